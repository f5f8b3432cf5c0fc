"""Outlines of the vehicle templates: measures in metres, canonical ones and variants of each."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from scene_ir.meshes.solids import VehicleMaterial

KINDS = ("sedan", "hatchback", "estate", "suv", "van", "pickup", "bus", "truck")
"""Kinds of templates."""


@dataclass(frozen=True, slots=True)
class CarOutline:
    """Outline of a car, van or pickup. Metres; lengths count from the front unless noted."""

    length: float
    """Overall length."""
    height: float
    """Overall height."""
    width: float
    """Overall width, with mirrors."""
    wheelbase: float
    """Distance of the axles."""
    front_overhang: float
    """Front to front axle."""
    wheel_radius: float
    """Radius of the wheels."""
    clearance: float
    """Height of the lower edge above the ground."""
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
    """Front end of the roof."""
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
    glass_top: float = 0.86
    """Upper edge of the windows, as a fraction of the height between window line and roof."""
    nose_bow: float = 0.16
    """Bow of the front in plan."""
    tail_bow: float = 0.10
    """Bow of the rear in plan."""
    tail_slope: float = 1.0
    """How far the tail leans forward towards its top, against a usual car's."""
    shoulder: float = 0.075
    """How far the glass stands inside the body's side."""
    light_span: tuple[float, float] = (0.70, 0.90)
    """Head lights' lower and upper edge, as fractions of the nose's height."""
    tail_span: tuple[float, float] = (0.62, 0.84)
    """Tail lights' edges, as fractions of the tail's height."""
    light_inner: float = 0.60
    """Inner edge of the head lights, as a fraction of the half width."""
    tail_inner: float = 0.66
    """Inner edge of the tail lights, as a fraction of the half width."""
    pillar_lights: bool = False
    """Tail lights that climb the rear pillars."""
    cladding: bool = False
    """Dark plastic along sills and arches."""
    bed: bool = False
    """An open load bed behind the cabin."""
    rails: bool = False
    """Rails on the roof."""
    spokes: int = 5
    """Spokes of a wheel."""
    intake: int = 4
    """Half width of the lower air intake, in columns of the front's grid."""
    grille: VehicleMaterial = VehicleMaterial.TRIM
    """Material of the grille."""
    indicators: bool = False
    """Amber outer ends of the head lights."""
    handles: VehicleMaterial = VehicleMaterial.TRIM
    """Material of the door handles."""


@dataclass(frozen=True, slots=True)
class BusOutline:
    """Outline of a bus. Metres; heights above the ground."""

    length: float = 11.4
    """Overall length."""
    height: float = 3.05
    """Overall height."""
    width: float = 2.55
    """Overall width, with mirrors."""
    front_overhang: float = 2.65
    """Front to front axle."""
    rear_overhang: float = 3.25
    """Rear to rear axle."""
    wheel_radius: float = 0.48
    """Radius of the wheels."""
    clearance: float = 0.30
    """Height of the lower edge."""
    sill: float = 1.25
    """Lower edge of the side windows."""
    screen_sill: float = 1.05
    """Lower edge of the windscreen."""
    header: float = 2.55
    """Upper edge of the side windows."""
    rear_sill: float = 1.75
    """Lower edge of the rear window."""
    panes: int = 7
    """Panes of a side."""
    bow: float = 0.14
    """Bow of the front in plan."""
    third_axle: bool = False
    """A second rear axle."""
    pod: bool = True
    """A box for the air conditioning on the roof."""


@dataclass(frozen=True, slots=True)
class TruckOutline:
    """Outline of a lorry with its cab over the engine, in metres."""

    length: float = 8.2
    """Overall length."""
    height: float = 3.30
    """Height of the load."""
    width: float = 2.50
    """Overall width."""
    cab_length: float = 1.95
    """Length of the cab."""
    cab_height: float = 2.75
    """Height of the cab."""
    cab_width: float = 2.36
    """Width of the cab."""
    sill: float = 1.62
    """Lower edge of the windscreen above the ground."""
    wheel_radius: float = 0.48
    """Radius of the wheels."""
    floor: float = 1.08
    """Underside of the load."""
    front_overhang: float = 1.20
    """Front to front axle."""
    rear_overhang: float = 2.05
    """Rear to last axle."""
    third_axle: bool = False
    """A second rear axle."""
    skirts: bool = False
    """Panels between the axles instead of tank and beam."""
    load: VehicleMaterial = VehicleMaterial.CARGO
    """Material of the load's box."""


