"""The paper's own protocol. Beside a run that keeps to it stand the paper's figures, and beside no other."""

from __future__ import annotations

from drivesem.attack.budgets import budget_of
from drivesem.config.commands import Attack

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
    *("passes", "rate", "momentum", "restarts", "scouts"),
    *("target_objects", "target_classes", "precision", "t_star"),
)
"""Settings that the protocol leaves as they are."""


def follows_paper(config: Attack) -> bool:
    """Whether an attack is the paper's: its method and settings, against its detector."""
    default = Attack()
    theirs = {**PROTOCOL, **{name: getattr(default, name) for name in _AS_EVER}, "detector": THEIR_DETECTOR}
    if any(getattr(config, name) != value for name, value in theirs.items()):
        return False
    return budget_of(config.budget) == budget_of("paper")
