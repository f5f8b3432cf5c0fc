"""The second opinion: are two scenes, as they lie on disk, a feasible change of one another?

Shares no code with `drivesem.attack.feasible`: it sees no theta, only the scenes, and measures them in other ways
(polygon clipping, finite differences, all vertices of the meshes, rays cast at them by Open3D). Its tolerances are
wider by what the two ways may differ.

Open3D needs libusb and loads slowly: it is imported when the first scene is checked, and where it cannot be, the
meshes' convex outlines stand for the meshes. `available_check_method` says which of the two it is here.
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
"""What tells whether cars show and whether their meshes meet: rays at the meshes, or their convex outlines."""

STRAIN = (0.7, 1.4)
"""Least and largest singular value of a mesh's deformation."""
STRAIN_TOLERANCE = 0.02
HEIGHT_TOLERANCE_M = 0.01
"""Of the pose above the ground plane, and of the mesh below its wheels."""
REACH_TOLERANCE = 1e-4
"""Of distances from the photograph, in each one's own unit: rounding of float32 poses, and no more."""
OVERLAP_TOLERANCE_M2 = 0.02
OUTLINE_TOLERANCE_M2 = 0.15
"""Of the meshes' outlines, which have rounder corners than the rectangles that the projection keeps apart: with
the rectangles' overlap unchanged, theirs was up to 0.12 m2 more, over 301 pairs that overlapped from the start."""
SYMMETRY_TOLERANCE = 1e-5
"""Unit boxes: float32's rounding of lattice offsets, and no more."""
ROAD_LOSS = 0.1
ROAD_TOLERANCE = 0.05
PARKED_ON_ROAD = 0.6
"""Share of the footprint of a car that was not there before."""
HEIGHT_KEPT = 0.6
IN_FRAME = 0.5
VISIBLE_TOLERANCE = 0.05
SEEN = 0.3
"""Share of its outline that must show in `base` for a car to be one that is seen. Of what is hidden more the
attack's set, which takes cars for boxes, may see nothing from the start; KITTI calls it largely occluded, and it
is not judged."""
RAYS = (48, 64)
"""Rays through a car's image box at most, down and across; no more than one a pixel."""
COLUMNS = 64
"""Plumb lines each way over the ground that two cars may share."""
HARDLY_CUT = 0.1
"""Truncation up to which a car counts as shown whole."""
MINIMUM_PX = 8.0
MINIMUM_TOLERANCE_PX = 1.0
WEATHER_TOLERANCE = 0.01
"""Of codes, and of what they are compared with."""
RAIN_BESIDE_SUN = 0.5
"""Code of rain up to which there may be a sky as bright as photographed: a shower."""
DAYLIGHT_LX, TWILIGHT_LX = 15_000.0, 3.4
"""In the shade at noon; at the end of civil twilight (RCA Electro-Optics Handbook, 1974)."""
EXTINCTION_PER_M = (0.03, 0.006)
"""Of fog 1 and rain 1: what these codes mean."""
DIMMING = 0.8
"""Of display values at time 1, in powers of e."""
AIRLIGHT = 0.82
"""Display value of the air where no sky is photographed: a bright haze."""
JUST_SEEN = 0.05
"""Contrast at which a thing is just seen (CIE S 017, 17-31-019); and light, of white's, that a screen adds."""
CONTRAST_TOLERANCE = 2.5
"""Factor on it: all of a car's box in the photograph is looked at, which need not be its own."""
JUDGED_PX = 25.0
"""Height of boxes of which it is asked whether they are seen: KITTI judges no lower ones."""


