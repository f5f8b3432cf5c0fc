# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportOptionalMemberAccess=false
"""All pixels of photographed vehicles and of their shadows: the stages of `shading` and `shadows` in order.

Shapes: N objects, V vertices, T packed pixels, Ts packed pixels of the shadows' patches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from scene_ir.raster.launch import (
    array,
    launch,
    load_kernel,
    make_struct,
    run_in_threads,
    split_by_work,
    split_range,
)
from scene_ir.render import channels, surfaces
from scene_ir.render.fixed_geometry import FixedGeometry
from scene_ir.render.kernels import shading, shadows
from scene_ir.render.prepare import VisibleSurfaces

Painter = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
"""From mesh, halo, lookup, unseen, codes, table and nearest to repainted mesh and halo."""


@dataclass(frozen=True, slots=True)
class ShadingInputs:
    """Constant inputs of `PhotographedPixels`."""

    fixed: FixedGeometry
    """Geometry that no parameter affects."""
    visible: VisibleSurfaces
    """Visible surfaces of the perturbation."""
    painter: Painter | None
    """Differentiable change of the premultiplied RGBA (T, 4) of mesh and halo, given these, the lookups (T,
    channels.LOOKUP), the unseen share (T,) and the codes; or None.
    """


def _pixel_to_patch(s: ShadingInputs) -> Tensor:
    assert s.visible.geometry.pixel_to_patch is not None
    return s.visible.geometry.pixel_to_patch.detach()


class _ObjectRanges:
    """Objects [start, end) as ranges of packed pixels, which one thread draws from the first stage to the last."""

    def __init__(self, s: ShadingInputs) -> None:
        self.pixels = s.visible.mesh.layout.host_offsets
        self.ground = s.visible.patch_layout.host_offsets
        count = len(self.pixels) - 1
        work = (2 * np.diff(self.pixels) + np.diff(self.ground)).tolist()
        # A GPU and a painter process all objects at once.
        whole = s.fixed.faces.device.type != "cpu" or s.painter is not None
        self.edges = [0, count] if whole else split_by_work(list(range(count + 1)), work)


def _nonzero(values: Tensor) -> Tensor:
    """Indices of values (K,) other than 0; on a GPU followed by -1 up to (K,): nothing waits for their number."""
    if not values.is_cuda:
        return values.nonzero()[:, 0]
    return torch.nonzero_static(values, size=len(values))[:, 0]


@dataclass(slots=True)
class _ForwardState:
    """What the forward pass leaves to the backward pass.

    turn (N, 2): cosine and sine of the yaws; painted: leaves and results of the painter; unseen_pixels, partial:
    of each range, the completed pixels and those that `shading.is_partly_covered`.
    """

    parts: _ObjectRanges
    pixels: Any
    vertices: Any
    photograph: Any
    lookups: Any
    shadow_inputs: list[Any]
    turn: Tensor
    unseen_pixels: dict[int, Tensor]
    partial: dict[int, Tensor]
    painted: tuple[tuple[Tensor, ...], tuple[Tensor, Tensor]] | None = None


class PhotographedPixels(torch.autograd.Function):
    """All pixels of photographed objects and of their shadows."""

    @staticmethod
    def forward(ctx: Any, clip, facing, brighter, coverage, yaw, then, code, sun, s: ShadingInputs):
        """Draw the objects; differentiable to all tensors, to `code` through the painter.

        Args:
            clip: (V, 3).
            facing: (V,) cosine towards the camera.
            brighter: (V,) brightening.
            coverage: (T,).
            yaw: (N,) rad.
            then: (N, 3, 3) float64, see `shadows.ShadowArrays`.
            code: (N, 5), or (0,) without painter.
            sun: (N, 4) direction and strength.
            s: Constant inputs.

        Returns:
            Premultiplied RGB and opacity / depth (T, 4), opacity (T,), depth (T,) m, inf where empty, and shadow
            factors (Ts, 3).
        """
        size, device, fixed, visible = coverage.shape[0], clip.device, s.fixed, s.visible
        clip, facing, brighter, coverage, then, sun = (
            t.detach().contiguous() for t in (clip, facing, brighter, coverage, then, sun)
        )
        parts, final = _ObjectRanges(s), s.painter is None
        layouts = visible.mesh.layout, visible.patch_layout
        table, ground_table = (torch.empty(o.size, 4, dtype=torch.int32, device=device) for o in layouts)
        nearest = torch.empty(size, dtype=torch.int64, device=device)
        turn = torch.stack([torch.cos(yaw), torch.sin(yaw)], dim=1).detach()
        new = clip.new_empty
        mesh, halo, lookup, unseen = new(size, 4), new(size, 4), new(size, channels.LOOKUP), new(size)
        colour, opacity, depth, shadow = new(size, 4), new(size), new(size), new(layouts[1].size, 3)
        pixels = make_struct(shading.PackedPixels, table, layouts[0].rects, visible.mesh.face, coverage, nearest)
        templates = fixed.base_clip, fixed.base_attributes, fixed.template
        vertices = make_struct(shading.Vertices, fixed.faces, fixed.neighbours, clip, facing, brighter, *templates)
        photograph = make_struct(shading.PhotographData, *fixed.texels, fixed.frame_wh, turn, sun, fixed.unproject)
        lookups = make_struct(shading.Lookups, torch.empty_like(lookup), lookup, mesh, halo, unseen)
        layers = make_struct(shading.MergedLayers, colour, opacity, depth)
        patches = make_struct(shadows.ShadowArrays, _pixel_to_patch(s), then, *fixed.darkness, fixed.frame_wh)
        shadow_inputs = [array(ground_table, wp.vec4i), patches]
        tables = [
            [array(layout.rects), array(layout.offsets), array(out, wp.vec4i)]
            for layout, out in zip(layouts, (table, ground_table), strict=True)
        ]
        darkened = array(shadow, wp.vec3f)
        unseen_pixels: dict[int, Tensor] = {}
        partial: dict[int, Tensor] = {}

        def work(start: int, end: int) -> None:
            first, last = parts.pixels[start], parts.pixels[end]
            for inputs in tables:
                launch(shading.table_kernel, [start, end], inputs, device)
            ground = [parts.ground[start], parts.ground[end]]
            launch(shadows.shadow_kernel, ground, [*shadow_inputs, darkened], device)
            if last == first:
                return
            surfaces.nearest_hits(visible.mesh, visible.reach_px, range(start, end), nearest)
            launch(shading.lookup_kernel, [first, last], [pixels, vertices, lookups], device)
            # Partly covered pixels: of what is hit, at least half is covered.
            partial[start] = rim = _nonzero(coverage[first:last].frac()).add_(first)
            launch(shading.save_kernel, [0, rim.shape[0]], [array(rim), lookups], device)
            launch(shading.extend_kernel, [0, rim.shape[0]], [array(rim), pixels, lookups], device)
            launch(shading.shade_kernel, [first, last], [pixels, photograph, lookups, final, layers], device)
            unseen_pixels[start] = need = _nonzero(unseen[first:last]).add_(first)
            if need.numel():
                inputs = [array(need), pixels, vertices, photograph, lookups, final, layers]
                launch(shading.complete_kernel, [0, need.shape[0]], inputs, device)

        for kernel in (shading.lookup_kernel, shadows.shadow_kernel):
            load_kernel(kernel)
        run_in_threads(work, parts.edges)
        state = _ForwardState(
            parts, pixels, vertices, photograph, lookups, shadow_inputs, turn, unseen_pixels, partial
        )
        if s.painter is not None:
            with torch.enable_grad():
                leaves = tuple(t.detach().requires_grad_() for t in (mesh, halo, lookup, unseen, code))
                state.painted = leaves, s.painter(*leaves, table, nearest)
            for name, painted in zip(("mesh", "halo"), state.painted[1], strict=True):
                lookups.set_array(name, painted.detach().contiguous())
            launch(shading.combine_kernel, split_range(size), [pixels, lookups, layers], device)
        ctx.setting, ctx.state = s, state
        ctx.mark_non_differentiable(depth)
        return colour, opacity, depth, shadow

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_colour: Tensor, grad_opacity: Tensor, _: Tensor, grad_shadow: Tensor):
        """Gradients in the order of `forward`.

        Args:
            grad_colour, grad_opacity, grad_shadow: Gradients to its results.
            others: Gradient to the depth, which is ignored.
        """
        s: ShadingInputs = ctx.setting
        state: _ForwardState = ctx.state
        parts, pixels, vertices = state.parts, state.pixels, state.vertices
        photograph, lookups = state.photograph, state.lookups
        grad_colour, grad_opacity = grad_colour.contiguous(), grad_opacity.contiguous()
        size, count, device = grad_opacity.shape[0], s.fixed.base_clip.shape[0], grad_colour.device
        new, zeros = grad_colour.new_empty, grad_colour.new_zeros
        grad_lookup, grad_moved = new(size, channels.LOOKUP), new(size, channels.LOOKUP)
        grad_mesh, grad_halo, grad_unseen, grad_coverage = new(size, 4), new(size, 4), new(size), new(size)
        grad_facing, grad_brighter = zeros(count), zeros(count)
        grad_clip = zeros(count, 3, dtype=torch.float64)
        grad_then = torch.zeros_like(_pixel_to_patch(s))
        grad_turn = torch.zeros_like(state.turn, dtype=torch.float64)
        grad_sun = torch.zeros(len(state.turn), 4, dtype=torch.float64, device=device)
        # The depth has no gradient.
        to_layers = make_struct(shading.MergedLayers, grad_colour, grad_opacity, grad_opacity)
        grads = make_struct(
            *(shading.PixelGradients, grad_lookup, grad_moved, grad_mesh, grad_halo, grad_unseen, grad_coverage),
            *(grad_clip, grad_facing, grad_brighter, grad_turn, grad_sun),
        )
        shadowed = [*state.shadow_inputs, array(grad_shadow.contiguous(), wp.vec3f), array(grad_then, wp.mat33d)]

        final = state.painted is None

        def work(start: int, end: int) -> None:
            first, last = parts.pixels[start], parts.pixels[end]
            ranges = [parts.ground[start], parts.ground[end]]
            launch(shadows.shadow_backward_kernel, ranges, shadowed, device)
            if last == first:
                return
            grad_coverage[first:last].zero_()
            if final:
                grad_lookup[first:last].zero_()
                grad_unseen[first:last].zero_()
            need = state.unseen_pixels[start]
            if need.numel():
                inputs = [array(need), pixels, vertices, photograph, lookups, final, to_layers, grads]
                launch(shading.complete_backward_kernel, [0, need.shape[0]], inputs, device)
            inputs = [pixels, photograph, lookups, final, to_layers, grads]
            launch(shading.shade_backward_kernel, [first, last], inputs, device)
            rim = state.partial[start]
            launch(shading.move_gradients_kernel, [0, rim.shape[0]], [array(rim), grads], device)
            launch(shading.extend_backward_kernel, [0, rim.shape[0]], [array(rim), pixels, lookups, grads], device)
            launch(shading.lookup_backward_kernel, [first, last], [pixels, vertices, lookups, grads], device)

        grad_code = None
        if state.painted is not None:
            inputs = [pixels, lookups, to_layers, grads]
            launch(shading.combine_backward_kernel, split_range(size), inputs, device)
            leaves, painted = state.painted
            grad_mesh, grad_halo, more, to_unseen, grad_code = torch.autograd.grad(
                painted, leaves, (grad_mesh, grad_halo), allow_unused=True
            )
            grad_unseen.copy_(torch.zeros_like(grad_unseen) if to_unseen is None else to_unseen)
            grad_mesh, grad_halo = grad_mesh.contiguous(), grad_halo.contiguous()
            grads.set_array("mesh", grad_mesh)
            grads.set_array("halo", grad_halo)
            grad_lookup.copy_(more)
        run_in_threads(work, parts.edges)
        turn = state.turn
        grad_yaw = (grad_turn[:, 1] * turn[:, 0] - grad_turn[:, 0] * turn[:, 1]).to(turn.dtype)
        to_place = grad_clip.to(grad_colour.dtype), grad_facing, grad_brighter
        return *to_place, grad_coverage, grad_yaw, grad_then, grad_code, grad_sun.to(grad_colour.dtype), None
