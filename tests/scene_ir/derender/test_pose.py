"""Poses from 2D boxes: what is done with the network's words, and what the shipped network says."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from scene_ir import files
from scene_ir.derender import pose
from scene_ir.derender.pose import BINS, KINDS, PoseNet, PosePrediction
from scene_ir.errors import FormatError, RangeError, ShapeError
from scene_ir.geometry import clip_boxes, project_boxes
from scene_ir.types import Camera

HEIGHT, WIDTH = 375, 1242
SIZES = ((4.2, 1.5, 1.7), (3.8, 1.6, 1.65), (4.5, 1.45, 1.8))


def kitti_camera() -> Camera:
    """With an offset of the centre of projection, as KITTI's second camera has it."""
    k = torch.tensor([[721.5, 0.0, 609.6], [0.0, 718.0, 172.9], [0.0, 0.0, 1.0]])
    return Camera(k, HEIGHT, WIDTH, torch.cat([k, torch.tensor([[44.9], [0.2], [0.003]])], 1))


class Oracle(PoseNet):
    """Says what is true of vehicles, with a given doubt about depth and error of it."""

    def __init__(self, camera: Camera, place: Tensor, yaw: Tensor, size: Tensor, boxes: Tensor) -> None:
        super().__init__()
        middle = place - size[:, 1:2] * torch.tensor([0.0, 0.5, 0.0])
        clip = middle @ camera.matrix[:, :3].T + camera.matrix[:, 3]
        sides = boxes[:, 2:] - boxes[:, :2]
        kinds = ["Car"] * len(place)
        self.offset = (clip[:, :2] / clip[:, 2:] - (boxes[:, :2] + boxes[:, 2:]) / 2) / sides
        self.alpha = yaw - torch.atan2(place[:, 0], place[:, 2])
        self.size = torch.log(size / pose.mean_sizes(kinds))
        self.depth = torch.log(middle[:, 2] / pose.mean_depth(boxes, kinds, camera))
        self.log_sigma = torch.full_like(self.depth, math.log(0.05))

    def forward(self, crops: Tensor, numbers: Tensor) -> PosePrediction:
        centre = torch.arange(BINS) * (2 * math.pi / BINS)
        apart = self.alpha[:, None] - centre
        prediction = PosePrediction(
            8 * apart.cos(),
            torch.stack([apart.cos(), apart.sin()], -1),
            self.offset,
            self.size,
            self.depth,
            self.log_sigma,
            torch.zeros(len(self.alpha), len(KINDS)),
        )
        self.calls = getattr(self, "calls", 0) + 1
        # the second pass sees the mirror's image
        return prediction if self.calls % 2 else pose.unmirror_prediction(prediction)


def row_of_cars(
    places: Sequence[tuple[float, float]] = ((-4.0, 12.0), (3.5, 20.0), (6.0, 35.0)), tilt: float = 0.0
) -> tuple[Camera, Tensor, Tensor, Tensor, Tensor]:
    """Camera, translation, yaw, size and uncut boxes of cars on the plane y = 1.65 + tilt z."""
    camera = kitti_camera()
    place = torch.tensor([[x, 1.65 + tilt * z, z] for x, z in places])
    yaw = torch.tensor([-1.5, 1.2, 2.9])[: len(places)]
    size = torch.tensor(SIZES[: len(places)])
    return camera, place, yaw, size, project_boxes(size, yaw, place, camera.matrix)


def grey() -> Tensor:
    return torch.full((3, HEIGHT, WIDTH), 0.5)


def test_what_is_true_comes_out_as_it_is() -> None:
    camera, place, yaw, size, boxes = row_of_cars()
    found = pose.estimate_poses(
        grey(), boxes, ["Car"] * 3, camera, network=Oracle(camera, place, yaw, size, boxes)
    )
    torch.testing.assert_close(found.translation, place, atol=0.02, rtol=0)
    torch.testing.assert_close(found.yaw, yaw, atol=1e-3, rtol=0)
    torch.testing.assert_close(found.size_lhw, size, atol=5e-3, rtol=0)
    torch.testing.assert_close(found.ground, torch.tensor([0.0, -1.0, 0.0, 1.65]), atol=5e-3, rtol=0)


