"""Results of a run, as plain dataclasses that are stored as JSON."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from drivesem.data.classes import PEOPLE
from drivesem.evaluation.coco import CocoScores
from drivesem.evaluation.resampling import ClusteredShare, Proportion
from drivesem.failures.feature_cells import CellVisit
from drivesem.failures.fidelity import ObjectFidelity
from drivesem.failures.grades import Certificate, SecondOpinion
from drivesem.reporting.tables import format_count
from drivesem.run.feature_map import FailureMap
from drivesem.run.records import dump_record, load_record
from scene_ir.errors import FormatError

SCHEMA = 3
"""Version of result.json and metrics.json."""


@dataclass(frozen=True, slots=True)
class BoxRecord:
    """One true or detected box."""

    xyxy: tuple[float, float, float, float]
    """Corners, px."""
    label: str
    """Class."""
    score: float | None = None
    """Score of a detection, in [0, 1]."""
    ignore: bool = False
    """Whether a true box counts neither as missed nor as a hit."""
    index: int | None = None
    """Number of the scene's object, if it is one."""


@dataclass(frozen=True, slots=True)
class Coordinate:
    """One coordinate of theta."""

    name: str
    """Such as `objects[3].yaw`."""
    unit: str
    """Unit of the next three."""
    value: float
    """Value."""
    lower: float
    """Lower bound."""
    upper: float
    """Upper bound."""
    display: str
    """Value for people, in metres or degrees."""


@dataclass(frozen=True, slots=True)
class Failure:
    """A failure of the detector that the change causes."""

    kind: str
    """"lost" or "phantom", by threshold."""
    label: str
    """Class."""
    xyxy: tuple[float, float, float, float]
    """True box of a lost object, or the detected box of a phantom, px."""
    index: int | None = None
    """Number of the lost object, or of the one that is reported twice."""
    score: float | None = None
    """Score of a phantom, in [0, 1]."""
    error: str | None = None
    """Kind (`failures.kinds`); None if the object is detected as far as it is visible, or the phantom lies on
    something.
    """
    grade: str | None = None
    """Grade; None if not graded."""
    count: Certificate | None = None
    """Draws of the certificate."""
    second: SecondOpinion | None = None
    """Opinion of a second renderer."""
    peer: SecondOpinion | None = None
    """Opinion of a second detector."""
    fidelity: ObjectFidelity | None = None
    """Lowest fidelity of the edited objects in its box; None if there is none, or the failure is not graded."""

    @property
    def is_trusted(self) -> bool:
        """Whether the picture is trusted."""
        return self.fidelity is None or self.fidelity.is_trusted

    def to_row(self) -> dict[str, Any]:
        """Return a flat row: kind, grade, draws, second opinions, fidelity, and box in px; None if unknown.

        by_threshold is lost or phantom; right_before and wrong_after count draws, of draws_before and draws_after.
        """
        count, (x0, y0, x1, y1) = self.count or Certificate(), self.xyxy
        row: dict[str, Any] = {"kind": self.error, "grade": self.grade, "by_threshold": self.kind}
        row |= {"label": self.label, "object": self.index, "score": self.score}
        row |= {"right_before": count.before, "draws_before": count.before_draws}
        row |= {"wrong_after": count.after, "draws_after": count.after_draws}
        row |= {"margin_before": count.margin_before, "margin_after": count.margin_after}
        for name, agreement in (("second", self.second), ("peer", self.peer)):
            row |= {name: agreement and agreement.by, f"{name}_agrees": agreement and agreement.agrees}
        row |= {"fidelity": self.fidelity and self.fidelity.score}
        return row | {"x0": x0, "y0": y0, "x1": x1, "y1": y1}


