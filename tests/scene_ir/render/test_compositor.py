"""Re-rendering: identity, moved vehicles against ground truth, order, shadows, borders."""

import gc
import math
import weakref
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from scene_ir.errors import ShapeError
from scene_ir.raster import verbs
from scene_ir.raster.layout import PixelLayout
from scene_ir.render import blend, surfaces
from scene_ir.render.compositor import Compositor, render
from scene_ir.render.prepare import RenderSettings
from scene_ir.render.sources import SolveSettings, analytic_shadows, photograph_scene, solve_sources
from scene_ir.types import Crop, Mesh, Objects, Part, Render, SceneIR, convert_scene

REFERENCE = RenderSettings(backend="reference")
IDENTITY = 1e-5
Street = Callable[[torch.dtype], SceneIR]


def _regions(scene: SceneIR, margin: int = 0) -> Tensor:
    """(H, W) bool: the crops of vehicles and shadows."""
    compositor = Compositor(scene, REFERENCE)
    layers = compositor.draw_layers(compositor.scene.objects)
    inside = torch.zeros_like(scene.depth, dtype=torch.bool)
    for rects in (layers.layout.rects, layers.shadow_layout.rects):
        for x0, y0, x1, y1 in rects.tolist():
            inside[max(y0 - margin, 0) : y1 + margin, max(x0 - margin, 0) : x1 + margin] = True
    return inside


def _moved(scene: SceneIR, dx: float = 0.0, dz: float = 0.0, dyaw: float = 0.0) -> SceneIR:
    step = scene.objects.translation.new_tensor([dx, 0.0, dz])
    return scene.with_objects(translation=scene.objects.translation + step, yaw=scene.objects.yaw + dyaw)


def _only(objects: Objects, index: list[int]) -> Objects:
    names = ("mesh_index", "translation", "yaw", "size_lhw", "ffd", "texture_code", "category", "box2d")
    names += ("lamps", "truncation", "occlusion")
    source = tuple(objects.source[i] for i in index) if objects.source else ()
    return replace(objects, source=source, **{n: getattr(objects, n)[index] for n in names})


@pytest.mark.parametrize(("backend", "dtype"), [("reference", torch.float64), ("warp", torch.float32)])
def test_unperturbed_render_is_the_photograph(photographed: SceneIR, backend, dtype: torch.dtype) -> None:
    scene = convert_scene(photographed, dtype)
    image = Compositor(scene, RenderSettings(backend=backend)).render(scene).image
    assert float((image - scene.photograph).abs().max()) < IDENTITY
    assert torch.equal((image * 255).round(), (scene.photograph * 255).round())
    outside = ~_regions(scene)
    assert torch.equal(image[:, outside], scene.photograph[:, outside])


@pytest.mark.parametrize("name", ["sky", "road"])
def test_a_car_hides_sky_and_road_from_weather(photographed: SceneIR, name: str) -> None:
    """Overcast covers the sky behind a car, and a wet road mirrors, but the car keeps its colours."""
    weather = torch.tensor([0.0, 0.0, 0.0, 1.0] if name == "sky" else [0.0, 1.0, 0.0, 0.0]).double()

    def drawn(value: float) -> Render:
        maps = {"sky": 0.0, "road": 0.0} | {name: value}
        filled = {n: torch.full_like(photographed.environment.sky, v) for n, v in maps.items()}
        environment = replace(photographed.environment, **filled)
        scene = replace(photographed, environment=environment)
        changed = replace(environment, weather=weather)
        # The same airlight, whatever counts as sky.
        compositor = Compositor(scene, REFERENCE)
        compositor.air = photographed.photograph.new_tensor([0.7, 0.75, 0.8])
        compositor.lamps = Compositor(photographed, REFERENCE).lamps
        return compositor.render(replace(scene, environment=changed))

    without, everywhere = drawn(0.0), drawn(1.0)
    inside = torch.zeros_like(without.object_id, dtype=torch.bool)
    for crop in without.opacity:
        (alpha,) = crop.values
        inside[crop.y0 : crop.y0 + alpha.shape[0], crop.x0 : crop.x0 + alpha.shape[1]] |= alpha > 1 - 1e-9
    outside = without.object_id == 0
    change = (everywhere.image - without.image).abs().amax(0)
    assert int(inside.sum()) > 200
    assert float(change[inside].max()) < 1e-9
    assert float(change[outside].mean()) > 0.01


