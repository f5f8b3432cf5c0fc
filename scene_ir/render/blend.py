"""Layers blended into a picture from back to front, and the order in which to blend them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scene_ir.geometry import ground_footprint
from scene_ir.raster.layout import PixelLayout
from scene_ir.raster.verbs import Backend
from scene_ir.render.model import SATURATED
from scene_ir.types import Occluder, to_host

_OCCLUDER_WIDTH_M = 0.4
"""Width on the ground of what stands in front of vehicles: about a person's."""

LayerSpan = tuple[slice, tuple[slice, slice], tuple[int, int]]
"""Packed pixels of a layer, its rows and columns in the picture, and its (height, width) px."""


@dataclass(frozen=True, slots=True)
class BlendPlan:
    """Positions and order of the layers and shadows of one picture."""

    layout: PixelLayout
    """Crops of the layers."""
    shadow_layout: PixelLayout
    """Crops of the shadows."""
    order: tuple[int, ...]
    """Layers that are not empty, back to front."""
    shadows: tuple[int, ...]
    """Draws that have a shadow."""
    spans: tuple[LayerSpan, ...]
    """Position of each layer."""
    shadow_spans: tuple[LayerSpan, ...]
    """Position of each shadow."""

    @classmethod
    def from_layouts(cls, layout: PixelLayout, shadow_layout: PixelLayout, order: Sequence[int]) -> BlendPlan:
        """The plan for crops and an order of all layers.

        Args:
            layout: Crops of the layers.
            shadow_layout: Crops of the shadows.
            order: All layers, back to front.
        """
        spans, shadow_spans = _spans(layout), _spans(shadow_layout)
        drawn = tuple(i for i in order if min(spans[i][2]) > 0)
        shadows = tuple(i for i, span in enumerate(shadow_spans) if min(span[2]) > 0)
        return cls(layout, shadow_layout, drawn, shadows, spans, shadow_spans)

    @property
    def sizes(self) -> list[int]:
        """Packed pixels of each layer."""
        return [size[0] * size[1] for _, _, size in self.spans]


def _spans(layout: PixelLayout) -> tuple[LayerSpan, ...]:
    """Positions of the packed pixels of each draw."""
    out: list[LayerSpan] = []
    for (packed, size), (x0, y0, _, _) in zip(layout.spans(), layout.host_rects, strict=True):
        out.append((packed, (slice(y0, y0 + size[0]), slice(x0, x0 + size[1])), size))
    return tuple(out)


class _Clamp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor) -> Tensor:
        ctx.save_for_backward(image)
        return image.clamp(0.0, 1.0)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> Tensor:
        (image,) = ctx.saved_tensors
        away = (image - 0.5).abs_()
        passing = (away <= 0.5 + SATURATED).to(image).add_(away < 0.5 - SATURATED).mul_(0.5)
        return passing.mul_(grad_outputs[0])


def clamp_colour(image: Tensor) -> Tensor:
    """Colours clamped to [0, 1].

    Where one just reaches a bound, as saturated pixels of a photograph do, half of the gradient passes: the mean
    of the slopes on both sides, which a central difference measures.
    """
    return _Clamp.apply(image)


def visible_background(opacity: Tensor, plan: BlendPlan, frame_hw: tuple[int, int]) -> Tensor:
    """Share (H, W) of the background that shows between all layers; differentiable to `opacity`.

    Args:
        opacity: (T,).
        plan: Positions and order of the layers.
        frame_hw: Size of the picture, px.
    """
    shows = opacity.new_ones(frame_hw)
    for i in plan.order:
        packed, (rows, columns), size = plan.spans[i]
        # A copy: autograd needs the factors that are overwritten.
        shows[rows, columns] = shows[rows, columns].clone() * (1.0 - opacity[packed].reshape(size))
    return shows


def composite(
    canvas: Tensor,
    depth: Tensor,
    layer_data: tuple[Tensor, Tensor, Tensor, Tensor],
    plan: BlendPlan,
    clamped: bool,
    backend: Backend = "reference",
) -> tuple[Tensor, Tensor, Tensor]:
    """Multiply shadows onto the canvas, then lay the layers over it.

    Differentiable to canvas, factors, colour and opacity. Pixels outside the plan's rectangles keep their bits.

    Args:
        canvas: (C, H, W), RGB and, with C = 4, 1 / depth.
        depth: (H, W) m behind all layers.
        layer_data: Shadow factors (Ts, 3); premultiplied RGB and opacity / depth (T, 4); opacity (T,); depth (T,) m.
        plan: Positions and order.
        clamped: Whether RGB is clamped to [0, 1].
        backend: Implementation.

    Returns:
        Picture (C, H, W); depth (H, W) m; (H, W) int64, i + 1 for the front-most object i that is at least half
        opaque.
    """
    factor, colour, opacity, z = layer_data
    if backend == "warp":
        from scene_ir.render.kernels import blending

        numbers = torch.tensor([*plan.order, *plan.shadows], dtype=torch.int32)
        numbers = numbers.to(canvas.device, non_blocking=True)
        order, own = numbers.split([len(plan.order), len(plan.shadows)])
        layers = order, plan.layout.rects, plan.layout.offsets
        shadows = own, plan.shadow_layout.rects, plan.shadow_layout.offsets
        rects = np.array(plan.layout.host_rects + plan.shadow_layout.host_rects, dtype=np.int64).reshape(-1, 4)
        edges = blending.row_edges(canvas.shape[1], rects)
        return blending.BlendLayers.apply(
            canvas, factor, colour, opacity, z, depth, (shadows, layers, edges), clamped
        )
    image = _ReferenceBlend.apply(canvas, factor, colour[:, : canvas.shape[0]], opacity, plan)
    if clamped:
        image = torch.cat([clamp_colour(image[:3]), image[3:]])
    with torch.no_grad():
        nearest = depth.clone()
        number = torch.zeros(depth.shape, dtype=torch.int64, device=depth.device)
        for i in plan.order:
            packed, (rows, columns), size = plan.spans[i]
            solid = (opacity[packed] >= 0.5).reshape(size)
            number[rows, columns] = torch.where(solid, i + 1, number[rows, columns])
            nearest[rows, columns] = torch.where(solid, z[packed].reshape(size).to(depth), nearest[rows, columns])
    return image, nearest, number


