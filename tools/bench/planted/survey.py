"""What a detector sees of a frame's cars, as photographed and where theta brings them: where to plant faults."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.stats import qmc
from torch import Tensor

from detectors import boxes
from detectors.base import lower_probability
from detectors.planted import BLIND_TO, FEATURES, PIXEL_FEATURES, Band, PlantedFault, compute_features, group_cars
from detectors.types import CLASSES
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.objective import Objective
from drivesem.evaluation.failures import MATCH_IOU
from drivesem.failures.certificate import CompositorRenderer
from drivesem.failures.nuisances import Nuisances
from scene_ir.types import SceneIR

HALTON = 128
"""Draws of a scrambled Halton sequence over all of the bounds: they measure how rare a fault is."""
CORNERS = 48
"""Corners of the bounds, each parameter at one of them or held: they show what else can be reached."""
CAMERA_DRAWS = 8
"""Draws of the camera before any change: they measure how features vary between pictures."""
MOSTLY = 0.75
"""Of looks: as many draws must fail after a change for a failure to be certain."""
_BY_FACTOR = ("height_px", "aspect")
"""Features by which a detector's box is off by a factor; by the others it is off by a difference."""


@dataclass(frozen=True, slots=True)
class FeatureObservation:
    """Predictions of a detector without a fault for the cars in one picture, with the features that faults use."""

    values: Tensor
    """Of FEATURES, of the K cars that it sees, (F, K)."""
    car: Tensor
    """Of predictions, which of these each is about, (R,) int64."""
    scores: Tensor
    """Of predictions, which of these each is about, (R,)."""
    meets: Tensor
    """Whether each finds one of the scene's objects, score and place; none that is ignored, (N, R) bool."""
    labelled: Tensor
    """Of FEATURES, of the objects by their labels, (F, N)."""
    t_star: float

    @classmethod
    @torch.no_grad()
    def of(cls, objective: Objective, image: Tensor, labels_xyxy: Tensor, ignore: Tensor) -> FeatureObservation:
        """In an image (3, H, W) with labels (N, 4) px and ignore (N,) bool of the scene's objects."""
        detector = objective.differentiable
        label = detector.classes.index(BLIND_TO)
        candidates = detector.candidates(detector(image[None]))
        placed, scores = candidates.boxes_for_class(label), candidates.log_scores[:, label].exp()
        cars = group_cars(placed, scores)
        own = scores[cars.rows]
        meets = boxes.iou_matrix(labels_xyxy.to(placed), placed[cars.rows]) >= MATCH_IOU
        meets &= (own >= objective.t_star) & ~ignore.to(meets.device)[:, None]
        values = compute_features(image[None], cars.boxes_xyxy[None])[:, 0]
        labelled = compute_features(image[None], labels_xyxy.to(image)[None])[:, 0]
        return cls(values, cars.car, own, meets, labelled, objective.t_star)

    @property
    def main(self) -> Tensor:
        """Features (F, N) of each object, of the car that the best prediction that finds it is about; nan where
        none does.
        """
        found = torch.full((len(self.values), len(self.meets)), torch.nan)
        for i, own in enumerate(self.meets):
            if bool(own.any()):
                found[:, i] = self.values[:, self.car[self.scores.where(own, 0.0).argmax()]]
        return found

    @property
    def single(self) -> Tensor:
        """(N,) bool: objects that are found, all predictions of which are about one car."""
        return torch.tensor([len(self.car[own].unique()) == 1 for own in self.meets])

    def lost(self, fault: PlantedFault) -> Tensor:
        """Objects (N,) bool that are found, and are not with the fault."""
        rows = [FEATURES.index(name) for name in fault.feature_names]
        by = fault.depth * fault.membership(self.values[rows])
        still = lower_probability(self.scores, by[self.car]) >= self.t_star
        return self.meets.any(1) & ~(self.meets & still).any(1)


