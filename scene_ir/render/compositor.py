"""Differentiable re-rendering of a scene: photograph, perturbed vehicles, weather.

In the order of work: `prepare`, then `reference` (plain torch, the definition) or `fast` (kernels), here for
several scenes at once, then `blend` and `environment`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, lru_cache

import torch
from torch import Tensor

from scene_ir.errors import RangeError, ShapeError
from scene_ir.raster.layout import PixelLayout
from scene_ir.render import blend, fast, model, reference
from scene_ir.render.channels import LIT, RISE
from scene_ir.render.environment import (
    PerturbedSun,
    add_flakes,
    apply_foliage,
    apply_weather,
    shadow_softening,
    sunlight_share,
)
from scene_ir.render.fixed_geometry import FixedGeometry
from scene_ir.render.lamps import draw_lamps
from scene_ir.render.night import apply_night, night_share
from scene_ir.render.prepare import ObjectLayers, PreparedScene, RenderSettings, SceneBatch, concat, is_active
from scene_ir.render.reflections import by_row, mirror_in_ground
from scene_ir.render.spray import draw_spray
from scene_ir.render.texture import PaintRegions, codes_by_part
from scene_ir.render.windscreen import add_drops
from scene_ir.types import Crop, Objects, Render, SceneIR, Weather, replace_unchecked


def render(scenes: Sequence[SceneIR], settings: RenderSettings | None = None) -> list[Render]:
    """Render scenes as they stand. To render many perturbations of one scene, reuse its `Compositor`."""
    return [Compositor(scene, settings).render(scene) for scene in scenes]


class Compositor(PreparedScene):
    """Renders perturbations of one scene, and caches what no parameter affects."""

    @cached_property
    @torch.no_grad()
    def fixed_geometry(self) -> FixedGeometry | None:
        """Input of the fast kernels, gathered on first use; None where they do not apply."""
        return FixedGeometry.from_scene(self) if self.texels is not None and self.backend == "warp" else None

    @cached_property
    def _compositor_before(self) -> Compositor:
        assert self.scene.before is not None
        return Compositor(self.scene.before, self.settings)

    def draw_layers(self, objects: Objects, sun: PerturbedSun | None = None) -> ObjectLayers:
        """Layers of the objects, not yet blended. sun: as of `perturbed_sun`."""
        fixed = self.fixed_geometry
        if fixed is None:
            return reference.draw_layers(self, objects, self.find_visible(objects, sun), sun)
        return _draw_layers([self], self.batch, fixed, [objects], [sun])[0]

    def render(self, perturbed: SceneIR) -> Render:
        """The picture of a perturbed scene; the photograph where nothing is perturbed.

        Where vehicles were exchanged, added or removed, states of the scene before that are rendered too
        (`SceneIR.before`). Raises RangeError for a state of which this scene is the one before.
        """
        if perturbed.before is None and self.scene.before is not None:
            return self._compositor_before.render(perturbed)
        if perturbed.before is not None and self.scene.before is None:
            raise RangeError("scene", "a state of the compositor's own", "one with vehicles exchanged")
        objects = self.perturbed_objects(perturbed)
        sun = self.perturbed_sun(perturbed.environment)
        return self.compose(perturbed, objects, self.draw_layers(objects, sun) if len(objects) else None)

    def perturbed_objects(self, perturbed: SceneIR) -> Objects:
        """The objects of a perturbed scene in this one's dtype. Raises ShapeError for other objects."""
        objects = perturbed.objects
        if len(objects) != len(self.scene.objects):
            raise ShapeError("objects", f"the {len(self.scene.objects)} of the base scene", len(objects))
        names = ("translation", "yaw", "size_lhw", "ffd", "texture_code", "lamps")
        changes = {name: getattr(objects, name).to(self.like) for name in names}
        return replace_unchecked(self.scene.objects, **changes)

    def compose(self, perturbed: SceneIR, objects: Objects, layers: ObjectLayers | None) -> Render:
        """Blend drawn objects into the picture.

        Args:
            perturbed: Scene with the environment to apply.
            objects: Its objects.
            layers: Their layers; None without objects.
        """
        environment, backend = perturbed.environment, self.backend
        weather = is_active(environment.weather) or is_active(objects.lamps)
        foliage, drops = is_active(environment.foliage), is_active(environment.drops)
        canvas = self.canvas if weather else self.canvas[:3]
        if foliage:
            changed = replace(self.scene.environment, foliage=environment.foliage.to(self.like))
            canvas = torch.cat([apply_foliage(canvas[:3], changed, self.crown_maps, backend), canvas[3:]])
        closed_sky = self.closed_sky_gain if weather else None
        if closed_sky is not None:
            hidden = 1.0 - sunlight_share(environment.weather.to(self.like))
            canvas = torch.cat([canvas[:3] * (1.0 + hidden * closed_sky), canvas[3:]])
        if self.occluders is not None:
            changed = foliage or closed_sky is not None
            layers = self.occluders.append_to(layers, canvas[:3] - self.canvas[:3] if changed else None)
        # On a GPU pictures are evaluated whole, and finding the regions would wait for it.
        unknown = weather or foliage or drops or self.like.is_cuda
        drawn = None if unknown else torch.zeros(0, 4, dtype=torch.int64)
        behind = self.scene.environment
        shows: Tensor | None = None
        if layers is None:
            with torch.no_grad():
                depth = self.scene.depth.clone()
                number = torch.zeros(self.frame_hw, dtype=torch.int64, device=depth.device)
            opacity: tuple[Crop, ...] = ()
        else:
            factors = layers.shadow
            sun = self.perturbed_sun(environment)
            if sun is not None:
                is_own = self.shadow_is_own[layers.shadow_layout.draw_index()]
                factors = (factors - (1.0 - factors) * is_own * (sun.shade - 1.0)).clamp(min=0.0)
            if weather:
                factors = 1.0 - (1.0 - factors) * shadow_softening(environment.weather.to(self.like))
            order = blend.paint_order(
                objects.size_lhw, objects.yaw, objects.translation, self.centre, self.footprints
            )
            if drawn is not None:
                with torch.no_grad():
                    visible = blend.visible_rects(layers.layout, layers.opacity[:, None] != 0)[: len(objects)]
                    shaded = blend.visible_rects(layers.shadow_layout, layers.shadow != 1)
                drawn = torch.cat([visible, shaded])
            plan = blend.BlendPlan.from_layouts(layers.layout, layers.shadow_layout, order)
            layer_data = (factors, layers.colour, layers.opacity, layers.depth)
            canvas, depth, number = blend.composite(
                canvas, self.scene.depth, layer_data, plan, not weather, backend
            )
            number = number if self.occluders is None else number.masked_fill(number > len(objects), 0)
            if weather:  # objects are not part of the sky or the road behind them
                shows = blend.visible_background(layers.opacity, plan, self.frame_hw)
                behind = replace(
                    behind, sky=behind.sky.to(self.like) * shows, road=behind.road.to(self.like) * shows
                )
            opacity = tuple(
                Crop(crop.reshape(1, *size), window[1].start, window[0].start)
                for crop, (_, window, size) in zip(
                    layers.opacity.clamp(0.0, 1.0).split(plan.sizes), plan.spans, strict=True
                )
            )[: len(objects)]
        image = canvas
        if weather:
            changed = replace(behind, weather=environment.weather.to(self.like))
            colour, inverse = canvas.split([3, 1])
            mirrored = spray = None
            if is_active(changed.weather[Weather.RAIN]):
                values = torch.cat([colour, changed.sky.to(colour)[None]])
                rise, camera_m = self.night_maps.maps[RISE], self.night_maps.camera_m
                mirrored = mirror_in_ground(values, inverse[0], changed.road, rise, camera_m)
                if len(objects):
                    spray = draw_spray(inverse[0], objects, self.lamps, self.scene.camera)
            image = apply_weather(colour, inverse[0], changed, self.air, mirrored, backend, spray)
            if is_active(changed.weather[Weather.SNOW]):
                image = add_flakes(image, inverse[0], changed, self.air)
            lit = self.night_maps.maps[LIT]
            lit = lit if shows is None else lit * shows
            lamps = torch.zeros_like(colour)
            if len(objects):
                lamps = draw_lamps(self.lamps, self.scene, objects, number, changed, self.centre)
            image = apply_night(image, inverse[0], changed, lit, lamps, self.night_maps, backend)
        if weather or layers is None:
            image = blend.clamp_colour(image[:3])
        if drops:
            image = add_drops(image, environment.drops[0].to(self.like))
        if self.scene.environment.ego is not None:  # at 1, `lerp` takes the photograph to the bit
            ego, photograph = self.scene.environment.ego.to(self.like), self.scene.photograph
            if is_active(environment.weather[Weather.NIGHT]):
                share = night_share(environment.weather.to(self.like), self.night_maps)
                photograph = photograph * (1.0 - by_row(model.EGO_DARKENED * share, photograph.shape[1]))
            image = torch.lerp(image, photograph, ego)
            number = number.masked_fill(ego > 0.5, 0)
        return Render(image, depth, number, opacity, drawn)


