"""Exchange, add, move and remove objects of a scene, as streets change from one day to the next.

The previous scene stays available as `SceneIR.before` with the same objects, row by row. A vehicle that is in only
one of the two stands behind the camera in the other, out of reach of pictures, labels and constraints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import kornia
import numpy as np
import torch
from torch import Tensor

from scene_ir.errors import RangeError
from scene_ir.geometry import to_clip
from scene_ir.removal import complete_uncovered_sources
from scene_ir.render import finish, model, surfaces, texture
from scene_ir.render.compositor import Compositor
from scene_ir.render.sources import analytic_shadows
from scene_ir.types import (
    LATTICE_POINTS,
    Category,
    Crop,
    Mesh,
    Objects,
    Part,
    SceneIR,
    Source,
)

AWAY_M = 60.0
"""Distance behind the camera of vehicles that are not in a scene, m."""
CHANGE_KEY = "change"
"""Provenance key of a scene's description of its change."""
_NEUTRAL = 0.8
"""Grey value of the templates' paint."""
_INFLATION_M = 0.05
_STREET_SHADOW = 0.7
_MIN_BOX_DARKNESS = 0.3
"""Least maximum darkness assumed of a box's shadow: only a rim of a clipped one is visible."""
_LENS_BLUR_PX = 0.5
"""Standard deviation of the blur of a camera."""
_MAX_GAIN = 2.0


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A vehicle that the photograph does not show."""

    mesh: Mesh
    """Mesh in the unit box."""
    category: Category
    """Its category."""
    translation: Tensor
    """(3,) m, bottom-face centre."""
    yaw: Tensor
    """() rad."""
    size_lhw: Tensor
    """(3,) m, length, height, width."""
    paint: tuple[float, float, float] | None = None
    """RGB in [0, 1] in place of the mesh's paint, or None."""


def remove_vehicle(scene: SceneIR, row: int) -> SceneIR:
    """The scene without the vehicle in `row` and its shadow; what it hid of others is completed
    (`scene_ir.removal`).

    Raises RangeError for an unknown row or missing sources.
    """
    _check_exchangeable(scene, row)
    objects = scene.objects
    sources = list(complete_uncovered_sources(scene, {row}))
    place = _away_position(scene, objects.translation)
    sources[row] = _hidden_source(sources[row], place)
    translation = objects.translation.clone()
    translation[row] = place
    return record_exchange(
        scene, scene, replace(objects, translation=translation, source=tuple(sources)), f"objects[{row}] is gone"
    )


@torch.no_grad()
def add_vehicle(scene: SceneIR, vehicle: Vehicle) -> SceneIR:
    """The scene with one more vehicle in a last row, in the scene's light and with a shadow.

    In the previous scene that row stands behind the camera. Raises RangeError for missing sources.
    """
    _check_exchangeable(scene, None)
    vehicle_render, mesh = _render_vehicle(scene, vehicle), len(scene.meshes)
    place = _away_position(scene, scene.objects.translation)
    padded = replace(scene, meshes=(*scene.meshes, vehicle_render.mesh))
    there = replace(
        _object_row(vehicle_render, mesh, padded),
        translation=place[None],
        source=(_hidden_source(vehicle_render.source, place),),
    )
    before = replace(padded, objects=_concatenate(scene.objects, there))
    objects = _concatenate(scene.objects, _object_row(vehicle_render, mesh, padded))
    return record_exchange(padded, before, objects, f"{vehicle.mesh.name} parks as objects[{len(scene.objects)}]")


