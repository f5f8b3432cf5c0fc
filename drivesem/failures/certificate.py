"""Certificates: whether a failure persists when the same scene is photographed again and again.

A fault is evaluated in nuisance samples that no search has seen. It is certain where the object is right in at
least 15 of 16 samples before the change and wrong in at least 12 of 16 after it: the 95 % Wilson interval of 12 of
16 begins above one half.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from detectors import boxes
from detectors.base import Predictor, predict
from detectors.types import Detections, Targets
from drivesem.attacks import losses
from drivesem.attacks.labels import Labeller, visible_boxes
from drivesem.attacks.targets import EvaluatedClasses
from drivesem.config.options import MIN_DRAWS
from drivesem.failures import margins as margin
from drivesem.failures.grades import Certificate, Kind
from drivesem.failures.kinds import (
    OBJECT_KINDS,
    SAME_PLACE_IOU,
    DetectionOutcome,
    Fault,
    LabelledDetections,
    match_detections,
)
from drivesem.failures.nuisances import Nuisances, NuisanceSample
from drivesem.failures.second_renderer.base import SecondRender, SecondRenderer
from scene_ir.errors import RangeError
from scene_ir.io import round_to_8bit
from scene_ir.render.compositor import Compositor, render_batch
from scene_ir.types import SceneIR


@dataclass(frozen=True, slots=True)
class CertificateRule:
    """How many samples must be right before the change, and wrong after it. RangeError for too few samples."""

    draws: int = MIN_DRAWS
    """Samples of either state."""
    right_before: float = 15 / 16
    """Minimum share of samples that are right before the change."""
    wrong_after: float = 12 / 16
    """Minimum share of samples that are wrong after it."""

    def __post_init__(self) -> None:
        if self.draws < MIN_DRAWS:
            raise RangeError("draws", f"at least {MIN_DRAWS}, which a certificate's rule needs", self.draws)

    @property
    def before(self) -> int:
        """Samples that must be right before the change."""
        return math.ceil(self.right_before * self.draws)

    @property
    def after(self) -> int:
        """Samples that must be wrong after it."""
        return math.ceil(self.wrong_after * self.draws)

    def holds(self, certificate: Certificate) -> bool:
        """Whether a fault with this certificate is certain."""
        return certificate.before >= self.before and certificate.after >= self.after


@dataclass(frozen=True, slots=True)
class SampleOutcome:
    """Detections in one nuisance sample of one state."""

    labelled: LabelledDetections
    """Labels and detections of the image."""
    outcome: DetectionOutcome
    """Both matched at `threshold`."""
    threshold: float
    """The detector's t*."""
    sample: NuisanceSample
    """The sample."""
    num_classes: int
    """Number of evaluated classes."""


@dataclass(frozen=True, slots=True)
class SampleImage:
    """The image of one nuisance sample of one state."""

    image: Tensor
    """(3, H, W) RGB in [0, 1]."""
    targets: Targets
    """Labels among `CLASSES`."""
    visible_xyxy: Tensor
    """(N, 4) px, boxes of the visible parts of the objects."""
    sample: NuisanceSample
    """The sample."""


@dataclass(frozen=True, slots=True)
class CompositorRenderer:
    """The first renderer behind the interface of the second ones: the compositor's images, labels that moved."""

    compositor: Compositor
    """Compositor of the scene."""
    labeller: Labeller
    """Its labeller."""

    @property
    def name(self) -> str:
        return "compositor"

    def unsupported_changes(self, changed: SceneIR) -> tuple[str, ...]:
        """Nothing: the compositor renders every change."""
        del changed
        return ()

    def render(self, changed: SceneIR) -> SecondRender:
        """Render a state of the scene as an image file would hold it."""
        return self.render_all([changed])[0]

    @torch.no_grad()
    def render_all(self, changed: Sequence[SceneIR]) -> list[SecondRender]:
        """Render states of the scene, their objects drawn at once."""
        renders = render_batch([(self.compositor, state) for state in changed])
        labels = (self.labeller.moved(state, render) for state, render in zip(changed, renders, strict=True))
        return [
            SecondRender(round_to_8bit(render.image), moved.targets, visible_boxes(render))
            for moved, render in zip(labels, renders, strict=True)
        ]


