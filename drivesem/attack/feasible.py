"""The way back to what can be: after every step of an attack, theta is projected onto the feasible set.

Feasible means: inside the bounds; the mesh is not inverted and only moderately strained, its lowest lattice layer
fixed vertically, nothing below its wheels; cars stay on the kind of surface they stood on, do not pass through
each other, and stay in the picture and visible. No constraint may be violated more than at theta = 0 (real labels
overlap and park on kerbs), so theta = 0 is always feasible. The pose stays on the ground plane by construction of
`ParameterSpace.apply`.

`drivesem.attack.feasibility_check` judges finished scenes a second time and shares no code with this module.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from drivesem.attack.space import Parameter, ParameterSpace, ground_axes
from scene_ir import ffd
from scene_ir.errors import RangeError
from scene_ir.types import LATTICE, LATTICE_POINTS, Mesh, SceneIR

Array = NDArray[np.float64]
Values = NDArray[np.floating[Any]]
"""Of theta's own dtype, float32 or float64."""
Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]
Turns = NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class Limits:
    """What counts as feasible. strain: range of the deformation's singular values; clearance_m: between
    footprints; road_loss: share of a footprint that may leave the road; height_kept: visible height, as a share
    of the start's; area_kept, in_frame: least visible and least unclipped share of a car's image box (or the
    start's); minimum_px: least width and height of the clipped box; near_m: least distance from the camera plane.
    """

    strain: tuple[float, float] = (0.7, 1.4)
    clearance_m: float = 0.05
    road_loss: float = 0.1
    height_kept: float = 0.6
    area_kept: float = 0.2
    in_frame: float = 0.5
    minimum_px: float = 8.0
    near_m: float = 1.0


@dataclass(frozen=True, slots=True)
class Projected:
    """theta (D,) in the feasible set, and the constraints that held it back, such as `objects[3]: collision`."""

    theta: Tensor
    active: tuple[str, ...]


_BLOCKS = (Parameter.MESH, Parameter.ROTATE, Parameter.TRANSLATE)
_HALVINGS = 5
"""Bisection steps a block: the scale of a block is found to 1/32."""
_TOLERANCE = 1e-6
"""Slack of every comparison (m, m2, shares, strain), far above rounding and far below what matters."""
_FOOTPRINT_GRID = (10, 16)
"""Cells along and across a footprint in whose centres the road map is read."""
_RAY_ROWS, _RAY_COLUMNS = 10, 6
"""Rows and columns of an image box through which rays are sent to see what hides a car."""
_STRAIN_GRID = (5, 5, 5)
"""Points of the unit box at which the strain is bounded; the independent check uses a finer grid."""
_SURFACE_POINTS = 160
"""At most this many mesh vertices, besides the convex hull's, carry a car's extents."""
_SLICE = LATTICE[1] * LATTICE[2]
"""Lattice points in a slice across the length."""
_NEAR_M = 0.1
"""Points nearer to the camera plane are projected as if they lay there."""


@dataclass(slots=True)
class _Cars:
    """N cars as they stand, changed in place. low, high (N, 3) m: bounds of the deformed car in its own frame;
    turn (N,): cos(yaw) + i sin(yaw); translation (N, 3) m. Found by `_Street.see`: box (N, 4) px, clipped;
    near, far (N,) m: least and largest distance of the bounds from the camera plane.
    """

    low: Array
    high: Array
    turn: Turns
    translation: Array
    box: Array
    near: Array
    far: Array

    @classmethod
    def of(cls, low: Array, high: Array, yaw: Array, translation: Array) -> _Cars:
        n = len(yaw)
        return cls(low, high, _turn(yaw), translation, np.zeros((n, 4)), np.zeros(n), np.zeros(n))


@dataclass(frozen=True, slots=True)
class _Sight:
    """What is seen of some cars. rows (R,): which; height (R,) px visible; area (R,): visible share;
    covers (R, N): car j hides a part of the car.
    """

    rows: Indices
    height: Array
    area: Array
    covers: Flags


@dataclass(frozen=True, slots=True)
class _View:
    """How the M cars `rows` lie in the picture. in_frame (M,): share of the image box inside; size (M, 2) px of
    the clipped box; near (M,) m; corner (M, 3), edges (M, 3, 2): of the footprint, in clip space.
    """

    rows: Indices
    in_frame: Array
    size: Array
    near: Array
    corner: Array
    edges: Array


@dataclass(frozen=True, slots=True)
class _Found:
    """Violations among N cars. road, frame, hidden (N,); collide, covers (N, N): car j hides a part of car i."""

    road: Flags
    frame: Flags
    hidden: Flags
    collide: Flags
    covers: Flags

    def cars(self) -> Flags:
        """Cars (N,) that take part in any violation."""
        alone = self.road | self.frame | self.hidden
        return alone | np.logical_or.reduce(self.collide, axis=1) | _coverers(self.covers, self.hidden)

    def names(self) -> list[str]:
        """`objects[3]: collision` and the like, of all that is violated."""
        named = {
            "road": self.road,
            "frame": self.frame,
            "visibility": self.hidden,
            "collision": self.collide.any(axis=1),
        }
        return [f"objects[{i}]: {name}" for name, cars in named.items() for i in np.flatnonzero(cars)]


