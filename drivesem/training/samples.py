"""Training samples and detections of an attack run's frames, and the mixture of benign frames and counterexamples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from detectors.base import Predictor
from detectors.training import AugmentedDataset, Sample
from detectors.types import CLASSES, Detections
from drivesem.attack.labels import LabelMode, append_other_labels
from drivesem.attack.targets import HEADLINE, EvaluatedClasses
from drivesem.data import kitti
from drivesem.evaluation.coco import ClassScores, evaluate
from drivesem.failures.second_renderer.generator import GeneratorRenderer
from drivesem.failures.second_renderer.selection import SecondRenderers
from drivesem.run.detection_cache import detect_objects, image_to_tensor
from drivesem.run.frame import RESULT, targets_from_records
from drivesem.run.labels import list_frames
from drivesem.run.results import FrameResult, load_frame
from drivesem.training.frames import TRAINING_LIMITS, training_targets
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.io import load_other_labels, load_scene

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
    """List the finished frames of a run of `drivesem attack` by name. Raises FormatError where there are none."""
    found = [AttackedFrame(run, name) for name in list_frames(run)]
    if not found:
        raise FormatError(str(run), "a run of drivesem attack with finished frames", "none")
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
