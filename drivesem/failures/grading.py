"""How sure a failure is: threshold, certain, confirmed, shared; each grade holds what the one before it asks.

threshold: right in one picture and wrong in another (`evaluation.failures`). certain: of a kind that is a failure
(`kinds`), with a certificate. confirmed: a second renderer's pictures of the same draws fail too. shared: so does
a detector of another architecture, which is right under a placebo, a random edit as large.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from detectors.base import Predictor, predict
from drivesem.attack.judging import JudgedClasses, t_star_of
from drivesem.evaluation.failures import Failures
from drivesem.failures.certificate import Camera, Rule, SampleOutcome, certify, has, is_right
from drivesem.failures.grades import SECOND, Agreement, Count, Grade, Kind
from drivesem.failures.kinds import OF_OBJECTS, Fault, View, find
from drivesem.failures.nuisances import Nuisances
from drivesem.failures.second_renderer.base import SecondRenderer
from scene_ir.errors import SceneError
from scene_ir.types import SceneIR

_SECOND_DRAWS = range(SECOND[1])
"""Draws that a second renderer and another detector see."""


@dataclass(frozen=True, slots=True)
class Graded:
    """A fault and how sure it is. second, peer: None where they were not asked."""

    fault: Fault
    grade: Grade
    count: Count
    second: Agreement | None = None
    peer: Agreement | None = None


@dataclass(frozen=True, slots=True)
class Case:
    """A scene before and after a change. renderer: the compositor, as `CompositorDraw`; benign, now: what the
    detector sees in the two pictures that were judged; placebo: the scene after a
    random edit as large as the change, made when it is asked for.
    """

    identifier: str
    base: SceneIR
    changed: SceneIR
    renderer: SecondRenderer
    benign: View
    now: View
    placebo: Callable[[], SceneIR] | None = None


@dataclass(frozen=True, slots=True)
class Grades:
    """Of one case. lost, phantoms: by target and by detection, those of today's failures that are one of a kind;
    what is missing here is none. notes: why a
    grade could not be reached.
    """

    lost: Mapping[int, Graded]
    phantoms: Mapping[int, Graded]
    notes: tuple[str, ...] = ()


@dataclass
class Grader:
    """Grades failures of one detector. seed: of the draws; second: makes the second renderer of a scene by its
    frame's name, and raises SceneError where it cannot; peer: loads the other detector; witness: of other makes,
    whose objects in the photograph are no phantoms'. None leaves the question out.
    """

    detector: Predictor
    t_star: float
    nuisances: Nuisances = field(default_factory=Nuisances)
    rule: Rule = field(default_factory=Rule)
    seed: int = 0
    second: Callable[[str, SceneIR], SecondRenderer] | None = None
    peer: Callable[[], Predictor] | None = None
    witness: Callable[[Tensor], Tensor] | None = None
    _kept: tuple[Tensor, dict[tuple[str, int], SampleOutcome]] | None = None

    def faults(self, case: Case, failures: Failures) -> tuple[Fault, ...]:
        """Those failures by threshold that are of a kind, in the order of `kinds.find`."""
        if not failures.success:
            return ()
        seen = self.witness(case.base.photograph) if self.witness is not None and failures.phantoms else None
        lost, phantoms = set(failures.lost), set(failures.phantoms)
        return tuple(
            fault
            for fault in find(case.benign, case.now, self.t_star, seen)
            if (fault.target in lost if fault.kind in OF_OBJECTS else fault.detection in phantoms)
        )

    def grade(self, case: Case, failures: Failures) -> Grades:
        """Grade what fails by threshold. The same case gives the same grades."""
        faults = self.faults(case, failures)
        graded, notes = self._graded(case, faults)
        return Grades(
            {one.fault.target: one for one in graded if one.fault.kind in OF_OBJECTS},
            {one.fault.detection: one for one in graded if one.fault.kind not in OF_OBJECTS},
            notes,
        )

    def certificates(self, case: Case, faults: tuple[Fault, ...]) -> tuple[Count, ...]:
        """Of faults, by draws of the case's own renderer."""
        camera = self._camera(case, case.renderer, self.detector, self.t_star)

        def before(number: int) -> SampleOutcome:
            return self._before(case, camera, number)

        def after(number: int) -> SampleOutcome:
            return _after(case, camera, number)

        return certify(faults, _places(case, faults), before, after, self.rule)

    def _before(self, case: Case, camera: Camera, number: int) -> SampleOutcome:
        """The number-th look at the scene before the change. Kept as long as the frame stays: attacks on it differ
        in what comes after.
        """
        labels = case.base.objects.box2d  # no change touches them
        if self._kept is None or self._kept[0] is not labels:
            self._kept = (labels, {})
        kept, key = self._kept[1], (camera.stream, number)
        if key not in kept:
            kept[key] = _look(case.base, case.benign, camera, number)
        return kept[key]

    def _graded(self, case: Case, faults: tuple[Fault, ...]) -> tuple[list[Graded], tuple[str, ...]]:
        counts = self.certificates(case, faults)
        graded = [
            Graded(fault, Grade.CERTAIN if self.rule.holds(count) else Grade.THRESHOLD, count)
            for fault, count in zip(faults, counts, strict=True)
        ]
        certain = [g for g in graded if g.grade is Grade.CERTAIN]
        if not certain or self.second is None:
            return graded, ()
        try:
            renderer = self.second(case.identifier, case.changed)
            camera = self._camera(case, renderer, self.detector, self.t_star, "second")
            before = [self._before(case, camera, number) for number in _SECOND_DRAWS]
            second = _agreements(case, camera, [g.fault for g in certain], before, renderer.name)
        except SceneError as error:
            return graded, (f"no second renderer: expected {error.expected}, found {error.actual}",)
        confirmed = [fault for fault, agreement in second.items() if agreement.agrees]
        peers: Mapping[Fault, Agreement] = {}
        if confirmed and self.peer is not None and case.placebo is not None:
            peer = self.peer()
            camera = self._camera(case, case.renderer, peer, t_star_of(peer), "peer")
            placebo = case.placebo()
            before = [_look(placebo, case.benign, camera, number) for number in _SECOND_DRAWS]
            peers = _agreements(case, camera, confirmed, before, peer.name)

        def told(g: Graded) -> Graded:
            by_second, by_peer = second.get(g.fault), peers.get(g.fault)
            grade = g.grade
            if by_second is not None and by_second.agrees:
                grade = Grade.SHARED if by_peer is not None and by_peer.agrees else Grade.CONFIRMED
            return Graded(g.fault, grade, g.count, by_second, by_peer)

        return [told(g) for g in graded], ()

    def _camera(
        self, case: Case, renderer: SecondRenderer, detector: Predictor, t_star: float, which: str = "certificate"
    ) -> Camera:
        return Camera(renderer, detector, t_star, self.nuisances, f"{which}:{case.identifier}:{self.seed}")


