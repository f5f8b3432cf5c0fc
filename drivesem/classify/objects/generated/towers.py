"""Generators of towers: lattice, water, clock and castle towers, radio masts, lighthouses, high-rises."""

from __future__ import annotations

from itertools import cycle, pairwise, product

import numpy as np

from drivesem.classify.objects.generated.builder import (
    BLACK,
    GLASS,
    IRON,
    LAMP,
    STEEL,
    STONES,
    WHITE,
    ObjectBuilder,
    Surface,
    dull,
    metal,
    paint,
)
from drivesem.classify.objects.generated.shapes import (
    UP,
    ball,
    beams,
    block,
    box,
    boxes,
    circle,
    lathe,
    loft,
    points,
    rotate,
    rotate_each,
    squares,
    torus,
    tube,
)

_RED = paint((0.52, 0.015, 0.015))
_QUARTERS = np.arange(4) * np.pi / 2
_CORNERS = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
"""x and z of the corners of a square (4, 2)."""


def _lattice(
    obj: ObjectBuilder, surfaces: list[Surface], levels: np.ndarray, halves: np.ndarray, thick: float
) -> None:
    """Add a square lattice; `halves` are half its width at each level, and storeys alternate between surfaces."""
    x, z = _CORNERS.T
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
    for x, z in _CORNERS:
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
