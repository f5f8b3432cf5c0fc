"""What `drivesem study retrain` trains, and on which frames: the arms of that study."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from rich.progress import track

from detectors.registry import SHIPPED, save_detector
from detectors.training import Sample
from drivesem.config.blocks import DEMO
from drivesem.config.commands import DEFAULT_COMBO, RetrainConfig
from drivesem.config.errors import UsageError
from drivesem.config.values import size_hw
from drivesem.data.joined import open_folders
from drivesem.data.registry import Dataset, open_dataset
from drivesem.failures.second_renderer.choose import SecondRenderers
from drivesem.report.paper import PAPER_BENIGN, PAPER_COMBOS
from drivesem.report.terminal import Console
from drivesem.run.attack import Worker
from drivesem.run.folder import ARMS, HELD_OUT, RETRAINED
from drivesem.run.protocol import follows_paper
from drivesem.run.workers import mapping
from drivesem.scenes.sources import SceneSource
from drivesem.training.around import AroundFailures, Consistency, Worst, failures_in
from drivesem.training.attacked import AttackedFrame, AttackedSamples, RedrawnSamples, Stage
from drivesem.training.frames import FrameStore
from drivesem.training.mixture import Mixture
from drivesem.training.retraining import WEIGHTS, broken, shares_of, startable, train_on
from scene_ir.types import SceneIR
from tools.experiments.detection.arms import PLACEBO, AttackArm, base_attack
from tools.experiments.settings import StudyConfig

BENIGN = "benign detector"
CACHE, FRAMES, POOL = "cache", "frames", "pool"
"""Folders: decoded frames, frames that were made, pictures that are trained on."""
Pictures = Stage | Literal["random", "generator", "around"]
"""Of an attacked frame; random edits of the same size, by the compositor or the generator; states around a certain
failure."""
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
"""Arms by name: what they are called, and what is shown beside benign frames."""
_BY_DEFAULT = ("re-rendered", "ours", "paper")
REPEATED = ("benign", "random", "certain", "consistent", "worst")
"""Arms that are trained by several seeds."""
_TERMS = {"consistent": Consistency, "worst": Worst}
"""Further terms of the loss, by arm."""
_ATTACKED, _QUICK_ATTACKED = 400, 4
"""Frames whose counterexamples are trained on."""
_HELD_OUT_SHARE = 0.25
"""As in `drivesem retrain`."""
_PAPER_BEFORE = (PAPER_COMBOS[DEFAULT_COMBO], PAPER_BENIGN)
_PAPER_AFTER = (0.7276, 0.8473)
"""The paper's mAP on counterexamples against the detector as it was, and on benign frames, before retraining and
after: a quarter of 6,339 frames replaced, 6,000 steps. Its detector before is one that 24,000 steps on benign
frames, rendered again, have made."""
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
"""Three benign frames to a counterexample, seen whole as in the last part of the shipped detector's training, at a
fifth of its rate: what is learned is added to what is known. configs/retrain-mixed.yaml is the same."""
_QUICK = {"steps": 40, "window": "640x224", "warmup": 10}


@dataclass(frozen=True, slots=True)
class RetrainingArm:
    """One retraining. folder: short name; pictures: what is shown among benign frames; reference: the paper's mAP
    on counterexamples and on benign frames, of what the paper has, too; arm: of TAUGHT, whose seeds are told
    together; weight: of the arm's further term, 0 for none.
    """

    name: str
    folder: str
    pictures: Pictures
    config: RetrainConfig
    reference: tuple[float, float] | None
    arm: str
    weight: float = 0.0

    @property
    def run_name(self) -> str:
        """Folder of the attack on held-out frames, against its detector."""
        return f"{HELD_OUT}-{self.folder}"

    @property
    def labels(self) -> str:
        """Of its pictures: benign, or moved with the cars."""
        if self.pictures in ("generator", "around"):
            return "moved"
        moved = self.pictures in ("counterexample", "random") and self.config.label_mode == "moved"
        return "moved" if moved else "benign"


@dataclass(frozen=True, slots=True)
class FrameDivision:
    """Frames to train on and frames to judge by. learned, judged: names of those that may be attacked, None where
    all of a source may; benign: to train on, None for the attacked ones' photographs; held_out: to judge by, None
    where they are yet to be made.
    """

    training: tuple[str, ...] | None
    test: tuple[str, ...] | None
    benign_training: tuple[Dataset, tuple[str, ...]] | None
    benign_test: tuple[Dataset, tuple[str, ...]] | None


@dataclass(frozen=True, slots=True)
class FrameSubset:
    """The frames of a source that have these names."""

    source: SceneSource
    names: frozenset[str]

    def identifiers(self) -> Iterator[str]:
        """In the source's order."""
        return (name for name in self.source.identifiers() if name in self.names)

    def has_vehicles(self, identifier: str) -> bool:
        """As the source says."""
        return self.source.has_vehicles(identifier)

    def scene(self, identifier: str) -> SceneIR:
        """As the source takes it apart."""
        return self.source.scene(identifier)


