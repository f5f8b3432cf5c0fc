"""The compositor's fast path: what the plain torch of `compositor` and `texture` does, in few passes.

The kernels are in `raster.shading`, which is imported on first use. Shapes as in `compositor`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from scene_ir import texture
from scene_ir.surfaces import Fleet

if TYPE_CHECKING:
    from scene_ir.compositor import Drawn


@dataclass(frozen=True, slots=True)
class Rig:
    """What placing vertices takes besides the pose: normal (V, 3) unit, local; owner (V,) int32; matrix (N, 3, 4) and
    centre (N, 3) m of the objects' cameras; edges: the objects' first vertices, and V."""

    normal: Tensor
    owner: Tensor
    matrix: Tensor
    centre: Tensor
    edges: list[int]

    @classmethod
    def of(cls, fleet: Fleet, normal: Tensor, matrix: Tensor, centre: Tensor) -> Rig:
        """Of one scene's objects. matrix (3, 4), centre (3,)."""
        count = fleet.vertex_ranges.shape[0]
        return cls(
            normal.contiguous(),
            fleet.owner.to(torch.int32),
            matrix.to(normal).expand(count, 3, 4).contiguous(),
            centre.to(normal).expand(count, 3).contiguous(),
            [0, *fleet.vertex_ranges[:, 1].tolist()],
        )


@dataclass(frozen=True, slots=True)
class Fixed:
    """What no parameter touches. faces (F, 3) int32; base_clip (V, 3), then; base (V, 3): cosine towards the camera
    then, paint, height; own (V, 13): colours (3), local normal (3), paint, glass, height, mirror clip (3), mirror
    cosine; texels, dark: values (S, 8) and (S, 3), rects (N.., 4), offsets (N.. + 1,); ground_clip (4N, 3), then;
    ground_faces (2N, 3) int32; frame_wh (N, 2) px; sun (N, 3); unproject (N, 3, 3).
    """

    faces: Tensor
    base_clip: Tensor
    base: Tensor
    own: Tensor
    texels: tuple[Tensor, Tensor, Tensor]
    ground_clip: Tensor
    ground_faces: Tensor
    dark: tuple[Tensor, Tensor, Tensor]
    frame_wh: Tensor
    sun: Tensor
    unproject: Tensor


def place(rig: Rig, local: Tensor, yaw: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
    """Clip coordinates (V, 3) of local vertices (V, 3) m, and the cosines (V,) of their normals to the camera."""
    from scene_ir.raster import shading

    clip, facing = shading.Place.apply(
        local, yaw, translation, rig.normal, rig.owner, rig.matrix, rig.centre, rig.edges
    )
    return clip, facing


def photographed(
    fixed: Fixed, drawn: Drawn, yaw: Tensor, tint: Tensor, code: tuple[Tensor, Tensor] | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Premultiplied RGB and opacity / depth (T, 4), opacity (T,), depth (T,) m of all packed pixels.

    tint (N, 3): the templates' paint; code: texture codes (N, 5) and CIE L* of the paint (N,), if there are any.
    """
    from scene_ir.raster import shading

    fragments, geometry, coverage = drawn.mesh, drawn.geometry, drawn.coverage
    edges = fragments.layout.offsets.tolist()
    table = shading.pixel_table(fragments.layout)
    look = shading.Look.apply(
        geometry.clip, geometry.cos, fragments, table, fixed.base_clip, fixed.base, fixed.faces, edges
    )
    look = shading.Fill.apply(look, coverage, fragments, table, edges)
    flat = coverage.detach()
    mesh, halo, left = shading.Shade.apply(
        look, flat, fragments, table, drawn.nearest, fixed.texels, fixed.frame_wh, edges
    )
    need = left.detach().nonzero()[:, 0]
    if need.numel():
        own = shading.Own.apply(geometry.clip, fragments, table, left.detach(), fixed.faces, fixed.own, edges)
        own = shading.Fill.apply(own, coverage, fragments, table, edges)
        view = (fixed.sun, tint.contiguous(), fixed.frame_wh, fixed.unproject)
        mesh = shading.Complete.apply(mesh, left, own, look, yaw, table, need, fixed.texels, view, edges)
    if code is not None:
        draw = table[:, 0].long()
        values, lightness = code[0].index_select(0, draw), code[1].index_select(0, draw)
        anchor = look.index_select(0, drawn.nearest.clamp(min=0))
        mesh = _painted(mesh, look, values, lightness)
        halo = _painted(halo, anchor, values, lightness)
    return shading.Combine.apply(mesh, halo, coverage, look, fragments, drawn.nearest, edges)


def _painted(rgba: Tensor, look: Tensor, code: Tensor, lightness: Tensor) -> Tensor:
    colour = texture.apply_texture_code(rgba[:, :3], rgba[:, 3], code, look[:, 6], look[:, 7], lightness)
    return torch.cat([colour, rgba[:, 3:]], dim=1)


def shadows(fixed: Fixed, drawn: Drawn) -> Tensor:
    """Factors (Ts, 3) on the ground, of all patches."""
    from scene_ir.raster import shading

    layout, clip = drawn.ground.layout, drawn.geometry.ground_clip
    if layout.size == 0:
        return clip.new_zeros(0, 3)
    return shading.Shadow.apply(
        clip, drawn.ground, shading.pixel_table(layout), fixed.ground_clip, fixed.ground_faces, fixed.dark,
        fixed.frame_wh, layout.offsets.tolist(),
    )  # fmt: skip
