"""Geometry of what is drawn: vehicle meshes, their halos, and the ground patches that carry their shadows.

Shapes: N objects; V vertices and F triangles of all objects together, object after object.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from scene_ir.ffd import lattice_weights
from scene_ir.geometry import to_clip, vertex_normals
from scene_ir.raster import verbs
from scene_ir.render import model
from scene_ir.types import Camera, Mesh, Objects, Part, check_finite

CREASE_RAD = 0.7
"""Faces that meet at a larger angle keep a sharp edge in shading: 40 degrees, the usual choice of modelling tools.
"""
SHADOW_MARGIN_M = 0.8
"""Margin of the shadow's patch around the footprint, besides the sun's offset."""
_GRAIN_SIZE = 1 << 15
"""Values that torch computes in one thread (ATen's GRAIN_SIZE)."""
_WELD_DISTANCE = 1e-5
"""Vertices of the unit box closer than this are one point."""


@dataclass(frozen=True, slots=True)
class TemplateSurface:
    """A mesh prepared for drawing, with sharp edges split."""

    unit: Tensor
    """(V, 3) in the unit box."""
    faces: Tensor
    """(F, 3) int64."""
    neighbours: Tensor
    """(F, 3) int64, face across the edge opposite to each corner; -1 where there is none or more than one."""
    weights: Tensor
    """(V, 64) lattice weights."""
    mirror_weights: Tensor
    """(V, 64) lattice weights of the mirrored vertices."""
    weld: Tensor
    """(V,) int64, equal for vertices at one place."""
    colours: Tensor
    """(V, 3)."""
    paint: Tensor
    """(V,) in [0, 1]."""
    glass: Tensor
    """(V,) in [0, 1]."""
    part: Tensor
    """(V,) int64, a `Part` of a face around the vertex."""
    closed: bool
    """Whether faces bound volumes and look outwards."""

    @classmethod
    def from_mesh(cls, mesh: Mesh, dtype: torch.dtype) -> TemplateSurface:
        """The surface of `mesh`; computed once per mesh and cached while few others are used."""
        return _build_surface(mesh.vertices, mesh.faces, mesh.part, mesh.colours, dtype)


@lru_cache(maxsize=128)
def _build_surface(
    vertices: Tensor, faces: Tensor, part: Tensor, colours: Tensor | None, dtype: torch.dtype
) -> TemplateSurface:
    points = vertices.detach().cpu().numpy().astype(np.float64)
    triangles = faces.cpu().numpy()
    weld = np.unique(np.round(points / _WELD_DISTANCE).astype(np.int64), axis=0, return_inverse=True)[1].reshape(
        -1
    )
    normals = _crease_normals(points, triangles, weld)
    corner = triangles.reshape(-1)
    key = np.concatenate([corner[:, None], np.round(normals * 500).astype(np.int64)], axis=1)
    _, first, split = np.unique(key, axis=0, return_index=True, return_inverse=True)
    origin = torch.as_tensor(corner[first])
    new_faces = torch.as_tensor(split.reshape(-1, 3))
    unit = vertices.detach().cpu()[origin].to(dtype)
    mirror = unit * unit.new_tensor([1.0, 1.0, -1.0])
    grey = torch.full((len(points), 3), 0.7) if colours is None else colours.detach().cpu()
    kinds = part.cpu()
    tensors = (
        unit, new_faces, torch.as_tensor(_face_neighbours(weld[triangles])), lattice_weights(unit),
        lattice_weights(mirror), torch.as_tensor(weld)[origin],
        grey[origin].to(dtype),
        _part_share(new_faces, kinds == Part.PAINT, unit), _part_share(new_faces, kinds == Part.GLASS, unit),
        torch.zeros(len(first), dtype=torch.int64).index_copy(
            0, new_faces.reshape(-1).flip(0), kinds.repeat_interleave(3).flip(0)
        ),
    )  # fmt: skip
    return TemplateSurface(
        *(t.to(vertices.device) for t in tensors), closed=_is_closed(points[triangles], weld[triangles])
    )


def _face_neighbours(faces: np.ndarray) -> np.ndarray:
    """See `TemplateSurface.neighbours`. faces: (F, 3) of welded points."""
    edges = np.sort(
        np.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], axis=1).reshape(-1, 2), axis=1
    )
    order = np.lexsort(edges.T)
    ordered = edges[order]
    same = (ordered[1:] == ordered[:-1]).all(axis=1)
    pair = np.flatnonzero(same & ~np.append(same[1:], False) & ~np.insert(same[:-1], 0, False))
    missed = np.full(len(edges), -1)
    missed[order[pair]], missed[order[pair + 1]] = order[pair + 1] // 3, order[pair] // 3
    return missed.reshape(-1, 3)


