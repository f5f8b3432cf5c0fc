"""How far the levels of detail lie from the full meshes, in pixels, as a Markdown table.

python tools/measure_detail.py --kinds sedan bus --heights 40 100

Each template is drawn in a street of KITTI's camera at several yaws, as it is and deformed at random, once in full
and once as `scene_ir.meshes.lod.detail` gives it for that height, finer than the pixels that the figures are in.
Outline: mean over the yaws of the mean distance and of its 99th percentile, and the largest of all, px; depth: the
mean difference, cm; normals: mean angle, degrees.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_ir import ffd
from scene_ir.geometry import place_vertices, to_clip, vertex_normals
from scene_ir.meshes.lod import level_of_detail
from scene_ir.meshes.outlines import KINDS
from scene_ir.meshes.templates import template, typical_size_lhw
from scene_ir.raster import verbs
from scene_ir.types import LATTICE_POINTS, Mesh

FOCAL_PX = 721.5
CAMERA_HEIGHT_M = 1.65
"""KITTI's camera 2 (Geiger et al. 2013)."""
HEIGHTS_PX = (25.0, 40.0, 60.0, 100.0, 150.0, 250.0)
YAWS_RAD = (0.0, 0.45, 1.1, math.pi / 2, 2.2, -0.8)
BEND = 0.05
"""Amplitude of the random lattice offsets, as a share of the unit box: strains reach their feasible bounds."""
DRAWN_PX = 800.0
"""Height at which the pictures are drawn, so that outlines are known to a fraction of a pixel; at most 16 to 1."""
SEED = 0
"""Of the random deformations."""


@dataclass(frozen=True, slots=True)
class VehicleView:
    """A vehicle of size_lhw m, `height_px` high in the image, turned by yaw rad, bent by offsets (64, 3)."""

    size_lhw: tuple[float, float, float]
    height_px: float
    yaw: float
    offsets: Tensor

    @property
    def fine(self) -> float:
        """Drawn pixels a pixel."""
        return min(16.0, max(DRAWN_PX / self.height_px, 2.0))


@dataclass(frozen=True, slots=True)
class VehicleRender:
    """covered (h, w) bool; depth (h, w) m, inf outside; normals (h, w, 3) unit."""

    covered: NDArray[np.bool_]
    depth: NDArray[np.float32]
    normals: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class DetailError:
    """Outline: mean, 99th percentile and largest distance, px."""

    outline_mean: float
    outline_p99: float
    outline_max: float
    depth: float
    """Mean, m."""
    normals: float
    """Mean angle, degrees."""


def clip_coordinates(mesh: Mesh, view: VehicleView) -> tuple[Tensor, Tensor]:
    """Clip coordinates (V, 3) of the finely drawn vehicle, and its welded normals (V, 3)."""
    unit = mesh.vertices.float()
    bent = unit + ffd.lattice_weights(unit) @ view.offsets
    size, yaw = torch.tensor(view.size_lhw), torch.tensor(view.yaw)
    z = FOCAL_PX * view.size_lhw[1] / view.height_px
    points = place_vertices(bent, size, yaw, torch.tensor([0.0, CAMERA_HEIGHT_M, z]))
    weld = torch.unique(unit, dim=0, return_inverse=True)[1]
    welded = torch.zeros(int(weld.max()) + 1, 3).index_copy(0, weld, points)
    normals = vertex_normals(welded, weld[mesh.faces])[weld]
    focal = FOCAL_PX * view.fine
    return to_clip(points, torch.tensor([[focal, 0, 0, 0], [0, focal, 0, 0], [0, 0, 1.0, 0]])), normals


def draw(mesh: Mesh, clip: Tensor, normals: Tensor, rect: Sequence[int]) -> VehicleRender:
    """The mesh inside a rectangle (x0, y0, x1, y1) px."""
    layout = verbs.PixelLayout.from_rects(torch.tensor([list(rect)]))
    fragments = verbs.rasterize(clip, mesh.faces, torch.tensor([[0, len(mesh.faces)]]), layout)
    values = verbs.interpolate(fragments, clip, mesh.faces, normals)
    shape = (rect[3] - rect[1], rect[2] - rect[0])
    unit = torch.nn.functional.normalize(values, dim=1).reshape(*shape, 3)
    return VehicleRender(
        (fragments.face >= 0).reshape(shape).numpy(), fragments.depth.reshape(shape).numpy(), unit.numpy()
    )


