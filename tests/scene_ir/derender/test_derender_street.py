"""Continuing a street's structure behind what hides it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from scene_ir.derender.background import Ground, fill
from scene_ir.derender.street import Plane, continued, course, foot_rows, plane_view
from scene_ir.types import Camera

CAMERA = Camera(torch.tensor([[380.0, 0, 239.5], [0, 380.0, 88.0], [0, 0, 1.0]]), 200, 480)
LEVEL = torch.tensor([0.0, -1.0, 0.0, 1.65])
HORIZON = 88.0
ROWS = np.arange(200)[:, None] + np.zeros((1, 480))
BELOW = ROWS > 93
ROAD = BELOW.astype(np.float32)


def view() -> Plane:
    return plane_view(LEVEL, CAMERA)


def lateral(heading: float, bend: float = 0.0) -> np.ndarray:
    plane = view()
    along = np.where(BELOW, plane.along, 1.0)
    return plane.across - heading * along - bend * along**2 / 2


def photograph(heading: float = 0.15, grain: float = 0.02, bend: float = 0.0) -> np.ndarray:
    """A grey road with a white line 0.2 m wide and a green verge to the right of it; above, a wall of two
    colours."""
    image = np.full((200, 480, 3), 0.45, np.float32)
    across = lateral(heading, bend)
    image[BELOW & (np.abs(across - 1.0) < 0.1)] = 0.9
    image[BELOW & (across > 3.0)] = (0.3, 0.42, 0.25)
    image[:94] = (0.6, 0.5, 0.4)
    image[:60] = (0.7, 0.8, 0.95)
    noise = np.random.default_rng(3).normal(0, grain, (200, 480, 1))
    return np.clip(image + noise, 0, 1).astype(np.float32)


def hole() -> np.ndarray:
    mask = np.zeros((200, 480), bool)
    mask[70:130, 225:330] = True
    return mask


def test_plane_view_knows_a_point_of_the_road():
    plane = view()
    assert plane.along[188, 239] == pytest.approx(380 * 1.65 / 100, abs=1e-3)
    assert plane.across[188, 339] == pytest.approx(1.65 * 99.5 / 100, abs=1e-3)
    assert np.isinf(plane.along[:88]).all()


@pytest.mark.parametrize(("heading", "bend"), [(0.15, 0.0), (-0.1, 0.0), (0.0, 0.006)])
def test_edges_on_the_ground_tell_the_roads_course(heading, bend):
    known = BELOW & (view().along < 45) & ~hole()
    found = course(photograph(heading, 0.005, bend), known, view())
    assert found == pytest.approx((heading, bend), abs=0.02)


def test_a_planted_line_and_a_verge_continue_through_the_hole():
    image = photograph()
    mask = hole()
    spoilt = image.copy()
    spoilt[mask] = (1, 0, 1)
    guess = continued(spoilt, mask, np.where(mask, 0, ROAD).astype(np.float32), view(), HORIZON)
    across = lateral(0.15)
    inside = mask & (ROWS > 100)
    line, asphalt = inside & (np.abs(across - 1.0) < 0.06), inside & (np.abs(across - 2.0) < 0.5)
    verge = inside & (across > 3.3)
    assert min(np.count_nonzero(part) for part in (line, asphalt, verge)) > 10
    assert guess.image[line].mean() > guess.image[asphalt].mean() + 0.2
    assert guess.image[asphalt].mean() == pytest.approx(0.45, abs=0.06)
    green = guess.image[verge].mean(0)
    assert green[1] - green[2] > 0.1
    assert np.array_equal(guess.image[~mask], image[~mask])


def test_what_is_unknown_does_not_matter_and_the_result_is_the_same_twice():
    mask = hole()
    one, other = photograph(), photograph()
    other[mask] = (1, 0, 0)
    road = np.where(mask, 0, ROAD).astype(np.float32)
    first, second = (continued(image, mask, road, view(), HORIZON).image for image in (one, other))
    assert np.array_equal(first, second)


def test_a_dash_beside_the_hole_is_not_smeared_into_it():
    image = photograph(0.0, 0.0)
    image[110:116, 205:222] = 0.9
    guess = continued(image, hole(), np.where(hole(), 0, ROAD).astype(np.float32), view(), HORIZON).image
    assert guess[113, 226:236].mean() < 0.55


def test_paint_on_the_ground_does_not_run_on_along_the_road():
    image = photograph(0.0, 0.0)
    near = (lateral(0.0) > 0.0) & (lateral(0.0) < 0.8) & (ROWS > 132)
    image[near] = (0.9, 0.05, 0.05)
    guess = continued(image, hole(), np.where(hole(), 0, ROAD).astype(np.float32), view(), HORIZON).image
    column = hole() & (ROWS > 105) & (ROWS < 125) & (np.abs(lateral(0.0) - 0.4) < 0.2)
    assert (guess[column][:, 0] - guess[column][:, 1]).mean() < 0.15


def test_the_grounds_end_is_interpolated_behind_the_hole():
    road = ROAD.copy()
    road[:110, 240:] = 0
    foot = foot_rows(np.where(hole(), 0, road).astype(np.float32), hole(), HORIZON)
    assert foot[200] == pytest.approx(94, abs=1)
    assert foot[360] == pytest.approx(110, abs=1)
    assert 94 < foot[275] < 110


def test_the_fill_has_the_guides_colours_and_the_photographs_grain():
    image = photograph(0.0, 0.03)
    mask = hole()
    like = np.where(mask, 0, ROAD).astype(np.float32)
    guide = continued(image, mask, like, view(), HORIZON)
    result = fill(image, mask, mask, HORIZON, Ground(guide.ground, like), guide=guide.image)
    assert np.array_equal(result[~mask], image[~mask])
    part = (slice(106, 126), slice(228, 244))
    assert result[part].mean() == pytest.approx(guide.image[part].mean(), abs=0.02)
    assert result[part].std() > 1.3 * guide.image[part].std()
    dark = fill(image, mask, mask, HORIZON, Ground(guide.ground, like), guide=guide.image * np.float32(0.6))
    assert dark[part].mean() < result[part].mean() - 0.1
