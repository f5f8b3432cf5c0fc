"""The embedded scenes and drive: synthetic streets as exact scenes, without de-rendering."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch

from drivesem.synth.frames import (
    VARIANTS,
    Plan,
    SynthFrame,
    SynthSettings,
    Truth,
    boxes_alone,
    full_boxes,
    plan_frame,
    render_frame,
    table,
)
from drivesem.synth.layout import LayoutSettings
from drivesem.synth.soup import GROUND
from drivesem.synth.view import blocks
from scene_ir.errors import RangeError
from scene_ir.meshes.templates import template
from scene_ir.render.sources import solve_sources
from scene_ir.types import LATTICE_POINTS, TEXTURE_DIM, Category, Crop, Mesh, Objects, SceneIR

_KINDS = ("residential", "city", "junction", "arterial", "residential", "motorway", "city", "arterial")
"""Roads of the scenes, in turn."""
_LAYOUT = LayoutSettings(variants=VARIANTS["heldout"], people=False, vehicles=(10, 18), max_heavy=1)
_FEWEST, _MOST = 6, 10
"""Vehicles in a scene."""
_CLEAR_CARS = 4
_CLEAR_HEIGHT_PX = 30.0
_LEAST_VISIBLE = 0.5
_LEAST_HEIGHT_PX = 26.0
_MOST_SCREENED = 0.02
"""Share of a vehicle that poles and plants may hide: its matte would carry their outline along."""
_ATTEMPTS = 400


def _fits(truth: Truth) -> bool:
    height, width = truth.box_xyxy[3] - truth.box_xyxy[1], truth.box_xyxy[2] - truth.box_xyxy[0]
    return (
        truth.visible >= _LEAST_VISIBLE and height >= _LEAST_HEIGHT_PX and width >= 12 and truth.truncation < 0.45
    )


def _clear(truth: Truth) -> bool:
    height = truth.box_xyxy[3] - truth.box_xyxy[1]
    return (
        truth.actor.label == "Car"
        and truth.occlusion <= 1
        and height >= _CLEAR_HEIGHT_PX
        and truth.truncation < 0.3
    )


def _thinned(plan: Plan) -> Plan | None:
    """The plan with only vehicles that can be seen well enough, or None where that leaves too few."""
    view = plan.setting.view
    boxes = full_boxes(plan.actors, view)
    large = boxes[:, 3] - boxes[:, 1] >= _LEAST_HEIGHT_PX
    reaching = (boxes[:, 2] > 40) & (boxes[:, 0] < view.camera.width - 40) & (boxes[:, 1] > 0)
    plan = replace(plan, actors=tuple(a for a, keep in zip(plan.actors, large & reaching, strict=True) if keep))
    for _ in range(4):
        if len(plan.actors) < _FEWEST:
            return None
        truths = boxes_alone(plan)
        usable = [t for t in truths if _fits(t)]
        usable = sorted(sorted(usable, key=lambda t: (t.translation[2], t.index))[:_MOST], key=lambda t: t.index)
        if len(usable) < _FEWEST or sum(map(_clear, usable)) < _CLEAR_CARS:
            return None
        if len(usable) == len(plan.actors):
            return plan
        plan = replace(plan, actors=tuple(t.actor for t in usable))
    return None


def _accepted(truths: Sequence[Truth], count: int) -> bool:
    return (
        len(truths) == count
        and all(t.screened <= _MOST_SCREENED and t.visible >= _LEAST_VISIBLE for t in truths)
        and sum(map(_clear, truths)) >= _CLEAR_CARS
    )


def demo_plan(seed: int, index: int, attempt: int) -> Plan | None:
    """What an attempt at embedded scene `index` of stream `seed` would show; None where too few vehicles of it can
    be seen. A scene's provenance names its attempt.
    """
    layout = replace(_LAYOUT, kinds=(_KINDS[index % len(_KINDS)],))
    settings = SynthSettings(layout, sunny=True, tilt_rad=0.004)
    return _thinned(plan_frame(seed, index, "heldout", settings, attempt))


def demo_scene(seed: int, index: int) -> SceneIR:
    """Embedded scene `index` of stream `seed`: shapes, surroundings and seeds that no training frame has.

    6 to 10 vehicles, at most one truck or bus, at least 4 cars of 30 px or more that are hardly hidden.
    Raises RangeError for a negative index.
    """
    if index < 0:
        raise RangeError("demo scene", "an index of at least 0", index)
    for attempt in range(_ATTEMPTS):
        plan = demo_plan(seed, index, attempt)
        if plan is None:
            continue
        count = len(plan.actors)
        frame = render_frame(plan, True, lambda truths, count=count: _accepted(truths, count))
        if frame is not None:
            return take_apart(frame, f"demo-{index:03d}")
    raise RangeError(f"demo scene {index} of seed {seed}", f"a street within {_ATTEMPTS} attempts", "none")


def take_apart(frame: SynthFrame, name: str, shape: Callable[[str, int], Mesh] = template) -> SceneIR:
    """The scene of a frame rendered with its background: exact objects, mattes, shadows and maps; all its actors
    must be vehicles that appear in the image. shape: the mesh of a kind and variant.
    """
    assert frame.background is not None
    assert frame.background_depth_m is not None
    truths = frame.truths
    vehicles = [t.actor for t in truths]
    meshes, index = [], []
    for actor in vehicles:
        mesh = shape(actor.kind, actor.variant)
        known = [m.name for m in meshes]
        index.append(known.index(mesh.name) if mesh.name in known else len(meshes))
        if mesh.name not in known:
            meshes.append(mesh)
    count = len(truths)

    objects = Objects(
        mesh_index=torch.tensor(index, dtype=torch.int64),
        translation=table([t.translation for t in truths], 3),
        yaw=torch.tensor([t.yaw for t in truths], dtype=torch.float32),
        size_lhw=table([a.size_lhw for a in vehicles], 3),
        ffd=torch.tensor([a.ffd or (0.0,) * (LATTICE_POINTS * 3) for a in vehicles], dtype=torch.float32).reshape(
            count, LATTICE_POINTS, 3
        ),
        texture_code=torch.zeros(count, TEXTURE_DIM),
        category=torch.tensor([int(Category.TRUCK if a.label == "Truck" else Category.CAR) for a in vehicles]),
        box2d=table([t.box_xyxy for t in truths], 4),
        truncation=torch.tensor([t.truncation for t in truths], dtype=torch.float32),
        occlusion=torch.tensor([t.occlusion for t in truths], dtype=torch.int64),
    )
    scene = SceneIR(
        camera=frame.camera,
        meshes=tuple(meshes),
        objects=objects,
        environment=frame.environment,
        photograph=_picture(frame.image),
        background=_picture(frame.background),
        depth=torch.from_numpy(frame.background_depth_m.copy()),
        ignore=frame.labels.ignore_xyxy,
        provenance={"dataset": "demo", "frame": name, **{k: str(v) for k, v in frame.manifest.items()}},
    )
    alphas = _mattes(frame)
    return solve_sources(scene, alphas, _shadows(frame, alphas))


def _picture(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image.transpose(2, 0, 1).astype(np.float32) / np.float32(255))


def _mattes(frame: SynthFrame) -> list[Crop]:
    """For each vehicle the share of each pixel that shows it, blurred as the lens blurs."""
    out = []
    height, width = frame.camera.height, frame.camera.width
    parts = blocks(frame.owner)
    for truth in frame.truths:
        own = truth.opacity.values.shape
        x0, y0 = max(truth.opacity.x0 - 3, 0), max(truth.opacity.y0 - 3, 0)
        x1, y1 = min(truth.opacity.x0 + own[2] + 3, width), min(truth.opacity.y0 + own[1] + 3, height)
        coverage = np.stack([p[y0:y1, x0:x1] == truth.index + 1 for p in parts]).mean(axis=0, dtype=np.float32)
        share = cv2.GaussianBlur(coverage, (5, 5), frame.setting.response.blur_px)
        share[share < 1e-3] = 0
        out.append(Crop(torch.from_numpy(np.minimum(share, 1.0))[None], x0, y0))
    return out


def _shadows(frame: SynthFrame, alphas: list[Crop]) -> list[Crop | None]:
    """For each vehicle the factor (3, h, w) by which it darkens the ground, split where several do by who stands
    between the ground and the sun, and who stands near.
    """
    setting, camera = frame.setting, frame.camera
    covered = np.zeros((camera.height, camera.width), bool)
    for alpha in alphas:
        h, w = alpha.values.shape[1:]
        covered[alpha.y0 : alpha.y0 + h, alpha.x0 : alpha.x0 + w] |= alpha.values[0].numpy() > 0
    assert frame.background is not None
    photo, plain = frame.image.astype(np.float32), frame.background.astype(np.float32)
    factor = np.clip((photo + 0.5) / (plain + 0.5), 0, 1)
    ground = np.isin(frame.ground_material, [int(m) for m in GROUND])
    dark = ground & ~covered & ((plain - photo).max(axis=2) > 1.5)
    rows, columns = np.nonzero(dark)
    if not len(rows):
        return [None] * len(frame.truths)
    matrix = np.linalg.inv(camera.matrix.double().numpy()[:, :3])
    ray = np.stack([columns, rows, np.ones_like(rows)], axis=1) @ matrix.T
    assert frame.background_depth_m is not None
    point = ray * frame.background_depth_m[rows, columns][:, None] + setting.view.centre
    weights = np.stack([_influence(t, point, setting.light.sun) for t in frame.truths])
    total = weights.sum(axis=0)
    share = weights / np.maximum(total, 1e-9)
    log_factor = np.log(np.maximum(factor[rows, columns], 0.02))
    out: list[Crop | None] = []
    for part in share:
        mine = part > 0.02
        if mine.sum() < 8:
            out.append(None)
            continue
        y0, y1, x0, x1 = rows[mine].min(), rows[mine].max() + 1, columns[mine].min(), columns[mine].max() + 1
        values = np.ones((y1 - y0, x1 - x0, 3), np.float32)
        values[rows[mine] - y0, columns[mine] - x0] = np.exp(log_factor[mine] * part[mine, None])
        out.append(Crop(torch.from_numpy(values.transpose(2, 0, 1).copy()), int(x0), int(y0)))
    return out


def _influence(truth: Truth, point: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """How much (n,) a vehicle's box darkens ground points (n, 3): it blocks their sun, or their sky near by."""
    cos, sin = np.cos(truth.yaw), np.sin(truth.yaw)
    axes = np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])
    local = (point - truth.translation) @ axes.T
    towards = axes @ sun
    length, height, width = truth.actor.size_lhw
    low = np.array([-length / 2, -height, -width / 2]) * 1.03
    high = np.array([length / 2, 0.0, width / 2]) * 1.03
    safe = np.where(np.abs(towards) < 1e-9, 1e-9, towards)
    one, two = (low - local) / safe, (high - local) / safe
    enters, leaves = np.minimum(one, two).max(axis=1), np.maximum(one, two).min(axis=1)
    blocked = (leaves > np.maximum(enters, 0)).astype(float)
    outside = np.hypot(
        np.maximum(np.abs(local[:, 0]) - length / 2, 0), np.maximum(np.abs(local[:, 2]) - width / 2, 0)
    )
    return blocked + 0.6 * np.exp(-outside / (0.25 * height)) * (outside < 2 * height)


