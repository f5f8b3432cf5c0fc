import math
from dataclasses import replace

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from detectors.types import CLASSES
from drivesem.attacks.labels import Difficulty, Labeller, hidden_shares, to_kitti_labels
from drivesem.attacks.space import Budget, Parameter, ParameterSpace
from scene_ir import ffd
from scene_ir.errors import RangeError, ShapeError
from scene_ir.geometry import place_vertices, project_boxes, to_clip
from scene_ir.types import Crop, Render

EASY = Difficulty(min_height_px=1.0, max_occlusion=3, max_truncation=1.0)


def label_scene(scene, perturbed, mode="moved", difficulty=None):
    return Labeller(scene, difficulty=difficulty).labels(mode, perturbed)


def _render(scene, ids, opacities):
    """A Render with given object ids (H, W) and full-frame opacities (N, H, W): white cars on black ground."""
    h, w = scene.camera.height, scene.camera.width
    return Render(
        image=(ids > 0).float().expand(3, h, w),
        depth=torch.ones(h, w),
        object_id=ids,
        opacity=tuple(Crop(o[None], 0, 0) for o in opacities),
    )


def _two_cars(scene, hidden_columns: int):
    """Object 0 fills 20 columns, object 1 the 20 columns from there, of which object 0 hides some."""
    h, w = scene.camera.height, scene.camera.width
    opacity = torch.zeros(2, h, w)
    opacity[0, 50:60, 0 : 20 + hidden_columns] = 1.0
    opacity[1, 50:60, 20:40] = 1.0
    ids = torch.zeros(h, w, dtype=torch.int64)
    ids[opacity[1] > 0.5] = 2
    ids[opacity[0] > 0.5] = 1
    return _render(scene, ids, opacity)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**31))
def test_moved_labels_at_theta0_are_the_benign_ones_to_the_bit(street, seed):
    generator = torch.Generator().manual_seed(seed)
    scene = street()
    scene = scene.with_objects(
        box2d=scene.objects.box2d + torch.randn(4, 4, generator=generator),
        truncation=torch.rand(4, generator=generator),
        occlusion=torch.randint(0, 4, (4,), generator=generator),
        ffd=0.02 * torch.randn(4, 64, 3, generator=generator),
    )
    space = ParameterSpace(scene, tuple(Parameter), Budget(size=0.1, sun=1.0, lamps=1.0))
    moved = label_scene(scene, space.apply(scene, space.theta0))
    assert torch.equal(moved.boxes_xyxy, scene.objects.box2d)
    assert torch.equal(moved.truncation, scene.objects.truncation)
    assert torch.equal(moved.occlusion, scene.objects.occlusion)
    paper = label_scene(scene, scene, "paper")
    assert torch.equal(moved.ignore, paper.ignore)
    assert not bool(moved.became_ignored.any() | moved.became_counted.any())
    kitti, benign = to_kitti_labels(moved, scene, space.apply(scene, space.theta0)), scene.objects
    assert torch.equal(kitti.translation, benign.translation)
    assert torch.equal(kitti.yaw, benign.yaw)
    assert torch.equal(kitti.size_lhw, benign.size_lhw)


def test_a_car_that_grows_has_a_larger_box_on_the_same_ground(street):
    scene = street()
    space = ParameterSpace(scene, ("size",), Budget(size=0.1))
    after = space.apply(scene, space.upper)
    moved = label_scene(scene, after)
    (x0, y0, x1, y1), (a0, b0, a1, b1) = scene.objects.box2d[3].tolist(), moved.boxes_xyxy[3].tolist()
    assert (a1 - a0) / (x1 - x0) == pytest.approx(1.1, abs=0.02)
    assert (b1 - b0) / (y1 - y0) == pytest.approx(1.1, abs=0.02)
    # The far wheels stay; what comes nearer lies lower in the picture, by little.
    assert abs(b1 - y1) < 0.1 * (b1 - b0) < b1 - b0 - (y1 - y0) + 1
    kitti = to_kitti_labels(moved, scene, after)
    assert torch.allclose(kitti.size_lhw, 1.1 * scene.objects.size_lhw)
    assert torch.equal(kitti.translation[:, 1], scene.objects.translation[:, 1])


