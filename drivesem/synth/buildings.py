"""Houses, blocks of flats, garden walls and fences. Each style has an id in a pool."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from drivesem.synth.soup import Material, Soup, box, join, make, placed, quad

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


@dataclass(frozen=True, slots=True)
class BuildingStyle:
    """Look of one building. wall, roof: linear albedo. pattern: window pitch and storey height in metres, and the
    window's share of both. offset_m: by which windows are shifted along the wall. pitched: roof form.
    """

    wall: np.ndarray
    roof: np.ndarray
    pattern: tuple[float, float, float, float]
    offset_m: float
    pitched: bool


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
        offset_m=0.37 if rng.random() < 0.35 else 0.0,
        pitched=bool(rng.random() < 0.75),
    )


def building(identifier: int, length_m: float, depth_m: float, storeys: int, along: bool) -> Soup:
    """A building centred on the origin, standing on the ground, its long side along x.

    along: whether the ridge of a pitched roof runs along x; else gables face +z and -z.
    """
    look = style(identifier)
    height = storeys * look.pattern[1] + 0.5
    body = box((length_m, height, depth_m), Material.FACADE, look.wall, look.pattern)
    body.uv[..., 0] += look.offset_m
    parts = [body]
    if look.pitched:
        parts += _gable(length_m, depth_m, height, look, along)
        if identifier % 3 == 0:
            chimney = box((0.7, height + 0.62 * depth_m * 0.5 + 0.8, 0.7), Material.WALL, look.roof * 0.9)
            parts.append(placed(chimney, (length_m * 0.22, 0.0, 0.0), 0.0, (1, 1, 1)))
    else:
        rim = box((length_m + 0.3, 0.45, depth_m + 0.3), Material.WALL, look.wall * 0.7)
        parts.append(placed(rim, (0, -height + 0.02, 0), 0.0, (1, 1, 1)))
    return join(parts)


def _gable(length_m: float, depth_m: float, height: float, look: BuildingStyle, along: bool) -> list[Soup]:
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
        roofs.append(make(quad(points), Material.ROOF, look.roof, np.broadcast_to(normal, (2, 3, 3)), quad(uv)))
        gable = np.array(
            [
                [sign * long / 2, -height, short / 2],
                [sign * long / 2, -height, -short / 2],
                [sign * long / 2, high, 0],
            ]
        )
        normal = np.array([sign, 0.0, 0.0])
        gables.append(make(gable[None], Material.WALL, look.wall, np.broadcast_to(normal, (1, 3, 3))))
    parts = roofs + gables
    return parts if along else [placed(p, (0, 0, 0), np.pi / 2, (1, 1, 1)) for p in parts]


def garden_wall(length_m: float, height_m: float, material: int, albedo: np.ndarray) -> Soup:
    """A wall or fence along x, 0.2 m thick (fences 0.06 m)."""
    thickness = 0.06 if material == Material.FENCE else 0.2
    return box((length_m, height_m, thickness), material, albedo)