@torch.no_grad()
def replace_vehicle(scene: SceneIR, row: int, vehicle: Vehicle) -> SceneIR:
    """The scene with another vehicle in the place of the one in a row.

    Args:
        scene: A scene in which nothing was exchanged yet.
        row: The object to replace.
        vehicle: Its replacement, which takes over the row.

    Returns:
        The changed scene.

    Raises:
        RangeError: An unknown row or missing sources.
    """
    _check_exchangeable(scene, row)
    vehicle_render = _render_vehicle(scene, vehicle)
    new = _object_row(vehicle_render, len(scene.meshes), scene)
    sources = list(complete_uncovered_sources(scene, {row}))
    sources[row] = vehicle_render.source
    own = {}
    for name in _TENSORS:
        own[name] = getattr(scene.objects, name).clone()
        own[name][row] = getattr(new, name)[0]
    objects = replace(scene.objects, source=tuple(sources), **own)
    wider = replace(scene, meshes=(*scene.meshes, vehicle_render.mesh))
    return record_exchange(wider, scene, objects, f"{vehicle.mesh.name} in the place of objects[{row}]")


@torch.no_grad()
def relocate_person(scene: SceneIR, row: int, place: Tensor, vehicle: int) -> SceneIR:
    """The scene with a person or cyclist behind a vehicle, drawn and lit as if photographed there.

    The surface keeps facing the camera, so the label turns with the direction in which the camera sees it.

    Args:
        scene: A scene in which nothing was exchanged yet.
        row: The person.
        place: (3,) m, where the feet stand.
        vehicle: Row of the vehicle, for the description of the change.

    Returns:
        The changed scene.

    Raises:
        RangeError: An unknown row, a vehicle's row, or missing sources.
    """
    _check_exchangeable(scene, row)
    objects, old = scene.objects, scene.objects.source[row]
    if not bool(objects.upright[row]):
        raise RangeError("objects", "a row of a person or cyclist", row)
    centre = surfaces.camera_centre(scene.camera.matrix).to(place)
    bearings = [torch.atan2(centre[2] - at[2], at[0] - centre[0]) for at in (old.translation, place)]
    translation, yaw = objects.translation.clone(), objects.yaw.clone()
    translation[row], yaw[row] = place, old.yaw + bearings[1] - bearings[0]
    compositor = Compositor(scene.unperturbed())
    moved = compositor.scene.with_objects(translation=translation, yaw=yaw)
    layers = compositor.draw_layers(compositor.perturbed_objects(moved))
    packed, size = layers.layout.spans()[row]
    x0, y0 = layers.layout.rects[row, :2].tolist()
    drawn = torch.cat([layers.colour[packed, :3], layers.opacity[packed, None]], dim=1).T.reshape(4, *size)
    foreground = Crop(drawn.to(scene.background).clamp(0.0, 1.0).contiguous(), x0, y0)
    alone = replace(moved.objects, source=(), **{n: getattr(moved.objects, n)[row : row + 1] for n in _TENSORS})
    alone = replace(alone, mesh_index=torch.zeros_like(alone.mesh_index))
    mesh = scene.meshes[int(objects.mesh_index[row])]
    shadow = _cast_shadow(scene, mesh, alone, [old, *objects.source])
    source = replace(old, translation=place, yaw=yaw[row], foreground=foreground, shadow=shadow, region=None)
    sources = list(complete_uncovered_sources(scene, {row}))
    sources[row] = source
    index = objects.mesh_index.clone()
    changed = replace(objects, mesh_index=index, translation=translation, yaw=yaw, source=tuple(sources))
    return record_exchange(scene, scene, changed, f"objects[{row}] stands behind objects[{vehicle}]")


