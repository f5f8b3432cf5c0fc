"""A mesh with materials under a point light and an environment, without a photograph: pixels that are
differentiable to its vertices, and through them to its pose, and to the lights.

Everything is in camera space (x right, y down, z forward). Visibility and outlines are those of `scene_ir.raster`,
by either of its backends; what is done here with its pixels is plain torch for both.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from scene_ir.geometry import kept_within, to_clip, weld
from scene_ir.raster import verbs
from scene_ir.raster.layout import Fragments, Layout
from scene_ir.types import Camera, check_finite, check_shape

GAMMA = 1 / 2.2
"""Exponent from linear light to picture values."""
_DARKEST = 1e-4
"""Of linear light: gamma has a slope there."""
_CREASE_COS = 0.766
"""Cosine of 40 degrees: faces of one corner that meet at less are shaded as one smooth surface."""
UP = 0.4
"""How much more of the environment's light comes from above than from below, either way from the mean."""
AROUND = 0.2
"""Share of the environment's light that a glossy surface mirrors, where the lamp's counts in full."""
_SHOWS = 2 / 255
"""Contrast from which a border between two faces is blended."""
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
    _corner: Tensor = field(init=False)
    _face: Tensor = field(init=False)

    def __post_init__(self) -> None:
        check_shape("lit.vertices", self.vertices, None, 3)
        check_finite("lit.vertices", self.vertices)
        check_shape("lit.faces", self.faces, None, 3, floating=False)
        check_shape("lit.diffuse", self.materials.diffuse, len(self.faces), 3)
        corner, face = _smoothed(self.vertices.detach(), self.faces)
        object.__setattr__(self, "_corner", corner)
        object.__setattr__(self, "_face", face)

    def render(self, vertices: Tensor, camera: Camera, lights: Lights, backend: verbs.Backend = "warp") -> Tensor:
        """The mesh with its vertices (V, 3) moved into camera space: (4, H, W), RGB after gamma, in [0, 1], and
        coverage. Colours go on beyond the outline where coverage does; elsewhere they are 0.

        Differentiable to vertices and lights, at outlines and at borders between faces too.
        """
        clip = to_clip(vertices, camera.matrix.to(vertices))
        everything = torch.tensor([[0, len(vertices)]])
        rects = verbs.bounding_rects(clip, everything, camera.height, camera.width)
        layout, faces = Layout.of(rects), torch.tensor([[0, len(self.faces)]])
        picture = vertices.new_zeros(4, camera.height, camera.width)
        if layout.size == 0:
            return picture
        fragments = verbs.rasterize(clip, self.faces, faces, layout, backend)
        coverage = verbs.antialias(fragments, clip, self.faces, backend)
        colour = self._colours(fragments, clip, vertices, lights, backend)
        x0, y0, x1, y1 = rects[0].tolist()
        width = x1 - x0
        colour = _blended(colour, fragments, clip, self.faces, width)
        colour = _continued(colour, fragments.face, coverage, width)
        drawn = torch.cat([colour, coverage[:, None]], dim=1).T.reshape(4, y1 - y0, width)
        return torch.nn.functional.pad(drawn, (x0, camera.width - x1, y0, camera.height - y1))

    def _colours(
        self, fragments: Fragments, clip: Tensor, vertices: Tensor, lights: Lights, backend: verbs.Backend
    ) -> Tensor:
        """(T, 3) after gamma; 0 where nothing is hit."""
        corners, normal, _ = self.corners(vertices)
        attributes = torch.cat([corners.reshape(-1, 3), normal], dim=1)
        flat = torch.arange(3 * len(self.faces)).reshape(-1, 3)
        own = clip.index_select(0, self.faces.reshape(-1))
        seen = verbs.interpolate(fragments, own, flat, attributes, backend)
        hit = (fragments.face >= 0).nonzero()[:, 0]
        face = fragments.face[hit].to(torch.int64)
        materials = self.materials
        light = shade(
            seen[hit, :3],
            seen[hit, 3:],
            materials.diffuse.to(clip)[face],
            materials.specular.to(clip)[face],
            materials.shininess.to(clip)[face],
            lights,
        )
        return torch.zeros_like(seen[:, :3]).index_add(0, hit, kept_within(light, _DARKEST, 1) ** GAMMA)

    def corners(self, vertices: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Of vertices (V, 3) in camera space each face's corners (F, 3, 3); their unit normals (3F, 3), towards
        the side that is seen; and which faces (F,) look away, by their winding.
        """
        corners = vertices[self.faces]
        across = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        summed = torch.zeros_like(corners).reshape(-1, 3)
        summed = summed.index_add(0, self._corner, across.index_select(0, self._face))
        away = (across.detach() * corners.detach().mean(dim=1)).sum(dim=1) > 0
        sign = torch.where(away, -1.0, 1.0).to(corners).repeat_interleave(3)
        return corners, _unit(summed) * sign[:, None], away


def shade(
    point: Tensor, normal: Tensor, diffuse: Tensor, specular: Tensor, shininess: Tensor, lights: Lights
) -> Tensor:
    """Linear RGB (P, 3) of points (P, 3) in camera space with normals (P, 3): Lambert's and Phong's terms of the
    lamp, and the environment's light, of which more comes from above.

    diffuse (P, 3), specular (P,), shininess (P,). Source: Phong 1975, "Illumination for computer generated
    pictures".
    """
    normal = _unit(normal)
    to_lamp = lights.point - point
    distance = torch.linalg.vector_norm(to_lamp, dim=1).clamp_min(_TINY)
    to_lamp = to_lamp / distance[:, None]
    arrives = lights.strength * (lights.reach / distance) ** 2
    facing = (normal * to_lamp).sum(dim=1).clamp_min(0)
    mirrored = 2 * (normal * to_lamp).sum(dim=1, keepdim=True) * normal - to_lamp
    glance = (mirrored * -_unit(point)).sum(dim=1).clamp_min(_TINY)
    around = lights.environment * (1 - UP * normal[:, 1])  # y points down
    lobe = torch.where(facing > 0, glance**shininess, 0)
    gloss = specular * (arrives * lobe + AROUND * around)
    return diffuse * (around + arrives * facing)[:, None] + gloss[:, None]


def over(drawn: Tensor, background: Tensor) -> Tensor:
    """What `LitMesh.render` drew (4, H, W) before a background (3, H, W)."""
    return background + drawn[3] * (drawn[:3] - background)


def _smoothed(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Pairs (Q,), (Q,) int64: a corner (3 * face + place) and a face that its normal is averaged over."""
    welded = weld(vertices)[faces].reshape(-1)  # (3F,)
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


def _unit(vectors: Tensor) -> Tensor:
    return torch.nn.functional.normalize(vectors, dim=-1, eps=_TINY)


def _blended(colour: Tensor, fragments: Fragments, clip: Tensor, faces: Tensor, width: int) -> Tensor:
    """Colours (T, 3) of one draw with the borders between faces blended: between two pixels that are hit by
    different faces the border crosses the segment of their centres; whoever's half it cuts takes of the other's
    colour what lies beyond. So a border that sweeps over pixels changes them continuously, as outlines do.
    """
    face = fragments.face
    place = torch.arange(len(face))
    first, second, steps = [], [], []
    for step, (dx, dy) in ((1, (1.0, 0.0)), (width, (0.0, 1.0))):
        here = place[: len(face) - step]
        there = here + step
        pairs = (face[here] >= 0) & (face[there] >= 0) & (face[here] != face[there])
        if step == 1:
            pairs &= here % width != width - 1
        here, there = here[pairs], there[pairs]
        shows = (colour[here] - colour[there]).detach().abs().amax(dim=1) > _SHOWS
        first.append(here[shows])
        second.append(there[shows])
        steps.append(clip.new_tensor([[dx, dy, 0.0]]).to(torch.float64).expand(int(shows.sum()), 3))
    here, there, step = torch.cat(first), torch.cat(second), torch.cat(steps)
    if not len(here):
        return colour
    pixels = fragments.layout.pixels()[here].to(torch.float64)
    start = torch.cat([pixels, torch.ones_like(pixels[:, :1])], dim=1)
    share, across = _crossing(clip, faces, face[here], face[there], start, step)
    # Of a border along the step, the pixels to its sides are the ones that share it.
    share = torch.where(across, share, 0.5).to(colour)
    change = colour.index_select(0, there) - colour.index_select(0, here)
    colour = colour.index_add(0, here, (0.5 - share).clamp_min(0)[:, None] * change)
    return colour.index_add(0, there, (0.5 - share).clamp_max(0)[:, None] * change)


def _crossing(
    clip: Tensor, faces: Tensor, one: Tensor, other: Tensor, start: Tensor, step: Tensor
) -> tuple[Tensor, Tensor]:
    """Where (P,) in [0, 1] on the segments from pixels (P, 3), (x, y, 1), to those a step (P, 3) further the face
    `one` (P,), which is seen at the start, gives way to the face `other`; and whether (P,) the border runs across
    the step rather than along it.

    Where both faces reach over one part of the segment, the border is that of the nearer one there, or where they
    pass through each other. Where neither does, something thin lies between, mostly the rest of a polygon: the
    border is that at which the two planes meet.
    """
    leaving = _Exit.of(clip, faces, one, start, start + step)
    entering = _Exit.of(clip, faces, other, start + step, start)
    leave, enter = leaving.share, 1 - entering.share
    # How much nearer the first one's plane is, as inverse depth, which is linear on the picture.
    plane = leaving.plane - entering.plane
    at_leave, at_enter = (
        (plane * (start + share.detach()[:, None] * step)).sum(dim=1) for share in (leave, enter)
    )
    overlap = enter.detach() < leave.detach()
    through = overlap & (at_enter.detach() > 0) & (at_leave.detach() < 0)
    far = at_leave.detach().abs() <= at_enter.detach().abs()
    chosen = torch.where(overlap, (at_leave + at_enter).detach() >= 0, far)
    crossed = -(plane * start).sum(dim=1) / torch.where(through, (plane * step).sum(dim=1), 1.0)
    share = torch.where(through, crossed, torch.where(chosen, leave, enter))
    slope = torch.where(chosen[:, None], leaving.slope, entering.slope)
    slope = torch.where(through[:, None], plane.detach()[:, :2], slope)
    along, across = (slope * step[:, :2]).sum(dim=1).abs(), (slope * (1 - step[:, :2])).sum(dim=1).abs()
    return share, (along > across) | ((along == across) & (step[:, 0] > 0))


@dataclass(frozen=True, slots=True)
class _Exit:
    """Where faces are left on segments. share (P,) in [0, 1]; slope (P, 2): of the edge function there,
    without a gradient; plane (P, 3): inverse depth at pixel (x, y, 1) is its product with it.
    """

    share: Tensor
    slope: Tensor
    plane: Tensor

    @classmethod
    def of(cls, clip: Tensor, faces: Tensor, face: Tensor, start: Tensor, end: Tensor) -> _Exit:
        """From start to end (P, 3), of faces (P,) that are seen at the start."""
        places = faces[face.to(torch.int64)].reshape(-1)
        corners = clip.index_select(0, places).reshape(-1, 3, 3).to(torch.float64)
        normals = torch.linalg.cross(corners[:, [1, 2, 0]], corners[:, [2, 0, 1]])
        inside, outside = (normals * start[:, None]).sum(-1), (normals * end[:, None]).sum(-1)
        det = (corners[:, 0] * normals[:, 0]).sum(-1, keepdim=True)
        leaves = outside.detach() * det.detach().sign() < 0
        share = torch.where(leaves, inside / torch.where(leaves, inside - outside, 1.0), 1.0)
        nearest = share.detach().argmin(dim=1, keepdim=True)
        slope = normals.detach().gather(1, nearest[..., None].expand(-1, 1, 3))[:, 0, :2]
        return cls(share.gather(1, nearest)[:, 0].clamp(0, 1), slope, normals.sum(dim=1) / det)


def _continued(colour: Tensor, face: Tensor, coverage: Tensor, width: int) -> Tensor:
    """Colours (T, 3), those of pixels that are covered in part and hit by nothing taken from a neighbour."""
    fringe = ((face < 0) & (coverage.detach() > 0)).nonzero()[:, 0]
    if not len(fringe):
        return colour
    source = torch.full_like(fringe, -1)
    for step in (-1, 1, -width, width):
        other = fringe + step
        inside = (other >= 0) & (other < len(face))
        if abs(step) == 1:
            inside &= other // width == fringe // width
        known = inside & (face[other.clamp(0, len(face) - 1)] >= 0) & (source < 0)
        source = torch.where(known, other, source)
    known = source >= 0
    return colour.index_add(0, fringe[known], colour.index_select(0, source[known]))
