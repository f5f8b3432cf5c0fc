"""Textures of vehicles, baked once from a photograph: each triangle has a patch of its own in an atlas.

A texel is a point of the mesh as it stood when the photograph was taken. Where the photograph shows it, it has the
photograph's colour; else that of the same point on the other side, as far as that was seen; else the median of
what was seen of its part.
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
"""Texels a pixel of the photograph."""
_PATCH_SIZES = np.array([1, 2, 3, 4, 5, 6, 8, 10, 12, 14, 16, 20, 24, 28, 32, 40, 48, 64, 80, 96])
"""Texels along a triangle's edge that a patch may have."""
_PAD = 1
"""Texels around a patch, so that interpolation at its edge meets its own."""
_ATLAS_WIDTH = 512
_FACING_RANGE = (0.0, 0.08)
"""Cosine towards the camera at which the photograph begins to tell of a surface, and tells all."""
_FAR_M = 1e6
_SELF_OCCLUSION_M = 0.15
"""A point this much behind what is seen there is hidden by its own vehicle."""
_MIN_OPACITY, _OPAQUE = 0.5, 0.95
"""Opacity from which on the photograph shows a vehicle, and its own colours."""
_MIN_OPAQUE_SHARE = 0.3
"""Share of the pixels that show it which are to have its own colours, for others to take theirs."""
_BLUR_PX = 1.5
"""Colours that are drawn out over the outline would be stripes."""
_EXTRAPOLATION = (2.0, 0.03)
"""How far beyond those pixels their colours are drawn out: pixels, and a share of the vehicle's height on top."""
_MIN_FILL_WEIGHT = 0.9
"""How far a texel is seen, or is paint, that stands for those of its part that never were."""
_DEFAULT_COLOURS = {
    Part.PAINT: (0.45, 0.45, 0.45), Part.GLASS: (0.16, 0.17, 0.18), Part.TYRE: (0.09, 0.09, 0.09),
    Part.LIGHT: (0.55, 0.5, 0.48), Part.OTHER: (0.16, 0.16, 0.16),
}  # fmt: skip
"""Colours of parts of which the photograph shows nothing."""


@dataclass(frozen=True, slots=True)
class TextureAtlas:
    """uv: (3F, 2), see `screen.Skin`; colour: (h, w, 3) in [0, 1]; paint: (h, w), how much of a texel is paint;
    height: (h, w), 0 at the vehicle's foot, 1 at its roof; base: (3,), the paint's own colour."""

    uv: Array
    colour: Array
    paint_share: Array
    height: Array
    paint_colour: Array


@dataclass(frozen=True, slots=True)
class _Layout:
    """Patches of F triangles. face: (T,) of each texel; weights: (T, 3) of its corners; row, column: (T,)."""

    face: NDArray[np.int64]
    weights: Array
    row: NDArray[np.int64]
    column: NDArray[np.int64]
    uv: Array
    size: tuple[int, int]


