"""What the street shows behind unknown pixels, worked out at the photograph's size or at a part of it.

The road and its profile go on (`street`), upright things are copied as columns (`upright`), the rest is patches
(`background`).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scene_ir.derender import patch_fill as fills
from scene_ir.derender import segmentation as segment
from scene_ir.derender import silhouette, street
from scene_ir.derender import standing_surfaces as upright
from scene_ir.types import Camera

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

_STOOD_M = 0.3
"""How far around a vehicle's footprint there is ground."""
_PERSON_SHARE = 0.8
"""How much a pixel must look like an unlabelled person not to be copied."""
_CERTAINLY, _LEAST_CORE_PX, _AROUND_CORE_PX = 0.97, 150, 150
"""How much the core of an unlabelled vehicle must look like one, its least area, and how far its less certain rest
reaches."""
_LEAST_REST = 0.05
"""Less than that for all but vehicles says nothing of the rest."""
_BORDER_PX = 5
"""So near to vehicles and their shadows colours are mixed, and masks may err: not copied."""
_LARGE_HOLE_PX = 60_000
"""Holes beyond are not searched at full size: a third of the time less, hardly to be seen."""


@dataclass(frozen=True, slots=True)
class BackgroundInputs:
    """horizon: its row, px; ground (4,): the plane; others (H, W): labelled things that are no vehicles; front
    (H, W): how much of each pixel shows things in front of vehicles; seen: the photograph's maps."""

    horizon: float
    ground: torch.Tensor
    camera: Camera
    excluded: Mask
    occluder_opacity: Array
    segmentation: segment.Segmentation

    def scaled_down(self, shrink: int) -> BackgroundInputs:
        """The same at one over `shrink` of the size."""
        camera = self.camera
        size = _scaled_size(self.excluded.shape, shrink)
        across, down = size[0] / camera.width, size[1] / camera.height
        zoom = torch.tensor([[across, 0, (across - 1) / 2], [0, down, (down - 1) / 2], [0, 0, 1]])
        matrix = zoom.to(camera.matrix) @ camera.matrix
        smaller = Camera(matrix[:, :3].clone(), size[1], size[0], matrix)
        seen = segment.Segmentation(
            *(_scale_down(getattr(self.segmentation, f.name), shrink) for f in fields(segment.Segmentation)),
        )
        horizon = (self.horizon + 0.5) * down - 0.5
        return replace(
            self,
            horizon=horizon,
            camera=smaller,
            others=_scale_mask(self.excluded, shrink),
            front=_scale_down(self.occluder_opacity, shrink),
            seen=seen,
        )


def _scaled_size(shape: tuple[int, ...], shrink: int) -> tuple[int, int]:
    """One over `shrink` of a size (H, W), as width, height."""
    return -(-shape[1] // shrink), -(-shape[0] // shrink)


def _scale_down(values: Array, shrink: int) -> Array:
    """Values (H, W) or (H, W, C) at one over `shrink` of the size, in the mean."""
    size = _scaled_size(values.shape, shrink)
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), np.float32)


def _scale_mask(mask: Mask, shrink: int) -> Mask:
    """A mask (H, W) at one over `shrink` of the size, with every pixel that it touches."""
    return mask if shrink == 1 else _scale_down(mask.astype(np.float32), shrink) > 0


