"""Tests counterexamples of runs on other detectors: scores and shares of failures in common, by run and detector."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from detectors.base import DetectorError, Predictor
from detectors.registry import SHIPPED
from detectors.types import CLASSES, Detections
from drivesem.attacks.targets import DEFAULT_T_STAR, HEADLINE, EvaluatedClasses, resolve_t_star
from drivesem.config.commands import TransferConfig
from drivesem.config.errors import UsageError
from drivesem.config.options import DetectionOptions
from drivesem.evaluation import coco, failures
from drivesem.evaluation.coco import IOU_50
from drivesem.evaluation.matched_class import ThresholdMatches
from drivesem.evaluation.resampling import (
    DRAWS,
    Interval,
    NamedMetric,
    WeightedAveragePrecision,
    WeightedRecall,
    bootstrap_intervals,
    paired_differences,
    ratio_metric,
)
from drivesem.failures.grades import Grade
from drivesem.reporting.plots import PLOT_STYLE, write_figure
from drivesem.reporting.tables import AnalysisReport, ReportTable, format_percent
from drivesem.run.detection_cache import DetectionCache, DetectorSpec, cache_detections
from drivesem.run.finished import PICTURES, AttackRun, RunFrame, load_runs
from drivesem.run.folder import claim_folder
from drivesem.run.frame import has_grade, targets_from_records
from drivesem.run.report.page import format_grade, name_failure
from drivesem.run.results import Failure, FrameResult

AP50, RECALL = "AP50", "recall"
EVALUATED_PICTURES = {"benign": "benign", "rerendered": "rerendered", "paper": "attacked", "moved": "attacked"}
"""Evaluations of a run (photographs, re-renders, counterexamples by either label mode), and their pictures in
`finished.PICTURES`."""


@dataclass(frozen=True, slots=True)
class SourceRun:
    """The run that made the counterexamples."""

    name: str
    """Name of the run."""
    detector: str
    """The attacked detector."""
    method: str
    """Search method."""
    params: str
    """Attacked parameters, separated by commas."""


@dataclass(frozen=True, slots=True)
class TransferTarget:
    """The detector that counterexamples are tested on."""

    name: str
    """Short name for people."""
    detector: str
    """The detector as given."""
    classes: tuple[str, ...]
    """Evaluated classes."""
    t_star: float
    """Score from which detections count."""


@dataclass(frozen=True, slots=True)
class LossTransfer:
    """An object that the source lost, before the target: in the run's own pictures, without draws."""

    failure: Failure
    """The failure, as the run graded it."""
    found: bool
    """Whether the target detects the object in the photograph."""
    lost: bool
    """Whether the target loses it, too."""

    @property
    def text(self) -> str:
        """What the target does."""
        if not self.found:
            return "never found it"
        return "loses it, too" if self.lost else "still finds it"


@dataclass(frozen=True, slots=True)
class FrameLosses:
    """Losses of one frame before a target, with moved labels."""

    identifier: str
    """The frame."""
    found: int
    """Objects that the target detects in the photograph."""
    lost: int
    """Those of them that the target loses."""
    source_lost: int
    """Those of `found` that the source lost."""
    both_lost: int
    """Those of `source_lost` that the target loses, too."""
    source_certain: int
    """Those of `found` that the source lost for certain."""
    both_certain: int
    """Those of `source_certain` that the target loses, too."""
    source_broken: bool
    """Whether the picture fails the source, by a lost object or a phantom."""
    broken: bool
    """Whether the picture fails the target."""
    phantoms: int
    """Phantoms of the target."""
    losses: tuple[LossTransfer, ...] = ()
    """Objects that the source lost."""


