"""`drivesem confirm`: counterexamples of a run on generated frames, drawn again by the generator."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from drivesem.attack.judging import JudgedClasses
from drivesem.questions.confirm.frame import Asked, confirm_frame, fingerprint
from drivesem.questions.confirm.plans import open_plans
from drivesem.questions.confirm.report import Report, print_report, summarise, write_report
from drivesem.questions.confirm.results import Confirmed, load
from drivesem.run.finished import METRICS, Frame, Run, load_runs
from drivesem.run.folder import PRESENTATION, attack_of, claim, detector_of
from drivesem.run.frame import RESULT
from drivesem.run.workers import outcomes
from drivesem.settings.commands import Confirm
from drivesem.settings.devices import check_device
from drivesem.settings.errors import UsageError
from scene_ir import files
from scene_ir.errors import SceneError

_FRAMES = "frames"
_WRITTEN = ("confirm.json", "confirm.md", "confirm.csv")


def run(config: Confirm) -> int:
    """Draw, ask, report; exit code 0. Raises UsageError or SceneError for bad input."""
    check_device(config.device)
    console = Console(stderr=True)
    report, data, out = confirm_run(config, console)
    if config.json:
        sys.stdout.write(json.dumps(data, allow_nan=False) + "\n")
    print_report(report, console if config.json else Console())
    for name, reason in data["frames_failed"].items():
        console.print(f"frame {name} could not be used: {reason}", soft_wrap=True)
    console.print(f"written to {out}", soft_wrap=True)
    return 0


def confirm_run(config: Confirm, console: Console) -> tuple[Report, dict[str, Any], Path]:
    """Confirm a run's frames, or go on with it. Returns the figures, what `--json` prints, and the folder in which
    all is. Raises UsageError or SceneError for bad input.
    """
    (one,) = load_runs([config.run or ""], config.limit)
    out = Path(config.out) if config.out else one.folder / "confirm"
    worker = _Worker(config, one)
    # Frames are kept by the result they belong to, so that another name of the run's folder is not in the way.
    claim(out, config, _clear, (*PRESENTATION, "run", "root", "seed"))
    failed: dict[str, str] = {}
    todo = [frame for frame in one.frames if not _is_done(one, frame, out)]
    _confirm_all(worker, todo, out, failed, console)
    done = [frame.result for frame in one.frames if frame.result.identifier not in failed]
    if not done:
        raise UsageError("--run", "a run with frames that can be used", one.folder)
    found = [load(out / _FRAMES / result.identifier / RESULT) for result in done]
    report = summarise(found, done, JudgedClasses.of(worker.detector).names, worker.asked.t_star)
    data = {
        "run": str(one.folder),
        "detector": one.detector,
        "params": one.params,
        "t_star": worker.asked.t_star,
        **report.to_json(),
        "frames_failed": failed,
    }
    files.write_json(out / "confirm.json", data)
    write_report(out, report, found)
    return report, data, out


class _Worker:
    """What one process needs: built once, used for many frames."""

    def __init__(self, config: Confirm, one: Run) -> None:
        attack = attack_of(one.folder)
        self.config, self.one = config, one
        self.plans = open_plans(attack, config.root)
        self.detector = detector_of(attack, config.device)
        self.asked = Asked(config.device, float(files.read_json(one.folder / METRICS)["t_star"]))

    def confirm(self, frame: Frame, out: Path) -> Confirmed:
        """One frame of the run, into its folder."""
        name = frame.result.identifier
        source = self.one.folder / _FRAMES / name
        return confirm_frame(frame, source, self.plans, self.detector, self.asked, out / _FRAMES / name)


def _in_process(config: Confirm, one: Run, out: Path) -> Callable[[Frame], Confirmed]:
    return partial(_Worker(config, one).confirm, out=out)


def _is_done(one: Run, frame: Frame, out: Path) -> bool:
    """Whether the frame was confirmed as the run now has it."""
    path = out / _FRAMES / frame.result.identifier / RESULT
    return path.is_file() and load(path).source == fingerprint(one.folder / _FRAMES / frame.result.identifier)


def _confirm_all(
    worker: _Worker, todo: Sequence[Frame], out: Path, failed: dict[str, str], console: Console
) -> None:
    """Confirm the frames of `todo`; a bad one goes to `failed` or ends the command."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not todo) as progress:
        task = progress.add_task("drawing frames again", total=len(todo))
        build = partial(_in_process, worker.config, worker.one, out)
        for frame, outcome in outcomes(partial(worker.confirm, out=out), build, todo, worker.config):
            try:
                outcome()
            except SceneError as error:
                if not worker.config.keep_going:
                    raise
                failed[frame.result.identifier] = str(error)
            progress.advance(task)


def _clear(out: Path) -> None:
    """Remove what an earlier call wrote, and nothing else."""
    for name in _WRITTEN:
        (out / name).unlink(missing_ok=True)
    if (out / _FRAMES).is_dir():
        shutil.rmtree(out / _FRAMES)
