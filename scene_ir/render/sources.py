"""Decomposition of a photograph into `Source`s and a background that render to exactly the photograph.

Given photograph I, background B and matte a, the foreground is F = (I - (1 - a) B) / a. That is an identity for
any matte, so the matte is raised only as far as F needs to stay in gamut. Vehicles are solved from the farthest to
the nearest, each against what lies behind it, completions of hidden parts included.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.ndimage
import torch
from torch import Tensor

from scene_ir.errors import ShapeError
from scene_ir.geometry import to_clip
from scene_ir.raster import verbs
from scene_ir.raster.layout import PixelLayout
from scene_ir.render import blend, finish, model, surfaces, texture
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings, VisibleSurfaces
from scene_ir.render.surfaces import nearest_true_pixel
from scene_ir.types import Crop, Objects, SceneIR, Source

_EXTENSION_PX = 4.5
"""Distance over which colours continue under a nearer object: `model.HIDDEN_PX` plus the lookup's kernel."""
_KEEP = 0.02
"""A given background stays under a shadow where background times shadow is this close to the photograph."""
_SOLID = 0.95
"""Opacity from which a pixel shows nothing but the vehicle."""
_COLOUR_SLACK = 0.1
"""Distance by which a foreground colour may leave the range between photograph and vehicle: thin trims do; a wrong
matte or background needs more, and would move with the vehicle as dark or bright specks.
"""
_OPEN = 0.9
"""Share of the sky's light, in display values, that reaches the ground next to a vehicle."""
_LEVELS = 255.0
"""Backgrounds are stored with 8 bits."""


@dataclass(frozen=True, slots=True)
class SolveSettings:
    """Settings of the decomposition."""

    margin_px: float = 3.0
    """Reach of the halo beyond the mesh, px."""
    min_inflation_m: float = 0.02
    """Least reach of the halo, m."""
    complete_shadows: bool = True
    """Whether shadows continue under the vehicles, where the photograph cannot show them."""
    backend: verbs.Backend = "warp"
    """See `RenderSettings`."""


def solve_sources(
    scene: SceneIR,
    alphas: Sequence[Crop],
    shadows: Sequence[Crop | None] | None = None,
    settings: SolveSettings | None = None,
    margins_px: Sequence[float] | None = None,
) -> SceneIR:
    """The scene with `objects.source` and a background such that its unperturbed render is its photograph.

    Where nothing covers the background, it becomes the photograph without shadows. Of occluders, the opacity is
    taken and the colours are solved.

    Args:
        scene: Photograph, background and placed objects; existing sources are replaced.
        alphas: Matte (1, h, w) of each object, 0 where a nearer object hides it.
        shadows: Factor (3, h, w) by which each object darkens the ground, or None.
        settings: Settings.
        margins_px: Margin of each object, instead of `settings.margin_px`.

    Raises:
        ShapeError: Unless there is one matte and one shadow per object.
    """
    settings = settings or SolveSettings()
    count = len(scene.objects)
    shadows = shadows if shadows is not None else [None] * count
    if len(alphas) != count or len(shadows) != count:
        raise ShapeError("mattes and shadows", f"one an object, {count}", f"{len(alphas)} and {len(shadows)}")
    with torch.no_grad():
        margins = list(margins_px) if margins_px is not None else [settings.margin_px] * count
        return _solve_scene(scene, list(alphas), list(shadows), margins, settings)


def photograph_scene(bare: SceneIR, backend: verbs.Backend = "warp") -> SceneIR:
    """A scene without sources, rendered to an 8-bit photograph and decomposed again.

    bare: objects in front of its background, without sources. backend: see `RenderSettings`.
    """
    settings, objects = RenderSettings(backend), bare.objects
    with torch.no_grad():
        shot = Compositor(bare, settings).render(bare)
    order = blend.paint_order(
        objects.size_lhw, objects.yaw, objects.translation, surfaces.camera_centre(bare.camera.matrix)
    )
    clear, mattes = torch.ones_like(bare.depth), list(shot.opacity)
    for i in reversed(order):  # the nearest hides the others
        opacity = shot.opacity[i]
        window = _crop_view(clear[None], opacity)
        mattes[i] = replace(opacity, values=opacity.values * window)
        window *= 1 - opacity.values
    taken = replace(bare, photograph=(shot.image * _LEVELS).round() / _LEVELS)
    return solve_sources(taken, mattes, analytic_shadows(bare, settings), SolveSettings(backend=backend))


