"""The rule of certificates, counting that stops where nothing more can change, and looks at a scene."""

import dataclasses
from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Tensor

from detectors.types import Detections, Targets
from drivesem.attacks.labels import Labeller
from drivesem.evaluation.resampling import wilson
from drivesem.failures.certificate import (
    CertificateRule,
    CompositorRenderer,
    NuisanceCamera,
    SampleOutcome,
    certify,
)
from drivesem.failures.grades import Certificate, Kind
from drivesem.failures.kinds import DetectionOutcome, Fault, LabelledDetections
from drivesem.failures.nuisances import Nuisances, NuisanceSample
from drivesem.failures.second_renderer.base import SecondRender
from drivesem.synth.demo import demo_scene
from scene_ir.errors import RangeError
from scene_ir.render.compositor import Compositor
from scene_ir.types import SceneIR

PLACE = torch.tensor([[10.0, 10.0, 60.0, 50.0]])
LOST = Fault(Kind.MISSED, 0, -1)
TWICE = Fault(Kind.TWICE, 0, 0)
PHANTOM = Fault(Kind.BACKGROUND, -1, 0)


class Still(NuisanceSample):
    """A draw that moves nothing."""

    def __init__(self) -> None:
        pass

    def transform_boxes(self, boxes_xyxy: Tensor) -> Tensor:
        return boxes_xyxy


def make_outcome(
    found: bool, twice: bool = False, alarm: float | None = None, hidden: bool = False
) -> SampleOutcome:
    boxes = PLACE if alarm is not None else PLACE[:0]
    scores = torch.tensor([] if alarm is None else [alarm])
    detections = Detections(boxes, torch.zeros(len(boxes), dtype=torch.int64), scores)
    targets = Targets(PLACE + 300, torch.tensor([0]), torch.tensor([hidden]))
    background = (0,) if alarm is not None and alarm >= 0.5 else ()
    judged = DetectionOutcome(torch.tensor([found]), {}, {0: 0} if twice else {}, background)
    return SampleOutcome(LabelledDetections(targets, torch.zeros(1, 4), detections), judged, 0.5, Still(), 1)


def counted(
    fault: Fault, before: Sequence[SampleOutcome], after: Sequence[SampleOutcome]
) -> tuple[Certificate, int]:
    """And how many looks were taken."""
    taken: list[int] = []

    def side(outcomes: Sequence[SampleOutcome]) -> Callable[[int], SampleOutcome]:
        def one(number: int) -> SampleOutcome:
            taken.append(number)
            return outcomes[number]

        return one

    (count,) = certify([fault], PLACE, side(before), side(after), CertificateRule())
    return count, len(taken)


FOUND, GONE = make_outcome(True), make_outcome(False)


@pytest.mark.parametrize(
    ("right", "wrong", "certain"), [(16, 16, True), (15, 12, True), (14, 16, False), (16, 11, False)]
)
def test_the_rule(right: int, wrong: int, certain: bool) -> None:
    count, _ = counted(LOST, [FOUND] * right + [GONE] * (16 - right), [GONE] * wrong + [FOUND] * (16 - wrong))
    assert CertificateRule().holds(count) is certain


def test_what_the_rule_promises() -> None:
    assert wilson(12, 16)[0] > 0.5
    assert wilson(11, 16)[0] < 0.5


def test_what_a_draw_hides_is_not_missed_in_it() -> None:
    """Nobody could see the car there: neither found nor missed."""
    unseen = make_outcome(False, hidden=True)
    count, _ = counted(LOST, [FOUND] * 16, [GONE] * 11 + [unseen] * 5)
    assert (count.after, CertificateRule().holds(count)) == (11, False)
    assert CertificateRule().holds(counted(LOST, [FOUND] * 16, [GONE] * 12 + [unseen] * 4)[0])
    assert not CertificateRule().holds(counted(LOST, [FOUND] * 14 + [unseen] * 2, [GONE] * 16)[0])


def test_no_more_samples_than_decide() -> None:
    assert counted(LOST, [FOUND] * 16, [GONE] * 16)[1] == 32
    # Five draws in which it is found leave at most 11; nobody looks at the scene before the change then.
    count, taken = counted(LOST, [FOUND] * 16, [FOUND] * 16)
    assert (taken, count) == (5, Certificate(0, 0, 0, 5, None, count.margin_after))
    assert counted(LOST, [GONE] * 16, [GONE] * 16)[1] == 16 + 2


