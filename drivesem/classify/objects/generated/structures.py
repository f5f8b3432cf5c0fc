"""Generators of benches, bins, mailboxes, towers and helmets; the face of a helmet is towards +x."""

from __future__ import annotations

from itertools import cycle, pairwise, product

import numpy as np

from drivesem.classify.objects.generated.shapes import (
    BLACK,
    CHROME,
    FORWARD,
    GLASS,
    IRON,
    LAMP,
    PAINTS,
    RIM_AZIMUTHS,
    RUBBER,
    STEEL,
    STONES,
    UP,
    WHITE,
    WOODS,
    Array,
    ObjectBuilder,
    Surface,
    ball,
    beams,
    block,
    bowl,
    box,
    boxes,
    circle,
    direction,
    dome,
    dull,
    lathe,
    loft,
    metal,
    paint,
    plastic,
    points,
    rectangle,
    rotate,
    rotate_each,
    slab,
    squares,
    torus,
    translate_solid,
    tube,
)
from scene_ir.meshes.solids import TemplateSolid


def _slats(obj: ObjectBuilder, wood: Surface, line: list[tuple[float, float]], length: float, wide: float) -> None:
    """Add boards along z at points (x, y) of a bench's section, each rotated along the section."""
    places = np.array(line)
    for (x, y), way in zip(places, np.gradient(places, axis=0), strict=True):
        board = block((-wide / 2, wide / 2), (-0.016, 0.016), length / 2, 0.008)
        obj.add(wood, translate_solid(rotate(board, "z", np.arctan2(way[1], way[0])), (x, y, 0)))


def park_bench(obj: ObjectBuilder) -> None:
    """Slats on cast iron ends with scrolled arms."""
    length, count, backs, lean = (
        obj.uniform(1.3, 1.9),
        obj.integer(5, 7),
        obj.integer(3, 5),
        obj.uniform(0.15, 0.32),
    )
    seat = [(0.22 - 0.44 * t, 0.45 - 0.02 * np.sin(np.pi * t)) for t in np.linspace(0, 1, count)]
    back = [(-0.27 - lean * h, 0.5 + h) for h in np.linspace(0.06, 0.4, backs)]
    wood, iron = dull(obj.tint(WOODS)), IRON if obj.chance(0.6) else metal((0.02, 0.1, 0.05))
    _slats(obj, wood, seat, length, 0.36 / count)
    _slats(obj, wood, back, length, 0.075)
    for z in (0.46 * length, 0.0) if length > 1.7 else (0.46 * length,):
        foot = [(0.3, 0.0, z), (0.24, 0.2, z), (0.24, 0.42, z), (-0.24, 0.42, z), (back[-1][0] - 0.03, 0.92, z)]
        rear = [(-0.4, 0.0, z), (-0.28, 0.2, z), (-0.24, 0.43, z)]
        obj.pair(iron, tube(foot, 0.022, 6), tube(rear, 0.022, 6))
        arm = [(0.24, 0.42, z), (0.3, 0.6, z), (0.22, 0.68, z), (-0.05, 0.66, z), (-0.32, 0.7, z)]
        obj.pair(iron, tube(arm, 0.02, 6), torus((0.22, 0.61, z), 0.05, 0.014, "z", 14))
        obj.pair(iron, torus((0.0, 0.3, z), 0.09, 0.014, "z", 16))


def garden_bench(obj: ObjectBuilder) -> None:
    """All of wood: four legs, arms, a back of upright bars."""
    half, wood = obj.uniform(0.6, 0.85), dull(obj.tint((*WOODS, (0.62, 0.62, 0.6), (0.1, 0.22, 0.28))))
    top = obj.uniform(0.86, 1.0)
    posts = [((0.24, z), 0.66) for z in (half, -half)] + [((-0.26, z), top) for z in (half, -half)]
    obj.add(wood, *(box((x - 0.035, 0, z - 0.035), (x + 0.035, h, z + 0.035), 0.008) for (x, z), h in posts))
    seats = obj.integer(4, 6)
    for x in np.linspace(0.23, -0.2, seats):
        obj.add(wood, block((x - 0.19 / seats, x + 0.19 / seats), (0.43, 0.455), half, 0.006))
    obj.pair(wood, box((-0.3, 0.64, half - 0.045), (0.31, 0.675, half + 0.045), 0.01))
    obj.add(wood, block((0.215, 0.245), (0.34, 0.42), half), block((-0.28, -0.24), (0.5, 0.57), half))
    rise = obj.uniform(0.0, 0.12)
    rail, bars = np.linspace(-half, half, 9), np.linspace(-0.92 * half, 0.92 * half, obj.integer(9, 15))
    line, ends = (points(-0.26, top - 0.06 + rise * (1 - (z / half) ** 2), z) for z in (rail, bars))
    obj.add(wood, tube(line, 0.045, 4), beams(ends * [1, 0, 1] + 0.54 * UP, ends, 0.022, 0.04))
    obj.pair(wood, box((-0.24, 0.16, half - 0.02), (0.22, 0.21, half + 0.02)))


def stone_bench(obj: ObjectBuilder) -> None:
    """A slab on two blocks, or with a backrest on them."""
    half, stone = obj.uniform(0.65, 0.95), dull(obj.tint(STONES))
    thick, deep = obj.uniform(0.07, 0.13), obj.uniform(0.2, 0.26)
    obj.add(stone, block((-deep, deep), (0.45 - thick, 0.45), half, 0.02))
    foot, width = obj.uniform(0.55, 0.8) * half, obj.uniform(0.06, 0.14)
    profile = [(1.0, 0.0), (1.0, 0.12), (0.72, 0.2), (0.72, 0.75), (1.0, 0.86), (1.0, 1.0)]
    leg = loft([rectangle((-0.8 * deep * s, 0.8 * deep * s), (0.45 - thick) * t, width * s) for s, t in profile])
    obj.add(stone, translate_solid(leg, (0, 0, foot)), translate_solid(leg, (0, 0, -foot)))
    wood = dull(obj.tint(WOODS))
    for x in np.linspace(-0.82 * deep, 0.82 * deep, 7):
        obj.add(wood, block((x - 0.11 * deep, x + 0.11 * deep), (0.445, 0.475), 0.96 * half, 0.012))
    if obj.chance(0.5):
        obj.pair(stone, box((-deep - 0.06, 0.4, foot - 0.08), (-deep + 0.04, 0.85, foot + 0.08), 0.015))
        for y in ((0.58, 0.68), (0.73, 0.83)):
            obj.add(wood, block((-deep, -deep + 0.05), y, 0.96 * half, 0.012))


def steel_bench(obj: ObjectBuilder) -> None:
    """One curved seat of bars on looped legs of steel."""
    half, colour = obj.uniform(0.65, 0.95), metal(obj.tint((*PAINTS, (0.3, 0.31, 0.32)), 0.15))
    high = obj.uniform(0.36, 0.46)
    curve = [(0.27, 0.4), (0.25, 0.44), (0.16, 0.45), (0.04, 0.43), (-0.1, 0.42), (-0.2, 0.44), (-0.26, 0.52),
        (-0.29, 0.62), (-0.32, 0.72), (-0.36, 0.42 + high), (-0.41, 0.43 + high)]  # fmt: skip
    for z in np.linspace(-half, half, obj.integer(14, 22)):
        obj.add(colour, tube([(x, y, z) for x, y in curve], 0.012, 4))
    for x, y in (curve[0], curve[3], curve[5], curve[-1]):
        obj.add(colour, tube([(x, y, -half - 0.02), (x, y, half + 0.02)], 0.018, 6))
    for side in (0.8 * half, -0.8 * half):
        loop = [(0.2, 0.43, side), (0.24, 0.03, side), (0.15, 0.0, side), (-0.28, 0.0, side), (-0.32, 0.04, side)]
        obj.add(STEEL, tube([*loop, (-0.22, 0.43, side)], 0.025, 8))


