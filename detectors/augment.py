"""Augments training frames: windows at half to native scale, mirrored, with other colours, blur, noise and JPEG.

Everything is drawn from the given generator, so an augmented frame is a function of (frame, generator) alone, and
an interrupted run resumes to the same bytes.
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
"""A box becomes an ignored one if the window shows less than this share of it."""

FILL_RGB = (124, 117, 104)
"""Colour outside the frame: ImageNet's mean, which backbones see as neutral."""


@dataclass(frozen=True, slots=True)
class AugmentSettings:
    """Limits of the augmentation."""

    window_hw: tuple[int, int] = (224, 640)
    """Size of the window, px; smaller frames are padded."""
    scale: tuple[float, float] = (0.5, 1.35)
    """Range of the zoom, drawn uniformly in its logarithm."""
    scale_probability: float = 0.8
    """Probability of a zoom other than 1."""
    object_probability: float = 0.9
    """Probability that the window is placed around an object instead of anywhere."""
    flip_probability: float = 0.5
    """Probability of a horizontal flip."""
    brightness: float = 0.15
    """Largest shift, in units of the whole range."""
    contrast: float = 0.35
    """Largest relative change, in the logarithm."""
    gamma: float = 0.35
    """Largest relative change of the exponent, in the logarithm."""
    channel_gain: float = 0.12
    """Largest relative change per channel, in the logarithm."""
    saturation: float = 0.6
    """Largest relative change."""
    hue_rad: float = 0.35
    """Largest shift, rad."""
    hue_probability: float = 0.25
    """Probability of a hue change, by far the slowest operation."""
    blur_probability: float = 0.15
    """Probability of a Gaussian blur."""
    noise_probability: float = 0.2
    """Probability of Gaussian noise."""
    jpeg_probability: float = 0.15
    """Probability of JPEG compression."""
    minimum_height_px: float = 11.0
    """Objects lower than this in the window are ignored: a 16 px grid resolves nothing smaller."""


def augment(
    image: np.ndarray, targets: Targets, settings: AugmentSettings, generator: np.random.Generator
) -> tuple[Tensor, Targets]:
    """Augment one frame.

    Args:
        image: (H, W, 3) uint8 RGB.
        targets: Its targets.
        settings: Limits of the augmentation.
        generator: Source of all random numbers.

    Returns:
        The window (3, h, w) float32 in [0, 1] and its targets.
    """
    scale = 1.0
    if generator.random() < settings.scale_probability:
        scale = float(np.exp(generator.uniform(*np.log(settings.scale))))
    height, width = (round(side / scale) for side in settings.window_hw)
    x0, y0 = _draw_window(image.shape[:2], (height, width), targets, settings, generator)
    pixels = torch.from_numpy(_crop(image, x0, y0, height, width)).permute(2, 0, 1).float() / 255
    if (height, width) != settings.window_hw:
        pixels = transform.resize(pixels, settings.window_hw, "bilinear", align_corners=False, antialias=scale < 1)
    zoom_xy = (settings.window_hw[1] / width, settings.window_hw[0] / height)
    window_targets = crop_targets(targets, (x0, y0), zoom_xy, settings)
    if generator.random() < settings.flip_probability:
        pixels, window_targets = transform.hflip(pixels), flip_targets(window_targets, settings.window_hw[1])
    return degrade(jitter_colour(pixels, settings, generator), settings, generator), window_targets


def crop_targets(
    targets: Targets, origin_xy: tuple[int, int], zoom_xy: tuple[float, float], settings: AugmentSettings
) -> Targets:
    """Targets in a window of the frame.

    Boxes are clipped to the window. Those outside are dropped; those cut to less than CUT_VISIBLE or too low are
    ignored.

    Args:
        targets: Targets of the frame.
        origin_xy: First pixel of the window.
        zoom_xy: Scale from the frame to the window of settings.window_hw.
        settings: Window size and least height.
    """
    zoom = torch.tensor([*zoom_xy, *zoom_xy])
    origin = torch.tensor([*origin_xy, *origin_xy])
    # Pixel centres are integers, so edges lie at x + 0.5 and scale.
    uncut = (targets.boxes_xyxy.float() - origin + 0.5) * zoom - 0.5
    cut = boxes.clip(uncut, *settings.window_hw)
    visible = boxes.area(cut) / boxes.area(uncut).clamp_min(1e-6)
    low = (cut[:, 3] - cut[:, 1]) < settings.minimum_height_px
    inside = boxes.area(cut) > 0
    ignore = targets.ignore | (visible < CUT_VISIBLE) | low
    return Targets(cut[inside], targets.labels[inside], ignore[inside])


def flip_targets(targets: Targets, width: int) -> Targets:
    """Targets after a horizontal flip of an image of that width, px."""
    left, top, right, bottom = targets.boxes_xyxy.unbind(-1)
    boxes_xyxy = torch.stack((width - 1 - right, top, width - 1 - left, bottom), -1)
    return Targets(boxes_xyxy, targets.labels, targets.ignore)


def jitter_colour(image: Tensor, settings: AugmentSettings, generator: np.random.Generator) -> Tensor:
    """Change brightness, contrast, saturation, hue, channel gain and gamma.

    Args:
        image: (3, H, W) in [0, 1].
        settings: Limits of the augmentation.
        generator: Source of all random numbers.
    """
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
    """Blur, add noise or compress as JPEG, each with its probability.

    Args:
        image: (3, H, W) in [0, 1].
        settings: Probabilities.
        generator: Source of all random numbers.
    """
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


def _draw_window(
    image_hw: tuple[int, ...],
    size_hw: tuple[int, int],
    targets: Targets,
    settings: AugmentSettings,
    generator: np.random.Generator,
) -> tuple[int, int]:
    """First pixel (x0, y0) of a window of that size; inside the frame if it fits."""
    chosen = torch.nonzero(~targets.ignore)[:, 0]
    focus = generator.uniform(0, 1, 2) * (image_hw[1], image_hw[0])
    if len(chosen) and generator.random() < settings.object_probability:
        # Draw a class, then one of its objects: this oversamples rare classes.
        present = torch.unique(targets.labels[chosen])
        chosen = chosen[targets.labels[chosen] == present[generator.integers(len(present))]]
        left, top, right, bottom = targets.boxes_xyxy[chosen[generator.integers(len(chosen))]].tolist()
        focus = np.array([(left + right) / 2, (top + bottom) / 2])
    corner = focus - generator.uniform(0.1, 0.9, 2) * (size_hw[1], size_hw[0])
    free = np.array([image_hw[1] - size_hw[1], image_hw[0] - size_hw[0]])
    x0, y0 = np.clip(np.round(corner), np.minimum(free, 0), np.maximum(free, 0)).astype(int).tolist()
    return x0, y0


def _crop(image: np.ndarray, x0: int, y0: int, height: int, width: int) -> np.ndarray:
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
