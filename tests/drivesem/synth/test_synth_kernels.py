"""The kernels compute what the plain numpy beside defines, and the weather they draw looks as it should."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from drivesem.synth import kernels, lamps
from drivesem.synth import render as rendering
from drivesem.synth.frames import SynthSettings, actor_soups, plan_frame
from drivesem.synth.layout import Marking, Road
from drivesem.synth.light import Light, Panorama, Response, develop
from drivesem.synth.render import render, see, sun_maps, take
from drivesem.synth.soup import Material, box, join, make, placed
from drivesem.synth.view import Setting, Shadow, View, blocks, fine_matrix, noise_set
from scene_ir.types import Camera
from tests.drivesem.synth import reference_render as reference
from tests.drivesem.synth.reference_light import reflected_radiance, sky_radiance, white_noise

PAINTED = [m for m in Material if m != Material.SKY]


def turned(heading: float) -> np.ndarray:
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]])


def a_view(heading: float = 0.0, position=(0.0, 0.0), size=(96, 320)) -> View:
    k = torch.tensor([[200.0, 0.0, size[1] / 2], [0.0, 200.0, size[0] / 3], [0.0, 0.0, 1.0]])
    return View(Camera(k, *size), turned(heading), 1.65, position, heading)


def a_light(view: View, **changes) -> Light:
    sun = view.rotation @ np.array([0.5, -0.75, -0.43])
    plain = Light(
        weather="sun",
        sun=sun / np.linalg.norm(sun),
        up=view.up,
        sun_colour=np.array([1.0, 0.95, 0.86]),
        zenith=np.array([0.17, 0.32, 0.74]),
        horizon=np.array([0.66, 0.80, 1.02]),
        ambient=np.array([0.165, 0.19, 0.235]),
        haze_per_m=0.001,
        clouds=0.35,
        cloud_seed=77.0,
    )
    return replace(plain, **changes)


RESPONSE = Response(2.2, np.array([1.02, 1.0, 0.96]), 1.3, 0.1, 0.5, 0.01)
ROAD = Road(
    kind="residential",
    curvature=0.0,
    lanes=(),
    strips=(),
    markings=(Marking(-3.0, 0.12, 1.0, 1.0), Marking(0.0, 0.12, 3.0, 9.0), Marking(3.0, 0.15, 1.0, 1.0)),
    flank_m=(-8.0, 8.0),
    pavements=(),
    crossing=(30.0, 36.0),
)


def a_setting(view: View, light: Light | None = None, **response) -> Setting:
    return Setting(view, ROAD, light or a_light(view), replace(RESPONSE, **response), noise_set(0), (1, 2, 3))


def a_world(view: View):
    """A road with a strip of each kind of ground, a box of each other material, and two actors before them."""
    grounds = [m for m in PAINTED if m <= Material.GRAVEL]
    parts = []
    for i, material in enumerate(grounds):
        x0, x1 = -12.0 + 4 * i, -8.0 + 4 * i
        points = np.array([[x0, 0, -14], [x1, 0, -14], [x1, 0, 120], [x0, 0, 120]], np.float32)
        triangles = points[np.array([[0, 1, 2], [0, 2, 3]])]
        uv = triangles[..., [0, 2]]
        down = np.broadcast_to([0.0, -1.0, 0.0], triangles.shape)
        parts.append(make(triangles, material, (0.12, 0.12, 0.13), down, uv, (3.7, 0.0, 0.0, 0.0)))
    for i, material in enumerate(m for m in PAINTED if m > Material.GRAVEL):
        pattern = (1.6, 2.9, 0.55, 0.5) if material == Material.FACADE else (0.4, 0.0, 0.0, 0.0)
        block = box((1.4, 4.0, 1.4), material, (0.3, 0.35, 0.25), pattern)
        parts.append(placed(block, (-10.0 + 1.7 * i, 0.0, 12.0 + 3 * (i % 3)), 0.4, (1.0, 1.0, 1.0)))
    for owner, x in ((1, -2.0), (2, 2.5)):
        car = placed(box((4.2, 1.5, 1.8), Material.PAINT, (0.5, 0.1, 0.1)), (x, 0.0, 8.0), 1.2, (1.0, 1.0, 1.0))
        parts.append(replace(car, owner=np.full(len(car), owner, np.int32)))
    world = join(parts)
    corners = (view.to_camera(world.corners) - view.centre).astype(np.float32)
    normals = (world.normals @ view.rotation.T).astype(np.float32)
    return replace(world, corners=corners, normals=normals)


SHADOWS = [Shadow((-2.0, 8.0), 1.2, (4.2, 1.5, 1.8)), Shadow((2.5, 8.0), 1.2, (4.2, 1.5, 1.8))]


def shaded(setting: Setting, develop_pixels):
    world = a_world(setting.view)
    sight, maps = see(world, setting.view), reference.sun_maps(world, setting)
    pixels = setting.view.camera.height * setting.view.camera.width
    image, shining = np.zeros((2, pixels, 3), np.float32)
    return image, develop_pixels(sight, setting, maps, SHADOWS, (image, np.ones(pixels, bool), shining)), shining


RAMP = np.stack(np.meshgrid(np.linspace(0, 1, 64), np.linspace(1, 0, 32)), axis=-1)
PANORAMA = Panorama(np.concatenate([RAMP, RAMP[..., :1] * 6], axis=2).astype(np.float32), 0.6)
WEATHERS = {
    "sun": {},
    "overcast": {"sun_colour": np.zeros(3), "clouds": 1.0},
    "fog": {"weather": "fog", "haze_per_m": 0.02, "sun_colour": np.full(3, 0.05)},
    "dusk": {"weather": "dusk", "sun": np.array([0.5, -0.15, 0.85])},
    "rain": {"wet": 0.9, "clouds": 1.0},
    "snow": {"snow": 0.8, "clouds": 1.0},
    "panorama": {"panorama": PANORAMA, "wet": 0.5},
}


@pytest.mark.parametrize("heading", [0.0, -0.5])
@pytest.mark.parametrize("weather", WEATHERS)
def test_materials_agree_with_numpy(weather, heading):
    view = a_view(heading, (1.5, -2.0), (160, 480))
    light = a_light(view, heading=heading, **WEATHERS[weather])
    setting = a_setting(view, replace(light, sun=light.sun / np.linalg.norm(light.sun)))
    fast, touched, shining = shaded(setting, kernels.develop_pixels)
    slow, expected, expected_shining = shaded(setting, reference.develop_pixels)
    assert not shining.any()
    assert not expected_shining.any()
    difference = np.abs(fast - slow).max(axis=1)
    assert (difference > 2e-3).mean() < 5e-4
    assert np.quantile(difference, 0.99) < 5e-4
    assert (touched != expected).mean() < 2e-4
    assert slow.std() > 0.05


NIGHT = {
    "sun_colour": np.zeros(3), "zenith": np.full(3, 0.001), "horizon": np.full(3, 0.004), "ambient": np.full(3, 0.008),
    "night": 1.0,
}  # fmt: skip


def some_lamps(view: View) -> np.ndarray:
    """A street lamp, headlamps from behind the camera and towards it, a tail lamp of actor 1."""
    ahead = view.rotation @ np.array([np.sin(view.heading), 0.0, np.cos(view.heading)])
    places = (
        view.to_camera(np.array([[2, -7, 14], [0.6, -0.7, 1], [-3, -0.7, 40], [-2, -0.8, 8]], float)) - view.centre
    )
    axes = np.stack([-view.up, ahead, -ahead, -ahead])
    colours = np.array([[26, 18, 10], [120, 100, 80], [90, 95, 100], [2, 0.1, 0.05]])
    kinds = np.array([[lamps.STREET, 0], [lamps.BEAM, 0], [lamps.BEAM, 0], [lamps.TAIL, 1]])
    return np.concatenate([places, axes, colours, kinds], axis=1).astype(np.float32)


@pytest.mark.parametrize("changes", [{}, {"wet": 0.9}, {"haze_per_m": 0.02}], ids=["dry", "wet", "foggy"])
def test_lamps_by_night_agree_with_numpy(changes):
    view = a_view(-0.3, (1.5, -2.0), (160, 480))
    light = a_light(view, heading=-0.3, **NIGHT, **changes)
    setting = replace(a_setting(view, light), lamps=some_lamps(view))
    fast, _, shining = shaded(setting, kernels.develop_pixels)
    slow, _, expected = shaded(setting, reference.develop_pixels)
    difference = np.abs(fast - slow).max(axis=1)
    assert (difference > 2e-3).mean() < 1e-3
    assert np.quantile(difference, 0.99) < 5e-4
    assert slow.std() > 0.05
    assert shining.sum() == pytest.approx(expected.sum(), rel=1e-3)
    unlit, _, _ = shaded(replace(setting, lamps=setting.lamps[:0]), kernels.develop_pixels)
    assert (fast >= unlit - 1e-6).all()
    assert fast.mean() > 2 * unlit.mean()


def test_the_scene_shows_every_material():
    view = a_view(size=(160, 480))
    assert set(PAINTED) <= {Material(m) for m in np.unique(see(a_world(view), view).material)}


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_street_photographed_by_kernel_and_by_numpy(seed):
    plan = plan_frame(11, seed, settings=SynthSettings(camera=1))
    k = torch.tensor([[260.0, 0.0, 220.0], [0.0, 260.0, 60.0], [0.0, 0.0, 1.0]])
    view = replace(plan.setting.view, camera=Camera(k, 130, 440))
    setting = replace(plan.setting, view=view)
    world = join([a_world(view), *actor_soups(replace(plan, setting=setting))])
    fast, slow = see(world, view), reference.see(world, view)
    assert (fast.owner != slow.owner).mean() < 1e-3
    assert (fast.material != slow.material).mean() < 1e-3
    assert (np.isinf(fast.depth) == np.isinf(slow.depth)).all()
    land = np.isfinite(slow.depth) & (fast.owner == slow.owner)
    assert np.quantile(np.abs(fast.depth[land] / slow.depth[land] - 1), 0.995) < 1e-5
    one, two = render(fast, world, [], setting).image, reference.render(slow, world, [], setting)
    assert (np.abs(one.astype(int) - two).max(axis=2) > 1).mean() < 0.02


def test_as_many_threads_as_you_like_give_the_same_bytes():
    view = a_view(size=(200, 600))
    world, setting = a_world(view), a_setting(view)
    selected, found = torch.get_num_threads(), []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            sight = see(world, view)
            picture = render(sight, world, SHADOWS, setting)
            assert picture.sun_maps is not None
            found.append((sight.face, sight.depth, picture.sun_maps.depth, picture.developed, picture.image))
    finally:
        torch.set_num_threads(selected)
    for one, other in zip(*found, strict=True):
        assert one.tobytes() == other.tobytes()


def test_the_nearest_sample_is_the_nearest():
    view = a_view()
    sight = see(a_world(view), view)
    places = kernels.nearest(sight.depth)
    assert places.dtype == np.int64
    assert np.array_equal(sight.depth.reshape(-1)[places], sight.depth_m)
    rows, columns = np.divmod(places, sight.depth.shape[1])
    assert np.array_equal(rows // 2, np.broadcast_to(np.arange(96)[:, None], (96, 320)))
    assert np.array_equal(columns // 2, np.broadcast_to(np.arange(320), (96, 320)))
    assert np.array_equal(places[0, :2], [0, 2])  # of equal ones the first


def test_ground_below_the_camera_is_cut_at_the_near_plane():
    view = a_view()
    sight = see(a_world(view), view)
    row = sight.depth.shape[0] - 1
    expected = 1.65 * 200 / ((row + 0.5) / 2 - 0.5 - 32)
    ground = sight.material[row] <= Material.GRAVEL
    assert ground.mean() > 0.9
    assert sight.depth[row][ground] == pytest.approx(expected, rel=1e-5)


def test_shadow_maps_lie_before_the_camera():
    view = a_view(0.6, (40.0, -7.0))
    maps = sun_maps(a_world(view), a_setting(view))
    assert maps is not None
    ahead = np.array([40.0 + 10 * np.sin(0.6) + 2 * np.cos(0.6), 0.0, -7.0 + 10 * np.cos(0.6) - 2 * np.sin(0.6)])
    place = maps.rows[:, :3] @ (view.to_camera(ahead) - view.centre) + maps.rows[:, 3]
    assert place[:2] == pytest.approx([2.0, 10.0], abs=1e-4)


def test_a_turned_and_moved_camera_sees_the_same_shadows():
    developed = []
    for heading, position in ((0.0, (0.0, 0.0)), (-0.5, (3.0, 1.0))):
        view = a_view(heading, position, (160, 480))
        world = a_world(view)
        picture = render(see(world, view), world, SHADOWS, a_setting(view))
        for point in ([1.2, 0.0, 8.2], [0.4, 0.0, 6.5]):
            place = fine_matrix(view) @ (view.to_camera(np.array(point)) - view.centre)
            u, v = np.rint(place[:2] / place[2] / 2).astype(int)
            developed.append(float(picture.developed.reshape(160, 480, 3)[v, u].mean()))
    dark, light = developed[:2]
    assert dark < 0.8 * light
    assert developed[2:] == pytest.approx([dark, light], rel=0.12)


def test_wet_ground_is_darker_below_and_mirrors_the_sky_far_away():
    view = a_view(size=(160, 480))
    sight = see(a_world(view), view)
    cloudy = a_light(view, sun_colour=np.zeros(3), ambient=np.full(3, 0.45), clouds=1.0)
    dry = render(sight, sight.faces, [], a_setting(view, cloudy)).developed.reshape(160, 480, 3)
    wet = render(sight, sight.faces, [], a_setting(view, replace(cloudy, wet=1.0))).developed.reshape(160, 480, 3)
    material, row = blocks(sight.material)[0], np.arange(160)[:, None]
    grass, slabs = material == Material.GRASS, material == Material.PAVEMENT
    assert wet[grass & (row < 90)].mean() < 0.95 * dry[grass & (row < 90)].mean()
    near, far = slabs & (row > 140), slabs & (row < 90)
    assert far.sum() > 30
    assert (wet[far] / dry[far]).mean() > 1.05 * (wet[near] / dry[near]).mean()
    car = blocks(sight.owner)[0] > 0
    assert np.abs(wet[car] - dry[car]).mean() < 0.02


def test_panoramas_are_the_right_way_up_and_turn_with_the_camera():
    light = replace(a_light(a_view()), panorama=replace(PANORAMA, turn_rad=0.0))
    textures = noise_set(0)
    up, ahead, right = np.eye(3, dtype=np.float32)[[1, 2, 0]] * np.array([[-1], [1], [1]], np.float32)
    colours = sky_radiance(light, np.stack([up, ahead, right]), textures)
    assert colours[0, 1] == pytest.approx(1.0, abs=0.02)
    assert colours[1:, 1] == pytest.approx([0.5, 0.5], abs=0.02)
    assert colours[1:, 0] == pytest.approx([0.5, 0.75], abs=0.02)
    later = sky_radiance(replace(light, heading=np.pi / 2), np.stack([ahead]), textures)
    assert later[0, 0] == pytest.approx(0.75, abs=0.02)
    moved = replace(light, panorama=replace(PANORAMA, turn_rad=np.pi / 2))
    assert sky_radiance(moved, np.stack([right]), textures)[0, 0] == pytest.approx(0.5, abs=0.02)
    mirrored = reflected_radiance(light, np.stack([right + up * 2]) / np.sqrt(5), textures, np.zeros(3))
    assert mirrored[0, 2] == pytest.approx(4.0)


def test_display_values_from_the_table_are_those_of_the_formula():
    view = a_view()
    fog = a_light(view, weather="fog", horizon=np.array([0.003, 0.4, 30.0]))
    setting = a_setting(view, fog)
    sight = see(make(np.zeros((0, 3, 3)), Material.ROAD, (0.1, 0.1, 0.1)), view)
    developed = render(sight, sight.faces, [], setting).developed
    expected = develop((fog.horizon * 0.8).astype(np.float32)[None], RESPONSE)
    assert np.abs(developed - expected).max() < 1e-4


def test_grain_is_normal_and_agrees_with_numpy():
    noise = white_noise(5, 400_000)
    assert noise.mean() == pytest.approx(0, abs=0.01)
    assert noise.std() == pytest.approx(1, abs=0.01)
    assert np.mean(np.abs(noise) > 2) == pytest.approx(0.0455, abs=0.005)
    spectrum = np.abs(np.fft.rfft(noise))[1:]
    assert spectrum.max() < 6 * np.sqrt(len(noise))
    assert abs(np.corrcoef(noise, white_noise(6, 400_000))[0, 1]) < 0.01
    view = a_view()
    image = np.random.default_rng(0).random((96, 320, 3), dtype=np.float32)
    setting = a_setting(view, noise=0.05)
    one, two = take(image, setting), reference.take(image, setting)
    assert np.abs(one.astype(int) - two).max() <= 1
    assert (one != two).mean() < 1e-3
    assert not np.array_equal(take(image, replace(setting, grain_seed=(1, 2, 4))), one)


def test_rain_streaks_follow_the_seed_and_fall():
    view = a_view(size=(200, 600))
    grey = np.full((200, 600, 3), 0.3, np.float32)
    setting = a_setting(view, streaks=1.0, noise=0.0, vignette=0.0)
    image = take(grey, setting).astype(int)
    assert np.array_equal(take(grey, setting), image)
    assert 0.02 < (image != image.min()).mean() < 0.6
    assert image.min() == round(0.3 * 255)
    assert image.max() < 140
    along = np.abs(np.diff(image, axis=0)).mean()
    across = np.abs(np.diff(image, axis=1)).mean()
    assert along < 0.6 * across
    assert not np.array_equal(take(grey, replace(setting, grain_seed=(9, 9))), image)
    assert np.array_equal(
        take(grey, replace(setting, response=replace(setting.response, streaks=0.0))), grey * 0 + 76
    )


def test_chromatic_error_moves_red_outwards_and_blue_inwards():
    view = a_view()
    image = np.zeros((96, 320, 3), np.float32)
    image[:, 300:] = 1.0
    developed = rendering._fringed(image, 0.5)
    assert np.array_equal(developed[..., 1], image[..., 1])
    share = (300 - 0.5 - 159.5) / np.hypot(159.5, 47.5) * 0.5
    edge = developed[48].sum(axis=0)
    assert edge[1] - edge[0] == pytest.approx(share, abs=0.02)
    assert edge[2] - edge[1] == pytest.approx(share, abs=0.02)
    assert view.camera.width == 320


def test_an_empty_world_is_all_sky():
    view = a_view()
    sight = see(make(np.zeros((0, 3, 3)), Material.ROAD, (0.1, 0.1, 0.1)), view)
    assert (sight.face == -1).all()
    assert np.isinf(sight.depth).all()
    picture = render(sight, sight.faces, [], a_setting(view))
    assert not picture.touched.any()
    assert kernels.nearest(sight.depth).shape == (96, 320)
