"""Independent pieces of work, such as frames, shared by processes of one machine, or of a cluster."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from contextlib import contextmanager
from functools import partial
from itertools import islice
from multiprocessing import resource_tracker
from typing import Any, TypeVar

import cv2
import torch

from drivesem import store
from drivesem.config.options import WorkerOptions
from drivesem.run.cluster import run_jobs_on_ray
from drivesem.run.jobs import Start, attempt, begin, do, ended

J = TypeVar("J")
R = TypeVar("R")


def run_jobs(
    worker: Callable[[J], R],
    make_worker: Callable[[], Callable[[J], R]],
    jobs: Sequence[J],
    config: WorkerOptions,
    in_subprocess: bool = False,
) -> Iterator[tuple[J, Callable[[], R]]]:
    """Each job with a call that gives its result or raises what went wrong, as they are done.

    work: does a job in this process, where one process is enough. build: makes the like of it in another process,
    once for each, and can be pickled, as jobs and results can. With `keep_going` an error for which no input is to
    blame is raised as UnforeseenError, which says where it arose. So is, always, a job at which its process ended,
    and ended again when the job was tried alone. apart: in no case in this process. UsageError for a cluster that
    is not there.
    """
    elsewhere = store.current()
    for job, outcome in _outcomes(worker, make_worker, jobs, config, in_subprocess):
        yield job, outcome
        if elsewhere is not None:
            elsewhere.keep()
    if elsewhere is not None and config.engine == "ray":
        elsewhere.fetch()  # what other machines made


def _outcomes(
    work: Callable[[J], R],
    build: Callable[[], Callable[[J], R]],
    jobs: Sequence[J],
    config: WorkerOptions,
    apart: bool,
) -> Iterator[tuple[J, Callable[[], R]]]:
    if config.engine == "ray":
        yield from run_jobs_on_ray(Start(build, 1, config.keep_going, store.current()), jobs, config)
        return
    # The number of threads follows from the settings, not from the jobs left: a resumed run adds up alike.
    # No more than torch would take by itself: OMP_NUM_THREADS says what is left beside other work.
    before = torch.get_num_threads()
    threads = max(min((os.cpu_count() or 1) // config.processes, before), 1)
    torch.set_num_threads(threads)
    try:
        count = min(config.processes, len(jobs))
        if count > 1 or apart:
            yield from _shared(Start(build, threads, config.keep_going), jobs, count)
            return
        for job in jobs:
            yield job, partial(attempt, work, config.keep_going, job)
    finally:
        torch.set_num_threads(before)  # what follows, such as training, is alone again


def make_parallel_map(
    config: WorkerOptions, in_subprocess: bool = False
) -> Callable[[Callable[[J], R], Sequence[J]], Iterator[R]]:
    """What does jobs that nothing has to be made for, and gives their results as they are done; see `outcomes`."""

    def over(work: Callable[[J], R], jobs: Sequence[J]) -> Iterator[R]:
        for _, outcome in run_jobs(work, partial(_as_it_is, work), jobs, config, in_subprocess):
            yield outcome()

    return over


def _as_it_is(work: Callable[[J], R]) -> Callable[[J], R]:
    cv2.setNumThreads(1)  # the work is parallel over jobs already
    return work


def _shared(start: Start, jobs: Sequence[J], count: int) -> Iterator[tuple[J, Callable[[], Any]]]:
    left = list(jobs)
    while left:
        lost: list[J] = []
        for job, outcome in _pooled(start, tuple(left), count, lost):
            left.remove(job)
            yield job, outcome
        # A process is gone, for want of memory say, and nobody knows at which of these: each has one try alone.
        for job in lost:
            left.remove(job)
            again: list[J] = []
            yield from _pooled(start, [job], 1, again)
            if again:
                yield job, ended


def _pooled(start: Start, jobs: Sequence[J], count: int, lost: list[J]) -> Iterator[tuple[J, Callable[[], Any]]]:
    """Jobs by so many processes, as they are done. Where a process ends by itself all end, and those that were at
    work are `lost`.
    """
    from loky.process_executor import ProcessPoolExecutor, TerminatedWorkerError

    # A process that has grown by 300 MB, which layers that it keeps may take, is replaced between jobs: no news.
    warnings.filterwarnings("ignore", "A worker was restarted", UserWarning)
    pool = ProcessPoolExecutor(count, initializer=_begin, initargs=(os.getpid(), start))
    waiting, pending = iter(jobs), {}
    try:
        # No more jobs at a time than processes: what is pending is what is at work.
        with _unheard():
            pending |= {pool.submit(do, job): job for job in islice(waiting, count)}
        while pending:
            done, _ = wait(pending, return_when=FIRST_COMPLETED)
            gone = {future for future in done if isinstance(future.exception(), TerminatedWorkerError)}
            if not gone:
                pending |= {pool.submit(do, job): job for job in islice(waiting, len(done))}
            for future in done - gone:
                yield pending.pop(future), future.result
            if gone:
                lost += pending.values()
                return
    finally:
        # Done with, interrupted, or broken: nobody waits for what is still at work, which is whole or not there.
        pool.shutdown(kill_workers=True)


@contextmanager
def _unheard() -> Iterator[None]:
    """Processes that start inside never hear of Ctrl-C, which reaches all processes of a terminal, not even while
    Python itself loads: the one that starts them ends them. There it counts afterwards.
    """
    if sys.platform == "win32":
        yield
        return
    resource_tracker.ensure_running()  # starting it lets signals through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(parent: int, start: Start) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_leave_with, args=(parent,), daemon=True).start()
    begin(start)


def _leave_with(parent: int) -> None:
    """End this process when the one that started it is gone: killed, it can no longer say so itself, and its
    workers would wait for ever, each with a detector in memory.
    """
    while os.getppid() == parent:
        time.sleep(1)
    os._exit(1)
