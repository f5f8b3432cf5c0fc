"""What a camera does between two frames, and what nobody could set up more exactly: draws of it.

A draw is a set of numbers, made from a name and a number alone, so that it can be made again: `Nuisances.draw`. It
is applied to a picture (`Draw.picture`, differentiable by kornia), to boxes in it (`Draw.boxes`) and to the scene
before it is rendered (`Draw.scene`).
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, fields, replace

import cv2
import kornia
import numpy as np
import torch
from torch import Tensor

from drivesem.attack.space import ground_axes
from drivesem.settings.errors import UsageError
from scene_ir.types import LATTICE, SceneIR

_GENTLEST_JPEG = 95


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
        seed = int.from_bytes(hashlib.sha256(f"{stream}:{number}".encode()).digest()[:8], "big") >> 1
        generator = torch.Generator().manual_seed(seed)

        def uniform(*shape: int) -> Tensor:
            return 2 * torch.rand(shape, generator=generator) - 1

        count, (height, width) = len(scene.objects), (scene.camera.height, scene.camera.width)
        camera = uniform(7).tolist()
        position, angle, size = uniform(count, 2), uniform(count), uniform(count)
        paint, weather, foliage = uniform(count, 5), uniform(4), uniform(3)
        quality = self.jpeg + (_GENTLEST_JPEG - self.jpeg) * (camera[6] + 1) / 2
        return Draw(
            hw=(height, width),
            shift_px=(self.shift_px * camera[0], self.shift_px * camera[1]),
            zoom=1 + self.scale * camera[2],
            gain=1 + self.gain * camera[3],
            gamma=math.exp(self.gamma * camera[4]),
            blur_px=self.blur_px * abs(camera[5]),
            jpeg=round(quality) if self.jpeg else None,
            noise=self.noise / 255,
            noise_seed=seed + 1,
            position_m=self.position_m * position,
            angle=math.radians(self.angle_deg) * angle,
            size=self.size * size,
            paint=self.code * paint,
            weather=self.code * weather,
            foliage=self.code * foliage,
        )


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
    noise_seed: int
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

        Differentiable: JPEG is kornia's then, libjpeg's otherwise. At the border the last pixels are repeated.
        """
        here = image[None]
        if self.shift_px != (0, 0) or self.zoom != 1:
            matrix = self._matrix(here)
            here = kornia.geometry.warp_affine(here, matrix, self.hw, padding_mode="border", align_corners=True)
        if self.blur_px > 0:
            here = kornia.filters.gaussian_blur2d(
                here, (5, 5), (self.blur_px, self.blur_px), border_type="replicate"
            )
        if self.gain != 1 or self.gamma != 1:
            here = self.gain * here.clamp(1e-6, 1) ** self.gamma
        if self.noise:
            generator = torch.Generator().manual_seed(self.noise_seed)
            here = here + self.noise * torch.randn(here.shape, generator=generator).to(here)
        here = here.clamp(0, 1)
        if self.jpeg is not None and image.requires_grad:
            quality = here.new_tensor([float(self.jpeg)])
            here = kornia.enhance.jpeg_codec_differentiable(here, quality)
        if image.requires_grad:
            return here[0].clamp(0, 1)
        levels = (here[0] * 255).round()
        return (levels if self.jpeg is None else _jpeg(levels, self.jpeg)) / 255

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


def _jpeg(levels: Tensor, quality: int) -> Tensor:
    """Levels (3, H, W) in [0, 255] through libjpeg."""
    bgr = np.ascontiguousarray(levels.flip(0).permute(1, 2, 0).to(torch.uint8).cpu().numpy())
    packed = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    decoded = np.ascontiguousarray(np.flip(cv2.imdecode(packed, cv2.IMREAD_COLOR), axis=2))  # pyright: ignore[reportArgumentType, reportCallIssue]
    return torch.from_numpy(decoded).permute(2, 0, 1).to(levels)


_AT_REST = torch.cartesian_prod(*(torch.linspace(0, 1, n) for n in LATTICE)) - torch.tensor([0.5, 1.0, 0.5])
"""Where the lattice points (64, 3) lie in the unit box: offsets in proportion make a car larger about the middle
of its bottom face."""
