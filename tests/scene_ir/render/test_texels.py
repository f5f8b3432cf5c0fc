"""Texels of photographed objects, inside and beyond the mesh."""

from __future__ import annotations

import torch

from scene_ir.render import channels
from scene_ir.render.texture import build_texels
from scene_ir.types import Crop, Source


def test_a_halo_is_as_deep_as_the_neighbours_of_its_nearest_outline() -> None:
    """An outline pixel that is hardly covered takes its depth from its neighbours, and its halo moves with it."""
    depth = torch.full((1, 6, 8), 18.4)
    depth[:, 4:] = torch.inf  # below the mesh
    depth[0, 3, :4] = torch.inf
    depth[0, :, 5:] = torch.where(torch.isfinite(depth[0, :, 5:]), 19.7, torch.inf)
    matte = Crop(torch.full((4, 6, 8), 0.4), 10, 20)
    source = Source(
        torch.zeros(3), torch.zeros(()), torch.ones(3), torch.zeros(64, 3), matte, None, 0.1, torch.ones(3), 1.0
    )
    texels = build_texels(source, Crop(depth, 10, 20), torch.zeros(40, 40), (10, 20, 18, 26), (40, 40))
    below = texels.values[channels.DEPTH, 24 - texels.y0, 13 - texels.x0]
    assert below == 19.7  # of row 23, column 14 is nearest, and 15 is its neighbour
    assert texels.values[channels.DEPTH, 21 - texels.y0, 11 - texels.x0] == 18.4
