"""`drivesem report` as a user types it: one run, several, a study, bad input."""

from __future__ import annotations

import json
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from drivesem.cli import main
from drivesem.config.commands import AttackConfig
from drivesem.config.parsing import parse
from drivesem.evaluation.coco import ClassScores, CocoScores
from drivesem.run.report.frames import build_cards
from drivesem.run.results import SCHEMA
from drivesem.run.run_report import (
    PROTOCOL,
    describe_next_step,
    load_reported_runs,
    query_curves,
    write_run_report,
)
from scene_ir import files
from tests.drivesem.counting import summary_of
from tests.drivesem.invoke import run_json


def test_one_run(some_run: Path) -> None:
    data = run_json("report", some_run)
    page = some_run / "report.html"
    assert data["out"] == str(page)
    assert data["bytes"] == page.stat().st_size
    (run,) = data["runs"]
    metrics = json.loads((some_run / "metrics.json").read_text())
    assert {key: run[key] for key in metrics if key not in ("out", "seconds")} == {
        key: value for key, value in metrics.items() if key not in ("out", "seconds")
    }
    assert run["paper"] is None  # which has another protocol
    assert [one["frame"] for one in data["frames"]] == ["000001", "000002", "000003", "0001/rain/00004"]
    assert data["frames"][3]["failures"] == {"some run": ["lost", "phantom"]}


def test_the_same_run_gives_the_same_page(some_run: Path) -> None:
    pages = []
    for _ in range(2):
        assert main(["report", str(some_run)]) == 0
        pages.append((some_run / "report.html").read_bytes())
    assert pages[0] == pages[1]


def test_an_attack_writes_the_same_page(some_run: Path) -> None:
    (loaded,), _ = load_reported_runs([str(some_run)])
    write_run_report(some_run, AttackConfig(), loaded.summary, loaded.frames)
    written = (some_run / "report.html").read_bytes()
    assert main(["report", str(some_run)]) == 0
    assert (some_run / "report.html").read_bytes() == written


def test_an_attack_without_any_frame(some_run: Path) -> None:
    """Where none could be used, the page says which and why."""
    (loaded,), _ = load_reported_runs([str(some_run)])
    failed = {"000009": "labels: expected a number, found x"}
    nothing = ClassScores(None, None, None, None, None, 0)
    scores = CocoScores(nothing, nothing, dict.fromkeys(loaded.summary.benign.per_class, nothing))
    summary = replace(
        loaded.summary,
        frames=0,
        frames_failed=failed,
        benign=scores,
        rerendered=scores,
        attacked_moved=scores,
        attacked_paper=scores,
        lost_objects={},
        phantoms={},
        feasible_fraction=None,
        successes_moved=0,
    )
    write_run_report(some_run, AttackConfig(), summary, [])
    text = (some_run / "report.html").read_text(encoding="utf-8")
    assert "000009 could not be used: labels: expected a number, found x" in text
    assert "– → –" in text


def test_runs_side_by_side(
    tmp_path: Path, frame: Callable[..., Any], make_run: Callable[..., Path], parse: Callable[[Path], Any]
) -> None:
    """Frames are matched by name; figures are of those that both have."""
    frames = [frame("1", lost=True), frame("2", lost=True), frame("only a", phantom=True)]
    a = make_run(tmp_path / "a", frames, AttackConfig(**PROTOCOL))  # pyright: ignore[reportArgumentType]
    b = make_run(tmp_path / "b", [frame("2"), frame("1", phantom=True)], AttackConfig(method="placebo", like="x"))
    out = tmp_path / "both.html"
    data = run_json("report", a, b, "--out", out)
    assert data["frames_left_out"] == 1
    assert [one["frame"] for one in data["frames"]] == ["1", "2"]
    assert data["frames"][0]["failures"] == {"a": ["lost"], "b": ["phantom"]}
    one, other = data["runs"]
    assert (one["frames"], one["lost_objects"], one["phantoms"], one["successes_moved"]) == (2, 2, 0, 2)
    assert (other["frames"], other["lost_objects"], other["phantoms"]) == (2, 0, 1)
    assert one["attacked"]["moved"]["recall_at_t_star"] == pytest.approx(0.5)
    assert other["attacked"]["moved"]["recall_at_t_star"] == pytest.approx(1.0)
    assert one["paper"] == {"before": 0.994, "after": 0.659}
    assert other["paper"] is None
    found = parse(out)
    articles = found.having("article")
    assert [(a["data-name"], a["data-lost"], a["data-phantoms"]) for a in articles] == [
        ("1", "1", "1"),
        ("2", "1", "0"),
    ]
    layers = [a for a in found.having("div") if a.get("class", "").split()[:1] == ["layer"]]
    assert [layer["data-title"] for layer in layers] == ["before", "a", "b"] * 2
    # the photograph's boxes are the same for both runs, and are there once
    assert len([a for a in found.having("div") if a.get("data-runs") == "0 1"]) == 2
    assert "a: 1 lost" in found.text
    assert "b: withstood" in found.text
    assert "1 frames that only some runs have are left out" in found.text


