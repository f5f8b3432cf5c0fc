"""Generators of airplanes: airliners, business jets, light planes, fighters."""

from __future__ import annotations

import numpy as np

from drivesem.classify.objects.generated.builder import (
    BLACK,
    GLASS,
    RUBBER,
    STEEL,
    WHITE,
    ObjectBuilder,
    Surface,
    metal,
    paint,
)
from drivesem.classify.objects.generated.shapes import (
    beams,
    body,
    box,
    boxes,
    lathe,
    patch,
    points,
    torus,
    tube,
    wing,
)


def _engine(obj: ObjectBuilder, cowl: Surface, x: float, y: float, z: float, radius: float) -> None:
    """Add a pair of jet engines in their cowls."""
    profile = [(0.80, -1.5), (0.98, -0.3), (1.05, 0.75), (0.92, 1.5), (0.80, 1.4), (0.78, 0.6)]
    obj.pair(cowl, lathe(radius * np.array(profile), (x, y, z), "x", 14))
    obj.pair(BLACK, lathe(radius * np.array([(0.79, 0.0), (0.79, 1.2)]), (x, y, z), "x", 14))
    obj.pair(STEEL, lathe(radius * np.array([(0.55, -1.3), (0.2, -2.2)]), (x, y, z), "x", 12))


def _gear(obj: ObjectBuilder, x: float, z: float, top: float, ground: float, radius: float) -> None:
    """Add a pair of legs with wheels."""
    hub = (x, ground + radius, z)
    obj.pair(STEEL, tube([(x, top, 0.6 * z), hub], 0.22 * radius, 6))
    obj.pair(RUBBER, torus(hub, 0.68 * radius, 0.32 * radius, "z", 16))
    obj.pair(STEEL, lathe([(0.5 * radius, -0.15 * radius), (0.5 * radius, 0.15 * radius)], hub, "z", 10))


def _jet(obj: ObjectBuilder, radius: float, length: float, rear: bool) -> None:
    """Add a jet with rows of windows; `rear` puts its engines at a T-tail, otherwise they hang below the wings."""
    r, half = radius, length / 2
    livery, grey = obj.lacquer(), metal((0.42, 0.43, 0.45))
    skin = WHITE if obj.chance(0.7) else paint(obj.tint(((0.35, 0.36, 0.38), (0.55, 0.60, 0.66))))
    tail, nose = half - obj.uniform(5, 6.5) * r, obj.uniform(3.0, 4.5) * r
    stations = [
        [-half, 0.55 * r, 0.12 * r, 0.10 * r], [-half + 2 * r, 0.32 * r, 0.58 * r, 0.5 * r], [-tail, 0, r, r],
        [half - nose, 0, r, r], [half - 0.55 * nose, -0.06 * r, 0.86 * r, 0.86 * r],
        [half - 0.22 * nose, -0.18 * r, 0.58 * r, 0.58 * r], [half, -0.28 * r, 0.06 * r, 0.06 * r],
    ]  # fmt: skip
    obj.add(skin, body(stations, 18))
    obj.add(GLASS, patch(stations, (half - 0.62 * nose, half - 0.25 * nose), (0.55, np.pi - 0.55), 0.015 * r))
    if rear or obj.chance(0.6):
        obj.pair(livery, patch(stations, (-0.42 * length, 0.42 * length), (-0.45, -0.05), 0.012 * r))
    x = np.arange(-0.16 if rear else -0.33, 0.22 if rear else 0.36, (1.5 if rear else 0.55) * r / length) * length
    pane = (0.5 * r, 0.45 * r, 0.1 * r) if rear else (0.24 * r, 0.34 * r, 0.06 * r)
    obj.pair(GLASS, boxes(points(x, 0.30 * r, 0.94 * r), pane))
    span, sweep = length * obj.uniform(0.42, 0.52), obj.uniform(0.40, 0.62)
    root, chord = obj.uniform(0.03, 0.10) * length, 0.235 * length
    tip = (root - span * sweep, 0.35 * r, span, 0.20 * chord)
    middle = (root - 0.32 * span * sweep, -0.35 * r, 0.34 * span, 0.58 * chord)
    obj.pair(grey, wing(0.11, (root + 0.03 * length, -0.5 * r, 0, 1.1 * chord), middle, tip))
    if obj.chance(0.6):
        up = (tip[0] - 0.3 * chord, tip[1] + r, span, 0.06 * chord)
        obj.pair(livery, wing(0.12, (tip[0] - 0.1 * chord, tip[1], span, 0.18 * chord), up, upright=True))
    cowl, lift = livery if obj.chance(0.4) else WHITE, obj.uniform(2.6, 3.3) * r
    fin = (-half + 1.0 * r, lift, 0, 1.7 * r)
    obj.add(livery, wing(0.10, (-half + 3.6 * r, 0.7 * r, 0, 3.2 * r), fin, upright=True))
    flat, height = (2.6 * r, 0.45 * r), 0.7 * r
    if rear:
        flat, height = (1.2 * r, lift), lift
        _engine(obj, cowl, -0.24 * length, 0.4 * r, 1.65 * r, 0.55 * r)
        obj.pair(skin, box((-0.28 * length, 0.3 * r, 0.6 * r), (-0.2 * length, 0.5 * r, 1.5 * r)))
    obj.pair(grey, wing(0.1, (flat[0] - half, flat[1], 0, 2 * r), (0.4 * r - half, height, 0.36 * span, 0.9 * r)))
    for share in () if rear else (0.32,) if obj.chance(0.7) else (0.30, 0.58):
        x0, z, size = root - share * span * sweep + 0.10 * chord, share * span, r * (0.9 - 0.8 * share)
        y = -0.42 * r - 1.05 * size + 0.3 * r * share
        _engine(obj, cowl, x0, y, z, size)
        obj.pair(grey, box((x0 - 0.6 * size, y, z - 0.1), (x0 + 0.6 * size, y + 1.3 * size, z + 0.1)))


