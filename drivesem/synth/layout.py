"""Where the road runs and what stands on it: roads, lanes, and vehicles placed as KITTI's labels distribute them.

World axes: x right, y down, z forward, ground at y = 0, camera above the origin. A road carries its own
coordinates: d metres to the right of the ego lane's middle, s metres along.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING

import numpy as np

from drivesem.synth.people import PRAM_LENGTH_M
from drivesem.synth.soup import Material

if TYPE_CHECKING:
    from drivesem.synth.assets import VehicleMesh

ROAD_KINDS = ("residential", "city", "arterial", "motorway", "country", "junction")
_ROAD_SHARE = (0.28, 0.25, 0.12, 0.07, 0.08, 0.20)
"""KITTI's drives: mostly residential and city streets of Karlsruhe, some rural roads and motorways."""
_BUSY_TILT = {"residential": 0.9, "city": 0.9, "arterial": 0.2, "motorway": -1.2, "country": -4.0, "junction": 0.6}
"""How much likelier each kind of road is for frames with many vehicles: exponent per quantile of their number."""
MOST_VEHICLES = 24
"""In a frame, so that numbers of tracks stay small; KITTI's fullest frame labels 20."""
_RANGE_M = 76.0
"""How far along the road vehicles are placed: KITTI labels hardly any beyond."""
_SPEEDS_KMH = {
    "residential": (20, 35), "city": (30, 50), "arterial": (45, 70), "motorway": (90, 130), "country": (60, 95),
    "junction": (25, 50),
}  # fmt: skip
_STOPPED_SHARE = {
    "residential": 0.15,
    "city": 0.3,
    "arterial": 0.2,
    "motorway": 0.05,
    "country": 0.03,
    "junction": 0.6,
}
"""How often the ego car's direction stands in a queue."""
LABEL_OF_KIND = {
    "sedan": "Car", "hatchback": "Car", "estate": "Car", "suv": "Car", "pickup": "Car",
    "van": "Van", "truck": "Truck", "bus": "Truck", "pedestrian": "Pedestrian", "cyclist": "Cyclist",
}  # fmt: skip
_CAR_KINDS = ("sedan", "hatchback", "estate", "suv", "pickup")
_CAR_SHARE = (0.27, 0.38, 0.17, 0.15, 0.03)
"""Body styles among passenger cars on German roads, roughly as registered (KBA segments)."""
_PAINTS = np.array(
    [
        [0.78, 0.78, 0.77], [0.018, 0.018, 0.02], [0.16, 0.165, 0.17], [0.42, 0.43, 0.44], [0.03, 0.07, 0.22],
        [0.36, 0.025, 0.025], [0.12, 0.07, 0.045], [0.03, 0.10, 0.06], [0.52, 0.46, 0.36], [0.62, 0.50, 0.06],
        [0.05, 0.055, 0.07], [0.10, 0.20, 0.40], [0.62, 0.17, 0.03],
    ],
    np.float32,
)  # fmt: skip
_PAINT_SHARE = np.array([0.18, 0.19, 0.16, 0.15, 0.07, 0.08, 0.02, 0.025, 0.02, 0.015, 0.04, 0.04, 0.01])
"""Linear albedo of car paints and how often they are seen (new registrations 2005 to 2012: black, grey, silver,
white lead).
"""
MARGIN_M = 0.3
"""Least clearance between two footprints."""
# The following, up to _ALWAYS_M, were chosen for small distances of `drivesem.synth.compare` over 700 streets.
_CLUSTER = 1.4
"""Spread of the log weight along a row: how much vehicles stand together."""
_CHANCE = 0.6
"""Weight of chance: 1 draws places in proportion to their weights, 0 takes the heaviest."""
_NEAR_GAIN, _NEAR_M = 0.8, 12.0
"""Near places weigh more by this factor around this depth: standing together favours the far ones."""
_HARDLY_SEEN, _HARDLY_SEEN_DEFERRED = 0.25, 0.9
"""Below which visible share, and how often, a place waits for others: labels leave out what is hardly seen."""
_PLAINLY_SEEN, _APART_DEFERRED = 0.75, 0.9
"""Above which visible share, and how often, a place where nothing hides anything waits for others."""
_ALWAYS_M = 5.0
"""Up to this depth vehicles do not wait: the image's border cuts them."""
_COLUMN_PX = 4
"""Width of the columns in which roofs are compared."""
_NEAR_PLANE_M = 0.3
_LEAST_VISIBLE, _LEAST_HEIGHT_PX, _LEAST_WIDTH_PX = 0.02, 10.0, 3.0
"""What a vehicle must show of itself to count: bodies hide a little less than the rectangles around them."""
_EGO = ((0.0, 1.5), -np.pi / 2, (7.0, 2.0, 2.2))
"""Footprint that stays free for the car that carries the camera."""
_SIZE_FACTOR_LHW = {"Car": (0.905, 1.015, 0.93), "Van": (1.03, 1.05, 0.99), "Truck": (1.05, 1.01, 1.03)}
"""From the templates' sizes, of today's cars with mirrors, to the means of KITTI's labels, of 2011's without."""
_SIZE_SPREAD_LHW = {"Car": (0.045, 0.055, 0.035), "Van": (0.12, 0.1, 0.05), "Truck": (0.2, 0.1, 0.05)}
"""What is missing to the labels' standard deviations."""


