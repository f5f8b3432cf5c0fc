"""Projective texture: colours of a vehicle's surface from the photograph, and paint changes on top of them.

Shapes: R rows, one per pixel of an object's layer; S texels of all sources. RGB in [0, 1].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from scene_ir.geometry import clamp_inclusive
from scene_ir.raster import verbs
from scene_ir.render import model
from scene_ir.render.surfaces import nearest_true_pixel
from scene_ir.types import TEXTURE_DIM, Crop, Objects, Source

_PAD = 2
"""Texels around a crop that complete the 4x4 Catmull-Rom footprint at its edge."""
_DEEP_PX = 4.0
"""Deeper inside the mesh than this, texels are equally far from the outline."""


def smoothstep(x: Tensor, low: float, high: float) -> Tensor:
    """Hermite cubic: exactly 0 up to `low`, exactly 1 from `high` on, continuously differentiable.

    Args:
        x: Values.
        low, high: Bounds.
    """
    return _Smoothstep.apply(x, low, high)


class _Smoothstep(torch.autograd.Function):
    """One node instead of autograd's six: rendering evaluates it twenty times per pixel."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, low: float, high: float) -> Tensor:
        t = ((x - low) / (high - low)).clamp_(0.0, 1.0)
        if ctx.needs_input_grad[0]:
            ctx.save_for_backward(t)
            ctx.scale = 6.0 / (high - low)
        return t * t * (3.0 - 2.0 * t)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None, None]:
        (t,) = ctx.saved_tensors
        return grad_outputs[0] * (t - t * t).mul_(ctx.scale), None, None


@dataclass(frozen=True, slots=True)
class PhotographTexels:
    """The photograph's content for each object, as packed crops."""

    values: Tensor
    """(S, C)."""
    rects: Tensor
    """(N, 4) int64 px, half-open, position of each crop in the frame."""
    offsets: Tensor
    """(N + 1,) int64, first texel of each crop."""

    @classmethod
    def from_crops(cls, crops: Sequence[Crop], like: Tensor) -> PhotographTexels:
        """Packed crops with equal channel counts, in the dtype and on the device of `like`."""
        rows = [crop.values.flatten(1).T.to(like) for crop in crops]
        rects = [
            [c.x0, c.y0, c.x0 + c.values.shape[2], c.y0 + c.values.shape[1]] if c.values.numel() else [0, 0, 0, 0]
            for c in crops
        ]
        offsets = np.cumsum([0] + [r.shape[0] for r in rows])
        return cls(
            torch.cat(rows).contiguous(),
            torch.tensor(rects, dtype=torch.int64, device=like.device),
            torch.as_tensor(offsets, dtype=torch.int64, device=like.device),
        )

    def sample(self, uv: Tensor, counts: Tensor, backend: verbs.Backend, border: verbs.Border) -> Tensor:
        """Catmull-Rom lookups (R, C).

        Args:
            uv: (R, 2) px of the frame, grouped by object.
            counts: (N,) rows of each object.
            backend: Implementation.
            border: Values beyond the crops, see `verbs.texture`.
        """
        zero = torch.zeros_like(counts)
        layout = verbs.PixelLayout.from_rects(torch.stack([zero, zero, counts, torch.ones_like(counts)], dim=-1))
        return verbs.texture_packed(self.values, self.rects, self.offsets, layout, uv, backend, border)

    def sample_mesh_and_halo(self, uv: Tensor, counts: Tensor, backend: verbs.Backend) -> Tensor:
        """`sample` with 0 beyond the crops, for rows of the objects' meshes, then of their halos.

        Args:
            uv: (R, 2) px.
            counts: (2N,) rows of each mesh, then of each halo.
            backend: Implementation.
        """
        twice = PhotographTexels(
            torch.cat([self.values, self.values]),
            torch.cat([self.rects, self.rects]),
            torch.cat([self.offsets, self.offsets[1:] + self.values.shape[0]]),
        )
        return twice.sample(uv, counts, backend, "zero")


