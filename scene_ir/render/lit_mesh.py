"""A mesh with materials under a point light and an environment: pixels differentiable to its vertices and lights.

Camera space (x right, y down, z forward). Visibility and outlines come from `scene_ir.raster`, with either
backend; the rest is plain torch.
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
"""Exponent from linear light to display values."""
_DARKEST = 1e-4
"""Least linear light, where gamma still has a slope."""
_CREASE_COS = 0.766
"""Cosine of 40 degrees: faces at one corner are smooth where their normals diverge by less."""
UPWARD_SHARE = 0.4
"""Environment light from above minus its mean, relative; from below, the reverse."""
MIRRORED_SHARE = 0.2
"""Share of the environment's light that a glossy surface mirrors; the lamp's counts in full."""
SAMPLES_PER_SIDE = 2
"""Samples along each side of a pixel."""
_TINY = 1e-12


@dataclass(frozen=True, slots=True)
class Materials:
    """One material per face."""

    diffuse: Tensor
    """(F, 3) linear RGB in [0, 1]."""
    specular: Tensor
    """(F,) in [0, 1]."""
    shininess: Tensor
    """(F,) Phong exponent."""


@dataclass(frozen=True, slots=True)
class Lights:
    """A white point light and an environment."""

    point: Tensor
    """(3,) m, position of the point light."""
    strength: Tensor
    """() Light on a surface that faces it at distance `reach`; falls with the squared distance."""
    environment: Tensor
    """() Light from all around."""
    reach: float = 2.0
    """Reference distance, m."""


@dataclass(frozen=True)
class LitMesh:
    """A mesh to render repeatedly. Raises ShapeError, and RangeError for values that are not finite."""

    vertices: Tensor
    """(V, 3) at rest; determines which corners are smooth."""
    faces: Tensor
    """(F, 3) int64."""
    materials: Materials
    """Material of each face."""
    edges: MeshEdges = field(init=False)
    """Adjacency of the faces."""
    _corner: Tensor = field(init=False)
    """(Q,) int64, corner 3 * face + place of each pair of corner and averaged face."""
    _face: Tensor = field(init=False)
    """(Q,) int64, face of each pair."""

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
        samples_per_side: int = SAMPLES_PER_SIDE,
    ) -> Tensor:
        """Render the mesh: (4, H, W), RGB after gamma and coverage, averaged over the samples of a pixel.

        RGB is that of the covering surface, 0 elsewhere. Differentiable to vertices and lights, also at outlines
        and at borders between faces.

        Args:
            vertices: (V, 3) in camera space.
            camera: The camera.
            lights: The lights.
            backend: Implementation.
            samples_per_side: Samples along each side of a pixel.
        """
        part, x, y = self.render_part(vertices, camera, lights, backend, samples_per_side)
        height, width = part.shape[1:]
        return torch.nn.functional.pad(part, (x, camera.width - x - width, y, camera.height - y - height))

    def render_part(
        self,
        vertices: Tensor,
        camera: Camera,
        lights: Lights,
        backend: verbs.Backend = "warp",
        samples_per_side: int = SAMPLES_PER_SIDE,
    ) -> tuple[Tensor, int, int]:
        """The part (4, h, w) of `render` that holds the mesh, and its first column and row.

        Args:
            vertices, camera, lights, backend, samples_per_side: As for `render`.
        """
        clip = to_clip(vertices, _scale_camera(camera.matrix.to(vertices), samples_per_side))
        height, width = samples_per_side * camera.height, samples_per_side * camera.width
        rects = verbs.bounding_rects(clip, torch.tensor([[0, len(vertices)]]), height, width)
        rects = torch.cat([rects[:, :2] // samples_per_side, -(-rects[:, 2:] // samples_per_side)], dim=1)
        x0, y0, x1, y1 = rects[0].tolist()
        if x1 <= x0 or y1 <= y0:
            return vertices.new_zeros(4, 0, 0), 0, 0
        fragments = verbs.rasterize(
            clip,
            self.faces,
            torch.tensor([[0, len(self.faces)]]),
            PixelLayout.from_rects(samples_per_side * rects),
            backend,
        )
        coverage = verbs.antialias(fragments, clip, self.faces, backend)
        samples = PixelSamples.from_fragments(fragments, samples_per_side)
        blend = _ShadedSamples.from_samples(self, samples, clip, coverage, backend)
        colour = self._colours(blend.face, blend.at, clip, vertices, lights, backend)
        group_amounts = samples.pixel, colour[: len(samples.face)] * samples.share[:, None].to(colour)
        amounts = [group_amounts, *blend.strip_changes(samples, colour)]
        total = colour.new_zeros((y1 - y0) * (x1 - x0), 3)
        # At once: a sum out of place copies the whole picture.
        total.index_add_(0, *(torch.cat(parts) for parts in zip(*amounts, strict=True)))
        cover = coverage.reshape(y1 - y0, samples_per_side, x1 - x0, samples_per_side)
        cover = reduce(torch.add, reduce(torch.add, cover.unbind(1)).unbind(2)) / samples_per_side**2
        rgb = _Transpose.apply(total).reshape(3, y1 - y0, x1 - x0) / torch.where(cover > 0, cover, 1.0)
        return torch.cat([rgb, cover[None]]), x0, y0

    def _colours(
        self, face: Tensor, at: Tensor, clip: Tensor, vertices: Tensor, lights: Lights, backend: verbs.Backend
    ) -> Tensor:
        """Colours (S, 3) after gamma of faces (S,) at (S, 2) px."""
        corners, normals, _ = self.corners(vertices)
        attributes = torch.cat([corners.reshape(-1, 3), normals], dim=1)
        flat = torch.arange(3 * len(self.faces)).reshape(-1, 3)
        corner_clip = clip.index_select(0, self.faces.reshape(-1)) * clip.new_tensor([GRID_SCALE, GRID_SCALE, 1.0])
        layout = PixelLayout.from_pixels((GRID_SCALE * at.to(torch.float64)).round())
        fragments = Fragments(layout, face.to(torch.int32), at[:, 0], torch.tensor([[0, len(self.faces)]]), 0.0)
        point, normal = verbs.interpolate(fragments, corner_clip, flat, attributes, backend).split(3, dim=1)
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
        """Corners (F, 3, 3) of the faces, their unit normals (3F, 3) towards the visible side, and which faces
        (F,) look away by their winding. vertices: (V, 3) in camera space.
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
    """Linear RGB (P, 3) by Lambert's and Phong's terms of the lamp and the environment's light.

    Source: Phong 1975, "Illumination for computer generated pictures".

    Args:
        point, normal: (P, 3) in camera space.
        diffuse: (P, 3).
        specular, shininess: (P,).
        lights: The lights.
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
    """Vectors (P, 3) as (3, P), or back. Sums over the three, and products with a number each, are several times
    faster where each coordinate is contiguous; so are their gradients.
    """

    @staticmethod
    def forward(ctx: Any, vectors: Tensor) -> Tensor:
        return vectors.T.contiguous()

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> Tensor:
        return grad_outputs[0].T.contiguous()


def composite_over(drawn: Tensor, background: Tensor) -> Tensor:
    """A result of `LitMesh.render` (4, H, W) over a background (3, H, W); differentiable to both."""
    return _CompositeOver.apply(drawn, background)


class _CompositeOver(torch.autograd.Function):
    """`composite_over`; torch's own gradient sums whole pictures, which takes longer than the rest."""

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
    """Pairs (Q,), (Q,) int64: a corner (3 * face + place) and a face over which its normal is averaged."""
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
    corner_face = corner // 3
    alike = ((normal[corner_face] * normal[other]).sum(dim=1) >= _CREASE_COS) | (corner_face == other)
    return corner[alike], other[alike]