@dataclass(frozen=True, slots=True)
class FittedCamera:
    """One of KITTI's rectified cameras. offset_px_m: fourth column of its projection."""

    focal_px: float
    centre_px: tuple[float, float]
    offset_px_m: tuple[float, float, float]
    size_wh_px: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Statistics:
    """Summary of KITTI's labels (`kitti_statistics.json`). edges in metres; shares sum to one."""

    vehicles_per_frame: np.ndarray
    depth_edges_m: np.ndarray
    depth_share: np.ndarray
    lateral_edges_m: np.ndarray
    lateral_share: np.ndarray
    yaw_spread_rad: float
    type_share: dict[str, float]
    size_hwl_mean_m: dict[str, list[float]]
    cameras: tuple[FittedCamera, ...]
    camera_height_m: float


@lru_cache(maxsize=1)
def statistics() -> Statistics:
    """The fitted figures shipped with the package."""
    raw = json.loads(files("drivesem.synth").joinpath("kitti_statistics.json").read_text(encoding="utf-8"))
    return Statistics(
        vehicles_per_frame=np.array(raw["vehicles_per_frame"]),
        depth_edges_m=np.array(raw["depth_edges_m"]),
        depth_share=np.array(raw["depth_share"]),
        lateral_edges_m=np.array(raw["lateral_edges_m"]),
        lateral_share=np.array(raw["lateral_share"]),
        yaw_spread_rad=raw["yaw_spread_rad"],
        type_share=raw["type_share"],
        size_hwl_mean_m=raw["size_hwl_mean_m"],
        cameras=tuple(
            FittedCamera(c["focal_px"], tuple(c["centre_px"]), tuple(c["offset_px_m"]), tuple(c["size_wh_px"]))
            for c in raw["cameras"]
        ),
        camera_height_m=raw["camera_height_m"],
    )


@dataclass(frozen=True, slots=True)
class Lane:
    """Where vehicles may be. middle_m: d. direction: +1 as the ego car, -1 oncoming, 0 across the road (parked
    nose in). parked: standing. weight: how much more often than average it is chosen. spacing_m: between
    candidates. slant_rad: that a parked row is turned by. speed_mps: of all that drives in it, along s. slack_m:
    how far a vehicle of no width may be off the middle without leaving the lane.
    """

    middle_m: float
    direction: int
    parked: bool = False
    weight: float = 1.0
    spacing_m: float = 8.0
    slant_rad: float = 0.0
    speed_mps: float = 0.0
    slack_m: float = 1.5


@dataclass(frozen=True, slots=True)
class Strip:
    """A band of ground from d0 to d1, `height_m` above the road."""

    d0: float
    d1: float
    material: Material
    height_m: float = 0.0


def _strip(edge: float, other: float, material: Material, height_m: float = 0.0) -> Strip:
    """A strip between two edges in any order."""
    return Strip(min(edge, other), max(edge, other), material, height_m)


@dataclass(frozen=True, slots=True)
class Marking:
    """A painted line along the road at `middle_m`: dashes of `dash_m` every `period_m` (equal: solid)."""

    middle_m: float
    width_m: float
    dash_m: float
    period_m: float


