"""Re-rendering a scene: photograph, perturbed vehicles, weather. Differentiable to all six kinds of parameter.

A vehicle's *mesh* shows the photograph where the photograph saw that point, and completes what it did not see. Its
*halo*, the pixels around the mesh, carries what of the matte lies beyond the mesh, and moves as the nearest piece
of outline does. A pixel's lookup is `pixel + displacement`, the displacement interpolated from the difference of
the clip coordinates then and now: with nothing perturbed it is exactly zero, every lookup falls on a pixel centre,
and the picture is the photograph.

Shapes: N objects, V vertices, T packed pixels of all objects' crops, R rows: pixels of the mesh or of its halo.
"""

from __future__ import annotations

import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from scene_ir import blend, finish, fused, surfaces, texture
from scene_ir.environment import apply_foliage, apply_weather, shadow_softening, sky_colour
from scene_ir.errors import ShapeError
from scene_ir.meshes.lod import detail
from scene_ir.raster import verbs
from scene_ir.surfaces import Fleet, Surface
from scene_ir.texture import Regions, Texels, smoothstep
from scene_ir.types import Crop, Objects, Render, SceneIR

T = TypeVar("T")

HALO_MAX_PX = 64.0
"""However near a vehicle is, its halo reaches no farther: of a car that fills the picture's height this is a
sixth."""


_MOST_SAMPLES, _GOLDEN = 5000, 0.6180339887
"""Pixels of one object that its finish is read off, some for each vertex; steps by the golden section spread
them."""
_PATCH_MARGIN_PX = 4
"""Ground kept around a photographed shadow: the reach of the lookups' kernel, and two pixels."""


@dataclass(frozen=True, slots=True)
class RenderSettings:
    """backend: `warp` (float32, fast) or `reference` (plain torch, the scene's dtype, for gradient checks).
    shadows: whether vehicles darken the ground. lod: whether meshes are drawn as coarsely as their size in pixels
    allows; a scene is rendered as it was taken apart where both were done alike.
    """

    backend: verbs.Backend = "warp"
    shadows: bool = True
    lod: bool = True


@dataclass(frozen=True, slots=True)
class Layers:
    """The objects of one scene, drawn but not yet blended.

    layout: crops of the objects; colour (T, 4): premultiplied RGB and opacity / depth; opacity (T,); depth (T,) m.
    shadow_layout, shadow (Ts, 3): the shadows' crops and factors.
    """

    layout: verbs.Layout
    colour: Tensor
    opacity: Tensor
    depth: Tensor
    shadow_layout: verbs.Layout
    shadow: Tensor


@dataclass(frozen=True, slots=True)
class _Standing:
    """What stands in front of vehicles, as layers after theirs. footprints (K, 4, 2) m, see `blend`; layout,
    colour (T, 4), opacity (T,), depth (T,) m as in `Layers`; pixel (T,) int64: of the frame, for each of theirs.
    """

    footprints: np.ndarray
    layout: verbs.Layout
    colour: Tensor
    opacity: Tensor
    depth: Tensor
    pixel: Tensor

    @classmethod
    def of(cls, scene: SceneIR, like: Tensor) -> _Standing:
        """Of a scene's `front`. `like`: a tensor of the dtype and device to work in."""
        texels = Texels.pack([f.foreground for f in scene.front], like)
        layout = verbs.Layout.of(texels.rects)
        rgba, draw = texels.values, layout.draw()
        depth = like.new_tensor([f.depth_m for f in scene.front])[draw]
        colour = torch.cat([rgba[:, :3], rgba[:, 3:] / depth[:, None]], dim=1)
        x, y = layout.pixels().unbind(1)
        footprints = blend.standing_footprints(scene.front, scene.camera.matrix)
        return cls(footprints, layout, colour, rgba[:, 3], depth, y * scene.camera.width + x)

    def before(self, layers: Layers | None, change: Tensor | None) -> Layers:
        """Layers of objects, if there are any, and these after them. change: (3, H, W), what the season does to
        the background, and so to these."""
        colour = self.colour
        if change is not None:
            moved = change.flatten(1)[:, self.pixel].T * self.opacity[:, None]
            colour = torch.cat([colour[:, :3] + moved, colour[:, 3:]], dim=1)
        if layers is None:
            nothing = verbs.Layout.of(self.layout.rects[:0])
            return Layers(self.layout, colour, self.opacity, self.depth, nothing, colour[:0, :3])
        return Layers(
            verbs.Layout.of(torch.cat([layers.layout.rects, self.layout.rects])),
            torch.cat([layers.colour, colour]),
            torch.cat([layers.opacity, self.opacity]),
            torch.cat([layers.depth, self.depth]),
            layers.shadow_layout,
            layers.shadow,
        )


def scene_to(value: T, dtype: torch.dtype, device: torch.device | str | None = None) -> T:
    """The same scene, or any part of it, with its floating tensors in `dtype`, all tensors on `device`."""
    return _convert(value, dtype, device)


def _convert(value: Any, dtype: torch.dtype, device: torch.device | str | None) -> Any:
    if isinstance(value, Tensor):
        return value.to(device=device, dtype=dtype if value.is_floating_point() else None)
    if isinstance(value, tuple):
        return tuple(_convert(v, dtype, device) for v in value)
    if is_dataclass(value) and not isinstance(value, type):
        changes = {
            f.name: _convert(getattr(value, f.name), dtype, device)
            for f in fields(value)
            if not isinstance(getattr(value, f.name), (int, float, str, Mapping, type(None)))
        }
        return replace(value, **changes)
    return value


def render(scenes: Sequence[SceneIR], settings: RenderSettings | None = None) -> list[Render]:
    """Render scenes as they stand. To render many perturbations of one scene, keep its `Compositor`."""
    return [Compositor(scene, settings).render(scene) for scene in scenes]


@dataclass(frozen=True, slots=True)
class _Geometry:
    """Placed vertices. clip (V, 3) of the meshes; cos (V,) between their welded normals and the way to the
    camera; ground_clip (4N, 3) of the shadows' patches; brighter (V,): see `texture.brightened`, by what the
    objects turned since the photograph."""

    clip: Tensor
    cos: Tensor
    ground_clip: Tensor
    brighter: Tensor


@dataclass(frozen=True, slots=True)
class Drawn:
    """What the z-buffers found for one perturbation. coverage (T,); reach_px: of each object's halo;
    ground_layout: of the patches; ground: what was found there, None where the fast kernels find out themselves.
    """

    geometry: _Geometry
    mesh: verbs.Fragments
    coverage: Tensor
    reach_px: tuple[float, ...]
    ground_layout: verbs.Layout
    ground: verbs.Fragments | None

    def nearest(self) -> Tensor:
        """(T,) int64: the packed pixel that the same object's mesh hits nearest to each, -1 where no halo
        reaches."""
        return surfaces.nearest_hits(self.mesh, self.reach_px)


