"""Street furniture: lamps, signs, traffic lights, shelters, bins, and objects similar to vehicles."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from drivesem.synth import people
from drivesem.synth.soup import Material, Semantic, Soup, ball, box, join, make, placed, quad, stick, tagged

_GREY = np.array([0.20, 0.21, 0.22])
_WHITE, _BLACK = np.array([0.58, 0.58, 0.57]), np.array([0.015, 0.015, 0.015])
_RED, _BLUE, _YELLOW = np.array([0.42, 0.02, 0.02]), np.array([0.02, 0.07, 0.36]), np.array([0.60, 0.40, 0.02])
_BOXES = np.array(
    [
        [0.05, 0.05, 0.055], [0.12, 0.16, 0.10], [0.30, 0.30, 0.29], [0.35, 0.20, 0.05], [0.03, 0.06, 0.15],
        [0.30, 0.04, 0.04], [0.02, 0.02, 0.02], [0.10, 0.055, 0.03],
    ]
)  # fmt: skip
"""Linear albedo of bins, containers and sheds."""


def _moved(soup: Soup, x: float, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Soup:
    return placed(soup, (x, y, z), yaw, (1, 1, 1))


def lamp(height_m: float, side: int) -> Soup:
    """A street lamp with an arm over the road: side -1 for the left of the road, 1 for the right."""
    pole = stick((0, 0, 0), (0, -height_m, 0), (0.09, 0.05), Material.METAL, _GREY, 8)
    foot = stick((0, 0, 0), (0, -1.1, 0), (0.11, 0.11), Material.METAL, _GREY * 0.9, 8)
    top = (0, -height_m - 0.35, side * 1.8)
    arm = stick((0, -height_m, 0), top, (0.04, 0.03), Material.METAL, _GREY, 5)
    head = ball((0, -height_m - 0.38, side * 2.0), (0.14, 0.07, 0.35), Material.METAL, _GREY * 1.3, 1)
    head.pattern[:, 2] = 1.0
    return join([pole, foot, arm, head])


def _outline(sides: int, size: float, turn: float) -> np.ndarray:
    angle = np.arange(sides) * 2 * np.pi / sides + turn
    return np.stack([np.cos(angle), np.sin(angle)], axis=1) * size


def _plate(outline: np.ndarray, height_m: float, out_m: float, albedo: np.ndarray) -> Soup:
    """A flat, convex figure (n, 2) of (sideways, up) m facing -x, its middle at `height_m`."""
    n = len(outline)
    rim = np.stack([np.full(n, -out_m), -height_m - outline[:, 1], outline[:, 0]], axis=1)
    corners = np.stack([np.broadcast_to(rim[0], (n - 2, 3)), rim[1:-1], rim[2:]], axis=1)
    face = make(corners, Material.FLAT, albedo, np.broadcast_to([-1.0, 0, 0], corners.shape), pattern=(1, 0, 0, 0))
    return tagged(face, Semantic.TRAFFIC_SIGN)


def _bar(x: float, y: float, wide: float, tall: float) -> np.ndarray:
    return np.array(
        [
            [x - wide / 2, y - tall / 2],
            [x + wide / 2, y - tall / 2],
            [x + wide / 2, y + tall / 2],
            [x - wide / 2, y + tall / 2],
        ]
    )


def sign(rng: np.random.Generator) -> Soup:
    """A traffic sign on its pole, facing oncoming traffic (towards -x), grey from behind."""
    height = float(rng.uniform(2.1, 3.0))
    size = float(rng.uniform(0.3, 0.42))
    middle = height - size
    parts = [stick((0, 0, 0), (0, -height, 0), (0.035, 0.035), Material.METAL, _GREY * 1.5, 7)]
    kind = int(rng.integers(9))
    layers: list[tuple[np.ndarray, np.ndarray]]
    disc, up = _outline(20, size, 0.0), _outline(3, size * 1.15, np.pi / 2)
    glyph = [
        (_bar(0, 0, size * 0.18, size * 0.6), _BLACK),
        (_bar(0, -0.1 * size, size * 0.5, size * 0.16), _BLACK),
    ]
    digits = [(_bar(x * size, 0, size * 0.32, size * 0.75), _BLACK) for x in (-0.3, 0.3)]
    holes = [
        (_bar(x * size, y * size, size * 0.12, size * 0.2), _WHITE) for x in (-0.3, 0.3) for y in (-0.17, 0.17)
    ]
    if kind == 0:
        layers = [(up, _RED), (up * 0.72, _WHITE), *((g * 0.7, c) for g, c in glyph)]
    elif kind == 1:
        layers = [(-up, _RED), (-up * 0.7, _WHITE)]
    elif kind == 2:
        layers = [(disc, _RED), (disc * 0.78, _WHITE), *((g * 0.8, c) for g, c in (*digits, *holes))]
    elif kind == 3:
        layers = [(disc, _RED), (disc * 0.82, _BLUE), (_bar(0, 0, size * 1.5, size * 0.16) @ _turned(0.8), _RED)]
    elif kind == 4:
        arrow = np.array([[-0.45, 0.05], [0.45, 0.05], [0.0, 0.6]]) * size
        layers = [(disc, _BLUE), (_bar(0, -0.2 * size, size * 0.22, size * 0.7), _WHITE), (arrow, _WHITE)]
    elif kind == 5:
        square = _outline(4, size * 1.15, 0.0)
        layers = [(square, _WHITE), (square * 0.74, _YELLOW)]
    elif kind == 6:
        octagon = _outline(8, size * 1.05, np.pi / 8)
        layers = [
            (octagon, _RED),
            (_bar(0, 0, size * 1.4, size * 0.42), _WHITE),
            (_bar(0, 0, size * 1.25, size * 0.1), _RED),
        ]
    elif kind == 7:
        square = _bar(0, 0, size * 1.7, size * 1.7)
        layers = [
            (square, _WHITE),
            (square * 0.92, _BLUE),
            (_bar(-0.2 * size, 0, size * 0.22, size * 1.1), _WHITE),
        ]
        layers += [
            (_bar(0.1 * size, 0.28 * size, size * 0.6, size * 0.55), _WHITE),
            (_bar(0.1 * size, 0.28 * size, size * 0.3, size * 0.22), _BLUE),
        ]
    else:
        wide = size * float(rng.uniform(3.2, 4.5))
        ground, ink = (
            (_YELLOW, _BLACK)
            if rng.random() < 0.5
            else (_WHITE, _BLACK)
            if rng.random() < 0.5
            else (_BLUE, _WHITE)
        )
        board = _bar(0, 0, wide, size * 1.3)
        layers = [(board, ink), (board * np.array([0.97, 0.92]), ground)]
        for row in (-0.3, 0.3):
            x = -wide * 0.42
            while x < wide * float(rng.uniform(0.0, 0.35)):
                letter = size * float(rng.uniform(0.1, 0.2))
                layers.append((_bar(x + letter / 2, row * size, letter, size * 0.28), ink))
                x += letter + size * 0.06
    for i, (outline, albedo) in enumerate(layers):
        parts.append(
            _plate(outline, middle, 0.045 + 0.004 * i, albedo * float(rng.uniform(0.9, 1.1)) if i == 0 else albedo)
        )
    back = _plate(layers[0][0][::-1], middle, 0.038, _GREY)
    back.normals[:] = np.array([1.0, 0, 0], np.float32)
    back.pattern[:, 0] = 0.0
    parts.append(back)
    return join(parts)


def _turned(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


def traffic_light(rng: np.random.Generator, reach_m: float) -> Soup:
    """A pole with lights for traffic that comes from -x; reach_m: length of an arm over the road along z, or 0."""
    lit = int(rng.integers(3))
    lamp_colours = np.array([[0.75, 0.03, 0.02], [0.75, 0.42, 0.02], [0.05, 0.65, 0.30]])
    height = 5.4 if reach_m else 3.3
    parts = [stick((0, 0, 0), (0, -height, 0), (0.08, 0.06), Material.METAL, _GREY, 8)]
    heads = [(0.0, 2.3)]
    if reach_m:
        end = (0.0, -height - 0.2, reach_m)
        parts.append(stick((0, -height + 0.1, 0), end, (0.06, 0.05), Material.METAL, _GREY, 6))
        heads.append((reach_m, 4.7))
    disc = _outline(12, 0.1, 0.0)
    for z, foot in heads:
        case = _moved(box((0.22, 0.95, 0.32), Material.FLAT, _BLACK * 1.6), -0.1, -foot, z)
        parts.append(tagged(case, Semantic.TRAFFIC_LIGHT))
        for i in range(3):
            albedo = lamp_colours[i] if i == lit else lamp_colours[i] * 0.06
            lens = _moved(_plate(disc, foot + 0.78 - 0.3 * i, 0.225, albedo), 0.0, 0.0, z)
            lens.pattern[:, 2] = i == lit
            parts.append(tagged(lens, Semantic.TRAFFIC_LIGHT))
            hood = _moved(box((0.14, 0.02, 0.24), Material.FLAT, _BLACK * 1.6), -0.27, -foot - 0.9 + 0.3 * i, z)
            parts.append(tagged(hood, Semantic.TRAFFIC_LIGHT))
    return join(parts)


def bus_stop(rng: np.random.Generator) -> Soup:
    """A shelter open towards -z, with a bench, a poster and the stop's sign."""
    long = float(rng.uniform(3.0, 4.5))
    steel = _GREY * float(rng.uniform(0.3, 1.2))
    posts = [
        _moved(box((0.08, 2.35, 0.08), Material.METAL, steel), x, 0.0, z)
        for x in (-long / 2, long / 2)
        for z in (0.6, -0.5)
    ]
    roof = _moved(box((long + 0.4, 0.12, 1.7), Material.FLAT, steel * 1.2), 0.0, -2.35)
    back = _moved(box((long, 1.9, 0.03), Material.FLAT, np.array([0.16, 0.18, 0.18])), 0.0, -0.25, 0.62)
    bench = _moved(box((long * 0.6, 0.07, 0.4), Material.FLAT, np.array([0.12, 0.07, 0.03])), 0.0, -0.45, 0.35)
    poster = _moved(box((0.1, 1.75, 1.15), Material.FLAT, rng.uniform(0.05, 0.5, 3)), long / 2, -0.35, 0.05)
    pole = stick(
        (-long / 2 - 1.2, 0, -0.5), (-long / 2 - 1.2, -2.7, -0.5), (0.035, 0.035), Material.METAL, _GREY, 6
    )
    disc = _plate(_outline(16, 0.26, 0.0), 2.5, 0.05, _YELLOW)
    ring = _plate(_outline(16, 0.2, 0.0), 2.5, 0.055, np.array([0.02, 0.22, 0.08]))
    mark = [_moved(s, -long / 2 - 1.2, 0.0, -0.5) for s in (disc, ring)]
    return join([*(tagged(s, Semantic.MISC) for s in (*posts, roof, back, bench, poster)), pole, *mark])


