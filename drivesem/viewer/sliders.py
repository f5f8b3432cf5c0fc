"""Sliders of a scene in physical units, the states that they set, and the command that renders each state.

Names, units and bounds are those of theta (`drivesem.attacks.space`). The 96 mesh offsets of a vehicle share one
slider: the share of the shape that the scene holds.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from drivesem.attacks.space import (
    Budget,
    Parameter,
    ParameterSpace,
    Perturbation,
    behind_camera,
)
from drivesem.config.edits import FOLIAGE_CODES, SUN_CODES, WEATHER_CODES
from scene_ir.errors import RangeError, make_printable
from scene_ir.types import SceneIR, Weather

State = Mapping[str, float]
"""Slider values by name, in the slider's unit. A missing name is 0: as photographed."""
PICTURE = "view.png"
"""File that a state's command writes."""
_STEPS = {"m": 0.01, "deg": 0.1, "%": 0.5, "": 0.01}
"""Step of a slider by unit; "" is the unit of codes."""
_DIGITS = 6
"""Decimals of values, the precision of float32."""
_SHAPE = "shape"
_CODES = (Parameter.COLOR, Parameter.WEATHER, Parameter.FOLIAGE, Parameter.SUN, Parameter.LAMPS)
_SCENE_CODES = {Parameter.WEATHER: WEATHER_CODES, Parameter.FOLIAGE: FOLIAGE_CODES, Parameter.SUN: SUN_CODES}


@dataclass(frozen=True, slots=True)
class Slider:
    """One slider."""

    name: str
    """Name of the coordinate of theta, such as `objects[3].yaw`."""
    title: str
    """Last word of the name."""
    unit: str
    """m, deg, % or "" for a code."""
    low: float
    """Smallest value."""
    high: float
    """Largest value."""
    step: float
    """Distance between two values."""
    found: float
    """Value that the scene holds."""
    car: int | None
    """Row of the vehicle; None for the scene's own sliders."""
    group: str
    """Its parameter, or "shape"."""


