"""Accuracies by class and overall, pictures that keep shares, and whether an order is the paper's."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivesem.classify.objects.types import CLASSES
from drivesem.evaluation.resampling import Interval
from tools.experiments.classification.paper import paper_tables
from tools.experiments.classification.results import Predictions, RatioBootstrap, sample_stratified
from tools.experiments.classification.tables import _judge_order

DRAWING = RatioBootstrap(50, 0)


def answers(right, label, unit=None):
    unit = np.arange(len(right)) if unit is None else np.array(unit)
    return Predictions(np.array(right, bool), np.array(label), unit)


def test_overall_is_weighed_by_class_sizes():
    found = answers([1, 1, 1, 0, 0, 1], [0, 0, 0, 0, 1, 1])
    assert found.by_class(3) == [0.75, 0.5, None]
    assert found.overall(DRAWING).value == pytest.approx(4 / 6)  # (4 x 0.75 + 2 x 0.5) / 6
    assert found.overall(DRAWING, (1, 9, 5)).value == pytest.approx(0.1 * 0.75 + 0.9 * 0.5)


@pytest.mark.parametrize("table", ["degradation", "transfer"])
def test_the_papers_own_overall_metrics_are_weighed_by_its_sizes(table):
    sizes = np.array([counts[0] for counts in paper_tables()["sizes"].values()])
    assert tuple(paper_tables()["sizes"]) == CLASSES
    rows = [row for strategies in paper_tables()[table].values() for row in strategies.values()]
    assert len(rows) == {"degradation": 16, "transfer": 6}[table]
    for row in rows:
        assert sizes @ row[:-1] / sizes.sum() == pytest.approx(row[-1], abs=1.6e-3)


def test_objects_are_drawn_and_not_pictures():
    """Four views of each of two objects: an interval as wide as of two pictures."""
    one = answers([1, 1, 1, 1, 0, 0, 0, 0], [0] * 8, [7, 7, 7, 7, 3, 3, 3, 3]).overall(DRAWING)
    assert (one.low, one.value, one.high) == (0, 0.5, 1)
    assert answers([1] * 8, [0] * 8, [0] * 8).overall(RatioBootstrap(0, 0)).low is None


def test_pairs_are_compared_on_the_same_pictures():
    first, second = answers([0, 0, 1, 1], [0] * 4), answers([1, 0, 1, 1], [0] * 4)
    one = first.accuracy_drop(second, DRAWING)
    assert one.value == 0.25
    assert one.low is not None
    assert one.low >= 0


@given(st.lists(st.integers(0, 4), min_size=1, max_size=60), st.integers(1, 60), st.integers(0, 5))
def test_a_subset_is_as_large_as_requested_and_no_class_is_off_by_one(labels, size, seed):
    stored = sample_stratified(labels, size, np.random.default_rng(seed))
    assert len(stored) == len(set(stored)) == min(size, len(labels))
    for label in set(labels):
        share = min(size, len(labels)) * labels.count(label) / len(labels)
        assert abs(sum(labels[i] == label for i in stored) - share) < 1


@pytest.mark.parametrize(
    ("theirs", "value", "low", "high", "output"),
    [
        (0.1, 0.2, 0.1, 0.3, "holds"),
        (-0.1, 0.2, 0.1, 0.3, "reversed"),
        (-0.1, -0.2, -0.3, -0.1, "holds"),
        (0.1, 0.2, -0.1, 0.3, "undecided"),
        (0.1, None, None, None, "undecided"),
    ],
)
def test_verdict(theirs, value, low, high, output):
    assert _judge_order(theirs, Interval("x", value, low, high)) == output
