"""Closed solids that vehicle templates consist of: boxes on a grid with named lines, wheels, plain boxes.

Everything here is in metres, axes x forward, y up, z to the car's left (a left-handed look at the unit box's axes,
turned over once at the very end by `assemble`). Solids are symmetric to z = 0 or come in mirrored pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
import torch
from numpy.typing import ArrayLike

from scene_ir.types import Mesh, Part


class Material(IntEnum):
    """Surfaces of a template; each has a part and a colour."""

    PAINT = 0
    GLASS = 1
    TYRE = 2
    RIM = 3
    RIM_GAP = 4
    HEADLIGHT = 5
    TAIL_LIGHT = 6
    INDICATOR = 7
    PLATE = 8
    TRIM = 9
    UNDERBODY = 10
    CHROME = 11
    CARGO = 12


PART = {
    Material.PAINT: Part.PAINT,
    Material.GLASS: Part.GLASS,
    Material.TYRE: Part.TYRE,
    Material.HEADLIGHT: Part.LIGHT,
    Material.TAIL_LIGHT: Part.LIGHT,
    Material.INDICATOR: Part.LIGHT,
}
"""Part of each material; those not named are OTHER."""

COLOUR = {
    Material.PAINT: (0.80, 0.80, 0.80),
    Material.GLASS: (0.07, 0.09, 0.12),
    Material.TYRE: (0.055, 0.055, 0.06),
    Material.RIM: (0.62, 0.63, 0.65),
    Material.RIM_GAP: (0.14, 0.14, 0.15),
    Material.HEADLIGHT: (0.90, 0.92, 0.93),
    Material.TAIL_LIGHT: (0.62, 0.05, 0.05),
    Material.INDICATOR: (0.90, 0.48, 0.10),
    Material.PLATE: (0.90, 0.90, 0.86),
    Material.TRIM: (0.10, 0.10, 0.11),
    Material.UNDERBODY: (0.05, 0.05, 0.05),
    Material.CHROME: (0.46, 0.47, 0.49),
    Material.CARGO: (0.86, 0.86, 0.86),
}
"""RGB of each material. PAINT is a neutral light grey, for a paint colour to multiply."""


@dataclass(frozen=True, slots=True)
class Solid:
    """A closed triangle soup. vertices (V, 3) float64 m; faces (F, 3) int64; material (F,) int64, a `Material`."""

    vertices: np.ndarray
    faces: np.ndarray
    material: np.ndarray


def quad_faces(quads: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Two triangles for each quad (Q, 4), cut along the shorter diagonal -> (2 Q, 3)."""
    corner = vertices[quads]
    first = np.linalg.norm(corner[:, 0] - corner[:, 2], axis=1)
    second = np.linalg.norm(corner[:, 1] - corner[:, 3], axis=1)
    cut = np.where(
        (first <= second + 1e-9)[:, None, None],
        quads[:, [[0, 1, 2], [0, 2, 3]]],
        quads[:, [[0, 1, 3], [1, 2, 3]]],
    )
    return cut.reshape(-1, 3)


def grid_quads(grid: np.ndarray) -> np.ndarray:
    """The quads (Q, 4) between neighbours of a grid (A, B) of vertices, row by row."""
    return np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], -1).reshape(-1, 4)


