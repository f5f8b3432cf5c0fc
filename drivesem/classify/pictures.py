"""Pictures of objects as a data set: SPLIT/CLASS/OBJECT-VIEW.png in a folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from drivesem.classify.objects.embedded import open_objects
from drivesem.classify.objects.types import SPLITS, ObjectModel, ObjectSet, Split
from drivesem.classify.scenes import VIEWS, ObjectScene, in_turn, open_backgrounds
from drivesem.config.commands import ClassifyConfig
from drivesem.config.errors import UsageError
from drivesem.run.driver import JobResults, ProgressSettings, run_frame_jobs
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.io import to_uint8


@dataclass(frozen=True, slots=True)
class Shown:
    """An object to be drawn from a view. name: of the object, "bus/0007"; of its class and it."""

    split: Split
    name: str
    view: str

    @property
    def identifier(self) -> str:
        """As folders are named."""
        return f"{self.name.replace('/', '-')}-{self.view}"


@dataclass(frozen=True)
class Studio:
    """What a process needs to draw objects: built once, used for many. model: loads an object by name."""

    objects: ObjectSet
    backgrounds: Callable[[str], Tensor]
    model: Callable[[str], ObjectModel]

    @classmethod
    def of(cls, config: ClassifyConfig) -> Studio:
        """Raises SceneError for objects or backgrounds that cannot be used."""
        objects = open_objects(config.objects)
        # The last object is kept, as it is seen from several views.
        return cls(objects, open_backgrounds(config.backgrounds), lru_cache(maxsize=1)(objects.load))

    def scene(self, shown: Shown) -> ObjectScene:
        """Raises SceneError naming the object's file, or the background's."""
        model = self.model(shown.name)
        return ObjectScene(shown.identifier, model, shown.view, self.backgrounds(shown.identifier))

    def place(self, shown: Shown, out: Path) -> Path:
        """Where a picture of a data set is, in its folder."""
        return out / shown.split / shown.name.partition("/")[0] / f"{shown.identifier}.png"

    @torch.no_grad()
    def write(self, shown: Shown, out: Path) -> None:
        """Draw a picture of a data set, where it is not there."""
        path = self.place(shown, out)
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            files.write_png(path, to_uint8(self.scene(shown).picture().clamp(0, 1)))


def views_of(config: ClassifyConfig) -> tuple[str, ...]:
    """The views by name. Raises UsageError."""
    names = tuple(part.strip() for part in config.views.split(","))
    if not set(names) <= set(VIEWS) or len(set(names)) != len(names):
        raise UsageError("--views", f"names among {', '.join(VIEWS)}, each once", repr(config.views))
    return names


def write_pictures(config: ClassifyConfig, out: Path) -> tuple[dict[str, int], dict[str, str]]:
    """Draw all splits into a folder, as far as they are not there: how many pictures each has, and why others
    could not be drawn. --limit: so many objects of each split, classes in turn.
    """
    studio, views = Studio.of(config), views_of(config)
    jobs = [
        Shown(split, name, view)
        for split in SPLITS
        for name in in_turn(studio.objects.names(split))[: config.limit]
        for view in views
    ]
    if not jobs:
        raise UsageError("--objects", "objects in any of the splits", "none")
    answers = draw(jobs, studio, config, out)
    done = {split: sum(job.split == split for job in answers.results) for split in SPLITS}
    return done, answers.failed


def draw(jobs: Sequence[Shown], studio: Studio, config: ClassifyConfig, out: Path) -> JobResults[Shown, None]:
    """Draw pictures into a folder, as far as they are not there. Raises SceneError."""
    work, build = partial(studio.write, out=out), partial(_drawer, config, out)
    return run_frame_jobs(
        jobs, work, build, config, ProgressSettings("drawing objects"), lambda job: job.identifier
    )


def _drawer(config: ClassifyConfig, out: Path) -> Callable[[Shown], None]:
    return partial(Studio.of(config).write, out=out)


def read_pictures(folder: Path, split: str, classes: tuple[str, ...]) -> tuple[Tensor, Tensor]:
    """Pictures (N, 3, H, W) uint8 RGB of a split, and their labels (N,) int64. Raises FormatError where a class
    has none, where one of them does not decode, or they differ in size.
    """
    images: list[np.ndarray] = []
    labels: list[int] = []
    for label, name in enumerate(classes):
        paths = sorted((folder / split / name).glob("*.png"))
        if not paths:
            raise FormatError(str(folder / split / name), "pictures of this class", "none")
        for path in paths:
            images.append(files.read_image(path, images[0].shape[:2] if images else None))  # type: ignore[arg-type]
            labels.append(label)
    return torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2), torch.tensor(labels)
