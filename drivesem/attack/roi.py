"""3D-SDN's parametrisation of a vehicle's position: image offset in units of its region of interest, and log
depth.

In 3D-SDN a network predicts the image centre of a vehicle's 3D box as (region centre + offset * region size), and
its distance from the camera as sqrt(exp(log depth) / region area) along the ray of that pixel (Yao et al. 2018,
and their code). These three numbers are the parameters here; the region is the label's box and stays fixed.
Nothing ties the vehicle to the ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from scene_ir.types import SceneIR

ROI_DIM = 3
"""Offset right and down, in region widths and heights; log depth."""
_MIN_SIZE_PX = 1.0
"""Minimum width and height of a region, so that a label without size can still move."""
_NEWTON_STEPS = 5
"""Newton iterations to the ground; the function is nearly linear, two would do."""
_HALVINGS = 6
"""Halvings of a change until its vertical offset is within bounds; after them the vehicle does not move."""


@dataclass(frozen=True, slots=True)
class RegionsOfInterest:
    """N vehicles in camera coordinates, as 3D-SDN parametrises their positions."""

    rays_m: Tensor
    """(N, 3) m, from the camera to the centre of each 3D box."""
    spans_m: Tensor
    """(N, 2, 3) m, one region width and one region height at the vehicle's depth."""
    ground_normal: Tensor
    """(3,), normal of the ground plane."""

    @classmethod
    def from_scene(cls, scene: SceneIR) -> RegionsOfInterest:
        """The regions of a scene's vehicles, from their 2D boxes."""
        objects = scene.objects
        matrix = scene.camera.matrix.to(objects.translation).detach()
        inverse = torch.linalg.inv(matrix[:, :3])
        middle = objects.translation.detach().clone()
        middle[:, 1] -= objects.size_lhw[:, 1].detach() / 2
        depth = middle @ matrix[2, :3] + matrix[2, 3]
        box = objects.box2d.to(middle)
        size = (box[:, 2:] - box[:, :2]).clamp_min(_MIN_SIZE_PX)
        spans_m = inverse[:, :2].T * (depth[:, None] * size)[..., None]
        return cls(middle + inverse @ matrix[:, 3], spans_m, scene.environment.ground[:3].to(middle).detach())

    def to_float64(self, rows: Tensor | slice = slice(None)) -> RegionsOfInterest:
        """The regions `rows`, in float64 on the CPU."""
        rays_m, spans_m, normal = (part.cpu().double() for part in (self.rays_m, self.spans_m, self.ground_normal))
        return RegionsOfInterest(rays_m[rows], spans_m[rows], normal)

    def shift(self, change: Tensor) -> Tensor:
        """Shift (N, 3) m caused by changes (N, 3); differentiable, and exactly 0 at 0."""
        direction = self._direction(change)
        distance = self.rays_m.norm(dim=1, keepdim=True) * torch.exp(change[:, 2:] / 2)
        return direction * (distance / direction.norm(dim=1, keepdim=True)) - self.rays_m

    def project_to_ground(self, change: Tensor, limit: Tensor) -> Tensor:
        """Changes (N, 3) with the vertical offset that keeps each vehicle's height above the ground plane. Where
        that offset exceeds `limit` (N,), the change is halved, repeatedly, or dropped.
        """
        change = change.clone()
        for _ in range(_HALVINGS):
            change[:, 1] = self._solve_vertical_offset(change)
            exceeds = ~(change[:, 1].abs() <= limit)
            if not bool(exceeds.any()):
                return change
            change[exceeds] /= 2
        change[:, 1] = self._solve_vertical_offset(change)
        change[~(change[:, 1].abs() <= limit)] = 0
        return change

    def vertical_slopes(self, change: Tensor) -> Tensor:
        """Derivatives (N, 2) of the vertical offset on the ground, by horizontal offset and by log depth."""
        direction, height_slopes = self._direction(change), self._height_slopes(change)
        length = direction.norm(dim=1, keepdim=True)
        distance = self.rays_m.norm(dim=1, keepdim=True) * torch.exp(change[:, 2:] / 2)
        depth_slope = (direction * (distance / length)) @ self.ground_normal / 2
        return -torch.stack([height_slopes[:, 0], depth_slope], dim=1) / height_slopes[:, 1:]

    def _direction(self, change: Tensor) -> Tensor:
        return self.rays_m + (change[:, :2, None] * self.spans_m).sum(dim=1)

    def _height_slopes(self, change: Tensor) -> Tensor:
        """Derivatives (N, 2) of the height above the plane by the offsets right and down."""
        direction = self._direction(change)
        length = direction.norm(dim=1)[:, None, None]
        unit = direction[:, None] / length
        tangents = self.spans_m - unit * (self.spans_m * unit).sum(dim=2, keepdim=True)
        distance = (self.rays_m.norm(dim=1) * torch.exp(change[:, 2] / 2))[:, None, None]
        return (tangents * (distance / length)) @ self.ground_normal

    def _solve_vertical_offset(self, change: Tensor) -> Tensor:
        """The vertical offset (N,) that keeps the height above the plane, by Newton's method."""
        change = change.clone()
        change[:, 1] = 0
        for _ in range(_NEWTON_STEPS):
            change[:, 1] -= self.shift(change) @ self.ground_normal / self._height_slopes(change)[:, 1]
        return change[:, 1]
