"""One frame: samples around each of its certain failures, a rule of them, and fresh samples inside of the rule."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from torch import Tensor

from detectors.base import Predictor
from detectors.types import CLASSES
from drivesem.analysis.holes.results import (
    FRESH,
    HOLES,
    RECHECK,
    Around,
    Beside,
    FrameHoles,
    FrameInside,
    Samples,
    dump,
    joined,
)
from drivesem.attack.feasible.bounds import Limits
from drivesem.attack.feasible.projection import FeasibleSet
from drivesem.attack.objective import Objective
from drivesem.attack.space import Parameter
from drivesem.config.commands import Attack
from drivesem.failures.neighbourhood import NEAR, Everywhere, Neighbourhood, Sample
from drivesem.failures.nuisances import Nuisances
from drivesem.failures.rare import State, share_lost
from drivesem.failures.rules import Floats, Where, contains
from drivesem.run.frame import RESULT
from drivesem.run.rebuilt import rebuilt
from drivesem.run.results import Failure, FrameResult, load_frame
from drivesem.run.tally import certain_losses
from scene_ir import files

_TRIES = 6
"""States that may be looked at for each fresh sample inside of a rule."""
_TRIES_AGAIN = 20
"""The same for a recheck: a rule may hold as little as a twentieth of the samples it is made of."""


@dataclass(frozen=True, slots=True)
class Effort:
    """samples: around each failure; contrast: states of all objects of a frame; reach: see `Neighbourhood`; seed:
    of all.
    """

    samples: int
    contrast: int
    reach: float
    seed: int


@dataclass(frozen=True, slots=True)
class Further:
    """Which further samples: so many inside of each rule, of the states of `numbers`, by seeds of `stream`; file:
    where they are kept, see `results`.
    """

    enough: int
    numbers: range
    stream: str
    file: str

    @classmethod
    def fresh(cls, samples: int, enough: int) -> Further:
        """What a rule of so many samples is held against."""
        return cls(enough, range(samples, samples + _TRIES * enough), "", FRESH)

    @classmethod
    def again(cls, enough: int) -> Further:
        """What its stated probability is held against, by seeds that neither of them knew."""
        return cls(enough, range(_TRIES_AGAIN * enough), ":recheck", RECHECK)


def look_around(
    folder: Path,
    attack: Attack,
    params: Sequence[Parameter],
    detector: Predictor,
    effort: Effort,
    out: Path,
) -> FrameHoles:
    """Look around the failures in a run's folder of one frame, and write the folder `out`, whole or not at all.

    attack, params: the run's. Raises FormatError where the scene is not there or is damaged.
    """
    start = time.perf_counter()
    result = load_frame(folder / RESULT)
    around, passes = [], 0
    posed = _Posed.of(result, folder, attack, params, detector)
    for failure, near in posed.neighbourhoods(effort):
        one = _around(failure, near, effort)
        passes += sum(len(seen.margins) for seen in (one.asked, one.near)) + one.lost.asked
        around.append(one)
    beside, shown = posed.beside(effort)
    found = FrameHoles(
        identifier=result.identifier,
        source=files.digest(folder / RESULT),
        around=tuple(around),
        beside=beside,
        passes=passes + shown,
        seconds=round(time.perf_counter() - start, 3),
    )
    with files.whole_folder(out) as part:
        files.write_text(part / HOLES, dump(found))
    return found


def look_inside(
    folder: Path,
    attack: Attack,
    params: Sequence[Parameter],
    detector: Predictor,
    effort: Effort,
    rules: Mapping[int, Where],
    further: Further,
    out: Path,
) -> FrameInside:
    """Draw further states inside of the rule of each failure of a frame, and write the folder `out`, whole or not
    at all. rules: by object. Else as `look_around`.
    """
    start = time.perf_counter()
    result = load_frame(folder / RESULT)
    indices, inside = [], []
    posed = _Posed.of(result, folder, attack, params, detector)
    for _, near in posed.neighbourhoods(effort, further.stream):
        if near.index in rules:
            samples, _ = _seen(near, further.numbers, further.enough, rules[near.index])
            indices.append(near.index)
            inside.append(samples)
    found = FrameInside(
        identifier=result.identifier,
        source=files.digest(folder / RESULT),
        indices=tuple(indices),
        inside=tuple(inside),
        passes=sum(len(samples.margins) for samples in inside),
        seconds=round(time.perf_counter() - start, 3),
    )
    with files.whole_folder(out) as part:
        files.write_text(part / further.file, dump(found))
    return found


@dataclass(frozen=True)
class _Posed:
    """A frame's result, and what its states are made with."""

    result: FrameResult
    objective: Objective
    feasible: FeasibleSet
    theta: Tensor
    nuisances: Nuisances

    @classmethod
    def of(
        cls,
        result: FrameResult,
        folder: Path,
        attack: Attack,
        params: Sequence[Parameter],
        detector: Predictor,
    ) -> _Posed:
        objective, theta = rebuilt(result, folder, attack, params, detector)
        limits = Limits(joint_weather=result.joint_weather)
        feasible = objective.feasible_set(limits, attack.project == "bounds")
        return cls(result, objective, feasible, theta, Nuisances.of(attack.nuisances))

    def neighbourhoods(self, effort: Effort, stream: str = "") -> Iterator[tuple[Failure, Neighbourhood]]:
        """Of each certain failure, in their order. stream: of the seeds."""
        for failure in certain_losses(self.result):
            assert failure.index is not None
            name = f"{self.result.identifier}:{failure.index}:{effort.seed}{stream}"
            near = Neighbourhood(
                self.objective, self.feasible, self.theta, failure.index, self.nuisances, name, effort.reach
            )
            yield failure, near

    def beside(self, effort: Effort) -> tuple[tuple[Beside, ...], int]:
        """Samples of all objects, by class, and the passes that they took."""
        if not effort.contrast:
            return (), 0
        name = f"{self.result.identifier}:{effort.seed}"
        everywhere = Everywhere(self.objective, self.feasible, self.nuisances, name)
        rows: dict[str, list[tuple[int, Sample, float]]] = {}
        passes = 0
        for number in range(effort.contrast):
            samples = everywhere.sample(number)
            passes += bool(samples)
            for index, margin in everywhere.margins(samples).items():
                label = CLASSES[int(samples[index].exposure.targets.labels[index])]
                rows.setdefault(label, []).append((index, samples[index], margin))
        return tuple(_beside(label, own) for label, own in rows.items()), passes


