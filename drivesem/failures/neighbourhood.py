"""Samples of the states around a counterexample, or anywhere within the bounds, with the object's features."""

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
from detectors.planted import compute_features
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.methods.margin_search import UnitBox
from drivesem.attacks.objective import Objective
from drivesem.attacks.space import Parameter
from drivesem.failures.certificate import (
    CompositorRenderer,
    NuisanceCamera,
    SampleImage,
    SampleOutcome,
    fault_margin,
)
from drivesem.failures.kinds import Fault, Kind
from drivesem.failures.margin_oracle import NuisanceMarginOracle
from drivesem.failures.nuisances import Nuisances
from drivesem.failures.rules import Floats
from scene_ir.types import SceneIR

if TYPE_CHECKING:
    from scipy.stats.qmc import QMCEngine

IMAGE_FEATURES: tuple[str, ...] = ("height_px", "aspect", "across", "lightness", "contrast")
"""Features of the object's label and of the image inside it, see `detectors.planted.FEATURES`."""
NEAR_REACH = 0.3
"""Share of the reach within which states are near the counterexample."""
_MIN_ABS_MARGIN = 1e-6
"""Smallest absolute margin in logits, where object and best candidate disagree about the sign."""
POSE_FEATURES = ("distance_m", "yaw_deg")
"""Depth of the object's origin; its heading about the vertical axis in KITTI's convention."""


@dataclass(frozen=True, slots=True)
class ObjectSample:
    """One state in one nuisance sample, described for one object."""

    image: SampleImage
    """The rendered sample."""
    features: dict[str, float]
    """The object's features by name."""


class Neighbourhood:
    """The states within reach of theta: one object and the scene's shared parameters vary, other objects stay."""

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
        """Prepare the samples.

        Args:
            objective: Scene, detector and labels.
            feasible: Set that every state is projected to.
            theta: (D,) the counterexample.
            index: The object.
            nuisances: Ranges of the nuisance samples.
            name: Name of the samples, which follow from it and their number alone.
            reach: Largest change either way, as a share of the bounds' width.
        """
        self._objective, self._feasible, self._theta, self.index = objective, feasible, theta, index
        self._box = UnitBox(objective.problem(feasible), objective.space.theta0)
        self._own = ((self._box.owner == index) | (self._box.owner < 0)).nonzero()[:, 0]
        mine = (self._box.theta_owner == index) | (self._box.theta_owner < 0)
        self._mine = mine.to(theta.device)
        self._span = reach * (objective.space.upper - objective.space.lower)
        renderer = CompositorRenderer(objective.compositor, objective.labeller)
        self._camera = NuisanceCamera(renderer, objective.detector, objective.t_star, nuisances, f"hole:{name}")
        self._sequence = _make_halton(len(self._own), name)
        self._points: list[Floats] = []

    def sample(self, number: int, part: float = 1.0) -> ObjectSample | None:
        """Render the state of a number in a nuisance sample of that number; `part` is the share of the reach to
        use. None where the object does not count.
        """
        return self.sample_at(self.unit_point(number), number, part)

    def sample_at(self, point: Floats, draw: int, part: float = 1.0) -> ObjectSample | None:
        """Render the state at a point of the unit cube.

        Args:
            point: (d,) in [0, 1].
            draw: Number of the nuisance sample.
            part: Share of the reach to use.

        Returns:
            None where the object does not count.
        """
        scene = self._objective.space.apply(self._objective.space.scene, self.theta_at(point, part))
        ignore = torch.zeros(len(scene.objects), dtype=torch.bool)
        image = self._camera.render(scene, draw, ignore)
        if bool(image.targets.ignore[self.index]):
            return None
        return ObjectSample(image, describe_object(self._objective, scene, image, self.index))

    def unit_point(self, number: int) -> Floats:
        """Halton's point (d,) of that number in the unit cube."""
        return _sequence_point(self._points, self._sequence, number)

    def theta(self, number: int, part: float = 1.0) -> Tensor:
        """The feasible state (D,) of that number; a smaller `part` of the reach keeps states closer together."""
        return self.theta_at(self.unit_point(number), part)

    def theta_at(self, point: Floats, part: float = 1.0) -> Tensor:
        """The feasible state (D,) at a point (d,) of the unit cube; see `theta`."""
        box_point = self._box.start.clone()
        box_point[self._own] = torch.from_numpy(point).to(box_point)
        change = torch.where(self._mine, self._box.theta(box_point) - self._theta, 0)
        if part < 1:
            change = part * change
        change = torch.minimum(torch.maximum(change, -part * self._span), part * self._span)
        return self._feasible.project(self._theta + change).theta

    def camera_for(self, detector: Predictor, t_star: float) -> NuisanceCamera:
        """A camera with another detector, which sees the same images."""
        return replace(self._camera, detector=detector, t_star=t_star)

    def evaluate(self, sample: ObjectSample, camera: NuisanceCamera | None = None) -> SampleOutcome:
        """Run the objective's detector, or another camera's, on a sample. Costs a pass."""
        return (camera or self._camera).detect(sample.image)

    def fails(self, sample: ObjectSample, camera: NuisanceCamera | None = None) -> bool:
        """Whether the object is missed. Costs a pass."""
        return not bool(self.evaluate(sample, camera).outcome.detected[self.index])

    def margin(self, sample: ObjectSample) -> float:
        """The object's margin in logits, negative where it is missed. Costs a pass."""
        return object_margin(self._camera.detect(sample.image), self.index)