@torch.no_grad()
def add_roof_load(scene: SceneIR, row: int, load: Mesh) -> SceneIR:
    """The scene with a load on the roof of a photographed vehicle.

    Args:
        scene: A scene in which nothing was exchanged yet.
        row: The vehicle.
        load: A mesh in and above that vehicle's unit box; it moves and deforms with the vehicle.

    Returns:
        The changed scene.

    Raises:
        RangeError: An unknown row or missing sources.
    """
    _check_exchangeable(scene, row)
    objects, source = scene.objects, scene.objects.source[row]
    own = scene.meshes[int(objects.mesh_index[row])]
    bare = replace(objects, source=(), **{n: getattr(objects, n)[row : row + 1] for n in _TENSORS})
    bare = replace(bare, mesh_index=torch.zeros_like(bare.mesh_index))
    top, body = (_render_object(scene, bare, mesh) for mesh in (load, own))
    size = (scene.camera.height, scene.camera.width)
    frame = (0, 0, size[1], size[0])
    nearer = texture.extract_crop(top.nearness, frame, size) >= texture.extract_crop(body.nearness, frame, size)
    rgba = texture.extract_crop(top.rgba, frame, size) * nearer
    whole = rgba + (1.0 - rgba[3:]) * texture.extract_crop(source.foreground, frame, size)
    rows, columns = ((whole[3] > 0).any(dim=side).nonzero()[:, 0] for side in (1, 0))
    y0, x0 = int(rows[0]), int(columns[0])
    values = whole[:, y0 : int(rows[-1]) + 1, x0 : int(columns[-1]) + 1]
    sources = list(objects.source)
    sources[row] = replace(source, foreground=Crop(values.to(scene.background).contiguous(), x0, y0))
    index = objects.mesh_index.clone()
    index[row] = len(scene.meshes)
    loaded = replace(scene, meshes=(*scene.meshes, _merge_meshes(own, load)))
    description = f"{load.name} on the roof of objects[{row}]"
    return record_exchange(loaded, scene, replace(objects, mesh_index=index, source=tuple(sources)), description)


def record_exchange(scene: SceneIR, before: SceneIR, objects: Objects, description: str) -> SceneIR:
    """A changed scene with its history.

    Args:
        scene: The scene to change.
        before: The previous scene.
        objects: The new objects.
        description: The change, for display.

    Returns:
        The changed scene.
    """
    provenance = {**scene.provenance, CHANGE_KEY: description}
    return replace(scene, objects=objects, before=before, provenance=provenance)


_TENSORS = tuple(entry.name for entry in fields(Objects) if entry.name != "source")


@dataclass(frozen=True, slots=True)
class _RenderedVehicle:
    """A vehicle with its mesh in its own paint, and its source in the scene."""

    vehicle: Vehicle
    mesh: Mesh
    source: Source


def _object_row(vehicle_render: _RenderedVehicle, mesh: int, scene: SceneIR) -> Objects:
    """A vehicle's row of objects. Its label (`drivesem.attacks.labels`) is empty at first."""
    vehicle, like = vehicle_render.vehicle, scene.objects.translation
    return Objects(
        mesh_index=torch.tensor([mesh]),
        translation=vehicle.translation.to(like)[None],
        yaw=vehicle.yaw.to(like)[None],
        size_lhw=vehicle.size_lhw.to(like)[None],
        ffd=like.new_zeros(1, LATTICE_POINTS, 3),
        texture_code=like.new_zeros(1, scene.objects.texture_code.shape[1]),
        category=torch.tensor([int(vehicle.category)]),
        box2d=scene.objects.box2d.new_zeros(1, 4),
        truncation=scene.objects.truncation.new_zeros(1),
        occlusion=scene.objects.occlusion.new_zeros(1),
        source=(vehicle_render.source,),
    )


def _concatenate(first: Objects, then: Objects) -> Objects:
    rows = {name: torch.cat([getattr(first, name), getattr(then, name)]) for name in _TENSORS}
    return Objects(**rows, source=(*first.source, *then.source))


def _render_vehicle(scene: SceneIR, vehicle: Vehicle) -> _RenderedVehicle:
    """Render a vehicle as if photographed: in the others' finish and sunlight, with a shadow as dark as theirs."""
    mesh, sources = _apply_paint(vehicle.mesh, vehicle.paint), scene.objects.source
    vehicle_render = _RenderedVehicle(vehicle, mesh, _blank_source(vehicle, mesh, _sunlight(scene)))
    row = replace(_object_row(vehicle_render, 0, scene), source=())
    alone = _render_object(scene, row, mesh)
    nearest = (scene.objects.translation - vehicle.translation).norm(dim=1).argsort().tolist()
    shadow = _cast_shadow(scene, mesh, row, [sources[i] for i in nearest])
    return replace(vehicle_render, source=replace(vehicle_render.source, foreground=alone.rgba, shadow=shadow))


