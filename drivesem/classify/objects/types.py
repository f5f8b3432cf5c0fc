"""An object with its class and materials, and the interface of a set of objects in three splits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_ir.errors import RangeError, ShapeError
from scene_ir.types import Mesh, Part, check_finite, check_shape

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = ("train", "val", "test")

CLASSES = (
    *("airplane", "bench", "trashcan", "bus", "car", "helmet"),
    *("mailbox", "motorcycle", "skateboard", "tower", "train", "boat"),
)
"""The paper's classes in its order; labels are indices into it, unless a set has its own classes."""


@dataclass(frozen=True, slots=True)
class ObjectModel:
    """One object of a class. Raises ShapeError or RangeError for bad values."""

    name: str
    """Name in its set, such as "bus/0007"."""
    label: int
    """Index of its class in the set's classes."""
    mesh: Mesh
    """Vertices (V, 3) float32, centred, longest side 1, y up, front towards -z as in ShapeNetCore v2; faces (F, 3)
    counter-clockwise seen from outside."""
    diffuse: Tensor
    """Linear RGB of each face (F, 3) float32, in [0, 1]."""
    specular: Tensor
    """Specular reflectance of each face (F,) float32, in [0, 1]."""
    shininess: Tensor
    """Phong exponent of each face (F,) float32, at least 0."""

    def __post_init__(self) -> None:
        if self.label < 0:
            raise RangeError(f"{self.name}: label", "at least 0", self.label)
        count = self.mesh.faces.shape[0]
        if count == 0:
            raise ShapeError(f"{self.name}: mesh.faces", "at least one face", "none")
        for field, values, shape, most in (
            ("diffuse", self.diffuse, (count, 3), 1.0),
            ("specular", self.specular, (count,), 1.0),
            ("shininess", self.shininess, (count,), float("inf")),
        ):
            check_shape(f"{self.name}: {field}", values, *shape)
            check_finite(f"{self.name}: {field}", values)
            low, high = float(values.min()), float(values.max())
            if low < 0 or high > most:
                expected = "at least 0" if most == float("inf") else "values in [0, 1]"
                raise RangeError(f"{self.name}: {field}", expected, low if low < 0 else high)

    def vertex_parts(self) -> Tensor:
        """Mesh part of each vertex (V,) int64: the first of its faces' materials, as meshes are divided in files."""
        kinds = torch.cat([self.diffuse, self.specular[:, None], self.shininess[:, None]], dim=1)
        part = torch.unique(kinds, dim=0, return_inverse=True)[1]
        faces, parts = self.mesh.faces, part.new_full((len(self.mesh.vertices),), len(kinds))
        return parts.scatter_reduce(0, faces.reshape(-1), part.repeat_interleave(3), "amin")


def drop_unused_vertices(mesh: Mesh) -> Mesh:
    """Drop vertices without faces, which are invisible but would be attacked."""
    used, faces = torch.unique(mesh.faces, return_inverse=True)
    return replace(mesh, vertices=mesh.vertices[used], faces=faces)


def make_object_model(
    name: str,
    label: int,
    vertices: NDArray[np.floating],
    faces: NDArray[np.integer],
    materials: NDArray[np.float64],
) -> ObjectModel:
    """Make an object.

    Args:
        name: Its name.
        label: Index of its class.
        vertices: Vertices (V, 3).
        faces: Faces (F, 3).
        materials: Linear RGB, specular reflectance and Phong exponent of each face (F, 5).
    """
    corners, sides = torch.from_numpy(vertices.astype(np.float32)), torch.from_numpy(faces.astype(np.int64))
    table = torch.from_numpy(materials.astype(np.float32))
    mesh = drop_unused_vertices(Mesh(corners, sides, torch.full((len(faces),), int(Part.OTHER)), name))
    return ObjectModel(name, label, mesh, table[:, :3].contiguous(), table[:, 3], table[:, 4])


class ObjectSet(Protocol):
    """Objects by name in three disjoint splits."""

    classes: tuple[str, ...]
    """Names of the classes, in the order of labels."""

    def names(self, split: Split) -> tuple[str, ...]:
        """List the names of a split's objects, in the order of classes."""
        ...

    def load(self, name: str) -> ObjectModel:
        """Load an object by name. Raises FormatError if it cannot be read, RangeError for an unknown name."""
        ...
