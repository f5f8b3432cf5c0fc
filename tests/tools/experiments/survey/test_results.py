"""Krippendorff's alpha: his own example, bounds, and what leaves it undefined."""

import pytest

from tools.experiments.survey.results import interval_distance, krippendorff_alpha, nominal_distance

# Four observers, twelve units, 0 where one said nothing (Krippendorff, Computing ... Alpha-Reliability, 2011).
EXAMPLE = (
    (1, 2, 3, 3, 2, 1, 4, 1, 2, 0, 0, 0),
    (1, 2, 3, 3, 2, 2, 4, 1, 2, 5, 0, 3),
    (0, 3, 3, 3, 2, 3, 4, 2, 2, 5, 1, 0),
    (1, 2, 3, 3, 2, 4, 4, 1, 2, 5, 1, 0),
)
UNITS = [[value for value in unit if value] for unit in zip(*EXAMPLE, strict=True)]


def test_the_published_example() -> None:
    assert krippendorff_alpha(UNITS, nominal_distance) == pytest.approx(0.743, abs=5e-4)
    assert krippendorff_alpha(UNITS, interval_distance) == pytest.approx(0.849, abs=5e-4)


def test_bounds() -> None:
    assert krippendorff_alpha([[1, 1], [5, 5, 5], [9, 9]], interval_distance) == 1
    # two people who always disagree: worse than chance
    worst = krippendorff_alpha([["a", "b"], ["b", "a"]], nominal_distance)
    assert worst == pytest.approx(-0.5)
    assert krippendorff_alpha([[2, 4], [4, 2], [2, 4]], interval_distance) == krippendorff_alpha(
        [[20, 40], [40, 20], [20, 40]], interval_distance
    )


def test_undefined() -> None:
    assert krippendorff_alpha([], nominal_distance) is None
    assert krippendorff_alpha([["a"], []], nominal_distance) is None
    assert krippendorff_alpha([["a", "a"], ["a", "a"]], nominal_distance) is None
