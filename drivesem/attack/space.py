"""What an attack may move: the parameters, their units and bounds, and theta, the flat vector of all of them.

theta is flat for the attack and readable for people: every coordinate has a name, a unit and bounds. The scene as
photographed is theta = 0. What is *feasible* inside the bounds is decided by `drivesem.attack.feasible`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Literal

import torch
from torch import Tensor

from drivesem.attack.regions import ROI_DIM, Regions
from drivesem.attack.theta import ParameterSpec, ThetaSpace, lattice_names, parameters_of
from scene_ir import ffd
from scene_ir.errors import FormatError, RangeError, ShapeError
from scene_ir.geometry import kept_within, yaw_matrix
from scene_ir.types import FOLIAGE_DIM, LATTICE, LIGHT_DIM, TEXTURE_DIM, WEATHER_DIM, SceneIR


class Parameter(StrEnum):
    """What can be moved, in the order in which theta holds it."""

    COLOR = "color"
    WEATHER = "weather"
    FOLIAGE = "foliage"
    TRANSLATE = "translate"
    ROTATE = "rotate"
    MESH = "mesh"
    SIZE = "size"
    SUN = "sun"


SIX = tuple(p for p in Parameter if p not in (Parameter.SIZE, Parameter.SUN))
"""The paper's parameters. The others need a budget that goes beyond the paper's."""


_HALF = (LATTICE[0], LATTICE[1], LATTICE[2] // 2)
"""Of the lattice: the other half mirrors it."""

SPECS: dict[Parameter, ParameterSpec] = {
    Parameter.COLOR: ParameterSpec(
        TEXTURE_DIM, True, "code", tuple(f"paint.{n}" for n in ("lightness", "a", "b", "gloss", "dirt"))
    ),
    Parameter.WEATHER: ParameterSpec(
        WEATHER_DIM, False, "code", tuple(f"weather.{n}" for n in ("fog", "rain", "time_of_day", "overcast"))
    ),
    Parameter.FOLIAGE: ParameterSpec(
        FOLIAGE_DIM, False, "code", tuple(f"foliage.{n}" for n in ("hue", "lightness", "density"))
    ),
    Parameter.TRANSLATE: ParameterSpec(2, True, "own lengths", ("translate.along", "translate.across")),
    Parameter.ROTATE: ParameterSpec(1, True, "rad", ("yaw",)),
    Parameter.MESH: ParameterSpec(ffd.SYMMETRIC_DIM, True, "unit boxes", lattice_names("ffd", _HALF)),
    Parameter.SIZE: ParameterSpec(1, True, "share of its own", ("size",)),
    Parameter.SUN: ParameterSpec(
        LIGHT_DIM, False, "code", tuple(f"sun.{n}" for n in ("azimuth", "elevation", "strength"))
    ),
}

Parametrisation = Literal["ground", "roi"]
"""What `translate` counts: own lengths along and across, on the ground; or as 3D-SDN does (`attack.regions`)."""
_IN_REGIONS = ParameterSpec(
    ROI_DIM, True, "of its box, log depth", tuple(f"translate.{n}" for n in ("right", "down", "log_depth"))
)

COMBOS: dict[int, tuple[Parameter, ...]] = {
    1: (Parameter.TRANSLATE, Parameter.ROTATE),
    2: (Parameter.TRANSLATE, Parameter.ROTATE, Parameter.MESH),
    3: (Parameter.TRANSLATE, Parameter.MESH),
    4: (Parameter.ROTATE, Parameter.MESH),
}
"""The paper's combinations for detection."""


_HARDLY_CUT = 0.1
"""Truncation up to which moved cars were held against the truth (`python -m tools.bench moves`)."""


