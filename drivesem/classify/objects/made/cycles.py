"""Motorcycles and skateboards."""

from __future__ import annotations

import numpy as np

from drivesem.classify.objects.shapes import (
    AHEAD,
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
    slab,
    torus,
    translate_solid,
    tube,
    turned,
)
from drivesem.classify.objects.surfaces import (
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
    Kit,
    Surface,
    dull,
    metal,
    paint,
    plastic,
)
from scene_ir.meshes.solids import TemplateSolid

_LEATHER = dull((0.015, 0.014, 0.014))


def _wheel(kit: Kit, x: float, radius: float, thick: float, spoked: bool) -> None:
    hub = np.array([x, radius, 0.0])
    inner = radius - 2 * thick
    kit.add(RUBBER, torus(hub, radius - thick, thick, "z", 32))
    rim = CHROME if spoked else metal((0.05, 0.05, 0.055))
    kit.add(rim, torus(hub, inner, 0.32 * thick, "z", 28))
    kit.add(STEEL, lathe([(0.05, -0.07), (0.05, 0.07)], hub, "z", 14))
    kit.both(CHROME, lathe([(0.42 * inner, 0.045), (0.42 * inner, 0.052)], hub, "z", 20))
    count, wide, deep = (18, 0.007, 0.007) if spoked else (5, 0.05, 0.035)
    angle = 2 * np.pi * np.arange(count) / count
    ends = hub + inner * points(np.cos(angle), np.sin(angle), 0)
    starts = hub + points(0, 0, 0.035 * (-1.0) ** np.arange(count) * spoked)
    kit.add(rim, beams(starts, ends, wide, deep))


def _fender(x: float, y: float, radius: float, angles: Pair, half: float) -> TemplateSolid:
    """A mudguard around a wheel's axle, between two angles from forward, upwards."""
    a, z = np.linspace(*angles, 11)[:, None], np.linspace(-half, half, 5)
    rise = radius - 0.35 * half * (z / half) ** 2

    def skin(r: Array) -> Array:
        return points(x + r * np.cos(a), y + r * np.sin(a), z)

    return slab(skin(rise), skin(rise - 0.008))


def _fork(kit: Kit, axle: Pair, head: Pair, half: float) -> None:
    (x, y), (hx, hy) = axle, head
    kit.both(CHROME, tube([(x, y, half), (hx, hy, half)], 0.022, 8))
    kit.both(STEEL, tube([(x, y, half), (x + 0.5 * (hx - x), y + 0.5 * (hy - y), half)], 0.03, 8))
    kit.add(BLACK, box((hx - 0.04, hy - 0.02, -half - 0.03), (hx + 0.04, hy + 0.02, half + 0.03), 0.01))
    kit.add(BLACK, box((hx + 0.01, hy - 0.2, -half - 0.03), (hx + 0.09, hy - 0.17, half + 0.03), 0.01))


def _bars(kit: Kit, path: list[tuple[float, float, float]], mirrors: bool) -> None:
    """Handlebars from their middle to the right grip, and to the left."""
    kit.both(CHROME, tube(path, 0.012, 6))
    end, before = np.array(path[-1]), np.array(path[-2])
    way = (end - before) / np.linalg.norm(end - before)
    kit.both(BLACK, tube([end - 0.11 * way, end + 0.02 * way], 0.02, 8))
    kit.both(BLACK, tube([end - 0.1 * way + 0.02 * AHEAD, end + 0.07 * AHEAD], 0.006, 4))
    if mirrors:
        top = end - 0.12 * way + np.array([-0.02, 0.15, 0.05])
        kit.both(BLACK, tube([end - 0.13 * way, top], 0.006, 4), ball(top, (0.015, 0.035, 0.055), 10))


def _engine(kit: Kit, twin: bool, y: float) -> None:
    kit.add(STEEL, lathe([(0.12, -0.13), (0.16, -0.1), (0.16, 0.1), (0.12, 0.13)], (-0.05, y, 0), "z", 16))
    kit.add(metal((0.12, 0.12, 0.13)), block((-0.32, 0.14), (y - 0.1, y + 0.05), 0.11, 0.03))
    for lean in (0.45, -0.45) if twin else (0.2,):
        for step in range(6):
            half = 0.075 if step % 2 else 0.095
            fin = box((-half, 0.12 + 0.035 * step, -half - 0.01), (half, 0.155 + 0.035 * step, half + 0.01))
            kit.add(CHROME if step == 5 else STEEL, translate_solid(turned(fin, "z", -lean), (-0.03, y, 0)))


