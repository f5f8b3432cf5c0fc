"""The objective of an attack on a classifier, theta to loss and gradient, and the search methods with defaults."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from drivesem.attacks.methods.base import GRADIENT_PASSES, Attack, Problem, Score
from drivesem.attacks.methods.gradient_ascent import SGD, SiFGSM
from drivesem.attacks.methods.gradient_free import Sampling
from drivesem.attacks.methods.scw import SCW
from drivesem.classify.networks.architectures import ImageClassifier
from drivesem.classify.scenes import ObjectScene
from drivesem.classify.space import (
    WIDEST_BOUNDS,
    ClassifyParameter,
    ObjectSpace,
    ParameterAmounts,
    parse_parameters,
)
from drivesem.config.commands import ClassifyConfig
from scene_ir.errors import RangeError
from scene_ir.io import round_to_8bit

AttackLoss = Literal["logit", "hinge", "softmax"]
"""Loss that an attack maximises.

logit: minus the true class's logit, as in the paper; hinge: minus the margin, where positive (Carlini and Wagner's f),
or minus how far a target class lies below the highest other one; softmax: the highest probability of a wrong class, by
which the paper chooses among samples.
"""


@dataclass(frozen=True, slots=True)
class ClassLogits:
    """A network's logits for one picture."""

    logits: Tensor
    """Scores before softmax (C,)."""
    label: int
    """Index of the true class."""

    @property
    def predicted(self) -> int:
        """Index of the class with the highest logit; the first of equal ones."""
        return int(self.logits.argmax())

    @property
    def rank(self) -> int:
        """Rank of the true class, from 1; of equal logits the first class is the better one."""
        return int((self.logits.argsort(descending=True, stable=True) == self.label).nonzero()) + 1

    @property
    def correct(self) -> bool:
        """Whether the prediction is the true class."""
        return self.predicted == self.label

    @property
    def confidence(self) -> float:
        """Softmax of the predicted class, in [0, 1]."""
        return float(self.logits.softmax(0).amax())

    @property
    def margin(self) -> float:
        """Logit of the true class minus the highest other one; negative if misclassified."""
        return float(class_margin(self.logits, self.label))


def class_margin(logits: Tensor, label: int) -> Tensor:
    """Compute the logit of the true class minus the highest other one (), of logits (C,)."""
    others = torch.cat([logits[:label], logits[label + 1 :]])
    return logits[label] - others.amax()


def compute_attack_loss(logits: Tensor, label: int, loss: AttackLoss, target: int | None = None) -> Tensor:
    """Compute the loss () that an attack maximises; differentiable.

    Args:
        logits: Logits of one picture (C,).
        label: Index of the true class.
        loss: Name of the loss.
        target: Index of the class to predict, for hinge; None for any wrong one.
    """
    if loss == "logit":
        return -logits[label]
    if loss == "hinge":
        margin = class_margin(logits, label) if target is None else -class_margin(logits, target)
        return -margin.clamp_min(0)
    probabilities = logits.softmax(0)
    return torch.cat([probabilities[:label], probabilities[label + 1 :]]).amax()


class ClassifierObjective:
    """Loss, gradient and prediction of one picture as functions of theta (D,)."""

    def __init__(
        self,
        scene: ObjectScene,
        space: ObjectSpace,
        network: ImageClassifier,
        loss: AttackLoss,
        *,
        target: int | None = None,
        constant: float | None = None,
        final: bool = False,
    ) -> None:
        """
        Args:
            scene: The object and its view.
            space: Its parameters.
            network: The network.
            loss: Name of the loss.
            target: Index of the class to predict; None for any wrong one.
            constant: Weight of the loss, from which the squares of theta are then subtracted; None: the loss alone.
            final: Whether the last iterate counts, also of a picture that is misclassified unchanged.

        Raises:
            RangeError: Logits that are not finite.
        """
        self.scene = scene
        self.space = space
        self.network = network
        self.loss: AttackLoss = loss
        self.target, self.constant, self.final = target, constant, final
        self.passes = 0
        """Passes of the network so far; a gradient counts as GRADIENT_PASSES."""
        self._evaluated: dict[bytes, ClassLogits] = {}
        self.benign = self.evaluate(space.theta0)
        """Prediction of the unchanged picture."""

    def loss_and_grad(self, theta: Tensor) -> tuple[float, Tensor]:
        """Compute the loss and its gradient (D,). Raises RangeError if one is not finite."""
        move = torch.zeros_like(theta).requires_grad_(True)
        image = self.scene.render(self.space.change(theta.detach(), move))
        loss = self._compute_loss(self.network(image[None])[0], theta.detach() + move)
        if not bool(loss.isfinite()):
            raise RangeError(f"objective: {self.loss}", "a finite loss", float(loss.detach()))
        gradient = self.space.settle_gradient(torch.autograd.grad(loss, move)[0])
        self.passes += GRADIENT_PASSES
        return float(loss.detach()), gradient

    def _compute_loss(self, logits: Tensor, theta: Tensor) -> Tensor:
        """The loss () of logits (C,) at theta (D,)."""
        loss = compute_attack_loss(logits, self.scene.model.label, self.loss, self.target)
        return loss if self.constant is None else self.constant * loss - theta.square().sum()

    @torch.no_grad()
    def render(self, theta: Tensor) -> Tensor:
        """Render theta's picture (3, H, W), rounded to 8 bits as in its file."""
        return round_to_8bit(self.scene.render(self.space.change(theta)))

    @torch.no_grad()
    def classify(self, image: Tensor) -> ClassLogits:
        """Classify a picture (3, H, W)."""
        self.passes += 1
        return ClassLogits(self.network(image[None])[0], self.scene.model.label)

    def evaluate(self, theta: Tensor) -> ClassLogits:
        """Classify the picture of theta (D,); each theta is rendered once."""
        key = theta.detach().cpu().numpy().tobytes()
        if key not in self._evaluated:
            self._evaluated[key] = self.classify(self.render(theta))
        return self._evaluated[key]

    def score(self, theta: Tensor) -> Score:
        """Score theta (D,): a failure if the prediction was correct before and is not now, or is the target.

        With `final`, a picture may be wrong before.
        """
        prediction = self.evaluate(theta)
        failed = not prediction.correct if self.target is None else prediction.predicted == self.target
        failed = failed and (self.final or self.benign.correct)
        loss = float(self._compute_loss(prediction.logits, theta))
        return Score(loss, lost=int(failed), phantoms=0, success=failed, success_paper=failed)

    def problem(self) -> Problem:
        """This objective as a problem for attacks."""
        return Problem(
            loss_and_grad=self.loss_and_grad,
            project=self.space.project,
            score=self.score,
            step=self.space.step,
            lower=self.space.lower,
            upper=self.space.upper,
            groups=self.space.groups,
            advance=self.space.advance,
            keep_last=self.final,
        )