@lru_cache(maxsize=8)
def _bicycle(identifier: int) -> Soup:
    return people.bicycle(np.random.default_rng([0xB1C, identifier]))


def bicycles(rng: np.random.Generator) -> Soup:
    """A few parked bicycles side by side."""
    count = int(rng.integers(1, 6))
    found = [
        _moved(
            _bicycle(int(rng.integers(8))),
            0.55 * i,
            0.0,
            float(rng.normal(0, 0.06)),
            np.pi / 2 + float(rng.normal(0, 0.08)),
        )
        for i in range(count)
    ]
    return tagged(join(found), Semantic.MISC)


def clutter(rng: np.random.Generator, small: bool) -> Soup:
    """What one may take for a car, its long side along x.

    small: fit for a pavement (bins, cabinets, bicycles); else sheds, skips, trailers, billboards.
    """
    colour = _BOXES[rng.integers(len(_BOXES))] * rng.uniform(0.7, 1.3)
    shape = int(rng.integers(5)) if small else int(rng.integers(5, 9))
    if shape == 0:
        count = int(rng.integers(1, 4))
        return join([_bin(colour * rng.uniform(0.7, 1.2), 0.68 * i, rng) for i in range(count)])
    if shape == 1:
        case = box((float(rng.uniform(0.6, 1.4)), float(rng.uniform(0.9, 1.5)), 0.45), Material.FLAT, colour)
        return join([case, box((1.5, 0.12, 0.5), Material.WALL, np.full(3, 0.2))])
    if shape == 2:
        return join([_moved(box((0.15, 0.9, 0.15), Material.FLAT, np.full(3, 0.35)), 1.5 * i) for i in range(4)])
    if shape == 3:
        pillar = stick((0, 0, 0), (0, -2.8, 0), (0.5, 0.5), Material.WALL, rng.uniform(0.1, 0.5, 3), 14)
        cap = stick((0, -2.8, 0), (0, -3.0, 0), (0.62, 0.5), Material.FLAT, np.array([0.05, 0.10, 0.07]), 14)
        return tagged(join([pillar, cap]), Semantic.MISC)
    if shape == 4:
        return bicycles(rng)
    if shape == 5:
        return shed(rng, float(rng.uniform(2.2, 5.0)))
    if shape == 6:
        return _container(rng, colour)
    if shape == 7:
        return _trailer(rng, colour)
    return _billboard(rng)


