"""What a study keeps of its runs, small enough for a repository: the same tables come from it without data set,
detector or run.

A folder: `study.json` (settings, arms, frames), `frames.csv` (a row an arm and frame), `detections.csv.gz` (a row
a detection of HEADLINE, with what it is beside the labels), `failures.csv`, and `objects.csv`, what the study
`searches` finds in the photographs; of the study `labels` also `labels.csv` (a row an object of an arm's frame)
and `label_failures.csv`. Columns are the fields of the classes below.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, fields
from pathlib import Path
from typing import Literal

from drivesem.analysis.confirm.report import Confirmation, Share
from drivesem.failures.grades import Grade, Kind
from drivesem.run.records import load_record
from scene_ir import files
from scene_ir.errors import FormatError
from tools.experiments.detection.arms import PLACEBO, RANDOM, AttackArm, base_attack
from tools.experiments.detection.attribution import AttributionPlan
from tools.experiments.detection.counts import ArmCounts, DetectedObject, FailureRecord, FrameCounts, StudyCounts
from tools.experiments.detection.kept_rows import (
    MOST,
    MOST_DRAWS,
    STUDY,
    Marked,
    check_count,
    check_marks,
    check_name,
    check_score,
    check_settings,
    marked,
    matches_of,
    read_rows,
    require,
    settings_of,
    write_rows,
)
from tools.experiments.detection.labels import OVERLAPS, FrameLabels, LabelFailures
from tools.experiments.settings import StudyConfig

_SCHEMA = 1
_FRAMES, _DETECTIONS = "frames.csv", "detections.csv.gz"
_FAILURES, _OBJECTS = "failures.csv", "objects.csv"
_LABELS, _LABEL_FAILURES = "labels.csv", "label_failures.csv"
"""Of the study `labels` alone."""
_LEAST = 1e-30
"""No measure but 0 is below it: ratios are finite."""
_MEASURE = f"0, or from {_LEAST:g} to below {MOST}"
_OF_AN_ARM = ("detector", "method", "keep", "steps", "queries")
"""Settings of an arm that tables ask for."""
_SHARED = tuple(field.name for field in fields(FrameCounts) if field.name not in ("identifier", "failures"))
"""What a row of frames.csv has as `FrameCounts` has it."""


@dataclass(frozen=True, slots=True)
class FrameRow:
    """One frame of an arm, as `FrameCounts` has it. photograph: the arm whose detections in the photograph are
    this one's too, mostly the first; cars, cars_moved: HEADLINE's objects to find, by benign and by moved labels.
    """

    arm: str
    frame: str
    photograph: str
    queries: int
    passes: int
    seconds: float
    feasible: bool
    success_paper: bool
    success_moved: bool
    size: float
    judged: int
    cars: int
    cars_moved: int


@dataclass(frozen=True, slots=True)
class DetectionRow:
    """One detection of HEADLINE. score: the shortest number that float32 tells from others; benign, moved: what it
    is beside these labels, a letter for each IoU from 0.5 to 0.95 in steps of 0.05: t true, f false, i ignored;
    what repeats at the end is left out. Photographs have no moved labels.
    """

    arm: str
    frame: str
    picture: Literal["photograph", "counterexample"]
    score: float
    benign: str
    moved: str | None


@dataclass(frozen=True, slots=True)
class FailureRow:
    """One failure, as `CountedFailure` has it."""

    arm: str
    frame: str
    object: int | None
    kind: str | None
    grade: str | None
    asked: bool


@dataclass(frozen=True, slots=True)
class ObjectRow:
    """One object that the detector finds in the photograph."""

    frame: str
    object: int
    height_px: float
    depth_m: float


@dataclass(frozen=True, slots=True)
class LabelRow:
    """One object of an arm's frame. iou: of its benign and its moved label."""

    arm: str
    frame: str
    object: int
    iou: float


@dataclass(frozen=True, slots=True)
class LabelFailureRow:
    """One frame of an arm where a detection meets a label from that IoU on, as `Mistakes` has it."""

    arm: str
    frame: str
    iou: float
    paper: bool
    moved: bool
    lost_paper: int
    lost_only_unmoved: int


@dataclass(frozen=True, slots=True)
class Survivors:
    """What a second renderer said of an arm. frames: that it drew; shares: failures, and those that survive."""

    frames: int
    shares: dict[str, tuple[int, int]]


@dataclass(frozen=True, slots=True)
class _Head:
    """study.json."""

    settings: StudyConfig
    arms: tuple[AttackArm, ...]
    frames: tuple[str, ...]
    frames_without_vehicles: int
    frames_failed: dict[str, str]
    confirmed: dict[str, Survivors]


