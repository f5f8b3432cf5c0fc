"""Independent pieces of work shared by the machines of a Ray cluster: https://docs.ray.io.

One actor of Ray is one process, and has one job at a time, so that what a machine takes with it is what was in its
hands. It is begun anew elsewhere, and the job is tried again.
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
from drivesem.run.jobs import Start, begin, do, ended

if TYPE_CHECKING:
    from types import ModuleType

J = TypeVar("J")
_PATIENCE_S, _PAUSE_S = 10.0, 1.0
_LOST_S = 60.0
"""A process that ended is begun anew; one that is not back after so long is given up."""
_TRIES = 3
"""How often a process may end with a job in hand, before that is listed."""


class _Process:
    """What an actor is. Made on another machine: paths of settings are relative to the folder of the command."""

    def __init__(self, folder: str, start: Start) -> None:
        os.chdir(folder)
        begin(start)

    def ready(self) -> None:
        """Returns once everything that jobs need has been made."""

    def do(self, job: Any) -> tuple[Any, Exception | None]:
        """A job's result, or what went wrong with it."""
        try:
            return do(job), None
        except Exception as error:
            return None, error


@dataclass(frozen=True, slots=True)
class _InHand:
    """An actor and the job that it does, None while it is getting ready. tries: of the job, before this one; gone:
    since when the actor has not been there, None where it was when it was last asked.
    """

    actor: Any
    job: Any = None
    tries: int = 0
    gone: float | None = None


def run_jobs_on_ray(
    start: Start, jobs: Sequence[J], config: WorkerOptions
) -> Iterator[tuple[J, Callable[[], Any]]]:
    """Each job with a call that gives its result or raises what went wrong, as they are done.

    By `--workers` processes on the machines of the cluster, by default one for each CPU. Raises UsageError where
    there is no Ray, or no cluster.
    """
    if not jobs:
        return
    ray = _loaded()
    if not ray.is_initialized():  # it stays until this process ends: commands ask more than once
        _connect(ray, config.address)
    count = min(config.workers or max(int(ray.cluster_resources().get("CPU", 1)), 1), len(jobs))
    kind = ray.remote(num_cpus=1, max_restarts=-1, scheduling_strategy="SPREAD")(_Process)
    actors = [kind.remote(os.getcwd(), start) for _ in range(count)]
    try:
        yield from _shared(ray, actors, deque((job, 0) for job in jobs))
    finally:
        for actor in actors:
            ray.kill(actor)


def _connect(ray: ModuleType, address: str | None) -> None:
    host, _, port = (address or "").removeprefix("ray://").rpartition(":")
    before, expected = signal.getsignal(signal.SIGTERM), "a Ray cluster"
    try:
        if host and port.isdecimal():  # Ray itself would go on asking for minutes
            socket.create_connection((host, int(port)), _PATIENCE_S).close()
        # Not whatever cluster ran here last, which is what Ray takes without an address.
        expected = "a Ray cluster (which may ask for RAY_AUTH_MODE=token)"
        ray.init(address=address or "local", log_to_driver=False, logging_level="ERROR")
    except OSError as error:
        raise UsageError("--address", expected, f"{address}: {error}") from error
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)


def _shared(
    ray: ModuleType, actors: Sequence[Any], left: deque[tuple[Any, int]]
) -> Iterator[tuple[Any, Callable[[], Any]]]:
    pending: dict[Any, _InHand] = {actor.ready.remote(): _InHand(actor) for actor in actors}
    absent: deque[tuple[float, _InHand]] = deque()  # and when they are asked again
    while pending or absent:
        while absent and (time.monotonic() >= absent[0][0] or not pending):
            due, hand = absent.popleft()
            time.sleep(max(due - time.monotonic(), 0))
            pending[hand.actor.ready.remote()] = hand
        done, _ = ray.wait(list(pending), num_returns=1, timeout=_PAUSE_S if absent else None)
        if not done:
            continue
        hand = pending.pop(done[0])
        outcome: Callable[[], Any] | None = None
        try:
            result, error = ray.get(done[0]) or (None, None)
            outcome = partial(_hand_over, result, error)
            ready = True
        except ray.exceptions.RayActorError as error:
            if getattr(error, "actor_init_failed", False):
                raise
            # Begun anew by Ray where there is room: only then it gets a job again. Or never: where the head takes
            # this machine for lost, it ends all that this process began.
            now = time.monotonic()
            gone = now if hand.gone is None else hand.gone
            if now - gone < _LOST_S:
                absent.append((now + _PAUSE_S, _InHand(hand.actor, gone=gone)))
            ready = False
            if hand.job is not None and hand.tries + 1 < _TRIES:
                left.appendleft((hand.job, hand.tries + 1))
            elif hand.job is not None:
                outcome = ended
        if ready and left:
            job, tries = left.popleft()
            pending[hand.actor.do.remote(job)] = _InHand(hand.actor, job, tries)
        if hand.job is not None and outcome is not None:
            yield hand.job, outcome
        if not left and not any(one.job is not None for one in pending.values()):
            return
    raise UsageError(
        "--engine", "a Ray cluster that lasts (the same command goes on)", "none of its processes left"
    )


def _hand_over(result: Any, error: Exception | None) -> Any:
    if error is not None:
        raise error
    return result


def _loaded() -> ModuleType:
    try:
        import ray
    except ImportError as error:
        raise UsageError("--engine", "local, or Ray installed (pip install 'drivesem[ray]')", "ray") from error
    return ray
