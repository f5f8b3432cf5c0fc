"""The parameters of a scene that an attack moves, their units and bounds, and theta, the flat vector of all of
them.

theta is flat for the attack and readable for people: every coordinate has a name, a unit and bounds. theta = 0 is
the photographed scene. What is *feasible* inside the bounds is decided by `drivesem.attacks.feasible`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Literal

import torch
from torch import Tensor

from drivesem.attacks.theta import ParameterSpec, ThetaSpace, lattice_names, select_parameters
from scene_ir import ffd
from scene_ir.errors import FormatError, RangeError, ShapeError
from scene_ir.geometry import clamp_inclusive, yaw_matrix
from scene_ir.types import (
    CLOTHES_DIM,
    DAYLIGHT_DIM,
    FOLIAGE_DIM,
    LATTICE,
    LIGHT_DIM,
    TEXTURE_DIM,
    WEATHER_DIM,
    SceneIR,
    Weather,
    replace_unchecked,
)

ROI_DIM = 3
"""Offset right and down, in region widths and heights; log depth."""
_MIN_SIZE_PX = 1.0
"""Minimum width and height of a region, so that a label without size can still move."""
_NEWTON_STEPS = 5
"""Newton iterations to the ground; the function is nearly linear, two would do."""
_HALVINGS = 6
"""Halvings of a change until its vertical offset is within bounds; after them the vehicle does not move."""


@dataclass(frozen=True, slots=True)
class RegionsOfInterest:
    """N vehicles in camera coordinates, as 3D-SDN parametrises their positions."""

    rays_m: Tensor
    """(N, 3) m, from the camera to the centre of each 3D box."""
    spans_m: Tensor
    """(N, 2, 3) m, one region width and one region height at the vehicle's depth."""
    ground_normal: Tensor
    """(3,), normal of the ground plane."""

    @classmethod
    def from_scene(cls, scene: SceneIR) -> RegionsOfInterest:
        """The regions of a scene's vehicles, from their 2D boxes."""
        objects = scene.objects
        matrix = scene.camera.matrix.to(objects.translation).detach()
        inverse = torch.linalg.inv(matrix[:, :3])
        middle = objects.translation.detach().clone()
        middle[:, 1] -= objects.size_lhw[:, 1].detach() / 2
        depth = middle @ matrix[2, :3] + matrix[2, 3]
        box = objects.box2d.to(middle)
        size = (box[:, 2:] - box[:, :2]).clamp_min(_MIN_SIZE_PX)
        spans_m = inverse[:, :2].T * (depth[:, None] * size)[..., None]
        return cls(middle + inverse @ matrix[:, 3], spans_m, scene.environment.ground[:3].to(middle).detach())

    def to_float64(self, rows: Tensor | slice = slice(None)) -> RegionsOfInterest:
        """The regions `rows`, in float64 on the CPU."""
        rays_m, spans_m, normal = (part.cpu().double() for part in (self.rays_m, self.spans_m, self.ground_normal))
        return RegionsOfInterest(rays_m[rows], spans_m[rows], normal)

    def shift(self, change: Tensor) -> Tensor:
        """Shift (N, 3) m caused by changes (N, 3); differentiable, and exactly 0 at 0."""
        direction = self._direction(change)
        distance = self.rays_m.norm(dim=1, keepdim=True) * torch.exp(change[:, 2:] / 2)
        return direction * (distance / direction.norm(dim=1, keepdim=True)) - self.rays_m

    def project_to_ground(self, change: Tensor, limit: Tensor) -> Tensor:
        """Changes (N, 3) with the vertical offset that keeps each vehicle's height above the ground plane. Where
        that offset exceeds `limit` (N,), the change is halved, repeatedly, or dropped.
        """
        change = change.clone()
        for _ in range(_HALVINGS):
            change[:, 1] = self._solve_vertical_offset(change)
            exceeds = ~(change[:, 1].abs() <= limit)
            if not bool(exceeds.any()):
                return change
            change[exceeds] /= 2
        change[:, 1] = self._solve_vertical_offset(change)
        change[~(change[:, 1].abs() <= limit)] = 0
        return change

    def vertical_slopes(self, change: Tensor) -> Tensor:
        """Derivatives (N, 2) of the vertical offset on the ground, by horizontal offset and by log depth."""
        direction, height_slopes = self._direction(change), self._height_slopes(change)
        length = direction.norm(dim=1, keepdim=True)
        distance = self.rays_m.norm(dim=1, keepdim=True) * torch.exp(change[:, 2:] / 2)
        depth_slope = (direction * (distance / length)) @ self.ground_normal / 2
        return -torch.stack([height_slopes[:, 0], depth_slope], dim=1) / height_slopes[:, 1:]

    def _direction(self, change: Tensor) -> Tensor:
        return self.rays_m + (change[:, :2, None] * self.spans_m).sum(dim=1)

    def _height_slopes(self, change: Tensor) -> Tensor:
        """Derivatives (N, 2) of the height above the plane by the offsets right and down."""
        direction = self._direction(change)
        length = direction.norm(dim=1)[:, None, None]
        unit = direction[:, None] / length
        tangents = self.spans_m - unit * (self.spans_m * unit).sum(dim=2, keepdim=True)
        distance = (self.rays_m.norm(dim=1) * torch.exp(change[:, 2] / 2))[:, None, None]
        return (tangents * (distance / length)) @ self.ground_normal

    def _solve_vertical_offset(self, change: Tensor) -> Tensor:
        """The vertical offset (N,) that keeps the height above the plane, by Newton's method."""
        change = change.clone()
        change[:, 1] = 0
        for _ in range(_NEWTON_STEPS):
            change[:, 1] -= self.shift(change) @ self.ground_normal / self._height_slopes(change)[:, 1]
        return change[:, 1]


