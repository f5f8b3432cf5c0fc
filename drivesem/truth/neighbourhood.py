"""The states around a counterexample in which one object may be, as samples that detectors are shown."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from detectors.base import Predictor
from detectors.planted import features as features_of
from drivesem.attack.feasible.projection import FeasibleSet
from drivesem.attack.methods.unit_box import UnitBox
from drivesem.attack.objective import Objective
from drivesem.attack.space import SPECS, Parameter
from drivesem.truth.certificate import Camera, Exposure, margin_of
from drivesem.truth.kinds import Fault, Kind
from drivesem.truth.nuisances import Nuisances
from drivesem.truth.redraw.compositor import CompositorDraw
from drivesem.truth.rules import Floats
from scene_ir.types import SceneIR

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
        from scipy.stats import qmc  # on use: it takes a third of a second to load

        self._sequence = qmc.Halton(
            len(self._own), scramble=True, rng=np.random.default_rng(zlib.crc32(name.encode()))
        )
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
        return Sample(exposure, self._features(scene, exposure))

    def place(self, number: int) -> Floats:
        """Of the number-th state, (d,) in the unit cube: Halton's."""
        while len(self._places) <= number:
            self._places.append(self._sequence.random(1)[0])
        return self._places[number]

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

    def fails(self, sample: Sample, camera: Camera | None = None) -> bool:
        """Whether the object is not found, by the objective's detector, or another camera's. Costs a pass."""
        camera = camera or self._camera
        return not bool(camera.see(sample.exposure).judged.found[self.index])

    def margin(self, sample: Sample) -> float:
        """How far the object is from being lost, in logits beyond t*: below 0 where it is. Costs a pass."""
        look = self._camera.see(sample.exposure)
        beyond = margin_of(Fault(Kind.MISSED, self.index, -1), torch.zeros(4), look)
        assert beyond is not None
        # A detection that meets two objects is one's alone: then what is best placed is not what is found.
        return max(beyond, _LEAST) if bool(look.judged.found[self.index]) else min(beyond, -_LEAST)

    def _features(self, scene: SceneIR, exposure: Exposure) -> dict[str, float]:
        i, objects, environment = self.index, scene.objects, scene.environment
        box = exposure.targets.boxes_xyxy[None, i : i + 1]
        seen = features_of(exposure.picture[None], box.to(exposure.picture), SEEN)[:, 0, 0].tolist()
        found: dict[str, float] = dict(zip(SEEN, seen, strict=True))
        found["distance_m"] = float(objects.translation[i, 2])
        found["yaw_deg"] = math.degrees(math.remainder(float(objects.yaw[i]), 2 * math.pi))
        codes = {
            Parameter.COLOR: objects.texture_code[i],
            Parameter.WEATHER: environment.weather,
            Parameter.FOLIAGE: environment.foliage,
            Parameter.SUN: environment.light,
        }
        for parameter, values in codes.items():
            if parameter in self._objective.space.params:
                found |= dict(zip(SPECS[parameter].names, values.tolist(), strict=True))
        if Parameter.TRANSLATE in self._objective.space.params:
            still = self._objective.space.scene.objects.translation[i]
            found["moved_m"] = float((objects.translation[i] - still).norm())
        if Parameter.SIZE in self._objective.space.params:
            still = self._objective.space.scene.objects.size_lhw[i]
            found["grown_percent"] = 100 * float((objects.size_lhw[i] / still).mean() - 1)
        return found