class FeasibleSet:
    """The feasible set of one scene's `ParameterSpace`; prepared once, then `project` takes a millisecond."""

    def __init__(self, space: ParameterSpace, limits: Limits | None = None) -> None:
        self.space = space
        self.limits = limits or Limits()
        objects = space.scene.objects
        self._lower = _array(space.lower)
        self._upper = _array(space.upper)
        if space.count == 0:
            return
        self._translation = _array(objects.translation)
        self._yaw = _array(objects.yaw)
        ground = space.scene.environment.ground.detach().cpu().double()
        length_m = objects.size_lhw[:, 0].detach().cpu().double()
        # (N, 2, 3): what one own length along and one across move.
        self._shift = _array(ground_axes(objects.yaw.detach().cpu().double(), length_m, ground))
        self._surface = _Surface(space.scene)
        self._strain = _StrainBound(self._surface.offsets, self.limits.strain)
        self._street = _Street(space.scene)
        low, high = _extents(self._surface.rest)
        cars = _Cars.of(low, high, self._yaw, self._translation)
        self._everyone = np.arange(space.count)
        self._bounds = _Bounds.around(self._street, cars, self.limits)

    @property
    def violated_at_start(self) -> tuple[str, ...]:
        """What theta = 0 violates, as `objects[3]: collision`: labels that overlap (or leave less than the
        clearance), cars off the road, out of the picture or too small in it, hidden by others, fits that are
        strained. Such a start is kept, and may only not get worse.
        """
        if self.space.count == 0:
            return ()
        strained = [f"objects[{i}]: strain" for i in np.flatnonzero(self._strain.violated_at_start)]
        low, high = _extents(self._surface.rest)
        cars = _Cars.of(low, high, self._yaw, self._translation)
        asked = _Bounds.alike(self.space.count, self.limits)
        return (*strained, *self._examine(cars, asked).names())

    def project(self, theta: Tensor) -> Projected:
        """The nearest feasible theta (D,) we can find; `theta` itself where it is feasible.

        Deterministic and idempotent. First the bounds, then the strain of each mesh, scaled back car by car; then
        the cars that violate something go back to the photograph and take mesh, rotation and translation up again,
        each as far as all constraints allow. Raises ShapeError; RangeError naming a coordinate that is not finite.
        """
        self.space.unflatten(theta)
        values = theta.detach().cpu().numpy()
        finite = np.isfinite(values)
        if not finite.all():
            i = int(np.flatnonzero(~finite)[0])
            raise RangeError(f"theta: {self.space.name(i)}", "a finite value", float(values[i]))
        result, active = self._project(values)
        # theta0 and the like carry the dtype and device of the scene.
        return Projected(torch.from_numpy(result).to(theta), tuple(active))

    def violations(self, theta: Tensor) -> tuple[str, ...]:
        """What theta (D,) violates, as `objects[3]: collision`; empty where it is feasible."""
        values = theta.detach().cpu().numpy()
        found = self._out_of_bounds(values, self._box(values))
        if self.space.count == 0:
            return tuple(found)
        mesh = self._block(values, Parameter.MESH)
        if mesh is not None:
            found += [f"objects[{i}]: lowest layer" for i in np.flatnonzero((_lowest(mesh) != 0).any(axis=(1, 2)))]
            wrong = self._strained(self._strain.change(mesh))
            found += [f"objects[{i}]: strain" for i in np.flatnonzero(wrong)]
        surface = None if mesh is None else self._surface.deformed(mesh)
        return tuple(found + self._examine(self._cars(values, surface), self._bounds).names())

    def _project(self, values: Values) -> tuple[Values, list[str]]:
        boxed = self._box(values)
        active = self._out_of_bounds(values, boxed)
        if self.space.count == 0:
            return boxed, active
        mesh, surface = self._block(boxed, Parameter.MESH), None
        if mesh is not None:
            _lowest(mesh)[:] = 0
            active += [f"objects[{i}]: strain" for i in np.flatnonzero(self._bound_strain(mesh))]
            surface = self._surface.deformed(mesh)
        cars = self._cars(boxed, surface)
        found = self._examine(cars, self._bounds)
        offenders = found.cars()
        if offenders.any():
            active += found.names()
            self._back_off(cars, boxed, surface, offenders)
        return boxed, active

    def _box(self, values: Values) -> Values:
        return np.minimum(np.maximum(values, self._lower), self._upper).astype(values.dtype)

    def _out_of_bounds(self, values: Values, boxed: Values) -> list[str]:
        return [f"{self.space.name(int(i))}: bounds" for i in np.flatnonzero(boxed != values)]

    def _block(self, values: Values, parameter: Parameter) -> Values | None:
        """theta's block of one parameter of cars, (N, size), a view; None where it is held."""
        where = self.space.slice_of(parameter)
        return None if where is None else values[where].reshape(self.space.count, -1)

    def _bound_strain(self, mesh: Values) -> Flags:
        """Scale each car's mesh offsets (N, 96) back, in place, until its strain holds; returns who was scaled."""
        change, full = self._strain.change(mesh), np.ones(len(mesh))
        wrong = self._strained(change)
        if not wrong.any():
            return wrong
        path = self._strain.path(change, wrong, 0.5 * _TOLERANCE)
        low, high = np.zeros_like(full), full
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            good = ~path.wrong_at(middle)
            low, high = np.where(good, middle, low), np.where(good, high, middle)
        mesh[wrong] = (mesh * low[:, None]).astype(mesh.dtype)[wrong]
        return wrong

    def _strained(self, change: Array) -> Flags:
        """Whose strain (N,) a change (N, 10, P) of it does not keep."""
        everyone = np.ones(self.space.count)
        return self._strain.path(change, everyone > 0).wrong_at(everyone)

    def _cars(self, values: Values, surface: Array | None) -> _Cars:
        """The cars at theta; `surface`: their deformed points, None where they are as photographed."""
        rotate, translate = self._block(values, Parameter.ROTATE), self._block(values, Parameter.TRANSLATE)
        low, high = _extents(self._surface.rest if surface is None else surface)
        yaw = self._yaw if rotate is None else self._yaw + rotate[:, 0]
        translation = self._translation if translate is None else self._moved(translate, slice(None))
        return _Cars.of(low, high, yaw, translation.copy())

    def _moved(self, translate: Values, rows: Indices | slice) -> Array:
        """Where cars `rows` are (M, 3) m, moved by own lengths (M, 2)."""
        shift = self._shift[rows]
        return self._translation[rows] + translate[:, :1] * shift[:, 0] + translate[:, 1:] * shift[:, 1]

    def _examine(self, cars: _Cars, bounds: _Bounds) -> _Found:
        """All that the cars violate."""
        street = self._street
        view = street.view(cars, self._everyone)
        sight = street.sight(cars, self._everyone)
        return _Found(
            road=bounds.off_road(street.road_share(view.corner, view.edges), self._everyone),
            frame=bounds.out_of_frame(view),
            hidden=bounds.hidden(sight),
            collide=bounds.collide(cars, self._everyone),
            covers=sight.covers,
        )

    def _wrong(self, cars: _Cars, moved: Indices, offenders: Flags) -> Flags:
        """Which of the offenders (N,) take part in a violation, after some of them moved and none was before."""
        street, bounds = self._street, self._bounds
        view = street.view(cars, moved)
        wrong = np.zeros(len(offenders), dtype=bool)
        wrong[moved] = bounds.out_of_frame(view)
        collide = bounds.collide(cars, moved)
        wrong |= np.logical_or.reduce(collide, axis=0)
        wrong[moved] |= np.logical_or.reduce(collide, axis=1)
        # What is known to be wrong need not be looked at further, as long as it draws no other car in.
        left = np.flatnonzero(~wrong[moved] & (bounds.road[moved] > 0))
        if len(left):
            road = street.road_share(view.corner[left], view.edges[left])
            wrong[moved[left]] = bounds.off_road(road, moved[left])
        if (wrong | ~offenders).all():
            return wrong & offenders
        sight = street.sight(cars, moved)
        hidden = bounds.hidden(sight)
        wrong[sight.rows[hidden]] = True
        return (wrong | _coverers(sight.covers, hidden)) & offenders

    def _back_off(self, cars: _Cars, values: Values, surface: Array | None, offenders: Flags) -> None:
        """Make values feasible, in place: offenders go back to 0 and take each block up again as far as everything
        allows. Where an offender at 0 is still hit by a car that moved, that car is an offender too.
        """
        rest, everyone = self._surface.rest, np.ones_like(offenders)
        while True:
            rows = np.flatnonzero(offenders)
            cars.low[rows], cars.high[rows] = _extents(rest[rows])
            cars.turn[rows], cars.translation[rows] = _turn(self._yaw[rows]), self._translation[rows]
            if offenders.all():
                break
            joined = offenders | self._wrong(cars, rows, everyone)
            if joined.sum() == len(rows):
                break
            offenders = joined
        if surface is not None:
            self._take_up_mesh(cars, values, surface, offenders)
        rotate, translate = self._block(values, Parameter.ROTATE), self._block(values, Parameter.TRANSLATE)
        if rotate is not None:

            def turn(moved: Indices) -> None:
                cars.turn[moved] = _turn(self._yaw[moved] + rotate[moved, 0])

            self._take_up(cars, offenders, rotate, turn)
        if translate is not None:
            # A kerb stops a car across its heading, not along: the two are found one after the other.
            for column in range(2):
                start = cars.translation.copy()

                def move(moved: Indices, start: Array = start, column: int = column) -> None:
                    shift = self._shift[moved, column]
                    cars.translation[moved] = start[moved] + translate[moved, column, None] * shift

                self._take_up(cars, offenders, translate[:, column : column + 1], move)

    def _take_up_mesh(self, cars: _Cars, values: Values, surface: Array, offenders: Flags) -> None:
        """Bring the offenders' mesh up from 0 to what `values` hold, in place, as far as is feasible.

        surface: the points (N, 3, K) at those values. Between, both they and the strain go along straight lines.
        """
        mesh = self._block(values, Parameter.MESH)
        assert mesh is not None
        goal, rest = mesh.copy(), self._surface.rest
        path = self._strain.path(self._strain.change(mesh), offenders, 0.5 * _TOLERANCE)

        def wrong_at(moved: Indices, scale: Array) -> Flags:
            part = scale[moved, None, None]
            cars.low[moved], cars.high[moved] = _extents(rest[moved] * (1 - part) + surface[moved] * part)
            wrong = self._wrong(cars, moved, offenders)
            # The feasible scales of a strain need not be an interval; at 1 it is known to hold.
            return wrong | (path.wrong_at(scale) & (scale < 1) & offenders)

        def settle(moved: Indices, scale: Array, known: bool) -> Flags:
            del known  # theta's rounding, which the straight line leaves out, may tip what a ray sees
            mesh[moved] = goal[moved] * scale[moved, None]
            cars.low[moved], cars.high[moved] = _extents(self._surface.deformed(mesh[moved], moved))
            return self._wrong(cars, moved, offenders)

        if goal[offenders].any():
            _largest_scales(wrong_at, settle, offenders)

    def _take_up(self, cars: _Cars, offenders: Flags, block: Values, follow: Callable[[Indices], None]) -> None:
        """Bring the offenders' columns `block` (N, k) up from 0 to what they hold, in place, while feasible.

        follow: moves cars to where their block says.
        """
        goal = block.copy()

        def wrong_at(moved: Indices, scale: Array) -> Flags:
            return settle(moved, scale, False)

        def settle(moved: Indices, scale: Array, known: bool) -> Flags:
            block[moved] = goal[moved] * scale[moved, None]
            follow(moved)
            return np.zeros_like(offenders) if known else self._wrong(cars, moved, offenders)

        if goal[offenders].any():
            _largest_scales(wrong_at, settle, offenders)