@dataclass(frozen=True, slots=True)
class _Rows:
    """Pixels to be coloured, mesh rows first, each part grouped by object.

    pixel (R,) int64 into the packed pixels; owner (R,) int64; xy (R, 2) px; share (R,): how much of the pixel this
    row fills; counts (2N,) int64 rows of each mesh, then of each halo; fringe: see `_Fringe`; anchor (R - Rm,)
    int64: the mesh row that each row of a halo moves with.
    """

    pixel: Tensor
    owner: Tensor
    xy: Tensor
    share: Tensor
    counts: Tensor
    mesh_rows: int
    fringe: _Fringe
    anchor: Tensor


@dataclass(frozen=True, slots=True)
class _Shaded:
    """Rows with their looks: premultiplied colour (R, 3), opacity (R,), depth (R,) m, paint and height (R,)."""

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    paint: Tensor
    height: Tensor


@dataclass(frozen=True, slots=True)
class _Fringe:
    """Pixels at a mesh's outline continue what their neighbours inside show: those whose centres the mesh misses
    have nothing of their own, the others lean on their neighbours the more, the less they are covered. So nothing
    jumps when the outline passes over a pixel's centre.

    hit (Rm,) 1 or 0; row (K,) int64: rows at the outline; own (K,) in [0, 1]: how much they keep of their own
    values; neighbour (K, 4) int64 rows; weight (K, 4), of sum 1, or 0 where no neighbour is hit.
    """

    hit: Tensor
    row: Tensor
    own: Tensor
    neighbour: Tensor
    weight: Tensor

    @classmethod
    def of(cls, layout: verbs.Layout, hit: Tensor, coverage: Tensor, mesh_pixel: Tensor, owner: Tensor) -> _Fringe:
        """hit, coverage, owner (T,): of all packed pixels; mesh_pixel (Rm,) int64: those that have a row."""
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
        weight = ((2.0 * coverage[neighbour] - 1.0).clamp(min=0.0) + 1e-3) * known
        weight = weight / weight.sum(dim=1, keepdim=True).clamp(min=1e-3)
        own = smoothstep(coverage[pixel], 0.5, 1.0) * hit[pixel]
        own = torch.where(known.any(dim=1), own, torch.ones_like(own))
        rank = torch.zeros_like(hit, dtype=torch.int64)
        rank[mesh_pixel] = torch.arange(mesh_pixel.shape[0], device=hit.device)
        return cls(hit[mesh_pixel].to(coverage), row, own, rank[neighbour], weight)

    def fill(self, values: Tensor) -> Tensor:
        """Values (Rm, Q), read at the hits, continued over the outline."""
        known = values * self.hit[:, None]
        if self.row.numel() == 0:
            return known
        mean = (known[self.neighbour] * self.weight[..., None]).sum(dim=1)
        return known.index_add(0, self.row, (1.0 - self.own)[:, None] * (mean - known[self.row]))


