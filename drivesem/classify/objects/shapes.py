"""Closed solids that objects are put together from: boxes, tubes, lathes, lofts, slabs.

Axes x forward, y up, z to the right; lengths in metres. Every solid is closed and wound outwards, its material 0.
Points come as (3,) or (n, 3) sequences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scene_ir.meshes import solids
from scene_ir.meshes.solids import Solid, cleaned, quad_faces

Array = NDArray[np.float64]
UP = np.array([0.0, 1.0, 0.0])
AHEAD = np.array([1.0, 0.0, 0.0])
Axis = Literal["x", "y", "z"]

_ORDER = {"x": [1, 0, 2], "y": [0, 1, 2], "z": [0, 2, 1]}
"""Where (across, along, across) of a lathe's axis lie among x, y, z."""


def _closed(vertices: Array, quads: NDArray[np.int64], *extra: NDArray[np.int64]) -> Solid:
    """The solid of quads (Q, 4) and triangles (T, 3): doubled points are one, collapsed faces go."""
    faces = np.concatenate([quad_faces(quads, vertices), *extra])
    return cleaned(vertices, faces, np.zeros(len(faces), np.int64))


def moved(solid: Solid, offset: ArrayLike) -> Solid:
    """The solid elsewhere."""
    return replace(solid, vertices=solid.vertices + np.asarray(offset, float))


def scaled(solid: Solid, factors: ArrayLike) -> Solid:
    """The solid stretched along the axes by positive factors."""
    return replace(solid, vertices=solid.vertices * np.asarray(factors, float))


def turned(solid: Solid, axis: Axis, angle: float, about: ArrayLike = (0.0, 0.0, 0.0)) -> Solid:
    """The solid turned by `angle` rad about an axis through a point, right-handed."""
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    rotation = np.eye(3)
    rotation[[j, j, k, k], [j, k, j, k]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
    centre = np.asarray(about, float)
    return replace(solid, vertices=(solid.vertices - centre) @ rotation.T + centre)


def loft(rings: ArrayLike, *, around: bool = False) -> Solid:
    """A skin over closed rings (K, N, 3), capped at both ends, or joined end to end where it goes `around`."""
    ring = np.asarray(rings, float)
    count, sides = ring.shape[:2]
    vertices = ring.reshape(-1, 3)
    index = np.arange(count * sides).reshape(count, sides)
    right = np.roll(index, -1, axis=1)
    if around:
        after, after_right = np.roll(index, -1, axis=0), np.roll(right, -1, axis=0)
        return _closed(vertices, np.stack([index, right, after_right, after], -1).reshape(-1, 4))
    quads = np.stack([index[:-1], right[:-1], right[1:], index[1:]], -1).reshape(-1, 4)
    middle = np.full(sides, count * sides)
    caps = (np.stack([middle, right[0], index[0]], -1), np.stack([middle + 1, index[-1], right[-1]], -1))
    return _closed(np.concatenate([vertices, [ring[0].mean(axis=0), ring[-1].mean(axis=0)]]), quads, *caps)


def slab(outer: ArrayLike, inner: ArrayLike) -> Solid:
    """What lies between two like grids of points (A, B, 3), such as both faces of a deck, a sail or a visor."""
    top, under = np.asarray(outer, float), np.asarray(inner, float)
    rows, columns = top.shape[:2]
    a = np.arange(rows * columns).reshape(rows, columns)
    b = a + rows * columns
    quads = [
        np.stack([g[:-1, :-1], g[:-1, 1:], g[1:, 1:], g[1:, :-1]], -1).reshape(-1, 4) for g in (a, b[:, ::-1])
    ]
    rim = [(a[0], b[0]), (a[:, -1], b[:, -1]), (a[-1, ::-1], b[-1, ::-1]), (a[::-1, 0], b[::-1, 0])]
    quads += [np.stack([p[1:], p[:-1], q[:-1], q[1:]], -1) for p, q in rim]
    return _closed(np.concatenate([top.reshape(-1, 3), under.reshape(-1, 3)]), np.concatenate(quads))


def lathe(profile: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0), axis: Axis = "y", sides: int = 16) -> Solid:
    """A solid of revolution: profile (K, 2) of radius and place along the axis through `centre`."""
    radius, along = np.asarray(profile, float).T
    angle = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    ring = np.empty((len(radius), sides, 3))
    ring[..., 0] = radius[:, None] * np.cos(angle)
    ring[..., 1] = along[:, None]
    ring[..., 2] = radius[:, None] * np.sin(angle)
    return loft(ring[..., _ORDER[axis]] + np.asarray(centre, float))


