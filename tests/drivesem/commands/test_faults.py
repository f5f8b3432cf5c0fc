"""Disks that are full, folders that may only be read, files that are damaged or vanish, clocks that jump."""

from __future__ import annotations

import errno
import gc
import itertools
import json
import os
import shutil
import time
import weakref
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
import torch

from drivesem.attacks.objective import Objective
from drivesem.cli import main
from drivesem.run import attack as run_attack
from drivesem.run.frame import AttackedScene
from drivesem.run.results import FrameResult
from drivesem.scenes.sources import DatasetSource
from scene_ir import files
from scene_ir.types import SceneIR
from tests.drivesem.invoke import invoke, refusal
from tools.same import copy_crop, sort_labels

NAMES = ("000000", "000001", "000002")
WIDTH, HEIGHT = 192, 112


@pytest.fixture(scope="module")
def tiny_kitti(small_kitti: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of one car."""
    folder, source = tmp_path_factory.mktemp("tiny"), small_kitti / "training"
    car = sort_labels(source / "label_2" / "000008.txt")[0]
    x0, y0, x1, y1 = map(float, car[4:8])
    left, top = round((x0 + x1 - WIDTH) / 2), round((y0 + y1 - HEIGHT) / 2)
    for shift, name in enumerate(NAMES):
        window = (left + shift, top, left + shift + WIDTH, top + HEIGHT)
        copy_crop(source, folder / "training", "000008", 1.0, window, slice(1))
        for path in (folder / "training").glob("*/000008.*"):
            path.rename(path.with_stem(name))
    return folder


@pytest.fixture
def kitti(tiny_kitti: Path, tmp_path: Path) -> Path:
    """The same, to be damaged."""
    return Path(shutil.copytree(tiny_kitti, tmp_path / "kitti"))


def attack(kitti: Path, out: Path, *words: str) -> int:
    frames = ["--dataset", "kitti", "--root", str(kitti), "--no-fit", "--workers", "1"]
    return main(["attack", *frames, "--params", "translate", "--steps", "1", *words, "--out", str(out)])


def done(out: Path) -> list[str]:
    """Names of the frames that are there."""
    return sorted(path.parent.name for path in out.glob("frames/*/result.json"))


def listed(out: Path) -> dict[str, str]:
    return json.loads((out / "metrics.json").read_text())["frames_failed"]


def hashes(out: Path) -> dict[str, str]:
    return json.loads((out / "manifest.json").read_text())["frames"]


@pytest.mark.parametrize("words", [(), ("--keep-going",)])
def test_a_full_disk_ends_an_attack_which_then_goes_on(
    words: tuple[str, ...],
    tiny_kitti: Path,
    tmp_path: Path,
    full_disk: Callable[[int], AbstractContextManager[None]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Also one that is to keep going: the next frame would find no room either."""
    out = tmp_path / "run"
    assert attack(tiny_kitti, out, "--limit", "1") == 0
    capsys.readouterr()
    with full_disk(5000):
        assert attack(tiny_kitti, out, *words) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("drivesem: ")
    assert done(out) == [NAMES[0]]
    assert not files.find_leftovers(out)
    assert attack(tiny_kitti, out) == 0
    assert done(out) == [*NAMES]
    assert main(["verify", "--run", str(out), "--workers", "1"]) == 0


COMMANDS = {
    "attack": ["attack", "--limit", "1", "--steps", "1", "--no-fit", "--workers", "1"],
    "derender": ["derender", "--limit", "1", "--fast", "--workers", "1"],
    "synth": ["synth", "--frames", "1", "--workers", "1"],
    "train": ["train", "--root", "{kitti}", "--steps", "1", "--batch", "1", "--window", "96x64"],
    "convert": ["convert", "{kitti}", "--to", "coco"],
    "eval": ["eval", "--detector", "squeezedet", "--root", "{kitti}"],
}


def run_refused(name: str, kitti: Path, out: Path) -> str:
    """The last line of a command that is refused."""
    words = [word.format(kitti=kitti) for word in COMMANDS[name]]
    return refusal(*words, "--out", out)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_place_that_cannot_be_written_is_one_line(
    name: str, tiny_kitti: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mkdir = Path.mkdir

    def reads_only(self: Path, *words: int, **options: bool) -> None:
        if str(self).startswith(str(tmp_path)):
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(self))
        mkdir(self, *words, **options)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(Path, "mkdir", reads_only)
    line = run_refused(name, tiny_kitti, tmp_path / "a" / "run")
    assert line.startswith(str(tmp_path))
    assert line.endswith("expected a place that can be written, found read-only file system")


@pytest.mark.parametrize("name", ["train", "synth", "derender"])
def test_a_full_disk_leaves_no_half(
    name: str, tiny_kitti: Path, tmp_path: Path, full_disk: Callable[[int], AbstractContextManager[None]]
) -> None:
    out = tmp_path / "run"
    with full_disk(20_000):
        line = run_refused(name, tiny_kitti, out)
    assert "expected a place that can be written, found file too large" in line
    assert not files.find_leftovers(out)
    assert not [path for path in out.rglob("*") if path.suffix in (".png", ".npz", ".safetensors")]
    words = [word.format(kitti=tiny_kitti) for word in COMMANDS[name]]
    assert main([*words, "--out", str(out)]) == 0


def cut_short(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


@pytest.mark.parametrize("damage", [cut_short, Path.unlink, lambda path: path.write_bytes(b"")])
def test_a_picture_in_the_middle_of_a_data_set(
    damage: Callable[[Path], None], kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = kitti / "training" / "image_2" / f"{NAMES[1]}.png"
    whole = picture.read_bytes()
    ends = picture.with_name(f"{NAMES[1]}.png")
    scene = DatasetSource.scene
    vanishing = damage is Path.unlink  # between listing and reading, in which it would not be a frame at all

    def first(self: DatasetSource, identifier: str) -> SceneIR:
        if vanishing and ends.exists():
            ends.unlink()
        return scene(self, identifier)

    if not vanishing:
        damage(picture)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DatasetSource, "scene", first)
        out = tmp_path / "run"
        assert attack(kitti, out) == 2
        (line,) = capsys.readouterr().err.splitlines()[-1:]
        assert line.startswith(f"drivesem: {picture}: expected ")
        assert done(out) == [NAMES[0]], "what was done stays"
        picture.write_bytes(whole)
        if not vanishing:
            damage(picture)
        assert attack(kitti, out, "--keep-going") == 0
    assert done(out) == [NAMES[0], NAMES[2]]
    assert list(listed(out)) == [NAMES[1]]
    assert str(picture) in listed(out)[NAMES[1]]
    picture.write_bytes(whole)
    assert attack(kitti, out) == 0
    assert (done(out), listed(out)) == ([*NAMES], {})


@pytest.mark.parametrize("name", ["arrays.npz", "meshes/0.glb", "background.png", "scene.json"])
def test_a_damaged_scene_of_a_run_is_named(name: str, small_run: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(small_run, tmp_path / "run"))
    path = run / "frames" / "demo-000" / "scene" / name
    cut_short(path)
    assert (
        invoke("confirm", "--run", run, "--workers", "1", "--out", tmp_path / "c", code=2)
        .err.splitlines()[-1]
        .startswith(f"drivesem: {path}")
    )


def test_a_clock_that_jumps_changes_nothing(
    tiny_kitti: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steady, jumping = tmp_path / "steady", tmp_path / "jumping"
    cache = ["--cache", str(tmp_path / "cache")]
    assert attack(tiny_kitti, steady) == 0
    backwards = itertools.count(2_000_000_000, -86_400)
    monkeypatch.setattr(time, "time", lambda: float(next(backwards)))
    assert attack(tiny_kitti, jumping, "--limit", "2", *cache) == 0
    future = time.time() + 1e9
    for path in [*jumping.rglob("*"), *(tmp_path / "cache").rglob("*")]:
        os.utime(path, (future, future))
    assert attack(tiny_kitti, jumping, *cache) == 0
    assert hashes(jumping) == hashes(steady)
    assert main(["verify", "--run", str(jumping), "--workers", "1"]) == 0
    seconds = [json.loads(path.read_text())["seconds"] for path in jumping.glob("frames/*/result.json")]
    assert all(0 < value < 600 for value in seconds)


def test_a_frame_for_which_the_device_has_no_memory(
    tiny_kitti: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = DatasetSource.scene

    def second_is_large(self: DatasetSource, identifier: str) -> SceneIR:
        if identifier == NAMES[1]:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 80.00 GiB.\nSee documentation")
        return scene(self, identifier)

    monkeypatch.setattr(DatasetSource, "scene", second_is_large)
    out, message = (
        tmp_path / "run",
        "--device: expected one with memory for this, found CUDA out of memory. Tried to",
    )
    assert attack(tiny_kitti, out) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"drivesem: {message}")
    assert attack(tiny_kitti, out, "--keep-going") == 0
    assert done(out) == [NAMES[0], NAMES[2]]
    assert listed(out)[NAMES[1]].startswith(message)


def test_results_are_in_their_folders_alone(
    tiny_kitti: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While frames are attacked: those of a night take gigabytes."""
    living: list[weakref.ref[Objective]] = []
    write = run_attack.write_frame

    def results() -> int:
        return sum(isinstance(one, FrameResult) for one in gc.get_objects())

    before = results()

    def watched(attacked: AttackedScene, folder: Path) -> FrameResult:
        gc.collect()
        assert not [one for one in living if one() is not None], "of an earlier frame"
        result = write(attacked, folder)
        living.append(weakref.ref(attacked.objective))
        assert results() <= before + 1
        return result

    monkeypatch.setattr(run_attack, "write_frame", watched)
    assert attack(tiny_kitti, tmp_path / "run") == 0
    assert len(living) == len(NAMES)
