"""The shadows of the cars on the ground: where they are, how dark, and which way the sun throws them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scene_ir.derender.background import push_pull
from scene_ir.derender.silhouette import Placement, grow
from scene_ir.surfaces import shadow_corners, shadow_density, sun_offset
from scene_ir.types import Camera

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

_AZIMUTHS = 24
_LENGTHS = (0.25, 0.5, 0.8, 1.2)
"""Lengths of a shadow over the height of what throws it that are tried: a sun of 76 to 40 degrees."""
_SAMPLES = 6000
"""Ground pixels a car that vote on the sun."""


@dataclass(frozen=True, slots=True)
class ShadowSettings:
    """reach_m: how far from the footprint a shadow is looked for; contact_m: width of the strip around the
    footprint that counts as touching; dark: share of the lit ground's brightness below which ground is shaded;
    gain: by how much an estimated sun must explain the darkness better than the assumed one; rim_m: how far beyond
    the reach shade is followed; open_share: a shadow of which more than this lies out of reach is not a car's.
    """

    reach_m: float = 2.6
    contact_m: float = 0.25
    dark: float = 0.72
    gain: float = 0.03
    rim_m: float = 0.8
    open_share: float = 0.08


@dataclass(frozen=True, slots=True)
class GroundView:
    """What each pixel sees of the plane parallel to the ground through a car's foot, in the car's frame.

    local (H, W, 2) m, (x, z), inf where nothing; distance (H, W) m from the footprint, negative inside.
    """

    local: Array
    distance: Array


@dataclass(frozen=True, slots=True)
class Light:
    """grey (H, W): the photograph's brightness; lit (H, W): how bright the ground would be without cars'
    shadows."""

    grey: Array
    lit: Array


def ground_view(placement: Placement, ground: torch.Tensor, camera: Camera) -> GroundView:
    """The ground around one car as the camera sees it. ground (4,): plane n.x + d = 0."""
    matrix = camera.matrix.double().numpy()
    inverse = np.linalg.inv(matrix[:, :3])
    centre = -inverse @ matrix[:, 3]
    normal = ground[:3].double().numpy()
    foot = placement.translation.double().numpy()
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    ray = inverse[:, 0] * u[..., None] + inverse[:, 1] * v[..., None] + inverse[:, 2]
    slope = ray @ normal
    with np.errstate(divide="ignore", invalid="ignore"):
        step = normal @ (foot - centre) / slope
    seen = np.isfinite(step) & (step > 0) & (step < 400)
    point = centre + np.where(seen, step, 0.0)[..., None] * ray - foot
    cos, sin = math.cos(float(placement.yaw)), math.sin(float(placement.yaw))
    local = np.stack([cos * point[..., 0] - sin * point[..., 2], sin * point[..., 0] + cos * point[..., 2]], -1)
    beyond = np.abs(local) - placement.size_lhw[[0, 2]].double().numpy() / 2
    distance = np.hypot(*np.maximum(beyond, 0).transpose(2, 0, 1)) + np.minimum(beyond.max(-1), 0)
    return GroundView(
        np.where(seen[..., None], local, np.inf).astype(np.float32),
        np.where(seen, distance, np.inf).astype(np.float32),
    )


def light(
    image: Array,
    road: Array,
    vehicles: Mask,
    views: Sequence[GroundView],
    settings: ShadowSettings | None = None,
    behind: Callable[[Mask], Array] | None = None,
) -> Light:
    """Brightness as it is, and of the ground as it would be lit: continued from the road around the cars' places.

    image (H, W, 3); road (H, W) in [0, 1]; vehicles (H, W): all cars' pixels; behind: gives the image (H, W, 3)
    with a mask's pixels continued from the others, so that light and dark strips along the road are no shadows.
    """
    settings = settings or ShadowSettings()
    # The brightest channel: in a shadow all three fall, on a red or blue thing one stays.
    grey = cv2.GaussianBlur(image.max(-1), (0, 0), 1.0)
    zone = np.logical_or.reduce([view.distance < settings.reach_m for view in views]) | grow(vehicles, 3)
    if behind is not None:
        return Light(grey, cv2.GaussianBlur(behind(zone).max(-1), (0, 0), 1.0))
    known = (road > 0.5) & ~zone
    if not known.any():
        known = ~zone
    lit = push_pull(np.ascontiguousarray(grey[..., None]), known.astype(np.float32))[..., 0]
    return Light(grey, lit)


def find(
    lighting: Light,
    vehicles: Mask,
    views: Sequence[GroundView],
    allowed: Sequence[Mask],
    settings: ShadowSettings | None = None,
) -> list[Mask]:
    """Each car's shadow on the visible ground (H, W): darker than the lit ground, joined to the car's foot.

    allowed: ground that each car's shadow can reach. Shade that goes on beyond it is a house's or a tree's: then
    only what is darker than that shade counts.
    """
    settings = settings or ShadowSettings()
    if not views:
        return []
    near = np.stack([view.distance for view in views])
    owner, nearest = near.argmin(0), near.min(0)
    around = (nearest < settings.reach_m + settings.rim_m) & ~vehicles
    dark = around & (lighting.grey < settings.dark * lighting.lit)
    within = np.logical_or.reduce(allowed) & (nearest < settings.reach_m)
    found = []
    for index, view in enumerate(views):
        touching = (view.distance < settings.contact_m) & ~vehicles & (owner == index)
        own = _joined(dark, touching)
        beyond = own & ~within
        if np.count_nonzero(beyond) > settings.open_share * max(np.count_nonzero(own), 1):
            shade = float(np.median(lighting.grey[beyond]))
            own = _joined(dark & (lighting.grey < settings.dark * shade), touching)
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
        closed = cv2.morphologyEx(own.astype(np.uint8), cv2.MORPH_CLOSE, disc) > 0
        found.append(closed & ~vehicles & allowed[index] & (owner == index) & (nearest < settings.reach_m))
    return found


def _joined(candidates: Mask, seeds: Mask) -> Mask:
    """The candidates that hang together with the seeds."""
    _, parts = cv2.connectedComponents((candidates | seeds).astype(np.uint8), connectivity=4)
    return np.isin(parts, np.unique(parts[seeds])) & candidates


def estimate_sun(
    lighting: Light,
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
        ground = (view.distance < settings.reach_m) & ~grow(vehicles, 2) & (owner == index)
        flat = np.nonzero(ground.reshape(-1))[0]
        flat = flat[:: max(1, len(flat) // _SAMPLES)]
        if not len(flat):
            continue
        points.append(torch.from_numpy(view.local.reshape(-1, 2)[flat]))
        sizes.append(placement.size_lhw.detach().expand(len(flat), 3))
        yaws.append(placement.yaw.detach().expand(len(flat)))
        shade = 1 - lighting.grey.reshape(-1)[flat] / np.maximum(lighting.lit.reshape(-1)[flat], 0.02)
        darkness.append(torch.from_numpy(np.clip(shade, 0, 1)))
    if not points:
        return assumed
    local, size, yaw = torch.cat(points), torch.cat(sizes), torch.cat(yaws)
    observed = torch.cat(darkness)

    def explained(sun: torch.Tensor) -> float:
        model = shadow_density(local, size, sun_offset(sun, yaw, size[:, 1]))
        strength = (model * observed).sum() / model.square().sum().clamp(min=1e-6)
        rest = (observed - strength.clamp(0.0, 1.2) * model).square().sum()
        return 1 - float(rest / observed.square().sum().clamp(min=1e-6))

    best, score = assumed, explained(assumed) + settings.gain
    for length in _LENGTHS:
        for step in range(_AZIMUTHS):
            angle = 2 * math.pi * step / _AZIMUTHS
            sun = torch.tensor([length * math.cos(angle), -1.0, length * math.sin(angle)])
            sun = sun / sun.norm()
            value = explained(sun)
            if value > score:
                best, score = sun, value
    return best


def reachable(placement: Placement, view: GroundView, sun: torch.Tensor) -> Mask:
    """Ground (H, W) that the renderer's patch for this car's shadow covers."""
    size = placement.size_lhw.detach()[None]
    offset = sun_offset(sun, placement.yaw.detach()[None], size[:, 1])
    corners = shadow_corners(size, offset)[0].numpy()
    low, high = corners.min(0), corners.max(0)
    return ((view.local > low + 0.05) & (view.local < high - 0.05)).all(-1)


def factors(image: Array, background: Array, region: Mask) -> Array:
    """The factor (H, W, 3) in [0, 1] by which one car darkens the ground: photograph / background in its
    `region`."""
    seen = np.clip(image / np.maximum(background, 1 / 255), 0, 1)
    return np.where(region[..., None], seen, 1).astype(np.float32)