@dataclass(frozen=True, slots=True)
class TransferCounts:
    """Results of one target on one run, from which a row is computed."""

    source: SourceRun
    """The run."""
    target: TransferTarget
    """The detector."""
    frames: tuple[FrameLosses, ...]
    """Losses by frame."""
    pictures: Mapping[str, Mapping[str, ThresholdMatches]]
    """Matches over all frames, by the names of EVALUATED_PICTURES and by class."""

    @classmethod
    def from_detections(
        cls,
        source: SourceRun,
        target: TransferTarget,
        results: Sequence[FrameResult],
        detections: Mapping[str, Sequence[Detections]],
    ) -> TransferCounts:
        """Count losses and match detections.

        Args:
            source: The run.
            target: The detector.
            results: Results of the run's frames.
            detections: Detections by the names of PICTURES, one per result, labelled by evaluated class.
        """
        classes = EvaluatedClasses(target.classes, target.classes)
        benign = [classes.map_targets(targets_from_records(r.targets_benign, CLASSES)) for r in results]
        moved = [classes.map_targets(targets_from_records(r.targets_moved, CLASSES)) for r in results]
        truth = {name: moved if name == "moved" else benign for name in EVALUATED_PICTURES}
        frames = []
        is_certain = has_grade(Grade.CERTAIN)
        for i, result in enumerate(results):
            before, after = detections["benign"][i], detections["attacked"][i]
            failed = failures.find_failures(benign[i], before, moved[i], after, target.t_star)
            detected = failures.match_detections(benign[i], before, target.t_star).detected & ~moved[i].ignore
            found, lost = set(detected.nonzero()[:, 0].tolist()), set(failed.lost)
            losses = [f for f in result.failures if f.kind == "lost"]
            source_lost = found & {f.index for f in losses}
            source_certain = found & {f.index for f in losses if is_certain(f)}
            frames.append(
                FrameLosses(
                    identifier=result.identifier,
                    found=len(found),
                    lost=len(failed.lost),
                    source_lost=len(source_lost),
                    both_lost=len(source_lost & lost),
                    source_certain=len(source_certain),
                    both_certain=len(source_certain & lost),
                    source_broken=result.success_moved,
                    broken=failed.success,
                    phantoms=len(failed.phantoms),
                    losses=tuple(LossTransfer(f, f.index in found, f.index in lost) for f in losses),
                )
            )
        matches = {
            name: {
                label: ThresholdMatches.from_frames(truth[name], detections[picture], i)
                for i, label in enumerate(target.classes)
            }
            for name, picture in EVALUATED_PICTURES.items()
        }
        return cls(source, target, tuple(frames), matches)

    def scores(self, name: str) -> coco.CocoScores:
        """Compute the scores of an evaluation in EVALUATED_PICTURES."""
        classes = {label: matches.scores(self.target.t_star) for label, matches in self.pictures[name].items()}
        return coco.CocoScores.from_classes(classes, HEADLINE)

    def shares(self) -> dict[str, tuple[list[int], list[int]]]:
        """Return the numerators and denominators of each share, frame by frame."""
        rows = self.frames
        others = [f.source_lost - f.source_certain for f in rows]
        return {
            TRANSFER: ([f.both_lost for f in rows], [f.source_lost for f in rows]),
            CERTAIN: ([f.both_certain for f in rows], [f.source_certain for f in rows]),
            THRESHOLD: ([f.both_lost - f.both_certain for f in rows], others),
            LOST: ([f.lost for f in rows], [f.found for f in rows]),
            FRAMES: ([f.source_broken and f.broken for f in rows], [f.source_broken for f in rows]),
            BROKEN: ([f.broken for f in rows], [1] * len(rows)),
        }


