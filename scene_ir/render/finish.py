"""Finish of a vehicle: the photograph's colours relative to the template's, extended to what was never seen.

Where a template stands for unseen surface, its colours in daylight are multiplied by a *gain* per vertex:
photograph over template, as seen nearby on the same part, fading into the part's mean. So the template continues
the photograph in the vehicle's own paint, glass and rubber, and in the photograph's light.

Shapes: K samples, pixels that show the surface; V vertices of one object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import scipy.spatial
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_ir.render import texture
from scene_ir.render.surfaces import TemplateSurface
from scene_ir.types import Part

Array = NDArray[np.float64]

_MIN_GAIN = 0.03
"""Of any part, at night."""
_MAX_GAIN = (3.0, 1.4)
"""Of paint, with a colour of its own, and of the rest, where the template knows the colour but not the light."""
_DARK_SHARE = 0.05
"""Share of a vehicle as dark as its darkest parts: tyres, grilles and gaps are on all sides."""
_MAX_LIFT = 0.25
_STRENGTHS = np.linspace(0.0, 2.4, 13)
"""Candidate strengths of the sun; at the largest, a side that faces it gets six times the light of one that does
not.
"""
_PAINT_SAMPLES, _PAINT_SCATTER, _STRENGTH_SCATTER = 10.0, 0.25, 0.3
"""Independent samples that a car's paint is worth, their scatter about one colour (logarithm), and the scatter of
the expected strength.
"""
_EXPECTED_STRENGTH, _PRIOR_WEIGHT = 0.3, 0.02
"""Prior strength, between an overcast sky's and a clear one's; weight of the prior."""
_MIN_EXPOSURE_PX = 50
"""Least pixels that determine the exposure of a frame."""
_HALF_EVIDENCE_PX, _MAX_COST = 200.0, 20.0
"""Paint samples at which a vehicle counts half; largest cost of one vehicle's disagreement."""
_DARKEST, _BRIGHTEST = 0.02, 0.97
"""Display values beyond which the ratio of template and photograph is meaningless."""
_PRIOR_PULL = 0.02
"""Pull of a part's mean, relative to a bond of 1 between neighbours: noticeable from about seven vertices on."""
_MAX_VERTEX_SAMPLES = 4.0
"""Samples of a vertex beyond which more add no weight: large panels would not bend at all."""
_TWIN_BOND = 0.3
"""Bond of a vertex to its twin on the other side: cars are symmetric, their light is not."""
_MIN_SAMPLES = 4.0
"""Samples below which a part's mean comes from everything except paint, and the paint's from the whole car."""


@dataclass(frozen=True, slots=True)
class FinishSamples:
    """Samples of one object's photographed surface."""

    vertex: NDArray[np.int64]
    """(K, 3) int64, corners of the triangle at each pixel."""
    share: Array
    """(K, 3) weights of the corners."""
    template: Array
    """(K, 3) RGB of the template in daylight."""
    photograph: Array
    """(K, 3) RGB."""
    sky: Array
    """(K,) light without sun, see `texture.daylight`."""
    direct: Array
    """(K,) light that a sun of strength 1 adds."""
    weight: Array
    """(K,) in [0, 1]."""


@dataclass(frozen=True, slots=True)
class _VertexGraph:
    """A surface's vertices as nodes, one per place and part. node (V,); part (M,); bonds: their Laplacian."""

    node: NDArray[np.int64]
    part: NDArray[np.int64]
    bonds: scipy.sparse.csc_array


def estimate_paint(surface: TemplateSurface, samples: FinishSamples) -> Tensor | None:
    """Most common photographed paint (3,) RGB: the median in CIE L*a*b*; None where no paint is visible."""
    part = surface.part.cpu().numpy()
    clear = (part[samples.vertex] == Part.PAINT).all(axis=1) & (samples.weight > 0.5)
    if np.count_nonzero(clear) < _MIN_SAMPLES:
        return None
    rgb_to_lab = texture.rgb_to_lab(torch.from_numpy(samples.photograph[clear]))
    return texture.lab_to_rgb(rgb_to_lab.median(dim=0).values[None])[0].clamp(0.0, 1.0)


