"""Which pixels are paint."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_ir.derender import paint_mask as paint
from scene_ir.types import Crop

H, W = 60, 90


def picture(base: tuple[float, float, float], seed: int = 0) -> tuple[Crop, np.ndarray]:
    """A car's side, 4 channels, and which of its pixels are truly paint: shaded, with a window above, a plate
    and a lamp below."""
    rng = np.random.default_rng(seed)
    shade = np.linspace(1.1, 0.6, H)[:, None, None]
    image = np.array(base) * shade + np.zeros((H, W, 3))
    truth = np.ones((H, W), bool)
    for rows, columns, colour in (
        (slice(8, 26), slice(15, 75), (0.08, 0.10, 0.12)),
        (slice(40, 46), slice(30, 52), (0.92, 0.92, 0.88)),
        (slice(34, 42), slice(72, 84), (0.75, 0.08, 0.06)),
    ):
        image[rows, columns] = colour
        truth[rows, columns] = False
    image = (image + rng.normal(0, 0.012, image.shape)).clip(0, 1)
    values = np.concatenate([image.transpose(2, 0, 1), np.ones((1, H, W))])
    return Crop(torch.from_numpy(values).float(), 5, 3), truth


def mesh_part(shift: int) -> Crop:
    """What a template says that is off by some px: it knows the window, no plate, no lamp."""
    part = torch.ones(1, H, W)
    part[0, 8 + shift : 26 + shift, 15 + shift : 75 + shift] = 0.0
    return Crop(part, 5, 3)


@pytest.mark.parametrize("base", [(0.35, 0.4, 0.62), (0.62, 0.62, 0.6), (0.2, 0.42, 0.25)])
def test_plates_lamps_and_windows_are_no_paint(base):
    foreground, truth = picture(base)
    found = paint.estimate_paint_region(foreground, mesh_part(2))
    assert (found.x0, found.y0) == (5, 3)
    share = found.values[0].numpy()
    assert share.dtype == np.float32
    assert 0 <= share.min() <= share.max() <= 1
    wrong = (share > 0.5) != truth
    assert wrong.mean() < 0.03
    mesh_paint = (mesh_part(2).values[0].numpy() > 0.5) != truth
    assert wrong.sum() < 0.4 * mesh_paint.sum()
    if np.ptp(base) > 0.1:  # white plates are no lighter than what grey paint may mirror
        assert share[41:45, 32:50].max() < 0.1


def test_paint_as_dark_as_glass_follows_the_mesh():
    foreground, truth = picture((0.1, 0.11, 0.12))
    share = paint.estimate_paint_region(foreground, mesh_part(0)).values[0].numpy()
    assert ((share > 0.5) == truth).mean() > 0.9


def test_nothing_outside_the_foreground():
    foreground, _ = picture((0.5, 0.2, 0.2))
    values = foreground.values.clone()
    values[:, :, :20] = 0
    share = paint.estimate_paint_region(replace(foreground, values=values), mesh_part(0)).values[0]
    assert bool((share[:, :20] == 0).all())
    assert float(share[50:, 30:].min()) > 0.9


def test_an_empty_foreground_has_an_empty_region():
    empty = Crop(torch.zeros(4, 0, 0), 0, 0)
    assert paint.estimate_paint_region(empty, Crop(torch.zeros(1, 0, 0), 0, 0)).values.shape == (1, 0, 0)
