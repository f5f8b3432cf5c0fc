"""The figures of one arm: before and after the attack, what falls, and what falls more than in its controls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from detectors.types import CLASSES
from drivesem.attack.judging import HEADLINE
from drivesem.evaluation.coco import IOU_THRESHOLDS, ClassScores
from drivesem.evaluation.outcome import Outcome
from drivesem.evaluation.resampling import Averaged, Difference, Figure, Interval, Recalled, differences, holm
from drivesem.questions.study.arms import matching
from drivesem.questions.study.running import ArmRun
from drivesem.report.paper import PAPER_BENIGN
from drivesem.run.frame import as_detections, as_targets
from drivesem.run.results import FrameResult

FIGURES = {"ap50": "AP50", "ap70": "AP70", "ap": "AP50:95", "recall": "recall"}
"""Fields of `ClassScores` whose fall is told, and their names for people."""
MODES = ("paper", "moved")
_SINGLE_OVERLAPS = {"ap50": 0.5, "ap70": 0.7}


@dataclass(frozen=True, slots=True)
class StudyRow:
    """One arm, or one control by its seeds. benign, paper, moved: HEADLINE's figures in the photographs, and after
    the attack by either label mode. drops: by mode and figure, from benign to attacked. effects: by control and
    mode, how far AP50 falls below the control's. controls: their own rows. size: of a control's edits, relative to
    the arm's. p: of the effect by moved labels beside the matching control, Holm's over all rows. Of several
    seeds AP50, its falls and what is counted are means, all else is the first's.
    """

    runs: Sequence[ArmRun]
    benign: ClassScores
    paper: ClassScores
    moved: ClassScores
    drops: dict[str, dict[str, Interval]]
    effects: dict[str, dict[str, Difference]]
    controls: dict[str, StudyRow]
    size: float | None = None
    p: float | None = None

    @property
    def run(self) -> ArmRun:
        """Of the first seed."""
        return self.runs[0]

    @property
    def matching(self) -> str | None:
        """The control with as many chances, where it was run."""
        kind = matching(self.run.arm.config)
        return kind if kind in self.controls else None

    def broken(self, mode: str) -> float:
        """Frames in which something was lost or made up."""
        found = [getattr(result, f"success_{mode}") for run in self.runs for result in run.results]
        return sum(found) / len(self.runs)

    @property
    def name(self) -> str:
        """The arm's."""
        return self.run.arm.name

    def flat(self) -> dict[str, Any]:
        """Numbers by name, for CSV and JSON: fractions of 1, None where there is nothing to count."""
        arm, results = self.run.arm, self.run.results
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
            "frames": len(results),
            "objects": self.benign.objects,
            "successes_paper": sum(r.success_paper for r in results),
            "successes_moved": sum(r.success_moved for r in results),
            "control": self.matching,
            "p": self.p,
            "queries": sum(r.queries for r in results),
            "feasible_fraction": feasible_fraction(results),
        }
        for key in ("ap70", "ap", "recall"):
            found[f"benign_{key}"] = getattr(self.benign, key)
            found |= {f"{mode}_{key}": getattr(getattr(self, mode), key) for mode in MODES}
        for mode, falls in self.drops.items():
            for key, one in falls.items():
                name = f"drop_{mode}" if key == "ap50" else f"drop_{mode}_{key}"
                found |= {name: one.value, f"{name}_low": one.low, f"{name}_high": one.high}
        for name, row in self.controls.items():
            found |= {f"{name}_{mode}_ap50": getattr(row, mode).ap50 for mode in MODES}
            found |= {f"{name}_successes_moved": row.broken("moved"), f"{name}_seeds": len(row.runs)}
            found |= {f"{name}_size": row.size}
            for mode in MODES:
                told = {f"{name}_drop_{mode}": row.drops[mode]["ap50"]}
                told[f"over_{name}_{mode}"] = self.effects[name][mode].interval
                for key, one in told.items():
                    found |= {key: one.value, f"{key}_low": one.low, f"{key}_high": one.high}
        return found


def rows_of(runs: Sequence[ArmRun], draws: int, seed: int) -> list[StudyRow]:
    """A row for each arm that is no control. draws: of the bootstrap over frames; all rows see the same."""
    rows = []
    for run in runs:
        if run.arm.control is not None:
            continue
        beside: dict[str, list[ArmRun]] = {}
        for other in runs:
            if other.arm.control and other.arm.of == run.arm.name:
                beside.setdefault(other.arm.control, []).append(other)
        rows.append(_row(run, beside, draws, seed))
    effects = [None if row.matching is None else row.effects[row.matching]["moved"].p for row in rows]
    return [replace(row, p=p) for row, p in zip(rows, holm(effects), strict=True)]


