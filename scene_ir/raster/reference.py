"""The four verbs in plain torch, the definition of the correct result; any floating dtype, geometry in float64.

A triangle with clip-space vertices c0, c1, c2 (rows (u w, v w, w)) meets the ray of pixel p = (x, y, 1) at w p =
sum b_i c_i. Its edge functions are e_i = p . (c_j x c_k) for (i, j, k) cyclic; b_i = e_i / sum e and w = det / sum
e with det = c0 . (c1 x c2), so p is inside where no e_i differs in sign from det (Olano and Greer 1997). This also
holds for vertices behind the camera: no hit is decided by dividing by a vertex's w. Since c_j x c_k = -(c_k x c_j)
in floating point too, two triangles agree about their common edge.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from scene_ir.raster.layout import Fragments, PixelLayout

PAIRS_PER_CHUNK = 1 << 21
"""Triangle-pixel pairs processed together; bounds the memory to a few hundred MB."""
DEGENERATE = 1e-15
"""A triangle is edge-on where |det| is at most this times the product of its vertices' 1-norms (rounding)."""
SLACK_PX = 1e-3
"""Margin of pixel bounds against the rounding of u = (u w) / w; the edge functions decide what is hit."""
SNAP_PX = 1e-9
"""An outline this close to a pixel centre is tested against the pairs on both sides."""


def rasterize(
    clip: Tensor, faces: Tensor, face_ranges: Tensor, layout: PixelLayout, near: float, cull: Tensor | None
) -> tuple[Tensor, Tensor, None]:
    """Implement `verbs.rasterize`.

    Args:
        clip, faces, face_ranges, layout, near, cull: See `verbs.rasterize`.

    Returns:
        Faces (T,) int32, depths (T,), and no plan.
    """
    size, none = layout.size, faces.shape[0]
    depth = clip.new_full((size,), torch.inf)
    face = torch.full((size,), none, dtype=torch.int64, device=clip.device)
    for jobs in _split_chunks(
        _TriangleJobs.from_mesh(clip, faces, face_ranges, layout, near, cull), lines_along=None
    ):
        bounds = jobs.bounds
        width = (bounds[:, 2] - bounds[:, 0]).clamp(min=0)
        job, within = _expand_counts(width * (bounds[:, 3] - bounds[:, 1]).clamp(min=0))
        x = bounds[job, 0] + within % width[job]
        y = bounds[job, 1] + within // width[job]
        normal, sign = jobs.normal[job], jobs.sign[job, None]  # (P, 3, 3), (P, 1)
        edge = _edge_values(normal, x, y) * sign  # (P, 3)
        # A pixel on an edge belongs to one of its two triangles, which have opposite normals there.
        facing = normal * sign[..., None]
        first = torch.where(facing[..., 0] != 0, facing[..., 0], facing[..., 1])
        first = torch.where(first != 0, first, facing[..., 2])
        inside = ((edge > 0) | ((edge == 0) & (first > 0))).all(dim=1)
        w = (jobs.det[job] * sign[:, 0]) / edge.sum(dim=1)
        hit = inside & (w >= near) & (w < torch.inf)
        pixel, w, owner = jobs.pixel(job, x, y)[hit], w[hit].to(clip.dtype), jobs.face[job][hit]
        nearest = depth.scatter_reduce(0, pixel, w, "amin")
        face = torch.where(nearest < depth, none, face)
        tied = w == nearest[pixel]
        face = face.scatter_reduce(0, pixel[tied], owner[tied], "amin")
        depth = nearest
    return torch.where(face == none, -1, face).to(torch.int32), depth, None