@dataclass(frozen=True, slots=True)
class ChangeLimits:
    """How far a change may go at most: by default as far as the paper's budget. translate: own lengths, along and
    across; translate_m: the same in m; across_m: m, across; of_distance: share of the distance from the camera;
    partly: own lengths, of a car that is hidden in part or cut by the picture's border; rotate: rad; mesh: unit
    boxes, of a lattice offset; size: share of its own, of a car that is neither hidden nor cut; codes: their
    largest values. roi: translate counts shares of the label's box in the picture, and log depth.
    """

    translate: float = 0.25
    translate_m: float = math.inf
    rotate: float = 0.35
    mesh: float = 0.25
    color: float = 1.0
    weather: float = 1.0
    foliage: float = 1.0
    across_m: float = math.inf
    distance_share: float = math.inf
    partly_visible: float = math.inf
    size: float = 0.0
    sun: float = 0.0
    roi: bool = False


PAPERS = ChangeLimits()


def check_limits(base: SceneIR, perturbed: SceneIR, reach: ChangeLimits) -> list[str]:
    """What goes further than `reach`, one line each, such as `objects[3]: turned by 0.100 rad`. Both scenes have
    the same objects.
    """
    found = _codes(base, perturbed, reach)
    for i in range(len(base.objects)):
        poses = _Pose(base, i), _Pose(perturbed, i)
        lines = (_in_region(base, i, *poses, reach) if reach.roi else _on_ground(*poses, reach)) + _rest(
            *poses, reach
        )
        found += [f"objects[{i}]: {line}" for line in lines]
    return found


def available_check_method() -> CheckMethod:
    """Who judges here: `open3d` where it can be imported, which takes a second or two, or else `outlines`."""
    return "outlines" if _open3d() is None else "open3d"


def check_scene(
    base: SceneIR,
    perturbed: SceneIR,
    by: CheckMethod | None = None,
    joint_weather: bool = True,
    reach: ChangeLimits = PAPERS,
) -> list[str]:
    """What is violated, one line each, such as `objects[3]: collision with objects[1], 0.52 m2 (0.00 before)`.

    by: whose judgement counts, by default that of `available_check_method`, which also stands in where Open3D is
    asked for and missing. joint_weather: whether weather is looked at beyond its bounds: what comes together, and
    whom it hides. reach: how far the change may go, by the budget that it was made in. Nothing counts that was as
    bad in `base`. Empty where the change is feasible.
    """
    judge = _Outlines() if by == "outlines" else _judge()
    base, perturbed = (convert_scene(scene, None, "cpu") for scene in (base, perturbed))
    if len(base.objects) != len(perturbed.objects):
        return [f"objects: {len(base.objects)} before, {len(perturbed.objects)} after"]
    found = _unchanged(base, perturbed) + check_limits(base, perturbed, reach)
    before = [_Car(base, i) for i in range(len(base.objects))]
    after = [_Car(perturbed, i) for i in range(len(base.objects))]
    road = base.environment.road.numpy().astype(np.float64)
    for i, (old, new) in enumerate(zip(before, after, strict=True)):
        lines = _height(base, old, new) + _shape(old, new) + _road(base, road, old, new)
        found += [f"objects[{i}]: {line}" for line in lines + _frame(base, old, new)]
    found += _collisions(dict(enumerate(before)), dict(enumerate(after)), judge)
    found += _hidden(base, before, after, judge)
    found += check_exchange(perturbed, by)
    return found + (_weather(base, perturbed) + _unseen(base, perturbed, after) if joint_weather else [])


def check_exchange(scene: SceneIR, by: CheckMethod | None = None) -> list[str]:
    """What is wrong with the vehicles that were exchanged, added or taken away, before anything else changed;
    lines as of `check_scene`, nothing where none was. What there is stands on the road, or as far on it as what
    stood there before, in no other car and hides none that was seen.
    """
    if scene.before is None:
        return []
    judge = _Outlines() if by == "outlines" else _judge()
    base, rest = (convert_scene(state.unperturbed(), None, "cpu") for state in (scene.before, scene))
    rows = range(len(rest.objects))
    before, after = ([_Car(state, i) for i in rows] for state in (base, rest))
    road = base.environment.road.numpy().astype(np.float64)
    there = [i for i in rows if after[i].near > 0]
    found = []
    for i in there:
        lines = _road(base, road, before[i], after[i])
        if before[i].near < 0:
            share = _road_share(base, road, after[i]) or 0.0
            lines = [] if share >= PARKED_ON_ROAD else [f"off the road, {share:.2f} of its footprint on it"]
            lines += _height(base, after[i], after[i])
        found += [f"objects[{i}]: {line}" for line in lines]
    found += _collisions({i: before[i] for i in there}, {i: after[i] for i in there}, judge)
    hidden = _hidden(base, before, [car if car.near > 0 else before[i] for i, car in enumerate(after)], judge)
    return [f"exchange: {line}" for line in (*found, *hidden)]


