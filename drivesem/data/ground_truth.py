"""Exact ground truth of one generated frame, the input of all writers, and its location in a data set."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from scene_ir.errors import RangeError, ShapeError
from scene_ir.types import Camera, Labels

SKY_CM = 65535
"""Depth of the sky in Virtual KITTI's images."""
OCCLUSION_STEPS = (0.9, 0.5, 0.1)
"""Visible fractions above which an object has KITTI's occlusion code 0, 1, 2; below all, 3. With these steps
rendered vehicles have the distribution of codes of KITTI's hand-made labels."""


def occlusion_from_visible(visible: float) -> int:
    """Return KITTI's occlusion code, 0 to 3, of an object with a visible fraction."""
    return sum(visible <= step for step in OCCLUSION_STEPS)


@dataclass(frozen=True, slots=True)
class TrackedObject:
    """One object of a frame."""

    track: int
    """Number within the scene, from 0."""
    kind: str
    """KITTI's type."""
    model: str
    """Name of its mesh, for people."""
    paint: str
    """Name of its colour, for people."""
    moving: bool
    """Whether it drives."""
    box_ltrb: tuple[int, int, int, int]
    """Box of its full silhouette, whole px, both ends inclusive, clipped to the image."""
    pixels: int
    """Number of visible pixels."""
    truncation: float
    """Share outside the image, [0, 1]."""
    visible: float
    """Visible share, [0, 1]."""
    occlusion: int
    """KITTI's code, 0 to 3."""
    translation: tuple[float, float, float]
    """Bottom-face centre in camera axes, m."""
    yaw: float
    """Yaw in camera axes, rad."""
    size_lhw: tuple[float, float, float]
    """Length, height, width, m."""
    world: tuple[float, float, float]
    """Bottom-face centre in world axes, m."""
    world_yxz: tuple[float, float, float]
    """Rotation in world axes, R = Ry(y) Rx(x) Rz(z), rad."""
    labelled: bool
    """Whether it is one of the frame's labels; else it is too small or too hidden."""


@dataclass(frozen=True, slots=True)
class Exposure:
    """One image with exact ground truth."""

    image: np.ndarray
    """RGB (H, W, 3) uint8."""
    depth_cm: np.ndarray
    """Depth (H, W) uint16 cm, 65535 in the sky."""
    classes: np.ndarray
    """Indices (H, W) uint8 into `class_names`."""
    class_names: tuple[str, ...]
    """Names of the semantic classes."""
    instances: np.ndarray
    """Track + 1 of each pixel (H, W) uint16; 0: no object."""
    camera: Camera
    """Intrinsics, size, and projection; the fourth column is zero except in KITTI's layout."""
    extrinsic: np.ndarray
    """World to camera axes (4, 4)."""
    objects: tuple[TrackedObject, ...]
    """Objects with at least one visible pixel."""
    labels: Labels
    """Those that are large and visible enough, in the same order; the others are regions to ignore."""
    manifest: dict[str, object] = field(default_factory=dict)
    """The frame's entry in the manifest."""

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
            raise RangeError("exposure.labels", "one for each labelled object", len(self.labels.kind))


@dataclass(frozen=True, slots=True)
class FrameLocation:
    """Where a frame belongs in a data set."""

    number: int
    """Running number, unique, from 0."""
    scene: str
    """Virtual KITTI's world, such as "01"."""
    variation: str
    """Virtual KITTI's variation, such as "clone" or "fog"."""
    frame: int
    """Number within scene and variation."""
    part: str
    """"train" or "val"."""
