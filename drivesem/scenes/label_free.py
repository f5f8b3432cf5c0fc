"""3D labels for photographs without them, from detections or 2D labels.

`scene_ir.derender.pose` estimates the poses of vehicles from their boxes. The result has the form of a frame with 3D
labels, the input of `scene_ir.derender.derender`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from detectors.base import Predictor, predict
from detectors.boxes import iou_matrix
from detectors.registry import load_detector
from detectors.types import CLASSES, Detections
from drivesem.attacks.targets import resolve_t_star
from drivesem.data.classes import VEHICLES, rename_to_types
from drivesem.data.ground_truth import occlusion_from_visible
from drivesem.data.label_table import UNKNOWN_OCCLUSION
from scene_ir.derender import ego
from scene_ir.derender.derender import DerenderSettings
from scene_ir.derender.people import join_riders
from scene_ir.derender.pose import BORDER_PX, VehiclePoses, back_project, estimate_poses
from scene_ir.derender.silhouette import FitSettings
from scene_ir.errors import RangeError
from scene_ir.geometry import clip_boxes, ground_footprint, project_boxes
from scene_ir.types import Camera, Frame, Labels

_DETECTOR_FOCAL_PX = 721.0
"""Focal length of the detector's training images; others are resized to it."""
_SAME_SCALE = 1.3
"""Ratio of focal lengths up to which images are not resized."""
_NEAR_PX, _NEAR_SCALE = 100.0, 0.6
"""Height from which boxes of vehicles come from an image scaled by the second value: the detector's boxes of very
near vehicles are too small (`python -m tools.bench label-free` measures the error)."""
_SAME_IOU = 0.4
"""IoU from which boxes in both images are one vehicle. Two boxes with the same match in the smaller image are also
one vehicle: they get the same pose, and one is dropped."""
_TWICE_IOU = 0.6
"""IoU above which boxes of a car and a truck are one vehicle."""
VEHICLE_CLASSES = ("Car", "Truck")
_PEOPLE_LHW = {"Pedestrian": (0.8, 1.75, 0.65), "Cyclist": (1.75, 1.75, 0.6)}
"""Typical sizes of KITTI's people, m; they serve as occluders only."""
_AFLOAT = (0.8, 0.02)
"""Allowed distance of a vehicle from the ground: m, plus m per metre of depth."""
_INSIDE = 0.35
"""Shared fraction of the smaller footprint from which two vehicles contradict each other."""
_NEAR_BORDER = 0.05
"""Distance from the image's border, as a share of the box's side, within which a detected box is truncated. Of 260
truncated sides in 400 generated frames, 183 were within BORDER_PX and 207 within this; of 3,523 others, 7."""
POSE_ROUNDS = 2
"""Rounds of pose estimation for detected boxes, which are not tight."""
FIT_TO_DETECTIONS = FitSettings(max_shift_m=0.4, max_turn_rad=0.17, max_stretch=0.12, box=0.0)
"""Limits of the outline fit around an estimate: wider than around labels, above all in heading. Outlines hardly
determine distance; more shift did not improve it. The boxes carry no evidence: they are the estimate's own."""
FIT_TO_LABELS = replace(FIT_TO_DETECTIONS, box=FitSettings().box)
"""The same for labelled boxes, which are evidence of the outline."""


def detection_fit_settings(settings: DerenderSettings) -> DerenderSettings:
    """Adapt settings to poses that were estimated from a detector's boxes."""
    return replace(settings, fitting=FIT_TO_DETECTIONS)


@torch.no_grad()
def detect(frame: Frame, detector: Predictor | None = None) -> Detections:
    """Detect objects with scores of at least t*, by default with the shipped detector.

    A vehicle that is detected as both car and truck is returned once. Photographs with other focal lengths than the
    training images' are resized. The boxes of very near vehicles come from a smaller image.
    """
    detector = detector or load_detector("squeezedet")
    scale = _DETECTOR_FOCAL_PX / float(frame.camera.intrinsics[0, 0])
    if 1 / _SAME_SCALE < scale < _SAME_SCALE:
        scale = 1.0
    detections = _detect_at_scale(frame, detector, scale)
    boxes = detections.boxes_xyxy
    vehicle = torch.tensor(
        [detector.classes[int(label)] in VEHICLE_CLASSES for label in detections.labels], dtype=torch.bool
    )
    near = vehicle & (scale * (boxes[:, 3] - boxes[:, 1]) >= _NEAR_PX)
    if not near.any():
        return detections
    smaller = _detect_at_scale(frame, detector, _NEAR_SCALE * scale)
    if len(smaller):
        overlap = iou_matrix(boxes, smaller.boxes_xyxy) * (detections.labels[:, None] == smaller.labels)
        same = near & (overlap >= _SAME_IOU).any(dim=1)
        boxes[same] = smaller.boxes_xyxy[overlap[same].argmax(dim=1)]
    return detections


