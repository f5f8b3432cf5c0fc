"""How common the vehicles of a run are before and after the attack, by KITTI's training labels, and its weather.

The reference is the histograms of all 7,481 label files that ship with the scene generator
(`drivesem.synth.compare`): each quantity by itself, over Car, Van and Truck. Two common values may still be an
uncommon pair, which these percentiles do not show.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np
from torch import Tensor

from drivesem.attacks.feasible.constraints import CODE_SUM_LIMITS, CODE_SUMS, RULE_NAMES
from drivesem.attacks.space import SPECS, Parameter, behind_camera
from drivesem.config.errors import UsageError
from drivesem.data.kitti import read_labels
from drivesem.reporting.tables import AnalysisReport, ReportTable, format_count
from drivesem.run.finished import AttackRun, RunFrame, load_runs
from drivesem.run.folder import FRAMES, resolve_output_folder
from drivesem.run.results import FrameResult
from drivesem.synth.compare import QUANTITIES, VEHICLES, Histograms, Quantity, measure_labels, reference
from scene_ir.errors import RangeError, ShapeError
from scene_ir.io import load_scene
from scene_ir.types import Labels
from tools.experiments.settings import PlausibilityConfig

NAMES = ("depth_m", "lateral_m", "yaw_rad", "height_m", "length_m", "width_m", "spacing_m")
"""Distance ahead, lateral position, yaw in camera axes, size, and ground distance to the nearest other vehicle."""
LOWEST = "lowest"
"""Name of a vehicle's lowest percentile."""
UNUSUAL = 5.0
"""Percentile below which a value counts as unusual."""
WEATHER_CODES = tuple(name.partition(".")[2] for name in SPECS[Parameter.WEATHER].names)
_ANGLE_STEPS = 720
"""Steps of the circle at which densities of angles are compared: half a degree."""
_SLACK = 1e-5
"""Float32 rounding of a weather on its limit."""
_BEFORE, _AFTER = "labels_paper.txt", "labels_moved.txt"
_DECIMALS = 2
_NOTE = (
    "Percentile: two-sided share of the vehicles in KITTI's 7,481 label files that are at least as unusual; 100 is "
    "the median (for yaw the commonest heading), 0 never occurs. Each quantity by itself: distributions are "
    f"marginal, over Car, Van and Truck. Lowest: of a vehicle's quantities. Unusual: below {UNUSUAL:g}. Weather "
    "above 100 % of a limit hardly ever occurs."
)


@dataclass(frozen=True, slots=True)
class PercentileScale:
    """Percentiles of one quantity."""

    quantity: Quantity
    """The quantity."""
    shares: np.ndarray
    """Share of the reference's vehicles in each bin (B,)."""

    def percentiles(self, values: np.ndarray) -> np.ndarray:
        """Percentiles (n,) in [0, 100] of values (n,): 100 is the median or the commonest angle; NaN stays NaN.

        Two-sided: twice the share of vehicles beyond the value on its side; for angles, the share of vehicles
        with an angle that is no commoner.
        """
        found = np.full(len(values), np.nan)
        known = np.isfinite(values)
        compute = self._from_density if self.quantity.angle else self._from_tails
        found[known] = compute(np.asarray(values, float)[known])
        return found

    def _from_tails(self, values: np.ndarray) -> np.ndarray:
        edges, middles = np.asarray(self.quantity.edges), self.quantity.middles
        # the end bins also hold what lies beyond them: nothing is known beyond their middles
        inside = np.clip(values, middles[0], middles[-1])
        below = np.interp(inside, edges, np.concatenate([[0.0], np.cumsum(self.shares)]) / self.shares.sum())
        return np.clip(200 * np.minimum(below, 1 - below), 0.0, 100.0)

    def _from_density(self, values: np.ndarray) -> np.ndarray:
        order = np.sort(self._density(np.arange(_ANGLE_STEPS) * (2 * math.pi / _ANGLE_STEPS)))
        mass = np.concatenate([[0.0], np.cumsum(order)]) / order.sum()
        # a margin for rounding: the commonest angle is no commoner than itself
        return 100 * mass[np.searchsorted(order, self._density(values) * (1 + 1e-9), side="right")]

    def _density(self, angles: np.ndarray) -> np.ndarray:
        """Interpolated between the middles of equal bins around the circle."""
        return np.interp(angles, self.quantity.middles, self.shares, period=2 * math.pi)


@lru_cache(maxsize=1)
def kitti_scales() -> Mapping[str, PercentileScale]:
    """KITTI's scales by name."""
    return build_scales(reference())


def build_scales(histograms: Histograms) -> dict[str, PercentileScale]:
    """Scales of a data set's histograms. Raises RangeError for an empty one."""
    for name in NAMES:
        if not histograms.shares[name].any():
            raise RangeError(f"histograms: {name}", "at least one vehicle", "none")
    return {name: PercentileScale(QUANTITIES[name], histograms.shares[name]) for name in NAMES}


