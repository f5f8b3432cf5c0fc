"""Triangle soups: what a synthetic world is made of, and the solids it is built from.

World axes as the camera's (x right, y down, z forward), but with the ground at y = 0 and up = -y; metres.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import IntEnum
from functools import lru_cache

import numpy as np


class Material(IntEnum):
    """What a triangle is made of; selects its shading."""

    SKY = 0
    ROAD = 1
    PARKING = 2
    PAVEMENT = 3
    KERB = 4
    GRASS = 5
    GRAVEL = 6
    FACADE = 7
    ROOF = 8
    WALL = 9
    FENCE = 10
    LEAF = 11
    BARK = 12
    METAL = 13
    FLAT = 14
    PAINT = 15
    GLASS = 16
    TYRE = 17
    LIGHT = 18
    TRIM = 19
    CLOTH = 20


class Semantic(IntEnum):
    """What a triangle belongs to: Virtual KITTI's categories, and the people it does not have."""

    UNDEFINED = 0
    TERRAIN = 1
    SKY = 2
    TREE = 3
    VEGETATION = 4
    BUILDING = 5
    ROAD = 6
    GUARD_RAIL = 7
    TRAFFIC_SIGN = 8
    TRAFFIC_LIGHT = 9
    POLE = 10
    MISC = 11
    TRUCK = 12
    CAR = 13
    VAN = 14
    PEDESTRIAN = 15
    CYCLIST = 16


_SEMANTIC_OF_MATERIAL = np.array(
    [
        *(Semantic.SKY, Semantic.ROAD, Semantic.ROAD, Semantic.TERRAIN, Semantic.TERRAIN, Semantic.TERRAIN),
        *(Semantic.TERRAIN, Semantic.BUILDING, Semantic.BUILDING, Semantic.BUILDING, Semantic.BUILDING),
        *(Semantic.VEGETATION, Semantic.TREE, Semantic.POLE, Semantic.MISC, Semantic.MISC, Semantic.MISC),
        *(Semantic.MISC, Semantic.MISC, Semantic.MISC, Semantic.PEDESTRIAN),
    ],
    np.uint8,
)
"""Default semantic class of each material, in the order of `Material`."""

GROUND = (Material.ROAD, Material.PARKING, Material.PAVEMENT, Material.KERB, Material.GRASS, Material.GRAVEL)
"""Materials that receive vehicles' shadows."""


@dataclass(frozen=True, slots=True)
class Soup:
    """F independent triangles. corners (F, 3, 3) m; normals (F, 3, 3) unit, one a corner; uv (F, 3, 2) m, surface
    coordinates for patterns; material (F,) uint8; albedo (F, 3) linear RGB; pattern (F, 4), meaning by material (of
    METAL to TRIM: retro-reflective, own radiance per albedo, whether it shines by night, cell of a plate);
    owner (F,) int32, 0 is the surroundings, i + 1 actor i; semantic (F,) uint8, a `Semantic`. All float32 unless
    stated.
    """

    corners: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    material: np.ndarray
    albedo: np.ndarray
    pattern: np.ndarray
    owner: np.ndarray
    semantic: np.ndarray

    def __len__(self) -> int:
        return int(self.corners.shape[0])

    def take(self, keep: np.ndarray) -> Soup:
        """The triangles selected by a mask or by indices."""
        return Soup(*(getattr(self, f.name)[keep] for f in fields(self)))


def make(
    corners: np.ndarray,
    material: int,
    albedo: np.ndarray | tuple[float, float, float],
    normals: np.ndarray | None = None,
    uv: np.ndarray | None = None,
    pattern: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
) -> Soup:
    """A soup of one material; flat normals and zero surface coordinates where none are given."""
    corners = np.asarray(corners, np.float32).reshape(-1, 3, 3)
    count = corners.shape[0]
    if normals is None:
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
        normals = np.repeat(flat[:, None], 3, axis=1)
    return Soup(
        corners=corners,
        normals=np.asarray(normals, np.float32).reshape(-1, 3, 3),
        uv=np.zeros((count, 3, 2), np.float32) if uv is None else np.asarray(uv, np.float32).reshape(-1, 3, 2),
        material=np.full(count, int(material), np.uint8),
        albedo=_rows(albedo, count, 3),
        pattern=_rows(pattern, count, 4),
        owner=np.zeros(count, np.int32),
        semantic=np.full(count, _SEMANTIC_OF_MATERIAL[int(material)]),
    )


def _rows(values: np.ndarray | tuple[float, ...], count: int, width: int) -> np.ndarray:
    """The values in each of `count` rows: np.broadcast_to takes five times as long for few."""
    rows = np.empty((count, width), np.float32)
    rows[:] = values
    return rows


def tagged(soup: Soup, semantic: Semantic) -> Soup:
    """The same triangles, all belonging to `semantic`."""
    return replace(soup, semantic=np.full(len(soup), semantic, np.uint8))


def join(soups: list[Soup]) -> Soup:
    """All triangles in one soup, in order."""
    return Soup(*(np.concatenate([getattr(s, f.name) for s in soups]) for f in fields(Soup)))


