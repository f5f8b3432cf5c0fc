"""Steps on changed regions against steps on whole pictures: one objective, two ways to look."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from detectors.base import AnchorPredictions, Detector
from detectors.registry import load_detector
from drivesem.attacks.objective import Objective
from drivesem.attacks.space import ParameterSpace
from drivesem.config.commands import AttackConfig
from drivesem.synth.demo import demo_scene
from scene_ir.render.compositor import Compositor


class Counted:
    """How many whole passes a detector makes."""

    def __init__(self, detector: Detector, monkeypatch: pytest.MonkeyPatch) -> None:
        self.passes = 0
        whole = detector.forward

        def forward(images: Tensor) -> AnchorPredictions:
            self.passes += 1
            return whole(images)

        monkeypatch.setattr(detector, "forward", forward)


@pytest.fixture(scope="module")
def pair() -> tuple[Objective, Objective]:
    """The same, on regions and whole."""
    scene = demo_scene(0, 0)
    space = ParameterSpace(scene, ("color", "translate", "rotate", "mesh"))
    detector, compositor = load_detector("squeezedet"), Compositor(scene)
    return Objective(compositor, space, detector), Objective(compositor, space, detector, AttackConfig(whole=True))


def thetas(space: ParameterSpace, count: int) -> list[Tensor]:
    generator = torch.Generator().manual_seed(1)
    noise = 2 * torch.rand(count, space.dim, generator=generator) - 1
    return [space.theta0, *(space.theta0 + 5 * space.step * noise[i] for i in range(count))]


def test_losses_gradients_and_scores_are_those_of_whole_pictures(pair: tuple[Objective, Objective]) -> None:
    """At the photograph too, where no pixel differs and each gradient counts."""
    regions, whole = pair
    for theta in thetas(regions.space, 2):
        (loss, gradient), (expected, slope) = regions.loss_and_grad(theta), whole.loss_and_grad(theta)
        assert loss == pytest.approx(expected, rel=1e-4)
        assert float((gradient - slope).norm() / slope.norm()) < 1e-4
        found, wanted = regions.score(theta), whole.score(theta)
        assert found.loss == pytest.approx(wanted.loss, rel=1e-4)
        assert (found.lost, found.phantoms, found.success) == (wanted.lost, wanted.phantoms, wanted.success)


def test_only_the_first_step_is_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """The benign picture is, and the pass that is compared; weather changes all pixels."""
    scene = demo_scene(0, 0)
    detector = load_detector("squeezedet")
    compositor = Compositor(scene)
    space = ParameterSpace(scene, ("color", "translate"))
    counted = Counted(detector, monkeypatch)
    objective = Objective(compositor, space, detector)
    assert counted.passes == 1
    for theta in thetas(space, 2):
        objective.loss_and_grad(theta)
    assert counted.passes == 2
    Objective(compositor, space, detector, AttackConfig(whole=True)).loss_and_grad(space.theta0)
    assert counted.passes == 4
    foggy = ParameterSpace(scene, ("weather", "translate"))
    Objective(compositor, foggy, detector).loss_and_grad(foggy.theta0)
    assert counted.passes == 6


def test_what_is_forgotten_is_made_anew(pair: tuple[Objective, Objective]) -> None:
    regions, _ = pair
    theta = thetas(regions.space, 1)[1]
    loss, gradient = regions.loss_and_grad(theta)
    regions.release_layers()
    again, slope = regions.loss_and_grad(theta)
    assert again == pytest.approx(loss, rel=1e-5)
    assert float((gradient - slope).norm() / slope.norm()) < 1e-5
