"""Where the road runs and what stands on it: roads, lanes, and vehicles placed as KITTI's labels distribute them.

World axes: x right, y down, z forward, ground at y = 0, camera above the origin. A road carries its own
coordinates: d metres to the right of the ego lane's middle, s metres along.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.resources import files

import numpy as np

from drivesem.synth.soup import Material

ROAD_KINDS = ("residential", "city", "arterial", "motorway", "country", "junction")
_ROAD_SHARE = (0.30, 0.24, 0.13, 0.08, 0.12, 0.13)
"""KITTI's drives: mostly residential and city streets of Karlsruhe, some rural roads and motorways."""
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
    candidates.
    """

    middle_m: float
    direction: int
    parked: bool = False
    weight: float = 1.0
    spacing_m: float = 8.0


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
    which on buildings and plants may stand.
    """

    kind: str
    curvature: float
    lanes: tuple[Lane, ...]
    strips: tuple[Strip, ...]
    markings: tuple[Marking, ...]
    flank_m: tuple[float, float]
    pavements: tuple[tuple[float, float], ...]
    crossing: tuple[float, float] | None = None

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


@dataclass(frozen=True, slots=True)
class Actor:
    """A vehicle or person. position_xz, yaw: world; size_lhw m; paint: linear albedo; seed: of its own details.
    lane_ds: road coordinates (d, s) m where it follows the road, speed_mps: along s, below 0 against it.
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

    @property
    def label(self) -> str:
        """KITTI's name of the type."""
        return LABEL_OF_KIND[self.kind]


@dataclass(frozen=True, slots=True)
class LayoutSettings:
    """variants: (first, count) of the vehicle shapes to draw from. people: whether pedestrians and cyclists
    appear. vehicles: (fewest, most) a frame, or None for KITTI's distribution. max_heavy: most trucks and buses.
    """

    variants: tuple[int, int] = (0, 100)
    people: bool = True
    vehicles: tuple[int, int] | None = None
    max_heavy: int = 3
    kinds: tuple[str, ...] = field(default=ROAD_KINDS)


def plan_road(rng: np.random.Generator, kinds: tuple[str, ...] = ROAD_KINDS) -> Road:
    """A random road of one of `kinds`."""
    share = np.array([_ROAD_SHARE[ROAD_KINDS.index(k)] for k in kinds])
    kind = kinds[int(rng.choice(len(kinds), p=share / share.sum()))]
    if kind in ("residential", "city"):
        return _street(rng, kind, None)
    if kind == "junction":
        start = float(rng.uniform(13, 32))
        return _street(rng, kind, (start, start + float(rng.uniform(8, 15))))
    return _open_road(rng, kind)


def _street(rng: np.random.Generator, kind: str, crossing: tuple[float, float] | None) -> Road:
    """Two lanes between parked rows and pavements."""
    lane = float(rng.uniform(2.7, 3.4) if kind == "residential" else rng.uniform(3.0, 3.6))
    extra = int(kind == "junction" and rng.random() < 0.5)
    left, right = -1.5 * lane, (0.5 + extra) * lane
    lanes = [Lane(0.0, 1, weight=1.2), Lane(-lane, -1, weight=1.2)]
    if extra:
        lanes.append(Lane(lane, 1, weight=1.5))
    busy = kind == "residential"
    strips = [Strip(left, right, Material.ROAD)]
    edges, pavements = [], []
    for side, edge in ((-1, left), (1, right)):
        parked = rng.random() < (0.85 if kind != "junction" else 0.4)
        nose_in = parked and rng.random() < 0.15
        width = float(rng.uniform(4.6, 5.2) if nose_in else rng.uniform(1.95, 2.3)) if parked else 0.0
        if parked:
            material = Material.PARKING if rng.random() < 0.6 else Material.ROAD
            strips.append(_strip(edge, edge + side * width, material))
            direction = 0 if nose_in else side if rng.random() < 0.85 or side < 0 else -side
            spacing = 2.75 if nose_in else 5.6
            lanes.append(Lane(edge + side * width / 2, direction, True, 1.9 if busy else 1.5, spacing))
        outer = edge + side * width
        walk = outer + side * float(rng.uniform(1.5, 2.6) if busy else rng.uniform(2.0, 4.5))
        height = float(rng.uniform(0.08, 0.14))
        strips.append(_strip(outer, outer + side * 0.14, Material.KERB, height))
        strips.append(_strip(outer + side * 0.14, walk, Material.PAVEMENT, height))
        pavements.append(tuple(sorted((outer + side * 0.4, walk - side * 0.3))))
        garden = Material.GRASS if busy or rng.random() < 0.4 else Material.PAVEMENT
        strips.append(_strip(walk, walk + side * 60, garden, height))
        edges.append(walk)
    markings = []
    middle = -lane / 2
    if not busy or rng.random() < 0.2:
        dash = 3.0 if rng.random() < 0.8 else 6.0
        markings.append(Marking(middle, 0.12, dash, dash * float(rng.choice([1.0, 2.0, 3.0]))))
    if extra:
        markings.append(Marking(lane / 2, 0.12, 3.0, 6.0))
    if not busy and rng.random() < 0.5:
        markings += [Marking(left + 0.1, 0.12, 1.0, 1.0), Marking(right - 0.1, 0.12, 1.0, 1.0)]
    curvature = 0.0 if crossing else float(rng.choice([0.0, 0.0, 0.0, 1.0]) * rng.normal(0, 0.0025))
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