@dataclass(frozen=True, slots=True)
class TransferRow:
    """Transfer of one run to one target."""

    source: SourceRun
    """The run."""
    target: TransferTarget
    """The detector."""
    frames: int
    """Number of frames."""
    benign: coco.CocoScores
    """Scores on the photographs."""
    rerendered: coco.CocoScores
    """Scores on the re-rendered photographs."""
    paper: coco.CocoScores
    """Scores on the counterexamples with benign labels."""
    moved: coco.CocoScores
    """Scores on the counterexamples with moved labels."""
    drops: dict[str, tuple[Interval, ...]]
    """Drop of the headline class's AP50 and recall from benign to attacked, by label mode."""
    shares: dict[str, Interval]
    """Shares by name, with bootstrap intervals over frames."""
    counts: dict[str, tuple[int, int]]
    """Numerator and denominator of each share."""
    phantoms: int
    """Phantoms with moved labels."""
    losses: tuple[tuple[str, LossTransfer], ...]
    """Objects that the source lost, each with its frame."""
    metrics: dict[str, list[NamedMetric]]
    """AP50 and RECALL of benign, paper and moved, for paired comparisons with other rows."""

    def to_row(self) -> dict[str, Any]:
        """Return a flat row for CSV and JSON: fractions, None if undefined."""
        row: dict[str, Any] = {
            "name": f"{self.source.name} -> {self.target.name}",
            "source": self.source.name,
            "source_detector": self.source.detector,
            "method": self.source.method,
            "params": self.source.params,
            "target": self.target.name,
            "target_detector": self.target.detector,
            "t_star": self.target.t_star,
            "frames": self.frames,
            "objects": self.benign.headline.objects,
        }
        for name in ("benign", "rerendered", "paper", "moved"):
            scores: coco.CocoScores = getattr(self, name)
            values = asdict(scores.headline) | {"map50": scores.overall.ap50, "map": scores.overall.ap}
            values.pop("objects")
            row |= {f"{name}_{key}": value for key, value in values.items()}
        for mode, pair in self.drops.items():
            for one in pair:
                key = f"{'drop' if one.name == AP50 else 'recall_drop'}_{mode}"
                row |= {key: one.value, f"{key}_low": one.low, f"{key}_high": one.high}
        for name, share in self.shares.items():
            row |= {name: share.value, f"{name}_low": share.low, f"{name}_high": share.high}
            row[f"{name}_of"] = self.counts[name][1]
        never_found = sum(not one.found for _, one in self.losses)
        return row | {"lost": self.counts[LOST][0], "phantoms": self.phantoms, "never_found": never_found}

    def failures_to_json(self) -> list[dict[str, Any]]:
        """Return an object per object that the source lost."""
        return [
            {
                "source": self.source.name,
                "target": self.target.name,
                "frame": frame,
                "object": one.failure.index,
                "kind": one.failure.error,
                "grade": one.failure.grade,
                "found": one.found,
                "lost": one.lost if one.found else None,
            }
            for frame, one in self.losses
        ]

    def to_json(self) -> dict[str, Any]:
        """Return the flat row with the scores of all classes."""
        attacked = {"paper": self.paper.to_json(), "moved": self.moved.to_json()}
        benign, rerendered = self.benign.to_json(), self.rerendered.to_json()
        return {**self.to_row(), "benign": benign, "rerendered": rerendered, "attacked": attacked}


TRANSFER, LOST, FRAMES, BROKEN = "transfer_rate", "lost_rate", "frame_rate", "broken_rate"
CERTAIN, THRESHOLD = "certain_rate", "threshold_rate"
"""Names of the shares, all with moved labels. Of the objects that the source lost and the target detected in the
photograph: those that the target loses, too (TRANSFER); the same for those that the source lost for certain (CERTAIN),
and by threshold only (THRESHOLD). Of the objects that the target detected in the photograph: those it loses (LOST). Of
the frames that fail the source: those that fail the target (FRAMES). Of all frames: those that fail the target
(BROKEN)."""


def compute_transfer_row(pair: TransferCounts, draws: int, seed: int) -> TransferRow:
    """Compute the row of a run and a target.

    Args:
        pair: Their results.
        draws: Bootstrap draws over frames.
        seed: Seed of the bootstrap.
    """
    rng, frames = np.random.default_rng(seed), len(pair.frames)
    metrics = {name: headline_metrics(pair.pictures[name][HEADLINE]) for name in ("benign", "paper", "moved")}
    drops = {
        mode: tuple(
            one.interval for one in paired_differences(metrics[mode], metrics["benign"], frames, draws, rng)
        )
        for mode in ("paper", "moved")
    }
    shares = pair.shares()
    rates = [
        ratio_metric(name, np.array(hits, np.float64), np.array(total, np.float64))
        for name, (hits, total) in shares.items()
    ]
    return TransferRow(
        source=pair.source,
        target=pair.target,
        frames=frames,
        benign=pair.scores("benign"),
        rerendered=pair.scores("rerendered"),
        paper=pair.scores("paper"),
        moved=pair.scores("moved"),
        drops=drops,
        shares={share.name: share for share in bootstrap_intervals(rates, frames, draws, rng)},
        counts={name: (sum(hits), sum(total)) for name, (hits, total) in shares.items()},
        phantoms=sum(frame.phantoms for frame in pair.frames),
        losses=tuple((frame.identifier, one) for frame in pair.frames for one in frame.losses),
        metrics=metrics,
    )


def headline_metrics(matches: ThresholdMatches) -> list[NamedMetric]:
    """Return AP50 and RECALL of one class, for bootstrap draws over frames."""
    class_matches = matches.class_matches(IOU_50)
    return [
        NamedMetric(AP50, (WeightedAveragePrecision(class_matches, "coco"),)),
        NamedMetric(RECALL, (WeightedRecall(class_matches),)),
    ]


DETECTIONS = "detections"
"""Folder of cached detections."""
_WRITTEN = ("transfer.json", "transfer.md", "transfer.csv", "transfer.png", DETECTIONS)


