"""Error of the estimated depth of a photograph's surroundings, against exact depth, a laser, and in fog."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from drivesem.bench.session import Columns
from drivesem.config.options import DEMO
from drivesem.data.registry import open_dataset
from drivesem.reporting.drawing import write_picture
from drivesem.synth.frames import SynthSettings, generate_frame
from scene_ir.derender import depth
from scene_ir.derender import depth as maps
from scene_ir.derender import segmentation as segment
from scene_ir.derender.derender import derender
from scene_ir.geometry import to_clip
from scene_ir.io import to_uint8
from scene_ir.render import model
from scene_ir.render.compositor import render
from scene_ir.types import Camera, Frame, Labels, SceneIR
from tools.bench.found import SceneFolder
from tools.bench.settings import BenchTool

Array = NDArray[np.float32]

TITLE = "Depth of photographs' surroundings"
COLUMNS: Columns = {
    "source": ("frames of", "of"), "depth": ("depth", "depth"), "frames": ("frames", "frames"),
    "abs_rel": ("relative error", "abs-rel"), "within": ("within 1.25", "<1.25"),
    "abs_rel_up": ("relative error, upright", "abs-rel up"), "within_up": ("within 1.25, upright", "<1.25 up"),
    "bands_px": ("bands in fog, px", "bands"), "worst_px": ("most bands, px", "worst"),
}  # fmt: skip
METHOD = (
    "Frames are de-rendered. Compared is the depth of the street behind and around the vehicles: walls "
    "guessed on the upper end of the ground (what drivesem used before), those walls relaxed along the "
    "picture's edges (Min et al. 2014), the network's, and the mean of the two in logarithms, which drivesem "
    "uses. Generated frames, of the held-out pools, are held against the generator's depth up to 120 m, "
    "KITTI's against the laser's points outside the vehicles, where a frame has any (bands are counted in all "
    "frames). Relative error: mean of |d - d*| / d*; within 1.25: share of pixels with a smaller ratio; "
    "upright: of what is at least 10 % nearer than the ground. Bands in fog: at code 1, transmission changes "
    "by more than 0.12 within 2.6 % of the width, though the picture's smoothed colours change by less than "
    "0.06, in runs of at least 24 rows; rows of such runs, px a frame. 'exact' is the generator's own depth: "
    "edges that no colours show."
)
QUICK_FRAMES, FULL_FRAMES = 6, 40
_GENERATED, USED = "generated", "both, as used"
FAR_M = 120.0
"""Farther truths are not compared: fog hides what is there."""
_STREAM_SEED = 53
"""Of the generated frames: neither that of the network's training nor of any other test."""


@dataclass(frozen=True, slots=True)
class DepthStreet:
    """What a guess goes by: the picture (H, W, 3) in [0, 1] without vehicles, the ground's plane (4,), and what is
    known besides."""

    picture: Array
    plane: Tensor
    camera: Camera
    ties: depth.DepthConstraints

    @staticmethod
    def of(scene: SceneIR) -> DepthStreet:
        """A scene's street."""
        picture = np.ascontiguousarray(scene.background.numpy().transpose(1, 2, 0))
        plane, camera, objects = scene.environment.ground, scene.camera, scene.objects
        seen = segment.segment_photograph(picture, plane, camera)
        count = len(objects)
        labels = Labels(
            ("Car",) * count, objects.box2d, objects.truncation, objects.occlusion,
            objects.translation, objects.yaw, objects.size_lhw, torch.zeros(0, 4),
        )  # fmt: skip
        stood = maps.draw_footprints(labels, list(range(count)), plane, camera)
        return DepthStreet(
            picture, plane, camera, depth.DepthConstraints(seen.sky, seen.ground, stood, np.zeros_like(stood))
        )

    def guesses(self) -> dict[str, Array]:
        """Depths (H, W) m by name: what the depth that is used is made of, and what was used before."""
        outlook, ties = depth.GroundFrame.from_image(self.picture, self.plane, self.camera), self.ties
        horizon = maps.horizon_row(self.plane, self.camera)
        nearness = {
            "walls, relaxed": depth.nearness_by_rule(outlook, ties),
            "network alone": depth.nearness_by_network(outlook, ties.flat),
        }
        guessed = maps.compute_wall_depth(outlook.plane_m, ties.flat, ties.footprint, ties.sky, horizon)
        without_sky = {name: outlook.depth_m(near * (1 - ties.sky)) for name, near in nearness.items()}
        return {"guessed walls": guessed, **without_sky}


