"""`drivesem render`: a scene folder as a picture."""

from __future__ import annotations

import time
from pathlib import Path

from drivesem.config.commands import RenderConfig
from drivesem.config.errors import UsageError
from drivesem.report.tables import format_count, print_json
from drivesem.report.terminal import Console
from drivesem.scenes.scene import load_scene
from scene_ir import files


def run(config: RenderConfig) -> int:
    """Render a scene folder; exit code 0. Raises UsageError or SceneError for bad input."""
    start = time.perf_counter()
    out = picture_path(config.out, Path(config.scene) / "render.png")
    scene = load_scene(config.scene)
    files.write_png(out, scene.render())
    seconds = round(time.perf_counter() - start, 3)
    if config.json:
        found = {"scene": config.scene, "out": str(out), "objects": len(scene), "seconds": seconds}
        print_json(found)
    else:
        Console().print(f"{out}: {format_count(len(scene), 'vehicle')} ({seconds:.1f} s)", soft_wrap=True)
    return 0


def picture_path(given: str | None, default: Path) -> Path:
    """Where a picture goes. Raises UsageError for what cannot be a PNG file."""
    if given is None:
        return default
    path = Path(given)
    if path.suffix.lower() != ".png" or path.is_dir():
        raise UsageError("--out", "a .png file", given)
    return path
