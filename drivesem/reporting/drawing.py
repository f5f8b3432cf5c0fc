"""Text, labels, and colour maps of depth and objects, drawn into pictures (h, w, 3) uint8 RGB."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from scene_ir import files

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont

MARGIN_PX = 12
TEXT_PX = 15
PAPER_COLOUR = (250, 250, 250)
TEXT_COLOUR = (30, 30, 30)
UNKNOWN_COLOUR = (120, 120, 120)
"""Sky in depth maps, and pixels of no object."""
NEAR_M, FAR_M = 3.0, 200.0
"""Ends of the logarithmic depth scale, m."""
# Okabe and Ito's palette, which colour-blind people can distinguish.
TRUE_COLOUR = (0, 158, 115)
DETECTED_COLOUR = (240, 228, 66)
LOST_COLOUR = (213, 94, 0)
PHANTOM_COLOUR = (204, 121, 167)
IGNORED_COLOUR = (150, 150, 150)
_MAX_LINES_AWAY = 4
"""Farthest a label may be above or below its box, in lines of text, when all nearer positions are taken."""
_HIDDEN_SHARE = 0.2
"""A label hides a box if it covers more than this share of it."""

PixelRect = tuple[int, int, int, int]
"""x0, y0, x1, y1 in px; x1 and y1 are exclusive."""


def write_picture(path: Path, picture: np.ndarray) -> None:
    """Write a picture (h, w, 3) uint8 RGB atomically, as JPEG for such a suffix, otherwise as PNG."""
    if path.suffix.lower() not in (".jpg", ".jpeg"):
        files.write_png(path, picture)
        return
    files.write_bytes(path, _jpeg(picture, 92))


def encode_jpeg_data_url(picture: np.ndarray) -> str:
    """Return a picture (h, w, 3) uint8 as a JPEG data URL, of high quality: people who rate how real a picture
    looks must not rate its compression.
    """
    return f"data:image/jpeg;base64,{base64.b64encode(_jpeg(picture, 90)).decode('ascii')}"


def _jpeg(picture: np.ndarray, quality: int) -> bytes:
    return cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def colourise_depth(depth_m: np.ndarray) -> np.ndarray:
    """Colour depth (h, w) m with viridis on a logarithmic scale, near is bright; sky and unknown depth are grey."""
    known = np.isfinite(depth_m) & (depth_m > 0)
    level = np.log(np.clip(np.where(known, depth_m, FAR_M), NEAR_M, FAR_M) / NEAR_M) / np.log(FAR_M / NEAR_M)
    colours = cv2.applyColorMap((255 * (1 - level)).round().astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]
    return np.where(known[..., None], colours, np.array(UNKNOWN_COLOUR, np.uint8))


def object_palette(count: int) -> np.ndarray:
    """Return a colour (count, 3) uint8 for each object; consecutive objects differ in hue."""
    numbers = np.arange(1, count + 1)
    hue = (numbers * 0.618034 % 1 * 180).astype(np.uint8)  # golden ratio: neighbours lie far apart
    value = np.where(numbers % 2, 235, 190).astype(np.uint8)
    hsv = np.stack([hue, np.full_like(hue, 200), value], axis=1)[None]
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0] if count else np.zeros((0, 3), np.uint8)


def fade_to_grey(image: np.ndarray) -> np.ndarray:
    """Return a picture in pale grey, as a background to draw on."""
    return (128 + cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) // 4)[..., None].repeat(3, axis=2)


def colourise_objects(instances: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Colour object instances (H, W), 0 is none, over the photograph (H, W, 3) in pale grey."""
    colours = np.concatenate([np.zeros((1, 3), np.uint8), object_palette(int(instances.max(initial=0)))])
    return np.where((instances > 0)[..., None], colours[instances], fade_to_grey(image)).astype(np.uint8)


def paste(canvas: np.ndarray, corner: tuple[int, int], picture: np.ndarray) -> None:
    """Copy a picture into a canvas.

    Args:
        canvas: Picture (h, w, 3), changed in place.
        corner: Top left corner (x, y), px.
        picture: Picture that fits.
    """
    x, y = corner
    canvas[y : y + picture.shape[0], x : x + picture.shape[1]] = picture


@lru_cache(maxsize=4)
def _font(size_px: int) -> FreeTypeFont:
    """DejaVu Sans, which ships with matplotlib."""
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size_px)


def measure_text(text: str, size_px: int) -> tuple[int, int]:
    """Return the width and height of a line of text in px, with 2 px of padding on either side."""
    return math.ceil(_font(size_px).getlength(text)) + 4, size_px + 3


