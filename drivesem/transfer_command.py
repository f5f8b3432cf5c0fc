"""`drivesem transfer`: counterexamples of finished runs before other detectors."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from detectors.base import DetectorError, Predictor
from detectors.registry import SHIPPED
from drivesem.config import Transfer, UsageError
from drivesem.evaluation.resampling import DRAWS
from drivesem.judged import DEFAULT_T_STAR, HEADLINE, JudgedClasses, t_star_of
from drivesem.run_folder import claim
from drivesem.transfer.looking import Memory, Order, look
from drivesem.transfer.matrix import Row, Target, row
from drivesem.transfer.report import print_rows, write_report
from drivesem.transfer.runs import PICTURES, Frame, Run, load_runs
from scene_ir import files
from scene_ir.errors import SceneError

_DETECTIONS = "detections"
_WRITTEN = ("transfer.json", "transfer.md", "transfer.csv", "transfer.png")


def run(config: Transfer) -> int:
    """Look, count, report; exit code 0. Raises UsageError or SceneError for bad input."""
    runs = load_runs(_words(config.run or ""), config.limit)
    specs = detector_names(config.detectors or "")
    out = Path(config.out) if config.out else runs[0].folder / "transfer"
    orders = [Order(spec, config.device, config.tiles, out / _DETECTIONS) for spec in specs]
    # All of them before the first picture: a name that is misspelt shall not show after hours.
    predictors = [_load(order) for order in orders]
    # Detections are kept by content, so that no setting of an earlier call is in the way.
    claim(out, config, _clear, presentation=[field.name for field in fields(config)])
    console = Console(stderr=True)
    failed: dict[str, str] = {}
    for order, predictor in zip(orders, predictors, strict=True):
        _look_at_all(order, predictor, runs, config, failed, console)
    draws = DRAWS if config.bootstrap is None else config.bootstrap
    rows: list[Row] = []
    for one in runs:
        frames = [f for f in one.frames if not any(str(p) in failed for p in f.pictures.values())]
        if not frames:
            raise UsageError("--run", "a run with frames that can be read", one.folder)
        for name, order, predictor in zip(short_names(specs), orders, predictors, strict=True):
            rows.append(_row(one, name, order, predictor, frames, config, draws))
    data = {"rows": [r.to_json() for r in rows], "headline": HEADLINE, "bootstrap": draws, "frames_failed": failed}
    files.write_json(out / "transfer.json", data)
    write_report(out, rows, draws)
    if config.json:
        sys.stdout.write(json.dumps(data, allow_nan=False) + "\n")
    print_rows(rows, draws, console if config.json else Console())
    for path, reason in failed.items():
        console.print(f"{path} could not be used: {reason}", soft_wrap=True)
    console.print(f"written to {out}", soft_wrap=True)
    return 0


def detector_names(text: str) -> list[str]:
    """The detectors of "a,b,darknet:c.cfg,c.weights". Behind KIND:FILE, a part without a colon that is no detector
    by itself goes with it.

    Raises UsageError where none or one twice is named.
    """
    names: list[str] = []
    for part in _words(text):
        alone = ":" in part or part in SHIPPED or part.endswith(".safetensors")
        if names and ":" in names[-1] and not alone:
            names[-1] += f",{part}"
        else:
            names.append(part)
    if not names:
        raise UsageError("--detectors", "detectors with commas", repr(text))
    for name in names:
        if names.count(name) > 1:
            raise UsageError("--detectors", "each detector once", name)
    return names


def short_names(names: Sequence[str]) -> list[str]:
    """Detectors without the folders of their files, as long as that tells them apart."""
    short = [re.sub(r"[^,:]*/", "", name) for name in names]
    return short if len(set(short)) == len(short) else list(names)


def _words(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


def _load(order: Order) -> Predictor:
    try:
        predictor = order.load()
        JudgedClasses.of(predictor)
    except DetectorError as error:
        raise UsageError("--detectors", "detectors", error) from error
    return predictor


def _look_at_all(
    order: Order,
    predictor: Predictor,
    runs: Sequence[Run],
    config: Transfer,
    failed: dict[str, str],
    console: Console,
) -> None:
    """All pictures of all runs before one detector; a bad one goes to `failed` or ends the command."""
    pictures = [path for one in runs for frame in one.frames for path in frame.pictures.values()]
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(order.detector, total=len(pictures))
        left = len(pictures)
        for path, outcome in look(order, predictor, pictures, config):
            try:
                outcome()
            except SceneError as error:
                if not config.keep_going:
                    raise
                failed[str(path)] = str(error)
            left -= 1
            progress.advance(task)
        progress.advance(task, left)


def _row(
    one: Run,
    name: str,
    order: Order,
    predictor: Predictor,
    frames: Sequence[Frame],
    config: Transfer,
    draws: int,
) -> Row:
    memory = Memory(order, predictor)
    otherwise = DEFAULT_T_STAR if config.t_star is None else config.t_star
    target = Target(name, order.detector, JudgedClasses.of(predictor), t_star_of(predictor, otherwise=otherwise))
    found = {name: [memory.recall(frame.pictures[name]) for frame in frames] for name in PICTURES}
    with torch.no_grad():
        return row(one, target, [frame.result for frame in frames], found, draws, config.seed)


def _clear(out: Path) -> None:
    """Remove what an earlier call wrote, and nothing else."""
    for name in _WRITTEN:
        (out / name).unlink(missing_ok=True)
    if (out / _DETECTIONS).is_dir():
        shutil.rmtree(out / _DETECTIONS)
