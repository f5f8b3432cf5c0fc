"""The way back to what can be: after every step of an attack, theta is projected onto the feasible set.

Feasible means: inside the bounds; the mesh is not inverted and only moderately strained, its lowest lattice layer
fixed vertically, nothing below its wheels; cars stay on the kind of surface they stood on, do not pass through
each other, and stay in the picture and visible. No constraint may be violated more than at theta = 0 (real labels
overlap and park on kerbs), so theta = 0 is always feasible. The pose stays on the ground plane by construction of
`ParameterSpace.apply`.

`drivesem.feasibility_check` judges finished scenes a second time and shares no code with this module.
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

from drivesem.space import Parameter, ParameterSpace
from scene_ir import ffd
from scene_ir.errors import RangeError
from scene_ir.types import LATTICE, LATTICE_POINTS, Mesh, SceneIR

Array = NDArray[np.float64]
Values = NDArray[np.floating[Any]]
"""Of theta's own dtype, float32 or float64."""


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


@dataclass(frozen=True, slots=True)
class _State:
    """What the constraints look at, for N cars. road: share of the footprint on the road map; gap, overlap (N, N):
    signed separation of footprints in m and their shared area in m2; box: (N, 4) px, clipped; in_frame,
    visible_height (px), visible_area (share), near (m): (N,); covers (N, N): car j hides a part of car i.
    """

    road: Array
    gap: Array
    overlap: Array
    box: Array
    in_frame: Array
    visible_height: Array
    visible_area: Array
    near: Array
    covers: NDArray[np.bool_]


