"""Whether a person can see an object in a picture: its luminance contrast with its surroundings and in itself.

Meteorology counts an object as seen, and recognised, down to a luminance contrast of 0.05: the visual contrast
threshold that the meteorological optical range is based on (CIE S 017, term 17-31-019; ICAO Annex 3). Size needs
no term of its own: thresholds rise for objects of some minutes of arc (Adrian 1989), and a vehicle of 25 px, the
least that KITTI's "moderate" judges, is two degrees high in KITTI's pictures.

A single mean says too little: a car as bright as the road shows by its windows and tyres. So distributions are
compared, as target acquisition does (by means and deviations: Doyle's metric, Copeland and Trivedi 1998), here by
quantiles, which drops and reflections do not move. A uniform object has its Weber contrast.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scene_ir.types import Render

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

LEAST_CONTRAST = 0.05
"""From here on an object counts as seen (source: above)."""
FLARE = 0.05
"""Light, of white's, that a screen adds to all that it shows, by WCAG 2's contrast ratio: why differences among
nearly black pixels are not seen."""
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Of linear red, green and blue (ITU-R BT.709, whose primaries are sRGB's)."""
_QUANTILES = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
_ROWS = 24
"""Of what is higher only so many rows, evenly spread, are looked at, and columns as far apart."""
_RING = 0.25
"""Width of what surrounds an object, of its height."""


def _linear_levels() -> Array:
    display = np.arange(256) / 255
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


_LINEAR = _linear_levels()
"""Light (256,) of sRGB's levels (IEC 61966-2-1), of white's."""


@dataclass(frozen=True, slots=True)
class Surrounded:
    """Pixels of an object and around it. where: rows and columns of a picture, some left out; own, around: flags
    (R, C) of these.
    """

    where: tuple[slice, slice]
    own: Flags
    around: Flags

    @classmethod
    def of(cls, render: Render, i: int) -> Surrounded:
        """Of object `i` of a render."""
        crop = render.opacity[i]
        x0, y0, (height, width) = crop.x0, crop.y0, crop.values.shape[1:]
        step, margin = max(1, height // _ROWS), max(2, round(_RING * height))
        where = (
            slice(max(y0 - margin, 0), y0 + height + margin, step),
            slice(max(x0 - margin, 0), x0 + width + margin, step),
        )
        own = render.object_id[where].cpu().numpy() == i + 1
        reach = 2 * max(1, margin // step) + 1
        near = cv2.dilate(own.view(np.uint8), np.ones((reach, reach), np.uint8))
        return cls(where, own, near.view(np.bool_) & ~own)


def contrasts(render: Render) -> Array:
    """The contrast (N,) of each object in a render; 0 of what does not show.

    Colours are rounded to 8 bits first: what is judged is what is written, and a gradient's pass judges alike.
    """
    image, found = render.image.detach().cpu().numpy(), np.zeros(len(render.opacity))
    for i in range(len(found)):
        pixels = Surrounded.of(render, i)
        light = luminance(image[:, *pixels.where])
        found[i] = contrast_between(light[pixels.own], light[pixels.around])
    return found


def luminance(rgb: NDArray[np.floating[Any]]) -> Array:
    """Luminance (...), of white's, of display colours (3, ...) in [0, 1], rounded to 8 bits."""
    levels = np.rint(np.clip(rgb, 0, 1) * 255).astype(np.uint8)
    return np.tensordot(_LUMINANCE, _LINEAR[levels], axes=1)


def contrast_between(own: Array, around: Array) -> float:
    """The contrast of an object's luminances (K,) with those around it (M,), of white's; 0 where either is empty.

    The mean difference between alike quantiles of the two, or of the object's own from their middle if that is
    more, over the mean luminance, which eyes are adapted to, and FLARE.
    """
    if not (len(own) and len(around)):
        return 0.0
    inside, outside = (np.sort(part)[(_QUANTILES * len(part)).astype(np.int64)] for part in (own, around))
    apart = max(np.abs(inside - outside).mean(), np.abs(inside - inside[len(inside) // 2]).mean())
    return float(apart / (0.5 * (own.mean() + around.mean()) + FLARE))
