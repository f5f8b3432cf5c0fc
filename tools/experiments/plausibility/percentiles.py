"""How common a vehicle's place, heading and size are among those that KITTI's training labels hold.

The reference is the summary figures of all 7,481 label files that ship with the scene generator
(`drivesem.synth.compare.reference`): histograms of each quantity by itself, over Car, Van and Truck. Two common
figures may still be an uncommon pair; that these percentiles do not tell.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from drivesem.synth.compare import QUANTITIES, VEHICLES, Histograms, Quantity, reference, values_of
from scene_ir.errors import RangeError
from scene_ir.types import Labels

NAMES = ("depth_m", "lateral_m", "yaw_rad", "height_m", "length_m", "width_m", "spacing_m")
"""Distance ahead, place to the side, yaw in camera axes, size, and ground distance to the nearest other
vehicle."""
UNUSUAL = 5.0
"""Percentile below which a figure counts as unusual."""
_STEPS = 720
"""Of the circle on which the density of angles is compared: half a degree."""


@dataclass(frozen=True, slots=True)
class Scale:
    """One quantity's percentiles. shares (B,): of the reference's vehicles in each of the quantity's bins."""

    quantity: Quantity
    shares: np.ndarray

    def percentiles(self, values: np.ndarray) -> np.ndarray:
        """Percentile (n,) in [0, 100] of values (n,): 100 is the median, or the commonest angle, 0 is never seen.

        Two-sided: twice the share of vehicles beyond the value on its side. For angles, which have no sides: the
        share of vehicles whose angle is no commoner. NaN stays NaN.
        """
        found = np.full(len(values), np.nan)
        known = np.isfinite(values)
        compute = self._by_density if self.quantity.angle else self._by_tails
        found[known] = compute(np.asarray(values, float)[known])
        return found

    def _by_tails(self, values: np.ndarray) -> np.ndarray:
        edges, middles = np.asarray(self.quantity.edges), self.quantity.middles
        # The end bins also hold what lies beyond them: from their middles outwards nothing more is known.
        inside = np.clip(values, middles[0], middles[-1])
        below = np.interp(inside, edges, np.concatenate([[0.0], np.cumsum(self.shares)]) / self.shares.sum())
        return np.clip(200 * np.minimum(below, 1 - below), 0.0, 100.0)

    def _by_density(self, values: np.ndarray) -> np.ndarray:
        grid = self._density(np.arange(_STEPS) * (2 * math.pi / _STEPS))
        order = np.sort(grid)
        mass = np.concatenate([[0.0], np.cumsum(order)]) / order.sum()
        # A hair's breadth: the commonest angle itself is no commoner than itself.
        return 100 * mass[np.searchsorted(order, self._density(values) * (1 + 1e-9), side="right")]

    def _density(self, angles: np.ndarray) -> np.ndarray:
        """Between the middles of bins of one width, round the circle."""
        return np.interp(angles, self.quantity.middles, self.shares, period=2 * math.pi)


@lru_cache(maxsize=1)
def scales() -> Mapping[str, Scale]:
    """KITTI's, by name."""
    return scales_of(reference())


def scales_of(histograms: Histograms) -> dict[str, Scale]:
    """Scales of a data set's distributions. Raises RangeError where one of them counted nothing."""
    for name in NAMES:
        if not histograms.shares[name].any():
            raise RangeError(f"histograms: {name}", "at least one vehicle", "none")
    return {name: Scale(QUANTITIES[name], histograms.shares[name]) for name in NAMES}


@dataclass(frozen=True, slots=True)
class Plausibility:
    """percentiles: NAMES -> (N,) of a frame's vehicles, NaN where a figure is unknown, as the spacing of a single
    vehicle is."""

    percentiles: Mapping[str, np.ndarray]

    @property
    def table(self) -> np.ndarray:
        """(N, 7) in the order of NAMES."""
        return np.stack([self.percentiles[name] for name in NAMES], axis=1)

    @property
    def lowest(self) -> np.ndarray:
        """(N,): a vehicle's headline, its least common figure; NaN where nothing is known."""
        table = self.table
        known = np.isfinite(table).any(axis=1)
        return np.where(known, np.where(np.isfinite(table), table, np.inf).min(axis=1, initial=np.inf), np.nan)


def plausibility(labels: Labels, scale: Mapping[str, Scale] | None = None) -> Plausibility:
    """How common the vehicles of one frame are, one by one, in the order of their labels.

    labels: Cars, Vans and Trucks with poses in KITTI's camera axes; others among them are left out. scale: by
    default KITTI's. Raises RangeError for a vehicle without a pose.
    """
    scale = scales() if scale is None else scale
    count = sum(kind in VEHICLES for kind in labels.kind)
    values = values_of(labels)
    if len(values["depth_m"]) != count:
        raise RangeError("labels", f"{count} vehicles with poses", len(values["depth_m"]))
    # A single vehicle has no neighbour.
    padded = {name: values[name] if len(values[name]) == count else np.full(count, np.nan) for name in NAMES}
    return Plausibility({name: scale[name].percentiles(padded[name]) for name in NAMES})
