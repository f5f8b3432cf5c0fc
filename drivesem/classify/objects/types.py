"""An object with its class and its materials, and a set of objects in three splits."""

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
"""The paper's classes in its order: an object's label is its class's place here, unless its set says otherwise."""


@dataclass(frozen=True, slots=True)
class ObjectModel:
    """One object of a class.

    name: of the object in its set, "bus/0007". label: its class's place in the set's classes. mesh: vertices
    (V, 3) float32, centred, longest side 1, y up, the front towards -z, as ShapeNetCore v2 has it (not the unit
    box of vehicles); faces (F, 3), counter-clockwise seen from outside. diffuse (F, 3): linear RGB in [0, 1];
    specular (F,) in [0, 1]; shininess (F,), Phong's exponent, at least 0: float32, one a face.
    Raises ShapeError for a shape or type, or no faces, RangeError for a value, naming the object.
    """

    name: str
    label: int
    mesh: Mesh
    diffuse: Tensor
    specular: Tensor
    shininess: Tensor

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


def used(mesh: Mesh) -> Mesh:
    """The mesh without vertices that no face has, which nothing draws and an attack would move all the same."""
    places, faces = torch.unique(mesh.faces, return_inverse=True)
    return replace(mesh, vertices=mesh.vertices[places], faces=faces)


def object_model(
    name: str, label: int, vertices: NDArray[np.floating], faces: NDArray[np.integer], looks: NDArray[np.float64]
) -> ObjectModel:
    """The object of vertices (V, 3), faces (F, 3), and their linear RGB, specular share and exponent (F, 5)."""
    corners, sides = torch.from_numpy(vertices.astype(np.float32)), torch.from_numpy(faces.astype(np.int64))
    table = torch.from_numpy(looks.astype(np.float32))
    mesh = used(Mesh(corners, sides, torch.full((len(faces),), int(Part.OTHER)), name))
    return ObjectModel(name, label, mesh, table[:, :3].contiguous(), table[:, 3], table[:, 4])


class ObjectSet(Protocol):
    """Objects by name, in three splits that share none."""

    classes: tuple[str, ...]
    """Names of the classes, in the order of labels."""

    def names(self, split: Split) -> tuple[str, ...]:
        """Names of a split's objects, in the order of classes."""
        ...

    def load(self, name: str) -> ObjectModel:
        """The object of that name, the same each time. Raises FormatError where it cannot be read, RangeError for
        a name that the set does not have.
        """
        ...
