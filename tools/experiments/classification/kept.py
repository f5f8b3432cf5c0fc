"""What the study of image classifiers keeps: the same tables come from it without objects, networks or run.

A folder: `study.json` (settings, networks, pictures), `answers.csv` (a row a network and set of pictures),
`distances.csv.gz` and `chances.csv.gz` (a row a picture), `sets.csv` (Frechet distances). Columns are the fields
of the classes below; all are keyed as `results` asks for them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from drivesem.classify.objects.types import SPLITS
from drivesem.run.records import load_record
from scene_ir import files
from scene_ir.errors import FormatError
from tools.experiments.classification.lab import TABLES
from tools.experiments.classification.results import OVERALL, StudyFacts, K, Key, ClassificationResults
from tools.experiments.detection.kept_rows import (
    STUDY,
    check_count,
    check_name,
    check_settings,
    read_rows,
    require,
    settings_of,
    write_rows,
)
from tools.experiments.realism.measures import METRICS
from tools.experiments.worth.measures import Floats

_SCHEMA = 1
_ANSWERS, _SETS = "answers.csv", "sets.csv"
_DISTANCES, _CHANCES = "distances.csv.gz", "chances.csv.gz"


@dataclass(frozen=True, slots=True)
class AnswersRow:
    """A network before pictures. what: attacked, known, fresh, crossed or pixels; strategy: by which the pictures
    were made, or benign; other: the arms' kind, what the network was trained on, or the network that is asked;
    right: a letter a picture, 1 where it is classified rightly.
    """

    what: str
    network: str
    strategy: str
    other: str | None
    right: str


@dataclass(frozen=True, slots=True)
class DistanceRow:
    """A picture and what it was before. what: counterexamples, or pixels after an attack on these; PSNR's
    distances are squared errors.
    """

    what: str
    network: str
    strategy: str
    metric: str | None
    picture: int
    distance: float


@dataclass(frozen=True, slots=True)
class ChancesRow:
    """A network's softmax for a picture, with blanks between classes. trained: on what, nothing as it was."""

    network: str
    strategy: str
    trained: str | None
    picture: int
    chances: str


@dataclass(frozen=True, slots=True)
class SetRow:
    """A Frechet distance between pictures before and after, of a class or of all; nothing of too few."""

    network: str
    strategy: str
    metric: str
    kind: str
    distance: float | None


@dataclass(frozen=True, slots=True)
class CertainRow:
    """Failures that are certain; nothing where that was not asked."""

    network: str
    strategy: str
    failures: int | None


@dataclass(frozen=True, slots=True)
class _Head:
    """study.json."""

    facts: StudyFacts
    certain: tuple[CertainRow, ...]


def keep_results(folder: Path, results: ClassificationResults) -> None:
    """Write what was noted, whole."""
    facts = asdict(results.facts) | {"study": settings_of(results.facts.study)}
    certain = [asdict(CertainRow(*key, count)) for key, count in results.certain_failures.items()]
    answers = (AnswersRow(*key, "".join("01"[bool(one)] for one in right)) for key, right in results.correct.items())
    distances = (
        DistanceRow(*key, place, far)
        for key, column in results.distances.items()
        for place, far in enumerate(column.tolist())
    )
    chances = (
        ChancesRow(*key, place, " ".join(map(repr, row)))
        for key, rows in results.probabilities.items()
        for place, row in enumerate(rows.tolist())
    )
    sets = (SetRow(*key, distance) for key, distance in results.sets.items())
    with files.atomic_folder(folder) as into:
        files.write_json(into / STUDY, {"schema": _SCHEMA, "facts": facts, "certain": certain})
        write_rows(into / _ANSWERS, AnswersRow, answers)
        write_rows(into / _DISTANCES, DistanceRow, distances)
        write_rows(into / _CHANCES, ChancesRow, chances)
        write_rows(into / _SETS, SetRow, sets)


def load_results(folder: Path) -> ClassificationResults:
    """What `keep_results` wrote. Raises FormatError naming file, and row or field."""
    check_name(folder / STUDY, "classification")
    head: _Head = load_record(folder / STUDY, _Head, _SCHEMA)
    facts = head.facts
    _check_facts(facts, f"{folder / STUDY}: facts")
    for one in head.certain:
        check_count(f"{folder / STUDY}: certain", one.failures or 0)
    return ClassificationResults(
        facts,
        correct=_right(folder / _ANSWERS, facts),
        probabilities=_chances(folder / _CHANCES, facts),
        distances=_distances(folder / _DISTANCES, len(facts.pictures)),
        sets=_sets(folder / _SETS, facts),
        certain_failures={(one.network, one.strategy): one.failures for one in head.certain},
    )


