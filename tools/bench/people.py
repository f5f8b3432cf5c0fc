"""A detector's judgement of people cut out of photographs: found where they were moved, not where they were removed?

Only people whom the detector finds in the photograph count. Streets that `drivesem synth` wrote are also compared
with the generator's own pictures of the moved people.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from detectors.boxes import iou_matrix
from detectors.registry import load_predictor
from detectors.types import CLASSES
from drivesem.attacks.budgets import PRESETS, STREET
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.labels import Labeller
from drivesem.attacks.space import Parameter, ParameterSpace
from drivesem.attacks.targets import resolve_t_star
from drivesem.bench.session import Columns
from drivesem.config.options import SceneOptions
from drivesem.data.subsets import FrameFilter, open_selection
from drivesem.evaluation.resampling import wilson
from drivesem.failures.second_renderer.base import MANIFEST
from drivesem.failures.second_renderer.generator import FolderPlans, transfer_edit
from drivesem.scenes.sources import NoVehicleError, open_source
from drivesem.synth.edits import apply_edit
from drivesem.synth.frames import render_frame
from scene_ir import files
from scene_ir.io import to_uint8
from scene_ir.removal import remove_objects
from scene_ir.render.compositor import Compositor, render
from scene_ir.types import UPRIGHT, SceneIR
from tools.bench.found import LOOSE_IOU, failure_sheet
from tools.bench.settings import BenchTool
from tools.bench.sights import CarView, DetectorSight, DetectorView, Picture, assign

TITLE = "People that a detector finds, moved and removed"
COLUMNS: Columns = {
    "measure": ("figure", "figure"), "people": ("count", "count"), "found": ("found", "found"),
    "share": ("share", "share"), "low": ("from", "from"), "high": ("to", "to"), "goal": ("goal", "goal"),
}  # fmt: skip
GENERATOR_TITLE = "Moved people against the generator's"
GENERATOR_COLUMNS: Columns = {
    "move": ("moved", "moved"), "people": ("people", "people"), "ours": ("ours, levels", "ours"),
    "pasted": ("pasted, levels", "pasted"), "nearer": ("ours nearer", "nearer"),
}  # fmt: skip
METHOD = (
    "People and cyclists that became objects, frames in order until --frames have some. Found: a detection of class "
    "Pedestrian or Cyclist with a score above t* and an IoU of at least 0.5 with the box, each detection for one "
    "object only. Exact: frames in which the render without a change, as an 8-bit picture, is the photograph. Moved: "
    "each one alone, by 0.5, 1 and 2 m along the heading or across, the first of the four ways, in random order, that "
    "the projection of the budget street leaves as it is and that hides and cuts the person no more; of those found in "
    "the photograph, the ones found at their moved boxes; moved away: moves to a box with an IoU below 0.3 with the "
    "old one, after which a person is still found there. Removed: of the same, places where a person is still found "
    "after all of them were taken out. Generated streets: mean absolute difference, in levels of 255, from the "
    "generator's picture of the moved person in that person's true new box; pasted: the old box of the photograph "
    "copied there, foot to foot; removed: from its picture without people, in the old box; medians. Intervals: "
    "Wilson, 95 %."
)
MOVES_M = (0.5, 1.0, 2.0)
PEOPLE = tuple(CLASSES[int(category)] for category in UPRIGHT)
_MORE_CUT = 0.05
"""Share of a person by which a move may carry it farther out of the picture."""
_STAYS_M = 0.01
"""Largest difference between a move and its projection."""


@dataclass(frozen=True, slots=True)
class PersonMove:
    """One person after one move."""

    metres: float
    shift_m: tuple[float, float]
    """(along the heading, across)."""
    sight: DetectorSight
    """At the moved box."""
    left: DetectorSight | None
    """At the old box, given to no other; None where the moved box overlaps it."""
    ours: float | None = None
    """Levels between our picture and the generator's, in the true new box; None for photographs."""
    pasted: float | None = None
    """The same of the old box copied there."""