def test_metrics_of_all_frames_equal_the_runs(
    tmp_path: Path, frame: Callable[..., Any], make_run: Callable[..., Path]
) -> None:
    """Counted again on the frames that are shared, they are as `drivesem attack` counts them."""
    names = ("1", "2")
    a = make_run(tmp_path / "a", [frame(name, lost=name == "1", phantom=True) for name in names])
    b = make_run(tmp_path / "b", [frame(name) for name in (*names, "3")])
    alone = run_json("report", a)["runs"][0]
    compared = run_json("report", a, b, "--out", tmp_path / "page.html")["runs"][0]
    assert alone == compared


def test_a_study_stands_for_its_arms(
    tmp_path: Path, frame: Callable[..., Any], make_run: Callable[..., Path], parse: Callable[[Path], Any]
) -> None:
    study = tmp_path / "study"
    for name in ("random", "apgd"):
        make_run(study / "arms" / name, [frame("1", lost=name == "apgd")])
    (study / "arms" / "unfinished").mkdir()
    points = [
        {"name": name, "queries": q, "share": 0.5 * q, "low": 0.1, "high": 1.0}
        for name in ("random", "apgd")
        for q in (1, 2)
    ]
    files.write_json(study / "study.json", {"curves": points})
    data = run_json("report", study)
    assert [run["name"] for run in data["runs"]] == ["apgd", "random"]
    found = parse(study / "report.html")
    assert "Frames broken by number of queries" in found.text
    (chart,) = query_curves(study)
    assert [line.name for line in chart.lines] == ["apgd", "random"]
    assert chart.lines[1].points == ((1.0, 50.0), (2.0, 100.0))
    assert chart.lines[1].band == ((1.0, 10.0, 100.0), (2.0, 10.0, 100.0))


def test_frames_without_failure(tmp_path: Path, frame: Callable[..., Any], make_run: Callable[..., Path]) -> None:
    run = make_run(tmp_path / "run", [frame("1"), frame("2")])
    assert main(["report", str(run)]) == 0
    text = (run / "report.html").read_text(encoding="utf-8")
    assert "withstood in all of 2 attacked frames" in text
    assert "What went wrong" not in text


