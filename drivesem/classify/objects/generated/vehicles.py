"""Generators of cars, buses, trains, airplanes, boats, motorcycles and skateboards.

Cars and city buses are vehicle templates in glossy paint.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drivesem.classify.objects.generated.shapes import (
    AMBER,
    BLACK,
    CHROME,
    FORWARD,
    GLASS,
    LAMP,
    PAINTS,
    RUBBER,
    STEEL,
    TAIL_LAMP,
    UP,
    WHITE,
    WOODS,
    Array,
    ObjectBuilder,
    Pair,
    Surface,
    ball,
    beams,
    block,
    body,
    box,
    boxes,
    carriage,
    dull,
    lathe,
    loft,
    metal,
    paint,
    patch,
    plastic,
    points,
    rectangle,
    rotate,
    section,
    slab,
    torus,
    translate_solid,
    tube,
    wing,
)
from scene_ir.meshes.solids import COLOUR, TemplateSolid, VehicleMaterial, clean_solid
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


def _jet_engines(obj: ObjectBuilder, cowl: Surface, x: float, y: float, z: float, radius: float) -> None:
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
        _jet_engines(obj, cowl, -0.24 * length, 0.4 * r, 1.65 * r, 0.55 * r)
        obj.pair(skin, box((-0.28 * length, 0.3 * r, 0.6 * r), (-0.2 * length, 0.5 * r, 1.5 * r)))
    obj.pair(grey, wing(0.1, (flat[0] - half, flat[1], 0, 2 * r), (0.4 * r - half, height, 0.36 * span, 0.9 * r)))
    for share in () if rear else (0.32,) if obj.chance(0.7) else (0.30, 0.58):
        x0, z, size = root - share * span * sweep + 0.10 * chord, share * span, r * (0.9 - 0.8 * share)
        y = -0.42 * r - 1.05 * size + 0.3 * r * share
        _jet_engines(obj, cowl, x0, y, z, size)
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


_LEATHER = dull((0.015, 0.014, 0.014))


def _wheel(obj: ObjectBuilder, x: float, radius: float, thick: float, spoked: bool) -> None:
    hub = np.array([x, radius, 0.0])
    inner = radius - 2 * thick
    obj.add(RUBBER, torus(hub, radius - thick, thick, "z", 32))
    rim = CHROME if spoked else metal((0.05, 0.05, 0.055))
    obj.add(rim, torus(hub, inner, 0.32 * thick, "z", 28))
    obj.add(STEEL, lathe([(0.05, -0.07), (0.05, 0.07)], hub, "z", 14))
    obj.pair(CHROME, lathe([(0.42 * inner, 0.045), (0.42 * inner, 0.052)], hub, "z", 20))
    count, wide, deep = (18, 0.007, 0.007) if spoked else (5, 0.05, 0.035)
    angle = 2 * np.pi * np.arange(count) / count
    ends = hub + inner * points(np.cos(angle), np.sin(angle), 0)
    starts = hub + points(0, 0, 0.035 * (-1.0) ** np.arange(count) * spoked)
    obj.add(rim, beams(starts, ends, wide, deep))


def _fender(x: float, y: float, radius: float, angles: Pair, half: float) -> TemplateSolid:
    """A mudguard around a wheel's axle, between two angles that go from forward upwards, rad."""
    a, z = np.linspace(*angles, 11)[:, None], np.linspace(-half, half, 5)
    rise = radius - 0.35 * half * (z / half) ** 2

    def skin(r: Array) -> Array:
        return points(x + r * np.cos(a), y + r * np.sin(a), z)

    return slab(skin(rise), skin(rise - 0.008))


def _fork(obj: ObjectBuilder, axle: Pair, head: Pair, half: float) -> None:
    (x, y), (hx, hy) = axle, head
    obj.pair(CHROME, tube([(x, y, half), (hx, hy, half)], 0.022, 8))
    obj.pair(STEEL, tube([(x, y, half), (x + 0.5 * (hx - x), y + 0.5 * (hy - y), half)], 0.03, 8))
    obj.add(BLACK, box((hx - 0.04, hy - 0.02, -half - 0.03), (hx + 0.04, hy + 0.02, half + 0.03), 0.01))
    obj.add(BLACK, box((hx + 0.01, hy - 0.2, -half - 0.03), (hx + 0.09, hy - 0.17, half + 0.03), 0.01))