def test_a_known_ground_corrects_the_depth_along_the_ray() -> None:
    camera, place, yaw, size, boxes = row_of_cars()
    network = Oracle(camera, place, yaw, size, boxes)
    network.depth = network.depth + torch.tensor([0.08, -0.08, 0.08])
    network.size = network.size + torch.tensor([0.08, -0.08, 0.08])[:, None]
    ground = torch.tensor([0.0, -1.0, 0.0, 1.65])
    one = Oracle(camera, place[:1], yaw[:1], size[:1], boxes[:1])
    alone = pose.estimate_poses(grey(), boxes[:1], ["Car"], camera, torch.tensor([0.0, -1.0, 0.0, 5.0]), one)
    found = pose.estimate_poses(grey(), boxes, ["Car"] * 3, camera, ground, network)
    wrong = torch.tensor([0.08, 0.08, 0.08]).expm1()
    error = (found.translation[:, 2] / place[:, 2] - 1).abs()
    assert bool((error < 0.7 * wrong).all()), error
    assert bool((found.log_depth_sigma < 0.05).all())
    ray = found.translation / found.translation[:, 2:]
    torch.testing.assert_close(ray, place / place[:, 2:], atol=5e-3, rtol=0)
    # what is farther is as much larger
    torch.testing.assert_close(found.size_lhw / found.translation[:, 2:], size / place[:, 2:], atol=2e-3, rtol=0)
    # a plane far below is not believed
    assert float(alone.translation[0, 2]) == pytest.approx(float(place[0, 2]), rel=0.06)


def test_the_ground_is_what_most_vehicles_stand_on() -> None:
    rng = np.random.default_rng(0)
    x, z = rng.uniform(-8, 8, 12), rng.uniform(8, 50, 12)
    points = np.stack([x, 1.6 + 0.01 * z, z], 1)
    points[3, 1] -= 2.5
    plane, covariance = pose.fit_plane(
        points, np.full(12, 0.05), np.array([0.0, 0.0, 1.65]), np.array([0.02, 0.015, 0.15])
    )
    assert plane == pytest.approx([0.0, 0.01, 1.6], abs=0.06)
    assert abs(plane[1] - 0.01) < 0.003
    assert np.linalg.eigvalsh(covariance).min() > 0
    nothing, spread = pose.fit_plane(
        np.zeros((0, 3)), np.zeros(0), np.array([0.0, 0.0, 1.65]), np.array([0.02, 0.015, 0.15])
    )
    assert nothing == pytest.approx([0, 0, 1.65])
    assert np.sqrt(np.diag(spread)) == pytest.approx([0.02, 0.015, 0.15])


@pytest.mark.parametrize("alpha", [-3.1, -1.6, -0.3, 0.0, 0.8, 1.57, 3.0])
def test_mirrored_twice_is_the_same_and_once_is_the_other_angle(alpha: float) -> None:
    camera, place, _, size, boxes = row_of_cars(places=((0.0, 15.0),))
    prediction = Oracle(camera, place, torch.tensor([alpha]), size, boxes)(
        grey()[None], torch.zeros(1, pose.BOX_FEATURES)
    )
    turned = pose.unmirror_prediction(prediction)
    assert torch.equal(pose.unmirror_prediction(turned).bins, prediction.bins)
    assert torch.equal(pose.unmirror_prediction(turned).turn, prediction.turn)
    angle, sure = pose.decode_viewing_angle(turned)
    assert math.remainder(float(angle) - (math.pi - alpha), 2 * math.pi) == pytest.approx(0, abs=1e-5)
    assert float(sure) > 0.99


