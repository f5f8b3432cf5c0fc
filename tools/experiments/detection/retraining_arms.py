"""The arms of the study `retrain`: which detectors are trained, on which pictures and frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from rich.progress import track
from torch import Tensor

from detectors.registry import SHIPPED, save_detector
from detectors.training import Sample
from drivesem.analysis.transfer import split_list
from drivesem.config.commands import DEFAULT_COMBO, RetrainConfig
from drivesem.config.constraints import parse_size_hw
from drivesem.config.errors import UsageError
from drivesem.config.options import DEMO
from drivesem.data.registry import Dataset, open_dataset
from drivesem.data.subsets import open_selection
from drivesem.failures.second_renderer.selection import SecondRenderers
from drivesem.reporting.tables import Console
from drivesem.run.attack import AttackWorker
from drivesem.run.folder import ARMS, HELD_OUT, RETRAINED
from drivesem.run.run_report import PAPER_BENIGN, PAPER_COMBOS, follows_paper
from drivesem.run.workers import make_parallel_map
from drivesem.scenes.sources import SceneSource
from drivesem.training.failure_neighbourhoods import (
    ConsistencyLoss,
    FailureNeighbourhoods,
    WorstCaseLoss,
    list_failures,
)
from drivesem.training.frames import (
    AttackedFrame,
    AttackedSamples,
    FrameStore,
    GeneratorSamples,
    Stage,
    TrainingMixture,
)
from drivesem.training.retrain import WEIGHTS, fine_tune, load_start, mixture_shares, select_counterexamples
from scene_ir.types import SceneIR
from tools.experiments.detection.arms import PLACEBO, AttackArm, base_attack
from tools.experiments.settings import StudyConfig

BENIGN = "benign detector"
"""Name of the original detector."""
CACHE, FRAMES, POOL = "cache", "frames", "pool"
"""Folders: decoded frames, generated frames, pictures to train on."""
Pictures = Stage | Literal["random", "generator", "around"]
"""Pictures of an attacked frame; random edits of the same size, by the compositor or by the generator; states around
a certain failure."""
RETRAINING_ARMS: dict[str, tuple[str, Pictures]] = {
    "benign": ("retrained on benign frames alone", "benign"),
    "re-rendered": ("retrained on benign re-rendered images", "rerender"),
    "random": ("retrained on random edits", "random"),
    "generator": ("retrained on random edits, by the generator", "generator"),
    "ours": ("retrained, ours", "counterexample"),
    "certain": ("retrained on certain failures and around them", "around"),
    "consistent": ("the same, consistently", "around"),
    "worst": ("the same, and the worst of four", "around"),
    "paper": ("retrained, paper's protocol", "counterexample"),
}
"""Arms by short name: their title, and the pictures added to benign frames."""
_DEFAULT_ARMS = ("re-rendered", "ours", "paper")
_REPEATED_ARMS = ("benign", "random", "certain", "consistent", "worst")
"""Arms that are trained with several seeds."""
_LOSS_TERMS = {"consistent": ConsistencyLoss, "worst": WorstCaseLoss}
"""Additional terms of the loss by arm."""
_ATTACKED_FRAMES, _QUICK_ATTACKED_FRAMES = 400, 4
_HELD_OUT_SHARE = 0.25
"""As in `drivesem retrain`."""
_PAPER_BEFORE = (PAPER_COMBOS[DEFAULT_COMBO], PAPER_BENIGN)
_PAPER_AFTER = (0.7276, 0.8473)
"""The paper's mAP on counterexamples of the original detector and on benign frames, before and after retraining: a
quarter of 6,339 frames replaced, 6,000 steps. Its original detector had 24,000 steps on re-rendered benign frames."""
OURS = RetrainConfig(
    run="",
    mix="add",
    label_mode="moved",
    steps=1500,
    batch=4,
    window="1248x384",
    scale="0.8,1.25",
    rate=1e-4,
    precision="bfloat16",
)
"""Three benign frames for each counterexample, seen whole as at the end of the shipped detector's training, at a
fifth of its rate, so that it does not forget. configs/retrain-mixed.yaml is the same."""
_QUICK = {"steps": 40, "window": "640x224", "warmup": 10}


@dataclass(frozen=True, slots=True)
class RetrainingArm:
    """One retrained detector."""

    name: str
    """Title in tables."""
    folder: str
    """Folder of its weights."""
    pictures: Pictures
    """Pictures added to benign frames."""
    config: RetrainConfig
    """Settings of the training."""
    reference: tuple[float, float] | None
    """The paper's mAP on counterexamples and on benign frames."""
    arm: str
    """Short name, one of RETRAINING_ARMS; seeds of one arm are reported together."""
    weight: float = 0.0
    """Weight of the arm's additional loss term; 0 for none."""

    @property
    def run_name(self) -> str:
        """Folder of the attack on held-out frames against its detector."""
        return f"{HELD_OUT}-{self.folder}"

    @property
    def labels(self) -> str:
        """Labels of its pictures, benign or moved."""
        if self.pictures in ("generator", "around"):
            return "moved"
        moved = self.pictures in ("counterexample", "random") and self.config.label_mode == "moved"
        return "moved" if moved else "benign"


