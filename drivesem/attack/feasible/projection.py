"""The way back to what can be: after every step of an attack, theta is projected onto the feasible set.
Feasible means: inside the bounds; the mesh is not inverted and only moderately strained, its lowest lattice layer
fixed vertically, nothing below its wheels; cars stay on the kind of surface they stood on, do not pass through
each other, and stay in the picture and visible; weather is one that there is, and cars show through it. No
constraint may be violated more than at theta = 0 (real labels overlap and park on kerbs), so theta = 0 is always
feasible. The pose stays on the ground plane by construction of `ParameterSpace.apply`; where a car's place is told
in the picture (`attack.regions`), its offset down follows the others.

`drivesem.attack.feasibility_check` judges finished scenes a second time and shares no code with this module.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from drivesem.attack.feasible.bounds import Bounds, Limits, Surroundings, Violations, coverers
from drivesem.attack.feasible.cars import TOLERANCE, Array, Cars, Flags, Indices, Values, array, turn_of
from drivesem.attack.feasible.strain import StrainBound
from drivesem.attack.feasible.surfaces import CarSurfaces, extents, lowest
from drivesem.attack.feasible.weather import Fading, WeatherSet
from drivesem.attack.space import Parameter, ParameterSpace, behind_camera, ground_axes
from drivesem.attack.theta import Projected
from scene_ir.errors import RangeError

_HALVINGS = 5
"""Bisection steps a block: the scale of a block is found to 1/32."""


class FeasibleSet:
    """The feasible set of one scene's `ParameterSpace`; prepared once, then `project` takes a millisecond.

    only_bounds: `project` keeps to the bounds and asks for nothing else, as the paper does. fades: who is lost
    from sight in which weather; by default nobody.
    """

    def __init__(
        self,
        space: ParameterSpace,
        limits: Limits | None = None,
        only_bounds: bool = False,
        fades: Fading | None = None,
    ) -> None:
        self.space = space
        self.only_bounds = only_bounds
        self.limits = limits or Limits()
        where = space.slice_of(Parameter.WEATHER)
        self._weather = None if where is None else WeatherSet(space, where, self.limits.joint_weather, fades)
        objects = space.scene.objects
        self._lower = array(space.lower)
        self._upper = array(space.upper)
        if space.count == 0:
            return
        self._translation = array(objects.translation)
        self._yaw = array(objects.yaw)
        ground = space.scene.environment.ground.detach().cpu().double()
        length_m = objects.size_lhw[:, 0].detach().cpu().double()
        # (N, 2, 3): what one own length along and one across move.
        self._shift = array(ground_axes(objects.yaw.detach().cpu().double(), length_m, ground))
        self._regions = None if space.regions is None else space.regions.double()
        self._surface = CarSurfaces(space.scene)
        self._strain = StrainBound(self._surface.offsets, self.limits.strain)
        self._surroundings = Surroundings(space.scene)
        self._everyone = np.arange(space.count)
        self._bounds = Bounds.around(self._surroundings, self._at_rest(), self.limits)

    @property
    def violated_at_start(self) -> tuple[str, ...]:
        """What theta = 0 violates, as `objects[3]: collision`: labels that overlap (or leave less than the
        clearance), cars off the road, out of the picture or too small in it, hidden by others, fits that are
        strained. Such a start is kept, and may only not get worse.
        """
        if self.space.count == 0:
            return ()
        strained = [f"objects[{i}]: strain" for i in np.flatnonzero(self._strain.violated_at_start)]
        asked = Bounds.alike(self.space.count, self.limits)
        names = (*strained, *self._examine(self._at_rest(), asked).names())
        away = tuple(f"objects[{i}]:" for i in behind_camera(self.space.scene).nonzero()[:, 0].tolist())
        return tuple(name for name in names if not name.startswith(away))

    def project(self, theta: Tensor) -> Projected:
        """The nearest feasible theta (D,) we can find; `theta` itself where it is feasible.

        Deterministic and idempotent. First the bounds, then weather, then the strain of each mesh, scaled back car
        by car; then the cars that violate something go back to the photograph and take mesh, size, rotation and
        translation up again, each as far as all constraints allow. Raises ShapeError; RangeError naming a
        coordinate that is not finite.
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
        found += [] if self._weather is None else self._weather.violations(values)
        if self.space.count == 0:
            return tuple(found)
        found += self._off_ground(values.copy())
        mesh = self._block(values, Parameter.MESH)
        if mesh is not None:
            found += [f"objects[{i}]: lowest layer" for i in np.flatnonzero((lowest(mesh) != 0).any(axis=(1, 2)))]
            wrong = self._strained(self._strain.change(mesh))
            found += [f"objects[{i}]: strain" for i in np.flatnonzero(wrong)]
        surface = None if mesh is None else self._surface.deformed(mesh)
        return tuple(found + self._examine(self._cars(values, surface), self._bounds).names())

    def _project(self, values: Values) -> tuple[Values, list[str]]:
        boxed = self._box(values)
        active = self._out_of_bounds(values, boxed)
        if self.only_bounds:
            return boxed, active
        if self._weather is not None:
            active += self._weather.bound(boxed, values)
        if self.space.count == 0:
            return boxed, active
        active += self._off_ground(boxed)
        mesh, surface = self._block(boxed, Parameter.MESH), None
        if mesh is not None:
            lowest(mesh)[:] = 0
            active += [f"objects[{i}]: strain" for i in np.flatnonzero(self._bound_strain(mesh))]
            surface = self._surface.deformed(mesh)
        cars = self._cars(boxed, surface)
        found = self._examine(cars, self._bounds)
        offenders = found.cars()
        if offenders.any():
            active += found.names()
            self._back_off(cars, boxed, surface, offenders)
        return boxed, active

    def along(self, theta: Tensor, gradient: Tensor) -> Tensor:
        """What a gradient (D,) at theta (D,) is of the coordinates that are free: where cars are held to the
        ground, what the offset down adds to those that it follows, and nothing of its own.
        """
        where = self.space.slice_of(Parameter.TRANSLATE)
        if self.only_bounds or self.space.count == 0 or self._regions is None or where is None:
            return gradient
        gradient = gradient.clone()
        slope, change = (values[where].view(self.space.count, -1) for values in (gradient, theta))
        slope[:, ::2] += slope[:, 1:2] * self._regions.slopes(change.cpu().double()).to(slope)
        slope[:, 1] = 0
        return gradient

    def _off_ground(self, values: Values) -> list[str]:
        """Put cars that are placed in the picture back onto the ground, in place; returns who was off it."""
        translate = self._block(values, Parameter.TRANSLATE)
        if self._regions is None or translate is None:
            return []
        before = translate.copy()
        translate[:] = self._grounded(translate, self._everyone)
        off = np.abs(translate - before).max(axis=1) > TOLERANCE
        return [f"objects[{i}]: ground" for i in np.flatnonzero(off)]

    def _grounded(self, translate: Values, rows: Indices) -> Values:
        """Translations (M, k) of cars `rows` with what is not free."""
        where = self.space.slice_of(Parameter.TRANSLATE)
        if self._regions is None or where is None:
            return translate
        most = self._upper[where].reshape(self.space.count, -1)[rows, 1]
        change = torch.from_numpy(translate.astype(np.float64))
        return array(self._regions.double(torch.from_numpy(rows)).grounded(change, torch.from_numpy(most)))

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
        path = self._strain.path(change, wrong, 0.5 * TOLERANCE)
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

    def _at_rest(self) -> Cars:
        """The cars as photographed."""
        return Cars.of(*extents(self._surface.rest), self._yaw, self._translation)

    def _cars(self, values: Values, surface: Array | None) -> Cars:
        """The cars at theta; `surface`: their deformed points, None where they are as photographed."""
        rotate, translate = self._block(values, Parameter.ROTATE), self._block(values, Parameter.TRANSLATE)
        low, high = extents(self._surface.rest if surface is None else surface)
        size = self._block(values, Parameter.SIZE)
        if size is not None:
            low, high = low * (1 + size), high * (1 + size)
        yaw = self._yaw if rotate is None else self._yaw + rotate[:, 0]
        translation = self._translation if translate is None else self._moved(translate, self._everyone)
        return Cars.of(low, high, yaw, translation.copy())

    def _moved(self, translate: Values, rows: Indices) -> Array:
        """Where cars `rows` are (M, 3) m, moved by what theta has of them (M, k)."""
        if self._regions is not None:
            regions = self._regions.double(torch.from_numpy(rows))
            return self._translation[rows] + array(regions.shift(torch.from_numpy(translate.astype(np.float64))))
        shift = self._shift[rows]
        return self._translation[rows] + translate[:, :1] * shift[:, 0] + translate[:, 1:] * shift[:, 1]

    def _examine(self, cars: Cars, bounds: Bounds) -> Violations:
        """All that the cars violate."""
        view = self._surroundings.camera.of(cars, self._everyone)
        sight = self._surroundings.sight.of(cars, self._everyone)
        return Violations(
            road=bounds.off_road(self._surroundings.road.share(view), self._everyone),
            frame=bounds.out_of_frame(view),
            hidden=bounds.hidden(sight),
            collide=bounds.collide(cars, self._everyone),
            covers=sight.covers,
        )

    def _wrong(self, cars: Cars, moved: Indices, offenders: Flags) -> Flags:
        """Which of the offenders (N,) take part in a violation, after some of them moved and none was before."""
        bounds = self._bounds
        view = self._surroundings.camera.of(cars, moved)
        wrong = np.zeros(len(offenders), dtype=bool)
        wrong[moved] = bounds.out_of_frame(view)
        collide = bounds.collide(cars, moved)
        wrong |= np.logical_or.reduce(collide, axis=0)
        wrong[moved] |= np.logical_or.reduce(collide, axis=1)
        # What is known to be wrong need not be looked at further, as long as it draws no other car in.
        left = np.flatnonzero(~wrong[moved] & (bounds.road[moved] > 0))
        if len(left):
            share = self._surroundings.road.share(view, left)
            wrong[moved[left]] = bounds.off_road(share, moved[left])
        if (wrong | ~offenders).all():
            return wrong & offenders
        sight = self._surroundings.sight.of(cars, moved)
        hidden = bounds.hidden(sight)
        wrong[sight.rows[hidden]] = True
        return (wrong | coverers(sight.covers, hidden)) & offenders

    def _back_off(self, cars: Cars, values: Values, surface: Array | None, offenders: Flags) -> None:
        """Make values feasible, in place: offenders go back to 0 and take each block up again as far as everything
        allows. Where an offender at 0 is still hit by a car that moved, that car is an offender too.
        """
        rest, everyone = self._surface.rest, np.ones_like(offenders)
        while True:
            rows = np.flatnonzero(offenders)
            cars.low[rows], cars.high[rows] = extents(rest[rows])
            cars.turn[rows], cars.translation[rows] = turn_of(self._yaw[rows]), self._translation[rows]
            if offenders.all():
                break
            joined = offenders | self._wrong(cars, rows, everyone)
            if joined.sum() == len(rows):
                break
            offenders = joined
        if surface is not None:
            self._take_up_mesh(cars, values, surface, offenders)
        size = self._block(values, Parameter.SIZE)
        if size is not None:
            low, high = cars.low.copy(), cars.high.copy()

            def grow(moved: Indices) -> None:
                cars.low[moved] = low[moved] * (1 + size[moved])
                cars.high[moved] = high[moved] * (1 + size[moved])

            self._take_up(cars, offenders, size, grow)
        rotate, translate = self._block(values, Parameter.ROTATE), self._block(values, Parameter.TRANSLATE)
        if rotate is not None:

            def turn(moved: Indices) -> None:
                cars.turn[moved] = turn_of(self._yaw[moved] + rotate[moved, 0])

            self._take_up(cars, offenders, rotate, turn)
        if translate is not None:

            def move(moved: Indices) -> None:
                translate[moved] = self._grounded(translate[moved], moved)
                cars.translation[moved] = self._moved(translate[moved], moved)

            # A kerb stops a car across its heading, not along: the two are found one after the other.
            goal = translate.copy()
            translate[offenders] = 0
            for column in (0, goal.shape[1] - 1):
                translate[offenders, column] = goal[offenders, column]
                self._take_up(cars, offenders, translate[:, column : column + 1], move)

    def _take_up_mesh(self, cars: Cars, values: Values, surface: Array, offenders: Flags) -> None:
        """Bring the offenders' mesh up from 0 to what `values` hold, in place, as far as is feasible.

        surface: the points (N, 3, K) at those values. Between, both they and the strain go along straight lines.
        """
        mesh = self._block(values, Parameter.MESH)
        assert mesh is not None
        goal, rest = mesh.copy(), self._surface.rest
        path = self._strain.path(self._strain.change(mesh), offenders, 0.5 * TOLERANCE)

        def wrong_at(moved: Indices, scale: Array) -> Flags:
            part = scale[moved, None, None]
            cars.low[moved], cars.high[moved] = extents(rest[moved] * (1 - part) + surface[moved] * part)
            wrong = self._wrong(cars, moved, offenders)
            # The feasible scales of a strain need not be an interval; at 1 it is known to hold.
            return wrong | (path.wrong_at(scale) & (scale < 1) & offenders)

        def settle(moved: Indices, scale: Array, known: bool) -> Flags:
            del known  # theta's rounding, which the straight line leaves out, may tip what a ray sees
            mesh[moved] = goal[moved] * scale[moved, None]
            cars.low[moved], cars.high[moved] = extents(self._surface.deformed(mesh[moved], moved))
            return self._wrong(cars, moved, offenders)

        if goal[offenders].any():
            _largest_scales(wrong_at, settle, offenders)

    def _take_up(self, cars: Cars, offenders: Flags, block: Values, follow: Callable[[Indices], None]) -> None:
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