@dataclass(frozen=True, slots=True)
class TargetDetector:
    """A detector that counterexamples are tested on."""

    name: str
    """Short name for people."""
    spec: DetectorSpec
    """How to load it, and where to cache its detections."""
    predictor: Predictor
    """The loaded detector."""
    t_star: float | None = None
    """Score from which detections count; by default the detector's own, or else that of the settings."""


def split_list(text: str) -> list[str]:
    """Split "a, b" at commas, without empty parts."""
    return [part.strip() for part in text.split(",") if part.strip()]


def parse_detector_names(text: str, setting: str = "--detectors") -> list[str]:
    """Parse detectors such as "a,b,darknet:c.cfg,c.weights": a part after KIND:FILE that is not a detector by itself
    belongs to it.

    Raises UsageError, naming the setting, for none or repeated detectors.
    """
    names: list[str] = []
    for part in split_list(text):
        is_detector = ":" in part or part in SHIPPED or part.endswith(".safetensors")
        if names and ":" in names[-1] and not is_detector:
            names[-1] += f",{part}"
        else:
            names.append(part)
    if not names:
        raise UsageError(setting, "detectors with commas", repr(text))
    for name in names:
        if names.count(name) > 1:
            raise UsageError(setting, "each detector once", name)
    return names


def shorten_detector_names(names: Sequence[str]) -> list[str]:
    """Shorten detectors to the names of their files, with as many folders as make them unique."""

    def keep_folders(name: str, folders: int) -> str:
        return re.sub(r"[^,:]+", lambda part: "/".join(part[0].split("/")[-folders - 1 :]), name)

    short = []
    for name in names:
        depths = range(name.count("/") + 1)
        unique = (d for d in depths if [keep_folders(n, d) for n in names].count(keep_folders(name, d)) == 1)
        short.append(keep_folders(name, next(unique, depths[-1])))
    return short


def load_target_detectors(
    specs: Sequence[str], config: DetectionOptions, out: Path, t_star: float | None = None
) -> list[TargetDetector]:
    """Load all detectors, before the first picture, so that a misspelt name shows at once.

    Args:
        specs: The detectors.
        config: Device and tiles.
        out: Output folder, with the cache DETECTIONS.
        t_star: Score from which the detections of all of them count.

    Raises:
        UsageError: One is not a detector.
    """
    targets = []
    for name, spec in zip(shorten_detector_names(specs), specs, strict=True):
        detector_spec = DetectorSpec(spec, config.device, config.tiles, out / DETECTIONS)
        try:
            predictor = detector_spec.load()
            EvaluatedClasses.from_detector(predictor)
        except DetectorError as error:
            raise UsageError.from_detector_error("--detectors", "detectors", error) from error
        targets.append(TargetDetector(name, detector_spec, predictor, t_star))
    return targets


def run_transfer(config: TransferConfig) -> AnalysisReport:
    """Test the pictures of runs on detectors, and write the report. Raises UsageError or SceneError."""
    runs = load_runs(split_list(config.run or ""), config.limit)
    specs = parse_detector_names(config.detectors or "")
    out = Path(config.out) if config.out else runs[0].folder / "transfer"
    detectors = load_target_detectors(specs, config, out)
    # detections are cached by content, so any setting may change
    claim_folder(out, config, _WRITTEN, presentation=[field.name for field in fields(config)])
    pairs, failed = evaluate_pairs(runs, detectors, config)
    draws = DRAWS if config.bootstrap is None else config.bootstrap
    rows = [compute_transfer_row(pair, draws, config.seed) for pair in pairs]
    failures = [one for row in rows for one in row.failures_to_json()]
    data = {
        "rows": [r.to_json() for r in rows],
        "failures": failures,
        "headline": HEADLINE,
        "bootstrap": draws,
        "frames_failed": failed,
    }
    report = build_transfer_report(out, rows, draws, failed, data)
    report.write()
    return report


def evaluate_pairs(
    runs: Sequence[AttackRun], detectors: Sequence[TargetDetector], config: DetectionOptions
) -> tuple[list[TransferCounts], dict[str, str]]:
    """Evaluate each detector on each run.

    Args:
        runs: The runs.
        detectors: The detectors.
        config: Workers, t*, and whether to keep going.

    Returns:
        Counts per run and detector, and reasons by picture that could not be used.

    Raises:
        UsageError: No frame of a run can be used.
        SceneError: A picture is damaged, and `keep_going` is not set.
    """
    failed: dict[str, str] = {}
    pictures = [path for run in runs for frame in run.frames for path in frame.pictures.values()]
    for target in detectors:
        failed |= cache_detections(target.spec, target.predictor, pictures, config, target.name)
    pairs: list[TransferCounts] = []
    for run in runs:
        frames = [
            f for f in run.frames if f.result.attacked and not any(str(p) in failed for p in f.pictures.values())
        ]
        if not frames:
            raise UsageError("--run", "a run with frames that can be read", run.folder)
        pairs += [_evaluate_pair(run, target, frames, config) for target in detectors]
    return pairs, failed


