"""What a wet road mirrors: the picture in the plane of the ground, smeared by the road's roughness.

A ray that the ground mirrors stays in its column of the picture while the camera does not roll, so the mirror image of
a pixel is the first surface up its column that the ray meets. Which one comes from the depth, without a slope.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from scene_ir.render import model


def mirror_in_ground(
    values: Tensor, inverse_depth: Tensor, ground: Tensor, rise: Tensor, camera_m: float
) -> Tensor:
    """Mirror images (C, H, W) of values in the plane of the ground, as if it were at every pixel below the horizon;
    differentiable to the values. They are coarse, as a rough road smears them.

    Args:
        values: (C, H, W).
        inverse_depth: (H, W) 1/m, 0 in the sky.
        ground: (H, W) in [0, 1], share of what lies in the plane and so is never mirrored.
        rise: (H, W), metres of height that a pixel's ray gains per metre of depth.
        camera_m: Height of the camera above the ground.
    """
    height, width = rise.shape
    step = max(1, round(height / model.MIRROR_ROWS))
    small = avg_pool2d(values[None], step, ceil_mode=True)[0]
    with torch.no_grad():
        inverse, flat, climb = avg_pool2d(
            torch.stack([inverse_depth, ground, rise])[None].detach(), step, ceil_mode=True
        )[0]
        # A ray mirrored at row v passes over row r while the depth there is beyond -2 camera_m / (rise_r + rise_v).
        reached = (2.0 * camera_m * inverse + climb).masked_fill(flat > 0.5, -torch.inf)
        rows = _first_above(reached, -climb * (1.0 + model.MIRROR_SLACK))
    mirrored = small.gather(1, rows.expand(len(values), *rows.shape))
    reach = round(model.MIRROR_REACH * len(rows) / 2)
    mirrored = pad(mirrored[None], (2, 2, 2 * reach, 2 * reach), "replicate")
    for _ in range(2):
        mirrored = avg_pool2d(avg_pool2d(mirrored, (2 * reach + 1, 1), 1), (1, 3), 1)
    return interpolate(mirrored, scale_factor=step, mode="bilinear")[0, :, :height, :width]


def by_row(amount: Tensor, height: int) -> Tensor:
    """An amount () for each row, (height, 1): its gradient is summed row by row, so that the sum does not depend on the
    number of threads.
    """
    return amount.expand(height)[:, None]


def mirror_share(depth: Tensor, camera_m: Tensor | float) -> Tensor:
    """Share of light that a wet road mirrors at a depth (...) m: the more, the flatter it is seen (Schlick 1994)."""
    cos = camera_m / (camera_m * camera_m + depth * depth).sqrt()
    return model.FILM * (model.WATER + (1.0 - model.WATER) * (1.0 - cos) ** 5)


def _first_above(values: Tensor, limits: Tensor) -> Tensor:
    """Row (H, W) of the first value above each place in its column that reaches the place's limit; 0 where none does.

    Args:
        values, limits: (H, W).
    """
    height = len(values)
    maxima = [values]  # of blocks of 1, 2, 4 rows that end at each row
    while 2 ** len(maxima) <= height:
        size = 2 ** (len(maxima) - 1)
        shifted = pad(maxima[-1][:-size], (0, 0, size, 0), value=-torch.inf)
        maxima.append(torch.maximum(maxima[-1], shifted))
    rows = torch.arange(-1, height - 1, device=values.device)[:, None].expand(values.shape).contiguous()
    for j in reversed(range(len(maxima))):
        below = (maxima[j].gather(0, rows.clamp(min=0)) < limits) & (rows >= 2**j - 1)
        rows = rows - below * 2**j
    return rows.clamp(min=0)
