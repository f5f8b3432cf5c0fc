"""Constraints: limits and violations of road, gaps and overlaps; strain of meshes; combinations of weather codes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from drivesem.attacks.feasible.vehicles import (
    NEAR_M,
    TOLERANCE,
    Array,
    CameraProjection,
    Flags,
    Indices,
    Turns,
    Values,
    VehicleBoxes,
    VehicleProjections,
    VehicleVisibility,
    VisibilityRays,
    cell_centres,
    footprint_centres,
    to_float64_array,
)
from drivesem.attacks.space import ParameterSpace
from scene_ir import ffd
from scene_ir.geometry import height_above_ground, project
from scene_ir.types import LATTICE, SceneIR


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


_STANDS_ON, _SURE_ROAD, _LEVEL_M = 0.5, 0.3, 0.3
"""Share of road, or of grass, from which a person stands on it; how much more makes sure of it; height over the ground
plane up to which ground is level, m."""
_FOOTPRINT_GRID = (10, 16)
"""Cells along and across a footprint; the road map is sampled at their centres."""
_FOOTPRINT = cell_centres(*_FOOTPRINT_GRID)
"""Sample points (2, P) of a footprint, as shares of its length and width."""


class RoadMap:
    """The road of a scene, sampled under footprints. People and cyclists off the road have the level ground there in
    its place; those that do not stand on grass, without what is green: it may be a bush.
    """

    def __init__(self, scene: SceneIR) -> None:
        road, upright = to_float64_array(scene.environment.road), scene.objects.upright.cpu().numpy()
        maps, kind = [road], np.zeros(len(upright), np.int64)
        if upright.any():
            foliage = to_float64_array(scene.environment.foliage_map)
            level = _level_ground(scene) * (1 - np.clip((road - _STANDS_ON) / _SURE_ROAD, 0, 1))
            maps += [level * (1 - foliage), level]
            on_road, on_grass = (_sample_feet(values, scene) >= _STANDS_ON for values in (road, foliage))
            kind = np.where(upright & ~on_road, 1 + on_grass, 0)
        self._road = np.concatenate([one.reshape(-1) for one in maps])
        self._start = kind * road.size
        self._width = scene.camera.width
        self._limit = np.array([scene.camera.width - 1.0, scene.camera.height - 1.0])

    def measure_share(self, view: VehicleProjections, rows: Indices | slice = slice(None)) -> Array:
        """Mean of the map (M,) under the footprints in `rows` of `view`; 1 where fewer than a quarter of a
        footprint's points lie in the image.
        """
        clip = view.corner[rows][:, :, None] + view.edges[rows] @ _FOOTPRINT
        depth = clip[:, 2]
        exact = clip[:, :2] / np.maximum(depth, NEAR_M)[:, None]
        pixels = np.minimum(np.maximum(exact, 0), self._limit[:, None])
        inside = (exact == pixels).all(axis=1) & (depth > NEAR_M)
        cell = np.minimum(pixels, self._limit[:, None] - 1).astype(np.int64)
        across, down = (pixels - cell).swapaxes(0, 1)
        index = cell[:, 1] * self._width + cell[:, 0] + self._start[view.rows[rows], None]
        top, bottom = self._road[index], self._road[index + self._width]
        top = top + across * (self._road[index + 1] - top)
        bottom = bottom + across * (self._road[index + self._width + 1] - bottom)
        count = inside.sum(axis=1)
        share = ((top + down * (bottom - top)) * inside).sum(axis=1) / np.maximum(count, 1)
        return np.where(count * 4 >= inside.shape[1], share, 1.0)


def _sample_feet(values: Array, scene: SceneIR) -> Array:
    """Values (N,) of a map (H, W) at the pixels where objects meet the ground."""
    matrix = scene.camera.matrix.to(scene.objects.translation)
    pixels = project(scene.objects.translation, matrix).detach().cpu().round().long()
    columns, rows = (pixels[:, k].clamp(0, n - 1) for k, n in enumerate((values.shape[1], values.shape[0])))
    return values[rows.numpy(), columns.numpy()]


def _level_ground(scene: SceneIR) -> Array:
    """Pixels (H, W), 0 or 1, at which the background is level ground, not a wall or the like in front of it."""
    ground, matrix = scene.environment.ground, scene.camera.matrix
    height_m = to_float64_array(height_above_ground(scene.depth, ground, matrix))
    return (np.abs(height_m) < _LEVEL_M).astype(np.float64)


_STRAIN_GRID = (5, 5, 5)
"""Grid points of the unit box at which strain is bounded; the independent check uses a finer grid."""


class StrainBound:
    """Bounds on the deformation of N vehicles: singular values, determinant of its Jacobian, nothing below y = 0.

    All is measured at P points of the unit box. A bound that a vehicle violates at theta = 0 is widened to its
    value there; `violated_at_start` (N,) lists those vehicles.
    """

    def __init__(self, source: Array, strain: tuple[float, float]) -> None:
        axes = [np.linspace(0, 1, n) for n in _STRAIN_GRID]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) - [0.5, 1.0, 0.5]
        mirrored = source.reshape(-1, *LATTICE, 3)[:, :, :, ::-1] * [1.0, 1.0, -1.0]
        if np.array_equal(mirrored.reshape(source.shape), source):
            grid = grid[grid[:, 2] <= 0]  # codes are symmetric: left and right are strained equally
        unit, start = torch.from_numpy(grid), torch.from_numpy(source)
        # Jacobian and height are linear in the codes: one matrix (96, 10 P).
        basis = ffd.from_symmetric(torch.eye(ffd.SYMMETRIC_DIM, dtype=torch.float64))
        weights, rest = ffd.lattice_weights(unit), torch.eye(3, dtype=torch.float64)
        self._linear = _jacobian_and_height(ffd.jacobian(unit, basis) - rest, (weights @ basis)[..., 1])
        self._linear = self._linear.reshape(ffd.SYMMETRIC_DIM, -1)
        jacobian, height = ffd.jacobian(unit, start), unit[:, 1] + (weights @ start)[..., 1]
        self._start = _jacobian_and_height(jacobian, height)
        values = np.linalg.svd(jacobian.numpy(), compute_uv=False)
        self._smallest, largest = values.min(axis=2), values.max(axis=2)
        self._inverted = (np.linalg.det(jacobian.numpy()) <= 0).any(axis=1)
        deepest = height.numpy().max(axis=1)
        self.violated_at_start: Flags = (
            (self._smallest.min(axis=1) < strain[0] - TOLERANCE)
            | (largest.max(axis=1) > strain[1] + TOLERANCE)
            | (deepest > TOLERANCE)
            | self._inverted
        )
        self._low = np.minimum(strain[0], self._smallest.min(axis=1)) - TOLERANCE
        self._high = np.maximum(strain[1], largest.max(axis=1)) + TOLERANCE
        self._floor = np.maximum(0.0, deepest) + TOLERANCE
        # A Jacobian that changes by less, in the Frobenius norm, stays within the bounds (Weyl's inequality).
        self._room = np.minimum(self._smallest - self._low[:, None], self._high[:, None] - largest)

    def change(self, mesh: Values) -> Array:
        """Change (N, 10, P) of Jacobian and height under mesh codes (N, 96)."""
        return (mesh @ self._linear).reshape(len(mesh), 10, -1)

    def path(self, change: Array, cars: Flags, slack: float = 0.0) -> _StrainPath:
        """The straight path from theta = 0 to a strain change.

        Args:
            change: (N, 10, P), as `change` returns it.
            cars: (N,), the vehicles in question.
            slack: by how much the bounds are tightened.
        """
        slopes = change[:, :9]
        norm = np.sqrt(np.einsum("ncp,ncp->np", slopes, slopes))
        owner, point = np.nonzero((norm >= self._room - slack) & cars[:, None])
        low, high = self._low[owner] + slack, self._high[owner] - slack
        # Only beyond the smallest singular value can a point turn inside out.
        flips = (norm[owner, point] >= self._smallest[owner, point]) & ~self._inverted[owner]
        return _StrainPath(
            owner=owner,
            start=self._start[owner, :9, point].T.copy(),
            slope=slopes[owner, :, point].T.copy(),
            bounds=np.stack([low * np.abs(low), high * high])[:, None],
            flips=np.flatnonzero(flips),
            height=self._start[:, 9],
            rise=change[:, 9] * cars[:, None],
            floor=self._floor - slack,
        )


@dataclass(frozen=True, slots=True)
class _StrainPath:
    """Strain of N vehicles on the straight path from theta = 0 to a mesh code, at the K points that could violate
    it.
    """

    owner: Indices
    """(K,), the vehicle of each point."""
    start: Array
    """(9, K), Jacobian at theta = 0."""
    slope: Array
    """(9, K), change of the Jacobian along the path."""
    bounds: Array
    """(2, 1, K), smallest and largest square of a singular value."""
    flips: Indices
    """Points that could turn inside out."""
    height: Array
    """(N, P), height of all points at theta = 0, in unit boxes, y down."""
    rise: Array
    """(N, P), change of the height along the path."""
    floor: Array
    """(N,), largest allowed height."""

    def violated_at(self, scale: Array) -> Flags:
        """(N,), which vehicles are out of bounds at scales (N,) of the path.

        Singular values lie in [low, high] where J J' - low^2 is positive definite and J J' - high^2 negative
        definite. Leading minors decide that (Sylvester) at a tenth of the cost of a singular value decomposition.
        """
        wrong: Flags = (self.height + scale[:, None] * self.rise).max(axis=1) > self.floor
        jacobian = (self.start + scale[self.owner] * self.slope).reshape(3, 3, -1)
        # Dot products of the rows: 0 0, 1 1, 2 2, and 0 1, 1 2, 2 0.
        squares, (g01, g12, g20) = (jacobian**2).sum(axis=1), (jacobian * jacobian[[1, 2, 0]]).sum(axis=1)
        diagonal = squares - self.bounds
        d0, d1, d2 = diagonal[:, 0], diagonal[:, 1], diagonal[:, 2]
        minor01, minor02, mixed = d0 * d1 - g01 * g01, d0 * d2 - g20 * g20, d0 * g12 - g01 * g20
        # The determinant times d0, which has its sign where the matrix is definite.
        determinant = minor01 * minor02 - mixed * mixed
        good = ((minor01 > 0) & (determinant > 0)).all(axis=0) & (d0[0] > 0) & (d0[1] < 0)
        wrong[self.owner[~good]] = True
        if len(self.flips):
            flipped = np.linalg.det(jacobian[:, :, self.flips].transpose(2, 0, 1)) <= 0
            wrong[self.owner[self.flips[flipped]]] = True
        return wrong


def _jacobian_and_height(jacobian: Tensor, height: Tensor) -> Array:
    """Jacobian (N, P, 3, 3) and height (N, P) as (N, 10, P)."""
    parts = [jacobian.flatten(2), height[..., None]]
    return np.ascontiguousarray(torch.cat(parts, dim=2).transpose(1, 2).numpy())


FindInvisible = Callable[[Array], Flags]
"""Which objects (N,) are no longer visible under weather codes (6,)."""

_DUSK = math.log10(15_000 / 3.4)
"""Decades of illuminance (lx) from daylight (10,000 to 20,000 without direct sun) to the end of civil twilight,
until which one sees without lamps; beyond it, lamps replace daylight (the code of night). Illuminances, here and
below, are from the RCA Electro-Optics Handbook (1974) and Schlyter's Radiometry and photometry in astronomy."""
_COVER = math.log10(400 / 40)
"""Decades that a closed cloud cover absorbs. Fog is a cloud cover on the ground."""
_STORM = math.log10(2_000 / 200)
"""Decades by which the clouds of strong rain are darker than other clouds."""
_BRIGHT_RAIN = 0.5
"""Maximum rain from a sky no more covered than in the photograph: showers in sunshine are light to moderate,
strong rain needs deep, wide clouds (WMO, International Cloud Atlas: nimbostratus, cumulonimbus)."""
CODE_SUMS = np.array(
    [
        # Drops of rain wash those of fog out of the air, the faster the stronger it rains; fog in rain forms where
        # weak rain evaporates into cold air (AMS Glossary of Meteorology: washout, precipitation fog). Snow gathers
        # them likewise, and is snow or rain by the temperature.
        [1.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        [0.0, 1.0, 0.0, -1.0, 0.0, 0.0],
        [_COVER / _DUSK, _STORM / _DUSK, 1.0, _COVER / _DUSK, 0.0, _COVER / _DUSK],
        # The glow of dusk ends as night falls.
        [0.0, 0.0, 1.0, 0.0, 1.0, 0.0],
    ]
)
"""Sums (4, 6) of the codes of `Weather`."""
CODE_SUM_LIMITS = np.array([1.0, _BRIGHT_RAIN, 1.0, 1.0])
"""Upper limits (4,) of CODE_SUMS."""
RULE_NAMES = ("fog in rain or snow", "rain without cover", "dark", "dusk at night")
_HALVINGS = 5
"""Bisection steps of the visibility limit, to 1/32 of a change."""


class WeatherSet:
    """The feasible weather of one scene: a convex set of codes, restricted to those that keep vehicles visible."""

    def __init__(
        self, space: ParameterSpace, where: slice, joint: bool, find_invisible: FindInvisible | None
    ) -> None:
        """Prepare the set.

        Args:
            space: the scene's parameter space.
            where: the weather block of theta.
            joint: whether the codes are bounded together.
            find_invisible: which objects are no longer visible under which codes; None: all stay visible.
        """
        self._where, self._find_invisible = where, find_invisible
        self._start = to_float64_array(space.scene.environment.weather)
        self._sums = CODE_SUMS[:, : where.stop - where.start]
        self._lower, self._upper = to_float64_array(space.lower)[where], to_float64_array(space.upper)[where]
        # Sums that the photographed scene already exceeds may only not grow.
        self._room = (
            np.maximum(CODE_SUM_LIMITS - CODE_SUMS @ self._start, 0.0)
            if joint
            else np.full(len(CODE_SUM_LIMITS), np.inf)
        )

    def violations(self, values: Values) -> list[str]:
        """Violations of theta (D,), which is inside its bounds, such as `weather: dark`."""
        change = values[self._where].astype(np.float64)
        return [f"weather: {RULE_NAMES[k]}" for k in np.flatnonzero(self._exceeded(change))] + self._invisible(
            change
        )

    def project(self, values: Values, unclipped: Values) -> list[str]:
        """Move theta into the set, in place: first to the nearest codes that occur together, then towards the
        photograph until all vehicles are visible.

        Args:
            values: theta (D,), inside its bounds.
            unclipped: theta (D,) before it was clipped to its bounds; the nearest codes are nearest to it.

        Returns:
            The active constraints.
        """
        change = values[self._where]
        active = [f"weather: {RULE_NAMES[k]}" for k in np.flatnonzero(self._exceeded(change.astype(np.float64)))]
        if active:
            change[:] = np.clip(
                self._find_nearest(unclipped[self._where].astype(np.float64)), self._lower, self._upper
            )
        invisible = self._invisible(change.astype(np.float64))
        if invisible:
            goal, low, high = change.copy(), 0.0, 1.0
            for _ in range(_HALVINGS):
                middle = 0.5 * (low + high)
                # Test what is returned: codes rounded as theta is.
                change[:] = goal * middle
                low, high = (low, middle) if self._invisible(change.astype(np.float64)) else (middle, high)
            change[:] = goal * low
        return active + invisible

    def _exceeded(self, change: Array) -> Flags:
        """(4,), which of CODE_SUMS exceed their limits."""
        return self._sums @ change > self._room + TOLERANCE

    def _invisible(self, change: Array) -> list[str]:
        if self._find_invisible is None or not change.any():
            return []
        codes = self._start + np.pad(change, (0, len(self._start) - len(change)))
        return [f"objects[{i}]: contrast" for i in np.flatnonzero(self._find_invisible(codes))]

    def _find_nearest(self, codes: Array) -> Array:
        """The point of the set nearest to codes (4,), (5,) or (6,), exactly: the distance to a polyhedron by
        non-negative least squares (Lawson and Hanson 1974, chapter 23).
        """
        axes = np.eye(len(codes))
        rows = np.concatenate([-self._sums, axes, -axes])
        offsets = np.concatenate([-self._room, self._lower, -self._upper]) - rows @ codes
        system, target = np.vstack([rows.T, offsets]), np.append(np.zeros(len(codes)), 1.0)
        residual = system @ nnls(system, target)[0] - target
        return codes - residual[:-1] / residual[-1]
