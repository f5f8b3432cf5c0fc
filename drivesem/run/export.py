"""Counterexamples of a run as others take them: data sets with their origin, tables, and scenes in 3D."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from drivesem.config.errors import UsageError
from drivesem.data.label_table import Written, to_coco
from drivesem.failures.grades import Grade
from drivesem.report.tables import csv_text
from drivesem.run.conversion import Conversion, convert
from drivesem.run.finished import Run
from drivesem.run.results import Failure, FrameResult
from drivesem.run.training_data import told_of
from scene_ir import files

PROVENANCE = "provenance.json"
"""In the folder of an exported data set: what each picture is."""
DETECTIONS = "detections.json"
"""Beside COCO's annotations: what the attacked detector found, as COCO's results."""


def chosen(run: Run, grade: str) -> list[FrameResult]:
    """The frames with a failure of at least this grade, or "all". UsageError where there is none."""
    rising = list(Grade)

    def reaches(failure: Failure) -> bool:
        return rising.index(Grade(failure.grade or Grade.THRESHOLD)) >= rising.index(Grade(grade))

    results = [frame.result for frame in run.frames]
    found = [result for result in results if grade == "all" or any(map(reaches, result.failures))]
    if not found:
        expected = "frames that fail so surely (--grade all takes those that withstood, too)"
        raise UsageError(f"--grade {grade}", expected, f"none of {len(run.frames)}")
    return found


def export_dataset(
    run: Run, out: Path, layout: str, grade: str, mapping: Mapping[str, str | None] | None = None
) -> Written:
    """Write the counterexamples of a run as a data set: pictures, moved labels, and `PROVENANCE`. mapping: classes
    by name. Raises UsageError or FormatError for what cannot be.
    """
    results = chosen(run, grade)
    names = [result.identifier for result in results]
    how = Conversion(layout, "run", copy_images=True, mapping=mapping or {}, frames=names)
    written = convert(run.folder, out, how)
    frames = [
        {
            "number": i,
            **told_of(run.folder, result),
            "change": result.change,
            "failed": [failure.flat() for failure in result.failures],
        }
        for i, result in enumerate(results)
    ]
    about = {"run": run.name, "detector": run.detector, "method": run.method, "params": run.params.split(",")}
    files.write_json(out / PROVENANCE, {**about, "layout": layout, "labels": "moved", "frames": frames})
    count = written.files + 1
    if layout == "coco":
        _write_detections(out, results)
        count += 1
    return Written(count, written.lost, written.assumed)


def _write_detections(out: Path, results: Sequence[FrameResult]) -> None:
    """COCO's results of the exported pictures, by the ids of the annotations; classes that these do not have are
    left out.
    """
    told = files.read_json(out / "annotations" / "instances_all.json")
    categories = {row["name"]: row["id"] for row in told["categories"]}
    images = {row["drivesem"]["frame"]: row["id"] for row in told["images"]}
    rows = [
        {
            "image_id": images[result.identifier],
            "category_id": categories[box.label],
            "bbox": to_coco(_array(box.xyxy)).tolist(),
            "score": box.score,
        }
        for result in results
        for box in result.detections_attacked
        if box.label in categories
    ]
    files.write_json(out / DETECTIONS, rows)


def _array(values: Sequence[float]) -> Any:
    import numpy as np

    return np.array(values, np.float64)


@dataclass(frozen=True, slots=True)
class Tables:
    """Flat rows by the name of their table."""

    rows: Mapping[str, Sequence[Mapping[str, Any]]] = field(default_factory=dict)

    @classmethod
    def of(cls, run: Run, results: Sequence[FrameResult]) -> Tables:
        """frames: one a frame; failures: one a failure; theta: one a parameter; each names its frame."""
        names = {result.identifier for result in results}
        theta = [
            {"frame": result.identifier, **asdict(coordinate)} for result in results for coordinate in result.theta
        ]
        return cls(
            {
                "frames": [row for row in run.rows() if row["frame"] in names],
                "failures": [row for row in run.failure_rows() if row["frame"] in names],
                "theta": theta,
            }
        )

    def write(self, out: Path) -> list[str]:
        """Write each that has rows as CSV, and as Parquet where pyarrow is there; the names of the files."""
        written: list[str] = []
        for name, rows in self.rows.items():
            if not rows:
                continue
            files.write_text(out / f"{name}.csv", csv_text(rows))
            written.append(f"{name}.csv")
            if find_spec("pyarrow") is not None:
                files.write_bytes(out / f"{name}.parquet", _parquet(rows))
                written.append(f"{name}.parquet")
        return written


def _parquet(rows: Sequence[Mapping[str, Any]]) -> bytes:
    import pyarrow  # pyright: ignore[reportMissingImports]
    import pyarrow.parquet  # pyright: ignore[reportMissingImports]

    sink = pyarrow.BufferOutputStream()
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist([dict(row) for row in rows]), sink)
    return sink.getvalue().to_pybytes()