def _bars(obj: ObjectBuilder, path: list[tuple[float, float, float]], mirrors: bool) -> None:
    """Add handlebars; `path` goes from their middle to the right grip."""
    obj.pair(CHROME, tube(path, 0.012, 6))
    end, before = np.array(path[-1]), np.array(path[-2])
    way = (end - before) / np.linalg.norm(end - before)
    obj.pair(BLACK, tube([end - 0.11 * way, end + 0.02 * way], 0.02, 8))
    obj.pair(BLACK, tube([end - 0.1 * way + 0.02 * FORWARD, end + 0.07 * FORWARD], 0.006, 4))
    if mirrors:
        top = end - 0.12 * way + np.array([-0.02, 0.15, 0.05])
        obj.pair(BLACK, tube([end - 0.13 * way, top], 0.006, 4), ball(top, (0.015, 0.035, 0.055), 10))


def _engine(obj: ObjectBuilder, twin: bool, y: float) -> None:
    obj.add(STEEL, lathe([(0.12, -0.13), (0.16, -0.1), (0.16, 0.1), (0.12, 0.13)], (-0.05, y, 0), "z", 16))
    obj.add(metal((0.12, 0.12, 0.13)), block((-0.32, 0.14), (y - 0.1, y + 0.05), 0.11, 0.03))
    for lean in (0.45, -0.45) if twin else (0.2,):
        for step in range(6):
            half = 0.075 if step % 2 else 0.095
            fin = box((-half, 0.12 + 0.035 * step, -half - 0.01), (half, 0.155 + 0.035 * step, half + 0.01))
            obj.add(CHROME if step == 5 else STEEL, translate_solid(rotate(fin, "z", -lean), (-0.03, y, 0)))


def _exhaust(obj: ObjectBuilder, y: float, rear: float, lift: float, sides: int) -> None:
    path = [(0.12, y + 0.18, 0.09), (0.24, y + 0.08, 0.12), (0.2, y - 0.1, 0.14), (-0.05, y - 0.14, 0.16),
        (-0.25, y - 0.12, 0.17)]  # fmt: skip
    end = y - 0.06 + lift
    muffler = [(-0.22, y - 0.12, 0.17), (-0.32, y - 0.1, 0.18), (rear, end, 0.19)]
    add = obj.pair if sides == 2 else obj.add
    add(CHROME, tube(path, 0.025, 8), tube(muffler, [0.026, 0.045, 0.05], 10))
    add(BLACK, tube([(rear + 0.01, end, 0.19), (rear - 0.006, end, 0.19)], 0.035, 10))


def _rear(obj: ObjectBuilder, axle: float, radius: float, seat: float) -> None:
    """Add swinging arm, dampers and chain."""
    obj.pair(STEEL, tube([(axle, radius, 0.09), (-0.25, 0.36, 0.1)], 0.022, 6))
    obj.pair(CHROME, tube([(axle + 0.04, radius + 0.03, 0.12), (axle + 0.16, seat - 0.08, 0.13)], 0.014, 6))
    obj.pair(BLACK, tube([(axle + 0.07, radius + 0.12, 0.12), (axle + 0.14, seat - 0.14, 0.13)], 0.032, 8))
    obj.add(STEEL, torus((axle, radius, 0.075), 0.1, 0.008, "z", 20))


def _lamps(obj: ObjectBuilder, x: float, y: float, rear: Pair, size: float) -> None:
    """Add headlamp, tail lamp and indicators."""
    shell = [(0.4 * size, -0.11), (0.95 * size, -0.03), (size, 0.02), (0.9 * size, 0.03)]
    obj.add(CHROME, lathe(shell, (x, y, 0), "x", 18))
    obj.add(LAMP, lathe([(0.88 * size, 0.0), (0.8 * size, 0.045), (0.3 * size, 0.055)], (x, y, 0), "x", 18))
    a, b = rear
    obj.pair(AMBER, ball((x - 0.04, y - 0.02, size + 0.09), 0.03, 8), ball((a + 0.05, b - 0.02, 0.15), 0.026, 8))
    obj.pair(BLACK, tube([(x - 0.04, y - 0.02, 0.06), (x - 0.04, y - 0.02, size + 0.08)], 0.01, 4))
    obj.add(TAIL_LAMP, block((a - 0.02, a + 0.02), (b - 0.035, b + 0.035), 0.06, 0.012))
    obj.add(BLACK, block((a - 0.03, a - 0.02), (b - 0.2, b - 0.06), 0.08))


