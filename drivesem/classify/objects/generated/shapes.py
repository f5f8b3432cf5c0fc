"""Solids and surfaces of which objects are composed, and the builder that collects them into an object.

Axes are x forward, y up, z to the right; lengths are in metres. Solids are wound outwards and have material 0.
Points are sequences (3,) or (n, 3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivesem.classify.objects.types import ObjectModel, make_object_model
from scene_ir.meshes import solids
from scene_ir.meshes.solids import (
    TemplateSolid,
    clean_solid,
    grid_quads,
    join_solids,
    mirror_solid,
    quad_faces,
    translate_solid,
)

Array = NDArray[np.float64]
UP = np.array([0.0, 1.0, 0.0])
FORWARD = np.array([1.0, 0.0, 0.0])
Axis = Literal["x", "y", "z"]
Pair = tuple[float, float]

_ORDER = {"x": [1, 0, 2], "y": [0, 1, 2], "z": [0, 2, 1]}
"""Order of x, y, z that moves the y axis to each axis."""


def points(x: ArrayLike, y: ArrayLike, z: ArrayLike) -> Array:
    """Broadcast coordinates and stack them to points (..., 3).

    Args:
        x: Forward.
        y: Up.
        z: To the right.
    """
    return np.stack(np.broadcast_arrays(x, y, z), -1)


def even_angles(count: int, start: float = 0.0) -> Array:
    """Divide a full turn into `count` equal steps, rad, beginning `start` steps from 0."""
    return 2 * np.pi * (np.arange(count) + start) / count


def circle(radius: ArrayLike, y: ArrayLike, angle: ArrayLike) -> Array:
    """Points (..., 3) around the upright axis.

    Args:
        radius: Distance from the axis.
        y: Height.
        angle: Angles from forward to the right, rad.
    """
    return points(radius * np.cos(angle), y, radius * np.sin(angle))


def _closed_solid(vertices: Array, quads: NDArray[np.int64], *extra: NDArray[np.int64]) -> TemplateSolid:
    """Make a solid of quads (Q, 4) and triangles (T, 3), without duplicate points and collapsed faces."""
    faces = np.concatenate([quad_faces(quads, vertices), *extra])
    return clean_solid(vertices, faces, np.zeros(len(faces), np.int64))


def rotate(solid: TemplateSolid, axis: Axis, angle: float) -> TemplateSolid:
    """Rotate a solid.

    Args:
        solid: The solid.
        axis: Axis of the rotation.
        angle: Right-handed angle, rad.
    """
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    rotation = np.eye(3)
    rotation[[j, j, k, k], [j, k, j, k]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
    return replace(solid, vertices=solid.vertices @ rotation.T)


def rotate_each(solid: TemplateSolid, angles: Array) -> list[TemplateSolid]:
    """Copy a solid, rotated about the upright axis by each angle (n,), rad."""
    return [rotate(solid, "y", angle) for angle in angles]


def loft(rings: ArrayLike, *, around: bool = False) -> TemplateSolid:
    """A skin over closed rings (K, N, 3), with caps at both ends, or closed to a loop if `around`."""
    ring = np.asarray(rings, float)
    count, sides = ring.shape[:2]
    vertices = ring.reshape(-1, 3)
    index = np.pad(np.arange(count * sides).reshape(count, sides), ((0, int(around)), (0, 1)), mode="wrap")
    if around:
        return _closed_solid(vertices, grid_quads(index))
    first, last, middle = index[0], index[-1], np.full(sides, count * sides)
    caps = (np.stack([middle, first[1:], first[:-1]], -1), np.stack([middle + 1, last[:-1], last[1:]], -1))
    both = [ring[0].mean(axis=0), ring[-1].mean(axis=0)]
    return _closed_solid(np.concatenate([vertices, both]), grid_quads(index), *caps)


def slab(outer: ArrayLike, inner: ArrayLike) -> TemplateSolid:
    """The space between two grids of points (A, B, 3), such as both faces of a deck, a sail or a visor."""
    top, under = np.asarray(outer, float), np.asarray(inner, float)
    a, b = np.arange(top.size // 3 * 2).reshape(2, *top.shape[:2])
    rim = [(a[0], b[0]), (a[:, -1], b[:, -1]), (a[-1, ::-1], b[-1, ::-1]), (a[::-1, 0], b[::-1, 0])]
    sides = [np.stack([p[1:], p[:-1], q[:-1], q[1:]], -1) for p, q in rim]
    quads = np.concatenate([grid_quads(a), grid_quads(b[:, ::-1]), *sides])
    return _closed_solid(np.concatenate([top.reshape(-1, 3), under.reshape(-1, 3)]), quads)


def lathe(
    profile: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0), axis: Axis = "y", sides: int = 16
) -> TemplateSolid:
    """A solid of revolution.

    Args:
        profile: Radius and position along the axis (K, 2).
        centre: A point of the axis, where the position is 0.
        axis: Direction of the axis.
        sides: Number of sides.
    """
    radius, along = np.asarray(profile, float).T[..., None]
    rings = circle(radius, along, even_angles(sides, 0.5))
    return loft(rings[..., _ORDER[axis]] + np.asarray(centre, float))


def ball(centre: ArrayLike, radii: ArrayLike, sides: int = 12) -> TemplateSolid:
    """An ellipsoid.

    Args:
        centre: Its centre (3,).
        radii: Radii along x, y, z (3,), or one for a sphere.
        sides: Number of sides.
    """
    angle = np.linspace(0, np.pi, sides // 2 + 1)
    unit = lathe(np.stack([np.sin(angle), -np.cos(angle)], 1), sides=sides)
    return translate_solid(replace(unit, vertices=unit.vertices * np.asarray(radii, float)), centre)


def tube(path: ArrayLike, radius: ArrayLike, sides: int = 8) -> TemplateSolid:
    """A round pipe.

    Args:
        path: Points of its axis (K, 3).
        radius: One radius, or one per point (K,).
        sides: Number of sides.
    """
    places = np.asarray(path, float)
    steps = np.diff(places, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    tangents = np.concatenate([steps[:1], steps[:-1] + steps[1:], steps[-1:]])
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    normal = np.eye(3)[int(np.argmin(np.abs(tangents[0])))]
    angle = even_angles(sides, 0.5)
    rings = []
    for point, tangent, r in zip(places, tangents, np.broadcast_to(radius, len(places)), strict=True):
        normal = normal - tangent * (normal @ tangent)
        normal /= np.linalg.norm(normal)
        across = np.cross(tangent, normal)
        rings.append(point + r * (np.cos(angle)[:, None] * normal + np.sin(angle)[:, None] * across))
    return loft(rings)


def torus(centre: ArrayLike, radius: float, thick: float, axis: Axis = "z", sides: int = 24) -> TemplateSolid:
    """A ring about an axis, such as a tyre.

    Args:
        centre: Its centre.
        radius: Radius of the ring.
        thick: Radius of its section.
        axis: The axis.
        sides: Number of sides.
    """
    section = even_angles(8)
    rings = circle(radius + thick * np.cos(section), thick * np.sin(section), even_angles(sides)[:, None])
    return loft(rings[..., _ORDER[axis]] + np.asarray(centre, float), around=True)


def box(low: ArrayLike, high: ArrayLike, bevel: float = 0.0) -> TemplateSolid:
    """An axis-aligned box.

    Args:
        low: Lowest corner (3,).
        high: Highest corner (3,).
        bevel: Width by which edges are cut off.
    """
    a, b = np.asarray(low, float), np.asarray(high, float)
    if bevel:
        return solids.box(a.tolist(), b.tolist(), solids.VehicleMaterial.PAINT, bevel=bevel)
    return boxes(((a + b) / 2)[None], (b - a)[None])


def block(x: Pair, y: Pair, z: float, bevel: float = 0.0) -> TemplateSolid:
    """A box across the middle of an object.

    Args:
        x: Range of x.
        y: Range of y.
        z: Half its width.
        bevel: Width by which edges are cut off.
    """
    return box((x[0], y[0], -z), (x[1], y[1], z), bevel)


_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_SIDES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)


def _hexahedra(corners: Array) -> TemplateSolid:
    """Bodies with eight corners each (n, 8, 3), in the order of a box's."""
    count = len(corners)
    faces = (_SIDES + 8 * np.arange(count)[:, None, None]).reshape(-1, 3)
    return TemplateSolid(corners.reshape(-1, 3), faces, np.zeros(len(faces), np.int64))