def analytic_shadows(scene: SceneIR, settings: RenderSettings | None = None) -> tuple[Crop, ...]:
    """Factor (3, h, w) by which each object's box, in the scene's sun, darkens the ground."""
    bare = replace(scene, objects=replace(scene.objects, source=()))
    with torch.no_grad():
        compositor = Compositor(bare, settings)
        layers = compositor.draw_layers(compositor.scene.objects)
    rects = layers.shadow_layout.rects.tolist()
    return tuple(
        Crop(layers.shadow[packed].T.reshape(3, *size), rects[i][0], rects[i][1])
        for i, (packed, size) in enumerate(layers.shadow_layout.spans())
    )


def _solve_scene(
    scene: SceneIR,
    alphas: list[Crop],
    shadows: list[Crop | None],
    margins_px: list[float],
    settings: SolveSettings,
) -> SceneIR:
    objects, image = scene.objects, scene.photograph
    frame_hw = (scene.camera.height, scene.camera.width)
    blank = [
        _unsolved_source(scene, i, alphas[i], shadows[i], margins_px[i], settings) for i in range(len(objects))
    ]
    staged = scene.with_objects(source=tuple(blank))  # type: ignore[arg-type]
    compositor = Compositor(staged, RenderSettings(settings.backend), whole_patches=True)
    drawn = compositor.find_visible(compositor.scene.objects)
    nearest = drawn.nearest_hits()
    count = len(objects)
    mattes = [_cut_matte(alphas[i], drawn, nearest, i, image) for i in range(count)]
    mattes += [replace(f.foreground, values=f.foreground.values[3:].to(image)) for f in scene.occluders]
    covered = torch.zeros(frame_hw, dtype=torch.bool)
    for matte in mattes:
        _crop_view(covered[None], matte)[0] |= matte.values[0] > 0
    factors = _complete_shadows(compositor, drawn, shadows, covered, settings)
    background = _balance_background(image, scene.background, factors, covered)

    canvas = background.clone()
    for factor in factors:
        _crop_view(canvas, factor).mul_(factor.values)
    order = blend.paint_order(
        objects.size_lhw,
        objects.yaw,
        objects.translation,
        surfaces.camera_centre(scene.camera.matrix),
        blend.occluder_footprints(scene.occluders, scene.camera.matrix),
    )
    behind_nearer = {
        i: texture.occlusion_map([mattes[j] for j in order[place + 1 :]], frame_hw, image)
        for place, i in enumerate(order)
    }
    lit = [factors[i] if shadows[i] is not None else None for i in range(count)]
    blank = _estimate_lighting(scene, blank, mattes, lit, [behind_nearer[i] for i in range(count)], settings)
    solved: dict[int, Source] = {}
    front = list(scene.occluders)
    rects = [
        drawn.mesh.layout.rects[i].tolist() if i < count else _crop_rect(mattes[i]) for i in range(len(mattes))
    ]
    for level in _layer_levels(order, rects, mattes):
        touched: list[int] = []
        for i in level:
            nearer = torch.zeros(frame_hw, dtype=torch.bool)
            later = order[order.index(i) + 1 :]
            for j in later:
                _crop_view(nearer[None], mattes[j])[0] |= mattes[j].values[0] > 0
            if i >= count:
                bare = replace(mattes[i], values=torch.zeros_like(mattes[i].values))
                standing = _solve_foreground(mattes[i], image, canvas, nearer, bare)
                behind = _crop_view(canvas, standing)
                behind.copy_(standing.values[:3] + (1.0 - standing.values[3:]) * behind)
                front[i - count] = replace(front[i - count], foreground=standing)
                continue
            packed, size = drawn.mesh.layout.spans()[i]
            coverage = Crop(drawn.coverage[packed].reshape(1, *size), *rects[i][:2])
            foreground = _solve_foreground(mattes[i], image, canvas, nearer, coverage)
            solved[i] = replace(blank[i], foreground=foreground, shadow=lit[i])
            if any(_touches(rects[i], mattes[j]) for j in later):  # one of them is solved against it
                touched.append(i)
        if touched:
            some = replace(_select_objects(objects, touched), source=tuple(solved[i] for i in touched))
            part = replace(scene, background=canvas, objects=some, occluders=())
            hidden = [behind_nearer[i] for i in touched]
            canvas = _composite_objects(Compositor(part, RenderSettings(settings.backend), hidden=hidden))
    sources = tuple(solved[i] for i in range(count))
    return replace(scene, background=background, objects=replace(objects, source=sources), occluders=tuple(front))


