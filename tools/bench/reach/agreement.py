"""Agreement of margin gradients with slopes over steps: table rows by parameter, distance and width."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tools.bench.reach.slopes import STEPS, ProbeSlopes

Array = NDArray[np.float64]

BANDS = ((0.0, 15.0), (15.0, 30.0), (30.0, np.inf))
"""Distances of objects, m."""
ALL = "all"
_RESAMPLES = 1000


@dataclass(frozen=True, slots=True)
class SlopeAgreement:
    """How well one list of slopes predicts another."""

    cosine: float
    """Of the two, with its 95 % interval by bootstrap over objects (None for fewer than 3)."""
    low: float | None
    high: float | None
    signs: float
    """Share of slopes of the same sign."""
    realised: float
    """Regression coefficient of the second slopes on the first, which noise of the second does not lower."""


@dataclass(frozen=True, slots=True)
class ReachRow:
    """One parameter, band of distances and width."""

    row: str
    distance: str
    steps: int
    """Half the width of differences, in steps of an attack."""
    objects: int
    """How many there are."""
    slopes: int
    """How many there are."""
    point: SlopeAgreement
    """Agreement of gradients with the slopes over that width."""
    smoothed: SlopeAgreement
    """Agreement of gradients with the slopes over that width."""
    repeated: SlopeAgreement
    """Agreement between the slopes of both halves of the draws: about the best that a gradient can reach."""


def reach_rows(frames: Sequence[Sequence[ProbeSlopes]], seed: int) -> tuple[ReachRow, ...]:
    """Of all objects and then of each band of distances that has some; rows in the order of their appearance."""
    names = tuple(dict.fromkeys(one.row for found in frames for one in found))
    bands = [(ALL, 0.0, np.inf), *((_words(low, high), low, high) for low, high in BANDS)]
    rows = []
    for name in names:
        for band, low, high in bands:
            picked = [
                (frame, one)
                for frame, found in enumerate(frames)
                for one in found
                if one.row == name and low <= one.distance_m < high
            ]
            for place, steps in enumerate(STEPS):
                row = _row(name, band, place, steps, picked, seed)
                rows += [] if row is None else [row]
    return tuple(rows)


def compare_slopes(slopes: Array, by: Array, owner: NDArray[np.int64], seed: int) -> SlopeAgreement:
    """Agreement of predictions `by` (S,) with slopes (S,). owner (S,): the object of each."""
    count = int(owner.max()) + 1
    sums = np.stack([np.bincount(owner, part, count) for part in (slopes * by, slopes**2, by**2)])
    low = high = None
    if count >= 3:
        generator = np.random.default_rng(seed)
        weights = generator.multinomial(count, np.full(count, 1 / count), _RESAMPLES).astype(np.float64)
        low, high = (float(q) for q in np.quantile(_cosine(sums @ weights.T), (0.025, 0.975)))
    same = float((np.sign(slopes) == np.sign(by)).mean())
    product, _, predicted_energy = sums.sum(axis=1).tolist()
    return SlopeAgreement(
        float(_cosine(sums.sum(axis=1))), low, high, same, product / max(predicted_energy, 1e-30)
    )


def _row(
    name: str, band: str, place: int, steps: int, picked: Sequence[tuple[int, ProbeSlopes]], seed: int
) -> ReachRow | None:
    owners: dict[tuple[int, int], int] = {}
    columns: list[tuple[float, ...]] = []
    owner: list[int] = []
    for frame, one in picked:
        wide, point, smoothed = (
            np.array(kind[place], dtype=np.float64) for kind in (one.wide, one.point, one.smoothed)
        )
        halves = [half[~np.isnan(half)] for half in (wide[::2], wide[1::2])]
        if not all(map(len, halves)):
            continue
        columns.append(tuple(float(np.nanmean(part)) for part in (wide, point, smoothed, *halves)))
        owner.append(owners.setdefault((frame, one.object), len(owners)))
    if not columns:
        return None
    wide, point, smoothed, even, odd = np.array(columns, dtype=np.float64).T
    index = np.array(owner)
    return ReachRow(
        row=name,
        distance=band,
        steps=steps,
        objects=len(owners),
        slopes=len(wide),
        point=compare_slopes(wide, point, index, seed),
        smoothed=compare_slopes(wide, smoothed, index, seed),
        repeated=compare_slopes(even, odd, index, seed),
    )


def _cosine(sums: Array) -> Array:
    """Of sums (3, ...) of products and of either's squares."""
    return sums[0] / np.sqrt(np.maximum(sums[1] * sums[2], 1e-30))


def _words(low: float, high: float) -> str:
    if low == 0:
        return f"under {high:g} m"
    return f"over {low:g} m" if np.isinf(high) else f"{low:g} to {high:g} m"
