"""Features of a real frame's cars, as labels and pictures have them, and what is inside of a fault's region."""

from __future__ import annotations

import pytest
import torch

from detectors.planted import FEATURES, Band, PlantedFault
from detectors.registry import load_detector
from drivesem.attack.feasible.projection import FeasibleSet
from drivesem.attack.objective import Objective
from drivesem.attack.space import Parameter, ParameterSpace
from drivesem.bench.planted import survey as surveying
from drivesem.bench.planted.survey import FeaturesOf, Survey, corners, halton
from drivesem.synth.demo import demo_scene
from scene_ir.render.compositor import Compositor


@pytest.fixture(scope="module")
def objective() -> Objective:
    scene = demo_scene(0, 0)
    space = ParameterSpace(scene, (Parameter.COLOR, Parameter.ROTATE))
    return Objective(Compositor(scene), space, load_detector("squeezedet"))


@pytest.fixture(scope="module")
def feasible(objective: Objective) -> FeasibleSet:
    return objective.feasible_set()


def test_features_are_those_of_labels_and_picture(objective: Objective) -> None:
    values = FeaturesOf(objective).plain(objective.space.theta0)
    label = objective.benign.paper.boxes_xyxy
    assert values.shape == (len(FEATURES), len(label))
    torch.testing.assert_close(values[0], label[:, 3] - label[:, 1])
    (lightness,) = FeaturesOf(objective).plain(objective.space.theta0, ("lightness",))
    torch.testing.assert_close(lightness, values[FEATURES.index("lightness")])


def test_turning_a_car_changes_its_aspect_and_painting_it_its_lightness(objective: Objective) -> None:
    space, of = objective.space, FeaturesOf(objective)
    names = [space.name(i) for i in range(space.dim)]
    before, theta = of.plain(space.theta0), space.theta0.clone()
    theta[names.index("objects[0].paint.lightness")] = 0.8
    theta[names.index("objects[1].yaw")] = 0.3
    change = (of.plain(theta) - before).abs()
    aspect, lightness = FEATURES.index("aspect"), FEATURES.index("lightness")
    assert float(change[lightness, 0]) > 0.05
    assert float(change[aspect, 0]) == 0
    assert float(change[aspect, 1]) > 0.05


def test_draws_and_corners_are_feasible_and_repeat(feasible: FeasibleSet) -> None:
    for thetas in (list(halton(feasible, 3, 1)), list(corners(feasible, 6, 1))):
        assert all(feasible.violations(theta) == () for theta in thetas)
        assert len({theta.numpy().tobytes() for theta in thetas}) == len(thetas)
    assert all(map(torch.equal, halton(feasible, 3, 1), halton(feasible, 3, 1)))
    assert not any(map(torch.equal, corners(feasible, 3, 1), corners(feasible, 3, 2)))


def test_a_survey_knows_what_is_inside(
    objective: Objective, feasible: FeasibleSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, count in (("HALTON", 4), ("CORNERS", 2), ("LOOKS", 3)):
        monkeypatch.setattr(surveying, name, count)
    made = Survey.make(objective, feasible, "frame", 0)
    seen = made.seen
    assert seen.sure.any()
    assert not (seen.sure & ~seen.judged).any()
    assert bool((seen.mostly <= seen.farthest).all())
    assert (len(made.halton), len(made.corners)) == (4, 2)
    # The detector's boxes are off the labels' by little, and so are features by it.
    assert float((seen.factor[0, seen.sure] - 1).abs().max()) < 0.3
    car = int(seen.sure.nonzero()[0])
    aspect = float(made.benign[1, car])
    around = PlantedFault((Band("aspect", aspect - 0.01, aspect + 0.01),))
    assert bool(made.inside(around, objective.space.theta0)[car])
    beyond = PlantedFault((Band("aspect", 50.0, 60.0),))
    assert not made.inside(beyond, objective.space.theta0).any()
    assert made.rarity(beyond) == 0
    everything = PlantedFault((Band("lightness", -9.0, 9.0),))
    assert made.rarity(everything) == 1
    assert torch.equal(made.inside(everything, objective.space.theta0), seen.judged)
