"""The attacks of the study: strategies, their settings in the paper, and runs of all arms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

from drivesem.classify.attack import Attacker
from drivesem.classify.pictures import ObjectView
from drivesem.classify.results import WRITTEN, ClassifiedPicture, load_picture_results
from drivesem.config.commands import ClassifyConfig
from drivesem.config.presets import find_presets
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.run.folder import ARMS, FRAMES, SHARING, claim_folder
from drivesem.run.labels import RESULT
from scene_ir import files
from tools.experiments.settings import StudyConfig

GRADIENT_STRATEGIES = ("si-fgsm", "sgd", "scw")
_SAMPLES: dict[str, dict[str, Any]] = {
    f"{method}-{name}": {"method": method, "params": "pose", "within_pose": within}
    for method in ("random", "halton")
    for name, within in (("large", 0.75), ("small", 0.3))
}
STRATEGIES = (*GRADIENT_STRATEGIES, *_SAMPLES)
"""All strategies, in the order of tables."""
STRATEGY_NAMES = {
    "benign": "benign",
    "benign-on": "benign, retrained",
    "si-fgsm": "si-FGSM",
    "sgd": "sGD",
    "scw": "sCW",
    **{f"{m}-{n}": f"{m.title()} ({n})" for m in ("random", "halton") for n in ("large", "small")},
}
"""Names in tables."""

BENIGN, BENIGN_RETRAINED = "benign", "benign-on"
"""The original network, and the one retrained on benign pictures alone."""
SINGLE_PARAMS = ("vertex", "pose", "lighting", "vertex,pose,lighting")
"""Parameter sets of the table of parameters, besides `pose,vertex`, which all other tables have."""

RETRAINED_TABLES = ("retraining", "robustness", "worth")
"""Tables of retrained networks."""


@dataclass(frozen=True, slots=True)
class ClassificationArm:
    """One attack on some pictures."""

    config: ClassifyConfig
    """Its settings, with its folder."""
    views: tuple[ObjectView, ...]
    """Its pictures."""

    @property
    def out(self) -> Path:
        """Its folder."""
        return Path(self.config.out or "")

    @property
    def pending(self) -> int:
        """Number of its pictures without a result."""
        return sum(not self.is_done(one) for one in self.views)

    def is_done(self, view: ObjectView) -> bool:
        """Whether a picture has a result."""
        return (self.out / FRAMES / view.identifier / RESULT).is_file()

    def frames(self, views: Sequence[ObjectView]) -> list[ClassifiedPicture]:
        """Results of some of its pictures."""
        return load_picture_results(self.out, views)


READINGS = ("text", "code")
"""Readings of the paper."""
CONTROL = "control"
"""The last layer trained on the pictures of the differences in training, without a difference."""
_TRAINING = ("layers", "optimiser", "batch", "rate", "epochs")
DIFFERENCES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "training": (_TRAINING, GRADIENT_STRATEGIES),
    "scw-step": (("scw_step",), ("scw",)),
    "vertex-groups": (("vertex_groups",), ("sgd",)),
    "turns": (("turns",), ("si-fgsm", "sgd")),
    "attack-misclassified": (("attack_misclassified",), GRADIENT_STRATEGIES),
    "normalisation": (("normalisation",), GRADIENT_STRATEGIES),
    "lamp": (("lamp",), GRADIENT_STRATEGIES),
    "sampled": (("sampled",), ("random-small", "halton-small")),
}
"""Differences between the paper's code and its text: the settings, and the strategies that they change."""
TRAINED = ("training", "normalisation", "lamp")
"""Differences for which a network is trained."""


def attributed_strategies(difference: str, quick: bool) -> tuple[str, ...]:
    """Strategies with which a difference, or CONTROL, is measured: all that it changes, or with --quick the first."""
    strategies = GRADIENT_STRATEGIES if difference == CONTROL else DIFFERENCES[difference][1]
    return strategies[:1] if quick else strategies


@cache
def code_settings(difference: str = "") -> Mapping[str, Any]:
    """Settings of the paper's code, or of one difference from its text."""
    settings = files.read_yaml(find_presets()["paper-code"])
    names = DIFFERENCES[difference][0] if difference else settings.keys() - {"for"}
    return {name: settings[name] for name in names}


def attack_settings(network: str, strategy: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of an attack: the paper's for one of its networks, and further ones, without those of training."""
    further = {name: value for name, value in settings.items() if name not in (*_TRAINING, "normalisation")}
    if strategy in _SAMPLES and "sampled" in further:
        further["params"] = "pose,vertex"
    return {**paper_preset(network, strategy), **further}


@cache
def paper_preset(network: str, strategy: str) -> Mapping[str, Any]:
    """The paper's settings of a strategy for one of its networks; those of samples do not depend on it."""
    if strategy in _SAMPLES:
        return _SAMPLES[strategy]
    settings = files.read_yaml(find_presets()[f"classify-{network}-{strategy}"])
    return {key: value for key, value in settings.items() if key != "for"}


def arm_config(study: StudyConfig, out: Path, name: str, network: str, **settings: Any) -> ClassifyConfig:
    """The settings of an arm.

    Args:
        study: Settings of the study.
        out: Its folder.
        name: Name of the arm's folder.
        network: Name of the shipped network, or a file.
        settings: Further settings of the attack.
    """
    shared = {one: getattr(study, one) for one in ("objects", "backgrounds", "seed", "device", *SHARING)}
    config = ClassifyConfig(what="attack", out=str(out / ARMS / name), network=network, grade=False, **shared)
    return replace(config, **settings)


class _ArmAttackers:
    """Attacks pictures in one process; arms share loaded networks and objects."""

    def __init__(self, arms: Sequence[ClassificationArm]) -> None:
        self._arms = arms
        self._attackers: dict[int, Attacker] = {}

    def __call__(self, job: tuple[int, ObjectView]) -> None:
        place, view = job
        arm = self._arms[place]
        if place not in self._attackers:
            # share with one on the same network, or else with any
            others = sorted(self._attackers.values(), key=lambda one: one.config.network != arm.config.network)
            self._attackers[place] = Attacker.from_config(arm.config, next(iter(others), None))
        self._attackers[place].attack(view, arm.out)


def run_classification_arms(arms: Sequence[ClassificationArm], study: StudyConfig, title: str) -> dict[str, str]:
    """Run or continue all arms.

    Args:
        arms: The arms.
        study: Settings of the study.
        title: Title of the progress bar.

    Returns:
        Reason by picture that could not be attacked.

    Raises:
        UsageError: Settings that do not fit a run that is there.
        SceneError: A picture that cannot be attacked, without --keep-going.
    """
    for arm in arms:
        claim_folder(arm.out, arm.config, WRITTEN)
    jobs = [(i, one) for i, arm in enumerate(arms) for one in arm.views if not arm.is_done(one)]
    build = partial(_ArmAttackers, tuple(arms))
    return run_frame_jobs(
        jobs, build(), build, study, ProgressSettings(title, show_remaining=True), lambda job: job[1].identifier
    ).failed
