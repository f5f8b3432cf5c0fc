"""Exact ground truth of one generated frame, as every writer takes it, and the frame's place in a data set."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from scene_ir.errors import RangeError, ShapeError
from scene_ir.types import Camera, Labels

SKY_CM = 65535
"""Depth of the sky (Virtual KITTI)."""
OCCLUSION_STEPS = (0.9, 0.5, 0.1)
"""Visible fractions above which an object counts as occlusion 0, 1, 2 (KITTI's codes); below all, 3. With
these the codes are shared out among rendered vehicles as they are in KITTI's labels, which people gave by eye."""


def occlusion_of(visible: float) -> int:
    """KITTI's code, 0 to 3, of an object of which a fraction `visible` shows."""
    return sum(visible <= step for step in OCCLUSION_STEPS)


@dataclass(frozen=True, slots=True)
class TrackedObject:
    """One object of a frame.

    track: its number within the scene, from 0. kind: KITTI's type. model, paint: names for people. moving: whether
    it drives. box_ltrb: of its own silhouette, whole pixels, both ends inclusive, cut at the image. pixels: how
    many show it. truncation, visible: shares in [0, 1]; occlusion: KITTI's 0 to 3. translation (3,) m, bottom-face
    centre, and yaw rad: camera axes; size_lhw m; world (3,) m: the same point in world axes; world_yxz (3,) rad:
    its rotation in world axes, R = Ry(y) Rx(x) Rz(z). labelled: whether it is an object of `labels`, or too small
    or too hidden to be one.
    """

    track: int
    kind: str
    model: str
    paint: str
    moving: bool
    box_ltrb: tuple[int, int, int, int]
    pixels: int
    truncation: float
    visible: float
    occlusion: int
    translation: tuple[float, float, float]
    yaw: float
    size_lhw: tuple[float, float, float]
    world: tuple[float, float, float]
    world_yxz: tuple[float, float, float]
    labelled: bool


@dataclass(frozen=True, slots=True)
class Exposure:
    """One photograph with exact ground truth.

    image (H, W, 3) uint8 RGB; depth_cm (H, W) uint16, 65535 in the sky; classes (H, W) uint8 into `class_names`;
    instances (H, W) uint16, 0 or track + 1. camera: K, size, and a projection whose fourth column is zero but in
    KITTI's layout; extrinsic (4, 4): world to camera axes. objects: all of which a pixel shows; labels: those that
    are large and visible enough, in the same order, the others as regions to ignore.
    """

    image: np.ndarray
    depth_cm: np.ndarray
    classes: np.ndarray
    class_names: tuple[str, ...]
    instances: np.ndarray
    camera: Camera
    extrinsic: np.ndarray
    objects: tuple[TrackedObject, ...]
    labels: Labels
    manifest: dict[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        expected = {"image": ((*size, 3), np.uint8), "depth_cm": (size, np.uint16)}
        expected |= {"classes": (size, np.uint8), "instances": (size, np.uint16)}
        for name, (shape, dtype) in expected.items():
            value = getattr(self, name)
            if value.shape != shape or value.dtype != dtype:
                wanted = f"{shape} of {np.dtype(dtype)}"
                raise ShapeError(f"exposure.{name}", wanted, f"{value.shape} of {value.dtype}")
        if sum(o.labelled for o in self.objects) != len(self.labels.kind):
            raise RangeError("exposure.labels", "one a labelled object", len(self.labels.kind))


@dataclass(frozen=True, slots=True)
class Place:
    """Where a frame belongs in a data set. number: running number, from 0, unique. scene: Virtual KITTI's world
    ("01"); variation: "clone", "fog", ...; frame: number within scene and variation. part: "train" or "val".
    """

    number: int
    scene: str
    variation: str
    frame: int
    part: str
