"""Projection of theta onto the feasible set, after every step of an attack.

Feasible means: theta is inside its bounds; meshes are not inverted and only moderately strained, their lowest
lattice layer is fixed vertically, nothing reaches below the wheels; vehicles stay on the kind of surface they
stood on, do not pass through each other, and stay in the picture and visible; the weather occurs in reality, and
vehicles are visible through it. No constraint may be violated more than at theta = 0 (real labels overlap and park
on kerbs), so theta = 0 is always feasible. `ParameterSpace.apply` keeps poses on the ground plane; where positions
are image offsets (`attack.roi`), the vertical offset follows the others.

`drivesem.attacks.feasibility_check` tests finished scenes independently and shares no code with this module.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from drivesem.attacks.feasible.constraints import (
    ConstraintBounds,
    ConstraintViolations,
    FeasibilityLimits,
    FindInvisible,
    MeasuredScene,
    StrainBound,
    WeatherSet,
    find_occluders,
)
from drivesem.attacks.feasible.vehicles import (
    TOLERANCE,
    Array,
    Flags,
    Indices,
    Values,
    VehicleBoxes,
    VehicleSurfaces,
    extents,
    lowest_layer_heights,
    to_float64_array,
    unit_complex,
)
from drivesem.attacks.space import Parameter, ParameterSpace, behind_camera, ground_axes
from drivesem.attacks.theta import ProjectedTheta

_HALVINGS = 5
"""Bisection steps for the scale of a block, to 1/32."""


class FeasibleSet:
    """The feasible set of one scene's `ParameterSpace`; prepared once, then `project` takes a millisecond."""

    def __init__(
        self,
        space: ParameterSpace,
        limits: FeasibilityLimits | None = None,
        only_bounds: bool = False,
        find_invisible: FindInvisible | None = None,
        held: Sequence[int] = (),
    ) -> None:
        """Prepare the constraints of the scene.

        Args:
            space: the scene's parameter space.
            limits: what counts as feasible.
            only_bounds: project onto the bounds alone, as the paper does.
            find_invisible: which objects are no longer visible in which weather; None: all stay visible.
            held: vehicles that stay as photographed.
        """
        self.space = space
        self.only_bounds = only_bounds
        self.limits = limits or FeasibilityLimits()
        where = space.blocks.get(Parameter.WEATHER)
        self._weather = (
            None if where is None else WeatherSet(space, where, self.limits.joint_weather, find_invisible)
        )
        objects = space.scene.objects
        self._lower = to_float64_array(space.lower)
        self._upper = to_float64_array(space.upper)
        self._held = tuple(held)
        for parameter, where in space.blocks.items():
            if space.specs[parameter].per_object:
                for bound in (self._lower, self._upper):
                    bound[where].reshape(space.count, space.specs[parameter].size)[list(self._held)] = 0
        if space.count == 0:
            return
        self._translation = to_float64_array(objects.translation)
        self._yaw = to_float64_array(objects.yaw)
        ground = space.scene.environment.ground.detach().cpu().double()
        length_m = objects.size_lhw[:, 0].detach().cpu().double()
        # (N, 2, 3) m, shift by one own length along and across.
        self._shift = to_float64_array(ground_axes(objects.yaw.detach().cpu().double(), length_m, ground))
        self._regions = None if space.regions is None else space.regions.to_float64()
        self._surface = VehicleSurfaces(space.scene)
        self._strain = StrainBound(self._surface.offsets, self.limits.strain)
        self._scene = MeasuredScene(space.scene)
        self._everyone = np.arange(space.count)
        self._bounds = ConstraintBounds.from_rest(self._scene, self._at_rest(), self.limits)

    @property
    def violated_at_start(self) -> tuple[str, ...]:
        """Violations at theta = 0, such as `objects[3]: collision`: labels that overlap or leave less than the
        clearance; vehicles off the road, out of the picture, too small or hidden; strained fits; pictures that are
        not trusted. These may stay, but not get worse.
        """
        if self.space.count == 0:
            return ()
        held = [f"objects[{i}]: fidelity" for i in self._held]
        strained = [f"objects[{i}]: strain" for i in np.flatnonzero(self._strain.violated_at_start)]
        limits = ConstraintBounds.absolute(self.space.count, self.limits)
        names = (*held, *strained, *self._find_violations(self._at_rest(), limits).names())
        absent = tuple(f"objects[{i}]:" for i in behind_camera(self.space.scene).nonzero()[:, 0].tolist())
        return tuple(name for name in names if not name.startswith(absent))

    def project(self, theta: Tensor) -> ProjectedTheta:
        """A feasible theta (D,) near `theta`, and `theta` itself where it is feasible.

        Deterministic and idempotent. First come the bounds, then weather, then the strain of each mesh, scaled
        back vehicle by vehicle. Vehicles that still violate something return to the photograph, and mesh, size,
        rotation and translation are restored in turn as far as all constraints allow. Raises ShapeError;
        RangeError naming a coordinate that is not finite.
        """
        self.space.check(theta)
        result, active = self._project(theta.detach().cpu().numpy())
        # theta has the dtype and device of the scene.
        return ProjectedTheta(torch.from_numpy(result).to(theta), tuple(active))

    def violations(self, theta: Tensor) -> tuple[str, ...]:
        """Violations of theta (D,), such as `objects[3]: collision`; empty where it is feasible."""
        values = theta.detach().cpu().numpy()
        names = self._out_of_bounds(values, self._clip_to_bounds(values))
        names += [] if self._weather is None else self._weather.violations(values)
        if self.space.count == 0:
            return tuple(names)
        names += self._put_on_ground(values.copy())
        mesh = self._block(values, Parameter.MESH)
        if mesh is not None:
            names += [
                f"objects[{i}]: lowest layer"
                for i in np.flatnonzero((lowest_layer_heights(mesh) != 0).any(axis=(1, 2)))
            ]
            names += [f"objects[{i}]: strain" for i in np.flatnonzero(self._strained(self._strain.change(mesh)))]
        surface = None if mesh is None else self._surface.deform(mesh)
        return tuple(names + self._find_violations(self._boxes_at(values, surface), self._bounds).names())

    def _project(self, values: Values) -> tuple[Values, list[str]]:
        boxed = self._clip_to_bounds(values)
        active = self._out_of_bounds(values, boxed)
        if self.only_bounds:
            return boxed, active
        if self._weather is not None:
            active += self._weather.project(boxed, values)
        if self.space.count == 0:
            return boxed, active
        active += self._put_on_ground(boxed)
        mesh, surface = self._block(boxed, Parameter.MESH), None
        if mesh is not None:
            lowest_layer_heights(mesh)[:] = 0
            active += [f"objects[{i}]: strain" for i in np.flatnonzero(self._bound_strain(mesh))]
            surface = self._surface.deform(mesh)
        cars = self._boxes_at(boxed, surface)
        violations = self._find_violations(cars, self._bounds)
        offenders = violations.involved()
        if offenders.any():
            active += violations.names()
            self._resolve(cars, boxed, surface, offenders)
        return boxed, active

    def project_gradient(self, theta: Tensor, gradient: Tensor) -> Tensor:
        """A gradient (D,) at theta (D,) with respect to the free coordinates: where the vertical offset follows
        the ground, its part is added to the offsets that it follows.
        """
        where = self.space.blocks.get(Parameter.TRANSLATE)
        if self.only_bounds or self.space.count == 0 or self._regions is None or where is None:
            return gradient
        gradient = gradient.clone()
        slope, change = (values[where].view(self.space.count, -1) for values in (gradient, theta))
        slope[:, ::2] += slope[:, 1:2] * self._regions.vertical_slopes(change.cpu().double()).to(slope)
        slope[:, 1] = 0
        return gradient

    def _put_on_ground(self, values: Values) -> list[str]:
        """Put vehicles with image offsets back onto the ground, in place; returns those that were off it."""
        translate = self._block(values, Parameter.TRANSLATE)
        if self._regions is None or translate is None:
            return []
        before = translate.copy()
        translate[:] = self._with_vertical_offset(translate, self._everyone)
        off = np.abs(translate - before).max(axis=1) > TOLERANCE
        return [f"objects[{i}]: ground" for i in np.flatnonzero(off)]

    def _with_vertical_offset(self, translate: Values, rows: Indices) -> Values:
        """Translations (M, k) of vehicles `rows`, with the vertical offset that the ground dictates."""
        where = self.space.blocks.get(Parameter.TRANSLATE)
        if self._regions is None or where is None:
            return translate
        limit = self._upper[where].reshape(self.space.count, -1)[rows, 1]
        change = torch.from_numpy(translate.astype(np.float64))
        return to_float64_array(
            self._regions.to_float64(torch.from_numpy(rows)).project_to_ground(change, torch.from_numpy(limit))
        )

    def _clip_to_bounds(self, values: Values) -> Values:
        return np.minimum(np.maximum(values, self._lower), self._upper).astype(values.dtype)

    def _out_of_bounds(self, values: Values, boxed: Values) -> list[str]:
        return [f"{self.space.name(int(i))}: bounds" for i in np.flatnonzero(boxed != values)]

    def _block(self, values: Values, parameter: Parameter) -> Values | None:
        """theta's block of a vehicle parameter, a view (N, size); None where it is held."""
        where = self.space.blocks.get(parameter)
        return None if where is None else values[where].reshape(self.space.count, -1)

    def _bound_strain(self, mesh: Values) -> Flags:
        """Scale each vehicle's mesh codes (N, 96) back, in place, until its strain holds; returns which."""
        change, full = self._strain.change(mesh), np.ones(len(mesh))
        wrong = self._strained(change)
        if not wrong.any():
            return wrong
        path = self._strain.path(change, wrong, 0.5 * TOLERANCE)
        low, high = np.zeros_like(full), full
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            good = ~path.violated_at(middle)
            low, high = np.where(good, middle, low), np.where(good, high, middle)
        mesh[wrong] = (mesh * low[:, None]).astype(mesh.dtype)[wrong]
        return wrong

    def _strained(self, change: Array) -> Flags:
        """(N,), vehicles with strain out of bounds after a change (N, 10, P)."""
        everyone = np.ones(self.space.count)
        return self._strain.path(change, everyone > 0).violated_at(everyone)

    def _at_rest(self) -> VehicleBoxes:
        """The vehicles as photographed."""
        return VehicleBoxes.from_poses(*extents(self._surface.rest), self._yaw, self._translation)

    def _boxes_at(self, values: Values, surface: Array | None) -> VehicleBoxes:
        """The vehicles at theta (D,), with deformed points `surface` (N, 3, K) m; None: as photographed."""
        rotate, translate = self._block(values, Parameter.ROTATE), self._block(values, Parameter.TRANSLATE)
        low, high = extents(self._surface.rest if surface is None else surface)
        size = self._block(values, Parameter.SIZE)
        if size is not None:
            low, high = low * (1 + size), high * (1 + size)
        yaw = self._yaw if rotate is None else self._yaw + rotate[:, 0]
        translation = self._translation if translate is None else self._translations_m(translate, self._everyone)
        return VehicleBoxes.from_poses(low, high, yaw, translation.copy())

    def _translations_m(self, translate: Values, rows: Indices) -> Array:
        """Translations (M, 3) m of vehicles `rows` at their blocks (M, k) of theta."""
        if self._regions is not None:
            regions = self._regions.to_float64(torch.from_numpy(rows))
            return self._translation[rows] + to_float64_array(
                regions.shift(torch.from_numpy(translate.astype(np.float64)))
            )
        shift = self._shift[rows]
        return self._translation[rows] + translate[:, :1] * shift[:, 0] + translate[:, 1:] * shift[:, 1]

    def _find_violations(self, cars: VehicleBoxes, bounds: ConstraintBounds) -> ConstraintViolations:
        view = self._scene.camera.project(cars, self._everyone)
        sight = self._scene.sight.measure(cars, self._everyone)
        return ConstraintViolations(
            road=bounds.off_road(self._scene.road.measure_share(view), self._everyone),
            frame=bounds.out_of_frame(view),
            hidden=bounds.hidden(sight),
            collide=bounds.collide(cars, self._everyone),
            covers=sight.covers,
        )

    def _still_violating(self, cars: VehicleBoxes, moved: Indices, offenders: Flags) -> Flags:
        """Which of the offenders (N,) take part in a violation after the vehicles `moved` moved, given that none
        did before.
        """
        bounds = self._bounds
        view = self._scene.camera.project(cars, moved)
        wrong = np.zeros(len(offenders), dtype=bool)
        wrong[moved] = bounds.out_of_frame(view)
        collide = bounds.collide(cars, moved)
        wrong |= np.logical_or.reduce(collide, axis=0)
        wrong[moved] |= np.logical_or.reduce(collide, axis=1)
        # Vehicles known to violate something need no further test, as long as they involve no other vehicle.
        untested = np.flatnonzero(~wrong[moved] & (bounds.road[moved] > 0))
        if len(untested):
            share = self._scene.road.measure_share(view, untested)
            wrong[moved[untested]] = bounds.off_road(share, moved[untested])
        if (wrong | ~offenders).all():
            return wrong & offenders
        sight = self._scene.sight.measure(cars, moved)
        hidden = bounds.hidden(sight)
        wrong[sight.rows[hidden]] = True
        return (wrong | find_occluders(sight.covers, hidden)) & offenders

    def _resolve(self, cars: VehicleBoxes, values: Values, surface: Array | None, offenders: Flags) -> None:
        """Make values feasible, in place: offenders (N,) return to 0, and each block is restored as far as all
        constraints allow. A moved vehicle that still hits an offender at 0 becomes an offender too.
        """
        rest, everyone = self._surface.rest, np.ones_like(offenders)
        while True:
            rows = np.flatnonzero(offenders)
            cars.low[rows], cars.high[rows] = extents(rest[rows])
            cars.turn[rows], cars.translation[rows] = unit_complex(self._yaw[rows]), self._translation[rows]
            if offenders.all():
                break
            joined = offenders | self._still_violating(cars, rows, everyone)
            if joined.sum() == len(rows):
                break
            offenders = joined
        if surface is not None:
            self._restore_mesh(cars, values, surface, offenders)
        size = self._block(values, Parameter.SIZE)
        if size is not None:
            low, high = cars.low.copy(), cars.high.copy()

            def grow(moved: Indices) -> None:
                cars.low[moved] = low[moved] * (1 + size[moved])
                cars.high[moved] = high[moved] * (1 + size[moved])

            self._restore_block(cars, offenders, size, grow)
        rotate, translate = self._block(values, Parameter.ROTATE), self._block(values, Parameter.TRANSLATE)
        if rotate is not None:

            def turn(moved: Indices) -> None:
                cars.turn[moved] = unit_complex(self._yaw[moved] + rotate[moved, 0])

            self._restore_block(cars, offenders, rotate, turn)
        if translate is not None:

            def move(moved: Indices) -> None:
                translate[moved] = self._with_vertical_offset(translate[moved], moved)
                cars.translation[moved] = self._translations_m(translate[moved], moved)

            # A kerb stops a car across its heading, not along it: the two are restored one after the other.
            goal = translate.copy()
            translate[offenders] = 0
            for column in (0, goal.shape[1] - 1):
                translate[offenders, column] = goal[offenders, column]
                self._restore_block(cars, offenders, translate[:, column : column + 1], move)

    def _restore_mesh(self, cars: VehicleBoxes, values: Values, surface: Array, offenders: Flags) -> None:
        """Scale the offenders' mesh codes up from 0 towards `values`, in place, as far as is feasible.

        surface: the points (N, 3, K) m at those values; points and strain are linear in the scale.
        """
        mesh = self._block(values, Parameter.MESH)
        assert mesh is not None
        goal, rest = mesh.copy(), self._surface.rest
        path = self._strain.path(self._strain.change(mesh), offenders, 0.5 * TOLERANCE)

        def wrong_at(moved: Indices, scale: Array) -> Flags:
            part = scale[moved, None, None]
            cars.low[moved], cars.high[moved] = extents(rest[moved] * (1 - part) + surface[moved] * part)
            wrong = self._still_violating(cars, moved, offenders)
            # The feasible scales of strain need not be an interval; at 1 it is known to hold.
            return wrong | (path.violated_at(scale) & (scale < 1) & offenders)

        def settle(moved: Indices, scale: Array, known: bool) -> Flags:
            del known  # the rounding of theta, which the straight line leaves out, can change what a ray hits
            mesh[moved] = goal[moved] * scale[moved, None]
            cars.low[moved], cars.high[moved] = extents(self._surface.deform(mesh[moved], moved))
            return self._still_violating(cars, moved, offenders)

        if goal[offenders].any():
            _bisect_scales(wrong_at, settle, offenders)

    def _restore_block(
        self, cars: VehicleBoxes, offenders: Flags, block: Values, follow: Callable[[Indices], None]
    ) -> None:
        """Scale the offenders' columns `block` (N, k) up from 0 towards their values, in place, while feasible.

        follow: moves vehicles to where their block puts them.
        """
        goal = block.copy()

        def wrong_at(moved: Indices, scale: Array) -> Flags:
            return settle(moved, scale, False)

        def settle(moved: Indices, scale: Array, known: bool) -> Flags:
            block[moved] = goal[moved] * scale[moved, None]
            follow(moved)
            return np.zeros_like(offenders) if known else self._still_violating(cars, moved, offenders)

        if goal[offenders].any():
            _bisect_scales(wrong_at, settle, offenders)