def _frame(obj: ObjectBuilder, surface: Surface, head: Pair, seat: float) -> None:
    hx, hy = head
    obj.pair(surface, tube([(hx - 0.03, hy - 0.12, 0.04), (0.22, 0.42, 0.1), (0.1, 0.22, 0.11),
        (-0.28, 0.24, 0.12), (-0.34, 0.5, 0.11), (-0.3, seat - 0.06, 0.1)], 0.018, 6))  # fmt: skip
    upper = [(hx - 0.03, hy - 0.06, 0.03), (-0.1, seat, 0.07), (-0.62, seat + 0.02, 0.09)]
    obj.pair(surface, tube(upper, 0.018, 6))


def roadster(obj: ObjectBuilder) -> None:
    """Upright, without fairing: round lamp, tank, flat seat."""
    r, base = obj.uniform(0.295, 0.32), obj.uniform(0.66, 0.72)
    coat, spoked, seat = obj.lacquer(), obj.chance(0.5), obj.uniform(0.74, 0.8)
    head = (base - 0.26, 0.92)
    _wheel(obj, base, r, 0.055, spoked)
    _wheel(obj, -base, r, 0.068, spoked)
    _fork(obj, (base, r), head, 0.1)
    _frame(obj, BLACK if obj.chance(0.6) else coat, head, seat)
    _engine(obj, twin=False, y=0.4)
    _exhaust(obj, 0.4, -base - 0.08, obj.uniform(0.0, 0.1), obj.integer(1, 2))
    _rear(obj, -base, r, seat)
    plump = obj.uniform(0.9, 1.15)
    obj.add(coat, body([[-0.14, seat + 0.03, 0.05, 0.06], [-0.02, seat + 0.06, 0.1 * plump, 0.11],
        [0.18, seat + 0.09, 0.12 * plump, 0.145], [0.33, seat + 0.09, 0.09 * plump, 0.11],
        [0.38, seat + 0.08, 0.04, 0.05]], 14, 2.5))  # fmt: skip
    obj.add(CHROME, lathe([(0.035, 0), (0.03, 0.02)], (0.16, seat + 0.09 + 0.115 * plump, 0), sides=12))
    obj.add(_LEATHER, body([[-0.74, seat + 0.06, 0.03, 0.07], [-0.66, seat + 0.05, 0.06, 0.12],
        [-0.34, seat + 0.02, 0.05, 0.13], [-0.12, seat + 0.02, 0.05, 0.1]], 12, 3.5))  # fmt: skip
    obj.add(coat, _fender(-base, r, r + 0.045, (0.9, 2.7), 0.085), _fender(base, r, r + 0.03, (0.6, 2.5), 0.07))
    obj.pair(coat, box((-0.42, seat - 0.22, 0.1), (-0.16, seat - 0.06, 0.125), 0.02))
    rise = obj.uniform(0.0, 0.08)
    _bars(obj, [(head[0], 0.97, 0), (head[0] - 0.02, 1.0 + rise, 0.12), (head[0] - 0.1, 1.02 + rise, 0.26),
        (head[0] - 0.17, 1.0 + rise, 0.38)], obj.chance(0.8))  # fmt: skip
    _lamps(obj, head[0] + 0.12, 0.86, (-0.76, seat), obj.uniform(0.085, 0.105))


