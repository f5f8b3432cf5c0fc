"""Training samples: frames of any data set, decoded once; perturbed frames; frames of runs, and mixtures of both."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from detectors.anchors import fit_anchors, target_sizes
from detectors.base import Predictor
from detectors.squeezedet import ANCHOR_SIZES_WH
from detectors.training import AugmentedDataset, Sample
from detectors.types import CLASSES, Detections, Targets
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.labels import Difficulty, Labeller, LabelMode, append_other_labels, to_kitti_labels
from drivesem.attacks.space import PAPER_PARAMETERS, Parameter, ParameterSpace
from drivesem.attacks.targets import HEADLINE, EvaluatedClasses
from drivesem.data import kitti
from drivesem.data.classes import CLASS_OF_TYPE, IGNORED_TYPES, select_road_users
from drivesem.data.registry import Dataset
from drivesem.evaluation.coco import ClassScores, evaluate
from drivesem.failures.second_renderer.generator import GeneratorRenderer
from drivesem.failures.second_renderer.selection import SecondRenderers
from drivesem.run.detection_cache import detect_objects, image_to_tensor
from drivesem.run.frame import targets_from_records
from drivesem.run.labels import RESULT, list_frames
from drivesem.run.results import FrameResult, load_frame
from scene_ir import files
from scene_ir.derender.derender import DerenderSettings, derender
from scene_ir.errors import FormatError, SceneError
from scene_ir.io import load_other_labels, load_scene, to_uint8
from scene_ir.render.compositor import Compositor
from scene_ir.types import Frame, Labels, SceneIR

PIXELS, INDEX = "pixels.u8", "index.json"
_COMPARED_FRAMES = 5
"""Number of frames, up to twice as many, that are compared to check a cache."""


class FrameStore(Sequence[Sample]):
    """Frames with their labels; the decoded pixels lie in one memory-mapped file.

    New frames of a data set are appended to the file; a data set with other images is decoded again.
    """

    def __init__(
        self,
        dataset: Dataset,
        names: Iterable[str],
        cache: Path,
        classes: Sequence[str],
        done: Callable[[], object] | None = None,
    ) -> None:
        """Decode frames that are not in the cache.

        Args:
            dataset: The data set.
            names: Frames to use.
            cache: Folder of the decoded pixels.
            classes: Names of the classes.
            done: Called after each frame.

        Raises:
            FormatError: A frame cannot be read or has no labels.
            WriteError: The cache cannot be written.
        """
        chosen = list(names)
        index = _known(cache, dataset, chosen)
        end = sum(height * width * 3 for _, height, width in index.values())
        with files.name_write_errors(cache / PIXELS):
            cache.mkdir(parents=True, exist_ok=True)
            with (cache / PIXELS).open("r+b" if (cache / PIXELS).is_file() else "w+b") as file:
                file.truncate(end)
                file.seek(end)
                for name in chosen:
                    if name not in index:
                        image = to_uint8(dataset.frame(name).photograph)
                        file.write(image.tobytes())
                        index[name] = (end, image.shape[0], image.shape[1])
                        end += image.size
                    if done is not None:
                        done()
        rows = [(name, *place) for name, place in index.items()]
        files.write_text(cache / INDEX, json.dumps(rows))
        self.dataset, self.classes = dataset, tuple(classes)
        self.names = tuple(chosen)
        self._places = [index[name] for name in chosen]
        self._pixels = np.memmap(cache / PIXELS, np.uint8, "r", shape=(max(end, 1),)) if end else np.zeros(0, "u1")
        self.labels = [_labels(dataset, name) for name in chosen]
        trained = adapt_limits(TRAINING_LIMITS, self.labels)
        self._targets = [training_targets(labels, trained, self.classes) for labels in self.labels]

    def __len__(self) -> int:
        return len(self.names)

    def image(self, index: int) -> np.ndarray:
        """Pixels (H, W, 3) uint8 RGB."""
        start, height, width = self._places[index]
        return self._pixels[start : start + height * width * 3].reshape(height, width, 3)

    def __getitem__(self, index: int) -> Sample:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.image(index), self._targets[index]

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all pixels, hexadecimal."""
        known = hashlib.sha256()
        for index in range(len(self)):
            known.update(self.image(index).tobytes())
        return known.hexdigest()

    def object_count(self) -> int:
        """Number of objects to train on."""
        return sum(int((~targets.ignore).sum()) for targets in self._targets)

    def fit_anchors(self, seed: int) -> tuple[tuple[float, float], ...]:
        """Fit as many anchors as SqueezeDet's published ones to the objects' sizes by k-means. Raises ValueError
        for too few different sizes.
        """
        sizes = np.concatenate([target_sizes(targets) for targets in self._targets])
        return fit_anchors(sizes, len(ANCHOR_SIZES_WH), seed).sizes_wh

    def evaluation_targets(self, difficulty: Difficulty) -> list[Targets]:
        """Labels to evaluate by, for each frame."""
        limits = adapt_limits(difficulty, self.labels)
        return [evaluation_targets(labels, limits, self.classes) for labels in self.labels]


