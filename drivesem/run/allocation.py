"""Memory that this process has freed, and will soon ask for again."""

from __future__ import annotations

import ctypes
import os
import sys

_LARGEST_MB, _KEPT_MB = 32, 256
"""Blocks of a layer or a picture are smaller than the first, the most that glibc takes; of what is free, so much
stays."""
_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1
"""Source: glibc's malloc.h."""


def keep_freed() -> None:
    """Freed memory stays with the process, up to a limit. By default glibc gives large blocks back to the system,
    which clears each page of them when the next pass asks for them: a tenth of what a detector's pass takes.

    Where there is another allocator, or the environment says how glibc's is to behave, all stays as it is.
    """
    told = any(name.startswith("MALLOC_") or name == "GLIBC_TUNABLES" for name in os.environ)
    if told or not sys.platform.startswith("linux"):
        return
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        set_option(_MMAP_THRESHOLD, _LARGEST_MB << 20)
        set_option(_TRIM_THRESHOLD, _KEPT_MB << 20)
