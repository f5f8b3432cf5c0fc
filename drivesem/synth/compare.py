"""How a data set's vehicles are distributed, and how far that is from KITTI's own labels.

Vehicles are Car, Van and Truck. KITTI's side is the histograms in `kitti_statistics.json`, which
`tools/fit_kitti_statistics.py` fits with the same definitions.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.resources import files as resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import wasserstein_distance

from drivesem.data.registry import Dataset
from drivesem.reporting.tables import format_count
from scene_ir.errors import FormatError
from scene_ir.files import write_bytes
from scene_ir.types import Labels

if TYPE_CHECKING:
    from matplotlib.axes import Axes

VEHICLES = ("Car", "Van", "Truck")
"""The labels that are compared."""
_ANGLE_BINS = 24
_TRUNCATED = 0.005
"""Truncation from which on a vehicle counts as cut: half of the two decimals that KITTI writes."""
_KITTI_COLOUR, _OWN_COLOUR = "#0072B2", "#D55E00"
"""Blue and vermilion of Okabe and Ito (2008), which differ for every kind of colour vision."""


def _angles() -> tuple[float, ...]:
    """Edges of bins that have 0 and +-pi/2 in their middles, where most yaws lie."""
    step = 2 * math.pi / _ANGLE_BINS
    return tuple((i - 0.5) * step - math.pi for i in range(_ANGLE_BINS + 1))


@dataclass(frozen=True, slots=True)
class Quantity:
    """What is counted: edges of its bins, in `unit`; the first and the last bin also take what lies beyond. angle:
    it goes round, with no end bins. Counts and levels are whole numbers, a bin each.
    """

    title: str
    unit: str
    edges: tuple[float, ...]
    angle: bool = False

    @property
    def middles(self) -> np.ndarray:
        """The value (B,) that stands for each bin: its middle, or the whole number."""
        edges = np.asarray(self.edges)
        return edges[:-1] if self.unit in ("vehicles", "level") else (edges[1:] + edges[:-1]) / 2

    def shares(self, values: np.ndarray) -> np.ndarray:
        """Share (B,) of values (n,) in each bin, summing to one; zeros where there is no value."""
        edges = np.asarray(self.edges)
        if self.angle:
            values = (values - edges[0]) % (2 * math.pi) + edges[0]
        index = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
        return np.bincount(index, minlength=len(edges) - 1) / max(len(values), 1)

    def wasserstein(self, one: np.ndarray, two: np.ndarray) -> float:
        """Wasserstein-1 distance of two histograms (B,), in `unit`; round the circle for angles."""
        if self.angle:
            # On a circle the best transport leaves out a constant flow: the median of the summed differences.
            flow = np.cumsum(one - two)
            return float(np.abs(flow - np.median(flow)).sum() * (self.edges[1] - self.edges[0]))
        return float(wasserstein_distance(self.middles, self.middles, one, two))


QUANTITIES: Mapping[str, Quantity] = {
    "vehicles_per_frame": Quantity("Vehicles a frame", "vehicles", tuple(range(18))),
    "box_height_px": Quantity(
        "Box height", "px", (*range(10, 60, 5), 60, 70, 80, 90, 100, 120, 140, 160, 200, 240, 300, 375)
    ),
    "depth_m": Quantity("Depth", "m", tuple(range(0, 85, 5))),
    "lateral_m": Quantity("Lateral position", "m", tuple(range(-32, 36, 4))),
    "yaw_rad": Quantity("Yaw in camera axes", "rad", _angles(), angle=True),
    "alpha_rad": Quantity("Observation angle", "rad", _angles(), angle=True),
    "occlusion": Quantity("Occlusion", "level", tuple(range(5))),
    "truncation": Quantity("Truncation", "share", (0.0, _TRUNCATED, *(round(0.1 * i, 1) for i in range(1, 11)))),
    "length_m": Quantity(
        "Length", "m", (*(round(2 + 0.25 * i, 2) for i in range(17)), 7.0, 8.0, 10.0, 12.0, 16.0)
    ),
    "height_m": Quantity("Height", "m", tuple(round(1 + 0.1 * i, 1) for i in range(31))),
    "width_m": Quantity("Width", "m", tuple(round(1 + 0.1 * i, 1) for i in range(21))),
    "spacing_m": Quantity("Distance to the nearest", "m", (*range(11), 12, 14, 16, 20, 25, 30, 40)),
}
"""Everything that is compared. Positions are of the bottom face's centre in camera axes; the observation angle is
yaw less the ray's direction; spacing is the ground distance of centres within a frame."""
_PANELS = ("vehicles_per_frame", "box_height_px", "depth_m", "lateral_m", "yaw_rad", "occlusion")


