"""Detectors fine-tuned on real dry days, with and without drivesem's edits, and tested on real adverse frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

import drivesem as ds
from detectors.augment import AugmentSettings
from detectors.base import Detector
from detectors.registry import load_detector, save_detector
from detectors.training import Sample
from drivesem.attacks.budgets import PRESETS, STREET
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.labels import Difficulty, Labeller
from drivesem.attacks.space import Parameter, ParameterSpace, parse_params
from drivesem.attacks.targets import HEADLINE
from drivesem.config.commands import RetrainConfig
from drivesem.data import kitti
from drivesem.data.registry import Dataset, open_dataset
from drivesem.evaluation.curves import ClassMatches
from drivesem.evaluation.matched_class import MatchedClass
from drivesem.reporting.tables import Console
from drivesem.training.frames import (
    TRAINING_LIMITS,
    FrameStore,
    MixtureShares,
    TrainingMixture,
    render_state,
    training_targets,
)
from drivesem.training.retrain import WEIGHTS, fine_tune, load_start
from drivesem.training.validation import detect_in_store
from scene_ir import files
from scene_ir.errors import SceneError
from scene_ir.io import to_tensor
from scene_ir.render.compositor import Compositor
from tools.bench.conditions import CONDITIONS, DAY, ConditionSets
from tools.experiments.reality.observations import ADVERSE, conditions_config
from tools.experiments.reality.samples import PARAMS, short_name
from tools.experiments.settings import RealityConfig
from tools.experiments.tables import RESULTS, read_table, write_table

START = "start"
"""Name of the detector before training."""
ARMS = {
    "days": "dry days",
    "usual": "usual augmentation",
    "random": "random edits",
    "worst": "counterexamples",
}
"""Training arms: days without changes of colour, blur or noise; with them; and with drivesem's edits as well."""
ARM_TITLES = {START: "before training"} | ARMS
"""Titles of the tested detectors."""
_UNCHANGED = AugmentSettings(
    brightness=0.0,
    contrast=0.0,
    gamma=0.0,
    channel_gain=0.0,
    saturation=0.0,
    hue_probability=0.0,
    blur_probability=0.0,
    noise_probability=0.0,
    jpeg_probability=0.0,
)
_SHARE = 0.5
"""Share of edited pictures in the arms that have some."""
_TRAINING = RetrainConfig(run="", window="640x384", scale="0.8,1.25", rate=1e-4, precision="float32", warmup=20)
_LEAST_SCORE = 0.05
"""Detections with lower scores are not stored."""
DETECTIONS, OBJECTS = "retrain-{}-detections.csv.gz", "retrain-{}-objects.csv.gz"
"""Tables of the detections and of the objects of each test frame, by retrained detector."""


@dataclass(frozen=True, slots=True)
class ArmDetection:
    """One detection of a car by the detector of an arm."""

    arm: str
    """Short name of the arm, or START."""
    seed: int
    """Seed of the training."""
    frame: str
    """Name of the frame."""
    score: float
    """Score."""
    true: bool
    """Whether it matches an object (IoU 0.5); otherwise it is a false alarm."""


@dataclass(frozen=True, slots=True)
class RetrainTestFrame:
    """A real frame of half B."""

    condition: str
    """Its condition."""
    frame: str
    """Its name."""
    objects: int
    """Cars to detect."""


def run_retraining(config: RealityConfig, out: Path) -> None:
    """Edit days, train the arms, test them and write the tables; what is finished stays."""
    console = Console(stderr=True)
    dataset = open_dataset("coco", Path(config.train_root or ""))
    names = dataset.identifiers[: config.days]
    start = load_start(config.detector, "cpu")
    store = FrameStore(dataset, names, out / "cache" / "days", start.classes)
    arms = [name.strip() for name in config.arms.split(",")]
    folder = out / "retrained" / short_name(config.detector)
    edits: dict[str, Sequence[Sample]] = {}
    if {"random", "worst"} & set(arms):
        edited = [edit_day(config, dataset, name, out / "edits") for name in names[: config.edited]]
        edits["random"] = EditedDays(edited, [0] * len(edited), start.classes)
        edits["worst"] = EditedDays(edited, find_worst(edited, start, folder / "losses.json"), start.classes)
    detectors = {(START, 0): load_detector(config.detector)}
    for seed in range(config.seeds):
        for arm in arms:
            weights = folder / f"{arm}-seed{seed}" / WEIGHTS
            if not weights.is_file():
                _train(config, arm, seed, store, edits.get(arm), weights, console)
            detectors[arm, seed] = load_detector(str(weights))
    _test(config, detectors, out)


