"""Taking vehicles out of a scene: background shows where they stood, and what they hid of others is completed."""

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
    """The scene without the vehicles in `rows` and without their shadows; the others move up, in order.

    What a removed vehicle hid of a farther one was known to be unseen because the nearer one's matte said so. That
    matte goes, so the farther one's foreground takes up what is drawn there today: the mirrored side or the
    template. Sources that nothing removed stood before keep every bit, as do photograph, background and maps.
    Of a scene after an exchange (`scene_ir.exchange`), what was before it is left behind. Raises RangeError for a
    row that the scene does not have.
    """
    count = len(scene.objects)
    for row in rows:
        if not 0 <= row < count:
            raise RangeError("objects", f"a row from 0 to {count - 1}" if count else "no row of none", row)
    kept = [row for row in range(count) if row not in rows]
    if len(kept) == count:
        return scene
    sources = scene.objects.source
    if sources:
        sources = complete_uncovered_sources(scene, rows, settings)
    objects = _select_objects(scene.objects, kept, tuple(sources[row] for row in kept) if sources else ())
    return replace(scene, objects=objects, provenance=_renumber_provenance(scene.provenance, kept), before=None)


def _select_objects(objects: Objects, kept: Sequence[int], source: tuple[Source, ...]) -> Objects:
    tensors = [f.name for f in fields(Objects) if f.name != "source"]
    return replace(objects, source=source, **{name: getattr(objects, name)[list(kept)] for name in tensors})


def _renumber_provenance(provenance: Mapping[str, str], kept: Sequence[int]) -> dict[str, str]:
    """What is told of `objects[i]` goes along with its object."""
    place = {row: i for i, row in enumerate(kept)}
    found = {}
    for key, value in provenance.items():
        match = _ROW.fullmatch(key)
        if match is None:
            found[key] = value
        elif int(match[1]) in place:
            found[f"objects[{place[int(match[1])]}]{match[2]}"] = value
    return found


@torch.no_grad()
def complete_uncovered_sources(
    scene: SceneIR, removed: Collection[int], settings: RenderSettings | None = None
) -> tuple[Source, ...]:
    """The sources of all objects, those behind a removed one completed where it stood."""
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
    """(H, W) bool: where any of the foregrounds, Crops (4, h, w), is not wholly transparent."""
    mask = torch.zeros(frame_hw, dtype=torch.bool)
    for crop in foregrounds:
        _window(mask[None], crop).logical_or_(crop.values[3:].cpu() > 0)
    return mask


def _complete_source(source: Source, layers: ObjectLayers, row: int, hidden: Tensor) -> Source:
    """The source with its foreground as `layers` draw it where `hidden` (H, W), as it was elsewhere."""
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
    here = _window(canvas, new)
    taken = _window(hidden[None], new)
    if not bool((taken & ((drawn[3:] > 0) | (here[3:] > 0))).any()):
        return source
    here.copy_(torch.where(taken, drawn, here))
    _window(used[None], new).logical_or_(taken & (drawn[3:] > 0))
    rows, columns = used.any(dim=1).nonzero()[:, 0], used.any(dim=0).nonzero()[:, 0]
    left, top = int(columns[0]), int(rows[0])
    values = canvas[:, top : int(rows[-1]) + 1, left : int(columns[-1]) + 1].contiguous()
    return replace(source, foreground=Crop(values, left, top))


def _window(frame: Tensor, crop: Crop) -> Tensor:
    """The view of a frame (C, H, W) that a crop lies on."""
    h, w = crop.values.shape[1:]
    return frame[:, crop.y0 : crop.y0 + h, crop.x0 : crop.x0 + w]
