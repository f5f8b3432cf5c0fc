"""Computes how a run's counterexamples transfer to a detector: scores, and shares of failures in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from detectors.types import CLASSES, Detections
from drivesem.attack.targets import HEADLINE, EvaluatedClasses
from drivesem.evaluation import coco, failures
from drivesem.evaluation.coco import IOU_50
from drivesem.evaluation.matched_class import ThresholdMatches
from drivesem.evaluation.resampling import (
    Interval,
    NamedMetric,
    WeightedAveragePrecision,
    WeightedRecall,
    bootstrap_intervals,
    paired_differences,
    ratio_metric,
)
from drivesem.failures.grades import Grade
from drivesem.run.frame import targets_from_records
from drivesem.run.results import FrameResult
from drivesem.run.summary import has_grade

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
        return row | {"lost": self.counts[LOST][0], "phantoms": self.phantoms}

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
        metrics=metrics,
    )


def headline_metrics(matches: ThresholdMatches) -> list[NamedMetric]:
    """Return AP50 and RECALL of one class, for bootstrap draws over frames."""
    class_matches = matches.class_matches(IOU_50)
    return [
        NamedMetric(AP50, (WeightedAveragePrecision(class_matches, "coco"),)),
        NamedMetric(RECALL, (WeightedRecall(class_matches),)),
    ]
