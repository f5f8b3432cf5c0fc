"""The search that learns: on cars that are lost in a small region, which earlier frames have met."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from drivesem.attacks.methods.learned import Learn, MarginModel
from drivesem.attacks.methods.margin_search import Climb
from tests.drivesem.attacks.methods.problems import CARS, DIM, LOST_AT, POSITION, Street

START = torch.zeros(DIM)
RADIUS = 0.25


@dataclass
class BlindSpot(Street):
    """Cars are found safely, except within a radius of a position each, from which no slope leads there."""

    def known_margins(self, theta: Tensor, number: int) -> Tensor:
        distance = (theta[POSITION].reshape(CARS, 2) - LOST_AT).norm(dim=1)
        return torch.where(distance < RADIUS, -3.0, 3.0) + 0 * theta.sum()


@dataclass
class Uniform(Street):
    """The margin is the same everywhere."""

    margin: float = 0.0

    def known_margins(self, theta: Tensor, number: int) -> Tensor:
        return self.margin + 0 * theta[:CARS]


def spot_rows(count: int = 2000) -> np.ndarray:
    """Rows of earlier frames, in which the same region was met now and then."""
    features = torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) * 3 - 1.5
    margins = torch.where(features[:, :2].norm(dim=1) < RADIUS, -3.0, 3.0)
    return torch.cat([features, margins[:, None]], 1).numpy()


def lost(method: Climb | Learn, seed: int) -> tuple[int, int]:
    street = BlindSpot()
    theta = method(street.problem(), START, seed).theta
    return int((street.known_margins(theta, 0) < 0).sum()), street.passes


def test_what_earlier_frames_met_is_found_in_fewer_passes() -> None:
    seeds = range(6)
    blind = np.sum([lost(Climb(passes=60), seed) for seed in seeds], 0)
    knowing = np.sum([lost(Learn(passes=60, model=MarginModel(spot_rows())), seed) for seed in seeds], 0)
    assert knowing[0] >= blind[0] + 4  # of 24 cars
    assert knowing[1] < blind[1]


def test_a_search_ends_early_where_cars_are_lost_or_beyond_hope() -> None:
    never = np.concatenate([spot_rows()[:, :-1], np.full((2000, 1), 5.0, np.float32)], 1)

    def passes(margin: float, rows: np.ndarray | None) -> int:
        street = Uniform(margin=margin)
        Learn(90, model=None if rows is None else MarginModel(rows))(street.problem(), START, 0)
        return street.passes

    assert passes(-3, None) == 20  # 16 points, and the best one in four nuisance samples
    assert passes(5, never) == 20  # no tree predicts that a car can be lost
    assert passes(5, None) > 70  # what no model has seen is searched in full
    assert passes(5, spot_rows()) > 70


@pytest.mark.parametrize("passes", [24, 41])
def test_it_keeps_within_its_passes(passes: int) -> None:
    street = Street()
    Learn(passes, model=MarginModel(spot_rows()))(street.problem(), START, 0)
    assert 0 < street.passes <= passes


def test_objects_that_do_not_count_are_left_out_of_predictions() -> None:
    street = BlindSpot(counted_objects=torch.tensor([True, False, True, False]))
    Learn(30, model=MarginModel(spot_rows()))(street.problem(), START, 0)
    assert street.passes <= 30


def test_points_that_the_model_proposes_are_not_random() -> None:
    one, other = BlindSpot(), BlindSpot()
    Learn(60, model=MarginModel(spot_rows()))(one.problem(), START, 0)
    Learn(60)(other.problem(), START, 0)
    assert len(one.random) == 4  # of 16 at the start, 8 of the model
    assert len(other.random) == 8
    distances = [min(float((theta - start).norm()) for start in one.thetas[:8:2]) for theta in one.random]
    assert min(distances) > 0


def test_each_tree_predicts_within_the_range_of_margins() -> None:
    rows = spot_rows()
    rows[::7, -1] = -1e3
    predicted = MarginModel(rows).predict(torch.from_numpy(rows[:5, :-1]))
    assert predicted.shape[1:] == (5,)
    assert len(predicted) > 10
    assert -4 <= float(predicted.min()) <= float(predicted.max()) <= 6


def test_a_fit_takes_a_limited_number_of_rows_and_repeats() -> None:
    rows = spot_rows(30_000)
    one, other = (MarginModel(rows).predict(torch.zeros(1, 3)) for _ in range(2))
    assert torch.equal(one, other)
    assert float(one.mean()) < -2
