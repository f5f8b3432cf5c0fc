"""The states around a counterexample in which one object may be, as samples that detectors are shown."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from detectors.base import Predictor
from detectors.planted import features as features_of
from drivesem.attack.feasible.projection import FeasibleSet
from drivesem.attack.methods.unit_box import UnitBox
from drivesem.attack.objective import Objective
from drivesem.attack.space import SPECS, Parameter
from drivesem.failures.certificate import Camera, Exposure, SampleOutcome, margin_of
from drivesem.failures.kinds import Fault, Kind
from drivesem.failures.nuisances import Nuisances
from drivesem.failures.rules import Floats
from drivesem.failures.second_renderer.compositor import CompositorDraw
from drivesem.failures.views import DrawnViews
from scene_ir.types import SceneIR

if TYPE_CHECKING:
    from scipy.stats.qmc import QMCEngine

SEEN: tuple[str, ...] = ("height_px", "aspect", "across", "lightness", "contrast")
"""Features of the object's label and of the picture in it, see `detectors.planted.FEATURES`."""
NEAR = 0.3
"""Part of the reach in which states lie that are near the counterexample."""
_LEAST = 1e-6
"""Margin, in logits, of what is just found."""
PLACED = ("distance_m", "yaw_deg")
"""distance_m: depth of the object's origin; yaw_deg: its heading about the vertical axis, as KITTI counts it."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One state in one draw of the nuisances. features: by name, of the object."""

    exposure: Exposure
    features: dict[str, float]


class Neighbourhood:
    """What object `index` and what all objects share may become, within reach of theta (D,), the others as found.

    reach: how far, as a share of the bounds' width either way, within the bounds. name: of the samples and their
    draws, which follow from it and their number alone.
    """

    def __init__(
        self,
        objective: Objective,
        feasible: FeasibleSet,
        theta: Tensor,
        index: int,
        nuisances: Nuisances,
        name: str,
        reach: float = 1.0,
    ) -> None:
        self._objective, self._feasible, self._theta, self.index = objective, feasible, theta, index
        self._box = UnitBox(objective.problem(feasible), objective.space.theta0)
        self._own = ((self._box.owner == index) | (self._box.owner < 0)).nonzero()[:, 0]
        mine = (self._box.holder == index) | (self._box.holder < 0)
        self._mine = mine.to(theta.device)
        self._span = reach * (objective.space.upper - objective.space.lower)
        renderer = CompositorDraw(objective.compositor, objective.labeller)
        self._camera = Camera(renderer, objective.detector, objective.t_star, nuisances, f"hole:{name}")
        self._sequence = _halton(len(self._own), name)
        self._places: list[Floats] = []

    def sample(self, number: int, part: float = 1.0) -> Sample | None:
        """The number-th state, seen once; None where the object does not count there. part: of the reach."""
        return self.sample_at(self.place(number), number, part)

    def sample_at(self, place: Floats, draw: int, part: float = 1.0) -> Sample | None:
        """The state at a place (d,) of the unit cube, in a draw by its number; see `sample`."""
        scene = self._objective.space.apply(self._objective.space.scene, self.theta_at(place, part))
        ignore = torch.zeros(len(scene.objects), dtype=torch.bool)
        exposure = self._camera.expose(scene, draw, ignore)
        if bool(exposure.targets.ignore[self.index]):
            return None
        return Sample(exposure, described(self._objective, scene, exposure, self.index))

    def place(self, number: int) -> Floats:
        """Of the number-th state, (d,) in the unit cube: Halton's."""
        return _nth(self._places, self._sequence, number)

    def theta(self, number: int, part: float = 1.0) -> Tensor:
        """Of the number-th state (D,), feasible. part: of the reach, in which states lie closer together."""
        return self.theta_at(self.place(number), part)

    def theta_at(self, place: Floats, part: float = 1.0) -> Tensor:
        """At a place (d,) of the unit cube, see `theta`."""
        at = self._box.start.clone()
        at[self._own] = torch.from_numpy(place).to(at)
        away = torch.where(self._mine, self._box.theta(at) - self._theta, 0)
        if part < 1:
            away = part * away
        away = torch.minimum(torch.maximum(away, -part * self._span), part * self._span)
        return self._feasible.project(self._theta + away).theta

    def camera_of(self, detector: Predictor, t_star: float) -> Camera:
        """Another detector in the place of the objective's, which sees the same pictures."""
        return replace(self._camera, detector=detector, t_star=t_star)

    def look(self, sample: Sample, camera: Camera | None = None) -> SampleOutcome:
        """What the objective's detector, or another camera's, makes of a sample. Costs a pass."""
        return (camera or self._camera).see(sample.exposure)

    def fails(self, sample: Sample, camera: Camera | None = None) -> bool:
        """Whether the object is not found, by either. Costs a pass."""
        return not bool(self.look(sample, camera).judged.found[self.index])

    def margin(self, sample: Sample) -> float:
        """How far the object is from being lost, in logits beyond t*: below 0 where it is. Costs a pass."""
        return margin_in(self._camera.see(sample.exposure), self.index)


