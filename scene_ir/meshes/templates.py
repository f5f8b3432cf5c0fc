"""Vehicle templates made by code: closed, labelled meshes of eight kinds, each a family of plausible outlines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.interpolate import PchipInterpolator

from scene_ir.errors import RangeError
from scene_ir.meshes.solids import Material, Skin, Solid, assemble, box, coons, mirrored, revolve
from scene_ir.types import Mesh

KINDS = ("sedan", "hatchback", "estate", "suv", "van", "pickup", "bus", "truck")
"""Kinds of template."""


@dataclass(frozen=True, slots=True)
class _Car:
    """Outline of a car, van or pickup in metres; lengths count from the front unless said otherwise."""

    length: float
    height: float
    width: float
    wheelbase: float
    front_overhang: float
    wheel_radius: float
    clearance: float
    nose: float
    """Height of the bonnet's leading edge."""
    cowl: float
    """Height of the bonnet at the windscreen."""
    belt_rear: float
    """Height of the window line at the rear end of the cabin."""
    deck: float
    """Height of the body at its rear end."""
    screen_base: float
    """Foot of the windscreen."""
    roof_front: float
    roof_rear: float
    """Rear end of the roof, from the rear."""
    rear_base: float
    """Foot of the rear screen, from the rear."""
    tumblehome: float
    """How much narrower the roof's edge is than the window line, each side."""
    pillars: tuple[tuple[float, float], ...]
    """Pillars between the side windows, as (position along the window line in [0, 1], width in m)."""
    blind: tuple[int, ...] = ()
    """Side panes, counted from the front, that are sheet metal instead of glass."""
    nose_bow: float = 0.16
    tail_bow: float = 0.10
    shoulder: float = 0.075
    """How far the glass stands inside the body's side."""
    light_span: tuple[float, float] = (0.70, 0.90)
    """Head lights' lower and upper edge, as fractions of the nose's height."""
    tail_span: tuple[float, float] = (0.62, 0.84)
    """Tail lights' edges, as fractions of the tail's height."""
    light_inner: float = 0.60
    """Inner edge of the head lights, as a fraction of the half width."""
    tail_inner: float = 0.66
    pillar_lights: bool = False
    """Tail lights that climb the rear pillars."""
    cladding: bool = False
    """Dark plastic along sills and arches."""
    bed: bool = False
    rails: bool = False
    spokes: int = 5


_CARS: dict[str, _Car] = {
    "sedan": _Car(
        4.55,
        1.44,
        1.78,
        2.70,
        0.88,
        0.315,
        0.17,
        0.70,
        0.93,
        0.98,
        1.00,
        1.32,
        2.10,
        1.28,
        0.62,
        0.16,
        ((0.47, 0.07), (0.83, 0.04)),
    ),
    "hatchback": _Car(
        3.95,
        1.48,
        1.70,
        2.50,
        0.80,
        0.30,
        0.16,
        0.72,
        0.95,
        1.02,
        0.95,
        1.02,
        1.72,
        0.36,
        0.10,
        0.14,
        ((0.46, 0.07), (0.80, 0.05)),
        tail_span=(0.72, 0.95),
        nose_bow=0.18,
    ),
    "estate": _Car(
        4.65,
        1.47,
        1.79,
        2.72,
        0.90,
        0.315,
        0.16,
        0.70,
        0.93,
        0.99,
        0.95,
        1.30,
        2.05,
        0.40,
        0.10,
        0.15,
        ((0.36, 0.07), (0.66, 0.06)),
        tail_span=(0.74, 0.95),
        pillar_lights=True,
        rails=True,
    ),
    "suv": _Car(
        4.50,
        1.69,
        1.85,
        2.68,
        0.90,
        0.36,
        0.22,
        0.88,
        1.08,
        1.14,
        1.08,
        1.22,
        1.88,
        0.42,
        0.10,
        0.13,
        ((0.42, 0.08), (0.74, 0.06)),
        tail_span=(0.70, 0.93),
        cladding=True,
        rails=True,
        nose_bow=0.13,
    ),
    "van": _Car(
        4.95,
        1.96,
        1.92,
        3.05,
        0.92,
        0.33,
        0.19,
        0.86,
        1.10,
        1.14,
        1.12,
        0.78,
        1.55,
        0.10,
        0.04,
        0.10,
        ((0.30, 0.10), (0.66, 0.10)),
        tail_span=(0.62, 0.97),
        pillar_lights=False,
        nose_bow=0.16,
        tail_bow=0.05,
        shoulder=0.05,
    ),
    "pickup": _Car(
        5.25,
        1.79,
        1.87,
        3.15,
        0.92,
        0.38,
        0.24,
        0.92,
        1.10,
        1.13,
        1.08,
        1.30,
        1.95,
        1.98,
        1.72,
        0.13,
        ((0.52, 0.08),),
        tail_span=(0.55, 0.95),
        nose_bow=0.10,
        tail_bow=0.03,
        cladding=True,
        bed=True,
    ),
}

_M = 6
"""Steps of a body's grid from the middle to the corners."""
_ARC = np.linspace(np.pi, 0.0, 9)
"""Angles of the stations of a wheel arch."""


