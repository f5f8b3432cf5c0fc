"""Counterexamples of combination 2 before other detectors, beside the paper's figures for a YOLOv3."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from detectors.yolov3.yolov3 import YoloV3
from drivesem.analysis.transfer.asking import Asked, detector_names, detectors_of, pairs_of
from drivesem.analysis.transfer.matrix import (
    AP50,
    BROKEN,
    FRAMES,
    LOST,
    TRANSFER,
    PairCounts,
    TransferRow,
    row_of,
)
from drivesem.analysis.transfer.report import bounded
from drivesem.analysis.transfer.report import sheets as matrix_sheets
from drivesem.attack.targets import HEADLINE
from drivesem.config.blocks import DetectionOptions
from drivesem.config.commands import DEFAULT_COMBO, AttackConfig
from drivesem.evaluation.resampling import Interval, differences
from drivesem.report.paper import PAPER_BENIGN, PAPER_COMBOS, PAPER_TRANSFER
from drivesem.report.tables import ReportTable, format_count, format_percent
from drivesem.run.attack import Worker
from drivesem.run.finished import load_runs
from drivesem.run.folder import ARMS
from drivesem.run.protocol import follows_paper
from tools.experiments.detection.arms import AttackArm, bootstrap_draws
from tools.experiments.detection.report import OWN_PROTOCOL, StudyText
from tools.experiments.detection.rows import MODES
from tools.experiments.detection.running import AttackTotals, feasible_share, run_arms
from tools.experiments.settings import StudyConfig

_SIDES = ("source", "target")
_LABELS = "labels"
_WORDS = (*_SIDES, _LABELS)


@dataclass(frozen=True, slots=True)
class SourceTargetResult:
    """Counterexamples of one source before one target. placebo: what one random edit as large as the attack's does
    there, where controls are asked for; beyond: how far AP50 falls below it, by label mode, paired over frames;
    reference: the paper's mAP of such a pair, benign and attacked.
    """

    row: TransferRow
    placebo: TransferRow | None
    beyond: Mapping[str, Interval]
    reference: tuple[float, float] | None

    def to_row(self) -> dict[str, Any]:
        """Numbers by name, for CSV and JSON: fractions of 1, None where there is nothing to count."""
        there, attacked = self.reference or (None, None)
        found = self.row.flat() | {
            "recall_paper": self.row.paper.headline.recall,
            "recall_moved": self.row.moved.headline.recall,
            "reference": attacked,
            "reference_benign": there,
            "reference_drop": None if there is None or attacked is None else there - attacked,
        }
        if self.placebo is not None:
            theirs = self.placebo.flat()
            told = ("paper_ap50", "moved_ap50", "drop_paper", "drop_moved", "drop_moved_low", "drop_moved_high")
            found |= {f"placebo_{key}": theirs[key] for key in (*told, BROKEN)}
        for mode, one in self.beyond.items():
            key = f"over_placebo_{mode}"
            found |= {key: one.value, f"{key}_low": one.low, f"{key}_high": one.high}
        return found


@dataclass(frozen=True, slots=True)
class TransferSource:
    """An arm that is no control, by its name; placebo: of the arm beside it, None without; references: the paper's
    mAP of a pair with it by the target's name, benign and attacked.
    """

    name: str
    placebo: str | None
    references: dict[str, tuple[float, float]]


@dataclass(frozen=True, slots=True)
class TransferCounts:
    """What the tables are computed from. pairs: of each arm, controls too, and each target; failed: pictures that
    could not be used, and why.
    """

    attacks: AttackTotals
    sources: tuple[TransferSource, ...]
    pairs: Sequence[PairCounts]
    failed: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class TransferMatrix:
    """All that the study found."""

    study: StudyConfig
    draws: int
    counts: TransferCounts
    rows: Sequence[SourceTargetResult]

    @property
    def failed(self) -> dict[str, str]:
        """Frames and pictures that could not be used, and why."""
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


def load_targets(study: StudyConfig, out: Path) -> list[Asked]:
    """The sources, then the others that are to be asked. Raises UsageError for what is no detector."""
    named = detector_names(study.detectors)
    sources = detector_names(study.sources or study.detector, "--sources")
    return detectors_of(list(dict.fromkeys([*sources, *named])), _settings(study), out, study.t_star)


def run(
    study: StudyConfig, arms: Sequence[AttackArm], workers: Sequence[Worker], asked: Sequence[Asked], out: Path
) -> TransferCounts:
    """Attack, then ask. asked: as `detectors_asked` gives them. Raises UsageError or SceneError for bad input."""
    ran = run_arms(arms, workers, out)
    runs = load_runs([str(out / ARMS / arm.folder) for arm in arms])
    named = [replace(run, name=arm.name) for run, arm in zip(runs, arms, strict=True)]
    pairs, failed = pairs_of(named, asked, _settings(study))
    sources = []
    for arm in (arm for arm in arms if arm.control is None):
        placebo = next((one.name for one in arms if one.control_of == arm.name), None)
        references = {target.name: _reference(arm.config, target) for target in asked}
        told = {name: one for name, one in references.items() if one is not None}
        sources.append(TransferSource(arm.name, placebo, told))
    return TransferCounts(AttackTotals.from_arms(ran), tuple(sources), pairs, failed)


def build_matrix(study: StudyConfig, counts: TransferCounts) -> TransferMatrix:
    """What follows from it."""
    draws = bootstrap_draws(study)
    rows = {(one.source.name, one.target.name): row_of(one, draws, study.seed) for one in counts.pairs}
    found: list[SourceTargetResult] = []
    for source in counts.sources:
        for target in dict.fromkeys(name for _, name in rows):
            row = rows[source.name, target]
            placebo = None if source.placebo is None else rows[source.placebo, target]
            beyond = {}
            if placebo is not None:
                beyond = {mode: _beyond(row, placebo, mode, draws, study.seed) for mode in MODES}
            found.append(SourceTargetResult(row, placebo, beyond, source.references.get(target)))
    return TransferMatrix(study, draws, counts, found)


def _beyond(row: TransferRow, placebo: TransferRow, mode: str, draws: int, seed: int) -> Interval:
    after, theirs = (one.figures[mode][:1] for one in (row, placebo))
    (one,) = differences(after, theirs, row.frames, draws, np.random.default_rng(seed))
    return one.interval


def _settings(study: StudyConfig) -> DetectionOptions:
    return DetectionOptions(
        seed=study.seed,
        workers=study.workers,
        device=study.device,
        keep_going=study.keep_going,
    )


def _reference(attack: AttackConfig, target: Asked) -> tuple[float, float] | None:
    """The paper's mAP under its own protocol: of the SqueezeDet that was attacked, and of a whole YOLOv3."""
    if not follows_paper(attack):
        return None
    if target.order.detector == attack.detector:
        return PAPER_BENIGN, PAPER_COMBOS[DEFAULT_COMBO]
    return PAPER_TRANSFER if type(target.predictor) is YoloV3 else None