def _detect_at_scale(frame: Frame, detector: Predictor, scale: float) -> Detections:
    """Detect objects in a photograph resized by `scale`; boxes in px of the frame."""
    t_star = resolve_t_star(detector)
    image = frame.photograph[None].float()
    if scale != 1:
        size = [max(round(scale * side), 32) for side in image.shape[2:]]
        image = torch.nn.functional.interpolate(image, size, mode="bilinear", antialias=True, align_corners=False)
    detections = predict(detector, image)[0]
    # pixel centres at integers: column j of the resized image is column (j + 1/2) / scale - 1/2
    ratio = torch.tensor([image.shape[3] / frame.camera.width, image.shape[2] / frame.camera.height]).repeat(2)
    boxes = (detections.boxes_xyxy + 0.5) / ratio - 0.5
    boxes = clip_boxes(boxes, frame.camera.height, frame.camera.width)
    selected: list[int] = []
    vehicle = [detector.classes[int(label)] in VEHICLE_CLASSES for label in detections.labels]
    overlap = iou_matrix(boxes, boxes)
    for i in range(len(detections)):  # best first
        sides = boxes[i, 2:] - boxes[i, :2]
        if float(detections.scores[i]) < t_star or float(sides.min()) < 2:
            continue
        if not any(vehicle[i] and vehicle[j] and float(overlap[i, j]) > _TWICE_IOU for j in selected):
            selected.append(i)
    return Detections(boxes[selected], detections.labels[selected], detections.scores[selected])


def label_from_detections(
    frame: Frame, detections: Detections, classes: tuple[str, ...] = CLASSES, ground: Tensor | None = None
) -> Frame:
    """Label a frame with the 3D boxes of detections.

    Poses come from `scene_ir.derender.pose`; vehicles' boxes are the projections of their poses. Occlusion is
    estimated from nearer boxes, so it is an upper bound; truncation from the image's border. Other objects than
    cars, trucks, pedestrians and cyclists are dropped, and so are vehicles off the ground or in the place of one
    with a higher score, and boxes of which the ego vehicle fills more than half.

    Args:
        frame: Photograph and camera.
        detections: Detections; labels are indices into `classes`.
        classes: Names of the classes.
        ground: Plane of the road (4,), if known.

    Returns:
        The frame with labels, in the order of the detections.

    Raises:
        RangeError: A label beyond `classes`, or a box without area.
    """
    names = [_class_name(int(label), classes) for label in detections.labels]
    image = np.ascontiguousarray(frame.photograph.detach().cpu().float().numpy().transpose(1, 2, 0))
    outside = ego.boxes_outside(ego.find_ego_vehicle(image), detections.boxes_xyxy)
    names, scores = [names[i] for i in outside], detections.scores[outside]
    boxes = detections.boxes_xyxy[outside].float()
    is_vehicle = torch.tensor([name in VEHICLES for name in names], dtype=torch.bool)
    boxes = torch.where(is_vehicle[:, None], _snap_to_border(boxes, frame.camera), boxes)
    placed = _place_objects(frame, boxes, names, scores, ground, POSE_ROUNDS)
    vehicles, poses = placed.vehicles, placed.poses
    boxes = boxes.clone()
    boxes[vehicles] = placed.inside[vehicles]
    selected = [i for i, possible in enumerate(placed.possible.tolist()) if possible]
    labels = Labels(
        kind=tuple(names[i] for i in selected),
        boxes_xyxy=boxes[selected],
        truncation=_estimate_truncation(placed.full[selected], placed.inside[selected]),
        occlusion=_estimate_occlusion(boxes[selected], placed.translation[selected, 2]),
        translation=placed.translation[selected],
        yaw=placed.yaw[selected],
        size_lhw=placed.size_lhw[selected],
        ignore_xyxy=torch.zeros(0, 4),
    )
    row = {i: n for n, i in enumerate(vehicles)}
    provenance = {"labels": "estimated"} | _record_uncertainty(
        poses, {row[i]: n for n, i in enumerate(selected) if i in row}
    )
    for n, i in enumerate(selected):
        if i in row:
            provenance[f"labels[{n}].score"] = f"{float(scores[i]):.3f}"
    return replace(frame, labels=labels, provenance={**frame.provenance, **provenance})