def _known(cache: Path, dataset: Dataset, names: Sequence[str]) -> dict[str, tuple[int, int, int]]:
    """Offset, height and width of each frame in a cache. Empty where its pixels are not the data set's: another
    folder's frames may have the same names.
    """
    if not (cache / INDEX).is_file() or not (cache / PIXELS).is_file():
        return {}
    index = {name: (start, height, width) for name, start, height, width in files.read_json(cache / INDEX)}
    shared = [name for name in names if name in index]
    # From the last one backwards: inserting or removing a numbered frame shifts all later names.
    for name in shared[:: -max(len(shared) // _COMPARED_FRAMES, 1)]:
        start, height, width = index[name]
        image = to_uint8(dataset.frame(name).photograph)
        cached = np.fromfile(cache / PIXELS, np.uint8, image.size, offset=start)
        if image.shape[:2] != (height, width) or not np.array_equal(cached, image.reshape(-1)):
            with files.name_write_errors(cache / INDEX):
                (cache / INDEX).unlink()  # before its pixels: the process may be killed in between
            return {}
    return index


def _labels(dataset: Dataset, name: str) -> Labels:
    labels = dataset.labels(name)
    if labels is None:
        raise FormatError(f"frame {name}", "labels", "none")
    return labels


OCCLUSION_UNKNOWN = 3
"""KITTI's code of an unknown occlusion."""

TRAINING_LIMITS = Difficulty(min_height_px=12.0, max_occlusion=OCCLUSION_UNKNOWN - 1, max_truncation=1.0)
"""Limits of training objects: high enough for a 16 px grid, and not known to be fully occluded."""


def adapt_limits(difficulty: Difficulty, labels: Iterable[Labels]) -> Difficulty:
    """Drop the limit on occlusion where a data set never states it."""
    if any(bool((one.occlusion != OCCLUSION_UNKNOWN).any()) for one in labels):
        return difficulty
    return replace(difficulty, max_occlusion=OCCLUSION_UNKNOWN)


def training_targets(labels: Labels, difficulty: Difficulty, classes: Sequence[str]) -> Targets:
    """Convert labels to training targets. Too hard objects and regions are ignored; objects of other classes, and
    types that are no road users, are background.

    Args:
        labels: Labels of a frame.
        difficulty: Limits of the objects.
        classes: Names of the classes.
    """
    labels = select_road_users(labels)
    targets = make_targets(labels)
    ignore = targets.ignore.clone()
    ignore[: len(labels.kind)] |= _too_hard(labels, difficulty)
    own = _places(classes)[targets.labels]
    chosen = (own >= 0) | ignore
    return Targets(targets.boxes_xyxy[chosen], own[chosen].clamp_min(0), ignore[chosen])


def evaluation_targets(labels: Labels, difficulty: Difficulty, classes: Sequence[str]) -> Targets:
    """Convert labels to evaluation targets. Too hard objects, objects of other classes, and regions are ignored for
    every class; types that are no road users are background.

    Args:
        labels: Labels of a frame.
        difficulty: Limits of the objects.
        classes: Names of the classes.
    """
    labels = select_road_users(labels)
    named = make_targets(labels)
    ignore = named.ignore.clone()
    ignore[: len(labels.kind)] |= _too_hard(labels, difficulty)
    own = _places(classes)[named.labels]
    # too hard objects, neighbours of a class, and regions are ignored for every class
    every = ignore | (own < 0)
    rows = torch.cat([torch.arange(len(ignore))[~every], torch.arange(len(ignore))[every].repeat(len(classes))])
    label = torch.cat([own[~every], torch.arange(len(classes)).repeat_interleave(int(every.sum()))])
    left_out = torch.ones(int(every.sum()) * len(classes), dtype=torch.bool)
    return Targets(named.boxes_xyxy[rows], label, torch.cat([ignore[~every], left_out]))


def make_targets(labels: Labels) -> Targets:
    """Return the targets of road users (see `select_road_users`) in file order, then of DontCare regions.

    Targets that are ignored for every class have the label 0. Objects with boxes without area are ignored, since no
    detection can match them.
    """
    names = [CLASS_OF_TYPE.get(kind) or IGNORED_TYPES[kind] for kind in labels.kind]
    index = [0 if name is None else CLASSES.index(name) for name in names]
    regions = labels.ignore_xyxy.shape[0]
    flat = (labels.boxes_xyxy[:, 2:] <= labels.boxes_xyxy[:, :2]).any(dim=1).tolist()
    ignored = [kind in IGNORED_TYPES or thin for kind, thin in zip(labels.kind, flat, strict=True)]
    return Targets(
        boxes_xyxy=torch.cat([labels.boxes_xyxy, labels.ignore_xyxy]),
        labels=torch.tensor([*index, *[0] * regions], dtype=torch.int64),
        ignore=torch.tensor([*ignored, *[True] * regions], dtype=torch.bool),
    )


def _too_hard(labels: Labels, difficulty: Difficulty) -> torch.Tensor:
    """(N,) bool. An unknown truncation (NaN) does not exclude an object."""
    height = labels.boxes_xyxy[:, 3] - labels.boxes_xyxy[:, 1]
    return (
        (height < difficulty.min_height_px)
        | (labels.occlusion > difficulty.max_occlusion)
        | (labels.truncation > difficulty.max_truncation)
    )


def _places(classes: Sequence[str]) -> torch.Tensor:
    """Index of each of `CLASSES` in `classes`; -1 where it is missing."""
    return torch.tensor([classes.index(name) if name in classes else -1 for name in CLASSES])


VARIANTS = 4
"""Perturbations per frame: de-rendering costs more than a few renders."""
PARAMETERS = PAPER_PARAMETERS
_BENT_BY = 0.3
"""Share of the budget from which lattice offsets are drawn: the bound on strain scales nearly all larger ones back."""


class PerturbedFrames(Sequence[Sample]):
    """The frames of a store; each view is perturbed with probability `share`.

    A frame is de-rendered when first drawn. Its variants are cached in `folder` and depend only on the frame, its
    index and the seed. Frames without vehicles, or that cannot be de-rendered, stay as they are.
    """

    def __init__(self, store: FrameStore, folder: Path, share: float, seed: int) -> None:
        self._store, self._folder, self._share, self._seed = store, folder, share, seed

    def __len__(self) -> int:
        return len(self._store)

    def __getitem__(self, index: int) -> Sample:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self._store[index]

    def draw(self, index: int, step: int, generator: np.random.Generator) -> Sample:
        """Draw a frame or one of its variants.

        Args:
            index: The frame.
            step: Not used.
            generator: Source of random numbers.
        """
        if generator.random() >= self._share:
            return self._store[index]
        variant = int(generator.integers(VARIANTS))
        name = self._store.names[index].replace("/", "_")
        folder = self._folder / name
        if not folder.is_dir():
            self._make(index, folder)
        if not (folder / f"{variant}.png").is_file():
            return self._store[index]
        labels = kitti.read_labels(folder / f"{variant}.txt")
        return files.read_image(folder / f"{variant}.png"), training_targets(
            labels, TRAINING_LIMITS, self._store.classes
        )

    def _make(self, index: int, folder: Path) -> None:
        """Write all variants of a frame at once; an empty folder where there are none."""
        with files.atomic_folder(folder) as part:
            frame = self._store.dataset.frame(self._store.names[index])
            try:
                variants = perturb_frame(frame, [self._seed, index])
            except SceneError:
                return
            for i, (image, labels) in enumerate(variants):
                files.write_png(part / f"{i}.png", image)
                kitti.write_labels(part / f"{i}.txt", labels)


@torch.no_grad()
def perturb_frame(frame: Frame, seed: Sequence[int]) -> list[tuple[np.ndarray, Labels]]:
    """Perturb a labelled frame `VARIANTS` times: pixels (H, W, 3) uint8 RGB, and moved labels.

    Empty for a frame without vehicles. Raises SceneError where the frame cannot be de-rendered.
    """
    scene = derender(frame, DerenderSettings(fit=False))
    if not len(scene.objects) or frame.labels is None:
        return []
    space = ParameterSpace(scene, PARAMETERS)
    feasible, compositor = FeasibleSet(space), Compositor(scene)
    labeller = Labeller(scene, compositor.render(scene))
    generator = np.random.default_rng([*seed, 4])
    reach = torch.ones(space.dim)
    reach[space.blocks.get(Parameter.MESH)] = _BENT_BY
    found = []
    for _ in range(VARIANTS):
        # Cubed: most codes stay near the photograph.
        drawn = torch.from_numpy(generator.uniform(-1, 1, space.dim).astype(np.float32)) ** 3 * reach
        theta = torch.where(drawn < 0, -drawn * space.lower, drawn * space.upper)
        image, labels, _ = render_state(feasible.project(theta).theta, space, compositor, labeller, scene)
        found.append((image, labels))
    return found


@torch.no_grad()
def render_state(
    theta: Tensor, space: ParameterSpace, compositor: Compositor, labeller: Labeller, base: SceneIR
) -> tuple[np.ndarray, Labels, Targets]:
    """Render and label a state.

    Args:
        theta: (D,) the state.
        space: Its parameters.
        compositor: Renderer of the scene.
        labeller: Its labeller.
        base: Scene of the labels that move.

    Returns:
        Pixels (H, W, 3) uint8 RGB; labels, including people and other objects outside of the scene; evaluation
        targets, of which the first rows are the scene's objects.
    """
    moved = space.apply(space.scene, theta)
    render = compositor.render(moved)
    labels = labeller.moved(moved, render)
    every = append_other_labels(to_kitti_labels(labels, base, moved), base.other_labels)
    return to_uint8(render.image), every, labels.targets


Stage = Literal["benign", "rerender", "counterexample"]
"""The photograph, its re-render without changes, and the attacked image."""


@dataclass(frozen=True)
class AttackedFrame:
    """A frame of an attack run."""

    run: Path
    """Folder of the run."""
    name: str
    """Identifier of the frame."""

    @property
    def folder(self) -> Path:
        return self.run / "frames" / self.name

    @cached_property
    def result(self) -> FrameResult:
        """Result of the attack."""
        return load_frame(self.folder / RESULT)

    def image(self, stage: Stage) -> np.ndarray:
        """Pixels (H, W, 3) uint8 RGB."""
        return files.read_image(self.folder / f"{stage}.png")


class AttackedSamples(Sequence[Sample]):
    """Training samples: photographs or re-renders with benign labels, or counterexamples with labels of a mode.

    Images are read each time. People and other objects outside of the scenes keep their own labels.
    """

    def __init__(
        self, frames: Sequence[AttackedFrame], stage: Stage, mode: LabelMode, classes: Sequence[str]
    ) -> None:
        self._frames = frames
        self._stage: Stage = stage
        name = f"labels_{mode if stage == 'counterexample' else 'paper'}.txt"
        labels = [
            append_other_labels(kitti.read_labels(frame.folder / name), load_other_labels(frame.folder / "scene"))
            for frame in frames
        ]
        self._targets = [training_targets(of_frame, TRAINING_LIMITS, classes) for of_frame in labels]

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> Sample:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self._frames[index].image(self._stage), self._targets[index]


class GeneratorSamples(Sequence[Sample]):
    """Training samples: the changes of a run on generated frames, rendered and labelled by the generator when first
    used, and cached in `folder`.
    """

    def __init__(
        self, frames: Sequence[AttackedFrame], second: SecondRenderers, folder: Path, classes: Sequence[str]
    ) -> None:
        self._frames, self._second, self._folder, self._classes = frames, second, folder, classes

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> Sample:  # pyright: ignore[reportIncompatibleMethodOverride]
        frame = self._frames[index]
        folder = self._folder / frame.name.replace("/", "_")
        if not folder.is_dir():
            changed = load_scene(frame.folder / "scene")
            renderer = self._second.renderer_for(frame.name, changed)
            if not isinstance(renderer, GeneratorRenderer):
                raise FormatError(f"frame {frame.name}", "a frame that the generator made", "another one")
            drawn = renderer.render_frame(changed)
            with files.atomic_folder(folder) as part:
                files.write_png(part / "picture.png", drawn.image)
                kitti.write_labels(part / "labels.txt", drawn.labels)
        labels = kitti.read_labels(folder / "labels.txt")
        return files.read_image(folder / "picture.png"), training_targets(labels, TRAINING_LIMITS, self._classes)


def load_attacked_frames(run: Path) -> list[AttackedFrame]:
    """List the finished frames of a run of `drivesem attack` in which there was something to attack. Raises
    FormatError where there are none.
    """
    found = [frame for name in list_frames(run) if (frame := AttackedFrame(run, name)).result.attacked]
    if not found:
        raise FormatError(str(run), "a run of drivesem attack with attacked frames", "none")
    return found


def detect_in_frames(
    detector: Predictor, frames: Sequence[AttackedFrame], stage: Stage, device: str
) -> list[Detections]:
    """Detect objects in the images of a stage.

    Args:
        detector: The detector.
        frames: Frames of a run.
        stage: Which image of each frame.
        device: Where the detector runs.

    Returns:
        Detections of each frame, with labels among the evaluated classes, on the CPU.
    """
    return [detect_objects(detector, image_to_tensor(np.array(frame.image(stage)), device)) for frame in frames]


def headline_scores(
    detector: Predictor,
    t_star: float,
    frames: Sequence[AttackedFrame],
    found: Sequence[Detections],
    mode: LabelMode,
) -> ClassScores:
    """Compute the headline's metrics as `drivesem attack` does.

    Args:
        detector: The detector.
        t_star: Score threshold for the recall.
        frames: Frames of a run.
        found: Detections of each frame.
        mode: Labels to compare with.
    """
    judged = EvaluatedClasses.from_detector(detector)
    results = [frame.result for frame in frames]
    records = [r.targets_benign if mode == "paper" else r.targets_moved for r in results]
    targets = [judged.map_targets(targets_from_records(record, CLASSES)) for record in records]
    return evaluate(targets, found, judged.names, t_star, HEADLINE).headline


Mix = Literal["replace", "add"]


@dataclass(frozen=True, slots=True)
class MixtureShares:
    """How counterexamples are mixed into benign frames."""

    fraction: float
    """Share of counterexamples in the training set, in (0, 1)."""
    mix: Mix
    """Whether counterexamples replace random benign frames or are added to all of them."""
    ramp_steps: int
    """Steps over which the probability of a counterexample, instead of a benign frame, rises from 0 to 1."""
    seed: int
    """Seed of the draws."""


class TrainingMixture(Sequence[Sample]):
    """Benign frames and counterexamples, each counterexample equally often, or once more.

    Raises ValueError where either is empty.
    """

    def __init__(self, benign: Sequence[Sample], counterexamples: Sequence[Sample], shares: MixtureShares) -> None:
        for name, frames in (("benign", benign), ("counterexamples", counterexamples)):
            if not len(frames):
                raise ValueError(f"{name}: expected at least one frame, found 0")
        self._benign, self._counterexamples, self._shares = benign, counterexamples, shares
        generator = np.random.default_rng([shares.seed, 5])
        count = len(benign)
        if shares.mix == "replace":
            wanted = min(max(round(shares.fraction * count), 1), count - 1) if count > 1 else 1
            self.drawn_benign = generator.permutation(count)[wanted:]
        else:
            wanted = max(round(count * shares.fraction / (1 - shares.fraction)), 1)
            self.drawn_benign = np.arange(count)
        rounds = -(-wanted // len(counterexamples))
        order = [generator.permutation(len(counterexamples)) for _ in range(rounds)]
        self.drawn_counterexamples = np.concatenate(order)[:wanted]

    def __len__(self) -> int:
        return len(self.drawn_benign) + len(self.drawn_counterexamples)

    def __getitem__(self, index: int) -> Sample:  # pyright: ignore[reportIncompatibleMethodOverride]
        if index < len(self.drawn_benign):
            return self._benign[int(self.drawn_benign[index])]
        return self._counterexamples[int(self.drawn_counterexamples[index - len(self.drawn_benign)])]

    def draw(self, index: int, step: int, generator: np.random.Generator) -> Sample:
        """Draw an entry; during the ramp, a random benign frame sometimes replaces a counterexample.

        Args:
            index: The entry.
            step: The step.
            generator: Source of random numbers.
        """
        if index >= len(self.drawn_benign) and generator.random() * self._shares.ramp_steps > step:
            return self._benign[int(generator.integers(len(self._benign)))]
        if index >= len(self.drawn_benign) and isinstance(self._counterexamples, AugmentedDataset):
            return self._counterexamples.draw(
                int(self.drawn_counterexamples[index - len(self.drawn_benign)]), step, generator
            )
        return self[index]
