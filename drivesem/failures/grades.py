"""Kinds of failure, grades, and the evidence for them, as plain dataclasses without torch."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

AGREEMENT_RULE = 3, 4
"""Samples, of either state, in which a second renderer or detector must agree, and of how many. The only rule by which
a failure is *confirmed*, *shared*, or survives.
"""


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
    """Samples, of `draws`, of the unchanged scene that are right."""
    after: int
    """Samples, of `draws`, that are wrong after the change."""
    draws: int
    """Samples of either state."""
    placebo: int | None = None
    """Samples, of `draws`, that are right after a random edit of the same size; None where it was not needed."""

    @property
    def agrees(self) -> bool:
        """Whether enough samples of every state agree with the failure."""
        right = self.before if self.placebo is None else min(self.before, self.placebo)
        return min(right, self.after) >= AGREEMENT_RULE[0]

    def describe(self, kind: str | None) -> str:
        """Describe the opinion on a failure of a kind: `generator agrees: found in 4/4 → 0/4`."""
        verb, counts_right = draw_verb(kind)
        if counts_right and not self.before:
            return f"{self.by} never {verb.removesuffix(' in')} it: 0/{self.draws} without the change"

        def share(right: int) -> str:
            return f"{right if counts_right else self.draws - right}/{self.draws}"

        verdict = "agrees" if self.agrees else "does not agree"
        text = f"{self.by} {verdict}: {verb} {share(self.before)} → {share(self.draws - self.after)}"
        return text if self.placebo is None else f"{text}; {share(self.placebo)} after a placebo"


def draw_verb(kind: str | None) -> tuple[str, bool]:
    """Return the verb that draws of a kind of failure are counted by, and whether it describes what is right."""
    if kind == Kind.BACKGROUND:
        return "there in", False
    return ("reported twice in", False) if kind == Kind.TWICE else ("found in", True)
