"""The last layer trained on, with half of the training set replaced by counterexamples, as in the paper."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from drivesem.classify.networks.base import Classifier
from drivesem.classify.networks.loading import load_classifier, ready, save_classifier
from drivesem.classify.training import fit_last
from drivesem.settings.commands import Classify

RETRAINED = "retrained"
"""Folder of the weights."""
EPOCHS = 20


def half(count: int, seed: int) -> list[int]:
    """Places of half of so many pictures, at random, in order."""
    order = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
    return sorted(order[: count // 2].tolist())


def retrained(
    network: Classifier, path: Path, features: Tensor, labels: Tensor, seed: int, device: str
) -> Classifier:
    """The network with its last layer trained on for 20 epochs, from what it is; kept in a file."""
    if not path.is_file():
        learner = copy.deepcopy(network)
        learner.last.requires_grad_(True)
        generator = torch.Generator().manual_seed(seed)
        config = Classify(what="train", epochs=EPOCHS, layers="last")
        truth = labels.to(device)
        known = {"train": features, "val": features}
        fit_last(learner, known, {"train": truth, "val": truth}, config, generator, onward=True)
        save_classifier(ready(learner, device), path, {"trained_on": str(len(labels))})
    return load_classifier(str(path), network.classes, device)


@torch.no_grad()
def right(network: Classifier, features: Tensor, labels: Sequence[int]) -> list[bool]:
    """Which pictures a network's last layer classifies rightly by their features (N, K)."""
    said = network.last(features).argmax(1).tolist()
    return [one == label for one, label in zip(said, labels, strict=True)]


@torch.no_grad()
def chances(network: Classifier, features: Tensor) -> Tensor:
    """Softmax (N, C) by features (N, K)."""
    return network.last(features).softmax(1).double().cpu()
