"""Inspection sheet of a scene: the photograph and all parts of the scene in panels, three per line.

Photograph, mattes, and normals of the meshes; depth, maps of the surroundings, and shadows; background, re-render
with nothing perturbed, and its difference from the photograph. Objects carry their row, the index in `drivesem edit`.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch

from drivesem.reporting.drawing import (
    MARGIN_PX,
    PAPER_COLOUR,
    TEXT_PX,
    colourise_depth,
    fade_to_grey,
    object_palette,
    paste,
    write_picture,
    write_text,
)
from drivesem.reporting.tables import format_count
from scene_ir.io import to_uint8
from scene_ir.raster import verbs
from scene_ir.render.compositor import Compositor
from scene_ir.render.surfaces import rotate_y
from scene_ir.types import Crop, SceneIR

PANEL_PX = 640
"""Width of a panel."""
_COLUMNS = 3
GAIN = 8
"""Factor of the difference."""
MAPS = {"sky": (70, 150, 235), "foliage_map": (60, 180, 75), "road": (225, 90, 160), "ego": (245, 190, 40)}
"""Colours of the environment's maps."""
_NUMBER_INK = (255, 255, 255)


def write_scene_sheet(path: Path, scene: SceneIR, title: str) -> None:
    """Write a scene's sheet atomically.

    Args:
        path: File, PNG or JPEG by its suffix.
        scene: Scene.
        title: Heading.
    """
    write_picture(path, scene_sheet(scene, title))


