import math
from dataclasses import replace

import pytest
import torch

from detectors.base import AnchorPredictions, Detector
from detectors.squeezedet import SqueezeDet
from detectors.types import CLASSES, Detections
from drivesem.attacks.feasibility_check import check_scene
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.labels import Difficulty
from drivesem.attacks.methods.gradient_ascent import SiFGSM
from drivesem.attacks.methods.gradient_free import Sampling
from drivesem.attacks.objective import Objective
from drivesem.attacks.space import ParameterSpace
from drivesem.config.commands import AttackConfig
from scene_ir.errors import RangeError
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import Crop, Render

NEAR = ((-2.0, 9.0), (2.4, 13.0))
ALL_TARGETS = Difficulty(min_height_px=0, max_occlusion=3, max_truncation=1, min_contrast=0)


class StubCompositor:
    """An image whose mean is a hundredth of the sum of the cars' z, and opacities without a meaning."""

    fixed_geometry = None  # what `render_batch` asks for: nothing of this can be drawn together

    def render(self, scene) -> Render:
        h, w = scene.camera.height, scene.camera.width
        value = scene.objects.translation[:, 2].sum() / 100
        crops = tuple(Crop(torch.ones(1, 2, 2), 4 * i, 0) for i in range(len(scene.objects)))
        ids = torch.zeros(h, w, dtype=torch.int64)
        for i, crop in enumerate(crops):
            ids[0:2, crop.x0 : crop.x0 + 2] = i + 1
        return Render(image=value.expand(3, h, w), depth=torch.ones(h, w), object_id=ids, opacity=crops)


class StubDetector(Detector):
    """Loss: a function of the image's mean. Detects each box given to it, until the mean exceeds `blind_above`."""

    name, classes, t_star = "stub", CLASSES, 0.5

    def __init__(self, boxes_xyxy, function=torch.sin, blind_above=float("inf")) -> None:
        super().__init__()
        self.boxes_xyxy, self.function, self.blind_above = boxes_xyxy, function, blind_above
        self.aimed_at = []

    def forward(self, images):
        n = len(self.boxes_xyxy)
        mean = images.mean().expand(1, n)
        boxes = self.boxes_xyxy[None]
        return AnchorPredictions(boxes, boxes, mean[..., None].expand(1, n, len(CLASSES)), mean, (2, 2))

    def loss(self, raw, targets):
        self.aimed_at.append(targets[0].boxes_xyxy)
        return {"confidence": self.function(raw.confidence_logits.mean())}

    def decode(self, raw):
        n = len(self.boxes_xyxy) if float(raw.confidence_logits.mean()) < self.blind_above else 0
        return [Detections(self.boxes_xyxy[:n], torch.zeros(n, dtype=torch.int64), torch.full((n,), 0.9))]


def _objective(scene, detector, mode="moved", **settings):
    space = ParameterSpace(scene, ("translate",))
    config = AttackConfig(objective_labels=mode, **{"objective": "confidence", **settings})
    return Objective(StubCompositor(), space, detector, config, ALL_TARGETS)


def test_a_photograph_is_detected_unless_it_is_the_benign_picture(street):
    scene = street(positions_xz=NEAR, dtype=torch.float64)
    objective = _objective(scene, StubDetector(scene.objects.box2d))
    passes = objective.passes
    assert len(objective.detect_photograph()) == len(NEAR)  # the stub's picture is not the photograph
    assert objective.passes == passes + 1
    same = replace(objective.benign, render=replace(objective.benign.render, image=scene.photograph))
    objective.benign = same
    assert objective.detect_photograph() is same.detections
    assert objective.passes == passes + 1


