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
from scene_ir.meshes.solids import TemplateSolid, clean_solid, grid_quads, quad_faces, translate_solid

Array = NDArray[np.float64]
UP = np.array([0.0, 1.0, 0.0])
AHEAD = np.array([1.0, 0.0, 0.0])
Axis = Literal["x", "y", "z"]
Pair = tuple[float, float]

_ORDER = {"x": [1, 0, 2], "y": [0, 1, 2], "z": [0, 2, 1]}
"""Where (across, along, across) of a lathe's axis lie among x, y, z."""


def points(x: ArrayLike, y: ArrayLike, z: ArrayLike) -> Array:
    """Points (..., 3) of coordinates that are broadcast."""
    return np.stack(np.broadcast_arrays(x, y, z), -1)


def turns(count: int, start: float = 0.0) -> Array:
    """As many even steps of a whole turn, rad, the first `start` steps from 0."""
    return 2 * np.pi * (np.arange(count) + start) / count


def circle(radius: ArrayLike, y: ArrayLike, angle: ArrayLike) -> Array:
    """Points (..., 3) about the upright axis, at angles that go from forward to the right."""
    return points(radius * np.cos(angle), y, radius * np.sin(angle))


def _closed(vertices: Array, quads: NDArray[np.int64], *extra: NDArray[np.int64]) -> TemplateSolid:
    """The solid of quads (Q, 4) and triangles (T, 3): doubled points are one, collapsed faces go."""
    faces = np.concatenate([quad_faces(quads, vertices), *extra])
    return clean_solid(vertices, faces, np.zeros(len(faces), np.int64))


