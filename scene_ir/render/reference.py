"""Objects drawn in plain torch in any dtype: the definition that the fast path must match.

Shapes: N objects, V vertices, T packed pixels of all objects' crops, R rows: pixels of the mesh or of its halo.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from scene_ir.geometry import clamp_inclusive
from scene_ir.raster import verbs
from scene_ir.render import channels, model, surfaces, texture
from scene_ir.render.environment import PerturbedSun
from scene_ir.render.prepare import ObjectLayers, PreparedScene, VisibleSurfaces, is_active, patch_faces
from scene_ir.render.texture import smoothstep
from scene_ir.types import Objects


@dataclass(frozen=True, slots=True)
class _PixelRows:
    """Pixels to colour, mesh rows first, each part grouped by object.

    pixel (R,) int64 into the packed pixels; owner (R,) int64; xy (R, 2) px; share (R,) of the pixel that the row
    fills; counts (2N,) int64, rows of each mesh, then of each halo; anchor (R - Rm,) int64, mesh row that each row
    of a halo moves with.
    """

    pixel: Tensor
    owner: Tensor
    xy: Tensor
    share: Tensor
    counts: Tensor
    mesh_rows: int
    outline: _OutlineRows
    anchor: Tensor


@dataclass(frozen=True, slots=True)
class _ShadedRows:
    """Appearance of rows: premultiplied colour (R, 3), opacity (R,), depth (R,) m, paint and height (R,)."""

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    paint: Tensor
    height: Tensor


@dataclass(frozen=True, slots=True)
class _OutlineRows:
    """Blend of the pixels at a mesh's outline with their neighbours inside, so that nothing jumps when the outline
    passes a pixel's centre: the less a pixel is covered, the more it takes from its neighbours; missed centres
    have no values of their own.

    hit (Rm,) 1 or 0; row (K,) int64 rows at the outline; own (K,) in [0, 1], weight of their own values; neighbour
    (K, 4) int64 rows; weight (K, 4) with sum 1, or 0 where no neighbour is hit.
    """

    hit: Tensor
    row: Tensor
    own: Tensor
    neighbour: Tensor
    weight: Tensor

    @classmethod
    def from_coverage(
        cls, layout: verbs.PixelLayout, hit: Tensor, coverage: Tensor, mesh_pixel: Tensor, owner: Tensor
    ) -> _OutlineRows:
        """The blend for all packed pixels: hit, coverage, owner (T,); mesh_pixel (Rm,) int64: those that have a
        row.
        """
        row = (coverage.detach()[mesh_pixel] < 1).nonzero()[:, 0]
        pixel = mesh_pixel[row]
        draw = owner[pixel]
        x0, y0, x1, y1 = layout.rects[draw].unbind(-1)
        width, within = x1 - x0, pixel - layout.offsets[draw]
        column, line = within % width, within // width
        steps = torch.stack([torch.full_like(width, -1), torch.ones_like(width), -width, width], dim=1)
        exists = torch.stack([column > 0, column < width - 1, line > 0, line < y1 - y0 - 1], dim=1)
        neighbour = torch.where(exists, pixel[:, None] + steps, pixel[:, None])
        known = exists & hit[neighbour]
        weight = ((2.0 * coverage[neighbour] - 1.0).clamp(min=0.0) + model.LEAST_NEIGHBOUR) * known
        weight = weight / weight.sum(dim=1, keepdim=True).clamp(min=model.LEAST_NEIGHBOUR)
        own = smoothstep(coverage[pixel], *model.COVERED) * hit[pixel]
        own = torch.where(known.any(dim=1), own, torch.ones_like(own))
        rank = torch.zeros_like(hit, dtype=torch.int64)
        rank[mesh_pixel] = torch.arange(mesh_pixel.shape[0], device=hit.device)
        return cls(hit[mesh_pixel].to(coverage), row, own, rank[neighbour], weight)

    def fill(self, values: Tensor) -> Tensor:
        """Values (Rm, Q), read at the hits, extended over the outline."""
        known = values * self.hit[:, None]
        if self.row.numel() == 0:
            return known
        mean = (known[self.neighbour] * self.weight[..., None]).sum(dim=1)
        return known.index_add(0, self.row, (1.0 - self.own)[:, None] * (mean - known[self.row]))


def draw_layers(
    prepared: PreparedScene, objects: Objects, drawn: VisibleSurfaces, sun: PerturbedSun | None = None
) -> ObjectLayers:
    """Draw objects in plain torch.

    Args:
        prepared: The prepared scene.
        objects: Perturbed objects.
        drawn: Their visible surfaces.
        sun: As of `PreparedScene.perturbed_sun`.
    """
    rows = _collect_rows(prepared, drawn, bool(objects.source))
    size = drawn.mesh.layout.size
    if objects.source:
        shaded = _shade_photographed(prepared, objects, drawn, rows, sun)
    else:
        plain = prepared.template_attributes(prepared.rotated_normals(objects), drawn.geometry.clip[:, 2])
        own = _interpolate_attributes(prepared, drawn, rows, plain)
        colour = clamp_inclusive(prepared.shade_template(rows.xy, rows.owner, own, sun), 0.0, 1.0)
        z = own[:, channels.OWN_DEPTH]
        shaded = _ShadedRows(
            colour, torch.ones_like(z), z, own[:, channels.OWN_PAINT], own[:, channels.OWN_HEIGHT]
        )
    colour, depth = shaded.colour, shaded.depth
    if is_active(objects.texture_code):
        code, base = (
            texture.codes_by_part(objects).index_select(0, rows.owner),
            prepared.paint_lightness[rows.owner],
        )
        code = texture.codes_at_height(code, shaded.height)
        colour = texture.apply_texture_code(colour, shaded.opacity, code, shaded.paint, shaded.height, base)
    opacity = shaded.opacity * rows.share
    inverse = (opacity / depth.clamp(min=verbs.NEAR_M))[:, None]
    packed = torch.cat([colour * rows.share[:, None], inverse], dim=1)
    z = torch.full_like(drawn.mesh.depth, torch.inf).scatter_reduce(
        0, rows.pixel, depth.detach(), "amin", include_self=True
    )
    return ObjectLayers(
        drawn.mesh.layout,
        packed.new_zeros(size, 4).index_add(0, rows.pixel, packed),
        opacity.new_zeros(size).index_add(0, rows.pixel, opacity),
        z,
        drawn.patch_layout,
        _sample_shadows(prepared, objects, drawn),
    )


def _collect_rows(prepared: PreparedScene, drawn: VisibleSurfaces, with_halo: bool) -> _PixelRows:
    layout = drawn.mesh.layout
    count = layout.rects.shape[0]
    covered = drawn.coverage.detach()
    hit = drawn.mesh.face >= 0
    mesh_pixel = (hit | (covered > 0)).nonzero()[:, 0]
    owner = layout.draw_index()
    pixel, share = mesh_pixel, drawn.coverage.index_select(0, mesh_pixel)
    counts = torch.bincount(owner[mesh_pixel], minlength=count)
    anchor = mesh_pixel[:0]
    if with_halo:
        nearest = drawn.nearest_hits()
        halo_pixel = ((nearest >= 0) & (covered < 1)).nonzero()[:, 0]
        pixel = torch.cat([mesh_pixel, halo_pixel])
        share = torch.cat([share, 1.0 - drawn.coverage.index_select(0, halo_pixel)])
        counts = torch.cat([counts, torch.bincount(owner[halo_pixel], minlength=count)])
        rank = torch.zeros_like(owner)
        rank[mesh_pixel] = torch.arange(mesh_pixel.shape[0], device=rank.device)
        anchor = rank[nearest[halo_pixel]]
    rows_owner = owner[pixel]
    x0, y0, x1, _ = layout.rects[rows_owner].unbind(-1)
    within, width = pixel - layout.offsets[rows_owner], x1 - x0
    xy = torch.stack([x0 + within % width, y0 + within // width], dim=-1)
    outline = _OutlineRows.from_coverage(layout, hit, drawn.coverage, mesh_pixel, owner)
    return _PixelRows(pixel, rows_owner, xy.to(prepared.like), share, counts, mesh_pixel.shape[0], outline, anchor)


def _interpolate_attributes(
    prepared: PreparedScene, drawn: VisibleSurfaces, rows: _PixelRows, attributes: Tensor
) -> Tensor:
    """Attributes (V, K) of the mesh at the mesh rows (Rm, K), extended over the outline."""
    dense = verbs.interpolate(
        drawn.mesh, drawn.geometry.clip, prepared.surfaces.faces, attributes, prepared.backend
    )
    return rows.outline.fill(dense.index_select(0, rows.pixel[: rows.mesh_rows]))


def _average_attributes(
    prepared: PreparedScene, drawn: VisibleSurfaces, rows: _PixelRows, attributes: Tensor
) -> Tensor:
    """`_interpolate_attributes`, averaged over the pixel at `model.SUBPIXELS`: parts thinner than a pixel would
    otherwise be rows of dots. A position that is not reached counts as the pixel's centre.
    """
    meshes, clip = prepared.surfaces, drawn.geometry.clip.double()
    face = drawn.mesh.face[rows.pixel[: rows.mesh_rows]].long()
    hit = (face >= 0).nonzero()[:, 0]
    centre, start = rows.xy[hit].double(), face[hit]
    total = clip.new_zeros(len(hit), attributes.shape[1])
    for place in model.SUBPIXELS:
        xy = centre + clip.new_tensor(place) / 16.0
        reached = _walk_mesh(start, xy, clip.detach(), meshes.faces, meshes.neighbours)
        xy = torch.where(reached[:, None] < 0, centre, xy)
        corner = meshes.faces[torch.where(reached < 0, start, reached)]
        share = surfaces.perspective_weights(clip[corner], xy)
        total = total + (share[..., None] * attributes.double()[corner]).sum(dim=1)
    mean = clip.new_zeros(len(face), attributes.shape[1]).index_copy(0, hit, total / len(model.SUBPIXELS))
    return rows.outline.fill(mean.to(attributes))


def _walk_mesh(face: Tensor, xy: Tensor, clip: Tensor, faces: Tensor, neighbours: Tensor) -> Tensor:
    """Faces (K,) at positions xy (K, 2) px, reached from `face` (K,) over the mesh's edges; -1 where the surface
    ends or turns away before, or after more than `model.WALK` faces.
    """
    reached, current = torch.full_like(face, -1), face
    first = clip.new_zeros(len(face))
    for passed in range(model.WALK):
        corner = clip[faces[current.clamp(min=0)]]
        normals = torch.stack([torch.linalg.cross(corner[:, k - 2], corner[:, k - 1]) for k in range(3)], dim=1)
        det = (corner[:, 0] * normals[:, 0]).sum(dim=1)
        first = det if passed == 0 else first
        edge = (normals[..., :2] * xy[:, None]).sum(dim=2) + normals[..., 2]
        least, nearest = (edge * det.sign()[:, None]).min(dim=1)
        walks = (current >= 0) & (reached < 0) & (det * first > 0.0)
        reached = torch.where(walks & (least >= 0.0), current, reached)
        across = neighbours[current.clamp(min=0)].gather(1, nearest[:, None])[:, 0]
        current = torch.where(walks, across, torch.full_like(current, -1))
    return reached


def _shade_photographed(
    prepared: PreparedScene, objects: Objects, drawn: VisibleSurfaces, rows: _PixelRows, sun: PerturbedSun | None
) -> _ShadedRows:
    """All rows, coloured by the photograph, and completed where it did not see the mesh."""
    geometry, base, meshes, m = (drawn.geometry, prepared.base_geometry, prepared.surfaces, rows.mesh_rows)
    turn = torch.stack(
        [
            geometry.facing_cos - base.facing_cos,
            base.facing_cos,
            meshes.paint,
            prepared.vertex_height,
            geometry.brightening,
        ],
        dim=1,
    )

    attributes = torch.cat([base.clip - geometry.clip, base.clip[:, 2:], turn], dim=1)
    dense = verbs.interpolate(drawn.mesh, geometry.clip, meshes.faces, attributes, prepared.backend)
    mesh = rows.outline.fill(_photograph_lookup(dense.index_select(0, rows.pixel[:m]), rows.xy[:m]))
    lookup = torch.cat([mesh, mesh.index_select(0, rows.anchor)])
    move, rest = lookup.split([channels.W_THEN, channels.LOOKUP - channels.W_THEN], dim=1)
    z_then, z_now, turned, cos_then, paint, height, brighter = rest.unbind(1)

    assert prepared.texels is not None
    uv = rows.xy + move
    texels = prepared.texels.sample(uv, rows.counts, prepared.backend, "clamp")
    rgb, rest = texels.split([channels.ALPHA, channels.TEXEL - channels.ALPHA], dim=1)
    alpha, _, inset, _, support = rest.unbind(1)
    rgb = texture.relight(rgb, brighter)
    weight, visible = photograph_weight(uv, texels, prepared.frame_hw, (z_then, turned, cos_then, paint))
    halo_weight = smoothstep(texture.outline_share(inset[m:]), 0.0, 1.0) * texture.outline_weight(turned[m:])
    halo_weight = halo_weight * (1.0 - smoothstep(inset[rows.anchor], *model.OUTER_OUTLINE_PX))
    weight = torch.cat([weight[:m], weight[m:] * halo_weight])
    rim = 1.0 - smoothstep(cos_then[:m], *model.RIM)
    opened = smoothstep(turned[:m], *model.OPEN_TURN) * rim * (1.0 - alpha[:m]).clamp(min=0.0)
    # Where the photograph shows no vehicle, the mesh is larger than the vehicle and stays empty: a visual hull.
    empty = visible[:m] * (1.0 - smoothstep(support[:m], *model.SUPPORTED))
    # Newly exposed outline becomes as opaque as the inside, in its own colour where that is reliable.
    closed = weight[:m] * opened * (1.0 - empty) * smoothstep(alpha[:m], *model.OPEN_ALPHA)
    gain = torch.cat([closed / alpha[:m].clamp(min=model.OPEN_ALPHA[0]), torch.zeros_like(alpha[m:])])
    fill = (1.0 - weight[:m]) * (1.0 - empty)
    colour, opacity = (weight + gain)[:, None] * rgb, (weight + gain) * alpha
    unseen = (fill != 0.0).nonzero()[:, 0]
    if unseen.numel():
        filled = fill.index_select(0, unseen)
        completed = _complete_unseen(prepared, objects, drawn, rows, unseen, cos_then[:m] + turned[:m], sun)
        colour = colour.index_add(0, unseen, filled[:, None] * completed)
        opacity = opacity.index_add(0, unseen, filled)
    assert prepared.regions is not None
    if is_active(objects.texture_code) and bool(prepared.regions.known.any()):
        unseen = torch.cat([fill, torch.zeros_like(alpha[m:])])
        region = prepared.regions.texels.sample_mesh_and_halo(uv, rows.counts, prepared.backend)[:, 0]
        paint = texture.paint_share(paint, region, unseen, prepared.regions.known[rows.owner])
    return _ShadedRows(colour, opacity, z_now, paint, height)


def photograph_weight(
    uv: Tensor, texels: Tensor, frame_hw: tuple[int, int], surface: tuple[Tensor, Tensor, Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """How far rows of meshes have the photograph's colours, not completed ones.

    Args:
        uv: (R, 2) px, where the photograph shows them.
        texels: (R, `channels.TEXEL`) of the photograph there.
        frame_hw: Size of the photograph, px.
        surface: Of the mesh there, (R,) each: depth then, m; cosine towards the camera now minus then, and then;
            share of paint.

    Returns:
        (R,) weight of the photograph in [0, 1], and whether it shows the place at all, in [0, 1].
    """
    alpha, hidden, _, z_seen, _ = texels[:, channels.ALPHA :].unbind(1)
    z_then, turned, cos_then, paint = surface
    clear = 1.0 - smoothstep(hidden, 0.0, 1.0)
    inside = texture.inside_weight(uv, *frame_hw)
    visible = inside * clear
    facing = texture.facing_weight(turned, cos_then, paint)
    weight = facing * visible
    if bool((inside.detach() < 1.0).any()):
        near = texture.inside_weight(uv, *frame_hw, model.EXTENDED_PX)
        near = near * smoothstep(alpha, *model.SOLID_ALPHA)
        weight = weight + facing * (1.0 - inside) * near * clear
    return weight * (1.0 - smoothstep(z_then - z_seen, *model.DEPTH_TOLERANCE_M)), visible


def measure_completion(prepared: PreparedScene, drawn: VisibleSurfaces) -> tuple[Tensor, Tensor]:
    """For each packed pixel of the meshes (T,): the share that is drawn at all, and that with colours which the
    photograph does not show; 0 beyond the meshes. Objects must have sources.
    """
    geometry, base, meshes = drawn.geometry, prepared.base_geometry, prepared.surfaces
    turn = torch.stack([geometry.facing_cos - base.facing_cos, base.facing_cos, meshes.paint], dim=1)
    attributes = torch.cat([base.clip - geometry.clip, base.clip[:, 2:], turn], dim=1)
    dense = verbs.interpolate(drawn.mesh, geometry.clip, meshes.faces, attributes, prepared.backend)
    hit = (drawn.mesh.face >= 0).nonzero()[:, 0]
    xy = drawn.mesh.layout.pixel_xy()[hit].to(prepared.like)
    lookup = _photograph_lookup(dense.index_select(0, hit), xy)
    counts = torch.bincount(drawn.mesh.layout.draw_index()[hit], minlength=drawn.mesh.layout.rects.shape[0])
    assert prepared.texels is not None
    uv = xy + lookup[:, :2]
    texels = prepared.texels.sample(uv, torch.cat([counts, 0 * counts]), prepared.backend, "clamp")
    surface = (lookup[:, 2], lookup[:, 4], lookup[:, 5], lookup[:, 6])
    weight, visible = photograph_weight(uv, texels, prepared.frame_hw, surface)
    share = 1.0 - visible * (1.0 - smoothstep(texels[:, channels.SUPPORT], *model.SUPPORTED))
    drawn_share = prepared.like.new_zeros(drawn.mesh.layout.size)
    return (
        drawn_share.index_copy(0, hit, share),
        drawn_share.index_copy(0, hit, (1.0 - weight).clamp(0.0, 1.0) * share),
    )


def _complete_unseen(
    prepared: PreparedScene,
    objects: Objects,
    drawn: VisibleSurfaces,
    rows: _PixelRows,
    unseen: Tensor,
    cos_now: Tensor,
    sun: PerturbedSun | None,
) -> Tensor:
    """Colours (K, 3) of mesh rows `unseen` that the photograph did not see: the car's other side, or the template
    in the car's own finish. cos_now: (Rm,) towards the camera.
    """
    attributes = prepared.completion_attributes(prepared.rotated_normals(objects), drawn.geometry.clip[:, 2])
    completion = _average_attributes(prepared, drawn, rows, attributes)[unseen]
    gain, lift = completion[:, channels.GAIN : channels.LIFT], completion[:, channels.LIFT :]
    colour = texture.apply_finish(
        prepared.shade_template(rows.xy[unseen], rows.owner[unseen], completion, sun), gain, lift
    )
    clip, cos_then = completion[:, channels.MIRROR : channels.MIRROR_COS], completion[:, channels.MIRROR_COS]
    z = clip[:, 2]
    safe = z.clamp(min=model.NEAREST_MIRRORED_M)
    uv = clip[:, :2] / safe[:, None]
    counts = torch.bincount(rows.owner[unseen], minlength=rows.counts.shape[0])
    assert prepared.texels is not None
    texels = prepared.texels.sample(uv, counts, prepared.backend, "clamp")
    height, width = prepared.frame_hw
    weight = (
        texture.inside_weight(uv, height, width)
        * (1.0 - smoothstep(texels[:, channels.HIDDEN], 0.0, 1.0))
        * smoothstep(texels[:, channels.ALPHA], *model.SOLID_ALPHA)
        * (1.0 - smoothstep(z - texels[:, channels.DEPTH], *model.DEPTH_TOLERANCE_M))
        * texture.facing_weight(cos_now[unseen] - cos_then, cos_then, completion[:, channels.OWN_PAINT])
        * smoothstep(cos_then, *model.MIRRORED_COS)
        * (1.0 - smoothstep(texture.outline_share(texels[:, channels.INSET]), *model.MIRRORED_RIM))
    )
    rgb, alpha = texels[:, : channels.ALPHA], texels[:, channels.ALPHA : channels.HIDDEN]
    straight = rgb / alpha.clamp(min=model.LEAST_MIRRORED_ALPHA)
    return colour + weight[:, None] * (clamp_inclusive(straight, 0.0, 1.0) - colour)


def _sample_shadows(prepared: PreparedScene, objects: Objects, drawn: VisibleSurfaces) -> Tensor:
    """Shadow factors (Ts, 3) on the ground, of all patches."""
    clip, layout = drawn.geometry.patch_clip, drawn.patch_layout
    assert drawn.patch_fragments is not None
    if layout.size == 0:
        return clip.new_zeros(0, 3)
    faces, _, _ = patch_faces(len(objects), clip.device)
    if not objects.source:
        return (1.0 - prepared.patch_density(drawn))[:, None].expand(-1, 3)
    base = prepared.base_geometry.patch_clip
    fixed = torch.cat([base - clip, base[:, 2:]], dim=1)
    dense = verbs.interpolate(drawn.patch_fragments, clip, faces, fixed, prepared.backend)
    hit = (drawn.patch_fragments.face >= 0).nonzero()[:, 0]
    xy = layout.pixel_xy()[hit].to(prepared.like)
    wanted = xy + _photograph_lookup(dense.index_select(0, hit), xy)[:, :2]
    height, width = prepared.frame_hw
    # Beyond the border `_shadow_darkness` is constant: clamping two pixels outside leaves no kink.
    uv = wanted.clamp(min=-2.0).minimum(wanted.new_tensor([width + 1.0, height + 1.0]))
    assert prepared.shadows is not None
    owner = layout.draw_index()[hit]
    rect = prepared.shadows.rects[owner]
    reached = ((uv > rect[:, :2] - 2) & (uv < rect[:, 2:] + 1)).all(dim=1).nonzero()[:, 0]
    hit, uv, wanted = hit[reached], uv.index_select(0, reached), wanted.index_select(0, reached)
    counts = torch.bincount(owner[reached], minlength=len(objects))
    dark = prepared.shadows.sample(uv, counts, prepared.backend, "zero")
    dark = dark * texture.inside_weight(wanted, height, width, model.SHADOW_EXTENDED_PX)[:, None]
    return dark.new_ones(layout.size, 3).index_add(0, hit, -dark)


def _photograph_lookup(attributes: Tensor, xy: Tensor) -> Tensor:
    """Photograph position of each pixel from interpolated clip differences.

    attributes (R, 4 + K): clip then minus now (3), w then, and K more; xy (R, 2) px -> (R, 4 + K): displacement in
    px (2), w then, w now, and the K more. A point that was behind the camera is looked up far outside.
    """
    delta, then = attributes[:, :3], attributes[:, 3:4]
    before = then > verbs.NEAR_M
    safe = torch.where(before, then, torch.ones_like(then))
    moved = (delta[:, :2] - xy * delta[:, 2:]) / safe
    moved = torch.where(before, moved, torch.full_like(moved, model.FAR_AWAY_PX))
    return torch.cat([moved, then, then - delta[:, 2:], attributes[:, 4:]], dim=1)