BENCHES = (park_bench, garden_bench, steel_bench, stone_bench)


def dustbin(obj: ObjectBuilder) -> None:
    """A ribbed can of zinc with a lid and a handle on each side."""
    r, h = obj.uniform(0.24, 0.3), obj.uniform(0.58, 0.76)
    zinc = metal(obj.tint(((0.36, 0.38, 0.4), (0.3, 0.31, 0.32), (0.06, 0.14, 0.09))))
    ribs, rows = obj.integer(10, 16), [(1.0, 0.0), (0.86, 0.02)]
    for t in np.linspace(0.08, 0.95, ribs):
        rows += [(0.87 + 0.13 * t, t - 0.02), (0.91 + 0.13 * t, t)]
    obj.add(zinc, lathe([(0.9 * r * a, h * t) for a, t in [*rows, (1.0, 0.97)]], sides=28))
    lid, grip = obj.uniform(0.06, 0.16), obj.uniform(0.05, 0.08)
    dome = [(1.06, -0.06), (1.08, 0.02), (0.98, 0.16), (0.75, 0.55), (0.4, 0.9), (0.0, 1.0)]
    obj.add(zinc, lathe([(r * a, lid * t) for a, t in dome], (0, h, 0), sides=28))
    low, high = h + 0.9 * lid, h + lid + 0.06
    obj.add(zinc, tube(points(0, [low, high, high, low], [-grip, -grip, grip, grip]), 0.012, 6))
    out = np.array([r, r + 0.05, r + 0.05, r]) * 0.97
    obj.pair(zinc, tube(points([-grip, -grip, grip, grip], 0.72 * h, out), 0.012, 6))


def wheeled_bin(obj: ObjectBuilder) -> None:
    """A tapered bin with a sloping lid, a handle behind, two wheels."""
    colour = obj.tint(((0.03, 0.16, 0.05), (0.03, 0.03, 0.032), (0.02, 0.07, 0.28), (0.45, 0.3, 0.01),
        (0.16, 0.08, 0.03)))  # fmt: skip
    coat, lid = plastic(colour), plastic(colour if obj.chance(0.5) else obj.tint(PAINTS))
    w, h, d = obj.uniform(0.24, 0.32), obj.uniform(0.85, 1.0), obj.uniform(0.27, 0.33)
    obj.add(coat, loft([rectangle((-0.72 * d, 0.66 * d), 0.06, 0.76 * w), rectangle((-d, d), h, w)]))
    obj.add(coat, block((-1.04 * d, 1.06 * d), (h - 0.1, h - 0.03), 1.06 * w, 0.02))
    for y in (0.35 * h, 0.62 * h):
        s = 0.74 + 0.26 * y / h
        obj.add(coat, box((0.0, y - 0.01, -w * s - 0.012), (d * s + 0.008, y + 0.01, w * s + 0.012)))
    rim = rectangle((-1.05 * d, 1.08 * d), h, 1.06 * w)
    top = rectangle((-0.95 * d, 0.9 * d), h + 0.1, 0.92 * w)
    rim[[1, 2], 1] -= 0.02
    top[[1, 2], 1] -= 0.05
    obj.add(lid, loft([rim, top]))
    obj.add(lid, block((1.0 * d, 1.16 * d), (h - 0.01, h + 0.02), 0.3 * w, 0.01))
    bar = [(-0.98 * d, h - 0.02, 0.8 * w), (-1.3 * d, h + 0.02, 0.8 * w), (-1.3 * d, h + 0.02, -0.8 * w)]
    obj.add(coat, tube([*bar, (-0.98 * d, h - 0.02, -0.8 * w)], 0.016, 6))
    r = obj.uniform(0.09, 0.12)
    wheel, hub = [(0.5 * r, -0.03), (r, -0.025), (r, 0.025), (0.5 * r, 0.03)], (-0.78 * d, r, w * 0.86)
    obj.pair(RUBBER, lathe(wheel, hub, "z", 18))
    obj.pair(STEEL, lathe([(0.5 * r, -0.035), (0.5 * r, 0.036)], hub, "z", 12))
    obj.add(STEEL, tube([(-0.78 * d, r, -0.85 * w), (-0.78 * d, r, 0.85 * w)], 0.012, 6))
    obj.add(WHITE, boxes([(0.9 * d, 0.72 * h, 0)], (0.04, 0.14, 0.2)))


def pedal_bin(obj: ObjectBuilder) -> None:
    """A smooth cylinder with a domed lid and a pedal, or a flap that swings."""
    r, h = obj.uniform(0.15, 0.2), obj.uniform(0.42, 0.66)
    coat = CHROME if obj.chance(0.5) else obj.lacquer()
    rows = (BLACK, 1.03, 0.0, 0.05), (BLACK, 1.02, h, h + 0.025), (coat, 1.0, 0.04, h + 0.01)
    for surface, wide, low, high in rows:
        obj.add(surface, lathe([(wide * r, low), (wide * r, high)], sides=28))
    top, angle = obj.uniform(0.05, 0.14), np.linspace(0, np.pi / 2, 8)
    lid = lathe(np.stack([r * np.cos(angle), top * np.sin(angle)], 1), (0, h + 0.025, 0), sides=28)
    obj.add(coat if obj.chance(0.6) else BLACK, lid)
    obj.add(BLACK, block((r - 0.03, r + 0.085), (0.015, 0.035), 0.05, 0.006))
    obj.add(BLACK, block((-r - 0.05, -r + 0.02), (h - 0.03, h + 0.06), 0.04, 0.01))


def slatted_bin(obj: ObjectBuilder) -> None:
    """A park's bin: slats around a bucket, with a hood on posts or an open ring."""
    r, h, n = obj.uniform(0.24, 0.32), obj.uniform(0.7, 0.9), obj.integer(14, 22)
    wood = dull(obj.tint(WOODS)) if obj.chance(0.6) else metal(obj.tint(PAINTS))
    bucket = [(0.86 * r, 0.06), (0.86 * r, h - 0.1), (0.8 * r, h - 0.1), (0.8 * r, 0.1)]
    obj.add(BLACK, lathe(bucket, sides=24))
    slat = block((0.9 * r, r), (0.05, h), 0.36 * 2 * np.pi * r / n, 0.006)
    obj.add(wood, *rotate_each(slat, 2 * np.pi * np.arange(n) / n))
    obj.add(IRON, *(torus((0, y * h, 0), 0.985 * r, 0.022, "y", 28) for y in (0.14, 0.55, 0.92)))
    obj.add(IRON, lathe([(0.5 * r, 0.0), (0.5 * r, 0.06)], sides=24))
    if obj.chance(0.6):
        for angle in (0.5, 2.6, 3.7, 5.8):
            x, z = 0.9 * r * np.cos(angle), 0.9 * r * np.sin(angle)
            obj.add(IRON, tube([(x, h - 0.05, z), (x, h + 0.22, z)], 0.014, 6))
        hood = [(1.08 * r, 0.0), (1.06 * r, 0.03), (0.6 * r, 0.1), (0.0, 0.13)]
        obj.add(IRON, lathe(hood, (0, h + 0.21, 0), sides=24))
    else:
        obj.add(IRON, torus((0, h, 0), 0.9 * r, 0.035, "y", 28))


