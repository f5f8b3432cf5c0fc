"""Trees, bushes and hedges: dark cores under a coat of leaf triangles. Each shape has an id in a pool."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from drivesem.synth import mesh_kernels
from drivesem.synth.soup import Material, Soup, balls, compact, join, make, stick

_GREENS = np.array(
    [[0.075, 0.115, 0.03], [0.055, 0.095, 0.03], [0.10, 0.135, 0.04], [0.12, 0.14, 0.05], [0.05, 0.075, 0.035]],
    np.float32,
)
"""Linear albedo of foliage: leaves reflect 3 to 14 % in the visible range, most in green."""
_AUTUMN = np.array([[0.16, 0.095, 0.03], [0.13, 0.055, 0.03], [0.14, 0.125, 0.04]], np.float32)
_BARK = np.array([[0.085, 0.07, 0.055], [0.12, 0.11, 0.095], [0.06, 0.05, 0.04]], np.float32)


def leaf_colour(rng: np.random.Generator, autumn: float = 0.05) -> np.ndarray:
    """A linear albedo (3,) for foliage; `autumn`: the probability of yellow or red leaves."""
    pool = _AUTUMN if rng.random() < autumn else _GREENS
    return (pool[rng.integers(len(pool))] * rng.uniform(0.8, 1.25, 3)).astype(np.float32)


def leaves(
    points: np.ndarray,
    outward: np.ndarray,
    size_m: float | np.ndarray,
    colour: np.ndarray,
    rng: np.random.Generator,
) -> Soup:
    """One slender leaf-cluster triangle at each of `points` (n, 3) around surface normals `outward` (n, 3).

    size_m: one for all, or (n, 1).
    """
    n = points.shape[0]
    jitter, spin = rng.normal(0, 1, (n, 3)), rng.normal(0, 1, (n, 3))
    reach = np.broadcast_to(size_m, (n, 1))[:, 0] * rng.uniform(0.6, 1.5, n)
    corners, normals = mesh_kernels.leaves(points, outward, (jitter, spin, reach))
    soup = make(corners, Material.LEAF, colour, normals)
    soup.albedo[:] *= rng.lognormal(0.0, 0.22, (n, 1)).astype(np.float32)
    return soup


def _crown(
    centres: np.ndarray, radii: np.ndarray, count: int, size_m: float, colour: np.ndarray, rng: np.random.Generator
) -> list[Soup]:
    """Blobs (k, 3) with radii (k, 3), covered with `count` leaves that do not lie deep inside another blob.

    One leaf in seven stands off the blobs, so that the sky shows through the crown's edge; leaves deep inside and
    on undersides get less light.
    """
    share = radii.prod(axis=1) ** (2 / 3)
    blob = rng.choice(len(centres), size=count, p=share / share.sum())
    direction = rng.normal(0, 1, (count, 3))
    depth = np.where(rng.random(count) < 0.14, rng.uniform(1.1, 1.32, count), rng.uniform(0.8, 1.1, count))
    rows, points, outward, light = mesh_kernels.crown((centres, radii), blob, direction, depth)
    cores = balls(centres, radii * 0.8, Material.LEAF, colour * 0.32, 1 if size_m < 0.02 else 0)
    # single leaves against the sky must not look like shards
    coat = leaves(points, outward, size_m * np.where(depth[rows, None] > 1.1, 0.55, 1.0), colour, rng)
    coat.albedo[:] *= light[:, None]
    return [cores, coat]


_TREE_LEAVES = ((520, 0.044), (1700, 0.0265), (5200, 0.0155), (22000, 0.0078))
"""Number and size of a tree's leaf clusters for each level of detail, per metre of height: 3 to 6 px each."""


