"""Pyrender as a second renderer of photographs: vehicles are meshes with textures baked from the photograph.

It shares no code with the compositor but the scene types. The compositor moves pixels with their matte; here a
vehicle's outline is that of its mesh, OpenGL's depth test decides occlusion, and a pixel averages sixteen samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from detectors.types import CLASSES, Targets
from drivesem.attacks.labels import Difficulty
from drivesem.attacks.visibility import compute_contrasts
from drivesem.failures.second_renderer import shading
from drivesem.failures.second_renderer.baking import BakedAppearance, TextureAtlas, bake_atlas
from drivesem.failures.second_renderer.base import SecondRender
from drivesem.failures.second_renderer.geometry import BodyMesh, PictureCamera, VehiclePose, to_numpy
from drivesem.failures.second_renderer.night import apply_night, darken_inside
from drivesem.failures.second_renderer.opengl import (
    SUPERSAMPLING,
    Array,
    ImageWindow,
    ObjectDepth,
    TexturedSurface,
    WindowImage,
    shared_context,
)
from drivesem.failures.second_renderer.shading import GroundShadow
from scene_ir.errors import RangeError
from scene_ir.types import Crop, Objects, Occluder, Render, SceneIR, Source

_MIN_SHARE = 0.5
"""Minimum coverage of a pixel that shows an object; minimum visible share of an object, relative to the
photograph."""
_MIN_OCCLUDER_OPACITY = 0.05
"""Minimum opacity at which a nearer object may colour a pixel."""


@dataclass(frozen=True, slots=True)
class _Vehicle:
    """What no change of a vehicle touches."""

    body: BodyMesh
    atlas: TextureAtlas
    texture: NDArray[np.uint8]  # (h, w, 3), of its own paint
    shadow: GroundShadow
    box_xyxy: Array  # (4,) px, of its mesh as photographed, not clipped at the border


@dataclass(frozen=True, slots=True)
class _RenderedScene:
    """One rendered state."""

    placed: list[Array]  # (F, 3, 3) m, triangles of each vehicle
    image: Array  # (H, W, 3) on the 8-bit grid
    owner: NDArray[np.int64]  # (H, W), object + 1 by pixel
    shares: Array  # (N,), visible share of the hull of each vehicle's outline


class PhotographRenderer:
    """Renders any state of one photograph's scene. Raises NoSecondRendererError where this machine has no OpenGL."""

    name = "pyrender"

    def __init__(
        self,
        identifier: str,
        scene: SceneIR,
        difficulty: Difficulty | None = None,
        before: PhotographRenderer | None = None,
    ) -> None:
        """Bake the vehicles' textures.

        Args:
            identifier: Name of the frame.
            scene: Any state of its scene.
            difficulty: Limits of what is evaluated; by default the usual ones.
            before: Renderer of the scene before vehicles were exchanged; its visible shares count.
        """
        still = scene.unperturbed()
        self._identifier, self._still, self._difficulty = identifier, still, difficulty or Difficulty()
        self._camera, self._context = PictureCamera.from_camera(still.camera), shared_context()
        self._photograph, self._background = (_to_image(p) for p in (still.photograph, still.background))
        self._depth_m = to_numpy(still.depth)
        self._air = shading.estimate_air_colour(self._photograph, to_numpy(still.environment.sky))
        self._leaves = to_numpy(still.environment.foliage_map)
        self._vehicles = [self._make_vehicle(source, i) for i, source in enumerate(still.objects.source)]
        rest = self._render_state(still)
        self._shares = rest.shares if before is None else before._shares
        self._ignore = self._too_hard(to_numpy(still.objects.box2d), to_numpy(still.objects.truncation), rest)

    def unsupported_changes(self, changed: SceneIR) -> tuple[str, ...]:
        """List changes of the sun, as textures baked from the photograph keep its light, and drops on the glass."""
        moved = not torch.equal(changed.environment.light, self._still.environment.light)
        sun = ("the sun: its light is baked into the textures",) if moved else ()
        return (*sun, "drops: there is no windscreen") if bool(changed.environment.drops.any()) else sun

    @torch.no_grad()
    def render(self, changed: SceneIR) -> SecondRender:
        """Render a state of the scene. Labels are the photograph's, moved as the meshes' boxes move.

        Objects are ignored that are too hard in the photograph or now, or that only the change hides mostly.
        """
        if len(changed.objects) != len(self._vehicles):
            raise RangeError(
                f"scene of {self._identifier}",
                f"the photograph's {len(self._vehicles)} vehicles",
                len(changed.objects),
            )
        state = self._render_state(changed)
        image = torch.from_numpy(np.ascontiguousarray(state.image.transpose(2, 0, 1)))
        return SecondRender(
            image,
            self._moved_targets(changed, state),
            torch.from_numpy(_visible_boxes(state.owner, len(self._shares))),
        )

    def textured_vehicles(self, changed: SceneIR) -> list[tuple[Array, TexturedSurface]]:
        """The vehicles of a state: triangles (F, 3, 3) m in the camera's own axes, and their textures."""
        poses = [VehiclePose.from_objects(changed.objects, i) for i in range(len(changed.objects))]
        surfaces = self._surfaces(changed.objects)
        return [
            (vehicle.body.place(pose, self._camera), surface)
            for vehicle, pose, surface in zip(self._vehicles, poses, surfaces, strict=True)
        ]

    def _surfaces(self, objects: Objects) -> list[TexturedSurface]:
        codes, parted = to_numpy(objects.texture_code), objects.parted.tolist()
        codes = [code if lower else code[:5] for code, lower in zip(codes, parted, strict=True)]
        return [
            TexturedSurface(v.atlas.uv, _paint_texture(v, code))
            for v, code in zip(self._vehicles, codes, strict=True)
        ]

    def _make_vehicle(self, source: Source, i: int) -> _Vehicle:
        objects = self._still.objects
        body = BodyMesh(self._still.meshes[int(objects.mesh_index[i])])
        appearance = BakedAppearance(source, self._occluded_area(i))
        normal = to_numpy(self._still.environment.ground)[:3]
        placed, camera = body.place(VehiclePose.from_source(source), self._camera), self._camera
        window = _enclosing_window([placed], camera)
        own_depth = (
            None
            if window is None
            else self._context.render_depth(placed.reshape(-1, 3), camera.intrinsics, window)
        )
        atlas = bake_atlas(body, source, appearance, camera, own_depth)
        shadow = GroundShadow(source, camera, normal, self._shadow_in_matte(source, own_depth))
        return _Vehicle(body, atlas, _to_levels(atlas.colour), shadow, camera.bounding_box(placed))

    def _shadow_in_matte(self, source: Source, own_depth: ObjectDepth | None) -> Array:
        """Optical depth (H, W, 3) of the photograph against the background, within a vehicle's matte but outside
        of its mesh: the part of its shadow that the matte contains.
        """
        out, matte = np.zeros_like(self._photograph), np.zeros(self._photograph.shape[:2], bool)
        crop = source.foreground
        alpha = to_numpy(crop.values)[3]
        matte[crop.y0 : crop.y0 + alpha.shape[0], crop.x0 : crop.x0 + alpha.shape[1]] = (
            alpha > _MIN_OCCLUDER_OPACITY
        )
        covered = np.zeros_like(matte)
        if own_depth is not None:
            s, window = SUPERSAMPLING, own_depth.window
            samples = np.isfinite(own_depth.depth_m).reshape(window.height, s, window.width, s)
            covered[window.slices] = samples.any(axis=(1, 3))
        matte &= ~covered
        floor = 1 / 255
        out[matte] = np.log((self._background[matte] + floor) / (self._photograph[matte] + floor))
        out = np.maximum(out, 0)
        # It continues under the mesh: border pixels are covered only partly.
        return np.where(covered[..., None], cv2.dilate(out, np.ones((5, 5), np.uint8)), out).astype(np.float32)

    def _occluded_area(self, i: int) -> NDArray[np.bool_]:
        """(H, W) bool: where the photograph shows something nearer than an object."""
        out = np.zeros((self._camera.height, self._camera.width), bool)
        depth = float(self._still.objects.translation[i, 2])
        nearer = [s.foreground for s in self._still.objects.source if float(s.translation[2]) < depth]
        nearer += [front.foreground for front in self._still.occluders if front.depth_m < depth]
        for crop in nearer:
            alpha = to_numpy(crop.values)[3]
            out[crop.y0 : crop.y0 + alpha.shape[0], crop.x0 : crop.x0 + alpha.shape[1]] |= (
                alpha > _MIN_OCCLUDER_OPACITY
            )
        return out

    def _render_state(self, scene: SceneIR) -> _RenderedScene:
        objects, camera = scene.objects, self._camera
        poses = [VehiclePose.from_objects(objects, i) for i in range(len(objects))]
        placed = [v.body.place(pose, camera) for v, pose in zip(self._vehicles, poses, strict=True)]
        environment = scene.environment
        shade = np.zeros_like(self._background)
        for vehicle, pose in zip(self._vehicles, poses, strict=True):
            vehicle.shadow.cast(pose, shade)
        # Foliage stands behind vehicles, or in `front`, which keeps the photograph's pixels.
        behind = shading.apply_foliage(self._background, to_numpy(environment.foliage), self._leaves, self._air)
        image = behind * np.exp(-shading.remaining_shade(to_numpy(environment.weather)) * shade)
        depth_m, owner = self._depth_m.copy(), np.zeros(image.shape[:2], np.int64)
        window = _enclosing_window(placed, camera)
        if window is not None:
            rendered = self._context.render(
                [p.reshape(-1, 3) for p in placed], self._surfaces(objects), camera.intrinsics, window
            )
            owner[window.slices] = _pixel_owners(rendered, len(placed))
            _composite(
                image[window.slices],
                depth_m[window.slices],
                owner[window.slices],
                rendered,
                self._occluder_layers(window),
            )
        image = shading.apply_weather(image, depth_m, (owner == 0).astype(np.float32), environment, self._air)
        riders = self._still.riders.cpu().numpy()
        unlit = objects.upright.cpu().numpy() & ~riders
        lamps = np.where(unlit, -1.0, to_numpy(objects.lamps))
        image = apply_night(image, depth_m, owner, environment, camera, poses, lamps, riders)
        if environment.ego is not None:
            inside = darken_inside(self._photograph, environment)
            image = image + (inside - image) * to_numpy(environment.ego)[..., None]
        image = np.rint(np.clip(image, 0, 1) * 255).astype(np.float32) / np.float32(255)
        shares = np.array([self._visible_share(p, owner == i + 1) for i, p in enumerate(placed)], np.float32)
        return _RenderedScene(placed, image, owner, shares)

    def _occluder_layers(self, window: ImageWindow) -> list[tuple[Array, float]]:
        """What may stand in front of vehicles in a window: (h, w, 4), premultiplied, and its distance."""
        return [(_crop_to_window(front, window), front.depth_m) for front in self._still.occluders]

    def _visible_share(self, placed: Array, visible: NDArray[np.bool_]) -> float:
        """Visible share of the hull of a vehicle's outline, of the part inside the image."""
        corners = placed[(placed[..., 2] > 0).all(axis=1)].reshape(-1, 3)
        if not len(corners):
            return 0.0
        limit = 4 * max(visible.shape)
        hull = cv2.convexHull(np.clip(self._camera.project(corners), -limit, limit).astype(np.float32))
        filled = np.zeros(visible.shape, np.uint8)
        cv2.fillConvexPoly(filled, np.rint(hull).astype(np.int32), 1)
        return float(np.count_nonzero(visible)) / max(int(filled.sum()), 1)

    def _moved_targets(self, changed: SceneIR, state: _RenderedScene) -> Targets:
        """The scene's objects in order, then regions in which no detection counts, each once per class."""
        objects = self._still.objects
        limit = np.array([self._camera.width - 1, self._camera.height - 1] * 2, np.float32)
        labelled, truncation = to_numpy(objects.box2d), to_numpy(objects.truncation)
        now = np.array([self._camera.bounding_box(placed) for placed in state.placed]).reshape(-1, 4)
        then = np.array([vehicle.box_xyxy for vehicle in self._vehicles]).reshape(-1, 4)
        gone = np.isnan(now).any(axis=1) | np.isnan(then).any(axis=1)
        now, then = np.nan_to_num(now), np.nan_to_num(then)
        inside, before = np.clip(now, 0, limit), np.clip(then, 0, limit)
        boxes = labelled + inside - before
        # A label that extends beyond the border stays there.
        boxes = np.clip(boxes, np.minimum(labelled, 0), np.maximum(labelled, limit)).astype(np.float32)
        truncation = np.clip(truncation + _share_outside(now, inside) - _share_outside(then, before), 0, 1)
        hidden = (state.shares < _MIN_SHARE * self._shares) | (state.shares == 0)
        ignore = self._ignore | gone | hidden | self._too_hard(boxes, truncation, state)
        regions, count = self._still.ignore.cpu(), len(CLASSES)
        return Targets(
            torch.cat([torch.from_numpy(boxes).float(), regions.repeat_interleave(count, dim=0).float()]),
            torch.cat([objects.category.cpu(), torch.arange(count).repeat(len(regions))]),
            torch.cat([torch.from_numpy(ignore), torch.ones(count * len(regions), dtype=torch.bool)]),
        )

    def _too_hard(self, boxes_xyxy: Array, truncation: Array, state: _RenderedScene) -> NDArray[np.bool_]:
        size, limits = boxes_xyxy[:, 2:] - boxes_xyxy[:, :2], self._difficulty
        occlusion = self._still.objects.occlusion.cpu().numpy()
        faint = _object_contrasts(state, len(boxes_xyxy)) < limits.min_contrast
        return (
            (size[:, 1] < limits.min_height_px)
            | (size <= 0).any(axis=1)
            | (occlusion > limits.max_occlusion)
            | (truncation > limits.max_truncation)
            | faint
        )


