"""NanoDet's graphs (https://github.com/RangiLyu/nanodet, versions before "Plus"): what goes in, what comes out.

Two outputs a stride: class scores (1, A, 80), sigmoids already, and distances (1, A, 32) from a cell's centre to a
box's left, upper, right and lower edge, each as 8 logits over 0 to 7 strides whose mean is meant (distribution
focal loss, Li et al. 2020).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from detectors.adapters.coco import CLASSES
from detectors.adapters.formats import Format, Shape

BGR_MEAN = (103.53, 116.28, 123.675)
BGR_STD = (57.375, 57.12, 58.395)
"""Of 8-bit values, as in NanoDet's configurations: ImageNet's."""
BINS = 8
SIDES = 4


def recognises(shapes: Sequence[Shape], input_hw: tuple[int, int]) -> bool:
    """Whether outputs of these shapes are NanoDet's: scores and distances for cells that fill the input."""
    try:
        return bool(_pairs(shapes, input_hw))
    except ValueError:
        return False


def prepare(images: Tensor) -> Tensor:
    """images (B, 3, h, w) RGB in [0, 1] as the network takes them."""
    mean, std = images.new_tensor(BGR_MEAN).view(3, 1, 1), images.new_tensor(BGR_STD).view(3, 1, 1)
    return (images.flip(1) * 255 - mean) / std


def read(outputs: Sequence[np.ndarray], input_hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Boxes (A, 4) px of the input, from its upper left corner, and scores (A, 80) in [0, 1] of all cells.

    A cell's centre is at (column + 1/2) strides: on KITTI's frames boxes then lie a pixel off the labels in the
    median; NanoDet-Plus, which has centres at whole strides and a fourth stride, is another format.
    """
    boxes, scores = [], []
    for s, d, stride in _pairs([o.shape for o in outputs], input_hw):
        high, wide = (math.ceil(side / stride) for side in input_hw)
        logits = torch.from_numpy(outputs[d][0]).view(-1, SIDES, BINS)
        distance = (logits.softmax(dim=2) @ torch.arange(BINS, dtype=logits.dtype)) * stride
        y, x = torch.meshgrid(torch.arange(high), torch.arange(wide), indexing="ij")
        centre = (torch.stack([x, y], dim=-1).view(-1, 2) + 0.5) * stride
        boxes.append(torch.cat([centre - distance[:, :2], centre + distance[:, 2:]], dim=1))
        scores.append(torch.from_numpy(outputs[s][0]))
    return torch.cat(boxes), torch.cat(scores)


def _pairs(shapes: Sequence[Shape], input_hw: tuple[int, int]) -> list[tuple[int, int, int]]:
    """(index of scores, index of distances, stride) for each stride. ValueError where they do not match."""
    scores = {shape[1]: i for i, shape in enumerate(shapes) if len(shape) == 3 and shape[2] == len(CLASSES)}
    distances = {shape[1]: i for i, shape in enumerate(shapes) if len(shape) == 3 and shape[2] == SIDES * BINS}
    if not scores or scores.keys() != distances.keys() or 2 * len(scores) != len(shapes):
        raise ValueError(f"expected a pair of scores and distances a stride, found {list(shapes)}")
    found = []
    for cells, i in sorted(scores.items(), reverse=True):
        stride = round(math.sqrt(input_hw[0] * input_hw[1] / cells))
        if math.ceil(input_hw[0] / stride) * math.ceil(input_hw[1] / stride) != cells:
            raise ValueError(f"expected cells of one size over {input_hw}, found {cells}")
        found.append((i, distances[cells], stride))
    return found


FORMAT = Format("nanodet", CLASSES, recognises, prepare, read)
