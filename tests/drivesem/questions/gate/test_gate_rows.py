"""Rows of the gate from hand-made pairs: shares, intervals, what grew, XML."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import pytest

from drivesem.questions.gate.report import junit
from drivesem.questions.gate.results import Pair
from drivesem.questions.gate.rows import ALL, HOLE, KIND, PHANTOMS, rows_of

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
) -> Pair:
    """The new detector fails in the samples in which the old one does, and in more or in fewer."""
    return Pair(index, "Car", error, *(first(count, of) for count in (before, after, *phantoms)))


def rows(found, tolerance: float = 0.05):
    return rows_of(found, tolerance, DRAWS, 0)


def test_shares_and_order() -> None:
    found = {"a": [pair(10, 10), pair(4, 14, index=1)], "b": [pair(10, 5, error="placed")]}
    told = rows(found)
    assert [(row.level, row.hole) for row in told] == [
        (HOLE, "a: objects[1]"),
        (HOLE, "a: objects[0]"),
        (HOLE, "b: objects[0]"),
        (KIND, "missed"),
        (KIND, "placed"),
        (ALL, ALL),
        (PHANTOMS, PHANTOMS),
    ]
    most, whole = told[0], told[-2]
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
    told = rows({"a": [pair(10, 9, phantoms=(2, 12))], "b": [pair(3, 3, phantoms=(0, 9))]})
    assert [row.hole for row in told if row.grew] == [PHANTOMS]
    row = told[-1]
    assert (row.before, row.after, row.samples, row.holes) == pytest.approx((2 / 40, 21 / 40, 40, 2))
    case = ET.fromstring(junit(told)).find(f"testcase[@name='{PHANTOMS}']/failure")
    assert case is not None
    assert case.attrib["message"] == "phantoms in 5.0 % before, 52.5 % after"


def test_pairing_counts() -> None:
    """Both fail half of the time, the one where the other does not: as often, so nothing grew, but not alike."""
    even, never = tuple(i % 2 == 0 for i in range(20)), (False,) * 20
    opposite = Pair(0, "Car", "missed", even, tuple(not one for one in even), never, never)
    alike, other = rows({"a": [pair(10, 10)]})[0], rows({"a": [opposite]})[0]
    assert alike.low == alike.high == 0
    assert other.low is not None
    assert other.high is not None
    assert other.low < -0.2 < 0.2 < other.high
    assert not other.grew


def test_without_failures_there_is_nothing_to_say() -> None:
    assert rows({}) == []
    assert rows({"a": [Pair(0, "Car", "missed", (), (), (), ())]}) == []
    assert ET.fromstring(junit([])).attrib["tests"] == "0"


def test_junit() -> None:
    told = rows({"a<b>": [pair(4, 14)], "c": [pair(5, 5)]})
    suite = ET.fromstring(junit(told))
    assert (suite.attrib["tests"], suite.attrib["failures"]) == (str(len(told)), str(sum(r.grew for r in told)))
    cases = {case.attrib["name"]: case for case in suite}
    failure = cases["a<b>: objects[0]"].find("failure")
    assert failure is not None
    assert failure.attrib["message"] == "lost 20.0 % before, 70.0 % after"
    assert cases["c: objects[0]"].find("failure") is None
