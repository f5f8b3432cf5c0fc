"""The words of grading: kinds of failure, grades, and what they rest on. Plain, for results and reports too."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

SECOND = 3, 4
"""Draws in which a second renderer or a second detector must say the same, of how many."""


class Kind(StrEnum):
    """missed: an object that nothing reports; class: reported as another class only; placed: its own class, framed
    badly (IoU from 0.1 to 0.5); twice: an object that is found is reported once more; background: a detection on
    nothing.
    """

    MISSED = "missed"
    CLASS = "class"
    PLACED = "placed"
    TWICE = "twice"
    BACKGROUND = "background"


class Grade(StrEnum):
    """How sure a failure is, in rising order; see `grading`."""

    THRESHOLD = "threshold"
    CERTAIN = "certain"
    CONFIRMED = "confirmed"
    SHARED = "shared"


@dataclass(frozen=True, slots=True)
class Count:
    """Draws of one fault. before: right before the change; after: wrong after it; each of how many that were made.
    margin_before, margin_after: in logits (`margin`), the mean of those draws; None where there is none.
    """

    before: int = 0
    before_draws: int = 0
    after: int = 0
    after_draws: int = 0
    margin_before: float | None = None
    margin_after: float | None = None


@dataclass(frozen=True, slots=True)
class Agreement:
    """What a second renderer or detector says of a fault. by: its name; before, after: of `draws` draws, right
    before the change and wrong after it.
    """

    by: str
    before: int
    after: int
    draws: int

    @property
    def agrees(self) -> bool:
        return min(self.before, self.after) >= SECOND[0]
