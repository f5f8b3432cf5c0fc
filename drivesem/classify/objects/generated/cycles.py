"""Generators of motorcycles and skateboards."""

from __future__ import annotations

import numpy as np

from drivesem.classify.objects.generated.builder import (
    AMBER,
    BLACK,
    CHROME,
    GLASS,
    LAMP,
    PAINTS,
    RUBBER,
    STEEL,
    TAIL_LAMP,
    WOODS,
    ObjectBuilder,
    Surface,
    dull,
    metal,
    paint,
    plastic,
)
from drivesem.classify.objects.generated.shapes import (
    FORWARD,
    UP,
    Array,
    Pair,
    ball,
    beams,
    block,
    body,
    box,
    boxes,
    lathe,
    points,
    rotate,
    slab,
    torus,
    translate_solid,
    tube,
)
from scene_ir.meshes.solids import TemplateSolid

_LEATHER = dull((0.015, 0.014, 0.014))


def _wheel(obj: ObjectBuilder, x: float, radius: float, thick: float, spoked: bool) -> None:
    hub = np.array([x, radius, 0.0])
    inner = radius - 2 * thick
    obj.add(RUBBER, torus(hub, radius - thick, thick, "z", 32))
    rim = CHROME if spoked else metal((0.05, 0.05, 0.055))
    obj.add(rim, torus(hub, inner, 0.32 * thick, "z", 28))
    obj.add(STEEL, lathe([(0.05, -0.07), (0.05, 0.07)], hub, "z", 14))
    obj.pair(CHROME, lathe([(0.42 * inner, 0.045), (0.42 * inner, 0.052)], hub, "z", 20))
    count, wide, deep = (18, 0.007, 0.007) if spoked else (5, 0.05, 0.035)
    angle = 2 * np.pi * np.arange(count) / count
    ends = hub + inner * points(np.cos(angle), np.sin(angle), 0)
    starts = hub + points(0, 0, 0.035 * (-1.0) ** np.arange(count) * spoked)
    obj.add(rim, beams(starts, ends, wide, deep))


def _fender(x: float, y: float, radius: float, angles: Pair, half: float) -> TemplateSolid:
    """A mudguard around a wheel's axle, between two angles that go from forward upwards, rad."""
    a, z = np.linspace(*angles, 11)[:, None], np.linspace(-half, half, 5)
    rise = radius - 0.35 * half * (z / half) ** 2

    def skin(r: Array) -> Array:
        return points(x + r * np.cos(a), y + r * np.sin(a), z)

    return slab(skin(rise), skin(rise - 0.008))


def _fork(obj: ObjectBuilder, axle: Pair, head: Pair, half: float) -> None:
    (x, y), (hx, hy) = axle, head
    obj.pair(CHROME, tube([(x, y, half), (hx, hy, half)], 0.022, 8))
    obj.pair(STEEL, tube([(x, y, half), (x + 0.5 * (hx - x), y + 0.5 * (hy - y), half)], 0.03, 8))
    obj.add(BLACK, box((hx - 0.04, hy - 0.02, -half - 0.03), (hx + 0.04, hy + 0.02, half + 0.03), 0.01))
    obj.add(BLACK, box((hx + 0.01, hy - 0.2, -half - 0.03), (hx + 0.09, hy - 0.17, half + 0.03), 0.01))


def _bars(obj: ObjectBuilder, path: list[tuple[float, float, float]], mirrors: bool) -> None:
    """Add handlebars; `path` goes from their middle to the right grip."""
    obj.pair(CHROME, tube(path, 0.012, 6))
    end, before = np.array(path[-1]), np.array(path[-2])
    way = (end - before) / np.linalg.norm(end - before)
    obj.pair(BLACK, tube([end - 0.11 * way, end + 0.02 * way], 0.02, 8))
    obj.pair(BLACK, tube([end - 0.1 * way + 0.02 * FORWARD, end + 0.07 * FORWARD], 0.006, 4))
    if mirrors:
        top = end - 0.12 * way + np.array([-0.02, 0.15, 0.05])
        obj.pair(BLACK, tube([end - 0.13 * way, top], 0.006, 4), ball(top, (0.015, 0.035, 0.055), 10))


