"""Estimates the run time of an attack on many frames of this machine from a sample, and shows where the time goes."""

from __future__ import annotations

import os
import shlex
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drivesem.bench.session import Columns
from drivesem.config.commands import AttackConfig, BenchConfig
from drivesem.config.errors import UsageError
from drivesem.config.options import DEMO, PHOTOGRAPHS, SCENES, SceneOptions, format_command_line, shared_options
from drivesem.config.parsing import parse
from drivesem.evaluation.resampling import DRAWS, bootstrap_intervals, ratio_metric
from drivesem.run.attack import AttackWorker
from drivesem.run.folder import CONFIG, PRESENTATION
from drivesem.run.frame import write_frame
from drivesem.scenes.sources import NoVehicleError, open_source

FRAMES = 20
"""Default number of sampled frames."""
PARTS = ("derender", "search", "certify", "write")
PARTS_TITLE = "where the time of a frame goes"
PARTS_COLUMNS: Columns = {
    "part": ("part", "part"),
    "mean_s": ("s a frame", "s a frame"),
    "median_s": ("median", "median"),
    "p90_s": ("nine tenths within", "90 %"),
    "share": ("share", "share"),
    "frames_an_hour_without": ("frames an hour without it", "frames an hour without it"),
}
NIGHTS_TITLE = "how long all of it takes"
NIGHTS_COLUMNS: Columns = {
    "how": ("how", "how"),
    "by": ("by", "by"),
    "frames": ("frames", "frames"),
    "processes": ("processes", "processes"),
    "frames_an_hour": ("frames an hour", "frames an hour"),
    "time": ("time", "time"),
    "time_low": ("from", "from"),
    "time_high": ("to", "to"),
}
METHOD = (
    "Frames spread evenly over the data set, by their number of labelled vehicles, are attacked as drivesem attack "
    "would, in as many processes, and "
    "each part is timed: derender turns the photograph into a scene; search is the attack with what it "
    "prepares; certify grades its failures, with the second renderer and the other detector; write is the "
    "frame's folder and the independent check. Frames an hour without a part: the most that a faster part could "
    "give, so the largest pays most. Frames without labelled vehicles are skipped. Time: "
    "the mean of all parts for each frame, shared by the processes; intervals 95 %, by bootstrap over frames. "
    "Start-up, some seconds a process, is left out. Measured: the same frames with other settings; estimated: from "
    "the parts, or, for no other work, from the processor's seconds, where a process has one thread."
)


@dataclass(frozen=True, slots=True)
class FrameTime:
    """Seconds of one frame."""

    derender: float
    """De-rendering."""
    search: float
    """The attack with its preparation."""
    certify: float
    """Grading of failures."""
    write: float
    """Writing the frame's folder and the independent check."""
    unfitted: float | None
    """De-rendering with --no-fit; None if that is the setting anyway."""
    processor: float | None = None
    """Processor time of all parts; None if they used several threads."""

    @property
    def total(self) -> float:
        """Sum of all parts."""
        return self.derender + self.search + self.certify + self.write


def build_attack_config(config: BenchConfig) -> AttackConfig:
    """The settings of the attack to estimate.

    Raises:
        UsageError: The preset cannot be used.
    """
    preset = parse(["attack", *_attack_words(config.attack)])
    assert isinstance(preset, AttackConfig)
    # the attack's own frames, unless this command names others
    options = shared_options(config, SceneOptions)
    overrides = {name: value for name, value in options.items() if value != getattr(BenchConfig, name)}
    overrides |= {"workers": config.workers, "device": config.device, "limit": None}
    settings = replace(preset, **overrides, keep_going=config.keep_going, out=None)
    if config.detector != BenchConfig.detector:
        settings = replace(settings, detector=config.detector)
    settings.check()
    return settings


def _attack_words(attack: str | None) -> list[str]:
    """Options of `drivesem attack` from --attack: the options themselves, a run's folder, a preset or a YAML file."""
    if attack is None:
        return []
    if " " in attack.strip() and not Path(attack).exists():
        words = shlex.split(attack)
        return words[next((i for i, word in enumerate(words) if word.startswith("-")), len(words)) :]
    return ["--config", str(Path(attack) / CONFIG) if Path(attack).is_dir() else attack]


def format_attack(settings: AttackConfig) -> str:
    """The command line of an attack, without where it writes and how its work is shared."""
    return format_command_line("attack", settings, PRESENTATION)


def format_duration(seconds: float) -> str:
    """A duration in the unit that suits it: s, min, h or days."""
    limits = ((90.0, 1.0, "s"), (90 * 60.0, 60.0, "min"), (48 * 3600.0, 3600.0, "h"))
    unit, name = next(((unit, name) for limit, unit, name in limits if seconds < limit), (86400.0, "days"))
    value = seconds / unit
    return f"{value:.0f} {name}" if value >= 9.95 else f"{value:.1f} {name}"


