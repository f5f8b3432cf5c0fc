"""A scene in 3D, in Open3D's window: vehicles with the photograph on them, and a relief of what is behind them."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from drivesem.run.gltf import glb_of
from drivesem.settings.errors import UsageError
from scene_ir.io import load_scene

_SIZE = (1280, 720)


def show(name: str, folder: Path) -> None:
    """Open the window; returns when it is closed. Raises UsageError where there is no display or no Open3D, and
    SceneError for a scene that cannot be read or textured.
    """
    if not has_display(sys.platform, os.environ):
        raise UsageError("--window", "a display (the page needs none)", "no DISPLAY and no WAYLAND_DISPLAY")
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise UsageError("--window", "Open3D (drivesem doctor says how to get it)", error) from error
    scene = load_scene(folder)
    with tempfile.TemporaryDirectory() as here:
        path = Path(here) / "scene.glb"
        path.write_bytes(glb_of(name, scene))
        model = open3d.io.read_triangle_model(str(path))  # pyright: ignore[reportArgumentType]
        # the camera that photographed it, at the origin of glTF's axes: along -z, y up
        open3d.visualization.draw(
            [{"name": name, "geometry": model}],
            title=f"{name} - drivesem",
            width=_SIZE[0],
            height=_SIZE[1],
            lookat=[0.0, 0.0, -20.0],
            eye=[0.0, 2.0, 6.0],
            up=[0.0, 1.0, 0.0],
            show_skybox=False,
        )


def has_display(platform: str, environment: Mapping[str, str]) -> bool:
    """Whether a window can be opened at all: elsewhere than on Linux there is a screen."""
    return not platform.startswith("linux") or any(environment.get(n) for n in ("DISPLAY", "WAYLAND_DISPLAY"))
