"""Meshes and headings told from one another before there is a mask."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_ir.derender import alignment as stand
from scene_ir.derender import silhouette
from scene_ir.derender.silhouette import LabelBoxes, Placement
from tests.scene_ir.derender.painting import CAMERA, NOTHING, painted

YAW = 0.6


def car(kind: str = "sedan", yaw: float = YAW, size: tuple[float, float, float] = (4.3, 1.5, 1.75)) -> Placement:
    return silhouette.place_mesh(kind, torch.tensor([0.5, 1.65, 9.0]), torch.tensor(yaw), torch.tensor(size))


def view_of(placement: Placement) -> stand.ObjectPhotograph:
    return stand.ObjectPhotograph(painted(placement), NOTHING, CAMERA)


def box_of(placement: Placement) -> LabelBoxes:
    x0, y0, x1, y1 = silhouette.mask_bounds(silhouette.render_silhouettes([placement], CAMERA)[0])
    return LabelBoxes(torch.tensor([[x0 - 0.5, y0 - 0.5, x1 - 0.5, y1 - 0.5]]), torch.ones(1, 4))


def off_deg(placement: Placement) -> float:
    return abs(math.degrees(float(placement.yaw) - YAW))


@pytest.mark.parametrize("turn", [-0.1, -0.06, 0.06, 0.1])
@pytest.mark.parametrize("boxed", [True, False])
def test_a_heading_that_is_off_is_found(turn: float, boxed: bool):
    truth = car()
    start = car(yaw=YAW + turn)
    found, apart = stand.choose_pose([start], box_of(truth) if boxed else None, view_of(truth))
    assert off_deg(found[0]) < 0.6 * math.degrees(abs(turn))
    assert 0 <= apart[0] < 1


def test_a_heading_that_is_right_stays():
    truth = car()
    found, _ = stand.choose_pose([truth], box_of(truth), view_of(truth))
    assert off_deg(found[0]) < 1


@pytest.mark.parametrize("kind", ["sedan", "hatchback", "suv"])
def test_the_template_is_chosen_despite_label_errors(kind: str):
    truth = car(kind)
    options = [car(k, YAW + 0.08, (4.5, 1.45, 1.8)) for k in ("sedan", "hatchback", "suv")]
    found, apart = stand.choose_pose(options, box_of(truth), view_of(truth))
    assert found[int(np.argmin(apart))].mesh.name == f"{kind}-0"
    assert [p.mesh.name for p in found] == ["sedan-0", "hatchback-0", "suv-0"]


def test_what_a_laser_measured_is_not_turned():
    truth = car()
    start = replace(truth, yaw=truth.yaw + 0.1)
    found, _ = stand.choose_pose([start], None, view_of(truth), measured=True)
    assert torch.equal(found[0].yaw, start.yaw)


def test_nothing_to_see_leaves_the_label():
    away = replace(car(), translation=torch.tensor([60.0, 1.65, 9.0]))
    found, apart = stand.choose_pose([away], None, view_of(car()))
    assert torch.equal(found[0].yaw, away.yaw)
    assert apart[0] == 1


def test_what_hardly_shows_keeps_its_heading():
    truth = car()
    start = replace(truth, yaw=truth.yaw + 0.1)
    hidden = NOTHING.copy()
    hidden[:, 225:] = True
    view = replace(view_of(truth), hidden=hidden)
    assert 0 < view.visible_share(truth) < stand.MIN_VISIBLE_SHARE
    assert view_of(truth).visible_share(truth) == 1
    found, _ = stand.choose_pose([start], None, view)
    assert torch.equal(found[0].yaw, start.yaw)


def test_a_pickup_is_the_last_to_be_believed():
    # seen from behind, cars hardly differ
    truth = car("sedan", -math.pi / 2)
    options = [car("sedan", -math.pi / 2), car("pickup", -math.pi / 2)]
    _, apart = stand.choose_pose(options, None, view_of(truth), measured=True)
    bare = silhouette.measure_edge_distances(options, NOTHING, painted(truth), CAMERA)
    assert apart[0] == pytest.approx(bare[0])
    assert apart[1] > bare[1] + 0.03
