"""A plain photograph as a frame with labels that nobody wrote: vehicles found, and placed on the ground.

The shipped detector finds vehicles, `scene_ir.derender.pose` places them. What comes out is what a data set's
reader gives, so that `scene_ir.derender.derender` takes it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from detectors.base import Detector
from detectors.boxes import iou_matrix
from detectors.registry import load_detector
from detectors.types import CLASSES, Detections
from drivesem.data.frames import pinhole
from drivesem.data.truth import occlusion_of
from scene_ir import files
from scene_ir.derender.derender import DerenderSettings
from scene_ir.derender.pose import BORDER_PX, Poses, back_project, estimate
from scene_ir.derender.silhouette import FitSettings
from scene_ir.errors import RangeError
from scene_ir.geometry import clip_boxes, ground_footprint, project_boxes
from scene_ir.io import to_tensor
from scene_ir.types import Camera, Frame, Labels

DEFAULT_FOCAL = 0.58
"""Focal length in image widths where nothing tells it: KITTI's 721 px of 1242, a view 81 degrees wide."""
FILM_MM = 36.0
"""Width of the film that EXIF's "focal length in 35 mm film" speaks of; its longer side."""
_EXIF, _FOCAL, _FOCAL_35 = 0x8769, 0x920A, 0xA405
_PLANE_X, _PLANE_Y, _PLANE_UNIT, _ORIENTATION = 0xA20E, 0xA20F, 0xA210, 0x0112
"""Tags of EXIF 2.32: its own directory, focal length in mm and in 35 mm film, pixels a unit on the sensor."""
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0}
_TURNED = {1: 0, 3: 2, 6: 3, 8: 1}
"""EXIF's orientations without mirroring, and quarter turns to the left that put them upright."""
_DETECTOR_FOCAL_PX = 721.0
"""Of the pictures that the detector was trained on: others are resized so that cars are as large."""
_SAME_SCALE = 1.3
"""Up to this ratio of focal lengths they are not."""
_TWICE_IOU = 0.6
"""Boxes of a car and a truck that overlap more than this are one vehicle."""
VEHICLE_CLASSES = ("Car", "Truck")
_PEOPLE_LHW = {"Pedestrian": (0.8, 1.75, 0.65), "Cyclist": (1.75, 1.75, 0.6)}
"""m, of KITTI's people, about: they only have to hide what is behind them."""

_AFLOAT = (0.8, 0.02)
"""m, and m a metre of distance: what stands higher above or deeper below the ground than this is no vehicle."""
_INSIDE = 0.35
"""Share of the smaller footprint from which on two vehicles cannot both be where they are."""
DETECTOR_LOOKS = 2
"""A detector's boxes are not tight: the network looks again at those of what it found."""
FITTING = FitSettings(max_shift_m=0.4, max_turn_rad=0.17, max_stretch=0.12, box=0.0)
"""How far the fit to the outlines may leave the estimate: farther than it may leave a data set's labels, in
heading above all. Outlines hardly tell distances: more shift made those no better. The boxes say nothing of their
own, they are the estimate's."""


def settings_for(settings: DerenderSettings) -> DerenderSettings:
    """The settings for poses that were estimated instead of labelled."""
    return replace(settings, fitting=FITTING)


@dataclass(frozen=True, slots=True)
class Focal:
    """A focal length, px, and where it is from: "given", "EXIF" or "default"."""

    length_px: float
    source: str


def camera_of(image_path: Path, focal_px: float | None = None) -> Camera:
    """The camera of a photograph: its axis through the middle, focal length as `focal_of` has it."""
    _, width, height = _header(image_path)
    return pinhole(height, width, focal_of(image_path, focal_px).length_px)


def focal_of(image_path: Path, focal_px: float | None = None) -> Focal:
    """The focal length of a photograph: `focal_px`, otherwise EXIF's, otherwise 0.58 of the image's longer side.

    RangeError for a focal_px that is no positive number, FormatError naming a file that is no image.
    """
    exif, width, height = _header(image_path)
    if focal_px is not None:
        return Focal(_checked(focal_px), "given")
    longer = max(width, height)
    told = exif.get_ifd(_EXIF)
    film = _positive(told.get(_FOCAL_35))
    if film:
        return Focal(film / FILM_MM * longer, "EXIF")
    unit = _UNIT_MM.get(int(told.get(_PLANE_UNIT, 2)))
    length, density = _positive(told.get(_FOCAL)), _positive(told.get(_PLANE_X)) or _positive(told.get(_PLANE_Y))
    if unit and length and density:
        return Focal(length / unit * density, "EXIF")
    return Focal(DEFAULT_FOCAL * longer, "default")