class FeasibleSet:
    """The feasible set of one scene's `ParameterSpace`; prepared once, then `project` takes a few milliseconds."""

    def __init__(self, space: ParameterSpace, limits: Limits | None = None) -> None:
        self.space = space
        self.limits = limits or Limits()
        scene, objects = space.scene, space.scene.objects
        self._lower = _array(space.lower)
        self._upper = _array(space.upper)
        self._translation = _array(objects.translation)
        self._yaw = _array(objects.yaw)
        self._size = _array(objects.size_lhw)
        self._ffd = _array(objects.ffd)
        self._matrix = _array(scene.camera.matrix)
        self._inverse = np.linalg.inv(self._matrix[:, :3])
        self._centre = -self._inverse @ self._matrix[:, 3]
        self._ground = _array(scene.environment.ground)
        self._road = _array(scene.environment.road)
        self._image = (scene.camera.width, scene.camera.height)
        self._surfaces = [_surface(scene.meshes[index]) for index in objects.mesh_index.tolist()]
        self._strain = _StrainBound(self._ffd, self.limits.strain)
        self._start = self._state(np.zeros(space.dim)) if space.count else None

    def project(self, theta: Tensor) -> Projected:
        """The nearest feasible theta (D,) we can find; `theta` itself where it is feasible.

        Deterministic and idempotent. First the bounds, then the strain of each mesh, scaled back car by car; then
        the cars that violate something go back to the photograph and take mesh, rotation and translation up again,
        each as far as all constraints allow. Raises ShapeError; RangeError naming a coordinate that is not finite.
        """
        self.space.unflatten(theta)
        bad = (~torch.isfinite(theta)).nonzero()
        if len(bad):
            i = int(bad[0])
            raise RangeError(f"theta: {self.space.name(i)}", "a finite value", float(theta[i]))
        values = theta.detach().cpu().numpy()
        result, active = self._project(values)
        # theta0 and the like carry the dtype and device of the scene.
        return Projected(torch.from_numpy(result.copy()).to(theta), tuple(active))

    def violations(self, theta: Tensor) -> tuple[str, ...]:
        """What theta (D,) violates, as `objects[3]: collision`; empty where it is feasible."""
        values = theta.detach().cpu().numpy()
        found = [f"{self.space.name(int(i))}: bounds" for i in np.flatnonzero(self._box(values) != values)]
        if self.space.count == 0:
            return tuple(found)
        mesh = self._mesh(values)
        if mesh is not None:
            found += [f"objects[{i}]: lowest layer" for i in np.flatnonzero((_lowest(mesh) != 0).any(axis=(1, 2)))]
            found += [f"objects[{i}]: strain" for i in np.flatnonzero(~self._strain.holds(_offsets(mesh)))]
        return tuple(found + self._named(self._violated(self._state(values))))

    def _project(self, values: Values) -> tuple[Values, list[str]]:
        active: list[str] = []
        boxed = self._box(values)
        active += [f"{self.space.name(int(i))}: bounds" for i in np.flatnonzero(boxed != values)]
        if self.space.count == 0:
            return boxed, active
        mesh = self._mesh(boxed)
        if mesh is not None:
            _lowest(mesh)[:] = 0
            scaled = self._bound_strain(mesh)
            active += [f"objects[{i}]: strain" for i in np.flatnonzero(scaled)]
        violated = self._violated(self._state(boxed))
        if not _any(violated):
            return boxed, active
        active += self._named(violated)
        return self._back_off(boxed, _cars(violated)), active

    def _box(self, values: Values) -> Values:
        return np.clip(values, self._lower, self._upper).astype(values.dtype)

    def _block(self, values: Values, parameter: Parameter) -> Values | None:
        """theta's block of one parameter of cars, (N, size), a view; None where it is held."""
        where = self.space.slice_of(parameter)
        return None if where is None else values[where].reshape(self.space.count, -1)

    def _mesh(self, values: Values) -> Values | None:
        return self._block(values, Parameter.MESH)

    def _bound_strain(self, mesh: Values) -> NDArray[np.bool_]:
        """Scale each car's mesh offsets (N, 96) back, in place, until its strain holds; returns who was scaled."""
        wrong = ~self._strain.holds(_offsets(mesh))
        if not wrong.any():
            return wrong
        full = mesh.copy()
        low, high = np.zeros(len(mesh)), np.ones(len(mesh))
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            trial = (full * middle[:, None]).astype(mesh.dtype)
            good = self._strain.holds(_offsets(trial))
            low, high = np.where(good, middle, low), np.where(good, high, middle)
        mesh[wrong] = (full * low[:, None]).astype(mesh.dtype)[wrong]
        return wrong

    def _back_off(self, wanted: Values, offenders: NDArray[np.bool_]) -> Values:
        """Feasible values: offenders go back to 0 and take each block up again as far as everything allows.

        Where an offender at 0 is still hit by a car that moved, that car is an offender too.
        """
        blocks = [p for p in _BLOCKS if self.space.slice_of(p) is not None]
        while True:
            current = wanted.copy()
            for parameter in blocks:
                block = self._block(current, parameter)
                assert block is not None
                block[offenders] = 0
            hit = _cars(self._violated(self._state(current)))
            if not hit.any():
                break
            if not (hit & ~offenders).any():
                raise AssertionError("theta = 0 is feasible")
            offenders = offenders | hit
        for parameter in blocks:
            self._take_up(current, wanted, parameter, offenders)
        return current

    def _take_up(
        self, current: Values, wanted: Values, parameter: Parameter, offenders: NDArray[np.bool_]
    ) -> None:
        """Bring the offenders' block of `parameter` from 0 towards `wanted`, in place, feasible throughout."""
        block, goal = self._block(current, parameter), self._block(wanted, parameter)
        assert block is not None
        assert goal is not None
        # A kerb stops a car across its heading, not along: the two are found one after the other.
        columns = [slice(0, 1), slice(1, 2)] if parameter is Parameter.TRANSLATE else [slice(None)]
        moves_mesh = parameter is Parameter.MESH
        extents = None if moves_mesh else self._extents(current)
        for column in columns:

            def wrong_at(scale: Array, column: slice = column) -> NDArray[np.bool_]:
                scaled = (goal[:, column] * scale[:, None]).astype(block.dtype)
                block[offenders, column] = scaled[offenders]
                wrong = _cars(self._violated(self._state(current, extents)))
                if moves_mesh:  # the feasible scales of a strain need not be an interval
                    wrong |= ~self._strain.holds(_offsets(block))
                return wrong & offenders

            _largest_scales(wrong_at, len(offenders))

    def _state(self, values: Values, extents: tuple[Array, Array] | None = None) -> _State:
        """What the constraints look at; `extents` where they are known already."""
        translate = self._block(values, Parameter.TRANSLATE)
        rotate = self._block(values, Parameter.ROTATE)
        yaw = self._yaw if rotate is None else self._yaw + rotate[:, 0]
        translation = self._translation
        if translate is not None:
            metres = translate * self._size[:, :1]
            cos, sin = np.cos(self._yaw), np.sin(self._yaw)
            x, z = metres[:, 0] * cos + metres[:, 1] * sin, metres[:, 1] * cos - metres[:, 0] * sin
            y = -(self._ground[0] * x + self._ground[2] * z) / self._ground[1]
            translation = translation + np.stack([x, y, z], axis=-1)
        low, high = extents or self._extents(values)
        return self._measure(low, high, yaw, translation)

    def _extents(self, values: Values) -> tuple[Array, Array]:
        """Bounds (N, 3), (N, 3) m of the deformed cars in their own frames."""
        mesh = self._mesh(values)
        offsets = self._ffd if mesh is None else self._ffd + _offsets(mesh)
        bounds = []
        for (unit, weights), offset, size in zip(self._surfaces, offsets, self._size, strict=True):
            deformed = (unit + weights @ offset) * size
            bounds.append((deformed.min(axis=0), deformed.max(axis=0)))
        return np.stack([b[0] for b in bounds]), np.stack([b[1] for b in bounds])

    def _measure(self, low: Array, high: Array, yaw: Array, translation: Array) -> _State:
        cos, sin = np.cos(yaw), np.sin(yaw)

        zero, one = np.zeros_like(cos), np.ones_like(cos)
        # Rows: where the car's length, height and width point in camera space.
        axes = np.stack([cos, zero, -sin, zero, one, zero, sin, zero, cos], axis=-1).reshape(-1, 3, 3)

        def to_camera(local: Array) -> Array:
            """Points (N, P, 3) m of the cars' frames to camera space."""
            return local @ axes + translation[:, None]

        corners = to_camera(low[:, None] + _CORNERS * (high - low)[:, None])
        footprint = corners[:, :4][:, :, [0, 2]]
        gap, overlap = _separation(footprint, cos, sin)
        grid = low[:, None] + _FOOTPRINT * (high - low)[:, None]
        grid[..., 1] = 0
        box, clipped, near = self._image_boxes(corners)
        in_frame = _box_area(clipped) / np.maximum(_box_area(box), 1e-9)
        enter = self._first_hits(clipped, axes, low, high, translation)
        covers, height, area = _visible(enter, _RAY_ROWS)
        return _State(
            road=self._road_share(to_camera(grid)),
            gap=gap,
            overlap=overlap,
            box=clipped,
            in_frame=in_frame,
            visible_height=height * _box_size(clipped)[:, 1],
            visible_area=area,
            near=near,
            covers=covers,
        )

    def _image_boxes(self, corners: Array) -> tuple[Array, Array, Array]:
        """Image boxes (N, 4) of box corners (N, 8, 3), as they are and clipped; least distance (N,) m."""
        clip = corners @ self._matrix[:, :3].T + self._matrix[:, 3]
        near = clip[..., 2].min(axis=1)
        # A corner behind the camera lands far out on its own side: enough for a box that is clipped anyway.
        pixels = clip[..., :2] / np.maximum(clip[..., 2:], 0.1)
        box = np.concatenate([pixels.min(axis=1), pixels.max(axis=1)], axis=-1)
        width, height = self._image
        limit = np.array([width - 1.0, height - 1.0, width - 1.0, height - 1.0])
        return box, np.clip(box, 0, limit), near

    def _first_hits(self, box: Array, axes: Array, low: Array, high: Array, translation: Array) -> Array:
        """Distance (N, N, R) at which rays through a grid on image box i enter the box of car j; inf for a miss.

        box (N, 4) px; axes (N, 3, 3): rows are the cars' axes in camera space; low, high (N, 3) m along them.
        """
        size = _box_size(box)
        rays = box[:, None, :2] + _RAYS * size[:, None]
        count = len(box)
        directions = np.concatenate([rays, np.ones((count, len(_RAYS), 1))], axis=-1) @ self._inverse.T
        enter = np.full((count, count, len(_RAYS)), np.inf)
        # Only a car whose image box meets box i can be in the way.
        meets = (box[:, None, :2] <= box[None, :, 2:]).all(axis=2) & (box[None, :, :2] <= box[:, None, 2:]).all(
            axis=2
        )
        i, j = np.nonzero(meets)
        along = directions[i] @ axes[j].swapaxes(-1, -2)
        along = np.where(np.abs(along) < 1e-12, 1e-12, along)
        origin = ((self._centre - translation)[:, None] @ axes.swapaxes(-1, -2))[:, 0]
        first = (low - origin)[j, None] / along
        second = (high - origin)[j, None] / along
        nearest = np.minimum(first, second).max(axis=-1)
        furthest = np.maximum(first, second).min(axis=-1)
        enter[i, j] = np.where((nearest <= furthest) & (furthest > 0), nearest, np.inf)
        return enter

    def _road_share(self, points: Array) -> Array:
        """Mean of the road map under points (N, P, 3) in the image; 1 where fewer than a quarter of them are."""
        clip = points @ self._matrix[:, :3].T + self._matrix[:, 3]
        depth = np.maximum(clip[..., 2], 0.1)
        u, v = clip[..., 0] / depth, clip[..., 1] / depth
        width, height = self._image
        inside = (clip[..., 2] > 0.1) & (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
        u, v = np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)
        x0, y0 = np.minimum(u.astype(int), width - 2), np.minimum(v.astype(int), height - 2)
        fx, fy = u - x0, v - y0
        road = self._road
        top = road[y0, x0] * (1 - fx) + road[y0, x0 + 1] * fx
        bottom = road[y0 + 1, x0] * (1 - fx) + road[y0 + 1, x0 + 1] * fx
        value = top * (1 - fy) + bottom * fy
        count = inside.sum(axis=1)
        share = (value * inside).sum(axis=1) / np.maximum(count, 1)
        return np.where(count * 4 >= inside.shape[1], share, 1.0)

    def _violated(self, state: _State) -> dict[str, NDArray[np.bool_]]:
        """Constraint -> (N, N) bool: on the diagonal what a car violates alone, else what a pair does."""
        start, limits, slack = self._start, self.limits, _TOLERANCE
        assert start is not None
        size, size0 = _box_size(state.box), _box_size(start.box)
        alone = {
            "road": state.road < start.road - limits.road_loss - slack,
            "frame": (state.in_frame < np.minimum(start.in_frame, limits.in_frame) - slack)
            | (size < np.minimum(size0, limits.minimum_px) - slack).any(axis=1)
            | (size[:, 1] < limits.height_kept * size0[:, 1] - slack)
            | (state.near < np.minimum(start.near, limits.near_m) - slack),
        }
        hidden = (state.visible_height < limits.height_kept * start.visible_height - slack) | (
            state.visible_area < np.minimum(start.visible_area, limits.area_kept) - slack
        )
        collide = (state.gap < np.minimum(start.gap, limits.clearance_m) - slack) | (
            state.overlap > start.overlap + slack
        )
        np.fill_diagonal(collide, False)
        pairs = {name: np.diag(flags) for name, flags in alone.items()}
        pairs["visibility"] = np.diag(hidden) | (state.covers & hidden[:, None])
        pairs["collision"] = collide
        return pairs

    @staticmethod
    def _named(violated: dict[str, NDArray[np.bool_]]) -> list[str]:
        return [
            f"objects[{i}]: {name}" for name, pairs in violated.items() for i in np.flatnonzero(pairs.any(axis=1))
        ]


