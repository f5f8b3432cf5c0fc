"""Generators of cars, buses and trains; cars and city buses are vehicle templates in glossy paint."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drivesem.classify.objects.generated.builder import (
    AMBER,
    BLACK,
    CHROME,
    GLASS,
    LAMP,
    RUBBER,
    STEEL,
    TAIL_LAMP,
    WHITE,
    ObjectBuilder,
    Surface,
    metal,
    paint,
    plastic,
)
from drivesem.classify.objects.generated.shapes import (
    FORWARD,
    ball,
    beams,
    block,
    box,
    boxes,
    carriage,
    lathe,
    loft,
    points,
    rectangle,
    section,
    torus,
    translate_solid,
    tube,
)
from scene_ir.meshes.solids import COLOUR, VehicleMaterial, clean_solid
from scene_ir.meshes.templates import template, typical_size_lhw

_SURFACES: dict[VehicleMaterial, Surface] = {
    VehicleMaterial.GLASS: GLASS,
    VehicleMaterial.TYRE: RUBBER,
    VehicleMaterial.RIM: CHROME,
    VehicleMaterial.RIM_GAP: BLACK,
    VehicleMaterial.HEADLIGHT: LAMP,
    VehicleMaterial.TAIL_LIGHT: TAIL_LAMP,
    VehicleMaterial.INDICATOR: AMBER,
    VehicleMaterial.PLATE: plastic((0.7, 0.7, 0.66)),
    VehicleMaterial.TRIM: BLACK,
    VehicleMaterial.UNDERBODY: RUBBER,
    VehicleMaterial.CHROME: CHROME,
    VehicleMaterial.CARGO: WHITE,
}
_TABLE = np.array([COLOUR[material] for material in VehicleMaterial])


def _template(obj: ObjectBuilder, kind: str, coat: Surface) -> tuple[float, float, float]:
    """Add a random variant of a vehicle template; returns its length, height and width, m."""
    variant = obj.integer(0, 1 << 20)
    mesh, size = template(kind, variant), typical_size_lhw(kind, variant)
    assert mesh.colours is not None
    # The template's y axis points down. Flipping it is a reflection, so the winding is reversed too.
    vertices = mesh.vertices.double().numpy() * np.array([size[0], -size[1], size[2]])
    faces = mesh.faces.numpy()[:, ::-1]
    colours = mesh.colours.numpy()[faces[:, 0]]
    material = np.abs(colours[:, None] - _TABLE).sum(axis=2).argmin(axis=1)
    surfaces = [coat if one == VehicleMaterial.PAINT else _SURFACES[one] for one in VehicleMaterial]
    obj.add_materials(surfaces, clean_solid(vertices, faces, material))
    return size


def sedan(obj: ObjectBuilder) -> None:
    """A saloon, sometimes a taxi or a police car."""
    taxi, police = obj.chance(0.15), obj.chance(0.12)
    coat = paint((0.62, 0.4, 0.01)) if taxi else obj.lacquer()
    _, height, width = _template(obj, "sedan", coat)
    if taxi:
        obj.add(plastic((0.75, 0.72, 0.55)), block((-0.15, 0.1), (height - 0.03, height + 0.12), 0.3, 0.03))
    elif police:
        obj.add(BLACK, block((-0.2, 0.05), (height - 0.02, height + 0.04), 0.32 * width, 0.02))
        for rgb, a, b in (((0.02, 0.05, 0.6), 0.03, 0.31 * width), ((0.6, 0.02, 0.02), -0.31 * width, -0.03)):
            obj.add(paint(rgb), box((-0.17, height + 0.03, a), (0.02, height + 0.12, b), 0.02))


def hatchback(obj: ObjectBuilder) -> None:
    """A small car with a steep tail, sometimes with a spoiler."""
    coat = obj.lacquer()
    length, height, width = _template(obj, "hatchback", coat)
    if obj.chance(0.4):
        obj.add(coat, block((-0.44 * length, -0.36 * length), (height - 0.07, height - 0.02), 0.36 * width, 0.015))


def estate(obj: ObjectBuilder) -> None:
    """A car with a long roof, sometimes with a roof box."""
    _, height, _ = _template(obj, "estate", obj.lacquer())
    if obj.chance(0.35):
        obj.add(BLACK, block((-0.9, 0.5), (height + 0.04, height + 0.32), 0.35, 0.1))
        obj.pair(STEEL, *(block((x, x + 0.05), (height - 0.04, height + 0.05), 0.5) for x in (-0.6, 0.2)))


def off_road(obj: ObjectBuilder) -> None:
    """A tall car, sometimes with its spare wheel at the rear."""
    length, height, _ = _template(obj, "suv", obj.lacquer())
    if obj.chance(0.4):
        obj.add(RUBBER, torus((-length / 2 - 0.06, 0.52 * height, 0), 0.24, 0.09, "x", 24))
        obj.add(STEEL, lathe([(0.2, -0.08), (0.2, 0.08)], (-length / 2 - 0.06, 0.52 * height, 0), "x", 18))


def pickup(obj: ObjectBuilder) -> None:
    """A car with an open bed."""
    _template(obj, "pickup", obj.lacquer())


def people_carrier(obj: ObjectBuilder) -> None:
    """A van with windows."""
    _template(obj, "van", obj.lacquer())


CARS = (sedan, hatchback, off_road, estate, pickup, sedan, people_carrier)


def _road_wheels(obj: ObjectBuilder, places: Sequence[float], radius: float, half: float) -> None:
    """Add wheels below a wide body, with dark arches around them."""
    for x in places:
        tyre = [(0.72 * radius, -0.26), (radius, -0.24), (radius, -0.03), (0.72 * radius, 0.0)]
        obj.pair(RUBBER, lathe(tyre, (x, radius, half + 0.01), "z", 22))
        rim = [(0.7 * radius, -0.1), (0.66 * radius, 0.0), (0.25 * radius, -0.04), (0.2 * radius, 0.04)]
        obj.pair(STEEL, lathe(rim, (x, radius, half + 0.015), "z", 16))
        obj.pair(BLACK, lathe([(1.28 * radius, -0.4), (1.28 * radius, 0.008)], (x, radius, half), "z", 22))


def _panes(
    obj: ObjectBuilder, x: tuple[float, float], y: tuple[float, float], half: float, count: int, gap: float
) -> None:
    """Add a row of windows on both sides."""
    edges = np.linspace(*x, count + 1)
    middle = (edges[1:] + edges[:-1]) / 2
    size = (edges[1] - edges[0] - gap, y[1] - y[0], 0.05)
    obj.pair(GLASS, boxes(points(middle, (y[0] + y[1]) / 2, half), size))


def _band(
    obj: ObjectBuilder, surface: Surface, x: tuple[float, float], y: tuple[float, float], half: float
) -> None:
    """Add a stripe along both sides."""
    obj.pair(surface, box((x[0], y[0], half - 0.05), (x[1], y[1], half + 0.012)))


def _ends(half: float, roof: float, ease: float) -> list[list[float]]:
    """Compute the stations of a body with rounded ends, for `carriage`."""
    rows = [[0.0, 0.5, 0.1, 0.3], [0.3, 0.16, 0.03, 0.08], [1.0, 0.0, 0.0, 0.0]]
    tail = [[-half + ease * x, roof * a, roof * b, roof * c] for x, a, b, c in rows]
    return tail + [[-x, a, b, c] for x, a, b, c in tail[::-1]]


def city_bus(obj: ObjectBuilder) -> None:
    """A low bus of one deck, two colours."""
    coat, second = obj.lacquer(), obj.lacquer()
    length, height, width = _template(obj, "bus", coat)
    side = width / 2 - 0.04
    top = obj.uniform(0.72, 0.95)
    obj.pair(second, box((-0.4 * length, 0.62, side - 0.05), (0.38 * length, top, side + 0.006)))
    front = length / 2 - 0.1
    obj.add(BLACK, block((length / 2 - 0.32, front), (0.83 * height, 0.92 * height), 0.36 * width, 0.02))
    obj.add(AMBER, boxes(points(front, 0.875 * height, [-0.5, -0.3, 0.0, 0.2, 0.45]), (0.02, 0.13, 0.12)))


def double_decker(obj: ObjectBuilder) -> None:
    """Two rows of windows, one above the other."""
    length, wide, high = obj.uniform(8.8, 10.6), 1.25, obj.uniform(4.1, 4.4)
    half, low = length / 2, 0.32
    red = (0.5, 0.012, 0.012)
    coat = paint(obj.tint((red, red, (0.02, 0.2, 0.09), (0.02, 0.06, 0.35), (0.6, 0.4, 0.02)), 0.15))
    obj.add(coat, carriage(_ends(half, 0.12, 0.35), wide, low, high, 0.2))
    upper, top, sign = (2.75, 3.55), 2.05, 2.2
    _panes(obj, (-half + 0.6, half - 0.9), (1.25, 2.0), wide, obj.integer(5, 7), 0.09)
    _panes(obj, (-half + 0.35, half - 0.35), upper, wide, obj.integer(6, 8), 0.09)
    for front, rear, share in ((upper, upper, 0.9), ((1.05, top), (1.25, top), 0.92)):
        obj.add(GLASS, block((half - 0.05, half + 0.02), front, share * wide, 0.02))
        obj.add(GLASS, block((-half - 0.02, -half + 0.05), rear, 0.8 * wide, 0.02))
    obj.add(BLACK, block((half - 0.05, half + 0.03), (sign, sign + 0.28), 0.8 * wide, 0.01))
    letters = points(half + 0.03, sign + 0.14, wide * np.array([-0.45, -0.3, -0.1, 0.05, 0.2, 0.4]))
    obj.add(AMBER, boxes(letters, (0.012, 0.15, 0.1 * wide)))
    for x, lamp, y in ((half, LAMP, low + 0.38), (-half, TAIL_LAMP, low + 0.55)):
        obj.pair(lamp, box((x - 0.05, y, 0.58 * wide), (x + 0.05, y + 0.2, 0.88 * wide), 0.03))
        obj.add(BLACK, block((x - 0.09, x + 0.09), (low, low + 0.2), 0.98 * wide, 0.04))
        obj.add(WHITE, block((x - 0.1, x + 0.1), (low + 0.05, low + 0.16), 0.25))
    obj.pair(BLACK, tube([(half - 0.05, top - 0.1, wide), (half + 0.25, top - 0.15, wide + 0.12)], 0.03, 6))
    obj.pair(BLACK, box((half + 0.18, top - 0.65, wide + 0.02), (half + 0.28, top - 0.15, wide + 0.24), 0.03))
    stripe, rise = WHITE if obj.chance(0.7) else obj.lacquer(), obj.uniform(0.1, 0.35)
    _band(obj, stripe, (-half + 0.3, half - 0.3), (2.25, 2.25 + rise), wide)
    _road_wheels(obj, (half - 2.2, -half + 2.4), 0.5, wide)


def school_bus(obj: ObjectBuilder) -> None:
    """Yellow with black stripes, a bonnet in front of the windscreen, lamps on the roof's edge."""
    length, wide, high = obj.uniform(7.5, 9.5), 1.2, obj.uniform(2.95, 3.2)
    half, low, nose = length / 2, 0.55, obj.uniform(1.3, 1.6)
    coat = paint(obj.tint(((0.66, 0.34, 0.006),), 0.1))
    front = half - nose
    obj.add(
        coat,
        translate_solid(carriage(_ends((half + front) / 2, 0.15, 0.4), wide, low, high, 0.3), -nose / 2 * FORWARD),
    )
    bonnet = [(front - 0.1, 1.78, 0.98), (front + 0.5 * nose, 1.66, 0.95), (half - 0.05, 1.5, 0.86),
        (half, 1.35, 0.8)]  # fmt: skip
    obj.add(coat, loft([section(x, w, low, top, 0.22) for x, top, w in bonnet]))
    obj.add(BLACK, boxes(points(half, np.linspace(0.85, 1.25, 5), 0), (0.05, 0.05, 1.0)))
    obj.pair(LAMP, lathe([(0.13, -0.03), (0.13, 0.04)], (half, 1.05, 0.64), "x", 16))
    obj.add(BLACK, block((half - 0.05, half + 0.14), (0.45, 0.68), wide, 0.04))
    obj.add(GLASS, block((front - 0.05, front + 0.02), (1.85, 2.6), 0.92 * wide, 0.02))
    _panes(obj, (-half + 0.4, front - 0.25), (1.8, 2.4), wide, obj.integer(7, 10), 0.14)
    for y in (1.0, 1.35, 1.65):
        _band(obj, BLACK, (-half + 0.15, front - 0.1), (y, y + 0.06), wide)
    obj.add(BLACK, block((front - 0.05, front + 0.03), (2.68, 2.88), 0.75, 0.02),
        block((-half - 0.09, -half + 0.09), (0.45, 0.68), wide, 0.04))  # fmt: skip
    obj.pair(TAIL_LAMP, box((front - 0.05, 2.7, 0.8), (front + 0.06, 2.86, 1.0), 0.02),
        box((-half - 0.05, 1.3, 0.8), (-half + 0.05, 1.55, 1.05), 0.02))  # fmt: skip
    obj.add(GLASS, block((-half - 0.02, -half + 0.05), (1.75, 2.4), 0.8 * wide, 0.02))
    _road_wheels(obj, (half - 0.62 * nose, -half + 2.3), 0.48, 1.0)
    obj.pair(BLACK, tube([(front, 2.1, wide), (front + 0.35, 2.0, wide + 0.15)], 0.03, 6),
        box((front + 0.3, 1.6, wide + 0.06), (front + 0.4, 2.05, wide + 0.28), 0.03))  # fmt: skip
    if obj.chance(0.5):
        stop = lathe([(0.25, -0.01), (0.25, 0.01)], (0.25 * half, 1.55, -wide - 0.3), "x", 8)
        obj.add(paint((0.6, 0.02, 0.02)), stop)
        obj.add(BLACK, beams((0.25 * half, 1.5, -wide), (0.25 * half, 1.5, -wide - 0.3), 0.04))