def _to_image(tensor: Tensor) -> Array:
    return np.ascontiguousarray(to_numpy(tensor).transpose(1, 2, 0))


def _paint_texture(vehicle: _Vehicle, code: Array) -> NDArray[np.uint8]:
    if not code.any():
        return vehicle.texture
    atlas = vehicle.atlas
    return _to_levels(shading.apply_paint(atlas.colour, code, atlas.paint_share, atlas.height, atlas.paint_colour))


def _to_levels(colour: Array) -> NDArray[np.uint8]:
    """Convert values in [0, 1] to levels of 255."""
    return np.rint(colour * 255).astype(np.uint8)


def _enclosing_window(placed: Sequence[Array], camera: PictureCamera) -> ImageWindow | None:
    """The part of the image with vehicles; None where there is none."""
    boxes = np.array([camera.bounding_box(p) for p in placed]).reshape(-1, 4)
    boxes = boxes[~np.isnan(boxes).any(axis=1)]
    if not len(boxes):
        return None
    limit = np.array([camera.width, camera.height])
    x0, y0 = np.clip(np.floor(boxes[:, :2].min(axis=0)) - 1, 0, limit).astype(int).tolist()
    x1, y1 = np.clip(np.ceil(boxes[:, 2:].max(axis=0)) + 2, 0, limit).astype(int).tolist()
    return ImageWindow(x0, y0, x1 - x0, y1 - y0) if x1 > x0 and y1 > y0 else None


