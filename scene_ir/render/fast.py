"""The fast path: what `reference` and `texture` compute in plain torch, by Warp kernels in few passes.

Kernels are imported on first use. Shapes as in `reference`.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from scene_ir.raster import verbs
from scene_ir.render import channels, texture
from scene_ir.render.fixed_geometry import FixedGeometry
from scene_ir.render.prepare import VisibleSurfaces

_PICTURE_MODULES = (
    "scene_ir.render.kernels.shading",
    "scene_ir.meshes.collapse",
    "scene_ir.raster.kernels",
    "scene_ir.render.kernels.shadows",
    "scene_ir.render.kernels.blending",
    "scene_ir.render.kernels.placement",
    "scene_ir.render.kernels.shadow_patches",
)
"""Kernels that render a scene without weather; the module that compiles longest comes first."""
_QUIET_S, _POLL_S = 2.0, 0.5
"""Compilation is reported after this many seconds, and checked this often."""


@dataclass(frozen=True, slots=True)
class PaintCodes:
    """Texture codes, and what they change."""

    values: Tensor
    """(N, 5) or (N, 8), see `texture.codes_by_part`."""
    lightness: Tensor
    """(N,) CIE L* of the objects' paint."""
    regions: texture.PaintRegions
    """Where the objects are paint."""


def draw_photographed(
    fixed: FixedGeometry, drawn: VisibleSurfaces, yaw: Tensor, code: PaintCodes | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Draw photographed objects and their shadows.

    Args:
        fixed: Input that no parameter affects.
        drawn: Visible surfaces of the perturbation.
        yaw: (N,) rad.
        code: Texture codes; None if all are 0.

    Returns:
        Premultiplied RGB and opacity / depth (T, 4), opacity (T,), depth (T,) m of all packed pixels; shadow
        factors (Ts, 3) of the ground.
    """
    from scene_ir.render.kernels.photographed_pixels import PhotographedPixels, ShadingInputs

    def paint(
        mesh: Tensor, halo: Tensor, lookup: Tensor, fill: Tensor, values: Tensor, table: Tensor, nearest: Tensor
    ) -> tuple[Tensor, Tensor]:
        assert code is not None
        draw = table[:, 0].long()
        rows, lightness = values.index_select(0, draw), code.lightness.index_select(0, draw)
        texels, known = code.regions.texels, code.regions.known.index_select(0, draw)
        anchor = lookup.index_select(0, nearest.clamp(min=0))

        def painted(rgba: Tensor, lookup: Tensor, unseen: Tensor) -> Tensor:
            paint = lookup[:, channels.PAINT]
            if texels.values.numel():
                uv = table[:, 1:3].to(lookup) + lookup[:, : channels.W_THEN]
                region = verbs.texture_packed(
                    texels.values, texels.rects, texels.offsets, drawn.mesh.layout, uv, "warp", "zero"
                )
                paint = texture.paint_share(paint, region[:, 0], unseen, known)
            height = lookup[:, channels.HEIGHT]
            codes = texture.codes_at_height(rows, height)
            colour = texture.apply_texture_code(rgba[:, :3], rgba[:, 3], codes, paint, height, lightness, "warp")
            return torch.cat([colour, rgba[:, 3:]], dim=1)

        return painted(mesh, lookup, fill), painted(halo, anchor, torch.zeros_like(fill))

    geometry = drawn.geometry
    assert geometry.pixel_to_patch is not None
    assert geometry.lights is not None
    then = fixed.base_patches @ geometry.pixel_to_patch
    inputs = ShadingInputs(fixed, drawn, paint if code is not None else None)
    codes = code.values if code is not None else yaw.new_zeros(0)
    return PhotographedPixels.apply(
        geometry.clip,
        geometry.facing_cos,
        geometry.brightening,
        drawn.coverage,
        yaw,
        then,
        codes,
        geometry.lights,
        inputs,
    )


def compile_kernels(more: Sequence[ModuleType] = ()) -> None:
    """Compile or load the kernels that render scenes, and those of `more` modules, in parallel.

    Kernels are compiled once per machine and version; progress goes to standard error.
    """
    import warp as wp

    picture_modules = [importlib.import_module(name) for name in _PICTURE_MODULES]
    modules = [wp.get_module(module.__name__) for module in (*more, *picture_modules)]
    done = threading.Event()
    reporter = threading.Thread(
        target=_report_compilation, args=(modules, wp.config.kernel_cache_dir, done), daemon=True
    )
    reporter.start()
    try:
        wp.force_load("cpu", modules, max_workers=torch.get_num_threads())
    finally:
        done.set()
        reporter.join()


def _report_compilation(modules: Sequence[Any], cache_folder: str, done: threading.Event) -> None:
    """Print how many modules are ready whenever that changes, if any is compiled rather than loaded."""
    begin, reported, wait = time.time(), None, _QUIET_S
    while not done.wait(wait):
        wait = _POLL_S
        if reported is None and not _written_since(cache_folder, begin):
            continue  # loading, too, is slow on a busy machine
        ready = sum(bool(module.execs) for module in modules)
        if ready != reported:
            reported = ready
            message = "compiling the renderer's kernels, once on this machine"
            sys.stderr.write(f"drivesem: {message}: {ready} of {len(modules)} are ready\n")


def _written_since(folder: str, begin: float) -> bool:
    """Whether an entry of a folder was written since a time in seconds."""
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        # File systems round times.
        return any(entry.stat().st_mtime >= begin - 1.0 for entry in entries)
    return False
