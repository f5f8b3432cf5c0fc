"""Smallest part of a change theta that keeps a failure, and the Shapley values of its parts (parameters, objects).

A part's Shapley value is what it adds on average over all orders in which the parts may be applied. A game gives
values (K,) of any subset of its P players, several games at once if they share their cost. Contributions add up to
the value of all players minus that of none, in the sampled form too, as the gains along each order do.

The change theta is scaled by s from 1 to 0, and every point is projected onto the feasible set. Failing need not
be monotone in s, as objects are lost and found again. So scales are evaluated on a grid first, and the smallest
that fails is bisected against its neighbour, which does not. Failures between two neighbours are missed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import comb
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from drivesem.attacks.space import Parameter, ParameterSpace
from drivesem.run.results import Coordinate, Failure
from scene_ir.errors import RangeError

SCHEMA = 2
EXPLANATION = "explain.json"
"""File of a frame's explanation."""


@dataclass(frozen=True, slots=True)
class PartOutcome:
    """The detector's result at one theta, with moved labels."""

    loss: float
    """The attack's objective."""
    lost: int
    """Number of lost objects."""
    phantoms: int
    """Number of phantoms."""
    success: bool
    """Whether the detector fails."""
    held_back: bool
    """Whether the projection onto the feasible set changed theta."""
    occurs: tuple[bool, ...] = ()
    """Whether each explained failure of the frame occurs: of the same object, in the same kind."""


@dataclass(frozen=True, slots=True)
class Contribution:
    """Contribution of one part of the change: a parameter or an object."""

    kind: str
    """"parameter" or "object"."""
    name: str
    """Name of the part."""
    loss: float
    """Shapley value of the loss."""
    loss_error: float | None
    """Its standard error, if orders were sampled."""
    fails: tuple[float, ...]
    """Shapley value of each explained failure: whether it occurs (1) or not (0)."""
    fails_error: tuple[float, ...] | None
    """Their standard errors, if orders were sampled."""
    gradient: float | None
    """Sum of gradient at theta0 times theta; None without a gradient."""
    gradient_share: float | None
    """Share of the sum of |gradient times theta| over all parts; None without a gradient."""
    alone: PartOutcome
    """Result of this part only."""
    without: PartOutcome
    """Result of all other parts."""


@dataclass(frozen=True, slots=True)
class MinimalChange:
    """The smallest change found that keeps one failure: the same object in the same kind."""

    draws: int
    """Draws, of `of`, that show the failure after this change, by the rule of its certificate."""
    of: int
    """Draws evaluated: the first of the certificate's; 0 for a failure of no kind."""
    holds: bool
    """Whether enough draws show it for a certificate. The search requires it of failures from certain on, and of
    others only that they occur in the picture.
    """
    scan: tuple[bool, ...]
    """Whether the failure occurs in the picture at each scale of the whole change, 0 and 1 included."""
    sign_changes: int
    """Changes between failing and not failing along the grid."""
    scale_whole: float
    """Smallest scale of the whole change that keeps the failure, in [0, 1]."""
    scale: float
    """Smallest such scale after dropping parts, in [0, 1]."""
    dropped: tuple[str, ...]
    """Names of the dropped parts, in order."""
    norm_found: float
    """Size of the counterexample, steps."""
    norm_whole: float
    """Size of the whole change at `scale_whole`, steps."""
    norm: float
    """Size of the minimal change, steps."""
    outcome: PartOutcome
    """The detector's result at the minimal change."""
    violations: tuple[str, ...]
    """Violations found by the independent feasibility check."""
    sizes: tuple[ChangeSize, ...]
    """Size of each parameter of each object."""
    failures: tuple[Failure, ...]
    """Failures at the minimal change."""
    theta: tuple[Coordinate, ...]
    """Coordinates of the minimal change that are not 0."""

    @property
    def left(self) -> float:
        """Size relative to the counterexample's."""
        return self.norm / self.norm_found

    @property
    def is_whole(self) -> bool:
        """Whether no part and no smaller amount of the change keeps the failure."""
        return not self.dropped and self.scale == 1

    @property
    def parameters(self) -> tuple[str, ...]:
        """Parameters of the minimal change."""
        return tuple(dict.fromkeys(size.parameter for size in self.sizes))

    @property
    def objects(self) -> tuple[int, ...]:
        """Objects that the minimal change moves."""
        return tuple(sorted({size.object for size in self.sizes if size.object is not None}))


@dataclass(frozen=True, slots=True)
class PixelSensitivity:
    """Distribution of |d loss / d pixel| over one picture."""

    objects: tuple[float, ...]
    """Share on each object, in [0, 1]."""
    background: float
    """Share on the background, in [0, 1]."""