def _generator(kind: str, variant: int) -> np.random.Generator:
    return np.random.default_rng([0x7E3A, KINDS.index(kind), variant])


def _vary_car(kind: str, variant: int) -> _Car:
    """The kind's canonical outline, its measures changed within what cars of that kind have."""
    car = _CARS[kind]
    if variant == 0:
        return car
    rng = _generator(kind, variant)

    def near(value: float, spread: float) -> float:
        return float(value * (1.0 + rng.uniform(-spread, spread)))

    length = near(car.length, 0.07)
    stretch = length / car.length
    height = near(car.height, 0.05)
    rise = height / car.height
    radius = near(car.wheel_radius, 0.07)
    front_low = float(rng.uniform(0.62, 0.74))
    tail_shift = float(rng.uniform(-0.05, 0.03))
    return replace(
        car,
        length=length,
        height=height,
        width=near(car.width, 0.035),
        wheelbase=near(car.wheelbase, 0.03) * stretch,
        front_overhang=near(car.front_overhang, 0.06) * stretch,
        wheel_radius=radius,
        clearance=near(car.clearance, 0.15),
        nose=near(car.nose, 0.06) * rise,
        cowl=near(car.cowl, 0.03) * rise,
        belt_rear=near(car.belt_rear, 0.035) * rise,
        deck=near(car.deck, 0.04) * rise,
        screen_base=near(car.screen_base, 0.09) * stretch,
        roof_front=near(car.roof_front, 0.05) * stretch,
        roof_rear=near(car.roof_rear, 0.15) * stretch,
        rear_base=near(car.rear_base, 0.15) * stretch,
        tumblehome=near(car.tumblehome, 0.2),
        pillars=tuple((p + float(rng.uniform(-0.025, 0.025)), w) for p, w in car.pillars),
        blind=((1, 2) if kind == "van" and rng.random() < 0.6 else ()),
        nose_bow=near(car.nose_bow, 0.3),
        tail_bow=near(car.tail_bow, 0.3),
        light_span=(front_low, front_low + float(rng.uniform(0.12, 0.24))),
        tail_span=(car.tail_span[0] + tail_shift, car.tail_span[1] + tail_shift),
        light_inner=float(rng.uniform(0.52, 0.68)),
        tail_inner=float(rng.uniform(0.55, 0.74)),
        pillar_lights=car.pillar_lights if kind != "hatchback" else bool(rng.random() < 0.35),
        cladding=car.cladding if kind != "hatchback" else bool(rng.random() < 0.2),
        rails=car.rails and bool(rng.random() < 0.6),
        spokes=int(rng.choice([5, 6, 10])),
    )


