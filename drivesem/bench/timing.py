"""Timers, medians, and the machine facts reported with every measurement."""

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
    """The median."""
    q1: float
    """Lower quartile."""
    q3: float
    """Upper quartile."""

    @property
    def iqr(self) -> float:
        """Interquartile range."""
        return self.q3 - self.q1

    @classmethod
    def from_values(cls, values: Sequence[float]) -> Spread:
        """The spread of at least one value."""
        q1, median, q3 = np.percentile(np.asarray(values, dtype=np.float64), [25, 50, 75]).tolist()
        return cls(median, q1, q3)


class CallTime(NamedTuple):
    """Duration of a call."""

    ms: float
    """Wall-clock time, ms."""
    cpu_ms: float
    """Processor time over all threads, ms; less affected by other work on the machine."""


class PairedTimer:
    """Times calls on a device, synchronising before and after."""

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self._cuda = torch.device(device).type == "cuda"

    def milliseconds(self, call: Callable[[], object]) -> float:
        """Wall-clock time of a call, ms."""
        return self.time_call(call).ms

    def time_call(self, call: Callable[[], object]) -> CallTime:
        """Wall-clock and processor time of a call."""
        self._wait()
        start, spent = time.perf_counter(), time.process_time()
        call()
        self._wait()
        return CallTime(1e3 * (time.perf_counter() - start), 1e3 * (time.process_time() - spent))

    def _wait(self) -> None:
        if self._cuda:
            torch.cuda.synchronize()


class TimeBudget:
    """Seconds shared among the remaining measurements."""

    def __init__(self, seconds: float, rows: int) -> None:
        """Start now, with `rows` rows to measure."""
        self._end = time.perf_counter() + seconds
        self._rows = rows

    def share(self, preparation: float = 0.0) -> float:
        """Seconds for the next row: an equal part of the rest, after `preparation` seconds for each other row.
        Time saved in one row is available to the others.
        """
        rows = max(self._rows, 1)
        self._rows -= 1
        left = self._end - time.perf_counter() - preparation * (rows - 1)
        return max(left, 0.0) / rows


def repetitions(seconds: float, fewest: int, most: int) -> Iterator[int]:
    """Count repetitions until `seconds` have passed.

    Args:
        seconds: Time limit.
        fewest: Least number of repetitions.
        most: Largest number of repetitions.
    """
    start = time.perf_counter()
    for i in range(most):
        if i >= fewest and time.perf_counter() - start >= seconds:
            return
        yield i


def machine_facts(device: torch.device | str = "cpu") -> dict[str, Any]:
    """Processor, cores, torch threads, memory in GB, and the GPU's name if one is used."""
    facts: dict[str, Any] = {
        "cpu": _processor_name(),
        "cores": _core_count(),
        "threads": torch.get_num_threads(),
        "ram": memory_gb(),
    }
    if torch.device(device).type == "cuda":
        facts["gpu"] = torch.cuda.get_device_name(device)
    return facts


def package_versions() -> dict[str, str]:
    """Versions of Python and of the packages that affect the measurements."""
    found = {name: importlib.metadata.version(package) for name, package in _PACKAGES.items()}
    return {"python": platform.python_version(), **found}


def _processor_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _core_count() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
