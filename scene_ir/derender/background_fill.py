"""Fill the background behind unknown pixels, at the photograph's size or at a fraction of it.

Roads and their profile are continued (`street`), upright surfaces are copied as columns (`standing_surfaces`), the
rest is filled with patches (`patch_fill`).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scene_ir.derender import patch_fill, street
from scene_ir.derender.segmentation import Segmentation
from scene_ir.derender.silhouette import grow_mask, mask_bounds
from scene_ir.derender.standing_surfaces import ColumnCopySettings, copy_columns
from scene_ir.image_filters import push_pull
from scene_ir.types import Camera

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

_STOOD_M = 0.3
"""Distance from a vehicle's footprint within which there is ground."""
_PERSON_SHARE = 0.8
"""Share of an unlabelled person from which a pixel is not copied."""
_VEHICLE_SHARE, _MIN_CORE_PX, _AROUND_CORE_PX = 0.97, 150, 150
"""Share and least area of the core of an unlabelled vehicle, and how far its less certain rest extends."""
_MIN_REST = 0.05
"""A smaller share of all but vehicles carries no information."""
_SEAM = 0.06
"""Width of the border along which a person's fill takes the colours around it, in heights."""
_NEAR_THIN = (1.0, 0.5)
"""Range around a person that is continued, across and down, in heights."""
_MAX_UNKNOWN = 0.8
"""Share of that range, of the person and of all others, above which there is too little to continue."""
_MAX_THIN_PX = 100
"""Height up to which a person's fill has its full size; the time grows with the area."""
_BORDER_PX = 5
"""Pixels this near to vehicles and shadows are not copied: their colours are mixed, and masks have errors."""


@dataclass(frozen=True, slots=True)
class BackgroundInputs:
    """What is known about a photograph before its background is filled."""

    horizon: float
    """Row of the horizon, px."""
    ground: torch.Tensor
    """(4,), plane n.x + d = 0."""
    camera: Camera
    """The photograph's camera."""
    excluded: Mask
    """(H, W), labels that are neither objects nor vehicles: not copied."""
    people: Mask
    """(H, W), labelled people who stay: not continued behind others."""
    occluder_opacity: Array
    """(H, W) in [0, 1], opacity of the occluders."""
    maps: Segmentation
    """The photograph's soft maps."""

    def scaled_down(self, shrink: int) -> BackgroundInputs:
        """The same at one over `shrink` of the size."""
        camera = self.camera
        width, height = _scaled_size(self.excluded.shape, shrink)
        across, down = width / camera.width, height / camera.height
        zoom = torch.tensor([[across, 0, (across - 1) / 2], [0, down, (down - 1) / 2], [0, 0, 1]])
        matrix = zoom.to(camera.matrix) @ camera.matrix
        return BackgroundInputs(
            (self.horizon + 0.5) * down - 0.5,
            self.ground,
            Camera(matrix[:, :3].clone(), height, width, matrix),
            _scale_mask(self.excluded, shrink),
            _scale_mask(self.people, shrink),
            _scale_down(self.occluder_opacity, shrink),
            Segmentation(*(_scale_down(getattr(self.maps, f.name), shrink) for f in fields(Segmentation))),
        )


def _scaled_size(shape: tuple[int, ...], shrink: int) -> tuple[int, int]:
    """Width and height at one over `shrink` of a shape (H, W)."""
    return -(-shape[1] // shrink), -(-shape[0] // shrink)


def _scale_down(values: Array, shrink: int) -> Array:
    """Averages of values (H, W) or (H, W, C) at one over `shrink` of the size."""
    size = _scaled_size(values.shape, shrink)
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), np.float32)


def _scale_mask(mask: Mask, shrink: int) -> Mask:
    """Every pixel that a mask (H, W) touches at one over `shrink` of the size."""
    return mask if shrink == 1 else _scale_down(mask.astype(np.float32), shrink) > 0


