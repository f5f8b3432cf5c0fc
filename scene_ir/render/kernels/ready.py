"""The kernels that every picture needs, compiled or loaded together and not one after the other."""

from __future__ import annotations

import importlib
import sys
import threading
from collections.abc import Sequence

import torch
import warp as wp

PICTURES = (
    "scene_ir.render.kernels.shading",  # the one that takes longest first
    "scene_ir.meshes.collapse",
    "scene_ir.raster.kernels",
    "scene_ir.render.kernels.ground",
    "scene_ir.render.kernels.blending",
    "scene_ir.render.kernels.placement",
)
"""Modules whose kernels draw a scene in which no weather changes."""
_LONG_S = 2.0
"""Loading takes less: what takes longer is compiled."""


def make_ready(more: Sequence[str] = ()) -> None:
    """Compile or load the kernels of `PICTURES` and of `more` modules for the CPU, as many at once as torch has
    threads. They are compiled once a machine and version, which a line on the standard error stream says."""
    names = [*more, *PICTURES]
    for name in names:
        importlib.import_module(name)
    said = "drivesem: compiling the renderer's kernels, once on this machine\n"
    line = threading.Timer(_LONG_S, sys.stderr.write, [said])
    line.daemon = True
    line.start()
    try:
        wp.force_load("cpu", [wp.get_module(name) for name in names], max_workers=torch.get_num_threads())
    finally:
        line.cancel()
