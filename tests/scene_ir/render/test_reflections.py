"""What a wet road mirrors."""

import pytest
import torch
from torch import Tensor

from scene_ir.render import reflections

CAMERA_M = 1.5


def _street(height: int, width: int, wall_m: float) -> tuple[Tensor, Tensor, Tensor]:
    """Inverse depth, map of the ground, and rise of an open street with a wall across it, 3 m high, from column
    width // 2 on. float64."""
    focal = 0.5 * width
    rise = ((height // 3 - torch.arange(height, dtype=torch.float64)) / focal)[:, None].expand(height, width)
    ground = (-rise / CAMERA_M).clamp(min=0.0)
    wall = (CAMERA_M + wall_m * rise > 0) & (CAMERA_M + wall_m * rise < 3.0)
    wall = wall & (torch.arange(width) >= width // 2)
    return torch.where(wall, 1.0 / wall_m, ground), (~wall & (rise < 0)).double(), rise


def test_a_wall_is_mirrored_about_its_foot_and_the_sky_about_the_horizon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reflections.model, "MIRROR_REACH", 0.0)
    height, width = 90, 120
    inverse, ground, rise = _street(height, width, 10.0)
    rows = torch.arange(height, dtype=torch.float64)[None, :, None].expand(1, height, width)
    mirrored = reflections.mirror_in_ground(rows, inverse, ground, rise, CAMERA_M)[0]
    horizon, foot = 30, 30 + round(CAMERA_M / 10.0 * 60)
    for row in range(foot + 3, foot + 12):
        assert mirrored[row, 90] == pytest.approx(2 * foot - row, abs=1.5)
    for row in range(horizon + 5, 55):
        assert mirrored[row, 20] == pytest.approx(2 * horizon - row, abs=2.0)


def test_first_above_agrees_with_a_loop() -> None:
    generator = torch.Generator().manual_seed(1)
    values, limits = (torch.rand(37, 5, generator=generator) for _ in range(2))
    found = reflections._first_above(values, limits)
    for row in range(37):
        for column in range(5):
            reached = (values[:row, column] >= limits[row, column]).nonzero()[:, 0].tolist()
            assert int(found[row, column]) == max(reached, default=0)


def test_a_wet_road_mirrors_more_the_flatter_it_is_seen() -> None:
    shares = reflections.mirror_share(torch.tensor([2.0, 8.0, 30.0, 300.0]), CAMERA_M)
    assert bool((shares.diff() > 0).all())
    assert float(shares[-1]) <= reflections.model.FILM


def test_it_is_differentiable_to_the_picture() -> None:
    inverse, ground, rise = _street(9, 8, 10.0)
    picture = torch.rand(4, 9, 8, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda values: reflections.mirror_in_ground(values, inverse, ground, rise, CAMERA_M), picture
    )
