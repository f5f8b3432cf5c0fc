"""Margins of an embedded scene's cars in draws: who counts, draws that come again, passes, gradients."""

from __future__ import annotations

import pytest
import torch

from detectors.registry import load_detector
from drivesem.attack.aims import Aim
from drivesem.attack.objective import Objective
from drivesem.attack.space import ParameterSpace
from drivesem.synth.demo import demo_scene
from drivesem.truth.nuisances import Nuisances
from drivesem.truth.views import DrawnViews
from scene_ir.render.compositor import Compositor

SHOWN, NEAR = 2, 0.3


@pytest.fixture(scope="module")
def objective() -> Objective:
    scene = demo_scene(0, 0)
    space = ParameterSpace(scene, ("color", "weather"))
    return Objective(Compositor(scene), space, load_detector("squeezedet"))


@pytest.fixture(scope="module")
def views(objective: Objective) -> DrawnViews:
    return DrawnViews.of(objective, Nuisances(), "search:demo-000:0")


def test_found_objects_count(views: DrawnViews, objective: Objective) -> None:
    margins = views.margins(objective.space.theta0, 0)
    assert margins.shape == views.judged.shape
    assert bool(views.judged.any())
    assert bool(torch.isinf(margins[~views.judged]).all())
    # As photographed, a shift and a little noise lose none of those that are plainly found.
    still = DrawnViews.of(objective, Nuisances.of("off"), "any").margins(objective.space.theta0, 0)
    assert bool((still[views.judged] > 0).all())


def test_the_aim_leaves_others_out(objective: Objective, views: DrawnViews) -> None:
    first = int(views.judged.nonzero()[0])
    aimed = Objective(
        objective.compositor, objective.space, objective.detector, aim=Aim(objects=(first,), classes=None)
    )
    assert DrawnViews.of(aimed, Nuisances(), "any").judged.nonzero().flatten().tolist() == [first]


def test_a_number_is_one_draw(views: DrawnViews, objective: Objective) -> None:
    before = views.passes
    one, again, other = (views.margins(objective.space.theta0, number) for number in (3, 3, 4))
    assert torch.equal(one, again)
    assert not torch.equal(one, other)
    assert views.passes == before + 3
    # What was kept of a draw changes nothing.
    anew = DrawnViews.of(objective, Nuisances(), "search:demo-000:0")
    assert torch.equal(anew.margins(objective.space.theta0, 3), one)


def test_gradients_against_differences(objective: Objective) -> None:
    """Along a direction of paint and weather, without the steps that JPEG makes."""
    views = DrawnViews.of(objective, Nuisances.of("noise=0,jpeg=0"), "search")
    generator = torch.Generator().manual_seed(1)
    lower, upper = objective.space.lower, objective.space.upper
    theta = 0.25 * upper + 0.05 * lower
    before = views.passes
    _, gradient = views.margins_and_grad(theta, 0, torch.ones(len(views.judged)))
    assert views.passes == before + 3
    way = torch.randn(len(theta), generator=generator) * (upper > lower)
    way = way + 3 * gradient / gradient.norm() * way.norm()  # not at right angles to the slope
    reach = 2.5e-4 / way.abs().max()

    def total(at: torch.Tensor) -> float:
        margins = views.soft(at.requires_grad_(True), 0).detach().double()
        return float(margins[torch.isfinite(margins)].sum())

    slope = (total(theta + reach * way) - total(theta - reach * way)) / float(2 * reach)
    assert slope == pytest.approx(float(gradient @ way), rel=0.02)