def test_paper_labels_stay_and_moved_ones_follow(street):
    scene = street(yaw=-math.pi / 2, dtype=torch.float64)
    space = ParameterSpace(scene, ("translate",))
    theta = space.theta0.clone()
    theta[1] = -0.1  # car 0 across, towards +x
    after = space.apply(scene, theta)
    assert torch.equal(label_scene(scene, after, "paper").boxes_xyxy, scene.objects.box2d)
    moved = label_scene(scene, after, "moved").boxes_xyxy
    o, a, matrix = scene.objects, after.objects, scene.camera.matrix
    expected = project_boxes(a.size_lhw, a.yaw, a.translation, matrix) - project_boxes(
        o.size_lhw, o.yaw, o.translation, matrix
    )
    change = moved - scene.objects.box2d
    assert float(change[0, 0]) > 10
    # The mesh fills its 3D box at bumper and roof height only to a few pixels.
    assert torch.allclose(change[0], expected[0], atol=2.5)
    assert torch.equal(moved[1:], scene.objects.box2d[1:])


def test_boxes_are_tight_around_the_deformed_mesh(street):
    scene = street(positions_xz=((0.0, 10.0),), dtype=torch.float64)
    space = ParameterSpace(scene, ("mesh",))
    theta = space.theta0.clone().reshape(4, 4, 2, 3)
    theta[:, 0, :, 1] = -0.2  # the roof goes up
    moved = label_scene(scene, space.apply(scene, theta.reshape(-1))).boxes_xyxy
    change = (moved - scene.objects.box2d)[0]
    assert float(change[1]) < -5
    assert float(change[3]) == pytest.approx(0, abs=1e-3)


def test_boxes_end_at_the_border_and_truncation_grows(street):
    scene = street(positions_xz=((6.9, 9.0),), yaw=0.0, dtype=torch.float64)
    space = ParameterSpace(scene, ("translate",))
    moved = label_scene(scene, space.apply(scene, torch.tensor([0.25, 0.0], dtype=torch.float64)), difficulty=EASY)
    assert float(moved.truncation[0]) > 0.1
    assert float(moved.boxes_xyxy[0, 2]) <= max(scene.camera.width - 1, float(scene.objects.box2d[0, 2]))
    assert not bool(moved.ignore[0])


def test_a_car_that_reaches_behind_the_camera_has_a_finite_box(street):
    scene = street(positions_xz=((1.5, 0.5),), yaw=-math.pi / 2)
    space = ParameterSpace(scene, ("translate",))
    moved = label_scene(scene, space.apply(scene, torch.tensor([0.2, 0.0])), difficulty=EASY)
    assert bool(torch.isfinite(moved.boxes_xyxy).all())
    behind = scene.with_objects(translation=torch.tensor([[0.0, 1.65, -20.0]]))
    assert bool(label_scene(scene, behind, difficulty=EASY).ignore[0])


def test_occlusion_follows_the_visible_share(street):
    scene = street(positions_xz=((0.0, 8.0), (2.0, 12.0)))
    assert hidden_shares(_two_cars(scene, 5)).tolist() == pytest.approx([0.0, 0.25])
    labeller = Labeller(scene, _two_cars(scene, 0))
    levels = {h: int(labeller.moved(scene, _two_cars(scene, h)).occlusion[1]) for h in (0, 1, 5, 10, 15)}
    assert levels == {0: 0, 1: 0, 5: 1, 10: 2, 15: 2}
    moved = labeller.moved(scene, _two_cars(scene, 15))
    assert moved.became_ignored.tolist() == [False, True]
    assert moved.ignore.tolist() == [False, True]


def test_occlusion_starts_from_the_labelled_level(street):
    scene = street(positions_xz=((0.0, 8.0), (2.0, 12.0)))
    scene = scene.with_objects(occlusion=torch.tensor([3, 1]))
    labeller = Labeller(scene, _two_cars(scene, 0))
    assert labeller.moved(scene, _two_cars(scene, 0)).occlusion.tolist() == [3, 1]
    # 0.1, where "partly" begins, and 0.45 more: largely hidden. Unknown stays unknown.
    assert labeller.moved(scene, _two_cars(scene, 9)).occlusion.tolist() == [3, 2]