def pick_evenly(names: Sequence[str], count: int, vehicles: Sequence[int] | None = None) -> list[str]:
    """The middle one of each of `count` equal parts of the names; all if there are fewer.

    Args:
        names: The names.
        count: Number of parts.
        vehicles: Number of vehicles of each; the parts are by that number, as a frame's time is.
    """
    order = range(len(names)) if vehicles is None else np.argsort(vehicles, kind="stable").tolist()
    picked = min(count, len(names))
    return [names[i] for i in sorted(order[(2 * k + 1) * len(names) // (2 * picked)] for k in range(picked))]


def count_labelled_vehicles(settings: AttackConfig, names: Sequence[str]) -> list[int] | None:
    """Number of labelled vehicles of each frame; None for scenes and photographs, which have no labels."""
    if settings.dataset in (DEMO, PHOTOGRAPHS, SCENES):
        return None
    from drivesem.data.classes import count_vehicles
    from drivesem.data.subsets import FrameFilter, open_selection

    choice = FrameFilter.from_options(settings)
    dataset = open_selection(settings.dataset, settings.root or "", choice, False, settings.focal)
    return [count_vehicles(dataset.labels(name)) for name in names]


def build_frame_timer(settings: AttackConfig) -> Callable[[str], FrameTime | None]:
    """A function that times one frame, given by name, in one process; it returns None for frames without vehicles."""
    worker = AttackWorker.from_config(settings)
    unfitted = open_source(replace(settings, fit=False)) if settings.fit else None

    def time_frame(name: str) -> FrameTime | None:
        start, begun = time.perf_counter(), time.process_time()
        try:
            scene = worker.source.scene(name)
            derender = time.perf_counter() - start
            attacked = worker.attack_scene(name, scene)
        except NoVehicleError:
            return None
        with tempfile.TemporaryDirectory(prefix="drivesem-night-") as folder:
            start = time.perf_counter()
            write_frame(attacked, Path(folder) / "frame")
            write = time.perf_counter() - start
        processor = time.process_time() - begun if torch.get_num_threads() == 1 else None
        certify, unfitted_seconds = attacked.grading_seconds, None
        if unfitted is not None:
            start = time.perf_counter()
            unfitted.scene(name)
            unfitted_seconds = time.perf_counter() - start
        return FrameTime(derender, attacked.seconds - certify, certify, write, unfitted_seconds, processor)

    return time_frame


def part_rows(frame_times: Sequence[FrameTime], processes: int) -> list[dict[str, Any]]:
    """One row per part of a frame."""
    total = sum(one.total for one in frame_times)
    rows = []
    for part in PARTS:
        seconds = np.array([getattr(one, part) for one in frame_times])
        low, high = np.quantile(seconds, [0.5, 0.9]).tolist()
        row = {"part": part, "mean_s": float(seconds.mean()), "median_s": low, "p90_s": high}
        without = 3600 * processes * len(frame_times) / (total - float(seconds.sum()))
        rows.append(row | {"share": float(seconds.sum()) / total, "frames_an_hour_without": round(without)})
    return rows


def night_rows(frame_times: Sequence[FrameTime], frames: int, processes: int, seed: int) -> list[dict[str, Any]]:
    """The estimated duration with the given settings, and alternatives, the shortest last.

    Args:
        spent: Sampled frames.
        frames: Number of frames to estimate.
        processes: Number of processes.
        seed: Seed of the bootstrap.
    """
    row = partial(_estimate_hours, frames=frames, seed=seed)
    current = row("as configured", "measured", [one.total for one in frame_times], processes)
    others = []
    fits = [one.unfitted for one in frame_times if one.unfitted is not None]
    if len(fits) == len(frame_times):
        unfitted_seconds = [one.total - one.derender + fit for one, fit in zip(frame_times, fits, strict=True)]
        others.append(row("--no-fit", "measured", unfitted_seconds, processes))
    alone = [one.processor for one in frame_times if one.processor is not None]
    if len(alone) == len(frame_times):
        others.append(row("no other work on the machine", "estimated", alone, processes))
    others.append(
        row("half the --steps", "estimated", [one.total - one.search / 2 for one in frame_times], processes)
    )
    without = [one.total - one.derender for one in frame_times]
    others.append(row("frames de-rendered before, in --cache", "estimated", without, processes))
    if any(one.certify for one in frame_times):
        ungraded = [one.total - one.certify for one in frame_times]
        others.append(row("no grades, --no-grade", "estimated", ungraded, processes))
    cores = os.cpu_count() or 1
    if cores > processes:
        others.append(row("--workers", "estimated", [one.total for one in frame_times], cores))
    return [current, *sorted(others, key=lambda one: -one["hours"])]


def _estimate_hours(
    how: str, by: str, seconds: Sequence[float], processes: int, frames: int, seed: int
) -> dict[str, Any]:
    figure = ratio_metric(how, np.array(seconds), np.ones(len(seconds)))
    (mean,) = bootstrap_intervals([figure], len(seconds), DRAWS, np.random.default_rng(seed))
    hours = [None if v is None else v * frames / processes / 3600 for v in (mean.value, mean.low, mean.high)]
    times = (None if value is None else format_duration(3600 * value) for value in hours)
    return {
        "how": how,
        "by": by,
        "frames": frames,
        "processes": processes,
        "frames_an_hour": round(3600 * processes * len(seconds) / sum(seconds)),
        **dict(zip(("hours", "low", "high"), hours, strict=True)),
        **dict(zip(("time", "time_low", "time_high"), times, strict=True)),
    }


def require_frames(frame_times: Sequence[FrameTime]) -> None:
    """Raises UsageError where no frame had a vehicle."""
    if not frame_times:
        raise UsageError("--root", "frames with vehicles", "none")