def visible_rects(layout: PixelLayout, visible: Tensor) -> Tensor:
    """Rectangles (N, 4) int64 px, half-open, of the pixels of each draw where any of `visible` (T, C) is true,
    with a margin of one pixel, which the smallest change may reach; empty where there are none.
    """
    rects: list[list[int]] = []
    packed, channels = visible.cpu().numpy(), visible.shape[1]
    for (part, size), whole in zip(layout.spans(), layout.host_rects, strict=True):
        pixels = packed[part].reshape(size[0], size[1] * channels)
        columns, rows = np.flatnonzero(pixels.any(0)) // channels, np.flatnonzero(pixels.any(1))
        if not len(columns):
            rects.append([0, 0, 0, 0])
            continue
        x0, y0 = whole[0] + int(columns[0]) - 1, whole[1] + int(rows[0]) - 1
        x1, y1 = whole[0] + int(columns[-1]) + 2, whole[1] + int(rows[-1]) + 2
        rects.append([max(x0, whole[0]), max(y0, whole[1]), min(x1, whole[2]), min(y1, whole[3])])
    return torch.tensor(rects, dtype=torch.int64).reshape(-1, 4)


class _ReferenceBlend(torch.autograd.Function):
    """Works in place on one copy of the picture, where autograd would copy it for each layer."""

    @staticmethod
    def forward(
        ctx: Any, canvas: Tensor, shadow: Tensor, colour: Tensor, opacity: Tensor, plan: BlendPlan
    ) -> Tensor:
        out = canvas.clone(memory_format=torch.contiguous_format)
        under: list[Tensor] = []
        for packed, (rows, columns), size in (plan.shadow_spans[i] for i in plan.shadows):
            region = out[:3, rows, columns]
            under.append(region.clone())
            region.mul_(shadow[packed].T.reshape(3, *size))
        for packed, (rows, columns), size in (plan.spans[i] for i in plan.order):
            region = out[:, rows, columns]
            under.append(region.clone())
            clear = 1.0 - opacity[packed].reshape(1, *size)
            region.copy_(colour[packed].T.reshape(-1, *size) + clear * region)
        ctx.save_for_backward(shadow, opacity)
        ctx.under, ctx.plan, ctx.channels = under, plan, canvas.shape[0]
        return out

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, None]:
        shadow, opacity = ctx.saved_tensors
        grad = grad_outputs[0].clone(memory_format=torch.contiguous_format)
        to_shadow = torch.zeros_like(shadow)
        to_colour = opacity.new_zeros(opacity.shape[0], ctx.channels)
        to_opacity = torch.zeros_like(opacity)
        plan: BlendPlan = ctx.plan
        steps = len(plan.shadows)
        for k in range(len(plan.order) - 1, -1, -1):
            packed, (rows, columns), size = plan.spans[plan.order[k]]
            region = grad[:, rows, columns]
            to_colour[packed] = region.reshape(ctx.channels, -1).T
            to_opacity[packed] = -(region * ctx.under[steps + k]).sum(dim=0).reshape(-1)
            region.mul_(1.0 - opacity[packed].reshape(1, *size))
        for k in range(steps - 1, -1, -1):
            packed, (rows, columns), size = plan.shadow_spans[plan.shadows[k]]
            region = grad[:3, rows, columns]
            to_shadow[packed] = (region * ctx.under[k]).reshape(3, -1).T
            region.mul_(shadow[packed].T.reshape(3, *size))
        return grad, to_shadow, to_colour, to_opacity, None


