"""The figures of one arm: before and after the attack, what falls, and what falls more than in its controls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from drivesem.evaluation.coco import IOU_THRESHOLDS
from drivesem.evaluation.matches import Matches
from drivesem.evaluation.resampling import (
    Averaged,
    Difference,
    Figure,
    Interval,
    Recalled,
    differences,
    holm,
    wilson,
)
from drivesem.report.paper import PAPER_BENIGN
from tools.experiments.detection.arms import matching_control
from tools.experiments.detection.counts import ArmCounts, FrameCounts

METRIC_NAMES = {"ap50": "AP50", "ap70": "AP70", "ap": "AP50:95", "recall": "recall"}
"""Fields of `RowScores`, whose fall is told, and their names for people."""
MODES = ("paper", "moved")
_SINGLE_OVERLAPS = {"ap50": 0.5, "ap70": 0.7}


@dataclass(frozen=True, slots=True)
class HeadlineScores:
    """HEADLINE's figures, fractions of 1, as `coco.ClassScores` has them; None where there is no object to find,
    or where they are not told.
    """

    ap50: float | None
    ap70: float | None = None
    ap: float | None = None
    recall: float | None = None

    @classmethod
    def from_metrics(cls, figures: Sequence[Figure]) -> HeadlineScores:
        """Those of them that are there."""
        return cls(**{figure.name: figure.value() for figure in figures})


@dataclass(frozen=True, slots=True)
class ArmComparison:
    """One arm, or one control by its seeds. benign, paper, moved: HEADLINE's figures in the photographs, and after
    the attack by either label mode. drops: by mode and figure, from benign to attacked. effects: by control and
    mode, how far AP50 falls below the control's. controls: their own rows. size: of a control's edits, relative to
    the arm's. p: of the effect by moved labels beside the matching control, Holm's over all rows. Of several
    seeds figures and what is counted are means, all else is the first's.
    """

    runs: Sequence[ArmCounts]
    benign: HeadlineScores
    paper: HeadlineScores
    moved: HeadlineScores
    drops: dict[str, dict[str, Interval]]
    effects: dict[str, dict[str, Difference]]
    controls: dict[str, ArmComparison]
    size: float | None = None
    p: float | None = None

    @property
    def run(self) -> ArmCounts:
        """Of the first seed."""
        return self.runs[0]

    @property
    def matching_control(self) -> str | None:
        """The control with as many chances, where it was run."""
        kind = matching_control(self.run.arm.config)
        return kind if kind in self.controls else None

    def mean_broken_frames(self, mode: str) -> float:
        """Frames in which something was lost or made up."""
        found = [getattr(frame, f"success_{mode}") for run in self.runs for frame in run.frames]
        return sum(found) / len(self.runs)

    def broken_share(self, mode: str) -> Interval:
        """Of the first seed's frames, with Wilson's 95 %, which also holds of a dozen frames."""
        found = [getattr(frame, f"success_{mode}") for frame in self.run.frames]
        if not found:
            return Interval("broken", None, None, None)
        return Interval("broken", sum(found) / len(found), *wilson(sum(found), len(found)))

    @property
    def name(self) -> str:
        """The arm's."""
        return self.run.arm.name

    def to_row(self) -> dict[str, Any]:
        """Numbers by name, for CSV and JSON: fractions of 1, None where there is nothing to count."""
        arm, frames = self.run.arm, self.run.frames
        found: dict[str, Any] = {
            "name": arm.name,
            "benign_ap50": self.benign.ap50,
            "paper_ap50": self.paper.ap50,
            "moved_ap50": self.moved.ap50,
            "drop_paper": self.drops["paper"]["ap50"].value,
            "drop_moved": self.drops["moved"]["ap50"].value,
            "recall_paper": self.paper.recall,
            "recall_moved": self.moved.recall,
            "reference": arm.reference,
            "reference_drop": None if arm.reference is None else PAPER_BENIGN - arm.reference,
            "frames": len(frames),
            "objects": int(self.run.before.objects.sum()),
            "successes_paper": sum(f.success_paper for f in frames),
            "successes_moved": sum(f.success_moved for f in frames),
            "control": self.matching_control,
            "p": self.p,
            "queries": sum(f.queries for f in frames),
            "feasible_fraction": feasible_fraction(frames),
        }
        for key in ("ap70", "ap", "recall"):
            found[f"benign_{key}"] = getattr(self.benign, key)
            found |= {f"{mode}_{key}": getattr(getattr(self, mode), key) for mode in MODES}
        for mode, falls in self.drops.items():
            broken = self.broken_share(mode)
            found |= {f"broken_{mode}": broken.value, f"broken_{mode}_low": broken.low}
            found[f"broken_{mode}_high"] = broken.high
            for key, one in falls.items():
                name = f"drop_{mode}" if key == "ap50" else f"drop_{mode}_{key}"
                found |= {name: one.value, f"{name}_low": one.low, f"{name}_high": one.high}
        for name, row in self.controls.items():
            found |= {f"{name}_{mode}_ap50": getattr(row, mode).ap50 for mode in MODES}
            found |= {f"{name}_successes_moved": row.mean_broken_frames("moved"), f"{name}_seeds": len(row.runs)}
            found |= {f"{name}_size": row.size}
            for mode in MODES:
                told = {f"{name}_drop_{mode}": row.drops[mode]["ap50"]}
                told[f"over_{name}_{mode}"] = self.effects[name][mode].interval
                for key, one in told.items():
                    found |= {key: one.value, f"{key}_low": one.low, f"{key}_high": one.high}
        return found