def estimate_sunlight(
    seen: Sequence[tuple[TemplateSurface, FinishSamples]], expected: Sequence[float | None]
) -> float:
    """Strength of the sun on a frame's vehicles, as `texture.shade_template` counts it.

    The strength at which the sides of a vehicle that face the sun and the others have one colour, for most
    vehicles, close to the expected strength. A vehicle counts by its visible paint, and one that disagrees with
    the rest, in the shade of a tree, by at most `_MAX_COST`.

    Args:
        seen: Surfaces and samples of the vehicles.
        expected: Strength by each vehicle's shadow; None without one.
    """
    cost = _PRIOR_WEIGHT * np.square((_STRENGTHS - _EXPECTED_STRENGTH) / _STRENGTH_SCATTER)
    for (surface, samples), strength in zip(seen, expected, strict=True):
        clear = (surface.part.cpu().numpy()[samples.vertex] == Part.PAINT).all(axis=1)
        weight = samples.weight * clear
        vehicle_cost = np.zeros_like(cost)
        if weight.sum() >= _MIN_SAMPLES:
            level = np.log(display_to_light(samples.photograph.mean(axis=1)))
            rest = level - np.log(samples.sky + _STRENGTHS[:, None] * samples.direct)
            mean = (rest * weight).sum(axis=1, keepdims=True) / weight.sum()
            apart = (np.square(rest - mean) * weight).sum(axis=1) / weight.sum()
            vehicle_cost += _PAINT_SAMPLES * apart / _PAINT_SCATTER**2
        if strength is not None:
            vehicle_cost += np.square((_STRENGTHS - np.clip(strength, 0.0, _STRENGTHS[-1])) / _STRENGTH_SCATTER)
        evidence = (weight.sum() + _MIN_SAMPLES) / (weight.sum() + _HALF_EVIDENCE_PX)
        cost = cost + evidence * np.minimum(vehicle_cost - vehicle_cost.min(), _MAX_COST)
    return float(_STRENGTHS[int(cost.argmin())])


def estimate_exposure(surface: TemplateSurface, samples: FinishSamples) -> tuple[float, float] | None:
    """Gain and lift of `texture.apply_finish` for another vehicle in the same light: the median over everything
    except paint; None where too little is visible.
    """
    known = (surface.part.cpu().numpy()[samples.vertex[:, 0]] != Part.PAINT) & (samples.weight > 0.5)
    if np.count_nonzero(known) < _MIN_EXPOSURE_PX:
        return None
    lift = _estimate_lift(surface, samples)
    bright = display_to_light((samples.photograph[known].mean(axis=1) - lift).clip(0.0) / (1.0 - lift))
    gain = np.median(bright / np.maximum(samples.template[known].mean(axis=1), _DARKEST))
    return float(np.clip(gain, _MIN_GAIN, _MAX_GAIN[1])), lift


