"""Freed memory stays with the process, unless its environment says otherwise."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

_FAULTS = """
import resource, sys
import torch
if sys.argv[1] == "kept":
    from drivesem.run.allocation import keep_freed
    keep_freed()
def work():
    for _ in range(3):
        layers = [torch.zeros(n << 18) for n in (8, 16, 30)]
        torch.zeros(1 << 18)
work()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
work()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""
"""How many pages the system clears for the same work a second time."""


def faults(how: str, **environment: str) -> int:
    still = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    told = subprocess.run(
        [sys.executable, "-c", _FAULTS, how],
        capture_output=True,
        text=True,
        check=True,
        env={**still, **environment},
    )
    return int(told.stdout)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs glibc's allocator: not Linux")
def test_freed_memory_is_not_cleared_again() -> None:
    assert faults("kept") < 100
    assert faults("plain") > 10_000


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs glibc's allocator: not Linux")
def test_the_environments_word_counts() -> None:
    assert faults("kept", MALLOC_TRIM_THRESHOLD_="131072") > 10_000