def _bisect_scales(
    wrong_at: Callable[[Indices, Array], Flags], settle: Callable[[Indices, Array, bool], Flags], cars: Flags
) -> None:
    """Bisect a scale in [0, 1] for each of the vehicles `cars` (N,), and settle there.

    Args:
        wrong_at: moves vehicles, all that changed since its last call, to their scales (N,) and returns the
            vehicles (N,) that then violate something; at 0 none does.
        settle: the same, finally; its last argument is whether none is known to violate anything.
        cars: (N,), the vehicles to scale.
    """
    full = np.ones(len(cars))
    search = wrong_at(np.flatnonzero(cars), full)
    if not search.any():
        return
    low, high, good = np.zeros_like(full), full, [np.zeros_like(full)]
    for _ in range(_HALVINGS):
        scale = np.where(search, 0.5 * (low + high), full)
        wrong = wrong_at(np.flatnonzero(search), scale)
        # A vehicle that was feasible alone may clash with one that is being restored: it joins the search.
        search = search | wrong
        low = np.where(search & ~wrong, scale, low)
        high = np.where(wrong, np.minimum(high, scale), high)
        if not wrong.any():
            good.append(scale)
    scale = np.where(search, low, full)
    moved, known = np.flatnonzero(search), any(np.array_equal(scale, well) for well in good)
    # Scales found in parallel may clash together: the vehicles involved fall back to 0, which is known to be
    # feasible, and so do those that were feasible at 1 only while another had made way.
    while (wrong := settle(moved, scale, known) & (scale > 0)).any():
        scale, search = np.where(wrong, 0.0, scale), search | wrong
        moved = np.flatnonzero(search)