def check_places(base: SceneIR, perturbed: SceneIR, rows: Iterable[int]) -> list[str]:
    """Which of the objects `rows` left the ground or the road, or stand in one another; lines as of `check_scene`.

    What only an attack is bound to, how far a car may go and turn, is not looked at. Outlines judge, on every
    machine: an edit waits for no library, and a scene drawn at random is the same everywhere.
    """
    base, perturbed = (convert_scene(scene, None, "cpu") for scene in (base, perturbed))
    before = {i: _Car(base, i) for i in rows}
    after = {i: _Car(perturbed, i) for i in before}
    road = base.environment.road.numpy().astype(np.float64)
    found = []
    for i, old in before.items():
        lines = _height(base, old, after[i]) + _road(base, road, old, after[i])
        found += [f"objects[{i}]: {line}" for line in lines]
    return found + _collisions(before, after, _Outlines())


class _Pose:
    """Where one car of a scene stands, and its lattice, in float64 numpy. axes: rows are its own axes."""

    def __init__(self, scene: SceneIR, i: int) -> None:
        objects = scene.objects
        self.position = objects.translation[i].detach().double().numpy()
        self.yaw = float(objects.yaw[i])
        self.size = objects.size_lhw[i].detach().double().numpy()
        self.lattice = objects.ffd[i].detach().double().numpy().reshape(4, 4, 4, 3)
        self.whole = int(objects.occlusion[i]) == 0 and float(objects.truncation[i]) <= HARDLY_CUT
        forward = np.array([math.cos(self.yaw), 0.0, -math.sin(self.yaw)])
        sideways = np.array([math.sin(self.yaw), 0.0, math.cos(self.yaw)])
        self.axes = np.stack([forward, np.array([0.0, 1.0, 0.0]), sideways])


class _Car(_Pose):
    """One car of a scene, with its mesh, measured in float64 numpy."""

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
        self.near = float(clip[:, 2].min())
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
    """unit (V, 3) moved by a Bernstein lattice (4, 4, 4, 3), by de Casteljau's interpolation axis by axis."""
    parameters = unit + np.array([0.5, 1.0, 0.5])
    points = np.broadcast_to(lattice, (len(unit), 4, 4, 4, 3))
    for axis in range(3):
        t = parameters[:, axis].reshape(-1, *([1] * (points.ndim - 2)))
        while points.shape[1] > 1:
            points = points[:, :-1] * (1 - t[:, None]) + points[:, 1:] * t[:, None]
        points = points[:, 0]
    return unit + points


def overlap_area(a: Array, b: Array) -> float:
    """Area m2 shared by two convex counter-clockwise polygons (K, 2): Sutherland and Hodgman's clipping."""
    polygon = a
    for start, end in zip(b, np.roll(b, -1, axis=0), strict=True):
        if not len(polygon):
            return 0.0
        normal = np.array([start[1] - end[1], end[0] - start[0]])
        side = (polygon - start) @ normal
        kept = []
        for k in range(len(polygon)):
            here, there = side[k - 1], side[k]
            if (here >= 0) != (there >= 0):
                kept.append(polygon[k - 1] + (polygon[k] - polygon[k - 1]) * (here / (here - there)))
            if there >= 0:
                kept.append(polygon[k])
        polygon = np.array(kept).reshape(-1, 2)
    return abs(_polygon_area(polygon)) if len(polygon) else 0.0


def _counter_clockwise(polygon: Array) -> Array:
    return polygon if _polygon_area(polygon) > 0 else polygon[::-1]