@dataclass(frozen=True, slots=True)
class Histograms:
    """Shares (B,) of every quantity over a number of frames, zeros where nothing was counted; means, None there
    and for angles, which have none.
    """

    frames: int
    vehicles: int
    shares: Mapping[str, np.ndarray]
    means: Mapping[str, float | None]

    def summary(self) -> dict[str, Any]:
        """JSON's form: shares to 1e-5, means to 1e-4."""
        return {
            "frames": self.frames,
            "vehicles": self.vehicles,
            "quantities": {
                name: {
                    "unit": QUANTITIES[name].unit,
                    "edges": [round(float(e), 6) for e in QUANTITIES[name].edges],
                    "mean": _rounded(self.means[name]),
                    "share": [round(float(s), 5) for s in self.shares[name]],
                }
                for name in QUANTITIES
            },
        }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)


def _format_value(value: float | None, decimals: int) -> str:
    """Format a value, or a dash for None."""
    return "-" if value is None else f"{value:.{decimals}f}"


def measure_labels(labels: Labels) -> dict[str, np.ndarray]:
    """Every quantity of one frame's vehicles; those of unknown pose (NaN) are left out of what needs one."""
    rows = np.array([i for i, kind in enumerate(labels.kind) if kind in VEHICLES], np.int64)
    boxes = labels.boxes_xyxy.double().numpy()[rows]
    spot = labels.translation.double().numpy()[rows]
    yaw = labels.yaw.double().numpy()[rows]
    size = labels.size_lhw.double().numpy()[rows]
    known = np.isfinite(np.concatenate([spot, yaw[:, None], size], axis=1)).all(axis=1)
    spot, yaw, size = spot[known], yaw[known], size[known]
    ground = spot[:, [0, 2]]
    apart = np.linalg.norm(ground[:, None] - ground[None], axis=2) + np.diag(np.full(len(ground), np.inf))
    truncation = labels.truncation.double().numpy()[rows]
    return {
        "vehicles_per_frame": np.array([float(len(rows))]),
        "box_height_px": boxes[:, 3] - boxes[:, 1],
        "depth_m": spot[:, 2],
        "lateral_m": spot[:, 0],
        "yaw_rad": yaw,
        "alpha_rad": yaw - np.arctan2(spot[:, 0], spot[:, 2]),
        "occlusion": labels.occlusion.numpy()[rows].astype(float),
        "truncation": truncation[np.isfinite(truncation)],
        "length_m": size[:, 0],
        "height_m": size[:, 1],
        "width_m": size[:, 2],
        "spacing_m": apart.min(axis=1) if len(ground) > 1 else np.zeros(0),
    }


def histograms(frames: Iterable[Labels]) -> Histograms:
    """The distributions of the vehicles in many frames' labels."""
    found: dict[str, list[np.ndarray]] = {name: [] for name in QUANTITIES}
    for labels in frames:
        for name, values in measure_labels(labels).items():
            found[name].append(values)
    values = {name: np.concatenate(parts) if parts else np.zeros(0) for name, parts in found.items()}
    means = {
        name: None if quantity.angle or not len(values[name]) else float(values[name].mean())
        for name, quantity in QUANTITIES.items()
    }
    return Histograms(
        frames=len(values["vehicles_per_frame"]),
        vehicles=len(values["box_height_px"]),
        shares={name: quantity.shares(values[name]) for name, quantity in QUANTITIES.items()},
        means=means,
    )


def reference() -> Histograms:
    """KITTI's own distributions, from the figures shipped with the package."""
    raw = json.loads(resources("drivesem.synth").joinpath("kitti_statistics.json").read_text(encoding="utf-8"))
    histograms = raw["histograms"]
    for name, quantity in QUANTITIES.items():
        found = histograms["quantities"].get(name, {}).get("edges", [])
        if len(found) != len(quantity.edges) or not np.allclose(found, quantity.edges, atol=1e-5):
            raise FormatError(f"kitti_statistics.json: {name}", f"bins at {quantity.edges}", f"bins at {found}")
    return Histograms(
        frames=histograms["frames"],
        vehicles=histograms["vehicles"],
        shares={name: np.array(histograms["quantities"][name]["share"]) for name in QUANTITIES},
        means={name: histograms["quantities"][name]["mean"] for name in QUANTITIES},
    )


@dataclass(frozen=True, slots=True)
class Distance:
    """How far one quantity is from KITTI's. wasserstein in `unit`; total_variation in [0, 1]; None where nothing
    was counted.
    """

    unit: str
    mean: float | None
    kitti_mean: float | None
    wasserstein: float | None
    total_variation: float | None