def _largest_scales(wrong_at: Callable[[Array], NDArray[np.bool_]], count: int) -> None:
    """Bisect a scale in [0, 1] for each of `count` cars; the last call of `wrong_at` is with the scales found.

    `wrong_at` applies scales (count,) and says which cars (count,) they leave in a violation; none at 0.
    """
    full = np.ones(count)
    search = wrong_at(full)
    if not search.any():
        return
    low, high = np.zeros(count), np.ones(count)
    for _ in range(_HALVINGS):
        scale = np.where(search, 0.5 * (low + high), full)
        wrong = wrong_at(scale)
        # A car that was well alone may clash with one that is coming up: it joins the search.
        search = search | wrong
        low = np.where(search & ~wrong, scale, low)
        high = np.where(wrong, np.minimum(high, scale), high)
    scale = np.where(search, low, full)
    # Scales found side by side may clash together: the cars involved fall back to 0, which is known to be good.
    while (wrong := wrong_at(scale) & (scale > 0)).any():
        scale = np.where(wrong, 0.0, scale)


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


class _StrainBound:
    """Bounds on the deformation of N cars: singular values, determinant of its Jacobian, nothing below y = 0.

    A bound that a car violates at theta = 0 is widened to what it has there.
    """

    def __init__(self, source: Array, strain: tuple[float, float]) -> None:
        axes = [np.linspace(0, 1, n) for n in _STRAIN_GRID]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) - [0.5, 1.0, 0.5]
        unit = torch.from_numpy(grid)
        self._y = grid[:, 1]
        # The Jacobian and the height are linear in the offsets: two matrices instead of tensor expressions.
        self._slopes = _jacobian_weights(unit)
        self._weights = ffd.lattice_weights(unit).numpy()
        self._source = source
        slack = _TOLERANCE
        if len(source):
            smallest, largest, lowest = self._extremes(source)
            self._low = np.minimum(strain[0], smallest) - slack
            self._high = np.maximum(strain[1], largest) + slack
            self._floor = np.maximum(0.0, lowest) + slack
            inverted = _determinant(self._jacobian(source)) <= 0
            self._inverted: NDArray[np.bool_] = np.logical_or.reduce(inverted, axis=1)

    def _jacobian(self, offsets: Array) -> Array:
        """(N, G, 3, 3) of offsets (N, 64, 3)."""
        n = len(offsets)
        slopes = (self._slopes @ offsets).reshape(n, -1, 3, 3)
        return np.eye(3) + slopes.swapaxes(-1, -2)

    def _extremes(self, offsets: Array) -> tuple[Array, Array, Array]:
        values = np.linalg.svd(self._jacobian(offsets), compute_uv=False)
        height = self._y + (self._weights @ offsets)[..., 1]
        return values.min(axis=(1, 2)), values.max(axis=(1, 2)), height.max(axis=1)

    def holds(self, change: Array) -> NDArray[np.bool_]:
        """Whether each car (N,) with offsets source + change (N, 64, 3) is within the bounds.

        Singular values lie in [low, high] where J'J - low^2 and high^2 - J'J have no negative eigenvalue: leading
        minors tell, at a tenth of the cost of a singular value decomposition.
        """
        offsets = self._source + change
        jacobian = self._jacobian(offsets)
        gram = jacobian.swapaxes(-1, -2) @ jacobian
        eye = np.eye(3)
        low = _positive(gram - self._low[:, None, None, None] ** 2 * eye)
        high = _positive(self._high[:, None, None, None] ** 2 * eye - gram)
        upright = (_determinant(jacobian) > 0) | self._inverted[:, None]
        height = self._y + (self._weights @ offsets)[..., 1]
        good = np.stack([low, high, upright]).all(axis=(0, 2))
        return np.logical_and(good, height.max(axis=1) <= self._floor)


