"""What follows an attack on Virtual KITTI, whose frames are named by folders: `Scene01/clone/Camera_0/00003`."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from detectors.types import CLASSES
from drivesem.cli import main
from drivesem.data.registry import Dataset, open_dataset
from drivesem.run.results import Failure
from drivesem.training import retrain
from drivesem.training.failure_neighbourhoods import FailureNeighbourhoods
from drivesem.training.frames import AttackedFrame, FrameStore, load_attacked_frames
from scene_ir import files
from tests.drivesem.invoke import invoke, run_json

NAMES = [f"Scene0{scene}/clone/Camera_0/0000{i}" for scene in (1, 2) for i in (0, 1)]


@pytest.fixture
def run(small_run: Path, tmp_path: Path) -> Path:
    """A run on two streets with two frames each, numbered alike, which all break the detector."""
    out = tmp_path / "run"
    out.mkdir()
    shutil.copy(small_run / "metrics.json", out)
    files.write_json(out / "manifest.json", {"frames": {name: {} for name in NAMES}})
    settings = (small_run / "config.yaml").read_text()
    settings = settings.replace("dataset: demo", "dataset: vkitti2").replace(
        "root: null", f"root: {tmp_path / 'data'}"
    )
    (out / "config.yaml").write_text(settings)
    (attacked,) = (small_run / "frames").iterdir()
    for name in NAMES:
        shutil.copytree(attacked, out / "frames" / name)
        result = out / "frames" / name / "result.json"
        record = json.loads(result.read_text()) | {
            "identifier": name,
            "success_moved": True,
            "success_paper": True,
        }
        result.write_text(json.dumps(record))
    return out


def test_its_frames_are_counted(run: Path) -> None:
    whole = run / "frames" / NAMES[0]
    shutil.copytree(whole, whole.with_name(".00000.abcdef12.tmp"))  # of a command that was killed
    assert "run: 4 frames" in invoke("runs", "list", run.parent).out


def test_it_is_judged(run: Path) -> None:
    assert run_json("eval", "--gt", run, "--pred", run)["frames"] == 4


@pytest.mark.parametrize("layout", [[], ["--from", "run"]])
def test_it_is_converted(run: Path, tmp_path: Path, layout: list[str]) -> None:
    words = ["convert", str(run), *layout, "--to", "coco", "--out", str(tmp_path / "a.json")]
    assert main(words) == 0
    images = files.read_json(tmp_path / "a.json")["images"]
    assert [row["file_name"] for row in images] == [f"{name}/counterexample.png" for name in NAMES]


def test_frames_that_are_held_out_are_not_trained_on(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the data set, either: it is made of the counterexamples here, and has the same names."""
    data = tmp_path / "data"
    assert main(["convert", str(run), "--to", "vkitti2", "--copy-images", "--out", str(data)]) == 0
    assert open_dataset("vkitti2", data).identifiers == tuple(NAMES)
    trained, judged = [], []

    def make_store(dataset: Dataset, names: Sequence[str], cache: Path, classes: Sequence[str]) -> FrameStore:
        trained.extend(names)
        return FrameStore(dataset, names, cache, classes)

    def detect_in_frames(detector: object, frames: Sequence[AttackedFrame], *_: object) -> None:
        judged.extend(frame.name for frame in frames)
        raise KeyboardInterrupt  # it has been trained

    monkeypatch.setattr(retrain, "FrameStore", make_store)
    monkeypatch.setattr(retrain, "fine_tune", lambda *_: None)
    monkeypatch.setattr(retrain, "detect_in_frames", detect_in_frames)
    words = ["--dataset", "vkitti2", "--root", str(data), "--validation", "0.5", "--out", str(tmp_path / "out")]
    assert main(["retrain", "--run", str(run), *words]) != 0
    assert len(judged) == 2
    assert sorted([*trained, *judged]) == NAMES


def test_frames_of_other_streets_have_pools_of_their_own(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = load_attacked_frames(run)
    assert [frame.name for frame in frames] == NAMES
    pools: list[Path] = []

    def make(self: FailureNeighbourhoods, frame: AttackedFrame, target: int, turn: int, folder: Path) -> None:
        pools.append(folder)
        raise InterruptedError

    lost = Failure("lost", "Car", (0.0, 0.0, 1.0, 1.0), index=0, error="missed", grade="certain")
    for frame in frames:
        frame.__dict__["result"] = replace(frame.result, failures=(lost,))
    monkeypatch.setattr(FailureNeighbourhoods, "_make", make)
    nobody: Any = None  # looks: no state is made
    around = FailureNeighbourhoods(frames, nobody, (), nobody, tmp_path, CLASSES, 1.0, 0)
    for index in range(len(around)):
        with pytest.raises(InterruptedError):
            around.state(index, 0)
    assert len(set(pools)) == len(around) == 4
