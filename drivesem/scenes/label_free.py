"""A photograph without 3D boxes as a frame with them: vehicles found, or labelled in 2D, and placed on the ground.

A detector or a data set's labels say where vehicles are in the picture, `scene_ir.derender.pose` places them. What
comes out is what a reader of 3D boxes gives, so that `scene_ir.derender.derender` takes it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from detectors.base import Predictor, predict
from detectors.boxes import iou_matrix
from detectors.registry import load_detector
from detectors.types import CLASSES, Detections
from drivesem.attack.judging import t_star_of
from drivesem.data.classes import VEHICLES, as_kitti
from drivesem.data.label_table import UNKNOWN_OCCLUSION
from drivesem.data.truth import occlusion_of
from scene_ir.derender.derender import DerenderSettings
from scene_ir.derender.pose import BORDER_PX, Poses, back_project, estimate
from scene_ir.derender.silhouette import FitSettings
from scene_ir.errors import RangeError
from scene_ir.geometry import clip_boxes, ground_footprint, project_boxes
from scene_ir.types import Camera, Frame, Labels

_DETECTOR_FOCAL_PX = 721.0
"""Of the pictures that the detector was trained on: others are resized so that cars are as large."""
_SAME_SCALE = 1.3
"""Up to this ratio of focal lengths they are not."""
_NEAR_PX, _NEAR_SCALE = 100.0, 0.6
"""Boxes of vehicles that are so high in the detector's picture are taken from one so much smaller: the detector
knows few that are nearer, and ends their boxes too early (`python -m tools.bench label-free` has its error)."""
_SAME_IOU = 0.4
"""Boxes in both pictures that overlap so much are one vehicle. So are two that meet the same one in the smaller
picture: they then stand in one place, and one is left out."""
_TWICE_IOU = 0.6
"""Boxes of a car and a truck that overlap more than this are one vehicle."""
VEHICLE_CLASSES = ("Car", "Truck")
_PEOPLE_LHW = {"Pedestrian": (0.8, 1.75, 0.65), "Cyclist": (1.75, 1.75, 0.6)}
"""m, of KITTI's people, about: they only have to hide what is behind them."""

_AFLOAT = (0.8, 0.02)
"""m, and m a metre of distance: what stands higher above or deeper below the ground than this is no vehicle."""
_INSIDE = 0.35
"""Share of the smaller footprint from which on two vehicles cannot both be where they are."""
_NEAR_BORDER = 0.05
"""A detector's box that ends nearer to the image's border than this share of its side is cut by it. Of 260 such
ends in 400 generated frames 183 were within BORDER_PX, and 207 within this; of 3,523 others 7."""
DETECTOR_LOOKS = 2
"""A detector's boxes are not tight: the network looks again at those of what it found."""
FITTING = FitSettings(max_shift_m=0.4, max_turn_rad=0.17, max_stretch=0.12, box=0.0)
"""How far the fit to the outlines may leave the estimate: farther than it may leave a data set's labels, in
heading above all. Outlines hardly tell distances: more shift made those no better. The boxes say nothing of their
own, they are the estimate's."""


LABELLED = replace(FITTING, box=FitSettings().box)
"""The same where a data set says the boxes: these do say something of the outline."""


def settings_for(settings: DerenderSettings) -> DerenderSettings:
    """The settings for poses that were estimated from a detector's boxes."""
    return replace(settings, fitting=FITTING)