def _exhaust(kit: Kit, y: float, rear: float, lift: float, sides: int) -> None:
    path = [(0.12, y + 0.18, 0.09), (0.24, y + 0.08, 0.12), (0.2, y - 0.1, 0.14), (-0.05, y - 0.14, 0.16),
        (-0.25, y - 0.12, 0.17)]  # fmt: skip
    end = y - 0.06 + lift
    muffler = [(-0.22, y - 0.12, 0.17), (-0.32, y - 0.1, 0.18), (rear, end, 0.19)]
    add = kit.both if sides == 2 else kit.add
    add(CHROME, tube(path, 0.025, 8), tube(muffler, [0.026, 0.045, 0.05], 10))
    add(BLACK, tube([(rear + 0.01, end, 0.19), (rear - 0.006, end, 0.19)], 0.035, 10))


def _rear(kit: Kit, axle: float, radius: float, seat: float) -> None:
    """Swinging arm, dampers, chain."""
    kit.both(STEEL, tube([(axle, radius, 0.09), (-0.25, 0.36, 0.1)], 0.022, 6))
    kit.both(CHROME, tube([(axle + 0.04, radius + 0.03, 0.12), (axle + 0.16, seat - 0.08, 0.13)], 0.014, 6))
    kit.both(BLACK, tube([(axle + 0.07, radius + 0.12, 0.12), (axle + 0.14, seat - 0.14, 0.13)], 0.032, 8))
    kit.add(STEEL, torus((axle, radius, 0.075), 0.1, 0.008, "z", 20))


def _lamps(kit: Kit, x: float, y: float, rear: Pair, size: float) -> None:
    """Headlamp, tail lamp, indicators."""
    shell = [(0.4 * size, -0.11), (0.95 * size, -0.03), (size, 0.02), (0.9 * size, 0.03)]
    kit.add(CHROME, lathe(shell, (x, y, 0), "x", 18))
    kit.add(LAMP, lathe([(0.88 * size, 0.0), (0.8 * size, 0.045), (0.3 * size, 0.055)], (x, y, 0), "x", 18))
    a, b = rear
    kit.both(AMBER, ball((x - 0.04, y - 0.02, size + 0.09), 0.03, 8), ball((a + 0.05, b - 0.02, 0.15), 0.026, 8))
    kit.both(BLACK, tube([(x - 0.04, y - 0.02, 0.06), (x - 0.04, y - 0.02, size + 0.08)], 0.01, 4))
    kit.add(TAIL_LAMP, block((a - 0.02, a + 0.02), (b - 0.035, b + 0.035), 0.06, 0.012))
    kit.add(BLACK, block((a - 0.03, a - 0.02), (b - 0.2, b - 0.06), 0.08))


def _frame(kit: Kit, surface: Surface, head: Pair, seat: float) -> None:
    hx, hy = head
    kit.both(surface, tube([(hx - 0.03, hy - 0.12, 0.04), (0.22, 0.42, 0.1), (0.1, 0.22, 0.11),
        (-0.28, 0.24, 0.12), (-0.34, 0.5, 0.11), (-0.3, seat - 0.06, 0.1)], 0.018, 6))  # fmt: skip
    upper = [(hx - 0.03, hy - 0.06, 0.03), (-0.1, seat, 0.07), (-0.62, seat + 0.02, 0.09)]
    kit.both(surface, tube(upper, 0.018, 6))