def boxes(centres: ArrayLike, sizes: ArrayLike) -> TemplateSolid:
    """Boxes around points (n, 3), with one size (3,) or one per box (n, 3): windows, slats, blocks."""
    middle = np.asarray(centres, float)
    return _hexahedra(middle[:, None] + _CORNERS * np.broadcast_to(sizes, middle.shape)[:, None])


def beams(starts: ArrayLike, ends: ArrayLike, thick: float, deep: float | None = None) -> TemplateSolid:
    """Bars between points.

    Args:
        starts: First ends, one (3,) or many (n, 3).
        ends: Second ends, one or many.
        thick: Side of their section.
        deep: Other side of their section, if it is not square.
    """
    a, b = (p.reshape(-1, 3) for p in np.broadcast_arrays(np.asarray(starts, float), np.asarray(ends, float)))
    along = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    helper = np.where(np.abs(along[:, 1:2]) > 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    side = np.cross(along, helper)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, along)
    shift = _CORNERS[None, :, 1:2] * up[:, None] * (deep or thick) + _CORNERS[None, :, 2:] * side[:, None] * thick
    return _hexahedra(np.where(_CORNERS[None, :, :1] < 0, a[:, None], b[:, None]) + shift)


def rectangle(x: Pair, y: float, z: float) -> Array:
    """Outline (4, 3) of a horizontal rectangle.

    Args:
        x: Range of x.
        y: Height.
        z: Half its width.
    """
    return np.array([[x[0], y, -z], [x[1], y, -z], [x[1], y, z], [x[0], y, z]])


