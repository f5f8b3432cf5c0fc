"""Neighbourhoods of certain failures as training data and as auxiliary losses: newly rendered states each time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from detectors.base import Candidates, Detector, Predictor
from detectors.training import Sample
from detectors.types import CLASSES, Targets
from drivesem.attacks.feasible.constraints import FeasibilityLimits
from drivesem.attacks.space import Parameter
from drivesem.config.commands import AttackConfig
from drivesem.data import kitti
from drivesem.failures.margin_oracle import SHARPNESS
from drivesem.failures.margins import background_margin, object_margins
from drivesem.failures.neighbourhood import NEAR_REACH, Neighbourhood
from drivesem.failures.nuisances import Nuisances
from drivesem.run.finished import rebuild_objective
from drivesem.run.frame import certain_losses, targets_from_records
from drivesem.training.frames import TRAINING_LIMITS, AttackedFrame, render_state, training_targets
from scene_ir import files

POOL_SIZE = 4
"""States rendered together: loading a scene costs more than a few renders of it."""


class FailureNeighbourhoods(Sequence[Sample]):
    """A run's certain failures of objects, each as states of its neighbourhood.

    A pool holds `POOL_SIZE` states of each failure, rendered when one is first drawn, and is replaced once all of it
    may have been used. States are cached in `folder` and follow from the failure, the seed and their number alone.
    """

    def __init__(
        self,
        frames: Sequence[AttackedFrame],
        attack: AttackConfig,
        params: Sequence[Parameter],
        detector: Predictor,
        folder: Path,
        classes: Sequence[str],
        pool_rate: float,
        seed: int,
        near: float = 0.5,
    ) -> None:
        """List the failures.

        Args:
            frames: Frames of the run.
            attack: Its settings.
            params: Its parameters.
            detector: Its detector.
            folder: Where states are cached.
            classes: Names of the classes to train.
            pool_rate: Views of all failures per step.
            seed: Seed of the states.
            near: Share of the states that are near the failure, as a failure region may be small.
        """
        self.failures = list_failures(frames)
        self._attack, self._params, self._detector = attack, params, detector
        self._folder, self._classes, self._seed, self._near = folder, classes, seed, near
        self._turns = pool_rate / (POOL_SIZE * max(len(self.failures), 1))

    def __len__(self) -> int:
        return len(self.failures)

    def __getitem__(self, index: int) -> Sample:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.state(index, 0)[0]

    def draw(self, index: int, step: int, generator: np.random.Generator) -> Sample:
        """Draw a state from the pool of a step.

        Args:
            index: The failure.
            step: The step.
            generator: Source of random numbers.
        """
        return self.state(index, self.draw_number(step, generator))[0]

    def draw_number(self, step: int, generator: np.random.Generator) -> int:
        """Draw the number of a state in the pool of a step."""
        return self.pool(step)[int(generator.integers(POOL_SIZE))]

    def pool(self, step: int) -> range:
        """Numbers of the states in the pool of a step."""
        first = POOL_SIZE * int(step * self._turns)
        return range(first, first + POOL_SIZE)

    def is_near(self, number: int) -> bool:
        """Whether a state is near its failure; such states are evenly spaced."""
        return math.floor((number + 1) * self._near) > math.floor(number * self._near)

    def state(self, index: int, number: int) -> tuple[Sample, Targets]:
        """The state of a number around a failure as a training sample, and its evaluation targets, which start with
        all objects of the scene.
        """
        frame, target = self.failures[index]
        folder = self._folder / f"{frame.name.replace('/', '_')}-{target}" / f"{number // POOL_SIZE}"
        if not folder.is_dir():
            self._make(frame, target, number // POOL_SIZE, folder)
        labels = kitti.read_labels(folder / f"{number}.txt")
        image = files.read_image(folder / f"{number}.png")
        boxes_xyxy, names, ignore = files.read_json(folder / f"{number}.json")
        judged = Targets(torch.tensor(boxes_xyxy), torch.tensor(names), torch.tensor(ignore))
        return (image, training_targets(labels, TRAINING_LIMITS, self._classes)), judged

    def _make(self, frame: AttackedFrame, target: int, turn: int, folder: Path) -> None:
        objective, theta = rebuild_objective(
            frame.result, frame.folder, self._attack, self._params, self._detector
        )
        limits = FeasibilityLimits(joint_weather=frame.result.joint_weather)
        feasible = objective.feasible_set(limits, self._attack.project == "bounds")
        name = f"training:{frame.name}:{target}:{self._seed}"
        near = Neighbourhood(objective, feasible, theta, target, Nuisances.parse("off"), name)
        with files.atomic_folder(folder) as part:
            for number in range(POOL_SIZE * turn, POOL_SIZE * (turn + 1)):
                at = near.theta(number, NEAR_REACH if self.is_near(number) else 1.0)
                image, labels, judged = render_state(
                    at, objective.space, objective.compositor, objective.labeller, objective.benign.scene
                )
                files.write_png(part / f"{number}.png", image)
                kitti.write_labels(part / f"{number}.txt", labels)
                targets = [judged.boxes_xyxy.tolist(), judged.labels.tolist(), judged.ignore.tolist()]
                files.write_json(part / f"{number}.json", targets)


def list_failures(frames: Sequence[AttackedFrame]) -> list[tuple[AttackedFrame, int]]:
    """List certain failures of objects: the frame, and the index of the lost object."""
    return [(f, one.index) for f in frames for one in certain_losses(f.result) if one.index is not None]


class _NeighbourhoodLoss:
    """What auxiliary losses on failure neighbourhoods share: a weight, t*, and the size of the image window around the
    failing object.
    """

    def __init__(
        self,
        neighbourhoods: FailureNeighbourhoods,
        weight: float,
        t_star: float,
        seed: int,
        window_hw: tuple[int, int],
    ) -> None:
        self._neighbourhoods, self._weight, self._t_star, self._seed = neighbourhoods, weight, t_star, seed
        self._window_hw = window_hw

    def _drawn(self, step: int) -> tuple[int, np.random.Generator]:
        """The failure of a step, and the generator of further draws."""
        generator = np.random.default_rng([self._seed, 8, step])
        return int(generator.integers(len(self._neighbourhoods))), generator

    def _window(self, index: int, sample: Sample, state: Targets) -> tuple[int, int, int, int]:
        """First row and column of the window, and those after the last."""
        left, top, right, bottom = state.boxes_xyxy[self._neighbourhoods.failures[index][1]].tolist()
        middle, size = np.array([top + bottom, left + right]) / 2, np.array(sample[0].shape[:2])
        side = np.minimum(self._window_hw, size)
        y0, x0 = np.clip(np.round(middle - side / 2), 0, size - side).astype(int).tolist()
        return y0, x0, y0 + int(side[0]), x0 + int(side[1])


class ConsistencyLoss(_NeighbourhoodLoss):
    """Penalises margins that differ between the photograph and a state around a failure, and background margins that
    are smaller there; one pair of images per step.
    """

    name = "consistency"

    def images(self, step: int) -> Tensor:
        """Windows of the photograph and of the state: (2, 3, h, w) in [0, 1]."""
        index, (sample, state) = self._pair(step)
        window = self._window(index, sample, state)
        return torch.stack(
            [_part(self._neighbourhoods.failures[index][0].image("benign"), window), _part(sample[0], window)]
        )

    def term(self, detector: Detector, raw: Any, step: int) -> Tensor:
        """Compute the loss over objects that count in both images and lie in the window, and over the background, so
        that scores do not rise everywhere.

        Args:
            detector: The detector.
            raw: Its raw predictions for `images`.
            step: The step.
        """
        index, (sample, state) = self._pair(step)
        window = self._window(index, sample, state)
        frame = self._neighbourhoods.failures[index][0]
        known = [box for box in frame.result.targets_benign if box.index is not None]
        still = targets_from_records(tuple(known), CLASSES)
        labels = _labels(detector, still)
        both = torch.stack([_shifted(still.boxes_xyxy, window), _shifted(state.boxes_xyxy[: len(known)], window)])
        judged = ~still.ignore & ~state.ignore[: len(known)] & (labels >= 0) & _inside(both, window).all(0)
        rows = judged.nonzero()[:, 0]
        before, after = (detector.candidates(raw.select(i)) for i in (0, 1))
        objects = margin_difference(before, after, (both[0][rows], both[1][rows]), labels[rows], self._t_star)
        nothing = [
            background_margin(seen, _shifted(there.boxes_xyxy, window), self._t_star, SHARPNESS)
            for seen, there in (
                (before, targets_from_records(frame.result.targets_benign, CLASSES)),
                (after, state),
            )
        ]
        # one-sided: a background margin of the photograph is not a target
        nearer = (nothing[0].detach() - nothing[1]).clamp_min(0)
        return self._weight * (objects + F.smooth_l1_loss(nearer, torch.zeros_like(nearer)))

    def _pair(self, step: int) -> tuple[int, tuple[Sample, Targets]]:
        index, generator = self._drawn(step)
        return index, self._neighbourhoods.state(index, self._neighbourhoods.draw_number(step, generator))


class WorstCaseLoss(_NeighbourhoodLoss):
    """Logistic losses of the smallest margin of the failing object, and of the smallest background margin, over the
    states of the pool around a failure.
    """

    name = "worst"

    def images(self, step: int) -> Tensor:
        """Windows of all states of the pool: (POOL_SIZE, 3, h, w) in [0, 1]."""
        index, states = self._states(step)
        return torch.stack([_part(sample[0], self._window(index, sample, state)) for sample, state in states])

    def term(self, detector: Detector, raw: Any, step: int) -> Tensor:
        """Compute the loss over the failing object, in states where it counts and lies in the window, and over the
        background in every state.

        Args:
            detector: The detector.
            raw: Its raw predictions for `images`.
            step: The step.
        """
        index, states = self._states(step)
        target = self._neighbourhoods.failures[index][1]
        margins, nothing = [], []
        for number, (sample, state) in enumerate(states):
            window, seen = self._window(index, sample, state), detector.candidates(raw.select(number))
            nothing.append(
                background_margin(seen, _shifted(state.boxes_xyxy, window), self._t_star, SHARPNESS)[None]
            )
            box, label = _shifted(state.boxes_xyxy[[target]], window), _labels(detector, state)[[target]]
            if bool(state.ignore[target]) or int(label) < 0 or not bool(_inside(box, window)):
                continue
            margins.append(object_margins(seen, box, label, box, self._t_star, SHARPNESS))
        return self._weight * (smallest_margin_loss(nothing) + (smallest_margin_loss(margins) if margins else 0))

    def _states(self, step: int) -> tuple[int, list[tuple[Sample, Targets]]]:
        index, _ = self._drawn(step)
        return index, [self._neighbourhoods.state(index, number) for number in self._neighbourhoods.pool(step)]


def _part(image: NDArray[np.uint8], window: tuple[int, int, int, int]) -> Tensor:
    y0, x0, y1, x1 = window
    return torch.from_numpy(np.array(image[y0:y1, x0:x1])).permute(2, 0, 1).float() / 255


def _shifted(boxes_xyxy: Tensor, window: tuple[int, int, int, int]) -> Tensor:
    y0, x0, _, _ = window
    return boxes_xyxy - torch.tensor([x0, y0, x0, y0])


def _inside(boxes_xyxy: Tensor, window: tuple[int, int, int, int]) -> Tensor:
    y0, x0, y1, x1 = window
    return (boxes_xyxy[..., :2] >= 0).all(-1) & (boxes_xyxy[..., 2:] < torch.tensor([x1 - x0, y1 - y0])).all(-1)


def _labels(detector: Detector, targets: Targets) -> Tensor:
    """Indices of the detector's classes; -1 where it lacks one."""
    names = [detector.classes.index(n) if n in detector.classes else -1 for n in CLASSES]
    return torch.tensor(names)[targets.labels]


def smallest_margin_loss(margins: Sequence[Tensor]) -> Tensor:
    """Logistic loss () of the smallest of some margins, each (1,)."""
    return F.softplus(-torch.cat(list(margins)).min())


def margin_difference(
    before: Candidates, after: Candidates, boxes_xyxy: tuple[Tensor, Tensor], labels: Tensor, t_star: float
) -> Tensor:
    """Compute the smooth L1 loss between the margins of objects in two images.

    Args:
        before: Candidates in the first image, which is the target and gets no gradient.
        after: Candidates in the second image.
        boxes_xyxy: (M, 4) px in either image.
        labels: (M,) among the detector's classes.
        t_star: Score threshold.

    Returns:
        () mean over objects; 0 without any.
    """
    if not len(labels):
        return after.log_scores.new_zeros(())
    margins = [
        object_margins(seen, at, labels, at, t_star, SHARPNESS)
        for seen, at in zip((before, after), boxes_xyxy, strict=True)
    ]
    return F.smooth_l1_loss(margins[1], margins[0].detach())
