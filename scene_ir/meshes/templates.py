"""Vehicle templates made by code: closed, labelled meshes of eight kinds, each a family of plausible outlines, and
roof loads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from torch import Tensor

from scene_ir.errors import RangeError
from scene_ir.meshes.bodies import Body, body_grid, wheels
from scene_ir.meshes.outlines import KINDS, BusOutline, CarOutline, TruckOutline, make_outline
from scene_ir.meshes.solids import (
    Skin,
    TemplateSolid,
    VehicleMaterial,
    assemble,
    box,
    coons,
    mirror_solid,
    translate_solid,
)
from scene_ir.types import Mesh

_M = 6
"""Steps of a body's grid from the middle to the corners."""
_MIRROR = 0.035
"""How far door mirrors stand out over the body, each side, m."""
_CAB_CLEARANCE = 0.36
"""Height of a lorry's front bumper above the ground, m."""
_GAP = 0.014
"""Width of the gaps around doors, m."""


def _greenhouse(car: CarOutline, top: Callable[[np.ndarray], np.ndarray], half_width: float) -> TemplateSolid:
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
    edge = car.glass_top
    profile = (
        (-0.25, 0.0),
        (0.04, 0.0),
        (0.52 * edge, 0.35 * edge),
        (edge, 0.95 * edge),
        (0.955, 1.0),
        (0.985, 1.25),
    )
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
    material = _greenhouse_material(car, m, n)
    lid_material = np.full((m, n), int(VehicleMaterial.PAINT))
    floor_material = np.full((m, n), int(VehicleMaterial.UNDERBODY))
    return Skin(wall, lid, coons(wall[0], m, n), material, lid_material, floor_material).solid()


def _greenhouse_material(car: CarOutline, m: int, n: int) -> np.ndarray:
    """Materials (5, 2 m + n) of the cabin's wall: glass between the pillars, in its second and third row."""
    material = np.full((5, 2 * m + n), int(VehicleMaterial.PAINT))
    glass = slice(1, 3)
    material[glass, : m - 1] = VehicleMaterial.GLASS
    material[glass, m + n + 1 :] = VehicleMaterial.PAINT if car.blind else VehicleMaterial.GLASS
    for step in range(1, n - 1):
        # odd steps are panes, even ones the pillars behind them
        if (step - 1) // 2 not in car.blind:
            material[glass, m + step] = VehicleMaterial.GLASS if step % 2 else VehicleMaterial.TRIM
    if car.pillar_lights:
        material[glass, m + n - 1 : m + n + 1] = VehicleMaterial.TAIL_LIGHT
    return material


def _top_line(car: CarOutline) -> Callable[[np.ndarray], np.ndarray]:
    """Height of bonnet, window line and boot over x (m from the middle)."""
    half = car.length / 2
    end = car.belt_rear - 0.02 if car.rear_base < 0.3 else car.deck - 0.02
    knots = np.array(
        [
            (-half, end),
            (-half + car.rear_base, car.belt_rear),
            (half - car.screen_base, car.cowl),
            (half - 0.25, car.nose + 0.03),
            (half, car.nose),
        ]
    )
    curve = PchipInterpolator(knots[:, 0], knots[:, 1])
    return lambda x: curve(np.clip(x, -half, half))