@dataclass(frozen=True, slots=True)
class FrameDivision:
    """Frames to train on and frames to test on."""

    training: tuple[str, ...] | None
    """Names that may be attacked to train on; None for all of the source."""
    test: tuple[str, ...] | None
    """Names that may be attacked to test on; None for all of the source."""
    benign_training: tuple[Dataset, tuple[str, ...]] | None
    """Benign frames to train on; None for the attacked frames' photographs."""
    benign_test: tuple[Dataset, tuple[str, ...]] | None
    """Benign frames to test on; None if they are yet to be generated."""


@dataclass(frozen=True, slots=True)
class FrameSubset:
    """Some frames of a scene source."""

    source: SceneSource
    """The source."""
    names: frozenset[str]
    """Names of its frames."""

    def identifiers(self) -> Iterator[str]:
        """Names in the source's order."""
        return (name for name in self.source.identifiers() if name in self.names)

    def has_vehicles(self, identifier: str) -> bool:
        """See `SceneSource`."""
        return self.source.has_vehicles(identifier)

    def photograph(self, identifier: str) -> Tensor:
        """See `SceneSource`."""
        return self.source.photograph(identifier)

    def scene(self, identifier: str) -> SceneIR:
        """See `SceneSource`."""
        return self.source.scene(identifier)


def _arm_names(study: StudyConfig) -> tuple[str, ...]:
    """Short names of the arms to train, in the order of RETRAINING_ARMS."""
    if study.arms is None:
        return tuple(name for name in _DEFAULT_ARMS if not (study.quick and name == "paper"))
    names = split_list(study.arms)
    if not names or not set(names) <= set(RETRAINING_ARMS):
        raise UsageError("--arms", f"some of {', '.join(RETRAINING_ARMS)}, with commas", repr(study.arms))
    return tuple(name for name in RETRAINING_ARMS if name in names)


def build_retraining_arms(study: StudyConfig) -> list[RetrainingArm]:
    """The arms of the study. All but the paper's protocol differ only in their pictures and an additional loss term.

    Raises UsageError for an unknown arm.
    """
    ours = replace(
        OURS,
        seed=study.seed,
        device=study.device,
        mix=study.mix,
        label_mode=study.label_mode,
        fraction=study.fraction,
        precision=study.precision,
        # other weights may come from the published loss, and go on with it
        loss="quality" if study.detector in SHIPPED else "published",
        **(_QUICK if study.quick else {}),
    )
    paper = RetrainConfig(run="", seed=study.seed, device=study.device)
    if study.train_steps is not None:
        ours, paper = (replace(one, steps=study.train_steps) for one in (ours, paper))
    references = {"re-rendered": _PAPER_BEFORE, "paper": _PAPER_AFTER}
    arms = []
    for arm in _arm_names(study):
        title, pictures = RETRAINING_ARMS[arm]
        config = paper if arm == "paper" else ours
        weight = study.consistency if arm in _LOSS_TERMS else 0.0
        for i in range(study.seeds or 1 if arm in _REPEATED_ARMS else 1):
            name, folder = (f"{title}, seed {study.seed + i}", f"{arm}-seed{i}") if i else (title, arm)
            own = replace(config, seed=study.seed + i)
            arms.append(RetrainingArm(name, folder, pictures, own, references.get(arm), arm, weight))
    return arms


