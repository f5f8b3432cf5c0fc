"""What `drivesem study retrain` trains, and on which frames: the arms of that study."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.progress import track

from detectors.registry import SHIPPED, save_detector
from detectors.training import Sample
from drivesem.data.joined import open_folders
from drivesem.data.registry import Dataset, open_dataset
from drivesem.questions.study.arms import Arm, attack_of
from drivesem.report.paper import PAPER_BENIGN, PAPER_COMBOS
from drivesem.report.terminal import Console
from drivesem.run.attack import Worker
from drivesem.run.protocol import follows_paper
from drivesem.run.workers import mapping
from drivesem.scenes.sources import SceneSource
from drivesem.settings.blocks import DEMO
from drivesem.settings.commands import DEFAULT_COMBO, Retrain, Study
from drivesem.settings.errors import UsageError
from drivesem.training.attacked import AttackedFrame, AttackedSamples, Stage
from drivesem.training.frames import FrameStore
from drivesem.training.mixture import Mixture
from drivesem.training.retraining import WEIGHTS, broken, shares_of, startable, train_on
from scene_ir.types import SceneIR

BENIGN = "benign detector"
RETRAINED, CACHE, FRAMES = "retrained", "cache", "frames"
"""Folders: trained detectors, decoded frames, frames that were made."""
_ATTACKED, _QUICK_ATTACKED = 400, 4
"""Frames whose counterexamples are trained on."""
_HELD_OUT_SHARE = 0.25
"""As in `drivesem retrain`."""
_PAPER_BEFORE = (PAPER_COMBOS[DEFAULT_COMBO], PAPER_BENIGN)
_PAPER_AFTER = (0.7276, 0.8473)
"""The paper's mAP on counterexamples against the detector as it was, and on benign frames, before retraining and
after: a quarter of 6,339 frames replaced, 6,000 steps. Its detector before is one that 24,000 steps on benign
frames, rendered again, have made."""
OURS = Retrain(
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
class Lesson:
    """One retraining. folder: short name; pictures: what is shown among benign frames; reference: the paper's mAP
    on counterexamples and on benign frames, of what the paper has, too.
    """

    name: str
    folder: str
    pictures: Stage
    config: Retrain
    reference: tuple[float, float] | None

    @property
    def run(self) -> str:
        """Folder of the attack on held-out frames, against its detector."""
        return f"held-out-{self.folder}"

    @property
    def labels(self) -> str:
        """Of its pictures: benign, or moved with the cars."""
        moved = self.pictures == "counterexample" and self.config.label_mode == "moved"
        return "moved" if moved else "benign"


@dataclass(frozen=True, slots=True)
class Parts:
    """Frames to train on and frames to judge by. learned, judged: names of those that may be attacked, None where
    all of a source may; benign: to train on, None for the attacked ones' photographs; held_out: to judge by, None
    where they are yet to be made.
    """

    learned: tuple[str, ...] | None
    judged: tuple[str, ...] | None
    benign: tuple[Dataset, tuple[str, ...]] | None
    held_out: tuple[Dataset, tuple[str, ...]] | None


@dataclass(frozen=True, slots=True)
class Among:
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


def lessons_of(study: Study) -> list[Lesson]:
    """What is trained: the ablation, ours and, in the full study, the paper's protocol."""
    ours = replace(
        OURS,
        seed=study.seed,
        device=study.device,
        mix=study.mix,
        label_mode=study.label_mode,
        # another's weights may have been trained by the published loss: it is what they know
        loss="quality" if study.detector in SHIPPED else "published",
        **(_QUICK if study.quick else {}),
    )
    paper = Retrain(run="", seed=study.seed, device=study.device)
    if study.train_steps is not None:
        ours, paper = (replace(one, steps=study.train_steps) for one in (ours, paper))
    lessons = [
        Lesson("retrained on benign re-rendered images", "re-rendered", "rerender", ours, _PAPER_BEFORE),
        Lesson("retrained, ours", "ours", "counterexample", ours, None),
    ]
    if not study.quick:
        lessons.append(Lesson("retrained, paper's protocol", "paper", "counterexample", paper, _PAPER_AFTER))
    return lessons


def reference_of(name: str, lessons: Sequence[Lesson], study: Study) -> tuple[float, float] | None:
    """The paper's mAP on counterexamples and on benign frames, of a detector by name; None where it has none, or
    where the study's attack is another than the paper's.
    """
    if not follows_paper(learning_arm(study).config):
        return None
    return next((lesson.reference for lesson in lessons if lesson.name == name), _PAPER_BEFORE)


