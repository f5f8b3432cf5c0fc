"""The figures of confirmed frames, by hand."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest

from detectors.types import CLASSES
from drivesem.analysis.confirm import (
    ConfirmAnalyser,
    ConfirmedFrame,
    ObjectComparison,
    RendererFailure,
    RetestedFailure,
    SurvivalRate,
    build_confirm_report,
    summarise_confirmation,
)
from drivesem.evaluation.resampling import wilson
from drivesem.failures.grades import SecondOpinion
from drivesem.run.records import dump_record, load_record
from drivesem.run.results import BoxRecord, Failure, FrameResult
from scene_ir.errors import FormatError

BOX = (100.0, 100.0, 160.0, 140.0)


def retested(survives: bool | None, kind: str = "lost", grade: str = "certain") -> RetestedFailure:
    """A failure with an opinion; None: of no kind."""
    index, error = (1, "missed") if kind == "lost" else (None, "background")
    failure = Failure(kind, "Car", BOX, index=index, error=error if survives is not None else None, grade=grade)
    return RetestedFailure(failure, None if survives is None else SecondOpinion("generator", 4, 3 * survives, 4))


def second(kind: str, index: int | None = None) -> RendererFailure:
    return RendererFailure(kind, "Car", BOX, index, None)


def confirmed(
    name: str, ours: tuple[RetestedFailure, ...] = (), theirs: tuple[RendererFailure, ...] = (), **changes: Any
) -> ConfirmedFrame:
    facts: dict[str, Any] = {
        "identifier": name,
        "source": "00",
        "renderer": "generator",
        "failures": ours,
        "second": theirs,
        "objects": (ObjectComparison(0, True, 1.0, 0.9), ObjectComparison(1, False, 1.0, 0.1)),
        "targets_benign": (BoxRecord(BOX, "Car", index=1),),
        "targets_changed": (BoxRecord(BOX, "Car", index=1),),
        "detections_benign": (BoxRecord(BOX, "Car", score=0.9),),
        "detections_changed": (),
        "not_carried": (),
        "seconds": 1.0,
    }
    return ConfirmedFrame(**facts | changes)


def result(name: str) -> FrameResult:
    target, hit = (BoxRecord(BOX, "Car", index=0),), (BoxRecord(BOX, "Car", score=0.9),)
    return FrameResult(
        identifier=name,
        objects=1,
        queries=1,
        loss_trace=(),
        theta=(),
        active_constraints=(),
        violations=(),
        targets_benign=target,
        targets_moved=target,
        detections_benign=hit,
        detections_rerendered=hit,
        detections_attacked=hit,
        failures=(),
        became_ignored=(),
        judged=(0,),
        found_before=(0,),
        success_paper=False,
        success_moved=False,
        identity_psnr_db=None,
        seconds=0.0,
    )


FRAMES = [
    confirmed("a", (retested(True), retested(False, "phantom", "threshold")), (second("lost", 1),)),
    confirmed("b", (retested(False, "phantom"), retested(None, "phantom", "threshold")), (second("lost", 2),)),
    confirmed("c", (retested(False),)),
    confirmed("d", (), (second("phantom"),)),
    confirmed("e"),
    confirmed("f", (retested(True),), (second("lost", 1),), not_carried=("objects[3]: no such vehicle",)),
]


def test_shares_by_hand() -> None:
    report = summarise_confirmation(FRAMES, [result(f.identifier) for f in FRAMES], CLASSES, 0.5)
    assert report.frames == 5
    assert report.not_carried == {"f": ["objects[3]: no such vehicle"]}
    assert [(s.name, s.survive, s.failures) for s in report.shares] == [
        ("frames", 1, 3),
        ("certain", 1, 3),
        ("lost", 1, 2),
        ("phantoms", 0, 2),
        ("frames, second only", 1, 2),
    ]
    assert (report.shares[0].low, report.shares[0].high) == wilson(1, 3)
    assert (len(report.failures), report.not_tested) == (4, 1)
    assert report.overlap == (pytest.approx(0.9), 0.9, 5)
    assert {name: s.headline.ap50 for name, s in report.scores.items()} == {
        "photograph": pytest.approx(1.0),
        "second renderer, unchanged": pytest.approx(1.0),
        "compositor": pytest.approx(1.0),
        "second renderer": 0.0,
    }
    assert report.to_json()["survive"] == pytest.approx(1 / 3)


def test_without_a_failure_there_is_no_share() -> None:
    assert SurvivalRate.from_outcomes("frames", []) == SurvivalRate("frames", 0, 0, None, None, None)
    report = summarise_confirmation([FRAMES[-1]], [result("f")], CLASSES, 0.5)
    assert (report.frames, report.scores, report.overlap) == (0, {}, None)
    assert report.to_json()["survive"] is None


def test_files(tmp_path: Path) -> None:
    report = summarise_confirmation(FRAMES, [result(f.identifier) for f in FRAMES], CLASSES, 0.5)
    build_confirm_report(tmp_path, report, FRAMES, {}, {}).write()
    rows = list(csv.DictReader((tmp_path / "confirm.csv").read_text().splitlines()))
    assert [(row["survive"], row["failures"]) for row in rows[:3]] == [("1", "2"), ("0", "1"), ("0", "1")]
    assert (rows[1]["not_tested"], rows[1]["lost_second"], rows[0]["box_iou"]) == ("1", "1", "0.9")
    assert {row["second"] for row in rows} == {"generator"}
    assert rows[5]["not_carried"] == "objects[3]: no such vehicle"
    text = (tmp_path / "confirm.md").read_text()
    assert "| frames | 1 of 3 | 33.33 |" in text
    assert "| a | Car missed, object 1 | certain | generator agrees: found in 4/4 → 1/4 | yes |" in text
    assert "1 failure by threshold, none of a kind: not tested." in text
    assert "Frame f is not counted: objects[3]: no such vehicle." in text


def test_a_frame_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "confirmed.json"
    path.write_text(dump_record(FRAMES[0], ConfirmAnalyser.schema))
    assert load_record(path, ConfirmedFrame, ConfirmAnalyser.schema) == FRAMES[0]
    path.write_text('{"schema": 3}')
    with pytest.raises(FormatError, match=r"confirmed\.json: identifier: expected a value"):
        load_record(path, ConfirmedFrame, ConfirmAnalyser.schema)
    path.write_text('{"schema": 0}')
    with pytest.raises(FormatError, match="schema"):
        load_record(path, ConfirmedFrame, ConfirmAnalyser.schema)