def paper_reference(name: str, arms: Sequence[RetrainingArm], study: StudyConfig) -> tuple[float, float] | None:
    """The paper's mAP on counterexamples and on benign frames of a detector by name.

    Args:
        name: Title of an arm, or BENIGN.
        arms: The retraining arms.
        study: Settings of the study.

    Returns:
        None if the paper has none, or its attack was another.
    """
    if not follows_paper(training_attack(study).config):
        return None
    return next((arm.reference for arm in arms if arm.name == name), _PAPER_BEFORE)


def training_attack(study: StudyConfig) -> AttackArm:
    """The attack on the frames to train on."""
    limit = study.limit or (_QUICK_ATTACKED_FRAMES if study.quick else _ATTACKED_FRAMES)
    passes = study.passes if study.method == "climb" else None
    config = replace(base_attack(study), params=study.params, limit=limit, passes=passes)
    if study.params is not None:
        return AttackArm(study.params, "attacked", config)
    return AttackArm(f"combo {DEFAULT_COMBO}", f"combo-{DEFAULT_COMBO}", replace(config, combo=DEFAULT_COMBO))


def placebo_attack(arm: AttackArm, out: Path) -> AttackArm:
    """Random edits of the same frames, each as large as those of `arm`, in the study's folder `out`."""
    config = replace(arm.config, method="placebo", passes=None, like=str(out / ARMS / arm.folder))
    return AttackArm(
        f"{arm.name} {PLACEBO}", f"{arm.folder}-{PLACEBO}", config, control=PLACEBO, control_of=arm.name
    )


def test_attacks(study: StudyConfig, arms: Sequence[RetrainingArm], out: Path) -> list[AttackArm]:
    """The same attack on held-out frames: on the original detector, then on each retrained one.

    Args:
        study: Settings of the study.
        arms: The retraining arms.
        out: Folder of the study, with their weights.
    """
    base = replace(training_attack(study).config, limit=study.fresh or (3 if study.quick else 200))
    if study.dataset == DEMO:
        base = replace(base, seed=study.seed + 1)  # other streets
    else:
        base = replace(base, root=study.held_out or study.root)
    attacks = [AttackArm(BENIGN, HELD_OUT, base)]
    for arm in arms if study.reattack else ():
        config = replace(base, detector=str(weights_path(out, arm)))
        attacks.append(AttackArm(arm.name, arm.run_name, config))
    return attacks


def weights_path(out: Path, arm: RetrainingArm) -> Path:
    """File of an arm's weights, in the study's folder `out`."""
    return out / RETRAINED / arm.folder / WEIGHTS


