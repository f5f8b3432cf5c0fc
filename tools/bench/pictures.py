"""How near a picture is to the true one, and sheets on which people see it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from scene_ir.errors import ShapeError
from tools.experiments.realism.perceptual import Mask, Picture

EXACT_DB = 99.0
"""Stands for the infinite PSNR of equal pixels, so that figures stay numbers."""
_DIFFERENCE_GAIN = 4
_BAR_PX = 18


def psnr(first: Picture, second: Picture, region: Mask) -> float:
    """PSNR, dB, of two pictures (H, W, 3) uint8 over the pixels of a region (H, W), at most `EXACT_DB`.

    Raises ShapeError for an empty region.
    """
    if not region.any():
        raise ShapeError("region", "at least one pixel", 0)
    difference = first[region].astype(np.float64) - second[region]
    mean = float(np.mean(difference * difference))
    return EXACT_DB if mean == 0 else min(10 * math.log10(255.0**2 / mean), EXACT_DB)


@dataclass(frozen=True, slots=True)
class SheetStrip:
    """One row of a sheet: the photograph, our picture and the true one (H, W, 3) uint8, the region (H, W) looked
    at, and what to write above it."""

    photograph: Picture
    ours: Picture
    truth: Picture
    region: Mask
    caption: str


def sheet(strips: Sequence[SheetStrip], width: int = 1920) -> Picture:
    """Photograph, ours, truth and their difference x4 around each strip's region, side by side, strips below each
    other -> (h, width, 3)."""
    rows = []
    panel = width // 4
    for strip in strips:
        window = _window(strip.region)
        gap = np.abs(strip.ours.astype(np.int16) - strip.truth) * _DIFFERENCE_GAIN
        parts = [strip.photograph, strip.ours, strip.truth, np.clip(gap, 0, 255).astype(np.uint8)]
        cut = [np.ascontiguousarray(p[window]) for p in parts]
        size = (panel, max(round(cut[0].shape[0] * panel / cut[0].shape[1]), 1))
        kind = cv2.INTER_AREA if size[0] < cut[0].shape[1] else cv2.INTER_CUBIC
        line = np.concatenate([cv2.resize(c, size, interpolation=kind) for c in cut], axis=1)
        bar = np.zeros((_BAR_PX, line.shape[1], 3), np.uint8)
        names = f"photograph; {strip.caption}", "ours", "generator", f"difference x{_DIFFERENCE_GAIN}"
        for i, name in enumerate(names):
            cv2.putText(bar, name, (i * panel + 4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1)
        rows += [bar, line]
    return np.concatenate(rows).astype(np.uint8)


def _window(region: Mask) -> tuple[slice, slice]:
    """The region's rectangle and a quarter more on each side, not narrower than high."""
    height, width = region.shape
    rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
    y0, y1, x0, x1 = int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1
    margin = max((x1 - x0) // 8, (y1 - y0) // 8, 12)
    more = max((y1 - y0 - (x1 - x0)) // 2, 0) + margin
    return (
        slice(max(y0 - margin, 0), min(y1 + margin, height)),
        slice(max(x0 - more, 0), min(x1 + more, width)),
    )
