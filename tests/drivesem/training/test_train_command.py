"""`drivesem train` as a user starts it: what it leaves behind, goes on with, and refuses."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from detectors.registry import load_detector, read_weights
from detectors.training import CHECKPOINT, LOG
from drivesem.cli import main
from drivesem.training.validation import BEST, CURVES, EVALUATIONS
from tests.drivesem.invoke import invoke, refusal, run_json

STEPS = ["--steps", "4", "--batch", "2", "--window", "96x64", "--rate", "1e-4", "--checkpoint-every", "2"]


@pytest.fixture
def frames(tmp_path: Path, kitti_folder: Callable[..., Path]) -> list[str]:
    """Options that name frames to train on and to judge by."""
    train, held_out = kitti_folder(tmp_path / "train", 5), kitti_folder(tmp_path / "held_out", 2, seed=1)
    return ["--root", str(train), "--held-out", str(held_out)]


def weights(path: Path) -> dict[str, torch.Tensor]:
    return {name: value for name, value in read_weights(path)[1].items() if name.startswith("weights.")}


@pytest.mark.slow
def test_validation_chooses_and_held_out_frames_judge(
    tmp_path: Path, frames: list[str], kitti_folder: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    """t* is that of the validation frames, not that of the held-out ones; the card names the frames of each metric."""
    validation = kitti_folder(tmp_path / "validation", 3, seed=2)
    runs = []
    for name, words in (("chosen", ["--held-out", str(validation)]), ("both", ["--validation", str(validation)])):
        out = tmp_path / name
        assert main(["train", *frames, *words, *STEPS, "--out", str(out), "--json"]) == 0
        runs.append((json.loads(capsys.readouterr().out)["best"], (out / "squeezedet.md").read_text()))
    (chosen, alone), (both, card) = runs
    assert both == chosen
    assert "2 held-out frames, evaluated from" in card
    assert "over all classes on 3 further frames," in card
    assert "these played no part" in card
    assert "3 held-out frames" in alone
    assert "selected on\nthem too" in alone
    again = ["train", *frames, "--validation", frames[-1], *STEPS, "--out", str(tmp_path / "again")]
    assert "also selects the weights and t*: its metrics are optimistic" in invoke(*again).err
    assert "--held-out: expected frames to measure on, with --validation" in refusal(
        "train", *frames[:2], "--validation", validation
    )


@pytest.mark.parametrize("detector", ["squeezedet", pytest.param("yolov3-slim", marks=pytest.mark.slow)])
def test_a_run(tmp_path: Path, frames: list[str], detector: str) -> None:
    out = tmp_path / "run"
    command = ["train", "--detector", detector, *frames, *STEPS, "--evaluate-every", "2", "--out", str(out)]
    data = run_json(*command)
    assert (data["frames"], data["steps"], data["steps_now"]) == (5, 4, 4)
    assert data["images_a_second"] > 0
    exported = load_detector(out / f"{detector}.safetensors")
    assert exported.name == detector
    assert exported.t_star == pytest.approx(data["best"]["t_star"], rel=1e-4)
    assert [row["step"] for row in csv.DictReader((out / LOG).read_text().splitlines())] == ["1", "2", "3", "4"]
    assert [row["step"] for row in csv.DictReader((out / EVALUATIONS).read_text().splitlines())] == ["2", "4"]
    assert json.loads((out / BEST).read_text())["step"] in (2, 4)
    assert (out / CURVES).stat().st_size > 10_000
    card = (out / f"{detector}.md").read_text()
    assert "5 frames of layout kitti (`train`)" in card
    assert f"--detector {detector}" in card or detector == "squeezedet"
    assert "drivesem train " in card
    assert "--root train" in card
    assert "| Car | 2 |" in card
    assert str(tmp_path) not in card
    before = (out / LOG).read_text()
    assert main(command) == 0, "a run that is over stays as it is"
    assert (out / LOG).read_text() == before
    assert "--no-resume" in refusal(*command, "--rate", "1e-5")
    assert main([*command, "--rate", "1e-5", "--no-resume"]) == 0
    assert (out / LOG).read_text() != before


def test_warns_about_frames_used_for_training_and_evaluation(
    tmp_path: Path, kitti_folder: Callable[..., Path]
) -> None:
    folder, other = kitti_folder(tmp_path / "train", 2), kitti_folder(tmp_path / "other", 2, seed=1)
    words = ["train", "--root", f"{other},{folder}", *STEPS, "--steps", "1", "--held-out"]
    assert (
        "is also trained on: its metrics and t* do not apply to other images"
        in invoke(*words, folder / ".." / "train", "--out", tmp_path / "a").err
    )
    apart = kitti_folder(tmp_path / "apart", 2, seed=2)
    assert "is trained on too" not in invoke(*words, apart, "--out", tmp_path / "b").err


def test_it_starts_from_weights_and_checkpoints(tmp_path: Path, frames: list[str]) -> None:
    def trained(name: str, start: str) -> dict[str, torch.Tensor]:
        words = ["train", *frames, *STEPS, "--rate", "1e-12", "--start", start, "--out", str(tmp_path / name)]
        assert main(words) == 0
        return weights(tmp_path / name / CHECKPOINT)

    shipped = trained("auto", "auto")
    reference = load_detector("squeezedet").state_dict()
    assert all(
        torch.allclose(value, reference[name.removeprefix("weights.")], atol=1e-6)
        for name, value in shipped.items()
    )
    again = trained("again", str(tmp_path / "auto" / CHECKPOINT))
    assert all(torch.allclose(again[name], value, atol=1e-6) for name, value in shipped.items())
    drawn = trained("drawn", "none")
    assert not torch.allclose(drawn["weights.convdet.weight"], shipped["weights.convdet.weight"], atol=1e-4)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--detector", "retinanot"], "--detector: expected one of squeezedet"),
        (["--dataset", "kitty"], "--dataset: expected one of kitti"),
        (["--steps", "0"], "--steps: expected a number above 0"),
        (["--window", "640"], "--window: expected WIDTHxHEIGHT, px, found '640'"),
        (["--scale", "2,1"], "--scale: expected LOW,HIGH"),
        (["--precision", "float16"], "--precision: expected float32 or bfloat16 on a CPU, found float16"),
        (["--drops", "never"], "--drops: expected numbers"),
        (["--device", "quantum"], "--device: expected a torch device"),
        (["--start", "nowhere.safetensors"], "--start: expected weights for squeezedet"),
        (["--start", "squeezenet"], "python tools/fetch_backbone.py"),
        (["--detector", "yolov3-slim", "--loss", "quality"], "--loss: expected published with --detector"),
        (["--anchors", "kmeans"], "--anchors: expected more different boxes"),
    ],
)
def test_bad_settings(
    tmp_path: Path,
    kitti_folder: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    words: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    root = kitti_folder(tmp_path / "frames", 2)
    error = invoke("train", "--root", root, "--out", tmp_path / "run", *words, code=2).err
    lines = [line for line in error.splitlines() if not line.startswith("kitti: 2 images")]  # the account
    assert len(lines) == 1
    assert message in lines[0]


def test_data_without_boxes_or_frames(tmp_path: Path, kitti_folder: Callable[..., Path]) -> None:
    root = kitti_folder(tmp_path / "trams", 2, kind="Tram")
    assert "expected frames with objects of Car, Truck, Pedestrian, Cyclist, found none" in refusal(
        "train", "--root", root, "--out", tmp_path / "run"
    )
    (tmp_path / "empty" / "training" / "image_2").mkdir(parents=True)
    assert "expected at least one image" in refusal(
        "train", "--root", tmp_path / "empty", "--out", tmp_path / "run2"
    )


def test_a_rate_at_which_training_breaks(tmp_path: Path, frames: list[str]) -> None:
    words = ["train", *frames, *STEPS, "--rate", "1e30", "--clip", "1e30", "--optimiser", "sgd"]
    assert "--rate: expected one at which the loss stays finite, found step" in refusal(
        *words, "--warmup", "0", "--out", tmp_path / "run"
    )


def _drivesem(*words: str) -> list[str]:
    return [sys.executable, "-m", "drivesem.cli", *words]


@pytest.mark.slow
def test_killed_and_resumed_ends_with_the_same_weights(tmp_path: Path, frames: list[str]) -> None:
    words = ["train", *frames, *STEPS, "--steps", "12", "--evaluate-every", "3"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    subprocess.run(_drivesem(*words, "--out", str(whole)), env=environment, check=True)
    killed = subprocess.Popen(_drivesem(*words, "--out", str(parts)), env=environment)
    while not (parts / CHECKPOINT).is_file():
        assert killed.poll() is None, "it was over before it could be killed"
        time.sleep(0.002)
    killed.send_signal(signal.SIGKILL)
    assert killed.wait() == -signal.SIGKILL
    done = int(read_weights(parts / CHECKPOINT)[0]["step"])
    assert done < 12
    subprocess.run(_drivesem(*words, "--out", str(parts)), env=environment, check=True)
    for name in (CHECKPOINT, "squeezedet.safetensors"):
        first, second = read_weights(whole / name)[1], read_weights(parts / name)[1]
        assert all(torch.equal(second[key], value) for key, value in first.items()), name
    assert (whole / EVALUATIONS).read_text() == (parts / EVALUATIONS).read_text()


@pytest.mark.slow
def test_two_processes_train_as_one(tmp_path: Path, frames: list[str]) -> None:
    words = ["train", *frames, *STEPS, "--dropout", "0", "--optimiser", "sgd", "--rate", "1e-3"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    subprocess.run(_drivesem(*words, "--out", str(tmp_path / "one")), env=environment, check=True)
    launcher = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "drivesem.cli"]
    command = [sys.executable, *launcher, *words, "--out", str(tmp_path / "two")]
    subprocess.run(command, env=environment, check=True)
    one, two = weights(tmp_path / "one" / CHECKPOINT), weights(tmp_path / "two" / CHECKPOINT)
    start = load_detector("squeezedet").state_dict()
    moved = sum(float((one[n] - start[n.removeprefix("weights.")]).square().sum()) for n in one)
    apart = sum(float((one[n] - two[n]).square().sum()) for n in one)
    assert moved > 0
    # each process divides by the objects of its own share, so the two are close, not equal
    assert apart < 0.05 * moved
    logs = [list(csv.DictReader((tmp_path / run / LOG).read_text().splitlines())) for run in ("one", "two")]
    assert [row["step"] for row in logs[0]] == [row["step"] for row in logs[1]]
