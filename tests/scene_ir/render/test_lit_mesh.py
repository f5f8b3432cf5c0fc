"""Lit meshes: values by hand, both backends, gradients against central differences, invalid input."""

import math

import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from scene_ir.errors import RangeError, ShapeError
from scene_ir.render.lit_mesh import GAMMA, Lights, LitMesh, Materials, composite_over, shade_phong
from scene_ir.types import Camera

SIZE = 96
FINE_PX = 288
"""As gradients are compared: small faces hop over a pixel of less."""
DARK = torch.tensor(0.0)


def camera(size=SIZE):
    return Camera(
        torch.tensor([[1.6 * size, 0, (size - 1) / 2], [0, 1.6 * size, (size - 1) / 2], [0, 0, 1]]), size, size
    )


def materials(colours, specular=0.3):
    count = len(colours)
    return Materials(torch.as_tensor(colours), torch.full((count,), specular), torch.full((count,), 20.0))


def solid(mesh, seed=0):
    """A trimesh mesh with a random colour per face."""
    vertices, faces = torch.tensor(mesh.vertices, dtype=torch.float32), torch.tensor(mesh.faces)
    colours = 0.1 + 0.8 * torch.rand(len(faces), 3, generator=torch.Generator().manual_seed(seed))
    return LitMesh(vertices, faces, materials(colours))


def lights(change=None):
    change = torch.zeros(5) if change is None else change
    return Lights(change.new_tensor([0.5, -0.8, 0.2]) + change[2:], 0.8 * (1 + change[0]), 0.3 * (1 + change[1]))


def turned(vertices, angles):
    (cx, cy, cz), (sx, sy, sz) = angles.cos(), angles.sin()
    zero, one = torch.zeros_like(cx), torch.ones_like(cx)
    x = torch.stack([one, zero, zero, zero, cx, -sx, zero, sx, cx]).reshape(3, 3)
    y = torch.stack([cy, zero, sy, zero, one, zero, -sy, zero, cy]).reshape(3, 3)
    z = torch.stack([cz, -sz, zero, sz, cz, zero, zero, zero, one]).reshape(3, 3)
    return vertices @ (z @ x @ y).T + vertices.new_tensor([0.0, 0.0, 2.2])


def test_a_surface_facing_lamp_and_camera():
    point, normal = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[0.0, 0.0, -1.0]])
    lamp = Lights(torch.zeros(3), torch.tensor(0.5), torch.tensor(0.2), reach=2.0)
    one = torch.ones(1)
    matt = shade_phong(point, normal, torch.tensor([[1.0, 0.5, 0.0]]), 0 * one, 10 * one, lamp)
    torch.testing.assert_close(matt, torch.tensor([[0.7, 0.35, 0.0]]))
    glossy = shade_phong(point, normal, torch.zeros(1, 3), one, 10 * one, lamp)
    torch.testing.assert_close(glossy, torch.full((1, 3), 0.5 + 0.2 * 0.2))
    nearer = shade_phong(point / 2, normal, torch.ones(1, 3), 0 * one, 10 * one, lamp)
    torch.testing.assert_close(nearer, torch.full((1, 3), 0.5 * 4 + 0.2))


