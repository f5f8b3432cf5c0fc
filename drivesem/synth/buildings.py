"""Houses, blocks of flats, garden walls and fences. Each style has an id in a pool."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from drivesem.synth.soup import Material, Semantic, Soup, box, join, make, placed, quad, stick, tagged

_PLASTER = np.array(
    [
        [0.70, 0.68, 0.62], [0.62, 0.56, 0.44], [0.55, 0.45, 0.28], [0.58, 0.36, 0.26], [0.42, 0.42, 0.41],
        [0.50, 0.53, 0.55], [0.66, 0.60, 0.50], [0.34, 0.19, 0.14], [0.28, 0.30, 0.33], [0.60, 0.52, 0.36],
    ],
    np.float32,
)  # fmt: skip
"""Linear albedo of plaster and brick in the colours of Central European streets."""
_ROOFS = np.array(
    [[0.17, 0.065, 0.045], [0.11, 0.055, 0.04], [0.07, 0.07, 0.075], [0.20, 0.10, 0.06], [0.05, 0.045, 0.045]],
    np.float32,
)

_TRIM = np.array(
    [[0.10, 0.05, 0.025], [0.04, 0.09, 0.05], [0.06, 0.08, 0.14], [0.30, 0.29, 0.27], [0.12, 0.03, 0.025]],
    np.float32,
)
"""Linear albedo of doors, shutters and shop signs."""
_SHOP_M = 3.5
"""Height of a ground floor that is a shop."""
_STEEL = np.array([0.16, 0.165, 0.17], np.float32)


@dataclass(frozen=True, slots=True)
class BuildingStyle:
    """Appearance of one building."""

    wall: np.ndarray
    """Linear albedo (3,)."""
    roof: np.ndarray
    """Linear albedo (3,)."""
    trim: np.ndarray
    """Linear albedo (3,)."""
    pattern: tuple[float, float, float, float]
    """Window pitch and storey height, m, and the window's share of each."""
    pitched: bool
    """Whether the roof is pitched."""
    shop: bool
    """Whether the ground floor is a shop."""
    shutters: bool
    """Whether windows have shutters."""
    balconies: bool
    """Whether blocks of flats have balconies."""


@lru_cache(maxsize=512)
def style(identifier: int) -> BuildingStyle:
    """The style with this id in the pool."""
    rng = np.random.default_rng([0xB11D, identifier])
    return BuildingStyle(
        wall=(_PLASTER[rng.integers(len(_PLASTER))] * rng.uniform(0.75, 1.1) * rng.uniform(0.95, 1.05, 3)).astype(
            np.float32
        ),
        roof=(_ROOFS[rng.integers(len(_ROOFS))] * rng.uniform(0.8, 1.3)).astype(np.float32),
        pattern=(
            float(rng.uniform(2.2, 3.8)),
            float(rng.uniform(2.7, 3.3)),
            float(rng.uniform(0.34, 0.6)),
            float(rng.uniform(0.42, 0.6)),
        ),
        pitched=bool(rng.random() < 0.75),
        trim=(_TRIM[rng.integers(len(_TRIM))] * rng.uniform(0.7, 1.2)).astype(np.float32),
        shop=bool(rng.random() < 0.45),
        shutters=bool(rng.random() < 0.3),
        balconies=bool(rng.random() < 0.4),
    )


