"""Attacks on a loss known in full: FGSM, samples of a box, CMA-ES."""

import numpy as np
import pytest
import torch

from drivesem.attack.methods.base import Problem, Score
from drivesem.attack.methods.fgsm import FGSM
from drivesem.attack.methods.gradient_free import CMAES, Sampling
from drivesem.attack.theta import ProjectedTheta
from drivesem.config.commands import GRADIENT_FREE_METHODS
from scene_ir.errors import RangeError

STEP = torch.tensor([0.01, 0.02, 0.0, 0.05])
LOWER, UPPER = torch.tensor([-0.5, -0.5, -0.5, 0.0]), torch.tensor([0.5, 0.5, 0.5, 1.0])
START = torch.zeros(4)
GOAL = torch.tensor([0.3, -0.4, 0.1, 0.8])
SEARCHES = [Sampling(kind="random"), Sampling(kind="halton"), CMAES()]


class World:
    """Loss -|theta - GOAL|^2; feasible is a first coordinate of at most 0.4; something is lost near
    GOAL.
    """

    def __init__(self, flat: bool = False) -> None:
        self.flat = flat
        self.scored: list[torch.Tensor] = []
        self.gradients = 0

    def loss(self, theta: torch.Tensor) -> torch.Tensor:
        return -((theta - GOAL) ** 2).sum() * (0 if self.flat else 1)

    def loss_and_grad(self, theta: torch.Tensor) -> tuple[float, torch.Tensor]:
        self.gradients += 1
        leaf = theta.clone().requires_grad_(True)
        return float(self.loss(leaf).detach()), torch.autograd.grad(self.loss(leaf), leaf)[0]

    def project(self, theta: torch.Tensor) -> ProjectedTheta:
        inside = theta.clone()
        inside[0] = inside[0].clamp(max=0.4)
        return ProjectedTheta(inside, ("0: too far",) if bool(inside[0] != theta[0]) else ())

    def score(self, theta: torch.Tensor) -> Score:
        self.scored.append(theta)
        lost = int((theta - GOAL).abs().max() < 0.3)
        return Score(float(self.loss(theta)), lost, 0, bool(lost), False)

    @property
    def problem(self) -> Problem:
        return Problem(self.loss_and_grad, self.project, self.score, STEP, LOWER, UPPER)


def test_fgsm_takes_one_gradient_and_goes_as_far_as_its_steps():
    world = World()
    result = FGSM(steps=5)(world.problem, START)
    assert result.theta.tolist() == pytest.approx([0.05, -0.10, 0.0, 0.25])
    assert result.queries == world.gradients == 1
    assert result.loss_trace == pytest.approx((float(world.loss(START)), float(world.loss(result.theta))))


@pytest.mark.parametrize("attack", SEARCHES, ids=GRADIENT_FREE_METHODS)
def test_searches_judge_as_many_feasible_thetas_as_they_may(attack):
    world = World()
    proposals = attack._propose(world.problem, START, torch.Generator().manual_seed(3))
    assert not attack.needs_gradient
    assert world.gradients == 0
    assert proposals.queries == len(world.scored) == len(proposals.thetas) == len(proposals.losses) == 64
    found = torch.stack(proposals.thetas)
    assert bool(((found >= LOWER) & (found <= UPPER + 1e-6)).all())
    assert float(found[:, 0].max()) <= 0.4 + 1e-6
    assert proposals.losses == pytest.approx([float(world.loss(theta)) for theta in found])
    assert set(proposals.active_constraints) == {"0: too far"}


@pytest.mark.parametrize("attack", SEARCHES, ids=GRADIENT_FREE_METHODS)
def test_the_seed_decides_and_the_global_generators_stay(attack):
    np.random.seed(5)  # noqa: NPY002
    before = np.random.get_state()[1].copy(), torch.random.get_rng_state()  # noqa: NPY002
    one, two, other = (attack(World().problem, START, seed=seed) for seed in (7, 7, 8))
    assert torch.equal(one.theta, two.theta)
    assert one.loss_trace == two.loss_trace
    assert one.loss_trace != other.loss_trace
    assert np.array_equal(before[0], np.random.get_state()[1])  # noqa: NPY002
    assert torch.equal(before[1], torch.random.get_rng_state())


