"""The kernels that every picture needs, compiled or loaded together and not one after the other."""

from __future__ import annotations

import sys
import threading
from collections.abc import Sequence
from types import ModuleType

import torch
import warp as wp

from scene_ir.meshes import collapse
from scene_ir.raster import kernels
from scene_ir.render.kernels import blending, ground, patches, placement, shading

PICTURES: tuple[ModuleType, ...] = (shading, collapse, kernels, ground, blending, placement, patches)
"""Modules whose kernels draw a scene in which no weather changes; the one that takes longest first."""
_LONG_S = 2.0
"""Loading takes less: what takes longer is compiled."""


def make_ready(more: Sequence[ModuleType] = ()) -> None:
    """Compile or load the kernels of `PICTURES` and of `more` modules for the CPU, as many at once as torch has
    threads. They are compiled once a machine and version, which a line on the standard error stream says."""
    modules = [wp.get_module(module.__name__) for module in (*more, *PICTURES)]
    said = "drivesem: compiling the renderer's kernels, once on this machine\n"
    line = threading.Timer(_LONG_S, sys.stderr.write, [said])
    line.daemon = True
    line.start()
    try:
        wp.force_load("cpu", modules, max_workers=torch.get_num_threads())
    finally:
        line.cancel()
