"""Closed solids that vehicle templates consist of: boxes on a grid with named lines, wheels, plain boxes.

In metres, axes x forward, y up, z to the car's left (left-handed; `assemble` flips y at the end). Solids are symmetric
about z = 0 or come in mirrored pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
import torch
from numpy.typing import ArrayLike

from scene_ir.types import Mesh, Part


class VehicleMaterial(IntEnum):
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
    VehicleMaterial.PAINT: Part.PAINT,
    VehicleMaterial.GLASS: Part.GLASS,
    VehicleMaterial.TYRE: Part.TYRE,
    VehicleMaterial.HEADLIGHT: Part.LIGHT,
    VehicleMaterial.TAIL_LIGHT: Part.LIGHT,
    VehicleMaterial.INDICATOR: Part.LIGHT,
}
"""Part of each material; others are OTHER."""

COLOUR = {
    VehicleMaterial.PAINT: (0.80, 0.80, 0.80),
    VehicleMaterial.GLASS: (0.07, 0.09, 0.12),
    VehicleMaterial.TYRE: (0.055, 0.055, 0.06),
    VehicleMaterial.RIM: (0.62, 0.63, 0.65),
    VehicleMaterial.RIM_GAP: (0.14, 0.14, 0.15),
    VehicleMaterial.HEADLIGHT: (0.90, 0.92, 0.93),
    VehicleMaterial.TAIL_LIGHT: (0.62, 0.05, 0.05),
    VehicleMaterial.INDICATOR: (0.90, 0.48, 0.10),
    VehicleMaterial.PLATE: (0.90, 0.90, 0.86),
    VehicleMaterial.TRIM: (0.10, 0.10, 0.11),
    VehicleMaterial.UNDERBODY: (0.05, 0.05, 0.05),
    VehicleMaterial.CHROME: (0.46, 0.47, 0.49),
    VehicleMaterial.CARGO: (0.86, 0.86, 0.86),
}
"""RGB of each material. PAINT is a neutral light grey, for a paint colour to multiply."""


@dataclass(frozen=True, slots=True)
class TemplateSolid:
    """A closed triangle mesh."""

    vertices: np.ndarray
    """(V, 3) float64 m."""
    faces: np.ndarray
    """(F, 3) int64."""
    material: np.ndarray
    """(F,) int64, a `VehicleMaterial`."""


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


def clean_solid(vertices: np.ndarray, faces: np.ndarray, material: np.ndarray) -> TemplateSolid:
    """Merge coincident vertices (to 1 um), drop collapsed faces and wind the others outwards.

    Args:
        vertices: (V, 3) m.
        faces: (F, 3).
        material: (F,), a `VehicleMaterial`.

    Returns:
        The solid.
    """
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
    return TemplateSolid(merged, faces, material)


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Six times the signed volume within closed faces, m^3."""
    a, b, c = vertices[faces].transpose(1, 2, 0)
    x, y, z = b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]
    return float(a[0] @ x + a[1] @ y + a[2] @ z)


def mirror_solid(solid: TemplateSolid) -> TemplateSolid:
    """The solid mirrored at z = 0."""
    return TemplateSolid(solid.vertices * np.array([1.0, 1.0, -1.0]), solid.faces[:, ::-1], solid.material)


def translate_solid(solid: TemplateSolid, offset: ArrayLike) -> TemplateSolid:
    """The solid moved by an offset (3,) m."""
    return replace(solid, vertices=solid.vertices + np.asarray(offset, float))


def join_solids(solids: Sequence[TemplateSolid]) -> TemplateSolid:
    """Possibly overlapping solids as one."""
    starts = np.cumsum([0] + [len(s.vertices) for s in solids])
    return TemplateSolid(
        np.concatenate([s.vertices for s in solids]),
        np.concatenate([s.faces + start for s, start in zip(solids, starts[:-1], strict=True)]),
        np.concatenate([s.material for s in solids]),
    )


