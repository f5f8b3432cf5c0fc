"""Shapley values: what each player of a game adds, on average over all orders in which they may come.

A game gives values (K,) of any coalition of its P players, several games at once where they share what is costly.
Contributions add up to the value of all players less that of none (efficiency), in the sampled form too: each
order's marginal gains do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray

from scene_ir.errors import RangeError

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Game = Callable[[Flags], Floats]
"""Members (P,) of a coalition to its values (K,)."""

MOST_EXACT = 6
"""Players up to which all coalitions are valued: 64 of them."""


@dataclass(frozen=True, slots=True)
class ShapleyShares:
    """contributions (P, K) of each player to each value. errors (P, K): their standard errors, where orders were
    drawn; None where all coalitions were valued, or only one pair of orders was.
    """

    contributions: Floats
    errors: Floats | None


def shapley(game: Game, players: int, permutations: int, generator: np.random.Generator) -> ShapleyShares:
    """Exact for at most MOST_EXACT players, else from so many orders. Raises RangeError as `sampled` does."""
    return exact(game, players) if players <= MOST_EXACT else sampled(game, players, permutations, generator)


def exact(game: Game, players: int) -> ShapleyShares:
    """From the values of all 2^P coalitions."""
    codes = np.arange(2**players)
    members = (codes[:, None] >> np.arange(players) & 1).astype(bool)
    values = np.stack([np.asarray(game(row), dtype=np.float64) for row in members])
    sizes = members.sum(axis=1)
    contributions = np.zeros((players, values.shape[1]))
    for player in range(players):
        without = codes[~members[:, player]]
        weight = np.array([1 / (players * comb(players - 1, int(size))) for size in sizes[without]])
        contributions[player] = weight @ (values[without | 1 << player] - values[without])
    return ShapleyShares(contributions, None)


def sampled(game: Game, players: int, permutations: int, generator: np.random.Generator) -> ShapleyShares:
    """From orders drawn at random, each walked forwards and backwards: `permutations` walks, an even number.

    An order and its reverse err to opposite sides where players stand in for one another, so that the mean of the
    two varies less (Mitchell et al. 2022). The standard error is that of the mean over such pairs, which are
    independent. Raises RangeError where there is no pair.
    """
    if permutations < 2 or permutations % 2:
        raise RangeError("permutations", "an even number, at least 2", permutations)
    pairs = np.stack([_pair(game, generator.permutation(players)) for _ in range(permutations // 2)])
    errors = None if len(pairs) == 1 else pairs.std(axis=0, ddof=1) / np.sqrt(len(pairs))
    return ShapleyShares(pairs.mean(axis=0), errors)


def _pair(game: Game, order: NDArray[np.int64]) -> Floats:
    """Marginal gains (P, K), the mean of an order's and its reverse's."""
    return (_walk(game, order) + _walk(game, order[::-1])) / 2


def _walk(game: Game, order: NDArray[np.int64]) -> Floats:
    """What each player (P, K) adds to those that came before it."""
    members = np.zeros(len(order), dtype=bool)
    values = [np.asarray(game(members.copy()), dtype=np.float64)]
    for player in order:
        members[player] = True
        values.append(np.asarray(game(members.copy()), dtype=np.float64))
    gains = np.zeros((len(order), len(values[0])))
    gains[order] = np.diff(np.stack(values), axis=0)
    return gains