def ball(centre: ArrayLike, radii: ArrayLike, sides: int = 12) -> Solid:
    """An ellipsoid."""
    angle = np.linspace(0, np.pi, sides // 2 + 1)
    unit = lathe(np.stack([np.sin(angle), -np.cos(angle)], 1), sides=sides)
    return moved(scaled(unit, np.broadcast_to(np.asarray(radii, float), 3)), centre)


def tube(path: ArrayLike, radius: ArrayLike, sides: int = 8) -> Solid:
    """A round pipe along points (K, 3), of one radius or one a point."""
    points = np.asarray(path, float)
    steps = np.diff(points, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    tangents = np.concatenate([steps[:1], steps[:-1] + steps[1:], steps[-1:]])
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    normal = np.eye(3)[int(np.argmin(np.abs(tangents[0])))]
    angle = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    rings = []
    for point, tangent, r in zip(points, tangents, np.broadcast_to(radius, len(points)), strict=True):
        normal = normal - tangent * (normal @ tangent)
        normal /= np.linalg.norm(normal)
        across = np.cross(tangent, normal)
        rings.append(point + r * (np.cos(angle)[:, None] * normal + np.sin(angle)[:, None] * across))
    return loft(rings)


def torus(centre: ArrayLike, radius: float, thick: float, axis: Axis = "z", sides: int = 24) -> Solid:
    """A ring about an axis: a tyre, a rim, a hoop. thick: radius of its section."""
    angle, section = 2 * np.pi * np.arange(sides) / sides, 2 * np.pi * np.arange(8) / 8
    reach = radius + thick * np.cos(section)
    ring = np.empty((sides, 8, 3))
    ring[..., 0], ring[..., 2] = np.cos(angle)[:, None] * reach, np.sin(angle)[:, None] * reach
    ring[..., 1] = thick * np.sin(section)
    return loft(ring[..., _ORDER[axis]] + np.asarray(centre, float), around=True)


def box(low: ArrayLike, high: ArrayLike, bevel: float = 0.0) -> Solid:
    """An upright box between two corners, its edges cut by `bevel`."""
    a, b = np.asarray(low, float), np.asarray(high, float)
    if bevel:
        return solids.box(a.tolist(), b.tolist(), solids.Material.PAINT, bevel=bevel)
    return boxes(((a + b) / 2)[None], (b - a)[None])


def block(x: tuple[float, float], y: tuple[float, float], z: float, bevel: float = 0.0) -> Solid:
    """A box from -z to z: what most things have across their middle."""
    return box((x[0], y[0], -z), (x[1], y[1], z), bevel)


_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_SIDES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)


def _many(corners: Array) -> Solid:
    """Bodies of eight corners (n, 8, 3) each, in the order of a box's."""
    count = len(corners)
    faces = (_SIDES + 8 * np.arange(count)[:, None, None]).reshape(-1, 3)
    return Solid(corners.reshape(-1, 3), faces, np.zeros(len(faces), np.int64))


def boxes(centres: ArrayLike, sizes: ArrayLike) -> Solid:
    """Plain boxes about points (n, 3), of one size (3,) or one each: windows, slats, blocks."""
    middle = np.asarray(centres, float)
    return _many(middle[:, None] + _CORNERS * np.broadcast_to(sizes, middle.shape)[:, None])


def beams(starts: ArrayLike, ends: ArrayLike, thick: float, deep: float | None = None) -> Solid:
    """Square bars between points (n, 3): lattices, legs, spokes. deep: their other side where they are flat."""
    a, b = np.asarray(starts, float).reshape(-1, 3), np.asarray(ends, float).reshape(-1, 3)
    along = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    helper = np.where(np.abs(along[:, 1:2]) > 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    side = np.cross(along, helper)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, along)
    shift = _CORNERS[None, :, 1:2] * up[:, None] * (deep or thick) + _CORNERS[None, :, 2:] * side[:, None] * thick
    return _many(np.where(_CORNERS[None, :, :1] < 0, a[:, None], b[:, None]) + shift)


def prism(low: ArrayLike, high: ArrayLike) -> Solid:
    """A body between two convex outlines (N, 3) of as many points: cabs, roofs, blocks with sloping sides."""
    return loft([np.asarray(low, float), np.asarray(high, float)])


def rectangle(x: tuple[float, float], y: float, z: float) -> Array:
    """The outline (4, 3) of a level rectangle at height `y`, from x[0] to x[1] and -z to z."""
    return np.array([[x[0], y, -z], [x[1], y, -z], [x[1], y, z], [x[0], y, z]])


def section(half: float, low: float, high: float, radius: float, steps: int = 3) -> Array:
    """An upright rectangle (4 steps, 2) of (y, z), -half to half and low to high, with corners of `radius`."""
    angle = np.linspace(0, np.pi / 2, steps) + np.pi / 2 * np.arange(4)[:, None]
    z = np.array([[1.0], [-1.0], [-1.0], [1.0]]) * (half - radius) + radius * np.cos(angle)
    y = np.array([[high - radius]] * 2 + [[low + radius]] * 2) + radius * np.sin(angle)
    return np.stack([y.ravel(), z.ravel()], 1)


def carriage(stations: ArrayLike, half: float, low: float, high: float, radius: float) -> Solid:
    """A long body of rounded section along x: stations (K, 4) of x, and how far its roof, floor and sides lie
    inside those of the full section there.
    """
    rings = []
    for x, roof, floor, side in np.asarray(stations, float):
        ring = section(half - side, low + floor, high - roof, radius)
        rings.append(np.column_stack([np.full(len(ring), x), ring]))
    return loft(rings)


_CHORD = np.array([0.0, 0.04, 0.15, 0.4, 0.7, 1.0, 0.7, 0.4, 0.15, 0.04])
_RISE = np.array([0.0, 0.5, 0.9, 1.0, 0.55, 0.06, -0.3, -0.6, -0.6, -0.4]) / 2


def wing(thick: float, *stations: Sequence[float], upright: bool = False) -> Solid:
    """A wing over stations: leading edge x, y, z, and chord. thick: of its section, a share of the chord.
    upright: a fin, thick along z.
    """
    across = np.array([0.0, 0.0, 1.0] if upright else [0.0, 1.0, 0.0])
    rings = []
    for *lead, chord in stations:
        back = np.array(lead) - _CHORD[:, None] * [chord, 0.0, 0.0]
        rings.append(back + _RISE[:, None] * thick * chord * across)
    return loft(rings)


def body(stations: ArrayLike, sides: int = 14, square: float = 2.0) -> Solid:
    """A hull along x: stations (K, 4) of x, height of its axis, half height, half width. square: the exponent of
    its section, an ellipse's 2 or a box's more.
    """
    angle = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    cos, sin = np.cos(angle), np.sin(angle)
    up, side = (np.sign(v) * np.abs(v) ** (2 / square) for v in (sin, cos))
    x, y, height, width = (c[:, None] for c in np.asarray(stations, float).T)
    return loft(np.stack([np.broadcast_to(x, (len(x), sides)), y + height * up, width * side], -1))


def dome(radii: ArrayLike, polar: ArrayLike, azimuth: ArrayLike, thick: float, out: ArrayLike = 0.0) -> Solid:
    """A piece of an ellipsoidal shell about the origin, `thick` to the inside of `out` beyond its radii.

    polar (A,) or (A, B): rad from the top; azimuth (B,): rad from forward to the right.
    """
    phi = np.asarray(azimuth, float)
    theta = np.asarray(polar, float)
    theta = np.broadcast_to(theta[:, None] if theta.ndim == 1 else theta, (len(theta), len(phi)))
    direction = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1)
    radius = np.asarray(radii, float) + np.asarray(out, float)
    return slab(direction * radius, direction * (radius - thick))


