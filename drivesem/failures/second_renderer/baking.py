"""Vehicle textures, baked once from a photograph: each triangle has its own patch in an atlas.

A texel is a point of the mesh in its photographed pose. It takes the photograph's colour where it is visible, else
that of the same point on the vehicle's other side, else the median colour of the visible texels of its part.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from drivesem.failures.second_renderer.geometry import BodyMesh, PictureCamera, VehiclePose, to_numpy
from drivesem.failures.second_renderer.opengl import SUPERSAMPLING, Array, ImageWindow, ObjectDepth
from scene_ir.types import Part, Source

Mask = NDArray[np.bool_]

_TEXELS_PER_PIXEL = 1.3
"""Texels per pixel of the photograph."""
_PATCH_SIZES = np.array([1, 2, 3, 4, 5, 6, 8, 10, 12, 14, 16, 20, 24, 28, 32, 40, 48, 64, 80, 96])
"""Possible lengths of a patch's edge, texels."""
_PAD = 1
"""Texels around a patch, so that interpolation at its edge stays within it."""
_ATLAS_WIDTH = 512
_FACING_RANGE = (0.0, 0.08)
"""Cosines towards the camera between which the photograph's weight for a surface rises from 0 to 1."""
_FAR_M = 1e6
_SELF_OCCLUSION_M = 0.15
"""A point this far behind the visible surface is hidden by its own vehicle."""
_MIN_OPACITY, _OPAQUE = 0.5, 0.95
"""Minimum opacity of a pixel that shows the vehicle; minimum opacity where its colour is pure."""
_MIN_OPAQUE_SHARE = 0.3
"""Minimum share of the vehicle's pixels with pure colour, for the others to be filled from them."""
_BLUR_PX = 1.5
"""Blur of extrapolated colours, which would be stripes otherwise."""
_EXTRAPOLATION = (2.0, 0.03)
"""How far colours are extrapolated beyond the outline: pixels, plus a share of the vehicle's height."""
_MIN_FILL_WEIGHT = 0.9
"""Minimum visibility and paint weight of a texel used to fill unseen texels of the same part."""
_DEFAULT_COLOURS = {
    Part.PAINT: (0.45, 0.45, 0.45), Part.GLASS: (0.16, 0.17, 0.18), Part.TYRE: (0.09, 0.09, 0.09),
    Part.LIGHT: (0.55, 0.5, 0.48), Part.OTHER: (0.16, 0.16, 0.16),
}  # fmt: skip
"""Colours of parts that the photograph does not show."""


@dataclass(frozen=True, slots=True)
class TextureAtlas:
    """Texture of one vehicle."""

    uv: Array
    """(3F, 2), see `TexturedSurface`."""
    colour: Array
    """(h, w, 3) in [0, 1]."""
    paint_share: Array
    """(h, w) in [0, 1], how much of a texel is paint."""
    height: Array
    """(h, w), 0 at the vehicle's foot, 1 at its roof."""
    paint_colour: Array
    """(3,), the paint's own colour."""


@dataclass(frozen=True, slots=True)
class _Layout:
    """T texels of the patches of F triangles."""

    face: NDArray[np.int64]  # (T,) triangle of each texel
    weights: Array  # (T, 3) barycentric
    row: NDArray[np.int64]  # (T,)
    column: NDArray[np.int64]  # (T,)
    uv: Array  # (3F, 2)
    size: tuple[int, int]  # rows and columns of the atlas


