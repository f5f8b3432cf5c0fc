"""What `drivesem study transfer` keeps, and what any study keeps of detectors before the pictures of runs.

The latter is a folder of `pairs.json` (runs and detectors), `frames.csv` (a row a run, detector and frame),
`objects.csv.gz` (what there is to find) and `detections.csv.gz`; the study's has `study.json` beside them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Literal

from detectors.types import CLASSES
from drivesem.analysis.transfer.matrix import FrameLosses, PairCounts, ShownRun, Target
from drivesem.attack.targets import HEADLINE
from drivesem.run.records import load_record
from scene_ir import files
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
from tools.experiments.detection.running import AttackTotals
from tools.experiments.detection.transfer import TransferCounts, TransferSource
from tools.experiments.settings import StudyConfig

_SCHEMA = 1
_PAIRS, _FRAMES, _OBJECTS, _DETECTIONS = "pairs.json", "frames.csv", "objects.csv.gz", "detections.csv.gz"
_LOSSES = tuple(field.name for field in fields(FrameLosses) if field.name != "identifier")
Picture = Literal["photograph", "re-render", "counterexample"]
PICTURES: dict[str, Picture] = {
    "benign": "photograph",
    "rerendered": "re-render",
    "paper": "counterexample",
    "moved": "counterexample",
}
"""By the names of SHOWN."""


@dataclass(frozen=True, slots=True)
class PairRow:
    """One frame of a run before a detector, as `FrameLosses` has it. photograph: the run whose detections in the
    photograph are this one's too, mostly the first; rerendered: whether those in the re-render are others.
    """

    source: str
    target: str
    frame: str
    photograph: str
    rerendered: bool
    found: int
    lost: int
    source_lost: int
    both_lost: int
    source_certain: int
    both_certain: int
    source_broken: bool
    broken: bool
    phantoms: int


@dataclass(frozen=True, slots=True)
class ToFindRow:
    """Objects of a class that there are to find, by benign and by moved labels; a class without has no row."""

    source: str
    target: str
    frame: str
    category: str
    benign: int
    moved: int


@dataclass(frozen=True, slots=True)
class FoundRow:
    """One detection. score, benign, moved: as in `kept.DetectionRow`; only counterexamples have moved labels."""

    source: str
    target: str
    frame: str
    picture: Picture
    category: str
    score: float
    benign: str
    moved: str | None


@dataclass(frozen=True, slots=True)
class _KeptPair:
    source: ShownRun
    target: Target


@dataclass(frozen=True, slots=True)
class _Pairs:
    """pairs.json."""

    pairs: tuple[_KeptPair, ...]


_Found = tuple[str, float, str, str | None]
"""Of a FoundRow, from its category on."""
_Key = tuple[str, str, str]
"""A run's name, a detector's, a frame's."""


def write_pairs(folder: Path, pairs: Sequence[PairCounts]) -> None:
    """Into a folder that is there. Runs of equal frames before equal detectors share what is found in these."""
    frames: list[PairRow] = []
    objects: list[ToFindRow] = []
    detections: list[FoundRow] = []
    known: dict[_Key, list[tuple[str, list[int], list[_Found]]]] = {}
    for pair in pairs:
        source, target = pair.source.name, pair.target.name
        shown = {name: _found(pair, name) for name in ("benign", "rerendered", "paper")}
        for place, frame in enumerate(pair.frames):
            key = (source, target, frame.identifier)
            counts = [_to_find(pair, mode, place) for mode in ("benign", "moved")]
            seen, again, attacked = (shown[name][place] for name in shown)
            # by target and frame, whatever the run
            before = known.setdefault(("", target, frame.identifier), [])
            alike = [by for by, n, same in before if (n, same) == (counts[0], seen)]
            told: dict[Picture, list[_Found]] = {
                "photograph": [] if alike else seen,
                "re-render": [] if again == seen else again,
                "counterexample": attacked,
            }
            if not alike:
                before.append((source, counts[0], seen))
            losses = {name: getattr(frame, name) for name in _LOSSES}
            frames.append(PairRow(*key, (alike or [source])[0], again != seen, **losses))
            objects += [
                ToFindRow(*key, *row) for row in zip(pair.target.classes, *counts, strict=True) if any(row[1:])
            ]
            detections += [FoundRow(*key, picture, *row) for picture, rows in told.items() for row in rows]
    head = {"schema": _SCHEMA, "pairs": [{"source": asdict(p.source), "target": asdict(p.target)} for p in pairs]}
    files.write_json(folder / _PAIRS, head)
    write_rows(folder / _FRAMES, PairRow, frames)
    write_rows(folder / _OBJECTS, ToFindRow, objects)
    write_rows(folder / _DETECTIONS, FoundRow, detections)


