"""Depth and silhouettes against rays cast by Open3D (Embree), an independent implementation."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from scene_ir.raster import verbs

open3d: Any = pytest.importorskip("open3d", reason="Open3D is not installed", exc_type=ImportError)


def cast(crowd: Any, height: int, width: int) -> NDArray[np.float32]:
    """Depth (H, W) m along rays through the pixel centres, from the near plane on."""
    scene = open3d.t.geometry.RaycastingScene()
    for points, faces in zip(crowd.points, crowd.faces, strict=True):
        scene.add_triangles(points.numpy(), faces.numpy().astype(np.uint32))
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)], dim=-1).to(torch.float64)
    way = pixels @ torch.linalg.inv(crowd.intrinsics.to(torch.float64)).T  # its z is 1: t is the depth
    rays = torch.cat([way * verbs.NEAR_M, way], dim=-1).to(torch.float32).numpy()
    return scene.cast_rays(open3d.core.Tensor(rays))["t_hit"].numpy() + np.float32(verbs.NEAR_M)


@pytest.mark.parametrize("seed", range(8))
def test_depth_and_silhouettes_agree_up_to_one_pixel_at_outlines(
    crowd: Callable[[int], Any],
    outlines: Callable[[NDArray[np.float32]], NDArray[np.bool_]],
    inner_pixels: Callable[..., NDArray[np.bool_]],
    seed: int,
) -> None:
    scene = crowd(seed)
    ours = scene.render_depth(cull=False)
    theirs = cast(scene, *ours.shape)
    band = outlines(theirs)
    inner = inner_pixels(ours, theirs, band)
    np.testing.assert_allclose(ours[inner], theirs[inner], rtol=2e-4, atol=0)
    # Both sample pixel centres: nearly everything agrees within the band too.
    hit = np.isfinite(theirs)
    assert ((np.isfinite(ours) != hit) & band).sum() <= 0.01 * band.sum()
    both = np.isfinite(ours) & hit & band
    assert (np.abs(ours[both] - theirs[both]) > 0.02 * theirs[both]).mean() < 0.02