def airliner(obj: ObjectBuilder) -> None:
    """Two or four engines beneath swept wings, rows of windows, a coloured tail."""
    radius = obj.uniform(1.75, 2.2)
    _jet(obj, radius, radius * obj.uniform(13.5, 18), rear=False)


def business_jet(obj: ObjectBuilder) -> None:
    """Engines at the tail, a T-tail, a low wing."""
    radius = obj.uniform(0.95, 1.15)
    _jet(obj, radius, radius * obj.uniform(12, 15), rear=True)


def light_plane(obj: ObjectBuilder) -> None:
    """One propeller, straight wings above or below, wheels that stay out."""
    half, r = obj.uniform(3.6, 4.3), obj.uniform(0.58, 0.70)
    livery, high = obj.lacquer(), obj.chance(0.6)
    skin = WHITE if obj.chance(0.6) else obj.lacquer()
    stations = [
        [-half, 0.25, 0.14, 0.06], [-0.1 * half, 0.12, 0.62 * r, 0.55 * r], [0.05 * half, 0.15, 0.95 * r, 0.9 * r],
        [0.48 * half, 0.1, 0.95 * r, 0.95 * r], [0.62 * half, -0.1, 0.72 * r, 0.85 * r],
        [0.92 * half, -0.12, 0.55 * r, 0.62 * r], [0.97 * half, -0.12, 0.35 * r, 0.35 * r],
    ]  # fmt: skip
    cabin = [
        [-0.05 * half, 0.3, 0.5 * r, 0.6 * r], [0.1 * half, 0.42, 0.75 * r, 0.80 * r],
        [0.42 * half, 0.42, 0.73 * r, 0.80 * r], [0.62 * half, 0.25, 0.4 * r, 0.7 * r],
    ]  # fmt: skip
    obj.add(skin, body(stations, 16, 2.8))
    obj.add(GLASS, body(cabin, 14, 3.2))
    obj.pair(livery, boxes([(0.0, -0.02, 0.86 * r)], (0.8 * half, 0.16, 0.14 * r)))
    x, reach, blades = 0.97 * half, obj.uniform(0.85, 1.0), obj.integer(2, 3)
    obj.add(livery, lathe(reach * np.array([(0.16, 0.0), (0.13, 0.15), (0.01, 0.3)]), (x, -0.12, 0), "x"))
    hub = np.array([x + 0.06 * reach, -0.12, 0])
    angle = obj.uniform(0, np.pi) + 2 * np.pi * np.arange(blades) / blades
    tips = hub + reach * points(0.0, np.sin(angle), np.cos(angle))
    obj.add(BLACK, beams(hub, tips, 0.14 * reach, 0.035 * reach))
    span, chord, lead = half * obj.uniform(1.20, 1.36), obj.uniform(1.35, 1.6), 0.5 * half
    height, rise = (0.42 + 0.8 * r, 0.02 * span) if high else (-0.45 * r, 0.09 * span)
    tip = (lead - 0.2 * chord, height + 1.6 * rise, span, 0.7 * chord)
    obj.pair(skin, wing(0.13, (lead, height, 0, chord), (lead, height + rise, 0.6 * span, chord), tip))
    end = (lead - 0.17 * chord, height + 1.45 * rise, 0.9 * span, 0.76 * chord)
    obj.pair(livery, wing(0.17, end, (*tip[:2], 1.01 * span, 0.68 * chord)))
    if high:
        foot = (lead - 0.3 * chord, -0.5 * r, 0.8 * r)
        obj.pair(skin, beams(foot, (foot[0], height, 0.45 * span), 0.10, 0.05))
    obj.add(livery, wing(0.10, (1.2 - half, 0.3, 0, 1.25), (0.35 - half, 1.55, 0, 0.6), upright=True))
    obj.pair(skin, wing(0.10, (1.0 - half, 0.3, 0, 0.95), (0.85 - half, 0.3, 0.4 * half, 0.7)))
    _gear(obj, 0.2 * half, 1.15, -0.6 * r, -r - 0.75, 0.24)
    if obj.chance(0.6):
        _gear(obj, 0.8 * half, 0.05, -0.5 * r, -r - 0.75, 0.2)
    else:
        _gear(obj, -0.93 * half, 0.03, 0.2, -0.28, 0.11)


