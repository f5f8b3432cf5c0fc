"""Independent pieces of work, such as frames, shared by processes of one machine."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context, parent_process
from typing import Any, TypeVar

import torch

from drivesem.config import Common, processes

J = TypeVar("J")
R = TypeVar("R")

_work: Callable[[Any], Any] | None = None


def outcomes(
    work: Callable[[J], R], build: Callable[[], Callable[[J], R]], jobs: Sequence[J], config: Common
) -> Iterator[tuple[J, Callable[[], R]]]:
    """Each job with a call that gives its result or raises what went wrong, as they are done.

    work: does a job in this process, where one process is enough. build: makes the like of it in another process,
    once for each, and can be pickled, as jobs and results can.
    """
    # The number of threads follows from the settings, not from the jobs left: a resumed run adds up alike.
    threads = max((os.cpu_count() or 1) // processes(config), 1)
    torch.set_num_threads(threads)
    count = min(processes(config), len(jobs))
    if count <= 1:
        for job in jobs:
            yield job, lambda job=job: work(job)
        return
    pool = ProcessPoolExecutor(count, get_context("spawn"), initializer=_start, initargs=(build, threads))
    with pool:
        pending = {pool.submit(_do, job): job for job in jobs}
        try:
            for future in as_completed(pending):
                yield pending[future], future.result
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _start(build: Callable[[], Callable[[Any], Any]], threads: int) -> None:
    global _work
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    torch.set_num_threads(threads)
    _work = build()


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