def _engine(obj: ObjectBuilder, twin: bool, y: float) -> None:
    obj.add(STEEL, lathe([(0.12, -0.13), (0.16, -0.1), (0.16, 0.1), (0.12, 0.13)], (-0.05, y, 0), "z", 16))
    obj.add(metal((0.12, 0.12, 0.13)), block((-0.32, 0.14), (y - 0.1, y + 0.05), 0.11, 0.03))
    for lean in (0.45, -0.45) if twin else (0.2,):
        for step in range(6):
            half = 0.075 if step % 2 else 0.095
            fin = box((-half, 0.12 + 0.035 * step, -half - 0.01), (half, 0.155 + 0.035 * step, half + 0.01))
            obj.add(CHROME if step == 5 else STEEL, translate_solid(rotate(fin, "z", -lean), (-0.03, y, 0)))


def _exhaust(obj: ObjectBuilder, y: float, rear: float, lift: float, sides: int) -> None:
    path = [(0.12, y + 0.18, 0.09), (0.24, y + 0.08, 0.12), (0.2, y - 0.1, 0.14), (-0.05, y - 0.14, 0.16),
        (-0.25, y - 0.12, 0.17)]  # fmt: skip
    end = y - 0.06 + lift
    muffler = [(-0.22, y - 0.12, 0.17), (-0.32, y - 0.1, 0.18), (rear, end, 0.19)]
    add = obj.pair if sides == 2 else obj.add
    add(CHROME, tube(path, 0.025, 8), tube(muffler, [0.026, 0.045, 0.05], 10))
    add(BLACK, tube([(rear + 0.01, end, 0.19), (rear - 0.006, end, 0.19)], 0.035, 10))


def _rear(obj: ObjectBuilder, axle: float, radius: float, seat: float) -> None:
    """Add swinging arm, dampers and chain."""
    obj.pair(STEEL, tube([(axle, radius, 0.09), (-0.25, 0.36, 0.1)], 0.022, 6))
    obj.pair(CHROME, tube([(axle + 0.04, radius + 0.03, 0.12), (axle + 0.16, seat - 0.08, 0.13)], 0.014, 6))
    obj.pair(BLACK, tube([(axle + 0.07, radius + 0.12, 0.12), (axle + 0.14, seat - 0.14, 0.13)], 0.032, 8))
    obj.add(STEEL, torus((axle, radius, 0.075), 0.1, 0.008, "z", 20))


def _lamps(obj: ObjectBuilder, x: float, y: float, rear: Pair, size: float) -> None:
    """Add headlamp, tail lamp and indicators."""
    shell = [(0.4 * size, -0.11), (0.95 * size, -0.03), (size, 0.02), (0.9 * size, 0.03)]
    obj.add(CHROME, lathe(shell, (x, y, 0), "x", 18))
    obj.add(LAMP, lathe([(0.88 * size, 0.0), (0.8 * size, 0.045), (0.3 * size, 0.055)], (x, y, 0), "x", 18))
    a, b = rear
    obj.pair(AMBER, ball((x - 0.04, y - 0.02, size + 0.09), 0.03, 8), ball((a + 0.05, b - 0.02, 0.15), 0.026, 8))
    obj.pair(BLACK, tube([(x - 0.04, y - 0.02, 0.06), (x - 0.04, y - 0.02, size + 0.08)], 0.01, 4))
    obj.add(TAIL_LAMP, block((a - 0.02, a + 0.02), (b - 0.035, b + 0.035), 0.06, 0.012))
    obj.add(BLACK, block((a - 0.03, a - 0.02), (b - 0.2, b - 0.06), 0.08))