@pytest.mark.parametrize("matte", ["eroded", "binary", "noisy", "empty"])
def test_identity_holds_for_any_matte(street: Street, photographed: SceneIR, matte: str) -> None:
    bare = replace(street(torch.float64), photograph=photographed.photograph)
    generator = torch.Generator().manual_seed(4)

    def spoil(values: Tensor) -> Tensor:
        if matte == "eroded":
            return (-torch.nn.functional.max_pool2d(-values[None], 5, 1, 2))[0]
        if matte == "binary":
            return (values > 0.5).to(values)
        if matte == "empty":
            return torch.zeros_like(values)
        return values * torch.rand(values.shape, generator=generator, dtype=values.dtype)

    crops = [replace(s.foreground, values=spoil(s.foreground.values[3:])) for s in photographed.objects.source]
    solved = solve_sources(bare, crops, analytic_shadows(bare, REFERENCE), SolveSettings(backend="reference"))
    image = Compositor(solved, REFERENCE).render(solved).image
    assert float((image - photographed.photograph).abs().max()) < IDENTITY
    for source in solved.objects.source:
        values = source.foreground.values
        assert float(values.min() if values.numel() else 0.0) > -1e-9
        assert bool((values[:3] <= values[3:] + 1e-9).all())


def test_background_contains_no_vehicles_and_shadows(street: Street, photographed: SceneIR) -> None:
    truth = street(torch.float64).background
    free = torch.ones_like(photographed.depth, dtype=torch.bool)
    for source in photographed.objects.source:
        crop = source.foreground
        h, w = crop.values.shape[1:]
        free[crop.y0 : crop.y0 + h, crop.x0 : crop.x0 + w] &= crop.values[3] == 0
    before = (photographed.photograph - truth).abs().amax(dim=0)
    after = (photographed.background - truth).abs().amax(dim=0)
    assert float(before[free].max()) > 0.1
    assert float(after[free].max()) < 0.02


@pytest.mark.parametrize(
    ("move", "worst"), [((0.5, 0.0, 0.0), 0.02), ((0.0, 1.0, 0.0), 0.02), ((0.0, 0.0, 0.15), 0.03), ((0.3, -0.5,
    -0.15), 0.035)]
)  # fmt: skip
def test_moved_vehicles_match_the_ground_truth(
    street: Street, photographed: SceneIR, move: tuple[float, float, float], worst: float
) -> None:
    """Against the same street rendered with vehicles and shadows at the new positions."""
    truth = Compositor(street(torch.float64), REFERENCE).render(_moved(street(torch.float64), *move))
    seen = Compositor(photographed, REFERENCE).render(_moved(photographed, *move))
    vehicles = (truth.object_id > 0) | (seen.object_id > 0)
    error = (truth.image - seen.image).abs().mean(dim=0)
    assert float(error[vehicles].mean()) < worst
    assert float(error.mean()) < 0.6 * float((truth.image - photographed.photograph).abs().mean())
    assert float((truth.object_id == seen.object_id).to(torch.float64).mean()) > 0.98
    both = (truth.object_id == seen.object_id) & (truth.object_id > 0)
    assert float((truth.depth - seen.depth)[both].abs().median()) < 0.1