def _polygon_area(polygon: Array) -> float:
    """Signed area m2 of (K, 2), positive counter-clockwise."""
    x, y = polygon.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def _unchanged(base: SceneIR, perturbed: SceneIR) -> list[str]:
    """What no parameter may touch."""
    pairs = {
        "objects.mesh_index": (base.objects.mesh_index, perturbed.objects.mesh_index),
        "photograph": (base.photograph, perturbed.photograph),
        "camera": (base.camera.matrix, perturbed.camera.matrix),
        "ground": (base.environment.ground, perturbed.environment.ground),
        "sun": (base.environment.sun, perturbed.environment.sun),
    }
    return [f"{name}: changed" for name, (a, b) in pairs.items() if a.shape != b.shape or not bool((a == b).all())]


def _codes(base: SceneIR, perturbed: SceneIR, reach: ChangeLimits) -> list[str]:
    (old, before), (new, after) = ((scene.objects, scene.environment) for scene in (base, perturbed))
    ranges = {
        "objects.texture_code": (old.texture_code, new.texture_code, -reach.color, reach.color),
        "environment.weather": (before.weather, after.weather, 0.0, reach.weather),
        "environment.foliage": (before.foliage, after.foliage, -reach.foliage, reach.foliage),
        "environment.light": (before.light, after.light, -reach.sun, reach.sun),
    }
    found = []
    for name, (start, code, low, high) in ranges.items():
        # What lay outside from the start, as under an edit, may stay there.
        if bool(((code < start.clamp(max=low) - 1e-6) | (code > start.clamp(min=high) + 1e-6)).any()):
            found.append(f"{name}: outside [{low:g}, {high:g}]")
    return found


def _weather(base: SceneIR, perturbed: SceneIR) -> list[str]:
    """What hardly ever comes together, and does so more than before."""
    before, after = (_Sky(*scene.environment.weather.tolist()) for scene in (base, perturbed))
    found = []
    if after.fog + after.rain > max(1.0, before.fog + before.rain) + WEATHER_TOLERANCE:
        found.append(f"weather: fog {after.fog:.2f} is washed out by rain {after.rain:.2f}")
    if after.rain - after.overcast > max(RAIN_BESIDE_SUN, before.rain - before.overcast) + WEATHER_TOLERANCE:
        found.append(f"weather: rain {after.rain:.2f} out of a sky covered {after.overcast:.2f}")
    if after.light_lx < min(TWILIGHT_LX, before.light_lx) * (1 - 5 * WEATHER_TOLERANCE):
        found.append(f"weather: {after.light_lx:.1f} lx, darker than at the end of civil twilight")
    return found


@dataclass(frozen=True, slots=True)
class _Sky:
    """Weather by its codes."""

    fog: float
    rain: float
    time: float
    overcast: float

    @property
    def light_lx(self) -> float:
        """What falls on the road. A cover takes nine tenths, fog is one too, and strong rain's takes more."""
        dusk = (TWILIGHT_LX / DAYLIGHT_LX) ** self.time
        return DAYLIGHT_LX * dusk * 0.1 ** (self.fog + self.rain + self.overcast)

    def dimmed(self, tones: Array, air: float, away_m: float) -> Array:
        """Display values as they look so far away, where the air is as bright as `air`."""
        clear = math.exp(-away_m * (EXTINCTION_PER_M[0] * self.fog + EXTINCTION_PER_M[1] * self.rain))
        return (clear * tones + (1 - clear) * air) * math.exp(-DIMMING * self.time**2)


