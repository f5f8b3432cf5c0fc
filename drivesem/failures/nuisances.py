"""What a camera does between two frames, and what nobody could set up more exactly: draws of it.

A draw is a set of numbers, made from a name and a number alone, so that it can be made again: `Nuisances.draw`. It
is applied to a picture (`Draw.picture`, differentiable), to boxes in it (`Draw.boxes`) and to the scene
before it is rendered (`Draw.scene`).
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

from drivesem.attack.space import ground_axes
from drivesem.config.errors import UsageError
from drivesem.failures.banded import Matrix, Separable
from drivesem.failures.jpeg import Codec
from scene_ir.types import LATTICE, SceneIR

_GENTLEST_JPEG = 95
_DARKEST = 1e-6
"""Of a picture's values before gamma: it has a slope there."""
_PART = 1 << 17
"""Numbers that a processor's second cache holds: one operation after the other on so many, not on all."""
_TAPS, _REACH = 2, 2.5
"""Pixels either way that a blur takes at least, and standard deviations of a wide one."""
_NOTHING = 1e-9
"""Weight beside the largest that a picture does not show; products with subnormal ones take ten times as long."""


@dataclass(frozen=True, slots=True)
class Nuisances:
    """Ranges; each is switched off by 0. Of the camera: shift_px, of the frame either way, along both axes; scale,
    about the picture's centre, +-; gain, +- of brightness; gamma, +- of the exponent's logarithm; noise, standard
    deviation in levels of 255; blur_px, the largest standard deviation; jpeg, the lowest quality (the highest is
    95). Of what a person could set up again: position_m along and across, angle_deg, size (share), code, either
    way.
    """

    shift_px: float = 15.0
    scale: float = 0.03
    gain: float = 0.05
    gamma: float = 0.05
    noise: float = 2.0
    blur_px: float = 0.7
    jpeg: float = 75.0
    position_m: float = 0.05
    angle_deg: float = 1.0
    size: float = 0.01
    code: float = 0.02

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            most = {"jpeg": 95.0, "scale": 0.5, "gain": 0.9, "size": 0.5}.get(entry.name, math.inf)
            if not (0 <= value <= most and math.isfinite(value)):
                expected = "a number of at least 0" + (f", at most {most:g}" if math.isfinite(most) else "")
                raise UsageError(f"--nuisances: {entry.name}", expected, value)

    @classmethod
    def of(cls, text: str) -> Nuisances:
        """Of `NAME=VALUE` with commas; what is not named keeps its default, `off` is none of all.

        Raises UsageError naming the setting.
        """
        none = cls(**{entry.name: 0.0 for entry in fields(cls)})
        if text in ("default", "off"):
            return cls() if text == "default" else none
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

    def draw(self, stream: str, number: int, scene: SceneIR) -> Draw:
        """The number-th draw of a stream, which its name alone decides, for this scene's picture and objects."""
        return self.of_picture(stream, number, (scene.camera.height, scene.camera.width), len(scene.objects))

    def of_picture(self, stream: str, number: int, hw: tuple[int, int], count: int = 0) -> Draw:
        """The same of any picture, in which so many objects may be moved."""
        seed = int.from_bytes(hashlib.sha256(f"{stream}:{number}".encode()).digest()[:8], "big") >> 1
        generator = torch.Generator().manual_seed(seed)

        def uniform(*shape: int) -> Tensor:
            return 2 * torch.rand(shape, generator=generator) - 1

        camera = uniform(7).tolist()
        position, angle, size = uniform(count, 2), uniform(count), uniform(count)
        paint, weather, foliage = uniform(count, 5), uniform(4), uniform(3)
        quality = self.jpeg + (_GENTLEST_JPEG - self.jpeg) * (camera[6] + 1) / 2
        return Draw(
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
            weather=self.code * weather,
            foliage=self.code * foliage,
        )