@pytest.mark.parametrize("grown", [1.1, 0.9])
def test_resized_vehicles_match_the_ground_truth(street: Street, photographed: SceneIR, grown: float) -> None:
    """Against the same street rendered with larger or smaller vehicles and shadows."""
    drawn = street(torch.float64)
    truth = Compositor(drawn, REFERENCE).render(drawn.with_objects(size_lhw=grown * drawn.objects.size_lhw))
    lhw = grown * photographed.objects.size_lhw
    seen = Compositor(photographed, REFERENCE).render(photographed.with_objects(size_lhw=lhw))
    vehicles = (truth.object_id > 0) | (seen.object_id > 0)
    error = (truth.image - seen.image).abs().mean(dim=0)
    assert float(error[vehicles].mean()) < 0.03
    assert float(error.mean()) < 0.5 * float((truth.image - photographed.photograph).abs().mean())
    assert float((truth.object_id == seen.object_id).to(torch.float64).mean()) > 0.98
    # They stand where they stood: no row of the picture below their wheels is theirs.
    still = Compositor(photographed, REFERENCE).render(photographed)
    feet = [int((picture.object_id == 1).any(dim=1).nonzero()[-1]) for picture in (still, seen)]
    assert abs(feet[1] - feet[0]) <= 2


def test_shadows_grow_with_their_vehicle_and_hardly_shrink(photographed: SceneIR) -> None:
    dark = []
    for grown in (1.0, 1.1, 0.9):
        scene = photographed.with_objects(size_lhw=grown * photographed.objects.size_lhw)
        layers = Compositor(photographed, REFERENCE).draw_layers(scene.objects)
        dark.append(float((1 - layers.shadow).sum()))
    assert 1.1 < dark[1] / dark[0] < 1.35
    # Its photographed rim would be left behind.
    assert 0.95 < dark[2] / dark[0] <= 1


def test_turned_vehicles_have_no_cracks(street: Street, photographed: SceneIR) -> None:
    """Well inside the mesh a turned vehicle is opaque, also along its former outline."""
    turned = _moved(photographed, dyaw=0.3)
    truth = Compositor(street(torch.float64), REFERENCE).render(_moved(street(torch.float64), dyaw=0.3))
    seen = Compositor(photographed, REFERENCE).render(turned)
    for full, crop in zip(truth.opacity, seen.opacity, strict=True):
        whole = torch.zeros_like(photographed.depth)
        whole[full.y0 : full.y0 + full.values.shape[1], full.x0 : full.x0 + full.values.shape[2]] = full.values[0]
        solid = -torch.nn.functional.max_pool2d(-whole[None, None], 5, 1, 2)[0, 0] > 0.999
        h, w = crop.values.shape[1:]
        window = solid[crop.y0 : crop.y0 + h, crop.x0 : crop.x0 + w]
        assert int(window.sum()) > 30
        assert float(crop.values[0][window].min()) > 0.9


def test_shadow_moves_with_its_vehicle(photographed: SceneIR) -> None:
    lone = replace(photographed, objects=_only(photographed.objects, [0]))
    dark = Compositor(lone, REFERENCE).render(_moved(lone, dz=3.0))
    none = replace(lone.objects.source[0], shadow=None)
    bright_scene = replace(lone, objects=replace(lone.objects, source=(none,)))
    bright = Compositor(bright_scene, REFERENCE).render(_moved(bright_scene, dz=3.0))
    darker = (bright.image - dark.image).amax(dim=0) > 0.02
    rows = darker.any(dim=1).nonzero()[:, 0]
    fy, eye, centre = 110.0, 1.65, 80 * 0.4
    near, far = 9.0 + 3.0 - 3.5, 9.0 + 3.0 + 4.0
    assert int(darker.sum()) > 10
    assert centre + fy * eye / far - 1 <= int(rows.min())
    assert int(rows.max()) <= centre + fy * eye / near + 1


def test_order_of_objects_does_not_matter(photographed: SceneIR) -> None:
    turned = _moved(photographed, dyaw=0.1)
    image = Compositor(photographed, REFERENCE).render(turned).image
    order = [2, 0, 1]
    mixed = replace(photographed, objects=_only(photographed.objects, order))
    again = Compositor(mixed, REFERENCE).render(replace(turned, objects=_only(turned.objects, order)))
    torch.testing.assert_close(image, again.image, rtol=0, atol=1e-9)


