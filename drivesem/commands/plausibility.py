"""`drivesem plausibility`: how common a run's vehicles are, before and after the attack."""

from __future__ import annotations

import csv
import io
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from drivesem.data.kitti import read_labels
from drivesem.questions.plausibility import NAMES, UNUSUAL, Plausibility, plausibility
from drivesem.report.tables import Sheet
from drivesem.run.finished import Run, load_runs
from drivesem.settings.commands import Plausibility as Config
from drivesem.settings.errors import UsageError
from scene_ir import files
from scene_ir.errors import ShapeError

LOWEST = "lowest"
_BEFORE, _AFTER = "labels_paper.txt", "labels_moved.txt"
_DECIMALS = 2
_NOTE = (
    "Percentile: two-sided share of the vehicles in KITTI's 7,481 label files that are at least as unusual; 100 "
    "is the median (for yaw the commonest heading), 0 is never seen. Each figure by itself: distributions are "
    f"marginal, over Car, Van and Truck. Lowest: of a vehicle's figures. Unusual: below {UNUSUAL:g}."
)


@dataclass(frozen=True, slots=True)
class FramePair:
    """One frame's vehicles before and after the attack."""

    identifier: str
    kinds: tuple[str, ...]
    before: Plausibility
    after: Plausibility


def run(config: Config) -> int:
    """Look up, report; exit code 0. Raises UsageError or SceneError for bad input."""
    (one,) = load_runs([config.run or ""], config.limit)
    out = Path(config.out) if config.out else one.folder / "plausibility"
    if out.exists() and not out.is_dir():
        raise UsageError("--out", "a folder", f"the file {out}")
    pairs = [_pair(one, frame.result.identifier) for frame in one.frames]
    if not any(pair.kinds for pair in pairs):
        raise UsageError("--run", "a run with vehicles", one.folder)
    data = {"run": str(one.folder), **summary(pairs)}
    files.write_json(out / "plausibility.json", data)
    files.write_text(out / "plausibility.csv", _csv(pairs))
    files.write_text(out / "plausibility.md", _markdown(data))
    if config.json:
        sys.stdout.write(json.dumps(data, allow_nan=False) + "\n")
    else:
        _print(data, Console())
    Console(stderr=True).print(f"written to {out}", soft_wrap=True)
    return 0


def _pair(one: Run, identifier: str) -> FramePair:
    folder = one.folder / "frames" / identifier
    before, after = (read_labels(folder / name) for name in (_BEFORE, _AFTER))
    if before.kind != after.kind:
        raise ShapeError(str(folder / _AFTER), f"the {len(before.kind)} vehicles of {_BEFORE}", len(after.kind))
    return FramePair(identifier, before.kind, plausibility(before), plausibility(after))


def _figures(found: Plausibility) -> dict[str, np.ndarray]:
    return {LOWEST: found.lowest, **found.percentiles}


def summary(pairs: Sequence[FramePair]) -> dict[str, Any]:
    """JSON's form: a row a figure over all vehicles, and each frame's least common vehicle; fractions of 1 for
    shares, percentiles in [0, 100], None where nothing is known."""
    rows = []
    for name in (LOWEST, *NAMES):
        before, after = (
            np.concatenate([_figures(side)[name] for side in sides])
            for sides in ([p.before for p in pairs], [p.after for p in pairs])
        )
        known = np.isfinite(before) & np.isfinite(after)
        before, after = before[known], after[known]
        rows.append(
            {
                "name": name,
                "vehicles": len(before),
                "median_before": _rounded(np.median(before)) if len(before) else None,
                "median_after": _rounded(np.median(after)) if len(after) else None,
                "unusual_before": float((before < UNUSUAL).mean()) if len(before) else None,
                "unusual_after": float((after < UNUSUAL).mean()) if len(after) else None,
                "largest_fall": _rounded((before - after).max()) if len(before) else None,
            }
        )
    frames = [
        {"frame": pair.identifier, "before": _least(pair.before), "after": _least(pair.after)} for pair in pairs
    ]
    return {"frames": len(pairs), "rows": rows, "by_frame": frames}


def _least(found: Plausibility) -> float | None:
    known = found.lowest[np.isfinite(found.lowest)]
    return _rounded(known.min()) if len(known) else None


def _rounded(value: np.floating[Any] | float) -> float | None:
    return round(float(value), _DECIMALS) if np.isfinite(value) else None


def _csv(pairs: Sequence[FramePair]) -> str:
    """A line a vehicle: each figure before and after."""
    buffer = io.StringIO()
    names = (LOWEST, *NAMES)
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["frame", "object", "kind", *(f"{n}_{when}" for n in names for when in ("before", "after"))])
    for pair in pairs:
        before, after = _figures(pair.before), _figures(pair.after)
        for i, kind in enumerate(pair.kinds):
            cells = [_rounded(side[name][i]) for name in names for side in (before, after)]
            writer.writerow([pair.identifier, i, kind, *("" if cell is None else cell for cell in cells)])
    return buffer.getvalue()


def _sheet(data: dict[str, Any]) -> Sheet:
    title = f"{data['frames']} frames: percentiles by KITTI's labels"
    columns = ("figure", "vehicles", "median before", "after", "unusual before, %", "after, %", "largest fall")
    rows = tuple(
        (
            row["name"],
            str(row["vehicles"]),
            _shown(row["median_before"]),
            _shown(row["median_after"]),
            _shown(row["unusual_before"], 100),
            _shown(row["unusual_after"], 100),
            _shown(row["largest_fall"]),
        )
        for row in data["rows"]
    )
    return Sheet(title, columns, rows)


def _shown(value: float | None, factor: float = 1.0) -> str:
    return "-" if value is None else f"{factor * value:.1f}"


def _markdown(data: dict[str, Any]) -> str:
    rows = tuple((one["frame"], _shown(one["before"]), _shown(one["after"])) for one in data["by_frame"])
    sheets = (_sheet(data), Sheet("least common vehicle of each frame", ("frame", "before", "after"), rows))
    lines = [line for sheet in sheets for line in (*sheet.markdown(sheet.columns[:1]), "")]
    return "\n".join(["# Plausibility", "", *lines, _NOTE, ""])


def _print(data: dict[str, Any], console: Console) -> None:
    sheet = _sheet(data)
    console.print(sheet.table(sheet.columns[:1]))
    console.print(_NOTE, soft_wrap=True)