def _length(vectors: Tensor) -> Tensor:
    """Lengths (P,) of vectors (3, P), at least _TINY. `vector_norm` along the first axis takes eight times as
    long.
    """
    return ((vectors * vectors).sum(dim=0) + _TINY**2).sqrt()


def _unit(vectors: Tensor) -> Tensor:
    return torch.nn.functional.normalize(vectors, dim=-1, eps=_TINY)


def _scale_camera(matrix: Tensor, samples_per_side: int) -> Tensor:
    """A camera's matrix (3, 4) for pictures of samples instead of pixels."""
    finer = samples_per_side * matrix[:2] + (samples_per_side - 1) / 2 * matrix[2]
    return torch.cat([finer, matrix[2:]])


def _edge_on_faces(clip: Tensor, faces: Tensor) -> Tensor:
    """Faces (F,) too thin in the picture to interpolate on: they have no point on the grid of groups."""
    corners = (clip[:, :2] / clip[:, 2:]).index_select(0, faces.reshape(-1)).reshape(-1, 3, 2)
    sides = corners - corners.roll(1, dims=1)
    double = (sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]).abs()
    return double * GRID_SCALE < 4 * torch.linalg.vector_norm(sides, dim=2).amax(dim=1)


@dataclass(frozen=True, slots=True)
class _SampleStrip:
    """Parts of samples (P,) with another colour: amount (P,) of a sample, differentiable, added of the first
    groups (P,) and removed of the second ones, if any.
    """

    sample: Tensor
    amount: Tensor
    groups: tuple[Tensor, ...]


