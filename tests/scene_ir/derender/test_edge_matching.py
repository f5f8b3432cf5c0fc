"""Edges of meshes against edges of pictures."""

import math

import numpy as np
import pytest
import torch

from scene_ir.derender import silhouette
from scene_ir.derender import silhouette as borders
from scene_ir.derender.silhouette import FitEvidence, FitSettings, LabelBoxes, Placement
from scene_ir.geometry import to_clip
from tests.scene_ir.derender.painting import CAMERA, NOTHING, drawn, painted

NO_BOXES = LabelBoxes(torch.zeros(1, 4), torch.zeros(1, 4))


def car(yaw: float = 0.6, kind: str = "hatchback", x: float = 0.5) -> Placement:
    return silhouette.place_mesh(
        kind, torch.tensor([x, 1.65, 9.0]), torch.tensor(yaw), torch.tensor([4.0, 1.5, 1.7])
    )


def followed(placement: Placement, known: np.ndarray) -> tuple[borders.VisibleContour, torch.Tensor]:
    hits, clip = drawn(placement)
    face, depth = (values.reshape(200, 480) for values in (hits.face.long(), hits.depth))
    return borders.trace_contour(face, depth, clip, placement.mesh.faces, placement.mesh.part, known), clip


def distance(field: torch.Tensor, contour: borders.VisibleContour, clip: torch.Tensor) -> torch.Tensor:
    return borders.EdgeSamples.from_contours([field], [contour], [len(clip)]).distances(clip)[0]


def test_edges_of_a_square_pull_by_direction():
    picture = np.full((60, 80, 3), 40, np.uint8)
    picture[20:40, 30:50] = 200
    field = borders.compute_edge_field(picture, np.zeros((60, 80), bool))
    assert field.shape == (4, 60, 80)
    assert float(field.min()) == 0
    assert float(field.max()) == 1
    upright, level = field[0, 30], field[2, :, 40]
    assert int(upright.argmin()) in (29, 30, 49, 50)
    assert int(level.argmin()) in (19, 20, 39, 40)
    assert float(field[0, 20, 40]) == 1
    assert float(upright[33]) == pytest.approx(3.5 / borders.REACH_PX, abs=1.1 / borders.REACH_PX)


def test_edges_of_what_is_unknown_do_not_pull():
    picture = np.full((60, 80, 3), 40, np.uint8)
    picture[20:40, 30:50] = 200
    assert float(borders.compute_edge_field(picture, np.ones((60, 80), bool)).min()) == 1


def test_followed_points_lie_where_parts_meet():
    placement = car()
    found, clip = followed(placement, ~NOTHING)
    assert len(found.channel) > 200
    assert torch.allclose(found.weight.sum(1), torch.ones(()), atol=1e-4)
    point = (clip[found.vertex] * found.weight[..., None]).sum(1)
    pixel = (point[:, :2] / point[:, 2:] + found.offset).numpy()
    face = drawn(placement)[0].face.reshape(200, 480).long()
    part = np.where(face.numpy() >= 0, placement.mesh.part[face.clamp(min=0)].numpy(), -1)
    x, y = pixel.T
    # a border lies half-way between two pixels of different parts
    first = part[np.floor(y + 0.01).astype(int), np.floor(x + 0.01).astype(int)]
    second = part[np.ceil(y - 0.01).astype(int), np.ceil(x - 0.01).astype(int)]
    assert np.mean(first != second) > 0.99


def test_what_is_hidden_is_not_followed():
    known = ~NOTHING
    known[:, 240:] = False
    found, clip = followed(car(), known)
    point = (clip[found.vertex] * found.weight[..., None]).sum(1)
    assert len(found.channel) > 20
    assert float((point[:, 0] / point[:, 2]).max()) < 240.5
    nothing, clip = followed(car(), NOTHING)
    assert len(nothing.channel) == 0
    assert distance(torch.ones(4, 200, 480), nothing, clip) == 0


