"""An attack that looks around before it climbs."""

import pytest
import torch

from drivesem.attack.methods.apgd import APGD
from drivesem.attack.methods.base import Problem, Score
from drivesem.attack.methods.scouted import Scouted
from drivesem.attack.methods.si_fgsm import SiFGSM
from drivesem.attack.theta import Projected
from scene_ir.errors import RangeError

STEP, LIMIT = torch.full((2,), 0.01), torch.ones(2)
START = torch.zeros(2)


class Hills:
    """A low hill at theta0 and, half the bounds away, a high one, on whose top the detector fails."""

    top = torch.tensor([0.5, 0.5])

    def loss(self, theta: torch.Tensor) -> torch.Tensor:
        low = torch.exp(-(theta.square().sum()) / 0.002)
        high = 4 * torch.exp(-((theta - self.top).square().sum()) / 0.1)
        return low + high

    def loss_and_grad(self, theta):
        leaf = theta.clone().requires_grad_(True)
        loss = self.loss(leaf)
        return float(loss.detach()), torch.autograd.grad(loss, leaf)[0]

    def score(self, theta):
        loss = float(self.loss(theta))
        return Score(loss, int(loss > 3.9), 0, loss > 3.9, False)

    @property
    def problem(self):
        def inside(theta):
            return Projected(theta.clamp(-LIMIT, LIMIT), ())

        return Problem(self.loss_and_grad, inside, self.score, STEP, -LIMIT, LIMIT)


def test_it_climbs_where_it_saw_most() -> None:
    near = SiFGSM(steps=10)(Hills().problem, START)
    assert not near.success_moved
    far = Scouted(SiFGSM(steps=30), 16)(Hills().problem, START)
    assert far.success_moved
    assert float((far.theta - Hills.top).abs().max()) < 0.1
    assert far.queries == 16 + 30


def test_where_nothing_is_better_it_begins_at_the_photograph() -> None:
    hills = Hills()
    hills.top = torch.tensor([9.0, 9.0])
    proposals = Scouted(APGD(steps=5), 8)._propose(hills.problem, START, torch.Generator().manual_seed(0))
    assert torch.equal(proposals.thetas[8], START)
    assert proposals.queries == 8 + 5


def test_it_does_not_begin_where_its_own_render_says_no(slope) -> None:
    world = slope(need=6.0, sight=8.0)  # far out the detector fails, and the car is out of sight
    attack = Scouted(SiFGSM(steps=3), 16)
    proposals = attack._propose(world.problem, torch.zeros(6), torch.Generator().manual_seed(0))
    assert any(world.problem.score(theta).violations for theta in proposals.thetas[:16])
    assert not world.problem.score(proposals.thetas[16]).violations


def test_it_stops_at_a_sample_that_fails() -> None:
    hills = Hills()
    hills.top = START + 0.05
    hills.score = lambda theta: Score(1.0, 1, 0, True, True)
    found = Scouted(SiFGSM(steps=30, early_stop=True), 16, early_stop=True)(hills.problem, START)
    assert (found.queries, found.success_moved) == (1, True)


def test_samples_may_lie_near() -> None:
    found = Scouted(SiFGSM(steps=1), 16, steps=3)._propose(Hills().problem, START, torch.Generator())
    assert float(torch.stack(found.thetas[:16]).abs().max()) <= 0.03 + 1e-6


@pytest.mark.parametrize(("settings", "named"), [({"count": 0}, "scouts"), ({"count": 1, "steps": 0}, "steps")])
def test_what_cannot_be_is_refused(settings, named) -> None:
    with pytest.raises(RangeError, match=named):
        Scouted(SiFGSM(), **settings)
