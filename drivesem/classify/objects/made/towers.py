"""Towers: lattices, masts, water, clock and television towers, castles', lighthouses, high-rises."""

from __future__ import annotations

from itertools import cycle, pairwise, product

import numpy as np

from drivesem.classify.objects.shapes import (
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
    squares,
    torus,
    tube,
    turned,
    turned_each,
)
from drivesem.classify.objects.surfaces import (
    BLACK,
    GLASS,
    IRON,
    LAMP,
    STEEL,
    STONES,
    WHITE,
    Kit,
    Surface,
    dull,
    metal,
    paint,
)

_RED = paint((0.52, 0.015, 0.015))
_QUARTERS = np.arange(4) * np.pi / 2
_CORNERS = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
"""x and z of a square's corners."""


def _lattice(kit: Kit, surfaces: list[Surface], levels: np.ndarray, halves: np.ndarray, thick: float) -> None:
    """A square trellis: half its width at each level, and its surfaces in turn, storey by storey."""
    x, z = _CORNERS.T
    rings, slim = [points(x * half, y, z * half) for y, half in zip(levels, halves, strict=True)], 0.55 * thick
    for (low, high), surface in zip(pairwise(rings), cycle(surfaces)):
        following_low, following_high = np.roll(low, -1, axis=0), np.roll(high, -1, axis=0)
        kit.add(surface, beams(low, high, thick), beams(low, following_high, slim),
            beams(following_low, high, slim), beams(high, following_high, slim))  # fmt: skip


def lattice_tower(kit: Kit) -> None:
    """Four curved legs of iron that meet far up, platforms between, arches below."""
    height, foot = kit.between(0.9, 1.0), kit.between(0.17, 0.22)
    iron = metal(kit.tint(((0.1, 0.06, 0.035), (0.05, 0.045, 0.04), (0.25, 0.05, 0.02)), 0.2))
    first, second = kit.between(0.17, 0.23) * height, kit.between(0.36, 0.44) * height
    upper = np.linspace(second, 0.92 * height, 9)
    halves = np.interp(upper, [second, 0.55 * height, 0.75 * height, 0.92 * height],
        [0.3 * foot, 0.2 * foot, 0.11 * foot, 0.05 * foot])  # fmt: skip
    _lattice(kit, [iron], upper, halves, 0.008)
    storeys = ((1.0, 0.3, 0.0), (0.62, 0.24, first)), ((0.58, 0.22, first), (0.3, 0.14, second))
    for x, z in _CORNERS:
        for (a, w, y0), (b, v, y1) in storeys:
            dx, dz = np.array([[0, 0], [0, 1], [1, 0], [1, 1]]).T
            low, high = (points(x * foot * (c - u * dx), y, z * foot * (c - u * dz))
                for c, u, y in ((a, w, y0), (b, v, y1)))  # fmt: skip
            kit.add(iron, beams(low, high, 0.01))
            inner = np.array([0, 1])
            for p, q in pairwise(np.linspace(0, 1, 6)):
                low, high = (points(x * foot * (a + (b - a) * t - (w + (v - w) * t) * s), y0 + (y1 - y0) * t,
                    z * foot * (a + (b - a) * t)) for t, s in ((p, inner), (q, 1 - inner)))  # fmt: skip
                for swap, way in (([0, 1, 2], 1), ([2, 1, 0], [x * z, 1, x * z])):
                    kit.add(iron, beams(low[:, swap] * way, high[:, swap] * way, 0.006))
    for y, half in ((first, 0.68 * foot), (second, 0.38 * foot), (0.92 * height, 0.1 * foot)):
        kit.add(iron, squares([(half, y - 0.008), (1.08 * half, y + 0.012), (half, y + 0.016)]))
    angle = np.linspace(0, np.pi, 13)
    rise = 0.02 + 0.15 * height * np.sin(angle)
    arch = points(0.62 * foot * np.cos(angle), rise, 0.9 * foot * (1 - 0.3 * rise / first))
    kit.add(iron, *turned_each(tube(arch, 0.007, 6), _QUARTERS))
    kit.add(iron, lathe([(0.05 * foot, 0.92 * height), (0.06 * foot, 0.945 * height), (0.012, 0.965 * height),
        (0.004, height + 0.05)], sides=10))  # fmt: skip
    kit.add(dull(kit.tint(STONES)), *(box((x * 0.86 * foot - 0.05, -0.01, z * 0.86 * foot - 0.05),
        (x * 0.86 * foot + 0.05, 0.012, z * 0.86 * foot + 0.05)) for x in (1, -1) for z in (1, -1)))  # fmt: skip