def _billboard(rng: np.random.Generator) -> Soup:
    """Posters on two legs."""
    legs = [stick((x, 0, 0), (x, -1.0, 0), (0.05, 0.05), Material.METAL, _GREY) for x in (-1.2, 1.2)]
    board = [_moved(box((3.0, 1.6, 0.12), Material.FLAT, np.full(3, 0.3)), 0.0, -0.9)]
    for i in range(5):
        wide, tall = float(rng.uniform(0.3, 1.4)), float(rng.uniform(0.15, 0.6))
        x, y = float(rng.uniform(-1.4 + wide / 2, 1.4 - wide / 2)), float(rng.uniform(1.0, 2.4 - tall))
        poster = box((wide, tall, 0.14 + 0.01 * i), Material.FLAT, rng.uniform(0.02, 0.6, 3))
        board.append(_moved(poster, x, -y))
    return _moved(join([*legs, *board]), 0.0, yaw=float(rng.uniform(0, 1.57)))


def _bin(colour: np.ndarray, x: float, rng: np.random.Generator) -> Soup:
    """A dustbin on wheels."""
    body = box((0.5, 0.95, 0.52), Material.FLAT, colour)
    lid = _moved(box((0.58, 0.09, 0.62), Material.FLAT, colour * 0.7), 0.0, -0.95)
    return _moved(join([body, lid]), x, yaw=float(rng.normal(0, 0.1)))