TRASHCANS = (wheeled_bin, dustbin, slatted_bin, pedal_bin)


def _tunnel(x: tuple[float, float], y: float, half: float, straight: float) -> TemplateSolid:
    """A box along x with a half circle on top; it stands at height y on straight sides."""
    angle = np.linspace(0, np.pi, 21)
    top = np.stack([y + straight + half * np.sin(angle), half * np.cos(angle)], 1)
    ring = np.concatenate([top, [(y, -half), (y, half)]])
    return loft([points(end, *ring.T) for end in x])


def _flag(obj: ObjectBuilder, x: float, y: float, z: float, size: float) -> None:
    red = paint((0.6, 0.015, 0.015))
    obj.add(red, box((x - 0.1 * size, y, z), (x + 0.1 * size, y + size, z + 0.012)))
    obj.add(red, box((x - 0.1 * size, y + 0.62 * size, z), (x + 0.62 * size, y + size, z + 0.012)))
    obj.add(CHROME, lathe([(0.018, -0.02), (0.018, 0.02)], (x, y + 0.04, z), "z", 10))


def rural_mailbox(obj: ObjectBuilder) -> None:
    """A tunnel of sheet metal with a door and a red flag, on a post."""
    half, long, height = obj.uniform(0.1, 0.14), obj.uniform(0.44, 0.58), obj.uniform(0.4, 0.75)
    coat = metal((0.42, 0.43, 0.45)) if obj.chance(0.35) else obj.lacquer()
    straight, x = obj.uniform(0.09, 0.14), (-0.4 * long, 0.6 * long)
    obj.add(coat, _tunnel(x, height, half, straight))
    obj.add(coat, _tunnel((x[1] - 0.005, x[1] + 0.018), height - 0.008, 1.06 * half, straight + 0.008))
    obj.add(coat, _tunnel((x[0] - 0.012, x[0] + 0.004), height - 0.006, 1.05 * half, straight + 0.006))
    obj.add(CHROME, block((x[1] + 0.01, x[1] + 0.05), (height + straight + 0.4 * half,
        height + straight + 0.75 * half), 0.02, 0.006))  # fmt: skip
    number = points(x[1] + 0.02, height + 0.6 * straight, [-0.05, 0.0, 0.05])
    obj.add(BLACK if coat.diffuse[1] > 0.25 else WHITE, boxes(number, (0.012, 0.06, 0.028)))
    _flag(obj, 0.25 * long, height + 0.5 * straight, half, obj.uniform(0.16, 0.22))
    wood = dull(obj.tint((*WOODS, (0.6, 0.6, 0.58))))
    if obj.chance(0.6):
        w = obj.uniform(0.04, 0.055)
        obj.add(wood, block((-w, w), (0, height), w, 0.01),
            block((-0.35 * long, 0.55 * long), (height - 0.03, height), 0.9 * half, 0.006))  # fmt: skip
        obj.add(wood, beams((0, height - 0.26, 0), (0.42 * long, height - 0.02, 0), 0.05, 0.05))
    else:
        obj.add(wood, block((-0.35, -0.25), (0, height + 0.42), 0.05, 0.012))
        obj.add(wood, block((-0.45, 0.55 * long), (height - 0.09, height), 0.04, 0.01))
        obj.add(wood, beams((-0.28, height - 0.35, 0), (0.05, height - 0.06, 0), 0.05, 0.05))
        cap = ((0.07, 0.42), (0.07, 0.45), (0.005, 0.53))
        obj.add(wood, translate_solid(squares([(s, height + y) for s, y in cap]), (-0.3, 0, 0)))


def collection_box(obj: ObjectBuilder) -> None:
    """A street's collection box: a rounded top over a slot, on four legs."""
    half, deep, straight = obj.uniform(0.28, 0.34), obj.uniform(0.26, 0.32), obj.uniform(0.62, 0.8)
    coat = paint(obj.tint(((0.015, 0.06, 0.28), (0.015, 0.06, 0.28), (0.62, 0.4, 0.01), (0.03, 0.18, 0.08))))
    obj.add(coat, rotate(_tunnel((-half, half), 0.18, deep, straight), "y", np.pi / 2))
    end = _tunnel((half - 0.01, half + 0.015), 0.17, 1.04 * deep, straight + 0.01)
    obj.pair(coat, rotate(end, "y", np.pi / 2))
    for x in (deep - 0.08, -deep):
        obj.pair(coat, box((x, 0, half - 0.08), (x + 0.08, 0.2, half), 0.01))
    slot = 0.18 + straight + 0.25 * deep
    obj.add(BLACK, block((0.6 * deep, 1.01 * deep), (slot - 0.02, slot + 0.06), 0.7 * half))
    obj.add(coat, block((0.7 * deep, 1.14 * deep), (slot - 0.06, slot - 0.02), 0.78 * half, 0.012))
    obj.add(CHROME, block((1.1 * deep, 1.17 * deep), (slot - 0.045, slot - 0.03), 0.2 * half))
    obj.add(WHITE, boxes([(deep, 0.18 + 0.62 * straight, 0)], (0.014, 0.16, 1.1 * half)))
    obj.add(paint((0.55, 0.02, 0.02)), boxes([(deep, 0.18 + 0.46 * straight, 0)], (0.014, 0.03, 1.1 * half)))
    obj.add(coat, block((deep - 0.01, deep + 0.012), (0.22, 0.18 + 0.38 * straight), 0.8 * half, 0.006))
    obj.add(CHROME, ball((deep + 0.01, 0.3, 0.6 * half), 0.02, 8))


def pillar_box(obj: ObjectBuilder) -> None:
    """A cast iron pillar with a cap, a slot and a notice."""
    r, h = obj.uniform(0.22, 0.27), obj.uniform(1.15, 1.4)
    coat = paint(obj.tint(((0.5, 0.01, 0.01), (0.5, 0.01, 0.01), (0.02, 0.2, 0.07), (0.6, 0.38, 0.01)), 0.15))
    obj.add(BLACK, lathe([(1.12 * r, 0.0), (1.12 * r, 0.1), (1.05 * r, 0.14)], sides=28))
    obj.add(coat, lathe([(r, 0.12), (r, h), (1.08 * r, h + 0.02), (1.08 * r, h + 0.05)], sides=28))
    cap = [(1.22, 0.0), (1.24, 0.05), (1.05, 0.11), (0.7, 0.18), (0.3, 0.22), (0.0, 0.23)]
    obj.add(coat, lathe([(r * a, 0.9 * b) for a, b in cap], (0, h + 0.05, 0), sides=28))
    obj.add(coat, torus((0, 0.24 * h, 0), r, 0.012, "y", 28), torus((0, 0.93 * h, 0), r, 0.014, "y", 28))
    obj.add(coat, block((0.8 * r, 1.1 * r), (0.8 * h, 0.9 * h), 0.62 * r, 0.015))
    obj.add(BLACK, block((0.9 * r, 1.115 * r), (0.835 * h, 0.872 * h), 0.5 * r))
    obj.add(WHITE, block((0.85 * r, 1.035 * r), (0.62 * h, 0.74 * h), 0.32 * r))
    obj.add(coat, block((0.75 * r, 1.02 * r), (0.28 * h, 0.6 * h), 0.6 * r, 0.02))
    obj.add(CHROME, ball((1.02 * r, 0.44 * h, 0.45 * r), 0.02, 8))