def _unseen(base: SceneIR, perturbed: SceneIR, cars: list[_Car]) -> list[str]:
    """Cars that the photograph shows, and of which air and dusk leave hardly a tone: what is in their boxes there,
    behind as much haze as there is now between them and the camera (Koschmieder's law), and as dim."""
    before, after = (_Sky(*scene.environment.weather.tolist()) for scene in (base, perturbed))
    photograph = base.photograph.double().numpy().mean(axis=0)
    sky = base.environment.sky.numpy() > 0.5
    air = float(photograph[sky].mean()) if sky.any() else AIRLIGHT
    found = []
    for i, car in enumerate(cars):
        x0, y0, x1, y1 = (max(round(value), 0) for value in base.objects.box2d[i].tolist())
        tones = photograph[y0 : y1 + 1, x0 : x1 + 1]
        if y1 - y0 < JUDGED_PX or not tones.size:
            continue
        then, now = (_contrast(sky.dimmed(tones, air, float(car.position[2]))) for sky in (before, after))
        if then >= JUST_SEEN and now < JUST_SEEN / CONTRAST_TOLERANCE:
            found.append(f"objects[{i}]: out of sight, contrast {now:.3f} ({then:.2f} before)")
    return found


def _contrast(tones: Array) -> float:
    """Deviation of the light of display values, over its mean and what a screen adds to it."""
    light = tones**2.2
    return float(light.std() / (light.mean() + JUST_SEEN))


def _height(base: SceneIR, old: _Car, new: _Car) -> list[str]:
    plane = base.environment.ground.double().numpy()
    rise = float(plane[:3] @ (new.position - old.position)) / float(np.linalg.norm(plane[:3]))
    return [f"off the ground by {rise:.3f} m"] if abs(rise) > HEIGHT_TOLERANCE_M else []


def _in_region(base: SceneIR, i: int, old: _Pose, new: _Pose, reach: ChangeLimits) -> list[str]:
    """By how much the middle of a car's box moved, in sizes of its label in the picture and in the logarithm of
    the squared distance, where that is more than `reach`.
    """
    matrix = base.camera.matrix.double().numpy()
    eye = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
    middles = np.stack([pose.position - [0.0, pose.size[1] / 2, 0.0] for pose in (old, new)])
    clip = middles @ matrix[:, :3].T + matrix[:, 3]
    pixels = clip[:, :2] / clip[:, 2:]
    x0, y0, x1, y1 = base.objects.box2d[i].tolist()
    shares = (pixels[1] - pixels[0]) / np.maximum([x1 - x0, y1 - y0], 1.0)
    depth = 2 * math.log(np.linalg.norm(middles[1] - eye) / np.linalg.norm(middles[0] - eye))
    if max(*np.abs(shares), abs(depth)) <= reach.translate + REACH_TOLERANCE:
        return []
    return [f"moved by {shares[0]:.3f}, {shares[1]:.3f} of its box and {depth:.3f} in log depth"]


def _on_ground(old: _Pose, new: _Pose, reach: ChangeLimits) -> list[str]:
    """By how much a car moved along and across, where that is more than `reach`."""
    found = []
    metres = old.axes @ (new.position - old.position)
    along, across = metres[0] / old.size[0], metres[2] / old.size[0]
    most_m = min(reach.translate_m, reach.distance_share * math.hypot(*old.position))
    across_m = min(most_m, reach.across_m)
    most = reach.translate if old.whole else min(reach.translate, reach.partly_visible)
    if max(abs(along), abs(across)) > most + REACH_TOLERANCE:
        found.append(f"moved by {along:.3f}, {across:.3f} own lengths")
    elif abs(metres[0]) > most_m + REACH_TOLERANCE or abs(metres[2]) > across_m + REACH_TOLERANCE:
        found.append(f"moved by {metres[0]:.3f}, {metres[2]:.3f} m")
    return found


def _rest(old: _Pose, new: _Pose, reach: ChangeLimits) -> list[str]:
    """By how much a car turned, was bent and grew, where that is more than `reach`."""
    found = []
    turned = math.remainder(new.yaw - old.yaw, 2 * math.pi)
    if abs(turned) > reach.rotate + REACH_TOLERANCE:
        found.append(f"turned by {turned:.3f} rad")
    bent = float(np.abs(new.lattice - old.lattice).max())
    if bent > reach.mesh + REACH_TOLERANCE:
        found.append(f"lattice bent by {bent:.3f} unit boxes")
    grown = new.size / old.size - 1
    if np.abs(grown).max() > (reach.size + REACH_TOLERANCE if reach.size and old.whole else 0.0):
        found.append(f"size changed by {100 * grown[np.abs(grown).argmax()]:.1f} %")
    elif np.ptp(grown) > REACH_TOLERANCE:
        found.append("size changed, and not alike in length, height and width")
    return found


