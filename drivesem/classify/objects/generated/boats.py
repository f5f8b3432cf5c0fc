"""Generators of boats: sailing, motor, rowing and fishing boats, ships."""

from __future__ import annotations

import numpy as np

from drivesem.classify.objects.generated.builder import (
    BLACK,
    CHROME,
    GLASS,
    LAMP,
    PAINTS,
    RUBBER,
    STEEL,
    WHITE,
    WOODS,
    ObjectBuilder,
    Surface,
    dull,
    metal,
    paint,
)
from drivesem.classify.objects.generated.shapes import (
    FORWARD,
    UP,
    Array,
    ball,
    beams,
    block,
    boxes,
    lathe,
    loft,
    points,
    rectangle,
    rotate,
    slab,
    torus,
    translate_solid,
    tube,
)
from scene_ir.meshes.solids import TemplateSolid


def _sections(length: float, beam: float, depth: float, sheer: float, stern: float, full: float = 2.0) -> Array:
    """Compute sections (17, 13, 3) of a hull, stern to bow, each from gunwale to gunwale.

    Args:
        length: Length of the hull.
        beam: Its width.
        depth: Its height at the stern.
        sheer: Rise of the bow.
        stern: Width of the transom, as a fraction of the beam.
        full: Squareness below the water line.
    """
    t = np.linspace(0, 1, 17)[:, None]
    s = np.linspace(-1, 1, 13)
    aft, fore = stern + (1 - stern) * np.sin(np.pi / 2 * t / 0.4), 1 - ((t - 0.4) / 0.6).clip(0, 1) ** 2.2
    half = beam / 2 * np.where(t < 0.4, aft, fore).clip(0.015)
    deck = depth + sheer * t**2.2
    keel = 0.75 * deck * ((t - 0.72) / 0.28).clip(0) ** 2.0
    x = length * (t - 0.5) + 0.1 * length * t**6 * np.abs(s) ** 1.5
    y = keel + (deck - keel) * np.abs(s) ** (2.2 * full)
    z = half * np.sign(s) * np.abs(s) ** (1 / full)
    return points(x, y, z)


def _hull(obj: ObjectBuilder, sections: Array, top: Surface, bottom: Surface, deck: Surface) -> None:
    """Add a closed hull: sides, another colour below the water line, a deck, a rail."""
    obj.add(top, loft(sections))
    unit = 0.002 * float(np.ptp(sections[..., 0]))
    lower = sections[:, 3:-3]
    obj.add(bottom, slab((lower - 2 * unit * UP) * [1.0, 1.0, 1.03], lower * [0.98, 1, 0.9] + 0.01 * UP))
    rim = sections[:, [0, -1]]
    s = np.linspace(0.06, 0.94, 5)[:, None]
    planks = rim[1:-1, :1] * (1 - s) + rim[1:-1, 1:] * s
    obj.add(deck, slab(planks + 2 * unit * UP, planks - 2 * unit * UP))
    obj.pair(bottom, tube(sections[:, -1], 3 * unit, 6))


def _sail(*corners: tuple[float, float, float], belly: float) -> TemplateSolid:
    """A sail between tack, clew and head; `belly` is its depth to the right."""
    tack, clew, head = np.array(corners)
    u, v = np.linspace(0, 1, 8)[:, None, None], np.linspace(0, 1, 9)[None, :, None]
    foot = tack + (clew - tack) * u
    grid = foot + (head - foot) * v * 0.985
    grid = grid + np.array([0, 0, belly]) * 4 * u * (1 - u) * (1 - v) ** 0.5 * np.minimum(1, 3 * v + 0.4)
    return slab(grid, grid - [0, 0, 0.02])


