"""Which parameters break a frame, and how few of them are enough: a search over subsets of theta's groups."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import torch
from torch import Tensor

from drivesem.attack.methods.base import Attack, Group, Problem, Proposals, Score, check_counts
from drivesem.attack.methods.si_fgsm import SiFGSM
from drivesem.attack.methods.trials import Trials

_HALVINGS = 4
"""Judged thetas for each subset of the fewest groups, to find how small it may be: to 1/16 of what it was."""


@dataclass(frozen=True, slots=True)
class Subsets(Attack):
    """Runs si-FGSM on all groups once, then looks for the smallest change that is still enough: fewest groups
    first, then the smallest size (`Problem.size`).

    A subset's change is that of the run, with all other groups as photographed: it shows which part of what was
    found is needed, not whether an attack of that subset alone would have found another. First groups are taken
    away one by one, the one that raised the loss least before the others (gradient times way, added up over the
    steps); then smaller subsets are tried, all of one size before the next, the most promising first; last, those
    of the fewest groups are scaled down by bisection.

    queries: gradients and judged thetas in all; where they do not suffice, the smallest that was found wins.
    steps: of si-FGSM; at most half of the queries. RangeError for fewer than 2 queries, or less than 1 step.
    """

    queries: int = 64
    steps: int = 10

    def __post_init__(self) -> None:
        check_counts(2, queries=self.queries)
        check_counts(steps=self.steps)

    def _rank(self, problem: Problem, theta: Tensor, score: Score) -> tuple[float, ...]:
        if not score.success:
            return (0.0, score.loss)
        return (1.0, -len(problem.moved(theta)), -float(problem.size(theta)))

    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        gradients: list[Tensor] = []

        def recorded(theta: Tensor) -> tuple[float, Tensor]:
            loss, gradient = problem.loss_and_grad(theta)
            gradients.append(gradient)
            return loss, gradient

        climb = self._climb()
        run = climb._propose(replace(problem, loss_and_grad=recorded), theta0, generator)
        failing = [theta for theta in run.thetas if problem.score(theta).success]
        if not failing:
            return run
        found = max(failing, key=lambda theta: climb._rank(problem, theta, problem.score(theta)))
        trials = Trials(problem, self.queries - run.queries)
        _Reduction(problem, found, raised(problem.groups, run.thetas, gradients), trials).reduce()
        return Proposals.joined((run, trials.proposals()))

    def _climb(self) -> Attack:
        return SiFGSM(min(self.steps, self.queries // 2))


def raised(groups: Iterable[Group], thetas: Sequence[Tensor], gradients: Sequence[Tensor]) -> dict[str, float]:
    """How much each group, by name, raised the loss on the way through K + 1 thetas (D,), to first order, by the K
    gradients (D,) at all but the last: gradient times way, added up.
    """
    ways = [after - before for before, after in pairwise(thetas)]
    gains = sum(
        (gradient * way for gradient, way in zip(gradients, ways, strict=True)), torch.zeros_like(thetas[0])
    )
    return {group.name: float(gains[group.where].sum()) for group in groups}


class _Reduction:
    """Subsets of the groups that `found` (D,) moves, by what each raised the loss."""

    def __init__(self, problem: Problem, found: Tensor, raised: dict[str, float], trials: Trials) -> None:
        self._found = found
        self._raised = raised
        self._trials = trials
        self._fails: dict[frozenset[str], bool] = {}
        self._groups = sorted(problem.moved(found), key=lambda group: -raised[group.name])

    def reduce(self) -> None:
        """Try what the queries allow."""
        kept = self._taken_away()
        for count in range(1, len(kept)):
            enough = self._enough(count)
            if enough:
                break
        else:
            # As few as were left by taking away; others of that number may be smaller.
            enough = self._enough(len(kept))
        for subset in enough:
            self._scaled_down(subset)

    def _taken_away(self) -> list[Group]:
        """Groups that are left when none can be spared, each taken away once, from the least."""
        kept = list(self._groups)
        for group in reversed(self._groups):
            rest = [other for other in kept if other is not group]
            if rest and self._fail(rest):
                kept = rest
        return kept

    def _enough(self, count: int) -> list[Sequence[Group]]:
        """Subsets of so many groups that fail, as far as the queries allow; the most promising first."""
        subsets = sorted(
            combinations(self._groups, count),
            key=lambda subset: -sum(self._raised[group.name] for group in subset),
        )
        return [subset for subset in subsets if self._fail(subset)]

    def _fail(self, subset: Sequence[Group]) -> bool:
        key = frozenset(group.name for group in subset)
        if len(key) == len(self._groups):
            return True
        if key not in self._fails and self._trials.left:
            self._fails[key] = self._trials.judge(self._alone(subset)).success
        return self._fails.get(key, False)

    def _alone(self, subset: Sequence[Group]) -> Tensor:
        """What was found (D,), the other groups as photographed."""
        theta = torch.zeros_like(self._found)
        for group in subset:
            theta[group.where] = self._found[group.where]
        return theta

    def _scaled_down(self, subset: Sequence[Group]) -> None:
        theta, low, high = self._alone(subset), 0.0, 1.0
        for _ in range(min(_HALVINGS, self._trials.left)):
            middle = (low + high) / 2
            if self._trials.judge(middle * theta).success:
                high = middle
            else:
                low = middle