def test_loss_and_gradient_are_those_of_the_whole_chain(street):
    scene = street(positions_xz=NEAR, dtype=torch.float64)
    objective = _objective(scene, StubDetector(scene.objects.box2d))
    theta = torch.tensor([0.01, 0.02, -0.03, 0.04], dtype=torch.float64)
    loss, gradient = objective.loss_and_grad(theta)
    assert loss == pytest.approx(float(objective(theta)))
    h = 1e-6
    for i in range(4):
        step = torch.zeros(4, dtype=torch.float64)
        step[i] = h
        slope = (float(objective(theta + step)) - float(objective(theta - step))) / (2 * h)
        assert float(gradient[i]) == pytest.approx(slope, rel=1e-5, abs=1e-8)


def test_a_loss_that_is_not_finite_is_an_error(street):
    scene = street(positions_xz=NEAR)
    with pytest.raises(RangeError, match="objective: confidence: expected a finite loss"):
        _objective(scene, StubDetector(scene.objects.box2d, lambda x: x / 0))


def test_a_gradient_that_is_not_finite_names_the_coordinate(street):
    scene = street(positions_xz=NEAR)
    # sqrt(x - x): the value is 0, the slope is not.
    objective = _objective(scene, StubDetector(scene.objects.box2d, lambda x: (x - x.detach()).sqrt()))
    with pytest.raises(RangeError, match=r"gradient of objects\[0\]\.translate\.along: expected a finite value"):
        objective.loss_and_grad(objective.space.theta0)


def test_an_unknown_term_is_named(street):
    scene = street(positions_xz=NEAR)
    with pytest.raises(RangeError, match=r"objective term: expected one of confidence, hide, .*, found 'class'"):
        _objective(scene, StubDetector(scene.objects.box2d), objective="class")


@pytest.mark.parametrize("mode", ["moved", "paper"])
def test_the_loss_uses_the_labels_of_its_mode(street, mode):
    scene = street(positions_xz=NEAR)
    detector = StubDetector(scene.objects.box2d)
    objective = _objective(scene, detector, mode)
    theta = torch.tensor([0.0, -0.1, 0.0, 0.0])
    objective(theta)
    rendered = objective.evaluate(theta)
    expected = rendered.moved if mode == "moved" else rendered.paper
    assert torch.equal(detector.aimed_at[-1], expected.targets.boxes_xyxy)
    assert torch.equal(detector.aimed_at[-2], expected.targets.boxes_xyxy)
    assert torch.equal(rendered.paper.boxes_xyxy, scene.objects.box2d)
    assert not torch.equal(rendered.moved.boxes_xyxy, scene.objects.box2d)


def test_theta0_is_the_benign_render_and_no_failure(street):
    scene = street(positions_xz=NEAR)
    objective = _objective(scene, StubDetector(scene.objects.box2d))
    assert objective.evaluate(objective.space.theta0) is objective.benign
    score = objective.score(objective.space.theta0)
    assert (score.lost, score.phantoms, score.success, score.success_paper) == (0, 0, False, False)


def test_a_theta_is_rendered_once(street):
    scene = street(positions_xz=NEAR)
    objective = _objective(scene, StubDetector(scene.objects.box2d))
    theta = torch.tensor([0.0, -0.1, 0.0, 0.0])
    first = objective.evaluate(theta)
    assert objective.evaluate(theta.clone()) is first
    theta[1] = 0.1
    assert objective.evaluate(theta) is not first


def test_success_in_both_label_modes(street):
    scene = street(positions_xz=NEAR)
    # A detector that sees nothing any more fails both; one that stays where the cars were fails `moved` only.
    blind = _objective(scene, StubDetector(scene.objects.box2d, blind_above=0.222))
    gone = blind.score(torch.tensor([0.1, 0.0, 0.0, 0.0]))
    assert (gone.lost, gone.phantoms, gone.success, gone.success_paper) == (2, 0, True, True)
    still = _objective(scene, StubDetector(scene.objects.box2d))
    stayed = still.score(torch.tensor([0.0, -0.25, 0.0, 0.0]))
    assert (stayed.lost, stayed.phantoms, stayed.success, stayed.success_paper) == (1, 1, True, False)


