"""The study `transfer`: counterexamples of combination 2 on other detectors, with the paper's numbers for a YOLOv3."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from detectors.yolov3.yolov3 import YoloV3
from drivesem.analysis.transfer import (
    AP50,
    BROKEN,
    FRAMES,
    LOST,
    TRANSFER,
    TargetDetector,
    TransferCounts,
    TransferRow,
    build_transfer_tables,
    compute_transfer_row,
    evaluate_pairs,
    format_interval,
    load_target_detectors,
    parse_detector_names,
    write_heatmap,
)
from drivesem.attacks.targets import HEADLINE
from drivesem.config.commands import DEFAULT_COMBO, AttackConfig
from drivesem.config.options import DetectionOptions
from drivesem.evaluation.resampling import Interval, paired_differences
from drivesem.reporting.tables import AnalysisReport, ReportTable, format_percent
from drivesem.run.attack import AttackWorker
from drivesem.run.finished import load_runs
from drivesem.run.folder import ARMS
from drivesem.run.run_report import PAPER_BENIGN, PAPER_COMBOS, PAPER_TRANSFER, follows_paper
from tools.experiments.detection.arms import AttackArm, AttackTotals, bootstrap_draws, feasible_share, run_arms
from tools.experiments.detection.comparison import MODES
from tools.experiments.detection.report import (
    FEASIBLE,
    LABEL_MODES,
    OWN_PROTOCOL,
    build_study_report,
    describe_intervals,
    describe_skipped,
)
from tools.experiments.settings import StudyConfig
from tools.experiments.tables import interval_columns

_SIDES = ("source", "target")
_TEXT_COLUMNS = (*_SIDES, "labels")


@dataclass(frozen=True, slots=True)
class SourceTargetResult:
    """Counterexamples of one source tested on one target."""

    row: TransferRow
    """Metrics of the pair."""
    placebo: TransferRow | None
    """Metrics of random edits as large as the attack's, with --controls."""
    beyond: Mapping[str, Interval]
    """Drop of AP50 beyond the placebo's by label mode, paired over frames."""
    reference: tuple[float, float] | None
    """The paper's mAP of such a pair, benign and attacked."""

    def to_row(self) -> dict[str, Any]:
        """Numbers by name, for CSV and JSON: fractions of 1, None where there is nothing to count."""
        benign, attacked = self.reference or (None, None)
        row = self.row.to_row() | {
            "recall_paper": self.row.paper.headline.recall,
            "recall_moved": self.row.moved.headline.recall,
            "reference": attacked,
            "reference_benign": benign,
            "reference_drop": None if benign is None or attacked is None else benign - attacked,
        }
        if self.placebo is not None:
            placebo = self.placebo.to_row()
            names = ("paper_ap50", "moved_ap50", "drop_paper", "drop_moved", "drop_moved_low", "drop_moved_high")
            row |= {f"placebo_{key}": placebo[key] for key in (*names, BROKEN)}
        for mode, drop in self.beyond.items():
            row |= interval_columns(f"over_placebo_{mode}", drop)
        return row


@dataclass(frozen=True, slots=True)
class TransferSource:
    """An attacked detector."""

    name: str
    """Name of its arm."""
    placebo: str | None
    """Name of the arm's placebo."""
    references: dict[str, tuple[float, float]]
    """The paper's mAP by target, benign and attacked."""


@dataclass(frozen=True, slots=True)
class TransferStudyCounts:
    """What the tables are computed from."""

    attacks: AttackTotals
    """Totals of the attacks."""
    sources: tuple[TransferSource, ...]
    """The attacked detectors."""
    pairs: Sequence[TransferCounts]
    """Counts of each arm, controls included, on each target."""
    failed: Mapping[str, str]
    """Reason by picture that could not be used."""


@dataclass(frozen=True, slots=True)
class TransferMatrix:
    """The result of the study `transfer`."""

    study: StudyConfig
    """Settings of the study."""
    draws: int
    """Bootstrap draws of frames."""
    counts: TransferStudyCounts
    """What it is computed from."""
    rows: Sequence[SourceTargetResult]
    """One row for each source and target."""

    @property
    def failed(self) -> dict[str, str]:
        """Reason by frame or picture that could not be used."""
        return {**self.counts.attacks.failed, **self.counts.failed}

    def to_json(self) -> dict[str, Any]:
        """What `--json` prints."""
        return {
            "study": self.study.name,
            "headline": HEADLINE,
            "frames": self.rows[0].row.frames,
            "frames_without_vehicles": self.counts.attacks.without_vehicles,
            "frames_failed": self.failed,
            "feasible_fraction": feasible_share(self.counts.attacks),
            "bootstrap": self.draws,
            "rows": [one.to_row() for one in self.rows],
        }