@torch.no_grad()
def detect(frame: Frame, detector: Predictor | None = None) -> Detections:
    """What a detector finds from its t* on, the shipped one by default; a vehicle that is both car and truck once.

    Pictures of much longer or shorter focal length than the detector knows are resized for it. Vehicles that are
    very near are looked at again in a smaller picture, which tells where they end.
    """
    detector = detector or load_detector("squeezedet")
    scale = _DETECTOR_FOCAL_PX / float(frame.camera.intrinsics[0, 0])
    if 1 / _SAME_SCALE < scale < _SAME_SCALE:
        scale = 1.0
    found = _seen(frame, detector, scale)
    boxes = found.boxes_xyxy
    vehicle = torch.tensor(
        [detector.classes[int(label)] in VEHICLE_CLASSES for label in found.labels], dtype=torch.bool
    )
    near = vehicle & (scale * (boxes[:, 3] - boxes[:, 1]) >= _NEAR_PX)
    if not near.any():
        return found
    smaller = _seen(frame, detector, _NEAR_SCALE * scale)
    if len(smaller):
        overlap = iou_matrix(boxes, smaller.boxes_xyxy) * (found.labels[:, None] == smaller.labels)
        same = near & (overlap >= _SAME_IOU).any(dim=1)
        boxes[same] = smaller.boxes_xyxy[overlap[same].argmax(dim=1)]
    return found


def _seen(frame: Frame, detector: Predictor, scale: float) -> Detections:
    """What a detector finds in a frame's picture resized by `scale`, in px of the frame."""
    t_star = t_star_of(detector)
    image = frame.photograph[None].float()
    if scale != 1:
        size = [max(round(scale * side), 32) for side in image.shape[2:]]
        image = torch.nn.functional.interpolate(image, size, mode="bilinear", antialias=True, align_corners=False)
    found = predict(detector, image)[0]
    # pixel centres at integers: column j of the resized image is column (j + 1/2) / scale - 1/2
    ratio = torch.tensor([image.shape[3] / frame.camera.width, image.shape[2] / frame.camera.height]).repeat(2)
    boxes = (found.boxes_xyxy + 0.5) / ratio - 0.5
    boxes = clip_boxes(boxes, frame.camera.height, frame.camera.width)
    keep: list[int] = []
    vehicle = [detector.classes[int(label)] in VEHICLE_CLASSES for label in found.labels]
    overlap = iou_matrix(boxes, boxes)
    for i in range(len(found)):  # best first
        sides = boxes[i, 2:] - boxes[i, :2]
        if float(found.scores[i]) < t_star or float(sides.min()) < 2:
            continue
        if not any(vehicle[i] and vehicle[j] and float(overlap[i, j]) > _TWICE_IOU for j in keep):
            keep.append(i)
    return Detections(boxes[keep], found.labels[keep], found.scores[keep])


def label_free(
    frame: Frame, detections: Detections, classes: tuple[str, ...] = CLASSES, ground: Tensor | None = None
) -> Frame:
    """The frame with labels made from a detector's boxes: poses by `scene_ir.derender.pose`, people where they
    stand, occlusion by what is nearer, truncation by the image's border. Vehicles' boxes are their poses'.

    detections: in their order; labels are indices into `classes`, of which all but cars, trucks, pedestrians and
    cyclists are left out. So are vehicles that would float above the ground or stand where a surer one does.
    ground (4,): the road's plane, where it is known. What is hidden is estimated from boxes, so that it is more
    than is really hidden. Raises RangeError for a label beyond `classes` and for boxes without area.
    """
    names = [_class_name(int(label), classes) for label in detections.labels]
    boxes = detections.boxes_xyxy.float()
    mine = torch.tensor([name in VEHICLES for name in names], dtype=torch.bool)
    boxes = torch.where(mine[:, None], _to_border(boxes, frame.camera), boxes)
    placed = _place(frame, boxes, names, detections.scores, ground, DETECTOR_LOOKS)
    vehicles, poses = placed.vehicles, placed.poses
    boxes = boxes.clone()
    boxes[vehicles] = placed.inside[vehicles]
    kept = [i for i, possible in enumerate(placed.possible.tolist()) if possible]
    labels = Labels(
        kind=tuple(names[i] for i in kept),
        boxes_xyxy=boxes[kept],
        truncation=_truncation(placed.full[kept], placed.inside[kept]),
        occlusion=_occlusion(boxes[kept], placed.translation[kept, 2]),
        translation=placed.translation[kept],
        yaw=placed.yaw[kept],
        size_lhw=placed.size_lhw[kept],
        ignore_xyxy=torch.zeros(0, 4),
    )
    row = {i: n for n, i in enumerate(vehicles)}
    told = {"labels": "estimated"}
    for n, i in enumerate(kept):
        if i in row:
            told[f"labels[{n}].score"] = f"{float(detections.scores[i]):.3f}"
            told[f"labels[{n}].depth_sigma"] = f"{float(poses.log_depth_sigma[row[i]]):.3f}"
            told[f"labels[{n}].facing"] = f"{float(poses.facing[row[i]]):.3f}"
    return replace(frame, labels=labels, provenance={**frame.provenance, **told})