def test_a_surface_facing_away_gets_only_environment_light_mostly_from_above():
    point, lamp = torch.tensor([[0.0, 0.0, 2.0]]), Lights(torch.zeros(3), torch.tensor(0.5), torch.tensor(0.2))
    one = torch.ones(1)
    up, down, away = (
        shade_phong(point, torch.tensor([normal]), torch.ones(1, 3), one, one, lamp)[0, 0]
        for normal in ([0.0, -1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    )
    assert float(up) == pytest.approx(1.2 * 0.2 * 1.4)
    assert float(down) == pytest.approx(1.2 * 0.2 * 0.6)
    assert float(away) == pytest.approx(1.2 * 0.2)


@pytest.mark.parametrize("backend", ["warp", "reference"])
def test_a_square_in_front_of_the_camera(backend):
    vertices = torch.tensor([[-0.25, -0.25, 2.0], [0.25, -0.25, 2.0], [0.25, 0.25, 2.0], [-0.25, 0.25, 2.0]])
    square = LitMesh(vertices, torch.tensor([[0, 2, 1], [0, 3, 2]]), materials([[0.5] * 3] * 2, 0.0))
    flat = Lights(torch.tensor([0.0, 0.0, 0.0]), DARK, torch.tensor(0.8))
    drawn = square.render(vertices, camera(), flat, backend)
    side = 0.5 * 1.6 * SIZE / 2
    assert float(drawn[3].sum()) == pytest.approx(side**2, rel=1e-3)
    inside = drawn[:3, drawn[3] > 0]
    torch.testing.assert_close(inside, torch.full_like(inside, 0.4**GAMMA), atol=1e-5, rtol=0)
    assert bool((drawn[:3, drawn[3] == 0] == 0).all())
    background = torch.rand(3, SIZE, SIZE)
    picture = composite_over(drawn, background)
    assert torch.equal(picture[:, 0, 0], background[:, 0, 0])
    torch.testing.assert_close(picture[:, SIZE // 2, SIZE // 2], torch.full((3,), 0.4**GAMMA))


def test_composite_over_passes_gradcheck():
    generator = torch.Generator().manual_seed(0)
    drawn, background = (
        torch.rand(channels, 3, 2, generator=generator, dtype=torch.float64).requires_grad_()
        for channels in (4, 3)
    )
    assert torch.autograd.gradcheck(composite_over, (drawn, background))


@pytest.mark.parametrize("mesh", [trimesh.creation.box((0.5, 0.6, 1)), trimesh.creation.icosphere(2, 0.5)])
def test_backends_agree(mesh):
    lit = solid(mesh)
    placed = turned(lit.vertices, torch.tensor([0.35, 0.5, 0.1]))
    fast, plain = (lit.render(placed, camera(), lights(), backend) for backend in ("warp", "reference"))
    assert float(((fast - plain).abs() > 1e-3).float().mean()) < 1e-3
    assert float((fast - plain).abs().mean()) < 1e-4


def test_meshes_behind_the_camera_or_outside_the_picture_are_not_drawn():
    lit = solid(trimesh.creation.box((0.5, 0.6, 1)))
    for place in ([0.0, 0.0, -3.0], [9.0, 0.0, 3.0]):
        assert not bool(lit.render(lit.vertices + torch.tensor(place), camera(), lights()).any())


MESHES = {
    "box": trimesh.creation.box((0.5, 0.6, 1.0)),
    "ball": trimesh.creation.icosphere(1, 0.5),
    "through each other": trimesh.util.concatenate(
        [trimesh.creation.box((0.5, 0.3, 1.0)), trimesh.creation.icosphere(0, 0.3).apply_translation((0, 0.2, 0))]
    ),
}


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("moved", ["pose", "vertex", "light"])
def test_gradients_match_central_differences(name, moved):
    lit = solid(MESHES[name])
    generator = torch.Generator().manual_seed(1)
    weight = torch.nn.functional.avg_pool2d(torch.randn(1, 4, FINE_PX, FINE_PX, generator=generator), 9, 1, 4)[
        0, :3
    ]
    rest, angles = lit.vertices, torch.tensor([0.35, 0.5, 0.1])
    size = {"pose": 3, "vertex": rest.numel(), "light": 5}[moved]

    def value(theta):
        offsets = theta.reshape(rest.shape) if moved == "vertex" else 0
        placed = turned(rest + offsets, angles + theta if moved == "pose" else angles)
        drawn = lit.render(placed, camera(FINE_PX), lights(theta if moved == "light" else None))
        return (composite_over(drawn, torch.full((3, FINE_PX, FINE_PX), 0.4)).double() * weight.double()).sum()

    leaf = torch.zeros(size, requires_grad=True)
    (gradient,) = torch.autograd.grad(value(leaf), leaf)
    directions = torch.eye(size) if moved != "vertex" else torch.eye(size)[gradient.abs().topk(24).indices]
    step = 1e-2 if moved == "light" else 2e-3
    with torch.no_grad():
        slopes = torch.stack([(value(step * d) - value(-step * d)) / (2 * step) for d in directions])
    cosine = float(torch.nn.functional.cosine_similarity(slopes, directions.double() @ gradient.double(), dim=0))
    assert cosine >= 0.99


@settings(deadline=None, max_examples=10)
@given(st.floats(-0.3, 0.3), st.floats(0.001, 0.01))
def test_a_border_between_two_colours_sweeps_evenly_over_pixels(start, step):
    """As the border between two halves of a wide strip moves, the mean colour follows it at any position."""
    vertices = torch.tensor([[-2.0, -0.2, 2], [0, -0.2, 2], [2, -0.2, 2], [-2, 0.2, 2], [0, 0.2, 2], [2, 0.2, 2]])
    faces = torch.tensor([[0, 3, 4], [0, 4, 1], [1, 4, 5], [1, 5, 2]])
    strip = LitMesh(vertices, faces, materials([[1.0] * 3] * 2 + [[0.0] * 3] * 2, 0.0))
    flat = Lights(torch.zeros(3), DARK, torch.tensor(0.5))

    def mean(border):
        moved = vertices.clone()
        moved[[1, 4], 0] = border
        return strip.render(moved, camera(), flat, "reference")[0, SIZE // 2].mean()

    shade_of, dark = 0.5**GAMMA, 1e-4**GAMMA
    moved = float(mean(start + step) - mean(start))
    assert moved == pytest.approx(step * 1.6 / 2 * (shade_of - dark), rel=0.02)


def test_normals_are_smooth_on_a_ball_and_sharp_on_a_box():
    ball, box = solid(trimesh.creation.icosphere(3, 0.5)), solid(MESHES["box"])
    centred = ball.vertices[ball.faces]
    away = ball.corners(ball.vertices + torch.tensor([0.0, 0.0, 3.0]))[1].reshape(-1, 3, 3)
    facing = (
        torch.linalg.cross(centred[:, 1] - centred[:, 0], centred[:, 2] - centred[:, 0])
        * (centred.mean(1) + torch.tensor([0, 0, 3.0]))
    ).sum(1) < 0
    outwards = torch.nn.functional.normalize(centred[facing], dim=-1)
    assert float((away[facing] * outwards).sum(-1).min()) > math.cos(math.radians(5))
    normals = box.corners(box.vertices + torch.tensor([0.0, 0.0, 3.0]))[1]
    assert torch.allclose(normals.abs().amax(dim=1), torch.ones(len(normals)))


def test_invalid_meshes_are_rejected():
    vertices, faces = torch.zeros(3, 3), torch.tensor([[0, 1, 2]])
    with pytest.raises(RangeError, match=r"lit.vertices\[1, 0\]"):
        LitMesh(torch.tensor([[0.0, 0, 0], [math.nan, 0, 0], [1, 0, 0]]), faces, materials([[0.5] * 3]))
    with pytest.raises(ShapeError, match=r"lit.diffuse"):
        LitMesh(vertices, faces, materials([[0.5] * 3] * 2))
    with pytest.raises(ShapeError, match=r"lit.faces"):
        LitMesh(vertices, torch.tensor([[0, 1]]), materials([[0.5] * 3]))
