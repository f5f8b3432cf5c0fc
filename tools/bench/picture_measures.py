"""Measures of a street picture that its weather and its camera decide: light, colour, sharpness, noise and lamps."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from types import EllipsisType

import cv2
import numpy as np
from numpy.typing import NDArray

from scene_ir.render.model import LUMA

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]

LINES = 720
"""Height to which every picture is resized, px; BDD100K's."""
LEAST_HEIGHT_PX = 30.0
"""Height from which a vehicle's box counts, px at `LINES`."""
_RING = 0.5
"""Width of the ring around a box, in sides of the box."""
_CLIPPED, _BLACK = 249.5 / 255, 5.5 / 255
"""Display value from which the brightest channel counts as clipped, and up to which it counts as black: JPEG moves
levels by a few."""
_RED, _REDNESS = 0.5, 0.25
"""Lowest red of a lit tail lamp, and its lead over green and blue, in display values."""
_AIR_HEIGHT, _DEFAULT_HORIZON, _SMOOTHEST = 0.12, 0.45, 0.25
"""Height of the band above the horizon, and the horizon without vehicles, in heights of the picture; share of its
pixels that counts as air."""
_ROOF = 0.1
"""Place of the horizon below a vehicle's roof, in heights of its box: a dashcam sits 1.3 m high, a roof 1.45 m."""
_BLOCK_PX, _LEAST_BLOCKS = 8, 30
_LEVELS = {"dark": (0.02, 0.2), "mid": (0.2, 0.6), "bright": (0.6, 0.95)}
"""Ranges of luma for noise."""
_LAMP_LUMA, _LAMP_AREA_PX, _MOST_LAMPS, _BACKGROUND = 0.9, (6, 2000), 40, 0.6
"""Lowest luma of a lamp, its area, the number that is measured, and the highest luma around it."""


@dataclass(frozen=True, slots=True)
class PictureLayers:
    """A picture of `LINES` lines and what is computed from it once, each (H, W)."""

    rgb: NDArray[np.float32]
    """Display values (H, W, 3) in [0, 1]."""
    luma: NDArray[np.float32]
    """Luma in [0, 1]."""
    saturation: NDArray[np.float32]
    """(max - min) / max of the channels, with a maximum of at least 0.1: below, it is noise."""
    gradient: NDArray[np.float32]
    """Length of luma's gradient, per px."""
    clipped: Mask
    """Whether the brightest channel is at its end."""
    black: Mask
    """Whether the brightest channel is near 0."""

    @classmethod
    def from_picture(cls, picture: Picture) -> PictureLayers:
        """Compute the layers of an RGB picture."""
        rgb = picture.astype(np.float32) / np.float32(255)
        luma = (rgb @ np.array(LUMA, np.float32)).astype(np.float32)
        # by channels: numpy reduces a short last axis slowly
        red, green, blue = np.ascontiguousarray(rgb.transpose(2, 0, 1))
        highest = np.maximum(np.maximum(red, green), blue)
        saturation = (highest - np.minimum(np.minimum(red, green), blue)) / np.maximum(highest, 0.1)
        # Sobel's kernels sum to 8
        dx, dy = (cv2.Sobel(luma, cv2.CV_32F, *order) / 8 for order in ((1, 0), (0, 1)))
        return cls(rgb, luma, saturation, np.hypot(dx, dy), highest >= _CLIPPED, highest <= _BLACK)


def resize_to_lines(picture: Picture, boxes_xyxy: Floats) -> tuple[Picture, Floats]:
    """Resize a picture and its boxes (N, 4) px to `LINES` lines; boxes lower than `LEAST_HEIGHT_PX` are left out."""
    scale = LINES / picture.shape[0]
    if scale != 1:
        kind = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        size = (max(round(scale * picture.shape[1]), 1), LINES)
        picture = cv2.resize(picture, size, interpolation=kind).astype(np.uint8)
    boxes = scale * boxes_xyxy
    return picture, boxes[boxes[:, 3] - boxes[:, 1] >= LEAST_HEIGHT_PX]