def turned(solid: TemplateSolid, axis: Axis, angle: float) -> TemplateSolid:
    """The solid turned by `angle` rad about an axis, right-handed."""
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    rotation = np.eye(3)
    rotation[[j, j, k, k], [j, k, j, k]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
    return replace(solid, vertices=solid.vertices @ rotation.T)


def turned_each(solid: TemplateSolid, angles: Array) -> list[TemplateSolid]:
    """The solid turned about the upright axis by each angle (n,), rad."""
    return [turned(solid, "y", angle) for angle in angles]


def loft(rings: ArrayLike, *, around: bool = False) -> TemplateSolid:
    """A skin over closed rings (K, N, 3), capped at both ends, or joined end to end where it goes `around`."""
    ring = np.asarray(rings, float)
    count, sides = ring.shape[:2]
    vertices = ring.reshape(-1, 3)
    index = np.pad(np.arange(count * sides).reshape(count, sides), ((0, int(around)), (0, 1)), mode="wrap")
    if around:
        return _closed(vertices, grid_quads(index))
    first, last, middle = index[0], index[-1], np.full(sides, count * sides)
    caps = (np.stack([middle, first[1:], first[:-1]], -1), np.stack([middle + 1, last[:-1], last[1:]], -1))
    both = [ring[0].mean(axis=0), ring[-1].mean(axis=0)]
    return _closed(np.concatenate([vertices, both]), grid_quads(index), *caps)


def slab(outer: ArrayLike, inner: ArrayLike) -> TemplateSolid:
    """What lies between two like grids of points (A, B, 3), such as both faces of a deck, a sail or a visor."""
    top, under = np.asarray(outer, float), np.asarray(inner, float)
    a, b = np.arange(top.size // 3 * 2).reshape(2, *top.shape[:2])
    rim = [(a[0], b[0]), (a[:, -1], b[:, -1]), (a[-1, ::-1], b[-1, ::-1]), (a[::-1, 0], b[::-1, 0])]
    sides = [np.stack([p[1:], p[:-1], q[:-1], q[1:]], -1) for p, q in rim]
    quads = np.concatenate([grid_quads(a), grid_quads(b[:, ::-1]), *sides])
    return _closed(np.concatenate([top.reshape(-1, 3), under.reshape(-1, 3)]), quads)


def lathe(
    profile: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0), axis: Axis = "y", sides: int = 16
) -> TemplateSolid:
    """A solid of revolution: profile (K, 2) of radius and place along the axis through `centre`."""
    radius, along = np.asarray(profile, float).T[..., None]
    rings = circle(radius, along, turns(sides, 0.5))
    return loft(rings[..., _ORDER[axis]] + np.asarray(centre, float))


def ball(centre: ArrayLike, radii: ArrayLike, sides: int = 12) -> TemplateSolid:
    """An ellipsoid."""
    angle = np.linspace(0, np.pi, sides // 2 + 1)
    unit = lathe(np.stack([np.sin(angle), -np.cos(angle)], 1), sides=sides)
    return translate_solid(replace(unit, vertices=unit.vertices * np.asarray(radii, float)), centre)


def tube(path: ArrayLike, radius: ArrayLike, sides: int = 8) -> TemplateSolid:
    """A round pipe along points (K, 3), of one radius or one a point."""
    places = np.asarray(path, float)
    steps = np.diff(places, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    tangents = np.concatenate([steps[:1], steps[:-1] + steps[1:], steps[-1:]])
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    normal = np.eye(3)[int(np.argmin(np.abs(tangents[0])))]
    angle = turns(sides, 0.5)
    rings = []
    for point, tangent, r in zip(places, tangents, np.broadcast_to(radius, len(places)), strict=True):
        normal = normal - tangent * (normal @ tangent)
        normal /= np.linalg.norm(normal)
        across = np.cross(tangent, normal)
        rings.append(point + r * (np.cos(angle)[:, None] * normal + np.sin(angle)[:, None] * across))
    return loft(rings)


def torus(centre: ArrayLike, radius: float, thick: float, axis: Axis = "z", sides: int = 24) -> TemplateSolid:
    """A ring about an axis: a tyre, a rim, a hoop. thick: radius of its section."""
    section = turns(8)
    rings = circle(radius + thick * np.cos(section), thick * np.sin(section), turns(sides)[:, None])
    return loft(rings[..., _ORDER[axis]] + np.asarray(centre, float), around=True)


def box(low: ArrayLike, high: ArrayLike, bevel: float = 0.0) -> TemplateSolid:
    """An upright box between two corners, its edges cut by `bevel`."""
    a, b = np.asarray(low, float), np.asarray(high, float)
    if bevel:
        return solids.box(a.tolist(), b.tolist(), solids.VehicleMaterial.PAINT, bevel=bevel)
    return boxes(((a + b) / 2)[None], (b - a)[None])


def block(x: Pair, y: Pair, z: float, bevel: float = 0.0) -> TemplateSolid:
    """A box from -z to z: what most things have across their middle."""
    return box((x[0], y[0], -z), (x[1], y[1], z), bevel)


_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_SIDES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)


def _many(corners: Array) -> TemplateSolid:
    """Bodies of eight corners (n, 8, 3) each, in the order of a box's."""
    count = len(corners)
    faces = (_SIDES + 8 * np.arange(count)[:, None, None]).reshape(-1, 3)
    return TemplateSolid(corners.reshape(-1, 3), faces, np.zeros(len(faces), np.int64))


def boxes(centres: ArrayLike, sizes: ArrayLike) -> TemplateSolid:
    """Plain boxes about points (n, 3), of one size (3,) or one each: windows, slats, blocks."""
    middle = np.asarray(centres, float)
    return _many(middle[:, None] + _CORNERS * np.broadcast_to(sizes, middle.shape)[:, None])


def beams(starts: ArrayLike, ends: ArrayLike, thick: float, deep: float | None = None) -> TemplateSolid:
    """Square bars between points (n, 3), one or many at each end. deep: their other side where they are flat."""
    a, b = (p.reshape(-1, 3) for p in np.broadcast_arrays(np.asarray(starts, float), np.asarray(ends, float)))
    along = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    helper = np.where(np.abs(along[:, 1:2]) > 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    side = np.cross(along, helper)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, along)
    shift = _CORNERS[None, :, 1:2] * up[:, None] * (deep or thick) + _CORNERS[None, :, 2:] * side[:, None] * thick
    return _many(np.where(_CORNERS[None, :, :1] < 0, a[:, None], b[:, None]) + shift)


def rectangle(x: Pair, y: float, z: float) -> Array:
    """The outline (4, 3) of a level rectangle at height `y`, from x[0] to x[1] and -z to z."""
    return np.array([[x[0], y, -z], [x[1], y, -z], [x[1], y, z], [x[0], y, z]])


def squares(rows: Sequence[Pair]) -> TemplateSolid:
    """A body of level squares: half their width, and their height."""
    return loft([rectangle((-half, half), y, half) for half, y in rows])


def section(x: float, half: float, low: float, high: float, radius: float) -> Array:
    """An upright rectangle (12, 3) across x, -half to half and low to high, with corners of `radius`."""
    angle = np.linspace(0, np.pi / 2, 3) + np.pi / 2 * np.arange(4)[:, None]
    z = np.array([[1.0], [-1.0], [-1.0], [1.0]]) * (half - radius) + radius * np.cos(angle)
    y = np.array([[high - radius]] * 2 + [[low + radius]] * 2) + radius * np.sin(angle)
    return points(x, y.ravel(), z.ravel())


def carriage(stations: ArrayLike, half: float, low: float, high: float, radius: float) -> TemplateSolid:
    """A long body of rounded section along x: stations (K, 4) of x, and how far its roof, floor and sides lie
    inside those of the full section there.
    """
    table = np.asarray(stations, float)
    return loft([section(x, half - side, low + floor, high - roof, radius) for x, roof, floor, side in table])


_CHORD = np.array([0.0, 0.04, 0.15, 0.4, 0.7, 1.0, 0.7, 0.4, 0.15, 0.04])
_RISE = np.array([0.0, 0.5, 0.9, 1.0, 0.55, 0.06, -0.3, -0.6, -0.6, -0.4]) / 2


def wing(thick: float, *stations: Sequence[float], upright: bool = False) -> TemplateSolid:
    """A wing over stations: leading edge x, y, z, and chord. thick: of its section, a share of the chord.
    upright: a fin, thick along z.
    """
    across = np.array([0.0, 0.0, 1.0] if upright else [0.0, 1.0, 0.0])
    rings = []
    for *lead, chord in stations:
        back = np.array(lead) - _CHORD[:, None] * [chord, 0.0, 0.0]
        rings.append(back + _RISE[:, None] * thick * chord * across)
    return loft(rings)


def body(stations: ArrayLike, sides: int = 14, square: float = 2.0) -> TemplateSolid:
    """A hull along x: stations (K, 4) of x, height of its axis, half height, half width. square: the exponent of
    its section, an ellipse's 2 or a box's more.
    """
    angle = turns(sides, 0.5)
    up, side = (np.sign(v) * np.abs(v) ** (2 / square) for v in (np.sin(angle), np.cos(angle)))
    x, y, height, width = np.asarray(stations, float).T[..., None]
    return loft(points(x, y + height * up, width * side))


def direction(polar: ArrayLike, azimuth: ArrayLike) -> Array:
    """Directions (..., 3) at angles that are broadcast: rad from the top, and rad from forward to the right."""
    return points(np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth))


def dome(
    radii: ArrayLike, polar: ArrayLike, azimuth: ArrayLike, thick: float, out: ArrayLike = 0.0
) -> TemplateSolid:
    """A piece of an ellipsoidal shell about the origin, `thick` to the inside of `out` beyond its radii.

    polar (A,), azimuth (B,): as `direction` has them.
    """
    way = direction(np.asarray(polar, float)[:, None], azimuth)
    radius = np.asarray(radii, float) + np.asarray(out, float)
    return slab(way * radius, way * (radius - thick))


AROUND = turns(32)
"""Azimuths of a bowl's rim, from forward."""


def bowl(radii: ArrayLike, rim: ArrayLike, thick: float, steps: int = 10) -> TemplateSolid:
    """An ellipsoidal shell about the origin from its top to a polar angle: one, or one for each of `AROUND`."""
    way = direction(np.linspace(0, 1, steps + 1)[:, None] * np.asarray(rim, float), AROUND)
    radius = np.asarray(radii, float)
    return loft(np.concatenate([way * radius, (way * (radius - thick))[::-1]]))


def patch(stations: ArrayLike, x: Pair, angle: Pair, out: float) -> TemplateSolid:
    """A piece of the skin of a `body` of elliptic section, its stations in order of x, raised by `out`: a
    windscreen, a stripe. angle: rad from the right side upwards.
    """
    table = np.asarray(stations, float).T
    along, around = np.linspace(*x, 9)[:, None], np.linspace(*angle, 9)
    axis, height, width = (np.interp(along, table[0], column) for column in table[1:])

    def skin(by: float) -> Array:
        return points(along, axis + (height + by) * np.sin(around), (width + by) * np.cos(around))

    return slab(skin(out), skin(-3 * out))