@pytest.mark.parametrize("kind", [Sampling, CMAES])
def test_small_range_is_what_steps_reach_inside_the_bounds(kind):
    world = World()
    kind(queries=32, steps=4)._propose(world.problem, START, torch.Generator().manual_seed(0))
    found = torch.stack(world.scored)
    reach = 4 * STEP
    assert bool((found.abs() <= reach + 1e-6).all())
    assert float(found[:, 3].min()) >= 0  # a bound is nearer than the reach
    assert float((found[:, :2].abs() / reach[:2]).max()) > 0.5
    assert bool((found[:, 2] == 0).all())


@pytest.mark.parametrize("attack", [Sampling(kind="halton", early_stop=True), CMAES(early_stop=True)])
def test_early_stop_ends_at_the_first_success(attack):
    world = World()
    proposals = attack._propose(world.problem, START, torch.Generator().manual_seed(1))
    failed = [world.score(theta).success for theta in proposals.thetas]
    assert failed.index(True) == len(failed) - 1 < 63


def test_sequences_fill_the_box_more_evenly_than_chance():
    def emptiest(kind: str) -> int:
        places = Sampling(kind=kind, queries=64)._places(2, torch.Generator().manual_seed(0))
        cells = (places * 4).long()
        return int(torch.bincount(cells[:, 0] * 4 + cells[:, 1], minlength=16).min())

    assert emptiest("random") < emptiest("halton")


@pytest.mark.parametrize("queries", [1, 3, 17])
def test_any_number_of_queries_is_kept_to(queries):
    for attack in (Sampling(queries, kind="halton"), CMAES(queries)):
        assert attack(World().problem, START).queries == queries


def test_cma_es_learns_where_samples_do_not():
    best = {
        name: max(attack(World().problem, START, seed=s).loss_trace[-1] for s in range(3))
        for name, attack in (("samples", Sampling(queries=128)), ("cma-es", CMAES(queries=128)))
    }
    assert best["cma-es"] > best["samples"]
    assert best["cma-es"] > -0.01


def test_cma_es_goes_on_where_nothing_changes_the_loss(capsys):
    result = CMAES(queries=80)(World(flat=True).problem, START)
    assert result.queries == 80
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("slope", [0.0, 1e-6, 1.0])
def test_cma_es_spreads_one_coordinate_alone(slope):
    """As wide as the library lets it, where the loss grows all the way or not at all."""
    for seed in range(4):
        problem = Problem(
            lambda theta: (0.0, theta),
            lambda theta: ProjectedTheta(theta, ()),
            lambda theta: Score(slope * float(theta.sum()), 0, 0, False, False),
            torch.full((1,), 0.1),
            torch.full((1,), -1.0),
            torch.full((1,), 1.0),
        )
        assert CMAES(queries=96)(problem, torch.zeros(1), seed=seed).queries == 96


def test_cma_es_moves_one_coordinate_alone_and_a_thousand():
    for size in (1, 1000):
        goal = torch.full((size,), 0.2)
        problem = Problem(
            lambda theta: (0.0, theta),
            lambda theta: ProjectedTheta(theta, ()),
            lambda theta, goal=goal: Score(-float(((theta - goal) ** 2).mean()), 0, 0, False, False),
            torch.full((size,), 0.1),
            torch.full((size,), -1.0),
            torch.full((size,), 1.0),
        )
        result = CMAES(queries=24)(problem, torch.zeros(size))
        assert result.queries == 24
        assert result.score.loss >= -0.04


@pytest.mark.parametrize("make", [lambda: Sampling(queries=0), lambda: CMAES(queries=0)])
def test_queries_must_be_positive(make):
    with pytest.raises(RangeError, match="queries: expected at least 1, found 0"):
        make()


@pytest.mark.parametrize("make", [lambda: FGSM(0), lambda: Sampling(steps=0), lambda: CMAES(steps=0)])
def test_steps_of_searches_must_be_positive(make):
    with pytest.raises(RangeError, match="steps: expected at least 1, found 0"):
        make()
