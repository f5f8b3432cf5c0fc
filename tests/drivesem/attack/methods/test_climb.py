"""The search on margins, on objects whose margins are known: budgets of passes, wide differences, noise, modes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import pytest
import torch
from torch import Tensor

from drivesem.attack.methods.base import ParameterGroup
from drivesem.attack.methods.climb import Climb
from drivesem.attack.methods.margin_search import LEAST_PASSES
from drivesem.config import commands
from scene_ir.errors import RangeError
from tests.drivesem.attack.methods.street import CARS, DIM, Street

PASSES = 90


@dataclass
class Recorded(Street):
    """With every theta that was asked for, in order."""

    seen: list[Tensor] = field(default_factory=list)

    def margins(self, theta: Tensor, number: int) -> Tensor:
        self.seen.append(theta)
        return super().margins(theta, number)

    def margins_and_grad(self, theta: Tensor, number: int, weights: Tensor) -> tuple[Tensor, Tensor]:
        self.seen.append(theta)
        return super().margins_and_grad(theta, number, weights)


def found(street: Street, climb: Climb | None = None, seed: int = 0) -> tuple[Tensor, int]:
    """Margins (CARS,) where the search ended, without ripples; passes it took."""
    result = (climb or Climb(PASSES))(street.problem(), torch.zeros(DIM), seed)
    return replace(street, ripple=0.0).known_margins(result.theta, 0), result.queries


@pytest.mark.parametrize("seed", range(5))
def test_each_car_is_brought_to_its_own_place(seed: int) -> None:
    margins, _ = found(Street(), seed=seed)
    assert (margins < 0).all(), margins


@pytest.mark.parametrize("seed", range(5))
def test_ripples_do_not_lead_astray(seed: int) -> None:
    """A gradient at a point is 40 times the slope here, of either sign."""
    margins, _ = found(Street(ripple=0.3), seed=seed)
    assert (margins < 0.3).sum() >= CARS - 1, margins


def test_differences_find_what_gradients_of_ripples_do_not() -> None:
    """The same search that trusts the gradient of places, on the same street."""
    street, trusting = Street(ripple=0.5), []
    for seed in range(8):
        result = Climb(PASSES)(street.problem(smooth_place=True), torch.zeros(DIM), seed)
        trusting.append(replace(street, ripple=0.0).known_margins(result.theta, 0))
    wide = [found(street, seed=seed)[0] for seed in range(8)]
    assert torch.cat(wide).mean() < torch.cat(trusting).mean()


@pytest.mark.parametrize("gradient", [True, False])
def test_it_ends_lower_than_anything_it_saw_while_looking_around(gradient: bool) -> None:
    """By a good part of a logit a car, mean over 5 seeds."""
    gained = []
    for seed in range(5):
        street = Recorded()
        result = Climb(PASSES, gradient)(street.problem(), torch.zeros(DIM), seed)
        around = min(float(street.known_margins(theta, 0).mean()) for theta in street.seen[: PASSES // 3])
        gained.append(around - float(street.known_margins(result.theta, 0).mean()))
    assert sum(gained) / len(gained) > 0.3, gained


def test_a_detector_without_a_gradient() -> None:
    street = Street(differentiable=False)
    street.margins_and_grad = None  # pyright: ignore[reportAttributeAccessIssue]
    margins, _ = found(street)
    assert (margins < 0).sum() >= CARS - 1, margins


@pytest.mark.parametrize("passes", [LEAST_PASSES, 41, 90, 200])
@pytest.mark.parametrize("gradient", [True, False])
def test_passes_are_kept_to_and_used(passes: int, gradient: bool) -> None:
    street = Street()
    _, spent = found(street, Climb(passes, gradient))
    assert spent == street.passes
    assert 0.8 * passes - 4 <= spent <= passes - 4


def test_objects_that_do_not_count_are_no_aim() -> None:
    """Infinite margins, as of objects that are hidden on the way, change nothing for others."""

    class Hidden(Street):
        def known_margins(self, theta: Tensor, number: int) -> Tensor:
            margins = super().known_margins(theta, number)
            return torch.where(torch.arange(CARS) == 1, torch.inf, margins)

    street = Hidden(counted_objects=torch.tensor([True, False, True, True]))
    result = Climb(PASSES)(street.problem(), torch.zeros(DIM), 0)
    assert bool(torch.isfinite(result.theta).all())
    assert (street.known_margins(result.theta, 0)[[0, 2, 3]] < 0).all()


def test_nothing_to_lose() -> None:
    street = Street(counted_objects=torch.zeros(CARS, dtype=torch.bool))
    result = Climb(PASSES)(street.problem(), torch.zeros(DIM), 0)
    assert street.passes == 0
    assert not bool(result.theta.any())


def test_modes_are_what_is_searched() -> None:
    """A group of many coordinates moves along its modes only, as far as the bounds go."""
    modes = torch.tensor([[1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]])
    street = Street()
    base = street.problem()
    groups = (ParameterGroup("bent", slice(0, 8), 2, modes), ParameterGroup("rest", slice(8, DIM)))
    result = Climb(PASSES)(replace(base, groups=groups), torch.zeros(DIM), 0)
    bent = result.theta[:8].reshape(2, 4)
    assert bool(bent.any())
    torch.testing.assert_close(bent[:, 0], bent[:, 1])
    torch.testing.assert_close(bent[:, 2], -bent[:, 3])


def test_the_least_of_passes_is_the_command_lines() -> None:
    """Written twice: options load no torch, and searches know no options."""
    assert commands.MIN_PASSES == LEAST_PASSES


def test_what_cannot_be() -> None:
    with pytest.raises(RangeError, match="passes"):
        Climb(LEAST_PASSES - 1)
    with pytest.raises(RangeError, match="views"):
        Climb()(replace(Street().problem(), margin_oracle=None), torch.zeros(DIM), 0)