def house_mailbox(obj: ObjectBuilder) -> None:
    """A small house on a post: a pitched roof, a flap with a slot, a paper roll beneath."""
    half, deep, tall = obj.uniform(0.13, 0.19), obj.uniform(0.11, 0.16), obj.uniform(0.24, 0.34)
    foot, coat = obj.uniform(0.45, 0.8), obj.lacquer() if obj.chance(0.6) else dull(obj.tint(WOODS))
    roof, pitch = dull(obj.tint((*WOODS, (0.05, 0.05, 0.055), (0.3, 0.05, 0.03)))), obj.uniform(0.5, 0.9) * half
    obj.add(coat, block((-deep, deep), (foot, foot + tall), half, 0.008))
    eaves = foot + tall
    gable = [eaves, eaves, eaves + pitch], [-half, half, 0.0]
    obj.add(coat, loft([points(x, *gable) for x in (-deep, deep)]))
    for side in (1, -1):
        eave = np.array([0, foot + tall - 0.25 * pitch, 1.25 * half * side])
        ridge = np.array([0, foot + tall + pitch, 0])
        ring = np.array([eave, ridge, ridge + 0.025 * UP, eave + 0.025 * UP])
        obj.add(roof, loft([ring - 1.25 * deep * FORWARD, ring + 1.25 * deep * FORWARD]))
    trim = CHROME if obj.chance(0.5) else BLACK
    obj.add(BLACK, block((0.9 * deep, deep + 0.006), (foot + 0.66 * tall, foot + 0.8 * tall), 0.72 * half))
    flap = rotate(block((0, 0.014), (-0.01, 0.15 * tall), 0.78 * half, 0.004), "z", -0.5)
    obj.add(trim, translate_solid(flap, (deep + 0.004, foot + 0.7 * tall, 0)))
    obj.add(WHITE, block((0.9 * deep, deep + 0.006), (foot + 0.22 * tall, foot + 0.42 * tall), 0.4 * half))
    obj.add(trim, ball((deep + 0.01, foot + 0.32 * tall, 0.7 * half), 0.014, 10))
    if obj.chance(0.5):
        _flag(obj, -0.2 * deep, foot + 0.35 * tall, half, 0.17)
    obj.add(coat, lathe([(0.05, -deep), (0.05, deep), (0.04, deep), (0.04, -0.9 * deep)], (0, foot - 0.055, 0),
        "x", 24))  # fmt: skip
    post = dull(obj.tint(WOODS)) if obj.chance(0.5) else IRON
    obj.add(post, block((-0.03, 0.03), (0, foot), 0.03, 0.006))
    obj.add(dull(obj.tint(STONES)), squares([(0.15, 0), (0.15, 0.05), (0.1, 0.07)]))


MAILBOXES = (rural_mailbox, collection_box, house_mailbox, pillar_box)


_RED = paint((0.52, 0.015, 0.015))
_QUARTERS = np.arange(4) * np.pi / 2
_SQUARE = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
"""x and z of the corners of a square (4, 2)."""


def _lattice(
    obj: ObjectBuilder, surfaces: list[Surface], levels: np.ndarray, halves: np.ndarray, thick: float
) -> None:
    """Add a square lattice; `halves` are half its width at each level, and storeys alternate between surfaces."""
    x, z = _SQUARE.T
    rings, slim = [points(x * half, y, z * half) for y, half in zip(levels, halves, strict=True)], 0.55 * thick
    for (low, high), surface in zip(pairwise(rings), cycle(surfaces)):
        following_low, following_high = np.roll(low, -1, axis=0), np.roll(high, -1, axis=0)
        obj.add(surface, beams(low, high, thick), beams(low, following_high, slim),
            beams(following_low, high, slim), beams(high, following_high, slim))  # fmt: skip


def lattice_tower(obj: ObjectBuilder) -> None:
    """Four curved legs of iron that meet far up, platforms between, arches below."""
    height, foot = obj.uniform(0.9, 1.0), obj.uniform(0.17, 0.22)
    iron = metal(obj.tint(((0.1, 0.06, 0.035), (0.05, 0.045, 0.04), (0.25, 0.05, 0.02)), 0.2))
    first, second = obj.uniform(0.17, 0.23) * height, obj.uniform(0.36, 0.44) * height
    upper = np.linspace(second, 0.92 * height, 9)
    halves = np.interp(upper, [second, 0.55 * height, 0.75 * height, 0.92 * height],
        [0.3 * foot, 0.2 * foot, 0.11 * foot, 0.05 * foot])  # fmt: skip
    _lattice(obj, [iron], upper, halves, 0.008)
    storeys = ((1.0, 0.3, 0.0), (0.62, 0.24, first)), ((0.58, 0.22, first), (0.3, 0.14, second))
    for x, z in _SQUARE:
        for (a, w, y0), (b, v, y1) in storeys:
            dx, dz = np.array([[0, 0], [0, 1], [1, 0], [1, 1]]).T
            low, high = (points(x * foot * (c - u * dx), y, z * foot * (c - u * dz))
                for c, u, y in ((a, w, y0), (b, v, y1)))  # fmt: skip
            obj.add(iron, beams(low, high, 0.01))
            inner = np.array([0, 1])
            for p, q in pairwise(np.linspace(0, 1, 6)):
                low, high = (points(x * foot * (a + (b - a) * t - (w + (v - w) * t) * s), y0 + (y1 - y0) * t,
                    z * foot * (a + (b - a) * t)) for t, s in ((p, inner), (q, 1 - inner)))  # fmt: skip
                for swap, way in (([0, 1, 2], 1), ([2, 1, 0], [x * z, 1, x * z])):
                    obj.add(iron, beams(low[:, swap] * way, high[:, swap] * way, 0.006))
    for y, half in ((first, 0.68 * foot), (second, 0.38 * foot), (0.92 * height, 0.1 * foot)):
        obj.add(iron, squares([(half, y - 0.008), (1.08 * half, y + 0.012), (half, y + 0.016)]))
    angle = np.linspace(0, np.pi, 13)
    rise = 0.02 + 0.15 * height * np.sin(angle)
    arch = points(0.62 * foot * np.cos(angle), rise, 0.9 * foot * (1 - 0.3 * rise / first))
    obj.add(iron, *rotate_each(tube(arch, 0.007, 6), _QUARTERS))
    obj.add(iron, lathe([(0.05 * foot, 0.92 * height), (0.06 * foot, 0.945 * height), (0.012, 0.965 * height),
        (0.004, height + 0.05)], sides=10))  # fmt: skip
    obj.add(dull(obj.tint(STONES)), *(box((x * 0.86 * foot - 0.05, -0.01, z * 0.86 * foot - 0.05),
        (x * 0.86 * foot + 0.05, 0.012, z * 0.86 * foot + 0.05)) for x in (1, -1) for z in (1, -1)))  # fmt: skip


