"""A detector that knows pictures again: searches for many faults begin with the same ones."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from typing import Any

from torch import Tensor

from detectors.base import Detector, DetectorWrapper

_MOST = 96
"""Pictures whose predictions are kept, half a megabyte each: those that searches of one frame share."""


class Remembering(DetectorWrapper):
    """`inner`, which is asked once for each picture without a gradient. asked: how often it was."""

    def __init__(self, inner: Detector) -> None:
        super().__init__(inner)
        self.asked = 0
        self._known: OrderedDict[bytes, Any] = OrderedDict()

    def forward(self, images: Tensor) -> Any:
        """Inner's, of images (B, 3, H, W)."""
        if images.requires_grad or len(images) != 1:
            self.asked += len(images)
            return self.inner(images)
        key = hashlib.blake2b(images.detach().cpu().contiguous().numpy().tobytes(), digest_size=16).digest()
        if key not in self._known:
            self.asked += 1
            self._known[key] = self.inner(images)
            if len(self._known) > _MOST:
                self._known.popitem(last=False)
        self._known.move_to_end(key)
        return self._known[key]