def _draw_layers(
    members: Sequence[Compositor],
    pack: SceneBatch,
    fixed: FixedGeometry,
    objects: Sequence[Objects],
    suns: Sequence[PerturbedSun | None],
) -> list[ObjectLayers]:
    """The layers of each member by the fast kernels, all at once."""
    drawn = pack.find_visible(objects, suns, with_ground=False)
    code = None
    if any(is_active(o.texture_code) for o in objects):
        regions = [m.regions for m in members]
        code = fast.PaintCodes(
            concat([codes_by_part(o) for o in objects]),
            concat([m.paint_lightness for m in members]),
            PaintRegions.concat([r for r in regions if r is not None]),
        )
    yaw = concat([o.yaw for o in objects])
    colour, opacity, depth, shadow = fast.draw_photographed(fixed, drawn, yaw, code)
    if len(members) == 1:
        return [ObjectLayers(drawn.mesh.layout, colour, opacity, depth, drawn.patch_layout, shadow)]
    layouts, grounds = (
        [PixelLayout.from_rects(rects) for rects in whole_layout.rects.split(pack.counts)]
        for whole_layout in (drawn.mesh.layout, drawn.patch_layout)
    )
    sizes, ground_sizes = [part.size for part in layouts], [part.size for part in grounds]
    parts = zip(
        layouts, colour.split(sizes), opacity.split(sizes), depth.split(sizes), grounds,
        shadow.split(ground_sizes), strict=True,
    )  # fmt: skip
    return [ObjectLayers(*part) for part in parts]


