"""Objects that are known in full, instead of those that the package makes: boxes, balls and poles."""

from __future__ import annotations

import torch
import trimesh

from drivesem.classify.objects.types import ObjectModel
from scene_ir.errors import RangeError
from scene_ir.types import Mesh

KINDS = ("box", "ball", "pole")
_COUNTS = {"train": 6, "val": 2, "test": 2}
_COLOURS = {"box": (0.7, 0.15, 0.1), "ball": (0.1, 0.6, 0.2), "pole": (0.15, 0.2, 0.8)}


def solid(kind: str, number: int = 0) -> trimesh.Trimesh:
    stretch = 1 - 0.03 * number
    if kind == "box":
        return trimesh.creation.box((0.5 * stretch, 0.6, 1.0))
    if kind == "ball":
        return trimesh.creation.icosphere(subdivisions=2, radius=0.5).apply_scale((1, stretch, 1))
    return trimesh.creation.cylinder(0.12 * stretch, 1.0, sections=16).apply_transform(
        trimesh.transformations.rotation_matrix(torch.pi / 2, (1, 0, 0))
    )


def model(kind: str, number: int = 0) -> ObjectModel:
    mesh = solid(kind, number)
    faces = torch.tensor(mesh.faces, dtype=torch.int64)
    count = len(faces)
    return ObjectModel(
        f"{kind}/{number:04d}",
        KINDS.index(kind),
        Mesh(torch.tensor(mesh.vertices, dtype=torch.float32), faces, torch.zeros(count, dtype=torch.int64), kind),
        torch.tensor(_COLOURS[kind]).expand(count, 3).contiguous(),
        torch.full((count,), 0.2),
        torch.full((count,), 20.0),
    )


class StandIns:
    """An `ObjectSet`. broken: names that cannot be loaded."""

    classes = KINDS

    def __init__(self, broken: tuple[str, ...] = ()) -> None:
        self.broken = broken

    def names(self, split):
        first = {"train": 0, "val": 6, "test": 8}[split]
        return tuple(f"{kind}/{first + i:04d}" for kind in KINDS for i in range(_COUNTS[split]))

    def load(self, name):
        if name in self.broken:
            raise RangeError(f"{name}: mesh.vertices[0, 0]", "a finite value", "nan")
        kind, _, number = name.partition("/")
        return model(kind, int(number))