def measure_picture(picture: Picture, boxes_xyxy: Floats) -> dict[str, float]:
    """Measure a picture by region: "frame: ...", "boxes: ..." and "ring: ...".

    Values of boxes and rings are means over vehicles. What cannot be measured (no vehicle, no lamp, no blocks of a
    level) is missing.

    Args:
        picture: RGB picture (H, W, 3); it is resized to `LINES` lines.
        boxes_xyxy: Boxes (N, 4) px of all its vehicles.
    """
    picture, boxes = resize_to_lines(picture, boxes_xyxy)
    layers = PictureLayers.from_picture(picture)
    values = {f"frame: {name}": measure(layers, ...) for name, measure in _OF_FRAME.items()}
    inside = [_window(box, layers.luma.shape, 0.0) for box in boxes]
    vehicles = np.zeros(layers.luma.shape, bool)
    for window in inside:
        vehicles[window] = True
    if inside:
        for name, measure in _OF_BOXES.items():
            values[f"boxes: {name}"] = float(np.mean([measure(layers, window) for window in inside]))
    rings = [region for box in boxes if (region := _ring(box, vehicles)) is not None]
    if rings:
        for name, measure in _OF_RING.items():
            values[f"ring: {name}"] = float(np.mean([measure(layers, region) for region in rings]))
    noise = measure_noise(layers.luma)
    values |= {f"frame: noise, {level}": value for level, value in noise.items()}
    values["frame: air a*"], values["frame: air b*"] = measure_air(layers, boxes, vehicles)
    values["frame: lamps"], glare = measure_glare(layers.luma)
    if glare is not None:
        values["frame: glare"] = glare
    return values


_Region = tuple[slice, slice] | Mask | EllipsisType
_Measure = Callable[[PictureLayers, _Region], float]


def _mean(layer: str, scale: float = 1.0) -> _Measure:
    return lambda layers, region: scale * float(getattr(layers, layer)[region].mean())


def _contrast(layers: PictureLayers, region: _Region) -> float:
    return float(layers.luma[region].std())


def _sharpness(layers: PictureLayers, region: _Region) -> float:
    """The steepest edges, per px, as a share of the region's own range of luma: blur lowers it, contrast does not."""
    low, high = np.quantile(layers.luma[region], [0.01, 0.99])
    return float(np.quantile(layers.gradient[region], 0.99) / max(high - low, 1 / 255))


def _red_lamps(layers: PictureLayers, region: _Region) -> float:
    rgb = layers.rgb[region]
    red = rgb[..., 0]
    return 100 * float(((red >= _RED) & (red - rgb[..., 1:].max(axis=-1) >= _REDNESS)).mean())


_OF_RING: dict[str, _Measure] = {
    "brightness": _mean("luma"),
    "contrast": _contrast,
    "saturation": _mean("saturation"),
    "sharpness": _sharpness,
}
_OF_FRAME: dict[str, _Measure] = {**_OF_RING, "clipped, %": _mean("clipped", 100), "black, %": _mean("black", 100)}
_OF_BOXES: dict[str, _Measure] = {**_OF_RING, "clipped, %": _mean("clipped", 100), "red lamps, %": _red_lamps}


def _window(box: Floats, size_hw: tuple[int, ...], grown: float) -> tuple[slice, slice]:
    """Pixels of a box grown by a share of its sides, at least one."""
    x0, y0, x1, y1 = box
    wide, high = grown * (x1 - x0), grown * (y1 - y0)
    rows = _pixels(y0 - high, y1 + high, size_hw[0])
    return rows, _pixels(x0 - wide, x1 + wide, size_hw[1])


def _pixels(low: float, high: float, size: int) -> slice:
    start = min(max(round(low), 0), size - 1)
    return slice(start, max(min(round(high) + 1, size), start + 1))


def _ring(box: Floats, vehicles: Mask) -> Mask | None:
    """Pixels around a box that are in no vehicle's box; None without any."""
    region = np.zeros(vehicles.shape, bool)
    region[_window(box, vehicles.shape, _RING)] = True
    region &= ~vehicles
    return region if region.any() else None


