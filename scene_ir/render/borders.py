"""Borders between the faces seen by two neighbouring samples of a mesh, differentiable to its vertices.

A sample is a point of the picture at which the z-buffer decides which face is visible. Between two samples that
see different faces lie creases at which the surface continues, the end of the nearer surface, or the line along
which two surfaces intersect. They follow from walks over the mesh, face by face, from both samples towards each
other, so that faces too thin for a sample to hit are found too.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from scene_ir.geometry import weld_vertices
from scene_ir.raster.verbs import Backend

MAX_WALK_FACES = 4
"""Faces over which a surface is followed between two samples."""


@dataclass(frozen=True, slots=True)
class MeshEdges:
    """Adjacency and creases of a mesh's faces (F, 3); edge 3 * face + i lies opposite to corner i."""

    across: Tensor
    """(3F,) int64, the same edge of the neighbouring face; -1 where there is none or more than one."""
    creased: Tensor
    """(3F,) bool, whether the appearance changes at the edge."""
    onwards: Tensor
    """(F, 3) int64, neighbours across edges without crease; -1 at creases."""

    @classmethod
    def from_mesh(cls, vertices: Tensor, faces: Tensor, materials: Tensor, crease_cos: float) -> MeshEdges:
        """Adjacency of a mesh; an edge is a crease where materials differ or normals diverge.

        Args:
            vertices: (V, 3); equal positions are one vertex.
            faces: (F, 3).
            materials: (F, C).
            crease_cos: Cosine of the normals below which an edge is a crease.
        """
        corners = weld_vertices(vertices)[faces]
        ends = torch.stack([corners[:, [1, 2, 0]], corners[:, [2, 0, 1]]], dim=-1).reshape(-1, 2)
        low, high = ends.amin(dim=1), ends.amax(dim=1)
        _, owner, counts = torch.unique(low * len(vertices) + high, return_inverse=True, return_counts=True)
        order = torch.argsort(owner, stable=True)
        first = (counts.cumsum(0) - counts)[counts == 2]
        one, other = order[first], order[first + 1]
        across = torch.full_like(owner, -1)
        across[one], across[other] = other, one
        sides = vertices[faces]
        normal = torch.linalg.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
        normal = torch.nn.functional.normalize(normal, dim=-1, eps=1e-12)
        here, there = torch.arange(len(across)) // 3, across.clamp_min(0) // 3
        creased = ((normal[here] * normal[there]).sum(dim=1) < crease_cos) | (
            materials[here] != materials[there]
        ).any(1)
        creased |= across < 0
        return cls(across, creased, torch.where(creased, -1, there).reshape(-1, 3))

    def join_smoothly(self, one: Tensor, other: Tensor) -> Tensor:
        """Whether faces (P,) share an edge without crease with others (P,)."""
        return (self.onwards.index_select(0, one) == other[:, None]).any(dim=1)


@dataclass(frozen=True, slots=True)
class VisibleFace:
    """Faces visible on paths between samples."""

    face: Tensor
    """(B,) int64."""
    share: Tensor
    """(B,) position on the path, in [0, 1]."""

    def reversed(self) -> VisibleFace:
        """The same on the reversed paths."""
        return VisibleFace(self.face, 1 - self.share)


@dataclass(frozen=True, slots=True)
class SurfaceBorders:
    """Borders (B) on paths between samples."""

    path: Tensor
    """(B,) int64, index of the path."""
    share: Tensor
    """(B,) position on it in [0, 1], differentiable."""
    across: Tensor
    """(B,) bool, whether the border runs across the path rather than along it."""
    before: VisibleFace
    """Visible before the border."""
    after: VisibleFace
    """Visible after it."""


