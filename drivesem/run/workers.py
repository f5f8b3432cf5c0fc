"""Shares independent jobs, such as frames, among processes of one machine or a cluster."""

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
from drivesem.run.jobs import ProcessStart, raise_process_ended, run_job, start_process, try_job

J = TypeVar("J")
R = TypeVar("R")


def run_jobs(
    worker: Callable[[J], R],
    make_worker: Callable[[], Callable[[J], R]],
    jobs: Sequence[J],
    config: WorkerOptions,
    in_subprocess: bool = False,
) -> Iterator[tuple[J, Callable[[], R]]]:
    """Yield each job, as it completes, with a function that returns its result or raises its error.

    With `keep_going`, an error that no input explains is raised as InternalError, which names its place. So is a
    job that ended its process twice, the second time alone.

    Args:
        worker: Runs a job in this process, if one process suffices.
        make_worker: Makes the worker of another process, once per process; can be pickled, as jobs and results
            can.
        jobs: The jobs.
        config: Number of workers, engine, and whether to keep going.
        in_subprocess: Never run jobs in this process.

    Raises:
        UsageError: The cluster is missing.
    """
    elsewhere = store.output_store()
    for job, outcome in _run_jobs(worker, make_worker, jobs, config, in_subprocess):
        yield job, outcome
        if elsewhere is not None:
            elsewhere.upload()
    if elsewhere is not None and config.engine == "ray":
        elsewhere.fetch()  # files of other machines


def _run_jobs(
    work: Callable[[J], R],
    build: Callable[[], Callable[[J], R]],
    jobs: Sequence[J],
    config: WorkerOptions,
    apart: bool,
) -> Iterator[tuple[J, Callable[[], R]]]:
    if config.engine == "ray":
        yield from run_jobs_on_ray(ProcessStart(build, 1, config.keep_going, store.output_store()), jobs, config)
        return
    # The number of threads depends on the settings only, as it affects sums, and a resumed run must equal another.
    # It does not exceed torch's own, which OMP_NUM_THREADS limits.
    before = torch.get_num_threads()
    threads = max(min((os.cpu_count() or 1) // config.processes, before), 1)
    torch.set_num_threads(threads)
    try:
        count = min(config.processes, len(jobs))
        if count > 1 or apart:
            yield from _run_in_processes(ProcessStart(build, threads, config.keep_going), jobs, count)
            return
        for job in jobs:
            yield job, partial(try_job, work, config.keep_going, job)
    finally:
        torch.set_num_threads(before)  # what follows, such as training, uses all


def make_parallel_map(
    config: WorkerOptions, in_subprocess: bool = False
) -> Callable[[Callable[[J], R], Sequence[J]], Iterator[R]]:
    """Return a parallel map, which yields results as they complete; see `run_jobs`."""

    def parallel_map(work: Callable[[J], R], jobs: Sequence[J]) -> Iterator[R]:
        for _, outcome in run_jobs(work, partial(_make_plain_worker, work), jobs, config, in_subprocess):
            yield outcome()

    return parallel_map


def _make_plain_worker(work: Callable[[J], R]) -> Callable[[J], R]:
    cv2.setNumThreads(1)  # jobs run in parallel already
    return work


def _run_in_processes(start: ProcessStart, jobs: Sequence[J], count: int) -> Iterator[tuple[J, Callable[[], Any]]]:
    left = list(jobs)
    while left:
        lost: list[J] = []
        for job, outcome in _run_in_pool(start, tuple(left), count, lost):
            left.remove(job)
            yield job, outcome
        # A process ended, perhaps out of memory, during one of these jobs: each gets one try alone.
        for job in lost:
            left.remove(job)
            again: list[J] = []
            yield from _run_in_pool(start, [job], 1, again)
            if again:
                yield job, raise_process_ended


def _run_in_pool(
    start: ProcessStart, jobs: Sequence[J], count: int, lost: list[J]
) -> Iterator[tuple[J, Callable[[], Any]]]:
    """Run jobs in `count` processes. If a process ends unexpectedly, all end, and their jobs are appended to
    `lost`.
    """
    from loky.process_executor import ProcessPoolExecutor, TerminatedWorkerError

    # loky replaces a process that has grown by 300 MB, as cached layers may, between jobs
    warnings.filterwarnings("ignore", "A worker was restarted", UserWarning)
    pool = ProcessPoolExecutor(count, initializer=_start_process, initargs=(os.getpid(), start))
    waiting, pending = iter(jobs), {}
    try:
        # submit no more jobs than processes, so that pending jobs are running jobs
        with _block_interrupts():
            pending |= {pool.submit(run_job, job): job for job in islice(waiting, count)}
        while pending:
            done, _ = wait(pending, return_when=FIRST_COMPLETED)
            gone = {future for future in done if isinstance(future.exception(), TerminatedWorkerError)}
            if not gone:
                pending |= {pool.submit(run_job, job): job for job in islice(waiting, len(done))}
            for future in done - gone:
                yield pending.pop(future), future.result
            if gone:
                lost += pending.values()
                return
    finally:
        # do not wait for running jobs: their output is complete or absent
        pool.shutdown(kill_workers=True)


@contextmanager
def _block_interrupts() -> Iterator[None]:
    """Block Ctrl-C in processes that start inside the block, also while Python loads; the parent ends them. The
    parent handles it after the block.
    """
    if sys.platform == "win32":
        yield
        return
    resource_tracker.ensure_running()  # starting it unblocks signals
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_process(parent: int, start: ProcessStart) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, args=(parent,), daemon=True).start()
    start_process(start)


def _exit_with_parent(parent: int) -> None:
    """End this process when its parent is gone. A killed parent cannot end its workers, which would wait for ever,
    each with a detector in memory.
    """
    while os.getppid() == parent:
        time.sleep(1)
    os._exit(1)
