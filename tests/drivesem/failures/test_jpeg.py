"""The JPEG codec with a gradient against kornia's, which defines it, and against libjpeg's pictures."""

from __future__ import annotations

import cv2
import kornia
import numpy as np
import pytest
import torch
from torch import Tensor

from drivesem.failures.jpeg import DifferentiableJpeg
from drivesem.synth.demo import demo_scene


def photograph(height: int, width: int) -> Tensor:
    """In float64: where a coefficient lies between two steps, rounding errors would decide."""
    image = demo_scene(0, 0).photograph[:, 100 : 100 + height, 300 : 300 + width].double()
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return (image + 0.01 * noise).clamp(0, 1)


@pytest.mark.parametrize(("height", "width", "quality"), [(64, 96, 75), (61, 83, 95), (40, 33, 30)])
def test_values_and_gradients_are_kornias(height: int, width: int, quality: int) -> None:
    one, other = (photograph(height, width).requires_grad_(True) for _ in range(2))
    expected = kornia.enhance.jpeg_codec_differentiable(one[None], one.new_tensor([float(quality)]))[0]
    packed = DifferentiableJpeg.create((height, width), quality, other)(other)
    torch.testing.assert_close(packed, expected, atol=1e-9, rtol=0)
    cotangent = torch.randn(expected.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (gradient,) = torch.autograd.grad(expected, one, cotangent)
    (found,) = torch.autograd.grad(packed, other, cotangent)
    torch.testing.assert_close(found, gradient, atol=1e-9, rtol=0)


def test_a_picture_as_libjpeg_packs_it() -> None:
    image = photograph(96, 128).float()
    levels = (255 * image).round().to(torch.uint8).permute(1, 2, 0).numpy()
    bgr = np.ascontiguousarray(levels[..., ::-1])
    decoded = cv2.imdecode(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 90])[1], cv2.IMREAD_COLOR)
    assert decoded is not None
    expected = torch.from_numpy(np.ascontiguousarray(decoded[..., ::-1])).permute(2, 0, 1) / 255
    packed = DifferentiableJpeg.create((96, 128), 90, image)(image)
    assert packed.dtype == torch.float32
    assert float((packed - expected).abs().mean()) < 2.5 / 255


def test_lower_quality_leaves_less() -> None:
    image = photograph(96, 128).float()
    worst = [
        float((DifferentiableJpeg.create((96, 128), quality, image)(image) - image).norm())
        for quality in (95, 75, 20)
    ]
    assert worst == sorted(worst)