def _largest_scales(
    wrong_at: Callable[[Indices, Array], Flags], settle: Callable[[Indices, Array, bool], Flags], cars: Flags
) -> None:
    """Bisect a scale in [0, 1] for each of some cars (N,), and settle there.

    wrong_at: takes cars, all that move since its last call, to their scales (N,) and says which cars (N,) are in a
    violation then; at 0 none is. settle: the same, for good; it hears whether it is known that none is.
    """
    full = np.ones(len(cars))
    search = wrong_at(np.flatnonzero(cars), full)
    if not search.any():
        return
    low, high, good = np.zeros_like(full), full, [np.zeros_like(full)]
    for _ in range(_HALVINGS):
        scale = np.where(search, 0.5 * (low + high), full)
        wrong = wrong_at(np.flatnonzero(search), scale)
        # A car that was well alone may clash with one that is coming up: it joins the search.
        search = search | wrong
        low = np.where(search & ~wrong, scale, low)
        high = np.where(wrong, np.minimum(high, scale), high)
        if not wrong.any():
            good.append(scale)
    scale = np.where(search, low, full)
    moved, known = np.flatnonzero(search), any(np.array_equal(scale, well) for well in good)
    # Scales found side by side may clash together: the cars involved fall back to 0, which is known to be good,
    # and so do those that were well at 1 only as long as another had made way.
    while (wrong := settle(moved, scale, known) & (scale > 0)).any():
        scale, search = np.where(wrong, 0.0, scale), search | wrong
        moved = np.flatnonzero(search)


