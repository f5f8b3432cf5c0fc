"""Shadows of vehicles on the ground: their pixels, their factors, and the direction of the sun."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scene_ir.derender.silhouette import Placement, grow_mask
from scene_ir.image_filters import channel_max, push_pull
from scene_ir.render.surfaces import shadow_corners, shadow_density, shadow_offset
from scene_ir.types import Camera

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]
Window = tuple[slice, slice]

_AZIMUTHS = 24
_LENGTHS = (0.25, 0.5, 0.8, 1.2, 1.7, 2.3)
"""Tried shadow lengths, over the height of the vehicle: sun elevations from 76 to 23 degrees."""
_STRIDE, _SHORTLIST = 4, 10
"""Every fourth pixel shortlists this many suns; all pixels choose among them."""
_REFINEMENTS = 3
"""Rounds of search around the best azimuth and length, each with half the step."""
_LENGTH_COST = 0.04
"""Cost, in explained variance, of each height of shadow length beyond 1.2: longer shadows cover more ground that
is dark for other reasons."""
_GAIN = 0.03
"""Explained variance by which an estimated sun must surpass the assumed one."""
STRETCHES = (1.0, 1.25, 1.5)
"""Factors of shadow length, tried in turn while shadows extend beyond the expected reach."""
MAX_SPILL_RATIO = 0.5
"""Share of the dark pixels beyond reach that may remain for a longer shadow to be accepted."""
_BOX_SHADOW = 0.12
"""Darkness of the box shadow from which a pixel counts as shaded by it."""
_CORE = 0.4
"""Darkness of the box shadow from which dark ground is the vehicle's shadow even if it does not touch its foot."""
_DARK, _SOFT = 0.72, 0.86
"""Share of the lit ground's brightness below which ground is shaded, and below which it is a shadow's rim."""
_REACH_M = 2.6
"""Distance from the footprint at which most shadows end: the ground beyond shows the lit brightness."""
_FAR_M = 4.0
"""Largest distance of a shadow from the footprint."""
_RIM_M = 0.8
"""How far beyond that shade is followed."""
_CONTACT_M = 0.25
"""Width of the strip around the footprint that counts as touching."""
_LOOSE_M = 0.35
"""How far true shadows extend beyond a box's."""
_SPILL_SHARE = 0.08
"""A shadow with more than this share beyond reach is a house's or a tree's."""
_SAMPLES = 6000
"""Ground pixels per vehicle that vote on the sun; with a third of them it is wrong on some frames."""
_AROUND_M, _AROUND_PX = 6.0, 8
"""Extent of the ground around a footprint: farther than shadows reach, and are grown."""
_NEAR_M = 0.1
"""Ground nearer to the camera's plane is in no photograph."""


