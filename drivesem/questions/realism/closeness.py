"""How near two pictures are, and sheets on which people see it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from detectors.registry import load_detector
from detectors.squeezedet import BGR_MEAN, SqueezeDet
from scene_ir.errors import ShapeError

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]

EXACT_DB = 99.0
"""Stands for the infinite PSNR of equal pixels, so that figures stay numbers."""
PERCEPTUAL = "perceptual distance (SqueezeDet backbone)"
_MARGIN_PX = 32
"""Context around a region that the backbone sees."""
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


class Perception:
    """A perceptual distance after Zhang et al. (CVPR 2018), unweighted: features of SqueezeNet's first layers, as
    the shipped detector has them, each pixel's scaled to unit length, squared differences averaged over a region.
    It is not LPIPS, whose layers and weights are others.
    """

    def __init__(self) -> None:
        detector = load_detector("squeezedet")
        assert isinstance(detector, SqueezeDet)
        self._net = detector

    @torch.no_grad()
    def distance(self, first: Picture, second: Picture, region: Mask) -> float:
        """Of two pictures (H, W, 3) uint8 over a region (H, W); 0 for equal ones. Raises ShapeError for an empty
        region."""
        if not region.any():
            raise ShapeError("region", "at least one pixel", 0)
        rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
        window = (
            slice(max(int(rows[0]) - _MARGIN_PX, 0), int(rows[-1]) + 1 + _MARGIN_PX),
            slice(max(int(columns[0]) - _MARGIN_PX, 0), int(columns[-1]) + 1 + _MARGIN_PX),
        )
        share = torch.from_numpy(region[window].astype(np.float32))[None, None]
        total = 0.0
        layers = list(zip(self.features(first[window]), self.features(second[window]), strict=True))
        for one, two in layers:
            apart = (F.normalize(one, dim=1) - F.normalize(two, dim=1)).square().sum(dim=1)[0]
            weight = F.adaptive_avg_pool2d(share, (apart.shape[0], apart.shape[1]))[0, 0]
            total += float((apart * weight).sum() / weight.sum())
        return total / len(layers)

    def features(self, picture: Picture) -> list[Tensor]:
        """Of conv1, fire3 and fire5: (1, C, h, w) at a half, a quarter and an eighth of the picture's size."""
        image = torch.from_numpy(np.ascontiguousarray(picture[..., ::-1].transpose(2, 0, 1))).float()[None]
        net, found = self._net, []
        x = F.relu(net.conv1(image - image.new_tensor(BGR_MEAN).view(1, 3, 1, 1)))
        found.append(x)
        for first, second in (("fire2", "fire3"), ("fire4", "fire5")):
            x = F.max_pool2d(x, 3, stride=2, padding=1)
            x = net.fires[second](net.fires[first](x))
            found.append(x)
        return found


@dataclass(frozen=True, slots=True)
class Strip:
    """One row of a sheet: the photograph, our picture and the true one (H, W, 3) uint8, the region (H, W) looked
    at, and what to write above it."""

    photograph: Picture
    ours: Picture
    truth: Picture
    region: Mask
    caption: str


def sheet(strips: Sequence[Strip], width: int = 1920) -> Picture:
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
