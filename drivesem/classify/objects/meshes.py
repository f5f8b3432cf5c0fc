"""Reads an object from a mesh file: a material per face, centred, longest side 1."""

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

from drivesem.classify.objects.types import ObjectModel, drop_unused_vertices, make_object_model
from scene_ir.errors import FormatError
from scene_ir.meshes.load import painted, read_scene, sample_texture, srgb_to_linear
from scene_ir.meshes.lod import simplify
from scene_ir.types import Mesh

Array = NDArray[np.float64]

_MAX_BYTES = 1 << 28
"""Maximum size of a mesh file, its materials and each texture: ten times that of the largest usual objects."""
_TEXTURE_PX = 512
"""Larger textures are downscaled to this size first."""
_BARYCENTRIC = np.array([[4, 4, 4], [10, 1, 1], [1, 10, 1], [1, 1, 10], [5, 5, 2], [5, 2, 5], [2, 5, 5]]) / 12
"""Barycentric coordinates of the texels of a face that are averaged."""
_DEFAULT_MATERIAL = (0.5, 0.1, 10.0)
"""Grey, specular reflectance and exponent without a material."""
_MAX_SHININESS = 1000.0
_COLOUR_STEPS = 16
"""Steps per channel by which colours are distinguished when a mesh is simplified."""
_MIN_DOUBLE_AREA = 1e-14
"""Twice the area, at longest side 1, below which a face is dropped since it has no normal."""


def load_object(path: Path, name: str, label: int, folder: Path, max_triangles: int | None = None) -> ObjectModel:
    """Load the object in a mesh file (OBJ with MTL, GLB, PLY) with y up and the front towards -z.

    glTF files have their front towards +z and are turned by half a turn. Kd (linear), Ks and Ns become diffuse
    colour, specular reflectance and exponent; a texture becomes the mean of some texels of each face.

    Args:
        path: The file.
        name: Name of the object.
        label: Index of its class.
        folder: Folder that its textures must be in.
        max_triangles: Simplify a mesh with more triangles.

    Raises:
        FormatError: A file without an object that can be rendered.
    """
    scene = read_scene(path, folder, _MAX_BYTES)
    parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not parts:
        raise FormatError(str(path), "a mesh with faces", "none")
    vertices, faces = append_faces(
        [np.asarray(part.vertices, float) for part in parts], [np.asarray(part.faces, np.int64) for part in parts]
    )
    materials = np.concatenate([_face_materials(part, path) for part in parts])
    used = np.unique(faces)
    if not np.isfinite(vertices[used]).all():
        raise FormatError(f"{path}: vertices", "finite coordinates", "NaN or infinity")
    low, high = vertices[used].min(axis=0), vertices[used].max(axis=0)
    longest = float((high - low).max())
    if not 0 < longest < np.inf:
        raise FormatError(f"{path}: vertices", "an object with some extent", f"a longest side of {longest}")
    unit = ((vertices - low) / longest - (high - low) / longest / 2) * (
        [-1.0, 1.0, -1.0] if path.suffix.lower() == ".glb" else 1.0
    )
    unit = unit.astype(np.float32)
    corners = unit[faces].astype(float)
    doubled = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    large_enough = doubled > _MIN_DOUBLE_AREA
    faces, materials = faces[large_enough], materials[large_enough]
    if len(faces) == 0:
        raise FormatError(f"{path}: faces", "at least one face with an area", "none")
    if max_triangles is not None and len(faces) > max_triangles:
        rounded = np.rint(materials * [_COLOUR_STEPS] * 4 + [1])
        _, first, material = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
        fine = Mesh(torch.from_numpy(unit), torch.from_numpy(faces), torch.from_numpy(material.reshape(-1)))
        coarse = simplify(drop_unused_vertices(fine), max_triangles)  # keeps borders between materials
        unit, faces = coarse.vertices.numpy(), coarse.faces.numpy()
        materials = materials[first[coarse.part.numpy()]]
    return make_object_model(name, label, unit, faces, materials)


def _face_materials(part: trimesh.Trimesh, path: Path) -> Array:
    """Compute linear RGB, specular reflectance and exponent (F, 5) of a part's faces."""
    count, visual = len(part.faces), part.visual
    grey, specular, shininess = _DEFAULT_MATERIAL
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
        rough = _parse_number(material.roughnessFactor, 1.0, 1.0)
        specular = 0.04 + 0.5 * _parse_number(material.metallicFactor, 0.0, 1.0)
        shininess = min(2 / max(rough, 0.1) ** 4, _MAX_SHININESS)
        if material.baseColorFactor is not None:
            rgb[:] = np.asarray(material.baseColorFactor, float)[:3] / 255.0
        elif image is not None or factor is not None:
            rgb[:] = 1.0
    elif isinstance(material, SimpleMaterial):
        image = material.image
        mtl = material.kwargs  # as in the MTL file; trimesh fills missing values with grey
        rgb[:] = _parse_colour(mtl.get("kd"), grey) if image is None else 1.0
        specular = float(_parse_colour(mtl.get("ks"), specular).mean())
        shininess = _parse_number(mtl.get("ns"), shininess, _MAX_SHININESS)
    if image is not None and uv is not None and len(uv) == len(part.vertices):
        corners = np.nan_to_num(np.asarray(uv, float)[part.faces][..., :2], posinf=0.0, neginf=0.0)
        texels = sample_texture(image, np.einsum("pc,fcd->fpd", _BARYCENTRIC, corners), path, _TEXTURE_PX)
        rgb = rgb * srgb_to_linear(texels).mean(axis=1)
    if factor is not None:
        rgb = rgb * factor[part.faces].mean(axis=1)
    return np.column_stack([rgb.clip(0, 1), np.full(count, specular), np.full(count, shininess)])


def _parse_number(value: Any, default: float, maximum: float) -> float:
    """Clamp a material's number to [0, maximum]; the default if it is missing or invalid."""
    return min(max(float(value), 0.0), maximum) if isinstance(value, int | float) and value == value else default


def _parse_colour(value: Any, default: float) -> Array:
    """Clamp a colour (3,) of an MTL file to [0, 1]; the default grey if it is missing or invalid."""
    if not isinstance(value, list) or len(value) != 3 or not np.isfinite(value).all():
        return np.full(3, default)
    return np.array(value, float).clip(0, 1)
