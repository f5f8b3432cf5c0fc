"""Grades of failures of a scene whose detector is made to fail."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from detectors.types import Detections
from drivesem.attacks.labels import Labeller
from drivesem.attacks.targets import EvaluatedClasses
from drivesem.evaluation import failures
from drivesem.failures.certificate import CompositorRenderer
from drivesem.failures.grades import Grade, Kind, SecondOpinion
from drivesem.failures.grading import FrameGrades, Grader, GradingInput
from drivesem.failures.kinds import Fault
from drivesem.failures.nuisances import Nuisances
from drivesem.failures.second_renderer.base import NoSecondRendererError, SecondRender, SecondRenderer
from drivesem.run.frame import EvaluatedScene, build_grading_input
from drivesem.synth.demo import demo_scene
from scene_ir.render.compositor import Compositor
from scene_ir.types import SceneIR


class Oracle:
    """Sees each car that is painted as photographed, and none that is not: the picture holds the labels."""

    name = "oracle"
    classes: tuple[str, ...] = ("Car",)

    def __init__(self, blind: bool = True) -> None:
        self.blind = blind

    def forward(self, images: Tensor) -> Tensor:
        return images

    def decode(self, raw: Tensor) -> list[Detections]:
        """Of the first rows of pixels: a box each, and whether its car was painted."""
        rows = raw[0, :, 0]
        count = round(float(rows[0, 0]) * 255)
        boxes, labels = [], []
        for i in range(count):
            box = [float(rows[0, 1 + 4 * i + j]) * 1500 - 100 for j in range(4)]
            painted = float(rows[1, 1 + 4 * i]) > 0.5
            if not (painted and self.blind):
                boxes.append(box)
                labels.append(0)
        found = torch.tensor(boxes).reshape(-1, 4)
        return [Detections(found, torch.tensor(labels, dtype=torch.int64), torch.full((len(boxes),), 0.9))]


@dataclasses.dataclass
class PositionRenderer:
    """A renderer whose pictures tell the oracle where the cars are."""

    of: CompositorRenderer
    name: str = "positions"
    honest: bool = True

    def render(self, changed: SceneIR) -> SecondRender:
        redrawn = self.of.render(changed)
        image = torch.zeros_like(redrawn.image)
        count = len(changed.objects)
        image[0, 0, 0] = count / 255
        for i in range(count):
            image[0, 0, 1 + 4 * i : 5 + 4 * i] = (redrawn.targets.boxes_xyxy[i] + 100) / 1500
            image[1, 0, 1 + 4 * i] = float(self.honest and bool(changed.objects.texture_code[i].any()))
        return dataclasses.replace(redrawn, image=image)


CAR = 3
"""A row of the scene."""


@pytest.fixture(scope="module")
def case() -> GradingInput:
    scene = demo_scene(0, 0)
    painted = torch.zeros_like(scene.objects.texture_code)
    painted[CAR] = 0.3
    changed = scene.with_objects(texture_code=painted)
    compositor = Compositor(scene)
    render = compositor.render(scene)
    labeller = Labeller(scene, render)
    renderer = CompositorRenderer(compositor, labeller)
    judged = EvaluatedClasses.from_detector(Oracle())
    paper = labeller.paper()

    def seen(boxes: Tensor) -> Detections:
        return Detections(boxes, torch.zeros(len(boxes), dtype=torch.int64), torch.full((len(boxes),), 0.9))

    boxes = paper.boxes_xyxy
    others = torch.cat([boxes[:CAR], boxes[CAR + 1 :]])
    benign = EvaluatedScene(scene, render, paper, seen(boxes))
    now = EvaluatedScene(changed, compositor.render(changed), paper, seen(others))
    whole = build_grading_input("frame", renderer, judged, benign, now, lambda: scene)
    return dataclasses.replace(whole, renderer=PositionRenderer(renderer))


OFF = Nuisances.parse("off")
"""The camera stands still: the oracle reads numbers, which must not be shifted."""
LOST = failures.FrameFailures(lost=(CAR,), phantoms=())


def graded(case: GradingInput, second: SecondRenderer | None = None, peer: Oracle | None = None) -> FrameGrades:
    grader = Grader(
        Oracle(),
        0.5,
        OFF,
        make_second_renderer=None if second is None else lambda name, scene: second,
        load_second_detector=None if peer is None else lambda: peer,
    )
    return grader.grade(case, LOST)


def position_renderer(case: GradingInput, honest: bool = True) -> PositionRenderer:
    assert isinstance(case.renderer, PositionRenderer)
    return PositionRenderer(case.renderer.of, "second", honest)


def test_certain_without_second_opinions(case: GradingInput) -> None:
    grades = graded(case)
    assert grades.lost[CAR].grade is Grade.CERTAIN
    assert grades.lost[CAR].count.after == grades.lost[CAR].count.before == 16


def test_no_grade_above_threshold_in_a_picture_that_is_not_trusted(case: GradingInput) -> None:
    yaw = case.changed.objects.yaw.clone()
    yaw[CAR] += math.pi
    turned = dataclasses.replace(case, changed=case.changed.with_objects(yaw=yaw))
    (one,) = graded(turned, position_renderer(case)).lost.values()
    assert one.grade is Grade.THRESHOLD
    assert one.count.after == one.count.before == 16
    assert one.second is None
    assert one.fidelity is not None
    assert one.fidelity.index == CAR
    assert one.fidelity.completed > 0.5
    assert not one.fidelity.is_trusted


def test_confirmed_where_the_second_renderer_fails_too(case: GradingInput) -> None:
    (one,) = graded(case, position_renderer(case)).lost.values()
    assert one.grade is Grade.CONFIRMED
    assert one.second is not None
    assert (one.second.by, one.second.before, one.second.after) == ("second", 4, 4)


def test_not_confirmed_where_it_does_not(case: GradingInput) -> None:
    (one,) = graded(case, position_renderer(case, honest=False)).lost.values()
    assert one.grade is Grade.CERTAIN
    assert one.second is not None
    assert one.second.after == 0


def test_shared_where_the_peer_loses_it_too(case: GradingInput) -> None:
    assert graded(case, position_renderer(case), Oracle()).lost[CAR].grade is Grade.SHARED
    fault = graded(case, position_renderer(case), Oracle(blind=False)).lost[CAR]
    assert fault.grade is Grade.CONFIRMED
    assert fault.peer is not None
    assert (fault.peer.before, fault.peer.after, fault.peer.placebo) == (4, 0, None)


def test_the_peer_is_counted_without_the_change_and_after_a_placebo_where_that_decides(case: GradingInput) -> None:
    """A placebo that makes the peer fail too leaves the failure unshared, and the numbers show it."""
    under_placebo = dataclasses.replace(case, placebo=lambda: case.changed)
    for one, placebo, grade in ((case, 4, Grade.SHARED), (under_placebo, 0, Grade.CONFIRMED)):
        fault = graded(one, position_renderer(one), Oracle()).lost[CAR]
        assert fault.peer is not None
        assert (fault.peer.before, fault.peer.after, fault.peer.placebo) == (4, 4, placebo)
        assert fault.grade is grade


@pytest.mark.parametrize(
    ("opinion", "kind", "text"),
    [
        (SecondOpinion("a", 4, 4, 4), "missed", "a agrees: found in 4/4 → 0/4"),
        (SecondOpinion("a", 4, 3, 4, 1), "missed", "a does not agree: found in 4/4 → 1/4; 1/4 after a placebo"),
        (SecondOpinion("a", 0, 4, 4), "missed", "a never found it: 0/4 without the change"),
        (SecondOpinion("a", 0, 4, 4), "background", "a does not agree: there in 4/4 → 4/4"),
    ],
)
def test_an_opinion_as_text(opinion: SecondOpinion, kind: str, text: str) -> None:
    assert opinion.describe(kind) == text


def test_counting_stops_where_enough_cannot_be_reached(case: GradingInput) -> None:
    grader, fault = Grader(Oracle(), 0.5, OFF), Fault(Kind.MISSED, CAR, -1)
    assert grader.count_wrong(case, fault, 4) == 4
    assert grader.count_wrong(dataclasses.replace(case, changed=case.base), fault, 4, 3) == 0


def test_a_missing_second_renderer_is_noted(case: GradingInput) -> None:
    def none(name: str, scene: SceneIR) -> SecondRenderer:
        raise NoSecondRendererError("EGL", "a driver (Debian: libegl1 libgl1-mesa-dri)", "none")

    grades = Grader(Oracle(), 0.5, OFF, make_second_renderer=none).grade(case, LOST)
    assert grades.lost[CAR].grade is Grade.CERTAIN
    assert "libegl1" in grades.notes[0]


def test_what_holds_only_at_the_threshold(case: GradingInput) -> None:
    """The picture that was judged shows it lost, its draws do not."""
    still = dataclasses.replace(case, changed=case.base)
    (one,) = Grader(Oracle(), 0.5, OFF).grade(still, LOST).lost.values()
    assert one.grade is Grade.THRESHOLD
    assert (one.count.after, one.count.after_draws) == (0, 5)


def test_a_failure_of_no_kind_has_no_grade_of_its_own(case: GradingInput) -> None:
    found = dataclasses.replace(case, now=case.benign)
    assert not Grader(Oracle(), 0.5, OFF).grade(found, LOST).lost


def test_samples_before_the_change_are_cached(case: GradingInput) -> None:
    grader = Grader(Oracle(), 0.5, OFF)
    grader.grade(case, LOST)
    rendered: list[SceneIR] = []

    class Counting(PositionRenderer):
        def render(self, changed: SceneIR) -> SecondRender:
            rendered.append(changed)
            return super().render(changed)

    assert isinstance(case.renderer, PositionRenderer)
    grader.grade(dataclasses.replace(case, renderer=Counting(case.renderer.of)), LOST)
    assert len(rendered) == 16
