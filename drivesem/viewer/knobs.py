"""What can be moved in a scene, in the units that people write; the states this makes, and a command for each.

Everything follows from theta (`drivesem.attack.space`): its names, units and bounds. Mesh offsets are 96 a
vehicle, which nobody moves by hand: where a scene holds other shapes than its photograph, they move together, by a
share.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from drivesem.attack.space import (
    SPECS,
    Budget,
    Parameter,
    ParameterSpace,
    Perturbation,
    behind_camera,
    ground_axes,
)
from drivesem.config.edits import FOLIAGE_NAMES, SUN_NAMES, WEATHER_NAMES
from scene_ir.errors import RangeError, shown
from scene_ir.types import SceneIR

State = Mapping[str, float]
"""Values by the names of knobs, in their units. Those that are not named are 0: as photographed."""
PICTURE = "view.png"
"""What a state's command writes."""
_STEPS = {"m": 0.01, "deg": 0.1, "%": 0.5, "": 0.01}
"""Of sliders, by unit; "" is a code's."""
_DIGITS = 6
"""Decimals of values: as float32 holds them."""
_SHAPE = "shape"
_CODES = (Parameter.COLOR, Parameter.WEATHER, Parameter.FOLIAGE, Parameter.SUN)
_SCENE_CODES = {Parameter.WEATHER: WEATHER_NAMES, Parameter.FOLIAGE: FOLIAGE_NAMES, Parameter.SUN: SUN_NAMES}


@dataclass(frozen=True, slots=True)
class Knob:
    """One slider. name: as theta has it, such as `objects[3].yaw`; title: its last word; unit: m, deg, % or "" of
    a code; low, high: how far it goes; step: from one place to the next; found: the value that the scene holds;
    car: whose it is, None of what belongs to the scene; group: its parameter, or shape.
    """

    name: str
    title: str
    unit: str
    low: float
    high: float
    step: float
    found: float
    car: int | None
    group: str


