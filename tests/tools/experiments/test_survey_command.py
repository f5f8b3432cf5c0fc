"""The survey's page, what it tells and what not; and what people said, counted by hand."""

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
from tests.drivesem.commands.conftest import write_finished_run
from tools.experiments.__main__ import main
from tools.experiments.survey.page import COLUMNS, draw_items


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two counterexamples and a control, of the run beside it."""
    out = tmp_path_factory.mktemp("survey") / "survey"
    words = ["--items", "2", "--controls", "1", "--out", str(out)]
    assert main(["survey", str(write_finished_run(out.parent / "run")), *words]) == 0
    return out


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
    words = ["survey", str(survey.parent / "run"), "--items", "2", "--controls", "1", "--out"]
    assert main([*words, str(tmp_path / "again")]) == 0
    assert (tmp_path / "again" / "survey.html").read_bytes() == (survey / "survey.html").read_bytes()
    assert main([*words, str(tmp_path / "other"), "--seed", "1"]) == 0
    assert key_of(tmp_path / "other")["survey"] != key_of(survey)["survey"]


def test_of_vehicles_that_left_or_parked_those_are_given_that_the_picture_has(run: Path) -> None:
    """The first car left and a lorry parked; people are asked about the lorry, where it stands, and of the picture
    without any change about the car."""
    nowhere = (0.0, 0.0, 0.0, 0.0)
    for path in (run / "frames" / "a").glob("*.png"):
        cv2.imwrite(str(path), np.zeros((400, 800, 3), np.uint8))
    path = run / "frames" / "a" / "result.json"
    result, car, lorry = load_frame(path), (20.0, 200.0, 80.0, 240.0), (600.0, 300.0, 700.0, 360.0)
    before = (BoxRecord(car, "Car", index=0), BoxRecord(nowhere, "Truck", ignore=True, index=1))
    after = (BoxRecord(nowhere, "Car", ignore=True, index=0), BoxRecord(lorry, "Truck", ignore=True, index=1))
    path.write_text(dump_frame(replace(result, targets_benign=before, targets_moved=after)))
    found = {item.kind: (item, view) for item, view in draw_items([load_run(run, limit=1)], 1, 1, 0)}
    (changed, view), (unchanged, _) = found["counterexample"], found["unchanged"]
    assert (changed.object, changed.truth) == (1, "Truck")
    assert (unchanged.object, unchanged.truth) == (0, "Car")
    # a view of 320 x 180 px around the lorry
    x0, y0, x1, y1 = view.outline_xyxy
    assert (x1 - x0, y1 - y0) == (pytest.approx(100 / 320), pytest.approx(60 / 180))
    gone = replace(result, targets_benign=before[:1], targets_moved=after[:1])
    path.write_text(dump_frame(gone))
    with pytest.raises(ShapeError, match="expected a run with vehicles"):
        draw_items([load_run(run, limit=1)], 1, 1, 0)


def test_fewer_frames_than_requested_for(capsys: pytest.CaptureFixture[str], run: Path) -> None:
    assert main(["survey", str(run), "--json"]) == 0
    output = capsys.readouterr()
    assert json.loads(output.out)["counterexample"] == 3
    assert "only 3 of 15 pictures" in output.err


def test_results(survey: Path, tmp_path: Path, output_json: Callable[..., Any]) -> None:
    key = key_of(survey)
    name = key["survey"]
    one, two = (item["item"] for item in key["items"] if item["kind"] == "counterexample")
    (same,) = (item["item"] for item in key["items"] if item["kind"] == "unchanged")
    files = [
        answers(tmp_path / "a.csv", name, "ann", (one, "Car", 8), (two, "Other", 3), (same, "Car", 10)),
        answers(tmp_path / "b.csv", name, "bob", (one, "Car", 6), (two, "Car", 4), (same, "Car", 10)),
        answers(tmp_path / "c.csv", name, "cem", (one, "Car", 7)),
    ]
    data = output_json("survey-results", *files, "--survey", survey)
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


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "none in them"),
        ([{"survey": "x"}], "bad.csv:2: survey: expected "),
        ([{"item": "x"}], "bad.csv:2: item: expected an item"),
        ([{"named": "Ship"}], "bad.csv:2: named: expected one of Car"),
        *(
            ([{"realism": x}], "bad.csv:2: realism: expected a whole number from 1 to 10")
            for x in ("0", "11", "5.5")
        ),
        *(([{"realism": x}], "bad.csv:2: realism: expected a whole number from 1 to 10") for x in ("", "nan")),
        ([{"participant": ""}], "bad.csv:2: participant"),
        ([{}, {"realism": "6"}], "bad.csv:3: expected each item once"),
    ],
)
def test_bad_answers(
    rows: list[dict[str, str]], message: str, survey: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    key = key_of(survey)
    good = {"survey": key["survey"], "participant": "ann", "item": key["items"][0]["item"], "named": "Car"}
    with (tmp_path / "bad.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, restval="5")
        writer.writeheader()
        writer.writerows([good | row for row in rows])
    assert message in refused("survey-results", str(tmp_path / "bad.csv"), "--survey", str(survey))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--survey {survey}", "CSV: expected files"),
        ("{good}", "--survey: expected the folder"),
        ("{good} --survey {good.parent}", "survey-key.json: expected a readable file"),
        ("{good} {good} --survey {survey}", "ann again"),
        ("{table} --survey {survey}", "no survey"),
        ("{good} --survey {key}", "expected a key"),
    ],
)
def test_bad_files(words: str, message: str, survey: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
    key = key_of(survey)
    good = answers(tmp_path / "good.csv", key["survey"], "ann", (key["items"][0]["item"], "Car", 5))
    (tmp_path / "table.csv").write_text("a,b\n1,2\n")
    (tmp_path / "key.json").write_text("{}")
    paths = {"survey": survey, "good": good, "table": tmp_path / "table.csv", "key": tmp_path / "key.json"}
    assert message in refused("survey-results", *words.format_map(paths).split())


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
