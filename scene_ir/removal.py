"""Remove vehicles from a scene: show the background behind them, and complete what they hid of other vehicles."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields, replace

import torch
from torch import Tensor

from scene_ir.errors import RangeError
from scene_ir.render import blend, surfaces
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import ObjectLayers, RenderSettings
from scene_ir.types import Crop, Objects, SceneIR, Source

_ROW = re.compile(r"objects\[(\d+)\](.*)", re.DOTALL)


def remove_objects(scene: SceneIR, rows: Collection[int], settings: RenderSettings | None = None) -> SceneIR:
    """Remove vehicles and their shadows from a scene; the others move up, in order.

    The parts of a farther vehicle that a removed one hid are filled from its mirrored side or its template.
    Sources that nothing removed was in front of stay equal to the bit, as do photograph, background and maps.
    `SceneIR.before` is dropped.

    Args:
        scene: The scene.
        rows: Objects to remove.
        settings: Of the renderer.

    Returns:
        The scene without them.

    Raises:
        RangeError: A row does not exist.
    """
    count = len(scene.objects)
    for row in rows:
        if not 0 <= row < count:
            raise RangeError("objects", f"a row from 0 to {count - 1}" if count else "no row of none", row)
    remaining = [row for row in range(count) if row not in rows]
    if len(remaining) == count:
        return scene
    sources = scene.objects.source
    if sources:
        sources = complete_uncovered_sources(scene, rows, settings)
    objects = _select_objects(
        scene.objects, remaining, tuple(sources[row] for row in remaining) if sources else ()
    )
    return replace(
        scene, objects=objects, provenance=_renumber_provenance(scene.provenance, remaining), before=None
    )


def _select_objects(objects: Objects, remaining: Sequence[int], source: tuple[Source, ...]) -> Objects:
    tensors = [f.name for f in fields(Objects) if f.name != "source"]
    return replace(objects, source=source, **{name: getattr(objects, name)[list(remaining)] for name in tensors})


def _renumber_provenance(provenance: Mapping[str, str], remaining: Sequence[int]) -> dict[str, str]:
    """The provenance with the keys `objects[i]` of the remaining objects renumbered."""
    place = {row: i for i, row in enumerate(remaining)}
    renumbered = {}
    for key, value in provenance.items():
        match = _ROW.fullmatch(key)
        if match is None:
            renumbered[key] = value
        elif int(match[1]) in place:
            renumbered[f"objects[{place[int(match[1])]}]{match[2]}"] = value
    return renumbered


@torch.no_grad()
def complete_uncovered_sources(
    scene: SceneIR, removed: Collection[int], settings: RenderSettings | None = None
) -> tuple[Source, ...]:
    """Complete the sources of objects behind removed ones.

    Args:
        scene: The scene.
        removed: Rows of the removed objects.
        settings: Of the renderer.

    Returns:
        The sources of all objects.
    """
    photographed = scene.unperturbed()
    objects, sources = photographed.objects, scene.objects.source
    order = blend.paint_order(
        objects.size_lhw, objects.yaw, objects.translation, surfaces.camera_centre(scene.camera.matrix)
    )
    hidden: dict[int, Tensor] = {}
    frame_hw = (scene.camera.height, scene.camera.width)
    for place, row in enumerate(order):
        nearer = [sources[i].foreground for i in order[place + 1 :] if i in removed]
        mask = _opaque_mask(nearer, frame_hw)
        if row not in removed and bool(mask.any()):
            hidden[row] = mask
    if not hidden:
        return sources
    compositor = Compositor(photographed, settings)
    layers = compositor.draw_layers(compositor.perturbed_objects(photographed))
    return tuple(
        _complete_source(source, layers, row, hidden[row]) if row in hidden else source
        for row, source in enumerate(sources)
    )


def _opaque_mask(foregrounds: Sequence[Crop], frame_hw: tuple[int, int]) -> Tensor:
    """(H, W) bool: where any of the foregrounds, Crops (4, h, w), is not fully transparent."""
    mask = torch.zeros(frame_hw, dtype=torch.bool)
    for crop in foregrounds:
        _window(mask[None], crop).logical_or_(crop.values[3:].cpu() > 0)
    return mask


def _complete_source(source: Source, layers: ObjectLayers, row: int, hidden: Tensor) -> Source:
    """The source with its foreground as rendered in `layers` where `hidden` (H, W), unchanged elsewhere."""
    old = source.foreground
    packed, size = layers.layout.spans()[row]
    x0, y0 = layers.layout.rects[row, :2].tolist()
    drawn = torch.cat([layers.colour[packed, :3], layers.opacity[packed, None]], dim=1).T.reshape(4, *size)
    drawn = drawn.to(old.values).clamp(0.0, 1.0)
    canvas = old.values.new_zeros(4, *hidden.shape)
    used = torch.zeros_like(hidden)
    _window(canvas, old)[:] = old.values
    _window(used[None], old)[:] = True
    new = Crop(drawn, x0, y0)
    target = _window(canvas, new)
    completed = _window(hidden[None], new)
    if not bool((completed & ((drawn[3:] > 0) | (target[3:] > 0))).any()):
        return source
    target.copy_(torch.where(completed, drawn, target))
    _window(used[None], new).logical_or_(completed & (drawn[3:] > 0))
    rows, columns = used.any(dim=1).nonzero()[:, 0], used.any(dim=0).nonzero()[:, 0]
    left, top = int(columns[0]), int(rows[0])
    values = canvas[:, top : int(rows[-1]) + 1, left : int(columns[-1]) + 1].contiguous()
    return replace(source, foreground=Crop(values, left, top))


def _window(frame: Tensor, crop: Crop) -> Tensor:
    """View of the part of a frame (C, H, W) that a crop covers."""
    h, w = crop.values.shape[1:]
    return frame[:, crop.y0 : crop.y0 + h, crop.x0 : crop.x0 + w]