_WINDOW, _STEP, _COLOUR, _ROWS = 0.026, 0.12, 0.06, 24
"""Of a band's edge: the width, in image widths, within which transmission changes by more than a step; the change
of the smoothed picture from which on it is an edge; rows that it must run through."""


def bands_px(depth_m: Array, picture: Array) -> float:
    """Rows, px, of upright steps that fog would show and for which the picture (H, W, 3) has no edge. depth_m (H,
    W)."""
    seen = np.exp(-model.FOG_EXTINCTION_PER_M * np.minimum(depth_m, model.HAZE_CAP_M)).astype(np.float32)
    half = max(round(_WINDOW * depth_m.shape[1] / 2), 1)
    smooth = np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.4 * half), np.float32)

    def across(values: Array) -> Array:
        wide = np.pad(values, ((0, 0), (half, half)) + ((0, 0),) * (values.ndim - 2), mode="edge")
        return np.abs(wide[:, 2 * half :] - wide[:, : -2 * half])

    steps = (across(seen) > _STEP) & (across(smooth).max(-1) < _COLOUR)
    upright = cv2.morphologyEx(steps.astype(np.uint8), cv2.MORPH_OPEN, np.ones((_ROWS, 1), np.uint8))
    return float(upright.sum()) / (2 * half)


def laser_m(points: Tensor, scene: SceneIR) -> Array:
    """Depth (H, W) m of the laser's points (P, 3) that the camera sees outside the vehicles; inf elsewhere."""
    camera = scene.camera
    clip = to_clip(points.double(), camera.matrix.double()).numpy()
    clip = clip[clip[:, 2] > 1]
    u, v = (np.rint(clip[:, i] / clip[:, 2]).astype(int) for i in (0, 1))
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    depth = np.full((camera.height, camera.width), np.inf)
    np.minimum.at(depth, (v[inside], u[inside]), clip[inside, 2])
    # The laser stands above the camera and sees past edges: what is behind its neighbours is not in the picture.
    near = cv2.erode(np.minimum(depth, 1e4).astype(np.float32), np.ones((7, 5), np.uint8))
    changed = (scene.background != scene.photograph).any(0).numpy()
    return np.where((depth > 1.1 * near + 0.3) | changed, np.inf, depth).astype(np.float32)


@dataclass(frozen=True, slots=True)
class DepthRow:
    """One depth of one frame. Errors are None where no truth is known."""

    source: str
    frame: str
    depth: str
    bands_px: float
    abs_rel: float | None = None
    within: float | None = None
    abs_rel_up: float | None = None
    within_up: float | None = None


def depth_row(
    source: str, name: str, kind: str, found: Array, truth: Array | None, street: DepthStreet
) -> DepthRow:
    """A depth (H, W) m held against the truth (H, W) m, inf where it is not known."""
    bands = round(bands_px(found, street.picture), 1)
    known = None if truth is None else truth < FAR_M
    if truth is None or known is None or not known.any():
        return DepthRow(source, name, kind, bands)
    true = truth[known]
    guess = np.minimum(found[known], model.HAZE_CAP_M)
    error, ratio = np.abs(guess - true) / true, np.maximum(guess / true, true / guess)
    up = true < 0.9 * maps.compute_plane_depth(street.plane, street.camera)[known]
    near = ratio < 1.25
    metrics = [float(m.mean()) for m in (error, near, error[up], near[up])]
    return DepthRow(source, name, kind, bands, *(round(figure, 4) for figure in metrics))


