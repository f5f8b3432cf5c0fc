"""States of all frames, each shown once to the detector without a fault: what a fault does to it follows.

Pictures, and the detector's scores before a fault lowers them, depend on no fault. So Halton's draws
are made once, and serve for where faults are planted, for how often chance hits them, and as samples of each.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from detectors import boxes
from detectors.base import Detector, DetectorWrapper, lower_probability
from detectors.planted import BLIND_TO, FEATURES, Band, PlantedFault, compute_features, group_cars
from detectors.types import CLASSES
from drivesem.attacks.objective import Objective
from drivesem.evaluation.failures import MATCH_IOU
from drivesem.failures.neighbourhood import ObjectSample, SceneSampler
from drivesem.failures.nuisances import Nuisances

CAMERA_DRAWS = 4
"""Draws of the camera before any change."""
SCHEMA = 1


@dataclass(frozen=True, slots=True)
class CarObservation:
    """One car in one picture."""

    index: int
    """Of the object."""
    described: tuple[float, ...]
    """Its features as `FramePool.names` has them."""
    margin: float
    """In logits beyond t*, below 0 where the detector without a fault does not find it."""
    best_candidates: tuple[tuple[float, ...], ...]
    """Of each car that its predictions are about, as faults group them, the best score and that car's FEATURES."""

    @property
    def best(self) -> tuple[float, ...] | None:
        """FEATURES of the car that its best prediction is about; None where nothing meets it."""
        return max(self.best_candidates)[1:] if self.best_candidates else None

    def lost(self, fault: PlantedFault, t_star: float) -> bool:
        """Whether the detector with a fault does not find it."""
        return self.margin < 0 or self.hidden(fault, t_star)

    def hidden(self, fault: PlantedFault, t_star: float) -> bool:
        """Whether the fault hides it: it is found, and with the fault is not."""
        return hidden([self], fault, t_star)[0]


def hidden(cars: Sequence[CarObservation], fault: PlantedFault, t_star: float) -> list[bool]:
    """Which cars a fault hides, see `SeenCar.hidden`."""
    counts = [len(car.best_candidates) if car.margin > 0 else 0 for car in cars]
    rows = [row for car, count in zip(cars, counts, strict=True) if count for row in car.best_candidates]
    if not rows:
        return [False] * len(cars)
    candidates = torch.tensor(rows, dtype=torch.float64)
    by = fault.depth * fault.membership(
        candidates[:, [1 + FEATURES.index(name) for name in fault.feature_names]].T
    )
    still = (lower_probability(candidates[:, 0], by) >= t_star).split(counts)
    return [count > 0 and not bool(seen.any()) for count, seen in zip(counts, still, strict=True)]


@dataclass(frozen=True, slots=True)
class FramePool:
    """A frame."""

    frame: str
    t_star: float
    """Of the detector."""
    names: tuple[str, ...]
    camera_samples: tuple[tuple[CarObservation, ...], ...]
    """Its cars as photographed, in `CAMERA_DRAWS` draws of the camera."""
    states: tuple[tuple[CarObservation, ...], ...]
    """At Halton's draws over all of the bounds."""

    @classmethod
    def make(cls, objective: Objective, name: str, seed: int, states: int) -> FramePool:
        """Of so many states; the same arguments give the same pool. name: the frame's. Raises RangeError where the
        detector has no gradient, DetectorError if it has no candidates.
        """
        everywhere = SceneSampler(objective, objective.feasible_set(), Nuisances(), f"planted:{name}:{seed}")
        cars = objective.benign.paper.category == CLASSES.index(BLIND_TO)
        still = objective.space.theta0
        # Numbers of looks lie beyond those of states: no draw of the camera is seen twice.
        jittered = [everywhere.sample_at(still, states + number) for number in range(CAMERA_DRAWS)]
        drawn = [everywhere.sample(number) for number in range(states)]
        seen = []
        for samples in (*jittered, *drawn):
            of_cars = {index: sample for index, sample in samples.items() if bool(cars[index])}
            seen.append(_seen(objective, of_cars, everywhere.margins(of_cars)))
        names = next(
            (tuple(sample.features) for samples in (*jittered, *drawn) for sample in samples.values()), ()
        )
        return cls(name, objective.t_star, names, tuple(seen[:CAMERA_DRAWS]), tuple(seen[CAMERA_DRAWS:]))

    def hidden_as_photographed(self, fault: PlantedFault) -> set[int]:
        """Cars that the fault hides in any sample before a change."""
        cars = [car for sample in self.camera_samples for car in sample]
        return {car.index for car, lost in zip(cars, hidden(cars, fault, self.t_star), strict=True) if lost}

    @property
    def found(self) -> set[int]:
        """Cars found in all looks."""
        found = [{car.index for car in sample if car.margin > 0} for sample in self.camera_samples]
        return set.intersection(*found) if found else set()