def compare_arms(runs: Sequence[ArmCounts], draws: int, seed: int) -> list[ArmComparison]:
    """A row for each arm that is no control. draws: of the bootstrap over frames; all rows see the same."""
    rows = []
    for run in runs:
        if run.arm.control is not None:
            continue
        beside: dict[str, list[ArmCounts]] = {}
        for other in runs:
            if other.arm.control and other.arm.control_of == run.arm.name:
                beside.setdefault(other.arm.control, []).append(other)
        rows.append(_row(run, beside, draws, seed))
    effects = [None if row.matching is None else row.effects[row.matching]["moved"].p for row in rows]
    return [replace(row, p=p) for row, p in zip(rows, holm(effects), strict=True)]


class _Checked(Protocol):
    @property
    def feasible(self) -> bool: ...


def feasible_fraction(frames: Sequence[_Checked]) -> float | None:
    """Share of the frames in which the independent check finds nothing violated; None without frames."""
    return sum(frame.feasible for frame in frames) / len(frames) if frames else None


def _row(run: ArmCounts, beside: Mapping[str, Sequence[ArmCounts]], draws: int, seed: int) -> ArmComparison:
    mine = ArmMetrics.from_runs(run)
    controls, effects = {}, {}
    for name, others in beside.items():
        theirs = ArmMetrics.from_runs(*others).ap50_only()
        sizes = [relative_size(other.frames, run.frames) for other in others]
        known = [size for size in sizes if size is not None]
        row = _told(others, theirs, draws, seed)
        controls[name] = replace(row, size=float(np.mean(known)) if known else None)
        effects[name] = {mode: mine.drop_beyond(theirs, mode, draws, seed) for mode in MODES}
    return replace(_told([run], mine, draws, seed), controls=controls, effects=effects)


def _told(runs: Sequence[ArmCounts], figures: ArmMetrics, draws: int, seed: int) -> ArmComparison:
    """Without its controls."""
    return ArmComparison(
        runs=runs,
        benign=HeadlineScores.from_metrics(figures.before),
        paper=HeadlineScores.from_metrics(figures.after["paper"]),
        moved=HeadlineScores.from_metrics(figures.after["moved"]),
        drops={mode: figures.drops(mode, draws, seed) for mode in MODES},
        effects={},
        controls={},
    )


@dataclass(frozen=True, slots=True)
class ArmMetrics:
    """An arm's figures, to be weighed by frames: before the attack, and after it by label mode."""

    before: list[Figure]
    after: dict[str, list[Figure]]
    frames: int

    @classmethod
    def from_runs(cls, *runs: ArmCounts) -> ArmMetrics:
        """Of several, such as seeds, the means."""
        before = _means([_figures(run.before) for run in runs])
        after = {mode: _means([_figures(run.after[mode]) for run in runs]) for mode in MODES}
        return cls(before, after, len(runs[0].frames))

    def ap50_only(self) -> ArmMetrics:
        """That alone: of a control nothing else is told."""
        return ArmMetrics(
            self.before[:1], {mode: figures[:1] for mode, figures in self.after.items()}, self.frames
        )

    def drops(self, mode: str, draws: int, seed: int) -> dict[str, Interval]:
        """How far each figure falls, by figure; paired over frames."""
        rng = np.random.default_rng(seed)
        fallen = differences(self.after[mode], self.before, self.frames, draws, rng, test=False)
        return {one.name: one.interval for one in fallen}

    def drop_beyond(self, control: ArmMetrics, mode: str, draws: int, seed: int) -> Difference:
        """How far AP50 falls below the control's; paired over frames."""
        mine, theirs = self.after[mode][0], control.after[mode][0]
        # One attack beside each seed of the control.
        mine = replace(mine, parts=mine.parts * (len(theirs.parts) // len(mine.parts)))
        (one,) = differences([mine], [theirs], self.frames, draws, np.random.default_rng(seed))
        return one


def _means(figures: Sequence[Sequence[Figure]]) -> list[Figure]:
    """The same figures of several runs, each as one."""
    return [
        replace(same[0], parts=tuple(part for one in same for part in one.parts))
        for same in zip(*figures, strict=True)
    ]


def _figures(matches: Matches) -> list[Figure]:
    """In the order of FIGURES."""
    tallies = [matches.tally(place) for place in range(len(IOU_THRESHOLDS))]
    single = [
        Figure(key, (Averaged(tallies[int(np.abs(IOU_THRESHOLDS - overlap).argmin())], "coco"),))
        for key, overlap in _SINGLE_OVERLAPS.items()
    ]
    mean = Figure("ap", tuple(Averaged(tally, "coco") for tally in tallies))
    return [*single, mean, Figure("recall", (Recalled(tallies[0]),))]


def relative_size(control: Sequence[FrameCounts], attack: Sequence[FrameCounts]) -> float | None:
    """How large a control's edits are: the mean over frames of the ratio of norms of theta, each coordinate in
    units of its bounds; None where no frame was changed by the attack.
    """
    ratios = []
    for one, other in zip(control, attack, strict=True):
        if other.size > 0:
            ratios.append(one.size / other.size)
    return float(np.mean(ratios)) if ratios else None