@dataclass(frozen=True, slots=True)
class Comparison:
    """A data set's distributions compared with KITTI's."""

    own: Histograms
    kitti: Histograms

    @property
    def distances(self) -> dict[str, Distance]:
        """The distance of every quantity."""
        found = {}
        for name, quantity in QUANTITIES.items():
            own, kitti = self.own.shares[name], self.kitti.shares[name]
            counted = own.any() and kitti.any()
            found[name] = Distance(
                unit=quantity.unit,
                mean=self.own.means[name],
                kitti_mean=self.kitti.means[name],
                wasserstein=quantity.wasserstein(own, kitti) if counted else None,
                total_variation=float(np.abs(own - kitti).sum() / 2) if counted else None,
            )
        return found

    @property
    def truncated(self) -> tuple[float, float]:
        """Share of vehicles that the image border cuts: here, and in KITTI."""
        return float(self.own.shares["truncation"][1:].sum()), float(self.kitti.shares["truncation"][1:].sum())

    def summary(self) -> dict[str, Any]:
        """JSON's form of the distances and of both sides' histograms."""
        return {
            "distances": {
                name: {
                    "unit": d.unit,
                    "mean": _rounded(d.mean),
                    "kitti_mean": _rounded(d.kitti_mean),
                    "wasserstein": _rounded(d.wasserstein),
                    "total_variation": _rounded(d.total_variation),
                }
                for name, d in self.distances.items()
            },
            "truncated_share": round(self.truncated[0], 4),
            "kitti_truncated_share": round(self.truncated[1], 4),
            "own": self.own.summary(),
            "kitti": self.kitti.summary(),
        }

    def table(self) -> str:
        """A Markdown table: mean here and in KITTI, Wasserstein-1 distance, total variation."""
        head = (
            f"{format_count(self.own.frames, 'frame')} with {format_count(self.own.vehicles, 'vehicle')} against "
        )
        head += f"KITTI's {self.kitti.frames} with {self.kitti.vehicles}.\n\n"
        rows = ["| quantity | unit | mean | KITTI's mean | Wasserstein-1 | total variation |"]
        rows.append("|---|---|---:|---:|---:|---:|")
        for name, d in self.distances.items():
            cells = " | ".join(_format_value(v, 2) for v in (d.mean, d.kitti_mean, d.wasserstein))
            title = QUANTITIES[name].title.lower()
            rows.append(f"| {title} | {d.unit} | {cells} | {_format_value(d.total_variation, 3)} |")
        mine, theirs = self.truncated
        rows.append(
            f"| truncated vehicles | % | {100 * mine:.1f} | {100 * theirs:.1f} | | {abs(mine - theirs):.3f} |"
        )
        return head + "\n".join(rows) + "\n"

    def plot(self, path: Path) -> None:
        """Six histograms of both sides as a PNG, written atomically."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(12, 6.6), layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(2, 3)
        for axes, name in zip(panels.flat, _PANELS, strict=True):
            self._panel(axes, name)
        names = (f"KITTI ({self.kitti.frames} frames)", f"generated ({format_count(self.own.frames, 'frame')})")
        figure.legend(panels.flat[0].get_legend_handles_labels()[0], names, loc="outside upper center", ncols=2)
        data = io.BytesIO()
        figure.savefig(data, format="png", dpi=110)
        write_bytes(path, data.getvalue())

    def _panel(self, axes: Axes, name: str) -> None:
        quantity, distance = QUANTITIES[name], self.distances[name]
        kitti, own = self.kitti.shares[name], self.own.shares[name]
        whole = quantity.unit in ("vehicles", "level")
        edges = np.asarray(quantity.edges) - (0.5 if whole else 0.0)
        # Bins differ in width: areas, not heights, are shares.
        width = np.ones(len(kitti)) if whole else np.diff(edges)
        axes.stairs(kitti / width, edges, fill=True, color=_KITTI_COLOUR, alpha=0.45, label="KITTI")
        axes.stairs(own / width, edges, color=_OWN_COLOUR, linewidth=1.8, label="generated")
        axes.set_xlabel(f"{quantity.title} [{quantity.unit}]")
        axes.set_ylabel("share" if whole else f"share per {quantity.unit}")
        if quantity.unit == "level":
            axes.set_xticks(quantity.middles)
        cost, variation = _format_value(distance.wasserstein, 2), _format_value(distance.total_variation, 3)
        axes.set_title(f"W1 {cost} {distance.unit}, TV {variation}", fontsize=10)


def compare(dataset: Dataset) -> Comparison:
    """A data set against KITTI; frames without labels are left out. Errors as its reader raises them."""
    found = (dataset.labels(identifier) for identifier in dataset.identifiers)
    return Comparison(histograms(labels for labels in found if labels is not None), reference())