class NoiseField:
    """Standard normal numbers of a seed, made when they are first asked for and kept: a search goes round in a few
    draws, and random numbers take longer than all else that is done to a picture.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._kept: Tensor | None = None

    def of(self, image: Tensor) -> Tensor:
        """As many as an image has, of its dtype."""
        if self._kept is None or self._kept.shape != image.shape:
            self._kept = torch.randn(image.shape, generator=torch.Generator().manual_seed(self._seed))
        return self._kept.to(image)


@dataclass(frozen=True, slots=True)
class Draw:
    """One draw. hw: of the picture; jpeg: quality, None for none; noise: standard deviation of RGB in [0, 1].
    position_m (N, 2), along and across each car; angle (N,) rad; size (N,), a share; paint (N, 5), weather (4,),
    foliage (3,): changes of codes.
    """

    hw: tuple[int, int]
    shift_px: tuple[float, float]
    zoom: float
    gain: float
    gamma: float
    blur_px: float
    jpeg: int | None
    noise: float
    noise_field: NoiseField
    position_m: Tensor
    angle: Tensor
    size: Tensor
    paint: Tensor
    weather: Tensor
    foliage: Tensor

    def scene(self, scene: SceneIR) -> SceneIR:
        """A scene set up again: each car a little off on the ground, the codes too, but for codes at 0, which are
        as photographed and stay so.
        """
        objects, environment = scene.objects, scene.environment
        axes = ground_axes(objects.yaw, torch.ones_like(objects.yaw), environment.ground)
        moved = objects.translation + (self.position_m.to(axes)[:, :, None] * axes).sum(dim=1)
        yaw = objects.yaw + self.angle.to(axes)
        grown = objects.ffd + self.size.to(axes)[:, None, None] * _AT_REST.to(axes)
        return scene.with_objects(
            translation=moved, yaw=yaw, ffd=grown, texture_code=_nudged(objects.texture_code, self.paint, -1)
        ).with_environment(
            weather=_nudged(environment.weather, self.weather, 0),
            foliage=_nudged(environment.foliage, self.foliage, -1),
        )

    def picture(self, image: Tensor) -> Tensor:
        """What the camera makes of a picture (3, H, W) in [0, 1], on the 8-bit grid but where it carries a
        gradient.

        Differentiable: JPEG is `jpeg.Codec`'s then, libjpeg's otherwise. Beyond the border, the last pixels go on.
        """
        here = image
        if self.shift_px != (0, 0) or self.zoom != 1 or self.blur_px > 0:
            here = _lens(self.hw, self.shift_px, self.zoom, self.blur_px, image.dtype, image.device)(here)
        noise = self.noise_field.of(image) if self.noise else None
        here = _Developed.apply(here, self.gain, self.gamma, self.noise, noise)
        assert isinstance(here, Tensor)
        if image.requires_grad:
            return here if self.jpeg is None else Codec.of(self.hw, self.jpeg, image)(here)
        levels = (255 * here).round_()
        return (levels if self.jpeg is None else _jpeg(levels, self.jpeg)).div_(255)

    def boxes(self, boxes_xyxy: Tensor) -> Tensor:
        """Where boxes (M, 4) px of the picture are in what the camera makes of it, cut at its border."""
        matrix = self._matrix(boxes_xyxy[None, :0])[0]
        corners = boxes_xyxy.reshape(-1, 2) @ matrix[:, :2].T + matrix[:, 2]
        limit = boxes_xyxy.new_tensor([self.hw[1] - 1.0, self.hw[0] - 1.0])
        return torch.minimum(corners.clamp_min(0), limit).reshape(-1, 4)

    def _matrix(self, like: Tensor) -> Tensor:
        """(1, 2, 3): pixels of the picture to those of the draw."""
        centre = [(self.hw[1] - 1) / 2, (self.hw[0] - 1) / 2]
        move = [c - self.zoom * c + s for c, s in zip(centre, self.shift_px, strict=True)]
        return like.new_tensor([[[self.zoom, 0.0, move[0]], [0.0, self.zoom, move[1]]]])


def _nudged(code: Tensor, change: Tensor, low: float) -> Tensor:
    return torch.where(code == 0, code, (code + change.to(code)).clamp(low, 1))


class _Developed(torch.autograd.Function):
    """Gain and gamma of an image, noise of that standard deviation from a field, and what is left in [0, 1]."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, gain: float, gamma: float, noise: float, field: Tensor | None) -> Tensor:
        result, toned = image.clone(memory_format=torch.contiguous_format), gain != 1 or gamma != 1
        noises = [None] if field is None else field.flatten().split(_PART)
        parts = result.flatten().split(result.numel() if field is None else _PART)
        for part, random in zip(parts, noises, strict=True):
            if toned:
                part.clamp_(_DARKEST, 1).log_().mul_(gamma).exp_().mul_(gain)
            if random is not None:
                part.add_(random, alpha=noise)
        if ctx.needs_input_grad[0]:
            slope = ((result >= 0) & (result <= 1)).to(image)
            if toned:
                known = image.clamp(_DARKEST, 1)
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
def _lens(
    hw: tuple[int, int],
    shift_px: tuple[float, float],
    zoom: float,
    blur_px: float,
    dtype: torch.dtype,
    device: torch.device,
) -> Separable:
    """The frame moved and enlarged about its centre, by linear interpolation, then blurred."""
    rows, columns = (_seen(size, shift, zoom, blur_px) for size, shift in zip(hw, reversed(shift_px), strict=True))
    return Separable.of(rows, columns, torch.empty(0, dtype=dtype, device=device))


def _seen(size: int, shift_px: float, zoom: float, blur_px: float) -> Matrix:
    """The same along one side: what each pixel (size,) is made of."""
    middle, pixels = (size - 1) / 2, np.arange(size)
    place = np.clip((pixels - middle - shift_px) / zoom + middle, 0, size - 1)
    first = np.minimum(np.floor(place).astype(np.int64), size - 2)
    reach = max(_TAPS, math.ceil(_REACH * blur_px))
    taps = np.arange(-reach, reach + 1)
    weights = np.exp(-0.5 * (taps / blur_px) ** 2) if blur_px > 0 else (taps == 0).astype(np.float64)
    weights[weights < _NOTHING] = 0
    matrix = np.zeros((size, size))
    for tap, weight in zip(taps, weights / weights.sum(), strict=True):
        source = np.clip(pixels + tap, 0, size - 1)
        matrix[pixels, first[source]] += weight * (first[source] + 1 - place[source])
        matrix[pixels, first[source] + 1] += weight * (place[source] - first[source])
    return matrix


def _jpeg(levels: Tensor, quality: int) -> Tensor:
    """Levels (3, H, W) in [0, 255] through libjpeg."""
    red, green, blue = levels.to(torch.uint8).cpu().numpy()
    packed = cv2.imencode(".jpg", cv2.merge((blue, green, red)), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    decoded = cv2.split(cv2.imdecode(packed, cv2.IMREAD_COLOR))  # pyright: ignore[reportArgumentType, reportCallIssue]
    return torch.from_numpy(np.stack(decoded[::-1])).to(levels)


_AT_REST = torch.cartesian_prod(*(torch.linspace(0, 1, n) for n in LATTICE)) - torch.tensor([0.5, 1.0, 0.5])
"""Where the lattice points (64, 3) lie in the unit box: offsets in proportion make a car larger about the middle
of its bottom face."""
