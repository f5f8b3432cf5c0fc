"""Shapley values of games whose values are known by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivesem.analysis.explain.attribution import (
    MOST_EXACT,
    exact_shapley_values,
    sampled_shapley_values,
    shapley_values,
)
from scene_ir.errors import RangeError


def glove(members):
    """One has a left glove, two have a right one each: a pair is worth 1. And beside it a game that adds up."""
    pair = members[0] and (members[1] or members[2])
    return np.array([pair, members @ np.array([1.0, 2.0, 4.0])])


class Table:
    """A game by a table of values (2^P, K); counts how often it is asked."""

    def __init__(self, values):
        self.values, self.evaluations = values, 0

    def __call__(self, members):
        self.evaluations += 1
        return self.values[int(members @ (1 << np.arange(len(members))))]


def random_table(players, seed, games=2):
    return Table(np.random.default_rng(seed).normal(size=(2**players, games)))


def test_gloves():
    shares = exact_shapley_values(glove, 3)
    np.testing.assert_allclose(shares.contributions[:, 0], [4 / 6, 1 / 6, 1 / 6])
    np.testing.assert_allclose(shares.contributions[:, 1], [1, 2, 4])
    assert shares.errors is None


@given(st.integers(1, 5), st.integers(0, 99))
def test_contributions_add_up_to_all_less_nothing(players, seed):
    table = random_table(players, seed)
    for shares in (
        exact_shapley_values(table, players),
        sampled_shapley_values(table, players, 4, np.random.default_rng(seed)),
    ):
        np.testing.assert_allclose(
            shares.contributions.sum(axis=0), table.values[-1] - table.values[0], atol=1e-12
        )


@given(st.integers(0, 99))
def test_a_player_without_effect_gets_nothing_and_equals_get_the_same(seed):
    effect = np.random.default_rng(seed).normal(size=3)

    def game(members):  # player 3 does nothing; 0 and 1 stand in for one another
        return np.array([effect[int(members[0]) + int(members[1])] * (2.0 if members[2] else 1.0)])

    values = exact_shapley_values(game, 4).contributions[:, 0]
    assert values[3] == pytest.approx(0, abs=1e-12)
    assert values[0] == pytest.approx(values[1], abs=1e-12)


def test_every_coalition_is_valued_once():
    table = random_table(4, 1)
    exact_shapley_values(table, 4)
    assert table.evaluations == 16


def test_drawn_orders_come_near_within_their_errors():
    table = random_table(7, 3)
    truth = exact_shapley_values(table, 7).contributions
    shares = sampled_shapley_values(table, 7, 400, np.random.default_rng(0))
    assert shares.errors is not None
    assert (np.abs(shares.contributions - truth) < 4 * shares.errors).all()
    assert (shares.errors > 0).all()
    wider = sampled_shapley_values(table, 7, 100, np.random.default_rng(0)).errors
    assert wider is not None
    assert wider.mean() == pytest.approx(2 * shares.errors.mean(), rel=0.3)


def test_a_game_that_adds_up_needs_no_luck():
    weights = np.array([1.0, -2.0, 0.5])
    shares = sampled_shapley_values(lambda members: np.array([members @ weights]), 3, 4, np.random.default_rng(5))
    np.testing.assert_allclose(shares.contributions[:, 0], weights)
    np.testing.assert_allclose(shares.errors, 0, atol=1e-12)


def test_an_order_and_its_reverse_cancel_for_pairs():
    """A game of interactions of two at most: every pair of walks has the value itself."""

    def game(members):
        return np.array([members[0] * members[1] + 2.0 * members[2] * members[0]])

    shares = sampled_shapley_values(game, 3, 2, np.random.default_rng(8))
    np.testing.assert_allclose(shares.contributions[:, 0], [1.5, 0.5, 1.0])
    assert shares.errors is None


def test_few_players_are_exact_and_many_are_drawn():
    few, many = random_table(MOST_EXACT, 0), random_table(MOST_EXACT + 1, 0)
    assert shapley_values(few, MOST_EXACT, 4, np.random.default_rng(0)).errors is None
    assert few.evaluations == 2**MOST_EXACT
    assert shapley_values(many, MOST_EXACT + 1, 4, np.random.default_rng(0)).errors is not None
    assert many.evaluations == 4 * (MOST_EXACT + 2)
    again = shapley_values(many, MOST_EXACT + 1, 4, np.random.default_rng(0)).contributions
    np.testing.assert_array_equal(
        again, shapley_values(many, MOST_EXACT + 1, 4, np.random.default_rng(0)).contributions
    )


@pytest.mark.parametrize("permutations", [0, 3])
def test_walks_come_in_pairs(permutations):
    with pytest.raises(RangeError, match="permutations: expected an even number"):
        sampled_shapley_values(glove, 3, permutations, np.random.default_rng(0))