def retraining_arm_names(study: StudyConfig) -> tuple[str, ...]:
    """The arms that are trained, in the order of TAUGHT. UsageError for a name that is none of them."""
    if study.arms is None:
        return tuple(name for name in _BY_DEFAULT if not (study.quick and name == "paper"))
    asked = [part.strip() for part in study.arms.split(",") if part.strip()]
    if not asked or not set(asked) <= set(RETRAINING_ARMS):
        raise UsageError("--arms", f"some of {', '.join(RETRAINING_ARMS)}, with commas", repr(study.arms))
    return tuple(name for name in RETRAINING_ARMS if name in asked)


def build_retraining_arms(study: StudyConfig) -> list[RetrainingArm]:
    """What is trained. All but the paper's protocol differ in their pictures alone, and in a further term."""
    ours = replace(
        OURS,
        seed=study.seed,
        device=study.device,
        mix=study.mix,
        label_mode=study.label_mode,
        fraction=study.fraction,
        precision=study.precision,
        # another's weights may have been trained by the published loss: it is what they know
        loss="quality" if study.detector in SHIPPED else "published",
        **(_QUICK if study.quick else {}),
    )
    paper = RetrainConfig(run="", seed=study.seed, device=study.device)
    if study.train_steps is not None:
        ours, paper = (replace(one, steps=study.train_steps) for one in (ours, paper))
    references = {"re-rendered": _PAPER_BEFORE, "paper": _PAPER_AFTER}
    lessons = []
    for arm in retraining_arm_names(study):
        title, pictures = RETRAINING_ARMS[arm]
        config = paper if arm == "paper" else ours
        weight = study.consistency if arm in _TERMS else 0.0
        for turn in range(study.seeds or 1 if arm in REPEATED else 1):
            name, folder = (f"{title}, seed {study.seed + turn}", f"{arm}-seed{turn}") if turn else (title, arm)
            own = replace(config, seed=study.seed + turn)
            lessons.append(RetrainingArm(name, folder, pictures, own, references.get(arm), arm, weight))
    return lessons


def paper_reference(name: str, lessons: Sequence[RetrainingArm], study: StudyConfig) -> tuple[float, float] | None:
    """The paper's mAP on counterexamples and on benign frames, of a detector by name; None where it has none, or
    where the study's attack is another than the paper's.
    """
    if not follows_paper(training_attack(study).config):
        return None
    return next((lesson.reference for lesson in lessons if lesson.name == name), _PAPER_BEFORE)


def training_attack(study: StudyConfig) -> AttackArm:
    """The attack on the frames to train on."""
    limit = study.limit or (_QUICK_ATTACKED if study.quick else _ATTACKED)
    passes = study.passes if study.method == "climb" else None
    config = replace(base_attack(study), params=study.params, limit=limit, passes=passes)
    if study.params is not None:
        return AttackArm(study.params, "attacked", config)
    return AttackArm(f"combo {DEFAULT_COMBO}", f"combo-{DEFAULT_COMBO}", replace(config, combo=DEFAULT_COMBO))


def placebo_attack(arm: AttackArm, out: Path) -> AttackArm:
    """Random edits of the same frames, each as large as the attack's."""
    config = replace(arm.config, method="placebo", passes=None, like=str(out / ARMS / arm.folder))
    return AttackArm(
        f"{arm.name} {PLACEBO}", f"{arm.folder}-{PLACEBO}", config, control=PLACEBO, control_of=arm.name
    )