@lru_cache(maxsize=2)
def _batch_compositors(members: tuple[Compositor, ...]) -> tuple[SceneBatch, FixedGeometry]:
    """Compositors with fast kernels, as one batch."""
    return SceneBatch(members), FixedGeometry.concat(
        [m.fixed_geometry for m in members if m.fixed_geometry is not None]
    )


def render_batch(pairs: Sequence[tuple[Compositor, SceneIR]]) -> list[Render]:
    """Pictures of perturbed scenes, each by its compositor, with the objects of all scenes drawn at once where
    possible.

    A compositor may occur several times. The pictures equal those of `Compositor.render`.
    """
    members = tuple(c for c, _ in pairs)
    together = len({scene.objects.texture_code.shape[1:] for _, scene in pairs}) == 1 < len(pairs) and all(
        c.fixed_geometry is not None and (scene.before is None) == (c.scene.before is None) for c, scene in pairs
    )
    if not together:
        return [c.render(scene) for c, scene in pairs]
    objects = [c.perturbed_objects(scene) for c, scene in pairs]
    suns = [c.perturbed_sun(scene.environment) for c, scene in pairs]
    layers = _draw_layers(members, *_batch_compositors(members), objects, suns)
    return [c.compose(p, o, part) for (c, p), o, part in zip(pairs, objects, layers, strict=True)]
