"""Placing and projecting, against cases worked out by hand, the conventions page, and real labels."""

import json
import math
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from scene_ir import geometry

ROOT = Path(__file__).resolve().parents[2]
KITTI = ROOT / ".." / "shared" / "data" / "kitti" / "training"
MATRIX = torch.tensor([[100.0, 0, 50, 0], [0, 100, 40, 0], [0, 0, 1, 0]], dtype=torch.float64)
SIZE = torch.tensor([4.0, 1.5, 2.0], dtype=torch.float64)


def f64(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def conventions() -> str:
    return (ROOT / "scene_ir" / "conventions.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("yaw", "front", "left"),
    [
        pytest.param(0.0, (2, 0, 0), (0, 0, 1), id="to-the-right"),
        pytest.param(math.pi / 2, (0, 0, -2), (1, 0, 0), id="towards-the-camera"),
        pytest.param(-math.pi / 2, (0, 0, 2), (-1, 0, 0), id="away-from-the-camera"),
        pytest.param(math.pi, (-2, 0, 0), (0, 0, -1), id="to-the-left"),
    ],
)
def test_front_and_side_of_a_turned_car(yaw: float, front: tuple[float, ...], left: tuple[float, ...]) -> None:
    unit = torch.tensor([[0.5, 0, 0], [0, 0, 0.5], [0, -1, 0]], dtype=torch.float64)
    placed = geometry.place_vertices(unit, SIZE, f64(yaw)[0], f64(1, 1.5, 10))
    expected = torch.tensor([front, left, (0, -1.5, 0)], dtype=torch.float64) + f64(1, 1.5, 10)
    torch.testing.assert_close(placed, expected, atol=1e-12, rtol=0)


def test_corners_at_yaw_0_follow_the_development_kit() -> None:
    corners = geometry.box_corners(SIZE, f64(0)[0], f64(0, 0, 10))
    x = (2, 2, -2, -2, 2, 2, -2, -2)
    y = (0, 0, 0, 0, -1.5, -1.5, -1.5, -1.5)
    z = (11, 9, 9, 11, 11, 9, 9, 11)
    assert corners.tolist() == [list(corner) for corner in zip(x, y, z, strict=True)]


def test_corners_at_a_quarter_turn() -> None:
    corners = geometry.box_corners(SIZE, f64(math.pi / 2)[0], f64(0, 0, 10))
    torch.testing.assert_close(corners[:4, 0], f64(1, -1, -1, 1), atol=1e-12, rtol=0)
    torch.testing.assert_close(corners[:4, 2], f64(8, 8, 12, 12), atol=1e-12, rtol=0)


def test_footprint_is_the_bottom_face() -> None:
    footprint = geometry.ground_footprint(SIZE, f64(0)[0], f64(3, 1.5, 10))
    assert footprint.tolist() == [[5, 11], [5, 9], [1, 9], [1, 11]]


def test_yaw_matrix_is_a_rotation_and_differentiable() -> None:
    yaw = f64(0.3, -2.0).requires_grad_()
    rotation = geometry.yaw_matrix(yaw)
    torch.testing.assert_close(rotation @ rotation.transpose(1, 2), torch.eye(3).double().expand(2, 3, 3))
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(2).double())
    assert torch.autograd.gradcheck(geometry.yaw_matrix, (yaw,))


def test_projected_box_in_front() -> None:
    box = geometry.project_boxes(SIZE[None], f64(0), f64(0, 1.5, 11)[None], MATRIX)
    # the near face at z = 10 spans x -2..2 and y 0..1.5
    torch.testing.assert_close(box[0], f64(50 - 20, 40, 50 + 20, 40 + 15))


def test_projection_uses_the_fourth_column() -> None:
    matrix = MATRIX.clone()
    matrix[:, 3] = f64(5, -3, 1)
    assert geometry.to_clip(f64(1, 2, 4), matrix).tolist() == [100 + 200 + 5, 200 + 160 - 3, 5]
    assert geometry.project(f64(1, 2, 4), matrix).tolist() == [305 / 5, 357 / 5]


def test_box_across_the_near_plane_is_cut_there() -> None:
    """The box spans z -1..3 at x -1..1, y 0..1.5: nearest visible slice at z = near."""
    near = 0.5
    box = geometry.project_boxes(SIZE[None], f64(math.pi / 2), f64(0, 1.5, 1)[None], MATRIX, near=near)
    torch.testing.assert_close(box[0], f64(50 - 100 / near, 40, 50 + 100 / near, 40 + 150 / near))


def test_box_behind_the_camera_is_nan_and_does_not_spoil_the_others() -> None:
    translation = torch.tensor([[0, 1.5, -5], [0, 1.5, 11]], dtype=torch.float64, requires_grad=True)
    boxes = geometry.project_boxes(SIZE.expand(2, 3), f64(0, 0), translation, MATRIX)
    assert bool(boxes[0].isnan().all())
    assert bool(boxes[1].isfinite().all())
    (gradient,) = torch.autograd.grad(boxes[1].sum(), translation)
    assert bool(gradient.isfinite().all())


def test_no_boxes() -> None:
    empty = torch.zeros(0, 3, dtype=torch.float64)
    assert geometry.project_boxes(empty, f64(), empty, MATRIX).shape == (0, 4)


