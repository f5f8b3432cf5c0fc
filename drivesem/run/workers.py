"""Independent pieces of work, such as frames, shared by processes of one machine."""

from __future__ import annotations

import os
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any, TypeVar

import torch

from detectors.base import DetectorError
from drivesem.settings.blocks import Sharing
from drivesem.settings.errors import UsageError
from scene_ir.errors import SceneError

J = TypeVar("J")
R = TypeVar("R")

_work: Callable[[Any], Any] | None = None


class UnforeseenError(SceneError):
    """A defect of drivesem that one job brought to light, and with which a night's work need not end."""


def outcomes(
    work: Callable[[J], R], build: Callable[[], Callable[[J], R]], jobs: Sequence[J], config: Sharing
) -> Iterator[tuple[J, Callable[[], R]]]:
    """Each job with a call that gives its result or raises what went wrong, as they are done.

    work: does a job in this process, where one process is enough. build: makes the like of it in another process,
    once for each, and can be pickled, as jobs and results can. With `keep_going` an error for which no input is to
    blame is raised as UnforeseenError, which says where it arose.
    """
    # The number of threads follows from the settings, not from the jobs left: a resumed run adds up alike.
    # No more than torch would take by itself: OMP_NUM_THREADS says what is left beside other work.
    before = torch.get_num_threads()
    threads = max(min((os.cpu_count() or 1) // config.processes, before), 1)
    torch.set_num_threads(threads)
    try:
        yield from _outcomes(work, build, jobs, config, threads)
    finally:
        torch.set_num_threads(before)  # what follows, such as training, is alone again


def _outcomes(
    work: Callable[[J], R],
    build: Callable[[], Callable[[J], R]],
    jobs: Sequence[J],
    config: Sharing,
    threads: int,
) -> Iterator[tuple[J, Callable[[], R]]]:
    count = min(config.processes, len(jobs))
    if count <= 1:
        here = partial(_forgiving, work) if config.keep_going else work
        for job in jobs:
            yield job, partial(here, job)
        return
    start = (build, threads, config.keep_going)
    pool = ProcessPoolExecutor(count, get_context("spawn"), initializer=_start, initargs=start)
    with pool:
        pending = {pool.submit(_do, job): job for job in jobs}
        try:
            for future in as_completed(pending):
                yield pending[future], future.result
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _start(build: Callable[[], Callable[[Any], Any]], threads: int, keep_going: bool) -> None:
    global _work
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    torch.set_num_threads(threads)
    work = build()
    _work = partial(_forgiving, work) if keep_going else work


def _forgiving(work: Callable[[J], R], job: J) -> R:
    try:
        return work(job)
    except (SceneError, UsageError, DetectorError):
        raise
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        found = f"{type(error).__name__} at {Path(last.filename).name}:{last.lineno}: {error}"
        raise UnforeseenError("drivesem", "no defect of its own", found) from error


def _leave_with_parent() -> None:
    """End this process when the one that started it is gone: killed, it can no longer say so itself, and its
    workers would wait for ever, each with a detector in memory.
    """
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _do(job: Any) -> Any:
    assert _work is not None
    return _work(job)