def _evaluate_pair(
    run: AttackRun, detector: TargetDetector, frames: Sequence[RunFrame], config: DetectionOptions
) -> TransferCounts:
    cache = DetectionCache(detector.spec, detector.predictor)
    default_t_star = DEFAULT_T_STAR if config.t_star is None else config.t_star
    t_star = resolve_t_star(detector.predictor, detector.t_star, default_t_star)
    classes = EvaluatedClasses.from_detector(detector.predictor).names
    target = TransferTarget(detector.name, detector.spec.detector, classes, t_star)
    detections = {name: [cache.load(frame.pictures[name]) for frame in frames] for name in PICTURES}
    source = SourceRun(run.name, run.detector, run.method, run.params)
    with torch.no_grad():
        return TransferCounts.from_detections(source, target, [frame.result for frame in frames], detections)


_SHARES = {
    TRANSFER: "transfer rate",
    CERTAIN: "of certain",
    THRESHOLD: "of others",
    LOST: "all lost",
    FRAMES: "frames",
}
_SIDES = ("source", "target")
_MAX_LISTED = 40
"""Certain failures that the table lists; transfer.json has all."""
_TARGET = "the target"
"""Column of what a target does."""
_LABELS = "labels"
"""Column of the evaluation: photographs (benign), or counterexamples by label mode."""


def build_transfer_tables(rows: Sequence[TransferRow]) -> list[ReportTable]:
    """Build the tables of precision and recall, and of drops and shares that transfer, %."""
    scores_rows: list[tuple[str, ...]] = []
    share_rows: list[tuple[str, ...]] = []
    for row in rows:
        sides = (row.source.name, row.target.name)
        for name in ("benign", "paper", "moved"):
            scores = getattr(row, name)
            own = scores.headline
            values = (own.ap50, own.ap70, own.ap, scores.overall.ap50, own.recall, own.recall_at_t_star)
            scores_rows.append((*sides, name, *map(format_percent, values)))
        drop = {mode: next(one for one in row.drops[mode] if one.name == AP50) for mode in row.drops}
        counted = [f"{format_interval(row.shares[n])}\n{row.counts[n][0]} of {row.counts[n][1]}" for n in _SHARES]
        share_rows.append((*sides, format_interval(drop["paper"]), format_interval(drop["moved"]), *counted))
    score_columns = ("AP50", "AP70", "AP50:95", "mAP50", "recall", "recall at t*")
    drop_columns = ("AP50 drop, paper", "AP50 drop, moved")
    return [
        ReportTable(f"{HEADLINE}, %", (*_SIDES, _LABELS, *score_columns), tuple(scores_rows)),
        ReportTable("transfer, %", (*_SIDES, *drop_columns, *_SHARES.values()), tuple(share_rows)),
        _failure_table(rows),
    ]


def _failure_table(rows: Sequence[TransferRow]) -> ReportTable:
    """Build the table of the objects that sources lost for certain."""
    is_certain = has_grade(Grade.CERTAIN)
    lines = [
        (row.source.name, row.target.name, frame, name_failure(one.failure), format_grade(one.failure), one.text)
        for row in rows
        for frame, one in row.losses
        if is_certain(one.failure)
    ]
    listed = "" if len(lines) <= _MAX_LISTED else f", the first {_MAX_LISTED} of {len(lines)}"
    columns = (*_SIDES, "frame", "failure", "grade", _TARGET)
    return ReportTable(f"certain failures, each in its picture{listed}", columns, tuple(lines[:_MAX_LISTED]))


def build_transfer_notes(rows: Sequence[TransferRow], draws: int) -> list[str]:
    """Explain the columns. draws: bootstrap draws."""
    interval = f" In brackets: 95 % interval of {draws} bootstrap draws of frames." if draws else ""
    thresholds = "; ".join(dict.fromkeys(f"{r.target.name}: t* {r.target.t_star:.3f}" for r in rows))
    return [
        "Labels: benign stands for the photographs, paper and moved for the counterexamples by label mode.",
        f"mAP50: mean over the target's classes; AP50 drop: benign minus attacked.{interval}",
        "Transfer rate: of the objects that the source lost and the target detected in the photograph, those that "
        "the target loses, too; of certain, of others: the same for objects that the source lost for certain, and "
        "by threshold only. All lost: of all objects that the target detected in the photograph, those it loses. "
        "Frames: of those that fail the source, those that fail the target. All with moved labels.",
        "Never found: the target does not detect the object in the photograph, so its failures do not count. One "
        "picture decides here; the grade shared counts draws.",
        f"{thresholds}.",
    ]