def sailboat(obj: ObjectBuilder) -> None:
    """A keel yacht: mast, main sail, jib, a low cabin."""
    long = obj.uniform(7, 10)
    beam, depth = long * obj.uniform(0.28, 0.34), long * obj.uniform(0.1, 0.13)
    hull, below = WHITE if obj.chance(0.6) else obj.lacquer(), obj.lacquer()
    sections = _sections(long, beam, depth, 0.05 * long, obj.uniform(0.5, 0.75), 1.5)
    _hull(obj, sections, hull, below, dull(obj.tint(WOODS)))
    x0, x1 = -0.12 * long, 0.17 * long
    obj.add(hull, loft([rectangle((x0, x1 - 0.6 * rise * long), depth + rise * long,
        0.3 * beam - 0.4 * rise * long) for rise in (0, 0.05, 0.075)]))  # fmt: skip
    panes = points(np.linspace(x0 + 0.6, x1 - 0.7, 3), depth + 0.035 * long, 0.275 * beam)
    obj.pair(GLASS, boxes(panes, (0.09 * long, 0.03 * long, 0.05 * beam)))
    mast, top = 0.08 * long, depth + long * obj.uniform(1.05, 1.25)
    obj.add(STEEL, tube([(mast, depth, 0), (mast, top, 0)], [0.012 * long, 0.007 * long], 8))
    boom, low = -0.36 * long, depth + 0.15 * long
    obj.add(STEEL, tube([(mast, low, 0), (boom, low - 0.01 * long, 0.02 * long)], 0.008 * long, 6))
    belly = obj.uniform(0.05, 0.09) * long * (1 if obj.chance(0.5) else -1)
    cloth = dull((0.74, 0.73, 0.69)) if obj.chance(0.7) else dull(obj.tint(PAINTS))
    tack, clew, peak = (mast - 0.1, low + 0.1, 0), (boom + 0.2, low + 0.1, 0.02 * long), (mast - 0.1, top - 0.1, 0)
    obj.add(cloth, _sail(tack, clew, peak, belly=belly))
    bow = (0.5 * long, depth + 0.06 * long, 0.0)
    second = cloth if obj.chance(0.6) else dull(obj.tint(PAINTS))
    clew, peak = (mast - 0.06 * long, low - 0.04 * long, 0.05 * long), (mast + 0.02 * long, top - 0.12 * long, 0)
    obj.add(second, _sail(bow, clew, peak, belly=belly))
    obj.add(STEEL, beams([bow, (-0.48 * long, depth, 0)], (mast, top, 0), 0.003 * long))
    obj.pair(STEEL, beams((mast, depth, 0.45 * beam), (mast, 0.94 * top, 0.0), 0.003 * long))
    obj.add(dull((0.03, 0.03, 0.035)), loft([rectangle((-0.08 * long, 0.06 * long), -0.13 * long, 0.012 * long),
        rectangle((-0.1 * long, 0.1 * long), 0.03 * long, 0.02 * long)]))  # fmt: skip
    obj.add(BLACK, block((-0.47 * long, -0.41 * long), (-0.06 * long, 0.06 * long), 0.01 * long))


