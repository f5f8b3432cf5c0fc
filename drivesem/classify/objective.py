"""The objective of an attack on a classifier, theta to loss and gradient, and the search methods with defaults."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from drivesem.attacks.methods.base import GRADIENT_PASSES, Attack, ParameterGroup, Problem, Score
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

logit: minus the true class's logit, as in the paper; hinge: minus the margin, where positive (Carlini and Wagner's f);
softmax: the highest probability of a wrong class, by which the paper chooses among samples.
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


def compute_attack_loss(logits: Tensor, label: int, loss: AttackLoss) -> Tensor:
    """Compute the loss () that an attack maximises; differentiable.

    Args:
        logits: Logits of one picture (C,).
        label: Index of the true class.
        loss: Name of the loss.
    """
    if loss == "logit":
        return -logits[label]
    if loss == "hinge":
        return -class_margin(logits, label).clamp_min(0)
    probabilities = logits.softmax(0)
    return torch.cat([probabilities[:label], probabilities[label + 1 :]]).amax()


class ClassifierObjective:
    """Loss, gradient and prediction of one picture as functions of theta (D,)."""

    def __init__(self, scene: ObjectScene, space: ObjectSpace, network: ImageClassifier, loss: AttackLoss) -> None:
        """
        Args:
            scene: The object and its view.
            space: Its parameters.
            network: The network.
            loss: Name of the loss.

        Raises:
            RangeError: Logits that are not finite.
        """
        self.scene = scene
        self.space = space
        self.network = network
        self.loss: AttackLoss = loss
        self.passes = 0
        """Passes of the network so far; a gradient counts as GRADIENT_PASSES."""
        self._evaluated: dict[bytes, ClassLogits] = {}
        self.benign = self.evaluate(space.theta0)
        """Prediction of the unchanged picture."""

    def loss_and_grad(self, theta: Tensor) -> tuple[float, Tensor]:
        """Compute the loss and its gradient (D,). Raises RangeError if one is not finite."""
        leaf = theta.detach().clone().requires_grad_(True)
        image = self.scene.render(self.space.change(leaf))
        loss = compute_attack_loss(self.network(image[None])[0], self.scene.model.label, self.loss)
        if not bool(loss.isfinite()):
            raise RangeError(f"objective: {self.loss}", "a finite loss", float(loss.detach()))
        (gradient,) = torch.autograd.grad(loss, leaf)
        self.space.check_gradient(gradient)
        self.passes += GRADIENT_PASSES
        return float(loss.detach()), gradient

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
        """Score theta (D,): a failure if the prediction was correct before and is not now."""
        prediction = self.evaluate(theta)
        failed = self.benign.correct and not prediction.correct
        loss = float(compute_attack_loss(prediction.logits, prediction.label, self.loss))
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
            groups=tuple(
                ParameterGroup(str(p), where, self.space.owner_count(p)) for p, where in self.space.blocks.items()
            ),
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


def create_attack(config: ClassifyConfig) -> Attack:
    """Create the algorithm. It stops at the first misclassified picture, except that samples are all evaluated."""
    match config.method:
        case "si-fgsm":
            return SiFGSM(config.steps, early_stop=True)
        case "sgd":
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


def attacked_parameters(config: ClassifyConfig) -> tuple[ClassifyParameter, ...]:
    """The attacked parameters. Raises FormatError."""
    return parse_parameters(config.params or ("pose" if config.method in SAMPLING else "pose,vertex"))


def step_sizes(config: ClassifyConfig) -> ParameterAmounts:
    """The step of each parameter."""
    return _override_defaults(_STEPS[config.method], config, "step")


def parameter_bounds(config: ClassifyConfig) -> ParameterAmounts:
    """The bound of each parameter."""
    return _override_defaults(_BOUNDS.get(config.method, WIDEST_BOUNDS), config, "within")


def _override_defaults(defaults: ParameterAmounts, config: ClassifyConfig, prefix: str) -> ParameterAmounts:
    values = {str(one): getattr(config, f"{prefix}_{one}") for one in ClassifyParameter}
    return replace(defaults, **{name: value for name, value in values.items() if value is not None})
