"""The figures of one run before one detector: benign and attacked, and what of the source's failures it shares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from detectors.types import CLASSES, Detections, Targets
from drivesem.attack.judging import HEADLINE, JudgedClasses
from drivesem.evaluation import coco, failures
from drivesem.evaluation.curves import Tally
from drivesem.evaluation.outcome import OVERLAP, Outcome
from drivesem.evaluation.resampling import Averaged, Difference, Figure, Interval, Recalled, differences, intervals
from drivesem.run.finished import Run
from drivesem.run.frame import as_targets
from drivesem.run.results import FrameResult
from drivesem.run.tally import at_least
from drivesem.truth.grades import Grade

AP50, RECALL = "AP50", "recall"


@dataclass(frozen=True, slots=True)
class Target:
    """A detector that is asked: its name for people, as it was given, its judged classes, its threshold."""

    name: str
    detector: str
    judged: JudgedClasses
    t_star: float


@dataclass(frozen=True, slots=True)
class TransferRow:
    """One run before one target. benign, rerendered, paper, moved: figures in the photographs, in these rendered
    again, and in the counterexamples by either label mode. drops: by how much HEADLINE's AP50 and recall fall from
    benign to attacked, by label mode. shares: TRANSFER, CERTAIN, THRESHOLD, LOST, FRAMES, BROKEN; counts: their
    numerators and denominators; phantoms: by moved labels. figures: AP50 and RECALL in the photographs (benign)
    and in the counterexamples by label mode, to be weighed by frames beside another row's.
    """

    run: Run
    target: Target
    frames: int
    benign: coco.Scores
    rerendered: coco.Scores
    paper: coco.Scores
    moved: coco.Scores
    drops: dict[str, tuple[Interval, ...]]
    shares: dict[str, Interval]
    counts: dict[str, tuple[int, int]]
    phantoms: int
    figures: dict[str, list[Figure]]

    def flat(self) -> dict[str, Any]:
        """Numbers by name, for CSV and JSON: fractions of 1, None where there is nothing to count."""
        found: dict[str, Any] = {
            "name": f"{self.run.name} -> {self.target.name}",
            "source": self.run.name,
            "source_detector": self.run.detector,
            "method": self.run.method,
            "params": self.run.params,
            "target": self.target.name,
            "target_detector": self.target.detector,
            "t_star": self.target.t_star,
            "frames": self.frames,
            "objects": self.benign.headline.objects,
        }
        for name in ("benign", "rerendered", "paper", "moved"):
            scores: coco.Scores = getattr(self, name)
            figures = asdict(scores.headline) | {"map50": scores.overall.ap50, "map": scores.overall.ap}
            figures.pop("objects")
            found |= {f"{name}_{key}": value for key, value in figures.items()}
        for mode, pair in self.drops.items():
            for one in pair:
                key = f"{'drop' if one.name == AP50 else 'recall_drop'}_{mode}"
                found |= {key: one.value, f"{key}_low": one.low, f"{key}_high": one.high}
        for name, share in self.shares.items():
            found |= {name: share.value, f"{name}_low": share.low, f"{name}_high": share.high}
            found[f"{name}_of"] = self.counts[name][1]
        return found | {"lost": self.counts[LOST][0], "phantoms": self.phantoms}

    def to_json(self) -> dict[str, Any]:
        """The flat numbers, and all classes' figures."""
        attacked = {"paper": self.paper.to_json(), "moved": self.moved.to_json()}
        benign, rerendered = self.benign.to_json(), self.rerendered.to_json()
        return {**self.flat(), "benign": benign, "rerendered": rerendered, "attacked": attacked}


TRANSFER, LOST, FRAMES, BROKEN = "transfer_rate", "lost_rate", "frame_rate", "broken_rate"
CERTAIN, THRESHOLD = "certain_rate", "threshold_rate"
"""Of the objects that the source lost and the target found in the photograph: those that the target loses too
(TRANSFER), the same of those that the source lost for certain, and of those it lost by threshold alone. Of all
that the target found in the photograph: those it loses. Of the frames that fail the source: those that fail the
target, by a lost object or a phantom. Of all frames: those that fail the target. All by `moved` labels."""