def test_texture_code_changes_only_one_vehicle(photographed: SceneIR) -> None:
    code = torch.zeros(3, 5, dtype=torch.float64)
    code[1, 1] = 0.8
    compositor = Compositor(photographed, REFERENCE)
    plain, painted = (compositor.render(s) for s in (photographed, photographed.with_objects(texture_code=code)))
    changed = (plain.image != painted.image).any(dim=0)
    crop = plain.opacity[1]
    h, w = crop.values.shape[1:]
    allowed = torch.zeros_like(changed)
    allowed[crop.y0 : crop.y0 + h, crop.x0 : crop.x0 + w] = crop.values[0] > 0
    assert int(changed.sum()) > 50
    assert not bool((changed & ~allowed).any())
    assert float((painted.image - plain.image)[0][changed].mean()) > 0.02


def test_weather_changes_vehicles_and_foliage_does_not(photographed: SceneIR) -> None:
    compositor = Compositor(photographed, REFERENCE)
    plain = compositor.render(photographed)
    solid = torch.zeros_like(photographed.depth)
    for crop in plain.opacity:
        h, w = crop.values.shape[1:]
        window = solid[crop.y0 : crop.y0 + h, crop.x0 : crop.x0 + w]
        window.copy_(torch.maximum(window, crop.values[0]))
    fog = compositor.render(
        photographed.with_environment(weather=torch.tensor([0.8, 0, 0, 0], dtype=torch.float64))
    )
    leaves = compositor.render(
        photographed.with_environment(foliage=torch.tensor([0.8, 0.2, 0], dtype=torch.float64))
    )
    inside = solid > 0.999
    assert float((fog.image - plain.image)[:, inside].abs().mean()) > 0.03
    assert torch.equal(leaves.image[:, inside], plain.image[:, inside])
    assert float((leaves.image - plain.image).abs().mean()) > 0.005


def _finite(result: Render) -> bool:
    low, high = float(result.image.detach().min()), float(result.image.detach().max())
    return bool(torch.isfinite(result.image).all()) and 0.0 <= low <= high <= 1.0


@pytest.mark.parametrize(
    "place", [[0.0, 1.65, -10.0], [60.0, 1.65, 10.0], [-1.9, 1.65, 1.5], [0.0, 1.65, 0.2]],
    ids=["behind", "beside", "through the near plane", "around the camera"],
)  # fmt: skip
def test_vehicles_out_of_view_and_across_the_near_plane(photographed: SceneIR, place: list[float]) -> None:
    lone = replace(photographed, objects=_only(photographed.objects, [0]))
    translation = torch.tensor([place], dtype=torch.float64, requires_grad=True)
    out = Compositor(lone, REFERENCE).render(lone.with_objects(translation=translation))
    assert _finite(out)
    out.image.sum().backward()
    assert translation.grad is None or bool(torch.isfinite(translation.grad).all())
    if place[2] < 0 or place[0] > 50:
        assert out.opacity[0].values.numel() == 0
        assert torch.equal(out.image, lone.background)


def test_truncated_vehicle_renders_exactly_and_can_move_into_view(street: Street) -> None:
    bare = street(torch.float64)
    at = bare.objects.translation.clone()
    at[0] = at.new_tensor([-4.6, 1.65, 6.5])
    bare = bare.with_objects(translation=at)
    shot = Compositor(bare, REFERENCE).render(bare)
    assert shot.opacity[0].x0 == 0
    taken = replace(bare, photograph=(shot.image * 255).round() / 255, objects=_only(bare.objects, [0, 2]))
    alphas = [shot.opacity[0], shot.opacity[2]]
    solved = solve_sources(taken, alphas, analytic_shadows(taken, REFERENCE), SolveSettings(backend="reference"))
    image = Compositor(solved, REFERENCE).render(solved).image
    assert float((image - taken.photograph).abs().max()) < IDENTITY
    pulled = Compositor(solved, REFERENCE).render(_moved(solved, dx=1.5))
    truth = Compositor(bare, REFERENCE).render(_moved(bare, dx=1.5))
    mask = truth.object_id == 1
    assert float((pulled.object_id == 1)[mask].to(torch.float64).mean()) > 0.97
    assert float((pulled.image - truth.image).abs().mean(dim=0)[mask].mean()) < 0.08


