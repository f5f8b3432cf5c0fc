"""The paper's figures for classifiers, to stand beside ours, and what is wrong with them."""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import Any

import yaml

NETWORKS = {"vgg16": "paper, VGG-16", "resnet50": "paper, ResNet-50"}
"""Networks of the paper, and how tables call them."""
REMARKS: dict[str, tuple[str, ...]] = {
    "degradation": (
        "The paper's ResNet-50 has a benign accuracy of 0.997 here and of 0.986 in its table of retraining.",
        "The paper's text on Random describes Halton's samples. Random is uniform here.",
    ),
    "worth": (
        "The paper has the same worth of benign pictures for both networks, though one misclassifies 1.4 % of "
        "them and the other 0.3 %; and for ResNet-50 a worth of 0.236 for sGD, below Random (small)'s 0.604, "
        "though more of sGD's are misclassified (0.612 against 0.749 are right).",
    ),
    "robustness": (
        "The paper's row of the benign ResNet-50 is VGG-16's, figure by figure: nothing can be said of what its "
        "retraining gained.",
    ),
    "hyperparameters": (
        "The paper found these by looking at pictures. For sCW it writes f in the targeted form and calls it "
        "untargeted; its construction has the 1-norm, its settings the 2-norm, which is used here.",
    ),
}
"""By table."""


@cache
def figures() -> dict[str, Any]:
    """The tables by name, as `paper.yaml` says."""
    return yaml.safe_load(resources.files("drivesem.classify").joinpath("paper.yaml").read_text(encoding="utf-8"))
