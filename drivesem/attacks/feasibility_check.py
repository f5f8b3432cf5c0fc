"""Independent check that one saved scene is a feasible change of another.

It shares no code with `drivesem.attacks.feasible`: it sees scenes instead of theta, and measures them in other ways
(polygon clipping, finite differences, all vertices of the meshes, rays cast at them by Open3D). Its tolerances are
wider by as much as the two measurements may differ.

Open3D needs libusb and loads slowly: it is imported for the first check. Without it, convex outlines replace the
meshes; `available_check_method` returns the method in use.
"""

from __future__ import annotations

import functools
import importlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from scene_ir.types import SceneIR, convert_scene

Array = NDArray[np.float64]
CheckMethod = Literal["open3d", "outlines"]
"""How visibility and contact of cars are measured: by rays at the meshes, or by their convex outlines."""

STRAIN = (0.7, 1.4)
"""Minimum and maximum singular value of a mesh's deformation."""
STRAIN_TOLERANCE = 0.02
HEIGHT_TOLERANCE_M = 0.01
"""Tolerance of heights above the ground plane, and of the mesh below its wheels."""
LIMIT_TOLERANCE = 1e-4
"""Tolerance of distances from the photograph, in their own units: rounding of float32 poses only."""
OVERLAP_TOLERANCE_M2 = 0.02
OUTLINE_TOLERANCE_M2 = 0.15
"""Tolerance of the overlap of mesh outlines. Their corners are rounder than those of the rectangles that the
projection separates: over 301 pairs that overlapped from the start, with unchanged overlap of the rectangles, it grew
by up to 0.12 m2."""
SYMMETRY_TOLERANCE = 1e-5
"""Tolerance of lattice offsets, in unit boxes: float32's rounding only."""
ROAD_LOSS = 0.1
ROAD_TOLERANCE = 0.05
PARKED_ON_ROAD = 0.6
"""Minimum share of an added car's footprint on the road."""
MIN_HEIGHT_SHARE = 0.6
IN_FRAME = 0.5
VISIBLE_TOLERANCE = 0.05
MIN_VISIBLE_SHARE = 0.3
"""Minimum visible share of its outline for a car to count as visible in `base`. Cars that are hidden more, which KITTI
calls largely occluded and does not evaluate, may be wholly hidden for the attack, which treats cars as boxes."""
RAYS = (48, 64)
"""Maximum number of rays through a car's image box, down and across; at most one a pixel."""
COLUMNS = 64
"""Vertical lines each way over the ground that two cars may share."""
MAX_CUT = 0.1
"""Maximum truncation of a car that counts as wholly in the picture."""
MINIMUM_PX = 8.0
MINIMUM_TOLERANCE_PX = 1.0
WEATHER_TOLERANCE = 0.01
"""Tolerance of weather codes and their limits."""
PEDESTRIAN = 2
PEOPLE = (PEDESTRIAN, 3)
"""Categories of people and cyclists."""
PEOPLE_TURN, PEOPLE_GROWTH, PEOPLE_COLOR = math.radians(5), 0.05, np.array([0.5, 0.5, 0.5, 0.0, 0.0])
"""rad, share of their size, and codes of their clothes, by which people may change; they do not bend, and have no
lamps. Codes after the fifth are those below the waist, of pedestrians alone."""
LOWER_COLOR = 0.5
LEVEL_SHARE = 0.18
"""Difference of the background's depth from the ground plane's, as a share, up to which a person can stand there."""
_NIGHT, _SNOW = 4, 5
"""Indices of the codes of night and snow."""
RAIN_UNDER_CLEAR_SKY = 0.5
"""Maximum code of rain under a sky as bright as photographed: a shower."""
DAYLIGHT_LX, TWILIGHT_LX = 15_000.0, 3.4
"""Illuminance in the shade at noon, and at the end of civil twilight (RCA Electro-Optics Handbook, 1974)."""
EXTINCTION_PER_M = (0.03, 0.006, 0.0075)
"""Extinction of the codes fog 1, rain 1 and snow 1."""
DIMMING = 0.8
"""Exponent of the dimming of display values at time 1."""
AIRLIGHT = 0.82
"""Display value of the air in pictures without sky: a bright haze."""
MIN_CONTRAST = 0.05
"""Contrast at which an object is just visible (CIE S 017, 17-31-019); also the light that a screen adds, as a share of
white."""
CONTRAST_TOLERANCE = 2.5
"""Factor on MIN_CONTRAST: the check uses all of a car's box in the photograph, which includes other pixels."""
MIN_JUDGED_PX = 25.0
"""Minimum height of a box for the check of visibility; KITTI evaluates no lower ones."""


