"""Visibility of an object to a person: its luminance contrast with its surroundings and within itself.

In meteorology an object is visible, and recognised, down to a luminance contrast of 0.05: the visual contrast
threshold behind the meteorological optical range (CIE S 017, term 17-31-019; ICAO Annex 3). Size needs no separate
term: thresholds rise for objects of some minutes of arc (Adrian 1989), and a vehicle of 25 px, the smallest that
KITTI's "moderate" includes, is two degrees high in KITTI's pictures.

Comparing means is not enough: a car as bright as the road is visible by its windows and tyres. So distributions
are compared, as in target acquisition (by means and deviations: Doyle's metric, Copeland and Trivedi 1998), here
by quantiles, which rain drops and reflections do not move. A uniform object has its Weber contrast.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_ir.render.environment import apply_weather
from scene_ir.types import Environment, Render

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

MIN_CONTRAST = 0.05
"""Contrast from which an object counts as visible (source: above)."""
FLARE = 0.05
"""Light that a screen adds to every pixel, as a share of white (WCAG 2's contrast ratio): differences among nearly
black pixels are invisible."""
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Weights of linear red, green and blue (ITU-R BT.709, with the primaries of sRGB)."""
_QUANTILES = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
_ROWS = 24
"""Maximum number of evenly spread rows that are sampled; columns are as far apart."""
_RING = 0.25
"""Width of an object's surround, as a share of its height."""


def _linear_levels() -> Array:
    display = np.arange(256) / 255
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


_WEIGHTED = _LUMINANCE[:, None] * _linear_levels()
"""Luminance (3, 256) of sRGB's levels (IEC 61966-2-1) of red, green and blue, as a share of white."""


@dataclass(frozen=True, slots=True)
class ObjectSurround:
    """Sampled pixels of an object and around it."""

    where: tuple[slice, slice]
    """Sampled rows and columns of the picture."""
    own: Flags
    """(R, C), pixels of the object."""
    around: Flags
    """(R, C), pixels around it."""

    @classmethod
    def from_render(cls, render: Render, i: int) -> ObjectSurround:
        """Pixels of object `i` of a render, and around it."""
        crop = render.opacity[i]
        x0, y0, (height, width) = crop.x0, crop.y0, crop.values.shape[1:]
        step, margin = max(1, height // _ROWS), max(2, round(_RING * height))
        where = (
            slice(max(y0 - margin, 0), y0 + height + margin, step),
            slice(max(x0 - margin, 0), x0 + width + margin, step),
        )
        own = render.object_id[where].cpu().numpy() == i + 1
        reach = 2 * max(1, margin // step) + 1
        near = cv2.dilate(own.view(np.uint8), _square(reach))
        return cls(where, own, near.view(np.bool_) & ~own)


def compute_contrasts(render: Render) -> Array:
    """The contrast (N,) of each object in a render; 0 for invisible objects.

    Colours are rounded to 8 bits first, as in the written picture, so that a gradient pass gives the same result.
    """
    image = render.image.detach().cpu().numpy()
    surrounds = [ObjectSurround.from_render(render, i) for i in range(len(render.opacity))]
    parts = [image[:, *s.where][:, flags] for s in surrounds for flags in (s.own, s.around)]
    if not parts:
        return np.zeros(0)
    # At once: most of the time of so few pixels goes into calls.
    ends = np.cumsum([part.shape[1] for part in parts])
    light = np.split(luminance(np.concatenate(parts, axis=1)), ends[:-1])
    return np.array([contrast_between(*pair) for pair in zip(light[::2], light[1::2], strict=True)])


@cache
def _square(side: int) -> NDArray[np.uint8]:
    return np.ones((side, side), np.uint8)


def luminance(rgb: NDArray[np.floating[Any]]) -> Array:
    """Luminance (...), as a share of white, of display colours (3, ...) in [0, 1], rounded to 8 bits."""
    red, green, blue = np.rint(np.minimum(np.maximum(rgb, 0), 1) * 255).astype(np.uint8)
    return _WEIGHTED[0][red] + _WEIGHTED[1][green] + _WEIGHTED[2][blue]


def contrast_between(own: Array, around: Array) -> float:
    """The contrast of an object's luminances (K,) with those around it (M,); 0 where either is empty.

    The mean difference between equal quantiles of the two, or of the object's quantiles from their median if that
    is larger, divided by the mean luminance, which eyes are adapted to, plus FLARE.
    """
    if not (len(own) and len(around)):
        return 0.0
    inside, outside = (np.sort(part)[(_QUANTILES * len(part)).astype(np.int64)] for part in (own, around))
    differences = np.abs(inside - np.stack([outside, inside[[len(inside) // 2] * len(inside)]])).sum(axis=1)
    adapted = 0.5 * (own.sum() / len(own) + around.sum() / len(around))
    return float(differences.max() / len(inside) / (adapted + FLARE))


_PIXELS = 96
"""Evenly spread pixels of each object, and as many around it."""
_MARGIN = 1.25
"""Required contrast over the minimum: pixels are few, cars may move, and rain streaks and reflections are
elsewhere in the real render, which decides in the end."""


class VisibilityUnderWeather:
    """Finds the objects of a scene that become invisible under other weather, from some pixels of the benign
    render. Objects that are fainter than the minimum from the start may not become fainter.
    """

    def __init__(
        self, render: Render, environment: Environment, air: Tensor, visible: Flags, min_contrast: float
    ) -> None:
        """Choose the pixels.

        Args:
            render: the benign render.
            environment: its environment.
            air: (3,), RGB of its airlight.
            visible: (N,), the objects in question.
            min_contrast: contrast from which an object counts as visible.
        """
        places = [_choose_pixels(render, int(i)) for i in np.flatnonzero(visible)]
        self._visible, self._air = visible, air.detach()
        if not places:
            return
        # One row of pixels for each object, and one for those around it.
        at = tuple(torch.from_numpy(np.concatenate([place[k] for place in places])) for k in range(2))
        self._image, self._inverse_depth = render.image.detach()[:, *at], 1 / render.depth.detach()[at]
        nothing = torch.zeros_like(self._inverse_depth)
        sky = environment.sky[at] * (render.object_id[at] == 0)
        self._environment = replace(environment, sky=sky, road=nothing, foliage_map=nothing, ego=None)
        start = self._contrasts(environment.weather.detach())
        self._min_contrast = np.minimum(_MARGIN * min_contrast, start)

    @torch.no_grad()
    def __call__(self, weather: Array) -> Flags:
        """Which objects (N,) become invisible under weather codes (6,); night hides none, since lamps are lit."""
        invisible = np.zeros_like(self._visible)
        if self._visible.any():
            contrasts = self._contrasts(torch.from_numpy(weather).to(self._image))
            invisible[self._visible] = contrasts < self._min_contrast
        return invisible

    def _contrasts(self, weather: Tensor) -> Array:
        environment = replace(self._environment, weather=weather)
        picture = apply_weather(self._image, self._inverse_depth, environment, self._air)
        light = luminance(picture.cpu().numpy())
        return np.array([contrast_between(*rows) for rows in light.reshape(-1, 2, _PIXELS)])


def _choose_pixels(render: Render, i: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns (2, _PIXELS) of pixels of object `i`, and of pixels around it."""
    pixels = ObjectSurround.from_render(render, i)
    chosen = [_spread_evenly(np.flatnonzero(flags)) for flags in (pixels.own, pixels.around)]
    down, across = (np.arange(size)[part] for size, part in zip(render.object_id.shape, pixels.where, strict=True))
    row, column = np.unravel_index(np.stack(chosen), pixels.own.shape)
    return down[row], across[column]


def _spread_evenly(places: NDArray[np.integer[Any]]) -> NDArray[np.integer[Any]]:
    """_PIXELS of the places, evenly spread; some repeat where there are fewer."""
    return places[np.linspace(0, len(places) - 1, _PIXELS).round().astype(np.int64)]
