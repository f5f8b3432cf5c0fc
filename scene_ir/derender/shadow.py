"""The shadows of the cars on the ground: where they are, and how dark."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scene_ir.derender.background import push_pull
from scene_ir.derender.silhouette import Placement, grow
from scene_ir.types import Camera

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class ShadowSettings:
    """reach_m: how far from the footprint a shadow is looked for; contact_m: width of the strip around the footprint
    that counts as touching; dark: share of the lit ground's brightness below which ground is shaded.
    """

    reach_m: float = 2.0
    contact_m: float = 0.25
    dark: float = 0.72


def footprint_distance(placement: Placement, ground: torch.Tensor, camera: Camera) -> Array:
    """Distance (H, W) m from the footprint, along the plane parallel to the ground through the car's foot, of the
    point that each pixel sees of this plane; negative inside, inf above the horizon and far away.
    """
    matrix = camera.matrix.double().numpy()
    inverse = np.linalg.inv(matrix[:, :3])
    centre = -inverse @ matrix[:, 3]
    normal = ground[:3].double().numpy()
    foot = placement.translation.double().numpy()
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    ray = np.einsum("ij,jhw->hwi", inverse, np.stack([u, v, np.ones_like(u)]).astype(np.float64))
    slope = ray @ normal
    with np.errstate(divide="ignore", invalid="ignore"):
        step = normal @ (foot - centre) / slope
    seen = np.isfinite(step) & (step > 0) & (step < 400)
    point = centre + np.where(seen, step, 0.0)[..., None] * ray - foot
    cos, sin = np.cos(float(placement.yaw)), np.sin(float(placement.yaw))
    along = np.abs(cos * point[..., 0] - sin * point[..., 2]) - float(placement.size_lhw[0]) / 2
    across = np.abs(sin * point[..., 0] + cos * point[..., 2]) - float(placement.size_lhw[2]) / 2
    distance = np.hypot(np.maximum(along, 0), np.maximum(across, 0)) + np.minimum(np.maximum(along, across), 0)
    return np.where(seen, distance, np.inf).astype(np.float32)


def find(
    image: Array, road: Array, vehicles: Mask, distances: list[Array], settings: ShadowSettings | None = None
) -> list[Mask]:
    """Each car's shadow on the visible ground (H, W): darker than the lit road around, joined to the car's foot.

    image (H, W, 3); road (H, W) in [0, 1]; vehicles (H, W): all cars' pixels; distances: of `footprint_distance`.
    """
    settings = settings or ShadowSettings()
    if not distances:
        return []
    near = np.stack(distances)
    owner = near.argmin(0)
    nearest = near.min(0)
    zone = (nearest < settings.reach_m) & ~vehicles
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
    lit = (road > 0.5) & ~zone & ~grow(vehicles, 3)
    if not lit.any():
        lit = ~zone & ~grow(vehicles, 3)
    reference = push_pull(np.ascontiguousarray(grey[..., None]), lit.astype(np.float32))[..., 0]
    dark = zone & (grey < settings.dark * reference)
    found = []
    for index, distance in enumerate(distances):
        touching = (distance < settings.contact_m) & ~vehicles
        own = dark & (owner == index)
        _, parts = cv2.connectedComponents((own | touching).astype(np.uint8), connectivity=4)
        joined = np.isin(parts, np.unique(parts[touching])) & (parts > 0) & (own | (touching & (owner == index)))
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
        closed = cv2.morphologyEx(joined.astype(np.uint8), cv2.MORPH_CLOSE, disc) > 0
        found.append(closed & ~vehicles)
    return found


def factors(image: Array, background: Array, region: Mask) -> Array:
    """The factor (H, W, 3) in [0, 1] by which one car darkens the ground: photograph / background in its `region`."""
    seen = np.clip(image / np.maximum(background, 1 / 255), 0, 1)
    return np.where(region[..., None], seen, 1).astype(np.float32)
