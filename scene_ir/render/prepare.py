"""Everything about a scene that no parameter affects, computed once, and the z-buffers of its perturbations.

A vehicle's *mesh* shows the photograph where the photograph saw that point, and completes what it did not see. Its
*halo*, the pixels around the mesh, carries the part of the matte beyond the mesh, and moves with the nearest piece
of outline. A pixel's lookup is `pixel + displacement`, with the displacement interpolated from the difference of
clip coordinates then and now: with nothing perturbed it is exactly zero, every lookup hits a pixel centre, and the
picture is the photograph.

Shapes: N objects, V vertices, T packed pixels of all objects' crops.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from scene_ir.geometry import to_clip
from scene_ir.meshes.lod import level_of_detail
from scene_ir.raster import verbs
from scene_ir.raster.layout import TensorCache
from scene_ir.render import blend, channels, finish, model, surfaces, texture
from scene_ir.render.environment import (
    PerturbedSun,
    compute_closed_sky_gain,
    compute_crown_maps,
    sky_colour,
)
from scene_ir.render.lamps import VehicleLamps, find_lamps
from scene_ir.render.night import NightMaps, compute_night_maps
from scene_ir.render.surfaces import ObjectSurfaces, TemplateSurface, VertexPlacement
from scene_ir.render.texture import PaintRegions, PhotographTexels, smoothstep
from scene_ir.types import Crop, Environment, Objects, SceneIR, convert_scene, to_host

MAX_HALO_PX = 64.0
"""Largest reach of a halo: of a car that fills the picture's height, a sixth."""


_MAX_SAMPLES, _GOLDEN = 5000, 0.6180339887
"""Pixels of one object from which its finish is measured, several per vertex; golden-section steps spread them."""
_PATCH_MARGIN_PX = 4
"""Margin of ground around a photographed shadow: the reach of the lookup's kernel, plus two pixels."""


@dataclass(frozen=True, slots=True)
class RenderSettings:
    """Settings of the renderer."""

    backend: verbs.Backend = "warp"
    """`warp` (float32, fast) or `reference` (plain torch in the scene's dtype, for gradient checks)."""
    shadows: bool = True
    """Whether vehicles darken the ground."""
    lod: bool = True
    """Whether meshes are simplified to their size in pixels; use the value with which the scene was de-rendered.
    """


@dataclass(frozen=True, slots=True)
class ObjectLayers:
    """The objects of one scene, drawn but not yet blended."""

    layout: verbs.PixelLayout
    """Crops of the objects."""
    colour: Tensor
    """(T, 4) premultiplied RGB and opacity / depth."""
    opacity: Tensor
    """(T,)."""
    depth: Tensor
    """(T,) m."""
    shadow_layout: verbs.PixelLayout
    """Crops of the shadows."""
    shadow: Tensor
    """(Ts, 3) factors on the ground."""


@dataclass(frozen=True, slots=True)
class OccluderLayers:
    """What stands in front of vehicles, as layers after theirs."""

    footprints: np.ndarray
    """(K, 4, 2) m, see `blend`."""
    layout: verbs.PixelLayout
    """Crops of the occluders."""
    colour: Tensor
    """(T, 4) premultiplied RGB and opacity / depth."""
    opacity: Tensor
    """(T,)."""
    depth: Tensor
    """(T,) m."""
    pixel: Tensor
    """(T,) int64, frame pixel of each packed pixel."""

    @classmethod
    def from_scene(cls, scene: SceneIR, like: Tensor) -> OccluderLayers:
        """Layers of a scene's occluders in the dtype and on the device of `like`."""
        texels = PhotographTexels.from_crops([f.foreground for f in scene.occluders], like)
        layout = verbs.PixelLayout.from_rects(texels.rects)
        rgba, draw = texels.values, layout.draw_index()
        depth = like.new_tensor([f.depth_m for f in scene.occluders])[draw]
        colour = torch.cat([rgba[:, :3], rgba[:, 3:] / depth[:, None]], dim=1)
        x, y = layout.pixel_xy().unbind(1)
        footprints = blend.occluder_footprints(scene.occluders, scene.camera.matrix)
        return cls(footprints, layout, colour, rgba[:, 3], depth, y * scene.camera.width + x)

    def append_to(self, layers: ObjectLayers | None, change: Tensor | None) -> ObjectLayers:
        """Layers of objects, if any, followed by these. change: (3, H, W) change of the background by the season,
        applied to these too.
        """
        colour = self.colour
        if change is not None:
            moved = change.flatten(1)[:, self.pixel].T * self.opacity[:, None]
            colour = torch.cat([colour[:, :3] + moved, colour[:, 3:]], dim=1)
        if layers is None:
            nothing = verbs.PixelLayout.from_rects(self.layout.rects[:0])
            return ObjectLayers(self.layout, colour, self.opacity, self.depth, nothing, colour[:0, :3])
        return ObjectLayers(
            verbs.PixelLayout.from_rects(torch.cat([layers.layout.rects, self.layout.rects])),
            torch.cat([layers.colour, colour]),
            torch.cat([layers.opacity, self.opacity]),
            torch.cat([layers.depth, self.depth]),
            layers.shadow_layout,
            layers.shadow,
        )


@dataclass(frozen=True, slots=True)
class PlacedGeometry:
    """Vertices placed in the camera frame."""

    clip: Tensor
    """(V, 3) clip coordinates of the meshes."""
    facing_cos: Tensor
    """(V,) cosine between welded normals and the direction to the camera."""
    patch_clip: Tensor
    """(4N, 3) clip coordinates of the shadows' patches."""
    brightening: Tensor
    """(V,) change since the photograph, see `texture.limit_brightening`."""
    lights: Tensor | None = None
    """(N, 4) direction and strength of the sun on each object; fast kernels only."""
    pixel_to_patch: Tensor | None = None
    """(N, 3, 3) float64, from a pixel (x, y, 1) to (s, t, 1) / w on the patch, s and t in [0, 1]; fast kernels
    only.
    """


