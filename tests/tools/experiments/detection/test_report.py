"""Tables, files and pictures of a study, from hand-made frames."""

import csv
import io
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from drivesem.analysis.confirm import Confirmation, SurvivalRate
from drivesem.run.folder import ARMS
from scene_ir import files
from tests.tools.experiments.detection.conftest import arm, arm_run, counted, frame
from tools.experiments.detection.arms import PLACEBO, RANDOM
from tools.experiments.detection.comparison import compare_arms
from tools.experiments.detection.counts import ArmCounts, StudyCounts
from tools.experiments.detection.labels import compare_frame_labels, compare_labels
from tools.experiments.detection.outcomes import compare_success, success_curve
from tools.experiments.detection.plots import (
    MAX_CHANGES,
    PICTURE_WIDTH_PX,
    find_largest_changes,
    write_largest_changes,
    write_plot,
)
from tools.experiments.detection.report import StudyResults, arms_report, build_notes, report_tables
from tools.experiments.settings import StudyConfig

DRAWS = 10


@pytest.fixture
def controlled() -> StudyResults:
    """Two parameters; one frame of four is broken by the attack, none by its controls."""
    runs = []
    for name, reference in (("rotate", 0.982), ("mesh", 0.987)):
        lost = [frame(f"{i}", found=i > 0, success=i == 0) for i in range(4)]
        runs.append(counted(arm(name, reference), lost))
        for kind in (RANDOM, PLACEBO):
            runs.append(counted(arm(f"{name} {kind}", control=(kind, name)), [frame(f"{i}") for i in range(4)]))
    ran = StudyCounts(tuple(runs), without_vehicles=3, failed={"000009": "no camera"})
    return StudyResults(StudyConfig(name="single"), DRAWS, ran, compare_arms(runs, DRAWS, 0))


@pytest.fixture
def sampled() -> StudyResults:
    """An arm of 10 queries, one of 64, and one of a single query."""
    runs = [
        counted(arm("si-fgsm"), [frame("0", queries=2, success=True), frame("1", queries=5, success=True)]),
        counted(
            arm("halton", method="halton", queries=64),
            [frame("0", queries=30, success=True), frame("1", queries=64)],
        ),
        counted(arm("fgsm", method="fgsm"), [frame("0", queries=1, success=True), frame("1", queries=1)]),
    ]
    return StudyResults(
        StudyConfig(name="samples"),
        DRAWS,
        StudyCounts(tuple(runs), 0, {}),
        compare_arms(runs, DRAWS, 0),
        curves=[success_curve(run, DRAWS, 0) for run in runs],
        advantages={run.arm.name: compare_success(runs[0], 10, run, DRAWS, 0) for run in runs},
    )


@pytest.fixture
def labelled() -> StudyResults:
    run = arm_run(arm("translate"), [frame("0", moved_by=40.0), frame("1")])
    counts = StudyCounts((ArmCounts.from_run(run),), 0, {})
    sets = [compare_labels("translate", compare_frame_labels(run))]
    return StudyResults(StudyConfig(name="labels"), 0, counts, compare_arms(counts.arms, 0, 0), label_sets=sets)


def cells(found: StudyResults, title: str, arm: str) -> dict[str, str]:
    sheet = next(s for s in report_tables(found) if s.title.startswith(title))
    return dict(zip(sheet.columns, next(row for row in sheet.rows if row[0] == arm), strict=True))


def test_the_papers_metrics_stand_next_to(controlled: StudyResults) -> None:
    row = cells(controlled, "Car AP50", "rotate")
    assert (row["benign"], row["paper's mAP"], row["paper's drop"]) == ("100.00", "98.20", "1.2")
    # 7 of 8 cars: 88 of 101 samples of recall
    assert row["drop, moved"].startswith(f"{100 * 13 / 101:.1f} [")
    assert cells(controlled, "Controls", "mesh")["placebo drop"] == "0.0 [0.0, 0.0]"
    control_rows = cells(controlled, "Controls", "rotate")
    assert control_rows["attack less random"].endswith("] *")
    assert not control_rows["attack less placebo"].endswith("*")
    assert float(control_rows["p of *"]) == pytest.approx(controlled.rows[0].p, abs=1e-3)
    frames = cells(controlled, "Frames", "rotate")
    assert (frames["moved"], frames[RANDOM], frames[PLACEBO], frames["queries"]) == ("1", "0", "0", "40")
    text = " ".join(build_notes(controlled))
    assert "Skipped: 3 frames without vehicles." in text
    assert "Frame 000009 could not be used: no camera" in text
    assert "check: 100.00 % of all" in text


def test_what_survives_the_second_renderer_stands_next_to(controlled: StudyResults) -> None:
    shares = tuple(
        SurvivalRate.from_outcomes(name, outcomes)
        for name, outcomes in (("frames", [True, True, False]), ("lost", []))
    )
    drawn = Confirmation(frames=4, not_carried={}, shares=shares, scores={}, overlap=None)
    found = replace(controlled, confirmed={"rotate": drawn, "mesh": drawn})
    row = cells(found, "Failures that survive", "rotate")
    assert (row["rendered"], row["lost"]) == ("4", "-")
    assert row["frames"].startswith("66.7 [")
    assert row["frames"].endswith("of 3")
    first = found.to_json()["rows"][0]
    assert (first["survive_failures"], first["survive_share"]) == (3, pytest.approx(2 / 3))
    assert not any(sheet.title.startswith("Failures that survive") for sheet in report_tables(controlled))
    assert "survive_share" not in controlled.to_json()["rows"][0]


