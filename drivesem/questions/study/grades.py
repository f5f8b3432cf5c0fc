"""How sure the failures of each arm are: by grade and kind, beside what there was to lose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivesem.evaluation.instances import Floats
from drivesem.evaluation.resampling import Interval, intervals, rate
from drivesem.questions.study.running import ArmRun
from drivesem.run.results import Failure, FrameResult
from drivesem.run.tally import at_least
from drivesem.truth.grades import Grade, Kind

SURVIVE = "survive"


@dataclass(frozen=True, slots=True)
class ArmGrades:
    """One arm. objects: judged ones, before the attack; passes: of the detector, grading not counted; counts:
    failures of at least each grade; rates: the same for each object; kinds: counts of each kind by grade; asked:
    certain failures that were shown to a second renderer; survive: the share of them that it confirms. Bounds by
    bootstrap over frames.
    """

    name: str
    control: str | None
    frames: int
    objects: int
    passes: int
    counts: dict[Grade, int]
    rates: dict[Grade, Interval]
    kinds: dict[Kind, dict[Grade, int]]
    asked: int
    survive: Interval

    def flat(self) -> dict[str, Any]:
        """Numbers by name, for CSV and JSON: fractions of 1, None where there is nothing to count."""
        found: dict[str, Any] = {
            "name": self.name,
            "control": self.control,
            "frames": self.frames,
            "objects": self.objects,
            "passes": self.passes,
        }
        for grade, one in self.rates.items():
            found |= {str(grade): self.counts[grade], f"{grade}_rate": one.value}
            found |= {f"{grade}_low": one.low, f"{grade}_high": one.high}
        found |= {f"{kind}_{grade}": n for kind, by_grade in self.kinds.items() for grade, n in by_grade.items()}
        one = self.survive
        return found | {
            "asked": self.asked,
            SURVIVE: one.value,
            f"{SURVIVE}_low": one.low,
            f"{SURVIVE}_high": one.high,
        }


def grades_of(run: ArmRun, draws: int, seed: int) -> ArmGrades:
    """Of an arm all of whose frames are graded."""
    results = run.results
    objects = np.array([_judged(result, run.judged.names) for result in results], np.float64)

    def counted(rule: Callable[[Failure], bool]) -> Floats:
        return np.array([sum(map(rule, result.failures)) for result in results], np.float64)

    def of_kind(kind: Kind, grade: Grade) -> int:
        return sum(f.error == kind and at_least(grade)(f) for result in results for f in result.failures)

    hits = {grade: counted(at_least(grade)) for grade in Grade}
    asked = counted(lambda failure: failure.second is not None)
    figures = [rate(str(grade), hits[grade], objects) for grade in Grade]
    figures.append(rate(SURVIVE, hits[Grade.CONFIRMED], asked))
    *rates, survive = intervals(figures, len(results), draws, np.random.default_rng(seed))
    return ArmGrades(
        name=run.arm.name,
        control=run.arm.control,
        frames=len(results),
        objects=int(objects.sum()),
        passes=sum(result.passes or 0 for result in results),
        counts={grade: int(hits[grade].sum()) for grade in Grade},
        rates=dict(zip(Grade, rates, strict=True)),
        kinds={kind: {grade: of_kind(kind, grade) for grade in Grade} for kind in Kind},
        asked=int(asked.sum()),
        survive=survive,
    )


def _judged(result: FrameResult, names: Sequence[str]) -> int:
    """Objects of the scene that the detector is to find in the photograph."""
    return sum(not box.ignore and box.index is not None and box.label in names for box in result.targets_benign)
