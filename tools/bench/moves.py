"""Accuracy of pictures with moved cars against the generator's, by distance.

The limits of budgets follow from this table (docs/guide/attack.md).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from detectors.boxes import iou_matrix
from detectors.registry import load_predictor
from drivesem.attacks.budgets import PAPER, PRESETS, STREET
from drivesem.bench.session import Columns
from drivesem.run.workers import run_jobs
from drivesem.synth.edits import apply_edit
from drivesem.synth.frames import SPLITS, SynthFrame, Truth, render_frame
from scene_ir import files
from scene_ir.derender.derender import VEHICLE_CATEGORIES, derender
from scene_ir.render.compositor import Compositor
from scene_ir.types import SceneIR
from tools.bench.derender import (
    EditedStreet,
    VehicleMove,
    apply_move,
    changed_region,
    disturb_labels,
    is_free,
    make_case,
    match_tracks,
    move_to_edit,
    synthetic_photograph,
    true_shape,
)
from tools.bench.pictures import SheetStrip, psnr, sheet
from tools.bench.settings import BenchTool
from tools.bench.sights import CAR, IOU, CarView, DetectorView

TITLE = "Moved cars by how far they went"
COLUMNS: Columns = {
    "split": ("streets", "streets"), "change": ("change", "change"), "count": ("cars", "cars"),
    "psnr_db": ("in the box, dB", "dB"), "tail_db": ("tail", "tail"), "unchanged_db": ("unchanged", "unchanged"),
    "region_db": ("all that changed, dB", "all"), "found": ("found, truth", "true"),
    "detected_ours": ("of these, ours", "ours"), "agree": ("agree", "agree"), "score_apart": ("score apart", "apart"),
    "score_tail": ("tail", "tail"),
    "invented": ("invented", "invented"),
}  # fmt: skip
METHOD = (
    "Frames as those of derender, half of the generator's training pools, half of the held-out ones; labels as"
    " far off. One well visible vehicle a frame is changed in every way of the table that keeps it free of "
    "collision, off kerbs, at least half visible and in the picture, and at least 0.6 times as high; signs by "
    "seed. Nearer and farther: along its heading, towards the camera or away. Size: all three. "
    "Anywhere in a budget: along, across, turned and grown at random within it. In the box: PSNR in the "
    "vehicle's true new box, ours to the generator's picture of the changed street; tail: the 10th percentile;"
    " unchanged: the photograph as the answer; all that changed: the region of derender, with the ground that "
    "it left. The detector runs on both pictures: how many it finds in the generator's (a Car above 0.3, IoU "
    "of at least 0.5), how many of these in ours; agree: found in both or in none; score apart: median "
    "difference of scores where found in both, and its 90th percentile; invented: Cars in ours, a picture, "
    "that meet no vehicle and nothing that it finds in the generator's."
)
QUICK_FRAMES, FULL_FRAMES = 6, 80
Split = Literal["train", "heldout"]
_ALONG_M = (0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0)
_ACROSS_M = (0.5, 1.0, 1.5)
_TURNS_DEG = (5, 10, 20, 30)
_SIZES = (0.05, 0.1, 0.2)
_SHARES = (0.0, 0.1, 0.2, 0.3, 0.5, 1.0)
"""Of a car's distance from the camera, by which it is brought nearer: bounds of what is counted together."""
_VISIBLE, _CUT, _MIN_HEIGHT_RATIO = 0.5, 0.5, 0.6
"""What must be left of a vehicle, as in attacks, where it comes to stand."""
_BUDGETS = (PAPER, STREET)
_TRIES = 8
"""Random places in a budget of which the first is taken that keeps the rules."""
_SHEET_CHANGES = 7
"""Pictures per frame."""


@dataclass(frozen=True, slots=True)
class MovedRow:
    """One vehicle after one change."""

    split: Split
    index: int
    change: str
    kind: str
    distance_m: float
    shift_m: tuple[float, float]
    turn_deg: float
    psnr_db: float
    unchanged_db: float
    region_db: float
    found: float | None
    """The scores with which the detector finds it in the generator's picture and in ours, None where it does not.
    The scores with which the detector finds it in the generator's picture and in ours, None where it does not."""
    ours: float | None
    """The scores with which the detector finds it in the generator's picture and in ours, None where it does not.
    The scores with which the detector finds it in the generator's picture and in ours, None where it does not."""
    invented: int
    """Cars that only ours shows."""


def names(config: BenchTool, frames: int) -> list[str]:
    """The frames in order, as `train/3`."""
    return [f"{SPLITS[k % 2]}/{k // 2}" for k in range(frames)]