def _car(car: CarOutline, name: str) -> Mesh:
    """A car, van or pickup: body, cabin, wheels, fittings."""
    half, half_width = car.length / 2, car.width / 2 - _MIRROR
    top = _top_line(car)
    axles = (half - car.front_overhang, half - car.front_overhang - car.wheelbase)
    arch_radius = car.wheel_radius * 1.10 + 0.005
    doors = _door_gaps(car, axles, arch_radius)
    tyre_width = 0.20 + 0.1 * (car.wheel_radius - 0.30)
    solids = [_car_body(car, top, axles, arch_radius, doors), _greenhouse(car, top, half_width)]
    for axle in axles:
        solids += wheels(axle, half_width - 0.015, car.wheel_radius, tyre_width, car.spokes)
    base_front = half - car.screen_base
    mirror_x = base_front - car.nose_bow - 0.18
    mirror_y = float(top(np.array([mirror_x]))[0]) + 0.04
    mirror = box(
        (mirror_x - 0.05, mirror_y, half_width - car.shoulder - 0.03),
        (mirror_x + 0.07, mirror_y + 0.13 + 0.6 * max(car.cowl - 1.0, 0.0), car.width / 2),
        VehicleMaterial.PAINT,
        bevel=0.03,
        rear=VehicleMaterial.TRIM,
    )
    solids += [mirror, mirror_solid(mirror)]
    for gap in doors[1:]:
        y = float(top(np.array([gap]))[0]) - 0.15
        handle = box((gap + 0.05, y, half_width - 0.08), (gap + 0.24, y + 0.035, half_width + 0.012), car.handles)
        solids += [handle, mirror_solid(handle)]
    if car.rails:
        rail_z = half_width - car.shoulder - car.tumblehome * 1.25 - 0.03
        rail = box(
            (-half + car.roof_rear + 0.25, car.height - 0.07, rail_z - 0.02),
            (half - car.roof_front - 0.3, car.height, rail_z + 0.02),
            VehicleMaterial.TRIM,
            bevel=0.008,
        )
        solids += [rail, mirror_solid(rail)]
    return assemble(solids, name)


def _door_gaps(car: CarOutline, axles: tuple[float, ...], arch_radius: float) -> np.ndarray:
    """x of the gaps between doors and body, front to rear; one pillar, one door a side."""
    base_front, base_rear = car.length / 2 - car.screen_base, -car.length / 2 + car.rear_base
    gaps = [min(base_front - 0.10, axles[0] - arch_radius - 0.08)]
    gaps.append(base_front - car.pillars[0][0] * (base_front - base_rear))
    if len(car.pillars) > 1:
        second = base_front - car.pillars[1][0] * (base_front - base_rear)
        gaps.append(max(second, axles[1] + arch_radius + 0.05))
    return np.array(gaps)


