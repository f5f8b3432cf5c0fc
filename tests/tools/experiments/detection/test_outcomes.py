"""Grades, cost, success curves and withstanding objects, from hand-made frames."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import pytest

from drivesem.failures.grades import Certificate, Grade, Kind, SecondOpinion
from drivesem.run.results import Failure
from tests.tools.experiments.detection.conftest import arm, arm_run, counted, frame
from tools.experiments.detection.arms import PLACEBO, ArmRun
from tools.experiments.detection.comparison import compare_arms
from tools.experiments.detection.counts import ArmCounts, StudyCounts
from tools.experiments.detection.outcomes import (
    ArmGrades,
    compare_success,
    count_grades,
    count_withstanding,
    find_detected_objects,
    search_costs,
    success_curve,
)
from tools.experiments.detection.plots import write_plot
from tools.experiments.detection.report import StudyResults, build_notes, report_tables
from tools.experiments.settings import StudyConfig

DRAWS = 200
REQUIRED_KEYS = SecondOpinion("generator", 4, 1, 4)


def failure(grade: Grade, kind: Kind = Kind.MISSED, second: SecondOpinion | None = None) -> Failure:
    return Failure("lost", "Car", (0.0, 0.0, 9.0, 9.0), 0, None, kind, grade, Certificate(16, 16, 16, 16), second)


@pytest.fixture
def graded_runs() -> list:
    """Four frames of two cars, failures of each grade in the first three; a control fails by threshold."""
    of = [
        (failure(Grade.THRESHOLD), failure(Grade.CERTAIN, second=REQUIRED_KEYS)),
        (failure(Grade.CONFIRMED, Kind.CLASS, replace(REQUIRED_KEYS, after=4)),),
        (failure(Grade.SHARED, second=replace(REQUIRED_KEYS, after=3)),),
        (),
    ]
    frames = [replace(frame(str(i)), failures=failures, passes=30) for i, failures in enumerate(of)]
    control = [replace(frame(str(i)), failures=of[0][:1], passes=1) for i in range(4)]
    return [
        counted(arm("combo 2"), frames),
        counted(arm("combo 2 placebo", control=(PLACEBO, "combo 2")), control),
        counted(arm("combo 2, halton", method="halton"), frames[:1] + control[1:]),
    ]


@pytest.fixture
def grades(graded_runs: list) -> ArmGrades:
    return count_grades(graded_runs[0], DRAWS, 0)


def test_a_grade_holds_those_above_it(grades: ArmGrades) -> None:
    assert grades.counts == {Grade.THRESHOLD: 4, Grade.CERTAIN: 3, Grade.CONFIRMED: 2, Grade.SHARED: 1}
    assert (grades.frames, grades.objects, grades.passes) == (4, 8, 120)
    assert grades.rates[Grade.CERTAIN].value == pytest.approx(3 / 8)
    assert grades.kinds[Kind.CLASS] == dict(zip(Grade, (1, 1, 1, 0), strict=True))
    assert grades.kinds[Kind.MISSED][Grade.THRESHOLD] == 3


def test_what_survives_is_a_share_of_what_was_requested(grades: ArmGrades) -> None:
    assert grades.second_rendered == 3
    assert grades.survive.value == pytest.approx(2 / 3)
    low, high = grades.survive.low, grades.survive.high
    assert low is not None
    assert high is not None
    assert 0 <= low < 2 / 3 <= high == 1


def test_grade_tables(graded_runs: list, tmp_path: Path) -> None:
    found = StudyResults(
        StudyConfig(name="grades"),
        DRAWS,
        StudyCounts(tuple(graded_runs), 0, {}),
        compare_arms(graded_runs, DRAWS, 0),
        grades=[count_grades(run, DRAWS, 0) for run in graded_runs],
    )
    by_grade, by_kind = report_tables(found)[:2]
    assert report_tables(found, whole=False)[0].rows[0][:3] == ("combo 2", "4 / 3 / 2 / 1", "8")
    assert by_grade.rows[0][:8] == ("combo 2", "4", "8", "120", "4", "3", "2", "1")
    assert by_grade.rows[1][4:8] == ("4", "0", "0", "0")
    assert by_grade.rows[1][-1] == "-"
    assert dict(zip(by_kind.columns, by_kind.rows[0], strict=True))["missed"] == "3 / 2 / 1"
    assert report_tables(found)[-1].rows[1][-2:] == ("-", "40")  # which has no placebo
    assert any(note.startswith("Certain:") for note in build_notes(found))
    assert found.to_json()["grades"][0]["survive"] == pytest.approx(2 / 3)
    write_plot(tmp_path / "study.png", found)
    assert cv2.imread(str(tmp_path / "study.png")).std() > 10


DEPTHS = {str(i): (12.0, 40.0) for i in range(4)}
"""A near car and a far one in each frame."""


def lost(index: int, grade: Grade = Grade.CERTAIN) -> Failure:
    return Failure(
        "lost", "Car", (0.0, 0.0, 9.0, 9.0), index, None, Kind.MISSED, grade, Certificate(16, 16, 16, 16)
    )


@pytest.fixture
def search_runs() -> list[ArmRun]:
    """Four frames of two cars: the first arm loses three for certain, the second one, the placebo the far one."""

    def of(failures: Sequence[tuple[Failure, ...]], passes: int, seconds: float) -> list:
        return [replace(frame(str(i)), failures=f, passes=passes, seconds=seconds) for i, f in enumerate(failures)]

    return [
        arm_run(arm("climb"), of([(lost(0),), (lost(0), lost(1, Grade.THRESHOLD)), (lost(0),), ()], 50, 30.0)),
        arm_run(arm("halton"), of([(lost(0),), (), (), ()], 25, 15.0)),
        arm_run(arm("climb placebo", control=(PLACEBO, "climb")), of([(lost(1),), (), (), ()], 1, 5.0)),
    ]


@pytest.fixture
def counts(search_runs: list[ArmRun]) -> StudyCounts:
    return StudyCounts(
        tuple(map(ArmCounts.from_run, search_runs)), 0, {}, find_detected_objects(search_runs[0], DEPTHS)
    )


def test_certain_failures_for_passes_and_minutes(counts: StudyCounts) -> None:
    climb, halton, _ = search_costs(counts.arms, counts.detected_objects, DRAWS, 0)
    assert climb.per_100_passes.value == pytest.approx(3 / 2)
    assert climb.per_minute.value == pytest.approx(3 / 2)
    assert halton.per_100_passes.value == pytest.approx(1.0)
    assert halton.seconds == 15.0
    assert climb.per_minute.low is not None
    assert climb.per_minute.low < 1.5


def test_the_first_arm_is_what_others_are_compared_with(counts: StudyCounts) -> None:
    climb, halton, _ = search_costs(counts.arms, counts.detected_objects, DRAWS, 0)
    assert climb.ahead is None
    assert halton.ahead is not None
    assert halton.ahead.difference == pytest.approx((3 - 1) / 8)
    assert halton.ahead.low is not None
    assert halton.ahead.low >= 0


def test_what_stands_by_size_and_distance(counts: StudyCounts) -> None:
    classes = {one.name: one for one in count_withstanding(counts.arms, counts.detected_objects)}
    assert (classes["all"].objects, classes["all"].lost) == (8, 3)  # the placebo's is not counted
    assert (classes["distance below 15 m"].objects, classes["distance below 15 m"].lost) == (4, 3)
    assert (classes["distance from 30 m"].objects, classes["distance from 30 m"].lost) == (4, 0)
    assert classes["height 25 to 40 px"].objects == 8
    assert classes["height from 80 px"].objects == 0


def test_search_tables(counts: StudyCounts) -> None:
    found = StudyResults(
        StudyConfig(name="searches"),
        DRAWS,
        counts,
        compare_arms(counts.arms, DRAWS, 0),
        grades=[count_grades(one, DRAWS, 0) for one in counts.arms],
        costs=search_costs(counts.arms, counts.detected_objects, DRAWS, 0),
        withstanding=count_withstanding(counts.arms, counts.detected_objects),
    )
    by_title = {sheet.title: sheet for sheet in report_tables(found, whole=False)}
    cost = by_title["Cost of certain failures"]
    assert cost.rows[0][:2] == ("climb", "30.0")
    assert cost.rows[1][2].startswith("1.00 [")
    assert by_title["Objects that no method makes the detector lose with certainty"].rows[0][:3] == (
        "all",
        "8",
        "3",
    )
    assert any("Wilson" in note for note in build_notes(found))
    assert found.to_json()["standing"][0]["standing"] == pytest.approx(5 / 8)
    assert {"searches", "standing"} <= set(found.csv_tables())


@pytest.fixture
def success_runs():
    """One arm that breaks frames after 1, 3, 3 queries and one never; one that needs 8 in two of them."""
    quick = [(1, True), (3, True), (3, True), (10, False)]
    slow = [(8, True), (8, True), (64, False), (64, False)]
    made = {
        name: [frame(str(i), queries=q, success=won) for i, (q, won) in enumerate(pairs)]
        for name, pairs in (("quick", quick), ("slow", slow))
    }
    return (
        counted(arm("quick", early_stop=True), made["quick"]),
        counted(arm("slow", method="halton", queries=64, early_stop=True), made["slow"]),
    )


def test_the_curve_is_the_distribution_of_first_successes(success_runs) -> None:
    quick, slow = (success_curve(run, draws=40, seed=0) for run in success_runs)
    assert [one.value for one in quick.shares] == [0.25, 0.25] + [0.75] * 8
    assert [slow.at(q).value for q in (1, 7, 8, 64, 100)] == [0, 0, 0.5, 0.5, 0.5]
    assert quick.mean_queries == pytest.approx(17 / 4)
    for curve in (quick, slow):
        shares = [one.value for one in curve.shares]
        assert shares == sorted(shares)
        assert all(one.low <= one.value <= one.high for one in curve.shares)
    assert quick.at(3).low < 0.75 < quick.at(3).high
    assert quick.to_json()[2] == {
        "name": "quick",
        "queries": 3,
        "share": 0.75,
        "low": quick.at(3).low,
        "high": quick.at(3).high,
    }


def test_one_arm_against_the_end_of_another(success_runs) -> None:
    one = compare_success(*(success_runs[0], 2, success_runs[1]), draws=60, seed=0)
    assert (one.first, one.second, one.difference) == (0.5, 0.25, -0.25)
    assert one.low <= -0.25 <= one.high
    assert compare_success(success_runs[0], 3, success_runs[1], 0, 0).difference == pytest.approx(0.25)
