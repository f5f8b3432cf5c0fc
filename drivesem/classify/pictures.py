"""Pictures of objects, rendered into a data set SPLIT/CLASS/OBJECT-VIEW.png and read from it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from drivesem.classify.objects.embedded import open_objects
from drivesem.classify.objects.types import SPLITS, ObjectModel, ObjectSet, Split
from drivesem.classify.scenes import VIEWS, ObjectScene, open_backgrounds
from drivesem.classify.space import Lamp
from drivesem.config.commands import ClassifyConfig
from drivesem.config.errors import UsageError
from drivesem.run.driver import JobResults, ProgressSettings, run_frame_jobs
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.io import to_uint8


@dataclass(frozen=True, slots=True)
class ObjectView:
    """One view of one object, which makes a picture."""

    split: Split
    """Split of the object."""
    name: str
    """Class and name of the object, such as "bus/0007"."""
    view: str
    """Key of `VIEWS`."""

    @property
    def identifier(self) -> str:
        """Name of the picture, as in file names."""
        return f"{self.name.replace('/', '-')}-{self.view}"


@dataclass(frozen=True)
class ObjectRenderer:
    """Loads and renders objects; built once per process."""

    objects: ObjectSet
    """The objects."""
    backgrounds: Callable[[str], Tensor]
    """Returns a picture's background by its name."""
    load_model: Callable[[str], ObjectModel]
    """Loads an object by name."""
    lamp: Lamp = "white"
    """The lamp."""

    @classmethod
    def from_config(cls, config: ClassifyConfig) -> ObjectRenderer:
        """Open objects and backgrounds. Raises SceneError if they cannot be used."""
        objects = open_objects(config.objects)
        # Cache the last object, since its views follow each other.
        return cls(objects, open_backgrounds(config.backgrounds), lru_cache(maxsize=1)(objects.load), config.lamp)

    def load_scene(self, view: ObjectView) -> ObjectScene:
        """Load the scene of a view. Raises SceneError for the object's or the background's file."""
        model = self.load_model(view.name)
        return ObjectScene(view.identifier, model, view.view, self.backgrounds(view.identifier), self.lamp)

    @torch.no_grad()
    def write_picture(self, view: ObjectView, out: Path) -> None:
        """Render a picture into the data set at `out`, unless it is there."""
        path = picture_path(view, out)
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            files.write_png(path, to_uint8(self.load_scene(view).render().clamp(0, 1)))


def picture_path(view: ObjectView, folder: Path) -> Path:
    """Path of a picture in a data set's folder."""
    return folder / view.split / view.name.partition("/")[0] / f"{view.identifier}.png"


def parse_views(config: ClassifyConfig) -> tuple[str, ...]:
    """Parse the names of views. Raises UsageError."""
    names = tuple(part.strip() for part in config.views.split(","))
    if not set(names) <= set(VIEWS) or len(set(names)) != len(names):
        raise UsageError("--views", f"names among {', '.join(VIEWS)}, each once", repr(config.views))
    return names


def interleave_classes(names: Sequence[str]) -> list[str]:
    """Order names "class/object" so that the first of each class come first, then the second."""
    counts: Counter[str] = Counter()
    ranks: list[tuple[int, str]] = []
    for name in names:
        kind = name.rpartition("/")[0]
        ranks.append((counts[kind], name))
        counts[kind] += 1
    return [name for _, name in sorted(ranks, key=lambda rank: rank[0])]


def write_pictures(config: ClassifyConfig, out: Path) -> tuple[dict[str, int], dict[str, str]]:
    """Render the missing pictures of all splits, of at most `limit` objects each.

    Args:
        config: Settings.
        out: Folder of the data set.

    Returns:
        Number of pictures by split, and reason by picture that could not be rendered.

    Raises:
        UsageError: There are no objects.
        SceneError: An object that cannot be used, without --keep-going.
    """
    renderer, views = ObjectRenderer.from_config(config), parse_views(config)
    jobs = [
        ObjectView(split, name, view)
        for split in SPLITS
        for name in interleave_classes(renderer.objects.names(split))[: config.limit]
        for view in views
    ]
    if not jobs:
        raise UsageError("--objects", "objects in any of the splits", "none")
    outcome = render_pictures(jobs, renderer, config, out)
    counts = {split: sum(job.split == split for job in outcome.results) for split in SPLITS}
    return counts, outcome.failed


def render_pictures(
    views: Sequence[ObjectView], renderer: ObjectRenderer, config: ClassifyConfig, out: Path
) -> JobResults[ObjectView, None]:
    """Render the missing pictures of a data set.

    Args:
        views: The pictures.
        renderer: Renderer of this process.
        config: Settings, from which other processes build their renderers.
        out: Folder of the data set.

    Raises:
        SceneError: An object that cannot be used, without --keep-going.
    """
    return run_frame_jobs(
        views,
        partial(renderer.write_picture, out=out),
        partial(_make_worker, config, out),
        config,
        ProgressSettings("rendering objects"),
        lambda view: view.identifier,
    )


def _make_worker(config: ClassifyConfig, out: Path) -> Callable[[ObjectView], None]:
    return partial(ObjectRenderer.from_config(config).write_picture, out=out)


def read_pictures(folder: Path, split: str, classes: tuple[str, ...]) -> tuple[Tensor, Tensor]:
    """Read the pictures of a split.

    Args:
        folder: Folder of the data set.
        split: The split.
        classes: Names of the classes, in the order of labels.

    Returns:
        RGB (N, 3, H, W) uint8, and labels (N,) int64.

    Raises:
        FormatError: A class without pictures, a damaged picture, or different sizes.
    """
    paths: list[Path] = []
    labels: list[int] = []
    for label, name in enumerate(classes):
        own = sorted((folder / split / name).glob("*.png"))
        if not own:
            raise FormatError(str(folder / split / name), "pictures of this class", "none")
        paths += own
        labels += [label] * len(own)
    return read_images(paths), torch.tensor(labels)


def read_images(paths: Sequence[Path]) -> Tensor:
    """Read pictures of one size: RGB (N, 3, H, W) uint8. Raises FormatError."""
    images: list[np.ndarray] = []
    for path in paths:
        images.append(files.read_image(path, images[0].shape[:2] if images else None))  # type: ignore[arg-type]
    return torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2)
