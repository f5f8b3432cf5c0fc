"""Splits a change theta into parts (parameters, objects) and computes their Shapley values.

A part's Shapley value is what it adds on average over all orders in which the parts may be applied. A game gives
values (K,) of any subset of its P players, several games at once if they share their cost. Contributions add up to
the value of all players minus that of none, in the sampled form too, as the gains along each order do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import comb
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from drivesem.attack.space import Parameter, ParameterSpace
from scene_ir.errors import RangeError

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
