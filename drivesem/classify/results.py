"""Results of an attack on a classifier: a record per picture, the metrics of a run, its table and page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from drivesem.classify.objective import attacked_parameters
from drivesem.classify.pictures import ObjectView
from drivesem.config.commands import ClassifyConfig
from drivesem.failures.grades import Certificate, Grade, SecondOpinion
from drivesem.reporting import web
from drivesem.reporting.drawing import encode_jpeg_data_url
from drivesem.reporting.tables import format_percent, rows_to_csv
from drivesem.run.finished import METRICS
from drivesem.run.folder import FRAMES
from drivesem.run.labels import RESULT
from drivesem.run.records import load_record
from drivesem.run.run_report import PAGE
from scene_ir import files

SCHEMA = 2
TOP = 3
"""Highest k of the top-k accuracies."""


@dataclass(frozen=True, slots=True)
class ClassPrediction:
    """A network's prediction for one picture."""

    predicted: str
    """Predicted class."""
    confidence: float
    """Its softmax, in [0, 1]."""
    margin: float
    """Logit of the true class minus the highest other one."""
    rank: int
    """Rank of the true class, from 1."""


@dataclass(frozen=True, slots=True)
class RendererAgreement:
    """Agreement between two renderers on one object."""

    iou: float
    """IoU of the pixels covered by at least half, in [0, 1]."""
    colour: float
    """Mean CIE L*a*b* distance (Delta E 1976) over the pixels that both cover, at the network's size."""


@dataclass(frozen=True, slots=True)
class SecondRenderComparison:
    """Test of one failure with a second renderer."""

    agreement: SecondOpinion
    """Whether the failure persists in its pictures."""
    before: RendererAgreement
    """Agreement with the project's renderer on the unchanged object."""
    after: RendererAgreement
    """The same on the changed object."""


@dataclass(frozen=True, slots=True)
class ClassifiedPicture:
    """Result of one picture."""

    identifier: str
    """Name of the picture."""
    object: str
    """Name of the object."""
    label: str
    """True class."""
    view: str
    """View of the object."""
    benign: ClassPrediction
    """Prediction before the change."""
    attacked: ClassPrediction
    """Prediction after the change."""
    grade: str | None
    """Grade of the failure; None without one."""
    count: Certificate | None
    """Certificate of the failure; None without one."""
    sizes: dict[str, float]
    """Largest change of each parameter, in theta's units."""
    moved: dict[str, str]
    """Pose and light by name, formatted."""
    loss_trace: tuple[float, ...]
    """Loss after each step."""
    queries: int
    """Gradients and evaluated samples."""
    passes: int
    """Passes of the network; a gradient counts as 3."""
    seconds: float
    """Time taken, s."""
    second: SecondRenderComparison | None = None
    """Test with a second renderer; None without one."""

    @property
    def correct_before(self) -> bool:
        """Whether the prediction before the change is correct."""
        return self.benign.predicted == self.label

    @property
    def correct_after(self) -> bool:
        """Whether the prediction after the change is correct."""
        return self.attacked.predicted == self.label

    def to_csv_row(self) -> dict[str, Any]:
        """The picture's row of the CSV file."""
        data = asdict(self)
        count = self.count or Certificate()
        row = {key: data[key] for key in ("identifier", "object", "label", "view", "grade", "queries", "passes")}
        for name in ("benign", "attacked"):
            row |= {f"{name}_{key}": value for key, value in data[name].items()}
        row |= {"right_before": count.before, "draws_before": count.before_draws}
        row |= {"wrong_after": count.after, "draws_after": count.after_draws}
        row |= {"second": self.second.agreement.by if self.second else None}
        return row | {f"size_{key}": value for key, value in self.sizes.items()} | self.moved


