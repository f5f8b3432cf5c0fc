"""How common a run's vehicles are, before and after the attack, and its weather."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from torch import Tensor

from drivesem.attack.space import behind_camera
from drivesem.config.errors import UsageError
from drivesem.data.kitti import read_labels
from drivesem.report.tables import AnalysisReport, ReportTable, format_count
from drivesem.run.finished import AttackRun, RunFrame, load_runs
from drivesem.run.folder import resolve_output_folder
from scene_ir.errors import ShapeError
from scene_ir.io import load_scene
from scene_ir.types import Labels, SceneIR
from tools.experiments.plausibility.percentiles import NAMES, UNUSUAL, Plausibility, plausibility
from tools.experiments.plausibility.weather import CODES, Weather, weather_of
from tools.experiments.settings import PlausibilityConfig as Config

LOWEST = "lowest"
_BEFORE, _AFTER = "labels_paper.txt", "labels_moved.txt"
_DECIMALS = 2
_NOTE = (
    "Percentile: two-sided share of the vehicles in KITTI's 7,481 label files that are at least as unusual; 100 "
    "is the median (for yaw the commonest heading), 0 is never seen. Each figure by itself: distributions are "
    f"marginal, over Car, Van and Truck. Lowest: of a vehicle's figures. Unusual: below {UNUSUAL:g}. Weather "
    "above 100 % of what there may be together is one that hardly ever is."
)


@dataclass(frozen=True, slots=True)
class FramePair:
    """One frame's vehicles before and after the attack, and its weather, where that was changed."""

    identifier: str
    kinds: tuple[str, ...]
    before: Plausibility
    after: Plausibility
    weather: Weather | None = None


def plausibility_run(config: Config) -> AnalysisReport:
    """Look up all vehicles of a run, and write what is said. Raises UsageError or SceneError for bad input."""
    (run,) = load_runs([config.run or ""], config.limit)
    out = resolve_output_folder(config.out, run.folder / "plausibility")
    pairs = [_pair(run, frame) for frame in run.frames]
    if not any(pair.kinds for pair in pairs):
        raise UsageError("--run", "a run with vehicles", run.folder)
    data = {"run": str(run.folder), **summary(pairs)}
    least = tuple((row["frame"], _shown(row["before"]), _shown(row["after"])) for row in data["by_frame"])
    figures = _sheet(data)
    answer = AnalysisReport(
        out=out,
        name="plausibility",
        heading="Plausibility",
        data=data,
        csv_tables={"plausibility": _vehicles(pairs)},
        tables=[
            figures,
            ReportTable("least common vehicle of each frame", ("frame", "before", "after"), least),
            *_weather_sheet(pairs),
        ],
        printed_tables=[figures, *_weather_sheet(pairs)],
        notes=[_NOTE],
        json_only=True,
    )
    answer.write()
    return answer


def _pair(run: AttackRun, frame: RunFrame) -> FramePair:
    identifier = frame.result.identifier
    folder = run.folder / "frames" / identifier
    before, after = (read_labels(folder / name) for name in (_BEFORE, _AFTER))
    if frame.result.change:
        before, after = _in_both(load_scene(folder / "scene"), before, after)
    if before.kind != after.kind:
        raise ShapeError(str(folder / _AFTER), f"the {len(before.kind)} vehicles of {_BEFORE}", len(after.kind))
    return FramePair(identifier, before.kind, plausibility(before), plausibility(after), weather_of(frame.result))


def _in_both(scene: SceneIR, before: Labels, after: Labels) -> tuple[Labels, Labels]:
    """The labels of vehicles that are there before and after another one left or came."""
    first, then = (~behind_camera(state) for state in (scene.origin, scene))
    return _chosen(before, then[first]), _chosen(after, first[then])


def _chosen(labels: Labels, rows: Tensor) -> Labels:
    """Some rows (M,) bool of labels; regions stay."""
    if len(rows) != len(labels.kind):
        raise ShapeError("labels", f"those of the scene's {len(rows)} vehicles", len(labels.kind))
    names = [field.name for field in fields(Labels) if field.name not in ("kind", "ignore_xyxy")]
    kinds = tuple(kind for kind, chosen in zip(labels.kind, rows.tolist(), strict=True) if chosen)
    return replace(labels, kind=kinds, **{name: getattr(labels, name)[rows] for name in names})


def _figures(found: Plausibility) -> dict[str, np.ndarray]:
    return {LOWEST: found.lowest, **found.percentiles}


def summary(pairs: Sequence[FramePair]) -> dict[str, Any]:
    """JSON's form: a row a figure over all vehicles, each frame's least common vehicle, and how near its weather
    comes to what hardly ever is; fractions of 1 for shares, percentiles in [0, 100], None where nothing is known.
    """
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
        {
            "frame": pair.identifier,
            "before": _least(pair.before),
            "after": _least(pair.after),
            "weather": None if pair.weather is None else _rounded(pair.weather.share),
        }
        for pair in pairs
    ]
    beyond = [pair.identifier for pair in pairs if pair.weather is not None and pair.weather.beyond]
    return {"frames": len(pairs), "rows": rows, "by_frame": frames, "weather_beyond": beyond}


def _least(found: Plausibility) -> float | None:
    known = found.lowest[np.isfinite(found.lowest)]
    return _rounded(known.min()) if len(known) else None


def _rounded(value: np.floating[Any] | float) -> float | None:
    return round(float(value), _DECIMALS) if np.isfinite(value) else None


def _vehicles(pairs: Sequence[FramePair]) -> list[dict[str, Any]]:
    """A line a vehicle: each figure before and after."""
    lines = []
    for pair in pairs:
        sides = {"before": _figures(pair.before), "after": _figures(pair.after)}
        for i, kind in enumerate(pair.kinds):
            line: dict[str, Any] = {"frame": pair.identifier, "object": i, "kind": kind}
            lines.append(
                line
                | {f"{n}_{when}": _rounded(side[n][i]) for n in (LOWEST, *NAMES) for when, side in sides.items()}
            )
    return lines


def _weather_sheet(pairs: Sequence[FramePair]) -> list[ReportTable]:
    """A line a frame whose weather was changed, the least likely first; no sheet where none was."""
    known = [(pair.identifier, pair.weather) for pair in pairs if pair.weather is not None]
    known.sort(key=lambda frame: -frame[1].share)
    rows = tuple(
        (name, *(f"{code:.2f}" for code in weather.codes), _shown(weather.share, 100), weather.rule)
        for name, weather in known
    )
    columns = ("frame", *CODES, "of what there may be, %", "by")
    return [ReportTable("weather, and what of it comes together", columns, rows)] if rows else []


def _sheet(data: dict[str, Any]) -> ReportTable:
    title = f"{format_count(data['frames'], 'frame')}: percentiles by KITTI's labels"
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
    return ReportTable(title, columns, rows)


def _shown(value: float | None, factor: float = 1.0) -> str:
    return "-" if value is None else f"{factor * value:.1f}"
