"""Torch devices and memory of this machine."""

from __future__ import annotations

import os

import torch

from drivesem.config.errors import UsageError


def check_device(device: str) -> None:
    """Raise UsageError if this machine has no such torch device."""
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        found = f"{device!r}: {error}".split("\n")[0]
        raise UsageError("--device", "a torch device of this machine", found) from error


def memory_gb() -> float | None:
    """Gigabytes (2^30 bytes) of memory of this machine; None if its system does not report it."""
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (AttributeError, OSError, ValueError):
        return None
