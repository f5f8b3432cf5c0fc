"""Solids, noise and figures that streets are made of."""

import numpy as np
import pytest
import torch

from drivesem.synth import buildings, flora, people
from drivesem.synth.light import develop, draw_light, draw_response
from drivesem.synth.soup import Material, Soup, ball, box, creased_normals, join, make, placed, stick, unit_sphere
from drivesem.synth.view import SIZE, noise_set
from scene_ir.geometry import place_vertices
from tests.drivesem.synth.reference_light import sample, sky_radiance


def _check(soup: Soup) -> None:
    assert np.isfinite(soup.corners).all()
    assert np.abs(np.linalg.norm(soup.normals, axis=-1) - 1).max() < 1e-4
    assert soup.albedo.min() >= 0
    assert soup.albedo.max() <= 1
    assert soup.material.dtype == np.uint8


def test_box_stands_on_the_ground_and_its_normals_point_outwards():
    soup = box((4.0, 2.0, 3.0), Material.FLAT, (0.5, 0.5, 0.5))
    points = soup.corners.reshape(-1, 3)
    assert points.min(axis=0) == pytest.approx([-2, -2, -1.5])
    assert points.max(axis=0) == pytest.approx([2, 0, 1.5])
    outward = soup.corners.mean(axis=1) - [0, -1, 0]
    assert ((outward * soup.normals[:, 0]).sum(axis=1) > 0).all()


def test_placed_agrees_with_the_projects_placing():
    rng = np.random.default_rng(0)
    soup = make(rng.uniform(-0.5, 0.5, (7, 3, 3)), Material.FLAT, (0.5, 0.5, 0.5))
    found = placed(soup, (1.0, 1.6, 9.0), 0.8, (4.0, 1.5, 1.8)).corners
    points = torch.from_numpy(soup.corners.reshape(-1, 3))
    expected = place_vertices(
        points, torch.tensor([4.0, 1.5, 1.8]), torch.tensor(0.8), torch.tensor([1.0, 1.6, 9.0])
    )
    assert np.abs(found.reshape(-1, 3) - expected.numpy()).max() < 1e-5


def test_placing_keeps_normals_at_right_angles_to_the_surface():
    soup = ball((0, 0, 0), (1, 1, 1), Material.FLAT, (0.5, 0.5, 0.5), 2)
    turned = placed(soup, (0, 0, 0), 0.4, (3.0, 1.0, 0.5))
    flat = np.cross(turned.corners[:, 1] - turned.corners[:, 0], turned.corners[:, 2] - turned.corners[:, 0])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    assert np.abs((flat * turned.normals.mean(axis=1)).sum(axis=1)).min() > 0.8


def test_sphere_has_unit_radius_and_four_times_the_faces_a_step():
    assert len(unit_sphere(0)) == 20
    assert len(unit_sphere(2)) == 320
    assert np.abs(np.linalg.norm(unit_sphere(2), axis=-1) - 1).max() < 1e-6


def test_creases_stay_and_curves_are_smoothed():
    cube = box((1.0, 1.0, 1.0), Material.FLAT, (0.5, 0.5, 0.5))
    assert np.abs(creased_normals(cube.corners)).max(axis=-1) == pytest.approx(np.ones((10, 3)))
    sphere = unit_sphere(2)
    outward = np.einsum("fki,fki->fk", creased_normals(sphere), sphere)
    assert np.abs(outward).min() > 0.98


def test_noise_tiles_and_is_normalised():
    textures = noise_set(0)
    for texture in (textures.soft, textures.rough, textures.grain):
        assert texture.shape == (SIZE + 1, SIZE + 1)
        assert np.array_equal(texture[0], texture[-1])
        assert np.array_equal(texture[:, 0], texture[:, -1])
        assert abs(float(texture[:-1, :-1].mean())) < 1e-3
        assert float(texture[:-1, :-1].std()) == pytest.approx(1.0, abs=1e-3)


def test_noise_is_read_at_texels_and_repeats():
    texture = noise_set(0).grain
    x, y = np.array([3.0, 3.0 + SIZE, 3.0 - 2 * SIZE], np.float32), np.array([5.0, 5.0, 5.0 + SIZE], np.float32)
    assert sample(texture, x, y) == pytest.approx(np.full(3, texture[5, 3]), abs=1e-3)
    assert sample(texture, x[:0], y[:0]).shape == (0,)


def test_pools_have_different_noise():
    assert not np.array_equal(noise_set(0).soft, noise_set(1).soft)


