"""The stored results of a study: CSV tables from which all its published tables follow, without data or runs.

A folder holds `study.json` (settings, arms, pairs), `frames.csv` and `detections.csv.gz`, and where a study has
them `failures.csv`, `objects.csv`, `labels.csv`, `label_failures.csv`, `confirmations.csv`. Columns are the fields
of the dataclasses that this module names.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from drivesem.analysis.confirm import Confirmation, SurvivalRate
from drivesem.analysis.transfer import (
    EVALUATED_PICTURES,
    FrameLosses,
    SourceRun,
    TransferCounts,
    TransferTarget,
)
from drivesem.evaluation.coco import IOU_THRESHOLDS
from drivesem.evaluation.instances import Booleans
from drivesem.evaluation.matched_class import ThresholdMatches
from scene_ir import files
from scene_ir.errors import FormatError
from tools.experiments.detection.arms import AttackArm, AttackTotals
from tools.experiments.detection.counts import ArmCounts, DetectedObject, FailureRecord, FrameCounts, StudyCounts
from tools.experiments.detection.labels import FrameLabels, LabelFailures
from tools.experiments.detection.retraining_arms import BENIGN
from tools.experiments.detection.retraining_results import BenignMatches, RetrainingCounts
from tools.experiments.detection.robustness import FailureCounts, FrameStateCounts
from tools.experiments.detection.transfer import TransferSource, TransferStudyCounts
from tools.experiments.settings import StudyConfig
from tools.experiments.tables import matching_tables, read_metadata, read_table, write_metadata, write_table

_FRAMES, _DETECTIONS, _FAILURES = "frames.csv", "detections.csv.gz", "failures.csv"
_OBJECTS, _LABELS, _LABEL_FAILURES = "objects.csv", "labels.csv", "label_failures.csv"
_CONFIRMATIONS, _BENIGN, _STATES = "confirmations.csv", "benign.csv", "states.csv.gz"
_PAIR_OBJECTS, _BENIGN_DETECTIONS = "objects.csv.gz", "benign_detections.csv.gz"
_KNOWN, _FRESH = "known", "fresh"
_ARM_SETTINGS = ("detector", "method", "keep", "steps", "queries")
"""Settings of an arm that the tables need."""
_MARK_LETTERS = "fti"
"""Letters of FALSE, TRUE and IGNORED."""
_PICTURES = {
    "benign": "photograph",
    "rerendered": "re-render",
    "paper": "counterexample",
    "moved": "counterexample",
}
K = TypeVar("K")
V = TypeVar("V")


@dataclass(frozen=True, slots=True)
class FrameKey:
    """A frame."""

    frame: str
    """Identifier of the frame."""


@dataclass(frozen=True, slots=True)
class ArmFrameKey:
    """A frame of an arm."""

    frame: str
    """Identifier of the frame."""
    arm: str
    """Name of the arm."""


@dataclass(frozen=True, slots=True)
class PairFrameKey:
    """A frame of a run, tested on a detector."""

    frame: str
    """Identifier of the frame."""
    source: str
    """Name of the run."""
    target: str
    """Name of the detector."""


@dataclass(frozen=True, slots=True)
class DetectorFrameKey:
    """A frame, tested on a detector."""

    frame: str
    """Identifier of the frame."""
    detector: str
    """Name of the detector."""


@dataclass(frozen=True, slots=True)
class CategoryKey:
    """A class of objects."""

    category: str
    """One of the judged classes."""


@dataclass(frozen=True, slots=True)
class ObjectCounts:
    """Objects to find in one frame."""

    benign: int
    """By the benign labels."""
    moved: int
    """By the labels that moved with the cars."""


@dataclass(frozen=True, slots=True)
class StoredDetection:
    """One detection, with its matches: a letter for each IoU of 0.5 to 0.95 (t true, f false, i ignored)."""

    picture: str
    """photograph, re-render or counterexample."""
    score: float
    """Shortest decimal number that float32 rounds to the score, in [0, 1]."""
    benign: str
    """Matches to the benign labels."""
    moved: str | None
    """Matches to the moved labels, of a counterexample."""


@dataclass(frozen=True, slots=True)
class ObjectOverlap:
    """How far one object moved away from its benign label."""

    object_index: int
    """Index in the scene."""
    iou: float
    """IoU of the benign and the moved label, in [0, 1]."""


@dataclass(frozen=True, slots=True)
class MatchIou:
    """The IoU from which a detection meets a label."""

    iou: float
    """In [0, 1]."""


@dataclass(frozen=True, slots=True)
class SurvivalCounts:
    """Failures of an arm that survive a second renderer."""

    arm: str
    """Name of the arm."""
    frames: int
    """Frames that the second renderer drew."""
    share: str
    """Which failures."""
    failures: int
    """Number of such failures."""
    survive: int
    """How many of them survive."""


@dataclass(frozen=True, slots=True)
class StateRow:
    """One detector in the sampled states of one kind of a held-out frame."""

    frame: str
    """Identifier of the frame."""
    kind: str
    """Kind of states: anywhere, redrawn or around."""
    detector: str
    """Name of the detector."""
    cars: int
    """Times that a car counts."""
    lost: int
    """Times that it is missed."""
    pictures: int
    """Number of pictures."""
    phantoms: int
    """Pictures with a detection where nothing is."""


@dataclass(frozen=True, slots=True)
class TestedPair:
    """A run and a detector that it was tested on."""

    source: SourceRun
    """The attack."""
    target: TransferTarget
    """The detector."""


@dataclass(frozen=True, slots=True)
class ArmStudyMetadata:
    """study.json of a study that compares arms."""

    settings: StudyConfig
    """Settings of the study."""
    arms: tuple[AttackArm, ...]
    """All arms, controls included."""
    frames_without_vehicles: int
    """Frames skipped for lack of vehicles."""
    frames_failed: dict[str, str]
    """Reason by frame that could not be used."""


@dataclass(frozen=True, slots=True)
class TransferMetadata:
    """study.json of tests on other detectors."""

    settings: StudyConfig
    """Settings of the study."""
    pairs: tuple[TestedPair, ...]
    """All runs and detectors."""
    attacks: AttackTotals | None = None
    """Totals of the attacks, of the study `transfer`."""
    sources: tuple[TransferSource, ...] = ()
    """The attacked detectors, of the study `transfer`."""
    failed: dict[str, str] | None = None
    """Reason by picture that could not be used."""


@dataclass(frozen=True, slots=True)
class RetrainingMetadata:
    """study.json of the study `retrain`."""

    settings: StudyConfig
    """Settings of the study."""
    attack: str
    """Name of the attack on the training frames."""
    training_attacks: AttackTotals
    """Totals of the attacks on the training frames."""
    test_attacks: AttackTotals
    """Totals of the attacks on held-out frames."""
    counterexamples: dict[str, int]
    """Distinct counterexamples by retraining arm."""
    benign_training_frames: int
    """Benign frames to train on."""
    detectors: dict[str, float]
    """t* by detector: the original one, then the retrained ones."""
    left_out: dict[str, str]
    """What was left out, and why."""


@dataclass(frozen=True, slots=True)
class StudyArchive:
    """The stored results of a study that compares arms."""

    settings: StudyConfig
    """Settings of the study."""
    counts: StudyCounts
    """Counts of each arm, frame by frame."""
    confirmed: Mapping[str, Confirmation]
    """Survival under a second renderer by arm, where it was tested."""


def save_study(
    folder: Path, study: StudyConfig, counts: StudyCounts, confirmed: Mapping[str, Confirmation]
) -> None:
    """Write the results of a study that compares arms.

    Args:
        folder: Folder to write, as a whole.
        study: Settings of the study.
        counts: Counts of its arms.
        confirmed: Survival under a second renderer by arm, where it was tested.
    """
    frames = [(arm, place, frame) for arm in counts.arms for place, frame in enumerate(arm.frames)]
    with files.atomic_folder(folder) as out:
        write_metadata(
            out,
            study,
            arms=[
                asdict(one.arm) | {"config": {name: getattr(one.arm.config, name) for name in _ARM_SETTINGS}}
                for one in counts.arms
            ],
            frames_without_vehicles=counts.without_vehicles,
            frames_failed=counts.failed,
        )
        write_table(
            out / _FRAMES,
            (ArmFrameKey, FrameCounts, ObjectCounts),
            (
                (
                    _key(arm, frame),
                    frame,
                    ObjectCounts(int(arm.before.objects[i]), int(arm.after["moved"].objects[i])),
                )
                for arm, i, frame in frames
            ),
        )
        write_table(out / _DETECTIONS, (ArmFrameKey, StoredDetection), _arm_detections(counts.arms))
        write_table(
            out / _FAILURES,
            (ArmFrameKey, FailureRecord),
            ((_key(arm, frame), failure) for arm, _, frame in frames for failure in frame.failures),
        )
        if counts.detected_objects:
            seen = counts.detected_objects.items()
            rows = ((FrameKey(name), one) for name, objects in seen for one in objects)
            write_table(out / _OBJECTS, (FrameKey, DetectedObject), rows)
        if counts.labels:
            labels = [(_key(arm, frame), counts.labels[arm.arm.name][i]) for arm, i, frame in frames]
            overlaps = ((key, ObjectOverlap(*one)) for key, own in labels for one in own.iou.items())
            failures = ((key, MatchIou(iou), one) for key, own in labels for iou, one in own.failures.items())
            write_table(out / _LABELS, (ArmFrameKey, ObjectOverlap), overlaps)
            write_table(out / _LABEL_FAILURES, (ArmFrameKey, MatchIou, LabelFailures), failures)
        if confirmed:
            survival = (
                (SurvivalCounts(arm, one.frames, share.name, share.failures, share.survive),)
                for arm, one in confirmed.items()
                for share in one.shares
            )
            write_table(out / _CONFIRMATIONS, (SurvivalCounts,), survival)


def _key(arm: ArmCounts, frame: FrameCounts) -> ArmFrameKey:
    return ArmFrameKey(frame.identifier, arm.arm.name)


def _arm_detections(arms: Sequence[ArmCounts]) -> Iterable[tuple[ArmFrameKey, StoredDetection]]:
    """Rows by frame, so that equal detections of several arms stand together and compress well."""
    photographs = [store_detections("photograph", arm.before) for arm in arms]
    attacked = [store_detections("counterexample", arm.after["paper"], arm.after["moved"]) for arm in arms]
    for place, frame in enumerate(arms[0].frames):
        for pictures in (photographs, attacked):
            for arm, rows in zip(arms, pictures, strict=True):
                yield from ((_key(arm, frame), row) for row in rows[place])


def store_detections(
    picture: str, benign: ThresholdMatches, moved: ThresholdMatches | None = None, chosen: Booleans | None = None
) -> list[list[StoredDetection]]:
    """Detections of one class as rows, frame by frame.

    Args:
        picture: Kind of picture.
        benign: Matches (N detections) to the benign labels.
        moved: Matches of the same detections to the moved labels.
        chosen: Which detections to store (N,) bool, by default all.
    """
    rows = np.flatnonzero(np.ones(len(benign.score), np.bool_) if chosen is None else chosen)
    words = [
        None if matches is None else ["".join(word) for word in np.array(list(_MARK_LETTERS))[matches.marks[rows]]]
        for matches in (benign, moved)
    ]
    assert words[0] is not None
    stored = [
        StoredDetection(picture, float(str(np.float32(score))), word, other)
        for score, word, other in zip(
            benign.score[rows].tolist(), words[0], words[1] or [None] * len(rows), strict=True
        )
    ]
    ends = np.searchsorted(benign.frame[rows], np.arange(len(benign.objects) + 1)).tolist()
    return [stored[start:end] for start, end in pairwise(ends)]


def load_matches(
    frames: Sequence[Sequence[StoredDetection]], objects: Sequence[int], mode: str
) -> ThresholdMatches:
    """Matches of the stored detections of one class.

    Args:
        frames: Detections of each of F frames.
        objects: Objects to find in each frame (F).
        mode: Label mode, `benign` or `moved`.

    Raises:
        ValueError: A detection without marks for this mode.
    """
    rows = [row for frame in frames for row in frame]
    marks = [[_MARK_LETTERS.index(letter) for letter in getattr(row, mode)] for row in rows]
    return ThresholdMatches(
        frame=np.repeat(np.arange(len(frames)), [len(one) for one in frames]),
        score=np.array([row.score for row in rows], np.float32).astype(np.float64),
        marks=np.array(marks, np.int64).reshape(-1, len(IOU_THRESHOLDS)),
        objects=np.array(objects, np.float64),
    )


def _group(rows: Iterable[tuple[K, V]]) -> Mapping[K, list[V]]:
    groups: dict[K, list[V]] = defaultdict(list)
    for key, value in rows:
        groups[key].append(value)
    return groups


def load_study(folder: Path, name: str) -> StudyArchive:
    """Read what `save_study` wrote, of a study called `name`. Raises FormatError."""
    metadata = read_metadata(folder, ArmStudyMetadata, name)
    rows = read_table(folder / _FRAMES, (ArmFrameKey, FrameCounts, ObjectCounts))
    frames = {key: (counts, objects) for key, counts, objects in rows}
    failures = _group(read_table(folder / _FAILURES, (ArmFrameKey, FailureRecord)))
    detections = _group(
        ((key, row.picture), row) for key, row in read_table(folder / _DETECTIONS, (ArmFrameKey, StoredDetection))
    )
    names = list(dict.fromkeys(key.frame for key, *_ in rows))
    arms = []
    with matching_tables(folder):
        for arm in metadata.arms:
            keys = [ArmFrameKey(frame, arm.name) for frame in names]
            before, after = ([detections[key, p] for key in keys] for p in ("photograph", "counterexample"))
            benign, moved = ([getattr(frames[key][1], mode) for key in keys] for mode in ("benign", "moved"))
            arms.append(
                ArmCounts(
                    arm,
                    tuple(replace(frames[key][0], failures=tuple(failures[key])) for key in keys),
                    load_matches(before, benign, "benign"),
                    {"paper": load_matches(after, benign, "benign"), "moved": load_matches(after, moved, "moved")},
                )
            )
        objects = {}
        if (folder / _OBJECTS).is_file():
            found = _group(read_table(folder / _OBJECTS, (FrameKey, DetectedObject)))
            objects = {frame: tuple(found[FrameKey(frame)]) for frame in names}
        counts = StudyCounts(
            tuple(arms),
            metadata.frames_without_vehicles,
            metadata.frames_failed,
            objects,
            _load_labels(folder, metadata.arms, names) if name == "labels" else {},
        )
        return StudyArchive(metadata.settings, counts, _load_confirmations(folder))


def _load_labels(
    folder: Path, arms: Sequence[AttackArm], names: Sequence[str]
) -> dict[str, tuple[FrameLabels, ...]]:
    overlaps = _group(read_table(folder / _LABELS, (ArmFrameKey, ObjectOverlap)))
    rows = read_table(folder / _LABEL_FAILURES, (ArmFrameKey, MatchIou, LabelFailures))
    failures = _group((key, (iou.iou, own)) for key, iou, own in rows)
    labels: dict[str, tuple[FrameLabels, ...]] = {}
    for arm in arms:
        keys = [ArmFrameKey(name, arm.name) for name in names]
        labels[arm.name] = tuple(
            FrameLabels({one.object_index: one.iou for one in overlaps[key]}, dict(failures[key])) for key in keys
        )
    return labels


def _load_confirmations(folder: Path) -> dict[str, Confirmation]:
    if not (folder / _CONFIRMATIONS).is_file():
        return {}
    rows = _group((row.arm, row) for (row,) in read_table(folder / _CONFIRMATIONS, (SurvivalCounts,)))
    return {
        arm: Confirmation(
            own[0].frames,
            {},
            tuple(
                SurvivalRate.from_outcomes(one.share, [i < one.survive for i in range(one.failures)])
                for one in own
            ),
            {},
            None,
        )
        for arm, own in rows.items()
    }


def _save_pairs(folder: Path, pairs: Sequence[TransferCounts]) -> None:
    """Write frames, objects and detections of runs that were tested on detectors."""
    frames = [
        (pair, place, PairFrameKey(frame.identifier, pair.source.name, pair.target.name), frame)
        for pair in pairs
        for place, frame in enumerate(pair.frames)
    ]
    write_table(folder / _FRAMES, (PairFrameKey, FrameLosses), ((key, frame) for _, _, key, frame in frames))
    counts = (
        (
            key,
            CategoryKey(category),
            ObjectCounts(*(int(pair.pictures[m][category].objects[place]) for m in ("benign", "moved"))),
        )
        for pair, place, key, _ in frames
        for category in pair.target.classes
    )
    found = (row for row in counts if row[2] != ObjectCounts(0, 0))
    write_table(folder / _PAIR_OBJECTS, (PairFrameKey, CategoryKey, ObjectCounts), found)
    rows = ((key, *row) for stored in map(_pair_detections, pairs) for key, own in stored for row in own)
    # by frame, so that equal detections stand together and compress well
    ordered = sorted(rows, key=lambda row: (row[0].frame, row[0].target, row[2].picture))
    write_table(folder / _DETECTIONS, (PairFrameKey, CategoryKey, StoredDetection), ordered)


def _pair_detections(
    pair: TransferCounts,
) -> list[tuple[PairFrameKey, list[tuple[CategoryKey, StoredDetection]]]]:
    """The detections of a pair by frame that affect a metric."""
    keys = [PairFrameKey(frame.identifier, pair.source.name, pair.target.name) for frame in pair.frames]
    rows: list[tuple[PairFrameKey, list[tuple[CategoryKey, StoredDetection]]]] = [(key, []) for key in keys]
    for name in ("benign", "rerendered", "paper"):
        for category, matches in pair.pictures[name].items():
            moved, chosen = None, matches.affects_metrics()
            if name == "paper":
                moved = pair.pictures["moved"][category]
                chosen |= moved.affects_metrics()
            stored = store_detections(_PICTURES[name], matches, moved, chosen)
            for (_, own), detections in zip(rows, stored, strict=True):
                own += [(CategoryKey(category), row) for row in detections]
    return rows


def _load_pairs(folder: Path, tested: Sequence[TestedPair]) -> list[TransferCounts]:
    frames = read_table(folder / _FRAMES, (PairFrameKey, FrameLosses))
    counts = read_table(folder / _PAIR_OBJECTS, (PairFrameKey, CategoryKey, ObjectCounts))
    objects = {(key, one.category): n for key, one, n in counts}
    rows = read_table(folder / _DETECTIONS, (PairFrameKey, CategoryKey, StoredDetection))
    detections = _group(((key, one.category, row.picture), row) for key, one, row in rows)
    by_pair = _group(((key.source, key.target), (key, frame)) for key, frame in frames)
    pairs = []
    with matching_tables(folder):
        for one in tested:
            own = by_pair[one.source.name, one.target.name]
            if not own:
                raise KeyError(f"frames of {one.source.name} tested on {one.target.name}")
            pictures = {
                name: {
                    category: load_matches(
                        [detections[key, category, _PICTURES[name]] for key, _ in own],
                        [getattr(objects.get((key, category), ObjectCounts(0, 0)), mode) for key, _ in own],
                        mode,
                    )
                    for category in one.target.classes
                }
                for name in EVALUATED_PICTURES
                for mode in ["moved" if name == "moved" else "benign"]
            }
            pairs.append(TransferCounts(one.source, one.target, tuple(frame for _, frame in own), pictures))
    return pairs


def _pair_records(pairs: Sequence[TransferCounts]) -> list[dict[str, Any]]:
    return [{"source": asdict(pair.source), "target": asdict(pair.target)} for pair in pairs]


def save_transfer(folder: Path, study: StudyConfig, counts: TransferStudyCounts) -> None:
    """Write the results of the study `transfer`."""
    with files.atomic_folder(folder) as out:
        write_metadata(
            out,
            study,
            pairs=_pair_records(counts.pairs),
            attacks=asdict(counts.attacks),
            sources=[asdict(source) for source in counts.sources],
            failed=dict(counts.failed),
        )
        _save_pairs(out, counts.pairs)


def load_transfer(folder: Path) -> tuple[StudyConfig, TransferStudyCounts]:
    """Read what `save_transfer` wrote. Raises FormatError."""
    metadata = read_metadata(folder, TransferMetadata, "transfer")
    if metadata.attacks is None:
        raise FormatError(f"{folder}: attacks", "totals of the attacks", "none")
    pairs = _load_pairs(folder, metadata.pairs)
    return metadata.settings, TransferStudyCounts(metadata.attacks, metadata.sources, pairs, metadata.failed or {})


def save_retraining(folder: Path, study: StudyConfig, counts: RetrainingCounts) -> None:
    """Write the results of the study `retrain`."""
    objects = counts.benign_matches[BENIGN].matches.objects
    cars = ((FrameKey(name), ObjectCounts(int(n), int(n))) for name, n in _zip(counts, objects))
    detections = (
        (DetectorFrameKey(frame, detector), row)
        for detector, one in counts.benign_matches.items()
        for frame, rows in _zip(
            counts, store_detections("photograph", one.matches, None, one.matches.affects_metrics())
        )
        for row in rows
    )
    states = (
        (StateRow(one.identifier, kind, name, own.cars, own.lost[i], own.pictures, own.phantoms[i]),)
        for one in counts.states
        for kind, own in one.counts.items()
        for i, name in enumerate(counts.benign_matches)
    )
    test = counts.test_attacks
    with files.atomic_folder(folder) as out:
        write_metadata(
            out,
            study,
            attack=counts.attack,
            training_attacks=asdict(counts.training_attacks),
            test_attacks=asdict(test),
            counterexamples=dict(counts.counterexamples),
            benign_training_frames=counts.benign_training_frames,
            detectors={name: one.t_star for name, one in counts.benign_matches.items()},
            left_out=dict(counts.left_out),
        )
        write_table(out / _BENIGN, (FrameKey, ObjectCounts), cars)
        write_table(out / _BENIGN_DETECTIONS, (DetectorFrameKey, StoredDetection), detections)
        write_table(out / _STATES, (StateRow,), states)
        (out / _KNOWN).mkdir()
        write_metadata(out / _KNOWN, study, pairs=_pair_records(counts.known))
        _save_pairs(out / _KNOWN, counts.known)
        fresh = StudyCounts(tuple(counts.fresh), test.without_vehicles, test.failed)
        save_study(out / _FRESH, study, fresh, {})


def _zip(counts: RetrainingCounts, values: Iterable[V]) -> Iterable[tuple[str, V]]:
    return zip(counts.benign_frames, values, strict=True)


def load_retraining(folder: Path) -> tuple[StudyConfig, RetrainingCounts]:
    """Read what `save_retraining` wrote. Raises FormatError."""
    metadata = read_metadata(folder, RetrainingMetadata, "retrain")
    cars = {key.frame: n.benign for key, n in read_table(folder / _BENIGN, (FrameKey, ObjectCounts))}
    detections = _group(read_table(folder / _BENIGN_DETECTIONS, (DetectorFrameKey, StoredDetection)))
    pairs = read_metadata(folder / _KNOWN, TransferMetadata, "retrain").pairs
    with matching_tables(folder):
        matches = {
            name: BenignMatches(
                load_matches(
                    [detections[DetectorFrameKey(frame, name)] for frame in cars], [*cars.values()], "benign"
                ),
                t_star,
            )
            for name, t_star in metadata.detectors.items()
        }
        return metadata.settings, RetrainingCounts(
            attack=metadata.attack,
            training_attacks=metadata.training_attacks,
            test_attacks=metadata.test_attacks,
            counterexamples=metadata.counterexamples,
            benign_training_frames=metadata.benign_training_frames,
            benign_frames=tuple(cars),
            benign_matches=matches,
            known=_load_pairs(folder / _KNOWN, pairs),
            fresh=load_study(folder / _FRESH, "retrain").counts.arms,
            left_out=metadata.left_out,
            states=_load_states(folder / _STATES, [*metadata.detectors]),
        )


def _load_states(path: Path, detectors: Sequence[str]) -> list[FrameStateCounts]:
    rows = {(row.frame, row.kind, row.detector): row for (row,) in read_table(path, (StateRow,))}
    kinds = _group(dict.fromkeys((frame, kind) for frame, kind, _ in rows))
    states = []
    for frame, own in kinds.items():
        counts = {}
        for kind in own:
            by_detector = [rows[frame, kind, name] for name in detectors]
            first = by_detector[0]
            lost, phantoms = (tuple(getattr(row, key) for row in by_detector) for key in ("lost", "phantoms"))
            counts[kind] = FailureCounts(first.cars, lost, first.pictures, phantoms)
        states.append(FrameStateCounts(frame, "", counts, ""))
    return states
