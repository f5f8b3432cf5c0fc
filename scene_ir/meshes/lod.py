"""Levels of detail: edges collapse in the order of their quadric error (Garland and Heckbert 1997)."""

from __future__ import annotations

import heapq

import numpy as np
import torch
from numpy.typing import NDArray

from scene_ir.errors import RangeError
from scene_ir.types import Mesh

_PROPORTION = np.array([2.7, 1.0, 1.15])
"""Length and width of a typical car in units of its height: errors are the car's, not its unit box's."""
_SEAM = 4.0
"""Weight of the planes that hold borders between parts or colours in place, against the faces' own planes."""
_MIN_COSINE = 0.1
"""A face may turn by no more than this allows (cosine between old and new normal) in one collapse."""


def simplify(mesh: Mesh, triangles: int) -> Mesh:
    """The mesh with about `triangles` faces (at most, as far as its topology allows), deterministic.

    Closed surfaces stay closed, two faces an edge; every face keeps its part and its corners' colours and uv; the
    bounds stay the mesh's. A mesh that is small enough comes back as it is. Raises RangeError for triangles < 4.
    """
    if triangles < 4:
        raise RangeError("triangles", "at least 4", triangles)
    if mesh.faces.shape[0] <= triangles:
        return mesh
    vertices = mesh.vertices.detach().cpu().double().numpy()
    positions, inverse = np.unique(vertices, axis=0, return_inverse=True)
    corners = mesh.faces.cpu().numpy()
    labels = _corner_labels(mesh)
    faces = inverse.reshape(-1)[corners]
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    kept = np.nonzero(proper)[0]
    work = _Collapser(positions * _PROPORTION, faces[kept], _seams(faces[kept], labels[kept]))
    work.run(triangles)
    alive = np.nonzero(work.alive)[0]
    moved = work.positions / _PROPORTION
    pairs = np.stack([work.faces[alive].reshape(-1), labels[kept[alive]].reshape(-1)], axis=1)
    unique, index = np.unique(pairs, axis=0, return_inverse=True)
    origin = np.zeros(int(labels.max()) + 1, dtype=np.int64)
    origin[labels.reshape(-1)[::-1]] = corners.reshape(-1)[::-1]
    source = torch.from_numpy(origin[unique[:, 1]])
    return Mesh(
        vertices=torch.from_numpy(_refit(moved[unique[:, 0]], vertices)).to(mesh.vertices.dtype),
        faces=torch.from_numpy(index.reshape(-1, 3).astype(np.int64)),
        part=mesh.part.cpu()[torch.from_numpy(kept[alive])],
        name=mesh.name,
        colours=None if mesh.colours is None else mesh.colours.cpu()[source],
        uv=None if mesh.uv is None else mesh.uv.cpu()[source],
    )


def _corner_labels(mesh: Mesh) -> NDArray[np.int64]:
    """A number (F, 3) for each corner's combination of part, colour and uv."""
    corners = mesh.faces.cpu().numpy()
    columns = [mesh.part.cpu().numpy().repeat(3)[:, None].astype(np.float64)]
    for values in (mesh.colours, mesh.uv):
        if values is not None:
            columns.append(values.detach().cpu().double().numpy()[corners.reshape(-1)])
    return np.unique(np.concatenate(columns, axis=1), axis=0, return_inverse=True)[1].reshape(-1, 3)


