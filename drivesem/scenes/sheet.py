"""An inspection sheet of a scene: the photograph beside all that was made of it, three panels a line.

Photograph, mattes, and normals of the meshes; depth, maps of the surroundings, and shadows; background, re-render
with nothing perturbed, and its difference from the photograph. Objects carry their row, as `drivesem edit` counts.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch

from drivesem.report.drawing import (
    MARGIN_PX,
    PAPER,
    TEXT_PX,
    depth_colours,
    pale,
    palette,
    paste,
    write_picture,
    write_text,
)
from drivesem.report.tables import number_of
from scene_ir.io import to_uint8
from scene_ir.raster import verbs
from scene_ir.render.compositor import Compositor
from scene_ir.render.surfaces import rotate
from scene_ir.types import Crop, SceneIR

PANEL_PX = 640
"""Width of a panel."""
_COLUMNS = 3
GAIN = 8
"""By which the difference is multiplied."""
MAPS = {"sky": (70, 150, 235), "foliage_map": (60, 180, 75), "road": (225, 90, 160)}
"""Colours of the maps of the surroundings."""
_NUMBER_INK = (255, 255, 255)


def write_scene_sheet(path: Path, scene: SceneIR, title: str) -> None:
    """Draw a scene's sheet into a file, PNG or JPEG by its name, atomically."""
    write_picture(path, scene_sheet(scene, title))