def radio_mast(kit: Kit) -> None:
    """A slim trellis, red and white by turns, with dishes and rods."""
    foot, top, storeys = kit.between(0.065, 0.11), kit.between(0.012, 0.022), kit.count(9, 13)
    levels = np.linspace(0, 0.86, storeys + 1)
    bands = [_RED, WHITE] if kit.chance(0.65) else [STEEL]
    _lattice(kit, bands, levels, np.linspace(foot, top, storeys + 1), 0.011)
    kit.add(bands[0], tube([(0, 0.86, 0), (0, 1.0, 0)], [0.008, 0.003], 8))
    kit.add(_RED, ball((0, 1.0, 0), 0.008, 8))
    for _ in range(kit.count(2, 5)):
        y, turn, size = kit.between(0.55, 0.82), kit.between(-2, 2), kit.between(0.022, 0.04)
        reach = np.interp(y, [0, 0.86], [foot, top]) + 0.012
        dish = lathe([(0.2 * size, -0.02), (size, 0.0), (size, 0.012), (0.3 * size, 0.002)], (reach + 0.01, y, 0),
            "x", 16)  # fmt: skip
        kit.add(WHITE, turned(dish, "y", turn))
        kit.add(STEEL, turned(beams((0, y, 0), (reach, y, 0), 0.008), "y", turn))
    for turn in 2 * np.pi * np.arange(3) / 3:
        kit.add(WHITE, turned(block((0.03, 0.04), (0.8, 0.87), 0.008), "y", turn))
        kit.add(STEEL, turned(beams((0, 0.83, 0), (0.035, 0.83, 0), 0.006), "y", turn))
    half = 1.25 * foot
    kit.add(dull(kit.tint(STONES)), block((-half, half), (-0.02, 0.008), half))
    kit.add(WHITE, box((0.3 * foot, 0.0, 0.2 * foot), (1.3 * foot, 0.05, 1.2 * foot), 0.003))