def building(
    identifier: int,
    length_m: float,
    depth_m: float,
    storeys: int,
    along: bool,
    front: float = 1.0,
    city: bool = False,
) -> Soup:
    """A building centred on the origin, standing on the ground, its long side along x.

    along: whether the ridge of a pitched roof runs along x; else gables face +z and -z. front: sign of z of the
    side with doors and fittings; 0: bare walls, for far away. city: whether it may have a shop or balconies.
    """
    building_style = style(identifier)
    rng = np.random.default_rng([0xB12, identifier, storeys])
    shop = city and building_style.shop and storeys > 1 and front != 0
    height = (
        storeys * building_style.pattern[1] + 0.5 + (_SHOP_M - 0.5 - building_style.pattern[1] if shop else 0.0)
    )
    parts = []
    for turn in range(4):
        wide, out = (length_m, depth_m / 2) if turn % 2 == 0 else (depth_m, length_m / 2)
        faces_street = front != 0 and turn == (0 if front > 0 else 2)
        wall = _wall(building_style, wide, height, shop and faces_street)
        if faces_street:
            wall += _fittings(
                building_style, (wide, height), storeys, shop, city and building_style.balconies, rng
            )
        at = {0: (0.0, 0.0, out), 1: (out, 0.0, 0.0), 2: (0.0, 0.0, -out), 3: (-out, 0.0, 0.0)}[turn]
        parts.append(placed(join(wall), at, turn * np.pi / 2, (1, 1, 1)))
    if building_style.pitched:
        parts += _gable(length_m, depth_m, height, building_style, along)
        span = depth_m if along else length_m
        if identifier % 3 != 1:
            chimney = box((0.7, height + 0.62 * span * 0.5 + 0.8, 0.6), Material.WALL, building_style.roof * 0.9)
            spot = (length_m * 0.22, 0.0, span * 0.08) if along else (span * 0.08, 0.0, depth_m * 0.22)
            parts.append(placed(chimney, spot, 0.0, (1, 1, 1)))
        if front:
            parts += _roof_fittings((length_m, depth_m), height, building_style, along, front, rng)
    else:
        rim = box((length_m + 0.3, 0.45, depth_m + 0.3), Material.WALL, building_style.wall * 0.7)
        parts.append(placed(rim, (0, -height + 0.02, 0), 0.0, (1, 1, 1)))
        hut = box((2.6, 1.7, 2.2), Material.WALL, building_style.wall * 0.6)
        parts.append(placed(hut, (length_m * float(rng.uniform(-0.25, 0.25)), -height, 0), 0.0, (1, 1, 1)))
    return join(parts)


_PANEL = np.array([[0, 1, 2], [0, 2, 3]])
_ACROSS, _UPWARDS = np.array([0, 1, 1, 0])[_PANEL], np.array([0, 0, 1, 1])[_PANEL]
"""Which end of a panel's extent in x and in y each corner of its two triangles takes."""


def _panels(x: np.ndarray, y: np.ndarray, z: float, material: int, albedo: np.ndarray) -> Soup:
    """Upright rectangles that face +z: x and height y (n, 2) from, to, m; z m."""
    x, y = np.atleast_2d(x), np.atleast_2d(y)
    n = len(x)
    points, uv = np.empty((n, 2, 3, 3), np.float32), np.empty((n, 2, 3, 2), np.float32)
    points[..., 0], points[..., 1], points[..., 2] = x[:, _ACROSS], -y[:, _UPWARDS], z
    uv[..., 0], uv[..., 1] = (x - x[:, :1])[:, _ACROSS], y[:, _UPWARDS]
    normals = np.zeros((2 * n, 3, 3), np.float32)
    normals[..., 2] = 1.0
    return make(points, material, albedo, normals, uv)


def _panel(x: tuple[float, float], y: tuple[float, float], z: float, material: int, albedo: np.ndarray) -> Soup:
    """One upright rectangle, as `_panels`."""
    return _panels(np.array(x), np.array(y), z, material, albedo)


def _copies(soup: Soup, at: np.ndarray) -> Soup:
    """Copies of a soup, moved by each of `at` (n, 3)."""
    many = soup.take(np.tile(np.arange(len(soup)), len(at)))
    return replace(many, corners=many.corners + np.repeat(at, len(soup), axis=0)[:, None].astype(np.float32))


def _windows(building_style: BuildingStyle, wide_m: float) -> tuple[int, float, float]:
    """Number of windows side by side on a wall, their pitch in metres, and their share of it: none is cut off."""
    number = max(int(wide_m / building_style.pattern[0] + 0.2), 1)
    pitch = wide_m / number
    return number, pitch, min(building_style.pattern[2] * building_style.pattern[0] / pitch, 0.62)


def _wall(building_style: BuildingStyle, wide_m: float, height_m: float, shop: bool) -> list[Soup]:
    """A wall with windows at z = 0 that faces +z, its foot's middle at the origin."""
    _, pitch, share = _windows(building_style, wide_m)
    low = _SHOP_M if shop else 0.0
    upper = _panel((-wide_m / 2, wide_m / 2), (low, height_m), 0.0, Material.FACADE, building_style.wall)
    upper.pattern[:] = (pitch, building_style.pattern[1], share, building_style.pattern[3])
    if not shop:
        return [upper]
    upper.uv[..., 1] += 0.5 - _SHOP_M
    panes = max(round(wide_m / 3.4), 1)
    lower = _panel((-wide_m / 2, wide_m / 2), (0.0, _SHOP_M), 0.0, Material.FACADE, building_style.wall * 0.6)
    lower.pattern[:] = (wide_m / panes, _SHOP_M - 0.5, 0.84, 0.8)
    return [upper, lower]


