"""How well methods fill the holes that removed vehicles leave, as a Markdown table.

python -m tools.compare_fills --frames 8

Generated streets of the held-out pools; the generator's own picture without the vehicles is the truth. All methods
get the same holes: the pixels that truly change, grown by 3 px. PSNR over the holes, and over their ground and
upright parts by the true depth; a perceptual distance, less is better; processor seconds; medians over the frames.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from drivesem.synth.layout import footprint
from scene_ir.derender import ground_geometry as maps
from scene_ir.derender import patch_fill as background
from scene_ir.derender import segmentation as segment
from scene_ir.derender import standing_surfaces as upright
from scene_ir.derender import street
from scene_ir.derender.derender import VEHICLE_CATEGORIES
from scene_ir.derender.silhouette import grow_mask
from tools.bench.derender import changed_region, make_case, share_of, without
from tools.bench.pictures import psnr
from tools.experiments.realism.perceptual import PerceptualDistance, Picture

Mask = NDArray[np.bool_]
SEED = 0
_SAME_DEPTH = 0.08
"""Relative difference from the plane's depth up to which a pixel is ground."""
_OPENCV_PX = 4.0
"""Radius of OpenCV's methods."""


@dataclass(frozen=True, slots=True)
class Hole:
    """photograph, truth (H, W, 3) uint8; hole, ground, people (H, W): what to fill, what of it is ground, and what
    nothing may be copied from; shares: what the photograph looks like, and where the vehicles stood."""

    photograph: Picture
    truth: Picture
    hole: Mask
    ground: Mask
    people: Mask
    plane: street.GroundCoordinates
    shares: street.StreetShares
    horizon: float

    @property
    def image(self) -> NDArray[np.float32]:
        """The photograph in [0, 1]."""
        return self.photograph.astype(np.float32) / np.float32(255)

    @property
    def forbidden(self) -> Mask:
        """Pixels that are no source."""
        return grow_mask(self.hole, 2) | self.people

    @property
    def like(self) -> NDArray[np.float32]:
        """How much (H, W) each pixel that may be copied looks like ground."""
        return np.where(self.forbidden, 0, self.shares.ground).astype(np.float32)


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    options = parser.parse_args()
    holes = [make_hole(index) for index in range(options.frames)]
    perception = PerceptualDistance()
    lines = [
        "| method | PSNR, dB | ground | upright | perceptual | seconds |",
        "|---|---|---|---|---|---|",
    ]
    for name in options.methods:
        figures = np.array([_figures(hole, METHODS[name], perception) for hole in holes])
        lines.append(f"| {name} | " + " | ".join(f"{value:.2f}" for value in np.nanmedian(figures, axis=0)) + " |")
    sys.stdout.write("\n".join(lines) + "\n")
    return 0


def make_hole(index: int) -> Hole:
    """The hole that all vehicles of a generated street leave."""
    case = make_case(SEED, index)
    before = case.before
    tracks = [t.actor.track for t in before.truths if t.actor.label in VEHICLE_CATEGORIES]
    empty = without(case, tracks)
    hole = changed_region(before, empty, tracks)
    people = np.zeros(hole.shape, bool)
    for truth in before.truths:
        if truth.actor.track not in tracks:
            people |= share_of(before, truth.actor.track) > 0
    plane = street.ground_coordinates(before.environment.ground, before.camera)
    flat = np.isfinite(plane.along) & np.isfinite(empty.depth_m)
    along, depth = np.where(flat, plane.along, 1.0), np.where(flat, empty.depth_m, 2.0)
    ground = flat & (np.abs(along - depth) < _SAME_DEPTH * depth)
    horizon = maps.horizon_row(before.environment.ground, before.camera)
    image = before.image.astype(np.float32) / np.float32(255)
    seen = segment.segment_photograph(image, before.environment.ground, before.camera)
    stood = np.zeros(hole.shape, bool)
    for truth in before.truths:
        if truth.actor.track in tracks:
            stood |= _inside(footprint(truth.actor.position_xz, truth.actor.yaw, truth.actor.size_lhw), plane)
    shares = street.StreetShares(seen.ground, seen.sky, stood & hole)
    return Hole(before.image, empty.image, hole, ground, people & ~hole, plane, shares, horizon)


