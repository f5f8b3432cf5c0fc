"""What stands in front of vehicles, found by labels, masks and depth."""

import numpy as np
import pytest
import torch

from scene_ir.derender import depth as maps
from scene_ir.derender import occluders as front
from scene_ir.derender import silhouette
from scene_ir.derender.derender import DerenderSettings, derender
from scene_ir.geometry import height_above_ground, project_boxes
from scene_ir.render.compositor import Compositor
from scene_ir.types import Camera, Frame, Labels

CAMERA = Camera(torch.tensor([[300.0, 0, 119.5], [0, 300.0, 60.0], [0, 0, 1.0]]), 150, 240)
LEVEL = torch.tensor([0.0, -1.0, 0.0, 1.65])
SIZES = torch.tensor([[4.0, 1.5, 1.7], [0.6, 1.75, 0.6]])
PLACES = torch.tensor([[0.0, 1.65, 12.0], [-0.4, 1.65, 8.0]])
YAWS = torch.tensor([0.1, 0.0])


def labels(kinds: tuple[str, str] = ("Car", "Pedestrian")) -> Labels:
    return Labels(
        kinds, project_boxes(SIZES, YAWS, PLACES, CAMERA.matrix), torch.zeros(2),
        torch.zeros(2, dtype=torch.int64), PLACES, YAWS, SIZES, torch.zeros(0, 4),
    )  # fmt: skip


def person() -> np.ndarray:
    """A body narrower than its box: trunk, head and two legs."""
    x0, y0, x1, y1 = labels().boxes_xyxy[1].tolist()
    v, u = np.mgrid[0:150, 0:240]
    across, down = (u - (x0 + x1) / 2) / (x1 - x0), (v - y0) / (y1 - y0)
    trunk = (np.abs(across) < 0.28) & (down > 0.2) & (down < 0.6)
    head = np.hypot(across * 0.6, down - 0.1) < 0.1
    legs = (np.abs(np.abs(across) - 0.17) < 0.1) & (down >= 0.6) & (down < 0.98)
    return trunk | head | legs


def picture() -> np.ndarray:
    """A grey street with a blue car and a person in red before it, 8 bit."""
    rng = np.random.default_rng(0)
    image = np.full((150, 240, 3), 120.0)
    image[:58] = (150, 180, 210)
    car = silhouette.render_silhouettes(
        [silhouette.place_mesh("hatchback", PLACES[0], YAWS[0], SIZES[0])], CAMERA
    )[0]
    image[car] = (40, 60, 140)
    image[person()] = (190, 50, 40)
    return np.clip(image + rng.normal(0, 4, image.shape), 0, 255).astype(np.uint8)


def frame(masks: torch.Tensor | None = None, depth: torch.Tensor | None = None) -> Frame:
    photograph = torch.from_numpy(picture().transpose(2, 0, 1).astype(np.float32) / np.float32(255))
    return Frame("street", photograph, CAMERA, labels(), masks, depth)


def test_a_labelled_person_is_cut_out_of_its_box():
    occluders = front.find_labelled_occluders(picture(), frame(), [0], [1])
    assert len(occluders) == 1
    assert occluders[0].depth_m == pytest.approx(8.0)
    assert silhouette.mask_iou(occluders[0].mask, person()) > 0.8


def test_masks_of_the_data_set_are_used_and_far_objects_left_out():
    masks = torch.zeros(2, 150, 240)
    masks[1, 60:90, 100:104] = 1.0
    occluders = front.find_labelled_occluders(picture(), frame(masks), [0], [1])
    assert np.array_equal(occluders[0].mask, (masks[1] > 0.5).numpy())
    assert front.find_labelled_occluders(picture(), frame(masks), [1], [0]) == []


def test_depth_determines_a_pole_from_the_ground_and_from_what_is_behind():
    depth = np.minimum(maps.compute_plane_depth(LEVEL, CAMERA), 60.0)
    pole = np.zeros((150, 240), bool)
    pole[40:100, 118:122] = True
    depth[pole] = 9.0
    car = silhouette.place_mesh("hatchback", PLACES[0], YAWS[0], SIZES[0])
    outline = silhouette.render_silhouettes([car], CAMERA)[0]
    outlined = outline & ~pole
    depth[outlined] = 11.5
    height = height_above_ground(torch.from_numpy(depth), LEVEL, CAMERA.matrix).float().numpy()
    ground = np.isfinite(maps.compute_plane_depth(LEVEL, CAMERA)) & ~pole & ~outline & (depth < 60)
    assert np.abs(height[ground]).max() < 0.01
    occluders = front.find_measured_occluders(
        depth.astype(np.float32), height, outlined, [(outline, front.nearest_corner_depth(car, CAMERA))]
    )
    assert len(occluders) == 1
    assert occluders[0].depth_m == pytest.approx(9.0)
    rows = slice(*silhouette.mask_bounds(outline)[1::2])
    assert np.array_equal(occluders[0].mask[rows], (pole & (height > 0.2))[rows])


def test_opacities_of_overlapping_objects_add_up_to_at_most_one():
    image = picture().astype(np.float32) / 255
    body = person()
    shifted = np.roll(body, 3, axis=1) & ~body
    found = front.compute_opacities(image, [front.OccluderMask(body, 8.0), front.OccluderMask(shifted, 9.0)])
    assert (found[0] + found[1]).max() <= 1 + 1e-6
    assert found[0][silhouette.grow_mask(body, -1.5)].min() > 0.9
    assert found[0][~silhouette.grow_mask(body, 4)].max() == 0


def test_a_car_moves_behind_the_person_and_the_photograph_comes_back():
    scene = derender(frame(), DerenderSettings(fit=False))
    assert len(scene.occluders) == 1
    compositor = Compositor(scene)

    def levels(image: torch.Tensor) -> torch.Tensor:
        return (image.clamp(0, 1) * 255).round()

    assert torch.equal(levels(compositor.render(scene).image), levels(scene.photograph))
    shift = scene.objects.translation + torch.tensor([[-0.4, 0.0, 0.0]])
    moved = compositor.render(scene.with_objects(translation=shift))
    core = torch.from_numpy(silhouette.grow_mask(person(), -1.5))
    same = (levels(moved.image) == levels(scene.photograph)).all(dim=0)
    assert float(same[core].double().mean()) > 0.95
    # The background keeps the person, without the car around it.
    assert float((scene.background - scene.photograph).abs()[:, core].max()) < 1e-6
