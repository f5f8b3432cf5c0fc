"""Outlines, masks and the fit of one to the other."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from scene_ir.derender import silhouette
from scene_ir.derender.silhouette import FitSettings, LabelBoxes
from scene_ir.geometry import project_boxes
from scene_ir.types import Camera

CAMERA = Camera(torch.tensor([[380.0, 0, 239.5], [0, 380.0, 88.0], [0, 0, 1.0]]), 200, 480)
NOTHING = np.zeros((200, 480), bool)
NO_BOXES = LabelBoxes(torch.zeros(1, 4), torch.zeros(1, 4))


def car(x: float = 0.5, z: float = 11.0, yaw: float = 0.6, kind: str = "hatchback") -> silhouette.Placement:
    return silhouette.place_mesh(
        kind, torch.tensor([x, 1.65, z]), torch.tensor(yaw), torch.tensor([4.0, 1.5, 1.7])
    )


def outline(placement: silhouette.Placement) -> np.ndarray:
    return silhouette.render_silhouettes([placement], CAMERA)[0]


def test_silhouette_lies_in_the_projected_box_and_nearly_fills_its_height():
    placement = car()
    box = project_boxes(placement.size_lhw[None], placement.yaw[None], placement.translation[None], CAMERA.matrix)[
        0
    ]
    x0, y0, x1, y1 = silhouette.mask_bounds(outline(placement))
    assert x0 >= box[0] - 1
    assert y0 >= box[1] - 1
    assert x1 <= box[2] + 2
    assert y1 <= box[3] + 2
    assert (y1 - y0) > 0.85 * float(box[3] - box[1])


def test_silhouettes_of_no_cars_and_of_a_car_next_to_the_image():
    assert silhouette.render_silhouettes([], CAMERA) == []
    assert not outline(car(x=60.0)).any()


@pytest.mark.parametrize(("radius", "remaining"), [(2.0, 45), (-2.0, 5)])
def test_grow_and_shrink(radius, remaining):
    mask = np.zeros((30, 30), bool)
    mask[13:18, 13:18] = True
    grown = silhouette.grow_mask(mask, radius)
    assert grown.sum() == pytest.approx(remaining, abs=25 if radius > 0 else 8)
    assert (grown >= mask).all() if radius > 0 else (grown <= mask).all()


def test_iou_leaves_the_unknown_out():
    first, second = NOTHING.copy(), NOTHING.copy()
    first[10:20, 10:30], second[10:20, 20:40] = True, True
    unknown = NOTHING.copy()
    unknown[:, 30:] = True
    assert silhouette.mask_iou(first, second) == pytest.approx(1 / 3)
    assert silhouette.mask_iou(first, second, unknown) == pytest.approx(1 / 2)
    assert silhouette.mask_iou(NOTHING, NOTHING) == 0


@pytest.mark.parametrize(
    ("kind", "size", "first"),
    [("Car", (3.6, 1.5, 1.6), "hatchback"), ("Car", (4.5, 1.45, 1.8), "sedan"), ("Van", (5.0, 2.0, 1.9), "van"),
     ("Truck", (8.0, 3.2, 2.5), "truck"), ("Truck", (12.3, 2.9, 2.6), "bus")],
)  # fmt: skip
def test_templates_by_type_and_proportion(kind, size, first):
    assert silhouette.rank_template_kinds(kind, size)[0] == first


@pytest.mark.parametrize(
    ("kind", "size", "withheld"),
    [("Car", (4.5, 1.45, 1.8), "sedan"), ("Van", (5.5, 2.6, 2.0), "van"), ("Truck", (8.0, 3.2, 2.5), "truck")],
)
def test_a_kind_that_is_withheld_is_no_candidate(kind, size, withheld):
    assert withheld in silhouette.rank_template_kinds(kind, size)
    left = silhouette.rank_template_kinds(kind, size, withheld)
    assert left
    assert withheld not in left


def test_a_users_meshes_are_tried_by_body_and_size():
    mesh = silhouette.place_mesh("van", torch.zeros(3), torch.tensor(0.0), torch.ones(3)).mesh
    lengths = (4.0, 4.4, 3.6, 4.8, 5.2, 3.2, 4.2, 4.1)
    own = [silhouette.UserMesh(replace(mesh, name=f"own {x}"), "sedan", (x, 1.5, 1.7)) for x in lengths]
    lorry = silhouette.UserMesh(replace(mesh, name="lorry"), "truck", (4.0, 1.5, 1.7))
    chosen = silhouette.select_user_meshes("Car", (4.05, 1.5, 1.7), [lorry, *own])
    assert [m.name for m in chosen[:3]] == ["own 4.1", "own 4.0", "own 4.2"]
    assert len(chosen) == 6
    assert [m.name for m in silhouette.select_user_meshes("Truck", (8.0, 3.0, 2.5), [lorry, *own])] == ["lorry"]
    assert silhouette.select_user_meshes("Van", (4.05, 1.5, 1.7), [lorry, *own]) == ()


def test_fit_finds_a_pose_that_is_off():
    truth, start = car(), car(x=0.65, yaw=0.57)
    target = outline(truth)
    fitted = silhouette.fit_silhouettes([start], [target], [NOTHING], NO_BOXES, CAMERA, FitSettings())[0]
    before, after = silhouette.mask_iou(outline(start), target), silhouette.mask_iou(outline(fitted), target)
    assert before < 0.95
    assert after > 0.965


def test_fit_stays_near_the_label():
    start = car()
    target = outline(car(x=2.0, yaw=1.2))
    fitted = silhouette.fit_silhouettes([start], [target], [NOTHING], NO_BOXES, CAMERA, FitSettings())[0]
    assert float((fitted.translation - start.translation).abs().max()) <= 0.3 + 1e-5
    assert abs(float(fitted.yaw - start.yaw)) <= 0.087 + 1e-5
    assert float((fitted.size_lhw / start.size_lhw).log().abs().max()) <= 0.08 + 1e-5
    lowest = fitted.ffd.reshape(4, 4, 4, 3)[:, -1, :, 1]
    assert float(lowest.abs().max()) == 0


def test_what_is_unknown_pulls_at_nothing():
    start = car()
    target = outline(start)
    hidden = NOTHING.copy()
    hidden[:, 262:] = True
    fitted = silhouette.fit_silhouettes([start], [target & ~hidden], [hidden], NO_BOXES, CAMERA, FitSettings())[0]
    assert silhouette.mask_iou(outline(fitted), target) > 0.95


def test_the_labels_box_raises_a_roof_that_the_mask_lacks():
    truth = car()
    target = outline(truth)
    x0, y0, x1, y1 = silhouette.mask_bounds(target)
    short = target.copy()
    short[: y0 + 8] = False
    boxes = LabelBoxes(torch.tensor([[x0, y0, x1 - 1, y1 - 1]]).float(), torch.tensor([[0.0, 1.0, 0.0, 1.0]]))
    tops = [
        silhouette.mask_bounds(
            outline(silhouette.fit_silhouettes([truth], [short], [NOTHING], b, CAMERA, FitSettings())[0])
        )[1]
        for b in (NO_BOXES, boxes)
    ]
    assert tops[1] < tops[0]
    assert abs(tops[1] - y0) <= 3


def test_fit_of_no_steps_and_of_no_cars_changes_nothing():
    start = car()
    same = silhouette.fit_silhouettes([start], [outline(start)], [NOTHING], NO_BOXES, CAMERA, FitSettings(steps=0))
    assert same == [start]
    empty = LabelBoxes(torch.zeros(0, 4), torch.zeros(0, 4))
    assert silhouette.fit_silhouettes([], [], [], empty, CAMERA, FitSettings()) == []


def painted(mask: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(1)
    image = np.clip(120 + rng.normal(0, 12, (200, 480, 3)), 0, 255)
    image[mask] = np.clip(np.array([190, 40, 40]) + rng.normal(0, 12, (int(mask.sum()), 3)), 0, 255)
    return image.astype(np.uint8)


def test_grabcut_finds_the_car_that_the_template_only_nearly_covers():
    truth = outline(car())
    template = outline(car(x=0.58, yaw=0.62))
    found = silhouette.grabcut_mask(painted(truth), template, NOTHING, (8.0, 5.0, 8.0))
    assert silhouette.mask_iou(template, truth) < 0.95
    assert silhouette.mask_iou(found, truth) > 0.96


def test_grabcut_takes_nothing_of_nearer_cars_and_is_repeatable():
    truth = outline(car())
    hidden = NOTHING.copy()
    hidden[:, 262:] = True
    first, second = (
        silhouette.grabcut_mask(painted(truth), outline(car(x=0.55)), hidden, (8.0, 5.0, 8.0)) for _ in range(2)
    )
    assert np.array_equal(first, second)
    assert not (first & hidden).any()
    assert silhouette.mask_iou(first, truth, hidden) > 0.9


def test_a_car_wholly_hidden_has_no_mask():
    assert not silhouette.grabcut_mask(painted(NOTHING), outline(car()), ~NOTHING, (5.0, 5.0, 5.0)).any()


def test_a_tiny_car_is_found():
    placement = replace(car(z=60.0), translation=torch.tensor([2.0, 1.65, 60.0]))
    truth = outline(placement)
    image = cv2.GaussianBlur(painted(truth), (3, 3), 0.5)
    found = silhouette.grabcut_mask(image, truth, NOTHING, (2.0, 2.0, 2.0))
    assert silhouette.mask_iou(found, truth) > 0.6


def test_a_box_holds_a_car_that_the_image_cuts_by_what_is_inside():
    truth = car(x=-3.2, z=5.2, yaw=0.3)
    target = outline(truth)
    x0, y0, x1, y1 = silhouette.mask_bounds(target)
    assert x0 == 0
    boxes = LabelBoxes(torch.tensor([[x0, y0, x1 - 1, y1 - 1]]).float(), torch.tensor([[0.0, 1.0, 1.0, 1.0]]))
    fitted = silhouette.fit_silhouettes([truth], [target], [NOTHING], boxes, CAMERA, FitSettings())[0]
    assert silhouette.mask_iou(outline(fitted), target) > 0.97


@pytest.mark.parametrize("radius", [0.0, 1.5, 4.0, -1.0, -2.5])
def test_growing_in_a_window_equals_growing_everywhere(radius: float):
    mask = np.zeros((60, 90), bool)
    mask[20:33, 40:70] = mask[50:, :12] = True
    mask[25, 55] = False
    if radius < 0:
        away = cv2.distanceTransform(np.pad(mask, 1, mode="edge").astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
        wanted = away > -radius
    else:
        wanted = mask | (cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5) <= radius)
    assert np.array_equal(silhouette.grow_mask(mask, radius), wanted)
    assert not silhouette.grow_mask(np.zeros_like(mask), radius).any()
