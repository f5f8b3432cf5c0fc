"""What a mesh shows between two looks that see different faces: differentiable to its vertices.

A look is a point of the picture at which the z-buffer says which face is seen. Between two of them borders are
crossed: creases at which a surface goes on, the end of the nearer surface, or the line along which two surfaces
pass through each other. They follow from walks over the mesh, face by face, from both looks towards each other. So
a face too thin for a look to meet it is passed, and seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from scene_ir.geometry import weld_vertices
from scene_ir.raster.verbs import Backend

MAX_WALK_FACES = 4
"""How many faces further a surface is followed between two looks."""


@dataclass(frozen=True, slots=True)
class MeshEdges:
    """Of a mesh's faces (F, 3). across (3F,) int64: beyond edge 3 * face + i, opposite to the face's corner i, the
    edge of who shares it, -1 where nobody does or more than one. creased (3F,): whether looks change there.
    onwards (F, 3) int64: the faces beyond edges at which they do not, -1 where they do.
    """

    across: Tensor
    creased: Tensor
    onwards: Tensor

    @classmethod
    def from_mesh(cls, vertices: Tensor, faces: Tensor, looks: Tensor, crease_cos: float) -> MeshEdges:
        """vertices (V, 3): at one place they are one. looks (F, C): of faces' materials. An
        edge is creased between two that differ, or whose normals' product is less than `crease_cos`.
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
        creased = ((normal[here] * normal[there]).sum(dim=1) < crease_cos) | (looks[here] != looks[there]).any(1)
        creased |= across < 0
        return cls(across, creased, torch.where(creased, -1, there).reshape(-1, 3))

    def join_smoothly(self, one: Tensor, other: Tensor) -> Tensor:
        """Whether faces (P,) share an edge with others (P,) at which looks do not change."""
        return (self.onwards.index_select(0, one) == other[:, None]).any(dim=1)


@dataclass(frozen=True, slots=True)
class VisibleFace:
    """face (B,) int64, and where (B,) on its way it is seen, as a share."""

    face: Tensor
    share: Tensor

    def reversed(self) -> VisibleFace:
        """The same on ways from their ends."""
        return VisibleFace(self.face, 1 - self.share)


@dataclass(frozen=True, slots=True)
class SurfaceBorders:
    """Borders (B,) on ways. way (B,) int64: which; share (B,) in [0, 1]: where on it, differentiable; across (B,):
    whether it runs across the way rather than along it; before, after: what is seen on both sides.
    """

    way: Tensor
    share: Tensor
    across: Tensor
    before: VisibleFace
    after: VisibleFace