def test_a_compositor_is_freed_with_its_last_reference_and_gradients_remain(photographed: SceneIR) -> None:
    yaw = photographed.objects.yaw.clone().requires_grad_(True)
    gc.collect()
    gc.disable()
    try:
        compositor = Compositor(photographed)
        image = compositor.render(photographed.with_objects(yaw=yaw)).image
        gone = weakref.ref(compositor)
        del compositor
        assert gone() is None
        image.square().mean().backward()
    finally:
        gc.enable()
    assert yaw.grad is not None
    assert bool(torch.isfinite(yaw.grad).all())


def test_no_objects(photographed: SceneIR) -> None:
    empty = replace(photographed, objects=_only(photographed.objects, []))
    (out,) = render([empty], REFERENCE)
    assert torch.equal(out.image, empty.background)
    assert out.opacity == ()


def test_wrong_number_of_objects_is_rejected(photographed: SceneIR) -> None:
    fewer = replace(photographed, objects=_only(photographed.objects, [0]))
    with pytest.raises(ShapeError, match="the 3 of the base scene"):
        Compositor(photographed, REFERENCE).render(fewer)
    with pytest.raises(ShapeError, match="one an object, 3"):
        solve_sources(photographed, [])


def test_blend_equals_the_formula_in_values_and_gradients() -> None:
    generator = torch.Generator().manual_seed(1)
    layers = torch.tensor([[0, 0, 4, 3], [2, 1, 6, 5]])
    shadows = torch.tensor([[1, 1, 5, 4]])

    plan = blend.BlendPlan.from_layouts(PixelLayout.from_rects(layers), PixelLayout.from_rects(shadows), (1, 0))

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64).requires_grad_()

    canvas, shadow, colour, opacity = rand(4, 5, 6), rand(12, 3), rand(28, 4), rand(28)
    behind, z = torch.full((5, 6), 9.0, dtype=torch.float64), torch.arange(28, dtype=torch.float64) / 4

    def blended(*what: Tensor) -> Tensor:
        return blend.composite(what[0], behind, (*what[1:], z), plan, False)[0]

    out = blended(canvas, shadow, colour, opacity)
    expected = canvas.detach().clone()
    expected[:3, 1:4, 1:5] *= shadow.detach().T.reshape(3, 3, 4)
    for part, (rows, columns), size in ((slice(12, 28), (slice(1, 5), slice(2, 6)), (4, 4)),
                                        (slice(0, 12), (slice(0, 3), slice(0, 4)), (3, 4))):  # fmt: skip
        under = expected[:, rows, columns]
        clear = 1 - opacity.detach()[part].reshape(size)
        expected[:, rows, columns] = colour.detach()[part].T.reshape(4, *size) + clear * under
    torch.testing.assert_close(out.detach(), expected)
    assert torch.autograd.gradcheck(blended, (canvas, shadow, colour, opacity))

    single = tuple(t.detach().float().requires_grad_() for t in (canvas, shadow, colour, opacity))
    scaled = [single[0], single[1], 3.0 * single[2] - 1.0, single[3]]  # layers beyond [0, 1], for the clamping
    for clamped in (False, True):
        what = (scaled[1], scaled[2], scaled[3], z.float())
        fast = blend.composite(scaled[0], behind.float(), what, plan, clamped, "warp")
        plain = blend.composite(scaled[0], behind.float(), what, plan, clamped, "reference")
        torch.testing.assert_close(fast, plain)
        weight = torch.rand(4, 5, 6, generator=generator)
        for a, b in zip(
            *(torch.autograd.grad((o[0] * weight).sum(), single, retain_graph=True) for o in (fast, plain)),
            strict=True,
        ):
            torch.testing.assert_close(a, b)