@dataclass(frozen=True, slots=True)
class FailureExplanation:
    """One graded failure of the run, and the smallest change that keeps it."""

    failure: Failure
    """The failure, as the run graded it."""
    least: MinimalChange | None
    """The minimal change; None with a `reason`."""
    reason: str = ""
    """Why there is none."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """Explanation of one counterexample."""

    identifier: str
    """The frame."""
    source: str
    """Digest of the run's result.json."""
    objects: int
    """Number of objects in the scene."""
    benign: PartOutcome
    """The detector's result at theta0."""
    found: PartOutcome
    """Its result at the counterexample."""
    contributions: tuple[Contribution, ...]
    """Contributions of parameters, then of objects."""
    exact: tuple[str, ...]
    """Kinds of parts with exact Shapley values."""
    sizes: tuple[ChangeSize, ...]
    """Size of each parameter of each object."""
    failures: tuple[FailureExplanation, ...]
    """Its failures, highest grade first."""
    sensitivity: dict[str, PixelSensitivity]
    """Pixel gradients of `benign` and `counterexample`; empty without a gradient."""
    renders: int
    """Number of thetas evaluated."""
    seconds: float
    """Run time; the only field that may differ between two calls."""

    def of_kind(self, kind: str) -> tuple[Contribution, ...]:
        """Return the contributions of one kind, `parameter` or `object`."""
        return tuple(c for c in self.contributions if c.kind == kind)


Kind = Literal["parameter", "object"]
SURROUNDINGS = "surroundings"
"""Name of the part that belongs to no object: weather and foliage."""


@dataclass(frozen=True, slots=True)
class ThetaPart:
    """A part of theta."""

    kind: Kind
    """"parameter" or "object"."""
    name: str
    """Such as `rotate` or `objects[2]`."""
    mask: Tensor
    """Its coordinates (D,) bool."""


@dataclass(frozen=True, slots=True)
class ObjectParameter:
    """One parameter of one object, or of the scene."""

    parameter: Parameter
    """The parameter."""
    object: int | None
    """Number of the object; None for the scene."""
    where: slice
    """Coordinates in theta."""

    @property
    def name(self) -> str:
        """Name such as `objects[2].rotate` or `weather`."""
        return str(self.parameter) if self.object is None else f"{object_name(self.object)}.{self.parameter}"


@dataclass(frozen=True, slots=True)
class ChangeSize:
    """Size of the change of one parameter of one object."""

    parameter: str
    """The parameter."""
    object: int | None
    """Number of the object; None for the scene."""
    value: float
    """translate: distance on the ground; mesh: largest displacement of a lattice point; others: largest value."""
    unit: str
    """Unit of `value`: m, deg or code."""
    steps: float
    """Largest change of a coordinate, in steps alpha."""

    @property
    def owner(self) -> str:
        """Name of the object part."""
        return SURROUNDINGS if self.object is None else object_name(self.object)


def object_name(index: int) -> str:
    """Return an object's name in theta."""
    return f"objects[{index}]"


def list_object_parameters(space: ParameterSpace) -> Iterator[ObjectParameter]:
    """Yield each parameter of each object, in the order of theta."""
    for parameter in space.params:
        where = space.blocks.get(parameter)
        assert where is not None
        spec = space.specs[parameter]
        if not spec.per_object:
            yield ObjectParameter(parameter, None, where)
            continue
        for i in range(space.count):
            start = where.start + i * spec.size
            yield ObjectParameter(parameter, i, slice(start, start + spec.size))


def split_by_parameter(space: ParameterSpace, theta: Tensor) -> list[ThetaPart]:
    """Split theta (D,) by parameter."""
    masks: dict[str, Tensor] = {}
    for cell in _changed_parameters(space, theta):
        masks.setdefault(str(cell.parameter), torch.zeros_like(theta, dtype=torch.bool))[cell.where] = True
    return [ThetaPart("parameter", name, mask) for name, mask in masks.items()]


def split_by_object(space: ParameterSpace, theta: Tensor) -> list[ThetaPart]:
    """Split theta (D,) by object, followed by the surroundings if they change."""
    masks: dict[str, Tensor] = {}
    for cell in sorted(
        _changed_parameters(space, theta), key=lambda cell: math.inf if cell.object is None else cell.object
    ):
        name = SURROUNDINGS if cell.object is None else object_name(cell.object)
        masks.setdefault(name, torch.zeros_like(theta, dtype=torch.bool))[cell.where] = True
    return [ThetaPart("object", name, mask) for name, mask in masks.items()]


def measure_change(space: ParameterSpace, theta: Tensor) -> list[ChangeSize]:
    """Measure the change theta (D,) of each parameter of each object that it moves."""
    return [_measure_parameter(space, theta, cell) for cell in _changed_parameters(space, theta)]


