"""Methods as a user types them, on an embedded scene; budgets in a run; options that belong to other methods."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from detectors.base import AnchorPredictions, Detector
from detectors.types import CLASSES, Detections
from drivesem.attacks.objective import Objective
from drivesem.run import attack as run_attack
from drivesem.run.finished import load_runs
from drivesem.run.results import load_frame
from tests.drivesem.invoke import invoke

WORDS = ["attack", "--detector", "any", "--limit", "1", "--workers", "1", "--json", "--steps", "3"]


class Dazzled(Detector):
    """Sees a car in a corner where there is none, surer the darker the picture is than the first it was displayed."""

    name, classes, t_star = "dazzled", CLASSES, 0.5

    def __init__(self) -> None:
        super().__init__()
        self.usual: float | None = None

    def forward(self, images: torch.Tensor) -> AnchorPredictions:
        mean = images.mean()
        if self.usual is None:
            self.usual = float(mean)
        score = 0.3 + 20 * (self.usual - mean)
        box = torch.tensor([[[0.0, 0.0, 20.0, 20.0]]])
        return AnchorPredictions(box, box, score.expand(1, 1, len(CLASSES)), score.expand(1, 1), (2, 2))

    def loss(self, raw: AnchorPredictions, targets: Any) -> dict[str, torch.Tensor]:
        return {"objectness": raw.confidence_logits.sum()}

    def decode(self, raw: AnchorPredictions) -> list[Detections]:
        score = raw.confidence_logits[0].clamp(0, 1)
        return [Detections(raw.boxes_xyxy[0], torch.tensor([CLASSES.index("Car")]), score)]


def attack(words: list[str], out: Path) -> dict[str, Any]:
    return json.loads(invoke(*WORDS, "--out", out, *words).out)


@pytest.fixture(autouse=True)
def dazzled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_attack, "load_predictor", lambda *_: Dazzled())
    monkeypatch.setattr(Objective, "_count_vehicles", lambda _: ((0,), (0,)))  # something can be lost


@pytest.mark.parametrize(
    ("words", "queries"),
    [
        (["--method", "sgd", "--rate", "1"], 3),
        (["--method", "sgd", "--step-form", "raw", "--rate", "2", "--momentum", "0.5"], 3),
        (["--momentum", "1"], 3),
        (["--method", "scw", "--queries", "5", "--norm", "1"], 5),
    ],
)
def test_gradient_methods(words: list[str], queries: int, tmp_path: Path) -> None:
    metrics = attack(["--params", "weather,translate", *words], tmp_path)
    assert metrics["queries"] == queries
    assert metrics["feasible_fraction"] == 1.0
    assert metrics["attacked"]["moved"]["ap50"] is not None
    result = load_frame(tmp_path / "frames" / "demo-000" / "result.json")
    assert result.success_moved
    assert [failure.kind for failure in result.failures] == ["phantom"]
    assert any(c.value != 0 for c in result.theta)


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["--early-stop"],
        ["--method", "apgd"],
        ["--method", "sgd"],
        ["--method", "scw"],
        ["--method", "halton"],
        ["--method", "cma-es"],
        ["--method", "corners"],
        ["--method", "climb"],
    ],
    ids=" ".join,
)
def test_no_method_exceeds_its_passes(words: list[str], tmp_path: Path) -> None:
    metrics = attack(["--params", "translate", "--passes", "40", *words], tmp_path)
    assert 0 < metrics["passes"] <= 40
    if words in ([], ["--method", "halton"]):
        assert metrics["passes"] > 30


def test_a_budget_from_a_file_is_recorded_in_numbers(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("translate: 0.02m\nweather: 0.125\n")
    out = tmp_path / "run"
    attack(["--params", "weather,translate,rotate", "--budget", str(own)], out)
    own.unlink()
    assert yaml.safe_load((out / "config.yaml").read_text())["budget"] == "weather=0.125,translate=0.02m"
    theta = json.loads((out / "frames" / "demo-000" / "theta.json").read_text())
    assert theta["weather.time_of_day"]["bounds"][1] <= 0.125
    assert theta["weather.time_of_day"]["value"] == pytest.approx(0.125)
    assert theta["objects[0].translate.along"]["bounds"][1] < 0.02
    assert theta["objects[0].yaw"]["bounds"] == pytest.approx([-0.35, 0.35])
    displayed = [float(c["display"].split()[0]) for name, c in theta.items() if "translate" in name]
    assert max(map(abs, displayed)) == pytest.approx(0.02, abs=1e-4)
    (run,) = load_runs([str(out)])
    assert (run.params, len(run.frames)) == ("weather,translate,rotate", 1)
    # The same numbers, written out, are the same run: it is finished already.
    words = ["--params", "weather,translate,rotate", "--budget", "translate=0.02m,weather=0.125"]
    before = (out / "frames" / "demo-000" / "result.json").stat().st_mtime_ns
    attack(words, out)
    assert (out / "frames" / "demo-000" / "result.json").stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--rate", "0"], "--rate: expected a number above 0, found 0"),
        (
            ["--method", "fgsm", "--rate", "2"],
            "--rate: expected only with --method si-fgsm, apgd, sgd, scw, found --method fgsm",
        ),
        (["--step-form", "raw"], "--step-form: expected only with --method sgd, found --method si-fgsm"),
        (
            ["--method", "scw", "--momentum", "1"],
            "--momentum: expected only with --method si-fgsm, sgd, found --method scw",
        ),
        (["--momentum", "2"], "--momentum: expected a number in [0, 1], found 2"),
        (["--norm", "1"], "--norm: expected only with --method scw, found --method si-fgsm"),
        (
            ["--method", "sgd", "--queries", "9"],
            "--queries: expected only with --method random, halton, cma-es, scw",
        ),
        (["--method", "halton", "--queries", "9", "--passes", "50"], "--queries: expected no --passes"),
        (["--passes", "10"], "--passes: expected at least 24, which the search needs, found 10"),
        (["--budget", "parkng"], "--budget: expected paper, parking, street, a YAML file, or NAME=VALUE"),
        (["--budget", "nowhere.yaml"], "nowhere.yaml: expected a readable file"),
        (["--budget", "spin=1"], "--budget: spin: expected one of color, weather"),
        (["--budget", "street,wide"], "--budget: expected paper, parking, street, a YAML file, or NAME=VALUE"),
        (["--budget", "street,rotate=21deg"], "--budget: rotate: expected a positive number of at most 0.35"),
    ],
)
def test_invalid_options_are_named(words: list[str], message: str, refused: Callable[..., str]) -> None:
    assert refused(*WORDS, *words).startswith(f"drivesem: {message}")