def rim(covered: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels of the mask next to pixels outside it."""
    return covered & (cv2.erode(covered.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)


def apart(from_rim: NDArray[np.bool_], to_rim: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Distance from each pixel of one rim to the nearest of the other, in drawn pixels."""
    distance = cv2.distanceTransform((~to_rim).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    return np.asarray(distance, dtype=np.float32)[from_rim]


def compare(full: Mesh, coarse: Mesh, view: VehicleView) -> DetailError:
    """How far the coarse mesh's picture is from the full one's."""
    clips = [clip_coordinates(m, view) for m in (full, coarse)]
    px = torch.cat([c[:, :2] / c[:, 2:] for c, _ in clips])
    low, high = px.amin(dim=0).floor().int() - 4, px.amax(dim=0).ceil().int() + 5
    rect = [*low.tolist(), *high.tolist()]
    a, b = (draw(m, *c, rect) for m, c in zip((full, coarse), clips, strict=True))
    rims = rim(a.covered), rim(b.covered)
    distance = np.concatenate([apart(rims[0], rims[1]), apart(rims[1], rims[0])])
    both = a.covered & b.covered
    cosine = (a.normals[both] * b.normals[both]).sum(axis=1).clip(-1.0, 1.0)
    return DetailError(
        outline_mean=float((a.covered ^ b.covered).sum()) / float(rims[0].sum()) / view.fine,
        outline_p99=float(np.quantile(distance, 0.99)) / view.fine,
        outline_max=float(distance.max()) / view.fine,
        depth=float(np.abs(a.depth[both] - b.depth[both]).mean()),
        normals=float(np.degrees(np.arccos(cosine)).mean()),
    )


def bend(generator: torch.Generator, amplitude: float) -> Tensor:
    """Random lattice offsets (64, 3), symmetric left to right, the lowest layer on the ground."""
    offsets = ffd.symmetrise((2 * torch.rand(LATTICE_POINTS, 3, generator=generator) - 1) * amplitude)
    grid = offsets.reshape(4, 4, 4, 3)
    grid[:, -1, :, 1] = 0.0
    return grid.reshape(LATTICE_POINTS, 3)


def measure(kind: str, height_px: float, amplitude: float) -> tuple[Mesh, list[DetailError]]:
    """The level of detail of a kind at a height, and its deviation at each yaw."""
    full = template(kind, 0)
    coarse = level_of_detail(full, height_px)
    generator = torch.Generator().manual_seed(SEED)
    size = typical_size_lhw(kind, 0)
    views = [VehicleView(size, height_px, yaw, bend(generator, amplitude)) for yaw in YAWS_RAD]
    return coarse, [compare(full, coarse, view) for view in views]


def row(kind: str, height_px: float) -> str:
    """A line of the table."""
    coarse, plain = measure(kind, height_px, 0.0)
    _, bent = measure(kind, height_px, BEND)
    cells = [kind, f"{height_px:g}", str(template(kind, 0).faces.shape[0]), str(coarse.faces.shape[0])]
    for found in (plain, bent):
        cells += [
            f"{np.mean([d.outline_mean for d in found]):.3f}",
            f"{np.mean([d.outline_p99 for d in found]):.2f}",
            f"{max(d.outline_max for d in found):.2f}",
        ]
    cells += [f"{100 * np.mean([d.depth for d in plain]):.2f}", f"{np.mean([d.normals for d in plain]):.1f}"]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--heights", nargs="+", type=float, default=HEIGHTS_PX, help="of the vehicles, px")
    arguments = parser.parse_args()
    columns = ["kind", "height px", "triangles", "of detail", "mean", "99 %", "max"]
    columns += ["bent mean", "99 %", "max", "depth cm", "normals deg"]
    print("| " + " | ".join(columns) + " |")
    print("|---" + "|---:" * (len(columns) - 1) + "|")
    for kind in arguments.kinds:
        for height_px in arguments.heights:
            print(row(kind, height_px), flush=True)


if __name__ == "__main__":
    main()
