"""The study `transfer` on an embedded frame."""

import csv
import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch

from detectors.types import Detections
from drivesem.attacks.methods.base import Attack
from drivesem.run import detection_cache as looking
from drivesem.run.run_report import PAPER_BENIGN, PAPER_COMBOS
from tests.tools.experiments.conftest import REQUIRED_KEYS
from tools.experiments.__main__ import main
from tools.experiments.detection import transfer
from tools.experiments.detection.arms import PLACEBO, build_arms
from tools.experiments.detection.report import OWN_PROTOCOL
from tools.experiments.settings import StudyConfig

WORDS = ["transfer", "--quick", "--limit", "1", "--steps", "1", "--workers", "1", "--bootstrap", "5"]


@pytest.fixture
def studied(output_json: Callable[..., Any]) -> Callable[..., Any]:
    return partial(output_json, *WORDS)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("study") / "transfer"
    assert main([*WORDS, "--out", str(out)]) == 0
    return out


def test_rows_and_references(finished: Path) -> None:
    data = json.loads((finished / "study.json").read_text())
    rows = {row["name"]: row for row in data["rows"]}
    assert list(rows) == ["squeezedet -> squeezedet", "squeezedet -> yolov3-slim"]
    assert all(set(row) >= REQUIRED_KEYS for row in rows.values())
    own, other = rows.values()
    assert own["reference"] is other["reference"] is None  # the study's attack is not the paper's
    for row in rows.values():
        assert row["drop_moved"] == pytest.approx(row["benign_ap50"] - row["moved_ap50"], abs=1e-9)
        assert row["rerendered_ap50"] == row["benign_ap50"], "nothing changed gives the photograph"
        assert row["recall_moved"] == row["moved_recall"]
        assert row["placebo_drop_moved"] is not None
    assert (data["frames"], data["feasible_fraction"]) == (1, 1.0)
    metrics = json.loads((finished / "arms" / "combo-2" / "metrics.json").read_text())
    assert own["moved_ap50"] == pytest.approx(metrics["attacked"]["moved"]["ap50"], abs=1e-9)
    assert (own["lost"], own["phantoms"]) == (metrics["lost_objects"], metrics["phantoms"])
    assert own["broken_rate"] == metrics["successes_moved"]


def test_files(finished: Path) -> None:
    text = (finished / "study.md").read_text()
    assert "## Car AP50, %; counterexamples of squeezedet" in text
    assert "| yolov3-slim |" in text
    assert "91.28" not in text
    assert OWN_PROTOCOL in text
    lines = list(csv.DictReader((finished / "study.csv").read_text().splitlines()))
    assert [line["target"] for line in lines] == ["squeezedet", "yolov3-slim"]
    assert min(cv2.imread(str(finished / "study.png")).shape[:2]) > 200
    assert {path.name for path in (finished / "arms").iterdir()} == {"combo-2", f"combo-2-{PLACEBO}"}
    assert (finished / "detections").is_dir()


def test_under_the_papers_protocol_its_metrics_stand_next_to(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, studied: Callable[..., Any]
) -> None:
    out = Path(shutil.copytree(finished, tmp_path / "transfer"))
    monkeypatch.setattr(transfer, "follows_paper", lambda attack: attack.method == "si-fgsm")
    own, other = studied("--out", out)["rows"]
    assert (own["reference_benign"], own["reference"]) == (PAPER_BENIGN, PAPER_COMBOS[2])
    assert other["reference"] is None  # a narrow YOLOv3 is not the paper's
    text = (out / "study.md").read_text()
    assert "Ours, under the paper's protocol" in text
    assert "91.28 to 87.50" in text


def test_requested_again_nothing_is_attacked_or_evaluated(
    finished: Path, monkeypatch: pytest.MonkeyPatch, studied: Callable[..., Any]
) -> None:
    """The order of the detectors may change, and others may come."""

    def never(*_: object) -> None:
        raise AssertionError("done before")

    monkeypatch.setattr(looking, "predict", never)
    monkeypatch.setattr(Attack, "__call__", never)
    before = json.loads((finished / "study.json").read_text())
    assert studied("--out", finished) == before
    assert studied("--out", finished, "--detectors", "yolov3-slim") == before


def test_what_is_stored_tells_the_same_without_a_run(
    finished: Path, tmp_path: Path, studied: Callable[..., Any]
) -> None:
    before = (finished / "study.json").read_bytes()
    shutil.rmtree(finished / "results")
    studied("--out", finished)
    results = Path(shutil.move(finished / "results", tmp_path / "results"))
    assert main(["transfer", "--from", str(results), "--out", str(tmp_path / "again")]) == 0
    assert (tmp_path / "again" / "study.json").read_bytes() == before
    for name in ("study.md", "study.csv", "study.png"):
        assert (tmp_path / "again" / name).read_bytes() == (finished / name).read_bytes()


def test_a_detector_that_finds_nothing_has_nothing_to_lose(
    finished: Path, monkeypatch: pytest.MonkeyPatch, studied: Callable[..., Any]
) -> None:
    class Blind:
        name, classes = "blind", ("Car",)

        def forward(self, images: torch.Tensor) -> int:
            return len(images)

        def decode(self, raw: int) -> list[Detections]:
            return [Detections(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), torch.zeros(0))] * raw

    whole = looking.load_predictor
    monkeypatch.setattr(
        looking, "load_predictor", lambda name, *rest: Blind() if name == "onnx:a.onnx" else whole(name, *rest)
    )
    rows = studied("--out", finished, "--detectors", "onnx:a.onnx")["rows"]
    assert [row["target"] for row in rows] == ["squeezedet", "onnx:a.onnx"]
    blind = rows[1]
    assert (blind["benign_ap50"], blind["moved_ap50"], blind["drop_moved"]) == (0.0, 0.0, 0.0)
    assert (blind["lost"], blind["lost_rate"], blind["broken_rate"]) == (0, None, 0.0)
    assert blind["reference"] is None


def test_each_source_has_an_arm_and_its_placebo() -> None:
    study = StudyConfig(name="transfer", sources="squeezedet,yolov3-slim", steps=3)
    arms = build_arms(study, Path("out"))
    assert [arm.folder for arm in arms] == [
        "combo-2",
        "combo-2-placebo",
        "combo-2-yolov3-slim",
        "combo-2-yolov3-slim-placebo",
    ]
    assert [arm.config.detector for arm in arms] == ["squeezedet"] * 2 + ["yolov3-slim"] * 2
    assert arms[3].config.like == "out/arms/combo-2-yolov3-slim"
    assert len(build_arms(StudyConfig(name="transfer", controls=False), Path("out"))) == 1


@pytest.mark.slow
def test_two_sources_make_a_matrix(finished: Path, studied: Callable[..., Any]) -> None:
    words = ("--out", finished, "--sources", "squeezedet,yolov3-slim")
    rows = studied(*words)["rows"]
    assert [(row["source"], row["target"]) for row in rows] == [
        ("squeezedet", "squeezedet"),
        ("squeezedet", "yolov3-slim"),
        ("yolov3-slim", "squeezedet"),
        ("yolov3-slim", "yolov3-slim"),
    ]
    settings = (finished / "arms" / "combo-2-yolov3-slim" / "config.yaml").read_text()
    assert "detector: yolov3-slim" in settings
    metrics = json.loads((finished / "arms" / "combo-2-yolov3-slim" / "metrics.json").read_text())
    assert rows[3]["moved_ap50"] == pytest.approx(metrics["attacked"]["moved"]["ap50"], abs=1e-9)
