"""Continuing a street's structure behind what hides it."""

import numpy as np
import pytest
import torch

from scene_ir.derender.patch_fill import GroundMaps, fill_patches
from scene_ir.derender.street import (
    GroundCoordinates,
    StreetShares,
    continue_street,
    estimate_road_course,
    find_foot_rows,
    find_skyline_rows,
    ground_coordinates,
)
from scene_ir.types import Camera

CAMERA = Camera(torch.tensor([[380.0, 0, 239.5], [0, 380.0, 88.0], [0, 0, 1.0]]), 200, 480)
LEVEL = torch.tensor([0.0, -1.0, 0.0, 1.65])
HORIZON = 88.0
ROWS = np.arange(200)[:, None] + np.zeros((1, 480))
BELOW = ROWS > 93
ROAD = BELOW.astype(np.float32)


def view() -> GroundCoordinates:
    return ground_coordinates(LEVEL, CAMERA)


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


def shares(ground: np.ndarray | None = None, stood: np.ndarray | None = None) -> StreetShares:
    """Ground below row 93, or as with_flat; sky above row 60."""
    nowhere = np.zeros(ROWS.shape, bool)
    return StreetShares(
        ROAD if ground is None else ground, (ROWS < 60).astype(np.float32), nowhere if stood is None else stood
    )


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
def test_edges_on_the_ground_determine_the_roads_course(heading, bend):
    known = BELOW & (view().along < 45) & ~hole()
    found = estimate_road_course(photograph(heading, 0.005, bend), known, view())
    assert found == pytest.approx((heading, bend), abs=0.04)


def test_a_planted_line_and_a_verge_continue_through_the_hole():
    image = photograph()
    mask = hole()
    spoilt = image.copy()
    spoilt[mask] = (1, 0, 1)
    guess = continue_street(spoilt, mask, shares(), view(), HORIZON)
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
    first, second = (continue_street(image, mask, shares(), view(), HORIZON).image for image in (one, other))
    assert np.array_equal(first, second)


def test_a_dash_next_to_the_hole_is_not_smeared_into_it():
    image = photograph(0.0, 0.0)
    image[110:116, 205:222] = 0.9
    guess = continue_street(image, hole(), shares(), view(), HORIZON).image
    assert guess[113, 226:236].mean() < 0.55


def test_paint_on_the_ground_does_not_run_on_along_the_road():
    image = photograph(0.0, 0.0)
    near = (lateral(0.0) > 0.0) & (lateral(0.0) < 0.8) & (ROWS > 132)
    image[near] = (0.9, 0.05, 0.05)
    guess = continue_street(image, hole(), shares(), view(), HORIZON).image
    column = hole() & (ROWS > 105) & (ROWS < 125) & (np.abs(lateral(0.0) - 0.4) < 0.2)
    assert (guess[column][:, 0] - guess[column][:, 1]).mean() < 0.15


def test_colours_of_walls_and_ground_and_sky_do_not_run_into_each_other():
    image = photograph(0.0, 0.0)
    guess = continue_street(image, hole(), shares(), view(), HORIZON)
    assert guess.ground[100, 280]
    assert not guess.ground[88, 280]
    assert guess.image[72:92, 230:325] == pytest.approx(np.broadcast_to([0.6, 0.5, 0.4], (20, 95, 3)), abs=0.04)
    tall = hole()
    tall[30:130, 225:330] = True
    guess = continue_street(image, tall, shares(), view(), HORIZON).image
    assert guess[35:57, 230:325] == pytest.approx(np.broadcast_to([0.7, 0.8, 0.95], (22, 95, 3)), abs=0.04)


def test_the_grounds_end_goes_on_straight_behind_the_hole():
    rows = np.interp(np.arange(480), [239, 479], [90, 138])
    ground = (rows <= ROWS).astype(np.float32)
    mask = np.zeros(ROWS.shape, bool)
    mask[92:170, 320:400] = True
    between = find_foot_rows(np.where(mask, 0, ground).astype(np.float32), mask, view(), HORIZON, 239.5)
    assert between[330:390] == pytest.approx(rows[330:390], abs=1.5)
    mask[92:170, 320:] = True
    beyond = find_foot_rows(np.where(mask, 0, ground).astype(np.float32), mask, view(), HORIZON, 239.5)
    assert beyond[470] == pytest.approx(rows[470], abs=4)


def test_where_a_vehicle_stood_is_ground():
    mask = np.zeros(ROWS.shape, bool)
    mask[80:190, 240:] = True
    stood = mask & (ROWS > 120)
    known = np.where(mask, 0, ROAD).astype(np.float32)
    without, with_flat = (
        continue_street(photograph(), mask, shares(known, place), view(), HORIZON) for place in (None, stood)
    )
    assert with_flat.ground[121:189, 245:].all()
    assert with_flat.foot[300:].mean() < without.foot[300:].mean()


def test_the_skyline_is_interpolated_behind_the_hole():
    mask = np.zeros(ROWS.shape, bool)
    mask[30:80, 225:330] = True
    sky = np.where(mask, 0, ROWS < 60).astype(np.float32)
    assert find_skyline_rows(sky, mask, HORIZON) == pytest.approx(np.full(480, 60), abs=1)


def test_the_fill_has_the_guides_colours_and_the_photographs_grain():
    image = photograph(0.0, 0.03)
    mask = hole()
    like = np.where(mask, 0, ROAD).astype(np.float32)
    guide = continue_street(image, mask, shares(), view(), HORIZON)
    result = fill_patches(image, mask, mask, HORIZON, GroundMaps(guide.ground, like), guide=guide.image)
    assert np.array_equal(result[~mask], image[~mask])
    part = (slice(106, 126), slice(228, 244))
    assert result[part].mean() == pytest.approx(guide.image[part].mean(), abs=0.04)
    assert result[part].std() > 1.3 * guide.image[part].std()
    dark = fill_patches(
        image, mask, mask, HORIZON, GroundMaps(guide.ground, like), guide=guide.image * np.float32(0.6)
    )
    assert dark[part].mean() < result[part].mean() - 0.1


def test_behind_a_hole_a_tree_at_its_edge_ends_and_the_low_skyline_goes_on():
    sky = np.zeros((100, 300), np.float32)
    sky[:60] = 1
    sky[20:60, 200:260] = 0
    unknown = np.zeros(sky.shape, bool)
    unknown[10:95, 120:200] = True
    found = find_skyline_rows(sky, unknown, 70.0)
    assert np.abs(found[120:178] - 60).max() < 3
    assert found[199] < 30


def test_what_the_maps_took_for_a_vehicle_lies_on_the_ground_where_none_is():
    image = photograph(0.0, 0.0)
    known = shares()
    taken = known.ground.copy()
    taken[100:, :] = 0.1
    plain = continue_street(image, hole(), StreetShares(known.ground, known.sky, known.stood), view(), HORIZON)
    found = continue_street(
        image, hole(), StreetShares(known.ground, known.sky, known.stood, taken), view(), HORIZON
    )
    low = hole() & plain.ground
    assert low.any()
    assert np.abs(found.image - plain.image)[low].max() > 0.01