def has_poses(labels: Labels) -> bool:
    """Whether labels have the position of at least one object."""
    return any(math.isfinite(float(z)) for z in labels.translation[:, 2])


def estimate_label_poses(frame: Frame) -> Frame:
    """Estimate the poses of vehicles and people from the 2D boxes of a frame's labels.

    Boxes and masks stay; types become KITTI's. Unknown occlusion and truncation are estimated. A vehicle off the
    ground, or in the place of a larger one, gets no pose: it stays in the photograph and is ignored.
    """
    assert frame.labels is not None
    labels = rename_to_types(frame.labels, {})
    boxes = labels.boxes_xyxy.float()
    whole, _ = join_riders(labels)
    flat = (boxes[:, 2:] <= boxes[:, :2]).any(1).tolist()
    names = ["" if thin else name for name, thin in zip(labels.kind, flat, strict=True)]
    # poses of nearer vehicles, which have higher boxes, are more reliable
    placed = _place_objects(frame, whole.float(), names, boxes[:, 3] - boxes[:, 1], None, rounds=1)
    dropped = ~placed.possible
    depth = torch.where(dropped, math.inf, placed.translation[:, 2])
    unknown = labels.occlusion == UNKNOWN_OCCLUSION
    known = torch.isfinite(labels.truncation)
    estimated = _estimate_truncation(placed.full, placed.inside)
    labels = replace(
        labels,
        translation=placed.translation.masked_fill(dropped[:, None], math.nan),
        yaw=placed.yaw.masked_fill(dropped, math.nan),
        size_lhw=placed.size_lhw.masked_fill(dropped[:, None], math.nan),
        occlusion=torch.where(unknown & ~dropped, _estimate_occlusion(boxes, depth), labels.occlusion),
        truncation=torch.where(~known & ~dropped, estimated, labels.truncation),
    )
    uncertainty = _record_uncertainty(placed.poses, dict(enumerate(placed.vehicles)))
    provenance = {**frame.provenance, "places": "estimated", **uncertainty}
    return replace(frame, labels=labels, provenance=provenance)


def _record_uncertainty(poses: VehiclePoses, rows: Mapping[int, int]) -> dict[str, str]:
    """Provenance of the uncertainty of poses, by their labels. rows: label of each pose."""
    provenance = {}
    for pose, label in rows.items():
        provenance[f"labels[{label}].depth_sigma"] = f"{float(poses.log_depth_sigma[pose]):.3f}"
        provenance[f"labels[{label}].facing"] = f"{float(poses.facing[pose]):.3f}"
    return provenance


@dataclass(frozen=True, slots=True)
class _PlacedObjects:
    """Poses of the objects in N boxes; NaN for objects that are neither vehicles nor people."""

    vehicles: list[int]
    """Indices of the vehicles."""
    poses: VehiclePoses
    """Estimated poses, one for each vehicle."""
    translation: Tensor
    """Bottom-face centres (N, 3) m."""
    yaw: Tensor
    """Yaw (N,) rad."""
    size_lhw: Tensor
    """Length, height, width (N, 3) m."""
    full: Tensor
    """Boxes (N, 4) px around the projected 3D boxes."""
    inside: Tensor
    """The same, clipped to the image."""
    possible: Tensor
    """Whether an object stands on the ground and is visible (N,)."""


def _place_objects(
    frame: Frame, boxes: Tensor, names: Sequence[str], scores: Tensor, ground: Tensor | None, rounds: int
) -> _PlacedObjects:
    """Estimate poses. `names` are KITTI's types; of two vehicles in one place, the one with the higher score stays."""
    vehicles = [i for i, name in enumerate(names) if name in VEHICLES]
    people = [i for i, name in enumerate(names) if name in _PEOPLE_LHW]
    kinds = [names[i] for i in vehicles]
    poses = estimate_poses(frame.photograph, boxes[vehicles], kinds, frame.camera, ground, rounds=rounds)
    people_positions = _place_people(boxes[people], [names[i] for i in people], frame.camera, poses)
    translation, yaw, size = (torch.full((len(names), *s), math.nan) for s in ((3,), (), (3,)))
    translation[vehicles], yaw[vehicles], size[vehicles] = poses.translation, poses.yaw, poses.size_lhw
    if people:
        translation[people], size[people] = people_positions, torch.tensor([_PEOPLE_LHW[names[i]] for i in people])
        yaw[people] = 0.0
    full = project_boxes(size, yaw, translation, frame.camera.matrix.float())
    inside = clip_boxes(full, frame.camera.height, frame.camera.width)
    visible = torch.isfinite(full).all(1) & (inside[:, 2:] - inside[:, :2] >= 1).all(1)
    visible[vehicles] &= _find_plausible(poses, scores[vehicles])
    return _PlacedObjects(vehicles, poses, translation, yaw, size, full, inside, visible)