def _open_road(rng: np.random.Generator, kind: str) -> Road:
    """Roads without parked cars: arterial, motorway, country."""
    lane = float(rng.uniform(3.3, 3.75))
    own = {"arterial": 2, "motorway": int(rng.integers(2, 4)), "country": 1}[kind]
    ego = int(rng.integers(own))
    right = (own - ego - 0.5) * lane
    median = {"arterial": float(rng.uniform(1.5, 7.0)), "motorway": float(rng.uniform(2.5, 4.0)), "country": 0.0}[
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
    bend = 0.0035 if kind == "country" else 0.0012
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


def _candidates(road: Road, rng: np.random.Generator) -> list[tuple[float, float, Lane, float]]:
    """(d, s, lane, weight) of places a vehicle may take."""
    fitted = statistics()
    found = []
    for lane in road.lanes:
        s = float(rng.uniform(2.0, 2.0 + lane.spacing_m)) if lane.parked else float(rng.uniform(5, 14))
        while s < 85:
            keep_off = road.crossing and road.crossing[0] - 5 < s < road.crossing[1] + 5
            if not (lane.parked and keep_off):
                d = lane.middle_m + float(rng.normal(0, 0.08 if lane.parked else 0.25))
                x, z = road.point(d, s)
                weight = _interpolated_share(float(z), fitted.depth_edges_m, fitted.depth_share)
                weight *= np.sqrt(_interpolated_share(float(x), fitted.lateral_edges_m, fitted.lateral_share))
                found.append((d, s, lane, float(weight) * lane.weight * lane.spacing_m))
            s += lane.spacing_m * float(rng.lognormal(0.06, 0.12 if lane.parked else 0.45))
    if road.crossing:
        c0, c1 = road.crossing
        for s, direction in ((c0 * 0.3 + c1 * 0.7, 1), (c0 * 0.72 + c1 * 0.28, -1)):
            across = float(rng.uniform(-22, -18))
            while across < 22:
                weight = _interpolated_share(s, fitted.depth_edges_m, fitted.depth_share) * 6.0
                found.append((across, s, Lane(across, 2 * direction), weight))
                across += float(rng.uniform(7, 16))
    return found


def _vehicle(rng: np.random.Generator, settings: LayoutSettings, parked: bool, heavy: bool) -> tuple[str, int]:
    """A body style and a variant."""
    first, count = settings.variants
    draw = rng.random()
    heavy_share = 0.0 if parked or not heavy else 0.11
    if draw < heavy_share:
        kind = "truck" if rng.random() < 0.6 else "bus"
    elif draw < heavy_share + 0.11:
        kind = "van"
    else:
        kind = _CAR_KINDS[int(rng.choice(len(_CAR_KINDS), p=_CAR_SHARE))]
    return kind, first + int(rng.integers(count))


def place_vehicles(rng: np.random.Generator, road: Road, settings: LayoutSettings) -> list[Actor]:
    """Vehicles on the road's lanes without interpenetration, nearer depths as often as in KITTI's labels."""
    from scene_ir.meshes.templates import typical_size_lhw

    fitted = statistics()
    if settings.vehicles is None:
        share = fitted.vehicles_per_frame.copy()
        share[0] *= 0.3
        wanted = int(rng.choice(len(share), p=share / share.sum())) + int(rng.integers(0, 5))
    else:
        wanted = int(rng.integers(settings.vehicles[0], settings.vehicles[1] + 1))
    candidates = _candidates(road, rng)
    weights = np.array([c[3] for c in candidates])
    if not candidates or weights.sum() <= 0:
        return []
    keys = rng.exponential(1.0, len(candidates)) / np.maximum(weights, 1e-9)
    actors: list[Actor] = []
    outlines = [footprint((0.0, 1.5), -np.pi / 2, (7.0, 2.0, 2.2))]
    heavy = 0
    for index in np.argsort(keys, kind="stable"):
        if len(actors) >= wanted:
            break
        d, s, lane, _ = candidates[index]
        kind, variant = _vehicle(rng, settings, lane.parked, heavy < settings.max_heavy)
        usual, stretch = typical_size_lhw(kind, variant), rng.normal(1.0, (0.025, 0.02, 0.015)).tolist()
        size = (usual[0] * stretch[0], usual[1] * stretch[1], usual[2] * stretch[2])
        if abs(lane.direction) == 2:
            yaw = 0.0 if lane.direction > 0 else np.pi
            yaw += float(rng.normal(0, 0.05) if rng.random() < 0.7 else rng.uniform(-0.9, 0.9))
        elif lane.direction == 0:
            facing = np.sign(d) if rng.random() < 0.7 else -np.sign(d)
            yaw = road.yaw(s, 0) + (0.0 if facing > 0 else np.pi) + float(rng.normal(0, 0.05))
        else:
            flipped = lane.parked and rng.random() < 0.12
            yaw = road.yaw(s, -lane.direction if flipped else lane.direction)
            yaw += float(rng.normal(0, fitted.yaw_spread_rad))
        x, z = (float(v) for v in road.point(d, s))
        outline = footprint((x, z), yaw, size)
        in_view = abs(x) < 0.95 * z + 3.0 and z > 1.5
        if not in_view or any(clearance(outline, o) < MARGIN_M for o in outlines):
            continue
        paint = _PAINTS[int(rng.choice(len(_PAINTS), p=_PAINT_SHARE / _PAINT_SHARE.sum()))]
        if kind in ("van", "truck", "bus") and rng.random() < 0.5:
            paint = _PAINTS[0]
        paint = np.clip(paint * rng.uniform(0.8, 1.15) * rng.uniform(0.93, 1.07, 3), 0.01, 0.85)
        yaw = float((yaw + np.pi) % (2 * np.pi) - np.pi)
        actors.append(
            Actor(
                kind,
                variant,
                (x, z),
                yaw,
                size,
                (float(paint[0]), float(paint[1]), float(paint[2])),
                lane.parked,
                int(rng.integers(2**31)),
            )
        )
        outlines.append(outline)
        heavy += kind in ("truck", "bus")
    return actors


def place_people(rng: np.random.Generator, road: Road, vehicles: list[Actor]) -> list[Actor]:
    """Pedestrians on pavements (some crossing the road) and cyclists near the road's edge, clear of vehicles."""
    wanted = ["pedestrian"] * int(rng.choice([0, 1, 2, 3, 5, 8], p=[0.45, 0.2, 0.15, 0.1, 0.06, 0.04]))
    wanted += ["cyclist"] * int(rng.choice([0, 1, 2, 3], p=[0.62, 0.24, 0.1, 0.04]))
    if road.kind == "motorway":
        wanted = []
    outlines = [footprint(a.position_xz, a.yaw, a.size_lhw) for a in vehicles]
    outlines.append(footprint((0.0, 1.5), -np.pi / 2, (7.0, 2.0, 2.2)))
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
            size = (0.85 if kind == "pedestrian" else 1.77, height, 0.65 if kind == "pedestrian" else 0.6)
            x, z = (float(v) for v in road.point(d, s))
            outline = footprint((x, z), yaw, size)
            if abs(x) < 0.85 * z and all(clearance(outline, o) > 0.2 for o in outlines):
                outlines.append(outline)
                yaw = float((yaw + np.pi) % (2 * np.pi) - np.pi)
                actors.append(Actor(kind, 0, (x, z), yaw, size, (0.0, 0.0, 0.0), False, int(rng.integers(2**31))))
                break
    return actors
