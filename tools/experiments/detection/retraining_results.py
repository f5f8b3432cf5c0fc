"""The metrics of the study `retrain`, and the counts that they are computed from."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drivesem.analysis.transfer import (
    AP50,
    BROKEN,
    TransferCounts,
    TransferRow,
    compute_transfer_row,
    headline_metrics,
)
from drivesem.attacks.targets import HEADLINE
from drivesem.evaluation.coco import ClassScores
from drivesem.evaluation.matched_class import ThresholdMatches
from drivesem.evaluation.resampling import Interval, NamedMetric, bootstrap_intervals, paired_differences
from tools.experiments.detection.arms import AttackTotals, bootstrap_draws, feasible_share
from tools.experiments.detection.comparison import MODES, ArmComparison, ArmMetrics, compare_arms
from tools.experiments.detection.counts import ArmCounts
from tools.experiments.detection.retraining_arms import (
    BENIGN,
    RetrainingArm,
    build_retraining_arms,
    paper_reference,
)
from tools.experiments.detection.robustness import FrameStateCounts, RobustnessRow, compare_robustness
from tools.experiments.settings import StudyConfig
from tools.experiments.tables import interval_columns


@dataclass(frozen=True, slots=True)
class BenignMatches:
    """A detector on benign frames."""

    matches: ThresholdMatches
    """Its detections of HEADLINE."""
    t_star: float
    """Score from which its detections count."""


@dataclass(frozen=True, slots=True)
class RetrainingCounts:
    """What the tables are computed from."""

    attack: str
    """Name of the attack on the training frames."""
    training_attacks: AttackTotals
    """Totals of the attacks on the training frames."""
    test_attacks: AttackTotals
    """Totals of the attacks on held-out frames."""
    counterexamples: Mapping[str, int]
    """Distinct counterexamples by arm that was trained."""
    benign_training_frames: int
    """Benign frames to train on."""
    benign_frames: tuple[str, ...]
    """Names of the held-out benign frames."""
    benign_matches: Mapping[str, BenignMatches]
    """Each detector on these, by name: the original one, then that of each arm."""
    known: Sequence[TransferCounts]
    """Each detector on counterexamples of the original one."""
    fresh: Sequence[ArmCounts]
    """Attacks on each detector, or on the original one alone without --reattack."""
    left_out: Mapping[str, str] = field(default_factory=dict[str, str])
    """What could not be trained or tested, and why."""
    states: Sequence[FrameStateCounts] = ()
    """All detectors in sampled states of held-out frames."""


@dataclass(frozen=True, slots=True)
class DetectorResult:
    """One detector; intervals paired over frames."""

    name: str
    """Name of the detector."""
    reference: tuple[float, float] | None
    """The paper's mAP on counterexamples and on benign frames."""
    t_star: float
    """Score from which its detections count."""
    benign_frames: int
    """Number of held-out benign frames."""
    benign: ClassScores
    """Metrics on these."""
    spread: dict[str, Interval]
    """AP50 on benign frames, on known and on fresh counterexamples."""
    known: TransferRow
    """Metrics on counterexamples of the original detector."""
    fresh: ArmComparison | None
    """Metrics under an attack on this detector."""
    drops: dict[str, Interval]
    """Drop of AP50 and recall on benign frames from the original detector."""
    gains: dict[str, dict[str, Interval]]
    """Gain of AP50 over the original detector by label mode, on known and on fresh counterexamples."""

    def to_row(self) -> dict[str, Any]:
        """Numbers by name, for CSV and JSON: fractions of 1, None where there is nothing to count."""
        counterexamples, benign = self.reference or (None, None)
        known = self.known.to_row()
        fresh = defaultdict[str, Any](lambda: None, self.fresh.to_row() if self.fresh else {})
        row: dict[str, Any] = {
            "name": self.name,
            "benign_ap50": self.benign.ap50,
            "paper_ap50": known["paper_ap50"],
            "moved_ap50": known["moved_ap50"],
            "drop_paper": known["drop_paper"],
            "drop_moved": known["drop_moved"],
            "recall_paper": known["paper_recall"],
            "recall_moved": known["moved_recall"],
            "reference": counterexamples,
            "reference_benign": benign,
            "t_star": self.t_star,
            "benign_frames": self.benign_frames,
            "benign_objects": self.benign.objects,
            "benign_recall": self.benign.recall,
            "frames": self.known.frames,
            "photographs_ap50": known["benign_ap50"],
            "broken_rate": known[BROKEN],
            "fresh_paper_ap50": fresh["paper_ap50"],
            "fresh_moved_ap50": fresh["moved_ap50"],
            "fresh_recall_moved": fresh["recall_moved"],
            "fresh_broken_rate": fresh["successes_moved"] / fresh["frames"] if fresh["frames"] else None,
            "feasible_fraction": fresh["feasible_fraction"],
        }
        for key, drop in self.drops.items():
            row |= interval_columns(f"benign_{'' if key == AP50 else 'recall_'}drop", drop)
        for name, gains in self.gains.items():
            for mode, gain in gains.items():
                row |= interval_columns(f"{'' if name == 'known' else f'{name}_'}gain_{mode}", gain)
        return row