def project(space: ParameterSpace, scene: SceneIR, theta: Tensor, limits: Limits | None = None) -> Projected:
    """`FeasibleSet.project` for a single call; keep a `FeasibleSet` where theta is projected more than once.

    `scene` must be the space's own: the constraints compare with it.
    """
    return _feasible_set(space, scene, limits).project(theta)


def violations(
    space: ParameterSpace, scene: SceneIR, theta: Tensor, limits: Limits | None = None
) -> tuple[str, ...]:
    """`FeasibleSet.violations` for a single call."""
    return _feasible_set(space, scene, limits).violations(theta)


def _feasible_set(space: ParameterSpace, scene: SceneIR, limits: Limits | None) -> FeasibleSet:
    if scene is not space.scene:
        raise RangeError("scene", "the scene of the parameter space", "another one")
    return FeasibleSet(space, limits)


class _Surface:
    """The points of N cars' meshes that carry their extents, in m of the cars' own frames.

    offsets (N, 64, 3): of the scene as photographed; rest (N, 3, K): where the points are then.
    """

    def __init__(self, scene: SceneIR) -> None:
        chosen = {index: _surface_points(scene.meshes[index]) for index in set(scene.objects.mesh_index.tolist())}
        most = max(len(points) for points in chosen.values())
        units: dict[int, Array] = {}
        along: dict[int, Array] = {}
        across: dict[int, Array] = {}
        for index, points in chosen.items():
            # All as many as the most: the last point again changes no extents.
            padded = np.concatenate([points, np.repeat(points[-1:], most - len(points), axis=0)])
            weights = ffd.lattice_weights(torch.from_numpy(padded)).numpy().reshape(most, LATTICE[0], _SLICE)
            # Either factor of the weights sums to 1. Apart they take a third of the memory, and of the time.
            units[index], along[index], across[index] = padded.T, weights.sum(axis=2).T, weights.sum(axis=1).T
        owners = scene.objects.mesh_index.tolist()
        # `stack` keeps the transposed order, with which the products take three times as long.
        self._unit, self._along, self._across = (
            np.ascontiguousarray(np.stack([part[i] for i in owners])) for part in (units, along, across)
        )
        self._size = _array(scene.objects.size_lhw)[:, :, None]
        self.offsets = _array(scene.objects.ffd)
        self.rest = self._bent(self.offsets, slice(None))

    def deformed(self, mesh: Values, rows: Indices | slice = slice(None)) -> Array:
        """The points (M, 3, K) m of cars `rows` under mesh codes (M, 96)."""
        return self._bent(self.offsets[rows] + _offsets(mesh), rows)

    def _bent(self, offsets: Array, rows: Indices | slice) -> Array:
        slices = offsets.swapaxes(1, 2).reshape(len(offsets), -1, _SLICE) @ self._across[rows]
        slices = slices.reshape(len(offsets), 3, LATTICE[0], -1)
        moved = np.einsum("ncik,nik->nck", slices, self._along[rows])
        return (self._unit[rows] + moved) * self._size[rows]