def _look(state: SceneIR, view: View, camera: Camera, number: int) -> SampleOutcome:
    """view: says which of the scene's objects are not judged in that state."""
    return camera.look(state, number, view.targets.ignore[: len(state.objects)])


def _after(case: Case, camera: Camera, number: int) -> SampleOutcome:
    return _look(case.changed, case.now, camera, number)


def _agreements(
    case: Case, camera: Camera, faults: list[Fault], before: list[SampleOutcome], name: str
) -> dict[Fault, Agreement]:
    """What a camera says of faults. before: its looks at the state in which all is to be right."""
    places = _places(case, tuple(faults))
    after = [_after(case, camera, number) for number in _SECOND_DRAWS]
    return {
        fault: Agreement(
            name,
            sum(is_right(fault, place, look) for look in before),
            sum(has(fault, place, look) for look in after),
            len(after),
        )
        for fault, place in zip(faults, places, strict=True)
    }


def _places(case: Case, faults: tuple[Fault, ...]) -> Tensor:
    """Where faults are, (F, 4) px of the changed picture: the object's label, or the detection."""
    boxes_xyxy = [
        case.now.detections.boxes_xyxy[fault.detection]
        if fault.kind is Kind.BACKGROUND
        else case.now.targets.boxes_xyxy[fault.target]
        for fault in faults
    ]
    return torch.stack(boxes_xyxy) if boxes_xyxy else case.now.targets.boxes_xyxy[:0]


def witness_of(detector: Predictor) -> Callable[[Tensor], Tensor]:
    """Where a detector sees an object of any class in a photograph (3, H, W): boxes (K, 4) px, from its t* on.

    Raises DetectorError where it knows no cars.
    """
    JudgedClasses.of(detector)
    t_star = t_star_of(detector)

    def seen(photograph: Tensor) -> Tensor:
        detections = predict(detector, photograph[None])[0]
        return detections.boxes_xyxy[detections.scores >= t_star]

    return seen