def test_attacks(study: StudyConfig, lessons: Sequence[RetrainingArm], out: Path) -> list[AttackArm]:
    """The same attack on held-out frames: against the detector as it was, then against each retrained one."""
    base = replace(training_attack(study).config, limit=study.fresh or (3 if study.quick else 200))
    if study.dataset == DEMO:
        base = replace(base, seed=study.seed + 1)  # other streets
    else:
        base = replace(base, root=study.held_out or study.root)
    arms = [AttackArm(BENIGN, HELD_OUT, base)]
    for lesson in lessons if study.reattack else ():
        retrained = replace(base, detector=str(weights_path(out, lesson)))
        arms.append(AttackArm(lesson.name, lesson.run_name, retrained))
    return arms


def weights_path(out: Path, lesson: RetrainingArm) -> Path:
    """Where a lesson's weights lie."""
    return out / RETRAINED / lesson.folder / WEIGHTS


def divide_frames(study: StudyConfig) -> FrameDivision:
    """Which frames are for what. Raises UsageError where there are too few, SceneError for a bad folder."""
    if study.dataset == DEMO:
        return FrameDivision(None, None, None, None)
    trained_on = [
        Path(part).resolve() for part in (study.root or "", *(study.benign_root or "").split(",")) if part
    ]
    if study.held_out is not None and Path(study.held_out).resolve() in trained_on:
        raise UsageError("--held-out", "a folder of which nothing is trained on", study.held_out)
    held_out_too = [*trained_on, Path(study.held_out or study.root or "").resolve()]
    if study.validation is not None and Path(study.validation).resolve() in held_out_too:
        raise UsageError("--validation", "a folder that is neither trained on nor judged by", study.validation)
    if study.validation is not None and not open_dataset(study.dataset, Path(study.validation)).identifiers:
        raise UsageError("--validation", "at least one frame", "none")
    dataset = open_dataset(study.dataset, Path(study.root or ""))
    learned = judged = None
    if study.held_out is not None:
        held_out = open_dataset(study.dataset, Path(study.held_out))
        kept = held_out.identifiers
    else:
        held_out = dataset
        learned, judged = _divided(dataset.identifiers, study.seed)
        kept = judged
    if not kept:
        raise UsageError("--held-out", "at least one frame", "none")
    benign = None
    if study.benign_root is not None:
        further = open_folders(study.dataset, study.benign_root)
        benign = further, further.identifiers
    elif not study.quick:
        benign = dataset, dataset.identifiers if learned is None else learned
    if benign is not None and not benign[1]:
        raise UsageError("--benign-root", "at least one frame", "none")
    return FrameDivision(learned, judged, benign, (held_out, kept[: benign_count(study)]))


def benign_count(study: StudyConfig) -> int:
    """How many held-out frames judge what is benign."""
    return study.benign_frames or (12 if study.quick else 1000)


