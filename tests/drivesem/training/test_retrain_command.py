"""`drivesem retrain`: from a run of attacks to the table of before and after."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from detectors.registry import load_detector
from detectors.training import LOG
from drivesem.cli import main
from tests.drivesem.invoke import invoke, run_json


@pytest.mark.slow
def test_a_run_is_learned_from_and_attacked_again(tmp_path: Path) -> None:
    run, out = tmp_path / "run", tmp_path / "out"
    attack = ["attack", "--limit", "6", "--combo", "1", "--steps", "3", "--workers", "1", "--out", str(run)]
    assert main(attack) == 0
    won = [json.loads(path.read_text())["success_moved"] for path in sorted(run.glob("frames/*/result.json"))]
    assert len(won) == 6
    assert any(won), "the demo's frames break the shipped detector"
    words = ["retrain", "--run", str(run), "--label-mode", "moved", "--steps", "3", "--batch", "2"]
    words += ["--window", "160x96", "--fraction", "0.5", "--ramp", "0.5", "--fresh", "1", "--workers", "1"]
    data = run_json(*words, "--out", out)
    rows = {(row["set"], row["labels"], row["detector"]): row for row in data["rows"]}
    assert len(rows) == 8
    assert {name for name, *_ in rows} == {"benign", "counterexamples of the run", "fresh counterexamples"}
    assert rows["fresh counterexamples", "moved", "after"]["frames"] == 1
    assert data["held_out"] == 2
    assert rows["benign", "paper", "before"]["ap50"] > 0.5
    assert load_detector(data["weights"]).t_star == pytest.approx(data["t_star"]["after"], rel=1e-4)
    assert len(list(csv.DictReader((out / "retrain.csv").read_text().splitlines()))) == 8
    assert (out / "retrain.md").read_text().count("\n") == 10
    log, fresh = (out / LOG).read_text(), sorted(out.glob("fresh/frames/*/result.json"))
    assert len(fresh) == 1
    written = fresh[0].stat().st_mtime_ns
    assert main([*words, "--out", str(out)]) == 0, "a run that is over stays as it is"
    assert ((out / LOG).read_text(), fresh[0].stat().st_mtime_ns) == (log, written)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--run", "nowhere"], "--run: expected a run's folder, with its config.yaml"),
        (["--run", "run"], "expected a run of drivesem attack with finished frames, found none"),
        (["--run", "other"], "--run: expected a run of drivesem attack, found other"),
        (["--run", "run", "--fraction", "1"], "--fraction: expected a fraction between 0 and 1"),
        (["--run", "run", "--validation", "0"], "--validation: expected a fraction between 0 and 1"),
        (["--run", "run", "--root", "x"], "--dataset and --root: expected both or none"),
    ],
)
def test_bad_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], message: str) -> None:
    monkeypatch.chdir(tmp_path)
    for name, text in (("run", "dataset: demo\n"), ("other", "photo: a.png\n")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.yaml").write_text(text)
    error = invoke("retrain", *words, code=2).err
    assert message in error
    assert error.count("\n") == 1