@dataclass(frozen=True, slots=True)
class RetrainingResults:
    """The result of the study `retrain`."""

    study: StudyConfig
    """Settings of the study."""
    draws: int
    """Bootstrap draws of frames."""
    counts: RetrainingCounts
    """What it is computed from."""
    arms: Sequence[RetrainingArm]
    """The arms that were trained."""
    rows: Sequence[DetectorResult]
    """One row for each detector."""
    robustness: Sequence[RobustnessRow] = ()
    """How likely each arm misses a car."""

    def to_json(self) -> dict[str, Any]:
        """What `--json` prints."""
        counts = self.counts
        training, test = counts.training_attacks, counts.test_attacks
        return {
            "study": self.study.name,
            "headline": HEADLINE,
            "frames": self.rows[0].known.frames,
            "benign_frames": self.rows[0].benign_frames,
            "frames_without_vehicles": training.without_vehicles + test.without_vehicles,
            "frames_failed": {**training.failed, **test.failed},
            "feasible_fraction": feasible_share(training, test),
            "bootstrap": self.draws,
            "attacked_to_train_on": training.frames,
            "benign_to_train_on": counts.benign_training_frames,
            "training": {
                arm.name: {"counterexamples": counts.counterexamples[arm.name], **_training_settings(arm)}
                for arm in self.arms
            },
            "rows": [row.to_row() for row in self.rows],
            "left_out": dict(counts.left_out),
            "state_frames": len(counts.states),
            "states": self.study.states,
            "robust": [row.to_row() for row in self.robustness],
        }


def _training_settings(arm: RetrainingArm) -> dict[str, Any]:
    names = ("seed", "steps", "batch", "window", "scale", "rate", "fraction", "mix", "loss", "precision")
    settings = {key: getattr(arm.config, key) for key in names}
    return {"pictures": arm.pictures, "labels": arm.labels, "weight": arm.weight} | settings


def summarise_retraining(study: StudyConfig, counts: RetrainingCounts) -> RetrainingResults:
    """Compute the metrics of the study from its counts."""
    draws = bootstrap_draws(study)
    arms = [arm for arm in build_retraining_arms(study) if arm.name in counts.counterexamples]
    rows = _summarise_detectors(study, arms, counts, draws)
    robustness: list[RobustnessRow] = []
    if counts.states:
        named = [(BENIGN, BENIGN), *((arm.arm, arm.name) for arm in arms)]
        drops: dict[str, list[float | None]] = defaultdict(list)
        for (arm, _), row in zip(named, rows, strict=True):
            drops[arm].append(row.drops[AP50].value)
        robustness = compare_robustness(counts.states, named, drops, draws, study.seed)
    return RetrainingResults(study, draws, counts, arms, rows, robustness)


def _summarise_detectors(
    study: StudyConfig, arms: Sequence[RetrainingArm], counts: RetrainingCounts, draws: int
) -> list[DetectorResult]:
    fresh = compare_arms(counts.fresh, draws, study.seed)
    fresh_metrics = [ArmMetrics.from_runs(one).after for one in counts.fresh]
    known = [compute_transfer_row(pair, draws, study.seed) for pair in counts.known]
    benign = {name: headline_metrics(one.matches) for name, one in counts.benign_matches.items()}
    benign_frames, attacked_frames = len(counts.benign_frames), counts.test_attacks.frames

    def gain(before: Sequence[NamedMetric], after: Sequence[NamedMetric], frames: int) -> Interval:
        """Gain of the first metric, AP50, paired over frames."""
        rng = np.random.default_rng(study.seed)
        (difference,) = paired_differences(before[:1], after[:1], frames, draws, rng)
        return difference.interval

    def spread(metrics: Sequence[NamedMetric], frames: int) -> Interval:
        (interval,) = bootstrap_intervals(metrics[:1], frames, draws, np.random.default_rng(study.seed))
        return interval

    results = []
    for i, (name, one) in enumerate(counts.benign_matches.items()):
        own, first = known[i], known[0]
        gains = {"known": {m: gain(first.metrics[m], own.metrics[m], own.frames) for m in MODES}}
        spreads = {
            "benign": spread(benign[name], benign_frames),
            "known": spread(own.metrics["moved"], own.frames),
        }
        if i < len(fresh):
            gains["fresh"] = {m: gain(fresh_metrics[0][m], fresh_metrics[i][m], attacked_frames) for m in MODES}
            spreads["fresh"] = spread(fresh_metrics[i]["moved"], attacked_frames)
        rng = np.random.default_rng(study.seed)
        drops = paired_differences(benign[name], benign[BENIGN], benign_frames, draws, rng)
        results.append(
            DetectorResult(
                name=name,
                reference=paper_reference(name, arms, study),
                t_star=one.t_star,
                benign_frames=benign_frames,
                benign=one.matches.scores(one.t_star),
                spread=spreads,
                known=own,
                fresh=fresh[i] if i < len(fresh) else None,
                drops={drop.name: drop.interval for drop in drops},
                gains=gains,
            )
        )
    return results
