"""`drivesem study`: the paper's experiments on frames of one's own, its figures beside ours."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

from rich.console import Console

from drivesem.config import Study, command_line
from drivesem.devices import check_device
from drivesem.evaluation.resampling import DRAWS
from drivesem.run_folder import PRESENTATION, claim
from drivesem.study.arms import arms_of
from drivesem.study.labels import label_sets
from drivesem.study.plots import write_plot
from drivesem.study.report import Findings, print_findings, write_tables
from drivesem.study.rows import rows_of
from drivesem.study.running import ARMS, Ran, run_arms, workers_of
from drivesem.study.success import against, curve_of
from scene_ir import files

_PICTURE, _FIGURES = "study.png", "study.json"
_TABLES = ("study.md", "study.csv", "curves.csv", "label_sets.csv")
_FREE = (*PRESENTATION, "quick", "controls", "bootstrap")
"""Settings that may change on the way: they add frames, arms or draws, and alter none."""
_NOT_TOLD = ("out", "json", "resume", "workers", "name")


def run(config: Study) -> int:
    """Run or continue a study; exit code 0. Raises UsageError or SceneError for bad input."""
    check_device(config.device)
    out = Path(config.out or f"runs/study-{config.name}-{config.dataset}-seed{config.seed}")
    arms = arms_of(config, out)
    workers = workers_of(arms)
    claim(out, config, _clear, _FREE)
    console = Console(stderr=True)
    found = _findings(config, run_arms(arms, workers, out, console))
    data = found.to_json()
    files.write_json(out / _FIGURES, data)
    command = command_line("study", config, _NOT_TOLD).replace("study", f"study {config.name}", 1)
    write_tables(out, found, _PICTURE, command)
    write_plot(out / _PICTURE, found)
    if config.json:
        sys.stdout.write(json.dumps(data, allow_nan=False) + "\n")
    print_findings(found, console if config.json else Console())
    console.print(f"written to {out}", soft_wrap=True)
    return 0


def _findings(config: Study, ran: Ran) -> Findings:
    draws = DRAWS if config.bootstrap is None else config.bootstrap
    rows = rows_of(ran.runs, draws, config.seed)
    if config.name == "labels":
        return Findings(config, draws, ran, rows, label_sets=[label_sets(one) for one in ran.runs])
    if config.name not in ("samples", "steps"):
        return Findings(config, draws, ran, rows)
    curves = [curve_of(one, draws, config.seed) for one in ran.runs]
    if config.name == "steps":
        return Findings(config, draws, ran, rows, curves)
    first = ran.runs[0]
    beside = {one.arm.name: against(first, config.steps, one, draws, config.seed) for one in ran.runs}
    return Findings(config, draws, ran, rows, curves, beside, config.steps)


def _clear(out: Path) -> None:
    """Remove what an earlier run wrote, and nothing else."""
    for name in (_PICTURE, _FIGURES, *_TABLES):
        (out / name).unlink(missing_ok=True)
    if (out / ARMS).is_dir():
        shutil.rmtree(out / ARMS)