def cleaned(vertices: np.ndarray, faces: np.ndarray, material: np.ndarray) -> Solid:
    """Merge coincident vertices (to 1 um), drop collapsed faces, turn the winding outwards (y up: see module)."""
    # a stable sort by rows: np.unique over rows takes five times as long
    key = np.rint(vertices.T * 1e6).astype(np.int64)
    order = np.lexsort(key[::-1])
    ranked = key[:, order]
    start = np.empty(len(order), bool)
    start[0], start[1:] = True, (ranked[:, 1:] != ranked[:, :-1]).any(axis=0)
    inverse = np.empty(len(order), np.int64)
    inverse[order] = np.cumsum(start) - 1
    merged, faces = vertices[order[start]], inverse[faces]
    keep = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    faces, material = faces[keep], material[keep]
    if _volume(merged, faces) < 0:
        faces = faces[:, ::-1]
    return Solid(merged, faces, material)


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Six times the signed volume within closed faces, m^3."""
    a, b, c = vertices[faces].transpose(1, 2, 0)
    x, y, z = b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]
    return float(a[0] @ x + a[1] @ y + a[2] @ z)


def mirrored(solid: Solid) -> Solid:
    """The solid on the other side of z = 0."""
    return Solid(solid.vertices * np.array([1.0, 1.0, -1.0]), solid.faces[:, ::-1], solid.material)


def moved(solid: Solid, offset: ArrayLike) -> Solid:
    """The solid elsewhere, by an offset (3,) in m."""
    return replace(solid, vertices=solid.vertices + np.asarray(offset, float))


def joined(solids: Sequence[Solid]) -> Solid:
    """Solids, overlapping as they may, as one."""
    starts = np.cumsum([0] + [len(s.vertices) for s in solids])
    return Solid(
        np.concatenate([s.vertices for s in solids]),
        np.concatenate([s.faces + start for s, start in zip(solids, starts[:-1], strict=True)]),
        np.concatenate([s.material for s in solids]),
    )


@dataclass(frozen=True, slots=True)
class Skin:
    """Half (z >= 0) of a box-like surface on a grid: a wall around it, a lid, a floor.

    wall (K + 1, 2 m + n + 1, 3): levels from bottom to top; along each level from the front's middle (z = 0) over
    m steps to the front corner, n steps along the side, m steps to the rear's middle (z = 0).
    lid, floor (m + 1, n + 1, 3): from z = 0 to the side, from front to rear; their rims are the wall's.
    wall_material (K, 2 m + n), lid_material (m, n), floor_material (m, n): a `Material` a cell.
    """

    wall: np.ndarray
    lid: np.ndarray
    floor: np.ndarray
    wall_material: np.ndarray
    lid_material: np.ndarray
    floor_material: np.ndarray

    def solid(self) -> Solid:
        """Both halves as one closed solid."""
        blocks = [self.wall.reshape(-1, 3), self.lid.reshape(-1, 3), self.floor.reshape(-1, 3)]
        starts = np.cumsum([0] + [len(b) for b in blocks])
        vertices = np.concatenate(blocks)
        wall = np.arange(starts[0], starts[1]).reshape(self.wall.shape[:2])
        lid = np.arange(starts[1], starts[2]).reshape(self.lid.shape[:2])
        floor = np.arange(starts[2], starts[3]).reshape(self.floor.shape[:2])
        quads = np.concatenate(
            [
                grid_quads(wall),
                np.stack([lid[1:, :-1], lid[1:, 1:], lid[:-1, 1:], lid[:-1, :-1]], -1).reshape(-1, 4),
                grid_quads(floor),
            ]
        )
        material = np.concatenate(
            [self.wall_material.reshape(-1), self.lid_material.reshape(-1), self.floor_material.reshape(-1)]
        ).repeat(2)
        faces = quad_faces(quads, vertices)
        both = np.concatenate([vertices, vertices * np.array([1.0, 1.0, -1.0])])
        faces = np.concatenate([faces, faces[:, ::-1] + len(vertices)])
        return cleaned(both, faces, np.concatenate([material, material]))


def coons(rim: np.ndarray, m: int, n: int) -> np.ndarray:
    """A grid spanned inside a half rim (2 m + n + 1, 3) as `Skin.wall` has it -> (m + 1, n + 1, 3).

    The middle line (z = 0) runs straight from the front's middle to the rear's, in the side's steps.
    """
    front, side, rear = rim[: m + 1], rim[m : m + n + 1], rim[m + n :][::-1]
    span = side[:, 0] - side[0, 0]
    t = (span / span[-1])[:, None]
    middle = front[0] * (1 - t) + rear[0] * t
    grid = np.empty((m + 1, n + 1, 3))
    reach = max(front[-1, 2], 1e-9)
    for c in range(m + 1):
        u = front[c, 2] / reach
        blend = middle * (1 - u) + side * u
        lead = front[c] - (front[0] * (1 - u) + front[-1] * u)
        trail = rear[c] - (rear[0] * (1 - u) + rear[-1] * u)
        grid[c] = blend + lead * (1 - t) + trail * t
    grid[:, 0], grid[:, -1], grid[m] = front, rear, side
    grid[0, :, 2] = 0.0
    return grid


def revolve(profile: np.ndarray, material: np.ndarray, centre: Sequence[float]) -> Solid:
    """A solid of revolution about the z axis through `centre` (3,) m.

    profile (R, 2): radius and z offset in m, first and last on the axis; material (R - 1, S): a `Material` for
    each strip and each of S sectors. A vertex of each ring lies straight below the axis.
    """
    sectors = material.shape[1]
    angle = -np.pi / 2 + 2 * np.pi * np.arange(sectors) / sectors
    r, z = profile[:, 0, None], profile[:, 1, None]
    x, y = r * np.cos(angle), r * np.sin(angle)
    vertices = np.stack([x, y, np.broadcast_to(z, x.shape)], -1) + np.asarray(centre)
    quads = grid_quads(np.pad(np.arange(x.size).reshape(x.shape), ((0, 0), (0, 1)), mode="wrap"))
    flat = vertices.reshape(-1, 3)
    return cleaned(flat, quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3), material.reshape(-1).repeat(2))


def box(
    low: Sequence[float],
    high: Sequence[float],
    material: Material,
    *,
    bevel: float = 0.0,
    front: Material | None = None,
    rear: Material | None = None,
) -> Solid:
    """An upright box between two corners (3,) m, its long edges cut by `bevel` m; other materials for its ends."""
    lo, hi = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    b = bevel
    ring = np.array(
        [
            [lo[1], lo[2] + b],
            [lo[1], hi[2] - b],
            [lo[1] + b, hi[2]],
            [hi[1] - b, hi[2]],
            [hi[1], hi[2] - b],
            [hi[1], lo[2] + b],
            [hi[1] - b, lo[2]],
            [lo[1] + b, lo[2]],
        ]
    )
    middle = np.array([(lo[1] + hi[1]) / 2, (lo[2] + hi[2]) / 2])
    inner = middle + (ring - middle) * (1 - 2 * b / np.ptp(ring, axis=0))
    layers = [(lo[0], np.tile(middle, (8, 1))), (lo[0], inner), (lo[0] + b, ring)]
    layers += [(hi[0] - b, ring), (hi[0], inner), (hi[0], np.tile(middle, (8, 1)))]
    vertices = np.concatenate([np.column_stack([np.full(8, x), yz]) for x, yz in layers])
    quads = grid_quads(np.pad(np.arange(len(vertices)).reshape(-1, 8), ((0, 0), (0, 1)), mode="wrap"))
    strip = np.array([rear or material, material, material, material, front or material])
    return cleaned(vertices, quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3), strip.repeat(8).repeat(2))


def assemble(solids: Sequence[Solid], name: str) -> Mesh:
    """Solids, overlapping as they may, as one mesh in the unit box (float32), vertices split between materials."""
    whole = joined(solids)
    vertices, faces, material = whole.vertices, whole.faces, whole.material
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    scale = high - low
    half = max(-low[2], high[2])
    # y is turned over to point down, which mirrors the solid: the winding turns with it
    unit = np.stack(
        [
            (vertices[:, 0] - (low[0] + high[0]) / 2) / scale[0],
            -(vertices[:, 1] - low[1]) / scale[1],
            vertices[:, 2] / (2 * half),
        ],
        axis=1,
    )
    # pairs of vertex and material as numbers from a small range: ticked off rather than sorted
    pairs = (faces[:, ::-1] * len(Material) + material[:, None]).reshape(-1)
    found = np.zeros(len(vertices) * len(Material), bool)
    found[pairs] = True
    inverse = (np.cumsum(found) - 1)[pairs]
    vertex, surface = np.divmod(np.flatnonzero(found), len(Material))
    part = np.array([PART.get(Material(m), Part.OTHER) for m in range(len(Material))])
    colour = np.array([COLOUR[Material(m)] for m in range(len(Material))])
    return Mesh(
        vertices=torch.from_numpy(unit[vertex].astype(np.float32) + np.float32(0)),
        faces=torch.from_numpy(inverse.reshape(-1, 3).astype(np.int64)),
        part=torch.from_numpy(part[material].astype(np.int64)),
        name=name,
        colours=torch.from_numpy(colour[surface].astype(np.float32)),
    )
