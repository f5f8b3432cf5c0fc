"""Constraints on vehicles: limits, a scene's bounds and their violations; road, gaps and overlaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivesem.attack.feasible.camera import (
    NEAR_M,
    CameraProjection,
    VehicleProjections,
    VehicleVisibility,
    VisibilityRays,
)
from drivesem.attack.feasible.vehicles import (
    TOLERANCE,
    Array,
    Flags,
    Indices,
    Turns,
    VehicleBoxes,
    cell_centres,
    footprint_centres,
    to_float64_array,
)
from scene_ir.types import SceneIR


@dataclass(frozen=True, slots=True)
class FeasibilityLimits:
    """What counts as feasible. Where the photographed scene violates a limit, its own value is the limit."""

    strain: tuple[float, float] = (0.7, 1.4)
    """Range of the deformation's singular values."""
    clearance_m: float = 0.05
    """Minimum distance between footprints."""
    road_loss: float = 0.1
    """Share of a footprint that may leave the road."""
    min_height_share: float = 0.6
    """Minimum visible height, as a share of the photographed one."""
    min_area_share: float = 0.2
    """Minimum visible share of a vehicle."""
    in_frame: float = 0.5
    """Minimum share of the image box inside the picture."""
    minimum_px: float = 8.0
    """Minimum width and height of the clipped image box."""
    near_m: float = 1.0
    """Minimum distance from the camera plane."""
    joint_weather: bool = True
    """Whether weather codes are also bounded together, and by what stays visible."""


class MeasuredScene:
    """The fixed parts of a scene that vehicles are measured against: camera, road map, visibility rays."""

    def __init__(self, scene: SceneIR) -> None:
        self.camera, self.road = CameraProjection(scene.camera), RoadMap(scene)
        self.sight = VisibilityRays(scene.camera)


@dataclass(frozen=True, slots=True)
class ConstraintBounds:
    """The smallest allowed measures of N vehicles (of `overlap` the largest), slack included."""

    road: Array
    """(N,), share of the footprint on the road."""
    in_frame: Array
    """(N,), share of the image box inside the picture."""
    near: Array
    """(N,) m, distance from the camera plane."""
    height: Array
    """(N,) px, visible height."""
    area: Array
    """(N,), visible share."""
    size: Array
    """(N, 2) px, width and height of the clipped image box."""
    gap: Array
    """(N, N) m, between footprints; -inf on the diagonal."""
    overlap: Array
    """(N, N) m2, shared by footprints; inf on the diagonal."""

    @classmethod
    def from_rest(cls, scene: MeasuredScene, cars: VehicleBoxes, limits: FeasibilityLimits) -> ConstraintBounds:
        """Bounds relative to the photographed scene.

        Args:
            scene: the scene's measures.
            cars: its vehicles at theta = 0.
            limits: the limits.
        """
        everyone = np.arange(len(cars.turn))
        view = scene.camera.project(cars, everyone)
        road, sight = scene.road.measure_share(view), scene.sight.measure(cars, everyone)
        size = np.minimum(view.size, limits.minimum_px)
        size[:, 1] = np.maximum(size[:, 1], limits.min_height_share * view.size[:, 1])
        gap = footprint_gaps(cars, everyone)
        overlap = np.zeros_like(gap)
        i, j = np.nonzero(gap < 0)
        overlap[i, j] = footprint_overlaps(cars, i, j)
        return cls._with_slack(
            overlap,
            road=road - limits.road_loss,
            in_frame=np.minimum(view.in_frame, limits.in_frame),
            near=np.minimum(view.near, limits.near_m),
            height=limits.min_height_share * sight.height,
            area=np.minimum(sight.area, limits.min_area_share),
            size=size,
            gap=np.minimum(gap, limits.clearance_m),
        )

    @classmethod
    def absolute(cls, count: int, limits: FeasibilityLimits) -> ConstraintBounds:
        """The limits themselves for `count` vehicles, regardless of the photographed scene."""
        return cls._with_slack(
            np.zeros((count, count)),
            road=np.full(count, 1 - limits.road_loss),
            in_frame=np.full(count, limits.in_frame),
            near=np.full(count, limits.near_m),
            height=np.zeros(count),
            area=np.full(count, limits.min_area_share),
            size=np.full((count, 2), limits.minimum_px),
            gap=np.full((count, count), limits.clearance_m),
        )

    @classmethod
    def _with_slack(cls, overlap: Array, **least: Array) -> ConstraintBounds:
        np.fill_diagonal(least["gap"], -np.inf)
        np.fill_diagonal(overlap, np.inf)
        return cls(overlap=overlap + TOLERANCE, **{name: value - TOLERANCE for name, value in least.items()})

    def off_road(self, share: Array, rows: Indices) -> Flags:
        """(M,), whether vehicles `rows` with these road shares (M,) are off the road."""
        return share < self.road[rows]

    def out_of_frame(self, view: VehicleProjections) -> Flags:
        """(M,), whether vehicles are too far out of the picture, too small in it, or too near."""
        rows = view.rows
        small = view.size < self.size[rows]
        return small[:, 0] | small[:, 1] | (view.in_frame < self.in_frame[rows]) | (view.near < self.near[rows])

    def hidden(self, sight: VehicleVisibility) -> Flags:
        """(R,), whether vehicles are hidden too much."""
        return (sight.height < self.height[sight.rows]) | (sight.area < self.area[sight.rows])

    def collide(self, cars: VehicleBoxes, rows: Indices) -> Flags:
        """(M, N), whether the vehicles `rows` collide with each other vehicle."""
        gap = footprint_gaps(cars, rows)
        collide = gap < self.gap[rows]
        # Two footprints that overlapped may overlap more without a deeper gap.
        m, j = np.nonzero((gap < 0) & ~collide & np.isfinite(self.overlap[rows]))
        if len(m):
            collide[m, j] = footprint_overlaps(cars, rows[m], j) > self.overlap[rows[m], j]
        return collide


