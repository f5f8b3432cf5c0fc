"""`drivesem derender`, `edit` and `render`: photographs to scene folders, and a scene folder to a picture."""

from __future__ import annotations

import sys
import time
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

from drivesem.attacks.scene_edits import REMOVED, apply_edit
from drivesem.config.commands import DerenderConfig, EditConfig, RenderConfig
from drivesem.config.edits import ALL, merge_edits, parse_frame_edit, parse_setting, read_frame_edit
from drivesem.config.errors import UsageError
from drivesem.data.account import write_account_of
from drivesem.reporting.tables import Console, format_count, print_json
from drivesem.scenes.scene import Scene, check_scene_folder
from drivesem.scenes.sources import PhotographSource, SceneSource
from scene_ir import files
from scene_ir.exchange import CHANGE_KEY
from scene_ir.io import load_scene, save_scene

_CHANGED = "not the photograph: objects that were removed, exchanged, added or loaded remain so"


def edit_command(config: EditConfig) -> int:
    """`drivesem edit`: write the changed scene, its picture, or both."""
    start = time.perf_counter()
    folder = Path(config.scene)
    out = None
    if config.out is not None or config.save is None:
        out = picture_path(config.out, folder / "edit.png")
    save = None if config.save is None else _save_path(Path(config.save), folder)
    edit = parse_frame_edit("edit", _changes(config))
    scene = load_scene(folder)
    result = apply_edit(scene.unperturbed(), edit, scene) if config.photographed else apply_edit(scene, edit)
    changed = config.photographed and not {CHANGE_KEY, REMOVED}.isdisjoint(scene.provenance)
    notes = (*([_CHANGED] if changed else []), *result.notes)
    for note in notes:
        sys.stderr.write(f"drivesem: {note}\n")
    if save is not None:
        save_scene(result.scene, save)
    if out is not None:
        files.write_png(out, Scene(result.scene).render())
    seconds = round(time.perf_counter() - start, 3)
    written = {name: str(path) for name, path in (("out", out), ("save", save)) if path is not None}
    if config.json:
        facts = {"objects": len(result.scene.objects), "notes": notes, "seconds": seconds}
        print_json({"scene": config.scene, **written, **facts})
    else:
        objects = format_count(len(result.scene.objects), "object")
        objects += f", {len(result.removed)} removed" if result.removed else ""
        Console().print(f"{' and '.join(written.values())}: {objects} ({seconds:.1f} s)", soft_wrap=True)
    return 0


def _changes(config: EditConfig) -> dict[Any, Any]:
    """The edits of file and command line as one mapping. Raises FormatError or UsageError."""
    changes: dict[Any, Any] = {} if config.edits is None else read_frame_edit(Path(config.edits))
    for text in config.set:
        changes = merge_edits(changes, parse_setting(text))
    for text in config.remove:
        for part in text.split(","):
            row = part.strip()
            if row != ALL and not (row.isascii() and row.isdigit()):
                raise UsageError("--remove", "numbers from 0, or all", repr(text))
            changes = merge_edits(changes, {"objects": {ALL if row == ALL else int(row): {"remove": True}}})
    if not changes and not config.photographed:
        raise UsageError("edit", "a change: --set, --remove, --edits or --photographed", "none")
    return changes


def _save_path(path: Path, scene: Path) -> Path:
    """The folder of the changed scene. Raises UsageError if it would overwrite anything but a scene."""
    if check_scene_folder(path, "--save").resolve() in scene.resolve().parents:
        raise UsageError("--save", "a folder that does not hold the scene", path)
    return path


def render_command(config: RenderConfig) -> int:
    """`drivesem render`: write the picture of a scene."""
    start = time.perf_counter()
    out = picture_path(config.out, Path(config.scene) / "render.png")
    scene = load_scene(Path(config.scene))
    files.write_png(out, Scene(scene).render())
    seconds = round(time.perf_counter() - start, 3)
    if config.json:
        print_json({"scene": config.scene, "out": str(out), "objects": len(scene.objects), "seconds": seconds})
    else:
        Console().print(f"{out}: {format_count(len(scene.objects), 'object')} ({seconds:.1f} s)", soft_wrap=True)
    return 0


def picture_path(given: str | None, default: Path) -> Path:
    """The path of a picture. Raises UsageError if it is not a PNG file."""
    if given is None:
        return default
    path = Path(given)
    if path.suffix.lower() != ".png" or path.is_dir():
        raise UsageError("--out", "a .png file", given)
    return path


def derender_command(config: DerenderConfig) -> int:
    """`drivesem derender`: make the scenes that do not exist yet."""
    from drivesem.run.derender import derender_frames

    console = Console(stderr=True)
    accounts: list[dict[str, Any]] = []

    def print_source(source: SceneSource) -> None:
        accounts.append(write_account_of(source, config.keep_going))
        _print_source(source, config, console)

    result = derender_frames(config, print_source)
    if config.json:
        frames = {name: asdict(summary) for name, summary in result.frames.items()}
        facts = {"failed": result.failed, "seconds": result.seconds, "data": accounts[0]}
        print_json({"out": str(result.out), "frames": frames, **facts})
        return 0
    lines = Console()
    for name, summary in result.frames.items():
        duration = "already there" if summary.seconds is None else f"{summary.seconds:.1f} s"
        lines.print(
            f"{name}: {format_count(summary.objects, 'object')}, {duration}", soft_wrap=True, highlight=False
        )
    reasons = Counter(reason for summary in result.frames.values() for reason in summary.left_out.values())
    if reasons:
        text = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
        lines.print(f"people that stay background: {text}", soft_wrap=True, highlight=False)
    for name, reason in result.failed.items():
        console.print(f"frame {name} could not be used: {reason}", soft_wrap=True)
    lines.print(
        f"{format_count(len(result.frames), 'scene')} in {result.out} ({result.seconds:.0f} s)", soft_wrap=True
    )
    return 0


def _print_source(source: SceneSource, config: DerenderConfig, console: Console) -> None:
    """Print the camera of a photograph, and what is left out of the meshes."""
    if isinstance(source, PhotographSource) and config.photo is not None:
        focal = source.focal_length(next(source.identifiers()))
        console.print(f"camera: focal length {focal.length_px:.0f} px ({focal.source})", soft_wrap=True)
    if config.meshes is not None:
        from drivesem.synth.assets import notes_in

        for note in notes_in(config.meshes):
            console.print(f"--meshes: {note}", soft_wrap=True, highlight=False, markup=False)
