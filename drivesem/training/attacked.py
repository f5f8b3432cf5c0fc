"""The frames of an attack's run as training and evaluation take them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from detectors.base import Predictor
from detectors.training import Sample
from detectors.types import CLASSES, Detections
from drivesem.attack.judging import HEADLINE, JudgedClasses
from drivesem.attack.labels import LabelMode, with_others
from drivesem.data import kitti
from drivesem.evaluation.coco import ClassScores, evaluate
from drivesem.failures.second_renderer.choose import SecondRenderers
from drivesem.failures.second_renderer.generator import GeneratorRedraw
from drivesem.run.frame import RESULT, as_targets
from drivesem.run.labels import frames_in
from drivesem.run.looking import as_picture, detections_in
from drivesem.run.results import FrameResult, load_frame
from drivesem.training.targets import TRAINED, training_targets
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.io import load_others, load_scene

Stage = Literal["benign", "rerender", "counterexample"]
"""The photograph, the same rendered again without any change, and what the attack made of it."""


@dataclass(frozen=True)
class AttackedFrame:
    """A frame of a run. name: its identifier."""

    run: Path
    name: str

    @property
    def folder(self) -> Path:
        return self.run / "frames" / self.name

    @cached_property
    def result(self) -> FrameResult:
        """What came of the attack."""
        return load_frame(self.folder / RESULT)

    def image(self, stage: Stage) -> np.ndarray:
        """Pixels (H, W, 3) uint8 RGB."""
        return files.read_image(self.folder / f"{stage}.png")


class AttackedSamples(Sequence[Sample]):
    """To train on: photographs, as they are or rendered again, with benign labels, or counterexamples with those
    of a mode; read each time. People and whatever else the scenes leave as it is have their own labels.
    """

    def __init__(
        self, frames: Sequence[AttackedFrame], stage: Stage, mode: LabelMode, classes: Sequence[str]
    ) -> None:
        self._frames = frames
        self._stage: Stage = stage
        name = f"labels_{mode if stage == 'counterexample' else 'paper'}.txt"
        labels = [
            with_others(kitti.read_labels(frame.folder / name), load_others(frame.folder / "scene"))
            for frame in frames
        ]
        self._targets = [training_targets(of_frame, TRAINED, classes) for of_frame in labels]

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> Sample:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self._frames[index].image(self._stage), self._targets[index]


class RedrawnSamples(Sequence[Sample]):
    """To train on: the changes of a run of generated frames, as the generator draws and labels them. Drawn when
    they are first asked for, and kept in `folder`.
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
            renderer = self._second.of(frame.name, changed)
            if not isinstance(renderer, GeneratorRedraw):
                raise FormatError(f"frame {frame.name}", "a frame that the generator made", "another one")
            drawn = renderer.drawn(changed)
            with files.whole_folder(folder) as part:
                files.write_png(part / "picture.png", drawn.image)
                kitti.write_labels(part / "labels.txt", drawn.labels)
        labels = kitti.read_labels(folder / "labels.txt")
        return files.read_image(folder / "picture.png"), training_targets(labels, TRAINED, self._classes)


def frames_of(run: Path) -> list[AttackedFrame]:
    """The finished frames of a run of `drivesem attack`, by name. Raises FormatError where there are none."""
    found = [AttackedFrame(run, name) for name in frames_in(run)]
    if not found:
        raise FormatError(str(run), "a run of drivesem attack with finished frames", "none")
    return found


def look(detector: Predictor, frames: Sequence[AttackedFrame], stage: Stage, device: str) -> list[Detections]:
    """What a detector finds in pictures of a stage: labels among the judged classes, on the CPU."""
    return [detections_in(detector, as_picture(np.array(frame.image(stage)), device)) for frame in frames]


def figures(
    detector: Predictor,
    t_star: float,
    frames: Sequence[AttackedFrame],
    found: Sequence[Detections],
    mode: LabelMode,
) -> ClassScores:
    """The headline's figures of detections beside the labels of a mode, as `drivesem attack` judges them."""
    judged = JudgedClasses.of(detector)
    results = [frame.result for frame in frames]
    records = [r.targets_benign if mode == "paper" else r.targets_moved for r in results]
    targets = [judged.targets(as_targets(record, CLASSES)) for record in records]
    return evaluate(targets, found, judged.names, t_star, HEADLINE).headline
