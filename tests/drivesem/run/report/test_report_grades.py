"""How sure failures are, on the page: headline, badges, draws, the table of kinds, and runs that do not say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from drivesem.cli import main
from drivesem.failures.grades import Certificate, SecondOpinion
from drivesem.run.report import page as grading
from drivesem.run.report.frames import build_cards
from drivesem.run.results import Failure, FrameResult
from drivesem.run.run_report import load_reported_runs
from tests.drivesem.invoke import run_json

CERTAIN = Certificate(16, 16, 15, 16, 1.42, -0.61)
CHANCE = Certificate(9, 16, 12, 16)
SECOND, PEER = SecondOpinion("generator", 4, 4, 4), SecondOpinion("yolov3-slim", 4, 1, 4)


def graded(frame: FrameResult, *grades: str, error: str = "missed") -> FrameResult:
    """The frame's failures with these grades; "none" is the threshold's of none of a kind."""

    def with_grade(failure: Failure, grade: str) -> Failure:
        if grade == "none":
            return replace(failure, grade="threshold")
        kind = "background" if failure.kind == "phantom" else error
        fields = {"grade": grade, "error": kind, "count": CHANCE if grade == "threshold" else CERTAIN}
        if grade in ("confirmed", "shared"):
            fields |= {"second": SECOND, "peer": replace(PEER, after=4) if grade == "shared" else PEER}
        return replace(failure, **fields)  # pyright: ignore[reportArgumentType]

    return replace(frame, failures=tuple(with_grade(f, g) for f, g in zip(frame.failures, grades, strict=True)))


@pytest.fixture
def run(tmp_path: Path, frame: Callable[..., FrameResult], make_run: Callable[..., Path]) -> Path:
    """Of five frames one fails by threshold, two for certain, one for a second renderer too, one not at all."""
    frames = [
        graded(frame("a", lost=True, phantom=True), "threshold", "threshold"),
        graded(frame("b", lost=True), "certain", error="placed"),
        graded(frame("c", lost=True, phantom=True), "none", "confirmed"),
        frame("d"),
        graded(frame("e", lost=True, phantom=True), "certain", "certain"),
    ]
    return make_run(tmp_path / "run", frames)


def page_of(run: Path, parse: Callable[[Path], Any]) -> tuple[Any, str]:
    assert main(["report", str(run)]) == 0
    found = parse(run / "report.html")
    assert not found.open_tags
    return found, " ".join(found.text.split())


def test_the_page_begins_with_the_highest_grade(run: Path, parse: Callable[[Path], Any]) -> None:
    found, text = page_of(run, parse)
    assert "1 confirmed failure of squeezedet, in 1 of 5 attacked frames" in text
    assert (
        "Confirmed: 1 on nothing. Only certain: 1 missed, 1 badly placed, 1 on nothing. "
        "More by threshold only: 1 missed, 1 on nothing, 1 none of a kind." in text
    )
    assert "certain failures4 of 71 confirmed, 0 shared" in text
    # by the highest grade, then how many of it
    assert [a["data-name"] for a in found.having("article")] == ["c", "e", "b", "a", "d"]
    assert [a["data-grade"] for a in found.having("article")] == ["3", "2", "2", "1", "0"]
    shots = text[text.index("Failures in close-up") : text.index("Failures by kind")]
    assert shots.index("confirmed") < shots.index("certain")
    assert "threshold" not in shots  # there are enough that are surer


def test_draws_and_second_opinions(run: Path, parse: Callable[[Path], Any]) -> None:
    _, text = page_of(run, parse)
    assert "found in 16/16 draws before → 1/16 after" in text
    assert "there in 0/16 draws before → 15/16 after" in text
    assert "+1.42 → −0.61" in text
    assert "generator agrees: there in 0/4 → 4/4" in text
    assert "yolov3-slim does not agree: there in 0/4 → 1/4" in text
    assert "lost Car, detected as far as visible, object 0" in text
    for rule in ("right in 15 of 16 draws or more before", "wrong in 12 of 16", "in 3 of 4 draws", "chance may"):
        assert rule in text


def test_the_table_of_kinds_adds_up(run: Path) -> None:
    (loaded,), _ = load_reported_runs([str(run)])
    rows = {row.name: row for row in grading.tabulate_kinds(loaded.frames)}
    # shared, confirmed, certain, threshold
    assert rows["missed"].counts == (0, 0, 1, 1)
    assert rows["badly placed"].counts == (0, 0, 1, 0)
    assert rows["on nothing"].counts == (0, 1, 1, 1)
    assert rows["none of a kind"].counts == (0, 0, 0, 1)
    assert sum(row.total for row in rows.values()) == loaded.summary.grades["threshold"] == 7
    (first, *_) = build_cards([loaded], 1)
    assert [mark.unsure for mark in first.layers[1].sets[0][1] if mark.kind in ("lost", "phantom")] == [
        True,
        False,
    ]


def test_a_page_without_certain_failures(
    tmp_path: Path, frame: Callable[..., Any], make_run: Callable[..., Path], parse: Callable[[Path], Any]
) -> None:
    one = graded(frame("a", lost=True, phantom=True), "threshold", "none")
    run = make_run(tmp_path / "run", [one, replace(frame("b"), grade_notes=())])
    _, text = page_of(run, parse)
    assert "No certain failure: 2 failures by threshold, which chance may explain" in text
    assert "none is certain" in text
    assert "By threshold only: 1 missed, 1 none of a kind." in text


def test_why_a_grade_was_not_reached(
    tmp_path: Path, frame: Callable[..., Any], make_run: Callable[..., Path], parse: Callable[[Path], Any]
) -> None:
    note = "no second renderer: expected EGL, found none"
    run = make_run(tmp_path / "run", [replace(graded(frame("a", lost=True), "certain"), grade_notes=(note,))])
    _, text = page_of(run, parse)
    assert f"{note} (1 frame)" in text
    assert text.count(note) == 2  # beside the grades, and with its frame


def test_runs_side_by_side_have_grades(
    run: Path,
    tmp_path: Path,
    frame: Callable[..., Any],
    make_run: Callable[..., Path],
    parse: Callable[[Path], Any],
) -> None:
    other = make_run(tmp_path / "other", [graded(frame("a", lost=True), "threshold"), frame("b")])
    out = tmp_path / "both.html"
    data = run_json("report", run, other, "--out", out)
    assert data["runs"][0]["grades"] == {"threshold": 3, "certain": 1, "confirmed": 0, "shared": 0}
    assert data["frames"][1]["grades"] == {"run": ["certain"], "other": []}
    assert data["frames"][1]["kinds"] == {"run": ["placed"], "other": []}
    found = parse(out)
    text = " ".join(found.text.split())
    assert "2 runs on 2 frames: run has most certain failures, 1 of 3 by threshold" in text
    assert "run: 1 certain of 1 lost" in text


def test_runs_with_equal_failures_share_the_headline(
    tmp_path: Path, frame: Callable[..., Any], make_run: Callable[..., Path], parse: Callable[[Path], Any]
) -> None:
    runs = [make_run(tmp_path / n, [graded(frame("a", lost=True), "certain"), frame("b")]) for n in ("one", "two")]
    out = tmp_path / "page.html"

    def page_text(*folders: Path) -> str:
        assert main(["report", *map(str, folders), "--out", str(out)]) == 0
        return " ".join(parse(out).text.split())

    assert "2 runs on 2 frames: both have as many certain failures, 1 each" in page_text(*runs)
    none = make_run(tmp_path / "none", [frame("a"), frame("b")])
    assert "3 runs on 2 frames: one and two have most certain failures, 1 each" in page_text(*runs, none)
    ungraded = [make_run(tmp_path / n, [frame("a", lost=True), frame("b")]) for n in ("three", "four")]
    assert "2 runs on 2 frames: both have as many broken frames by threshold, 1 each" in page_text(*ungraded)


@pytest.mark.parametrize(
    ("error", "count", "expected"),
    [
        ("missed", Certificate(16, 16, 15, 16), "found in 16/16 draws before → 1/16 after"),
        ("missed", Certificate(0, 0, 4, 9), "found in 5/9 draws after"),
        ("twice", Certificate(14, 16, 16, 16), "reported twice in 2/16 draws before → 16/16 after"),
        ("background", Certificate(16, 16, 13, 16), "there in 0/16 draws before → 13/16 after"),
        ("background", Certificate(), ""),
        (None, None, ""),
    ],
)
def test_draws_in_words(error: str | None, count: Certificate | None, expected: str) -> None:
    assert grading.format_draws(Failure("lost", "Car", (0, 0, 1, 1), error=error, count=count)) == expected


def test_frames_can_be_filtered_by_grade(chromium: Any, run: Path) -> None:
    assert main(["report", str(run)]) == 0
    tab = chromium.new_page()
    tab.goto((run / "report.html").as_uri())
    tab.locator("select[name=grade]").select_option("2")
    names = tab.locator("article:not(.hidden)").evaluate_all("all => all.map(e => e.dataset.name)")
    assert names == ["c", "e", "b"]
    tab.close()
