"""pyrender: OpenGL's z-buffer and glTF's shading, in the same unseen window as photographs' second renderer.

Its lights lack a sky, and its materials a strength of gloss. So a picture is the sum of three: the lamp on matt
surfaces, the lamp on mirrors as rough as Phong's lobe is wide and as strong as it is high, and the light from all
around, corner by corner.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch

from drivesem.classify.redraw.base import Array, Solid
from drivesem.failures.second_renderer.opengl import ImageWindow, PaintLayer, shared_context
from scene_ir.render.lit_mesh import GAMMA, MIRRORED_SHARE, UPWARD_SHARE

_MATT = 0.96**2
"""Of a colour glTF's shading lets so much show of what is neither metal nor glossy, in pyrender's version."""


class PyrenderRenderer:
    """`Redraw` by pyrender. Raises NoSecondRendererError where there is neither EGL nor OSMesa."""

    name = "pyrender"

    def __init__(self) -> None:
        self._screen = shared_context()

    def draw(self, solid: Solid) -> torch.Tensor:
        """See `Redraw`."""
        lights, size = solid.lights, (solid.camera.height, solid.camera.width)
        window = ImageWindow(0, 0, size[1], size[0])
        intrinsics = solid.camera.matrix.numpy()[:3, :3]
        intensity = math.pi * float(lights.strength) * lights.reach**2
        diffuse, specular, shininess = (
            np.repeat(values, 3, axis=0) for values in (solid.diffuse, solid.specular, solid.shininess)
        )
        around = float(lights.environment) * (1 - UPWARD_SHARE * solid.normals[:, 1:2])
        sky = np.clip((diffuse + MIRRORED_SHARE * specular[:, None]) * around, 0, 1)
        matt = [PaintLayer(solid.points, solid.normals, diffuse / np.float32(_MATT), 1.0, 0.0)]
        bare = [PaintLayer(solid.points, solid.normals, (sky**GAMMA).astype(np.float32), 1.0, 0.0)]
        glossy = []
        for exponent in np.unique(shininess):
            own = shininess == exponent
            height = np.repeat(specular[own, None] * 8 / (exponent + 2), 3, axis=1)
            rough = float((2 / (exponent + 2)) ** 0.25)
            glossy.append(PaintLayer(solid.points[own], solid.normals[own], height.astype(np.float32), rough, 1.0))
        lamp = lights.point.numpy(), intensity
        drawn = [
            self._screen.shade(coats, light, intrinsics, window)
            for coats, light in ((matt, lamp), (glossy, lamp), (bare, None))
        ]
        coverage = drawn[0][..., 3:]
        # A pixel's samples are averaged after gamma, background and all.
        linear = sum((image[..., :3] / np.maximum(coverage, 1e-6)) ** (1 / GAMMA) for image in drawn)
        colour = np.minimum(linear, 1) ** GAMMA
        both = np.concatenate([colour * coverage, coverage], axis=2).astype(np.float32)
        seen: Array = np.asarray(cv2.resize(both, (size[1], size[0]), interpolation=cv2.INTER_AREA), np.float32)
        seen[..., :3] /= np.maximum(seen[..., 3:], 1e-6)
        return torch.from_numpy(seen).permute(2, 0, 1).contiguous()
