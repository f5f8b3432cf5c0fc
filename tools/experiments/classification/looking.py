"""What networks and measures make of pictures, kept in files: features, and distances to what was before."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from drivesem.classify.networks.base import Classifier
from drivesem.classify.training import embedded
from drivesem.report.terminal import Console, training_progress_bar
from drivesem.run.detection_cache import weights_digest
from scene_ir import files
from tools.experiments.realism.comparison import Measures
from tools.experiments.realism.frechet import Gaussian, frechet
from tools.experiments.realism.measures import METRICS

LOOKED = "looked"
"""Folder of what is kept."""


def kept(path: Path, about: str, compute: Callable[[], Mapping[str, np.ndarray]]) -> Mapping[str, np.ndarray]:
    """What a file holds, if it is about that; else it is computed, and written."""
    if path.is_file():
        found = files.read_npz(path)
        if str(found["about"]) == about:
            return found
    found = {**compute(), "about": np.array(about)}
    files.write_npz(path, found)
    return found


@dataclass(frozen=True)
class Eyes:
    """A network that looks at pictures. name: for files and people; spec: what loads it; folder: the study's."""

    name: str
    spec: str
    network: Classifier
    folder: Path
    device: str

    @property
    def theirs(self) -> str:
        """The network of the paper that it stands beside: VGG-16, unless it is a ResNet-50."""
        return "resnet50" if self.network.architecture.startswith("resnet") else "vgg16"

    def features(self, name: str, paths: Sequence[Path]) -> Tensor:
        """Features (N, K) of pictures, which are known by a name of their own."""

        def look() -> Mapping[str, np.ndarray]:
            images = torch.from_numpy(np.stack([files.read_image(path) for path in paths])).permute(0, 3, 1, 2)
            title = f"{self.name} looks at {name}"
            return {"features": embedded(self.network, images, self.device, title).cpu().numpy()}

        found = kept(self.folder / LOOKED / f"{self.name}-{name}.npz", self.about(paths), look)
        return torch.from_numpy(found["features"]).to(self.device)

    def about(self, paths: Sequence[Path]) -> str:
        """What tells this network before these pictures from all others."""
        return "\n".join((weights_digest(self.network), *(f"{path.parent.name}/{path.name}" for path in paths)))


def apart(path: Path, pairs: Sequence[tuple[Path, Path]], measures: Measures) -> Mapping[str, np.ndarray]:
    """How far pictures are from those they were made of: distances (M,) by metric, PSNR's as squared errors; of
    metrics of sets the features (M, D), as "METRIC before" and "METRIC after". path: the file that keeps them.
    """

    def compute() -> Mapping[str, np.ndarray]:
        columns: dict[str, list[np.ndarray | float]] = {}
        with training_progress_bar(Console(stderr=True)) as progress:
            for pair in progress.track(pairs, description=f"distances of {path.stem}"):
                before, after = map(files.read_image, pair)
                for name, measure in measures.items():
                    if METRICS[name].pairwise:
                        columns.setdefault(name, []).append(measure(before, after))  # type: ignore[call-arg]
                    else:
                        columns.setdefault(f"{name} before", []).append(measure(before))  # type: ignore[call-arg]
                        columns.setdefault(f"{name} after", []).append(measure(after))  # type: ignore[call-arg]
        return {name: np.asarray(column, np.float64) for name, column in columns.items()}

    about = "\n".join((", ".join(measures), *(after.parent.name for _, after in pairs)))
    return kept(path, about, compute)


def between(features: Mapping[str, np.ndarray], metric: str, among: np.ndarray) -> float | None:
    """The distance of the sets of some pictures, among (M,) bool; None where there are too few. features: as of
    `apart`.
    """
    first, second = (features[f"{metric} {side}"][among] for side in ("before", "after"))
    return frechet(Gaussian.of(first), Gaussian.of(second)) if len(first) > 1 else None