@dataclass(frozen=True, slots=True)
class PaintRegions:
    """Where N objects are paint according to the photograph."""

    texels: PhotographTexels
    """One channel in [0, 1]."""
    known: Tensor
    """(N,) bool; where false, the object's texels are empty."""

    @classmethod
    def concat(cls, parts: Sequence[PaintRegions]) -> PaintRegions:
        """The regions of several scenes' objects, concatenated."""
        if len(parts) == 1:
            return parts[0]
        starts = np.cumsum([0] + [p.texels.values.shape[0] for p in parts])
        offsets = [p.texels.offsets[:-1] + int(start) for p, start in zip(parts, starts[:-1], strict=True)]
        end = parts[0].texels.offsets.new_tensor([int(starts[-1])])
        texels = PhotographTexels(
            torch.cat([p.texels.values for p in parts]),
            torch.cat([p.texels.rects for p in parts]),
            torch.cat([*offsets, end]),
        )
        return cls(texels, torch.cat([p.known for p in parts]))


def paint_share(mesh: Tensor, region: Tensor, unseen: Tensor, known: Tensor) -> Tensor:
    """Paint share of each pixel (R,): from the photographed region where seen, else from the mesh's parts.

    Args:
        mesh: (R,) share by the mesh.
        region: (R,) share by the photographed region.
        unseen: (R,) share of the pixel that the photograph did not see.
        known: (R,) bool, whether there is a region.
    """
    return torch.where(known, region + unseen * (mesh - region), mesh)


def extract_crop(crop: Crop, rect: Sequence[int], frame_hw: tuple[int, int]) -> Tensor:
    """The part of a crop inside a rectangle that may reach beyond the frame.

    Beyond the frame, edge pixels repeat, since a vehicle continues there.

    Args:
        crop: (C, h, w).
        rect: x0, y0, x1, y1 px, half-open.
        frame_hw: Frame size, px.

    Returns:
        (C, y1 - y0, x1 - x0), 0 outside the crop.
    """
    height, width = frame_hw
    x0, y0, x1, y1 = rect
    rows = (torch.arange(y0, y1).clamp(0, height - 1) - crop.y0).to(crop.values.device)
    columns = (torch.arange(x0, x1).clamp(0, width - 1) - crop.x0).to(crop.values.device)
    h, w = crop.values.shape[1:]
    if h == 0 or w == 0:
        return crop.values.new_zeros(crop.values.shape[0], y1 - y0, x1 - x0)
    known = ((rows >= 0) & (rows < h))[:, None] & ((columns >= 0) & (columns < w))[None, :]
    picked = crop.values[:, rows.clamp(0, h - 1)][:, :, columns.clamp(0, w - 1)]
    return picked * known


def build_texels(
    source: Source, mesh_depth: Crop, hidden: Tensor, rect: Sequence[int], frame_hw: tuple[int, int]
) -> Crop:
    """The `channels.TEXEL` channels of one object's texels inside a padded rectangle.

    Beyond the mesh, texels belong to the outline and have the depth of its nearest piece.

    Args:
        source: Foreground of the object.
        mesh_depth: (1, h, w) m of the unperturbed mesh, inf outside.
        hidden: (H, W) in [0, 1], 1 where a nearer object covers this one.
        rect: x0, y0, x1, y1 px, half-open.
        frame_hw: Frame size, px.
    """
    x0, y0, x1, y1 = rect[0] - _PAD, rect[1] - _PAD, rect[2] + _PAD, rect[3] + _PAD
    window = (x0, y0, x1, y1)
    rgba = extract_crop(source.foreground, window, frame_hw)
    frame = Crop(hidden[None], 0, 0)
    covered = torch.isfinite(mesh_depth.values)
    padded = extract_crop(Crop(covered.to(rgba), mesh_depth.x0, mesh_depth.y0), window, frame_hw)[0] > 0.5
    finite = torch.where(covered, mesh_depth.values, torch.zeros_like(mesh_depth.values)).to(rgba)
    known = extract_crop(Crop(finite, mesh_depth.x0, mesh_depth.y0), window, frame_hw)
    deepest = _deepest_neighbour(extend_nearest(known, padded))
    # A halo moves with its nearest piece of outline, which takes a part of its depth from its neighbours.
    depth = torch.maximum(deepest, extend_nearest(_deepest_neighbour(known * padded), padded))
    inside = np.pad(padded.cpu().numpy().astype(np.uint8), 1, mode="edge")
    distance = cv2.distanceTransform(inside, cv2.DIST_L2, 5)[1:-1, 1:-1]
    inset = torch.from_numpy(np.ascontiguousarray(distance)).to(rgba).clamp(max=_DEEP_PX)
    pool = 2 * model.SUPPORT_PX + 1
    support = torch.nn.functional.max_pool2d(rgba[3:][None], pool, stride=1, padding=model.SUPPORT_PX)[0]
    values = torch.cat([rgba, extract_crop(frame, window, frame_hw).to(rgba), inset[None], depth, support])
    return Crop(values, x0, y0)