class Knobs:
    """The knobs of a scene as a folder holds it. budget: how far they go; they reach what the scene holds, however
    far that is. Raises RangeError for a scene that no photograph was the source of.

    rest: the scene as photographed, of which states are changes; space: theta of it.
    """

    def __init__(self, scene: SceneIR, budget: Budget) -> None:
        self.scene = scene
        self.rest = scene.at_rest()
        if len(scene.objects) and not scene.objects.source:
            raise RangeError("scene", "one that was made from a photograph", "meshes alone")
        found = _changes(self.rest, scene)
        budget = _reaching(budget, found)
        params = [p for p in Parameter if p is not Parameter.MESH and getattr(budget, p.value) > 0]
        self.space = ParameterSpace(self.rest, params, budget)
        found = replace(found, **{p.value: None for p in Parameter if p not in params})
        self._bent = scene.objects.ffd - self.rest.objects.ffd
        self._places: dict[str, tuple[int, float]] = {}
        self.knobs: dict[str, Knob] = {}
        self._of_space(self.space.flatten(found))
        for car, bend in enumerate(self._bent):
            if bool((bend != 0).any()):
                name = f"objects[{car}].{_SHAPE}"
                self.knobs[name] = Knob(name, _SHAPE, "%", 0.0, 100.0, 1.0, 100.0, car, _SHAPE)

    @property
    def found(self) -> dict[str, float]:
        """The state that the scene holds."""
        return {name: knob.found for name, knob in self.knobs.items() if knob.found}

    def state(self, values: Mapping[str, float]) -> State:
        """Values as a state. RangeError naming the knob that there is none of, or the value beyond its ends."""
        for name, value in values.items():
            knob = self.knobs.get(name)
            if knob is None:
                raise RangeError(shown(name), "a parameter of this scene", "an unknown name")
            if not knob.low <= value <= knob.high:
                unit = f" {knob.unit}" if knob.unit else ""
                raise RangeError(name, f"{knob.low:g} to {knob.high:g}{unit}", value)
        return {name: value for name, value in values.items() if value}

    def apply(self, state: State) -> SceneIR:
        """The scene in a state."""
        theta = self.space.theta0.clone()
        shares = self._bent.new_zeros(len(self._bent))
        for name, value in state.items():
            if name in self._places:
                place, factor = self._places[name]
                theta[place] = value / factor
            else:
                shares[self.knobs[name].car or 0] = value / 100
        scene = self.space.apply(self.rest, theta)
        if not shares.any():
            return scene
        return scene.with_objects(ffd=self.rest.objects.ffd + shares[:, None, None] * self._bent)

    def command(self, folder: Path, state: State) -> str:
        """The line that draws a state of the scene in `folder`, for a POSIX shell."""
        settings = [f"{place}={value}" for place, value in self._settings(state).items()]
        words = ["drivesem", "edit", str(folder)]
        if self.found:
            words.append("--photographed")
        elif not settings:
            words[1] = "render"
        for setting in settings:
            words += ["--set", setting]
        return shlex.join([*words, "--out", PICTURE])

    def _settings(self, state: State) -> dict[str, str]:
        """A state by the words of `drivesem edit --set`."""
        told: dict[str, str] = {}
        for parameter, where in self.space.blocks.items():
            spec, names = SPECS[parameter], _SCENE_CODES.get(parameter)
            for start in range(where.start, where.stop, spec.size):
                here = [self.space.name(i) for i in range(start, start + spec.size)]
                values = [state.get(name, 0.0) for name in here]
                if names is not None:
                    told |= {f"{parameter}.{n}": _plain(v) for n, v in zip(names, values, strict=True) if v}
                elif any(values):
                    unit = self.knobs[here[0]].unit
                    car = (start - where.start) // spec.size
                    told[f"objects[{car}].{parameter}"] = ",".join(f"{_plain(v)}{unit}" for v in values)
        for name, knob in self.knobs.items():
            if knob.group == _SHAPE and state.get(name):
                told[f"objects[{knob.car}].{Parameter.MESH}"] = f"{_plain(state[name])}%"
        return told

    def _of_space(self, found: Tensor) -> None:
        lower, upper, values = self.space.lower.tolist(), self.space.upper.tolist(), found.tolist()
        away = behind_camera(self.rest).tolist()
        for parameter, where in self.space.blocks.items():
            spec = SPECS[parameter]
            for i in range(where.start, where.stop):
                car = (i - where.start) // spec.size if spec.per_object else None
                factor, unit = self.space.physical(i, 1.0) or (1.0, "")
                step, value = _STEPS[unit], round(values[i] * factor, _DIGITS)
                low, high = (_inward(bound * factor, step) for bound in (lower[i], upper[i]))
                low, high = min(low, value), max(high, value)
                if low == high or (car is not None and away[car]):
                    continue  # nothing to move
                name = self.space.name(i)
                self._places[name] = (i, factor)
                title = name.rpartition(".")[2].replace("_", " ")
                self.knobs[name] = Knob(name, title, unit, low, high, step, value, car, str(parameter))


def _changes(rest: SceneIR, scene: SceneIR) -> Perturbation:
    """What a scene differs by from itself at rest, but for the shapes."""
    there, here = rest.objects, scene.objects
    flat = ground_axes(there.yaw, torch.ones_like(there.yaw), rest.environment.ground)[..., [0, 2]]
    moved_m = (flat @ (here.translation - there.translation)[:, [0, 2], None])[..., 0]
    environment = scene.environment
    return Perturbation(
        color=here.texture_code,
        weather=environment.weather,
        foliage=environment.foliage,
        translate=moved_m / there.size_lhw[:, :1],
        rotate=(here.yaw - there.yaw)[:, None],
        size=here.size_lhw[:, :1] / there.size_lhw[:, :1] - 1,
        sun=environment.light.to(there.yaw),
    )


def _reaching(budget: Budget, found: Perturbation) -> Budget:
    """The budget, with codes and sizes as far as the scene holds them."""
    wider: dict[str, Any] = {}
    for parameter in (*_CODES, Parameter.SIZE):
        values = getattr(found, parameter.value)
        most = float(values.abs().max()) if values.numel() else 0.0
        if most > max(getattr(budget, parameter.value), 1e-6):
            wider[parameter.value] = most
    return replace(budget, **wider)


def _inward(bound: float, step: float) -> float:
    """A bound as a whole number of steps, not beyond itself but for float32's rounding."""
    return math.copysign(math.floor(abs(bound) / step + 1e-3) * step, bound)


def _plain(value: float) -> str:
    """A number without an exponent."""
    return f"{value:.{_DIGITS}f}".rstrip("0").rstrip(".")