def build_transfer_report(
    out: Path, rows: Sequence[TransferRow], draws: int, failed: Mapping[str, str], data: Mapping[str, Any]
) -> AnalysisReport:
    """Build the report.

    Args:
        out: Output folder.
        rows: A row per run and detector.
        draws: Bootstrap draws.
        failed: Reasons by picture that could not be used.
        data: Contents of the JSON.
    """
    scores, shares, losses = build_transfer_tables(rows)
    return AnalysisReport(
        out=out,
        name="transfer",
        heading="Transfer",
        data=data,
        csv_tables={"transfer": [row.to_row() for row in rows]},
        tables=[scores, replace(shares, rich_options={"show_lines": True}), *([losses] if losses.rows else [])],
        notes=build_transfer_notes(rows, draws),
        text_columns=(*_SIDES, _LABELS, "frame", "failure", "grade", _TARGET),
        picture=partial(write_heatmap, rows=rows),
        failed=failed,
    )


def format_interval(interval: Interval) -> str:
    """Format a fraction and its interval as percentages."""
    if interval.value is None or interval.low is None or interval.high is None:
        return format_percent(interval.value)
    return f"{100 * interval.value:.1f} [{100 * interval.low:.1f}, {100 * interval.high:.1f}]"


if TYPE_CHECKING:
    from matplotlib.axes import Axes

_CELL_IN = (1.5, 0.75)
_MARGIN_IN = (2.2, 1.9)
_DARK = 0.55
"""Position on the colour scale from which text is white."""
_MAX_LABEL = 24
"""Longest label of an axis, characters; longer names lose their beginning."""


def write_heatmap(path: Path, rows: Sequence[TransferRow]) -> None:
    """Plot a heatmap of the AP50 drop with moved labels, and of the share of failures that transfer, %."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    sources = list(dict.fromkeys(row.source.name for row in rows))
    targets = list(dict.fromkeys(row.target.name for row in rows))
    panels: list[tuple[str, Callable[[TransferRow], float | None]]] = [
        ("AP50 drop, moved labels, %", lambda row: row.to_row()["drop_moved"]),
        ("transferred failures, %", lambda row: row.shares[TRANSFER].value),
    ]
    width = _MARGIN_IN[0] + _CELL_IN[0] * len(targets)
    height = _MARGIN_IN[1] + _CELL_IN[1] * len(sources)
    style = {**PLOT_STYLE, "axes.grid": False}
    with mpl.rc_context(style):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=(len(panels) * width, height), layout="constrained")
        for place, (title, value) in enumerate(panels, start=1):
            axes = figure.add_subplot(1, len(panels), place)
            table = {(row.source.name, row.target.name): value(row) for row in rows}
            _plot_panel(axes, [[table[s, t] for t in targets] for s in sources])
            axes.set_title(title, loc="left", fontsize=11)
            axes.set_xticks(range(len(targets)), [_shorten(t) for t in targets], rotation=20, ha="right")
            axes.set_yticks(range(len(sources)), [_shorten(s) for s in sources])
            axes.set(xlabel="target", ylabel="source (run)")
    write_figure(path, figure)


def _plot_panel(axes: Axes, values: Sequence[Sequence[float | None]]) -> None:
    """Draw cells coloured from 0 to 1, with their values; negative values, where the attack helped, are white."""
    nothing = float("nan")
    axes.imshow(
        [[nothing if v is None else v for v in line] for line in values],
        cmap="Blues",
        vmin=0,
        vmax=1,
        aspect="auto",
    )
    for y, line in enumerate(values):
        for x, value in enumerate(line):
            text = "none" if value is None else f"{100 * value:.1f}"
            dark = value is not None and value > _DARK
            axes.text(x, y, text, ha="center", va="center", color="white" if dark else "black")
    for side in axes.spines.values():
        side.set_visible(False)
    axes.tick_params(length=0)


def _shorten(name: str) -> str:
    return name if len(name) <= _MAX_LABEL else f"...{name[3 - _MAX_LABEL :]}"