def divide_frames(study: StudyConfig) -> FrameDivision:
    """Divide the frames. Raises UsageError if there are too few, SceneError for a bad folder."""
    if study.dataset == DEMO:
        return FrameDivision(None, None, None, None)
    trained_on = [
        Path(part).resolve() for part in (study.root or "", *(study.benign_root or "").split(",")) if part
    ]
    if study.held_out is not None and Path(study.held_out).resolve() in trained_on:
        raise UsageError("--held-out", "a folder that is not trained on", study.held_out)
    tested_on = [*trained_on, Path(study.held_out or study.root or "").resolve()]
    if study.validation is not None and Path(study.validation).resolve() in tested_on:
        raise UsageError("--validation", "a folder that is neither trained nor tested on", study.validation)
    if study.validation is not None and not open_dataset(study.dataset, Path(study.validation)).identifiers:
        raise UsageError("--validation", "at least one frame", "none")
    dataset = open_dataset(study.dataset, Path(study.root or ""))
    training = test = None
    if study.held_out is not None:
        held_out = open_dataset(study.dataset, Path(study.held_out))
        held_out_names = held_out.identifiers
    else:
        held_out = dataset
        training, test = _split_names(dataset.identifiers, study.seed)
        held_out_names = test
    if not held_out_names:
        raise UsageError("--held-out", "at least one frame", "none")
    benign = None
    if study.benign_root is not None:
        further = open_selection(study.dataset, study.benign_root)
        benign = further, further.identifiers
    elif not study.quick:
        benign = dataset, dataset.identifiers if training is None else training
    if benign is not None and not benign[1]:
        raise UsageError("--benign-root", "at least one frame", "none")
    return FrameDivision(training, test, benign, (held_out, held_out_names[: _benign_test_count(study)]))


def _benign_test_count(study: StudyConfig) -> int:
    return study.benign_frames or (12 if study.quick else 1000)


