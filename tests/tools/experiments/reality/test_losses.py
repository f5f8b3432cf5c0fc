"""Losses of recall, their agreement, and the placebo of equal size, on cases counted by hand."""

from dataclasses import replace

import numpy as np
import pytest

from tools.bench.conditions import DAY, UNDRAWN
from tools.experiments.reality.features import ObjectFeatures
from tools.experiments.reality.losses import compare_losses, compute_losses
from tools.experiments.reality.observations import (
    DRAWN,
    PLACEBO,
    PLAIN,
    REAL,
    Observation,
    ObservedObject,
    change_as_much,
)


def observe(
    source: str, condition: str, misses: int, heights: tuple[float, ...] = (40.0,), frames: int = 4, cars: int = 10
) -> list[Observation]:
    """Frames of `cars` objects of each height, of which `misses` are missed."""
    return [
        (
            ObservedObject(
                "B", condition, source, f"{source}{condition}{f}" if source == REAL else f"{f}", n, False, missed
            ),
            ObjectFeatures(height, 1.0, 0.5, 0.5, 0.1, 0.5, 0.1, 0.0),
        )
        for f in range(frames)
        for height in heights
        for n in range(cars)
        for missed in ["a" if n < misses else ""]
    ]


def test_losses_are_differences_of_recalls() -> None:
    rows = observe(REAL, DAY, 2) + observe(REAL, "fog", 6) + observe(PLAIN, UNDRAWN, 1)
    rows += observe(DRAWN, "fog", 4) + observe(PLACEBO, "fog", 1)
    losses = compute_losses(rows, ["a"], 20, np.random.default_rng(0))
    (point,) = losses.points
    assert (point.detector, point.condition, point.heights_px, point.objects) == (
        "a",
        "fog",
        (30.0, 48.0),
        (40, 40),
    )
    assert losses.real[0].tolist() == pytest.approx([0.4])
    assert losses.drawn[0].tolist() == pytest.approx([0.3])
    assert losses.placebo[0].tolist() == pytest.approx([0.0])
    assert losses.real.shape == (21, 1)


def test_few_objects_make_no_point() -> None:
    rows = observe(REAL, DAY, 2) + observe(REAL, "fog", 6, frames=1, cars=9) + observe(PLAIN, UNDRAWN, 1)
    rows += observe(DRAWN, "fog", 4) + observe(PLACEBO, "fog", 1)
    rows += observe(REAL, "night", 5) + observe(DRAWN, "night", 5) + observe(PLACEBO, "night", 5)
    losses = compute_losses(rows, ["a"], 5, np.random.default_rng(0))
    assert [point.condition for point in losses.points] == ["night"]


def test_equal_heights_decide() -> None:
    # real fog has near cars only, which are always detected: at its own height there is no loss
    rows = (
        observe(REAL, DAY, 0, (40.0, 120.0))
        + observe(REAL, "fog", 0, (120.0,))
        + observe(PLAIN, UNDRAWN, 0, (40.0, 120.0))
    )
    rows += observe(DRAWN, "fog", 3, (40.0, 120.0)) + observe(PLACEBO, "fog", 0, (40.0, 120.0))
    losses = compute_losses(rows, ["a"], 0, np.random.default_rng(0))
    assert [point.heights_px[0] for point in losses.points] == [96.0]
    assert losses.drawn[0].tolist() == pytest.approx([0.3])
    assert losses.real[0].tolist() == pytest.approx([0.0])


def test_agreement_by_hand() -> None:
    predicted = np.array([[0.1, 0.2, 0.3, -0.1], [0.1, 0.2, 0.3, -0.1]])
    agreement = compare_losses(predicted, 2 * predicted + 0.05)
    assert agreement.rank_correlation.value == pytest.approx(1)
    assert agreement.slope.value == pytest.approx(2)
    assert agreement.same_sign.value == 1
    assert agreement.bias.value == pytest.approx(-0.175)
    assert agreement.error.value == pytest.approx(np.mean([0.15, 0.25, 0.35, 0.05]))
    turned = compare_losses(predicted, -predicted)
    assert turned.rank_correlation.value == pytest.approx(-1)
    assert turned.same_sign.value == 0
    assert turned.slope.low == pytest.approx(-1)


@pytest.mark.parametrize("seed", range(8))
def test_placebo_changes_as_much(seed: int) -> None:
    photograph = np.random.default_rng(1).integers(60, 200, (40, 60, 3)).astype(np.uint8)
    other = np.clip(photograph.astype(int) - 25, 0, 255).astype(np.uint8)
    changed = change_as_much(photograph, other, np.random.default_rng(seed))
    assert np.abs(changed.astype(float) - photograph).mean() == pytest.approx(25, abs=0.6)


def test_placebo_of_an_equal_picture_is_that_picture() -> None:
    photograph = np.random.default_rng(1).integers(0, 255, (20, 20, 3)).astype(np.uint8)
    assert (change_as_much(photograph, photograph, np.random.default_rng(0)) == photograph).all()


def test_placebos_of_some_days_are_compared_with_those_days() -> None:
    rows = observe(REAL, DAY, 2) + observe(REAL, "fog", 6) + observe(PLAIN, UNDRAWN, 1, frames=2)
    worse = [
        (replace(one, frame=f"{one.frame}x"), features) for one, features in observe(PLAIN, UNDRAWN, 9, frames=2)
    ]
    rows += worse + observe(DRAWN, "fog", 4, frames=4) + observe(PLACEBO, "fog", 3, frames=2)
    losses = compute_losses(rows, ["a"], 5, np.random.default_rng(0))
    assert losses.placebo[0].tolist() == pytest.approx([0.2])
    assert losses.drawn[0].tolist() == pytest.approx([-0.1])