def sport(obj: ObjectBuilder) -> None:
    """A fairing with a screen, a high tail, low bars."""
    r, base = 0.3, obj.uniform(0.66, 0.7)
    coat, second = obj.lacquer(), obj.lacquer()
    head = (base - 0.24, 0.84)
    _wheel(obj, base, r, 0.055, spoked=False)
    _wheel(obj, -base, r, 0.085, spoked=False)
    _fork(obj, (base, r), head, 0.1)
    _engine(obj, twin=False, y=0.38)
    _exhaust(obj, 0.36, -base - 0.06, obj.uniform(0.05, 0.28), 1)
    _rear(obj, -base, r, 0.78)
    nose = obj.uniform(0.74, 0.84)
    obj.add(coat, body([[-0.02, 0.58, 0.25, 0.15], [0.2, 0.6, 0.28, 0.2], [0.42, 0.72, 0.2, 0.2],
        [0.6, 0.8, 0.12, 0.15], [nose, 0.74, 0.05, 0.07]], 14, 2.6))  # fmt: skip
    obj.pair(second, box((-0.1, 0.3, 0.15), (0.34, 0.52, 0.205), 0.03))
    obj.add(GLASS, body([[0.28, 0.98, 0.05, 0.1], [0.42, 0.95, 0.1, 0.14], [0.62, 0.84, 0.06, 0.12],
        [0.68, 0.8, 0.02, 0.08]], 14, 2.4))  # fmt: skip
    obj.pair(LAMP, ball((nose - 0.1, 0.78, 0.07), (0.075, 0.032, 0.05), 10))
    obj.add(coat, body([[-0.16, 0.8, 0.06, 0.08], [0.0, 0.86, 0.12, 0.14], [0.18, 0.9, 0.13, 0.16],
        [0.34, 0.88, 0.08, 0.11]], 14, 2.5))  # fmt: skip
    obj.add(second, body([[-0.92, 1.0, 0.02, 0.03], [-0.74, 0.96, 0.06, 0.09], [-0.45, 0.84, 0.07, 0.12],
        [-0.28, 0.8, 0.04, 0.09]], 12, 2.8))  # fmt: skip
    obj.add(_LEATHER, body([[-0.5, 0.89, 0.03, 0.1], [-0.34, 0.85, 0.05, 0.13], [-0.12, 0.83, 0.05, 0.1]], 12,
        3.0))  # fmt: skip
    obj.add(coat, _fender(base, r, r + 0.025, (0.5, 2.6), 0.075))
    obj.add(BLACK, _fender(-base, r, r + 0.04, (1.4, 2.9), 0.08))
    obj.pair(BLACK, tube([(head[0], 0.88, 0.1), (head[0] - 0.1, 0.86, 0.33)], 0.02, 8))
    obj.pair(BLACK, tube([(0.52, 0.92, 0.12), (0.5, 1.0, 0.3)], 0.008, 4))
    obj.pair(coat, ball((0.5, 1.01, 0.33), (0.03, 0.035, 0.06), 10))
    obj.add(TAIL_LAMP, block((-0.94, -0.88), (0.975, 1.01), 0.05, 0.01))
    obj.add(BLACK, block((-0.93, -0.91), (0.68, 0.84), 0.08), beams((-0.8, 0.94, 0), (-0.92, 0.76, 0), 0.05))