@dataclass(frozen=True, slots=True)
class Budget:
    """How far each parameter may go from the photograph, at most. Codes end at these values whatever they start
    from; the others are distances from the photographed scene, and of several bounds the nearest binds. translate:
    own lengths; translate_m: metres, the same for long and short cars; across_m: metres, across alone;
    of_distance: share of the car's distance from the camera; partly: own lengths, of cars that the photograph does
    not show whole (`shown_whole`); rotate: rad; mesh: unit boxes (the bound on strain in
    `drivesem.attack.feasible` is the one that binds); size: share of a car's own, larger or smaller, 0 where
    sizes are held, as they are of cars that are not shown whole; sun: codes, 0 where it is held.
    """

    color: float = 1.0
    weather: float = 1.0
    foliage: float = 1.0
    translate: float = 0.25
    rotate: float = 0.35
    mesh: float = 0.25
    size: float = 0.0
    sun: float = 0.0
    translate_m: float = math.inf
    across_m: float = math.inf
    of_distance: float = math.inf
    partly: float = math.inf

    def __post_init__(self) -> None:
        unbounded = ("translate_m", "across_m", "of_distance", "partly")
        _check_positive("budget", self, unbounded, may_be_held=("size", "sun"))

    def check(self, params: Iterable[Parameter], parametrisation: Parametrisation = "ground") -> None:
        """FormatError where one of the parameters is held by this budget, or bounded in metres, which `roi` has
        none of.
        """
        metres = (self.translate_m, self.across_m, self.of_distance, self.partly)
        if parametrisation == "roi" and min(metres) < math.inf:
            expected = "a budget without metres, such as paper or translate=0.1, with --parametrisation roi"
            raise FormatError("budget", expected, "one with metres")
        for parameter in params:
            if getattr(self, parameter.value) == 0:
                expected = f"a budget in which {parameter} may change, such as street"
                raise FormatError(f"params: {parameter}", expected, f"one that holds {parameter}")


@dataclass(frozen=True, slots=True)
class StepSizes:
    """The step alpha for each parameter, in theta's units: the paper's, of sizes as long as that of places, of the
    sun as that of leaves."""

    color: float = 0.05
    weather: float = 0.25
    foliage: float = 0.10
    translate: float = 0.01
    rotate: float = 0.01
    mesh: float = 0.025
    size: float = 0.01
    sun: float = 0.10

    def __post_init__(self) -> None:
        _check_positive("steps", self)


def _check_positive(
    what: str, values: Budget | StepSizes, unbounded: Collection[str] = (), may_be_held: Collection[str] = ()
) -> None:
    for entry in fields(values):
        value = getattr(values, entry.name)
        positive = value > 0 or (value == 0 and entry.name in may_be_held)
        if not (positive and (math.isfinite(value) or entry.name in unbounded)):
            raise RangeError(f"{what}.{entry.name}", "a positive number", value)


@dataclass(frozen=True, slots=True)
class Perturbation:
    """theta by parameter; None where a parameter is held. color (N, 5), weather (4,), foliage (3,),
    translate (N, 2), of `roi` (N, 3), rotate (N, 1), mesh (N, 96), size (N, 1), sun (3,): changes from the
    photographed scene.
    """

    color: Tensor | None = None
    weather: Tensor | None = None
    foliage: Tensor | None = None
    translate: Tensor | None = None
    rotate: Tensor | None = None
    mesh: Tensor | None = None
    size: Tensor | None = None
    sun: Tensor | None = None


def parse_params(text: str) -> tuple[Parameter, ...]:
    """Parameters from "translate,rotate,mesh". Raises FormatError naming the unknown one and the known ones."""
    return parameters_of(Parameter, (part for part in text.split(",") if part.strip()))


def combo(number: int) -> tuple[Parameter, ...]:
    """The paper's combination by number. Raises RangeError on an unknown one."""
    if number not in COMBOS:
        raise RangeError("combo", f"one of {', '.join(map(str, COMBOS))}", number)
    return COMBOS[number]