def _strain(car: _Car) -> tuple[float, float, float]:
    """Least and largest singular value and least determinant over the unit box, by central differences."""
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


def _shape(old: _Car, new: _Car) -> list[str]:
    if np.array_equal(old.lattice, new.lattice):
        return []
    found = []
    low0, high0, det0 = _strain(old)
    low, high, det = _strain(new)
    if low < min(STRAIN[0], low0) - STRAIN_TOLERANCE or high > max(STRAIN[1], high0) + STRAIN_TOLERANCE:
        found.append(f"strain in [{low:.3f}, {high:.3f}]")
    if det <= min(0.0, det0):
        found.append(f"mesh inverted, determinant {det:.3f}")
    change = new.lattice - old.lattice
    # Left and right are the last of the lattice's axes; what goes to the side is turned round in a mirror.
    uneven = float(np.abs(change - change[:, :, ::-1] * [1.0, 1.0, -1.0]).max())
    if uneven > SYMMETRY_TOLERANCE:
        found.append(f"mesh not symmetric, left and right {uneven:.4f} unit boxes apart")
    lowest = change[:, -1, :, 1]
    if np.abs(lowest).max() > 1e-6:
        found.append(f"lowest lattice layer moved vertically by {np.abs(lowest).max():.4f} unit boxes")
    # y points down: the largest y is the lowest point.
    if new.high[1] > max(old.high[1], 0.0) + HEIGHT_TOLERANCE_M:
        found.append(f"mesh {new.high[1]:.3f} m below its wheels")
    if new.high[1] < old.high[1] - HEIGHT_TOLERANCE_M:
        found.append(f"mesh lifted off the ground by {old.high[1] - new.high[1]:.3f} m")
    return found


def _road(base: SceneIR, road: Array, old: _Car, new: _Car) -> list[str]:
    before, after = (_road_share(base, road, car) for car in (old, new))
    if before is None or after is None or after >= before - ROAD_LOSS - ROAD_TOLERANCE:
        return []
    return [f"left the road, {after:.2f} of its footprint on it ({before:.2f} before)"]


def _road_share(base: SceneIR, road: Array, car: _Car) -> float | None:
    """Mean of the road map over a fine grid on the footprint; None where most of that lies outside the image."""
    a, b = car.low, car.high
    x, z = np.meshgrid(np.linspace(a[0], b[0], 33), np.linspace(a[2], b[2], 17), indexing="ij")
    local = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=-1)
    points = local @ car.axes + car.position
    matrix = base.camera.matrix.double().numpy()
    clip = points @ matrix[:, :3].T + matrix[:, 3]
    clip = clip[clip[:, 2] > 0.1]
    u, v = (clip[:, :2] / clip[:, 2:]).T
    inside = (u >= 0) & (u <= base.camera.width - 1) & (v >= 0) & (v <= base.camera.height - 1)
    # Well above the quarter at which the constraint begins, so that both ways agree on whether it applies.
    if inside.sum() < 0.35 * x.size:
        return None
    u, v = u[inside].astype(np.float32), v[inside].astype(np.float32)
    return float(cv2.remap(road, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).mean())


def _clipped(base: SceneIR, car: _Car) -> tuple[float, float, float, float]:
    width, height = base.camera.width - 1, base.camera.height - 1
    x0, y0, x1, y1 = car.box
    return min(max(x0, 0), width), min(max(y0, 0), height), min(max(x1, 0), width), min(max(y1, 0), height)