def cruiser(obj: ObjectBuilder) -> None:
    """Long and low: a raked fork, wide bars, a V of two cylinders, full fenders, perhaps bags."""
    r, base, front = obj.uniform(0.31, 0.33), obj.uniform(0.74, 0.8), obj.uniform(0.82, 1.0)
    coat, spoked = obj.lacquer(), obj.chance(0.6)
    head, seat = (front - 0.42, 0.88), 0.62
    _wheel(obj, front, r + 0.02, 0.05, spoked)
    _wheel(obj, -base, r, 0.085, spoked)
    _fork(obj, (front, r + 0.02), head, 0.11)
    _frame(obj, BLACK, head, seat)
    _engine(obj, twin=True, y=0.36)
    _exhaust(obj, 0.34, -base - 0.12, 0.0, 2)
    _rear(obj, -base, r, seat)
    obj.add(coat, body([[-0.16, 0.66, 0.03, 0.03], [-0.02, 0.74, 0.09, 0.11], [0.16, 0.8, 0.12, 0.16],
        [0.3, 0.83, 0.1, 0.12], [0.38, 0.85, 0.04, 0.04]], 14, 2.2))  # fmt: skip
    obj.add(CHROME, block((0.0, 0.26), (0.83, 0.935), 0.03, 0.02))
    obj.add(_LEATHER, body([[-0.58, 0.76, 0.08, 0.1], [-0.46, 0.68, 0.07, 0.16], [-0.3, 0.64, 0.06, 0.18],
        [-0.14, 0.66, 0.05, 0.1]], 12, 2.8))  # fmt: skip
    obj.add(_LEATHER, body([[-0.86, 0.76, 0.03, 0.07], [-0.72, 0.76, 0.05, 0.11], [-0.58, 0.74, 0.05, 0.1]], 12,
        2.8))  # fmt: skip
    obj.add(coat, _fender(-base, r, r + 0.06, (0.5, 3.2), 0.115),
        _fender(front, r + 0.02, r + 0.06, (0.5, 2.9), 0.085))  # fmt: skip
    if obj.chance(0.5):
        obj.pair(_LEATHER, box((-0.98, 0.36, 0.14), (-0.56, 0.66, 0.28), 0.04))
        obj.pair(CHROME, boxes([(-0.68, 0.56, 0.285), (-0.86, 0.56, 0.285)], (0.03, 0.06, 0.012)))
    rise, wide = obj.uniform(0.1, 0.34), obj.uniform(0.34, 0.44)
    _bars(obj, [(head[0], 0.93, 0), (head[0] - 0.02, 0.95, 0.12), (head[0] - 0.08, 0.94 + rise, 0.24),
        (head[0] - 0.18, 0.96 + rise, wide - 0.12), (head[0] - 0.3, 0.94 + rise, wide)], True)  # fmt: skip
    _lamps(obj, head[0] + 0.17, 0.8, (-base - 0.36, 0.52), obj.uniform(0.09, 0.115))
    if obj.chance(0.4):
        screen = rotate(block((-0.008, 0.008), (0.0, 0.42), 0.24, 0.006), "z", 0.35)
        obj.add(GLASS, translate_solid(screen, (head[0] + 0.13, 0.92, 0)))


def scooter(obj: ObjectBuilder) -> None:
    """Small wheels, a shield before the legs, a floor to stand on, a rounded rear."""
    r, base, coat = obj.uniform(0.2, 0.24), obj.uniform(0.58, 0.66), obj.lacquer()
    second = obj.lacquer() if obj.chance(0.3) else coat
    for x in (base, -base):
        _wheel(obj, x, r, 0.055, spoked=False)
    obj.add(coat, _fender(base, r, r + 0.05, (0.2, 2.7), 0.09))
    head, floor = (base - 0.2, 0.86), 0.26
    obj.pair(STEEL, tube([(base, r, 0.08), (base - 0.1, 0.55, 0.05)], 0.022, 6))
    obj.add(coat, tube([(base - 0.08, 0.44, 0), (head[0], head[1], 0)], [0.08, 0.06], 10))
    z, t = np.linspace(-0.2, 0.2, 9), np.linspace(0, 1, 8)[:, None]
    shield = points(base - 0.16 - 0.12 * t - 1.6 * z**2 - 0.1 * (1 - t) ** 4, 0.2 + 0.58 * t,
        z * (0.75 + 0.45 * np.sin(np.pi * (0.2 + 0.6 * t))))  # fmt: skip
    obj.add(coat, slab(shield, shield - 0.015 * FORWARD))
    obj.add(BLACK, block((-0.22, base - 0.22), (floor - 0.05, floor), 0.18, 0.02))
    obj.add(coat, block((-0.22, base - 0.24), (floor - 0.07, floor - 0.03), 0.19, 0.02))
    full = obj.uniform(0.9, 1.15)
    obj.add(second, body([[-0.98, 0.56, 0.05, 0.06], [-0.86, 0.52, 0.14, 0.14 * full],
        [-0.58, 0.48, 0.2, 0.2 * full], [-0.3, 0.46, 0.2, 0.16 * full], [-0.18, 0.44, 0.18, 0.12]], 14,
        2.5))  # fmt: skip
    obj.add(_LEATHER, body([[-0.86, 0.74, 0.02, 0.07], [-0.72, 0.74, 0.06, 0.13], [-0.4, 0.72, 0.06, 0.14],
        [-0.2, 0.68, 0.04, 0.09]], 12, 3.0))  # fmt: skip
    obj.add(STEEL, box((-0.7, 0.18, 0.06), (-0.3, 0.34, 0.16), 0.03))
    obj.add(CHROME, tube([(-0.4, 0.2, 0.13), (-0.55, 0.2, 0.17), (-0.92, 0.24, 0.18)], [0.02, 0.04, 0.045], 8))
    obj.add(coat, body([[head[0] - 0.12, 0.92, 0.06, 0.1], [head[0], 0.93, 0.09, 0.12],
        [head[0] + 0.12, 0.91, 0.07, 0.09]], 12, 2.5))  # fmt: skip
    obj.add(LAMP, lathe([(0.07, 0), (0.06, 0.03), (0.02, 0.04)], (head[0] + 0.1, 0.91, 0), "x", 16))
    obj.pair(AMBER, ball((base - 0.24, 0.62, 0.17), 0.028, 8), ball((-0.9, 0.55, 0.12), 0.028, 8))
    obj.add(TAIL_LAMP, block((-1.0, -0.95), (0.54, 0.62), 0.06, 0.015))
    obj.add(BLACK, block((-1.02, -1.0), (0.34, 0.48), 0.09), beams((-0.9, 0.48, 0), (-1.01, 0.44, 0), 0.05))
    _bars(obj, [(head[0], 0.95, 0), (head[0] - 0.06, 0.97, 0.14), (head[0] - 0.13, 0.97, 0.34)], mirrors=True)
    if obj.chance(0.4):
        obj.add(coat, block((-1.16, -0.88), (0.7, 0.98), 0.15, 0.04))