def _jacobian_weights(unit: Tensor) -> Array:
    """(G * 3, 64): maps offsets (64, 3) to d deformation / d axis, rows (point, axis), columns the component."""
    basis = torch.eye(LATTICE_POINTS, dtype=unit.dtype)
    # One lattice point at a time moves along x: column x of the offsets, first row of the Jacobian.
    offsets = torch.stack([basis, torch.zeros_like(basis), torch.zeros_like(basis)], dim=-1)
    rows = ffd.jacobian(unit, offsets)[:, :, 0, :] - torch.tensor([1.0, 0.0, 0.0], dtype=unit.dtype)
    return rows.permute(1, 2, 0).reshape(-1, LATTICE_POINTS).numpy()


def _positive(matrix: Array) -> NDArray[np.bool_]:
    """Whether symmetric 3x3 matrices are positive definite (Sylvester)."""
    minor2 = matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0]
    return (matrix[..., 0, 0] > 0) & (minor2 > 0) & (_determinant(matrix) > 0)


def _determinant(m: Array) -> Array:
    return (
        m[..., 0, 0] * (m[..., 1, 1] * m[..., 2, 2] - m[..., 1, 2] * m[..., 2, 1])
        - m[..., 0, 1] * (m[..., 1, 0] * m[..., 2, 2] - m[..., 1, 2] * m[..., 2, 0])
        + m[..., 0, 2] * (m[..., 1, 0] * m[..., 2, 1] - m[..., 1, 1] * m[..., 2, 0])
    )


