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

from drivesem.config.errors import UsageError
from drivesem.evaluation.resampling import DRAWS, Interval
from drivesem.report.tables import AnalysisReport, ReportTable
from drivesem.run.finished import AttackRun, load_runs
from drivesem.run.folder import resolve_output_folder
from scene_ir import files
from scene_ir.errors import FormatError
from tools.experiments.realism.comparison import frame_parts
from tools.experiments.realism.measures import load
from tools.experiments.settings import WorthConfig
from tools.experiments.worth.by_arm import by_arm
from tools.experiments.worth.measures import (
    MEMBERSHIPS,
    Integers,
    Points,
    Setting,
    classified,
    gain_of,
    realism,
    worth_of,
)
from tools.experiments.worth.runs import (
    SHOWN,
    SecondDetector,
    distance_of,
    distances_of,
    own_points,
    realism_of,
)

_DISTANCES = ("distance", "realism")
"""Columns of a table that are no class."""
_SUM_TOLERANCE = 1e-3
"""How far probabilities of a point may be from 1: tables are rounded."""
_WORDS = ("set", "detector", "membership", "realism weight")
_NOTE = (
    "Information worth: entropy of the true label that is left once the answer is known; 0: the answer tells all. "
    "Gain: the worth before the first detector less that before the second, on the same pictures. In brackets "
    "95 % of the jackknife over frames, less what few of them make too small: a figure may lie below it."
)


@dataclass(frozen=True, slots=True)
class Entry:
    """A data set: name; points before the first detector, and before the second where there is one."""

    name: str
    first: Points
    second: Points | None


def worth_run(config: WorthConfig) -> AnalysisReport:
    """Count, and write what is said of it. Raises UsageError or SceneError for bad input."""
    base = math.e if config.base == "e" else _number(config.base)
    first = Path(config.table).parent if config.table is not None else Path(config.study or config.runs[0])
    out = resolve_output_folder(config.out, first / "worth")
    if config.study is not None:
        answer = by_arm(
            config, base, DRAWS if config.bootstrap is None else config.bootstrap, distance_of(config), out
        )
        answer.write()
        return answer
    facts: dict[str, Any] = {"base": config.base}
    if config.table is not None:
        entries, names = _tables(Path(config.table), None if config.after is None else Path(config.after))
        weighted = [False, True] if any((e.first.realism != 1).any() for e in entries) else [False]
        distance = None
    else:
        runs = load_runs(config.runs, config.limit, "RUN")
        distance = distance_of(config)
        entries, names = _runs(runs, config, distance, out)
        weighted = [False] if distance is None else [False, True]
    facts |= {"distance": distance, "detectors": names}
    settings = [Setting(kind, w, base) for w in weighted for kind in MEMBERSHIPS]
    rows = [row for entry in entries for setting in settings for row in _rows(entry, setting, names)]
    answer = AnalysisReport(
        out=out,
        name="worth",
        heading="Information worth",
        data={**facts, "rows": rows},
        csv_tables={"worth": rows},
        tables=[_sheet(rows)],
        notes=[_NOTE],
        text_columns=_WORDS,
        json_only=True,
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


def _runs(
    runs: Sequence[AttackRun], config: WorthConfig, distance: str | None, out: Path
) -> tuple[list[Entry], list[str]]:
    """Photographs and counterexamples of each run, and the names of the detectors."""
    attacked = sorted({one.detector for one in runs})
    if len(attacked) > 1:
        raise UsageError("RUN", "runs against one detector", " and ".join(attacked))
    second = None if config.second is None else SecondDetector(config.second, config, out)
    folder = None if config.weights is None else Path(config.weights)
    measures = {} if distance is None else load([distance], folder, fetch=False)
    far = [
        [distances_of(f, frame_parts(f, measures) if measures else None, distance or "") for f in one.frames]
        for one in runs
    ]
    rho = realism_of(far)
    if second is not None:
        second.look(runs)
    entries: list[Entry] = []
    for one, own in zip(runs, rho, strict=True):
        for picture, name in SHOWN.items():
            weights = own if picture == "attacked" else None
            other = None if second is None else second.points(one, picture, weights)
            entries.append(Entry(f"{one.name} ({one.params}): {name}", own_points(one, picture, weights), other))
    return entries, attacked if second is None else [*attacked, second.name]


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


def _sheet(rows: Sequence[Mapping[str, Any]]) -> ReportTable:
    columns = ("set", "detector", "membership", "realism weight", "worth", "gain", "points")
    lines = []
    for row in rows:
        shown = "-" if row["value"] is None else f"{row['value']:.4f}"
        if row["low"] is not None:
            shown += f" ({row['low']:.4f} to {row['high']:.4f})"
        weight = "yes" if row["realism_weight"] else "no"
        cells = (shown, "") if row["what"] == "worth" else ("", shown)
        lines.append((row["set"], row["detector"], row["membership"], weight, *cells, str(row["points"])))
    return ReportTable("information worth", columns, tuple(lines))