class ObservedFrame:
    """A scene's cars at theta, by labels and pictures. judged (N,) bool: its cars that count."""

    def __init__(self, objective: Objective) -> None:
        self.objective = objective
        paper = objective.benign.paper
        self.judged = ~paper.ignore & (paper.category == CLASSES.index(BLIND_TO))

    @torch.no_grad()
    def labelled(self, theta: Tensor, names: Sequence[str] = FEATURES) -> Tensor:
        """Features (F, N) at a feasible theta (D,), of labels that moved along; OF_THE_PICTURE need a render."""
        objective = self.objective
        scene = objective.space.apply(objective.space.scene, theta)
        image = scene.photograph
        if set(names) & set(PIXEL_FEATURES):
            image = objective.compositor.render(scene).image.clamp(0, 1)
        labels = objective.labeller.moved(scene)
        return compute_features(image[None], labels.boxes_xyxy.to(image)[None], names)[:, 0]

    def sighting(self, theta: Tensor) -> FeatureObservation:
        """What the detector sees at a feasible theta (D,)."""
        scene = self.objective.space.apply(self.objective.space.scene, theta)
        return self._sighting(scene)

    def camera_samples(self, name: str, seed: int) -> Iterator[FeatureObservation]:
        """What it sees in `CAMERA_DRAWS` draws of the scene before any change."""
        scene = self.objective.space.scene
        for number in range(CAMERA_DRAWS):
            yield self._sighting(scene, f"planted:{name}:{seed}", number)

    def _sighting(self, scene: SceneIR, stream: str | None = None, number: int = 0) -> FeatureObservation:
        renderer = CompositorRenderer(self.objective.compositor, self.objective.labeller)
        if stream is None:
            drawn = renderer.render(scene)
            image, at = drawn.image, drawn.targets.boxes_xyxy
        else:
            draw = Nuisances().sample(stream, number, scene)
            drawn = renderer.render(draw.perturb_scene(scene))
            image, at = draw.degrade_image(drawn.image), draw.transform_boxes(drawn.targets.boxes_xyxy)
        count = len(self.judged)
        return FeatureObservation.of(
            self.objective, image, at[:count], drawn.targets.ignore[:count] | ~self.judged
        )