def radio_mast(obj: ObjectBuilder) -> None:
    """A slim trellis, in red and white bands, with dishes and rods."""
    foot, top, storeys = obj.uniform(0.065, 0.11), obj.uniform(0.012, 0.022), obj.integer(9, 13)
    levels = np.linspace(0, 0.86, storeys + 1)
    bands = [_RED, WHITE] if obj.chance(0.65) else [STEEL]
    _lattice(obj, bands, levels, np.linspace(foot, top, storeys + 1), 0.011)
    obj.add(bands[0], tube([(0, 0.86, 0), (0, 1.0, 0)], [0.008, 0.003], 8))
    obj.add(_RED, ball((0, 1.0, 0), 0.008, 8))
    for _ in range(obj.integer(2, 5)):
        y, turn, size = obj.uniform(0.55, 0.82), obj.uniform(-2, 2), obj.uniform(0.022, 0.04)
        reach = np.interp(y, [0, 0.86], [foot, top]) + 0.012
        dish = lathe([(0.2 * size, -0.02), (size, 0.0), (size, 0.012), (0.3 * size, 0.002)], (reach + 0.01, y, 0),
            "x", 16)  # fmt: skip
        obj.add(WHITE, rotate(dish, "y", turn))
        obj.add(STEEL, rotate(beams((0, y, 0), (reach, y, 0), 0.008), "y", turn))
    for turn in 2 * np.pi * np.arange(3) / 3:
        obj.add(WHITE, rotate(block((0.03, 0.04), (0.8, 0.87), 0.008), "y", turn))
        obj.add(STEEL, rotate(beams((0, 0.83, 0), (0.035, 0.83, 0), 0.006), "y", turn))
    half = 1.25 * foot
    obj.add(dull(obj.tint(STONES)), block((-half, half), (-0.02, 0.008), half))
    obj.add(WHITE, box((0.3 * foot, 0.0, 0.2 * foot), (1.3 * foot, 0.05, 1.2 * foot), 0.003))


def water_tower(obj: ObjectBuilder) -> None:
    """A tank high up, on braced legs or on one stem."""
    coat = paint(obj.tint(((0.6, 0.62, 0.62), (0.3, 0.45, 0.55), (0.5, 0.45, 0.35), (0.45, 0.1, 0.05))))
    r = obj.uniform(0.2, 0.28)
    top, tall = obj.uniform(0.5, 0.62), obj.uniform(0.16, 0.26)
    if obj.chance(0.6):
        flat = obj.chance(0.5)
        cone = [(1.06, tall), (0.0, tall + 0.55 * r)]
        dome = [(0.95, tall + 0.12 * r), (0.6, tall + 0.3 * r), (0.0, tall + 0.38 * r)]
        base = [(0.9, -0.0)] if flat else [(0.2, -0.45 * r), (0.6, -0.3 * r), (0.9, -0.1 * r)]
        rows = [*base, (1.0, 0.03), (1.0, tall), *(cone if flat else dome)]
        obj.add(coat, lathe([(a * r, y) for a, y in rows], (0, top, 0), sides=24))
        obj.add(STEEL, torus((0, top + 0.02, 0), 1.06 * r, 0.008, "y", 24),
            torus((0, top + 0.07, 0), 1.08 * r, 0.004, "y", 24))  # fmt: skip
        legs = obj.integer(4, 6)
        angle = 2 * np.pi * (np.arange(legs) + 0.5) / legs
        rings = [circle(s * r, y, angle) for s, y in ((1.25, 0), (1.08, 0.5 * top), (0.92, top + 0.02))]
        for low, high in pairwise(rings):
            obj.add(STEEL, beams(low, high, 0.022), beams(high, np.roll(high, -1, 0), 0.012),
                beams(low, np.roll(high, -1, 0), 0.007), beams(np.roll(low, -1, 0), high, 0.007))  # fmt: skip
        obj.add(STEEL, tube([(0, 0, 0), (0, top, 0)], 0.025, 10))
    else:
        stem = obj.uniform(0.06, 0.09)
        bulb = [(1.6 * stem, 0.0), (stem, 0.08), (stem, 0.8 * top), (1.5 * stem, top), (0.75 * r, top + 0.06),
            (r, top + 0.15), (r, top + 0.2), (0.75 * r, top + 0.3), (0.35 * r, top + 0.36),
            (0, top + 0.38)]  # fmt: skip
        obj.add(coat, lathe(bulb, sides=28))
        obj.add(paint(obj.tint(((0.02, 0.06, 0.4), (0.5, 0.02, 0.02), (0.02, 0.2, 0.06)))),
            lathe([(1.005 * r, top + 0.15), (1.01 * r, top + 0.2)], sides=28))  # fmt: skip
        obj.add(STEEL, torus((0, top + 0.37, 0), 0.25 * r, 0.006, "y", 20))
        obj.add(BLACK, block((1.1 * stem, 1.35 * stem), (0.0, 0.07), 0.02))
    obj.add(STEEL, tube([(0, top + tall, 0), (0, top + tall + 0.6 * r + 0.05, 0)], 0.005, 6))


def clock_tower(obj: ObjectBuilder) -> None:
    """A square shaft of stone with a clock on each side beneath a steep roof."""
    half, stone = obj.uniform(0.09, 0.125), dull(obj.tint((*STONES, (0.42, 0.2, 0.1))))
    trim = dull(obj.tint(STONES[:1]))
    roof = dull(obj.tint(((0.05, 0.06, 0.07), (0.06, 0.2, 0.15), (0.25, 0.06, 0.03))))
    shaft, head = obj.uniform(0.46, 0.56), obj.uniform(0.13, 0.17)
    obj.add(stone, squares([(1.12 * half, 0), (1.12 * half, 0.06), (half, 0.08), (half, shaft)]))
    obj.add(trim, squares([(half, shaft - 0.02), (1.18 * half, shaft), (1.18 * half, shaft + 0.015)]))
    obj.add(stone, squares([(1.08 * half, shaft), (1.08 * half, shaft + head)]))
    obj.add(trim, squares([(1.08 * half, shaft + head - 0.01), (1.25 * half, shaft + head + 0.012),
        (1.2 * half, shaft + head + 0.02)]))  # fmt: skip
    top = shaft + head + 0.02
    peak = obj.uniform(0.22, 0.34)
    if obj.chance(0.5):
        obj.add(roof, squares([(1.2 * half, top), (0.75 * half, top + 0.3 * peak), (0.12 * half, top + 0.9 * peak),
            (0.02 * half, top + peak)]))  # fmt: skip
    else:
        obj.add(stone, squares([(0.8 * half, top), (0.8 * half, top + 0.09)]))
        opening = block((0.78 * half, 0.82 * half), (top + 0.015, top + 0.075), 0.35 * half)
        obj.add(BLACK, *rotate_each(opening, _QUARTERS))
        obj.add(roof, squares([(0.95 * half, top + 0.09), (0.55 * half, top + 0.09 + 0.3 * peak),
            (0.02 * half, top + 0.09 + 0.8 * peak)]))  # fmt: skip
    face, middle = min(0.78 * half, 0.42 * head), shaft + 0.5 * head
    turn, panes = obj.uniform(0, 6), obj.integer(3, 5)
    out, size, angle = 1.08 * half, np.array([0.85, 0.55]), np.array([turn, turn + 2.2])
    hands = points(out + 0.018, middle + size * face * np.cos(angle), size * face * np.sin(angle))
    rows = [(half, 0.14 + (shaft - 0.2) * k / panes, z) for k in range(panes) for z in (-0.4 * half, 0.4 * half)]
    side = (
        (IRON, lathe([(1.12 * face, 0), (1.12 * face, 0.012)], (out, middle, 0), "x", 24)),
        (WHITE, lathe([(face, 0), (face, 0.015)], (out, middle, 0), "x", 24)),
        (BLACK, beams((out + 0.018, middle, 0), hands, 0.007)),
        (GLASS, boxes(rows, (0.012, 0.045, 0.26 * half))),
        (trim, box((half - 0.02, 0.05, half - 0.02), (1.06 * half, shaft, 1.06 * half))),
    )
    for quarter, (surface, solid) in product(_QUARTERS, side):
        obj.add(surface, rotate(solid, "y", quarter))
    obj.add(BLACK, block((1.05 * half, 1.15 * half), (0, 0.06), 0.3 * half))