def _frame(obj: ObjectBuilder, surface: Surface, head: Pair, seat: float) -> None:
    hx, hy = head
    obj.pair(surface, tube([(hx - 0.03, hy - 0.12, 0.04), (0.22, 0.42, 0.1), (0.1, 0.22, 0.11),
        (-0.28, 0.24, 0.12), (-0.34, 0.5, 0.11), (-0.3, seat - 0.06, 0.1)], 0.018, 6))  # fmt: skip
    upper = [(hx - 0.03, hy - 0.06, 0.03), (-0.1, seat, 0.07), (-0.62, seat + 0.02, 0.09)]
    obj.pair(surface, tube(upper, 0.018, 6))


def roadster(obj: ObjectBuilder) -> None:
    """Upright, without fairing: round lamp, tank, flat seat."""
    r, base = obj.uniform(0.295, 0.32), obj.uniform(0.66, 0.72)
    coat, spoked, seat = obj.lacquer(), obj.chance(0.5), obj.uniform(0.74, 0.8)
    head = (base - 0.26, 0.92)
    _wheel(obj, base, r, 0.055, spoked)
    _wheel(obj, -base, r, 0.068, spoked)
    _fork(obj, (base, r), head, 0.1)
    _frame(obj, BLACK if obj.chance(0.6) else coat, head, seat)
    _engine(obj, twin=False, y=0.4)
    _exhaust(obj, 0.4, -base - 0.08, obj.uniform(0.0, 0.1), obj.integer(1, 2))
    _rear(obj, -base, r, seat)
    plump = obj.uniform(0.9, 1.15)
    obj.add(coat, body([[-0.14, seat + 0.03, 0.05, 0.06], [-0.02, seat + 0.06, 0.1 * plump, 0.11],
        [0.18, seat + 0.09, 0.12 * plump, 0.145], [0.33, seat + 0.09, 0.09 * plump, 0.11],
        [0.38, seat + 0.08, 0.04, 0.05]], 14, 2.5))  # fmt: skip
    obj.add(CHROME, lathe([(0.035, 0), (0.03, 0.02)], (0.16, seat + 0.09 + 0.115 * plump, 0), sides=12))
    obj.add(_LEATHER, body([[-0.74, seat + 0.06, 0.03, 0.07], [-0.66, seat + 0.05, 0.06, 0.12],
        [-0.34, seat + 0.02, 0.05, 0.13], [-0.12, seat + 0.02, 0.05, 0.1]], 12, 3.5))  # fmt: skip
    obj.add(coat, _fender(-base, r, r + 0.045, (0.9, 2.7), 0.085), _fender(base, r, r + 0.03, (0.6, 2.5), 0.07))
    obj.pair(coat, box((-0.42, seat - 0.22, 0.1), (-0.16, seat - 0.06, 0.125), 0.02))
    rise = obj.uniform(0.0, 0.08)
    _bars(obj, [(head[0], 0.97, 0), (head[0] - 0.02, 1.0 + rise, 0.12), (head[0] - 0.1, 1.02 + rise, 0.26),
        (head[0] - 0.17, 1.0 + rise, 0.38)], obj.chance(0.8))  # fmt: skip
    _lamps(obj, head[0] + 0.12, 0.86, (-0.76, seat), obj.uniform(0.085, 0.105))