class _StrainBound:
    """Bounds on the deformation of N cars: singular values, determinant of its Jacobian, nothing below y = 0.

    A bound that a car violates at theta = 0 is widened to what it has there; violated_at_start (N,) says who does.
    All is measured at P points of the unit box.
    """

    def __init__(self, source: Array, strain: tuple[float, float]) -> None:
        axes = [np.linspace(0, 1, n) for n in _STRAIN_GRID]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) - [0.5, 1.0, 0.5]
        mirrored = source.reshape(-1, *LATTICE, 3)[:, :, :, ::-1] * [1.0, 1.0, -1.0]
        if np.array_equal(mirrored.reshape(source.shape), source):
            grid = grid[grid[:, 2] <= 0]  # codes are symmetric, so that left and right are strained alike
        unit, start = torch.from_numpy(grid), torch.from_numpy(source)
        # Jacobian and height are linear in the codes: one matrix (96, 10 P) instead of tensor expressions.
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
            (self._smallest.min(axis=1) < strain[0] - _TOLERANCE)
            | (largest.max(axis=1) > strain[1] + _TOLERANCE)
            | (deepest > _TOLERANCE)
            | self._inverted
        )
        self._low = np.minimum(strain[0], self._smallest.min(axis=1)) - _TOLERANCE
        self._high = np.maximum(strain[1], largest.max(axis=1)) + _TOLERANCE
        self._floor = np.maximum(0.0, deepest) + _TOLERANCE
        # A Jacobian that changes by less, in Frobenius' norm, stays within the bounds (Weyl's inequality).
        self._room = np.minimum(self._smallest - self._low[:, None], self._high[:, None] - largest)

    def change(self, mesh: Values) -> Array:
        """By how much mesh codes (N, 96) change Jacobian and height: (N, 10, P)."""
        return (mesh @ self._linear).reshape(len(mesh), 10, -1)

    def path(self, change: Array, cars: Flags, slack: float = 0.0) -> _StrainPath:
        """The way of `cars` (N,) from theta = 0 to a change (N, 10, P), the bounds tighter by `slack`."""
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
    """The strain of N cars on the straight way from theta = 0 to a mesh code, at the K points in question.

    owner (K,): their cars; start, slope (9, K): of the Jacobian; bounds (2, 1, K): least and greatest square of a
    singular value; flips: points that might turn inside out; height, rise (N, P): of all points; floor (N,).
    """

    owner: Indices
    start: Array
    slope: Array
    bounds: Array
    flips: Indices
    height: Array
    rise: Array
    floor: Array

    def wrong_at(self, scale: Array) -> Flags:
        """Which cars (N,) are out of bounds at scales (N,) of the way.

        Singular values lie in [low, high] where J J' - low^2 is positive definite and J J' - high^2 negative
        definite: leading minors tell (Sylvester), at a tenth of the cost of a singular value decomposition.
        """
        wrong: Flags = (self.height + scale[:, None] * self.rise).max(axis=1) > self.floor
        jacobian = (self.start + scale[self.owner] * self.slope).reshape(3, 3, -1)
        # Products of the rows: 0 0, 1 1, 2 2, and 0 1, 1 2, 2 0.
        squares, (g01, g12, g20) = (jacobian**2).sum(axis=1), (jacobian * jacobian[[1, 2, 0]]).sum(axis=1)
        left = squares - self.bounds
        d0, d1, d2 = left[:, 0], left[:, 1], left[:, 2]
        minor, other, mixed = d0 * d1 - g01 * g01, d0 * d2 - g20 * g20, d0 * g12 - g01 * g20
        # The determinant, times d0, which has its sign where the matrix is definite.
        last = minor * other - mixed * mixed
        good = ((minor > 0) & (last > 0)).all(axis=0) & (d0[0] > 0) & (d0[1] < 0)
        wrong[self.owner[~good]] = True
        if len(self.flips):
            flipped = np.linalg.det(jacobian[:, :, self.flips].transpose(2, 0, 1)) <= 0
            wrong[self.owner[self.flips[flipped]]] = True
        return wrong