def _layer_levels(order: Sequence[int], rects: Sequence[list[int]], mattes: Sequence[Crop]) -> list[list[int]]:
    """Objects and occluders, far ones first, in levels: those of one level do not touch each other, and each is
    nearer than those of earlier levels that it touches.
    """
    levels: list[list[int]] = []
    level_of: dict[int, int] = {}
    for place, i in enumerate(order):
        touched = (
            level_of[j] + 1 for j in order[:place] if _touches(rects[j], mattes[i]) or _overlap(rects[j], rects[i])
        )
        level_of[i] = max(touched, default=0)
        levels += [[] for _ in range(level_of[i] + 1 - len(levels))]
        levels[level_of[i]].append(i)
    return levels


def _unsolved_source(
    scene: SceneIR, index: int, alpha: Crop, shadow: Crop | None, margin_px: float, settings: SolveSettings
) -> Source:
    """A source with its geometry, not yet solved."""
    objects = scene.objects
    translation = objects.translation[index]
    distance = max(float(to_clip(translation, scene.camera.matrix)[2]), 1.0)
    inflation = max(settings.min_inflation_m, margin_px * distance / float(scene.camera.intrinsics[0, 0]))
    alpha_rgba = torch.cat([torch.zeros_like(alpha.values).expand(3, -1, -1), alpha.values])
    return Source(
        translation, objects.yaw[index], objects.size_lhw[index], objects.ffd[index],
        replace(alpha, values=alpha_rgba), shadow, inflation, torch.ones_like(translation), model.SUNLIGHT,
    )  # fmt: skip


def _estimate_lighting(
    scene: SceneIR,
    blank: list[Source],
    mattes: list[Crop],
    shadows: list[Crop | None],
    hidden: list[Tensor],
    settings: SolveSettings,
) -> list[Source]:
    """Sources with the photographed paint, and the strength of the sun, one for the whole frame."""
    if not blank:
        return blank
    plain = []
    for source, matte in zip(blank, mattes, strict=False):  # mattes of occluders follow
        colour = _crop_view(scene.photograph, matte) * matte.values
        plain.append(replace(source, foreground=replace(matte, values=torch.cat([colour, matte.values]))))
    whole = replace(scene, objects=replace(scene.objects, source=tuple(plain)), occluders=())
    compositor = Compositor(whole, RenderSettings(settings.backend), hidden=hidden)
    samples = compositor.sample_photograph()
    seen = list(zip(compositor.surfaces.templates, samples, strict=True))
    strength = finish.estimate_sunlight(seen, [_sunlight_from_shadow(s, scene.environment.sun) for s in shadows])
    paint = compositor.estimate_paint(samples)
    return [replace(s, paint=paint[i], sunlight=strength) for i, s in enumerate(blank)]


