"""Runs in which people and vehicles change: all commands name the person, and count by class."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import pytest
import torch

from detectors.types import CLASSES, Detections
from drivesem.analysis import gate
from drivesem.cli import main
from drivesem.data.kitti import read_labels
from drivesem.run import attack as run_attack
from drivesem.run import detection_cache
from drivesem.run import folder as run_folder
from drivesem.run.results import load_frame
from tests.drivesem.invoke import refusal, run_json

ATTACK = ("attack", "--detector", "any", "--dataset", "kitti", "--people", "--no-fit", "--params", "color")
QUICK = ("--method", "random", "--queries", "1", "--nuisances", "off", "--no-confirm", "--second-detector", "off")


class Unnoticing:
    """Finds each labelled car and pedestrian, but in a changed picture no pedestrian."""

    name, classes, t_star = "unnoticing", CLASSES, 0.5

    def __init__(self, root: Path) -> None:
        labels = read_labels(root / "training" / "label_2" / "000000.txt")
        rows = [row for row, kind in enumerate(labels.kind) if kind in CLASSES]
        self.boxes = labels.boxes_xyxy[rows]
        self.labels = torch.tensor([CLASSES.index(labels.kind[row]) for row in rows])
        self.bright: float | None = None

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        means = images.double().mean(dim=(1, 2, 3))
        self.bright = float(means[0]) if self.bright is None else self.bright
        return means

    def decode(self, raw: torch.Tensor) -> list[Detections]:
        return [self.seen(abs(float(mean) - (self.bright or 0)) < 1e-6) for mean in raw]

    def seen(self, unchanged: bool) -> Detections:
        rows = torch.ones_like(self.labels, dtype=torch.bool) if unchanged else self.labels == CLASSES.index("Car")
        boxes = self.boxes[rows]
        return Detections(boxes, self.labels[rows], torch.full((len(boxes),), 0.9))


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A generated frame of which one car and one person are labelled."""
    folder = tmp_path_factory.mktemp("street") / "kitti"
    assert main(["synth", "--frames", "1", "--seed", "17", "--workers", "1", "--out", str(folder)]) == 0
    shutil.rmtree(folder / "training" / "instance_2")  # its numbers are those of all rows
    path = folder / "training" / "label_2" / "000000.txt"
    lines = path.read_text().splitlines()
    few = [
        next(line for line in lines if line.startswith(kind) and " 0.00 0 " in line)
        for kind in ("Car", "Pedestrian")
    ]
    path.write_text("\n".join(few) + "\n")
    return folder


@pytest.fixture(scope="module")
def run(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A finished run, with its detector in place."""
    out, detector = tmp_path_factory.mktemp("people") / "run", Unnoticing(root)
    with pytest.MonkeyPatch.context() as patch:
        for module in (run_attack, run_folder, detection_cache, gate):
            patch.setattr(module, "load_predictor", lambda *_: detector)
        run_json(*ATTACK, *QUICK, "--workers", "1", "--root", root, "--out", out)
        yield out


def test_gate_and_export_know_the_person(run: Path, tmp_path: Path) -> None:
    compared = run_json(
        "gate", run, "--workers", "1", "--samples", "2", "--after", "any", "--out", tmp_path / "gate"
    )
    assert compared["failures"] == 1
    run_json("export", run, "--to", "kitti", "--out", tmp_path / "kitti")
    (labels,) = (tmp_path / "kitti").rglob("label_2/*.txt")
    assert "Pedestrian" in labels.read_text()


@pytest.mark.slow
def test_a_person_emerges_from_behind_a_vehicle(
    run: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The proposal is taken, whatever its margins; its person stays judged, and the run agrees with its files."""
    worse = count(0, -1)
    monkeypatch.setattr(run_attack, "margin_objective", lambda *_: next(worse))
    words = ("--params", "translate", "--method", "climb", "--budget", "street", "--passes", "36", "--no-confirm")
    run_json(
        *ATTACK[:-2], *words, "--changes", "emerge", "--workers", "1", "--root", root, "--out", tmp_path / "run"
    )
    result = load_frame(tmp_path / "run" / "frames" / "000000" / "result.json")
    assert result.change == "objects[1] stands behind objects[0]"
    assert result.violations == ()
    assert 1 in result.judged
    assert not result.targets_moved[1].ignore
    assert run_json("verify", tmp_path / "run", "--workers", "1")["differences"] == []


def test_nobody_emerges_without_people(tmp_path: Path) -> None:
    words = ("attack", "--method", "climb", "--budget", "street", "--changes", "emerge", "--out", tmp_path / "run")
    assert refusal(*words) == "--changes: expected no emerge without --people, found emerge"


@pytest.mark.slow
def test_analyses_name_the_person(run: Path) -> None:
    one = (run, "--workers", "1")
    (explained,) = run_json("explain", *one, "--points", "2", "--permutations", "2")["rows"]
    assert (explained["label"], explained["kind"], explained["grade"]) == ("Pedestrian", "missed", "certain")
    (hole,) = run_json("holes", *one, "--samples", "24", "--fresh", "1", "--contrast", "0")["holes"]
    assert hole["class"] == "Pedestrian"
    assert run_json("verify", *one)["differences"] == []


def test_failures_are_counted_by_class(run: Path) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    by_class = metrics["by_class"]
    assert list(by_class) == ["Car", "Pedestrian"]
    assert by_class["Car"]["grades"]["threshold"] == 0
    assert by_class["Pedestrian"]["found_before"] == by_class["Pedestrian"]["judged"] == 1
    assert by_class["Pedestrian"]["kinds"]["missed"] == by_class["Pedestrian"]["grades"]["certain"] == 1
    page = (run / "report.html").read_text()
    assert "Failures by class, kind and highest grade" in page
    assert "Pedestrian<span" in page
    assert "found before" in page
    assert "vehicles found before" not in page