def squares(rows: Sequence[Pair]) -> TemplateSolid:
    """A body over horizontal squares, each with half its width and its height."""
    return loft([rectangle((-half, half), y, half) for half, y in rows])


def section(x: float, half: float, low: float, high: float, radius: float) -> Array:
    """Outline (12, 3) of an upright rectangle across x with rounded corners.

    Args:
        x: Its position.
        half: Half its width.
        low: Its lower edge.
        high: Its upper edge.
        radius: Radius of the corners.
    """
    angle = np.linspace(0, np.pi / 2, 3) + np.pi / 2 * np.arange(4)[:, None]
    z = np.array([[1.0], [-1.0], [-1.0], [1.0]]) * (half - radius) + radius * np.cos(angle)
    y = np.array([[high - radius]] * 2 + [[low + radius]] * 2) + radius * np.sin(angle)
    return points(x, y.ravel(), z.ravel())


def carriage(stations: ArrayLike, half: float, low: float, high: float, radius: float) -> TemplateSolid:
    """A long body along x with rounded sections.

    Args:
        stations: x, and the distances of roof, floor and sides from those of the full section (K, 4).
        half: Half the full width.
        low: Floor of the full section.
        high: Its roof.
        radius: Radius of its corners.
    """
    table = np.asarray(stations, float)
    return loft([section(x, half - side, low + floor, high - roof, radius) for x, roof, floor, side in table])


_CHORD = np.array([0.0, 0.04, 0.15, 0.4, 0.7, 1.0, 0.7, 0.4, 0.15, 0.04])
_RISE = np.array([0.0, 0.5, 0.9, 1.0, 0.55, 0.06, -0.3, -0.6, -0.6, -0.4]) / 2


def wing(thick: float, *stations: Sequence[float], upright: bool = False) -> TemplateSolid:
    """A wing.

    Args:
        thick: Thickness as a fraction of the chord.
        stations: Position x, y, z of the leading edge, and chord, of each station.
        upright: Make a fin, with its thickness along z.
    """
    across = np.array([0.0, 0.0, 1.0] if upright else [0.0, 1.0, 0.0])
    rings = []
    for *lead, chord in stations:
        back = np.array(lead) - _CHORD[:, None] * [chord, 0.0, 0.0]
        rings.append(back + _RISE[:, None] * thick * chord * across)
    return loft(rings)