def interpolate(fragments: Fragments, clip: Tensor, faces: Tensor, attributes: Tensor) -> Tensor:
    """Implement `verbs.interpolate`.

    Args:
        fragments, clip, faces, attributes: See `verbs.interpolate`.
    """
    out = attributes.new_zeros(fragments.face.shape[0], attributes.shape[1])
    hit = (fragments.face >= 0).nonzero()[:, 0]
    corners = faces.to(torch.int64)[fragments.face[hit].to(torch.int64)]  # (P, 3)
    x, y = fragments.layout.pixel_xy()[hit].unbind(-1)
    edge = _edge_values(_edge_normals(clip.to(torch.float64)[corners]), x, y)
    weight = edge / edge.sum(dim=1, keepdim=True)  # (P, 3)
    values = (weight[..., None] * attributes.to(torch.float64)[corners]).sum(dim=1)
    return out.index_put((hit,), values.to(attributes.dtype))


def texture(image: Tensor, uv: Tensor, clamp: bool) -> Tensor:
    """Implement `verbs.texture`.

    Args:
        image, uv: See `verbs.texture`.
        clamp: Whether edge pixels repeat beyond the image.
    """
    height, width = image.shape[1:]
    rect = torch.tensor([[0, 0, width, height]], device=uv.device).expand(uv.shape[0], 4)
    return _sample_crops(image.flatten(1).T, rect, torch.zeros_like(rect[:, 0]), uv, clamp)


def texture_packed(values: Tensor, crops: PixelLayout, layout: PixelLayout, uv: Tensor, clamp: bool) -> Tensor:
    """Implement `verbs.texture_packed`.

    Args:
        values, layout, uv: See `verbs.texture_packed`.
        crops: Positions of the crops.
        clamp: Whether edge pixels repeat beyond a crop.
    """
    draw = layout.draw_index()
    filled = (crops.offsets.diff() > 0)[draw].nonzero()[:, 0]
    draw = draw[filled]
    sampled = _sample_crops(values, crops.rects[draw], crops.offsets[draw], uv[filled], clamp)
    return values.new_zeros(uv.shape[0], values.shape[1]).index_put((filled,), sampled)