class Spotter:
    """A detector without gradient, of COCO-like classes: finds given boxes, surer the brighter the image."""

    name, classes = "spotter", ("person", "Car")

    def __init__(self, boxes_xyxy) -> None:
        self.boxes_xyxy, self.seen_images = boxes_xyxy, 0

    def forward(self, images):
        self.seen_images += len(images)
        return images.mean(dim=(1, 2, 3)).tolist()

    def decode(self, raw):
        n = len(self.boxes_xyxy)
        person = Detections(self.boxes_xyxy[:1], torch.tensor([0]), torch.tensor([0.99]))
        scores = [torch.full((n,), min(2 * mean, 1.0)) for mean in raw]
        return [
            Detections(
                torch.cat([person.boxes_xyxy, self.boxes_xyxy]),
                torch.cat([person.labels, torch.ones(n, dtype=torch.int64)]),
                torch.cat([person.scores, score]),
            )
            for score in scores
        ]


def test_a_detector_without_gradient_is_scored_by_its_detections(street):
    scene = street(positions_xz=NEAR)
    objective = _objective(scene, Spotter(scene.objects.box2d), objective="objectness")
    assert objective.classes.names == ("Car",)
    assert objective.t_star == 0.3
    # mean 0.22 of the image, rounded to 8 bits: both cars are found with a score of 0.44
    score = 2 * round(0.22 * 255) / 255
    assert objective.benign.loss == pytest.approx(2 * (1 - score) ** 2, abs=1e-5)
    assert objective.benign.detections.labels.tolist() == [0, 0]
    # its boxes stay behind when a car drives off across: one car is lost, and its box a phantom
    stayed = objective.score(torch.tensor([0.0, -0.25, 0.0, 0.0]))
    assert (stayed.lost, stayed.phantoms, stayed.success, stayed.success_paper) == (1, 1, True, False)
    assert stayed.loss > objective.benign.loss


def test_no_success_while_a_car_is_out_of_sight(street):
    scene = street(positions_xz=((0.0, 7.0), (3.0, 13.0)), yaw=-math.pi / 2)
    compositor = Compositor(scene, RenderSettings(backend="reference"))
    objective = Objective(compositor, ParameterSpace(scene, ("translate",)), Spotter(scene.objects.box2d))
    other = objective.score(torch.tensor([0.0, -0.25, 0.0, 0.0]))
    behind = objective.score(torch.tensor([0.0, -0.25, 0.0, 0.25]))
    assert other.success
    assert other.violations == ()
    assert behind.violations == ("objects[1]: visibility",)
    assert behind.lost > 0
    assert not behind.success
    assert not behind.success_paper


def test_the_threshold_can_be_set(street):
    scene = street(positions_xz=NEAR)
    objective = _objective(scene, Spotter(scene.objects.box2d), objective="objectness", t_star=0.9)
    assert not objective.score(torch.tensor([0.0, -0.25, 0.0, 0.0])).success


def test_a_missing_gradient_or_term_is_named(street):
    scene = street(positions_xz=NEAR)
    objective = _objective(scene, Spotter(scene.objects.box2d), objective="objectness")
    with pytest.raises(RangeError, match="detector: expected one with a gradient, found spotter"):
        objective.loss_and_grad(objective.space.theta0)
    with pytest.raises(
        RangeError, match=r"objective term: expected one of objectness, hide, .*, found 'confidence'"
    ):
        _objective(scene, Spotter(scene.objects.box2d))


def test_scores_are_cached(street):
    scene = street(positions_xz=NEAR)
    detector = Spotter(scene.objects.box2d)
    objective = _objective(scene, detector, objective="objectness")
    problem = objective.problem(FeasibleSet(objective.space))
    result = Sampling(queries=6, kind="halton")(problem, objective.space.theta0, seed=1)
    assert result.queries == 6
    assert detector.seen_images == 7
    assert result.score == objective.score(result.theta)


def _real(scene, params) -> Objective:
    detector = SqueezeDet(t_star=0.3)
    detector.initialise(torch.Generator().manual_seed(0))
    detector.eval().requires_grad_(False)
    return Objective(
        Compositor(scene, RenderSettings(backend="reference")),
        ParameterSpace(scene, params),
        detector.to(scene.depth),
    )