def _car_body(
    car: CarOutline,
    top: Callable[[np.ndarray], np.ndarray],
    axles: tuple[float, ...],
    arch_radius: float,
    doors: np.ndarray,
) -> TemplateSolid:
    """Everything below the window line: bonnet, doors, boot or bed, bumpers, lights, plates."""
    half, half_width = car.length / 2, car.width / 2 - _MIRROR
    base_rear = -half + car.rear_base
    lo, hi = car.light_span
    tail_lo, tail_hi = car.tail_span
    stations = [doors + _GAP / 2, doors - _GAP / 2]
    stations.append(
        np.array([half - car.nose_bow - 0.22, -half + car.tail_bow + 0.16, axles[1] - arch_radius - 0.12])
    )
    bed = (base_rear - 0.12, -half + 0.10)
    if car.bed:
        stations.append(np.array([bed[0], bed[0] - 0.02, bed[1] + 0.02, bed[1]]))
    body = Body(
        length=car.length,
        half_width=half_width,
        clearance=car.clearance,
        # lower edge, bumper's edges, plate's edges, lights' edges, shoulder, top
        front_levels=np.array([0.0, 0.16, lo * 0.52, lo * 0.80, lo, hi, 0.5 + 0.5 * hi, 1.0]),
        rear_levels=np.array(
            [0.0, 0.16, tail_lo * 0.40, tail_lo * 0.85, tail_lo, tail_hi, 0.5 + 0.5 * tail_hi, 1.0]
        ),
        front_recess=np.array([0.05, 0.0, 0.0, 0.02, 0.045, 0.11, 0.17, 0.26]),
        rear_recess=np.array([0.05, 0.0, 0.0, 0.02, 0.03, 0.05, 0.07, 0.12]) * car.tail_slope,
        side_inset=np.array([0.05, 0.022, 0.008, 0.0, 0.0, 0.010, 0.028, 0.066]),
        top=top,
        crown=0.035,
        nose_bow=car.nose_bow,
        tail_bow=car.tail_bow,
        corner=0.90,
        front_columns=np.array([0.0, 0.28, 0.29, 0.5 * (0.3 + car.light_inner), car.light_inner, 0.85, 1.0]),
        rear_columns=np.array([0.0, 0.28, 0.29, 0.5 * (0.3 + car.tail_inner), car.tail_inner, 0.87, 1.0]),
        axles=axles,
        arch_radius=arch_radius,
        hub=car.wheel_radius,
        stations=np.concatenate(stations),
        tyre_width=0.21,
    )
    wall, lid, floor, inner = body_grid(body)
    m, n = _M, len(inner) + 1
    material = np.full((wall.shape[0] - 1, wall.shape[1] - 1), int(VehicleMaterial.PAINT))
    middle = (inner[:-1] + inner[1:]) / 2
    gaps = m + 1 + np.nonzero(np.min(np.abs(middle[:, None] - doors), axis=1) < 1e-6)[0]
    material[1:, gaps] = VehicleMaterial.TRIM
    material[0] = VehicleMaterial.TRIM
    material[1, : car.intake] = VehicleMaterial.TRIM
    material[1, -car.intake :] = VehicleMaterial.TRIM
    if car.cladding:
        material[1] = VehicleMaterial.TRIM
    material[4, :4] = car.grille
    material[4, 4 : m + 1] = VehicleMaterial.HEADLIGHT
    if car.indicators:
        material[4, m] = VehicleMaterial.INDICATOR
    material[4, m + n - 1 : m + n + 2] = VehicleMaterial.TAIL_LIGHT
    material[2, :1] = VehicleMaterial.PLATE
    material[3, -1:] = VehicleMaterial.PLATE
    lid_material = np.full((m, n), int(VehicleMaterial.PAINT))
    if car.bed:
        columns = np.nonzero((inner < bed[0] - 0.01) & (inner > bed[1] + 0.01))[0] + 1
        lid[m - 1, columns, 2] = lid[m, columns, 2] - 0.06
        lid[m - 2, columns, 2] = lid[m, columns, 2] - 0.07
        for c in range(m - 1):
            lid[c, columns, 1] = car.belt_rear - 0.45
            lid[c, columns, 2] = lid[m - 2, columns, 2] * c / (m - 2)
        lid_material[: m - 1, columns[0] - 1 : columns[-1] + 1] = VehicleMaterial.TRIM
    return Skin(wall, lid, floor, material, lid_material, np.full((m, n), int(VehicleMaterial.UNDERBODY))).solid()