class BackgroundFill:
    """The street behind pixels of one photograph. image (H, W, 3) in [0, 1]; near (H, W) m: distance from the
    cars' footprints; shrink: work at one over so much of the size, which takes less time and shows less detail.
    """

    def __init__(self, image: Array, near: Array, surroundings: BackgroundInputs, shrink: int = 1) -> None:
        self._whole = image
        self._shrink = shrink
        self._image, self._near, self._inputs = image, near, surroundings
        if shrink > 1:
            self._image, self._inputs = _scale_down(image, shrink), surroundings.scaled_down(shrink)
            nearest = cv2.resize(near, _scaled_size(near.shape, shrink), interpolation=cv2.INTER_NEAREST)
            self._near = np.asarray(nearest, np.float32)
        self._plane = street.ground_coordinates(self._inputs.ground, self._inputs.camera)

    def continue_street(self, unknown: Mask) -> Array:
        """The image (H, W, 3) with the street, smooth, behind unknown pixels (H, W)."""
        return self._at_full_size(self._continue_street(_scale_mask(unknown, self._shrink)).image, unknown)

    def fill_hole(self, hole: Mask, seed: int) -> Array:
        """The image (H, W, 3) without what is in the hole (H, W). seed: of the random search."""
        return self._at_full_size(self._fill_hole(_scale_mask(hole, self._shrink), seed), hole)

    def _at_full_size(self, found: Array, hole: Mask) -> Array:
        if self._shrink == 1:
            return found
        size = self._whole.shape[1], self._whole.shape[0]
        larger = np.clip(cv2.resize(found, size, interpolation=cv2.INTER_CUBIC), 0, 1)
        return np.where(hole[..., None], larger, self._whole).astype(np.float32)

    def _fill_hole(self, hole: Mask, seed: int) -> Array:
        shrink = self._shrink
        guide = self._continue_street(silhouette.grow_mask(hole, 2 / shrink))
        forbidden = silhouette.grow_mask(hole, _BORDER_PX / shrink) | self._excluded_pixels(hole)
        seen, horizon = self._inputs.segmentation, self._inputs.horizon
        like = np.where(forbidden, 0, np.where(guide.ground, _ground_share(seen), seen.ground)).astype(np.float32)
        sideways = upright.ColumnCopySettings().scaled_down(shrink)
        standing = upright.copy_columns(self._image, hole, forbidden | (like > 0.5), guide, horizon, sideways)
        rest, forbidden = hole & ~standing.copied, forbidden & ~standing.copied
        ground = fills.GroundMaps((self._near < _STOOD_M) | guide.ground, like)
        quick = fills.PatchFillSettings(iterations=(8, 0))
        settings = quick if np.count_nonzero(rest) > _LARGE_HOLE_PX else fills.PatchFillSettings()
        settings = settings.scaled_down(shrink)
        return fills.fill_patches(standing.image, rest, forbidden, horizon, ground, seed, settings, guide.image)

    def _continue_street(self, unknown: Mask) -> street.StreetContinuation:
        seen = self._inputs.segmentation
        unknown = unknown | self._excluded_pixels(unknown)
        shares = street.StreetShares(seen.ground, seen.sky, unknown & (self._near < _STOOD_M), _ground_share(seen))
        settings = street.StreetSettings(coarse=self._shrink)
        return street.continue_street(self._image, unknown, shares, self._plane, self._inputs.horizon, settings)

    def _excluded_pixels(self, unknown: Mask) -> Mask:
        """Pixels (H, W) outside the unknown ones that show no street: people and vehicles, also those that nobody
        labelled."""
        seen = self._inputs.segmentation
        # Light walls and cobbles look somewhat like cars: only what has a large, certain core is one.
        certain = ((seen.vehicle > _CERTAINLY) & ~unknown).astype(np.uint8)
        count, parts, stats, _ = cv2.connectedComponentsWithStats(certain)
        least = _LEAST_CORE_PX / self._shrink**2
        large = [i for i in range(1, count) if stats[i, cv2.CC_STAT_AREA] >= least]
        core = np.isin(parts, large)
        vehicle = core
        if large:
            rest = (seen.vehicle > 0.5) & (_ground_share(seen) < 0.5)
            vehicle = core | (silhouette.grow_mask(core, _AROUND_CORE_PX / self._shrink) & rest)
        return (
            self._inputs.excluded
            | silhouette.grow_mask(vehicle, _BORDER_PX / self._shrink)
            | (seen.person > _PERSON_SHARE)
        )


def _ground_share(seen: segment.Segmentation) -> Array:
    """How much each pixel (H, W) looks like ground, given that it shows no vehicle: where these are is known."""
    return np.clip(seen.ground / np.maximum(1 - seen.vehicle, _LEAST_REST), 0, 1).astype(np.float32)
