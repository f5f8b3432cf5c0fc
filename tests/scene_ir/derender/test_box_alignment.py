"""Cars moved until they fill their 2D boxes, as little as that asks for."""

import numpy as np
import pytest
import torch

from scene_ir.derender import alignment as box_alignment
from scene_ir.derender import silhouette
from scene_ir.derender.alignment import BoxAlignmentSettings, align_to_boxes
from scene_ir.derender.silhouette import LabelBoxes, Placement
from scene_ir.types import Camera

CAMERA = Camera(torch.tensor([[380.0, 0, 239.5], [0, 380.0, 88.0], [0, 0, 1.0]]), 200, 480)


def car(x: float, z: float, yaw: float, size: tuple[float, float, float] = (4.0, 1.5, 1.7)) -> Placement:
    return silhouette.place_mesh("sedan", torch.tensor([x, 1.65, z]), torch.tensor(yaw), torch.tensor(size))


def seen(placement: Placement) -> np.ndarray:
    return silhouette.render_silhouettes([placement], CAMERA)[0]


def box_of(mask: np.ndarray) -> list[float]:
    x0, y0, x1, y1 = silhouette.mask_bounds(mask)
    return [x0 - 0.5, y0 - 0.5, x1 - 0.5, y1 - 0.5]


def settled(start: Placement, box: list[float], trust: tuple[float, ...]) -> Placement:
    return align_to_boxes([start], LabelBoxes(torch.tensor([box]), torch.tensor([trust])), CAMERA)[0]


def test_a_label_that_is_off_comes_to_fill_its_box():
    truth, start = car(0.5, 11.0, 0.6), car(0.66, 10.9, 0.52, (4.2, 1.43, 1.78))
    target = seen(truth)
    found = settled(start, box_of(target), (1.0, 1.0, 1.0, 1.0))
    assert silhouette.mask_iou(seen(start), target) < 0.9
    assert silhouette.mask_iou(seen(found), target) > 0.95
    assert np.abs(np.array(box_of(seen(found))) - box_of(target)).max() <= 1.5


CUT = {"left": (-3.2, 5.2, 0.3), "right": (3.4, 5.2, 0.3), "below": (0.4, 3.6, 0.9), "nearest": (-2.1, 2.6, 0.2)}


@pytest.mark.parametrize("where", CUT)
def test_a_car_that_the_image_cuts_fills_what_is_left_of_its_box(where: str):
    x, z, yaw = CUT[where]
    truth, start = car(x, z, yaw), car(x + 0.15, z + 0.1, yaw + 0.06, (4.15, 1.43, 1.75))
    target = seen(truth)
    borders = np.array([target[:, 0].any(), target[0].any(), target[:, -1].any(), target[-1].any()])
    assert borders.any()
    trust = tuple(np.where(borders, 0.0, 1.0).tolist())
    found = settled(start, box_of(target), trust)
    assert silhouette.mask_iou(seen(found), target) > silhouette.mask_iou(seen(start), target) + 0.01
    apart = np.abs(np.array(box_of(seen(found))) - box_of(target))
    assert apart[~borders].max(initial=0) <= 2.5


@pytest.mark.parametrize("where", CUT)
def test_what_lies_beyond_the_border_is_cut_off_and_not_squeezed(where: str):
    # the box of what shows, found by cutting edges, is that of the drawn pixels
    placement = car(*CUT[where])
    corners = placement.vertices().double().numpy()
    clip = CAMERA.matrix.double().numpy() @ np.concatenate([corners.T, np.ones((1, len(corners)))])
    faces = placement.mesh.faces.numpy()
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    found = box_alignment._clipped_bounds(clip, edges, CAMERA, np.zeros(4))
    drawn_box = np.array(box_of(seen(placement)))
    assert np.abs(found - np.clip(drawn_box, 0, [479, 199, 479, 199])).max() <= 1.5
    assert ((found >= -1e-6) & (found <= np.array([479, 199, 479, 199]) + 1e-6)).all()
    whole = clip[:2] / np.maximum(clip[2], 0.5)
    assert (whole.min(1) < -5).any() or (whole.max(1) > np.array([484, 204])).any()


@pytest.mark.parametrize("trust", [(0.0, 0.0, 0.0, 0.0), (1.0, 1.0, 1.0, 1.0)])
def test_without_trust_or_need_nothing_moves(trust):
    start = car(0.5, 11.0, 0.6)
    found = settled(start, box_of(seen(start)), trust)
    assert float((found.translation - start.translation).abs().max()) < 0.03
    assert abs(float(found.yaw - start.yaw)) < 0.02


def test_no_box_moves_a_car_beyond_its_label():
    start, settings = car(0.5, 11.0, 0.6), BoxAlignmentSettings()
    found = settled(start, [20.0, 20.0, 60.0, 50.0], (1.0, 1.0, 1.0, 1.0))
    limit = settings.reach * settings.shift_m + 1e-5
    assert float((found.translation - start.translation).abs().max()) <= limit
    assert float((found.size_lhw / start.size_lhw).log().abs().max()) <= settings.reach * settings.stretch + 1e-5


def test_a_car_out_of_sight_stays():
    start = car(60.0, 11.0, 0.6)
    found = settled(start, [10.0, 80.0, 60.0, 110.0], (1.0, 1.0, 1.0, 1.0))
    assert torch.allclose(found.translation, start.translation)
