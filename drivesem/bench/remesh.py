"""Changes the number of triangles of a car's mesh."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from scene_ir.errors import RangeError
from scene_ir.meshes.lod import simplify
from scene_ir.types import Mesh

_PROPORTION = np.array([2.7, 1.0, 1.15])
"""Length and width of a typical car in units of its height, to measure edges on the car instead of the unit box.
"""


def set_triangle_count(mesh: Mesh, triangles: int) -> Mesh:
    """The mesh with `triangles` faces, or one fewer if that number is odd.

    Edges are collapsed, or the longest ones split at their middles, which preserves the surface. Closed surfaces
    stay closed.

    Raises:
        RangeError: Fewer than 4 triangles.
    """
    if triangles < 4:
        raise RangeError("triangles", "at least 4", triangles)
    mesh = simplify(mesh, triangles)
    while mesh.faces.shape[0] + 2 <= triangles:
        before = mesh.faces.shape[0]
        mesh = _split_edges(mesh, (triangles - before) // 2)
        if mesh.faces.shape[0] == before:
            break
    return mesh


def _split_edges(mesh: Mesh, most: int) -> Mesh:
    """Split at most `most` edges, the longest first, no two of the same face.

    Edges are identified by position: both sides of a colour seam are split together.
    """
    vertices, faces = mesh.vertices.double().numpy(), mesh.faces.numpy()
    positions = np.unique(vertices, axis=0, return_inverse=True)[1].reshape(-1)
    pairs: dict[tuple[int, int], list[tuple[int, int]]] = {}
    corners = positions[faces]
    for f, face in enumerate(corners.tolist()):
        for k in range(3):
            a, b = face[k], face[(k + 1) % 3]
            pairs.setdefault((min(a, b), max(a, b)), []).append((f, k))
    shared = [sides for sides in pairs.values() if len(sides) == 2]
    length = np.array([_length(vertices, faces, sides[0]) for sides in shared])
    used = np.zeros(len(faces), dtype=bool)
    chosen: list[list[tuple[int, int]]] = []
    for i in np.argsort(-length, kind="stable").tolist():
        sides = shared[i]
        if len(chosen) == most or used[[f for f, _ in sides]].any():
            continue
        used[[f for f, _ in sides]] = True
        chosen.append(sides)
    return _insert_middles(mesh, chosen)


def _length(vertices: NDArray[np.float64], faces: NDArray[np.int64], side: tuple[int, int]) -> float:
    f, k = side
    return float(np.linalg.norm((vertices[faces[f, k]] - vertices[faces[f, (k + 1) % 3]]) * _PROPORTION))


def _insert_middles(mesh: Mesh, edges: list[list[tuple[int, int]]]) -> Mesh:
    """Cut each edge's two faces (face, corner at which the edge begins) from its middle to the opposite corner."""
    faces, part = mesh.faces.clone(), mesh.part
    count, ends, owners, added = mesh.vertices.shape[0], [], [], []
    middles: dict[tuple[int, int], int] = {}
    for sides in edges:
        for f, k in sides:
            a, b, c = (int(faces[f, (k + j) % 3]) for j in range(3))
            key = (min(a, b), max(a, b))
            if key not in middles:
                middles[key] = count + len(ends)
                ends.append(key)
            middle = middles[key]
            faces[f] = torch.tensor([a, middle, c])
            added.append((middle, b, c))
            owners.append(f)
    if not edges:
        return mesh
    pair = torch.tensor(ends, dtype=torch.int64)

    def with_middles(values: torch.Tensor) -> torch.Tensor:
        return torch.cat([values, values[pair].mean(dim=1)])

    return Mesh(
        vertices=with_middles(mesh.vertices),
        faces=torch.cat([faces, torch.tensor(added, dtype=torch.int64)]),
        part=torch.cat([part, part[torch.tensor(owners, dtype=torch.int64)]]),
        name=mesh.name,
        colours=None if mesh.colours is None else with_middles(mesh.colours),
        uv=None if mesh.uv is None else with_middles(mesh.uv),
    )