def water_tower(kit: Kit) -> None:
    """A tank high up, on braced legs or on one stem."""
    coat = paint(kit.tint(((0.6, 0.62, 0.62), (0.3, 0.45, 0.55), (0.5, 0.45, 0.35), (0.45, 0.1, 0.05))))
    r = kit.between(0.2, 0.28)
    top, tall = kit.between(0.5, 0.62), kit.between(0.16, 0.26)
    if kit.chance(0.6):
        flat = kit.chance(0.5)
        cone = [(1.06, tall), (0.0, tall + 0.55 * r)]
        dome = [(0.95, tall + 0.12 * r), (0.6, tall + 0.3 * r), (0.0, tall + 0.38 * r)]
        base = [(0.9, -0.0)] if flat else [(0.2, -0.45 * r), (0.6, -0.3 * r), (0.9, -0.1 * r)]
        rows = [*base, (1.0, 0.03), (1.0, tall), *(cone if flat else dome)]
        kit.add(coat, lathe([(a * r, y) for a, y in rows], (0, top, 0), sides=24))
        kit.add(STEEL, torus((0, top + 0.02, 0), 1.06 * r, 0.008, "y", 24),
            torus((0, top + 0.07, 0), 1.08 * r, 0.004, "y", 24))  # fmt: skip
        legs = kit.count(4, 6)
        angle = 2 * np.pi * (np.arange(legs) + 0.5) / legs
        rings = [circle(s * r, y, angle) for s, y in ((1.25, 0), (1.08, 0.5 * top), (0.92, top + 0.02))]
        for low, high in pairwise(rings):
            kit.add(STEEL, beams(low, high, 0.022), beams(high, np.roll(high, -1, 0), 0.012),
                beams(low, np.roll(high, -1, 0), 0.007), beams(np.roll(low, -1, 0), high, 0.007))  # fmt: skip
        kit.add(STEEL, tube([(0, 0, 0), (0, top, 0)], 0.025, 10))
    else:
        stem = kit.between(0.06, 0.09)
        bulb = [(1.6 * stem, 0.0), (stem, 0.08), (stem, 0.8 * top), (1.5 * stem, top), (0.75 * r, top + 0.06),
            (r, top + 0.15), (r, top + 0.2), (0.75 * r, top + 0.3), (0.35 * r, top + 0.36),
            (0, top + 0.38)]  # fmt: skip
        kit.add(coat, lathe(bulb, sides=28))
        kit.add(paint(kit.tint(((0.02, 0.06, 0.4), (0.5, 0.02, 0.02), (0.02, 0.2, 0.06)))),
            lathe([(1.005 * r, top + 0.15), (1.01 * r, top + 0.2)], sides=28))  # fmt: skip
        kit.add(STEEL, torus((0, top + 0.37, 0), 0.25 * r, 0.006, "y", 20))
        kit.add(BLACK, block((1.1 * stem, 1.35 * stem), (0.0, 0.07), 0.02))
    kit.add(STEEL, tube([(0, top + tall, 0), (0, top + tall + 0.6 * r + 0.05, 0)], 0.005, 6))


def clock_tower(kit: Kit) -> None:
    """A square shaft of stone with a clock on each side beneath a steep roof."""
    half, stone = kit.between(0.09, 0.125), dull(kit.tint((*STONES, (0.42, 0.2, 0.1))))
    trim = dull(kit.tint(STONES[:1]))
    roof = dull(kit.tint(((0.05, 0.06, 0.07), (0.06, 0.2, 0.15), (0.25, 0.06, 0.03))))
    shaft, head = kit.between(0.46, 0.56), kit.between(0.13, 0.17)
    kit.add(stone, squares([(1.12 * half, 0), (1.12 * half, 0.06), (half, 0.08), (half, shaft)]))
    kit.add(trim, squares([(half, shaft - 0.02), (1.18 * half, shaft), (1.18 * half, shaft + 0.015)]))
    kit.add(stone, squares([(1.08 * half, shaft), (1.08 * half, shaft + head)]))
    kit.add(trim, squares([(1.08 * half, shaft + head - 0.01), (1.25 * half, shaft + head + 0.012),
        (1.2 * half, shaft + head + 0.02)]))  # fmt: skip
    top = shaft + head + 0.02
    peak = kit.between(0.22, 0.34)
    if kit.chance(0.5):
        kit.add(roof, squares([(1.2 * half, top), (0.75 * half, top + 0.3 * peak), (0.12 * half, top + 0.9 * peak),
            (0.02 * half, top + peak)]))  # fmt: skip
    else:
        kit.add(stone, squares([(0.8 * half, top), (0.8 * half, top + 0.09)]))
        opening = block((0.78 * half, 0.82 * half), (top + 0.015, top + 0.075), 0.35 * half)
        kit.add(BLACK, *turned_each(opening, _QUARTERS))
        kit.add(roof, squares([(0.95 * half, top + 0.09), (0.55 * half, top + 0.09 + 0.3 * peak),
            (0.02 * half, top + 0.09 + 0.8 * peak)]))  # fmt: skip
    face, middle = min(0.78 * half, 0.42 * head), shaft + 0.5 * head
    turn, panes = kit.between(0, 6), kit.count(3, 5)
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
        kit.add(surface, turned(solid, "y", quarter))
    kit.add(BLACK, block((1.05 * half, 1.15 * half), (0, 0.06), 0.3 * half))