def _is_closed(corners: np.ndarray, faces: np.ndarray) -> bool:
    """Whether faces (F, 3) of welded points bound volumes and look outwards, so that their backs are never
    visible.

    Each edge must be passed once in each direction, and every connected piece must have a positive volume.
    corners: (F, 3, 3) positions of the faces' corners.
    """
    if not len(faces):
        return False
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    count = int(faces.max()) + 1
    forth, back = edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]
    if len(np.unique(forth)) != len(forth) or not np.array_equal(np.sort(forth), np.sort(back)):
        return False
    joined = scipy.sparse.coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    piece = scipy.sparse.csgraph.connected_components(joined, directed=False)[1][faces[:, 0]]
    volume = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return bool((np.bincount(piece, volume)[np.unique(piece)] > 0).all())


def _crease_normals(points: np.ndarray, faces: np.ndarray, weld: np.ndarray) -> np.ndarray:
    """Unit normals (3F, 3) of the corners, area-weighted over the faces around the point that bend by less than a
    crease.
    """
    a, b, c = (points[faces[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    unit = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-20)
    point = weld[faces.reshape(-1)]
    face = np.repeat(np.arange(len(faces)), 3)
    order = np.argsort(point, kind="stable")
    count = np.bincount(point)
    start = np.cumsum(count) - count
    repeats = count[point]
    left = np.repeat(np.arange(len(point)), repeats)
    step = np.arange(len(left)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
    right = face[order[start[point[left]] + step]]
    smooth = (unit[face[left]] * unit[right]).sum(axis=1) > np.cos(CREASE_RAD)
    summed = np.zeros((len(point), 3))
    np.add.at(summed, left[smooth], area[right[smooth]])
    return summed / np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-20)


def _part_share(faces: Tensor, is_part: Tensor, like: Tensor) -> Tensor:
    """Share (V,) of the faces around each vertex that belong to one part."""
    index = faces.reshape(-1)
    flags = is_part.to(like.dtype).repeat_interleave(3)
    total = like.new_zeros(like.shape[0]).index_add(0, index, torch.ones_like(flags))
    return like.new_zeros(like.shape[0]).index_add(0, index, flags) / total.clamp(min=1.0)


def offset_indices(numbers: Sequence[Tensor], counts: Sequence[int]) -> list[Tensor]:
    """Indices into several sets, made indices into their concatenation; -1 stays. counts: size of each set."""
    return [torch.where(n < 0, n, n + sum(counts[:i])) for i, n in enumerate(numbers)]


@dataclass(frozen=True, slots=True)
class ObjectSurfaces:
    """The surfaces of N objects, concatenated."""

    templates: tuple[TemplateSurface, ...]
    """Surface of each object."""
    owner: Tensor
    """(V,) int64, object of each vertex."""
    vertex_ranges: Tensor
    """(N, 2) int64."""
    face_ranges: Tensor
    """(N, 2) int64."""
    faces: Tensor
    """(F, 3) int64 into the V vertices."""
    neighbours: Tensor
    """(F, 3) int64 into the F faces, see `TemplateSurface`."""
    colours: Tensor
    """(V, 3)."""
    paint: Tensor
    """(V,)."""
    glass: Tensor
    """(V,)."""

    @classmethod
    def from_surfaces(cls, surfaces: Sequence[TemplateSurface], like: Tensor) -> ObjectSurfaces:
        """The surfaces concatenated, in the dtype and on the device of `like`."""
        device = like.device
        ends = np.cumsum([0] + [s.unit.shape[0] for s in surfaces])
        face_ends = np.cumsum([0] + [s.faces.shape[0] for s in surfaces])
        counts = torch.tensor([s.unit.shape[0] for s in surfaces], dtype=torch.int64)

        def ranges(edges: np.ndarray) -> Tensor:
            return torch.as_tensor(np.stack([edges[:-1], edges[1:]], axis=1), dtype=torch.int64)

        def packed(parts: list[Tensor], *shape: int) -> Tensor:
            return torch.cat(parts) if parts else like.new_zeros(shape)

        faces = offset_indices([s.faces for s in surfaces], counts.tolist())
        missed = offset_indices([s.neighbours for s in surfaces], [s.faces.shape[0] for s in surfaces])
        return cls(
            tuple(surfaces),
            torch.repeat_interleave(torch.arange(len(surfaces)), counts).to(device),
            ranges(ends),
            ranges(face_ends),
            packed(faces, 0, 3).to(torch.int64),
            packed(missed, 0, 3).to(torch.int64),
            packed([s.colours for s in surfaces], 0, 3),
            packed([s.paint for s in surfaces], 0),
            packed([s.glass for s in surfaces], 0),
        )

    @staticmethod
    def concat_faces(surface_sets: Sequence[ObjectSurfaces]) -> tuple[Tensor, list[list[int]], list[list[int]]]:
        """Faces (F, 3) of several sets of objects, concatenated; vertex and face ranges of all objects."""
        vertex_ranges: list[list[int]] = []
        face_ranges: list[list[int]] = []
        faces, vertices, triangles = [], 0, 0
        for surfaces in surface_sets:
            faces.append(surfaces.faces + vertices)
            vertex_ranges += [[vertices + a, vertices + b] for a, b in surfaces.vertex_ranges.tolist()]
            face_ranges += [[triangles + a, triangles + b] for a, b in surfaces.face_ranges.tolist()]
            vertices += surfaces.owner.shape[0]
            triangles += surfaces.faces.shape[0]
        return torch.cat(faces), vertex_ranges, face_ranges

    def local_vertices(self, ffd: Tensor, size_lhw: Tensor, mirrored: bool = False) -> Tensor:
        """Vertices (V, 3) m in their objects' frames.

        Args:
            ffd: (N, P, 3) lattice offsets.
            size_lhw: (N, 3) m.
            mirrored: Whether left and right are swapped.
        """
        parts = []
        for i, surface in enumerate(self.templates):
            if mirrored:
                unit = surface.unit * surface.unit.new_tensor([1.0, 1.0, -1.0])
                unit = unit + _LatticeBend.apply(ffd[i], surface.mirror_weights)
            else:
                unit = surface.unit + _LatticeBend.apply(ffd[i], surface.weights)
            parts.append(unit * size_lhw[i])
        return torch.cat(parts) if parts else ffd.new_zeros(0, 3)

    def normals(self, local: Tensor) -> tuple[Tensor, Tensor]:
        """Unit normals (V, 3) twice: with sharp edges for shading, and welded ones."""
        sharp, smooth = [], []
        for surface, (start, end) in zip(self.templates, self.vertex_ranges.tolist(), strict=True):
            points = local[start:end]
            sharp.append(vertex_normals(points, surface.faces))
            count = int(surface.weld.max()) + 1
            position = points.new_zeros(count, 3).index_copy(0, surface.weld, points)
            smooth.append(vertex_normals(position, surface.weld[surface.faces])[surface.weld])
        if not sharp:
            return local, local
        return torch.cat(sharp), torch.cat(smooth)

    def per_vertex(self, values: Tensor) -> Tensor:
        """Values (N, ...) of the objects at their vertices (V, ...)."""
        return values.index_select(0, self.owner)

    def place(self, local: Tensor, yaw: Tensor, translation: Tensor) -> Tensor:
        """Camera-space points (V, 3) m.

        Args:
            local: (V, 3) m in the objects' frames.
            yaw: (N,) rad.
            translation: (N, 3) m.
        """
        return rotate_y(local, self.per_vertex(yaw)) + self.per_vertex(translation)


@dataclass(frozen=True, slots=True)
class VertexPlacement:
    """Input of the kernels that place vertices, besides poses."""

    unit: Tensor
    """(V, 3) in the unit box."""
    weights: tuple[Tensor, ...]
    """Lattice weights (v, P) of each object."""
    normal: Tensor
    """(V, 3) unit, local."""
    owner: Tensor
    """(V,) int32."""
    paint: Tensor
    """(V,)."""
    base_ffd: Tensor
    """(N, P, 3) photographed lattice offsets."""
    base_bend: Tensor
    """(3, V) their effect at the vertices."""
    base_exposure: Tensor
    """(V,) how squarely the photographed sun meets the vertices."""
    sunlight: Tensor
    """(N,) strength of that sun, 0 without photograph."""
    matrix: Tensor
    """(N, 3, 4) cameras of the objects."""
    centre: Tensor
    """(N, 3) m, positions of the cameras."""
    vertex_edges: list[int]
    """First vertex of each object, and V."""

    @classmethod
    def concat(cls, placements: Sequence[VertexPlacement]) -> VertexPlacement:
        """Several scenes' objects, concatenated."""
        if len(placements) == 1:
            return placements[0]
        counts = [r.matrix.shape[0] for r in placements]
        shifts = [sum(counts[:i]) for i in range(len(counts))]
        edges = [0]
        for placement in placements:
            edges += [edges[-1] + e for e in placement.vertex_edges[1:]]
        plain = ("unit", "normal", "paint", "base_ffd", "base_exposure", "sunlight", "matrix", "centre")
        return cls(
            base_bend=torch.cat([r.base_bend for r in placements], 1),
            weights=tuple(w for r in placements for w in r.weights),
            owner=torch.cat([r.owner + s for r, s in zip(placements, shifts, strict=True)]),
            vertex_edges=edges,
            **{name: torch.cat([getattr(r, name) for r in placements]) for name in plain},
        )

    @classmethod
    def from_objects(
        cls, surfaces: ObjectSurfaces, base: Objects, normal: Tensor, camera: Camera, sun: Tensor, sunlight: Tensor
    ) -> VertexPlacement:
        """The input for one scene's photographed objects.

        Args:
            surfaces: Surfaces of the objects.
            base: Objects at their photographed poses.
            normal: (V, 3) welded normals.
            camera: The camera.
            sun: (3,) photographed direction.
            sunlight: (N,) photographed strength.
        """
        count, like = len(base), normal
        placement = cls(
            unit=torch.cat([s.unit for s in surfaces.templates]) if count else like,
            weights=tuple(s.weights for s in surfaces.templates),
            normal=normal.contiguous(),
            owner=surfaces.owner.to(torch.int32),
            paint=surfaces.paint,
            base_ffd=base.ffd.new_full((), torch.nan),
            base_bend=torch.zeros_like(like.T),
            base_exposure=like.new_zeros(len(like)),
            sunlight=sunlight,
            matrix=camera.matrix.to(like).expand(count, 3, 4).contiguous(),
            centre=camera_centre(camera.matrix).to(like).expand(count, 3).contiguous(),
            vertex_edges=[0, *surfaces.vertex_ranges[:, 1].tolist()],
        )
        placement = replace(placement, base_bend=placement.bend_vertices(base.ffd), base_ffd=base.ffd)
        lights = torch.cat([sun.to(like).expand(count, 3), sunlight[:, None]], dim=1)
        poses = base.ffd, base.size_lhw, base.yaw, base.translation
        return (
            replace(placement, base_exposure=place_with_kernels(placement, *poses, lights)[3])
            if count
            else placement
        )

    def bend_vertices(self, ffd: Tensor) -> Tensor:
        """Effect (3, V) of lattice offsets (N, P, 3) at the vertices, as fractions of the unit box.

        Rows x, y, z: a product with three rows is three times as fast as one with three columns.
        """
        if not ffd.is_cuda and torch.equal(ffd, self.base_ffd):
            return self.base_bend
        linear = torch.nn.functional.linear
        parts = [linear(own.T.contiguous(), weights) for own, weights in zip(ffd, self.weights, strict=True)]
        return torch.cat(parts, 1)

    def bend_gradient(self, to_bent: Tensor) -> Tensor:
        """A gradient (3, V) to the bend as one to the offsets (N, P, 3)."""
        parts = [
            (to_bent[:, a:b].contiguous() @ w).T
            for (a, b), w in zip(itertools.pairwise(self.vertex_edges), self.weights, strict=True)
        ]
        return torch.stack(parts)


def place_with_kernels(
    placement: VertexPlacement, ffd: Tensor, size_lhw: Tensor, yaw: Tensor, translation: Tensor, lights: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Place vertices by the kernels, in float32.

    Args:
        placement: Input besides poses.
        ffd: (N, P, 3) lattice offsets.
        size_lhw: (N, 3) m.
        yaw: (N,) rad.
        translation: (N, 3) m.
        lights: (N, 4) direction and strength of the sun on each object.

    Returns:
        Clip coordinates (V, 3), cosine (V,) towards the camera, brightening (V,), see `texture.limit_brightening`,
        and how squarely the sun meets the vertices (V,).
    """
    from scene_ir.render.kernels.placement import PlaceVertices

    placed = PlaceVertices.apply(ffd, size_lhw, yaw, translation, lights, placement)
    assert isinstance(placed, tuple)
    return placed


def place_patches(
    yaw: Tensor, translation: Tensor, size_lhw: Tensor, lights: Tensor, fixed: tuple[Tensor, ...]
) -> tuple[Tensor, Tensor, Tensor]:
    """Place the shadows' patches by the kernels.

    Args:
        yaw: (N,) rad.
        translation: (N, 3) m.
        size_lhw: (N, 3) m.
        lights: (N, 4) direction and strength of the sun on each object.
        fixed: As of `PreparedScene.patch_inputs`.

    Returns:
        (N, 3, 3) float64 from a pixel (x, y, 1) to (s, t, 1) / w on the patch, s and t in [0, 1]; without
        gradient, its inverse and the corners' clip coordinates (4N, 3).
    """
    from scene_ir.render.kernels.shadow_patches import PlacePatches

    placed = PlacePatches.apply(yaw, translation, size_lhw, lights, fixed)
    assert isinstance(placed, tuple)
    return placed


def place_vertices(
    local: Tensor, normal: Tensor, owner: Tensor, objects: Objects, matrix: Tensor, centre: Tensor
) -> tuple[Tensor, Tensor]:
    """Place vertices in plain torch.

    Args:
        local: (V, 3) m in the objects' frames.
        normal: (V, 3) local normals.
        owner: (V,) int64.
        objects: Poses.
        matrix: (3, 4) of the camera.
        centre: (3,) m, position of the camera.

    Returns:
        Clip coordinates (V, 3) and cosines (V,) of the normals towards the camera.
    """
    turn = objects.yaw.index_select(0, owner)
    points = rotate_y(local, turn) + objects.translation.index_select(0, owner)
    clip = points @ matrix[:, :3].T + matrix[:, 3]
    return clip, facing_cosine(points, rotate_y(normal, turn), centre)


class _LatticeBend(torch.autograd.Function):
    """weights (V, 64) @ offsets (64, 3), in the operand order that is several times faster for three columns."""

    @staticmethod
    def forward(ctx: Any, offsets: Tensor, weights: Tensor) -> Tensor:
        ctx.weights = weights
        return torch.nn.functional.linear(offsets.T, weights).T

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        return (grad_outputs[0].T.contiguous() @ ctx.weights).T, None


def rotate_y(local: Tensor, yaw: Tensor) -> Tensor:
    """Vectors (V, 3) turned about the camera's y axis, each by its own yaw (V,) rad."""
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    x, y, z = local.unbind(-1)
    return torch.stack([cos * x + sin * z, y, cos * z - sin * x], dim=-1)


def facing_cosine(points: Tensor, normals: Tensor, centre: Tensor) -> Tensor:
    """Cosine (V,) between normals and the direction to the camera.

    Args:
        points: (V, 3) m.
        normals: (V, 3) unit.
        centre: (3,) m, position of the camera.
    """
    towards = centre - points
    return (towards * normals).sum(-1) / towards.norm(dim=-1).clamp(min=1e-6)


def camera_centre(matrix: Tensor) -> Tensor:
    """Position (3,) m of the camera; the fourth column of KITTI's camera 2 moves it off the origin."""
    return -torch.linalg.solve(matrix[:, :3], matrix[:, 3])


def shadow_offset(sun: Tensor, yaw: Tensor, height_m: Tensor) -> Tensor:
    """Offset (N, 2) m, (x, z) in the objects' frames, at which the shadow of a point at a height falls.

    Args:
        sun: (3,) unit.
        yaw: (N,) rad.
        height_m: (N,).
    """
    away = -sun / (-sun[1]).clamp(min=model.LEAST_SINE)
    world = torch.stack([away[0].expand_as(yaw), torch.zeros_like(yaw), away[2].expand_as(yaw)], dim=-1)
    offset = rotate_y(world, -yaw)[:, [0, 2]] * height_m[:, None]
    length = offset.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    return offset * (length.clamp(max=model.SUN_OFFSET_MAX_M) / length)


def shadow_corners(size_lhw: Tensor, offset: Tensor) -> Tensor:
    """Corners (N, 4, 2) m, (x, z) in the objects' frames, of the ground patches that hold the shadows."""
    half = size_lhw[:, [0, 2]] / 2 + SHADOW_MARGIN_M
    return rectangle_corners(-half + offset.clamp(max=0.0), half + offset.clamp(min=0.0))


def outwardness(points: Tensor, size_lhw: Tensor, offset: Tensor) -> Tensor:
    """Distance of points along the shadow's offset: 0 in the object's centre, 1 where the shadow of the roof's far
    edge ends; linear in the points.

    Args:
        points: (N, K, 2) m, (x, z) in the objects' frames.
        size_lhw: (N, 3) m.
        offset: (N, 2) m, as of `shadow_offset`.

    Returns:
        (N, K).
    """
    length = offset.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    along = offset / length
    edge = (along.abs() * size_lhw[:, [0, 2]] / 2).sum(dim=-1, keepdim=True)
    return (points * along[:, None]).sum(dim=-1) / (edge + length)


def rectangle_corners(low: Tensor, high: Tensor) -> Tensor:
    """Corners (..., 4, 2), in order, of rectangles from low to high (..., 2)."""
    x = torch.stack([low[..., 0], high[..., 0], high[..., 0], low[..., 0]], dim=-1)
    z = torch.stack([low[..., 1], low[..., 1], high[..., 1], high[..., 1]], dim=-1)
    return torch.stack([x, z], dim=-1)


def pixels_to_ground(
    pixels: Tensor, unproject: Tensor, centre: Tensor, translation: Tensor, yaw: Tensor, ground: Tensor
) -> Tensor | None:
    """Points (K, 2) m, (x, z) in an object's frame, of the ground at its foot that pixels show; None where a pixel
    shows no ground.

    Args:
        pixels: (K, 2) px.
        unproject: (3, 3) inverse of the camera's matrix.
        centre: (3,) m, position of the camera.
        translation: (3,) m of the object.
        yaw: () rad of the object.
        ground: (4,) plane, to which the object's foot is parallel.
    """
    normal = ground[:3].to(pixels)
    ray = torch.cat([pixels, torch.ones_like(pixels[:, :1])], dim=1) @ unproject.T
    # No matrix product: its rounding depends on the number of threads.
    along, down = (ray * normal).sum(dim=1), (translation - centre) @ normal
    distance = down / torch.where(along.abs() > 1e-6, along, torch.full_like(along, 1e-6))
    if not bool(((distance > 0) & (along.abs() > 1e-6)).all()):
        return None
    points = centre + distance[:, None] * ray - translation
    return rotate_y(points, -yaw.expand(len(points)))[:, [0, 2]]


def place_on_ground(corners: Tensor, yaw: Tensor, translation: Tensor, ground: Tensor) -> Tensor:
    """Points (4N, 3) m on planes parallel to the ground through the objects' feet.

    Args:
        corners: (N, 4, 2) m, local (x, z).
        yaw: (N,) rad.
        translation: (N, 3) m.
        ground: (4,) plane.
    """
    flat = torch.stack([corners[..., 0], torch.zeros_like(corners[..., 0]), corners[..., 1]], dim=-1).reshape(
        -1, 3
    )
    turned = rotate_y(flat, yaw.repeat_interleave(4))
    x, _, z = turned.unbind(-1)
    y = -(ground[0] * x + ground[2] * z) / ground[1]
    return torch.stack([x, y, z], dim=-1) + translation.repeat_interleave(4, dim=0)


def shadow_density(local_xz: Tensor, size_lhw: Tensor, offset: Tensor) -> Tensor:
    """Darkness (T,) in [0, 1] of the ground under and next to a box-like vehicle; smooth.

    The contact shadow under the body fades over some tens of centimetres; the cast one is that of a box tapering
    to the roof, moved along the sun's offset.

    Args:
        local_xz: (T, 2) m, (x, z) in the vehicle's frame.
        size_lhw: (T, 3) m.
        offset: (T, 2) m, as of `shadow_offset`; (S, T, 2) for S suns, which gives (S, T).
    """
    half = size_lhw[:, [0, 2]] / 2

    def outside(centre: Tensor, extent: Tensor) -> Tensor:
        q = (local_xz - centre).abs() - extent
        apart = (q.clamp(min=0.0).square().sum(-1) + 1e-6).sqrt()
        return apart + q.amax(dim=-1).clamp(max=0.0)

    contact = _thread_invariant_sigmoid(-outside(offset.new_zeros(2), half - 0.12) / 0.10)
    shares = ((0.25, 0.97), (0.55, 0.92), (0.9, 0.72))
    cast = torch.stack(
        [_thread_invariant_sigmoid(-outside(offset * s, half * taper) / (0.04 + 0.05 * s)) for s, taper in shares]
    )
    lit = 1.0 - (1.0 - cast).prod(dim=0)
    return 1.0 - (1.0 - 0.72 * contact) * (1.0 - 0.55 * lit)


def _thread_invariant_sigmoid(values: Tensor) -> Tensor:
    """Sigmoid with the same bits for any number of threads: torch rounds the last values of each thread's share
    differently.
    """
    return torch.cat([part.sigmoid() for part in values.flatten().split(_GRAIN_SIZE)]).view_as(values)


def crop_rects(
    clip: Tensor,
    faces: Tensor,
    vertex_ranges: Sequence[Sequence[int]],
    face_ranges: Sequence[Sequence[int]],
    frames_hw: Sequence[tuple[int, int]],
    margins_px: Sequence[float],
) -> Tensor:
    """Pixel rectangles (N, 4) int64, half-open, clipped to the image, that hold the draws; exact across the near
    plane. Empty for a draw behind the camera or outside its image.

    Args:
        clip: (V, 3), on the CPU.
        faces: (F, 3).
        vertex_ranges, face_ranges: [start, end) of each draw; vertex ranges are consecutive.
        frames_hw: Image size of each draw, px.
        margins_px: Margin of each draw.
    """
    check_finite("raster.clip", clip)
    rects = np.zeros((len(vertex_ranges), 4), dtype=np.int64)
    filled = [i for i, (start, end) in enumerate(vertex_ranges) if end > start]
    if filled:
        points = clip.double().numpy()
        starts = np.array([vertex_ranges[i][0] for i in filled])
        nearest = np.minimum.reduceat(points[:, 2], starts)
        px = points[:, :2] / np.maximum(points[:, 2:], verbs.NEAR_M)
        first, last = np.minimum.reduceat(px, starts), np.maximum.reduceat(px, starts)
        for row in np.flatnonzero(nearest < verbs.NEAR_M):
            box = _clipped_bounds(points, faces, face_ranges[filled[row]])
            first[row], last[row] = (np.inf, -np.inf) if box is None else (box[:2], box[2:])
        margin, limit = np.array(margins_px)[filled, None], np.array(frames_hw, dtype=np.float64)[filled, ::-1]
        low = np.minimum(np.maximum(np.ceil(first - margin), 0.0), limit)
        high = np.minimum(np.maximum(np.floor(last + margin) + 1.0, 0.0), limit)
        rects[filled] = np.concatenate([low, high], axis=1) * (high > low).all(axis=1, keepdims=True)
    return torch.from_numpy(rects)


def _clipped_bounds(points: np.ndarray, faces: Tensor, face_range: Sequence[int]) -> np.ndarray | None:
    """Bounds (4,) px of the part of a draw beyond the near plane; None if there is none. points: (V, 3) clip."""
    corners = faces[face_range[0] : face_range[1]].cpu().numpy()
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    a, b = points[edges[:, 0]], points[edges[:, 1]]
    front = a[:, 2] >= verbs.NEAR_M
    crosses = front != (b[:, 2] >= verbs.NEAR_M)
    start, end = a[crosses], b[crosses]
    share = (verbs.NEAR_M - start[:, 2:]) / (end[:, 2:] - start[:, 2:])
    seen = np.concatenate([a[front], start + share * (end - start)])
    if not len(seen):
        return None
    px = seen[:, :2] / seen[:, 2:]
    return np.concatenate([px.min(axis=0), px.max(axis=0)])


def nearest_hits(
    fragments: verbs.Fragments, reach_px: Sequence[float], draws: range | None = None, out: Tensor | None = None
) -> Tensor:
    """Nearest hit pixel of the same draw for each packed pixel (T,) int64: itself where hit, -1 beyond `reach_px`.

    Args:
        fragments: Visible faces.
        reach_px: Reach of each draw.
        draws: Draws to process; all by default.
        out: (T,) to write the draws' part into; on a GPU the whole.
    """
    layout, face = fragments.layout, fragments.face.cpu()
    nearest = torch.empty_like(face, dtype=torch.int64) if out is None or out.is_cuda else out
    spans, rects = layout.host_offsets, layout.host_rects
    for i in draws if draws is not None else range(len(rects)):
        start, end = spans[i], spans[i + 1]
        if end == start:
            continue
        x0, y0, x1, y1 = rects[i]
        missed = (face[start:end].numpy() < 0).reshape(y1 - y0, x1 - x0)
        if missed.all():
            nearest[start:end] = -1
            continue
        distance, index = nearest_true_pixel(~missed)
        index += start
        index[distance > reach_px[i]] = -1
        nearest[start:end].copy_(torch.from_numpy(index.reshape(-1)))
    if out is not None:
        return nearest if out is nearest else out.copy_(nearest, non_blocking=True)
    return nearest.to(fragments.face.device, non_blocking=True)


def nearest_true_pixel(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance (h, w) px to the nearest true pixel of a mask (h, w) that has one, and that pixel's flat index."""
    distance, labels = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    where = np.flatnonzero(mask)
    pixel_of = np.zeros(len(where) + 1, dtype=np.int64)
    numbers = np.asarray(labels, dtype=np.int32)
    pixel_of[numbers.reshape(-1)[where]] = where
    return np.asarray(distance), pixel_of.take(numbers)


def perspective_weights(corners: Tensor, xy: Tensor) -> Tensor:
    """Perspective-correct weights (K, 3) of triangles (K, 3, 3) in clip coordinates at pixels xy (K, 2)."""
    ray = torch.cat([xy, torch.ones_like(xy[:, :1])], dim=1).double()
    a, b, c = corners.double().unbind(dim=1)
    edges = [torch.linalg.cross(p, q) for p, q in ((b, c), (c, a), (a, b))]
    value = torch.stack([(edge * ray).sum(dim=1) for edge in edges], dim=1)
    return value / value.sum(dim=1, keepdim=True)


def project_vertices(points: Tensor, camera: Camera) -> Tensor:
    """Clip coordinates (V, 3) of camera-space points (V, 3)."""
    return to_clip(points, camera.matrix.to(points))
