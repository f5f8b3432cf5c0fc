"""What does not fit into the memory of a device at once is done in halves."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, TypeVar

import torch

T = TypeVar("T")
R = TypeVar("R")


def in_halves(work: Callable[[Any], list[R]], items: Any, what: str) -> list[R]:
    """What `work` gives of items, one result each, all at once: or of each half, and so on, where the device's
    memory does not hold as many, which a line on standard error says.

    items: a sequence or a tensor; what: they are, for that line. Raises torch.OutOfMemoryError where not even one
    fits.
    """
    try:
        return work(items)
    except torch.OutOfMemoryError:
        if len(items) < 2:
            raise
    # Not before the error is gone, which holds what the device has no room for.
    make_room(f"{len(items)} {what} at once do not fit into the device's memory: trying {-(-len(items) // 2)}")
    half = -(-len(items) // 2)
    return [*in_halves(work, items[:half], what), *in_halves(work, items[half:], what)]


def make_room(line: str) -> None:
    """Let go of what the device keeps for later, and say why on standard error."""
    if torch.cuda.is_available():
        torch.cuda.empty_cache()
    sys.stderr.write(f"drivesem: {line}\n")