@dataclass(frozen=True, slots=True)
class Skin:
    """Half (z >= 0) of a box-like surface on a grid: a wall around it, a lid, a floor."""

    wall: np.ndarray
    """(K + 1, 2 m + n + 1, 3) m, levels from bottom to top; along each, m steps from the front's middle (z = 0) to the
    front corner, n along the side, m to the rear's middle."""
    lid: np.ndarray
    """(m + 1, n + 1, 3) m, from z = 0 to the side, from front to rear; its rim is the wall's."""
    floor: np.ndarray
    """Likewise."""
    wall_material: np.ndarray
    """(K, 2 m + n), a `VehicleMaterial` per cell."""
    lid_material: np.ndarray
    """(m, n), likewise."""
    floor_material: np.ndarray
    """(m, n), likewise."""

    def solid(self) -> TemplateSolid:
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
        return clean_solid(both, faces, np.concatenate([material, material]))


def coons(rim: np.ndarray, m: int, n: int) -> np.ndarray:
    """Span a grid inside a half rim, with a straight middle line (z = 0) from front to rear.

    Args:
        rim: (2 m + n + 1, 3) m, as a level of `Skin.wall`.
        m: Steps from the middle to a corner.
        n: Steps along the side.

    Returns:
        (m + 1, n + 1, 3) m.
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


def revolve(profile: np.ndarray, material: np.ndarray, centre: Sequence[float]) -> TemplateSolid:
    """Make a solid of revolution about the z axis.

    Args:
        profile: (R, 2) m, radius and z offset; the first and last are on the axis.
        material: (R - 1, S), a `VehicleMaterial` for each strip and sector.
        centre: (3,) m.

    Returns:
        The solid; a vertex of each ring is straight below the axis.
    """
    sectors = material.shape[1]
    angle = -np.pi / 2 + 2 * np.pi * np.arange(sectors) / sectors
    r, z = profile[:, 0, None], profile[:, 1, None]
    x, y = r * np.cos(angle), r * np.sin(angle)
    vertices = np.stack([x, y, np.broadcast_to(z, x.shape)], -1) + np.asarray(centre)
    quads = grid_quads(np.pad(np.arange(x.size).reshape(x.shape), ((0, 0), (0, 1)), mode="wrap"))
    flat = vertices.reshape(-1, 3)
    return clean_solid(flat, quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3), material.reshape(-1).repeat(2))


def box(
    low: Sequence[float],
    high: Sequence[float],
    material: VehicleMaterial,
    *,
    bevel: float = 0.0,
    front: VehicleMaterial | None = None,
    rear: VehicleMaterial | None = None,
) -> TemplateSolid:
    """Make an upright box.

    Args:
        low: Lowest corner (3,) m.
        high: Highest corner (3,) m.
        material: Of its faces.
        bevel: Width of the cut along its long edges, m.
        front: Another material for its front.
        rear: Another material for its rear.

    Returns:
        The solid.
    """
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
    return clean_solid(vertices, quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3), strip.repeat(8).repeat(2))


def assemble(solids: Sequence[TemplateSolid], name: str) -> Mesh:
    """Possibly overlapping solids as one mesh in the unit box (float32), with vertices split between materials."""
    whole = join_solids(solids)
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
    pairs = (faces[:, ::-1] * len(VehicleMaterial) + material[:, None]).reshape(-1)
    found = np.zeros(len(vertices) * len(VehicleMaterial), bool)
    found[pairs] = True
    inverse = (np.cumsum(found) - 1)[pairs]
    vertex, surface = np.divmod(np.flatnonzero(found), len(VehicleMaterial))
    part = np.array([PART.get(VehicleMaterial(m), Part.OTHER) for m in range(len(VehicleMaterial))])
    colour = np.array([COLOUR[VehicleMaterial(m)] for m in range(len(VehicleMaterial))])
    return Mesh(
        vertices=torch.from_numpy(unit[vertex].astype(np.float32) + np.float32(0)),
        faces=torch.from_numpy(inverse.reshape(-1, 3).astype(np.int64)),
        part=torch.from_numpy(part[material].astype(np.int64)),
        name=name,
        colours=torch.from_numpy(colour[surface].astype(np.float32)),
    )