def sport(obj: ObjectBuilder) -> None:
    """A fairing with a screen, a high tail, low bars."""
    r, base = 0.3, obj.uniform(0.66, 0.7)
    coat, second = obj.lacquer(), obj.lacquer()
    head = (base - 0.24, 0.84)
    _wheel(obj, base, r, 0.055, spoked=False)
    _wheel(obj, -base, r, 0.085, spoked=False)
    _fork(obj, (base, r), head, 0.1)
    _engine(obj, twin=False, y=0.38)
    _exhaust(obj, 0.36, -base - 0.06, obj.uniform(0.05, 0.28), 1)
    _rear(obj, -base, r, 0.78)
    nose = obj.uniform(0.74, 0.84)
    obj.add(coat, body([[-0.02, 0.58, 0.25, 0.15], [0.2, 0.6, 0.28, 0.2], [0.42, 0.72, 0.2, 0.2],
        [0.6, 0.8, 0.12, 0.15], [nose, 0.74, 0.05, 0.07]], 14, 2.6))  # fmt: skip
    obj.pair(second, box((-0.1, 0.3, 0.15), (0.34, 0.52, 0.205), 0.03))
    obj.add(GLASS, body([[0.28, 0.98, 0.05, 0.1], [0.42, 0.95, 0.1, 0.14], [0.62, 0.84, 0.06, 0.12],
        [0.68, 0.8, 0.02, 0.08]], 14, 2.4))  # fmt: skip
    obj.pair(LAMP, ball((nose - 0.1, 0.78, 0.07), (0.075, 0.032, 0.05), 10))
    obj.add(coat, body([[-0.16, 0.8, 0.06, 0.08], [0.0, 0.86, 0.12, 0.14], [0.18, 0.9, 0.13, 0.16],
        [0.34, 0.88, 0.08, 0.11]], 14, 2.5))  # fmt: skip
    obj.add(second, body([[-0.92, 1.0, 0.02, 0.03], [-0.74, 0.96, 0.06, 0.09], [-0.45, 0.84, 0.07, 0.12],
        [-0.28, 0.8, 0.04, 0.09]], 12, 2.8))  # fmt: skip
    obj.add(_LEATHER, body([[-0.5, 0.89, 0.03, 0.1], [-0.34, 0.85, 0.05, 0.13], [-0.12, 0.83, 0.05, 0.1]], 12,
        3.0))  # fmt: skip
    obj.add(coat, _fender(base, r, r + 0.025, (0.5, 2.6), 0.075))
    obj.add(BLACK, _fender(-base, r, r + 0.04, (1.4, 2.9), 0.08))
    obj.pair(BLACK, tube([(head[0], 0.88, 0.1), (head[0] - 0.1, 0.86, 0.33)], 0.02, 8))
    obj.pair(BLACK, tube([(0.52, 0.92, 0.12), (0.5, 1.0, 0.3)], 0.008, 4))
    obj.pair(coat, ball((0.5, 1.01, 0.33), (0.03, 0.035, 0.06), 10))
    obj.add(TAIL_LAMP, block((-0.94, -0.88), (0.975, 1.01), 0.05, 0.01))
    obj.add(BLACK, block((-0.93, -0.91), (0.68, 0.84), 0.08), beams((-0.8, 0.94, 0), (-0.92, 0.76, 0), 0.05))


