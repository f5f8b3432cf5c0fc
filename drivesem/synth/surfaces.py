"""What rain, shadow and the light of the ground do to surfaces: constants of the generator's shading."""

from __future__ import annotations

import numpy as np

from drivesem.synth.light import Light
from drivesem.synth.soup import Material

SHADOW_OFFSET_M, SHADOW_OFFSET_TEXELS = 0.015, 3.0
"""How far before a surface its shadow is looked up, the more the more it turns from the sun: the lookup's tent
spans two texels to each side, 2.8 across, which must not meet the surface itself.
"""
LEAF_DEPTH_M = 0.25
"""How deep the sun shines into a crown."""


MIRRORED_GROUND = 0.12
"""Albedo of the ground as seen in reflections."""


def _soaked() -> np.ndarray:
    table = np.zeros((len(Material), 3), np.float32)
    table[Material.ROAD] = 0.48, 0.24, 0.50
    table[[Material.PARKING, Material.PAVEMENT]] = 0.42, 0.18, 0.40
    table[Material.KERB] = 0.36, 0.15, 0.0
    table[Material.GRAVEL] = 0.36, 0.04, 0.60
    table[Material.ROOF] = 0.30, 0.10, 0.0
    table[[Material.GRASS, Material.FACADE, Material.WALL, Material.FENCE, Material.BARK], 0] = 0.2
    table[Material.LEAF, 0] = 0.1
    return table


SOAKED = _soaked()
"""Per material: share of light lost when wet, reflectance as a film of water, and the addition in puddles. Wet, porous
ground is about half as bright. Source: Lekner and Dorf, Applied Optics 27 (1988).
"""


def ground_light(light: Light) -> np.ndarray:
    """Radiance (3,) that the ground casts on what faces down."""
    return 0.16 * (light.ambient + 0.6 * light.sun_colour)