_CORNERS = np.array(
    [[1, 1, 1], [1, 1, 0], [0, 1, 0], [0, 1, 1], [1, 0, 1], [1, 0, 0], [0, 0, 0], [0, 0, 1]], dtype=np.float64
)
"""Corners of a box between its bounds; the first four run around the bottom."""
_FOOTPRINT = np.stack(
    np.meshgrid(
        (np.arange(_FOOTPRINT_GRID[0]) + 0.5) / _FOOTPRINT_GRID[0],
        [1.0],
        (np.arange(_FOOTPRINT_GRID[1]) + 0.5) / _FOOTPRINT_GRID[1],
        indexing="ij",
    ),
    axis=-1,
).reshape(-1, 3)
"""Points of a footprint (K, 3) between a car's bounds."""
_RAYS = np.stack(
    np.meshgrid(
        (np.arange(_RAY_ROWS) + 0.5) / _RAY_ROWS, (np.arange(_RAY_COLUMNS) + 0.5) / _RAY_COLUMNS, indexing="ij"
    )[::-1],
    axis=-1,
).reshape(-1, 2)
"""Where in an image box its rays pass, (R, 2), as shares of width and height, row by row."""


def _separation(footprint: Array, cos: Array, sin: Array) -> tuple[Array, Array]:
    """Signed gap (N, N) m by separating axes (negative: depth of overlap) and shared area (N, N) m2.

    footprint (N, 4, 2): corners (x, z) around the bottom. The diagonal means nothing.
    """
    n = len(footprint)
    axes = np.stack([np.stack([cos, -sin], axis=-1), np.stack([sin, cos], axis=-1)], axis=1).reshape(-1, 2)
    spans = footprint @ axes.T
    low, high = spans.min(axis=1), spans.max(axis=1)
    gaps = np.maximum(low[:, None] - high[None], low[None] - high[:, None])
    # Only the two axes of either box separate a pair.
    index = np.arange(n)
    own = 2 * index[:, None]
    best = np.maximum(gaps[index[:, None], index[None], own], gaps[index[:, None], index[None], own + 1])
    gap = np.maximum(best, best.T)
    area = np.zeros((n, n))
    first, second = np.nonzero(np.triu(gap < 0, k=1))
    if len(first):
        shared = _shared_area(footprint[first], footprint[second])
        area[first, second] = shared
        area[second, first] = shared
    return gap, area


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


