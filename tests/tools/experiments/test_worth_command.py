"""Experiment `worth` on hand-made runs and tables."""

import csv
import json
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from detectors.base import Predictor
from detectors.types import Detections
from drivesem.run import detection_cache as looking
from drivesem.training.retrain import WEIGHTS
from scene_ir import files
from tests.drivesem.commands.conftest import write_finished_run
from tools.experiments.__main__ import main

CARS = [[13.0, 20.0, 63.0, 50.0], [73.0, 10.0, 128.0, 60.0]]


class Sees:
    """A detector that finds the first `count` of the moved cars in every picture."""

    name, classes, t_star = "sees", ("Car",), 0.5

    def __init__(self, count: int) -> None:
        self.count = count

    def forward(self, images: torch.Tensor) -> list[int]:
        return [0] * len(images)

    def decode(self, raw: list[int]) -> list[Detections]:
        n = self.count
        one = Detections(torch.tensor(CARS[:n]).reshape(-1, 4), torch.zeros(n, dtype=torch.int64), torch.ones(n))
        return [one] * len(raw)


@pytest.fixture
def worth(output_json: Callable[..., Any]) -> Callable[..., Any]:
    return partial(output_json, "worth")


def pick(data: dict[str, Any], of: str, **which: object) -> dict[str, Any]:
    found = [r for r in data["rows"] if of in r["set"] and all(r[k] == v for k, v in which.items())]
    (row,) = found
    return row


def entropy(*shares: float) -> float:
    return -sum(p * math.log(p) for p in shares if p)


def test_runs(worth: Callable[..., Any], run: Path) -> None:
    """Three frames of two cars; afterwards a car of two frames is lost: 4 cars, and 2 cars with 6 empty places."""
    data = worth(run, "--distance", "perceptual")
    assert json.loads((run / "worth" / "worth.json").read_text()) == data
    before = pick(data, "photographs", membership="binary", realism_weight=False)
    assert (before["value"], before["points"]) == (0, 12)
    after = pick(data, "counterexamples", membership="binary", realism_weight=False)
    assert after["value"] == pytest.approx(8 / 12 * entropy(2 / 8, 6 / 8))
    assert after["low"] <= after["value"] <= after["high"]
    # 0.8 of each car that is found, 0.2 and all of a lost one are nothing: 3.2 cars; 2.8 cars and 6 empty places
    fractional = pick(data, "counterexamples", membership="fractional", realism_weight=False)
    assert fractional["value"] == pytest.approx(8.8 / 12 * entropy(2.8 / 8.8, 6 / 8.8))
    # lost cars changed most: they count for less
    weighted = pick(data, "counterexamples", membership="binary", realism_weight=True)
    assert 0 < weighted["value"] < after["value"]
    lines = list(csv.DictReader((run / "worth" / "worth.csv").read_text().splitlines()))
    assert len(lines) == len(data["rows"]) == 8
    assert "| run (rotate): counterexamples |" in (run / "worth" / "worth.md").read_text()


def test_nothing_changed(tmp_path: Path, worth: Callable[..., Any]) -> None:
    data = worth(write_finished_run(tmp_path / "same", same=True), "--distance", "perceptual")
    for kind in ("binary", "fractional"):
        for weighted in (False, True):
            which = {"membership": kind, "realism_weight": weighted}
            before, after = (pick(data, of, **which)["value"] for of in ("photographs", "counterexamples"))
            assert before == pytest.approx(after, abs=1e-12)


@pytest.mark.parametrize(("count", "gain"), [(2, 8 / 12 * entropy(2 / 8, 6 / 8)), (0, None)])
def test_gain_of_a_second_detector(
    count: int, gain: float | None, worth: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, run: Path
) -> None:
    monkeypatch.setattr(looking, "load_predictor", lambda *_: Sees(count))
    data = worth(run, "--distance", "none", "--second", "sees")
    assert data["detectors"] == ["squeezedet", "sees"]
    row = pick(data, "counterexamples", membership="binary", what="gain")
    if gain is None:
        # blind: all is left to know
        gain = 8 / 12 * entropy(2 / 8, 6 / 8) - math.log(2)
    assert row["value"] == pytest.approx(gain)


