"""A detector's judgement of de-rendered photographs: are removed cars found again, and moved ones where they are?

Only cars that the detector finds in the photograph count. What it finds after all cars are
taken out is a remnant; a car that it no longer finds after a small move was drawn badly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from detectors.base import Predictor
from detectors.boxes import iou_matrix
from detectors.registry import load_predictor
from detectors.types import Detections
from drivesem.attacks.feasibility_check import check_places
from drivesem.attacks.labels import Labeller, SceneLabels
from drivesem.attacks.scene_edits import apply_changes
from drivesem.bench.session import Columns
from drivesem.config.edits import FrameEdit, ObjectEdit
from drivesem.config.options import SceneOptions
from drivesem.evaluation.resampling import wilson
from drivesem.reporting.drawing import PAPER_COLOUR, TEXT_PX, measure_text, write_text
from drivesem.run.workers import run_jobs
from drivesem.scenes.sources import SceneSource, open_source
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.io import load_scene
from scene_ir.removal import remove_objects
from scene_ir.render.compositor import Compositor, render
from scene_ir.types import Category, SceneIR
from tools.bench.settings import BenchTool
from tools.bench.sights import CAR, UNSEEN, VEHICLES, CarView, DetectorSight, DetectorView, Picture

TITLE = "Cars that a detector finds, removed and moved"
COLUMNS: Columns = {
    "which": ("cars", "cars"), "measure": ("figure", "figure"), "cars": ("count", "count"),
    "found": ("found", "found"), "share": ("share", "share"), "low": ("from", "from"), "high": ("to", "to"),
    "goal": ("goal", "goal"),
}  # fmt: skip
METHOD = (
    "Cars (KITTI's Car and Van) that became objects. Found: a detection of class Car with a score above 0.3 and "
    "an IoU of at least 0.5 with the box, each detection for one car only. Removed: of the cars found in the "
    "photograph, those found again at their old boxes after all objects were taken out; also at an IoU of "
    "0.3 already, as a vehicle of any class, at a score of 0.1 already, and those with old boxes in which at least "
    "half of a car lies that the photograph did not have. Moved: each car by 0.5 m along its heading and by 10 "
    "degrees, signs by seed such that it leaves neither road nor picture, hits nothing and stays as visible; one "
    "at a time, and all together; of those found in the photograph, the ones found at their moved boxes; as "
    "often: found at moved boxes over found at old ones. Judged: at least 25 px high and at most partly occluded, "
    "as labelled. Intervals: Wilson, 95 %. Pictures are rounded to 8 bits before they are judged."
)
FAINT_SCORE, LOOSE_IOU = 0.1, 0.3
"""Stricter thresholds that removal is also measured at."""
MOVE_M, TURN_RAD = 0.5, math.radians(10.0)
LEAST_HEIGHT_PX, MOST_OCCLUSION = 25.0, 1
_MORE_CUT = 0.05
"""Share of a car by which a move may carry it farther out of the picture."""


@dataclass(frozen=True, slots=True)
class CarRow:
    """One car of one frame."""

    frame: str
    row: int
    box_xyxy: tuple[float, ...]
    height_px: float
    occlusion: int
    truncation: float
    judged: bool
    """High and visible enough."""
    before: DetectorSight
    """In the photograph."""
    removed: DetectorSight
    """At the old box in the emptied picture, as a car and as any vehicle."""
    removed_any: DetectorSight
    """At the old box in the emptied picture, as a car and as any vehicle."""
    removed_faint: DetectorSight
    """As a car at a tenth of a score."""
    ghost: DetectorSight
    """The surest car that lies at least half in the old box and was not in the photograph."""
    move: tuple[float, float] | None
    """(m along the heading, rad)."""
    alone: DetectorSight | None
    """At the moved box, None where no move was possible."""
    together: DetectorSight | None
    """At the moved box, None where no move was possible."""


def measure(config: BenchTool, sheets: Path | None = None) -> Iterator[tuple[str, list[CarRow]]]:
    """Frame by frame, in the order in which they are done: its identifier and its cars.

    config: dataset, root, scenes, detector, tiles, limit, seed, workers. sheets: a folder that gets a picture
    of each failure. Raises DetectorError, SceneError or UsageError for bad input.
    """
    judge = _FoundJudge(config, sheets)
    names = judge.names()
    for name, outcome in run_jobs(judge.frame, partial(_in_process, config, sheets), names, config):
        yield name, outcome()


def count(config: BenchTool) -> int:
    """How many frames `measure` goes through."""
    return len(frame_names(config))


def _in_process(config: BenchTool, sheets: Path | None) -> Callable[[str], list[CarRow]]:
    return _FoundJudge(config, sheets).frame


def open_scene_source(config: BenchTool) -> SceneSource:
    """Scenes of a data set, or of a folder of scenes."""
    scene_options = SceneOptions(dataset=config.dataset, root=config.root, seed=config.seed, limit=config.limit)
    return SceneFolder(Path(config.scenes)) if config.scenes is not None else open_source(scene_options)


def frame_names(config: BenchTool) -> list[str]:
    """Their identifiers, as many as are wanted."""
    return list(open_scene_source(config).identifiers())[: config.limit]


class SceneFolder:
    """Scenes that `drivesem derender` wrote, wherever below a folder they lie."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._names = sorted(p.parent.relative_to(folder).as_posix() for p in folder.rglob("scene.json"))
        if not self._names:
            raise FormatError(str(folder), "scenes as drivesem derender writes them", "none")

    def account(self) -> None:
        return None

    def identifiers(self) -> Iterator[str]:
        return iter(self._names)

    def has_vehicles(self, identifier: str) -> bool:
        return len(self.scene(identifier).objects) > 0

    def photograph(self, identifier: str) -> Tensor:
        return self.scene(identifier).photograph

    def scene(self, identifier: str) -> SceneIR:
        return load_scene(self._folder / identifier)


