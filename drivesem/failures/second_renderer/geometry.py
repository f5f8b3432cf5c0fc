"""Camera, poses and meshes of the second renderer: its own implementation of the conventions, in plain numpy."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from scene_ir.types import LATTICE, Camera, Mesh, Objects, Source

Array = NDArray[np.float32]

NEAR_M = 0.1
"""Triangles are clipped at this distance from the camera's plane before projection."""


@dataclass(frozen=True, slots=True)
class PictureCamera:
    """The camera that took an image."""

    intrinsics: Array
    """(3, 3) px."""
    shift_m: Array
    """(3,), from the origin of the conventions' axes to that of this camera."""
    height: int
    """Image height, px."""
    width: int
    """Image width, px."""

    @classmethod
    def from_camera(cls, camera: Camera) -> PictureCamera:
        """Split a projection into K (x + shift)."""
        matrix = to_numpy(camera.matrix).astype(np.float64)
        shift = np.linalg.solve(matrix[:, :3], matrix[:, 3])
        return cls(matrix[:, :3].astype(np.float32), shift.astype(np.float32), camera.height, camera.width)

    def project(self, points: Array) -> Array:
        """Project points (..., 3) m in the camera's own axes to (..., 2) px; points behind it are moved to its
        plane.
        """
        seen = points @ self.intrinsics.T
        return (seen[..., :2] / np.maximum(seen[..., 2:], NEAR_M)).astype(np.float32)

    def bounding_box(self, corners: Array) -> Array:
        """The tight box (4,) px of triangles (F, 3, 3) m, clipped at the near plane but not at the image border;
        NaN where all lie behind it.
        """
        start, end = corners, np.roll(corners, -1, axis=1)
        crosses = (start[..., 2] >= NEAR_M) != (end[..., 2] >= NEAR_M)
        a, b = start[crosses], end[crosses]
        cut = a + ((NEAR_M - a[:, 2]) / (b[:, 2] - a[:, 2]))[:, None] * (b - a)
        seen = self.project(np.concatenate([corners[corners[..., 2] >= NEAR_M], cut]).astype(np.float32))
        if not len(seen):
            return np.full(4, np.nan, np.float32)
        return np.concatenate([seen.min(axis=0), seen.max(axis=0)])


@dataclass(frozen=True, slots=True)
class VehiclePose:
    """One vehicle's pose, size and shape, as defined by the conventions."""

    translation: Array
    """(3,) m, centre of the bottom face."""
    yaw: float
    """Heading, rad."""
    size_lhw: Array
    """(3,) m, length, height and width."""
    lattice: Array
    """(64, 3) FFD offsets, fractions of the unit box."""

    @classmethod
    def from_objects(cls, objects: Objects, i: int) -> VehiclePose:
        return cls(
            to_numpy(objects.translation[i]),
            float(objects.yaw[i]),
            to_numpy(objects.size_lhw[i]),
            to_numpy(objects.ffd[i]),
        )

    @classmethod
    def from_source(cls, source: Source) -> VehiclePose:
        return cls(
            to_numpy(source.translation), float(source.yaw), to_numpy(source.size_lhw), to_numpy(source.ffd)
        )

    def rotation(self) -> Array:
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]], np.float32)


class BodyMesh:
    """A mesh, corner by corner: `unit` (F, 3, 3) in the unit box, `part` (F,) a `Part` each."""

    def __init__(self, mesh: Mesh) -> None:
        self._vertices = to_numpy(mesh.vertices)
        self._faces = mesh.faces.cpu().numpy()
        self._weights = _bernstein_weights(self._vertices)
        self.unit = self._vertices[self._faces]
        self.part = mesh.part.cpu().numpy()
        self.colours = None if mesh.colours is None else to_numpy(mesh.colours)[self._faces].mean(axis=1)

    def place(self, pose: VehiclePose, camera: PictureCamera, mirrored: bool = False) -> Array:
        """Place the mesh.

        Args:
            pose: Pose of the vehicle.
            camera: Camera.
            mirrored: Put each triangle where its counterpart on the vehicle's other side is.

        Returns:
            (F, 3, 3) m in the camera's own axes.
        """
        bent = self._vertices + self._weights @ pose.lattice
        if mirrored:
            # The lattice is nearly symmetric, so the deformed mesh's mirror image stands for the other side.
            bent = bent * np.array([1, 1, -1], np.float32)
        placed = (bent * pose.size_lhw) @ pose.rotation().T + pose.translation + camera.shift_m
        return placed.astype(np.float32)[self._faces]


def to_numpy(tensor: Tensor) -> Array:
    """Copy a tensor's values from any device."""
    return tensor.detach().cpu().numpy().astype(np.float32)


def _bernstein_weights(unit: Array) -> Array:
    """(V, 64): ordered by length, then height from the roof, then width."""
    at = unit + np.array([0.5, 1.0, 0.5], np.float32)
    axes = []
    for t, count in zip(at.T, LATTICE, strict=True):
        order = count - 1
        axes.append([math.comb(order, k) * t**k * (1 - t) ** (order - k) for k in range(count)])
    weights = [x * y * z for x in axes[0] for y in axes[1] for z in axes[2]]
    return np.stack(weights, axis=1).astype(np.float32)