def edit_day(config: RealityConfig, dataset: Dataset, name: str, out: Path) -> Path:
    """De-render a day and draw random states of it; an empty folder without vehicles.

    States are feasible within the budget street. Half of the codes of weather lie at an end of their range.
    """
    folder = out / name
    if folder.is_dir():
        return folder
    with files.atomic_folder(folder) as part:
        try:
            scene = ds.derender(dataset.frame(name)).ir
        except SceneError:
            return folder
        if not len(scene.objects):
            return folder
        space = ParameterSpace(scene, parse_params(PARAMS), PRESETS[STREET])
        feasible, compositor = FeasibleSet(space), Compositor(scene)
        labeller = Labeller(scene, compositor.render(scene))
        generator = np.random.default_rng([config.seed, *name.encode()])
        for k in range(config.states):
            share = torch.from_numpy(generator.uniform(0, 1, space.dim)).float()
            weather = space.blocks[Parameter.WEATHER]
            ends = torch.from_numpy(generator.integers(0, 2, space.dim)).float()
            at_end = torch.from_numpy(generator.random(space.dim) < 0.5)
            share[weather] = torch.where(at_end, ends, share)[weather]
            theta = feasible.project(space.lower + share * (space.upper - space.lower)).theta
            image, labels, _ = render_state(theta, space, compositor, labeller, scene)
            files.write_png(part / f"{k}.png", image)
            kitti.write_labels(part / f"{k}.txt", labels)
    return folder


def find_worst(folders: Sequence[Path], detector: Detector, path: Path) -> list[int]:
    """The state of each edited day with the detector's largest loss; losses are stored in a file."""
    losses: dict[str, list[float]] = files.read_json(path) if path.is_file() else {}
    for folder in folders:
        if folder.name not in losses:
            losses[folder.name] = [_loss(detector, picture) for picture in _pictures(folder)]
            files.write_json(path, losses)
    return [int(np.argmax(losses[folder.name] or [0.0])) for folder in folders]


def _pictures(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.png"), key=lambda path: int(path.stem))


def _loss(detector: Detector, picture: Path) -> float:
    image, targets = _read_edit(picture, detector.classes)
    with torch.no_grad():
        return round(float(detector.loss(detector(to_tensor(image)[None]), [targets])["total"]), 5)


def _read_edit(picture: Path, classes: Sequence[str]) -> Sample:
    labels = kitti.read_labels(picture.with_suffix(".txt"))
    return files.read_image(picture), training_targets(labels, TRAINING_LIMITS, classes)


class EditedDays(Sequence[Sample]):
    """One state of each edited day that has vehicles."""

    def __init__(self, folders: Sequence[Path], states: Sequence[int], classes: Sequence[str]) -> None:
        pairs = zip(folders, states, strict=True)
        self._paths = [_pictures(folder)[state] for folder, state in pairs if _pictures(folder)]
        self._classes = classes

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, index: int) -> Sample:  # pyright: ignore[reportIncompatibleMethodOverride]
        return _read_edit(self._paths[index], self._classes)


