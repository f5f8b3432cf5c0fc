"""How much counterexamples could teach, and how much a second detector has learnt from them."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from detectors.base import DetectorError
from detectors.types import CLASSES, Detections
from drivesem.attack.judging import JudgedClasses, t_star_of
from drivesem.evaluation.resampling import DRAWS, Interval
from drivesem.questions.realism.comparison import Measures, frame_parts
from drivesem.questions.realism.measures import METRICS, load, missing
from drivesem.questions.transfer.asking import DETECTIONS
from drivesem.questions.worth.measures import (
    MEMBERSHIPS,
    Floats,
    Integers,
    Points,
    Setting,
    classified,
    detected,
    gain_of,
    joined,
    realism,
    worth_of,
)
from drivesem.report.answer import Answer
from drivesem.report.tables import Sheet
from drivesem.run.finished import METRICS as RUN_FIGURES
from drivesem.run.finished import Frame, Run, load_runs
from drivesem.run.folder import folder_of
from drivesem.run.frame import as_detections, as_targets
from drivesem.run.looking import Memory, Order, look
from drivesem.run.results import BoxRecord
from drivesem.settings.blocks import Sharing
from drivesem.settings.commands import Worth
from drivesem.settings.errors import UsageError
from drivesem.training.retraining import WEIGHTS
from scene_ir import files
from scene_ir.errors import FormatError

PREFERRED = ("lpips-alex", "perceptual")
"""The distance behind realism: LPIPS as in the paper where its weights are there."""
_DISTANCES = ("distance", "realism")
"""Columns of a table that are no class."""
_SUM_TOLERANCE = 1e-3
"""How far probabilities of a point may be from 1: tables are rounded."""
_WORDS = ("set", "detector", "membership", "realism weight")
_NOTE = (
    "Information worth: entropy of the true label that is left once the answer is known; 0: the answer tells all. "
    "Gain: the worth before the first detector less that before the second, on the same pictures. In brackets "
    "95 % of the bootstrap over frames."
)


@dataclass(frozen=True, slots=True)
class Entry:
    """A data set: name; points before the first detector, and before the second where there is one."""

    name: str
    first: Points
    second: Points | None


def worth_run(config: Worth) -> Answer:
    """Count, and write what is said of it. Raises UsageError or SceneError for bad input."""
    base = math.e if config.base == "e" else _number(config.base)
    draws = DRAWS if config.bootstrap is None else config.bootstrap
    first = Path(config.table).parent if config.table is not None else Path(config.runs[0])
    out = folder_of(config.out, first / "worth")
    facts: dict[str, Any] = {"base": config.base, "bootstrap": draws}
    if config.table is not None:
        entries, names = _tables(Path(config.table), None if config.after is None else Path(config.after))
        weighted = [False, True] if any((e.first.realism != 1).any() for e in entries) else [False]
        distance = None
    else:
        runs = load_runs(config.runs, config.limit, "RUN")
        distance = _distance(config)
        entries, names = _runs(runs, config, distance, out)
        weighted = [False] if distance is None else [False, True]
    facts |= {"distance": distance, "detectors": names}
    settings = [Setting(kind, w, base, draws, config.seed) for w in weighted for kind in MEMBERSHIPS]
    rows = [row for entry in entries for setting in settings for row in _rows(entry, setting, names)]
    answer = Answer(
        out=out,
        name="worth",
        heading="Information worth",
        data={**facts, "rows": rows},
        tables={"worth": rows},
        sheets=[_sheet(rows)],
        notes=[_NOTE],
        words=_WORDS,
        only_json=True,
    )
    answer.write()
    return answer


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 1):
        raise UsageError("--base", "e, or a number above 1", repr(text))
    return value


def _distance(config: Worth) -> str | None:
    folder = None if config.weights is None else Path(config.weights)
    if config.distance == "none":
        return None
    if config.distance is None:
        return next(name for name in PREFERRED if missing(name, folder) is None)
    known = [name for name, metric in METRICS.items() if metric.pairwise and not metric.squared and name != "ssim"]
    if config.distance not in known:
        raise UsageError("--distance", f"none, {', '.join(known)}", repr(config.distance))
    return config.distance


def _runs(runs: Sequence[Run], config: Worth, distance: str | None, out: Path) -> tuple[list[Entry], list[str]]:
    """Photographs and counterexamples of each run, and the names of the detectors."""
    attacked = sorted({one.detector for one in runs})
    if len(attacked) > 1:
        raise UsageError("RUN", "runs against one detector", " and ".join(attacked))
    second = None if config.second is None else _Second(config, out)
    folder = None if config.weights is None else Path(config.weights)
    measures = {} if distance is None else load([distance], folder, fetch=False)
    far = [[_distances(frame, measures) for frame in one.frames] for one in runs]
    largest = max((float(d.max(initial=0)) for frames in far for d in frames), default=0.0)
    entries: list[Entry] = []
    for one, distances in zip(runs, far, strict=True):
        t_star = float(files.read_json(one.folder / RUN_FIGURES)["t_star"])
        for picture, name in (("benign", "photographs"), ("attacked", "counterexamples")):
            sides: tuple[list[Points], list[Points]] = ([], [])
            for frame, d in zip(one.frames, distances, strict=True):
                rho = None if picture == "benign" else realism(d, largest)
                found = getattr(frame.result, f"detections_{picture}")
                sides[0].append(_points(frame, picture, as_detections(found, CLASSES), t_star, rho))
                if second is not None:
                    asked = second.find(frame.pictures[picture])
                    sides[1].append(_points(frame, picture, asked, second.t_star, rho))
            other = joined(sides[1]) if second is not None else None
            entries.append(Entry(f"{one.name} ({one.params}): {name}", joined(sides[0]), other))
    return entries, attacked if second is None else [*attacked, second.name]


def _kept(frame: Frame) -> list[tuple[BoxRecord, BoxRecord]]:
    """Objects that are judged before and after."""
    result = frame.result
    pairs = zip(result.targets_benign, result.targets_moved, strict=True)
    return [(a, b) for a, b in pairs if not (a.ignore or b.ignore)]


def _distances(frame: Frame, measures: Measures) -> Floats:
    """Of each judged object's surroundings before and after (M,), by the one measure; 0 without one."""
    kept = _kept(frame)
    if not measures:
        return np.zeros(len(kept))
    (name,) = measures
    parts = frame_parts(frame, measures).region("boxes")
    by_index = {part.index: part.distances[name]["benign", "attacked"] for part in parts}
    return np.array([by_index[a.index] for a, _ in kept], np.float64)