@dataclass(frozen=True, slots=True)
class VisibleSurfaces:
    """What the z-buffers found for one perturbation."""

    geometry: PlacedGeometry
    """Placed vertices."""
    mesh: verbs.Fragments
    """Visible faces of the meshes."""
    coverage: Tensor
    """(T,) coverage by the meshes."""
    reach_px: tuple[float, ...]
    """Reach of each object's halo, px."""
    patch_layout: verbs.PixelLayout
    """Crops of the shadows' patches."""
    patch_fragments: verbs.Fragments | None
    """Visible patches; None for the fast kernels, which need none."""

    def nearest_hits(self) -> Tensor:
        """(T,) int64, nearest packed pixel that the same object's mesh hits, -1 beyond its halo."""
        return surfaces.nearest_hits(self.mesh, self.reach_px)


class PreparedScene:
    """One scene, prepared for its perturbations: everything that no parameter affects.

    A perturbed scene may differ from `scene` in objects.translation, yaw, size_lhw, ffd, texture_code and in
    environment.weather, foliage, light. With backend `warp` the scene is processed in float32.
    """

    def __init__(
        self,
        scene: SceneIR,
        settings: RenderSettings | None = None,
        hidden: Sequence[Tensor] | None = None,
        whole_patches: bool = False,
    ) -> None:
        """Prepare a scene.

        Args:
            scene: The scene.
            settings: Settings of the renderer.
            hidden: One (H, W) per object, where nearer objects covered it; computed from the mattes by default.
            whole_patches: Keep all ground that a vehicle may darken, not only what its source's shadow darkens.
        """
        self.settings = settings or RenderSettings()
        self.backend: verbs.Backend = self.settings.backend
        if self.backend == "warp":
            scene = convert_scene(scene, torch.float32)
        self.scene = scene
        self._whole_patches = whole_patches
        self.like = scene.photograph
        self.frame_hw = (scene.camera.height, scene.camera.width)
        self.centre = surfaces.camera_centre(scene.camera.matrix).to(self.like)
        self.unproject = torch.linalg.inv(scene.camera.matrix[:, :3]).to(self.like)
        self.occluders = OccluderLayers.from_scene(scene, self.like) if scene.occluders else None
        self.footprints = None if self.occluders is None else self.occluders.footprints
        with torch.no_grad():
            self._prepare(scene.objects, hidden)

    def _prepare(self, objects: Objects, hidden: Sequence[Tensor] | None) -> None:
        """Compute what depends on the unperturbed objects: normals, and the photograph's content."""
        base = at_photographed_pose(objects)
        meshes = [self.scene.meshes[int(i)] for i in objects.mesh_index]
        if self.settings.lod:
            heights = self._heights_px(base)
            meshes = [level_of_detail(mesh, height) for mesh, height in zip(meshes, heights, strict=True)]
        picked = [TemplateSurface.from_mesh(mesh, self.like.dtype) for mesh in meshes]
        self.surfaces = ObjectSurfaces.from_surfaces(picked, self.like)
        local = self.surfaces.local_vertices(base.ffd, base.size_lhw)
        self.sharp_normals, self.smooth_normals = self.surfaces.normals(local)
        inflation = self.like.new_tensor([s.inflation for s in objects.source] or [0.0] * len(objects))
        self.halo = inflation * self.scene.camera.matrix[0, 0].to(self.like)
        self.base_shadow_offset = surfaces.shadow_offset(self.scene.environment.sun, base.yaw, base.size_lhw[:, 1])
        self.patch_corners = surfaces.shadow_corners(base.size_lhw, self.base_shadow_offset)
        if objects.source and not self._whole_patches:
            self.patch_corners = self._trimmed_corners(objects, base)
        self.corner_outwardness = surfaces.outwardness(self.patch_corners, base.size_lhw, self.base_shadow_offset)
        self.base_yaw = base.yaw
        self.sunlight = self.like.new_tensor([s.sunlight for s in objects.source] or [model.SUNLIGHT] * len(base))
        self.placement: VertexPlacement | None = None
        if self.backend == "warp" and len(base):
            follows = self.sunlight if objects.source else torch.zeros_like(self.sunlight)
            environment = self.scene.environment
            self.placement = VertexPlacement.from_objects(
                self.surfaces, base, self.smooth_normals, self.scene.camera, environment.sun, follows
            )
        self.base_size_lhw = base.size_lhw
        self._base_ffd, self._base_local = base.ffd, local
        # A weak reference: a cycle would keep each compositor and its texels alive until garbage collection.
        self.batch = SceneBatch([weakref.proxy(self)])
        self.base_geometry = self._place(base)
        self.vertex_height = torch.cat([-s.unit[:, 1] for s in picked]) if picked else self.like.new_zeros(0)
        self.texels, self.shadows, self.regions = None, None, None
        self._base_visible: VisibleSurfaces | None = None  # until the finish is computed
        self.paint_lightness = self._base_lightness(objects)
        if objects.source:
            self._prepare_sources(objects, base, hidden)

    @cached_property
    def air(self) -> Tensor:
        """Colour (3,) of the air, see `environment.sky_colour`."""
        return sky_colour(self.scene.photograph, self.scene.environment.sky)

    @cached_property
    def canvas(self) -> Tensor:
        """Background and its inverse depth (4, H, W)."""
        depth = self.scene.depth
        inverse = torch.where(torch.isfinite(depth), 1.0 / depth, torch.zeros_like(depth))
        return torch.cat([self.scene.background, inverse.to(self.like)[None]])

    def _trimmed_corners(self, objects: Objects, base: Objects) -> Tensor:
        """The patches (N, 4, 2) m, cut down to what the photographed shadows darken."""
        height, width = self.frame_hw
        corners = self.patch_corners.clone()
        for i, source in enumerate(objects.source):
            if source.shadow is None or source.shadow.values.numel() == 0:
                continue
            rows, columns = (source.shadow.values < 1.0).any(dim=0).nonzero().unbind(dim=1)
            x, y = columns + source.shadow.x0, rows + source.shadow.y0
            margin = _PATCH_MARGIN_PX
            if not len(x) or int(x.min()) < margin or int(y.min()) < margin:
                continue  # a shadow cut by the border continues beyond it
            if int(x.max()) >= width - margin or int(y.max()) >= height - margin:
                continue
            steps = x.new_tensor([[-margin, -margin], [margin, -margin], [-margin, margin], [margin, margin]])
            pixels = (torch.stack([x, y], dim=1)[:, None] + steps).reshape(-1, 2).to(self.like)
            ground_points = surfaces.pixels_to_ground(
                pixels,
                self.unproject,
                self.centre,
                base.translation[i],
                base.yaw[i],
                self.scene.environment.ground,
            )
            if ground_points is None:
                continue
            low = torch.maximum(ground_points.amin(dim=0), corners[i].amin(dim=0))
            high = torch.minimum(ground_points.amax(dim=0), corners[i].amax(dim=0))
            if bool((high > low).all()):
                corners[i] = surfaces.rectangle_corners(low, high)
        return corners

    def _heights_px(self, objects: Objects) -> list[float]:
        """Lower bounds of the objects' heights in the image at their nearest point."""
        middle = surfaces.project_vertices(objects.translation.detach(), self.scene.camera)[:, 2]
        nearest = (middle - 0.5 * objects.size_lhw[:, [0, 2]].norm(dim=1)).clamp(min=1.0)
        return (self.scene.camera.matrix[1, 1].to(nearest) * objects.size_lhw[:, 1] / nearest).tolist()

    def _prepare_sources(self, objects: Objects, base: Objects, hidden: Sequence[Tensor] | None) -> None:
        drawn = self.find_visible(base)
        self._base_visible = drawn
        mirrored = self.surfaces.place(
            self.surfaces.local_vertices(base.ffd, base.size_lhw, mirrored=True), base.yaw, base.translation
        )
        self.mirror_clip = surfaces.project_vertices(mirrored, self.scene.camera)
        flipped = surfaces.rotate_y(
            self.smooth_normals * self.like.new_tensor([1.0, 1.0, -1.0]), base.yaw[self.surfaces.owner]
        )
        self.mirror_cos = surfaces.facing_cosine(mirrored, flipped, self.centre)
        order = blend.paint_order(base.size_lhw, base.yaw, base.translation, self.centre, self.footprints)
        nearer = [occluder.foreground for occluder in (*objects.source, *self.scene.occluders)]
        mattes = [replace(crop, values=crop.values[3:]) for crop in nearer]
        crops = []
        rects = drawn.mesh.layout.rects.tolist()
        for i, (packed, size) in enumerate(drawn.mesh.layout.spans()):
            before = [mattes[j] for j in order[order.index(i) + 1 :]]
            unseen = hidden[i] if hidden else texture.occlusion_map(before, self.frame_hw, self.like)
            x0, y0, x1, y1 = rects[i]
            if x1 <= x0:
                crops.append(Crop(self.like.new_zeros(channels.TEXEL, 0, 0), 0, 0))
                continue
            depth = Crop(drawn.mesh.depth[packed].reshape(1, *size), x0, y0)
            crops.append(texture.build_texels(objects.source[i], depth, unseen, (x0, y0, x1, y1), self.frame_hw))
        self.texels = PhotographTexels.from_crops(crops + crops, self.like)
        self.shadows = PhotographTexels.from_crops(
            [_shadow_darkness(s.shadow, self.frame_hw) for s in objects.source], self.like
        )
        blank = Crop(self.like.new_zeros(1, 0, 0), 0, 0)
        self.regions = PaintRegions(
            PhotographTexels.from_crops([s.region or blank for s in objects.source], self.like),
            torch.tensor([s.region is not None for s in objects.source], device=self.like.device),
        )

    @cached_property
    def finish(self) -> Tensor:
        """(V, 4) gains (3) and lift that match the templates' colours to the vehicles; computed on first use."""
        parts = zip(self.surfaces.templates, self.sample_photograph(), strict=True)
        self._base_visible = None
        return torch.cat([torch.from_numpy(finish.fit_finish(*part)) for part in parts]).to(self.like)

    def _base_lightness(self, objects: Objects) -> Tensor:
        """CIE L* (N,) of the objects' paint, about which gloss changes contrast."""
        if objects.source:
            paint = torch.stack([s.paint for s in objects.source]).to(self.like)
        else:
            paint = self._template_paint()
        return texture.rgb_to_lab(paint.clamp(0.0, 1.0))[:, 0]

    def _template_paint(self) -> Tensor:
        """Mean colour (N, 3) of the templates' paint."""
        meshes = self.surfaces
        total = self.base_size_lhw.new_zeros(len(self.base_size_lhw), 3)
        total = total.index_add(0, meshes.owner, meshes.colours * meshes.paint[:, None])
        count = total.new_zeros(len(total)).index_add(0, meshes.owner, meshes.paint)
        return total / count.clamp(min=1e-3)[:, None]

    def estimate_paint(self, samples: Sequence[finish.FinishSamples]) -> Tensor:
        """Paint (N, 3) of the objects in the photograph, by their samples; the templates' where it shows none."""
        paint = self._template_paint()
        for i, (surface, own) in enumerate(zip(self.surfaces.templates, samples, strict=True)):
            ground_points = finish.estimate_paint(surface, own)
            if ground_points is not None:
                paint[i] = ground_points.to(paint)
        return paint

    def _place(self, objects: Objects) -> PlacedGeometry:
        return self.batch.place([objects], [None], with_ground=True)

    def find_visible(self, objects: Objects, sun: PerturbedSun | None = None) -> VisibleSurfaces:
        """Find which surfaces the pixels see. sun: as of `perturbed_sun`."""
        return self.batch.find_visible([objects], [sun])

    def perturbed_sun(self, environment: Environment) -> PerturbedSun | None:
        """The sun of a perturbed scene; None where it is the photographed one."""
        base = self.scene.environment
        covered = base.closed_sky is not None and is_active(environment.weather)
        if not len(self.sunlight) or not (covered or is_active(environment.light)):
            return None
        changed = replace(base, light=environment.light, weather=environment.weather)
        return PerturbedSun.from_environment(changed, self.like, self.sunlight.mean())

    @cached_property
    def closed_sky_gain(self) -> Tensor | None:
        """Of the background, see `environment.compute_closed_sky_gain`; None where the closed sky is not known."""
        return self._closed_sky_gain(0, self.scene.background)

    def _closed_sky_gain(self, which: int, picture: Tensor) -> Tensor | None:
        environment, camera = self.scene.environment, self.scene.camera
        if environment.closed_sky is None:
            return None
        gain = compute_closed_sky_gain(
            environment.closed_sky[which], picture, environment.sky, float(camera.intrinsics[0, 0])
        )
        return gain.to(self.like)

    @cached_property
    @torch.no_grad()
    def closed_sky_brightening(self) -> Tensor:
        """Brightening (V,) of the photographed surfaces under a closed sky, less that by the sun alone, which
        `compute_brightening` has; of surfaces that the photograph does not show, the mean of their vehicle's others.
        """
        gain = self._closed_sky_gain(1, self.scene.photograph.to(self.like))
        sources, owner = self.scene.objects.source, self.surfaces.owner
        if gain is None or not sources:
            return self.like.new_zeros(owner.shape[0])
        luma = self.like.new_tensor(model.LUMA)[:, None]
        height, width = self.frame_hw
        clip = self.base_geometry.clip
        columns, rows = (clip[:, :2] / clip[:, 2:].clamp(min=1e-3)).round().long().unbind(1)
        columns, rows = columns.clamp(0, width - 1), rows.clamp(0, height - 1)
        seen = self.base_geometry.facing_cos > 0.0
        for i, source in enumerate(sources):
            crop, own = source.foreground, (owner == i).nonzero()[:, 0]
            row, column = rows[own] - crop.y0, columns[own] - crop.x0
            h, w = crop.values.shape[1:]
            inside = (row >= 0) & (row < h) & (column >= 0) & (column < w)
            opaque = torch.zeros_like(inside)
            opaque[inside] = crop.values.to(self.like)[3, row[inside], column[inside]] > model.SOLID_ALPHA[1]
            seen[own] &= opaque
        now = self.scene.photograph.to(self.like)[:, rows, columns]
        bent = (1.0 - now.square()).clamp(
            min=1.0 - model.CLOSED_SKY_BURNT[0] ** 2
        )  # as `texture.relight` bends it
        wanted = (luma * now * gain[:, rows, columns]).sum(0) / (luma * now * bent).sum(0).clamp(min=1e-3)
        none, one = self.like.new_zeros(()), self.like.new_ones(())
        hidden = PerturbedSun(self.scene.environment.sun.to(self.like), none, one, one)
        more = wanted.clamp(*model.CLOSED_SKY_RELIT) - self.compute_brightening(
            at_photographed_pose(self.scene.objects), hidden
        )
        count = self.like.new_zeros(len(sources)).index_add(0, owner, seen.to(self.like))
        mean = self.like.new_zeros(len(sources)).index_add(0, owner, more * seen) / count.clamp(min=1.0)
        return torch.where(seen, more, mean[owner])

    def local_vertices(self, objects: Objects) -> Tensor:
        """Vertices (V, 3) m in their objects' frames."""
        shapes = ((objects.ffd, self._base_ffd), (objects.size_lhw, self.base_size_lhw))
        changed = any(now.requires_grad or not torch.equal(now, then) for now, then in shapes)
        return self.surfaces.local_vertices(objects.ffd, objects.size_lhw) if changed else self._base_local

    def compute_brightening(self, objects: Objects, sun: PerturbedSun | None = None) -> Tensor:
        """Brightening (V,) of the surfaces since the photograph, by turns of objects and sun or its strength: see
        `texture.limit_brightening`.
        """
        turned = objects.yaw.requires_grad or not torch.equal(objects.yaw, self.base_yaw)
        if not objects.source or not (turned or sun is not None):
            return self.like.new_zeros(self.surfaces.owner.shape[0])
        sunlight = self.surfaces.per_vertex(self.sunlight)
        then = (
            model.AMBIENT[0]
            + model.AMBIENT[1] * (0.5 - 0.5 * self.smooth_normals[:, 1])
            + sunlight * self._base_sun_exposure
        )
        now = self._sun_exposure(objects.yaw, sun)
        more = now - self._base_sun_exposure
        if sun is not None:
            more = more + (sun.strength - 1.0) * now
        return texture.limit_brightening(sunlight * more / then, self.surfaces.paint)

    @cached_property
    def _base_sun_exposure(self) -> Tensor:
        return self._sun_exposure(self.base_yaw)

    def _sun_exposure(self, yaw: Tensor, moved: PerturbedSun | None = None) -> Tensor:
        """How squarely (V,) the sun meets the surfaces of objects at yaw (N,)."""
        direction = self.scene.environment.sun.to(self.like) if moved is None else moved.direction
        sun = direction.expand(len(yaw), 3)
        x, y, z = self.surfaces.per_vertex(surfaces.rotate_y(sun, -yaw)).unbind(-1)
        # Written out: the last bit of a sum along an axis may depend on the number of rows.
        soft = self.smooth_normals[:, 0] * x + self.smooth_normals[:, 1] * y + self.smooth_normals[:, 2] * z
        return texture.sun_exposure(soft)

    def place_patches(self, objects: Objects, sun: PerturbedSun | None = None) -> Tensor:
        """Clip coordinates (4N, 3) of the corners of the shadows' patches.

        A patch turns with its object, but the shadow cast beyond the footprint stays on the side away from the
        sun: the patch is sheared the more, the farther out. It grows with its object, and hardly shrinks. Where
        the sun moves, only shadows that are the objects' own follow (`shadow_is_own`).
        """
        ground = self.scene.environment.ground
        offset = surfaces.shadow_offset(self.scene.environment.sun, objects.yaw, self.base_size_lhw[:, 1])
        if sun is not None:
            offset = offset + self.shadow_is_own * (
                surfaces.shadow_offset(sun.direction, objects.yaw, self.base_size_lhw[:, 1]) - offset
            )
        corners = (
            self.patch_corners + self.corner_outwardness[..., None] * (offset - self.base_shadow_offset)[:, None]
        )
        more = (objects.size_lhw / self.base_size_lhw - 1.0)[:, None, ::2]
        # Softly at least 0, and exactly 0 at 0: a patch that shrank would leave its photographed rim behind.
        soft = torch.full_like(more, model.SHRUNK)
        more = 0.5 * (more + (more.square() + soft.square()).sqrt() - soft.square().sqrt())
        corners = corners + more * corners
        corners = surfaces.place_on_ground(corners, objects.yaw, objects.translation, ground)
        return surfaces.project_vertices(corners, self.scene.camera)

    def patch_inputs(self, sun: PerturbedSun | None) -> tuple[Tensor, ...]:
        """Inputs of the patches' kernels except poses: the tensors of `shadow_patches.PatchInputs`."""
        count, environment = len(self.base_size_lhw), self.scene.environment
        direction, ground = (t.to(self.like) for t in (environment.sun, environment.ground))
        casts = self.like.new_zeros(count) if sun is None else self.shadow_is_own[:, 0].contiguous()
        return (
            *(t.contiguous() for t in (self.patch_corners, self.corner_outwardness, self.base_shadow_offset)),
            self.base_size_lhw,
            *(direction.expand(count, 3).contiguous(), ground.expand(count, 4).contiguous()),
            *(self.scene.camera.matrix.to(self.like).expand(count, 3, 4).contiguous(), casts),
        )

    @cached_property
    def crown_maps(self) -> Tensor:
        """Result of `environment.compute_crown_maps`; computed on first use."""
        return compute_crown_maps(self.scene)

    @cached_property
    def lamps(self) -> VehicleLamps:
        """Lamps of the vehicles; found on first use."""
        return find_lamps(self.scene, at_photographed_pose(self.scene.objects), self.centre)

    @cached_property
    def night_maps(self) -> NightMaps:
        """Result of `night.compute_night_maps`; computed on first use."""
        gain = self.closed_sky_gain
        shaded = self.scene.background if gain is None else self.scene.background * (1.0 + gain)
        return compute_night_maps(self.scene, shaded.clamp(0.0, 1.0))

    @cached_property
    @torch.no_grad()
    def shadow_is_own(self) -> Tensor:
        """(N, 1): 1 where the photographed shadow is that of the object's box in the scene's sun, 0 where it
        includes others, such as a house's, or is cut by the picture's border; computed on first use.
        """
        source, casts = self.scene.objects.source, self.like.new_ones(len(self.scene.objects), 1)
        if not source:
            return casts
        drawn = self.find_visible(at_photographed_pose(self.scene.objects))
        density, rects = self.patch_density(drawn), drawn.patch_layout.rects.tolist()
        for i, (packed, size) in enumerate(drawn.patch_layout.spans()):
            shadow = source[i].shadow
            if shadow is None or not shadow.values.numel() or not min(size):
                continue
            (x0, y0), (h, w) = (shadow.x0, shadow.y0), shadow.values.shape[1:]
            cut = min(x0, y0) <= 0 or x0 + w >= self.frame_hw[1] or y0 + h >= self.frame_hw[0]
            inverted = replace(shadow, values=1.0 - shadow.values.to(self.like))
            dark = texture.extract_crop(inverted, tuple(rects[i]), self.frame_hw).mean(dim=0).flatten()
            alike = torch.nn.functional.cosine_similarity(dark, density[packed], dim=0)
            casts[i] = float(alike >= model.OWN_SHADOW and not cut)
        return casts

    def objects_without_shadow(self) -> list[bool]:
        """Which objects do not darken the ground."""
        source = self.scene.objects.source
        count = len(self.scene.objects)
        return [not self.settings.shadows or (bool(source) and source[i].shadow is None) for i in range(count)]

    def reach_px(self, objects: Objects) -> list[float]:
        """Reach of each object's halo beyond its mesh, px."""
        if not objects.source:
            return [0.0] * len(objects)
        parts = (objects.translation, objects.size_lhw, self.base_size_lhw, self.halo, self.scene.camera.matrix)
        translation, size, base_size, halo, matrix = (values.to(self.like.dtype) for values in to_host(*parts))
        distance = to_clip(translation, matrix)[:, 2].clamp(min=1.0)
        return (halo * (size / base_size).amax(dim=1) / distance).clamp(max=MAX_HALO_PX).tolist()

    def template_attributes(self, normals: Tensor, depth: Tensor) -> Tensor:
        """(V, channels.PLAIN) appearance of the templates. normals (V, 3); depth (V,) m."""
        shares = torch.stack([self.surfaces.paint, self.surfaces.glass, depth, self.vertex_height], dim=1)
        return torch.cat([self.surfaces.colours, normals, shares], dim=1)

    def completion_attributes(self, normals: Tensor, depth: Tensor) -> Tensor:
        """(V, channels.OWN): `template_attributes`, and what completes a photographed vehicle."""
        template = self.template_attributes(normals, depth)
        return torch.cat([template, self.mirror_clip, self.mirror_cos[:, None], self.finish], dim=1)

    def rotated_normals(self, objects: Objects) -> Tensor:
        """Unit normals (V, 3) with sharp edges, in camera axes."""
        return surfaces.rotate_y(self.sharp_normals, self.surfaces.per_vertex(objects.yaw))

    def object_lights(self, sun: PerturbedSun | None = None) -> Tensor:
        """(N, 4) direction and strength of the sun on each object."""
        direction = self.scene.environment.sun.to(self.like) if sun is None else sun.direction
        strength = self.sunlight if sun is None else self.sunlight * sun.strength
        return torch.cat([direction.expand(len(strength), 3), strength[:, None]], dim=1)

    def shade_template(self, xy: Tensor, owner: Tensor, own: Tensor, sun: PerturbedSun | None = None) -> Tensor:
        """Template colours (K, 3) in daylight, not clamped.

        Args:
            xy: (K, 2) px.
            owner: (K,) object of each pixel.
            own: (K, ...) attributes as of `template_attributes`.
            sun: As of `perturbed_sun`.
        """
        light = self.object_lights(sun).index_select(0, owner)
        albedo, normal = own[:, : channels.NORMAL], own[:, channels.NORMAL : channels.OWN_PAINT]
        sheen, height = own[:, channels.OWN_PAINT : channels.OWN_DEPTH], own[:, channels.OWN_HEIGHT]
        ray = torch.cat([xy, torch.ones_like(xy[:, :1])], dim=1) @ self.unproject.T
        normal = torch.nn.functional.normalize(normal, dim=-1, eps=1e-6)
        to_eye = -torch.nn.functional.normalize(ray, dim=-1)
        return texture.shade_template(normal, to_eye, albedo, sheen, height, light[:, :3], light[:, 3])

    @torch.no_grad()
    def project_paint(self) -> list[Crop]:
        """Paint maps of the objects: Crop (1, h, w) at their foregrounds, 1 where the mesh at its photographed
        pose is paint, else 0; beyond the mesh as at its nearest pixel.
        """
        objects = at_photographed_pose(self.scene.objects)
        drawn = self.find_visible(objects)
        dense = verbs.interpolate(
            drawn.mesh, drawn.geometry.clip, self.surfaces.faces, self.surfaces.paint[:, None], self.backend
        )
        out = []
        for i, (packed, size) in enumerate(drawn.mesh.layout.spans()):
            place = objects.source[i].foreground
            h, w = place.values.shape[1:]
            x0, y0 = drawn.mesh.layout.rects[i, :2].tolist()
            known = (drawn.mesh.face[packed] >= 0).reshape(size)
            if not h or not w or not bool(known.any()):
                out.append(Crop(self.like.new_zeros(1, h, w), place.x0, place.y0))
                continue
            values = texture.extend_nearest(dense[packed].T.reshape(1, *size), known)
            rows = (torch.arange(h) + place.y0 - y0).clamp(0, size[0] - 1)
            columns = (torch.arange(w) + place.x0 - x0).clamp(0, size[1] - 1)
            out.append(Crop(values[:, rows][:, :, columns], place.x0, place.y0))
        return out

    @torch.no_grad()
    def sample_photograph(self) -> list[finish.FinishSamples]:
        """Samples of the photographed colours of each object and of its template in daylight.

        Large objects are sampled at about `_MAX_SAMPLES` evenly spread pixels.
        """
        objects, drawn = at_photographed_pose(self.scene.objects), self._base_visible
        if drawn is None:
            drawn = self.find_visible(objects)
        layout, count = drawn.mesh.layout, len(objects)
        pixel = (drawn.mesh.face >= 0).nonzero()[:, 0]
        owner, xy = layout.draw_index()[pixel], layout.pixel_xy()[pixel].to(self.like)
        assert self.texels is not None
        counts = torch.bincount(owner, minlength=2 * count)
        texels = self.texels.sample(xy, counts, self.backend, "clamp")
        weight = smoothstep(texels[:, channels.ALPHA], 0.9, 0.99)
        for part in (texels[:, channels.HIDDEN], texture.outline_share(texels[:, channels.INSET])):
            weight = weight * (1.0 - smoothstep(part, 0.0, 1.0))
        plain = (weight > 0.0).nonzero()[:, 0]
        # By position within the object, so that other objects have no influence.
        size = torch.bincount(owner[plain], minlength=count)
        place = torch.arange(len(plain), device=plain.device) - (size.cumsum(0) - size)[owner[plain]]
        chosen = plain[(place.double() * _GOLDEN) % 1.0 < (_MAX_SAMPLES / size.clamp(min=1))[owner[plain]]]
        pixel, owner, xy, texels, weight = (v[chosen] for v in (pixel, owner, xy, texels, weight))
        corner = self.surfaces.faces[drawn.mesh.face[pixel].long()]
        share = surfaces.perspective_weights(drawn.geometry.clip[corner], xy).to(self.like)
        template_appearance = self.template_attributes(self.rotated_normals(objects), drawn.geometry.clip[:, 2])
        attributes = torch.cat([template_appearance, drawn.geometry.facing_cos[:, None]], dim=1)
        attributes = (attributes[corner] * share[..., None]).sum(dim=1)
        weight = weight * smoothstep(attributes[:, channels.PLAIN], *model.SQUARE)
        template = self.shade_template(xy, owner, attributes)
        normal = torch.nn.functional.normalize(
            attributes[:, channels.NORMAL : channels.OWN_PAINT], dim=-1, eps=1e-6
        )
        sun = self.scene.environment.sun.to(self.like)
        sky, lit = (texture.daylight(normal, sun, strength) for strength in (0.0, 1.0))
        columns = (corner, share, template, texels[:, : channels.ALPHA], sky, lit - sky, weight)
        out = []
        for i, (start, _) in enumerate(self.surfaces.vertex_ranges.tolist()):
            is_own = (owner == i) & (weight > 0.0)
            vertex, *values = (c[is_own].cpu().numpy() for c in columns)
            out.append(finish.FinishSamples(vertex - start, *(v.astype(np.float64) for v in values)))
        return out

    def patch_density(self, drawn: VisibleSurfaces) -> Tensor:
        """Darkening (Ts,) in [0, 1] of the patches' pixels by the objects' boxes."""
        clip = drawn.geometry.patch_clip
        assert drawn.patch_fragments is not None
        faces, _, _ = patch_faces(self.patch_corners.shape[0], clip.device)
        corners = self.patch_corners.reshape(-1, 2).contiguous()
        local = verbs.interpolate(drawn.patch_fragments, clip, faces, corners, self.backend)
        owner = drawn.patch_layout.draw_index()
        density = surfaces.shadow_density(local, self.base_size_lhw[owner], self.base_shadow_offset[owner])
        return density * (drawn.patch_fragments.face >= 0)