def _frame(base: SceneIR, old: _Car, new: _Car) -> list[str]:
    """Whether the car stays in the picture and as large as it must be."""
    found = []
    (a0, b0, a1, b1), (c0, d0, c1, d1) = _clipped(base, old), _clipped(base, new)

    def inside(car: _Car, area: float) -> float:
        x0, y0, x1, y1 = car.box
        return area / max((x1 - x0) * (y1 - y0), 1e-9)

    before, after = inside(old, (a1 - a0) * (b1 - b0)), inside(new, (c1 - c0) * (d1 - d0))
    # Of a car that reaches behind the camera no whole box is known.
    if min(old.near, new.near) > 0.1 and after < min(before, IN_FRAME) - VISIBLE_TOLERANCE:
        found.append(f"left the picture, {after:.2f} of it inside ({before:.2f} before)")
    for name, length0, length in (("wide", a1 - a0, c1 - c0), ("high", b1 - b0, d1 - d0)):
        if length < min(length0, MINIMUM_PX) - MINIMUM_TOLERANCE_PX:
            found.append(f"{length:.1f} px {name} ({length0:.1f} before)")
    if d1 - d0 < (HEIGHT_KEPT - VISIBLE_TOLERANCE) * (b1 - b0):
        found.append(f"{d1 - d0:.1f} px high ({b1 - b0:.1f} before)")
    return found


def _collisions(before: Mapping[int, _Car], after: Mapping[int, _Car], judge: _Judge) -> list[str]:
    """Cars that share more ground than before: their rectangles, and, where those meet, the meshes themselves."""
    found = []
    for i in after:
        for j in (k for k in after if k < i):
            now = overlap_area(after[i].footprint, after[j].footprint)
            then = overlap_area(before[i].footprint, before[j].footprint)
            if now > then + OVERLAP_TOLERANCE_M2:
                found.append(f"objects[{i}]: collision with objects[{j}], {now:.2f} m2 ({then:.2f} before)")
            elif now > 0:
                now, then = (judge.shared_m2(cars[i], cars[j]) for cars in (after, before))
                if now > then + OUTLINE_TOLERANCE_M2:
                    areas = f"{now:.2f} m2 ({then:.2f} before)"
                    found.append(f"objects[{i}]: mesh runs into that of objects[{j}], {areas}")
    return found


def _hidden(base: SceneIR, before: list[_Car], after: list[_Car], judge: _Judge) -> list[str]:
    """Cars that were seen and are now wholly behind others."""
    (then, alone), (now, _) = judge.seen(base, before), judge.seen(base, after)
    return [f"objects[{i}]: hidden" for i in range(len(before)) if now[i] == 0 and then[i] > SEEN * alone[i]]


class _Judge(Protocol):
    """Whether cars show, and whether they meet."""

    def seen(self, base: SceneIR, cars: list[_Car]) -> tuple[list[int], list[int]]:
        """How much of each car shows, and how much would if it stood there alone."""
        ...

    def shared_m2(self, a: _Car, b: _Car) -> float:
        """The ground on which both cars stand."""
        ...


class _Outlines:
    """Judges by convex outlines, painted from far to near."""

    def seen(self, base: SceneIR, cars: list[_Car]) -> tuple[list[int], list[int]]:
        """In pixels."""
        return _visible_pixels(base, cars), [_visible_pixels(base, [car])[0] for car in cars]

    def shared_m2(self, a: _Car, b: _Car) -> float:
        """Where the outlines from above overlap."""
        return overlap_area(a.outline, b.outline)


def _visible_pixels(base: SceneIR, cars: list[_Car]) -> list[int]:
    """Pixels of each car's convex outline in front of all others, painted from far to near."""
    canvas = np.zeros((base.camera.height, base.camera.width), dtype=np.int32)
    for i in sorted(range(len(cars)), key=lambda k: -cars[k].position[2]):
        limit = 1 << 14
        outline = cv2.convexHull(np.clip(np.rint(cars[i].pixels), -limit, limit).astype(np.int32))
        cv2.fillConvexPoly(canvas, outline, i + 1)
    counts = np.bincount(canvas.ravel(), minlength=len(cars) + 1)
    return counts[1:].tolist()


@functools.cache
def _open3d() -> Any | None:
    """The library; None where it, or a library of the system that it needs, is missing."""
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError):
        return None


