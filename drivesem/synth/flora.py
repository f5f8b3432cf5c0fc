"""Trees, bushes and hedges: dark cores under a coat of leaf triangles. Each shape has an id in a pool."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from drivesem.synth.soup import Material, Soup, ball, join, make, stick

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
    points: np.ndarray, outward: np.ndarray, size_m: float, colour: np.ndarray, rng: np.random.Generator
) -> Soup:
    """One leaf-cluster triangle at each of `points` (n, 3) around surface normals `outward` (n, 3)."""
    n = points.shape[0]
    facing = outward + rng.normal(0, 0.55, (n, 3))
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    one = np.cross(facing, rng.normal(0, 1, (n, 3)))
    one /= np.maximum(np.linalg.norm(one, axis=1, keepdims=True), 1e-6)
    two = np.cross(facing, one)
    reach = size_m * rng.uniform(0.55, 1.35, (n, 1))
    corners = (
        points[:, None] + np.stack([one, -0.5 * one + 0.87 * two, -0.5 * one - 0.87 * two], 1) * reach[:, None]
    )
    shade = outward * 0.75 + facing * 0.45
    shade /= np.linalg.norm(shade, axis=1, keepdims=True)
    soup = make(corners, Material.LEAF, colour, np.repeat(shade[:, None], 3, axis=1))
    soup.albedo[:] *= rng.lognormal(0.0, 0.28, (n, 1)).astype(np.float32)
    return soup


def _crown(
    centres: np.ndarray, radii: np.ndarray, count: int, size_m: float, colour: np.ndarray, rng: np.random.Generator
) -> list[Soup]:
    """Blobs (k, 3) with radii (k, 3), covered with `count` leaves that do not lie deep inside another blob."""
    share = radii.prod(axis=1) ** (2 / 3)
    blob = rng.choice(len(centres), size=count, p=share / share.sum())
    direction = rng.normal(0, 1, (count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = centres[blob] + direction * radii[blob] * rng.uniform(0.86, 1.1, (count, 1))
    inside = np.zeros(count, bool)
    for centre, radius in zip(centres, radii, strict=True):
        inside |= (((points - centre) / radius) ** 2).sum(axis=1) < 0.6
    outward = direction / radii[blob]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    keep = ~inside
    cores = [ball(c, r * 0.86, Material.LEAF, colour * 0.45, 1) for c, r in zip(centres, radii, strict=True)]
    return [*cores, leaves(points[keep], outward[keep], size_m, colour, rng)]


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
    parts = [stick((0, 0.02, 0), (lean[0], -trunk * 1.6, lean[1]), (0.022, 0.014), Material.BARK, bark, 8)]
    if conifer:
        levels = np.linspace(trunk, 0.97, 7)
        width = rng.uniform(0.16, 0.24)
        centres = np.stack([rng.normal(0, 0.01, 7), -levels, rng.normal(0, 0.01, 7)], axis=1)
        flat = width * (1.04 - (levels - trunk) / (1 - trunk)) + 0.012
        radii = np.stack([flat, np.full(7, 0.10), flat], axis=1)
    else:
        count = int(rng.integers(7, 13))
        spread = rng.uniform(0.2, 0.34)
        middle = (1 + trunk) / 2
        direction = rng.normal(0, 1, (count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        reach = rng.uniform(0.35, 0.72, (count, 1))
        centres = direction * reach * np.array([spread, (1 - trunk) / 2, spread]) + np.array([0, -middle, 0])
        size = rng.uniform(0.38, 0.62, count) * spread
        radii = np.stack([size, size * rng.uniform(0.75, 1.1, count), size], axis=1)
        top, low = (centres[:, 1] - radii[:, 1]).min(), trunk * 0.8
        centres[:, 1] *= 0.97 / -top
        centres[:, 1] = np.minimum(centres[:, 1], -low - radii[:, 1] * 0.8)
        for i in range(3):
            parts.append(stick((lean[0], -trunk, lean[1]), centres[i], (0.011, 0.004), Material.BARK, bark, 5))
    number, size_m = ((450, 0.05), (1300, 0.032), (3600, 0.0195), (14000, 0.0105))[detail]
    parts += _crown(centres, radii, number, size_m, colour, np.random.default_rng([0x7EF, identifier, detail]))
    return join(parts)


@lru_cache(maxsize=64)
def bush(identifier: int, detail: int) -> Soup:
    """A bush standing on the ground, about 1 m wide and high (scale it)."""
    rng = np.random.default_rng([0xB05, identifier])
    count = int(rng.integers(3, 7))
    colour = leaf_colour(rng, 0.05)
    size = rng.uniform(0.2, 0.34, count)
    centres = np.stack([rng.uniform(-0.3, 0.3, count), -size * 0.75, rng.uniform(-0.3, 0.3, count)], axis=1)
    centres[0, 1] = -0.6
    number, size_m = ((140, 0.12), (420, 0.075), (1300, 0.042), (5000, 0.022))[detail]
    radii = np.repeat(size[:, None], 3, axis=1)
    return join(_crown(centres, radii, number, size_m, colour, rng))


def hedge(length_m: float, height_m: float, depth_m: float, detail: int, rng: np.random.Generator) -> Soup:
    """A hedge along x, centred on the origin, standing on the ground; `detail` as for trees."""
    colour = leaf_colour(rng, 0.02)
    core = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [length_m / 2 - 0.1, depth_m / 2 - 0.12]
    density, size_m = ((9.0, 0.3), (30.0, 0.16), (75.0, 0.1), (260.0, 0.05))[detail]
    area_side, area_top = length_m * height_m, length_m * depth_m
    points, outward = [], []
    for sign in (-1.0, 1.0):
        n = int(area_side * density)
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
    return join([block, leaves(spots, np.concatenate(outward), size_m, colour, rng)])


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
    """A wood seen from far away: a wall (x, z) start to end with a ragged top and leaf clusters of 1 to 2 m."""
    length = float(np.hypot(*(end - start)))
    columns = max(int(length / 2.2), 4)
    along = np.linspace(0, 1, columns + 1)[:, None]
    foot = start + along * (end - start)
    steps = np.cumsum(rng.normal(0, 0.22, columns + 1))
    steps -= np.linspace(steps[0], steps[-1], columns + 1)
    top = height_m * np.clip(0.8 + 0.25 * steps + rng.normal(0, 0.05, columns + 1), 0.45, 1.3)
    low = np.stack([foot[:, 0], np.zeros(columns + 1), foot[:, 1]], axis=1)
    high = low - np.stack([np.zeros(columns + 1), top * 0.93, np.zeros(columns + 1)], axis=1)
    strip = np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)[:, np.array([[0, 1, 2], [0, 2, 3]])]
    normal = np.array([end[1] - start[1], 0, -(end[0] - start[0])]) / length
    if float(normal @ np.array([foot.mean(axis=0)[0], 0, foot.mean(axis=0)[1]])) > 0:
        normal = -normal
    colour = leaf_colour(rng, 0.04)
    wall = make(strip, Material.LEAF, colour * 0.5, np.tile(normal, (2 * columns, 3, 1)))
    n = int(length * height_m * 0.55)
    where = rng.uniform(0, columns, n)
    cell = np.minimum(where.astype(int), columns - 1)
    height = top[cell] * (1 - rng.random(n) ** 1.4)
    spots = np.stack(
        [
            np.interp(where, np.arange(columns + 1), foot[:, 0]),
            -height,
            np.interp(where, np.arange(columns + 1), foot[:, 1]),
        ],
        axis=1,
    )
    return join([wall, leaves(spots, normal + rng.normal(0, 0.5, (n, 3)), 1.0, colour, rng)])