@dataclass(frozen=True, slots=True)
class ConstraintViolations:
    """Violations among N vehicles."""

    road: Flags
    """(N,), off the road."""
    frame: Flags
    """(N,), out of the picture, too small or too near."""
    hidden: Flags
    """(N,), hidden too much."""
    collide: Flags
    """(N, N), collides with vehicle j."""
    covers: Flags
    """(N, N), vehicle j hides a part of vehicle i."""

    def involved(self) -> Flags:
        """(N,), vehicles that take part in any violation."""
        alone = self.road | self.frame | self.hidden
        return alone | np.logical_or.reduce(self.collide, axis=1) | find_occluders(self.covers, self.hidden)

    def names(self) -> list[str]:
        """The violations by name, such as `objects[3]: collision`."""
        named = {
            "road": self.road,
            "frame": self.frame,
            "visibility": self.hidden,
            "collision": self.collide.any(axis=1),
        }
        return [f"objects[{i}]: {name}" for name, cars in named.items() for i in np.flatnonzero(cars)]


def find_occluders(covers: Flags, hidden: Flags) -> Flags:
    """Vehicles (N,) that hide a part (covers (R, N)) of a vehicle that is hidden (R,) too much."""
    return np.logical_or.reduce(covers & hidden[:, None], axis=0)


def footprint_gaps(cars: VehicleBoxes, rows: Indices) -> Array:
    """Signed gaps (M, N) m between the footprints of vehicles `rows` and of all, by separating axes; negative gaps
    are depths of overlap.
    """
    centre, turn = footprint_centres(cars), cars.turn
    half = 0.5 * (cars.high - cars.low)[:, ::2]
    apart = centre[rows, None] - centre
    # Along and across (M, N, 2): the offset in either frame, and one's axes in the other's frame.
    way = _parts(turn[rows, None] * apart)
    way_there = _parts(turn * apart)
    mixed = _parts(turn[rows, None] * turn.conj())
    mixed_back = mixed[..., ::-1]
    here = way - half[rows, None] - mixed * half[:, :1] - mixed_back * half[:, 1:]
    there = way_there - half - mixed * half[rows, None, :1] - mixed_back * half[rows, None, 1:]
    return np.maximum(here, there).max(axis=2)


def _parts(numbers: Turns) -> Array:
    """Absolute real and imaginary parts (..., 2)."""
    return np.abs(numbers.view(np.float64).reshape(*numbers.shape, 2))