def coach(obj: ObjectBuilder) -> None:
    """High, with dark glass all along, a raked screen and a hold below."""
    length, wide, high = obj.uniform(9.5, 11.5), 1.27, obj.uniform(3.4, 3.7)
    half, low, coat, second = length / 2, 0.34, obj.lacquer(), obj.lacquer()
    rake = obj.uniform(0.3, 0.6)
    tail = _ends(half, 0.15, 0.4)[:3]
    front = [[half - rake, 0.0, 0, 0], [half - 0.35 * rake, 0.12, 0.0, 0.03], [half, 0.75, 0.04, 0.08]]
    obj.add(coat if obj.chance(0.6) else WHITE, carriage(tail + front, wide, low, high, 0.28))
    x = [half - 0.3, half + 0.03, half + 0.03, half - 0.3 * rake, half - rake]
    y = [1.2, 1.2, high - 0.75, high - 0.16, high - 0.3]
    obj.add(GLASS, loft([points(x, y, z) for z in (-0.9 * wide, 0.9 * wide)]))
    _panes(obj, (-half + 0.5, half - 0.5), (1.75, high - 0.55), wide, obj.integer(6, 8), 0.05)
    _band(obj, second, (-half + 0.5, half - 0.6), (0.95, 0.95 + obj.uniform(0.15, 0.5)), wide)
    for x in np.linspace(-0.1 * length, 0.2 * length, 4):
        _band(obj, BLACK, (x, x + 0.03), (0.45, 0.9), wide)
    obj.add(GLASS, block((-half - 0.02, -half + 0.05), (1.9, high - 0.5), 0.8 * wide, 0.02))
    for x, lamp in ((half, LAMP), (-half, TAIL_LAMP)):
        obj.pair(lamp, box((x - 0.06, 0.75, 0.55 * wide), (x + 0.05, 0.95, 0.9 * wide), 0.03))
        obj.add(BLACK, block((x - 0.1, x + 0.08), (low, low + 0.2), 0.96 * wide, 0.04))
    obj.add(second, block((half - 0.05, half + 0.06), (0.62, 1.05), 0.5 * wide, 0.05))
    for side in (wide, -wide):
        z = 1.08 * side
        arm = [(half - rake, high - 0.1, 0.9 * side), (half + 0.35, high - 0.25, 1.05 * side),
            (half + 0.4, high - 0.5, z)]  # fmt: skip
        mirror = box((half + 0.34, high - 1.1, z - 0.12), (half + 0.44, high - 0.5, z + 0.12), 0.04)
        obj.add(BLACK, tube(arm, 0.05, 6), mirror)
    rear = (-half + 2.6, -half + 1.4) if obj.chance(0.4) else (-half + 2.2,)
    _road_wheels(obj, (half - 2.3, *rear), 0.5, wide)
    obj.add(WHITE, block((-0.15 * length, 0.1 * length), (high - 0.05, high + 0.14), 0.7, 0.06))