def _divided(names: Sequence[str], seed: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names to train on, and those that are held out, drawn at random; both in order."""
    if len(names) < 2:
        raise UsageError("--root", "at least 2 frames, some to train on and some to judge by", len(names))
    order = np.random.default_rng([seed, 6]).permutation(len(names))
    kept = set(order[: max(round(_HELD_OUT_SHARE * len(names)), 1)].tolist())
    learned = tuple(name for i, name in enumerate(names) if i not in kept)
    return learned, tuple(name for i, name in enumerate(names) if i in kept)


def limit_sources(workers: Sequence[Worker], names: Sequence[str] | None) -> list[Worker]:
    """The workers, their sources limited to these frames; as they are where there is nothing to limit."""
    if names is None:
        return list(workers)
    chosen = frozenset(names)
    return [replace(worker, source=FrameSubset(worker.source, chosen)) for worker in workers]


def held_out_frames(
    study: StudyConfig, parts: FrameDivision, classes: Sequence[str], out: Path, console: Console
) -> FrameStore:
    """What benign figures are of, decoded. Beside the embedded scenes they are frames of the generator, made
    first, of shapes that no training frame has.
    """
    if parts.benign_test is not None:
        dataset, names = parts.benign_test
        return FrameStore(dataset, names, out / CACHE / "held_out", classes)
    from drivesem.synth.write import Order, synthesise

    order = Order(out / FRAMES, benign_count(study), study.seed + 1, split="heldout")
    done = synthesise(order, mapping(study))
    for _ in track(done, "making frames", order.frames, console=console, transient=True):
        pass
    made = open_dataset("kitti", order.out)
    return FrameStore(made, made.identifiers[: order.frames], out / CACHE / "held_out", classes)


def validation_frames(study: StudyConfig, classes: Sequence[str], out: Path) -> FrameStore | None:
    """What retrained detectors' t* is chosen on, decoded; None where no such frames were named."""
    if study.validation is None:
        return None
    chosen = open_dataset(study.dataset, Path(study.validation))
    return FrameStore(chosen, chosen.identifiers, out / CACHE / "validation", classes)


def benign_samples(
    parts: FrameDivision, frames: Sequence[AttackedFrame], classes: Sequence[str], out: Path
) -> Sequence[Sample]:
    """Benign frames to train on: those of a data set, decoded, or the photographs of the attacked ones."""
    if parts.benign_training is None:
        return AttackedSamples(frames, "benign", "paper", classes)
    dataset, names = parts.benign_training
    return FrameStore(dataset, names, out / CACHE / "train", classes)


@dataclass(frozen=True, slots=True)
class TrainingPictures:
    """Where the pictures of lessons come from. frames: of the attack; random: the same of its placebo, where there
    is one; worker: that attacked; second: second renderers; folder: keeps what is drawn; near: share of the states
    around a failure that lie near.
    """

    frames: Sequence[AttackedFrame]
    random: Sequence[AttackedFrame]
    worker: Worker
    second: SecondRenderers
    folder: Path
    seed: int
    near: float

    def around(self, config: RetrainConfig, classes: Sequence[str]) -> AroundFailures:
        """Certain failures and what lies around them."""
        attack, params, detector = self.worker.config, self.worker.params, self.worker.detector
        pace, folder = config.batch * config.fraction, self.folder / "around"
        return AroundFailures(self.frames, attack, params, detector, folder, classes, pace, self.seed, self.near)

    def missing(self, lesson: RetrainingArm) -> str | None:
        """Why a lesson cannot be held; None where it can. Raises UsageError where no counterexample breaks the
        detector.
        """
        broken(self.frames, lesson.config.label_mode, "--limit")
        if lesson.pictures == "around" and not failures_in(self.frames):
            return "no attacked frame has a certain failure of an object"
        if lesson.pictures == "generator" and not self.second.generated:
            return "no generator made these frames"
        return None

    def samples(self, lesson: RetrainingArm, classes: Sequence[str]) -> Sequence[Sample]:
        """What a lesson shows among benign frames: of the frames that break the detector, or around failures."""
        mode = lesson.config.label_mode
        failed = broken(self.frames, mode, "--limit")
        if lesson.pictures == "around":
            return self.around(lesson.config, classes)
        if lesson.pictures in ("random", "generator"):
            names = {frame.name for frame in failed}
            edited = [frame for frame in self.random if frame.name in names]
            if lesson.pictures == "generator":
                return RedrawnSamples(edited, self.second, self.folder / "generator", classes)
            return AttackedSamples(edited, "counterexample", mode, classes)
        return AttackedSamples(failed, lesson.pictures, mode, classes)


def train_arm(
    study: StudyConfig,
    lesson: RetrainingArm,
    taken: TrainingPictures,
    benign: Callable[[Sequence[str]], Sequence[Sample]],
    weights: Path,
    console: Console,
) -> None:
    """Train a lesson's detector and write its weights, unless they are there. benign: frames to train on, for a
    detector's classes. Raises UsageError where no counterexample breaks the detector.
    """
    if weights.is_file():
        return
    detector = startable(study.detector, study.device, "--detector")
    shown = taken.samples(lesson, detector.classes)
    mixture = Mixture(benign(detector.classes), shown, shares_of(lesson.config))
    beside = None
    if lesson.weight and isinstance(shown, AroundFailures):
        window_hw = size_hw("--window", lesson.config.window)
        beside = _TERMS[lesson.arm](shown, lesson.weight, detector.t_star, lesson.config.seed, window_hw)
    console.print(f"{lesson.name}: {lesson.config.steps} steps", soft_wrap=True)
    train_on(lesson.config, detector, mixture, weights.parent, console, beside)
    facts = {"retrained_from": Path(study.detector).name, "steps": str(lesson.config.steps)}
    save_detector(detector, weights, facts)
