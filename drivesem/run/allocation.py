"""Control the C library's free memory: reuse it, or return it to the system. Imports nothing heavy."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable
from functools import cache

_MMAP_LIMIT_MB, _FREE_LIMIT_MB = 32, 256
"""Maximum size of blocks that stay with the process (the most that glibc accepts; layers and pictures are smaller), and
maximum of its free memory."""
_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1
"""Source: glibc's malloc.h."""


def keep_freed_memory() -> None:
    """Keep freed memory in the process, up to a limit. By default glibc returns large blocks to the system, which
    clears each page on the next request: a tenth of the time of a detector pass.

    Does nothing with another allocator, or where the environment configures glibc's.
    """
    configured = any(name.startswith("MALLOC_") or name == "GLIBC_TUNABLES" for name in os.environ)
    if configured or not sys.platform.startswith("linux"):
        return
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        set_option(_MMAP_THRESHOLD, _MMAP_LIMIT_MB << 20)
        set_option(_TRIM_THRESHOLD, _FREE_LIMIT_MB << 20)


def release_freed_memory() -> None:
    """Return free memory to the system: glibc keeps it in pieces between long-lived blocks. Does nothing with
    another C library.
    """
    trim = _malloc_trim()
    if trim is not None:
        trim(0)


@cache
def _malloc_trim() -> Callable[[int], int] | None:
    return getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
