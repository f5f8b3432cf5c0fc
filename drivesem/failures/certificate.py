"""Certificates: does a failure hold when the same scene is photographed again and again?

A fault is looked at in draws of `nuisances` that no search has seen. It is certain where all is right in at least
15 of 16 draws of the scene before the change, and wrong in at least 12 of 16 after it: the Wilson interval (95 %)
of 12 of 16 begins above one half.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from detectors import boxes
from detectors.base import Predictor, predict
from detectors.types import Targets
from drivesem.attack import goals
from drivesem.attack.judging import JudgedClasses
from drivesem.config.blocks import CERTIFYING_DRAWS
from drivesem.failures import margin
from drivesem.failures.grades import Count, Kind
from drivesem.failures.kinds import OF_OBJECTS, SAME_PLACE, Fault, Judged, View, judge
from drivesem.failures.nuisances import Draw, Nuisances
from drivesem.failures.second_renderer.base import SecondRenderer
from scene_ir.errors import RangeError
from scene_ir.types import SceneIR


@dataclass(frozen=True, slots=True)
class Rule:
    """Of `draws` draws before the change, and as many after it, how many must be right, and wrong. RangeError for
    fewer draws than that needs.
    """

    draws: int = CERTIFYING_DRAWS
    right_before: float = 15 / 16
    wrong_after: float = 12 / 16

    def __post_init__(self) -> None:
        if self.draws < CERTIFYING_DRAWS:
            raise RangeError("draws", f"at least {CERTIFYING_DRAWS}, which a certificate's rule needs", self.draws)

    @property
    def before(self) -> int:
        return math.ceil(self.right_before * self.draws)

    @property
    def after(self) -> int:
        return math.ceil(self.wrong_after * self.draws)

    def holds(self, count: Count) -> bool:
        """Whether a fault with these draws is certain."""
        return count.before >= self.before and count.after >= self.after


@dataclass(frozen=True, slots=True)
class SampleOutcome:
    """One draw of one state, as a detector sees it. judged: by `threshold`; classes: how many are judged."""

    view: View
    judged: Judged
    threshold: float
    draw: Draw
    classes: int


@dataclass(frozen=True, slots=True)
class Exposure:
    """One draw of one state as a picture (3, H, W), before a detector sees it. targets: labels among CLASSES;
    shown_xyxy: (N, 4) px, the boxes of what shows of the objects.
    """

    picture: Tensor
    targets: Targets
    shown_xyxy: Tensor
    draw: Draw


@dataclass(frozen=True)
class Camera:
    """Looks at states of one scene through a renderer and a detector. stream: name of the draws, which follow from
    it and their number alone.
    """

    renderer: SecondRenderer
    detector: Predictor
    t_star: float
    nuisances: Nuisances
    stream: str

    def look(self, state: SceneIR, number: int, ignore: Tensor) -> SampleOutcome:
        """The number-th draw of a state. ignore: (N,) bool, the objects that are not judged in it."""
        return self.see(self.expose(state, number, ignore))

    @torch.no_grad()
    def expose(self, state: SceneIR, number: int, ignore: Tensor) -> Exposure:
        """The same, before the detector sees it."""
        draw = self.nuisances.draw(self.stream, number, state)
        redrawn = self.renderer.redraw(draw.scene(state))
        truth, known, count = redrawn.targets, redrawn.shown_xyxy, len(ignore)
        skipped = torch.cat([truth.ignore[:count] | ignore.to(truth.ignore), truth.ignore[count:]])
        shown = torch.where(boxes.area(known)[:, None] > 0, draw.boxes(known), torch.zeros_like(known))
        targets = Targets(draw.boxes(truth.boxes_xyxy), truth.labels, skipped)
        return Exposure(draw.picture(redrawn.image), targets, shown, draw)

    @torch.no_grad()
    def see(self, exposure: Exposure) -> SampleOutcome:
        """What the detector makes of it."""
        judged = JudgedClasses.of(self.detector)
        targets = judged.targets(exposure.targets)
        detections = judged.detections(predict(self.detector, exposure.picture[None])[0])
        view = View(targets, with_regions(exposure.shown_xyxy, targets), detections)
        return SampleOutcome(view, judge(view, self.t_star), self.t_star, exposure.draw, len(judged.names))


def with_regions(shown_xyxy: Tensor, targets: Targets) -> Tensor:
    """Boxes of what shows of the objects (N, 4), as many as there are targets (M, 4): zeros for regions."""
    return torch.cat([shown_xyxy, shown_xyxy.new_zeros(len(targets) - len(shown_xyxy), 4)])


def certify(
    faults: Sequence[Fault],
    places_xyxy: Tensor,
    before: Callable[[int], SampleOutcome],
    after: Callable[[int], SampleOutcome],
    rule: Rule,
) -> tuple[Count, ...]:
    """Count draws for each fault until no more can change whether it is certain: first after the change, then, of
    what still may be, before it.

    places_xyxy: (F, 4) px of each fault, in the picture without a draw; it matters for background. before, after:
    the number-th look at either state. Looks are shared by all faults: at most 2 * rule.draws of them.
    """

    def seen(changed: bool, number: int, asked: Sequence[int]) -> list[Drawn]:
        look, says = (after(number), has) if changed else (before(number), is_right)
        told = [(faults[f], places_xyxy[f], look) for f in asked]
        return [(says(*one), margin_of(*one)) for one in told]

    return count_draws(len(faults), seen, rule)


Drawn = tuple[bool, float | None]
"""Of a fault in a draw: whether it is wrong after the change, or right before it; and its margin."""


def count_draws(
    faults: int, seen: Callable[[bool, int, Sequence[int]], Sequence[Drawn]], rule: Rule
) -> tuple[Count, ...]:
    """The same for so many faults of whatever kind. seen: whether it is after the change, number of the draw, and
    places of the faults that are asked -> each of these.
    """
    wrong: list[list[Drawn]] = [[] for _ in range(faults)]
    right: list[list[Drawn]] = [[] for _ in range(faults)]
    for drawn, changed, needed in ((wrong, True, rule.after), (right, False, rule.before)):
        # What has failed the first half is not asked again.
        asked = [f for f in range(faults) if changed or _held(wrong[f]) >= rule.after]
        for number in range(rule.draws):
            if all(len(drawn[f]) - _held(drawn[f]) > rule.draws - needed for f in asked):
                break
            for f, one in zip(asked, seen(changed, number, asked), strict=True):
                drawn[f].append(one)
    return tuple(
        Count(_held(r), len(r), _held(w), len(w), _mean(r), _mean(w)) for r, w in zip(right, wrong, strict=True)
    )


def _held(draws: Sequence[Drawn]) -> int:
    return sum(holds for holds, _ in draws)


def has(fault: Fault, place_xyxy: Tensor, look: SampleOutcome) -> bool:
    """Whether a look shows this fault: an object that is judged and not found, or reported twice; something on
    nothing there. Where a draw hides an object, or makes it too small or faint to be judged, nothing is missed.
    """
    if fault.kind in OF_OBJECTS:
        return not bool(look.judged.found[fault.target] | look.view.targets.ignore[fault.target])
    if fault.kind is Kind.TWICE:
        return fault.target in look.judged.twice
    at = look.view.detections.boxes_xyxy[list(look.judged.background)]
    return bool((_overlap(place_xyxy, look, at) >= SAME_PLACE).any())


def is_right(fault: Fault, place_xyxy: Tensor, look: SampleOutcome) -> bool:
    """Whether all is right in a look where the fault may be: the object found, once; nothing reported there."""
    if fault.kind is Kind.BACKGROUND:
        at = look.view.detections.boxes_xyxy[look.view.detections.scores >= look.threshold]
        return not bool((_overlap(place_xyxy, look, at) >= SAME_PLACE).any())
    found = bool(look.judged.found[fault.target])
    return found and (fault.kind is not Kind.TWICE or fault.target not in look.judged.twice)


def margin_of(fault: Fault, place_xyxy: Tensor, look: SampleOutcome) -> float | None:
    """The fault's margin in a look, in logits, of what suppression left; None of what is reported twice."""
    if fault.kind is Kind.TWICE:
        return None
    candidates = goals.of_detections(look.view.detections, look.classes)
    if fault.kind is Kind.BACKGROUND:
        return float(margin.of_places(candidates, look.draw.boxes(place_xyxy[None]), look.threshold)[0])
    target, view = slice(fault.target, fault.target + 1), look.view
    box, label = view.targets.boxes_xyxy[target], view.targets.labels[target]
    return float(margin.of_objects(candidates, box, label, view.shown_xyxy[target], look.threshold)[0])


def _overlap(place_xyxy: Tensor, look: SampleOutcome, at_xyxy: Tensor) -> Tensor:
    return boxes.iou_matrix(look.draw.boxes(place_xyxy[None]).to(at_xyxy), at_xyxy)[0]


def _mean(draws: Sequence[Drawn]) -> float | None:
    known = [margin for _, margin in draws if margin is not None]
    return round(sum(known) / len(known), 4) if known else None