class SceneBatch:
    """Prepared scenes that are drawn together: each stage passes once over the pixels of all scenes.

    A scene may occur more than once, for several of its perturbations.
    """

    def __init__(self, members: Sequence[PreparedScene]) -> None:
        self._members = tuple(members)
        self._backend: verbs.Backend = members[0].backend
        placements = [m.placement for m in members if m.placement is not None]
        self._placement = VertexPlacement.concat(placements) if placements else None
        self._faces, self._vertex_ranges, self._face_ranges = ObjectSurfaces.concat_faces(
            [m.surfaces for m in members]
        )
        self._face_range_tensor = torch.tensor(self._face_ranges, dtype=torch.int64).reshape(-1, 2)
        closed = [s.closed for m in members for s in m.surfaces.templates]
        self._cull = torch.tensor(closed, dtype=torch.bool)
        self.counts = [len(m.scene.objects) for m in members]
        cameras = [m.scene.camera for m in members]
        self._frames_hw = [
            (c.height, c.width) for c, n in zip(cameras, self.counts, strict=True) for _ in range(n)
        ]
        self._patches = patch_faces(sum(self.counts), self._faces.device)
        self._patch_corners, self._patch_faces = (ranges.tolist() for ranges in self._patches[1:])
        self._shadowless = torch.tensor([s for m in members for s in m.objects_without_shadow()], dtype=torch.bool)
        self._still_patch_inputs: tuple[Tensor, ...] | None = None

    def place(
        self, objects: Sequence[Objects], suns: Sequence[PerturbedSun | None], with_ground: bool
    ) -> PlacedGeometry:
        """Place the vertices of each member's perturbed objects, and compute the light on them.

        Args:
            objects: Perturbed objects of each member.
            suns: As of `perturbed_sun`, for each member.
            with_ground: Whether to place the patches in plain torch.
        """
        if self._placement is None:
            ((m,), (o,), (sun,)) = self._members, objects, suns
            matrix = m.scene.camera.matrix.to(m.like)
            clip, cos = surfaces.place_vertices(
                m.local_vertices(o), m.smooth_normals, m.surfaces.owner, o, matrix, m.centre
            )
            brighter = m.compute_brightening(o, sun) + closed_sky_brightening([m], suns)
            return PlacedGeometry(clip, cos, m.place_patches(o, sun), brighter)
        lit = list(zip(self._members, objects, suns, strict=True))
        lights = concat([m.object_lights(sun) for m, _, sun in lit])
        ffd, size, yaw, translation = (
            concat([getattr(o, name) for o in objects]) for name in ("ffd", "size_lhw", "yaw", "translation")
        )
        clip, cos, brighter, _ = surfaces.place_with_kernels(self._placement, ffd, size, yaw, translation, lights)
        if any(sun is not None for sun in suns):
            brighter = brighter + closed_sky_brightening(self._members, suns)
        if with_ground:
            return PlacedGeometry(
                clip, cos, concat([m.place_patches(o, sun) for m, o, sun in lit]), brighter, lights
            )
        inside, _, ground = surfaces.place_patches(yaw, translation, size, lights, self._patch_inputs(suns))
        return PlacedGeometry(clip, cos, ground, brighter, lights, inside)

    def patch_matrices(self, objects: Sequence[Objects]) -> Tensor:
        """(N, 3, 3) float64, from (s, t, 1) on a patch, each in [0, 1], to its clip coordinates under the
        photographed sun.
        """
        lights, fixed = (
            concat([m.object_lights() for m in self._members]),
            self._patch_inputs([None] * len(objects)),
        )
        yaw, place, size = (concat([getattr(o, n) for o in objects]) for n in ("yaw", "translation", "size_lhw"))
        return surfaces.place_patches(yaw, place, size, lights, fixed)[1]

    def _patch_inputs(self, suns: Sequence[PerturbedSun | None]) -> tuple[Tensor, ...]:
        """Inputs of the patches' kernels that poses do not affect; cached while no sun moves."""
        if self._still_patch_inputs is None or any(sun is not None for sun in suns):
            parts = [m.patch_inputs(sun) for m, sun in zip(self._members, suns, strict=True)]
            ground_points = tuple(concat(rows) for rows in zip(*parts, strict=True))
            if any(sun is not None for sun in suns):
                return ground_points
            self._still_patch_inputs = ground_points
        return self._still_patch_inputs

    def reach_px(self, objects: Sequence[Objects]) -> list[float]:
        """Reach of each object's halo beyond its mesh, px."""
        return [r for m, o in zip(self._members, objects, strict=True) for r in m.reach_px(o)]

    def find_visible(
        self, objects: Sequence[Objects], suns: Sequence[PerturbedSun | None], with_ground: bool = True
    ) -> VisibleSurfaces:
        """Find which surfaces the pixels see; the draws are the members' objects, concatenated.

        Args:
            objects: Perturbed objects of each member.
            suns: As of `perturbed_sun`, for each member.
            with_ground: Whether to rasterise the patches.
        """
        backend, reach = self._backend, self.reach_px(objects)
        geometry = self.place(objects, suns, with_ground)
        clip, patch_clip = to_host(geometry.clip, geometry.patch_clip)
        rects = surfaces.crop_rects(
            clip, self._faces, self._vertex_ranges, self._face_ranges, self._frames_hw,
            [2.0 + r for r in reach],
        )  # fmt: skip
        layout = verbs.PixelLayout.from_rects(rects, geometry.clip.device)
        mesh = verbs.rasterize(
            geometry.clip, self._faces, self._face_range_tensor, layout, backend, cull=self._cull
        )
        coverage = verbs.antialias(mesh, geometry.clip, self._faces, backend=backend)
        faces, _, face_ranges = self._patches
        patch_rects = surfaces.crop_rects(
            patch_clip, faces, self._patch_corners, self._patch_faces, self._frames_hw, [0.0] * len(reach)
        )
        patch_rects[self._shadowless] = 0
        ground_layout = verbs.PixelLayout.from_rects(patch_rects, geometry.clip.device)
        ground = None
        if with_ground:
            ground = verbs.rasterize(geometry.patch_clip, faces, face_ranges, ground_layout, backend)
        return VisibleSurfaces(geometry, mesh, coverage, tuple(reach), ground_layout, ground)