def test_equally_likely_front_and_back_have_no_confidence() -> None:
    centre = torch.arange(BINS) * (2 * math.pi / BINS)
    bins = 6 * (2 * (centre - 1.0)).cos()[None]  # alpha 1.0, or half a turn away
    apart = torch.where((centre - 1.0).cos() > 0, 1.0 - centre, 1.0 + math.pi - centre)
    turn = torch.stack([apart.cos(), apart.sin()], -1)[None]
    nothing = torch.zeros(1)
    prediction = PosePrediction(
        bins, turn, torch.zeros(1, 2), torch.zeros(1, 3), nothing, nothing, torch.zeros(1, len(KINDS))
    )
    alpha, sure = pose.decode_viewing_angle(prediction)
    assert math.remainder(float(alpha) - 1.0, math.pi) == pytest.approx(0, abs=1e-4)
    assert float(sure) == pytest.approx(0.5, abs=0.01)


def test_crops_show_the_box_in_their_middle() -> None:
    image = np.zeros((200, 300, 3), np.float32)
    image[40:80, 100:160] = 1  # pixels' centres 40 to 79, 100 to 159
    crop = pose.crop_boxes(image, np.array([[99.5, 39.5, 159.5, 79.5]], np.float32), (64, 96), 1.0)[0]
    assert crop.min() > 0.49  # half a pixel beyond the edge is half light
    assert crop[1:-1, 1:-1].min() > 0.99
    wide = pose.crop_boxes(image, np.array([[99.5, 39.5, 159.5, 79.5]], np.float32), (64, 96), 2.0)[0]
    assert wide[17:47, 25:71].min() > 0.99
    assert wide[:15].max() < 0.01
    assert wide[:, :23].max() < 0.01
    # from a halved picture too, and grey beyond the border
    large = pose.crop_boxes(image, np.array([[-100, -60, 360, 260.0]], np.float32), (64, 96), 1.0)[0]
    assert large[0, 0].tolist() == [0.5, 0.5, 0.5]
    assert large[24, 48] == pytest.approx([1, 1, 1], abs=1e-5)
    assert large[50, 48] == pytest.approx([0, 0, 0], abs=1e-5)


def test_features_mark_cut_sides() -> None:
    camera = kitti_camera()
    boxes = torch.tensor([[0.0, 50, 100, 374], [609.6 - 50, 172.9 - 30, 609.6 + 50, 172.9 + 30]])
    boxes = torch.cat([boxes, torch.tensor([[1100.0, 0, 1241, 200]])])
    numbers = pose.box_features(boxes, pose.is_truck(["Car", "Van", "Truck"]), pose.camera_features(camera))
    assert numbers.shape == (3, pose.BOX_FEATURES)
    assert numbers[:, 4:8].tolist() == [[1, 0, 0, 1], [0, 0, 0, 0], [0, 1, 1, 0]]
    assert numbers[:, 8].tolist() == [0, 0, 1]
    assert numbers[1, :2].tolist() == pytest.approx([0, 0], abs=1e-6)
    turned = pose.mirror_features(numbers)
    assert turned[:, 4:8].tolist() == [[0, 0, 1, 1], [0, 0, 0, 0], [1, 1, 0, 0]]
    assert torch.equal(turned[:, 0], -numbers[:, 0])


def test_no_boxes_give_no_poses() -> None:
    camera = kitti_camera()
    found = pose.estimate_poses(grey(), torch.zeros(0, 4), [], camera)
    assert found.translation.shape == (0, 3)
    assert found.kind == ()
    torch.testing.assert_close(found.ground, torch.tensor([0.0, -1.0, 0.0, 1.65]))


def test_what_is_not_right_is_refused() -> None:
    camera = kitti_camera()
    box = torch.tensor([[100.0, 100, 200, 160]])
    with pytest.raises(ShapeError, match="photograph"):
        pose.estimate_poses(grey()[:, :100], box, ["Car"], camera)
    with pytest.raises(ShapeError, match="boxes_xyxy"):
        pose.estimate_poses(grey(), box[:, :3], ["Car"], camera)
    with pytest.raises(ShapeError, match="kinds: expected 1"):
        pose.estimate_poses(grey(), box, [], camera)
    with pytest.raises(RangeError, match=r"kinds\[0\]: expected Car or Van or Truck, found 'Tram'"):
        pose.estimate_poses(grey(), box, ["Tram"], camera)
    with pytest.raises(RangeError, match=r"boxes_xyxy\[0\]"):
        pose.estimate_poses(grey(), box[:, [2, 1, 0, 3]], ["Car"], camera)
    with pytest.raises(RangeError, match=r"boxes_xyxy\[0\]"):
        pose.estimate_poses(grey(), box * math.nan, ["Car"], camera)
    with pytest.raises(RangeError, match="ground"):
        pose.estimate_poses(grey(), box, ["Car"], camera, torch.tensor([0.0, 1.0, 0.0, 1.65]))