def feasible_fraction(results: Sequence[FrameResult]) -> float | None:
    """Share of the frames in which the independent check finds nothing violated; None without frames."""
    return sum(r.feasible for r in results) / len(results) if results else None


def _row(run: ArmRun, beside: Mapping[str, Sequence[ArmRun]], draws: int, seed: int) -> StudyRow:
    mine = Figures.of(run)
    controls, effects = {}, {}
    for name, others in beside.items():
        theirs = Figures.of(*others).of_ap50()
        sizes = [relative_size(other.results, run.results) for other in others]
        known = [size for size in sizes if size is not None]
        row = _told(others, theirs, draws, seed)
        controls[name] = replace(row, size=float(np.mean(known)) if known else None)
        effects[name] = {mode: mine.falls(theirs, mode, draws, seed) for mode in MODES}
    return replace(_told([run], mine, draws, seed), controls=controls, effects=effects)


def _told(runs: Sequence[ArmRun], figures: Figures, draws: int, seed: int) -> StudyRow:
    """Without its controls."""
    summary = runs[0].summary
    after = {"paper": summary.attacked_paper.headline, "moved": summary.attacked_moved.headline}
    if len(runs) > 1:
        after = {mode: replace(one, ap50=figures.after[mode][0].value()) for mode, one in after.items()}
    return StudyRow(
        runs=runs,
        benign=summary.benign.headline,
        paper=after["paper"],
        moved=after["moved"],
        drops={mode: figures.drops(mode, draws, seed) for mode in MODES},
        effects={},
        controls={},
    )


@dataclass(frozen=True, slots=True)
class Figures:
    """An arm's figures, to be weighed by frames: before the attack, and after it by label mode."""

    before: list[Figure]
    after: dict[str, list[Figure]]
    frames: int

    @classmethod
    def of(cls, *runs: ArmRun) -> Figures:
        """Of several, such as seeds, the means."""
        each = [cls._of(run) for run in runs]
        before = _means([one.before for one in each])
        return cls(before, {mode: _means([one.after[mode] for one in each]) for mode in MODES}, each[0].frames)

    @classmethod
    def _of(cls, run: ArmRun) -> Figures:
        names, label = run.judged.names, run.judged.names.index(HEADLINE)
        benign = [run.judged.targets(as_targets(r.targets_benign, CLASSES)) for r in run.results]
        moved = [run.judged.targets(as_targets(r.targets_moved, CLASSES)) for r in run.results]
        attacked = [as_detections(r.detections_attacked, names) for r in run.results]
        photographs = [as_detections(r.detections_benign, names) for r in run.results]
        return cls(
            before=_figures(Outcome.of(benign, photographs, label)),
            after={
                "paper": _figures(Outcome.of(benign, attacked, label)),
                "moved": _figures(Outcome.of(moved, attacked, label)),
            },
            frames=len(run.results),
        )

    def of_ap50(self) -> Figures:
        """That alone: of a control nothing else is told."""
        return Figures(self.before[:1], {mode: figures[:1] for mode, figures in self.after.items()}, self.frames)

    def drops(self, mode: str, draws: int, seed: int) -> dict[str, Interval]:
        """How far each figure falls, by figure; paired over frames."""
        rng = np.random.default_rng(seed)
        fallen = differences(self.after[mode], self.before, self.frames, draws, rng, test=False)
        return {one.name: one.interval for one in fallen}

    def falls(self, control: Figures, mode: str, draws: int, seed: int) -> Difference:
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


def _figures(outcome: Outcome) -> list[Figure]:
    """In the order of FIGURES."""
    candidates = outcome.candidates
    tallies = [candidates.tally(candidates.coco(overlap), 0) for overlap in IOU_THRESHOLDS]
    single = [
        Figure(key, (Averaged(tallies[int(np.abs(IOU_THRESHOLDS - overlap).argmin())], "coco"),))
        for key, overlap in _SINGLE_OVERLAPS.items()
    ]
    mean = Figure("ap", tuple(Averaged(tally, "coco") for tally in tallies))
    return [*single, mean, Figure("recall", (Recalled(tallies[0]),))]


def relative_size(control: Sequence[FrameResult], attack: Sequence[FrameResult]) -> float | None:
    """How large a control's edits are: the mean over frames of the ratio of norms of theta, each coordinate in
    units of its bounds; None where no frame was changed by the attack.
    """
    ratios = []
    for one, other in zip(control, attack, strict=True):
        size = size_of(other)
        if size > 0:
            ratios.append(size_of(one) / size)
    return float(np.mean(ratios)) if ratios else None


def size_of(result: FrameResult) -> float:
    """Norm of a frame's theta, each coordinate in units of its bounds."""
    values = [c.value / (c.upper - c.lower) for c in result.theta if c.upper > c.lower]
    return float(np.linalg.norm(values))