def body(stations: ArrayLike, sides: int = 14, square: float = 2.0) -> TemplateSolid:
    """A hull along x.

    Args:
        stations: x, height of the axis, half height, half width (K, 4).
        sides: Number of sides.
        square: Exponent of the section: 2 for an ellipse, larger for rounder boxes.
    """
    angle = even_angles(sides, 0.5)
    up, side = (np.sign(v) * np.abs(v) ** (2 / square) for v in (np.sin(angle), np.cos(angle)))
    x, y, height, width = np.asarray(stations, float).T[..., None]
    return loft(points(x, y + height * up, width * side))


def direction(polar: ArrayLike, azimuth: ArrayLike) -> Array:
    """Directions (..., 3) at polar angles from the top and azimuths from forward to the right, rad."""
    return points(np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth))


def dome(
    radii: ArrayLike, polar: ArrayLike, azimuth: ArrayLike, thick: float, out: ArrayLike = 0.0
) -> TemplateSolid:
    """A patch of an ellipsoidal shell around the origin.

    Args:
        radii: Radii along x, y, z (3,).
        polar: Polar angles (A,), see `direction`.
        azimuth: Azimuths (B,).
        thick: Thickness, inwards.
        out: Distance of the outer face beyond the radii.
    """
    way = direction(np.asarray(polar, float)[:, None], azimuth)
    radius = np.asarray(radii, float) + np.asarray(out, float)
    return slab(way * radius, way * (radius - thick))


RIM_AZIMUTHS = even_angles(32)
"""Azimuths of a bowl's rim (32,), rad."""


def bowl(radii: ArrayLike, rim: ArrayLike, thick: float, steps: int = 10) -> TemplateSolid:
    """An ellipsoidal shell around the origin, open at the bottom.

    Args:
        radii: Radii along x, y, z (3,).
        rim: Polar angle of the rim, one or one for each of `RIM_AZIMUTHS`, rad.
        thick: Thickness, inwards.
        steps: Number of steps from the top to the rim.
    """
    way = direction(np.linspace(0, 1, steps + 1)[:, None] * np.asarray(rim, float), RIM_AZIMUTHS)
    radius = np.asarray(radii, float)
    return loft(np.concatenate([way * radius, (way * (radius - thick))[::-1]]))


def patch(stations: ArrayLike, x: Pair, angle: Pair, out: float) -> TemplateSolid:
    """A patch on the skin of a `body` of elliptic section, such as a windscreen or a stripe.

    Args:
        stations: Stations of the body, in order of x.
        x: Range of x.
        angle: Range of angles from the right side upwards, rad.
        out: Height above the skin.
    """
    table = np.asarray(stations, float).T
    along, around = np.linspace(*x, 9)[:, None], np.linspace(*angle, 9)
    axis, height, width = (np.interp(along, table[0], column) for column in table[1:])

    def skin(by: float) -> Array:
        return points(along, axis + (height + by) * np.sin(around), (width + by) * np.cos(around))

    return slab(skin(out), skin(-3 * out))


Rgb = tuple[float, float, float]


class Surface(NamedTuple):
    """Material of a surface."""

    diffuse: Rgb
    """Linear RGB, in [0, 1]."""
    specular: float
    """Specular reflectance, in [0, 1]."""
    shininess: float
    """Phong exponent."""


def paint(rgb: Rgb) -> Surface:
    """A glossy lacquer."""
    return Surface(rgb, 0.30, 60.0)


def plastic(rgb: Rgb) -> Surface:
    """Half-glossy plastic."""
    return Surface(rgb, 0.12, 18.0)


def dull(rgb: Rgb) -> Surface:
    """A matt surface: wood, stone, cloth."""
    return Surface(rgb, 0.03, 5.0)


def metal(rgb: Rgb) -> Surface:
    """Brushed or cast metal."""
    return Surface(rgb, 0.45, 30.0)


