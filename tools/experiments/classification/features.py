"""Features and distances of the study's pictures, cached in files, and attacks on pixels for comparison."""

from __future__ import annotations

import copy
import importlib.util
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from drivesem.classify.networks.architectures import Classifier, SqueezeNet
from drivesem.classify.networks.loading import load_classifier
from drivesem.classify.pictures import read_images
from drivesem.classify.training import compute_features
from drivesem.reporting.tables import Console, training_progress_bar
from drivesem.run.detection_cache import weights_digest
from scene_ir import files
from tools.experiments.realism.comparison import Measures
from tools.experiments.realism.metrics import METRICS, Gaussian, frechet_distance

FEATURES = "features"
"""Folder of cached features and distances, in the study's."""
PIXEL_ATTACKS = ("FGSM, 4/255", "PGD, 4/255", "CW, 2-norm")
PIXELS_HINT = "pip install 'drivesem[pixels]'"
_REACH, _STEP = 4 / 255, 1 / 255
"""Bound and step of a pixel's channel, of 1."""
_STEPS, _BATCH = 10, 16


def load_or_compute(
    path: Path, key: str, compute: Callable[[], Mapping[str, np.ndarray]]
) -> Mapping[str, np.ndarray]:
    """Arrays by name, cached in a file.

    Args:
        path: File of the cache.
        key: What identifies the arrays.
        compute: Computes them if the file holds others.
    """
    if path.is_file():
        cached = files.read_npz(path)
        if str(cached["about"]) == key:
            return cached
    arrays = {**compute(), "about": np.array(key)}
    files.write_npz(path, arrays)
    return arrays


@dataclass(frozen=True)
class NetworkFeatures:
    """A network of the study, with cached features of pictures."""

    name: str
    """Name in files and tables."""
    spec: str
    """Name or file to load it from."""
    classes: tuple[str, ...]
    """Names of its classes."""
    folder: Path
    """Folder of the study."""
    device: str
    """torch device."""
    text: NetworkFeatures | None = None
    """The network from which this one is trained as the paper's code does; None if this is one of the text."""

    @cached_property
    def network(self) -> Classifier:
        """The network. Raises FormatError if it cannot be loaded."""
        return load_classifier(self.spec, self.classes, self.device)

    @property
    def reading(self) -> str:
        """Reading of the paper."""
        return "text" if self.text is None else "code"

    @property
    def paper_network(self) -> str:
        """The paper's network that it is compared with: VGG-16, unless it is a ResNet-50."""
        network = self.network if self.text is None else self.text.network
        return "resnet50" if network.architecture.startswith("resnet") else "vgg16"

    @property
    def takes_normalisation(self) -> bool:
        """Whether the code's mean, deviation and rate apply to it; SqueezeNet's weights take 0 to 255."""
        network = self.network if self.text is None else self.text.network
        return network.architecture != SqueezeNet.architecture

    def features(self, name: str, paths: Sequence[Path]) -> Tensor:
        """Features (N, K) of a set of pictures called `name`."""

        def compute() -> Mapping[str, np.ndarray]:
            title = f"features of {self.name}, {name}"
            features = compute_features(self.network, read_images(paths), self.device, title)
            return {"features": features.cpu().numpy()}

        path = self.folder / FEATURES / f"{self.name}-{name}.npz"
        return torch.from_numpy(load_or_compute(path, self.cache_key(paths), compute)["features"]).to(self.device)

    def cache_key(self, paths: Sequence[Path]) -> str:
        """What identifies this network and these pictures."""
        return "\n".join((weights_digest(self.network), *(f"{path.parent.name}/{path.name}" for path in paths)))


def measure_distances(
    path: Path, pairs: Sequence[tuple[Path, Path]], measures: Measures
) -> Mapping[str, np.ndarray]:
    """Distances of pictures from their originals.

    Args:
        path: File that caches them.
        pairs: M originals and pictures.
        measures: Metrics by name.

    Returns:
        Distances (M,) by metric, PSNR's as squared errors; for metrics of sets the features (M, D), as
        `METRIC before` and `METRIC after`.
    """

    def compute() -> Mapping[str, np.ndarray]:
        columns: dict[str, list[np.ndarray | float]] = {}
        with training_progress_bar(Console(stderr=True)) as progress:
            for pair in progress.track(pairs, description=f"distances of {path.stem}"):
                before, after = map(files.read_image, pair)
                for name, measure in measures.items():
                    if METRICS[name].pairwise:
                        columns.setdefault(name, []).append(measure(before, after))  # pyright: ignore
                    else:
                        columns.setdefault(f"{name} before", []).append(measure(before))  # pyright: ignore
                        columns.setdefault(f"{name} after", []).append(measure(after))  # pyright: ignore
        return {name: np.asarray(column, np.float64) for name, column in columns.items()}

    key = "\n".join((", ".join(measures), *(after.parent.name for _, after in pairs)))
    return load_or_compute(path, key, compute)


def set_distance(features: Mapping[str, np.ndarray], metric: str, among: np.ndarray) -> float | None:
    """Frechet distance of pictures before and after; None for fewer than two.

    Args:
        features: From `measure_distances`.
        metric: A metric of sets.
        among: Which pictures count (M,) bool.
    """
    first, second = (features[f"{metric} {side}"][among] for side in ("before", "after"))
    if len(first) < 2:
        return None
    return frechet_distance(Gaussian.from_features(first), Gaussian.from_features(second))


def has_pixel_attacks() -> bool:
    """Whether the Adversarial Robustness Toolbox is installed."""
    return importlib.util.find_spec("art") is not None


def attack_pixels(network: Classifier, images: np.ndarray, labels: np.ndarray) -> Mapping[str, np.ndarray]:
    """Attack the pixels of pictures with the Adversarial Robustness Toolbox, for comparison.

    Args:
        network: The network.
        images: Pictures (N, 3, H, W) in [0, 1].
        labels: Their classes (N,).

    Returns:
        Pictures (N, 3, H, W) uint8 after each of PIXEL_ATTACKS.
    """
    from art.attacks import evasion  # pyright: ignore[reportMissingImports]
    from art.estimators import classification  # pyright: ignore[reportMissingImports]

    classifier = classification.PyTorchClassifier(
        model=copy.deepcopy(network),
        loss=nn.CrossEntropyLoss(),
        input_shape=images.shape[1:],
        nb_classes=len(network.classes),
        clip_values=(0.0, 1.0),
        device_type="gpu" if next(network.parameters()).is_cuda else "cpu",
    )
    size, quiet = {"batch_size": _BATCH}, {"verbose": False}
    attacks: dict[str, Callable[[], Any]] = {
        "FGSM, 4/255": lambda: evasion.FastGradientMethod(classifier, eps=_REACH, **size),
        "PGD, 4/255": lambda: evasion.ProjectedGradientDescent(
            classifier, eps=_REACH, eps_step=_STEP, max_iter=_STEPS, **size, **quiet
        ),
        "CW, 2-norm": lambda: evasion.CarliniL2Method(
            classifier, max_iter=_STEPS, binary_search_steps=3, max_halving=2, max_doubling=2, **size, **quiet
        ),
    }
    one_hot = np.eye(len(network.classes), dtype=np.float32)[labels]
    pictures = {}
    for name in PIXEL_ATTACKS:
        changed = attacks[name]().generate(x=images.astype(np.float32), y=one_hot)
        pictures[name] = (np.clip(changed, 0, 1) * 255).round().astype(np.uint8)
    return pictures