def _found(pair: PairCounts, name: str) -> list[list[_Found]]:
    """What is detected in the pictures of that name and has a say in a figure, frame by frame; paper: with the
    marks of moved labels.
    """
    frames: list[list[_Found]] = [[] for _ in pair.frames]
    for category, matches in pair.pictures[name].items():
        kept, moved = matches.telling(), None
        if name == "paper":
            other = pair.pictures["moved"][category]
            kept |= other.telling()
            moved = marked(other, kept)
        for place, rows in enumerate(marked(matches, kept)):
            words = [None] * len(rows) if moved is None else [word for _, word in moved[place]]
            frames[place] += [(category, *row, word) for row, word in zip(rows, words, strict=True)]
    return frames


def _to_find(pair: PairCounts, mode: str, place: int) -> list[int]:
    return [int(matches.objects[place]) for matches in pair.pictures[mode].values()]


def read_pairs(folder: Path) -> list[PairCounts]:
    """What `write_pairs` wrote. Raises FormatError naming file, and row or field."""
    where = str(folder / _PAIRS)
    head: _Pairs = load_record(folder / _PAIRS, _Pairs, _SCHEMA)
    pairs = {(one.source.name, one.target.name): one for one in head.pairs}
    require(0 < len(pairs) == len(head.pairs), f"{where}: pairs", "each pair once", len(head.pairs))
    for place, one in enumerate(head.pairs):
        classes, here = one.target.classes, f"{where}: pairs[{place}].target"
        good = HEADLINE in classes and list(classes) == [name for name in CLASSES if name in classes]
        require(good, f"{here}.classes", f"{HEADLINE} and others of {', '.join(CLASSES)}", classes)
        check_score(f"{here}.t_star", one.target.t_star)
    frames = _frames(folder / _FRAMES, pairs)
    objects = _objects(folder / _OBJECTS, frames)
    found = _detections(folder / _DETECTIONS, frames)
    rows = {key: [row for row in frames.values() if (row.source, row.target) == key] for key in pairs}
    return [_pair(one, rows[key], objects, found, str(folder)) for key, one in pairs.items()]


_Objects = Mapping[tuple[_Key, str], ToFindRow]
_Detected = Mapping[tuple[_Key, str], list[FoundRow]]
"""By the run, detector and frame, and the class or the picture."""


def _pair(one: _KeptPair, rows: Sequence[PairRow], objects: _Objects, found: _Detected, where: str) -> PairCounts:
    keys = [(row.source, row.target, row.frame) for row in rows]
    require(bool(rows), where, f"frames of {one.source.name} before {one.target.name}", "none")
    pictures = {}
    for name, picture in PICTURES.items():
        at = [_whose(row, picture) for row in rows]
        mode = "moved" if name == "moved" else "benign"
        pictures[name] = {}
        for category in one.target.classes:
            detected: list[list[Marked]] = [
                [(r.score, getattr(r, mode) or "") for r in found[place] if r.category == category] for place in at
            ]
            told = [objects.get((key, category)) for key in keys]
            counts = [0 if row is None else getattr(row, mode) for row in told]
            here = f"{where}: {one.source.name} before {one.target.name}, {category}"
            pictures[name][category] = matches_of(detected, counts, here)
    frames = tuple(FrameLosses(row.frame, **{name: getattr(row, name) for name in _LOSSES}) for row in rows)
    return PairCounts(one.source, one.target, frames, pictures)


def _whose(row: PairRow, picture: Picture) -> tuple[_Key, Picture]:
    """Where the detections in a picture stand."""
    if picture == "counterexample" or (picture == "re-render" and row.rerendered):
        return (row.source, row.target, row.frame), picture
    return (row.photograph, row.target, row.frame), "photograph"


def _frames(path: Path, pairs: Mapping[tuple[str, str], _KeptPair]) -> dict[_Key, PairRow]:
    found: dict[_Key, PairRow] = {}
    for where, row in read_rows(path, PairRow):
        key = (row.source, row.target, row.frame)
        require(key[:2] in pairs, where, f"a pair of {_PAIRS}", key[:2])
        require(key not in found, where, "each frame once a pair", row.frame)
        check_count(f"{where}: found", row.found)
        check_count(f"{where}: phantoms", row.phantoms)
        for part, whole in (
            ("lost", "found"),
            ("source_lost", "found"),
            ("both_lost", "source_lost"),
            ("source_certain", "source_lost"),
            ("both_certain", "source_certain"),
            ("both_certain", "both_lost"),
        ):
            check_count(f"{where}: {part}", getattr(row, part), getattr(row, whole))
        others = row.source_lost - row.source_certain
        check_count(f"{where}: both_lost", row.both_lost - row.both_certain, others)
        found[key] = row
    for row in found.values():
        first = found.get((row.photograph, row.target, row.frame))
        good = first is not None and first.photograph == row.photograph
        require(good, f"{path}: photograph", "a run that has its own", row.photograph)
    return found


