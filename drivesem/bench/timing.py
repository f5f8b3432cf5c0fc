"""Stopwatches, medians, and the facts of the machine that every figure stands beside."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from drivesem.config.devices import memory_gb

_PACKAGES = {"torch": "torch", "warp": "warp-lang", "drivesem": "drivesem"}


@dataclass(frozen=True, slots=True)
class Spread:
    """Median and quartiles of repeated measurements."""

    median: float
    q1: float
    q3: float

    @property
    def iqr(self) -> float:
        """Distance of the quartiles."""
        return self.q3 - self.q1

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Of at least one value."""
        q1, median, q3 = np.percentile(np.asarray(values, dtype=np.float64), [25, 50, 75]).tolist()
        return cls(median, q1, q3)


class Taken(NamedTuple):
    """Milliseconds of a call: by the clock, and of the processor, all threads together, which others on the
    machine lengthen less.
    """

    ms: float
    cpu_ms: float


class Clock:
    """Milliseconds of calls on a device, waiting for the device before and after."""

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self._cuda = torch.device(device).type == "cuda"

    def ms(self, call: Callable[[], object]) -> float:
        """How long one call takes."""
        return self.taken(call).ms

    def taken(self, call: Callable[[], object]) -> Taken:
        """How long one call takes, by the clock and of the processor."""
        self._wait()
        start, spent = time.perf_counter(), time.process_time()
        call()
        self._wait()
        return Taken(1e3 * (time.perf_counter() - start), 1e3 * (time.process_time() - spent))

    def _wait(self) -> None:
        if self._cuda:
            torch.cuda.synchronize()


class Budget:
    """Seconds that are shared between what is left to measure."""

    def __init__(self, seconds: float, rows: int) -> None:
        """Starts now, with `rows` rows to come."""
        self._end = time.perf_counter() + seconds
        self._rows = rows

    def share(self, preparation: float = 0.0) -> float:
        """Seconds for the next row, which is prepared: an equal part of what is left when each of the others has
        been prepared in `preparation` seconds. What one row saves, the others may use.
        """
        rows = max(self._rows, 1)
        self._rows -= 1
        left = self._end - time.perf_counter() - preparation * (rows - 1)
        return max(left, 0.0) / rows


def rounds(seconds: float, fewest: int, most: int) -> Iterator[int]:
    """Numbers of repetitions until `seconds` are over: at least `fewest`, at most `most`."""
    start = time.perf_counter()
    for i in range(most):
        if i >= fewest and time.perf_counter() - start >= seconds:
            return
        yield i


def machine(device: torch.device | str = "cpu") -> dict[str, Any]:
    """Processor, cores, threads that torch uses, memory in GB, and the GPU's name where one is measured."""
    facts: dict[str, Any] = {
        "cpu": _processor(),
        "cores": _cores(),
        "threads": torch.get_num_threads(),
        "ram": memory_gb(),
    }
    if torch.device(device).type == "cuda":
        facts["gpu"] = torch.cuda.get_device_name(device)
    return facts


def versions() -> dict[str, str]:
    """Of Python and of the packages that decide the figures."""
    found = {name: importlib.metadata.version(package) for name, package in _PACKAGES.items()}
    return {"python": platform.python_version(), **found}


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