@pytest.fixture
def fingerprints(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The detectors whose weights were read for a fingerprint, each time anew."""
    real, found = looking.detector_fingerprint, []

    def read(order: looking.DetectorSpec, predictor: Predictor) -> str:
        found.append(order.detector)
        return real(order, predictor)

    monkeypatch.setattr(looking, "detector_fingerprint", read)
    return found


def test_a_folder_of_retrain_is_a_second_detector(
    tmp_path: Path, worth: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, run: Path
) -> None:
    weights = tmp_path / "retrained" / WEIGHTS
    weights.parent.mkdir()
    weights.touch()
    loaded: list[str] = []

    def load(name: str, *_: object) -> Sees:
        loaded.append(name)
        return Sees(2)

    monkeypatch.setattr(looking, "load_predictor", load)
    data = worth(run, "--distance", "none", "--second", weights.parent)
    assert set(loaded) == {str(weights)} == {data["detectors"][1]}


TABLE = "label,bench,bus,distance\nbench,0.9,0.1,0\nbench,0.3,0.7,0.2\nbus,0.2,0.8,0.4\n"


def test_tables(tmp_path: Path, worth: Callable[..., Any]) -> None:
    path = tmp_path / "answers.csv"
    path.write_text(TABLE)
    data = worth("--table", path)
    plain = pick(data, "answers", membership="binary", realism_weight=False)
    assert plain["value"] == pytest.approx(2 / 3 * entropy(0.5, 0.5))
    # realism 1, 0.5, 0: the third point does not count
    assert pick(data, "answers", membership="binary", realism_weight=True)["value"] == 0
    after = tmp_path / "after.csv"
    after.write_text("label,bench,bus\nbench,1,0\nbench,0.6,0.4\nbus,0,1\n")
    data = worth("--table", path, "--after", after, "--out", tmp_path / "gain")
    gain = pick(data, "answers", membership="binary", realism_weight=False, what="gain")
    assert gain["value"] == pytest.approx(plain["value"])
    assert (tmp_path / "worth" / "worth.json").is_file()


def write_study(folder: Path, name: str, *arms: str) -> Path:
    """A finished study whose arms are these runs; in the first nothing is changed."""
    for place, arm in enumerate(arms):
        write_finished_run(folder / "arms" / arm, same=place == 0)
    files.write_text(folder / "config.yaml", f"name: {name}\n")
    return folder


def test_arms_of_a_study(tmp_path: Path, worth: Callable[..., Any]) -> None:
    """Each arm as realism and worth tell it alone, beside the paper's figures; controls are left out."""
    study = write_study(tmp_path / "study", "multi", "combo-1", "combo-2", "combo-2-placebo")
    placebo = study / "arms" / "combo-2-placebo" / "config.yaml"
    files.write_text(placebo, files.read_text(placebo).replace("method: si-fgsm", "method: placebo"))
    data = worth("--study", study, "--metrics", "psnr,ssim,perceptual", "--distance", "perceptual")
    still, moved = data["rows"]
    assert (still["arm"], moved["arm"]) == ("combo-1", "combo-2")
    assert (still["frame_psnr"], still["frame_ssim"], still["vehicles_perceptual"]) == (None, 1, 0)
    assert moved["frame_psnr_low"] <= moved["frame_psnr"] <= moved["frame_psnr_high"]
    assert 0 < moved["vehicles_ssim"] < moved["frame_ssim"] < 1
    assert (still["frames"], still["vehicles"], data["gains"]) == (3, 6, [])
    assert data["reference"] == {"lpips": 0.52, "fid": 0.1}
    own = worth(study / "arms" / "combo-2", "--distance", "perceptual")
    for key, of, weighted in (
        ("worth_photographs_binary", "photographs", False),
        ("worth_counterexamples_fractional", "counterexamples", False),
        ("worth_counterexamples_binary_by_realism", "counterexamples", True),
    ):
        kind = "fractional" if "fractional" in key else "binary"
        row = pick(own, of, membership=kind, realism_weight=weighted)
        assert (moved[key], moved[f"{key}_low"]) == (row["value"], row["low"])
    text = (study / "worth" / "arms.md").read_text()
    assert "| the paper | - | - | - | - | 0.52 | 0.10 |" in text
    lines = list(csv.DictReader((study / "worth" / "arms.csv").read_text().splitlines()))
    assert [line["arm"] for line in lines] == ["combo-1", "combo-2"]


def test_what_a_study_retrained_gained(
    tmp_path: Path, worth: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each detector that was retrained, on the held-out counterexamples of the one before."""
    study = write_study(tmp_path / "study", "retrain", "combo-2", "held-out", "held-out-ours")
    for name in ("ours", "benign"):
        files.write_text(study / "retrained" / name / WEIGHTS, "")
    monkeypatch.setattr(looking, "load_predictor", lambda name, *_: Sees(2 if "ours" in name else 0))
    data = worth("--study", study, "--metrics", "ssim", "--distance", "none")
    gains = {row["second"]: row for row in data["gains"] if row["membership"] == "binary"}
    assert {row["arm"] for row in data["gains"]} == {"held-out"}
    before = 8 / 12 * entropy(2 / 8, 6 / 8)
    assert gains["ours"]["gain"] == pytest.approx(before)
    assert gains["benign"]["gain"] == pytest.approx(before - math.log(2))
    assert gains["benign"]["worth"] == pytest.approx(math.log(2))
    assert len(data["rows"]) == 3
    assert (study / "worth" / "gains.csv").is_file()


def test_a_table_for_people(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "answers.csv"
    path.write_text(TABLE)
    assert main(["worth", "--table", str(path)]) == 0
    assert "information worth" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected columns label and one a class, found nothing"),
        ("label,bus\n", "expected a line a point, found none"),
        ("label,bus,bus\nbus,1,0\n", "expected columns label and one a class"),
        ("label,bus,distance,realism\nbus,1,0,1\n", "expected one of distance and realism, found both"),
        ("label,bench,bus\ntram,1,0\n", ":2: label: expected one of bench, bus, found 'tram'"),
        ("label,bench,bus\nbus,0.5,nan\n", ":2: bus: expected a number in [0, 1], found 'nan'"),
        ("label,bench,bus\nbus,0.5\n", ":2: bus: expected a number in [0, 1], found None"),
        ("label,bench,bus\nbus,0.5,0.4\n", ":2: expected probabilities that add up to 1, found 0.9"),
        ("label,bench,bus,distance\nbus,0.5,0.5,-1\n", ":2: distance: expected a number of at least 0"),
        ("label,bench,bus,realism\nbus,0.5,0.5,2\n", ":2: realism: expected a number in [0, 1]"),
    ],
)
def test_bad_tables(text: str, message: str, tmp_path: Path, refused: Callable[..., str]) -> None:
    path = tmp_path / "table.csv"
    path.write_text(text)
    assert message in refused("worth", "--table", str(path))