def test_the_gradient_reaches_through_the_real_renderer(street):
    # The paint's code moves no label, so the constant labels leave the gradient exact.
    objective = _real(street(positions_xz=NEAR, dtype=torch.float64), ("color",))
    space = objective.space
    _, gradient = objective.loss_and_grad(space.theta0)
    step = 0.01 * space.step * torch.sign(gradient)
    with torch.no_grad():
        slope = float(objective(space.theta0 + step) - objective(space.theta0 - step)) / 2
    assert float(gradient @ step) == pytest.approx(slope, rel=0.02)
    assert slope > 0


def test_the_whole_chain_is_deterministic_and_feasible(street):
    scene = street(positions_xz=NEAR)
    objective = _real(scene, ("translate", "rotate", "mesh"))
    space = objective.space
    problem = objective.problem(FeasibleSet(space))
    result = SiFGSM(steps=2)(problem, space.theta0)
    again = SiFGSM(steps=2)(problem, space.theta0)
    assert torch.equal(result.theta, again.theta)
    assert result.loss_trace == again.loss_trace
    assert result.queries == 2
    # What is judged is rounded to 8 bits, what is differentiated is not.
    assert result.loss_trace[0] == pytest.approx(objective.benign.loss, rel=0.05)
    assert not objective.score(space.theta0).success
    assert check_scene(scene, space.apply(scene, result.theta)) == []


class PatternCompositor(StubCompositor):
    """Images of a size of its own, whose brightness in each third is that of one coordinate of the first car."""

    def __init__(self, height: int, width: int) -> None:
        generator = torch.Generator().manual_seed(height)
        self.pattern = torch.rand(3, height, width, generator=generator, dtype=torch.float64)

    def render(self, scene) -> Render:
        stub = super().render(scene)
        value = (scene.objects.translation[0] / 20).sigmoid()
        return Render(value[:, None, None] * self.pattern, stub.depth, stub.object_id, stub.opacity)


def _frozen_squeezedet() -> SqueezeDet:
    detector = SqueezeDet(t_star=0.3).double()
    detector.initialise(torch.Generator().manual_seed(0))
    torch.nn.init.normal_(detector.convdet.weight, std=0.02, generator=torch.Generator().manual_seed(1))
    return detector.eval().requires_grad_(False)


def test_a_gradient_pass_previews_the_score(street):
    scene = street(positions_xz=NEAR)
    space = ParameterSpace(scene, ("translate",))
    thetas = [torch.full((4,), 0.2), torch.full((4,), -0.2)]
    light = [float(StubCompositor().render(space.apply(scene, theta)).image.mean()) for theta in thetas]
    benign = float(StubCompositor().render(scene).image.mean())
    # Blind at the brighter of the two only.
    objective = _objective(scene, StubDetector(scene.objects.box2d, blind_above=(benign + max(light)) / 2))
    lost = set()
    for theta in thetas:
        assert objective.preview(theta) is None
        objective.loss_and_grad(theta)
        preview, score = objective.preview(theta), objective.score(theta)
        assert preview is not None
        assert (preview.lost, preview.phantoms) == (score.lost, score.phantoms)
        assert (preview.success, preview.success_paper) == (score.success, score.success_paper)
        assert preview.loss == pytest.approx(score.loss, abs=1e-2)
        lost.add(score.lost)
    assert lost == {1, 2}  # detections stay, so the nearer car leaves its own either way


@pytest.mark.parametrize("mode", ["moved", "paper"])
def test_goals_without_a_gradient(street, mode):
    scene = street(positions_xz=NEAR)
    objective = _objective(scene, Spotter(scene.objects.box2d), mode, objective="failure")
    certain = 2 * math.log(objective.t_star / (1 - objective.t_star))
    assert objective.benign.loss < certain
    with pytest.raises(RangeError, match="detector: expected one with a gradient"):
        objective.loss_and_grad(objective.space.theta0)
