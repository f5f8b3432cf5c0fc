"""Recall by condition, at equal box heights."""

from __future__ import annotations

import numpy as np
import pytest

from drivesem.evaluation.conditions import DetectedObjects, group_frames, recall_by_condition


def test_frames_are_grouped_by_values() -> None:
    attributes = [{"weather": "clear", "timeofday": "night"}, {"weather": "rainy"}, {"weather": "clear"}]
    groups = group_frames(attributes, ["weather", "timeofday"])
    assert {name: rows.tolist() for name, rows in groups.items()} == {
        "clear, night": [0],
        "clear, unknown": [2],
        "rainy, unknown": [1],
    }
    assert list(group_frames(attributes, ["weather"])) == ["clear", "rainy"]


def test_equal_heights_undo_a_difference_of_sizes() -> None:
    """Small objects are found in one of four, large ones in three of four, in both conditions."""
    small_hits, large_hits = [True, False, False, False], [True, True, True, False]
    frame = np.repeat([0, 1], [12, 12])  # by day 8 small and 4 large objects, in fog 4 small and 8 large ones
    height = np.concatenate([np.full(8, 20.0), np.full(4, 80.0), np.full(4, 20.0), np.full(8, 80.0)])
    hit = np.array([*small_hits * 2, *large_hits, *small_hits, *large_hits * 2])
    day, fog = recall_by_condition(
        DetectedObjects(frame, height, hit),
        2,
        {"day": np.array([0]), "fog": np.array([1])},
        "day",
        0,
        np.random.default_rng(0),
    )
    assert (day.objects, day.recall, day.equal_recall) == (12, 5 / 12, pytest.approx(5 / 12))
    assert (fog.recall, fog.equal_recall) == (7 / 12, pytest.approx(5 / 12))
    assert (fog.covered, fog.median_height, fog.low) == (1.0, 80.0, None)


def test_heights_that_do_not_occur_are_left_out() -> None:
    objects = DetectedObjects(np.array([0, 0, 1]), np.array([20.0, 80.0, 80.0]), np.array([False, True, True]))
    groups = {"day": np.array([0]), "fog": np.array([1]), "empty": np.array([2])}
    _, fog, empty = recall_by_condition(objects, 3, groups, "day", 20, np.random.default_rng(0))
    assert (fog.equal_recall, fog.covered, fog.low, fog.equal_low) == (1.0, 0.5, None, None)
    assert (empty.objects, empty.recall, empty.equal_recall, empty.covered) == (0, None, None, None)


def test_intervals_cover_the_value_and_shrink_with_frames() -> None:
    generator = np.random.default_rng(1)
    widths = []
    for frames in (20, 400):
        objects = DetectedObjects(np.arange(frames), np.full(frames, 40.0), generator.random(frames) < 0.6)
        (row,) = recall_by_condition(objects, frames, {"all": np.arange(frames)}, "all", 300, generator)
        assert None not in (row.low, row.recall, row.high)
        assert row.low <= row.recall <= row.high  # pyright: ignore[reportOptionalOperand]
        widths.append(row.high - row.low)  # pyright: ignore[reportOptionalOperand]
    assert widths[1] == pytest.approx(2 * 1.96 * np.sqrt(0.24 / 400), rel=0.2)
    assert widths[0] > 3 * widths[1]