def _snap_to_border(boxes: Tensor, camera: Camera) -> Tensor:
    """Move sides of boxes (N, 4) px near the image's border onto it."""
    near = (_NEAR_BORDER * (boxes[:, 2:] - boxes[:, :2])).clamp_min(BORDER_PX)
    low, high = boxes[:, :2], boxes[:, 2:]
    end = boxes.new_tensor([camera.width - 1, camera.height - 1])
    return torch.cat([torch.where(low <= near, 0.0, low), torch.where(high >= end - near, end, high)], dim=1)


def _class_name(label: int, classes: tuple[str, ...]) -> str:
    if not 0 <= label < len(classes):
        raise RangeError("detections.labels", f"0 to {len(classes) - 1}", label)
    return classes[label]


def _place_people(boxes: Tensor, kinds: list[str], camera: Camera, poses: VehiclePoses) -> Tensor:
    """Return positions of people (N, 3) m: on the ground below their boxes, or at the distance of their height."""
    if not kinds:
        return torch.zeros(0, 3)
    foot = torch.stack([(boxes[:, 0] + boxes[:, 2]) / 2, boxes[:, 3]], 1)
    height = boxes.new_tensor([_PEOPLE_LHW[kind][1] for kind in kinds])
    by_height = back_project(foot, camera.intrinsics[1, 1] * height / (boxes[:, 3] - boxes[:, 1]), camera)
    scale = -poses.ground[3] / (by_height @ poses.ground[:3])
    plausible = (scale > 0.6) & (scale < 1.6) & (boxes[:, 3] < camera.height - 1 - BORDER_PX)
    return by_height * torch.where(plausible, scale, torch.ones(()))[:, None]


def _find_plausible(poses: VehiclePoses, scores: Tensor) -> Tensor:
    """Return which vehicles (N,) stand on the ground and not inside one with a higher score."""
    above = (poses.translation @ poses.ground[:3] + poses.ground[3]).abs()
    possible = above <= _AFLOAT[0] + _AFLOAT[1] * poses.translation[:, 2]
    feet = ground_footprint(poses.size_lhw, poses.yaw, poses.translation).numpy()
    order = [int(i) for i in scores.argsort(descending=True, stable=True) if bool(possible[i])]
    selected: list[int] = []
    for i in order:
        smaller = [min(cv2.contourArea(feet[i]), cv2.contourArea(feet[j])) for j in selected]
        shared = [cv2.intersectConvexConvex(feet[i], feet[j])[0] for j in selected]
        if all(s < _INSIDE * area for s, area in zip(shared, smaller, strict=True)):
            selected.append(i)
        else:
            possible[i] = False
    return possible


def _estimate_truncation(full: Tensor, inside: Tensor) -> Tensor:
    """Return the share (N,) of each box outside the image."""
    area, whole = ((b[:, 2:] - b[:, :2]).prod(1) for b in (inside, full))
    return (1 - area / whole.clamp(min=1e-6)).clamp(0, 1)


def _estimate_occlusion(boxes: Tensor, depth: Tensor) -> Tensor:
    """Return KITTI's codes (N,) of the share covered by boxes of nearer objects."""
    codes = []
    for i, (x0, y0, x1, y1) in enumerate(boxes.tolist()):
        columns, rows = np.linspace(x0, x1, 64), np.linspace(y0, y1, 64)
        hidden = np.zeros((64, 64), bool)
        for j, (left, top, right, bottom) in enumerate(boxes.tolist()):
            if float(depth[j]) < float(depth[i]):
                hidden |= np.outer((rows >= top) & (rows <= bottom), (columns >= left) & (columns <= right))
        codes.append(occlusion_from_visible(1 - float(hidden.mean())))
    return torch.tensor(codes, dtype=torch.int64)