def cruiser(obj: ObjectBuilder) -> None:
    """Long and low: a raked fork, wide bars, a V of two cylinders, full fenders, perhaps bags."""
    r, base, front = obj.uniform(0.31, 0.33), obj.uniform(0.74, 0.8), obj.uniform(0.82, 1.0)
    coat, spoked = obj.lacquer(), obj.chance(0.6)
    head, seat = (front - 0.42, 0.88), 0.62
    _wheel(obj, front, r + 0.02, 0.05, spoked)
    _wheel(obj, -base, r, 0.085, spoked)
    _fork(obj, (front, r + 0.02), head, 0.11)
    _frame(obj, BLACK, head, seat)
    _engine(obj, twin=True, y=0.36)
    _exhaust(obj, 0.34, -base - 0.12, 0.0, 2)
    _rear(obj, -base, r, seat)
    obj.add(coat, body([[-0.16, 0.66, 0.03, 0.03], [-0.02, 0.74, 0.09, 0.11], [0.16, 0.8, 0.12, 0.16],
        [0.3, 0.83, 0.1, 0.12], [0.38, 0.85, 0.04, 0.04]], 14, 2.2))  # fmt: skip
    obj.add(CHROME, block((0.0, 0.26), (0.83, 0.935), 0.03, 0.02))
    obj.add(_LEATHER, body([[-0.58, 0.76, 0.08, 0.1], [-0.46, 0.68, 0.07, 0.16], [-0.3, 0.64, 0.06, 0.18],
        [-0.14, 0.66, 0.05, 0.1]], 12, 2.8))  # fmt: skip
    obj.add(_LEATHER, body([[-0.86, 0.76, 0.03, 0.07], [-0.72, 0.76, 0.05, 0.11], [-0.58, 0.74, 0.05, 0.1]], 12,
        2.8))  # fmt: skip
    obj.add(coat, _fender(-base, r, r + 0.06, (0.5, 3.2), 0.115),
        _fender(front, r + 0.02, r + 0.06, (0.5, 2.9), 0.085))  # fmt: skip
    if obj.chance(0.5):
        obj.pair(_LEATHER, box((-0.98, 0.36, 0.14), (-0.56, 0.66, 0.28), 0.04))
        obj.pair(CHROME, boxes([(-0.68, 0.56, 0.285), (-0.86, 0.56, 0.285)], (0.03, 0.06, 0.012)))
    rise, wide = obj.uniform(0.1, 0.34), obj.uniform(0.34, 0.44)
    _bars(obj, [(head[0], 0.93, 0), (head[0] - 0.02, 0.95, 0.12), (head[0] - 0.08, 0.94 + rise, 0.24),
        (head[0] - 0.18, 0.96 + rise, wide - 0.12), (head[0] - 0.3, 0.94 + rise, wide)], True)  # fmt: skip
    _lamps(obj, head[0] + 0.17, 0.8, (-base - 0.36, 0.52), obj.uniform(0.09, 0.115))
    if obj.chance(0.4):
        screen = rotate(block((-0.008, 0.008), (0.0, 0.42), 0.24, 0.006), "z", 0.35)
        obj.add(GLASS, translate_solid(screen, (head[0] + 0.13, 0.92, 0)))


def scooter(obj: ObjectBuilder) -> None:
    """Small wheels, a shield before the legs, a floor to stand on, a rounded rear."""
    r, base, coat = obj.uniform(0.2, 0.24), obj.uniform(0.58, 0.66), obj.lacquer()
    second = obj.lacquer() if obj.chance(0.3) else coat
    for x in (base, -base):
        _wheel(obj, x, r, 0.055, spoked=False)
    obj.add(coat, _fender(base, r, r + 0.05, (0.2, 2.7), 0.09))
    head, floor = (base - 0.2, 0.86), 0.26
    obj.pair(STEEL, tube([(base, r, 0.08), (base - 0.1, 0.55, 0.05)], 0.022, 6))
    obj.add(coat, tube([(base - 0.08, 0.44, 0), (head[0], head[1], 0)], [0.08, 0.06], 10))
    z, t = np.linspace(-0.2, 0.2, 9), np.linspace(0, 1, 8)[:, None]
    shield = points(base - 0.16 - 0.12 * t - 1.6 * z**2 - 0.1 * (1 - t) ** 4, 0.2 + 0.58 * t,
        z * (0.75 + 0.45 * np.sin(np.pi * (0.2 + 0.6 * t))))  # fmt: skip
    obj.add(coat, slab(shield, shield - 0.015 * FORWARD))
    obj.add(BLACK, block((-0.22, base - 0.22), (floor - 0.05, floor), 0.18, 0.02))
    obj.add(coat, block((-0.22, base - 0.24), (floor - 0.07, floor - 0.03), 0.19, 0.02))
    full = obj.uniform(0.9, 1.15)
    obj.add(second, body([[-0.98, 0.56, 0.05, 0.06], [-0.86, 0.52, 0.14, 0.14 * full],
        [-0.58, 0.48, 0.2, 0.2 * full], [-0.3, 0.46, 0.2, 0.16 * full], [-0.18, 0.44, 0.18, 0.12]], 14,
        2.5))  # fmt: skip
    obj.add(_LEATHER, body([[-0.86, 0.74, 0.02, 0.07], [-0.72, 0.74, 0.06, 0.13], [-0.4, 0.72, 0.06, 0.14],
        [-0.2, 0.68, 0.04, 0.09]], 12, 3.0))  # fmt: skip
    obj.add(STEEL, box((-0.7, 0.18, 0.06), (-0.3, 0.34, 0.16), 0.03))
    obj.add(CHROME, tube([(-0.4, 0.2, 0.13), (-0.55, 0.2, 0.17), (-0.92, 0.24, 0.18)], [0.02, 0.04, 0.045], 8))
    obj.add(coat, body([[head[0] - 0.12, 0.92, 0.06, 0.1], [head[0], 0.93, 0.09, 0.12],
        [head[0] + 0.12, 0.91, 0.07, 0.09]], 12, 2.5))  # fmt: skip
    obj.add(LAMP, lathe([(0.07, 0), (0.06, 0.03), (0.02, 0.04)], (head[0] + 0.1, 0.91, 0), "x", 16))
    obj.pair(AMBER, ball((base - 0.24, 0.62, 0.17), 0.028, 8), ball((-0.9, 0.55, 0.12), 0.028, 8))
    obj.add(TAIL_LAMP, block((-1.0, -0.95), (0.54, 0.62), 0.06, 0.015))
    obj.add(BLACK, block((-1.02, -1.0), (0.34, 0.48), 0.09), beams((-0.9, 0.48, 0), (-1.01, 0.44, 0), 0.05))
    _bars(obj, [(head[0], 0.95, 0), (head[0] - 0.06, 0.97, 0.14), (head[0] - 0.13, 0.97, 0.34)], mirrors=True)
    if obj.chance(0.4):
        obj.add(coat, block((-1.16, -0.88), (0.7, 0.98), 0.15, 0.04))


