"""Parallel compilation of the kernels, and its progress lines."""

import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import warp as wp

from scene_ir.render import fast
from scene_ir.render.kernels import colour

MODULE_COUNT = 8
"""The renderer's modules, and one that the test adds."""


@pytest.mark.parametrize(("compiles", "is_slow"), [(True, True), (True, False), (False, True), (False, False)])
def test_modules_load_together_and_slow_compilation_is_reported(
    compiles: bool,
    is_slow: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    calls: list[tuple[str, list[Any], int]] = []
    modules = [SimpleNamespace(execs={}) for _ in range(MODULE_COUNT)]

    def force_load(device: str, loaded: list[Any], max_workers: int) -> None:
        calls.append((device, loaded, max_workers))
        if compiles:
            (tmp_path / "wp_module").mkdir()
        for module in loaded[:2]:
            time.sleep(0.3 if is_slow else 0.0)
            module.execs["cpu"] = 1
        time.sleep(0.3 if is_slow else 0.0)

    names = iter(modules)
    (tmp_path / "wp_older").mkdir()
    os.utime(tmp_path / "wp_older", (1e9, 1e9))
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(wp, "get_module", lambda name: next(names))
    monkeypatch.setattr(wp, "force_load", force_load)
    monkeypatch.setattr(fast, "_QUIET_S", 0.05 if is_slow else 30.0)
    monkeypatch.setattr(fast, "_POLL_S", 0.05)
    fast.compile_kernels([colour])
    ((device, loaded, workers),) = calls
    assert (device, loaded) == ("cpu", modules)
    assert workers >= 1
    printed = capsys.readouterr()
    assert printed.out == ""
    expected = [f"{done} of {MODULE_COUNT} are ready" for done in range(3)] if is_slow and compiles else []
    assert [line.split(": ")[-1] for line in printed.err.splitlines()] == expected
    assert printed.err.count("compiling the renderer's kernels, once on this machine") == len(expected)


def test_a_scene_needs_exactly_these_modules() -> None:
    script = """
import warp as wp
from scene_ir.render import fast
fast.compile_kernels()
def loaded():
    return {name for name, module in wp._src.context.user_modules.items() if module.execs}
before = loaded()
assert before >= set(fast._PICTURE_MODULES), before
from drivesem.bench.scenes import build_bench_scene
from scene_ir.render.compositor import Compositor
scene = build_bench_scene(1, 2000, 0).scene
translation = (scene.objects.translation.float() + 0.1).requires_grad_()
Compositor(scene).render(scene.with_objects(translation=translation)).image.sum().backward()
assert all(name.startswith("drivesem.synth") for name in loaded() - before), loaded() - before
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