class ParameterSpace(ThetaSpace[Parameter]):
    """The vector theta (D,) of one scene: names, bounds, steps, and the way from theta to a perturbed scene.

    Blocks follow each other in the order of `Parameter`; a block of a parameter of cars is (N, size), row-major.
    dtype and device are those of the scene. parametrisation: of translate; of `roi` the budget's bound and the
    step count for each of its three numbers. Raises FormatError for a parameter that the budget holds.
    """

    def __init__(
        self,
        scene: SceneIR,
        params: Sequence[str],
        budget: Budget | None = None,
        steps: StepSizes | None = None,
        parametrisation: Parametrisation = "ground",
    ) -> None:
        specs = SPECS | {Parameter.TRANSLATE: _IN_REGIONS} if parametrisation == "roi" else SPECS
        super().__init__(parameters_of(Parameter, params), specs, len(scene.objects), scene.objects.translation)
        self.scene = scene
        self.parametrisation: Parametrisation = parametrisation
        self.budget = budget or Budget()
        self.budget.check(self.params, parametrisation)
        self.steps = steps or StepSizes()
        # Constant, as nobody asks for a gradient to the photographed scene.
        self._axes = _ground_axes_of(scene).detach()
        self.regions = Regions.of(scene) if parametrisation == "roi" else None
        for parameter, where in self._slices.items():
            low, high = self._bounds(parameter)
            self.lower[where] = low
            self.upper[where] = high
            self.step[where] = getattr(self.steps, parameter.value)
            if specs[parameter].per_object:
                for bound in (self.lower, self.upper):
                    bound[where].view(self.count, specs[parameter].size)[behind_camera(scene)] = 0

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
                    raise ShapeError(f"perturbation.{parameter.value}", "None (it is held)", tuple(value.shape))
                continue
            spec = self.specs[parameter]
            shape = (self.count, spec.size) if spec.per_object else (spec.size,)
            if value is None or tuple(value.shape) != shape:
                raise ShapeError(
                    f"perturbation.{parameter.value}",
                    f"shape {shape}",
                    None if value is None else tuple(value.shape),
                )
            parts.append(value.reshape(-1))
        return torch.cat(parts) if parts else self.theta0

    def apply(self, scene: SceneIR, theta: Tensor) -> SceneIR:
        """The scene at theta (D,); differentiable to theta. At theta = 0 all tensors equal the originals exactly.

        A translation is a fraction of the car's own length, along and across its photographed heading, and the car
        keeps its height above the ground plane; or it is what `Regions` says. A size grows from its bottom face:
        the wheels stay where they are. Mesh offsets are symmetric left to right, added to the source's.
        Raises ShapeError, and RangeError naming a coordinate that is not finite.
        """
        self.check(theta)
        part = self.unflatten(theta)
        objects, environment = scene.objects, scene.environment
        changes: dict[str, Tensor] = {}
        if part.translate is not None:
            changes["translation"] = objects.translation + self._shift(scene, part.translate)
        if part.rotate is not None:
            changes["yaw"] = objects.yaw + part.rotate[:, 0]
        if part.mesh is not None:
            changes["ffd"] = objects.ffd + ffd.from_symmetric(part.mesh)
        if part.size is not None:
            changes["size_lhw"] = objects.size_lhw * (1 + part.size)
        if part.color is not None:
            changes["texture_code"] = _within(
                objects.texture_code, part.color, -self.budget.color, self.budget.color
            )
        if changes:
            scene = scene.with_objects(**changes)
        codes: dict[str, Tensor] = {}
        if part.weather is not None:
            codes["weather"] = _within(environment.weather, part.weather, 0.0, self.budget.weather)
        if part.foliage is not None:
            limit = self.budget.foliage
            codes["foliage"] = _within(environment.foliage, part.foliage, -limit, limit)
        if part.sun is not None:
            light = environment.light.to(part.sun)
            codes["light"] = _within(light, part.sun, -self.budget.sun, self.budget.sun)
        return scene.with_environment(**codes) if codes else scene

    def _shift(self, scene: SceneIR, translate: Tensor) -> Tensor:
        """What translate's block moves, (N, 3) m."""
        if self.regions is not None:
            return (self.regions if scene is self.scene else Regions.of(scene)).shift(translate)
        axes = self._axes if scene is self.scene else _ground_axes_of(scene)
        return (translate[:, None] @ axes)[:, 0]

    def carried(self, other: ParameterSpace, theta: Tensor) -> Tensor:
        """theta (D',) of another space of the same parameters, as one (D,) of this one, whose scene has the same
        vehicles, and perhaps more after them.
        """
        other.unflatten(theta)
        here = self.theta0.clone()
        for parameter, where in other.blocks.items():
            start = self.blocks[parameter].start
            here[start : start + where.stop - where.start] = theta[where]
        return here

    def physical(self, i: int, value: float) -> tuple[float, str] | None:
        """`value` of coordinate `i` in metres ("m"), degrees ("deg") or percent ("%"); None for a bare code."""
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
        """Bounds of theta's block of `parameter`; they always hold 0."""
        limit = getattr(self.budget, parameter.value)
        if parameter is Parameter.COLOR:
            start, low = self.scene.objects.texture_code.reshape(-1), -limit
        elif parameter is Parameter.WEATHER:
            start, low = self.scene.environment.weather, 0.0
        elif parameter is Parameter.FOLIAGE:
            start, low = self.scene.environment.foliage, -limit
        elif parameter is Parameter.SUN:
            start, low = self.scene.environment.light.to(self.scene.objects.yaw), -limit
        elif parameter is Parameter.TRANSLATE and self.parametrisation == "ground":
            budget, objects = self.budget, self.scene.objects
            length_m, place = objects.size_lhw[:, :1].detach(), objects.translation.detach()
            most_m = length_m.new_tensor([budget.translate_m, min(budget.translate_m, budget.across_m)])
            most_m = torch.minimum(most_m, budget.of_distance * place.norm(dim=1, keepdim=True))
            reach = (most_m / length_m).clamp(max=limit)
            partly = ~shown_whole(self.scene)
            reach[partly] = reach[partly].clamp(max=budget.partly)
            return -reach.reshape(-1), reach.reshape(-1)
        elif parameter is Parameter.SIZE:
            grown = torch.where(shown_whole(self.scene), limit, 0.0)
            return -grown, grown
        else:
            return -limit, limit
        start = start.detach()
        return (low - start).clamp(max=0), (limit - start).clamp(min=0)


