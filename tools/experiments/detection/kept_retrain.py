"""What `drivesem study retrain` keeps.

A folder: `study.json` (settings, lessons, what was left out), `benign.csv` (a row a held-out benign frame),
`benign_detections.csv.gz` (what each detector finds in them), `states.csv.gz` (a row a frame, kind of states and
detector), and two folders as other studies have them: `known`, the counterexamples of the detector as it was
before all (`kept_transfer`), and `fresh`, attacks on held-out frames against each (`kept`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from drivesem.run.records import load_record
from scene_ir import files
from tools.experiments.detection.counts import StudyCounts
from tools.experiments.detection.kept import keep, load_kept
from tools.experiments.detection.kept_rows import (
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
from tools.experiments.detection.kept_transfer import check_attacks, read_pairs, write_pairs
from tools.experiments.detection.lessons import BENIGN, build_retraining_arms
from tools.experiments.detection.robust import KINDS, FailureCounts, FrameStateCounts
from tools.experiments.detection.running import AttackTotals
from tools.experiments.detection.taught import BenignMatches, RetrainingCounts
from tools.experiments.settings import StudyConfig

_SCHEMA = 1
_BENIGN, _DETECTIONS, _STATES = "benign.csv", "benign_detections.csv.gz", "states.csv.gz"
_KNOWN, _FRESH = "known", "fresh"


@dataclass(frozen=True, slots=True)
class BenignRow:
    """One held-out benign frame, and HEADLINE's objects to find in it."""

    frame: str
    cars: int


@dataclass(frozen=True, slots=True)
class BenignDetectionRow:
    """One detection of HEADLINE in a benign frame. score, benign: as in `kept.DetectionRow`."""

    detector: str
    frame: str
    score: float
    benign: str


@dataclass(frozen=True, slots=True)
class StatesRow:
    """One detector before the states of one kind of a held-out frame. cars: how often a car counts; lost: how
    often it is not found; pictures; phantoms: in how many of them something is reported where nothing is.
    """

    frame: str
    kind: str
    detector: str
    cars: int
    lost: int
    pictures: int
    phantoms: int


@dataclass(frozen=True, slots=True)
class _Head:
    """study.json. detectors: t* by name, of the detector as it was, then of the lessons."""

    settings: StudyConfig
    attack: str
    learned: AttackTotals
    judged: AttackTotals
    shown: dict[str, int]
    benign: int
    detectors: dict[str, float]
    left_out: dict[str, str]


def keep_retrain(folder: Path, study: StudyConfig, counts: RetrainingCounts) -> None:
    """Write it whole."""
    head = {
        "schema": _SCHEMA,
        "settings": settings_of(study),
        "attack": counts.attack,
        "learned": asdict(counts.training_attacks),
        "judged": asdict(counts.test_attacks),
        "shown": dict(counts.counterexamples),
        "benign": counts.benign_training_frames,
        "detectors": {name: one.t_star for name, one in counts.benign_matches.items()},
        "left_out": dict(counts.left_out),
    }
    cars = map(int, counts.benign_matches[BENIGN].matches.objects)
    benign = (BenignRow(*row) for row in zip(counts.benign_frames, cars, strict=True))
    detections = (
        BenignDetectionRow(detector, name, *row)
        for detector, one in counts.benign_matches.items()
        for name, rows in zip(counts.benign_frames, marked(one.matches, one.matches.telling()), strict=True)
        for row in rows
    )
    states = (
        StatesRow(frame.identifier, kind, name, one.cars, one.lost[place], one.pictures, one.phantoms[place])
        for frame in counts.states
        for kind, one in frame.counts.items()
        for place, name in enumerate(counts.benign_matches)
    )
    fresh = StudyCounts(tuple(counts.fresh), counts.test_attacks.without_vehicles, counts.test_attacks.failed)
    with files.atomic_folder(folder) as into:
        files.write_json(into / STUDY, head)
        write_rows(into / _BENIGN, BenignRow, benign)
        write_rows(into / _DETECTIONS, BenignDetectionRow, detections)
        write_rows(into / _STATES, StatesRow, states)
        (into / _KNOWN).mkdir()
        write_pairs(into / _KNOWN, counts.known)
        keep(into / _FRESH, study, fresh, {})


