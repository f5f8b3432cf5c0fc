"""Base class of attacks: a subclass proposes thetas; the base class projects, re-renders, scores and selects."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Protocol, final

import torch
from torch import Tensor

from drivesem.attacks.theta import ProjectedTheta
from scene_ir.errors import RangeError

GRADIENT_PASSES = 3
"""Cost of a gradient, in forward passes of the network."""
MAX_RESCORED = 5
"""Maximum number of iterates with a preview that are rendered and scored: the most promising ones."""
_PREVIEW_ERROR = 0.05
"""Share by which a score's loss may exceed its preview's, which is of a picture not rounded to 8 bits: of 165 iterates
of generated streets and photographs, two did by more, 0.051 and 0.052."""
_TINY = 1e-30
"""Keeps a division defined where its result is not used."""


@dataclass(frozen=True, slots=True)
class Score:
    """The network's failures at one theta, relative to the benign re-render."""

    loss: float
    """The attack's objective, to be raised."""
    lost: int
    """Objects (or the picture's class) that are missed now, under labels that move with objects."""
    phantoms: int
    """New false positives, under the same labels; 0 for classifiers."""
    success: bool
    """Whether anything fails and the render is feasible."""
    success_paper: bool
    """The same under the benign labels."""
    violations: tuple[str, ...] = ()
    """Constraints that the render violates, such as `objects[3]: visibility`."""

    @property
    def failures(self) -> int:
        """Number of failures."""
        return self.lost + self.phantoms


def check_counts(least: int = 1, **counts: int | None) -> None:
    """Raise RangeError for a count below `least`; None passes."""
    for name, value in counts.items():
        if value is not None and value < least:
            raise RangeError(name, f"at least {least}", value)


def check_rate(rate: float, name: str = "rate") -> None:
    """Raise RangeError for a rate that is not positive."""
    if not (math.isfinite(rate) and rate > 0):
        raise RangeError(name, "a positive number", rate)


def _score_later(thetas: Sequence[Tensor]) -> None:
    return None


def _no_preview(theta: Tensor) -> Score | None:
    return None


@dataclass(frozen=True, slots=True)
class ParameterGroup:
    """The block of theta that holds one parameter, of the scene or of all its objects."""

    name: str
    """Name of the parameter."""
    where: slice
    """Its coordinates in theta."""
    owners: int = 0
    """Number of objects, one block of coordinates each; 0 for a parameter of the scene."""
    modes: Tensor | None = None
    """(K, M), search directions in an object's M coordinates; None for each coordinate by itself."""
    smooth: bool = True
    """Whether a point gradient predicts the effect of a step as wide as the bounds."""