class Parameter(StrEnum):
    """Parameters of a scene, in the order of their blocks in theta."""

    COLOR = "color"
    WEATHER = "weather"
    FOLIAGE = "foliage"
    TRANSLATE = "translate"
    ROTATE = "rotate"
    MESH = "mesh"
    SIZE = "size"
    SUN = "sun"
    LAMPS = "lamps"


PAPER_PARAMETERS = tuple(p for p in Parameter if p not in (Parameter.SIZE, Parameter.SUN, Parameter.LAMPS))
"""The paper's parameters. The others need a budget beyond the paper's."""


_HALF_LATTICE = (LATTICE[0], LATTICE[1], LATTICE[2] // 2)
"""Independent half of the lattice; the other half mirrors it."""

_WEATHER_NAMES = tuple(
    f"weather.{'time_of_day' if code is Weather.TIME else code.name.lower()}" for code in Weather
)
_TINT = ("lightness", "a", "b")
_PAINT_NAMES = tuple(f"paint.{n}" for n in (*_TINT, "gloss", "dirt", *(f"lower_{n}" for n in _TINT)))


def _weather_spec(size: int) -> ParameterSpec:
    """The first `size` codes of `Weather`."""
    return ParameterSpec(size, False, "code", _WEATHER_NAMES[:size])


def _color_spec(size: int) -> ParameterSpec:
    """The first `size` texture codes."""
    return ParameterSpec(size, True, "code", _PAINT_NAMES[:size])


SPECS: dict[Parameter, ParameterSpec] = {
    Parameter.COLOR: _color_spec(CLOTHES_DIM),
    Parameter.WEATHER: _weather_spec(WEATHER_DIM),
    Parameter.FOLIAGE: ParameterSpec(
        FOLIAGE_DIM, False, "code", tuple(f"foliage.{n}" for n in ("hue", "lightness", "density"))
    ),
    Parameter.TRANSLATE: ParameterSpec(2, True, "own lengths", ("translate.along", "translate.across")),
    Parameter.ROTATE: ParameterSpec(1, True, "rad", ("yaw",)),
    Parameter.MESH: ParameterSpec(ffd.SYMMETRIC_DIM, True, "unit boxes", lattice_names("ffd", _HALF_LATTICE)),
    Parameter.SIZE: ParameterSpec(1, True, "share of its own", ("size",)),
    Parameter.SUN: ParameterSpec(
        LIGHT_DIM, False, "code", tuple(f"sun.{n}" for n in ("azimuth", "elevation", "strength"))
    ),
    Parameter.LAMPS: ParameterSpec(1, True, "code", ("lamps",)),
}

Parametrisation = Literal["ground", "roi"]
"""Unit of `translate`: own lengths along and across, on the ground; or 3D-SDN's image offsets (`attack.roi`)."""
_ROI_TRANSLATE = ParameterSpec(
    ROI_DIM, True, "of its box, log depth", tuple(f"translate.{n}" for n in ("right", "down", "log_depth"))
)

COMBOS: dict[int, tuple[Parameter, ...]] = {
    1: (Parameter.TRANSLATE, Parameter.ROTATE),
    2: (Parameter.TRANSLATE, Parameter.ROTATE, Parameter.MESH),
    3: (Parameter.TRANSLATE, Parameter.MESH),
    4: (Parameter.ROTATE, Parameter.MESH),
}
"""The paper's combinations for detection."""


_MAX_TRUNCATION = 0.1
"""Truncation up to which moved vehicles were compared with the truth (`python -m tools.bench moves`)."""


_UPRIGHT_LIMITS: dict[Parameter, float | tuple[float, ...]] = {
    Parameter.COLOR: (0.5, 0.5, 0.5, 0.0, 0.0, 0.5, 0.5, 0.5),
    Parameter.ROTATE: math.radians(5),
    Parameter.MESH: 0.0,
    Parameter.SIZE: 0.05,
    Parameter.LAMPS: 0.0,
}
"""Limits of people and cyclists besides the budget's: a surface that faces the camera hardly turns, and has no limbs
to move; beyond half of the code, clothes lose their folds and patterns, and gloss and dirt are those of paint."""


@dataclass(frozen=True, slots=True)
class Budget:
    """Limits of the change. Codes are bounded in value, regardless of the start; other limits are distances from
    the photographed scene. Where several limits apply, the tightest binds.
    """

    color: float = 1.0
    """Code, absolute."""
    weather: float = 1.0
    """Code."""
    foliage: float = 1.0
    """Code, absolute."""
    translate: float = 0.25
    """Own lengths, along and across."""
    rotate: float = 0.35
    """rad."""
    mesh: float = 0.25
    """Unit boxes; the bound on strain (`drivesem.attacks.feasible`) is usually tighter."""
    size: float = 0.0
    """Share of a vehicle's own size, larger or smaller; 0 fixes it. Vehicles that are not fully visible keep
    theirs."""
    sun: float = 0.0
    """Code, absolute; 0 fixes it."""
    night: float = 0.0
    """Code of night, as far as `weather` allows it too; 0 fixes it."""
    snow: float = 0.0
    """Code of snow, likewise."""
    lamps: float = 0.0
    """Code, absolute; 0 fixes it."""
    translate_m: float = math.inf
    """Metres, along and across, the same for long and short vehicles."""
    across_m: float = math.inf
    """Metres, across alone."""
    distance_share: float = math.inf
    """Share of the vehicle's distance from the camera."""
    partly_visible: float = math.inf
    """Own lengths, for vehicles that are not `fully_visible` in the photograph."""
    walk_m: float = 0.0
    """Metres, along and across, for people and cyclists instead of own lengths and `across_m`; 0: as for vehicles."""

    def __post_init__(self) -> None:
        unbounded = ("translate_m", "across_m", "distance_share", "partly_visible")
        _check_positive(
            "budget", self, unbounded, zero_allowed=("size", "sun", "night", "snow", "lamps", "walk_m")
        )

    def check(self, params: Iterable[Parameter], parametrisation: Parametrisation = "ground") -> None:
        """Raise FormatError for a parameter that this budget fixes, or for a budget in metres with `roi`."""
        metres = (self.translate_m, self.across_m, self.distance_share, self.partly_visible)
        if parametrisation == "roi" and min(metres) < math.inf:
            expected = "a budget without metres, such as paper or translate=0.1, with --parametrisation roi"
            raise FormatError("budget", expected, "one with metres")
        for parameter in params:
            if getattr(self, parameter.value) == 0:
                expected = f"a budget in which {parameter} may change, such as street"
                raise FormatError(f"params: {parameter}", expected, f"one that holds {parameter}")


@dataclass(frozen=True, slots=True)
class StepSizes:
    """The step alpha of each parameter, in theta's units: the paper's; size steps like translate, sun like
    foliage, lamps like weather.
    """

    color: float = 0.05
    """Code."""
    weather: float = 0.25
    """Code."""
    foliage: float = 0.10
    """Code."""
    translate: float = 0.01
    """Own lengths."""
    rotate: float = 0.01
    """rad."""
    mesh: float = 0.025
    """Unit boxes, of a lattice offset."""
    size: float = 0.01
    """Share of the vehicle's size."""
    sun: float = 0.10
    """Code."""
    lamps: float = 0.25
    """Code."""

    def __post_init__(self) -> None:
        _check_positive("steps", self)


def _check_positive(
    what: str, values: Budget | StepSizes, unbounded: Collection[str] = (), zero_allowed: Collection[str] = ()
) -> None:
    for entry in fields(values):
        value = getattr(values, entry.name)
        positive = value > 0 or (value == 0 and entry.name in zero_allowed)
        if not (positive and (math.isfinite(value) or entry.name in unbounded)):
            raise RangeError(f"{what}.{entry.name}", "a positive number", value)


@dataclass(frozen=True, slots=True)
class Perturbation:
    """theta by parameter, as changes from the photographed scene; None for a fixed parameter."""

    color: Tensor | None = None
    """(N, 5) or (N, 8), codes."""
    weather: Tensor | None = None
    """(6,), codes; without snow in the budget (5,), and without night either the paper's (4,)."""
    foliage: Tensor | None = None
    """(3,), codes."""
    translate: Tensor | None = None
    """(N, 2) own lengths, with `roi` (N, 3)."""
    rotate: Tensor | None = None
    """(N, 1) rad."""
    mesh: Tensor | None = None
    """(N, 96) unit boxes."""
    size: Tensor | None = None
    """(N, 1), share of the own size."""
    sun: Tensor | None = None
    """(3,), codes."""
    lamps: Tensor | None = None
    """(N, 1), codes."""

    @classmethod
    def between(cls, photographed: SceneIR, scene: SceneIR) -> Perturbation:
        """All changes from the photographed scene to a state of it, by `ground` parametrisation."""
        before, now, environment = photographed.objects, scene.objects, scene.environment
        flat = ground_axes(before.yaw, torch.ones_like(before.yaw), photographed.environment.ground)[..., [0, 2]]
        moved_m = (flat @ (now.translation - before.translation)[:, [0, 2], None])[..., 0]
        return cls(
            color=now.texture_code,
            weather=environment.weather,
            foliage=environment.foliage,
            translate=moved_m / before.size_lhw[:, :1],
            rotate=(now.yaw - before.yaw)[:, None],
            mesh=ffd.to_symmetric(now.ffd - before.ffd),
            size=now.size_lhw[:, :1] / before.size_lhw[:, :1] - 1,
            sun=environment.light.to(before.yaw),
            lamps=now.lamps[:, None],
        )


def parse_params(text: str) -> tuple[Parameter, ...]:
    """Parameters from "translate,rotate,mesh". Raises FormatError naming the unknown one and the known ones."""
    return select_parameters(Parameter, (part for part in text.split(",") if part.strip()))


def combo_parameters(number: int) -> tuple[Parameter, ...]:
    """The parameters of one of the paper's combinations. Raises RangeError on an unknown number."""
    if number not in COMBOS:
        raise RangeError("combo", f"one of {', '.join(map(str, COMBOS))}", number)
    return COMBOS[number]


class ParameterSpace(ThetaSpace[Parameter]):
    """The vector theta (D,) of one scene: names, bounds, steps, and the perturbed scene at theta.

    Blocks follow each other in the order of `Parameter`; a block of a vehicle parameter is (N, size), row-major.
    dtype and device are those of the scene.
    """

    def __init__(
        self,
        scene: SceneIR,
        params: Sequence[str],
        budget: Budget | None = None,
        steps: StepSizes | None = None,
        parametrisation: Parametrisation = "ground",
    ) -> None:
        """Lay out theta.

        Args:
            scene: the photographed scene.
            params: what theta moves.
            budget: limits of the change.
            steps: the step alpha of each parameter.
            parametrisation: of translate; with `roi` limit and step apply to each of its three numbers.

        Raises:
            FormatError: the budget fixes one of the parameters.
        """
        self.budget = budget or Budget()
        specs = SPECS | {Parameter.TRANSLATE: _ROI_TRANSLATE} if parametrisation == "roi" else SPECS
        past = Weather.SNOW if self.budget.night else DAYLIGHT_DIM
        specs = specs if self.budget.snow else specs | {Parameter.WEATHER: _weather_spec(past)}
        specs = specs | {Parameter.COLOR: _color_spec(scene.objects.texture_code.shape[1])}
        super().__init__(
            select_parameters(Parameter, params), specs, len(scene.objects), scene.objects.translation
        )
        self.scene = scene
        self.parametrisation: Parametrisation = parametrisation
        self.budget.check(self.params, parametrisation)
        self.steps = steps or StepSizes()
        # Constant: no gradient flows to the photographed scene.
        self._axes = _scene_ground_axes(scene).detach()
        self.regions = RegionsOfInterest.from_scene(scene) if parametrisation == "roi" else None
        for parameter, where in self._slices.items():
            low, high = self._bounds(parameter)
            self.lower[where] = low
            self.upper[where] = high
            self.step[where] = getattr(self.steps, parameter.value)
            if specs[parameter].per_object:
                most = self.upper.new_tensor(_UPRIGHT_LIMITS.get(parameter, math.inf))
                most = most[: specs[parameter].size] if parameter is Parameter.COLOR else most
                upright = scene.objects.upright
                for bound in (self.lower, self.upper):
                    block = bound[where].view(self.count, specs[parameter].size)
                    block[behind_camera(scene)] = 0
                    block[upright] = block[upright].clamp(-most, most)
                    if parameter is Parameter.COLOR:
                        block[~scene.objects.parted, TEXTURE_DIM:] = 0

    def unflatten(self, theta: Tensor) -> Perturbation:
        """theta (D,) as named tensors (views of it). Raises ShapeError."""
        if tuple(theta.shape) != (self.dim,):
            raise ShapeError("theta", f"shape ({self.dim},)", tuple(theta.shape))
        return Perturbation(**{str(parameter): self.block(theta, parameter) for parameter in self.params})

    def flatten(self, perturbation: Perturbation) -> Tensor:
        """The inverse of `unflatten`. Raises ShapeError where a parameter is missing, unexpected or misshaped."""
        parts = []
        for parameter in Parameter:
            value = getattr(perturbation, parameter.value)
            where = self._slices.get(parameter)
            if where is None:
                if value is not None:
                    raise ShapeError(f"perturbation.{parameter.value}", "None (it is fixed)", tuple(value.shape))
                continue
            spec = self.specs[parameter]
            shape = (self.count, spec.size) if spec.per_object else (spec.size,)
            actual = None if value is None else tuple(value.shape)
            if value is None or actual != shape:
                raise ShapeError(f"perturbation.{parameter.value}", f"shape {shape}", actual)
            parts.append(value.reshape(-1))
        return torch.cat(parts) if parts else self.theta0

    def apply(self, scene: SceneIR, theta: Tensor) -> SceneIR:
        """The scene at theta (D,); differentiable in theta. At theta = 0 all tensors equal the originals exactly.

        A translation is a share of the vehicle's own length, along and across its photographed heading, at constant
        height above the ground plane; with `roi` see `RegionsOfInterest`. Sizes scale about the bottom face, so that
        wheels stay in place. Mesh offsets are symmetric left to right and added to the source's. Raises ShapeError,
        and RangeError naming a coordinate that is not finite.
        """
        self.check(theta)
        part = self.unflatten(theta)
        objects, environment = scene.objects, scene.environment
        changes: dict[str, Tensor] = {}
        if part.translate is not None:
            changes["translation"] = objects.translation + self._shift_m(scene, part.translate)
        if part.rotate is not None:
            changes["yaw"] = objects.yaw + part.rotate[:, 0]
        if part.mesh is not None:
            changes["ffd"] = objects.ffd + ffd.from_symmetric(part.mesh)
        if part.size is not None:
            changes["size_lhw"] = objects.size_lhw * (1 + part.size)
        budget = self.budget
        if part.color is not None:
            changes["texture_code"] = _clamp_code(objects.texture_code, part.color, -budget.color, budget.color)
        if part.lamps is not None:
            changes["lamps"] = _clamp_code(objects.lamps, part.lamps[:, 0], -budget.lamps, budget.lamps)
        if part.size is not None:
            scene = scene.with_objects(**changes)
        elif changes:  # of a valid scene by a finite theta
            scene = replace_unchecked(scene, objects=replace_unchecked(scene.objects, **changes))
        codes: dict[str, Tensor] = {}
        if part.weather is not None:
            start = environment.weather
            changed = _clamp_code(
                start[: len(part.weather)], part.weather, 0.0, self._weather_limits(part.weather)
            )
            codes["weather"] = torch.cat([changed, start[len(part.weather) :].to(changed)])
        if part.foliage is not None:
            codes["foliage"] = _clamp_code(environment.foliage, part.foliage, -budget.foliage, budget.foliage)
        if part.sun is not None:
            codes["light"] = _clamp_code(environment.light.to(part.sun), part.sun, -budget.sun, budget.sun)
        return scene.with_environment(**codes) if codes else scene

    def _weather_limits(self, codes: Tensor) -> Tensor:
        """Upper bounds of weather codes (4,), (5,) or (6,)."""
        weather, rare = self.budget.weather, (self.budget.night, self.budget.snow)
        limits = [weather] * DAYLIGHT_DIM + [min(weather, limit) for limit in rare]
        return codes.new_tensor(limits)[: len(codes)]

    def _shift_m(self, scene: SceneIR, translate: Tensor) -> Tensor:
        """Shift (N, 3) m caused by translate's block."""
        if self.regions is not None:
            return (self.regions if scene is self.scene else RegionsOfInterest.from_scene(scene)).shift(translate)
        axes = self._axes if scene is self.scene else _scene_ground_axes(scene)
        return (translate[:, None] @ axes)[:, 0]

    def convert_theta(self, other: ParameterSpace, theta: Tensor) -> Tensor:
        """theta (D,) of this space with the values of theta (D',) of another space of the same parameters. This
        scene has the other's vehicles, possibly followed by more.
        """
        other.unflatten(theta)
        converted = self.theta0.clone()
        for parameter, where in other.blocks.items():
            start = self.blocks[parameter].start
            converted[start : start + where.stop - where.start] = theta[where]
        return converted

    def physical(self, i: int, value: float) -> tuple[float, str] | None:
        """`value` of coordinate `i` in metres ("m"), degrees ("deg") or percent ("%"); None for a code."""
        parameter, owner, k = self._locate(i)
        size_lhw = self.scene.objects.size_lhw
        if parameter is Parameter.TRANSLATE and self.regions is not None:
            return 100 * (math.expm1(value / 2) if k == ROI_DIM - 1 else value), "%"
        if parameter is Parameter.TRANSLATE:
            return value * float(size_lhw[owner, 0]), "m"
        if parameter is Parameter.ROTATE:
            return math.degrees(value), "deg"
        if parameter is Parameter.MESH:
            return value * float(size_lhw[owner, k % 3]), "m"
        if parameter is Parameter.SIZE:
            return 100 * value, "%"
        return None

    def _bounds(self, parameter: Parameter) -> tuple[Tensor | float, Tensor | float]:
        """Bounds of theta's block of `parameter`; they always include 0."""
        limit = getattr(self.budget, parameter.value)
        if parameter is Parameter.COLOR:
            start, low = self.scene.objects.texture_code.reshape(-1), -limit
        elif parameter is Parameter.LAMPS:
            start, low = self.scene.objects.lamps, -limit
        elif parameter is Parameter.WEATHER:
            start, low = self.scene.environment.weather[: self.specs[parameter].size], 0.0
            limit = self._weather_limits(start)
        elif parameter is Parameter.FOLIAGE:
            start, low = self.scene.environment.foliage, -limit
        elif parameter is Parameter.SUN:
            start, low = self.scene.environment.light.to(self.scene.objects.yaw), -limit
        elif parameter is Parameter.TRANSLATE and self.parametrisation == "ground":
            budget, objects = self.budget, self.scene.objects
            length_m, place = objects.size_lhw[:, :1].detach(), objects.translation.detach()
            limit_m = length_m.new_tensor([budget.translate_m, min(budget.translate_m, budget.across_m)])
            walks = objects.upright[:, None] & (budget.walk_m > 0)
            limit_m = torch.where(walks, min(budget.walk_m, budget.translate_m), limit_m)
            limit_m = torch.minimum(limit_m, budget.distance_share * place.norm(dim=1, keepdim=True))
            reach = limit_m / length_m
            reach = torch.where(walks, reach, reach.clamp(max=limit))
            hidden = ~fully_visible(self.scene)
            reach[hidden] = reach[hidden].clamp(max=budget.partly_visible)
            return -reach.reshape(-1), reach.reshape(-1)
        elif parameter is Parameter.SIZE:
            growth = torch.where(fully_visible(self.scene), limit, 0.0)
            return -growth, growth
        else:
            return -limit, limit
        start = start.detach()
        return (low - start).clamp(max=0), (limit - start).clamp(min=0)


def behind_camera(scene: SceneIR) -> Tensor:
    """(N,) bool, vehicles behind the camera: placeholders that are not in the scene (`scene_ir.exchange`)."""
    return scene.objects.translation[:, 2] < 0


def fully_visible(scene: SceneIR) -> Tensor:
    """(N,) bool, vehicles that nothing hides and that the picture's border hardly cuts. Moving others far would
    show surfaces that the photograph does not.
    """
    return (scene.objects.occlusion == 0) & (scene.objects.truncation <= _MAX_TRUNCATION)


def ground_axes(yaw: Tensor, length_m: Tensor, ground: Tensor) -> Tensor:
    """Shifts of vehicles on the ground plane by one own length along and across their heading, at constant height.

    Args:
        yaw: (N,) rad.
        length_m: (N,) m.
        ground: (4,), the plane n.x + d = 0.

    Returns:
        (N, 2, 3) m: along, and across towards +z of the vehicle's frame.
    """
    flat = yaw_matrix(yaw).transpose(-1, -2)[:, ::2]
    y = -(ground[0] * flat[..., 0] + ground[2] * flat[..., 2]) / ground[1]
    return torch.stack([flat[..., 0], y, flat[..., 2]], dim=-1) * length_m[:, None, None]


def _scene_ground_axes(scene: SceneIR) -> Tensor:
    objects = scene.objects
    return ground_axes(objects.yaw, objects.size_lhw[:, 0], scene.environment.ground)


def _clamp_code(start: Tensor, change: Tensor, low: float, high: float | Tensor) -> Tensor:
    """start + change within [low, high], or up to `start` where that lies outside, so that 0 changes nothing."""
    return clamp_inclusive(start + change, start.clamp(max=low), start.clamp(min=high))