BUSES = (city_bus, double_decker, school_bus, coach)


def _bogies(obj: ObjectBuilder, places: Sequence[float], radius: float) -> None:
    for x in places:
        obj.add(BLACK, block((x - 1.5, x + 1.5), (0.35, 0.95), 1.0, 0.1))
        wheel = [(radius, -0.12), (radius, 0.0), (0.8 * radius, 0.04), (0.3 * radius, 0.1)]
        for dx in (-0.95, 0.95):
            obj.pair(STEEL, lathe(wheel, (x + dx, radius, 0.95), "z", 14))


def _track(obj: ObjectBuilder, rear: float, front: float) -> None:
    """Add rails on sleepers below."""
    x = np.arange(rear, front, 0.75)
    obj.add(paint((0.1, 0.065, 0.04)), boxes(points(x, -0.22, 0), (0.28, 0.16, 2.5)))
    obj.pair(STEEL, box((rear - 0.2, -0.14, 0.7), (front + 0.2, 0.0, 0.8)))


def _wagon(obj: ObjectBuilder, rear: float, front: float, coat: Surface, stripe: Surface) -> None:
    """Add a passenger coach: windows, doors, a stripe, bogies."""
    middle, half = (rear + front) / 2, (front - rear) / 2
    obj.add(coat, translate_solid(carriage(_ends(half, 0.05, 0.2), 1.4, 0.9, 3.75, 0.5), middle * FORWARD))
    _panes(obj, (rear + 1.2, front - 1.2), (2.05, 2.85), 1.4, 6, 0.35)
    _band(obj, stripe, (rear + 0.1, front - 0.1), (1.35, 1.65), 1.4)
    for x in (rear + 0.65, front - 0.65):
        obj.pair(stripe, box((x - 0.42, 1.0, 1.35), (x + 0.42, 3.0, 1.42)))
        obj.pair(GLASS, box((x - 0.25, 2.1, 1.35), (x + 0.25, 2.8, 1.44)))
    obj.add(BLACK, block((rear - 0.5, rear + 0.1), (1.2, 3.2), 0.7))
    _bogies(obj, (rear + 2.0, front - 2.0), 0.42)


