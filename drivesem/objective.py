"""theta -> loss: the one place where scene, renderer, labels and detector meet."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from detectors.base import Detector, RawPredictions
from detectors.types import Detections
from drivesem.attacks.base import Problem, Score
from drivesem.evaluation import failures
from drivesem.feasible import FeasibleSet
from drivesem.labels import Difficulty, Labeller, LabelMode, MovedLabels
from drivesem.space import ParameterSpace
from scene_ir.compositor import Compositor, render_batch
from scene_ir.errors import RangeError, ShapeError
from scene_ir.types import Render, SceneIR

_REMEMBERED = 3
"""Evaluated thetas kept: what an attack scores at its end, so that its choice need not be rendered once more."""


@dataclass(frozen=True, slots=True)
class Rendered:
    """One theta, rendered, detected and labelled; carries no gradient. loss: the objective, by its own labels."""

    scene: SceneIR
    render: Render
    detections: Detections
    paper: MovedLabels
    moved: MovedLabels
    loss: float


class Objective:
    """A term of the detector's loss as a function of theta (D,), to be raised by an attack.

    label_mode: the labels the loss aims at, `moved` or, as in the paper, the benign ones, which reward drifting
    away from the label. They are constant in the gradient. term: a key of `Detector.loss`.
    """

    def __init__(
        self,
        compositor: Compositor,
        space: ParameterSpace,
        detector: Detector,
        label_mode: LabelMode = "moved",
        term: str = "objectness",
        difficulty: Difficulty | None = None,
    ) -> None:
        self.compositor = compositor
        self.space = space
        self.detector = detector
        self.label_mode: LabelMode = label_mode
        self.term = term
        with torch.no_grad():
            base_render = compositor.render(space.apply(space.scene, space.theta0))
        self._labeller = Labeller(space.scene, base_render, difficulty)
        self._benign = self._judged(space.scene, base_render)
        self._recent: deque[tuple[Tensor, Rendered]] = deque(maxlen=_REMEMBERED)

    @property
    def benign(self) -> Rendered:
        """The scene at theta = 0, re-rendered."""
        return self._benign

    def __call__(self, theta: Tensor) -> Tensor:
        """The loss () at theta (D,), differentiable. Raises RangeError where it is not finite."""
        return _losses([self], [theta])[0]

    def loss_and_grad(self, theta: Tensor) -> tuple[float, Tensor]:
        """Loss and its gradient (D,). Raises RangeError naming the coordinate where either is not finite."""
        losses, gradients = self.loss_and_grad_many(theta[None])
        return float(losses[0]), gradients[0]

    def loss_and_grad_many(self, thetas: Tensor) -> tuple[Tensor, Tensor]:
        """Losses (B,) and gradients (B, D) at thetas (B, D), such as restarts: one step for all. Raises as
        `loss_and_grad` does.
        """
        if thetas.ndim != 2 or len(thetas) == 0 or thetas.shape[1] != self.space.dim:
            raise ShapeError("thetas", f"(B, {self.space.dim})", tuple(thetas.shape))
        outcome = _losses_and_gradients([self] * len(thetas), thetas.unbind())
        return torch.stack([loss for loss, _ in outcome]), torch.stack([gradient for _, gradient in outcome])

    @torch.no_grad()
    def evaluate(self, theta: Tensor) -> Rendered:
        """Render, detect and label at theta (D,), without gradients."""
        if torch.equal(theta, self.space.theta0):
            return self._benign
        for known, rendered in self._recent:
            if torch.equal(theta, known):
                return rendered
        scene = self.space.apply(self.space.scene, theta)
        rendered = self._judged(scene, self.compositor.render(scene))
        self._recent.append((theta.clone(), rendered))
        return rendered

    def failures(self, rendered: Rendered, mode: LabelMode) -> failures.Failures:
        """What the detector gets wrong in `rendered` and got right in the benign re-render, by one label mode."""
        labels = rendered.moved if mode == "moved" else rendered.paper
        return failures.find(
            self._benign.paper.targets,
            self._benign.detections,
            labels.targets,
            rendered.detections,
            self.detector.t_star,
        )

    def score(self, theta: Tensor) -> Score:
        """What the detector makes of theta (D,): a fresh render, judged under both label modes."""
        rendered = self.evaluate(theta)
        moved = self.failures(rendered, "moved")
        return Score(
            loss=rendered.loss,
            lost=len(moved.lost),
            phantoms=len(moved.phantoms),
            success=moved.success,
            success_paper=self.failures(rendered, "paper").success,
        )

    def problem(self, feasible: FeasibleSet) -> Problem:
        """This objective as attacks see it."""
        return Problem(
            loss_and_grad=self.loss_and_grad,
            project=feasible.project,
            score=self.score,
            step=self.space.step,
        )

    def loss_of(self, raw: RawPredictions, scene: SceneIR, render: Render) -> Tensor:
        """The loss () of one image's predictions, by the labels of its scene and render."""
        labels = self._labeller.labels(self.label_mode, scene, render)
        return self._term(self.detector.loss(raw, [labels.targets]))

    @torch.no_grad()
    def _judged(self, scene: SceneIR, render: Render) -> Rendered:
        # What is judged is what is written: a file holds 8 bits, and so does a camera's picture.
        render = replace(render, image=(render.image.clamp(0, 1) * 255).round() / 255)
        raw = self.detector(render.image[None])
        paper, moved = self._labeller.paper(), self._labeller.moved(scene, render)
        aim = moved if self.label_mode == "moved" else paper
        loss = self._term(self.detector.loss(raw, [aim.targets]))
        return Rendered(scene, render, self.detector.decode(raw)[0], paper, moved, float(loss))

    def _term(self, terms: dict[str, Tensor]) -> Tensor:
        if self.term not in terms:
            raise RangeError("objective term", f"one of {', '.join(terms)}", repr(self.term))
        loss = terms[self.term]
        if not bool(torch.isfinite(loss)):
            raise RangeError(f"objective: {self.term}", "a finite loss", float(loss.detach()))
        return loss


