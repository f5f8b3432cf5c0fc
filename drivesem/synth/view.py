"""What a street is photographed with, and what the camera sees of it; textures of noise."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from drivesem.synth.layout import Road
from drivesem.synth.light import Light, Response
from drivesem.synth.soup import Soup
from scene_ir.types import Camera

SUPERSAMPLING = 2
"""Samples a pixel along each axis."""
LAMP_NUMBERS = 11
"""In a row of `Setting.lamps`."""
SHADOW_VIEWS_M = ((-15.0, 15.0, 1.0, 31.0), (-56.0, 56.0, -2.0, 110.0))
"""Rectangles (x0, x1, z0, z1) of the ground that the near and the far shadow map cover, m to the right and ahead
of the camera."""


@dataclass(frozen=True, slots=True)
class View:
    """A camera above the ground. rotation (3, 3): world to camera axes. centre (3,): the image's centre of
    projection in camera axes (KITTI's camera 2 is next to the origin). height_m: of the axes' origin above the
    ground. position_xz: of the origin, m; heading: rad that the camera is turned to the right, part of `rotation`.
    """

    camera: Camera
    rotation: np.ndarray
    height_m: float
    position_xz: tuple[float, float] = (0.0, 0.0)
    heading: float = 0.0

    @property
    def origin(self) -> np.ndarray:
        """The origin (3,) of camera axes in world axes."""
        return np.array([self.position_xz[0], -self.height_m, self.position_xz[1]])

    @property
    def centre(self) -> np.ndarray:
        """The centre of projection (3,) in camera axes."""
        matrix = self.camera.matrix.double().numpy()
        return -np.linalg.solve(matrix[:, :3], matrix[:, 3])

    def to_camera(self, world: np.ndarray) -> np.ndarray:
        """Camera axes of world points (..., 3)."""
        return (world - self.origin) @ self.rotation.T

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """World axes of camera-space points (..., 3)."""
        return points @ self.rotation.astype(points.dtype) + self.origin.astype(points.dtype)

    @property
    def up(self) -> np.ndarray:
        """The ground's normal (3,) in camera axes."""
        return self.rotation @ np.array([0.0, -1.0, 0.0])


@dataclass(frozen=True, slots=True)
class Shadow:
    """A footprint under which the sky is hidden: corners' centre (x, z), yaw, size_lhw, in world axes."""

    position_xz: tuple[float, float]
    yaw: float
    size_lhw: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Setting:
    """What a frame is rendered with, apart from the triangles. lamps (K, 11) float32: place, axis, colour times
    intensity, kind, owner of each lamp that is on (see `lamps`), in camera axes about the centre of projection.
    """

    view: View
    road: Road
    light: Light
    response: Response
    noise: NoiseSet
    grain_seed: tuple[int, ...]
    lamps: np.ndarray = field(default_factory=lambda: np.zeros((0, LAMP_NUMBERS), np.float32))


@dataclass(frozen=True, slots=True)
class SunMaps:
    """Shadow maps. rows (3, 4): camera axes about the centre to x, z on the ground, to the right and ahead of the
    camera, and the distance along the sun's rays; depth (views, 2, texels, texels): the least of it, the second
    axis is surroundings, actors; areas: the views' (x0, x1, z0, z1), m.
    """

    rows: np.ndarray
    depth: np.ndarray
    areas: tuple[tuple[float, float, float, float], ...] = SHADOW_VIEWS_M


@dataclass(frozen=True, slots=True)
class Sight:
    """What the camera sees, at twice the resolution. faces: the triangles, at least those in view. face (2H, 2W)
    index into them, -1 in the sky; depth (2H, 2W) m, inf in the sky; material (2H, 2W) uint8; owner (2H, 2W)
    int32, -1 in the sky; semantic (2H, 2W) uint8, a `Semantic`.
    """

    faces: Soup
    face: np.ndarray
    depth: np.ndarray
    material: np.ndarray
    owner: np.ndarray
    semantic: np.ndarray

    @property
    def depth_m(self) -> np.ndarray:
        """(H, W) m, of the nearest of a pixel's samples, inf in the sky."""
        return np.minimum.reduce(blocks(self.depth))


def fine_matrix(view: View) -> np.ndarray:
    """(3, 3): centre-relative camera-space points to homogeneous pixels of the supersampled image."""
    n = SUPERSAMPLING
    to_fine = np.array([[n, 0, (n - 1) / 2], [0, n, (n - 1) / 2], [0, 0, 1.0]])
    return to_fine @ view.camera.matrix.double().numpy()[:, :3]


def blocks(values: np.ndarray) -> list[np.ndarray]:
    """The samples of all pixels, one (H, W) array for each place inside a pixel."""
    n = SUPERSAMPLING
    return [values[dy::n, dx::n] for dy in range(n) for dx in range(n)]


SIZE = 512
"""Texels along one side of every noise texture; textures tile."""
BYTE_SUM_SCALE = (4 * (256**2 - 1) / 12) ** -0.5
"""One over the standard deviation of the sum of four uniform bytes."""


@dataclass(frozen=True, slots=True)
class NoiseSet:
    """Three textures (SIZE + 1, SIZE + 1) float32, zero mean, unit deviation, last row and column repeat the
    first.

    soft: clouds and patches (amplitude ~ 1/f^1.7); rough: leaves and plaster (~ 1/f^0.9); grain: nearly white.
    """

    soft: np.ndarray
    rough: np.ndarray
    grain: np.ndarray


def _spectral(rng: np.random.Generator, exponent: float) -> np.ndarray:
    frequency = np.hypot(np.fft.fftfreq(SIZE)[:, None], np.fft.rfftfreq(SIZE)[None]) * SIZE
    frequency[0, 0] = 1.0
    spectrum = np.fft.rfft2(rng.standard_normal((SIZE, SIZE))) * frequency**-exponent
    spectrum[0, 0] = 0.0
    field = np.fft.irfft2(spectrum, s=(SIZE, SIZE))
    return np.pad(field / field.std(), ((0, 1), (0, 1)), mode="wrap").astype(np.float32)


@lru_cache(maxsize=4)
def noise_set(pool: int) -> NoiseSet:
    """The textures of a pool (an integer: training and held-out scenes use different ones)."""
    rng = np.random.default_rng([0x5EED, pool])
    return NoiseSet(_spectral(rng, 1.7), _spectral(rng, 0.9), _spectral(rng, 0.25))