def steam_train(obj: ObjectBuilder) -> None:
    """A locomotive with boiler, chimney, cab, rods and cow catcher; a tender and a coach."""
    coat = paint(obj.tint(((0.02, 0.02, 0.022), (0.02, 0.12, 0.05), (0.3, 0.02, 0.02), (0.02, 0.05, 0.22))))
    trim, red = metal((0.5, 0.33, 0.08)), paint((0.45, 0.02, 0.02))
    r, y, long = obj.uniform(0.85, 1.0), 2.15, obj.uniform(5.2, 6.4)
    obj.add(coat, lathe([(r, 0.0), (r, long - 0.8)], (0, y, 0), "x", 22))
    obj.add(BLACK, lathe([(1.04 * r, 0.0), (1.04 * r, 0.9), (0.85 * r, 0.98)], (long - 0.9, y, 0), "x", 22))
    obj.add(STEEL, lathe([(0.72 * r, 0.0), (0.7 * r, 0.08), (0.2 * r, 0.16)], (long + 0.05, y, 0), "x", 18))
    obj.add(trim, *(lathe([(1.02 * r, 0), (1.02 * r, 0.07)], (x, y, 0), "x", 22) for x in (0.9, 2.2, 3.5)))
    wide = 0.42 if obj.chance(0.5) else 0.34
    chimney = [(0.3, y + 0.8 * r), (0.26, y + r + 0.2), (0.28, y + r + 0.7), (wide, y + r + 1.0),
        (0.34, y + r + 1.02)]  # fmt: skip
    obj.add(BLACK, lathe(chimney, (long - 0.4, 0, 0), sides=18))
    dome = [(0.36, 0.8 * r), (0.34, r + 0.25), (0.2, r + 0.42), (0.0, r + 0.46)]
    for x in (1.4, 2.9):
        obj.add(trim if obj.chance(0.7) else coat, lathe(dome, (x, y, 0), sides=16))
    obj.add(LAMP, lathe([(0.2, 0.0), (0.2, 0.22), (0.05, 0.26)], (long - 0.1, y + r + 0.22, 0), "x", 16))
    obj.add(BLACK, block((-0.4, long + 0.2), (1.05, 1.25), 1.2), block((-0.2, long - 0.2), (0.55, 1.1), 0.5))
    obj.add(coat, block((-1.9, -0.1), (1.1, 2.5), 1.3, 0.05))
    obj.pair(coat, *(box((x - 0.1, 2.4, 1.1), (x + 0.1, 3.5, 1.3)) for x in (-1.8, -0.2)))
    obj.add(BLACK, block((-1.0, -0.2), (2.45, 2.9), 1.2))
    obj.pair(trim, box((-1.6, 1.7, 1.25), (-0.4, 2.1, 1.32)))
    arc = np.linspace(0, np.pi, 9)
    obj.add(BLACK, loft([points(x, 3.5 + 0.35 * np.sin(arc), 1.45 * np.cos(arc)) for x in (-2.2, 0.1)]))
    drive, places = obj.uniform(0.62, 0.75), [0.2 + 1.5 * i for i in range(obj.integer(2, 3))]
    for x in places:
        obj.pair(red, torus((x, drive, 0.85), 0.88 * drive, 0.11, "z", 24),
            lathe([(0.25 * drive, -0.06), (0.2 * drive, 0.12)], (x, drive, 0.85), "z", 12))  # fmt: skip
        angle = 2 * np.pi * np.arange(8) / 8
        rim = points(x + 0.85 * drive * np.cos(angle), drive + 0.85 * drive * np.sin(angle), 0.85)
        obj.pair(red, beams((x, drive, 0.85), rim, 0.07))
    obj.pair(STEEL, box((places[0] - 0.15, drive - 0.28, 0.98), (places[-1] + 0.15, drive - 0.16, 1.06)),
        tube([(places[-1], drive - 0.2, 1.08), (long - 0.9, 0.75, 1.08)], 0.05, 6))  # fmt: skip
    obj.pair(coat, lathe([(0.32, -0.45), (0.32, 0.45)], (long - 0.5, 0.78, 1.0), "x", 16))
    obj.pair(STEEL, *(lathe([(0.36, -0.05), (0.36, 0.05)], (x, 0.36, 0.85), "z", 16)
        for x in (long - 1.3, long + 0.1)))  # fmt: skip
    if obj.chance(0.6):
        z = np.linspace(-1.1, 1.1, 9)
        obj.add(red, beams(points(long + 0.3, 0.95, z), points(long + 1.2 - 0.6 * abs(z), 0.12, z), 0.07))
    obj.add(red, block((long + 0.15, long + 0.32), (0.85, 1.25), 1.25))
    obj.pair(STEEL, lathe([(0.12, 0), (0.1, 0.3), (0.22, 0.32), (0.2, 0.38)], (long + 0.3, 1.05, 0.85), "x", 12))
    obj.add(coat, block((-5.0, -2.4), (0.95, 2.4), 1.25, 0.05))
    obj.add(BLACK, ball((-3.6, 2.3, 0), (1.2, 0.35, 1.05), 12))
    _bogies(obj, (-3.7,), 0.38)
    rear = -5.4 - obj.uniform(4.2, 5.6)
    _wagon(obj, rear, -5.4, obj.lacquer(), WHITE)
    _track(obj, rear, long + 1.2)


