"""Tables, CSV and plots of explanations made by hand; and back from JSON what was written."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest

from drivesem.analysis.explain.attribution import (
    SCHEMA,
    ChangeSize,
    Contribution,
    Explanation,
    FailureExplanation,
    MinimalChange,
    PartOutcome,
    PixelSensitivity,
)
from drivesem.analysis.explain.report import (
    build_explain_report,
    build_explain_tables,
    build_frame_table,
    plot_waterfalls,
    summarise_parameters,
)
from drivesem.run.records import dump_record, load_record
from drivesem.run.results import Coordinate, Failure
from scene_ir.errors import FormatError

GOOD, BAD = PartOutcome(1.0, 0, 0, False, False, (False,)), PartOutcome(3.0, 1, 2, True, False, (True,))
LOST = Failure("lost", "Car", (1.0, 2.0, 3.0, 4.0), index=2, error="missed", grade="certain")


def contribution(kind: str, name: str, loss: float, fails: float, error: float | None = None) -> Contribution:
    bad, good = (BAD, GOOD) if fails > 0.5 else (GOOD, BAD)
    errors = None if error is None else (error,)
    return Contribution(kind, name, loss, error, (fails,), errors, 2 * loss, abs(loss) / 2, bad, good)


def explanation(name: str, rotate: float = 0.5) -> Explanation:
    sizes = (
        ChangeSize("rotate", 0, 2.0, "deg", 3.5),
        ChangeSize("rotate", 2, 5.0, "deg", 8.7),
        ChangeSize("mesh", 2, 0.1, "m", 1.0),
    )
    least = MinimalChange(
        draws=3,
        of=4,
        holds=True,
        scan=(False, True, False, True),
        sign_changes=3,
        scale_whole=0.3,
        scale=0.5,
        dropped=("mesh", "objects[0]"),
        norm_found=8.0,
        norm_whole=4.0,
        norm=2.0,
        outcome=replace(BAD, phantoms=0),
        violations=(),
        sizes=(ChangeSize("rotate", 2, 2.5, "deg", 4.3),),
        failures=(Failure("lost", "Car", (1.0, 2.0, 3.0, 4.0), index=2),),
        theta=(Coordinate("objects[2].yaw", "rad", 0.04, -0.35, 0.35, "2.5 deg"),),
    )
    return Explanation(
        identifier=name,
        source="abc",
        objects=3,
        benign=GOOD,
        found=BAD,
        contributions=(
            contribution("parameter", "rotate", 2 - rotate, 0.75),
            contribution("parameter", "mesh", rotate, 0.25),
            contribution("object", "objects[0]", -0.5, 0.0, 0.1),
            contribution("object", "objects[2]", 2.5, 1.0, 0.1),
        ),
        exact=("parameter",),
        sizes=sizes,
        failures=(FailureExplanation(LOST, least),),
        sensitivity={"benign": PixelSensitivity((0.1, 0.2, 0.3), 0.4)},
        renders=99,
        seconds=1.5,
    )


def test_back_from_json(tmp_path: Path) -> None:
    path, record = tmp_path / "explain.json", explanation("a")
    path.write_text(dump_record(record, SCHEMA))
    assert load_record(path, Explanation, SCHEMA) == record
    for broken in ("[]", "{}", '{"schema": 2}', path.read_text().replace('"sign_changes"', '"signs"')):
        (tmp_path / "broken.json").write_text(broken)
        with pytest.raises(FormatError, match=r"broken\.json: (schema|identifier|failures)"):
            load_record(tmp_path / "broken.json", Explanation, SCHEMA)
    (tmp_path / "old.json").write_text('{"schema": 0}')
    with pytest.raises(FormatError, match="schema: expected 2"):
        load_record(tmp_path / "old.json", Explanation, SCHEMA)


def test_the_least_change_in_words() -> None:
    least = explanation("a").failures[0].least
    assert least is not None
    assert least.left == 0.25
    assert least.parameters == ("rotate",)
    assert least.objects == (2,)


def test_means_over_frames() -> None:
    rows = summarise_parameters([explanation("a", 0.5), explanation("b", 1.5)], 200, 0)
    rotate, mesh = rows
    assert (rotate.name, rotate.loss.value, mesh.loss.value) == ("rotate", 1.0, 1.0)
    assert (rotate.loss.low, rotate.loss.high) == (0.5, 1.5)
    assert (rotate.fails.value, rotate.fails.low, rotate.fails.high) == (0.75, 0.75, 0.75)
    assert (rotate.alone, rotate.without, mesh.alone, mesh.without) == (2, 0, 0, 2)
    assert (rotate.needed, mesh.needed) == (2, 0)
    assert (rotate.found, rotate.least, mesh.found, mesh.least) == (5.0, 2.5, 0.1, None)
    assert rotate.gradient_share == pytest.approx(0.5)
    (lone, _) = summarise_parameters([explanation("a")], 0, 0)
    assert (lone.loss.value, lone.loss.low, lone.loss.high) == (1.5, None, None)
    assert lone.to_json()["loss"] == 1.5


def test_a_parameter_that_some_frames_leave_alone() -> None:
    without = explanation("b")
    without = replace(
        without,
        contributions=tuple(c for c in without.contributions if c.name != "mesh"),
        sizes=without.sizes[:2],
    )
    _, mesh = summarise_parameters([explanation("a", 1.0), without], 0, 0)
    assert mesh.loss.value == 0.5
    assert (mesh.alone, mesh.without) == (0, 2)
    assert mesh.gradient_share == 0.5


def test_tables() -> None:
    frames = [explanation("a"), explanation("b")]
    by_failure, by_parameter = build_explain_tables(frames, summarise_parameters(frames, 0, 0))
    assert by_parameter.rows[0] == (
        *("rotate", "+1.50", "+75", "75", "2 of 2", "0 of 2", "2 of 2", "5 deg", "2.5 deg"),
    )
    assert by_failure.rows[0] == (
        *("a", "Car missed, object 2", "certain", "rotate", "object 2", "25", "3 of 4 draws"),
    )
    parts = {row[0]: row for row in build_frame_table(frames[0]).rows}
    assert parts["whole change"][4:6] == ("3.00", "1 + 2")
    assert parts["rotate"][1:4] == ("+1.50", "+75", "75")
    assert parts["objects[0]"][1] == "-0.50 ± 0.10"
    assert parts["objects[0]"][4:] == ("1.00", "0 + 0", "3.00", "1 + 2")


def held(**changes: Any) -> str:
    one = explanation("a")
    (failure,) = one.failures
    assert failure.least is not None
    least = replace(failure.least, **changes)
    tables = build_explain_tables([replace(one, failures=(replace(failure, least=least),))], [])
    return tables[0].rows[0][-1]


def test_whether_the_smallest_change_holds_in_words() -> None:
    assert held(draws=1, holds=False) == "no: 1 of 4 draws, in the picture only"
    assert held(dropped=(), scale=1.0) == "3 of 4 draws; no smaller change keeps it"
    assert held(draws=0, of=0, holds=False) == "in the picture, no kind to test in draws"
    one = explanation("a")
    exchanged = replace(one, failures=(FailureExplanation(LOST, None, "the exchange causes it"),))
    assert build_explain_tables([exchanged], [])[0].rows[0][-1] == "the exchange causes it"


def test_a_part_that_hinders_is_called_so() -> None:
    frame = explanation("a")
    hinders = [replace(c, fails=(-0.17,)) if c.name == "rotate" else c for c in frame.contributions]
    frame = replace(frame, contributions=tuple(hinders))
    _, by_parameter = build_explain_tables([frame], summarise_parameters([frame], 0, 0))
    row = dict(zip(by_parameter.columns, by_parameter.rows[0], strict=True))
    assert (row["of failing, %"], row["need it"]) == ("-17 against", "1 of 1")


def test_one_frame_has_no_interval() -> None:
    (lone, _) = summarise_parameters([explanation("a")], 100, 0)
    assert (lone.loss.value, lone.loss.low, lone.fails.low) == (1.5, None, None)


def test_files(tmp_path: Path) -> None:
    frames = [explanation("a"), explanation("b", 1.5)]
    report = build_explain_report(
        tmp_path, frames, summarise_parameters(frames, 20, 0), 20, {"frames_failed": {}, "frames_by_exchange": []}
    )
    report.write()
    row = report.data["rows"][0]
    assert (row["frame"], row["object"], row["grade"]) == ("a", 2, "certain")
    assert {name: row["least"][name] for name in ("holds", "draws", "of")} == {"holds": True, "draws": 3, "of": 4}
    rows = list(csv.DictReader((tmp_path / "explain.csv").read_text().splitlines()))
    assert [row["frame"] for row in rows] == ["a"] * 4 + ["b"] * 4
    assert (rows[0]["found"], rows[0]["unit"]) == ("5.0", "deg")
    assert (rows[2]["name"], rows[2]["found"]) == ("objects[0]", "")
    failures = list(csv.DictReader((tmp_path / "explain_failures.csv").read_text().splitlines()))
    assert [(f["frame"], f["object"], f["holds"], f["draws"], f["parameters"]) for f in failures] == [
        (name, "2", "True", "3", "rotate") for name in ("a", "b")
    ]
    page = (tmp_path / "explain.md").read_text()
    assert page.count("\n## ") == 4
    assert "![Smallest change that keeps: Car missed, object 2](frames/a/minimal_1_overlay.png)" in page
    assert all(len(line.split("|")) > 5 for line in page.splitlines() if line.startswith("|"))
    assert min(cv2.imread(str(tmp_path / "explain.png")).shape[:2]) > 150


def test_waterfalls_grow_with_the_number_of_cars(tmp_path: Path) -> None:
    few, many = explanation("a"), explanation("a")
    cars = tuple(contribution("object", f"objects[{i}]", (-1) ** i * 0.3, 0.1, 0.05) for i in range(12))
    many = replace(many, contributions=many.of_kind("parameter") + cars)
    heights = []
    for record in (few, many):
        plot_waterfalls(tmp_path / "shapley.png", record)
        heights.append(cv2.imread(str(tmp_path / "shapley.png")).shape[0])
    assert heights[1] > heights[0] + 10 * 40
