# pyright: basic, reportGeneralTypeIssues=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportIndexIssue=false, reportCallIssue=false, reportInvalidTypeForm=false, reportAssignmentType=false, reportOptionalMemberAccess=false
# ruff: noqa: E501 - the line above; Warp needs int(0) to declare what a loop changes; `wp.grad`
# returns the gradients of all arguments.
"""All pixels of photographed vehicles, and of their shadows: the stages of `shading` and `ground`, one after the other.

Shapes: N objects, V vertices, T packed pixels, Ts of the shadows' patches.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

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
from scene_ir.raster.layout import Fragments, PixelLayout
from scene_ir.render import channels, surfaces
from scene_ir.render.kernels import shading, shadows

Painter = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
"""From mesh, halo, look, fill, codes, table and nearest to mesh and halo."""


@dataclass(frozen=True, slots=True)
class ShadingInputs:
    """What `PhotographedPixels` reads and does not change. See `fast.FixedGeometry` and `prepare.Drawn` for what is not said here.

    ground: the shadows' patches, one an object; inside (N, 3, 3) float64: see `shadows.ShadowArrays`. painter: None, or what
    repaints premultiplied RGBA of mesh and halo (T, 4) each, given them, what the pixels look at (T, 9), how much of
    them was filled (T,) and the codes, differentiable. reach_px: how far each halo reaches.
    """

    fragments: Fragments
    ground: PixelLayout
    inside: Tensor
    reach_px: Sequence[float]
    faces: Tensor
    neighbours: Tensor
    base_clip: Tensor
    base: Tensor
    own: Tensor
    texels: tuple[Tensor, Tensor, Tensor]
    dark: tuple[Tensor, Tensor, Tensor]
    frame_wh: Tensor
    unproject: Tensor
    painter: Painter | None


class _ObjectRanges:
    """Objects [start, end) as ranges of packed pixels: what one thread draws from the first stage to the last."""

    def __init__(self, s: ShadingInputs, code: Tensor | None) -> None:
        self.pixels = s.fragments.layout.offsets.tolist()
        self.ground = s.ground.offsets.tolist()
        count = len(self.pixels) - 1
        work = [
            2.0 * (self.pixels[i + 1] - self.pixels[i]) + self.ground[i + 1] - self.ground[i] for i in range(count)
        ]
        # A GPU works on all at once; a painter is torch's.
        whole = s.faces.device.type != "cpu" or code is not None
        self.edges = [0, count] if whole else split_by_work(list(range(count + 1)), work)


@dataclass(slots=True)
class _ForwardState:
    """What the forward pass leaves to the backward one. turn (N, 2): cosine and sine of the yaws; painted: leaves and
    results of the painter; needs, leaning: of each part, the pixels that were completed, and those that
    `shading.is_partly_covered`."""

    parts: _ObjectRanges
    pixels: Any
    vertices: Any
    photograph: Any
    looks: Any
    shadow_inputs: list[Any]
    turn: Tensor
    needs: dict[int, Tensor]
    partial: dict[int, Tensor]
    painted: tuple[tuple[Tensor, ...], tuple[Tensor, Tensor]] | None = None


class PhotographedPixels(torch.autograd.Function):
    """All pixels of photographed objects, and of their shadows.

    clip (V, 3), facing (V,), brighter (V,), coverage (T,), yaw (N,), then (N, 3, 3) float64 (see `shadows.ShadowArrays`),
    code (N, 5) or (0,), sun (N, 4): differentiable, the code through the painter. -> premultiplied RGB and opacity / depth
    (T, 4), opacity (T,), depth (T,) m (inf where nothing is), and the factors by which the ground is darkened (Ts, 3).
    """

    @staticmethod
    def forward(ctx: Any, clip, facing, brighter, coverage, yaw, then, code, sun, s: ShadingInputs):
        size, device = coverage.shape[0], clip.device
        clip, facing, brighter, coverage = (t.detach().contiguous() for t in (clip, facing, brighter, coverage))
        parts = _ObjectRanges(s, code if s.painter is not None else None)
        table, ground_table = (
            torch.empty(layout.size, 4, dtype=torch.int32, device=device)
            for layout in (s.fragments.layout, s.ground)
        )
        nearest = torch.empty(size, dtype=torch.int64, device=device)
        turn = torch.stack([torch.cos(yaw), torch.sin(yaw)], dim=1).detach()
        found, look = clip.new_empty(size, channels.LOOK), clip.new_empty(size, channels.LOOK)
        mesh, halo, fill = clip.new_empty(size, 4), clip.new_empty(size, 4), clip.new_empty(size)
        colour, opacity, depth = clip.new_empty(size, 4), clip.new_empty(size), clip.new_empty(size)
        shadow = clip.new_empty(s.ground.size, 3)
        pixels = make_struct(
            shading.PackedPixels, table, s.fragments.layout.rects, s.fragments.face, coverage, nearest
        )
        vertices = make_struct(
            shading.MeshVertices, s.faces, s.neighbours, clip, facing, brighter, s.base_clip, s.base, s.own
        )
        photograph = make_struct(
            shading.PhotographArrays, *s.texels, s.frame_wh, turn, sun.detach().contiguous(), s.unproject
        )
        looks = make_struct(shading.LookupArrays, found, look, mesh, halo, fill)
        layers = make_struct(shading.LayerArrays, colour, opacity, depth)
        patches = make_struct(shadows.ShadowArrays, s.inside, then.detach().contiguous(), *s.dark, s.frame_wh)
        shadow_inputs = [array(ground_table, wp.vec4i), patches]
        tables = [
            [array(layout.rects), array(layout.offsets), array(out, wp.vec4i)]
            for layout, out in ((s.fragments.layout, table), (s.ground, ground_table))
        ]
        darkened = array(shadow, wp.vec3f)
        needs: dict[int, Tensor] = {}
        partial: dict[int, Tensor] = {}
        final = s.painter is None

        def work(start: int, end: int) -> None:
            first, last = parts.pixels[start], parts.pixels[end]
            for inputs in tables:
                launch(shading.table_kernel, [start, end], inputs, (), device)
            launch(
                shadows.shadow_kernel,
                [parts.ground[start], parts.ground[end]],
                [*shadow_inputs, darkened],
                (),
                device,
            )
            if last == first:
                return
            surfaces.nearest_hits(s.fragments, s.reach_px, range(start, end), nearest)
            launch(shading.lookup_kernel, [first, last], [pixels, vertices, looks], (), device)
            partial[start] = lean = _partly_covered(coverage[first:last]).add_(first)
            launch(shading.save_lookups_kernel, [0, lean.shape[0]], [array(lean), looks], (), device)
            launch(shading.extend_lookups_kernel, [0, lean.shape[0]], [array(lean), pixels, looks], (), device)
            launch(shading.shade_kernel, [first, last], [pixels, photograph, looks, final, layers], (), device)
            needs[start] = need = fill[first:last].nonzero()[:, 0] + first
            if need.numel():
                inputs = [array(need), pixels, vertices, photograph, looks, final, layers]
                launch(shading.complete_kernel, [0, need.shape[0]], inputs, (), device)

        for kernel in (shading.lookup_kernel, shadows.shadow_kernel):
            load_kernel(kernel)
        run_in_threads(work, parts.edges)
        state = _ForwardState(parts, pixels, vertices, photograph, looks, shadow_inputs, turn, needs, partial)
        if s.painter is not None:
            with torch.enable_grad():
                leaves = tuple(t.detach().requires_grad_() for t in (mesh, halo, look, fill, code))
                state.painted = leaves, s.painter(*leaves, table, nearest)
            for name, painted in zip(("mesh", "halo"), state.painted[1], strict=True):
                looks.set_array(name, painted.detach().contiguous())
            launch(shading.combine_kernel, split_range(size), [pixels, looks, layers], (), device)
        ctx.setting, ctx.state = s, state
        ctx.mark_non_differentiable(depth)
        return colour, opacity, depth, shadow

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_colour: Tensor, grad_opacity: Tensor, _: Tensor, grad_shadow: Tensor):
        s: ShadingInputs = ctx.setting
        state: _ForwardState = ctx.state
        parts, pixels, vertices, photograph, looks = (
            *(state.parts, state.pixels, state.vertices),
            *(state.photograph, state.looks),
        )
        grad_colour, grad_opacity = grad_colour.contiguous(), grad_opacity.contiguous()
        size, count, device = grad_opacity.shape[0], s.base_clip.shape[0], grad_colour.device
        new, zeros = grad_colour.new_empty, grad_colour.new_zeros
        grad_look, grad_kept = new(size, channels.LOOK), new(size, channels.LOOK)
        grad_mesh, grad_halo, grad_fill, grad_coverage = new(size, 4), new(size, 4), new(size), new(size)
        grad_facing, grad_brighter = zeros(count), zeros(count)
        grad_clip = zeros(count, 3, dtype=torch.float64)
        grad_then = torch.zeros_like(s.inside)
        grad_turn = torch.zeros_like(state.turn, dtype=torch.float64)
        grad_sun = torch.zeros(len(state.turn), 4, dtype=torch.float64, device=device)
        to_layers = make_struct(
            shading.LayerArrays, grad_colour, grad_opacity, grad_opacity
        )  # depth has no gradient
        grads = make_struct(
            *(shading.ShadingGradients, grad_look, grad_kept, grad_mesh, grad_halo, grad_fill, grad_coverage),
            *(grad_clip, grad_facing, grad_brighter, grad_turn, grad_sun),
        )
        shadowed = [*state.shadow_inputs, array(grad_shadow.contiguous(), wp.vec3f), array(grad_then, wp.mat33d)]

        final = state.painted is None

        def work(start: int, end: int) -> None:
            first, last = parts.pixels[start], parts.pixels[end]
            ranges = [parts.ground[start], parts.ground[end]]
            launch(shadows.shadow_backward_kernel, ranges, shadowed, (), device)
            if last == first:
                return
            grad_coverage[first:last].zero_()
            if final:
                grad_look[first:last].zero_()
                grad_fill[first:last].zero_()
            need = state.needs[start]
            if need.numel():
                inputs = [array(need), pixels, vertices, photograph, looks, final, to_layers, grads]
                launch(shading.complete_backward_kernel, [0, need.shape[0]], inputs, (), device)
            inputs = [pixels, photograph, looks, final, to_layers, grads]
            launch(shading.shade_backward_kernel, [first, last], inputs, (), device)
            lean = state.partial[start]
            launch(shading.move_gradients_kernel, [0, lean.shape[0]], [array(lean), grads], (), device)
            launch(
                shading.extend_lookups_backward_kernel,
                [0, lean.shape[0]],
                [array(lean), pixels, looks, grads],
                (),
                device,
            )
            launch(shading.lookup_backward_kernel, [first, last], [pixels, vertices, looks, grads], (), device)

        grad_code = None
        if state.painted is not None:
            launch(
                shading.combine_backward_kernel, split_range(size), [pixels, looks, to_layers, grads], (), device
            )
            leaves, painted = state.painted
            grad_mesh, grad_halo, more, to_fill, grad_code = torch.autograd.grad(
                painted, leaves, (grad_mesh, grad_halo), allow_unused=True
            )
            grad_fill.copy_(torch.zeros_like(grad_fill) if to_fill is None else to_fill)
            grad_mesh, grad_halo = grad_mesh.contiguous(), grad_halo.contiguous()
            grads.set_array("mesh", grad_mesh)
            grads.set_array("halo", grad_halo)
            grad_look.copy_(more)
        run_in_threads(work, parts.edges)
        turn = state.turn
        grad_yaw = (grad_turn[:, 1] * turn[:, 0] - grad_turn[:, 0] * turn[:, 1]).to(turn.dtype)
        to_place = grad_clip.to(grad_colour.dtype), grad_facing, grad_brighter
        return *to_place, grad_coverage, grad_yaw, grad_then, grad_code, grad_sun.to(grad_colour.dtype), None


def _partly_covered(coverage: Tensor) -> Tensor:
    """Which pixels `shading.is_partly_covered`: of what is hit, at least half is covered."""
    return coverage.frac().nonzero()[:, 0]