def _order(cars: list[tuple[float, float, float, float]]) -> list[int]:
    """Paint order of cars 2 m wide, given (x, z, yaw, length)."""
    table = torch.tensor(cars, dtype=torch.float64)
    count = len(cars)
    translation = torch.stack([table[:, 0], torch.full((count,), 1.6, dtype=torch.float64), table[:, 1]], dim=1)
    size = torch.stack([table[:, 3], torch.full_like(table[:, 3], 1.5), torch.full_like(table[:, 3], 2.0)], dim=1)
    return blend.paint_order(size, table[:, 2], translation, torch.zeros(3, dtype=torch.float64))


def test_paint_order_of_a_car_next_to_a_long_truck() -> None:
    half = math.pi / 2
    ahead, truck_right = (0.0, 14.0, half, 4.0), (3.5, 16.0, half, 16.0)
    assert _order([ahead, truck_right]) == [1, 0]
    assert _order([truck_right, ahead]) == [0, 1]
    # The truck's middle and nearest point are nearer, yet the car stands before its side.
    beyond = (0.5, 22.0, half, 4.0)
    assert _order([beyond, truck_right]) == [1, 0]


@given(st.integers(0, 10_000))
@settings(max_examples=20)
def test_paint_order_never_puts_a_hidden_car_over_its_occluder(seed: int) -> None:
    """Cars in a row on a ray from the camera."""
    generator = torch.Generator().manual_seed(seed)
    far = torch.randperm(5, generator=generator).tolist()
    yaw = (6.0 * torch.rand(5, generator=generator)).tolist()
    slope = float(torch.rand(1, generator=generator)) - 0.5
    cars = [(slope * (8.0 + 7.0 * k), 8.0 + 7.0 * k, yaw[i], 4.0) for i, k in enumerate(far)]
    assert [far[i] for i in _order(cars)] == [4, 3, 2, 1, 0]


def test_welded_normals_are_equal_at_one_place(street: Street) -> None:
    """Although the mesh does not share these vertices between faces."""
    meshes = surfaces.ObjectSurfaces.from_surfaces(
        [surfaces.TemplateSurface.from_mesh(street(torch.float64).meshes[0], torch.float64)], torch.zeros(1)
    )
    local = meshes.templates[0].unit
    _, smooth = meshes.normals(local)
    weld = meshes.templates[0].weld
    for place in range(int(weld.max()) + 1):
        here = smooth[weld == place]
        torch.testing.assert_close(here, here[:1].expand_as(here))


def test_face_neighbours_share_the_edge(street: Street) -> None:
    surface = surfaces.TemplateSurface.from_mesh(street(torch.float64).meshes[0], torch.float64)
    points = surface.weld[surface.faces]
    assert bool((surface.neighbours >= 0).all())
    for face, corners in enumerate(points.tolist()):
        for corner, across in enumerate(surface.neighbours[face].tolist()):
            assert set(corners) & set(points[across].tolist()) == set(corners) - {corners[corner]}
            assert face in surface.neighbours[across].tolist()


def test_border_edges_and_edges_of_three_faces_have_no_neighbour() -> None:
    vertices = torch.tensor([[0.0, 0, 0], [0, -0.5, 0], [0.5, 0, 0], [-0.5, 0, 0], [0, 0, 0.5], [-0.5, -0.5, 0]])
    faces = torch.tensor([[0, 1, 2], [1, 0, 3], [0, 1, 4], [1, 3, 5]])
    mesh = Mesh(vertices, faces, torch.zeros(4, dtype=torch.int64))
    neighbours = surfaces.TemplateSurface.from_mesh(mesh, torch.float64).neighbours
    assert neighbours.tolist() == [[-1, -1, -1], [-1, 3, -1], [-1, -1, -1], [-1, -1, 1]]