def camera_for(height: int, width: int, focal_px: float | None = None) -> Camera:
    """The camera of pixels that nothing is told of: 0.58 of the longer side where no focal length is given."""
    focal = DEFAULT_FOCAL * max(width, height) if focal_px is None else _checked(focal_px)
    return pinhole(height, width, focal)


def _checked(focal_px: float) -> float:
    if not (math.isfinite(focal_px) and focal_px > 0):
        raise RangeError("focal", "positive px", focal_px)
    return float(focal_px)


def _positive(value: Any) -> float:
    """A value of EXIF as a positive number; 0 where it is none: cameras write 0 for what they do not know."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if math.isfinite(number) and number > 0 else 0.0


def _header(path: Path) -> tuple[Any, int, int]:
    """EXIF, width and height, as seen upright. FormatError."""
    with files.opened_image(path) as image:
        exif = image.getexif()
        width, height = image.size
    return (exif, height, width) if _turns(exif) % 2 else (exif, width, height)


def _turns(exif: Any) -> int:
    return _TURNED.get(int(exif.get(_ORIENTATION, 1)), 0)


def photograph(path: Path, focal_px: float | None = None) -> Frame:
    """A photograph, upright, with its camera, without labels. FormatError naming the file; RangeError."""
    focal = focal_of(path, focal_px)
    pixels = np.rot90(files.read_image(path), _turns(_header(path)[0]))
    image = to_tensor(pixels)
    told = f"{focal.length_px:.1f} px, {focal.source}"
    provenance = {"dataset": "photograph", "image": path.name, "focal": told}
    return Frame(path.stem, image, pinhole(image.shape[1], image.shape[2], focal.length_px), provenance=provenance)


@torch.no_grad()
def detect(frame: Frame, detector: Detector | None = None) -> Detections:
    """What a detector finds from its t* on, the shipped one by default; a vehicle that is both car and truck once.

    Pictures of much longer or shorter focal length than the detector knows are resized for it.
    """
    detector = detector or load_detector("squeezedet")
    image = frame.photograph[None].float()
    scale = _DETECTOR_FOCAL_PX / float(frame.camera.intrinsics[0, 0])
    if 1 / _SAME_SCALE < scale < _SAME_SCALE:
        scale = 1.0
    else:
        size = [max(round(scale * side), 32) for side in image.shape[2:]]
        image = torch.nn.functional.interpolate(image, size, mode="bilinear", antialias=True, align_corners=False)
    found = detector.decode(detector(image))[0]
    # pixel centres at integers: column j of the resized image is column (j + 1/2) / scale - 1/2
    ratio = torch.tensor([image.shape[3] / frame.camera.width, image.shape[2] / frame.camera.height]).repeat(2)
    boxes = (found.boxes_xyxy + 0.5) / ratio - 0.5
    boxes = clip_boxes(boxes, frame.camera.height, frame.camera.width)
    keep: list[int] = []
    vehicle = [detector.classes[int(label)] in VEHICLE_CLASSES for label in found.labels]
    overlap = iou_matrix(boxes, boxes)
    for i in range(len(found)):  # best first
        sides = boxes[i, 2:] - boxes[i, :2]
        if float(found.scores[i]) < detector.t_star or float(sides.min()) < 2:
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
    vehicles = [i for i, name in enumerate(names) if name in VEHICLE_CLASSES]
    people = [i for i, name in enumerate(names) if name in _PEOPLE_LHW]
    kinds = [names[i] for i in vehicles]
    poses = estimate(frame.photograph, boxes[vehicles], kinds, frame.camera, ground, looks=DETECTOR_LOOKS)
    places = _people(boxes[people], [names[i] for i in people], frame.camera, poses)
    translation, yaw, size = (torch.full((len(names), *s), math.nan) for s in ((3,), (), (3,)))
    translation[vehicles], yaw[vehicles], size[vehicles] = poses.translation, poses.yaw, poses.size_lhw
    if people:
        translation[people], size[people] = places, torch.tensor([_PEOPLE_LHW[names[i]] for i in people])
        yaw[people] = 0.0
    full = project_boxes(size, yaw, translation, frame.camera.matrix.float())
    inside = clip_boxes(full, frame.camera.height, frame.camera.width)
    boxes = boxes.clone()
    boxes[vehicles] = inside[vehicles]
    seen = torch.isfinite(full).all(1) & (inside[:, 2:] - inside[:, :2] >= 1).all(1)
    seen[vehicles] &= _possible(poses, detections.scores[vehicles])
    kept = [i for i in sorted(vehicles + people) if bool(seen[i])]
    labels = Labels(
        kind=tuple(names[i] for i in kept),
        boxes_xyxy=boxes[kept],
        truncation=_truncation(full[kept], inside[kept]),
        occlusion=_occlusion(boxes[kept], translation[kept, 2]),
        translation=translation[kept],
        yaw=yaw[kept],
        size_lhw=size[kept],
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