def test_a_car_that_vanishes_is_ignored(street):
    scene = street(positions_xz=((0.0, 8.0), (2.0, 12.0)))
    labeller = Labeller(scene, _two_cars(scene, 0), EASY)
    assert labeller.moved(scene, _two_cars(scene, 20)).became_ignored.tolist() == [False, True]


@pytest.mark.parametrize(
    ("before", "after", "out_of_sight"),
    [(0, 18, False), (0, 19, True), (15, 19, True), (15, 18, False), (16, 20, False), (19, 20, False)],
)
def test_a_visible_car_that_goes_out_of_sight_is_reported(street, before: int, after: int, out_of_sight: bool):
    scene = street(positions_xz=((0.0, 8.0), (2.0, 12.0)))
    labeller = Labeller(scene, _two_cars(scene, before), EASY)  # of the car's 20 columns so many are hidden
    assert labeller.moved(scene, _two_cars(scene, after)).out_of_sight.tolist() == [False, out_of_sight]
    assert not labeller.paper().out_of_sight.any()


def test_difficulty_and_regions(street):
    scene = street(positions_xz=((0.0, 8.0), (0.0, 70.0), (3.0, 9.0), (-3.0, 9.0)))
    scene = scene.with_objects(occlusion=torch.tensor([0, 0, 2, 0]), truncation=torch.tensor([0.0, 0.0, 0.0, 0.4]))
    scene = replace(scene, ignore=torch.tensor([[1.0, 2, 30, 40]]))
    labels = label_scene(scene, scene, "paper")
    assert labels.ignore.tolist() == [False, True, True, True]
    targets = labels.targets
    assert len(targets) == 4 + len(CLASSES)
    assert targets.labels[4:].tolist() == list(range(len(CLASSES)))
    assert bool(targets.ignore[4:].all())
    assert targets.boxes_xyxy[4:].tolist() == [[1.0, 2, 30, 40]] * len(CLASSES)


def test_ignored_objects_stay_ignored_and_changes_are_reported(street):
    scene = street(positions_xz=((0.0, 27.0),), yaw=-math.pi / 2)
    height = float(scene.objects.box2d[0, 3] - scene.objects.box2d[0, 1])
    labeller = Labeller(scene, difficulty=Difficulty(min_height_px=height + 0.2))
    nearer = scene.with_objects(translation=scene.objects.translation - torch.tensor([0.0, 0.0, 1.0]))
    labels = labeller.moved(nearer)
    assert labels.ignore.tolist() == [True]
    assert labels.became_counted.tolist() == [True]
    away = Labeller(scene, difficulty=Difficulty(min_height_px=height - 0.2)).moved(
        scene.with_objects(translation=scene.objects.translation + torch.tensor([0.0, 0.0, 1.0]))
    )
    assert away.became_ignored.tolist() == [True]


def test_kitti_labels_hold_the_pose_of_their_mode(street):
    scene = street(yaw=math.pi - 0.05, dtype=torch.float64)
    space = ParameterSpace(scene, ("translate", "rotate", "mesh"))
    theta = space.theta0.clone()
    theta[0], theta[8] = 0.1, 0.2
    mesh = theta[12:].reshape(4, 4, 4, 2, 3)
    mesh[0, ..., 2] = -0.05  # wider by a tenth
    after = space.apply(scene, theta)
    paper = to_kitti_labels(label_scene(scene, after, "paper"), scene, after)
    assert torch.equal(paper.translation, scene.objects.translation)
    moved = to_kitti_labels(label_scene(scene, after), scene, after)
    assert torch.allclose(moved.translation, after.objects.translation, atol=1e-9)
    assert float(moved.yaw[0]) == pytest.approx(math.pi - 0.05 + 0.2 - 2 * math.pi)
    assert moved.size_lhw[0].tolist() == pytest.approx([4.2, 1.5, 1.75 * 1.1], rel=0.02)
    assert moved.kind == ("Car",) * 4
    assert to_kitti_labels(label_scene(scene, after), scene, after, ["Van"] * 4).kind == ("Van",) * 4


def test_errors(street):
    scene = street()
    with pytest.raises(RangeError, match="label mode: expected one of paper, moved, found 'none'"):
        label_scene(scene, scene, "none")
    with pytest.raises(ShapeError, match=r"perturbed\.objects"):
        Labeller(scene).moved(street(positions_xz=((0.0, 9.0),)))


