"""A scene in 3D, in Open3D's window: vehicles with the photograph on them, and a relief of what is behind them."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from drivesem.config.blocks import Sharing
from drivesem.config.errors import UsageError
from drivesem.run.gltf import glb_of
from drivesem.run.workers import mapping
from scene_ir.io import load_scene

_SIZE = (1280, 720)
_AHEAD, _FROM, _ZOOM = [0.0, 0.0, -20.0], [0.0, 0.12, 1.0], 0.06
"""Where one looks and from where, in glTF's axes: from behind the camera that took the photograph."""


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
    # in a process of its own: textures are baked by EGL, whose context is in the way of a window's
    (glb,) = mapping(Sharing(workers=1), apart=True)(partial(_glb, name), [folder])
    meshes = _meshes(open3d, glb)
    window = open3d.visualization.Visualizer()
    if not window.create_window(f"{name} - drivesem", *_SIZE):
        raise UsageError("--window", "a display with OpenGL", "none that Open3D can use")
    for mesh in meshes:
        window.add_geometry(mesh)
    how, view = window.get_render_option(), window.get_view_control()
    how.light_on, how.mesh_show_back_face = False, True  # the photograph is lit
    view.set_lookat(_AHEAD)
    view.set_front(_FROM)
    view.set_up([0.0, 1.0, 0.0])
    view.set_zoom(_ZOOM)
    window.run()
    window.destroy_window()


def _glb(name: str, folder: Path) -> bytes:
    return glb_of(name, load_scene(folder))


def _meshes(open3d: Any, glb: bytes) -> list[Any]:
    """The meshes of a GLB file, with their textures, for the older of Open3D's windows: the newer one asks for
    Vulkan.
    """
    with tempfile.TemporaryDirectory() as here:
        path = Path(here) / "scene.glb"
        path.write_bytes(glb)
        model = open3d.io.read_triangle_model(str(path))
    meshes = []
    for part in model.meshes:
        mesh, skin = part.mesh, np.asarray(model.materials[part.material_idx].albedo_img)
        uv = np.asarray(mesh.triangle_uvs)
        uv[:, 1] = 1 - uv[:, 1]  # glTF counts them downwards
        mesh.triangle_uvs = open3d.utility.Vector2dVector(uv)
        mesh.textures = [open3d.geometry.Image(skin)]
        mesh.triangle_material_ids = open3d.utility.IntVector([0] * len(mesh.triangles))
        meshes.append(mesh)
    return meshes


def has_display(platform: str, environment: Mapping[str, str]) -> bool:
    """Whether a window can be opened at all: elsewhere than on Linux there is a screen."""
    return not platform.startswith("linux") or any(environment.get(n) for n in ("DISPLAY", "WAYLAND_DISPLAY"))
