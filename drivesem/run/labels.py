"""Labels and detections in columns, of finished runs as of data sets: what `eval` and `convert` read."""

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
"""What of a run is looked at: detections after the attack with labels that moved or the benign ones, detections in
the re-rendered photograph, and in the photograph."""
RESULT, MANIFEST = "result.json", "manifest.json"


def frames_in(run: Path) -> list[str]:
    """Identifiers of a run's frames, sorted: of a finished one those of its manifest, else those in its folder,
    without what a killed command left there. Virtual KITTI's are folders in folders. Raises FormatError for a
    damaged manifest.
    """
    frames = run / "frames"
    found = (path.parent.relative_to(frames) for path in sorted(frames.rglob(RESULT)))
    names = [name.as_posix() for name in found if not any(part.startswith(".") for part in name.parts)]
    return sorted(names_in(run)) if names and (run / MANIFEST).is_file() else names


def names_in(run: Path) -> list[str]:
    """Identifiers of a finished run's frames. Raises FormatError for a damaged manifest."""
    manifest = files.read_json(run / MANIFEST)
    if not isinstance(manifest, dict) or not isinstance(manifest.get("frames"), dict):
        raise FormatError(f"{run / MANIFEST}: frames", "hashes by frame and file", "something else")
    for name in manifest["frames"]:
        files.below(run / "frames", name)
    return list(manifest["frames"])


def layout_of(path: Path) -> str:
    """ "run", or one of `layouts.LAYOUTS`, by what lies there. FormatError where it is none."""
    if frames_in(path):
        return "run"
    layout = layouts.layout_of(path)
    if layout is None:
        expected = f"labels as one of {', '.join((*layouts.LAYOUTS, 'run'))}"
        raise FormatError(str(path), expected, "no label file (an empty folder?)")
    return layout


def read(
    path: Path, layout: str, scored: bool = False, stage: str = STAGES[0], truth: LabelTable | None = None
) -> LabelTable:
    """The table of a path: see `layouts.read_table`. stage: of a run."""
    return _of_run(path, scored, stage) if layout == "run" else layouts.read_table(path, layout, scored, truth)


def _of_run(path: Path, scored: bool, stage: str) -> LabelTable:
    names = frames_in(path)
    if not names:
        raise FormatError(str(path / "frames"), f"frames with {RESULT}", "none")
    if stage not in STAGES:
        raise RangeError("stage", f"one of {', '.join(STAGES)}", stage)
    results = [load_frame(path / "frames" / name / RESULT) for name in names]
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