def _changed_parameters(space: ParameterSpace, theta: Tensor) -> list[ObjectParameter]:
    return [cell for cell in list_object_parameters(space) if bool(theta[cell.where].any())]


def _measure_parameter(space: ParameterSpace, theta: Tensor, cell: ObjectParameter) -> ChangeSize:
    indices = range(cell.where.start, cell.where.stop)
    values, units = [], set()
    for i, value in zip(indices, theta[cell.where].tolist(), strict=True):
        physical = space.physical(i, value)
        values.append(value if physical is None else physical[0])
        units.add("code" if physical is None else physical[1])
    (unit,) = units
    if cell.parameter is Parameter.TRANSLATE and space.parametrisation == "ground":
        value = math.hypot(*values)
    elif cell.parameter is Parameter.MESH:
        value = max(math.hypot(*values[k : k + 3]) for k in range(0, len(values), 3))
    else:
        value = max(map(abs, values))
    # a fixed coordinate has step 0, and stays at 0
    alpha = space.step[cell.where].clamp_min(torch.finfo(space.step.dtype).tiny)
    steps = float((theta[cell.where] / alpha).abs().max())
    return ChangeSize(str(cell.parameter), cell.object, value, unit, steps)


Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Game = Callable[[Flags], Floats]
"""Maps the members (P,) of a subset to its values (K,)."""

MOST_EXACT = 6
"""Largest number of players for which all subsets are evaluated: 64."""


@dataclass(frozen=True, slots=True)
class ShapleyValues:
    """Shapley values of P players in K games."""

    contributions: Floats
    """Contribution of each player to each value (P, K)."""
    errors: Floats | None
    """Standard errors (P, K); None for exact values, or a single pair of sampled orders."""


def shapley_values(game: Game, players: int, permutations: int, generator: np.random.Generator) -> ShapleyValues:
    """Compute Shapley values, exactly for at most MOST_EXACT players, otherwise from sampled orders.

    Args:
        game: The game.
        players: Number of players P.
        permutations: Number of sampled orders; an even number.
        generator: Draws the orders.
    """
    return (
        exact_shapley_values(game, players)
        if players <= MOST_EXACT
        else sampled_shapley_values(game, players, permutations, generator)
    )


def exact_shapley_values(game: Game, players: int) -> ShapleyValues:
    """Compute Shapley values from the values of all 2^P subsets."""
    codes = np.arange(2**players)
    members = (codes[:, None] >> np.arange(players) & 1).astype(bool)
    values = np.stack([np.asarray(game(row), dtype=np.float64) for row in members])
    sizes = members.sum(axis=1)
    contributions = np.zeros((players, values.shape[1]))
    for player in range(players):
        without = codes[~members[:, player]]
        weight = np.array([1 / (players * comb(players - 1, int(size))) for size in sizes[without]])
        contributions[player] = weight @ (values[without | 1 << player] - values[without])
    return ShapleyValues(contributions, None)


