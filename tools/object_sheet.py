"""Contact sheets of the classifiers' objects, to see whether a person knows each class at a glance.

    python -m tools.object_sheet OUT.png [--objects FOLDER] [--classes bus train] [--each 6] [--size 160]

A row a class and view (forward, top, left, right), a column an object. Plain shading: a light beside the camera.

    python -m tools.object_sheet OUT.png --beside mitsuba

draws two held-out objects of each class, 24 pictures with all views, by the project's renderer and by a second one
beside it, and prints how alike they are.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from drivesem.classify import scenes
from drivesem.classify.confirm import open_renderer
from drivesem.classify.objects.sources import open_objects
from drivesem.classify.objects.types import ObjectModel, ObjectSet
from drivesem.classify.redraw.base import Solid, likeness
from drivesem.synth.soup import creased_normals
from scene_ir import files
from scene_ir.io import to_uint8
from scene_ir.raster.verbs import Layout, interpolate, rasterize

VIEWS = {"forward": (0.0, 0.0), "top": (0.0, 0.35), "left": (-0.5, 0.0), "right": (0.5, 0.0)}
"""Turn about the vertical and elevation of the camera, rad, as in the paper."""
_DISTANCE = 2.4
_FOCAL = 2.1
"""In widths of the picture."""
_BACKGROUND = 0.62
_LIGHT = torch.tensor([0.4, 0.6, -1.0])
"""Towards the light, from the camera's place: x right, y up, z away from the camera."""


def picture(model: ObjectModel, view: tuple[float, float], size: int) -> np.ndarray:
    """An object as (size, size, 3) uint8, seen from before its front, the camera turned and raised."""
    wide = 2 * size
    corners = model.mesh.vertices[model.mesh.faces].double()
    normals = torch.from_numpy(creased_normals(10 * corners.numpy(), 0.7)).double()
    rotation = _camera(*view)
    seen, facing = corners.reshape(-1, 3) @ rotation.T, normals.reshape(-1, 3) @ rotation.T
    w = seen[:, 2] + _DISTANCE
    u, v = _FOCAL * wide * seen[:, 0] + wide / 2 * w, -_FOCAL * wide * seen[:, 1] + wide / 2 * w
    clip = torch.stack([u, v, w], 1).float()
    faces = torch.arange(len(clip)).reshape(-1, 3)
    layout = Layout.of(torch.tensor([[0, 0, wide, wide]]))
    fragments = rasterize(clip, faces, torch.tensor([[0, len(faces)]]), layout)
    rows = torch.cat([facing, seen, model.diffuse.repeat_interleave(3, 0)], 1)
    gloss = torch.stack([model.specular, model.shininess], 1).repeat_interleave(3, 0)
    values = interpolate(fragments, clip, faces, torch.cat([rows, gloss], 1).float())
    normal, place, diffuse, specular, shininess = values.split([3, 3, 3, 1, 1], dim=1)
    normal = torch.nn.functional.normalize(normal, dim=1)
    light = torch.nn.functional.normalize(_LIGHT, dim=0)
    eye = torch.nn.functional.normalize(-place - torch.tensor([0.0, 0.0, _DISTANCE]), dim=1)
    half = torch.nn.functional.normalize(light + eye, dim=1)
    lit = (normal @ light).clamp(min=0)[:, None] * 0.85 + 0.25
    shine = specular * (normal * half).sum(1, keepdim=True).clamp(min=0) ** shininess * 0.6
    rgb = (diffuse * lit + shine).clamp(0, 1) ** (1 / 2.2)
    rgb = torch.where(fragments.face[:, None] >= 0, rgb, torch.tensor(_BACKGROUND))
    small = rgb.reshape(size, 2, size, 2, 3).mean((1, 3))
    return (small * 255).round().byte().numpy()


def _camera(yaw: float, elevation: float) -> Tensor:
    """Rotation (3, 3) from the object's axes to x right, y up, z away, of a camera before its front (at -z)."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    turn = np.array([[-cos, 0.0, sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]])
    up, level = np.cos(elevation), np.sin(elevation)
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, up, level], [0.0, -level, up]])
    return torch.from_numpy(tilt @ turn)


@torch.no_grad()
def beside(objects: ObjectSet, second: str) -> np.ndarray:
    """The sheet of both renderers: in each of three columns the own picture, then the other."""
    renderer, rows, found = open_renderer(second), [], []
    for place, kind in enumerate(objects.classes):
        names = [name for name in objects.names("test") if name.startswith(f"{kind}/")]
        for name, view in zip(names, list(scenes.VIEWS)[place % 2 :: 2], strict=False):
            scene = scenes.ObjectScene(name, objects.load(name), view, scenes.generated_background(name))
            own = scene.mesh.render(scene.placed(), scenes.camera(), scene.lights())
            other = renderer.draw(Solid.of(scene))
            found.append(likeness(scene, own, other))
            print(f"{name} {view}: silhouettes IoU {found[-1].iou:.4f}, colours Delta E {found[-1].colour:.2f}")
            rows.append(np.hstack([to_uint8(scene.shown(drawn).clamp(0, 1)) for drawn in (own, other)]))
    ious, colours = [one.iou for one in found], [one.colour for one in found]
    print(
        f"{second}, {len(found)} views: IoU {np.mean(ious):.4f} in the mean, {min(ious):.4f} at least; "
        f"Delta E (CIE 1976) {np.mean(colours):.2f} in the mean, {max(colours):.2f} at most"
    )
    third = -(-len(rows) // 3)
    rows += [np.zeros_like(rows[0])] * (3 * third - len(rows))
    return np.hstack([np.vstack(rows[i * third : (i + 1) * third]) for i in range(3)])


def main() -> None:
    """Write the sheet."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--objects", help="a folder of meshes; without it, the embedded objects")
    parser.add_argument("--classes", nargs="+")
    parser.add_argument("--views", nargs="+", default=list(VIEWS), choices=list(VIEWS))
    parser.add_argument("--each", type=int, default=6, help="objects a class")
    parser.add_argument("--start", type=int, default=0, help="the first of them")
    parser.add_argument("--size", type=int, default=160, help="px a picture")
    parser.add_argument("--beside", choices=("mitsuba", "pyrender"), help="a second renderer")
    told = parser.parse_args()
    objects = open_objects(told.objects)
    if told.beside is not None:
        files.write_png(told.out, beside(objects, told.beside))
        return
    names = objects.names("train")
    rows = []
    for name in told.classes or objects.classes:
        own = [n for n in names if n.startswith(f"{name}/")][told.start : told.start + told.each]
        models = [objects.load(n) for n in own]
        if not models:
            continue
        rows += [np.hstack([picture(m, VIEWS[view], told.size) for m in models]) for view in told.views]
    files.write_png(told.out, np.vstack(rows))


if __name__ == "__main__":
    main()
