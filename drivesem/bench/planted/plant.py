"""Faults planted for one frame: no car is in their bands as photographed, and theta can bring one into them.

Bands lie between features that theta was seen to reach. Of many that are drawn, the one whose share of Halton's draws
is nearest to what was asked for is kept.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from detectors.planted import FEATURES, Band, PlantedFault
from drivesem.bench.planted.survey import Survey

Rarity = Literal["easy", "rare"]
LEAST_EASY, MOST_RARE = 0.10, 0.02
"""Shares of Halton's draws that hit a fault: easy ones above the first, rare ones below the second."""
_WANTED: dict[Rarity, float] = {"easy": 0.2, "rare": 0.01}
_TRIALS = 1500
"""Bands that are drawn for a fault."""
_DIGITS = 4


@dataclass(frozen=True, slots=True)
class FaultKind:
    """What a fault is about, and how rarely chance hits it."""

    features: tuple[str, ...]
    rarity: Rarity

    @property
    def text(self) -> str:
        return f"{'+'.join(self.features)} {self.rarity}"


KINDS = tuple(
    FaultKind(tuple(words.split("+")), rarity)
    for rarity, faults in (
        (
            "easy",
            ("height_px", "aspect", "across", "lightness", "contrast", "aspect+lightness", "height_px+contrast"),
        ),
        (
            "rare",
            (
                "lightness",
                "contrast",
                "aspect+lightness",
                "aspect+contrast",
                "height_px+aspect",
                "across+lightness",
            ),
        ),
    )
    for words in faults
)
"""The faults of the yardstick."""


@dataclass(frozen=True, slots=True)
class Planting:
    """A fault of a kind in a frame. hit: share of Halton's draws in which a car is inside of its region; sure: in
    which one is so far inside that what a camera does between two pictures would not take it out.
    """

    kind: FaultKind
    fault: PlantedFault
    hit: float
    sure: float


def plant(survey: Survey, kind: FaultKind, seed: int) -> Planting | None:
    """A fault for this frame; None where theta cannot bring a car into such bands. Equal arguments, equal faults."""
    cars = survey.cars.nonzero()[:, 0].tolist()
    if not cars:
        return None
    rows = [FEATURES.index(name) for name in kind.features]
    reached = [values[:, rows][:, :, cars].double().numpy() for values in (survey.halton, survey.corners)]
    drawn, extreme = reached  # (K, F, N), (C, F, N)
    benign = survey.benign[rows][:, cars].double().numpy()
    slack = survey.seen.slack[rows][:, cars].double().numpy()
    rng = np.random.default_rng([seed, *kind.text.encode()])
    best: tuple[float, Planting] | None = None
    for _ in range(_TRIALS):
        car = int(rng.integers(len(cars)))
        bands = _bands(np.concatenate(reached)[:, :, car], slack[:, car], rng)
        if _within(benign[None], bands, slack).any():
            continue
        hit = _within(drawn, bands, 0 * slack).any(1).mean()
        sure = _within(drawn, bands, -slack).any(1).mean()
        reachable = sure > 0 or bool(_within(extreme, bands, -slack).any())
        if not reachable or not _fits(hit, kind.rarity):
            continue
        apart = abs(math.log((hit + 1 / len(drawn)) / (_WANTED[kind.rarity] + 1 / len(drawn))))
        if best is None or apart < best[0]:
            fault = PlantedFault(
                tuple(Band(n, *band) for n, band in zip(kind.features, bands.tolist(), strict=True))
            )
            best = apart, Planting(kind, fault, float(hit), float(sure))
    return None if best is None else best[1]


def _fits(hit: float, rarity: Rarity) -> bool:
    return hit > LEAST_EASY if rarity == "easy" else hit < MOST_RARE


def _bands(
    reached: NDArray[np.float64], slack: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Low and high (F, 2), drawn among what a car reaches (K, F), and beyond its extremes by its slack (F,)."""
    bands = []
    for values, room in zip(reached.T, slack, strict=True):
        edges = np.sort(np.concatenate([values, [values.min() - 2 * room, values.max() + 2 * room]]))
        low, high = np.sort(rng.choice(len(edges), 2, replace=False))
        bands.append([_rounded(edges[low]), _rounded(edges[high])])
    return np.array(bands)


def _within(
    values: NDArray[np.float64], bands: NDArray[np.float64], more: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether features (K, F, N) lie in all bands (F, 2), grown by so much (F, N) on both sides: (K, N)."""
    low, high = bands[:, :1] - more, bands[:, 1:] + more
    return ((values >= low) & (values <= high)).all(1)


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
