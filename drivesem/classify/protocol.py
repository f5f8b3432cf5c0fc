"""The paper's settings for classifiers: what a method does where nothing else is asked for."""

from __future__ import annotations

from dataclasses import replace

from drivesem.attack.methods.base import Attack
from drivesem.attack.methods.gradient_ascent import SGD, SiFGSM
from drivesem.attack.methods.gradient_free import Sampling
from drivesem.attack.methods.scw import SCW
from drivesem.classify.objective import Aimed
from drivesem.classify.space import FARTHEST, Amounts, Moved, moved_of
from drivesem.config.commands import ClassifyConfig

SAMPLED = ("random", "halton")
_LIGHT_STEP, _LARGER_LIGHT_STEP = 0.2, 0.4
"""The paper steps 4,000 units of its renderer's light for si-FGSM and 8,000 for the others, and does not say of
how many: half as much, and these shares."""
_STEPS = {
    "si-fgsm": Amounts(0.002, 0.15, _LIGHT_STEP),
    "sgd": Amounts(0.01, 0.20, _LARGER_LIGHT_STEP),
    "scw": Amounts(0.01, 0.30, _LARGER_LIGHT_STEP),
    **dict.fromkeys(SAMPLED, Amounts(0.01, 0.15, _LIGHT_STEP)),
}
"""For VGG-16; of sCW they are learning rates; samples have none, and need the unit alone."""
_WITHIN = {
    "sgd": Amounts(0.05, 1.0, FARTHEST.lighting),
    **dict.fromkeys(SAMPLED, Amounts(0.05, 0.75, 0.5)),
}
"""How far theta may go; the others are held by their few steps."""


def attack_of(config: ClassifyConfig) -> Attack:
    """The algorithm. Each ends at the first picture that is misclassified, but for samples, which are all seen."""
    match config.method:
        case "si-fgsm":
            return SiFGSM(config.steps, early_stop=True)
        case "sgd":
            return SGD(config.steps, early_stop=True, form="unit")
        case "scw":
            return SCW(config.steps, config.steps, config.norm, early_stop=True, constant=config.constant)
        case "random" | "halton":
            return Sampling(config.queries, kind=config.method)


def aimed_by(config: ClassifyConfig) -> Aimed:
    """What the method raises."""
    if config.method in SAMPLED:
        return "softmax"
    return "hinge" if config.method == "scw" else "logit"


def params_of(config: ClassifyConfig) -> tuple[Moved, ...]:
    """What moves. Raises FormatError."""
    return moved_of(config.params or ("pose" if config.method in SAMPLED else "pose,vertex"))


def steps_of(config: ClassifyConfig) -> Amounts:
    """The step of each parameter."""
    return _asked(config, "step", _STEPS[config.method])


def reach_of(config: ClassifyConfig) -> Amounts:
    """How far each parameter may go."""
    return _asked(config, "within", _WITHIN.get(config.method, FARTHEST))


def _asked(config: ClassifyConfig, which: str, usual: Amounts) -> Amounts:
    given = {str(one): getattr(config, f"{which}_{one}") for one in Moved}
    return replace(usual, **{name: value for name, value in given.items() if value is not None})