class Compositor:
    """Draws perturbations of one scene; keeps what no parameter touches.

    A perturbed scene may differ from `scene` in objects.translation, yaw, ffd, texture_code and in
    environment.weather, foliage. With backend `warp` the scene is worked on in float32.
    """

    def __init__(
        self,
        scene: SceneIR,
        settings: RenderSettings | None = None,
        hidden: Sequence[Tensor] | None = None,
        whole_patches: bool = False,
    ) -> None:
        """hidden: one (H, W) an object, where nearer objects stood before it; found from the mattes if not given.
        whole_patches: keep all of the ground that a vehicle may darken, not only what its source's shadow does."""
        self.settings = settings or RenderSettings()
        if self.settings.backend == "warp" and scene.photograph.dtype != torch.float32:
            scene = scene_to(scene, torch.float32)
        self.scene = scene
        self._whole_patches = whole_patches
        self._like = scene.photograph
        self._frame_hw = (scene.camera.height, scene.camera.width)
        self._centre = surfaces.camera_centre(scene.camera.matrix).to(self._like)
        self._unproject = torch.linalg.inv(scene.camera.matrix[:, :3]).to(self._like)
        self._air = sky_colour(scene.photograph, scene.environment.sky)
        inverse = torch.where(torch.isfinite(scene.depth), 1.0 / scene.depth, torch.zeros_like(scene.depth))
        self._canvas = torch.cat([scene.background, inverse.to(self._like)[None]])
        self._standing = _Standing.of(scene, self._like) if scene.front else None
        self._footprints = None if self._standing is None else self._standing.footprints
        with torch.no_grad():
            self._prepare(scene.objects, hidden)

    def _prepare(self, objects: Objects, hidden: Sequence[Tensor] | None) -> None:
        """Everything that hangs on the unperturbed objects: normals, and what the photograph knows."""
        base = _photographed(objects)
        meshes = [self.scene.meshes[int(i)] for i in objects.mesh_index]
        if self.settings.lod:
            heights = self._height_px(base)
            meshes = [detail(mesh, height) for mesh, height in zip(meshes, heights, strict=True)]
        picked = [Surface.of(mesh, self._like.dtype) for mesh in meshes]
        self.fleet = Fleet.of(picked, self._like)
        local = self.fleet.local(base.ffd, base.size_lhw)
        self._sharp, self._smooth = self.fleet.normals(local)
        self.rig = fused.Rig.of(self.fleet, self._smooth, self.scene.camera.matrix, self._centre)
        inflation = self._like.new_tensor([s.inflation for s in objects.source] or [0.0] * len(objects))
        self._halo = inflation * self.scene.camera.matrix[0, 0].to(self._like)
        self._sun_offset = surfaces.sun_offset(self.scene.environment.sun, base.yaw, base.size_lhw[:, 1])
        self._corners = surfaces.shadow_corners(base.size_lhw, self._sun_offset)
        if objects.source and not self._whole_patches:
            self._corners = self._trimmed_corners(objects, base)
        self._outwards = surfaces.outwards(self._corners, base.size_lhw, self._sun_offset)
        self._lit: Tensor | None = None
        self._base_yaw = base.yaw
        self._sunlight = self._like.new_tensor(
            [s.sunlight for s in objects.source] or [texture.SUNLIGHT] * len(base)
        )
        self._size = base.size_lhw
        self._base_ffd, self._base_local = base.ffd, local
        # Weak, or each compositor, with its texels, would live on until the collector finds the circle.
        self._pack = _Pack([weakref.proxy(self)])
        self._base = self._place(base)
        self._height = torch.cat([-s.unit[:, 1] for s in picked]) if picked else self._like.new_zeros(0)
        self._texels, self._shadows, self.regions = None, None, None
        self._finish: Tensor | None = None
        self._drawn: Drawn | None = None  # until the finish is found
        self._fixed: fused.Fixed | None = None
        self.paint_lightness = self._base_lightness(objects)
        if objects.source:
            self._prepare_sources(objects, base, hidden)

    def _trimmed_corners(self, objects: Objects, base: Objects) -> Tensor:
        """The patches (N, 4, 2) m, cut down to what the photographed shadows darken."""
        height, width = self._frame_hw
        corners = self._corners.clone()
        for i, source in enumerate(objects.source):
            if source.shadow is None or source.shadow.values.numel() == 0:
                continue
            rows, columns = (source.shadow.values < 1.0).any(dim=0).nonzero().unbind(dim=1)
            x, y = columns + source.shadow.x0, rows + source.shadow.y0
            margin = _PATCH_MARGIN_PX
            if not len(x) or int(x.min()) < margin or int(y.min()) < margin:
                continue  # a shadow that the border cuts goes on beyond it
            if int(x.max()) >= width - margin or int(y.max()) >= height - margin:
                continue
            steps = torch.tensor([[-margin, -margin], [margin, -margin], [-margin, margin], [margin, margin]])
            pixels = (torch.stack([x, y], dim=1)[:, None] + steps).reshape(-1, 2).to(self._like)
            found = surfaces.on_ground(
                pixels,
                self._unproject,
                self._centre,
                base.translation[i],
                base.yaw[i],
                self.scene.environment.ground,
            )
            if found is None:
                continue
            low = torch.maximum(found.amin(dim=0), corners[i].amin(dim=0))
            high = torch.minimum(found.amax(dim=0), corners[i].amax(dim=0))
            if bool((high > low).all()):
                corners[i] = surfaces.rectangle(low, high)
        return corners

    def _height_px(self, objects: Objects) -> list[float]:
        """How high the objects are in the image at their nearest point, at least."""
        middle = surfaces.project_vertices(objects.translation.detach(), self.scene.camera)[:, 2]
        nearest = (middle - 0.5 * objects.size_lhw[:, [0, 2]].norm(dim=1)).clamp(min=1.0)
        return (self.scene.camera.matrix[1, 1].to(nearest) * objects.size_lhw[:, 1] / nearest).tolist()

    def _prepare_sources(self, objects: Objects, base: Objects, hidden: Sequence[Tensor] | None) -> None:
        drawn = self.draw(base)
        self._drawn = drawn
        mirrored = self.fleet.place(
            self.fleet.local(base.ffd, base.size_lhw, mirrored=True), base.yaw, base.translation
        )
        self._mirror_clip = surfaces.project_vertices(mirrored, self.scene.camera)
        flipped = surfaces.rotate(
            self._smooth * self._like.new_tensor([1.0, 1.0, -1.0]), base.yaw[self.fleet.owner]
        )
        self._mirror_cos = surfaces.facing(mirrored, flipped, self._centre)
        order = blend.paint_order(base.size_lhw, base.yaw, base.translation, self._centre, self._footprints)
        nearer = [thing.foreground for thing in (*objects.source, *self.scene.front)]
        mattes = [replace(crop, values=crop.values[3:]) for crop in nearer]
        crops = []
        rects = drawn.mesh.layout.rects.tolist()
        for i, (packed, size) in enumerate(drawn.mesh.layout.spans()):
            before = [mattes[j] for j in order[order.index(i) + 1 :]]
            unseen = hidden[i] if hidden else texture.hidden_behind(before, self._frame_hw, self._like)
            x0, y0, x1, y1 = rects[i]
            if x1 <= x0:
                crops.append(Crop(self._like.new_zeros(texture.CHANNELS, 0, 0), 0, 0))
                continue
            depth = Crop(drawn.mesh.depth[packed].reshape(1, *size), x0, y0)
            crops.append(texture.source_texels(objects.source[i], depth, unseen, (x0, y0, x1, y1), self._frame_hw))
        self._texels = Texels.pack(crops + crops, self._like)
        self._shadows = Texels.pack([_darkness(s.shadow, self._frame_hw) for s in objects.source], self._like)
        blank = Crop(self._like.new_zeros(1, 0, 0), 0, 0)
        self.regions = Regions(
            Texels.pack([s.region or blank for s in objects.source], self._like),
            torch.tensor([s.region is not None for s in objects.source], device=self._like.device),
        )

    @property
    def fixed(self) -> fused.Fixed | None:
        """What the fast kernels read, gathered on first use; None where they are not used."""
        if self._fixed is None and self._texels is not None and self.settings.backend == "warp":
            with torch.no_grad():
                self._fixed = self._fuse()
        return self._fixed

    @property
    def finish(self) -> Tensor:
        """(V, 4): gains (3) and lift that make the templates' colours the vehicles'; found on first use."""
        if self._finish is None:
            parts = zip(self.fleet.surfaces, self.samples(), strict=True)
            found = [torch.from_numpy(finish.fitted(surface, samples)) for surface, samples in parts]
            self._finish = torch.cat(found).to(self._like)
            self._drawn = None
        return self._finish

    def _fuse(self) -> fused.Fixed:
        """What the fast kernels read, gathered."""
        fleet, base, count = self.fleet, self._base, len(self.scene.objects)
        assert self._texels is not None
        assert self._shadows is not None
        own = (fleet.colours, self._sharp, fleet.paint[:, None], fleet.glass[:, None], self._height[:, None])
        mirror = (self._mirror_clip, self._mirror_cos[:, None])
        height, width = self._frame_hw
        return fused.Fixed(
            faces=fleet.faces.to(torch.int32).contiguous(),
            base_clip=base.clip,
            base=torch.stack([base.cos, fleet.paint, self._height], dim=1),
            own=torch.cat([*own, *mirror, self.finish], dim=1),
            texels=(
                self._texels.values[: int(self._texels.offsets[count])],
                self._texels.rects[:count],
                self._texels.offsets[: count + 1],
            ),
            patches=fused.patches(base.ground_clip),
            dark=(self._shadows.values, self._shadows.rects, self._shadows.offsets),
            frame_wh=self._like.new_tensor([width, height]).expand(count, 2).contiguous(),
            sun=torch.cat(
                [self.scene.environment.sun.to(self._like).expand(count, 3), self._sunlight[:, None]], dim=1
            ),
            unproject=self._unproject.expand(count, 3, 3).contiguous(),
        )

    def _base_lightness(self, objects: Objects) -> Tensor:
        """CIE L* (N,) of the objects' paint, about which gloss turns contrast."""
        if objects.source:
            paint = torch.stack([s.paint for s in objects.source]).to(self._like)
        else:
            paint = self._template_paint()
        return texture.lab(paint.clamp(0.0, 1.0))[:, 0]

    def _template_paint(self) -> Tensor:
        """The mean colour (N, 3) of the templates' paint."""
        fleet = self.fleet
        total = self._size.new_zeros(len(self._size), 3)
        total = total.index_add(0, fleet.owner, fleet.colours * fleet.paint[:, None])
        count = total.new_zeros(len(total)).index_add(0, fleet.owner, fleet.paint)
        return total / count.clamp(min=1e-3)[:, None]

    def base_paint(self, samples: Sequence[finish.Samples]) -> Tensor:
        """The paint (N, 3) of the objects as the photograph shows it, by their `samples`; the templates' where it
        shows none."""
        paint = self._template_paint()
        for i, (surface, own) in enumerate(zip(self.fleet.surfaces, samples, strict=True)):
            found = finish.base_paint(surface, own)
            if found is not None:
                paint[i] = found.to(paint)
        return paint

    def _place(self, objects: Objects) -> _Geometry:
        return self._pack.place([objects])

    def draw(self, objects: Objects) -> Drawn:
        """Find which surfaces the pixels see."""
        return self._pack.draw([objects])

    def local(self, objects: Objects) -> Tensor:
        """Vertices (V, 3) m in their objects' frames."""
        bent = objects.ffd.requires_grad or not torch.equal(objects.ffd, self._base_ffd)
        return self.fleet.local(objects.ffd, objects.size_lhw) if bent else self._base_local

    def brighter(self, objects: Objects) -> Tensor:
        """By how much (V,) the surfaces are brighter than in the photograph, since they turned: see
        `texture.brightened`."""
        turned = objects.yaw.requires_grad or not torch.equal(objects.yaw, self._base_yaw)
        if not objects.source or not turned:
            return self._like.new_zeros(self.fleet.owner.shape[0])
        if self._lit is None:
            self._lit = self._sun_on(self._base_yaw)
        sunlight = self.fleet.spread(self._sunlight)
        then = texture.AMBIENT[0] + texture.AMBIENT[1] * (0.5 - 0.5 * self._smooth[:, 1]) + sunlight * self._lit
        return texture.brightened(sunlight * (self._sun_on(objects.yaw) - self._lit) / then, self.fleet.paint)

    def _sun_on(self, yaw: Tensor) -> Tensor:
        """How squarely (V,) the sun meets the surfaces of objects that stand at yaw (N,)."""
        sun = self.scene.environment.sun.to(self._like).expand(len(yaw), 3)
        x, y, z = self.fleet.spread(surfaces.rotate(sun, -yaw)).unbind(-1)
        # Written out: sums along an axis may differ in their last bit with the number of rows.
        soft = self._smooth[:, 0] * x + self._smooth[:, 1] * y + self._smooth[:, 2] * z
        return texture.sunward(soft)

    def ground(self, objects: Objects) -> Tensor:
        """Clip coordinates (4N, 3) of the corners of the shadows' patches.

        A patch turns with its object, but what the sun casts beyond the footprint stays on the side away from the
        sun: the patch is sheared the more, the farther out.
        """
        ground = self.scene.environment.ground
        offset = surfaces.sun_offset(self.scene.environment.sun, objects.yaw, self._size[:, 1])
        corners = self._corners + self._outwards[..., None] * (offset - self._sun_offset)[:, None]
        corners = surfaces.place_on_ground(corners, objects.yaw, objects.translation, ground)
        return surfaces.project_vertices(corners, self.scene.camera)

    def shadowless(self) -> list[bool]:
        """Which objects darken no ground."""
        source = self.scene.objects.source
        count = len(self.scene.objects)
        return [not self.settings.shadows or (bool(source) and source[i].shadow is None) for i in range(count)]

    def reach_px(self, objects: Objects) -> list[float]:
        """How far the halo of each object reaches beyond its mesh."""
        if not objects.source:
            return [0.0] * len(objects)
        distance = surfaces.project_vertices(objects.translation.detach(), self.scene.camera)[:, 2].clamp(min=1.0)
        return (self._halo / distance).clamp(max=HALO_MAX_PX).tolist()

    def layers(self, objects: Objects) -> Layers:
        """The objects drawn one by one, not yet blended."""
        return self._pack.layers([objects])[0]

    def reference_layers(self, objects: Objects, drawn: Drawn) -> Layers:
        """`layers` in plain torch."""
        rows = self._rows(drawn, bool(objects.source))
        size = drawn.mesh.layout.size
        if objects.source:
            shaded = self._photographed_rows(objects, drawn, rows)
        else:
            own = self._mesh_attributes(drawn, rows, self._own_attributes(objects, drawn.geometry))
            colour = self._own_colour(rows.xy, rows.owner, own).clamp(0.0, 1.0)
            shaded = _Shaded(colour, torch.ones_like(own[:, 8]), own[:, 8], own[:, 6], own[:, 9])
        colour, depth = shaded.colour, shaded.depth
        if _active(objects.texture_code):
            code, base = objects.texture_code.index_select(0, rows.owner), self.paint_lightness[rows.owner]
            colour = texture.apply_texture_code(colour, shaded.opacity, code, shaded.paint, shaded.height, base)
        opacity = shaded.opacity * rows.share
        inverse = (opacity / depth.clamp(min=verbs.NEAR_M))[:, None]
        packed = torch.cat([colour * rows.share[:, None], inverse], dim=1)
        z = torch.full_like(drawn.mesh.depth, torch.inf).scatter_reduce(
            0, rows.pixel, depth.detach(), "amin", include_self=True
        )
        return Layers(
            drawn.mesh.layout,
            packed.new_zeros(size, 4).index_add(0, rows.pixel, packed),
            opacity.new_zeros(size).index_add(0, rows.pixel, opacity),
            z,
            drawn.ground_layout,
            self._shadow_factors(objects, drawn),
        )

    def _rows(self, drawn: Drawn, with_halo: bool) -> _Rows:
        layout = drawn.mesh.layout
        count = layout.rects.shape[0]
        covered = drawn.coverage.detach()
        hit = drawn.mesh.face >= 0
        mesh_pixel = (hit | (covered > 0)).nonzero()[:, 0]
        owner = layout.draw()
        pixel, share = mesh_pixel, drawn.coverage.index_select(0, mesh_pixel)
        counts = torch.bincount(owner[mesh_pixel], minlength=count)
        anchor = mesh_pixel[:0]
        if with_halo:
            nearest = drawn.nearest()
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
        fringe = _Fringe.of(layout, hit, drawn.coverage, mesh_pixel, owner)
        return _Rows(pixel, rows_owner, xy.to(self._like), share, counts, mesh_pixel.shape[0], fringe, anchor)

    def _mesh_attributes(self, drawn: Drawn, rows: _Rows, attributes: Tensor) -> Tensor:
        """Attributes (V, K) of the mesh at the mesh rows (Rm, K), continued over the fringe."""
        dense = verbs.interpolate(
            drawn.mesh, drawn.geometry.clip, self.fleet.faces, attributes, self.settings.backend
        )
        return rows.fringe.fill(dense.index_select(0, rows.pixel[: rows.mesh_rows]))

    def _photographed_rows(self, objects: Objects, drawn: Drawn, rows: _Rows) -> _Shaded:
        """All rows, coloured by the photograph, and completed where it did not see the mesh."""
        geometry, base, fleet, m = drawn.geometry, self._base, self.fleet, rows.mesh_rows
        turn = torch.stack(
            [geometry.cos - base.cos, base.cos, fleet.paint, self._height, geometry.brighter], dim=1
        )

        attributes = torch.cat([base.clip - geometry.clip, base.clip[:, 2:], turn], dim=1)
        dense = verbs.interpolate(drawn.mesh, geometry.clip, fleet.faces, attributes, self.settings.backend)
        mesh = rows.fringe.fill(_lookup(dense.index_select(0, rows.pixel[:m]), rows.xy[:m]))
        move, rest = torch.cat([mesh, mesh.index_select(0, rows.anchor)]).split([2, 7], dim=1)
        z_then, z_now, turned, cos_then, paint, up, brighter = rest.unbind(1)

        assert self._texels is not None
        uv = rows.xy + move
        seen = self._texels.sample(uv, rows.counts, self.settings.backend, "clamp")
        rgb, rest = seen.split([3, texture.CHANNELS - 3], dim=1)
        alpha, hidden, outline, z_seen, support = rest.unbind(1)
        rgb = texture.relit(rgb, brighter)
        clear = 1.0 - smoothstep(hidden, 0.0, 1.0)
        inside = texture.inside_weight(uv, *self._frame_hw)
        visible = inside * clear
        facing = texture.facing_weight(turned, cos_then, paint)
        weight = facing * visible
        if bool((inside.detach() < 1.0).any()):
            near = texture.inside_weight(uv, *self._frame_hw, texture.EXTENDED_PX) * smoothstep(alpha, 0.5, 0.95)
            weight = weight + facing * (1.0 - inside) * near * clear
        weight = weight * (1.0 - smoothstep(z_then - z_seen, *texture.DEPTH_TOLERANCE_M))
        kept = smoothstep(outline[m:], 0.0, 1.0) * texture.outline_weight(turned[m:])
        weight = torch.cat([weight[:m], weight[m:] * kept])
        rim = 1.0 - smoothstep(cos_then[:m], *texture.RIM)
        opened = smoothstep(turned[:m], *texture.OPEN_TURN) * rim * (1.0 - alpha[:m]).clamp(min=0.0)
        # Where the photograph shows that there is no vehicle, the mesh sticks out of it: a visual hull.
        empty = visible[:m] * (1.0 - smoothstep(support[:m], 0.1, 0.9))
        # What opens up is as opaque as the inside, in its own colour, where there is enough of it to tell.
        closed = weight[:m] * opened * (1.0 - empty) * smoothstep(alpha[:m], *texture.OPEN_ALPHA)
        gain = torch.cat([closed / alpha[:m].clamp(min=texture.OPEN_ALPHA[0]), torch.zeros_like(alpha[m:])])
        fill = (1.0 - weight[:m]) * (1.0 - empty)
        colour, opacity = (weight + gain)[:, None] * rgb, (weight + gain) * alpha
        need = (fill != 0.0).nonzero()[:, 0]
        if need.numel():
            filled = fill.index_select(0, need)
            completed = self._completion(objects, drawn, rows, need, cos_then[:m] + turned[:m])
            colour = colour.index_add(0, need, filled[:, None] * completed)
            opacity = opacity.index_add(0, need, filled)
        assert self.regions is not None
        if _active(objects.texture_code) and bool(self.regions.known.any()):
            unseen = torch.cat([fill, torch.zeros_like(alpha[m:])])
            found = self.regions.texels.sample_parts(uv, rows.counts, self.settings.backend)[:, 0]
            paint = texture.paint_share(paint, found, unseen, self.regions.known[rows.owner])
        return _Shaded(colour, opacity, z_now, paint, up)

    def _own_attributes(self, objects: Objects, geometry: _Geometry) -> Tensor:
        """(V, 10): colour (3), normal (3), paint, glass, depth m, height."""
        fleet = self.fleet
        normals = surfaces.rotate(self._sharp, fleet.spread(objects.yaw))
        parts = (fleet.paint, fleet.glass, geometry.clip[:, 2], self._height)
        return torch.cat([fleet.colours, normals, torch.stack(parts, dim=1)], dim=1)

    def _own_colour(self, xy: Tensor, owner: Tensor, own: Tensor) -> Tensor:
        """The templates' colours (K, 3) in daylight, not clamped, at pixels xy (K, 2) of objects `owner` (K,), by
        `_own_attributes` (K, 10)."""
        sunlight = self._sunlight.index_select(0, owner)
        albedo, normal, sheen, height = own[:, :3], own[:, 3:6], own[:, 6:8], own[:, 9]
        ray = torch.cat([xy, torch.ones_like(xy[:, :1])], dim=1) @ self._unproject.T
        normal = torch.nn.functional.normalize(normal, dim=-1, eps=1e-6)
        to_eye = -torch.nn.functional.normalize(ray, dim=-1)
        sun = self.scene.environment.sun.to(self._like)
        return texture.shade(normal, to_eye, albedo, sheen, height, sun, sunlight)

    def _completion(self, objects: Objects, drawn: Drawn, rows: _Rows, need: Tensor, cos_now: Tensor) -> Tensor:
        """Colours (K, 3) of mesh rows `need` that the photograph did not see: the car's other side, or the
        template in the car's own finish.

        cos_now: (Rm,) towards the camera.
        """
        own = self._own_attributes(objects, drawn.geometry)
        mirror = torch.cat([self._mirror_clip, self._mirror_cos[:, None]], dim=1)
        both = self._mesh_attributes(drawn, rows, torch.cat([own, mirror, self.finish], dim=1))[need]
        gain, lift = both[:, 14:17], both[:, 17:]
        colour = texture.finished(self._own_colour(rows.xy[need], rows.owner[need], both[:, :10]), gain, lift)
        clip, cos_then = both[:, 10:13], both[:, 13]
        z = clip[:, 2]
        safe = z.clamp(min=0.1)
        uv = clip[:, :2] / safe[:, None]
        counts = torch.bincount(rows.owner[need], minlength=rows.counts.shape[0])
        assert self._texels is not None
        seen = self._texels.sample(uv, counts, self.settings.backend, "clamp")
        height, width = self._frame_hw
        weight = (
            texture.inside_weight(uv, height, width)
            * (1.0 - smoothstep(seen[:, 4], 0.0, 1.0))
            * smoothstep(seen[:, 3], 0.5, 0.95)
            * (1.0 - smoothstep(z - seen[:, 6], *texture.DEPTH_TOLERANCE_M))
            * texture.facing_weight(cos_now[need] - cos_then, cos_then, both[:, 6])
            * smoothstep(cos_then, 0.05, 0.2)
            * (1.0 - smoothstep(seen[:, 5], *texture.MIRRORED_RIM))
        )
        straight = seen[:, :3] / seen[:, 3:4].clamp(min=0.4)
        return colour + weight[:, None] * (straight.clamp(0.0, 1.0) - colour)

    @torch.no_grad()
    def photographed_paint(self) -> list[Crop]:
        """For each object, where its foreground is: Crop (1, h, w), 1 where the mesh at its place in the
        photograph is paint, 0 where not; beyond the mesh as at its nearest pixel."""
        objects = _photographed(self.scene.objects)
        drawn = self.draw(objects)
        dense = verbs.interpolate(
            drawn.mesh, drawn.geometry.clip, self.fleet.faces, self.fleet.paint[:, None], self.settings.backend
        )
        out = []
        for i, (packed, size) in enumerate(drawn.mesh.layout.spans()):
            place = objects.source[i].foreground
            h, w = place.values.shape[1:]
            x0, y0 = drawn.mesh.layout.rects[i, :2].tolist()
            known = (drawn.mesh.face[packed] >= 0).reshape(size)
            if not h or not w or not bool(known.any()):
                out.append(Crop(self._like.new_zeros(1, h, w), place.x0, place.y0))
                continue
            values = texture.continued(dense[packed].T.reshape(1, *size), known)
            rows = (torch.arange(h) + place.y0 - y0).clamp(0, size[0] - 1)
            columns = (torch.arange(w) + place.x0 - x0).clamp(0, size[1] - 1)
            out.append(Crop(values[:, rows][:, :, columns], place.x0, place.y0))
        return out

    @torch.no_grad()
    def samples(self) -> list[finish.Samples]:
        """What the photograph shows of each object, beside its template in daylight: a row a pixel, of large
        objects about `_MOST_SAMPLES` pixels, spread evenly."""
        objects, drawn = _photographed(self.scene.objects), self._drawn
        if drawn is None:
            drawn = self.draw(objects)
        layout, count = drawn.mesh.layout, len(objects)
        pixel = (drawn.mesh.face >= 0).nonzero()[:, 0]
        owner, xy = layout.draw()[pixel], layout.pixels()[pixel].to(self._like)
        assert self._texels is not None
        counts = torch.bincount(owner, minlength=2 * count)
        seen = self._texels.sample(xy, counts, self.settings.backend, "clamp")
        weight = smoothstep(seen[:, 3], 0.9, 0.99) * (1.0 - smoothstep(seen[:, 4], 0.0, 1.0))
        weight = weight * (1.0 - smoothstep(seen[:, 5], 0.0, 1.0))
        plain = (weight > 0.0).nonzero()[:, 0]
        # By their places within the object, so that others beside it change nothing.
        size = torch.bincount(owner[plain], minlength=count)
        place = torch.arange(len(plain), device=plain.device) - (size.cumsum(0) - size)[owner[plain]]
        chosen = plain[(place.double() * _GOLDEN) % 1.0 < (_MOST_SAMPLES / size.clamp(min=1))[owner[plain]]]
        pixel, owner, xy, seen, weight = (v[chosen] for v in (pixel, owner, xy, seen, weight))
        corner = self.fleet.faces[drawn.mesh.face[pixel].long()]
        share = surfaces.weights_at(drawn.geometry.clip[corner], xy).to(self._like)
        own = torch.cat([self._own_attributes(objects, drawn.geometry), drawn.geometry.cos[:, None]], dim=1)
        own = (own[corner] * share[..., None]).sum(dim=1)
        weight = weight * smoothstep(own[:, 10], *texture.SQUARE)
        template = self._own_colour(xy, owner, own[:, :10])
        normal = torch.nn.functional.normalize(own[:, 3:6], dim=-1, eps=1e-6)
        sun = self.scene.environment.sun.to(self._like)
        sky, lit = (texture.daylight(normal, sun, strength) for strength in (0.0, 1.0))
        columns = (corner, share, template, seen[:, :3], sky, lit - sky, weight)
        out = []
        for i, (start, _) in enumerate(self.fleet.vertex_ranges.tolist()):
            mine = (owner == i) & (weight > 0.0)
            vertex, *values = (c[mine].cpu().numpy() for c in columns)
            out.append(finish.Samples(vertex - start, *(v.astype(np.float64) for v in values)))
        return out

    def _shadow_factors(self, objects: Objects, drawn: Drawn) -> Tensor:
        """Factors (Ts, 3) on the ground, of all patches."""
        clip, layout = drawn.geometry.ground_clip, drawn.ground_layout
        assert drawn.ground is not None
        if layout.size == 0:
            return clip.new_zeros(0, 3)
        faces, _, _ = _patches(len(objects), clip.device)
        if not objects.source:
            return (1.0 - self.ground_density(drawn))[:, None].expand(-1, 3)
        base = self._base.ground_clip
        fixed = torch.cat([base - clip, base[:, 2:]], dim=1)
        dense = verbs.interpolate(drawn.ground, clip, faces, fixed, self.settings.backend)
        hit = (drawn.ground.face >= 0).nonzero()[:, 0]
        xy = layout.pixels()[hit].to(self._like)
        wanted = xy + _lookup(dense.index_select(0, hit), xy)[:, :2]
        height, width = self._frame_hw
        # Constant from the border on, where `_darkness` repeats it: clamping two pixels beyond leaves no kink.
        uv = wanted.clamp(min=-2.0).minimum(wanted.new_tensor([width + 1.0, height + 1.0]))
        assert self._shadows is not None
        owner = layout.draw()[hit]
        rect = self._shadows.rects[owner]
        reached = ((uv > rect[:, :2] - 2) & (uv < rect[:, 2:] + 1)).all(dim=1).nonzero()[:, 0]
        hit, uv, wanted = hit[reached], uv.index_select(0, reached), wanted.index_select(0, reached)
        counts = torch.bincount(owner[reached], minlength=len(objects))
        dark = self._shadows.sample(uv, counts, self.settings.backend, "zero")
        dark = dark * texture.inside_weight(wanted, height, width, texture.SHADOW_EXTENDED_PX)[:, None]
        return dark.new_ones(layout.size, 3).index_add(0, hit, -dark)

    def ground_density(self, drawn: Drawn) -> Tensor:
        """How much the objects' boxes darken the pixels (Ts,) of their patches, in [0, 1]."""
        clip = drawn.geometry.ground_clip
        assert drawn.ground is not None
        faces, _, _ = _patches(self._corners.shape[0], clip.device)
        corners = self._corners.reshape(-1, 2).contiguous()
        local = verbs.interpolate(drawn.ground, clip, faces, corners, self.settings.backend)
        owner = drawn.ground_layout.draw()
        density = surfaces.shadow_density(local, self._size[owner], self._sun_offset[owner])
        return density * (drawn.ground.face >= 0)

    def render(self, perturbed: SceneIR) -> Render:
        """The picture of a perturbed scene; with nothing perturbed, the photograph."""
        objects = self.moved(perturbed)
        return self.compose(perturbed, objects, self.layers(objects) if len(objects) else None)

    def moved(self, perturbed: SceneIR) -> Objects:
        """The objects of a perturbed scene in this one's dtype. Raises ShapeError where it has other objects."""
        objects = perturbed.objects
        if len(objects) != len(self.scene.objects):
            raise ShapeError("objects", f"the {len(self.scene.objects)} of the base scene", len(objects))
        moving = {n: getattr(objects, n).to(self._like) for n in ("translation", "yaw", "ffd", "texture_code")}
        return replace(self.scene.objects, **moving)

    def compose(self, perturbed: SceneIR, objects: Objects, layers: Layers | None) -> Render:
        """The picture of drawn objects. perturbed: for its environment; layers: None where there are no
        objects."""
        environment, backend = perturbed.environment, self.settings.backend
        weather, foliage = _active(environment.weather), _active(environment.foliage)
        canvas = self._canvas if weather else self._canvas[:3]
        if foliage:
            changed = replace(self.scene.environment, foliage=environment.foliage.to(self._like))
            canvas = torch.cat([apply_foliage(canvas[:3], changed, self._air, backend), canvas[3:]])
        if self._standing is not None:
            layers = self._standing.before(layers, canvas[:3] - self._canvas[:3] if foliage else None)
        if layers is None:
            with torch.no_grad():
                depth = self.scene.depth.clone()
                number = torch.zeros(self._frame_hw, dtype=torch.int64, device=depth.device)
            opacity: tuple[Crop, ...] = ()
        else:
            factors = layers.shadow
            if weather:
                factors = 1.0 - (1.0 - factors) * shadow_softening(environment.weather.to(self._like))
            order = blend.paint_order(
                objects.size_lhw, objects.yaw, objects.translation, self._centre, self._footprints
            )
            plan = blend.Plan.of(layers.layout, layers.shadow_layout, order)
            what = (factors, layers.colour, layers.opacity, layers.depth)
            canvas, depth, number = blend.composite(canvas, self.scene.depth, what, plan, not weather, backend)
            number = number if self._standing is None else number.masked_fill(number > len(objects), 0)
            opacity = tuple(
                Crop(crop.reshape(1, *size), window[1].start, window[0].start)
                for crop, (_, window, size) in zip(
                    layers.opacity.clamp(0.0, 1.0).split(plan.sizes), plan.spans, strict=True
                )
            )[: len(objects)]
        image = canvas
        if weather:
            changed = replace(self.scene.environment, weather=environment.weather.to(self._like))
            image = apply_weather(canvas[:3], canvas[3], changed, self._air, backend)
        if weather or layers is None:
            image = blend.clamp_colour(image[:3])
        return Render(image, depth, number, opacity)


