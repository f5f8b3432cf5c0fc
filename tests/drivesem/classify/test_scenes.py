"""Views, pictures and their gradients, and backgrounds."""

import numpy as np
import pytest
import torch

from drivesem.classify import scenes
from drivesem.classify.objects.embedded import open_objects
from drivesem.classify.pictures import interleave_classes
from drivesem.classify.scenes import (
    DRAWN_PX,
    SEEN_PX,
    VIEWS,
    ObjectScene,
    generate_background,
    open_backgrounds,
    picture_camera,
)
from drivesem.classify.space import ObjectChange, ObjectSpace, ParameterAmounts, parse_parameters, rotation_matrix
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.render.lit_mesh import composite_over
from tests.drivesem.classify.conftest import make_model

GREY = torch.full((3, DRAWN_PX, DRAWN_PX), 0.4)


def test_the_front_faces_the_camera_and_up_is_up():
    scene = ObjectScene("box", make_model("box"), "forward", GREY)
    placed, rest = scene.camera_vertices(), scene.vertices
    front, top = rest[:, 2] < 0, rest[:, 1] > 0
    assert float(placed[front, 2].max()) < float(placed[~front, 2].min())
    assert float(placed[top, 1].max()) < float(placed[~top, 1].min())


def test_views():
    placed = {view: ObjectScene("box", make_model("box"), view, GREY).camera_vertices() for view in VIEWS}
    rest = make_model("box").mesh.vertices
    corner = (rest[:, 1] > 0) & (rest[:, 2] < 0)  # the upper edge of the front
    assert float(placed["top"][corner, 1].mean()) > float(placed["forward"][corner, 1].mean())
    sides = [float(placed[view][rest[:, 2] < 0, 0].mean()) for view in ("left", "forward", "right")]
    assert sides[1] == pytest.approx(0, abs=1e-6)
    assert sides[0] == pytest.approx(-sides[2], abs=1e-6)
    assert abs(sides[0]) > 0.1


def test_rotation_matrices_and_angles_add_to_the_view():
    turn = rotation_matrix(torch.tensor([0.3, -0.5, 0.2]))
    torch.testing.assert_close(turn @ turn.T, torch.eye(3))
    assert float(torch.linalg.det(turn)) == pytest.approx(1)
    forward, left = (ObjectScene("box", make_model("box"), view, GREY) for view in ("forward", "left"))
    torch.testing.assert_close(
        forward.camera_vertices(ObjectChange(angles=torch.tensor([0.0, 0.5, 0.0]))), left.camera_vertices()
    )


