"""Peak memory of attack steps above the detector's own, each measured in a process of its own."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from drivesem.bench.scenes import build_bench_scene
from drivesem.bench.session import Columns
from scene_ir.io import save_scene
from tools.bench.probe import ProbeOrder, ResidentMemory, probe

TITLE = "Memory"
COLUMNS: Columns = {
    "sweep": ("against", "against"), "cars": ("cars", "cars"), "triangles": ("triangles a car", None),
    "steps": ("steps", "steps"), "peak_mb": ("peak, MB", "peak MB"),
    "detector_mb": ("detector alone, MB", "detector"), "above_mb": ("above it, MB", "above"),
    "libraries_mb": ("of which libraries, MB", "libraries"), "rss_10": ("after 10 steps, MB", "at 10"),
    "rss_100": ("after 100, MB", "at 100"), "rss_1000": ("after 1,000, MB", "at 1000"),
    "slope_kb": ("growth, KB a step", "KB/step"),
}  # fmt: skip
METHOD = (
    "Each row is a process of its own that reads a scene from disk and attacks it; detector_mb is the peak of "
    "another process that runs nothing but the detector, forward and backward, on the same images. peak_mb is "
    "the largest resident set the operating system saw (VmHWM on Linux), above_mb their difference, of which "
    "libraries_mb is there once renderer and attack are imported. rss_10, rss_100 and rss_1000 are resident "
    "MB after so many steps; slope_kb is the growth per step, KB, of a line fitted to the second half of the "
    "run."
)
QUICK_STEPS, FULL_STEPS = 100, 1000
_SWEEP_STEPS = 12
"""Steps of a row that is about cars: the peak is reached in the first."""
_KB = 1024.0
_ASKER = "bench memory"


@dataclass(frozen=True, slots=True)
class MemoryRow:
    """Memory of one case; MB unless noted."""

    sweep: str
    """What this row is about, cars or steps."""
    cars: int
    triangles: int
    steps: int
    peak_mb: float
    detector_mb: float
    above_mb: float
    libraries_mb: float
    rss_10: float | None
    rss_100: float | None
    rss_1000: float | None
    slope_kb: float | None


@dataclass(frozen=True, slots=True)
class MemoryCase:
    """One row to measure."""

    sweep: str
    cars: int
    triangles: int
    steps: int = _SWEEP_STEPS


def cases(cars: Sequence[int], triangles: Sequence[int], quick: bool) -> list[MemoryCase]:
    """Against cars; and against steps, at the usual size."""
    usual, most = (8 if 8 in cars else max(cars)), max(triangles)
    return [
        *(MemoryCase("cars", n, most) for n in cars),
        MemoryCase("steps", usual, most, steps=QUICK_STEPS if quick else FULL_STEPS),
    ]


def measure(case_list: Sequence[MemoryCase], seed: int, detector: str) -> Iterator[MemoryRow]:
    """One row a case. Raises FormatError where a process ends without a result."""
    with tempfile.TemporaryDirectory(prefix="drivesem-bench-") as name:
        folder = Path(name)
        alone: ResidentMemory | None = None
        for case in case_list:
            scene = folder / f"{case.cars}x{case.triangles}"
            if not scene.exists():
                save_scene(build_bench_scene(case.cars, case.triangles, seed).scene, scene)
            order = ProbeOrder(detector, torch.get_num_threads(), str(scene), case.steps, seed)
            alone = alone or probe("detector", order, _ASKER)
            yield _row(case, probe("attack", order, _ASKER), alone)


def _row(case: MemoryCase, attack: ResidentMemory, alone: ResidentMemory) -> MemoryRow:
    def after(step: int) -> float | None:
        return round(attack.rss_kb[step - 1] / _KB, 1) if len(attack.rss_kb) >= step else None

    return MemoryRow(
        sweep=case.sweep,
        cars=case.cars,
        triangles=case.triangles,
        steps=case.steps,
        peak_mb=round(attack.peak_kb / _KB, 1),
        detector_mb=round(alone.peak_kb / _KB, 1),
        above_mb=round((attack.peak_kb - alone.peak_kb) / _KB, 1),
        libraries_mb=round((attack.libraries_kb - alone.libraries_kb) / _KB, 1),
        rss_10=after(10),
        rss_100=after(100),
        rss_1000=after(1000),
        slope_kb=_slope(attack.rss_kb) if case.sweep == "steps" else None,
    )


def _slope(rss_kb: Sequence[int]) -> float:
    """KB a step, of the line through the second half."""
    late = np.asarray(rss_kb[len(rss_kb) // 2 :], dtype=np.float64)
    return round(float(np.polyfit(np.arange(len(late)), late, 1)[0]), 3) if len(late) > 1 else 0.0


def supported() -> bool:
    """Whether this system reports the peak resident memory of a process."""
    return os.name == "posix"