@dataclass(frozen=True, slots=True)
class ChangeLimits:
    """Limits of the change, by default those of the paper's budget."""

    translate: float = 0.25
    """Own lengths, along and across; with `roi`, shares of the label's box in the picture, and log depth."""
    translate_m: float = math.inf
    """m, along and across."""
    rotate: float = 0.35
    """rad."""
    mesh: float = 0.25
    """Unit boxes, of a lattice offset."""
    color: float = 1.0
    """Code, absolute."""
    weather: float = 1.0
    """Code."""
    foliage: float = 1.0
    """Code, absolute."""
    across_m: float = math.inf
    """m, across only."""
    distance_share: float = math.inf
    """Share of the distance from the camera."""
    partly_visible: float = math.inf
    """Own lengths, of a car that is partly hidden or truncated."""
    size: float = 0.0
    """Share of the size, of a car that is neither hidden nor truncated."""
    sun: float = 0.0
    """Code, absolute."""
    night: float = 0.0
    """Code of night."""
    snow: float = 0.0
    """Code of snow."""
    lamps: float = 0.0
    """Code, absolute."""
    walk_m: float = 0.0
    """m, along and across, of people and cyclists in place of `translate` and `across_m`; 0: as for cars."""
    roi: bool = False
    """Whether `translate` uses the parametrisation of 3D-SDN."""


PAPER_LIMITS = ChangeLimits()


def check_limits(base: SceneIR, perturbed: SceneIR, limits: ChangeLimits) -> list[str]:
    """Check only the limits of a change.

    Args:
        base: the photographed scene.
        perturbed: the same objects, changed.
        limits: the limits.

    Returns:
        A line for each violation, such as `objects[3]: turned by 0.100 rad`.
    """
    violations = _code_violations(base, perturbed, limits)
    for i in range(len(base.objects)):
        poses = _MeasuredPose(base, i), _MeasuredPose(perturbed, i)
        moves = _region_violations(base, i, *poses, limits) if limits.roi else _move_violations(*poses, limits)
        violations += [f"objects[{i}]: {line}" for line in moves + _shape_violations(*poses, limits)]
    return violations


def available_check_method() -> CheckMethod:
    """`open3d` where it can be imported, which takes a second or two; otherwise `outlines`."""
    return "outlines" if _open3d() is None else "open3d"


def check_scene(
    base: SceneIR,
    perturbed: SceneIR,
    method: CheckMethod | None = None,
    joint_weather: bool = True,
    limits: ChangeLimits = PAPER_LIMITS,
) -> list[str]:
    """Check that a scene is a feasible change of another; nothing counts that was as bad in `base`.

    Args:
        base: the photographed scene.
        perturbed: the changed scene.
        method: None: that of `available_check_method`, which also replaces a missing Open3D.
        joint_weather: whether to check combinations of weather codes, and which cars they hide.
        limits: limits of the change.

    Returns:
        A line for each violation, such as `objects[3]: collision with objects[1], 0.52 m2 (0.00 before)`.
    """
    visibility = _visibility_check(method)
    base, perturbed = (convert_scene(scene, None, "cpu") for scene in (base, perturbed))
    if len(base.objects) != len(perturbed.objects):
        return [f"objects: {len(base.objects)} before, {len(perturbed.objects)} after"]
    violations = _fixed_field_violations(base, perturbed) + check_limits(base, perturbed, limits)
    before, after = ([_MeasuredCar(scene, i) for i in range(len(base.objects))] for scene in (base, perturbed))
    road = base.environment.road.numpy().astype(np.float64)
    for i, (old, new) in enumerate(zip(before, after, strict=True)):
        lines = _height_violations(base, old, new) + _mesh_violations(old, new)
        lines += _road_violations(base, road, old, new) + _frame_violations(base, old, new)
        violations += [f"objects[{i}]: {line}" for line in lines]
    violations += _collisions(dict(enumerate(before)), dict(enumerate(after)), visibility)
    violations += _hidden_cars(base, before, after, visibility)
    violations += check_exchange(perturbed, method)
    if joint_weather:
        violations += _weather_violations(base, perturbed) + _faint_cars(base, perturbed, after)
    return violations


def check_exchange(scene: SceneIR, method: CheckMethod | None = None) -> list[str]:
    """Check vehicles that were exchanged, added or removed, before any other change.

    Present vehicles must stand on the road, or as far on it as those before, touch no other car, and hide none that
    was visible. Returns lines like those of `check_scene`.
    """
    if scene.before is None:
        return []
    visibility = _visibility_check(method)
    base, rest = (convert_scene(state.unperturbed(), None, "cpu") for state in (scene.before, scene))
    rows = range(len(rest.objects))
    before, after = ([_MeasuredCar(state, i) for i in rows] for state in (base, rest))
    road = base.environment.road.numpy().astype(np.float64)
    present = [i for i in rows if after[i].near > 0]
    violations = []
    for i in present:
        lines = _road_violations(base, road, before[i], after[i], steps_onto_road=True)
        if before[i].near < 0:
            share = _road_share(base, road, after[i]) or 0.0
            lines = [] if share >= PARKED_ON_ROAD else [f"off the road, {share:.2f} of its footprint on it"]
            lines += _height_violations(base, after[i], after[i])
        violations += [f"objects[{i}]: {line}" for line in lines]
    violations += _collisions({i: before[i] for i in present}, {i: after[i] for i in present}, visibility)
    remaining = [car if car.near > 0 else before[i] for i, car in enumerate(after)]
    violations += _hidden_cars(base, before, remaining, visibility)
    return [f"exchange: {line}" for line in violations]


