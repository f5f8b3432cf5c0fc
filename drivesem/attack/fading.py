"""Who fades from sight in which weather, told from some of the benign picture's own pixels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from drivesem.attack.contrast import Array, Flags, Surrounded, contrast_between, luminance
from scene_ir.render.environment import apply_weather
from scene_ir.types import Environment, Render

_PIXELS = 96
"""Of each object, and as many around it, evenly spread."""
_MARGIN = 1.25
"""Contrast that is asked for, of the least that counts as seen: pixels are few, cars may move, and neither streaks
nor what wet roads mirror lie where the picture has them. What counts is judged by the picture itself."""


class Fading:
    """Objects of one scene that are seen, and which of them no longer are under other weather.

    render, environment: the benign ones; air (3,): RGB of its airlight; seen (N,): the objects that are asked for;
    least: contrast that counts as seen. Who is fainter from the start may not become fainter.
    """

    def __init__(self, render: Render, environment: Environment, air: Tensor, seen: Flags, least: float) -> None:
        places = [_places(render, int(i)) for i in np.flatnonzero(seen)]
        self._seen, self._air = seen, air.detach()
        if not places:
            return
        # A row of pixels for each object, and one for those around it.
        at = tuple(torch.from_numpy(np.concatenate([place[k] for place in places])) for k in range(2))
        self._image, self._inverse_depth = render.image.detach()[:, *at], 1 / render.depth.detach()[at]
        nothing = torch.zeros_like(self._inverse_depth)
        sky = environment.sky[at] * (render.object_id[at] == 0)
        self._environment = replace(environment, sky=sky, road=nothing, foliage_map=nothing)
        start = self._contrasts(environment.weather.detach())
        self._least = np.minimum(_MARGIN * least, start)

    @torch.no_grad()
    def __call__(self, weather: Array) -> Flags:
        """Which objects (N,) fade under codes (4,)."""
        fades = np.zeros_like(self._seen)
        if self._seen.any():
            fades[self._seen] = self._contrasts(torch.from_numpy(weather).to(self._image)) < self._least
        return fades

    def _contrasts(self, weather: Tensor) -> Array:
        environment = replace(self._environment, weather=weather)
        picture = apply_weather(self._image, self._inverse_depth, environment, self._air)
        light = luminance(picture.cpu().numpy())
        return np.array([contrast_between(*rows) for rows in light.reshape(-1, 2, _PIXELS)])


def _places(render: Render, i: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns (2, _PIXELS) of pixels of object `i`, and around it."""
    pixels = Surrounded.of(render, i)
    spread = [_spread(np.flatnonzero(flags)) for flags in (pixels.own, pixels.around)]
    down, across = (np.arange(size)[part] for size, part in zip(render.object_id.shape, pixels.where, strict=True))
    row, column = np.unravel_index(np.stack(spread), pixels.own.shape)
    return down[row], across[column]


def _spread(places: NDArray[np.integer[Any]]) -> NDArray[np.integer[Any]]:
    """So many of some places as there are _PIXELS, evenly; again where there are fewer."""
    return places[np.linspace(0, len(places) - 1, _PIXELS).round().astype(np.int64)]
