"""Freed memory stays with the process, unless its environment says otherwise."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

_KEPT = """
import ctypes, sys
import torch
if sys.argv[1] == "kept":
    from drivesem.run.jobs import keep_freed
    keep_freed()

class Mallinfo2(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in (
        "arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost")]

told = ctypes.CDLL(None).mallinfo2
told.restype = Mallinfo2
layers = [torch.zeros(n << 18) for n in (8, 16, 30)]
del layers
print(told().fordblks >> 20)
"""
"""How many MB of 54 that were freed glibc has at hand. Faults do not tell: the system may take pages away."""


def kept_mb(how: str, **environment: str) -> int:
    still = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    told = subprocess.run(
        [sys.executable, "-c", _KEPT, how],
        capture_output=True,
        text=True,
        check=True,
        env={**still, **environment},
    )
    return int(told.stdout)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs glibc's allocator: not Linux")
def test_freed_memory_stays() -> None:
    assert kept_mb("kept") >= 54
    assert kept_mb("plain") < 54


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs glibc's allocator: not Linux")
def test_the_environments_word_counts() -> None:
    assert kept_mb("kept", MALLOC_TRIM_THRESHOLD_="131072") < 54
