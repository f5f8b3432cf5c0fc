"""Generated frames, embedded or in a folder, go to the generator, others to pyrender; runs ask if they are to."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from drivesem.config.commands import Attack
from drivesem.failures.second_renderer.choose import SecondRenderers
from drivesem.failures.second_renderer.generator import GeneratorRedraw
from drivesem.failures.second_renderer.photograph import PhotographRedraw
from drivesem.failures.second_renderer.screen import Screen
from drivesem.run.attack import Worker
from drivesem.scenes.sources import open_source
from drivesem.synth.demo import demo_scene
from drivesem.synth.write import Order, synthesise


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("data") / "streets"
    list(synthesise(Order(out, 1, seed=5, split="heldout")))
    return out


def test_an_embedded_scene_is_known_wherever_it_comes_from(tmp_path: Path) -> None:
    scene = demo_scene(0, 0)
    for dataset, root in (("demo", None), ("kitti", str(tmp_path)), ("coco", str(tmp_path))):
        assert isinstance(SecondRenderers(dataset, root).of("any", scene), GeneratorRedraw)


def test_frames_of_a_folder_that_the_generator_wrote(folder: Path) -> None:
    scene = open_source(Attack(dataset="kitti", root=str(folder))).scene("000000")
    second = SecondRenderers("kitti", str(folder))
    assert isinstance(second.of("000000", scene), GeneratorRedraw)


def test_photographs_go_to_pyrender(screen: Screen, tmp_path: Path) -> None:
    del screen
    scene = demo_scene(0, 0)
    photograph = replace(scene, provenance={**scene.provenance, "dataset": "kitti"})
    second = SecondRenderers("kitti", str(tmp_path))
    second.check()
    assert isinstance(second.of("000000", photograph), PhotographRedraw)


def test_attacks_on_one_scene_share_the_renderer() -> None:
    second, one, two = SecondRenderers("demo", None), demo_scene(0, 0), demo_scene(0, 1)
    first = second.of("demo-000", one)
    assert second.of("demo-000", one.with_objects(yaw=one.objects.yaw + 0.1)) is first
    assert second.of("demo-001", two) is not first


@pytest.mark.parametrize("confirm", [True, False])
def test_runs_ask_the_second_renderer_if_they_are_to(confirm: bool) -> None:
    assert (Worker.of(Attack(confirm=confirm)).grader.second is not None) == confirm
