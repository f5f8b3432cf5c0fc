"""Shadows on the ground by the second renderer: the photographed one goes with its vehicle, a contact shadow fills
what the photograph does not show of it."""

from __future__ import annotations

import cv2
import numpy as np

from drivesem.failures.second_renderer.placing import Lens, Pose, numbers
from drivesem.failures.second_renderer.screen import Array
from scene_ir.types import Source

_DARKEST = 0.05
"""Factors below this count as this: their logarithms are added."""
_CONTACT, _CORE = (0.7, 2.0), 80
"""Optical depth of the shadow under a vehicle, least and most; the percentile of what the photograph shows of its
shadow that it is taken for."""
_SOFT_M = 0.15
"""Over how far that one fades at the footprint's edge."""


class Shadow:
    """Of one vehicle, as optical depth. normal: (3,) of the ground, in the camera's axes. dark: (H, W, 3), what
    the photograph shows of it, besides that of the scene.
    """

    def __init__(self, source: Source, lens: Lens, normal: Array, dark: Array) -> None:
        self._lens, self._normal = lens, normal.astype(np.float64)
        self._before = Pose.photographed(source)
        if source.shadow is not None and source.shadow.values.numel():
            crop = source.shadow
            factor = numbers(crop.values).transpose(1, 2, 0)
            where = slice(crop.y0, crop.y0 + factor.shape[0]), slice(crop.x0, crop.x0 + factor.shape[1])
            # What is dark about a vehicle above the ground is no shadow.
            low = np.zeros_like(dark)
            low[where] = np.maximum(dark[where], -np.log(np.clip(factor, _DARKEST, 1)))
            dark = low
        x, y, width, height = cv2.boundingRect((dark.max(axis=2) > 0).astype(np.uint8))
        # Nothing is known beyond: there the shadow is to end.
        density = np.minimum(dark[y : y + height, x : x + width], -np.log(_DARKEST))
        self._density = (
            cv2.copyMakeBorder(density, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=(0, 0, 0)) if width else None
        )
        self._origin = (x - 1, y - 1)
        told = density[density > 0]
        self._core = float(np.clip(np.percentile(told, _CORE), *_CONTACT)) if len(told) else _CONTACT[0]

    def cast(self, pose: Pose, density: Array) -> None:
        """Add what the vehicle casts where it stands now to the picture's optical depth (H, W, 3)."""
        contact = self._contact(pose)
        if contact is not None:
            where, dark = contact
            density[where] = np.maximum(density[where], dark[..., None])
        if self._density is None:
            return
        matrix = self._ground_motion(pose) @ _shift(*self._origin)
        height, width = self._density.shape[:2]
        corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], np.float64) @ matrix.T
        if (corners[:, 2] <= 0).any():
            return
        at = corners[:, :2] / corners[:, 2:]
        limit = [self._lens.width, self._lens.height]
        x0, y0 = np.clip(np.floor(at.min(axis=0)), 0, limit).astype(int).tolist()
        x1, y1 = np.clip(np.ceil(at.max(axis=0)) + 1, 0, limit).astype(int).tolist()
        if x1 <= x0 or y1 <= y0:
            return
        moved = cv2.warpPerspective(self._density, _shift(-x0, -y0) @ matrix, (x1 - x0, y1 - y0))
        density[y0:y1, x0:x1] = np.maximum(density[y0:y1, x0:x1], moved)

    def _ground_motion(self, pose: Pose) -> np.ndarray:
        """(3, 3) by which pixels of the ground under the vehicle move when it does: a plane's homography."""
        k = self._lens.intrinsics.astype(np.float64)
        before, after = (p.translation.astype(np.float64) + self._lens.shift_m for p in (self._before, pose))
        turn = pose.rotation().astype(np.float64) @ self._before.rotation().T
        level = self._normal @ before
        return k @ (turn + np.outer(after - turn @ before, self._normal) / level) @ np.linalg.inv(k)

    def _contact(self, pose: Pose) -> tuple[tuple[slice, slice], Array] | None:
        """Optical depth (h, w) of the contact shadow, and where; None where it is not in the picture."""
        lens = self._lens
        half = np.array([pose.size_lhw[0], pose.size_lhw[2]]) / 2 - _SOFT_M
        flat = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * half
        ends = np.stack([flat[:, 0], np.zeros(4), flat[:, 1]], axis=1) @ pose.rotation().T
        ends += pose.translation + lens.shift_m
        if ends[:, 2].min() < 1.0:
            return None
        at = lens.pixels(ends.astype(np.float32))
        soft = max(0.7, _SOFT_M * float(lens.intrinsics[0, 0]) / float(ends[:, 2].mean()))
        # Seen at a slant, the ground is foreshortened by the camera's height over the distance.
        flatter = max(0.5, soft * abs(float(self._normal @ ends.mean(axis=0))) / float(ends[:, 2].mean()))
        reach = int(np.ceil(3 * soft))
        x0, y0 = np.clip(np.floor(at.min(axis=0)) - reach, 0, [lens.width, lens.height]).astype(int).tolist()
        x1, y1 = np.clip(np.ceil(at.max(axis=0)) + reach, 0, [lens.width, lens.height]).astype(int).tolist()
        if x1 <= x0 or y1 <= y0:
            return None
        mask = np.zeros((y1 - y0, x1 - x0), np.float32)
        fixed = np.rint((at - [x0, y0]) * 16).astype(np.int32)
        cv2.fillConvexPoly(mask, fixed, 1.0, cv2.LINE_8, 4)
        mask = cv2.GaussianBlur(mask, (0, 0), soft, sigmaY=flatter)
        return (slice(y0, y1), slice(x0, x1)), (self._core * mask).astype(np.float32)


def _shift(x: float, y: float) -> np.ndarray:
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1]], np.float64)
