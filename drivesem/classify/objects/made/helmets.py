"""Helmets: for motorcycles, football, bicycles, building sites, soldiers and knights. They look along +x."""

from __future__ import annotations

import numpy as np

from drivesem.classify.objects.shapes import (
    AROUND,
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
    slab,
    torus,
    translate_solid,
    tube,
    turned,
)
from drivesem.classify.objects.surfaces import (
    BLACK,
    CHROME,
    GLASS,
    PAINTS,
    WHITE,
    Kit,
    dull,
    metal,
    paint,
    plastic,
)

_LINING = dull((0.02, 0.02, 0.022))


def _rim(front: float, side: float, rear: float, sharp: float = 1.0) -> Array:
    """Polar angles (32,) of a shell's rim, rad from the top, in front, at the sides and behind."""
    ahead = np.maximum(np.cos(AROUND), 0) ** sharp
    behind = np.maximum(-np.cos(AROUND), 0)
    return side + (front - side) * ahead + (rear - side) * behind


def full_face(kit: Kit) -> None:
    """A motorcyclist's: a closed shell, a visor, a bar before the chin."""
    radii = np.array([kit.between(0.145, 0.158), kit.between(0.138, 0.15), kit.between(0.118, 0.128)])
    coat, second = kit.lacquer(), kit.lacquer()
    kit.add(coat, bowl(radii, kit.between(2.25, 2.4), 0.022))
    kit.add(_LINING, bowl(radii * 0.9, 2.2, 0.02))
    half, low = kit.between(1.05, 1.25), kit.between(1.8, 1.92)
    frame = np.linspace(-half - 0.07, half + 0.07, 17)
    kit.add(BLACK, dome(radii, np.linspace(1.12, low + 0.06, 7), frame, 0.02, 0.004))
    visor = GLASS if kit.chance(0.8) else metal((0.35, 0.22, 0.05))
    kit.add(visor, dome(radii, np.linspace(1.17, low, 7), np.linspace(-half, half, 17), 0.02, 0.009))
    chin = np.linspace(-half - 0.25, half + 0.25, 17)
    kit.add(coat, dome(radii, np.linspace(low + 0.04, 2.42, 6), chin, 0.035, (0.036, 0.02, 0.018)))
    kit.add(BLACK, dome(radii, np.linspace(2.02, 2.14, 3), np.linspace(-0.28, 0.28, 7), 0.03,
        (0.042, 0.023, 0.02)))  # fmt: skip
    kit.both(CHROME, lathe([(0.017, -0.012), (0.017, 0.012), (0.01, 0.016)], (0.02, -0.02, radii[2]), "z", 16))
    stripe = kit.between(0.1, 0.22)
    if kit.chance(0.5):
        wide = np.linspace(-stripe, stripe, 5)
        kit.add(second, dome(radii, np.linspace(0.05, 1.08, 8), wide, 0.01, 0.003))
        kit.add(second, dome(radii, np.linspace(0.05, 2.0, 12), np.pi + wide, 0.01, 0.003))
    else:
        kit.both(second, dome(radii, np.linspace(1.15, 1.55, 5), np.linspace(1.5, 3.0, 9), 0.01, 0.003))
    if kit.chance(0.35):
        peak = np.linspace(-0.75, 0.75, 9)
        kit.add(second, dome(radii, np.linspace(1.02, 1.14, 3), peak, 0.008, (0.089, 0.004, 0.004)))
        kit.both(BLACK, dome(radii, np.linspace(0.95, 1.25, 3), np.linspace(0.9, 1.15, 3), 0.012, 0.01))