def measure_noise(luma: NDArray[np.float32]) -> dict[str, float]:
    """Standard deviation of noise, levels of 255, by range of luma, as the lower quartile of blocks of 8 px.

    Each block's deviation is Immerkaer's (Fast Noise Variance Estimation, 1996): the mean absolute response to a
    kernel that planes and straight edges do not answer. Levels with fewer than 30 blocks are missing.
    """
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    response = np.abs(cv2.filter2D(luma, cv2.CV_32F, kernel))
    deviation = 255 * math.sqrt(math.pi / 2) / 6 * _block_means(response)
    light = _block_means(luma)
    noise = {}
    for name, (low, high) in _LEVELS.items():
        blocks = deviation[(light >= low) & (light < high)]
        if len(blocks) >= _LEAST_BLOCKS:
            noise[name] = float(np.quantile(blocks, 0.25))
    return noise


def _block_means(layer: NDArray[np.float32]) -> Floats:
    height, width = (side // _BLOCK_PX for side in layer.shape)
    cut = layer[: height * _BLOCK_PX, : width * _BLOCK_PX].astype(np.float64)
    return cut.reshape(height, _BLOCK_PX, width, _BLOCK_PX).mean(axis=(1, 3))


def measure_air(layers: PictureLayers, boxes: Floats, vehicles: Mask) -> tuple[float, float]:
    """Median a* and b* (CIELAB) of the smoothest quarter of a band above the horizon, without vehicles.

    Far streets and the lowest sky lie there; the thicker the air, the more of it is air alone. The horizon follows
    from the vehicles' boxes: their roofs are a little above the camera.
    """
    height = layers.luma.shape[0]
    roofs = boxes[:, 1] + _ROOF * (boxes[:, 3] - boxes[:, 1])
    horizon = float(np.median(roofs)) if len(roofs) else _DEFAULT_HORIZON * height
    rows = _pixels(horizon - _AIR_HEIGHT * height, horizon, height)
    free = ~vehicles[rows]
    if not free.any():
        free = np.ones_like(free)
    gradient = cv2.blur(layers.gradient[rows], (_BLOCK_PX, _BLOCK_PX))
    smooth = free & (gradient <= np.quantile(gradient[free], _SMOOTHEST))
    lab = cv2.cvtColor(np.ascontiguousarray(layers.rgb[rows]), cv2.COLOR_RGB2LAB)[smooth]
    return float(np.median(lab[:, 1])), float(np.median(lab[:, 2]))


def measure_glare(luma: NDArray[np.float32]) -> tuple[int, float | None]:
    """Number of lamps (at most 40), and the median light around them; None without lamps.

    A lamp is a small bright area before a darker background. Its glare is the median luma at 0.5 to 1.5 radii from
    its edge above that at 4 to 6 radii, as a share of what is missing to white: 0 for a sharp disc.
    """
    bright = (luma >= _LAMP_LUMA).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(bright, connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA]
    lamps = [i for i in range(1, len(area)) if _LAMP_AREA_PX[0] <= area[i] <= _LAMP_AREA_PX[1]]
    halos = []
    for i in sorted(lamps, key=lambda lamp: -int(area[lamp])):
        radius = math.sqrt(area[i] / math.pi)
        x0, y0, wide, high = (int(side) for side in stats[i, :4])
        margin = math.ceil(6 * radius) + 2
        rows = slice(max(y0 - margin, 0), y0 + high + margin)
        columns = slice(max(x0 - margin, 0), x0 + wide + margin)
        lamp = labels[rows, columns] == i
        distance = cv2.distanceTransform((~lamp).astype(np.uint8), cv2.DIST_L2, 3)
        around, other = luma[rows, columns], bright[rows, columns] == 0
        near = around[other & (distance >= 1 + 0.5 * radius) & (distance <= 1 + 1.5 * radius)]
        far = around[other & (distance >= 4 * radius) & (distance <= 6 * radius)]
        if len(near) and len(far) and (background := float(np.median(far))) <= _BACKGROUND:
            halos.append((float(np.median(near)) - background) / (1 - background))
        if len(halos) == _MOST_LAMPS:
            break
    return len(halos), float(np.median(halos)) if halos else None
