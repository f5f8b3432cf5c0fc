"""Rules found again in samples that follow one: the feature, the interval, and none where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivesem.failures.rules import (
    Flags,
    Floats,
    contains,
    count_rule,
    description_length,
    fit_rule,
    fit_rule_list,
    overlap,
    rates_differ,
)

NAMES = ("height_px", "aspect", "across", "lightness", "distance_m", "yaw_deg")


@pytest.mark.parametrize(
    ("inside", "outside", "differ"),
    [
        ((28, 32), (10, 40), True),
        ((19, 32), (19, 40), False),  # 59 % [42, 74], elsewhere 48
        ((10, 32), (30, 40), False),  # failing less often is no rule
        ((0, 0), (10, 40), True),
    ],
)
def test_a_rule_needs_rates_that_differ_beyond_their_intervals(
    inside: tuple[int, int], outside: tuple[int, int], differ: bool
) -> None:
    assert rates_differ(inside, outside) is differ


def samples(count: int, seed: int) -> dict[str, Floats]:
    values = np.random.default_rng(seed).random((len(NAMES), count))
    return dict(zip(NAMES, values, strict=True))


def failing(inside: Flags, seed: int, often: float = 0.9, else_: float = 0.05) -> Flags:
    return np.random.default_rng(seed + 1000).random(len(inside)) < np.where(inside, often, else_)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("band", [(0.2, 0.5), (0.0, 0.3), (0.65, 1.0)])
def test_one_feature(seed: int, band: tuple[float, float]) -> None:
    features = samples(96, seed)
    rule = fit_rule(features, failing(contains({"aspect": band}, features, 96), seed))
    assert next(iter(rule.intervals)) == "aspect"
    low, high = rule.intervals["aspect"]
    assert (low, high) == pytest.approx(band, abs=0.12)
    assert rule.failures / rule.count > 0.7
    assert rule.failures_outside / rule.count_outside < 0.2


def test_two_features() -> None:
    """In most of 8 draws: a pair that covers 16 % of the samples leaves few failures to tell from."""
    truth, named = {"height_px": (0.3, 0.7), "lightness": (0.0, 0.4)}, 0
    for seed in range(8):
        features = samples(128, seed)
        rule = fit_rule(features, failing(contains(truth, features, 128), seed, else_=0.02))
        named += set(rule.intervals) == set(truth)
    assert named >= 6


def test_chance_gives_no_rule() -> None:
    """At most one rule in twenty where failures follow nothing."""
    message = 0
    for seed in range(60):
        features = samples(96, seed)
        message += bool(fit_rule(features, failing(np.ones(96, np.bool_), seed, often=0.4)).intervals)
    assert message <= 3


def test_everything_fails_or_nothing() -> None:
    features = samples(50, 0)
    for fails in (np.ones(50, np.bool_), np.zeros(50, np.bool_)):
        rule = fit_rule(features, fails)
        assert rule.intervals == {}
        assert (rule.failures, rule.count) == (int(fails.sum()), 50)


def test_a_constant_feature_gives_no_rule() -> None:
    features = samples(60, 3) | {"across": np.full(60, 0.4)}
    fails = features["height_px"] < 0.5
    assert set(fit_rule(features, fails, only=("across",)).intervals) == set()
    assert set(fit_rule(features, fails).intervals) == {"height_px"}


@given(st.integers(0, 500), st.floats(0.05, 0.95), st.floats(0.05, 0.95))
@settings(max_examples=40, deadline=None)
def test_counts_add_up(seed: int, often: float, else_: float) -> None:
    features = samples(64, seed)
    fails = failing(features["aspect"] < 0.5, seed, often, else_)
    rule = fit_rule(features, fails)
    assert rule.count + rule.count_outside == 64
    assert rule.failures + rule.failures_outside == int(fails.sum())
    assert rule == count_rule(rule.intervals, features, fails)
    if rule.intervals:
        assert rule.failures * rule.count_outside > rule.failures_outside * rule.count


def test_overlap_is_by_the_worst_feature() -> None:
    one = {"a": (0.0, 1.0), "b": (0.0, 1.0)}
    assert overlap(one, one) == 1
    assert overlap(one, {"a": (0.5, 1.5), "b": (0.0, 1.0)}) == pytest.approx(0.5 / 1.5)
    assert overlap(one, {"a": (2.0, 3.0), "b": (0.0, 1.0)}) == 0
    assert overlap({}, {}) == 1


def of_cars(cars: int, each: int, seed: int) -> tuple[dict[str, Floats], np.ndarray]:
    """Samples of cars that differ more from each other than in their own: height and place are nearly theirs."""
    rng = np.random.default_rng(seed)
    objects = np.repeat(np.arange(cars), each)
    own = {name: rng.random(cars)[objects] + 0.03 * rng.standard_normal(len(objects)) for name in NAMES[:3]}
    return own | {name: rng.random(len(objects)) for name in NAMES[3:]}, objects


def test_covering_finds_two_rules() -> None:
    features, objects = of_cars(80, 16, 0)
    first, second = {"height_px": (0.3, 0.6), "lightness": (0.1, 0.5)}, {"yaw_deg": (0.85, 1.0)}
    inside = contains(first, features, len(objects)) | contains(second, features, len(objects))
    rules = fit_rule_list(features, failing(inside, 0, else_=0.01), objects)
    assert [set(rule.intervals) for rule in rules] in ([set(first), set(second)], [set(second), set(first)])
    for truth in (first, second):
        (rule,) = [rule for rule in rules if set(rule.intervals) == set(truth)]
        assert overlap(truth, rule.intervals) > 0.7


@pytest.mark.parametrize("by_car", [True, False])
def test_chance_gives_no_rule_list(by_car: bool) -> None:
    """Nor of a few cars that fail for no reason: samples of one car are much alike, and would seem to tell it."""
    message = 0
    for seed in range(20):
        features, objects = of_cars(40, 12, seed)
        rng = np.random.default_rng(seed)
        fails = rng.random(len(objects)) < 0.05
        if by_car:
            fails = np.isin(objects, rng.choice(40, 4, replace=False)) & (rng.random(len(objects)) < 0.5)
        message += bool(fit_rule_list(features, fails, objects))
    assert message <= 1


@pytest.mark.parametrize("cars", [3, 4, 5])
def test_three_cars_are_enough(cars: int) -> None:
    """Where there are fewer cars than parts, each car is a part."""
    truth = {"lightness": (0.2, 0.5)}
    features, objects = of_cars(cars, 48, 0)
    (rule,) = fit_rule_list(features, failing(contains(truth, features, len(objects)), 0, else_=0.01), objects)
    assert rule.intervals["lightness"] == pytest.approx(truth["lightness"], abs=0.1)


@pytest.mark.parametrize("cars", [3, 4])
def test_chance_on_few_cars_gives_no_rule_list(cars: int) -> None:
    """Nor where each fails as often as it will."""
    message = 0
    for seed in range(30):
        features, objects = of_cars(cars, 48, seed)
        rng = np.random.default_rng(seed)
        for often in (0.05, 0.4, rng.random(cars)[objects]):
            message += bool(fit_rule_list(features, rng.random(len(objects)) < often, objects))
    assert message <= 4


def test_what_fails_in_two_cars_alone_is_no_rule() -> None:
    features, objects = of_cars(40, 12, 1)
    assert fit_rule_list(features, objects < 2, objects) == []


def test_a_good_rule_shortens_the_description() -> None:
    features = samples(96, 0)
    truth = {"aspect": (0.2, 0.5)}
    fails = failing(contains(truth, features, 96), 0)
    assert description_length(truth, features, fails) < description_length({}, features, fails)
    assert description_length({"yaw_deg": (0.2, 0.5)}, features, fails) > description_length({}, features, fails)
    # Two bounds, each one of the 48 ends that are tried.
    more = description_length(truth, features, fails) - description_length(truth, features, fails, bounds=0)
    assert more == pytest.approx(2 * np.log(48))