def _at(soup: Soup, x: float, y: float, z: float) -> Soup:
    """The soup moved."""
    return replace(soup, corners=soup.corners + np.array([x, y, z], np.float32))


def _fittings(
    building_style: BuildingStyle,
    size_m: tuple[float, float],
    storeys: int,
    shop: bool,
    balconies: bool,
    rng: np.random.Generator,
) -> list[Soup]:
    """What stands out of the wall towards the street: door, sills, shutters, balconies, sign, awning, downpipe."""
    wide, height = size_m
    number, pitch, share = _windows(building_style, wide)
    storey, tall = building_style.pattern[1], building_style.pattern[3]
    low = _SHOP_M - 0.5 if shop else 0.0
    middles = (np.arange(number) + 0.5) * pitch - wide / 2
    window = share * pitch
    door = int(rng.integers(number))
    parts = []
    blind = int(rng.integers(number)) if balconies and storeys > 2 else -1
    upper = 1 if shop else 0
    base = low + np.arange(storeys - upper) * storey + 0.5
    column, row = (g.reshape(-1) for g in np.meshgrid(np.arange(number), np.arange(storeys - upper)))
    if not shop:
        keep = (row > 0) | (column != door)
        column, row = column[keep], row[keep]
    x, bottom = middles[column], base[row] + storey * (0.5 - tall / 2)
    if len(x):
        sill = box((window + 0.24, 0.07, 0.16), Material.FLAT, np.full(3, 0.34))
        parts.append(_copies(sill, np.stack([x, 0.10 - bottom, np.full(len(x), 0.06)], axis=1)))
        top = bottom + storey * tall
        if building_style.shutters:
            near, far = window / 2 + 0.12, window / 2 + 0.12 + 0.45 * window
            spans = np.concatenate([x[:, None] + [near, far], x[:, None] - [far, near]])
            heights = np.tile(np.stack([bottom, top], axis=1), (2, 1))
            parts.append(_panels(spans, heights, 0.05, Material.FENCE, building_style.trim))
        # roller shutters, let down part of the way
        shut = rng.random(len(x)) < 0.14
        drop = rng.uniform(0.25, 1.0, len(x)) * storey * tall
        if shut.any():
            spans = x[shut, None] + [-window / 2, window / 2]
            roller = np.full(3, float(rng.uniform(0.25, 0.5)))
            parts.append(_panels(spans, np.stack([top - drop, top], 1)[shut], 0.03, Material.WALL, roller))
    if blind >= 0:
        one = join(_balcony(max(window + 0.9, 2.2), building_style))
        floors = base[1:] if not shop else base
        spots = np.stack([np.full(len(floors), middles[blind]), -floors, np.zeros(len(floors))], axis=1)
        parts.append(_copies(one, spots))
    if not shop:
        x = float(middles[door])
        surround = window / 2 + 0.22
        parts.append(
            _panel(
                (x - surround, x + surround),
                (0.0, 0.55 + storey * (0.5 + tall / 2)),
                0.03,
                Material.WALL,
                building_style.wall * 0.8,
            )
        )
        parts.append(_panel((x - 0.62, x + 0.62), (0.0, 2.35), 0.05, Material.FLAT, np.full(3, 0.4)))
        parts.append(_panel((x - 0.52, x + 0.52), (0.1, 2.25), 0.06, Material.FLAT, building_style.trim))
        parts.append(_panel((x - 0.3, x + 0.3), (1.2, 2.05), 0.07, Material.GLASS, np.full(3, 0.03)))
        parts.append(_at(box((1.5, 0.14, 1.1), Material.WALL, np.full(3, 0.2)), x, 0.0, 0.5))
        if rng.random() < 0.6:
            parts.append(_at(box((1.8, 0.12, 1.0), Material.FLAT, building_style.roof), x, -2.6, 0.5))
    else:
        parts += _shop(building_style, wide, rng)
    pipe = float(rng.choice([-1.0, 1.0])) * (wide / 2 - 0.25)
    parts.append(stick((pipe, 0, 0.1), (pipe, -height + 0.1, 0.1), (0.05, 0.05), Material.METAL, _STEEL, 4))
    return parts


