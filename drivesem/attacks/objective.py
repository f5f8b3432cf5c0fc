"""The loss of theta: an attack's objective on one scene, from renderer, labels and detector."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from detectors.base import (
    AnchorPredictions,
    Candidates,
    Detector,
    Predictor,
    explain_missing_gradient,
    predict,
    run_in_halves,
)
from detectors.incremental.reference import LIMIT_MB, ReferencePass
from detectors.incremental.regions import Rect
from detectors.types import Detections, Targets
from drivesem.attacks import losses
from drivesem.attacks.budgets import parse_budget, resolve_parameters
from drivesem.attacks.feasible.constraints import FeasibilityLimits
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.labels import Difficulty, Labeller, LabelMode, SceneLabels
from drivesem.attacks.methods.base import GRADIENT_PASSES, MarginOracle, ParameterGroup, Problem, Score
from drivesem.attacks.space import Parameter, ParameterSpace
from drivesem.attacks.targets import EvaluatedClasses, TargetSelection, resolve_t_star
from drivesem.attacks.visibility import VisibilityUnderWeather
from drivesem.config.commands import AttackConfig
from drivesem.evaluation import failures
from drivesem.failures.feature_cells import CellVisit
from drivesem.failures.fidelity import find_untrusted
from drivesem.failures.search_log import ObjectPatches, SearchLog
from scene_ir import ffd
from scene_ir.errors import RangeError
from scene_ir.io import round_to_8bit
from scene_ir.render.compositor import Compositor, render_batch
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import Render, SceneIR

GRADIENT_FREE_TERMS = ("objectness", *losses.GOALS)
"""Terms that need detections only."""
CustomLoss = Callable[[Candidates, Targets, float], Tensor]
"""A loss of a user's: from the detector's candidates, the targets, and t* to a differentiable loss () that an attack
raises. Labels of the targets are indices into the detector's classes, which are the columns of the candidates' scores.
"""
_RECENT = 3
"""Number of cached evaluations: an attack's last scores, so that its result need not be rendered again."""


@dataclass(frozen=True, slots=True)
class RenderEvaluation:
    """One state of the scene, rendered, detected and labelled, without gradients."""

    scene: SceneIR
    """The scene at theta."""
    render: Render
    """Its render, rounded to 8 bits."""
    detections: Detections
    """Detections; labels are indices into the evaluated classes."""
    paper: SceneLabels
    """The benign labels."""
    moved: SceneLabels
    """Labels that follow the vehicles."""
    loss: float
    """The objective."""


