"""Surfaces of generated objects, and the builder that collects solids into an object."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drivesem.classify.objects.types import ObjectModel, make_object_model
from scene_ir.meshes.solids import TemplateSolid, join_solids, mirror_solid

Rgb = tuple[float, float, float]


class Surface(NamedTuple):
    """Material of a surface."""

    diffuse: Rgb
    """Linear RGB, in [0, 1]."""
    specular: float
    """Specular reflectance, in [0, 1]."""
    shininess: float
    """Phong exponent."""


def paint(rgb: Rgb) -> Surface:
    """A glossy lacquer."""
    return Surface(rgb, 0.30, 60.0)


def plastic(rgb: Rgb) -> Surface:
    """Half-glossy plastic."""
    return Surface(rgb, 0.12, 18.0)


def dull(rgb: Rgb) -> Surface:
    """A matt surface: wood, stone, cloth."""
    return Surface(rgb, 0.03, 5.0)


def metal(rgb: Rgb) -> Surface:
    """Brushed or cast metal."""
    return Surface(rgb, 0.45, 30.0)


CHROME = Surface((0.50, 0.51, 0.53), 0.80, 90.0)
STEEL = metal((0.28, 0.29, 0.30))
IRON = metal((0.03, 0.03, 0.032))
BLACK = plastic((0.012, 0.012, 0.013))
RUBBER = Surface((0.016, 0.016, 0.017), 0.05, 8.0)
GLASS = Surface((0.018, 0.026, 0.034), 0.90, 120.0)
LAMP = Surface((0.80, 0.80, 0.74), 0.60, 60.0)
TAIL_LAMP = Surface((0.42, 0.012, 0.012), 0.50, 50.0)
AMBER = Surface((0.70, 0.25, 0.01), 0.40, 40.0)
WHITE = paint((0.72, 0.72, 0.71))

PAINTS: tuple[Rgb, ...] = (
    *((0.55, 0.02, 0.02), (0.02, 0.06, 0.40), (0.70, 0.70, 0.69), (0.02, 0.02, 0.022), (0.60, 0.38, 0.01)),
    *((0.02, 0.20, 0.05), (0.30, 0.31, 0.33), (0.60, 0.16, 0.01), (0.03, 0.30, 0.45), (0.22, 0.02, 0.04)),
)
"""Lacquers of objects that come in any colour."""
WOODS: tuple[Rgb, ...] = ((0.24, 0.11, 0.04), (0.13, 0.055, 0.022), (0.38, 0.22, 0.10), (0.20, 0.15, 0.10))
STONES: tuple[Rgb, ...] = ((0.42, 0.40, 0.36), (0.26, 0.26, 0.25), (0.48, 0.36, 0.24), (0.30, 0.12, 0.07))


class ObjectBuilder:
    """Collects the solids of an object, and draws all its random numbers from one generator.

    Solids are in metres: x forward, y up, z to the right.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._solids: list[TemplateSolid] = []
        self._face_materials: list[np.ndarray] = []

    def add(self, surface: Surface, *solids: TemplateSolid) -> None:
        """Add solids with one surface."""
        for solid in solids:
            self.add_materials([surface], solid)

    def add_materials(self, surfaces: Sequence[Surface], solid: TemplateSolid) -> None:
        """Add a solid; its material numbers are indices into `surfaces`."""
        table = np.array([(*s.diffuse, s.specular, s.shininess) for s in surfaces])
        self._solids.append(solid)
        self._face_materials.append(table[solid.material])

    def pair(self, surface: Surface, *solids: TemplateSolid) -> None:
        """Add solids with one surface, and their mirror images at z = 0."""
        self.add(surface, *solids, *(mirror_solid(solid) for solid in solids))

    def uniform(self, low: float, high: float) -> float:
        """Draw a number uniformly."""
        return float(self._rng.uniform(low, high))

    def chance(self, probability: float) -> bool:
        """Draw True with this probability."""
        return bool(self._rng.random() < probability)

    def integer(self, low: int, high: int) -> int:
        """Draw an integer uniformly, both ends included."""
        return int(self._rng.integers(low, high + 1))

    def tint(self, colours: Sequence[Rgb], spread: float = 0.25) -> Rgb:
        """Draw one of the colours, lighter or darker by up to `spread`, with a small change per channel."""
        rgb = np.array(colours[int(self._rng.integers(len(colours)))])
        shift = self._rng.uniform(1 - spread, 1 + spread) * self._rng.uniform(0.9, 1.1, 3)
        red, green, blue = np.clip(rgb * shift + 0.004, 0.0, 0.9).tolist()
        return red, green, blue

    def lacquer(self, spread: float = 0.25) -> Surface:
        """Draw a paint of any usual colour."""
        return paint(self.tint(PAINTS, spread))

    def build(self, name: str, label: int) -> ObjectModel:
        """Join all solids into one object: centred, longest side 1, front towards -z."""
        whole = join_solids(self._solids)
        low, high = whole.vertices.min(axis=0), whole.vertices.max(axis=0)
        unit = (whole.vertices - (low + high) / 2) / (high - low).max()
        vertices = unit[:, [2, 1, 0]] * [1.0, 1.0, -1.0]
        return make_object_model(name, label, vertices, whole.faces, np.concatenate(self._face_materials))