def _refit(points: NDArray[np.float64], original: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points stretched along each axis so that their bounds are the original's again."""
    low, high = points.min(axis=0), points.max(axis=0)
    target_low, target_high = original.min(axis=0), original.max(axis=0)
    span = np.where(high > low, high - low, 1.0)
    share = np.where(high > low, (points - low) / span, 0.0)
    return target_low * (1 - share) + target_high * share


def _edges(faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All faces' edges (3 F, 2), lower vertex first, and the face each belongs to (3 F,)."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return edges, np.arange(len(faces)).repeat(3)


def _seams(faces: NDArray[np.int64], labels: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which of `_edges` lie between faces of different labels, or at an open border."""
    edges, face = _edges(faces)
    _, group, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    kind = labels.min(axis=1)[face]
    low, high = np.full(len(count), np.iinfo(np.int64).max), np.full(len(count), -1)
    np.minimum.at(low, group, kind)
    np.maximum.at(high, group, kind)
    return ((low != high) | (count != 2))[group]


class _Collapser:
    """Collapses edges, cheapest first, keeping the surface's topology. positions (P, 3); faces (F, 3) int64."""

    def __init__(self, positions: NDArray[np.float64], faces: NDArray[np.int64], seams: NDArray[np.bool_]) -> None:
        self.positions = positions.copy()
        self.faces = faces.copy()
        self.alive = np.ones(len(faces), dtype=bool)
        self._quadrics = self._initial_quadrics(seams)
        self._around: list[set[int]] = [set() for _ in positions]
        for f, face in enumerate(faces.tolist()):
            for v in face:
                self._around[v].add(f)
        self._version = [0] * len(positions)
        self._heap: list[tuple[float, int, int, int, int]] = []

    def _initial_quadrics(self, seams: NDArray[np.bool_]) -> NDArray[np.float64]:
        """(P, 4, 4) sums of the planes' outer products around each vertex, weighted by area."""
        corner = self.positions[self.faces]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        area = np.linalg.norm(normal, axis=1, keepdims=True) / 2
        unit = normal / np.maximum(2 * area, 1e-12)
        quadrics = np.zeros((len(self.positions), 4, 4))
        plane = np.concatenate([unit, -np.einsum("ij,ij->i", unit, corner[:, 0])[:, None]], axis=1)
        outer = plane[:, :, None] * plane[:, None, :] * area[:, :, None]
        for k in range(3):
            np.add.at(quadrics, self.faces[:, k], outer)
        # a plane through each seam, upright on its face
        edges, face = _edges(self.faces)
        edges, face = edges[seams], face[seams]
        along = self.positions[edges[:, 1]] - self.positions[edges[:, 0]]
        across = np.cross(along, unit[face])
        length = np.linalg.norm(across, axis=1, keepdims=True)
        across = across / np.maximum(length, 1e-12)
        offset = -np.einsum("ij,ij->i", across, self.positions[edges[:, 0]])[:, None]
        plane = np.concatenate([across, offset], axis=1)
        outer = _SEAM * plane[:, :, None] * plane[:, None, :] * (length**2)[:, :, None]
        for k in range(2):
            np.add.at(quadrics, edges[:, k], outer)
        return quadrics

    def run(self, triangles: int) -> None:
        """Collapse until at most `triangles` faces are left or no edge may go."""
        edges = np.unique(_edges(self.faces)[0], axis=0)
        for a, b in edges.tolist():
            self._push(a, b)
        left = len(self.faces)
        while left > triangles and self._heap:
            _, a, b, version_a, version_b = heapq.heappop(self._heap)
            if (version_a, version_b) == (self._version[a], self._version[b]) and self._allowed(a, b):
                left -= self._collapse(a, b)

    def _best(self, a: int, b: int) -> tuple[float, NDArray[np.float64]]:
        """Least error and place of the vertex that replaces a and b: one of them, or their middle."""
        quadric = self._quadrics[a] + self._quadrics[b]
        pa, pb = self.positions[a], self.positions[b]
        points = np.ones((3, 4))
        points[0, :3], points[1, :3], points[2, :3] = pa, pb, (pa + pb) / 2
        errors = np.einsum("ki,ij,kj->k", points, quadric, points)
        best = int(np.argmin(errors))
        # a trace of the edge's length orders the collapses within flat regions
        return float(errors[best]) + 1e-9 * float(np.sum((pa - pb) ** 2)), points[best, :3]

    def _push(self, a: int, b: int) -> None:
        a, b = min(a, b), max(a, b)
        heapq.heappush(self._heap, (self._best(a, b)[0], a, b, self._version[a], self._version[b]))

    def _neighbours(self, v: int) -> set[int]:
        return {int(u) for f in self._around[v] for u in self.faces[f]} - {v}

    def _allowed(self, a: int, b: int) -> bool:
        """Whether collapsing the edge keeps the surface a manifold (link condition) and turns no face over."""
        shared = self._around[a] & self._around[b]
        opposite = {int(u) for f in shared for u in self.faces[f]} - {a, b}
        if not shared or len(shared) > 2 or self._neighbours(a) & self._neighbours(b) != opposite:
            return False
        if len(shared) == 2 and self._open(a) and self._open(b):
            return False
        known = {frozenset(self.faces[f].tolist()) for f in self._around[a] - shared}
        for f in self._around[b] - shared:
            if frozenset(a if u == b else u for u in self.faces[f].tolist()) in known:
                return False
        target = self._best(a, b)[1]
        rest = np.array(sorted((self._around[a] | self._around[b]) - shared), dtype=np.int64)
        if len(rest) == 0:
            return False
        before = self.positions[self.faces[rest]]
        moving = (self.faces[rest] == a) | (self.faces[rest] == b)
        after = np.where(moving[..., None], target, before)
        old = np.cross(before[:, 1] - before[:, 0], before[:, 2] - before[:, 0])
        new = np.cross(after[:, 1] - after[:, 0], after[:, 2] - after[:, 0])
        scale = np.linalg.norm(old, axis=1) * np.linalg.norm(new, axis=1)
        return bool(np.all(np.einsum("ij,ij->i", old, new) > _MIN_COSINE * scale))

    def _open(self, v: int) -> bool:
        """Whether a vertex lies at an open border."""
        count: dict[int, int] = {}
        for f in self._around[v]:
            for u in self.faces[f].tolist():
                count[u] = count.get(u, 0) + 1
        return any(n == 1 for u, n in count.items() if u != v)

    def _collapse(self, a: int, b: int) -> int:
        """Replace b by a, moved to the best place; returns how many faces went."""
        target = self._best(a, b)[1]
        shared = self._around[a] & self._around[b]
        for f in shared:
            self.alive[f] = False
            for u in self.faces[f].tolist():
                self._around[u].discard(f)
        for f in self._around[b]:
            self.faces[f][self.faces[f] == b] = a
        self._around[a] |= self._around[b]
        self._around[b] = set()
        self.positions[a] = target
        self._quadrics[a] += self._quadrics[b]
        self._version[a] += 1
        self._version[b] += 1
        for u in sorted(self._neighbours(a)):
            self._push(a, u)
        return len(shared)