def behind_camera(scene: SceneIR) -> Tensor:
    """(N,) bool: the vehicles that are not in the scene (`scene_ir.exchange`), which nothing moves."""
    return scene.objects.translation[:, 2] < 0


def shown_whole(scene: SceneIR) -> Tensor:
    """(N,) bool: the cars that nothing hides, and that the picture's border hardly cuts. Of others a long way
    shows what no photograph did.
    """
    return (scene.objects.occlusion == 0) & (scene.objects.truncation <= _HARDLY_CUT)


def ground_axes(yaw: Tensor, length_m: Tensor, ground: Tensor) -> Tensor:
    """Shifts (N, 2, 3) m of cars on the ground plane: by one own length along the heading, and by one across it
    (towards +z of their own frame). yaw (N,) rad; length_m (N,); ground (4,): n.x + d = 0.

    The horizontal part follows heading; y follows the plane, so the height above it is kept.
    """
    flat = yaw_matrix(yaw).transpose(-1, -2)[:, ::2]
    y = -(ground[0] * flat[..., 0] + ground[2] * flat[..., 2]) / ground[1]
    return torch.stack([flat[..., 0], y, flat[..., 2]], dim=-1) * length_m[:, None, None]


def _ground_axes_of(scene: SceneIR) -> Tensor:
    objects = scene.objects
    return ground_axes(objects.yaw, objects.size_lhw[:, 0], scene.environment.ground)


def _within(start: Tensor, change: Tensor, low: float, high: float) -> Tensor:
    """start + change within [low, high], or up to `start` where that lies outside: 0 changes nothing."""
    return kept_within(start + change, start.clamp(max=low), start.clamp(min=high))