def test_a_picture_has_its_background_around_the_object():
    picture = ObjectScene("ball", make_model("ball"), "forward", GREY).render()
    assert picture.shape == (3, SEEN_PX, SEEN_PX)
    torch.testing.assert_close(picture[:, 0, 0], torch.full((3,), 0.4))
    middle = picture[:, SEEN_PX // 2, SEEN_PX // 2]
    assert float(middle[1]) > float(middle[0]) > 0.2


@pytest.mark.parametrize("drawn_px", [512, 96, 448])
@pytest.mark.parametrize("along", [(0.0, 0.0), (0.9, -0.4), (30.0, 0.0)])
def test_only_the_surroundings_of_an_object_are_downscaled(drawn_px, along, monkeypatch):
    """The result equals that of the whole picture, with the object in the middle, over two borders, or outside."""
    monkeypatch.setattr(scenes, "DRAWN_PX", drawn_px)
    behind = torch.rand(3, drawn_px, drawn_px, generator=torch.Generator().manual_seed(0))
    scene, view = ObjectScene("ball", make_model("ball"), "forward", behind), picture_camera(drawn_px)
    vertices = (scene.camera_vertices() + torch.tensor([*along, 0.0])).requires_grad_(True)
    weight = torch.randn(3, SEEN_PX, SEEN_PX, generator=torch.Generator().manual_seed(1))
    drawn = scene.mesh.render(vertices, view, scene.lights())
    whole = torch.nn.functional.interpolate(
        composite_over(drawn, behind)[None], (SEEN_PX, SEEN_PX), mode="bilinear", antialias=True
    )[0]
    part, x, y = scene.mesh.render_part(vertices, view, scene.lights())
    found = scene.composite(part, x, y)
    torch.testing.assert_close(found, whole, atol=2e-5, rtol=0)
    assert part.numel() < drawn.numel()
    if not part.numel():
        return
    expected, gradient = (
        torch.autograd.grad(seen, vertices, weight, retain_graph=True)[0] for seen in (whole, found)
    )
    torch.testing.assert_close(gradient, expected, atol=1e-4 * float(expected.abs().max()), rtol=0)


def smooth_noise():
    noise = torch.randn(1, 3, SEEN_PX, SEEN_PX, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.avg_pool2d(noise, 9, 1, 4)[0].double()


def gradient_agreement(value, dim, step):
    """Cosine between the gradient at theta = 0 and central differences."""
    leaf = torch.zeros(dim, requires_grad=True)
    (gradient,) = torch.autograd.grad(value(leaf), leaf)
    with torch.no_grad():
        slopes = [(value(step * d) - value(-step * d)) / (2 * step) for d in torch.eye(dim)]
    return float(torch.nn.functional.cosine_similarity(torch.stack(slopes).double(), gradient.double(), dim=0))


@pytest.mark.parametrize("params", ["pose", pytest.param("vertex", marks=pytest.mark.slow), "lighting"])
def test_gradients_of_the_picture_and_of_a_score(params, colours):
    scene = ObjectScene("box", make_model("box"), "left", generate_background("box"))
    space = ObjectSpace(scene.vertices, parse_parameters(params), ParameterAmounts(0.002, 0.15, 0.2))
    weight = smooth_noise()
    step = 1e-2 if params == "lighting" else 2e-3
    for value in (
        lambda theta: (scene.render(space.change(theta)).double() * weight).sum(),
        lambda theta: colours(scene.render(space.change(theta))[None])[0, 0].double(),
    ):
        assert gradient_agreement(value, space.dim, step) >= 0.99


@pytest.mark.parametrize("name", ["bus/0080", "airplane/0080"])
def test_gradients_of_objects_with_parts_thinner_than_a_pixel(name):
    """Faces that appear and vanish at pixel centres would give 0.86 and 0.57."""
    scene = ObjectScene(name, open_objects(None).load(name), "top", generate_background(name))
    space = ObjectSpace(scene.vertices, parse_parameters("pose"), ParameterAmounts(0.002, 0.15, 0.2))
    weight = smooth_noise()
    assert gradient_agreement(lambda t: (scene.render(space.change(t)).double() * weight).sum(), 3, 1e-3) >= 0.99


def test_generated_backgrounds_depend_on_the_name():
    one = generate_background("a")
    assert one.shape == (3, DRAWN_PX, DRAWN_PX)
    assert bool((one >= 0).all() and (one <= 1).all())
    assert torch.equal(one, generate_background("a"))
    assert not torch.equal(one, generate_background("b"))


def test_photographs_as_backgrounds(tmp_path):
    wide = np.zeros((40, 90, 3), np.uint8)
    wide[:, 25:65] = (200, 100, 50)
    files.write_png(tmp_path / "wide.png", wide)
    background = open_backgrounds(str(tmp_path))("anything")
    expected = torch.tensor([200, 100, 50]).view(3, 1, 1).expand(3, DRAWN_PX, DRAWN_PX) / 255
    torch.testing.assert_close(background, expected)


def test_missing_and_damaged_backgrounds(tmp_path):
    with pytest.raises(FormatError, match="photographs"):
        open_backgrounds(str(tmp_path))
    (tmp_path / "torn.jpg").write_bytes(b"\xff\xd8 no picture")
    with pytest.raises(FormatError, match=r"torn\.jpg"):
        open_backgrounds(str(tmp_path))("anything")


def test_classes_are_interleaved():
    assert interleave_classes(["a/0", "a/1", "b/0", "b/1", "b/2"]) == ["a/0", "b/0", "a/1", "b/1", "b/2"]