def bands_by_label(pools: Sequence[FramePool], fault: PlantedFault) -> tuple[Band, ...]:
    """Where a fault hides cars in features of their labels: from the 5th to the 95th percentile over all states. A
    detector's boxes grow and shrink with what it sees, and a fault goes by them. Empty where it hides none.
    """
    rows: list[list[float]] = []
    for pool in pools:
        cars = [car for state in (*pool.camera_samples, *pool.states) for car in state]
        for car, gone in zip(cars, hidden(cars, fault, pool.t_star), strict=True):
            if gone:
                rows.append([car.described[pool.names.index(name)] for name in fault.feature_names])
    if len(rows) < 2:
        return ()
    ends = torch.tensor(rows, dtype=torch.float64).quantile(torch.tensor([0.05, 0.95], dtype=torch.float64), 0)
    named = zip(fault.feature_names, *ends.tolist(), strict=True)
    return tuple(Band(name, start, end) for name, start, end in named if start < end)


def sharpness(pools: Sequence[FramePool], fault: PlantedFault) -> float:
    """Share of the cars found at Halton's states, inside of a fault's bands by label, that it hides."""
    bands = bands_by_label(pools, fault)
    inside = lost = 0
    for pool in (pool for pool in pools if pool.names):  # of a frame without cars there are none
        rows = [pool.names.index(band.feature) for band in bands]
        ends = [(row, band.low, band.high) for row, band in zip(rows, bands, strict=True)]
        cars = [
            car
            for state in pool.states
            for car in state
            if car.margin > 0 and all(low <= car.described[row] <= high for row, low, high in ends)
        ]
        inside, lost = inside + len(cars), lost + sum(hidden(cars, fault, pool.t_star))
    return lost / inside if inside else 0.0


@torch.no_grad()
def _seen(
    objective: Objective, samples: dict[int, ObjectSample], margins: dict[int, float]
) -> tuple[CarObservation, ...]:
    if not samples:
        return ()
    exposure = next(iter(samples.values())).image
    image, detector = exposure.image, objective.differentiable
    label = detector.classes.index(BLIND_TO)
    candidates = detector.candidates(detector(image[None]))
    placed, scores = candidates.boxes_for_class(label), candidates.log_scores[:, label].exp()
    cars = group_cars(placed, scores)
    values = compute_features(image[None], cars.boxes_xyxy[None])[:, 0].T  # (K, F)
    found = []
    for index, sample in samples.items():
        truth = torch.stack([exposure.targets.boxes_xyxy[index], exposure.visible_xyxy[index]]).to(placed)
        meets = (boxes.iou_matrix(truth, placed[cars.rows]) >= MATCH_IOU).any(0)
        groups = []
        for car in cars.car[meets].unique().tolist():
            best = float(scores[cars.rows][meets & (cars.car == car)].max())
            groups.append(tuple(round(value, 6) for value in (best, *values[car].tolist())))
        described = tuple(round(value, 6) for value in sample.features.values())
        found.append(CarObservation(index, described, round(margins[index], 6), tuple(groups)))
    return tuple(found)


_MOST = 400
"""Cached predictions, half a megabyte each: pictures that the searches of one frame share."""


class CachingDetector(DetectorWrapper):
    """Runs `inner` once per picture without a gradient. images_seen: pictures it ran on."""

    def __init__(self, inner: Detector) -> None:
        super().__init__(inner)
        self.images_seen = 0
        self._known: OrderedDict[bytes, Any] = OrderedDict()

    def forward(self, images: Tensor) -> Any:
        """Inner's, of images (B, 3, H, W)."""
        if images.requires_grad or len(images) != 1:
            self.images_seen += len(images)
            return self.inner(images)
        key = hashlib.blake2b(images.detach().cpu().contiguous().numpy().tobytes(), digest_size=16).digest()
        if key not in self._known:
            self.images_seen += 1
            self._known[key] = self.inner(images)
            if len(self._known) > _MOST:
                self._known.popitem(last=False)
        self._known.move_to_end(key)
        return self._known[key]
