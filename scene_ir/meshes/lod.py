"""Levels of detail: fewer triangles of the same surface, by a vehicle's size in pixels."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_ir.errors import RangeError
from scene_ir.meshes.collapse import collapse
from scene_ir.types import Mesh

Array = NDArray[np.float64]

_PROPORTION = np.array([2.7, 1.0, 1.15])
"""Length and width of a typical car in units of its height: errors are the car's, not its unit box's."""
_SEAM = 0.1
"""Weight of borders between parts or colours against the surface's shape. At 4, the outline of a car of 800 triangles
is off by 0.28 % of its height on average, at 0.1 by 0.18 %; windows and lights still keep their shape."""
_TRIANGLES_PER_PX = 16
"""Triangles per pixel of height: outlines are then off by less than 0.1 px on average, and 99 % of an outline by less
than about 0.5 px. `tools/measure_detail.py` measures this."""
_MIN_TRIANGLES = 256
"""Coarser levels lose wheels and mirrors."""
_MAX_EDGE = 1.0
"""Longest edge, in heights. Deformed by 0.05 of its box, a bus of 1,000 triangles has two thirds of the outline error
that it has without a limit; cars gain nothing, and lose by shorter ones."""


def level_of_detail(mesh: Mesh, height_px: float) -> Mesh:
    """The mesh with as many triangles as a vehicle of `height_px` pixels in the image needs.

    The mesh itself if it has no more than that; else one of few levels, a factor of 1.4 apart. Recent levels are
    cached: meshes of equal content give the same object. See `simplify` for what is preserved. Raises RangeError if
    the height is negative or not a number.
    """
    if not height_px >= 0:
        raise RangeError("height_px", "at least 0", height_px)
    count = mesh.faces.shape[0]
    wanted = max(_TRIANGLES_PER_PX * height_px, float(_MIN_TRIANGLES))
    if count <= wanted:
        return mesh
    level = math.ceil(2 ** (math.ceil(2 * math.log2(wanted)) / 2))
    return mesh if count <= level else _cached_level(_HashedMesh(_mesh_digest(SameMesh(mesh)), mesh), level)


@dataclass(frozen=True, slots=True, eq=False)
class SameMesh:
    """A mesh as a cache's key: equal to the same object only."""

    mesh: Mesh
    """The mesh, which stays alive while the cache holds it."""

    def __hash__(self) -> int:
        return id(self.mesh)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SameMesh) and self.mesh is other.mesh


@dataclass(frozen=True, slots=True)
class _HashedMesh:
    """A mesh that equals others of the same digest."""

    digest: bytes
    mesh: Mesh = field(compare=False)


@lru_cache(maxsize=64)
def _mesh_digest(key: SameMesh) -> bytes:
    mesh = key.mesh
    known = hashlib.blake2b(mesh.name.encode(), digest_size=16)
    for values in (mesh.vertices, mesh.faces, mesh.part, mesh.colours, mesh.uv):
        if values is None:
            known.update(b"none")
        else:
            known.update(f"{values.device} {values.dtype} {tuple(values.shape)}".encode())
            known.update(values.detach().cpu().contiguous().numpy().tobytes())
    return known.digest()


@lru_cache(maxsize=256)
def _cached_level(content: _HashedMesh, triangles: int) -> Mesh:
    return simplify(content.mesh, triangles, _MAX_EDGE)


def simplify(mesh: Mesh, triangles: int, longest: float = math.inf) -> Mesh:
    """Simplify a mesh, deterministically.

    Closed surfaces stay closed, two faces per edge; faces preserve their parts, and corners the colours and uv of
    corners of that part; the bounds stay. A mesh that is small enough, or has degenerate faces only, is returned
    unchanged.

    Args:
        mesh: The mesh.
        triangles: Number of faces to reach, as far as the topology allows; at least 4.
        longest: No longer edge is created, in heights of a typical car, so that large panels can still bend.

    Returns:
        The simplified mesh.

    Raises:
        RangeError: `triangles` or `longest` is too small.
    """
    if triangles < 4:
        raise RangeError("triangles", "at least 4", triangles)
    if not longest > 0:
        raise RangeError("longest", "more than 0", longest)
    if mesh.faces.shape[0] <= triangles:
        return mesh
    columns = _column_arrays(mesh.vertices)
    corners = mesh.faces.cpu().numpy()
    first, point = _unique_rows(columns)
    faces = point[corners]
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    if not proper.any():
        return mesh
    points = np.stack(columns, axis=1)[first]
    # corners appearance alike where part, colour and uv are the same
    attributes = [c for values in (mesh.colours, mesh.uv) if values is not None for c in _column_arrays(values)]
    example, appearance = _unique_rows(attributes or [np.zeros(len(point))])
    parts, part = np.unique(mesh.part.cpu().numpy(), return_inverse=True)
    labels = appearance[corners] * len(parts) + part[:, None]
    used = np.zeros(len(points), dtype=bool)
    used[faces[proper]] = True
    bounds = np.stack([points[used].min(axis=0), points[used].max(axis=0)])
    scaled = bounds * _PROPORTION
    done = collapse(points * _PROPORTION, faces[proper], labels[proper], scaled, triangles, longest, _SEAM)
    count = len(example) * len(parts)
    pairs, vertex = np.unique(done.faces.astype(np.int64) * count + done.labels, return_inverse=True)
    moved = done.points[pairs // count]
    # to the bit, which dividing again would not give
    moved = np.where(moved == scaled[0], bounds[0], np.where(moved == scaled[1], bounds[1], moved / _PROPORTION))
    source = torch.from_numpy(example[pairs % count // len(parts)])
    faces_left = torch.from_numpy(np.flatnonzero(proper)[done.faces_left])
    return Mesh(
        vertices=torch.from_numpy(moved).to(mesh.vertices),
        faces=torch.from_numpy(vertex.reshape(-1, 3)).to(mesh.faces),
        part=mesh.part[faces_left.to(mesh.part.device)],
        name=mesh.name,
        colours=None if mesh.colours is None else mesh.colours.detach()[source.to(mesh.colours.device)],
        uv=None if mesh.uv is None else mesh.uv.detach()[source.to(mesh.uv.device)],
    )


def _unique_rows(columns: Sequence[Array]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Index of one row of each distinct kind (K,), and each row's kind (n,), of a table given by its columns (n,).

    As numpy.unique along an axis, but several times as fast.
    """
    order = np.lexsort(columns)
    new = np.zeros(len(order), dtype=bool)
    new[0] = True
    for column in columns:
        ordered = column[order]
        new[1:] |= ordered[1:] != ordered[:-1]
    kind = np.empty(len(order), dtype=np.int64)
    kind[order] = np.cumsum(new) - 1
    return order[new], kind


def _column_arrays(values: Tensor) -> list[Array]:
    return list(values.detach().cpu().double().numpy().T)