def shed(rng: np.random.Generator, long: float) -> Soup:
    """A garden shed or a small garage, `long` m along x."""
    colour = _BOXES[rng.integers(len(_BOXES))] * rng.uniform(0.7, 1.3)
    tall, wide = float(rng.uniform(1.8, 2.4)), float(rng.uniform(1.8, 2.8))
    wood = rng.random() < 0.6
    walls = box(
        (long, tall, wide), Material.FENCE if wood else Material.WALL, colour if wood else np.full(3, 0.35)
    )
    half, rise, eave = wide / 2 + 0.15, 0.35 * wide, 0.15
    slopes = []
    for sign_z in (1.0, -1.0):
        points = np.array(
            [
                [long / 2 + eave, -tall + 0.08, sign_z * half], [-long / 2 - eave, -tall + 0.08, sign_z * half],
                [-long / 2 - eave, -tall - rise, 0], [long / 2 + eave, -tall - rise, 0],
            ]
        )  # fmt: skip
        normal = np.array([0, -half, sign_z * rise]) / np.hypot(half, rise)
        slopes.append(
            make(quad(points), Material.ROOF, np.array([0.07, 0.05, 0.045]), np.broadcast_to(normal, (2, 3, 3)))
        )
    ends = [
        make(
            np.array([[x, -tall, wide / 2], [x, -tall, -wide / 2], [x, -tall - rise, 0]])[None],
            Material.WALL,
            colour,
        )
        for x in (-long / 2, long / 2)
    ]
    door = _moved(box((0.04, 1.75, 0.9), Material.FLAT, colour * 0.5), -long / 2 - 0.02)
    return tagged(join([walls, *slopes, *ends, door]), Semantic.BUILDING)