def express(obj: ObjectBuilder) -> None:
    """A streamlined nose, a dark screen, stripes, and a coach like it."""
    coat, stripe = WHITE if obj.chance(0.6) else obj.lacquer(), obj.lacquer()
    long, nose = obj.uniform(8.0, 9.5), obj.uniform(2.4, 3.6)
    t = np.linspace(0, 1, 9)
    slope = t ** obj.uniform(1.6, 2.4)
    stations = [[0.0, 0.05, 0.0, 0.05], [0.2, 0, 0, 0], [long - nose, 0, 0, 0]]
    stations += [[long - nose + nose * a, 1.95 * b, 0.12 * b, 0.62 * b] for a, b in zip(t, slope, strict=True)][1:]
    obj.add(coat, carriage(stations, 1.45, 0.55, 3.75, 0.48))
    glass, angle = [], np.linspace(0, np.pi, 9)
    for v in np.linspace(obj.uniform(0.26, 0.32), obj.uniform(0.62, 0.72), 5):
        s = np.interp(v, t, slope)
        x, roof, side = long - nose + nose * v, 3.75 - 1.95 * s + 0.015, (1.45 - 0.62 * s) * 0.8
        top = points(x, roof - 0.45 + 0.47 * np.sin(angle) ** 0.5, 1.2 * side * np.cos(angle))
        glass.append(np.concatenate([top, top[::-1] * [1, 1, 0.7] - [0, 0.5, 0]]))
    obj.add(GLASS, loft(glass))
    s = np.interp(0.88, t, slope)
    obj.pair(LAMP, ball((long - 0.14 * nose, 1.45, 1.45 - 0.66 * s), (0.32, 0.09, 0.14), 10))
    obj.add(BLACK, block((long - 0.25, long + 0.06), (0.62, 0.95), 0.5, 0.08))
    _panes(obj, (0.9, long - nose - 0.6), (2.0, 2.75), 1.45, obj.integer(5, 7), 0.3)
    _band(obj, stripe, (0.1, long - nose + 0.3), (1.2, 1.2 + obj.uniform(0.2, 0.5)), 1.45)
    if obj.chance(0.5):
        _band(obj, stripe, (0.1, long - nose + 0.3), (2.95, 3.1), 1.45)
    _bogies(obj, (1.8, long - 2.3), 0.44)
    rear = -0.4 - obj.uniform(4.8, 6.5)
    _wagon(obj, rear, -0.4, coat, stripe)
    obj.add(STEEL, *(beams((-3.0 - d, 3.7, 0), (-2.4, 4.25, 0), 0.06) for d in (0.0, 1.2)),
        block((-2.45, -2.3), (4.2, 4.28), 0.8))  # fmt: skip
    _track(obj, rear, long)