def check_places(
    base: SceneIR, perturbed: SceneIR, rows: Iterable[int], limits: ChangeLimits | None = None
) -> list[str]:
    """Check that objects stay on the ground and the road, and apart from one another.

    With limits, also that they stay in the picture and on ground that it shows, and move no further. Always
    measured by outlines, so that results are equal on all machines and no library is loaded.

    Args:
        base: the photographed scene.
        perturbed: the changed scene.
        rows: the objects to check.
        limits: limits of moves; None: no such check.

    Returns:
        Lines like those of `check_scene`.
    """
    base, perturbed = (convert_scene(scene, None, "cpu") for scene in (base, perturbed))
    before = {i: _MeasuredCar(base, i) for i in rows}
    after = {i: _MeasuredCar(perturbed, i) for i in before}
    road = base.environment.road.numpy().astype(np.float64)
    violations = []
    for i, old in before.items():
        lines = _height_violations(base, old, after[i]) + _road_violations(base, road, old, after[i])
        lines += [] if limits is None else _place_violations(base, road, old, after[i], limits)
        violations += [f"objects[{i}]: {line}" for line in lines]
    return violations + _collisions(before, after, _OutlineCheck())


class _MeasuredPose:
    """Pose and lattice of one car, in float64 numpy; the rows of `axes` are the car's axes."""

    def __init__(self, scene: SceneIR, i: int) -> None:
        objects = scene.objects
        self.position = objects.translation[i].detach().double().numpy()
        self.yaw = float(objects.yaw[i])
        self.size = objects.size_lhw[i].detach().double().numpy()
        self.lattice = objects.ffd[i].detach().double().numpy().reshape(4, 4, 4, 3)
        self.person = int(objects.category[i]) in PEOPLE
        self.lower_color = LOWER_COLOR if int(objects.category[i]) == PEDESTRIAN else 0.0
        self.lamps = float(objects.lamps[i])
        self.colour = objects.texture_code[i].detach().double().numpy()
        self.whole = int(objects.occlusion[i]) == 0 and float(objects.truncation[i]) <= MAX_CUT
        forward = np.array([math.cos(self.yaw), 0.0, -math.sin(self.yaw)])
        sideways = np.array([math.sin(self.yaw), 0.0, math.cos(self.yaw)])
        self.axes = np.stack([forward, np.array([0.0, 1.0, 0.0]), sideways])


class _MeasuredCar(_MeasuredPose):
    """One car with its mesh, in float64 numpy."""

    def __init__(self, scene: SceneIR, i: int) -> None:
        super().__init__(scene, i)
        objects = scene.objects
        mesh = scene.meshes[int(objects.mesh_index[i])]
        self.unit, self.faces = mesh.vertices.detach().double().numpy(), mesh.faces.numpy()
        self.deformed = bend(self.unit, self.lattice)
        local = self.deformed * self.size
        self.low, self.high = local.min(axis=0), local.max(axis=0)
        self.vertices = local @ self.axes + self.position
        matrix = scene.camera.matrix.double().numpy()
        clip = self.vertices @ matrix[:, :3].T + matrix[:, 3]
        self.near, self.far = float(clip[:, 2].min()), float(clip[:, 2].max())
        front = clip[clip[:, 2] > 0.1]
        pixels = front[:, :2] / front[:, 2:] if len(front) else np.zeros((1, 2))
        self.box = (*pixels.min(axis=0).tolist(), *pixels.max(axis=0).tolist())
        self.pixels = pixels

    @property
    def footprint(self) -> Array:
        """Corners (4, 2) m, (x, z), of the rectangle around the deformed mesh, counter-clockwise in (x, z)."""
        a, b = self.low, self.high
        corners = np.array([[a[0], 0, a[2]], [b[0], 0, a[2]], [b[0], 0, b[2]], [a[0], 0, b[2]]])
        return _counter_clockwise((corners @ self.axes + self.position)[:, [0, 2]])

    @property
    def outline(self) -> Array:
        """Convex hull (K, 2) m, (x, z), of the deformed mesh seen from above, counter-clockwise in (x, z)."""
        hull = cv2.convexHull(self.vertices[:, [0, 2]].astype(np.float32))
        return _counter_clockwise(hull[:, 0].astype(np.float64))


def bend(unit: Array, lattice: Array) -> Array:
    """Vertices (V, 3) of the unit box, moved by a Bernstein lattice (4, 4, 4, 3): de Casteljau's algorithm by axis."""
    parameters = unit + np.array([0.5, 1.0, 0.5])
    points = np.broadcast_to(lattice, (len(unit), 4, 4, 4, 3))
    for axis in range(3):
        t = parameters[:, axis].reshape(-1, *([1] * (points.ndim - 2)))
        while points.shape[1] > 1:
            points = points[:, :-1] * (1 - t[:, None]) + points[:, 1:] * t[:, None]
        points = points[:, 0]
    return unit + points


def overlap_area(a: Array, b: Array) -> float:
    """Area m2 shared by two convex counter-clockwise polygons (K, 2): Sutherland-Hodgman clipping."""
    polygon = a
    for start, end in zip(b, np.roll(b, -1, axis=0), strict=True):
        if not len(polygon):
            return 0.0
        normal = np.array([start[1] - end[1], end[0] - start[0]])
        side = (polygon - start) @ normal
        clipped = []
        for k in range(len(polygon)):
            here, there = side[k - 1], side[k]
            if (here >= 0) != (there >= 0):
                clipped.append(polygon[k - 1] + (polygon[k] - polygon[k - 1]) * (here / (here - there)))
            if there >= 0:
                clipped.append(polygon[k])
        polygon = np.array(clipped).reshape(-1, 2)
    return abs(_polygon_area(polygon)) if len(polygon) else 0.0


