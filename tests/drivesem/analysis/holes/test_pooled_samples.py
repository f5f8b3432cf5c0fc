"""One rule for failures of many cars: where each car alone leaves a band open, and where it has its own rule."""

from __future__ import annotations

import numpy as np
import pytest

from drivesem.analysis.holes.rules import (
    ContrastSamples,
    FailureSamples,
    FeatureSamples,
    FrameHoles,
    fit_failure_rule,
    fit_rules,
)
from drivesem.failures.failure_probability import FailureProbability

NAMES = ("height_px", "lightness", "moved_m")
FAULT = {"height_px": (40.0, 60.0), "lightness": (0.2, 0.4)}
NOTHING = FeatureSamples((), (), ())


def samples(
    rng: np.random.Generator, height: float, count: int, fault: dict[str, tuple[float, float]]
) -> FeatureSamples:
    """Of a car of about one height, which its place hardly changes; its paint may become anything."""
    heights, shades = height + rng.uniform(-4, 4, count), rng.random(count)
    known = {"height_px": heights, "lightness": shades}
    inside = np.ones(count, np.bool_)
    for name, (low, high) in fault.items():
        inside &= (known[name] >= low) & (known[name] <= high)
    lost = rng.random(count) < np.where(inside, 0.95, 0.02)
    rows = np.stack([heights, shades, rng.random(count)], 1)
    return FeatureSamples(NAMES, tuple(map(tuple, rows.tolist())), tuple(-1.0 if one else 1.0 for one in lost))


def frame(rng: np.random.Generator, failing: list[float], others: list[float], label: str = "Car") -> FrameHoles:
    """Failures of cars of some heights, and others that were shown beside."""
    around = tuple(
        FailureSamples(
            i,
            label,
            "missed",
            "certain",
            samples(rng, h, 24, FAULT),
            NOTHING,
            FailureProbability(0.2, 0.1, 0.3, "samples", 0),
        )
        for i, h in enumerate(failing)
    )
    seen = [samples(rng, height, 4, FAULT) for height in others]
    objects = tuple(len(failing) + i for i, one in enumerate(seen) for _ in one.margins)
    values = tuple(row for one in seen for row in one.values)
    margins = tuple(margin for one in seen for margin in one.margins)
    return FrameHoles(
        "x", "", around, (ContrastSamples(label, objects, FeatureSamples(NAMES, values, margins)),), 0, 0.0
    )


@pytest.fixture
def found() -> dict[str, FrameHoles]:
    rng = np.random.default_rng(0)
    return {
        str(number): frame(rng, [44.0 + 4 * number], [15.0 + 7 * number, 65.0 + 5 * number, 35.0 + number])
        for number in range(4)
    }


def test_many_cars_pin_both_bands_down(found: dict[str, FrameHoles]) -> None:
    alone = [fit_failure_rule(one) for holes in found.values() for one in holes.around]
    assert not any("height_px" in where for where in alone), "a car alone leaves its height open"
    rules = fit_rules(found)
    assert set(rules) == {(name, 0) for name in found}
    (where,) = {tuple(sorted(one.where.items())) for one in rules.values()}
    assert all(one.pooled for one in rules.values())
    for name, (low, high) in where:
        wide = FAULT[name][1] - FAULT[name][0]
        assert (low, high) == pytest.approx(FAULT[name], abs=0.3 * wide)
    assert len(where) == 2


def test_without_contrast_heights_stay_open(found: dict[str, FrameHoles]) -> None:
    """All failing cars stand inside of the band: no sample says where it ends."""
    bare = {name: FrameHoles("x", "", holes.around, (), 0, 0.0) for name, holes in found.items()}
    rules = fit_rules(bare)
    assert not any("height_px" in one.where for one in rules.values())


def test_another_class_keeps_its_own(found: dict[str, FrameHoles]) -> None:
    van = frame(np.random.default_rng(9), [50.0], [], "Van")
    rules = fit_rules(found | {"van": van})
    assert not rules["van", 0].pooled
    assert rules["van", 0].where == fit_failure_rule(van.around[0])
    assert all(one.pooled for key, one in rules.items() if key[0] != "van")


def test_a_failure_that_no_rule_explains_keeps_its_own(found: dict[str, FrameHoles]) -> None:
    rng = np.random.default_rng(3)
    far = samples(rng, 110.0, 48, {"lightness": (0.7, 1.0)})
    other = FailureSamples(
        5, "Car", "missed", "certain", far, NOTHING, FailureProbability(0.2, 0.1, 0.3, "samples", 0)
    )
    rules = fit_rules(found | {"other": FrameHoles("x", "", (other,), (), 0, 0.0)})
    assert not rules["other", 5].pooled
    assert set(rules["other", 5].where) == {"lightness"}
    assert rules["other", 5].where["lightness"][0] == pytest.approx(0.7, abs=0.1)


def test_one_failure_is_not_pooled() -> None:
    rng = np.random.default_rng(1)
    rules = fit_rules({"a": frame(rng, [50.0], [20.0, 90.0])})
    assert not rules["a", 0].pooled


def test_a_failure_without_samples_has_no_rule() -> None:
    one = FailureSamples(
        0, "Car", "missed", "certain", NOTHING, NOTHING, FailureProbability(0.0, 0.0, 1.0, "samples", 0)
    )
    rules = fit_rules({"a": FrameHoles("x", "", (one,), (), 0, 0.0)})
    assert (rules["a", 0].where, rules["a", 0].pooled) == ({}, False)