def _deepest_neighbour(depth: Tensor) -> Tensor:
    """Largest depth (1, h, w) of each pixel and the eight around it."""
    return torch.nn.functional.max_pool2d(depth[None], 3, stride=1, padding=1)[0]


def extend_nearest(values: Tensor, known: Tensor) -> Tensor:
    """Values (C, h, w) where `known` (h, w), elsewhere those of the nearest known pixel; unchanged if none is
    known.
    """
    mask = known.cpu().numpy()
    if not mask.any():
        return values
    index = torch.from_numpy(nearest_true_pixel(mask)[1]).to(values.device)
    return values.flatten(1)[:, index]


def occlusion_map(mattes: Sequence[Crop], frame_hw: tuple[int, int], like: Tensor) -> Tensor:
    """(H, W) in [0, 1]: 1 well inside the mattes of nearer objects, 0 where they are transparent.

    Depends only on where mattes are above 0, as the solution raises their values as it proceeds.

    Args:
        mattes: Crops (1, h, w).
        frame_hw: Frame size, px.
        like: Tensor of the wanted dtype and device.
    """
    support = np.zeros(frame_hw, dtype=np.uint8)
    for matte in mattes:
        h, w = matte.values.shape[1:]
        region = support[matte.y0 : matte.y0 + h, matte.x0 : matte.x0 + w]
        region[matte.values[0].detach().cpu().numpy() > 0.0] = 1
    out = like.new_zeros(frame_hw)
    x, y, w, h = cv2.boundingRect(support)
    if not w:
        return out
    # One pixel of margin, clipped to the frame: distances are measured to the mattes' edges, not to the frame's.
    window = (slice(max(y - 1, 0), y + h + 1), slice(max(x - 1, 0), x + w + 1))
    padded = np.pad(support[window], 1, mode="edge")
    distance = np.ascontiguousarray(cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1])
    out[window] = smoothstep(torch.from_numpy(distance).to(like), *model.HIDDEN_PX)
    return out


def facing_weight(turned: Tensor, cos_source: Tensor, paint: Tensor) -> Tensor:
    """1 where a texel was seen squarely enough for how it is shown now, 0 where it would smear.

    Exactly 1, with zero slope, where nothing turned.

    Args:
        turned: Cosine towards the camera now minus then.
        cos_source: Cosine then.
        paint: Paint share of the mesh.
    """
    positive = 0.5 * (cos_source + (cos_source.square() + model.SQUARED_COS).sqrt())
    rest, coat = model.GRAZING
    return 1.0 - smoothstep(turned / (positive + rest + (coat - rest) * paint), *model.STRETCH)


def outline_share(inset: Tensor) -> Tensor:
    """Outline share of a texel: 1 outside the photographed mesh and up to `model.OUTLINE_PX` inside it.

    inset: (R,) px to the nearest texel centre that the mesh does not cover, 0 there.
    """
    return 1.0 - smoothstep(inset, *model.OUTLINE_PX)


def outline_weight(turned: Tensor) -> Tensor:
    """1 where a point of the outline still is one, 0 where it turned away or towards the camera."""
    low, high = model.OUTLINE_TURN
    return 1.0 - smoothstep(turned.square(), low * low, high * high)


def inside_weight(uv: Tensor, height: int, width: int, fade_px: tuple[float, float] = model.BORDER_PX) -> Tensor:
    """1 in the photograph and up to fade_px[0] beyond it, falling to 0 at fade_px[1].

    Args:
        uv: (R, 2) px.
        height, width: Size of the photograph, px.
        fade_px: Distances beyond the border.
    """
    limit = uv.new_tensor([width - 1.0, height - 1.0])
    beyond = torch.maximum(-uv, uv - limit)
    return (1.0 - smoothstep(beyond, *fade_px)).prod(dim=-1)


def codes_by_part(objects: Objects) -> Tensor:
    """Texture codes (N, 5), or (N, 8) in which an object without a waist has its tint below it too."""
    code = objects.texture_code
    if code.shape[1] == TEXTURE_DIM:
        return code
    lower = torch.where(objects.parted[:, None], code[:, TEXTURE_DIM:], code[:, :3])
    return torch.cat([code[:, :TEXTURE_DIM], lower], dim=1)


