"""Margins of an embedded scene's cars in draws: who counts, draws that come again, passes, gradients."""

from __future__ import annotations

import pytest
import torch

from detectors.incremental.reference import LIMIT_MB
from detectors.registry import load_detector
from drivesem.attacks.objective import Objective
from drivesem.attacks.space import ParameterSpace
from drivesem.config.commands import AttackConfig
from drivesem.failures.margin_oracle import NuisanceMarginOracle
from drivesem.failures.nuisances import Nuisances
from drivesem.synth.demo import demo_scene
from scene_ir.render.compositor import Compositor

VISIBLE, NEAR = 2, 0.3


@pytest.fixture(scope="module")
def objective() -> Objective:
    scene = demo_scene(0, 0)
    space = ParameterSpace(scene, ("color", "weather"))
    return Objective(Compositor(scene), space, load_detector("squeezedet"))


@pytest.fixture(scope="module")
def views(objective: Objective) -> NuisanceMarginOracle:
    return NuisanceMarginOracle.for_objective(objective, Nuisances(), "search:demo-000:0")


def test_found_objects_count(views: NuisanceMarginOracle, objective: Objective) -> None:
    (margins,) = views.margins([objective.space.theta0], [0])
    assert margins.shape == views.counted_objects.shape
    assert bool(views.counted_objects.any())
    assert bool(torch.isinf(margins[~views.counted_objects]).all())
    # As photographed, a shift and a little noise lose none of those that are plainly found.
    views_without = NuisanceMarginOracle.for_objective(objective, Nuisances.parse("off"), "any")
    (still,) = views_without.margins([objective.space.theta0], [0])
    assert bool((still[views.counted_objects] > 0).all())


def test_the_aim_leaves_others_out(objective: Objective, views: NuisanceMarginOracle) -> None:
    first = int(views.counted_objects.nonzero()[0])
    aimed = Objective(
        objective.compositor,
        objective.space,
        objective.detector,
        AttackConfig(target_objects=str(first)),
    )
    assert NuisanceMarginOracle.for_objective(
        aimed, Nuisances(), "any"
    ).counted_objects.nonzero().flatten().tolist() == [first]


def test_a_number_is_one_draw(views: NuisanceMarginOracle, objective: Objective) -> None:
    before = views.passes
    one, again, other = views.margins([objective.space.theta0] * 3, [3, 3, 4])
    assert torch.equal(one, again)
    assert not torch.equal(one, other)
    assert views.passes == before + 3
    # What was kept of a draw changes nothing.
    anew = NuisanceMarginOracle.for_objective(objective, Nuisances(), "search:demo-000:0")
    assert torch.equal(anew.margins([objective.space.theta0], [3])[0], one)


def test_objects_are_described_as_their_margins_are_recorded(
    views: NuisanceMarginOracle, objective: Objective
) -> None:
    theta = 0.5 * (objective.space.theta0 + objective.space.upper)
    (margins,) = views.margins([theta], [3])
    recorded = objective.search_log.margin_rows()
    before = views.passes
    rows, features, cells = views.describe(theta, 3)
    assert views.passes == before
    assert rows.tolist() == torch.isfinite(margins).nonzero()[:, 0].tolist()
    assert len(cells) == len(rows) > 0
    assert recorded[-len(rows) :, :-1] == pytest.approx(features.float().numpy(), abs=1e-6)


def random_states(objective: Objective) -> int:
    return max((visit.random for visit in objective.cell_visits(objective.benign)), default=0)


@pytest.mark.parametrize(("method", "expected"), [("random", 2), ("climb", 0)])
def test_states_that_no_score_influences_are_recorded_as_random(method: str, expected: int) -> None:
    scene = demo_scene(0, 0)
    space = ParameterSpace(scene, ("color",))
    objective = Objective(Compositor(scene), space, load_detector("squeezedet"), AttackConfig(method=method))
    for share in (0.0, 0.1, 0.2):  # the first is the photograph
        objective.score(share * space.upper)
    assert random_states(objective) == expected
    oracle = NuisanceMarginOracle.for_objective(objective, Nuisances.parse("off"), "any")
    oracle.margins([0.1 * space.upper, 0.2 * space.upper, 0.3 * space.upper], [0, 1, 2], random=range(1, 2))
    assert random_states(objective) == expected + 1


