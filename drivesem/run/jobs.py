"""Jobs in a worker process, on this machine or another: start, errors, and memory."""

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


class InternalError(SceneError):
    """A defect of drivesem in one job; the others can go on."""


@dataclass(frozen=True, slots=True)
class ProcessStart:
    """Settings of a worker process."""

    build: Callable[[], Callable[[Any], Any]]
    """Makes the function that does a job."""
    threads: int
    """Number of torch's threads."""
    keep_going: bool
    """See `try_job`."""
    output: store.RemoteFolder | None = None
    """Folder to upload results to; None where another process does."""


def start_process(start: ProcessStart) -> None:
    """Prepare a process, once before its first job."""
    global _work
    keep_freed_memory()
    torch.set_num_threads(start.threads)
    store.set_output_store(start.output)
    _work = partial(try_job, start.build(), start.keep_going)


def run_job(job: Any) -> Any:
    """Do a job, in a prepared process."""
    assert _work is not None
    result = _work(job)
    if (output := store.output_store()) is not None:
        output.upload(now=True)
    return result


def try_job(work: Callable[[J], R], keep_going: bool, job: J) -> R:
    """Do a job and translate its errors.

    Args:
        work: does the job.
        keep_going: raise InternalError, with its location, for an error that no input explains, or that a user's own
            detector raised.
        job: the job.

    Returns:
        The job's result.

    Raises:
        SceneError: the input is bad, or the device is out of memory.
        UsageError: a user's own detector raised an error.
    """
    try:
        result = work(job)
        release_freed_memory()
        return result
    except torch.OutOfMemoryError as error:
        actual = str(error).splitlines()[0]
    except (SceneError, UsageError, DetectorError, WriteError):
        raise
    except Exception as error:
        if not keep_going:
            if (description := describe_user_error(error)) is not None:
                raise UsageError("--detector", RAISES_NOTHING, description) from error
            raise
        last = traceback.extract_tb(error.__traceback__)[-1]
        actual = f"{type(error).__name__} at {Path(last.filename).name}:{last.lineno}: {error}"
        raise InternalError("drivesem", "no defect of its own", actual) from error
    # After the handler, because the exception holds tensors.
    if torch.cuda.is_available():
        torch.cuda.empty_cache()
    raise SceneError("--device", "one with memory for this", actual)


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


def raise_process_ended() -> NoReturn:
    """Raise InternalError: the outcome of a job that ended its process twice."""
    actual = "one that was ended twice, for want of memory perhaps"
    raise InternalError("drivesem", "a process that lasts", actual)


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
