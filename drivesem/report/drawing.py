"""What sheets are drawn with: texts, and pictures of depth and of objects. Pictures are (h, w, 3) uint8 RGB."""

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
PAPER = (250, 250, 250)
INK = (30, 30, 30)
UNKNOWN = (120, 120, 120)
"""Sky in depth maps; pixels of no object."""
NEAR_M, FAR_M = 3.0, 200.0
"""Ends of the depth scale, which is logarithmic."""
_LINES_OFF = 4
"""So many lines of text above or below its box a label may stand where all nearer places are taken."""
_HIDDEN = 0.2
"""Share of a box from which on a label hides it."""

Spot = tuple[int, int, int, int]
"""x0, y0, x1, y1 px; x1 and y1 are outside."""


def write_picture(path: Path, picture: np.ndarray) -> None:
    """Write a picture (h, w, 3) uint8 RGB as PNG, or as JPEG where the name says so, atomically."""
    if path.suffix.lower() not in (".jpg", ".jpeg"):
        files.write_png(path, picture)
        return
    files.write_bytes(path, _jpeg(picture, 92))


def jpeg_address(picture: np.ndarray) -> str:
    """A picture as JPEG in the address by which a page shows it. Its quality is high, or people who are asked how
    real it looks would judge the compression.
    """
    return f"data:image/jpeg;base64,{base64.b64encode(_jpeg(picture, 90)).decode('ascii')}"


def _jpeg(picture: np.ndarray, quality: int) -> bytes:
    return cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def depth_colours(depth_m: np.ndarray) -> np.ndarray:
    """Depth in viridis, near is bright, on a logarithmic scale; the sky, and no depth, in grey."""
    known = np.isfinite(depth_m) & (depth_m > 0)
    level = np.log(np.clip(np.where(known, depth_m, FAR_M), NEAR_M, FAR_M) / NEAR_M) / np.log(FAR_M / NEAR_M)
    colours = cv2.applyColorMap((255 * (1 - level)).round().astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]
    return np.where(known[..., None], colours, np.array(UNKNOWN, np.uint8))


def palette(count: int) -> np.ndarray:
    """Colours (count, 3) uint8 of objects 0, 1, ..., in hues that differ from number to number."""
    numbers = np.arange(1, count + 1)
    hue = (numbers * 0.618034 % 1 * 180).astype(np.uint8)  # golden ratio: neighbours lie far apart
    value = np.where(numbers % 2, 235, 190).astype(np.uint8)
    hsv = np.stack([hue, np.full_like(hue, 200), value], axis=1)[None]
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0] if count else np.zeros((0, 3), np.uint8)


def pale(image: np.ndarray) -> np.ndarray:
    """A picture in pale grey, to draw on."""
    return (128 + cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) // 4)[..., None].repeat(3, axis=2)


def object_colours(instances: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Objects, instances (H, W) from 1, 0 is none, in their colours over the photograph in pale grey."""
    colours = np.concatenate([np.zeros((1, 3), np.uint8), palette(int(instances.max(initial=0)))])
    return np.where((instances > 0)[..., None], colours[instances], pale(image)).astype(np.uint8)


def paste(canvas: np.ndarray, corner: tuple[int, int], picture: np.ndarray) -> None:
    """Lay a picture over `canvas`, its upper left corner at `corner`."""
    x, y = corner
    canvas[y : y + picture.shape[0], x : x + picture.shape[1]] = picture


@lru_cache(maxsize=4)
def _font(size_px: int) -> FreeTypeFont:
    """DejaVu Sans, which matplotlib brings along."""
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size_px)


def text_extent(text: str, size_px: int) -> tuple[int, int]:
    """Width and height in px that a text takes, with a margin of 2 px at its sides."""
    return math.ceil(_font(size_px).getlength(text)) + 4, size_px + 3


def write_text(
    canvas: np.ndarray,
    corner: tuple[int, int],
    text: str,
    colour: tuple[int, int, int] = INK,
    size_px: int = TEXT_PX,
) -> None:
    """Write a line of text into `canvas`, its upper left corner at `corner`; what leaves the canvas is cut."""
    from PIL import Image, ImageDraw

    x, y = corner
    wide, high = text_extent(text, size_px)
    part = canvas[max(y, 0) : y + high + 3, max(x, 0) : x + wide]
    picture = Image.fromarray(np.ascontiguousarray(part))
    ImageDraw.Draw(picture).text((0, 0), text, colour, _font(size_px))
    part[:] = np.asarray(picture)


@dataclass(frozen=True, slots=True)
class Label:
    """A line of text on a plate. colour: of the text; plate: behind it."""

    text: str
    colour: tuple[int, int, int]
    plate: tuple[int, int, int] = (0, 0, 0)
    size_px: int = TEXT_PX - 3


@dataclass
class Labels:
    """Texts at the boxes of a picture of size_wh px, none of them over another where there is room.

    The text that is added first has the best place: above its box; else below it, beside it, inside, or some lines
    further off. Where all of these are taken, it stands where it hides the least of the others. seen: boxes
    (x0, y0, x1, y1) px that no text should hide.
    """

    size_wh: tuple[int, int]
    seen: Sequence[Sequence[float]] = ()
    placed: list[tuple[Spot, Label]] = field(default_factory=list)

    def add(self, xyxy: Sequence[float], label: Label, within: bool = False) -> None:
        """Find a label's place at its box. within: the box's middle comes before all others."""

        def covers(spot: Spot) -> tuple[float, int]:
            others = sum(_shared(spot, taken) for taken, _ in self.placed)
            return others, sum(_shared(spot, box) > _HIDDEN * _shared(box, box) for box in self.seen)

        extent = text_extent(label.text, label.size_px)
        self.placed.append((min(_places(xyxy, extent, self.size_wh, within), key=covers), label))

    def draw(self, canvas: np.ndarray) -> None:
        """Write all of them into `canvas` (H, W, 3)."""
        for (x0, y0, x1, y1), label in self.placed:
            canvas[y0:y1, x0:x1] = label.plate
            write_text(canvas, (x0 + 2, y0), label.text, label.colour, label.size_px)


def _shared(a: Sequence[float], b: Sequence[float]) -> float:
    """How many px two boxes share."""
    return max(min(a[2], b[2]) - max(a[0], b[0]), 0) * max(min(a[3], b[3]) - max(a[1], b[1]), 0)


def _places(
    xyxy: Sequence[float], extent: tuple[int, int], size_wh: tuple[int, int], within: bool
) -> Iterator[Spot]:
    """Where a text of an extent may stand at a box, all inside of the picture, the best first."""
    (wide, high), (x0, y0, x1, y1) = extent, (round(v) for v in xyxy)
    middle = (x0 + x1 - wide + 1) // 2
    corners = [(middle, (y0 + y1 - high + 1) // 2)] if within else []
    columns = (x0 - 1, x1 - wide + 2, middle)
    above, below = y0 - high - 1, y1 + 2
    corners += [(x, y) for y in (above, below) for x in columns]
    corners += [(x, y) for x in (x1 + 3, x0 - wide - 2) for y in (y0 - 1, y1 - high + 2)]  # beside
    corners += [(x, y) for y in (y0 + 2, y1 - high - 1) for x in columns]
    for line in range(1, _LINES_OFF + 1):
        off = line * (high + 1)
        corners += [(x, y) for y in (above - off, below + off) for x in columns]
    for left, top in corners:
        x, y = (max(min(v, size - long), 0) for v, size, long in zip((left, top), size_wh, extent, strict=True))
        yield x, y, x + wide, y + high