def test_convert_scene_changes_every_floating_tensor(photographed: SceneIR) -> None:
    single = convert_scene(photographed, torch.float32)
    assert single.objects.source[0].foreground.values.dtype == torch.float32
    assert single.camera.projection is not None
    assert single.camera.projection.dtype == torch.float32
    assert single.meshes[0].faces.dtype == torch.int64
    assert isinstance(single.objects.source[0].shadow, Crop)


def test_nearest_hits_stay_within_their_draw_and_reach() -> None:
    layout = verbs.PixelLayout.from_rects(torch.tensor([[0, 0, 5, 1], [2, 3, 5, 5], [0, 0, 2, 1]]))
    face = torch.full((13,), -1, dtype=torch.int32)
    face[1], face[5] = 7, 2
    fragments = verbs.Fragments(layout, face, torch.ones(13), torch.zeros(3, 2, dtype=torch.int64), 0.05)
    nearest = surfaces.nearest_hits(fragments, [2.0, 9.0, 9.0])
    assert nearest.tolist() == [1, 1, 1, 1, -1] + [5] * 6 + [-1, -1]


def _widely_cut(scene: SceneIR, index: int) -> SceneIR:
    """One photographed object with a matte larger than its mesh."""
    scene = replace(scene, objects=_only(scene.objects, [index]))
    shot = Compositor(scene, REFERENCE).render(scene).opacity[0]
    wide = torch.nn.functional.max_pool2d(torch.nn.functional.pad(shot.values, (3, 3, 3, 3))[None], 7, 1, 3)[0]
    inside = (slice(None), slice(max(-(shot.y0 - 3), 0), None), slice(max(-(shot.x0 - 3), 0), None))
    matte = Crop(wide[inside], max(shot.x0 - 3, 0), max(shot.y0 - 3, 0))
    return solve_sources(scene, [matte], None, SolveSettings(margin_px=6.0, backend="reference"))


def test_halo_moves_with_the_outline(street: Street) -> None:
    """A matte larger than the mesh stays connected to the turning vehicle."""
    taken = _widely_cut(street(torch.float64), 0)
    still = Compositor(taken, REFERENCE).render(taken).opacity[0].values.sum()
    turned = Compositor(taken, REFERENCE).render(_moved(taken, dyaw=0.08)).opacity[0]
    solid = (turned.values[0] > 0.5).numpy().astype("uint8")
    parts, _, stats, _ = cv2.connectedComponentsWithStats(solid, connectivity=8)
    assert parts == 2 or stats[1:, cv2.CC_STAT_AREA].max() > 0.995 * stats[1:, cv2.CC_STAT_AREA].sum()
    gaps, *_ = cv2.connectedComponents(
        1 - cv2.copyMakeBorder(solid, 1, 1, 1, 1, cv2.BORDER_CONSTANT), connectivity=4
    )
    assert gaps == 2
    assert float(turned.values.sum()) == pytest.approx(float(still), rel=0.15)


@pytest.mark.parametrize("dyaw", [-0.3, -0.4])
def test_an_outline_that_turned_away_leaves_no_rim(street: Street, dyaw: float) -> None:
    """Outside the mesh, no pixel is more opaque than its neighbours closer to the mesh."""
    taken = _widely_cut(street(torch.float64), 2)
    compositor, turned = Compositor(taken, REFERENCE), _moved(taken, dyaw=dyaw)
    drawn, opacity = compositor.find_visible(turned.objects), compositor.render(turned).opacity[0].values[0]
    hit = (drawn.mesh.face >= 0).reshape(opacity.shape)
    distance = torch.from_numpy(cv2.distanceTransform((~hit).numpy().astype("uint8"), cv2.DIST_L2, 5))
    around = [torch.nn.functional.unfold(v[None, None].double(), 3, padding=1) for v in (opacity, distance)]
    near = around[1] < distance.flatten() - 0.3
    rise = opacity.flatten() - (around[0] * near).amax(dim=1)
    assert float(rise[0][~hit.flatten()].max()) < 0.1