def roadster(kit: Kit) -> None:
    """Upright, without fairing: round lamp, tank, flat seat."""
    r, base = kit.between(0.295, 0.32), kit.between(0.66, 0.72)
    coat, spoked, seat = kit.lacquer(), kit.chance(0.5), kit.between(0.74, 0.8)
    head = (base - 0.26, 0.92)
    _wheel(kit, base, r, 0.055, spoked)
    _wheel(kit, -base, r, 0.068, spoked)
    _fork(kit, (base, r), head, 0.1)
    _frame(kit, BLACK if kit.chance(0.6) else coat, head, seat)
    _engine(kit, twin=False, y=0.4)
    _exhaust(kit, 0.4, -base - 0.08, kit.between(0.0, 0.1), kit.count(1, 2))
    _rear(kit, -base, r, seat)
    plump = kit.between(0.9, 1.15)
    kit.add(coat, body([[-0.14, seat + 0.03, 0.05, 0.06], [-0.02, seat + 0.06, 0.1 * plump, 0.11],
        [0.18, seat + 0.09, 0.12 * plump, 0.145], [0.33, seat + 0.09, 0.09 * plump, 0.11],
        [0.38, seat + 0.08, 0.04, 0.05]], 14, 2.5))  # fmt: skip
    kit.add(CHROME, lathe([(0.035, 0), (0.03, 0.02)], (0.16, seat + 0.09 + 0.115 * plump, 0), sides=12))
    kit.add(_LEATHER, body([[-0.74, seat + 0.06, 0.03, 0.07], [-0.66, seat + 0.05, 0.06, 0.12],
        [-0.34, seat + 0.02, 0.05, 0.13], [-0.12, seat + 0.02, 0.05, 0.1]], 12, 3.5))  # fmt: skip
    kit.add(coat, _fender(-base, r, r + 0.045, (0.9, 2.7), 0.085), _fender(base, r, r + 0.03, (0.6, 2.5), 0.07))
    kit.both(coat, box((-0.42, seat - 0.22, 0.1), (-0.16, seat - 0.06, 0.125), 0.02))
    rise = kit.between(0.0, 0.08)
    _bars(kit, [(head[0], 0.97, 0), (head[0] - 0.02, 1.0 + rise, 0.12), (head[0] - 0.1, 1.02 + rise, 0.26),
        (head[0] - 0.17, 1.0 + rise, 0.38)], kit.chance(0.8))  # fmt: skip
    _lamps(kit, head[0] + 0.12, 0.86, (-0.76, seat), kit.between(0.085, 0.105))


def sport(kit: Kit) -> None:
    """A fairing with a screen, a high tail, low bars."""
    r, base = 0.3, kit.between(0.66, 0.7)
    coat, second = kit.lacquer(), kit.lacquer()
    head = (base - 0.24, 0.84)
    _wheel(kit, base, r, 0.055, spoked=False)
    _wheel(kit, -base, r, 0.085, spoked=False)
    _fork(kit, (base, r), head, 0.1)
    _engine(kit, twin=False, y=0.38)
    _exhaust(kit, 0.36, -base - 0.06, kit.between(0.05, 0.28), 1)
    _rear(kit, -base, r, 0.78)
    nose = kit.between(0.74, 0.84)
    kit.add(coat, body([[-0.02, 0.58, 0.25, 0.15], [0.2, 0.6, 0.28, 0.2], [0.42, 0.72, 0.2, 0.2],
        [0.6, 0.8, 0.12, 0.15], [nose, 0.74, 0.05, 0.07]], 14, 2.6))  # fmt: skip
    kit.both(second, box((-0.1, 0.3, 0.15), (0.34, 0.52, 0.205), 0.03))
    kit.add(GLASS, body([[0.28, 0.98, 0.05, 0.1], [0.42, 0.95, 0.1, 0.14], [0.62, 0.84, 0.06, 0.12],
        [0.68, 0.8, 0.02, 0.08]], 14, 2.4))  # fmt: skip
    kit.both(LAMP, ball((nose - 0.1, 0.78, 0.07), (0.075, 0.032, 0.05), 10))
    kit.add(coat, body([[-0.16, 0.8, 0.06, 0.08], [0.0, 0.86, 0.12, 0.14], [0.18, 0.9, 0.13, 0.16],
        [0.34, 0.88, 0.08, 0.11]], 14, 2.5))  # fmt: skip
    kit.add(second, body([[-0.92, 1.0, 0.02, 0.03], [-0.74, 0.96, 0.06, 0.09], [-0.45, 0.84, 0.07, 0.12],
        [-0.28, 0.8, 0.04, 0.09]], 12, 2.8))  # fmt: skip
    kit.add(_LEATHER, body([[-0.5, 0.89, 0.03, 0.1], [-0.34, 0.85, 0.05, 0.13], [-0.12, 0.83, 0.05, 0.1]], 12,
        3.0))  # fmt: skip
    kit.add(coat, _fender(base, r, r + 0.025, (0.5, 2.6), 0.075))
    kit.add(BLACK, _fender(-base, r, r + 0.04, (1.4, 2.9), 0.08))
    kit.both(BLACK, tube([(head[0], 0.88, 0.1), (head[0] - 0.1, 0.86, 0.33)], 0.02, 8))
    kit.both(BLACK, tube([(0.52, 0.92, 0.12), (0.5, 1.0, 0.3)], 0.008, 4))
    kit.both(coat, ball((0.5, 1.01, 0.33), (0.03, 0.035, 0.06), 10))
    kit.add(TAIL_LAMP, block((-0.94, -0.88), (0.975, 1.01), 0.05, 0.01))
    kit.add(BLACK, block((-0.93, -0.91), (0.68, 0.84), 0.08), beams((-0.8, 0.94, 0), (-0.92, 0.76, 0), 0.05))