def _wheel(x: float, z_outer: float, radius: float, tyre_width: float, spokes: int = 5) -> list[Solid]:
    """A wheel and its twin on the other side; it stands on y = 0, its outer face at `z_outer` m."""
    r, w = radius, tyre_width
    profile = np.array(
        [
            [0.0, -w],
            [0.80 * r, -w],
            [r, -0.82 * w],
            [r, -0.12 * w],
            [0.93 * r, 0.0],
            [0.68 * r, -0.01],
            [0.64 * r, -0.035],
            [0.20 * r, -0.02],
            [0.0, -0.012],
        ]
    )
    sectors = 20 if spokes != 6 else 24
    strip = np.full((8, sectors), int(Material.TYRE))
    strip[0] = int(Material.UNDERBODY)
    strip[5], strip[7] = int(Material.RIM), int(Material.RIM)
    gap = np.arange(sectors) % (sectors // spokes) >= (sectors // spokes + 1) // 2
    strip[6] = np.where(gap, int(Material.RIM_GAP), int(Material.RIM))
    wheel = revolve(profile, strip, (x, r, z_outer))
    return [wheel, mirrored(wheel)]


@dataclass(frozen=True, slots=True)
class _Body:
    """What the body's skin is made of. Levels run from the lower edge (0) to the shoulder (1)."""

    length: float
    half_width: float
    clearance: float
    front_levels: np.ndarray
    """(K + 1,) heights at the front as fractions of the height between lower edge and top."""
    rear_levels: np.ndarray
    front_recess: np.ndarray
    """(K + 1,) m, how far behind the foremost point each level is."""
    rear_recess: np.ndarray
    side_inset: np.ndarray
    """(K + 1,) m, how far inside the half width each level is along the side."""
    top: Callable[[np.ndarray], np.ndarray]
    """Height of the shoulder line over x (m from the middle, front is positive)."""
    crown: float
    nose_bow: float
    tail_bow: float
    corner: float
    """Half width of front and rear at their corners, as a fraction of `half_width`."""
    front_columns: np.ndarray
    """(m + 1,) fractions of the corner's half width."""
    rear_columns: np.ndarray
    axles: tuple[float, ...]
    arch_radius: float
    hub: float
    stations: np.ndarray
    """x of further stations along the side, m."""
    tyre_width: float
    ease: float = 0.9
    """Length over which the plan narrows towards both ends, m."""
    side_levels: np.ndarray | None = None
    """(K + 1,) fractions along the side; else they go over from the front's to the rear's."""
    arch_reach: float = 1.0
    """Levels at this fraction and above do not bend over the arches."""


def _side_stations(body: _Body) -> np.ndarray:
    """x (n + 1,) of the stations along the side, front to rear, corners left out at both ends."""
    stations = [body.stations]
    for axle in body.axles:
        arc = axle + body.arch_radius * np.cos(np.pi - _ARC)
        stations += [arc, axle + np.array([-1.0, 1.0]) * (body.arch_radius + 0.004)]
        lo, hi = axle - body.arch_radius - 0.02, axle + body.arch_radius + 0.02
        stations[0] = stations[0][(stations[0] < lo) | (stations[0] > hi)]
    return np.sort(np.concatenate(stations))[::-1]


def _lower_edge(body: _Body, x: np.ndarray) -> np.ndarray:
    """Height of the side's lower edge over x: the clearance, and the arches above the wheels."""
    edge = np.full_like(x, body.clearance)
    for axle in body.axles:
        d = x - axle
        inside = np.abs(d) < body.arch_radius + 0.002
        rise = np.sqrt(np.clip(body.arch_radius**2 - d**2, 0.0, None))
        edge = np.where(inside, np.maximum(edge, body.hub + rise), edge)
    return edge


def _body_grid(body: _Body) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Wall, lid and floor of the body's skin, and the side stations' x."""
    inner = _side_stations(body)
    levels, m, n = len(body.front_levels), len(body.front_columns) - 1, len(inner) + 1
    half_length = body.length / 2
    wall = np.empty((levels, 2 * m + n + 1, 3))
    reach = body.corner * body.half_width
    front_z, rear_z = body.front_columns * reach, body.rear_columns * reach
    for k in range(levels):
        shrink = 1 - body.side_inset[k] / body.half_width
        fx = half_length - body.front_recess[k] - body.nose_bow * body.front_columns**3
        rx = -half_length + body.rear_recess[k] + body.tail_bow * body.rear_columns**3
        x = np.concatenate([fx, np.clip(inner, rx[-1] + 0.004, fx[-1] - 0.004), rx[::-1]])
        # the plan narrows towards both ends: an ellipse's quarter at each corner
        from_front, from_rear = fx[-1] - inner, inner - rx[-1]
        ease = np.clip(np.minimum(from_front, from_rear) / body.ease, 0, 1)
        side_z = reach + (body.half_width - reach) * np.sqrt(1 - (1 - ease) ** 2)
        z = np.concatenate([front_z, side_z, rear_z[::-1]]) * shrink
        wall[k, :, 0], wall[k, :, 2] = x, z
    top_x = wall[-1, :, 0]
    edge = np.full(wall.shape[1], body.clearance)
    edge[m + 1 : m + n] = _lower_edge(body, inner)
    widest = wall[-1, :, 2].max()
    top = body.top(top_x) + body.crown * (1 - (wall[-1, :, 2] / widest) ** 2)
    along = np.clip((half_length - wall[0, :, 0]) / body.length, 0, 1)
    along[: m + 1], along[m + n :] = 0.0, 1.0
    for k in range(levels):
        fraction = body.front_levels[k] * (1 - along) + body.rear_levels[k] * along
        if body.side_levels is not None:
            fraction[m + 1 : m + n] = body.side_levels[k]
        bend = (edge - body.clearance) * np.clip(1 - fraction / body.arch_reach, 0, None)
        wall[k, :, 1] = body.clearance + fraction * (top - body.clearance) + bend
    # inside an arch the lower edge stands out instead of tucking under
    arch = edge > body.clearance + 1e-6
    wall[0, arch, 2] = np.maximum(wall[0, arch, 2], wall[1, arch, 2] + 0.004)
    lid, floor = coons(wall[-1], m, n), coons(wall[0], m, n)
    inside = (slice(0, m), slice(1, n))
    lid[inside][..., 1] = body.top(lid[inside][..., 0]) + body.crown * (1 - (lid[inside][..., 2] / widest) ** 2)
    floor[inside][..., 1] = body.clearance
    well = body.half_width - body.tyre_width - 0.12
    under = arch[m + 1 : m + n]
    floor[m - 1, 1:n, 2] = np.where(under, well, floor[m - 1, 1:n, 2])
    floor[m - 1, 1:n, 1] = np.where(under, edge[m + 1 : m + n], body.clearance)
    floor[m - 2, 1:n, 2] = np.where(under, well - 0.002, floor[m - 2, 1:n, 2])
    floor[1 : m - 2, 1:n, 2] = floor[1 : m - 2, 1:n, 2].clip(max=well - 0.1)
    return wall, lid, floor, inner


def _greenhouse(car: _Car, top: Callable[[np.ndarray], np.ndarray], half_width: float) -> Solid:
    """The cabin above the window line: screens, side windows, pillars, roof."""
    half = car.length / 2
    m = 4
    columns = np.array([0.0, 0.45, 0.80, 0.91, 1.0])
    base_front, base_rear = half - car.screen_base, -half + car.rear_base
    roof_front, roof_rear = half - car.roof_front, -half + car.roof_rear
    span = base_front - base_rear
    edges = [0.0, 0.045]
    for position, width in car.pillars:
        edges += [position - width / span / 2, position + width / span / 2]
    edges += [0.945, 1.0]
    t_base = np.array(edges)
    # doors' pillars stand nearly upright: their place on the roof is their place on the belt, moved a little
    upright = (base_front - t_base * span - roof_rear) / (roof_front - roof_rear)
    t_roof = np.clip(0.35 * t_base + 0.65 * (1 - upright), 0.0, 1.0)
    t_roof[:2], t_roof[-2:] = [0.0, 0.06], [0.94, 1.0]
    n = len(t_base) - 1
    belt_y = float(top(np.array([base_front]))[0])
    rear_y = float(top(np.array([base_rear]))[0])
    roof = car.height
    # level: (height between belt and roof, inset share of the tumblehome)
    profile = ((-0.25, 0.0), (0.04, 0.0), (0.45, 0.30), (0.86, 0.82), (0.955, 1.0), (0.985, 1.25))
    wall = np.empty((len(profile), 2 * m + n + 1, 3))
    waist = half_width - car.shoulder
    for k, (f, inset) in enumerate(profile):
        g = min(max(f, -0.12), 1.0)
        z_side = waist - car.tumblehome * inset
        bow_f, bow_r = car.nose_bow * (1.1 - 0.5 * max(f, 0)), car.tail_bow * (1.0 - 0.4 * max(f, 0))
        # screens are slightly arched: they lean more towards the roof
        lean = g + 0.06 * np.sin(np.pi * np.clip(g, 0, 1))
        front_x = base_front + (roof_front - base_front) * (2 * g - lean)
        rear_x = base_rear + (roof_rear - base_rear) * (2 * g - lean)
        corner = 0.93 * z_side
        fx = front_x - bow_f * columns**2.5
        rx = rear_x + bow_r * columns**2.5
        t = t_base * (1 - g) + t_roof * g if g > 0 else t_base
        t = (t - t[0]) / (t[-1] - t[0])
        x = fx[-1] + (rx[-1] - fx[-1]) * t
        along = np.sin(np.pi * np.clip(t, 0, 1)) ** 0.4
        z = corner + (z_side - corner) * along
        wall[k, :, 0] = np.concatenate([fx, x[1:-1], rx[::-1]])
        wall[k, :, 2] = np.concatenate([columns * corner, z[1:-1], columns[::-1] * corner])
        share = np.concatenate([np.zeros(m), t, np.ones(m)])
        base_y = belt_y * (1 - share) + rear_y * share
        arch = 0.035 * (1 - (2 * share - 1) ** 2) * max(f, 0)
        droop = 0.03 * (wall[k, :, 2] / waist) ** 2 * max(f, 0)
        wall[k, :, 1] = base_y + f * (roof - 0.035 - base_y) + arch * 0.8 - droop + 0.03 * max(f, 0)
    lid = coons(wall[-1], m, n)
    inside = (slice(0, m), slice(1, n))
    rim_y = lid[m, 1:n, 1]
    lid[inside][..., 1] = rim_y + (roof - rim_y) * (1 - (lid[inside][..., 2] / lid[m, 1:n, 2]) ** 2)
    lid[0, [0, -1], 1] = wall[-1, [0, -1], 1]
    floor = coons(wall[0], m, n)
    material = np.full((len(profile) - 1, 2 * m + n), int(Material.PAINT))
    glass = slice(1, 3)
    material[glass, : m - 1] = Material.GLASS
    material[glass, m + n + 1 :] = Material.GLASS
    for pane, s in enumerate(range(1, n, 2)):
        if pane not in car.blind:
            material[glass, m + s] = Material.GLASS
    for s in range(2, n - 1, 2):
        if (s - 1) // 2 not in car.blind:
            material[glass, m + s] = Material.TRIM
    if car.blind:
        material[glass, m + n + 1 :] = Material.PAINT
    if car.pillar_lights:
        material[glass, m + n - 1 : m + n + 1] = Material.TAIL_LIGHT
    lid_material = np.full((m, n), int(Material.PAINT))
    floor_material = np.full((m, n), int(Material.UNDERBODY))
    return Skin(wall, lid, floor, material, lid_material, floor_material).solid()


def _car(car: _Car, name: str) -> Mesh:
    """A car, van or pickup: body, cabin, wheels, mirrors."""
    half, half_width = car.length / 2, car.width / 2 - 0.035
    base_front, base_rear = half - car.screen_base, -half + car.rear_base
    knots = [
        (-half, car.deck - 0.02),
        (base_rear, car.belt_rear),
        (base_front, car.cowl),
        (half - 0.25, car.nose + 0.03),
        (half, car.nose),
    ]
    if car.rear_base < 0.3:
        knots[0] = (-half, car.belt_rear - 0.02)
    x_knot, y_knot = np.array(knots).T
    curve = PchipInterpolator(x_knot, y_knot)

    def top(x: np.ndarray) -> np.ndarray:
        return curve(np.clip(x, -half, half))

    lo, hi = car.light_span
    tlo, thi = car.tail_span
    front_levels = np.array([0.0, 0.16, lo * 0.52, lo * 0.80, lo, hi, 0.5 + 0.5 * hi, 1.0])
    rear_levels = np.array([0.0, 0.16, tlo * 0.55, tlo * 0.85, tlo, thi, 0.5 + 0.5 * thi, 1.0])
    axle_front = half - car.front_overhang
    axle_rear = axle_front - car.wheelbase
    arch_radius = car.wheel_radius * 1.13 + 0.01
    doors = np.linspace(axle_front - arch_radius, axle_rear + arch_radius, 5)[1:-1]
    ends = np.array([half - car.nose_bow - 0.22, -half + car.tail_bow + 0.16])
    more = np.array([axle_rear - arch_radius - 0.12])
    bed_edges = (
        np.array([base_rear - 0.12, base_rear - 0.14, -half + 0.12, -half + 0.10]) if car.bed else np.zeros(0)
    )
    tyre_width = 0.20 + 0.1 * (car.wheel_radius - 0.30)
    body = _Body(
        length=car.length,
        half_width=half_width,
        clearance=car.clearance,
        front_levels=front_levels,
        rear_levels=rear_levels,
        front_recess=np.array([0.05, 0.0, 0.0, 0.02, 0.045, 0.11, 0.17, 0.26]),
        rear_recess=np.array([0.06, 0.0, 0.0, 0.02, 0.03, 0.05, 0.07, 0.12]),
        side_inset=np.array([0.05, 0.022, 0.008, 0.0, 0.0, 0.010, 0.028, 0.066]),
        top=top,
        crown=0.035,
        nose_bow=car.nose_bow,
        tail_bow=car.tail_bow,
        corner=0.90,
        front_columns=np.array([0.0, 0.28, 0.29, 0.5 * (0.3 + car.light_inner), car.light_inner, 0.85, 1.0]),
        rear_columns=np.array([0.0, 0.28, 0.29, 0.5 * (0.3 + car.tail_inner), car.tail_inner, 0.87, 1.0]),
        axles=(axle_front, axle_rear),
        arch_radius=arch_radius,
        hub=car.wheel_radius,
        stations=np.concatenate([doors, ends, more, bed_edges]),
        tyre_width=tyre_width,
    )
    wall, lid, floor, inner = _body_grid(body)
    m, n = _M, len(inner) + 1
    material = np.full((len(front_levels) - 1, 2 * m + n), int(Material.PAINT))
    material[4, 4 : m + 1] = Material.HEADLIGHT
    material[4, m + n - 1 : m + n + 2] = Material.TAIL_LIGHT
    material[4, m + n] = Material.TAIL_LIGHT
    material[1, :4] = Material.TRIM
    material[0, :] = Material.TRIM
    material[4, :4] = Material.TRIM
    material[2, 0:1] = Material.PLATE
    rear_plate = 3
    material[rear_plate, -1:] = Material.PLATE
    if car.cladding:
        material[1, :] = Material.TRIM
    lid_material = np.full((m, n), int(Material.PAINT))
    floor_material = np.full((m, n), int(Material.UNDERBODY))
    if car.bed:
        in_bed = (inner < base_rear - 0.13) & (inner > -half + 0.11)
        columns = np.nonzero(in_bed)[0] + 1
        lid[m - 1, columns, 2] = lid[m, columns, 2] - 0.06
        lid[m - 2, columns, 2] = lid[m, columns, 2] - 0.07
        for c in range(m - 1):
            lid[c, columns, 1] = car.belt_rear - 0.45
            lid[c, columns, 2] = lid[m - 2, columns, 2] * c / (m - 2)
        lid_material[: m - 1, columns[0] - 1 : columns[-1] + 1] = Material.TRIM
    solids = [Skin(wall, lid, floor, material, lid_material, floor_material).solid()]
    solids.append(_greenhouse(car, top, half_width))
    outer = half_width - 0.02
    for axle in body.axles:
        solids += _wheel(axle, outer, car.wheel_radius, tyre_width, car.spokes)
    mirror_x = base_front - car.nose_bow - 0.18
    mirror_y = float(top(np.array([mirror_x]))[0]) + 0.04
    mirror = box(
        (mirror_x - 0.05, mirror_y, half_width - car.shoulder - 0.03),
        (mirror_x + 0.07, mirror_y + 0.13, car.width / 2),
        Material.PAINT,
        bevel=0.03,
        rear=Material.TRIM,
    )
    solids += [mirror, mirrored(mirror)]
    if car.rails:
        rail_z = half_width - car.shoulder - car.tumblehome * 1.25 - 0.03
        rail = box(
            (-half + car.roof_rear + 0.25, car.height - 0.07, rail_z - 0.02),
            (half - car.roof_front - 0.3, car.height, rail_z + 0.02),
            Material.TRIM,
            bevel=0.008,
        )
        solids += [rail, mirrored(rail)]
    return assemble(solids, name)


@dataclass(frozen=True, slots=True)
class _Bus:
    """Outline of a bus in metres; heights above the ground."""

    length: float = 11.4
    height: float = 3.05
    width: float = 2.55
    front_overhang: float = 2.65
    rear_overhang: float = 3.25
    wheel_radius: float = 0.48
    clearance: float = 0.30
    sill: float = 1.25
    """Lower edge of the side windows."""
    screen_sill: float = 1.05
    """Lower edge of the windscreen."""
    header: float = 2.55
    """Upper edge of the side windows."""
    rear_sill: float = 1.75
    panes: int = 7
    bow: float = 0.14
    third_axle: bool = False
    pod: bool = True
    """A box for the air conditioning on the roof."""


@dataclass(frozen=True, slots=True)
class _Truck:
    """Outline of a lorry with its cab over the engine, in metres."""

    length: float = 8.2
    height: float = 3.30
    width: float = 2.50
    cab_length: float = 1.95
    cab_height: float = 2.75
    cab_width: float = 2.36
    sill: float = 1.62
    """Lower edge of the windscreen above the ground."""
    wheel_radius: float = 0.48
    floor: float = 1.08
    """Underside of the load."""
    front_overhang: float = 1.20
    rear_overhang: float = 2.05
    third_axle: bool = False
    skirts: bool = False


def _vary_bus(variant: int) -> _Bus:
    if variant == 0:
        return _Bus()
    rng = _generator("bus", variant)
    length = float(rng.uniform(9.6, 13.2))
    height = float(rng.uniform(2.90, 3.35))
    sill = float(rng.uniform(1.10, 1.45))
    return _Bus(
        length=length,
        height=height,
        width=float(rng.uniform(2.48, 2.58)),
        front_overhang=float(rng.uniform(2.4, 2.8)),
        rear_overhang=float(rng.uniform(0.25, 0.31)) * length,
        wheel_radius=float(rng.uniform(0.45, 0.51)),
        clearance=float(rng.uniform(0.24, 0.36)),
        sill=sill,
        screen_sill=float(rng.uniform(0.95, 1.15)),
        header=height - float(rng.uniform(0.38, 0.60)),
        rear_sill=float(rng.uniform(1.55, 1.95)),
        panes=int(rng.integers(5, 9)),
        bow=float(rng.uniform(0.06, 0.24)),
        third_axle=bool(length > 12.2),
        pod=bool(rng.random() < 0.6),
    )


def _vary_truck(variant: int) -> _Truck:
    if variant == 0:
        return _Truck()
    rng = _generator("truck", variant)
    length = float(rng.uniform(6.6, 10.2))
    height = float(rng.uniform(2.85, 3.75))
    return _Truck(
        length=length,
        height=height,
        width=float(rng.uniform(2.35, 2.55)),
        cab_length=float(rng.uniform(1.75, 2.2)),
        cab_height=float(rng.uniform(2.45, 2.85)),
        cab_width=float(rng.uniform(2.20, 2.34)),
        sill=float(rng.uniform(1.50, 1.70)),
        wheel_radius=float(rng.uniform(0.44, 0.51)),
        floor=float(rng.uniform(1.0, 1.15)),
        front_overhang=float(rng.uniform(1.1, 1.3)),
        rear_overhang=float(rng.uniform(0.22, 0.28)) * length,
        third_axle=bool(length > 8.8),
        skirts=bool(rng.random() < 0.4),
    )


def _shifted(solid: Solid, x: float) -> Solid:
    return replace(solid, vertices=solid.vertices + np.array([x, 0.0, 0.0]))


def _bus(bus: _Bus, name: str) -> Mesh:
    """A single-deck bus: one long body, windows all round."""
    half, half_width = bus.length / 2, bus.width / 2 - 0.04
    roof = bus.height - (0.16 if bus.pod else 0.0)
    span = roof - bus.clearance

    def level(height: float) -> float:
        return (height - bus.clearance) / span

    axles = [half - bus.front_overhang, -half + bus.rear_overhang]
    if bus.third_axle:
        axles.append(axles[1] - 1.25)
    radius = bus.wheel_radius * 1.12
    header = min(bus.header, roof - 0.30)
    # levels: skirt, bumper, lights' edges, window sill, window header, roof's edge
    front = [0.0, 0.10, 0.16, 0.25, level(bus.screen_sill), level(header) + 0.01, 0.965, 1.0]
    side = [0.0, 0.10, 0.16, 0.27, level(bus.sill), level(header), 0.965, 1.0]
    rear = [0.0, 0.10, 0.16, 0.30, level(bus.rear_sill), level(header), 0.965, 1.0]
    pillars = np.linspace(half - 0.75, -half + 0.35, bus.panes + 1)
    stations = np.sort(np.concatenate([pillars - 0.035, pillars + 0.035]))
    body = _Body(
        length=bus.length,
        half_width=half_width,
        clearance=bus.clearance,
        front_levels=np.array(front),
        rear_levels=np.array(rear),
        front_recess=np.array([0.03, 0.0, 0.0, 0.01, 0.02, 0.10, 0.16, 0.30]),
        rear_recess=np.array([0.03, 0.0, 0.0, 0.0, 0.01, 0.03, 0.05, 0.14]),
        side_inset=np.array([0.02, 0.0, 0.0, 0.0, 0.008, 0.035, 0.06, 0.17]),
        top=lambda x: np.full_like(x, roof - 0.04),
        crown=0.04,
        nose_bow=bus.bow,
        tail_bow=0.05,
        corner=0.93,
        front_columns=np.array([0.0, 0.22, 0.40, 0.62, 0.74, 0.94, 1.0]),
        rear_columns=np.array([0.0, 0.16, 0.40, 0.74, 0.86, 0.95, 1.0]),
        axles=tuple(axles),
        arch_radius=radius,
        hub=bus.wheel_radius,
        stations=stations,
        tyre_width=0.30,
        ease=0.35,
        arch_reach=level(bus.sill),
        side_levels=np.array(side),
    )
    wall, lid, floor, inner = _body_grid(body)
    m, n = _M, len(inner) + 1
    material = np.full((len(front) - 1, 2 * m + n), int(Material.PAINT))
    material[0] = Material.TRIM
    centre = (inner[:-1] + inner[1:]) / 2
    pane = (centre < pillars[0] + 0.03) & (centre > pillars[-1] - 0.03)
    post = np.min(np.abs(centre[:, None] - pillars[None]), axis=1) < 0.034
    material[4, m + 1 : m + n - 1] = np.where(pane, np.where(post, int(Material.TRIM), int(Material.GLASS)), 0)
    # the driver's window reaches from the screen to the first pillar
    material[4, m : m + 1 + int(np.sum(centre > pillars[0]))] = Material.GLASS
    material[4, :m] = Material.GLASS
    material[4, m + n + 1 :] = Material.GLASS
    material[5, : m - 1] = Material.TRIM
    material[2, 4:m] = Material.HEADLIGHT
    material[1, :2] = Material.PLATE
    material[2, :2] = Material.TRIM
    material[2:4, m + n : m + n + 2] = Material.TAIL_LIGHT
    material[1, -1:] = Material.PLATE
    material[2, m + n + 3 :] = Material.TRIM
    lid_material = np.full((m, n), int(Material.PAINT))
    floor_material = np.full((m, n), int(Material.UNDERBODY))
    solids = [Skin(wall, lid, floor, material, lid_material, floor_material).solid()]
    for axle in axles:
        solids += _wheel(axle, half_width - 0.03, bus.wheel_radius, 0.30, 10)
    if bus.pod:
        pod = box(
            (-0.18 * bus.length, roof - 0.10, -0.75),
            (0.10 * bus.length, bus.height, 0.75),
            Material.PAINT,
            bevel=0.08,
        )
        solids.append(pod)
    mirror = box(
        (half - 0.42, 1.75, half_width - 0.12), (half - 0.25, 2.15, bus.width / 2), Material.TRIM, bevel=0.03
    )
    solids += [mirror, mirrored(mirror)]
    return assemble(solids, name)


def _truck(truck: _Truck, name: str) -> Mesh:
    """A lorry: cab, box for the load, frame, wheels."""
    half = truck.length / 2
    clearance, cab_half = 0.36, truck.cab_width / 2
    span = truck.cab_height - clearance
    radius = truck.wheel_radius * 1.12
    axle = half - truck.front_overhang

    def level(height: float) -> float:
        return (height - clearance) / span

    header = truck.cab_height - 0.38
    levels = np.array([0.0, 0.07, 0.13, 0.24, level(truck.sill), level(header), 0.955, 1.0])
    middle = half - truck.cab_length / 2
    door = truck.cab_length / 2 - 0.30
    cab = _Body(
        length=truck.cab_length,
        half_width=cab_half,
        clearance=clearance,
        front_levels=levels,
        rear_levels=levels,
        front_recess=np.array([0.03, 0.0, 0.0, 0.02, 0.07, 0.20, 0.27, 0.42]),
        rear_recess=np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.02, 0.08]),
        side_inset=np.array([0.02, 0.0, 0.0, 0.0, 0.01, 0.05, 0.08, 0.17]),
        top=lambda x: np.full_like(x, truck.cab_height - 0.05),
        crown=0.05,
        nose_bow=0.16,
        tail_bow=0.02,
        corner=0.93,
        front_columns=np.array([0.0, 0.24, 0.44, 0.64, 0.76, 0.94, 1.0]),
        rear_columns=np.array([0.0, 0.24, 0.44, 0.64, 0.76, 0.94, 1.0]),
        axles=(axle - middle,),
        arch_radius=radius,
        hub=truck.wheel_radius,
        stations=np.array([door, door - 0.06, -truck.cab_length / 2 + 0.42, -truck.cab_length / 2 + 0.36]),
        tyre_width=0.30,
        ease=0.25,
        arch_reach=level(truck.sill),
        side_levels=levels,
    )
    wall, lid, floor, inner = _body_grid(cab)
    m, n = _M, len(inner) + 1
    material = np.full((len(levels) - 1, 2 * m + n), int(Material.PAINT))
    material[0] = Material.TRIM
    material[1, : m + 1] = Material.TRIM
    material[4, : m - 1] = Material.GLASS
    centre = (inner[:-1] + inner[1:]) / 2
    window = (centre < door - 0.05) & (centre > -truck.cab_length / 2 + 0.41)
    material[4, m + 1 : m + n - 1] = np.where(window, int(Material.GLASS), int(Material.PAINT))
    material[5, : m - 1] = Material.TRIM
    material[2, 4:m] = Material.HEADLIGHT
    material[2, :4] = Material.TRIM
    material[3, :3] = Material.TRIM
    material[1, :1] = Material.PLATE
    lid_material = np.full((m, n), int(Material.PAINT))
    floor_material = np.full((m, n), int(Material.UNDERBODY))
    solids = [_shifted(Skin(wall, lid, floor, material, lid_material, floor_material).solid(), middle)]
    load_front = half - truck.cab_length - 0.12
    width = truck.width / 2
    solids.append(
        box((-half + 0.02, truck.floor, -width), (load_front, truck.height, width), Material.CARGO, bevel=0.03)
    )
    solids.append(box((-half + 0.25, 0.62, -0.45), (half - 0.5, truck.floor + 0.02, 0.45), Material.UNDERBODY))
    bumper = -half + 0.10
    solids.append(box((bumper, 0.45, -0.95 * width), (bumper + 0.12, 0.60, 0.95 * width), Material.TRIM))
    solids.append(
        box((-half, truck.floor - 0.13, -width), (-half + 0.10, truck.floor + 0.02, width), Material.TRIM)
    )
    light = box((-half + 0.05, 0.72, 0.62 * width), (-half + 0.16, 0.90, 0.96 * width), Material.TAIL_LIGHT)
    post = box((-half + 0.10, 0.45, 0.55 * width), (-half + 0.30, truck.floor + 0.02, 0.60 * width), Material.TRIM)
    solids += [light, mirrored(light), post, mirrored(post)]
    solids.append(box((bumper - 0.02, 0.66, -0.26), (bumper + 0.1, 0.78, 0.26), Material.PLATE))
    rear_axles = [-half + truck.rear_overhang]
    if truck.third_axle:
        rear_axles.append(rear_axles[0] + 1.32)
    for x in rear_axles:
        solids += _wheel(x, width - 0.05, truck.wheel_radius, 0.55, 10)
        guard = box(
            (x - radius - 0.05, truck.floor - 0.10, width - 0.62),
            (x + radius + 0.05, truck.floor + 0.02, width - 0.03),
            Material.TRIM,
        )
        solids += [guard, mirrored(guard)]
    solids += _wheel(axle, cab_half - 0.03, truck.wheel_radius, 0.30, 10)
    gap = (max(rear_axles) + radius + 0.15, axle - radius - 0.35)
    if truck.skirts:
        panel = box((gap[0], 0.45, width - 0.09), (gap[1], truck.floor + 0.02, width - 0.03), Material.CARGO)
    else:
        panel = box(
            (gap[1] - 1.0, 0.50, width - 0.65),
            (gap[1] - 0.05, truck.floor - 0.12, width - 0.08),
            Material.CHROME,
            bevel=0.05,
        )
        beam = box((gap[0], 0.62, width - 0.10), (gap[1] - 1.05, 0.76, width - 0.05), Material.TRIM)
        solids += [beam, mirrored(beam)]
    solids += [panel, mirrored(panel)]
    mirror = box(
        (half - 0.45, truck.sill + 0.1, cab_half - 0.12),
        (half - 0.30, truck.sill + 0.65, width),
        Material.TRIM,
        bevel=0.03,
    )
    solids += [mirror, mirrored(mirror)]
    return assemble(solids, name)


@lru_cache(maxsize=256)
def template(kind: str, variant: int = 0) -> Mesh:
    """A vehicle of one of the KINDS; each `variant` (>= 0) is another outline of its family, 0 the canonical one.

    The mesh is closed, symmetric to z = 0, fills the unit box, has 1,500 to 5,000 triangles and colours in which
    paint is a neutral light grey. Raises RangeError for an unknown kind or a negative variant.
    """
    _check(kind, variant)
    name = f"{kind}-{variant}"
    if kind == "bus":
        return _bus(_vary_bus(variant), name)
    if kind == "truck":
        return _truck(_vary_truck(variant), name)
    return _car(_vary_car(kind, variant), name)


def typical_size_lhw(kind: str, variant: int = 0) -> tuple[float, float, float]:
    """Length, height, width (m) that this variant's outline was drawn with: plausible for its kind."""
    _check(kind, variant)
    if kind == "bus":
        outline: _Bus | _Truck | _Car = _vary_bus(variant)
    elif kind == "truck":
        outline = _vary_truck(variant)
    else:
        outline = _vary_car(kind, variant)
    return outline.length, outline.height, outline.width


def _check(kind: str, variant: int) -> None:
    if kind not in KINDS:
        raise RangeError("template kind", " or ".join(KINDS), kind)
    if variant < 0:
        raise RangeError("template variant", "an integer of at least 0", variant)
