"""`drivesem runs`: what runs there are, one of several parts, and nothing that was never finished."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

from drivesem.commands.attack import told_grades
from drivesem.config.commands import DEFAULT_COMBO, AttackConfig, RunsConfig
from drivesem.config.errors import UsageError
from drivesem.failures.grades import Grade
from drivesem.report.tables import format_count, print_json
from drivesem.report.terminal import Console
from drivesem.run.finished import METRICS
from drivesem.run.folder import CONFIG, FRAMES, is_attack_run, load_attack_config, result_settings
from drivesem.run.labels import list_frames
from drivesem.run.lock import acquire_folder_lock, is_locked_elsewhere
from drivesem.run.merge import merge_runs
from drivesem.store import place
from scene_ir import files

_SETTING = "FOLDER"
"""What names a run on the command line."""
_HOME = "runs"
"""Where `drivesem attack` puts runs without --out."""


def runs_command(config: RunsConfig) -> int:
    """Tell, merge or prune; exit code 0. Raises UsageError or SceneError for bad input."""
    console = Console()
    does = {"list": _list, "show": _show, "merge": _merge, "prune": _prune}
    data = does[config.what](config, Console(quiet=True) if config.json else console)
    if config.json:
        print_json(data)
    return 0


_place = partial(place, setting=_SETTING)


def _list(config: RunsConfig, console: Console) -> dict[str, Any]:
    found = [run for folder in config.folders or (_HOME,) for run in _runs_in(_place(folder))]
    rows = [_row(folder) for folder in found]
    for row in rows:
        console.print(_line(row), soft_wrap=True, markup=False)
    console.print(f"{len(rows)} in all", soft_wrap=True)
    return {"runs": rows}


def _line(row: Mapping[str, Any]) -> str:
    """A run in words."""
    grades, frames = row["grades"], format_count(row["frames"], "frame")
    what = f"{row['params']} by {row['method']} on {row['detector']}, {row['mb']:.0f} MB"
    if grades is None:
        stands = "being made now" if row["running"] else "not finished (the same command goes on)"
        return f"{row['run']}: {frames}, {stands}; {what}"
    held = [f"{grades[grade]} {grade}" for grade in (Grade.CERTAIN, Grade.CONFIRMED) if grade in grades]
    found = f"{', '.join(held)} of {format_count(grades.get(Grade.THRESHOLD, 0), 'failure')} by threshold"
    return f"{row['run']}: {frames}, {found}; {what}"


def _runs_in(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise UsageError(_SETTING, "a folder with runs of drivesem attack", folder)
    if (folder / CONFIG).is_file():
        return [folder]
    runs = (path.parent for path in folder.glob(f"*/{CONFIG}") if (path.parent / FRAMES).is_dir())
    return sorted(run for run in runs if is_attack_run(run))


def _row(folder: Path) -> dict[str, Any]:
    attack, figures = load_attack_config(folder, _SETTING), _figures(folder)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return {
        "run": str(folder),
        "finished": bool(figures),
        "running": not figures and is_locked_elsewhere(folder),
        "detector": attack.detector,
        "dataset": attack.dataset,
        "params": ",".join(figures.get("params", ())) or attack.params or f"combo {attack.combo or DEFAULT_COMBO}",
        "method": attack.method,
        "frames": len(list_frames(folder)),
        "grades": figures.get("grades"),
        "mb": round(size / 1e6, 1),
    }


def _figures(folder: Path) -> dict[str, Any]:
    """Of metrics.json; empty for a run that is not finished."""
    found = files.read_json(folder / METRICS) if (folder / METRICS).is_file() else {}
    return found if isinstance(found, dict) else {}


def _show(config: RunsConfig, console: Console) -> dict[str, Any]:
    told = []
    for folder in map(_place, config.folders):
        usual = {field.name: field.default for field in fields(AttackConfig)}
        settings = result_settings(load_attack_config(folder, _SETTING))
        asked = {key: value for key, value in settings.items() if value != usual[key]}
        told.append({**_row(folder), "settings": asked, "left": len(files.find_leftovers(folder))})
        console.print(
            f"{folder}: {format_count(told[-1]['frames'], 'frame')}, {told[-1]['mb']:.0f} MB",
            soft_wrap=True,
            markup=False,
        )
        for key, value in asked.items():
            console.print(f"  {key}: {value}", soft_wrap=True, markup=False)
    return {"runs": told}


def _merge(config: RunsConfig, console: Console) -> dict[str, Any]:
    summary = merge_runs([str(_place(folder)) for folder in config.folders], Path(config.out or ""), config.trust)
    console.print(told_grades(summary), soft_wrap=True)
    console.print(
        f"{format_count(summary.frames, 'frame')} of {format_count(len(config.folders), 'run')} in {summary.out}",
        soft_wrap=True,
    )
    return summary.to_json()


def _prune(config: RunsConfig, console: Console) -> dict[str, Any]:
    removed: list[str] = []
    for folder in map(Path, config.folders):
        load_attack_config(folder, _SETTING)
        acquire_folder_lock(folder)  # what another command is writing now is none of this
        for path in files.find_leftovers(folder):
            # A question to the run writes below it, and holds the folder of its own answers alone.
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
