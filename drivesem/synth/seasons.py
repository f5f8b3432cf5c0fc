"""Foliage codes on a world's leaves and grass: the counterpart of `scene_ir.render.environment.apply_foliage` in
albedo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from drivesem.synth.soup import Material, Soup
from scene_ir.render.environment import apply_foliage
from scene_ir.types import WEATHER_DIM, Environment

_GROWTH = 0.35
"""By how much of its size a leaf cluster grows at density 1."""
_FALL = 0.85
"""Share of the leaf clusters that are gone at density -1."""


def leaved(soup: Soup, foliage: tuple[float, ...]) -> Soup:
    """The triangles with their foliage as the codes (hue, lightness, density), each in [-1, 1], have it."""
    if not any(foliage):
        return soup
    hue, lightness, density = foliage
    green = np.isin(soup.material, (Material.LEAF, Material.GRASS))
    albedo = soup.albedo.copy()
    albedo[green] = _coloured(soup.albedo[green], hue, lightness)
    corners = soup.corners
    leaf = soup.material == Material.LEAF
    if density > 0:
        middle = corners.mean(axis=1, keepdims=True)
        corners = np.where(
            leaf[:, None, None], middle + (corners - middle) * np.float32(1 + _GROWTH * density), corners
        )
    soup = replace(soup, albedo=albedo, corners=corners)
    if density < 0:
        # By a fixed order of the leaves, so that a lower density takes away more of the same ones.
        fallen = np.zeros(len(soup), bool)
        fallen[leaf] = np.random.default_rng(0x1EAF).random(int(leaf.sum())) < -_FALL * density
        soup = soup.take(~fallen)
    return soup


def _coloured(albedo: np.ndarray, hue: float, lightness: float) -> np.ndarray:
    """Linear albedo (n, 3) under the codes of hue and lightness."""
    display_colour = torch.from_numpy(np.clip(albedo, 0, 1).T[:, None].astype(np.float64)) ** (1 / 2.2)
    row = torch.zeros(display_colour.shape[1:], dtype=torch.float64)
    environment = Environment(
        weather=row.new_zeros(WEATHER_DIM),
        foliage=row.new_tensor([hue, lightness, 0.0]),
        sun=row.new_tensor([0.0, -1.0, 0.0]),
        ground=row.new_tensor([0.0, -1.0, 0.0, 1.65]),
        sky=row,
        foliage_map=torch.ones_like(row),
        road=row,
    )
    changed = apply_foliage(display_colour, environment, row.new_zeros(5, *row.shape))
    return (changed.clamp(0, 1) ** 2.2)[:, 0].T.float().numpy()