def _counter_clockwise(polygon: Array) -> Array:
    return polygon if _polygon_area(polygon) > 0 else polygon[::-1]


def _polygon_area(polygon: Array) -> float:
    """Signed area m2 of (K, 2), positive counter-clockwise."""
    x, y = polygon.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def _fixed_field_violations(base: SceneIR, perturbed: SceneIR) -> list[str]:
    """Fields that no parameter may change."""
    pairs = {
        "objects.mesh_index": (base.objects.mesh_index, perturbed.objects.mesh_index),
        "photograph": (base.photograph, perturbed.photograph),
        "camera": (base.camera.matrix, perturbed.camera.matrix),
        "ground": (base.environment.ground, perturbed.environment.ground),
        "sun": (base.environment.sun, perturbed.environment.sun),
    }
    return [f"{name}: changed" for name, (a, b) in pairs.items() if a.shape != b.shape or not bool((a == b).all())]


def _code_violations(base: SceneIR, perturbed: SceneIR, limits: ChangeLimits) -> list[str]:
    (old, before), (new, after) = ((scene.objects, scene.environment) for scene in (base, perturbed))
    ranges = {
        "objects.texture_code": (old.texture_code, new.texture_code, -limits.color, limits.color),
        "objects.lamps": (old.lamps, new.lamps, -limits.lamps, limits.lamps),
        "environment.weather": (before.weather[:_NIGHT], after.weather[:_NIGHT], 0.0, limits.weather),
        "environment.night": (
            before.weather[_NIGHT:_SNOW],
            after.weather[_NIGHT:_SNOW],
            0.0,
            min(limits.weather, limits.night),
        ),
        "environment.snow": (before.weather[_SNOW:], after.weather[_SNOW:], 0.0, min(limits.weather, limits.snow)),
        "environment.foliage": (before.foliage, after.foliage, -limits.foliage, limits.foliage),
        "environment.light": (before.light, after.light, -limits.sun, limits.sun),
    }
    violations = []
    for name, (start, code, low, high) in ranges.items():
        # Codes outside of the range from the start, as after an edit, may stay there.
        if bool(((code < start.clamp(max=low) - 1e-6) | (code > start.clamp(min=high) + 1e-6)).any()):
            violations.append(f"{name}: outside [{low:g}, {high:g}]")
    return violations


def _weather_violations(base: SceneIR, perturbed: SceneIR) -> list[str]:
    """Combinations of weather codes that hardly ever occur, beyond those in `base`."""
    before, after = (_Sky(*scene.environment.weather.tolist()) for scene in (base, perturbed))
    violations = []
    if after.drops > max(1.0, before.drops) + WEATHER_TOLERANCE:
        violations.append(
            f"weather: fog {after.fog:.2f} is washed out by rain {after.rain:.2f} and snow {after.snow:.2f}"
        )
    if after.rain - after.overcast > max(RAIN_UNDER_CLEAR_SKY, before.rain - before.overcast) + WEATHER_TOLERANCE:
        violations.append(f"weather: rain {after.rain:.2f} out of a sky covered {after.overcast:.2f}")
    if after.light_lx < min(TWILIGHT_LX, before.light_lx) * (1 - 5 * WEATHER_TOLERANCE):
        violations.append(f"weather: {after.light_lx:.1f} lx, darker than at the end of civil twilight")
    if after.time + after.night > max(1.0, before.time + before.night) + WEATHER_TOLERANCE:
        violations.append(f"weather: dusk {after.time:.2f} at night {after.night:.2f}")
    return violations


@dataclass(frozen=True, slots=True)
class _Sky:
    """Weather codes."""

    fog: float
    rain: float
    time: float
    overcast: float
    night: float
    snow: float

    @property
    def drops(self) -> float:
        """Water in the air, as shares of what it holds of one kind."""
        return self.fog + self.rain + self.snow

    @property
    def light_lx(self) -> float:
        """Daylight on the road, before night. Overcast, fog, rain and snow each take nine tenths."""
        dusk = (TWILIGHT_LX / DAYLIGHT_LX) ** self.time
        return DAYLIGHT_LX * dusk * 0.1 ** (self.drops + self.overcast)

    def dimmed(self, tones: Array, air: float, away_m: float) -> Array:
        """Display values as they appear at a distance, where the air has the display value `air`. Night hides no car:
        its lamps are lit.
        """
        codes = (self.fog, self.rain, self.snow)
        clear = math.exp(-away_m * sum(rate * code for rate, code in zip(EXTINCTION_PER_M, codes, strict=True)))
        return (clear * tones + (1 - clear) * air) * math.exp(-DIMMING * self.time**2)


