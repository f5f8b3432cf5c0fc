"""From a photograph to a scene and back."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from scene_ir.derender import silhouette
from scene_ir.derender.derender import DerenderSettings, derender, place_vehicles
from scene_ir.derender.silhouette import Placement
from scene_ir.errors import RangeError, ShapeError
from scene_ir.render.compositor import Compositor
from scene_ir.types import Category, Frame, Labels, SceneIR

KITTI = Path(__file__).parents[4] / "shared" / "data" / "kitti" / "training"


def render(scene: SceneIR) -> torch.Tensor:
    return Compositor(scene).render(scene).image


def psnr(first: torch.Tensor, second: torch.Tensor) -> float:
    return -10 * math.log10(max(float((first - second).square().mean()), 1e-12))


@pytest.fixture(scope="module")
def scene(street) -> SceneIR:
    return derender(street.frame)


def test_the_render_is_the_photograph(street, scene):
    assert psnr(render(scene), street.frame.photograph) > 60


def test_outside_of_car_and_shadow_not_a_bit_changes(street, scene):
    matte = scene.objects.source[0].foreground
    touched = np.zeros(street.mask.shape, bool)
    touched[matte.y0 : matte.y0 + matte.values.shape[1], matte.x0 : matte.x0 + matte.values.shape[2]] = True
    touched |= (scene.background != street.frame.photograph).any(0).numpy()
    assert torch.equal(
        render(scene)[:, ~torch.from_numpy(touched)], street.frame.photograph[:, ~torch.from_numpy(touched)]
    )
    assert (~touched).mean() > 0.6


def test_mask_and_place_come_out_right(street, scene):
    matte = scene.objects.source[0].foreground
    opaque = np.zeros(street.mask.shape, bool)
    h, w = matte.values.shape[1:]
    opaque[matte.y0 : matte.y0 + h, matte.x0 : matte.x0 + w] = matte.values[3].numpy() > 0.5
    union = (opaque | street.mask).sum()
    assert (opaque & street.mask).sum() / union > 0.9
    assert float(scene.provenance["objects[0].mask_iou"]) > 0.9
    assert scene.objects.translation[0].tolist() == pytest.approx([0.6, 1.65, 11.0], abs=0.35)


def test_the_car_and_its_shadow_are_gone_from_the_background(street, scene):
    truth = torch.from_numpy(street.background.transpose(2, 0, 1))
    box = [int(v) for v in street.frame.labels.boxes_xyxy[0]]
    part = (slice(None), slice(box[1] - 4, box[3] + 5), slice(box[0] - 4, box[2] + 5))
    with_car = psnr(street.frame.photograph[part], truth[part])
    without = psnr(scene.background[part], truth[part])
    assert without > 17
    assert without > with_car + 3
    red = (scene.background[0] - scene.background[1])[part[1:]]
    assert float((red > 0.25).float().mean()) < 0.005


def test_a_moved_car_takes_all_of_itself_along(scene):
    objects = scene.objects
    away = render(scene.with_objects(translation=objects.translation + torch.tensor([3.5, 0.0, 0.0])))
    matte = scene.objects.source[0].foreground
    left = away[:, matte.y0 : matte.y0 + matte.values.shape[1], matte.x0 : matte.x0 + matte.values.shape[2] // 2]
    assert float(((left[0] - left[1]) > 0.25).float().mean()) < 0.01


def test_same_input_same_scene(street, scene):
    again = derender(street.frame)
    assert torch.equal(again.background, scene.background)
    assert torch.equal(again.objects.translation, scene.objects.translation)
    assert torch.equal(again.objects.source[0].foreground.values, scene.objects.source[0].foreground.values)


@pytest.mark.parametrize("masked", [False, True])
def test_a_car_that_the_fit_leads_out_of_sight_stays_at_its_label(street, masked, monkeypatch):
    def fit(placements: list[Placement], *_: object) -> list[Placement]:
        return [replace(p, translation=p.translation + torch.tensor([80.0, 0.0, 0.0])) for p in placements]

    monkeypatch.setattr(silhouette, "fit_silhouettes", fit)
    masks = torch.from_numpy(street.mask)[None].float() if masked else None
    scene = derender(replace(street.frame, masks=masks))
    assert scene.objects.translation[0].tolist() == pytest.approx([0.6, 1.65, 11.0], abs=0.35)
    assert psnr(render(scene), street.frame.photograph) > 60


def test_a_given_mask_is_used(street):
    masks = torch.from_numpy(street.mask)[None].float()
    scene = derender(replace(street.frame, masks=masks), DerenderSettings(fit=False))
    assert psnr(render(scene), street.frame.photograph) > 60


def with_labels(frame: Frame, **changes) -> Frame:
    return replace(frame, labels=replace(frame.labels, **changes))


def test_a_given_depth_is_used_but_for_the_vehicles_own(street):
    depth = torch.full((street.frame.camera.height, street.frame.camera.width), 33.0)
    depth[torch.from_numpy(street.mask)] = 11.0
    masks = torch.from_numpy(street.mask)[None].float()
    scene = derender(replace(street.frame, depth=depth, masks=masks), DerenderSettings(fit=False))
    behind = scene.depth[torch.from_numpy(street.mask)]
    assert (behind != 11.0).all()
    assert (scene.depth == 33.0).float().mean() > 0.6


def test_no_wall_stands_before_a_car_where_the_ground_was_not_recognised(street):
    shares = np.zeros((3, *street.mask.shape), np.float32)
    shares[0, :45], shares[1, 45:165], shares[2, 165:] = 1, 1, 1  # road up to 8 m only; the car stands at 11 m

    def segmenter(_image: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
        return shares, ("sky", "tree", "road")

    depth = derender(street.frame, DerenderSettings(fit=False, segmenter=segmenter)).depth
    left, top, right, _ = (int(v) for v in street.frame.labels.boxes_xyxy[0])
    assert float(depth[top + 5][torch.from_numpy(street.mask[top + 5])].min()) > 10.5
    assert float(depth[top + 5, left:right].diff().abs().max()) < 0.6


def test_no_labels_is_an_error(street):
    with pytest.raises(ShapeError, match="labels"):
        derender(replace(street.frame, labels=None))


def test_a_box_behind_the_camera_is_an_error_that_names_it(street):
    behind = with_labels(street.frame, translation=torch.tensor([[0.0, 1.6, -8.0]]))
    with pytest.raises(RangeError, match=r"label 0 \(Car\).*in front of the camera"):
        derender(behind)


@pytest.mark.parametrize(
    "change",
    [
        {"kind": ("Pedestrian",)},
        {"translation": torch.full((1, 3), -1000.0), "size_lhw": -torch.ones(1, 3)},
        {"translation": torch.tensor([[0.0, 1.6, 300.0]])},
        {"translation": torch.tensor([[40.0, 1.6, 10.0]])},
    ],
    ids=["a person", "no pose", "too small", "beside the image"],
)
def test_a_frame_without_vehicles_is_a_scene_without_objects(street, change):
    scene = derender(with_labels(street.frame, **change))
    assert len(scene.objects) == 0
    assert torch.equal(scene.background, street.frame.photograph)
    assert torch.equal(render(scene), street.frame.photograph)
    assert torch.equal(scene.ignore, street.frame.labels.boxes_xyxy)  # nothing that is found there counts


def test_who_hides_all_vehicles_keeps_their_colours(street):
    """What stands in front is drawn from its own layer, whose colours are solved with the vehicles'."""
    one = street.frame.labels
    left, top, right, bottom = one.boxes_xyxy[0].tolist()
    wall = torch.tensor([[left - 5, top - 5, right + 5, bottom + 5]])
    both = replace(
        one,
        kind=(*one.kind, "Pedestrian"),
        boxes_xyxy=torch.cat([one.boxes_xyxy, wall]),
        truncation=torch.zeros(2),
        occlusion=torch.zeros(2, dtype=torch.int64),
        translation=torch.cat([one.translation, one.translation / 2 + torch.tensor([0.0, 0.8, 0.0])]),
        yaw=torch.cat([one.yaw, torch.zeros(1)]),
        size_lhw=torch.cat([one.size_lhw, torch.tensor([[2.0, 2.0, 2.0]])]),
    )
    masks = torch.zeros(2, *street.mask.shape)
    masks[1, max(int(top) - 5, 0) : int(bottom) + 5, max(int(left) - 5, 0) : int(right) + 5] = 1
    scene = derender(replace(street.frame, labels=both, masks=masks), DerenderSettings(fit=False))
    assert len(scene.objects) == 0
    assert torch.equal(render(scene), street.frame.photograph)