def _inside(corners: NDArray[np.float64], plane: street.GroundCoordinates) -> Mask:
    """Pixels (H, W) that see the ground within a rectangle; corners (4, 2): (x, z) m, in order."""
    along = np.where(np.isfinite(plane.along), plane.along, -1.0)
    after = np.roll(corners, -1, axis=0)
    sides = [
        (x1 - x0) * (along - z0) - (z1 - z0) * (plane.across - x0)
        for (x0, z0), (x1, z1) in zip(corners, after, strict=True)
    ]
    return (along > 0) & (np.all(np.stack(sides) > 0, 0) | np.all(np.stack(sides) < 0, 0))


def _figures(
    hole: Hole, method: Callable[[Hole], NDArray[np.float32]], perception: PerceptualDistance
) -> list[float]:
    start = time.process_time()
    found = method(hole)
    seconds = time.process_time() - start
    picture = np.clip(np.rint(found * 255), 0, 255).astype(np.uint8)
    picture = np.where(hole.hole[..., None], picture, hole.truth)
    parts = [hole.hole, hole.hole & hole.ground, hole.hole & ~hole.ground]
    levels = [psnr(picture, hole.truth, part) if part.any() else float("nan") for part in parts]
    return [*levels, perception.distance(picture, hole.truth, hole.hole), seconds]


def _opencv(kind: int) -> Callable[[Hole], NDArray[np.float32]]:
    def run(hole: Hole) -> NDArray[np.float32]:
        filled = cv2.inpaint(hole.photograph, grow_mask(hole.hole, 2).astype(np.uint8), _OPENCV_PX, kind)
        return np.asarray(filled, np.float32) / np.float32(255)

    return run


def _xphoto(kind: int) -> Callable[[Hole], NDArray[np.float32]]:
    def run(hole: Hole) -> NDArray[np.float32]:
        valid = (~grow_mask(hole.hole, 2)).astype(np.uint8) * 255
        shift_map = kind == cv2.xphoto.INPAINT_SHIFTMAP
        source = cv2.cvtColor(hole.photograph, cv2.COLOR_RGB2Lab) if shift_map else hole.photograph[..., ::-1]
        target = np.zeros_like(hole.photograph)
        cv2.xphoto.inpaint(np.ascontiguousarray(source), valid, target, kind)
        filled = cv2.cvtColor(target, cv2.COLOR_Lab2RGB) if shift_map else target[..., ::-1]
        return np.asarray(filled, np.float32) / np.float32(255)

    return run


def _smooth(hole: Hole) -> NDArray[np.float32]:
    return background.push_pull(hole.image, (~hole.forbidden).astype(np.float32))


def _patches(hole: Hole) -> NDArray[np.float32]:
    known_ground = background.GroundMaps(hole.hole & hole.ground, hole.like)
    return background.fill_patches(hole.image, hole.hole, hole.forbidden, hole.horizon, known_ground)


def _continued(hole: Hole) -> street.StreetContinuation:
    return street.continue_street(hole.image, hole.forbidden, hole.shares, hole.plane, hole.horizon)


def _street(hole: Hole) -> NDArray[np.float32]:
    return _continued(hole).image


def _street_patches(hole: Hole) -> NDArray[np.float32]:
    guide = _continued(hole)
    known_ground = background.GroundMaps(guide.ground, hole.like)
    return background.fill_patches(
        hole.image, hole.hole, hole.forbidden, hole.horizon, known_ground, guide=guide.image
    )


def _columns_and_patches(hole: Hole) -> NDArray[np.float32]:
    guide = _continued(hole)
    found = upright.copy_columns(hole.image, hole.hole, hole.forbidden | (hole.like > 0.5), guide, hole.horizon)
    rest, forbidden = hole.hole & ~found.copied, hole.forbidden & ~found.copied
    known_ground = background.GroundMaps(guide.ground, hole.like)
    return background.fill_patches(found.image, rest, forbidden, hole.horizon, known_ground, guide=guide.image)


METHODS: dict[str, Callable[[Hole], NDArray[np.float32]]] = {
    "Telea": _opencv(cv2.INPAINT_TELEA),
    "Navier-Stokes": _opencv(cv2.INPAINT_NS),
    "FSR, fast": _xphoto(cv2.xphoto.INPAINT_FSR_FAST),
    "ShiftMap": _xphoto(cv2.xphoto.INPAINT_SHIFTMAP),
    "push-pull": _smooth,
    "patches, true ground": _patches,
    "street": _street,
    "street and patches": _street_patches,
    "street, columns and patches": _columns_and_patches,
}


if __name__ == "__main__":
    raise SystemExit(main())
