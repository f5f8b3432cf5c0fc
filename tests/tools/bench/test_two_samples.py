"""Distances of distributions and the probe, on samples whose answers are known."""

import numpy as np
import pytest

from tools.bench.two_samples import compare_distributions, probe_sets, roc_area


def generator() -> np.random.Generator:
    return np.random.default_rng(5)


def test_a_shift_is_measured_in_real_interquartile_ranges() -> None:
    real = np.linspace(0, 4, 101)
    compared = compare_distributions(real, real + 3, 100, generator())
    assert compared.real == pytest.approx((1, 2, 3))
    assert compared.drawn == pytest.approx((4, 5, 6))
    assert compared.distance == pytest.approx(1.5)
    assert compared.low is not None
    assert compared.high is not None
    assert compared.low < 1.5 < compared.high
    assert not compared.inside


def test_the_median_decides_what_is_inside() -> None:
    real = np.linspace(0, 4, 101)
    assert compare_distributions(real, np.array([-9.0, 2.9, 40.0]), 10, generator()).inside
    assert not compare_distributions(real, np.array([2.0, 3.1, 4.0]), 10, generator()).inside


def test_without_a_range_there_is_no_distance() -> None:
    compared = compare_distributions(np.zeros(9), np.ones(9), 10, generator())
    assert (compared.distance, compared.low, compared.high) == (None, None, None)


def test_area_under_the_curve_counts_ties_half() -> None:
    assert roc_area(np.array([0.0, 1.0]), np.array([2.0, 3.0])) == 1
    assert roc_area(np.array([2.0, 3.0]), np.array([0.0, 1.0])) == 0
    assert roc_area(np.array([0.0, 1.0]), np.array([1.0])) == 0.75


def test_separable_sets_have_a_high_auc() -> None:
    rng = generator()
    first, second = rng.normal(size=(30, 50)), rng.normal(size=(20, 50))
    second[:, 3] += 9
    result = probe_sets(first, second, 50, rng)
    assert result is not None
    assert result.auc > 0.95
    assert result.frames == (30, 20)


def test_sets_of_one_distribution_are_not() -> None:
    """More features than frames: without held-out frames, the probe would tell them apart perfectly."""
    rng = generator()
    result = probe_sets(rng.normal(size=(60, 200)), rng.normal(size=(60, 200)), 200, rng)
    assert result is not None
    assert 0.3 < result.auc < 0.7
    assert result.low < result.auc < result.high


def test_too_few_frames_give_no_result() -> None:
    assert probe_sets(np.zeros((4, 2)), np.ones((40, 2)), 10, generator()) is None