def cruiser(kit: Kit) -> None:
    """Long and low: a raked fork, wide bars, a V of two cylinders, full fenders, perhaps bags."""
    r, base, front = kit.between(0.31, 0.33), kit.between(0.74, 0.8), kit.between(0.82, 1.0)
    coat, spoked = kit.lacquer(), kit.chance(0.6)
    head, seat = (front - 0.42, 0.88), 0.62
    _wheel(kit, front, r + 0.02, 0.05, spoked)
    _wheel(kit, -base, r, 0.085, spoked)
    _fork(kit, (front, r + 0.02), head, 0.11)
    _frame(kit, BLACK, head, seat)
    _engine(kit, twin=True, y=0.36)
    _exhaust(kit, 0.34, -base - 0.12, 0.0, 2)
    _rear(kit, -base, r, seat)
    kit.add(coat, body([[-0.16, 0.66, 0.03, 0.03], [-0.02, 0.74, 0.09, 0.11], [0.16, 0.8, 0.12, 0.16],
        [0.3, 0.83, 0.1, 0.12], [0.38, 0.85, 0.04, 0.04]], 14, 2.2))  # fmt: skip
    kit.add(CHROME, block((0.0, 0.26), (0.83, 0.935), 0.03, 0.02))
    kit.add(_LEATHER, body([[-0.58, 0.76, 0.08, 0.1], [-0.46, 0.68, 0.07, 0.16], [-0.3, 0.64, 0.06, 0.18],
        [-0.14, 0.66, 0.05, 0.1]], 12, 2.8))  # fmt: skip
    kit.add(_LEATHER, body([[-0.86, 0.76, 0.03, 0.07], [-0.72, 0.76, 0.05, 0.11], [-0.58, 0.74, 0.05, 0.1]], 12,
        2.8))  # fmt: skip
    kit.add(coat, _fender(-base, r, r + 0.06, (0.5, 3.2), 0.115),
        _fender(front, r + 0.02, r + 0.06, (0.5, 2.9), 0.085))  # fmt: skip
    if kit.chance(0.5):
        kit.both(_LEATHER, box((-0.98, 0.36, 0.14), (-0.56, 0.66, 0.28), 0.04))
        kit.both(CHROME, boxes([(-0.68, 0.56, 0.285), (-0.86, 0.56, 0.285)], (0.03, 0.06, 0.012)))
    rise, wide = kit.between(0.1, 0.34), kit.between(0.34, 0.44)
    _bars(kit, [(head[0], 0.93, 0), (head[0] - 0.02, 0.95, 0.12), (head[0] - 0.08, 0.94 + rise, 0.24),
        (head[0] - 0.18, 0.96 + rise, wide - 0.12), (head[0] - 0.3, 0.94 + rise, wide)], True)  # fmt: skip
    _lamps(kit, head[0] + 0.17, 0.8, (-base - 0.36, 0.52), kit.between(0.09, 0.115))
    if kit.chance(0.4):
        screen = turned(block((-0.008, 0.008), (0.0, 0.42), 0.24, 0.006), "z", 0.35)
        kit.add(GLASS, translate_solid(screen, (head[0] + 0.13, 0.92, 0)))