def has_places(labels: Labels) -> bool:
    """Whether a data set says where any of the vehicles stands."""
    return any(math.isfinite(float(z)) for z in labels.translation[:, 2])


def placed_by_boxes(frame: Frame) -> Frame:
    """The frame with the places of vehicles and people estimated from the 2D boxes of its labels, which stay as
    they are, with masks; types are KITTI's. Occlusion and truncation are estimated where the labels do not say.

    A vehicle that would float above the ground, or stand where a larger one does, has no place: it stays in the
    picture, and is neither missed nor a hit.
    """
    assert frame.labels is not None
    labels = as_kitti(frame.labels)
    boxes = labels.boxes_xyxy.float()
    flat = (boxes[:, 2:] <= boxes[:, :2]).any(1).tolist()
    names = ["" if thin else name for name, thin in zip(labels.kind, flat, strict=True)]
    # nearer vehicles, which are higher in the picture, are surer
    placed = _place(frame, boxes, names, boxes[:, 3] - boxes[:, 1], None, looks=1)
    gone = ~placed.possible
    depth = torch.where(gone, math.inf, placed.translation[:, 2])
    unknown = labels.occlusion == UNKNOWN_OCCLUSION
    told = torch.isfinite(labels.truncation)
    estimated = _truncation(placed.full, placed.inside)
    labels = replace(
        labels,
        translation=placed.translation.masked_fill(gone[:, None], math.nan),
        yaw=placed.yaw.masked_fill(gone, math.nan),
        size_lhw=placed.size_lhw.masked_fill(gone[:, None], math.nan),
        occlusion=torch.where(unknown & ~gone, _occlusion(boxes, depth), labels.occlusion),
        truncation=torch.where(~told & ~gone, estimated, labels.truncation),
    )
    return replace(frame, labels=labels, provenance={**frame.provenance, "places": "estimated"})


@dataclass(frozen=True, slots=True)
class _Placed:
    """N boxes and what stands in them. vehicles: their places among the boxes, one a row of poses. translation
    (N, 3) m, yaw (N,) rad, size_lhw (N, 3) m: NaN for what is neither vehicle nor person; full, inside (N, 4) px:
    around the 3D box, and as much of that as the image has. possible (N,): stands on the ground, and shows.
    """

    vehicles: list[int]
    poses: Poses
    translation: Tensor
    yaw: Tensor
    size_lhw: Tensor
    full: Tensor
    inside: Tensor
    possible: Tensor


def _place(
    frame: Frame, boxes: Tensor, names: Sequence[str], scores: Tensor, ground: Tensor | None, looks: int
) -> _Placed:
    """names: KITTI's types; scores (N,): of two vehicles in one place the higher stays."""
    vehicles = [i for i, name in enumerate(names) if name in VEHICLES]
    people = [i for i, name in enumerate(names) if name in _PEOPLE_LHW]
    kinds = [names[i] for i in vehicles]
    poses = estimate(frame.photograph, boxes[vehicles], kinds, frame.camera, ground, looks=looks)
    places = _people(boxes[people], [names[i] for i in people], frame.camera, poses)
    translation, yaw, size = (torch.full((len(names), *s), math.nan) for s in ((3,), (), (3,)))
    translation[vehicles], yaw[vehicles], size[vehicles] = poses.translation, poses.yaw, poses.size_lhw
    if people:
        translation[people], size[people] = places, torch.tensor([_PEOPLE_LHW[names[i]] for i in people])
        yaw[people] = 0.0
    full = project_boxes(size, yaw, translation, frame.camera.matrix.float())
    inside = clip_boxes(full, frame.camera.height, frame.camera.width)
    seen = torch.isfinite(full).all(1) & (inside[:, 2:] - inside[:, :2] >= 1).all(1)
    seen[vehicles] &= _possible(poses, scores[vehicles])
    return _Placed(vehicles, poses, translation, yaw, size, full, inside, seen)


