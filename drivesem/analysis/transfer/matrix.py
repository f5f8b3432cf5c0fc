"""The figures of one run before one detector: benign and attacked, and what of the source's failures it shares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from detectors.types import CLASSES, Detections
from drivesem.attack.judging import HEADLINE, JudgedClasses
from drivesem.evaluation import coco, failures
from drivesem.evaluation.coco import IOU_50
from drivesem.evaluation.matches import Matches
from drivesem.evaluation.resampling import Averaged, Figure, Interval, Recalled, differences, intervals, rate
from drivesem.failures.grades import Grade
from drivesem.run.frame import as_targets
from drivesem.run.results import FrameResult
from drivesem.run.tally import at_least

AP50, RECALL = "AP50", "recall"
SHOWN = {"benign": "benign", "rerendered": "rerendered", "paper": "attacked", "moved": "attacked"}
"""What figures are of: the photographs, these rendered again, and the counterexamples by either label mode; and
their pictures, of `finished.PICTURES`."""


@dataclass(frozen=True, slots=True)
class ShownRun:
    """A run that is shown: its name, and its attack."""

    name: str
    detector: str
    method: str
    params: str


@dataclass(frozen=True, slots=True)
class Target:
    """A detector that is asked: its name for people, as it was given, its judged classes, its threshold."""

    name: str
    detector: str
    classes: tuple[str, ...]
    t_star: float


@dataclass(frozen=True, slots=True)
class FrameLosses:
    """One frame before a target, by moved labels. found: objects that it finds in the photograph; lost: those of
    them that it loses; source_lost, source_certain: those of them that the source lost, and lost for certain;
    both_lost, both_certain: those of these that the target loses too; source_broken, broken: whether the picture
    fails the source, and the target, by a lost object or a phantom; phantoms: of the target.
    """

    identifier: str
    found: int
    lost: int
    source_lost: int
    both_lost: int
    source_certain: int
    both_certain: int
    source_broken: bool
    broken: bool
    phantoms: int


@dataclass(frozen=True, slots=True)
class PairCounts:
    """What one target made of one run: all that its row is computed from. pictures: by the names of SHOWN and by
    judged class, what is detected in all frames.
    """

    source: ShownRun
    target: Target
    frames: tuple[FrameLosses, ...]
    pictures: Mapping[str, Mapping[str, Matches]]

    @classmethod
    def of(
        cls,
        source: ShownRun,
        target: Target,
        results: Sequence[FrameResult],
        found: Mapping[str, Sequence[Detections]],
    ) -> PairCounts:
        """Of a run's frames. found: detections in the pictures of PICTURES, one for each result, with labels among
        the judged classes.
        """
        judged = JudgedClasses(target.classes, target.classes)
        benign = [judged.targets(as_targets(r.targets_benign, CLASSES)) for r in results]
        moved = [judged.targets(as_targets(r.targets_moved, CLASSES)) for r in results]
        truth = {name: moved if name == "moved" else benign for name in SHOWN}
        frames = []
        sure = at_least(Grade.CERTAIN)
        for i, result in enumerate(results):
            failed = failures.find(benign[i], found["benign"][i], moved[i], found["attacked"][i], target.t_star)
            seen = failures.judge(benign[i], found["benign"][i], target.t_star).found & ~moved[i].ignore
            known = set(seen.nonzero()[:, 0].tolist())
            losses = [f for f in result.failures if f.kind == "lost"]
            theirs = known & {f.index for f in losses}
            certain = known & {f.index for f in losses if sure(f)}
            one = FrameLosses(
                identifier=result.identifier,
                found=len(known),
                lost=len(failed.lost),
                source_lost=len(theirs),
                both_lost=len(theirs & set(failed.lost)),
                source_certain=len(certain),
                both_certain=len(certain & set(failed.lost)),
                source_broken=result.success_moved,
                broken=failed.success,
                phantoms=len(failed.phantoms),
            )
            frames.append(one)
        matches = {
            name: {one: Matches.of(truth[name], found[at], label) for label, one in enumerate(target.classes)}
            for name, at in SHOWN.items()
        }
        return cls(source, target, tuple(frames), matches)

    def scores(self, name: str) -> coco.Scores:
        """The figures in the pictures of that name."""
        classes = {one: matches.scores(self.target.t_star) for one, matches in self.pictures[name].items()}
        return coco.Scores.of(classes, HEADLINE)

    def shares(self) -> dict[str, tuple[list[int], list[int]]]:
        """Frame by frame, how many of how many, by the names of shares."""
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
    """One run before one target. benign, rerendered, paper, moved: figures in the photographs, in these rendered
    again, and in the counterexamples by either label mode. drops: by how much HEADLINE's AP50 and recall fall from
    benign to attacked, by label mode. shares: TRANSFER, CERTAIN, THRESHOLD, LOST, FRAMES, BROKEN; counts: their
    numerators and denominators; phantoms: by moved labels. figures: AP50 and RECALL in the photographs (benign)
    and in the counterexamples by label mode, to be weighed by frames beside another row's.
    """

    source: ShownRun
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


def row_of(pair: PairCounts, draws: int, seed: int) -> TransferRow:
    """The figures of a pair. draws: of the bootstrap over frames."""
    rng, frames = np.random.default_rng(seed), len(pair.frames)
    figures = {name: figures_of(pair.pictures[name][HEADLINE]) for name in ("benign", "paper", "moved")}
    drops = {
        mode: tuple(one.interval for one in differences(figures[mode], figures["benign"], frames, draws, rng))
        for mode in ("paper", "moved")
    }
    shares = pair.shares()
    rates = [
        rate(name, np.array(hits, np.float64), np.array(of, np.float64)) for name, (hits, of) in shares.items()
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
        shares={share.name: share for share in intervals(rates, frames, draws, rng)},
        counts={name: (sum(hits), sum(of)) for name, (hits, of) in shares.items()},
        phantoms=sum(frame.phantoms for frame in pair.frames),
        figures=figures,
    )


def figures_of(matches: Matches) -> list[Figure]:
    """AP50 and RECALL of one class, to be weighed by frames."""
    tally = matches.tally(IOU_50)
    return [Figure(AP50, (Averaged(tally, "coco"),)), Figure(RECALL, (Recalled(tally),))]
