"""`drivesem edit`: a scene folder, changed by physical units, as a picture and as a scene folder again."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

from drivesem.attack.scene_edits import REMOVED, edited
from drivesem.commands.render import picture_path
from drivesem.config.commands import EditConfig
from drivesem.config.edits import ALL, frame_edit, merged, parse_setting, read_frame_edit
from drivesem.config.errors import UsageError
from drivesem.report.tables import format_count, print_json
from drivesem.report.terminal import Console
from drivesem.scenes.scene import Scene, free_folder
from scene_ir import files
from scene_ir.exchange import CHANGE_KEY
from scene_ir.io import load_scene, save_scene

_STAYS = "not the photograph: vehicles that were removed, exchanged, added, loaded or taken away stay so"


def run(config: EditConfig) -> int:
    """Edit a scene folder; exit code 0. Raises UsageError or SceneError for bad input."""
    start = time.perf_counter()
    folder = Path(config.scene)
    out = None
    if config.out is not None or config.save is None:
        out = picture_path(config.out, folder / "edit.png")
    save = None if config.save is None else _save_path(Path(config.save), folder)
    edit = frame_edit("edit", _changes(config))
    scene = load_scene(folder)
    result = edited(scene.unperturbed(), edit, scene) if config.photographed else edited(scene, edit)
    stays = config.photographed and not {CHANGE_KEY, REMOVED}.isdisjoint(scene.provenance)
    notes = (*([_STAYS] if stays else []), *result.notes)
    for note in notes:
        sys.stderr.write(f"drivesem: {note}\n")
    if save is not None:
        save_scene(result.scene, save)
    if out is not None:
        files.write_png(out, Scene(result.scene).render())
    seconds = round(time.perf_counter() - start, 3)
    written = {name: str(path) for name, path in (("out", out), ("save", save)) if path is not None}
    if config.json:
        found = {"scene": config.scene, **written, "objects": len(result.scene.objects), "notes": notes}
        print_json({**found, "seconds": seconds})
    else:
        what = format_count(len(result.scene.objects), "vehicle")
        what += f", {len(result.removed)} removed" if result.removed else ""
        Console().print(f"{' and '.join(written.values())}: {what} ({seconds:.1f} s)", soft_wrap=True)
    return 0


def _changes(config: EditConfig) -> dict[Any, Any]:
    """The edits of file and command line as one mapping. FormatError or UsageError for what cannot be."""
    changes: dict[Any, Any] = {} if config.edits is None else read_frame_edit(Path(config.edits))
    for text in config.set:
        changes = merged(changes, parse_setting(text))
    for text in config.remove:
        for part in text.split(","):
            row = part.strip()
            if row != ALL and not (row.isascii() and row.isdigit()):
                raise UsageError("--remove", "rows from 0, or all", repr(text))
            changes = merged(changes, {"objects": {ALL if row == ALL else int(row): {"remove": True}}})
    if not changes and not config.photographed:
        raise UsageError("edit", "a change: --set, --remove, --edits or --photographed", "none")
    return changes


def _save_path(path: Path, scene: Path) -> Path:
    """Where the changed scene goes. UsageError where that would destroy something else than a scene."""
    if free_folder(path, "--save").resolve() in scene.resolve().parents:
        raise UsageError("--save", "a folder that does not hold the scene", path)
    return path
