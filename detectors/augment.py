"""Views of a training frame: windows at half to native scale, mirrored, with other colours, blur, noise, JPEG.

kornia changes the pixels. Everything is drawn from the generator that comes in, so a view is a function of (frame,
generator) alone, and a run that was stopped goes on to the same bytes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from kornia import enhance, filters
from kornia.geometry import transform
from torch import Tensor

from detectors import boxes
from detectors.types import Targets

CUT_VISIBLE = 0.3
"""A box of which the window shows less than this fraction becomes an ignored one."""

FILL_RGB = (124, 117, 104)
"""Outside the frame: the mean colour of ImageNet, which backbones take for nothing."""


@dataclass(frozen=True, slots=True)
class AugmentSettings:
    """How far views may depart from their frame."""

    window_hw: tuple[int, int] = (224, 640)
    """Size of the view in pixels; frames smaller than it are padded by their border."""
    scale: tuple[float, float] = (0.5, 1.35)
    """Range of the zoom, drawn uniformly in its logarithm."""
    scale_probability: float = 0.8
    object_probability: float = 0.9
    """How often the window is placed around an object instead of anywhere."""
    flip_probability: float = 0.5
    brightness: float = 0.15
    """Largest shift, in units of the whole range; the following three are relative."""
    contrast: float = 0.35
    gamma: float = 0.35
    channel_gain: float = 0.12
    saturation: float = 0.6
    hue_rad: float = 0.35
    hue_probability: float = 0.25
    """Of a change of hue, by far the slowest of all."""
    blur_probability: float = 0.15
    noise_probability: float = 0.2
    jpeg_probability: float = 0.15
    minimum_height_px: float = 11.0
    """Objects lower than this in the view are ignored: the coarsest thing a 16 px grid can be asked for."""


def view(
    image: np.ndarray, targets: Targets, settings: AugmentSettings, generator: np.random.Generator
) -> tuple[Tensor, Targets]:
    """One view (3, h, w) float32 in [0, 1] with its targets, of a frame (H, W, 3) uint8 RGB with its targets."""
    scale = 1.0
    if generator.random() < settings.scale_probability:
        scale = float(np.exp(generator.uniform(*np.log(settings.scale))))
    height, width = (round(side / scale) for side in settings.window_hw)
    x0, y0 = _place(image.shape[:2], (height, width), targets, settings, generator)
    pixels = torch.from_numpy(_cut(image, x0, y0, height, width)).permute(2, 0, 1).float() / 255
    if (height, width) != settings.window_hw:
        pixels = transform.resize(pixels, settings.window_hw, "bilinear", align_corners=False, antialias=scale < 1)
    zoom_xy = (settings.window_hw[1] / width, settings.window_hw[0] / height)
    moved = cut_targets(targets, (x0, y0), zoom_xy, settings)
    if generator.random() < settings.flip_probability:
        pixels, moved = transform.hflip(pixels), mirror(moved, settings.window_hw[1])
    return degrade(recolour(pixels, settings, generator), settings, generator), moved


def cut_targets(
    targets: Targets, origin_xy: tuple[int, int], zoom_xy: tuple[float, float], settings: AugmentSettings
) -> Targets:
    """Targets in the window that starts at pixel origin_xy of the frame and was zoomed to settings.window_hw.

    Boxes are cut at the window; those outside go, those cut to less than CUT_VISIBLE or too low become ignored.
    """
    zoom = torch.tensor([*zoom_xy, *zoom_xy])
    origin = torch.tensor([*origin_xy, *origin_xy])
    # Pixel centres are integers, so edges are what scales: x + 0.5.
    whole = (targets.boxes_xyxy.float() - origin + 0.5) * zoom - 0.5
    cut = boxes.clip(whole, *settings.window_hw)
    shown = boxes.area(cut) / boxes.area(whole).clamp_min(1e-6)
    low = (cut[:, 3] - cut[:, 1]) < settings.minimum_height_px
    there = boxes.area(cut) > 0
    ignore = targets.ignore | (shown < CUT_VISIBLE) | low
    return Targets(cut[there], targets.labels[there], ignore[there])


def mirror(targets: Targets, width: int) -> Targets:
    """Targets in an image (of that width in px) that was flipped left to right."""
    left, top, right, bottom = targets.boxes_xyxy.unbind(-1)
    boxes_xyxy = torch.stack((width - 1 - right, top, width - 1 - left, bottom), -1)
    return Targets(boxes_xyxy, targets.labels, targets.ignore)


def recolour(image: Tensor, settings: AugmentSettings, generator: np.random.Generator) -> Tensor:
    """The image (3, H, W) in [0, 1] in other light: brightness, contrast, saturation, hue, channel gain, gamma."""
    gain = np.exp(generator.uniform(-settings.channel_gain, settings.channel_gain, 3)).astype(np.float32)
    contrast = float(np.exp(generator.uniform(-settings.contrast, settings.contrast)))
    brightness = float(generator.uniform(-settings.brightness, settings.brightness))
    saturation = 1 + settings.saturation * float(generator.uniform(-1, 1))
    exponent = float(np.exp(generator.uniform(-settings.gamma, settings.gamma)))
    hue = float(generator.uniform(-settings.hue_rad, settings.hue_rad))
    image = (image * torch.from_numpy(gain)[:, None, None]).clamp_(0, 1)
    image = enhance.adjust_contrast_with_mean_subtraction(image, contrast)
    image = enhance.adjust_brightness(image, brightness)
    image = enhance.adjust_saturation_with_gray_subtraction(image, saturation)
    if generator.random() < settings.hue_probability:
        image = enhance.adjust_hue(image, hue)
    return enhance.adjust_gamma(image, exponent)


def degrade(image: Tensor, settings: AugmentSettings, generator: np.random.Generator) -> Tensor:
    """The image (3, H, W) in [0, 1], now and then blurred, noisy, or through JPEG."""
    if generator.random() < settings.blur_probability:
        sigma = float(generator.uniform(0.4, 1.3))
        image = filters.gaussian_blur2d(image[None], (7, 7), (sigma, sigma), "replicate")[0]
    if generator.random() < settings.noise_probability:
        grain = generator.standard_normal(tuple(image.shape), dtype=np.float32)
        image = (image + torch.from_numpy(grain) * float(generator.uniform(0.005, 0.04))).clamp_(0, 1)
    if generator.random() < settings.jpeg_probability:
        quality = torch.tensor([generator.uniform(30, 90)], dtype=image.dtype)
        image = enhance.jpeg_codec_differentiable(image[None], quality)[0]
    return image


def _place(
    image_hw: tuple[int, ...],
    size_hw: tuple[int, int],
    targets: Targets,
    settings: AugmentSettings,
    generator: np.random.Generator,
) -> tuple[int, int]:
    """First pixel (x0, y0) of a window of that size; inside the frame where it fits."""
    chosen = torch.nonzero(~targets.ignore)[:, 0]
    focus = generator.uniform(0, 1, 2) * (image_hw[1], image_hw[0])
    if len(chosen) and generator.random() < settings.object_probability:
        # A class first, then one of its objects: the rare classes are seen more often than they occur.
        present = torch.unique(targets.labels[chosen])
        chosen = chosen[targets.labels[chosen] == present[generator.integers(len(present))]]
        left, top, right, bottom = targets.boxes_xyxy[chosen[generator.integers(len(chosen))]].tolist()
        focus = np.array([(left + right) / 2, (top + bottom) / 2])
    corner = focus - generator.uniform(0.1, 0.9, 2) * (size_hw[1], size_hw[0])
    free = np.array([image_hw[1] - size_hw[1], image_hw[0] - size_hw[0]])
    x0, y0 = np.clip(np.round(corner), np.minimum(free, 0), np.maximum(free, 0)).astype(int).tolist()
    return x0, y0


def _cut(image: np.ndarray, x0: int, y0: int, height: int, width: int) -> np.ndarray:
    """Pixels (height, width, 3) from (x0, y0) on; FILL_RGB outside the frame."""
    inside_y = slice(max(y0, 0), min(y0 + height, image.shape[0]))
    inside_x = slice(max(x0, 0), min(x0 + width, image.shape[1]))
    part = image[inside_y, inside_x]
    if part.shape[:2] == (height, width):
        return np.array(part)
    window = np.empty((height, width, 3), np.uint8)
    window[:] = FILL_RGB
    window[inside_y.start - y0 : inside_y.stop - y0, inside_x.start - x0 : inside_x.stop - x0] = part
    return window
