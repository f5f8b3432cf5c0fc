"""How sure the failures of each arm are: by grade and kind, beside what there was to lose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivesem.evaluation.instances import Floats
from drivesem.evaluation.resampling import Interval, intervals, rate
from drivesem.failures.grades import Grade, Kind
from drivesem.run.summary import at_least
from tools.experiments.detection.counts import ArmCounts, FailureRecord

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
    second_rendered: int
    survive: Interval

    def to_row(self) -> dict[str, Any]:
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
            "asked": self.second_rendered,
            SURVIVE: one.value,
            f"{SURVIVE}_low": one.low,
            f"{SURVIVE}_high": one.high,
        }


def count_grades(run: ArmCounts, draws: int, seed: int) -> ArmGrades:
    """Of an arm all of whose frames are graded."""
    frames = run.frames
    objects = np.array([frame.judged_objects for frame in frames], np.float64)

    def counted(rule: Callable[[FailureRecord], bool]) -> Floats:
        return np.array([sum(map(rule, frame.failures)) for frame in frames], np.float64)

    def of_kind(kind: Kind, grade: Grade) -> int:
        return sum(f.kind == kind and at_least(grade)(f) for frame in frames for f in frame.failures)

    hits = {grade: counted(at_least(grade)) for grade in Grade}
    asked = counted(lambda failure: failure.second_rendered)
    figures = [rate(str(grade), hits[grade], objects) for grade in Grade]
    figures.append(rate(SURVIVE, hits[Grade.CONFIRMED], asked))
    *rates, survive = intervals(figures, len(frames), draws, np.random.default_rng(seed))
    return ArmGrades(
        name=run.arm.name,
        control=run.arm.control,
        frames=len(frames),
        objects=int(objects.sum()),
        passes=sum(frame.passes for frame in frames),
        counts={grade: int(hits[grade].sum()) for grade in Grade},
        rates=dict(zip(Grade, rates, strict=True)),
        kinds={kind: {grade: of_kind(kind, grade) for grade in Grade} for kind in Kind},
        second_rendered=int(asked.sum()),
        survive=survive,
    )
