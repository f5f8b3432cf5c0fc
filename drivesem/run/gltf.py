"""Scenes as glTF: vehicles with the photograph baked into their textures, and what stands behind them as a relief.

Axes are glTF's: x right, y up, looking along -z from the camera at the origin; metres.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from drivesem.failures.second_renderer.geometry import PictureCamera
from drivesem.failures.second_renderer.photograph import PhotographRenderer
from drivesem.scenes.sources import find_scene_folders
from scene_ir import files
from scene_ir.io import load_scene, to_uint8
from scene_ir.types import SceneIR

STEP_PX = 4
"""Of the relief's grid."""
FARTHEST_M = 120.0
"""The sky is as far."""
_TORN = 1.25
"""Neighbours with distances that differ by more than this factor are not joined."""
_TO_GLTF = np.array([1.0, -1.0, -1.0], np.float32)
"""From camera axes: x right, y down, z forward."""


def export_scenes(source: Path, out: Path) -> list[str]:
    """Write a GLB file for each scene below a folder, as it stands; their names. Raises SceneError where there is
    no scene, or no second renderer to bake textures with.
    """
    written: list[str] = []
    for name, folder in find_scene_folders(source).items():
        files.write_bytes(out / f"{name}.glb", scene_to_glb(name, load_scene(folder)))
        written.append(f"{name}.glb")
    return written


def scene_to_glb(name: str, scene: SceneIR) -> bytes:
    """A scene as a GLB file: meshes "vehicle-0" and so on, and "surroundings"."""
    import trimesh

    whole = trimesh.Scene()
    for i, (corners, skin) in enumerate(PhotographRenderer(name, scene).textured_vehicles(scene)):
        faces = np.arange(corners.shape[0] * 3).reshape(-1, 3)
        points = corners.reshape(-1, 3) * _TO_GLTF
        whole.add_geometry(_textured(points, faces, skin.uv, skin.texture), geom_name=f"vehicle-{i}")
    points, faces, uv = _relief(scene)
    behind = to_uint8(scene.origin.background)
    whole.add_geometry(_textured(points * _TO_GLTF, faces, uv, behind), geom_name="surroundings")
    exported: Any = whole.export(file_type="glb")
    return bytes(exported)


def _textured(points: NDArray[Any], faces: NDArray[Any], uv: NDArray[Any], picture: NDArray[np.uint8]) -> Any:
    import trimesh
    from PIL import Image
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    material = PBRMaterial(
        baseColorTexture=Image.fromarray(np.ascontiguousarray(picture)),
        metallicFactor=0.0,
        roughnessFactor=1.0,
        doubleSided=True,
    )
    visual = TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(points, faces, visual=visual, process=False)


def _relief(scene: SceneIR) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """The background as a surface: points (N, 3) m in the camera's own axes, faces (M, 3), uv (N, 2) upwards."""
    lens = PictureCamera.from_camera(scene.camera)
    depth = np.minimum(scene.origin.depth.cpu().numpy().astype(np.float32), FARTHEST_M)
    rows = np.unique(np.append(np.arange(0, lens.height, STEP_PX), lens.height - 1))
    columns = np.unique(np.append(np.arange(0, lens.width, STEP_PX), lens.width - 1))
    smooth = cv2.medianBlur(depth, 5)[np.ix_(rows, columns)]
    x, y = np.meshgrid(columns.astype(np.float64), rows.astype(np.float64))
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(lens.intrinsics.astype(np.float64)).T
    points = (rays * smooth[..., None]).reshape(-1, 3).astype(np.float32)
    uv = np.stack([(x + 0.5) / lens.width, 1 - (y + 0.5) / lens.height], -1).reshape(-1, 2)
    at = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel())
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    far = smooth.ravel()[faces]
    return points, faces[far.max(1) <= _TORN * far.min(1)], uv
