"""Losses by hand, and attacks on networks with fixed outcomes."""

import math
from dataclasses import replace

import pytest
import torch
from torch import nn

from drivesem.attacks.methods.base import Score
from drivesem.attacks.methods.gradient_ascent import SGD, SiFGSM
from drivesem.attacks.methods.gradient_free import Sampling
from drivesem.attacks.methods.scw import SCW
from drivesem.classify.objective import ClassifierObjective, ClassLogits, class_margin, compute_attack_loss
from drivesem.classify.scenes import DRAWN_PX, ObjectScene
from drivesem.classify.space import ObjectSpace, ParameterAmounts, parse_parameters
from scene_ir.errors import RangeError
from tests.drivesem.classify.conftest import make_model

GREY = torch.full((3, DRAWN_PX, DRAWN_PX), 0.5)
WIDE = ParameterAmounts(0.5, 3.0, 0.9)
SCORES = torch.tensor([2.0, 3.0, -1.0])


def make_objective(network, aimed="logit", params="pose", kind="box", reach=WIDE):
    scene = ObjectScene(kind, make_model(kind), "forward", GREY)
    space = ObjectSpace(scene.vertices, parse_parameters(params), ParameterAmounts(0.002, 0.15, 0.2), reach)
    return ClassifierObjective(scene, space, network, aimed)


def test_aims_by_hand():
    assert float(compute_attack_loss(SCORES, 1, "logit")) == -3
    assert float(compute_attack_loss(SCORES, 1, "hinge")) == -1
    assert float(compute_attack_loss(SCORES, 0, "hinge")) == 0
    chances = [math.exp(s) / (math.exp(2) + math.exp(3) + math.exp(-1)) for s in (2, 3, -1)]
    assert float(compute_attack_loss(SCORES, 1, "softmax")) == pytest.approx(chances[0])
    assert float(compute_attack_loss(SCORES, 2, "softmax")) == pytest.approx(chances[1])
    assert (float(class_margin(SCORES, 1)), float(class_margin(SCORES, 2))) == (1, -4)


def test_prediction_confidence_and_margin():
    seen = ClassLogits(SCORES, 1)
    assert (seen.predicted, seen.correct, seen.margin) == (1, True, 1.0)
    assert seen.confidence == pytest.approx(float(SCORES.softmax(0)[1]))
    assert not ClassLogits(SCORES, 0).correct


def test_loss_and_gradient(colours):
    objective = make_objective(colours)
    loss, gradient = objective.loss_and_grad(torch.tensor([0.1, 0.2, 0.0]))
    seen = objective.evaluate(torch.tensor([0.1, 0.2, 0.0]))
    assert loss == pytest.approx(-float(seen.logits[0]), abs=0.02)  # what is judged is rounded to 8 bits
    assert gradient.shape == (3,)
    assert objective.passes == 1 + 3 + 1


def test_a_picture_that_is_misclassified_unchanged_is_no_failure(colours):
    objective = make_objective(colours, kind="ball")
    object.__setattr__(objective.scene.model, "label", 2)
    objective = ClassifierObjective(objective.scene, objective.space, colours, "logit")
    score = objective.score(torch.zeros(3))
    assert not objective.benign.correct
    assert (score.lost, score.phantoms, score.success, score.failures) == (0, 0, False, 0)


def test_a_loss_that_is_not_finite(colours):
    objective = make_objective(colours)
    objective.network = lambda images: images.mean(dim=(2, 3)) * math.nan
    with pytest.raises(RangeError, match="a finite loss"):
        objective.loss_and_grad(torch.zeros(3))


class NarrowClassifier(nn.Module):
    """Predicts box while red is less than `limit` below its first value."""

    def __init__(self, network, limit):
        super().__init__()
        self.network, self.limit, self.first = network, limit, None

    def forward(self, images):
        red = self.network(images)[:, 0]
        self.first = float(red[0].detach()) if self.first is None else self.first
        return torch.stack([red - (self.first - self.limit), 0 * red, 0 * red - 1], dim=1)


METHODS = {
    "si-fgsm": (SiFGSM(5, early_stop=True), "logit"),
    "sgd": (SGD(5, early_stop=True, form="unit"), "logit"),
    "scw": (SCW(5, 5, early_stop=True, constant=0.1), "hinge"),
    "halton": (Sampling(5, kind="halton"), "softmax"),
}


@pytest.mark.parametrize("name", METHODS)
def test_methods_stop_at_the_first_failure(name, colours):
    method, aimed = METHODS[name]
    params = "pose" if name == "halton" else "pose,vertex"
    objective = make_objective(
        NarrowClassifier(colours, 0.02), aimed, params, reach=ParameterAmounts(0.05, 0.75, 0.9)
    )
    result = method(objective.problem(), objective.space.theta0, seed=0)
    assert result.success_moved
    assert not objective.evaluate(result.theta).correct
    assert result.queries == 5 if name == "halton" else result.queries < 5
    again = method(objective.problem(), objective.space.theta0, seed=0)
    assert torch.equal(again.theta, result.theta)


@pytest.mark.parametrize("name", ["si-fgsm", "sgd", "scw"])
def test_the_true_score_falls(name, colours):
    method, aimed = METHODS[name]
    objective = make_objective(NarrowClassifier(colours, 99.0), aimed, "pose,vertex")
    result = method(objective.problem(), objective.space.theta0, seed=0)
    assert not result.success_moved
    assert result.score.loss > objective.score(objective.space.theta0).loss
    assert result.queries == 5


class FixedOutcomes:
    """A problem in which wrong answers are fixed by theta: (theta, misclassified, softmax of the wrong class)."""

    def __init__(self, outcomes):
        self.outcomes, self.samples = outcomes, []

    def score(self, theta):
        if not bool(theta.any()):
            return Score(0.05, 0, 0, False, False)
        if not any(torch.equal(theta, t) for t in self.samples):
            self.samples.append(theta.clone())
        place = next(i for i, t in enumerate(self.samples) if torch.equal(t, theta))
        wrong, softmax = self.outcomes[place]
        return Score(softmax, int(wrong), 0, wrong, wrong)


@pytest.mark.parametrize("kind", ["random", "halton"])
@pytest.mark.parametrize(
    ("outcomes", "winner"),
    [
        ([(False, 0.49), (True, 0.40), (True, 0.90), (True, 0.60), (False, 0.45)], 2),
        ([(False, 0.49), (True, 0.30), (False, 0.48), (False, 0.10), (False, 0.45)], 1),
        ([(False, 0.10), (False, 0.20), (False, 0.30), (False, 0.40), (False, 0.25)], 3),
    ],
)
def test_sampling_prefers_failures_then_the_highest_wrong_softmax(kind, outcomes, winner, colours):
    objective, fixed = (
        make_objective(colours, "softmax", reach=ParameterAmounts(0.05, 0.75, 0.5)),
        FixedOutcomes(outcomes),
    )
    problem = replace(objective.problem(), score=fixed.score)
    result = Sampling(5, kind=kind)(problem, objective.space.theta0, seed=1)
    assert len(fixed.samples) == 5
    assert torch.equal(result.theta, fixed.samples[winner])
    assert float(result.theta.abs().max()) <= 0.75
    assert max(float(theta.abs().max()) for theta in fixed.samples) > 0.3