def _plain_box(scene, i):
    """Tight box (4,) px of object i's deformed mesh, vertex by vertex, cut 0.1 m before the camera."""
    objects, mesh = scene.objects, scene.meshes[int(scene.objects.mesh_index[i])]
    unit = mesh.vertices.double()
    unit = ffd.deform(unit, ffd.lattice_weights(unit), objects.ffd[i].double())
    pose = (t[i].double() for t in (objects.size_lhw, objects.yaw, objects.translation))
    clip = to_clip(place_vertices(unit, *pose), scene.camera.matrix.double())
    points = [p for p in clip if p[2] >= 0.1]
    for face in mesh.faces.tolist() if len(points) < len(clip) else []:
        for a, b in ((face[0], face[1]), (face[1], face[2]), (face[2], face[0])):
            if (clip[a, 2] >= 0.1) != (clip[b, 2] >= 0.1):
                share = (0.1 - clip[a, 2]) / (clip[b, 2] - clip[a, 2])
                points.append(clip[a] + share * (clip[b] - clip[a]))
    if not points:
        return torch.zeros(4).double()
    pixels = torch.stack(points)[:, :2] / torch.stack(points)[:, 2:]
    return torch.cat([pixels.amin(dim=0), pixels.amax(dim=0)])


@pytest.mark.parametrize("nearest_m", [7.0, 0.5, -20.0])
def test_boxes_enclose_every_vertex(street, nearest_m):
    scene = street(positions_xz=((1.5, nearest_m), (-2.0, 12.0)), dtype=torch.float64)
    generator = torch.Generator().manual_seed(3)
    offsets = 0.05 * torch.randn(2, 64, 3, generator=generator, dtype=torch.float64)  # not symmetric
    scene = scene.with_objects(ffd=offsets, yaw=scene.objects.yaw + 0.3)
    found = torch.from_numpy(Labeller(scene)._project(scene))
    expected = torch.stack([_plain_box(scene, i) for i in range(2)])
    torch.testing.assert_close(found, expected, atol=1e-7, rtol=1e-9)


def test_moved_boxes_are_the_benign_ones_plus_the_change_of_every_vertex(street):
    scene = street(dtype=torch.float64)
    space = ParameterSpace(scene, ("translate", "rotate", "mesh"))
    theta = 4 * space.step * torch.randn(space.dim, generator=torch.Generator().manual_seed(4)).double()
    after = space.apply(scene, theta)
    limit = torch.tensor([scene.camera.width - 1.0, scene.camera.height - 1.0] * 2).double()
    plain = (torch.stack([_plain_box(s, i) for i in range(4)]) for s in (after, scene))
    inside = [torch.minimum(boxes.clamp(min=0), limit) for boxes in plain]
    expected = (scene.objects.box2d + inside[0] - inside[1]).clamp(min=0)
    expected = torch.minimum(expected, torch.maximum(limit, scene.objects.box2d))
    torch.testing.assert_close(label_scene(scene, after).boxes_xyxy, expected, atol=1e-7, rtol=1e-9)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**31))
def test_hidden_shares_are_those_of_the_whole_frame(street, seed):
    scene, generator = street(positions_xz=((0.0, 8.0),)), torch.Generator().manual_seed(seed)
    ids = torch.zeros(scene.camera.height, scene.camera.width, dtype=torch.int64)
    crops, own = [], []
    for i in range(4):  # painted one over the other, the last one without any pixel of its own
        x, y = (int(v) for v in torch.randint(0, 100, (2,), generator=generator))
        values = torch.rand(1, 40, 60, generator=generator) * (0.4 if i == 3 else 1.0)
        solid = values[0] >= 0.5
        ids[y : y + 40, x : x + 60][solid] = i + 1
        crops.append(Crop(values, x, y))
        own.append(float(solid.sum()))
    image = torch.zeros(3, *ids.shape)
    seen = torch.bincount(ids.reshape(-1), minlength=5)[1:].double()
    expected = torch.where(torch.tensor(own) > 0, 1 - seen / torch.tensor(own).clamp(min=1), 1.0).double()
    found = hidden_shares(Render(image=image, depth=image[0], object_id=ids, opacity=tuple(crops)))
    torch.testing.assert_close(torch.from_numpy(found), expected)
