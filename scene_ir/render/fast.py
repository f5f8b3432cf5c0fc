"""The fast path: what the plain torch of `reference` and `texture` does, in few passes.

The kernels are in `kernels.photographed_pixels`, which is imported on first use. Shapes as in `reference`.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from scene_ir.raster import verbs
from scene_ir.render import channels, texture
from scene_ir.render.prepare import PreparedScene, VisibleSurfaces
from scene_ir.render.prepare import at_photographed_pose as photographed_at
from scene_ir.render.surfaces import offset_indices

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
class FixedGeometry:
    """What no parameter touches. faces, beside (F, 3) int32, see `surfaces.Surface`; base_clip (V, 3), then;
    base (V, 3): cosine towards the camera then, paint, height; own (V, channels.OWN), with local normals, without
    depth; texels, dark: values (S, channels.TEXEL) and (S, 4), the fourth 0, rects (N, 4), offsets (N + 1,);
    patches (N, 3, 3) float64: from (s, t, 1) on a shadow's patch, 0 to 1 both ways, to its clip coordinates then;
    frame_wh (N, 2) px; unproject (N, 3, 3).
    """

    faces: Tensor
    neighbours: Tensor
    base_clip: Tensor
    base: Tensor
    own: Tensor
    texels: tuple[Tensor, Tensor, Tensor]
    patches: Tensor
    dark: tuple[Tensor, Tensor, Tensor]
    frame_wh: Tensor
    unproject: Tensor

    @classmethod
    def from_scene(cls, prepared: PreparedScene) -> FixedGeometry:
        """Of one scene."""
        object_surfaces, base, count = (
            prepared.object_surfaces,
            prepared.base_geometry,
            len(prepared.scene.objects),
        )
        assert prepared.texels is not None
        assert prepared.shadows is not None
        height, width = prepared.frame_hw
        return cls(
            faces=object_surfaces.faces.to(torch.int32).contiguous(),
            neighbours=object_surfaces.neighbours.to(torch.int32).contiguous(),
            base_clip=base.clip,
            base=torch.stack([base.facing_cos, object_surfaces.paint, prepared.vertex_height], dim=1),
            own=prepared.completion_attributes(prepared.sharp_normals, torch.zeros_like(prepared.vertex_height)),
            texels=(
                prepared.texels.values[: int(prepared.texels.offsets[count])],
                prepared.texels.rects[:count],
                prepared.texels.offsets[: count + 1],
            ),
            patches=prepared.batch.patch_matrices([photographed_at(prepared.scene.objects)]),
            dark=(
                torch.nn.functional.pad(prepared.shadows.values, (0, 1)),
                prepared.shadows.rects,
                prepared.shadows.offsets,
            ),
            frame_wh=prepared.like.new_tensor([width, height]).expand(count, 2).contiguous(),
            unproject=prepared.unproject.expand(count, 3, 3).contiguous(),
        )

    @classmethod
    def concat(cls, parts: Sequence[FixedGeometry]) -> FixedGeometry:
        """Several scenes' objects, one after the other."""
        if len(parts) == 1:
            return parts[0]
        plain = ("base_clip", "base", "own", "patches", "frame_wh", "unproject")
        return cls(
            faces=torch.cat(offset_indices([p.faces for p in parts], [p.base_clip.shape[0] for p in parts])),
            neighbours=torch.cat(offset_indices([p.neighbours for p in parts], [p.faces.shape[0] for p in parts])),
            texels=_concat_crops([p.texels for p in parts]),
            dark=_concat_crops([p.dark for p in parts]),
            **{name: torch.cat([getattr(p, name) for p in parts]) for name in plain},
        )


def _concat_crops(crops: Sequence[tuple[Tensor, Tensor, Tensor]]) -> tuple[Tensor, Tensor, Tensor]:
    """Values, rectangles and offsets of several packs of crops as one."""
    starts = [sum(c[0].shape[0] for c in crops[:i]) for i in range(len(crops))]
    ends = [c[2][1:] + start for c, start in zip(crops, starts, strict=True)]
    offsets = torch.cat([crops[0][2][:1], *ends])
    return torch.cat([c[0] for c in crops]), torch.cat([c[1] for c in crops]), offsets


@dataclass(frozen=True, slots=True)
class PaintCodes:
    """Texture codes (N, 5), CIE L* (N,) of the objects' paint, and where they are paint."""

    values: Tensor
    lightness: Tensor
    regions: texture.PaintRegions


def draw_photographed(
    fixed: FixedGeometry,
    drawn: VisibleSurfaces,
    reach_px: Sequence[float],
    yaw: Tensor,
    code: PaintCodes | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Premultiplied RGB and opacity / depth (T, 4), opacity (T,), depth (T,) m of all packed pixels; the factors
    (Ts, 3) by which their shadows darken the ground.

    reach_px: of each halo; code: texture codes, if there are any.
    """
    from scene_ir.render.kernels.photographed_pixels import PhotographedPixels, ShadingInputs

    def paint(
        mesh: Tensor, halo: Tensor, look: Tensor, fill: Tensor, values: Tensor, table: Tensor, nearest: Tensor
    ) -> tuple[Tensor, Tensor]:
        assert code is not None
        draw = table[:, 0].long()
        rows, lightness = values.index_select(0, draw), code.lightness.index_select(0, draw)
        texels, known = code.regions.texels, code.regions.known.index_select(0, draw)
        anchor = look.index_select(0, nearest.clamp(min=0))

        def painted(rgba: Tensor, looked: Tensor, unseen: Tensor) -> Tensor:
            paint = looked[:, channels.PAINT]
            if texels.values.numel():
                uv = table[:, 1:3].to(looked) + looked[:, : channels.W_THEN]
                found = verbs.texture_packed(
                    texels.values, texels.rects, texels.offsets, drawn.mesh.layout, uv, "warp", "zero"
                )
                paint = texture.paint_share(paint, found[:, 0], unseen, known)
            colour = texture.apply_texture_code(
                rgba[:, :3], rgba[:, 3], rows, paint, looked[:, channels.HEIGHT], lightness, "warp"
            )
            return torch.cat([colour, rgba[:, 3:]], dim=1)

        return painted(mesh, look, fill), painted(halo, anchor, torch.zeros_like(fill))

    geometry = drawn.geometry
    assert geometry.pixel_to_patch is not None
    assert geometry.lights is not None
    then = fixed.patches @ geometry.pixel_to_patch
    inputs = ShadingInputs(
        fragments=drawn.mesh,
        ground=drawn.patch_layout,
        inside=geometry.pixel_to_patch.detach(),
        reach_px=reach_px,
        painter=paint if code is not None else None,
        **{f.name: getattr(fixed, f.name) for f in fields(fixed) if f.name != "patches"},
    )
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