def write_text(
    canvas: np.ndarray,
    corner: tuple[int, int],
    text: str,
    colour: tuple[int, int, int] = TEXT_COLOUR,
    size_px: int = TEXT_PX,
) -> None:
    """Draw a line of text into `canvas`; what does not fit is cut off.

    Args:
        canvas: Picture (h, w, 3) uint8, changed in place.
        corner: Top left corner of the text (x, y), px.
        text: The line.
        colour: RGB of the text.
        size_px: Font size.
    """
    from PIL import Image, ImageDraw

    x, y = corner
    wide, high = measure_text(text, size_px)
    part = canvas[max(y, 0) : y + high + 3, max(x, 0) : x + wide]
    picture = Image.fromarray(np.ascontiguousarray(part))
    ImageDraw.Draw(picture).text((0, 0), text, colour, _font(size_px))
    part[:] = np.asarray(picture)


@dataclass(frozen=True, slots=True)
class TextLabel:
    """One line of text on a filled background."""

    text: str
    """The line."""
    colour: tuple[int, int, int]
    """RGB of the text."""
    background: tuple[int, int, int] = (0, 0, 0)
    """RGB behind the text."""
    size_px: int = TEXT_PX - 3
    """Font size."""


@dataclass
class LabelLayout:
    """Labels of the boxes in a picture, placed without overlap while there is room.

    Labels added first get the best positions: above the box, then below, at its sides, inside, then some lines
    away. If all are taken, a label goes where it hides the least of the others.
    """

    size_wh: tuple[int, int]
    """Width and height of the picture, px."""
    protected_boxes: Sequence[Sequence[float]] = ()
    """Boxes xyxy, px, that no label should hide."""
    placed: list[tuple[PixelRect, TextLabel]] = field(default_factory=list)
    """Labels so far, with their positions."""

    def add(self, xyxy: Sequence[float], label: TextLabel, within: bool = False) -> None:
        """Place a label at its box.

        Args:
            xyxy: The box, px.
            label: The label.
            within: Prefer the middle of the box to all other positions.
        """

        def count_overlaps(spot: PixelRect) -> tuple[float, int]:
            others = sum(_overlap_area(spot, taken) for taken, _ in self.placed)
            return others, sum(
                _overlap_area(spot, box) > _HIDDEN_SHARE * _overlap_area(box, box) for box in self.protected_boxes
            )

        extent = measure_text(label.text, label.size_px)
        counted = ((count_overlaps(s), s) for s in _candidate_positions(xyxy, extent, self.size_wh, within))
        best = next(counted)
        while best[0] != (0, 0) and (other := next(counted, None)) is not None:
            best = other if other[0] < best[0] else best
        self.placed.append((best[1], label))

    def draw(self, canvas: np.ndarray) -> None:
        """Draw all labels into `canvas` (H, W, 3) uint8."""
        for (x0, y0, x1, y1), label in self.placed:
            canvas[y0:y1, x0:x1] = label.background
            write_text(canvas, (x0 + 2, y0), label.text, label.colour, label.size_px)


def _overlap_area(a: Sequence[float], b: Sequence[float]) -> float:
    """Return the area that two boxes have in common, px²."""
    return max(min(a[2], b[2]) - max(a[0], b[0]), 0) * max(min(a[3], b[3]) - max(a[1], b[1]), 0)


def _candidate_positions(
    xyxy: Sequence[float], extent: tuple[int, int], size_wh: tuple[int, int], within: bool
) -> Iterator[PixelRect]:
    """Yield positions of a label at its box, all inside the picture, the best first."""
    (wide, high), (x0, y0, x1, y1) = extent, (round(v) for v in xyxy)
    middle = (x0 + x1 - wide + 1) // 2
    corners = [(middle, (y0 + y1 - high + 1) // 2)] if within else []
    columns = (x0 - 1, x1 - wide + 2, middle)
    above, below = y0 - high - 1, y1 + 2
    corners += [(x, y) for y in (above, below) for x in columns]
    corners += [(x, y) for x in (x1 + 3, x0 - wide - 2) for y in (y0 - 1, y1 - high + 2)]
    corners += [(x, y) for y in (y0 + 2, y1 - high - 1) for x in columns]
    for line in range(1, _MAX_LINES_AWAY + 1):
        off = line * (high + 1)
        corners += [(x, y) for y in (above - off, below + off) for x in columns]
    for left, top in corners:
        x, y = (max(min(v, size - long), 0) for v, size, long in zip((left, top), size_wh, extent, strict=True))
        yield x, y, x + wide, y + high
