"""Generators of helmets for motorcycles, football, bicycles, building sites and knights; the face is towards +x."""

from __future__ import annotations

import numpy as np

from drivesem.classify.objects.generated.builder import (
    BLACK,
    CHROME,
    GLASS,
    PAINTS,
    WHITE,
    ObjectBuilder,
    dull,
    metal,
    paint,
    plastic,
)
from drivesem.classify.objects.generated.shapes import (
    RIM_AZIMUTHS,
    UP,
    Array,
    ball,
    block,
    bowl,
    direction,
    dome,
    lathe,
    loft,
    points,
    rotate,
    slab,
    torus,
    translate_solid,
    tube,
)

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
