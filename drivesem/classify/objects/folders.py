"""Sets of objects in folders: ShapeNetCore's layout, or meshes by class."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from trimesh.util import append_faces
from trimesh.visual import ColorVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from drivesem.classify.objects.types import (
    CLASSES,
    SPLITS,
    ObjectModel,
    Split,
    drop_unused_vertices,
    make_object_model,
)
from scene_ir import files
from scene_ir.errors import FormatError, RangeError
from scene_ir.meshes.load import painted, read_scene, sample_texture, srgb_to_linear
from scene_ir.meshes.lod import simplify
from scene_ir.types import Mesh

SHAPENET = {
    "airplane": ("02691156", (775, 2713, 388)),
    "bench": ("02828884", (464, 1624, 232)),
    "trashcan": ("02747177", (119, 417, 60)),
    "bus": ("02924116", (127, 445, 64)),
    "car": ("02958343", (1549, 5421, 774)),
    "helmet": ("03513137", (60, 210, 30)),
    "mailbox": ("03710193", (15, 53, 8)),
    "motorcycle": ("03790512", (73, 258, 37)),
    "skateboard": ("04225987", (49, 171, 24)),
    "tower": ("04460130", (25, 87, 12)),
    "train": ("04468005", (99, 344, 49)),
    "boat": ("04530566", (315, 1100, 157)),
}
"""ShapeNetCore's folder of each class, and numbers of objects that the paper tests, trains and validates on."""
_SHARES = (0.7, 0.1)
"""Shares of training and validation if a class has fewer objects than in the paper: the paper's own."""
_MODELS = ("models/model_normalized.obj", "model.obj")
"""File of an object in ShapeNetCore's second and first version."""
_SUFFIXES = (".obj", ".glb", ".ply")


