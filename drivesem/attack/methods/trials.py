"""What searches without a gradient have in common: they try thetas one by one and see how each is judged.

One by one, because several at once are not faster on a CPU: renders take the same time, and the detector's working
set leaves the cache (measured: 97 ms for an image by itself, 123 ms in a batch of eight).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from torch import Tensor

from drivesem.attack.methods.base import Attack, Problem, Proposals, Score, check_counts


@dataclass(frozen=True, slots=True)
class Search(Attack):
    """An attack that projects and judges `queries` thetas; the detector's gradient is not asked for.

    steps: thetas lie within so many steps of theta0, or anywhere within the bounds where it is None. early_stop:
    end at the first that fails the detector under `moved` labels. RangeError for fewer than 1 query or step.
    """

    queries: int = 64
    steps: int | None = None
    early_stop: bool = False

    needs_gradient: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_counts(queries=self.queries, steps=self.steps)


@dataclass(slots=True)
class Trials:
    """At most `queries` thetas, projected and judged. early_stop: end at the first that fails the detector."""

    problem: Problem
    queries: int
    early_stop: bool = False
    _thetas: list[Tensor] = field(default_factory=list)
    _losses: list[float | None] = field(default_factory=list)
    _active: list[str] = field(default_factory=list)
    _failed: bool = False

    @property
    def left(self) -> int:
        """How many thetas may still be tried."""
        return 0 if self.early_stop and self._failed else self.queries - len(self._thetas)

    def judge(self, theta: Tensor) -> Score:
        """What comes of the feasible theta (D,) nearest to this one. Costs a query."""
        feasible = self.problem.project(theta)
        score = self.problem.score(feasible.theta)
        self._thetas.append(feasible.theta)
        self._losses.append(score.loss)
        self._active.extend(feasible.active)
        self._failed |= score.success
        return score

    def proposals(self) -> Proposals:
        """All that was tried, in order."""
        return Proposals(
            thetas=tuple(self._thetas),
            losses=tuple(self._losses),
            queries=len(self._thetas),
            active_constraints=tuple(self._active),
        )