class Everywhere:
    """All objects of a scene, each anywhere within the bounds: one pass tells of all of them.

    name: of the states and their draws, which follow from it and their number alone. judged: objects found as
    photographed, whose losses count.
    """

    def __init__(self, objective: Objective, feasible: FeasibleSet, nuisances: Nuisances, name: str) -> None:
        self._objective, self._feasible = objective, feasible
        self._box = UnitBox(objective.problem(feasible), objective.space.theta0)
        renderer = CompositorDraw(objective.compositor, objective.labeller)
        self.camera = Camera(renderer, objective.detector, objective.t_star, nuisances, f"everywhere:{name}")
        self.judged = DrawnViews.of(objective, nuisances, name).judged.nonzero()[:, 0].tolist()
        self._sequence = _halton(len(self._box.owner), name)
        self._places: list[Floats] = []

    def theta(self, number: int) -> Tensor:
        """Of the number-th state (D,), feasible."""
        place = torch.from_numpy(_nth(self._places, self._sequence, number))
        return self._feasible.project(self._box.theta(place.to(self._box.start))).theta

    def exposed(self, number: int, camera: Camera | None = None) -> Exposure:
        """The number-th state in a draw of that number, whoever draws it."""
        scene = self._objective.space.apply(self._objective.space.scene, self.theta(number))
        nothing = torch.zeros(len(scene.objects), dtype=torch.bool)
        return (camera or self.camera).expose(scene, number, nothing)

    def sample(self, number: int) -> dict[int, Sample]:
        """The number-th state, by those judged objects that count there. No detector is asked."""
        return self.sample_of(self.theta(number), number)

    def sample_of(self, theta: Tensor, draw: int) -> dict[int, Sample]:
        """The same of a feasible theta (D,), in a draw by its number."""
        scene = self._objective.space.apply(self._objective.space.scene, theta)
        exposure = self.camera.expose(scene, draw, torch.zeros(len(scene.objects), dtype=torch.bool))
        counts = [index for index in self.judged if not bool(exposure.targets.ignore[index])]
        return {index: Sample(exposure, described(self._objective, scene, exposure, index)) for index in counts}

    def margins(self, samples: Mapping[int, Sample]) -> dict[int, float]:
        """How far each object of one state is from being lost, see `Neighbourhood.margin`. Costs a pass, if there
        is an object.
        """
        if not samples:
            return {}
        look = self.camera.see(next(iter(samples.values())).exposure)
        return {index: margin_in(look, index) for index in samples}


def margin_in(look: SampleOutcome, index: int) -> float:
    """How far an object is from being lost in a look, in logits beyond t*: below 0 where it is not found."""
    beyond = margin_of(Fault(Kind.MISSED, index, -1), torch.zeros(4), look)
    assert beyond is not None
    # A detection that meets two objects is one's alone: then what is best placed is not what is found.
    return max(beyond, _LEAST) if bool(look.judged.found[index]) else min(beyond, -_LEAST)


def described(objective: Objective, scene: SceneIR, exposure: Exposure, index: int) -> dict[str, float]:
    """Features by name of an object of a scene, of which a picture was taken."""
    objects, environment, space = scene.objects, scene.environment, objective.space
    box = exposure.targets.boxes_xyxy[None, index : index + 1]
    seen = features_of(exposure.picture[None], box.to(exposure.picture), SEEN)[:, 0, 0].tolist()
    found: dict[str, float] = dict(zip(SEEN, seen, strict=True))
    found["distance_m"] = float(objects.translation[index, 2])
    found["yaw_deg"] = math.degrees(math.remainder(float(objects.yaw[index]), 2 * math.pi))
    codes = {
        Parameter.COLOR: objects.texture_code[index],
        Parameter.WEATHER: environment.weather,
        Parameter.FOLIAGE: environment.foliage,
        Parameter.SUN: environment.light,
    }
    for parameter, values in codes.items():
        if parameter in space.params:
            found |= dict(zip(SPECS[parameter].names, values.tolist(), strict=True))
    if Parameter.TRANSLATE in space.params:
        found["moved_m"] = float((objects.translation[index] - space.scene.objects.translation[index]).norm())
    if Parameter.SIZE in space.params:
        still = space.scene.objects.size_lhw[index]
        found["grown_percent"] = 100 * float((objects.size_lhw[index] / still).mean() - 1)
    return found


def _halton(dimensions: int, name: str) -> QMCEngine:
    from scipy.stats import qmc  # on use: it takes a third of a second to load

    return qmc.Halton(dimensions, scramble=True, rng=np.random.default_rng(zlib.crc32(name.encode())))


def _nth(known: list[Floats], sequence: QMCEngine, number: int) -> Floats:
    """The number-th place of a sequence, of which some are known."""
    while len(known) <= number:
        known.append(sequence.random(1)[0])
    return known[number]