def _jacobian_and_height(jacobian: Tensor, height: Tensor) -> Array:
    """(N, 10, P) of (N, P, 3, 3) and (N, P)."""
    parts = [jacobian.flatten(2), height[..., None]]
    return np.ascontiguousarray(torch.cat(parts, dim=2).transpose(1, 2).numpy())


_CORNERS = np.array(
    [[1, 1, 1], [1, 1, 0], [0, 1, 0], [0, 1, 1], [1, 0, 1], [1, 0, 0], [0, 0, 0], [0, 0, 1]], dtype=np.float64
).T.copy()
"""Corners (3, 8) of a box between its bounds; the first four run around the bottom."""


def _cells(along: int, across: int) -> Array:
    """Centres (2, along * across) of the cells of a unit square, `across` fastest."""
    first, second = (np.arange(along) + 0.5) / along, (np.arange(across) + 0.5) / across
    return np.stack([a.reshape(-1) for a in np.meshgrid(first, second, indexing="ij")])


_FOOTPRINT = _cells(*_FOOTPRINT_GRID)
"""Points of a footprint (2, P) between a car's bounds, along and across."""
_RAYS = _cells(_RAY_ROWS, _RAY_COLUMNS)[::-1].copy()
"""Where in an image box its rays pass, (2, R), as shares of width and height, row by row."""


class _Street:
    """What stands still: camera and road; measures cars against it and against each other."""

    def __init__(self, scene: SceneIR) -> None:
        matrix = _array(scene.camera.matrix)
        x, y, z = matrix[:, :3].T
        zero = np.zeros(3)
        # Clip-space directions of a car's axes, columns, are even + cos * by_cos + sin * by_sin.
        self._even = np.stack([zero, y, zero], axis=1)
        self._by_cos = np.stack([x, zero, z], axis=1)
        self._by_sin = np.stack([-z, zero, x], axis=1)
        self._matrix = matrix
        self._inverse = np.linalg.inv(matrix[:, :3])
        self._centre = -self._inverse @ matrix[:, 3]
        self._road = _array(scene.environment.road).reshape(-1)
        self._width = scene.camera.width
        self._limit = np.array([scene.camera.width - 1.0, scene.camera.height - 1.0])

    def view(self, cars: _Cars, rows: Indices) -> _View:
        """The cars `rows` in the picture; brings their boxes and distances up to date."""
        low, extent, turn = cars.low[rows], cars.high[rows] - cars.low[rows], cars.turn[rows]
        axes = self._even + turn.real[:, None, None] * self._by_cos + turn.imag[:, None, None] * self._by_sin
        base = cars.translation[rows] @ self._matrix[:, :3].T + self._matrix[:, 3]
        ground = base + axes[:, :, 0] * low[:, :1] + axes[:, :, 2] * low[:, 2:]
        edges = axes * extent[:, None]
        corners = (ground + axes[:, :, 1] * low[:, 1:2])[:, :, None] + edges @ _CORNERS
        depth = corners[:, 2]
        near = depth.min(axis=1)
        cars.near[rows], cars.far[rows] = near, depth.max(axis=1)
        # A corner behind the camera lands far out on its own side: enough for a box that is clipped anyway.
        pixels = corners[:, :2] / np.maximum(depth, _NEAR_M)[:, None]
        first, last = pixels.min(axis=2), pixels.max(axis=2)
        whole = last - first
        first, last = (np.minimum(np.maximum(p, 0), self._limit) for p in (first, last))
        size = last - first
        cars.box[rows, :2], cars.box[rows, 2:] = first, last
        in_frame = size[:, 0] * size[:, 1] / np.maximum(whole[:, 0] * whole[:, 1], 1e-9)
        return _View(rows, in_frame, size, near, ground, edges[:, :, ::2])

    def road_share(self, origin: Array, edges: Array) -> Array:
        """Mean of the road map (M,) under footprints of corner (M, 3) and edges (M, 3, 2) in clip space; 1 where
        fewer than a quarter of their points are in the image.
        """
        clip = origin[:, :, None] + edges @ _FOOTPRINT
        depth = clip[:, 2]
        exact = clip[:, :2] / np.maximum(depth, _NEAR_M)[:, None]
        pixels = np.minimum(np.maximum(exact, 0), self._limit[:, None])
        inside = (exact == pixels).all(axis=1) & (depth > _NEAR_M)
        cell = np.minimum(pixels, self._limit[:, None] - 1).astype(np.int64)
        across, down = (pixels - cell).swapaxes(0, 1)
        index = cell[:, 1] * self._width + cell[:, 0]
        top, bottom = self._road[index], self._road[index + self._width]
        top = top + across * (self._road[index + 1] - top)
        bottom = bottom + across * (self._road[index + self._width + 1] - bottom)
        count = inside.sum(axis=1)
        share = ((top + down * (bottom - top)) * inside).sum(axis=1) / np.maximum(count, 1)
        return np.where(count * 4 >= inside.shape[1], share, 1.0)

    def sight(self, cars: _Cars, rows: Indices) -> _Sight:
        """What is seen of the cars `rows`, and of those that one of them may hide, by rays through their boxes."""
        box, count = cars.box, len(cars.turn)
        starts = (box[:, None, 0] <= box[:, 2]) & (box[:, None, 1] <= box[:, 3])
        # Only a car whose image box meets box i, and that begins before car i ends, can be in the way.
        near = starts & starts.T & (cars.near <= cars.far[:, None])
        seen = np.flatnonzero(near[:, rows].any(axis=1))
        i, j = np.nonzero(near[seen])
        rays = np.empty((len(seen), 3, _RAYS.shape[1]))
        rays[:, :2] = box[seen, :2, None] + _RAYS * (box[seen, 2:] - box[seen, :2])[:, :, None]
        rays[:, 2] = 1
        directions = self._inverse @ rays
        enter = np.full((len(seen), count, _RAYS.shape[1]), np.inf)
        enter[i, j] = _entered(cars, self._centre, directions[i], j)
        own = enter[np.arange(len(seen)), seen]
        met = np.isfinite(own)
        before = enter < np.where(met, own, -np.inf)[:, None]
        shown = met & ~before.any(axis=1)
        rows_shown = shown.reshape(len(seen), _RAY_ROWS, _RAY_COLUMNS).any(axis=2).sum(axis=1)
        return _Sight(
            rows=seen,
            height=rows_shown / _RAY_ROWS * (box[seen, 3] - box[seen, 1]),
            area=shown.sum(axis=1) / np.maximum(met.sum(axis=1), 1),
            covers=np.logical_or.reduce(before, axis=2),
        )


