"""`drivesem transfer` on a small run of `drivesem attack`: the shipped detector, and one without gradient."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch

from detectors.types import Detections
from drivesem.analysis import transfer as transfer_run
from drivesem.cli import main
from drivesem.run import detection_cache
from drivesem.run.results import load_frame
from tests.drivesem.invoke import invoke, refusal, run_json


def transfer(*words: object) -> Any:
    return run_json("transfer", "--workers", "1", *words)


class Blind:
    """A detector that finds nothing in a picture with any change, and `first` in the others."""

    name, classes = "blind", ("bus", "Car")

    def __init__(self, seen: dict[bytes, Detections]) -> None:
        self.seen = seen

    def forward(self, images: torch.Tensor) -> list[bytes]:
        return [image.numpy().tobytes() for image in images]

    def decode(self, raw: list[bytes]) -> list[Detections]:
        nothing = Detections(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), torch.zeros(0))
        return [self.seen.get(key, nothing) for key in raw]


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two embedded frames."""
    out = tmp_path_factory.mktemp("runs") / "source"
    words = ["attack", "--combo", "2", "--limit", "2", "--no-confirm", "--second-detector", "off", "--json"]
    assert main([*words, "--out", str(out)]) == 0
    return out


@pytest.fixture
def run(attacked: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(attacked, tmp_path / "source"))


def test_the_source_detector_reproduces_the_run(run: Path) -> None:
    (row,) = transfer("--run", run, "--detectors", "squeezedet")["rows"]
    metrics = json.loads((run / "metrics.json").read_text())
    for key in ("ap50", "ap70", "recall_at_t_star"):
        assert row[f"benign_{key}"] == pytest.approx(metrics["benign"][key], abs=1e-9)
        assert row[f"moved_{key}"] == pytest.approx(metrics["attacked"]["moved"][key], abs=1e-9)
        assert row[f"paper_{key}"] == pytest.approx(metrics["attacked"]["paper"][key], abs=1e-9)
    assert row["drop_moved"] == pytest.approx(row["benign_ap50"] - row["moved_ap50"], abs=1e-9)
    assert row["drop_moved_low"] <= row["drop_moved"] + 1e-9
    assert row["frames"] == 2
    assert row["frame_rate"] == 1.0
    assert row["frame_rate_of"] == metrics["successes_moved"] > 0
    assert row["transfer_rate"] in (1.0, None)
    assert (row["transfer_rate"] is None) == (metrics["lost_objects"] == 0)


def test_files(run: Path) -> None:
    data = transfer("--run", run, "--detectors", "squeezedet", "--bootstrap", "10")
    out = run / "transfer"
    assert json.loads((out / "transfer.json").read_text()) == data
    (line,) = csv.DictReader((out / "transfer.csv").read_text().splitlines())
    assert float(line["moved_ap50"]) == data["rows"][0]["moved_ap50"]
    assert "| source | squeezedet | moved |" in (out / "transfer.md").read_text()
    picture = cv2.imread(str(out / "transfer.png"))
    assert min(picture.shape[:2]) > 200


