"""theta -> loss: the one place where scene, renderer, labels and detector meet."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from detectors.base import Detector, Predictor, RawPredictions, predict
from detectors.incremental.reference import LIMIT_MB, Reference
from detectors.incremental.regions import Rect
from detectors.memory import in_halves
from detectors.types import Detections, Targets
from drivesem.attack import detection_loss, goals
from drivesem.attack.aims import EVERYTHING, Aim
from drivesem.attack.fading import Fading
from drivesem.attack.feasible.bounds import Limits
from drivesem.attack.feasible.projection import FeasibleSet
from drivesem.attack.judging import JudgedClasses, t_star_of
from drivesem.attack.labels import Difficulty, Labeller, LabelMode, MovedLabels
from drivesem.attack.methods.base import GRADIENT_PASSES, Group, Problem, Score, Views
from drivesem.attack.space import Parameter, ParameterSpace
from drivesem.config.blocks import KEEP_MB
from drivesem.evaluation import failures
from scene_ir import ffd
from scene_ir.errors import RangeError, ShapeError
from scene_ir.io import as_written
from scene_ir.render.compositor import Compositor, render_batch
from scene_ir.types import Render, SceneIR

OF_DETECTIONS = ("objectness", *goals.GOALS)
"""Terms that need no more than detections."""
_REMEMBERED = 3
"""Evaluated thetas kept: what an attack scores at its end, so that its choice need not be rendered once more."""


@dataclass(frozen=True, slots=True)
class Rendered:
    """One theta, rendered, detected and labelled; carries no gradient. detections: labels are indices into the
    judged classes. loss: the objective, by its own labels.
    """

    scene: SceneIR
    render: Render
    detections: Detections
    paper: MovedLabels
    moved: MovedLabels
    loss: float


class Objective:
    """What an attack raises, as a function of theta (D,).

    label_mode: the labels the loss aims at, `moved` or, as in the paper, the benign ones, which reward drifting
    away from the label. They are constant in the gradient. term: one of `goals.GOALS`, or a key of
    `Detector.loss`; a detector without a gradient has OF_DETECTIONS only. difficulty: what is judged. t_star:
    score from which a detection counts; by default the detector's own. aim: what counts as a failure, and is
    raised; by default everything. whole: the detector always sees whole pictures; else only what vehicles change
    of the benign one is computed again, where the detector's layers are known (`detectors.incremental`). keep_mb:
    of layers of pictures that are kept for that, those of `truth.views` included.
    Raises DetectorError where the detector knows no cars, or does not tell the candidates that a goal needs,
    RangeError where it has no such term.

    passes: of the detector so far, a gradient counted as GRADIENT_PASSES; the benign picture's is the first.
    """

    def __init__(
        self,
        compositor: Compositor,
        space: ParameterSpace,
        detector: Predictor,
        label_mode: LabelMode = "moved",
        term: str = "objectness",
        difficulty: Difficulty | None = None,
        t_star: float | None = None,
        aim: Aim = EVERYTHING,
        whole: bool = False,
        keep_mb: float = KEEP_MB,
    ) -> None:
        self.compositor = compositor
        self.space = space
        self.detector = detector
        self.label_mode: LabelMode = label_mode
        self.term = term
        self.t_star = t_star_of(detector, t_star)
        self.judged = JudgedClasses.of(detector)
        self.aim = aim
        self.difficulty = difficulty or Difficulty()
        with torch.no_grad():
            base_render = compositor.render(space.apply(space.scene, space.theta0).origin)
        base = space.scene.origin
        self._labeller = Labeller(base, base_render, self.difficulty)
        self.keep_mb = keep_mb
        self._whole = True  # the reference comes first
        self._reference: Reference | None = None
        self._benign = self.look(base, base_render)
        self._whole = whole
        self.passes = 1
        self._recent: deque[tuple[Tensor, Rendered]] = deque(maxlen=_REMEMBERED)
        self._scores: dict[bytes, Score] = {}
        self._previews: dict[bytes, Score] = {}

    @property
    def labeller(self) -> Labeller:
        """What labels the scene's states."""
        return self._labeller

    @property
    def benign(self) -> Rendered:
        """The scene at theta = 0, re-rendered; where vehicles were exchanged, added or taken away, the one
        before.
        """
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
        if self.space.scene.before is None and torch.equal(theta, self.space.theta0):
            return self._benign
        for known, rendered in self._recent:
            if torch.equal(theta, known):
                return rendered
        scene = self.space.apply(self.space.scene, theta)
        self.passes += 1
        rendered = self.look(scene, self.compositor.render(scene))
        self._recent.append((theta.clone(), rendered))
        return rendered

    def failures(self, rendered: Rendered, mode: LabelMode) -> failures.Failures:
        """What the detector gets wrong in `rendered` and got right in the benign re-render, by one label mode."""
        labels = rendered.moved if mode == "moved" else rendered.paper
        return self._failures(labels, rendered.detections)

    def _failures(self, labels: MovedLabels, detections: Detections) -> failures.Failures:
        found = failures.find(
            self.judged.targets(self._benign.paper.targets),
            self._benign.detections,
            self.judged.targets(labels.targets),
            detections,
            self.t_star,
        )
        return self.aim.failures(found, labels.targets, detections, self.judged.names)

    def score(self, theta: Tensor) -> Score:
        """What the detector makes of theta (D,): a render of its own, judged under both label modes.

        Scores are kept, which are small, so that a search without gradient pays for each theta once.
        """
        key = _key(theta)
        if key not in self._scores:
            rendered = self.evaluate(theta)
            self._scores[key] = self._score(rendered.loss, rendered.moved, rendered.detections)
        return self._scores[key]

    def preview(self, theta: Tensor) -> Score | None:
        """What the gradient pass at theta (D,) saw, if there was one: of an image that is not rounded to 8 bits,
        and in the precision of gradients.
        """
        return self._previews.get(_key(theta))

    def _score(self, loss: float, moved: MovedLabels, detections: Detections) -> Score:
        failed = self._failures(moved, detections)
        # The projection takes cars for boxes, behind which another may lie from the start; a render knows.
        hidden = moved.out_of_sight.nonzero()[:, 0].tolist()
        return Score(
            loss=loss,
            lost=len(failed.lost),
            phantoms=len(failed.phantoms),
            success=failed.success and not hidden,
            success_paper=self._failures(self._labeller.paper(), detections).success and not hidden,
            violations=tuple(f"objects[{i}]: visibility" for i in hidden),
        )

    def feasible_set(self, limits: Limits | None = None, only_bounds: bool = False) -> FeasibleSet:
        """What can be, and is seen through the weather as far as difficulty asks for it."""
        fades, least = None, self.difficulty.min_contrast
        if least > 0 and Parameter.WEATHER in self.space.params:
            seen = ~self._labeller.paper().ignore.cpu().numpy()
            environment = self.space.scene.environment
            fades = Fading(self._benign.render, environment, self.compositor.air, seen, least)
        return FeasibleSet(self.space, limits, only_bounds, fades)

    def problem(self, feasible: FeasibleSet, keep_last: bool = False, views: Views | None = None) -> Problem:
        """This objective as attacks see it. keep_last, views: as of `Problem`."""
        return Problem(
            loss_and_grad=lambda theta: self._along(feasible, theta),
            project=feasible.project,
            score=self.score,
            step=self.space.step,
            lower=self.space.lower,
            upper=self.space.upper,
            groups=tuple(self._group(parameter, where) for parameter, where in self.space.blocks.items()),
            preview=self.preview,
            keep_last=keep_last,
            views=views,
        )

    def _along(self, feasible: FeasibleSet, theta: Tensor) -> tuple[float, Tensor]:
        """Loss and gradient (D,), as far as the feasible set leaves theta free."""
        loss, gradient = self.loss_and_grad(theta)
        return loss, feasible.along(theta, gradient)

    def _group(self, parameter: Parameter, where: slice) -> Group:
        owners = self.space.owners(parameter)
        modes = ffd.low_modes() if parameter is Parameter.MESH else None
        smooth = parameter not in (Parameter.TRANSLATE, Parameter.ROTATE, Parameter.SIZE)
        return Group(parameter.value, where, owners, modes, smooth)

    def raw(self, render: Render) -> RawPredictions:
        """What the detector says of a render of the scene, with a gradient wherever vehicles are drawn. RangeError
        where it has none.
        """
        image = render.image[None]
        reference = None if render.drawn is None else self._kept()
        if reference is None or render.drawn is None:
            return self.differentiable(image)
        return reference(image, [Rect(y0, y1, x0, x1) for x0, y0, x1, y1 in render.drawn.tolist()])

    def sees_regions(self, render: Render) -> bool:
        """Whether the detector is to see only what changes."""
        return render.drawn is not None and self._kept() is not None

    @property
    def whole(self) -> bool:
        """Whether the detector always sees whole pictures."""
        return self._whole

    @property
    def picture_mb(self) -> float:
        """Of layers, the most that is kept of one picture."""
        return min(LIMIT_MB, self.keep_mb)

    @property
    def kept_mb(self) -> float:
        """Of the benign picture's layers."""
        return 0.0 if self._reference is None else self._reference.bytes / 1e6

    def forget(self) -> None:
        """Let go of the benign picture's layers, which are made anew when they are asked for."""
        self._reference = None

    def _kept(self) -> Reference | None:
        """The benign picture's layers, or nothing where pictures are seen whole."""
        if self._reference is None and not self._whole:
            self._reference = Reference.of(self.differentiable, self._benign.render.image[None], self.picture_mb)
            self._whole = self._reference is None
        return self._reference

    @property
    def differentiable(self) -> Detector:
        """The detector. Raises RangeError where it has no gradient."""
        if not isinstance(self.detector, Detector):
            raise RangeError("detector", "one with a gradient", self.detector.name)
        return self.detector

    @torch.no_grad()
    def detect(self, image: Tensor) -> Detections:
        """What the detector finds in an image (3, H, W), as far as it is judged."""
        return self.judged.detections(predict(self.detector, image[None])[0])

    def loss_of(self, raw: RawPredictions, scene: SceneIR, render: Render) -> Tensor:
        """The loss () of one image's predictions, by the labels of its scene and render."""
        labels = self._labeller.labels(self.label_mode, scene, render)
        return self._loss(self.differentiable, raw, labels.targets)

    def loss_at(self, theta: Tensor, raw: RawPredictions, scene: SceneIR, render: Render) -> Tensor:
        """The same at theta (D,); what is seen there is kept for `preview`."""
        moved = self._labeller.moved(scene, render)
        aimed = moved if self.label_mode == "moved" else self._labeller.paper()
        loss = self._loss(self.differentiable, raw, aimed.targets)
        with torch.no_grad():
            found = self.judged.detections(self.differentiable.decode(raw)[0])
        self._previews[_key(theta)] = self._score(float(loss.detach()), moved, found)
        return loss

    @torch.no_grad()
    def look(self, scene: SceneIR, render: Render) -> Rendered:
        """A state of the scene that is drawn already, detected and labelled."""
        # What is judged is what is written: a file holds 8 bits, and so does a camera's picture.
        render = replace(render, image=as_written(render.image))
        paper, moved = self._labeller.paper(), self._labeller.moved(scene, render)
        labels = (moved if self.label_mode == "moved" else paper).targets
        if isinstance(self.detector, Detector):
            raw = self.raw(render)
            loss = float(self._loss(self.detector, raw, labels))
            found = self.judged.detections(self.detector.decode(raw)[0])
        else:
            found = self.detect(render.image)
            loss = self._loss_of_detections(found, labels)
        return Rendered(scene, render, found, paper, moved, loss)

    def _loss(self, detector: Detector, raw: RawPredictions, labels: Targets) -> Tensor:
        targets = self.judged.own_targets(self.judged.targets(self.aim.targets(labels)))
        if self.term in goals.GOALS:
            known = [detector.classes.index(name) for name in self.aim.classes_of(self.judged.names)]
            loss = goals.goal(self.term, detector.candidates(raw), targets, self.t_star, known)
        else:
            terms = detector.loss(raw, [targets])
            self._check_term((*terms, *goals.GOALS))
            loss = terms[self.term]
        if not bool(torch.isfinite(loss)):
            raise RangeError(f"objective: {self.term}", "a finite loss", float(loss.detach()))
        return loss

    def _loss_of_detections(self, found: Detections, labels: Targets) -> float:
        """The same where there is no gradient, of judged detections."""
        self._check_term(OF_DETECTIONS)
        names, targets = self.judged.names, self.judged.targets(self.aim.targets(labels))
        if self.term not in goals.GOALS:
            return detection_loss.objectness(targets, found)
        known = [names.index(name) for name in self.aim.classes_of(names)]
        return float(goals.goal(self.term, goals.of_detections(found, len(names)), targets, self.t_star, known))

    def _check_term(self, terms: Collection[str]) -> None:
        if self.term not in terms:
            raise RangeError("objective term", f"one of {', '.join(terms)}", repr(self.term))


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