def _bus(bus: BusOutline, name: str) -> Mesh:
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
    body = Body(
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
        arch_steps=4 if bus.third_axle else 6,
        side_levels=np.array(side),
    )
    wall, lid, floor, inner = body_grid(body)
    m, n = _M, len(inner) + 1
    material = np.full((len(front) - 1, 2 * m + n), int(VehicleMaterial.PAINT))
    material[0] = VehicleMaterial.TRIM
    centre = (inner[:-1] + inner[1:]) / 2
    pane = (centre < pillars[0] + 0.03) & (centre > pillars[-1] - 0.03)
    post = np.min(np.abs(centre[:, None] - pillars[None]), axis=1) < 0.034
    material[4, m + 1 : m + n - 1] = np.where(
        pane, np.where(post, int(VehicleMaterial.TRIM), int(VehicleMaterial.GLASS)), int(VehicleMaterial.PAINT)
    )
    # the driver's window reaches from the screen to the first pillar
    material[4, m : m + 1 + int(np.sum(centre > pillars[0]))] = VehicleMaterial.GLASS
    material[4, :m] = VehicleMaterial.GLASS
    material[4, m + n + 1 :] = VehicleMaterial.GLASS
    material[5, : m - 1] = VehicleMaterial.TRIM
    material[2, 4:m] = VehicleMaterial.HEADLIGHT
    material[1, :2] = VehicleMaterial.PLATE
    material[2, :2] = VehicleMaterial.TRIM
    material[2:4, m + n : m + n + 2] = VehicleMaterial.TAIL_LIGHT
    material[1, -1:] = VehicleMaterial.PLATE
    material[2, m + n + 3 :] = VehicleMaterial.TRIM
    lid_material = np.full((m, n), int(VehicleMaterial.PAINT))
    floor_material = np.full((m, n), int(VehicleMaterial.UNDERBODY))
    solids = [Skin(wall, lid, floor, material, lid_material, floor_material).solid()]
    for axle in axles:
        solids += wheels(axle, half_width - 0.03, bus.wheel_radius, 0.30, 10)
    if bus.pod:
        pod = box(
            (-0.18 * bus.length, roof - 0.10, -0.75),
            (0.10 * bus.length, bus.height, 0.75),
            VehicleMaterial.PAINT,
            bevel=0.08,
        )
        solids.append(pod)
    mirror = box(
        (half - 0.42, 1.75, half_width - 0.12),
        (half - 0.25, 2.15, bus.width / 2),
        VehicleMaterial.TRIM,
        bevel=0.03,
    )
    solids += [mirror, mirror_solid(mirror)]
    return assemble(solids, name)


def _truck_cab(truck: TruckOutline) -> TemplateSolid:
    """A lorry's cab over its front axle."""
    half, clearance = truck.length / 2, _CAB_CLEARANCE
    span = truck.cab_height - clearance

    def level(height: float) -> float:
        return (height - clearance) / span

    header = truck.cab_height - 0.38
    levels = np.array([0.0, 0.07, 0.13, 0.24, level(truck.sill), level(header), 0.955, 1.0])
    middle = half - truck.cab_length / 2
    door = truck.cab_length / 2 - 0.30
    cab = Body(
        length=truck.cab_length,
        half_width=truck.cab_width / 2,
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
        axles=(half - truck.front_overhang - middle,),
        arch_radius=truck.wheel_radius * 1.12,
        hub=truck.wheel_radius,
        stations=np.array([door, door - 0.06, -truck.cab_length / 2 + 0.42, -truck.cab_length / 2 + 0.36]),
        tyre_width=0.30,
        ease=0.25,
        arch_reach=level(truck.sill),
        side_levels=levels,
    )
    wall, lid, floor, inner = body_grid(cab)
    m, n = _M, len(inner) + 1
    material = np.full((len(levels) - 1, 2 * m + n), int(VehicleMaterial.PAINT))
    material[0] = VehicleMaterial.TRIM
    material[1, : m + 1] = VehicleMaterial.TRIM
    material[4, : m - 1] = VehicleMaterial.GLASS
    centre = (inner[:-1] + inner[1:]) / 2
    window = (centre < door - 0.05) & (centre > -truck.cab_length / 2 + 0.41)
    material[4, m + 1 : m + n - 1] = np.where(window, int(VehicleMaterial.GLASS), int(VehicleMaterial.PAINT))
    material[5, : m - 1] = VehicleMaterial.TRIM
    material[2, 4:m] = VehicleMaterial.HEADLIGHT
    material[2, :4] = VehicleMaterial.TRIM
    material[3, :3] = VehicleMaterial.TRIM
    material[1, :1] = VehicleMaterial.PLATE
    lid_material = np.full((m, n), int(VehicleMaterial.PAINT))
    floor_material = np.full((m, n), int(VehicleMaterial.UNDERBODY))
    return translate_solid(Skin(wall, lid, floor, material, lid_material, floor_material).solid(), (middle, 0, 0))


