"""Which pixels of a vehicle are paint: what a texture code recolours, and nothing else.

The fitted mesh says about where paint, glass, tyres and lights are; the photograph says where their borders truly
run, and what the template does not know: plates, stickers, handles, the neighbour's hedge in a window. Both are
weighed as odds. Colours are compared in CIE L*a*b*: paint has one hue, whose chroma falls with the light on it.
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
"""How far the fitted mesh's parts may be off, as a fraction of the vehicle's height, and at least half a pixel."""
_PRIOR = (0.06, 0.94)
"""How sure a mesh can be that a pixel is no paint, and that it is."""
_EVIDENCE = 5.0
"""Largest logarithm of odds that a pixel's colour brings."""
_SPREAD = (9.0, 4.0)
"""Least standard deviations of paint, in L* and in a* and b*: noise, and reflections of the street."""
_TAIL = 1.6
"""Standard deviations of paint beside those of its middle: it is lit from all sides."""
_ANYTHING = 1.0 / (100.0 * 60.0 * 60.0)
"""Density of colours of plates, lights and whatever else is no paint."""
_KNOWN = 0.5
"""Share of what is no paint that looks as most of it does: glass and tyres."""
_FEWEST = 12
"""Pixels below which a kind's colours are not known."""
_OPAQUE = 0.5


@dataclass(frozen=True, slots=True)
class _Look:
    """Colours of one kind of surface: CIE L*a*b* (3,) by the median, and standard deviations (3,)."""

    middle: Array
    spread: Array


def add_paint_regions(scene: SceneIR, backend: verbs.Backend = "warp") -> SceneIR:
    """The scene with `Source.region` of each object: its paint, by the photograph. Needs `objects.source`."""
    if not scene.objects.source:
        return scene
    parts = Compositor(scene, RenderSettings(backend)).project_paint()
    sources = tuple(
        replace(source, region=estimate_paint_region(source.foreground, part))
        for source, part in zip(scene.objects.source, parts, strict=True)
    )
    return replace(scene, objects=replace(scene.objects, source=sources))


def estimate_paint_region(foreground: Crop, part: Crop) -> Crop:
    """How much of each pixel of a foreground (4, h, w) is paint: Crop (1, h, w) in [0, 1].

    part: Crop (1, h, w) of the same place, what the mesh says, continued beyond its outline.
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
    paint, other = _look(lab[inner]), _look(lab[outer])
    prior = cv2.GaussianBlur(mesh, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE).clip(*_PRIOR)
    odds = np.log(prior / (1 - prior))
    if paint is not None:
        evidence = np.log(_density(lab, paint, True) + 1e-12)
        rest = _ANYTHING if other is None else (1 - _KNOWN) * _ANYTHING + _KNOWN * _density(lab, other, False)
        odds = odds + np.clip(evidence - np.log(rest), -_EVIDENCE, _EVIDENCE)
    share = 1 / (1 + np.exp(-odds))
    share = np.where(opacity > _OPAQUE, share, 0.0)
    # A pixel's own noise decides nothing: its neighbours are asked too.
    weight = cv2.GaussianBlur((opacity > _OPAQUE).astype(np.float64), (3, 3), 0.7)
    share = cv2.GaussianBlur(share, (3, 3), 0.7) / np.maximum(weight, 1e-3)
    share = np.clip((share - 0.15) / 0.7, 0, 1) * (opacity > 0)
    return Crop(torch.from_numpy(share[None]).to(foreground.values), foreground.x0, foreground.y0)


def _look(colours: Array) -> _Look | None:
    """The look of colours (K, 3), sure of its middle even where a third of them is something else."""
    if len(colours) < _FEWEST:
        return None
    middle = np.median(colours, axis=0)
    spread = 1.48 * np.median(np.abs(colours - middle), axis=0)
    return _Look(middle, _TAIL * np.maximum(spread, (_SPREAD[0], _SPREAD[1], _SPREAD[1])))


def _density(lab: Array, look: _Look, shaded: bool) -> Array:
    """Density (h, w) of colours (h, w, 3) on a look; shaded: whether chroma falls and rises with lightness."""
    middle = np.broadcast_to(look.middle, lab.shape).copy()
    if shaded:
        middle[..., 1:] *= np.clip(lab[..., :1] / max(look.middle[0], 5.0), 0.3, 1.2)
    apart = (lab - middle) / look.spread
    return np.exp(-0.5 * np.square(apart).sum(-1)) / (np.prod(look.spread) * (2 * np.pi) ** 1.5)