@lru_cache(maxsize=96)
def tree(identifier: int, detail: int) -> Soup:
    """A tree about its trunk's foot, 1 m of height a metre (scale it): total height 1.

    identifier: shape in the pool. detail: 0 (far) to 3 (near): how many and how small the leaves are.
    """
    rng = np.random.default_rng([0x7EE, identifier])
    conifer = rng.random() < 0.15
    colour = leaf_colour(rng, 0.0 if conifer else 0.06)
    bark = _BARK[rng.integers(len(_BARK))]
    trunk = rng.uniform(0.18, 0.34) * (0.5 if conifer else 1.0)
    lean = rng.normal(0, 0.015, 2)
    sides = 4 + 2 * detail
    knee = (lean[0] * 0.2, -trunk * 0.6, lean[1] * 0.2)
    parts = [
        stick((0, 0.02, 0), (0, -0.03, 0), (0.028, 0.019), Material.BARK, bark, sides),
        stick((0, -0.025, 0), knee, (0.019, 0.0165), Material.BARK, bark, sides),
        stick(knee, (lean[0], -trunk * 1.6, lean[1]), (0.0165, 0.011), Material.BARK, bark, sides),
    ]
    if conifer:
        levels = np.linspace(trunk, 0.97, 9)
        width = rng.uniform(0.16, 0.24)
        centres = np.stack([rng.normal(0, 0.01, 9), -levels, rng.normal(0, 0.01, 9)], axis=1)
        flat = width * (1.04 - (levels - trunk) / (1 - trunk)) + 0.012
        radii = np.stack([flat, np.full(9, 0.07), flat], axis=1)
    else:
        count = int(rng.integers(11, 20))
        spread = rng.uniform(0.2, 0.34)
        middle = (1 + trunk) / 2
        direction = rng.normal(0, 1, (count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        reach = rng.uniform(0.35, 0.85, (count, 1))
        centres = direction * reach * np.array([spread, (1 - trunk) / 2, spread]) + np.array([0, -middle, 0])
        size = rng.uniform(0.26, 0.54, count) * spread
        radii = np.stack([size, size * rng.uniform(0.7, 1.05, count), size], axis=1)
        top, low = (centres[:, 1] - radii[:, 1]).min(), trunk * 0.8
        centres[:, 1] *= 0.97 / -top
        centres[:, 1] = np.minimum(centres[:, 1], -low - radii[:, 1] * 0.8)
        for i in range(2 + 2 * detail):
            parts.append(
                stick((lean[0], -trunk, lean[1]), centres[i], (0.010, 0.003), Material.BARK, bark, 3 + detail)
            )
    number, size_m = _TREE_LEAVES[detail]
    parts += _crown(centres, radii, number, size_m, colour, np.random.default_rng([0x7EF, identifier, detail]))
    return compact(join(parts))


@lru_cache(maxsize=128)
def bush(identifier: int, detail: int) -> Soup:
    """A bush standing on the ground, about 1 m wide and high (scale it)."""
    rng = np.random.default_rng([0xB05, identifier])
    count = int(rng.integers(3, 7))
    colour = leaf_colour(rng, 0.05)
    size = rng.uniform(0.2, 0.34, count)
    centres = np.stack([rng.uniform(-0.3, 0.3, count), -size * 0.75, rng.uniform(-0.3, 0.3, count)], axis=1)
    centres[0, 1] = -0.6
    number, size_m = ((140, 0.12), (520, 0.07), (2200, 0.036), (7500, 0.02))[detail]
    radii = np.repeat(size[:, None], 3, axis=1)
    return compact(join(_crown(centres, radii, number, size_m, colour, rng)))


def hedge(size_m: tuple[float, float, float], front: float, detail: int, rng: np.random.Generator) -> Soup:
    """A hedge of a length, height and depth along x, centred on the origin, standing on the ground.

    front: -1 or 1, the sign of z on the side that faces the camera (the other is thinner). detail: as for trees.
    """
    length_m, height_m, depth_m = size_m
    colour = leaf_colour(rng, 0.02)
    core = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [length_m / 2 - 0.1, depth_m / 2 - 0.12]
    density, leaf_m = ((12.0, 0.26), (40.0, 0.15), (120.0, 0.088), (340.0, 0.05))[detail]
    area_side, area_top = length_m * height_m, length_m * depth_m
    points, outward = [], []
    for sign in (-1.0, 1.0):
        n = int(area_side * density * (1.0 if sign == front else 0.3))
        points.append(
            np.stack(
                [
                    rng.uniform(-0.5, 0.5, n) * length_m,
                    -rng.uniform(0, 1, n) * height_m,
                    np.full(n, sign * depth_m / 2),
                ],
                axis=1,
            )
        )
        outward.append(np.tile([0.0, -0.15, sign], (n, 1)))
        n = int(depth_m * height_m * density)
        points.append(
            np.stack(
                [
                    np.full(n, sign * length_m / 2),
                    -rng.uniform(0, 1, n) * height_m,
                    rng.uniform(-0.5, 0.5, n) * depth_m,
                ],
                axis=1,
            )
        )
        outward.append(np.tile([sign, -0.15, 0.0], (n, 1)))
    n = int(area_top * density)
    points.append(
        np.stack(
            [rng.uniform(-0.5, 0.5, n) * length_m, np.full(n, -height_m), rng.uniform(-0.5, 0.5, n) * depth_m],
            axis=1,
        )
    )
    outward.append(np.tile([0.0, -1.0, 0.0], (n, 1)))
    spots = np.concatenate(points)
    spots += rng.normal(0, 0.05, spots.shape)
    block = _prism(core, height_m - 0.1, colour * 0.4)
    return join([block, leaves(spots, np.concatenate(outward), leaf_m, colour, rng)])


def _prism(ring: np.ndarray, height_m: float, colour: np.ndarray) -> Soup:
    """A box over the ring (4, 2) of (x, z) corners, of leaf material."""
    faces = []
    for i in range(4):
        a, b = ring[i], ring[(i + 1) % 4]
        face = np.array([[a[0], 0, a[1]], [b[0], 0, b[1]], [b[0], -height_m, b[1]], [a[0], -height_m, a[1]]])
        faces.append(face[np.array([[0, 1, 2], [0, 2, 3]])])
    top = np.stack([ring[:, 0], np.full(4, -height_m), ring[:, 1]], axis=1)
    faces.append(top[np.array([[0, 1, 2], [0, 2, 3]])])
    corners = np.concatenate(faces)
    return make(corners, Material.LEAF, colour)


def tree_line(start: np.ndarray, end: np.ndarray, height_m: float, rng: np.random.Generator) -> Soup:
    """A wood seen from far away: a wall (x, z) start to end with a top that follows crowns, under leaf clusters."""
    length = float(np.hypot(*(end - start)))
    columns = max(int(length / 1.1), 4)
    at = np.linspace(0, length, columns + 1)
    crowns = max(int(length / 4.0), 3)
    middle, reach = rng.uniform(0, length, crowns), rng.uniform(1.6, 6.5, crowns)
    rise = height_m * rng.uniform(0.45, 1.1, crowns)
    round_top = np.sqrt(np.clip(1 - ((at[:, None] - middle) / reach) ** 2, 0, 1)) ** 0.8
    top = np.maximum((rise * (0.45 + 0.55 * round_top) * (round_top > 0)).max(axis=1), 0.45 * height_m)
    top = top * (1 + rng.normal(0, 0.035, columns + 1))
    foot = start + at[:, None] / length * (end - start)
    low = np.stack([foot[:, 0], np.zeros(columns + 1), foot[:, 1]], axis=1)
    high = low - np.stack([np.zeros(columns + 1), top * 0.96, np.zeros(columns + 1)], axis=1)
    strip = np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)[:, np.array([[0, 1, 2], [0, 2, 3]])]
    normal = np.array([end[1] - start[1], 0, -(end[0] - start[0])]) / length
    if float(normal @ np.array([foot.mean(axis=0)[0], 0, foot.mean(axis=0)[1]])) > 0:
        normal = -normal
    colour = leaf_colour(rng, 0.0)
    wall = make(strip, Material.LEAF, colour * 0.55, np.tile(normal, (2 * columns, 3, 1)))
    n = int(length * height_m * 1.3)
    where = rng.uniform(0, columns, n)
    cell = np.minimum(where.astype(int), columns - 1)
    height = top[cell] * (1 - rng.random(n) ** 1.6)
    spots = np.stack(
        [
            np.interp(where, np.arange(columns + 1), foot[:, 0]),
            -height,
            np.interp(where, np.arange(columns + 1), foot[:, 1]),
        ],
        axis=1,
    )
    tilt = normal + rng.normal(0, 0.35, (n, 3)) + np.array([0, -0.6, 0]) * (height / top[cell])[:, None]
    coat = leaves(spots, tilt / np.linalg.norm(tilt, axis=1, keepdims=True), 0.62, colour, rng)
    coat.albedo[:] *= (0.6 + 0.4 * height / top[cell])[:, None].astype(np.float32)
    return join([wall, coat])
