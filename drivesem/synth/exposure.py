"""A generated frame as what every writer takes: whole-pixel maps, centimetres, tracks, poses in world axes."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from drivesem.data.ground_truth import SKY_CM, Exposure, TrackedObject
from drivesem.synth.frames import SynthFrame, Truth
from drivesem.synth.soup import Semantic
from drivesem.synth.view import View
from scene_ir.geometry import yaw_matrix

CLASS_NAMES = tuple(
    {"GUARD_RAIL": "GuardRail", "TRAFFIC_SIGN": "TrafficSign", "TRAFFIC_LIGHT": "TrafficLight"}.get(
        s.name, s.name.capitalize()
    )
    for s in Semantic
)
"""Virtual KITTI's names of the classes, in the order of `Semantic`, and Pedestrian and Cyclist."""
_FARTHEST_CM = SKY_CM - 1
_PAINT_NAMES = {
    "White": (0.75, 0.75, 0.74),
    "Black": (0.02, 0.02, 0.02),
    "Grey": (0.16, 0.165, 0.17),
    "Silver": (0.42, 0.43, 0.44),
    "Blue": (0.05, 0.11, 0.28),
    "Red": (0.36, 0.03, 0.03),
    "Brown": (0.12, 0.07, 0.045),
    "Green": (0.03, 0.10, 0.06),
    "Beige": (0.52, 0.46, 0.36),
    "Yellow": (0.62, 0.50, 0.06),
    "Orange": (0.62, 0.17, 0.03),
}
"""Linear albedo of the colours that Virtual KITTI's `info.txt` names."""


def expose(frame: SynthFrame, first_track: int = 0) -> Exposure:
    """The frame's ground truth for a writer. first_track: added to its tracks, so that they are unique in a
    scene."""
    view = frame.setting.view
    counts = np.bincount(frame.instance.reshape(-1), minlength=1)
    objects = []
    for truth in frame.truths:
        value = truth.actor.track + 1
        pixels = int(counts[value]) if value < len(counts) else 0
        if pixels or truth.labelled:
            objects.append(_object(truth, pixels, view, first_track))
    depth = np.full(frame.depth_m.shape, SKY_CM, np.uint16)
    land = np.isfinite(frame.depth_m)
    depth[land] = np.minimum(np.rint(frame.depth_m[land] * 100), _FARTHEST_CM)
    instances = frame.instance + np.where(frame.instance > 0, np.uint16(first_track), np.uint16(0))
    extrinsic = np.eye(4)
    extrinsic[:3, :3] = view.rotation
    extrinsic[:3, 3] = -view.rotation @ view.origin
    return Exposure(
        image=frame.image,
        depth_cm=depth,
        classes=frame.semantic,
        class_names=CLASS_NAMES,
        instances=instances,
        camera=frame.camera,
        extrinsic=extrinsic,
        objects=tuple(objects),
        labels=frame.labels,
        manifest=frame.manifest,
    )


def _object(truth: Truth, pixels: int, view: View, first_track: int) -> TrackedObject:
    actor = truth.actor
    left, top = np.floor(truth.box_xyxy[:2] + 0.5)
    right, bottom = np.ceil(truth.box_xyxy[2:] + 0.5) - 1
    world = view.to_world(truth.translation)
    return TrackedObject(
        track=first_track + actor.track,
        kind=actor.label,
        model=actor.model,
        paint=paint_name(actor.paint),
        moving=actor.speed_mps != 0,
        box_ltrb=(int(left), int(top), int(right), int(bottom)),
        pixels=pixels,
        truncation=truth.truncation,
        visible=truth.visible,
        occlusion=truth.occlusion,
        translation=_triple(truth.translation),
        yaw=truth.yaw,
        size_lhw=actor.size_lhw,
        world=_triple(world),
        world_yxz=_euler_yxz(view.rotation.T @ yaw_matrix(torch.tensor(truth.yaw, dtype=torch.float64)).numpy()),
        labelled=truth.labelled,
    )


def paint_name(albedo: Sequence[float]) -> str:
    """The nearest of the named paints, by the cube roots of linear RGB, which are about even to the eye."""
    cube_roots = np.cbrt(np.asarray(albedo, float))
    return min(_PAINT_NAMES, key=lambda name: float(np.abs(np.cbrt(_PAINT_NAMES[name]) - cube_roots).sum()))


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def _euler_yxz(rotation: np.ndarray) -> tuple[float, float, float]:
    """Angles (y, x, z), rad, of a rotation R = Ry(y) Rx(x) Rz(z)."""
    return (
        math.atan2(rotation[0, 2], rotation[2, 2]),
        -math.asin(float(np.clip(rotation[1, 2], -1, 1))),
        math.atan2(rotation[1, 0], rotation[1, 1]),
    )