@dataclass(frozen=True)
class NuisanceCamera:
    """Renders states of one scene in nuisance samples and runs a detector on them."""

    renderer: SecondRenderer
    """What renders the scene."""
    detector: Predictor
    """What is evaluated."""
    t_star: float
    """Its score threshold."""
    nuisances: Nuisances
    """Ranges of the samples."""
    stream: str
    """Name of the sample stream; a sample follows from it and its number alone."""

    def evaluate(self, state: SceneIR, number: int, ignore: Tensor) -> SampleOutcome:
        """Render a state in a nuisance sample and run the detector on it.

        Args:
            state: State of the scene.
            number: Number of the sample in the stream.
            ignore: (N,) bool, objects that are ignored in addition.
        """
        return self.detect(self.render(state, number, ignore))

    def draws_together(self, state: SceneIR) -> bool:
        """Whether `evaluate_all` renders and detects samples of a state at once."""
        return state.photograph.is_cuda and isinstance(self.renderer, CompositorRenderer)

    @torch.no_grad()
    def evaluate_all(self, state: SceneIR, numbers: Sequence[int], ignore: Tensor) -> list[SampleOutcome]:
        """Evaluate a state in several nuisance samples; arguments as of `evaluate`. On a GPU they are rendered and
        detected together, which takes little longer than one; on a CPU a picture then costs as much as alone.
        """
        if not (self.draws_together(state) and isinstance(self.renderer, CompositorRenderer)):
            return [self.evaluate(state, number, ignore) for number in numbers]
        samples = [self.nuisances.sample(self.stream, number, state) for number in numbers]
        renders = self.renderer.render_all([sample.perturb_scene(state) for sample in samples])
        images = [self._degrade(*pair, ignore) for pair in zip(samples, renders, strict=True)]
        found = predict(self.detector, torch.stack([one.image for one in images]))
        return [self._match(one, detections) for one, detections in zip(images, found, strict=True)]

    @torch.no_grad()
    def render(self, state: SceneIR, number: int, ignore: Tensor) -> SampleImage:
        """Render a state in a nuisance sample.

        Args:
            state: State of the scene.
            number: Number of the sample in the stream.
            ignore: (N,) bool, objects that are ignored in addition.
        """
        sample = self.nuisances.sample(self.stream, number, state)
        return self._degrade(sample, self.renderer.render(sample.perturb_scene(state)), ignore)

    def _degrade(self, sample: NuisanceSample, render: SecondRender, ignore: Tensor) -> SampleImage:
        """The image of a sample from its render."""
        truth, visible, count = render.targets, render.visible_xyxy, len(ignore)
        ignored = torch.cat([truth.ignore[:count] | ignore.to(truth.ignore), truth.ignore[count:]])
        is_visible = boxes.area(visible)[:, None] > 0
        visible = torch.where(is_visible, sample.transform_boxes(visible), torch.zeros_like(visible))
        targets = Targets(sample.transform_boxes(truth.boxes_xyxy), truth.labels, ignored)
        image = sample.degrade_image(render.image)
        sample.noise_field.release()  # outcomes are cached for a whole frame, and none needs the noise again
        return SampleImage(image, targets, visible, sample)

    @torch.no_grad()
    def detect(self, rendered: SampleImage) -> SampleOutcome:
        """Run the detector on a rendered sample and match its detections."""
        return self._match(rendered, predict(self.detector, rendered.image[None])[0])

    def _match(self, rendered: SampleImage, found: Detections) -> SampleOutcome:
        """Match the detections found in a rendered sample."""
        classes = EvaluatedClasses.from_detector(self.detector)
        targets, detections = classes.map_targets(rendered.targets), classes.map_detections(found)
        labelled = LabelledDetections(targets, pad_visible_boxes(rendered.visible_xyxy, targets), detections)
        outcome = match_detections(labelled, self.t_star)
        return SampleOutcome(labelled, outcome, self.t_star, rendered.sample, len(classes.names))


def pad_visible_boxes(visible_xyxy: Tensor, targets: Targets) -> Tensor:
    """Append zeros to the objects' visible boxes (N, 4), one row for each further target (M, 4)."""
    return torch.cat([visible_xyxy, visible_xyxy.new_zeros(len(targets) - len(visible_xyxy), 4)])


SampleVerdict = tuple[bool, float | None]
"""Whether a fault occurs in a sample after the change, or is absent before it; and its margin."""


def certify(
    faults: Sequence[Fault],
    places_xyxy: Tensor,
    before: Callable[[int], SampleOutcome],
    after: Callable[[int], SampleOutcome],
    rule: CertificateRule,
) -> tuple[Certificate, ...]:
    """Certify faults on shared samples, at most `rule.draws` of either state.

    Args:
        faults: F faults.
        places_xyxy: (F, 4) px, their places in the image without nuisances; used for background faults.
        before: Number of a sample -> its outcome before the change.
        after: The same after it.
        rule: How many samples decide.
    """

    def judge_sample(changed: bool, number: int, rows: Sequence[int]) -> list[SampleVerdict]:
        outcome, check = (after(number), shows_fault) if changed else (before(number), is_correct)
        cases = [(faults[row], places_xyxy[row], outcome) for row in rows]
        return [(check(*case), fault_margin(*case)) for case in cases]

    return count_samples(len(faults), judge_sample, rule)


