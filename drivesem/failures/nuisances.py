"""Nuisances: what a camera changes between two frames, and what nobody could set up more exactly.

A sample is a set of numbers that follows from a stream's name and a number alone, so it can be drawn again
(`Nuisances.sample`). It applies to an image (`NuisanceSample.degrade_image`, differentiable), to boxes in it
(`NuisanceSample.transform_boxes`), and to the scene before it is rendered (`NuisanceSample.perturb_scene`).
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesem.attacks.space import ground_axes
from drivesem.config.errors import UsageError
from drivesem.failures.jpeg import DifferentiableJpeg, Matrix, SeparableMap
from scene_ir.types import LATTICE, SceneIR

_MAX_JPEG_QUALITY = 95
_MIN_VALUE = 1e-6
"""Smallest pixel value before gamma, where it still has a slope."""
_CHUNK = 1 << 17
"""Values that fit into a CPU's second-level cache: all operations run on one chunk before the next."""
_MIN_TAPS, _BLUR_DEVIATIONS = 2, 2.5
"""Pixels either way that a blur covers at least; standard deviations that a wide one covers."""
_MIN_WEIGHT = 1e-9
"""Blur weights below this are zero: they change no pixel, and products with subnormal ones take ten times as
long."""


@dataclass(frozen=True, slots=True)
class Nuisances:
    """Ranges of the nuisances; 0 switches one off. The first seven belong to the camera, the others to the scene."""

    shift_px: float = 15.0
    """Largest shift of the frame either way along both axes."""
    scale: float = 0.03
    """Largest zoom about the image's centre, either way."""
    gain: float = 0.05
    """Largest relative change of brightness, either way."""
    gamma: float = 0.05
    """Largest change of the logarithm of the tone exponent, either way."""
    noise: float = 2.0
    """Standard deviation of the noise, in levels of 255."""
    blur_px: float = 0.7
    """Largest standard deviation of the blur."""
    jpeg: float = 75.0
    """Lowest JPEG quality; the highest is 95."""
    position_m: float = 0.05
    """Largest move of a vehicle along and across its heading, either way."""
    angle_deg: float = 1.0
    """Largest turn of a vehicle, either way."""
    size: float = 0.01
    """Largest relative change of a vehicle's size, either way."""
    code: float = 0.02
    """Largest change of a paint, weather or foliage code, either way."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            most = {"jpeg": 95.0, "scale": 0.5, "gain": 0.9, "size": 0.5}.get(entry.name, math.inf)
            if not (0 <= value <= most and math.isfinite(value)):
                expected = "a number of at least 0" + (f", at most {most:g}" if math.isfinite(most) else "")
                raise UsageError(f"--nuisances: {entry.name}", expected, value)

    @classmethod
    def parse(cls, text: str) -> Nuisances:
        """Parse comma-separated `NAME=VALUE`; unnamed ranges keep their defaults, `off` switches all off.

        Raises:
            UsageError: A name or value is wrong.
        """
        if text in ("default", "off"):
            return cls() if text == "default" else cls(**{entry.name: 0.0 for entry in fields(cls)})
        known = [entry.name for entry in fields(cls)]
        ranges: dict[str, float] = {}
        for part in text.split(","):
            name, _, value = (word.strip() for word in part.partition("="))
            try:
                number = float(value)
            except ValueError:
                number = math.nan
            if name not in known or name in ranges or math.isnan(number):
                expected = f"default, off, or NAME=NUMBER with commas, names among {', '.join(known)}"
                raise UsageError("--nuisances", expected, repr(part))
            ranges[name] = number
        return replace(cls(), **ranges)

    def sample(self, stream: str, number: int, scene: SceneIR) -> NuisanceSample:
        """Draw a sample for a scene's image and objects.

        Args:
            stream: Name of the stream.
            number: Number of the sample in it.
            scene: Scene of N objects.
        """
        return self.sample_for_image(stream, number, (scene.camera.height, scene.camera.width), len(scene.objects))

    def sample_for_image(self, stream: str, number: int, hw: tuple[int, int], count: int = 0) -> NuisanceSample:
        """Draw a sample for any image.

        Args:
            stream: Name of the stream.
            number: Number of the sample in it.
            hw: Height and width of the image, px.
            count: Number of objects that may move.
        """
        seed = int.from_bytes(hashlib.sha256(f"{stream}:{number}".encode()).digest()[:8], "big") >> 1
        generator = torch.Generator().manual_seed(seed)

        def uniform(*shape: int) -> Tensor:
            return 2 * torch.rand(shape, generator=generator) - 1

        camera = uniform(7).tolist()
        position, angle, size = uniform(count, 2), uniform(count), uniform(count)
        paint, daylight, foliage, night = uniform(count, 5), uniform(4), uniform(3), uniform(1)
        quality = self.jpeg + (_MAX_JPEG_QUALITY - self.jpeg) * (camera[6] + 1) / 2
        return NuisanceSample(
            hw=hw,
            shift_px=(self.shift_px * camera[0], self.shift_px * camera[1]),
            zoom=1 + self.scale * camera[2],
            gain=1 + self.gain * camera[3],
            gamma=math.exp(self.gamma * camera[4]),
            blur_px=self.blur_px * abs(camera[5]),
            jpeg=round(quality) if self.jpeg else None,
            noise=self.noise / 255,
            noise_field=NoiseField(seed + 1),
            position_m=self.position_m * position,
            angle=math.radians(self.angle_deg) * angle,
            size=self.size * size,
            paint=self.code * paint,
            weather=self.code * torch.cat([daylight, night, torch.zeros(1)]),
            foliage=self.code * foliage,
        )


class NoiseField:
    """Standard normal noise from a seed, drawn once and cached: a search cycles through a few samples, and random
    numbers take longer than everything else that is done to an image.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._values: Tensor | None = None

    def like(self, image: Tensor) -> Tensor:
        """Noise of an image's shape, dtype and device."""
        if self._values is None or self._values.shape != image.shape:
            self._values = torch.randn(image.shape, generator=torch.Generator().manual_seed(self._seed))
        return self._values.to(image)

    @property
    def cached_mb(self) -> float:
        """Size of the cached noise."""
        return 0.0 if self._values is None else self._values.nbytes / 1e6

    def release(self) -> None:
        """Release the cached noise, which is drawn again when needed."""
        self._values = None