Outline = CarOutline | BusOutline | TruckOutline

_CAR_KINDS = ("sedan", "hatchback", "estate", "suv", "van", "pickup")
_MEASURES = {
    "length": (4.55, 3.9, 4.65, 4.5, 4.95, 5.25),
    "height": (1.44, 1.47, 1.47, 1.69, 1.96, 1.79),
    "width": (1.78, 1.7, 1.79, 1.85, 1.92, 1.87),
    "wheelbase": (2.7, 2.5, 2.72, 2.68, 3.05, 3.15),
    "front_overhang": (0.88, 0.8, 0.9, 0.9, 0.92, 0.92),
    "wheel_radius": (0.315, 0.3, 0.315, 0.36, 0.33, 0.38),
    "clearance": (0.17, 0.16, 0.16, 0.22, 0.19, 0.24),
    "nose": (0.7, 0.72, 0.7, 0.88, 0.86, 0.92),
    "cowl": (0.93, 0.95, 0.93, 1.08, 1.1, 1.1),
    "belt_rear": (0.97, 1.02, 0.99, 1.14, 1.14, 1.13),
    "deck": (0.98, 0.95, 0.95, 1.08, 1.12, 1.08),
    "screen_base": (1.32, 1.02, 1.3, 1.22, 0.78, 1.3),
    "roof_front": (2.1, 1.72, 2.05, 1.88, 1.55, 1.95),
    "roof_rear": (1.28, 0.56, 0.4, 0.42, 0.11, 1.98),
    "rear_base": (0.62, 0.15, 0.14, 0.14, 0.06, 1.72),
    "tumblehome": (0.16, 0.14, 0.15, 0.13, 0.1, 0.13),
    "pillars": (
        ((0.47, 0.07), (0.83, 0.04)),
        ((0.46, 0.07), (0.8, 0.05)),
        ((0.36, 0.07), (0.66, 0.06)),
        ((0.42, 0.08), (0.74, 0.06)),
        ((0.3, 0.1), (0.66, 0.1)),
        ((0.52, 0.08),),
    ),
}
"""Measures of the `_CAR_KINDS`, in their order."""
_DETAILS: dict[str, dict[str, Any]] = {
    "sedan": {},
    "hatchback": {"nose_bow": 0.18, "tail_span": (0.72, 0.95)},
    "estate": {"tail_span": (0.74, 0.95), "pillar_lights": True, "rails": True},
    "suv": {"nose_bow": 0.13, "tail_span": (0.7, 0.93), "cladding": True, "rails": True},
    "van": {"tail_bow": 0.05, "tail_slope": 0.4, "shoulder": 0.05, "tail_span": (0.62, 0.97)},
    "pickup": {"nose_bow": 0.1, "tail_bow": 0.03, "tail_span": (0.55, 0.95), "cladding": True, "bed": True},
}
CARS = {
    kind: CarOutline(**{name: row[i] for name, row in _MEASURES.items()}, **_DETAILS[kind])
    for i, kind in enumerate(_CAR_KINDS)
}
"""Canonical outlines (variant 0): measures of common European cars of about 2000 to 2012, as on KITTI's streets."""


def make_outline(kind: str, variant: int) -> Outline:
    """The outline of one of the KINDS; variant 0 is the canonical one, others vary it within plausible bounds."""
    if kind == "bus":
        return _vary_bus(variant)
    if kind == "truck":
        return _vary_truck(variant)
    return _vary_car(kind, variant)


def _generator(kind: str, variant: int) -> np.random.Generator:
    return np.random.default_rng([0x7E3A, KINDS.index(kind), variant])