_DRIVE_KINDS = ("residential", "city")
"""Of roads: with parked rows that the camera's car goes past."""
_DRIVE_LAYOUT = replace(_LAYOUT, kinds=_DRIVE_KINDS)
_DRIVE_ATTEMPTS = 60
_CHECKED_FRAMES = 5
"""Frames, evenly spread, by which a drive is chosen."""
_CLEAR_VISIBLE = 0.6
_DRIVE_FEWEST, _DRIVE_MOST = 4, 8
"""Vehicles of a drive: such as are plainly seen in one of those frames."""
_LEAST_SPEED_MPS = 4.0
_LENS_PX = 3
"""How far the lens spreads a vehicle's outline."""


@dataclass(frozen=True, slots=True)
class Drive:
    """A drive as it is planned. tracks: of the vehicles that stand in it, in all of its frames or none."""

    seed: int
    frames: int
    attempt: int
    tracks: tuple[int, ...]

    def plan(self, number: int) -> Plan:
        """What frame `number` will show. RangeError for one that the drive has not."""
        if not 0 <= number < self.frames:
            raise RangeError("frame of the drive", f"0 to {self.frames - 1}", number)
        plan = _plan_drive(self.seed, self.frames, number, self.attempt)
        return replace(plan, actors=tuple(actor for actor in plan.actors if actor.track in self.tracks))

    def scene(self, number: int) -> SceneIR:
        """Scene of frame `number`; `tracks` of its provenance names the vehicles in the objects' order."""
        frame = render_frame(self.plan(number), with_background=True)
        assert frame is not None
        scene = take_apart(_without_hidden(frame), f"drive-{number:03d}")
        tracks = {"tracks": ",".join(str(t.actor.track) for t in frame.truths if t.labelled)}
        labels = {f"objects[{i}].label": str(i) for i in range(len(scene.objects))}
        return replace(scene, provenance=dict(scene.provenance) | tracks | labels)