@dataclass(frozen=True, slots=True)
class NuisanceSample:
    """One sample of the nuisances, for an image and N objects."""

    hw: tuple[int, int]
    """Height and width of the image, px."""
    shift_px: tuple[float, float]
    """Shift to the right and downwards."""
    zoom: float
    """Magnification about the centre."""
    gain: float
    """Factor on brightness."""
    gamma: float
    """Tone exponent."""
    blur_px: float
    """Standard deviation of the blur."""
    jpeg: int | None
    """JPEG quality, 1 to 100; None for none."""
    noise: float
    """Standard deviation of the noise, RGB in [0, 1]."""
    noise_field: NoiseField
    """Standard normal numbers."""
    position_m: Tensor
    """(N, 2) moves along and across each vehicle's heading."""
    angle: Tensor
    """(N,) rad, turns."""
    size: Tensor
    """(N,) relative changes of size."""
    paint: Tensor
    """(N, 5) changes of texture codes; clothes above and below the waist change alike."""
    weather: Tensor
    """(5,) changes of the weather code."""
    foliage: Tensor
    """(3,) changes of the foliage code."""

    def perturb_scene(self, scene: SceneIR) -> SceneIR:
        """Set the scene up again: move each vehicle a little on the ground and change the codes. Codes of 0, which
        mean as photographed, stay 0.
        """
        objects, environment = scene.objects, scene.environment
        axes = ground_axes(objects.yaw, torch.ones_like(objects.yaw), environment.ground)
        moved = objects.translation + (self.position_m.to(axes)[:, :, None] * axes).sum(dim=1)
        yaw = objects.yaw + self.angle.to(axes)
        grown = objects.ffd + self.size.to(axes)[:, None, None] * _LATTICE_POINTS.to(axes)
        code = objects.texture_code
        paint = torch.cat([self.paint, self.paint[:, :3]], dim=1)[:, : code.shape[1]]
        return scene.with_objects(
            translation=moved, yaw=yaw, ffd=grown, texture_code=_perturb_code(code, paint, -1)
        ).with_environment(
            weather=_perturb_code(environment.weather, self.weather, 0),
            foliage=_perturb_code(environment.foliage, self.foliage, -1),
        )

    def degrade_image(self, image: Tensor) -> Tensor:
        """Apply the camera's nuisances to an image (3, H, W) in [0, 1]; border pixels are replicated.

        An image that requires a gradient gets it, with JPEG by `jpeg.DifferentiableJpeg`. Others are rounded to
        8 bits, with JPEG by libjpeg.
        """
        result = image
        if self.shift_px != (0, 0) or self.zoom != 1 or self.blur_px > 0:
            warp = _warp_and_blur(self.hw, self.shift_px, self.zoom, self.blur_px, image.dtype, image.device)
            result = warp(result)
        noise = self.noise_field.like(image) if self.noise else None
        result = _ToneAndNoise.apply(result, self.gain, self.gamma, self.noise, noise)
        assert isinstance(result, Tensor)
        if image.requires_grad:
            return result if self.jpeg is None else DifferentiableJpeg.create(self.hw, self.jpeg, image)(result)
        levels = (255 * result).round_()
        return (levels if self.jpeg is None else _encode_and_decode_jpeg(levels, self.jpeg)).div_(255)

    def transform_boxes(self, boxes_xyxy: Tensor) -> Tensor:
        """Where boxes (M, 4) px of the original image lie in the degraded one, clipped to its border."""
        centre = [(self.hw[1] - 1) / 2, (self.hw[0] - 1) / 2]
        offset = [c - self.zoom * c + s for c, s in zip(centre, self.shift_px, strict=True)]
        matrix = boxes_xyxy.new_tensor([[self.zoom, 0.0], [0.0, self.zoom]])
        corners = boxes_xyxy.reshape(-1, 2) @ matrix.T + boxes_xyxy.new_tensor(offset)
        limit = boxes_xyxy.new_tensor([self.hw[1] - 1.0, self.hw[0] - 1.0])
        return torch.minimum(corners.clamp_min(0), limit).reshape(-1, 4)