class _FoundJudge:
    """What one process needs: built once, used for many frames."""

    def __init__(self, config: BenchTool, sheets: Path | None) -> None:
        self._config = config
        self._source = open_scene_source(config)
        self._sheets = sheets
        self._predictor = load_predictor(config.detector, config.device, config.tiles)

    def names(self) -> list[str]:
        return list(self._source.identifiers())[: self._config.limit]

    def frame(self, name: str) -> list[CarRow]:
        number = self.names().index(name)
        rng = np.random.default_rng([self._config.seed, number])
        return judge(name, self._source.scene(name), self._predictor, rng, self._sheets)


def judge(
    name: str, scene: SceneIR, predictor: Predictor, rng: np.random.Generator, sheets: Path | None = None
) -> list[CarRow]:
    """The cars of one scene, removed and moved. rng: signs of the moves. sheets: a folder for failures' pictures.

    Raises FormatError for a detector that knows no cars.
    """
    if CAR not in predictor.classes:
        raise FormatError("detector", f"one with class {CAR}", ", ".join(predictor.classes))
    rows = (scene.objects.category == int(Category.CAR)).nonzero()[:, 0].tolist()
    if not rows:
        return []
    eye = DetectorView(predictor)
    moves = CarMoves(scene, rows, rng)
    photograph = eye.view_cars(scene.photograph, scene.objects.box2d)
    emptied = eye.view_cars(_emptied(scene), scene.objects.box2d)
    together = moves.together()
    crowd = eye.view_cars(together.image, together.boxes_xyxy)
    found: list[CarRow] = []
    for row in rows:
        chosen = moves.alone.get(row)
        alone = None if chosen is None else eye.view_cars(chosen.image, chosen.boxes_xyxy)
        box, occlusion = scene.objects.box2d[row].tolist(), int(scene.objects.occlusion[row])
        height = box[3] - box[1]
        car = CarRow(
            frame=name,
            row=row,
            box_xyxy=tuple(round(v, 2) for v in box),
            height_px=round(height, 1),
            occlusion=occlusion,
            truncation=round(float(scene.objects.truncation[row]), 3),
            judged=height >= LEAST_HEIGHT_PX and occlusion <= MOST_OCCLUSION,
            before=photograph.assigned[row],
            removed=emptied.sight(row, (CAR,)),
            removed_any=emptied.sight(row, VEHICLES),
            removed_faint=emptied.sight(row, (CAR,), FAINT_SCORE),
            ghost=emptied.ghost(row, photograph),
            move=None if chosen is None else (chosen.along_m, chosen.turn),
            alone=None if alone is None else alone.assigned[row],
            together=crowd.assigned[row] if row in moves.in_crowd else None,
        )
        found.append(car)
        if sheets is None:
            continue
        for kind in failures(car):
            view = {"removed": emptied, "alone": alone, "together": crowd}[kind]
            assert view is not None
            now = {"removed": car.removed, "alone": car.alone, "together": car.together}[kind] or UNSEEN
            caption = f"{name} row {row}, {kind}: IoU {car.before.iou:.2f}, score {car.before.score:.2f} before, "
            caption += f"{now.iou:.2f}, {now.score:.2f} now"
            files.write_png(
                sheets / f"{kind}-{_plain(name)}-{row}.png", failure_sheet(photograph, view, row, caption)
            )
    return found


def failures(car: CarRow) -> list[str]:
    """What went wrong with a car that the photograph shows: removed, alone, together."""
    if not car.before.found:
        return []
    found = ["removed"] if car.removed.found else []
    return found + [
        k for k, s in (("alone", car.alone), ("together", car.together)) if s is not None and not s.found
    ]


