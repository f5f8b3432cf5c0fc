"""The shadows of the cars on the ground: where they are, how dark, and which way the sun throws them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scene_ir.derender.silhouette import Placement, grow_mask, mask_bounds
from scene_ir.image_filters import push_pull
from scene_ir.render.surfaces import shadow_corners, shadow_density, shadow_offset
from scene_ir.types import Camera

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

_AZIMUTHS = 24
_LENGTHS = (0.25, 0.5, 0.8, 1.2, 1.7, 2.3)
"""Lengths of a shadow over the height of what throws it that are tried: a sun of 76 to 23 degrees."""
_EVERY, _LIKELY = 4, 10
"""Of the pixels every fourth says which suns are the likeliest; among so many of them all pixels choose."""
_FINER = 3
"""How often azimuth and length are searched again around the best ones, each time in steps half as large."""
_LOW = 0.04
"""How much better than a sun of 40 degrees one must explain the darkness whose shadows are longer by a height:
long ones meet more that is dark for other reasons."""
STRETCHES = (1.0, 1.25, 1.5)
"""Of a sun's shadows, tried in turn where theirs go on beyond what was expected."""
MAX_SPILL_RATIO = 0.5
"""Share of the dark pixels beyond reach that may be left for longer shadows to be believed."""
_CAST = 0.12
"""Darkness of the box shadow from which on a pixel counts as shaded by it."""
_CORE = 0.4
"""Darkness of the box shadow from which on dark ground is the car's without hanging together with its foot."""
_SAMPLES = 6000
"""Ground pixels a car that vote on the sun: with a third of them it is found behind the street on some frames."""
_AROUND_M, _AROUND_PX = 6.0, 8
"""How far around a footprint the ground is looked at: farther than shadows are looked for, and grown."""
_NEAR_M = 0.1
"""Ground that is nearer to the camera's plane is in no photograph."""


@dataclass(frozen=True, slots=True)
class ShadowSettings:
    """reach_m: how far from the footprint most shadows end, so that the ground beyond tells how bright it is lit;
    far_m: how far from it a shadow is looked for; contact_m: width of the strip around the footprint that counts
    as touching; dark: share of the lit ground's brightness below which ground is shaded; soft: likewise, of the
    rim of a shadow; gain: by how much an estimated sun must explain the darkness better than the assumed one;
    rim_m: how far beyond the reach shade is followed; open_share: a shadow of which more than this lies out of
    reach is not a car's; loose_m: how far true shadows leave that of a box.
    """

    reach_m: float = 2.6
    far_m: float = 4.0
    contact_m: float = 0.25
    dark: float = 0.72
    gain: float = 0.03
    soft: float = 0.86
    rim_m: float = 0.8
    open_share: float = 0.08
    loose_m: float = 0.35


@dataclass(frozen=True, slots=True)
class GroundView:
    """What each pixel sees of the plane parallel to the ground through a car's foot, in the car's frame, some
    metres around the footprint.

    local (H, W, 2) m, (x, z), inf where nothing; distance (H, W) m from the footprint, negative inside, inf where
    nothing; window: rows and columns beyond which there is nothing.
    """

    local: Array
    distance: Array
    window: tuple[slice, slice]


@dataclass(frozen=True, slots=True)
class GroundLight:
    """grey (H, W): the photograph's brightness; lit (H, W): how bright the ground would be without cars'
    shadows."""

    grey: Array
    lit: Array


def view_ground(placement: Placement, ground: torch.Tensor, camera: Camera) -> GroundView:
    """The ground around one car as the camera sees it. ground (4,): plane n.x + d = 0."""
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
    window = _pictured(matrix[:, :3] @ (along + foot[:, None]) + matrix[:, 3:], camera)
    v, u = (np.arange(part.start, part.stop, dtype=np.float64) for part in window)
    v = v[:, None]
    ray = [inverse[i, 0] * u + inverse[i, 1] * v + inverse[i, 2] for i in range(3)]
    slope = normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        step = normal @ (foot - centre) / slope
    seen = np.isfinite(step) & (step > 0) & (step < 400)
    step = np.where(seen, step, 0.0)
    east, north = (centre[i] - foot[i] + step * ray[i] for i in (0, 2))
    local = np.stack([cos * east - sin * north, sin * east + cos * north], -1)
    across, ahead = np.abs(local[..., 0]) - half[0], np.abs(local[..., 1]) - half[1]
    apart = np.hypot(np.maximum(across, 0), np.maximum(ahead, 0)) + np.minimum(np.maximum(across, ahead), 0)
    view = GroundView(
        np.full((camera.height, camera.width, 2), np.inf, np.float32),
        np.full((camera.height, camera.width), np.inf, np.float32),
        window,
    )
    view.local[window] = np.where(seen[..., None], local, np.inf)
    view.distance[window] = np.where(seen, apart, np.inf)
    return view