def _cast_shadow(scene: SceneIR, mesh: Mesh, row: Objects, like: Sequence[Source]) -> Crop:
    """Shadow of `row`, one object of `mesh`, in a scene's sun, as dark as the first shadow of `like`."""
    shadow = analytic_shadows(replace(scene, meshes=(mesh,), objects=row, occluders=(), before=None))[0]
    dark = 1.0 - shadow.values
    if dark.numel():
        dark = dark * (_shadow_darkness(like) / dark.max().clamp(min=_MIN_BOX_DARKNESS))
    return replace(shadow, values=1.0 - dark.clamp(0.0, 1.0))


@dataclass(frozen=True, slots=True)
class _ObjectLayer:
    """One object rendered alone: Crop (4, h, w), premultiplied RGBA, and Crop (1, h, w), 1 / depth in 1 / m, 0
    outside it.
    """

    rgba: Crop
    nearness: Crop


def _render_object(scene: SceneIR, row: Objects, mesh: Mesh) -> _ObjectLayer:
    """Render `row`, one object of `mesh` without a photograph, in the scene's light."""
    compositor = Compositor(replace(scene, meshes=(mesh,), objects=row, occluders=(), before=None))
    compositor.sunlight.fill_(_sunlight(scene))
    layers = compositor.draw_layers(compositor.scene.objects)
    (packed, size), (x0, y0) = layers.layout.spans()[0], layers.layout.rects[0, :2].tolist()
    opacity = layers.opacity[packed, None].clamp(0.0, 1.0)
    light = layers.colour[packed, :3] / opacity.clamp(min=model.LEAST_ALPHA)
    gain, lift = _exposure(scene, row.translation[0], row.size_lhw[0])
    colour = texture.apply_finish(light, light.new_tensor([gain] * 3), light.new_tensor([lift])) * opacity
    values = torch.cat([colour, opacity, 1.0 / layers.depth[packed, None]], dim=1).T.reshape(5, *size)
    values = values.to(scene.background).contiguous()
    if values.numel():  # else it is outside the picture
        values[:4] = kornia.filters.gaussian_blur2d(
            values[None, :4], (5, 5), (_LENS_BLUR_PX, _LENS_BLUR_PX), "replicate"
        )[0]
    return _ObjectLayer(Crop(values[:4], x0, y0), Crop(values[4:], x0, y0))


def _sunlight(scene: SceneIR) -> float:
    return scene.objects.source[0].sunlight if scene.objects.source else model.SUNLIGHT


def _exposure(scene: SceneIR, place: Tensor, size_lhw: Tensor) -> tuple[float, float]:
    """Gain and lift as of `finish.exposure`: the others' medians.

    Gains are relative to the brightness of the road at each vehicle, which varies along a street, as in a house's
    shade.
    """
    if not len(scene.objects):
        return 1.0, 0.0
    objects, whole = scene.objects, Compositor(scene.unperturbed())
    gains, lifts = [], []
    for i, (surface, samples) in enumerate(zip(whole.surfaces.templates, whole.sample_photograph(), strict=True)):
        found = finish.estimate_exposure(surface, samples)
        if found is not None:
            gains.append(found[0] / _road_light(scene, objects.translation[i], objects.size_lhw[i]))
            lifts.append(found[1])
    if not gains:
        return 1.0, 0.0
    gain = float(np.median(gains)) * _road_light(scene, place, size_lhw)
    return min(gain, _MAX_GAIN), float(np.median(lifts))