def load_targets(study: StudyConfig, out: Path) -> list[TargetDetector]:
    """Load the sources, then the other detectors to test on. Raises UsageError for what is no detector."""
    others = parse_detector_names(study.detectors)
    names = dict.fromkeys([*parse_detector_names(study.sources or study.detector, "--sources"), *others])
    return load_target_detectors(list(names), detection_settings(study), out, study.t_star)


def run_transfer(
    study: StudyConfig,
    arms: Sequence[AttackArm],
    workers: Sequence[AttackWorker],
    targets: Sequence[TargetDetector],
    out: Path,
) -> TransferStudyCounts:
    """Run or continue the attacks, then test their pictures on the targets.

    Args:
        study: Settings of the study.
        arms: The attacks and their controls.
        workers: One worker for each arm.
        targets: Detectors, from `load_targets`.
        out: Folder of the study.

    Raises:
        UsageError: Settings that do not fit a run that is there.
        SceneError: A frame that cannot be used, without --keep-going.
    """
    attacks = AttackTotals.from_arms(run_arms(arms, workers, out))
    loaded = load_runs([str(out / ARMS / arm.folder) for arm in arms])
    runs = [replace(run, name=arm.name) for run, arm in zip(loaded, arms, strict=True)]
    pairs, failed = evaluate_pairs(runs, targets, detection_settings(study))
    sources = []
    for arm in (arm for arm in arms if arm.control is None):
        placebo = next((one.name for one in arms if one.control_of == arm.name), None)
        references = {target.name: _paper_reference(arm.config, target) for target in targets}
        known = {name: one for name, one in references.items() if one is not None}
        sources.append(TransferSource(arm.name, placebo, known))
    return TransferStudyCounts(attacks, tuple(sources), pairs, failed)


def build_matrix(study: StudyConfig, counts: TransferStudyCounts) -> TransferMatrix:
    """Compute the metrics of the study from its counts."""
    draws = bootstrap_draws(study)
    rows = {
        (one.source.name, one.target.name): compute_transfer_row(one, draws, study.seed) for one in counts.pairs
    }
    results: list[SourceTargetResult] = []
    for source in counts.sources:
        for target in dict.fromkeys(name for _, name in rows):
            row = rows[source.name, target]
            placebo = None if source.placebo is None else rows[source.placebo, target]
            beyond = {}
            if placebo is not None:
                beyond = {mode: _drop_beyond(row, placebo, mode, draws, study.seed) for mode in MODES}
            results.append(SourceTargetResult(row, placebo, beyond, source.references.get(target)))
    return TransferMatrix(study, draws, counts, results)


def _drop_beyond(row: TransferRow, placebo: TransferRow, mode: str, draws: int, seed: int) -> Interval:
    own, other = (one.metrics[mode][:1] for one in (row, placebo))
    (difference,) = paired_differences(own, other, row.frames, draws, np.random.default_rng(seed))
    return difference.interval


def detection_settings(study: StudyConfig) -> DetectionOptions:
    """The settings with which detectors of a study are run."""
    return DetectionOptions(
        seed=study.seed, workers=study.workers, device=study.device, keep_going=study.keep_going
    )


def _paper_reference(attack: AttackConfig, target: TargetDetector) -> tuple[float, float] | None:
    """The paper's mAP under its own protocol: of the attacked SqueezeDet, and of a full YOLOv3."""
    if not follows_paper(attack):
        return None
    if target.spec.detector == attack.detector:
        return PAPER_BENIGN, PAPER_COMBOS[DEFAULT_COMBO]
    return PAPER_TRANSFER if type(target.predictor) is YoloV3 else None


def transfer_report(matrix: TransferMatrix, out: Path) -> AnalysisReport:
    """The report of the study `transfer`."""
    sources = list(dict.fromkeys(one.row.source.name for one in matrix.rows))
    tables = [table(matrix.rows) for table in (_precision_table, _drop_table, _broken_table)]
    tables = [_move_source_to_title(table, sources) for table in tables]
    rows = [one.row for one in matrix.rows]
    further = replace(build_transfer_tables(rows)[0], title=f"{HEADLINE}, further metrics, %")
    return build_study_report(
        matrix.study,
        out,
        matrix.to_json(),
        {"study": [one.to_row() for one in matrix.rows]},
        [*tables, further],
        [replace(table, rich_options={"unbroken": _SIDES}) for table in tables],
        notes=_build_notes(matrix),
        text_columns=_TEXT_COLUMNS,
        picture=partial(write_heatmap, rows=rows),
    )


