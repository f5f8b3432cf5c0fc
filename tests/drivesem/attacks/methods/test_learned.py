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


def spot_rows(count: int = 2000) -> np.ndarray:
    """Rows of earlier frames, in which the same region was met now and then."""
    features = torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) * 3 - 1.5
    margins = torch.where(features[:, :2].norm(dim=1) < RADIUS, -3.0, 3.0)
    return torch.cat([features, margins[:, None]], 1).numpy()


def lost(method: Climb, seed: int) -> int:
    street = BlindSpot()
    theta = method(street.problem(), START, seed).theta
    return int((street.known_margins(theta, 0) < 0).sum())


def test_what_earlier_frames_met_is_found_in_fewer_passes() -> None:
    seeds = range(6)
    blind = sum(lost(Climb(passes=30), seed) for seed in seeds)
    knowing = sum(lost(Learn(passes=30, model=MarginModel(spot_rows())), seed) for seed in seeds)
    assert knowing >= blind + 4


def test_without_a_model_it_is_climb() -> None:
    for seed in range(2):
        one, other = (method(Street().problem(), START, seed) for method in (Climb(40), Learn(40)))
        assert torch.equal(one.theta, other.theta)


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
    Learn(60, model=MarginModel(1 - spot_rows()))(other.problem(), START, 0)
    assert len(one.random) == len(other.random) == 6  # of 24 at the start, 12 of the model
    distances = [min(float((theta - start).norm()) for start in one.thetas[:12]) for theta in one.random]
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