@dataclass(frozen=True, slots=True)
class _View:
    """A photograph at one over `shrink` of its size."""

    image: Array
    """(H, W, 3) in [0, 1]."""
    near: Array
    """(H, W) m, distance of the ground from the vehicles' footprints."""
    inputs: BackgroundInputs
    """What is known about the photograph at this size."""
    shrink: int
    """See above."""

    def scaled_down(self, shrink: int) -> _View:
        """The photograph, which is at its full size, at one over `shrink` of it."""
        if shrink == 1:
            return self
        nearest = cv2.resize(self.near, _scaled_size(self.near.shape, shrink), interpolation=cv2.INTER_NEAREST)
        inputs = self.inputs.scaled_down(shrink)
        return _View(_scale_down(self.image, shrink), np.asarray(nearest, np.float32), inputs, shrink)

    def enlarge(self, filled: Array, unknown: Mask) -> Array:
        """This photograph (H, W, 3) with unknown pixels (H, W) from a smaller image of it."""
        size = self.image.shape[1], self.image.shape[0]
        enlarged = np.clip(cv2.resize(filled, size, interpolation=cv2.INTER_CUBIC), 0, 1)
        return np.where(unknown[..., None], enlarged, self.image).astype(np.float32)


class BackgroundFill:
    """Fills pixels of one photograph with the background behind them."""

    def __init__(self, image: Array, near: Array, inputs: BackgroundInputs, shrink: int = 1) -> None:
        """Prepare the photograph.

        Args:
            image: (H, W, 3) in [0, 1].
            near: Distance (H, W) m of the ground from the vehicles' footprints.
            inputs: What is known about the photograph.
            shrink: Fill at one over this size: faster, with less detail.
        """
        self._full = _View(image, near, inputs, 1)
        self._work = self._full.scaled_down(shrink)
        # The continued street is smooth: half the size shows it.
        self._coarse = self._full.scaled_down(2 * shrink)
        self._coordinates = street.ground_coordinates(self._coarse.inputs.ground, self._coarse.inputs.camera)

    def continue_street(self, unknown: Mask) -> Array:
        """The image (H, W, 3) with a smooth continuation of the street at unknown pixels (H, W)."""
        return self._full.enlarge(self._continue_street(unknown, self._coarse.shrink).image, unknown)

    def fill_hole(self, hole: Mask, seed: int) -> Array:
        """The image (H, W, 3) with the hole (H, W) filled; `seed` is the random search's."""
        filled = self._fill_hole(_scale_mask(hole, self._work.shrink), seed)
        return filled if self._work is self._full else self._full.enlarge(filled, hole)

    def fill_thin(self, filled: Array, thin: Mask, others: Mask) -> Array:
        """The image (H, W, 3) with lines and textures from around a person continued behind it (frequency selective
        reconstruction, Genser et al. 2018), as suits objects that are narrower than what they hide.

        Args:
            filled: The image, filled otherwise.
            thin: Pixels (H, W) of one person.
            others: Pixels (H, W) of people that are to be filled after this one.
        """
        x0, y0, x1, y1 = mask_bounds(thin)
        across, down = (round(reach * (y1 - y0)) for reach in _NEAR_THIN)
        window = (slice(max(y0 - down, 0), y1 + down), slice(max(x0 - across, 0), x1 + across))
        inputs, hole = self._full.inputs, thin[window]
        unknown = hole | others[window] | inputs.people[window] | (inputs.maps.person[window] > _PERSON_SHARE)
        if unknown.mean() > _MAX_UNKNOWN:
            return filled
        height, width = hole.shape
        scale = min(1.0, _MAX_THIN_PX / (y1 - y0))
        size = (max(round(scale * width), 1), max(round(scale * height), 1))
        small = np.rint(cv2.resize(filled[window], size, interpolation=cv2.INTER_AREA) * 255).astype(np.uint8)
        known = cv2.resize(unknown.astype(np.float32), size, interpolation=cv2.INTER_AREA) == 0
        cv2.xphoto.inpaint(small, known.astype(np.uint8) * 255, found := small.copy(), cv2.xphoto.INPAINT_FSR_FAST)
        image = filled.copy()
        continued = cv2.resize(found.astype(np.float32) / 255, (width, height), interpolation=cv2.INTER_CUBIC)
        around = push_pull(filled[window], 1 - unknown.astype(np.float32))  # without the colours of other people
        patched = np.where(unknown[..., None], around, filled[window])
        patched[hole] = np.clip(continued[hole], 0, 1)
        hidden = _hide_seam(patched.astype(np.float32), hole, _SEAM * (y1 - y0))
        image[window] = np.where(hole[..., None], hidden, filled[window])
        return image

    def _fill_hole(self, hole: Mask, seed: int) -> Array:
        work, shrink = self._work, self._work.shrink
        maps, horizon = work.inputs.maps, work.inputs.horizon
        guide = self._guide(grow_mask(hole, 2 / shrink))
        forbidden = grow_mask(hole, _BORDER_PX / shrink) | _excluded_pixels(work, hole)
        share = np.where(forbidden, 0, np.where(guide.ground, _ground_share(maps), maps.ground)).astype(np.float32)
        column_settings = ColumnCopySettings().scaled_down(shrink)
        columns = copy_columns(work.image, hole, forbidden | (share > 0.5), guide, horizon, column_settings)
        rest, forbidden = hole & ~columns.copied, forbidden & ~columns.copied
        ground = patch_fill.GroundMaps((work.near < _STOOD_M) | guide.ground, share)
        settings = patch_fill.PatchFillSettings().scaled_down(shrink)
        return patch_fill.fill_patches(
            columns.image, rest, forbidden, horizon, ground, seed, settings, guide.image
        )

    def _guide(self, unknown: Mask) -> street.StreetContinuation:
        """The street continued into unknown pixels (H, W) of the size that is filled."""
        found = self._continue_street(unknown, 2)
        height, width = unknown.shape
        ground = cv2.resize(found.ground.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
        foot = 2 * np.interp(np.arange(width) / 2 - 0.25, np.arange(found.foot.size), found.foot) + 0.5
        return replace(found, image=self._work.enlarge(found.image, unknown), ground=ground, foot=foot)

    def _continue_street(self, unknown: Mask, factor: int) -> street.StreetContinuation:
        """The street at the coarse size; `unknown` is `factor` times as large."""
        coarse = self._coarse
        unknown = _scale_mask(unknown, factor)
        unknown = unknown | _excluded_pixels(coarse, unknown)
        maps = coarse.inputs.maps
        shares = street.StreetShares(
            maps.ground, maps.sky, unknown & (coarse.near < _STOOD_M), _ground_share(maps)
        )
        return street.continue_street(
            coarse.image, unknown, shares, self._coordinates, coarse.inputs.horizon, coarse.shrink
        )


def _hide_seam(filled: Array, hole: Mask, width: float) -> Array:
    """An image (H, W, 3) in which the filled hole (H, W) has the colours around it, smoothed, along its border of this
    width, px: its contour would remind of what stood there.
    """
    around = push_pull(filled, 1 - hole.astype(np.float32))
    smooth = [cv2.GaussianBlur(part, (0, 0), max(width / 2, 1.0)) for part in (around, filled)]
    inside = cv2.distanceTransform(hole.astype(np.uint8), cv2.DIST_L2, 5)
    weight = (hole * np.exp(-inside / max(width, 1.0)))[..., None]
    return np.clip(filled + weight * (smooth[0] - smooth[1]), 0, 1).astype(np.float32)


def _excluded_pixels(view: _View, unknown: Mask) -> Mask:
    """Pixels (H, W), outside the unknown ones, of people and vehicles, labelled or not."""
    maps = view.inputs.maps
    # Light walls and cobbles look somewhat like cars: only a large core with high shares is one.
    core_pixels = ((maps.vehicle > _VEHICLE_SHARE) & ~unknown).astype(np.uint8)
    count, components, stats, _ = cv2.connectedComponentsWithStats(core_pixels)
    min_area = _MIN_CORE_PX / view.shrink**2
    large = [i for i in range(1, count) if stats[i, cv2.CC_STAT_AREA] >= min_area]
    vehicle = np.isin(components, large)
    if large:
        rest = (maps.vehicle > 0.5) & (_ground_share(maps) < 0.5)
        vehicle = vehicle | (grow_mask(vehicle, _AROUND_CORE_PX / view.shrink) & rest)
    near_vehicle = grow_mask(vehicle, _BORDER_PX / view.shrink)
    return view.inputs.excluded | near_vehicle | (maps.person > _PERSON_SHARE)


def _ground_share(maps: Segmentation) -> Array:
    """Share (H, W) of ground in each pixel, given that it shows no vehicle."""
    return np.clip(maps.ground / np.maximum(1 - maps.vehicle, _MIN_REST), 0, 1).astype(np.float32)