def _check_facts(facts: StudyFacts, where: str) -> None:
    check_settings(facts.study, "classification", where)
    classes = facts.classes
    require(bool(classes) and len(set(classes)) == len(classes), f"{where}: classes", "each once", classes)
    names = [one.name for one in facts.networks]
    require(bool(names) and len(set(names)) == len(names), f"{where}: networks", "each once", names)
    tables, known = set(facts.tables), set(TABLES)
    require(bool(tables) and tables <= known, f"{where}: tables", f"of {', '.join(TABLES)}", facts.tables)
    require(set(facts.measures) <= set(METRICS), f"{where}: measures", f"of {', '.join(METRICS)}", facts.measures)
    pairwise = facts.distance in METRICS and METRICS[facts.distance].pairwise
    require(pairwise, f"{where}: distance", "one of pictures", facts.distance)
    kinds = {name.partition("/")[0] for name in facts.pictures}
    require(bool(kinds) and kinds <= set(classes), f"{where}: pictures", "objects of these classes", sorted(kinds))
    for place in facts.retested:
        check_count(f"{where}: few", place, len(facts.pictures) - 1)
    for name, splits, wanted in (("objects", facts.objects, SPLITS), ("used", facts.used, ("test", "train"))):
        good = set(splits) == set(wanted) and all(set(counts) == set(classes) for counts in splits.values())
        require(good, f"{where}: {name}", f"{', '.join(wanted)}, each class", list(splits))
    require(set(facts.counts) == {"test", "train", "retrained"}, f"{where}: counts", "three", list(facts.counts))


def _right(path: Path, facts: StudyFacts) -> dict[Key, np.ndarray]:
    found: dict[Key, np.ndarray] = {}
    for where, row in read_rows(path, AnswersRow):
        key = (row.what, row.network, row.strategy, row.other or "")
        require(key not in found, where, "each set of pictures once", key)
        count = len(facts.retested if row.what == "fresh" else facts.pictures)
        good = len(row.right) == count and {*row.right} <= {*"01"}
        require(good, f"{where}: right", f"{count} of the letters 0 and 1", row.right[:20])
        found[key] = np.array([letter == "1" for letter in row.right], np.bool_)
    return found


def _distances(path: Path, count: int) -> dict[Key, Floats]:
    def values() -> Iterator[tuple[str, Key, int, float]]:
        for where, row in read_rows(path, DistanceRow):
            require(row.distance >= 0, f"{where}: distance", "at least 0", row.distance)
            yield where, (row.what, row.network, row.strategy, row.metric or ""), row.picture, row.distance

    return _columns(values(), count, path)


def _chances(path: Path, facts: StudyFacts) -> dict[tuple[str, str, str], Floats]:
    def values() -> Iterator[tuple[str, tuple[str, str, str], int, list[float]]]:
        for where, row in read_rows(path, ChancesRow):
            try:
                chances = [float(word) for word in row.chances.split()]
            except ValueError as error:
                raise FormatError(f"{where}: chances", "numbers", error) from error
            good = (
                len(chances) == len(facts.classes) and all(0 <= one <= 1 for one in chances) and sum(chances) > 0
            )
            require(good, f"{where}: chances", f"{len(facts.classes)} from 0 to 1", row.chances[:40])
            yield where, (row.network, row.strategy, row.trained or ""), row.picture, chances

    return _columns(values(), len(facts.pictures), path)


def _columns(rows: Iterator[tuple[str, K, int, float | list[float]]], count: int, path: Path) -> dict[K, Floats]:
    """Values by key, of each picture one, in their order."""
    found: dict[K, list[float | list[float]]] = {}
    for where, key, picture, value in rows:
        column = found.setdefault(key, [])
        require(picture == len(column) < count, f"{where}: picture", f"{len(column)}, of {count}", picture)
        column.append(value)
    for key, column in found.items():
        expected = f"{count} pictures of {', '.join(filter(None, key))}"
        require(len(column) == count, str(path), expected, len(column))
    return {key: np.array(column, np.float64) for key, column in found.items()}


def _sets(path: Path, facts: StudyFacts) -> dict[Key, float | None]:
    found: dict[Key, float | None] = {}
    for where, row in read_rows(path, SetRow):
        key = (row.network, row.strategy, row.metric, row.kind)
        require(row.kind in (*facts.classes, OVERALL), f"{where}: kind", f"a class or {OVERALL}", row.kind)
        require(key not in found, where, "each set once", key)
        found[key] = row.distance
    return found
