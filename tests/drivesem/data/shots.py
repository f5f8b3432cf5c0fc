"""A small exposure made by hand: a road, two cars of which one hides part of the other, and a walker."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from drivesem.data.ground_truth import SKY_CM, Exposure, TrackedObject, occlusion_from_visible
from scene_ir.types import Camera, Labels

CLASS_NAMES = ("Undefined", "Sky", "Road", "Tree", "Car", "Van", "Pedestrian", "GuardRail")


def make_object(track: int = 0, kind: str = "Car", **changes: Any) -> TrackedObject:
    """A car a little to the right of the camera, changed as asked."""
    base = TrackedObject(
        track=track,
        kind=kind,
        model=f"{kind.lower()}{track:03d}",
        paint="dark red",
        moving=track % 2 == 1,
        box_ltrb=(10, 14, 27, 24),
        pixels=90,
        truncation=0.0,
        visible=0.923456789012345,
        occlusion=0,
        translation=(1.0471975512, 1.6500001, 14.4321987),
        yaw=-1.2345678901,
        size_lhw=(4.125, 1.5078125, 1.7654321),
        world=(1.0471975512, -0.0123456, 1234.5678912),
        world_yxz=(-1.2345678901, 0.0012345678, -0.0076543),
        labelled=True,
    )
    changed = replace(base, **changes)
    return replace(changed, occlusion=occlusion_from_visible(changed.visible))


def shot(height: int = 40, width: int = 80, camera: Camera | None = None, seed: int = 0) -> Exposure:
    """The exposure, in the upper left 40x80 pixels of an image of this size."""
    rng = np.random.default_rng(seed)
    instances = np.zeros((height, width), np.uint16)
    classes = np.full((height, width), CLASS_NAMES.index("Road"), np.uint8)
    classes[: height // 4] = CLASS_NAMES.index("Sky")
    classes[height // 4 : height // 3, : width // 2] = CLASS_NAMES.index("Tree")
    classes[height // 3] = CLASS_NAMES.index("GuardRail")
    classes[-1, -3:] = CLASS_NAMES.index("Undefined")
    depth = rng.integers(300, 65534, (height, width)).astype(np.uint16)
    depth[classes == CLASS_NAMES.index("Sky")] = SKY_CM
    depth[-1, -1] = SKY_CM - 1
    far = make_object(7, "Van", box_ltrb=(18, 12, 33, 22), visible=0.6, truncation=0.0)
    near = make_object(0, "Car", box_ltrb=(10, 14, 27, 24))
    cut = make_object(3, "Car", box_ltrb=(70, 15, 79, 39), truncation=0.3123456789, visible=1.0, yaw=3.1)
    walker = make_object(12, "Pedestrian", box_ltrb=(50, 18, 50, 18), visible=0.1, pixels=1, labelled=False)
    for item in (far, near, cut, walker):  # the nearer ones last
        left, top, right, bottom = item.box_ltrb
        instances[top : bottom + 1, left : right + 1] = item.track + 1
        classes[top : bottom + 1, left : right + 1] = CLASS_NAMES.index(item.kind)
    tracked_objects = (near, cut, far, walker)
    labelled = [t for t in tracked_objects if t.labelled]
    small = torch.tensor([t.box_ltrb for t in tracked_objects if not t.labelled], dtype=torch.float32)
    k = torch.tensor([[72.00087, 0, 39.5], [0, 72.5, 18.25], [0, 0, 1]])
    turn, shift = np.array([[0.6, 0, 0.8], [0, 1, 0], [-0.8, 0, 0.6]]), np.array([1.25, -1.7, 300.123456])
    extrinsic = np.eye(4)
    extrinsic[:3, :3], extrinsic[:3, 3] = turn, shift
    return Exposure(
        image=rng.integers(0, 256, (height, width, 3), dtype=np.uint8),
        depth_cm=depth,
        classes=classes,
        class_names=CLASS_NAMES,
        instances=instances,
        camera=camera or Camera(k, height, width),
        extrinsic=extrinsic,
        objects=tracked_objects,
        labels=Labels(
            kind=tuple(t.kind for t in labelled),
            boxes_xyxy=torch.tensor([t.box_ltrb for t in labelled], dtype=torch.float32),
            truncation=torch.tensor([t.truncation for t in labelled], dtype=torch.float32),
            occlusion=torch.tensor([t.occlusion for t in labelled]),
            translation=torch.tensor([t.translation for t in labelled], dtype=torch.float32),
            yaw=torch.tensor([t.yaw for t in labelled], dtype=torch.float32),
            size_lhw=torch.tensor([t.size_lhw for t in labelled], dtype=torch.float32),
            ignore_xyxy=small,
        ),
    )
