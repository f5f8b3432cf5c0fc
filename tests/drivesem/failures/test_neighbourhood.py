"""States around a counterexample: what moves and what does not, how far, and what is told of each."""

from __future__ import annotations

import pytest
import torch

from detectors.registry import load_detector
from drivesem.attacks.objective import Objective
from drivesem.attacks.space import Budget, ParameterSpace
from drivesem.failures.neighbourhood import Neighbourhood, SceneSampler
from drivesem.failures.nuisances import Nuisances
from drivesem.synth.demo import demo_scene
from scene_ir.render.compositor import Compositor

CAR = 3


@pytest.fixture(scope="module")
def objective() -> Objective:
    scene = demo_scene(0, 0)
    space = ParameterSpace(scene, ("color", "weather", "translate", "size"), Budget(size=0.1))
    return Objective(Compositor(scene), space, load_detector("squeezedet"))


@pytest.fixture(scope="module")
def theta(objective: Objective) -> torch.Tensor:
    space = objective.space
    return objective.feasible_set().project(0.1 * space.upper).theta


def around(objective: Objective, theta: torch.Tensor, reach: float = 1.0, name: str = "a") -> Neighbourhood:
    return Neighbourhood(objective, objective.feasible_set(), theta, CAR, Nuisances.parse("off"), name, reach)


def own(objective: Objective) -> torch.Tensor:
    names = [objective.space.name(i) for i in range(objective.space.dim)]
    return torch.tensor([n.startswith(f"objects[{CAR}]") or not n.startswith("objects") for n in names])


def test_only_the_object_and_what_is_shared_move(objective: Objective, theta: torch.Tensor) -> None:
    near = around(objective, theta)
    mine = own(objective)
    for number in range(4):
        state = near.theta(number)
        # A neighbour may have to make a little room.
        torch.testing.assert_close(state[~mine], theta[~mine], atol=0.01, rtol=0)
        assert bool((state[mine] != theta[mine]).any())
        assert bool((state >= objective.space.lower - 1e-6).all() & (state <= objective.space.upper + 1e-6).all())


def test_states_stay_within_reach(objective: Objective, theta: torch.Tensor) -> None:
    span = objective.space.upper - objective.space.lower
    far, near = ([around(objective, theta, reach).theta(n) for n in range(4)] for reach in (1.0, 0.1))
    assert all(bool(((state - theta).abs() <= 0.1 * span + 0.01).all()) for state in near)
    assert any(bool(((state - theta).abs() > 0.1 * span).any()) for state in far)
    close = [around(objective, theta).theta(n, part=0.1) for n in range(4)]
    assert all(bool(((state - theta).abs() <= 0.1 * span + 0.01).all()) for state in close)


def test_states_follow_from_the_name(objective: Objective, theta: torch.Tensor) -> None:
    one, again, other = (around(objective, theta, name=name) for name in "aab")
    assert torch.equal(one.theta(2), again.theta(2))
    assert not torch.equal(one.theta(2), other.theta(2))


def test_features_are_those_of_the_state(objective: Objective, theta: torch.Tensor) -> None:
    near = around(objective, theta)
    sample = near.sample(1)
    assert sample is not None
    scene = objective.space.apply(objective.space.scene, near.theta(1))
    x0, y0, x1, y1 = sample.image.targets.boxes_xyxy[CAR].tolist()
    assert sample.features["height_px"] == pytest.approx(y1 - y0, rel=1e-4)
    assert sample.features["aspect"] == pytest.approx((x1 - x0) / (y1 - y0), rel=1e-4)
    assert sample.features["distance_m"] == pytest.approx(float(scene.objects.translation[CAR, 2]))
    grown = scene.objects.size_lhw[CAR] / objective.space.scene.objects.size_lhw[CAR] - 1
    assert sample.features["grown_percent"] == pytest.approx(100 * float(grown.mean()))
    assert sample.features["grown_percent"] != 0
    assert sample.features["weather.fog"] == pytest.approx(float(scene.environment.weather[0]))
    assert sample.features["paint.lightness"] == pytest.approx(float(scene.objects.texture_code[CAR, 0]))
    assert isinstance(near.fails(sample), bool)


def test_the_sign_of_the_margin_is_the_failure(objective: Objective, theta: torch.Tensor) -> None:
    near = around(objective, theta)
    samples = [near.sample(number) for number in range(6)]
    margins = [near.margin(sample) for sample in samples if sample is not None]
    assert [margin < 0 for margin in margins] == [near.fails(sample) for sample in samples if sample is not None]
    assert len(set(margins)) == len(margins)


def test_a_place_in_a_draw_is_a_sample(objective: Objective, theta: torch.Tensor) -> None:
    near = around(objective, theta)
    numbered, placed, moved = (
        near.sample(2),
        near.sample_at(near.unit_point(2), 2),
        near.sample_at(1 - near.unit_point(2), 2),
    )
    assert numbered is not None
    assert placed is not None
    assert moved is not None
    assert torch.equal(numbered.image.image, placed.image.image)
    assert not torch.equal(numbered.image.image, moved.image.image)


def test_a_scene_sample_describes_all_objects(objective: Objective) -> None:
    def everywhere(name: str = "a") -> SceneSampler:
        return SceneSampler(objective, objective.feasible_set(), Nuisances.parse("off"), name)

    whole, space = everywhere(), objective.space
    assert len(whole.counted_objects) > 2
    thetas = [whole.theta(number) for number in range(3)]
    for theta in thetas:
        assert bool((theta >= space.lower - 1e-6).all() & (theta <= space.upper + 1e-6).all())
        assert bool((theta[: space.dim // 2] != 0).any())
    assert torch.equal(thetas[2], everywhere().theta(2))
    assert not torch.equal(thetas[2], everywhere("b").theta(2))

    samples = whole.sample(1)
    assert set(samples) <= set(whole.counted_objects)
    assert len({id(sample.image) for sample in samples.values()}) == 1, "one picture"
    margins = whole.margins(samples)
    assert set(margins) == set(samples)
    index = next(iter(samples))
    _, y0, _, y1 = samples[index].image.targets.boxes_xyxy[index].tolist()
    assert samples[index].features["height_px"] == pytest.approx(y1 - y0, rel=1e-4)
    assert whole.margins({}) == {}


def test_everywhere_at_theta0_all_judged_objects_are_found(objective: Objective) -> None:
    whole = SceneSampler(objective, objective.feasible_set(), Nuisances.parse("off"), "a")
    margins = whole.margins(whole.sample_at(objective.space.theta0, 0))
    assert set(margins) == set(whole.counted_objects)
    assert all(margin > 0 for margin in margins.values())