def _faint_cars(base: SceneIR, perturbed: SceneIR, cars: list[_MeasuredCar]) -> list[str]:
    """Cars of the photograph that haze and dusk make invisible: the pixels of their boxes in the photograph, with the
    haze of the present distance (Koschmieder's law) and dimming.
    """
    before, after = (_Sky(*scene.environment.weather.tolist()) for scene in (base, perturbed))
    photograph = base.photograph.double().numpy().mean(axis=0)
    sky = base.environment.sky.numpy() > 0.5
    air = float(photograph[sky].mean()) if sky.any() else AIRLIGHT
    violations = []
    for i, car in enumerate(cars):
        x0, y0, x1, y1 = (max(round(value), 0) for value in base.objects.box2d[i].tolist())
        tones = photograph[y0 : y1 + 1, x0 : x1 + 1]
        if y1 - y0 < MIN_JUDGED_PX or not tones.size:
            continue
        then, now = (_contrast(sky.dimmed(tones, air, float(car.position[2]))) for sky in (before, after))
        if then >= MIN_CONTRAST and now < MIN_CONTRAST / CONTRAST_TOLERANCE:
            violations.append(f"objects[{i}]: out of sight, contrast {now:.3f} ({then:.2f} before)")
    return violations


def _contrast(tones: Array) -> float:
    """Standard deviation of the light of display values, divided by its mean plus the light that a screen adds."""
    light = tones**2.2
    return float(light.std() / (light.mean() + MIN_CONTRAST))


def _height_violations(base: SceneIR, old: _MeasuredCar, new: _MeasuredCar) -> list[str]:
    plane = base.environment.ground.double().numpy()
    rise = float(plane[:3] @ (new.position - old.position)) / float(np.linalg.norm(plane[:3]))
    return [f"off the ground by {rise:.3f} m"] if abs(rise) > HEIGHT_TOLERANCE_M else []


def _region_violations(
    base: SceneIR, i: int, old: _MeasuredPose, new: _MeasuredPose, limits: ChangeLimits
) -> list[str]:
    """The move of the centre of a car's box beyond the limits, in sizes of its label in the picture and log depth."""
    matrix = base.camera.matrix.double().numpy()
    eye = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
    middles = np.stack([pose.position - [0.0, pose.size[1] / 2, 0.0] for pose in (old, new)])
    clip = middles @ matrix[:, :3].T + matrix[:, 3]
    pixels = clip[:, :2] / clip[:, 2:]
    x0, y0, x1, y1 = base.objects.box2d[i].tolist()
    shares = (pixels[1] - pixels[0]) / np.maximum([x1 - x0, y1 - y0], 1.0)
    depth = 2 * math.log(np.linalg.norm(middles[1] - eye) / np.linalg.norm(middles[0] - eye))
    if max(*np.abs(shares), abs(depth)) <= limits.translate + LIMIT_TOLERANCE:
        return []
    return [f"moved by {shares[0]:.3f}, {shares[1]:.3f} of its box and {depth:.3f} in log depth"]


def _move_violations(old: _MeasuredPose, new: _MeasuredPose, limits: ChangeLimits) -> list[str]:
    """The move of a car beyond the limits, along and across."""
    violations = []
    metres = old.axes @ (new.position - old.position)
    along, across = metres[0] / old.size[0], metres[2] / old.size[0]
    most_m = min(limits.translate_m, limits.distance_share * math.hypot(*old.position))
    across_m = min(most_m, limits.across_m)
    most = limits.translate
    if old.person and limits.walk_m:
        most_m = across_m = min(most_m, limits.walk_m)
        most = math.inf
    most = most if old.whole else min(most, limits.partly_visible)
    if max(abs(along), abs(across)) > most + LIMIT_TOLERANCE:
        violations.append(f"moved by {along:.3f}, {across:.3f} own lengths")
    elif abs(metres[0]) > most_m + LIMIT_TOLERANCE or abs(metres[2]) > across_m + LIMIT_TOLERANCE:
        violations.append(f"moved by {metres[0]:.3f}, {metres[2]:.3f} m")
    return violations


def _shape_violations(old: _MeasuredPose, new: _MeasuredPose, limits: ChangeLimits) -> list[str]:
    """Rotation, lattice offsets and size of a car beyond the limits."""
    violations = []
    turned = math.remainder(new.yaw - old.yaw, 2 * math.pi)
    if abs(turned) > (min(limits.rotate, PEOPLE_TURN) if old.person else limits.rotate) + LIMIT_TOLERANCE:
        violations.append(f"turned by {turned:.3f} rad")
    bent = float(np.abs(new.lattice - old.lattice).max())
    if bent > (0.0 if old.person else limits.mesh) + LIMIT_TOLERANCE:
        violations.append(f"lattice bent by {bent:.3f} unit boxes")
    grown = new.size / old.size - 1
    growth = min(limits.size, PEOPLE_GROWTH) if old.person else limits.size
    if np.abs(grown).max() > (growth + LIMIT_TOLERANCE if limits.size and old.whole else 0.0):
        violations.append(f"size changed by {100 * grown[np.abs(grown).argmax()]:.1f} %")
    elif np.ptp(grown) > LIMIT_TOLERANCE:
        violations.append("size changed, and not alike in length, height and width")
    if old.person and new.lamps != old.lamps:
        violations.append("lamps of a person")
    most = np.append(PEOPLE_COLOR if old.person else np.ones(5), np.full(3, old.lower_color))[: len(new.colour)]
    exceeds = np.abs(new.colour) > np.maximum(most, np.abs(old.colour)) + LIMIT_TOLERANCE
    if old.person and exceeds.any():
        violations.append(f"clothes recoloured by {np.abs(new.colour).max():.2f}")
    elif exceeds[5:].any():
        violations.append("recoloured below the waist, without one")
    return violations