def lighthouse(kit: Kit) -> None:
    """A tapered tower in bands, a gallery, a lantern."""
    foot, head = kit.between(0.13, 0.17), kit.between(0.075, 0.1)
    band = paint(kit.tint(((0.5, 0.015, 0.015), (0.02, 0.02, 0.022), (0.02, 0.08, 0.35)), 0.15))
    rows, plain = kit.count(4, 7), kit.chance(0.25)
    edges = np.linspace(0, 0.72, rows + 1)
    outline = np.stack([np.interp(edges, [0, 0.72], [foot, head]), edges], 1)
    for i, profile in enumerate(pairwise(outline)):
        kit.add(WHITE if plain or i % 2 else band, lathe(profile, sides=24))
    kit.add(BLACK, lathe([(head, 0.7), (1.45 * head, 0.725), (1.45 * head, 0.74)], sides=24))
    kit.add(BLACK, torus((0, 0.78, 0), 1.4 * head, 0.004, "y", 24))
    angle = 2 * np.pi * np.arange(12) / 12
    post = circle(1.4 * head, 0.74, angle)
    kit.add(BLACK, beams(post, post + 0.04 * UP, 0.005))
    kit.add(LAMP, lathe([(0.72 * head, 0.74), (0.72 * head, 0.84)], sides=12))
    glass = circle(0.74 * head, 0.74, angle)
    kit.add(BLACK, beams(glass, glass + 0.1 * UP, 0.006))
    kit.add(band, lathe([(0.9 * head, 0.84), (0.55 * head, 0.89), (0.1 * head, 0.92), (0.05 * head, 0.96)],
        sides=20))  # fmt: skip
    for i, y in enumerate(np.linspace(0.16, 0.6, kit.count(2, 4))):
        r = np.interp(y, [0, 0.72], [foot, head])
        kit.add(GLASS, turned(block((r - 0.02, r + 0.004), (y, y + 0.045), 0.014), "y", 0.5 * (i % 3 - 1)))
    kit.add(BLACK, block((foot - 0.03, foot + 0.006), (0, 0.08), 0.025))
    kit.add(dull(kit.tint(STONES)), lathe([(1.6 * foot, -0.05), (1.4 * foot, -0.01), (1.1 * foot, 0.012)],
        sides=14))  # fmt: skip
    if kit.chance(0.5):
        kit.add(WHITE, box((-0.1, -0.01, 0.9 * foot), (0.1, 0.08, foot + 0.13)))
        rows = ((0.08, 0.8 * foot, foot + 0.15), (0.14, 0.9 * foot + 0.06, 0.9 * foot + 0.07))
        kit.add(band, loft([points([-0.12, 0.12, 0.12, -0.12], y, [a, a, b, b]) for y, a, b in rows]))