def _pictured(corners: NDArray[np.float64], camera: Camera) -> tuple[slice, slice]:
    """Rows and columns of the image around a convex polygon's picture. corners (3, K): in clip space, in turn."""
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
    image: Array,
    road: Array,
    vehicles: Mask,
    views: Sequence[GroundView],
    settings: ShadowSettings | None = None,
    behind: Callable[[Mask], Array] | None = None,
) -> GroundLight:
    """Brightness as it is, and of the ground as it would be lit: continued from the road around the cars' places.

    image (H, W, 3); road (H, W) in [0, 1]; vehicles (H, W): all cars' pixels; behind: gives the image (H, W, 3)
    with a mask's pixels continued from the others, so that light and dark strips along the road are no shadows.
    """
    settings = settings or ShadowSettings()
    grey = _brightness(image)
    zone = np.logical_or.reduce([view.distance < settings.reach_m for view in views]) | grow_mask(vehicles, 3)
    if behind is not None:
        return GroundLight(grey, _brightness(behind(zone)))
    known = (road > 0.5) & ~zone
    if not known.any():
        known = ~zone
    lit = push_pull(np.ascontiguousarray(grey[..., None]), known.astype(np.float32))[..., 0]
    return GroundLight(grey, lit)


def _brightness(image: Array) -> Array:
    """The brightest channel (H, W) of an image (H, W, 3), smoothed: in a shadow all three fall, on a red or blue
    thing one stays."""
    # Many times as fast as numpy's maximum over an axis of three.
    brightest = np.maximum(np.maximum(image[..., 0], image[..., 1]), image[..., 2])
    return np.asarray(cv2.GaussianBlur(brightest, (0, 0), 1.0), np.float32)


def cast_box_shadow(placement: Placement, view: GroundView, sun: torch.Tensor) -> Array:
    """How dark (H, W), in [0, 1], the car's box makes the ground in this sun; 0 where it cannot reach."""
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
    settings: ShadowSettings | None = None,
) -> tuple[list[Mask], int]:
    """Each car's shadow on the visible ground (H, W): darker than the lit ground, joined to the car's foot; and
    how many dark pixels go on beyond reach.

    allowed: ground that each car's shadow can reach; casts: how dark (H, W) each car's box makes it. Shade that
    goes on beyond reach is a house's or a tree's: then only what is darker than it counts, and what is dark in the
    box's shadow but lit around it.
    """
    settings = settings or ShadowSettings()
    if not views:
        return [], 0
    frame = vehicles.shape
    part = _all_windows(views)
    lighting = GroundLight(lighting.grey[part], lighting.lit[part])
    vehicles, allowed, casts = vehicles[part], [a[part] for a in allowed], [c[part] for c in casts]
    near = np.stack([view.distance[part] for view in views])
    owner, nearest = near.argmin(0), near.min(0)
    around = (nearest < settings.far_m + settings.rim_m) & ~vehicles
    free = around & (np.max(casts, axis=0) < _CAST) & (nearest > settings.loose_m)
    open_light = push_pull(np.ascontiguousarray(lighting.grey[..., None]), free.astype(np.float32))[..., 0]
    dark = around & (lighting.grey < settings.dark * np.maximum(lighting.lit, open_light))
    stands_out = dark & (lighting.grey < settings.dark * open_light)
    within = np.logical_or.reduce(allowed) & (nearest < settings.far_m)
    soft = around & (lighting.grey < settings.soft * lighting.lit) & (lighting.grey < settings.soft * open_light)
    found, spilled = [], 0
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    for index in range(len(views)):
        touching = (near[index] < settings.contact_m) & ~vehicles & (owner == index)
        core = stands_out & (casts[index] > _CORE)
        own = _joined(dark, touching)
        beyond = own & ~within
        if np.count_nonzero(beyond) > settings.open_share * max(np.count_nonzero(own), 1):
            shade = float(np.median(lighting.grey[beyond]))
            own = _joined(dark & (lighting.grey < settings.dark * shade), touching)
            own |= _joined(stands_out & (casts[index] > _CAST), core)
            spilled += int(np.count_nonzero(beyond))
        else:
            own |= _joined(stands_out, core)
        own |= _joined(soft & (casts[index] > _CAST), own)
        closed = cv2.morphologyEx(own.astype(np.uint8), cv2.MORPH_CLOSE, disc) > 0
        mask = np.zeros(frame, bool)
        mask[part] = closed & ~vehicles & allowed[index] & (owner == index) & (nearest < settings.far_m)
        found.append(mask)
    return found, spilled


def _all_windows(views: Sequence[GroundView]) -> tuple[slice, slice]:
    """Rows and columns beyond which there is nothing in any of the views; of at least one pixel."""
    spans = [[(view.window[axis].start, view.window[axis].stop) for view in views] for axis in (0, 1)]
    starts, stops = zip(*((min(a for a, _ in span), max(b for _, b in span)) for span in spans), strict=True)
    return slice(starts[0], max(stops[0], starts[0] + 1)), slice(starts[1], max(stops[1], starts[1] + 1))