@dataclass(frozen=True, slots=True)
class VehiclePlausibility:
    """How common the N vehicles of a frame are."""

    percentiles: Mapping[str, np.ndarray]
    """Percentiles (N,) by name; NaN if unknown, as the spacing of a single vehicle."""

    @property
    def table(self) -> np.ndarray:
        """Percentiles (N, 7) in the order of NAMES."""
        return np.stack([self.percentiles[name] for name in NAMES], axis=1)

    @property
    def lowest(self) -> np.ndarray:
        """The lowest percentile of each vehicle (N,); NaN if all are unknown."""
        table = self.table
        known = np.isfinite(table).any(axis=1)
        return np.where(known, np.where(np.isfinite(table), table, np.inf).min(axis=1, initial=np.inf), np.nan)

    @property
    def all_percentiles(self) -> dict[str, np.ndarray]:
        """Percentiles by name, the lowest first."""
        return {LOWEST: self.lowest, **self.percentiles}


def vehicle_plausibility(
    labels: Labels, scales: Mapping[str, PercentileScale] | None = None
) -> VehiclePlausibility:
    """How common the Cars, Vans and Trucks of a frame are, in the order of their labels; other classes are left out.

    Poses are in KITTI's camera axes; scales: by default KITTI's. Raises RangeError for a vehicle without a pose.
    """
    scales = kitti_scales() if scales is None else scales
    count = sum(kind in VEHICLES for kind in labels.kind)
    values = measure_labels(labels)
    if len(values["depth_m"]) != count:
        raise RangeError("labels", f"{count} vehicles with poses", len(values["depth_m"]))
    # a single vehicle has no neighbour
    padded = {name: values[name] if len(values[name]) == count else np.full(count, np.nan) for name in NAMES}
    return VehiclePlausibility({name: scales[name].percentiles(padded[name]) for name in NAMES})


@dataclass(frozen=True, slots=True)
class FrameWeather:
    """How near an attacked frame's weather is to the limits of what occurs together (`feasible.weather`)."""

    codes: tuple[float, ...]
    """Changes of WEATHER_CODES from the photograph."""
    share: float
    """Largest sum of codes, in units of its limit; 0 as photographed."""
    rule: str
    """Name of that limit."""

    @property
    def beyond(self) -> bool:
        """Whether the weather exceeds the limit."""
        return self.share > 1 + _SLACK


def frame_weather(result: FrameResult) -> FrameWeather | None:
    """The weather of an attacked frame; None if the attack did not change it."""
    values = {c.name: c.value for c in result.theta}
    if not any(f"weather.{name}" in values for name in WEATHER_CODES):
        return None
    codes = [values.get(f"weather.{name}", 0.0) for name in WEATHER_CODES]
    shares = CODE_SUMS @ np.array(codes) / CODE_SUM_LIMITS
    worst = int(shares.argmax())
    return FrameWeather(tuple(codes), max(float(shares[worst]), 0.0), RULE_NAMES[worst])


@dataclass(frozen=True, slots=True)
class FramePlausibility:
    """The vehicles of a frame before and after the attack, and its weather."""

    identifier: str
    """Name of the frame."""
    kinds: tuple[str, ...]
    """Classes of its vehicles (N)."""
    before: VehiclePlausibility
    """As photographed."""
    after: VehiclePlausibility
    """In the counterexample."""
    weather: FrameWeather | None = None
    """None if the attack did not change it."""


def run_plausibility(config: PlausibilityConfig) -> AnalysisReport:
    """Look up all vehicles of a run, and write the report. Raises UsageError or SceneError for bad input."""
    (run,) = load_runs([config.run or ""], config.limit)
    frames = [_load_frame(run, frame) for frame in run.frames]
    if not any(frame.kinds for frame in frames):
        raise UsageError("--run", "a run with vehicles", run.folder)
    data: dict[str, Any] = {"run": str(run.folder), **summarise_plausibility(frames)}
    lowest = tuple((row["frame"], _format(row["before"]), _format(row["after"])) for row in data["by_frame"])
    tables = [_percentile_table(data), *_weather_table(frames)]
    report = AnalysisReport(
        out=resolve_output_folder(config.out, run.folder / "plausibility"),
        name="plausibility",
        heading="Plausibility",
        data=data,
        csv_tables={"plausibility": _vehicle_rows(frames)},
        tables=[
            tables[0],
            ReportTable("least common vehicle of each frame", ("frame", "before", "after"), lowest),
            *tables[1:],
        ],
        printed_tables=tables,
        notes=[_NOTE],
        json_only=True,
    )
    report.write()
    return report