def _split_names(names: Sequence[str], seed: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names to train on and names that are held out, drawn at random; both in order."""
    if len(names) < 2:
        raise UsageError("--root", "at least 2 frames, to train on and to test on", len(names))
    order = np.random.default_rng([seed, 6]).permutation(len(names))
    held_out = set(order[: max(round(_HELD_OUT_SHARE * len(names)), 1)].tolist())
    training = tuple(name for i, name in enumerate(names) if i not in held_out)
    return training, tuple(name for i, name in enumerate(names) if i in held_out)


def limit_sources(workers: Sequence[AttackWorker], names: Sequence[str] | None) -> list[AttackWorker]:
    """The workers with their scene sources limited to `names`; None leaves them as they are."""
    if names is None:
        return list(workers)
    chosen = frozenset(names)
    return [replace(worker, source=FrameSubset(worker.source, chosen)) for worker in workers]


def benign_test_frames(
    study: StudyConfig, division: FrameDivision, classes: Sequence[str], out: Path, console: Console
) -> FrameStore:
    """The benign frames to test on, decoded. With the embedded scenes they are generated first, of shapes that no
    training frame has.

    Args:
        study: Settings of the study.
        division: Which frames are for what.
        classes: The detector's classes.
        out: Folder of the study.
        console: Where progress is shown.
    """
    if division.benign_test is not None:
        dataset, names = division.benign_test
        return FrameStore(dataset, names, out / CACHE / "held_out", classes)
    from drivesem.synth.write import Order, synthesise

    order = Order(out / FRAMES, _benign_test_count(study), study.seed + 1, split="heldout")
    for _ in track(
        synthesise(order, make_parallel_map(study)), "making frames", order.frames, console=console, transient=True
    ):
        pass
    made = open_dataset("kitti", order.out)
    return FrameStore(made, made.identifiers[: order.frames], out / CACHE / "held_out", classes)


def validation_frames(study: StudyConfig, classes: Sequence[str], out: Path) -> FrameStore | None:
    """The decoded frames of --validation, on which t* of retrained detectors is chosen; None without.

    Args:
        study: Settings of the study.
        classes: The detector's classes.
        out: Folder of the study.
    """
    if study.validation is None:
        return None
    chosen = open_dataset(study.dataset, Path(study.validation))
    return FrameStore(chosen, chosen.identifiers, out / CACHE / "validation", classes)


def benign_samples(
    division: FrameDivision, frames: Sequence[AttackedFrame], classes: Sequence[str], out: Path
) -> Sequence[Sample]:
    """Benign frames to train on: those of a data set, decoded, or the photographs of the attacked frames.

    Args:
        division: Which frames are for what.
        frames: The attacked frames.
        classes: The detector's classes.
        out: Folder of the study.
    """
    if division.benign_training is None:
        return AttackedSamples(frames, "benign", "paper", classes)
    dataset, names = division.benign_training
    return FrameStore(dataset, names, out / CACHE / "train", classes)


@dataclass(frozen=True, slots=True)
class TrainingPictures:
    """Where the pictures of the arms come from."""

    frames: Sequence[AttackedFrame]
    """Frames of the attack."""
    random: Sequence[AttackedFrame]
    """The same frames of its placebo, if there is one."""
    worker: AttackWorker
    """Worker of the attack."""
    second: SecondRenderers
    """Second renderers of the frames."""
    folder: Path
    """Folder of pictures that are rendered."""
    seed: int
    """Seed of the states around failures."""
    near: float
    """Share of the states around a failure that lie near it, in [0, 1]."""

    def _around_failures(self, config: RetrainConfig, classes: Sequence[str]) -> FailureNeighbourhoods:
        """Certain failures and states around them."""
        attack, params, detector = self.worker.config, self.worker.params, self.worker.detector
        pace, folder = config.batch * config.fraction, self.folder / "around"
        return FailureNeighbourhoods(
            self.frames, attack, params, detector, folder, classes, pace, self.seed, self.near
        )

    def missing(self, arm: RetrainingArm) -> str | None:
        """Why an arm cannot be trained, or None. Raises UsageError if no counterexample breaks the detector."""
        select_counterexamples(self.frames, arm.config.label_mode, "--limit")
        if arm.pictures == "around" and not list_failures(self.frames):
            return "no attacked frame has a certain failure of an object"
        if arm.pictures == "generator" and not self.second.generated:
            return "no generator made these frames"
        return None

    def samples(self, arm: RetrainingArm, classes: Sequence[str]) -> Sequence[Sample]:
        """Pictures that an arm adds to benign frames: of frames that break the detector, or around failures."""
        mode = arm.config.label_mode
        failed = select_counterexamples(self.frames, mode, "--limit")
        if arm.pictures == "around":
            return self._around_failures(arm.config, classes)
        if arm.pictures in ("random", "generator"):
            names = {frame.name for frame in failed}
            edited = [frame for frame in self.random if frame.name in names]
            if arm.pictures == "generator":
                return GeneratorSamples(edited, self.second, self.folder / "generator", classes)
            return AttackedSamples(edited, "counterexample", mode, classes)
        return AttackedSamples(failed, arm.pictures, mode, classes)


def train_arm(
    study: StudyConfig,
    arm: RetrainingArm,
    pictures: TrainingPictures,
    benign: Callable[[Sequence[str]], Sequence[Sample]],
    weights: Path,
    console: Console,
) -> None:
    """Train an arm's detector and write its weights, unless they are there.

    Args:
        study: Settings of the study.
        arm: The arm.
        pictures: Where its pictures come from.
        benign: Benign frames to train on, for a detector's classes.
        weights: File to write.
        console: Where progress is shown.

    Raises:
        UsageError: No counterexample breaks the detector.
    """
    if weights.is_file():
        return
    detector = load_start(study.detector, study.device, "--detector")
    samples = pictures.samples(arm, detector.classes)
    mixture = TrainingMixture(benign(detector.classes), samples, mixture_shares(arm.config))
    term = None
    if arm.weight and isinstance(samples, FailureNeighbourhoods):
        window_hw = parse_size_hw("--window", arm.config.window)
        term = _LOSS_TERMS[arm.arm](samples, arm.weight, detector.t_star, arm.config.seed, window_hw)
    console.print(f"{arm.name}: {arm.config.steps} steps", soft_wrap=True)
    fine_tune(arm.config, detector, mixture, weights.parent, console, term)
    facts = {"retrained_from": Path(study.detector).name, "steps": str(arm.config.steps)}
    save_detector(detector, weights, facts)