def _container(rng: np.random.Generator, colour: np.ndarray) -> Soup:
    """A skip or a shipping container with ribs."""
    long = float(rng.choice([3.2, 6.0]))
    tall, wide = (1.4, 1.8) if long < 4 else (2.5, 2.4)
    parts = [_moved(box((long, tall, wide), Material.FLAT, colour), 0.0, -0.12)]
    rib = box((0.08, tall, wide + 0.08), Material.FLAT, colour * 0.85)
    parts += [_moved(rib, float(x), -0.12) for x in np.arange(-long / 2 + 0.2, long / 2, 0.45)]
    parts.append(_moved(box((long + 0.06, 0.12, wide + 0.1), Material.FLAT, colour * 0.8), 0.0, -tall))
    parts.append(box((long * 0.9, 0.14, wide * 0.8), Material.FLAT, _BLACK))
    return tagged(join(parts), Semantic.MISC)


def _trailer(rng: np.random.Generator, colour: np.ndarray) -> Soup:
    """A small trailer with two wheels and a drawbar."""
    tall = float(rng.uniform(0.4, 1.4))
    body = _moved(box((2.4, tall, 1.4), Material.FLAT, colour), 0.0, -0.5)
    frame = _moved(box((2.5, 0.1, 1.45), Material.METAL, _GREY), 0.0, -0.42)
    wheels = [
        stick((0, -0.29, z - 0.09), (0, -0.29, z + 0.09), (0.29, 0.29), Material.TYRE, _BLACK, 12)
        for z in (-0.8, 0.8)
    ]
    bar = stick((1.2, -0.45, 0), (2.2, -0.4, 0), (0.04, 0.04), Material.METAL, _GREY, 5)
    prop = stick((2.1, 0, 0), (2.1, -0.4, 0), (0.03, 0.03), Material.METAL, _GREY, 5)
    return tagged(join([body, frame, *wheels, bar, prop]), Semantic.MISC)


def wire_pole(height_m: float) -> Soup:
    """A wooden pole with a cross beam for overhead lines across the road's direction."""
    wood = np.array([0.10, 0.075, 0.05])
    pole = stick((0, 0, 0), (0, -height_m, 0), (0.13, 0.09), Material.BARK, wood, 7)
    beam = _moved(box((0.1, 0.1, 1.8), Material.BARK, wood), 0.0, -height_m + 0.5)
    return tagged(join([pole, beam]), Semantic.POLE)


def bale() -> Soup:
    """A round bale of straw."""
    straw = np.array([0.33, 0.25, 0.11])
    return tagged(
        stick((0, -0.6, -0.6), (0, -0.6, 0.6), (0.6, 0.6), Material.BARK, straw, 14), Semantic.VEGETATION
    )