MOTORCYCLES = (roadster, sport, cruiser, scooter)


def _board(
    obj: ObjectBuilder, deck: Surface, length: float, widths: list[Pair], kicks: Pair, concave: float
) -> None:
    """Add a deck with grip, trucks and wheels.

    Args:
        obj: The object.
        deck: Surface of the deck.
        length: Its length.
        widths: Position from the middle, in half lengths, and half width, from tail to nose.
        kicks: Rise of tail and nose.
        concave: Rise of the edges.
    """
    half = length / 2
    t = np.concatenate([-np.cos(np.linspace(0, np.pi / 2, 14)), np.cos(np.linspace(np.pi / 2, 0, 14))[1:]])
    places, reach = np.array(widths).T
    wide = np.interp(t, places, reach)
    end = np.sqrt(np.maximum(1 - ((np.abs(t) - 0.8).clip(0) / 0.2005) ** 2, 0.0))
    wide = wide * end + 0.004
    s = np.linspace(-1, 1, 7)
    rise = np.where(t < 0, kicks[0], kicks[1]) * ((np.abs(t) - 0.58).clip(0) / 0.42) ** 1.3
    clear, r = obj.uniform(0.085, 0.1), obj.uniform(0.026, 0.036)
    top = points(half * t[:, None], rise[:, None] + concave * s**2 + clear, wide[:, None] * s)
    obj.add(deck, slab(top, top - 0.013 * UP))
    inset = top * [0.985, 1, 0.96]
    obj.add(dull((0.012, 0.012, 0.013)), slab(inset + 0.003 * UP, inset - 0.004 * UP))
    stripe, under = obj.lacquer(), inset[4:-4] - 0.0125 * UP
    for part in (under[2:7], under[-7:-2], under[7:-7, 2:5]):
        obj.add(stripe, slab(part, part - 0.002 * UP))
    wheels = plastic(obj.tint(((0.75, 0.73, 0.66), (0.6, 0.3, 0.02), (0.55, 0.03, 0.03), (0.05, 0.35, 0.12),
        (0.02, 0.18, 0.45), (0.02, 0.02, 0.02))))  # fmt: skip
    alloy = STEEL if obj.chance(0.7) else BLACK
    axle, level, track = obj.uniform(0.52, 0.58) * half, clear - 0.012, wide.max() * 0.92
    for x, way in ((axle, 1), (-axle, -1)):
        obj.add(BLACK, block((x - 0.045, x + 0.045), (level - 0.012, level), 0.03, 0.004))
        obj.add(alloy, block((x - 0.038, x + 0.038), (level - 0.026, level - 0.01), 0.024, 0.006))
        hanger = [(x, r, -0.62 * track), (x, r + 0.012, 0), (x, r, 0.62 * track)]
        obj.add(alloy, tube([(x + 0.015 * way, level - 0.015, 0), (x - 0.015 * way, r + 0.006, 0)], [0.016, 0.012],
            10), tube(hanger, [0.009, 0.014, 0.009], 8))  # fmt: skip
        obj.add(CHROME, tube([(x, r, -1.02 * track), (x, r, 1.02 * track)], 0.005, 6))
        tread = r * np.array([(0.45, -0.62), (0.88, -0.6), (1.0, -0.38), (1.0, 0.38), (0.88, 0.6), (0.45, 0.62)])
        obj.pair(wheels, lathe(tread, (x, r, 0.8 * track), "z", 20))
        obj.pair(STEEL, lathe(r * np.array([(0.42, -0.66), (0.42, 0.66)]), (x, r, 0.8 * track), "z", 14))
        bolts = [(x + dx, clear + 0.003 + 0.001, dz) for dx in (-0.034, 0.034) for dz in (-0.02, 0.02)]
        obj.add(CHROME, boxes(bolts, (0.008, 0.004, 0.008)))