@dataclass(frozen=True, slots=True)
class GroundView:
    """The ground plane through a vehicle's foot, as seen at each pixel near its footprint, in the
    vehicle's frame.
    """

    window: Window
    """Rows and columns of the photograph with the ground near the footprint."""
    local: Array
    """(h, w, 2) m, (x, z), of the window's pixels; inf where they show no ground."""
    distance: Array
    """(h, w) m from the footprint, negative inside; inf where they show no ground."""

    def in_frame(self, values: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
        """Values (h, w) of the window in a photograph of a shape (H, W), 0 elsewhere."""
        frame = np.zeros(shape[:2], values.dtype)
        frame[self.window] = values
        return frame


@dataclass(frozen=True, slots=True)
class GroundLight:
    """Brightness of the photograph and of its ground without the vehicles' shadows."""

    grey: Array
    """(H, W) in [0, 1], the photograph's brightness."""
    lit: Array
    """(H, W) in [0, 1], the ground's brightness without shadows."""


def view_ground(placement: Placement, ground: torch.Tensor, camera: Camera) -> GroundView:
    """Map pixels to the ground around one vehicle.

    Args:
        placement: The vehicle.
        ground: Plane (4,) n.x + d = 0.
        camera: The photograph's camera.

    Returns:
        The pixels' positions on the ground.
    """
    matrix = camera.matrix.double().numpy()
    inverse = np.linalg.inv(matrix[:, :3])
    centre = -inverse @ matrix[:, 3]
    normal = ground[:3].double().numpy()
    foot = placement.translation.double().numpy()
    half = placement.size_lhw[[0, 2]].double().numpy() / 2
    cos, sin = math.cos(float(placement.yaw)), math.sin(float(placement.yaw))
    reach = half + _AROUND_M
    x, z = np.array([[1, 1, -1, -1], [1, -1, -1, 1]]) * reach[:, None]
    along = np.stack([cos * x + sin * z, np.zeros(4), cos * z - sin * x])
    along[1] = -(normal[0] * along[0] + normal[2] * along[2]) / normal[1]
    window = _image_window(matrix[:, :3] @ (along + foot[:, None]) + matrix[:, 3:], camera)
    v, u = (np.arange(part.start, part.stop, dtype=np.float64) for part in window)
    v = v[:, None]
    ray = [inverse[i, 0] * u + inverse[i, 1] * v + inverse[i, 2] for i in range(3)]
    slope = normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        step = normal @ (foot - centre) / slope
    hit = np.isfinite(step) & (step > 0) & (step < 400)
    step = np.where(hit, step, 0.0)
    east, north = (centre[i] - foot[i] + step * ray[i] for i in (0, 2))
    local = np.stack([cos * east - sin * north, sin * east + cos * north], -1)
    across, ahead = np.abs(local[..., 0]) - half[0], np.abs(local[..., 1]) - half[1]
    apart = np.hypot(np.maximum(across, 0), np.maximum(ahead, 0)) + np.minimum(np.maximum(across, ahead), 0)
    return GroundView(
        window,
        np.where(hit[..., None], local, np.inf).astype(np.float32),
        np.where(hit, apart, np.inf).astype(np.float32),
    )


def nearest_views(views: Sequence[GroundView], shape: tuple[int, ...]) -> tuple[NDArray[np.int64], Array]:
    """The view (H, W) of each pixel of a photograph with the nearest footprint, 0 where there is none, and the
    distance (H, W) m, inf where there is none.
    """
    owner, nearest = np.zeros(shape[:2], np.int64), np.full(shape[:2], np.inf, np.float32)
    for index, view in enumerate(views):
        closer = view.distance < nearest[view.window]
        owner[view.window][closer] = index
        nearest[view.window][closer] = view.distance[closer]
    return owner, nearest


def _image_window(corners: NDArray[np.float64], camera: Camera) -> Window:
    """Rows and columns of the image around a convex polygon with corners (3, K) in clip space, in order."""
    depth = corners[2] - _NEAR_M
    following, after = np.roll(corners, -1, 1), np.roll(depth, -1)
    crossing = depth * after < 0
    share = depth[crossing] / (depth - after)[crossing]
    cut = corners[:, crossing] + share * (following - corners)[:, crossing]
    points = np.concatenate([corners[:, depth >= 0], cut], 1)
    if not points.size:
        return slice(0, 0), slice(0, 0)
    pixels = points[:2] / points[2]
    limit = np.array([camera.width, camera.height])
    x0, y0 = np.clip(pixels.min(1) - _AROUND_PX, 0, limit).astype(int).tolist()
    x1, y1 = np.clip(np.ceil(pixels.max(1)) + _AROUND_PX + 1, 0, limit).astype(int).tolist()
    return slice(y0, y1), slice(x0, x1)


def estimate_ground_light(
    image: Array, vehicles: Mask, views: Sequence[GroundView], continue_street: Callable[[Mask], Array]
) -> GroundLight:
    """Brightness of the photograph, and of its ground continued over the area of shadows.

    Args:
        image: The photograph (H, W, 3).
        vehicles: All vehicles' pixels (H, W).
        views: The ground around each vehicle.
        continue_street: The image (H, W, 3) with a mask's pixels continued from the others along the road, so that
            light and dark strips of the road do not count as shadows.

    Returns:
        Both brightnesses.
    """
    zone = (nearest_views(views, vehicles.shape)[1] < _REACH_M) | grow_mask(vehicles, 3)
    return GroundLight(_brightness(image), _brightness(continue_street(zone)))


def _brightness(image: Array) -> Array:
    """The brightest channel (H, W) of an image (H, W, 3), smoothed: in a shadow all channels are dark, on a red or
    blue surface one stays bright.
    """
    return np.asarray(cv2.GaussianBlur(channel_max(image), (0, 0), 1.0), np.float32)


def cast_box_shadow(placement: Placement, view: GroundView, sun: torch.Tensor) -> Array:
    """Darkness of the ground in the shadow of a vehicle's box.

    Args:
        placement: The vehicle.
        view: The ground around it.
        sun: Direction (3,) towards the sun.

    Returns:
        (h, w) in [0, 1], of the view's window; 0 out of the shadow's reach.
    """
    dark = np.zeros(view.distance.shape, np.float32)
    near = reachable_ground(placement, view, sun)
    local = torch.from_numpy(view.local[near])
    size = placement.size_lhw.detach()[None]
    offset = shadow_offset(sun, placement.yaw.detach()[None], size[:, 1])
    dark[near] = shadow_density(local, size.expand(len(local), 3), offset.expand(len(local), 2)).numpy()
    return dark


def find_shadows(
    lighting: GroundLight,
    vehicles: Mask,
    views: Sequence[GroundView],
    allowed: Sequence[Mask],
    casts: Sequence[Array],
) -> tuple[list[Mask], int]:
    """Find each vehicle's shadow on the visible ground: darker than the lit ground and connected to its foot.

    Shade that extends beyond reach is a house's or a tree's: then only ground darker than it counts, and ground
    that is dark in the box's shadow but lit around it.

    Args:
        lighting: Actual and shadow-free brightness.
        vehicles: All vehicles' pixels (H, W).
        views: The ground around each vehicle.
        allowed: Ground (h, w) of each view's window that the vehicle's shadow can reach.
        casts: Darkness (h, w) there of each vehicle's box shadow.

    Returns:
        Each vehicle's shadow (h, w) in its view's window, and the number of dark pixels beyond reach.
    """
    if not views:
        return [], 0
    part = _union_window(views)
    lighting, vehicles = GroundLight(lighting.grey[part], lighting.lit[part]), vehicles[part]
    windows = [_relative_window(view.window, part) for view in views]
    views = [replace(view, window=window) for view, window in zip(views, windows, strict=True)]
    owner, nearest = nearest_views(views, vehicles.shape)
    darkest, reached = np.zeros(vehicles.shape, np.float32), np.zeros(vehicles.shape, bool)
    for window, cast, ground in zip(windows, casts, allowed, strict=True):
        darkest[window] = np.maximum(darkest[window], cast)
        reached[window] |= ground
    around = (nearest < _FAR_M + _RIM_M) & ~vehicles
    free = around & (darkest < _BOX_SHADOW) & (nearest > _LOOSE_M)
    open_light = push_pull(np.ascontiguousarray(lighting.grey[..., None]), free.astype(np.float32))[..., 0]
    dark = around & (lighting.grey < _DARK * np.maximum(lighting.lit, open_light))
    stands_out = dark & (lighting.grey < _DARK * open_light)
    within = reached & (nearest < _FAR_M)
    soft = around & (lighting.grey < _SOFT * lighting.lit) & (lighting.grey < _SOFT * open_light)
    shadows, spilled = [], 0
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    for index, (view, ground, cast) in enumerate(zip(views, allowed, casts, strict=True)):
        cast = view.in_frame(cast, vehicles.shape)
        touching = view.in_frame(view.distance < _CONTACT_M, vehicles.shape) & ~vehicles & (owner == index)
        core = stands_out & (cast > _CORE)
        own = _connected_to(dark, touching)
        beyond = own & ~within
        if np.count_nonzero(beyond) > _SPILL_SHARE * max(np.count_nonzero(own), 1):
            shade = float(np.median(lighting.grey[beyond]))
            own = _connected_to(dark & (lighting.grey < _DARK * shade), touching)
            own |= _connected_to(stands_out & (cast > _BOX_SHADOW), core)
            spilled += int(np.count_nonzero(beyond))
        else:
            own |= _connected_to(stands_out, core)
        own |= _connected_to(soft & (cast > _BOX_SHADOW), own)
        closed = cv2.morphologyEx(own.astype(np.uint8), cv2.MORPH_CLOSE, disc) > 0
        shadow = closed & ~vehicles & (owner == index) & (nearest < _FAR_M)
        shadows.append(shadow[view.window] & ground)
    return shadows, spilled


def _relative_window(window: Window, part: Window) -> Window:
    """A window's rows and columns within a part of the photograph that holds it."""
    rows, columns = (
        slice(one.start - of.start, one.stop - of.start) for one, of in zip(window, part, strict=True)
    )
    return rows, columns


def _union_window(views: Sequence[GroundView]) -> Window:
    """The window of at least one pixel that holds all views' windows."""
    spans = [[(view.window[axis].start, view.window[axis].stop) for view in views] for axis in (0, 1)]
    starts, stops = zip(*((min(a for a, _ in span), max(b for _, b in span)) for span in spans), strict=True)
    return slice(starts[0], max(stops[0], starts[0] + 1)), slice(starts[1], max(stops[1], starts[1] + 1))


def _connected_to(candidates: Mask, seeds: Mask) -> Mask:
    """The candidates connected to the seeds."""
    count, components = cv2.connectedComponents((candidates | seeds).astype(np.uint8), connectivity=4)
    parts = np.asarray(components, np.int64)
    wanted = np.zeros(count, bool)
    wanted[parts[seeds]] = True
    return wanted[parts] & candidates


def estimate_sun(
    lighting: GroundLight,
    vehicles: Mask,
    placements: Sequence[Placement],
    views: Sequence[GroundView],
    assumed: torch.Tensor,
) -> torch.Tensor:
    """Estimate the sun with the box shadows that best explain how dark the ground around the vehicles is.

    Args:
        lighting: Actual and shadow-free brightness.
        vehicles: All vehicles' pixels (H, W).
        placements: The vehicles.
        views: The ground around each of them.
        assumed: Direction (3,) towards the sun that is returned unless another one explains clearly more.

    Returns:
        Direction (3,) towards the sun.
    """
    points, sizes, yaws, darkness = [], [], [], []
    owner, _ = nearest_views(views, vehicles.shape)
    outside = ~grow_mask(vehicles, 2)
    for index, (placement, view) in enumerate(zip(placements, views, strict=True)):
        ground = (view.distance < _REACH_M) & outside[view.window] & (owner[view.window] == index)
        flat = np.nonzero(ground.reshape(-1))[0]
        flat = flat[:: max(1, len(flat) // _SAMPLES)]
        if not len(flat):
            continue
        points.append(torch.from_numpy(view.local.reshape(-1, 2)[flat]))
        sizes.append(placement.size_lhw.detach())
        yaws.append(placement.yaw.detach())
        grey, lit = (light[view.window].reshape(-1)[flat] for light in (lighting.grey, lighting.lit))
        shade = 1 - grey / np.maximum(lit, 0.02)
        darkness.append(torch.from_numpy(np.clip(shade, 0, 1)))
    if not points:
        return assumed
    local, size, yaw = torch.cat(points), torch.stack(sizes), torch.stack(yaws)
    observed = torch.cat(darkness)
    car = torch.arange(len(points)).repeat_interleave(torch.tensor([len(part) for part in points]))
    sized = size[car]

    def explained(suns: Sequence[torch.Tensor], every: int = 1) -> list[float]:
        offset = torch.stack([shadow_offset(sun, yaw, size[:, 1]) for sun in suns])[:, car[::every]]
        model, dark = shadow_density(local[::every], sized[::every], offset), observed[::every]
        strength = (model * dark).sum(-1) / model.square().sum(-1).clamp(min=1e-6)
        rest = (dark - strength.clamp(0.0, 1.2)[:, None] * model).square().sum(-1)
        return (1 - rest.double() / dark.square().sum().clamp(min=1e-6)).tolist()

    def rate(places: Sequence[tuple[float, float]], every: int = 1) -> list[float]:
        lengths = [length for length, _ in places]
        shares = explained([_sun_direction(*place) for place in places], every)
        return [
            share - _LENGTH_COST * max(length - 1.2, 0.0) for share, length in zip(shares, lengths, strict=True)
        ]

    score, best = explained([assumed])[0] + _GAIN, None
    tried = [(length, 2 * math.pi * step / _AZIMUTHS) for length in _LENGTHS for step in range(_AZIMUTHS)]
    shortlist = [tried[place] for place in np.argsort(rate(tried, _STRIDE))[: -_SHORTLIST - 1 : -1]]
    for place, value in zip(shortlist, rate(shortlist), strict=True):
        if value > score:
            score, best = value, place
    if best is None:
        return assumed
    turn, stretch = math.pi / _AZIMUTHS, 1.2
    for _ in range(_REFINEMENTS):
        length, angle = best
        around = [
            (length * stretch, angle),
            (length / stretch, angle),
            (length, angle + turn),
            (length, angle - turn),
        ]
        for near, value in zip(around, rate(around), strict=True):
            if value > score:
                score, best = value, near
        turn, stretch = turn / 2, math.sqrt(stretch)
    return _sun_direction(*best)


def lengthen_shadows(sun: torch.Tensor, factor: float) -> torch.Tensor:
    """Direction (3,) towards a sun with shadows `factor` times as long as those of `sun` (3,)."""
    lower = sun * sun.new_tensor([factor, 1.0, factor])
    return lower / lower.norm()


def _sun_direction(length: float, angle: float) -> torch.Tensor:
    """Direction (3,) towards a sun that casts shadows of `length` heights, at `angle` rad from x to z."""
    sun = torch.tensor([length * math.cos(angle), -1.0, length * math.sin(angle)])
    return sun / sun.norm()


def reachable_ground(placement: Placement, view: GroundView, sun: torch.Tensor) -> Mask:
    """Ground that the renderer's patch for a vehicle's shadow covers.

    Args:
        placement: The vehicle.
        view: The ground around it.
        sun: Direction (3,) towards the sun.

    Returns:
        Mask (h, w) of the view's window.
    """
    size = placement.size_lhw.detach()[None]
    offset = shadow_offset(sun, placement.yaw.detach()[None], size[:, 1])
    corners = shadow_corners(size, offset)[0].numpy()
    low, high = corners.min(0), corners.max(0)
    low, high = low + 0.05, high - 0.05
    x, z = view.local[..., 0], view.local[..., 1]
    return (x > low[0]) & (x < high[0]) & (z > low[1]) & (z < high[1])


def shadow_factors(image: Array, background: Array, region: Mask) -> Array:
    """Factor by which one vehicle darkens the ground: photograph / background.

    Args:
        image: The photograph (H, W, 3), or a part of it.
        background: The background (H, W, 3).
        region: The vehicle's shadow (H, W).

    Returns:
        (H, W, 3) in [0, 1]; 1 outside the region.
    """
    seen = np.clip(image / np.maximum(background, 1 / 255), 0, 1)
    return np.where(region[..., None], seen, 1).astype(np.float32)
