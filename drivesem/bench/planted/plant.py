"""Faults planted for one frame: no car is in their bands as photographed, and theta can bring one into them.

Bands lie between features that theta was seen to reach. Of many that are drawn, and that chance hits as rarely as
was asked for, the one is kept inside of which theta can bring a car most surely.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from detectors.planted import FEATURES, Band, PlantedFault
from drivesem.bench.planted.survey import Survey

Rarity = Literal["easy", "rare"]
HITS: dict[Rarity, tuple[float, float]] = {"easy": (0.1, 0.4), "rare": (0.0, 0.02)}
"""Shares of Halton's draws that hit a fault: of easy ones from a tenth on, of rare ones at most one in fifty."""
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


_EASY = ("height_px", "aspect", "across", "lightness", "contrast", "aspect+lightness", "height_px+contrast")
_RARE = (
    *("contrast", "aspect+lightness", "aspect+contrast", "across+lightness", "across+contrast"),
    "lightness+contrast",
)
KINDS = (
    *(FaultKind(tuple(words.split("+")), "easy") for words in _EASY),
    *(FaultKind(tuple(words.split("+")), "rare") for words in _RARE),
)
"""The faults of the yardstick: those that could be planted in at least four of six frames of stream 101."""


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
    """A fault for this frame; None where theta brings no car into such bands. Equal arguments, equal faults."""
    cars = survey.seen.judged.nonzero()[:, 0].tolist()
    aims = [i for i, car in enumerate(cars) if survey.seen.sure[car]]
    if not aims:
        return None
    rows = [FEATURES.index(name) for name in kind.features]
    benign, farthest, mostly = (
        of[rows][:, cars].double().numpy() for of in (survey.benign, survey.seen.farthest, survey.seen.mostly)
    )
    drawn, extreme = (of[:, rows][:, :, cars].double().numpy() for of in (survey.halton, survey.corners))
    reached = np.concatenate([drawn, extreme])
    rng = np.random.default_rng([seed, *kind.text.encode()])
    least, most = HITS[kind.rarity]
    best: tuple[int, Planting] | None = None
    for _ in range(_TRIALS):
        car = int(rng.choice(aims))
        bands = _bands(reached[:, :, car], mostly[:, car], rng)
        hit = float(_within(drawn, bands, 0 * mostly).any(1).mean())
        if not least <= hit <= most or _within(benign[None], bands, farthest).any():
            continue
        sure = _within(reached, bands, -mostly)[:, aims].any(1)
        if sure.any() and (best is None or sure.sum() > best[0]):
            named = zip(kind.features, bands.tolist(), strict=True)
            fault = PlantedFault(tuple(Band(name, low, high) for name, (low, high) in named))
            best = int(sure.sum()), Planting(kind, fault, hit, float(sure[: len(drawn)].mean()))
    return None if best is None else best[1]


def _bands(
    reached: NDArray[np.float64], room: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Low and high (F, 2), drawn among what a car reaches (K, F), and twice its room (F,) beyond its extremes."""
    bands = []
    for values, beyond in zip(reached.T, 2 * room, strict=True):
        edges = np.sort(np.concatenate([values, [values.min() - beyond, values.max() + beyond]]))
        low, high = np.sort(rng.choice(len(edges), 2, replace=False))
        # Half of the bands are open: what is rare mostly lies at an end of what is reached.
        side = rng.random()
        low, high = (0 if side < 0.25 else low), (len(edges) - 1 if side > 0.75 else high)
        bands.append([_rounded(float(edges[low])), _rounded(float(edges[high]))])
    return np.array(bands)


def _within(
    values: NDArray[np.float64], bands: NDArray[np.float64], more: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether features (K, F, N) lie in all bands (F, 2), grown by so much (F, N) on both sides: (K, N)."""
    low, high = bands[:, :1] - more, bands[:, 1:] + more
    return np.all((values >= low) & (values <= high), axis=1)


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