class FolderObjects:
    """`ObjectSet` of a folder.

    The folder has ShapeNetCore's layout `SYNSET/HASH/models/model_normalized.obj`, of which the paper's classes are
    used, or `CLASS/NAME.obj` (.glb, .ply) with any classes. `splits.json` ({"train": ["bus/NAME", ...], "val": [...],
    "test": [...]}) or `train.txt`, `val.txt` and `test.txt`, with one name per line, define the splits. Otherwise they
    are drawn at random within each class: of the paper's sizes if the class has that many objects, else 70, 10 and
    20 %.
    """

    def __init__(self, folder: str | Path, *, seed: int = 0, max_triangles: int | None = None) -> None:
        """
        Args:
            folder: The folder.
            seed: Seed of random splits.
            max_triangles: Simplify meshes with more triangles to this number.

        Raises:
            FormatError: A folder without objects, or lists that name missing objects.
        """
        if max_triangles is not None and max_triangles < 4:
            raise RangeError("max_triangles", "at least 4", max_triangles)
        self._root, self._seed, self._max_triangles = Path(folder), seed, max_triangles
        if not self._root.is_dir():
            raise FormatError(str(folder), "a folder of objects", "no such folder")
        synsets = {name: self._root / synset for name, (synset, _) in SHAPENET.items()}
        self._synsets = {name: path for name, path in synsets.items() if path.is_dir()}
        self._paths = self._find_shapenet_objects() if self._synsets else self._find_meshes_by_class()
        if not self._paths:
            expected = f"ShapeNetCore's folders, or folders of {', '.join(_SUFFIXES)} by class"
            raise FormatError(str(folder), expected, "no object")
        known = {name.partition("/")[0] for name in self._paths}
        self.classes: tuple[str, ...] = CLASSES if known <= set(CLASSES) else tuple(sorted(known))
        if len(self.classes) < 2:
            raise FormatError(str(folder), "objects of at least two classes", f"only {min(known)}")
        folders = Counter(name.replace("/", "-") for name in self._paths)
        duplicate = next((name for name, count in folders.items() if count > 1), None)
        if duplicate is not None:
            raise FormatError(str(folder), "names that differ with - for /", f"{duplicate} twice")
        self._splits = self._read_splits() or self._draw_splits()

    def names(self, split: Split) -> tuple[str, ...]:
        """List the names of a split's objects, in the order of classes."""
        return self._splits[split]

    def load(self, name: str) -> ObjectModel:
        """Load an object by name. Raises FormatError if it cannot be read, RangeError for an unknown name."""
        if name not in self._paths:
            raise RangeError("object", f"one of the {len(self._paths):,} in {self._root}", name)
        path, label = self._paths[name], self.classes.index(name.partition("/")[0])
        if self._synsets:
            path, folder = next((path / m for m in _MODELS if (path / m).is_file()), path / _MODELS[0]), path
        else:
            folder = path.parent
        return load_object(path, name, label, folder, self._max_triangles)

    def _find_shapenet_objects(self) -> dict[str, Path]:
        """Find folders of objects by name."""
        folders = {kind: _list_folder(synset) for kind, synset in self._synsets.items()}
        return {f"{kind}/{path.name}": path for kind, paths in folders.items() for path in paths if path.is_dir()}

    def _find_meshes_by_class(self) -> dict[str, Path]:
        """Find mesh files by name."""
        paths: dict[str, Path] = {}
        for folder in (path for path in _list_folder(self._root) if path.is_dir()):
            for path in _list_folder(folder):
                name = f"{folder.name}/{path.stem}"
                if path.suffix.lower() not in _SUFFIXES:
                    continue
                if name in paths:
                    raise FormatError(str(path), "one mesh per name", f"also {paths[name].name}")
                paths[name] = path
        return paths

    @cached_property
    def _aliases(self) -> dict[str, str]:
        """Names of objects by their names in lists: with the class, with the synset, or the hash alone."""
        aliases = {name: name for name in self._paths}
        for name in self._paths if self._synsets else ():
            kind, _, code = name.partition("/")
            aliases[f"{self._synsets[kind].name}/{code}"] = name
            aliases[code] = name
        return aliases

    def _read_splits(self) -> dict[Split, tuple[str, ...]] | None:
        """Read the splits from lists in the folder; None without lists."""
        path = self._root / "splits.json"
        if path.exists():
            lists = _check_lists(path, files.read_json(path))
        else:
            texts = {split: self._root / f"{split}.txt" for split in SPLITS}
            if not any(text.exists() for text in texts.values()):
                return None
            lines = {s: files.read_text(t).splitlines() if t.exists() else [] for s, t in texts.items()}
            lists = {split: [line.strip() for line in every if line.strip()] for split, every in lines.items()}
        owner: dict[str, Split] = {}
        for split in SPLITS:
            where = str(path) if path.exists() else str(self._root / f"{split}.txt")
            for entry in lists[split]:
                name = self._aliases.get(entry)
                if name is None:
                    raise FormatError(f"{where}: {split}", f"objects of {self._root}", repr(entry[:200]))
                if owner.setdefault(name, split) != split:
                    raise FormatError(f"{where}: {split}", "objects of no other split", repr(entry[:200]))
        return {
            split: self._sort_by_class([name for name, own in owner.items() if own == split]) for split in SPLITS
        }

    def _draw_splits(self) -> dict[Split, tuple[str, ...]]:
        """Draw splits at random."""
        splits: dict[Split, list[str]] = {split: [] for split in SPLITS}
        for kind in self.classes:
            own = sorted(name for name in self._paths if name.partition("/")[0] == kind)
            order = np.random.default_rng([self._seed, crc32(kind.encode())]).permutation(len(own))
            test, train, val = SHAPENET[kind][1] if self._synsets else (1, len(own), 0)
            if train + val + test > len(own):
                train, val = (round(share * len(own)) for share in _SHARES)
                test = len(own) - train - val
            ends = np.cumsum([0, train, val, test])
            for split, start, end in zip(SPLITS, ends[:-1], ends[1:], strict=True):
                splits[split] += [own[i] for i in order[start:end]]
        return {split: self._sort_by_class(names) for split, names in splits.items()}

    def _sort_by_class(self, names: Sequence[str]) -> tuple[str, ...]:
        return tuple(sorted(names, key=lambda name: (self.classes.index(name.partition("/")[0]), name)))


def _list_folder(folder: Path) -> list[Path]:
    """List a folder in order, without hidden files. Raises FormatError if it cannot be read."""
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise FormatError(str(folder), "a readable folder", (error.strerror or str(error)).lower()) from error


def _check_lists(path: Path, value: Any) -> dict[Split, list[str]]:
    """Check the contents of splits.json."""
    if not isinstance(value, dict) or not set(value) <= set(SPLITS):
        raise FormatError(str(path), f"lists by {', '.join(SPLITS)}", "another value")
    lists: dict[Split, list[str]] = {}
    for split in SPLITS:
        names = value.get(split, [])
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise FormatError(f"{path}: {split}", "a list of names", type(names).__name__)
        lists[split] = names
    return lists


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