def _perturb_code(code: Tensor, change: Tensor, low: float) -> Tensor:
    return torch.where(code == 0, code, (code + change.to(code)).clamp(low, 1))


class _ToneAndNoise(torch.autograd.Function):
    """Apply gain and gamma to an image, add scaled noise, and clip to [0, 1]."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, gain: float, gamma: float, noise: float, field: Tensor | None) -> Tensor:
        result, toned = image.clone(memory_format=torch.contiguous_format), gain != 1 or gamma != 1
        noises = [None] if field is None else field.flatten().split(_CHUNK)
        parts = result.flatten().split(result.numel() if field is None else _CHUNK)
        for part, random in zip(parts, noises, strict=True):
            if toned:
                part.clamp_(_MIN_VALUE, 1).log_().mul_(gamma).exp_().mul_(gain)
            if random is not None:
                part.add_(random, alpha=noise)
        if ctx.needs_input_grad[0]:
            slope = ((result >= 0) & (result <= 1)).to(image)
            if toned:
                known = image.clamp(_MIN_VALUE, 1)
                slope.mul_(known == image).mul_(known.log_().mul_(gamma - 1).exp_().mul_(gain * gamma))
            ctx.save_for_backward(slope)
        return result.clamp_(0, 1)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor, None, None, None, None]:
        (slope,) = ctx.saved_tensors
        return gradients[0] * slope, None, None, None, None


@lru_cache(maxsize=32)
def _warp_and_blur(
    hw: tuple[int, int],
    shift_px: tuple[float, float],
    zoom: float,
    blur_px: float,
    dtype: torch.dtype,
    device: torch.device,
) -> SeparableMap:
    """Shift the frame and magnify it about its centre, by linear interpolation, then blur it."""
    rows, columns = (
        _warp_and_blur_axis(size, shift, zoom, blur_px) for size, shift in zip(hw, reversed(shift_px), strict=True)
    )
    return SeparableMap.from_dense(rows, columns, torch.empty(0, dtype=dtype, device=device))


def _warp_and_blur_axis(size: int, shift_px: float, zoom: float, blur_px: float) -> Matrix:
    """The same along one axis: a matrix (size, size) from input to output pixels."""
    middle, pixels = (size - 1) / 2, np.arange(size)
    place = np.clip((pixels - middle - shift_px) / zoom + middle, 0, size - 1)
    first = np.minimum(np.floor(place).astype(np.int64), size - 2)
    reach = max(_MIN_TAPS, math.ceil(_BLUR_DEVIATIONS * blur_px))
    taps = np.arange(-reach, reach + 1)
    weights = np.exp(-0.5 * (taps / blur_px) ** 2) if blur_px > 0 else (taps == 0).astype(np.float64)
    weights[weights < _MIN_WEIGHT] = 0
    matrix = np.zeros((size, size))
    for tap, weight in zip(taps, weights / weights.sum(), strict=True):
        source = np.clip(pixels + tap, 0, size - 1)
        matrix[pixels, first[source]] += weight * (first[source] + 1 - place[source])
        matrix[pixels, first[source] + 1] += weight * (place[source] - first[source])
    return matrix


def _encode_and_decode_jpeg(levels: Tensor, quality: int) -> Tensor:
    """Encode and decode levels (3, H, W) in [0, 255] by libjpeg."""
    red, green, blue = levels.to(torch.uint8).cpu().numpy()
    packed = cv2.imencode(".jpg", cv2.merge((blue, green, red)), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    decoded = cv2.split(cv2.imdecode(packed, cv2.IMREAD_COLOR))  # pyright: ignore[reportArgumentType, reportCallIssue]
    return torch.from_numpy(np.stack(decoded[::-1])).to(levels)


_LATTICE_POINTS = torch.cartesian_prod(*(torch.linspace(0, 1, n) for n in LATTICE)) - torch.tensor([0.5, 1.0, 0.5])
"""(64, 3) lattice points in the unit box, from the middle of the bottom face: offsets in proportion to them resize
a vehicle about that point."""
