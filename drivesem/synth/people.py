"""Simple articulated people and riders for training scenes, built from tubes and balls.

Varied people also wear coats, skirts, hats and long hair, carry bags, push prams, hold their arms in other ways, and
ride motorcycles.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from drivesem.synth.soup import Material, Soup, ball, join, placed, stick

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


def _head(hip: np.ndarray, lean: float) -> np.ndarray:
    """The middle of the head of `_body`."""
    return hip + np.array([np.sin(lean), -np.cos(lean), 0.0]) * 0.71 + np.array([0.02, 0, 0])


def _headwear(rng: np.random.Generator, hip: np.ndarray, lean: float, hair: np.ndarray) -> list[Soup]:
    """Long hair, a cap, a hat, a hood, or none of them, on the head of `_body`."""
    up = np.array([np.sin(lean), -np.cos(lean), 0.0])
    head, cloth = _head(hip, lean), _pick(_CLOTH, rng)
    match int(rng.integers(5)):
        case 0:
            return [ball(head - up * 0.06 - np.array([0.06, 0, 0]), (0.07, 0.17, 0.1), Material.CLOTH, hair, 1)]
        case 1:
            peak = ball(head + up * 0.05 + np.array([0.1, 0, 0]), (0.08, 0.015, 0.07), Material.CLOTH, cloth, 0)
            return [ball(head + up * 0.06, (0.11, 0.085, 0.095), Material.CLOTH, cloth, 1), peak]
        case 2:
            brim = ball(head + up * 0.06, (0.17, 0.02, 0.16), Material.CLOTH, cloth, 1)
            return [ball(head + up * 0.09, (0.11, 0.08, 0.1), Material.CLOTH, cloth, 1), brim]
        case 3:
            return [ball(head - np.array([0.03, 0, 0]), (0.115, 0.145, 0.115), Material.CLOTH, cloth, 1)]
        case _:
            return []


def _long_garment(rng: np.random.Generator, hip: np.ndarray, colours: tuple[np.ndarray, ...]) -> list[Soup]:
    """A coat in the shirt's colour, or a skirt in the trousers', to somewhere between thigh and ankle; or neither."""
    shirt, trousers = colours
    kind = int(rng.integers(5))
    if kind > 1:
        return []
    hem = hip + np.array([0, float(rng.uniform(0.2, 0.8)), 0])
    radii = (0.155, float(rng.uniform(0.17, 0.27)))
    return [stick(hip - np.array([0, 0.12, 0]), hem, radii, Material.CLOTH, (shirt, trousers)[kind], 10)]


def _bags(rng: np.random.Generator, hip: np.ndarray, shoulder: np.ndarray, hands: list[np.ndarray]) -> list[Soup]:
    """A rucksack, a bag at the hip, bags in one or both hands, or none."""
    colour, kind, side = _pick(_CLOTH, rng), int(rng.integers(5)), float(rng.choice([-1.0, 1.0]))
    if kind == 0:
        radii = (float(rng.uniform(0.08, 0.17)), float(rng.uniform(0.18, 0.3)), 0.16)
        return [ball(shoulder + np.array([-0.17, 0.22, 0]), radii, Material.CLOTH, colour, 1)]
    if kind == 1:
        bag = hip + np.array([float(rng.uniform(-0.15, 0.1)), float(rng.uniform(-0.05, 0.15)), side * 0.24])
        strap = stick(shoulder - np.array([0, 0.03, side * 0.1]), bag, (0.012, 0.012), Material.CLOTH, colour, 4)
        radii = (float(rng.uniform(0.1, 0.2)), float(rng.uniform(0.1, 0.18)), 0.06)
        return [strap, ball(bag, radii, Material.CLOTH, colour, 1)]
    if kind < 4:
        held = hands if kind == 2 else [hands[int(rng.integers(2))]]
        radii = (float(rng.uniform(0.1, 0.19)), float(rng.uniform(0.12, 0.22)), float(rng.uniform(0.04, 0.09)))
        return [ball(hand + np.array([0, radii[1] + 0.05, 0]), radii, Material.CLOTH, colour, 1) for hand in held]
    return []


_HANDLE = np.array([0.40, -1.02, 0.0])
"""Middle of a pram's handle, m before the feet of who pushes it."""
PRAM_LENGTH_M = 1.75
"""Length of a person 1.75 m tall with a pram."""
_BEFORE_PRAM_M = 0.5
"""How far who pushes a pram is behind the middle of both."""


