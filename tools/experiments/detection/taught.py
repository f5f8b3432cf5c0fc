"""What `drivesem study retrain` tells of its detectors, and what that is computed from."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drivesem.analysis.transfer.matrix import AP50, BROKEN, PairCounts, TransferRow, figures_of, row_of
from drivesem.attack.targets import HEADLINE
from drivesem.evaluation.coco import ClassScores
from drivesem.evaluation.matches import Matches
from drivesem.evaluation.resampling import Figure, Interval, differences, intervals
from tools.experiments.detection import lessons as plan
from tools.experiments.detection import robust
from tools.experiments.detection.arms import bootstrap_draws
from tools.experiments.detection.counts import ArmCounts
from tools.experiments.detection.lessons import BENIGN, RetrainingArm
from tools.experiments.detection.rows import MODES, ArmComparison, ArmMetrics, compare_arms
from tools.experiments.detection.running import AttackTotals, feasible_share
from tools.experiments.settings import StudyConfig


@dataclass(frozen=True, slots=True)
class BenignMatches:
    """A detector on benign frames: what it finds of HEADLINE, and the score from which its detections count."""

    matches: Matches
    t_star: float


@dataclass(frozen=True, slots=True)
class RetrainingCounts:
    """What the tables are computed from. attack: the name of that on frames to train on; learned, judged: attacks
    on these, and on held-out ones; shown: by lesson that was held, how many different counterexamples; benign:
    frames to train on beside them; left_out: arms that could not be trained, what could not be judged, and why.
    Of the detector as it was, then of each lesson: seen, by name, on held-out benign frames of the names
    `benign_frames`; known, the counterexamples against the first; fresh, those against it, of the first alone
    where no other was attacked. states: of held-out frames, before all detectors; none where that was not asked.
    """

    attack: str
    training_attacks: AttackTotals
    test_attacks: AttackTotals
    counterexamples: Mapping[str, int]
    benign_training_frames: int
    benign_frames: tuple[str, ...]
    benign_matches: Mapping[str, BenignMatches]
    known: Sequence[PairCounts]
    fresh: Sequence[ArmCounts]
    left_out: Mapping[str, str] = field(default_factory=dict[str, str])
    states: Sequence[robust.FrameStateCounts] = ()


@dataclass(frozen=True, slots=True)
class DetectorResult:
    """One detector. benign: HEADLINE's figures on held-out benign frames; spread: their AP50 with bounds; known:
    the counterexamples against the detector as it was; fresh: those against this one. drops: of AP50 and recall on
    benign frames, from the detector as it was; gains: of AP50 by label mode, on known and on fresh ones, over what
    the detector as it was has on its own. All paired over frames. fresh: None where there were no such attacks.
    """

    name: str
    reference: tuple[float, float] | None
    t_star: float
    benign_frames: int
    benign: ClassScores
    spread: dict[str, Interval]
    known: TransferRow
    fresh: ArmComparison | None
    drops: dict[str, Interval]
    gains: dict[str, dict[str, Interval]]

    def to_row(self) -> dict[str, Any]:
        """Numbers by name, for CSV and JSON: fractions of 1, None where there is nothing to count."""
        counterexamples, benign = self.reference or (None, None)
        theirs, fresh = (
            self.known.flat(),
            defaultdict[str, Any](lambda: None, self.fresh.to_row() if self.fresh else {}),
        )
        found: dict[str, Any] = {
            "name": self.name,
            "benign_ap50": self.benign.ap50,
            "paper_ap50": theirs["paper_ap50"],
            "moved_ap50": theirs["moved_ap50"],
            "drop_paper": theirs["drop_paper"],
            "drop_moved": theirs["drop_moved"],
            "recall_paper": theirs["paper_recall"],
            "recall_moved": theirs["moved_recall"],
            "reference": counterexamples,
            "reference_benign": benign,
            "t_star": self.t_star,
            "benign_frames": self.benign_frames,
            "benign_objects": self.benign.objects,
            "benign_recall": self.benign.recall,
            "frames": self.known.frames,
            "photographs_ap50": theirs["benign_ap50"],
            "broken_rate": theirs[BROKEN],
            "fresh_paper_ap50": fresh["paper_ap50"],
            "fresh_moved_ap50": fresh["moved_ap50"],
            "fresh_recall_moved": fresh["recall_moved"],
            "fresh_broken_rate": fresh["successes_moved"] / fresh["frames"] if fresh["frames"] else None,
            "feasible_fraction": fresh["feasible_fraction"],
        }
        bounded = {f"benign_{'' if key == AP50 else 'recall_'}drop": one for key, one in self.drops.items()}
        for name, gains in self.gains.items():
            prefix = "" if name == "known" else f"{name}_"
            bounded |= {f"{prefix}gain_{mode}": one for mode, one in gains.items()}
        for key, one in bounded.items():
            found |= {key: one.value, f"{key}_low": one.low, f"{key}_high": one.high}
        return found


@dataclass(frozen=True, slots=True)
class RetrainingResults:
    """All that the study found. lessons: those that were held; chances: how likely each arm fails a car."""

    study: StudyConfig
    draws: int
    counts: RetrainingCounts
    arms: Sequence[RetrainingArm]
    rows: Sequence[DetectorResult]
    robustness: Sequence[robust.RobustnessRow] = ()

    @property
    def attacks(self) -> tuple[AttackTotals, AttackTotals]:
        """On frames to train on, and on held-out ones."""
        return self.counts.training_attacks, self.counts.test_attacks

    def to_json(self) -> dict[str, Any]:
        """What `--json` prints."""
        learned, judged = self.attacks
        return {
            "study": self.study.name,
            "headline": HEADLINE,
            "frames": self.rows[0].known.frames,
            "benign_frames": self.rows[0].benign_frames,
            "frames_without_vehicles": learned.without_vehicles + judged.without_vehicles,
            "frames_failed": {**learned.failed, **judged.failed},
            "feasible_fraction": feasible_share(learned, judged),
            "bootstrap": self.draws,
            "attacked_to_train_on": learned.frames,
            "benign_to_train_on": self.counts.benign_training_frames,
            "training": {
                lesson.name: {"counterexamples": self.counts.counterexamples[lesson.name], **_training(lesson)}
                for lesson in self.arms
            },
            "rows": [row.to_row() for row in self.rows],
            "left_out": dict(self.counts.left_out),
            "state_frames": len(self.counts.states),
            "states": self.study.states,
            "robust": [row.to_row() for row in self.robustness],
        }


def _training(lesson: RetrainingArm) -> dict[str, Any]:
    told = ("seed", "steps", "batch", "window", "scale", "rate", "fraction", "mix", "loss", "precision")
    return {"pictures": lesson.pictures, "labels": lesson.labels, "weight": lesson.weight} | {
        key: getattr(lesson.config, key) for key in told
    }


def summarise_retraining(study: StudyConfig, counts: RetrainingCounts) -> RetrainingResults:
    """What follows from it."""
    draws = bootstrap_draws(study)
    lessons = [lesson for lesson in plan.build_retraining_arms(study) if lesson.name in counts.counterexamples]
    rows = _rows_of(study, lessons, counts, draws)
    return RetrainingResults(
        study, draws, counts, lessons, rows, _robust_rows(lessons, rows, counts, draws, study.seed)
    )


def _robust_rows(
    lessons: Sequence[RetrainingArm],
    rows: Sequence[DetectorResult],
    counts: RetrainingCounts,
    draws: int,
    seed: int,
) -> list[robust.RobustnessRow]:
    """How likely each arm fails a car: the detector as it was, then the lessons, their seeds together."""
    if not counts.states:
        return []
    arms = [(BENIGN, BENIGN), *((lesson.arm, lesson.name) for lesson in lessons)]
    falls: dict[str, list[float | None]] = {}
    for (arm, _), row in zip(arms, rows, strict=True):
        falls.setdefault(arm, []).append(row.drops[AP50].value)
    return robust.compare_robustness(counts.states, arms, falls, draws, seed)


def _rows_of(
    study: StudyConfig, lessons: Sequence[RetrainingArm], counts: RetrainingCounts, draws: int
) -> list[DetectorResult]:
    """A row for each detector."""
    fresh = compare_arms(counts.fresh, draws, study.seed)
    figures = [ArmMetrics.from_runs(one).after for one in counts.fresh]
    known = [row_of(pair, draws, study.seed) for pair in counts.known]
    benign = {name: figures_of(one.matches) for name, one in counts.benign_matches.items()}
    frames = len(counts.benign_frames)
    found = []
    for i, (name, one) in enumerate(counts.benign_matches.items()):
        gains = {
            "known": {
                m: _gain(known[0].figures[m], known[i].figures[m], known[i].frames, draws, study) for m in MODES
            },
        }
        again = i < len(figures)
        if again:
            attacked = counts.test_attacks.frames
            gains["fresh"] = {m: _gain(figures[0][m], figures[i][m], attacked, draws, study) for m in MODES}
        rng = np.random.default_rng(study.seed)
        fallen = differences(benign[name], benign[BENIGN], frames, draws, rng)
        spread = {
            "benign": _spread(benign[name], frames, draws, study),
            "known": _spread(known[i].figures["moved"], known[i].frames, draws, study),
        }
        if again:
            spread["fresh"] = _spread(figures[i]["moved"], counts.test_attacks.frames, draws, study)
        found.append(
            DetectorResult(
                name=name,
                reference=plan.paper_reference(name, lessons, study),
                t_star=one.t_star,
                benign_frames=frames,
                benign=one.matches.scores(one.t_star),
                spread=spread,
                known=known[i],
                fresh=fresh[i] if again else None,
                drops={d.name: d.interval for d in fallen},
                gains=gains,
            )
        )
    return found


def _gain(
    before: Sequence[Figure], after: Sequence[Figure], frames: int, draws: int, study: StudyConfig
) -> Interval:
    """How far the first figure, AP50, rises; paired over frames."""
    (one,) = differences(before[:1], after[:1], frames, draws, np.random.default_rng(study.seed))
    return one.interval


def _spread(figures: Sequence[Figure], frames: int, draws: int, study: StudyConfig) -> Interval:
    (one,) = intervals(figures[:1], frames, draws, np.random.default_rng(study.seed))
    return one
