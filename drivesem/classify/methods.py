"""Search methods of attacks on classifiers, with the paper's steps and bounds as defaults."""

from __future__ import annotations

from dataclasses import replace

from drivesem.attack.methods.base import Attack
from drivesem.attack.methods.gradient_ascent import SGD, SiFGSM
from drivesem.attack.methods.gradient_free import Sampling
from drivesem.attack.methods.scw import SCW
from drivesem.classify.objective import AttackLoss
from drivesem.classify.space import WIDEST_BOUNDS, ClassifyParameter, ParameterAmounts, parse_parameters
from drivesem.config.commands import ClassifyConfig

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
