"""Vehicles cut out by the network: the crops it sees, and what it says of generated streets."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from drivesem.synth.frames import SynthFrame, Truth, generate_frame
from drivesem.synth.view import blocks
from scene_ir.derender import cutout, shadow, silhouette
from scene_ir.derender.cutout import CROP_HW, Cutout
from scene_ir.errors import FormatError
from scene_ir.types import Camera

CAMERA = Camera(
    torch.tensor([[380.0, 0, 239.5], [0, 370.0, 88.0], [0, 0, 1.0]]),
    200,
    480,
    torch.tensor([[380.0, 0, 239.5, 20.0], [0, 370.0, 88.0, 0.3], [0, 0, 1.0, 0.002]]),
)
GROUND = torch.tensor([0.0, -1.0, 0.0, 1.65])


def car(x: float = 0.5, z: float = 11.0, yaw: float = 0.6) -> silhouette.Placement:
    return silhouette.place_mesh(
        "hatchback", torch.tensor([x, 1.65, z]), torch.tensor(yaw), torch.tensor([4.0, 1.5, 1.7])
    )


@lru_cache(maxsize=1)
def street() -> SynthFrame:
    return generate_frame(9, 4, "heldout")


def vehicles(frame: SynthFrame, least_px: float = 40.0) -> list[Truth]:
    found = [
        t
        for t in frame.truths
        if t.actor.label in ("Car", "Van") and t.box_xyxy[3] - t.box_xyxy[1] >= least_px and t.visible >= 0.7
    ]
    assert found
    return found


def placed(truth: Truth, shift_m: float = 0.0, turn: float = 0.0) -> silhouette.Placement:
    size = torch.tensor(truth.actor.size_lhw, dtype=torch.float32)
    kind = silhouette.rank_template_kinds(truth.actor.label, size.tolist())[0]
    spot = torch.from_numpy(truth.translation).float() + torch.tensor([shift_m, 0.0, 0.0])
    return silhouette.place_mesh(kind, spot, torch.tensor(truth.yaw + turn), size)


def share(frame: SynthFrame, truth: Truth) -> np.ndarray:
    return np.mean([part == truth.index + 1 for part in blocks(frame.owner)], axis=0)


@pytest.mark.parametrize("placement", [car(), car(-2.5, 4.0, 0.2), car(1.0, 60.0, 1.5)])
def test_the_crop_holds_the_template_and_room_around_it(placement):
    x0, y0, x1, y1 = cutout.crop_rectangle(placement, CAMERA)
    rows, columns = np.nonzero(silhouette.render_silhouettes([placement], CAMERA)[0])
    assert x0 <= columns.min() - 2
    assert columns.max() + 3 <= x1
    assert y0 <= rows.min() - 2
    assert rows.max() + 3 <= y1


def test_a_template_out_of_view_has_no_crop():
    assert cutout.crop_rectangle(car(x=60.0), CAMERA) is None
    assert cutout.crop_rectangle(car(z=-9.0), CAMERA) is None
    nothing = cutout.cut_out(
        np.zeros((200, 480, 3), np.uint8), [car(x=60.0)], [np.zeros((200, 480), bool)], GROUND, CAMERA
    )
    assert nothing[0].visible.size == 0
    assert not nothing[0].full_map("visible", (200, 480)).any()


def test_guides_show_the_template_where_the_photograph_has_it():
    placement = car()
    rect = cutout.crop_rectangle(placement, CAMERA)
    guide_maps = cutout.render_guides(
        [placement], [cutout.crop_camera(CAMERA, rect)], [GROUND], np.zeros((1, 2, *CROP_HW), "f4")
    )
    mask = silhouette.render_silhouettes([placement], CAMERA)[0].astype(np.float32)
    x0, y0, x1, y1 = rect
    inner = np.zeros((y1 - y0, x1 - x0), np.float32)
    top, left = max(y0, 0), max(x0, 0)
    part = mask[top : min(y1, 200), left : min(x1, 480)]
    inner[top - y0 : top - y0 + part.shape[0], left - x0 : left - x0 + part.shape[1]] = part
    there = cv2.resize(inner, CROP_HW[::-1], interpolation=cv2.INTER_LINEAR) >= 0.5
    assert silhouette.mask_iou(guide_maps[0, 0].numpy() >= 0.5, there) > 0.96
    spots = guide_maps[0, 1:4].permute(1, 2, 0).numpy()
    assert (np.abs(spots[there & (guide_maps[0, 0].numpy() > 0.99)]) <= 2.0001).all()
    assert not spots[guide_maps[0, 0].numpy() == 0].any()


def test_nearness_is_that_of_the_ground_around_the_footprint():
    placement, ground = car(), torch.tensor([0.01, -0.9997, 0.02, 1.6])
    camera = cutout.crop_camera(CAMERA, cutout.crop_rectangle(placement, CAMERA))
    guide_maps = cutout.render_guides([placement], [camera], [ground], np.zeros((1, 2, *CROP_HW), "f4"))
    view = shadow.view_ground(placement, ground, camera)
    wanted = np.full(CROP_HW, -1.0)
    wanted[view.window] = np.clip(-view.distance / 2, -1, 1)
    assert np.abs(guide_maps[0, 4].numpy() - wanted).max() < 1e-4


def test_what_lies_inside_a_rectangle_of_a_crop():
    inside = cutout.inside_mask((-80, 10, 80, 106), (0, 0, 480, 58))
    assert inside.shape == CROP_HW
    assert inside.sum() == 80 * 48
    assert inside[0, 80] == 1
    assert inside[0, 79] == 0


def test_disturbed_templates_lead_to_the_vehicles_of_a_generated_street():
    frame = street()
    nothing = np.zeros(frame.depth_m.shape, bool)
    scores, before = [], []
    for truth in vehicles(frame):
        placement = placed(truth, 0.15, 0.06)
        seen = cutout.clean_cutout(
            cutout.cut_out(frame.image, [placement], [nothing], frame.environment.ground, frame.camera)[0]
        )
        mask = share(frame, truth) >= 0.5
        scores.append(silhouette.mask_iou(seen.full_map("visible", mask.shape) >= 0.5, mask))
        before.append(silhouette.mask_iou(silhouette.render_silhouettes([placement], frame.camera)[0], mask))
        total = seen.visible + seen.front + seen.shadow
        assert seen.visible.dtype == np.float32
        assert total.min() >= 0
        assert total.max() <= 1 + 1e-5
    assert np.median(scores) > 0.9
    assert np.median(scores) > np.median(before)


def test_cut_outs_do_not_depend_on_other_vehicles():
    frame = street()
    places = [placed(t) for t in vehicles(frame, 25.0)]
    nothing = [np.zeros(frame.depth_m.shape, bool)] * len(places)
    together = cutout.cut_out(frame.image, places, nothing, frame.environment.ground, frame.camera)
    alone = cutout.cut_out(frame.image, places[-1:], nothing[:1], frame.environment.ground, frame.camera)
    assert np.abs(together[-1].visible - alone[0].visible).max() < 1e-4


def test_a_known_mask_gets_shares_of_pixels_along_its_border():
    frame = street()
    nothing = np.zeros(frame.depth_m.shape, bool)
    soft, hard = [], []
    for truth in vehicles(frame):
        wanted = share(frame, truth).astype(np.float32)
        found = cutout.cutout_from_mask(frame.image, wanted >= 0.5, nothing)
        mixed = (wanted > 0) & (wanted < 1)
        soft.append(np.abs(found.full_map("visible", wanted.shape) - wanted)[mixed].mean())
        hard.append(np.abs((wanted >= 0.5) - wanted)[mixed].mean())
        assert silhouette.mask_iou(found.full_map("visible", wanted.shape) >= 0.5, wanted >= 0.5) > 0.95
    assert np.mean(soft) < 0.85 * np.mean(hard)


def blob(visible: np.ndarray, front: np.ndarray | None = None) -> Cutout:
    zero = np.zeros_like(visible, dtype=np.float32)
    return Cutout(3, 5, visible.astype(np.float32), zero if front is None else front.astype(np.float32), zero)


def test_tidy_takes_specks_away_and_fills_holes():
    visible = np.zeros((40, 60))
    visible[5:35, 5:45] = 1
    visible[10:14, 10:14] = 0
    visible[2:4, 54:56] = 1
    front = np.zeros_like(visible)
    front[20:24, 20:24] = 1
    visible[20:24, 20:24] = 0
    front[15:40, 30:33] = 1
    visible[15:40, 30:33] = 0
    found = cutout.clean_cutout(blob(visible, front))
    assert (found.visible[10:14, 10:14] == 1).all()
    assert (found.visible[20:24, 20:24] == 1).all()
    assert not found.front[20:24, 20:24].any()
    assert not found.visible[2:4, 54:56].any()
    assert (found.front[15:40, 30:33] == 1).all()
    assert found.visible[5:35, 5:45].sum() == 30 * 40 - 20 * 3


def test_poles_stand_in_front_and_dark_parts_do_not():
    outline = np.zeros((60, 80), bool)
    outline[10:50, 10:70] = True
    visible, front = outline.astype(float), np.zeros((60, 80))
    front[5:60, 30:34] = 1  # a pole, from above the vehicle to the ground before it
    front[30:50, 44:56] = 1  # a dark part at its lower border
    front[30:60, 60:80] = 1  # a nearer vehicle
    visible[front > 0] = 0
    known = np.zeros_like(outline)
    known[30:60, 60:80] = True
    found = cutout.remove_unlikely_occluders(
        blob(visible, front), *(np.pad(m, ((5, 0), (3, 0))) for m in (outline, known))
    )
    assert (found.front[5:60, 30:34] == 1).all()
    assert (found.visible[30:50, 44:56] == 1).all()
    assert (found.front[30:60, 60:80] == 1).all()
    assert found.visible[30:50, 62:70].max() == 0


def test_notches_that_the_outline_does_not_have_are_filled():
    outline = np.zeros((60, 80), bool)
    outline[10:50, 10:70] = True
    visible = outline.astype(float)
    visible[10:14, 40:43] = 0
    visible[10:50, 60:70] = 0
    nothing = np.zeros((65, 83), bool)
    found = cutout.remove_unlikely_occluders(blob(visible), np.pad(outline, ((5, 0), (3, 0))), nothing)
    assert (found.visible[11:14, 40:43] == 1).all()
    assert not found.visible[20:40, 63:70].any()


def test_only_borders_are_refined():
    visible = np.zeros((80, 120))
    visible[20:60, 30:90] = 1
    wanted = cutout.find_uncertain_pixels(blob(visible))
    assert wanted[20, 50]
    assert not wanted[40, 60]
    assert not wanted[5, 5]
    found = cutout.refine_cutouts(np.full((100, 140, 3), 99, np.uint8), [blob(visible)])[0]
    assert found.visible[40, 60] == 1
    assert found.visible[5, 5] == 0


def test_whole_maps_lie_where_the_rectangle_does():
    part = blob(np.ones((4, 6)))
    full = part.full_map("visible", (20, 30))
    assert full.sum() == 24
    assert full[5:9, 3:9].all()


def test_weights_that_are_damaged_are_named(tmp_path: Path):
    path = tmp_path / "cutout.safetensors"
    path.write_bytes(cutout.WEIGHTS.read_bytes()[:1000])
    with pytest.raises(FormatError, match=r"cutout\.safetensors"):
        cutout.load_network(path)


def test_weights_are_small():
    assert cutout.WEIGHTS.stat().st_size <= 2.5e6


def test_empty_cut_outs_stay_empty():
    nothing = replace(blob(np.zeros((0, 0))), x0=0, y0=0)
    assert cutout.refine_cutouts(np.zeros((10, 10, 3), np.uint8), [nothing])[0].visible.size == 0