def _select_objects(objects: Objects, rows: Sequence[int]) -> Objects:
    """Some objects, without sources."""
    names = (
        "mesh_index", "translation", "yaw", "size_lhw", "ffd", "texture_code", "category", "box2d", "truncation",
        "occlusion", "lamps",
    )  # fmt: skip
    return replace(objects, source=(), **{n: getattr(objects, n)[list(rows)] for n in names})


def _crop_view(frame: Tensor, crop: Crop) -> Tensor:
    """The view of a frame (C, H, W) at a crop."""
    h, w = crop.values.shape[1:]
    return frame[:, crop.y0 : crop.y0 + h, crop.x0 : crop.x0 + w]


def _crop_rect(crop: Crop) -> list[int]:
    """Rectangle x0, y0, x1, y1, half-open, of a crop."""
    h, w = crop.values.shape[1:]
    return [crop.x0, crop.y0, crop.x0 + w, crop.y0 + h]


def _touches(rect: Sequence[int], matte: Crop) -> bool:
    """Whether a matte has pixels in a rectangle x0, y0, x1, y1, half-open, or adjacent to it."""
    return matte.values.numel() > 0 and _overlap(rect, _crop_rect(matte))


def _overlap(first: Sequence[int], second: Sequence[int]) -> bool:
    """Whether two rectangles x0, y0, x1, y1, half-open, overlap or are adjacent."""
    across = second[0] <= first[2] and first[0] <= second[2]
    return across and second[1] <= first[3] and first[1] <= second[3]


def _cut_matte(alpha: Crop, drawn: VisibleSurfaces, nearest: Tensor, index: int, like: Tensor) -> Crop:
    """The matte where mesh and halo carry it, trimmed to where it is above 0 and may be extended."""
    packed, size = drawn.mesh.layout.spans()[index]
    x0, y0, x1, y1 = drawn.mesh.layout.rects[index].tolist()
    height, width = like.shape[1:]
    carried = (nearest[packed] >= 0).reshape(1, *size).to(like)
    values = texture.extract_crop(alpha, (x0, y0, x1, y1), (height, width)).to(like).clamp(0.0, 1.0) * carried
    return _trim_crop(Crop(values, x0, y0), values[0] > 0, grow=int(np.ceil(_EXTENSION_PX)))


def _trim_crop(crop: Crop, keep: Tensor, grow: int = 0) -> Crop:
    """The smallest part of a crop that holds `keep` (h, w), and `grow` px around it."""
    rows, columns = keep.any(dim=1).nonzero()[:, 0], keep.any(dim=0).nonzero()[:, 0]
    if rows.numel() == 0:
        return Crop(crop.values[:, :0, :0], crop.x0, crop.y0)
    h, w = keep.shape
    top, bottom = max(int(rows[0]) - grow, 0), min(int(rows[-1]) + 1 + grow, h)
    left, right = max(int(columns[0]) - grow, 0), min(int(columns[-1]) + 1 + grow, w)
    return Crop(crop.values[:, top:bottom, left:right].contiguous(), crop.x0 + left, crop.y0 + top)


def _complete_shadows(
    compositor: Compositor,
    drawn: VisibleSurfaces,
    shadows: list[Crop | None],
    covered: Tensor,
    settings: SolveSettings,
) -> list[Crop]:
    """Shadow factors (3, h, w) on the patches that carry them, continued under the vehicles."""
    density = compositor.patch_density(drawn)
    assert drawn.patch_fragments is not None
    out = []
    for i, (packed, size) in enumerate(drawn.patch_layout.spans()):
        x0, y0 = drawn.patch_layout.rects[i, :2].tolist()
        shadow = shadows[i]
        if shadow is None or min(size) == 0:
            out.append(Crop(density.new_ones(3, 0, 0), x0, y0))
            continue
        rect = (x0, y0, x0 + size[1], y0 + size[0])
        height, width = covered.shape
        inverted = replace(shadow, values=1.0 - shadow.values.to(density))
        dark = texture.extract_crop(inverted, rect, (height, width)).clamp(0.0, 1.0)
        expected = density[packed].reshape(size)
        if settings.complete_shadows:
            dark = _extend_shadow(dark, expected, covered[y0 : rect[3], x0 : rect[2]])
        hit = (drawn.patch_fragments.face[packed] >= 0).reshape(1, *size)
        dark = dark * (hit & (dark.amax(dim=0, keepdim=True) > 0.5 / _LEVELS))
        out.append(_trim_crop(Crop(1.0 - dark, x0, y0), dark.amax(dim=0) > 0))
    return out