@dataclass(frozen=True, slots=True)
class FrameResult:
    """Result of one frame. Boxes are in px of the frame."""

    identifier: str
    """The frame."""
    objects: int
    """Number of objects."""
    queries: int
    """Gradients and evaluated renders."""
    loss_trace: tuple[float, ...]
    """Loss of each query."""
    theta: tuple[Coordinate, ...]
    """The change."""
    active_constraints: tuple[str, ...]
    """Constraints that limit the change."""
    violations: tuple[str, ...]
    """Violations found by the independent check."""
    targets_benign: tuple[BoxRecord, ...]
    """True boxes before the change."""
    targets_moved: tuple[BoxRecord, ...]
    """True boxes after it."""
    detections_benign: tuple[BoxRecord, ...]
    """Detections in the photograph."""
    detections_rerendered: tuple[BoxRecord, ...]
    """Detections in the re-rendered photograph."""
    detections_attacked: tuple[BoxRecord, ...]
    """Detections in the counterexample."""
    failures: tuple[Failure, ...]
    """Lost objects and phantoms."""
    became_ignored: tuple[int, ...]
    """Objects that the change makes ignored."""
    judged: tuple[int, ...]
    """Objects that count, before the change: targeted, of a class of the detector, and not ignored."""
    found_before: tuple[int, ...]
    """Judged objects that are detected in the re-rendered photograph at IoU 0.5 and t*; others cannot be lost."""
    success_paper: bool
    """Whether the detector fails with benign labels."""
    success_moved: bool
    """Whether it fails with moved labels."""
    identity_psnr_db: float | None
    """PSNR of the re-rendered photograph in the vehicles; None if it is exact."""
    seconds: float
    """Run time; the only field that may differ between equal runs."""
    violated_at_start: tuple[str, ...] = ()
    """Constraints that the photographed scene violates, and the change may not worsen."""
    checked_by: Literal["open3d", "outlines"] = "outlines"
    """Method of the independent feasibility check."""
    min_contrast: float = 0.0
    """Contrast below which objects are ignored."""
    joint_weather: bool = False
    """Whether weather codes are bounded together."""
    passes: int | None = None
    """Detector passes of the search; a gradient counts as 3."""
    grade_notes: tuple[str, ...] = ()
    """Reasons why a grade could not be reached."""
    change: str = ""
    """Description of an exchanged, added or removed vehicle; empty if none."""
    visits: tuple[CellVisit, ...] = ()
    """Where in feature space the search has evaluated the judged objects."""

    @property
    def feasible(self) -> bool:
        """Whether the independent check found no violation."""
        return not self.violations

    @property
    def attacked(self) -> bool:
        """Whether there was anything to attack: an object found before, or a search for phantoms alone."""
        return bool(self.found_before) or self.queries > 0

    @property
    def reason_not_attacked(self) -> str:
        """Why the frame was not attacked."""
        if self.judged:
            return f"none of {format_count(len(self.judged), 'judged object')} is found before"
        reason = "under 25 px high, hidden, cut off, faint, not targeted, or of a class that the detector lacks"
        return f"none of {format_count(self.objects, 'object')} is judged: {reason}"

    @property
    def graded(self) -> bool:
        """Whether all failures have a grade."""
        return all(failure.grade is not None for failure in self.failures)


@dataclass(frozen=True, slots=True)
class VehicleCounts:
    """Numbers of vehicles, each a part of the one before."""

    all: int
    """In the frames."""
    judged: int
    """That count (`FrameResult.judged`)."""
    found_before: int
    """That the detector finds before the attack."""


@dataclass(frozen=True, slots=True)
class ClassSummary:
    """Objects of one class, and failures in it."""

    judged: int
    """Judged objects."""
    found_before: int
    """Those that the detector finds before the attack."""
    grades: dict[str, int]
    """Failures of at least each grade."""
    kinds: dict[str, int]
    """Failures by kind."""


@dataclass(frozen=True, slots=True)
class PhotographedRate:
    """A rate over random states, weighted to the distribution of objects over cells in a run's photographs."""

    value: float
    """The rate, in [0, 1]."""
    low: float
    """Lower end of the 95 % interval."""
    high: float
    """Upper end."""
    covered: float
    """Share of the photographed objects in cells with random states, in [0, 1]; the rate is that of these."""