def diesel_train(obj: ObjectBuilder) -> None:
    """A square locomotive with a cab, grilles and rails, and goods wagons: tanks, boxes or coal."""
    coat, second = obj.lacquer(), obj.lacquer()
    long, cab = obj.uniform(7.6, 8.8), obj.uniform(1.8, 2.3)
    obj.add(BLACK, block((0, long), (0.85, 1.15), 1.4, 0.04), block((3.0, long - 3.2), (0.35, 0.9), 1.0, 0.1))
    short = obj.uniform(1.0, 1.8)
    front = long - short
    obj.add(coat, block((0.4, front - cab), (1.1, 3.4), 1.05, 0.12),
        block((front - cab, front), (1.1, 3.85), 1.4, 0.15))  # fmt: skip
    obj.add(second, block((front - 0.1, long - 0.25), (1.1, 2.3), 1.05, 0.15))
    obj.pair(GLASS, box((front - 0.02, 2.6, 0.15), (front + 0.03, 3.35, 1.2), 0.01),
        box((front - cab + 0.3, 2.6, 1.38), (front - 0.3, 3.3, 1.43), 0.01))  # fmt: skip
    obj.pair(BLACK, *(boxes([(x, 2.4, 1.05)], (0.7, 1.2, 0.04)) for x in np.arange(1.0, front - cab - 0.5, 1.0)))
    _band(obj, second, (0.4, front - cab), (1.35, 1.6), 1.05)
    obj.add(second, block((front - 0.05, front + 0.02), (2.35, 2.55), 1.35))
    obj.pair(LAMP, lathe([(0.16, 0), (0.14, 0.06)], (front, 3.6, 0.2), "x", 12),
        lathe([(0.13, 0), (0.12, 0.05)], (long - 0.26, 1.5, 0.75), "x", 12))  # fmt: skip
    for z, surface in zip(np.arange(-1.25, 1.5, 0.5), (AMBER, BLACK) * 3, strict=True):
        obj.add(surface, box((long - 0.02, 0.5, z - 0.25), (long + 0.1, 1.15, z + 0.25)))
    x = np.arange(0.2, front - cab, 1.0)
    obj.pair(WHITE, tube([(0.2, 2.1, 1.35), (front - cab, 2.1, 1.35)], 0.03, 6),
        beams(points(x, 1.15, 1.35), points(x, 2.1, 1.35), 0.05))  # fmt: skip
    obj.add(BLACK, lathe([(0.22, 3.3), (0.2, 3.8)], (2.2, 0, 0), sides=12),
        lathe([(0.5, 3.35), (0.5, 3.5)], (3.6, 0, 0), sides=16))  # fmt: skip
    _bogies(obj, (1.8, long - 2.0), 0.46)
    rear = -0.4
    for _ in range(2):
        size, what = obj.uniform(3.4, 4.2), obj.integer(0, 2)
        a, b, load = rear - size, rear, obj.lacquer()
        obj.add(BLACK, block((a, b), (0.85, 1.1), 1.2, 0.04), block((b - 0.1, b + 0.5), (0.8, 1.0), 0.15))
        if what == 0:
            tank = [(0.2, 0.0), (0.95, 0.15), (1.15, 0.45), (1.15, size - 0.65), (0.95, size - 0.35),
                (0.2, size - 0.2)]  # fmt: skip
            obj.add(load, lathe(tank, (a + 0.1, 2.2, 0), "x", 20))
            obj.add(STEEL, lathe([(0.3, 3.3), (0.3, 3.55)], ((a + b) / 2, 0, 0), sides=12))
        elif what == 1:
            obj.add(load, block((a + 0.1, b - 0.1), (1.05, 3.6), 1.3, 0.05))
            x = np.linspace(a + 0.3, b - 0.3, 9)
            obj.pair(load, boxes(points(x, 2.3, 1.3), (0.08, 2.4, 0.1)))
        else:
            low, high = (a + 0.5, b - 0.5), (a + 0.1, b - 0.1)
            obj.add(load, loft([rectangle(low, 1.0, 0.9), rectangle(high, 2.7, 1.3)]))
            obj.add(BLACK, ball(((a + b) / 2, 2.6, 0), (0.42 * size, 0.55, 1.1), 12))
        _bogies(obj, ((a + b) / 2,), 0.42)
        rear = a - 0.5
    _track(obj, rear + 0.5, long)


