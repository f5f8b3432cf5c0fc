"""`drivesem report`: the page of finished runs, beside each other where there are several."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from drivesem.report.page import Chart, ShownRun
from drivesem.run.finished import METRICS
from drivesem.run.folder import CONFIG
from drivesem.run.page import load_shown, query_curves, write_report
from drivesem.settings.commands import Report
from drivesem.settings.errors import UsageError

_STUDY, _ARMS = "study.json", "arms"
_PAGE = "report.html"


def run(config: Report) -> int:
    """Write the page; exit code 0. Raises UsageError or SceneError for bad input."""
    folders: list[str] = []
    charts: list[Chart] = []
    for given in config.runs:
        found = _runs_of(Path(given))
        folders += [str(folder) for folder in found]
        if (Path(given) / _STUDY).is_file():
            charts += query_curves(Path(given))
    out = Path(config.out) if config.out else _default_out(config.runs)
    if out.is_dir():
        raise UsageError("--out", "an HTML file", f"the folder {out}")
    shown, left_out = load_shown(folders)
    size = write_report(out, shown, config.frames, left_out, charts)
    if config.json:
        sys.stdout.write(json.dumps(_data(out, size, shown, left_out), allow_nan=False) + "\n")
    else:
        told = (
            f"{len(shown)} run{'' if len(shown) == 1 else 's'}, {len(shown[0].frames)} frames, {size / 1e6:.1f} MB"
        )
        Console().print(f"{told}: {out}", soft_wrap=True)
    return 0


def _runs_of(folder: Path) -> list[Path]:
    """A run itself, or the finished arms of a study. Raises UsageError where it is neither."""
    if not folder.is_dir():
        raise UsageError("RUN", "a folder of drivesem attack or drivesem study", folder)
    if not (folder / _ARMS).is_dir():
        return [folder]
    arms = [
        arm for arm in sorted((folder / _ARMS).iterdir()) if (arm / CONFIG).is_file() and (arm / METRICS).is_file()
    ]
    if not arms:
        raise UsageError("RUN", "a study with a finished arm", folder)
    return arms


def _default_out(given: tuple[str, ...]) -> Path:
    """In the folder that was given, or where the command is called."""
    return Path(given[0]) / _PAGE if len(given) == 1 else Path(_PAGE)


def _data(out: Path, size: int, shown: list[ShownRun], left_out: int) -> dict[str, Any]:
    """What `--json` prints: fractions of 1."""
    rows = []
    for one in shown:
        summary = one.summary.to_json()
        del summary["out"], summary["seconds"]
        rows.append(
            {
                "name": one.name,
                "run": str(one.folder),
                "method": one.method,
                **summary,
                "paper": asdict(one.paper) if one.paper else None,
            }
        )
    frames = [
        {
            "frame": results[0].identifier,
            "failures": {
                one.name: [f.kind for f in result.failures] for one, result in zip(shown, results, strict=True)
            },
        }
        for results in zip(*(one.frames for one in shown), strict=True)
    ]
    return {"out": str(out), "bytes": size, "frames_left_out": left_out, "runs": rows, "frames": frames}