class BatchObjective:
    """Objectives of several scenes before one detector, which sees all images of a size at once.

    Raises RangeError where there is no objective, or they have several detectors.
    """

    def __init__(self, objectives: Sequence[Objective]) -> None:
        detectors = {id(objective.detector) for objective in objectives}
        if len(detectors) != 1:
            raise RangeError("objectives", "one detector for all", f"{len(detectors)} detectors")
        self.objectives = tuple(objectives)

    def loss_and_grad(self, thetas: Sequence[Tensor]) -> list[tuple[float, Tensor]]:
        """Loss and gradient (D,) of each scene at its own theta (D,). Raises as `Objective.loss_and_grad` does."""
        if len(thetas) != len(self.objectives):
            raise ShapeError("thetas", f"{len(self.objectives)}, one for each scene", len(thetas))
        outcome = _losses_and_gradients(self.objectives, thetas)
        return [(float(loss), gradient) for loss, gradient in outcome]


def _losses_and_gradients(
    objectives: Sequence[Objective], thetas: Sequence[Tensor]
) -> list[tuple[Tensor, Tensor]]:
    leaves = [theta.detach().clone().requires_grad_(True) for theta in thetas]
    losses = _losses(objectives, leaves)
    gradients = torch.autograd.grad(losses, leaves)
    for objective, gradient in zip(objectives, gradients, strict=True):
        bad = (~torch.isfinite(gradient)).nonzero()
        if len(bad):
            i = int(bad[0])
            raise RangeError(f"gradient of {objective.space.name(i)}", "a finite value", float(gradient[i]))
    return [(loss.detach(), gradient) for loss, gradient in zip(losses, gradients, strict=True)]


def _losses(objectives: Sequence[Objective], thetas: Sequence[Tensor]) -> list[Tensor]:
    """The loss () of each objective at its theta (D,), differentiable; all of them have one detector."""
    scenes = [o.space.apply(o.space.scene, theta) for o, theta in zip(objectives, thetas, strict=True)]
    renders = render_batch([(o.compositor, scene) for o, scene in zip(objectives, scenes, strict=True)])
    of_size: dict[torch.Size, list[int]] = {}
    for i, render in enumerate(renders):
        of_size.setdefault(render.image.shape, []).append(i)
    losses: dict[int, Tensor] = {}
    for members in of_size.values():
        images = [renders[i].image for i in members]
        raw = objectives[members[0]].detector(images[0][None] if len(images) == 1 else torch.stack(images))
        for row, i in enumerate(members):
            # Each by itself: the loss of a batch is a mean over its images, and weighs them by their objects.
            losses[i] = objectives[i].loss_of(raw.one(row), scenes[i], renders[i])
    return [losses[i] for i in range(len(renders))]