def scooter(kit: Kit) -> None:
    """Small wheels, a shield before the legs, a floor to stand on, a rounded rear."""
    r, base, coat = kit.between(0.2, 0.24), kit.between(0.58, 0.66), kit.lacquer()
    second = kit.lacquer() if kit.chance(0.3) else coat
    for x in (base, -base):
        _wheel(kit, x, r, 0.055, spoked=False)
    kit.add(coat, _fender(base, r, r + 0.05, (0.2, 2.7), 0.09))
    head, floor = (base - 0.2, 0.86), 0.26
    kit.both(STEEL, tube([(base, r, 0.08), (base - 0.1, 0.55, 0.05)], 0.022, 6))
    kit.add(coat, tube([(base - 0.08, 0.44, 0), (head[0], head[1], 0)], [0.08, 0.06], 10))
    z, t = np.linspace(-0.2, 0.2, 9), np.linspace(0, 1, 8)[:, None]
    shield = points(base - 0.16 - 0.12 * t - 1.6 * z**2 - 0.1 * (1 - t) ** 4, 0.2 + 0.58 * t,
        z * (0.75 + 0.45 * np.sin(np.pi * (0.2 + 0.6 * t))))  # fmt: skip
    kit.add(coat, slab(shield, shield - 0.015 * AHEAD))
    kit.add(BLACK, block((-0.22, base - 0.22), (floor - 0.05, floor), 0.18, 0.02))
    kit.add(coat, block((-0.22, base - 0.24), (floor - 0.07, floor - 0.03), 0.19, 0.02))
    full = kit.between(0.9, 1.15)
    kit.add(second, body([[-0.98, 0.56, 0.05, 0.06], [-0.86, 0.52, 0.14, 0.14 * full],
        [-0.58, 0.48, 0.2, 0.2 * full], [-0.3, 0.46, 0.2, 0.16 * full], [-0.18, 0.44, 0.18, 0.12]], 14,
        2.5))  # fmt: skip
    kit.add(_LEATHER, body([[-0.86, 0.74, 0.02, 0.07], [-0.72, 0.74, 0.06, 0.13], [-0.4, 0.72, 0.06, 0.14],
        [-0.2, 0.68, 0.04, 0.09]], 12, 3.0))  # fmt: skip
    kit.add(STEEL, box((-0.7, 0.18, 0.06), (-0.3, 0.34, 0.16), 0.03))
    kit.add(CHROME, tube([(-0.4, 0.2, 0.13), (-0.55, 0.2, 0.17), (-0.92, 0.24, 0.18)], [0.02, 0.04, 0.045], 8))
    kit.add(coat, body([[head[0] - 0.12, 0.92, 0.06, 0.1], [head[0], 0.93, 0.09, 0.12],
        [head[0] + 0.12, 0.91, 0.07, 0.09]], 12, 2.5))  # fmt: skip
    kit.add(LAMP, lathe([(0.07, 0), (0.06, 0.03), (0.02, 0.04)], (head[0] + 0.1, 0.91, 0), "x", 16))
    kit.both(AMBER, ball((base - 0.24, 0.62, 0.17), 0.028, 8), ball((-0.9, 0.55, 0.12), 0.028, 8))
    kit.add(TAIL_LAMP, block((-1.0, -0.95), (0.54, 0.62), 0.06, 0.015))
    kit.add(BLACK, block((-1.02, -1.0), (0.34, 0.48), 0.09), beams((-0.9, 0.48, 0), (-1.01, 0.44, 0), 0.05))
    _bars(kit, [(head[0], 0.95, 0), (head[0] - 0.06, 0.97, 0.14), (head[0] - 0.13, 0.97, 0.34)], mirrors=True)
    if kit.chance(0.4):
        kit.add(coat, block((-1.16, -0.88), (0.7, 0.98), 0.15, 0.04))


MOTORCYCLES = (roadster, sport, cruiser, scooter)