def fighter(obj: ObjectBuilder) -> None:
    """A pointed nose, a bubble canopy, delta or swept wings, one fin or two, missiles."""
    length, r, twin, delta = obj.uniform(14, 17), obj.uniform(0.75, 0.9), obj.chance(0.5), obj.chance(0.5)
    half, wide = length / 2, 1.55 * r if twin else r
    skin = metal(obj.tint(((0.22, 0.24, 0.26), (0.30, 0.32, 0.33), (0.12, 0.15, 0.10), (0.30, 0.24, 0.15))))
    stations = [
        [0.4 - half, 0, 0.75 * r, 0.9 * wide], [-0.2 * half, 0, r, wide], [0.2 * half, 0, r, 0.95 * wide],
        [0.48 * half, 0, 0.85 * r, 0.8 * r], [0.78 * half, -0.1, 0.48 * r, 0.48 * r], [half, -0.2, 0.03, 0.03],
    ]  # fmt: skip
    canopy = [
        [0.25 * half, 0.75 * r, 0.1, 0.1], [0.38 * half, 0.85 * r, 0.55 * r, 0.5 * r],
        [0.52 * half, 0.7 * r, 0.55 * r, 0.5 * r], [0.72 * half, 0.3 * r, 0.15, 0.12],
    ]  # fmt: skip
    obj.add(skin, body(stations, 18, 2.6))
    obj.add(GLASS, body(canopy, 14))
    obj.pair(skin, box((-0.1 * half, -0.75 * r, 0.8 * wide), (0.34 * half, 0.5 * r, 1.25 * wide), 0.12))
    obj.pair(BLACK, box((0.33 * half, -0.62 * r, 0.88 * wide), (0.345 * half, 0.4 * r, 1.18 * wide)))
    span = length * obj.uniform(0.30, 0.38)
    lead, sweep, root, tip = (0.30, 1.35, 0.62, 0.06) if delta else (0.20, 0.75, 0.36, 0.11)
    end = (lead * half - sweep * (span - 0.5 * wide), 0, span, tip * length)
    obj.pair(skin, wing(0.045, (lead * half, 0, 0.5 * wide, root * length), end))
    missile = [(0.02, 1.5), (0.13, 1.1), (0.13, -1.4), (0.10, -1.5)]
    inner = (lead * half - sweep * 0.55 * span - 0.2 * root * length, -0.45, 0.6 * span)
    obj.pair(WHITE, lathe(missile, (end[0] - 0.3 * tip * length, 0, span), "x", 8), lathe(missile, inner, "x", 8))
    top, cant, z = r + obj.uniform(1.7, 2.3), obj.uniform(0.0, 0.7), 0.75 * wide
    foot, head = (-0.36 * half, 0.6 * r, 0, 0.24 * length), (-0.72 * half, top, 0, 0.09 * length)
    if twin:
        tilted = (*head[:2], z + cant, head[3])
        obj.pair(skin, wing(0.06, (*foot[:2], z, foot[3]), tilted, upright=True))
    else:
        obj.add(skin, wing(0.06, foot, head, upright=True))
    if not delta:
        tail = (-0.86 * half, 0, 0.62 * span, 0.07 * length)
        obj.pair(skin, wing(0.05, (-0.58 * half, 0, 0.6 * wide, 0.17 * length), tail))
    for side in (0.55 * wide, -0.55 * wide) if twin else (0.0,):
        obj.add(STEEL, lathe([(0.55 * r, -0.9), (0.68 * r, 0.0), (0.68 * r, 0.5)], (0.5 - half, 0, side), "x", 14))
        obj.add(BLACK, lathe([(0.45 * r, -0.42), (0.45 * r, 0.0)], (-half, 0, side), "x", 12))


AIRPLANES = (airliner, light_plane, fighter, business_jet)