class _Pack:
    """Compositors whose objects are drawn in one go: each stage passes once over all pixels, of however many
    scenes.

    A compositor may occur more than once, for several perturbations of one scene.
    """

    def __init__(self, members: Sequence[Compositor]) -> None:
        self._members = tuple(members)
        self._backend: verbs.Backend = members[0].settings.backend
        self._rig = fused.Rig.pack([m.rig for m in members])
        self._faces, self._vertex_ranges, self._face_ranges = Fleet.joined([m.fleet for m in members])
        self._ranges = torch.tensor(self._face_ranges, dtype=torch.int64, device=self._faces.device).reshape(-1, 2)
        closed = [s.closed for m in members for s in m.fleet.surfaces]
        self._cull = torch.tensor(closed, dtype=torch.bool, device=self._faces.device)
        self._counts = [len(m.scene.objects) for m in members]
        cameras = [m.scene.camera for m in members]
        self._frames_hw = [
            (c.height, c.width) for c, n in zip(cameras, self._counts, strict=True) for _ in range(n)
        ]
        self._patches = _patches(sum(self._counts), self._faces.device)
        self._patch_ranges = [[4 * i, 4 * i + 4] for i in range(sum(self._counts))]
        self._patch_faces = [[2 * i, 2 * i + 2] for i in range(sum(self._counts))]
        self._shadowless = [s for m in members for s in m.shadowless()]
        self._fixed: fused.Fixed | None = None

    def place(self, objects: Sequence[Objects]) -> _Geometry:
        """Where the vertices of perturbed objects, of each member, come to lie."""
        local = _joined([m.local(o) for m, o in zip(self._members, objects, strict=True)])
        yaw, translation = _joined([o.yaw for o in objects]), _joined([o.translation for o in objects])
        ground = _joined([m.ground(o) for m, o in zip(self._members, objects, strict=True)])
        if self._backend == "warp" and len(yaw):
            clip, cos = fused.place(self._rig, local, yaw, translation)
        else:
            clip, cos = fused.reference_place(self._rig, local, yaw, translation)
        brighter = _joined([m.brighter(o) for m, o in zip(self._members, objects, strict=True)])
        return _Geometry(clip, cos, ground, brighter)

    def reach_px(self, objects: Sequence[Objects]) -> list[float]:
        """How far the halo of each object reaches beyond its mesh."""
        return [r for m, o in zip(self._members, objects, strict=True) for r in m.reach_px(o)]

    def draw(self, objects: Sequence[Objects], with_ground: bool = True) -> Drawn:
        """Find which surfaces the pixels see; the draws are the members' objects, one after the other."""
        geometry, backend, reach = self.place(objects), self._backend, self.reach_px(objects)
        rects = surfaces.crop_rects(
            geometry.clip, self._faces, self._vertex_ranges, self._face_ranges, self._frames_hw,
            [2.0 + r for r in reach],
        )  # fmt: skip
        layout = verbs.Layout.of(rects)
        mesh = verbs.rasterize(geometry.clip, self._faces, self._ranges, layout, backend, cull=self._cull)
        coverage = verbs.antialias(mesh, geometry.clip, self._faces, backend=backend)
        faces, _, face_ranges = self._patches
        patch_rects = surfaces.crop_rects(
            geometry.ground_clip, faces, self._patch_ranges, self._patch_faces, self._frames_hw, [0.0] * len(reach)
        )
        patch_rects[torch.tensor(self._shadowless, dtype=torch.bool)] = 0
        ground_layout = verbs.Layout.of(patch_rects)
        ground = None
        if with_ground:
            ground = verbs.rasterize(geometry.ground_clip, faces, face_ranges, ground_layout, backend)
        return Drawn(geometry, mesh, coverage, tuple(reach), ground_layout, ground)

    def layers(self, objects: Sequence[Objects]) -> list[Layers]:
        """The layers of each member."""
        fixed = [m.fixed for m in self._members]
        known = [f for f in fixed if f is not None]
        if len(known) < len(fixed):
            return [m.reference_layers(o, m.draw(o)) for m, o in zip(self._members, objects, strict=True)]
        if len(self._members) > 1 and self._fixed is None:
            self._fixed = fused.Fixed.pack(known)
        drawn = self.draw(objects, with_ground=False)
        code = None
        if any(_active(o.texture_code) for o in objects):
            regions = [m.regions for m in self._members]
            code = fused.Code(
                _joined([o.texture_code for o in objects]),
                _joined([m.paint_lightness for m in self._members]),
                Regions.joined([r for r in regions if r is not None]),
            )
        yaw = _joined([o.yaw for o in objects])
        whole = self._fixed or known[0]
        colour, opacity, depth, shadow = fused.photographed(whole, drawn, drawn.reach_px, yaw, code)
        if len(self._members) == 1:
            return [Layers(drawn.mesh.layout, colour, opacity, depth, drawn.ground_layout, shadow)]
        layouts, grounds = (
            [verbs.Layout.of(rects) for rects in whole_layout.rects.split(self._counts)]
            for whole_layout in (drawn.mesh.layout, drawn.ground_layout)
        )
        sizes, ground_sizes = [part.size for part in layouts], [part.size for part in grounds]
        parts = zip(
            layouts, colour.split(sizes), opacity.split(sizes), depth.split(sizes), grounds,
            shadow.split(ground_sizes), strict=True,
        )  # fmt: skip
        return [Layers(*part) for part in parts]


