"""Shadows on the ground."""

import numpy as np
import pytest
import torch

from scene_ir.derender import shadow, silhouette
from scene_ir.geometry import project
from scene_ir.image_filters import push_pull
from scene_ir.render.surfaces import shadow_density, shadow_offset
from scene_ir.types import Camera

CAMERA = Camera(torch.tensor([[380.0, 0, 239.5], [0, 380.0, 88.0], [0, 0, 1.0]]), 200, 480)
LEVEL = torch.tensor([0.0, -1.0, 0.0, 1.65])
CAR = silhouette.place_mesh(
    "hatchback", torch.tensor([0.5, 1.65, 9.0]), torch.tensor(0.4), torch.tensor([4.0, 1.5, 1.7])
)
ROAD = np.concatenate([np.zeros((92, 480)), np.ones((108, 480))]).astype(np.float32)


def view() -> shadow.GroundView:
    return shadow.view_ground(CAR, LEVEL, CAMERA)


def whole(ground: shadow.GroundView, name: str) -> np.ndarray:
    """A field of a view in the whole picture; infinite outside the window."""
    values = getattr(ground, name)
    frame = np.full((200, 480, *values.shape[2:]), np.inf, np.float32)
    frame[ground.window] = values
    return frame


def distance() -> np.ndarray:
    return whole(view(), "distance")


def vehicle() -> np.ndarray:
    return silhouette.render_silhouettes([CAR], CAMERA)[0]


def toward(x: float, z: float) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.tensor([x, -1.0, z]), dim=0)


