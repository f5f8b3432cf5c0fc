"""What features a frame's cars have, and which ones theta can give them: where faults can be planted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.stats import qmc
from torch import Tensor

from detectors import boxes
from detectors.planted import BLIND_TO, FEATURES, OF_THE_PICTURE, PlantedFault, features, seen_cars
from detectors.types import CLASSES
from drivesem.attack.feasible.projection import FeasibleSet
from drivesem.attack.objective import Objective
from drivesem.evaluation.failures import IOU
from drivesem.truth.nuisances import Nuisances
from drivesem.truth.redraw.compositor import CompositorDraw

HALTON = 128
"""Draws of a scrambled Halton sequence over all of the bounds: they say how rare a fault is."""
CORNERS = 48
"""Corners of the bounds, each parameter at one of them or held: they say what can be reached beside."""
LOOKS = 8
"""Draws of the camera before any change: they say how far features differ from one picture to the next."""
MOSTLY = 0.75
"""Of looks: as many draws must fail after a change for a failure to be certain."""
_BY_FACTOR = ("height_px", "aspect")
"""Features by which a detector's box is off by a factor; by the others it is off by a difference."""


@dataclass(frozen=True, slots=True)
class Seen:
    """How a detector sees the cars of a frame before any change. judged (N,) bool: the cars; sure (N,) bool: of
    these, the ones found in all looks, mostly by one box; factor, shift (F, N): of FEATURES, what makes those of
    the detector's boxes of those of the labels' boxes; farthest, mostly (F, N): how far single looks are off what
    that gives, at most, and in `MOSTLY` of them.
    """

    judged: Tensor
    sure: Tensor
    factor: Tensor
    shift: Tensor
    farthest: Tensor
    mostly: Tensor

    @classmethod
    def of(cls, objective: Objective, name: str, seed: int) -> Seen:
        """By `LOOKS` draws of the scene before a change. Raises RangeError where the detector has no gradient,
        DetectorError where it does not tell its candidates.
        """
        paper, scene = objective.benign.paper, objective.space.scene
        renderer = CompositorDraw(objective.compositor, objective.labeller)
        base = FeaturesOf(objective).plain(objective.space.theta0)
        judged = ~paper.ignore & (paper.category == CLASSES.index(BLIND_TO))
        labelled, seen, single = [], [], []
        for number in range(LOOKS):
            draw = Nuisances().draw(f"planted:{name}:{seed}", number, scene)
            redrawn = renderer.redraw(draw.scene(scene))
            image = draw.picture(redrawn.image)
            labels = draw.boxes(redrawn.targets.boxes_xyxy[: len(judged)]).to(image)
            labelled.append(features(image[None], labels[None])[:, 0])
            values, alone = _as_seen(objective, image, labels)
            seen.append(values)
            single.append(alone)
        by_label, by_box = torch.stack(labelled), torch.stack(seen)  # (LOOKS, F, N)
        found = torch.isfinite(by_box).all(1)
        mostly_single = torch.stack(single).double().mean(0) >= MOSTLY
        by_factor = torch.tensor([feature in _BY_FACTOR for feature in FEATURES])[:, None]
        off = torch.where(by_factor, by_box / by_label, by_box - by_label).nanmedian(0).values
        factor = torch.where(by_factor, off, 1.0).nan_to_num(1.0)
        shift = torch.where(by_factor, 0.0, off).nan_to_num(0.0)
        apart = (by_box - (factor * base + shift)).abs().nan_to_num(0.0)
        sure = judged & found.all(0) & mostly_single
        return cls(judged, sure, factor, shift, apart.amax(0), apart.quantile(MOSTLY, 0))


class FeaturesOf:
    """The features of a scene's cars at theta, by their labels and the rendered picture: no detector is asked."""

    def __init__(self, objective: Objective) -> None:
        self.objective = objective

    @torch.no_grad()
    def plain(self, theta: Tensor, names: Sequence[str] = FEATURES) -> Tensor:
        """Features (F, N) at a feasible theta (D,), of labels that moved along; OF_THE_PICTURE need a render."""
        objective = self.objective
        scene = objective.space.apply(objective.space.scene, theta)
        image = scene.photograph
        if set(names) & set(OF_THE_PICTURE):
            image = objective.compositor.render(scene).image.clamp(0, 1)
        labels = objective.labeller.moved(scene)
        return features(image[None], labels.boxes_xyxy.to(image)[None], names)[:, 0]


@dataclass(frozen=True)
class Survey:
    """What theta can do to a frame's cars, in features as the detector sees them. benign (F, N); halton (K, F, N)
    and corners (C, F, N): at feasible thetas.
    """

    of: FeaturesOf
    seen: Seen
    benign: Tensor
    halton: Tensor
    corners: Tensor

    @classmethod
    def make(cls, objective: Objective, feasible: FeasibleSet, name: str, seed: int) -> Survey:
        """Of one frame; the same arguments give the same survey. name: the frame's."""
        of, seen = FeaturesOf(objective), Seen.of(objective, name, seed)

        def as_seen(thetas: Iterator[Tensor]) -> Tensor:
            return torch.stack([seen.factor * of.plain(theta) + seen.shift for theta in thetas])

        return cls(
            of,
            seen,
            as_seen(iter([objective.space.theta0]))[0],
            as_seen(halton(feasible, HALTON, seed)),
            as_seen(corners(feasible, CORNERS, seed)),
        )

    def inside(self, fault: PlantedFault, theta: Tensor) -> Tensor:
        """Whether each object (N,) is a car inside of the fault's region at a feasible theta (D,)."""
        rows = [FEATURES.index(name) for name in fault.names]
        values = self.seen.factor[rows] * self.of.plain(theta, fault.names) + self.seen.shift[rows]
        return self.seen.judged & fault.contains(values)

    def rarity(self, fault: PlantedFault) -> float:
        """Share of Halton's draws in which a car is inside of the fault's region."""
        values = self.halton[:, [FEATURES.index(name) for name in fault.names]]
        hit = fault.contains(values.transpose(0, 1)) & self.seen.judged
        return float(hit.any(1).double().mean())


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


@torch.no_grad()
def _as_seen(objective: Objective, image: Tensor, labels_xyxy: Tensor) -> tuple[Tensor, Tensor]:
    """Features (F, N) of cars with labels (N, 4) px in a picture (3, H, W), by the box of the detector's best
    prediction that meets each; nan where none does. And (N,) bool: whether all that meet it are about one car.
    """
    detector = objective.differentiable
    label = detector.classes.index(BLIND_TO)
    told = detector.candidates(detector(image[None]))
    placed, scores = told.boxes_of(label), told.log_scores[:, label].exp()
    cars = seen_cars(placed, scores)
    values = features(image[None], cars.boxes_xyxy[None])[:, 0]
    meets = boxes.iou_matrix(labels_xyxy.to(placed), placed[cars.rows]) >= IOU
    meets &= scores[cars.rows] >= objective.t_star
    seen = torch.full((len(FEATURES), len(labels_xyxy)), torch.nan)
    single = torch.zeros(len(labels_xyxy), dtype=torch.bool)
    for i, own in enumerate(meets):
        if bool(own.any()):
            best = scores[cars.rows].where(own, 0.0).argmax()
            seen[:, i] = values[:, cars.car[best]]
            single[i] = len(cars.car[own].unique()) == 1
    return seen, single