@dataclass(frozen=True, slots=True)
class _ShadedSamples:
    """What to shade, face (S,) and position (S, 2), the samples' groups first, and the strips that complete the
    pixels.
    """

    face: Tensor
    at: Tensor
    strips: list[_SampleStrip]

    @classmethod
    def from_samples(
        cls, mesh: LitMesh, samples: PixelSamples, clip: Tensor, coverage: Tensor, backend: verbs.Backend
    ) -> _ShadedSamples:
        """Find the borders and outlines between samples. coverage: (T,) of the samples."""
        inner, outer = samples.offsets_at_borders(mesh.edges)
        edge_on = _edge_on_faces(clip.detach(), mesh.faces)
        faces, places = [samples.face], [samples.at]

        def numbers(visible: VisibleFace, offsets: SampleOffsets, path: Tensor) -> Tensor:
            """Of what is seen on ways (B,): of the look that sees it, or where none does of a place of its own."""
            here, there = offsets.here.index_select(0, path), offsets.there.index_select(0, path)
            is_there = (visible.face == samples.face_at(there)) | (edge_on[visible.face] & (visible.share > 0.5))
            is_there &= samples.face_at(there) >= 0
            is_here = ~is_there & ((visible.face == samples.face_at(here)) | edge_on[visible.face])
            new = (~is_here & ~is_there).nonzero()[:, 0]
            number = samples.group.index_select(0, torch.where(is_there, there, here))
            number = number.index_put((new,), sum(map(len, faces)) + torch.arange(len(new)))
            faces.append(visible.face[new])
            places.append(offsets.start[path[new], :2] + visible.share[new, None] * offsets.step[path[new], :2])
            return number

        ends = samples.face_at(inner.here), samples.face_at(inner.there)
        between = find_borders(clip, mesh.faces, mesh.edges, ends, inner.start, inner.step, backend)
        alone = samples.face_at(outer.here)
        rim = find_rims(clip, mesh.faces, mesh.edges, alone, outer.start, outer.step, backend)
        # Samples cut by an outline along one axis: borders along the other axis count only for their covered part.
        cut = [torch.zeros_like(coverage, dtype=torch.bool) for _ in range(2)]
        for axis, along in enumerate((~outer.down, outer.down)):
            cut[axis][outer.here[rim.across & along]] = True
        path, share = between.path, torch.where(between.across, between.share, 0.5)
        before, after = (numbers(visible, inner, path) for visible in (between.before, between.after))
        part = ((samples.fragments.face >= 0) & (coverage.detach() < 1)).nonzero()[:, 0]
        # Samples that hit nothing continue the colour of the neighbour across the outline, if possible.
        order = torch.arange(len(outer.there)) + len(outer.there) * ~rim.across
        ends, which = torch.unique(outer.there, return_inverse=True)
        first = order.new_full((len(ends),), 2 * len(order)).scatter_reduce(0, which, order, "amin")
        source = (first[which] == order) & (coverage.detach()[outer.there] > 0)
        here, there, beyond = inner.here[path], inner.there[path], outer.there[source]
        here_covers, there_covers, part_covers, beyond_covers = _gather_all(coverage, (here, there, part, beyond))
        strips = []
        # A border along the path is shared by the samples on both sides.
        for sample, covers, amount, more, less in (
            (here, here_covers, 0.5 - share, after, before),
            (there, there_covers, share - 0.5, before, after),
        ):
            aside = torch.where(inner.down[path], cut[0][sample], cut[1][sample])
            strips.append(
                _SampleStrip(sample, amount.clamp_min(0) * torch.where(aside, covers, 1.0), (more, less))
            )
        strips.append(_SampleStrip(part, part_covers - 1, (samples.group[part],)))
        strips.append(_SampleStrip(beyond, beyond_covers, (samples.group[outer.here[source]],)))
        path, share, end = rim.inner.path, rim.inner.share, rim.end
        before, after = (numbers(visible, outer, path) for visible in (rim.inner.before, rim.inner.after))
        for sample, amount, counts in (
            (outer.here[path], end.clamp_max(0.5) - share, rim.inner.across),
            (outer.there[path], end - share.clamp_min(0.5), rim.inner.across & source[path]),
        ):
            strips.append(_SampleStrip(sample, torch.where(counts, amount.clamp_min(0), 0.0), (after, before)))
        return cls(torch.cat(faces), torch.cat(places), strips)

    def strip_changes(self, samples: PixelSamples, colour: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Pixels (P,) and their changes (P, 3), strip by strip; colour: (S, 3) of the groups."""
        gathered = iter(_gather_all(colour, [group for strip in self.strips for group in strip.groups]))
        for strip in self.strips:
            change = reduce(torch.sub, islice(gathered, len(strip.groups)))
            yield samples.pixel_at(strip.sample), (strip.amount.to(colour) / samples.count**2)[:, None] * change


def _gather_all(values: Tensor, places: Sequence[Tensor]) -> Sequence[Tensor]:
    """Values (N, ...) at several sets of places (P,), at once: each gradient fills an array (N, ...)."""
    return values.index_select(0, torch.cat(list(places))).split([len(one) for one in places])
