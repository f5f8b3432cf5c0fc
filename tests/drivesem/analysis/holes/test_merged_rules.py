"""Holes gathered over frames, from hand-made samples: what is one hole, how large it is, and in which order."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivesem.analysis.holes.rules import (
    FEATURE_TEXT,
    FailureRule,
    FailureSamples,
    FailureWithRule,
    FeatureSamples,
    Hole,
    describe_rule,
    kitti_shares,
    merge_holes,
)
from drivesem.analysis.holes.run import build_holes_report, take_in_turn
from drivesem.attacks.space import SPECS, Parameter
from drivesem.failures.failure_probability import FailureProbability
from drivesem.failures.feature_cells import Cell, CellVisit
from drivesem.failures.neighbourhood import IMAGE_FEATURES, POSE_FEATURES
from drivesem.failures.rules import fit_rule
from drivesem.run.feature_map import FailureMap

NAMES = ("height_px", "lightness")
NOTHING = FeatureSamples((), (), ())


def samples(height: list[float], fails: list[bool]) -> FeatureSamples:
    return FeatureSamples(NAMES, tuple((h, 0.5) for h in height), tuple(-1.0 if lost else 1.0 for lost in fails))


def merge(
    found: dict[str, list[FailureWithRule]], again: dict[tuple[str, int], FeatureSamples] | None = None
) -> list[Hole]:
    """Of failures by frame, of object after object."""
    return merge_holes({(name, i): one for name, own in found.items() for i, one in enumerate(own)}, again)


def around(
    low: float, high: float, fresh_fails: int = 9, wide: float = 100.0, label: str = "Car"
) -> FailureWithRule:
    """Fails where the height lies in a band, of 100 samples evenly from 0 to `wide`, and in some of 10 fresh."""
    heights = np.linspace(0, wide, 100).tolist()
    fresh = samples([(low + high) / 2] * 10, [i < fresh_fails for i in range(10)])
    drawn_samples = samples(heights, [low <= h <= high for h in heights])
    size = (high - low) / wide
    lost = FailureProbability(size, size / 2, size * 2, "samples", 0)
    one = FailureSamples(0, label, "missed", "certain", drawn_samples, NOTHING, lost)
    return FailureWithRule(one, FailureRule({"height_px": (low, high)}, False), fresh)


def test_bands_that_overlap_are_one_hole() -> None:
    (hole,) = merge({"000001": [around(20, 40)], "000002": [around(22, 42, fresh_fails=7)]})
    assert hole.where["height_px"] == pytest.approx((21, 41))
    assert [(one.frame, one.object, one.kind, one.grade) for one in hole.failures] == [
        ("000001", 0, "missed", "certain"),
        ("000002", 0, "missed", "certain"),
    ]
    assert hole.frames == ("000001", "000002")
    assert hole.count == 20
    assert hole.probability == pytest.approx(16 / 20)
    assert hole.low is not None
    assert hole.high is not None
    assert hole.low < 0.8 < hole.high
    assert (hole.lost.probability, hole.lost.low, hole.lost.high) == pytest.approx((0.2, 0.1, 0.4))
    assert hole.outside is not None
    assert 0 < hole.outside < 0.03


def test_a_rule_of_many_stays_as_it_is() -> None:
    """What is much like it joins it, and does not move its bounds."""
    one = around(22, 42)
    pooled = replace(one, rule=FailureRule({"height_px": (20.0, 45.0)}, True))
    (hole,) = merge({"a": [around(25, 45)], "b": [pooled], "c": [pooled]})
    assert hole.where == {"height_px": (20.0, 45.0)}
    assert hole.pooled
    assert hole.to_json()["pooled"]
    assert len(hole.failures) == 3
    assert hole.frames == ("b", "c", "a")


def test_other_bands_and_classes_are_others() -> None:
    found = {"a": [around(20, 40), around(60, 70)], "b": [around(20, 40, label="Van")]}
    assert len(merge(found)) == 3


def test_the_largest_first_and_copies_last() -> None:
    found = {"a": [around(0, 50)], "b": [around(60, 95)], "c": [around(10, 20, label="Van")]}
    order = [(hole.label, hole.rule_text) for hole in merge(found)]
    assert order == [
        ("Car", "height in the picture 0 to 50 px"),
        ("Van", "height in the picture 10 to 20 px"),
        ("Car", "height in the picture 60 to 95 px"),
    ]


def test_a_rule_of_nothing_is_the_whole_neighbourhood() -> None:
    four = samples([1, 2, 3, 4], [True, True, False, True])
    lost = FailureProbability(0.75, 0.3, 0.95, "samples", 0)
    one = FailureWithRule(
        FailureSamples(0, "Car", "missed", "certain", four, NOTHING, lost), FailureRule({}, False), NOTHING
    )
    (hole,) = merge({"a": [one]})
    assert (hole.rule_text, hole.probability, hole.outside, hole.lost) == (
        "no rule found; 30 to 95 % everywhere",
        None,
        None,
        lost,
    )


def test_a_rule_is_not_printed_where_its_intervals_overlap() -> None:
    """Of 10 fresh samples 5 are lost, of 80 outside 38: chance may explain the difference."""
    one = around(20, 40, fresh_fails=5)
    heights = np.linspace(0, 100, 100)
    even = samples(heights.tolist(), [i % 2 == 0 for i in range(100)])
    one = replace(
        one, failure=replace(one.failure, samples=even, lost=FailureProbability(0.5, 0.4, 0.6, "samples", 0))
    )
    (hole,) = merge({"a": [one]})
    assert (hole.where, hole.rule_text) == ({}, "no rule found; 40 to 60 % everywhere")
    assert (hole.probability, hole.outside) == (None, None)


def test_every_feature_has_words() -> None:
    codes = [name for p in ("color", "weather", "foliage", "sun", "lamps") for name in SPECS[Parameter(p)].names]
    assert {*IMAGE_FEATURES, *POSE_FEATURES, "moved_m", "grown_percent", *codes} == set(FEATURE_TEXT)
    assert describe_rule({"paint.b": (0.344, 0.993), "distance_m": (8.0, 12.5)}) == (
        "paint, -1 bluer to 1 yellower: 0.344 to 0.993; nearer to further: 8 to 12.5 m"
    )


def drawn(rng: np.random.Generator, count: int, low: float = 0.0, high: float = 100.0) -> FeatureSamples:
    """Of a field in which an object is lost in 70 % of the states of heights from 30 to 60, and in 5 % else."""
    heights = rng.uniform(low, high, count)
    lost = rng.random(count) < np.where((heights > 30) & (heights < 60), 0.7, 0.05)
    return samples(heights.tolist(), lost.tolist())


@pytest.fixture(scope="module")
def fields() -> list[tuple[FailureWithRule, FeatureSamples]]:
    """Rules of that field from samples, fresh ones inside of each, and those of a recheck."""
    found = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        drawn_samples = drawn(rng, 96)
        where = fit_rule(drawn_samples.columns(), drawn_samples.failing).intervals
        low, high = where.get("height_px", (0.0, 100.0))
        plain = around(30, 60)
        own = replace(plain.failure, samples=drawn_samples)
        one = FailureWithRule(own, FailureRule(where, False), drawn(rng, 32, low, high))
        found.append((one, drawn(rng, 150, low, high)))
    return found


def test_a_probability_that_was_held_against_fresh_samples_holds(
    fields: list[tuple[FailureWithRule, FeatureSamples]],
) -> None:
    held = 0
    for one, again in fields:
        (hole,) = merge({"a": [one]}, {("a", 0): again})
        assert hole.recheck is not None
        recheck = hole.recheck.to_json()
        assert (recheck["draws"], recheck["failures"]) == (150, int(again.failing.sum()))
        assert recheck["probability"] == recheck["failures"] / 150
        assert recheck["interval"][0] < recheck["probability"] < recheck["interval"][1]
        assert recheck["holds"] == (recheck["difference"][0] <= 0 <= recheck["difference"][1])
        held += recheck["holds"]
    assert 0.92 <= held / len(fields) <= 0.99  # 95 %: chance alone makes some that do not


def test_a_probability_of_another_place_does_not(fields: list[tuple[FailureWithRule, FeatureSamples]]) -> None:
    """What is stated of samples anywhere, of which a third or so lie where the object is lost."""
    held = 0
    for one, again in fields:
        drawn_samples = one.failure.samples
        anywhere = replace(
            drawn_samples, values=tuple((one.rule.where["height_px"][0], 0.5) for _ in drawn_samples.values)
        )
        (hole,) = merge({"a": [replace(one, fresh=anywhere)]}, {("a", 0): again})
        held += hole.recheck is not None and hole.recheck.holds  # most rules separate nothing, and are not printed
    assert held / len(fields) < 0.05


def test_a_recheck_covers_the_whole_region() -> None:
    """Of a hole of two failures, draws of both count where they lie inside of the rule that is recheck."""
    again = {("a", 0): samples([21.0, 30.0, 39.0], [True] * 3), ("b", 0): samples([25.0, 41.9], [False] * 2)}
    (hole,) = merge({"a": [around(20, 40)], "b": [around(22, 42)]}, again)
    assert hole.recheck is not None
    assert hole.recheck.again == (3, 4)
    assert hole.recheck.stated == (18, 20)


def test_nothing_to_check() -> None:
    (plain,) = merge({"a": [around(20, 40)]})
    assert plain.to_json()["recheck"] is None
    (unsaid,) = merge({"a": [replace(around(20, 40), fresh=NOTHING)]}, {("a", 0): samples([30.0], [True])})
    assert (unsaid.probability, unsaid.recheck) == (None, None)


def test_kitti_knows_some_features() -> None:
    assert kitti_shares({"lightness": (0.0, 0.5)}) == {}
    assert kitti_shares({"distance_m": (0.0, 80.0)})["distance_m"] == pytest.approx(1.0)
    near, far = kitti_shares({"distance_m": (5.0, 25.0)}), kitti_shares({"distance_m": (60.0, 80.0)})
    assert near["distance_m"] > 4 * far["distance_m"] > 0
    assert kitti_shares({"yaw_deg": (-180.0, 180.0)})["yaw_deg"] == pytest.approx(1.0, abs=0.02)


def test_sizes_by_samples_and_by_simulation() -> None:
    one = around(22, 42)
    rare = replace(
        one, failure=replace(one.failure, lost=FailureProbability(0.01, 0.002, 0.05, "subset simulation", 90))
    )
    (hole,) = merge({"a": [around(20, 40), rare]})
    size = hole.to_json()["size"]
    assert [size["probability"], *size["interval"]] == pytest.approx([0.105, 0.051, 0.225])
    assert (size["by"], hole.lost.extra_samples) == ("samples and subset simulation", 90)


def test_failures_are_taken_in_turn_from_cells() -> None:
    """Five hundred of one fog are one finding: two failures cover two cells, whichever frames they are of."""
    foggy = [(f"{number:03}", 0) for number in range(500)]
    cells = dict.fromkeys(foggy, "fog") | {("900", 1): "near", ("901", 0): "near", ("902", 3): "far"}
    failures = [*foggy, ("900", 1), ("901", 0), ("902", 3), ("old", 2)]
    order = take_in_turn(failures, cells)
    assert order[:6] == [("000", 0), ("900", 1), ("902", 3), ("old", 2), ("001", 0), ("901", 0)]
    assert sorted(order) == sorted(failures)
    assert order[6:] == foggy[2:]


def test_the_report_names_cells_with_a_rule_and_those_without(tmp_path: Path) -> None:
    """A rule for one failure, none for a second, and a third and fourth that were not sampled."""
    places: list[Cell] = [(0, 0, 0, 1), (0, 0, 1, 1), (0, 0, 2, 1), (0, 0, 2, 1)]
    visits = [(str(i), [CellVisit(0, cell, 1, 1, final=True)], {0}) for i, cell in enumerate(places)]
    failing = FailureMap.from_frames([*visits, ("old", [], {0})])
    names = list(dict.fromkeys(failing.cells_by_failure().values()))
    even = replace(around(20, 40), rule=FailureRule({}, False), fresh=NOTHING, cell=names[1])
    holes = merge({"0": [replace(around(20, 40), cell=names[0])], "1": [even]})
    report = build_holes_report(tmp_path, holes, failing, {"detector": "any", "params": "color"}, {})
    numbers = [number for number, hole in enumerate(holes) if hole.where]
    assert report.data["map"] == {
        "cells": [
            {"cell": names[0], "certain": 1, "sampled": 1, "holes": numbers},
            {"cell": names[1], "certain": 1, "sampled": 1, "holes": []},
            {"cell": names[2], "certain": 2, "sampled": 0, "holes": []},
        ],
        "frames_without_record": 1,
    }
    hole = report.data["holes"][numbers[0]]
    assert (hole["cells"], hole["failures"][0]["cell"]) == ([names[0]], names[0])
    page = report.to_markdown()
    assert f"| {names[0]} | 1 | 1 | height in the picture 20 to 40 px |" in page
    assert f"| {names[1]} | 1 | 1 | no rule found |" in page
    assert f"| {names[2]} | 2 | 0 | not sampled |" in page
    assert "2 of 4 certain failures were sampled around" in page
    assert "Rules for 1 of 3 failing cells." in page
    assert "1 frame without a record of the search: in no cell." in page