def placed(
    soup: Soup, position: tuple[float, float, float], yaw: float, scale: tuple[float, float, float]
) -> Soup:
    """A copy scaled along its own axes, turned about y (KITTI's sense) and moved."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]], np.float32)
    size = np.asarray(scale, np.float32)
    corners = _product(soup.corners, (turn * size).T)
    corners += np.asarray(position, np.float32)
    normals = _product(soup.normals, (turn / size).T)
    if tuple(scale) != (1, 1, 1):
        normals /= np.sqrt(np.maximum(np.einsum("ni,ni->n", normals, normals), 1e-24))[:, None]
    return replace(soup, corners=corners.reshape(-1, 3, 3), normals=normals.reshape(-1, 3, 3))


def transformed(soup: Soup, rotation: np.ndarray, shift: np.ndarray) -> Soup:
    """A copy turned by a rotation (3, 3) and moved by a shift (3,)."""
    turn = np.ascontiguousarray(rotation.T, np.float32)
    corners = _product(soup.corners, turn)
    corners += shift.astype(np.float32)
    return replace(soup, corners=corners.reshape(-1, 3, 3), normals=_product(soup.normals, turn).reshape(-1, 3, 3))


_ROWS = 16384
"""So many rows times a small matrix are multiplied by one thread: OpenBLAS wakes others, which then spin, above a
quarter of a million products."""


def _product(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Rows (n, 3) of the points times a matrix (3, 3): far quicker at once than three rows at a time."""
    rows = points.reshape(-1, 3)
    out = np.empty(rows.shape, np.float32)
    for start in range(0, len(rows), _ROWS):
        np.matmul(rows[start : start + _ROWS], matrix, out=out[start : start + _ROWS])
    return out


def compact(soup: Soup) -> Soup:
    """The same triangles in less memory, to keep: what is zero all over is one number seen many times."""
    plain = {
        f.name: np.broadcast_to(np.zeros(1, values.dtype), values.shape)
        for f in fields(Soup)
        if not (values := getattr(soup, f.name)).any()
    }
    return replace(soup, **plain)


def quad(points: np.ndarray) -> np.ndarray:
    """Two triangles (2, 3, ...) of four corners (4, ...) in order around the outline."""
    return points[np.array([[0, 1, 2], [0, 2, 3]])]


def _unit_box() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners and normals (10, 3, 3) of a box of size 1 on y = 0 without its floor, and what of length, height and
    width each surface coordinate measures (10, 3, 2, 3)."""
    ring = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])
    corners, normals, uv = [], [], []
    for i in range(4):
        a, b = ring[i], ring[(i + 1) % 4]
        corners.append(quad(np.array([[a[0], 0, a[1]], [b[0], 0, b[1]], [b[0], -1, b[1]], [a[0], -1, a[1]]])))
        normals.append(np.broadcast_to([(a + b)[0], 0.0, (a + b)[1]], (2, 3, 3)))
        along = np.zeros((4, 2, 3))
        along[:, 0, 0 if a[0] != b[0] else 2] = [-0.5, 0.5, 0.5, -0.5]
        along[2:, 1, 1] = 1.0
        uv.append(quad(along))
    corners.append(quad(np.stack([ring[:, 0], np.full(4, -1.0), ring[:, 1]], axis=1)))
    normals.append(np.broadcast_to([0.0, -1.0, 0.0], (2, 3, 3)))
    flat = np.zeros((4, 2, 3))
    flat[:, 0, 0], flat[:, 1, 2] = ring.T
    uv.append(quad(flat))
    return (
        np.concatenate(corners).astype(np.float32),
        np.concatenate(normals).astype(np.float32),
        np.concatenate(uv).astype(np.float32),
    )


_BOX_CORNERS, _BOX_NORMALS, _BOX_UV = _unit_box()


def box(
    size: tuple[float, float, float],
    material: int,
    albedo: np.ndarray | tuple[float, float, float],
    pattern: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
) -> Soup:
    """A box (length x, height, width z) standing on y = 0; u runs along each side, v is the height, in metres."""
    scale = np.array(size, np.float32)
    return make(_BOX_CORNERS * scale, material, albedo, _BOX_NORMALS.copy(), _BOX_UV @ scale, pattern)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross product of two vectors (3,): np.cross takes 20 times as long for one pair."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def tube(
    start: np.ndarray, end: np.ndarray, radii: tuple[float, float], sides: int
) -> tuple[np.ndarray, np.ndarray]:
    """Corners and normals (F, 3, 3) of a closed, round stick from start to end (3,)."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    axis = end - start
    axis /= max(float(np.sqrt(axis @ axis)), 1e-9)
    helper = np.array([1.0, 0, 0]) if abs(axis[0]) < 0.8 else np.array([0, 1.0, 0])
    one = _cross(axis, helper)
    one /= np.sqrt(one @ one)
    ring = _circle(sides) @ np.stack([one, _cross(axis, one)])
    low, high = start + ring * radii[0], end + ring * radii[1]
    corners, normals = np.empty((2, 4, sides, 3, 3), np.float32)
    for i, (a, b, c) in enumerate(
        (
            (low[:-1], low[1:], high[1:]),
            (low[:-1], high[1:], high[:-1]),
            (start, low[:-1], low[1:]),
            (end, high[:-1], high[1:]),
        )
    ):
        corners[i, :, 0], corners[i, :, 1], corners[i, :, 2] = a, b, c
    normals[:2, :, 0], normals[0, :, 1], normals[:2, :, 2] = ring[:-1], ring[1:], ring[1:]
    normals[1, :, 1], normals[1, :, 2], normals[2], normals[3] = ring[1:], ring[:-1], -axis, axis
    return corners.reshape(-1, 3, 3), normals.reshape(-1, 3, 3)