def load_retrain(folder: Path) -> tuple[StudyConfig, RetrainingCounts]:
    """What `keep_retrain` wrote. Raises FormatError naming file, and row or field."""
    where = str(folder / STUDY)
    check_name(folder / STUDY, "retrain")
    head: _Head = load_record(folder / STUDY, _Head, _SCHEMA)
    names = _check_head(head, where)
    known = read_pairs(folder / _KNOWN)
    targets = [one.target.name for one in known]
    require(targets == names, str(folder / _KNOWN), f"one run before {', '.join(names)}", targets)
    alike = {tuple(frame.identifier for frame in one.frames) for one in known}
    require(len(alike) == 1, str(folder / _KNOWN), "the same frames before all", f"{len(alike)} sets")
    fresh = load_kept(folder / _FRESH, "retrain").counts.arms
    attacked = [one.arm.name for one in fresh]
    require(attacked in (names, names[:1]), str(folder / _FRESH), f"arms {', '.join(names)}", attacked)
    frames = len(fresh[0].frames)
    require(frames == head.judged.frames, f"{where}: judged.frames", str(frames), head.judged.frames)
    cars = _benign(folder / _BENIGN)
    return head.settings, RetrainingCounts(
        attack=head.attack,
        training_attacks=head.learned,
        test_attacks=head.judged,
        counterexamples=head.shown,
        benign_training_frames=head.benign,
        benign_frames=tuple(cars),
        benign_matches=_seen(folder / _DETECTIONS, head.detectors, cars),
        known=known,
        fresh=fresh,
        left_out=head.left_out,
        states=_states(folder / _STATES, names),
    )


def _check_head(head: _Head, where: str) -> list[str]:
    """The names of the detectors."""
    check_settings(head.settings, "retrain", where)
    lessons = [one.name for one in build_retraining_arms(head.settings) if one.name in head.shown]
    require(lessons == list(head.shown), f"{where}: shown", "lessons of these settings", list(head.shown))
    names = [BENIGN, *lessons]
    found = list(head.detectors)
    require(found == names, f"{where}: detectors", ", ".join(names), found)
    for name, t_star in head.detectors.items():
        check_score(f"{where}: detectors.{name}", t_star)
    for name, count in (*head.shown.items(), ("benign", head.benign)):
        check_count(f"{where}: {name}", count)
    check_attacks(f"{where}: learned", head.learned)
    check_attacks(f"{where}: judged", head.judged)
    return names


def _benign(path: Path) -> dict[str, int]:
    """Cars by frame."""
    found: dict[str, int] = {}
    for where, row in read_rows(path, BenignRow):
        require(row.frame not in found, f"{where}: frame", "each once", row.frame)
        check_count(f"{where}: cars", row.cars)
        found[row.frame] = row.cars
    require(bool(found), str(path), "at least one frame", "none")
    return found


def _seen(path: Path, detectors: Mapping[str, float], cars: Mapping[str, int]) -> dict[str, BenignMatches]:
    found: dict[tuple[str, str], list[Marked]] = {(name, frame): [] for name in detectors for frame in cars}
    for where, row in read_rows(path, BenignDetectionRow):
        key = (row.detector, row.frame)
        require(key in found, where, f"a detector of {STUDY} and a frame of {_BENIGN}", key)
        check_score(where, row.score)
        check_marks(f"{where}: benign", row.benign)
        found[key].append((row.score, row.benign))
    objects = list(cars.values())
    return {
        name: BenignMatches(matches_of([found[name, frame] for frame in cars], objects, f"{path}: {name}"), t_star)
        for name, t_star in detectors.items()
    }


def _states(path: Path, names: Sequence[str]) -> list[FrameStateCounts]:
    """Of each frame that has any, in the order of the file; digests and notes of the run are not kept."""
    rows: dict[str, dict[str, dict[str, StatesRow]]] = {}
    for where, row in read_rows(path, StatesRow):
        require(row.kind in KINDS, f"{where}: kind", f"one of {', '.join(KINDS)}", row.kind)
        require(row.detector in names, f"{where}: detector", f"one of {STUDY}", row.detector)
        known = rows.setdefault(row.frame, {}).setdefault(row.kind, {})
        require(row.detector not in known, f"{where}: detector", "each once a frame and kind", row.detector)
        check_count(f"{where}: cars", row.cars)
        check_count(f"{where}: pictures", row.pictures)
        check_count(f"{where}: lost", row.lost, row.cars)
        check_count(f"{where}: phantoms", row.phantoms, row.pictures)
        known[row.detector] = row
    found: list[FrameStateCounts] = []
    for frame, kinds in rows.items():
        counts = {kind: _counted(f"{path}: {frame}, {kind}", own, names) for kind, own in kinds.items()}
        found.append(FrameStateCounts(frame, "", counts, ""))
    return found


def _counted(where: str, rows: Mapping[str, StatesRow], names: Sequence[str]) -> FailureCounts:
    missing = [name for name in names if name not in rows]
    require(not missing, where, f"a row of {missing[:1]}", "none")
    own = [rows[name] for name in names]
    cars, pictures = own[0].cars, own[0].pictures
    alike = all((row.cars, row.pictures) == (cars, pictures) for row in own)
    require(alike, where, "as many cars and pictures before all detectors", "other numbers")
    return FailureCounts(cars, tuple(row.lost for row in own), pictures, tuple(row.phantoms for row in own))