def _visible(enter: Array, rows: int) -> tuple[NDArray[np.bool_], Array, Array]:
    """Who hides whom. enter (N, N, R): distance at which ray r towards car i enters the box of car j, inf where it
    misses; rays of car i in `rows` rows.

    covers (N, N): car j hides a part of car i; height (N,): share of the rows in which car i shows; area (N,):
    share of the rays that meet car i's box first, among those that meet it.
    """
    count = len(enter)
    index = np.arange(count)
    own = enter[index, index]
    met = np.isfinite(own)
    before = np.logical_and(enter < own[:, None], met[:, None])
    before[index, index] = False
    shown = met & ~before.any(axis=1)
    height = shown.reshape(count, rows, -1).any(axis=2).mean(axis=1)
    return np.logical_or.reduce(before, axis=2), height, shown.sum(axis=1) / np.maximum(met.sum(axis=1), 1)


def _surface(mesh: Mesh) -> tuple[Array, Array]:
    """Vertices (K, 3) of the unit box that carry the extents, and their lattice weights (K, 64)."""
    vertices = mesh.vertices.detach().cpu().double().numpy()
    try:
        chosen = set(ConvexHull(vertices).vertices.tolist())
    except QhullError:  # a flat mesh has no hull with a volume; its vertices do as well
        chosen = set()
    stride = max(1, -(-len(vertices) // _SURFACE_POINTS))
    keep = np.array(sorted(chosen | set(range(0, len(vertices), stride))))
    unit = vertices[keep]
    return unit, ffd.lattice_weights(torch.from_numpy(unit)).numpy()


def _offsets(mesh: Values) -> Array:
    """Lattice offsets (N, 64, 3) of symmetric codes (N, 96)."""
    return ffd.from_symmetric(torch.from_numpy(np.ascontiguousarray(mesh)).double()).numpy()


def _lowest(mesh: Values) -> Values:
    """The vertical offsets (N, 4, 2) of the lowest lattice layer: a view into symmetric codes (N, 96)."""
    return mesh.reshape(len(mesh), LATTICE[0], LATTICE[1], LATTICE[2] // 2, 3)[:, :, -1, :, 1]


def _box_size(box: Array) -> Array:
    return np.maximum(box[:, 2:] - box[:, :2], 0)


def _box_area(box: Array) -> Array:
    return _box_size(box).prod(axis=1)


def _any(violated: dict[str, NDArray[np.bool_]]) -> bool:
    return any(pairs.any() for pairs in violated.values())


def _cars(violated: dict[str, NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """Cars (N,) that take part in any violation."""
    pairs: NDArray[np.bool_] = np.logical_or.reduce(np.stack(list(violated.values())), axis=0)
    return np.logical_or.reduce(pairs | pairs.T, axis=0)


def _array(tensor: Tensor) -> Array:
    return tensor.detach().cpu().double().numpy()
