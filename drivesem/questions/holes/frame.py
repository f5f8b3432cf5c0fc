"""One frame: samples around each of its certain failures, a rule of them, and fresh samples inside of the rule."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from detectors.base import Predictor
from drivesem.attack.feasible.bounds import Limits
from drivesem.attack.space import Parameter
from drivesem.questions.holes.results import (
    HOLES,
    RECHECK,
    Around,
    FrameHoles,
    FrameRecheck,
    Samples,
    dump,
)
from drivesem.run.frame import RESULT
from drivesem.run.rebuilt import rebuilt
from drivesem.run.results import Failure, FrameResult, load_frame
from drivesem.run.tally import certain_losses
from drivesem.settings.commands import Attack
from drivesem.truth.neighbourhood import NEAR, Neighbourhood, Sample
from drivesem.truth.nuisances import Nuisances
from drivesem.truth.rare import State, share_lost
from drivesem.truth.rules import Floats, contains, fit
from scene_ir import files

_TRIES = 6
"""States that may be looked at for each fresh sample inside of a rule."""
_TRIES_AGAIN = 20
"""The same for a recheck: a rule may hold as little as a twentieth of the samples it is made of."""


@dataclass(frozen=True, slots=True)
class Effort:
    """samples: around each failure; fresh: inside of its rule; reach: see `Neighbourhood`; seed: of all."""

    samples: int
    fresh: int
    reach: float
    seed: int


@dataclass(frozen=True, slots=True)
class Told:
    """What samples around a failure say. asked: of the whole neighbourhood, at `states`; close: near the failure;
    where: the rule of both.
    """

    asked: Samples
    close: Samples
    states: list[State]
    where: dict[str, tuple[float, float]]


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
    for failure, near in _neighbourhoods(result, folder, attack, params, detector, effort):
        one = _around(failure, near, effort)
        passes += sum(len(seen.margins) for seen in (one.asked, one.near, one.fresh)) + one.lost.asked
        around.append(one)
    found = FrameHoles(
        identifier=result.identifier,
        source=files.digest(folder / RESULT),
        around=tuple(around),
        passes=passes,
        seconds=round(time.perf_counter() - start, 3),
    )
    with files.whole_folder(out) as part:
        files.write_text(part / HOLES, dump(found))
    return found


def look_again(
    folder: Path,
    attack: Attack,
    params: Sequence[Parameter],
    detector: Predictor,
    effort: Effort,
    known: FrameHoles,
    draws: int,
    out: Path,
) -> FrameRecheck:
    """Draw up to so many states inside of each rule that is known of a frame, by seeds of their own, and write the
    folder `out`, whole or not at all. Else as `look_around`.
    """
    start = time.perf_counter()
    result = load_frame(folder / RESULT)
    inside = []
    around = _neighbourhoods(result, folder, attack, params, detector, effort, ":recheck")
    for one, (_, near) in zip(known.around, around, strict=True):
        samples, _ = _seen(near, range(_TRIES_AGAIN * draws), draws if one.fresh.margins else 0, one.where)
        inside.append(samples)
    found = FrameRecheck(
        identifier=result.identifier,
        source=files.digest(folder / RESULT),
        indices=tuple(one.index for one in known.around),
        inside=tuple(inside),
        passes=sum(len(samples.margins) for samples in inside),
        seconds=round(time.perf_counter() - start, 3),
    )
    with files.whole_folder(out) as part:
        files.write_text(part / RECHECK, dump(found))
    return found


def _neighbourhoods(
    result: FrameResult,
    folder: Path,
    attack: Attack,
    params: Sequence[Parameter],
    detector: Predictor,
    effort: Effort,
    stream: str = "",
) -> Iterator[tuple[Failure, Neighbourhood]]:
    """Of each certain failure, in their order. stream: of the seeds."""
    objective, theta = rebuilt(result, folder, attack, params, detector)
    limits = Limits(joint_weather=result.joint_weather)
    feasible = objective.feasible_set(limits, attack.project == "bounds")
    nuisances = Nuisances.of(attack.nuisances)
    for failure in certain_losses(result):
        assert failure.index is not None
        name = f"{result.identifier}:{failure.index}:{effort.seed}{stream}"
        yield failure, Neighbourhood(objective, feasible, theta, failure.index, nuisances, name, effort.reach)


def told_around(near: Neighbourhood, samples: int) -> Told:
    """What so many samples around a failure tell, half of the whole neighbourhood, half close to it."""
    half = samples // 2
    asked, states = _seen(near, range(half), half, {})
    close, _ = _seen(near, range(half, samples), samples - half, {}, NEAR)
    return Told(asked, close, states, _rule(asked, close))


def _around(failure: Failure, near: Neighbourhood, effort: Effort) -> Around:
    told = told_around(near, effort.samples)
    asked, last = told.asked, effort.samples + _TRIES * effort.fresh
    fresh, _ = _seen(near, range(effort.samples, last), effort.fresh if asked.margins else 0, told.where)

    def margin(place: Floats, draw: int) -> float | None:
        sample = near.sample_at(place, draw)
        return None if sample is None else near.margin(sample)

    lost = share_lost(told.states, margin, np.random.default_rng([effort.seed, near.index]))
    assert failure.index is not None
    return Around(
        index=failure.index,
        label=failure.label,
        error=failure.error or "",
        grade=failure.grade or "",
        asked=asked,
        near=told.close,
        where=told.where,
        fresh=fresh,
        lost=lost,
    )


def _rule(asked: Samples, close: Samples) -> dict[str, tuple[float, float]]:
    both = [samples for samples in (asked, close) if samples.margins]
    if not both:
        return {}
    columns = {name: np.concatenate([samples.columns()[name] for samples in both]) for name in both[0].names}
    return fit(columns, np.concatenate([samples.failing for samples in both])).where


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
    names = tuple(rows[0]) if rows else ()
    values = tuple(tuple(round(v, 6) for v in row.values()) for row in rows)
    return Samples(names, values, tuple(round(state.margin, 6) for state in states)), states


def _columns(sample: Sample) -> dict[str, Floats]:
    return {name: np.array([value]) for name, value in sample.features.items()}
