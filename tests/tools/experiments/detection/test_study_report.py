"""Tables, files and pictures of a study, from hand-made frames."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
from matplotlib.figure import Figure
from rich.console import Console

from drivesem.analysis.confirm.report import Confirmation, Share
from drivesem.config.commands import Study
from drivesem.evaluation.resampling import Interval
from drivesem.report.plots import COLOURS
from tools.experiments.detection.arms import PLACEBO, RANDOM
from tools.experiments.detection.counts import ArmCounts, StudyCounts
from tools.experiments.detection.labels import label_frames, label_sets
from tools.experiments.detection.plots import bars, write_plot
from tools.experiments.detection.report import Findings, answer_of, notes, sheets, told
from tools.experiments.detection.rows import rows_of
from tools.experiments.detection.success import against, curve_of

DRAWS = 10


@pytest.fixture
def controlled(frame, counted, arm) -> Findings:
    """Two parameters; one frame of four is broken by the attack, none by its controls."""
    runs = []
    for name, reference in (("rotate", 0.982), ("mesh", 0.987)):
        lost = [frame(f"{i}", found=i > 0, success=i == 0) for i in range(4)]
        runs.append(counted(arm(name, reference), lost))
        for kind in (RANDOM, PLACEBO):
            runs.append(counted(arm(f"{name} {kind}", control=(kind, name)), [frame(f"{i}") for i in range(4)]))
    ran = StudyCounts(tuple(runs), without_vehicles=3, failed={"000009": "no camera"})
    return Findings(Study(name="single"), DRAWS, ran, rows_of(runs, DRAWS, 0))


@pytest.fixture
def sampled(frame, counted, arm) -> Findings:
    """An arm of 10 queries, one of 64, and one of a single query."""
    runs = [
        counted(arm("si-fgsm"), [frame("0", queries=2, success=True), frame("1", queries=5, success=True)]),
        counted(
            arm("halton", method="halton", queries=64),
            [frame("0", queries=30, success=True), frame("1", queries=64)],
        ),
        counted(arm("fgsm", method="fgsm"), [frame("0", queries=1, success=True), frame("1", queries=1)]),
    ]
    return Findings(
        Study(name="samples"),
        DRAWS,
        StudyCounts(tuple(runs), 0, {}),
        rows_of(runs, DRAWS, 0),
        curves=[curve_of(run, DRAWS, 0) for run in runs],
        beside={run.arm.name: against(runs[0], 10, run, DRAWS, 0) for run in runs},
        within=10,
    )


@pytest.fixture
def labelled(frame, arm_run, arm) -> Findings:
    run = arm_run(arm("translate"), [frame("0", moved_by=40.0), frame("1")])
    counts = StudyCounts((ArmCounts.of(run),), 0, {})
    sets = [label_sets("translate", label_frames(run))]
    return Findings(Study(name="labels"), 0, counts, rows_of(counts.arms, 0, 0), label_sets=sets)


def cells(found: Findings, title: str, arm: str) -> dict[str, str]:
    sheet = next(s for s in sheets(found) if s.title.startswith(title))
    return dict(zip(sheet.columns, next(row for row in sheet.rows if row[0] == arm), strict=True))


def test_the_papers_figures_stand_beside(controlled: Findings) -> None:
    row = cells(controlled, "Car AP50", "rotate")
    assert (row["benign"], row["mAP there"], row["falls there"]) == ("100.00", "98.20", "1.2")
    # 7 of 8 cars: 88 of 101 samples of recall
    assert row["falls, moved"].startswith(f"{100 * 13 / 101:.1f} [")
    assert cells(controlled, "Controls", "mesh")["placebo falls"] == "0.0 [0.0, 0.0]"
    beside = cells(controlled, "Controls", "rotate")
    assert beside["attack less random"].endswith("] *")
    assert not beside["attack less placebo"].endswith("*")
    assert float(beside["p of *"]) == pytest.approx(controlled.rows[0].p, abs=1e-3)
    frames = cells(controlled, "Frames", "rotate")
    assert (frames["moved"], frames[RANDOM], frames[PLACEBO], frames["queries"]) == ("1", "0", "0", "40")
    text = " ".join(notes(controlled))
    assert "3 frames without vehicles passed over" in text
    assert "Frame 000009 could not be used: no camera" in text
    assert "check: 100.00 % of all" in text


def test_what_survives_the_second_renderer_stands_beside(controlled: Findings) -> None:
    shares = tuple(Share.of(name, outcomes) for name, outcomes in (("frames", [True, True, False]), ("lost", [])))
    drawn = Confirmation(frames=4, left={}, shares=shares, scores={}, overlap=None)
    found = replace(controlled, confirmed={"rotate": drawn, "mesh": drawn})
    row = cells(found, "Failures that survive", "rotate")
    assert (row["drawn"], row["lost"]) == ("4", "-")
    assert row["frames"].startswith("66.7 [")
    assert row["frames"].endswith("of 3")
    first = found.to_json()["rows"][0]
    assert (first["survive_failures"], first["survive_share"]) == (3, pytest.approx(2 / 3))
    assert not any(sheet.title.startswith("Failures that survive") for sheet in sheets(controlled))
    assert "survive_share" not in controlled.to_json()["rows"][0]


def test_json_has_what_others_read(controlled: Findings) -> None:
    data = controlled.to_json()
    assert (data["frames"], data["feasible_fraction"]) == (4, 1.0)
    assert [row["name"] for row in data["rows"]] == ["rotate", "mesh"]


def test_success_after_queries(sampled: Findings) -> None:
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


def test_label_sets(labelled: Findings) -> None:
    row = cells(labelled, "Counterexamples", "translate")
    assert (row["IoU"], row["paper"], row["moved"], row["paper only"]) == ("0.5", "1", "0", "1")
    assert labelled.to_json()["label_sets"][0]["only_unmoved_at_0.5"] == 1


@pytest.mark.parametrize("kind", ["controlled", "sampled", "labelled"])
def test_files(kind: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    found: Findings = request.getfixturevalue(kind)
    answer_of(told(found), tmp_path, {}, "drivesem study any", None).write()
    write_plot(tmp_path / "study.png", found)
    lines = list(csv.DictReader((tmp_path / "study.csv").read_text().splitlines()))
    assert [line["name"] for line in lines] == [row.name for row in found.rows]
    text = (tmp_path / "study.md").read_text()
    assert all(f"## {sheet.title}" in text for sheet in sheets(found))
    assert (tmp_path / "curves.csv").exists() == (kind == "sampled")
    assert (tmp_path / "label_sets.csv").exists() == (kind == "labelled")
    picture = cv2.imread(str(tmp_path / "study.png"))
    assert min(picture.shape[:2]) > 400
    stream = io.StringIO()
    answer_of(told(found), tmp_path, {}, "", None).print(Console(file=stream, width=100))
    assert found.rows[0].name in stream.getvalue()


def test_nothing_to_attack(frame, counted, arm, tmp_path: Path) -> None:
    """No frame has a vehicle: the tables have dashes, and nothing fails."""
    runs = [counted(arm("rotate", 0.982), []), counted(arm("rotate placebo", control=(PLACEBO, "rotate")), [])]
    runs.append(counted(arm("rotate random", control=(RANDOM, "rotate")), []))
    found = Findings(Study(name="single"), DRAWS, StudyCounts(tuple(runs), 5, {}), rows_of(runs, DRAWS, 0))
    assert found.to_json()["feasible_fraction"] is None
    assert cells(found, "Car AP50", "rotate")["benign"] == "-"
    answer_of(told(found), tmp_path, {}, "drivesem study single", None).write()
    write_plot(tmp_path / "study.png", found)


def test_more_series_than_colours_are_told_apart() -> None:
    """Each has a look of its own, by colour or hatch."""
    axes = Figure().add_subplot()
    bars(axes, {f"detector {i}": [Interval("ap50", 0.5, 0.4, 0.6)] for i in range(2 * len(COLOURS) + 1)})
    assert len({(bar.get_facecolor(), bar.get_hatch()) for bar in axes.patches}) == 2 * len(COLOURS) + 1