def lighthouse(obj: ObjectBuilder) -> None:
    """A tapered tower in bands, a gallery, a lantern."""
    foot, head = obj.uniform(0.13, 0.17), obj.uniform(0.075, 0.1)
    band = paint(obj.tint(((0.5, 0.015, 0.015), (0.02, 0.02, 0.022), (0.02, 0.08, 0.35)), 0.15))
    rows, plain = obj.integer(4, 7), obj.chance(0.25)
    edges = np.linspace(0, 0.72, rows + 1)
    outline = np.stack([np.interp(edges, [0, 0.72], [foot, head]), edges], 1)
    for i, profile in enumerate(pairwise(outline)):
        obj.add(WHITE if plain or i % 2 else band, lathe(profile, sides=24))
    obj.add(BLACK, lathe([(head, 0.7), (1.45 * head, 0.725), (1.45 * head, 0.74)], sides=24))
    obj.add(BLACK, torus((0, 0.78, 0), 1.4 * head, 0.004, "y", 24))
    angle = 2 * np.pi * np.arange(12) / 12
    post = circle(1.4 * head, 0.74, angle)
    obj.add(BLACK, beams(post, post + 0.04 * UP, 0.005))
    obj.add(LAMP, lathe([(0.72 * head, 0.74), (0.72 * head, 0.84)], sides=12))
    glass = circle(0.74 * head, 0.74, angle)
    obj.add(BLACK, beams(glass, glass + 0.1 * UP, 0.006))
    obj.add(band, lathe([(0.9 * head, 0.84), (0.55 * head, 0.89), (0.1 * head, 0.92), (0.05 * head, 0.96)],
        sides=20))  # fmt: skip
    for i, y in enumerate(np.linspace(0.16, 0.6, obj.integer(2, 4))):
        r = np.interp(y, [0, 0.72], [foot, head])
        obj.add(GLASS, rotate(block((r - 0.02, r + 0.004), (y, y + 0.045), 0.014), "y", 0.5 * (i % 3 - 1)))
    obj.add(BLACK, block((foot - 0.03, foot + 0.006), (0, 0.08), 0.025))
    obj.add(dull(obj.tint(STONES)), lathe([(1.6 * foot, -0.05), (1.4 * foot, -0.01), (1.1 * foot, 0.012)],
        sides=14))  # fmt: skip
    if obj.chance(0.5):
        obj.add(WHITE, box((-0.1, -0.01, 0.9 * foot), (0.1, 0.08, foot + 0.13)))
        rows = ((0.08, 0.8 * foot, foot + 0.15), (0.14, 0.9 * foot + 0.06, 0.9 * foot + 0.07))
        obj.add(band, loft([points([-0.12, 0.12, 0.12, -0.12], y, [a, a, b, b]) for y, a, b in rows]))


def castle_tower(obj: ObjectBuilder) -> None:
    """A round or square keep with battlements, arrow slits, a gate, sometimes a cone for a roof."""
    r, h, stone = obj.uniform(0.2, 0.27), obj.uniform(0.66, 0.8), dull(obj.tint(STONES))
    square = obj.chance(0.4)
    darker = dull(obj.tint([stone.diffuse], 0.2))
    rows = [(1.25, 0.0), (1.08, 0.08), (1.0, 0.14), (1.0, h - 0.1), (1.2, h - 0.05), (1.2, h)]
    profile = [(a * r, y) for a, y in rows]
    if square:
        obj.add(stone, squares(profile))
        obj.add(darker, squares([(1.02 * r, 0.3 * h), (1.02 * r, 0.315 * h)]))
        for turn, z in product(_QUARTERS, r * np.array([-1.08, -0.54, 0, 0.54])):
            merlon = box((1.08 * r, h - 0.005, z - 0.12 * r), (1.2 * r, h + 0.06, z + 0.12 * r), 0.01)
            obj.add(stone, rotate(merlon, "y", turn))
    else:
        obj.add(stone, lathe(profile, sides=24))
        obj.add(darker, torus((0, 0.3 * h, 0), r, 0.012, "y", 24))
        n = obj.integer(9, 13)
        merlon = block((1.06 * r, 1.2 * r), (h - 0.005, h + 0.06), 0.36 * 3.77 * r / n)
        obj.add(stone, *rotate_each(merlon, 2 * np.pi * np.arange(n) / n))
    for y in (0.4 * h, 0.62 * h):
        slit = block((0.9 * r, r + 0.004), (y, y + 0.07), 0.012)
        obj.add(BLACK, *rotate_each(slit, _QUARTERS + (0 if square else 0.4 * y)))
    obj.add(BLACK, block((0.9 * r, 1.22 * r), (0.0, 0.11), 0.055),
        lathe([(0.055, 0.9 * r), (0.055, 1.14 * r)], (0, 0.11, 0), "x", 20))  # fmt: skip
    roof = obj.uniform(0.18, 0.3)
    if obj.chance(0.55):
        slate = dull(obj.tint(((0.28, 0.06, 0.03), (0.05, 0.06, 0.08), (0.04, 0.1, 0.25))))
        obj.add(stone, lathe([(0.85 * r, h - 0.02), (0.85 * r, h + 0.08)], sides=20))
        obj.add(slate, lathe([(1.02 * r, h + 0.07), (0.5 * r, h + 0.07 + 0.5 * roof), (0.0, h + 0.07 + roof)],
            sides=20))  # fmt: skip
        h += roof
    obj.add(IRON, tube([(0, h, 0), (0, h + 0.19, 0)], 0.006, 6))
    obj.add(_RED, block((-0.09, 0.0), (h + 0.12, h + 0.18), 0.002))


