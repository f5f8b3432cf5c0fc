"""`drivesem runs`: list, show, merge and prune runs."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

from drivesem.commands.attack import summarise_grades
from drivesem.config.commands import DEFAULT_COMBO, AttackConfig, RunsConfig
from drivesem.config.errors import UsageError
from drivesem.failures.grades import Grade
from drivesem.reporting.tables import Console, format_count, print_json
from drivesem.run.attack import merge_runs
from drivesem.run.finished import METRICS
from drivesem.run.folder import CONFIG, FRAMES, PLAN, is_attack_run, load_attack_config, result_settings
from drivesem.run.labels import list_frames
from drivesem.run.lock import acquire_folder_lock, is_locked_elsewhere
from drivesem.run.records import from_json
from drivesem.store import local_copy
from scene_ir import files

_ARGUMENT = "FOLDER"
"""The argument that names a run."""
_DEFAULT_FOLDER = "runs"
"""Folder of the runs of `drivesem attack` without --out."""


def runs_command(config: RunsConfig) -> int:
    """`drivesem runs`: list, show, merge or prune."""
    actions = {"list": _list, "show": _show, "merge": _merge, "prune": _prune}
    data = actions[config.what](config, Console(quiet=config.json))
    if config.json:
        print_json(data)
    return 0


_find_folder = partial(local_copy, setting=_ARGUMENT)


def _list(config: RunsConfig, console: Console) -> dict[str, Any]:
    folders = [run for folder in config.folders or (_DEFAULT_FOLDER,) for run in _runs_in(_find_folder(folder))]
    rows = [_describe_run(folder) for folder in folders]
    for row in rows:
        console.print(_format_run(row), soft_wrap=True, markup=False)
    console.print(f"{len(rows)} in total", soft_wrap=True)
    return {"runs": rows}


def _format_run(row: Mapping[str, Any]) -> str:
    """A run in one line."""
    grades, frames = row["grades"], format_count(row["frames"], "frame")
    attack = f"{row['params']} by {row['method']} on {row['detector']}, {row['mb']:.0f} MB"
    if grades is None:
        frames = frames if row["frames_planned"] is None else f"{row['frames']} of {row['frames_planned']} frames"
        state = f"running, {frames}" if row["running"] else f"interrupted, {frames} (the same command resumes)"
        return f"{row['run']}: {state}; {attack}"
    sure = [f"{grades[grade]} {grade}" for grade in (Grade.CERTAIN, Grade.CONFIRMED) if grade in grades]
    failures = f"{', '.join(sure)} of {format_count(grades.get(Grade.THRESHOLD, 0), 'failure')} by threshold"
    return f"{row['run']}: {frames}, {failures}; {attack}"


def _runs_in(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise UsageError(_ARGUMENT, "a folder with runs of drivesem attack", folder)
    if (folder / CONFIG).is_file():
        return [folder]
    runs = (path.parent for path in folder.glob(f"*/{CONFIG}"))
    return sorted(
        run for run in runs if any((run / name).exists() for name in (FRAMES, PLAN)) and is_attack_run(run)
    )


def _describe_run(folder: Path) -> dict[str, Any]:
    attack, metrics = load_attack_config(folder, _ARGUMENT), _read_metrics(folder)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return {
        "run": str(folder),
        "finished": bool(metrics),
        "running": not metrics and is_locked_elsewhere(folder),
        "detector": attack.detector,
        "dataset": attack.dataset,
        "params": ",".join(metrics.get("params", ())) or attack.params or f"combo {attack.combo or DEFAULT_COMBO}",
        "method": attack.method,
        "frames": len(list_frames(folder)),
        "frames_planned": _read_planned(folder),
        "grades": metrics.get("grades"),
        "mb": round(size / 1e6, 1),
    }


def _read_metrics(folder: Path) -> dict[str, Any]:
    """The content of metrics.json; empty for an unfinished run."""
    metrics = files.read_json(folder / METRICS) if (folder / METRICS).is_file() else {}
    return metrics if isinstance(metrics, dict) else {}


def _read_planned(folder: Path) -> int | None:
    """The number of frames that the run will have, if known."""
    plan = files.read_json(folder / PLAN) if (folder / PLAN).is_file() else None
    return None if plan is None else from_json(dict[str, int], plan, str(folder / PLAN)).get("frames")


def _show(config: RunsConfig, console: Console) -> dict[str, Any]:
    rows = []
    for folder in map(_find_folder, config.folders):
        defaults = {field.name: field.default for field in fields(AttackConfig)}
        settings = result_settings(load_attack_config(folder, _ARGUMENT))
        changed = {key: value for key, value in settings.items() if value != defaults[key]}
        rows.append({**_describe_run(folder), "settings": changed, "left": len(files.find_leftovers(folder))})
        console.print(
            f"{folder}: {format_count(rows[-1]['frames'], 'frame')}, {rows[-1]['mb']:.0f} MB",
            soft_wrap=True,
            markup=False,
        )
        for key, value in changed.items():
            console.print(f"  {key}: {value}", soft_wrap=True, markup=False)
    return {"runs": rows}


def _merge(config: RunsConfig, console: Console) -> dict[str, Any]:
    summary = merge_runs(
        [str(_find_folder(folder)) for folder in config.folders], Path(config.out or ""), config.trust
    )
    console.print(summarise_grades(summary), soft_wrap=True)
    console.print(
        f"{format_count(summary.frames, 'frame')} of {format_count(len(config.folders), 'run')} in {summary.out}",
        soft_wrap=True,
    )
    return summary.to_json()


def _prune(config: RunsConfig, console: Console) -> dict[str, Any]:
    removed: list[str] = []
    for folder in map(Path, config.folders):
        load_attack_config(folder, _ARGUMENT)
        acquire_folder_lock(folder)  # fails while another command writes to it
        for path in files.find_leftovers(folder):
            # An analysis writes to a folder below the run, and locks that folder alone.
            if any(is_locked_elsewhere(parent) for parent in path.parents if parent.is_relative_to(folder)):
                continue
            removed.append(str(path))
            if config.dry:
                continue
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
    verb = "would be removed" if config.dry else "removed"
    console.print("\n".join([*removed, f"{len(removed)} leftovers {verb}"]), soft_wrap=True, markup=False)
    return {"removed": removed}
