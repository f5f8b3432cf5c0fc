"""Failures of an arm by grade and kind, on hand-made frames; what is confirmed; tables and picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import pytest

from drivesem.config.commands import Study
from drivesem.failures.grades import Agreement, Count, Grade, Kind
from drivesem.run.results import Failure, FrameResult
from tools.experiments.detection.arms import PLACEBO
from tools.experiments.detection.counts import StudyCounts
from tools.experiments.detection.grades import ArmGrades, grades_of
from tools.experiments.detection.plots import write_plot
from tools.experiments.detection.report import Findings, notes, sheets
from tools.experiments.detection.rows import rows_of

DRAWS = 200
ASKED = Agreement("generator", 4, 1, 4)


def failure(grade: Grade, kind: Kind = Kind.MISSED, second: Agreement | None = None) -> Failure:
    return Failure("lost", "Car", (0.0, 0.0, 9.0, 9.0), 0, None, kind, grade, Count(16, 16, 16, 16), second)


@pytest.fixture
def runs(frame, counted, arm) -> list:
    """Four frames of two cars, failures of each grade in the first three; a control fails by threshold."""
    of = [
        (failure(Grade.THRESHOLD), failure(Grade.CERTAIN, second=ASKED)),
        (failure(Grade.CONFIRMED, Kind.CLASS, replace(ASKED, after=4)),),
        (failure(Grade.SHARED, second=replace(ASKED, after=3)),),
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
def grades(runs: list) -> ArmGrades:
    return grades_of(runs[0], DRAWS, 0)


def test_a_grade_holds_those_above_it(grades: ArmGrades) -> None:
    assert grades.counts == {Grade.THRESHOLD: 4, Grade.CERTAIN: 3, Grade.CONFIRMED: 2, Grade.SHARED: 1}
    assert (grades.frames, grades.objects, grades.passes) == (4, 8, 120)
    assert grades.rates[Grade.CERTAIN].value == pytest.approx(3 / 8)
    assert grades.kinds[Kind.CLASS] == dict(zip(Grade, (1, 1, 1, 0), strict=True))
    assert grades.kinds[Kind.MISSED][Grade.THRESHOLD] == 3


def test_what_survives_is_a_share_of_what_was_asked(grades: ArmGrades) -> None:
    assert grades.asked == 3
    assert grades.survive.value == pytest.approx(2 / 3)
    low, high = grades.survive.low, grades.survive.high
    assert low is not None
    assert high is not None
    assert 0 <= low < 2 / 3 <= high == 1


def test_ignored_objects_are_nothing_to_lose(frame, counted, arm) -> None:
    result: FrameResult = frame("0")
    first, second = result.targets_benign
    ignored = replace(result, targets_benign=(replace(first, ignore=True), second))
    assert grades_of(counted(arm("a"), [ignored]), 0, 0).objects == 1


def test_bounds_are_those_of_drawing_frames(frame, counted, arm) -> None:
    """Equal frames leave nothing to chance; without draws there are no bounds."""
    alike = [replace(frame(str(i)), failures=(failure(Grade.CERTAIN),)) for i in range(5)]
    one = grades_of(counted(arm("a"), alike), DRAWS, 0).rates[Grade.CERTAIN]
    assert (one.value, one.low, one.high) == pytest.approx((0.5, 0.5, 0.5))
    assert grades_of(counted(arm("a"), alike), 0, 0).rates[Grade.CERTAIN].low is None


def test_told_to_people(runs: list, tmp_path: Path) -> None:
    found = Findings(
        Study(name="grades"),
        DRAWS,
        StudyCounts(tuple(runs), 0, {}),
        rows_of(runs, DRAWS, 0),
        grades=[grades_of(run, DRAWS, 0) for run in runs],
    )
    by_grade, by_kind = sheets(found)[:2]
    assert sheets(found, whole=False)[0].rows[0][:3] == ("combo 2", "4 / 3 / 2 / 1", "8")
    assert by_grade.rows[0][:8] == ("combo 2", "4", "8", "120", "4", "3", "2", "1")
    assert by_grade.rows[1][4:8] == ("4", "0", "0", "0")
    assert by_grade.rows[1][-1] == "-"
    assert dict(zip(by_kind.columns, by_kind.rows[0], strict=True))["missed"] == "3 / 2 / 1"
    assert sheets(found)[-1].rows[1][-2:] == ("-", "40")  # which has no placebo
    assert any(note.startswith("Certain:") for note in notes(found))
    assert found.to_json()["grades"][0]["survive"] == pytest.approx(2 / 3)
    write_plot(tmp_path / "study.png", found)
    assert cv2.imread(str(tmp_path / "study.png")).std() > 10