def _key(theta: Tensor) -> bytes:
    return theta.detach().cpu().numpy().tobytes()


def _losses_and_gradients(
    objectives: Sequence[Objective], thetas: Sequence[Tensor]
) -> list[tuple[Tensor, Tensor]]:
    """In halves, where the device's memory does not hold all renders and their layers."""
    return in_halves(_together, list(zip(objectives, thetas, strict=True)), "thetas")


def _together(pairs: Sequence[tuple[Objective, Tensor]]) -> list[tuple[Tensor, Tensor]]:
    objectives, thetas = zip(*pairs, strict=True)
    leaves = [theta.detach().clone().requires_grad_(True) for theta in thetas]
    losses = _losses(objectives, leaves)
    gradients = torch.autograd.grad(losses, leaves)
    for objective, gradient in zip(objectives, gradients, strict=True):
        objective.passes += GRADIENT_PASSES
        objective.space.check_gradient(gradient)
    return [(loss.detach(), gradient) for loss, gradient in zip(losses, gradients, strict=True)]


def _losses(objectives: Sequence[Objective], thetas: Sequence[Tensor]) -> list[Tensor]:
    """The loss () of each objective at its theta (D,), differentiable; all of them have one detector."""
    scenes = [o.space.apply(o.space.scene, theta) for o, theta in zip(objectives, thetas, strict=True)]
    renders = render_batch([(o.compositor, scene) for o, scene in zip(objectives, scenes, strict=True)])
    of_size: dict[torch.Size, list[int]] = {}
    losses: dict[int, Tensor] = {}
    for i, (objective, render) in enumerate(zip(objectives, renders, strict=True)):
        if objective.sees_regions(render):
            losses[i] = objective.loss_at(thetas[i], objective.raw(render), scenes[i], render)
        else:
            of_size.setdefault(render.image.shape, []).append(i)
    for members in of_size.values():
        images = [renders[i].image for i in members]
        raw = objectives[members[0]].differentiable(images[0][None] if len(images) == 1 else torch.stack(images))
        for row, i in enumerate(members):
            # Each by itself: the loss of a batch is a mean over its images, and weighs them by their objects.
            losses[i] = objectives[i].loss_at(thetas[i], raw.one(row), scenes[i], renders[i])
    return [losses[i] for i in range(len(renders))]
