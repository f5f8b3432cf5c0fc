"""`drivesem derender`: a scene folder for each frame of a data set, or for one photograph."""

from __future__ import annotations

from dataclasses import asdict

from drivesem.config.commands import DerenderConfig
from drivesem.report.tables import format_count, print_json
from drivesem.report.terminal import Console
from drivesem.run.derender import derender_frames
from drivesem.scenes.sources import Photographs, SceneSource


def derender_command(config: DerenderConfig) -> int:
    """Take apart the frames that are not there yet; exit code 0. Raises UsageError or SceneError for bad input."""
    console = Console(stderr=True)
    found = derender_frames(config, lambda source: _begin(source, config, console))
    if config.json:
        frames = {name: asdict(taken) for name, taken in found.frames.items()}
        print_json({"out": str(found.out), "frames": frames, "failed": found.failed, "seconds": found.seconds})
        return 0
    lines = Console()
    for name, taken in found.frames.items():
        spent = "there before" if taken.seconds is None else f"{taken.seconds:.1f} s"
        lines.print(f"{name}: {format_count(taken.objects, 'vehicle')}, {spent}", soft_wrap=True, highlight=False)
    for name, reason in found.failed.items():
        console.print(f"frame {name} could not be used: {reason}", soft_wrap=True)
    lines.print(
        f"{format_count(len(found.frames), 'scene')} in {found.out} ({found.seconds:.0f} s)", soft_wrap=True
    )
    return 0


def _begin(source: SceneSource, config: DerenderConfig, console: Console) -> None:
    """Say what is known before the first frame."""
    if isinstance(source, Photographs) and config.photo is not None:
        focal = source.focal(next(source.identifiers()))
        console.print(f"camera: focal length {focal.length_px:.0f} px ({focal.source})", soft_wrap=True)
    if config.meshes is not None:
        from drivesem.synth.assets import unreadable_in

        for name, fault in unreadable_in(config.meshes):
            console.print(f"--meshes: {name} is left out: {fault}", soft_wrap=True, highlight=False, markup=False)