def learning_arm(study: Study) -> Arm:
    """The attack on the frames to train on."""
    limit = study.limit or (_QUICK_ATTACKED if study.quick else _ATTACKED)
    config = replace(attack_of(study), combo=DEFAULT_COMBO, limit=limit)
    return Arm(f"combo {DEFAULT_COMBO}", f"combo-{DEFAULT_COMBO}", config)


def judging_arms(study: Study, lessons: Sequence[Lesson], out: Path) -> list[Arm]:
    """The same attack on held-out frames: against the detector as it was, then against each retrained one."""
    base = replace(learning_arm(study).config, limit=study.fresh or (3 if study.quick else 200))
    if study.dataset == DEMO:
        base = replace(base, seed=study.seed + 1)  # other streets
    else:
        base = replace(base, root=study.held_out or study.root)
    arms = [Arm(BENIGN, "held-out", base)]
    for lesson in lessons:
        retrained = replace(base, detector=str(weights_of(out, lesson)))
        arms.append(Arm(lesson.name, lesson.run, retrained))
    return arms


def weights_of(out: Path, lesson: Lesson) -> Path:
    """Where a lesson's weights lie."""
    return out / RETRAINED / lesson.folder / WEIGHTS


def parts_of(study: Study) -> Parts:
    """Which frames are for what. Raises UsageError where there are too few, SceneError for a bad folder."""
    if study.dataset == DEMO:
        return Parts(None, None, None, None)
    trained_on = [
        Path(part).resolve() for part in (study.root or "", *(study.benign_root or "").split(",")) if part
    ]
    if study.held_out is not None and Path(study.held_out).resolve() in trained_on:
        raise UsageError("--held-out", "a folder of which nothing is trained on", study.held_out)
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
    return Parts(learned, judged, benign, (held_out, kept[: benign_count(study)]))


def benign_count(study: Study) -> int:
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


def among(workers: Sequence[Worker], names: Sequence[str] | None) -> list[Worker]:
    """The workers, their sources limited to these frames; as they are where there is nothing to limit."""
    if names is None:
        return list(workers)
    chosen = frozenset(names)
    return [replace(worker, source=Among(worker.source, chosen)) for worker in workers]


def held_out_frames(study: Study, parts: Parts, classes: Sequence[str], out: Path, console: Console) -> FrameStore:
    """What benign figures are of, decoded. Beside the embedded scenes they are frames of the generator, made
    first, of shapes that no training frame has.
    """
    if parts.held_out is not None:
        dataset, names = parts.held_out
        return FrameStore(dataset, names, out / CACHE / "held_out", classes)
    from drivesem.synth.write import Order, synthesise

    order = Order(out / FRAMES, benign_count(study), study.seed + 1, split="heldout")
    done = synthesise(order, mapping(study))
    for _ in track(done, "making frames", order.frames, console=console, transient=True):
        pass
    made = open_dataset("kitti", order.out)
    return FrameStore(made, made.identifiers[: order.frames], out / CACHE / "held_out", classes)


def benign_samples(
    parts: Parts, frames: Sequence[AttackedFrame], classes: Sequence[str], out: Path
) -> Sequence[Sample]:
    """Benign frames to train on: those of a data set, decoded, or the photographs of the attacked ones."""
    if parts.benign is None:
        return AttackedSamples(frames, "benign", "paper", classes)
    dataset, names = parts.benign
    return FrameStore(dataset, names, out / CACHE / "train", classes)


def learn(
    study: Study,
    lesson: Lesson,
    frames: Sequence[AttackedFrame],
    benign: Callable[[Sequence[str]], Sequence[Sample]],
    weights: Path,
    console: Console,
) -> None:
    """Train a lesson's detector and write its weights, unless they are there. frames: of the attack's run; benign:
    frames to train on, for a detector's classes. Raises UsageError where no counterexample breaks the detector.
    """
    failed = broken(frames, lesson.config.label_mode, "--limit")
    if weights.is_file():
        return
    detector = startable(study.detector, study.device, "--detector")
    shown = AttackedSamples(failed, lesson.pictures, lesson.config.label_mode, detector.classes)
    mixture = Mixture(benign(detector.classes), shown, shares_of(lesson.config))
    console.print(f"{lesson.name}: {lesson.config.steps} steps", soft_wrap=True)
    train_on(lesson.config, detector, mixture, weights.parent, console)
    facts = {"retrained_from": Path(study.detector).name, "steps": str(lesson.config.steps)}
    save_detector(detector, weights, facts)