def _road_light(scene: SceneIR, translation: Tensor, size_lhw: Tensor) -> float:
    """Brightness of the ground without vehicles, around a place (3,) as far as a vehicle is wide."""
    steps = torch.linspace(-0.5, 0.5, 9) * size_lhw[2]
    x, z = torch.meshgrid(steps, steps, indexing="ij")
    points = translation + torch.stack([x, torch.zeros_like(x), z], dim=-1).reshape(-1, 3)
    clip = to_clip(points.to(scene.camera.matrix), scene.camera.matrix)
    pixels = (clip[:, :2] / clip[:, 2:].clamp(min=1.0)).round().long()
    column, row = pixels[:, 0].clamp(0, scene.camera.width - 1), pixels[:, 1].clamp(0, scene.camera.height - 1)
    colours = scene.background[:, row, column].mean(dim=0).double().numpy()
    return float(finish.display_to_light(colours).mean())


def _blank_source(vehicle: Vehicle, mesh: Mesh, sunlight: float) -> Source:
    translation = vehicle.translation
    nothing, ffd = Crop(translation.new_zeros(4, 1, 1), 0, 0), translation.new_zeros(LATTICE_POINTS, 3)
    paint = translation.new_tensor(vehicle.paint or (_NEUTRAL,) * 3)
    return Source(translation, vehicle.yaw, vehicle.size_lhw, ffd, nothing, None, _INFLATION_M, paint, sunlight)


def _shadow_darkness(sources: Sequence[Source]) -> float:
    """Maximum darkness of the first shadow, as a share; a typical one if there is none."""
    shadows = (source.shadow.values for source in sources if source.shadow is not None)
    return next((float((1.0 - s).mean(dim=0).max()) for s in shadows if s.numel()), _STREET_SHADOW)


def _merge_meshes(body: Mesh, load: Mesh) -> Mesh:
    """Two meshes in one unit box as one."""
    both = (body, load)
    grey = (
        mesh.vertices.new_full(mesh.vertices.shape, 0.7) if mesh.colours is None else mesh.colours for mesh in both
    )
    return Mesh(
        vertices=torch.cat([mesh.vertices for mesh in both]),
        faces=torch.cat([body.faces, load.faces + len(body.vertices)]),
        part=torch.cat([mesh.part for mesh in both]),
        name=f"{body.name} with {load.name}",
        colours=torch.cat(list(grey)),
    )


def _apply_paint(mesh: Mesh, paint: tuple[float, float, float] | None) -> Mesh:
    if paint is None or mesh.colours is None:
        return mesh
    rows = mesh.faces[mesh.part == Part.PAINT].unique()
    colours = mesh.colours.clone()
    colours[rows] = colours[rows] * colours.new_tensor(paint) / _NEUTRAL
    return replace(mesh, colours=colours.clamp(0.0, 1.0))


def _check_exchangeable(scene: SceneIR, row: int | None) -> None:
    count = len(scene.objects)
    if scene.before is not None:
        raise RangeError(
            "scene", "one in which no vehicle was exchanged yet", scene.provenance.get(CHANGE_KEY, "another")
        )
    if len(scene.objects.source) != count:
        raise RangeError("objects.source", "one entry an object", len(scene.objects.source))
    if row is not None and not 0 <= row < count:
        raise RangeError("objects", f"a row from 0 to {count - 1}" if count else "no row of none", row)


def _away_position(scene: SceneIR, like: Tensor) -> Tensor:
    """Position (3,) of vehicles that are not in a scene: on its ground, behind the camera."""
    ground = scene.environment.ground.to(like)
    return torch.stack(
        [ground.new_zeros(()), (ground[2] * AWAY_M - ground[3]) / ground[1], ground.new_tensor(-AWAY_M)]
    )


def _hidden_source(source: Source, place: Tensor) -> Source:
    """The source of a vehicle that is out of the picture, at `place` (3,)."""
    nothing = Crop(source.foreground.values.new_zeros(4, 1, 1), 0, 0)
    return replace(source, translation=place, foreground=nothing, shadow=None, region=None)