def _strain(car: _MeasuredCar) -> tuple[float, float, float]:
    """Minimum and maximum singular value, and minimum determinant, over the unit box, by central differences."""
    steps = np.linspace(0.03, 0.97, 7)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3) - [0.5, 1.0, 0.5]
    h = 1e-4
    columns = []
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = h
        columns.append((bend(grid + shift, car.lattice) - bend(grid - shift, car.lattice)) / (2 * h))
    jacobian = np.stack(columns, axis=-1)
    values = np.linalg.svd(jacobian, compute_uv=False)
    return float(values.min()), float(values.max()), float(np.linalg.det(jacobian).min())


def _mesh_violations(old: _MeasuredCar, new: _MeasuredCar) -> list[str]:
    if np.array_equal(old.lattice, new.lattice):
        return []
    violations = []
    low0, high0, det0 = _strain(old)
    low, high, det = _strain(new)
    if low < min(STRAIN[0], low0) - STRAIN_TOLERANCE or high > max(STRAIN[1], high0) + STRAIN_TOLERANCE:
        violations.append(f"strain in [{low:.3f}, {high:.3f}]")
    if det <= min(0.0, det0):
        violations.append(f"mesh inverted, determinant {det:.3f}")
    change = new.lattice - old.lattice
    # Left and right are the lattice's last axis; a mirror flips sideways offsets.
    uneven = float(np.abs(change - change[:, :, ::-1] * [1.0, 1.0, -1.0]).max())
    if uneven > SYMMETRY_TOLERANCE:
        violations.append(f"mesh not symmetric, left and right {uneven:.4f} unit boxes apart")
    lowest = change[:, -1, :, 1]
    if np.abs(lowest).max() > 1e-6:
        violations.append(f"lowest lattice layer moved vertically by {np.abs(lowest).max():.4f} unit boxes")
    # y points down: the largest y is the lowest point.
    if new.high[1] > max(old.high[1], 0.0) + HEIGHT_TOLERANCE_M:
        violations.append(f"mesh {new.high[1]:.3f} m below its wheels")
    if new.high[1] < old.high[1] - HEIGHT_TOLERANCE_M:
        violations.append(f"mesh lifted off the ground by {old.high[1] - new.high[1]:.3f} m")
    return violations


def _road_violations(
    base: SceneIR, road: Array, old: _MeasuredCar, new: _MeasuredCar, steps_onto_road: bool = False
) -> list[str]:
    """Whether an object leaves the road, or a person the level ground off it; `steps_onto_road`: or either."""
    if old.person and (_road_share(base, road, old, at_feet=True) or 0.0) < 0.5:
        green = base.environment.foliage_map.numpy().astype(np.float64)
        on_grass = (_road_share(base, green, old, at_feet=True) or 0.0) >= 0.5
        sure = ((road - 0.5) / 0.3).clip(0, 1)
        level = _level_ground(base) * (1.0 if on_grass else 1 - green)
        road = np.maximum(level, road) if steps_onto_road else level * (1 - sure)
    before, after = (_road_share(base, road, car) for car in (old, new))
    if before is None or after is None or after >= before - ROAD_LOSS - ROAD_TOLERANCE:
        return []
    return [f"left the road, {after:.2f} of its footprint on it ({before:.2f} before)"]


def _level_ground(base: SceneIR) -> Array:
    """Pixels (H, W), 0 or 1, with a background as far away as the ground plane."""
    matrix, plane = base.camera.matrix.double().numpy(), base.environment.ground.double().numpy()
    inverse = np.linalg.inv(matrix[:, :3])
    y, x = np.mgrid[0 : base.camera.height, 0 : base.camera.width]
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ inverse.T
    with np.errstate(divide="ignore", invalid="ignore"):
        ground_m = (plane[:3] @ inverse @ matrix[:, 3] - plane[3]) / (rays @ plane[:3])
        return (np.abs(base.depth.double().numpy() / ground_m - 1) < LEVEL_SHARE).astype(np.float64)


def _road_share(base: SceneIR, road: Array, car: _MeasuredCar, at_feet: bool = False) -> float | None:
    """Mean of the road map over a fine grid on the footprint, or only at the label's place; None if most of it is
    outside of the picture.
    """
    a, b = (np.zeros(3), np.zeros(3)) if at_feet else (car.low, car.high)
    x, z = np.meshgrid(np.linspace(a[0], b[0], 33), np.linspace(a[2], b[2], 17), indexing="ij")
    local = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=-1)
    points = local @ car.axes + car.position
    matrix = base.camera.matrix.double().numpy()
    clip = points @ matrix[:, :3].T + matrix[:, 3]
    clip = clip[clip[:, 2] > 0.1]
    u, v = (clip[:, :2] / clip[:, 2:]).T
    inside = (u >= 0) & (u <= base.camera.width - 1) & (v >= 0) & (v <= base.camera.height - 1)
    # Well above the quarter from which the constraint applies, so that both measurements agree on whether it does.
    if inside.sum() < 0.35 * x.size:
        return None
    u, v = u[inside].astype(np.float32), v[inside].astype(np.float32)
    return float(cv2.remap(road, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).mean())