@dataclass(frozen=True, slots=True)
class Road:
    """One road. curvature in 1/m; crossing: (s0, s1) of a road across, or None; flank_m: (left, right) d from
    which on buildings and plants may stand. ego_speed_mps: of the car that carries the camera. busy: in [0, 1],
    the share of KITTI's frames with fewer vehicles.
    """

    kind: str
    curvature: float
    lanes: tuple[Lane, ...]
    strips: tuple[Strip, ...]
    markings: tuple[Marking, ...]
    flank_m: tuple[float, float]
    pavements: tuple[tuple[float, float], ...]
    crossing: tuple[float, float] | None = None
    ego_speed_mps: float = 0.0
    busy: float = 0.5

    @property
    def stands(self) -> bool:
        """Whether all traffic along the road waits, so that traffic across may pass."""
        return self.ego_speed_mps == 0 and all(lane.speed_mps == 0 for lane in self.lanes)

    def point(self, d: np.ndarray | float, s: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """World (x, z) of road coordinates; arrays broadcast."""
        heading = self.curvature * np.asarray(s, float)
        return self.curvature * np.square(s) / 2 + np.asarray(d) * np.cos(heading), s - np.asarray(d) * np.sin(
            heading
        )

    def yaw(self, s: float, direction: int) -> float:
        """KITTI yaw of a car driving along (+1) or against (-1) the road at s, or standing across it (0)."""
        base = {1: -np.pi / 2, -1: np.pi / 2, 0: 0.0}[direction]
        return float(base + self.curvature * s)


PUSHES_PRAM = 2
"""Variant of a varied person who pushes a pram."""


@dataclass(frozen=True, slots=True)
class Actor:
    """A vehicle or person. variant: of the shape; a person's is 0, 1 if varied, `PUSHES_PRAM` with a pram too.
    position_xz, yaw: world; size_lhw m; paint: linear albedo; seed: of its own details. lane_ds: road coordinates
    (d, s) m where it follows the road, speed_mps: along s, below 0 against it. track: its number within the scene.
    ffd: lattice offsets (192,) that bend its shape, as fractions of the unit box, or None. lamps: code in [-1, 1]:
    off, as the weather makes drivers do it, brake lamps.
    """

    kind: str
    variant: int
    position_xz: tuple[float, float]
    yaw: float
    size_lhw: tuple[float, float, float]
    paint: tuple[float, float, float]
    parked: bool
    seed: int
    lane_ds: tuple[float, float] | None = None
    speed_mps: float = 0.0
    track: int = 0
    ffd: tuple[float, ...] | None = None
    mesh: VehicleMesh | None = None
    lamps: float = 0.0

    @property
    def model(self) -> str:
        """Which shape it has, by the name that manifests give."""
        return f"{self.kind}-{self.variant}" if self.mesh is None else f"mesh-{self.mesh.name}"

    @property
    def label(self) -> str:
        """KITTI's name of the type."""
        return LABEL_OF_KIND[self.kind]


@dataclass(frozen=True, slots=True)
class LayoutSettings:
    """variants: (first, count) of the vehicle shapes to draw from. people: whether pedestrians and cyclists
    appear. varied_people: see `place_people`. crowd: times as many people. vehicles: (fewest, most) to be seen a
    frame, or None for KITTI's distribution. max_heavy: most trucks and buses. fleet: vehicles from files, used
    instead of the templates of their type.
    """

    variants: tuple[int, int] = (0, 100)
    people: bool = True
    vehicles: tuple[int, int] | None = None
    max_heavy: int = 3
    kinds: tuple[str, ...] = field(default=ROAD_KINDS)
    fleet: tuple[VehicleMesh, ...] = ()
    crowd: int = 1
    varied_people: bool = False


def plan_road(rng: np.random.Generator, kinds: tuple[str, ...] = ROAD_KINDS) -> Road:
    """A random road of one of `kinds`, how busy it is, and how fast its lanes go."""
    busy = float(rng.random())
    share = np.array([_ROAD_SHARE[ROAD_KINDS.index(k)] * np.exp(_BUSY_TILT[k] * (busy - 0.5)) for k in kinds])
    kind = kinds[int(rng.choice(len(kinds), p=share / share.sum()))]
    if kind in ("residential", "city"):
        road = _street(rng, kind, None)
    elif kind == "junction":
        start = float(rng.uniform(11, 30))
        road = _street(rng, kind, (start, start + float(rng.uniform(8, 15))))
    else:
        road = _open_road(rng, kind)
    return _with_speeds(rng, replace(road, busy=busy))


def _with_speeds(rng: np.random.Generator, road: Road) -> Road:
    """The road with a common speed for each lane, so that nothing runs into anything."""
    stopped = rng.random() < _STOPPED_SHARE[road.kind]
    oncoming_stopped = stopped and (road.kind == "junction" or rng.random() < 0.3)
    low, high = _SPEEDS_KMH[road.kind]
    lanes, ego = [], 0.0
    for lane in road.lanes:
        if lane.parked:
            lanes.append(lane)
            continue
        stands = stopped if lane.direction > 0 else oncoming_stopped
        # Lanes further to the right are slower, where there are several.
        speed = (
            0.0
            if stands
            else float(rng.uniform(low, high)) / 3.6 * (1 - 0.012 * float(np.clip(lane.middle_m, -8, 8)))
        )
        spacing = float(rng.uniform(6.3, 8.0)) if stands else 6.5 + 0.35 * speed
        if lane.middle_m == 0:
            ego = speed * float(rng.uniform(0.85, 1.0))
        gaps = [
            abs(other.middle_m - lane.middle_m) for other in road.lanes if other is not lane and not other.parked
        ]
        slack = min([3.3, *gaps]) / 2 - MARGIN_M
        lanes.append(replace(lane, speed_mps=speed * lane.direction, spacing_m=spacing, slack_m=slack))
    return replace(road, lanes=tuple(lanes), ego_speed_mps=ego)


def _street(rng: np.random.Generator, kind: str, crossing: tuple[float, float] | None) -> Road:
    """A street between parked rows, pavements and now and then parking lots."""
    quiet = kind == "residential"
    lane = float(rng.uniform(2.9, 3.4) if quiet else rng.uniform(3.0, 3.7))
    right_lanes = 0 if quiet else int(rng.choice(3, p=(0.6, 0.3, 0.1)))
    left_lanes = 0 if quiet else int(rng.choice(2, p=(0.8, 0.2)))
    oncoming = int(rng.random() < 0.8) if quiet else int(rng.choice((1, 2), p=(0.65, 0.35)))
    median = 0.0 if quiet or rng.random() < 0.6 else float(rng.uniform(1.5, 9.0))
    inner = -(0.5 + left_lanes) * lane
    other = inner - median
    left, right = other - oncoming * lane, (0.5 + right_lanes) * lane
    lanes = [Lane(i * lane, 1, weight=1.0) for i in range(-left_lanes, right_lanes + 1)]
    lanes += [Lane(other - (i + 0.5) * lane, -1, weight=1.0) for i in range(oncoming)]
    strips = [Strip(inner, right, Material.ROAD), Strip(left, other, Material.ROAD)] if median else []
    strips = strips or [Strip(left, right, Material.ROAD)]
    if median:
        strips.append(Strip(other, inner, (Material.GRASS, Material.GRAVEL)[int(rng.integers(2))], 0.1))
    edges, pavements = [], []
    for side, edge in ((-1, left), (1, right)):
        rows, bands, walk, height = _side(rng, kind, side, edge, side if oncoming else 1)
        lanes += rows
        strips += bands
        pavements.append(walk)
        outer = bands[-1].d0 if side < 0 else bands[-1].d1
        garden = Material.GRASS if quiet or rng.random() < 0.4 else Material.PAVEMENT
        strips.append(_strip(outer, outer + side * 60, garden, height))
        edges.append(outer)
    markings = []
    if not median and oncoming and (not quiet or rng.random() < 0.2):
        dash = 3.0 if rng.random() < 0.8 else 6.0
        markings.append(Marking(inner, 0.12, dash, dash * float(rng.choice([1.0, 2.0, 3.0]))))
    markings += [Marking((i + 0.5) * lane, 0.12, 3.0, 6.0) for i in range(-left_lanes, right_lanes)]
    markings += [Marking(other - i * lane, 0.12, 3.0, 6.0) for i in range(1, oncoming)]
    if not quiet and rng.random() < 0.5:
        markings += [Marking(left + 0.1, 0.12, 1.0, 1.0), Marking(right - 0.1, 0.12, 1.0, 1.0)]
    curvature = 0.0 if crossing or rng.random() < 0.5 else float(np.clip(rng.normal(0, 0.0045), -0.007, 0.007))
    return Road(
        kind,
        curvature,
        tuple(lanes),
        tuple(strips),
        tuple(markings),
        (edges[0], edges[1]),
        tuple(pavements),
        crossing,
    )


def _side(
    rng: np.random.Generator, kind: str, side: int, edge: float, facing: int
) -> tuple[list[Lane], list[Strip], tuple[float, float], float]:
    """Return parked rows, strips outwards, where people walk, and the pavement's height, along a street.

    facing: the direction of most parked cars.
    """
    quiet = kind == "residential"
    rows: list[Lane] = []
    strips: list[Strip] = []
    at = edge
    if rng.random() < (0.25 if quiet else 0.45):
        # A cycle lane, or road too wide for its lanes.
        width = float(rng.uniform(0.8, 2.0))
        strips.append(_strip(at, at + side * width, Material.ROAD))
        at += side * width
    if rng.random() < (0.9 if quiet else 0.6 if kind == "city" else 0.4):
        draw = rng.random()
        slant = 0.0 if draw < 0.85 else float(rng.choice((-1, 1)) * rng.uniform(0.6, 1.1))
        nose_in = draw >= 0.72
        width = float(rng.uniform(4.6, 5.2) if nose_in else rng.uniform(1.95, 2.3))
        material = Material.PARKING if rng.random() < 0.6 else Material.ROAD
        strips.append(_strip(at, at + side * width, material))
        direction = 0 if nose_in else facing
        spacing = 2.5 / max(float(np.cos(slant)), 0.4) if nose_in else float(rng.uniform(4.7, 5.8))
        rows.append(Lane(at + side * width / 2, direction, True, 2.2 if side < 0 else 1.3, spacing, slant))
        at += side * width
    height = float(rng.uniform(0.08, 0.14))
    walk = at + side * float(rng.uniform(1.5, 2.6) if quiet else rng.uniform(2.0, 4.5))
    strips.append(_strip(at, at + side * 0.14, Material.KERB, height))
    strips.append(_strip(at + side * 0.14, walk, Material.PAVEMENT, height))
    low, high = sorted((at + side * 0.4, walk - side * 0.3))
    if rng.random() < 0.3:
        lot, bands = _lot(rng, side, walk)
        rows += lot
        strips += bands
    return rows, strips, (low, high), height


def _lot(rng: np.random.Generator, side: int, edge: float) -> tuple[list[Lane], list[Strip]]:
    """A parking lot beyond the pavement: one or two rows, and a strip of green that ends it."""
    rows = 1 + int(rng.random() < 0.6)
    slant = 0.0 if rng.random() < 0.6 else float(rng.choice((-1, 1)) * rng.uniform(0.4, 1.2))
    width = 11.5 if rows == 1 else 17.0
    outer = edge + side * width
    spacing = 2.5 / max(float(np.cos(slant)), 0.4)
    lanes = [Lane(edge + side * 3.0, 0, True, 1.0, spacing, slant)]
    if rows == 2:
        lanes.append(Lane(edge + side * 14.0, 0, True, 1.0, spacing, slant))
    strips = [
        _strip(edge, outer, Material.PARKING),
        _strip(outer, outer + side * 1.6, Material.GRASS, 0.08),
    ]
    return lanes, strips


def _open_road(rng: np.random.Generator, kind: str) -> Road:
    """Roads without parked rows: arterial, motorway, country."""
    lane = float(rng.uniform(3.3, 3.75))
    own = {"arterial": 2, "motorway": int(rng.integers(2, 4)), "country": 1}[kind]
    ego = int(rng.integers(own))
    right = (own - ego - 0.5) * lane
    median = {"arterial": float(rng.uniform(1.5, 9.0)), "motorway": float(rng.uniform(2.5, 5.0)), "country": 0.0}[
        kind
    ]
    inner = -(ego + 0.5) * lane
    other = inner - median
    left = other - own * lane
    lanes = [Lane((i - ego) * lane, 1, weight=1.3, spacing_m=11.0) for i in range(own)]
    lanes += [Lane(other - (i + 0.5) * lane, -1, spacing_m=11.0) for i in range(own)]
    strips = [Strip(inner, right + 0.3, Material.ROAD), Strip(left - 0.3, other, Material.ROAD)]
    if median:
        kinds = (Material.GRASS, Material.GRAVEL, Material.PAVEMENT)
        strips.append(Strip(other, inner, kinds[int(rng.integers(3))], 0.1 if kind == "arterial" else 0.0))
    shoulder = {"arterial": 0.0, "motorway": 2.6, "country": 0.0}[kind]
    edges = []
    for side, edge in ((-1, left - 0.3), (1, right + 0.3)):
        if shoulder:
            strips.append(_strip(edge, edge + side * shoulder, Material.ROAD))
            edge += side * shoulder
        bank = edge + side * float(rng.uniform(0.8, 1.6))
        kind_of_bank = Material.GRAVEL if rng.random() < 0.5 else Material.GRASS
        if kind == "arterial" and rng.random() < 0.6:
            kind_of_bank = Material.PAVEMENT
            bank += side * 1.5
        strips.append(_strip(edge, bank, kind_of_bank, 0.1 if kind_of_bank == Material.PAVEMENT else 0.0))
        if kind != "motorway" and rng.random() < 0.3:
            rows, bands = _lot(rng, side, bank)
            lanes += rows
            strips += bands
            bank = bands[-1].d0 if side < 0 else bands[-1].d1
        strips.append(_strip(bank, bank + side * 60, Material.GRASS))
        edges.append(bank)
    solid = Marking(right, 0.15, 1.0, 1.0), Marking(left, 0.15, 1.0, 1.0)
    markings = list(solid)
    dash = (6.0, 18.0) if kind == "motorway" else (4.0, 12.0) if rng.random() < 0.5 else (3.0, 9.0)
    for i in range(own - 1):
        markings.append(Marking((i - ego + 0.5) * lane, 0.13, *dash))
        markings.append(Marking(other - (i + 1) * lane, 0.13, *dash))
    if median:
        markings += [Marking(inner + 0.2, 0.15, 1.0, 1.0), Marking(other - 0.2, 0.15, 1.0, 1.0)]
    else:
        markings.append(Marking(inner, 0.12, 1.0, 1.0) if rng.random() < 0.3 else Marking(inner, 0.12, *dash))
    bend = 0.0035 if kind == "country" else 0.0015
    return Road(
        kind, float(rng.normal(0, bend)), tuple(lanes), tuple(strips), tuple(markings), (edges[0], edges[1]), ()
    )


def footprint(position_xz: tuple[float, float], yaw: float, size_lhw: tuple[float, float, float]) -> np.ndarray:
    """Corners (4, 2) of the bottom face in (x, z), in order around it."""
    front = np.array([np.cos(yaw), -np.sin(yaw)]) * size_lhw[0] / 2
    side = np.array([np.sin(yaw), np.cos(yaw)]) * size_lhw[2] / 2
    return np.asarray(position_xz) + np.array([front + side, front - side, -front - side, -front + side])


def clearance(one: np.ndarray, two: np.ndarray) -> float:
    """Largest gap between two convex outlines (4, 2) along any of their side normals (negative: they overlap)."""
    gaps = []
    for outline in (one, two):
        for edge in (outline[1] - outline[0], outline[2] - outline[1]):
            normal = np.array([-edge[1], edge[0]]) / max(float(np.hypot(*edge)), 1e-9)
            a, b = one @ normal, two @ normal
            gaps.append(max(b.min() - a.max(), a.min() - b.max()))
    return float(max(gaps))


def _interpolated_share(value: float, edges: np.ndarray, share: np.ndarray) -> float:
    middle = (edges[1:] + edges[:-1]) / 2
    return float(np.interp(value, middle, share))


@dataclass(frozen=True, slots=True)
class _Spot:
    """A place that a vehicle may take. lane: None for traffic across, which stands at `yaw`. key: the lowest are
    taken first.
    """

    d: float
    s: float
    yaw: float
    lane: Lane | None
    key: float


def _candidates(road: Road, rng: np.random.Generator) -> list[_Spot]:
    """Places that vehicles may take, in the order in which they are taken."""
    found = []
    for lane in road.lanes:
        first = lane.spacing_m if lane.middle_m == 0 and not lane.parked else 0.0
        s = float(rng.uniform(0.0, lane.spacing_m)) + first
        # Rows are full here and empty there: a slow walk of the log weight.
        crowd = float(rng.normal(0, _CLUSTER))
        while s < _RANGE_M:
            keep_off = road.crossing and road.crossing[0] - 5 < s < road.crossing[1] + 5
            waiting = road.crossing and lane.speed_mps == 0 and road.crossing[0] - 2 < s < road.crossing[1] + 2
            if not ((lane.parked and keep_off) or (not lane.parked and waiting)):
                d = lane.middle_m + (float(rng.normal(0, 0.08)) if lane.parked else 0.0)
                weight = _weight(road, d, s) * lane.weight * lane.spacing_m**0.5
                key = float(rng.exponential(1.0)) ** _CHANCE / max(weight * float(np.exp(crowd)), 1e-9)
                found.append(_Spot(d, s, _lane_yaw(rng, road, lane, d, s), lane, key))
            step = lane.spacing_m * float(rng.lognormal(0.03, 0.08 if lane.parked else 0.35))
            crowd = 0.8 * crowd + 0.6 * float(rng.normal(0, _CLUSTER))
            s += step
    if road.crossing:
        found += _across(road, rng)
    return sorted(found, key=lambda spot: spot.key)


def _weight(road: Road, d: float, s: float) -> float:
    """How much a place is wanted: as often as KITTI has vehicles at its depth and to its side."""
    fitted = statistics()
    x, z = (float(v) for v in road.point(d, s))
    weight = _interpolated_share(z, fitted.depth_edges_m, fitted.depth_share)
    weight *= 1 + _NEAR_GAIN * float(np.exp(-np.square(z / _NEAR_M - 1)))
    return weight * float(np.sqrt(_interpolated_share(x, fitted.lateral_edges_m, fitted.lateral_share)))


def _lane_yaw(rng: np.random.Generator, road: Road, lane: Lane, d: float, s: float) -> float:
    """World yaw of a vehicle in a lane or a row."""
    if lane.direction == 0:
        facing = np.sign(d) if rng.random() < 0.7 else -np.sign(d)
        return road.yaw(s, 0) + (0.0 if facing > 0 else np.pi) + lane.slant_rad + float(rng.normal(0, 0.05))
    if not lane.parked:
        return road.yaw(s, lane.direction)
    flipped = rng.random() < 0.16
    return road.yaw(s, -lane.direction if flipped else lane.direction)


def _across(road: Road, rng: np.random.Generator) -> list[_Spot]:
    """Traffic on a road across: driving through where all else waits, else waiting at both sides."""
    assert road.crossing is not None
    c0, c1 = road.crossing
    paved = [s for s in road.strips if s.material == Material.ROAD]
    low, high = min(s.d0 for s in paved), max(s.d1 for s in paved)
    found = []
    for s, direction in ((c0 * 0.3 + c1 * 0.7, 1), (c0 * 0.72 + c1 * 0.28, -1)):
        across = float(rng.uniform(-36, -28))
        while across < 30:
            inside = low - 4.5 < across < high + 4.5
            if road.stands or not inside:
                yaw = 0.0 if direction > 0 else np.pi
                turning = inside and rng.random() < 0.35
                yaw += float(rng.uniform(-0.9, 0.9) if turning else rng.normal(0, 0.05))
                key = float(rng.exponential(1.0)) / max(_weight(road, across, s) * 5.0, 1e-9)
                found.append(_Spot(across, s, yaw, None, key))
            across += float(rng.uniform(5.5, 11))
    return found


def _vehicle(rng: np.random.Generator, settings: LayoutSettings, parked: bool, heavy: bool) -> tuple[str, int]:
    """A body style and a variant."""
    first, count = settings.variants
    draw = rng.random()
    heavy_share = 0.0 if parked or not heavy else 0.055
    if draw < heavy_share:
        kind = "truck" if rng.random() < 0.6 else "bus"
    elif draw < heavy_share + 0.09:
        kind = "van"
    else:
        kind = _CAR_KINDS[int(rng.choice(len(_CAR_KINDS), p=_CAR_SHARE))]
    return kind, first + int(rng.integers(count))


def _size(rng: np.random.Generator, kind: str, variant: int) -> tuple[float, float, float]:
    """Length, height, width (m) of one vehicle, spread as KITTI's labels are."""
    from scene_ir.meshes.templates import typical_size_lhw

    label = LABEL_OF_KIND[kind]
    stretch = np.clip(rng.normal(0.0, 1.0, 3), -2.0, 2.0) * _SIZE_SPREAD_LHW[label] + 1.0
    length, height, width = typical_size_lhw(kind, variant) * np.asarray(_SIZE_FACTOR_LHW[label]) * stretch
    return float(length), float(height), float(width)


def _paint(rng: np.random.Generator, kind: str) -> tuple[float, float, float]:
    """A paint's linear albedo."""
    paint = _PAINTS[int(rng.choice(len(_PAINTS), p=_PAINT_SHARE / _PAINT_SHARE.sum()))]
    if kind in ("van", "truck", "bus") and rng.random() < 0.5:
        paint = _PAINTS[0]
    paint = np.clip(paint * rng.uniform(0.8, 1.15) * rng.uniform(0.93, 1.07, 3), 0.01, 0.85)
    return float(paint[0]), float(paint[1]), float(paint[2])


@dataclass(frozen=True, slots=True)
class _Sight:
    """A vehicle as an upright rectangle in KITTI's image. distance_m orders vehicles; left to bottom: px."""

    distance_m: float
    left: float
    top: float
    right: float
    bottom: float


def _sight(actor: Actor) -> _Sight | None:
    """How KITTI's camera sees a vehicle with nothing before it; None where it is too small or out of sight."""
    fitted = statistics()
    camera, height_m = fitted.cameras[0], fitted.camera_height_m
    width, height = camera.size_wh_px
    f, (cx, cy) = camera.focal_px, camera.centre_px
    outline = _before_camera(footprint(actor.position_xz, actor.yaw, actor.size_lhw))
    if len(outline) == 0:
        return None
    u = cx + f * (outline[:, 0] + camera.offset_px_m[0] / f) / outline[:, 1]
    left, right = max(float(u.min()), 0.0), min(float(u.max()), float(width - 1))
    near, far = float(outline[:, 1].min()), float(outline[:, 1].max())
    above = height_m - actor.size_lhw[1]
    top = max(cy + f * above / (far if above > 0 else near), 0.0)
    bottom = min(cy + f * height_m / near, float(height - 1))
    if right - left < _LEAST_WIDTH_PX or bottom - top < _LEAST_HEIGHT_PX:
        return None
    return _Sight(float(np.hypot(*actor.position_xz)), left, top, right, bottom)


def _shares(sights: list[_Sight]) -> np.ndarray:
    """Roughly how much (N,) of each rectangle those nearer leave free. All stand on the ground, so that what is
    free of a farther one lies above the highest roof before it.
    """
    width, height = statistics().cameras[0].size_wh_px
    roofs = np.full(width // _COLUMN_PX + 1, float(height))
    shares = np.zeros(len(sights))
    for index in sorted(range(len(sights)), key=lambda i: sights[i].distance_m):
        one = sights[index]
        before = roofs[int(one.left) // _COLUMN_PX : int(one.right) // _COLUMN_PX + 1]
        free = np.clip(before, one.top, one.bottom).mean() - one.top
        shares[index] = free / (one.bottom - one.top)
        np.minimum(before, one.top, out=before)
    return shares


def _before_camera(outline: np.ndarray) -> np.ndarray:
    """The part (K, 2) of a convex outline (4, 2) in front of the camera."""
    if (outline[:, 1] >= _NEAR_PLANE_M).all():
        return outline
    corners = []
    for one, two in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if one[1] >= _NEAR_PLANE_M:
            corners.append(one)
        if (one[1] >= _NEAR_PLANE_M) != (two[1] >= _NEAR_PLANE_M):
            corners.append(one + (two - one) * (_NEAR_PLANE_M - one[1]) / (two[1] - one[1]))
    return np.array(corners).reshape(-1, 2)


def place_vehicles(rng: np.random.Generator, road: Road, settings: LayoutSettings) -> list[Actor]:
    """Vehicles on the road without interpenetration: as many as are needed for as many to be seen as KITTI's
    labels have, at most MOST_VEHICLES.
    """
    if settings.vehicles is None:
        wanted = int(np.searchsorted(np.cumsum(statistics().vehicles_per_frame), road.busy, side="right"))
        wanted = min(wanted, len(statistics().vehicles_per_frame) - 1)
    else:
        wanted = int(rng.integers(settings.vehicles[0], settings.vehicles[1] + 1))
    actors: list[Actor] = []
    sights: list[_Sight] = []
    visible_shares = np.zeros(0)
    outlines = [footprint(*_EGO)]
    heavy = 0
    queue = [(spot, False) for spot in _candidates(road, rng)]
    for spot, patient in queue:
        if len(actors) >= MOST_VEHICLES or (visible_shares >= _LEAST_VISIBLE).sum() >= wanted:
            break
        actor = _settle(rng, road, settings, spot, heavy < settings.max_heavy)
        outline = footprint(actor.position_xz, actor.yaw, actor.size_lhw)
        sight = _sight(actor)
        if sight is None or any(_nearer(outline, o, MARGIN_M) for o in outlines):
            continue
        after = _shares([*sights, sight])
        hidden = (after < _HARDLY_SEEN).any() and rng.random() < _HARDLY_SEEN_DEFERRED
        apart = (
            after[-1] > _PLAINLY_SEEN
            and (after[:-1] > visible_shares - 0.08).all()
            and actor.position_xz[1] > _ALWAYS_M
        )
        if not patient and (hidden or (bool(actors) and apart and rng.random() < _APART_DEFERRED)):
            queue.append((spot, True))
            continue
        actors.append(actor)
        sights.append(sight)
        outlines.append(outline)
        visible_shares = after
        heavy += actor.kind in ("truck", "bus")
    return actors


def _nearer(one: np.ndarray, two: np.ndarray, gap_m: float) -> bool:
    """Whether two outlines are closer than `gap_m`."""
    apart = np.hypot(*(one.mean(axis=0) - two.mean(axis=0)))
    reach = np.hypot(*(one[0] - one[2])) + np.hypot(*(two[0] - two[2]))
    return bool(apart < reach / 2 + gap_m and clearance(one, two) < gap_m)


def _settle(rng: np.random.Generator, road: Road, settings: LayoutSettings, spot: _Spot, heavy: bool) -> Actor:
    """A random vehicle at a place. heavy: whether it may be a truck or a bus."""
    lane = spot.lane
    parked = lane is not None and lane.parked
    wide = lane is None or lane.slack_m > 1.25
    kind, variant = _vehicle(rng, settings, parked, heavy and wide)
    size = _size(rng, kind, variant)
    fleet = [m for m in settings.fleet if LABEL_OF_KIND[m.kind] == LABEL_OF_KIND[kind]]
    mesh = fleet[int(rng.integers(len(fleet)))] if fleet else None
    if mesh is not None:
        kind, stretch = mesh.kind, np.clip(rng.normal(1.0, 0.015, 3), 0.97, 1.03)
        length, height, width = (np.asarray(mesh.size_lhw) * stretch).tolist()
        size = length, height, width
    d, yaw = spot.d, spot.yaw
    turn = float(rng.normal(0, statistics().yaw_spread_rad))
    if lane is not None and not lane.parked:
        # The next lane must stay free: long vehicles drive straighter.
        slack = max(lane.slack_m - size[2] / 2, 0.0)
        d += float(np.clip(rng.normal(0, 0.25), -slack, slack))
        turn *= min(1.0, 3.0 / size[0])
    yaw += turn
    x, z = (float(v) for v in road.point(d, spot.s))
    return Actor(
        kind,
        variant,
        (x, z),
        float((yaw + np.pi) % (2 * np.pi) - np.pi),
        size,
        _paint(rng, kind),
        parked,
        int(rng.integers(2**31)),
        lane_ds=None if lane is None else (d, spot.s),
        speed_mps=0.0 if lane is None else lane.speed_mps,
        mesh=mesh,
    )


_CHILD_SHARE, _CHILD_M = 0.15, (1.05, 1.5)
"""Share of children among varied pedestrians, and their height, m."""
_TOGETHER_SHARE, _TOGETHER_M = 0.4, 0.9
"""Share of varied pedestrians who walk next to the one before, and how far apart they are, m."""


_PRAM_SHARE = 0.12
"""Share of varied grown pedestrians who push a pram."""


def place_people(rng: np.random.Generator, road: Road, vehicles: list[Actor], varied: bool = False) -> list[Actor]:
    """Pedestrians on pavements (some crossing the road) and cyclists near the road's edge, clear of vehicles.

    varied: children, people who walk side by side and people with prams too, in the clothes and with the bags of
    `people.pedestrian`, and riders of motorcycles.
    """
    wanted = ["pedestrian"] * int(rng.choice([0, 1, 2, 3, 5, 8], p=[0.45, 0.2, 0.15, 0.1, 0.06, 0.04]))
    wanted += ["cyclist"] * int(rng.choice([0, 1, 2, 3], p=[0.62, 0.24, 0.1, 0.04]))
    if road.kind == "motorway":
        wanted = []
    outlines = [footprint(a.position_xz, a.yaw, a.size_lhw) for a in vehicles]
    outlines.append(footprint(*_EGO))
    left, right = (
        min(s.d0 for s in road.strips if s.material == Material.ROAD),
        max(s.d1 for s in road.strips if s.material == Material.ROAD),
    )
    actors = []
    for kind in wanted:
        for _ in range(6):
            s = float(np.exp(rng.uniform(np.log(5.0), np.log(45.0))))
            if kind == "pedestrian" and road.pavements and rng.random() < 0.85:
                d = float(rng.uniform(*road.pavements[int(rng.integers(len(road.pavements)))]))
                yaw = road.yaw(s, 1 if rng.random() < 0.5 else -1) + float(rng.normal(0, 0.5))
            elif kind == "pedestrian":
                d = float(rng.uniform(left - 1.5, right + 1.5))
                yaw = float(rng.uniform(-np.pi, np.pi))
            else:
                side = 1 if rng.random() < 0.6 else -1
                d = (right - 0.6) if side > 0 else (left + 0.6)
                d += float(rng.normal(0, 0.4))
                yaw = road.yaw(s, side) + float(rng.normal(0, 0.15))
            height = float(rng.normal(1.75, 0.09))
            variant, length = int(varied), 0.85 if kind == "pedestrian" else 1.77
            if varied and kind == "pedestrian" and rng.random() < _CHILD_SHARE:
                height = float(rng.uniform(*_CHILD_M))
            elif varied and kind == "pedestrian" and rng.random() < _PRAM_SHARE:
                variant, length = PUSHES_PRAM, PRAM_LENGTH_M * height / 1.75
            size = (length, height, 0.65 if kind == "pedestrian" else 0.6)
            x, z = (float(v) for v in road.point(d, s))
            if varied and kind == "pedestrian" and actors and rng.random() < _TOGETHER_SHARE:
                (x, z), yaw = actors[-1].position_xz, actors[-1].yaw
                x, z = x + _TOGETHER_M * float(np.sin(yaw)), z + _TOGETHER_M * float(np.cos(yaw))
            outline = footprint((x, z), yaw, size)
            if abs(x) < 0.85 * z and all(clearance(outline, o) > 0.2 for o in outlines):
                outlines.append(outline)
                yaw = float((yaw + np.pi) % (2 * np.pi) - np.pi)
                seed = int(rng.integers(2**31))
                actors.append(Actor(kind, variant, (x, z), yaw, size, (0.0, 0.0, 0.0), False, seed))
                break
    return actors