def street_board(obj: ObjectBuilder) -> None:
    """Both ends kicked up equally."""
    w, kick = obj.uniform(0.098, 0.112), obj.uniform(0.045, 0.065)
    deck = dull(obj.tint((*WOODS, *PAINTS))) if obj.chance(0.7) else obj.lacquer()
    _board(obj, deck, obj.uniform(0.76, 0.84), [(-1, 0.94 * w), (-0.5, w), (0.5, w), (1, 0.96 * w)],
        (kick, 1.05 * kick), obj.uniform(0.004, 0.012))  # fmt: skip


def cruiser_board(obj: ObjectBuilder) -> None:
    """Small, of coloured plastic: a tapered nose, a kicked tail."""
    w = obj.uniform(0.08, 0.095)
    _board(obj, plastic(obj.tint(PAINTS, 0.4)), obj.uniform(0.55, 0.66),
        [(-1, 0.8 * w), (-0.5, w), (0.3, 0.98 * w), (1, 0.6 * w)],
        (obj.uniform(0.03, 0.05), obj.uniform(0.005, 0.015)), 0.004)  # fmt: skip


def longboard(obj: ObjectBuilder) -> None:
    """Long and flat, with pointed ends or cut-outs at the wheels."""
    w = obj.uniform(0.11, 0.13)
    pointed = obj.chance(0.5)
    ends = [(-1, 0.25 * w), (-0.6, 0.8 * w), (0.0, w), (0.6, 0.85 * w), (1, 0.45 * w)]
    cuts = [(-1, 0.5 * w), (-0.75, 0.55 * w), (-0.5, 0.95 * w), (0.5, 0.95 * w), (0.75, 0.55 * w), (1, 0.5 * w)]
    line = ends if pointed else cuts
    _board(obj, paint(obj.tint(WOODS)), obj.uniform(0.92, 1.05), line,
        (obj.uniform(0.0, 0.015), obj.uniform(0.0, 0.015)), obj.uniform(-0.004, 0.006))  # fmt: skip


def old_school_board(obj: ObjectBuilder) -> None:
    """Wide, with a blunt nose and a kicked tail."""
    w = obj.uniform(0.118, 0.132)
    _board(obj, obj.lacquer(0.4), obj.uniform(0.74, 0.8), [(-1, 0.8 * w), (-0.55, 0.88 * w), (0.1, w),
        (0.6, 0.84 * w), (1, 0.62 * w)], (obj.uniform(0.05, 0.07), obj.uniform(0.01, 0.03)), 0.007)  # fmt: skip


SKATEBOARDS = (street_board, cruiser_board, longboard, old_school_board)