@dataclass(frozen=True, slots=True)
class PersonRow:
    """One person of one frame."""

    frame: str
    row: int
    kind: str
    box_xyxy: tuple[float, ...]
    distance_m: float
    exact: bool
    """Whether the frame's render without a change equals the photograph."""
    before: DetectorSight
    removed: DetectorSight
    """At the old box, after all people were taken out."""
    moves: tuple[PersonMove, ...] = field(default=())
    """The moves that are feasible."""
    emptied: float | None = None
    """Levels between our picture without people and the generator's, in the old box; None for photographs."""


def measure(config: BenchTool, sheets: Path | None = None) -> Iterator[list[PersonRow]]:
    """The people of each frame that has some. sheets: a folder that gets a picture of each failure.

    Raises DetectorError, SceneError or UsageError for bad input.
    """
    options = SceneOptions(
        dataset=config.dataset, root=config.root, seed=config.seed, where=config.where, people=True
    )
    options.check()
    source, judge, frames = open_source(options), PeopleJudge(config, sheets), 0
    labelled = open_selection(config.dataset, config.root or "", FrameFilter.from_options(options))
    for index, name in enumerate(labelled.identifiers):
        if frames == config.frames:
            return
        labels = labelled.labels(name)
        if labels is None or not set(PEOPLE) & set(labels.kind):
            continue
        try:
            scene = source.scene(name)
        except NoVehicleError:
            continue
        rows = judge.judge(name, scene, np.random.default_rng([config.seed, index]))
        if rows:
            frames += 1
            yield rows


@dataclass(frozen=True, slots=True)
class PeopleMove:
    """A scene with one person moved; its picture (3, H, W), and the boxes (N, 4) px of all its objects."""

    shift_m: tuple[float, float]
    scene: SceneIR
    image: Tensor
    boxes_xyxy: Tensor


