"""What a second renderer is given of an object's picture, and what it gives back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from drivesem.classify.results import Likeness
from drivesem.classify.scenes import SEEN_PX, ObjectScene, camera
from drivesem.classify.space import Change
from scene_ir.render.lit_mesh import Lights
from scene_ir.types import Camera

Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Solid:
    """An object as it stands before the camera: points, normals (3F, 3), corner by corner, in camera space (x
    right, y down, z forward), each face wound and each normal turned towards the side that is seen; diffuse (F, 3)
    linear, specular (F,), shininess (F,).
    """

    points: Array
    normals: Array
    diffuse: Array
    specular: Array
    shininess: Array
    lights: Lights
    camera: Camera

    @classmethod
    @torch.no_grad()
    def of(cls, scene: ObjectScene, change: Change | None = None) -> Solid:
        """An object, with a change."""
        model = scene.model
        corners, normals, away = scene.mesh.corners(scene.placed(change))

        def wound(values: Tensor) -> Array:
            return torch.where(away[:, None, None], values[:, [0, 2, 1]], values).reshape(-1, 3).numpy()

        return cls(
            points=wound(corners),
            normals=wound(normals.reshape(-1, 3, 3)),
            diffuse=model.diffuse.numpy(),
            specular=model.specular.numpy(),
            shininess=model.shininess.numpy(),
            lights=scene.lights(change),
            camera=camera(),
        )


class Redraw(Protocol):
    """A renderer of objects. name: of what draws, for people."""

    @property
    def name(self) -> str: ...

    def draw(self, solid: Solid) -> Tensor:
        """(4, H, W) as `LitMesh.render`: RGB after gamma, in [0, 1], and coverage."""
        ...


def likeness(scene: ObjectScene, one: Tensor, other: Tensor) -> Likeness:
    """Of what two renderers drew (4, H, W) of a scene."""
    first, second = one[3] >= 0.5, other[3] >= 0.5
    either = int((first | second).sum())
    small = F.interpolate((first & second).float()[None, None], (SEEN_PX, SEEN_PX), mode="area")[0, 0] > 0.999
    lab = [_lab(scene.shown(drawn))[small.numpy()] for drawn in (one, other)]
    distance = np.linalg.norm(lab[0] - lab[1], axis=1)
    return Likeness(
        iou=round(int((first & second).sum()) / either, 4) if either else 1.0,
        colour=round(float(distance.mean()), 2) if len(distance) else 0.0,
    )


def _lab(picture: Tensor) -> Array:
    """A picture (3, H, W) as (H, W, 3) of CIE L*a*b*, in which 1 is hardly seen and 100 is black from white."""
    rgb = np.ascontiguousarray(picture.clamp(0, 1).permute(1, 2, 0).numpy())
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB), np.float32)
