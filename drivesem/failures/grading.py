"""Grades: how certain a failure is. Each grade includes the requirements of the previous one.

threshold: right in one image and wrong in another (`evaluation.failures`). certain: one of the kinds in `kinds`, with
a certificate, in a picture that is trusted (`fidelity`). confirmed: it also occurs in a second renderer's images of
other samples (`SecondOpinion.agrees`). shared: it also occurs with a detector of another architecture, which is right
without the change and under a placebo, a random edit of the same size.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from detectors.base import Predictor, predict
from drivesem.attacks.targets import EvaluatedClasses, resolve_t_star
from drivesem.evaluation.failures import FrameFailures
from drivesem.failures.certificate import (
    CertificateRule,
    NuisanceCamera,
    SampleOutcome,
    certify,
    is_correct,
    shows_fault,
)
from drivesem.failures.fidelity import ObjectFidelity, lowest_fidelity, measure_fidelity
from drivesem.failures.grades import AGREEMENT_RULE, Certificate, Grade, Kind, SecondOpinion
from drivesem.failures.kinds import OBJECT_KINDS, Fault, LabelledDetections, find_faults
from drivesem.failures.nuisances import Nuisances
from drivesem.failures.second_renderer.base import SecondRenderer
from scene_ir.errors import SceneError
from scene_ir.render.compositor import Compositor
from scene_ir.types import SceneIR

_OPINION_SAMPLES = range(AGREEMENT_RULE[1])
"""Samples that a second renderer and a second detector see."""


@dataclass(frozen=True, slots=True)
class GradedFault:
    """A fault, its grade, and the evidence for it."""

    fault: Fault
    """The failure."""
    grade: Grade
    """Its grade."""
    count: Certificate
    """Its certificate."""
    second: SecondOpinion | None = None
    """Opinion of a second renderer; None where there was none."""
    peer: SecondOpinion | None = None
    """Opinion of a second detector; None where there was none."""
    fidelity: ObjectFidelity | None = None
    """Lowest fidelity of the edited objects in its place; None where there is none."""


@dataclass(frozen=True, slots=True)
class GradingInput:
    """A scene before and after a change, and what the detector reports in both images."""

    identifier: str
    """Name of the frame."""
    base: SceneIR
    """Scene before the change."""
    changed: SceneIR
    """Scene after it."""
    renderer: SecondRenderer
    """The compositor, as a `CompositorRenderer`."""
    benign: LabelledDetections
    """Labels and detections before the change."""
    now: LabelledDetections
    """Labels and detections after it."""
    compositor: Compositor
    """The compositor of the scene."""
    placebo: Callable[[], SceneIR] | None = None
    """Makes the scene after a random edit of the same size as the change."""


@dataclass(frozen=True, slots=True)
class FrameGrades:
    """Grades of one frame's failures; failures by threshold that are none of the kinds are missing."""

    lost: Mapping[int, GradedFault]
    """Faults of objects, by target."""
    phantoms: Mapping[int, GradedFault]
    """Other faults, by detection."""
    notes: tuple[str, ...] = ()
    """Why a grade could not be reached."""