def shaded(sun: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """A lit street on which the car's box shadow lies, and that shadow's factor."""
    local = whole(view(), "local")
    flat = torch.from_numpy(np.where(np.isfinite(local), local, 99.0)).reshape(-1, 2)
    size = CAR.size_lhw.expand(len(flat), 3)
    offset = shadow_offset(sun, CAR.yaw.expand(len(flat)), size[:, 1])
    factor = 1 - 0.8 * shadow_density(flat, size, offset).reshape(200, 480).numpy()
    image = np.full((200, 480, 3), 0.6, np.float32) * factor[..., None]
    image[vehicle()] = (0.5, 0.1, 0.1)
    return image.astype(np.float32), factor


def lit_ground(image: np.ndarray) -> shadow.GroundLight:
    """Brightness with the road continued smoothly."""

    def continue_street(unknown: np.ndarray) -> np.ndarray:
        return push_pull(image, ((ROAD > 0.5) & ~unknown).astype(np.float32))

    return shadow.estimate_ground_light(image, vehicle(), [view()], continue_street)


def test_ground_view_knows_the_footprints_corners_and_middle():
    ground = view()
    front = CAR.translation + torch.tensor([np.cos(0.4), 0, -np.sin(0.4)]).float() * 2.0
    u, v = project(front, CAMERA.matrix).round().long().tolist()
    assert whole(ground, "local")[v, u] == pytest.approx([2.0, 0.0], abs=0.12)
    assert distance()[v, u] == pytest.approx(0.0, abs=0.12)
    u, v = project(CAR.translation, CAMERA.matrix).round().long().tolist()
    assert distance()[v, u] == pytest.approx(-0.85, abs=0.12)
    assert np.isinf(distance()[:88]).all()


@pytest.mark.parametrize("place", [(0.5, 1.65, 9.0), (-2.5, 1.65, 2.0), (4.0, 1.65, 40.0)])
def test_ground_view_holds_all_ground_within_metres_of_the_footprint(place: tuple[float, float, float]):
    car = silhouette.place_mesh("hatchback", torch.tensor(place), torch.tensor(0.4), CAR.size_lhw)
    ground = shadow.view_ground(car, LEVEL, CAMERA)
    v, u = np.mgrid[0:200, 0:480]
    intrinsics = CAMERA.matrix.numpy()
    with np.errstate(divide="ignore"):
        z = 1.65 * intrinsics[1, 1] / np.maximum(v - intrinsics[1, 2], 0)
    x = (u - intrinsics[0, 2]) * np.minimum(z, 1e3) / intrinsics[0, 0]
    near = (np.hypot(x - place[0], z - place[2]) < 5.0) & (z > 0)
    assert near.any()
    assert np.isfinite(whole(ground, "distance")[near]).all()


def found_in(
    light: shadow.GroundLight,
    sun: torch.Tensor,
    allowed: np.ndarray = ROAD > 0.5,
    pixels: np.ndarray | None = None,
) -> np.ndarray:
    """The car's shadow when the sun is known."""
    ground, pixels = view(), vehicle() if pixels is None else pixels
    cast = shadow.cast_box_shadow(CAR, ground, sun)
    found = shadow.find_shadows(light, pixels, [ground], [allowed[ground.window]], [cast])[0][0]
    return ground.in_frame(found, allowed.shape)


def test_a_shadow_is_found_and_the_lit_road_is_not():
    image, factor = shaded(toward(0.6, 0.0))
    light = lit_ground(image)
    found = found_in(light, toward(0.6, 0.0))
    visible = ~vehicle() & (distance() < 2.4)
    assert found[visible & (factor < 0.5)].mean() > 0.95
    assert found[visible & (factor > 0.95)].mean() < 0.02
    assert not (found & vehicle()).any()


def test_shade_that_goes_on_beyond_a_cars_reach_is_not_its_shadow():
    image, _ = shaded(toward(0.0, 0.0))
    image[:, :260] *= 0.4
    image[92:110] *= 2.5
    light = lit_ground(np.clip(image, 0, 1))
    found = found_in(light, toward(0.0, 0.0))
    shade = (distance() > 1.2) & (distance() < 2.0) & ~vehicle()
    shade[:, 250:] = False
    assert found[shade].mean() < 0.15


@pytest.mark.parametrize("direction", [(0.8, 0.0), (-0.8, 0.1)])
def test_the_sun_is_on_the_other_side_of_the_shadow(direction):
    image, _ = shaded(toward(*direction))
    light = lit_ground(image)
    sun = shadow.estimate_sun(light, vehicle(), [CAR], [view()], toward(0.0, 0.0))
    assert float(sun[0]) * direction[0] > 0.2
    assert float(sun.norm()) == pytest.approx(1.0, abs=1e-5)


def test_without_shadows_the_assumed_sun_stays():
    image = np.full((200, 480, 3), 0.6, np.float32)
    assumed = toward(0.1, -0.3)
    light = lit_ground(image)
    assert torch.equal(shadow.estimate_sun(light, vehicle(), [CAR], [view()], assumed), assumed)


def test_reach_of_the_renderers_patch():
    ground = view()
    reach = shadow.reachable_ground(CAR, ground, toward(0.0, 0.0))
    assert reach[ground.distance < 0.5].all()
    assert not reach[ground.distance > 3.5].any()


def test_a_low_suns_shadow_is_found_to_its_end():
    sun = toward(-1.7, 0.3)
    image, factor = shaded(sun)
    light = lit_ground(image)
    estimate = shadow.estimate_sun(light, vehicle(), [CAR], [view()], toward(0.0, 0.0))
    azimuths = [float(torch.atan2(s[2], s[0])) for s in (estimate, sun)]
    assert abs(np.remainder(azimuths[0] - azimuths[1] + np.pi, 2 * np.pi) - np.pi) < 0.2
    found = found_in(light, sun)
    far = (factor < 0.75) & ~vehicle() & (distance() > 1.3)
    assert np.count_nonzero(far) > 200
    assert found[far].mean() > 0.9


def test_dark_ground_beyond_reach_counts_and_vanishes_with_longer_shadows():
    sun = toward(-1.8, 0.0)
    image, _ = shaded(sun)
    light = lit_ground(image)
    beyond = []
    for factor in (0.15, 1.0):
        lower = shadow.lengthen_shadows(sun, factor)
        assert float(lower[0] / lower[1]) == pytest.approx(factor * float(sun[0] / sun[1]), rel=1e-5)
        allowed = shadow.reachable_ground(CAR, view(), lower)
        casts = [shadow.cast_box_shadow(CAR, view(), lower)]
        beyond.append(shadow.find_shadows(light, vehicle(), [view()], [allowed], casts)[1])
    assert beyond[0] > 50
    assert beyond[1] == 0


def test_the_cast_is_the_renderers_and_ends_where_its_patch_does():
    sun = toward(0.6, 0.2)
    cast, (_, factor) = shadow.cast_box_shadow(CAR, view(), sun), shaded(sun)
    inside = shadow.reachable_ground(CAR, view(), sun)
    assert not cast[~inside].any()
    assert cast[inside] == pytest.approx((1 - factor[view().window][inside]) / 0.8, abs=1e-4)


def test_of_two_vehicles_the_nearer_one_owns_the_ground():
    other = silhouette.place_mesh("hatchback", torch.tensor([4.5, 1.65, 9.0]), torch.tensor(0.4), CAR.size_lhw)
    views = [view(), shadow.view_ground(other, LEVEL, CAMERA)]
    owner, nearest = shadow.nearest_views(views, (200, 480))
    distances = np.stack([whole(ground, "distance") for ground in views])
    assert np.array_equal(owner, distances.argmin(0))
    assert np.array_equal(nearest, distances.min(0))
    assert 0 < owner.mean() < 1


def test_factors_darken_only_in_their_region():
    image = np.full((4, 5, 3), 0.2, np.float32)
    background = np.full((4, 5, 3), 0.5, np.float32)
    background[0, 0] = 0.1
    region = np.zeros((4, 5), bool)
    region[:2] = True
    factor = shadow.shadow_factors(image, background, region)
    assert factor[1, 1] == pytest.approx([0.4] * 3)
    assert factor[0, 0] == pytest.approx([1.0] * 3)
    assert (factor[2:] == 1).all()


def test_a_dark_strip_of_road_is_no_shadow_with_the_street_continued():
    image, factor = shaded(toward(0.6, 0.0))
    strip = np.where(np.abs(whole(view(), "local")[..., 0] - 2.5) < 0.4, 0.6, 1.0).astype(np.float32)
    empty = np.full_like(image, 0.6) * strip[..., None]
    photograph = np.where(vehicle()[..., None], image, image * strip[..., None])
    smooth = lit_ground(photograph)
    continued = shadow.estimate_ground_light(photograph, vehicle(), [view()], lambda _: empty)
    dark = (strip < 1) & (factor > 0.98) & ~vehicle() & (distance() < 2.4)
    assert np.count_nonzero(dark) > 50
    wrong, right = (found_in(light, toward(0.6, 0.0)) for light in (smooth, continued))
    assert right[dark].mean() < 0.1 < wrong[dark].mean()


def test_several_suns_together_shade_as_one_by_one() -> None:
    generator = torch.Generator().manual_seed(3)
    local = 4 * torch.randn(50, 2, generator=generator)
    size = 1.5 + torch.rand(50, 3, generator=generator)
    offsets = torch.randn(5, 50, 2, generator=generator)
    together = shadow_density(local, size, offsets)
    assert together.shape == (5, 50)
    assert torch.equal(together, torch.stack([shadow_density(local, size, offset) for offset in offsets]))