@pytest.mark.parametrize("detail", [0, 1, 2, 3])
def test_trees_are_one_high_and_stand_on_the_ground(detail):
    soup = flora.tree(7, detail)
    _check(soup)
    low, high = soup.corners[..., 1].max(), -soup.corners[..., 1].min()
    assert 0 <= low < 0.1
    assert 0.85 < high < 1.15


def test_more_detail_means_more_leaves_of_the_same_tree():
    counts = [len(flora.tree(5, detail)) for detail in range(4)]
    assert counts == sorted(counts)
    assert counts[3] > 5 * counts[1]


def test_buildings_are_sound_and_differ_by_id():
    one, two = (buildings.building(i, 12.0, 9.0, 3, True) for i in (0, 1))
    _check(one)
    _check(two)
    assert one.corners[..., 1].min() < -8
    assert not np.array_equal(buildings.style(0).wall, buildings.style(1).wall)


@pytest.mark.parametrize("figure", [people.pedestrian, people.cyclist])
def test_people_stand_on_the_ground_at_human_size(figure):
    for seed in range(5):
        soup = figure(np.random.default_rng(seed))
        _check(soup)
        points = soup.corners.reshape(-1, 3)
        assert -0.08 < points[:, 1].max() < 0.08
        assert 1.55 < -points[:, 1].min() < 1.95
        assert np.ptp(points[:, 2]) < 0.95


def test_varied_people_stand_on_the_ground_and_differ_in_shape():
    """Headwear, long garments and bags combine: without one of them there are at most nine kinds of pedestrians."""
    for figure, least in ((people.pedestrian, 10), (people.cyclist, 5)):
        shapes = set()
        for seed in range(24):
            soup = figure(np.random.default_rng(seed), True)
            _check(soup)
            points = soup.corners.reshape(-1, 3)
            assert -0.08 < points[:, 1].max() < 0.08
            assert 1.5 < -points[:, 1].min() < 1.95
            assert np.ptp(points[:, 2]) < 1.1
            assert np.ptp(points[:, 0]) < 2.1
            shapes.add(len(soup))
        assert len(shapes) >= least


def test_a_pram_is_in_the_middle_before_who_pushes_it_on_the_ground():
    """The origin is the middle of both, so that their 3D box contains them; head behind, wheels in front."""
    for seed in range(24):
        alone, both = (people.pedestrian(np.random.default_rng(seed), True, pram) for pram in (False, True))
        _check(both)
        points = both.corners.reshape(-1, 3)
        assert len(both) > len(alone)
        assert np.abs(points[:, 0]).max() < people.PRAM_LENGTH_M / 2 + 0.25  # a foot reaches farther back
        assert np.ptp(points[:, 0]) > 1.3
        assert -0.08 < points[:, 1].max() < 0.08
        assert points[points[:, 1] < -1.5][:, 0].mean() < -0.3
        assert points[points[:, 0] > 0.4][:, 1].max() == pytest.approx(0, abs=0.02)


@pytest.mark.parametrize(
    ("figure", "count", "spread"), [(people.pedestrian, 1060, 0.557607), (people.cyclist, 1968, 0.504367)]
)
def test_plain_people_are_as_in_streets_generated_earlier(figure, count, spread):
    corners = figure(np.random.default_rng(3)).corners
    assert len(corners) == count
    assert float(corners.std()) == pytest.approx(spread, abs=1e-5)


def test_join_keeps_every_triangle():
    parts = [stick((0, 0, 0), (0, -1, 0), (0.1, 0.1), Material.METAL, (0.3, 0.3, 0.3)), unit_box()]
    assert len(join(parts)) == sum(map(len, parts))


def unit_box() -> Soup:
    return box((1.0, 1.0, 1.0), Material.WALL, (0.4, 0.4, 0.4))


def test_the_camera_response_rises_and_stays_in_range():
    response = draw_response(np.random.default_rng(0), "sun")
    ramp = np.repeat(np.linspace(0, 2, 50, dtype=np.float32)[:, None], 3, axis=1)
    visible = develop(ramp, response)
    assert (np.diff(visible, axis=0) > 0).all()
    assert visible[0] == pytest.approx(np.zeros(3))
    assert visible.max() <= 1.0


def test_the_sky_is_brightest_near_the_sun():
    up = np.array([0.0, -1.0, 0.0])
    light = draw_light(np.random.default_rng(1), up, sunny=True)
    away = 2 * (light.sun @ up) * up - light.sun
    radiance = sky_radiance(light, np.stack([light.sun, away]).astype(np.float32), noise_set(0))
    assert light.sun @ up > 0
    assert radiance[0].sum() > radiance[1].sum()