def scene_sheet(scene: SceneIR, title: str) -> np.ndarray:
    """Draw the sheet (h, 3 * 640 + margins, 3) uint8 RGB of the scene as photographed."""
    original = scene.as_photographed()
    with torch.no_grad():
        compositor = Compositor(original)
        render = compositor.render(original)
        meshes = _MeshBuffers(original, compositor)
    photograph, rerendered = to_uint8(original.photograph), to_uint8(render.image)
    difference = np.abs(rerendered.astype(int) - photograph)
    count = len(scene.objects)
    kinds = ", ".join(name.removesuffix("_map") for name in MAPS)
    panels = (
        (
            f"photograph, {format_count(count, 'object')}: outlines of their meshes",
            _draw_outlines(meshes, photograph),
        ),
        ("mattes", _draw_rows(original, _draw_mattes(original, photograph))),
        ("normals of the meshes", _draw_normals(meshes, photograph)),
        ("depth behind the objects (log, near is bright)", colourise_depth(original.depth.cpu().numpy())),
        (f"maps: {kinds}", _draw_maps(original)),
        ("shadows: what is left of the light", _draw_shadows(original)),
        ("background", to_uint8(original.background)),
        ("re-render, nothing perturbed", rerendered),
        (
            f"difference x {GAIN}: {_format_difference(difference)}",
            np.minimum(difference * GAIN, 255).astype(np.uint8),
        ),
    )
    height, width = photograph.shape[:2]
    tall = max(round(PANEL_PX * height / width), 1)
    line = TEXT_PX + 8
    lines = -(-len(panels) // _COLUMNS)
    top = line + MARGIN_PX
    size = (top + lines * (line + tall + MARGIN_PX), MARGIN_PX + _COLUMNS * (PANEL_PX + MARGIN_PX), 3)
    sheet = np.full(size, PAPER_COLOUR, np.uint8)
    write_text(sheet, (MARGIN_PX, 4), f"{title}   {width}x{height} px")
    for i, (name, picture) in enumerate(panels):
        x = MARGIN_PX + i % _COLUMNS * (PANEL_PX + MARGIN_PX)
        y = top + i // _COLUMNS * (line + tall + MARGIN_PX)
        write_text(sheet, (x, y), name)
        interpolation = cv2.INTER_AREA if width > PANEL_PX else cv2.INTER_NEAREST
        paste(sheet, (x, y + line), cv2.resize(picture, (PANEL_PX, tall), interpolation=interpolation))
    return sheet


def _format_difference(difference: np.ndarray) -> str:
    """Format the maximum and the share of 8-bit differences."""
    if not difference.any():
        return "none, to the last bit"
    return f"at most {difference.max()} of 255, {(difference > 0).any(axis=2).mean():.2%} of pixels"


def _window(image: np.ndarray, crop: Crop) -> np.ndarray:
    """Return the part of an image (H, W, ...) below a crop, as a view."""
    h, w = crop.values.shape[1:]
    return image[crop.y0 : crop.y0 + h, crop.x0 : crop.x0 + w]


def _values(crop: Crop) -> np.ndarray:
    """Return a crop's values, (h, w, C) float32."""
    return crop.values.detach().cpu().float().permute(1, 2, 0).numpy()


def _draw_mattes(scene: SceneIR, photograph: np.ndarray) -> np.ndarray:
    """Draw mattes in the objects' colours over the pale grey photograph."""
    canvas = fade_to_grey(photograph).astype(np.float32)
    for source, colour in zip(scene.objects.source, object_palette(len(scene.objects)), strict=False):
        here, opacity = _window(canvas, source.foreground), _values(source.foreground)[..., 3:]
        here += opacity * (colour - here)
    return canvas.round().astype(np.uint8)


def _draw_rows(scene: SceneIR, canvas: np.ndarray) -> np.ndarray:
    """Write the objects' rows in the middle of their boxes."""
    scale = canvas.shape[1] / PANEL_PX
    for row, (x0, y0, x1, y1) in enumerate(_matte_boxes(scene)):
        x, y = round((x0 + x1) / 2 - 5 * scale), round((y0 + y1) / 2 - 9 * scale)
        if 0 <= x < canvas.shape[1] and 0 <= y < canvas.shape[0]:
            size = max(round(18 * scale), 6)
            write_text(canvas, (x + 1, y + 1), str(row), (0, 0, 0), size)
            write_text(canvas, (x, y), str(row), _NUMBER_INK, size)
    return canvas


def _matte_boxes(scene: SceneIR) -> list[list[float]]:
    """Return boxes xyxy px of the mattes; far outside for empty ones."""
    boxes = []
    for source in scene.objects.source:
        rows, columns = (_values(source.foreground)[..., 3] > 0.5).nonzero()
        x0, y0 = source.foreground.x0, source.foreground.y0
        box = (
            [columns.min() + x0, rows.min() + y0, columns.max() + x0, rows.max() + y0] if len(rows) else [-1e6] * 4
        )
        boxes.append([float(v) for v in box])
    return boxes


class _MeshBuffers:
    """Z-buffers of each object's mesh as photographed.

    For each object: its region's slices of the frame, and of that region `hit`, `depth_m` (h, w), and `normal`
    (h, w, 3) in camera axes.
    """

    def __init__(self, scene: SceneIR, compositor: Compositor) -> None:
        self.regions: list[tuple[slice, slice]] = []
        self.hit: list[np.ndarray] = []
        self.depth_m: list[np.ndarray] = []
        self.normal: list[np.ndarray] = []
        if not len(scene.objects):
            return
        objects, surfaces = compositor.perturbed_objects(scene), compositor.surfaces
        visible = compositor.find_visible(objects)
        sharp, _ = surfaces.normals(surfaces.local_vertices(objects.ffd, objects.size_lhw))
        turned = rotate_y(sharp, surfaces.per_vertex(objects.yaw)).contiguous()
        normal = verbs.interpolate(visible.mesh, visible.geometry.clip, surfaces.faces, turned)
        normal = torch.nn.functional.normalize(normal, dim=1)
        rects = visible.mesh.layout.rects.tolist()
        for (packed, size), (x0, y0, x1, y1) in zip(visible.mesh.layout.spans(), rects, strict=True):
            self.regions.append((slice(y0, y1), slice(x0, x1)))
            self.hit.append((visible.mesh.face[packed] >= 0).reshape(size).cpu().numpy())
            self.depth_m.append(visible.mesh.depth[packed].reshape(size).cpu().numpy())
            self.normal.append(normal[packed].reshape(*size, 3).cpu().numpy())


def _draw_outlines(meshes: _MeshBuffers, photograph: np.ndarray) -> np.ndarray:
    """Draw the outlines of the meshes in the objects' colours."""
    canvas = photograph.copy()
    for region, hit, colour in zip(meshes.regions, meshes.hit, object_palette(len(meshes.hit)), strict=True):
        edge = hit & (cv2.erode(hit.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) == 0)
        canvas[region][edge] = colour
    return canvas


def _draw_normals(meshes: _MeshBuffers, photograph: np.ndarray) -> np.ndarray:
    """Draw normals as colours: red is right, green up, blue towards the camera."""
    canvas = fade_to_grey(photograph)
    nearest = np.full(canvas.shape[:2], np.inf, np.float32)
    for region, hit, depth_m, normal in zip(
        meshes.regions, meshes.hit, meshes.depth_m, meshes.normal, strict=True
    ):
        front = hit & (depth_m < nearest[region])
        colours = 127.5 + 127.5 * normal * np.array([1.0, -1.0, -1.0], np.float32)
        canvas[region][front] = colours[front].round().astype(np.uint8)
        nearest[region][front] = depth_m[front]
    return canvas


def _draw_maps(scene: SceneIR) -> np.ndarray:
    """Draw the environment's maps, each in its colour, over the grey background."""
    canvas = (
        cv2.cvtColor(to_uint8(scene.background), cv2.COLOR_RGB2GRAY)[..., None]
        .repeat(3, axis=2)
        .astype(np.float32)
    )
    for name, colour in MAPS.items():
        share = getattr(scene.environment, name)
        if share is not None:
            opacity = 0.65 * share.detach().cpu().float().numpy()[..., None]
            canvas += opacity * (np.array(colour, np.float32) - canvas)
    return canvas.round().clip(0, 255).astype(np.uint8)


def _draw_shadows(scene: SceneIR) -> np.ndarray:
    """Draw the product of the objects' shadow factors."""
    canvas = np.ones((scene.camera.height, scene.camera.width, 3), np.float32)
    for source in scene.objects.source:
        if source.shadow is not None:
            here = _window(canvas, source.shadow)
            here *= _values(source.shadow)
    return (255 * canvas).round().clip(0, 255).astype(np.uint8)