def transfer_text(found: TransferMatrix) -> StudyText:
    """The study as text."""
    sources = list(dict.fromkeys(one.row.source.name for one in found.rows))
    short = [_plain(sheet(found.rows), sources) for sheet in (_precision, _falls, _broken)]
    further = matrix_sheets([one.row for one in found.rows])[0]
    whole = [*short, replace(further, title=f"{HEADLINE}, further figures, %")]
    tables = {"study": [one.to_row() for one in found.rows]}
    return StudyText(found.study.name, whole, short, notes(found), tables, _WORDS, _SIDES)


def _plain(sheet: ReportTable, sources: Sequence[str]) -> ReportTable:
    """The source in the title where there is one only, instead of in each row."""
    if len(sources) > 1:
        return sheet
    title = f"{sheet.title}; counterexamples of {sources[0]}"
    return ReportTable(title, sheet.columns[1:], tuple(row[1:] for row in sheet.rows))


def _precision(rows: Sequence[SourceTargetResult]) -> ReportTable:
    lines, told = [], _has_references(rows)
    for one in rows:
        row, there = one.row, one.reference or (None, None)
        scores = (row.benign, row.rerendered, row.paper, row.moved)
        cells = (*_sides(row), *(format_percent(s.headline.ap50) for s in scores))
        lines.append((*cells, *map(format_percent, there)) if told else cells)
    columns = (*_SIDES, "benign", "re-rendered", *MODES, *(["benign there", "attacked there"] if told else []))
    return ReportTable(f"{HEADLINE} AP50, %", columns, tuple(lines))


