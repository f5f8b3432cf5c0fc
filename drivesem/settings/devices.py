"""Whether a torch device is there."""

from __future__ import annotations

import torch

from drivesem.settings.errors import UsageError


def check_device(device: str) -> None:
    """Raises UsageError naming --device where this machine has no such torch device."""
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        found = f"{device!r}: {error}".split("\n")[0]
        raise UsageError("--device", "a torch device of this machine", found) from error
