"""Shares independent jobs, such as frames, among processes of this machine or of a Ray cluster (https://docs.ray.io).

Each Ray actor is one process and runs one job at a time. If its machine fails, it is restarted elsewhere, and its job
is tried again.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import cv2
import torch

from detectors.adapters.network import RAISES_NOTHING, describe_user_error
from detectors.base import DetectorError
from drivesem import store
from drivesem.config.errors import UsageError
from drivesem.config.options import WorkerOptions
from drivesem.run.allocation import keep_freed_memory, release_freed_memory
from scene_ir.errors import SceneError, WriteError

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
        # do not wait for running jobs: their output is complete or absent; idle processes end by themselves in the
        # meantime, since a killed one leaks the semaphores of its libraries
        pool.shutdown(wait=bool(pending), kill_workers=bool(pending))


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


if TYPE_CHECKING:
    from types import ModuleType

_PATIENCE_S, _PAUSE_S = 10.0, 1.0
_LOST_S = 60.0
"""Time after which an actor that does not restart is given up."""
_TRIES = 3
"""Number of tries of a job before it counts as failed."""


class _RayWorker:
    """Class of the actors. Paths in settings are relative to the working directory of the command."""

    def __init__(self, folder: str, start: ProcessStart) -> None:
        os.chdir(folder)
        start_process(start)

    def ready(self) -> None:
        """Return once the worker has been made."""

    def do(self, job: Any) -> tuple[Any, Exception | None]:
        """Run a job. Returns its result or its error."""
        try:
            return run_job(job), None
        except Exception as error:
            return None, error


@dataclass(frozen=True, slots=True)
class _ActorState:
    """An actor and its job."""

    actor: Any
    """The actor."""
    job: Any = None
    """Its job; None while it starts."""
    tries: int = 0
    """Earlier tries of the job."""
    missing_since: float | None = None
    """Time at which the actor failed; None if it responded last time."""


def run_jobs_on_ray(
    start: ProcessStart, jobs: Sequence[J], config: WorkerOptions
) -> Iterator[tuple[J, Callable[[], Any]]]:
    """Yield each job, as it completes, with a function that returns its result or raises its error.

    Args:
        start: How a process starts.
        jobs: The jobs.
        config: Number of processes, by default one per CPU of the cluster, and its address.

    Raises:
        UsageError: Ray or the cluster is missing.
    """
    if not jobs:
        return
    ray = _import_ray()
    if not ray.is_initialized():  # stays for further calls until this process ends
        _connect(ray, config.address)
    count = min(config.workers or max(int(ray.cluster_resources().get("CPU", 1)), 1), len(jobs))
    kind = ray.remote(num_cpus=1, max_restarts=-1, scheduling_strategy="SPREAD")(_RayWorker)
    actors = [kind.remote(os.getcwd(), start) for _ in range(count)]
    try:
        yield from _distribute_jobs(ray, actors, deque((job, 0) for job in jobs))
    finally:
        for actor in actors:
            ray.kill(actor)


def _connect(ray: ModuleType, address: str | None) -> None:
    host, _, port = (address or "").removeprefix("ray://").rpartition(":")
    before, expected = signal.getsignal(signal.SIGTERM), "a Ray cluster"
    try:
        if host and port.isdecimal():  # Ray itself would retry for minutes
            socket.create_connection((host, int(port)), _PATIENCE_S).close()
        # without an address, Ray would connect to the last cluster of this machine
        expected = "a Ray cluster (which may need RAY_AUTH_MODE=token)"
        ray.init(address=address or "local", log_to_driver=False, logging_level="ERROR")
    except OSError as error:
        raise UsageError("--address", expected, f"{address}: {error}") from error
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)


def _distribute_jobs(
    ray: ModuleType, actors: Sequence[Any], left: deque[tuple[Any, int]]
) -> Iterator[tuple[Any, Callable[[], Any]]]:
    pending: dict[Any, _ActorState] = {actor.ready.remote(): _ActorState(actor) for actor in actors}
    absent: deque[tuple[float, _ActorState]] = deque()  # with the time of the next check
    while pending or absent:
        while absent and (time.monotonic() >= absent[0][0] or not pending):
            due, state = absent.popleft()
            time.sleep(max(due - time.monotonic(), 0))
            pending[state.actor.ready.remote()] = state
        done, _ = ray.wait(list(pending), num_returns=1, timeout=_PAUSE_S if absent else None)
        if not done:
            continue
        state = pending.pop(done[0])
        outcome: Callable[[], Any] | None = None
        try:
            result, error = ray.get(done[0]) or (None, None)
            outcome = partial(_make_outcome, result, error)
            ready = True
        except ray.exceptions.RayActorError as error:
            if getattr(error, "actor_init_failed", False):
                raise
            # Ray restarts the actor where there is room, and only then it gets a job. It never does if the head
            # node lost this machine.
            now = time.monotonic()
            missing_since = now if state.missing_since is None else state.missing_since
            if now - missing_since < _LOST_S:
                absent.append((now + _PAUSE_S, _ActorState(state.actor, missing_since=missing_since)))
            ready = False
            if state.job is not None and state.tries + 1 < _TRIES:
                left.appendleft((state.job, state.tries + 1))
            elif state.job is not None:
                outcome = raise_process_ended
        if ready and left:
            job, tries = left.popleft()
            pending[state.actor.do.remote(job)] = _ActorState(state.actor, job, tries)
        if state.job is not None and outcome is not None:
            yield state.job, outcome
        if not left and not any(one.job is not None for one in pending.values()):
            return
    raise UsageError(
        "--engine", "a Ray cluster that lasts (the same command goes on)", "none of its processes left"
    )


def _make_outcome(result: Any, error: Exception | None) -> Any:
    if error is not None:
        raise error
    return result


def _import_ray() -> ModuleType:
    try:
        import ray
    except ImportError as error:
        raise UsageError("--engine", "local, or Ray installed (pip install 'drivesem[ray]')", "ray") from error
    return ray