def _balcony(wide_m: float, building_style: BuildingStyle) -> list[Soup]:
    """A slab and a parapet of sheet metal or bars."""
    slab = _at(box((wide_m, 0.16, 1.3), Material.WALL, building_style.wall * 0.8), 0.0, 0.05, 0.65)
    front = _at(box((wide_m, 0.85, 0.05), Material.FENCE, building_style.trim * 1.3), 0.0, -0.16, 1.25)
    ends = [
        _at(box((0.05, 0.85, 1.25), Material.FENCE, building_style.trim * 1.3), s * wide_m / 2, -0.16, 0.62)
        for s in (-1.0, 1.0)
    ]
    return [slab, front, *ends]


def _shop(building_style: BuildingStyle, wide_m: float, rng: np.random.Generator) -> list[Soup]:
    """A sign with letters over the panes, perhaps an awning."""
    board = building_style.trim * float(rng.uniform(0.8, 2.2))
    low = _SHOP_M - 0.72
    parts = [_at(box((wide_m - 0.5, 0.6, 0.1), Material.FLAT, board), 0.0, -low, 0.05)]
    ink = np.full(3, 0.5) if board.mean() < 0.15 else np.full(3, 0.03)
    width = rng.uniform(0.12, 0.3, 24)
    ends = np.cumsum(width + rng.uniform(0.05, 0.1, 24) + 0.3 * (rng.random(24) < 0.12)) - 0.35 * wide_m
    ends = ends[ends < 0.35 * wide_m]
    if len(ends):
        spans = np.stack([ends - width[: len(ends)], ends], axis=1)
        heights = np.stack([np.full(len(ends), low + 0.15), low + rng.choice([0.36, 0.45], len(ends))], axis=1)
        parts.append(_panels(spans, heights, 0.115, Material.FLAT, ink))
    if rng.random() < 0.45:
        stripes = max(int(wide_m / 0.45), 4)
        edges = np.linspace(-wide_m / 2 + 0.4, wide_m / 2 - 0.4, stripes + 1)
        reach = float(rng.uniform(0.9, 1.4))
        plain = rng.random() < 0.5
        normal = np.array([0.0, -reach, 0.6]) / np.hypot(reach, 0.6)
        a, b = edges[:-1], edges[1:]
        flat = np.full(stripes, 1.0)
        points = np.stack(
            [
                np.stack([x, -low * flat + fall, out * flat], axis=1)
                for x, fall, out in ((a, 0.0, 0.1), (b, 0.0, 0.1), (b, 0.6, reach), (a, 0.6, reach))
            ],
            axis=1,
        )
        cloth = make(
            points[:, _PANEL].reshape(-1, 3, 3),
            Material.CLOTH,
            building_style.trim * 1.8,
            np.broadcast_to(normal, (2 * stripes, 3, 3)),
        )
        if not plain:
            cloth.albedo[np.arange(2 * stripes) % 4 < 2] = 0.5
        parts.append(tagged(cloth, Semantic.BUILDING))
    return parts


def _roof_fittings(
    plan_m: tuple[float, float],
    height: float,
    building_style: BuildingStyle,
    along: bool,
    front: float,
    rng: np.random.Generator,
) -> list[Soup]:
    """Gutters along the eaves; dormers or skylights on the slope towards the street; an attic window in gables."""
    long, short = plan_m if along else plan_m[::-1]
    rise, eave = 0.42 * short, 0.45
    slope = rise / (short / 2)
    drop = eave * slope
    parts = []
    for sign in (-1.0, 1.0):
        gutter = box((long + 2 * eave, 0.13, 0.13), Material.METAL, _STEEL)
        parts.append(_at(gutter, 0.0, -height + drop + 0.06, sign * (short / 2 + eave + 0.02)))
    if along:
        draw = rng.random()
        spots = np.linspace(-0.5, 0.5, int(rng.integers(2, 4)) + 2)[1:-1] * long
        at = 0.55
        z, y = front * at * short / 2, height + (1 - at) * rise
        for x in spots:
            if draw < 0.3:
                dormer = _at(
                    box((1.5, 1.35, 1.6), Material.WALL, building_style.wall),
                    float(x),
                    -y + 0.25,
                    z - front * 0.35,
                )
                lid = _at(
                    box((1.9, 0.12, 2.1), Material.FLAT, building_style.roof), float(x), -y - 1.1, z - front * 0.35
                )
                pane = _panel((-0.5, 0.5), (0.15, 1.0), 0.46, Material.GLASS, np.full(3, 0.03))
                turned = placed(
                    pane,
                    (float(x), -y + 0.25, z - front * 0.35 + front * 0.36),
                    0.0 if front > 0 else np.pi,
                    (1, 1, 1),
                )
                parts += [dormer, lid, turned]
            elif draw < 0.6:
                parts.append(_skylight(float(x), (z, -y), slope, front))
    else:
        for sign in (-1.0, 1.0):
            window = [
                _panel((-0.75, 0.75), (height + 0.25, height + 1.45), 0.02, Material.FLAT, np.full(3, 0.45)),
                _panel((-0.65, 0.65), (height + 0.33, height + 1.37), 0.03, Material.GLASS, np.full(3, 0.03)),
            ]
            if rise > 2.2:
                parts.append(placed(join(window), (sign * long / 2, 0, 0), sign * np.pi / 2, (1, 1, 1)))
    return parts if along else [placed(p, (0, 0, 0), np.pi / 2, (1, 1, 1)) for p in parts]


