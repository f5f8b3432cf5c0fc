"""NanoDet's graphs (https://github.com/RangiLyu/nanodet, versions before "Plus"): what goes in, what comes out.

Two outputs a stride: class scores (1, A, 80), sigmoids already, and distances (1, A, 32) from a cell's centre to a
box's left, upper, right and lower edge, each as 8 logits over 0 to 7 strides whose mean is meant (distribution
focal loss, Li et al. 2020).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from detectors.adapters.coco import CLASSES
from detectors.adapters.spec import Spec

SPEC = Spec(
    channels="bgr",
    scale=255.0,
    mean=(103.53, 116.28, 123.675),
    std=(57.375, 57.12, 58.395),
    classes=CLASSES,
)
"""ImageNet's mean and deviation of 8-bit values, as in NanoDet's configurations."""
BINS = 8
SIDES = 4


def recognises(shapes: Sequence[tuple[int | str | None, ...]], input_hw: tuple[int, int]) -> bool:
    """Whether outputs of these shapes are NanoDet's: scores and distances for cells that fill the input."""
    try:
        return bool(_pairs(shapes, input_hw))
    except ValueError:
        return False


def read(outputs: Sequence[Tensor], input_hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Boxes (B, A, 4) px of the input, from its upper left corner, and scores (B, A, 80) in [0, 1] of all cells.

    A cell's centre is at (column + 1/2) strides: on KITTI's frames boxes then lie a pixel off the labels in the
    median; NanoDet-Plus, which has centres at whole strides and a fourth stride, is another format.
    """
    boxes, scores = [], []
    for s, d, stride in _pairs([tuple(o.shape) for o in outputs], input_hw):
        high, wide = (math.ceil(side / stride) for side in input_hw)
        logits = outputs[d].unflatten(2, (SIDES, BINS))
        bins = torch.arange(BINS, dtype=logits.dtype, device=logits.device)
        distance = (logits.softmax(dim=3) @ bins) * stride
        y, x = torch.meshgrid(torch.arange(high), torch.arange(wide), indexing="ij")
        centre = (torch.stack([x, y], dim=-1).view(-1, 2).to(bins) + 0.5) * stride
        boxes.append(torch.cat([centre - distance[..., :2], centre + distance[..., 2:]], dim=2))
        scores.append(outputs[s])
    return torch.cat(boxes, dim=1), torch.cat(scores, dim=1)


def _pairs(
    shapes: Sequence[tuple[int | str | None, ...]], input_hw: tuple[int, int]
) -> list[tuple[int, int, int]]:
    """(index of scores, index of distances, stride) for each stride. ValueError where they do not match."""
    scores, distances = _cells(shapes, len(CLASSES)), _cells(shapes, SIDES * BINS)
    if not scores or scores.keys() != distances.keys() or 2 * len(scores) != len(shapes):
        raise ValueError(f"expected a pair of scores and distances a stride, found {list(shapes)}")
    found = []
    for cells, i in sorted(scores.items(), reverse=True):
        stride = round(math.sqrt(input_hw[0] * input_hw[1] / cells))
        if math.ceil(input_hw[0] / stride) * math.ceil(input_hw[1] / stride) != cells:
            raise ValueError(f"expected cells of one size over {input_hw}, found {cells}")
        found.append((i, distances[cells], stride))
    return found


def _cells(shapes: Sequence[tuple[int | str | None, ...]], columns: int) -> dict[int, int]:
    """Number of cells and place of each output (1, cells, columns)."""
    return {
        cells: i
        for i, shape in enumerate(shapes)
        if len(shape) == 3 and isinstance(cells := shape[1], int) and shape[2] == columns
    }
