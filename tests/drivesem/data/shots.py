"""Builders: a small exposure with a road, two overlapping cars and a walker, and damages to files."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import torch

from drivesem.data.ground_truth import SKY_CM, Exposure, TrackedObject, occlusion_from_visible
from scene_ir.types import Camera, Labels

CLASS_NAMES = ("Undefined", "Sky", "Road", "Tree", "Car", "Van", "Pedestrian", "GuardRail")

Damage: TypeAlias = "Callable[[Path], object]"
"""Damages a file below a folder."""


def remove(path: str) -> Damage:
    return lambda root: (root / path).unlink()


def overwrite(path: str, data: bytes) -> Damage:
    return lambda root: (root / path).write_bytes(data)


def truncate(path: str, count: int) -> Damage:
    return lambda root: (root / path).write_bytes((root / path).read_bytes()[:count])


def write_image(path: str, array: np.ndarray) -> Damage:
    return lambda root: cv2.imwrite(str(root / path), array)


def replace_text(path: str, old: str, new: str) -> Damage:
    """Replace the first occurrence in a text file."""

    def damage(root: Path) -> None:
        text = (root / path).read_text()
        assert old in text
        (root / path).write_text(text.replace(old, new, 1))

    return damage


def set_field(path: str, column: str, value: str) -> Damage:
    """Set a column of a table's first row."""

    def damage(root: Path) -> None:
        header, first, *rest = (root / path).read_text().splitlines()
        fields = first.split()
        fields[header.split().index(column)] = value
        (root / path).write_text("\n".join([header, " ".join(fields), *rest, ""]))

    return damage


def plain_labels(kinds: Sequence[str], regions: int = 0) -> Labels:
    """Labels of objects of some types, 50 px high, with unknown 3D boxes, and regions to ignore."""
    n = len(kinds)
    unknown = torch.full((n, 3), torch.nan)
    box = torch.tensor([10.0, 10.0, 60.0, 60.0])
    return Labels(
        kind=tuple(kinds),
        boxes_xyxy=box.repeat(n, 1),
        truncation=unknown[:, 0],
        occlusion=torch.full((n,), 3),
        translation=unknown,
        yaw=unknown[:, 0],
        size_lhw=unknown,
        ignore_xyxy=box.repeat(regions, 1),
    )


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


def make_labels(
    objects: Sequence[TrackedObject], boxes: Sequence[Sequence[float]], regions: Sequence[Sequence[float]]
) -> Labels:
    """Labels of objects with these boxes xyxy px, and regions to ignore."""

    def table(rows: Iterable[Any], *shape: int) -> torch.Tensor:
        return torch.tensor(list(rows), dtype=torch.float32).reshape(-1, *shape)

    return Labels(
        kind=tuple(o.kind for o in objects),
        boxes_xyxy=table(boxes, 4),
        truncation=table(o.truncation for o in objects),
        occlusion=torch.tensor([o.occlusion for o in objects], dtype=torch.int64),
        translation=table((o.translation for o in objects), 3),
        yaw=table(o.yaw for o in objects),
        size_lhw=table((o.size_lhw for o in objects), 3),
        ignore_xyxy=table(regions, 4),
    )


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
    small = [t.box_ltrb for t in tracked_objects if not t.labelled]
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
        labels=make_labels(labelled, [t.box_ltrb for t in labelled], small),
    )