def high_rise(obj: ObjectBuilder) -> None:
    """Stepped storeys of glass, a crown, an antenna."""
    half, steps, shrink = obj.uniform(0.11, 0.16), obj.integer(2, 4), obj.uniform(0.12, 0.26)
    grow = obj.uniform(0.6, 1.1)
    frame = dull(obj.tint((*STONES[:3], (0.1, 0.11, 0.13))))
    glass = Surface(obj.tint(((0.04, 0.1, 0.16), (0.02, 0.03, 0.04), (0.05, 0.14, 0.13))), 0.7, 80.0)
    y, top = 0.0, obj.uniform(0.74, 0.82)
    for i in range(steps):
        end = top * ((i + 1) / steps) ** grow
        size = half * (1 - shrink * i)
        obj.add(glass, block((-size, size), (y, end), size))
        mullions = points(size, (y + end) / 2, np.linspace(-size, size, max(4, 8 - i))[:-1])
        obj.add(frame, *rotate_each(boxes(mullions, (0.014, end - y, 0.014)), _QUARTERS))
        floors = points(0, [*np.arange(y, end, 0.035), end], 0)
        obj.add(frame, boxes(floors, (2 * size + 0.008, 0.01, 2 * size + 0.008)))
        y = end
    size = half * (1 - 0.24 * steps)
    if obj.chance(0.5):
        crown = [(size, y), (0.75 * size, y + 0.05), (0.2 * size, y + 0.14), (0.05 * size, y + 0.16)]
        obj.add(STEEL, squares(crown))
    else:
        obj.add(frame, block((-size, size), (y, y + 0.04), size))
    obj.add(STEEL, tube([(0, y, 0), (0, y + 0.14, 0), (0, 1.05, 0)], [0.01, 0.008, 0.003], 8))
    obj.add(BLACK, block((half, half + 0.01), (0, 0.035), 0.04))
    obj.add(frame, block((-1.25 * half, 1.25 * half), (-0.012, 0.0), 1.25 * half))


TOWERS = (lattice_tower, clock_tower, water_tower, radio_mast, castle_tower, lighthouse, high_rise)


_LINING = dull((0.02, 0.02, 0.022))


def _rim(front: float, side: float, rear: float, sharp: float = 1.0) -> Array:
    """Interpolate the polar angles (32,) of a shell's rim, rad, between front, sides and rear."""
    ahead = np.maximum(np.cos(RIM_AZIMUTHS), 0) ** sharp
    behind = np.maximum(-np.cos(RIM_AZIMUTHS), 0)
    return side + (front - side) * ahead + (rear - side) * behind


def full_face(obj: ObjectBuilder) -> None:
    """A motorcycle helmet: a closed shell, a visor, a chin bar."""
    radii = np.array([obj.uniform(0.145, 0.158), obj.uniform(0.138, 0.15), obj.uniform(0.118, 0.128)])
    coat, second = obj.lacquer(), obj.lacquer()
    obj.add(coat, bowl(radii, obj.uniform(2.25, 2.4), 0.022))
    obj.add(_LINING, bowl(radii * 0.9, 2.2, 0.02))
    half, low = obj.uniform(1.05, 1.25), obj.uniform(1.8, 1.92)
    frame = np.linspace(-half - 0.07, half + 0.07, 17)
    obj.add(BLACK, dome(radii, np.linspace(1.12, low + 0.06, 7), frame, 0.02, 0.004))
    visor = GLASS if obj.chance(0.8) else metal((0.35, 0.22, 0.05))
    obj.add(visor, dome(radii, np.linspace(1.17, low, 7), np.linspace(-half, half, 17), 0.02, 0.009))
    chin = np.linspace(-half - 0.25, half + 0.25, 17)
    obj.add(coat, dome(radii, np.linspace(low + 0.04, 2.42, 6), chin, 0.035, (0.036, 0.02, 0.018)))
    obj.add(BLACK, dome(radii, np.linspace(2.02, 2.14, 3), np.linspace(-0.28, 0.28, 7), 0.03,
        (0.042, 0.023, 0.02)))  # fmt: skip
    obj.pair(CHROME, lathe([(0.017, -0.012), (0.017, 0.012), (0.01, 0.016)], (0.02, -0.02, radii[2]), "z", 16))
    stripe = obj.uniform(0.1, 0.22)
    if obj.chance(0.5):
        wide = np.linspace(-stripe, stripe, 5)
        obj.add(second, dome(radii, np.linspace(0.05, 1.08, 8), wide, 0.01, 0.003))
        obj.add(second, dome(radii, np.linspace(0.05, 2.0, 12), np.pi + wide, 0.01, 0.003))
    else:
        obj.pair(second, dome(radii, np.linspace(1.15, 1.55, 5), np.linspace(1.5, 3.0, 9), 0.01, 0.003))
    if obj.chance(0.35):
        peak = np.linspace(-0.75, 0.75, 9)
        obj.add(second, dome(radii, np.linspace(1.02, 1.14, 3), peak, 0.008, (0.089, 0.004, 0.004)))
        obj.pair(BLACK, dome(radii, np.linspace(0.95, 1.25, 3), np.linspace(0.9, 1.15, 3), 0.012, 0.01))


def football(obj: ObjectBuilder) -> None:
    """A shell with an open face, bars across it, a stripe from front to rear."""
    radii = np.array([obj.uniform(0.15, 0.162), 0.135, obj.uniform(0.118, 0.126)])
    coat, second = obj.lacquer(), obj.lacquer() if obj.chance(0.5) else WHITE
    obj.add(coat, bowl(radii, _rim(1.12, 2.25, 2.15, 0.45), 0.018))
    obj.add(_LINING, bowl(radii * 0.93, _rim(1.05, 2.1, 2.05, 0.45), 0.015))
    width = obj.uniform(0.14, 0.24)
    stripe = np.linspace(-width, width, 5)
    for middle, end in ((0.0, 1.02), (np.pi, 2.0)):
        obj.add(second, dome(radii, np.linspace(0.06, end, 10), middle + stripe, 0.01, 0.003))
    obj.pair(BLACK, lathe([(0.02, -0.02), (0.02, 0.012)], (-0.005, -0.045, 0.88 * radii[2]), "z", 16))
    obj.pair(second, lathe([(0.024, -0.02), (0.024, 0.004)], (-0.005, -0.045, 0.97 * radii[2]), "z", 16))
    bars, wire = paint(obj.tint(((0.1, 0.1, 0.11), (0.55, 0.55, 0.55), *PAINTS[:2]))), 0.0055
    side, reach = 0.86 * radii[2], radii[0] + obj.uniform(0.035, 0.055)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 11)
    rows = [(-0.035, 0.06, reach - 0.005), (-0.068, 0.03, reach), (-0.115, 0.03, reach - 0.012)]
    for y, back, front in rows if obj.chance(0.6) else rows[::2]:
        obj.add(bars, tube(points(back + (front - back) * np.cos(angle) ** 0.7, y, side * np.sin(angle)), wire, 6))
    for z in (-0.03, 0.03) if obj.chance(0.7) else (0.0,):
        line = [(radii[0] * 0.93, 0.035, z), (reach - 0.008, 0.0, z), (reach - 0.006, -0.07, z),
            (reach - 0.018, -0.117, z)]  # fmt: skip
        obj.add(bars, tube(line, wire, 6))
    obj.pair(bars, tube([(0.03, -0.115, side), (0.02, -0.02, side * 1.04)], wire, 6))
    obj.add(plastic((0.6, 0.6, 0.6)), ball((0.115, -0.125, 0), (0.02, 0.022, 0.035), 10))
    obj.pair(WHITE, tube([(0.11, -0.125, 0.03), (0.03, -0.1, 0.95 * side)], 0.005, 6))