def castle_tower(kit: Kit) -> None:
    """A round or square keep with battlements, arrow slits, a gate, sometimes a cone for a roof."""
    r, h, stone = kit.between(0.2, 0.27), kit.between(0.66, 0.8), dull(kit.tint(STONES))
    square = kit.chance(0.4)
    darker = dull(kit.tint([stone.diffuse], 0.2))
    rows = [(1.25, 0.0), (1.08, 0.08), (1.0, 0.14), (1.0, h - 0.1), (1.2, h - 0.05), (1.2, h)]
    profile = [(a * r, y) for a, y in rows]
    if square:
        kit.add(stone, squares(profile))
        kit.add(darker, squares([(1.02 * r, 0.3 * h), (1.02 * r, 0.315 * h)]))
        for turn, z in product(_QUARTERS, r * np.array([-1.08, -0.54, 0, 0.54])):
            merlon = box((1.08 * r, h - 0.005, z - 0.12 * r), (1.2 * r, h + 0.06, z + 0.12 * r), 0.01)
            kit.add(stone, turned(merlon, "y", turn))
    else:
        kit.add(stone, lathe(profile, sides=24))
        kit.add(darker, torus((0, 0.3 * h, 0), r, 0.012, "y", 24))
        n = kit.count(9, 13)
        merlon = block((1.06 * r, 1.2 * r), (h - 0.005, h + 0.06), 0.36 * 3.77 * r / n)
        kit.add(stone, *turned_each(merlon, 2 * np.pi * np.arange(n) / n))
    for y in (0.4 * h, 0.62 * h):
        slit = block((0.9 * r, r + 0.004), (y, y + 0.07), 0.012)
        kit.add(BLACK, *turned_each(slit, _QUARTERS + (0 if square else 0.4 * y)))
    kit.add(BLACK, block((0.9 * r, 1.22 * r), (0.0, 0.11), 0.055),
        lathe([(0.055, 0.9 * r), (0.055, 1.14 * r)], (0, 0.11, 0), "x", 20))  # fmt: skip
    roof = kit.between(0.18, 0.3)
    if kit.chance(0.55):
        slate = dull(kit.tint(((0.28, 0.06, 0.03), (0.05, 0.06, 0.08), (0.04, 0.1, 0.25))))
        kit.add(stone, lathe([(0.85 * r, h - 0.02), (0.85 * r, h + 0.08)], sides=20))
        kit.add(slate, lathe([(1.02 * r, h + 0.07), (0.5 * r, h + 0.07 + 0.5 * roof), (0.0, h + 0.07 + roof)],
            sides=20))  # fmt: skip
        h += roof
    kit.add(IRON, tube([(0, h, 0), (0, h + 0.19, 0)], 0.006, 6))
    kit.add(_RED, block((-0.09, 0.0), (h + 0.12, h + 0.18), 0.002))


def high_rise(kit: Kit) -> None:
    """Stepped storeys of glass, a crown, an antenna."""
    half, steps, shrink = kit.between(0.11, 0.16), kit.count(2, 4), kit.between(0.12, 0.26)
    grow = kit.between(0.6, 1.1)
    frame = dull(kit.tint((*STONES[:3], (0.1, 0.11, 0.13))))
    glass = Surface(kit.tint(((0.04, 0.1, 0.16), (0.02, 0.03, 0.04), (0.05, 0.14, 0.13))), 0.7, 80.0)
    y, top = 0.0, kit.between(0.74, 0.82)
    for i in range(steps):
        end = top * ((i + 1) / steps) ** grow
        size = half * (1 - shrink * i)
        kit.add(glass, block((-size, size), (y, end), size))
        mullions = points(size, (y + end) / 2, np.linspace(-size, size, max(4, 8 - i))[:-1])
        kit.add(frame, *turned_each(boxes(mullions, (0.014, end - y, 0.014)), _QUARTERS))
        floors = points(0, [*np.arange(y, end, 0.035), end], 0)
        kit.add(frame, boxes(floors, (2 * size + 0.008, 0.01, 2 * size + 0.008)))
        y = end
    size = half * (1 - 0.24 * steps)
    if kit.chance(0.5):
        crown = [(size, y), (0.75 * size, y + 0.05), (0.2 * size, y + 0.14), (0.05 * size, y + 0.16)]
        kit.add(STEEL, squares(crown))
    else:
        kit.add(frame, block((-size, size), (y, y + 0.04), size))
    kit.add(STEEL, tube([(0, y, 0), (0, y + 0.14, 0), (0, 1.05, 0)], [0.01, 0.008, 0.003], 8))
    kit.add(BLACK, block((half, half + 0.01), (0, 0.035), 0.04))
    kit.add(frame, block((-1.25 * half, 1.25 * half), (-0.012, 0.0), 1.25 * half))


TOWERS = (lattice_tower, clock_tower, water_tower, radio_mast, castle_tower, lighthouse, high_rise)