def measure(config: BenchTool, frames: int, sheets: Path | None = None) -> Iterator[list[MovedRow]]:
    """The rows of each frame. sheets: a folder that gets a picture of each."""
    build = partial(_MovesJudge, config, sheets)
    for _, outcome in run_jobs(build(), build, names(config, frames), config):
        yield outcome()


class _MovesJudge:
    """What one process needs: built once, used for many frames."""

    def __init__(self, config: BenchTool, sheets: Path | None) -> None:
        self._seed, self._sheets = config.seed, sheets
        self._eye = DetectorView(load_predictor(config.detector, config.device, config.tiles))

    def __call__(self, name: str) -> list[MovedRow]:
        split: Split = "train" if name.startswith("train") else "heldout"
        index = int(name.partition("/")[2])
        rng = np.random.default_rng([self._seed, index, len(split)])
        case = make_case(self._seed, index, split)
        scene = derender(synthetic_photograph(case.before, disturb_labels(case.before, rng)))
        rows, strips = judge(case, scene, match_tracks(scene, case.before), self._eye, rng)
        if self._sheets is not None and strips:
            files.write_png(self._sheets / f"{split}-{index}.png", sheet(strips[:_SHEET_CHANGES]))
        return [replace(row, split=split, index=index) for row in rows]


def judge(
    case: EditedStreet, scene: SceneIR, tracks: Sequence[int], eye: DetectorView, rng: np.random.Generator
) -> tuple[list[MovedRow], list[SheetStrip]]:
    """One row a change that the case's vehicle can take; strips, the worst first. tracks: of the scene's objects;
    rng: signs, and places in budgets. Nothing where the vehicle is none of the objects.
    """
    before = case.before
    old = true_shape(before, case.move.track)
    rows: list[MovedRow] = []
    strips: list[tuple[float, SheetStrip]] = []
    if case.move.track not in tracks:
        return [], []
    compositor = Compositor(scene)
    for change, moves in changes(old, rng):
        changed = next(filter(None, (changed_case(case, move) for move in moves)), None)
        if changed is None:
            continue
        image = compositor.render(apply_move(changed, scene, tracks)).image
        new = true_shape(changed.moved, case.move.track)
        box = _inside(new, before.image.shape[:2])
        boxes = torch.tensor(np.stack([new.box_xyxy, *_others(changed.moved, case.move.track)])).float()
        true = torch.from_numpy(changed.moved.image.transpose(2, 0, 1).astype(np.float32) / 255)
        theirs, ours = (eye.view_cars(picture, boxes) for picture in (true, image))
        region = changed_region(before, changed.moved, [case.move.track])
        row = MovedRow(
            split="train",
            index=0,
            change=change,
            kind=new.actor.kind,
            distance_m=round(float(np.hypot(*old.translation[[0, 2]])), 2),
            shift_m=changed.move.shift_m,
            turn_deg=round(math.degrees(changed.move.turn), 1),
            psnr_db=round(psnr(ours.picture, changed.moved.image, box), 3),
            unchanged_db=round(psnr(before.image, changed.moved.image, box), 3),
            region_db=round(psnr(ours.picture, changed.moved.image, region), 3),
            found=_score(theirs),
            ours=_score(ours),
            invented=_invented(ours, theirs),
        )
        rows.append(row)
        caption = f"{new.actor.kind} {change}: {row.psnr_db:.1f} dB, score {row.found} and {row.ours}"
        strips.append((row.psnr_db, SheetStrip(before.image, ours.picture, changed.moved.image, region, caption)))
    return rows, [strip for _, strip in sorted(strips, key=lambda pair: pair[0])]


def changes(old: Truth, rng: np.random.Generator) -> Iterator[tuple[str, list[VehicleMove]]]:
    """What is tried on a vehicle, by name: the moves, either of which will do."""
    track = old.actor.track
    # The heading is (cos yaw, -sin yaw) in (x, z): whether it leads away from the camera.
    away = 1.0 if float(np.cos(old.yaw) * old.translation[0] - np.sin(old.yaw) * old.translation[2]) > 0 else -1.0
    for metres in _ALONG_M:
        yield f"{metres:g} m nearer", [VehicleMove(track, (-away * metres, 0.0), 0.0)]
        yield f"{metres:g} m farther", [VehicleMove(track, (away * metres, 0.0), 0.0)]
    either: list[tuple[str, Callable[[float], VehicleMove]]] = []
    either += [(f"{m:g} m across", lambda sign, m=m: VehicleMove(track, (0.0, sign * m), 0.0)) for m in _ACROSS_M]
    either += [
        (f"{d} degrees", lambda sign, d=d: VehicleMove(track, (0.0, 0.0), sign * math.radians(d)))
        for d in _TURNS_DEG
    ]
    either += [
        (f"{s:.0%} in size", lambda sign, s=s: VehicleMove(track, (0.0, 0.0), 0.0, sign * s)) for s in _SIZES
    ]
    for name, of in either:
        sign = float(rng.choice((-1.0, 1.0)))
        yield name, [of(sign), of(-sign)]
    length_m = old.actor.size_lhw[0]
    for name in _BUDGETS:
        budget = PRESETS[name]
        distance_m = float(np.linalg.norm(old.translation))
        along = min(budget.translate * length_m, budget.translate_m, budget.distance_share * distance_m)
        most = np.array([along, min(along, budget.across_m), budget.rotate, budget.size])
        drawn = rng.uniform(-most, most, (_TRIES, len(most))).tolist()
        yield f"anywhere in {name}", [VehicleMove(track, (x, z), turn, size) for x, z, turn, size in drawn]