@dataclass(frozen=True, slots=True)
class ClassCounts:
    """Counts of one class's pictures."""

    name: str
    """Name of the class."""
    pictures: int
    """All its pictures."""
    benign: int
    """Correct before the change."""
    attacked: int
    """Correct after it."""
    failures: int
    """Correct before the change and wrong after it."""
    certain: int
    """Failures of grade certain or above."""
    confirmed: int = 0
    """Failures of grade confirmed."""

    @property
    def accuracy(self) -> dict[str, float | None]:
        """Accuracy before and after the change, in [0, 1]; None without pictures."""
        counts = {"benign": self.benign, "attacked": self.attacked}
        return {name: count / self.pictures if self.pictures else None for name, count in counts.items()}


@dataclass(frozen=True, slots=True)
class ClassifyMetrics:
    """Metrics of a run; its accuracy counts every picture equally, as in the paper."""

    out: str
    """Folder of the run."""
    objects: str
    """Folder of the objects, or "embedded"."""
    network: str
    """The attacked network."""
    method: str
    """Search method."""
    params: tuple[str, ...]
    """Attacked parameters."""
    classes: tuple[ClassCounts, ...]
    """Counts by class."""
    top: dict[str, tuple[float, ...]]
    """Top-1 to top-3 accuracy in [0, 1], benign and attacked; empty without pictures."""
    confusion: dict[str, tuple[tuple[int, ...], ...]]
    """Pictures by true class (rows) and predicted class, benign and attacked."""
    frames_failed: dict[str, str]
    """Reason by picture without a result."""
    queries: int
    """Gradients and evaluated samples."""
    passes: int
    """Passes of the network."""
    seconds: float
    """Time taken, s."""

    @classmethod
    def from_results(
        cls, results: Sequence[ClassifiedPicture], classes: Sequence[str], **facts: Any
    ) -> ClassifyMetrics:
        """Count the results of pictures.

        Args:
            results: Results of pictures.
            classes: Names of all classes.
            facts: The fields that are not counted.
        """

        def count(name: str) -> ClassCounts:
            own = [result for result in results if result.label == name]
            benign = sum(result.correct_before for result in own)
            attacked = sum(result.correct_after for result in own)
            confirmed = sum(result.grade == Grade.CONFIRMED for result in own)
            certain = confirmed + sum(result.grade == Grade.CERTAIN for result in own)
            failures = sum(result.grade is not None for result in own)
            return ClassCounts(name, len(own), benign, attacked, failures, certain, confirmed)

        sides = {side: [getattr(result, side) for result in results] for side in ("benign", "attacked")}
        confusion = {
            side: Counter(zip((r.label for r in results), (one.predicted for one in predictions), strict=True))
            for side, predictions in sides.items()
        }
        return cls(
            classes=tuple(count(name) for name in classes),
            top={
                side: tuple(
                    round(sum(one.rank <= k for one in predictions) / len(predictions), 4)
                    for k in range(1, TOP + 1)
                    if predictions
                )
                for side, predictions in sides.items()
            },
            confusion={
                side: tuple(tuple(counts[true, predicted] for predicted in classes) for true in classes)
                for side, counts in confusion.items()
            },
            queries=sum(result.queries for result in results),
            passes=sum(result.passes for result in results),
            **facts,
        )

    @property
    def overall(self) -> ClassCounts:
        """Counts over all classes."""
        counts = ("pictures", "benign", "attacked", "failures", "certain", "confirmed")
        return ClassCounts("all", *(sum(getattr(one, name) for one in self.classes) for name in counts))

    @property
    def grades(self) -> dict[str, int]:
        """Number of failures of at least each grade."""
        overall = self.overall
        counts = (overall.failures, overall.certain, overall.confirmed)
        return dict(zip(map(str, (Grade.THRESHOLD, Grade.CERTAIN, Grade.CONFIRMED)), counts, strict=True))

    def to_json(self) -> dict[str, Any]:
        """The JSON object that `--json` prints."""
        overall = self.overall
        accuracy = {name: None if one is None else round(one, 4) for name, one in overall.accuracy.items()}
        data = {"schema": SCHEMA, **asdict(self), "pictures": overall.pictures}
        return data | {"accuracy": accuracy, "grades": self.grades}


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
