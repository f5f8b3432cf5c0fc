"""What every attack is: it proposes, and what came of it is decided elsewhere.

A subclass writes `_propose`; the final `__call__` projects each proposal, re-renders, re-scores and decides on
success. No attack marks its own homework.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Protocol, final

import torch
from torch import Tensor

from drivesem.attack.theta import ProjectedTheta
from scene_ir.errors import RangeError

GRADIENT_PASSES = 3
"""What a gradient counts, where a forward pass of the network counts 1."""
MAX_RESCORED = 5
"""Of the iterates that a gradient pass saw, so many of the most promising are rendered and judged."""
_TINY = 1e-30
"""Keeps a division defined where its result is not used."""


@dataclass(frozen=True, slots=True)
class Score:
    """What the network makes of one theta. loss: the attack's objective, to be raised. lost: what it got right in
    the benign re-render and gets wrong now, such as objects that are missed, or the picture's class; phantoms: new
    false positives, of which a classifier has none; success: any of the two, all under labels that move with
    objects. success_paper: the same under the benign labels. violations: what the render shows not to be feasible,
    such as `objects[3]: visibility`; nothing is a success then.
    """

    loss: float
    lost: int
    phantoms: int
    success: bool
    success_paper: bool
    violations: tuple[str, ...] = ()

    @property
    def failures(self) -> int:
        """How much is wrong that was right."""
        return self.lost + self.phantoms


def check_counts(least: int = 1, **counts: int | None) -> None:
    """RangeError where one of the settings, None left out, is less than `least`."""
    for name, value in counts.items():
        if value is not None and value < least:
            raise RangeError(name, f"at least {least}", value)


def check_rate(rate: float, name: str = "rate") -> None:
    """RangeError where it is not positive."""
    if not (math.isfinite(rate) and rate > 0):
        raise RangeError(name, "a positive number", rate)


def _unseen(theta: Tensor) -> Score | None:
    return None


@dataclass(frozen=True, slots=True)
class ParameterGroup:
    """A block of theta that belongs together: one parameter of the scene, or of all its cars. where: its
    coordinates; owners: how many objects it holds, one after the other, 0 for a parameter of the scene; modes:
    (K, M) directions in an object's M coordinates along which to look where there are too many of these, None for
    each coordinate by itself; smooth: whether a gradient at a point says what a step of the bounds' size does.
    """

    name: str
    where: slice
    owners: int = 0
    modes: Tensor | None = None
    smooth: bool = True


class MarginOracle(Protocol):
    """Margins of a scene's objects, in logits, in what a camera sees of it from time to time.

    number: of the view; the same number sees different thetas alike. passes: of the detector so far.
    differentiable: whether the detector has a gradient.
    """

    @property
    def differentiable(self) -> bool: ...

    @property
    def counted_objects(self) -> Tensor:
        """(N,) bool: objects that are found as photographed, and count."""
        ...

    @property
    def passes(self) -> int: ...

    def margins(self, theta: Tensor, number: int) -> Tensor:
        """(N,) at theta (D,): below 0 an object is lost; infinite where it does not count there. Costs a pass."""
        ...

    def margins_and_grad(self, theta: Tensor, number: int, weights: Tensor) -> tuple[Tensor, Tensor]:
        """The same, and the gradient (D,) of their sum weighed by weights (N,). Costs 3 passes."""
        ...


@dataclass(frozen=True, slots=True)
class Problem:
    """What an attack sees of scene and network, a detector or a classifier: callables of theta (D,), which is 0 as
    photographed.

    loss_and_grad: the objective to be raised, and its gradient (D,); for detectors that have one. project: onto
    the feasible set. score: re-render and judge, without a gradient; what was judged once is not rendered again.
    step (D,): the step alpha of each coordinate, 0 where it is held; lower, upper (D,): its bounds. groups: the
    blocks of theta, which cover it; by default it is one. preview: what the gradient pass at theta saw, roughly
    what `score` will say and without a cost; None where there was no such pass. keep_last: the last iterate is
    handed back, whatever it does. views: margins of objects, for searches that ask for more than the loss.
    """

    loss_and_grad: Callable[[Tensor], tuple[float, Tensor]]
    project: Callable[[Tensor], ProjectedTheta]
    score: Callable[[Tensor], Score]
    step: Tensor
    lower: Tensor
    upper: Tensor
    groups: tuple[ParameterGroup, ...] = (ParameterGroup("theta", slice(None)),)
    preview: Callable[[Tensor], Score | None] = _unseen
    keep_last: bool = False
    margin_oracle: MarginOracle | None = None

    def in_steps(self, theta: Tensor) -> Tensor:
        """theta (D,) in steps alpha; 0 where a coordinate is held. Differentiable."""
        return torch.where(self.step > 0, theta / self.step.clamp_min(_TINY), 0)

    def size(self, theta: Tensor, p: int = 2) -> Tensor:
        """How large a change is: the p-norm () of theta (D,) in sign steps; differentiable.

        Of each group the p-mean of its coordinates counts, in steps alpha: k sign steps of any group alone have
        size k, whether it has one coordinate or a thousand, and groups can be compared.
        """
        weight = torch.zeros_like(self.step)
        for group in self.groups:
            block = weight[group.where]
            block.fill_(max(len(block), 1) ** (-1 / p))
        return torch.linalg.vector_norm(weight * self.in_steps(theta), p)

    def box(self, theta0: Tensor, steps: int | None) -> tuple[Tensor, Tensor]:
        """Where a search may look: lower and upper (D,), so many steps around theta0, within the bounds; the whole
        bounds where `steps` is None.
        """
        if steps is None:
            return self.lower, self.upper
        reach = steps * self.step
        return torch.maximum(self.lower, theta0 - reach), torch.minimum(self.upper, theta0 + reach)


@dataclass(frozen=True, slots=True)
class Proposals:
    """What `_propose` hands over. thetas: the iterates in order; losses: one each, None where it was not computed;
    queries: gradients taken, and thetas judged by a search without gradient; active_constraints: what projections
    on the way held back, as often as they did.
    """

    thetas: tuple[Tensor, ...]
    losses: tuple[float | None, ...]
    queries: int
    active_constraints: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class AttackResult:
    """theta, theta0 (D,); loss_trace: the objective at each iterate, as far as the attack knew it, and at theta;
    score: of theta, from the final re-render; success_paper, success_moved: whether theta fails the detector under
    either label mode; queries: one gradient step counts as one, and so does one theta judged by a search without
    gradient (re-scoring is not counted); active_constraints: what held the attack back at any of its iterates,
    each named once.
    """

    theta: Tensor
    theta0: Tensor
    loss_trace: tuple[float, ...]
    score: Score
    success_paper: bool
    success_moved: bool
    queries: int
    seed: int
    active_constraints: tuple[str, ...]


class Attack(ABC):
    """A way of choosing theta. needs_gradient: whether it asks for `Problem.loss_and_grad`."""

    needs_gradient: ClassVar[bool] = True

    @abstractmethod
    def _propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        """Iterates from theta0 (D,), feasible or not; all randomness from `generator`."""

    def _rank(self, problem: Problem, theta: Tensor, score: Score) -> tuple[float, ...]:
        """What the winner among feasible, newly scored thetas (D,) has most of, the more important first. Here:
        failures under `moved` labels, then the loss.
        """
        return (score.failures, score.loss)

    @final
    def __call__(self, problem: Problem, theta0: Tensor, seed: int = 0) -> AttackResult:
        """Run from theta0 (D,). Of theta0 and the proposals, projected and scored anew, the one that ranks highest
        (`_rank`) wins; of equals the first. What its render shows not to be feasible ranks below all others.

        Scored are all that no gradient pass saw, and of the others the MAX_RESCORED that rank highest by what it
        saw: failures, and not the loss alone, which says only roughly what is lost. A score takes no gradient and
        counts as no query.
        """
        generator = torch.Generator(device="cpu").manual_seed(seed)
        proposals = self._propose(problem, theta0, generator)
        projected: list[ProjectedTheta] = []
        candidates = (theta0, *proposals.thetas)
        for candidate in candidates[-1:] if problem.keep_last else candidates:
            feasible = problem.project(candidate.detach())
            if not any(torch.equal(feasible.theta, other.theta) for other in projected):
                projected.append(feasible)
        projected = self._promising(problem, projected)
        scores = [problem.score(p.theta) for p in projected]
        ranks = [self._order(problem, p.theta, score) for p, score in zip(projected, scores, strict=True)]
        best = max(range(len(ranks)), key=lambda i: (*ranks[i], -i))
        violations = [name for score in scores for name in score.violations]
        score = scores[best]
        trace = [loss for loss in proposals.losses if loss is not None]
        return AttackResult(
            theta=projected[best].theta,
            theta0=theta0.detach(),
            loss_trace=(*trace, score.loss),
            score=score,
            success_paper=score.success_paper,
            success_moved=score.success,
            queries=proposals.queries,
            seed=seed,
            active_constraints=tuple(
                dict.fromkeys((*proposals.active_constraints, *projected[best].active, *violations))
            ),
        )

    def _order(self, problem: Problem, theta: Tensor, score: Score) -> tuple[float, ...]:
        return (float(not score.violations), *self._rank(problem, theta, score))

    def _promising(self, problem: Problem, projected: list[ProjectedTheta]) -> list[ProjectedTheta]:
        """What is worth a render, in its order; the first, where the attack began, always is."""
        seen: dict[int, tuple[float, ...]] = {}
        for i, candidate in enumerate(projected[1:], start=1):
            preview = problem.preview(candidate.theta)
            if preview is not None:
                seen[i] = self._order(problem, candidate.theta, preview)
        best = sorted(seen, key=lambda i: (seen[i], -i), reverse=True)[:MAX_RESCORED]
        return [candidate for i, candidate in enumerate(projected) if i not in seen or i in best]