CHROME = Surface((0.50, 0.51, 0.53), 0.80, 90.0)
STEEL = metal((0.28, 0.29, 0.30))
IRON = metal((0.03, 0.03, 0.032))
BLACK = plastic((0.012, 0.012, 0.013))
RUBBER = Surface((0.016, 0.016, 0.017), 0.05, 8.0)
GLASS = Surface((0.018, 0.026, 0.034), 0.90, 120.0)
LAMP = Surface((0.80, 0.80, 0.74), 0.60, 60.0)
TAIL_LAMP = Surface((0.42, 0.012, 0.012), 0.50, 50.0)
AMBER = Surface((0.70, 0.25, 0.01), 0.40, 40.0)
WHITE = paint((0.72, 0.72, 0.71))

PAINTS: tuple[Rgb, ...] = (
    *((0.55, 0.02, 0.02), (0.02, 0.06, 0.40), (0.70, 0.70, 0.69), (0.02, 0.02, 0.022), (0.60, 0.38, 0.01)),
    *((0.02, 0.20, 0.05), (0.30, 0.31, 0.33), (0.60, 0.16, 0.01), (0.03, 0.30, 0.45), (0.22, 0.02, 0.04)),
)
"""Lacquers of objects that come in any colour."""
WOODS: tuple[Rgb, ...] = ((0.24, 0.11, 0.04), (0.13, 0.055, 0.022), (0.38, 0.22, 0.10), (0.20, 0.15, 0.10))
STONES: tuple[Rgb, ...] = ((0.42, 0.40, 0.36), (0.26, 0.26, 0.25), (0.48, 0.36, 0.24), (0.30, 0.12, 0.07))


class ObjectBuilder:
    """Collects the solids of an object, and draws all its random numbers from one generator.

    Solids are in metres: x forward, y up, z to the right.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._solids: list[TemplateSolid] = []
        self._face_materials: list[np.ndarray] = []

    def add(self, surface: Surface, *solids: TemplateSolid) -> None:
        """Add solids with one surface."""
        for solid in solids:
            self.add_materials([surface], solid)

    def add_materials(self, surfaces: Sequence[Surface], solid: TemplateSolid) -> None:
        """Add a solid; its material numbers are indices into `surfaces`."""
        table = np.array([(*s.diffuse, s.specular, s.shininess) for s in surfaces])
        self._solids.append(solid)
        self._face_materials.append(table[solid.material])

    def pair(self, surface: Surface, *solids: TemplateSolid) -> None:
        """Add solids with one surface, and their mirror images at z = 0."""
        self.add(surface, *solids, *(mirror_solid(solid) for solid in solids))

    def uniform(self, low: float, high: float) -> float:
        """Draw a number uniformly."""
        return float(self._rng.uniform(low, high))

    def chance(self, probability: float) -> bool:
        """Draw True with this probability."""
        return bool(self._rng.random() < probability)

    def integer(self, low: int, high: int) -> int:
        """Draw an integer uniformly, both ends included."""
        return int(self._rng.integers(low, high + 1))

    def tint(self, colours: Sequence[Rgb], spread: float = 0.25) -> Rgb:
        """Draw one of the colours, lighter or darker by up to `spread`, with a small change per channel."""
        rgb = np.array(colours[int(self._rng.integers(len(colours)))])
        shift = self._rng.uniform(1 - spread, 1 + spread) * self._rng.uniform(0.9, 1.1, 3)
        red, green, blue = np.clip(rgb * shift + 0.004, 0.0, 0.9).tolist()
        return red, green, blue

    def lacquer(self, spread: float = 0.25) -> Surface:
        """Draw a paint of any usual colour."""
        return paint(self.tint(PAINTS, spread))

    def build(self, name: str, label: int) -> ObjectModel:
        """Join all solids into one object: centred, longest side 1, front towards -z."""
        whole = join_solids(self._solids)
        low, high = whole.vertices.min(axis=0), whole.vertices.max(axis=0)
        unit = (whole.vertices - (low + high) / 2) / (high - low).max()
        vertices = unit[:, [2, 1, 0]] * [1.0, 1.0, -1.0]
        return make_object_model(name, label, vertices, whole.faces, np.concatenate(self._face_materials))