def _ribbed(stripe: float) -> Mesh:
    """A box in three parts along its length; the middle part, a fiftieth of it, has the grey value `stripe`."""
    parts = []
    for low, high in ((-0.5, -0.01), (-0.01, 0.01), (0.01, 0.5)):
        part = trimesh.creation.box(bounds=[[low, -1.0, -0.5], [high, 0.0, 0.5]])
        across = np.abs(part.face_normals[:, 0]) > 0.5
        outer = np.abs(np.abs(part.triangles_center[:, 0]) - 0.5) < 1e-6
        parts.append(part.triangles[~across | outer])
    corners = torch.from_numpy(np.concatenate(parts))
    grey = torch.where(corners[:, :, 0].abs().amax(dim=1) < 0.02, stripe, 0.8)
    colours = grey[:, None, None].expand(-1, 3, 3).reshape(-1, 3)
    part = torch.full((len(corners),), int(Part.OTHER))
    return Mesh(corners.reshape(-1, 3), torch.arange(3 * len(corners)).reshape(-1, 3), part, "ribbed", colours)


def test_a_stripe_thinner_than_a_pixel_is_equally_dark_at_any_position(street: Street) -> None:
    """On a side that the photograph did not see, and that the vehicle turned into view: leaning, it is a line, and
    no row of dots."""
    scene = street(torch.float64)
    objects = _only(scene.objects, [0])
    place = objects.translation.new_tensor([[0.0, 1.65, 9.0]])
    behind = replace(objects, translation=place, yaw=objects.yaw.new_tensor([-math.pi / 2]))
    pictures = []
    for stripe in (0.8, 0.0):
        taken = photograph_scene(replace(scene, meshes=(_ribbed(stripe),), objects=behind), "reference")
        compositor = Compositor(taken, REFERENCE)
        turns = torch.linspace(0.30, 0.42, 7).tolist()
        pictures.append(torch.stack([compositor.render(_moved(taken, dyaw=turn)).image for turn in turns]))
    darkness = (pictures[0] - pictures[1])[:, :, 36:45].mean(dim=(1, 2)).sum(dim=1)
    assert 0.05 < float(darkness.mean()) < 0.3
    assert float(darkness.std() / darkness.mean()) < 0.5


def test_vehicles_change_nothing_outside_their_regions(photographed: SceneIR) -> None:
    """Neither the picture nor its gradients; weather may change every pixel."""
    scene = convert_scene(photographed, torch.float32)
    compositor = Compositor(scene)
    moved = scene.objects.translation.clone().requires_grad_(True)
    rendered = compositor.render(scene.with_objects(translation=moved + moved.new_tensor([0.3, 0.0, 0.2])))
    assert rendered.vehicle_regions is not None
    outside = torch.ones_like(scene.depth, dtype=torch.bool)
    for x0, y0, x1, y1 in rendered.vehicle_regions.tolist():
        outside[y0:y1, x0:x1] = False
    assert 0 < int(outside.sum()) < outside.numel()
    assert torch.equal(rendered.image.detach()[:, outside], scene.background[:, outside])
    (gradient,) = torch.autograd.grad(rendered.image[:, outside].sum(), moved)
    assert not bool(gradient.any())
    foggy = scene.with_environment(weather=torch.tensor([0.5, 0.0, 0.0, 0.0]))
    assert compositor.render(foggy).vehicle_regions is None


def test_visible_rects_enclose_visible_pixels() -> None:
    layout = PixelLayout.from_rects(torch.tensor([[2, 3, 8, 9], [0, 0, 2, 2], [4, 4, 4, 7]]))
    visible = torch.zeros(layout.size, dtype=torch.bool)
    visible[:36].view(6, 6)[2:4, 0:3] = True
    assert blend.visible_rects(layout, visible[:, None]).tolist() == [[2, 4, 6, 8], [0, 0, 0, 0], [0, 0, 0, 0]]
    for channel in range(3):
        several = torch.zeros(layout.size, 3, dtype=torch.bool)
        several[:, channel] = visible
        assert blend.visible_rects(layout, several).tolist() == [[2, 4, 6, 8], [0, 0, 0, 0], [0, 0, 0, 0]]