def bicycle_helmet(obj: ObjectBuilder) -> None:
    """Ribs with air between them over a dark lining, a peak, straps."""
    long, wide, high = obj.uniform(0.15, 0.165), obj.uniform(0.105, 0.115), obj.uniform(0.105, 0.125)
    coat, second = obj.lacquer(), obj.lacquer() if obj.chance(0.5) else BLACK
    radii = np.array([long, high, wide])
    rim = _rim(1.42, 1.62, 1.7)
    obj.add(_LINING, bowl(0.93 * radii, rim - 0.05, 0.02, 8))
    ribs = obj.integer(3, 4)
    for i, z in enumerate(np.linspace(0.0, 0.8, ribs)):
        angle, w = np.linspace(0.12, np.pi - 0.08, 15)[:, None], np.linspace(z - 0.3 / ribs, z + 0.3 / ribs, 5)
        lift = np.sqrt(np.maximum(1 - w * w, 0.02))
        grid = points(np.cos(angle) * lift, np.sin(angle) * lift, w) * (radii + 0.008)
        rib = slab(grid, grid * 0.86)
        (obj.add if i == 0 else obj.pair)(second if i == 1 and obj.chance(0.5) else coat, rib)
    a = np.linspace(-1.5, 1.5, 11)
    for lean in np.linspace(0.5, 2.4, 4):
        ring = points(long * np.cos(lean) * 0.98, high * np.sin(lean) * 0.98 * np.cos(a),
            wide * 0.98 * np.sin(a) * np.sin(lean) ** 0.5)  # fmt: skip
        obj.add(coat, tube(ring, 0.009, 6))
    edge = radii * direction(rim, RIM_AZIMUTHS)
    obj.add(coat, tube([*edge, edge[0]], 0.014, 6))
    if obj.chance(0.6):
        peak = (0.055, -0.02, 0.0)
        obj.add(second, dome(radii, np.linspace(1.36, 1.46, 3), np.linspace(-0.7, 0.7, 9), 0.006, peak))
    for x in (0.05, -0.05):
        obj.pair(BLACK, tube([(x, 0.0, 0.97 * wide), (0.01, -0.1, 0.8 * wide)], 0.005, 6))
    obj.pair(BLACK, tube([(0.01, -0.1, 0.8 * wide), (0.02, -0.16, 0.0)], 0.005, 6))
    obj.add(BLACK, block((0.005, 0.035), (-0.17, -0.15), 0.015, 0.004))


def hard_hat(obj: ObjectBuilder) -> None:
    """A dome with ridges, a brim that is longer in front."""
    radii = np.array([obj.uniform(0.135, 0.15), obj.uniform(0.115, 0.135), obj.uniform(0.112, 0.122)])
    colour = plastic(obj.tint(((0.7, 0.45, 0.01), (0.68, 0.68, 0.67), (0.6, 0.02, 0.02), (0.02, 0.1, 0.42),
        (0.7, 0.22, 0.01)), 0.15))  # fmt: skip
    obj.add(colour, bowl(radii, np.pi / 2 + 0.02, 0.012))
    peak, cos, sin = obj.uniform(0.05, 0.085), np.cos(RIM_AZIMUTHS), np.sin(RIM_AZIMUTHS)
    inner = points(cos * (radii[0] - 0.008), 0, sin * (radii[2] - 0.008))
    x = cos * (radii[0] + 0.022 + peak * np.maximum(cos, 0) ** 2)
    outer = points(x, -0.012 - 0.1 * np.maximum(x - radii[0], 0), sin * (radii[2] + 0.022))
    obj.add(colour, loft([inner, outer, outer - 0.009 * UP, inner - 0.009 * UP], around=True))
    ridge = obj.uniform(0.07, 0.12)
    obj.add(colour, *(dome(radii, np.linspace(0.0, 1.42, 10), m + np.linspace(-ridge, ridge, 3), 0.01, 0.009)
        for m in (0.0, np.pi)))  # fmt: skip
    if obj.chance(0.6):
        wide = np.linspace(-0.07, 0.07, 3)
        for turn in (0.5, 2.64):
            obj.pair(colour, dome(radii, np.linspace(0.35, 1.2, 7), turn + wide, 0.01, 0.006))
    strap = 0.9 * radii[2]
    obj.add(_LINING, torus((0.0, -0.02, 0.0), strap, 0.01, "y", 28))
    if obj.chance(0.5):
        obj.pair(BLACK, tube([(0.02, -0.01, strap), (0.03, -0.1, 0.75 * strap), (0.045, -0.15, 0.0)], 0.006, 6))
    if obj.chance(0.4):
        lamp = rotate(block((-0.012, 0.02), (-0.02, 0.02), 0.03, 0.008), "z", -0.9)
        obj.add(BLACK, translate_solid(lamp, (0.93 * radii[0], 0.45 * radii[1], 0)))
    else:
        obj.add(WHITE if colour.diffuse[2] < 0.5 else BLACK,
            dome(radii, np.linspace(1.05, 1.3, 4), np.linspace(-0.22, 0.22, 5), 0.01, 0.011))  # fmt: skip


def knight(obj: ObjectBuilder) -> None:
    """Steel over the whole head: a slit for the eyes, holes to breathe, a crest or a plume."""
    radii = np.array([0.135, obj.uniform(0.14, 0.16), 0.115])
    steel = metal(obj.tint(((0.36, 0.37, 0.39), (0.2, 0.2, 0.21), (0.45, 0.33, 0.12)), 0.15))
    obj.add(steel, bowl(radii, 2.35, 0.012))
    low, long = obj.uniform(2.2, 2.5), obj.uniform(0.02, 0.06)
    mask, holes = (long + 0.008, 0.012, 0.008), (long + 0.011, 0.015, 0.011)
    obj.add(steel, dome(radii, np.linspace(1.25, low, 8), np.linspace(-1.3, 1.3, 17), 0.02, mask))
    obj.pair(BLACK, dome(radii, np.linspace(1.42, 1.52, 3), np.linspace(0.1, 1.0, 7), 0.02, holes))
    for theta in (1.78, 1.92, 2.06):
        for phi in (0.2, 0.38, 0.56):
            obj.pair(BLACK, dome(radii, (theta, theta + 0.05), (phi, phi + 0.06), 0.02, holes))
    brass = metal((0.5, 0.33, 0.08))
    obj.pair(brass, lathe([(0.022, -0.01), (0.022, 0.016), (0.01, 0.022)], (0.0, 0.02, radii[2]), "z", 16))
    for middle, end in ((0.0, 1.2), (np.pi, 2.0)):
        obj.add(steel, dome(radii, np.linspace(0, end, 10), middle + np.linspace(-0.06, 0.06, 3), 0.01, 0.012))
    obj.add(steel, torus((0, 1.05 * radii[1] * np.cos(2.35), 0), 0.088, 0.016, "y", 28))
    if obj.chance(0.6):
        plume = [(0.0, radii[1], 0), (-0.03, radii[1] + 0.07, 0), (-0.1, radii[1] + 0.08, 0), (-0.17, 0.1, 0),
            (-0.19, 0.0, 0)]  # fmt: skip
        obj.add(dull(obj.tint(PAINTS)), tube(plume, [0.008, 0.028, 0.036, 0.034, 0.01], 8))


HELMETS = (full_face, football, bicycle_helmet, hard_hat, knight)
