"""Labels and detections in columns, of finished runs as of data sets: what `eval` and `convert` read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drivesem.data import registry
from drivesem.data.frames import size_of_image
from drivesem.data.kitti import table_of
from drivesem.data.label_table import LabelTable, camera_entry
from drivesem.run.results import BoxRecord, FrameResult, load_frame
from drivesem.truth.grades import Grade
from scene_ir.errors import FormatError, RangeError
from scene_ir.io import load_camera

STAGES = ("attacked", "attacked-paper", "rerendered", "benign")
"""What of a run is looked at: detections after the attack with labels that moved or the benign ones, detections in
the re-rendered photograph, and in the photograph."""
RESULT = "result.json"
PICTURE, LABELS = "counterexample.png", "labels_moved.txt"
"""What of a frame is trained on."""
_SAME_PX = 0.002
"""Label files have three decimals."""


def layout_of(path: Path) -> str:
    """ "run", or one of `registry.LAYOUTS`, by what lies there. FormatError where it is none."""
    if any((path / "frames").glob(f"*/{RESULT}")):
        return "run"
    layout = registry.layout_of(path)
    if layout is None:
        expected = f"labels as one of {', '.join((*registry.LAYOUTS, 'run'))}"
        raise FormatError(str(path), expected, "no label file (an empty folder?)")
    return layout


def read(
    path: Path, layout: str, scored: bool = False, stage: str = STAGES[0], truth: LabelTable | None = None
) -> LabelTable:
    """The table of a path: see `registry.read_table`. stage: of a run."""
    return _of_run(path, scored, stage) if layout == "run" else registry.read_table(path, layout, scored, truth)


def _of_run(path: Path, scored: bool, stage: str) -> LabelTable:
    paths = sorted((path / "frames").glob(f"*/{RESULT}"))
    if not paths:
        raise FormatError(str(path / "frames"), f"frames with {RESULT}", "none")
    if stage not in STAGES:
        raise RangeError("stage", f"one of {', '.join(STAGES)}", stage)
    results = [load_frame(file) for file in paths]
    records: list[tuple[int, BoxRecord]] = []
    for i, result in enumerate(results):
        if scored:
            of_stage = {"benign": result.detections_benign, "rerendered": result.detections_rerendered}
            chosen = of_stage.get(stage, result.detections_attacked)
        else:
            chosen = result.targets_moved if stage == "attacked" else result.targets_benign
        records += [(i, record) for record in chosen]
    kinds = sorted({record.label for _, record in records})
    return LabelTable.of(
        [result.identifier for result in results],
        kinds,
        [i for i, _ in records],
        [kinds.index(record.label) for _, record in records],
        np.array([record.xyxy for _, record in records], float).reshape(-1, 4),
        "xyxy",
        ignore=np.array([record.ignore for _, record in records], np.bool_),
        score=np.array([math.nan if r.score is None else r.score for _, r in records], float),
    )


def pictures(run: Path, frames: Sequence[str]) -> dict[str, Path]:
    """The counterexamples of a run, by frame, that are there."""
    found = {name: run / "frames" / name / PICTURE for name in frames}
    return {name: path for name, path in found.items() if path.is_file()}


def labels_of_run(run: Path, frames: Sequence[str] | None = None) -> LabelTable:
    """A run's counterexamples as training data: moved labels with 3D boxes, cameras, sizes and names of the
    pictures. "failure" is the grade of an object that the detector lost, in an extra column. frames: some of them,
    by default all. FormatError naming a file that is not as it should be.
    """
    names = sorted(p.parent.name for p in (run / "frames").glob(f"*/{RESULT}")) if frames is None else list(frames)
    if not names:
        raise FormatError(str(run / "frames"), f"frames with {RESULT}", "none")
    folders = [run / "frames" / name for name in names]
    table = table_of({name: folder / LABELS for name, folder in zip(names, folders, strict=True)})
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