def _joined(candidates: Mask, seeds: Mask) -> Mask:
    """The candidates that hang together with the seeds."""
    count, found = cv2.connectedComponents((candidates | seeds).astype(np.uint8), connectivity=4)
    parts = np.asarray(found, np.int64)
    wanted = np.zeros(count, bool)
    wanted[parts[seeds]] = True
    return wanted[parts] & candidates


def estimate_sun(
    lighting: GroundLight,
    vehicles: Mask,
    placements: Sequence[Placement],
    views: Sequence[GroundView],
    assumed: torch.Tensor,
    settings: ShadowSettings | None = None,
) -> torch.Tensor:
    """The direction towards the sun (3,) whose box shadows explain best how dark the ground around the cars is.

    Tries azimuths and heights; keeps `assumed` unless another one explains clearly more.
    """
    settings = settings or ShadowSettings()
    points, sizes, yaws, darkness = [], [], [], []
    owner = np.stack([view.distance for view in views]).argmin(0)
    for index, (placement, view) in enumerate(zip(placements, views, strict=True)):
        ground = (view.distance < settings.reach_m) & ~grow_mask(vehicles, 2) & (owner == index)
        flat = np.nonzero(ground.reshape(-1))[0]
        flat = flat[:: max(1, len(flat) // _SAMPLES)]
        if not len(flat):
            continue
        points.append(torch.from_numpy(view.local.reshape(-1, 2)[flat]))
        sizes.append(placement.size_lhw.detach())
        yaws.append(placement.yaw.detach())
        shade = 1 - lighting.grey.reshape(-1)[flat] / np.maximum(lighting.lit.reshape(-1)[flat], 0.02)
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

    def worth(places: Sequence[tuple[float, float]], every: int = 1) -> list[float]:
        lengths = [length for length, _ in places]
        shares = explained([_sun(*place) for place in places], every)
        return [share - _LOW * max(length - 1.2, 0.0) for share, length in zip(shares, lengths, strict=True)]

    score, best = explained([assumed])[0] + settings.gain, None
    tried = [(length, 2 * math.pi * step / _AZIMUTHS) for length in _LENGTHS for step in range(_AZIMUTHS)]
    likely = [tried[place] for place in np.argsort(worth(tried, _EVERY))[: -_LIKELY - 1 : -1]]
    for place, value in zip(likely, worth(likely), strict=True):
        if value > score:
            score, best = value, place
    if best is None:
        return assumed
    turn, stretch = math.pi / _AZIMUTHS, 1.2
    for _ in range(_FINER):
        length, angle = best
        around = [
            (length * stretch, angle),
            (length / stretch, angle),
            (length, angle + turn),
            (length, angle - turn),
        ]
        for near, value in zip(around, worth(around), strict=True):
            if value > score:
                score, best = value, near
        turn, stretch = turn / 2, math.sqrt(stretch)
    return _sun(*best)


def lengthen_shadows(sun: torch.Tensor, factor: float) -> torch.Tensor:
    """Towards the sun (3,) whose shadows are `factor` times as long as those of `sun` (3,)."""
    lower = sun * sun.new_tensor([factor, 1.0, factor])
    return lower / lower.norm()


def _sun(length: float, angle: float) -> torch.Tensor:
    """Towards a sun (3,) that throws shadows of `length` heights; angle: rad from x to z."""
    sun = torch.tensor([length * math.cos(angle), -1.0, length * math.sin(angle)])
    return sun / sun.norm()


def reachable_ground(placement: Placement, view: GroundView, sun: torch.Tensor) -> Mask:
    """Ground (H, W) that the renderer's patch for this car's shadow covers."""
    size = placement.size_lhw.detach()[None]
    offset = shadow_offset(sun, placement.yaw.detach()[None], size[:, 1])
    corners = shadow_corners(size, offset)[0].numpy()
    low, high = corners.min(0), corners.max(0)
    low, high = low + 0.05, high - 0.05
    x, z = view.local[view.window][..., 0], view.local[view.window][..., 1]
    reach = np.zeros(view.distance.shape, bool)
    reach[view.window] = (x > low[0]) & (x < high[0]) & (z > low[1]) & (z < high[1])
    return reach


def shadow_factors(image: Array, background: Array, region: Mask) -> Array:
    """The factor (H, W, 3) in [0, 1] by which one car darkens the ground: photograph / background in its
    `region`."""
    factor = np.ones(image.shape, np.float32)
    if region.any():
        x0, y0, x1, y1 = mask_bounds(region)
        part = slice(y0, y1), slice(x0, x1)
        seen = np.clip(image[part] / np.maximum(background[part], 1 / 255), 0, 1)
        factor[part] = np.where(region[part][..., None], seen, 1)
    return factor