def _extend_shadow(dark: Tensor, expected: Tensor, covered: Tensor) -> Tensor:
    """Darkness (3, h, w) with its unseen pixels, `covered` (h, w), taken from the expected one (h, w), fitted to
    the visible pixels in strength and, near them, in value.
    """
    seen = (~covered).to(dark)
    sure = seen * (expected > 0.05)
    # Row by row: a sum split between threads depends on their number.
    total = (expected.square() * sure).sum(dim=1).sum()
    strength = (dark * expected * sure).sum(dim=2).sum(dim=1) / total.clamp(min=1e-6)
    strength = strength.clamp(0.3, 1.2) if float(sure.sum()) > 20.0 else torch.ones_like(strength)
    model = (strength[:, None, None] * expected).clamp(0.0, 0.95)

    def smooth(values: Tensor) -> Tensor:
        return torch.from_numpy(scipy.ndimage.gaussian_filter(values.numpy(), (0, 3, 3), mode="nearest"))

    weight = smooth(seen[None])
    rest = smooth((dark - model) * seen) / weight.clamp(min=1e-3) * (2.0 * weight).clamp(max=1.0)
    return torch.where(covered, (model + rest).clamp(0.0, 0.95), dark)


def _balance_background(image: Tensor, background: Tensor, factors: list[Crop], covered: Tensor) -> Tensor:
    """The background for which background times shadows is the photograph where no vehicle covers it.

    Changes `factors` in place where the quantised background requires it.
    """
    product = torch.ones_like(image)
    for factor in factors:
        _crop_view(product, factor).mul_(factor.values)
    free = ~covered
    plain = free & (product == 1.0).all(dim=0)
    near = ((image - background * product).abs().amax(dim=0) <= _KEEP) & free
    lifted = (image / product.clamp(min=0.05)).clamp(max=1.0)
    out = torch.where(near | covered, background, lifted).clamp(0.0, 1.0)
    out = torch.where(plain, image, (out * _LEVELS).round() / _LEVELS)
    # The darkest shadow of a pixel absorbs the rounding error, or the background where the shadow would brighten.
    darkest = torch.full(covered.shape, torch.inf, dtype=image.dtype)
    chosen = torch.full(covered.shape, -1)
    for i, factor in enumerate(factors):
        mean = factor.values.mean(dim=0) if factor.values.numel() else factor.values.new_zeros(0, 0)
        lowest, choice = _crop_view(darkest[None], factor)[0], _crop_view(chosen[None], factor)[0]
        better = (mean < lowest) & (mean < 1.0)
        choice[better] = i
        lowest[better] = mean[better]
    failed = torch.zeros_like(covered)
    for i, factor in enumerate(factors):
        is_darkest = ((_crop_view(chosen[None], factor)[0] == i) & _crop_view(free[None], factor)[0])[None]
        below, goal = _crop_view(out, factor), _crop_view(image, factor)
        others = _crop_view(product, factor) / factor.values.clamp(min=1e-6)
        wanted = goal / (below * others).clamp(min=1e-6)
        below.copy_(torch.where(is_darkest & (wanted > 1.0), goal / others, below))
        factor.values.copy_(torch.where(is_darkest, wanted.clamp(max=1.0), factor.values))
        exact = (below * others * factor.values - goal).abs().amax(dim=0) < 1e-6
        _crop_view(failed[None], factor)[0] |= is_darkest[0] & ((below > 1.0).any(dim=0) | ~exact)
    for factor in factors:
        factor.values.masked_fill_(_crop_view(failed[None], factor), 1.0)
    return torch.where(failed, image, out)