class MarginOracle(Protocol):
    """Margins of a scene's objects, in logits, in numbered nuisance samples: equal numbers give all thetas the same
    nuisances.
    """

    @property
    def differentiable(self) -> bool:
        """Whether the detector has a gradient."""
        ...

    @property
    def counted_objects(self) -> Tensor:
        """(N,) bool: objects that count, and are detected in the photograph."""
        ...

    @property
    def passes(self) -> int:
        """Detector passes so far."""
        ...

    def margins(self, thetas: Sequence[Tensor], numbers: Sequence[int], random: Collection[int] = ()) -> Tensor:
        """Margins (C, N) at thetas (D,), each in the sample of its number; inf for objects that do not count there.
        `random` has the places of thetas that no score influenced. Costs C passes.
        """
        ...

    def describe(self, theta: Tensor, number: int) -> tuple[Tensor, Tensor, Sequence[tuple[int, ...]]]:
        """Rows (K,), features (K, F) and cells of the map of the objects that count at theta (D,) in a sample. Costs
        no pass.
        """
        ...

    def margins_and_grad(self, theta: Tensor, number: int, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Margins and the gradient of their weighted sum. Costs GRADIENT_PASSES passes.

        Args:
            theta: (D,).
            number: of the sample.
            weights: (N,).

        Returns:
            Margins (N,), and the gradient (D,).
        """
        ...


@dataclass(frozen=True, slots=True)
class Problem:
    """A scene and a network (detector or classifier) as an attack sees them: functions of theta (D,), which is 0 for
    the photograph.
    """

    loss_and_grad: Callable[[Tensor], tuple[float, Tensor]]
    """The objective, to be raised, and its gradient (D,); for networks that have one."""
    project: Callable[[Tensor], ProjectedTheta]
    """Projection onto the feasible set."""
    score: Callable[[Tensor], Score]
    """Re-renders and scores, without a gradient; scores are cached."""
    step: Tensor
    """(D,), step alpha of each coordinate; 0 where it is fixed."""
    lower: Tensor
    """(D,), lower bounds."""
    upper: Tensor
    """(D,), upper bounds."""
    groups: tuple[ParameterGroup, ...] = (ParameterGroup("theta", slice(None)),)
    """The blocks of theta, which cover it."""
    advance: Callable[[Tensor, Tensor], Tensor] = torch.add
    """theta (D,) after a move (D,) from a theta; gradients are those of the loss in the move, at 0."""
    preview: Callable[[Tensor], Score | None] = _no_preview
    """Free estimate of `score` from the gradient pass at theta; None without such a pass."""
    score_ahead: Callable[[Sequence[Tensor]], None] = _score_later
    """Called with feasible thetas that `score` gets next; scores them together where that is faster."""
    keep_last: bool = False
    """Return the last iterate instead of the best one."""
    margin_oracle: MarginOracle | None = None
    """Margins of objects, for searches on margins."""

    def size(self, theta: Tensor, p: int = 2) -> Tensor:
        """Size of a change: the p-norm () of theta (D,) in sign steps; differentiable.

        Each group counts with the p-mean of its coordinates, in steps alpha: k sign steps of one group have size k,
        whether it has one coordinate or a thousand.
        """
        in_steps = torch.where(self.step > 0, theta / self.step.clamp_min(_TINY), 0)
        weight = torch.zeros_like(self.step)
        for group in self.groups:
            block = weight[group.where]
            block.fill_(max(len(block), 1) ** (-1 / p))
        return torch.linalg.vector_norm(weight * in_steps, p)

    def box(self, theta0: Tensor, steps: int | None) -> tuple[Tensor, Tensor]:
        """Lower and upper limits (D,) of a search: `steps` steps alpha around theta0 (D,), within the bounds; None:
        all of the bounds.
        """
        if steps is None:
            return self.lower, self.upper
        reach = steps * self.step
        return torch.maximum(self.lower, theta0 - reach), torch.minimum(self.upper, theta0 + reach)


@dataclass(frozen=True, slots=True)
class Proposals:
    """The iterates of an attack."""

    thetas: tuple[Tensor, ...]
    """(D,) each, in order."""
    losses: tuple[float | None, ...]
    """Loss of each; None where it was not computed."""
    queries: int
    """Gradients taken, or thetas scored by a gradient-free search."""
    active_constraints: tuple[str, ...] = ()
    """Constraints that changed iterates, repeated for each time."""


@dataclass(slots=True)
class QueryLog:
    """The thetas that a search with a query budget has tried."""

    queries: int
    """Maximum number of thetas."""
    early_stop: bool
    """End at the first failure."""
    _thetas: list[Tensor] = field(default_factory=list)
    """Thetas (D,) so far."""
    _losses: list[float | None] = field(default_factory=list)
    """Their losses."""
    _active: list[str] = field(default_factory=list)
    """Constraints that changed them."""
    _failed: bool = False
    """Whether the network failed at any of them."""

    @property
    def left(self) -> int:
        """Number of thetas that may still be tried."""
        return 0 if self.early_stop and self._failed else self.queries - len(self._thetas)

    def add(self, projected: ProjectedTheta, loss: float, failed: bool) -> None:
        """Record a theta.

        Args:
            projected: the theta.
            loss: its loss.
            failed: whether the network fails there.
        """
        self._thetas.append(projected.theta)
        self._losses.append(loss)
        self._active.extend(projected.active)
        self._failed |= failed

    def proposals(self) -> Proposals:
        """All recorded thetas, in order."""
        return Proposals(tuple(self._thetas), tuple(self._losses), len(self._thetas), tuple(self._active))


@dataclass(frozen=True, slots=True)
class AttackResult:
    """The outcome of an attack on one scene."""

    theta: Tensor
    """(D,), the selected theta."""
    theta0: Tensor
    """(D,), the start."""
    loss_trace: tuple[float, ...]
    """Loss at each iterate where it was computed, then at theta."""
    score: Score
    """Score of theta, from the final re-render."""
    success_paper: bool
    """Whether theta fails the network under the benign labels."""
    success_moved: bool
    """Whether theta fails the network under labels that move with objects."""
    queries: int
    """Gradients taken, or thetas scored by a gradient-free search; final scores do not count."""
    seed: int
    """Seed of the attack."""
    active_constraints: tuple[str, ...]
    """Constraints that changed any iterate, each once."""


class Attack(ABC):
    """An algorithm that proposes theta."""

    needs_gradient: ClassVar[bool] = True
    """Whether it uses `Problem.loss_and_grad`."""

    @abstractmethod
    def propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        """Iterates from theta0 (D,), feasible or not. All randomness comes from `generator`."""

    def _rank(self, problem: Problem, theta: Tensor, score: Score) -> tuple[float, ...]:
        """Rank of a feasible theta (D,), compared lexicographically; the largest wins. By default failures under
        `moved` labels, then the loss.
        """
        return (score.failures, score.loss)

    @final
    def __call__(self, problem: Problem, theta0: Tensor, seed: int = 0) -> AttackResult:
        """Run from theta0 (D,) and select the highest-ranked theta (`_rank`) of theta0 and the proposals.

        Proposals are projected and scored; ties go to the first, and infeasible renders rank below all others. Of
        proposals with a preview at most the MAX_RESCORED with the highest previewed rank are scored, as long as one
        may still win.

        Args:
            problem: the scene and network.
            theta0: (D,), the start.
            seed: of all randomness.
        """
        generator = torch.Generator(device="cpu").manual_seed(seed)
        proposals = self.propose(problem, theta0, generator)
        projected: list[ProjectedTheta] = []
        candidates = (theta0, *proposals.thetas)
        for candidate in candidates[-1:] if problem.keep_last else candidates:
            feasible = problem.project(candidate.detach())
            if not any(torch.equal(feasible.theta, other.theta) for other in projected):
                projected.append(feasible)
        scores = self._score_promising(problem, projected)
        ranks = {i: self._full_rank(problem, projected[i].theta, score) for i, score in scores.items()}
        best = max(ranks, key=lambda i: (*ranks[i], -i))
        violations = [name for _, score in sorted(scores.items()) for name in score.violations]
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

    def _full_rank(self, problem: Problem, theta: Tensor, score: Score) -> tuple[float, ...]:
        return (float(not score.violations), *self._rank(problem, theta, score))

    def _score_promising(self, problem: Problem, projected: list[ProjectedTheta]) -> dict[int, Score]:
        """Scores of the candidates that may win, by their place: those without a preview, which include theta0, then
        the others by their previewed rank, until none left can reach the best score.
        """
        previews: dict[int, tuple[float, ...]] = {}
        for i, candidate in enumerate(projected[1:], start=1):
            preview = problem.preview(candidate.theta)
            if preview is not None:
                previews[i] = self._full_rank(problem, candidate.theta, preview)
        scores = {i: problem.score(one.theta) for i, one in enumerate(projected) if i not in previews}
        best = max(self._full_rank(problem, projected[i].theta, score) for i, score in scores.items())
        for i in sorted(previews, key=lambda i: (previews[i], -i), reverse=True)[:MAX_RESCORED]:
            *failures, loss = previews[i]
            if (*failures, loss + _PREVIEW_ERROR * abs(loss)) < best:
                break
            scores[i] = problem.score(projected[i].theta)
            best = max(best, self._full_rank(problem, projected[i].theta, scores[i]))
        return scores