class BakedAppearance:
    """One vehicle's appearance in the photograph: its colours, extrapolated beyond its outline, and its
    visibility.

    `hidden` (H, W) is true where something nearer stands.
    """

    def __init__(self, source: Source, hidden: Mask) -> None:
        crop = source.foreground
        rgba = to_numpy(crop.values).transpose(1, 2, 0)
        height, width = rgba.shape[:2]
        rows, columns = slice(crop.y0, crop.y0 + height), slice(crop.x0, crop.x0 + width)
        visible = (rgba[..., 3] > _MIN_OPACITY) & ~hidden[rows, columns]
        # At its border, a matte mixes in what lies behind.
        solid = cv2.erode((visible & (rgba[..., 3] > _OPAQUE)).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        solid = solid if np.count_nonzero(solid) > _MIN_OPAQUE_SHARE * np.count_nonzero(visible) else visible
        self.known = bool(solid.any())
        self._origin = np.array([crop.x0, crop.y0], np.float32)
        straight = (rgba[..., :3] / np.maximum(rgba[..., 3:], 1e-3)).astype(np.float32)
        self._distance = np.full((height, width), np.inf, np.float32)
        self._colour = straight
        if self.known:
            self._distance = np.asarray(distance_transform_edt(~solid)).astype(np.float32)
            nearest = distance_transform_edt(~solid, return_distances=False, return_indices=True)
            extrapolated = np.clip(straight[tuple(np.asarray(nearest))], 0, 1)
            soft = cv2.GaussianBlur(extrapolated, (0, 0), _BLUR_PX).astype(np.float32)
            self._colour = np.where(solid[..., None], extrapolated, soft).astype(np.float32)
        self._paint = source.region
        height_px = int(np.count_nonzero(solid.any(axis=1)))
        self.reach = _EXTRAPOLATION[0] + _EXTRAPOLATION[1] * height_px

    def colour(self, at: Array) -> Array:
        """Colours (T, 3) at pixels (T, 2)."""
        return np.clip(_sample_image(self._colour, at - self._origin, cv2.INTER_CUBIC), 0, 1)

    def visibility(self, at: Array) -> Array:
        """How much (T,) in [0, 1] pixels (T, 2) show of the vehicle; 0 beyond the reach of the extrapolation."""
        limit = np.array(self._distance.shape[::-1], np.float32) - 1
        local = at - self._origin
        outside = np.abs(local - np.clip(local, 0, limit)).max(axis=1)
        distance = _sample_image(self._distance, local, cv2.INTER_LINEAR) + outside
        return np.clip(2 - distance / self.reach, 0, 1)

    def paint(self, at: Array) -> Array | None:
        """How much (T,) of pixels (T, 2) is paint; None where that is unknown."""
        if self._paint is None:
            return None
        local = at - np.array([self._paint.x0, self._paint.y0], np.float32)
        return _sample_image(to_numpy(self._paint.values)[0], local, cv2.INTER_LINEAR)


def bake_atlas(
    body: BodyMesh,
    source: Source,
    appearance: BakedAppearance,
    camera: PictureCamera,
    own_depth: ObjectDepth | None,
) -> TextureAtlas:
    """Bake the atlas of one vehicle.

    Args:
        body: Mesh.
        source: The vehicle in the photograph.
        appearance: Its appearance there.
        camera: Camera.
        own_depth: Depth of its mesh there; None where it is outside of the photograph.
    """
    pose = VehiclePose.from_source(source)
    placed, other = body.place(pose, camera), body.place(pose, camera, mirrored=True)
    cosines = [_facing_cosine(placed), _facing_cosine(other, turned=True)]
    layout = pack_patches(*_patch_sizes((placed, other), cosines, camera))
    visible = np.zeros(len(layout.face), np.float32)
    colour = np.zeros((len(layout.face), 3), np.float32)
    paint = (body.part == Part.PAINT)[layout.face].astype(np.float32)
    if appearance.known and own_depth is not None:
        depth = cv2.dilate(np.minimum(own_depth.depth_m, _FAR_M), np.ones((3, 3), np.uint8)).astype(np.float32)
        # The visible side first; the other one where that is not visible.
        for corners, cosine in zip((placed, other), cosines, strict=True):
            points = np.einsum("tk,tkc->tc", layout.weights, corners[layout.face])
            at = camera.project(points)
            weight = np.clip(
                (cosine[layout.face] - _FACING_RANGE[0]) / (_FACING_RANGE[1] - _FACING_RANGE[0]), 0, 1
            )
            weight = (
                weight
                * appearance.visibility(at)
                * (points[:, 2] <= _lookup_in_window(depth, at, own_depth.window) + _SELF_OCCLUSION_M)
            )
            weight = weight * (points[:, 2] > 0) * (1 - visible)
            colour += weight[:, None] * appearance.colour(at)
            paint_there = appearance.paint(at)
            if paint_there is not None:
                paint += weight * (paint_there - paint)
            visible += weight
    filled = _median_colours(body, layout, colour, visible, paint)
    colour += (1 - visible)[:, None] * filled[layout.face]
    unit = np.einsum("tk,tk->t", layout.weights, body.unit[layout.face][..., 1])

    def spread(values: Array) -> Array:
        out = np.zeros((*layout.size, *values.shape[1:]), np.float32)
        out[layout.row, layout.column] = values
        return out

    return TextureAtlas(
        layout.uv, spread(colour), spread(paint), spread(np.clip(-unit, 0, 1)), to_numpy(source.paint)
    )


def _median_colours(body: BodyMesh, layout: _Layout, colour: Array, visible: Array, paint: Array) -> Array:
    """Colours (F, 3) for unseen triangles: the median of their part. Lamps and plates that the mesh counts as
    paint are excluded by the photograph's paint map.
    """
    filled = np.empty((len(body.part), 3), np.float32)
    for part in Part:
        usable = (body.part == part)[layout.face] & (visible > _MIN_FILL_WEIGHT)
        usable &= (paint > _MIN_FILL_WEIGHT) | (part != Part.PAINT)
        filled[body.part == part] = np.median(colour[usable], axis=0) if usable.any() else _DEFAULT_COLOURS[part]
    return filled


def _facing_cosine(placed: Array, turned: bool = False) -> Array:
    """Cosine (F,) towards the camera of triangles (F, 3, 3) m. turned: whether they wind the other way round."""
    normal = np.cross(placed[:, 1] - placed[:, 0], placed[:, 2] - placed[:, 0])
    middle = placed.mean(axis=1)
    length = np.linalg.norm(normal, axis=1) * np.linalg.norm(middle, axis=1)
    cos = -(normal * middle).sum(axis=1) / np.maximum(length, 1e-12)
    return -cos if turned else cos


def _patch_sizes(
    sides: tuple[Array, Array], cosines: list[Array], camera: PictureCamera
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The corner (F,) between each triangle's two shorter edges, and texels (F, 2) along these: as many as the
    photograph has pixels of it, or of its counterpart on the other side.
    """
    limit, rows = np.array([camera.width, camera.height]), np.arange(len(cosines[0]))
    corner, pair = np.zeros(len(rows), np.int64), np.ones((len(rows), 2))
    for k, (corners, cosine) in enumerate(zip(sides, cosines, strict=True)):
        at = camera.project(corners)
        length = np.linalg.norm(np.roll(at, -1, axis=1) - at, axis=2)
        if k == 0:
            # A corner's edge leads to the next corner; the longest edge lies opposite the one after that.
            corner = (length.argmax(axis=1) + 2) % 3
        shorter = np.stack([length[rows, corner], length[rows, (corner + 2) % 3]], axis=1) * _TEXELS_PER_PIXEL
        is_visible = (cosine > 0) & (at.max(axis=1) > 0).all(axis=1) & (at.min(axis=1) < limit).all(axis=1)
        pair[is_visible] = np.maximum(pair[is_visible], shorter[is_visible])
    return corner, _PATCH_SIZES[np.searchsorted(_PATCH_SIZES, np.minimum(pair, _PATCH_SIZES[-1]))]


def _place_on_shelves(edges: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """Place patches on shelves of equal height: their upper left texels (F, 2), x and y, and the total height."""
    places, x, y, shelf = np.zeros((len(edges), 2), np.int64), 0, 0, 0
    for i in np.lexsort((edges[:, 0], edges[:, 1])).tolist():
        wide, tall = edges[i] + 1 + 2 * _PAD
        if tall != shelf or x + wide > _ATLAS_WIDTH:
            x, y, shelf = 0, y + shelf, int(tall)
        places[i] = x, y
        x += int(wide)
    return places, y + shelf


def pack_patches(corner: NDArray[np.int64], edges: NDArray[np.int64]) -> _Layout:
    """Lay out patches side by side, with given texels (F, 2) along two edges from a corner (F,)."""
    faces, weights, rows, columns = [], [], [], []
    corners = np.zeros((len(edges), 3, 2), np.float32)
    places, height = _place_on_shelves(edges)
    for nu, nv in np.unique(edges, axis=0).tolist():
        mine = np.flatnonzero((edges == (nu, nv)).all(axis=1))
        x0, y0 = places[mine].T
        v, u = np.mgrid[-_PAD : nv + _PAD + 1, -_PAD : nu + _PAD + 1]
        inside = u / nu + v / nv <= 1 + _PAD / nu + _PAD / nv
        u, v = u[inside], v[inside]
        w = np.stack([1 - u / nu - v / nv, u / nu, v / nv], axis=1).astype(np.float32)
        # From the patch's corner order to the triangle's.
        own = (np.arange(3) - corner[mine, None]) % 3
        faces.append(np.repeat(mine, len(u)))
        weights.append(w[:, own].transpose(1, 0, 2).reshape(-1, 3))
        rows.append((y0[:, None] + _PAD + v[None]).ravel())
        columns.append((x0[:, None] + _PAD + u[None]).ravel())
        patch = np.array([(0, 0), (nu, 0), (0, nv)]) + _PAD
        corners[mine] = patch[own] + places[mine, None]
    size = (height, _ATLAS_WIDTH)
    uv = (corners + 0.5) / np.array([size[1], size[0]], np.float32)
    uv[..., 1] = 1 - uv[..., 1]
    return _Layout(
        np.concatenate(faces),
        np.concatenate(weights),
        np.concatenate(rows),
        np.concatenate(columns),
        uv.reshape(-1, 2),
        size,
    )


def _lookup_in_window(drawn: Array, at: Array, window: ImageWindow) -> Array:
    """A rendered depth's values (T,) at pixels (T, 2); far away outside of the window."""
    local = np.floor((at + 0.5 - np.array([window.x0, window.y0])) * SUPERSAMPLING).astype(int)
    inside = ((local >= 0) & (local < np.array(drawn.shape[::-1]))).all(axis=1)
    local = np.clip(local, 0, np.array(drawn.shape[::-1]) - 1)
    return np.where(inside, drawn[local[:, 1], local[:, 0]], np.float32(_FAR_M))


def _sample_image(values: Array, at: Array, how: int) -> Array:
    """Interpolate an image (h, w, ...) at pixels (T, 2), with its border replicated: (T, ...)."""
    # OpenCV's images and maps have at most 32,767 columns.
    count, columns = len(at), 4096
    padded = np.zeros((-(-count // columns) * columns, 2), np.float32)
    padded[:count] = np.clip(at, -1e4, 1e4)
    grid = padded.reshape(-1, columns, 2)
    across, down = (np.ascontiguousarray(axis) for axis in (grid[..., 0], grid[..., 1]))
    sampled = cv2.remap(values, across, down, how, borderMode=cv2.BORDER_REPLICATE)
    return sampled.reshape(len(padded), *values.shape[2:])[:count].astype(np.float32)