def codes_at_height(code: Tensor, height: Tensor) -> Tensor:
    """Texture codes (R, 5) of places on objects.

    Args:
        code: (R, 5) or (R, 8), see `codes_by_part`.
        height: (R,) 0 at the object's foot, 1 at its top.
    """
    if code.shape[1] == TEXTURE_DIM:
        return code
    upper, rest, lower = code.split([3, TEXTURE_DIM - 3, 3], dim=1)
    below = 1.0 - smoothstep(height, *model.WAIST)
    return torch.cat([upper + below[:, None] * (lower - upper), rest], dim=1)


def apply_texture_code(
    colour: Tensor,
    opacity: Tensor,
    code: Tensor,
    paint: Tensor,
    height: Tensor,
    base_lightness: Tensor,
    backend: verbs.Backend = "reference",
) -> Tensor:
    """Premultiplied colours (R, 3) with the paint changed; the same bits where the code is 0.

    The change is f(colour, code) - f(colour, 0): it is 0 at code 0, its slope is not.

    Args:
        colour: (R, 3) premultiplied RGB.
        opacity: (R,).
        code: (R, 5) lightness, a*, b*, gloss, dirt in (-1, 1).
        paint: (R,) paint share of the pixel.
        height: (R,) 0 at the vehicle's foot, 1 at its roof (dirt gathers low).
        base_lightness: (R,) CIE L* of the paint, about which gloss changes contrast.
        backend: Implementation.
    """
    if backend == "warp":
        from scene_ir.render.kernels.colour import repaint

        return repaint(colour, opacity, code, paint, height, base_lightness)
    index = ((paint > 0.0) & (opacity > 0.0)).nonzero()[:, 0]
    if index.numel() == 0:
        return colour
    alpha = opacity[index]
    straight = clamp_inclusive(colour[index] / alpha.clamp(min=model.LEAST_ALPHA)[:, None], 0.0, 1.0)
    arguments = (height[index], base_lightness[index])
    change = _paint(straight, code[index], *arguments) - _paint(
        straight, torch.zeros_like(code[index]), *arguments
    )
    return colour.index_add(0, index, change * (alpha * paint[index])[:, None])


def _paint(rgb: Tensor, code: Tensor, height: Tensor, base_lightness: Tensor) -> Tensor:
    """The paint model: a curve in CIE L*, shifts of a* and b*, and a veil of dust. rgb (R, 3), code (R, 5)."""
    lightness, a, b = rgb_to_lab(rgb).unbind(-1)
    shift, red, yellow, gloss, dirt = code.unbind(-1)
    level = clamp_inclusive(lightness / 100.0, *model.LEVEL)
    glossy = gloss * model.GLOSS_GAIN * (lightness - base_lightness) / model.GLOSSY_L
    level = torch.sigmoid(torch.logit(level) + model.LIGHTNESS_GAIN * shift + glossy)
    room = 4.0 * level * (1.0 - level)
    red, yellow = a + model.CHROMA_GAIN * red * room, b + model.CHROMA_GAIN * yellow * room
    changed = torch.stack([100.0 * level, red, yellow], dim=-1)
    out = lab_to_soft_rgb(changed)
    veil = (dirt * model.DIRT_GAIN * (1.0 - model.CLEAN_ROOF * clamp_inclusive(height, 0.0, 1.0)))[:, None]
    return out + veil * (out.new_tensor(model.DUST_RGB) - out)


def rgb_to_lab(rgb: Tensor) -> Tensor:
    """CIE L*a*b* (R, 3) of sRGB rows (R, 3)."""
    import kornia

    return kornia.color.rgb_to_lab(rgb.T[None, :, :, None])[0, :, :, 0].T


def lab_to_soft_rgb(lab_rows: Tensor) -> Tensor:
    """sRGB rows (R, 3) in (0, 1) of CIE L*a*b* rows (R, 3).

    Colours out of gamut bend back softly, so that near black and white this is not the inverse of `rgb_to_lab`:
    use differences of two results.
    """
    rgb = lab_to_rgb(lab_rows)
    softplus = torch.nn.functional.softplus
    return softplus(rgb, beta=model.GAMUT_SHARPNESS) - softplus(rgb - 1.0, beta=model.GAMUT_SHARPNESS)


def lab_to_rgb(lab_rows: Tensor) -> Tensor:
    """sRGB rows (R, 3) of CIE L*a*b* rows (R, 3): the inverse of `rgb_to_lab`, beyond [0, 1] out of gamut."""
    import kornia

    return kornia.color.lab_to_rgb(lab_rows.T[None, :, :, None], clip=False)[0, :, :, 0].T