@dataclass(frozen=True, slots=True)
class Kept:
    """A study that was kept. confirmed: of its arms, where second renderers were asked."""

    settings: StudyConfig
    counts: StudyCounts
    confirmed: Mapping[str, Confirmation]


def keep(folder: Path, study: StudyConfig, counts: StudyCounts, confirmed: Mapping[str, Confirmation]) -> None:
    """Write it whole. counts: what came of the study's arms."""
    head = {
        "schema": _SCHEMA,
        "settings": settings_of(study),
        "arms": [
            asdict(one.arm) | {"config": {name: getattr(one.arm.config, name) for name in _OF_AN_ARM}}
            for one in counts.arms
        ],
        "frames": [frame.identifier for frame in counts.arms[0].frames],
        "frames_without_vehicles": counts.without_vehicles,
        "frames_failed": counts.failed,
        "confirmed": {
            name: {"frames": one.frames, "shares": {s.name: (s.failures, s.survive) for s in one.shares}}
            for name, one in confirmed.items()
        },
    }
    frames, detections = _rows(counts.arms)
    failures = (
        FailureRow(one.arm.name, frame.identifier, f.object_index, f.kind, f.grade, f.second_rendered)
        for one in counts.arms
        for frame in one.frames
        for f in frame.failures
    )
    seen = (ObjectRow(name, *astuple(one)) for name, objects in counts.detected_objects.items() for one in objects)
    with files.atomic_folder(folder) as into:
        files.write_json(into / STUDY, head)
        write_rows(into / _FRAMES, FrameRow, frames)
        write_rows(into / _DETECTIONS, DetectionRow, detections)
        write_rows(into / _FAILURES, FailureRow, failures)
        write_rows(into / _OBJECTS, ObjectRow, seen)
        if counts.labels:
            _write_labels(into, counts)


def _rows(arms: Sequence[ArmCounts]) -> tuple[list[FrameRow], list[DetectionRow]]:
    """What the detector finds in a photograph stands once, with the first arm of which it is the same."""
    frames: list[FrameRow] = []
    detections: list[DetectionRow] = []
    known: dict[str, list[tuple[str, int, list[Marked]]]] = {}
    for one in arms:
        arm, paper, moved = one.arm.name, one.after["paper"], one.after["moved"]
        befores, papers, moveds = map(marked, (one.before, paper, moved))
        for place, frame in enumerate(one.frames):
            name, cars = frame.identifier, int(one.before.objects[place])
            alike = [by for by, n, rows in known.get(name, ()) if (n, rows) == (cars, befores[place])]
            if not alike:
                known.setdefault(name, []).append((arm, cars, befores[place]))
                detections += [DetectionRow(arm, name, "photograph", *row, None) for row in befores[place]]
            detections += [
                DetectionRow(arm, name, "counterexample", score, benign, after)
                for (score, benign), (_, after) in zip(papers[place], moveds[place], strict=True)
            ]
            told = {key: getattr(frame, key) for key in _SHARED}
            by = (alike or [arm])[0]
            frames.append(FrameRow(arm, name, by, **told, cars=cars, cars_moved=int(moved.objects[place])))
    return frames, detections


def _write_labels(folder: Path, counts: StudyCounts) -> None:
    told = [
        (arm.arm.name, frame.identifier, labels)
        for arm in counts.arms
        for frame, labels in zip(arm.frames, counts.labels[arm.arm.name], strict=True)
    ]
    objects = (LabelRow(arm, frame, *own) for arm, frame, one in told for own in one.iou.items())
    failed = (
        LabelFailureRow(arm, frame, iou, *astuple(own))
        for arm, frame, one in told
        for iou, own in one.failures.items()
    )
    write_rows(folder / _LABELS, LabelRow, objects)
    write_rows(folder / _LABEL_FAILURES, LabelFailureRow, failed)


