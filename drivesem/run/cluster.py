"""Shares independent jobs among the machines of a Ray cluster (https://docs.ray.io).

Each Ray actor is one process and runs one job at a time. If its machine fails, it is restarted elsewhere, and its job
is tried again.
"""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

from drivesem.config.errors import UsageError
from drivesem.config.options import WorkerOptions
from drivesem.run.jobs import ProcessStart, raise_process_ended, run_job, start_process

if TYPE_CHECKING:
    from types import ModuleType

J = TypeVar("J")
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
