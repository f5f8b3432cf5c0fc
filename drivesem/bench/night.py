"""How long an attack on many frames takes on this machine: some of them tell, and where the time goes."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drivesem.bench.tables import Columns
from drivesem.config.blocks import Scenes, shared
from drivesem.config.commands import Attack, Bench
from drivesem.config.errors import UsageError
from drivesem.config.parsing import parse, preset_words
from drivesem.evaluation.resampling import DRAWS, intervals, rate
from drivesem.run.attack import Worker
from drivesem.run.frame import write_frame
from drivesem.scenes.sources import NoVehicleError, open_source

FRAMES = 20
"""Frames that tell, where nobody says how many."""
PARTS = ("derender", "search", "certify", "write")
PARTS_TITLE = "where the time of a frame goes"
PARTS_COLUMNS: Columns = {
    "part": ("part", "part"),
    "mean_s": ("s a frame", "s a frame"),
    "median_s": ("median", "median"),
    "p90_s": ("nine tenths within", "90 %"),
    "share": ("share", "share"),
}
NIGHTS_TITLE = "how long all of it takes"
NIGHTS_COLUMNS: Columns = {
    "how": ("how", "how"),
    "by": ("by", "by"),
    "frames": ("frames", "frames"),
    "processes": ("processes", "processes"),
    "hours": ("hours", "hours"),
    "low": ("from", "from"),
    "high": ("to", "to"),
}
METHOD = (
    "Frames that lie evenly in the data set are attacked as drivesem attack would, in as many processes, and "
    "each part is timed there: derender takes the photograph apart; search is the attack with what it "
    "prepares; certify grades its failures, with the second renderer and the other detector; write is the "
    "frame's folder and the independent check. Frames without vehicles are passed over by their labels. Hours: "
    "the mean of all parts for each frame, shared by the processes; intervals 95 %, by bootstrap over frames. "
    "Start-up, some seconds a process, is left out. Measured: the same frames in another way; reckoned: from "
    "the parts, or, for no other work, from the processor's seconds, where a process has one thread."
)


@dataclass(frozen=True, slots=True)
class Spent:
    """Seconds of one frame. unfitted: of taking it apart with --no-fit, None where that was done anyway.
    processor: of the processor, for all parts, None where several threads shared them.
    """

    derender: float
    search: float
    certify: float
    write: float
    unfitted: float | None
    processor: float | None = None

    @property
    def total(self) -> float:
        """All parts of the attack."""
        return self.derender + self.search + self.certify + self.write


def settings_of(config: Bench) -> Attack:
    """The attack that is to be foretold. Raises UsageError for a preset that cannot be."""
    words = [] if config.attack is None else preset_words(config.attack, "attack")
    named = parse(["attack", *words])
    assert isinstance(named, Attack)
    own = shared(config, Scenes) | {"workers": config.workers, "device": config.device, "limit": None}
    settings = replace(named, **own, keep_going=config.keep_going, out=None)
    if config.detector != Bench.detector:
        settings = replace(settings, detector=config.detector)
    settings.check()
    return settings


def spread(names: Sequence[str], count: int) -> list[str]:
    """So many of the names, evenly; all where there are fewer."""
    places = np.linspace(0, len(names) - 1, min(count, len(names))).round()
    return [names[int(i)] for i in places]


def timer_of(settings: Attack) -> Callable[[str], Spent | None]:
    """What times one frame, by its name, in one process; it gives None for a frame without a vehicle."""
    worker = Worker.of(settings)
    unfitted = open_source(replace(settings, fit=False)) if settings.fit else None

    def spent(name: str) -> Spent | None:
        start, begun = time.perf_counter(), time.process_time()
        try:
            scene = worker.source.scene(name)
            derender = time.perf_counter() - start
            attacked = worker.search(name, scene)
        except NoVehicleError:
            return None
        with tempfile.TemporaryDirectory(prefix="drivesem-night-") as folder:
            start = time.perf_counter()
            write_frame(attacked, Path(folder) / "frame")
            write = time.perf_counter() - start
        processor = time.process_time() - begun if torch.get_num_threads() == 1 else None
        certify, quick = attacked.grading_seconds, None
        if unfitted is not None:
            start = time.perf_counter()
            unfitted.scene(name)
            quick = time.perf_counter() - start
        return Spent(derender, attacked.seconds - certify, certify, write, quick, processor)

    return spent


def part_rows(spent: Sequence[Spent]) -> list[dict[str, Any]]:
    """A row for each part."""
    whole = sum(one.total for one in spent)
    rows = []
    for part in PARTS:
        seconds = np.array([getattr(one, part) for one in spent])
        low, high = np.quantile(seconds, [0.5, 0.9]).tolist()
        row = {"part": part, "mean_s": float(seconds.mean()), "median_s": low, "p90_s": high}
        rows.append(row | {"share": float(seconds.sum()) / whole})
    return rows


def night_rows(spent: Sequence[Spent], frames: int, processes: int, seed: int) -> list[dict[str, Any]]:
    """How long so many frames take as asked, and what would make it shorter, the shortest last."""
    row = partial(_night, frames=frames, seed=seed)
    asked = row("as asked", "measured", [one.total for one in spent], processes)
    others = []
    fits = [one.unfitted for one in spent if one.unfitted is not None]
    if len(fits) == len(spent):
        quick = [one.total - one.derender + fit for one, fit in zip(spent, fits, strict=True)]
        others.append(row("--no-fit", "measured", quick, processes))
    alone = [one.processor for one in spent if one.processor is not None]
    if len(alone) == len(spent):
        others.append(row("no other work on the machine", "reckoned", alone, processes))
    others.append(row("half the --steps", "reckoned", [one.total - one.search / 2 for one in spent], processes))
    without = [one.total - one.derender for one in spent]
    others.append(row("frames taken apart before, in --cache", "reckoned", without, processes))
    if any(one.certify for one in spent):
        ungraded = [one.total - one.certify for one in spent]
        others.append(row("no grades, --no-grade", "reckoned", ungraded, processes))
    cores = os.cpu_count() or 1
    if cores > processes:
        others.append(row("--workers", "reckoned", [one.total for one in spent], cores))
    return [asked, *sorted(others, key=lambda one: -one["hours"])]


def _night(how: str, by: str, seconds: Sequence[float], processes: int, frames: int, seed: int) -> dict[str, Any]:
    figure = rate(how, np.array(seconds), np.ones(len(seconds)))
    (mean,) = intervals([figure], len(seconds), DRAWS, np.random.default_rng(seed))
    hours = [None if v is None else v * frames / processes / 3600 for v in (mean.value, mean.low, mean.high)]
    return {
        "how": how,
        "by": by,
        "frames": frames,
        "processes": processes,
        "hours": hours[0],
        "low": hours[1],
        "high": hours[2],
    }


def check_some(spent: Sequence[Spent]) -> None:
    """Raises UsageError where no frame had a vehicle."""
    if not spent:
        raise UsageError("--root", "frames with vehicles", "none")