def find_borders(
    clip: Tensor,
    faces: Tensor,
    edges: MeshEdges,
    seen: tuple[Tensor, Tensor],
    start: Tensor,
    step: Tensor,
    backend: Backend,
) -> SurfaceBorders:
    """The borders on ways from looks (P, 3), (x, y, 1), to those a step (P, 3) further, of which the ones see the
    first faces of `seen` (P,), (P,) int64, and the others the second. clip (V, 3), faces (F, 3).
    """
    points, end = clip.detach().to(torch.float64), start + step
    leave = MeshWalk.trace(points, faces, edges.across, seen, start, end, backend)
    enter = MeshWalk.trace(points, faces, edges.across, (seen[1], seen[0]), end, start, backend)
    # How much nearer the first surface is, as inverse depth, where it ends and where the second one begins.
    nearer = leave.plane - enter.plane
    at_leave, at_enter = (
        (nearer * (start + share[:, None] * step)).sum(dim=1) for share in (leave.end, 1 - enter.end)
    )
    through = (1 - enter.end < leave.end) & (at_enter > 0) & (at_leave < 0) & (at_enter - at_leave).isfinite()
    meets = 1 - enter.end + (leave.end - 1 + enter.end) * at_enter / torch.where(through, at_enter - at_leave, 1.0)
    first_ends = at_leave + at_enter >= 0
    # Up to there the first surface is seen, from there on the second.
    until = torch.where(through, meets, torch.where(first_ends, leave.end, 1 - enter.end))
    until = torch.where(leave.met, 1.0, torch.where(enter.met, 0.0, until))
    way, edge, near, far = leave.creases(edges.creased, until)
    way_back, edge_back, near_back, far_back = enter.creases(edges.creased, 1 - until)
    apart = (~leave.met & ~enter.met).nonzero()[:, 0]
    one, other = leave.last_face(apart, until), enter.last_face(apart, 1 - until).reversed()
    ends = torch.where(first_ends, leave.edge[:, -1], enter.edge[:, -1])
    ways = torch.cat([way, way_back, apart])
    share, slope = _cross_edges(clip, faces, torch.cat([edge, edge_back, ends[apart]]), start[ways], end[ways])
    at = through[apart].nonzero()[:, 0]
    if len(at):
        plane = _face_planes(clip, faces, leave.face[apart[at], -1]) - _face_planes(
            clip, faces, enter.face[apart[at], -1]
        )
        where = at + len(ways) - len(apart)
        met = -(plane * start[ways[where]]).sum(dim=1) / (plane * step[ways[where]]).sum(dim=1)
        share, slope = share.index_put((where,), met), slope.index_put((where,), plane.detach()[:, :2])
    return SurfaceBorders(
        ways,
        share.clamp(0, 1),
        _runs_across(slope, step[ways]),
        _concat_faces(near, far_back.reversed(), one),
        _concat_faces(far, near_back.reversed(), other),
    )


@dataclass(frozen=True, slots=True)
class SurfaceRims:
    """Where surfaces end on ways (P,) to looks that meet nothing. inner: the borders (B,) before that; end (B,):
    where on the borders' ways the surface ends, as a share, differentiable; across (P,): whether that end runs
    across the way rather than along it.
    """

    inner: SurfaceBorders
    end: Tensor
    across: Tensor


def find_rims(
    clip: Tensor, faces: Tensor, edges: MeshEdges, seen: Tensor, start: Tensor, step: Tensor, backend: Backend
) -> SurfaceRims:
    """Of ways as those of `find_borders`, whose looks see the faces `seen` (P,) and, a step further, nothing."""
    points, end = clip.detach().to(torch.float64), start + step
    walk = MeshWalk.trace(points, faces, edges.across, (seen, torch.full_like(seen, -1)), start, end, backend)
    way, edge, near, far = walk.creases(edges.creased, walk.end)
    share, slope = _cross_edges(clip, faces, edge, start[way], end[way])
    ends, _ = _cross_edges(clip, faces, walk.edge[way, -1], start[way], end[way])
    _, slope_of_end = _cross_edges(clip.detach(), faces, walk.edge[:, -1], start, end)
    return SurfaceRims(
        SurfaceBorders(way, share.clamp(0, 1), _runs_across(slope, step[way]), near, far),
        torch.where(walk.end[way] < 1, ends.clamp(0, 1), 1.0),
        _runs_across(slope_of_end, step),
    )


def _runs_across(slope: Tensor, step: Tensor) -> Tensor:
    """Whether (B,) edges whose functions have slopes (B, 2) run across steps (B, 3) rather than along them."""
    heading = step[:, :2].abs()
    along, aside = (slope * heading).sum(dim=1).abs(), (slope * (1 - heading)).sum(dim=1).abs()
    return (along > aside) | ((along == aside) & (heading[:, 0] > 0))


def _concat_faces(*sights: VisibleFace) -> VisibleFace:
    return VisibleFace(torch.cat([sight.face for sight in sights]), torch.cat([sight.share for sight in sights]))