def football(kit: Kit) -> None:
    """A shell open before the face, bars across it, a stripe from front to rear."""
    radii = np.array([kit.between(0.15, 0.162), 0.135, kit.between(0.118, 0.126)])
    coat, second = kit.lacquer(), kit.lacquer() if kit.chance(0.5) else WHITE
    kit.add(coat, bowl(radii, _rim(1.12, 2.25, 2.15, 0.45), 0.018))
    kit.add(_LINING, bowl(radii * 0.93, _rim(1.05, 2.1, 2.05, 0.45), 0.015))
    width = kit.between(0.14, 0.24)
    stripe = np.linspace(-width, width, 5)
    for middle, end in ((0.0, 1.02), (np.pi, 2.0)):
        kit.add(second, dome(radii, np.linspace(0.06, end, 10), middle + stripe, 0.01, 0.003))
    kit.both(BLACK, lathe([(0.02, -0.02), (0.02, 0.012)], (-0.005, -0.045, 0.88 * radii[2]), "z", 16))
    kit.both(second, lathe([(0.024, -0.02), (0.024, 0.004)], (-0.005, -0.045, 0.97 * radii[2]), "z", 16))
    bars, wire = paint(kit.tint(((0.1, 0.1, 0.11), (0.55, 0.55, 0.55), *PAINTS[:2]))), 0.0055
    side, reach = 0.86 * radii[2], radii[0] + kit.between(0.035, 0.055)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 11)
    rows = [(-0.035, 0.06, reach - 0.005), (-0.068, 0.03, reach), (-0.115, 0.03, reach - 0.012)]
    for y, back, front in rows if kit.chance(0.6) else rows[::2]:
        kit.add(bars, tube(points(back + (front - back) * np.cos(angle) ** 0.7, y, side * np.sin(angle)), wire, 6))
    for z in (-0.03, 0.03) if kit.chance(0.7) else (0.0,):
        line = [(radii[0] * 0.93, 0.035, z), (reach - 0.008, 0.0, z), (reach - 0.006, -0.07, z),
            (reach - 0.018, -0.117, z)]  # fmt: skip
        kit.add(bars, tube(line, wire, 6))
    kit.both(bars, tube([(0.03, -0.115, side), (0.02, -0.02, side * 1.04)], wire, 6))
    kit.add(plastic((0.6, 0.6, 0.6)), ball((0.115, -0.125, 0), (0.02, 0.022, 0.035), 10))
    kit.both(WHITE, tube([(0.11, -0.125, 0.03), (0.03, -0.1, 0.95 * side)], 0.005, 6))


def bicycle_helmet(kit: Kit) -> None:
    """Ribs with air between them over a dark lining, a peak, straps."""
    long, wide, high = kit.between(0.15, 0.165), kit.between(0.105, 0.115), kit.between(0.105, 0.125)
    coat, second = kit.lacquer(), kit.lacquer() if kit.chance(0.5) else BLACK
    radii = np.array([long, high, wide])
    rim = _rim(1.42, 1.62, 1.7)
    kit.add(_LINING, bowl(0.93 * radii, rim - 0.05, 0.02, 8))
    ribs = kit.count(3, 4)
    for i, z in enumerate(np.linspace(0.0, 0.8, ribs)):
        angle, w = np.linspace(0.12, np.pi - 0.08, 15)[:, None], np.linspace(z - 0.3 / ribs, z + 0.3 / ribs, 5)
        lift = np.sqrt(np.maximum(1 - w * w, 0.02))
        grid = points(np.cos(angle) * lift, np.sin(angle) * lift, w) * (radii + 0.008)
        rib = slab(grid, grid * 0.86)
        (kit.add if i == 0 else kit.both)(second if i == 1 and kit.chance(0.5) else coat, rib)
    a = np.linspace(-1.5, 1.5, 11)
    for lean in np.linspace(0.5, 2.4, 4):
        ring = points(long * np.cos(lean) * 0.98, high * np.sin(lean) * 0.98 * np.cos(a),
            wide * 0.98 * np.sin(a) * np.sin(lean) ** 0.5)  # fmt: skip
        kit.add(coat, tube(ring, 0.009, 6))
    edge = radii * direction(rim, AROUND)
    kit.add(coat, tube([*edge, edge[0]], 0.014, 6))
    if kit.chance(0.6):
        peak = (0.055, -0.02, 0.0)
        kit.add(second, dome(radii, np.linspace(1.36, 1.46, 3), np.linspace(-0.7, 0.7, 9), 0.006, peak))
    for x in (0.05, -0.05):
        kit.both(BLACK, tube([(x, 0.0, 0.97 * wide), (0.01, -0.1, 0.8 * wide)], 0.005, 6))
    kit.both(BLACK, tube([(0.01, -0.1, 0.8 * wide), (0.02, -0.16, 0.0)], 0.005, 6))
    kit.add(BLACK, block((0.005, 0.035), (-0.17, -0.15), 0.015, 0.004))


