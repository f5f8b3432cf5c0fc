"""What the networks that look at streets share: how a photograph is shown to them."""

import numpy as np
import pytest
import torch

from scene_ir.derender import unet
from scene_ir.types import Camera

CAMERA = Camera(torch.tensor([[380.0, 0, 239.5], [0, 380.0, 88.0], [0, 0, 1.0]]), 200, 480)
LEVEL = torch.tensor([0.0, -1.0, 0.0, 1.65])


def test_elevation_is_zero_at_the_horizon_and_the_rays_angle_elsewhere():
    height = unet.compute_elevation(LEVEL, CAMERA, (200, 480))
    assert np.abs(height[88]).max() < 1e-6
    assert height[20, 239] == pytest.approx(np.sin(np.arctan(68 / 380)), abs=1e-4)
    small = unet.compute_elevation(LEVEL, CAMERA, (100, 240))
    assert small[10, 100] == pytest.approx(height[20:22, 200:202].mean(), abs=1e-4)


def test_a_photograph_is_seen_at_one_focal_length_and_at_a_bounded_size():
    seen = unet.prepare_input(np.zeros((200, 480, 3), np.float32), LEVEL, CAMERA)
    assert seen.image.shape == (*seen.elevation.shape, 3)
    assert all(side % unet.STRIDE == 0 for side in seen.elevation.shape)
    assert seen.elevation.shape[1] / 480 == pytest.approx(unet.INPUT_FOCAL_PX / 380, rel=0.03)
    wide = Camera(torch.tensor([[300.0, 0, 999.5], [0, 300.0, 500.0], [0, 0, 1.0]]), 1000, 2000)
    large = unet.prepare_input(np.zeros((1000, 2000, 3), np.float32), LEVEL, wide)
    assert large.elevation.size < 270_000


def test_output_has_half_the_size_and_the_given_channels():
    network = unet.UNet(3).eval()
    seen = unet.prepare_input(np.zeros((200, 480, 3), np.float32), LEVEL, CAMERA)
    height, width = seen.elevation.shape
    assert network.predict(seen).shape == (1, 3, height // 2, width // 2)
