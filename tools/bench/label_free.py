"""Photographs without labels held against labels that were hidden: heading, distance and place, before the fit to
the photograph and after it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from detectors.boxes import iou_matrix
from drivesem.bench.session import Columns
from drivesem.config.options import DEMO
from drivesem.run.workers import run_jobs
from scene_ir.derender.derender import VEHICLE_CATEGORIES, DerenderSettings, place_vehicles
from scene_ir.types import Camera, Frame, Labels
from tools.bench.settings import BenchTool

TITLE = "Photographs without labels, against hidden labels"
COLUMNS: Columns = {
    "measure": ("figure", "figure"), "median": ("median", "median"), "tail": ("tail", "tail"),
    "worst": ("worst", "worst"), "count": ("count", "count"), "goal": ("goal", "goal"),
}  # fmt: skip
METHOD = (
    "Photographs and their cameras, labels hidden. The shipped detector finds vehicles at its t*, the shipped "
    "network places them, the fit moves them; generated frames are of the generator's held-out pools. A vehicle "
    "counts where its box meets a label's (IoU of at least 0.5) that is at least 25 px high, at most partly "
    "occluded and at most 30 % truncated. Heading: between estimate and label, those that look backwards "
    "included; turned: off by more than 90 degrees; axis: but for half turns. Depth: relative; place: on the "
    "ground. The tail is the 90th percentile."
)
QUICK_FRAMES, FULL_FRAMES = 12, 60
_MEETS = 0.5
NEAR_PX = 120.0
LEAST_HEIGHT_PX, MOST_OCCLUSION, MOST_TRUNCATION = 25.0, 1, 0.3
"""KITTI's moderate level."""
_GOALS = {"heading, degrees": "median 5", "depth, relative": "median 0.06"}


@dataclass(frozen=True, slots=True)
class VehicleError:
    """Between an estimate and a label: yaw_deg in [0, 180], relative depth, m on the ground."""

    yaw_deg: float
    depth: float
    place_m: float


@dataclass(frozen=True, slots=True)
class VehicleRow:
    """One labelled vehicle that was found: as the network places it, and after the fit, None where the fit left it
    out."""

    frame: str
    label: int
    height_px: float
    before: VehicleError
    after: VehicleError | None


@dataclass(frozen=True, slots=True)
class FrameRows:
    """A frame's vehicles."""

    labelled: int
    """How many there were to be found."""
    rows: tuple[VehicleRow, ...]
    near: tuple[float, ...] = ()
    """Of each very near one, cut ones too, 1 - IoU of its box and the one placed that it meets best."""


def names(config: BenchTool) -> list[str]:
    """The frames that are measured. Raises SceneError for a data set that cannot be read."""
    if config.dataset == DEMO:
        count = config.frames or (QUICK_FRAMES if config.quick else FULL_FRAMES)
        return [f"{index:03d}" for index in range(count)]
    from drivesem.data.registry import open_dataset

    return list(open_dataset(config.dataset, Path(config.root or "")).identifiers)[: config.limit or config.frames]


def measure(config: BenchTool) -> Iterator[tuple[str, FrameRows]]:
    """Frame by frame, in the order in which they are done. config: dataset, root, frames, seed, workers. Raises
    SceneError for a frame that cannot be used."""
    for name, outcome in run_jobs(
        _LabelFreeJudge(config).frame, partial(_in_process, config), names(config), config
    ):
        yield name, outcome()


def _in_process(config: BenchTool) -> Callable[[str], FrameRows]:
    return _LabelFreeJudge(config).frame


class _LabelFreeJudge:
    """What one process needs: built once, used for many frames."""

    def __init__(self, config: BenchTool) -> None:
        self._config = config

    def frame(self, name: str) -> FrameRows:
        frame = load_frame_without_labels(self._config, name)
        return FrameRows(0, ()) if frame.labels is None else judge(frame, frame.labels)


def load_frame_without_labels(config: BenchTool, name: str) -> Frame:
    """A frame of the data set, or a generated one by its number. Raises SceneError for one that cannot be read."""
    if config.dataset != DEMO:
        from drivesem.data.registry import open_dataset

        return open_dataset(config.dataset, Path(config.root or "")).frame(name)
    from drivesem.synth.frames import generate_frame

    made = generate_frame(config.seed, int(name), "heldout")
    picture = torch.from_numpy(made.image.transpose(2, 0, 1).astype(np.float32) / np.float32(255))
    return Frame(name, picture, made.camera, made.labels)


