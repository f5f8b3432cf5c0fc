"""Shares of a cube in which an object is lost: against ones that are known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from drivesem.failures.failure_probability import (
    LEVEL_SHARE,
    MAX_LEVELS,
    FailureProbability,
    UnitCubePoint,
    estimate_failure_probability,
)
from drivesem.failures.rules import Floats


def slab(share: float) -> Callable[[Floats, int], float]:
    """Lost where the first coordinate is below `share`, whatever the others and the draw."""
    return lambda place, draw: float(place[0]) - share


def sphere(share: float) -> Callable[[Floats, int], float]:
    """Lost in a corner of three coordinates."""
    return lambda place, draw: float(place[:3].max()) - share ** (1 / 3)


def drawn(share: float) -> Callable[[Floats, int], float]:
    """Lost in some draws more than in others, by a noise that a draw's number fixes."""

    def margin(place: Floats, draw: int) -> float:
        return float(place[0]) - share * 2 * np.random.default_rng(draw).random()

    return margin


def estimate(margin: Callable[[Floats, int], float], seed: int, count: int = 48) -> FailureProbability:
    rng = np.random.default_rng(seed)
    places = rng.random((count, 6))
    states = [UnitCubePoint(place, i, margin(place, i)) for i, place in enumerate(places)]
    return estimate_failure_probability(states, margin, rng)


def test_what_is_not_rare_is_counted() -> None:
    found = estimate(slab(0.5), 0)
    assert (found.by, found.extra_samples) == ("samples", 0)
    assert found.low < 0.5 < found.high


@pytest.mark.parametrize("margin", [slab, sphere, drawn])
def test_rare_shares_are_found_without_bias(margin: Callable[[float], Callable[[Floats, int], float]]) -> None:
    found = [estimate(margin(0.01), seed, 300) for seed in range(40)]
    assert {one.by for one in found} == {"subset simulation"}
    assert np.mean([one.probability for one in found]) == pytest.approx(0.01, rel=0.15)


@pytest.mark.parametrize("share", [0.02, 0.004])
def test_few_states_give_a_wide_interval_that_mostly_holds(share: float) -> None:
    found = [estimate(slab(share), seed) for seed in range(100)]
    rare = [one for one in found if one.by == "subset simulation"]
    assert np.mean([one.low <= share <= one.high for one in rare]) > 0.85
    assert np.mean([one.probability for one in rare]) == pytest.approx(share, rel=0.4)
    assert max(one.extra_samples for one in rare) <= MAX_LEVELS * 48


def test_plain_samples_would_be_wider() -> None:
    wide = [one.high / max(one.low, 1e-9) for one in (estimate(slab(0.004), seed) for seed in range(20))]
    assert np.median(wide) < 30


def test_what_never_fails_has_an_upper_end_alone() -> None:
    found = estimate(lambda place, draw: 1.0 + float(place[0]), 3)
    assert (found.probability, found.low) == (0.0, 0.0)
    assert LEVEL_SHARE**MAX_LEVELS <= found.high < 0.02


def test_equal_margins_end_at_once() -> None:
    found = estimate(lambda place, draw: 1.0, 3)
    assert (found.probability, found.extra_samples) == (0.0, 0)


def test_where_it_does_not_count_is_never_entered() -> None:
    """Half of the cube does not count; of the rest 1 % is lost."""
    seen: list[Floats] = []

    def margin(place: Floats, draw: int) -> float | None:
        if place[1] > 0.5:
            return None
        seen.append(place)
        return float(place[0]) - 0.01

    rng = np.random.default_rng(5)
    shares = []
    for _ in range(100):
        places = rng.random((48, 4)) * [1, 0.5, 1, 1]
        states = [UnitCubePoint(place, 0, margin(place, 0) or 0.0) for place in places]
        shares.append(estimate_failure_probability(states, margin, rng).probability)
    assert np.mean(shares) == pytest.approx(0.01, rel=0.2)