class Objective:
    """The loss that an attack raises, as a function of theta (D,).

    `passes` counts detector passes so far, a gradient as GRADIENT_PASSES; the benign picture's is the first.
    """

    def __init__(
        self,
        compositor: Compositor,
        space: ParameterSpace,
        detector: Predictor,
        config: AttackConfig | None = None,
        difficulty: Difficulty | None = None,
    ) -> None:
        """Render and evaluate the benign scene.

        Args:
            compositor: renders the scene.
            space: the parameter space of the scene.
            detector: the detector under attack; one without a gradient has GRADIENT_FREE_TERMS only.
            config: settings of the loss, the targets and the detector's passes; None: the defaults.
            difficulty: which objects are evaluated.

        Raises:
            DetectorError: the detector knows no cars, or does not provide the candidates that a goal needs.
            RangeError: the detector does not provide the term.
        """
        config = config or AttackConfig()
        self.compositor = compositor
        self.space = space
        self.detector = detector
        self.label_mode: LabelMode = config.objective_labels
        self.term: str | CustomLoss = config.objective
        """Name of the loss, or a function, which `drivesem.run.counterexample.attack` takes."""
        self.t_star = resolve_t_star(detector, config.t_star)
        self.classes = EvaluatedClasses.from_detector(detector)
        self.aim = TargetSelection.from_options(config.target_objects, config.target_classes)
        self.difficulty = difficulty or Difficulty()
        with torch.no_grad():
            base_render = compositor.render(space.apply(space.scene, space.theta0).origin)
        base = space.scene.origin
        self.labeller = Labeller(base, base_render, self.difficulty)
        """Labels states of the scene."""
        self.keep_mb = config.keep_mb
        self.whole = True  # the reference comes first
        """Whether the detector always evaluates whole pictures."""
        self._reference: ReferencePass | None = None
        self.benign = self.evaluate_render(base, base_render)
        """The scene at theta = 0, re-rendered; the one before, where vehicles were exchanged, added or removed."""
        self.judged, self.found_before = self._count_vehicles()
        """Rows of the vehicles that are targeted and not ignored, and of those that are detected at theta = 0."""
        self.whole = config.whole
        self.passes = 1
        self.search_log = SearchLog()
        """What was evaluated so far, the benign picture first."""
        rows = torch.tensor(self.judged, dtype=torch.int64)
        missed = ~torch.isin(rows, torch.tensor(self.found_before, dtype=torch.int64))
        self.search_log.record(
            self.benign.render.image, rows, self.benign.paper.boxes_xyxy[rows], missed, self.passes
        )
        self._scores_random_states = config.samples_states
        self._recent: deque[tuple[Tensor, RenderEvaluation]] = deque(maxlen=_RECENT)
        self._scores: dict[bytes, Score] = {}
        self.previews: dict[bytes, Score] = {}

    @classmethod
    def from_config(
        cls, scene: SceneIR, detector: Predictor, config: AttackConfig, difficulty: Difficulty | None = None
    ) -> Objective:
        """The objective of an attack's settings on one scene.

        Args:
            scene: on the detector's device.
            detector: the detector under attack.
            config: the settings.
            difficulty: which objects are evaluated.
        """
        budget, params = parse_budget(config.budget), resolve_parameters(config)
        space = ParameterSpace(scene, params, budget, parametrisation=config.parametrisation)
        return cls(Compositor(scene, RenderSettings(backend=config.backend)), space, detector, config, difficulty)

    def __call__(self, theta: Tensor) -> Tensor:
        """The loss () at theta (D,), differentiable. Raises RangeError where it is not finite."""
        return self._compute_loss(theta)[0]

    def loss_and_grad(self, theta: Tensor, feasible: FeasibleSet | None = None) -> tuple[float, Tensor]:
        """Loss and its gradient (D,) at theta (D,), for the coordinates that `feasible` leaves free. Raises
        RangeError naming the coordinate where either is not finite.
        """
        leaf = theta.detach().clone().requires_grad_(True)
        loss, value = self._compute_loss(leaf)
        (gradient,) = torch.autograd.grad(loss, leaf)
        self.passes += GRADIENT_PASSES
        self.space.check_gradient(gradient)
        return value, gradient if feasible is None else feasible.project_gradient(theta, gradient)

    def _compute_loss(self, theta: Tensor) -> tuple[Tensor, float]:
        """The loss () at theta (D,), differentiable, and its value. The score seen on the way is cached for
        `preview`.
        """
        scene = self.space.apply(self.space.scene, theta)
        render = self.compositor.render(scene)
        detector, raw = self.differentiable, self.predict(render)
        moved = self.labeller.moved(scene, render)
        labels = moved if self.label_mode == "moved" else self.labeller.paper()
        loss, value = self.compute_loss(detector, raw, labels.targets)
        with torch.no_grad():
            detections = self.classes.map_detections(_decode(detector, raw))
        self.previews[_key(theta)] = self.score_image(value, moved, detections, render.image, GRADIENT_PASSES)
        return loss, value

    @torch.no_grad()
    def evaluate(self, theta: Tensor) -> RenderEvaluation:
        """Render, detect and label at theta (D,), without gradients."""
        if self.space.scene.before is None and torch.equal(theta, self.space.theta0):
            return self.benign
        for recent_theta, evaluation in self._recent:
            if torch.equal(theta, recent_theta):
                return evaluation
        scene = self.space.apply(self.space.scene, theta)
        self.passes += 1
        evaluation = self.evaluate_render(scene, self.compositor.render(scene))
        self._recent.append((theta.clone(), evaluation))
        return evaluation

    def failures(self, evaluation: RenderEvaluation, mode: LabelMode) -> failures.FrameFailures:
        """Failures in `evaluation` that the benign re-render does not have, by the labels of one mode."""
        labels = evaluation.moved if mode == "moved" else evaluation.paper
        return self._failures(labels, evaluation.detections)

    def _count_vehicles(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """See `judged` and `found_before`."""
        targets, classes, count = self.benign.paper.targets, self.classes, len(self.benign.scene.objects)
        matches = failures.match_detections(classes.map_targets(targets), self.benign.detections, self.t_star)
        judged = ~classes.map_targets(self.aim.targets(targets)).ignore.cpu()
        rows = (judged[:count], (judged & matches.detected)[:count])
        judged_rows, found_rows = (tuple(row.nonzero()[:, 0].tolist()) for row in rows)
        return judged_rows, found_rows

    def _failures(self, labels: SceneLabels, detections: Detections) -> failures.FrameFailures:
        all_failures = failures.find_failures(
            self.classes.map_targets(self.benign.paper.targets),
            self.benign.detections,
            self.classes.map_targets(labels.targets),
            detections,
            self.t_star,
        )
        return self.aim.failures(all_failures, labels.targets, detections, self.classes.names)

    def score(self, theta: Tensor) -> Score:
        """The score of theta (D,), from a render of its own, under both label modes.

        Scores are cached, so that a gradient-free search pays for each theta once.
        """
        key = _key(theta)
        if key not in self._scores:
            self._scores[key] = self._score_evaluation(self.evaluate(theta))
        return self._scores[key]

    def _score_evaluation(self, evaluated: RenderEvaluation) -> Score:
        passes = 0 if evaluated is self.benign else 1
        return self.score_image(
            evaluated.loss, evaluated.moved, evaluated.detections, evaluated.render.image, passes
        )

    @torch.no_grad()
    def score_ahead(self, thetas: Sequence[Tensor]) -> None:
        """Score several thetas (D,) and cache the scores. On a GPU their scenes are rendered and detected together; on
        a CPU, where a picture of several costs as much as alone, they are left for `score`.
        """
        new = [theta for theta in thetas if _key(theta) not in self._scores]
        if len(new) < 2 or not self.space.scene.photograph.is_cuda or not isinstance(self.detector, Detector):
            return
        evaluations = run_in_halves(self._evaluate_together, new, "scenes")
        self.passes += len(new)
        for theta, evaluated in zip(new, evaluations, strict=True):
            self._scores[_key(theta)] = self._score_evaluation(evaluated)

    def _evaluate_together(self, thetas: Sequence[Tensor]) -> list[RenderEvaluation]:
        """Evaluate thetas (D,) in one batch. Their pictures are not cached: they would fill the memory."""
        scenes = [self.space.apply(self.space.scene, theta) for theta in thetas]
        renders = render_batch([(self.compositor, scene) for scene in scenes])
        renders = [replace(render, image=round_to_8bit(render.image)) for render in renders]
        raw = self.differentiable(torch.stack([render.image for render in renders]))
        return [
            self._evaluate_predictions(scene, render, raw.select(i))
            for i, (scene, render) in enumerate(zip(scenes, renders, strict=True))
        ]

    def preview(self, theta: Tensor) -> Score | None:
        """The score seen by the gradient pass at theta (D,), None without one: of an image that is not rounded to
        8 bits, in the precision of gradients.
        """
        return self.previews.get(_key(theta))

    def score_image(
        self, loss: float, moved: SceneLabels, detections: Detections, image: Tensor, passes: int
    ) -> Score:
        """The score of a state, which enters the search log.

        Args:
            loss: the objective.
            moved: the state's labels.
            detections: what the detector finds in it.
            image: (3, H, W), its picture.
            passes: detector passes that it took.
        """
        failed = self._failures(moved, detections)
        rows = torch.tensor(self.found_before, dtype=torch.int64)
        rows = rows[~moved.ignore[rows]]
        missed = torch.isin(rows, torch.tensor(failed.lost, dtype=torch.int64))
        boxes_xyxy, random = moved.boxes_xyxy[rows], self._scores_random_states and passes > 0
        self.search_log.record(image.detach(), rows, boxes_xyxy, missed, passes, random=random)
        # The projection treats vehicles as boxes, which may hide others from the start; a render is exact.
        hidden = moved.out_of_sight.nonzero()[:, 0].tolist()
        return Score(
            loss=loss,
            lost=len(failed.lost),
            phantoms=len(failed.phantoms),
            success=failed.success and not hidden,
            success_paper=self._failures(self.labeller.paper(), detections).success and not hidden,
            violations=tuple(f"objects[{i}]: visibility" for i in hidden),
        )

    def cell_visits(self, counterexample: RenderEvaluation) -> tuple[CellVisit, ...]:
        """Visits of the benign picture and of the search, which ended at a counterexample."""
        start = ObjectPatches.from_image(self.benign.render.image, self.benign.paper.boxes_xyxy)
        end = ObjectPatches.from_image(counterexample.render.image, counterexample.moved.boxes_xyxy)
        return self.search_log.visits(start.cells(), end.cells())

    def feasible_set(self, limits: FeasibilityLimits | None = None, only_bounds: bool = False) -> FeasibleSet:
        """The feasible set of the scene. Weather keeps objects visible as far as `difficulty` requires, and vehicles
        that no edit would leave with a trusted picture stay as photographed, except with `only_bounds`.
        """
        find_invisible, min_contrast = None, self.difficulty.min_contrast
        if min_contrast > 0 and Parameter.WEATHER in self.space.params:
            visible = ~self.labeller.paper().ignore.cpu().numpy()
            environment = self.space.scene.environment
            air = self.compositor.air
            find_invisible = VisibilityUnderWeather(self.benign.render, environment, air, visible, min_contrast)
        held = () if only_bounds else find_untrusted(self.compositor)
        return FeasibleSet(self.space, limits, only_bounds, find_invisible, held)

    def problem(
        self, feasible: FeasibleSet, keep_last: bool = False, margin_oracle: MarginOracle | None = None
    ) -> Problem:
        """The problem that attacks solve.

        Args:
            feasible: the feasible set.
            keep_last: see `Problem`.
            margin_oracle: see `Problem`.
        """
        return Problem(
            loss_and_grad=partial(self.loss_and_grad, feasible=feasible),
            project=feasible.project,
            score=self.score,
            step=self.space.step,
            lower=self.space.lower,
            upper=self.space.upper,
            groups=tuple(self._group(parameter, where) for parameter, where in self.space.blocks.items()),
            preview=self.preview,
            score_ahead=self.score_ahead,
            keep_last=keep_last,
            margin_oracle=margin_oracle,
        )

    def _group(self, parameter: Parameter, where: slice) -> ParameterGroup:
        owners = self.space.owner_count(parameter)
        modes = ffd.low_order_modes() if parameter is Parameter.MESH else None
        smooth = parameter not in (Parameter.TRANSLATE, Parameter.ROTATE, Parameter.SIZE)
        return ParameterGroup(parameter.value, where, owners, modes, smooth)

    def predict(self, render: Render) -> AnchorPredictions:
        """Raw predictions for a render of the scene, with a gradient wherever vehicles are drawn. Raises
        RangeError for a detector without one.
        """
        predictions = self.predict_regions(render)
        return self.differentiable(render.image[None]) if predictions is None else predictions

    def predict_regions(self, render: Render) -> AnchorPredictions | None:
        """Predictions from the regions that differ from the benign picture; None where pictures are evaluated whole."""
        if render.vehicle_regions is None or (reference := self._reference_layers()) is None:
            return None
        regions = [Rect(y0, y1, x0, x1) for x0, y0, x1, y1 in render.vehicle_regions.tolist()]
        return reference(render.image[None], regions)

    @property
    def layer_limit_mb(self) -> float:
        """Limit on the cached layers of one picture, in MB."""
        return min(LIMIT_MB, self.keep_mb)

    @property
    def reference_mb(self) -> float:
        """Size of the benign picture's cached layers, in MB."""
        return 0.0 if self._reference is None else self._reference.bytes / 1e6

    def release_layers(self) -> None:
        """Release the benign picture's layers, which are computed again when needed."""
        self._reference = None

    def _reference_layers(self) -> ReferencePass | None:
        """The benign picture's layers; None where pictures are evaluated whole."""
        if self._reference is None and not self.whole:
            self._reference = ReferencePass.run(
                self.differentiable, self.benign.render.image[None], self.layer_limit_mb
            )
            self.whole = self._reference is None
        return self._reference

    @property
    def differentiable(self) -> Detector:
        """The detector. Raises RangeError where it has no gradient."""
        if not isinstance(self.detector, Detector):
            found = f"{self.detector.name}{explain_missing_gradient(self.detector)}"
            raise RangeError("detector", "one with a gradient", found)
        return self.detector

    def detect_photograph(self) -> Detections:
        """Detections in the photograph: those of the benign picture, which is the photograph to the bit unless vehicles
        were exchanged, added or removed.
        """
        photograph = self.space.scene.photograph
        if torch.equal(self.benign.render.image, photograph):
            return self.benign.detections
        self.passes += 1
        return self.detect(photograph)

    @torch.no_grad()
    def detect(self, image: Tensor) -> Detections:
        """Detections of the evaluated classes in an image (3, H, W)."""
        return self.classes.map_detections(predict(self.detector, image[None])[0])

    def loss_from_predictions(self, raw: AnchorPredictions, scene: SceneIR, render: Render) -> Tensor:
        """The loss () of one image's predictions.

        Args:
            raw: predictions of one image.
            scene: the state that the image shows.
            render: its render.
        """
        labels = self.labeller.labels(self.label_mode, scene, render)
        return self.compute_loss(self.differentiable, raw, labels.targets)[0]

    @torch.no_grad()
    def evaluate_render(self, scene: SceneIR, render: Render) -> RenderEvaluation:
        """Detect and label a rendered state of the scene."""
        # Evaluate what is written: a file holds 8 bits, and so does a camera's picture.
        render = replace(render, image=round_to_8bit(render.image))
        raw = self.predict(render) if isinstance(self.detector, Detector) else None
        return self._evaluate_predictions(scene, render, raw)

    def _evaluate_predictions(
        self, scene: SceneIR, render: Render, raw: AnchorPredictions | None
    ) -> RenderEvaluation:
        """Label a state of the scene and decode its predictions; those of a detector without a gradient, for None."""
        paper, moved = self.labeller.paper(), self.labeller.moved(scene, render)
        labels = (moved if self.label_mode == "moved" else paper).targets
        if raw is not None:
            assert isinstance(self.detector, Detector)
            _, loss = self.compute_loss(self.detector, raw, labels)
            detections = self.classes.map_detections(_decode(self.detector, raw))
        else:
            detections = self.detect(render.image)
            loss = self._loss_without_gradient(detections, labels)
        return RenderEvaluation(scene, render, detections, paper, moved, loss)

    def compute_loss(self, detector: Detector, raw: AnchorPredictions, labels: Targets) -> tuple[Tensor, float]:
        """The loss () of one image's predictions, and its value. Raises RangeError where it is not finite."""
        targets = self.classes.to_detector_targets(self.classes.map_targets(self.aim.targets(labels)))
        if callable(self.term):
            loss = self.term(detector.candidates(raw), targets, self.t_star)
            if not isinstance(loss, Tensor) or loss.shape != ():
                raise RangeError(
                    "objective", "a function that returns a tensor ()", getattr(loss, "shape", type(loss))
                )
        elif self.term in losses.GOALS:
            columns = [detector.classes.index(name) for name in self.aim.classes_of(self.classes.names)]
            loss = losses.goal_loss(self.term, detector.candidates(raw), targets, self.t_star, columns)
        else:
            terms = detector.loss(raw, [targets])
            self._check_term((*terms, *losses.GOALS))
            loss = terms[self.term]
        if not math.isfinite(value := float(loss.detach())):
            raise RangeError(f"objective: {self.term}", "a finite loss", value)
        return loss, value

    def _loss_without_gradient(self, detections: Detections, labels: Targets) -> float:
        if callable(self.term):
            candidates = losses.candidates_from_detections(detections, len(self.classes.names))
            return float(self.term(candidates, self.classes.map_targets(self.aim.targets(labels)), self.t_star))
        self._check_term(GRADIENT_FREE_TERMS)
        names, targets = self.classes.names, self.classes.map_targets(self.aim.targets(labels))
        if self.term not in losses.GOALS:
            return losses.detection_objectness(targets, detections)
        columns = [names.index(name) for name in self.aim.classes_of(names)]
        candidates = losses.candidates_from_detections(detections, len(names))
        return float(losses.goal_loss(self.term, candidates, targets, self.t_star, columns))

    def _check_term(self, terms: Collection[str]) -> None:
        if self.term not in terms:
            raise RangeError("objective term", f"one of {', '.join(terms)}", repr(self.term))


def _decode(detector: Detector, raw: AnchorPredictions) -> Detections:
    """The detections of one image; decoding takes many small steps, each of which would wait for a GPU."""
    return detector.decode(raw.to_host() if type(raw) is AnchorPredictions else raw)[0]


def _key(theta: Tensor) -> bytes:
    return theta.detach().cpu().numpy().tobytes()