def _truck(truck: TruckOutline, name: str) -> Mesh:
    """A lorry: cab, box for the load, frame, wheels."""
    half, width, cab_half = truck.length / 2, truck.width / 2, truck.cab_width / 2
    radius = truck.wheel_radius * 1.12
    axle = half - truck.front_overhang
    load_front = half - truck.cab_length - 0.12
    solids = [_truck_cab(truck)]
    solids.append(
        box((-half + 0.02, truck.floor, -width), (load_front, truck.height, width), truck.load, bevel=0.03)
    )
    solids.append(
        box((-half + 0.25, 0.62, -0.45), (half - 0.5, truck.floor + 0.02, 0.45), VehicleMaterial.UNDERBODY)
    )
    bumper = -half + 0.10
    solids.append(box((bumper, 0.45, -0.95 * width), (bumper + 0.12, 0.60, 0.95 * width), VehicleMaterial.TRIM))
    solids.append(
        box((-half, truck.floor - 0.13, -width), (-half + 0.10, truck.floor + 0.02, width), VehicleMaterial.TRIM)
    )
    light = box((-half + 0.05, 0.72, 0.62 * width), (-half + 0.16, 0.90, 0.96 * width), VehicleMaterial.TAIL_LIGHT)
    post = box(
        (-half + 0.10, 0.45, 0.55 * width), (-half + 0.30, truck.floor + 0.02, 0.60 * width), VehicleMaterial.TRIM
    )
    solids += [light, mirror_solid(light), post, mirror_solid(post)]
    solids.append(box((bumper - 0.02, 0.66, -0.26), (bumper + 0.1, 0.78, 0.26), VehicleMaterial.PLATE))
    rear_axles = [-half + truck.rear_overhang]
    if truck.third_axle:
        rear_axles.append(rear_axles[0] + 1.32)
    for x in rear_axles:
        solids += wheels(x, width - 0.05, truck.wheel_radius, 0.55, 10)
        guard = box(
            (x - radius - 0.05, truck.floor - 0.10, width - 0.62),
            (x + radius + 0.05, truck.floor + 0.02, width - 0.03),
            VehicleMaterial.TRIM,
        )
        solids += [guard, mirror_solid(guard)]
    solids += wheels(axle, cab_half - 0.03, truck.wheel_radius, 0.30, 10)
    gap = (max(rear_axles) + radius + 0.15, axle - radius - 0.35)
    if truck.skirts:
        panel = box((gap[0], 0.45, width - 0.09), (gap[1], truck.floor + 0.02, width - 0.03), truck.load)
    else:
        panel = box(
            (gap[1] - 1.0, 0.50, width - 0.65),
            (gap[1] - 0.05, truck.floor - 0.12, width - 0.08),
            VehicleMaterial.CHROME,
            bevel=0.05,
        )
        beam = box((gap[0], 0.62, width - 0.10), (gap[1] - 1.05, 0.76, width - 0.05), VehicleMaterial.TRIM)
        solids += [beam, mirror_solid(beam)]
    solids += [panel, mirror_solid(panel)]
    mirror = box(
        (half - 0.45, truck.sill + 0.1, cab_half - 0.12),
        (half - 0.30, truck.sill + 0.65, width),
        VehicleMaterial.TRIM,
        bevel=0.03,
    )
    solids += [mirror, mirror_solid(mirror)]
    return assemble(solids, name)


@lru_cache(maxsize=64)
def template(kind: str, variant: int = 0) -> Mesh:
    """A vehicle of one of the KINDS; `variant` 0 is its canonical outline, others vary it.

    The mesh is closed, symmetric about z = 0, fills the unit box, has 1,500 to 5,000 triangles and vertex colours with
    paint as a neutral light grey. Raises RangeError for an unknown kind or a negative variant.
    """
    _check(kind, variant)
    shape = make_outline(kind, variant)
    name = f"{kind}-{variant}"
    if isinstance(shape, BusOutline):
        return _bus(shape, name)
    if isinstance(shape, TruckOutline):
        return _truck(shape, name)
    return _car(shape, name)