def motor_yacht(obj: ObjectBuilder) -> None:
    """A sharp white hull, one deck or two with dark glass, a mast for lamps, a rail."""
    long = obj.uniform(10, 16)
    beam, depth = long * obj.uniform(0.27, 0.32), long * obj.uniform(0.13, 0.16)
    hull = WHITE if obj.chance(0.7) else paint(obj.tint(((0.015, 0.03, 0.12), (0.05, 0.05, 0.055))))
    _hull(obj, _sections(long, beam, depth, 0.07 * long, 0.85, 1.3), hull, obj.lacquer(), dull(obj.tint(WOODS)))
    decks, w = obj.integer(1, 2), 0.36 * beam
    x0, x1, y = -0.34 * long, obj.uniform(0.16, 0.24) * long, depth + 0.02 * long
    h, lean = 0.095 * long, 0.1 * long
    for _ in range(decks):
        low = rectangle((x0, x1), y - 0.03 * long, w)
        high = rectangle((x0 + 0.02 * long, x1 - lean), y + h, 0.86 * w)
        obj.add(WHITE, loft([low, high]))
        strip = [low * (1 - v) + high * v for v in (0.35, 0.88)]
        obj.add(GLASS, loft([part * [1, 1, 1.03] + 0.02 * long * FORWARD for part in strip]))
        obj.add(WHITE, block((x0 - 0.04 * long, x1 - lean + 0.02 * long),
            (y + h - 0.006 * long, y + h + 0.012 * long), 0.98 * w, 0.01 * long))  # fmt: skip
        x0, x1, y, w = x0 + 0.04 * long, x1 - lean - 0.03 * long, y + h, 0.86 * w
    screen = rectangle((x1 - 0.06 * long, x1 - 0.05 * long), y + 0.04 * long, 0.7 * w)
    obj.add(GLASS, loft([rectangle((x1 - 0.02 * long, x1 + 0.005 * long), y, 0.75 * w), screen]))
    bench = (x0 + 0.1 * long, x0 + 0.2 * long)
    obj.add(dull((0.55, 0.5, 0.42)), block(bench, (y, y + 0.035 * long), 0.6 * w, 0.01 * long))
    x0, y, w = x0 + 0.04 * long, y + 0.03 * long, 0.86 * w
    obj.pair(WHITE, beams((x0 + 0.02 * long, y - 0.04 * long, 0.8 * w),
        (x0 + 0.06 * long, y + 0.06 * long, 0.7 * w), 0.03 * long, 0.015 * long))  # fmt: skip
    obj.add(WHITE, block((x0 + 0.03 * long, x0 + 0.09 * long), (y + 0.05 * long, y + 0.065 * long), 0.75 * w,
        0.005 * long))  # fmt: skip
    obj.add(WHITE, ball((x0 + 0.06 * long, y + 0.085 * long, 0), 0.022 * long, 12))
    obj.add(STEEL, tube([(x0 + 0.05 * long, y + 0.06 * long, 0.1 * w),
        (x0 + 0.02 * long, y + 0.2 * long, 0.1 * w)], 0.003 * long, 6))  # fmt: skip
    foot = _sections(long, 0.94 * beam, depth, 0.07 * long, 0.85)[8:16, -1]
    rail = foot + 0.05 * long * UP
    obj.pair(CHROME, tube(rail, 0.003 * long, 6), beams(foot, rail, 0.004 * long))
    obj.pair(BLACK, *(ball((x * long, 0.72 * depth, 0.485 * beam), (0.012 * long, 0.012 * long, 0.004 * long), 10)
        for x in (-0.15, -0.05, 0.05)))  # fmt: skip


def rowing_boat(obj: ObjectBuilder) -> None:
    """An open shell of wood with thwarts and two oars."""
    long = obj.uniform(3.2, 4.4)
    beam, depth = long * obj.uniform(0.34, 0.42), long * obj.uniform(0.12, 0.15)
    wood = paint(obj.tint(WOODS)) if obj.chance(0.5) else obj.lacquer()
    inside = dull(obj.tint(WOODS))
    outer = _sections(long, beam, depth, 0.09 * long, obj.uniform(0.35, 0.75), 1.5)
    inner = outer * [0.96, 0.86, 0.9] + (0.14 * depth + 0.02) * UP
    inner[..., 1] = np.where(np.abs(np.linspace(-1, 1, 13)) > 0.99, outer[..., 1], inner[..., 1])
    obj.add(wood, slab(outer, outer * [0.99, 0.95, 0.96] + 0.03 * UP))
    obj.add(inside, slab(outer * [0.985, 0.95, 0.955] + 0.032 * UP, inner))
    transom = outer[0]
    obj.add(wood, loft([transom + 0.06 * FORWARD, transom - 0.01 * FORWARD]))
    obj.pair(inside, tube(outer[:, -1], 0.028, 6))
    for x in (-0.28 * long, -0.02 * long, 0.22 * long):
        here = np.interp(x, outer[:, -1, 0], outer[:, -1, 2])
        obj.add(inside, block((x - 0.11, x + 0.11), (0.78 * depth, 0.78 * depth + 0.035), 0.93 * here, 0.01))
    oar, out = dull(obj.tint(WOODS)), obj.uniform(0.9, 1.3)
    end = np.array([obj.uniform(-0.35, 0.1) * long, 0.35 * depth, beam / 2 + out])
    grip, lock = np.array([0.02 * long, 1.45 * depth, 0.12]), np.array([-0.06 * long, 1.08 * depth, beam / 2])
    way = (end - lock) / np.linalg.norm(end - lock)
    obj.pair(oar, tube([grip, lock, end], 0.022, 6), beams(end - 0.1 * way, end + 0.4 * way, 0.035, 0.14))
    obj.pair(STEEL, torus(lock, 0.04, 0.01, "x", 12))
    for x in np.linspace(-0.36, 0.3, 7) * long:
        y, z = (np.array([np.interp(x, outer[:, j, 0], outer[:, j, k]) for j in range(1, 12)]) for k in (1, 2))
        obj.add(inside, tube(points(x, y + 0.06, 0.86 * z), 0.014, 4))


