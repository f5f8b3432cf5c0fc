"""What all kept studies are written and read by: settings, detections as rows, and checks."""

from __future__ import annotations

import gzip
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from drivesem.config.errors import UsageError
from drivesem.config.text import command_line
from drivesem.evaluation.coco import IOU_THRESHOLDS
from drivesem.evaluation.instances import Booleans
from drivesem.evaluation.matches import TRUE, Matches
from drivesem.run.records import dump_rows, load_rows
from scene_ir import files
from scene_ir.errors import FormatError
from tools.experiments.detection.arms import bootstrap_draws
from tools.experiments.settings import StudyConfig

KEPT = "kept"
"""The folder, in the study's."""
STUDY = "study.json"
"""The file in it that says what study it is."""
NOT_TOLD = ("out", "json", "resume", "workers")
"""Settings that say nothing about a study."""
MOST_BYTES = 1 << 28
"""Of a file, unpacked: some million detections."""
MOST = 1 << 31
"""No measure reaches it."""
MOST_DRAWS = 100_000
"""Of frames; and of an arm's steps and queries."""
MARKS = "fti"
"""Letters of FALSE, TRUE and IGNORED."""
T = TypeVar("T")
Marked = tuple[float, str]
"""A detection's score and its marks: a letter for each of IOU_THRESHOLDS, without what repeats at the end."""


def settings_of(study: StudyConfig) -> dict[str, Any]:
    """Those that are kept."""
    return {name: value for name, value in asdict(study).items() if name not in NOT_TOLD}


def command_of(study: StudyConfig) -> str:
    """What repeats it, as it is typed."""
    return command_line("study", study, (*NOT_TOLD, "name")).replace("study", f"study {study.name}", 1)


def check_name(path: Path, name: str) -> None:
    """Raises FormatError where a file STUDY is of a study of another name, which has other fields."""
    data = files.read_json(path)
    for key in ("settings", "name"):
        data = data.get(key) if isinstance(data, dict) else None
    require(data is None or data == name, f"{path}: settings.name", name, data)


def check_settings(study: StudyConfig, name: str, where: str) -> None:
    """Raises FormatError unless these are the settings of a study of that name."""
    require(study.name == name, f"{where}: settings.name", name, study.name)
    try:
        replace(study, pace=None, kept=None).check()  # the folder of other seconds may be gone
    except UsageError as error:
        raise FormatError(f"{where}: settings: {error.field}", error.expected, error.actual) from error
    require(study.seed >= 0, f"{where}: settings.seed", "at least 0", study.seed)
    draws = bootstrap_draws(study)
    require(draws <= MOST_DRAWS, f"{where}: settings.bootstrap", f"at most {MOST_DRAWS}", draws)


def marked(matches: Matches, kept: Booleans | None = None) -> list[list[Marked]]:
    """The detections of each frame. kept (N,): which of them, by default all."""
    chosen = np.ones(len(matches.score), np.bool_) if kept is None else kept
    words = ["".join(letters) for letters in np.array(list(MARKS))[matches.marks[chosen]]]
    scores = matches.score[chosen].tolist()
    rows = [(_short(s), w.rstrip(w[-1]) + w[-1]) for s, w in zip(scores, words, strict=True)]
    ends = np.searchsorted(matches.frame[chosen], np.arange(len(matches.objects) + 1)).tolist()
    return [rows[start:end] for start, end in pairwise(ends)]


def _short(score: float) -> float:
    """The number of the fewest digits that float32 does not tell from this one."""
    short = float(str(np.float32(score)))
    return short if np.float32(short) == score else score


def matches_of(frames: Sequence[Sequence[Marked]], objects: Sequence[int], where: str) -> Matches:
    """Of the detections of each frame, and how many objects there are to find in each."""
    rows = [row for frame in frames for row in frame]
    words = [list(word.ljust(len(IOU_THRESHOLDS), word[-1])) for _, word in rows]
    letters = np.array(words, dtype="U1").reshape(-1, len(IOU_THRESHOLDS))
    marks = np.select([letters == letter for letter in MARKS], list(range(len(MARKS))))
    frame = np.repeat(np.arange(len(frames)), [len(one) for one in frames])
    score = np.array([score for score, _ in rows], np.float32).astype(np.float64)
    hits = np.zeros((len(frames), len(IOU_THRESHOLDS)), np.int64)
    np.add.at(hits, frame, marks == TRUE)
    most = np.array(objects, np.float64)
    require(bool((hits.max(axis=1, initial=0) <= most).all()), where, "no more true ones than objects", "more")
    return Matches(frame, score, marks, most)


def check_score(where: str, score: float) -> None:
    """Raises FormatError unless it is one."""
    require(0 <= score <= 1, f"{where}: score", "0 to 1", score)


def check_marks(where: str, word: str | None) -> None:
    """Raises FormatError unless these are marks. None: of a picture without labels of that mode."""
    good = word is None or (0 < len(word) <= len(IOU_THRESHOLDS) and {*word} <= {*MARKS})
    require(good, where, f"at most {len(IOU_THRESHOLDS)} of the letters {MARKS}", word)


def check_count(where: str, count: int, most: int = MOST - 1) -> None:
    """Raises FormatError unless it is from 0 to `most`."""
    require(0 <= count <= most, where, f"0 to {most}", count)


def write_rows(path: Path, kind: type[Any], rows: Iterable[Any]) -> None:
    """As CSV, packed where the name ends in .gz; equal rows give equal bytes."""
    text = dump_rows(kind, rows)
    if path.suffix == ".gz":
        files.write_bytes(path, gzip.compress(text.encode("utf-8"), mtime=0))
    else:
        files.write_text(path, text)


def read_rows(path: Path, kind: type[T]) -> Iterator[tuple[str, T]]:
    """What `write_rows` wrote, each with its place."""
    if path.suffix == ".gz":
        text = files.decode_utf8(files.read_gzip(path, MOST_BYTES), path)
    else:
        text = files.read_text(path, MOST_BYTES)
    return load_rows(text, kind, str(path))


def require(good: bool, where: str, expected: str, found: object) -> None:
    """FormatError unless it is good."""
    if not good:
        raise FormatError(where, expected, "nothing" if found is None else found)