def _load_frame(run: AttackRun, frame: RunFrame) -> FramePlausibility:
    identifier = frame.result.identifier
    folder = run.folder / FRAMES / identifier
    before, after = (read_labels(folder / name) for name in (_BEFORE, _AFTER))
    if frame.result.change:  # a vehicle left or came
        scene = load_scene(folder / "scene")
        first, then = (~behind_camera(state) for state in (scene.origin, scene))
        before, after = _select_labels(before, then[first]), _select_labels(after, first[then])
    if before.kind != after.kind:
        raise ShapeError(str(folder / _AFTER), f"the {len(before.kind)} vehicles of {_BEFORE}", len(after.kind))
    plausibility = vehicle_plausibility(before), vehicle_plausibility(after)
    return FramePlausibility(identifier, before.kind, *plausibility, frame_weather(frame.result))


def _select_labels(labels: Labels, rows: Tensor) -> Labels:
    """Some rows (M,) bool of labels; regions stay."""
    if len(rows) != len(labels.kind):
        raise ShapeError("labels", f"those of the scene's {len(rows)} vehicles", len(labels.kind))
    names = [field.name for field in fields(Labels) if field.name not in ("kind", "ignore_xyxy")]
    kinds = tuple(kind for kind, chosen in zip(labels.kind, rows.tolist(), strict=True) if chosen)
    return replace(labels, kind=kinds, **{name: getattr(labels, name)[rows] for name in names})


def summarise_plausibility(frames: Sequence[FramePlausibility]) -> dict[str, Any]:
    """Summarise frames as JSON: a row for each quantity over all vehicles, and each frame's least common vehicle.

    Shares are fractions of 1, percentiles in [0, 100], None if nothing is known.
    """
    rows = []
    for name in (LOWEST, *NAMES):
        before, after = (
            np.concatenate([side.all_percentiles[name] for side in sides])
            for sides in ([f.before for f in frames], [f.after for f in frames])
        )
        known = np.isfinite(before) & np.isfinite(after)
        before, after = before[known], after[known]
        rows.append(
            {
                "name": name,
                "vehicles": len(before),
                "median_before": _round(np.median(before)) if len(before) else None,
                "median_after": _round(np.median(after)) if len(after) else None,
                "unusual_before": float((before < UNUSUAL).mean()) if len(before) else None,
                "unusual_after": float((after < UNUSUAL).mean()) if len(after) else None,
                "largest_fall": _round((before - after).max()) if len(before) else None,
            }
        )
    by_frame = [
        {
            "frame": frame.identifier,
            "before": _lowest(frame.before),
            "after": _lowest(frame.after),
            "weather": None if frame.weather is None else _round(frame.weather.share),
        }
        for frame in frames
    ]
    beyond = [frame.identifier for frame in frames if frame.weather is not None and frame.weather.beyond]
    return {"frames": len(frames), "rows": rows, "by_frame": by_frame, "weather_beyond": beyond}


def _lowest(vehicles: VehiclePlausibility) -> float | None:
    known = vehicles.lowest[np.isfinite(vehicles.lowest)]
    return _round(known.min()) if len(known) else None


def _round(value: np.floating[Any] | float) -> float | None:
    return round(float(value), _DECIMALS) if np.isfinite(value) else None


def _vehicle_rows(frames: Sequence[FramePlausibility]) -> list[dict[str, Any]]:
    """A row for each vehicle: each percentile before and after."""
    rows = []
    for frame in frames:
        sides = {"before": frame.before.all_percentiles, "after": frame.after.all_percentiles}
        for i, kind in enumerate(frame.kinds):
            row: dict[str, Any] = {"frame": frame.identifier, "object": i, "kind": kind}
            names = ((name, when) for name in (LOWEST, *NAMES) for when in sides)
            rows.append(row | {f"{name}_{when}": _round(sides[when][name][i]) for name, when in names})
    return rows


def _weather_table(frames: Sequence[FramePlausibility]) -> list[ReportTable]:
    """One line per frame with changed weather, least likely first; no table without any."""
    known = [(frame.identifier, frame.weather) for frame in frames if frame.weather is not None]
    known.sort(key=lambda frame: -frame[1].share)
    rows = tuple(
        (name, *(f"{code:.2f}" for code in weather.codes), _format(weather.share, 100), weather.rule)
        for name, weather in known
    )
    columns = ("frame", *WEATHER_CODES, "% of limit", "limit")
    return [ReportTable("weather, and the limit that it is nearest to", columns, rows)] if rows else []


def _percentile_table(data: dict[str, Any]) -> ReportTable:
    title = f"{format_count(data['frames'], 'frame')}: percentiles by KITTI's labels"
    columns = ("quantity", "vehicles", "median before", "after", "unusual before, %", "after, %", "largest drop")
    rows = tuple(
        (
            row["name"],
            str(row["vehicles"]),
            *(_format(row[key]) for key in ("median_before", "median_after")),
            *(_format(row[key], 100) for key in ("unusual_before", "unusual_after")),
            _format(row["largest_fall"]),
        )
        for row in data["rows"]
    )
    return ReportTable(title, columns, rows)


def _format(value: float | None, factor: float = 1.0) -> str:
    return "-" if value is None else f"{factor * value:.1f}"
