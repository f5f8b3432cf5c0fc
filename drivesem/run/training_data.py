"""The counterexamples of a run as training data: pictures, labels that moved along, and what each picture is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drivesem.data.frames import size_of_image
from drivesem.data.kitti_labels import table_of
from drivesem.data.label_table import REGION, LabelTable, camera_entry, shortest
from drivesem.failures.grades import Grade
from drivesem.run.labels import RESULT, frames_in
from drivesem.run.results import FrameResult, load_frame
from scene_ir.errors import FormatError
from scene_ir.io import load_camera, load_others

PICTURE, LABELS = "counterexample.png", "labels_moved.txt"
"""What of a frame is trained on."""
_SAME_PX = 0.002
"""Label files have three decimals."""


def pictures(run: Path, frames: Sequence[str]) -> dict[str, Path]:
    """The counterexamples of a run, by frame, that are there."""
    found = {name: run / "frames" / name / PICTURE for name in frames}
    return {name: path for name, path in found.items() if path.is_file()}


def labels_of_run(run: Path, frames: Sequence[str] | None = None) -> LabelTable:
    """A run's counterexamples as training data: moved labels with 3D boxes, cameras, sizes and names of the
    pictures. People and whatever else the scenes leave as it is keep their labels. "failure" is the grade of an
    object that the detector lost, in an extra column. frames: some of them, by default all. FormatError naming a
    file that is not as it should be.
    """
    names = frames_in(run) if frames is None else list(frames)
    if not names:
        raise FormatError(str(run / "frames"), f"frames with {RESULT}", "none")
    folders = [run / "frames" / name for name in names]
    table = table_of({name: str(folder / LABELS) for name, folder in zip(names, folders, strict=True)})
    table = _with_others(table, folders)
    results = [load_frame(folder / RESULT) for folder in folders]
    sizes = [size_of_image(folder / PICTURE) for folder in folders]
    failure: list[str | None] = [None] * len(table)
    for result, rows in zip(results, table.by_frame(), strict=True):
        for lost in (one for one in result.failures if one.kind == "lost"):
            near = [row for row in rows if np.abs(table.boxes[row] - lost.xyxy).max() < _SAME_PX]
            if near:
                failure[near[0]] = lost.grade or Grade.THRESHOLD
    return replace(
        table,
        sizes_wh=np.array(sizes, np.int64).reshape(-1, 2),
        extra={**table.extra, "failure": failure},
        cameras={i: camera_entry(load_camera(folder / "scene").matrix) for i, folder in enumerate(folders)},
        image_files={i: f"{name}/{PICTURE}" for i, name in enumerate(names)},
        told={i: told_of(run, result) for i, result in enumerate(results)},
    )


def _with_others(table: LabelTable, folders: Sequence[Path]) -> LabelTable:
    """The table with the labels of what scenes leave as it is. Label files of a run tell of it as regions, the
    last of each frame. FormatError where there are fewer.
    """
    found = [load_others(folder / "scene") for folder in folders]
    kinds = sorted({*table.kinds, *(kind for others in found if others is not None for kind in others.kind)})
    names = ("ignore", "truncation", "occlusion", "pose")
    columns = {name: getattr(table, name).copy() for name in names}
    kind = np.array([*map(kinds.index, table.kinds), REGION], np.int64)[table.kind]
    for folder, others, rows in zip(folders, found, table.by_frame(), strict=True):
        if others is None:
            continue
        count = len(others.kind)
        own = slice(rows.stop - count, rows.stop)
        if count > len(rows) or (table.kind[own] != REGION).any():
            raise FormatError(str(folder / LABELS), f"at its end {count} DontCare, as the scene has", "others")
        kind[own] = [kinds.index(name) for name in others.kind]
        columns["ignore"][own] = False
        columns["truncation"][own] = np.nan_to_num(shortest(others.truncation), nan=-1)
        columns["occlusion"][own] = others.occlusion.numpy()
        pose = torch.cat([others.size_lhw, others.translation, others.yaw[:, None]], dim=1)
        columns["pose"][own] = np.reshape(shortest(pose), (count, 7))
    return replace(table, kinds=tuple(kinds), kind=kind, **columns)


def told_of(run: Path, result: FrameResult) -> dict[str, Any]:
    """What a picture of a run is: the run and frame it is from, the surest grade of its failures, theta."""
    grades = [Grade(failure.grade or Grade.THRESHOLD) for failure in result.failures]
    return {
        "run": run.resolve().name,
        "frame": result.identifier,
        "failures": len(result.failures),
        "grade": max(grades, key=list(Grade).index, default=None),
        "feasible": result.feasible,
        "theta": {coordinate.name: coordinate.value for coordinate in result.theta},
    }