def _emptied(scene: SceneIR) -> Tensor:
    empty = remove_objects(scene, range(len(scene.objects)))
    with torch.no_grad():
        return render([empty])[0].image


@dataclass(frozen=True, slots=True)
class MovedCar:
    """A scene with a car moved, or several; its picture (3, H, W), and the boxes (N, 4) px of all its objects."""

    along_m: float
    turn: float
    scene: SceneIR
    image: Tensor
    boxes_xyxy: Tensor


class CarMoves:
    """A move of each car of a scene that can be moved, and the scene with as many of them as fit together.

    alone: by row, what could be moved; in_crowd: rows moved in `together`.
    """

    def __init__(self, scene: SceneIR, rows: Sequence[int], rng: np.random.Generator) -> None:
        self._compositor = Compositor(scene)
        self._scene = scene
        with torch.no_grad():
            self._labeller = Labeller(scene, self._compositor.render(scene))
        signs = {row: rng.permutation(4) for row in rows}
        self.alone = {row: move for row in rows if (move := self._possible(row, signs[row])) is not None}
        self.in_crowd: list[int] = []

    def _possible(self, row: int, order: NDArray[np.int64]) -> MovedCar | None:
        for k in order.tolist():
            along, turn = (1 - 2 * (k & 1)) * MOVE_M, (1 - (k & 2)) * TURN_RAD
            changed = self._changed({row: (along, turn)})
            if changed is None:
                continue
            image, labels = self._drawn(changed)
            if self._as_visible(labels, row):
                return MovedCar(along, turn, changed, image, labels.boxes_xyxy)
        return None

    def _changed(self, places: Mapping[int, tuple[float, float]]) -> SceneIR | None:
        """The scene with cars moved, (m along, rad) by row; None where one leaves the road or hits another."""
        edits: dict[int | str, ObjectEdit] = {
            row: ObjectEdit(translate_m=(along, 0.0), rotate=turn) for row, (along, turn) in places.items()
        }
        changed = apply_changes(self._scene, FrameEdit(edits))
        return None if check_places(self._scene, changed, range(len(self._scene.objects))) else changed

    def _drawn(self, changed: SceneIR) -> tuple[Tensor, SceneLabels]:
        with torch.no_grad():
            drawn = self._compositor.render(changed)
            return drawn.image, self._labeller.moved(changed, drawn)

    def _as_visible(self, labels: SceneLabels, row: int) -> bool:
        """Whether a car is about as much in the picture as before, and hidden by others no more."""
        objects = self._scene.objects
        cut = float(labels.truncation[row] - objects.truncation[row]) > _MORE_CUT
        return not (
            cut or bool(labels.became_ignored[row]) or int(labels.occlusion[row]) > int(objects.occlusion[row])
        )

    def together(self) -> MovedCar:
        """As many moves at once as do not collide; without a way of their own."""
        places: dict[int, tuple[float, float]] = {}
        changed = self._scene
        for row, move in self.alone.items():
            more = self._changed({**places, row: (move.along_m, move.turn)})
            if more is not None:
                places[row], changed = (move.along_m, move.turn), more
        image, labels = self._drawn(changed)
        self.in_crowd = [row for row in places if self._as_visible(labels, row)]
        return MovedCar(0.0, 0.0, changed, image, labels.boxes_xyxy)


def summary(cars: Sequence[CarRow]) -> list[dict[str, Any]]:
    """A line a figure, of the judged cars, then of all: how many, how many found, share and interval, the goal."""
    return _summary([c for c in cars if c.judged], "judged") + _summary(cars, "all")


def _summary(cars: Sequence[CarRow], which: str) -> list[dict[str, Any]]:
    known = [c for c in cars if c.before.found]
    lines = [
        _line(which, "in the photograph", [c.before.found for c in cars]),
        _line(which, "removed, found again", [c.removed.found for c in known], "at most 0.05"),
        _line(which, f"removed, IoU {LOOSE_IOU}", [c.removed.iou >= LOOSE_IOU for c in known]),
        _line(which, "removed, as any vehicle", [c.removed_any.found for c in known]),
        _line(which, f"removed, score {FAINT_SCORE}", [c.removed_faint.found for c in known]),
        _line(which, "removed, a new car in its place", [c.ghost.score > 0 for c in known]),
    ]
    for name, key in (("one at a time", "alone"), ("all together", "together")):
        pairs = [(c.before.found, sight.found) for c in cars if (sight := getattr(c, key)) is not None]
        lines.append(_line(which, f"moved {name}", [now for then, now in pairs if then], "at least 0.95"))
        then, now = (sum(column) for column in zip(*pairs, strict=True)) if pairs else (0, 0)
        if then:
            line = {"cars": then, "found": now, "share": round(now / then, 4)}
            lines.append({"which": which, "measure": f"moved {name}, as often", **line})
    return [line for line in lines if line["cars"]]