def sampled_shapley_values(
    game: Game, players: int, permutations: int, generator: np.random.Generator
) -> ShapleyValues:
    """Estimate Shapley values from random orders, each walked forwards and backwards.

    An order and its reverse err in opposite directions if players can replace each other, so their mean varies
    less (Mitchell et al. 2022). The standard error is that of the mean over these independent pairs.

    Args:
        game: The game.
        players: Number of players P.
        permutations: Number of walks; an even number.
        generator: Draws the orders.

    Raises:
        RangeError: `permutations` is odd or below 2.
    """
    if permutations < 2 or permutations % 2:
        raise RangeError("permutations", "an even number, at least 2", permutations)
    pairs = np.stack([_antithetic_gains(game, generator.permutation(players)) for _ in range(permutations // 2)])
    errors = None if len(pairs) == 1 else pairs.std(axis=0, ddof=1) / np.sqrt(len(pairs))
    return ShapleyValues(pairs.mean(axis=0), errors)


def _antithetic_gains(game: Game, order: NDArray[np.int64]) -> Floats:
    """Return the mean gains (P, K) of an order and its reverse."""
    return (_marginal_gains(game, order) + _marginal_gains(game, order[::-1])) / 2


def _marginal_gains(game: Game, order: NDArray[np.int64]) -> Floats:
    """Return what each player adds to those before it (P, K)."""
    members = np.zeros(len(order), dtype=bool)
    values = [np.asarray(game(members.copy()), dtype=np.float64)]
    for player in order:
        members[player] = True
        values.append(np.asarray(game(members.copy()), dtype=np.float64))
    gains = np.zeros((len(order), len(values[0])))
    gains[order] = np.diff(np.stack(values), axis=0)
    return gains


_HALVINGS = 5
"""Bisection steps between two neighbours of the grid; a grid of 16 points resolves a scale to 1/512."""
_ROUNDING = 1e-5
"""Relative rounding error of norms in float32."""


@dataclass(frozen=True, slots=True)
class ThetaBlock:
    """Coordinates that are dropped together."""

    name: str
    """Name of the block."""
    mask: Tensor
    """Its coordinates (D,) bool."""


@dataclass(frozen=True, slots=True)
class MinimalChangeSearch:
    """Functions of theta (D,) that define the search."""

    project: Callable[[Tensor], Tensor]
    """Projects onto the feasible set."""
    occurs: Callable[[Tensor], bool]
    """Whether the failure occurs in the picture of a feasible theta: necessary, and cheap."""
    fails: Callable[[Tensor], bool]
    """Whether the failure holds at a feasible theta."""
    size: Callable[[Tensor], float]
    """The norm to minimise."""
    points: int
    """Points of the grid of scales, without 0."""


@dataclass(frozen=True, slots=True)
class ShortenedChange:
    """Result of the search."""

    theta: Tensor
    """Smallest change found (D,), feasible and failing."""
    scale: float
    """Its scale relative to the remaining blocks, in [0, 1]."""
    scan: tuple[bool, ...]
    """Whether the failure occurs at each scale of the whole change, 0 and 1 included."""
    shortened: Tensor
    """The whole change (D,) after the first bisection."""
    shortened_scale: float
    """Its scale, in [0, 1]."""
    dropped: tuple[str, ...]
    """Names of the dropped blocks, in order."""

    @property
    def sign_changes(self) -> int:
        """Changes between failing and not failing along the grid; 1 if monotone."""
        return sum(a != b for a, b in zip(self.scan, self.scan[1:], strict=False))


def find_minimal_change(
    theta: Tensor, blocks: Sequence[ThetaBlock], search: MinimalChangeSearch
) -> ShortenedChange:
    """Find the smallest part of a change that fails.

    A block is dropped if the rest, at some scale, still fails and is no larger than before. This is repeated until
    no block can be dropped.

    Args:
        theta: The change (D,).
        blocks: Blocks to drop, in this order.
        search: Functions that define the search.

    Raises:
        RangeError: The change does not fail, or no change is needed.
    """
    scan = tuple(search.occurs(search.project(theta * (k / search.points))) for k in range(search.points + 1))
    if not scan[-1] or scan[0]:
        actual = "one that does not" if not scan[-1] else "a failure without any change"
        raise RangeError("theta", "a change that fails", actual)
    first = next(k for k, occurs in enumerate(scan) if occurs and _fails_at(theta, k / search.points, search))
    scale = _bisect(theta, (first - 1) / search.points, first / search.points, search)
    shortened, shortened_scale = search.project(theta * scale), scale
    direction, dropped = theta, []
    again = True
    while again:
        again = False
        for block in blocks:
            rest = torch.where(block.mask, torch.zeros_like(direction), direction)
            if torch.equal(rest, direction) or not bool(rest.any()):
                continue
            rest_scale = _failing_scale_within(rest, search.size(search.project(direction * scale)), search)
            if rest_scale is not None:
                direction, scale, again = rest, rest_scale, True
                dropped.append(block.name)
    if dropped:
        scale = _smallest_failing_scale(direction, scale, search)
    return ShortenedChange(
        search.project(direction * scale), scale, scan, shortened, shortened_scale, tuple(dropped)
    )


def _fails_at(direction: Tensor, scale: float, search: MinimalChangeSearch) -> bool:
    return search.fails(search.project(direction * scale))


def _failing_scale_within(direction: Tensor, max_size: float, search: MinimalChangeSearch) -> float | None:
    """Return the smallest failing scale on half the grid with a change not larger than `max_size`, or None."""
    limit = min(1.0, max_size / search.size(direction))
    points = max(search.points // 2, 1)
    for k in range(1, points + 1):
        scale = limit * k / points
        theta = search.project(direction * scale)
        # projected, a change may be longer than its scale implies: the feasible set need not be star-shaped
        if search.size(theta) <= max_size * (1 + _ROUNDING) and search.fails(theta):
            return scale
    return None


def _smallest_failing_scale(direction: Tensor, scale: float, search: MinimalChangeSearch) -> float:
    """Return the smallest failing scale up to `scale`, which fails, by grid and bisection."""
    for k in range(1, search.points):
        if _fails_at(direction, scale * k / search.points, search):
            return _bisect(direction, scale * (k - 1) / search.points, scale * k / search.points, search)
    return _bisect(direction, scale * (search.points - 1) / search.points, scale, search)


def _bisect(direction: Tensor, low: float, high: float, search: MinimalChangeSearch) -> float:
    """Bisect an interval of scales; its upper end fails, its lower end does not. Return its failing end."""
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        if _fails_at(direction, middle, search):
            high = middle
        else:
            low = middle
    return high