def _pixel_owners(rendered: WindowImage, count: int) -> NDArray[np.int64]:
    """(h, w): object + 1 that covers at least half of a pixel; 0 where none does."""
    height, width = rendered.depth_m.shape
    s = SUPERSAMPLING
    blocks = rendered.owner.reshape(height, s, width, s)
    out = np.zeros((height, width), np.int64)
    for i in range(1, count + 1):
        out[(blocks == i).sum(axis=(1, 3), dtype=np.uint8) >= _MIN_SHARE * s * s] = i
    return out


def _composite(
    image: Array,
    depth_m: Array,
    owner: NDArray[np.int64],
    rendered: WindowImage,
    fronts: Sequence[tuple[Array, float]],
) -> None:
    """Composite vehicles over the background (h, w, 3), and occluders over both, in place.

    The background already contains the occluders, so vehicles lose what those cover.
    """
    colour, cover = rendered.colour[..., :3], rendered.colour[..., 3:]
    veiled, added = np.ones_like(cover), np.zeros_like(colour)
    for rgba, distance in sorted(fronts, key=lambda front: -front[1]):
        over = (rendered.depth_m > distance)[..., None]
        alpha = np.where(over, rgba[..., 3:], 0)
        veiled, added = veiled * (1 - alpha), added * (1 - alpha) + np.where(over, rgba[..., :3], 0)
    owner[veiled[..., 0] < _MIN_SHARE] = 0
    image *= 1 - cover
    image += veiled * colour + cover * added
    visible = owner > 0
    depth_m[visible] = rendered.depth_m[visible]


