"""The second opinion: are two scenes, as they lie on disk, a feasible change of one another?

Shares no code with `drivesem.attack.feasible`: it sees no theta, only the scenes, and measures them in other ways
(polygon clipping, finite differences, all vertices of the meshes). Its tolerances are wider by what the two ways
may differ.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from scene_ir.types import SceneIR

Array = NDArray[np.float64]

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
HEIGHT_KEPT = 0.6
IN_FRAME = 0.5
VISIBLE_TOLERANCE = 0.05
SEEN = 0.3
"""Share of its outline that must show in `base` for a car to be one that is seen. Of what is hidden more the
attack's set, which takes cars for boxes, may see nothing from the start; KITTI calls it largely occluded, and it
is not judged."""
MINIMUM_PX = 8.0
MINIMUM_TOLERANCE_PX = 1.0


@dataclass(frozen=True, slots=True)
class Reach:
    """How far a change may go at most: by default as far as any budget. translate: own lengths, along and across;
    translate_m: the same in m; rotate: rad; mesh: unit boxes, of a lattice offset; codes: their largest values.
    """

    translate: float = 0.25
    translate_m: float = math.inf
    rotate: float = 0.35
    mesh: float = 0.25
    color: float = 1.0
    weather: float = 1.0
    foliage: float = 1.0


WIDEST = Reach()


def check_reach(base: SceneIR, perturbed: SceneIR, reach: Reach) -> list[str]:
    """What goes further than `reach`, one line each, such as `objects[3]: turned by 0.100 rad`. Both scenes have
    the same objects.
    """
    found = _codes(perturbed, reach)
    for i in range(len(base.objects)):
        lines = _distance(_Pose(base, i), _Pose(perturbed, i), reach)
        found += [f"objects[{i}]: {line}" for line in lines]
    return found


def check_scene(base: SceneIR, perturbed: SceneIR) -> list[str]:
    """What is violated, one line each, such as `objects[3]: collision with objects[1], 0.52 m2 (0.00 before)`.

    Nothing counts that was as bad in `base`. Empty where the change is feasible.
    """
    if len(base.objects) != len(perturbed.objects):
        return [f"objects: {len(base.objects)} before, {len(perturbed.objects)} after"]
    found = _unchanged(base, perturbed) + check_reach(base, perturbed, WIDEST)
    before = [_Car(base, i) for i in range(len(base.objects))]
    after = [_Car(perturbed, i) for i in range(len(base.objects))]
    road = base.environment.road.numpy().astype(np.float64)
    for i, (old, new) in enumerate(zip(before, after, strict=True)):
        lines = _height(base, old, new) + _shape(old, new) + _road(base, road, old, new)
        found += [f"objects[{i}]: {line}" for line in lines + _frame(base, old, new)]
    found += _collisions(dict(enumerate(before)), dict(enumerate(after)))
    found += _hidden(base, before, after)
    return found


def check_places(base: SceneIR, perturbed: SceneIR, rows: Iterable[int]) -> list[str]:
    """Which of the objects `rows` left the ground or the road, or stand in one another; lines as of `check_scene`.

    What only an attack is bound to, how far a car may go and turn, is not looked at.
    """
    before = {i: _Car(base, i) for i in rows}
    after = {i: _Car(perturbed, i) for i in before}
    road = base.environment.road.numpy().astype(np.float64)
    found = []
    for i, old in before.items():
        lines = _height(base, old, after[i]) + _road(base, road, old, after[i])
        found += [f"objects[{i}]: {line}" for line in lines]
    return found + _collisions(before, after)


class _Pose:
    """Where one car of a scene stands, and its lattice, in float64 numpy. axes: rows are its own axes."""

    def __init__(self, scene: SceneIR, i: int) -> None:
        objects = scene.objects
        self.position = objects.translation[i].detach().double().numpy()
        self.yaw = float(objects.yaw[i])
        self.size = objects.size_lhw[i].detach().double().numpy()
        self.lattice = objects.ffd[i].detach().double().numpy().reshape(4, 4, 4, 3)
        forward = np.array([math.cos(self.yaw), 0.0, -math.sin(self.yaw)])
        sideways = np.array([math.sin(self.yaw), 0.0, math.cos(self.yaw)])
        self.axes = np.stack([forward, np.array([0.0, 1.0, 0.0]), sideways])


class _Car(_Pose):
    """One car of a scene, with its mesh, measured in float64 numpy."""

    def __init__(self, scene: SceneIR, i: int) -> None:
        super().__init__(scene, i)
        objects = scene.objects
        self.unit = scene.meshes[int(objects.mesh_index[i])].vertices.detach().double().numpy()
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
        "objects.size_lhw": (base.objects.size_lhw, perturbed.objects.size_lhw),
        "objects.mesh_index": (base.objects.mesh_index, perturbed.objects.mesh_index),
        "photograph": (base.photograph, perturbed.photograph),
        "camera": (base.camera.matrix, perturbed.camera.matrix),
        "ground": (base.environment.ground, perturbed.environment.ground),
    }
    return [f"{name}: changed" for name, (a, b) in pairs.items() if a.shape != b.shape or not bool((a == b).all())]


def _codes(scene: SceneIR, reach: Reach) -> list[str]:
    ranges = {
        "objects.texture_code": (scene.objects.texture_code, -reach.color, reach.color),
        "environment.weather": (scene.environment.weather, 0.0, reach.weather),
        "environment.foliage": (scene.environment.foliage, -reach.foliage, reach.foliage),
    }
    return [
        f"{name}: outside [{low:g}, {high:g}]"
        for name, (code, low, high) in ranges.items()
        if code.numel() and not (low - 1e-6 <= float(code.min()) and float(code.max()) <= high + 1e-6)
    ]


def _height(base: SceneIR, old: _Car, new: _Car) -> list[str]:
    plane = base.environment.ground.double().numpy()
    rise = float(plane[:3] @ (new.position - old.position)) / float(np.linalg.norm(plane[:3]))
    return [f"off the ground by {rise:.3f} m"] if abs(rise) > HEIGHT_TOLERANCE_M else []


def _distance(old: _Pose, new: _Pose, reach: Reach) -> list[str]:
    """By how much a car moved, turned and was bent, where that is more than `reach`."""
    found = []
    metres = old.axes @ (new.position - old.position)
    along, across = metres[0] / old.size[0], metres[2] / old.size[0]
    if max(abs(along), abs(across)) > reach.translate + REACH_TOLERANCE:
        found.append(f"moved by {along:.3f}, {across:.3f} own lengths")
    elif max(abs(metres[0]), abs(metres[2])) > reach.translate_m + REACH_TOLERANCE:
        found.append(f"moved by {metres[0]:.3f}, {metres[2]:.3f} m")
    turned = math.remainder(new.yaw - old.yaw, 2 * math.pi)
    if abs(turned) > reach.rotate + REACH_TOLERANCE:
        found.append(f"turned by {turned:.3f} rad")
    bent = float(np.abs(new.lattice - old.lattice).max())
    if bent > reach.mesh + REACH_TOLERANCE:
        found.append(f"lattice bent by {bent:.3f} unit boxes")
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


def _collisions(before: Mapping[int, _Car], after: Mapping[int, _Car]) -> list[str]:
    """Cars that share more ground than before: their rectangles, and, where those meet, the meshes' outlines."""
    found = []
    for i in after:
        for j in (k for k in after if k < i):
            now = overlap_area(after[i].footprint, after[j].footprint)
            then = overlap_area(before[i].footprint, before[j].footprint)
            if now > then + OVERLAP_TOLERANCE_M2:
                found.append(f"objects[{i}]: collision with objects[{j}], {now:.2f} m2 ({then:.2f} before)")
            elif now > 0:
                now = overlap_area(after[i].outline, after[j].outline)
                then = overlap_area(before[i].outline, before[j].outline)
                if now > then + OUTLINE_TOLERANCE_M2:
                    areas = f"{now:.2f} m2 ({then:.2f} before)"
                    found.append(f"objects[{i}]: mesh runs into that of objects[{j}], {areas}")
    return found


def _hidden(base: SceneIR, before: list[_Car], after: list[_Car]) -> list[str]:
    """Cars that were seen and are now wholly behind others, by their convex outlines."""
    then, now = _visible_pixels(base, before), _visible_pixels(base, after)
    alone = [_visible_pixels(base, [car])[0] for car in before]
    return [f"objects[{i}]: hidden" for i in range(len(before)) if now[i] == 0 and then[i] > SEEN * alone[i]]


def _visible_pixels(base: SceneIR, cars: list[_Car]) -> list[int]:
    """Pixels of each car's convex outline in front of all others, painted from far to near."""
    canvas = np.zeros((base.camera.height, base.camera.width), dtype=np.int32)
    for i in sorted(range(len(cars)), key=lambda k: -cars[k].position[2]):
        limit = 1 << 14
        outline = cv2.convexHull(np.clip(np.rint(cars[i].pixels), -limit, limit).astype(np.int32))
        cv2.fillConvexPoly(canvas, outline, i + 1)
    counts = np.bincount(canvas.ravel(), minlength=len(cars) + 1)
    return counts[1:].tolist()