class BakedAppearance:
    """What a photograph tells of one vehicle: its colours, drawn out beyond its outline, and where they stop.

    hidden: (H, W), where something nearer stands.
    """

    def __init__(self, source: Source, hidden: Mask) -> None:
        crop = source.foreground
        rgba = to_numpy(crop.values).transpose(1, 2, 0)
        height, width = rgba.shape[:2]
        rows, columns = slice(crop.y0, crop.y0 + height), slice(crop.x0, crop.x0 + width)
        shown = (rgba[..., 3] > _MIN_OPACITY) & ~hidden[rows, columns]
        # At its border a matte mixes in what lies behind.
        solid = cv2.erode((shown & (rgba[..., 3] > _OPAQUE)).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        solid = solid if np.count_nonzero(solid) > _MIN_OPAQUE_SHARE * np.count_nonzero(shown) else shown
        self.known = bool(solid.any())
        self._origin = np.array([crop.x0, crop.y0], np.float32)
        straight = (rgba[..., :3] / np.maximum(rgba[..., 3:], 1e-3)).astype(np.float32)
        self._beyond = np.full((height, width), np.inf, np.float32)
        self._colour = straight
        if self.known:
            self._beyond = np.asarray(distance_transform_edt(~solid)).astype(np.float32)
            nearest = distance_transform_edt(~solid, return_distances=False, return_indices=True)
            drawn_out = np.clip(straight[tuple(np.asarray(nearest))], 0, 1)
            soft = cv2.GaussianBlur(drawn_out, (0, 0), _BLUR_PX).astype(np.float32)
            self._colour = np.where(solid[..., None], drawn_out, soft).astype(np.float32)
        self._paint = None if source.region is None else source.region
        tall = int(np.count_nonzero(solid.any(axis=1)))
        self.reach = _EXTRAPOLATION[0] + _EXTRAPOLATION[1] * tall

    def colour(self, at: Array) -> Array:
        """(T, 3) at pixels (T, 2)."""
        return np.clip(_sample_image(self._colour, at - self._origin, cv2.INTER_CUBIC), 0, 1)

    def visibility(self, at: Array) -> Array:
        """How far (T,) in [0, 1] pixels (T, 2) show the vehicle: 0 beyond the reach of its colours."""
        limit = np.array(self._beyond.shape[::-1], np.float32) - 1
        local = at - self._origin
        outside = np.abs(local - np.clip(local, 0, limit)).max(axis=1)
        beyond = _sample_image(self._beyond, local, cv2.INTER_LINEAR) + outside
        return np.clip(2 - beyond / self.reach, 0, 1)

    def paint(self, at: Array) -> Array | None:
        """How much (T,) of pixels (T, 2) is paint; None where the photograph does not tell."""
        if self._paint is None:
            return None
        local = at - np.array([self._paint.x0, self._paint.y0], np.float32)
        return _sample_image(to_numpy(self._paint.values)[0], local, cv2.INTER_LINEAR)


def bake_atlas(
    body: BodyMesh, source: Source, seen: BakedAppearance, lens: PictureCamera, alone: ObjectDepth | None
) -> TextureAtlas:
    """The atlas of one vehicle as its photograph shows it. alone: its mesh there; None where it is not in it."""
    pose = VehiclePose.from_source(source)
    placed, other = body.place(pose, lens), body.place(pose, lens, mirrored=True)
    squares = [_facing_cosine(placed), _facing_cosine(other, turned=True)]
    layout = pack_patches(*_patch_sizes((placed, other), squares, lens))
    shown = np.zeros(len(layout.face), np.float32)
    colour = np.zeros((len(layout.face), 3), np.float32)
    paint = (body.part == Part.PAINT)[layout.face].astype(np.float32)
    if seen.known and alone is not None:
        depth = cv2.dilate(np.minimum(alone.depth_m, _FAR_M), np.ones((3, 3), np.uint8)).astype(np.float32)
        # The photograph's own side first; the other one where that tells nothing.
        for corners, square in zip((placed, other), squares, strict=True):
            points = np.einsum("tk,tkc->tc", layout.weights, corners[layout.face])
            at = lens.project(points)
            weight = np.clip(
                (square[layout.face] - _FACING_RANGE[0]) / (_FACING_RANGE[1] - _FACING_RANGE[0]), 0, 1
            )
            weight = (
                weight
                * seen.visibility(at)
                * (points[:, 2] <= _lookup_in_window(depth, at, alone.window) + _SELF_OCCLUSION_M)
            )
            weight = weight * (points[:, 2] > 0) * (1 - shown)
            colour += weight[:, None] * seen.colour(at)
            told = seen.paint(at)
            if told is not None:
                paint += weight * (told - paint)
            shown += weight
    filled = _median_colours(body, layout, colour, shown, paint)
    colour += (1 - shown)[:, None] * filled[layout.face]
    unit = np.einsum("tk,tk->t", layout.weights, body.unit[layout.face][..., 1])

    def spread(values: Array) -> Array:
        out = np.zeros((*layout.size, *values.shape[1:]), np.float32)
        out[layout.row, layout.column] = values
        return out

    return TextureAtlas(
        layout.uv, spread(colour), spread(paint), spread(np.clip(-unit, 0, 1)), to_numpy(source.paint)
    )


def _median_colours(body: BodyMesh, layout: _Layout, colour: Array, shown: Array, paint: Array) -> Array:
    """Colours (F, 3) of triangles that were never seen: their part's median. Lamps and plates that the mesh takes
    for paint are no paint by the photograph."""
    filled = np.empty((len(body.part), 3), np.float32)
    for part in Part:
        told = (body.part == part)[layout.face] & (shown > _MIN_FILL_WEIGHT)
        told &= (paint > _MIN_FILL_WEIGHT) | (part != Part.PAINT)
        filled[body.part == part] = np.median(colour[told], axis=0) if told.any() else _DEFAULT_COLOURS[part]
    return filled


def _facing_cosine(placed: Array, turned: bool = False) -> Array:
    """Cosine (F,) towards the camera of triangles (F, 3, 3) m. turned: they wind the other way round."""
    normal = np.cross(placed[:, 1] - placed[:, 0], placed[:, 2] - placed[:, 0])
    middle = placed.mean(axis=1)
    length = np.linalg.norm(normal, axis=1) * np.linalg.norm(middle, axis=1)
    cos = -(normal * middle).sum(axis=1) / np.maximum(length, 1e-12)
    return -cos if turned else cos


def _patch_sizes(
    sides: tuple[Array, Array], squares: list[Array], lens: PictureCamera
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The corner (F,) of each triangle that lies between its shorter edges, and texels (F, 2) along these: as many
    as the photograph has of it, or of the one on the other side.
    """
    limit, rows = np.array([lens.width, lens.height]), np.arange(len(squares[0]))
    corner, pair = np.zeros(len(rows), np.int64), np.ones((len(rows), 2))
    for k, (corners, square) in enumerate(zip(sides, squares, strict=True)):
        at = lens.project(corners)
        length = np.linalg.norm(np.roll(at, -1, axis=1) - at, axis=2)
        if k == 0:
            # The edge from a corner leads to the next one: the longest lies opposite to the one after that.
            corner = (length.argmax(axis=1) + 2) % 3
        shorter = np.stack([length[rows, corner], length[rows, (corner + 2) % 3]], axis=1) * _TEXELS_PER_PIXEL
        seen = (square > 0) & (at.max(axis=1) > 0).all(axis=1) & (at.min(axis=1) < limit).all(axis=1)
        pair[seen] = np.maximum(pair[seen], shorter[seen])
    return corner, _PATCH_SIZES[np.searchsorted(_PATCH_SIZES, np.minimum(pair, _PATCH_SIZES[-1]))]


def _place_on_shelves(edges: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """Upper left texels (F, 2) of patches, x and y, in rows of one height each; how high all are."""
    places, x, y, shelf = np.zeros((len(edges), 2), np.int64), 0, 0, 0
    for i in np.lexsort((edges[:, 0], edges[:, 1])).tolist():
        wide, tall = edges[i] + 1 + 2 * _PAD
        if tall != shelf or x + wide > _ATLAS_WIDTH:
            x, y, shelf = 0, y + shelf, int(tall)
        places[i] = x, y
        x += int(wide)
    return places, y + shelf


def pack_patches(corner: NDArray[np.int64], edges: NDArray[np.int64]) -> _Layout:
    """Patches of so many texels along two edges, (F, 2), from a corner (F,); side by side."""
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
        # From the order in the patch to the triangle's own.
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
    """A drawn picture's values (T,) at pixels (T, 2); what lies beside the window is not hidden."""
    local = np.floor((at + 0.5 - np.array([window.x0, window.y0])) * SUPERSAMPLING).astype(int)
    inside = ((local >= 0) & (local < np.array(drawn.shape[::-1]))).all(axis=1)
    local = np.clip(local, 0, np.array(drawn.shape[::-1]) - 1)
    return np.where(inside, drawn[local[:, 1], local[:, 0]], np.float32(_FAR_M))


def _sample_image(values: Array, at: Array, how: int) -> Array:
    """Values (T, ...) of a picture (h, w, ...) at its pixels (T, 2); its border goes on beyond it."""
    # OpenCV's pictures and maps have at most 32,767 columns.
    count, columns = len(at), 4096
    padded = np.zeros((-(-count // columns) * columns, 2), np.float32)
    padded[:count] = np.clip(at, -1e4, 1e4)
    grid = padded.reshape(-1, columns, 2)
    across, down = (np.ascontiguousarray(axis) for axis in (grid[..., 0], grid[..., 1]))
    found = cv2.remap(values, across, down, how, borderMode=cv2.BORDER_REPLICATE)
    return found.reshape(len(padded), *values.shape[2:])[:count].astype(np.float32)