def _train(
    config: RealityConfig,
    arm: str,
    seed: int,
    days: FrameStore,
    edits: Sequence[Sample] | None,
    weights: Path,
    console: Console,
) -> None:
    settings = replace(_TRAINING, steps=config.train_steps, batch=config.batch, seed=seed, loss="quality")
    detector = load_start(config.detector, "cpu")
    samples = days if edits is None else TrainingMixture(days, edits, MixtureShares(_SHARE, "add", 0, seed))
    console.print(f"{ARMS[arm]}, seed {seed}: {config.train_steps} steps", soft_wrap=True)
    augment = _UNCHANGED if arm == "days" else None
    fine_tune(settings, detector, samples, weights.parent, console, augment=augment)
    save_detector(detector, weights, {"retrained_from": config.detector, "steps": str(config.train_steps)})


def _test(config: RealityConfig, detectors: dict[tuple[str, int], Detector], out: Path) -> None:
    """Run the detectors on real frames of half B, and write what they detect."""
    settings = conditions_config(replace(config, real=config.test, real_days=config.test), "B")
    sets = ConditionSets(settings)
    conditions = {condition.name: condition for condition in CONDITIONS}
    detections: list[tuple[ArmDetection]] = []
    frames: dict[str, RetrainTestFrame] = {}
    for condition in (DAY, *ADVERSE):
        by_dataset: dict[int, tuple[Dataset, list[str]]] = {}
        for dataset, name in sets.names(conditions[condition]):
            by_dataset.setdefault(id(dataset), (dataset, []))[1].append(name)
        for number, (dataset, names) in enumerate(by_dataset.values()):
            for (arm, seed), detector in detectors.items():
                cache = out / "cache" / f"test-{condition.replace(', ', '-')}-{number}"
                store = FrameStore(dataset, names, cache, detector.classes)
                found = detect_in_store(detector, store, range(len(store)))
                matched = MatchedClass.from_frames(
                    store.evaluation_targets(Difficulty()), found, detector.classes.index(HEADLINE)
                )
                matches = matched.candidates.class_matches(matched.match, 0)
                rows = zip(matches.frame, matches.score, matches.true_positives, strict=True)
                detections += [
                    (ArmDetection(arm, seed, names[int(frame)], round(float(score), 4), bool(hit)),)
                    for frame, score, hit in rows
                    if score >= _LEAST_SCORE
                ]
                for name, count in zip(names, matches.objects, strict=True):
                    frames[name] = RetrainTestFrame(condition, name, int(count))
    name = short_name(config.detector)
    write_table(out / RESULTS / DETECTIONS.format(name), (ArmDetection,), detections)
    write_table(out / RESULTS / OBJECTS.format(name), (RetrainTestFrame,), [(frame,) for frame in frames.values()])


def retrained_detectors(folder: Path) -> list[str]:
    """Names of the detectors with tables in a folder."""
    before, after = DETECTIONS.split("{}")
    return [
        path.name.removeprefix(before).removesuffix(after) for path in sorted(folder.glob(DETECTIONS.format("*")))
    ]


def read_matches(
    folder: Path, detector: str
) -> tuple[dict[tuple[str, int], ClassMatches], list[RetrainTestFrame]]:
    """Read the matches of each arm and seed in all test frames, and the frames. Raises FormatError."""
    table = read_table(folder / OBJECTS.format(detector), (RetrainTestFrame,))
    frames: list[RetrainTestFrame] = [row[0] for row in table]
    place = {frame.frame: i for i, frame in enumerate(frames)}
    objects = np.array([frame.objects for frame in frames], np.float64)
    by_arm: dict[tuple[str, int], list[ArmDetection]] = {}
    for (one,) in read_table(folder / DETECTIONS.format(detector), (ArmDetection,)):
        by_arm.setdefault((one.arm, one.seed), []).append(one)
    matches = {}
    for key, found in by_arm.items():
        ordered = sorted(found, key=lambda one: -one.score)
        hit = np.array([one.true for one in ordered], np.float64)
        matches[key] = ClassMatches(
            score=np.array([one.score for one in ordered]),
            frame=np.array([place[one.frame] for one in ordered], np.int64),
            true_positives=hit,
            false_positives=1 - hit,
            objects=objects,
        )
    return matches, frames
