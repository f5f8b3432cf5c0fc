"""Throughput and memory of the scene generator, measured on whole data sets written to a temporary folder."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil

from drivesem.bench.session import Columns
from drivesem.config.options import WorkerOptions
from drivesem.run.workers import make_parallel_map
from drivesem.synth.variations import MIXED
from drivesem.synth.write import Order, synthesise

TITLE = "The scene generator"
COLUMNS: Columns = {
    "layout": ("layout", "layout"), "workers": ("processes", "processes"), "frames": ("frames", "frames"),
    "frames_per_second": ("frames a second", "frames/s"), "start_s": ("start, s", "start s"),
    "peak_rss_mb": ("peak of all processes, MB", "peak MB"), "growth_kb": ("growth, KB a frame", "KB/frame"),
}  # fmt: skip
METHOD = (
    "Each row writes a data set with all its files to a temporary folder, with single-threaded processes; KITTI's "
    "layout with depth and instance images too. frames_per_second counts from the moment when each process has "
    "made two frames on average to the last one; start is the time up to there, mostly imports. peak_rss_mb is "
    "the largest sum of the resident sets of all processes (sampled every 50 ms; shared pages count in each); "
    "growth is the slope of that sum over the second half of the run."
)
QUICK_FRAMES, FULL_FRAMES = 40, 200
_SAMPLE_S = 0.05
_KB = 1024.0


@dataclass(frozen=True, slots=True)
class SynthRow:
    """What was measured."""

    layout: str
    workers: int
    frames: int
    frames_per_second: float
    start_s: float
    peak_rss_mb: float
    growth_kb: float


def measure(frames: int, seed: int, workers: int) -> Iterator[SynthRow]:
    """A row for Virtual KITTI 2's layout with `workers` processes, one with a single one, one for KITTI's
    layout."""
    for layout, count in dict.fromkeys((("vkitti2", workers), ("vkitti2", 1), ("kitti", workers))):
        yield _row(layout, count, frames, seed)


def _row(layout: str, workers: int, frames: int, seed: int) -> SynthRow:
    with tempfile.TemporaryDirectory(prefix="drivesem-bench-") as name:
        clone = layout == "vkitti2"
        order = Order(
            out=Path(name) / "data",
            frames=frames,
            seed=seed,
            layout=layout,
            variations=("clone",) if clone else (MIXED,),
            people=not clone,
        )
        with _Watch() as watch:
            start = time.perf_counter()
            # A single process is a child too, so that what this one has loaded does not count.
            done = [
                time.perf_counter() - start
                for _ in synthesise(order, make_parallel_map(WorkerOptions(workers=workers), in_subprocess=True))
            ]
    warm = min(2 * workers, frames - 1)
    return SynthRow(
        layout=layout,
        workers=workers,
        frames=frames,
        frames_per_second=round((frames - warm) / (done[-1] - done[warm - 1]), 3),
        start_s=round(done[warm - 1], 3),
        peak_rss_mb=round(watch.peak_kb / _KB, 1),
        growth_kb=watch.growth_kb(frames),
    )


class _Watch:
    """Samples the resident memory of this process's children, all together, while its block runs."""

    def __init__(self) -> None:
        self._samples: list[int] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> _Watch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    @property
    def peak_kb(self) -> int:
        """The largest sum, KB."""
        return max(self._samples, default=0)

    def growth_kb(self, frames: int) -> float:
        """KB a frame, of a line through the second half of the samples."""
        late = np.asarray([s for s in self._samples[len(self._samples) // 2 :] if s > 0], np.float64)
        if len(late) < 2:
            return 0.0
        slope = float(np.polyfit(np.arange(len(late)), late, 1)[0])
        return round(slope * len(self._samples) / frames, 1)

    def _run(self) -> None:
        while not self._stop.wait(_SAMPLE_S):
            self._samples.append(sum(map(_resident_kb, psutil.Process().children(recursive=True))))


def _resident_kb(process: psutil.Process) -> int:
    """Resident memory of a process now, KB; 0 where it has ended."""
    try:
        return process.memory_info().rss // 1024
    except psutil.NoSuchProcess:
        return 0
