"""A detector around another one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from torch import Tensor

from detectors.base import Candidates, Detector
from detectors.types import Detections, Targets


class Wrapping(Detector):
    """`inner`, of which subclasses change the pass (`forward`); all else is inner's."""

    def __init__(self, inner: Detector) -> None:
        super().__init__()
        self.inner = inner
        self.name, self.classes, self.t_star = inner.name, inner.classes, inner.t_star
        self.fresh_layers = tuple(f"inner.{beginning}" for beginning in inner.fresh_layers)

    def loss(self, raw: Any, targets: Sequence[Targets]) -> dict[str, Tensor]:
        """Inner's."""
        return self.inner.loss(raw, targets)

    def decode(self, raw: Any) -> list[Detections]:
        """Inner's."""
        return self.inner.decode(raw)

    def candidates(self, raw: Any) -> Candidates:
        """Inner's."""
        return self.inner.candidates(raw)

    @contextmanager
    def holding(self, raw: Any) -> Iterator[None]:
        """Inner's."""
        with self.inner.holding(raw):
            yield
