"""Figures of the yardstick, of attempts counted by hand."""

from dataclasses import replace

import pytest

from drivesem.bench.session import BenchTable, build_terminal_table
from tools.bench.planted.summary import kind_columns, kind_rows, method_rows
from tools.bench.planted.yardstick import NO_FAULT, FaultSearch, FrameSearches

FIRST = FaultSearch("a", "aspect easy", "easy", "aspect=1:2", 0.2, 0.1, "halton", 3, 2, 1, 50, 4.0)


def frames() -> list[FrameSearches]:
    other = replace(FIRST, method="climb", certain=1, found=1, inside=1, passes=100)
    rare = replace(FIRST, kind="contrast rare", rarity="rare", fault="contrast=0.1:0.2", found=0, inside=0)
    return [
        FrameSearches("a", (FIRST, other), ("contrast rare",)),
        FrameSearches(
            "b", (replace(FIRST, frame="b", found=0, inside=0), replace(other, frame="b", found=3), rare), ()
        ),
    ]


def test_found_for_each_hundred_passes() -> None:
    rows = {(row["method"], row["rarity"]): row for row in method_rows(frames(), ("halton", "climb"), 0)}
    halton, climb = rows["halton", "easy"], rows["climb", "easy"]
    assert (halton["found"], halton["faults"], halton["reached"]) == (2, 2, 1)
    assert halton["found_per_100"] == pytest.approx(2.0)
    assert (halton["low"], halton["high"]) == pytest.approx((0.0, 4.0))
    assert climb["found_per_100"] == pytest.approx(2.0)
    assert climb["inside_share"] == pytest.approx(0.5)
    assert rows["halton", "rare"]["found_per_100"] == 0
    assert rows["halton", "rare"]["frames"] == 1
    assert ("climb", "rare") not in rows, "nobody asked it"


def test_kinds_tell_in_how_many_frames_they_could_be_planted() -> None:
    rows = {row["kind"]: row for row in kind_rows(frames(), ("halton", "climb"))}
    assert rows["aspect easy"]["planted"] == 2
    assert (rows["aspect easy"]["reached_halton"], rows["aspect easy"]["reached_climb"]) == (1, 2)
    assert (rows["contrast rare"]["frames"], rows["contrast rare"]["planted"]) == (2, 1)
    section = BenchTable("kinds", kind_columns(("halton", "climb")), list(rows.values()))
    assert build_terminal_table(section).row_count == 2


def test_names_are_counted_where_somebody_asked() -> None:
    told = replace(FIRST, rule="aspect 1 to 2", named=True, in_part=True, naming=90)
    anywhere = replace(FIRST, frame="b", rule="anywhere", naming=90)
    none = replace(FIRST, kind=NO_FAULT, rarity=NO_FAULT, fault="", rule="moved_m 0 to 1", naming=90)
    judged = [FrameSearches("a", (told, none), ()), FrameSearches("b", (anywhere,), ())]
    easy, control = method_rows(judged, ("halton",), 0)
    assert (easy["explained"], easy["with_rule"], easy["named"], easy["in_part"], easy["naming"]) == (
        2,
        1,
        1,
        1,
        180,
    )
    assert (control["rarity"], control["with_rule"], control["named"]) == (NO_FAULT, 1, 0)
    assert {row["kind"] for row in kind_rows(judged, ("halton",))} == {"aspect easy"}


def test_what_was_judged_comes_back_from_json() -> None:
    for judged in frames():
        assert FrameSearches.of_json(judged.to_json()) == judged
