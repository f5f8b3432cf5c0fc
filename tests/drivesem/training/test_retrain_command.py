"""`drivesem retrain`: from a run of attacks to the table of before and after."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from detectors.registry import load_detector
from detectors.training import LOG
from detectors.types import Detections, Targets
from drivesem.cli import main
from drivesem.training.retrain import compare_retrained
from tests.drivesem.invoke import invoke, run_json

CAR = torch.tensor([[10.0, 10.0, 60.0, 40.0]])


def _detections(score: float) -> Detections:
    return Detections(CAR, torch.tensor([0]), torch.tensor([score]))


@pytest.mark.parametrize(
    ("frames", "before", "after", "verdict"),
    [
        pytest.param(1, 0.9, 0.2, "too few to tell", id="one frame has no interval"),
        pytest.param(5, 0.9, 0.2, "too few to tell", id="five frames allow p of 0.06 at least"),
        pytest.param(12, 0.9, 0.2, "worse", id="all of twelve fall below t*"),
        pytest.param(12, 0.2, 0.9, "better", id="all of twelve rise above t*"),
        pytest.param(12, 0.9, 0.8, "too few to tell", id="the same"),
    ],
)
def test_the_verdict_on_recall_needs_frames(frames: int, before: float, after: float, verdict: str) -> None:
    detectors: Any = [SimpleNamespace(name="d", classes=("Car",), t_star=0.5)] * 2
    truths = [[Targets(CAR, torch.tensor([0]), torch.tensor([False]))] * frames] * 2
    found = [[_detections(score)] * frames for score in (before, after)]
    ap50, recall = compare_retrained("benign", detectors, truths, found, 0)
    assert (recall.count, recall.objects, recall.verdict) == (frames, frames, verdict)
    assert recall.compared.difference == pytest.approx((after > 0.5) - (before > 0.5))
    assert recall.cells()[-2:] == (
        f"{frames} frame{'s' * (frames > 1)}, {frames} object{'s' * (frames > 1)}",
        verdict,
    )
    # average precision does not depend on t*
    assert (ap50.compared.first, ap50.compared.second) == pytest.approx((1, 1))
    assert ap50.verdict == "too few to tell"


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
    verdicts = {(row["set"], row["metric"]): row for row in data["verdicts"]}
    sets = ("benign", "counterexamples of the run", "counterexamples against each")
    assert set(verdicts) == {(name, metric) for name in sets for metric in ("AP50", "recall at t*")}
    assert {row["verdict"] for row in verdicts.values()} == {"too few to tell"}, "two frames prove nothing"
    benign = verdicts["benign", "recall at t*"]
    assert benign["frames"] == 2
    assert benign["before"] == pytest.approx(rows["benign", "paper", "before"]["recall_at_t_star"])
    assert benign["after"] == pytest.approx(rows["benign", "paper", "after"]["recall_at_t_star"])
    assert {name for name, *_ in rows} == {"benign", "counterexamples of the run", "fresh counterexamples"}
    assert rows["fresh counterexamples", "moved", "after"]["frames"] == 1
    assert data["held_out"] == 2
    assert rows["benign", "paper", "before"]["ap50"] > 0.5
    assert load_detector(data["weights"]).t_star == pytest.approx(data["t_star"]["after"], rel=1e-4)
    assert len(list(csv.DictReader((out / "retrain.csv").read_text().splitlines()))) == 8
    page = (out / "retrain.md").read_text()
    assert page.count("too few to tell |") == len(verdicts)
    assert "each with the best F1 on the 2 validation photographs" in page
    log, fresh = (out / LOG).read_text(), sorted(out.glob("fresh/frames/*/result.json"))
    assert len(fresh) == 1
    written = fresh[0].stat().st_mtime_ns
    assert main([*words, "--out", str(out)]) == 0, "a run that is over stays as it is"
    assert ((out / LOG).read_text(), fresh[0].stat().st_mtime_ns) == (log, written)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--run", "nowhere"], "--run: expected a run's folder, with its config.yaml"),
        (["--run", "run"], "expected a run of drivesem attack with attacked frames, found none"),
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