def test_a_second_call_detects_in_no_frame_again(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = transfer("--run", run, "--detectors", "squeezedet")
    cached = sorted((run / "transfer" / "detections").rglob("*.json"))
    assert len(cached) == 4
    cached[1].unlink()
    calls: list[int] = []
    predict = detection_cache.predict
    monkeypatch.setattr(detection_cache, "predict", lambda *words: calls.append(1) or predict(*words))
    assert transfer("--run", run, "--detectors", "squeezedet") == first
    assert len(calls) == 1
    assert transfer("--run", run, "--detectors", "squeezedet", "--no-resume") == first
    assert len(calls) == 5


def test_what_another_detector_loses(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that finds all cars in the photographs, and nothing once anything moves, loses them all."""
    seen = {}
    lost = known = 0
    for folder in sorted((run / "frames").iterdir()):
        result = load_frame(folder / "result.json")
        cars = [t for t in result.targets_benign if t.label == "Car" and not t.ignore]
        image = cv2.cvtColor(cv2.imread(str(folder / "benign.png")), cv2.COLOR_BGR2RGB)
        boxes = torch.tensor([t.xyxy for t in cars])
        found = Detections(boxes, torch.ones(len(cars), dtype=torch.int64), torch.full((len(cars),), 0.5))
        seen[(torch.from_numpy(image).permute(2, 0, 1) / 255).numpy().tobytes()] = found
        moved = {t.index: t for t in result.targets_moved}
        known += sum(not moved[t.index].ignore for t in cars)
        lost += sum(f.kind == "lost" and f.label == "Car" for f in result.failures)
    monkeypatch.setattr(detection_cache, "load_predictor", lambda *_: Blind(seen))
    (row,) = transfer("--run", run, "--detectors", "onnx:some/blind.onnx")["rows"]
    assert row["target"] == "onnx:blind.onnx"
    assert row["t_star"] == 0.3
    assert (row["benign_ap50"], row["moved_ap50"], row["paper_recall"]) == (1.0, 0.0, 0.0)
    assert (row["drop_moved"], row["drop_moved_low"], row["drop_moved_high"]) == (1.0, 1.0, 1.0)
    assert (row["lost_rate"], row["lost_rate_of"]) == (1.0, known)
    assert row["transfer_rate_of"] == lost
    assert row["transfer_rate"] == (1.0 if lost else None)
    assert row["certain_rate_of"] + row["threshold_rate_of"] == lost
    data = transfer("--run", run, "--detectors", "onnx:some/blind.onnx", "--t-star", "0.6")
    (high,) = data["rows"]
    assert high["lost_rate_of"] == 0
    assert high["lost_rate"] is None
    # a detector that never found an object neither loses it nor agrees
    assert high["never_found"] == lost == len(data["failures"])
    assert {(one["found"], one["lost"]) for one in data["failures"]} == {(False, None)}


def test_a_matrix_of_two_runs(run: Path, tmp_path: Path) -> None:
    other = shutil.copytree(run, tmp_path / "again")
    out = tmp_path / "matrix"
    rows = transfer("--run", f"{run},{other}", "--detectors", "squeezedet", "--out", out, "--limit", "1")["rows"]
    assert [row["source"] for row in rows] == ["source", "again"]
    assert {row["frames"] for row in rows} == {1}
    # the same pictures are looked at once
    assert len(list((out / "detections").rglob("*.json"))) == 2


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("squeezedet, a.safetensors", ["squeezedet", "a.safetensors"]),
        ("darknet:y.cfg,y.weights,squeezedet", ["darknet:y.cfg,y.weights", "squeezedet"]),
        ("onnx:n.onnx,n.yaml,onnx:m.onnx,b.safetensors", ["onnx:n.onnx,n.yaml", "onnx:m.onnx", "b.safetensors"]),
    ],
)
def test_detectors_have_distinct_names(text: str, names: list[str]) -> None:
    assert transfer_run.parse_detector_names(text) == names


def test_names_lose_their_folders_where_that_is_clear() -> None:
    assert transfer_run.shorten_detector_names(["squeezedet", "onnx:a/b/n.onnx"]) == ["squeezedet", "onnx:n.onnx"]
    assert transfer_run.shorten_detector_names(["onnx:c/a/n.onnx", "onnx:b/n.onnx"]) == [
        "onnx:a/n.onnx",
        "onnx:b/n.onnx",
    ]
    assert transfer_run.shorten_detector_names(["a/n.onnx", "c/a/n.onnx"]) == ["a/n.onnx", "c/a/n.onnx"]
    runs = ["squeezedet", "onnx:d/n.onnx", "out/benign/r.safetensors", "out/worst/r.safetensors"]
    assert transfer_run.shorten_detector_names(runs) == [
        "squeezedet",
        "onnx:n.onnx",
        "benign/r.safetensors",
        "worst/r.safetensors",
    ]
    assert transfer_run.shorten_detector_names(["darknet:x/c.cfg,x/c.weights"]) == ["darknet:c.cfg,c.weights"]


def test_bad_input(run: Path, tmp_path: Path) -> None:
    def refused(*words: object) -> str:
        (line,) = invoke("transfer", "--workers", "1", *words, code=2).err.splitlines()
        return line.removeprefix("drivesem: ")

    detectors = ("--detectors", "squeezedet")
    assert refused("--run", tmp_path / "none", *detectors).startswith(
        "--run: expected a folder of drivesem attack"
    )
    assert refused("--run", run) == "--detectors: expected detectors with commas, found nothing"
    unknown = refused("--run", run, "--detectors", "squeezdet")
    assert unknown.startswith("--detectors: expected detectors (squeezedet, yolov3-slim, a path.safetensors, or")
    assert unknown.endswith("ensemble: or planted:), found 'squeezdet'")
    assert (unknown.count("expected"), unknown.count("found")) == (1, 1)
    assert "each detector once, found squeezedet" in refused("--run", run, "--detectors", "squeezedet,squeezedet")
    assert "each run once" in refused("--run", f"{run},{run}", *detectors)
    assert "--bootstrap" in refused("--run", run, *detectors, "--bootstrap", "-1")
    assert not (run / "transfer").exists()
    broken = run / "frames" / "demo-001" / "counterexample.png"
    broken.write_bytes(broken.read_bytes()[:999])
    # its progress bar may stand before the line
    assert str(broken) in " ".join(
        invoke("transfer", "--run", run, *detectors, "--workers", "1", code=2).err.split()
    )
    (run / "metrics.json").unlink()
    assert "a finished run" in refused("--run", run, *detectors)
    (run / "config.yaml").write_text("photo: street.png\n")
    assert "a run of another command" in refused("--run", run, *detectors)


def test_bad_frames_are_left_out_with_keep_going(run: Path) -> None:
    broken = run / "frames" / "demo-001" / "counterexample.png"
    broken.write_bytes(b"no picture")
    data = transfer("--run", run, "--detectors", "squeezedet", "--keep-going")
    assert data["rows"][0]["frames"] == 1
    assert list(data["frames_failed"]) == [str(broken)]


def test_a_detector_without_cars_is_refused(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blind = Blind({})
    monkeypatch.setattr(blind, "classes", ("bus",), raising=False)
    monkeypatch.setattr(detection_cache, "load_predictor", lambda *_: blind)
    assert "expected one that knows Car, found bus" in refusal(
        "transfer", "--run", run, "--detectors", "onnx:blind.onnx"
    )