@lru_cache(maxsize=4096)
def typical_size_lhw(kind: str, variant: int = 0) -> tuple[float, float, float]:
    """Length, height, width (m) of a variant's outline."""
    _check(kind, variant)
    shape = make_outline(kind, variant)
    return shape.length, shape.height, shape.width


def _check(kind: str, variant: int) -> None:
    if kind not in KINDS:
        raise RangeError("template kind", " or ".join(KINDS), kind)
    if variant < 0:
        raise RangeError("template variant", "an integer of at least 0", variant)


ROOF_LOADS = ("roof box", "cases", "crate")
"""Kinds of roof loads."""
_BARS_M = 0.05
"""Height of the bars above the roof."""
_SUNK_M = 0.09
"""Depth of their feet in the roof, which is arched."""
_ROOF_HEIGHT = 0.9
"""Height above which a car's mesh is roof, as a fraction of its own."""


def make_roof_load(kind: str, car: Mesh, size_lhw: Sequence[float] | Tensor) -> Mesh:
    """Make a roof load: boxes on bars, in the unit box of the car and above it.

    Args:
        kind: One of `ROOF_LOADS`.
        car: The car's mesh.
        size_lhw: The car's length, height, width, m.

    Returns:
        The load's mesh.
    """
    length, height, width = (float(side) for side in size_lhw)
    roof = car.vertices[car.vertices[:, 1] < -_ROOF_HEIGHT]
    ends = roof[:, 0].aminmax()
    middle, half = 0.5 * float(ends.min + ends.max) * length, 0.5 * float(ends.max - ends.min) * length
    reach = 0.36 * width
    solids: list[TemplateSolid] = []
    for x in (-0.6 * half, 0.6 * half):
        solids.append(box((x - 0.03, 0.5 * _BARS_M, -reach), (x + 0.03, _BARS_M, reach), VehicleMaterial.CHROME))
        for z in (-reach, reach - 0.08):
            solids.append(box((x - 0.04, -_SUNK_M, z), (x + 0.04, _BARS_M, z + 0.08), VehicleMaterial.TRIM))
    solids += _load_boxes(kind, half, width)
    low = torch.tensor([min(solid.vertices[:, axis].min() for solid in solids) for axis in range(3)])
    high = torch.tensor([max(solid.vertices[:, axis].max() for solid in solids) for axis in range(3)])
    made = assemble(solids, kind)
    # Out of the load's own unit box, y down, to the car's: its roof is at y = -1.
    size, top = (high - low).to(made.vertices), made.vertices.new_tensor([length, height, width])
    centre = torch.tensor([middle + 0.5 * float(low[0] + high[0]), -float(low[1]) - height, 0.0])
    return replace(made, vertices=(made.vertices * size + centre.to(size)) / top)


def _load_boxes(kind: str, half: float, width: float) -> list[TemplateSolid]:
    """Boxes in metres above the roof, y up, about the roof's middle; `half` is half its length."""
    if kind == "roof box":
        return [box((-0.95, _BARS_M, -0.36), (0.95, _BARS_M + 0.36, 0.36), VehicleMaterial.TRIM, bevel=0.1)]
    if kind == "cases":
        rows = [
            (-0.95, -0.35, 0.42, VehicleMaterial.CARGO),
            (-0.32, 0.2, 0.3, VehicleMaterial.TRIM),
            (0.23, 0.8, 0.36, VehicleMaterial.RIM),
        ]
        reach = 0.3 * width
        return [
            box((a * half, _BARS_M, -reach), (b * half, _BARS_M + up, reach), m, bevel=0.03)
            for a, b, up, m in rows
        ]
    return [
        box(
            (-0.8 * half, _BARS_M, -0.38 * width),
            (0.9 * half, _BARS_M + 0.4, 0.38 * width),
            VehicleMaterial.CARGO,
            bevel=0.02,
        )
    ]
