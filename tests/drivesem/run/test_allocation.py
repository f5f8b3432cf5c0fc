"""Freed memory stays with the process, unless the environment configures the allocator."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

_SCRIPT = """
import ctypes, sys
import torch
if sys.argv[1] == "retained":
    from drivesem.run.allocation import keep_freed_memory
    keep_freed_memory()

class Mallinfo2(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in (
        "arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost")]

mallinfo = ctypes.CDLL(None).mallinfo2
mallinfo.restype = Mallinfo2
layers = [torch.zeros(n << 18) for n in (8, 16, 30)]
del layers
print(mallinfo().fordblks >> 20)
"""
"""Prints the MB, of 54 freed, that glibc has free. Page faults prove nothing: the system may reclaim pages."""


def free_mb(how: str, **environment: str) -> int:
    still = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    process = subprocess.run(
        [sys.executable, "-c", _SCRIPT, how],
        capture_output=True,
        text=True,
        check=True,
        env={**still, **environment},
    )
    return int(process.stdout)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs glibc's allocator: not Linux")
def test_freed_memory_stays() -> None:
    assert free_mb("retained") >= 54
    assert free_mb("plain") < 54


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs glibc's allocator: not Linux")
def test_the_environment_wins() -> None:
    assert free_mb("retained", MALLOC_TRIM_THRESHOLD_="131072") < 54
