"""Contact sheets of the classifiers' objects, to see whether a person knows each class at a glance.

    python -m tools.object_sheet OUT.jpg [--objects FOLDER] [--classes bus train] [--each 2] [--size 112]

A row a class: each object from all views, as networks see it. By default two held-out objects of each class.

    python -m tools.object_sheet OUT.png --beside mitsuba

draws two held-out objects of each class, 24 pictures with all views, by the project's renderer and by a second one
beside it, and prints how alike they are.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch

from drivesem.classify.objects.embedded import open_objects
from drivesem.classify.objects.types import SPLITS, ObjectSet
from drivesem.classify.pictures import ObjectView
from drivesem.classify.scenes import VIEWS, ObjectScene, generate_background, picture_camera
from drivesem.classify.second_renderer import PosedObject, measure_agreement, open_second_renderer
from scene_ir import files
from scene_ir.io import to_uint8

_QUALITY = 80
"""Of a JPEG."""


@torch.no_grad()
def row(objects: ObjectSet, names: list[str], views: list[str], size: int) -> np.ndarray:
    """Objects from each view (size, N size, 3) uint8 RGB."""
    tiles = []
    for name in names:
        model = objects.load(name)
        for view in views:
            identifier = ObjectView("test", name, view).identifier
            scene = ObjectScene(identifier, model, view, generate_background(identifier))
            picture = to_uint8(scene.render().clamp(0, 1))
            tiles.append(cv2.resize(picture, (size, size), interpolation=cv2.INTER_AREA))
    return np.hstack(tiles)


@torch.no_grad()
def beside(objects: ObjectSet, second: str) -> np.ndarray:
    """The sheet of both renderers: in each of three columns the own picture, then the other."""
    renderer, rows, found = open_second_renderer(second), [], []
    for place, kind in enumerate(objects.classes):
        names = [name for name in objects.names("test") if name.startswith(f"{kind}/")]
        for name, view in zip(names, list(VIEWS)[place % 2 :: 2], strict=False):
            scene = ObjectScene(name, objects.load(name), view, generate_background(name))
            own = scene.mesh.render(scene.camera_vertices(), picture_camera(), scene.lights())
            other = renderer.render(PosedObject.from_scene(scene))
            found.append(measure_agreement(scene, own, other))
            print(f"{name} {view}: silhouettes IoU {found[-1].iou:.4f}, colours Delta E {found[-1].colour:.2f}")
            rows.append(np.hstack([to_uint8(scene.composite(drawn).clamp(0, 1)) for drawn in (own, other)]))
    ious, colours = [one.iou for one in found], [one.colour for one in found]
    print(
        f"{second}, {len(found)} views: IoU {np.mean(ious):.4f} in the mean, {min(ious):.4f} at least; "
        f"Delta E (CIE 1976) {np.mean(colours):.2f} in the mean, {max(colours):.2f} at most"
    )
    third = -(-len(rows) // 3)
    rows += [np.zeros_like(rows[0])] * (3 * third - len(rows))
    return np.hstack([np.vstack(rows[i * third : (i + 1) * third]) for i in range(3)])


def main(argv: Sequence[str] | None = None) -> None:
    """Write the sheet."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, help="a .jpg or .png file")
    parser.add_argument("--objects", help="a folder of meshes; without it, the embedded objects")
    parser.add_argument("--classes", nargs="+")
    parser.add_argument("--split", default="test", choices=SPLITS)
    parser.add_argument("--views", nargs="+", default=list(VIEWS), choices=list(VIEWS))
    parser.add_argument("--each", type=int, default=2, help="objects a class")
    parser.add_argument("--start", type=int, default=0, help="the first of them")
    parser.add_argument("--size", type=int, default=112, help="px a picture")
    parser.add_argument("--beside", choices=("mitsuba", "pyrender"), help="a second renderer")
    told = parser.parse_args(argv)
    if told.out.suffix not in (".jpg", ".png"):
        parser.error(f"out: expected a .jpg or .png file, found {told.out}")
    objects = open_objects(told.objects)
    if told.beside is not None:
        sheet = beside(objects, told.beside)
    else:
        rows = []
        for kind in told.classes or objects.classes:
            own = [name for name in objects.names(told.split) if name.startswith(f"{kind}/")]
            chosen = own[told.start : told.start + told.each]
            rows += [row(objects, chosen, told.views, told.size)] if chosen else []
        wide = max(one.shape[1] for one in rows)
        sheet = np.vstack([np.pad(one, ((0, 0), (0, wide - one.shape[1]), (0, 0))) for one in rows])
    if told.out.suffix == ".png":
        files.write_png(told.out, sheet)
    else:
        encoded = cv2.imencode(".jpg", sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
        files.write_bytes(told.out, encoded.tobytes())


if __name__ == "__main__":
    main()
