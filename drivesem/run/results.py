"""What a run leaves behind, as plain dataclasses: written as JSON, read by the report and by a resumed run."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from drivesem.evaluation.coco import CocoScores
from drivesem.failures.grades import Certificate, SecondOpinion
from drivesem.run.records import from_json
from scene_ir import files
from scene_ir.errors import FormatError

SCHEMA = 2
"""Of what is written; 1, which knew no grades, is still read."""


@dataclass(frozen=True, slots=True)
class BoxRecord:
    """One true or detected box. xyxy px; label: class name; score in [0, 1] for detections;
    ignore: true boxes that are neither missed nor a hit. index: the object of the scene, where it is one.
    """

    xyxy: tuple[float, float, float, float]
    label: str
    score: float | None = None
    ignore: bool = False
    index: int | None = None


@dataclass(frozen=True, slots=True)
class Coordinate:
    """One coordinate of theta. name such as `objects[3].yaw`; value, lower, upper in `unit`;
    display: the value in the unit that people use (metres, degrees).
    """

    name: str
    unit: str
    value: float
    lower: float
    upper: float
    display: str


@dataclass(frozen=True, slots=True)
class Failure:
    """One thing the detector got wrong only after the change, by threshold. kind: lost or phantom; label: class
    name; xyxy: the true box that was lost, or the detection that nothing supports; index: the lost object, or the
    one that is reported twice. error: its kind as `truth.kinds` names it, None where it is none (found as far as
    it shows; on a real object; suspect before the change). grade: how sure it is, None where nobody asked (runs of
    earlier versions). count: the draws of its certificate; second, peer: what another renderer and another
    architecture say.
    """

    kind: str
    label: str
    xyxy: tuple[float, float, float, float]
    index: int | None = None
    score: float | None = None
    error: str | None = None
    grade: str | None = None
    count: Certificate | None = None
    second: SecondOpinion | None = None
    peer: SecondOpinion | None = None

    def to_row(self) -> dict[str, Any]:
        """A flat dict: kind (as `truth.kinds`), grade, draws and second opinions; boxes in px; None where unknown.

        by_threshold is lost or phantom; right_before, wrong_after are draws, of draws_before, draws_after.
        """
        count, (x0, y0, x1, y1) = self.count or Certificate(), self.xyxy
        row: dict[str, Any] = {"kind": self.error, "grade": self.grade, "by_threshold": self.kind}
        row |= {"label": self.label, "object": self.index, "score": self.score}
        row |= {"right_before": count.before, "draws_before": count.before_draws}
        row |= {"wrong_after": count.after, "draws_after": count.after_draws}
        row |= {"margin_before": count.margin_before, "margin_after": count.margin_after}
        for name, agreement in (("second", self.second), ("peer", self.peer)):
            row |= {name: agreement and agreement.by, f"{name}_agrees": agreement and agreement.agrees}
        return row | {"x0": x0, "y0": y0, "x1": x1, "y1": y1}


@dataclass(frozen=True, slots=True)
class FrameResult:
    """One frame of a run. Lists of boxes are in the frame's pixels; `seconds` is the only field that may differ
    between two runs with the same configuration. violated_at_start: constraints that the photographed scene does
    not meet, and that may only not get worse. checked_by: what the second feasibility check judged with, open3d or
    (as before there was a choice) outlines. min_contrast: below it objects were ignored, 0 where that was no rule;
    joint_weather: whether that check bounded weather codes together, too; both as in earlier runs by default.
    passes: of the detector, a gradient counted as 3, without what grading took. grade_notes: why a grade could not
    be reached. change: which vehicle was exchanged, added or taken away, in words; empty where none was.
    """

    identifier: str
    objects: int
    queries: int
    loss_trace: tuple[float, ...]
    theta: tuple[Coordinate, ...]
    active_constraints: tuple[str, ...]
    violations: tuple[str, ...]
    targets_benign: tuple[BoxRecord, ...]
    targets_moved: tuple[BoxRecord, ...]
    detections_benign: tuple[BoxRecord, ...]
    detections_rerendered: tuple[BoxRecord, ...]
    detections_attacked: tuple[BoxRecord, ...]
    failures: tuple[Failure, ...]
    became_ignored: tuple[int, ...]
    success_paper: bool
    success_moved: bool
    identity_psnr_db: float | None
    seconds: float
    violated_at_start: tuple[str, ...] = ()
    checked_by: Literal["open3d", "outlines"] = "outlines"
    min_contrast: float = 0.0
    joint_weather: bool = False
    passes: int | None = None
    grade_notes: tuple[str, ...] = ()
    change: str = ""

    @property
    def feasible(self) -> bool:
        """Whether the independent check found nothing violated."""
        return not self.violations

    @property
    def graded(self) -> bool:
        """Whether somebody asked how sure its failures are; a frame without failures leaves nothing to ask."""
        return all(failure.grade is not None for failure in self.failures)


@dataclass(frozen=True, slots=True)
class RunSummary:
    """The figures of a run; `to_json` is what `--json` prints."""

    out: str
    dataset: str
    params: tuple[str, ...]
    detector: str
    headline: str
    t_star: float
    frames: int
    frames_without_vehicles: int
    frames_failed: dict[str, str]
    objects: int
    benign: CocoScores
    rerendered: CocoScores
    attacked_paper: CocoScores
    attacked_moved: CocoScores
    lost_objects: dict[str, int]
    phantoms: dict[str, int]
    successes_paper: int
    successes_moved: int
    feasible_fraction: float | None
    queries: int
    passes: int
    grades: dict[str, int]
    kinds: dict[str, int]
    frames_ungraded: int
    grade_notes: dict[str, int]
    seconds: float

    def to_json(self) -> dict[str, Any]:
        """A JSON object; classes stand apart, totals in front."""
        data = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        paper, moved = data.pop("attacked_paper"), data.pop("attacked_moved")
        return {
            "schema": SCHEMA,
            **data,
            "params": list(self.params),
            "benign": self.benign.to_json(),
            "rerendered": self.rerendered.to_json(),
            "attacked": {"paper": paper.to_json(), "moved": moved.to_json()},
            "lost_objects": sum(self.lost_objects.values()),
            "lost_objects_by_class": self.lost_objects,
            "phantoms": sum(self.phantoms.values()),
            "phantoms_by_class": self.phantoms,
        }


def dump_frame(result: FrameResult) -> str:
    """JSON text of one frame's result, exact and in a fixed order."""
    return json.dumps({"schema": SCHEMA, **dataclasses.asdict(result)}, indent=1, allow_nan=False) + "\n"


def load_frame(path: Path) -> FrameResult:
    """Read what `dump_frame` wrote. Raises FormatError naming the file and the field."""
    data = files.read_json(path)
    if not isinstance(data, dict) or data.pop("schema", None) not in (1, SCHEMA):
        raise FormatError(f"{path}: schema", f"1 or {SCHEMA}", "another one")
    result: FrameResult = from_json(FrameResult, data, str(path))
    for i, failure in enumerate(result.failures):
        if failure.kind not in ("lost", "phantom"):
            raise FormatError(f"{path}: failures[{i}].kind", "lost or phantom", repr(failure.kind))
        if failure.index is not None and not 0 <= failure.index < max(len(result.targets_moved), 1):
            expected = f"one of {len(result.targets_moved)} targets"
            raise FormatError(f"{path}: failures[{i}].index", expected, failure.index)
    return result
