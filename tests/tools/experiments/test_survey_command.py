"""The survey's page, what it tells and what not; and what people said, counted by hand."""

from __future__ import annotations

import base64
import csv
import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from drivesem.run.finished import load_run
from drivesem.run.results import BoxRecord, dump_frame, load_frame
from scene_ir.errors import ShapeError
from tools.experiments.__main__ import main
from tools.experiments.survey.page import COLUMNS, draw_items


@pytest.fixture
def survey(write_run: Callable[..., Path], tmp_path: Path) -> Path:
    """Two counterexamples and a control."""
    words = ["--items", "2", "--controls", "1", "--out", str(tmp_path / "survey")]
    assert main(["survey", str(write_run(tmp_path / "run")), *words]) == 0
    return tmp_path / "survey"


def key_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "survey-key.json").read_text())


def answers(path: Path, name: str, person: str, *rows: tuple[str, str, object]) -> Path:
    """Rows: item, named, realism."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for place, (item, named, realism) in enumerate(rows, start=1):
            writer.writerow([name, person, item, place, named, realism, 3.5])
    return path


def test_the_page_stands_alone_and_keeps_the_truth_to_itself(survey: Path) -> None:
    page = (survey / "survey.html").read_text()
    assert not re.search(
        r"(src|href)=\"(?!data:)[^\"]+\"|https?://|@import|<link (?!rel=\"icon\" href=\"data:,\">)", page
    )
    assert page.count("data:image/jpeg;base64,") == 6
    script = page.partition("<script>")[2].partition("</script>")[0]
    known = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{known}'" in page
    assert page.count("<script") == 2  # and the pictures, which are data
    key = key_of(survey)
    assert [item["truth"] for item in key["items"]] == ["Car"] * 3
    assert sorted(item["kind"] for item in key["items"]) == ["counterexample", "counterexample", "unchanged"]
    # successes come first, and frame c is none
    assert {item["frame"] for item in key["items"] if item["kind"] == "counterexample"} == {"a", "b"}
    assert [item["frame"] for item in key["items"] if item["kind"] == "unchanged"] == ["c"]
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.S)[1])  # pyright: ignore[reportOptionalSubscript]
    assert data["survey"] == key["survey"]
    assert {frozenset(item) for item in data["items"]} == {frozenset(("item", "original", "changed", "outline"))}
    for kind in ("unchanged", "counterexample"):
        assert f'"{kind}"' not in page
    by_name = {item["item"]: item["kind"] for item in key["items"]}
    for item in data["items"]:
        assert (item["original"] == item["changed"]) == (by_name[item["item"]] == "unchanged")
        x0, y0, x1, y1 = item["outline"]
        assert 0 <= x0 < x1 <= 1
        assert 0 <= y0 < y1 <= 1


def test_the_same_command_makes_the_same_survey(survey: Path, tmp_path: Path) -> None:
    words = ["survey", str(tmp_path / "run"), "--items", "2", "--controls", "1", "--out"]
    assert main([*words, str(tmp_path / "again")]) == 0
    assert (tmp_path / "again" / "survey.html").read_bytes() == (survey / "survey.html").read_bytes()
    assert main([*words, str(tmp_path / "other"), "--seed", "1"]) == 0
    assert key_of(tmp_path / "other")["survey"] != key_of(survey)["survey"]


def test_of_vehicles_that_left_or_parked_those_are_given_that_the_picture_has(
    write_run: Callable[..., Path], tmp_path: Path
) -> None:
    """The first car left and a lorry parked; people are asked about the lorry, where it stands, and of the picture
    without any change about the car."""
    folder, nowhere = write_run(tmp_path / "run"), (0.0, 0.0, 0.0, 0.0)
    for path in (folder / "frames" / "a").glob("*.png"):
        cv2.imwrite(str(path), np.zeros((400, 800, 3), np.uint8))
    path = folder / "frames" / "a" / "result.json"
    result, car, lorry = load_frame(path), (20.0, 200.0, 80.0, 240.0), (600.0, 300.0, 700.0, 360.0)
    before = (BoxRecord(car, "Car", index=0), BoxRecord(nowhere, "Truck", ignore=True, index=1))
    after = (BoxRecord(nowhere, "Car", ignore=True, index=0), BoxRecord(lorry, "Truck", ignore=True, index=1))
    path.write_text(dump_frame(replace(result, targets_benign=before, targets_moved=after)))
    found = {item.kind: (item, view) for item, view in draw_items([load_run(folder, limit=1)], 1, 1, 0)}
    (changed, view), (unchanged, _) = found["counterexample"], found["unchanged"]
    assert (changed.object, changed.truth) == (1, "Truck")
    assert (unchanged.object, unchanged.truth) == (0, "Car")
    # a view of 320 x 180 px around the lorry
    x0, y0, x1, y1 = view.outline_xyxy
    assert (x1 - x0, y1 - y0) == (pytest.approx(100 / 320), pytest.approx(60 / 180))
    gone = replace(result, targets_benign=before[:1], targets_moved=after[:1])
    path.write_text(dump_frame(gone))
    with pytest.raises(ShapeError, match="expected a run with vehicles"):
        draw_items([load_run(folder, limit=1)], 1, 1, 0)


def test_fewer_frames_than_requested_for(
    write_run: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["survey", str(write_run(tmp_path / "run")), "--json"]) == 0
    output = capsys.readouterr()
    assert json.loads(output.out)["counterexample"] == 3
    assert "only 3 of 15 pictures" in output.err


def test_results(survey: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key = key_of(survey)
    name = key["survey"]
    one, two = (item["item"] for item in key["items"] if item["kind"] == "counterexample")
    (same,) = (item["item"] for item in key["items"] if item["kind"] == "unchanged")
    files = [
        answers(tmp_path / "a.csv", name, "ann", (one, "Car", 8), (two, "Other", 3), (same, "Car", 10)),
        answers(tmp_path / "b.csv", name, "bob", (one, "Car", 6), (two, "Car", 4), (same, "Car", 10)),
        answers(tmp_path / "c.csv", name, "cem", (one, "Car", 7)),
    ]
    capsys.readouterr()
    assert main(["survey-results", *map(str, files), "--survey", str(survey), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert json.loads((survey / "results" / "survey.json").read_text()) == data
    assert (data["people"], data["answers"]) == (3, 7)
    changed, control = data["kinds"]["counterexample"], data["kinds"]["unchanged"]
    assert changed["named_right"] == pytest.approx(4 / 5)
    assert changed["realism_mean"] == pytest.approx(28 / 5)
    assert changed["realism_median"] == 6
    assert changed["realism_average_median"] == pytest.approx((7 + 3.5) / 2)
    assert changed["realism_mean_low"] <= changed["realism_mean"] <= changed["realism_mean_high"]
    # within: (16 - 4 + ...) worked out: pairs of 8, 6, 7 over 2, of 3, 4 over 1; expected: all pairs of five
    within = ((4 + 1 + 1) * 2 / 2 + 1 * 2 / 1) / 5
    values = (8, 6, 7, 3, 4)
    expected = sum((a - b) ** 2 for a in values for b in values) / (5 * 4)
    assert changed["alpha_realism"] == pytest.approx(1 - within / expected)
    assert (control["named_right"], control["realism_mean"], control["alpha_realism"]) == (1, 10, None)
    lines = {
        line["item"]: line for line in csv.DictReader((survey / "results" / "survey.csv").read_text().splitlines())
    }
    assert (lines[one]["answers"], lines[one]["realism_mean"]) == ("3", "7.0")
    assert "| named correctly, % | 80.0" in (survey / "results" / "survey.md").read_text()


def test_bad_input(survey: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
    name, item = key_of(survey)["survey"], key_of(survey)["items"][0]["item"]

    def says(*words: object) -> str:
        line = refused(*map(str, words))
        (tmp_path / "empty").rmdir()
        return line

    def of(*rows: tuple[str, str, object], name: str = name, person: str = "ann") -> str:
        path = answers(tmp_path / "bad.csv", name, person, *rows)
        return says("survey-results", path, "--survey", survey)

    good = answers(tmp_path / "good.csv", name, "ann", (item, "Car", 5))
    assert "CSV: expected files" in says("survey-results", "--survey", survey)
    assert "--survey: expected the folder" in says("survey-results", good)
    assert "survey-key.json: expected a readable file" in says("survey-results", good, "--survey", tmp_path)
    assert "ann again" in says("survey-results", good, good, "--survey", survey)
    assert "none in them" in of()
    assert f"bad.csv:2: survey: expected {name}, found 'x'" in of((item, "Car", 5), name="x")
    assert "bad.csv:2: item: expected an item" in of(("x", "Car", 5))
    assert "bad.csv:2: named: expected one of Car" in of((item, "Ship", 5))
    for rating in ("0", "11", "5.5", "", "nan"):
        assert "bad.csv:2: realism: expected a whole number from 1 to 10" in of((item, "Car", rating))
    assert "bad.csv:2: participant" in of((item, "Car", 5), person="")
    assert "bad.csv:3: expected each item once" in of((item, "Car", 5), (item, "Car", 6))
    (tmp_path / "bad.csv").write_text("a,b\n1,2\n")
    assert "no survey" in says("survey-results", tmp_path / "bad.csv", "--survey", survey)
    (tmp_path / "key.json").write_text("{}")
    assert "expected a key" in says("survey-results", good, "--survey", tmp_path / "key.json")
    assert "RUN: expected folders" in says("survey")
    assert "--items: expected at least 1" in says("survey", tmp_path / "run", "--items", "0")
    assert "--out: expected a folder" in says("survey", tmp_path / "run", "--out", good)


@pytest.mark.slow
def test_the_page_in_a_browser(survey: Path, tmp_path: Path, chromium: Any) -> None:
    """By keyboard alone: names, ratings, a file that survey-results takes; no error, no request."""
    faults: list[str] = []
    requested: list[str] = []
    page = chromium.new_page(viewport={"width": 390, "height": 800})
    page.on("console", lambda message: faults.append(message.text))
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("request", lambda request: requested.append(request.url))
    page.goto((survey / "survey.html").as_uri())
    page.keyboard.press("Tab")
    page.keyboard.type('Ann, "A"')
    page.keyboard.press("Enter")
    for _ in range(3):
        assert page.locator("#naming").is_visible()
        assert not page.locator("#rating").is_visible()
        page.locator("input[name=named]").first.focus()
        page.keyboard.press("Space")
        page.keyboard.press("Enter")
        assert page.locator("#rating").is_visible()
        page.locator("input[name=realism]").first.focus()
        for _ in range(4):
            page.keyboard.press("ArrowRight")
        page.keyboard.press("Enter")
    with page.expect_download() as download:
        page.locator("#save").click()
    download.value.save_as(tmp_path / "answers.csv")
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.close()
    assert not faults
    assert requested
    assert not [url for url in requested if not url.startswith(("file:", "data:", "blob:"))]
    assert main(["survey-results", str(tmp_path / "answers.csv"), "--survey", str(survey), "--json"]) == 0
    rows = list(csv.DictReader((tmp_path / "answers.csv").read_text().splitlines()))
    assert {row["participant"] for row in rows} == {'Ann, "A"'}
    assert {row["realism"] for row in rows} == {"5"}
    assert sorted(row["item"] for row in rows) == sorted(item["item"] for item in key_of(survey)["items"])
