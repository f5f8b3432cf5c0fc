"""Drops of rain on the windscreen: each shows the picture around it, small and upside down."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from scene_ir.render import model


def add_drops(image: Tensor, amount: Tensor) -> Tensor:
    """The picture (3, H, W) with drops on the glass, the more the larger the amount () in [0, 1]; 0 changes no bit.

    Where they are depends on the picture's size alone. Differentiable to both.
    """
    _, height, width = image.shape
    pixel, place_xy, opacity, rank = (t.to(image.device) for t in _place_drops(height, width))
    step = max(1, round(height / model.DROP_ROWS))
    small = interpolate(image[None], size=(height // step, width // step), mode="area")
    refracted = grid_sample(small, place_xy.to(image)[None, None], padding_mode="border", align_corners=False)[
        0, :, 0
    ]
    grown = ((1.0 + model.DROP_GROWS) * amount - rank.to(image)) / model.DROP_GROWS
    share = opacity.to(image) * grown.clamp(0.0, 1.0)
    flat = image.flatten(1)
    return flat.index_add(1, pixel, share * (refracted - flat[:, pixel])).reshape(image.shape)


@lru_cache(maxsize=8)
def _place_drops(height: int, width: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Drops in a picture of a size, by the K pixels that they cover: index (K,) int64 of the pixel; the place seen
    through it (K, 2), as `grid_sample` counts; opacity (K,) in [0, 1]; rank (K,) in [0, 1] of its drop, the order in
    which they appear.
    """
    rng = np.random.default_rng(19031103)
    rows, columns = np.mgrid[:height, :width].astype(np.float64)
    opacity, rank, place_xy = np.zeros((height, width)), np.zeros((height, width)), np.zeros((height, width, 2))
    low, high = np.log(model.DROP_RADII)
    for order in np.linspace(0.0, 1.0, model.DROPS):
        x, y, aspect = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0.8, 1.2)
        radius = height * float(np.exp(rng.uniform(low, high)))
        reach = int(np.ceil(1.3 * radius)) + 1
        area = (
            slice(max(0, int(y) - reach), int(y) + reach + 1),
            slice(max(0, int(x) - reach), int(x) + reach + 1),
        )
        across, down = (columns[area] - x) / (radius * aspect), (rows[area] - y) * aspect / radius
        # Drops hang: they are wider below.
        square = np.square(across * (1.0 - model.DROP_HANGS * down)) + np.square(down)
        inside = np.clip((1.0 - np.sqrt(square)) / model.DROP_EDGE, 0.0, 1.0)
        inside = inside * inside * (3.0 - 2.0 * inside)
        newer = inside > opacity[area]
        bend = model.DROP_FIELD * height * (1.0 + square)
        places = np.stack([(x - bend * across + 0.5) / width, (y - bend * down + 0.5) / height], axis=-1)
        opacity[area] = np.where(newer, inside, opacity[area])
        rank[area] = np.where(newer, order, rank[area])
        place_xy[area] = np.where(newer[..., None], 2.0 * places - 1.0, place_xy[area])
    pixel = np.flatnonzero(opacity)
    planes = (pixel, place_xy.reshape(-1, 2)[pixel], opacity.reshape(-1)[pixel], rank.reshape(-1)[pixel])
    index, places, share, appears = map(torch.from_numpy, planes)
    return index, places, share, appears
