"""Writes the metrics, the table and the page of a run on a classifier."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from drivesem.classify.methods import attacked_parameters
from drivesem.classify.pictures import ObjectView
from drivesem.classify.results import SCHEMA, ClassCounts, ClassifiedPicture, ClassifyMetrics
from drivesem.config.commands import ClassifyConfig
from drivesem.failures.grades import Grade
from drivesem.report import web
from drivesem.report.drawing import encode_jpeg_data_url
from drivesem.report.tables import format_percent, rows_to_csv
from drivesem.run.finished import METRICS
from drivesem.run.folder import FRAMES
from drivesem.run.frame import RESULT
from drivesem.run.records import load_record
from drivesem.run.run_report import PAGE
from scene_ir import files

CSV = "classified.csv"
WRITTEN = (FRAMES, METRICS, PAGE, CSV)
"""Files and folders that a run writes."""
SECOND_PICTURE = "second.png"
"""A second renderer's picture of a failure, in the folder of its frame."""
_ORDER: dict[str | None, int] = {Grade.CONFIRMED: 0, Grade.CERTAIN: 1, Grade.THRESHOLD: 2}


def load_picture_results(out: Path, views: Sequence[ObjectView]) -> list[ClassifiedPicture]:
    """Load the results of attacked pictures from a run's folder. Raises FormatError."""
    return [load_record(out / FRAMES / view.identifier / RESULT, ClassifiedPicture, SCHEMA) for view in views]


def write_run_report(
    config: ClassifyConfig,
    out: Path,
    classes: tuple[str, ...],
    views: Sequence[ObjectView],
    failed: Mapping[str, str],
    seconds: float,
) -> ClassifyMetrics:
    """Write metrics, CSV and page of a run.

    Args:
        config: Settings of the run.
        out: Its folder.
        classes: Names of all classes.
        views: Pictures that have results.
        failed: Reason by picture without a result.
        seconds: Time taken, s.

    Raises:
        FormatError: A damaged result, or a missing picture.
    """
    results = load_picture_results(out, views)
    metrics = ClassifyMetrics.from_results(
        results,
        classes,
        out=str(out),
        objects=config.objects or "embedded",
        network=config.network,
        method=config.method,
        params=tuple(map(str, attacked_parameters(config))),
        frames_failed=dict(sorted(failed.items())),
        seconds=round(seconds, 3),
    )
    files.write_json(out / METRICS, metrics.to_json())
    files.write_text(out / CSV, rows_to_csv([result.to_csv_row() for result in results]))
    _write_page(out, metrics, results)
    return metrics


def format_accuracy(counts: ClassCounts) -> list[str]:
    """Format accuracy before and after the change, %."""
    return [format_percent(one) for one in counts.accuracy.values()]


def _write_page(out: Path, metrics: ClassifyMetrics, results: Sequence[ClassifiedPicture]) -> None:
    worst_first = sorted(results, key=lambda r: (_ORDER.get(r.grade, 3), r.attacked.margin, r.identifier))
    before, after = format_accuracy(metrics.overall)
    page = web.render_page(
        "drivesem.classify:report.html",
        title=metrics.network,
        run=metrics,
        cards=[_build_card(result, out / FRAMES / result.identifier) for result in worst_first],
        before=before,
        after=after,
        rows=[(one, *format_accuracy(one)) for one in metrics.classes],
        rerendered=any(result.second is not None for result in results),
    )
    files.write_text(out / PAGE, page)


def _build_card(result: ClassifiedPicture, folder: Path) -> dict[str, Any]:
    """Collect a picture's result, its images by name, and a description of the change."""
    changes = [f"{name.rpartition('.')[2]} {value}" for name, value in result.moved.items()]
    if "vertex" in result.sizes:
        changes.append(f"vertices by up to {100 * result.sizes['vertex']:.1f} % of the size")
    images = {"before": "benign.png", "after": "counterexample.png"}
    if result.second is not None:
        images[result.second.agreement.by] = SECOND_PICTURE
    urls = [(name, encode_jpeg_data_url(files.read_image(folder / file))) for name, file in images.items()]
    return {"result": result, "images": urls, "changes": ", ".join(changes)}