class SceneSampler:
    """Samples all objects of a scene at once, each anywhere within the bounds.

    `counted_objects` lists the objects that are detected in the benign image.
    """

    def __init__(self, objective: Objective, feasible: FeasibleSet, nuisances: Nuisances, name: str) -> None:
        self._objective, self._feasible = objective, feasible
        self._box = UnitBox(objective.problem(feasible), objective.space.theta0)
        renderer = CompositorRenderer(objective.compositor, objective.labeller)
        self.camera = NuisanceCamera(
            renderer, objective.detector, objective.t_star, nuisances, f"everywhere:{name}"
        )
        self.counted_objects = (
            NuisanceMarginOracle.for_objective(objective, nuisances, name).counted_objects.nonzero()[:, 0].tolist()
        )
        self._sequence = _make_halton(len(self._box.owner), name)
        self._points: list[Floats] = []

    def theta(self, number: int) -> Tensor:
        """The feasible state (D,) of that number."""
        point = torch.from_numpy(_sequence_point(self._points, self._sequence, number))
        return self._feasible.project(self._box.theta(point.to(self._box.start))).theta

    def render(self, number: int, camera: NuisanceCamera | None = None) -> SampleImage:
        """Render the state of a number in a nuisance sample of that number, by this or another camera."""
        scene = self._objective.space.apply(self._objective.space.scene, self.theta(number))
        nothing = torch.zeros(len(scene.objects), dtype=torch.bool)
        return (camera or self.camera).render(scene, number, nothing)

    def sample(self, number: int) -> dict[int, ObjectSample]:
        """Describe the counted objects that count in the state of a number, without a detector pass."""
        return self.sample_at(self.theta(number), number)

    def sample_at(self, theta: Tensor, draw: int) -> dict[int, ObjectSample]:
        """The same for a feasible state (D,) and the number of a nuisance sample."""
        scene = self._objective.space.apply(self._objective.space.scene, theta)
        image = self.camera.render(scene, draw, torch.zeros(len(scene.objects), dtype=torch.bool))
        counts = [index for index in self.counted_objects if not bool(image.targets.ignore[index])]
        return {
            index: ObjectSample(image, describe_object(self._objective, scene, image, index)) for index in counts
        }

    def margins(self, samples: Mapping[int, ObjectSample]) -> dict[int, float]:
        """Margins of the objects of one state, in logits. Costs a pass if there is an object."""
        if not samples:
            return {}
        outcome = self.camera.detect(next(iter(samples.values())).image)
        return {index: object_margin(outcome, index) for index in samples}


def object_margin(outcome: SampleOutcome, index: int) -> float:
    """An object's margin in a sample, in logits: negative exactly where it is missed."""
    margin = fault_margin(Fault(Kind.MISSED, index, -1), torch.zeros(4), outcome)
    assert margin is not None
    # A detection can overlap two objects but detects only one of them.
    detected = bool(outcome.outcome.detected[index])
    return max(margin, _MIN_ABS_MARGIN) if detected else min(margin, -_MIN_ABS_MARGIN)


def describe_object(objective: Objective, scene: SceneIR, image: SampleImage, index: int) -> dict[str, float]:
    """Compute an object's features.

    Args:
        objective: Scene and parameters.
        scene: The state.
        image: Its image and labels.
        index: The object.

    Returns:
        Values by name: `IMAGE_FEATURES`, `POSE_FEATURES`, and the codes and changes of the parameters in use.
    """
    objects, environment, space = scene.objects, scene.environment, objective.space
    box = image.targets.boxes_xyxy[None, index : index + 1]
    image_values = compute_features(image.image[None], box.to(image.image), IMAGE_FEATURES)[:, 0, 0].tolist()
    features: dict[str, float] = dict(zip(IMAGE_FEATURES, image_values, strict=True))
    features["distance_m"] = float(objects.translation[index, 2])
    features["yaw_deg"] = math.degrees(math.remainder(float(objects.yaw[index]), 2 * math.pi))
    codes = {
        Parameter.COLOR: objects.texture_code[index],
        Parameter.WEATHER: environment.weather,
        Parameter.FOLIAGE: environment.foliage,
        Parameter.SUN: environment.light,
        Parameter.LAMPS: objects.lamps[index : index + 1],
    }
    for parameter, values in codes.items():
        if parameter in space.params:
            features |= dict(zip(space.specs[parameter].names, values.tolist(), strict=False))
    if Parameter.TRANSLATE in space.params:
        features["moved_m"] = float((objects.translation[index] - space.scene.objects.translation[index]).norm())
    if Parameter.SIZE in space.params:
        still = space.scene.objects.size_lhw[index]
        features["grown_percent"] = 100 * float((objects.size_lhw[index] / still).mean() - 1)
    return features


def _make_halton(dimensions: int, name: str) -> QMCEngine:
    from scipy.stats import qmc  # imported on use: it takes a third of a second

    return qmc.Halton(dimensions, scramble=True, rng=np.random.default_rng(zlib.crc32(name.encode())))


def _sequence_point(points: list[Floats], sequence: QMCEngine, number: int) -> Floats:
    """The point of that number; `points` caches those drawn so far."""
    while len(points) <= number:
        points.append(sequence.random(1)[0])
    return points[number]