def _to_border(boxes: Tensor, camera: Camera) -> Tensor:
    """Boxes (N, 4) px whose sides near the image's border lie on it."""
    near = (_NEAR_BORDER * (boxes[:, 2:] - boxes[:, :2])).clamp_min(BORDER_PX)
    low, high = boxes[:, :2], boxes[:, 2:]
    end = boxes.new_tensor([camera.width - 1, camera.height - 1])
    return torch.cat([torch.where(low <= near, 0.0, low), torch.where(high >= end - near, end, high)], dim=1)


def _class_name(label: int, classes: tuple[str, ...]) -> str:
    if not 0 <= label < len(classes):
        raise RangeError("detections.labels", f"0 to {len(classes) - 1}", label)
    return classes[label]


def _people(boxes: Tensor, kinds: list[str], camera: Camera, poses: Poses) -> Tensor:
    """Where people (N, 3) m stand: their boxes' bottoms on the ground, or as far away as they are small."""
    if not kinds:
        return torch.zeros(0, 3)
    foot = torch.stack([(boxes[:, 0] + boxes[:, 2]) / 2, boxes[:, 3]], 1)
    height = boxes.new_tensor([_PEOPLE_LHW[kind][1] for kind in kinds])
    small = back_project(foot, camera.intrinsics[1, 1] * height / (boxes[:, 3] - boxes[:, 1]), camera)
    scale = -poses.ground[3] / (small @ poses.ground[:3])
    believable = (scale > 0.6) & (scale < 1.6) & (boxes[:, 3] < camera.height - 1 - BORDER_PX)
    return small * torch.where(believable, scale, torch.ones(()))[:, None]


def _possible(poses: Poses, scores: Tensor) -> Tensor:
    """Which vehicles (N,) can stand where they are: on the ground, and not inside one of a higher score."""
    above = (poses.translation @ poses.ground[:3] + poses.ground[3]).abs()
    possible = above <= _AFLOAT[0] + _AFLOAT[1] * poses.translation[:, 2]
    feet = ground_footprint(poses.size_lhw, poses.yaw, poses.translation).numpy()
    order = [int(i) for i in scores.argsort(descending=True, stable=True) if bool(possible[i])]
    kept: list[int] = []
    for i in order:
        smaller = [min(cv2.contourArea(feet[i]), cv2.contourArea(feet[j])) for j in kept]
        shared = [cv2.intersectConvexConvex(feet[i], feet[j])[0] for j in kept]
        if all(s < _INSIDE * area for s, area in zip(shared, smaller, strict=True)):
            kept.append(i)
        else:
            possible[i] = False
    return possible


def _truncation(full: Tensor, inside: Tensor) -> Tensor:
    """Share (N,) of each box in the image's plane that the border cuts off."""
    area, whole = ((b[:, 2:] - b[:, :2]).prod(1) for b in (inside, full))
    return (1 - area / whole.clamp(min=1e-6)).clamp(0, 1)


def _occlusion(boxes: Tensor, depth: Tensor) -> Tensor:
    """KITTI's code (N,) of what boxes of nearer things cover."""
    codes = []
    for i, (x0, y0, x1, y1) in enumerate(boxes.tolist()):
        columns, rows = np.linspace(x0, x1, 64), np.linspace(y0, y1, 64)
        hidden = np.zeros((64, 64), bool)
        for j, (left, top, right, bottom) in enumerate(boxes.tolist()):
            if float(depth[j]) < float(depth[i]):
                hidden |= np.outer((rows >= top) & (rows <= bottom), (columns >= left) & (columns <= right))
        codes.append(occlusion_of(1 - float(hidden.mean())))
    return torch.tensor(codes, dtype=torch.int64)
