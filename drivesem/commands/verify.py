"""`drivesem verify`: whether a finished run is what it says it is, computed again from its files."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from drivesem.attack.aims import Aim
from drivesem.attack.budgets import budget_of
from drivesem.attack.judging import t_star_of
from drivesem.attack.space import parse_params
from drivesem.questions.verify.differences import CHECKS, Difference, Tally
from drivesem.questions.verify.frame import BOX_PX, LABEL, LEVELS, SCORE, Checked, Given, check_frame
from drivesem.report.tables import Sheet
from drivesem.run.finished import MANIFEST, METRICS, Run, load_runs
from drivesem.run.folder import attack_of, detector_of
from drivesem.run.results import FrameResult
from drivesem.run.workers import outcomes
from drivesem.settings.commands import Verify
from drivesem.settings.devices import check_device
from drivesem.settings.errors import UsageError
from scene_ir import files
from scene_ir.errors import FormatError, SceneError

_FRAMES = "frames"
_WHOLE_RUN = "(run)"
"""Stands for a frame's name where a difference is the run's."""
_MOST_SHOWN = 30
"""Differences that are told on a terminal; verify.json has them all."""


def run(config: Verify) -> int:
    """Check, report; exit code 0, or 1 where something differs or a frame could not be read. Raises UsageError or
    SceneError for bad input.
    """
    check_device(config.device)
    (one,) = load_runs([config.run or ""])
    worker = _Worker(config, one)
    out = Path(config.out) if config.out else one.folder / "verify.json"
    if out.is_dir():
        raise UsageError("--out", "a file", f"the folder {out}")
    console = Console(stderr=True)
    names = [frame.result.identifier for frame in one.frames][: config.limit]
    checked, failed = _check_all(worker, names, console)
    totals = _totals(one, worker.given.t_star)
    data = _data(one, checked, totals, failed)
    files.write_json(out, data)
    if config.json:
        sys.stdout.write(json.dumps(data, allow_nan=False) + "\n")
    _print(data, console if config.json else Console())
    console.print(f"written to {out}", soft_wrap=True)
    return 0 if data["agree"] else 1


class _Worker:
    """What one process needs: built once, used for many frames."""

    def __init__(self, config: Verify, one: Run) -> None:
        attack = attack_of(one.folder)
        detector = detector_of(attack, config.device)
        self.config, self.one = config, one
        self.given = Given(
            detector=detector,
            device=config.device,
            backend=attack.backend,
            params=parse_params(one.params),
            budget=budget_of(attack.budget),
            aim=Aim.of(attack.target_objects, attack.target_classes),
            t_star=t_star_of(detector, attack.t_star),
            hashes=_hashes(one),
        )

    def check(self, name: str) -> Checked:
        """One frame of the run."""
        return check_frame(name, self.one.folder / _FRAMES / name, self.given)


def _hashes(one: Run) -> Mapping[str, Mapping[str, str]]:
    frames = files.read_json(one.folder / MANIFEST)["frames"]
    if not isinstance(frames, dict) or not all(isinstance(part, dict) for part in frames.values()):
        raise FormatError(f"{one.folder / MANIFEST}: frames", "hashes by frame and file", "something else")
    return frames


def _in_process(config: Verify, one: Run) -> Callable[[str], Checked]:
    return _Worker(config, one).check


def _check_all(worker: _Worker, names: Sequence[str], console: Console) -> tuple[list[Checked], dict[str, str]]:
    """The frames that could be read, in their order, and why others could not."""
    checked: dict[str, Checked] = {}
    failed: dict[str, str] = {}
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("checking frames", total=len(names))
        build = partial(_in_process, worker.config, worker.one)
        for name, outcome in outcomes(worker.check, build, names, worker.config):
            try:
                checked[name] = outcome()
            except SceneError as error:
                if not worker.config.keep_going:
                    raise
                failed[name] = str(error)
            progress.advance(task)
    return [checked[name] for name in names if name in checked], failed


def _totals(one: Run, t_star: float) -> Tally:
    """metrics.json against what all frames of the run hold."""
    results = [frame.result for frame in one.frames]
    tally, metrics = Tally(), files.read_json(one.folder / METRICS)
    for name, found in {**_added_up(results), "t_star": t_star}.items():
        tally.same("totals", f"{METRICS}: {name}", metrics.get(name), found)
    return tally


def _added_up(results: Sequence[FrameResult]) -> dict[str, Any]:
    failures = [failure.kind for result in results for failure in result.failures]
    return {
        "frames": len(results),
        "objects": sum(result.objects for result in results),
        "lost_objects": failures.count("lost"),
        "phantoms": failures.count("phantom"),
        "successes_paper": sum(result.success_paper for result in results),
        "successes_moved": sum(result.success_moved for result in results),
        "feasible_fraction": sum(result.feasible for result in results) / len(results),
        "queries": sum(result.queries for result in results),
    }


def _data(one: Run, checked: Sequence[Checked], totals: Tally, failed: dict[str, str]) -> dict[str, Any]:
    """JSON's form."""
    differences: list[tuple[str, Difference]] = [(c.identifier, d) for c in checked for d in c.differences]
    differences += [(_WHOLE_RUN, d) for d in totals.differences]
    rows = []
    for check, holds in CHECKS.items():
        ours = [(name, d) for name, d in differences if d.check == check]
        compared = sum(c.compared.get(check, 0) for c in checked) + totals.compared.get(check, 0)
        rows.append(
            {
                "name": check,
                "holds": holds,
                "compared": compared,
                "differing": len(ours),
                "frames_differing": list(dict.fromkeys(name for name, _ in ours)),
            }
        )
    pictures = {name for c in checked for name in c.levels}
    return {
        "run": str(one.folder),
        "detector": one.detector,
        "params": one.params,
        "frames": len(checked),
        "frames_of_run": len(one.frames),
        "agree": not differences and not failed,
        "checks": rows,
        "rendered_again": {
            name: {
                "largest_level": max(c.levels[name].largest for c in checked),
                "largest_share": max(c.levels[name].share for c in checked),
            }
            for name in sorted(pictures)
        },
        "tolerances": {"levels": LEVELS, "box_px": BOX_PX, "score": SCORE, "label": LABEL},
        "differences": [{"frame": name, **asdict(d)} for name, d in differences],
        "frames_failed": failed,
    }


def _print(data: dict[str, Any], console: Console) -> None:
    rows = tuple(
        (row["name"], row["holds"], str(row["compared"]), str(row["differing"]), str(len(row["frames_differing"])))
        for row in data["checks"]
    )
    columns = ("check", "what holds where nothing differs", "compared", "differ", "in frames")
    console.print(Sheet(f"{data['frames']} frames of {data['run']}", columns, rows).table(columns[:2]))
    for one in data["differences"][:_MOST_SHOWN]:
        line = f"{one['frame']}: {one['check']}: {one['field']}: expected {one['expected']}, found {one['found']}"
        console.print(line, soft_wrap=True, markup=False, highlight=False)
    left = len(data["differences"]) - _MOST_SHOWN
    if left > 0:
        console.print(f"and {left} more")
    for name, reason in data["frames_failed"].items():
        console.print(f"frame {name} could not be checked: {reason}", soft_wrap=True, markup=False)
    console.print("all agree" if data["agree"] else "the run is not what it says it is")
