"""Kernels that are compiled or loaded together."""

from __future__ import annotations

import subprocess
import sys
import time
from typing import Any

import pytest
import warp as wp

from scene_ir.render.kernels import colour, ready


@pytest.mark.parametrize("takes_long", [True, False])
def test_all_modules_are_loaded_at_once_and_a_long_wait_is_told(
    takes_long: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[tuple[Any, list[str], int]] = []

    def force_load(device: str, modules: list[Any], max_workers: int) -> None:
        asked.append((device, [module.name for module in modules], max_workers))
        time.sleep(0.3 if takes_long else 0.0)

    monkeypatch.setattr(wp, "force_load", force_load)
    monkeypatch.setattr(ready, "_LONG_S", 0.05 if takes_long else 30.0)
    ready.make_ready([colour])
    ((device, names, workers),) = asked
    assert device == "cpu"
    assert names == [module.__name__ for module in (colour, *ready.PICTURES)]
    assert workers >= 1
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.count("compiling the renderer's kernels") == takes_long


def test_a_scene_is_drawn_with_these_kernels_and_no_others() -> None:
    script = """
import torch, warp as wp
from scene_ir.render.kernels import ready
ready.make_ready()
def loaded():
    return {name for name, module in wp._src.context.user_modules.items() if module.execs}
before = loaded()
assert before >= {module.__name__ for module in ready.PICTURES}, before
from drivesem.bench.scenes import bench_scene
from scene_ir.render.compositor import Compositor
scene = bench_scene(1, 2000, 0).scene
leaf = (scene.objects.translation.float() + 0.1).requires_grad_()
image = Compositor(scene).render(scene.with_objects(translation=leaf)).image
image.sum().backward()
assert all(name.startswith("drivesem.synth") for name in loaded() - before), loaded() - before
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
