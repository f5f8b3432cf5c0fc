"""Rows of the gate from hand-made pairs: shares, intervals, what grew and how often by chance; verdict, XML."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from drivesem.analysis.gate import (
    ALL,
    CELL,
    HOLE,
    KIND,
    PHANTOMS,
    GateFacts,
    PairedSamples,
    build_gate_report,
    compute_gate_rows,
    format_junit,
)

DRAWS = 200


def first(count: int, of: int) -> tuple[bool, ...]:
    return tuple(i < count for i in range(of))


def pair(
    before: int,
    after: int,
    of: int = 20,
    error: str = "missed",
    index: int = 0,
    phantoms: tuple[int, int] = (0, 0),
) -> PairedSamples:
    """The new detector fails in the samples in which the old one does, and in more or in fewer."""
    old, new, old_phantoms, new_phantoms = (first(count, of) for count in (before, after, *phantoms))
    return PairedSamples(index, "Car", error, old, new, old_phantoms, new_phantoms)


def rows(found, tolerance: float = 0.05, cells: dict[tuple[str, int], str] | None = None):
    return compute_gate_rows(found, tolerance, DRAWS, 0, cells or {})


def test_shares_and_order() -> None:
    found = {"a": [pair(10, 10), pair(4, 14, index=1)], "b": [pair(10, 5, error="placed")]}
    compared = rows(found)
    assert [(row.level, row.hole) for row in compared] == [
        (HOLE, "a: objects[1]"),
        (HOLE, "a: objects[0]"),
        (HOLE, "b: objects[0]"),
        (KIND, "missed"),
        (KIND, "placed"),
        (ALL, ALL),
        (PHANTOMS, PHANTOMS),
    ]
    most, whole = compared[0], compared[-2]
    assert (most.before, most.after, most.difference) == pytest.approx((0.2, 0.7, 0.5))
    assert (whole.before, whole.after, whole.samples, whole.holes) == pytest.approx((24 / 60, 29 / 60, 60, 3))


def test_what_grew_is_beyond_the_tolerance_and_beyond_chance() -> None:
    assert not any(row.grew for row in rows({"a": [pair(10, 10)]}))
    assert rows({"a": [pair(4, 14)]})[0].grew
    assert not rows({"a": [pair(4, 14)]}, tolerance=0.6)[0].grew
    # One sample of 20 is above the tolerance, and may be chance.
    one = rows({"a": [pair(10, 12)]})[0]
    assert one.difference == pytest.approx(0.1)
    assert one.low == pytest.approx(0.0)
    assert not one.grew
    # Better never fails.
    assert not any(row.grew for row in rows({"a": [pair(14, 4), pair(20, 0, index=1)]}))


def test_phantoms_are_a_row_of_their_own() -> None:
    """Of all samples, whether the object is lost there or not; they alone may fail a gate."""
    compared = rows({"a": [pair(10, 9, phantoms=(2, 12))], "b": [pair(3, 3, phantoms=(0, 9))]})
    assert [row.hole for row in compared if row.grew] == [PHANTOMS]
    row = compared[-1]
    assert (row.before, row.after, row.samples, row.holes) == pytest.approx((2 / 40, 21 / 40, 40, 2))
    case = ET.fromstring(format_junit(compared, {})).find(f"testcase[@name='{PHANTOMS}']/failure")
    assert case is not None
    assert case.attrib["message"] == "phantoms in 5.0 % before, 52.5 % after"


def test_pairing_counts() -> None:
    """Both fail half of the time, the one where the other does not: as often, so nothing grew, but not alike."""
    even, never = tuple(i % 2 == 0 for i in range(20)), (False,) * 20
    opposite = PairedSamples(0, "Car", "missed", even, tuple(not one for one in even), never, never)
    alike, other = rows({"a": [pair(10, 10)]})[0], rows({"a": [opposite]})[0]
    assert alike.low == alike.high == 0
    assert other.low is not None
    assert other.high is not None
    assert other.low < -0.2 < 0.2 < other.high
    assert not other.grew


def test_p_is_of_samples_in_which_one_fails_alone() -> None:
    """Ten of them, all of the new detector. A kind of one hole, and all of one kind, are no further test."""
    hole, kind, whole, phantoms = rows({"a": [pair(4, 14)]})
    assert (hole.p, kind.p, whole.p, phantoms.p) == pytest.approx((2**-9, 2**-9, 2**-9, 1))
    # Two holes and phantoms: three tests, and all of both holes a fourth.
    compared = {row.hole: row.p for row in rows({"a": [pair(4, 14)], "b": [pair(9, 9)]})}
    assert compared["a: objects[0]"] == compared["missed"] == compared[ALL] == pytest.approx(4 * 2**-10)
    assert compared["b: objects[0]"] == 1


def test_a_cell_has_the_samples_around_its_failures() -> None:
    """Of four failures one lies in no cell, as its frame has no record of the search."""
    found = {"a": [pair(4, 14), pair(10, 10, index=1)], "b": [pair(16, 2)], "c": [pair(5, 5, index=7)]}
    cells = {("a", 0): "near", ("b", 0): "far", ("a", 1): "near"}
    compared = {row.hole: row for row in rows(found, cells=cells) if row.level == CELL}
    assert list(compared) == ["near", "far"]
    near, far = compared["near"], compared["far"]
    assert (near.before, near.after, near.samples, near.holes) == pytest.approx((14 / 40, 24 / 40, 40, 2))
    assert (far.before, far.after, far.samples, far.holes) == pytest.approx((0.8, 0.1, 20, 1))
    assert (near.change, far.change) == (
        "unclear",
        "fell",
    )  # one hole alone grew: the interval over both contains 0
    assert [row.level for row in rows(found, cells=cells)][3:6] == [HOLE, CELL, CELL]


def test_cells_of_several_holes_are_further_tests() -> None:
    """Three holes, all of them and phantoms: five tests. A cell of two holes is a sixth, one of one hole is none."""
    found = {"a": [pair(4, 14)], "b": [pair(9, 9)], "c": [pair(9, 9)]}
    for cells, tests in (
        ({}, 5),
        ({("c", 0): "far"}, 5),
        ({("a", 0): "near", ("b", 0): "near"}, 6),
        ({("a", 0): "near", ("b", 0): "near", ("c", 0): "far"}, 6),
        ({("a", 0): "near", ("b", 0): "near", ("c", 0): "near"}, 5),
    ):
        compared = {row.hole: row.p for row in rows(found, cells=cells)}
        assert compared["a: objects[0]"] == pytest.approx(tests * 2**-10)


def test_what_fell_is_beyond_chance_too() -> None:
    assert [row.change for row in rows({"a": [pair(14, 4)]})] == ["fell", "fell", "fell", "same"]
    assert {row.change for row in rows({"a": [pair(14, 4)]}, tolerance=0.8)} == {"same"}
    assert rows({"a": [pair(14, 4)]}, tolerance=0.6)[0].change == "unclear"
    # Six of six samples: p is 2**-6 of one test, and above 0.05 of the five of three holes.
    assert rows({"a": [pair(9, 3)]})[0].change == "fell"
    three = rows({"a": [pair(9, 3)], "b": [pair(9, 9)], "c": [pair(9, 9)]})
    assert [row.change for row in three] == ["same", "same", "unclear", "unclear", "unclear", "same"]
    assert not any(row.change == "fell" for row in rows({"a": [pair(4, 14)]}))


def test_one_sample_is_no_evidence() -> None:
    compared = rows({"a": [pair(0, 1, of=1)]})
    assert (compared[0].difference, compared[0].low) == (1, None)
    assert not any(row.grew for row in compared)


def seen(
    holes: int, samples: int, new_alone: float, old_alone: float, seed: int
) -> dict[str, list[PairedSamples]]:
    """Holes in which one half of the samples is lost, and in so large shares of all by one detector alone."""
    rng = np.random.default_rng(seed)
    found = []
    for index in range(holes):
        lot, lost = rng.random(samples), rng.random(samples) < 0.5
        new, old = lot < new_alone, lot > 1 - old_alone
        before, after = (lost | old) & ~new, (lost | new) & ~old
        found.append(PairedSamples(index, "Car", "missed", *(tuple(one.tolist()) for one in (before, after))))
    return {"a": found}


def share_not_passed(holes: int, samples: int, new_alone: float, old_alone: float, of: int) -> float:
    compared = (
        compute_gate_rows(seen(holes, samples, new_alone, old_alone, seed), 0.05, 40, seed) for seed in range(of)
    )
    return sum(any(row.grew for row in one) for one in compared) / of


@pytest.mark.parametrize("samples", [8, 32])
@pytest.mark.parametrize("holes", [1, 2, 3, 13])
def test_detectors_that_are_alike_pass(holes: int, samples: int) -> None:
    """Each alone loses the object in a tenth of the samples."""
    assert share_not_passed(holes, samples, 0.1, 0.1, of=80) <= 0.06


@pytest.mark.parametrize(
    ("holes", "samples", "new_alone"),
    [
        pytest.param(1, 24, 0.7, id="nearly blind, in one small hole"),
        pytest.param(3, 32, 0.3, id="in three holes"),
        pytest.param(13, 32, 0.2, id="a little worse in each of 13 holes"),
    ],
)
def test_one_that_is_worse_does_not(holes: int, samples: int, new_alone: float) -> None:
    assert share_not_passed(holes, samples, new_alone, 0.05, of=40) >= 0.95


def test_a_blind_one_does_not_pass_in_one_hole_of_24_samples() -> None:
    assert rows({"a": [pair(12, 24, of=24)]})[0].grew
    assert rows({"a": [pair(18, 24, of=24)]})[0].grew


EMPTY = {"a": [PairedSamples(0, "Car", "missed", (), ())]}


@pytest.mark.parametrize(
    ("found", "failed", "allow_empty", "passed", "reason"),
    [
        pytest.param({}, {}, False, False, "none in 3 frames", id="no certain failure"),
        pytest.param({}, {}, True, True, "none in 3 frames", id="no certain failure, allowed"),
        pytest.param({}, {"a": "no scene"}, True, False, "", id="all frames failed"),
        pytest.param({"b": [pair(5, 5)]}, {"a": "no scene"}, False, False, "", id="one of two frames failed"),
        pytest.param(EMPTY, {}, False, False, "no sample counts", id="no sample counts"),
        pytest.param(EMPTY, {}, True, False, "no sample counts", id="no sample counts, allowed"),
        pytest.param({"b": [pair(5, 5)]}, {}, False, True, "", id="nothing grew"),
        pytest.param({"b": [pair(4, 14)]}, {}, False, False, "", id="a row grew"),
    ],
)
def test_the_verdict(found, failed, allow_empty, passed, reason, tmp_path: Path) -> None:
    """A gate is passed where all that should be compared was compared, and no row grew: notes, JUnit and page agree."""
    about = {"before": "x", "after": "y", "tolerance": 0.05}
    facts = GateFacts(about, "none in 3 frames", sum(map(len, found.values())), failed, allow_empty)
    report = build_gate_report(tmp_path, rows(found), facts)
    assert report.data["passed"] == passed
    assert report.data["frames_failed"] == failed
    assert any(f"nothing was compared: {reason}" in note for note in report.notes) == bool(reason)
    assert any("could not be compared" in note for note in report.notes) == bool(failed)
    suite = ET.fromstring((tmp_path / "gate.xml").read_text())
    assert int(suite.attrib["tests"]) == len(list(suite)) > 0
    assert int(suite.attrib["errors"]) == len(failed)
    assert (suite.attrib["failures"], suite.attrib["errors"]) == ("0", "0") if passed else True
    assert passed or int(suite.attrib["failures"]) + int(suite.attrib["errors"]) > 0
    assert suite.attrib["skipped"] == str(int(passed and bool(reason)))
    errors = {case.attrib["name"]: case.find("error") for case in suite}
    assert {name: one.attrib["message"] for name, one in errors.items() if one is not None} == failed
    page = (tmp_path / "gate.html").read_text()
    assert ("Gate passed" in page, "Gate not passed" in page) == (passed, not passed)


def test_each_case_has_its_numbers_passed_or_not(tmp_path: Path) -> None:
    compared = rows({"a": [pair(4, 14)], "c": [pair(5, 5)]})
    build_gate_report(
        tmp_path, compared, GateFacts({"before": "x", "after": "y", "tolerance": 0.05}, "two", 2, {})
    )
    page = (tmp_path / "gate.html").read_text()
    cases = {case.attrib["name"]: case for case in ET.fromstring((tmp_path / "gate.xml").read_text())}
    assert len(cases) == len(compared)
    expected = {
        "a: objects[0]": "lost in 4 of 20 samples by the current detector, in 14 by the new one; difference +50.0 [",
        "c: objects[0]": "lost in 5 of 20 samples by the current detector, in 5 by the new one; difference +0.0 [",
    }
    for name, text in expected.items():
        assert (cases[name].findtext("system-out") or "").startswith(text)
        assert text in page


def test_without_failures_there_are_no_rows() -> None:
    assert rows({}) == []
    assert rows({"a": [PairedSamples(0, "Car", "missed", (), (), (), ())]}) == []


def test_junit() -> None:
    compared = rows({"a<b>": [pair(4, 14)], "c": [pair(5, 5)]})
    suite = ET.fromstring(format_junit(compared, {}))
    assert (suite.attrib["tests"], suite.attrib["failures"]) == (
        str(len(compared)),
        str(sum(r.grew for r in compared)),
    )
    cases = {case.attrib["name"]: case for case in suite}
    failure = cases["a<b>: objects[0]"].find("failure")
    assert failure is not None
    assert failure.attrib["message"] == "lost 20.0 % before, 70.0 % after"
    assert cases["c: objects[0]"].find("failure") is None
