"""Spray that vehicles throw up from a wet road: a pale veil low behind their wheels.

A vehicle's spray is a Gaussian in its own axes, densest on the ground, which cuts it off as any other surface does.
About its middle the projection is linear, so it is a Gaussian along each pixel's ray, and in the picture, where it is
taken as upright: differentiable to poses and sizes, and to the picture's depth. A photograph does not show speed: every
vehicle that stands where one drives throws up as much, which is little.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from scene_ir.geometry import to_clip
from scene_ir.render import model
from scene_ir.render.lamps import VehicleLamps
from scene_ir.render.reflections import by_row
from scene_ir.render.surfaces import rotate_y
from scene_ir.render.texture import smoothstep
from scene_ir.types import Camera, Objects


def draw_spray(inverse_depth: Tensor, objects: Objects, lamps: VehicleLamps, camera: Camera) -> Tensor:
    """Opacity (H, W) in [0, 1) of the vehicles' spray at rain 1, before what is seen.

    Args:
        inverse_depth: (H, W) 1/m, 0 in the sky.
        objects: The vehicles, perturbed.
        lamps: Of `lamps.find_lamps`: which vehicles drive, and which way they head.
        camera: Of the picture.
    """
    place, covariance, density = _project_spray(objects, lamps, camera)
    precision = torch.linalg.inv(covariance[:, :2, :2])
    lean = torch.einsum("nj,njk->nk", covariance[:, 2, :2], precision)  # of the depth along the ray, m per px
    depth_deviation = (covariance[:, 2, 2] - (lean * covariance[:, 2, :2]).sum(dim=1)).sqrt()
    peak = math.sqrt(2.0 * math.pi) * density * depth_deviation
    sharp = model.SPRAY_LOGIT / depth_deviation
    rows = torch.stack(
        [*place.T, *(1.0 / covariance.diagonal(dim1=1, dim2=2)[:, :2]).T, *lean.T, peak, sharp], dim=1
    ).to(inverse_depth)
    reach = model.SPRAY_REACH * covariance.diagonal(dim1=1, dim2=2)[:, :2].detach().sqrt()
    low, high = (place[:, :2].detach() - reach).ceil().long(), (place[:, :2].detach() + reach).floor().long() + 1
    height, width = inverse_depth.shape
    rects = torch.cat([low.clamp(min=0), high.minimum(low.new_tensor([width, height]))], dim=1).tolist()
    seen = [
        (row, rect)
        for row, rect, amount in zip(rows, rects, density.tolist(), strict=True)
        if rect[0] < rect[2] and rect[1] < rect[3] and amount > 0
    ]
    if not seen:
        return torch.zeros_like(inverse_depth)
    left, top = (min(rect[k] for _, rect in seen) for k in (0, 1))
    right, bottom = (max(rect[k] for _, rect in seen) for k in (2, 3))
    total = inverse_depth.new_zeros(bottom - top, right - left)
    for row, (x0, y0, x1, y1) in seen:
        area = slice(y0 - top, y1 - top), slice(x0 - left, x1 - left)
        total[area] = total[area] + _optical_depth(inverse_depth[y0:y1, x0:x1], row, x0, y0)
    return pad(1.0 - torch.exp(-total), (left, width - right, top, height - bottom))


def _project_spray(objects: Objects, lamps: VehicleLamps, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """The vehicles' sprays about their middles: position (N, 3) px, px, depth in m; covariance (N, 3, 3) of the same;
    optical depth (N,) per metre of depth in the middle. float64.
    """
    count, size = len(objects), objects.size_lhw.double()
    unit = torch.eye(3, dtype=torch.float64, device=size.device).repeat(count, 1)
    axes = rotate_y(unit, objects.yaw.double().repeat_interleave(3)).reshape(count, 3, 3)  # ahead, down, left
    behind = 0.5 * size[:, 0] + model.SPRAY_BEHIND * size[:, 2]
    behind = torch.where(lamps.front[:, 0], -behind, behind)
    middle = objects.translation.double() + behind[:, None] * axes[:, 0]
    deviation = size[:, [2, 1, 2]] * size.new_tensor(model.SPRAY_SIZE)
    matrix = camera.matrix.to(middle)
    u, v, depth = to_clip(middle, matrix).unbind(dim=1)
    safe = depth.clamp(min=model.SPRAY_NEAR_M[0])
    place = torch.stack([u / safe, v / safe, depth], dim=1)
    slopes = (matrix[:2, :3] - place[:, :2, None] * matrix[2, :3]) / safe[:, None, None]
    slopes = torch.cat([slopes, matrix[2:, :3].expand(count, 1, 3)], dim=1)
    spread = slopes @ (axes.transpose(1, 2) * deviation[:, None])
    rays = torch.cat([place[:, :2], torch.ones_like(place[:, :1])], dim=1) @ torch.linalg.inv(matrix[:, :3]).T
    density = model.SPRAY_PER_M * rays.norm(dim=1) * smoothstep(depth, *model.SPRAY_NEAR_M)
    return place, spread @ spread.transpose(1, 2), density * lamps.driven.to(density) * ~objects.upright


def _optical_depth(inverse_depth: Tensor, row: Tensor, x0: int, y0: int) -> Tensor:
    """Optical depth (h, w) of a spray in a window of the picture from (x0, y0) px.

    Args:
        inverse_depth: (h, w) 1/m.
        row: (9,) middle: x, y px, depth m; precision by x and y, 1/px^2; slopes of the depth along the rays by x and y,
            m/px; peak; slope of the logit of what lies before a depth, 1/m.
    """
    height, width = inverse_depth.shape
    u, v, middle, xx, yy, lean_x, lean_y, peak, sharp = row.unbind()
    x = torch.arange(x0, x0 + width, dtype=row.dtype, device=row.device) - u
    y = torch.arange(y0, y0 + height, dtype=row.dtype, device=row.device)[:, None] - v
    depth = 1.0 / inverse_depth.clamp(min=1.0 / model.HAZE_CAP_M)
    beyond = sharp * (middle + lean_y * y) - by_row(sharp, height) * (depth - lean_x * x)
    across = peak * torch.exp(-0.5 * yy * y * y) * torch.exp(-0.5 * xx * x * x)
    return across / (1.0 + torch.exp(beyond.clamp(max=30.0)))