def bowl(radii: ArrayLike, rim: ArrayLike, thick: float, steps: int = 10) -> Solid:
    """An ellipsoidal shell about the origin from its top to the polar angle `rim` (B,), around from forward."""
    edge = np.asarray(rim, float)
    phi = 2 * np.pi * np.arange(len(edge)) / len(edge)
    theta = np.linspace(0, 1, steps + 1)[:, None] * edge
    direction = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1)
    radius = np.asarray(radii, float)
    return loft(np.concatenate([direction * radius, (direction * (radius - thick))[::-1]]))


def patch(stations: ArrayLike, x: tuple[float, float], angle: tuple[float, float], out: float) -> Solid:
    """A piece of the skin of a `body` of elliptic section, raised by `out`: a windscreen, a stripe. angle: rad
    from the right side upwards.
    """
    table = np.asarray(stations, float)
    table = table[np.argsort(table[:, 0], kind="stable")]
    along, around = np.linspace(*x, 9), np.linspace(*angle, 9)
    axis, height, width = (np.interp(along, table[:, 0], column)[:, None] for column in table[:, 1:].T)

    def skin(by: float) -> Array:
        y, z = axis + (height + by) * np.sin(around), (width + by) * np.cos(around)
        return np.stack([np.broadcast_to(along[:, None], y.shape), y, z], -1)

    return slab(skin(out), skin(-3 * out))
