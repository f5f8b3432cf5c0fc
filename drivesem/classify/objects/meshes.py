"""An object read from a mesh file: its materials a face, centred, its longest side 1."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from trimesh.util import append_faces
from trimesh.visual import ColorVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from drivesem.classify.objects.types import ObjectModel, object_model, used
from scene_ir.errors import FormatError
from scene_ir.meshes.load import painted, read_scene, sample_texture, srgb_to_linear
from scene_ir.meshes.lod import simplify
from scene_ir.types import Mesh

Array = NDArray[np.float64]

_MOST_BYTES = 1 << 28
"""Of a mesh file, its materials and each texture: ten times the largest of usual objects."""
_TEXTURE_PX = 512
"""Larger textures are averaged down to so many before faces look at them."""
_PLACES = np.array([[4, 4, 4], [10, 1, 1], [1, 10, 1], [1, 1, 10], [5, 5, 2], [5, 2, 5], [2, 5, 5]]) / 12
"""Barycentric places of a face whose texels are averaged."""
_PLAIN = (0.5, 0.1, 10.0)
"""Grey, specular share and exponent where a file says nothing."""
_MOST_SHININESS = 1000.0
_STEPS = 16
"""Colours are told apart so finely, a channel, where a mesh is simplified."""
_SMALL = 1e-14
"""Twice the area, at longest side 1, below which a face has no direction and is left out."""


def read_object(path: Path, name: str, label: int, folder: Path, most_triangles: int | None = None) -> ObjectModel:
    """The object in a mesh file (OBJ with MTL, GLB, PLY), y up, its front towards -z.

    glTF's front is +z: those files are turned by half. Kd (linear), Ks and Ns become diffuse colour, specular
    share and exponent; a texture becomes the mean of some texels of each face. folder: where textures may lie.
    most_triangles: a finer mesh is simplified. Raises FormatError for a file without an object that can be drawn.
    """
    scene = read_scene(path, folder, _MOST_BYTES)
    parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not parts:
        raise FormatError(str(path), "a mesh with faces", "none")
    vertices, faces = append_faces(
        [np.asarray(part.vertices, float) for part in parts], [np.asarray(part.faces, np.int64) for part in parts]
    )
    looks = np.concatenate([_looks(part, path) for part in parts])
    shown = np.unique(faces)
    if not np.isfinite(vertices[shown]).all():
        raise FormatError(f"{path}: vertices", "finite coordinates", "NaN or infinity")
    low, high = vertices[shown].min(axis=0), vertices[shown].max(axis=0)
    longest = float((high - low).max())
    if not 0 < longest < np.inf:
        raise FormatError(f"{path}: vertices", "an object with some extent", f"a longest side of {longest}")
    unit = ((vertices - low) / longest - (high - low) / longest / 2) * (
        [-1.0, 1.0, -1.0] if path.suffix.lower() == ".glb" else 1.0
    )
    unit = unit.astype(np.float32)
    corners = unit[faces].astype(float)
    doubled = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    faces, looks = faces[doubled > _SMALL], looks[doubled > _SMALL]
    if len(faces) == 0:
        raise FormatError(f"{path}: faces", "at least one face with an area", "none")
    if most_triangles is not None and len(faces) > most_triangles:
        rounded = np.rint(looks * [_STEPS, _STEPS, _STEPS, _STEPS, 1])
        _, first, material = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
        fine = Mesh(torch.from_numpy(unit), torch.from_numpy(faces), torch.from_numpy(material.reshape(-1)))
        coarse = simplify(used(fine), most_triangles)  # borders between materials stay
        unit, faces, looks = coarse.vertices.numpy(), coarse.faces.numpy(), looks[first[coarse.part.numpy()]]
    return object_model(name, label, unit, faces, looks)


def _looks(part: trimesh.Trimesh, path: Path) -> Array:
    """Linear RGB, specular share and exponent (F, 5) of a part's faces."""
    count, visual = len(part.faces), part.visual
    grey, specular, shininess = _PLAIN
    rgb = np.full((count, 3), grey)
    material: Any = getattr(visual, "material", None)
    image, uv = None, getattr(visual, "uv", None)
    factor = painted(part)
    if isinstance(visual, ColorVisuals):
        if factor is not None:
            rgb[:] = 1.0
        elif visual.defined:
            rgb = srgb_to_linear(np.asarray(visual.face_colors)[:, :3] / 255.0)
    elif isinstance(material, PBRMaterial):
        image = material.baseColorTexture
        rough = _number(material.roughnessFactor, 1.0, 1.0)
        specular = 0.04 + 0.5 * _number(material.metallicFactor, 0.0, 1.0)
        shininess = min(2 / max(rough, 0.1) ** 4, _MOST_SHININESS)
        if material.baseColorFactor is not None:
            rgb[:] = np.asarray(material.baseColorFactor, float)[:3] / 255.0
        elif image is not None or factor is not None:
            rgb[:] = 1.0
    elif isinstance(material, SimpleMaterial):
        image = material.image
        said = material.kwargs  # as the MTL has it: what it leaves out, trimesh fills with grey
        rgb[:] = _share(said.get("kd"), grey) if image is None else 1.0
        specular = float(_share(said.get("ks"), specular).mean())
        shininess = _number(said.get("ns"), shininess, _MOST_SHININESS)
    if image is not None and uv is not None and len(uv) == len(part.vertices):
        corners = np.nan_to_num(np.asarray(uv, float)[part.faces][..., :2], posinf=0.0, neginf=0.0)
        seen = sample_texture(image, np.einsum("pc,fcd->fpd", _PLACES, corners), path, _TEXTURE_PX)
        rgb = rgb * srgb_to_linear(seen).mean(axis=1)
    if factor is not None:
        rgb = rgb * factor[part.faces].mean(axis=1)
    return np.column_stack([rgb.clip(0, 1), np.full(count, specular), np.full(count, shininess)])


def _number(value: Any, other: float, most: float) -> float:
    """What a material says, between 0 and `most`; another number where it says nothing, or nonsense."""
    return min(max(float(value), 0.0), most) if isinstance(value, int | float) and value == value else other


def _share(value: Any, other: float) -> Array:
    """A colour (3,) in [0, 1] of an MTL; grey of another lightness where it has none, or nonsense."""
    if not isinstance(value, list) or len(value) != 3 or not np.isfinite(value).all():
        return np.full(3, other)
    return np.array(value, float).clip(0, 1)