def _skylight(x: float, spot: tuple[float, float], slope: float, front: float) -> Soup:
    """A window flush with the roof."""
    z, y = spot
    up = np.array([0.0, -slope, -front]) / np.hypot(slope, 1.0)
    out = np.array([0.0, -1.0, front * slope]) / np.hypot(slope, 1.0)
    middle = np.array([x, y, z]) + out * 0.05
    corners = [middle + a * np.array([0.45, 0, 0]) + b * 0.6 * up for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return make(quad(np.array(corners)), Material.GLASS, (0.03, 0.03, 0.03), np.broadcast_to(out, (2, 3, 3)))


def _gable(
    length_m: float, depth_m: float, height: float, building_style: BuildingStyle, along: bool
) -> list[Soup]:
    """A saddle roof with eaves, and its two gable walls."""
    long, short = (length_m, depth_m) if along else (depth_m, length_m)
    rise, eave = 0.42 * short, 0.45
    drop = eave * rise / (short / 2)
    half, low, high = short / 2 + eave, -height + drop, -height - rise
    ends = (long / 2 + eave, -long / 2 - eave)
    roofs, gables = [], []
    for sign in (1.0, -1.0):
        points = np.array(
            [[ends[0], low, sign * half], [ends[1], low, sign * half], [ends[1], high, 0], [ends[0], high, 0]]
        )
        uv = np.array([[ends[0], 0], [ends[1], 0], [ends[1], short * 0.65], [ends[0], short * 0.65]])
        normal = np.array([0, -short / 2, sign * rise])
        normal /= np.linalg.norm(normal)
        roofs.append(
            make(quad(points), Material.ROOF, building_style.roof, np.broadcast_to(normal, (2, 3, 3)), quad(uv))
        )
        gable = np.array(
            [
                [sign * long / 2, -height, short / 2],
                [sign * long / 2, -height, -short / 2],
                [sign * long / 2, high, 0],
            ]
        )
        normal = np.array([sign, 0.0, 0.0])
        gables.append(make(gable[None], Material.WALL, building_style.wall, np.broadcast_to(normal, (1, 3, 3))))
    parts = roofs + gables
    return parts if along else [placed(p, (0, 0, 0), np.pi / 2, (1, 1, 1)) for p in parts]


def garden_wall(length_m: float, height_m: float, material: int, albedo: np.ndarray) -> Soup:
    """A wall or fence along x, 0.2 m thick (fences 0.06 m)."""
    thickness = 0.06 if material == Material.FENCE else 0.2
    return box((length_m, height_m, thickness), material, albedo)


def railing(length_m: float, height_m: float, albedo: np.ndarray) -> Soup:
    """A fence of iron bars along x."""
    bars = np.arange(-length_m / 2 + 0.1, length_m / 2, 0.16)
    parts = [
        _at(box((length_m, 0.05, 0.04), Material.METAL, albedo), 0.0, -y, 0.0) for y in (0.12, height_m - 0.05)
    ]
    n = len(bars)
    x = np.stack([bars - 0.012, bars + 0.012, bars + 0.012, bars - 0.012], axis=1)
    y = np.broadcast_to([0.0, 0.0, -height_m, -height_m], (n, 4))
    faces = np.stack([x, y, np.zeros((n, 4))], axis=2)[:, np.array([[0, 1, 2], [0, 2, 3]])]
    parts.append(make(faces.reshape(-1, 3, 3), Material.METAL, albedo))
    return join(parts)
