"""A mesh with materials under a point light and an environment, without a photograph: pixels that are
differentiable to its vertices, and through them to its pose, and to the lights.

Everything is in camera space (x right, y down, z forward). Visibility and outlines are those of `scene_ir.raster`,
by either of its backends; what is done here with its pixels is plain torch for both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import reduce
from itertools import islice
from typing import Any

import torch
from torch import Tensor

from scene_ir.geometry import clamp_inclusive, to_clip, weld_vertices
from scene_ir.raster import verbs
from scene_ir.raster.layout import Fragments, PixelLayout
from scene_ir.render.borders import MeshEdges, VisibleFace, find_borders, find_rims
from scene_ir.render.pixel_samples import GRID_SCALE, PixelSamples, SampleOffsets
from scene_ir.types import Camera, check_finite, check_shape

GAMMA = 1 / 2.2
"""Exponent from linear light to picture values."""
_DARKEST = 1e-4
"""Of linear light: gamma has a slope there."""
_CREASE_COS = 0.766
"""Cosine of 40 degrees: faces of one corner that meet at less are shaded as one smooth surface."""
UPWARD_SHARE = 0.4
"""How much more of the environment's light comes from above than from below, either way from the mean."""
MIRRORED_SHARE = 0.2
"""Share of the environment's light that a glossy surface mirrors, where the lamp's counts in full."""
SAMPLES_PER_SIDE = 2
"""A pixel is looked at so many times along each side."""
_TINY = 1e-12


@dataclass(frozen=True, slots=True)
class Materials:
    """One material a face: diffuse (F, 3) linear RGB and specular (F,), in [0, 1]; shininess (F,), Phong's."""

    diffuse: Tensor
    specular: Tensor
    shininess: Tensor


@dataclass(frozen=True, slots=True)
class Lights:
    """point: (3,), where a white lamp is; strength: (), what it gives a surface that faces it at distance `reach`,
    falling with the square of the distance; environment: (), what comes from all around.
    """

    point: Tensor
    strength: Tensor
    environment: Tensor
    reach: float = 2.0


