"""Kernels that are compiled or loaded together."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import warp as wp

from scene_ir.render.kernels import colour, ready


@pytest.mark.parametrize("compiles", [True, False])
@pytest.mark.parametrize("takes_long", [True, False])
def test_all_modules_are_loaded_at_once_and_a_long_wait_for_a_compiler_is_told(
    takes_long: bool,
    compiles: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    asked: list[tuple[Any, list[str], int]] = []
    loaded = [SimpleNamespace(name=f"module {i}", execs={}) for i in range(len(ready.PICTURES) + 1)]

    def force_load(device: str, modules: list[Any], max_workers: int) -> None:
        asked.append((device, [module.name for module in modules], max_workers))
        if compiles:
            (tmp_path / "wp_module").mkdir()
        for module in modules[:2]:
            time.sleep(0.3 if takes_long else 0.0)
            module.execs["cpu"] = 1
        time.sleep(0.3 if takes_long else 0.0)

    names = iter(loaded)
    (tmp_path / "wp_older").mkdir()
    os.utime(tmp_path / "wp_older", (1e9, 1e9))
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(wp, "get_module", lambda name: next(names))
    monkeypatch.setattr(wp, "force_load", force_load)
    monkeypatch.setattr(ready, "_LONG_S", 0.05 if takes_long else 30.0)
    monkeypatch.setattr(ready, "_LOOK_S", 0.05)
    ready.make_ready([colour])
    ((device, told_of, workers),) = asked
    assert device == "cpu"
    assert told_of == [module.name for module in loaded]
    assert workers >= 1
    told = capsys.readouterr()
    assert told.out == ""
    count = len(loaded)
    expected = [f"{done} of {count} are ready" for done in range(3)] if takes_long and compiles else []
    assert [line.split(": ")[-1] for line in told.err.splitlines()] == expected
    assert told.err.count("compiling the renderer's kernels, once on this machine") == len(expected)


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
