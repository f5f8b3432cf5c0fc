"""Detectors by name, asked about all pictures of runs: a row for each run and detector."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from detectors.base import DetectorError, Predictor
from detectors.registry import SHIPPED
from drivesem.attack.judging import DEFAULT_T_STAR, JudgedClasses, t_star_of
from drivesem.evaluation.resampling import DRAWS
from drivesem.questions.transfer.matrix import Row, Target, row
from drivesem.run.finished import PICTURES, Frame, Run
from drivesem.run.looking import Memory, Order, look
from drivesem.settings.blocks import Asking
from drivesem.settings.errors import UsageError
from scene_ir.errors import SceneError

DETECTIONS = "detections"
"""Folder of what detectors found."""


@dataclass(frozen=True, slots=True)
class Asked:
    """A detector that is asked. name: for people; t_star: score from which its detections count, by default its
    own, or that of the settings where it has none.
    """

    name: str
    order: Order
    predictor: Predictor
    t_star: float | None = None


def words(text: str) -> list[str]:
    """The parts of "a, b", without what is empty."""
    return [part.strip() for part in text.split(",") if part.strip()]


def detector_names(text: str, setting: str = "--detectors") -> list[str]:
    """The detectors of "a,b,darknet:c.cfg,c.weights". Behind KIND:FILE, a part without a colon that is no detector
    by itself goes with it.

    Raises UsageError, naming the setting, where none or one twice is named.
    """
    names: list[str] = []
    for part in words(text):
        alone = ":" in part or part in SHIPPED or part.endswith(".safetensors")
        if names and ":" in names[-1] and not alone:
            names[-1] += f",{part}"
        else:
            names.append(part)
    if not names:
        raise UsageError(setting, "detectors with commas", repr(text))
    for name in names:
        if names.count(name) > 1:
            raise UsageError(setting, "each detector once", name)
    return names


def short_names(names: Sequence[str]) -> list[str]:
    """Detectors without the folders of their files, as long as that tells them apart."""
    short = [re.sub(r"[^,:]*/", "", name) for name in names]
    return short if len(set(short)) == len(short) else list(names)


def detectors_of(specs: Sequence[str], config: Asking, out: Path, t_star: float | None = None) -> list[Asked]:
    """All of them loaded, before the first picture: a name that is misspelt shall not show after hours.

    out: in its folder DETECTIONS is remembered what they find; t_star: of all of them. Raises UsageError for what
    is no detector.
    """
    asked = []
    for name, spec in zip(short_names(specs), specs, strict=True):
        order = Order(spec, config.device, config.tiles, out / DETECTIONS)
        try:
            predictor = order.load()
            JudgedClasses.of(predictor)
        except DetectorError as error:
            raise UsageError("--detectors", "detectors", error) from error
        asked.append(Asked(name, order, predictor, t_star))
    return asked


def rows_of(
    runs: Sequence[Run], detectors: Sequence[Asked], config: Asking, console: Console
) -> tuple[list[Row], dict[str, str]]:
    """Each run before each detector, and the pictures that could not be used, with reasons.

    Raises UsageError where no frame of a run is left, SceneError for a bad picture unless `keep_going`.
    """
    failed: dict[str, str] = {}
    for one in detectors:
        _look_at_all(one, runs, config, failed, console)
    draws = DRAWS if config.bootstrap is None else config.bootstrap
    rows: list[Row] = []
    for run in runs:
        frames = [f for f in run.frames if not any(str(p) in failed for p in f.pictures.values())]
        if not frames:
            raise UsageError("--run", "a run with frames that can be read", run.folder)
        rows += [_row(run, one, frames, config, draws) for one in detectors]
    return rows, failed


def _look_at_all(
    asked: Asked, runs: Sequence[Run], config: Asking, failed: dict[str, str], console: Console
) -> None:
    """All pictures of all runs before one detector; a bad one goes to `failed` or ends the command."""
    pictures = [path for one in runs for frame in one.frames for path in frame.pictures.values()]
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(asked.name, total=len(pictures))
        left = len(pictures)
        for path, outcome in look(asked.order, asked.predictor, pictures, config):
            try:
                outcome()
            except SceneError as error:
                if not config.keep_going:
                    raise
                failed[str(path)] = str(error)
            left -= 1
            progress.advance(task)
        progress.advance(task, left)


def _row(run: Run, asked: Asked, frames: Sequence[Frame], config: Asking, draws: int) -> Row:
    memory, predictor = Memory(asked.order, asked.predictor), asked.predictor
    otherwise = DEFAULT_T_STAR if config.t_star is None else config.t_star
    t_star = t_star_of(predictor, asked.t_star, otherwise)
    target = Target(asked.name, asked.order.detector, JudgedClasses.of(predictor), t_star)
    found = {name: [memory.recall(frame.pictures[name]) for frame in frames] for name in PICTURES}
    with torch.no_grad():
        return row(run, target, [frame.result for frame in frames], found, draws, config.seed)