@dataclass(frozen=True)
class LitMesh:
    """A mesh to be drawn again and again: faces (F, 3) int64, and which faces each corner's normal is averaged
    over, told from `vertices` (V, 3) as they are at rest. Raises ShapeError, and RangeError for what is not
    finite.
    """

    vertices: Tensor
    faces: Tensor
    materials: Materials
    edges: MeshEdges = field(init=False)
    _corner: Tensor = field(init=False)
    _face: Tensor = field(init=False)

    def __post_init__(self) -> None:
        check_shape("lit.vertices", self.vertices, None, 3)
        check_finite("lit.vertices", self.vertices)
        check_shape("lit.faces", self.faces, None, 3, floating=False)
        check_shape("lit.diffuse", self.materials.diffuse, len(self.faces), 3)
        materials = self.materials
        kinds = torch.cat([materials.diffuse, materials.specular[:, None], materials.shininess[:, None]], dim=1)
        edges = MeshEdges.from_mesh(self.vertices.detach(), self.faces, kinds, _CREASE_COS)
        object.__setattr__(self, "edges", edges)
        corner, face = _smoothing_pairs(self.vertices.detach(), self.faces)
        object.__setattr__(self, "_corner", corner)
        object.__setattr__(self, "_face", face)

    def render(
        self,
        vertices: Tensor,
        camera: Camera,
        lights: Lights,
        backend: verbs.Backend = "warp",
        looks: int = SAMPLES_PER_SIDE,
    ) -> Tensor:
        """The mesh with its vertices (V, 3) moved into camera space: (4, H, W), RGB after gamma and coverage, both
        of looks x looks a pixel. RGB is that of what covers; elsewhere it is 0.

        Differentiable to vertices and lights, at outlines and at borders between faces too.
        """
        part, x, y = self.render_part(vertices, camera, lights, backend, looks)
        height, width = part.shape[1:]
        return torch.nn.functional.pad(part, (x, camera.width - x - width, y, camera.height - y - height))

    def render_part(
        self,
        vertices: Tensor,
        camera: Camera,
        lights: Lights,
        backend: verbs.Backend = "warp",
        looks: int = SAMPLES_PER_SIDE,
    ) -> tuple[Tensor, int, int]:
        """The part (4, h, w) of `render` that the mesh is in, and the column and row at which that begins."""
        clip = to_clip(vertices, _scale_camera(camera.matrix.to(vertices), looks))
        height, width = looks * camera.height, looks * camera.width
        rects = verbs.bounding_rects(clip, torch.tensor([[0, len(vertices)]]), height, width)
        rects = torch.cat([rects[:, :2] // looks, -(-rects[:, 2:] // looks)], dim=1)
        x0, y0, x1, y1 = rects[0].tolist()
        if x1 <= x0 or y1 <= y0:
            return vertices.new_zeros(4, 0, 0), 0, 0
        fragments = verbs.rasterize(
            clip, self.faces, torch.tensor([[0, len(self.faces)]]), PixelLayout.from_rects(looks * rects), backend
        )
        coverage = verbs.antialias(fragments, clip, self.faces, backend)
        seen = PixelSamples.from_fragments(fragments, looks)
        blend = _ShadedSamples.from_samples(self, seen, clip, coverage, backend)
        colour = self._colours(blend.face, blend.at, clip, vertices, lights, backend)
        own = seen.pixel, colour[: len(seen.face)] * seen.share[:, None].to(colour)
        amounts = [own, *blend.strip_changes(seen, colour)]
        total = colour.new_zeros((y1 - y0) * (x1 - x0), 3)
        # All in one go: a sum out of place copies the whole picture.
        total.index_add_(0, *(torch.cat(parts) for parts in zip(*amounts, strict=True)))
        cover = coverage.reshape(y1 - y0, looks, x1 - x0, looks)
        cover = reduce(torch.add, reduce(torch.add, cover.unbind(1)).unbind(2)) / looks**2
        rgb = _Transpose.apply(total).reshape(3, y1 - y0, x1 - x0) / torch.where(cover > 0, cover, 1.0)
        return torch.cat([rgb, cover[None]]), x0, y0

    def _colours(
        self, face: Tensor, at: Tensor, clip: Tensor, vertices: Tensor, lights: Lights, backend: verbs.Backend
    ) -> Tensor:
        """(S, 3) after gamma of faces (S,) at (S, 2) px."""
        corners, normals, _ = self.corners(vertices)
        attributes = torch.cat([corners.reshape(-1, 3), normals], dim=1)
        flat = torch.arange(3 * len(self.faces)).reshape(-1, 3)
        own = clip.index_select(0, self.faces.reshape(-1)) * clip.new_tensor([GRID_SCALE, GRID_SCALE, 1.0])
        layout = PixelLayout.from_pixels((GRID_SCALE * at.to(torch.float64)).round())
        fragments = Fragments(layout, face.to(torch.int32), at[:, 0], torch.tensor([[0, len(self.faces)]]), 0.0)
        point, normal = verbs.interpolate(fragments, own, flat, attributes, backend).split(3, dim=1)
        materials = self.materials
        light = shade_phong(
            point,
            normal,
            materials.diffuse.to(clip).index_select(0, face),
            materials.specular.to(clip).index_select(0, face),
            materials.shininess.to(clip).index_select(0, face),
            lights,
        )
        return (GAMMA * clamp_inclusive(light, _DARKEST, 1).log()).exp()  # `**` takes almost twice as long

    def corners(self, vertices: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Of vertices (V, 3) in camera space each face's corners (F, 3, 3); their unit normals (3F, 3), towards
        the side that is seen; and which faces (F,) look away, by their winding.
        """
        corners = vertices.index_select(0, self.faces.reshape(-1)).reshape(-1, 3, 3)
        across = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        summed = torch.zeros_like(corners).reshape(-1, 3)
        summed.index_add_(0, self._corner, across.index_select(0, self._face))
        away = (across.detach() * corners.detach().mean(dim=1)).sum(dim=1) > 0
        sign = torch.where(away, -1.0, 1.0).to(corners).repeat_interleave(3)
        return corners, _unit(summed) * sign[:, None], away


def shade_phong(
    point: Tensor, normal: Tensor, diffuse: Tensor, specular: Tensor, shininess: Tensor, lights: Lights
) -> Tensor:
    """Linear RGB (P, 3) of points (P, 3) in camera space with normals (P, 3): Lambert's and Phong's terms of the
    lamp, and the environment's light, of which more comes from above.

    diffuse (P, 3), specular (P,), shininess (P,). Source: Phong 1975, "Illumination for computer generated
    pictures".
    """
    point, normal, diffuse = (vectors.T.contiguous() for vectors in (point, normal, diffuse))
    normal = normal / _length(normal)
    to_lamp = lights.point[:, None] - point
    distance = _length(to_lamp)
    to_lamp = to_lamp / distance
    arrives = lights.strength * (lights.reach / distance) ** 2
    cosine = (normal * to_lamp).sum(dim=0)
    facing = cosine.clamp_min(0)
    mirrored = 2 * cosine * normal - to_lamp
    glance = (mirrored * (point / -_length(point))).sum(dim=0).clamp_min(_TINY)
    around = lights.environment * (1 - UPWARD_SHARE * normal[1])  # y points down
    lobe = torch.where(facing > 0, glance**shininess, 0)
    gloss = specular * (arrives * lobe + MIRRORED_SHARE * around)
    return _Transpose.apply(diffuse * (around + arrives * facing) + gloss)


class _Transpose(torch.autograd.Function):
    """Vectors (P, 3) as (3, P), or back. Sums over the three, and products with a number each, take a fraction of
    the time where each coordinate lies in one piece; so do their gradients, which this keeps in that order.
    """

    @staticmethod
    def forward(ctx: Any, vectors: Tensor) -> Tensor:
        return vectors.T.contiguous()

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> Tensor:
        return grad_outputs[0].T.contiguous()


def composite_over(drawn: Tensor, background: Tensor) -> Tensor:
    """What `LitMesh.render` drew (4, H, W) before a background (3, H, W); differentiable to both."""
    return _CompositeOver.apply(drawn, background)


class _CompositeOver(torch.autograd.Function):
    """`composite_over`. torch's own gradient of it sums whole pictures up, which takes longer than any other part of one."""

    @staticmethod
    def forward(ctx: Any, drawn: Tensor, background: Tensor) -> Tensor:
        ctx.save_for_backward(drawn, background)
        return background + drawn[3] * (drawn[:3] - background)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, Tensor | None]:
        (gradient,), (drawn, background) = grad_outputs, ctx.saved_tensors
        to_drawn = torch.empty_like(drawn)
        torch.mul(gradient, drawn[3], out=to_drawn[:3])
        to_cover = torch.mul(gradient[0], drawn[0] - background[0], out=to_drawn[3])
        for channel in (1, 2):
            to_cover.addcmul_(gradient[channel], drawn[channel] - background[channel])
        return to_drawn, gradient * (1 - drawn[3]) if ctx.needs_input_grad[1] else None


def _smoothing_pairs(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Pairs (Q,), (Q,) int64: a corner (3 * face + place) and a face that its normal is averaged over."""
    welded = weld_vertices(vertices)[faces].reshape(-1)  # (3F,)
    order = torch.argsort(welded, stable=True)
    counts = torch.bincount(welded)
    begins = counts.cumsum(0) - counts
    partners = counts[welded]
    corner = torch.repeat_interleave(torch.arange(len(welded)), partners)
    within = torch.arange(len(corner)) - (partners.cumsum(0) - partners).repeat_interleave(partners)
    other = order[begins[welded[corner]] + within] // 3
    sides = vertices[faces]
    normal = _unit(torch.linalg.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]))
    own = corner // 3
    alike = ((normal[own] * normal[other]).sum(dim=1) >= _CREASE_COS) | (own == other)
    return corner[alike], other[alike]


def _length(vectors: Tensor) -> Tensor:
    """(P,) of vectors (3, P), no less than _TINY. `vector_norm` along the first axis takes eight times as long."""
    return ((vectors * vectors).sum(dim=0) + _TINY**2).sqrt()


def _unit(vectors: Tensor) -> Tensor:
    return torch.nn.functional.normalize(vectors, dim=-1, eps=_TINY)


def _scale_camera(matrix: Tensor, looks: int) -> Tensor:
    """A camera's matrix (3, 4), of pictures of `looks` x `looks` pixels where it has one."""
    finer = looks * matrix[:2] + (looks - 1) / 2 * matrix[2]
    return torch.cat([finer, matrix[2:]])


def _edge_on_faces(clip: Tensor, faces: Tensor) -> Tensor:
    """Which faces (F,) are too thin in the picture to interpolate on: they have no place on the grid of sights."""
    corners = (clip[:, :2] / clip[:, 2:]).index_select(0, faces.reshape(-1)).reshape(-1, 3, 2)
    sides = corners - corners.roll(1, dims=1)
    double = (sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]).abs()
    return double * GRID_SCALE < 4 * torch.linalg.vector_norm(sides, dim=2).amax(dim=1)


@dataclass(frozen=True, slots=True)
class _SampleStrip:
    """Parts of looks (P,) that are of another colour than a look: amount (P,), of a look, differentiable, of the
    first sights (P,), and less of the second ones, where there are any.
    """

    look: Tensor
    amount: Tensor
    sights: tuple[Tensor, ...]


@dataclass(frozen=True, slots=True)
class _ShadedSamples:
    """What is to be shaded, face (S,) and place (S, 2), looks' sights first, and how it makes pixels."""

    face: Tensor
    at: Tensor
    strips: list[_SampleStrip]

    @classmethod
    def from_samples(
        cls, mesh: LitMesh, seen: PixelSamples, clip: Tensor, coverage: Tensor, backend: verbs.Backend
    ) -> _ShadedSamples:
        """coverage (T,): of looks."""
        inner, outer = seen.offsets_at_borders(mesh.edges)
        edge_on = _edge_on_faces(clip.detach(), mesh.faces)
        faces, places = [seen.face], [seen.at]

        def numbers(sight: VisibleFace, ways: SampleOffsets, way: Tensor) -> Tensor:
            """Of what is seen on ways (B,): of the look that sees it, or where none does of a place of its own."""
            here, there = ways.here.index_select(0, way), ways.there.index_select(0, way)
            is_there = (sight.face == seen.face_at(there)) | (edge_on[sight.face] & (sight.share > 0.5))
            is_there &= seen.face_at(there) >= 0
            is_here = ~is_there & ((sight.face == seen.face_at(here)) | edge_on[sight.face])
            new = (~is_here & ~is_there).nonzero()[:, 0]
            number = seen.sight.index_select(0, torch.where(is_there, there, here))
            number = number.index_put((new,), sum(map(len, faces)) + torch.arange(len(new)))
            faces.append(sight.face[new])
            places.append(ways.start[way[new], :2] + sight.share[new, None] * ways.step[way[new], :2])
            return number

        ends = seen.face_at(inner.here), seen.face_at(inner.there)
        between = find_borders(clip, mesh.faces, mesh.edges, ends, inner.start, inner.step, backend)
        alone = seen.face_at(outer.here)
        rim = find_rims(clip, mesh.faces, mesh.edges, alone, outer.start, outer.step, backend)
        # PixelSamples that an outline cuts beside or below: of them less is seen of the borders along the other axis.
        cut = [torch.zeros_like(coverage, dtype=torch.bool) for _ in range(2)]
        for axis, along in enumerate((~outer.down, outer.down)):
            cut[axis][outer.here[rim.across & along]] = True
        way, share = between.way, torch.where(between.across, between.share, 0.5)
        before, after = (numbers(sight, inner, way) for sight in (between.before, between.after))
        part = ((seen.fragments.face >= 0) & (coverage.detach() < 1)).nonzero()[:, 0]
        # What meets nothing goes on with the colour from which its outline is reached, rather across it.
        order = torch.arange(len(outer.there)) + len(outer.there) * ~rim.across
        ends, which = torch.unique(outer.there, return_inverse=True)
        first = order.new_full((len(ends),), 2 * len(order)).scatter_reduce(0, which, order, "amin")
        source = (first[which] == order) & (coverage.detach()[outer.there] > 0)
        here, there, beyond = inner.here[way], inner.there[way], outer.there[source]
        here_covers, there_covers, part_covers, beyond_covers = _gather_all(coverage, (here, there, part, beyond))
        strips = []
        # Of a border along the way, the looks to its sides are the ones that share it.
        for look, covers, amount, more, less in (
            (here, here_covers, 0.5 - share, after, before),
            (there, there_covers, share - 0.5, before, after),
        ):
            aside = torch.where(inner.down[way], cut[0][look], cut[1][look])
            strips.append(_SampleStrip(look, amount.clamp_min(0) * torch.where(aside, covers, 1.0), (more, less)))
        strips.append(_SampleStrip(part, part_covers - 1, (seen.sight[part],)))
        strips.append(_SampleStrip(beyond, beyond_covers, (seen.sight[outer.here[source]],)))
        way, share, end = rim.inner.way, rim.inner.share, rim.end
        before, after = (numbers(sight, outer, way) for sight in (rim.inner.before, rim.inner.after))
        for look, amount, shown in (
            (outer.here[way], end.clamp_max(0.5) - share, rim.inner.across),
            (outer.there[way], end - share.clamp_min(0.5), rim.inner.across & source[way]),
        ):
            strips.append(_SampleStrip(look, torch.where(shown, amount.clamp_min(0), 0.0), (after, before)))
        return cls(torch.cat(faces), torch.cat(places), strips)

    def strip_changes(self, seen: PixelSamples, colour: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Pixels (P,), and what each gets more of (P, 3), by strip; colour (S, 3): of sights."""
        picked = iter(_gather_all(colour, [sight for strip in self.strips for sight in strip.sights]))
        for strip in self.strips:
            change = reduce(torch.sub, islice(picked, len(strip.sights)))
            yield seen.pixel_of(strip.look), (strip.amount.to(colour) / seen.count**2)[:, None] * change


def _gather_all(values: Tensor, places: Sequence[Tensor]) -> Sequence[Tensor]:
    """Of values (N, ...) those at places (P,), for each. In one go: each gradient fills an array (N, ...)."""
    return values.index_select(0, torch.cat(list(places))).split([len(one) for one in places])