def find_borders(
    clip: Tensor,
    faces: Tensor,
    edges: MeshEdges,
    seen: tuple[Tensor, Tensor],
    start: Tensor,
    step: Tensor,
    backend: Backend,
) -> SurfaceBorders:
    """The borders on paths between samples that see different faces.

    Args:
        clip: (V, 3) clip coordinates.
        faces: (F, 3).
        edges: Adjacency of the faces.
        seen: (P,), (P,) int64, faces at the start and at the end of each path.
        start: (P, 3) start (x, y, 1), float64.
        step: (P, 3) difference between end and start.
        backend: Implementation.
    """
    points, end = clip.detach().to(torch.float64), start + step
    leave = MeshWalk.trace(points, faces, edges.across, seen, start, end, backend)
    enter = MeshWalk.trace(points, faces, edges.across, (seen[1], seen[0]), end, start, backend)
    # Difference of inverse depths, first surface minus second, where the first ends and where the second begins.
    nearer = leave.plane - enter.plane
    at_leave, at_enter = (
        (nearer * (start + share[:, None] * step)).sum(dim=1) for share in (leave.end, 1 - enter.end)
    )
    through = (1 - enter.end < leave.end) & (at_enter > 0) & (at_leave < 0) & (at_enter - at_leave).isfinite()
    meets = 1 - enter.end + (leave.end - 1 + enter.end) * at_enter / torch.where(through, at_enter - at_leave, 1.0)
    first_ends = at_leave + at_enter >= 0
    # The first surface is visible up to here, the second one beyond.
    until = torch.where(through, meets, torch.where(first_ends, leave.end, 1 - enter.end))
    until = torch.where(leave.met, 1.0, torch.where(enter.met, 0.0, until))
    path, edge, near, far = leave.creases(edges.creased, until)
    path_back, edge_back, near_back, far_back = enter.creases(edges.creased, 1 - until)
    apart = (~leave.met & ~enter.met).nonzero()[:, 0]
    one, other = leave.last_face(apart, until), enter.last_face(apart, 1 - until).reversed()
    ends = torch.where(first_ends, leave.edge[:, -1], enter.edge[:, -1])
    paths = torch.cat([path, path_back, apart])
    share, slope = _cross_edges(clip, faces, torch.cat([edge, edge_back, ends[apart]]), start[paths], end[paths])
    at = through[apart].nonzero()[:, 0]
    if len(at):
        plane = _face_planes(clip, faces, leave.face[apart[at], -1]) - _face_planes(
            clip, faces, enter.face[apart[at], -1]
        )
        where = at + len(paths) - len(apart)
        met = -(plane * start[paths[where]]).sum(dim=1) / (plane * step[paths[where]]).sum(dim=1)
        share, slope = share.index_put((where,), met), slope.index_put((where,), plane.detach()[:, :2])
    return SurfaceBorders(
        paths,
        share.clamp(0, 1),
        _runs_across(slope, step[paths]),
        _concat_faces(near, far_back.reversed(), one),
        _concat_faces(far, near_back.reversed(), other),
    )


@dataclass(frozen=True, slots=True)
class SurfaceRims:
    """Ends of surfaces on paths to samples that hit nothing."""

    inner: SurfaceBorders
    """Borders (B) before the end."""
    end: Tensor
    """(B,) end of the surface on the borders' paths, as a share, differentiable."""
    across: Tensor
    """(P,) bool, whether the end runs across the path rather than along it."""


def find_rims(
    clip: Tensor, faces: Tensor, edges: MeshEdges, seen: Tensor, start: Tensor, step: Tensor, backend: Backend
) -> SurfaceRims:
    """The ends of surfaces on paths from samples that see `seen` to samples that hit nothing.

    Args:
        clip: (V, 3) clip coordinates.
        faces: (F, 3).
        edges: Adjacency of the faces.
        seen: (P,) int64, faces at the start.
        start: (P, 3) start (x, y, 1), float64.
        step: (P, 3) difference between end and start.
        backend: Implementation.
    """
    points, end = clip.detach().to(torch.float64), start + step
    walk = MeshWalk.trace(points, faces, edges.across, (seen, torch.full_like(seen, -1)), start, end, backend)
    path, edge, near, far = walk.creases(edges.creased, walk.end)
    share, slope = _cross_edges(clip, faces, edge, start[path], end[path])
    ends, _ = _cross_edges(clip, faces, walk.edge[path, -1], start[path], end[path])
    _, slope_of_end = _cross_edges(clip.detach(), faces, walk.edge[:, -1], start, end)
    return SurfaceRims(
        SurfaceBorders(path, share.clamp(0, 1), _runs_across(slope, step[path]), near, far),
        torch.where(walk.end[path] < 1, ends.clamp(0, 1), 1.0),
        _runs_across(slope_of_end, step),
    )