def test_labels_that_are_no_vehicles_become_ignored_regions(street):
    one, region = street.frame.labels, torch.tensor([[1.0, 2.0, 30.0, 40.0]])
    walker = torch.tensor([[300.0, 90.0, 320.0, 150.0]])
    twice = (torch.cat([t, t]) for t in (one.truncation, one.occlusion, one.translation, one.yaw, one.size_lhw))
    both = Labels(("Pedestrian", *one.kind), torch.cat([walker, one.boxes_xyxy]), *twice, region)
    scene = derender(replace(street.frame, labels=both), DerenderSettings(fit=False))
    assert len(scene.objects) == 1
    assert torch.equal(scene.ignore, torch.cat([region, walker]))
    assert scene.other_labels is not None
    assert (scene.other_labels.kind, scene.other_labels.ignore_xyxy.tolist()) == (("Pedestrian",), region.tolist())
    assert torch.equal(scene.other_labels.translation, one.translation)


def test_vans_are_cars_and_trucks_are_trucks(street):
    for kind, category in (("Van", Category.CAR), ("Truck", Category.TRUCK)):
        scene = derender(with_labels(street.frame, kind=(kind,)), DerenderSettings(fit=False))
        assert scene.objects.category.tolist() == [int(category)]


def test_cars_behind_each_other_at_the_border_and_through_the_near_plane(street):
    place = torch.tensor([[0.6, 1.65, 11.0], [1.2, 1.65, 15.0], [-4.6, 1.65, 9.0], [1.5, 1.65, 1.2]])
    n = len(place)
    labels = Labels(
        ("Car",) * n, torch.tensor([[0.0, 60.0, 470.0, 199.0]]).expand(n, 4), torch.zeros(n),
        torch.full((n,), 2), place, torch.full((n,), 0.6), torch.tensor([[4.0, 1.5, 1.7]]).expand(n, 3),
        torch.zeros(0, 4),
    )  # fmt: skip
    scene = derender(replace(street.frame, labels=labels), DerenderSettings(fit=True))
    assert 2 <= len(scene.objects) <= n
    assert psnr(render(scene), street.frame.photograph) > 60
    assert bool(torch.isfinite(scene.background).all())


