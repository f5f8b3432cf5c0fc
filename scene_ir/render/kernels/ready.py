"""The kernels that every picture needs, compiled or loaded together and not one after the other."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import torch
import warp as wp

from scene_ir.meshes import collapse
from scene_ir.raster import kernels
from scene_ir.render.kernels import blending, ground, patches, placement, shading

PICTURES: tuple[ModuleType, ...] = (shading, collapse, kernels, ground, blending, placement, patches)
"""Modules whose kernels draw a scene in which no weather changes; the one that takes longest first."""
_LONG_S = 2.0
"""Nobody is told of what takes less."""
_LOOK_S = 0.5


def make_ready(more: Sequence[ModuleType] = ()) -> None:
    """Compile or load the kernels of `PICTURES` and of `more` modules for the CPU, as many at once as torch has
    threads. They are compiled once a machine and version, which lines on the standard error stream follow."""
    modules = [wp.get_module(module.__name__) for module in (*more, *PICTURES)]
    done = threading.Event()
    watch = threading.Thread(target=_tell, args=(modules, time.time(), done), daemon=True)
    watch.start()
    try:
        wp.force_load("cpu", modules, max_workers=torch.get_num_threads())
    finally:
        done.set()
        watch.join()


def _tell(modules: Sequence[Any], begun: float, done: threading.Event) -> None:
    """How many of the modules are ready, each time it changes, where one is compiled and not only loaded."""
    said = None
    wait = _LONG_S
    while not done.wait(wait):
        wait = _LOOK_S
        if said is None and not _written_since(begun):
            continue  # on a busy machine loading takes long too
        ready = sum(bool(module.execs) for module in modules)
        if ready != said:
            said = ready
            once = "compiling the renderer's kernels, once on this machine"
            sys.stderr.write(f"drivesem: {once}: {ready} of {len(modules)} are ready\n")


def _written_since(begun: float) -> bool:
    """Whether Warp wrote compiled kernels since a time, s."""
    folder = wp.config.kernel_cache_dir
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        # file systems round times
        return any(entry.stat().st_mtime >= begun - 1.0 for entry in entries)
    return False
