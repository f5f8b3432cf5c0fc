"""What it costs to hand frames to Ray instead of to processes of one's own: small frames, in turn."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

from detectors.base import Detector
from detectors.registry import load_detector
from drivesem.bench.scenes import build_bench_scene
from drivesem.bench.session import Columns
from drivesem.bench.timing import Spread
from drivesem.config.commands import AttackConfig
from drivesem.run.attack import AttackWorker
from drivesem.run.finished import PICTURES
from drivesem.run.frame import write_frame
from drivesem.run.workers import run_jobs
from scene_ir import files
from tools.bench.settings import DetectorBenchConfig

Engine = Literal["local", "ray"]
FRAMES, QUICK_FRAMES = 200, 40
"""Frames per engine, by default and with --quick."""
_ROUNDS, _QUICK_ROUNDS = 4, 2
_CARS, _TRIANGLES, _SCALE = 2, 300, 0.5
TITLE = "Frames shared by processes of this machine, and by Ray"
COLUMNS: Columns = {
    "engine": ("engine", "engine"),
    "processes": ("processes", "processes"),
    "frames": ("frames", "frames"),
    "first_s": ("first start, s", "first start, s"),
    "start_s": ("later starts, s", "start, s"),
    "frame_ms": ("a frame, ms", "a frame, ms"),
    "frame_iqr": ("IQR", "IQR"),
    "own_ms": ("of it its own work, ms", "own work, ms"),
    "own_iqr": ("IQR", None),
    "over_ms": ("overhead, ms", "over, ms"),
    "same": ("frames as the other's", "same"),
}
METHOD = (
    f"Streets of {_CARS} cars, {_SCALE:g} of KITTI's width, are made, attacked by one step of fgsm, and written, "
    "by as many processes of either kind, in rounds in turn (local, ray, ray, local, ...). First start: until "
    "the first frame begins, on a cluster that is begun for it; later starts: the same of the rounds, median. A "
    "frame: from the first frame of a round to its last, for each frame and process, its own work included; "
    "medians and quartiles over rounds, of its own work over frames. Overhead: the difference to the "
    "mean of its own work."
)


@dataclass(frozen=True, slots=True)
class ScaleRow:
    """One engine; see `METHOD`."""

    engine: Engine
    processes: int
    frames: int
    first_s: float
    start_s: float
    frame_ms: float
    frame_iqr: float
    own_ms: float
    own_iqr: float
    over_ms: float
    same: int


@dataclass(frozen=True, slots=True)
class _ScaleRound:
    """start_s: until the first frame began; frame_ms: per frame of a process; own_ms: of each frame; digests: SHA-256
    of each frame's result, by number.
    """

    start_s: float
    frame_ms: float
    own_ms: list[float]
    digests: dict[int, str]


def measure(config: DetectorBenchConfig) -> Iterator[ScaleRow]:
    """A row for each engine. Raises UsageError where there is no Ray."""
    frames, count = (QUICK_FRAMES, _QUICK_ROUNDS) if config.quick else (FRAMES, _ROUNDS)
    processes = config.processes
    a_round = max((config.limit or frames) // count, 2 * processes)
    engines: tuple[Engine, Engine] = ("local", "ray")
    work, settings = _worker(config.detector), {engine: _settings(config, engine) for engine in engines}
    first = {engine: _round(work, settings[engine], range(2 * processes)) for engine in engines}
    rounds: dict[Engine, list[_ScaleRound]] = {engine: [] for engine in engines}
    for number in range(count):
        for engine in engines if number % 2 == 0 else engines[::-1]:
            numbers = range(number * a_round, (number + 1) * a_round)
            rounds[engine].append(_round(work, settings[engine], numbers))
    digests = {engine: {k: v for one in rounds[engine] for k, v in one.digests.items()} for engine in engines}
    same = sum(digests["local"][number] == digests["ray"][number] for number in digests["local"])
    for engine in engines:
        times = rounds[engine]
        frame = Spread.from_values([one.frame_ms for one in times])
        own = Spread.from_values([ms for one in times for ms in one.own_ms])
        mean = sum(sum(one.own_ms) for one in times) / sum(len(one.own_ms) for one in times)
        yield ScaleRow(
            engine=engine,
            processes=processes,
            frames=count * a_round,
            first_s=round(first[engine].start_s, 2),
            start_s=round(Spread.from_values([one.start_s for one in times]).median, 2),
            frame_ms=round(frame.median, 1),
            frame_iqr=round(frame.iqr, 1),
            own_ms=round(own.median, 1),
            own_iqr=round(own.iqr, 1),
            over_ms=round(frame.median - mean, 1),
            same=same,
        )


def _settings(config: DetectorBenchConfig, engine: Engine) -> DetectorBenchConfig:
    address = config.address if engine == "ray" else None
    return replace(config, engine=engine, address=address, workers=config.processes)


def _round(work: Callable[[int], tuple[float, str]], config: DetectorBenchConfig, numbers: range) -> _ScaleRound:
    begun = time.perf_counter()
    ends, own_ms, digests = [], [], {}
    build = partial(_worker, config.detector)
    for number, outcome in run_jobs(work, build, list(numbers), config, in_subprocess=True):
        seconds, digests[number] = outcome()
        ends.append(time.perf_counter())
        own_ms.append(1e3 * seconds)
    start = ends[0] - own_ms[0] / 1e3
    wall = 1e3 * (ends[-1] - start)
    return _ScaleRound(start - begun, wall * config.processes / len(ends), own_ms, digests)


def _worker(name: str) -> Callable[[int], tuple[float, str]]:
    return partial(_frame, detector=load_detector(name))


def _frame(number: int, detector: Detector) -> tuple[float, str]:
    """Seconds that a frame takes, and its picture's hash."""
    begun = time.perf_counter()
    scene = build_bench_scene(_CARS, _TRIANGLES, number, _SCALE).scene
    config = AttackConfig(method="fgsm", params="translate,rotate", steps=1, grade=False, seed=number)
    attacked = AttackWorker.from_config(config, detector).attack_scene(f"bench-{number}", scene)
    with tempfile.TemporaryDirectory(prefix="drivesem-scale-") as folder:
        write_frame(attacked, Path(folder) / "frame")
        digest = files.sha256_digest(Path(folder) / "frame" / PICTURES["attacked"])
    return time.perf_counter() - begun, digest