def _points(frame: Frame, picture: str, found: Detections, t_star: float, rho: Floats | None) -> Points:
    result = frame.result
    records = result.targets_benign if picture == "benign" else result.targets_moved
    other = result.targets_moved if picture == "benign" else result.targets_benign
    targets = as_targets(records, CLASSES)
    # The same objects before and after, or the sets could not be compared.
    targets.ignore.logical_or_(torch.tensor([box.ignore for box in other], dtype=torch.bool))
    return detected(targets, found, t_star, rho)


class _Second:
    """Another detector, or the same one retrained: what it finds is remembered by the pictures' content."""

    def __init__(self, config: Worth, out: Path) -> None:
        assert config.second is not None
        path = Path(config.second)
        name = str(path / WEIGHTS) if (path / WEIGHTS).is_file() else config.second
        self._settings = Sharing(workers=1)
        self._order = Order(name, config.device, config.tiles, out / DETECTIONS)
        try:
            self._predictor = self._order.load()
            self._names = JudgedClasses.of(self._predictor).names
        except DetectorError as error:
            raise UsageError("--second", "a detector, or a run of drivesem retrain", error) from error
        self._memory = Memory(self._order, self._predictor)
        self.name, self.t_star = name, t_star_of(self._predictor)

    def find(self, picture: Path) -> Detections:
        """Detections whose labels are places in CLASSES."""
        look(self._order, self._predictor, [picture], self._settings, self.name)
        found = self._memory.recall(picture)
        places = torch.tensor([CLASSES.index(name) for name in self._names])
        return Detections(found.boxes_xyxy, places[found.labels], found.scores)