def _board(kit: Kit, deck: Surface, length: float, widths: list[Pair], kicks: Pair, concave: float) -> None:
    """A deck with grip, trucks and wheels. widths: (place from the middle in half lengths, half width), tail to
    nose; kicks: how far tail and nose rise.
    """
    half = length / 2
    t = np.concatenate([-np.cos(np.linspace(0, np.pi / 2, 14)), np.cos(np.linspace(np.pi / 2, 0, 14))[1:]])
    places, reach = np.array(widths).T
    wide = np.interp(t, places, reach)
    end = np.sqrt(np.maximum(1 - ((np.abs(t) - 0.8).clip(0) / 0.2005) ** 2, 0.0))
    wide = wide * end + 0.004
    s = np.linspace(-1, 1, 7)
    rise = np.where(t < 0, kicks[0], kicks[1]) * ((np.abs(t) - 0.58).clip(0) / 0.42) ** 1.3
    clear, r = kit.between(0.085, 0.1), kit.between(0.026, 0.036)
    top = points(half * t[:, None], rise[:, None] + concave * s**2 + clear, wide[:, None] * s)
    kit.add(deck, slab(top, top - 0.013 * UP))
    inset = top * [0.985, 1, 0.96]
    kit.add(dull((0.012, 0.012, 0.013)), slab(inset + 0.003 * UP, inset - 0.004 * UP))
    stripe, under = kit.lacquer(), inset[4:-4] - 0.0125 * UP
    for part in (under[2:7], under[-7:-2], under[7:-7, 2:5]):
        kit.add(stripe, slab(part, part - 0.002 * UP))
    wheels = plastic(kit.tint(((0.75, 0.73, 0.66), (0.6, 0.3, 0.02), (0.55, 0.03, 0.03), (0.05, 0.35, 0.12),
        (0.02, 0.18, 0.45), (0.02, 0.02, 0.02))))  # fmt: skip
    alloy = STEEL if kit.chance(0.7) else BLACK
    axle, level, track = kit.between(0.52, 0.58) * half, clear - 0.012, wide.max() * 0.92
    for x, way in ((axle, 1), (-axle, -1)):
        kit.add(BLACK, block((x - 0.045, x + 0.045), (level - 0.012, level), 0.03, 0.004))
        kit.add(alloy, block((x - 0.038, x + 0.038), (level - 0.026, level - 0.01), 0.024, 0.006))
        hanger = [(x, r, -0.62 * track), (x, r + 0.012, 0), (x, r, 0.62 * track)]
        kit.add(alloy, tube([(x + 0.015 * way, level - 0.015, 0), (x - 0.015 * way, r + 0.006, 0)], [0.016, 0.012],
            10), tube(hanger, [0.009, 0.014, 0.009], 8))  # fmt: skip
        kit.add(CHROME, tube([(x, r, -1.02 * track), (x, r, 1.02 * track)], 0.005, 6))
        tread = r * np.array([(0.45, -0.62), (0.88, -0.6), (1.0, -0.38), (1.0, 0.38), (0.88, 0.6), (0.45, 0.62)])
        kit.both(wheels, lathe(tread, (x, r, 0.8 * track), "z", 20))
        kit.both(STEEL, lathe(r * np.array([(0.42, -0.66), (0.42, 0.66)]), (x, r, 0.8 * track), "z", 14))
        bolts = [(x + dx, clear + 0.003 + 0.001, dz) for dx in (-0.034, 0.034) for dz in (-0.02, 0.02)]
        kit.add(CHROME, boxes(bolts, (0.008, 0.004, 0.008)))


def street_board(kit: Kit) -> None:
    """Both ends kicked up alike."""
    w, kick = kit.between(0.098, 0.112), kit.between(0.045, 0.065)
    deck = dull(kit.tint((*WOODS, *PAINTS))) if kit.chance(0.7) else kit.lacquer()
    _board(kit, deck, kit.between(0.76, 0.84), [(-1, 0.94 * w), (-0.5, w), (0.5, w), (1, 0.96 * w)],
        (kick, 1.05 * kick), kit.between(0.004, 0.012))  # fmt: skip


def cruiser_board(kit: Kit) -> None:
    """Small, of coloured plastic: a tapered nose, a kicked tail."""
    w = kit.between(0.08, 0.095)
    _board(kit, plastic(kit.tint(PAINTS, 0.4)), kit.between(0.55, 0.66),
        [(-1, 0.8 * w), (-0.5, w), (0.3, 0.98 * w), (1, 0.6 * w)],
        (kit.between(0.03, 0.05), kit.between(0.005, 0.015)), 0.004)  # fmt: skip


def longboard(kit: Kit) -> None:
    """Long and flat, with pointed ends or cut-outs at the wheels."""
    w = kit.between(0.11, 0.13)
    pointed = kit.chance(0.5)
    ends = [(-1, 0.25 * w), (-0.6, 0.8 * w), (0.0, w), (0.6, 0.85 * w), (1, 0.45 * w)]
    cuts = [(-1, 0.5 * w), (-0.75, 0.55 * w), (-0.5, 0.95 * w), (0.5, 0.95 * w), (0.75, 0.55 * w), (1, 0.5 * w)]
    line = ends if pointed else cuts
    _board(kit, paint(kit.tint(WOODS)), kit.between(0.92, 1.05), line,
        (kit.between(0.0, 0.015), kit.between(0.0, 0.015)), kit.between(-0.004, 0.006))  # fmt: skip


def old_school_board(kit: Kit) -> None:
    """Wide, with a blunt nose and a kicked tail."""
    w = kit.between(0.118, 0.132)
    _board(kit, kit.lacquer(0.4), kit.between(0.74, 0.8), [(-1, 0.8 * w), (-0.55, 0.88 * w), (0.1, w),
        (0.6, 0.84 * w), (1, 0.62 * w)], (kit.between(0.05, 0.07), kit.between(0.01, 0.03)), 0.007)  # fmt: skip


SKATEBOARDS = (street_board, cruiser_board, longboard, old_school_board)