def test_damaged_weights_are_named(tmp_path: Path) -> None:
    whole = files.read_bytes(pose.WEIGHTS)
    path = tmp_path / "pose.safetensors"
    for data in (whole[:4], whole[:100], whole[:-2000], b"\x02\0\0\0\0\0\0\0[]"):
        path.write_bytes(data)
        with pytest.raises(FormatError, match=r"pose\.safetensors"):
            pose.load_network(path)
    with pytest.raises(FormatError, match=r"none\.safetensors"):
        pose.load_network(tmp_path / "none.safetensors")
    path.write_bytes(whole.replace(b"out.bias", b"not.bias"))
    with pytest.raises(FormatError, match=r"not\.bias: expected none|out\.bias: expected a tensor"):
        pose.load_network(path)


def test_the_weights_are_small() -> None:
    assert pose.WEIGHTS.stat().st_size <= 1_500_000


def test_boxes_at_the_border_and_of_few_pixels_give_finite_poses() -> None:
    camera = kitti_camera()
    boxes = torch.tensor(
        [[0.0, 0, 1241, 374], [0, 180, 60, 374], [1150, 190, 1241, 374], [600, 170, 606, 174], [0, 0, 40, 30]]
    )
    generator = torch.Generator().manual_seed(0)
    photograph = torch.rand(3, HEIGHT, WIDTH, generator=generator)
    kinds = ["Truck", "Car", "Van", "Car", "Car"]
    found = pose.estimate_poses(photograph, boxes, kinds, camera)
    for values in (found.translation, found.yaw, found.size_lhw, found.log_depth_sigma, found.ground):
        assert bool(torch.isfinite(values).all())
    assert bool((found.translation[:, 2] > 0).all())
    assert bool((found.size_lhw > 0).all())
    assert bool((found.facing >= 0.5 - 1e-6).all())
    assert all(kind in KINDS for kind in found.kind)
    again = pose.estimate_poses(photograph, boxes, kinds, camera)
    assert torch.equal(found.translation, again.translation)
    assert torch.equal(found.yaw, again.yaw)


def test_the_mirrored_photograph_gives_the_mirrored_poses() -> None:
    k = torch.tensor([[700.0, 0.0, (WIDTH - 1) / 2], [0.0, 700.0, 170.0], [0.0, 0.0, 1.0]])
    camera = Camera(k, HEIGHT, WIDTH)
    photograph = torch.rand(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1))
    boxes = torch.tensor([[0.0, 180, 160, 330], [500, 170, 640, 240]])
    one = pose.estimate_poses(photograph, boxes, ["Car", "Car"], camera)
    turned = boxes[:, [2, 1, 0, 3]] * torch.tensor([-1.0, 1, -1, 1]) + torch.tensor([WIDTH - 1.0, 0, WIDTH - 1, 0])
    other = pose.estimate_poses(photograph.flip(2), turned, ["Car", "Car"], camera)
    flip = torch.tensor([-1.0, 1, 1])
    torch.testing.assert_close(other.translation * flip, one.translation, atol=2e-3, rtol=1e-4)
    apart = other.yaw - (math.pi - one.yaw)
    assert torch.remainder(apart + 1, 2 * math.pi).tolist() == pytest.approx([1, 1], abs=2e-3)


def test_clipped_boxes_are_what_the_flags_expect() -> None:
    camera, place, yaw, size, _ = row_of_cars(places=((-4.5, 6.0),))
    box = clip_boxes(project_boxes(size, yaw, place, camera.matrix), HEIGHT, WIDTH)
    numbers = pose.box_features(box, pose.is_truck(["Car"]), pose.camera_features(camera))
    assert numbers[0, 4] == 1
