"""Plant faults in one frame: no car is in their bands as photographed, and theta can bring one into them.

Bands lie between feature values that theta reaches. Of many random bands that samples hit as rarely as requested, the
one into which theta brings a car most reliably is chosen.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from detectors.planted import FEATURES, Band, PlantedFault
from tools.bench.planted.survey import FrameSurvey

Rarity = Literal["easy", "rare"]
HITS: dict[Rarity, tuple[float, float]] = {"easy": (0.1, 0.4), "rare": (0.0, 0.02)}
"""Shares of Halton's draws that hit a fault: of easy ones from a tenth on, of rare ones at most one in fifty."""
_TRIALS = 4000
"""Bands that are drawn for a fault."""
_MAX_CHECKED = 200
"""Number of the most promising of these that are evaluated exactly."""
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
"""The faults of the yardstick: those that could be planted in most frames of stream 101."""


@dataclass(frozen=True, slots=True)
class FaultPlacement:
    """A fault of a kind in a frame."""

    kind: FaultKind
    fault: PlantedFault
    hit: float
    """Share of Halton's draws in which it hides a car."""
    sure: float
    """In which one is so far inside that what a camera does between two pictures would not take it out."""


def plant(survey: FrameSurvey, kind: FaultKind, seed: int) -> FaultPlacement | None:
    """A fault for this frame; None where theta brings no car into such bands. Equal arguments, equal faults."""
    if not bool(survey.sure.any()):
        return None
    rows = [FEATURES.index(name) for name in kind.features]
    mains = torch.stack([sighting.main[rows] for sighting in (*survey.halton, *survey.corners)])
    mostly_seen = torch.isfinite(mains).all(1).double().mean(0) > 0.5
    aims = (survey.sure & mostly_seen).nonzero()[:, 0].tolist()
    if not aims:
        return None
    reached, benign, farthest, mostly = (
        of.double().numpy() for of in (mains, survey.benign[rows], survey.farthest[rows], survey.mostly[rows])
    )
    drawn = len(survey.halton)
    judged = survey.frame.judged.numpy()
    rng = np.random.default_rng([seed, *kind.text.encode()])
    least, most = HITS[kind.rarity]
    promising: list[tuple[int, int, NDArray[np.float64]]] = []
    for trial in range(_TRIALS):
        car = int(rng.choice(aims))
        bands = _bands(reached[:, :, car], mostly[:, car], rng)
        # Roughly, by one box a car; the best are evaluated exactly below.
        hit = _within(reached[:drawn], bands, 0 * mostly).any(1).mean()
        if not 0.5 * least <= hit <= most or (_within(benign[None], bands, farthest)[0] & judged).any():
            continue
        surely = int(np.any(_within(reached, bands, -mostly)[:, aims], axis=1).sum())
        if surely:
            promising.append((-surely, trial, bands))
    for _, _, bands in sorted(promising, key=lambda one: one[:2])[:_MAX_CHECKED]:
        named = zip(kind.features, bands.tolist(), strict=True)
        fault = PlantedFault(tuple(Band(name, low, high) for name, (low, high) in named))
        hit = survey.rarity(fault)
        clear = not any(bool(sample.lost(fault).any()) for sample in survey.camera_samples)
        reachable = any(bool(s.lost(fault)[aims].any()) for s in (*survey.halton, *survey.corners))
        if clear and reachable and least <= hit <= most:
            sure = float(np.any(_within(reached[:drawn], bands, -mostly)[:, aims], axis=1).mean())
            return FaultPlacement(kind, fault, hit, sure)
    return None


def _bands(
    reached: NDArray[np.float64], room: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Low and high (F, 2), drawn among what a car reaches (K, F), nan where it is not seen, and twice its room
    (F,) beyond its extremes.
    """
    bands = []
    for every, beyond in zip(reached.T, 2 * room, strict=True):
        values = every[np.isfinite(every)]
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
