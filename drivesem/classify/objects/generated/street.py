"""Generators of street furniture: benches, bins, mailboxes."""

from __future__ import annotations

import numpy as np

from drivesem.classify.objects.generated.builder import (
    BLACK,
    CHROME,
    IRON,
    PAINTS,
    RUBBER,
    STEEL,
    STONES,
    WHITE,
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
    ball,
    beams,
    block,
    box,
    boxes,
    lathe,
    loft,
    points,
    rectangle,
    rotate,
    rotate_each,
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
