"""Exports counterexamples of a run as data sets with provenance, and as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from drivesem.config.errors import UsageError
from drivesem.data.label_table import WriteSummary, xyxy_to_coco
from drivesem.failures.grades import Grade
from drivesem.report.tables import rows_to_csv
from drivesem.run.conversion import ConversionSettings, convert_labels, provenance
from drivesem.run.finished import AttackRun
from drivesem.run.results import FrameResult
from drivesem.run.summary import has_grade
from scene_ir import files

PROVENANCE = "provenance.json"
"""File of an exported data set that describes each picture."""
DETECTIONS = "detections.json"
"""The attacked detector's detections as COCO results."""


def select_frames_by_grade(run: AttackRun, grade: str) -> list[FrameResult]:
    """Return the frames with a failure of at least this grade ("all": every frame). Raises UsageError for none."""
    results = [frame.result for frame in run.frames]
    selected = results if grade == "all" else [r for r in results if any(map(has_grade(Grade(grade)), r.failures))]
    if not selected:
        expected = "a failure of this grade (--grade all also takes frames without failures)"
        raise UsageError(f"--grade {grade}", expected, f"none of {len(run.frames)}")
    return selected


def export_dataset(
    run: AttackRun, out: Path, layout: str, grade: str, mapping: Mapping[str, str | None] | None = None
) -> WriteSummary:
    """Write the counterexamples of a run as a data set: pictures, moved labels, and `PROVENANCE`.

    Args:
        run: The run.
        out: Folder of the data set.
        layout: Label layout.
        grade: Lowest grade of a frame's failures, or "all".
        mapping: New names of classes; None drops a class.

    Raises:
        UsageError: No frame has the grade, or a class is unknown.
        FormatError: A file of the run is damaged.
    """
    results = select_frames_by_grade(run, grade)
    names = [result.identifier for result in results]
    settings = ConversionSettings(layout, "run", copy_images=True, mapping=mapping or {}, frames=names)
    written, _ = convert_labels(run.folder, out, settings)
    frames = [
        {
            "number": i,
            **provenance(run.folder, result),
            "change": result.change,
            "failed": [failure.to_row() for failure in result.failures],
        }
        for i, result in enumerate(results)
    ]
    about = {"run": run.name, "detector": run.detector, "method": run.method, "params": run.params.split(",")}
    files.write_json(out / PROVENANCE, {**about, "layout": layout, "labels": "moved", "frames": frames})
    count = written.files + 1
    if layout == "coco":
        _write_detections(out, results)
        count += 1
    return WriteSummary(count, written.lost, written.assumed)


def _write_detections(out: Path, results: Sequence[FrameResult]) -> None:
    """Write COCO results with the annotations' ids, without classes that the annotations lack."""
    annotations = files.read_json(out / "annotations" / "instances_all.json")
    categories = {row["name"]: row["id"] for row in annotations["categories"]}
    images = {row["drivesem"]["frame"]: row["id"] for row in annotations["images"]}
    rows = [
        {
            "image_id": images[result.identifier],
            "category_id": categories[box.label],
            "bbox": xyxy_to_coco(np.array(box.xyxy, np.float64)).tolist(),
            "score": box.score,
        }
        for result in results
        for box in result.detections_attacked
        if box.label in categories
    ]
    files.write_json(out / DETECTIONS, rows)


def build_tables(run: AttackRun, results: Sequence[FrameResult]) -> dict[str, list[dict[str, Any]]]:
    """Return flat rows by table: frames, failures, and theta (a row per coordinate). Each row names its frame."""
    names = {result.identifier for result in results}
    theta = [{"frame": result.identifier, **asdict(one)} for result in results for one in result.theta]
    return {
        "frames": [row for row in run.rows() if row["frame"] in names],
        "failures": [row for row in run.failure_rows() if row["frame"] in names],
        "theta": theta,
    }


def write_tables(tables: Mapping[str, Sequence[Mapping[str, Any]]], out: Path) -> list[str]:
    """Write each table that has rows as CSV, and as Parquet if pyarrow is installed. Returns the file names."""
    written: list[str] = []
    for name, rows in tables.items():
        if not rows:
            continue
        files.write_text(out / f"{name}.csv", rows_to_csv(rows))
        written.append(f"{name}.csv")
        if find_spec("pyarrow") is not None:
            files.write_bytes(out / f"{name}.parquet", _rows_to_parquet(rows))
            written.append(f"{name}.parquet")
    return written


def _rows_to_parquet(rows: Sequence[Mapping[str, Any]]) -> bytes:
    import pyarrow  # pyright: ignore[reportMissingImports]
    import pyarrow.parquet  # pyright: ignore[reportMissingImports]

    sink = pyarrow.BufferOutputStream()
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist([dict(row) for row in rows]), sink)
    return sink.getvalue().to_pybytes()