def hard_hat(kit: Kit) -> None:
    """A dome with ridges, a brim that is longer in front."""
    radii = np.array([kit.between(0.135, 0.15), kit.between(0.115, 0.135), kit.between(0.112, 0.122)])
    colour = plastic(kit.tint(((0.7, 0.45, 0.01), (0.68, 0.68, 0.67), (0.6, 0.02, 0.02), (0.02, 0.1, 0.42),
        (0.7, 0.22, 0.01)), 0.15))  # fmt: skip
    kit.add(colour, bowl(radii, np.pi / 2 + 0.02, 0.012))
    peak, cos, sin = kit.between(0.05, 0.085), np.cos(AROUND), np.sin(AROUND)
    inner = points(cos * (radii[0] - 0.008), 0, sin * (radii[2] - 0.008))
    x = cos * (radii[0] + 0.022 + peak * np.maximum(cos, 0) ** 2)
    outer = points(x, -0.012 - 0.1 * np.maximum(x - radii[0], 0), sin * (radii[2] + 0.022))
    kit.add(colour, loft([inner, outer, outer - 0.009 * UP, inner - 0.009 * UP], around=True))
    ridge = kit.between(0.07, 0.12)
    kit.add(colour, *(dome(radii, np.linspace(0.0, 1.42, 10), m + np.linspace(-ridge, ridge, 3), 0.01, 0.009)
        for m in (0.0, np.pi)))  # fmt: skip
    if kit.chance(0.6):
        wide = np.linspace(-0.07, 0.07, 3)
        for turn in (0.5, 2.64):
            kit.both(colour, dome(radii, np.linspace(0.35, 1.2, 7), turn + wide, 0.01, 0.006))
    strap = 0.9 * radii[2]
    kit.add(_LINING, torus((0.0, -0.02, 0.0), strap, 0.01, "y", 28))
    if kit.chance(0.5):
        kit.both(BLACK, tube([(0.02, -0.01, strap), (0.03, -0.1, 0.75 * strap), (0.045, -0.15, 0.0)], 0.006, 6))
    if kit.chance(0.4):
        lamp = turned(block((-0.012, 0.02), (-0.02, 0.02), 0.03, 0.008), "z", -0.9)
        kit.add(BLACK, translate_solid(lamp, (0.93 * radii[0], 0.45 * radii[1], 0)))
    else:
        kit.add(WHITE if colour.diffuse[2] < 0.5 else BLACK,
            dome(radii, np.linspace(1.05, 1.3, 4), np.linspace(-0.22, 0.22, 5), 0.01, 0.011))  # fmt: skip


def knight(kit: Kit) -> None:
    """Steel over the whole head: a slit for the eyes, holes to breathe, a crest or a plume."""
    radii = np.array([0.135, kit.between(0.14, 0.16), 0.115])
    steel = metal(kit.tint(((0.36, 0.37, 0.39), (0.2, 0.2, 0.21), (0.45, 0.33, 0.12)), 0.15))
    kit.add(steel, bowl(radii, 2.35, 0.012))
    low, long = kit.between(2.2, 2.5), kit.between(0.02, 0.06)
    mask, holes = (long + 0.008, 0.012, 0.008), (long + 0.011, 0.015, 0.011)
    kit.add(steel, dome(radii, np.linspace(1.25, low, 8), np.linspace(-1.3, 1.3, 17), 0.02, mask))
    kit.both(BLACK, dome(radii, np.linspace(1.42, 1.52, 3), np.linspace(0.1, 1.0, 7), 0.02, holes))
    for theta in (1.78, 1.92, 2.06):
        for phi in (0.2, 0.38, 0.56):
            kit.both(BLACK, dome(radii, (theta, theta + 0.05), (phi, phi + 0.06), 0.02, holes))
    brass = metal((0.5, 0.33, 0.08))
    kit.both(brass, lathe([(0.022, -0.01), (0.022, 0.016), (0.01, 0.022)], (0.0, 0.02, radii[2]), "z", 16))
    for middle, end in ((0.0, 1.2), (np.pi, 2.0)):
        kit.add(steel, dome(radii, np.linspace(0, end, 10), middle + np.linspace(-0.06, 0.06, 3), 0.01, 0.012))
    kit.add(steel, torus((0, 1.05 * radii[1] * np.cos(2.35), 0), 0.088, 0.016, "y", 28))
    if kit.chance(0.6):
        plume = [(0.0, radii[1], 0), (-0.03, radii[1] + 0.07, 0), (-0.1, radii[1] + 0.08, 0), (-0.17, 0.1, 0),
            (-0.19, 0.0, 0)]  # fmt: skip
        kit.add(dull(kit.tint(PAINTS)), tube(plume, [0.008, 0.028, 0.036, 0.034, 0.01], 8))


HELMETS = (full_face, football, bicycle_helmet, hard_hat, knight)