@dataclass(frozen=True)
class FrameSurvey:
    """Sightings of a frame: in draws of the camera before any change, at Halton's draws, and at corners."""

    frame: ObservedFrame
    camera_samples: tuple[FeatureObservation, ...]
    halton: tuple[FeatureObservation, ...]
    corners: tuple[FeatureObservation, ...]
    benign: Tensor
    """Features as photographed, by the detector's boxes, (F, N)."""
    farthest: Tensor
    """How far those of single looks are off, at most and in `MOSTLY` of them."""
    mostly: Tensor
    """How far those of single looks are off, at most and in `MOSTLY` of them, (F, N)."""
    sure: Tensor
    """Cars found in all looks, mostly as one. Without any there are neither Halton's draws nor corners, (N,) bool.
    Cars found in all looks, mostly as one. Without any there are neither Halton's draws nor corners, (N,) bool."""
    factor: Tensor
    """What makes features by the detector's boxes of those by labels, as photographed."""
    shift: Tensor
    """What makes features by the detector's boxes of those by labels, as photographed, (F, N)."""

    @classmethod
    def make(cls, objective: Objective, feasible: FeasibleSet, name: str, seed: int) -> FrameSurvey:
        """Of one frame; the same arguments give the same survey. name: the frame's. Raises RangeError where the
        detector has no gradient, DetectorError if it has no candidates.
        """
        frame = ObservedFrame(objective)
        camera_samples = tuple(frame.camera_samples(name, seed))
        photographed = frame.sighting(objective.space.theta0)
        labelled, benign = photographed.labelled, photographed.main
        seen = torch.isfinite(benign)
        by_factor = torch.tensor([feature in _BY_FACTOR for feature in FEATURES])[:, None]
        factor = torch.where(by_factor & seen, benign / labelled, 1.0)
        shift = torch.where(~by_factor & seen, benign - labelled, 0.0)
        benign = benign.where(seen, labelled)
        mains = torch.stack([sample.main for sample in camera_samples])  # (LOOKS, F, N)
        off = (mains - benign).abs().nan_to_num(0.0)
        single = torch.stack([sample.single for sample in camera_samples]).double().mean(0) >= MOSTLY
        sure = frame.judged & seen.all(0) & torch.isfinite(mains).all(0).all(0) & single
        some = bool(sure.any())  # without such a car no fault is planted
        return cls(
            frame=frame,
            camera_samples=camera_samples,
            halton=tuple(map(frame.sighting, halton(feasible, HALTON, seed))) if some else (),
            corners=tuple(map(frame.sighting, corners(feasible, CORNERS, seed))) if some else (),
            benign=benign,
            farthest=off.amax(0),
            mostly=off.quantile(MOSTLY, 0),
            sure=sure,
            factor=factor,
            shift=shift,
        )

    def inside(self, fault: PlantedFault, theta: Tensor) -> Tensor:
        """Whether each object (N,) is a car inside of the fault's bands at a feasible theta (D,), by labels and
        picture, and by how far the detector's boxes are off as photographed. Runs no detector.
        """
        rows = [FEATURES.index(name) for name in fault.feature_names]
        values = self.factor[rows] * self.frame.labelled(theta, fault.feature_names) + self.shift[rows]
        return self.frame.judged & fault.contains(values)

    def blind(self, fault: PlantedFault, theta: Tensor) -> Tensor:
        """Whether each object (N,) is a car that the fault hides at a feasible theta (D,). Runs the detector."""
        return self.frame.sighting(theta).lost(fault)

    def bands_by_label(self, fault: PlantedFault) -> tuple[Band, ...]:
        """Where a fault hides cars in features of their labels: from the 5th to the 95th percentile over Halton's
        draws and corners. A detector's boxes grow and shrink with what it sees, and a fault goes by them. Empty
        where it hides none.
        """
        rows = [FEATURES.index(name) for name in fault.feature_names]
        hidden = [state.labelled[rows][:, state.lost(fault)] for state in (*self.halton, *self.corners)]
        values = torch.cat(hidden, 1)
        if values.shape[1] < 2:
            return ()
        low, high = values.quantile(torch.tensor([0.05, 0.95]).to(values), 1).tolist()
        named = zip(fault.feature_names, low, high, strict=True)
        return tuple(Band(name, start, end) for name, start, end in named if start < end)

    def rarity(self, fault: PlantedFault) -> float:
        """Share of Halton's draws in which the fault hides a car."""
        return sum(bool(sighting.lost(fault).any()) for sighting in self.halton) / len(self.halton)


def halton(feasible: FeasibleSet, count: int, seed: int) -> Iterator[Tensor]:
    """Feasible thetas (D,) of a scrambled Halton sequence over all of the bounds."""
    space = feasible.space
    places = qmc.Halton(space.dim, scramble=True, rng=np.random.default_rng(seed)).random(count)
    for place in torch.from_numpy(places).to(space.theta0):
        yield feasible.project(space.lower + place * (space.upper - space.lower)).theta


def corners(feasible: FeasibleSet, count: int, seed: int) -> Iterator[Tensor]:
    """Feasible thetas (D,) near corners of the bounds; about half of the parameters are held, never all."""
    space = feasible.space
    rng = np.random.default_rng([seed, 1])
    for _ in range(count):
        theta = torch.where(torch.from_numpy(rng.random(space.dim) < 0.5), space.lower, space.upper)
        held = rng.random(len(space.blocks)) < 0.5
        for where, still in zip(space.blocks.values(), held, strict=True):
            if still and not held.all():
                theta[where] = 0
        yield feasible.project(theta).theta