SAMPLING = ("random", "halton")
_LIGHT_STEP, _LARGER_LIGHT_STEP = 0.2, 0.4
"""The paper steps 4,000 units of its renderer's light for si-FGSM and 8,000 for the others, without giving the total;
these fractions have the same ratio."""
_STEPS = {
    "si-fgsm": ParameterAmounts(0.002, 0.15, _LIGHT_STEP),
    "sgd": ParameterAmounts(0.01, 0.20, _LARGER_LIGHT_STEP),
    "scw": ParameterAmounts(0.01, 0.30, _LARGER_LIGHT_STEP),
    **dict.fromkeys(SAMPLING, ParameterAmounts(0.01, 0.15, _LIGHT_STEP)),
}
"""For VGG-16. For sCW these are learning rates; for samples, units."""
_BOUNDS = {
    "sgd": ParameterAmounts(0.05, 1.0, WIDEST_BOUNDS.lighting),
    **dict.fromkeys(SAMPLING, ParameterAmounts(0.05, 0.75, 0.5)),
}
"""The other methods are bounded by their few steps."""
_SAMPLED_BOUNDS = ParameterAmounts(0.005, 0.3, 0.5)
"""Of samples over vertices and one turn, in the paper's code."""


def create_attack(config: ClassifyConfig) -> Attack:
    """Create the algorithm. It stops at the first misclassified picture, except that samples are all evaluated."""
    match config.method:
        case "si-fgsm":
            return SiFGSM(config.steps, early_stop=True)
        case "sgd":
            return SGD(config.steps, early_stop=True, form="unit")
        case "scw" if config.scw_step == "unit":
            return SGD(config.steps, early_stop=True, form="unit")
        case "scw":
            return SCW(config.steps, config.steps, config.norm, early_stop=True, constant=config.constant)
        case "random" | "halton":
            return Sampling(config.queries, kind=config.method)


def choose_loss(config: ClassifyConfig) -> AttackLoss:
    """Choose the loss of the method."""
    if config.method in SAMPLING:
        return "softmax"
    return "hinge" if config.method == "scw" else "logit"


def create_objective(
    scene: ObjectScene, space: ObjectSpace, network: ImageClassifier, config: ClassifyConfig
) -> ClassifierObjective:
    """Create the objective of an attack. Raises RangeError for logits that are not finite."""
    unit = config.method == "scw" and config.scw_step == "unit"
    return ClassifierObjective(
        scene,
        space,
        network,
        choose_loss(config),
        target=None if config.target is None else network.classes.index(config.target),
        constant=config.constant if unit else None,
        final=config.attack_misclassified and config.method not in SAMPLING,
    )


def create_space(scene: ObjectScene, config: ClassifyConfig) -> ObjectSpace:
    """Create the parameters of an object's attack. Raises FormatError."""
    return ObjectSpace(
        scene.vertices,
        attacked_parameters(config),
        step_sizes(config),
        parameter_bounds(config),
        config.shape,
        turns=config.turns,
        one_turn=_samples_vertices(config),
        lamp=config.lamp,
        parts=scene.model.vertex_parts() if config.vertex_groups == "part" else None,
    )


def _samples_vertices(config: ClassifyConfig) -> bool:
    return config.method in SAMPLING and config.sampled == "vertex,turn"


def attacked_parameters(config: ClassifyConfig) -> tuple[ClassifyParameter, ...]:
    """The attacked parameters. Raises FormatError."""
    pose_alone = config.method in SAMPLING and not _samples_vertices(config)
    return parse_parameters(config.params or ("pose" if pose_alone else "pose,vertex"))


def step_sizes(config: ClassifyConfig) -> ParameterAmounts:
    """The step of each parameter."""
    return _override_defaults(_STEPS[config.method], config, "step")


def parameter_bounds(config: ClassifyConfig) -> ParameterAmounts:
    """The bound of each parameter."""
    defaults = _SAMPLED_BOUNDS if _samples_vertices(config) else _BOUNDS.get(config.method, WIDEST_BOUNDS)
    return _override_defaults(defaults, config, "within")


def _override_defaults(defaults: ParameterAmounts, config: ClassifyConfig, prefix: str) -> ParameterAmounts:
    values = {str(one): getattr(config, f"{prefix}_{one}") for one in ClassifyParameter}
    return replace(defaults, **{name: value for name, value in values.items() if value is not None})