class SceneSliders:
    """The sliders of a scene.

    Attributes:
        rest: The scene as photographed; states are changes of it.
        space: Theta of `rest`.
        sliders: Sliders by name.
    """

    def __init__(self, scene: SceneIR, budget: Budget) -> None:
        """Create the sliders within a budget, extended to the values that the scene holds.

        Raises RangeError for a scene without a photograph as its source.
        """
        self.scene = scene
        self.rest = scene.unperturbed()
        if len(scene.objects) and not scene.objects.source:
            raise RangeError("scene", "one that was made from a photograph", "meshes alone")
        found = Perturbation.between(self.rest, scene)
        budget = _widen_budget(budget, found)
        params = [p for p in Parameter if p is not Parameter.MESH and getattr(budget, p.value) > 0]
        self.space = ParameterSpace(self.rest, params, budget)
        found = replace(found, **{p.value: None for p in Parameter if p not in params})
        if found.weather is not None:
            found = replace(found, weather=found.weather[: self.space.specs[Parameter.WEATHER].size])
        self._bent = scene.objects.ffd - self.rest.objects.ffd
        self._places: dict[str, tuple[int, float]] = {}
        self.sliders: dict[str, Slider] = {}
        self._add_space_sliders(self.space.flatten(found))
        for car, bend in enumerate(self._bent):
            if bool((bend != 0).any()):
                name = f"objects[{car}].{_SHAPE}"
                self.sliders[name] = Slider(name, _SHAPE, "%", 0.0, 100.0, 1.0, 100.0, car, _SHAPE)

    @property
    def found(self) -> dict[str, float]:
        """State that the scene holds."""
        return {name: slider.found for name, slider in self.sliders.items() if slider.found}

    def state(self, values: Mapping[str, float]) -> State:
        """Validate values and drop zeros. Raises RangeError for an unknown slider or a value out of range."""
        for name, value in values.items():
            slider = self.sliders.get(name)
            if slider is None:
                raise RangeError(make_printable(name), "a parameter of this scene", "an unknown name")
            if not slider.low <= value <= slider.high:
                unit = f" {slider.unit}" if slider.unit else ""
                raise RangeError(name, f"{slider.low:g} to {slider.high:g}{unit}", value)
        return {name: value for name, value in values.items() if value}

    def apply(self, state: State) -> SceneIR:
        """Return the scene in a state."""
        theta = self.space.theta0.clone()
        shares = self._bent.new_zeros(len(self._bent))
        for name, value in state.items():
            if name in self._places:
                place, factor = self._places[name]
                theta[place] = value / factor
            else:
                shares[self.sliders[name].car or 0] = value / 100
        scene = self.space.apply(self.rest, theta)
        if not shares.any():
            return scene
        return scene.with_objects(ffd=self.rest.objects.ffd + shares[:, None, None] * self._bent)

    def command(self, folder: Path, state: State) -> str:
        """Command line, for a POSIX shell, that renders a state of the scene in `folder`."""
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
        """A state as the assignments of `drivesem edit --set`."""
        assignments: dict[str, str] = {}
        for parameter, where in self.space.blocks.items():
            spec, names = self.space.specs[parameter], _SCENE_CODES.get(parameter)
            for start in range(where.start, where.stop, spec.size):
                here = [self.space.name(i) for i in range(start, start + spec.size)]
                values = [state.get(name, 0.0) for name in here]
                if names is not None:
                    assignments |= {
                        f"{parameter}.{n}": _format_number(v) for n, v in zip(names, values, strict=False) if v
                    }
                elif any(values):
                    unit = self.sliders[here[0]].unit
                    car = (start - where.start) // spec.size
                    texts = (f"{_format_number(value)}{unit}" for value in values)
                    assignments[f"objects[{car}].{parameter}"] = ",".join(texts)
        for name, slider in self.sliders.items():
            if slider.group == _SHAPE and state.get(name):
                assignments[f"objects[{slider.car}].{Parameter.MESH}"] = f"{_format_number(state[name])}%"
        return assignments

    def _add_space_sliders(self, found: Tensor) -> None:
        lower, upper, values = self.space.lower.tolist(), self.space.upper.tolist(), found.tolist()
        away = behind_camera(self.rest).tolist()
        for parameter, where in self.space.blocks.items():
            spec = self.space.specs[parameter]
            for i in range(where.start, where.stop):
                car = (i - where.start) // spec.size if spec.per_object else None
                factor, unit = self.space.physical(i, 1.0) or (1.0, "")
                step, value = _STEPS[unit], round(values[i] * factor, _DIGITS)
                low, high = (_round_inward(bound * factor, step) for bound in (lower[i], upper[i]))
                low, high = min(low, value), max(high, value)
                if low == high or (car is not None and away[car]):
                    continue
                name = self.space.name(i)
                self._places[name] = (i, factor)
                title = name.rpartition(".")[2].replace("_", " ")
                self.sliders[name] = Slider(name, title, unit, low, high, step, value, car, str(parameter))


def _widen_budget(budget: Budget, found: Perturbation) -> Budget:
    """Extend the budget to the codes and sizes that the scene holds."""
    wider: dict[str, Any] = {}
    for parameter in (*_CODES, Parameter.SIZE):
        values = getattr(found, parameter.value)
        most = float(values.abs().max()) if values.numel() else 0.0
        if most > max(getattr(budget, parameter.value), 1e-6):
            wider[parameter.value] = most
    if found.weather is not None:
        wider["night"] = max(budget.night, float(found.weather[Weather.NIGHT]))
        wider["snow"] = max(budget.snow, float(found.weather[Weather.SNOW]))
    return replace(budget, **wider)


def _round_inward(bound: float, step: float) -> float:
    """Round a bound towards zero to a whole number of steps, tolerating float32 rounding."""
    return math.copysign(math.floor(abs(bound) / step + 1e-3) * step, bound)


def _format_number(value: float) -> str:
    """Format a number without an exponent."""
    return f"{value:.{_DIGITS}f}".rstrip("0").rstrip(".")