def _pram(rng: np.random.Generator) -> list[Soup]:
    """A pram with a hood or a pushchair with a seat, at `_HANDLE`, wheels on the ground."""
    cloth, lining = _pick(_CLOTH, rng), _pick(_CLOTH, rng)
    rubber, steel = np.full(3, 0.02, np.float32), np.full(3, 0.25, np.float32)
    radius, half = float(rng.uniform(0.08, 0.15)), float(rng.uniform(0.2, 0.26))
    lying = rng.random() < 0.5
    across = np.array([0.0, 0.0, half])
    parts = [stick(_HANDLE - across, _HANDLE + across, (0.018, 0.018), Material.CLOTH, rubber, 5)]
    for side in (-across, across):
        back, front = np.array([0.62, -radius, 0.0]) + side, np.array([1.08, -radius, 0.0]) + side
        knee = np.array([0.72, -0.52, 0.0]) + side
        for start, end in ((_HANDLE + side, knee), (knee, front), (knee, back)):
            parts.append(stick(start, end, (0.014, 0.014), Material.METAL, steel, 4))
        parts += [ball(wheel, (radius, radius, 0.025), Material.CLOTH, rubber, 1) for wheel in (back, front)]
    width = half - 0.02
    if lying:
        hood = np.array([float(rng.choice([0.68, 1.02])), -0.82, 0.0])
        parts.append(ball(np.array([0.85, -0.66, 0.0]), (0.40, 0.16, width), Material.CLOTH, cloth, 1))
        parts.append(ball(hood, (0.24, 0.26, width), Material.CLOTH, lining, 1))
    else:
        seat, top = np.array([0.92, -0.48, 0.0]), np.array([0.66, -0.98, 0.0])
        parts.append(ball(seat, (0.22, 0.09, width), Material.CLOTH, cloth, 1))
        parts.append(stick(seat - np.array([0.1, 0, 0]), top, (width, width * 0.9), Material.CLOTH, cloth, 8))
        parts.append(ball(top + np.array([0.12, 0.0, 0.0]), (0.24, 0.12, width), Material.CLOTH, lining, 1))
        parts.append(ball(seat + np.array([0.0, -0.22, 0.0]), (0.11, 0.17, 0.12), Material.CLOTH, lining, 1))
    return parts


def pedestrian(rng: np.random.Generator, varied: bool = False, pram: bool = False) -> Soup:
    """A person 1.75 m tall facing +x, feet on the ground, standing or walking, in random clothes.

    pram: pushes one; then the origin is below the middle of both.
    """
    shirt, trousers, skin, hair = _pick(_CLOTH, rng), _pick(_CLOTH, rng), _pick(_SKIN, rng), _pick(_HAIR, rng)
    shoes = np.full(3, 0.03, np.float32)
    stride = float(rng.choice([0.08, 0.35, 0.5])) * float(rng.uniform(0.7, 1.1))
    hip = np.array([0.0, -0.93 + 0.10 * stride, 0.0])
    lean = float(rng.uniform(0.0, 0.12))
    parts, shoulder = _body(hip, lean, (shirt, skin, hair))
    bare = rng.random() < 0.35
    hands = []
    for side in (-1.0, 1.0):
        swing = side * stride
        start = hip + np.array([0, 0, side * 0.095])
        leg = _swing(start, (swing, swing - (0.35 if swing < 0 else 0.05)), (0.45, 0.42))
        parts += _limb(leg, (0.09, 0.062, 0.045), trousers)
        parts.append(ball(leg[-1] + np.array([0.06, 0.02, 0]), (0.13, 0.05, 0.05), Material.CLOTH, shoes, 1))
        start = shoulder + np.array([0, 0, side * 0.205])
        bend = float(rng.uniform(0.1, 2.2)) if varied and rng.random() < 0.5 else 0.3
        arm = _swing(start, (-swing * 0.9, -swing * 0.9 + bend), (0.29, 0.27))
        if pram:
            reach = _HANDLE + np.array([0.0, 0.0, side * 0.17])
            arm = [start, (start + reach) / 2 + np.array([-0.05, 0.08, side * 0.03]), reach]
        hands.append(arm[-1])
        parts += _limb(arm, (0.06, 0.048, 0.04), skin if bare else shirt)
        parts.append(ball(arm[-1], (0.05, 0.06, 0.04), Material.CLOTH, skin, 0))
    if varied:
        parts += _headwear(rng, hip, lean, hair) + _long_garment(rng, hip, (shirt, trousers))
        parts += _bags(rng, hip, shoulder, hands)
    elif rng.random() < 0.3:
        parts.append(
            ball(shoulder + np.array([-0.16, 0.2, 0]), (0.11, 0.22, 0.15), Material.CLOTH, _pick(_CLOTH, rng))
        )
    if pram:
        return placed(join([*parts, *_pram(rng)]), (-_BEFORE_PRAM_M, 0.0, 0.0), 0.0, (1.0, 1.0, 1.0))
    return join(parts)


def _wheel(centre: np.ndarray, radius: float, tyre: float = 0.022) -> list[Soup]:
    rubber, steel = np.full(3, 0.02, np.float32), np.full(3, 0.35, np.float32)
    angle = np.linspace(0, 2 * np.pi, 15)
    rim = centre + np.stack([np.cos(angle) * radius, np.sin(angle) * radius, np.zeros(15)], axis=1)
    parts = [stick(a, b, (tyre, tyre), Material.CLOTH, rubber, 5) for a, b in pairwise(rim)]
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


