"""Vehicles placed at random in front of a camera, rendered by this and other renderers."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_ir.geometry import place_vertices, to_clip
from scene_ir.meshes.lod import simplify
from scene_ir.meshes.templates import template, typical_size_lhw
from scene_ir.raster import verbs

HEIGHT, WIDTH, FOCAL = 90, 200, 150.0
KINDS = ("sedan", "van", "pickup", "bus", "truck", "hatchback")
STEP_SHARE = 0.02
"""Neighbouring depths that differ by a larger share than this belong to two surfaces."""


@dataclass(frozen=True, slots=True)
class Crowd:
    """Vehicles in camera space (x right, y down, z forward): points (V, 3) m and faces (F, 3) of each; intrinsics
    (3, 3) px with pixel centres at integers."""

    points: tuple[Tensor, ...]
    faces: tuple[Tensor, ...]
    intrinsics: Tensor

    def packed(self) -> tuple[Tensor, Tensor]:
        """Clip coordinates and faces of all vehicles together."""
        starts = np.cumsum([0, *(len(p) for p in self.points)])
        faces = torch.cat([f + int(s) for f, s in zip(self.faces, starts[:-1], strict=True)])
        matrix = torch.cat([self.intrinsics, torch.zeros(3, 1)], dim=1)
        return to_clip(torch.cat(self.points), matrix), faces

    def render_depth(self, cull: bool) -> NDArray[np.float32]:
        """Depth (H, W) m by the fast backend, inf where nothing is hit."""
        clip, faces = self.packed()
        layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, WIDTH, HEIGHT]]))
        found = verbs.rasterize(clip, faces, torch.tensor([[0, len(faces)]]), layout, cull=cull)
        return found.depth.view(HEIGHT, WIDTH).numpy()


@pytest.fixture(scope="session")
def crowd() -> Callable[[int], Crowd]:
    """Six vehicles for a seed: they hide one another, are cut by the border, and one stands next to the camera."""
    meshes = [simplify(template(kind), 1500) for kind in KINDS]

    def build(seed: int) -> Crowd:
        generator = torch.Generator().manual_seed(seed)
        points = []
        for i, (kind, mesh) in enumerate(zip(KINDS, meshes, strict=True)):
            u, v, w = torch.rand(3, generator=generator).tolist()
            z = 9.0 + 35.0 * w
            x = (2.0 * u - 1.0) * 0.8 * z
            yaw = 2 * math.pi * torch.rand(1, generator=generator)
            if i == len(KINDS) - 1:  # cut by the near plane, or just not
                x, z, yaw = 1.8 + u, 0.5 + 3.0 * w, math.pi / 2 + 0.1 * torch.rand(1, generator=generator)
            size = torch.tensor([typical_size_lhw(kind)])
            centre = torch.tensor([[x, 1.65 + 0.4 * v, z]])
            points.append(place_vertices(mesh.vertices.to(torch.float32)[None], size, yaw, centre)[0])
        intrinsics = torch.tensor([[FOCAL, 0, WIDTH / 2 - 0.3], [0, FOCAL, HEIGHT * 0.4], [0, 0, 1]])
        return Crowd(tuple(points), tuple(m.faces for m in meshes), intrinsics)

    return build


def near_outlines(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Pixels (H, W) with one of eight neighbours on another surface, or empty where they are not."""
    far = np.where(np.isfinite(depth), depth, 1e6)
    square = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(far, square), cv2.dilate(far, square)
    return high > low * (1.0 + STEP_SHARE)


@pytest.fixture
def outlines() -> Callable[[NDArray[np.float32]], NDArray[np.bool_]]:
    """Pixels within one pixel of another surface."""
    return near_outlines


@pytest.fixture
def inner_pixels() -> Callable[..., NDArray[np.bool_]]:
    """Compare the silhouettes of two depth maps outside a band; returns the common pixels outside it."""

    def compare(
        ours: NDArray[np.float32], theirs: NDArray[np.float32], band: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        hit = np.isfinite(theirs)
        assert 0.05 < hit.mean() < 0.98
        assert not ((np.isfinite(ours) != hit) & ~band).any()
        assert (hit & ~band).sum() > 500
        return hit & ~band

    return compare
