"""Holes gathered over frames, from hand-made samples: what is one hole, how large it is, and in which order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivesem.questions.holes.merged import merged, of_kitti
from drivesem.questions.holes.results import Around, Samples
from drivesem.truth.rare import Share

NAMES = ("height_px", "lightness")
NOTHING = Samples((), (), ())


def samples(height: list[float], fails: list[bool]) -> Samples:
    return Samples(NAMES, tuple((h, 0.5) for h in height), tuple(-1.0 if lost else 1.0 for lost in fails))


def around(low: float, high: float, fresh_fails: int = 9, wide: float = 100.0, label: str = "Car") -> Around:
    """Fails where the height lies in a band, of 100 samples evenly from 0 to `wide`, and in some of 10 fresh."""
    heights = np.linspace(0, wide, 100).tolist()
    fresh = samples([(low + high) / 2] * 10, [i < fresh_fails for i in range(10)])
    asked = samples(heights, [low <= h <= high for h in heights])
    size = (high - low) / wide
    lost = Share(size, size / 2, size * 2, "samples", 0)
    return Around(0, label, "missed", "certain", asked, NOTHING, {"height_px": (low, high)}, fresh, lost)


def test_bands_that_overlap_are_one_hole() -> None:
    (hole,) = merged({"000001": [around(20, 40)], "000002": [around(22, 42, fresh_fails=7)]})
    assert hole.where["height_px"] == pytest.approx((21, 41))
    assert (hole.failures, hole.frames) == (("000001: objects[0]", "000002: objects[0]"), ("000001", "000002"))
    assert hole.count == 20
    assert hole.probability == pytest.approx(16 / 20)
    assert hole.low is not None
    assert hole.high is not None
    assert hole.low < 0.8 < hole.high
    assert (hole.lost.probability, hole.lost.low, hole.lost.high) == pytest.approx((0.2, 0.1, 0.4))
    assert hole.outside is not None
    assert 0 < hole.outside < 0.03


def test_other_bands_and_classes_are_others() -> None:
    found = {"a": [around(20, 40), around(60, 70)], "b": [around(20, 40, label="Van")]}
    assert len(merged(found)) == 3


def test_the_largest_first_and_copies_last() -> None:
    found = {"a": [around(0, 50)], "b": [around(60, 95)], "c": [around(10, 20, label="Van")]}
    order = [(hole.label, hole.words) for hole in merged(found)]
    assert order == [("Car", "height_px 0 to 50"), ("Van", "height_px 10 to 20"), ("Car", "height_px 60 to 95")]


def test_a_rule_of_nothing_is_the_whole_neighbourhood() -> None:
    four = samples([1, 2, 3, 4], [True, True, False, True])
    lost = Share(0.75, 0.3, 0.95, "samples", 0)
    one = Around(0, "Car", "missed", "certain", four, NOTHING, {}, NOTHING, lost)
    (hole,) = merged({"a": [one]})
    assert (hole.words, hole.probability, hole.outside, hole.lost) == ("anywhere", None, None, lost)


def test_kitti_knows_some_features() -> None:
    assert of_kitti({"lightness": (0.0, 0.5)}) == {}
    assert of_kitti({"distance_m": (0.0, 80.0)})["distance_m"] == pytest.approx(1.0)
    near, far = of_kitti({"distance_m": (5.0, 25.0)}), of_kitti({"distance_m": (60.0, 80.0)})
    assert near["distance_m"] > 4 * far["distance_m"] > 0
    assert of_kitti({"yaw_deg": (-180.0, 180.0)})["yaw_deg"] == pytest.approx(1.0, abs=0.02)


def test_sizes_by_samples_and_by_simulation_are_told_together() -> None:
    rare = replace(around(22, 42), lost=Share(0.01, 0.002, 0.05, "subset simulation", 90))
    (hole,) = merged({"a": [around(20, 40), rare]})
    size = hole.to_json()["size"]
    assert [size["probability"], *size["interval"]] == pytest.approx([0.105, 0.051, 0.225])
    assert (size["by"], hole.lost.asked) == ("samples and subset simulation", 90)
