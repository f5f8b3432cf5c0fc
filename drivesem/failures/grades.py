"""Kinds of failure, grades, and the evidence for them, as plain dataclasses without torch."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

AGREEMENT_RULE = 3, 4
"""Samples in which a second renderer or detector must agree, and of how many."""


class Kind(StrEnum):
    """Kinds of failure; see `kinds`."""

    MISSED = "missed"
    """No detection reports the object."""
    CLASS = "class"
    """It is reported only as another class."""
    PLACED = "placed"
    """It is reported with a bad box only (IoU from 0.1 to 0.5)."""
    TWICE = "twice"
    """It is detected and reported again."""
    BACKGROUND = "background"
    """A detection lies on nothing."""


class Grade(StrEnum):
    """How certain a failure is, in ascending order; see `grading`."""

    THRESHOLD = "threshold"
    CERTAIN = "certain"
    CONFIRMED = "confirmed"
    SHARED = "shared"


@dataclass(frozen=True, slots=True)
class Certificate:
    """How reliably one failure occurs in nuisance samples that the search never saw."""

    before: int = 0
    """Samples, of `before_draws`, that are right before the change."""
    before_draws: int = 0
    """Samples evaluated before the change."""
    after: int = 0
    """Samples, of `after_draws`, that are wrong after the change."""
    after_draws: int = 0
    """Samples evaluated after the change."""
    margin_before: float | None = None
    """Mean margin before the change, logits; None where there is none."""
    margin_after: float | None = None
    """Mean margin after the change, logits; None where there is none."""


@dataclass(frozen=True, slots=True)
class SecondOpinion:
    """How often a failure occurs with a second renderer or detector."""

    by: str
    """Name of the renderer or detector."""
    before: int
    """Samples, of `draws`, that are right before the change."""
    after: int
    """Samples, of `draws`, that are wrong after the change."""
    draws: int
    """Samples of either state."""

    @property
    def agrees(self) -> bool:
        """Whether enough samples of either state agree with the failure."""
        return min(self.before, self.after) >= AGREEMENT_RULE[0]
