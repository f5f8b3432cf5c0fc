"""What certain failures cost, and what no method brings to fall, on hand-made frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest

from drivesem.config.commands import Study
from drivesem.failures.grades import Count, Grade, Kind
from drivesem.run.results import Failure
from tools.experiments.detection.arms import PLACEBO
from tools.experiments.detection.counts import ArmCounts, StudyCounts
from tools.experiments.detection.grades import grades_of
from tools.experiments.detection.report import Findings, notes, sheets, told
from tools.experiments.detection.rows import rows_of
from tools.experiments.detection.running import ArmRun
from tools.experiments.detection.searches import Standing, costs_of, seen_of, standing_of

DRAWS = 200
DEPTHS = {str(i): (12.0, 40.0) for i in range(4)}
"""A near car and a far one in each frame."""


def lost(index: int, grade: Grade = Grade.CERTAIN) -> Failure:
    return Failure("lost", "Car", (0.0, 0.0, 9.0, 9.0), index, None, Kind.MISSED, grade, Count(16, 16, 16, 16))


@pytest.fixture
def runs(frame, arm_run, arm) -> list[ArmRun]:
    """Four frames of two cars: the first arm loses three for certain, the second one, the placebo the far one."""

    def of(failures: Sequence[tuple[Failure, ...]], passes: int, seconds: float) -> list:
        return [replace(frame(str(i)), failures=f, passes=passes, seconds=seconds) for i, f in enumerate(failures)]

    return [
        arm_run(arm("climb"), of([(lost(0),), (lost(0), lost(1, Grade.THRESHOLD)), (lost(0),), ()], 50, 30.0)),
        arm_run(arm("halton"), of([(lost(0),), (), (), ()], 25, 15.0)),
        arm_run(arm("climb placebo", control=(PLACEBO, "climb")), of([(lost(1),), (), (), ()], 1, 5.0)),
    ]


@pytest.fixture
def counts(runs: list[ArmRun]) -> StudyCounts:
    return StudyCounts(tuple(map(ArmCounts.of, runs)), 0, {}, seen_of(runs[0], DEPTHS))


def test_certain_failures_for_passes_and_minutes(counts: StudyCounts) -> None:
    climb, halton, _ = costs_of(counts.arms, counts.seen, DRAWS, 0)
    assert climb.per_100_passes.value == pytest.approx(3 / 2)
    assert climb.per_minute.value == pytest.approx(3 / 2)
    assert halton.per_100_passes.value == pytest.approx(1.0)
    assert halton.seconds == 15.0
    assert climb.per_minute.low is not None
    assert climb.per_minute.low < 1.5


def test_the_first_arm_is_what_others_are_compared_with(counts: StudyCounts) -> None:
    climb, halton, _ = costs_of(counts.arms, counts.seen, DRAWS, 0)
    assert climb.ahead is None
    assert halton.ahead is not None
    assert halton.ahead.difference == pytest.approx((3 - 1) / 8)
    assert halton.ahead.low is not None
    assert halton.ahead.low >= 0


def test_what_stands_by_size_and_distance(counts: StudyCounts) -> None:
    classes = {one.name: one for one in standing_of(counts.arms, counts.seen)}
    assert (classes["all"].objects, classes["all"].lost) == (8, 3)  # the placebo's is not counted
    assert (classes["distance below 15 m"].objects, classes["distance below 15 m"].lost) == (4, 3)
    assert (classes["distance from 30 m"].objects, classes["distance from 30 m"].lost) == (4, 0)
    assert classes["height 25 to 40 px"].objects == 8
    assert classes["height from 80 px"].objects == 0


def test_cars_that_the_detector_does_not_find_cannot_fall(runs: list[ArmRun]) -> None:
    blind = [replace(result, detections_benign=()) for result in runs[0].results]
    run = replace(runs[0], results=tuple(blind))
    assert standing_of([ArmCounts.of(run)], seen_of(run, DEPTHS))[0].objects == 0


def test_share_with_wilson() -> None:
    one = Standing("all", 10, 1).standing
    assert one.value == pytest.approx(0.9)
    assert (one.low, one.high) == pytest.approx((0.596, 0.982), abs=1e-3)
    assert Standing("none", 0, 0).standing.value is None


def test_told_to_people(counts: StudyCounts) -> None:
    found = Findings(
        Study(name="searches"),
        DRAWS,
        counts,
        rows_of(counts.arms, DRAWS, 0),
        grades=[grades_of(one, DRAWS, 0) for one in counts.arms],
        costs=costs_of(counts.arms, counts.seen, DRAWS, 0),
        standing=standing_of(counts.arms, counts.seen),
    )
    by_title = {sheet.title: sheet for sheet in sheets(found, whole=False)}
    cost = by_title["What certain failures cost"]
    assert cost.rows[0][:2] == ("climb", "30.0")
    assert cost.rows[1][2].startswith("1.00 [")
    assert by_title["Objects that no method brings to fall for certain"].rows[0][:3] == ("all", "8", "3")
    assert any("Wilson" in note for note in notes(found))
    assert found.to_json()["standing"][0]["standing"] == pytest.approx(5 / 8)
    assert {"searches", "standing"} <= set(told(found).tables)