def _tables(path: Path, after: Path | None) -> tuple[list[Entry], list[str]]:
    first, classes, labels = _table(path)
    second = None
    if after is not None:
        second, other, truth = _table(after)
        if other != classes or not np.array_equal(labels, truth):
            raise UsageError("--after", f"the classes and labels of {path.name}, line by line", after)
    return [Entry(path.stem, first, second)], [path.stem, *([] if after is None else [after.stem])]


def _table(path: Path) -> tuple[Points, tuple[str, ...], Integers]:
    """A CSV file of probabilities: label, a column a class, and distance or realism where known.

    Raises FormatError naming the line.
    """
    reader = csv.DictReader(io.StringIO(files.read_text(path), newline=""))
    columns = list(reader.fieldnames or ())
    classes = tuple(name for name in columns if name not in ("label", *_DISTANCES))
    if "label" not in columns or not classes or len(set(columns)) < len(columns):
        raise FormatError(str(path), "columns label and one a class", ", ".join(columns) or "nothing")
    if set(_DISTANCES) <= set(columns):
        raise FormatError(str(path), "one of distance and realism", "both")
    probabilities, labels, extra = [], [], []
    for number, line in enumerate(reader, start=2):
        where = f"{path}:{number}"
        if line["label"] not in classes:
            raise FormatError(f"{where}: label", f"one of {', '.join(classes)}", repr(line["label"]))
        labels.append(classes.index(line["label"]))
        probabilities.append([_fraction(where, name, line) for name in classes])
        if abs(sum(probabilities[-1]) - 1) > _SUM_TOLERANCE:
            raise FormatError(where, "probabilities that add up to 1", f"{sum(probabilities[-1]):.4g}")
        if "realism" in columns:
            extra.append(_fraction(where, "realism", line))
        elif "distance" in columns:
            extra.append(_fraction(where, "distance", line, math.inf))
    if not labels:
        raise FormatError(str(path), "a line a point", "none")
    rho = np.array(extra) if extra else None
    if rho is not None and "distance" in columns:
        rho = realism(rho)
    label = np.array(labels, np.int64)
    return classified(np.array(probabilities), label, rho), classes, label


def _fraction(where: str, name: str, line: Mapping[str, str | None], most: float = 1.0) -> float:
    try:
        value = float(line[name] or "")
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and 0 <= value <= most):
        raise FormatError(
            f"{where}: {name}", "a number in [0, 1]" if most == 1 else "a number of at least 0", repr(line[name])
        )
    return value


def _rows(entry: Entry, setting: Setting, names: Sequence[str]) -> list[dict[str, Any]]:
    """Worth before each detector, and the gain."""

    def row(detector: str, what: str, one: Interval) -> dict[str, Any]:
        return {
            "set": entry.name,
            "detector": detector,
            "membership": setting.kind,
            "realism_weight": setting.weighted,
            "what": what,
            "value": one.value,
            "low": one.low,
            "high": one.high,
            "points": len(entry.first.label),
        }

    found = [row(names[0], "worth", worth_of(entry.first, setting))]
    if entry.second is not None:
        found.append(row(names[1], "worth", worth_of(entry.second, setting)))
        found.append(row(names[1], "gain", gain_of(entry.first, entry.second, setting)))
    return found


def _sheet(rows: Sequence[Mapping[str, Any]]) -> Sheet:
    columns = ("set", "detector", "membership", "realism weight", "worth", "gain", "points")
    lines = []
    for row in rows:
        shown = "-" if row["value"] is None else f"{row['value']:.4f}"
        if row["low"] is not None:
            shown += f" ({row['low']:.4f} to {row['high']:.4f})"
        weight = "yes" if row["realism_weight"] else "no"
        cells = (shown, "") if row["what"] == "worth" else ("", shown)
        lines.append((row["set"], row["detector"], row["membership"], weight, *cells, str(row["points"])))
    return Sheet("information worth", columns, tuple(lines))