def antialias(fragments: Fragments, clip: Tensor, faces: Tensor) -> Tensor:
    """Implement `verbs.antialias`.

    Args:
        fragments, clip, faces: See `verbs.antialias`.
    """
    layout, size = fragments.layout, fragments.face.shape[0]
    hit = fragments.face >= 0
    pixel = torch.arange(size, device=clip.device)
    xy = layout.pixel_xy()
    rect = layout.rects[layout.draw_index()]
    change = []  # (T,) each: how much a pixel loses or gains towards one of its four neighbours
    for axis, step in ((0, torch.ones_like(pixel)), (1, rect[:, 2] - rect[:, 0])):
        start = pixel[xy[:, axis] + 1 < rect[:, 2 + axis]]
        end = start + step[start]
        changes = hit[start] != hit[end]
        start, end = start[changes], end[changes]
        edge = _outline_edges(fragments, clip, faces, axis, start, end)  # (P,) face * 3 + edge, -1 where none
        start, end, edge = start[edge >= 0], end[edge >= 0], edge[edge >= 0]
        inner, outer = torch.where(hit[start], start, end), torch.where(hit[start], end, start)
        corners = faces.to(torch.int64)[edge // 3]
        a = corners.gather(1, ((edge + 1) % 3)[:, None])[:, 0]  # edge i lies opposite to corner i
        b = corners.gather(1, ((edge + 2) % 3)[:, None])[:, 0]
        points = clip.to(torch.float64)
        normal = _cross(points[a], points[b])
        e_inner, e_outer = (_edge_values(normal[:, None], *xy[p].unbind(-1))[:, 0] for p in (inner, outer))
        t = e_inner / (e_inner - e_outer)
        zero = torch.zeros(size, dtype=torch.float64, device=clip.device)
        changed, amount = torch.where(t < 0.5, inner, outer), torch.where(t < 0.5, 0.5 - t, t - 0.5)
        for side in (changed == start, changed == end):
            change.append(zero.index_put((changed[side],), amount[side]))
    largest, _ = first_largest(torch.stack(change))
    return torch.where(hit, 1 - largest, largest).to(clip.dtype)


def _outline_edges(
    fragments: Fragments, clip: Tensor, faces: Tensor, axis: int, start: Tensor, end: Tensor
) -> Tensor:
    """The edge that makes the outline between packed pixels `start` and `end`, neighbours along `axis` of which
    one is hit: face * 3 + edge (P,), -1 where there is none.

    Each triangle is cut with the pixel rows (axis 0) or columns (axis 1) and covers an interval of such a line. As
    no triangle covers the empty pixel, the interval that reaches farthest towards it ends at the outline.
    """
    layout = fragments.layout
    slot = torch.full((fragments.face.shape[0],), -1, dtype=torch.int64, device=clip.device)
    slot[start] = torch.arange(start.shape[0], device=clip.device)
    best_t = torch.full((start.shape[0],), -1.0, dtype=torch.float32, device=clip.device)
    best_edge = torch.full((start.shape[0],), -1, dtype=torch.int64, device=clip.device)
    ranges, near, cull = fragments.face_ranges, fragments.near, fragments.cull
    jobs_all = _TriangleJobs.from_mesh(clip.detach(), faces, ranges, layout, near, cull)
    hit = fragments.face >= 0
    for jobs in _split_chunks(jobs_all, lines_along=1 - axis):
        lines = (jobs.bounds[:, 3 - axis] - jobs.bounds[:, 1 - axis]).clamp(min=0)
        job, within = _expand_counts(lines)
        line = jobs.bounds[job, 1 - axis] + within
        normal = jobs.normal[job] * jobs.sign[job, None, None]
        slope = normal[..., axis]  # the edge function along the line is slope * s + base
        base = normal[..., 1 - axis] * line[:, None] + normal[..., 2]
        # w >= near is sum e <= |det| / near: a fourth side, which is never an outline.
        slope = torch.cat([slope, -slope.sum(dim=1, keepdim=True)], dim=1)
        beyond = jobs.det[job].abs() / fragments.near - base.sum(dim=1)
        base = torch.cat([base, beyond[:, None]], dim=1)
        cut = -base / slope
        low, low_edge = first_largest(torch.where(slope > 0, cut, -torch.inf).T)
        high, high_edge = first_largest(torch.where(slope < 0, -cut, -torch.inf).T)
        high = -high
        covers = (low <= high) & ~((slope == 0) & (base < 0)).any(dim=1)
        rect = jobs.rect[job]
        for value, edge, upper in ((low, low_edge, False), (high, high_edge, True)):
            usable = covers & (edge < 3) & (value > rect[:, axis] - 1) & (value < rect[:, 2 + axis])
            nearest = torch.where(usable, value, 0.0)
            below = nearest.floor()
            snaps = (nearest - nearest.round()).abs() <= SNAP_PX
            for first in (below, torch.where(snaps, nearest.round() - 1, below), nearest.round()):
                s = first.to(torch.int64)
                ok = usable & (s >= rect[:, axis]) & (s + 1 < rect[:, 2 + axis])
                xy = (s, line) if axis == 0 else (line, s)
                packed = torch.where(ok, jobs.pixel(job, *xy), 0)
                pair = slot[packed] if slot.shape[0] else packed
                ok = ok & (pair >= 0) & ((nearest - first) > -SNAP_PX) & ((nearest - first) < 1 + SNAP_PX)
                ok = ok & (hit[packed] == upper) if hit.shape[0] else ok
                t = (nearest - first) if upper else (first + 1 - nearest)
                t = t.clamp(0, 1).to(torch.float32)[ok]
                key = (jobs.face[job] * 3 + edge)[ok]
                pair = pair[ok]
                farthest = best_t.scatter_reduce(0, pair, t, "amax")
                best_edge = torch.where(farthest > best_t, -1, best_edge)
                tied = t == farthest[pair]
                best_edge = best_edge.scatter_reduce(0, pair[tied], key[tied], "amax")
                best_t = farthest
    return best_edge


@dataclass(frozen=True, slots=True)
class _TriangleJobs:
    """Triangles to draw, one entry per draw and visible face (J)."""

    face: Tensor  # (J,) index into faces
    rect: Tensor  # (J, 4) of the draw
    offset: Tensor  # (J,) first packed pixel of the draw
    bounds: Tensor  # (J, 4) px, half-open, inside rect
    normal: Tensor  # (J, 3, 3) float64, of the three edge functions
    det: Tensor  # (J,)
    sign: Tensor  # (J,) of det

    @classmethod
    def from_mesh(
        cls,
        clip: Tensor,
        faces: Tensor,
        face_ranges: Tensor,
        layout: PixelLayout,
        near: float,
        cull: Tensor | None,
    ) -> _TriangleJobs:
        draw, within = _expand_counts(face_ranges.diff(dim=1)[:, 0].clamp(min=0))
        face = face_ranges[draw, 0] + within
        corner = clip.to(torch.float64)[faces.to(torch.int64)[face]]  # (J, 3, 3)
        normal = _edge_normals(corner)
        det = (corner[:, 0, 0] * normal[:, 0, 0] + corner[:, 0, 1] * normal[:, 0, 1]) + (
            corner[:, 0, 2] * normal[:, 0, 2]
        )
        seen = det.abs() > DEGENERATE * corner.abs().sum(dim=2).prod(dim=1)
        seen &= (corner[..., 2] >= near).any(dim=1)
        if cull is not None:
            seen &= (det < 0) | ~cull[draw]
        rect = layout.rects[draw]
        jobs = (face, rect, layout.offsets[draw], _pixel_bounds(corner, rect, near), normal, det, det.sign())
        return cls(*(field[seen] for field in jobs))

    def pixel(self, job: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Packed index (P,) of image pixels x, y (P,) in the draw of each job (P,)."""
        rect = self.rect[job]
        return self.offset[job] + (y - rect[:, 1]) * (rect[:, 2] - rect[:, 0]) + (x - rect[:, 0])


def _split_chunks(jobs: _TriangleJobs, lines_along: int | None) -> Iterator[_TriangleJobs]:
    """The jobs in order, split where their pixels (or their lines along an axis) fill a chunk."""
    extent = (jobs.bounds[:, 2:] - jobs.bounds[:, :2]).clamp(min=0)
    work = (extent.prod(dim=1) if lines_along is None else extent[:, lines_along]).cumsum(0)
    chunk = torch.div(work, PAIRS_PER_CHUNK, rounding_mode="floor")
    _, counts = torch.unique_consecutive(chunk, return_counts=True)
    fields = (jobs.face, jobs.rect, jobs.offset, jobs.bounds, jobs.normal, jobs.det, jobs.sign)
    for parts in zip(*(field.split(counts.tolist()) for field in fields), strict=True):
        yield _TriangleJobs(*parts)


def first_largest(values: Tensor) -> tuple[Tensor, Tensor]:
    """Maximum (P,) of values (E, P) over E and its index (P,) int64; the first of equal ones on every device."""
    best, index = values[0], torch.zeros(values.shape[1], dtype=torch.int64, device=values.device)
    for i in range(1, values.shape[0]):
        further = values[i] > best
        index = torch.where(further, i, index)
        best = torch.where(further, values[i], best)
    return best, index


def _expand_counts(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Owner (P,) and position within the owner (P,) of each of the sum(counts) elements."""
    owner = torch.repeat_interleave(torch.arange(counts.shape[0], device=counts.device), counts)
    start = counts.cumsum(0) - counts
    return owner, torch.arange(owner.shape[0], device=counts.device) - start[owner]


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product (..., 3), written out so that exchanging a and b gives the exact negative."""
    return torch.stack(
        [
            a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
            a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
            a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
        ],
        dim=-1,
    )


def _edge_normals(corner: Tensor) -> Tensor:
    """Normals (..., 3, 3) of the edge functions opposite to each corner (..., 3, 3)."""
    return _cross(corner[..., [1, 2, 0], :], corner[..., [2, 0, 1], :])


def _edge_values(normal: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Edge functions (P, E) with normals (P, E, 3) at pixels x, y (P,)."""
    return (normal[..., 0] * x[:, None] + normal[..., 1] * y[:, None]) + normal[..., 2]


def _pixel_bounds(corner: Tensor, rect: Tensor, near: float) -> Tensor:
    """Pixel bounds (J, 4), half-open, inside rect (J, 4), of the part of triangles (J, 3, 3) with w >= near."""
    after = corner[:, [1, 2, 0]]
    w, w_after = corner[..., 2], after[..., 2]
    front, crosses = w >= near, (w >= near) != (w_after >= near)
    share = (near - w) / torch.where(crosses, w_after - w, 1.0)
    cut = corner + share[..., None] * (after - corner)
    points = torch.cat([corner, cut], dim=1)
    used = torch.cat([front, crosses], dim=1)[..., None]
    # A cut lies at w = near by construction; both backends divide by near, not by the rounded w.
    depth = torch.cat([w, torch.full_like(w, near)], dim=1)[..., None]
    px = points[..., :2] / torch.where(used, depth, 1.0)
    low = torch.where(used, px, torch.inf).amin(dim=1) - SLACK_PX
    high = torch.where(used, px, -torch.inf).amax(dim=1) + SLACK_PX
    first = low.ceil().maximum(rect[:, :2].to(low)).minimum(rect[:, 2:].to(low))
    last = (high.floor() + 1).minimum(rect[:, 2:].to(low)).maximum(first)
    return torch.cat([first, last], dim=1).to(torch.int64)


def _catmull_rom_weights(t: Tensor) -> Tensor:
    """Catmull-Rom weights (T, 4) of the pixels at -1, 0, 1, 2 for samples at t (T,) in [0, 1)."""
    return torch.stack(
        [
            ((-0.5 * t + 1.0) * t - 0.5) * t,
            (1.5 * t - 2.5) * t * t + 1.0,
            ((-1.5 * t + 2.0) * t + 0.5) * t,
            (0.5 * t - 0.5) * t * t,
        ],
        dim=1,
    )


def _sample_crops(texels: Tensor, rect: Tensor, offset: Tensor, uv: Tensor, clamp: bool) -> Tensor:
    """Catmull-Rom samples (T, C) at uv (T, 2) px of crops at rect (T, 4) of the frame, computed in float64; texels
    (S, C), row-major from `offset` (T,).
    """
    size = rect[:, 2:] - rect[:, :2]
    # Beyond 3 px outside, all 16 taps lie outside as well: the value no longer changes.
    local = (uv.to(torch.float64) - rect[:, :2]).maximum(torch.full_like(size, -4).double())
    local = local.minimum((size + 3).double())
    first = local.detach().floor()
    weight_x, weight_y = (_catmull_rom_weights((local - first)[:, axis]) for axis in (0, 1))
    out = torch.zeros(uv.shape[0], texels.shape[1], dtype=torch.float64, device=uv.device)
    for row in range(4):
        for column in range(4):
            tap = first.to(torch.int64) + torch.tensor([column - 1, row - 1], device=uv.device)
            inside = ((tap >= 0) & (tap < size)).all(dim=1)
            tap = tap.clamp(min=0).minimum(size - 1)
            value = texels[offset + tap[:, 1] * size[:, 0] + tap[:, 0]].to(torch.float64)
            if not clamp:
                value = torch.where(inside[:, None], value, 0.0)
            out = out + (weight_y[:, row] * weight_x[:, column])[:, None] * value
    return out.to(texels.dtype)
