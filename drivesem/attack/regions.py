"""3D-SDN's parametrisation of a car's place: its centre in units of its region of interest, and log depth.

There a network tells the middle of a car's box in the picture as (region's middle + offset * region's size), and
its distance from the camera as sqrt(exp(log depth) / region's area) along the ray of that pixel (Yao et al. 2018,
and their code). What changes here are these three numbers; the region is the label's box, and stays. Nothing ties
the car to the ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from scene_ir.types import SceneIR

ROI_DIM = 3
"""Offset to the right and down, in widths and heights of the region; log depth."""
_LEAST_PX = 1.0
"""Of a region's width and height: keeps a label without size from standing still."""
_NEWTON = 5
"""Steps to the ground: the way there is nearly straight, two would do."""
_SHORTENINGS = 6
"""Halvings of a way along which the offset down would leave its bounds; after them the car stays."""


@dataclass(frozen=True, slots=True)
class Regions:
    """Cars as seen from the camera. ray (N, 3) m: from it to the middle of a car's box; wide (N, 2, 3) m: what one
    region's width and height are at that depth; ground (3,): normal of the plane.
    """

    ray: Tensor
    wide: Tensor
    ground: Tensor

    @classmethod
    def of(cls, scene: SceneIR) -> Regions:
        """Of the scene as it is."""
        objects = scene.objects
        matrix = scene.camera.matrix.to(objects.translation).detach()
        inverse = torch.linalg.inv(matrix[:, :3])
        middle = objects.translation.detach().clone()
        middle[:, 1] -= objects.size_lhw[:, 1].detach() / 2
        depth = middle @ matrix[2, :3] + matrix[2, 3]
        box = objects.box2d.to(middle)
        size = (box[:, 2:] - box[:, :2]).clamp_min(_LEAST_PX)
        wide = inverse[:, :2].T * (depth[:, None] * size)[..., None]
        return cls(middle + inverse @ matrix[:, 3], wide, scene.environment.ground[:3].to(middle).detach())

    def double(self, rows: Tensor | slice = slice(None)) -> Regions:
        """Some of them, in float64 on the CPU."""
        ray, wide, ground = (part.cpu().double() for part in (self.ray, self.wide, self.ground))
        return Regions(ray[rows], wide[rows], ground)

    def shift(self, change: Tensor) -> Tensor:
        """What changes (N, 3) move, (N, 3) m; differentiable. At 0 it is 0 exactly."""
        towards = self._towards(change)
        distance = self.ray.norm(dim=1, keepdim=True) * torch.exp(change[:, 2:] / 2)
        return towards * (distance / towards.norm(dim=1, keepdim=True)) - self.ray

    def grounded(self, change: Tensor, most: Tensor) -> Tensor:
        """Changes (N, 3) with the offset down by which cars keep their height above the plane. Where that would be
        more than `most` (N,), they go half as far, or not at all.
        """
        change = change.clone()
        for _ in range(_SHORTENINGS):
            change[:, 1] = self._down(change)
            wrong = ~(change[:, 1].abs() <= most)
            if not bool(wrong.any()):
                return change
            change[wrong] /= 2
        change[:, 1] = self._down(change)
        change[~(change[:, 1].abs() <= most)] = 0
        return change

    def slopes(self, change: Tensor) -> Tensor:
        """By how much the offset down follows (N, 2) the offset to the right and log depth, on the ground."""
        towards, rising = self._towards(change), self._rising(change)
        length = towards.norm(dim=1, keepdim=True)
        distance = self.ray.norm(dim=1, keepdim=True) * torch.exp(change[:, 2:] / 2)
        receding = (towards * (distance / length)) @ self.ground / 2
        return -torch.stack([rising[:, 0], receding], dim=1) / rising[:, 1:]

    def _towards(self, change: Tensor) -> Tensor:
        return self.ray + (change[:, :2, None] * self.wide).sum(dim=1)

    def _rising(self, change: Tensor) -> Tensor:
        """By how much the height above the plane grows (N, 2) with the offsets right and down."""
        towards = self._towards(change)
        length = towards.norm(dim=1)[:, None, None]
        unit = towards[:, None] / length
        turned = self.wide - unit * (self.wide * unit).sum(dim=2, keepdim=True)
        distance = (self.ray.norm(dim=1) * torch.exp(change[:, 2] / 2))[:, None, None]
        return (turned * (distance / length)) @ self.ground

    def _down(self, change: Tensor) -> Tensor:
        """The offset down (N,) at which the height is kept, by Newton's method."""
        change = change.clone()
        change[:, 1] = 0
        for _ in range(_NEWTON):
            change[:, 1] -= self.shift(change) @ self.ground / self._rising(change)[:, 1]
        return change[:, 1]