def test_large_pictures_are_made_smaller(
    tmp_path: Path, frame: Callable[..., Any], make_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivesem.run.report.frames.LARGEST_PX", 100)
    run = make_run(tmp_path / "run", [frame("1", lost=True)])
    loaded, _ = load_reported_runs([str(run)])
    (card,) = build_cards(loaded, 1)
    assert (card.width, card.height) == (320, 96)  # boxes stay in the picture's own px
    assert len(card.layers[0].source) < 2000


def test_no_run_in_the_folder(refused: Callable[..., str], tmp_path: Path) -> None:
    (tmp_path / "plain").mkdir()
    assert "expected a folder of drivesem attack" in refused("report", str(tmp_path / "plain"))


def test_no_finished_arm(refused: Callable[..., str], tmp_path: Path) -> None:
    (tmp_path / "study" / "arms" / "a").mkdir(parents=True)
    assert "expected a study with a finished arm" in refused("report", str(tmp_path / "study"))


def test_unfinished(refused: Callable[..., str], some_run: Path) -> None:
    (some_run / "metrics.json").unlink()
    assert "expected a finished run" in refused("report", str(some_run))


def test_damaged_metrics(refused: Callable[..., str], some_run: Path) -> None:
    files.write_json(some_run / "metrics.json", {"schema": SCHEMA, "params": ["mesh"], "detector": "x"})
    assert "metrics.json: expected the metrics of a run" in refused("report", str(some_run))


def test_no_shared_frame(
    refused: Callable[..., str], tmp_path: Path, frame: Callable[..., Any], make_run: Callable[..., Path]
) -> None:
    a, b = (make_run(tmp_path / name, [frame(name)]) for name in ("a", "b"))
    assert "expected runs that share frames" in refused("report", str(a), str(b))


def test_other_photographs(
    refused: Callable[..., str], tmp_path: Path, frame: Callable[..., Any], make_run: Callable[..., Path]
) -> None:
    a, b = (make_run(tmp_path / name, [frame("1")], tone=tone) for name, tone in (("a", 90), ("b", 91)))
    assert "expected runs on the same photographs, found another picture of frame 1" in refused(
        "report", str(a), str(b)
    )


def test_the_same_run_twice(refused: Callable[..., str], some_run: Path) -> None:
    assert "each run once" in refused("report", str(some_run), str(some_run))


def test_number_of_frames(refused: Callable[..., str], some_run: Path) -> None:
    assert "--frames: expected at least 1" in refused("report", str(some_run), "--frames", "0")


def test_out_is_a_folder(refused: Callable[..., str], some_run: Path) -> None:
    assert "--out: expected an HTML file" in refused("report", str(some_run), "--out", str(some_run))


def test_damaged_curves(refused: Callable[..., str], some_run: Path, tmp_path: Path) -> None:
    shutil.copytree(some_run, tmp_path / "study" / "arms" / "a")
    files.write_json(tmp_path / "study" / "study.json", {"curves": [{"name": "a"}]})
    assert "expected curves of a study" in refused("report", str(tmp_path / "study"))


def test_frames_that_were_not_attacked_are_in_no_denominator(
    tmp_path: Path, frame: Callable[..., Any], make_run: Callable[..., Path], parse: Callable[[Path], Any]
) -> None:
    missed = replace(frame("3", queries=0), found_before=(), detections_benign=(), detections_rerendered=())
    hidden = replace(frame("4", queries=0), judged=(), found_before=())
    run = make_run(tmp_path / "run", [frame("1", lost=True), frame("2"), missed, hidden])
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["objects"] == {"all": 8, "judged": 6, "found_before": 4}
    assert (metrics["frames"], metrics["frames_attacked"]) == (4, 2)
    assert metrics["broken"] == {"count": 1, "of": 2} | {key: metrics["broken"][key] for key in ("low", "high")}
    assert (metrics["lost_by_grade"]["threshold"]["count"], metrics["missed_before"]["count"]) == (1, 2)
    assert main(["report", str(run)]) == 0
    text = " ".join(parse(run / "report.html").text.split())
    assert "4 frames: 2 attacked, 2 not attacked (no vehicle judged and found before)" in text
    assert "8 vehicles: 6 judged, 4 found before the attack" in text
    assert "not attacked: none of 2 judged objects is found before" in text
    assert "not attacked: none of 2 objects is judged: under 25 px high" in text
    assert "25 % [5, 70] of vehicles found before" in text
    assert "33 % [10, 70] of judged vehicles" in text
    assert text.count("withstood") == 2  # frame 2, in the gallery and in the table


_WEATHER = {"params": ("weather",)}


@pytest.mark.parametrize(
    ("config", "change", "expected"),
    [
        (
            {"combo": 2, "steps": 2, "momentum": 1.0, "grade": False},
            {},
            "next, add weather: drivesem attack --out a/run-weather --params translate,rotate,mesh,weather "
            "--method climb",
        ),
        (
            {"combo": 2, "dataset": "coco", "root": "data/b dd", "limit": 3, "method": "random"},
            {},
            "next, add weather: drivesem attack --out a/run-weather --limit 3 --dataset coco --root 'data/b dd' "
            "--params translate,rotate,mesh,weather --method random",
        ),
        (
            {"params": "weather"},
            _WEATHER,
            "next, widen the budget: drivesem attack --out a/run-street --budget street --params weather "
            "--method climb",
        ),
        (
            {"params": "weather", "budget": "street", "method": "climb", "passes": 100},
            _WEATHER,
            "next, search longer: drivesem attack --out a/run-longer --budget street --params weather "
            "--method climb --passes 200",
        ),
        (
            {"combo": 2},
            {"grades": {"certain": 1}},
            "next: drivesem explain a/run (which change causes each failure), drivesem holes a/run (where else it "
            "fails), drivesem view a/run (in the browser)",
        ),
        (
            {"combo": 2},
            {"frames_not_attacked": {"1": "none of 2 vehicles is judged: too small"}},
            "nothing to attack: 2 judged, 2 found by squeezedet, of 2 vehicles (1 frame: none of 2 vehicles is judged: "
            "too small); next: a detector that finds them, lower --t-star, or other frames",
        ),
    ],
)
def test_the_next_step_fits_the_run(
    config: dict[str, Any], change: dict[str, Any], expected: str, frame: Callable[..., Any]
) -> None:
    attack = AttackConfig(**config)
    summary = replace(summary_of(attack, [frame("1")]), out="a/run")
    text = describe_next_step(attack, replace(summary, **change))
    assert text == expected
    if ": drivesem attack" in text:
        parse(shlex.split(text.partition("drivesem ")[2])).check()  # a command that is accepted