def motorcycle(rng: np.random.Generator) -> Soup:
    """A motorcycle or scooter about 2 m long along x, wheels on the ground."""
    paint, dark, steel = _pick(_CLOTH, rng), np.full(3, 0.03, np.float32), np.full(3, 0.4, np.float32)
    radius = float(rng.uniform(0.22, 0.32))
    back, front = np.array([-0.66, -radius, 0.0]), np.array([0.66, -radius, 0.0])
    bar = np.array([0.40, -1.02, 0])
    parts = [
        ball(np.array([0.12, -0.78, 0]), (0.3, 0.15, 0.15), Material.CLOTH, paint, 1),
        ball(np.array([-0.35, -0.74, 0]), (0.42, 0.08, 0.14), Material.CLOTH, dark, 1),
        ball(np.array([0.0, -0.42, 0]), (0.33, 0.24, 0.17), Material.CLOTH, dark, 1),
        ball(np.array([0.48, -0.86, 0]), (0.11, 0.12, 0.13), Material.CLOTH, paint, 1),
        stick(np.array([-0.02, -0.45, 0]), back, (0.07, 0.05), Material.CLOTH, dark, 6),
        stick(bar, front, (0.045, 0.045), Material.CLOTH, dark, 6),
        stick(
            bar - np.array([0.05, 0, 0.33]), bar + np.array([-0.05, 0, 0.33]), (0.018, 0.018), Material.CLOTH, dark
        ),
        stick(np.array([0.0, -0.3, 0.18]), np.array([-0.75, -0.38, 0.2]), (0.05, 0.06), Material.METAL, steel, 6),
    ]
    if rng.random() < 0.4:
        parts.append(ball(np.array([0.3, -0.5, 0]), (0.08, 0.38, 0.2), Material.CLOTH, paint, 1))  # leg shield
    if rng.random() < 0.3:
        parts.append(ball(np.array([-0.75, -0.95, 0]), (0.18, 0.16, 0.19), Material.CLOTH, dark, 1))  # top box
    return join([*parts, *_wheel(back, radius, 0.055), *_wheel(front, radius, 0.055)])


def cyclist(rng: np.random.Generator, varied: bool = False) -> Soup:
    """A person riding a bicycle, or if varied perhaps a motorcycle, along +x, wheels on the ground, 1.75 m tall."""
    shirt, trousers, skin, hair = _pick(_CLOTH, rng), _pick(_CLOTH, rng), _pick(_SKIN, rng), _pick(_HAIR, rng)
    motor = varied and rng.random() < 0.35
    hip = np.array([-0.2, -0.86 if motor else -0.97, 0.0])
    lean = float(rng.uniform(0.0, 0.4) if motor else rng.uniform(0.3, 0.65))
    parts, shoulder = _body(hip, lean, (shirt, skin, hair))
    if motor:
        parts.append(ball(_head(hip, lean), (0.14, 0.15, 0.125), Material.CLOTH, _pick(_CLOTH, rng), 1))
    elif varied:
        parts += _headwear(rng, hip, lean, hair)
    if varied and rng.random() < 0.3:
        parts.append(
            ball(shoulder + np.array([-0.2, 0.1, 0]), (0.14, 0.2, 0.16), Material.CLOTH, _pick(_CLOTH, rng), 1)
        )
    phase = float(rng.uniform(0, 2 * np.pi))
    for side in (-1.0, 1.0):
        angle = phase if side > 0 else phase + np.pi
        foot = np.array([-0.06 + 0.16 * np.cos(angle), -0.27 + 0.16 * np.sin(angle), side * 0.11])
        if motor:
            foot = np.array([0.02, -0.27, side * 0.22])
        start = hip + np.array([0.03, 0.02, side * 0.1])
        middle = (start + foot) / 2
        bend = np.sqrt(max(0.44**2 - float(((foot - start) ** 2).sum()) / 4, 0.0025))
        knee = middle + bend * np.array([0.9, -0.35, 0.0])
        parts += _limb([start, knee, foot], (0.09, 0.065, 0.045), trousers)
        parts.append(
            ball(foot + np.array([0.05, 0.02, 0]), (0.12, 0.045, 0.045), Material.CLOTH, trousers * 0.3, 1)
        )
        hand = np.array([0.35, -1.02 if motor else -1.0, side * (0.31 if motor else 0.24)])
        start = shoulder + np.array([0, 0, side * 0.19])
        elbow = (start + hand) / 2 + np.array([-0.02, 0.1, side * 0.04])
        parts += _limb([start, elbow, hand], (0.06, 0.048, 0.04), shirt)
    return join([motorcycle(rng) if motor else bicycle(rng), *parts])