_AXES = np.array(
    [[[1, 0, 0], [0, 0, 0], [0, 0, 1]], [[0, 0, -1], [0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 1, 0], [0, 0, 0]]],
    dtype=np.float64,
)
"""Rows: where a car's axes point in camera space, by the cosine of its yaw, by its sine, and always."""


def _entered(cars: _Cars, centre: Array, directions: Array, j: Indices) -> Array:
    """Distance (K, R) at which rays (K, 3, R) from `centre` enter the boxes of cars j (K,); inf for a miss."""
    axes = cars.turn.real[:, None, None] * _AXES[0] + cars.turn.imag[:, None, None] * _AXES[1] + _AXES[2]
    origin = (axes @ (centre - cars.translation)[:, :, None])[:, :, 0]
    # The sum is the ray's own slope, unless that is 0.
    slowness = 1 / (axes[j] @ directions + 1e-30)
    one, other = (cars.low - origin)[j, :, None] * slowness, (cars.high - origin)[j, :, None] * slowness
    nearest, furthest = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
    return np.where((nearest <= furthest) & (furthest > 0), nearest, np.inf)


@dataclass(frozen=True, slots=True)
class _Bounds:
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
    def around(cls, street: _Street, cars: _Cars, limits: Limits) -> _Bounds:
        """What is asked of cars that stand like this at theta = 0."""
        everyone = np.arange(len(cars.turn))
        view = street.view(cars, everyone)
        road, sight = street.road_share(view.corner, view.edges), street.sight(cars, everyone)
        size = np.minimum(view.size, limits.minimum_px)
        size[:, 1] = np.maximum(size[:, 1], limits.height_kept * view.size[:, 1])
        gap = _gap(cars, everyone)
        overlap = np.zeros_like(gap)
        i, j = np.nonzero(gap < 0)
        overlap[i, j] = _overlap(cars, i, j)
        gap = np.minimum(gap, limits.clearance_m)
        np.fill_diagonal(gap, -np.inf)
        np.fill_diagonal(overlap, np.inf)
        return cls(
            road=road - limits.road_loss - _TOLERANCE,
            in_frame=np.minimum(view.in_frame, limits.in_frame) - _TOLERANCE,
            near=np.minimum(view.near, limits.near_m) - _TOLERANCE,
            height=limits.height_kept * sight.height - _TOLERANCE,
            area=np.minimum(sight.area, limits.area_kept) - _TOLERANCE,
            size=size - _TOLERANCE,
            gap=gap - _TOLERANCE,
            overlap=overlap + _TOLERANCE,
        )

    @classmethod
    def alike(cls, count: int, limits: Limits) -> _Bounds:
        """What is asked of `count` cars wherever they stood before."""
        gap, overlap = np.full((count, count), limits.clearance_m), np.zeros((count, count))
        np.fill_diagonal(gap, -np.inf)
        np.fill_diagonal(overlap, np.inf)
        everyone = np.ones(count)
        return cls(
            road=everyone * (1 - limits.road_loss - _TOLERANCE),
            in_frame=everyone * (limits.in_frame - _TOLERANCE),
            near=everyone * (limits.near_m - _TOLERANCE),
            height=0 * everyone,
            area=everyone * (limits.area_kept - _TOLERANCE),
            size=np.full((count, 2), limits.minimum_px - _TOLERANCE),
            gap=gap - _TOLERANCE,
            overlap=overlap + _TOLERANCE,
        )

    def off_road(self, share: Array, rows: Indices) -> Flags:
        """(M,) of road shares (M,) of the cars `rows`."""
        return share < self.road[rows]

    def out_of_frame(self, view: _View) -> Flags:
        """(M,): too far out of the picture, too small in it, or too near."""
        rows = view.rows
        small = view.size < self.size[rows]
        return small[:, 0] | small[:, 1] | (view.in_frame < self.in_frame[rows]) | (view.near < self.near[rows])

    def hidden(self, sight: _Sight) -> Flags:
        """(R,): too much behind others."""
        return (sight.height < self.height[sight.rows]) | (sight.area < self.area[sight.rows])

    def collide(self, cars: _Cars, rows: Indices) -> Flags:
        """(M, N): the cars `rows` with all others."""
        gap = _gap(cars, rows)
        collide = gap < self.gap[rows]
        # No nearer than before, yet two that overlapped may overlap more.
        m, j = np.nonzero((gap < 0) & ~collide & np.isfinite(self.overlap[rows]))
        if len(m):
            collide[m, j] = _overlap(cars, rows[m], j) > self.overlap[rows[m], j]
        return collide