def load_kept(folder: Path, name: str) -> Kept:
    """A study of that name that `keep` wrote. Raises FormatError naming file, and row or field."""
    check_name(folder / STUDY, name)
    head: _Head = load_record(folder / STUDY, _Head, _SCHEMA)
    _check_head(head, name, str(folder / STUDY))
    frames = _frames(folder / _FRAMES, head)
    seen_by = _detections(folder / _DETECTIONS, frames)
    failures = _failures(folder / _FAILURES, frames)
    seen = _seen(folder / _OBJECTS, head.frames)
    arms = []
    for arm in head.arms:
        rows = [frames[arm.name, frame] for frame in head.frames]
        cars, moved = ([getattr(row, key) for row in rows] for key in ("cars", "cars_moved"))
        before = [seen_by[row.photograph, row.frame, "photograph"] for row in rows]
        after = [seen_by[row.arm, row.frame, "counterexample"] for row in rows]
        where = f"{folder / _DETECTIONS}: arm {arm.name}"
        arms.append(
            ArmCounts(
                arm=arm,
                frames=tuple(_frame(row, failures[row.arm, row.frame]) for row in rows),
                before=matches_of([[(r.score, r.benign) for r in one] for one in before], cars, where),
                after={
                    "paper": matches_of([[(r.score, r.benign) for r in one] for one in after], cars, where),
                    "moved": matches_of([[(r.score, r.moved or "") for r in one] for one in after], moved, where),
                },
            )
        )
    labels = _labels(folder, head) if name == "labels" else {}
    counts = StudyCounts(tuple(arms), head.frames_without_vehicles, head.frames_failed, seen, labels)
    confirmed = {
        arm: Confirmation(
            one.frames, {}, tuple(_share(n, failed, kept) for n, (failed, kept) in one.shares.items()), {}, None
        )
        for arm, one in head.confirmed.items()
    }
    return Kept(head.settings, counts, confirmed)


def _share(name: str, failures: int, survive: int) -> Share:
    return Share.of(name, [place < survive for place in range(failures)])


def _check_head(head: _Head, name: str, where: str) -> None:
    study, arms = head.settings, [arm.name for arm in head.arms]
    check_settings(study, name, where)
    require(any(arm.control is None for arm in head.arms), f"{where}: arms", "one that is no control", "none")
    needed = (
        [arm.name for arm in AttributionPlan.from_study(study, base_attack(study)).arms()]
        if name == "attribution"
        else []
    )
    missing = [arm for arm in needed if arm not in arms]
    require(not missing, f"{where}: arms", f"one named {missing[:1]}", "none")
    for place, arm in enumerate(head.arms):
        here = f"{where}: arms[{place}]"
        require(arms.index(arm.name) == place, f"{here}.name", "each name once", arm.name)
        beside = (None, RANDOM, PLACEBO) if arm.control_of in arms else (None,)
        require(arm.control in beside, f"{here}.control", "random or placebo of an arm, or null", arm.control)
        require(arm.reference is None or 0 <= arm.reference <= 1, f"{here}.reference", "0 to 1", arm.reference)
        for key, value in (("steps", arm.config.steps), ("queries", arm.config.queries)):
            good = value is None or 1 <= value <= MOST_DRAWS
            require(good, f"{here}.config.{key}", f"1 to {MOST_DRAWS}", value)
    require(len(set(head.frames)) == len(head.frames), f"{where}: frames", "each once", "one twice")
    passed = head.frames_without_vehicles
    require(0 <= passed < MOST, f"{where}: frames_without_vehicles", "a count", passed)
    for arm, one in head.confirmed.items():
        here = f"{where}: confirmed.{arm}"
        alike = bool(one.shares) and all(
            one.shares.keys() == other.shares.keys() for other in head.confirmed.values()
        )
        require(arm in arms and alike, here, "an arm, with the same shares as others", list(one.shares))
        for failures, survive in one.shares.values():
            good = 0 <= survive <= failures <= MOST_DRAWS
            require(good, here, "failures, and how many of them survive", (failures, survive))


_Key = tuple[str, str]
"""An arm's name and a frame's."""


def _frames(path: Path, head: _Head) -> dict[_Key, FrameRow]:
    wanted = {(arm.name, frame) for arm in head.arms for frame in head.frames}
    found: dict[_Key, FrameRow] = {}
    for where, row in read_rows(path, FrameRow):
        require((row.arm, row.frame) in wanted, where, f"an arm and a frame of {STUDY}", (row.arm, row.frame))
        require((row.arm, row.frame) not in found, where, "each frame once an arm", row.frame)
        for name in ("queries", "passes", "seconds", "size", "judged", "cars", "cars_moved"):
            value = getattr(row, name)
            require(value == 0 or _LEAST <= value < MOST, f"{where}: {name}", _MEASURE, value)
        found[row.arm, row.frame] = row
    for key in wanted - found.keys():
        raise FormatError(str(path), f"a row of arm {key[0]}, frame {key[1]}", "none")
    for row in found.values():
        first = found.get((row.photograph, row.frame))
        good = first is not None and (first.photograph, first.cars) == (row.photograph, row.cars)
        require(good, f"{path}: photograph", "an arm that has its own and as many cars", row.photograph)
    return found


def _frame(row: FrameRow, failures: Sequence[FailureRecord]) -> FrameCounts:
    return FrameCounts(row.frame, **{key: getattr(row, key) for key in _SHARED}, failures=tuple(failures))


