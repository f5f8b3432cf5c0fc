"""Samples of a box and CMA-ES on known losses."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from drivesem.attacks.methods.gradient_free import CMAES, QuerySearch, Sampling
from drivesem.attacks.theta import ProjectedTheta
from drivesem.config.commands import GRADIENT_FREE_METHODS
from tests.drivesem.attacks.methods.problems import Quadratic, make_problem, propose, score_of

STEP = torch.tensor([0.01, 0.02, 0.0, 0.05])
LOWER, UPPER = torch.tensor([-0.5, -0.5, -0.5, 0.0]), torch.tensor([0.5, 0.5, 0.5, 1.0])
START = torch.zeros(4)
GOAL = torch.tensor([0.3, -0.4, 0.1, 0.8])
SEARCHES = pytest.mark.parametrize(
    "attack", [Sampling(kind="random"), Sampling(kind="halton"), CMAES()], ids=GRADIENT_FREE_METHODS
)


def quadratic(scale: float = 1.0) -> Quadratic:
    """Feasible is a first coordinate of at most 0.4; something is lost near GOAL."""

    def project(theta: Tensor) -> ProjectedTheta:
        inside = torch.cat([theta[:1].clamp(max=0.4), theta[1:]])
        return ProjectedTheta(inside, ("0: limit",) if bool(inside[0] != theta[0]) else ())

    return Quadratic(
        GOAL, STEP, (LOWER, UPPER), project, lambda theta: (theta - GOAL).abs().max() < 0.3, scale=scale
    )


@SEARCHES
def test_all_queries_are_feasible_and_scored(attack: QuerySearch) -> None:
    world = quadratic()
    proposals = propose(attack, world.problem, seed=3)
    assert not attack.needs_gradient
    assert world.gradients == 0
    assert proposals.queries == len(world.scored) == len(proposals.thetas) == len(proposals.losses) == 64
    thetas = torch.stack(proposals.thetas)
    assert bool(((thetas >= LOWER) & (thetas <= UPPER + 1e-6)).all())
    assert float(thetas[:, 0].max()) <= 0.4 + 1e-6
    assert proposals.losses == pytest.approx([float(world.loss(theta)) for theta in thetas])
    assert set(proposals.active_constraints) == {"0: limit"}


@SEARCHES
def test_global_generators_are_unused(attack: QuerySearch) -> None:
    np.random.seed(5)  # noqa: NPY002
    before = np.random.get_state()[1].copy(), torch.random.get_rng_state()  # noqa: NPY002
    one, other = (attack(quadratic().problem, START, seed=seed) for seed in (7, 8))
    assert one.loss_trace != other.loss_trace
    assert np.array_equal(before[0], np.random.get_state()[1])  # noqa: NPY002
    assert torch.equal(before[1], torch.random.get_rng_state())


@pytest.mark.parametrize("kind", [Sampling, CMAES])
def test_steps_limit_the_distance_within_the_bounds(kind: type[QuerySearch]) -> None:
    world = quadratic()
    propose(kind(queries=32, steps=4), world.problem)
    thetas, reach = torch.stack(world.scored), 4 * STEP
    assert bool((thetas.abs() <= reach + 1e-6).all())
    assert float(thetas[:, 3].min()) >= 0  # a bound is nearer than the reach
    assert float((thetas[:, :2].abs() / reach[:2]).max()) > 0.5
    assert bool((thetas[:, 2] == 0).all())


@pytest.mark.parametrize("attack", [Sampling(kind="halton", early_stop=True), CMAES(early_stop=True)])
def test_early_stop_ends_at_the_first_success(attack: QuerySearch) -> None:
    world = quadratic()
    proposals = propose(attack, world.problem, seed=1)
    failed = [world.score(theta).success for theta in proposals.thetas]
    assert failed.index(True) == len(failed) - 1 < 63


def test_halton_fills_the_box_more_evenly_than_random_points() -> None:
    def emptiest(kind: str) -> int:
        world = quadratic()
        propose(Sampling(kind=kind, queries=64), world.problem)  # pyright: ignore
        cells = ((torch.stack(world.scored)[:, 1:] - LOWER[1:]) * 4).long()[:, [0, 2]]
        return int(torch.bincount(cells[:, 0] * 4 + cells[:, 1], minlength=16).min())

    assert emptiest("random") < emptiest("halton")


@pytest.mark.parametrize("queries", [1, 3, 17])
def test_any_number_of_queries_is_used(queries: int) -> None:
    for attack in (Sampling(queries, kind="halton"), CMAES(queries)):
        assert attack(quadratic().problem, START).queries == queries


def test_cma_es_learns_from_scores() -> None:
    samples, learned = (
        max(attack(quadratic().problem, START, seed=seed).loss_trace[-1] for seed in range(3))
        for attack in (Sampling(queries=128), CMAES(queries=128))
    )
    assert learned > samples
    assert learned > -0.01


def test_cma_es_continues_on_a_flat_loss(capsys: pytest.CaptureFixture[str]) -> None:
    assert CMAES(queries=80)(quadratic(scale=0.0).problem, START).queries == 80
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("slope", [0.0, 1e-6, 1.0])
def test_cma_es_spreads_in_a_single_coordinate(slope: float) -> None:
    """As wide as the library allows, on a loss that grows all the way or not at all."""
    problem = make_problem(torch.sum, (0.1,), 1.0, score=lambda theta: score_of(slope * float(theta.sum())))
    for seed in range(4):
        assert CMAES(queries=96)(problem, torch.zeros(1), seed=seed).queries == 96


@pytest.mark.parametrize("size", [1, 1000])
def test_cma_es_moves_one_coordinate_or_a_thousand(size: int) -> None:
    problem = make_problem(lambda theta: -((theta - 0.2) ** 2).mean(), torch.full((size,), 0.1), 1.0)
    result = CMAES(queries=24)(problem, torch.zeros(size))
    assert result.queries == 24
    assert result.score.loss >= -0.04
