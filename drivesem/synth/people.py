"""Simple articulated people and cyclists for training scenes, built from tubes and balls."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from drivesem.synth.soup import Material, Soup, ball, join, stick

_SKIN = np.array([[0.50, 0.30, 0.20], [0.62, 0.40, 0.29], [0.28, 0.15, 0.09], [0.42, 0.25, 0.16]], np.float32)
_CLOTH = np.array(
    [
        [0.02, 0.02, 0.025], [0.04, 0.06, 0.14], [0.35, 0.05, 0.05], [0.55, 0.55, 0.52], [0.12, 0.12, 0.12],
        [0.07, 0.12, 0.22], [0.30, 0.26, 0.18], [0.10, 0.18, 0.10], [0.45, 0.30, 0.10], [0.25, 0.27, 0.30],
    ],
    np.float32,
)  # fmt: skip
_HAIR = np.array([[0.02, 0.015, 0.01], [0.10, 0.06, 0.03], [0.30, 0.22, 0.12], [0.35, 0.34, 0.33]], np.float32)


def _pick(pool: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return (pool[rng.integers(len(pool))] * rng.uniform(0.75, 1.25)).astype(np.float32)


def _limb(points: list[np.ndarray], radii: tuple[float, ...], albedo: np.ndarray) -> list[Soup]:
    parts = [
        stick(a, b, (r0, r1), Material.CLOTH, albedo, 6)
        for a, b, r0, r1 in zip(points[:-1], points[1:], radii[:-1], radii[1:], strict=True)
    ]
    return parts + [
        ball(p, (r, r, r), Material.CLOTH, albedo, 0) for p, r in zip(points[1:], radii[1:], strict=True)
    ]


def _swing(top: np.ndarray, angles: tuple[float, float], lengths: tuple[float, float]) -> list[np.ndarray]:
    """Hip, knee and foot (or shoulder, elbow, hand): angles from straight down towards +x (the front)."""
    points = [top]
    for angle, length in zip(angles, lengths, strict=True):
        points.append(points[-1] + length * np.array([np.sin(angle), np.cos(angle), 0.0]))
    return points


def _body(hip: np.ndarray, lean: float, colours: tuple[np.ndarray, ...]) -> tuple[list[Soup], np.ndarray]:
    """Torso, neck and head over the hip; returns them and the middle of the shoulders."""
    shirt, skin, hair = colours
    up = np.array([np.sin(lean), -np.cos(lean), 0.0])
    neck = hip + up * 0.56
    chest, waist = hip + up * 0.40, hip + up * 0.20
    head = neck + up * 0.15 + np.array([0.02, 0, 0])
    parts = [
        ball(hip + up * 0.06, (0.125, 0.16, 0.17), Material.CLOTH, shirt, 1),
        ball(waist, (0.115, 0.22, 0.155), Material.CLOTH, shirt, 1),
        ball(chest, (0.125, 0.19, 0.19), Material.CLOTH, shirt, 1),
        ball(hip + up * 0.49, (0.075, 0.065, 0.215), Material.CLOTH, shirt, 1),
        stick(neck - up * 0.06, head, (0.06, 0.055), Material.CLOTH, skin),
        ball(head, (0.1, 0.125, 0.08), Material.CLOTH, skin, 1),
        ball(head + up * 0.035 - np.array([0.025, 0, 0]), (0.1, 0.11, 0.088), Material.CLOTH, hair, 1),
    ]
    return parts, hip + up * 0.5


def pedestrian(rng: np.random.Generator) -> Soup:
    """A person 1.75 m tall facing +x, feet on the ground, standing or walking, in random clothes."""
    shirt, trousers, skin, hair = _pick(_CLOTH, rng), _pick(_CLOTH, rng), _pick(_SKIN, rng), _pick(_HAIR, rng)
    shoes = np.full(3, 0.03, np.float32)
    stride = float(rng.choice([0.08, 0.35, 0.5])) * float(rng.uniform(0.7, 1.1))
    hip = np.array([0.0, -0.93 + 0.10 * stride, 0.0])
    parts, shoulder = _body(hip, float(rng.uniform(0.0, 0.12)), (shirt, skin, hair))
    bare = rng.random() < 0.35
    for side in (-1.0, 1.0):
        swing = side * stride
        start = hip + np.array([0, 0, side * 0.095])
        leg = _swing(start, (swing, swing - (0.35 if swing < 0 else 0.05)), (0.45, 0.42))
        parts += _limb(leg, (0.09, 0.062, 0.045), trousers)
        parts.append(ball(leg[-1] + np.array([0.06, 0.02, 0]), (0.13, 0.05, 0.05), Material.CLOTH, shoes, 1))
        start = shoulder + np.array([0, 0, side * 0.205])
        arm = _swing(start, (-swing * 0.9, -swing * 0.9 + 0.3), (0.29, 0.27))
        parts += _limb(arm, (0.06, 0.048, 0.04), skin if bare else shirt)
        parts.append(ball(arm[-1], (0.05, 0.06, 0.04), Material.CLOTH, skin, 0))
    if rng.random() < 0.3:
        parts.append(
            ball(shoulder + np.array([-0.16, 0.2, 0]), (0.11, 0.22, 0.15), Material.CLOTH, _pick(_CLOTH, rng))
        )
    return join(parts)


def _wheel(centre: np.ndarray, radius: float) -> list[Soup]:
    rubber, steel = np.full(3, 0.02, np.float32), np.full(3, 0.35, np.float32)
    angle = np.linspace(0, 2 * np.pi, 15)
    rim = centre + np.stack([np.cos(angle) * radius, np.sin(angle) * radius, np.zeros(15)], axis=1)
    parts = [stick(a, b, (0.022, 0.022), Material.CLOTH, rubber, 5) for a, b in pairwise(rim)]
    spokes = rim[:-1:2]
    return parts + [stick(centre, s, (0.006, 0.006), Material.METAL, steel, 3) for s in spokes]


def bicycle(rng: np.random.Generator) -> Soup:
    """A bicycle 1.75 m long along x, wheels on the ground."""
    paint = _pick(_CLOTH, rng)
    back, front = np.array([-0.53, -0.34, 0.0]), np.array([0.53, -0.34, 0.0])
    crank, seat, head = np.array([-0.06, -0.30, 0]), np.array([-0.2, -0.85, 0]), np.array([0.36, -0.82, 0])
    bar = head + np.array([0.03, -0.18, 0])
    tubes = ((crank, seat), (crank, head), (seat, head), (seat, back), (crank, back), (bar, front))
    parts = [stick(a, b, (0.02, 0.02), Material.CLOTH, paint, 5) for a, b in tubes]
    parts.append(
        stick(
            bar - np.array([0.05, 0, 0.26]),
            bar + np.array([-0.05, 0, 0.26]),
            (0.015, 0.015),
            Material.CLOTH,
            paint * 0.2,
            5,
        )
    )
    parts.append(
        ball(seat - np.array([0, 0.06, 0]), (0.13, 0.035, 0.07), Material.CLOTH, np.full(3, 0.02, np.float32), 1)
    )
    return join([*parts, *_wheel(back, 0.33), *_wheel(front, 0.33)])


def cyclist(rng: np.random.Generator) -> Soup:
    """A person riding a bicycle along +x, wheels on the ground, 1.75 m tall in all."""
    shirt, trousers, skin, hair = _pick(_CLOTH, rng), _pick(_CLOTH, rng), _pick(_SKIN, rng), _pick(_HAIR, rng)
    hip = np.array([-0.2, -0.97, 0.0])
    parts, shoulder = _body(hip, float(rng.uniform(0.3, 0.65)), (shirt, skin, hair))
    phase = float(rng.uniform(0, 2 * np.pi))
    for side in (-1.0, 1.0):
        angle = phase if side > 0 else phase + np.pi
        foot = np.array([-0.06 + 0.16 * np.cos(angle), -0.27 + 0.16 * np.sin(angle), side * 0.11])
        start = hip + np.array([0.03, 0.02, side * 0.1])
        middle = (start + foot) / 2
        bend = np.sqrt(max(0.44**2 - float(((foot - start) ** 2).sum()) / 4, 0.0025))
        knee = middle + bend * np.array([0.9, -0.35, 0.0])
        parts += _limb([start, knee, foot], (0.09, 0.065, 0.045), trousers)
        parts.append(
            ball(foot + np.array([0.05, 0.02, 0]), (0.12, 0.045, 0.045), Material.CLOTH, trousers * 0.3, 1)
        )
        hand = np.array([0.35, -1.0, side * 0.24])
        start = shoulder + np.array([0, 0, side * 0.19])
        elbow = (start + hand) / 2 + np.array([-0.02, 0.1, side * 0.04])
        parts += _limb([start, elbow, hand], (0.06, 0.048, 0.04), shirt)
    return join([bicycle(rng), *parts])
