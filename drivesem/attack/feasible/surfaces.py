"""The points of cars' meshes that carry their extents, and how lattice offsets move them."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import ConvexHull, QhullError

from drivesem.attack.feasible.cars import Array, Indices, Values, array
from scene_ir import ffd
from scene_ir.types import LATTICE, LATTICE_POINTS, Mesh, SceneIR

_SURFACE_POINTS = 160
"""At most this many mesh vertices, besides the convex hull's, carry a car's extents."""
_SLICE = LATTICE[1] * LATTICE[2]
"""Lattice points in a slice across the length."""


class CarSurfaces:
    """The points of N cars' meshes that carry their extents, in m of the cars' own frames.

    offsets (N, 64, 3): of the scene as photographed; rest (N, 3, K): where the points are then.
    """

    def __init__(self, scene: SceneIR) -> None:
        chosen = {index: surface_points(scene.meshes[index]) for index in set(scene.objects.mesh_index.tolist())}
        most = max(len(points) for points in chosen.values())
        units: dict[int, Array] = {}
        along: dict[int, Array] = {}
        across: dict[int, Array] = {}
        for index, points in chosen.items():
            # All as many as the most: the last point again changes no extents.
            padded = np.concatenate([points, np.repeat(points[-1:], most - len(points), axis=0)])
            weights = ffd.lattice_weights(torch.from_numpy(padded)).numpy().reshape(most, LATTICE[0], _SLICE)
            # Either factor of the weights sums to 1. Apart they take a third of the memory, and of the time.
            units[index], along[index], across[index] = padded.T, weights.sum(axis=2).T, weights.sum(axis=1).T
        owners = scene.objects.mesh_index.tolist()
        # `stack` keeps the transposed order, with which the products take three times as long.
        self._unit, self._along, self._across = (
            np.ascontiguousarray(np.stack([part[i] for i in owners])) for part in (units, along, across)
        )
        self._size = array(scene.objects.size_lhw)[:, :, None]
        self.offsets = array(scene.objects.ffd)
        self.rest = self._bent(self.offsets, slice(None))

    def deformed(self, mesh: Values, rows: Indices | slice = slice(None)) -> Array:
        """The points (M, 3, K) m of cars `rows` under mesh codes (M, 96)."""
        return self._bent(self.offsets[rows] + _offsets(mesh), rows)

    def _bent(self, offsets: Array, rows: Indices | slice) -> Array:
        slices = offsets.swapaxes(1, 2).reshape(len(offsets), -1, _SLICE) @ self._across[rows]
        slices = slices.reshape(len(offsets), 3, LATTICE[0], -1)
        moved = np.einsum("ncik,nik->nck", slices, self._along[rows])
        return (self._unit[rows] + moved) * self._size[rows]


def surface_points(mesh: Mesh) -> Array:
    """Vertices (K, 3) of the unit box that carry the extents."""
    vertices = mesh.vertices.detach().cpu().double().numpy()
    try:
        chosen = set(ConvexHull(vertices).vertices.tolist())
    except QhullError:  # a flat mesh has no hull with a volume; its vertices do as well
        chosen = set()
    stride = max(1, -(-len(vertices) // _SURFACE_POINTS))
    return vertices[sorted(chosen | set(range(0, len(vertices), stride)))]


def extents(surface: Array) -> tuple[Array, Array]:
    """Bounds (N, 3), (N, 3) of points (N, 3, K)."""
    return surface.min(axis=2), surface.max(axis=2)


def _offsets(mesh: Values) -> Array:
    """Lattice offsets (N, 64, 3) of symmetric codes (N, 96), as `ffd.from_symmetric`, without its detour."""
    half = mesh.astype(np.float64).reshape(len(mesh), LATTICE[0], LATTICE[1], LATTICE[2] // 2, 3)
    mirror = half[:, :, :, ::-1] * [1.0, 1.0, -1.0]
    return np.concatenate([half, mirror], axis=3).reshape(len(mesh), LATTICE_POINTS, 3)


def lowest(mesh: Values) -> Values:
    """The vertical offsets (N, 4, 2) of the lowest lattice layer: a view into symmetric codes (N, 96)."""
    return mesh.reshape(len(mesh), LATTICE[0], LATTICE[1], LATTICE[2] // 2, 3)[:, :, -1, :, 1]
