"""The paper's own protocol. Beside a run that keeps to it stand the paper's figures, and beside no other."""

from __future__ import annotations

from drivesem.attack.budgets import parse_budget
from drivesem.config.commands import AttackConfig

THEIR_DETECTOR = "squeezedet"
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
"""Settings of configs/paper.yaml, but for the budget and for what moves."""
_AS_EVER = (
    *("passes", "rate", "momentum"),
    *("target_objects", "target_classes", "precision", "t_star"),
)
"""Settings that the protocol leaves as they are."""


def follows_paper(config: AttackConfig) -> bool:
    """Whether an attack is the paper's: its method and settings, against its detector."""
    default = AttackConfig()
    theirs = {**PROTOCOL, **{name: getattr(default, name) for name in _AS_EVER}, "detector": THEIR_DETECTOR}
    if any(getattr(config, name) != value for name, value in theirs.items()):
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
"""Of the paper's pictures and their photographs; of which of them, and by which network, it does not say."""
PAPER_TRANSFER = (0.9128, 0.875)
"""The paper's mAP of a YOLOv3, trained on KITTI: on benign frames, and on counterexamples against SqueezeDet."""
