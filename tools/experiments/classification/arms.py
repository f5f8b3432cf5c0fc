"""What the study attacks: strategies, their settings, and who is attacked on which pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

from drivesem.classify.attack import WRITTEN, Attacker, frames_of
from drivesem.classify.pictures import Shown
from drivesem.classify.results import ClassifiedFrame
from drivesem.config.commands import ClassifyConfig
from drivesem.config.presets import find_presets
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.run.folder import ARMS, FRAMES, SHARING, claim_folder
from drivesem.run.frame import RESULT
from scene_ir import files
from tools.experiments.settings import StudyConfig

GRADIENT = ("si-fgsm", "sgd", "scw")
_SAMPLES: dict[str, dict[str, Any]] = {
    f"{method}-{name}": {"method": method, "params": "pose", "within_pose": within}
    for method in ("random", "halton")
    for name, within in (("large", 0.75), ("small", 0.3))
}
STRATEGIES = (*GRADIENT, *_SAMPLES)
"""In the order of tables."""
NAMES = {
    "benign": "benign",
    "benign-on": "benign, trained on",
    "si-fgsm": "si-FGSM",
    "sgd": "sGD",
    "scw": "sCW",
    **{f"{m}-{n}": f"{m.title()} ({n})" for m in ("random", "halton") for n in ("large", "small")},
}
"""For people."""


@dataclass(frozen=True, slots=True)
class Arm:
    """One attack. config: its settings, with its folder; shown: its pictures."""

    config: ClassifyConfig
    shown: tuple[Shown, ...]

    @property
    def out(self) -> Path:
        return Path(self.config.out or "")

    def frames(self, kept: Sequence[Shown]) -> list[ClassifiedFrame]:
        """What came of some of its pictures."""
        return frames_of(self.out, kept)


@cache
def preset(network: str, strategy: str) -> Mapping[str, Any]:
    """The paper's settings of a strategy for one of its networks; samples have the same for both."""
    if strategy in _SAMPLES:
        return _SAMPLES[strategy]
    settings = files.read_yaml(find_presets()[f"classify-{network}-{strategy}"])
    return {key: value for key, value in settings.items() if key != "for"}


def attack_of(study: StudyConfig, out: Path, name: str, network: str, **settings: Any) -> ClassifyConfig:
    """The settings of an arm. network: the shipped one's name, or a file."""
    shared = {one: getattr(study, one) for one in ("objects", "backgrounds", "seed", "device", *SHARING)}
    config = ClassifyConfig(what="attack", out=str(out / ARMS / name), network=network, grade=False, **shared)
    return replace(config, **settings)


class _Attackers:
    """Attacks pictures in one process; of networks and objects, what arms share is loaded once."""

    def __init__(self, arms: Sequence[Arm]) -> None:
        self._arms = arms
        self._kept: dict[int, Attacker] = {}

    def __call__(self, job: tuple[int, Shown]) -> None:
        place, shown = job
        arm = self._arms[place]
        if place not in self._kept:
            # One that attacks the same network, or else any.
            others = sorted(self._kept.values(), key=lambda one: one.config.network != arm.config.network)
            self._kept[place] = Attacker.of(arm.config, next(iter(others), None))
        self._kept[place].attack(shown, arm.out)


def run_arms(arms: Sequence[Arm], study: StudyConfig, title: str) -> dict[str, str]:
    """Attack all pictures of all arms, as far as that is not done: those that could not be, and why.

    Raises UsageError or SceneError.
    """
    for arm in arms:
        claim_folder(arm.out, arm.config, WRITTEN)
    jobs = [
        (i, one)
        for i, arm in enumerate(arms)
        for one in arm.shown
        if not (arm.out / FRAMES / one.identifier / RESULT).is_file()
    ]
    build = partial(_Attackers, tuple(arms))
    return run_frame_jobs(
        jobs, build(), build, study, ProgressSettings(title, show_remaining=True), lambda job: job[1].identifier
    ).failed