def _solve_foreground(matte: Crop, image: Tensor, canvas: Tensor, nearer: Tensor, coverage: Crop) -> Crop:
    """Premultiplied foreground and matte (4, h, w) over the canvas, extended a little under nearer objects.

    nearer: (H, W) bool, where they are; coverage: (1, h, w) by the mesh, the opacity under them.
    """
    h, w = matte.values.shape[1:]
    if h == 0 or w == 0:
        return Crop(image.new_zeros(4, 0, 0), matte.x0, matte.y0)
    goal, behind = _crop_view(image, matte), _crop_view(canvas, matte)
    opacity = matte.values[0]
    seen = (opacity > 0) & ~_crop_view(nearer[None], matte)[0]
    low, high = _plausible_range(goal, seen & (opacity > _SOLID))
    need = torch.where(
        goal < behind,
        (behind - goal) / (behind - low).clamp(min=1e-6),
        (goal - behind) / (high - behind).clamp(min=1e-6),
    )
    raised = torch.maximum(opacity, need.amax(dim=0)).clamp(max=1.0) * seen
    colour = torch.where(seen, goal - (1.0 - raised) * behind, torch.zeros_like(goal))
    values = torch.cat([colour, raised[None]])
    solid = (seen & (raised > 0.5)).numpy()
    if bool(seen.all()) or not solid.any():
        return replace(matte, values=values)
    distance, index = (torch.from_numpy(part) for part in nearest_true_pixel(solid))
    straight = (colour / raised.clamp(min=0.5)).flatten(1)[:, index]
    rect = (matte.x0, matte.y0, matte.x0 + w, matte.y0 + h)
    filled = texture.extract_crop(coverage, rect, (image.shape[1], image.shape[2])).to(values)
    continued = torch.cat([straight * filled, filled])
    use = (distance <= _EXTENSION_PX) & _crop_view(nearer[None], matte)[0] & ~seen
    return replace(matte, values=torch.where(use, continued, values))


def _plausible_range(goal: Tensor, solid: Tensor) -> tuple[Tensor, Tensor]:
    """Lowest and highest plausible foreground (3, h, w): between the photograph's colour and that of the nearest
    pixel that is all vehicle, `solid` (h, w), with some slack.
    """
    if not bool(solid.any()):
        return torch.zeros_like(goal), torch.ones_like(goal)
    index = torch.from_numpy(nearest_true_pixel(solid.numpy())[1])
    inside = goal.flatten(1)[:, index]
    low = (torch.minimum(goal, inside) - _COLOUR_SLACK).clamp(min=0.0)
    return low, (torch.maximum(goal, inside) + _COLOUR_SLACK).clamp(max=1.0)


def _sunlight_from_shadow(shadow: Crop | None, sun: Tensor) -> float | None:
    """Strength of the sun (3,) that casts this shadow, from the light it removes; None without one."""
    if shadow is None or not shadow.values.numel():
        return None
    core = 1.0 - shadow.values.mean(dim=0)
    if not bool((core > 0.0).any()):
        return None
    left = 1.0 - float(core[core > 0.5 * core.max()].median())
    level = sum(model.AMBIENT)
    return (_OPEN * level / max(left, 0.05) - level) / max(-float(sun[1]), 0.3)


def _composite_objects(part: Compositor) -> Tensor:
    """The background of a scene with its objects laid over it, without their shadows."""
    objects, background = part.scene.objects, part.scene.background
    layers = part.draw_layers(objects)
    no_shadow = PixelLayout.from_rects(layers.shadow_layout.rects * 0)
    plan = blend.BlendPlan.from_layouts(layers.layout, no_shadow, range(len(objects)))
    layer_data = (layers.shadow[:0], layers.colour, layers.opacity, layers.depth)
    return blend.composite(background, part.scene.depth, layer_data, plan, False, part.backend)[0]