def _falls(rows: Sequence[SourceTargetResult]) -> ReportTable:
    controlled = any(one.placebo is not None for one in rows)
    lines, told = [], _has_references(rows)
    for one in rows:
        there, attacked = one.reference or (None, None)
        fallen = None if there is None or attacked is None else there - attacked
        cells = [*_sides(one.row), *(bounded(_fall(one.row, mode)) for mode in MODES)]
        if controlled:
            cells.append("-" if one.placebo is None else bounded(_fall(one.placebo, "moved")))
            cells.append(bounded(one.beyond["moved"]) if one.beyond else "-")
        cells += ["-" if fallen is None else f"{100 * fallen:.1f}"] if told else []
        lines.append(tuple(cells))
    columns = [*_SIDES, *MODES, *(["placebo, moved", "attack less placebo"] if controlled else [])]
    columns += ["there"] if told else []
    return ReportTable(f"{HEADLINE} AP50 falls, points", tuple(columns), tuple(lines))


def _has_references(rows: Sequence[SourceTargetResult]) -> bool:
    return any(one.reference is not None for one in rows)


def _sides(row: TransferRow) -> tuple[str, str]:
    return row.source.name, row.target.name


def _fall(row: TransferRow, mode: str) -> Interval:
    return next(one for one in row.drops[mode] if one.name == AP50)


def _broken(rows: Sequence[SourceTargetResult]) -> ReportTable:
    lines = []
    for row in (one.row for one in rows):
        lost, shared, frames = (
            f"{row.counts[name][0]} of {row.counts[name][1]}" for name in (LOST, TRANSFER, FRAMES)
        )
        lines.append((*_sides(row), bounded(row.shares[BROKEN]), lost, str(row.phantoms), shared, frames))
    columns = (*_SIDES, "frames broken", "lost", "phantoms", "lost too", "frames too")
    return ReportTable("Frames broken, %, and what was lost or made up; moved labels", columns, tuple(lines))


def notes(found: TransferMatrix) -> list[str]:
    """What the columns mean."""
    spread = f" In brackets: 95 % of {found.draws} draws of frames, paired." if found.draws else ""
    stars = "; ".join(dict.fromkeys(f"{o.row.target.name} {o.row.target.t_star:.3f}" for o in found.rows))
    there = "{:.2f} to {:.2f}".format(*(100 * value for value in PAPER_TRANSFER))
    lines = [
        "Each source was attacked by combination 2; each target looked at the photographs, at the same rendered "
        "again without any change, and at the counterexamples.",
        f"Paper: by the benign labels, as in the paper; moved: by labels that moved with the cars.{spread}",
    ]
    if _has_references(found.rows):
        lines.append(
            "Ours, under the paper's protocol. There: in the paper, whose SqueezeDet fell from "
            f"{100 * PAPER_BENIGN:.1f} to {100 * PAPER_COMBOS[DEFAULT_COMBO]:.1f} on Virtual KITTI, and a YOLOv3, "
            f"trained on KITTI, from {there} before the same pictures."
        )
    else:
        lines.append(OWN_PROTOCOL)
    if any(one.placebo is not None for one in found.rows):
        lines.append(
            "Placebo: one random edit as large as the attack's, before the same target. What the attack takes "
            "beyond it is what transfers."
        )
    lines += [
        "Lost: of the objects that the target found in the photograph. Lost too: of those among them that the "
        "source lost. Frames too: of the frames that fail the source, those that fail the target. Counted from t* "
        f"on: {stars}.",
    ]
    attacks = found.counts.attacks
    lines.append(
        f"Feasible by the independent check: {format_percent(feasible_share(attacks))} % of all attacked frames."
    )
    if attacks.without_vehicles:
        lines.append(f"{format_count(attacks.without_vehicles, 'frame')} without vehicles passed over.")
    lines += [f"{name} could not be used: {reason}" for name, reason in found.failed.items()]
    return lines
