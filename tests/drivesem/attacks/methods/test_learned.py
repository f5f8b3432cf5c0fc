"""The search that learns: on cars that are lost in a small region, which earlier frames have met."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from drivesem.attacks.methods.gradient_ascent import SiFGSM
from drivesem.attacks.methods.learned import Knowledge, Learn, MarginModel
from drivesem.attacks.methods.margin_search import Climb, UnitBox
from tests.drivesem.attacks.methods.problems import CARS, DIM, LOST_AT, PAINT, POSITION, WEATHER, Street

START = torch.zeros(DIM)
RADIUS = 0.25


@dataclass
class BlindSpot(Street):
    """Cars are found safely, except within a radius of a position each, from which no slope leads there."""

    def known_margins(self, theta: Tensor, number: int) -> Tensor:
        distance = (theta[POSITION].reshape(CARS, 2) - LOST_AT).norm(dim=1)
        return torch.where(distance < RADIUS, -3.0, 3.0) + 0 * theta.sum()


def spot_rows(count: int = 2000) -> np.ndarray:
    """Rows of earlier frames, in which the same region was met now and then."""
    features = torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) * 3 - 1.5
    margins = torch.where(features[:, :2].norm(dim=1) < RADIUS, -3.0, 3.0)
    return torch.cat([features, margins[:, None]], 1).numpy()


def knowledge(
    rows: np.ndarray | None = None,
    scenes: list[list[float]] | None = None,
    failing: set[tuple[int, ...]] | None = None,
    paint: float = 0.0,
) -> Knowledge:
    """Objects that were lost in these scenes stood at 0, 0."""
    losses = [(torch.tensor(scene), torch.tensor([0.0, 0.0, paint])) for scene in scenes or []]
    model = None if rows is None else MarginModel(rows)
    return Knowledge(model, losses, frozenset(failing or ()))


def lost(method: Climb, seed: int) -> int:
    street = BlindSpot(differentiable=False)
    theta = method(street.problem(), START, seed).theta
    return int((street.known_margins(theta, 0) < 0).sum())


def test_what_earlier_frames_met_is_found_in_fewer_passes() -> None:
    seeds = range(6)
    blind = sum(lost(Climb(passes=30), seed) for seed in seeds)
    knowing = sum(lost(Learn(passes=30, knowledge=knowledge(spot_rows())), seed) for seed in seeds)
    assert knowing >= blind + 4


@pytest.mark.parametrize("known", [None, knowledge()])
def test_without_knowledge_and_gradient_it_climbs(known: Knowledge | None) -> None:
    street = Street(differentiable=False)
    theta = Learn(90, knowledge=known)(street.problem(), START, 0).theta
    assert int((street.known_margins(theta, 0) < 0).sum()) >= 3
    assert 70 < street.passes <= 86


def test_without_knowledge_it_follows_the_gradient_of_the_scene_as_si_fgsm() -> None:
    street = Street()
    problem = replace(street.problem(), loss_and_grad=lambda theta: (0.0, torch.sign(torch.arange(DIM) - 5.5)))
    one, other = (method.propose(problem, START, torch.Generator()).thetas for method in (Learn(40), SiFGSM(9)))
    assert torch.equal(torch.stack(one), torch.stack(other))


@dataclass
class Night(Street):
    """Cars with dark paint are lost in one weather only, wherever they stand."""

    darkest: float = -0.4

    def known_margins(self, theta: Tensor, number: int) -> Tensor:
        near = (theta[WEATHER] - torch.tensor([0.9, 0.15])).norm() < 0.05
        return torch.where(near & (theta[PAINT] < self.darkest), -3.0, 3.0) + 0 * theta.sum()


@pytest.mark.parametrize("differentiable", [False, True])
@pytest.mark.parametrize("rows", [None, spot_rows()])
def test_what_lost_objects_of_other_frames_is_tried_first(rows: np.ndarray | None, differentiable: bool) -> None:
    street = Night(differentiable=differentiable)
    known = knowledge(rows, [[0.9, 0.15]], paint=-0.5)
    theta = Learn(90, knowledge=known)(street.problem(), START, 0).theta
    assert int((street.known_margins(theta, 0) < 0).sum()) == CARS
    assert street.passes == 10, "two random points, four proposals, the best one in four further samples"


def test_losses_with_other_coordinates_are_of_no_use() -> None:
    box, known = UnitBox(Street().problem(), START), knowledge(None, [[0.9, 0.15]])
    other = (torch.zeros(2), torch.zeros(8))
    both = replace(known, losses=[*known.losses, other]).for_box(box)
    assert both is not None
    assert both.losses == list(known.losses)
    assert replace(known, losses=[other]).for_box(box) is None


@pytest.mark.parametrize("differentiable", [False, True])
def test_where_an_object_is_left_the_search_goes_on(differentiable: bool) -> None:
    street = Night(differentiable=differentiable, darkest=-2.0)
    gradients: list[Tensor] = []

    def loss_and_grad(theta: Tensor) -> tuple[float, Tensor]:
        gradients.append(theta)
        return 0.0, torch.zeros(DIM)

    problem = replace(street.problem(), loss_and_grad=loss_and_grad)
    Learn(90, knowledge=knowledge(None, [[0.9, 0.15]]))(problem, START, 0)
    if differentiable:
        assert len(gradients) == (90 - 4 - 10 - 5) // 2 // 3
        assert gradients[0][WEATHER].tolist() == pytest.approx([0.9, 0.15])
    else:
        assert 75 < street.passes <= 86


def test_a_cell_that_fails_already_counts_less() -> None:
    """Where two weathers lose all cars, the one in an unknown cell is chosen."""

    class Either(Street):
        def known_margins(self, theta: Tensor, number: int) -> Tensor:
            return torch.where(theta[WEATHER].sum() > 0, -3.0, 3.0).expand(CARS) + 0 * theta.sum()

    rows = spot_rows()
    rows[:, -1] = -3.0
    for cell, dark in (((0,), True), ((1,), False)):
        known = knowledge(rows, [[0.9, 0.15], [0.1, 0.15]], {cell})
        theta = Learn(40, knowledge=known)(Either().problem(), START, 0).theta
        assert bool(theta[WEATHER][0] > 0.5) is dark


def test_theta_of_another_frame_stays_within_the_bounds() -> None:
    box, theta = UnitBox(Street().problem(), START), torch.linspace(-0.9, 0.9, DIM)
    theta[WEATHER] = torch.tensor([0.25, 7.0])
    again = box.theta(box.point(theta))
    assert again[WEATHER].tolist() == [0.25, 1.0]
    assert torch.allclose(again[: WEATHER.start], theta[: WEATHER.start])


@pytest.mark.parametrize("passes", [24, 41])
def test_it_keeps_within_its_passes(passes: int) -> None:
    street = Street()
    Learn(passes, knowledge=knowledge(spot_rows()))(street.problem(), START, 0)
    assert 0 < street.passes <= passes


def test_objects_that_do_not_count_are_left_out_of_predictions() -> None:
    street = BlindSpot(counted_objects=torch.tensor([True, False, True, False]))
    Learn(30, knowledge=knowledge(spot_rows()))(street.problem(), START, 0)
    assert street.passes <= 30


@pytest.mark.parametrize("rows", [spot_rows(), 1 - spot_rows()])
def test_each_frame_has_two_random_states_however_long_its_search(rows: np.ndarray) -> None:
    street = BlindSpot(differentiable=False)
    Learn(60, knowledge=knowledge(rows))(street.problem(), START, 0)
    assert torch.equal(torch.stack(street.random), torch.stack(street.thetas[:2]))


def test_each_tree_predicts_within_the_range_of_margins() -> None:
    rows = spot_rows()
    rows[::7, -1] = -1e3
    predicted = MarginModel(rows).predict(torch.from_numpy(rows[:5, :-1]))
    assert predicted.shape[1:] == (5,)
    assert MarginModel(rows).predict(torch.empty(0, 3)).shape == (len(predicted), 0)
    assert len(predicted) > 10
    assert -4 <= float(predicted.min()) <= float(predicted.max()) <= 6


def test_a_fit_takes_a_limited_number_of_rows_and_repeats() -> None:
    rows = spot_rows(30_000)
    one, other = (MarginModel(rows).predict(torch.zeros(1, 3)) for _ in range(2))
    assert torch.equal(one, other)
    assert float(one.mean()) < -2
