"""Attacks on pixels, for comparison: those of the Adversarial Robustness Toolbox, which is optional."""

from __future__ import annotations

import copy
import importlib.util
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from torch import nn

from drivesem.classify.networks.base import Classifier

NEEDS = "pip install 'drivesem[pixels]'"
_REACH, _STEP = 4 / 255, 1 / 255
"""How far a pixel's channel may go, of 1, and in which steps."""
_STEPS = 10
_AT_A_TIME = 16
ATTACKS = ("FGSM, 4/255", "PGD, 4/255", "CW, 2-norm")


def available() -> bool:
    """Whether the toolbox is installed."""
    return importlib.util.find_spec("art") is not None


def attacked(network: Classifier, images: np.ndarray, labels: np.ndarray) -> Mapping[str, np.ndarray]:
    """Pictures (N, 3, H, W) in [0, 1] after each of `ATTACKS`, on the 8-bit grid, as uint8. labels (N,)."""
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
    size, quiet = {"batch_size": _AT_A_TIME}, {"verbose": False}
    made: dict[str, Callable[[], Any]] = {
        "FGSM, 4/255": lambda: evasion.FastGradientMethod(classifier, eps=_REACH, **size),
        "PGD, 4/255": lambda: evasion.ProjectedGradientDescent(
            classifier, eps=_REACH, eps_step=_STEP, max_iter=_STEPS, **size, **quiet
        ),
        "CW, 2-norm": lambda: evasion.CarliniL2Method(
            classifier, max_iter=_STEPS, binary_search_steps=3, max_halving=2, max_doubling=2, **size, **quiet
        ),
    }
    truth = np.eye(len(network.classes), dtype=np.float32)[labels]
    found = {}
    for name in ATTACKS:
        changed = made[name]().generate(x=images.astype(np.float32), y=truth)
        found[name] = (np.clip(changed, 0, 1) * 255).round().astype(np.uint8)
    return found