def paint_order(
    size_lhw: Tensor, yaw: Tensor, translation: Tensor, centre: Tensor, standing: np.ndarray | None = None
) -> list[int]:
    """Objects from the farthest to the nearest, as a painter lays them down; not differentiated.

    Of two separate footprints, the one on the camera's side of the line between them is in front (a car next to a
    long truck may be farther by its centre and yet hide it). Where that does not decide, or in a cycle, the
    nearest point does. Occluders have numbers from N on and come right after the last object that they can hide,
    so that the objects keep their order.

    Args:
        size_lhw: (N, 3) m.
        yaw: (N,) rad.
        translation: (N, 3) m.
        centre: (3,) m, position of the camera.
        standing: (K, 4, 2) m, footprints of occluders, see `occluder_footprints`.
    """
    count = int(translation.shape[0])
    size, turn, place, camera = to_host(size_lhw, yaw, translation, centre)
    dtype, eye = yaw.dtype, camera.numpy()[[0, 2]]
    corners = ground_footprint(size.to(dtype), turn.to(dtype), place.to(dtype)).double().numpy()
    nearest = _nearest_distance(corners, eye)
    first, second = np.triu_indices(count, 1)
    side = _in_front(corners[first], corners[second], eye, nearest[second] - nearest[first])
    behind = np.zeros((count, count), dtype=bool)
    behind[first, second], behind[second, first] = side < 0, side > 0
    remaining = sorted(range(count), key=lambda i: (-nearest[i], i))
    order: list[int] = []
    while remaining:
        hidden = behind[np.ix_(remaining, remaining)].any(axis=0)
        # The first that hides none of the others; in a cycle, the first.
        chosen = remaining[int(np.argmin(hidden))]
        order.append(chosen)
        remaining.remove(chosen)
    return order if standing is None or not len(standing) else _insert_occluders(order, corners, standing, eye)


def _insert_occluders(order: list[int], corners: np.ndarray, standing: np.ndarray, eye: np.ndarray) -> list[int]:
    """The order of N objects with K occluders inserted. corners (N, 4, 2), standing (K, 4, 2), eye (2,), m."""
    count, occluder_count = len(corners), len(standing)
    first, second = np.repeat(np.arange(occluder_count), count), np.tile(np.arange(count), occluder_count)
    nearest, near = _nearest_distance(corners, eye), _nearest_distance(standing, eye)
    hides = _in_front(standing[first], corners[second], eye, nearest[second] - near[first]) > 0
    place = np.argsort(order)
    after = np.where(hides.reshape(occluder_count, count), place[None], -1).max(axis=1, initial=-1)
    slots: list[list[int]] = [[] for _ in range(count + 1)]
    for k in np.argsort(-near, kind="stable"):
        slots[int(after[k]) + 1].append(count + int(k))
    full_order = list(slots[0])
    for i, there in zip(order, slots[1:], strict=True):
        full_order += [i, *there]
    return full_order


def occluder_footprints(front: Sequence[Occluder], matrix: Tensor) -> np.ndarray:
    """Corners (K, 4, 2) m, (x, z), of small squares where occluders stand. matrix: (3, 4) of the camera."""
    inverse = np.linalg.inv(matrix[:, :3].detach().cpu().double().numpy())
    centre = -inverse @ matrix[:, 3].detach().cpu().double().numpy()
    places = []
    for occluder in front:
        height, width = occluder.foreground.values.shape[1:]
        foot = np.array([occluder.foreground.x0 + (width - 1) / 2, occluder.foreground.y0 + height - 1.0, 1.0])
        places.append((centre + inverse @ foot * occluder.depth_m)[[0, 2]])
    square = _OCCLUDER_WIDTH_M / 2 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return np.array(places).reshape(-1, 1, 2) + square


def _in_front(a: np.ndarray, b: np.ndarray, eye: np.ndarray, farther: np.ndarray) -> np.ndarray:
    """(P,): 1 where footprint a[i] (P, 4, 2) can hide b[i], -1 for the reverse, 0 for neither.

    farther: (P,) how much farther b's outline is; decides where the footprints are not separate.
    """
    axes = np.concatenate([corners[:, 1:3] - corners[:, 0:2] for corners in (a, b)], axis=1)
    axes = axes / np.maximum(np.linalg.norm(axes, axis=2, keepdims=True), 1e-9)
    pa, pb = (np.einsum("pkc,pac->pak", corners, axes) for corners in (a, b))
    eye_along = axes @ eye
    # Along each axis, then against it.
    low = np.stack([pa.max(axis=2), -pa.min(axis=2)], axis=2).reshape(len(a), 8)
    high = np.stack([pb.min(axis=2), -pb.max(axis=2)], axis=2).reshape(len(a), 8)
    where = np.stack([eye_along, -eye_along], axis=2).reshape(len(a), 8)
    gaps = high - low
    signs = np.where(where <= low, 1, np.where(where >= high, -1, 0))
    best, pair = gaps.argmax(axis=1), np.arange(len(a))
    return np.where(gaps[pair, best] > 0, signs[pair, best], np.sign(farther))


def _nearest_distance(corners: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Distance (N,) from the eye to the outlines of footprints (N, 4, 2)."""
    ends = np.roll(corners, -1, axis=1) - corners
    along = ((eye - corners) * ends).sum(-1) / np.maximum((ends**2).sum(-1), 1e-12)
    closest = corners + np.clip(along, 0, 1)[..., None] * ends
    return np.linalg.norm(closest - eye, axis=-1).min(axis=1)
