"""What counts as feasible, what is asked of the cars of one scene, and who does not keep it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivesem.attack.feasible.cars import TOLERANCE, Array, Cars, Flags, Indices
from drivesem.attack.feasible.collisions import gap_between, shared_ground
from drivesem.attack.feasible.ground import RoadMap
from drivesem.attack.feasible.picture import CameraView, CarViews
from drivesem.attack.feasible.sight import CarSights, LinesOfSight
from scene_ir.types import SceneIR


@dataclass(frozen=True, slots=True)
class Limits:
    """What counts as feasible. strain: range of the deformation's singular values; clearance_m: between
    footprints; road_loss: share of a footprint that may leave the road; height_kept: visible height, as a share
    of the start's; area_kept, in_frame: least visible and least unclipped share of a car's image box (or the
    start's); minimum_px: least width and height of the clipped box; near_m: least distance from the camera plane;
    joint_weather: whether weather codes are bounded together.
    """

    strain: tuple[float, float] = (0.7, 1.4)
    clearance_m: float = 0.05
    road_loss: float = 0.1
    height_kept: float = 0.6
    area_kept: float = 0.2
    in_frame: float = 0.5
    minimum_px: float = 8.0
    near_m: float = 1.0
    joint_weather: bool = True


class Surroundings:
    """What stands still in a scene, as cars are measured against it."""

    def __init__(self, scene: SceneIR) -> None:
        self.camera, self.road, self.sight = CameraView(scene.camera), RoadMap(scene), LinesOfSight(scene.camera)


@dataclass(frozen=True, slots=True)
class Bounds:
    """The least (and of `overlap`, the greatest) measures that are no violation, each with its slack.

    road, in_frame, near, height, area (N,); size (N, 2) px; gap, overlap (N, N): never violated on the diagonal.
    """

    road: Array
    in_frame: Array
    near: Array
    height: Array
    area: Array
    size: Array
    gap: Array
    overlap: Array

    @classmethod
    def around(cls, surroundings: Surroundings, cars: Cars, limits: Limits) -> Bounds:
        """What is asked of cars that stand like this at theta = 0."""
        everyone = np.arange(len(cars.turn))
        view = surroundings.camera.of(cars, everyone)
        road, sight = surroundings.road.share(view), surroundings.sight.of(cars, everyone)
        size = np.minimum(view.size, limits.minimum_px)
        size[:, 1] = np.maximum(size[:, 1], limits.height_kept * view.size[:, 1])
        gap = gap_between(cars, everyone)
        overlap = np.zeros_like(gap)
        i, j = np.nonzero(gap < 0)
        overlap[i, j] = shared_ground(cars, i, j)
        return cls._with_slack(
            overlap,
            road=road - limits.road_loss,
            in_frame=np.minimum(view.in_frame, limits.in_frame),
            near=np.minimum(view.near, limits.near_m),
            height=limits.height_kept * sight.height,
            area=np.minimum(sight.area, limits.area_kept),
            size=size,
            gap=np.minimum(gap, limits.clearance_m),
        )

    @classmethod
    def alike(cls, count: int, limits: Limits) -> Bounds:
        """What is asked of `count` cars wherever they stood before."""
        return cls._with_slack(
            np.zeros((count, count)),
            road=np.full(count, 1 - limits.road_loss),
            in_frame=np.full(count, limits.in_frame),
            near=np.full(count, limits.near_m),
            height=np.zeros(count),
            area=np.full(count, limits.area_kept),
            size=np.full((count, 2), limits.minimum_px),
            gap=np.full((count, count), limits.clearance_m),
        )

    @classmethod
    def _with_slack(cls, overlap: Array, **least: Array) -> Bounds:
        np.fill_diagonal(least["gap"], -np.inf)
        np.fill_diagonal(overlap, np.inf)
        return cls(overlap=overlap + TOLERANCE, **{name: value - TOLERANCE for name, value in least.items()})

    def off_road(self, share: Array, rows: Indices) -> Flags:
        """(M,) of road shares (M,) of the cars `rows`."""
        return share < self.road[rows]

    def out_of_frame(self, view: CarViews) -> Flags:
        """(M,): too far out of the picture, too small in it, or too near."""
        rows = view.rows
        small = view.size < self.size[rows]
        return small[:, 0] | small[:, 1] | (view.in_frame < self.in_frame[rows]) | (view.near < self.near[rows])

    def hidden(self, sight: CarSights) -> Flags:
        """(R,): too much behind others."""
        return (sight.height < self.height[sight.rows]) | (sight.area < self.area[sight.rows])

    def collide(self, cars: Cars, rows: Indices) -> Flags:
        """(M, N): the cars `rows` with all others."""
        gap = gap_between(cars, rows)
        collide = gap < self.gap[rows]
        # No nearer than before, yet two that overlapped may overlap more.
        m, j = np.nonzero((gap < 0) & ~collide & np.isfinite(self.overlap[rows]))
        if len(m):
            collide[m, j] = shared_ground(cars, rows[m], j) > self.overlap[rows[m], j]
        return collide


@dataclass(frozen=True, slots=True)
class Violations:
    """Violations among N cars. road, frame, hidden (N,); collide, covers (N, N): car j hides a part of car i."""

    road: Flags
    frame: Flags
    hidden: Flags
    collide: Flags
    covers: Flags

    def cars(self) -> Flags:
        """Cars (N,) that take part in any violation."""
        alone = self.road | self.frame | self.hidden
        return alone | np.logical_or.reduce(self.collide, axis=1) | coverers(self.covers, self.hidden)

    def names(self) -> list[str]:
        """`objects[3]: collision` and the like, of all that is violated."""
        named = {
            "road": self.road,
            "frame": self.frame,
            "visibility": self.hidden,
            "collision": self.collide.any(axis=1),
        }
        return [f"objects[{i}]: {name}" for name, cars in named.items() for i in np.flatnonzero(cars)]


def coverers(covers: Flags, hidden: Flags) -> Flags:
    """Cars (N,) that hide a part of one that is hidden (R,) too much. covers (R, N): car j hides a part of it."""
    return np.logical_or.reduce(covers & hidden[:, None], axis=0)
