"""The paper's protocol and its published results, which are comparable only to runs that follow it."""

from __future__ import annotations

from drivesem.attack.budgets import parse_budget
from drivesem.config.commands import AttackConfig

PAPER_DETECTOR = "squeezedet"
PROTOCOL = {
    "method": "si-fgsm",
    "steps": 10,
    "early_stop": False,
    "objective": "confidence",
    "objective_labels": "paper",
    "keep": "last",
    "project": "bounds",
    "parametrisation": "roi",
}
"""Settings of configs/paper.yaml, without the budget and the parameters."""
_DEFAULTS = ("passes", "rate", "momentum", "target_objects", "target_classes", "precision", "t_star")
"""Settings with default values in the protocol."""


def follows_paper(config: AttackConfig) -> bool:
    """Whether an attack uses the paper's method, settings and detector."""
    default = AttackConfig()
    expected = {**PROTOCOL, **{name: getattr(default, name) for name in _DEFAULTS}, "detector": PAPER_DETECTOR}
    if any(getattr(config, name) != value for name, value in expected.items()):
        return False
    return parse_budget(config.budget) == parse_budget("paper")


PAPER_BENIGN = 0.994
"""The paper's mAP of SqueezeDet before any change."""
PAPER_SINGLE = {
    "color": 0.995,
    "weather": 0.988,
    "foliage": 0.997,
    "translate": 0.992,
    "rotate": 0.982,
    "mesh": 0.987,
}
PAPER_COMBOS = {1: 0.82, 2: 0.659, 3: 0.808, 4: 0.987}
"""The paper's mAP after the attack, by parameter and by combination."""
PAPER_LPIPS, PAPER_FID = 0.52, 0.10
"""The paper's LPIPS and FID between attacked pictures and photographs; which pictures and networks is not stated."""
PAPER_TRANSFER = (0.9128, 0.875)
"""The paper's mAP of a YOLOv3, trained on KITTI: on benign frames, and on counterexamples against SqueezeDet."""