def fishing_boat(obj: ObjectBuilder) -> None:
    """A high bow, a wheelhouse, masts with a boom, tyres as fenders, a drum for the net."""
    long = obj.uniform(9, 13)
    beam, depth = long * obj.uniform(0.32, 0.38), long * obj.uniform(0.16, 0.2)
    hull, below, house = obj.lacquer(), obj.lacquer(), WHITE if obj.chance(0.7) else obj.lacquer()
    sections = _sections(long, beam, depth, 0.13 * long, 0.72, 1.7)
    _hull(obj, sections, hull, below, dull(obj.tint(WOODS)))
    obj.pair(WHITE, tube(sections[:, -1] - 0.035 * long * UP, 0.008 * long, 6))
    x = obj.uniform(-0.24, 0.1) * long
    w, h, d = 0.28 * beam, obj.uniform(0.2, 0.25) * long, 0.11 * long
    obj.add(house, block((x - d, x + d), (depth - 0.02 * long, depth + h), w, 0.02 * long))
    obj.add(below, block((x - 1.15 * d, x + 1.2 * d), (depth + h, depth + h + 0.02 * long), 1.15 * w,
        0.006 * long))  # fmt: skip
    level = depth + 0.68 * h
    front, sides = points(x + d, level, [-0.6 * w, 0, 0.6 * w]), points([x - 0.4 * d, x + 0.45 * d], level, w)
    obj.add(GLASS, boxes(front, (0.01 * long, 0.06 * long, 0.45 * w)))
    obj.pair(GLASS, boxes(sides, (0.6 * d, 0.06 * long, 0.012 * long)))
    top = depth + obj.uniform(0.55, 0.75) * long
    for mast, height in ((0.3 * long, 0.85 * top), (x - 1.6 * d, top)):
        pole = tube([(mast, depth, 0), (mast, height, 0)], [0.012 * long, 0.006 * long], 8)
        obj.add(dull(obj.tint(WOODS)), pole)
        stays = points(mast, depth, [0.4 * beam, -0.4 * beam])
        obj.add(STEEL, beams((mast, height, 0), stays, 0.003 * long))
        obj.add(STEEL, beams((mast, 0.6 * height, 0), (mast - 0.2 * long, 0.9 * height, 0), 0.01 * long))
    obj.add(STEEL, beams((0.3 * long, 0.85 * top, 0), (0.5 * long, depth + 0.12 * long, 0), 0.003 * long))
    drum, end = (-0.38 * long, depth + 0.07 * long, 0), 0.24 * beam
    obj.add(dull((0.03, 0.16, 0.12)), lathe([(0.05 * long, -end), (0.05 * long, end)], drum, "z", 14))
    obj.pair(STEEL, lathe([(0.07 * long, end), (0.07 * long, 0.26 * beam)], drum, "z", 16))
    for place in (-0.3, -0.1, 0.1):
        z = np.interp(place * long, sections[:, -2, 0], sections[:, -2, 2])
        obj.pair(RUBBER, torus((place * long, 0.72 * depth, 1.02 * z), 0.035 * long, 0.015 * long, "z", 16))
    obj.add(LAMP, ball((x + d, depth + h + 0.04 * long, 0), 0.02 * long, 10))
    obj.pair(paint((0.65, 0.15, 0.01)), torus((x, depth + 0.4 * h, w), 0.035 * long, 0.01 * long, "z", 16))