def test_gradients_against_differences(objective: Objective) -> None:
    """Along a direction of paint and weather, without the steps that JPEG makes."""
    views = NuisanceMarginOracle.for_objective(objective, Nuisances.parse("noise=0,jpeg=0"), "search")
    generator = torch.Generator().manual_seed(1)
    lower, upper = objective.space.lower, objective.space.upper
    theta = 0.25 * upper + 0.05 * lower
    before = views.passes
    _, gradient = views.margins_and_grad(theta, 0, torch.ones(len(views.counted_objects)))
    assert views.passes == before + 3
    way = torch.randn(len(theta), generator=generator) * (upper > lower)
    way = way + 3 * gradient / gradient.norm() * way.norm()  # not at right angles to the slope
    reach = 2.5e-4 / way.abs().max()

    def total(at: torch.Tensor) -> float:
        margins = views.soft_margins(at.requires_grad_(True), 0).detach().double()
        return float(margins[torch.isfinite(margins)].sum())

    slope = (total(theta + reach * way) - total(theta - reach * way)) / float(2 * reach)
    assert slope == pytest.approx(float(gradient @ way), rel=0.02)


def test_only_what_changes_is_seen_again(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, detector = demo_scene(0, 0), load_detector("squeezedet")
    space = ParameterSpace(scene, ("color", "translate"))
    of_regions, of_all = (
        Objective(Compositor(scene), space, detector, AttackConfig(whole=whole)) for whole in (False, True)
    )
    regional, whole = (NuisanceMarginOracle.for_objective(o, Nuisances(), "search") for o in (of_regions, of_all))
    generator = torch.Generator().manual_seed(0)
    places = [torch.rand(space.dim, generator=generator) * space.upper for _ in range(3)]
    for number in (0, 1):
        for place in (*places, places[-1]):
            torch.testing.assert_close(
                regional.margins([place], [number]), whole.margins([place], [number]), atol=1e-4, rtol=0
            )
    cached = [regional.cache_mb, whole.cache_mb]
    regional.clear_cache()
    cached.append(regional.cache_mb)
    assert cached[0] > 0
    assert cached[1:] == [0, 0]


def test_a_picture_seen_again_costs_less_than_a_whole_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, detector = demo_scene(0, 0), load_detector("squeezedet")
    space = ParameterSpace(scene, ("translate",))
    views = NuisanceMarginOracle.for_objective(
        Objective(Compositor(scene), space, detector), Nuisances(), "search"
    )
    views.margins([space.theta0], [0])

    def whole(*_: object) -> None:
        raise AssertionError("a whole pass")

    monkeypatch.setattr(type(detector), "forward", whole)
    views.margins([0.1 * space.upper], [0])
    with pytest.raises(AssertionError, match="a whole pass"):  # with a gradient
        views.margins_and_grad(space.theta0, 0, torch.ones(len(views.counted_objects)))


def test_weather_has_no_regions(objective: Objective) -> None:
    views = NuisanceMarginOracle.for_objective(objective, Nuisances(), "search")
    views.margins([0.5 * objective.space.upper], [0])
    cached = views.cache_mb
    assert cached == 0


def test_cached_layers_fit_the_limit() -> None:
    scene = demo_scene(0, 0)
    space = ParameterSpace(scene, ("translate",))
    objective = Objective(
        Compositor(scene), space, load_detector("squeezedet"), AttackConfig(keep_mb=LIMIT_MB + 1.0)
    )
    views = NuisanceMarginOracle.for_objective(objective, Nuisances(), "search")
    cached = []
    for number in range(2):
        views.margins([space.theta0], [number])
        cached.append(views.cache_mb)
    assert cached[0] == cached[1] > 0


def test_the_benign_picture_counts_and_one_picture_keeps_no_more_than_the_process() -> None:
    scene, detector = demo_scene(0, 0), load_detector("squeezedet")
    space = ParameterSpace(scene, ("translate",))
    whole = Objective(Compositor(scene), space, detector, AttackConfig(whole=True))
    tight = Objective(Compositor(scene), space, detector, AttackConfig(keep_mb=10.0))
    views = NuisanceMarginOracle.for_objective(tight, Nuisances(), "search")
    theta = 0.1 * space.upper
    loss, gradient = tight.loss_and_grad(theta)
    expected, slope = whole.loss_and_grad(theta)
    assert loss == pytest.approx(expected, abs=1e-4)
    torch.testing.assert_close(gradient, slope, atol=1e-3 * float(slope.abs().max()), rtol=1e-3)
    assert 0 < tight.reference_mb <= 10.0
    views.margins([space.theta0], [0])
    assert views.cache_mb == 0
    tight.release_layers()
    assert tight.reference_mb == 0