@dataclass(frozen=True, slots=True)
class RunSummary:
    """Summary of a run."""

    out: str
    """Folder."""
    dataset: str
    """Data set."""
    params: tuple[str, ...]
    """Attacked parameters."""
    detector: str
    """The attacked detector."""
    headline: str
    """Class of the headline scores."""
    t_star: float
    """Score from which detections count."""
    frames: int
    """Number of frames."""
    frames_not_attacked: dict[str, str]
    """Reasons by frame that had nothing to attack; scores and shares leave these frames out."""
    frames_without_vehicles: int
    """Frames skipped because they have no vehicle."""
    frames_failed: dict[str, str]
    """Reasons by frame that could not be used."""
    objects: VehicleCounts
    """Vehicles of all frames."""
    missed_before: Proportion
    """Judged vehicles that the detector misses before the attack."""
    lost_by_grade: dict[str, Proportion]
    """Vehicles found before that are lost, by at least each grade."""
    benign: CocoScores
    """Scores on the photographs."""
    rerendered: CocoScores
    """Scores on the re-rendered photographs."""
    attacked_paper: CocoScores
    """Scores after the attack, with benign labels."""
    attacked_moved: CocoScores
    """Scores after the attack, with moved labels."""
    lost_objects: dict[str, int]
    """Lost objects by class."""
    phantoms: dict[str, int]
    """Phantoms by class."""
    successes_paper: int
    """Frames that fail with benign labels."""
    successes_moved: int
    """Frames that fail with moved labels."""
    feasible_fraction: float | None
    """Share of frames that pass the independent feasibility check."""
    queries: int
    """Gradients and evaluated renders."""
    passes: int
    """Detector passes of the search."""
    grades: dict[str, int]
    """Failures of at least each grade."""
    kinds: dict[str, int]
    """Failures by kind."""
    fidelity: dict[str, int]
    """Graded failures of a kind, by whether their pictures are `trusted` or `not_trusted`."""
    frames_ungraded: int
    """Frames with ungraded failures."""
    grade_notes: dict[str, int]
    """Frames by reason why a grade could not be reached."""
    seconds: float
    """Run time."""
    data: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Files and label rows of the data set, and what became of them; empty for generated scenes."""
    by_class: dict[str, ClassSummary] = dataclasses.field(default_factory=dict)
    """Classes with judged objects or failures."""
    map: FailureMap = dataclasses.field(default_factory=FailureMap)
    """Which features were searched, what fails there, and what is known to hold."""
    rate: ClusteredShare | None = None
    """How often a random state loses an object that is found before; None where the method does not sample states."""

    rate_as_photographed: PhotographedRate | None = None
    """The same for objects of the size, contrast, place and light that they have in the photographs."""

    @property
    def noun(self) -> str:
        """What the objects are called: vehicles, unless people are among them."""
        return "object" if {self.headline, *self.by_class} & {*PEOPLE} else "vehicle"

    @property
    def attacked_classes(self) -> tuple[str, ...]:
        """Classes to list apart, where people and vehicles are both judged; else none."""
        judged = {name in PEOPLE for name, one in self.by_class.items() if one.judged}
        return tuple(self.by_class) if len(judged) == 2 else ()

    @property
    def frames_attacked(self) -> int:
        """Number of frames that had something to attack."""
        return self.frames - len(self.frames_not_attacked)

    @property
    def broken(self) -> Proportion:
        """Attacked frames that fail with moved labels."""
        return Proportion.from_counts(self.successes_moved, self.frames_attacked)

    def describe_rate(self) -> str:
        """The rate in one line, "" without one."""
        if self.rate is None:
            return ""
        rate, weighted = self.rate, self.rate_as_photographed
        draws = f"{rate.draws:,} {self.noun}s in random states of {rate.frames} frames"
        line = f"rate: {rate.failing:,} of {draws} missed ({_format_share(rate)})"
        if weighted is None:
            return line
        covered = f"{100 * weighted.covered:.0f} % of the {self.noun}s"
        return (
            f"{line}; {_format_share(weighted)} with size, contrast, place and light distributed as photographed "
            f"({covered} are in cells that such states met)"
        )

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object with totals, followed by counts by class."""
        data = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        paper, moved = data.pop("attacked_paper"), data.pop("attacked_moved")
        return {
            "schema": SCHEMA,
            **data,
            "params": list(self.params),
            "frames_attacked": self.frames_attacked,
            "broken": dataclasses.asdict(self.broken),
            "objects": dataclasses.asdict(self.objects),
            "missed_before": dataclasses.asdict(self.missed_before),
            "by_class": {name: dataclasses.asdict(one) for name, one in self.by_class.items()},
            "map": self.map.to_json(),
            "rate": None if self.rate is None else dataclasses.asdict(self.rate),
            "rate_as_photographed": (
                None if self.rate_as_photographed is None else dataclasses.asdict(self.rate_as_photographed)
            ),
            "lost_by_grade": {grade: dataclasses.asdict(share) for grade, share in self.lost_by_grade.items()},
            "benign": self.benign.to_json(),
            "rerendered": self.rerendered.to_json(),
            "attacked": {"paper": paper.to_json(), "moved": moved.to_json()},
            "lost_objects": sum(self.lost_objects.values()),
            "lost_objects_by_class": self.lost_objects,
            "phantoms": sum(self.phantoms.values()),
            "phantoms_by_class": self.phantoms,
        }


def dump_frame(result: FrameResult) -> str:
    """Return the JSON text of a frame's result."""
    return dump_record(result, SCHEMA)


def load_frame(path: Path) -> FrameResult:
    """Load a frame's result. Raises FormatError naming the file and the field."""
    result = load_record(path, FrameResult, SCHEMA)
    for i, failure in enumerate(result.failures):
        if failure.kind not in ("lost", "phantom"):
            raise FormatError(f"{path}: failures[{i}].kind", "lost or phantom", repr(failure.kind))
        if failure.index is not None and not 0 <= failure.index < max(len(result.targets_moved), 1):
            expected = f"one of {len(result.targets_moved)} targets"
            raise FormatError(f"{path}: failures[{i}].index", expected, failure.index)
    return result


def _format_share(share: ClusteredShare | PhotographedRate) -> str:
    """Such as 12.5 % [8.31, 17.9]; without exponents."""
    value, low, high = (f"{round(100 * end, 3):.3g}" for end in (share.value, share.low, share.high))
    return f"{value} % [{low}, {high}]"
