"""Margins of a scene's objects as a function of theta, over nuisance samples: what a search for robust failures
lowers. Certificates use samples of another stream, which no search sees.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from detectors.base import Candidates, Detector, predict, run_in_halves
from detectors.incremental.reference import ReferencePass
from detectors.types import Targets
from drivesem.attacks import losses
from drivesem.attacks.labels import visible_boxes
from drivesem.attacks.methods.base import GRADIENT_PASSES
from drivesem.attacks.objective import Objective
from drivesem.failures import margins as margin
from drivesem.failures.certificate import pad_visible_boxes
from drivesem.failures.feature_cells import Cell
from drivesem.failures.kinds import LabelledDetections, match_detections
from drivesem.failures.nuisances import Nuisances, NuisanceSample
from drivesem.failures.search_log import ObjectPatches, cells_of_features
from scene_ir.render.compositor import render_batch
from scene_ir.types import Render, SceneIR

SHARPNESS = 4.0
"""Sharpness of the soft maximum over candidates in gradients, 1 / logits."""


@dataclass(frozen=True)
class NuisanceMarginOracle:
    """The `attack.methods.base.MarginOracle` of an objective.

    It caches each sample with its noise (5.6 MB at 1242 x 375 px; a search cycles through twelve). Where neither
    weather nor foliage changes, it also caches the detector's layers for a sample's first image, and evaluates
    later images only where they differ from it.
    """

    objective: Objective
    """Scene, detector and labels."""
    nuisances: Nuisances
    """Ranges of the samples."""
    stream: str
    """Name of the sample stream."""
    counted_objects: Tensor
    """(N,) bool, objects that are detected in the benign image and are targets of the attack."""
    _samples: dict[int, NuisanceSample] = field(default_factory=dict[int, NuisanceSample])
    """Cached samples by number."""
    _references: dict[int, ReferencePass] = field(default_factory=dict[int, ReferencePass])
    """Cached detector layers by number."""

    @classmethod
    def for_objective(cls, objective: Objective, nuisances: Nuisances, stream: str) -> NuisanceMarginOracle:
        """Count the objects that are detected in the benign re-render and that the aim includes.

        Args:
            objective: Scene, detector and labels.
            nuisances: Ranges of the samples.
            stream: Name of the sample stream.
        """
        benign = objective.benign
        targets = objective.classes.map_targets(objective.aim.targets(benign.paper.targets))
        visible = pad_visible_boxes(visible_boxes(benign.render), targets)
        labelled = LabelledDetections(targets, visible, benign.detections)
        detected = match_detections(labelled, objective.t_star).detected
        counted = detected & ~targets.ignore.to(detected.device)
        return cls(objective, nuisances, stream, counted[: len(objective.space.scene.objects)])

    @property
    def differentiable(self) -> bool:
        """Whether margins have a gradient: the detector must expose its candidates."""
        detector = self.objective.detector
        return isinstance(detector, Detector) and type(detector).candidates is not Detector.candidates

    @property
    def passes(self) -> int:
        """Detector passes since the objective was created."""
        return self.objective.passes

    @torch.no_grad()
    def margins(self, thetas: Sequence[Tensor], numbers: Sequence[int], random: Collection[int] = ()) -> Tensor:
        """Margins (C, N) at C thetas (D,), each in the sample of its number; infinite for objects that do not count.
        `random` has the places of thetas that no score influenced. Costs C passes. On a GPU the states are rendered
        and detected together; on a CPU a picture then costs as much as alone.
        """
        self.objective.passes += len(thetas)
        states = [
            (theta, number, i in random) for i, (theta, number) in enumerate(zip(thetas, numbers, strict=True))
        ]
        if len(states) > 1 and self.objective.space.scene.photograph.is_cuda:
            return torch.stack(run_in_halves(self._margins_together, states, "samples"))
        return torch.stack(
            [self._compute_margins(theta, number, None, chance) for theta, number, chance in states]
        )

    def margins_and_grad(self, theta: Tensor, number: int, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Compute soft margins in one sample, and the gradient of their weighted sum. Costs three passes.

        Args:
            theta: (D,) state.
            number: Number of the sample.
            weights: (N,) weights of the margins.

        Returns:
            Margins (N,), infinite for objects that do not count, and the gradient (D,).

        Raises:
            RangeError: The detector has no gradient.
        """
        leaf = theta.detach().clone().requires_grad_(True)
        soft = self.soft_margins(leaf, number)
        self.objective.passes += GRADIENT_PASSES
        counts = torch.isfinite(soft)
        total = (weights.to(soft)[counts] * soft[counts]).sum()
        if not total.requires_grad:  # no object counts in this sample
            return soft.detach(), torch.zeros_like(theta)
        (gradient,) = torch.autograd.grad(total, leaf)
        return soft.detach(), gradient

    def soft_margins(self, theta: Tensor, number: int) -> Tensor:
        """Differentiable margins (N,) by a soft maximum over candidates. The image is not rounded to 8 bits where
        theta (D,) requires a gradient.
        """
        return self._compute_margins(theta, number, SHARPNESS)

    @torch.no_grad()
    def describe(self, theta: Tensor, number: int) -> tuple[Tensor, Tensor, list[Cell]]:
        """Render theta (D,) in one sample, without a detector pass.

        Returns:
            Rows (K,) of the objects that count, their features (K, F), `search_log.OBJECT_FEATURES`, and their cells.
        """
        scene, sample = self._perturb_scene(theta, number), self.sample(number)
        render = self.objective.compositor.render(scene)
        targets, rows = self._counted_targets(scene, render)
        boxes_xyxy = sample.transform_boxes(targets.boxes_xyxy[rows])
        features = ObjectPatches.from_image(sample.degrade_image(render.image), boxes_xyxy).features()
        return rows, features, cells_of_features(features)

    def clear_cache(self) -> None:
        """Drop cached samples and layers; they are recomputed when needed."""
        self._samples.clear()
        self._references.clear()

    @property
    def cache_mb(self) -> float:
        """Size of the cached layers."""
        return sum(reference.bytes for reference in self._references.values()) / 1e6

    def sample(self, number: int) -> NuisanceSample:
        """The sample of that number."""
        if number not in self._samples:
            self._samples[number] = self.nuisances.sample(self.stream, number, self.objective.space.scene)
        return self._samples[number]

    def _margins_together(self, states: Sequence[tuple[Tensor, int, bool]]) -> list[Tensor]:
        scenes = [self._perturb_scene(theta, number) for theta, number, _ in states]
        renders = render_batch([(self.objective.compositor, scene) for scene in scenes])
        samples = [self.sample(number) for _, number, _ in states]
        images = [sample.degrade_image(render.image) for sample, render in zip(samples, renders, strict=True)]
        if self.differentiable:
            detector = self.objective.differentiable
            raw = detector.forward_for_search(torch.stack(images))
            candidates = [detector.candidates(raw.select(i)) for i in range(len(images))]
        else:
            candidates = self._detect(torch.stack(images))
        return [
            self._margins_in_sample(candidates[i], images[i], samples[i], scenes[i], renders[i], None, random)
            for i, (_, _, random) in enumerate(states)
        ]

    def _compute_margins(
        self, theta: Tensor, number: int, sharpness: float | None, random: bool = False
    ) -> Tensor:
        scene, sample = self._perturb_scene(theta, number), self.sample(number)
        render = self.objective.compositor.render(scene)
        image = sample.degrade_image(render.image)
        candidates = self._find_candidates(image, number, render)
        return self._margins_in_sample(candidates, image, sample, scene, render, sharpness, random)

    def _perturb_scene(self, theta: Tensor, number: int) -> SceneIR:
        space = self.objective.space
        return self.sample(number).perturb_scene(space.apply(space.scene, theta))

    def _margins_in_sample(
        self,
        candidates: Candidates,
        image: Tensor,
        sample: NuisanceSample,
        scene: SceneIR,
        render: Render,
        sharpness: float | None,
        random: bool,
    ) -> Tensor:
        """Margins (N,) from the candidates in a sample's image, which enter the search log."""
        rows, boxes_xyxy, margins = self._object_margins(candidates, sample, scene, render, sharpness)
        passes = 1 if sharpness is None else GRADIENT_PASSES
        values = margins.detach()
        self.objective.search_log.record(image.detach(), rows, boxes_xyxy, values < 0, passes, values, random)
        everywhere = margins.new_full((len(self.counted_objects),), torch.inf)
        return everywhere.index_put((rows.to(margins.device),), margins)

    def _detect(self, images: Tensor) -> list[Candidates]:
        """Detections in images (C, 3, H, W), as candidates of a detector without any."""
        classes = self.objective.classes
        found = predict(self.objective.detector, images)
        return [
            losses.candidates_from_detections(classes.map_detections(one), len(classes.names)) for one in found
        ]

    def _find_candidates(self, image: Tensor, number: int, render: Render) -> Candidates:
        if not self.differentiable:
            return self._detect(image[None])[0]
        detector, reference = self.objective.differentiable, None
        if image.requires_grad:
            return detector.candidates(detector(image[None]))
        if render.vehicle_regions is not None and not self.objective.whole:
            reference = self._reference(detector, image, number)
        raw = detector.forward_for_search(image[None]) if reference is None else reference(image[None], [])
        return detector.candidates(raw)

    def _reference(self, detector: Detector, image: Tensor, number: int) -> ReferencePass | None:
        """Layers of a sample's first image; None where they are unknown or do not fit into the cache."""
        limit = self.objective.layer_limit_mb
        if (
            number not in self._references
            and self.objective.reference_mb + self.cache_mb + limit <= self.objective.keep_mb
        ):
            reference = ReferencePass.run(detector, image[None], limit)
            if reference is not None:
                self._references[number] = reference
        return self._references.get(number)

    def _object_margins(
        self,
        candidates: Candidates,
        sample: NuisanceSample,
        scene: SceneIR,
        render: Render,
        sharpness: float | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Rows (K,), boxes (K, 4) px and margins (K,) of the objects that count here and in the benign image."""
        with torch.no_grad():
            detached = replace(render, image=render.image.detach())
            targets, rows = self._counted_targets(scene, detached)
            boxes_xyxy, visible = sample.transform_boxes(targets.boxes_xyxy[rows]), visible_boxes(detached)[rows]
            is_visible = (visible[:, 2:] > visible[:, :2]).all(1, keepdim=True)
            visible = torch.where(is_visible, sample.transform_boxes(visible), visible)
        labels = targets.labels[rows]
        margins = margin.object_margins(candidates, boxes_xyxy, labels, visible, self.objective.t_star, sharpness)
        return rows, boxes_xyxy, margins

    def _counted_targets(self, scene: SceneIR, render: Render) -> tuple[Targets, Tensor]:
        """Labels of a state, and the rows (K,) of the objects that count in it and in the benign image."""
        classes, count = self.objective.classes, len(self.counted_objects)
        targets = classes.map_targets(self.objective.labeller.moved(scene, render).targets)
        if self.differentiable:
            targets = classes.to_detector_targets(targets)
        counts = self.counted_objects & ~targets.ignore[:count].to(self.counted_objects.device)
        return targets, counts.nonzero()[:, 0]