def _objects(path: Path, frames: Mapping[_Key, PairRow]) -> _Objects:
    found: dict[tuple[_Key, str], ToFindRow] = {}
    for where, row in read_rows(path, ToFindRow):
        key = (row.source, row.target, row.frame)
        require(key in frames, where, f"a frame of {_FRAMES}", key)
        require(row.category in CLASSES, f"{where}: category", f"one of {', '.join(CLASSES)}", row.category)
        require((key, row.category) not in found, where, "each class once a frame", row.category)
        check_count(f"{where}: benign", row.benign)
        check_count(f"{where}: moved", row.moved)
        found[key, row.category] = row
    return found


def _detections(path: Path, frames: Mapping[_Key, PairRow]) -> _Detected:
    found: dict[tuple[_Key, str], list[FoundRow]] = {
        (key, picture): [] for key in frames for picture in PICTURES.values()
    }
    for where, row in read_rows(path, FoundRow):
        key = (row.source, row.target, row.frame)
        frame = frames.get(key)
        require(frame is not None, where, f"a frame of {_FRAMES}", key)
        own = frame is None or _whose(frame, row.picture) == (key, row.picture)
        require(own, where, "no picture of which another's detections are told", row.picture)
        require(row.category in CLASSES, f"{where}: category", f"one of {', '.join(CLASSES)}", row.category)
        check_score(where, row.score)
        attacked = row.picture == "counterexample"
        require((row.moved is not None) == attacked, f"{where}: moved", "of counterexamples alone", row.moved)
        check_marks(f"{where}: benign", row.benign)
        check_marks(f"{where}: moved", row.moved)
        found[key, row.picture].append(row)
    return found


@dataclass(frozen=True, slots=True)
class _Head:
    """study.json."""

    settings: StudyConfig
    attacks: AttackTotals
    sources: tuple[TransferSource, ...]
    failed: dict[str, str]


def keep_transfer(folder: Path, study: StudyConfig, counts: TransferCounts) -> None:
    """Write it whole."""
    head = {
        "schema": _SCHEMA,
        "settings": settings_of(study),
        "attacks": asdict(counts.attacks),
        "sources": [asdict(one) for one in counts.sources],
        "failed": dict(counts.failed),
    }
    with files.atomic_folder(folder) as into:
        files.write_json(into / STUDY, head)
        write_pairs(into, counts.pairs)


def load_transfer(folder: Path) -> tuple[StudyConfig, TransferCounts]:
    """What `keep_transfer` wrote. Raises FormatError naming file, and row or field."""
    where = str(folder / STUDY)
    check_name(folder / STUDY, "transfer")
    head: _Head = load_record(folder / STUDY, _Head, _SCHEMA)
    check_settings(head.settings, "transfer", where)
    check_attacks(f"{where}: attacks", head.attacks)
    pairs = read_pairs(folder)
    frames = {(one.source.name, one.target.name): [f.identifier for f in one.frames] for one in pairs}
    require(bool(head.sources), f"{where}: sources", "at least one", "none")
    for place, one in enumerate(head.sources):
        here = f"{where}: sources[{place}]"
        for target in dict.fromkeys(name for _, name in frames):
            own = frames.get((one.name, target))
            require(own is not None, f"{here}.name", f"a run before {target}", one.name)
            beside = one.placebo is None or frames.get((one.placebo, target)) == own
            require(beside, f"{here}.placebo", f"a run of the same frames before {target}", one.placebo)
        for name, values in one.references.items():
            good = all(0 <= value <= 1 for value in values)
            require(good, f"{here}.references.{name}", "from 0 to 1", values)
    return head.settings, TransferCounts(head.attacks, head.sources, pairs, head.failed)


def check_attacks(where: str, attacks: AttackTotals) -> None:
    """Raises FormatError unless it can be."""
    for name in ("frames", "pictures", "without_vehicles"):
        check_count(f"{where}.{name}", getattr(attacks, name))
    check_count(f"{where}.feasible", attacks.feasible, attacks.pictures)