def _judge() -> _Judge:
    open3d = _open3d()
    return _Outlines() if open3d is None else _Rays(open3d)


class _Rays:
    """Judges by what rays of Open3D meet of the cars' triangles."""

    def __init__(self, open3d: Any) -> None:
        self._open3d = open3d

    def seen(self, base: SceneIR, cars: list[_Car]) -> tuple[list[int], list[int]]:
        """In rays through the car's image box: those that meet it first, and those that meet it at all."""
        if not cars:
            return [], []
        matrix = base.camera.matrix.double().numpy()
        inverse = np.linalg.inv(matrix[:, :3])
        pixels = [_grid(_clipped(base, car)) for car in cars]
        owner = np.repeat(np.arange(len(cars)), [len(grid) for grid in pixels])
        rays = np.concatenate(pixels)
        directions = np.column_stack([rays, np.ones(len(rays))]) @ inverse.T
        ray, car, distance = self._met(cars, -inverse @ matrix[:, 3], directions)
        first = np.full(len(rays), np.inf)
        np.minimum.at(first, ray, distance)
        own = car == owner[ray]
        shown, met = np.unique(ray[own & (distance == first[ray])]), np.unique(ray[own])
        counts = (np.bincount(owner[hit], minlength=len(cars)).tolist() for hit in (shown, met))
        return next(counts), next(counts)

    def shared_m2(self, a: _Car, b: _Car) -> float:
        """Where a plumb line is inside of both at one height."""
        corners = [(car.vertices.min(axis=0), car.vertices.max(axis=0)) for car in (a, b)]
        low, high = np.maximum(corners[0][0], corners[1][0]), np.minimum(corners[0][1], corners[1][1])
        if (low >= high).any():
            return 0.0
        steps = (np.arange(COLUMNS) + 0.5) / COLUMNS
        x, z = np.meshgrid(low[0] + steps * (high[0] - low[0]), low[2] + steps * (high[2] - low[2]))
        # y points down.
        above = min(corners[0][0][1], corners[1][0][1]) - 1.0
        origins = np.stack([x.ravel(), np.full(x.size, above), z.ravel()], axis=1)
        ray, car, distance = self._met([a, b], origins, np.array([0.0, 1.0, 0.0]))
        top, bottom = np.full((2, x.size), np.inf), np.full((2, x.size), -np.inf)
        np.minimum.at(top, (car, ray), distance)
        np.maximum.at(bottom, (car, ray), distance)
        meet = top.max(axis=0) < bottom.min(axis=0)
        return float(meet.mean() * (high[0] - low[0]) * (high[2] - low[2]))

    def _met(self, cars: list[_Car], origins: Array, directions: Array) -> tuple[NDArray[Any], ...]:
        """All that rays (R, 3), (R, 3) meet: ray (K,), car (K,), and distance in lengths of the direction (K,)."""
        tensor = self._open3d.core.Tensor
        scene = self._open3d.t.geometry.RaycastingScene(nthreads=1)
        for car in cars:
            vertices, faces = (np.ascontiguousarray(car.vertices, np.float32), car.faces.astype(np.uint32))
            scene.add_triangles(tensor(vertices), tensor(faces))
        origins, directions = np.broadcast_arrays(origins, directions)
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        met = scene.list_intersections(tensor(rays), nthreads=1)
        return tuple(
            met[name].numpy().astype(kind)
            for name, kind in (("ray_ids", np.int64), ("geometry_ids", np.int64), ("t_hit", np.float64))
        )


def _grid(box: tuple[float, float, float, float]) -> Array:
    """Pixels (R, 2), x and y, spread evenly over an image box."""
    sides = []
    for first, last, most in ((box[0], box[2], RAYS[1]), (box[1], box[3], RAYS[0])):
        count = min(most, math.ceil(last - first) + 1)
        sides.append(first + (np.arange(count) + 0.5) / count * (last - first))
    return np.stack([side.ravel() for side in np.meshgrid(*sides)], axis=1)