def make_drive(seed: int, frames: int) -> Drive:
    """Return the embedded drive of `frames` frames, ten a second: the seed's first with enough near vehicles.

    Raises RangeError for no frame.
    """
    if frames < 1:
        raise RangeError("frames of a drive", "at least 1", frames)
    checked_frames = sorted(
        {round(i * (frames - 1) / max(_CHECKED_FRAMES - 1, 1)) for i in range(_CHECKED_FRAMES)}
    )
    for attempt in range(_DRIVE_ATTEMPTS):
        if _plan_drive(seed, frames, 0, attempt).setting.road.ego_speed_mps < _LEAST_SPEED_MPS:
            continue
        height: dict[int, float] = {}
        for number in checked_frames:
            for truth in boxes_alone(_plan_drive(seed, frames, number, attempt)):
                tall = float(truth.box_xyxy[3] - truth.box_xyxy[1])
                if tall >= _CLEAR_HEIGHT_PX and truth.visible >= _CLEAR_VISIBLE and truth.truncation < 0.3:
                    height[truth.actor.track] = max(height.get(truth.actor.track, 0.0), tall)
        if len(height) >= _DRIVE_FEWEST:
            chosen = sorted(height, key=lambda track: (-height[track], track))[:_DRIVE_MOST]
            return Drive(seed, frames, attempt, tuple(sorted(chosen)))
    raise RangeError(f"drive of seed {seed}", f"a street within {_DRIVE_ATTEMPTS} attempts", "none")


def _plan_drive(seed: int, frames: int, number: int, attempt: int) -> Plan:
    settings = SynthSettings(_DRIVE_LAYOUT, sunny=True, tilt_rad=0.004, sequence=frames)
    return plan_frame(seed, number, "heldout", settings, attempt)


def _without_hidden(frame: SynthFrame) -> SynthFrame:
    """The frame with objects for the labelled vehicles alone: of others, hardly seen or cut by the camera's plane,
    what shows stays in the background.
    """
    labelled = tuple(truth for truth in frame.truths if truth.labelled)
    others = (frame.owner > 0) & ~np.isin(frame.owner, [truth.index + 1 for truth in labelled])
    if not others.any():
        return replace(frame, truths=labelled)
    height, width = frame.camera.height, frame.camera.width
    uncovered = np.asarray(others.reshape(height, 2, width, 2).any(axis=(1, 3)), np.uint8)
    uncovered = cv2.dilate(uncovered, np.ones((2 * _LENS_PX + 1,) * 2, np.uint8)).astype(bool)
    assert frame.background is not None
    background = np.where(uncovered[..., None], frame.image, frame.background)
    return replace(frame, truths=labelled, background=background)
