"""Gradient-free searches, which project and score thetas: random and Halton samples, CMA-ES; the placebo.

On a GPU, thetas are scored together (`Problem.score_ahead`). Batches are not faster on a CPU: renders take the same
time, and the detector's working set leaves the cache (measured: 97 ms for a single image, 123 ms for each in a batch
of eight).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from drivesem.attacks.methods.base import Attack, Problem, Proposals, QueryLog, Score, check_counts
from scene_ir.errors import ShapeError


@dataclass(frozen=True, slots=True)
class QuerySearch(Attack):
    """A search that scores `queries` thetas. Raises RangeError for fewer than 1 query or step."""

    queries: int = 64
    """Number of thetas."""
    steps: int | None = None
    """Maximum distance of thetas from theta0, in steps alpha; None: anywhere within the bounds."""
    early_stop: bool = False
    """End at the first theta that fails the network under `moved` labels."""

    needs_gradient: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_counts(queries=self.queries, steps=self.steps)


def _score_nearest(problem: Problem, thetas: Iterable[Tensor], log: QueryLog) -> list[float]:
    """Score the feasible thetas nearest to thetas (D,), as far as queries are left, and record them. Returns losses."""
    projected = [problem.project(theta) for theta in itertools.islice(thetas, log.left)]
    problem.score_ahead([one.theta for one in projected])
    losses: list[float] = []
    for one in projected:
        if log.left:
            score = problem.score(one.theta)
            log.add(one, score.loss, score.success)
            losses.append(score.loss)
    return losses


_BLOCK = 32
"""Thetas that are scored together where that is faster."""
_HALTON_LIMIT, _HALTON_BLOCK = 2048, 256
"""Maximum dimension of one Halton sequence, and of each of several beyond it: large bases need gigabytes."""


@dataclass(frozen=True, slots=True)
class Sampling(QuerySearch):
    """Random samples, independent of earlier scores."""

    kind: Literal["random", "halton"] = "random"
    """random: independent and uniform; halton: a low-discrepancy sequence, scrambled (Owen 2017, as in
    scipy.stats.qmc).
    """

    def propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        lower, upper = problem.box(theta0, self.steps)
        log = QueryLog(self.queries, self.early_stop)
        points = self._unit_points(len(theta0), generator).to(theta0)
        for block in points.split(1 if self.early_stop else _BLOCK):
            _score_nearest(problem, lower + block * (upper - lower), log)
        return log.proposals()

    def _unit_points(self, dimensions: int, generator: torch.Generator) -> Tensor:
        """Sample points (queries, dimensions) float64 in the unit box."""
        if self.kind == "random":
            return torch.rand(self.queries, dimensions, generator=generator, dtype=torch.float64)
        from scipy.stats import qmc  # imported on use: it takes a third of a second to load

        rng = np.random.default_rng(int(torch.randint(2**62, (), generator=generator)))
        block = dimensions if dimensions <= _HALTON_LIMIT else _HALTON_BLOCK
        sizes = [min(block, dimensions - first) for first in range(0, dimensions, block)]
        blocks = [qmc.Halton(size, scramble=True, rng=rng).random(self.queries) for size in sizes]
        return torch.from_numpy(np.concatenate(blocks, axis=1))


_SIGMA = 0.25
"""First standard deviation, as a share of the box; the library recommends a quarter of the search interval."""
_MIN_GENERATIONS = 4
"""Minimum number of generations, smaller ones for small query budgets: a single one is a random sample."""
_MIN_POPULATION = 4
"""Minimum population size, that of one dimension (Hansen 2016, arXiv:1604.00772, table 1)."""
_FULL_COVARIANCE = 64
"""Maximum dimension with a full covariance: its D (D + 1) / 2 numbers need many queries. Above, only the diagonal is
learned (Ros and Hansen 2008)."""
_MIN_DIMENSIONS = 2
"""Minimum dimension that the library can scale; a single coordinate gets an unused second one."""


@dataclass(frozen=True, slots=True)
class CMAES(QuerySearch):
    """CMA-ES from theta0, restarted on convergence. The library gets each sample with the loss of its projection."""

    def propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        lower, upper = problem.box(theta0, self.steps)
        size = upper - lower
        start = ((theta0 - lower) / size.clamp_min(torch.finfo(theta0.dtype).tiny)).detach().cpu().double().numpy()
        coordinates = len(start)
        start = np.pad(start, (0, max(_MIN_DIMENSIONS - coordinates, 0)), constant_values=0.5)
        rng = np.random.default_rng(int(torch.randint(2**62, (), generator=generator)))
        log = QueryLog(self.queries, self.early_stop)
        strategy = self._strategy(start, rng)
        while log.left:
            if strategy.stop():  # it has converged; the remaining queries search elsewhere
                strategy = self._strategy(rng.random(len(start)), rng)
            points = strategy.ask()
            block = torch.from_numpy(np.asarray(points)[:, :coordinates]).to(theta0)
            losses = _score_nearest(problem, lower + block * size, log)
            if len(losses) == len(points):
                strategy.tell(points, [-loss for loss in losses])
        return log.proposals()

    def _strategy(self, start: np.ndarray, rng: np.random.Generator) -> Any:
        import cma  # imported on use: it loads matplotlib's pyplot, which takes two seconds

        dimensions = len(start)
        default_size = 4 + int(3 * math.log(dimensions))
        options = {
            "bounds": [0.0, 1.0],
            "popsize": min(default_size, max(self.queries // _MIN_GENERATIONS, _MIN_POPULATION)),
            "CMA_diagonal": dimensions > _FULL_COVARIANCE,
            # Instead of numpy's global generator.
            "randn": lambda *shape: rng.standard_normal(shape),
            "seed": math.nan,
            "verbose": -9,
            "verb_log": 0,
        }
        return cma.CMAEvolutionStrategy(start, _SIGMA, options)


if TYPE_CHECKING:
    from drivesem.attacks.theta import ProjectedTheta

_MAX_DRAWS = 8
"""Maximum number of random edits; if all are infeasible, nothing is changed."""


@dataclass(frozen=True, slots=True)
class Placebo(Attack):
    """A control: the values of another change, shuffled within each group and with random signs. The edit is as
    large in every norm of every group, and does not depend on the detector.

    Signs that would leave the bounds are flipped. The edit is projected, which may shrink it; if its render is not
    feasible, another is drawn. Raises ShapeError where `like` belongs to another scene.
    """

    like: tuple[float, ...] = ()
    """theta (D,) of the other change."""

    needs_gradient: ClassVar[bool] = False

    def propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        if len(self.like) != len(theta0):
            raise ShapeError("like", f"({len(theta0)},)", (len(self.like),))
        like = torch.tensor(self.like, dtype=torch.float64).to(theta0) - theta0
        edit = self._random_edit(problem, theta0, like, generator)
        draws = 1
        while draws < _MAX_DRAWS and problem.score(edit.theta).violations:
            edit = self._random_edit(problem, theta0, like, generator)
            draws += 1
        return Proposals(thetas=(edit.theta,), losses=(None,), queries=draws, active_constraints=edit.active)

    def _random_edit(
        self, problem: Problem, theta0: Tensor, like: Tensor, generator: torch.Generator
    ) -> ProjectedTheta:
        change = like.clone()
        for group in problem.groups:
            block = change[group.where]
            change[group.where] = block[torch.randperm(len(block), generator=generator).to(block.device)]
        signs = 2 * torch.randint(2, change.shape, generator=generator).to(change) - 1
        change = signs * change.abs()
        outside = (theta0 + change < problem.lower) | (theta0 + change > problem.upper)
        return problem.project(theta0 + torch.where(outside, -change, change))

    def _rank(self, problem: Problem, theta: Tensor, score: Score) -> tuple[float, ...]:
        # The edit wins over theta0 regardless of its effect: choosing the better of the two would be an attack.
        return (float(bool((theta != 0).any())),)


@dataclass(frozen=True, slots=True)
class FixedTheta(Attack):
    """Proposes a given theta, which wins wherever it is feasible."""

    theta: Tensor
    """(D,)."""

    needs_gradient: ClassVar[bool] = False

    def propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        return Proposals((self.theta,), (None,), 0)

    def _rank(self, problem: Problem, theta: Tensor, score: Score) -> tuple[float, ...]:
        return (float(torch.equal(theta, self.theta)),)
