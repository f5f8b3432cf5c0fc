"""Searches on margins, from the worst point of each object over nuisance samples: base class, unit box, corners.

Objects are nearly independent, so the worst points of all objects are combined into one.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from drivesem.attacks.methods.base import Attack, MarginOracle, Problem, Proposals, check_counts
from scene_ir.errors import RangeError

MIN_PASSES = 24
"""Minimum number of passes; with fewer, none are left to search with after the final comparison."""
MARGIN_CEILING = 4.0
"""Margin above which objects count as equally hard to lose."""
MARGIN_FLOOR = -2.0
"""Margin below which an object is certainly lost, and the others matter more."""
_FINAL_SAMPLES = 4
"""Number of nuisance samples in which the last candidates are compared."""
FINAL_PASSES = 3 * _FINAL_SAMPLES
"""Passes of the comparison of three candidates."""
_FIXED_PASSES = 4
"""Passes of the benign pictures and the final score."""
_SEARCH_SAMPLES = 8
"""Number of nuisance samples that the search uses in turn."""
_FINAL_NUMBERS = range(_SEARCH_SAMPLES, _SEARCH_SAMPLES + _FINAL_SAMPLES)
"""Numbers of the nuisance samples of comparisons."""
FIRST_HELD_OUT_SAMPLE = _SEARCH_SAMPLES + _FINAL_SAMPLES
"""Number of the first nuisance sample that no search uses."""


def margin_objective(margins: Tensor, counted: Tensor) -> float:
    """The value that a search lowers: about a step down for each lost object, plus a small share of the margins.

    margins: (N,); counted: (N,) bool, which objects count.
    """
    clamped = margins[counted.to(margins.device)].clamp(MARGIN_FLOOR, MARGIN_CEILING)
    return float(torch.tanh(2 * clamped).sum() + 0.1 * clamped.sum())


class UnitBox:
    """The unit box of a search: points u (K,) correspond to thetas (D,) within the bounds.

    A coordinate of u spans the bounds of one coordinate of theta or, in groups with modes, the amount of one mode.
    """

    def __init__(self, problem: Problem, theta0: Tensor) -> None:
        self._problem = problem
        blocks: list[Tensor] = []
        owners: list[Tensor] = []
        theta_owners: list[Tensor] = []
        rough: list[Tensor] = []
        start: list[Tensor] = []
        span = problem.upper - problem.lower
        for group in problem.groups:
            lower, width = problem.lower[group.where], span[group.where]
            size, count = len(width), max(group.owners, 1)
            if group.modes is None:
                block = torch.diag(width)
                group_start = (theta0[group.where] - lower) / width.clamp_min(1e-12)
            else:
                half = 0.5 * width.reshape(count, -1)
                block = torch.block_diag(*(2 * group.modes.to(half) * row for row in half))
                group_start = torch.full((len(block),), 0.5).to(block)
            rows = torch.zeros(len(block), len(theta0)).to(block)
            rows[:, group.where] = block
            blocks.append(rows)
            start.append(group_start)
            group_owners = (torch.arange(count) if group.owners else torch.tensor([-1])).to(block.device)
            owners.append(group_owners.repeat_interleave(len(block) // count))
            theta_owners.append(group_owners.repeat_interleave(size // count))
            rough.append(torch.full((len(block),), not group.smooth, device=block.device))
        self._matrix = torch.cat(blocks)
        self.start = torch.cat(start)
        """(K,), the point of theta0."""
        self._offset = theta0 - self.start @ self._matrix
        self.owner, self.theta_owner = torch.cat(owners), torch.cat(theta_owners)
        """(K,) and (D,), the object of each coordinate of u and of theta; -1 for the scene."""
        self.rough = torch.cat(rough)
        """(K,) bool: coordinates in which a point gradient does not predict wide steps."""

    def theta(self, point: Tensor) -> Tensor:
        """theta (D,) at u (K,), within the bounds; feasible or not."""
        theta = self._offset + point @ self._matrix
        return torch.minimum(torch.maximum(theta, self._problem.lower), self._problem.upper)

    def point(self, theta: Tensor) -> Tensor:
        """The point u (K,) of theta (D,) within the bounds; in groups with modes, of the part that they span."""
        return (self._matrix @ (theta - self._offset) / self._matrix.square().sum(1).clamp_min(1e-12)).clamp(0, 1)

    def slope(self, gradient: Tensor) -> Tensor:
        """The gradient (K,) with respect to u, from the gradient (D,) with respect to theta."""
        return self._matrix @ gradient


@dataclass
class MarginSearchState:
    """A search of the unit box within a pass budget."""

    problem: Problem
    """The scene and detector."""
    oracle: MarginOracle
    """Margins of the scene's objects."""
    box: UnitBox
    """The searched box."""
    generator: torch.Generator
    """Source of randomness."""
    limit: int
    """Maximum number of passes."""
    _active: list[str] = field(default_factory=list)
    """Constraints that were active so far."""
    _passes_before: int = field(init=False)
    """The oracle's passes before the search."""
    _sample: int = 0
    """Number of nuisance samples so far."""

    def __post_init__(self) -> None:
        self._passes_before = self.oracle.passes

    @property
    def passes_left(self) -> int:
        """Number of passes that may still be taken."""
        return self.limit - self.passes

    @property
    def passes(self) -> int:
        """Number of passes so far."""
        return self.oracle.passes - self._passes_before

    def theta(self, point: Tensor) -> tuple[Tensor, tuple[str, ...]]:
        """The feasible theta (D,) nearest to that of u (K,), and all constraints that were active so far."""
        projected = self.problem.project(self.box.theta(point))
        self._active.extend(projected.active)
        return projected.theta, tuple(dict.fromkeys(self._active))

    def next_sample(self) -> int:
        """Number of the next nuisance sample."""
        self._sample += 1
        return self._sample % _SEARCH_SAMPLES

    def margins(self, points: Sequence[Tensor], numbers: Sequence[int], random: Collection[int] = ()) -> Tensor:
        """Margins (C, N) of the objects at points u (K,), each in the nuisance sample of its number; see
        `MarginOracle`.
        """
        return self.oracle.margins([self.theta(point)[0] for point in points], numbers, random)

    def objective(self, margins: Tensor) -> float:
        """See `margin_objective`."""
        return margin_objective(margins, self.oracle.counted_objects)

    def candidates(self, points: Tensor, random: Collection[int] = ()) -> list[Tensor]:
        """The best of the points (C, K), and combinations of the best point of each object with the scene
        coordinates of the best and second-best point. Each point gets another nuisance sample; costs C passes.
        `random` has the places of points that no score influenced.
        """
        margins = self.margins(list(points), [self.next_sample() for _ in points], random)
        values = [self.objective(row) for row in margins]
        order = sorted(range(len(points)), key=values.__getitem__)
        return [points[order[0]], *(self.combine_objects(points, margins, row) for row in order[:2])]

    def loses_all(self, point: Tensor) -> bool:
        """Whether all objects that count are lost at u (K,) in each nuisance sample that the search has not used."""
        margins = self.margins([point] * _FINAL_SAMPLES, _FINAL_NUMBERS)
        return bool((margins[:, self.oracle.counted_objects.to(margins.device)] < 0).all())

    def select_best(self, points: list[Tensor]) -> Tensor:
        """The point with the lowest mean objective in nuisance samples that the search has not used."""
        numbers = _FINAL_NUMBERS[: self.passes_left // len(points)]
        states = [(self.theta(point)[0], number) for point in points for number in numbers]
        margins = self.oracle.margins([theta for theta, _ in states], [number for _, number in states])
        values = [sum(map(self.objective, rows)) for rows in margins.split(len(numbers))]
        return points[min(range(len(points)), key=values.__getitem__)]

    def combine_objects(self, points: Tensor, margins: Tensor, scene_row: int) -> Tensor:
        """The scene coordinates of one of the points (C, K), and each object's own from the point where its margin
        (C, N) was lowest.

        Where points differ in the scene too, margins are relative to the mean over objects at their point.
        """
        owner = self.box.owner
        clamped = margins.clamp(-MARGIN_CEILING, MARGIN_CEILING)
        if bool((owner < 0).any()) and clamped.shape[1] > 1:
            clamped = clamped - clamped.mean(dim=1, keepdim=True)
        lowest = clamped.argmin(dim=0)
        rows = torch.where(owner < 0, scene_row, lowest.to(owner.device)[owner.clamp_min(0)])
        return points.gather(0, rows[None].to(points.device))[0]


@dataclass(frozen=True, slots=True)
class MarginSearch(Attack):
    """A search on margins, which proposes one theta. Raises RangeError for fewer than MIN_PASSES passes, and for a
    problem without a margin oracle.
    """

    passes: int = 90
    """Detector passes in all; a gradient counts as GRADIENT_PASSES."""

    needs_gradient: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_counts(MIN_PASSES, passes=self.passes)

    @abstractmethod
    def _search(self, search: MarginSearchState) -> Tensor:
        """The proposed point u (K,). The final `MarginSearchState.select_best` takes FINAL_PASSES."""

    def propose(self, problem: Problem, theta0: Tensor, generator: torch.Generator) -> Proposals:
        oracle = problem.margin_oracle
        if oracle is None:
            raise RangeError("problem", "one with margins of its objects", "none")
        if not bool(oracle.counted_objects.any()):
            return Proposals((), (), 0)
        limit = self.passes - _FIXED_PASSES
        return self._propose_in(
            MarginSearchState(problem, oracle, UnitBox(problem, theta0), generator, limit), theta0
        )

    def _propose_in(self, search: MarginSearchState, theta0: Tensor) -> Proposals:
        """Iterates from theta0 (D,)."""
        theta, active = search.theta(self._search(search))
        return Proposals((theta,), (None,), search.passes, active)


@dataclass(frozen=True, slots=True)
class Corners(MarginSearch):
    """Evaluates corners of the bounds, each in another nuisance sample, and combines each object's worst corner."""

    def _search(self, search: MarginSearchState) -> Tensor:
        count = search.passes_left - FINAL_PASSES
        corners = balanced_corners(search.box.owner, count, search.generator)
        return search.select_best(search.candidates(corners.to(search.box.start)))


def balanced_corners(owner: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Corners of the unit box from rows of a Hadamard matrix; the first has all scene coordinates at 1.

    Over all rows any two coordinates of one owner take each of their four combinations equally often; over `count`
    random rows, nearly so.

    Args:
        owner: (K,), the object of each coordinate; -1 for the scene.
        count: number of corners.
        generator: selects the rows.

    Returns:
        (count, K) bool.
    """
    from scipy.linalg import hadamard

    owners = owner.unique().tolist()
    most = max(int((owner == one).sum()) for one in owners)
    size = 1 << max(count - 1, most).bit_length()
    matrix = torch.from_numpy(hadamard(size) > 0)
    ends = torch.empty(size, len(owner), dtype=torch.bool)
    for one in owners:
        own = (owner == one).cpu().nonzero()[:, 0]
        columns = 1 + torch.randperm(size - 1, generator=generator)[: len(own)]  # the first is constant
        flipped = torch.randint(2, (len(own),), generator=generator).bool() & (one >= 0)
        ends[:, own] = matrix[:, columns] ^ flipped
    rows = torch.cat([torch.zeros(1, dtype=torch.int64), 1 + torch.randperm(size - 1, generator=generator)])
    return ends[rows[:count]].to(owner.device)


START_SHARE = 0.4
"""Share of the passes that choose the start."""
_DIFFERENCE_REACH = 0.2
"""Half the width of differences, as a share of the bounds."""
_STEP = 0.15
"""First step, as a share of the bounds; the last is a fifth of it."""
_SMOOTHING = 0.05
"""Standard deviation of theta in gradients, as a share of the bounds."""
_DECAY = 0.5
"""Weight of earlier estimates in a moving average."""


@dataclass(frozen=True, slots=True)
class Climb(MarginSearch):
    """Samples the bounds, then descends on margins."""

    gradient: bool = True
    """Whether to use gradients where the detector has one."""

    def _search(self, search: MarginSearchState) -> Tensor:
        count = max(int(START_SHARE * self.passes), 1)
        return self._climb(search, sample_points(search, count), range(1, count, 2))

    def _climb(self, search: MarginSearchState, points: Tensor, random: Collection[int]) -> Tensor:
        """Descend from a start that points (C, K) give; random: the places of those that are uniform in the box."""
        start = _choose_start(search, points, random)
        return _Descent(search, self.gradient and search.oracle.differentiable).descend(start)


def _choose_start(search: MarginSearchState, points: Tensor, random: Collection[int]) -> Tensor:
    """The start u (K,): the best of the candidates that the points (C, K) give."""
    starts = search.candidates(points, random)
    number = search.next_sample()
    values = [search.objective(row) for row in search.margins(starts, [number] * len(starts))]
    return starts[min(range(len(starts)), key=values.__getitem__)]


def sample_points(search: MarginSearchState, count: int) -> Tensor:
    """Points (count, K): balanced corners and a scrambled Halton sequence alternately, which is uniform in the box."""
    from scipy.stats import qmc  # imported on use: it takes a third of a second to load

    box = search.box
    rng = np.random.default_rng(int(torch.randint(2**62, (), generator=search.generator)))
    points = torch.empty(count, len(box.owner), dtype=torch.float64)
    # A sequence of its own: every second point of a longer one would stay in one half of the first coordinate.
    points[1::2] = torch.from_numpy(qmc.Halton(len(box.owner), scramble=True, rng=rng).random(count // 2))
    points[::2] = balanced_corners(box.owner, (count + 1) // 2, search.generator)
    return points.to(box.start)


@dataclass(frozen=True, slots=True)
class _Descent:
    """The descent from a start, with or without gradients."""

    search: MarginSearchState
    gradient: bool

    def descend(self, point: Tensor) -> Tensor:
        """Descend from u (K,) until the passes are used up.

        Returns:
            Of the last point, the mean of the later ones, and the start: the best in held-out nuisance samples.
        """
        search, box = self.search, self.search.box
        start, rough = point, box.rough if self.gradient else torch.ones_like(box.rough)
        any_rough, any_smooth = bool(rough.any()), bool((~rough).any())
        cost = (3 if any_smooth else 0) + (2 if any_rough else 0)
        steps = max((search.passes_left - FINAL_PASSES) // cost, 0)
        slope = torch.zeros_like(point)
        track: list[Tensor] = []
        margins = torch.full((len(search.oracle.counted_objects),), MARGIN_CEILING, device=point.device)
        for step in range(steps):
            number, estimate = search.next_sample(), torch.zeros_like(point)
            if any_smooth:
                step_margins, gradient = self._estimate_gradient(point, number, _object_weights(margins))
                estimate = torch.where(rough, estimate, gradient)
                clamped = step_margins.clamp(-MARGIN_CEILING, MARGIN_CEILING)
                margins = _DECAY * margins + (1 - _DECAY) * clamped
            if any_rough:
                differences = self._estimate_differences(point, number, rough, margins)
                estimate = torch.where(rough, differences, estimate)
            slope = _DECAY * slope + (1 - _DECAY) * self._normalise_per_object(estimate)
            rate = _STEP * (1 - 0.8 * step / max(steps - 1, 1))
            point = (point - rate * slope.sign() * slope.abs().clamp_max(1)).clamp(0, 1)
            track.append(point)
        late = torch.stack(track[len(track) // 2 :]).mean(dim=0) if track else start
        return search.select_best([point, late, start])

    def _estimate_gradient(self, point: Tensor, number: int, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Margins (N,) and the gradient (K,) of their weighted sum near u (K,)."""
        noise = torch.randn(len(point), generator=self.search.generator).to(point)
        theta, _ = self.search.theta((point + _SMOOTHING * noise).clamp(0, 1))
        margins, gradient = self.search.oracle.margins_and_grad(theta, number, weights)
        return margins, self.search.box.slope(gradient)

    def _estimate_differences(self, point: Tensor, number: int, rough: Tensor, margins: Tensor) -> Tensor:
        """Slopes (K,) of each object's margin in its own coordinates, and of all margins in the scene's.

        One random step either way changes all rough coordinates at once: other objects' steps hardly matter to an
        object, and average out.
        """
        owner = self.search.box.owner
        signs = torch.randint(0, 2, (len(point),), generator=self.search.generator) * 2.0 - 1
        direction = signs.to(point) * rough.to(point)
        ahead, behind = ((point + sign * _DIFFERENCE_REACH * direction).clamp(0, 1) for sign in (1, -1))
        margins_ahead, margins_behind = self.search.margins([ahead, behind], [number, number]).clamp(
            -MARGIN_CEILING, MARGIN_CEILING
        )
        differences = (margins_ahead - margins_behind).to(point)
        weighted_sum = (differences * _object_weights(margins).to(differences)).sum()
        change = torch.where(owner < 0, weighted_sum, differences[owner.clamp_min(0)])
        distance = ahead - behind
        return torch.where(distance != 0, change / distance, 0)

    def _normalise_per_object(self, slope: Tensor) -> Tensor:
        """A slope (K,) divided by its largest value for each object, in rough and in smooth coordinates separately:
        all objects move at one pace.
        """
        box, normalised = self.search.box, torch.zeros_like(slope)
        for owner in box.owner.unique():
            for rough in (False, True):
                where = (box.owner == owner) & (box.rough == rough)
                if bool(where.any()):
                    normalised[where] = slope[where] / slope[where].abs().max().clamp_min(1e-9)
        return normalised


def _object_weights(margins: Tensor) -> Tensor:
    """Weights (N,) of objects in shared coordinates: largest for nearly lost ones, near 0 for certainly lost ones."""
    finite = margins.nan_to_num(MARGIN_CEILING, MARGIN_CEILING, -MARGIN_CEILING)
    return torch.sigmoid(2 * (finite - MARGIN_FLOOR)) * torch.exp(-finite.clamp_min(0) / 2)