def ship(obj: ObjectBuilder) -> None:
    """A long hull with containers and a bridge behind, or rows of decks with a funnel."""
    long = obj.uniform(60, 80)
    cargo = obj.chance(0.5)
    beam, depth = long * obj.uniform(0.16, 0.19), long * obj.uniform(0.09, 0.115)
    colours = ((0.02, 0.03, 0.06), (0.45, 0.03, 0.02), (0.03, 0.15, 0.08), (0.02, 0.06, 0.3))
    hull = paint(obj.tint(colours)) if cargo else WHITE
    sections = _sections(long, beam, depth, 0.05 * long, 0.85, 2.2)
    _hull(obj, sections, hull, paint((0.35, 0.03, 0.02)) if cargo else obj.lacquer(), dull((0.25, 0.08, 0.05)))
    stripe, w = obj.lacquer(), 0.44 * beam
    x0, x1, rows = -0.4 * long, -0.29 * long, 5
    if cargo:
        size = np.array([0.115 * long, 0.033 * long, 0.2 * beam])
        for x in np.arange(-0.2, 0.34, 0.125) * long:
            for z in (-1.5, -0.5, 0.5, 1.5):
                for level in range(obj.integer(2, 4) if abs(z) < 1 or x < 0.25 * long else 0):
                    place = [(x, depth + (level + 0.5) * size[1] + 0.02 * long, 1.04 * z * size[2])]
                    obj.add(metal(obj.tint(PAINTS)), boxes(place, size))
    else:
        x1, rows = 0.26 * long, obj.integer(3, 5)
    y, step, b = depth, 0.033 * long, x1
    for i in range(rows):
        shrink = 0.0 if cargo else 0.035 * long * i
        a, b = x0 + 0.5 * shrink, x1 - shrink
        obj.add(WHITE, block((a, b), (y, y + step), w * (1 - 0.03 * i), 0.004 * long))
        x = np.arange(a + 0.015 * long, b - 0.01 * long, 0.018 * long if cargo else 0.02 * long)
        panes = points(x, y + 0.55 * step, w * (1 - 0.03 * i))
        obj.pair(GLASS, boxes(panes, (0.011 * long, 0.4 * step, 0.02 * beam)))
        y += step
    obj.add(GLASS, block((b - 0.002 * long, b + 0.003 * long), (y - 0.7 * step, y - 0.25 * step), 0.8 * w))
    obj.add(WHITE, block((b - 0.05 * long, b + 0.005 * long), (y, y + 0.6 * step), 1.1 * w, 0.003 * long))
    obj.add(BLACK, block((b + 0.003 * long, b + 0.007 * long), (y + 0.15 * step, y + 0.45 * step), 1.0 * w))
    funnel = -0.37 * long if cargo else obj.uniform(-0.22, -0.05) * long
    for x in (funnel,) if cargo or obj.chance(0.5) else (funnel, funnel + 0.12 * long):
        outer, rim = [(0.03, 0.0), (0.026, 0.075), (0.026, 0.08)], [(0.027, 0.06), (0.025, 0.09)]
        for colour, profile in ((stripe, outer), (BLACK, rim)):
            pipe = lathe(np.array(profile) * long, sides=18)
            obj.add(colour, translate_solid(rotate(pipe, "z", 0.15), (x, y, 0)))
    for x, foot, high in ((b - 0.03 * long, y, 0.1 * long), (0.42 * long, depth, 0.14 * long)):
        obj.add(STEEL, tube([(x, foot, 0), (x, foot + high, 0)], 0.004 * long, 6))
    boats = [x0 + 0.05 * long] if cargo else np.linspace(x0 + 0.1 * long, 0.2 * long, 6)
    obj.pair(paint((0.65, 0.2, 0.01)), *(ball((x, depth + 1.4 * step, 1.03 * w),
        (0.022 * long, 0.01 * long, 0.01 * long), 10) for x in boats))  # fmt: skip


BOATS = (sailboat, motor_yacht, fishing_boat, rowing_boat, ship)