class PeopleJudge:
    """Judges the people of scenes."""

    def __init__(self, config: BenchTool, sheets: Path | None) -> None:
        self._predictor = load_predictor(config.detector, config.device, config.tiles)
        self._t_star, self._sheets = resolve_t_star(self._predictor), sheets
        self._view = DetectorView(self._predictor, PEOPLE, self._t_star)
        root = Path(config.root or "")
        self._plans = FolderPlans(root) if (root / MANIFEST).is_file() else None

    @torch.no_grad()
    def judge(self, name: str, scene: SceneIR, rng: np.random.Generator) -> list[PersonRow]:
        """The people of one scene; rng: order of the ways."""
        people = scene.objects.upright.nonzero()[:, 0].tolist()
        if not people:
            return []
        moves = PeopleMoves(scene)
        before = self._view.view_cars(scene.photograph, scene.objects.box2d[people])
        emptied = self._view.view_cars(render([remove_objects(scene, people)])[0].image, before.boxes_xyxy)
        removed = assign(before.boxes_xyxy, emptied.named(PEOPLE, self._t_star))
        empty = self._draw_empty(name, scene, people)
        found = []
        for place, row in enumerate(people):
            old_xyxy = scene.objects.box2d[row].numpy()
            if before.assigned[place].found and removed[place].found:
                self._write(name, place, "removed", before, emptied)
            moved = []
            for metres in MOVES_M:
                step = moves.first_feasible(row, metres, rng)
                if step is None:
                    continue
                after = self._view.view_cars(step.image, step.boxes_xyxy[people])
                if before.assigned[place].found and not after.assigned[place].found:
                    self._write(name, place, f"moved-{metres:g}", before, after)
                left = self._left_behind(after, before.boxes_xyxy[place : place + 1], place)
                if before.assigned[place].found and left is not None and left.found:
                    self._write(name, place, f"left-{metres:g}", before, after)
                errors = self._compare(name, scene, step.scene, row, after.picture)
                moved.append(PersonMove(metres, step.shift_m, after.assigned[place], left, *errors))
            found.append(
                PersonRow(
                    frame=name,
                    row=row,
                    kind=CLASSES[int(scene.objects.category[row])],
                    box_xyxy=tuple(round(v, 2) for v in scene.objects.box2d[row].tolist()),
                    distance_m=round(float(scene.objects.translation[row, [0, 2]].norm()), 2),
                    exact=moves.exact,
                    before=before.assigned[place],
                    removed=removed[place],
                    moves=tuple(moved),
                    emptied=None if empty is None else _levels(emptied.picture, empty, old_xyxy),
                )
            )
        return found

    def _left_behind(self, after: CarView, old_xyxy: Tensor, place: int) -> DetectorSight | None:
        """What is found in the old box (1, 4) of a person who moved; None where the moved box overlaps it."""
        if float(iou_matrix(after.boxes_xyxy[place : place + 1], old_xyxy)) >= LOOSE_IOU:
            return None
        found = after.named(PEOPLE, self._t_star)
        return assign(torch.cat([after.boxes_xyxy, old_xyxy]), found)[-1]

    def _write(self, name: str, place: int, what: str, before: CarView, after: CarView) -> None:
        if self._sheets is not None:
            caption = f"{name} person {place}, {what}: score {before.assigned[place].score:.2f} before"
            file = f"{what}-{name.replace('/', '_')}-{place}.png"
            files.write_png(self._sheets / file, failure_sheet(before, after, place, caption, PEOPLE))

    def _draw_empty(self, name: str, scene: SceneIR, people: list[int]) -> Picture | None:
        """The generator's picture without people; None for photographs."""
        if self._plans is None:
            return None
        planned = self._plans.find_plan(name, scene)
        gone = {planned.tracks[row] for row in people}
        drawn = render_frame(
            replace(planned.plan, actors=tuple(one for one in planned.plan.actors if one.track not in gone))
        )
        return None if drawn is None else drawn.image

    def _compare(
        self, name: str, scene: SceneIR, changed: SceneIR, row: int, picture: Picture
    ) -> tuple[float, float] | tuple[()]:
        """Levels by which our picture of a moved person, and the old box copied there, differ from the generator's.

        Empty for photographs, and where the generator's picture does not show the person.
        """
        if self._plans is None:
            return ()
        planned = self._plans.find_plan(name, scene)
        moved = render_frame(apply_edit(planned.plan, transfer_edit(scene, changed, planned).edit))
        if moved is None:
            return ()
        boxes = [truth.box_xyxy for truth in moved.truths if truth.actor.track == planned.tracks[row]]
        if not boxes:
            return ()
        pasted = paste(to_uint8(scene.photograph), scene.objects.box2d[row].numpy(), boxes[0])
        return _levels(picture, moved.image, boxes[0]), _levels(pasted, moved.image, boxes[0])


