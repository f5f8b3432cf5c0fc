"""Find the ego vehicle in a photograph: its bonnet, dashboard, wipers and pillars, as dashcams show them.

A small network (`unet`), trained on generated streets with drawn ego vehicles, sees the whole photograph. Most
photographs show none.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_ir.derender.unet import NetworkInput, UNet
from scene_ir.weights import load_frozen

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

WEIGHTS = Path(__file__).parent / "weights" / "ego.safetensors"
"""The shipped weights, made by `tools/train_ego.py`."""
CLASS_NAME = "ego vehicle"
"""Its name among a data set's classes (Cityscapes)."""
INPUT_HW = (112, 224)
"""Size of the network's input, for photographs of any size."""
DEPTH_M = 0.3
"""Depth of the ego vehicle, m: nearer than all that it hides."""
_SURE, _LIKELY = 2.5, 0.3
"""Log odds that a part must reach in at least the share `_MIN_SHARE` of the photograph, and those that it must have
everywhere: a false ego vehicle costs more than a missed one, but a found one is wanted whole (hysteresis)."""
_NIGHT = 0.2
"""Mean value of photographs taken by night: a dashboard is as black as the road there, and is not searched for."""
_RADIUS, _FLATNESS = 0.012, 3e-4
"""Guided filter: radius as a share of the photograph's height, and the variance of colour below which a surface is
uniform."""
_MIN_SHARE = 0.004
"""Parts and holes below this share of the photograph are noise."""


class EgoNet(UNet):
    """RGB (N, 3, 112, 224) in [0, 1] and rows (N, 1, 112, 224), see `row_map` -> logits (N, 1, 56, 112)."""

    def __init__(self) -> None:
        super().__init__(1)


@lru_cache(maxsize=2)
def load_network(path: Path = WEIGHTS) -> EgoNet:
    """The network of a weights file, in eval mode. Raises FormatError."""
    network = load_frozen(EgoNet(), path)
    return network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]


def row_map(count: int) -> Tensor:
    """Rows (count, 1, h, w) of the network's pixels, 0.5 at the top and -0.5 at the bottom."""
    height, width = INPUT_HW
    return torch.linspace(0.5, -0.5, height)[:, None].expand(count, 1, height, width)


def find_ego_vehicle(image: Array, network: EgoNet | None = None) -> Mask | None:
    """Find the ego vehicle in a photograph.

    Args:
        image: (H, W, 3) RGB float32 in [0, 1].
        network: In place of the shipped one.

    Returns:
        Its pixels (H, W); None if the photograph does not show it, or was taken by night.
    """
    height, width = image.shape[:2]
    small = np.asarray(cv2.resize(image, INPUT_HW[::-1], interpolation=cv2.INTER_AREA), np.float32)
    if small.mean() < _NIGHT:
        return None
    view = NetworkInput(small, row_map(1)[0, 0].numpy())
    odds = (network or load_network()).predict(view)[0, 0]
    if float(odds.max()) < _SURE:
        return None
    likely, sure = (
        cv2.resize((odds - level).sigmoid().numpy(), (width, height), interpolation=cv2.INTER_LINEAR)
        for level in (_LIKELY, _SURE)
    )
    soft = cv2.ximgproc.guidedFilter(image * 255, likely, max(2, round(_RADIUS * height)), _FLATNESS * 255**2)
    mask = _keep_border_parts(soft > 0.5, sure > 0.5)
    return mask if mask.any() else None


def _keep_border_parts(mask: Mask, sure: Mask) -> Mask:
    """The connected parts of a mask (H, W) at the picture's border that have enough `sure` pixels (H, W), without small
    holes.
    """
    least_px = _MIN_SHARE * mask.size
    count, parts = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    border = np.unique(np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]]))
    sure_px = np.bincount(parts[sure], minlength=count)
    mask = np.isin(parts, [k for k in border if k and sure_px[k] >= least_px])
    count, parts, stats, _ = cv2.connectedComponentsWithStats((~mask).astype(np.uint8), connectivity=4)
    small = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] < least_px]
    return mask | np.isin(parts, small)


def boxes_outside(mask: Mask | None, boxes_xyxy: Tensor) -> list[int]:
    """Indices of the boxes (N, 4) px of which a mask (H, W) fills at most half; all if there is none."""
    if mask is None:
        return list(range(len(boxes_xyxy)))
    parts = [mask[y0 : y1 + 1, x0 : x1 + 1] for x0, y0, x1, y1 in boxes_xyxy.clamp(min=0).int().tolist()]
    return [i for i, part in enumerate(parts) if not 2 * np.count_nonzero(part) > part.size]


def ignored_regions(mask: Mask) -> Tensor:
    """Boxes (K, 4) px, xyxy, in which no detection counts: for each part of a mask (H, W) its bounding box, cut to the
    rows of which it fills at least half.
    """
    _, parts, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    boxes = []
    for number, (x0, y0, width, height, _) in enumerate(stats.tolist()):
        rows = np.flatnonzero((parts[y0 : y0 + height, x0 : x0 + width] == number).mean(1) >= 0.5)
        if number and len(rows):
            boxes.append((x0, y0 + int(rows[0]), x0 + width - 1, y0 + int(rows[-1])))
    return torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4)