def judge(frame: Frame, labels: Labels) -> FrameRows:
    """Hold what is found of a frame's photograph against labels that were hidden from it."""
    from drivesem.scenes.label_free import detect, detection_fit_settings, label_from_detections

    bare = Frame(frame.identifier, frame.photograph, frame.camera)
    found = label_from_detections(bare, detect(bare))
    assert found.labels is not None
    fitted = place_vehicles(found, detection_fit_settings(DerenderSettings()))
    guess = found.labels
    mine = [i for i, kind in enumerate(guess.kind) if kind in VEHICLE_CATEGORIES]
    wanted = judged(labels)
    overlap = iou_matrix(labels.boxes_xyxy[wanted].float(), guess.boxes_xyxy[mine]).numpy()
    rows = []
    for k, label in enumerate(wanted):
        best = int(overlap[k].argmax()) if mine else -1
        # a vehicle found belongs to the label that it meets best
        if best < 0 or overlap[k, best] < _MEETS or int(overlap[:, best].argmax()) != k:
            continue
        row = mine[best]
        before = vehicle_error(labels, label, guess.translation[row], float(guess.yaw[row]), frame.camera)
        end = fitted.get(row)
        after = (
            None if end is None else vehicle_error(labels, label, end.translation, float(end.yaw), frame.camera)
        )
        height = float(labels.boxes_xyxy[label, 3] - labels.boxes_xyxy[label, 1])
        rows.append(VehicleRow(frame.identifier, label, round(height, 1), before, after))
    near = labels.boxes_xyxy[nearest(labels)].float()
    meets = iou_matrix(near, guess.boxes_xyxy[mine])
    apart = 1 - meets.amax(dim=1) if mine else torch.ones(len(near))
    return FrameRows(len(wanted), tuple(rows), tuple(round(value, 4) for value in apart.tolist()))


def judged(labels: Labels) -> list[int]:
    """Rows of the vehicles that count."""
    height = labels.boxes_xyxy[:, 3] - labels.boxes_xyxy[:, 1]
    clear = (
        (height >= LEAST_HEIGHT_PX) & (labels.occlusion <= MOST_OCCLUSION) & (labels.truncation <= MOST_TRUNCATION)
    )
    posed = (labels.size_lhw > 0).all(1) & torch.isfinite(labels.yaw)
    return [i for i, kind in enumerate(labels.kind) if kind in VEHICLE_CATEGORIES and bool(clear[i] & posed[i])]


def nearest(labels: Labels) -> list[int]:
    """Rows of the vehicles that are very near, whole or not."""
    height = labels.boxes_xyxy[:, 3] - labels.boxes_xyxy[:, 1]
    clear = (height >= NEAR_PX) & (labels.occlusion <= MOST_OCCLUSION)
    return [i for i, kind in enumerate(labels.kind) if kind in VEHICLE_CATEGORIES and bool(clear[i])]


def vehicle_error(labels: Labels, row: int, translation: Tensor, yaw: float, camera: Camera) -> VehicleError:
    """Errors of an estimate against a label."""
    true = labels.translation[row].double()
    apart = translation.double() - true
    offset = float(camera.matrix[2, 3])
    turn = math.remainder(yaw - float(labels.yaw[row]), 2 * math.pi)
    return VehicleError(
        round(abs(math.degrees(turn)), 3),
        round(abs(float(apart[2])) / (float(true[2]) + offset), 4),
        round(float(torch.hypot(apart[0], apart[2])), 3),
    )


def summary(frames: Sequence[FrameRows]) -> list[dict[str, Any]]:
    """A line a figure: median, 90th percentile, worst, count, goal."""
    rows = [row for frame in frames for row in frame.rows]
    labelled = sum(frame.labelled for frame in frames)
    lines: list[dict[str, Any]] = []
    if labelled:
        lines.append(
            {"measure": "vehicles found, share", "median": round(len(rows) / labelled, 4), "count": labelled}
        )
    near = np.array([value for frame in frames for value in frame.near])
    if len(near):
        lines.append(_line(f"1 - IoU of boxes from {NEAR_PX:.0f} px high, cut ones too", near))
    for stage in ("before", "after"):
        errors = [e for row in rows if (e := getattr(row, stage)) is not None]
        if not errors:
            continue
        yaw = np.array([e.yaw_deg for e in errors])
        metrics = {
            "heading, degrees": yaw,
            "axis, degrees": np.minimum(yaw, 180 - yaw),
            "depth, relative": np.array([e.depth for e in errors]),
            "place, m": np.array([e.place_m for e in errors]),
        }
        when = "as placed" if stage == "before" else "after the fit"
        for name, values in metrics.items():
            goal = _GOALS.get(name) if stage == "after" else None
            lines.append(_line(f"{name}, {when}", values) | {"goal": goal})
        share = round(float((yaw > 90).mean()), 4)
        lines.append({"measure": f"turned, share, {when}", "median": share, "count": len(yaw)})
    return lines


def _line(measure: str, values: np.ndarray) -> dict[str, Any]:
    return {
        "measure": measure,
        "median": round(float(np.median(values)), 4),
        "tail": round(float(np.percentile(values, 90)), 4),
        "worst": round(float(values.max()), 4),
        "count": len(values),
    }
