"""`drivesem export`: what a run found, as training data, tables or 3D files for other tools."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path

from drivesem.commands.convert import sentence
from drivesem.config.commands import ExportConfig
from drivesem.config.errors import UsageError
from drivesem.config.values import class_map
from drivesem.report.tables import format_count, print_json
from drivesem.run.export import Tables, chosen, export_dataset
from drivesem.run.finished import load_runs


def run(config: ExportConfig) -> int:
    """Export; exit code 0. Raises UsageError or SceneError for bad input."""
    out = Path(config.out or "")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError("--out", "a new or empty folder", out)
    if config.to_format == "gltf":
        return _gltf(config, out)
    (found,) = load_runs([config.run or ""])
    if config.to_format == "tables":
        written = Tables.of(found, chosen(found, config.grade)).write(out)
        if config.json:
            print_json({"out": str(out), "files": written})
        sys.stderr.write(f"{', '.join(written)} in {out}\n")
        return 0
    result = export_dataset(found, out, config.to_format, config.grade, class_map("--map", config.map))
    if config.json:
        print_json({"out": str(out), **asdict(result)})
    sys.stderr.write(f"{sentence(result)}\n")
    return 0


def _gltf(config: ExportConfig, out: Path) -> int:
    from drivesem.run.gltf import export_scenes

    written = export_scenes(Path(config.run or ""), out)
    if config.json:
        print_json({"out": str(out), "files": written})
    sys.stderr.write(f"{format_count(len(written), 'scene')} in {out}\n")
    return 0