def changed_case(case: EditedStreet, move: VehicleMove) -> EditedStreet | None:
    """The case with another move; None where the vehicle would hit something, or too little of it be left."""
    old = true_shape(case.before, move.track)
    if not is_free(case.plan, old.actor, move):
        return None
    moved = render_frame(apply_edit(case.plan, move_to_edit(move)))
    if moved is None or all(t.actor.track != move.track for t in moved.truths):
        return None
    new = true_shape(moved, move.track)
    high = [float(t.box_xyxy[3] - t.box_xyxy[1]) for t in (old, new)]
    judged = new.labelled and new.visible >= _VISIBLE and new.truncation <= _CUT
    return replace(case, move=move, moved=moved) if judged and high[1] >= _MIN_HEIGHT_RATIO * high[0] else None


def _others(frame: SynthFrame, track: int) -> list[np.ndarray]:
    return [t.box_xyxy for t in frame.truths if t.actor.label in VEHICLE_CATEGORIES and t.actor.track != track]


def _inside(truth: Truth, frame_hw: tuple[int, ...]) -> np.ndarray:
    """Pixels (H, W) of a vehicle's box."""
    mask = np.zeros(frame_hw[:2], bool)
    x0, y0, x1, y1 = (max(round(float(v)), 0) for v in truth.box_xyxy)
    mask[y0 : y1 + 1, x0 : x1 + 1] = True
    return mask


def _score(view: CarView) -> float | None:
    return view.assigned[0].score if view.assigned[0].found else None


def _invented(ours: CarView, theirs: CarView) -> int:
    """Cars that the detector finds in our picture, and that meet no vehicle and none that it finds in theirs."""
    found = ours.named((CAR,)).boxes_xyxy
    known = torch.cat([ours.boxes_xyxy, theirs.named((CAR,)).boxes_xyxy])
    return int((iou_matrix(found, known).amax(dim=1) < IOU).sum()) if len(found) else 0


def summary(rows: Sequence[MovedRow]) -> list[dict[str, Any]]:
    """A line a change and split, in the order in which they were tried, then those nearer by share of distance."""
    order = [f"{m:g} m {way}" for m in _ALONG_M for way in ("nearer", "farther")]
    order += [f"{m:g} m across" for m in _ACROSS_M] + [f"{d} degrees" for d in _TURNS_DEG]
    order += [f"{s:.0%} in size" for s in _SIZES] + [f"anywhere in {name}" for name in _BUDGETS]
    lines = []
    for split in SPLITS:
        own = [row for row in rows if row.split == split]
        groups = {change: [row for row in own if row.change == change] for change in order}
        for low, high in itertools.pairwise(_SHARES):
            groups[f"{low:g} to {high:g} of its distance nearer"] = [
                row
                for row in own
                if row.change.endswith("nearer") and low <= abs(row.shift_m[0]) / row.distance_m < high
            ]
        lines += [{"split": split, "change": change, **_line(given)} for change, given in groups.items() if given]
    return lines


def _line(rows: Sequence[MovedRow]) -> dict[str, Any]:
    both = [abs(row.found - row.ours) for row in rows if row.found is not None and row.ours is not None]
    seen = [row for row in rows if row.found is not None]
    return {
        "count": len(rows),
        "psnr_db": round(float(np.median([row.psnr_db for row in rows])), 1),
        "tail_db": round(float(np.percentile([row.psnr_db for row in rows], 10)), 1),
        "region_db": round(float(np.median([row.region_db for row in rows])), 1),
        "unchanged_db": round(float(np.median([row.unchanged_db for row in rows])), 1),
        "found": len(seen),
        "detected_ours": sum(row.ours is not None for row in seen),
        "agree": round(float(np.mean([(row.found is None) == (row.ours is None) for row in rows])), 3),
        "score_apart": round(float(np.median(both)), 3) if both else None,
        "score_tail": round(float(np.percentile(both, 90)), 3) if both else None,
        "invented": round(float(np.mean([row.invented for row in rows])), 3),
    }