def test_twice_and_background() -> None:
    certain = counted(TWICE, [FOUND] * 16, [make_outcome(True, twice=True)] * 16)[0]
    assert CertificateRule().holds(certain)
    assert certain.margin_after is None
    assert not CertificateRule().holds(
        counted(TWICE, [make_outcome(True, twice=True)] * 16, [make_outcome(True, twice=True)] * 16)[0]
    )
    # A phantom must be silent before: whatever is reported there from t* on speaks against it.
    alarm, hint = make_outcome(True, alarm=0.8), make_outcome(True, alarm=0.4)
    certain = counted(PHANTOM, [hint] * 16, [alarm] * 16)[0]
    assert CertificateRule().holds(certain)
    assert (certain.margin_before or 0) > 0
    assert (certain.margin_after or 0) < 0
    assert not CertificateRule().holds(counted(PHANTOM, [alarm] * 16, [alarm] * 16)[0])


def test_more_draws_keep_the_shares() -> None:
    rule = CertificateRule(32)
    assert (rule.before, rule.after) == (30, 24)


def test_fewer_draws_than_the_rule_needs() -> None:
    with pytest.raises(
        RangeError, match="draws: expected at least 16, which a certificate's rule needs, found 15"
    ):
        CertificateRule(15)


class Sees:
    """Finds whatever is bright: one car where the picture is not black."""

    name = "sees"
    classes: tuple[str, ...] = ("Car",)
    calls = 0

    def forward(self, images: Tensor) -> Tensor:
        self.calls += 1
        return images

    def decode(self, raw: Tensor) -> list[Detections]:
        seen = (raw[0].sum(0) > 0.05).nonzero()
        if not len(seen):
            return [Detections(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), torch.zeros(0))]
        low, high = seen.amin(0).flip(0), seen.amax(0).flip(0)
        box = torch.cat([low, high]).float()[None]
        return [Detections(box, torch.zeros(1, dtype=torch.int64), torch.ones(1))]


def test_a_sample_moves_the_labels() -> None:
    """The label of a car that alone is painted white is where the camera sees it, in every draw."""
    scene = demo_scene(0, 0)
    compositor = Compositor(scene)
    labeller = Labeller(scene, compositor.render(scene))
    drawn = CompositorRenderer(compositor, labeller)
    largest = int((scene.objects.box2d[:, 2] - scene.objects.box2d[:, 0]).argmax())

    class Masked:
        name = "masked"

        def render(self, changed: SceneIR) -> SecondRender:
            redrawn = drawn.render(changed)
            ids = compositor.render(changed).object_id
            return dataclasses.replace(redrawn, image=(ids == largest + 1).float().expand(3, -1, -1))

    quiet = dataclasses.replace(Nuisances(), noise=0.0, jpeg=0.0, blur_px=0.0)
    camera = NuisanceCamera(Masked(), Sees(), 0.5, quiet, "test")
    for number in range(3):
        seen = camera.evaluate(scene, number, torch.zeros(len(scene.objects), dtype=torch.bool))
        visible = seen.labelled.visible_xyxy[largest]
        torch.testing.assert_close(visible, seen.labelled.detections.boxes_xyxy[0], atol=1.6, rtol=0)
        assert bool(seen.outcome.detected[largest])


def test_outcomes_hold_no_image_of_noise() -> None:
    """A frame's outcomes are cached, and at 1280 x 720 px each noise takes 11 MB."""
    scene = demo_scene(0, 0)
    compositor = Compositor(scene)
    drawn = CompositorRenderer(compositor, Labeller(scene, compositor.render(scene)))
    camera = NuisanceCamera(drawn, Sees(), 0.5, Nuisances(), "test")
    outcome = camera.evaluate(scene, 0, torch.zeros(len(scene.objects), dtype=torch.bool))
    assert outcome.sample.noise > 0
    assert outcome.sample.noise_field.cached_mb == 0
    outcome.sample.noise_field.like(scene.photograph)
    assert outcome.sample.noise_field.cached_mb > 0