def kitti_frame(identifier: str) -> Frame:
    if not KITTI.is_dir():
        pytest.skip(f"{KITTI} is missing")
    from drivesem.data.kitti import KittiDataset

    return KittiDataset(KITTI.parent).frame(identifier)


@pytest.mark.parametrize("identifier", ["000003", "000012"])
def test_a_real_frame_comes_back_exactly(identifier):
    frame = kitti_frame(identifier)
    scene = derender(frame)
    image = render(scene)
    inside = torch.zeros(image.shape[1:], dtype=torch.bool)
    for x0, y0, x1, y1 in scene.objects.box2d.round().long().tolist():
        inside[max(y0, 0) : y1 + 1, max(x0, 0) : x1 + 1] = True
    assert len(scene.objects) > 0
    assert psnr(image[:, inside], frame.photograph[:, inside]) > 40


@pytest.mark.slow
@pytest.mark.parametrize(
    "identifier",
    ["000000", "000001", "000002", "000004", "000005", "000006", "000008", "000010", "000015", "000021", "000031",
     "000060"],
)  # fmt: skip
def test_all_real_frames_come_back(identifier):
    frame = kitti_frame(identifier)
    scene = derender(frame)
    image = render(scene)
    assert psnr(image, frame.photograph) > 50
    for index in range(len(scene.objects)):
        assert float(scene.provenance[f"objects[{index}].mask_iou"]) > 0.45


def test_a_2d_box_counts_only_where_it_is_not_the_3d_boxs_own_picture(street):
    from scene_ir.derender.derender import _trusted_boxes
    from scene_ir.geometry import project_boxes

    labels, camera = street.frame.labels, street.frame.camera
    assert _trusted_boxes(labels, [0], camera).trust.tolist() == [[1.0, 1.0, 1.0, 1.0]]
    drawn = project_boxes(labels.size_lhw, labels.yaw, labels.translation, camera.matrix)
    assert _trusted_boxes(replace(labels, boxes_xyxy=drawn), [0], camera).trust.tolist() == [[0.0, 1.0, 0.0, 0.0]]
    hidden = replace(labels, occlusion=torch.tensor([2]))
    assert _trusted_boxes(hidden, [0], camera).trust.tolist() == [[0.0, 0.0, 0.0, 0.0]]


def test_a_vehicle_too_low_to_be_evaluated_is_not_fitted(street, monkeypatch: pytest.MonkeyPatch) -> None:
    fitted: list[int] = []
    fit = silhouette.fit_silhouettes

    def count(placements, *rest):
        fitted.append(len(placements))
        return fit(placements, *rest)

    monkeypatch.setattr(silhouette, "fit_silhouettes", count)
    labels = street.frame.labels
    assert labels is not None
    heights = labels.boxes_xyxy[:, 3] - labels.boxes_xyxy[:, 1]
    placed = place_vehicles(street.frame, DerenderSettings())
    assert fitted == [len(placed)]
    limit = float(heights[list(placed)].max()) + 1
    low = place_vehicles(street.frame, DerenderSettings(min_fit_px=limit))
    assert fitted == [len(placed)]
    assert set(low) == set(placed)
    assert not any(bool(placement.ffd.any()) for placement in low.values())
    assert any(bool(placement.ffd.any()) for placement in placed.values())