def scene_sheet(scene: SceneIR, title: str) -> np.ndarray:
    """The sheet (h, 3 * 640 + margins, 3) uint8 RGB. The re-render is of the scene as photographed."""
    still = scene.as_photographed()
    with torch.no_grad():
        compositor = Compositor(still)
        shown = compositor.render(still)
        meshes = _Meshes(still, compositor)
    photograph, again = to_uint8(still.photograph), to_uint8(shown.image)
    off = np.abs(again.astype(int) - photograph)
    count = len(scene.objects)
    kinds = ", ".join(name.removesuffix("_map") for name in MAPS)
    panels = (
        (f"photograph, {number_of(count, 'vehicle')}: outlines of their meshes", _outlined(meshes, photograph)),
        ("mattes", _numbered(still, _mattes(still, photograph))),
        ("normals of the meshes", _normals(meshes, photograph)),
        ("depth behind the vehicles (log, near is bright)", depth_colours(still.depth.cpu().numpy())),
        (f"maps: {kinds}", _maps(still)),
        ("shadows: what is left of the light", _shadows(still)),
        ("background", to_uint8(still.background)),
        ("re-render, nothing perturbed", again),
        (f"difference x {GAIN}: {_difference(off)}", np.minimum(off * GAIN, 255).astype(np.uint8)),
    )
    height, width = photograph.shape[:2]
    tall = max(round(PANEL_PX * height / width), 1)
    line = TEXT_PX + 8
    lines = -(-len(panels) // _COLUMNS)
    top = line + MARGIN_PX
    size = (top + lines * (line + tall + MARGIN_PX), MARGIN_PX + _COLUMNS * (PANEL_PX + MARGIN_PX), 3)
    sheet = np.full(size, PAPER, np.uint8)
    write_text(sheet, (MARGIN_PX, 4), f"{title}   {width}x{height} px")
    for i, (name, picture) in enumerate(panels):
        x = MARGIN_PX + i % _COLUMNS * (PANEL_PX + MARGIN_PX)
        y = top + i // _COLUMNS * (line + tall + MARGIN_PX)
        write_text(sheet, (x, y), name)
        how = cv2.INTER_AREA if width > PANEL_PX else cv2.INTER_NEAREST
        paste(sheet, (x, y + line), cv2.resize(picture, (PANEL_PX, tall), interpolation=how))
    return sheet


def _difference(off: np.ndarray) -> str:
    """Largest and mean of 8-bit differences."""
    if not off.any():
        return "none, to the last bit"
    return f"at most {off.max()} of 255, {(off > 0).any(axis=2).mean():.2%} of pixels"


def _window(image: np.ndarray, crop: Crop) -> np.ndarray:
    """The view of an image (H, W, ...) that a crop lies on."""
    h, w = crop.values.shape[1:]
    return image[crop.y0 : crop.y0 + h, crop.x0 : crop.x0 + w]


def _values(crop: Crop) -> np.ndarray:
    """A crop's values, (h, w, C) float32."""
    return crop.values.detach().cpu().float().permute(1, 2, 0).numpy()


def _mattes(scene: SceneIR, photograph: np.ndarray) -> np.ndarray:
    """Each object's colour, as strong as its matte is opaque, over the photograph in pale grey."""
    canvas = pale(photograph).astype(np.float32)
    for source, colour in zip(scene.objects.source, palette(len(scene.objects)), strict=False):
        here, opacity = _window(canvas, source.foreground), _values(source.foreground)[..., 3:]
        here += opacity * (colour - here)
    return canvas.round().astype(np.uint8)


def _numbered(scene: SceneIR, canvas: np.ndarray) -> np.ndarray:
    """The objects' rows, each in the middle of its box."""
    scale = canvas.shape[1] / PANEL_PX
    for row, (x0, y0, x1, y1) in enumerate(_boxes(scene)):
        x, y = round((x0 + x1) / 2 - 5 * scale), round((y0 + y1) / 2 - 9 * scale)
        if 0 <= x < canvas.shape[1] and 0 <= y < canvas.shape[0]:
            size = max(round(18 * scale), 6)
            write_text(canvas, (x + 1, y + 1), str(row), (0, 0, 0), size)
            write_text(canvas, (x, y), str(row), _NUMBER_INK, size)
    return canvas


def _boxes(scene: SceneIR) -> list[list[float]]:
    """xyxy px of what the mattes show of the objects; where there is nothing, far outside."""
    found = []
    for source in scene.objects.source:
        rows, columns = (_values(source.foreground)[..., 3] > 0.5).nonzero()
        x0, y0 = source.foreground.x0, source.foreground.y0
        box = (
            [columns.min() + x0, rows.min() + y0, columns.max() + x0, rows.max() + y0] if len(rows) else [-1e6] * 4
        )
        found.append([float(v) for v in box])
    return found


class _Meshes:
    """What the z-buffers found of each object's mesh, as photographed. regions: the slices of the frame that each
    object's crop covers; hit, depth_m (h, w), normal (h, w, 3) in camera axes: of each crop.
    """

    def __init__(self, scene: SceneIR, compositor: Compositor) -> None:
        self.regions: list[tuple[slice, slice]] = []
        self.hit: list[np.ndarray] = []
        self.depth_m: list[np.ndarray] = []
        self.normal: list[np.ndarray] = []
        if not len(scene.objects):
            return
        objects, fleet = compositor.moved(scene), compositor.fleet
        drawn = compositor.draw(objects)
        sharp, _ = fleet.normals(fleet.local(objects.ffd, objects.size_lhw))
        turned = rotate(sharp, fleet.spread(objects.yaw)).contiguous()
        normal = verbs.interpolate(drawn.mesh, drawn.geometry.clip, fleet.faces, turned)
        normal = torch.nn.functional.normalize(normal, dim=1)
        rects = drawn.mesh.layout.rects.tolist()
        for (packed, size), (x0, y0, x1, y1) in zip(drawn.mesh.layout.spans(), rects, strict=True):
            self.regions.append((slice(y0, y1), slice(x0, x1)))
            self.hit.append((drawn.mesh.face[packed] >= 0).reshape(size).cpu().numpy())
            self.depth_m.append(drawn.mesh.depth[packed].reshape(size).cpu().numpy())
            self.normal.append(normal[packed].reshape(*size, 3).cpu().numpy())


def _outlined(meshes: _Meshes, photograph: np.ndarray) -> np.ndarray:
    """The outlines of the meshes in the objects' colours."""
    canvas = photograph.copy()
    for region, hit, colour in zip(meshes.regions, meshes.hit, palette(len(meshes.hit)), strict=True):
        edge = hit & (cv2.erode(hit.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) == 0)
        canvas[region][edge] = colour
    return canvas


def _normals(meshes: _Meshes, photograph: np.ndarray) -> np.ndarray:
    """Normals as colours: red is right, green up, blue towards the camera."""
    canvas = pale(photograph)
    nearest = np.full(canvas.shape[:2], np.inf, np.float32)
    for region, hit, depth_m, normal in zip(
        meshes.regions, meshes.hit, meshes.depth_m, meshes.normal, strict=True
    ):
        front = hit & (depth_m < nearest[region])
        colours = 127.5 + 127.5 * normal * np.array([1.0, -1.0, -1.0], np.float32)
        canvas[region][front] = colours[front].round().astype(np.uint8)
        nearest[region][front] = depth_m[front]
    return canvas


def _maps(scene: SceneIR) -> np.ndarray:
    """The maps of the surroundings, each in its colour, over the background in grey: it is what they tell of."""
    canvas = (
        cv2.cvtColor(to_uint8(scene.background), cv2.COLOR_RGB2GRAY)[..., None]
        .repeat(3, axis=2)
        .astype(np.float32)
    )
    for name, colour in MAPS.items():
        share = 0.65 * getattr(scene.environment, name).detach().cpu().float().numpy()[..., None]
        canvas += share * (np.array(colour, np.float32) - canvas)
    return canvas.round().clip(0, 255).astype(np.uint8)


def _shadows(scene: SceneIR) -> np.ndarray:
    """The factors by which the objects darken the ground, multiplied."""
    canvas = np.ones((scene.camera.height, scene.camera.width, 3), np.float32)
    for source in scene.objects.source:
        if source.shadow is not None:
            here = _window(canvas, source.shadow)
            here *= _values(source.shadow)
    return (255 * canvas).round().clip(0, 255).astype(np.uint8)