class PeopleMoves:
    """Feasible moves of a scene's people, and their pictures."""

    def __init__(self, scene: SceneIR) -> None:
        self._space = ParameterSpace(scene, (Parameter.TRANSLATE,), PRESETS[STREET])
        self._feasible, self._compositor = FeasibleSet(self._space), Compositor(scene)
        still = self._compositor.render(scene)
        self._labeller = Labeller(scene, still)
        self.exact = bool((to_uint8(still.image) == to_uint8(scene.photograph)).all())

    def first_feasible(self, row: int, metres: float, rng: np.random.Generator) -> PeopleMove | None:
        """The first way along or across, in random order, in which a person can go so far; None without one."""
        objects = self._space.scene.objects
        length_m = float(objects.size_lhw[row, 0])
        for way in rng.permutation(4).tolist():
            shift_m = [0.0, 0.0]
            shift_m[way // 2] = metres if way % 2 else -metres
            theta = self._space.lower.new_zeros(self._space.dim)
            theta[2 * row : 2 * row + 2] = theta.new_tensor(shift_m) / length_m
            if float((self._feasible.project(theta).theta - theta).abs().max()) * length_m > _STAYS_M:
                continue
            changed = self._space.apply(self._space.scene, theta)
            drawn = self._compositor.render(changed)
            labels = self._labeller.moved(changed, drawn)
            cut = float(labels.truncation[row] - objects.truncation[row]) > _MORE_CUT
            if cut or bool(labels.became_ignored[row]) or int(labels.occlusion[row]) > int(objects.occlusion[row]):
                continue
            return PeopleMove((shift_m[0], shift_m[1]), changed, drawn.image, labels.boxes_xyxy)
        return None


def paste(picture: Picture, old_xyxy: NDArray[Any], new_xyxy: NDArray[Any]) -> Picture:
    """The picture (H, W, 3) with the pixels of the old box copied to the new one: middle to middle, foot to foot."""
    x0, y0, x1, y1 = _pixels(old_xyxy, picture.shape)
    right = round(float(new_xyxy[0] + new_xyxy[2] - old_xyxy[0] - old_xyxy[2]) / 2)
    down = round(float(new_xyxy[3] - old_xyxy[3]))
    height, width = picture.shape[:2]
    pasted = picture.copy()
    left, top = max(x0 + right, 0), max(y0 + down, 0)
    bottom, end = min(y1 + down, height), min(x1 + right, width)
    pasted[top:bottom, left:end] = picture[top - down : bottom - down, left - right : end - right]
    return pasted


def _levels(picture: Picture, truth: Picture, box_xyxy: NDArray[Any]) -> float:
    """Mean absolute difference of two pictures (H, W, 3) in a box (4,) px, in levels of 255."""
    x0, y0, x1, y1 = _pixels(box_xyxy, truth.shape)
    part = slice(y0, y1), slice(x0, x1)
    return round(float(np.abs(picture[part].astype(np.float64) - truth[part]).mean()), 3)


def _pixels(box_xyxy: NDArray[Any], shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """First and past the last column and row of a box's pixels inside of a picture."""
    x0, y0, x1, y1 = (round(float(value)) for value in box_xyxy)
    return max(x0, 0), max(y0, 0), min(x1 + 1, shape[1]), min(y1 + 1, shape[0])


def summary(rows: Sequence[PersonRow]) -> list[dict[str, Any]]:
    """A line a figure: how many, how many found, share and interval, the goal."""
    known = [row for row in rows if row.before.found]
    exact = {row.frame: row.exact for row in rows}
    lines = [_line("frames, exact without a change", list(exact.values()), "all")]
    lines.append(_line("in the photograph", [row.before.found for row in rows]))
    for metres in MOVES_M:
        moved = [move.sight.found for row in known for move in row.moves if move.metres == metres]
        lines.append(_line(f"moved {metres:g} m", moved, "at least 0.9"))
    left = [move.left.found for row in known for move in row.moves if move.left is not None]
    lines.append(_line("moved away, found where they were", left, "none"))
    return [*lines, _line("removed", [row.removed.found for row in known], "none")]


def _line(measure: str, found: Sequence[bool], goal: str | None = None) -> dict[str, Any]:
    line: dict[str, Any] = {"measure": measure, "people": len(found), "found": sum(found)}
    if found:
        low, high = wilson(sum(found), len(found))
        line |= {"share": round(sum(found) / len(found), 4), "low": round(low, 4), "high": round(high, 4)}
    return {**line, "goal": goal}


def compare_with_generator(rows: Sequence[PersonRow]) -> list[dict[str, Any]]:
    """A line a move, and one for removal; none for photographs."""
    lines = []
    for metres in MOVES_M:
        pairs = [
            (move.ours, move.pasted)
            for row in rows
            for move in row.moves
            if move.metres == metres and move.ours is not None and move.pasted is not None
        ]
        if pairs:
            ours, pasted = (round(float(np.median(column)), 1) for column in zip(*pairs, strict=True))
            nearer = sum(ours < pasted for ours, pasted in pairs)
            lines.append(
                {"move": f"{metres:g} m", "people": len(pairs), "ours": ours, "pasted": pasted, "nearer": nearer}
            )
    emptied = [row.emptied for row in rows if row.emptied is not None]
    if emptied:
        lines.append({"move": "removed", "people": len(emptied), "ours": round(float(np.median(emptied)), 1)})
    return lines