def _detections(path: Path, frames: Mapping[_Key, FrameRow]) -> dict[tuple[str, str, str], list[DetectionRow]]:
    found: dict[tuple[str, str, str], list[DetectionRow]] = {
        (*key, picture): [] for key in frames for picture in ("photograph", "counterexample")
    }
    for where, row in read_rows(path, DetectionRow):
        frame, photograph = frames.get((row.arm, row.frame)), row.picture == "photograph"
        require(frame is not None, where, f"an arm and a frame of {_FRAMES}", (row.arm, row.frame))
        own = frame is None or frame.photograph == row.arm
        require(own or not photograph, where, "no photograph of an arm that has another's", row.arm)
        check_score(where, row.score)
        require((row.moved is None) == photograph, f"{where}: moved", "marks of counterexamples alone", row.moved)
        check_marks(f"{where}: benign", row.benign)
        check_marks(f"{where}: moved", row.moved)
        found[row.arm, row.frame, row.picture].append(row)
    return found


def _failures(path: Path, frames: Mapping[_Key, FrameRow]) -> dict[_Key, list[FailureRecord]]:
    found: dict[_Key, list[FailureRecord]] = {key: [] for key in frames}
    for where, row in read_rows(path, FailureRow):
        require((row.arm, row.frame) in found, where, f"an arm and a frame of {_FRAMES}", (row.arm, row.frame))
        require(0 <= (row.object or 0) < MOST, f"{where}: object", "at least 0", row.object)
        for name, value, known in (("kind", row.kind, Kind), ("grade", row.grade, Grade)):
            require(
                value is None or value in map(str, known), f"{where}: {name}", f"one of {', '.join(known)}", value
            )
        found[row.arm, row.frame].append(FailureRecord(row.object, row.kind, row.grade, row.asked))
    return found


def _seen(path: Path, frames: Sequence[str]) -> dict[str, tuple[DetectedObject, ...]]:
    found: dict[str, list[DetectedObject]] = {name: [] for name in frames}
    for where, row in read_rows(path, ObjectRow):
        require(row.frame in found, f"{where}: frame", f"a frame of {STUDY}", row.frame)
        require(0 <= row.object < MOST, f"{where}: object", "at least 0", row.object)
        known = [one.object_index for one in found[row.frame]]
        require(row.object not in known, f"{where}: object", "each once a frame", row.object)
        for name in ("height_px", "depth_m"):
            require(getattr(row, name) >= 0, f"{where}: {name}", "at least 0", getattr(row, name))
        found[row.frame].append(DetectedObject(row.object, row.height_px, row.depth_m))
    return {name: tuple(objects) for name, objects in found.items()}


def _labels(folder: Path, head: _Head) -> dict[str, tuple[FrameLabels, ...]]:
    keys = [(arm.name, frame) for arm in head.arms for frame in head.frames]
    overlaps: dict[_Key, dict[int, float]] = {key: {} for key in keys}
    mistakes: dict[_Key, dict[float, LabelFailures]] = {key: {} for key in keys}
    for where, row in read_rows(folder / _LABELS, LabelRow):
        own = overlaps.get((row.arm, row.frame))
        require(own is not None, where, f"an arm and a frame of {STUDY}", (row.arm, row.frame))
        check_count(f"{where}: object", row.object)
        require(row.object not in (own or {}), f"{where}: object", "each once a frame", row.object)
        require(0 <= row.iou <= 1, f"{where}: iou", "0 to 1", row.iou)
        overlaps[row.arm, row.frame][row.object] = row.iou
    for where, row in read_rows(folder / _LABEL_FAILURES, LabelFailureRow):
        require((row.arm, row.frame) in mistakes, where, f"an arm and a frame of {STUDY}", (row.arm, row.frame))
        require(row.iou in OVERLAPS, f"{where}: iou", f"one of {', '.join(map(str, OVERLAPS))}", row.iou)
        check_count(f"{where}: lost_paper", row.lost_paper)
        check_count(f"{where}: lost_only_unmoved", row.lost_only_unmoved, row.lost_paper)
        one = LabelFailures(row.paper, row.moved, row.lost_paper, row.lost_only_unmoved)
        mistakes[row.arm, row.frame][row.iou] = one
    for key, own in mistakes.items():
        missing = [iou for iou in OVERLAPS if iou not in own]
        require(not missing, str(folder / _LABEL_FAILURES), f"rows of arm {key[0]}, frame {key[1]}", "none")
    return {
        arm.name: tuple(
            FrameLabels(overlaps[arm.name, name], {iou: mistakes[arm.name, name][iou] for iou in OVERLAPS})
            for name in head.frames
        )
        for arm in head.arms
    }
