"""Scenes that are kept: once for the same content, made again for any other, within a limit."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from drivesem.cli import main
from drivesem.config.commands import AttackConfig
from drivesem.scenes.scene_cache import SceneCache, content_digest
from drivesem.scenes.sources import DatasetSource, _open_cache
from drivesem.synth.demo import demo_scene
from scene_ir import files
from scene_ir.derender import derender as derendering
from scene_ir.types import SceneIR


@dataclass(frozen=True)
class CachedInput:
    name: str
    at: torch.Tensor


@pytest.fixture(scope="module")
def scene() -> SceneIR:
    return demo_scene(0, 0)


@dataclass
class Maker:
    scene: SceneIR
    calls: int = 0

    def __call__(self) -> SceneIR:
        self.calls += 1
        return self.scene


def test_the_same_content_has_the_same_digest() -> None:
    cached_input = CachedInput("a", torch.tensor([1.0, 2.0]))
    assert content_digest(cached_input) == content_digest(replace(cached_input, at=cached_input.at.clone()))
    others = [
        replace(cached_input, name="b"),
        replace(cached_input, at=torch.tensor([1.0, 2.5])),
        replace(cached_input, at=torch.tensor([1.0, 2.0], dtype=torch.float64)),
        replace(cached_input, at=torch.tensor([[1.0, 2.0]])),
        (cached_input,),
        {"a": cached_input},
    ]
    assert len({content_digest(one) for one in [cached_input, *others]}) == 1 + len(others)
    assert content_digest(["ab", "c"]) != content_digest(["a", "bc"])
    assert content_digest({"a": 1, "b": 2}) == content_digest({"b": 2, "a": 1})
    with pytest.raises(TypeError, match="plain values"):
        content_digest(object())


def test_a_scene_is_made_once(scene: SceneIR, tmp_path: Path) -> None:
    cached, make = SceneCache(tmp_path / "kept", 1.0), Maker(scene)
    first, second = cached.get_or_make(("a", 1), make), cached.get_or_make(("a", 1), make)
    assert make.calls == 1
    torch.testing.assert_close(second.photograph, first.photograph, rtol=0, atol=0)
    torch.testing.assert_close(second.objects.translation, first.objects.translation, rtol=0, atol=0)
    cached.get_or_make(("a", 2), make)
    assert make.calls == 2


def test_a_damaged_scene_is_made_again(scene: SceneIR, tmp_path: Path) -> None:
    cached, make = SceneCache(tmp_path, 1.0), Maker(scene)
    cached.get_or_make("a", make)
    (folder,) = tmp_path.iterdir()
    (folder / "scene.json").write_text("{")
    cached.get_or_make("a", make)
    cached.get_or_make("a", make)
    assert make.calls == 2


def test_least_recently_used_scenes_are_removed_first(scene: SceneIR, tmp_path: Path) -> None:
    make = Maker(scene)
    SceneCache(tmp_path, 1.0).get_or_make("old", make)
    (old,) = tmp_path.iterdir()
    size = sum(file.stat().st_size for file in old.rglob("*") if file.is_file()) / 1e9
    SceneCache(tmp_path, 1.0).get_or_make("asked for", make)
    for age, path in enumerate(tmp_path.iterdir()):
        os.utime(path, (age, 1000 if path == old else 0))
    cached = SceneCache(tmp_path, 2.5 * size)
    cached.get_or_make("old", make)
    cached.get_or_make("new", make)
    assert make.calls == 3
    cached.get_or_make("old", make)
    cached.get_or_make("new", make)
    assert make.calls == 3, "both are there"
    assert len(list(tmp_path.iterdir())) == 2
    SceneCache(tmp_path, 1e-9).get_or_make("newest", make)
    assert len(list(tmp_path.iterdir())) == 1, "the newest stays, however large"


def test_a_lower_limit_holds_for_a_command_that_adds_nothing(scene: SceneIR, tmp_path: Path) -> None:
    make = Maker(scene)
    for name in ("a", "b"):
        SceneCache(tmp_path / "kept", 1.0).get_or_make(name, make)
    config = AttackConfig(dataset="kitti", root=str(tmp_path), cache=str(tmp_path / "kept"), cache_gb=1.0)
    _open_cache(config)
    assert len(list((tmp_path / "kept").iterdir())) == 2
    _open_cache(replace(config, cache_gb=1e-9))
    assert not list((tmp_path / "kept").iterdir())
    assert _open_cache(replace(config, cache=str(tmp_path / "none"))) is not None


def test_photographs_are_taken_apart_once(scene: SceneIR, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not for other labels or settings: those make other scenes."""
    image = np.full((60, 200, 3), 90, np.uint8)
    folder = tmp_path / "D" / "training"
    files.write_png(folder / "image_2/000000.png", image)
    files.write_text(folder / "label_2/000000.txt", "")
    files.write_text(folder / "calib/000000.txt", "P2: 90 0 100 0 0 90 30 0 0 0 1 0\n")
    make = Maker(scene)
    monkeypatch.setattr(derendering, "derender", lambda *_: make())
    config = AttackConfig(dataset="kitti", root=str(tmp_path / "D"), cache=str(tmp_path / "kept"))
    DatasetSource(config).scene("000000")
    DatasetSource(config).scene("000000")
    assert make.calls == 1
    DatasetSource(replace(config, fit=False)).scene("000000")
    assert make.calls == 2
    files.write_text(folder / "label_2/000000.txt", "DontCare -1 -1 -10 5 5 9 9 -1 -1 -1 -1000 -1000 -1000 -10\n")
    DatasetSource(config).scene("000000")
    assert make.calls == 3
    DatasetSource(replace(config, cache=None)).scene("000000")
    assert make.calls == 4


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["attack", "--cache", "c"], "--cache: expected a --dataset of photographs"),
        (["derender", "--dataset", "kitti", "--root", ".", "--cache", "c"], "--cache: expected none"),
        (["attack", "--cache-gb", "0"], "--cache-gb: expected a number above 0"),
    ],
)
def test_bad_input(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 2
    assert message in capsys.readouterr().err


def test_what_another_process_is_writing_stays(tmp_path: Path) -> None:
    """What was left by one that was killed, long ago, goes as a scene does."""
    writing, left, scene = tmp_path / ".b.01234567.tmp", tmp_path / ".a.89abcdef.tmp", tmp_path / "c"
    for path in (writing, left, scene):
        files.write_text(path / "scene.json", "{}")
    os.utime(left, (0, 0))
    SceneCache(tmp_path, 1e-9).evict()
    assert list(tmp_path.iterdir()) == [writing]