def _vary_car(kind: str, variant: int) -> CarOutline:
    """The kind's canonical outline, its measures changed within what cars of that kind have."""
    car = CARS[kind]
    if variant == 0:
        return car
    rng = _generator(kind, variant)

    def near(value: float, spread: float) -> float:
        return float(value * (1.0 + rng.uniform(-spread, spread)))

    length = near(car.length, 0.09 if kind == "hatchback" else 0.07)
    stretch = length / car.length
    tall = kind == "van" and rng.random() < 0.35
    height = float(rng.uniform(2.25, 2.60)) if tall else near(car.height, 0.05)
    # a high roof sits on the same body: only a part of the height is the body's
    rise = 1 + (0.15 if tall else 1.0) * (height / car.height - 1)
    front_low = float(rng.uniform(0.62, 0.74))
    tail_low = car.tail_span[0] + float(rng.uniform(-0.06, 0.02))
    rear_base = max(near(car.rear_base, 0.08 if car.bed else 0.15) * stretch, 0.13 * car.tail_slope)
    return replace(
        car,
        length=length,
        height=height,
        width=near(car.width, 0.035),
        wheelbase=near(car.wheelbase, 0.03) * stretch,
        front_overhang=near(car.front_overhang, 0.06) * stretch,
        wheel_radius=near(car.wheel_radius, 0.07),
        clearance=near(car.clearance, 0.15),
        nose=near(car.nose, 0.06) * rise,
        cowl=near(car.cowl, 0.03) * rise,
        belt_rear=near(car.belt_rear, 0.035) * rise,
        deck=near(car.deck, 0.04) * rise,
        screen_base=near(car.screen_base, 0.09) * stretch,
        roof_front=near(car.roof_front, 0.05) * stretch,
        roof_rear=rear_base + near(car.roof_rear - car.rear_base, 0.35) * stretch,
        rear_base=rear_base,
        tumblehome=near(car.tumblehome, 0.2),
        glass_top=0.86 * (car.height - car.cowl) / (height - car.cowl) if tall else car.glass_top,
        pillars=_vary_pillars(kind, car.pillars, rng),
        blind=((1, 2) if kind == "van" and rng.random() < 0.6 else ()),
        nose_bow=near(car.nose_bow, 0.3),
        tail_bow=near(car.tail_bow, 0.3),
        light_span=(front_low, front_low + float(rng.uniform(0.12, 0.24))),
        tail_span=(tail_low, min(tail_low + near(car.tail_span[1] - car.tail_span[0], 0.25), 0.95)),
        light_inner=float(rng.uniform(0.52, 0.68)),
        tail_inner=float(rng.uniform(0.55, 0.74)),
        pillar_lights=car.pillar_lights if kind != "hatchback" else bool(rng.random() < 0.35),
        cladding=car.cladding if kind != "hatchback" else bool(rng.random() < 0.2),
        rails=car.rails and bool(rng.random() < 0.6),
        spokes=int(rng.choice([5, 6, 10])),
        intake=int(rng.integers(3, 6)),
        grille=VehicleMaterial.CHROME if rng.random() < 0.2 else VehicleMaterial.TRIM,
        indicators=bool(rng.random() < 0.3),
        handles=VehicleMaterial.PAINT if rng.random() < 0.5 else VehicleMaterial.TRIM,
    )


def _vary_pillars(
    kind: str, pillars: tuple[tuple[float, float], ...], rng: np.random.Generator
) -> tuple[tuple[float, float], ...]:
    """The pillars moved a little; some hatchbacks have two long doors and so a pillar fewer."""
    moved = tuple((p + float(rng.uniform(-0.025, 0.025)), w) for p, w in pillars)
    if kind == "hatchback" and rng.random() < 0.3:
        return ((moved[0][0] + 0.08, moved[0][1]),)
    return moved


def _vary_bus(variant: int) -> BusOutline:
    if variant == 0:
        return BusOutline()
    rng = _generator("bus", variant)
    length = float(rng.uniform(9.6, 13.2))
    height = float(rng.uniform(2.90, 3.35))
    sill = float(rng.uniform(1.10, 1.45))
    return BusOutline(
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
        panes=int(rng.integers(4, 6) if length > 12.2 else rng.integers(5, 8)),
        bow=float(rng.uniform(0.06, 0.24)),
        third_axle=bool(length > 12.2),
        pod=bool(rng.random() < 0.6),
    )


def _vary_truck(variant: int) -> TruckOutline:
    if variant == 0:
        return TruckOutline()
    rng = _generator("truck", variant)
    length = float(rng.uniform(6.6, 10.2))
    height = float(rng.uniform(2.85, 3.75))
    return TruckOutline(
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
        load=VehicleMaterial.PAINT if rng.random() < 0.4 else VehicleMaterial.CARGO,
    )
