"""`drivesem explain`: why the counterexamples of a finished run fail, and how little is enough."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from drivesem.attack.space import Parameter, parse_params
from drivesem.evaluation.resampling import DRAWS
from drivesem.questions.explain.frame import Effort, digest, explain_frame
from drivesem.questions.explain.report import means, print_tables, write_report
from drivesem.questions.explain.results import EXPLANATION, Explanation, read_explanation
from drivesem.run.finished import Run, load_runs
from drivesem.run.folder import PRESENTATION, attack_of, claim, detector_of
from drivesem.run.workers import outcomes
from drivesem.settings.commands import Attack, Explain
from drivesem.settings.devices import check_device
from drivesem.settings.errors import UsageError
from scene_ir import files
from scene_ir.errors import SceneError

_FRAMES = "frames"
_WRITTEN = ("explain.json", "explain.md", "explain.csv", "explain.png")
_FREE = (*PRESENTATION, "run", "frame", "bootstrap")
"""Settings that a second call may change: none is in a frame's explanation."""


def run(config: Explain) -> int:
    """Explain, report; exit code 0. Raises UsageError or SceneError for bad input."""
    check_device(config.device)
    (one,) = load_runs([config.run or ""])
    names = _chosen(one, config)
    worker = _Worker(config, attack_of(one.folder), parse_params(one.params))
    out = Path(config.out) if config.out else one.folder / "explain"
    claim(out, config, _clear, _FREE)
    console = Console(stderr=True)
    failed: dict[str, str] = {}
    _explain_all(worker, [name for name in names if not _is_done(one, name, out)], out, failed, console)
    explained = [read_explanation(out / _FRAMES / name / EXPLANATION) for name in names if name not in failed]
    if not explained:
        raise UsageError("--run", "a run with frames that can be explained", "; ".join(failed.values()))
    draws = DRAWS if config.bootstrap is None else config.bootstrap
    rows = means(explained, draws, config.seed)
    data = {
        "out": str(out),
        "run": str(one.folder),
        "detector": one.detector,
        "params": one.params,
        "frames": len(explained),
        "frames_of_run": len(one.frames),
        "frames_failed": failed,
        "bootstrap": draws,
        "rows": [row.to_json() for row in rows],
        "explained": [_brief(e) for e in explained],
    }
    files.write_json(out / "explain.json", data)
    write_report(out, explained, rows, draws)
    if config.json:
        sys.stdout.write(json.dumps(data, allow_nan=False) + "\n")
    told = console if config.json else Console()
    print_tables(explained, rows, draws, told)
    for name, reason in failed.items():
        told.print(f"frame {name} could not be explained: {reason}", soft_wrap=True)
    told.print(f"written to {out}", soft_wrap=True)
    return 0


@dataclass
class _Worker:
    """What one process needs: built once, used for many frames."""

    config: Explain
    attack: Attack
    params: tuple[Parameter, ...]

    def __post_init__(self) -> None:
        self.detector = detector_of(self.attack, self.config.device)

    def explain(self, name: str, out: Path) -> None:
        """One frame, from the run's folder to its own."""
        config = self.config
        folder = Path(config.run or "") / _FRAMES / name
        effort = Effort(config.points, config.permutations, config.seed, lost=config.least == "lost")
        explain_frame(folder, self.attack, self.params, self.detector, effort, out / _FRAMES / name)


def _in_process(
    config: Explain, attack: Attack, params: tuple[Parameter, ...], out: Path
) -> Callable[[str], None]:
    return partial(_Worker(config, attack, params).explain, out=out)


def _chosen(one: Run, config: Explain) -> list[str]:
    """The frames to explain: those that fail by moved labels. Raises UsageError where there is none."""
    fails = {frame.result.identifier: frame.result.success_moved for frame in one.frames}
    asked = [part.strip() for part in (config.frame or "").split(",") if part.strip()]
    for name in asked:
        if name not in fails:
            raise UsageError("--frame", f"a frame of {one.folder}", name)
        if not fails[name]:
            raise UsageError("--frame", "frames that fail, by moved labels", f"{name}, which does not")
    names = [name for name in fails if fails[name] and (not asked or name in asked)]
    if not names:
        raise UsageError("--run", "a run with counterexamples, by moved labels", f"none in {len(fails)} frames")
    return names[: config.limit]


def _is_done(one: Run, name: str, out: Path) -> bool:
    """Whether a frame was explained, and its counterexample is still the same."""
    path = out / _FRAMES / name / EXPLANATION
    return path.is_file() and read_explanation(path).source == digest(one.folder / _FRAMES / name)


def _explain_all(
    worker: _Worker, todo: Sequence[str], out: Path, failed: dict[str, str], console: Console
) -> None:
    """Explain the frames of `todo`, in this process or in several; a bad one goes to `failed` or ends it all."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, disable=not todo) as progress:
        task = progress.add_task("explaining frames", total=len(todo))
        build = partial(_in_process, worker.config, worker.attack, worker.params, out)
        for name, outcome in outcomes(partial(worker.explain, out=out), build, todo, worker.config):
            try:
                outcome()
            except SceneError as error:
                if not worker.config.keep_going:
                    raise
                failed[name] = str(error)
            progress.advance(task)


def _brief(explanation: Explanation) -> dict[str, Any]:
    """A frame in the summary; the rest is in its own folder."""
    least = explanation.least
    return {
        "frame": explanation.identifier,
        "loss_benign": explanation.benign.loss,
        "loss_found": explanation.found.loss,
        "sign_changes": least.sign_changes,
        "size_found": least.norm_found,
        "size_least": least.norm,
        "left": least.left,
        "parameters": list(least.parameters),
        "objects": list(least.objects),
        "feasible": not least.violations,
        "renders": explanation.renders,
    }


def _clear(out: Path) -> None:
    """Remove what an earlier call wrote, and nothing else."""
    for name in _WRITTEN:
        (out / name).unlink(missing_ok=True)
    if (out / _FRAMES).is_dir():
        shutil.rmtree(out / _FRAMES)