@dataclass(frozen=True, slots=True)
class MeshWalk:
    """From the faces that are seen at the start of ways towards their ends, over faces (P, MAX_WALK_FACES + 1). share, edge
    (P, MAX_WALK_FACES + 1): where each is left, in [0, 1], and by which edge, 3 * face + edge; goes_on (P, WALK + 1):
    whether to the next one. end (P,): where the last is left; plane (P, 3): its inverse depth at pixel (x, y, 1)
    is its product with it. met (P,): whether it is what is seen at the way's end.
    """

    face: Tensor
    share: Tensor
    edge: Tensor
    goes_on: Tensor
    end: Tensor
    plane: Tensor
    met: Tensor

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
        """Of points (V, 3) float64, faces and `MeshEdges.across`: from the first of `seen` towards the second."""
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
        face, shares, edges = (torch.stack(kept, dim=1) for kept in zip(*chain, strict=True))
        goes_on.append(torch.zeros_like(going))
        return cls(face, shares, edges, torch.stack(goes_on, dim=1), share, plane, met)

    def creases(self, creased: Tensor, room: Tensor) -> tuple[Tensor, Tensor, VisibleFace, VisibleFace]:
        """Where looks change on the surface before `room` (P,), a share of the way: which ways (B,), by which
        edges (B,), and what is seen nearer and farther. creased: as in `MeshEdges`.
        """
        way, place = (self.goes_on & (self.share < room[:, None]) & creased[self.edge]).nonzero(as_tuple=True)
        near, far = self._visible_face(way, place, room), self._visible_face(way, place + 1, room)
        return way, self.edge[way, place], near, far

    def last_face(self, way: Tensor, room: Tensor) -> VisibleFace:
        """The last that is seen on ways (B,) before `room` (P,)."""
        passed = (self.goes_on & (self.share < room[:, None])).sum(dim=1)
        return self._visible_face(way, passed[way], room)

    def _visible_face(self, way: Tensor, place: Tensor, room: Tensor) -> VisibleFace:
        """The faces at places (B,) of walks (B,), midway between where they begin and where they are left."""
        begins = torch.where(place > 0, self.share[way, (place - 1).clamp_min(0)], 0.0)
        ends = self.share[way, place].minimum(room[way]).maximum(begins)
        return VisibleFace(self.face[way, place], (begins + ends) / 2)


def _exit_face(
    points: Tensor, faces: Tensor, face: Tensor, start: Tensor, end: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Where (P,) on ways from start to end (P, 3) faces (P,) are left, 1 where they are not; by which edge (P,),
    3 * face + edge; their planes (P, 3), as in `MeshWalk`; and the edge's normal (P, 3), whose product with what lies
    beyond it is positive.
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
    """Where (B,) edges (B,), 3 * face + edge, cross ways from start to end (B, 3), as a share, differentiable, 1/2
    where they do not; and the slopes (B, 2) of their edge functions.
    """
    face, corner = edge // 3, edge % 3
    one, other = (clip.index_select(0, faces[face, (corner + turn) % 3]).to(torch.float64) for turn in (1, 2))
    normal = torch.linalg.cross(one, other)
    at_start, at_end = (normal * start).sum(dim=1), (normal * end).sum(dim=1)
    crossed = (at_start.detach() * at_end.detach() <= 0) & (at_start.detach() != at_end.detach())
    share = torch.where(crossed, at_start / torch.where(crossed, at_start - at_end, 1.0), 0.5)
    return share, normal.detach()[:, :2]


def _face_planes(clip: Tensor, faces: Tensor, face: Tensor) -> Tensor:
    """(B, 3) of faces (B,), as in `MeshWalk`; differentiable."""
    corners = clip.index_select(0, faces[face].reshape(-1)).reshape(-1, 3, 3).to(torch.float64)
    normals = torch.linalg.cross(corners[:, [1, 2, 0]], corners[:, [2, 0, 1]])
    return normals.sum(dim=1) / (corners[:, 0] * normals[:, 0]).sum(-1, keepdim=True)