def fit_finish(surface: TemplateSurface, samples: FinishSamples) -> Array:
    """Gains (3) and lift of `texture.apply_finish` for each vertex, (V, 4).

    The lift is the brightness of the vehicle's darkest parts, by haze and mirrored light; paint has none.
    """
    web = _build_graph(surface.weld, surface.faces, surface.part, surface.unit)
    count = len(web.part)
    lift = np.where(web.part == Part.PAINT, 0.0, _estimate_lift(surface, samples))
    less = 1.0 - lift[web.node[samples.vertex[:, :1]]]
    ratio = np.log(
        display_to_light(1.0 - (1.0 - samples.photograph) / less) / np.maximum(samples.template, _DARKEST)
    )
    node = web.node[samples.vertex].reshape(-1)
    share = (samples.weight[:, None] * samples.share).reshape(-1)
    total = _sum_at_nodes(node, share, count)
    mean = np.stack([_sum_at_nodes(node, share * ratio[:, c].repeat(3), count) for c in range(3)], axis=1)
    mean /= np.maximum(total, 1e-9)[:, None]
    most = np.log(np.where(web.part == Part.PAINT, *_MAX_GAIN))[:, None]
    mean = np.clip(mean, np.log(_MIN_GAIN), most)
    data = np.minimum(total, _MAX_VERTEX_SAMPLES)
    matrix = web.bonds + scipy.sparse.diags_array(data + _PRIOR_PULL)
    known = data[:, None] * mean + _PRIOR_PULL * _prior_gains(web.part, total, mean)
    # Symmetric and diagonally dominant: no pivoting, and an ordering with little fill-in.
    solver = scipy.sparse.linalg.splu(
        matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    gains = np.exp(solver.solve(known))[web.node]
    return np.concatenate([gains, lift[web.node, None]], axis=1)


def _sum_at_nodes(node: NDArray[np.int64], values: Array, count: int) -> Array:
    """Sum of values (L,) at each of `count` nodes (L,)."""
    return np.bincount(node, values, count).astype(np.float64)


def display_to_light(display: Array) -> Array:
    """Light that `texture.apply_finish` shows as these display values."""
    return -np.log(1.0 - np.clip(display, _DARKEST / 2, _BRIGHTEST))


def _estimate_lift(surface: TemplateSurface, samples: FinishSamples) -> float:
    """Brightness of the vehicle's darkest parts, paint excluded, above its template's darkest."""
    part = surface.part.cpu().numpy()[samples.vertex[:, 0]]
    clear = (samples.weight > 0.5) & (part != Part.PAINT)
    if np.count_nonzero(clear) < _MIN_SAMPLES:
        return 0.0
    dark, template_dark = (
        np.quantile(v[clear].mean(axis=1), _DARK_SHARE) for v in (samples.photograph, samples.template)
    )
    return float(np.clip((dark - template_dark) / (1.0 - template_dark), 0.0, _MAX_LIFT))


def _prior_gains(part: NDArray[np.int64], total: Array, mean: Array) -> Array:
    """Logarithm (M, 3) of the median gain of each node's part; of other parts where it is unseen."""
    out = np.zeros((len(part), 3))
    rest = _weighted_median(mean, total * (part != Part.PAINT))
    for kind in np.unique(part):
        is_part = part == kind
        part_weight = total * is_part
        if part_weight.sum() >= _MIN_SAMPLES:
            out[is_part] = _weighted_median(mean, part_weight)
        elif kind == Part.PAINT:
            out[is_part] = _weighted_median(mean, total)
        else:
            # No colour of its own: as dark or bright as the rest.
            out[is_part] = rest.mean()
    return out


def _weighted_median(values: Array, weight: Array) -> Array:
    """Weighted median (3,) of values (M, 3); 0 without weight."""
    if weight.sum() < _MIN_SAMPLES:
        return np.zeros(3)
    order = np.argsort(values, axis=0, kind="stable")
    running = np.cumsum(weight[order], axis=0)
    place = (running < 0.5 * weight.sum()).sum(axis=0)
    return np.take_along_axis(values, order, axis=0)[np.minimum(place, len(values) - 1), np.arange(3)]


@lru_cache(maxsize=128)
def _build_graph(weld: Tensor, faces: Tensor, part: Tensor, unit: Tensor) -> _VertexGraph:
    welded, kinds = weld.cpu().numpy(), part.cpu().numpy()
    key, first, node = np.unique(welded * len(Part) + kinds, return_index=True, return_inverse=True)
    count = len(key)
    corners = node[faces.cpu().numpy()]
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    edges = np.unique(np.sort(edges[kinds[first][edges[:, 0]] == kinds[first][edges[:, 1]]], axis=1), axis=0)
    # Twins: the vertex of the same part that is nearest to the mirrored place.
    points = unit.double().cpu().numpy()[first]
    twins = []
    for kind in np.unique(kinds):
        part_nodes = np.flatnonzero(kinds[first] == kind)
        tree = scipy.spatial.KDTree(points[part_nodes])
        twins.append(
            np.stack([part_nodes, part_nodes[tree.query(points[part_nodes] * [1.0, 1.0, -1.0])[1]]], axis=1)
        )
    pairs = np.concatenate([edges, *twins])
    bond = np.concatenate([np.ones(len(edges)), np.full(len(pairs) - len(edges), 0.5 * _TWIN_BOND)])
    proper = pairs[:, 0] != pairs[:, 1]
    pairs, bond = pairs[proper], bond[proper]
    rows = np.concatenate([pairs[:, 0], pairs[:, 1]])
    columns = np.concatenate([pairs[:, 1], pairs[:, 0]])
    joined = scipy.sparse.coo_array((np.tile(bond, 2), (rows, columns)), shape=(count, count)).tocsc()
    return _VertexGraph(node, kinds[first], (scipy.sparse.diags_array(joined.sum(axis=1)) - joined).tocsc())
