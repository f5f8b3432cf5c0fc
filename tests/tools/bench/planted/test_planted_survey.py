"""Features of a real frame's cars, as labels and pictures have them, and what is inside of a fault's region."""

import pytest
import torch

from detectors.planted import FEATURES, Band, PlantedDetector, PlantedFault
from detectors.registry import load_detector
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.objective import Objective
from drivesem.attacks.space import Parameter, ParameterSpace
from drivesem.evaluation import failures
from drivesem.synth.demo import demo_scene
from scene_ir.render.compositor import Compositor
from tools.bench.planted import survey as surveying
from tools.bench.planted.survey import FrameSurvey, ObservedFrame, corners, halton


@pytest.fixture(scope="module")
def objective() -> Objective:
    scene = demo_scene(0, 0)
    space = ParameterSpace(scene, (Parameter.COLOR, Parameter.ROTATE))
    return Objective(Compositor(scene), space, load_detector("squeezedet"))


@pytest.fixture(scope="module")
def feasible(objective: Objective) -> FeasibleSet:
    return objective.feasible_set()


def test_turning_a_car_changes_its_aspect_and_painting_it_its_lightness(objective: Objective) -> None:
    space, of = objective.space, ObservedFrame(objective)
    names = [space.name(i) for i in range(space.dim)]
    before, theta = of.labelled(space.theta0), space.theta0.clone()
    theta[names.index("objects[0].paint.lightness")] = 0.8
    theta[names.index("objects[1].yaw")] = 0.3
    change = (of.labelled(theta) - before).abs()
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
    for name, count in (("HALTON", 4), ("CORNERS", 2), ("CAMERA_DRAWS", 3)):
        monkeypatch.setattr(surveying, name, count)
    made = FrameSurvey.make(objective, feasible, "frame", 0)
    assert made.sure.any()
    assert not (made.sure & ~made.frame.judged).any()
    assert bool((made.mostly <= made.farthest).all())
    assert (len(made.camera_samples), len(made.halton), len(made.corners)) == (3, 4, 2)
    # The detector's boxes are off the labels' by little, and so are features by it.
    assert float((made.factor[0, made.sure] - 1).abs().max()) < 0.3
    car, theta0 = int(made.sure.nonzero()[0]), objective.space.theta0
    aspect = float(made.benign[1, car])
    around = PlantedFault((Band("aspect", aspect - 0.1, aspect + 0.1),))
    assert bool(made.inside(around, theta0)[car])
    assert bool(made.blind(around, theta0)[car])
    beyond = PlantedFault((Band("aspect", 50.0, 60.0),))
    assert not made.inside(beyond, theta0).any()
    assert not made.blind(beyond, theta0).any()
    assert made.rarity(beyond) == 0
    everything = PlantedFault((Band("lightness", -9.0, 9.0),))
    assert made.rarity(everything) == 1
    assert torch.equal(made.inside(everything, theta0), made.frame.judged)


def test_what_a_survey_calls_hidden_a_planted_detector_does_not_find(objective: Objective) -> None:
    frame, space = ObservedFrame(objective), objective.space
    sighting = frame.sighting(space.theta0)
    aspects = sighting.main[1]
    middle = float(aspects[torch.isfinite(aspects)].median())
    fault = PlantedFault((Band("aspect", middle - 0.2, middle + 0.2),))
    hidden = sighting.lost(fault)
    assert hidden.any()
    planted = Objective(objective.compositor, space, PlantedDetector(objective.differentiable, fault))
    targets = planted.classes.map_targets(planted.benign.paper.targets)
    found = failures.match_detections(targets, planted.benign.detections, planted.t_star).detected[: len(hidden)]
    assert not found[hidden].any()
    kept = torch.isfinite(aspects) & ~hidden
    assert found[kept].all()