@pytest.mark.parametrize("z", [11.0, 1.0])
def test_projected_boxes_have_the_gradient_of_central_differences(z: float) -> None:
    def boxes(size: torch.Tensor, yaw: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
        return geometry.project_boxes(size, yaw, translation, MATRIX, near=0.5)

    inputs = (SIZE[None].clone(), f64(1.3), f64(0.3, 1.4, z)[None])
    assert torch.autograd.gradcheck(boxes, [i.requires_grad_() for i in inputs])


@given(yaw=st.floats(-4, 4), x=st.floats(-20, 20), z=st.floats(6, 60), dx=st.floats(-3, 3), length=st.floats(1, 9))
def test_every_point_of_the_box_projects_into_its_image_box(
    yaw: float, x: float, z: float, dx: float, length: float
) -> None:
    size, place = f64(length, 1.5, 2.0), (f64(yaw), f64(x + dx, 1.6, z)[None])
    box = geometry.project_boxes(size[None], *place, MATRIX)[0]
    unit = torch.rand(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - f64(0.5, 1, 0.5)
    pixels = geometry.project(geometry.place_vertices(unit, size, place[0][0], place[1][0]), MATRIX)
    assert bool((pixels >= box[:2] - 1e-9).all())
    assert bool((pixels <= box[2:] + 1e-9).all())


def test_clip_boxes_is_kittis_image_border() -> None:
    boxes = f64(-5, 10, 2000, 374.5, 3, -2, 7, 20).reshape(2, 4)
    assert geometry.clip_boxes(boxes, 375, 1242).tolist() == [[0, 10, 1241, 374], [3, 0, 7, 20]]


def test_normals_of_an_outward_wound_tetrahedron_point_outwards() -> None:
    vertices = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=torch.float64)
    faces = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    normals = geometry.vertex_normals(vertices, faces)
    outward = vertices - vertices.mean(dim=0)
    assert bool(((normals * outward).sum(dim=1) > 0).all())
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(4).double())
    torch.testing.assert_close(normals[0], -f64(1, 1, 1) / math.sqrt(3))


def test_the_example_of_the_conventions_page() -> None:
    example = json.loads(conventions().split("```json")[1].split("```")[0])
    value = {key: torch.tensor(v, dtype=torch.float64) for key, v in example.items()}
    pose = (value["size_lhw"], value["yaw"], value["translation"])
    unit = torch.stack([value["front_unit"], value["roof_unit"]])
    placed = torch.stack([value["front_m"], value["roof_m"]])
    torch.testing.assert_close(geometry.place_vertices(unit, *pose), placed, atol=5e-5, rtol=0)
    clip = geometry.to_clip(value["translation"], value["projection"])
    torch.testing.assert_close(clip, value["ground_centre_clip"], atol=5e-5, rtol=0)
    pixel = geometry.project(value["translation"], value["projection"])
    torch.testing.assert_close(pixel, value["ground_centre_px"], atol=5e-5, rtol=0)
    boxes = geometry.project_boxes(*(v[None] for v in pose), value["projection"])
    torch.testing.assert_close(boxes[0], value["box_xyxy"], atol=5e-5, rtol=0)


@pytest.mark.skipif(not KITTI.is_dir(), reason="needs ../shared/data/kitti/training")
def test_real_labels_3d_boxes_project_onto_their_2d_boxes() -> None:
    """KITTI's hand-drawn boxes meet the projected 3D boxes at a mean IoU of about 0.975 where both are whole."""
    overlaps = []
    for path in sorted((KITTI / "label_2").glob("*.txt")):
        p2 = next(line for line in (KITTI / "calib" / path.name).read_text().splitlines() if line.startswith("P2"))
        matrix = torch.tensor([float(v) for v in p2.split()[1:]]).reshape(3, 4)
        for line in path.read_text().splitlines():
            kind, truncated, _, _, *rest = line.split()
            if kind not in ("Car", "Van", "Truck") or float(truncated) > 0:
                continue
            left, t, r, b, h, w, length, x, y, z, yaw = map(float, rest)
            size, place = torch.tensor([[length, h, w]]), torch.tensor([[x, y, z]])
            box = geometry.project_boxes(size, torch.tensor([yaw]), place, matrix)
            u = geometry.clip_boxes(box, 375, 1242)[0].tolist()
            shared = max(0.0, min(u[2], r) - max(u[0], left)) * max(0.0, min(u[3], b) - max(u[1], t))
            overlaps.append(shared / ((u[2] - u[0]) * (u[3] - u[1]) + (r - left) * (b - t) - shared))
    assert len(overlaps) > 20
    assert sum(overlaps) / len(overlaps) > 0.965
    assert min(overlaps) > 0.9


@pytest.mark.parametrize("tensors", [False, True])
def test_clamp_inclusive_passes_gradients_up_to_its_bounds(tensors: bool) -> None:
    """Whatever torch.clamp has there: codes and saturated pixels lie on bounds."""
    values = torch.tensor([-0.5, 0.0, 0.3, 1.0, 1.5], requires_grad=True)
    bounds = (torch.zeros(5), torch.ones(5)) if tensors else (0.0, 1.0)
    clamped = geometry.clamp_inclusive(values, *bounds)
    assert clamped.tolist() == values.clamp(0, 1).tolist()
    assert torch.equal(geometry.clamp_inclusive(values.detach(), *bounds), clamped)
    clamped.sum().backward()
    assert values.grad is not None
    assert values.grad.tolist() == [0, 1, 1, 1, 0]
