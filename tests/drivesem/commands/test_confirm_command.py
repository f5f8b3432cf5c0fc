"""`drivesem confirm` on small runs of `drivesem attack`: a second renderer draws what the compositor drew."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from drivesem.analysis.confirm import ConfirmedFrame
from drivesem.cli import main
from drivesem.failures.second_renderer import opengl as screen
from drivesem.failures.second_renderer.generator import GeneratorRenderer
from drivesem.run.records import load_record
from drivesem.run.results import load_frame
from scene_ir import files
from tests.drivesem.invoke import invoke, run_json


def confirm(run: Path, *words: object) -> Any:
    return run_json("confirm", "--run", run, "--workers", "1", *words)


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of one embedded frame."""
    out = tmp_path_factory.mktemp("runs") / "source"
    words = ["attack", "--method", "halton", "--queries", "2", "--limit", "1", "--workers", "1", "--json"]
    assert main([*words, "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def confirmed(attacked: Path) -> Path:
    """The run with its frame drawn again beside."""
    assert main(["confirm", "--run", str(attacked), "--workers", "1", "--json"]) == 0
    return attacked


@pytest.fixture
def run(confirmed: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(confirmed, tmp_path / "source"))


def test_vehicles_stand_where_the_compositor_put_them(run: Path) -> None:
    out = run / "confirm"
    data = json.loads((out / "confirm.json").read_text())
    assert data["frames"] == 1
    assert data["not_carried"] == data["frames_failed"] == {}
    assert data["box_iou"]["boxes"] >= 4
    # Moves of up to a quarter of a length and 20 degrees: a wrong sign or axis would leave far less.
    assert data["box_iou"]["mean"] > 0.95
    assert data["box_iou"]["least"] > 0.85
    frame = run / "frames" / "demo-000"
    result, found = (
        load_frame(frame / "result.json"),
        load_record(out / "frames" / "demo-000" / "confirmed.json", ConfirmedFrame, 3),
    )
    assert len(found.failures) == len(result.failures)
    assert [s.iou_benign for s in found.objects] == pytest.approx([1.0] * result.objects, abs=1e-4)
    # The photograph is the same picture: the detector finds the same.
    assert [d.score for d in found.detections_benign] == pytest.approx([d.score for d in result.detections_benign])
    drawn, benign = (
        files.read_image(path).astype(float)
        for path in (out / "frames" / "demo-000" / "generator.png", frame / "benign.png")
    )
    composed = files.read_image(frame / "counterexample.png").astype(float)
    assert np.abs(drawn - composed).mean() < 0.5 * np.abs(benign - composed).mean()


def test_files(run: Path) -> None:
    out = run / "confirm"
    (row,) = csv.DictReader((out / "confirm.csv").read_text().splitlines())
    assert row["frame"] == "demo-000"
    assert "## failures that survive" in (out / "confirm.md").read_text()
    sheet = files.read_image(out / "frames" / "demo-000" / "sheet.png")
    photograph = files.read_image(run / "frames" / "demo-000" / "benign.png")
    assert sheet.shape[0] > 2 * photograph.shape[0]


def test_a_second_call_draws_nothing_and_a_changed_frame_is_drawn_again(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = json.loads((run / "confirm" / "confirm.json").read_text())
    draws: list[int] = []
    draw = GeneratorRenderer.render
    monkeypatch.setattr(GeneratorRenderer, "render", lambda self, scene: draws.append(1) or draw(self, scene))
    again = confirm(run)
    assert again == before | {"run": str(run)}
    assert draws == []
    path = run / "frames" / "demo-000" / "result.json"
    path.write_text(path.read_text().replace('"seconds": ', '"seconds": 1'))
    assert confirm(run)["rows"] == before["rows"]
    assert len(draws) >= 2


def test_another_picture_is_refused(run: Path) -> None:
    benign = run / "frames" / "demo-000" / "scene" / "photograph.png"
    image = files.read_image(benign)
    image[5, 5] ^= 64
    files.write_png(benign, image)
    out = run / "again"
    output = " ".join(invoke("confirm", "--run", run, "--workers", "1", "--out", out, code=2).err.split())
    assert (
        "photograph of demo-000: expected the image that the generator renders, found one 64 levels off" in output
    )
    words = ("--run", str(run), "--workers", "1", "--out", str(out), "--keep-going")
    assert "a run with frames that can be used" in " ".join(invoke("confirm", *words, code=2).err.split())


def test_bad_input(run: Path, tmp_path: Path) -> None:
    def refused(*words: object) -> str:
        (line,) = invoke("confirm", "--workers", "1", *words, code=2).err.splitlines()
        return line.removeprefix("drivesem: ")

    assert refused("--run", tmp_path).startswith("--run: expected a folder of drivesem attack")
    assert refused("--run", run, "--root", tmp_path).startswith("--root: expected none for the embedded scenes")
    (run / "metrics.json").unlink()
    assert "a finished run" in refused("--run", run)


@pytest.fixture
def photographs(run: Path, tmp_path: Path) -> Path:
    """The run as if its frames were photographs of a data set."""
    shutil.rmtree(run / "confirm")
    path = run / "config.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | {"dataset": "coco", "root": str(tmp_path)}))
    for file in (run / "frames").glob("*/scene/scene.json"):
        data = json.loads(file.read_text())
        data["provenance"]["dataset"] = "coco"
        file.write_text(json.dumps(data))
    return run


@pytest.mark.usefixtures("screen")
def test_photographs_are_drawn_by_pyrender(photographs: Path) -> None:
    data = confirm(photographs)
    assert (data["frames"], data["not_carried"]) == (1, {})
    assert data["box_iou"]["least"] > 0.99
    frame, out = photographs / "frames" / "demo-000", photographs / "confirm" / "frames" / "demo-000"
    found = load_record(out / "confirmed.json", ConfirmedFrame, 3)
    assert found.renderer == "pyrender"
    assert len(found.failures) == len(load_frame(frame / "result.json").failures)
    drawn, benign, composed = (
        files.read_image(path).astype(float)
        for path in (out / "pyrender.png", frame / "benign.png", frame / "counterexample.png")
    )
    assert np.abs(drawn - composed).mean() < 0.5 * np.abs(benign - composed).mean()


def test_without_opengl_nothing_is_written(
    photographs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    monkeypatch.setattr(screen, "_LIBRARIES", {})
    screen.shared_context.cache_clear()
    assert main(["confirm", "--run", str(photographs), "--workers", "1"]) == 2
    screen.shared_context.cache_clear()
    (line,) = capsys.readouterr().err.splitlines()
    assert "install Debian's libegl1 or libosmesa6" in line
    assert not (photographs / "confirm").exists()
