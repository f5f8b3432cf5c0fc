"""`drivesem derender`: a scene folder for each frame of a data set, or for each photograph."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from drivesem.config.commands import DerenderConfig
from drivesem.data.account import write_account
from drivesem.report.tables import format_count, print_json
from drivesem.report.terminal import Console
from drivesem.run.derender import derender_frames
from drivesem.scenes.sources import PhotographSource, SceneSource


def derender_command(config: DerenderConfig) -> int:
    """`drivesem derender`: make the scenes that do not exist yet."""
    console = Console(stderr=True)
    accounts: list[dict[str, Any]] = []

    def print_source(source: SceneSource) -> None:
        accounts.append(write_account(source.account()))
        _print_source(source, config, console)

    result = derender_frames(config, print_source)
    if config.json:
        frames = {name: asdict(summary) for name, summary in result.frames.items()}
        print_json(
            {"out": str(result.out), "frames": frames, "failed": result.failed, "seconds": result.seconds}
            | {"data": accounts[0]}
        )
        return 0
    lines = Console()
    for name, summary in result.frames.items():
        time = "already there" if summary.seconds is None else f"{summary.seconds:.1f} s"
        lines.print(f"{name}: {format_count(summary.objects, 'vehicle')}, {time}", soft_wrap=True, highlight=False)
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
