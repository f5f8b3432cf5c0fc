"""Frames of a run, and the labels and detections of runs and data sets as tables."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from drivesem.data import layouts
from drivesem.data.label_table import LabelTable
from drivesem.run.results import BoxRecord, load_frame
from scene_ir import files
from scene_ir.errors import FormatError, RangeError

STAGES = ("attacked", "attacked-paper", "rerendered", "benign")
"""Stages of a run: after the attack, with moved or benign labels; the re-rendered photograph; the photograph."""
RESULT, MANIFEST = "result.json", "manifest.json"


def list_frames(run: Path) -> list[str]:
    """Return the identifiers of a run's frames, sorted.

    A finished run lists them in its manifest. Otherwise they are the folders with a result, except what a killed
    command left; Virtual KITTI's identifiers are nested folders. Raises FormatError for a damaged manifest.
    """
    frames = run / "frames"
    paths = (path.parent.relative_to(frames) for path in sorted(frames.rglob(RESULT)))
    names = [path.as_posix() for path in paths if not any(part.startswith(".") for part in path.parts)]
    return sorted(list_manifest_frames(run)) if names and (run / MANIFEST).is_file() else names


def list_manifest_frames(run: Path) -> list[str]:
    """Return the identifiers of the frames in a run's manifest. Raises FormatError for a damaged manifest."""
    manifest = files.read_json(run / MANIFEST)
    if not isinstance(manifest, dict) or not isinstance(manifest.get("frames"), dict):
        raise FormatError(f"{run / MANIFEST}: frames", "hashes by frame and file", "something else")
    for name in manifest["frames"]:
        files.resolve_inside(run / "frames", name)
    return list(manifest["frames"])


def detect_labels_layout(path: Path) -> str:
    """Return "run" or the `layouts.LAYOUTS` entry that a path holds. Raises FormatError if it holds neither."""
    if list_frames(path):
        return "run"
    layout = layouts.detect_layout(path)
    if layout is None:
        expected = f"labels as one of {', '.join((*layouts.LAYOUTS, 'run'))}"
        raise FormatError(str(path), expected, "no label file (an empty folder?)")
    return layout


def read_labels(
    path: Path,
    layout: str,
    scored: bool = False,
    stage: str = STAGES[0],
    truth: LabelTable | None = None,
    size_wh: tuple[int, int] | None = None,
) -> LabelTable:
    """Read the labels or detections at a path.

    Args:
        path: A run, or a file or folder as `layouts.read_table` takes it.
        layout: "run" or one of `layouts.LAYOUTS`.
        scored: Read detections instead of labels.
        stage: One of `STAGES`, for a run.
        truth: Labels that the detections belong to.
        size_wh: Size of all images, px, if known.
    """
    return (
        _read_run_table(path, scored, stage)
        if layout == "run"
        else layouts.read_table(path, layout, scored, truth, size_wh)
    )


def _read_run_table(path: Path, scored: bool, stage: str) -> LabelTable:
    names = list_frames(path)
    if not names:
        raise FormatError(str(path / "frames"), f"frames with {RESULT}", "none")
    if stage not in STAGES:
        raise RangeError("stage", f"one of {', '.join(STAGES)}", stage)
    results = [load_frame(path / "frames" / name / RESULT) for name in names]
    records: list[tuple[int, BoxRecord]] = []
    for i, result in enumerate(results):
        if scored:
            by_stage = {"benign": result.detections_benign, "rerendered": result.detections_rerendered}
            chosen = by_stage.get(stage, result.detections_attacked)
        else:
            chosen = result.targets_moved if stage == "attacked" else result.targets_benign
        records += [(i, record) for record in chosen]
    kinds = sorted({record.label for _, record in records})
    return LabelTable.from_columns(
        [result.identifier for result in results],
        kinds,
        [i for i, _ in records],
        [kinds.index(record.label) for _, record in records],
        np.array([record.xyxy for _, record in records], float).reshape(-1, 4),
        "xyxy",
        ignore=np.array([record.ignore for _, record in records], np.bool_),
        score=np.array([math.nan if r.score is None else r.score for _, r in records], float),
    )