def judge(source: str, name: str, scene: SceneIR, truth: Array | None, sheets: Path | None) -> list[DepthRow]:
    """Rows of the network's depth, which the scene has, and of its rivals. sheets: folder for pictures of fog."""
    street = DepthStreet.of(scene)
    depths = {**street.guesses(), USED: scene.depth.numpy()}
    if sheets is not None:
        panels = [to_uint8(scene.photograph), *(in_fog(scene, depths[k]) for k in ("guessed walls", USED))]
        write_picture(sheets / f"{source}_{name.replace('/', '_')}.png", np.concatenate(panels))
    rows = [depth_row(source, name, kind, found, truth, street) for kind, found in depths.items()]
    if source == _GENERATED and truth is not None:
        rows.append(DepthRow(source, name, "exact", round(bands_px(truth, street.picture), 1)))
    return rows


def in_fog(scene: SceneIR, depth_m: Array) -> NDArray[np.uint8]:
    """The scene (H, W, 3) in fog of code 1, with another depth (H, W) m."""
    weather = torch.zeros_like(scene.environment.weather)
    weather[0] = 1
    changed = replace(
        scene, depth=torch.from_numpy(depth_m), environment=replace(scene.environment, weather=weather)
    )
    return to_uint8(render([changed])[0].image)


def measure(config: BenchTool, frames: int, sheets: Path | None) -> Iterator[list[DepthRow]]:
    """Rows of a frame at a time: of generated ones, then of the data set and the scenes that are given. Raises
    SceneError for what cannot be read."""
    settings = SynthSettings(bent=True)
    for index in range(frames):
        made = generate_frame(_STREAM_SEED, index, "heldout", settings, with_background=True)
        picture = torch.from_numpy(made.image.transpose(2, 0, 1).astype(np.float32) / np.float32(255))
        name = f"{index:03d}"
        scene = derender(Frame(name, picture, made.camera, made.labels))
        yield judge(_GENERATED, name, scene, made.background_depth_m, sheets)
    if config.dataset != DEMO:
        dataset = open_dataset(config.dataset, Path(config.root or ""), _has_points(config))
        for name in dataset.identifiers[: config.limit]:
            frame = dataset.frame(name)
            scene = derender(replace(frame, points=None, depth=None))
            truth = None if frame.points is None else laser_m(frame.points, scene)
            yield judge(config.dataset, name, scene, truth, sheets)
    if config.scenes is not None:
        folder = SceneFolder(Path(config.scenes))
        for name in folder.identifiers():
            yield judge("scenes", name, folder.scene(name), None, sheets)


def _has_points(config: BenchTool) -> bool:
    """Whether a KITTI folder has the laser's points, of some frames at least."""
    root = Path(config.root or "")
    return config.dataset == "kitti" and any((root / part / "velodyne").is_dir() for part in ("", "training"))


def count(config: BenchTool, frames: int) -> int:
    """How many frames `measure` goes through."""
    if config.dataset != DEMO:
        frames += len(open_dataset(config.dataset, Path(config.root or "")).identifiers[: config.limit])
    return frames + (0 if config.scenes is None else len(list(SceneFolder(Path(config.scenes)).identifiers())))


def summary(rows: Sequence[DepthRow]) -> list[dict[str, Any]]:
    """A line for each source and depth: means over frames, errors over those with a truth."""
    lines = []
    for source, kind in dict.fromkeys((row.source, row.depth) for row in rows):
        mine = [row for row in rows if (row.source, row.depth) == (source, kind)]
        bands = [row.bands_px for row in mine]
        line: dict[str, Any] = {"source": source, "depth": kind, "frames": len(mine)}
        line |= {"bands_px": round(float(np.mean(bands)), 1), "worst_px": max(bands)}
        for name in ("abs_rel", "within", "abs_rel_up", "within_up"):
            known = [value for row in mine if (value := getattr(row, name)) is not None]
            line[name] = round(float(np.mean(known)), 3) if known else None
        lines.append(line)
    return lines
