"""What a process does that shares jobs with others, on this machine or on another one."""

from __future__ import annotations

import ctypes
import os
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import torch

from detectors.adapters.module import RAISES_NOTHING, describe_user_error
from detectors.base import DetectorError
from drivesem import store
from drivesem.config.errors import UsageError
from scene_ir.errors import SceneError, WriteError

J = TypeVar("J")
R = TypeVar("R")

_work: Callable[[Any], Any] | None = None


class UnforeseenError(SceneError):
    """A defect of drivesem that one job brought to light, and with which a night's work need not end."""


@dataclass(frozen=True, slots=True)
class Start:
    """How a process begins. build: makes what does a job; threads: of torch; keep_going: see `attempt`; url: of
    the store to which it brings what it makes, None where another process does.
    """

    build: Callable[[], Callable[[Any], Any]]
    threads: int
    keep_going: bool
    elsewhere: store.RemoteFolder | None = None


def begin(start: Start) -> None:
    """Once in a process, before its first job."""
    global _work
    keep_freed_memory()
    torch.set_num_threads(start.threads)
    store.set_output_store(start.elsewhere)
    _work = partial(attempt, start.build(), start.keep_going)


def do(job: Any) -> Any:
    """A job, in a process that has begun."""
    assert _work is not None
    result = _work(job)
    if (elsewhere := store.output_store()) is not None:
        elsewhere.upload(now=True)
    return result


def attempt(work: Callable[[J], R], keep_going: bool, job: J) -> R:
    """A job's result. SceneError where the device has no room for it, UsageError for what a user's own detector
    raised. keep_going: this, and an error for which no input is to blame, becomes UnforeseenError, which says
    where it arose.
    """
    try:
        result = work(job)
        give_back()
        return result
    except torch.OutOfMemoryError as error:
        found = str(error).splitlines()[0]
    except (SceneError, UsageError, DetectorError, WriteError):
        raise
    except Exception as error:
        if not keep_going:
            if (told := describe_user_error(error)) is not None:
                raise UsageError("--detector", RAISES_NOTHING, told) from error
            raise
        last = traceback.extract_tb(error.__traceback__)[-1]
        found = f"{type(error).__name__} at {Path(last.filename).name}:{last.lineno}: {error}"
        raise UnforeseenError("drivesem", "no defect of its own", found) from error
    # Not before the error is gone, which holds what the device has no room for.
    if torch.cuda.is_available():
        torch.cuda.empty_cache()
    raise SceneError("--device", "one with memory for this", found)


def give_back() -> None:
    """Hand what is free to the system again: glibc keeps it, in pieces between what lives on from job to job.
    Nothing happens where there is another C library.
    """
    trim = _trim()
    if trim is not None:
        trim(0)


@cache
def _trim() -> Callable[[int], int] | None:
    return getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None


def ended() -> NoReturn:
    """The outcome of a job at which processes ended."""
    raise UnforeseenError(
        "drivesem", "a process that lasts", "one that was ended twice, for want of memory perhaps"
    )


_LARGEST_MB, _KEPT_MB = 32, 256
"""Blocks of a layer or a picture are smaller than the first, the most that glibc takes; of what is free, so much
stays."""
_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1
"""Source: glibc's malloc.h."""


def keep_freed_memory() -> None:
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