def _clipped_box(base: SceneIR, car: _MeasuredCar) -> tuple[float, float, float, float]:
    width, height = base.camera.width - 1, base.camera.height - 1
    x0, y0, x1, y1 = car.box
    return min(max(x0, 0), width), min(max(y0, 0), height), min(max(x1, 0), width), min(max(y1, 0), height)


def _frame_violations(base: SceneIR, old: _MeasuredCar, new: _MeasuredCar) -> list[str]:
    """Whether a car leaves the picture or becomes too small."""
    violations = []
    (a0, b0, a1, b1), (c0, d0, c1, d1) = _clipped_box(base, old), _clipped_box(base, new)

    def inside(car: _MeasuredCar, area: float) -> float:
        x0, y0, x1, y1 = car.box
        return area / max((x1 - x0) * (y1 - y0), 1e-9)

    before, after = inside(old, (a1 - a0) * (b1 - b0)), inside(new, (c1 - c0) * (d1 - d0))
    # A car that reaches behind the camera has no complete box.
    if min(old.near, new.near) > 0.1 and after < min(before, IN_FRAME) - VISIBLE_TOLERANCE:
        violations.append(f"left the picture, {after:.2f} of it inside ({before:.2f} before)")
    for name, length0, length in (("wide", a1 - a0, c1 - c0), ("high", b1 - b0, d1 - d0)):
        if length < min(length0, MINIMUM_PX) - MINIMUM_TOLERANCE_PX:
            violations.append(f"{length:.1f} px {name} ({length0:.1f} before)")
    if d1 - d0 < (MIN_HEIGHT_SHARE - VISIBLE_TOLERANCE) * (b1 - b0):
        violations.append(f"{d1 - d0:.1f} px high ({b1 - b0:.1f} before)")
    return violations


def _place_violations(
    base: SceneIR, road: Array, old: _MeasuredCar, new: _MeasuredCar, limits: ChangeLimits
) -> list[str]:
    """Whether a car gets behind the camera, out of the picture or onto ground outside of it, or moves too far."""
    violations = []
    if _move_violations(old, new, limits):
        along, _, across = np.abs(old.axes @ (new.position - old.position))
        which = "" if old.whole else " for a partly visible vehicle"
        violations.append(
            f"moved by {along:.2f} m along, {across:.2f} m across: more than any budget allows{which}"
        )
    if new.near <= 0.1 < old.near:
        return [*violations, "behind the camera" if new.far <= 0.1 else "reaches behind the camera"]
    violations += _frame_violations(base, old, new)[:1]
    if _road_share(base, road, old) is not None and _road_share(base, road, new) is None:
        violations.append("on ground that the picture does not show")
    return violations


def _collisions(
    before: Mapping[int, _MeasuredCar], after: Mapping[int, _MeasuredCar], visibility: _VisibilityCheck
) -> list[str]:
    """Cars that share more ground than before: their rectangles and, where those overlap, the meshes."""
    violations = []
    for i in after:
        for j in (k for k in after if k < i):
            now = overlap_area(after[i].footprint, after[j].footprint)
            then = overlap_area(before[i].footprint, before[j].footprint)
            if now > then + OVERLAP_TOLERANCE_M2:
                violations.append(f"objects[{i}]: collision with objects[{j}], {now:.2f} m2 ({then:.2f} before)")
            elif now > 0:
                now, then = (visibility.shared_m2(cars[i], cars[j]) for cars in (after, before))
                if now > then + OUTLINE_TOLERANCE_M2:
                    areas = f"{now:.2f} m2 ({then:.2f} before)"
                    violations.append(f"objects[{i}]: mesh runs into that of objects[{j}], {areas}")
    return violations


def _hidden_cars(
    base: SceneIR, before: list[_MeasuredCar], after: list[_MeasuredCar], visibility: _VisibilityCheck
) -> list[str]:
    """Visible cars that are now wholly behind others."""
    (then, alone), (now, _) = visibility.visible(base, before), visibility.visible(base, after)
    rows = (i for i in range(len(before)) if now[i] == 0 and then[i] > MIN_VISIBLE_SHARE * alone[i])
    return [f"objects[{i}]: hidden" for i in rows]


class _VisibilityCheck(Protocol):
    """Measures visibility and contact of cars."""

    def visible(self, base: SceneIR, cars: list[_MeasuredCar]) -> tuple[list[int], list[int]]:
        """Visible amount of each car, and its amount without the other cars."""
        ...

    def shared_m2(self, a: _MeasuredCar, b: _MeasuredCar) -> float:
        """Area that both cars cover."""
        ...


class _OutlineCheck:
    """Measures by convex outlines."""

    def visible(self, base: SceneIR, cars: list[_MeasuredCar]) -> tuple[list[int], list[int]]:
        """Pixels; see `_VisibilityCheck`."""
        return _visible_pixels(base, cars), [_visible_pixels(base, [car])[0] for car in cars]

    def shared_m2(self, a: _MeasuredCar, b: _MeasuredCar) -> float:
        """Overlap of the outlines from above."""
        return overlap_area(a.outline, b.outline)


