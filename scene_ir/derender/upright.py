"""Upright surfaces that stand for people and cyclists: they face the camera, and the photograph covers them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from scene_ir.derender.silhouette import Placement, place_mesh
from scene_ir.geometry import to_clip, yaw_matrix
from scene_ir.types import Camera, Mesh, Part, SceneIR

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class OutlineDetail:
    """How closely a surface follows its mask."""

    cells: int
    """Cells over the height."""
    cell_px: tuple[float, float]
    """Bounds of their sides, px."""
    margin_px: float
    """How far the surface reaches beyond the mask, px."""


UNDER_MATTE = OutlineDetail(24, (2.0, 12.0), 1.5)
"""For surfaces with an outline drawn by the matte."""
ALONG_MASK = OutlineDetail(60, (1.5, 6.0), 0.0)
"""For surfaces with an outline of their own."""
_GUIDE_DEPTH_M = 0.3
"""Thickness of the box that shows the network where a person is."""
_SOLID = 0.5
"""Opacity from which a pixel is the object."""
_DRAWN = 0.7
"""How far corners outside are drawn to the border: wholly, cells at tips would lose their area."""
_SLOPE, _RELIEF_M = 0.6, 0.12
"""Slope of the relief at the outline, and its height, m."""
_HALF_THICKNESS_M = 0.002
"""Half the thickness at the outline: thin, since the photograph does not show the rim."""
_CLOTHED = {"Pedestrian": (0.05, 0.86), "Cyclist": (0.45, 0.84)}
"""Heights, as shares of the whole, between which a surface counts as clothing: without head, shoes or bicycle."""
_BOX_FACES = (
    *((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)),
    *((2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)),
)
"""Triangles of a box, wound outwards; bit 2 of a vertex is x, bit 1 y, bit 0 z."""


def place_box(box_xyxy: Tensor, translation: Tensor, camera: Camera) -> Placement:
    """A thin upright box that faces the camera and fills a 2D box, as a guide for the cut-out network.

    Args:
        box_xyxy: (4,) px.
        translation: (3,) m, the labelled place, which gives the depth.
        camera: The photograph's camera.

    Returns:
        The placed box; its x axis points to the camera.
    """
    matrix = camera.matrix.double()
    x0, y0, x1, y1 = box_xyxy.double().tolist()
    depth = float(to_clip(translation.double(), matrix)[2])
    inverse = torch.linalg.inv(matrix[:, :3])
    corners = torch.tensor([[x0, y0, 1.0], [x1, y1, 1.0]], dtype=torch.float64)
    low, high = (depth * corners - matrix[:, 3]) @ inverse.T
    foot = torch.stack([(low[0] + high[0]) / 2, high[1], (low[2] + high[2]) / 2])
    towards = -inverse @ matrix[:, 3] - foot
    yaw = torch.atan2(-towards[2], towards[0])
    facing = towards[2].abs() / towards[[0, 2]].norm()
    size = torch.stack([low.new_tensor(_GUIDE_DEPTH_M), high[1] - low[1], (high[0] - low[0]) * facing])
    return place_mesh(_unit_box(), foot.float(), yaw.float(), size.clamp(min=0.01).float())


def _unit_box() -> Mesh:
    corners = torch.tensor([[x, y, z] for x in (-0.5, 0.5) for y in (-1.0, 0.0) for z in (-0.5, 0.5)])
    faces = torch.tensor(_BOX_FACES)
    return Mesh(corners, faces, torch.full((len(faces),), int(Part.OTHER)), "box")


def make_placement(
    mask: Mask,
    kind: str,
    pose: tuple[Tensor, Tensor, Tensor],
    camera: Camera,
    detail: OutlineDetail = UNDER_MATTE,
    body: Mask | None = None,
) -> Placement:
    """The surface of one person or cyclist: upright, facing the camera through the labelled place, with the outline of
    a mask and a shallow relief.

    Args:
        mask: Pixels (H, W) of the object, not empty.
        kind: Type as labelled, which decides what of it is clothing.
        pose: Labelled translation (3,) m, yaw () rad and size (3,) m; the object's frame.
        camera: The photograph's camera.
        detail: How closely the surface follows the mask.
        body: Pixels (H, W) by which the heights of clothing are measured; those of the mask if None.

    Returns:
        The placed surface; its mesh is closed, and may reach beyond the unit box where the mask reaches beyond the
        label.
    """
    translation, yaw, size_lhw = (part.double() for part in pose)
    grid = _OutlineGrid.from_mask(mask, detail)
    matrix = camera.matrix.double()
    inverse = torch.linalg.inv(matrix[:, :3])
    centre = -inverse @ matrix[:, 3]
    towards = (centre - translation) * centre.new_tensor([1.0, 0.0, 1.0])
    normal = towards / towards.norm()
    pixels = torch.from_numpy(grid.pixels)
    rays = torch.cat([pixels, torch.ones_like(pixels[:, :1])], 1) @ inverse.T
    at_surface = ((translation - centre) @ normal) / (rays @ normal)
    metres_per_px = float((translation - centre).norm()) / float(camera.intrinsics[0, 0])
    relief = torch.from_numpy((_SLOPE * metres_per_px * grid.depth_px).clip(max=_RELIEF_M)) + _HALF_THICKNESS_M
    layers = [
        centre + (at_surface + offset / (rays @ normal))[:, None] * rays
        for offset in (relief, torch.full_like(relief, -_HALF_THICKNESS_M))
    ]
    unit = (torch.cat(layers) - translation) @ yaw_matrix(yaw) / size_lhw
    faces = torch.from_numpy(grid.closed_faces())
    rows = np.flatnonzero((mask if body is None else body).any(1))
    share = (
        torch.from_numpy((rows[-1] + 0.5 - grid.pixels[:, 1]) / (rows[-1] + 1 - rows[0])).repeat(2)[faces].mean(1)
    )
    low, high = _CLOTHED[kind]
    part = torch.where((share > low) & (share < high), int(Part.PAINT), int(Part.OTHER))
    return place_mesh(Mesh(unit.float(), faces, part, kind.lower()), *pose)


def trim_to_mattes(scene: SceneIR) -> SceneIR:
    """A scene in which the outlines of upright surfaces are those of their mattes, for renderers without mattes."""
    meshes, camera = list(scene.meshes), scene.camera
    for row in scene.objects.upright.nonzero()[:, 0].tolist() if scene.objects.source else ():
        source, index = scene.objects.source[row], int(scene.objects.mesh_index[row])
        crop, solid = source.foreground, np.zeros((camera.height, camera.width), bool)
        h, w = crop.values.shape[1:]
        solid[crop.y0 : crop.y0 + h, crop.x0 : crop.x0 + w] = crop.values[3].cpu().numpy() >= _SOLID
        if solid.any():
            pose, kind = (source.translation, source.yaw, source.size_lhw), meshes[index].name.capitalize()
            meshes[index] = make_placement(solid, kind, pose, camera, ALONG_MASK).mesh
    return replace(scene, meshes=tuple(meshes))


@dataclass(frozen=True, slots=True)
class _OutlineGrid:
    """The cells of a pixel grid that a mask touches, with the corners on its outside drawn to its border."""

    pixels: NDArray[np.float64]
    """(V, 2), x and y of the corners, px."""
    depth_px: NDArray[np.float64]
    """(V,), how far the corners are inside the mask, px."""
    quads: NDArray[np.int64]
    """(Q, 4), corners of each cell: upper left, upper right, lower right, lower left."""

    @classmethod
    def from_mask(cls, mask: Mask, detail: OutlineDetail) -> _OutlineGrid:
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        pad = int(2 * detail.margin_px) + 2
        inner = np.pad(mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1], pad)
        wide = cv2.distanceTransform((~inner).astype(np.uint8), cv2.DIST_L2, 5) <= detail.margin_px
        side = float(np.clip((rows[-1] + 1 - rows[0]) / detail.cells, *detail.cell_px))
        count = [int(np.ceil(n / side)) for n in wide.shape]
        y, x = np.nonzero(wide)
        used = np.zeros(count, bool)
        used[
            np.minimum((y / side).astype(int), count[0] - 1), np.minimum((x / side).astype(int), count[1] - 1)
        ] = True
        used = _without_pinches(used)
        i, j = np.nonzero(used)
        corners = (
            np.stack([(i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j)], axis=1).transpose(2, 1, 0).reshape(-1, 2)
        )
        places, index = np.unique(corners, axis=0, return_inverse=True)
        at = places[:, ::-1] * side - 0.5
        inside = cv2.distanceTransform(inner.astype(np.uint8), cv2.DIST_L2, 5)
        nearest = distance_transform_edt(~wide, return_distances=False, return_indices=True)
        cell = np.clip(np.rint(at[:, ::-1]).astype(int), 0, np.array(wide.shape) - 1)
        goal = np.asarray(nearest)[:, cell[:, 0], cell[:, 1]][::-1].T
        outside = ~wide[cell[:, 0], cell[:, 1]]
        at = np.where(outside[:, None], at + _DRAWN * (goal - at), at)
        depth = np.where(outside, 0.0, inside[cell[:, 0], cell[:, 1]])
        offset = np.array([columns[0] - pad, rows[0] - pad])
        return cls(at + offset, depth.astype(np.float64), index.reshape(-1, 4))

    def closed_faces(self) -> NDArray[np.int64]:
        """Triangles (F, 3) of a front of the corners, a back of V more, and the rim between them."""
        a, b, c, d = self.quads.T
        front = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
        edges = np.concatenate([np.stack(pair, 1) for pair in ((a, b), (b, c), (c, d), (d, a))])
        count = len(self.pixels)
        single = ~np.isin(edges @ [count, 1], edges @ [1, count])
        p, q = edges[single].T
        rim = np.concatenate([np.stack([p, q, q + count], 1), np.stack([p, q + count, p + count], 1)])
        return np.concatenate([front, front[:, ::-1] + count, rim]).astype(np.int64)


def _without_pinches(used: Mask) -> Mask:
    """Cells with one more wherever two touch at a corner alone."""
    used = used.copy()
    while True:
        a, b, c, d = used[:-1, :-1], used[:-1, 1:], used[1:, :-1], used[1:, 1:]
        falling, rising = a & d & ~b & ~c, b & c & ~a & ~d
        if not (falling | rising).any():
            return used
        used[:-1, 1:] |= falling
        used[:-1, :-1] |= rising