def _runs_across(slope: Tensor, step: Tensor) -> Tensor:
    """Whether (B,) edges with slopes (B, 2) of their functions run across steps (B, 3) rather than along them."""
    heading = step[:, :2].abs()
    along, aside = (slope * heading).sum(dim=1).abs(), (slope * (1 - heading)).sum(dim=1).abs()
    return (along > aside) | ((along == aside) & (heading[:, 0] > 0))


def _concat_faces(*sights: VisibleFace) -> VisibleFace:
    return VisibleFace(torch.cat([sight.face for sight in sights]), torch.cat([sight.share for sight in sights]))


@dataclass(frozen=True, slots=True)
class MeshWalk:
    """Walks from the faces at the start of paths towards their ends, over W = MAX_WALK_FACES + 1 faces."""

    face: Tensor
    """(P, W) faces."""
    share: Tensor
    """(P, W) position at which each face is left, in [0, 1]."""
    edge: Tensor
    """(P, W) edge by which it is left, 3 * face + edge."""
    goes_on: Tensor
    """(P, W) bool, whether the walk continues to the next face."""
    end: Tensor
    """(P,) position at which the last face is left."""
    plane: Tensor
    """(P, 3) inverse depth of the last face at pixel (x, y, 1), as a product with it."""
    met: Tensor
    """(P,) bool, whether the last face is the one at the path's end."""

    @classmethod
    def trace(
        cls,
        points: Tensor,
        faces: Tensor,
        across: Tensor,
        seen: tuple[Tensor, Tensor],
        start: Tensor,
        end: Tensor,
        backend: Backend,
    ) -> MeshWalk:
        """Walk from the first of `seen` towards the second.

        Args:
            points: (V, 3) float64 clip coordinates.
            faces: (F, 3).
            across: See `MeshEdges`.
            seen: (P,), (P,) faces at start and end.
            start, end: (P, 3) pixels (x, y, 1).
            backend: Implementation.
        """
        if backend == "warp":
            from scene_ir.render.kernels.mesh_walk import trace_walks

            face, share, edge, goes_on, plane, met = trace_walks(
                points, faces, across, seen, start, end, MAX_WALK_FACES
            )
            return cls(face, share, edge, goes_on, share[:, -1], plane, met)
        here, goal = seen
        share, edge, plane, beyond = _exit_face(points, faces, here, start, end)
        met, going = torch.zeros_like(here, dtype=torch.bool), torch.ones_like(here, dtype=torch.bool)
        chain, goes_on = [(here, share, edge)], []
        for _ in range(MAX_WALK_FACES):
            onto = across[edge]
            apex = points[faces.reshape(-1)[onto]]
            going = going & ~met & (share < 1) & (onto >= 0) & ((beyond * apex).sum(dim=1) > 0)
            met = met | (going & (onto // 3 == goal))
            at = going.nonzero()[:, 0]
            left, *rest = _exit_face(points, faces, onto[at] // 3, start[at], end[at])
            further = (left.maximum(share[at]), *rest)
            share, edge, plane, beyond = (
                old.index_put((at,), new) for old, new in zip((share, edge, plane, beyond), further, strict=True)
            )
            chain.append((edge // 3, share, edge))
            goes_on.append(going)
        face, shares, edges = (torch.stack(column, dim=1) for column in zip(*chain, strict=True))
        goes_on.append(torch.zeros_like(going))
        return cls(face, shares, edges, torch.stack(goes_on, dim=1), share, plane, met)

    def creases(self, creased: Tensor, room: Tensor) -> tuple[Tensor, Tensor, VisibleFace, VisibleFace]:
        """Creases on the surface before `room` (P,), a share of the path; creased: as in `MeshEdges`.

        Returns:
            Paths (B,), edges (B,), and the faces visible before and after each crease.
        """
        path, place = (self.goes_on & (self.share < room[:, None]) & creased[self.edge]).nonzero(as_tuple=True)
        near, far = self._visible_face(path, place, room), self._visible_face(path, place + 1, room)
        return path, self.edge[path, place], near, far

    def last_face(self, path: Tensor, room: Tensor) -> VisibleFace:
        """Last faces visible on paths (B,) before `room` (P,)."""
        passed = (self.goes_on & (self.share < room[:, None])).sum(dim=1)
        return self._visible_face(path, passed[path], room)

    def _visible_face(self, path: Tensor, place: Tensor, room: Tensor) -> VisibleFace:
        """The faces at places (B,) of walks (B,), midway between entry and exit."""
        begins = torch.where(place > 0, self.share[path, (place - 1).clamp_min(0)], 0.0)
        ends = self.share[path, place].minimum(room[path]).maximum(begins)
        return VisibleFace(self.face[path, place], (begins + ends) / 2)


def _exit_face(
    points: Tensor, faces: Tensor, face: Tensor, start: Tensor, end: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Where paths from start to end (P, 3) leave faces (P,): position (P,), 1 if they do not; edge (P,), 3 * face
    + edge; the face's plane (P, 3), as in `MeshWalk`; and the edge's normal (P, 3), positive beyond it.
    """
    corners = points[faces[face].reshape(-1)].reshape(-1, 3, 3)
    normals = torch.linalg.cross(corners[:, [1, 2, 0]], corners[:, [2, 0, 1]])
    det = (corners[:, 0] * normals[:, 0]).sum(-1, keepdim=True)
    inside, outside = ((normals * place[:, None]).sum(-1) * det.sign() for place in (start, end))
    leaves = outside < 0
    ends = torch.where(leaves, inside / torch.where(leaves, inside - outside, 1.0), 1.0)
    share, edge = torch.where(det == 0, 0.0, ends).min(dim=1)
    beyond = -det.sign() * normals.gather(1, edge[:, None, None].expand(-1, 1, 3))[:, 0]
    return share, 3 * face + edge, normals.sum(dim=1) / det, beyond


def _cross_edges(clip: Tensor, faces: Tensor, edge: Tensor, start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
    """Position (B,), differentiable, at which edges (B,), 3 * face + edge, cross paths from start to end (B, 3),
    1/2 if they do not; and the slopes (B, 2) of their edge functions.
    """
    face, corner = edge // 3, edge % 3
    one, other = (clip.index_select(0, faces[face, (corner + turn) % 3]).to(torch.float64) for turn in (1, 2))
    normal = torch.linalg.cross(one, other)
    at_start, at_end = (normal * start).sum(dim=1), (normal * end).sum(dim=1)
    crossed = (at_start.detach() * at_end.detach() <= 0) & (at_start.detach() != at_end.detach())
    share = torch.where(crossed, at_start / torch.where(crossed, at_start - at_end, 1.0), 0.5)
    return share, normal.detach()[:, :2]


def _face_planes(clip: Tensor, faces: Tensor, face: Tensor) -> Tensor:
    """Planes (B, 3) of faces (B,), as in `MeshWalk`; differentiable."""
    corners = clip.index_select(0, faces[face].reshape(-1)).reshape(-1, 3, 3).to(torch.float64)
    normals = torch.linalg.cross(corners[:, [1, 2, 0]], corners[:, [2, 0, 1]])
    return normals.sum(dim=1) / (corners[:, 0] * normals[:, 0]).sum(-1, keepdim=True)
