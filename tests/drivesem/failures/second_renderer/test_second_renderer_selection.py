"""Generated frames, embedded or in a folder, go to the generator, others to pyrender; runs ask if they are to."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from drivesem.config.commands import AttackConfig
from drivesem.failures.second_renderer.generator import GeneratorRenderer
from drivesem.failures.second_renderer.opengl import OpenGLContext
from drivesem.failures.second_renderer.photograph import PhotographRenderer
from drivesem.failures.second_renderer.selection import SecondRenderers
from drivesem.run.attack import AttackWorker
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
        assert isinstance(SecondRenderers(dataset, root).renderer_for("any", scene), GeneratorRenderer)


def test_frames_of_a_folder_that_the_generator_wrote(folder: Path) -> None:
    scene = open_source(AttackConfig(dataset="kitti", root=str(folder))).scene("000000")
    second = SecondRenderers("kitti", str(folder))
    assert isinstance(second.renderer_for("000000", scene), GeneratorRenderer)


def test_photographs_go_to_pyrender(screen: OpenGLContext, tmp_path: Path) -> None:
    del screen
    scene = demo_scene(0, 0)
    photograph = replace(scene, provenance={**scene.provenance, "dataset": "kitti"})
    second = SecondRenderers("kitti", str(tmp_path))
    second.check()
    assert isinstance(second.renderer_for("000000", photograph), PhotographRenderer)


def test_photographs_do_not_load_the_generator(tmp_path: Path) -> None:
    code = (
        "import sys\n"
        "from drivesem.failures.second_renderer.selection import SecondRenderers\n"
        f"assert not SecondRenderers('kitti', {str(tmp_path)!r}).generated\n"
        "print('drivesem.synth.frames' in sys.modules)\n"
    )
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
        == "False\n"
    )


def test_attacks_on_one_scene_share_the_renderer() -> None:
    second, one, two = SecondRenderers("demo", None), demo_scene(0, 0), demo_scene(0, 1)
    first = second.renderer_for("demo-000", one)
    assert second.renderer_for("demo-000", one.with_objects(yaw=one.objects.yaw + 0.1)) is first
    assert second.renderer_for("demo-001", two) is not first


@pytest.mark.parametrize("confirm", [True, False])
def test_runs_use_the_second_renderer_on_request(confirm: bool) -> None:
    assert (
        AttackWorker.from_config(AttackConfig(confirm=confirm)).grader.make_second_renderer is not None
    ) == confirm