MOTORCYCLES = (roadster, sport, cruiser, scooter)


def _board(
    obj: ObjectBuilder, deck: Surface, length: float, widths: list[Pair], kicks: Pair, concave: float
) -> None:
    """Add a deck with grip, trucks and wheels.

    Args:
        obj: The object.
        deck: Surface of the deck.
        length: Its length.
        widths: Position from the middle, in half lengths, and half width, from tail to nose.
        kicks: Rise of tail and nose.
        concave: Rise of the edges.
    """
    half = length / 2
    t = np.concatenate([-np.cos(np.linspace(0, np.pi / 2, 14)), np.cos(np.linspace(np.pi / 2, 0, 14))[1:]])
    places, reach = np.array(widths).T
    wide = np.interp(t, places, reach)
    end = np.sqrt(np.maximum(1 - ((np.abs(t) - 0.8).clip(0) / 0.2005) ** 2, 0.0))
    wide = wide * end + 0.004
    s = np.linspace(-1, 1, 7)
    rise = np.where(t < 0, kicks[0], kicks[1]) * ((np.abs(t) - 0.58).clip(0) / 0.42) ** 1.3
    clear, r = obj.uniform(0.085, 0.1), obj.uniform(0.026, 0.036)
    top = points(half * t[:, None], rise[:, None] + concave * s**2 + clear, wide[:, None] * s)
    obj.add(deck, slab(top, top - 0.013 * UP))
    inset = top * [0.985, 1, 0.96]
    obj.add(dull((0.012, 0.012, 0.013)), slab(inset + 0.003 * UP, inset - 0.004 * UP))
    stripe, under = obj.lacquer(), inset[4:-4] - 0.0125 * UP
    for part in (under[2:7], under[-7:-2], under[7:-7, 2:5]):
        obj.add(stripe, slab(part, part - 0.002 * UP))
    wheels = plastic(obj.tint(((0.75, 0.73, 0.66), (0.6, 0.3, 0.02), (0.55, 0.03, 0.03), (0.05, 0.35, 0.12),
        (0.02, 0.18, 0.45), (0.02, 0.02, 0.02))))  # fmt: skip
    alloy = STEEL if obj.chance(0.7) else BLACK
    axle, level, track = obj.uniform(0.52, 0.58) * half, clear - 0.012, wide.max() * 0.92
    for x, way in ((axle, 1), (-axle, -1)):
        obj.add(BLACK, block((x - 0.045, x + 0.045), (level - 0.012, level), 0.03, 0.004))
        obj.add(alloy, block((x - 0.038, x + 0.038), (level - 0.026, level - 0.01), 0.024, 0.006))
        hanger = [(x, r, -0.62 * track), (x, r + 0.012, 0), (x, r, 0.62 * track)]
        obj.add(alloy, tube([(x + 0.015 * way, level - 0.015, 0), (x - 0.015 * way, r + 0.006, 0)], [0.016, 0.012],
            10), tube(hanger, [0.009, 0.014, 0.009], 8))  # fmt: skip
        obj.add(CHROME, tube([(x, r, -1.02 * track), (x, r, 1.02 * track)], 0.005, 6))
        tread = r * np.array([(0.45, -0.62), (0.88, -0.6), (1.0, -0.38), (1.0, 0.38), (0.88, 0.6), (0.45, 0.62)])
        obj.pair(wheels, lathe(tread, (x, r, 0.8 * track), "z", 20))
        obj.pair(STEEL, lathe(r * np.array([(0.42, -0.66), (0.42, 0.66)]), (x, r, 0.8 * track), "z", 14))
        bolts = [(x + dx, clear + 0.003 + 0.001, dz) for dx in (-0.034, 0.034) for dz in (-0.02, 0.02)]
        obj.add(CHROME, boxes(bolts, (0.008, 0.004, 0.008)))