def count_samples(
    count: int,
    judge_sample: Callable[[bool, int, Sequence[int]], Sequence[SampleVerdict]],
    rule: CertificateRule,
) -> tuple[Certificate, ...]:
    """Judge samples until no more can change whether a fault is certain: first after the change, then before it
    for the faults that still may be.

    Args:
        count: Number of faults.
        judge_sample: Whether after the change, number of the sample, rows of the faults -> their verdicts.
        rule: How many samples decide.
    """
    wrong: list[list[SampleVerdict]] = [[] for _ in range(count)]
    right: list[list[SampleVerdict]] = [[] for _ in range(count)]
    for verdicts, changed, needed in ((wrong, True, rule.after), (right, False, rule.before)):
        rows = [row for row in range(count) if changed or _count_true(wrong[row]) >= rule.after]
        for number in range(rule.draws):
            if all(len(verdicts[row]) - _count_true(verdicts[row]) > rule.draws - needed for row in rows):
                break
            for row, verdict in zip(rows, judge_sample(changed, number, rows), strict=True):
                verdicts[row].append(verdict)
    return tuple(
        Certificate(_count_true(r), len(r), _count_true(w), len(w), _mean_margin(r), _mean_margin(w))
        for r, w in zip(right, wrong, strict=True)
    )


def shows_fault(fault: Fault, place_xyxy: Tensor, outcome: SampleOutcome) -> bool:
    """Whether a sample shows a fault. An object that the sample hides, or makes too small or faint, is not missed.

    Args:
        fault: The fault.
        place_xyxy: (4,) px, where a background fault is.
        outcome: The sample.
    """
    if fault.kind in OBJECT_KINDS:
        ignored = outcome.labelled.targets.ignore[fault.target]
        return not bool(outcome.outcome.detected[fault.target] | ignored)
    if fault.kind is Kind.TWICE:
        return fault.target in outcome.outcome.duplicates
    background = outcome.labelled.detections.boxes_xyxy[list(outcome.outcome.background)]
    return _overlaps_place(place_xyxy, outcome, background)


def is_correct(fault: Fault, place_xyxy: Tensor, outcome: SampleOutcome) -> bool:
    """Whether a sample is right where the fault may occur: the object detected once, or nothing at its place.

    Args:
        fault: The fault.
        place_xyxy: (4,) px, where a background fault is.
        outcome: The sample.
    """
    if fault.kind is Kind.BACKGROUND:
        detections = outcome.labelled.detections
        confident = detections.boxes_xyxy[detections.scores >= outcome.threshold]
        return not _overlaps_place(place_xyxy, outcome, confident)
    detected = bool(outcome.outcome.detected[fault.target])
    return detected and (fault.kind is not Kind.TWICE or fault.target not in outcome.outcome.duplicates)


def fault_margin(fault: Fault, place_xyxy: Tensor, outcome: SampleOutcome) -> float | None:
    """Compute a fault's margin in a sample from the detections after suppression.

    Args:
        fault: The fault.
        place_xyxy: (4,) px, where a background fault is.
        outcome: The sample.

    Returns:
        Logits; None for duplicates.
    """
    if fault.kind is Kind.TWICE:
        return None
    labelled = outcome.labelled
    candidates = losses.candidates_from_detections(labelled.detections, outcome.num_classes)
    if fault.kind is Kind.BACKGROUND:
        place = outcome.sample.transform_boxes(place_xyxy[None])
        return float(margin.place_margins(candidates, place, outcome.threshold)[0])
    row = slice(fault.target, fault.target + 1)
    box, label = labelled.targets.boxes_xyxy[row], labelled.targets.labels[row]
    return float(margin.object_margins(candidates, box, label, labelled.visible_xyxy[row], outcome.threshold)[0])


def _overlaps_place(place_xyxy: Tensor, outcome: SampleOutcome, boxes_xyxy: Tensor) -> bool:
    place = outcome.sample.transform_boxes(place_xyxy[None]).to(boxes_xyxy)
    return bool((boxes.iou_matrix(place, boxes_xyxy)[0] >= SAME_PLACE_IOU).any())


def _count_true(verdicts: Sequence[SampleVerdict]) -> int:
    return sum(holds for holds, _ in verdicts)


def _mean_margin(verdicts: Sequence[SampleVerdict]) -> float | None:
    margins = [margin for _, margin in verdicts if margin is not None]
    return round(sum(margins) / len(margins), 4) if margins else None