def footprint_overlaps(cars: VehicleBoxes, i: Indices, j: Indices) -> Array:
    """Areas shared by the footprints of pairs of vehicles.

    Args:
        cars: the vehicles.
        i: (K,), first vehicle of each pair.
        j: (K,), second vehicle of each pair.

    Returns:
        (K,) m2.
    """
    half, centre = 0.5 * (cars.high - cars.low), footprint_centres(cars)
    corners = half[:, :1] * [1, 1, -1, -1] + 1j * half[:, 2:] * [1, -1, -1, 1]
    corners = centre[:, None] + cars.turn.conj()[:, None] * corners
    footprint = corners.view(np.float64).reshape(*corners.shape, 2)
    return _shared_area(footprint[i], footprint[j])


def _shared_area(a: Array, b: Array) -> Array:
    """Areas (P,) shared by convex polygons (P, 4, 2) of the same orientation, by Green's theorem."""
    return 0.5 * np.abs(_inside_integral(a, b) + _inside_integral(b, a))


def _inside_integral(a: Array, b: Array) -> Array:
    """Integral (P,) of x dz - z dx along the parts of a's edges that lie inside b (Cyrus and Beck's clipping)."""
    start, along = a, np.roll(a, -1, axis=1) - a
    corner, edge = b, np.roll(b, -1, axis=1) - b
    outline = edge[..., 0] * np.roll(edge, -1, axis=1)[..., 1] - edge[..., 1] * np.roll(edge, -1, axis=1)[..., 0]
    sense = np.sign(outline[:, :1, None])
    relative = start[:, :, None] - corner[:, None]
    distance = sense * (edge[:, None, :, 0] * relative[..., 1] - edge[:, None, :, 1] * relative[..., 0])
    slope = sense * (edge[:, None, :, 0] * along[:, :, None, 1] - edge[:, None, :, 1] * along[:, :, None, 0])
    flat = np.abs(slope) < 1e-12
    cut = -distance / np.where(flat, 1.0, slope)
    enter = np.where(~flat & (slope > 0), cut, 0.0).clip(min=0).max(axis=2)
    leave = np.where(~flat & (slope < 0), cut, 1.0).clip(max=1).min(axis=2)
    inside = (leave > enter) & ~(flat & (distance < 0)).any(axis=2)
    cross = start[..., 0] * along[..., 1] - start[..., 1] * along[..., 0]
    return (np.where(inside, leave - enter, 0.0) * cross).sum(axis=1)


_FOOTPRINT_GRID = (10, 16)
"""Cells along and across a footprint; the road map is sampled at their centres."""
_FOOTPRINT = cell_centres(*_FOOTPRINT_GRID)
"""Sample points (2, P) of a footprint, as shares of its length and width."""


class RoadMap:
    """A scene's road map, sampled under footprints."""

    def __init__(self, scene: SceneIR) -> None:
        self._road = to_float64_array(scene.environment.road).reshape(-1)
        self._width = scene.camera.width
        self._limit = np.array([scene.camera.width - 1.0, scene.camera.height - 1.0])

    def measure_share(self, view: VehicleProjections, rows: Indices | slice = slice(None)) -> Array:
        """Mean of the road map (M,) under the footprints in `rows` of `view`; 1 where fewer than a quarter of a
        footprint's points lie in the image.
        """
        clip = view.corner[rows][:, :, None] + view.edges[rows] @ _FOOTPRINT
        depth = clip[:, 2]
        exact = clip[:, :2] / np.maximum(depth, NEAR_M)[:, None]
        pixels = np.minimum(np.maximum(exact, 0), self._limit[:, None])
        inside = (exact == pixels).all(axis=1) & (depth > NEAR_M)
        cell = np.minimum(pixels, self._limit[:, None] - 1).astype(np.int64)
        across, down = (pixels - cell).swapaxes(0, 1)
        index = cell[:, 1] * self._width + cell[:, 0]
        top, bottom = self._road[index], self._road[index + self._width]
        top = top + across * (self._road[index + 1] - top)
        bottom = bottom + across * (self._road[index + self._width + 1] - bottom)
        count = inside.sum(axis=1)
        share = ((top + down * (bottom - top)) * inside).sum(axis=1) / np.maximum(count, 1)
        return np.where(count * 4 >= inside.shape[1], share, 1.0)