def street_board(obj: ObjectBuilder) -> None:
    """Both ends kicked up equally."""
    w, kick = obj.uniform(0.098, 0.112), obj.uniform(0.045, 0.065)
    deck = dull(obj.tint((*WOODS, *PAINTS))) if obj.chance(0.7) else obj.lacquer()
    _board(obj, deck, obj.uniform(0.76, 0.84), [(-1, 0.94 * w), (-0.5, w), (0.5, w), (1, 0.96 * w)],
        (kick, 1.05 * kick), obj.uniform(0.004, 0.012))  # fmt: skip


def cruiser_board(obj: ObjectBuilder) -> None:
    """Small, of coloured plastic: a tapered nose, a kicked tail."""
    w = obj.uniform(0.08, 0.095)
    _board(obj, plastic(obj.tint(PAINTS, 0.4)), obj.uniform(0.55, 0.66),
        [(-1, 0.8 * w), (-0.5, w), (0.3, 0.98 * w), (1, 0.6 * w)],
        (obj.uniform(0.03, 0.05), obj.uniform(0.005, 0.015)), 0.004)  # fmt: skip


def longboard(obj: ObjectBuilder) -> None:
    """Long and flat, with pointed ends or cut-outs at the wheels."""
    w = obj.uniform(0.11, 0.13)
    pointed = obj.chance(0.5)
    ends = [(-1, 0.25 * w), (-0.6, 0.8 * w), (0.0, w), (0.6, 0.85 * w), (1, 0.45 * w)]
    cuts = [(-1, 0.5 * w), (-0.75, 0.55 * w), (-0.5, 0.95 * w), (0.5, 0.95 * w), (0.75, 0.55 * w), (1, 0.5 * w)]
    line = ends if pointed else cuts
    _board(obj, paint(obj.tint(WOODS)), obj.uniform(0.92, 1.05), line,
        (obj.uniform(0.0, 0.015), obj.uniform(0.0, 0.015)), obj.uniform(-0.004, 0.006))  # fmt: skip


def old_school_board(obj: ObjectBuilder) -> None:
    """Wide, with a blunt nose and a kicked tail."""
    w = obj.uniform(0.118, 0.132)
    _board(obj, obj.lacquer(0.4), obj.uniform(0.74, 0.8), [(-1, 0.8 * w), (-0.55, 0.88 * w), (0.1, w),
        (0.6, 0.84 * w), (1, 0.62 * w)], (obj.uniform(0.05, 0.07), obj.uniform(0.01, 0.03)), 0.007)  # fmt: skip


SKATEBOARDS = (street_board, cruiser_board, longboard, old_school_board)