@dataclass
class Grader:
    """Grades the failures of one detector."""

    detector: Predictor
    """The detector."""
    t_star: float
    """Its score threshold."""
    nuisances: Nuisances = field(default_factory=Nuisances)
    """Ranges of the samples."""
    rule: CertificateRule = field(default_factory=CertificateRule)
    """How many samples make a certificate."""
    seed: int = 0
    """Seed of the samples."""
    make_second_renderer: Callable[[str, SceneIR], SecondRenderer] | None = None
    """Makes a scene's second renderer, or raises SceneError; None stops at *certain*."""
    load_second_detector: Callable[[], Predictor] | None = None
    """Loads the second detector; None stops at *confirmed*."""
    reference_detector: Callable[[Tensor], Tensor] | None = None
    """Boxes of the objects in the photograph, which are no phantoms; see `make_reference_detector`."""
    _unchanged_outcomes: tuple[Tensor, dict[tuple[str, int], SampleOutcome]] | None = None
    """Cache of outcomes before the change: the frame's labels, and outcomes by stream and number."""

    def faults(self, case: GradingInput, failures: FrameFailures) -> tuple[Fault, ...]:
        """Those failures by threshold that are of a kind, in the order of `kinds.find_faults`."""
        if not failures.success:
            return ()
        reference_xyxy = None
        if self.reference_detector is not None and failures.phantoms:
            reference_xyxy = self.reference_detector(case.base.photograph)
        lost, phantoms = set(failures.lost), set(failures.phantoms)
        return tuple(
            fault
            for fault in find_faults(case.benign, case.now, self.t_star, reference_xyxy)
            if (fault.target in lost if fault.kind in OBJECT_KINDS else fault.detection in phantoms)
        )

    def grade(self, case: GradingInput, failures: FrameFailures) -> FrameGrades:
        """Grade the failures by threshold of one frame; deterministic."""
        graded, notes = self._grade_faults(case, self.faults(case, failures))
        return FrameGrades(
            {one.fault.target: one for one in graded if one.fault.kind in OBJECT_KINDS},
            {one.fault.detection: one for one in graded if one.fault.kind not in OBJECT_KINDS},
            notes,
        )

    def certificates(self, case: GradingInput, faults: tuple[Fault, ...]) -> tuple[Certificate, ...]:
        """Certify faults on samples by the frame's own renderer."""
        camera = self._make_camera(case, case.renderer, self.detector, self.t_star)
        outcomes: dict[int, SampleOutcome] = {}

        def after(number: int) -> SampleOutcome:
            if number not in outcomes:
                outcomes.update(
                    _evaluate_states(case.changed, case.now, camera, self._numbers_with(case, camera, number))
                )
            return outcomes[number]

        return certify(
            faults,
            _fault_boxes(case, faults),
            lambda number: self._evaluate_unchanged(case, camera, number),
            after,
            self.rule,
        )

    def _numbers_with(self, case: GradingInput, camera: NuisanceCamera, number: int) -> Sequence[int]:
        """The samples to evaluate when one is wanted: all of a certificate where they are drawn together, else that
        one, as early ones may decide.
        """
        together = camera.draws_together(case.base) and number < self.rule.draws
        return range(self.rule.draws) if together else [number]

    def count_wrong(self, case: GradingInput, fault: Fault, draws: int, enough: int = 0) -> int:
        """Count the samples that show a fault after the change: the first of its certificate's, by the same rule.

        Args:
            case: The scene before and after the change.
            fault: The fault.
            draws: Number of samples.
            enough: Stop as soon as this many can no longer be reached.
        """
        camera = self._make_camera(case, case.renderer, self.detector, self.t_star)
        (place,) = _fault_boxes(case, (fault,))
        wrong = 0
        for number in range(draws):
            if wrong + draws - number < enough:
                break
            (outcome,) = _evaluate_states(case.changed, case.now, camera, [number]).values()
            wrong += shows_fault(fault, place, outcome)
        return wrong

    def second_opinions(self, case: GradingInput, faults: Sequence[Fault]) -> dict[Fault, SecondOpinion]:
        """Count how often faults occur in a second renderer's images: what makes a failure confirmed.

        Raises SceneError where there is no second renderer of the scene.
        """
        if not faults or self.make_second_renderer is None:
            return {}
        renderer = self.make_second_renderer(case.identifier, case.changed)
        camera = self._make_camera(case, renderer, self.detector, self.t_star, "second")
        before = [self._evaluate_unchanged(case, camera, number) for number in _OPINION_SAMPLES]
        return _second_opinions(case, camera, faults, before, renderer.name)

    def _peer_opinions(self, case: GradingInput, faults: Sequence[Fault]) -> dict[Fault, SecondOpinion]:
        """Count how often faults occur with the second detector; under a placebo only where that decides."""
        if not faults or self.load_second_detector is None or case.placebo is None:
            return {}
        peer = self.load_second_detector()
        camera = self._make_camera(case, case.renderer, peer, resolve_t_star(peer), "peer")
        before = [*_evaluate_states(case.base, case.benign, camera, _OPINION_SAMPLES).values()]
        opinions = _second_opinions(case, camera, faults, before, peer.name)
        agreeing = [fault for fault in faults if opinions[fault].agrees]
        if agreeing:
            edited = case.placebo()
            samples = [*_evaluate_states(edited, case.benign, camera, _OPINION_SAMPLES).values()]
            for fault in agreeing:
                opinions[fault] = replace(opinions[fault], placebo=_count_right(case, fault, samples))
        return opinions

    def _evaluate_unchanged(self, case: GradingInput, camera: NuisanceCamera, number: int) -> SampleOutcome:
        """Evaluate a sample of the scene before the change; cached while the frame stays the same, as attacks on
        it differ only in what comes after.
        """
        labels = case.base.objects.box2d  # no change touches them
        if self._unchanged_outcomes is None or self._unchanged_outcomes[0] is not labels:
            self._unchanged_outcomes = (labels, {})
        cache, key = self._unchanged_outcomes[1], (camera.stream, number)
        if key not in cache:
            found = _evaluate_states(case.base, case.benign, camera, self._numbers_with(case, camera, number))
            cache.update({(camera.stream, one): outcome for one, outcome in found.items()})
        return cache[key]

    def _grade_faults(
        self, case: GradingInput, faults: tuple[Fault, ...]
    ) -> tuple[list[GradedFault], tuple[str, ...]]:
        certificates = self.certificates(case, faults)
        graded = [
            GradedFault(fault, self._grade_without_opinions(certificate, fidelity), certificate, fidelity=fidelity)
            for fault, certificate, fidelity in zip(faults, certificates, _fidelities(case, faults), strict=True)
        ]
        certain = [one.fault for one in graded if one.grade is Grade.CERTAIN]
        try:
            second = self.second_opinions(case, certain)
        except SceneError as error:
            return graded, (f"no second renderer: expected {error.expected}, found {error.actual}",)
        peers = self._peer_opinions(case, [fault for fault, opinion in second.items() if opinion.agrees])

        def add_opinions(one: GradedFault) -> GradedFault:
            by_renderer, by_detector = second.get(one.fault), peers.get(one.fault)
            grade = one.grade
            if by_renderer is not None and by_renderer.agrees:
                grade = Grade.SHARED if by_detector is not None and by_detector.agrees else Grade.CONFIRMED
            return replace(one, grade=grade, second=by_renderer, peer=by_detector)

        return [add_opinions(one) for one in graded], ()

    def _grade_without_opinions(self, certificate: Certificate, fidelity: ObjectFidelity | None) -> Grade:
        is_trusted = fidelity is None or fidelity.is_trusted
        return Grade.CERTAIN if is_trusted and self.rule.holds(certificate) else Grade.THRESHOLD

    def _make_camera(
        self,
        case: GradingInput,
        renderer: SecondRenderer,
        detector: Predictor,
        t_star: float,
        purpose: str = "certificate",
    ) -> NuisanceCamera:
        stream = f"{purpose}:{case.identifier}:{self.seed}"
        return NuisanceCamera(renderer, detector, t_star, self.nuisances, stream)