def _move_source_to_title(table: ReportTable, sources: Sequence[str]) -> ReportTable:
    """The source in the title if there is only one, instead of in each row."""
    if len(sources) > 1:
        return table
    rows = tuple(row[1:] for row in table.rows)
    return ReportTable(f"{table.title}; counterexamples of {sources[0]}", table.columns[1:], rows)


def _precision_table(rows: Sequence[SourceTargetResult]) -> ReportTable:
    lines, with_paper = [], _has_references(rows)
    for one in rows:
        row = one.row
        scores = (row.benign, row.rerendered, row.paper, row.moved)
        cells = (row.source.name, row.target.name, *(format_percent(s.headline.ap50) for s in scores))
        paper = map(format_percent, one.reference or (None, None))
        lines.append((*cells, *paper) if with_paper else cells)
    further = ("paper's mAP, benign", "attacked") if with_paper else ()
    columns = (*_SIDES, "benign", "re-rendered", *MODES, *further)
    return ReportTable(f"{HEADLINE} AP50, %", columns, tuple(lines))


def _drop_table(rows: Sequence[SourceTargetResult]) -> ReportTable:
    controlled, with_paper = any(one.placebo is not None for one in rows), _has_references(rows)
    lines = []
    for one in rows:
        benign, attacked = one.reference or (None, None)
        drops = (format_interval(_ap50_drop(one.row, mode)) for mode in MODES)
        cells = [one.row.source.name, one.row.target.name, *drops]
        if controlled:
            cells.append("-" if one.placebo is None else format_interval(_ap50_drop(one.placebo, "moved")))
            cells.append(format_interval(one.beyond["moved"]) if one.beyond else "-")
        if with_paper:
            cells.append("-" if benign is None or attacked is None else f"{100 * (benign - attacked):.1f}")
        lines.append(tuple(cells))
    columns = [*_SIDES, *MODES, *(["placebo, moved", "attack less placebo"] if controlled else [])]
    columns += ["paper"] if with_paper else []
    return ReportTable(f"Drop of {HEADLINE} AP50, points", tuple(columns), tuple(lines))


def _has_references(rows: Sequence[SourceTargetResult]) -> bool:
    return any(one.reference is not None for one in rows)


def _ap50_drop(row: TransferRow, mode: str) -> Interval:
    return next(drop for drop in row.drops[mode] if drop.name == AP50)


def _broken_table(rows: Sequence[SourceTargetResult]) -> ReportTable:
    lines = []
    for row in (one.row for one in rows):
        counts = (f"{row.counts[name][0]} of {row.counts[name][1]}" for name in (LOST, TRANSFER, FRAMES))
        lost, shared, frames = counts
        sides = (row.source.name, row.target.name)
        lines.append((*sides, format_interval(row.shares[BROKEN]), lost, str(row.phantoms), shared, frames))
    columns = (*_SIDES, "frames broken", "lost", "phantoms", "lost too", "frames too")
    return ReportTable("Frames broken, %, lost objects and phantoms; moved labels", columns, tuple(lines))


def _build_notes(matrix: TransferMatrix) -> list[str]:
    thresholds = dict.fromkeys(f"{one.row.target.name} {one.row.target.t_star:.3f}" for one in matrix.rows)
    benign, attacked = (f"{100 * value:.2f}" for value in PAPER_TRANSFER)
    notes = [
        "Each source was attacked by combination 2; each target was tested on the photographs, on the same frames "
        "re-rendered without a change, and on the counterexamples.",
        f"{LABEL_MODES}{describe_intervals(matrix.draws)}",
    ]
    if _has_references(matrix.rows):
        notes.append(
            "Ours, under the paper's protocol. The paper's SqueezeDet dropped from "
            f"{100 * PAPER_BENIGN:.1f} to {100 * PAPER_COMBOS[DEFAULT_COMBO]:.1f} on Virtual KITTI, and a YOLOv3, "
            f"trained on KITTI, from {benign} to {attacked} on the same pictures."
        )
    else:
        notes.append(OWN_PROTOCOL)
    if any(one.placebo is not None for one in matrix.rows):
        notes.append(
            "Placebo: one random edit as large as the attack's, on the same target. What the attack causes beyond "
            "it is what transfers."
        )
    notes.append(
        "Lost: of the objects that the target found in the photograph. Lost too: of those that the source lost "
        "among them. Frames too: of the frames that fail the source, those that fail the target. Counted from t*: "
        f"{'; '.join(thresholds)}."
    )
    attacks = matrix.counts.attacks
    notes.append(FEASIBLE.format(format_percent(feasible_share(attacks))))
    notes += describe_skipped(attacks.without_vehicles, {})
    return notes + [f"{name} could not be used: {reason}" for name, reason in matrix.failed.items()]