def closed_sky_brightening(members: Sequence[PreparedScene], suns: Sequence[PerturbedSun | None]) -> Tensor:
    """Brightening (V,) of the members' surfaces as far as clouds hide their suns."""
    parts = [
        m.like.new_zeros(m.surfaces.owner.shape[0]) if sun is None else sun.hidden * m.closed_sky_brightening
        for m, sun in zip(members, suns, strict=True)
    ]
    return concat(parts)


def concat(parts: Sequence[Tensor]) -> Tensor:
    """Rows of several scenes, concatenated."""
    return parts[0] if len(parts) == 1 else torch.cat(list(parts))


def at_photographed_pose(objects: Objects) -> Objects:
    """The objects at the geometry of their sources."""
    if not objects.source:
        return objects
    names = ("translation", "yaw", "size_lhw", "ffd")
    return replace(
        objects, **{n: torch.stack([getattr(s, n) for s in objects.source]).to(objects.yaw) for n in names}
    )


def _shadow_darkness(shadow: Crop | None, frame_hw: tuple[int, int]) -> Crop:
    """Light that a shadow removes, (3, h, w), continued beyond the frame for the lookup's kernel."""
    if shadow is None or shadow.values.numel() == 0:
        return Crop(torch.zeros(3, 0, 0), 0, 0)
    h, w = shadow.values.shape[1:]
    dark = replace(shadow, values=1.0 - shadow.values)
    rect = (shadow.x0 - 4, shadow.y0 - 4, shadow.x0 + w + 4, shadow.y0 + h + 4)
    return Crop(texture.extract_crop(dark, rect, frame_hw), rect[0], rect[1])


def patch_faces(count: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Faces (2N, 3), vertex and face ranges (N, 2) of the shadows' patches, four corners each."""
    start = torch.arange(count, device=device)[:, None]
    faces = (4 * start + torch.tensor([0, 1, 2, 0, 2, 3], device=device)).reshape(-1, 3)
    return faces, torch.cat([4 * start, 4 * start + 4], dim=1), torch.cat([2 * start, 2 * start + 2], dim=1)


def is_active(code: Tensor) -> bool:
    """Whether a code must be applied: it is not 0, or needs a gradient."""
    return code.requires_grad or _any_nonzero(code)


_any_nonzero = TensorCache(lambda code: bool((code != 0).any()))