def _evaluate_states(
    state: SceneIR, labelled: LabelledDetections, camera: NuisanceCamera, numbers: Sequence[int]
) -> dict[int, SampleOutcome]:
    """Outcomes of a state's samples by number; `labelled` names the objects that are ignored in it."""
    ignore = labelled.targets.ignore[: len(state.objects)]
    return dict(zip(numbers, camera.evaluate_all(state, numbers, ignore), strict=True))


def _second_opinions(
    case: GradingInput, camera: NuisanceCamera, faults: Sequence[Fault], before: list[SampleOutcome], name: str
) -> dict[Fault, SecondOpinion]:
    """Count how often faults occur with a camera. before: samples of the unchanged scene."""
    places = _fault_boxes(case, tuple(faults))
    after = [*_evaluate_states(case.changed, case.now, camera, _OPINION_SAMPLES).values()]
    return {
        fault: SecondOpinion(
            name,
            _count_right(case, fault, before),
            sum(shows_fault(fault, place, outcome) for outcome in after),
            len(after),
        )
        for fault, place in zip(faults, places, strict=True)
    }


def _count_right(case: GradingInput, fault: Fault, samples: Sequence[SampleOutcome]) -> int:
    """Count the samples that are right where a fault may occur."""
    (place,) = _fault_boxes(case, (fault,))
    return sum(is_correct(fault, place, outcome) for outcome in samples)


def _fidelities(case: GradingInput, faults: tuple[Fault, ...]) -> list[ObjectFidelity | None]:
    """The lowest fidelity of the edited objects in the place of each fault."""
    if not faults:
        return []
    regions = measure_fidelity(case.compositor, case.changed)
    return [lowest_fidelity(regions, place) for place in _fault_boxes(case, faults).tolist()]


def _fault_boxes(case: GradingInput, faults: tuple[Fault, ...]) -> Tensor:
    """(F, 4) px in the changed image: the object's label, or the detection on background."""
    boxes_xyxy = [
        case.now.detections.boxes_xyxy[fault.detection]
        if fault.kind is Kind.BACKGROUND
        else case.now.targets.boxes_xyxy[fault.target]
        for fault in faults
    ]
    return torch.stack(boxes_xyxy) if boxes_xyxy else case.now.targets.boxes_xyxy[:0]


def make_reference_detector(detector: Predictor) -> Callable[[Tensor], Tensor]:
    """Make a function from a photograph (3, H, W) to the boxes (K, 4) px of all objects that a detector sees in
    it.

    Raises:
        DetectorError: The detector knows no cars.
    """
    EvaluatedClasses.from_detector(detector)
    t_star = resolve_t_star(detector)

    def detect(photograph: Tensor) -> Tensor:
        detections = predict(detector, photograph[None])[0]
        return detections.boxes_xyxy[detections.scores >= t_star]

    return detect