@lru_cache(maxsize=32)
def _circle(sides: int) -> np.ndarray:
    """Points (sides + 1, 2) around a circle, the first again at the end."""
    angle = np.arange(sides + 1) * 2 * np.pi / sides
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def stick(
    start: tuple[float, float, float] | np.ndarray,
    end: tuple[float, float, float] | np.ndarray,
    radii: tuple[float, float],
    material: int,
    albedo: tuple[float, float, float] | np.ndarray,
    sides: int = 7,
) -> Soup:
    """A round stick as a soup."""
    corners, normals = tube(np.asarray(start), np.asarray(end), radii, sides)
    return make(corners, material, albedo, normals)


@lru_cache(maxsize=4)
def unit_sphere(subdivisions: int) -> np.ndarray:
    """Corners (F, 3, 3) of a subdivided icosahedron of radius 1."""
    golden = (1 + 5**0.5) / 2
    points = [(a * 1.0, b * golden, 0.0) for a in (-1, 1) for b in (-1, 1)]
    base = np.array(points + [(0, x, y) for x, y, _ in points] + [(y, 0, x) for x, y, _ in points])
    base /= np.linalg.norm(base, axis=1, keepdims=True)
    distance = np.linalg.norm(base[:, None] - base[None], axis=-1)
    near = (distance > 0) & (distance < 1.2)
    triangles = [
        (i, j, k)
        for i in range(12)
        for j in range(i + 1, 12)
        for k in range(j + 1, 12)
        if near[i, j] and near[j, k] and near[i, k]
    ]
    corners = base[np.array(triangles)]
    for _ in range(subdivisions):
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        ab, bc, ca = ((p + q) / np.linalg.norm(p + q, axis=1, keepdims=True) for p, q in ((a, b), (b, c), (c, a)))
        corners = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return corners.astype(np.float32)


def ball(
    centre: tuple[float, float, float] | np.ndarray,
    radii: tuple[float, float, float] | np.ndarray,
    material: int,
    albedo: tuple[float, float, float] | np.ndarray,
    subdivisions: int = 1,
) -> Soup:
    """An ellipsoid."""
    return balls(np.array([centre]), np.array([radii]), material, albedo, subdivisions)


def balls(
    centres: np.ndarray,
    radii: np.ndarray,
    material: int,
    albedo: tuple[float, float, float] | np.ndarray,
    subdivisions: int = 1,
) -> Soup:
    """Ellipsoids: centres and radii (k, 3)."""
    sphere, size = unit_sphere(subdivisions)[None], np.asarray(radii, np.float32)[:, None, None]
    normals = sphere / size
    normals /= np.sqrt(np.einsum("kfij,kfij->kfi", normals, normals))[..., None]
    return make(sphere * size + np.asarray(centres, np.float32)[:, None, None], material, albedo, normals)


def creased_normals(corners: np.ndarray, crease_rad: float = 0.65) -> np.ndarray:
    """Corner normals (F, 3, 3): averaged over faces that meet at a point at less than the crease angle."""
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
    grid = np.round(corners.reshape(-1, 3) * 2000).astype(np.int64) + 2**19
    point = (grid[:, 0] << 40) | (grid[:, 1] << 20) | grid[:, 2]
    order = np.argsort(point, kind="stable")
    ranked = point[order]
    starts = np.flatnonzero(np.concatenate([[True], ranked[1:] != ranked[:-1]]))
    counts = np.diff(np.concatenate([starts, [len(order)]]))
    # Pairs of each corner, in order of the points, with each corner at its point.
    per = np.repeat(counts, counts)
    first = np.concatenate([[0], np.cumsum(per)[:-1]])
    other = np.repeat(np.repeat(starts, counts) - first, per) + np.arange(int(per.sum()))
    mine, theirs = np.repeat(order // 3, per), order[other] // 3
    weight = flat[theirs]
    weight[np.einsum("ni,ni->n", unit[mine], unit[theirs]) <= np.cos(crease_rad)] = 0
    summed = np.empty((len(order), 3), flat.dtype)
    summed[order] = np.add.reduceat(weight, first, axis=0)
    summed /= np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-12)
    return summed.reshape(-1, 3, 3).astype(np.float32)