def test_the_right_pose_is_nearest_and_the_slope_leads_to_it():
    field = borders.compute_edge_field(painted(car()), NOTHING)
    distances = {}
    for turn in (-0.1, -0.05, 0.0, 0.05, 0.1):
        found, clip = followed(car(0.6 + turn), ~NOTHING)
        distances[turn] = float(distance(field, found, clip))
    assert min(distances, key=lambda turn: distances[turn]) == 0.0
    assert distances[0.0] < 0.25
    placement = car()
    shift = torch.tensor(0.03, requires_grad=True)
    found, _ = followed(car(x=0.53), ~NOTHING)
    moved = placement.vertices() + shift * torch.tensor([1.0, 0.0, 0.0])
    distance(field, found, to_clip(moved, CAMERA.matrix)).backward()
    assert shift.grad is not None
    assert float(shift.grad) > 0


def test_several_contours_are_sampled_as_by_torch():
    generator = torch.Generator().manual_seed(1)
    fields = [torch.rand(4, *hw, generator=generator) for hw in ((20, 30), (12, 9))]
    clip = torch.rand(10, 3, generator=generator) * torch.tensor([40.0, 30.0, 0.5]) + torch.tensor([-4, -4, 0.8])
    clip.requires_grad_(True)
    contours = [
        borders.VisibleContour(
            torch.randint(0, 5, (50, 3), generator=generator),
            torch.rand(50, 3, generator=generator),
            torch.rand(50, 2, generator=generator),
            torch.randint(0, 4, (50,), generator=generator),
        )
        for _ in fields
    ]
    found = borders.EdgeSamples.from_contours(fields, contours, [5, 5]).distances(clip)
    wanted = []
    for field, contour, own in zip(fields, contours, (clip[:5], clip[5:]), strict=True):
        point = (own[contour.vertex] * contour.weight[..., None]).sum(1)
        pixel = point[:, :2] / point[:, 2:].clamp(min=0.05) + contour.offset
        grid = (2 * pixel + 1) / torch.tensor([field.shape[2], field.shape[1]]) - 1
        sampled = torch.nn.functional.grid_sample(
            field[None], grid[None, None], padding_mode="border", align_corners=False
        )[0, :, 0]
        wanted.append(sampled.gather(0, contour.channel[None]).mean())
    torch.testing.assert_close(found, torch.stack(wanted))
    weights = torch.tensor([1.0, 2.0])
    slopes = [
        torch.autograd.grad((one * weights).sum(), clip, retain_graph=True)[0]
        for one in (found, torch.stack(wanted))
    ]
    torch.testing.assert_close(*slopes, atol=1e-4, rtol=1e-3)


def test_edges_find_the_yaw_that_the_outline_leaves_open():
    truth, start = car(0.6), car(0.67)
    picture = painted(truth)
    mask = silhouette.render_silhouettes([truth], CAMERA)[0]
    # a mask whose border says nothing within 2 px of the outline, as those of photographs
    ragged = silhouette.grow_mask(mask, 2) & ~(
        silhouette.grow_mask(mask, 2) & (np.indices(mask.shape).sum(0) % 7 < 3) & ~mask
    )
    turn = {}
    for name, evidence in (("outline", None), ("edges", FitEvidence(picture))):
        fitted = silhouette.fit_silhouettes(
            [start], [ragged], [NOTHING], NO_BOXES, CAMERA, FitSettings(), evidence=evidence
        )[0]
        turn[name] = abs(math.degrees(float(fitted.yaw) - 0.6))
    assert turn["edges"] < 1.5
    assert turn["edges"] < turn["outline"]


def test_a_picture_distinguishes_templates():
    for kind in ("sedan", "hatchback", "suv"):
        options = [car(kind=k) for k in ("sedan", "hatchback", "suv")]
        distances = silhouette.measure_edge_distances(options, NOTHING, painted(car(kind=kind)), CAMERA)
        assert options[int(np.argmin(distances))].mesh.name == f"{kind}-0"


def test_a_car_out_of_sight_is_nowhere_near():
    assert silhouette.measure_edge_distances([car(x=80.0)], NOTHING, painted(car()), CAMERA) == [1.0]


def test_what_a_laser_measured_hardly_moves():
    truth, start = car(0.6), car(0.67)
    mask = silhouette.render_silhouettes([truth], CAMERA)[0]
    evidence = FitEvidence(painted(truth), [True])
    fitted = silhouette.fit_silhouettes(
        [start], [mask], [NOTHING], NO_BOXES, CAMERA, FitSettings(), evidence=evidence
    )[0]
    assert abs(float(fitted.yaw - start.yaw)) <= 0.25 * FitSettings().max_turn_rad + 1e-5