def _crop_to_window(front: Occluder, window: ImageWindow) -> Array:
    """An occluder's layer (h, w, 4) in a window; transparent outside of it."""
    crop = front.foreground
    rgba = to_numpy(crop.values).transpose(1, 2, 0)
    out = np.zeros((window.height, window.width, 4), np.float32)
    y0, x0 = crop.y0 - window.y0, crop.x0 - window.x0
    top, left = max(y0, 0), max(x0, 0)
    bottom, right = min(y0 + rgba.shape[0], window.height), min(x0 + rgba.shape[1], window.width)
    if bottom > top and right > left:
        out[top:bottom, left:right] = rgba[top - y0 : bottom - y0, left - x0 : right - x0]
    return out


def _share_outside(whole: Array, inside: Array) -> Array:
    """Shares (N,) of boxes that lie outside of the image."""
    areas = [np.prod(np.maximum(b[:, 2:] - b[:, :2], 0), axis=1) for b in (whole, inside)]
    return 1 - areas[1] / np.maximum(areas[0], 1e-6)


def _visible_boxes(owner: NDArray[np.int64], count: int) -> Array:
    """(N, 4) px, boxes of the visible part of each object; zeros where nothing is visible."""
    out = np.zeros((count, 4), np.float32)
    for i in range(count):
        appearance = (owner == i + 1).astype(np.uint8)
        x, y, width, height = cv2.boundingRect(appearance)
        if width:
            out[i] = x, y, x + width - 1, y + height - 1
    return out


def _object_contrasts(state: _RenderedScene, count: int) -> NDArray[np.float64]:
    """Contrast (N,) of each object to its surroundings in the image."""
    image = torch.from_numpy(np.ascontiguousarray(state.image.transpose(2, 0, 1)))
    owner = torch.from_numpy(state.owner)
    crops = []
    for x0, y0, x1, y1 in _visible_boxes(state.owner, count).astype(int).tolist():
        mask = owner[y0 : y1 + 1, x0 : x1 + 1] == len(crops) + 1
        crops.append(Crop(mask[None].float(), x0, y0))
    return compute_contrasts(Render(image, torch.zeros_like(owner, dtype=torch.float32), owner, tuple(crops)))