def _visible_pixels(base: SceneIR, cars: list[_MeasuredCar]) -> list[int]:
    """Visible pixels of each car's convex outline; outlines are painted from far to near."""
    canvas = np.zeros((base.camera.height, base.camera.width), dtype=np.int32)
    for i in sorted(range(len(cars)), key=lambda k: -cars[k].position[2]):
        limit = 1 << 14
        outline = cv2.convexHull(np.clip(np.rint(cars[i].pixels), -limit, limit).astype(np.int32))
        cv2.fillConvexPoly(canvas, outline, i + 1)
    counts = np.bincount(canvas.ravel(), minlength=len(cars) + 1)
    return counts[1:].tolist()


@functools.cache
def _open3d() -> Any | None:
    """Open3D; None where it, or a system library that it needs, is missing."""
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError):
        return None


def _visibility_check(method: CheckMethod | None) -> _VisibilityCheck:
    open3d = None if method == "outlines" else _open3d()
    return _OutlineCheck() if open3d is None else _RayCheck(open3d)


class _RayCheck:
    """Measures by Open3D's rays at the cars' triangles."""

    def __init__(self, open3d: Any) -> None:
        self._open3d = open3d

    def visible(self, base: SceneIR, cars: list[_MeasuredCar]) -> tuple[list[int], list[int]]:
        """Rays through the car's image box: those that hit it first, and those that hit it at all."""
        if not cars:
            return [], []
        matrix = base.camera.matrix.double().numpy()
        inverse = np.linalg.inv(matrix[:, :3])
        pixels = [_pixel_grid(_clipped_box(base, car)) for car in cars]
        owner = np.repeat(np.arange(len(cars)), [len(grid) for grid in pixels])
        rays = np.concatenate(pixels)
        directions = np.column_stack([rays, np.ones(len(rays))]) @ inverse.T
        ray, car, distance = self._intersections(cars, -inverse @ matrix[:, 3], directions)
        first = np.full(len(rays), np.inf)
        np.minimum.at(first, ray, distance)
        own = car == owner[ray]
        visible, hit = np.unique(ray[own & (distance == first[ray])]), np.unique(ray[own])
        counts = (np.bincount(owner[rows], minlength=len(cars)).tolist() for rows in (visible, hit))
        return next(counts), next(counts)

    def shared_m2(self, a: _MeasuredCar, b: _MeasuredCar) -> float:
        """Area of the vertical lines that are inside of both cars at one height."""
        corners = [(car.vertices.min(axis=0), car.vertices.max(axis=0)) for car in (a, b)]
        low, high = np.maximum(corners[0][0], corners[1][0]), np.minimum(corners[0][1], corners[1][1])
        if (low >= high).any():
            return 0.0
        steps = (np.arange(COLUMNS) + 0.5) / COLUMNS
        x, z = np.meshgrid(low[0] + steps * (high[0] - low[0]), low[2] + steps * (high[2] - low[2]))
        # y points down.
        above = min(corners[0][0][1], corners[1][0][1]) - 1.0
        origins = np.stack([x.ravel(), np.full(x.size, above), z.ravel()], axis=1)
        ray, car, distance = self._intersections([a, b], origins, np.array([0.0, 1.0, 0.0]))
        top, bottom = np.full((2, x.size), np.inf), np.full((2, x.size), -np.inf)
        np.minimum.at(top, (car, ray), distance)
        np.maximum.at(bottom, (car, ray), distance)
        meet = top.max(axis=0) < bottom.min(axis=0)
        return float(meet.mean() * (high[0] - low[0]) * (high[2] - low[2]))

    def _intersections(
        self, cars: list[_MeasuredCar], origins: Array, directions: Array
    ) -> tuple[NDArray[Any], ...]:
        """All hits of rays (R, 3), (R, 3): ray (K,), car (K,), and distance (K,) in lengths of the direction."""
        tensor = self._open3d.core.Tensor
        scene = self._open3d.t.geometry.RaycastingScene(nthreads=1)
        for car in cars:
            vertices, faces = (np.ascontiguousarray(car.vertices, np.float32), car.faces.astype(np.uint32))
            scene.add_triangles(tensor(vertices), tensor(faces))
        origins, directions = np.broadcast_arrays(origins, directions)
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        hits = scene.list_intersections(tensor(rays), nthreads=1)
        return tuple(
            hits[name].numpy().astype(kind)
            for name, kind in (("ray_ids", np.int64), ("geometry_ids", np.int64), ("t_hit", np.float64))
        )


def _pixel_grid(box: tuple[float, float, float, float]) -> Array:
    """Pixels (R, 2), x and y, evenly spread over an image box."""
    sides = []
    for first, last, most in ((box[0], box[2], RAYS[1]), (box[1], box[3], RAYS[0])):
        count = min(most, math.ceil(last - first) + 1)
        sides.append(first + (np.arange(count) + 0.5) / count * (last - first))
    return np.stack([side.ravel() for side in np.meshgrid(*sides)], axis=1)
