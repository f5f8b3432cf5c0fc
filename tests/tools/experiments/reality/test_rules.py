"""Lifts of rules over matched objects, placebos, and rules fitted to samples, on cases counted by hand."""

import numpy as np
import pytest

from tools.experiments.reality.features import ObjectFeatures
from tools.experiments.reality.losses import draw_weights
from tools.experiments.reality.rules import RULE_FEATURES, choose_rules, feature_columns, measure_lift, random_box
from tools.experiments.reality.samples import RuleSample, SampledObject


def expand(*cells: tuple[bool, int, int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Objects of cells (inside, stratum, missed, count)."""
    inside, stratum, missed = [], [], []
    for is_inside, number, misses, count in cells:
        inside += [is_inside] * count
        stratum += [number] * count
        missed += [True] * misses + [False] * (count - misses)
    return np.array(inside), np.array(missed), np.array(stratum)


def test_lift_compares_within_strata() -> None:
    # near: 2 of 10 inside against 1 of 10 outside; far: 8 of 10 against 4 of 10. Both twice as often.
    inside, missed, stratum = expand((True, 0, 2, 10), (False, 0, 1, 10), (True, 1, 8, 10), (False, 1, 4, 10))
    frame = np.arange(len(inside)) % 8
    lift = measure_lift(inside, missed, stratum, frame, np.ones((1, 8)))
    assert lift.lift.value == pytest.approx(2)
    assert lift.inside == (10, 20)
    assert lift.rate.value == pytest.approx(0.5)
    assert lift.outside.value == pytest.approx(0.25)


def test_a_rule_that_only_selects_small_objects_has_no_lift() -> None:
    # small ones are missed 6 times in 10 in and out of the rule, large ones once in 10; the rule holds small ones
    inside, missed, stratum = expand((True, 0, 18, 30), (False, 0, 6, 10), (True, 1, 1, 10), (False, 1, 3, 30))
    lift = measure_lift(inside, missed, stratum, np.arange(len(inside)) % 5, np.ones((1, 5)))
    assert lift.lift.value == pytest.approx(1)


def test_strata_without_comparison_do_not_count() -> None:
    inside, missed, stratum = expand((True, 0, 4, 10), (False, 0, 2, 10), (True, 1, 10, 10))
    lift = measure_lift(inside, missed, stratum, np.arange(len(inside)) % 5, np.ones((1, 5)))
    assert lift.inside == (4, 10)
    assert lift.lift.value == pytest.approx(2)


def test_intervals_follow_from_the_draws() -> None:
    inside, missed, stratum = expand((True, 0, 36, 40), (False, 0, 8, 40))
    frame = np.tile(np.arange(20), 4)
    weights = draw_weights(20, 300, np.random.default_rng(0))
    lift = measure_lift(inside, missed, stratum, frame, weights)
    assert lift.above
    assert lift.apart
    assert lift.rate.low is not None
    assert lift.outside.high is not None
    assert lift.outside.high < 0.5 < lift.rate.low
    same = measure_lift(inside, ~missed, stratum, frame, weights)
    assert not same.above
    assert not same.apart


def features(contrast: float, across: float) -> ObjectFeatures:
    return ObjectFeatures(50.0, 1.3, across, 0.4, contrast, 0.4, 0.15, 0.0)


def sample_run(rng: np.random.Generator, threshold: float = 0.1) -> list[RuleSample]:
    """A detector that misses what has less contrast than the threshold."""
    rows = []
    for frame in range(8):
        for failure in (True, False):
            for _ in range(24):
                contrast = float(rng.uniform(0.02, 0.3))
                one = SampledObject("a", f"f{frame}", 0, failure, contrast < threshold)
                rows.append((one, features(contrast, float(rng.uniform()))))
    return rows


def test_rules_are_those_of_the_samples() -> None:
    rules = choose_rules(sample_run(np.random.default_rng(0)), "a", 5, 0)
    assert rules
    low, high = rules[0].where["contrast"]
    assert low < 0.03
    assert high == pytest.approx(0.1, abs=0.02)
    assert choose_rules(sample_run(np.random.default_rng(0)), "a", 5, 0) == rules
    assert choose_rules(sample_run(np.random.default_rng(0)), "b", 5, 0) == []


def test_noise_has_no_rule() -> None:
    rng = np.random.default_rng(0)
    rows = [
        (
            SampledObject("a", f"f{frame}", 0, frame % 2 == 0, bool(rng.random() < 0.5)),
            features(float(rng.uniform()), 0.5),
        )
        for frame in range(8)
        for _ in range(24)
    ]
    assert choose_rules(rows, "a", 5, 0) == []


@pytest.mark.parametrize("seed", range(5))
def test_random_boxes_are_as_large(seed: int) -> None:
    rng = np.random.default_rng(seed)
    columns = feature_columns([features(*rng.uniform(0, 1, 2)) for _ in range(1000)])
    columns |= {name: rng.uniform(0, 1, 1000) for name in RULE_FEATURES}
    box = random_box({"contrast": (0.2, 0.5)}, columns, rng)
    ((name, (low, high)),) = box.items()
    inside = (columns[name] >= low) & (columns[name] <= high)
    assert inside.mean() == pytest.approx(0.3, abs=0.05)
