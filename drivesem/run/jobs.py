"""Jobs in a worker process, on this machine or another: start, errors, and memory."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import torch

from detectors.adapters.network import RAISES_NOTHING, describe_user_error
from detectors.base import DetectorError
from drivesem import store
from drivesem.config.errors import UsageError
from drivesem.run.allocation import keep_freed_memory, release_freed_memory
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


def raise_process_ended() -> NoReturn:
    """Raise InternalError: the outcome of a job that ended its process twice."""
    actual = "one that was ended twice, for want of memory perhaps"
    raise InternalError("drivesem", "a process that lasts", actual)