def _joined(parts: Sequence[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(list(parts))


@lru_cache(maxsize=2)
def _pack(members: tuple[Compositor, ...]) -> _Pack:
    return _Pack(members)


def render_batch(pairs: Sequence[tuple[Compositor, SceneIR]]) -> list[Render]:
    """The picture of each perturbed scene by its compositor, their objects drawn in one go where they can be.

    A compositor may occur several times. The pictures are those that `Compositor.render` gives, one by one.
    """
    members = tuple(c for c, _ in pairs)
    together = len(pairs) > 1 and all(c.fixed is not None for c in members)
    if not together:
        return [c.render(scene) for c, scene in pairs]
    objects = [c.moved(scene) for c, scene in pairs]
    layers = _pack(members).layers(objects)
    return [c.compose(p, o, part) for (c, p), o, part in zip(pairs, objects, layers, strict=True)]


def _photographed(objects: Objects) -> Objects:
    """The objects at the geometry of their sources."""
    if not objects.source:
        return objects
    names = ("translation", "yaw", "size_lhw", "ffd")
    return replace(
        objects, **{n: torch.stack([getattr(s, n) for s in objects.source]).to(objects.yaw) for n in names}
    )


def _darkness(shadow: Crop | None, frame_hw: tuple[int, int]) -> Crop:
    """What a shadow takes away, (3, h, w), continued a little beyond the frame, since the lookups' kernel reaches
    there."""
    if shadow is None or shadow.values.numel() == 0:
        return Crop(torch.zeros(3, 0, 0), 0, 0)
    h, w = shadow.values.shape[1:]
    dark = replace(shadow, values=1.0 - shadow.values)
    rect = (shadow.x0 - 4, shadow.y0 - 4, shadow.x0 + w + 4, shadow.y0 + h + 4)
    return Crop(texture.crop_of(dark, rect, frame_hw), rect[0], rect[1])


def _patches(count: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Faces (2N, 3), vertex and face ranges (N, 2) of the shadows' patches, four corners each."""
    start = torch.arange(count, device=device)[:, None]
    faces = (4 * start + torch.tensor([0, 1, 2, 0, 2, 3], device=device)).reshape(-1, 3)
    return faces, torch.cat([4 * start, 4 * start + 4], dim=1), torch.cat([2 * start, 2 * start + 2], dim=1)


def _lookup(attributes: Tensor, xy: Tensor) -> Tensor:
    """From interpolated clip differences to where the photograph shows this point.

    attributes (R, 4 + K): clip then minus now (3), w then, and K more; xy (R, 2) px
    -> (R, 4 + K): displacement in px (2), w then, w now, and the K more. A point that was behind the camera is
    looked up far outside the photograph.
    """
    delta, then = attributes[:, :3], attributes[:, 3:4]
    before = then > verbs.NEAR_M
    safe = torch.where(before, then, torch.ones_like(then))
    moved = (delta[:, :2] - xy * delta[:, 2:]) / safe
    moved = torch.where(before, moved, torch.full_like(moved, 1e5))
    return torch.cat([moved, then, then - delta[:, 2:], attributes[:, 4:]], dim=1)


def _active(code: Tensor) -> bool:
    """Whether a code has to be applied: it is not 0, or somebody wants its gradient."""
    return code.requires_grad or bool((code.detach() != 0).any())