def test_success_after_queries(sampled: StudyResults) -> None:
    first = cells(sampled, "Frames broken", "si-fgsm")
    assert [first[mark].split(" [")[0] for mark in ("1", "2", "5", "10", "20")] == [
        "0.0",
        "50.0",
        "100.0",
        "100.0",
        "-",
    ]
    halton = cells(sampled, "Frames broken", "halton")
    assert halton["at the end"].startswith("50.0 [")
    assert halton["at the end"].endswith("of 64")
    assert halton["si-fgsm in 10, less this at the end"].startswith("50.0 [")
    assert len(sampled.to_json()["curves"]) == 10 + 64 + 1


def test_label_sets(labelled: StudyResults) -> None:
    row = cells(labelled, "Counterexamples", "translate")
    assert (row["IoU"], row["paper"], row["moved"], row["paper only"]) == ("0.5", "1", "0", "1")
    assert labelled.to_json()["label_sets"][0]["only_unmoved_at_0.5"] == 1


@pytest.mark.parametrize("kind", ["controlled", "sampled", "labelled"])
def test_files(kind: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    found: StudyResults = request.getfixturevalue(kind)
    arms_report(found, tmp_path).write()
    write_plot(tmp_path / "study.png", found)
    lines = list(csv.DictReader((tmp_path / "study.csv").read_text().splitlines()))
    assert [line["name"] for line in lines] == [row.name for row in found.rows]
    text = (tmp_path / "study.md").read_text()
    assert all(f"## {sheet.title}" in text for sheet in report_tables(found))
    assert (tmp_path / "curves.csv").exists() == (kind == "sampled")
    assert (tmp_path / "label_sets.csv").exists() == (kind == "labelled")
    picture = cv2.imread(str(tmp_path / "study.png"))
    assert min(picture.shape[:2]) > 400
    stream = io.StringIO()
    arms_report(found, tmp_path).print(Console(file=stream, width=100))
    assert found.rows[0].name in stream.getvalue()


def test_nothing_to_attack(tmp_path: Path) -> None:
    """No frame has a vehicle: the tables have dashes, and nothing fails."""
    runs = [counted(arm("rotate", 0.982), []), counted(arm("rotate placebo", control=(PLACEBO, "rotate")), [])]
    runs.append(counted(arm("rotate random", control=(RANDOM, "rotate")), []))
    found = StudyResults(
        StudyConfig(name="single"), DRAWS, StudyCounts(tuple(runs), 5, {}), compare_arms(runs, DRAWS, 0)
    )
    assert found.to_json()["feasible_fraction"] is None
    assert cells(found, "Car AP50", "rotate")["benign"] == "-"
    arms_report(found, tmp_path).write()
    write_plot(tmp_path / "study.png", found)


@pytest.fixture
def runs():
    """Two attacks, of which each changes other frames more, and a control that changes all frames most."""
    small = [frame(f"{i:03d}", yaw=0.01 * i) for i in range(MAX_CHANGES + 3)]
    turned = [frame(f"{i:03d}", yaw=-0.02 if i else 0.3) for i in range(MAX_CHANGES + 3)]
    edits = [frame(f"{i:03d}", yaw=0.35) for i in range(MAX_CHANGES + 3)]
    return [
        arm_run(arm("small"), small),
        arm_run(arm("turned"), turned),
        arm_run(arm("small placebo", control=(PLACEBO, "small")), edits),
    ]


def test_each_frame_once_by_the_arm_that_changed_it_most(runs) -> None:
    found = find_largest_changes(runs, Path("out"))
    assert [(c.result.identifier, c.arm) for c in found[:3]] == [
        ("000", "turned"),
        ("012", "small"),
        ("011", "small"),
    ]
    assert len(found) == MAX_CHANGES
    assert found[0].size == pytest.approx(0.3 / 0.7)
    assert found[0].folder == Path("out", ARMS, "turned", "frames", "000")


def test_the_sheet_shows_photographs_next_to_counterexamples(runs, tmp_path: Path) -> None:
    changes = find_largest_changes(runs, tmp_path)[:2]
    for level, change in enumerate(changes, start=1):
        for name, value in (("benign.png", 20), ("counterexample.png", 20 + 50 * level)):
            files.write_png(change.folder / name, np.full((30, 100, 3), value, np.uint8))
    write_largest_changes(tmp_path / "largest.png", changes)
    sheet = files.read_image(tmp_path / "largest.png")
    row = sheet.shape[0] // 2
    for level in (1, 2):
        middle = sheet[(level - 1) * row + row // 2 + 10]
        assert int(middle[PICTURE_WIDTH_PX // 2, 0]) == 20
        assert int(middle[PICTURE_WIDTH_PX + PICTURE_WIDTH_PX // 2, 0]) == 20 + 50 * level
