"""Estimate which pixels of a vehicle are paint, and so change colour with its texture code.

The fitted mesh gives the approximate place of paint, glass, tyres and lights; the photograph gives their true
borders, and what the template lacks: plates, stickers, handles, reflections in windows. Both are combined as odds.
Colours are compared in CIE L*a*b*: paint has one hue, with a chroma that falls with the light on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scene_ir.raster import verbs
from scene_ir.render import texture
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import Crop, SceneIR

Array = NDArray[np.float64]

_BLUR = 0.025
"""Error of the fitted mesh's parts, as a fraction of the vehicle's height; at least half a pixel."""
_PRIOR = (0.06, 0.94)
"""Bounds of the mesh's probability of paint."""
_EVIDENCE = 5.0
"""Bound of the log odds of a pixel's colour."""
_SPREAD = (9.0, 4.0)
"""Least standard deviations of paint, in L* and in a* and b*: noise, and reflections of the street."""
_TAIL = 1.6
"""Factor on paint's standard deviation about its median: it is lit from all sides."""
_OTHER_DENSITY = 1.0 / (100.0 * 60.0 * 60.0)
"""Density of the colours of plates, lights and other parts."""
_TYPICAL_SHARE = 0.5
"""Share of non-paint with typical colours: glass and tyres."""
_MIN_PX = 12
"""Fewer pixels do not determine a surface's colours."""
_OPAQUE = 0.5


@dataclass(frozen=True, slots=True)
class _ColourModel:
    """A normal distribution of one surface's colours in CIE L*a*b*."""

    middle: Array
    """(3,), median."""
    spread: Array
    """(3,), standard deviations."""


def add_paint_regions(scene: SceneIR, backend: verbs.Backend = "warp") -> SceneIR:
    """The scene with the `Source.region` of each vehicle estimated: clothes have no one colour. Needs
    `objects.source`.
    """
    if not scene.objects.source:
        return scene
    parts = Compositor(scene, RenderSettings(backend)).project_paint()
    sources = tuple(
        source if upright else replace(source, region=estimate_paint_region(source.foreground, part))
        for source, part, upright in zip(scene.objects.source, parts, scene.objects.upright.tolist(), strict=True)
    )
    return replace(scene, objects=replace(scene.objects, source=sources))


def estimate_paint_region(foreground: Crop, part: Crop) -> Crop:
    """Share of paint in each pixel of a foreground (4, h, w), as a Crop (1, h, w) in [0, 1].

    `part` is a Crop (1, h, w) at the same place: the mesh's paint, continued beyond its outline.
    """
    rgba = foreground.values.double().numpy()
    mesh = part.values[0].double().numpy()
    if mesh.size == 0:
        return part
    opacity = rgba[3]
    straight = (rgba[:3] / np.maximum(opacity, 0.05)).clip(0, 1)
    rows = torch.from_numpy(straight.reshape(3, -1).T.copy())
    lab = texture.rgb_to_lab(rows).numpy().reshape(*opacity.shape, 3)
    solid = opacity > 0.95
    high = int(np.ptp(np.flatnonzero(solid.any(1)))) + 1 if solid.any() else 1
    sigma = max(_BLUR * high, 0.5)
    inner = solid & (cv2.erode(mesh, np.ones((3, 3))) > 0.95)
    outer = solid & (cv2.dilate(mesh, np.ones((3, 3))) < 0.05)
    paint, other = _fit_colours(lab[inner]), _fit_colours(lab[outer])
    prior = cv2.GaussianBlur(mesh, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE).clip(*_PRIOR)
    odds = np.log(prior / (1 - prior))
    if paint is not None:
        evidence = np.log(_density(lab, paint, True) + 1e-12)
        rest = (
            _OTHER_DENSITY
            if other is None
            else (1 - _TYPICAL_SHARE) * _OTHER_DENSITY + _TYPICAL_SHARE * _density(lab, other, False)
        )
        odds = odds + np.clip(evidence - np.log(rest), -_EVIDENCE, _EVIDENCE)
    share = 1 / (1 + np.exp(-odds))
    share = np.where(opacity > _OPAQUE, share, 0.0)
    # Average over neighbours, so that a pixel's own noise decides nothing.
    weight = cv2.GaussianBlur((opacity > _OPAQUE).astype(np.float64), (3, 3), 0.7)
    share = cv2.GaussianBlur(share, (3, 3), 0.7) / np.maximum(weight, 1e-3)
    share = np.clip((share - 0.15) / 0.7, 0, 1) * (opacity > 0)
    return Crop(torch.from_numpy(share[None]).to(foreground.values), foreground.x0, foreground.y0)


def _fit_colours(colours: Array) -> _ColourModel | None:
    """Colour model of colours (K, 3), robust against a third of outliers; None for too few."""
    if len(colours) < _MIN_PX:
        return None
    middle = np.median(colours, axis=0)
    spread = 1.48 * np.median(np.abs(colours - middle), axis=0)
    return _ColourModel(middle, _TAIL * np.maximum(spread, (_SPREAD[0], _SPREAD[1], _SPREAD[1])))


def _density(lab: Array, model: _ColourModel, shaded: bool) -> Array:
    """Density (h, w) of colours (h, w, 3) under a model; if `shaded`, chroma scales with lightness."""
    middle = np.broadcast_to(model.middle, lab.shape).copy()
    if shaded:
        middle[..., 1:] *= np.clip(lab[..., :1] / max(model.middle[0], 5.0), 0.3, 1.2)
    apart = (lab - middle) / model.spread
    return np.exp(-0.5 * np.square(apart).sum(-1)) / (np.prod(model.spread) * (2 * np.pi) ** 1.5)