def row(
    run: Run,
    target: Target,
    results: Sequence[FrameResult],
    found: dict[str, list[Detections]],
    draws: int,
    seed: int,
) -> TransferRow:
    """The figures of the run's frames. found: detections in the pictures of PICTURES, one for each result, with
    labels among the judged classes; draws: of the bootstrap over frames.
    """
    judged, names = target.judged, target.judged.names
    truth = {
        "benign": [judged.targets(as_targets(r.targets_benign, CLASSES)) for r in results],
        "moved": [judged.targets(as_targets(r.targets_moved, CLASSES)) for r in results],
    }
    truth["paper"] = truth["benign"]

    def scores(labels: str, pictures: str) -> coco.Scores:
        return coco.evaluate(truth[labels], found[pictures], names, target.t_star, HEADLINE)

    rng = np.random.default_rng(seed)
    label = names.index(HEADLINE)
    figures = {
        name: figures_of(truth[name], found[pictures], label)
        for name, pictures in (("benign", "benign"), ("paper", "attacked"), ("moved", "attacked"))
    }
    drops = {
        mode: tuple(_fall(one) for one in differences(figures[mode], figures["benign"], len(results), draws, rng))
        for mode in ("paper", "moved")
    }
    tallies, phantoms = _tallies(results, truth, found, target.t_star)
    shares = intervals(
        [Figure(name, (Recalled(tally),)) for name, tally in tallies.items()], len(results), draws, rng
    )
    return TransferRow(
        run=run,
        target=target,
        frames=len(results),
        benign=scores("benign", "benign"),
        rerendered=scores("benign", "rerendered"),
        paper=scores("paper", "attacked"),
        moved=scores("moved", "attacked"),
        drops=drops,
        shares={share.name: share for share in shares},
        counts={name: (int(t.hits.sum()), int(t.objects.sum())) for name, t in tallies.items()},
        phantoms=phantoms,
        figures=figures,
    )


def _fall(one: Difference) -> Interval:
    return one.interval


def figures_of(targets: Sequence[Targets], found: Sequence[Detections], label: int) -> list[Figure]:
    """AP50 and RECALL of one class, to be weighed by frames."""
    outcome = Outcome.of(targets, found, label)
    tally = outcome.candidates.tally(outcome.candidates.coco(OVERLAP), 0)
    return [Figure(AP50, (Averaged(tally, "coco"),)), Figure(RECALL, (Recalled(tally),))]


def _tallies(
    results: Sequence[FrameResult],
    truth: dict[str, list[Targets]],
    found: dict[str, list[Detections]],
    t_star: float,
) -> tuple[dict[str, Tally], int]:
    """Hits and objects of each share, frame by frame, and how many phantoms there are."""
    names = (TRANSFER, CERTAIN, THRESHOLD, LOST, FRAMES, BROKEN)
    sure = at_least(Grade.CERTAIN)
    hits, objects = ({name: np.zeros(len(results)) for name in names} for _ in range(2))
    phantoms = 0
    for i, result in enumerate(results):
        benign, moved = truth["benign"][i], truth["moved"][i]
        failed = failures.find(benign, found["benign"][i], moved, found["attacked"][i], t_star)
        seen = failures.judge(benign, found["benign"][i], t_star).found & ~moved.ignore
        known = set(seen.nonzero()[:, 0].tolist())
        losses = [f for f in result.failures if f.kind == "lost"]
        theirs = known & {f.index for f in losses}
        certain = known & {f.index for f in losses if sure(f)}
        for name, lost in ((TRANSFER, theirs), (CERTAIN, certain), (THRESHOLD, theirs - certain)):
            objects[name][i], hits[name][i] = len(lost), len(lost & set(failed.lost))
        objects[LOST][i], hits[LOST][i] = len(known), len(failed.lost)
        objects[FRAMES][i], hits[FRAMES][i] = result.success_moved, result.success_moved and failed.success
        objects[BROKEN][i], hits[BROKEN][i] = 1, failed.success
        phantoms += len(failed.phantoms)
    frames = np.arange(len(results))
    tallies = {
        name: Tally(np.ones(len(results)), frames, hits[name], np.zeros(len(results)), objects[name])
        for name in names
    }
    return tallies, phantoms