def _line(which: str, measure: str, found: Sequence[bool], goal: str | None = None) -> dict[str, Any]:
    line: dict[str, Any] = {"which": which, "measure": measure, "cars": len(found), "found": sum(found)}
    if found:
        low, high = wilson(sum(found), len(found))
        line |= {"share": round(sum(found) / len(found), 4), "low": round(low, 4), "high": round(high, 4)}
    return {**line, "goal": goal}


def rank_sheets(cars: Sequence[CarRow], folder: Path) -> None:
    """Name the pictures of failures by how bad they are, judged cars before others: removed-01-000008-3.png.

    Pictures of earlier runs go.
    """
    written: set[str] = set()
    for kind in ("removed", "alone", "together"):
        failed = [c for c in cars if kind in failures(c)]
        failed.sort(key=lambda c: (not c.judged, -(c.removed.score if kind == "removed" else c.before.score)))
        for place, car in enumerate(failed, start=1):
            name = f"{_plain(car.frame)}-{car.row}.png"
            written.add(f"{kind}-{place:02d}-{name}")
            (folder / f"{kind}-{name}").replace(folder / f"{kind}-{place:02d}-{name}")
        for old in folder.glob(f"{kind}-*.png"):
            if old.name not in written:
                old.unlink()


def _plain(name: str) -> str:
    return name.replace("/", "_")


_TRUE, _GIVEN, _OTHER = (0, 158, 115), (240, 228, 66), (213, 94, 0)
"""Colours of Okabe and Ito: the object's box, cars, and vehicles of other classes that were found."""
_NEAR_IOU = 0.1
"""With the object's box before or after, of detections that are drawn."""
_CONTEXT, _PANEL_PX, _GAP_PX = 0.5, 420, 6
"""Of a sheet: context around the boxes in their longer sides, height of a panel, gap."""


def failure_sheet(
    before: CarView, after: CarView, row: int, caption: str, classes: Sequence[str] = (CAR,)
) -> Picture:
    """Photograph and edited picture around an object, side by side, without boxes above and with them below.

    classes: names of detections that count.
    """
    boxes = torch.stack([before.boxes_xyxy[row], after.boxes_xyxy[row]])
    x0, y0 = boxes[:, :2].amin(dim=0).tolist()
    x1, y1 = boxes[:, 2:].amax(dim=0).tolist()
    margin = _CONTEXT * max(x1 - x0, y1 - y0)
    height, width = before.picture.shape[:2]
    left, top = max(math.floor(x0 - margin), 0), max(math.floor(y0 - margin), 0)
    right, bottom = min(math.ceil(x1 + margin) + 1, width), min(math.ceil(y1 + margin) + 1, height)
    scale = _PANEL_PX / max(bottom - top, 1)
    panels = []
    for view in (before, after):
        cut = np.ascontiguousarray(view.picture[top:bottom, left:right])
        plain = cv2.resize(cut, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        drawn = plain.copy()
        _draw(drawn, view.boxes_xyxy[row], _TRUE, "", (left, top, scale))
        for names, colour in ((classes, _GIVEN), (VEHICLES[1:], _OTHER)):
            found = view.named(names)
            near = iou_matrix(found.boxes_xyxy, boxes).amax(dim=1) > _NEAR_IOU
            found = Detections(found.boxes_xyxy[near], found.labels[near], found.scores[near])
            for box, score, label in zip(found.boxes_xyxy, found.scores, found.labels, strict=True):
                text = f"{view.classes[int(label)]} {float(score):.2f}"
                _draw(drawn, box, colour, text, (left, top, scale))
        panels.append(np.concatenate([plain, drawn]))
    gap = np.full((panels[0].shape[0], _GAP_PX, 3), PAPER_COLOUR, np.uint8)
    picture = np.concatenate([panels[0], gap, panels[1]], axis=1)
    head = np.full((measure_text(caption, TEXT_PX)[1] + _GAP_PX, picture.shape[1], 3), PAPER_COLOUR, np.uint8)
    write_text(head, (2, 2), caption)
    return np.concatenate([head, picture])


def _draw(
    canvas: NDArray[Any], box: Tensor, colour: tuple[int, int, int], text: str, place: tuple[int, int, float]
) -> None:
    """A box px of the picture on a panel that begins at (left, top) and is enlarged by scale."""
    left, top, scale = place
    x0, y0, x1, y1 = ((box.cpu() + 0.5 - torch.tensor([left, top] * 2)) * scale).round().int().tolist()
    cv2.rectangle(canvas, (x0, y0), (x1, y1), colour, 2)
    if text:
        wide, high = measure_text(text, TEXT_PX)
        x, y = min(max(x0, 0), max(canvas.shape[1] - wide, 0)), min(max(y0 - high, 0), canvas.shape[0] - high)
        write_text(canvas, (x, y), text, colour)