def tram(obj: ObjectBuilder) -> None:
    """Two joined cars with big windows, rounded ends, a current collector."""
    coat, second = obj.lacquer(), WHITE if obj.chance(0.6) else obj.lacquer()
    long = obj.uniform(6.2, 7.4)
    for rear, front, ahead in ((0.25, long, True), (-long, -0.25, False)):
        middle, half = (rear + front) / 2, (front - rear) / 2
        nose = [[half - 1.3, 0, 0, 0], [half - 0.5, 0.1, 0.0, 0.1], [half - 0.1, 0.45, 0.02, 0.32],
            [half, 0.7, 0.05, 0.45]]  # fmt: skip
        stations = np.array(_ends(half, 0.05, 0.2)[:3] + nose)
        stations = stations if ahead else stations[::-1] * [-1, 1, 1, 1]
        obj.add(coat, translate_solid(carriage(stations, 1.3, 0.45, 3.4, 0.35), middle * FORWARD))
        inner = (rear + 0.3, front - 1.3) if ahead else (rear + 1.3, front - 0.3)
        _panes(obj, inner, (1.6, 2.75), 1.3, obj.integer(4, 5), 0.12)
        _band(obj, second, inner, (0.6, obj.uniform(1.0, 1.4)), 1.3)
        end, way = (front, 1) if ahead else (rear, -1)
        pane = np.array([[0.03, 1.45], [0.03, 2.62], [-0.1, 2.95], [-0.5, 2.85], [-0.5, 1.45]])
        obj.add(GLASS, loft([points(end + way * pane[:, 0], pane[:, 1], z) for z in (-0.8, 0.8)]))
        obj.add(BLACK, block((end - 0.3 if ahead else end - 0.06, end + 0.06 if ahead else end + 0.3), (2.82, 3.1),
            0.6, 0.02))  # fmt: skip
        obj.add(AMBER, boxes(points(end + 0.065 * way, 2.96, [-0.4, -0.2, 0.05, 0.3]), (0.02, 0.16, 0.13)))
        obj.pair(LAMP if ahead else TAIL_LAMP, lathe([(0.14, -0.1), (0.12, 0.1)], (end - 0.08 * way, 1.0, 0.62),
            "x", 14))  # fmt: skip
        obj.add(second, block((end - 0.25 if ahead else end - 0.04, end + 0.04 if ahead else end + 0.25),
            (0.5, 0.8), 0.8, 0.06))  # fmt: skip
        _bogies(obj, (middle,), 0.32)
    obj.add(BLACK, block((-0.35, 0.35), (0.6, 3.2), 1.15))
    side, knee = [0.3, -0.3], (1.2, 3.9, 0)
    obj.add(STEEL, beams(points(2.0, 3.4, side), knee, 0.05), beams(knee, points(2.0, 4.35, side), 0.05))
    obj.add(STEEL, block((1.9, 2.1), (4.32, 4.4), 0.8), block((2.8, 4.2), (3.35, 3.65), 0.7, 0.08))
    _track(obj, -long, long)


TRAINS = (steam_train, express, diesel_train, tram)