def daylight(normal: Tensor, sun: Tensor, sunlight: Tensor | float) -> Tensor:
    """Light (R,) on surfaces in the open: sky dome, ground bounce and sun.

    Args:
        normal: (R, 3) unit.
        sun: (3,) or (R, 3) unit vector towards the sun.
        sunlight: (R,) strength of the sun.
    """
    around, above = model.AMBIENT
    return (around + above * (0.5 - 0.5 * normal[:, 1])) + sunlight * sun_exposure((normal * sun).sum(-1))


def sun_exposure(cos: Tensor) -> Tensor:
    """How squarely the sun meets a surface with this cosine to it; smooth, 0 from behind."""
    return 0.5 * (cos + (cos.square() + model.TERMINATOR).sqrt())


def shade_template(
    normal: Tensor,
    to_eye: Tensor,
    albedo: Tensor,
    sheen: Tensor,
    height: Tensor,
    sun: Tensor,
    sunlight: Tensor | float = model.SUNLIGHT,
) -> Tensor:
    """Daylight on a vehicle's template colours: RGB (R, 3), not clamped.

    Sky dome and ground bounce, a sun with a highlight, and a Fresnel reflection of a plain street and sky.

    Args:
        normal, to_eye: (R, 3) unit.
        albedo: (R, 3).
        sheen: (R, 2) shares of paint and glass in [0, 1].
        height: (R,) 0 at the foot, 1 at the roof.
        sun: (3,) or (R, 3) unit.
        sunlight: (R,) strength of the sun.
    """
    foot, *heights = model.OCCLUDED
    occluded = foot + (1.0 - foot) * smoothstep(height, *heights)
    diffuse = daylight(normal, sun, sunlight) * occluded
    cos = clamp_inclusive((normal * to_eye).sum(-1), 0.0, 1.0)
    mirror = 2.0 * cos[:, None] * normal - to_eye
    sky_up = -mirror[:, 1]
    ground, horizon, zenith = (
        albedo.new_tensor(c) for c in (model.GROUND_RGB, model.HORIZON_RGB, model.ZENITH_RGB)
    )
    above = horizon + (zenith - horizon) * smoothstep(sky_up, *model.ZENITH_UP)[:, None]
    surround = ground + (above - ground) * smoothstep(sky_up, *model.HORIZON_UP)[:, None]
    fresnel = model.FRESNEL + (1.0 - model.FRESNEL) * (1.0 - cos).pow(5)
    paint, glass = sheen[:, 0], sheen[:, 1]
    least, more = model.GLASS_MIRRORS
    mirrored = model.PAINT_MIRRORS * paint * fresnel + glass * (least + more * fresnel)
    strength = mirrored * (0.5 + 0.5 * occluded)
    glint = clamp_inclusive((mirror * sun).sum(-1), 0.0, 1.0).pow(40) * (
        model.GLINT[0] * paint + model.GLINT[1] * glass
    )
    lit = albedo * diffuse[:, None]
    return lit + strength[:, None] * (surround - lit) + glint[:, None] * (1.0 - lit)


def limit_brightening(ratio: Tensor, paint: Tensor) -> Tensor:
    """Relative change of a surface's colour after the light on it changed, within `model.RELIT_MOST`; 0 for 0.

    Args:
        ratio: Relative change of the light, above -1.
        paint: Paint share.
    """
    share = model.RELIT[0] + (model.RELIT[1] - model.RELIT[0]) * paint
    return share * ratio / (1.0 + (ratio / model.RELIT_MOST).square()).sqrt()


def relight(rgb: Tensor, brighter: Tensor) -> Tensor:
    """Photographed colours (R, 3) in other light; the same bits where `brighter` (R,) is 0.

    brighter: as of `limit_brightening`. Photographed white hardly changes, as film saturates.
    """
    return rgb * (1.0 + brighter[:, None] * (1.0 - rgb * rgb))


def apply_finish(light: Tensor, gain: Tensor, lift: Tensor) -> Tensor:
    """Light (R, 3) on a template as a photograph shows the vehicle; bright light saturates and never reaches 1.

    Args:
        light: (R, 3).
        gain: (R, 3).
        lift: (R, 1) value of the darkest parts.
    """
    return 1.0 - (1.0 - lift) * torch.exp(-(light * gain))