def _beside(label: str, rows: Sequence[tuple[int, Sample, float]]) -> Beside:
    described = [sample.features for _, sample, _ in rows]
    samples = _samples(described, [margin for _, _, margin in rows])
    return Beside(label, tuple(index for index, _, _ in rows), samples)


def samples_around(near: Neighbourhood, samples: int) -> Samples:
    """So many samples around a failure, half of the whole neighbourhood, half close to it."""
    asked, close, _ = _drawn(near, samples)
    return joined((asked, close))


def _around(failure: Failure, near: Neighbourhood, effort: Effort) -> Around:
    asked, close, states = _drawn(near, effort.samples)

    def margin(place: Floats, draw: int) -> float | None:
        sample = near.sample_at(place, draw)
        return None if sample is None else near.margin(sample)

    lost = share_lost(states, margin, np.random.default_rng([effort.seed, near.index]))
    assert failure.index is not None
    return Around(
        index=failure.index,
        label=failure.label,
        error=failure.error or "",
        grade=failure.grade or "",
        asked=asked,
        near=close,
        lost=lost,
    )


def _drawn(near: Neighbourhood, samples: int) -> tuple[Samples, Samples, list[State]]:
    half = samples // 2
    asked, states = _seen(near, range(half), half, {})
    close, _ = _seen(near, range(half, samples), samples - half, {}, NEAR)
    return asked, close, states


def _seen(
    near: Neighbourhood,
    numbers: Iterable[int],
    enough: int,
    where: Mapping[str, tuple[float, float]],
    part: float = 1.0,
) -> tuple[Samples, list[State]]:
    """Up to `enough` samples inside of a rule, in which the object counts, before the detector; and where they
    lie. part: of the neighbourhood's reach.
    """
    rows: list[dict[str, float]] = []
    states: list[State] = []
    for number in numbers:
        if len(rows) == enough:
            break
        sample = near.sample(number, part)
        if sample is None or not contains(where, _columns(sample), 1)[0]:
            continue
        rows.append(sample.features)
        states.append(State(near.place(number), number, near.margin(sample)))
    return _samples(rows, [state.margin for state in states]), states


def _samples(rows: Sequence[Mapping[str, float]], margins: Sequence[float]) -> Samples:
    names = tuple(rows[0]) if rows else ()
    values = tuple(tuple(round(v, 6) for v in row.values()) for row in rows)
    return Samples(names, values, tuple(round(margin, 6) for margin in margins))


def _columns(sample: Sample) -> dict[str, Floats]:
    return {name: np.array([value]) for name, value in sample.features.items()}