def _coverers(covers: Flags, hidden: Flags) -> Flags:
    """Cars (N,) that hide a part of one that is hidden (R,) too much. covers (R, N): car j hides a part of it."""
    return np.logical_or.reduce(covers & hidden[:, None], axis=0)


def _turn(yaw: Array) -> Turns:
    """cos(yaw) + i sin(yaw): times x + i z it turns camera axes into a car's own, and its conjugate back."""
    return np.cos(yaw) + 1j * np.sin(yaw)


def _centres(cars: _Cars) -> Turns:
    """Middles of the footprints, x + i z (N,) m."""
    middle = 0.5 * (cars.low + cars.high)
    place = cars.translation[:, 0] + 1j * cars.translation[:, 2]
    return place + cars.turn.conj() * (middle[:, 0] + 1j * middle[:, 2])


def _gap(cars: _Cars, rows: Indices) -> Array:
    """Signed gap (M, N) m between the footprints of the cars `rows` and all, by separating axes; negative: depth
    of overlap.
    """
    centre, turn = _centres(cars), cars.turn
    half = 0.5 * (cars.high - cars.low)[:, ::2]
    apart = centre[rows, None] - centre
    # Along and across, (M, N, 2): the way between them in the frames of both, one's axes in the other's frame.
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


def _overlap(cars: _Cars, i: Indices, j: Indices) -> Array:
    """Area (K,) m2 that the footprints of the cars i and j (K,) share."""
    half, centre = 0.5 * (cars.high - cars.low), _centres(cars)
    corners = half[:, :1] * [1, 1, -1, -1] + 1j * half[:, 2:] * [1, -1, -1, 1]
    corners = centre[:, None] + cars.turn.conj()[:, None] * corners
    footprint = corners.view(np.float64).reshape(*corners.shape, 2)
    return _shared_area(footprint[i], footprint[j])


def _shared_area(a: Array, b: Array) -> Array:
    """Area (P,) shared by convex polygons (P, 4, 2), both around in the same sense, by Green's theorem."""
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


def _surface_points(mesh: Mesh) -> Array:
    """Vertices (K, 3) of the unit box that carry the extents."""
    vertices = mesh.vertices.detach().cpu().double().numpy()
    try:
        chosen = set(ConvexHull(vertices).vertices.tolist())
    except QhullError:  # a flat mesh has no hull with a volume; its vertices do as well
        chosen = set()
    stride = max(1, -(-len(vertices) // _SURFACE_POINTS))
    return vertices[sorted(chosen | set(range(0, len(vertices), stride)))]


def _extents(surface: Array) -> tuple[Array, Array]:
    """Bounds (N, 3), (N, 3) of points (N, 3, K)."""
    return surface.min(axis=2), surface.max(axis=2)


def _offsets(mesh: Values) -> Array:
    """Lattice offsets (N, 64, 3) of symmetric codes (N, 96), as `ffd.from_symmetric`, without its detour."""
    half = mesh.astype(np.float64).reshape(len(mesh), LATTICE[0], LATTICE[1], LATTICE[2] // 2, 3)
    mirror = half[:, :, :, ::-1] * [1.0, 1.0, -1.0]
    return np.concatenate([half, mirror], axis=3).reshape(len(mesh), LATTICE_POINTS, 3)


def _lowest(mesh: Values) -> Values:
    """The vertical offsets (N, 4, 2) of the lowest lattice layer: a view into symmetric codes (N, 96)."""
    return mesh.reshape(len(mesh), LATTICE[0], LATTICE[1], LATTICE[2] // 2, 3)[:, :, -1, :, 1]


def _array(tensor: Tensor) -> Array:
    return tensor.detach().cpu().double().numpy()
