"""What a detector's graph takes and gives: one description for each family of graphs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

Shape = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Format:
    """How one family of graphs is fed and read.

    classes: what labels are indices into. recognises: whether outputs of these shapes, at this input size (height,
    width), are this family's. prepare: images (B, 3, h, w) RGB in [0, 1] of the network's size -> what the graph
    takes. read: what the graph gave for one image, and the input size -> boxes (A, 4), edges in px of the input
    counted from its upper left corner, and scores (A, C) in [0, 1].
    """

    name: str
    classes: tuple[str, ...]
    recognises: Callable[[Sequence[Shape], tuple[int, int]], bool]
    prepare: Callable[[Tensor], Tensor]
    read: Callable[[Sequence[np.ndarray], tuple[int, int]], tuple[Tensor, Tensor]]
