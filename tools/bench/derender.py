"""De-rendering held against the generator's truth: silhouettes, moved and removed vehicles, time and memory.

A generated frame goes in as a photograph with hand-drawn labels would: RGB, camera, labels that are off by a
little; no mask, no depth. What comes out is edited, and compared with the generator's own picture of the edited
street.
"""

from __future__ import annotations

import ctypes
import gc
import math
import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from drivesem.bench.session import Columns
from drivesem.synth.demo import take_apart
from drivesem.synth.edits import FrameEdit, ObjectEdit, apply_edit
from drivesem.synth.frames import Plan, SynthFrame, SynthSettings, Truth, full_boxes, plan_frame, render_frame
from drivesem.synth.layout import Actor, Road, clearance, footprint
from drivesem.synth.view import blocks
from scene_ir import files
from scene_ir.derender import silhouette
from scene_ir.derender.derender import VEHICLE_CATEGORIES, DerenderSettings, derender
from scene_ir.errors import RangeError
from scene_ir.geometry import project_boxes, yaw_matrix
from scene_ir.render import blend, surfaces
from scene_ir.render.compositor import Compositor
from scene_ir.render.sources import solve_sources
from scene_ir.types import Crop, Frame, Labels, SceneIR
from tools.bench.pictures import EXACT_DB, SheetStrip, psnr, sheet
from tools.experiments.realism.perceptual import PERCEPTUAL, PerceptualDistance, Picture

Mask = NDArray[np.bool_]

TITLE = "De-rendering against the generator's truth"
COLUMNS: Columns = {
    "measure": ("figure", "figure"), "median": ("median", "median"), "tail": ("tail", "tail"),
    "worst": ("worst", "worst"), "count": ("count", "count"), "goal": ("goal", "goal"),
}  # fmt: skip
METHOD = (
    "Frames of the generator's held-out pools, clear and mixed weather in turn, each with a vehicle that can be "
    "moved. derender sees RGB, camera and labels with 3D boxes off by 0.2 m on the ground, 5 degrees and 5 % "
    "in each size, in random directions; 2D boxes are exact; no mask, no depth. Silhouettes: IoU with the "
    "generator's mask (pixels at least half covered) of vehicles of at least 40 px, at least 70 % visible; mesh: "
    "pixels the fitted mesh covers at least half and no nearer mesh does, counted outside what truly hides the "
    "vehicle; matte: pixels the scene draws as this vehicle; true template withheld: de-rendered once more, "
    "without the template of each vehicle's own kind. Move: one vehicle by 0.5 m along or across and 10 "
    "degrees, free of collision, rendered by the compositor and by the generator, compared over both pictures' "
    "true masks grown by 3 px and all pixels that truly changed by more than 2 levels; unchanged: the photograph "
    "itself as the answer. never seen: share of the moved vehicle's pixels with a surface that the photograph did not "
    "show. Zones: outline, within 2 px of the true new border; seen and never seen, inside it; uncovered, the old "
    "mask beyond it; ground, the rest. Remove: all vehicles that became objects, and those hardly to be seen. "
    f"{EXACT_DB:.0f} dB stands for equal. The {PERCEPTUAL}: unit-length features of conv1, fire3, fire5, squared "
    "difference, averaged over the region. The tail is the 10th percentile, or the 90th where less is better. "
    "Peak memory is the process's while it de-renders; the libraries and the generator's tables are in it."
)
QUICK_FRAMES, FULL_FRAMES = 12, 100
SHIFT_M, TURN_RAD, STRETCH = 0.2, math.radians(5.0), 0.05
"""How far labels are off: as hand-drawn 3D boxes are."""
MOVE_M, MOVE_RAD = 0.5, math.radians(10.0)
LEAST_HEIGHT_PX, LEAST_VISIBLE = 40.0, 0.7
_MOVABLE_VISIBLE, _MOVABLE_TRUNCATION = 0.85, 0.1
"""Of a vehicle that is moved: more than a little hidden, and the truth shows what no photograph can know."""
_LEAST_SEEN = 0.05
"""What shows less of itself has no label."""
_HARDLY_SEEN = 0.3
_GROW_PX = 3.0
_CHANGED_LEVELS = 2
_OUTLINE_PX = 2.0
_DEPTH_TOLERANCE_M = 0.12
"""Between a surface point and the depth map at its pixel, the neighbours' included: slopes are steep at grazing
angles."""
_RAISED_M = 0.02
_SHADED = 0.85
"""Share of its brightness without vehicles below which ground counts as shaded by them."""
_ATTEMPTS = 200
_STREAM = 0xDE4E
"""Keeps this benchmark's random numbers apart from the generator's."""
_WORST, _TYPICAL = 8, 4
"""Number of sheets written."""
_KB = 1024.0
ZONES = ("seen", "never seen", "outline", "uncovered", "ground")
ABLATIONS = (
    "true labels",
    "true masks",
    "true pose",
    "true shape",
    "true geometry",
    "true mattes",
    "true background",
    "true background and mattes",
    "all true",
)


@dataclass(frozen=True, slots=True)
class VehicleMove:
    """One vehicle's edit."""

    track: int
    shift_m: tuple[float, float]
    """(along, across)."""
    turn: float
    """Rad."""
    size: float = 0.0
    """Share by which it grows."""


@dataclass(frozen=True, slots=True)
class EditedStreet:
    """One street before and after the edit."""

    plan: Plan
    before: SynthFrame
    move: VehicleMove
    """What happens."""
    moved: SynthFrame
    """The generator's own frame of it."""


@dataclass(frozen=True, slots=True)
class SilhouetteOverlap:
    """One vehicle's silhouettes: IoU of the template at the disturbed label, the fitted mesh, and the matte; 0
    where de-rendering made no object of it. template_iou is None where the scene comes from elsewhere.
    """

    track: int
    kind: str
    height_px: float
    visible: float
    template_iou: float | None
    mesh_iou: float
    matte_iou: float
    place_m: float | None = None
    """On the ground, between its fitted and its true middle."""
    yaw_deg: float | None = None
    """Between its headings."""
    stretch: float | None = None
    """Largest relative error of its sizes; all None without an object."""


@dataclass(frozen=True, slots=True)
class EditAccuracy:
    """A scene's edited picture against the truth."""

    psnr_db: float
    unchanged_db: float
    perceptual: float
    unchanged_perceptual: float
    pixels: int
    zones: dict[str, float] = field(default_factory=dict)
    """PSNR in each of `ZONES`, error: each one's share of the squared error; none of a zone that is empty."""
    error: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DerenderRow:
    """What was found of one frame."""

    index: int
    weather: str
    road: str
    objects: int
    shapes: tuple[SilhouetteOverlap, ...]
    moved: str
    shift_m: tuple[float, float]
    turn_deg: float
    never_seen: float
    move: EditAccuracy
    remove: EditAccuracy
    identity_db: float
    """In the objects' boxes."""
    exact: bool
    """Whether all pixels that no matte and no shadow reaches are the photograph's."""
    derender_s: float
    cpu_s: float
    peak_mb: float | None
    withheld: tuple[SilhouetteOverlap, ...] = ()
    """Shapes where no vehicle's own kind of template may be chosen."""
    ablations: dict[str, dict[str, float]] = field(default_factory=dict)
    """PSNR of move and removal with a part replaced by the truth."""
    shadow_iou: float | None = None
    """See `compare_shadows`; no sun but under a clear sky."""
    sun_deg: float | None = None
    """See `compare_shadows`; no sun but under a clear sky."""


@dataclass(frozen=True, slots=True)
class DerenderTask:
    """One frame to measure."""

    seed: int
    index: int
    ablate: bool = False
    sheets: Path | None = None
    """Folder for its sheet, or None."""
    settings: DerenderSettings = field(default_factory=DerenderSettings)
    """De-rendering settings."""


def measure(
    frames: int,
    seed: int,
    workers: int,
    ablate: bool = False,
    sheets: Path | None = None,
    settings: DerenderSettings | None = None,
) -> Iterator[DerenderRow]:
    """One row a frame, in order. sheets: a folder that gets the worst and some typical frames as pictures;
    settings: De-rendering settings.

    Raises RangeError for no frames or no processes.
    """
    for name, value in (("frames", frames), ("workers", workers)):
        if value < 1:
            raise RangeError(f"--{name}", "at least 1", value)
    with tempfile.TemporaryDirectory(prefix="drivesem-bench-") as name:
        folder = None if sheets is None else Path(name)
        settings = settings or DerenderSettings()
        tasks = [DerenderTask(seed, index, ablate, folder, settings) for index in range(frames)]
        found = []
        for row in _in_processes(tasks, min(workers, frames)):
            found.append(row)
            yield row
        if folder is not None and sheets is not None:
            _copy_worst_sheets(found, folder, sheets)


def _in_processes(tasks: Sequence[DerenderTask], workers: int) -> Iterator[DerenderRow]:
    if workers == 1:
        yield from map(work, tasks)
        return
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with multiprocessing.get_context("spawn").Pool(workers, initializer=_one_thread) as pool:
        yield from pool.imap(work, tasks)


def _one_thread() -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


@lru_cache(maxsize=1)
def _perception() -> PerceptualDistance:
    return PerceptualDistance()


def work(task: DerenderTask) -> DerenderRow:
    """Make a frame, de-render it, judge the scene."""
    case = make_case(task.seed, task.index)
    rng = np.random.default_rng([_STREAM, task.seed, task.index, 1])
    labels = disturb_labels(case.before, rng)
    frame = synthetic_photograph(case.before, labels)
    reset = _reset_peak()
    start, cpu = time.perf_counter(), time.process_time()
    scene = derender(frame, task.settings)
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    peak = _peak_mb() if reset else None
    tracks = match_tracks(scene, case.before)
    row, strips = judge(case, scene, tracks, labels, task.index)
    row = replace(row, derender_s=round(seconds, 3), cpu_s=round(cpu, 3), peak_mb=peak)
    row = replace(row, withheld=_withheld(case, frame, task.settings))
    if task.ablate:
        row = replace(row, ablations=_ablations(case, scene, tracks, frame, task.settings))
    if task.sheets is not None:
        files.write_png(task.sheets / f"{task.index}.png", sheet(strips))
    return row


def _withheld(case: EditedStreet, frame: Frame, settings: DerenderSettings) -> tuple[SilhouetteOverlap, ...]:
    """Shape errors of the frame de-rendered with templates of other kinds than the vehicles'."""
    kinds = tuple(t.actor.kind for t in case.before.truths if t.labelled)
    scene = derender(frame, replace(settings, withheld_kinds=kinds))
    return tuple(compare_silhouettes(case, Compositor(scene), match_tracks(scene, case.before), None))


def make_case(seed: int, index: int, split: str = "heldout") -> EditedStreet:
    """Street `index` of stream `seed`, with a vehicle that can be moved. split: "train" or "heldout", the
    generator's pools. Raises RangeError where none is found.
    """
    settings = SynthSettings(sunny=index % 2 == 0)
    for attempt in range(_ATTEMPTS):
        plan = plan_frame(seed, index, split, settings, attempt)
        found = _photographed(plan, (_STREAM, seed, index, attempt)) if _promising(plan) else None
        if found is None:
            continue
        plan, before, move = found
        moved = render_frame(apply_edit(plan, move_to_edit(move)))
        assert moved is not None
        if (track_coverage(moved, move.track) >= 0.5).any():
            return EditedStreet(plan, before, move, moved)
    raise RangeError(f"bench derender: street {index} of seed {seed}", f"one within {_ATTEMPTS} attempts", "none")


def _photographed(plan: Plan, key: tuple[int, ...]) -> tuple[Plan, SynthFrame, VehicleMove] | None:
    """The plan without what the photograph hides altogether, and nobody can know of; its frame, and a move.

    key: seeds the choice of the move. None where nothing can be moved.
    """
    known: list[Truth] = []

    def all_seen(truths: Sequence[Truth]) -> bool:
        known[:] = truths
        return _seen(truths) and bool(choose_move(plan, truths, np.random.default_rng(key)))

    frame = render_frame(plan, accept=all_seen)
    if frame is None and not _seen(known):
        hidden = {t.index for t in known if t.visible < _LEAST_SEEN}
        plan = replace(plan, actors=tuple(a for i, a in enumerate(plan.actors) if i not in hidden))
        frame = render_frame(plan, accept=all_seen)
    return None if frame is None else (plan, frame, choose_move(plan, frame.truths, np.random.default_rng(key))[0])


def _seen(truths: Sequence[Truth]) -> bool:
    return all(t.visible >= _LEAST_SEEN for t in truths)


def move_to_edit(move: VehicleMove) -> FrameEdit:
    """The move as the generator takes it."""
    return FrameEdit({move.track: ObjectEdit(translate_m=move.shift_m, rotate=move.turn, size=move.size)})


def _promising(plan: Plan) -> bool:
    """Whether some vehicle may be high enough, before anything is rendered."""
    boxes, view = full_boxes(plan.actors, plan.setting.view), plan.setting.view
    inside = (boxes[:, 2] > 0) & (boxes[:, 0] < view.camera.width - 1)
    high = boxes[:, 3] - boxes[:, 1] >= LEAST_HEIGHT_PX
    vehicles = np.array([a.label in VEHICLE_CATEGORIES for a in plan.actors], bool)
    return bool((inside & high & vehicles).any())


def eligible(truth: Truth) -> bool:
    """Whether a vehicle is large and visible enough to be judged."""
    height = truth.box_xyxy[3] - truth.box_xyxy[1]
    return (
        truth.labelled
        and truth.actor.label in VEHICLE_CATEGORIES
        and height >= LEAST_HEIGHT_PX
        and truth.visible >= LEAST_VISIBLE
    )


def choose_move(plan: Plan, truths: Sequence[Truth], rng: np.random.Generator) -> list[VehicleMove]:
    """A move of one well visible vehicle that ends free of collision, and on no kerb; none where there is no
    such."""
    movable = [
        t for t in truths if eligible(t) and t.visible >= _MOVABLE_VISIBLE and t.truncation <= _MOVABLE_TRUNCATION
    ]
    for i in rng.permutation(len(movable)):
        actor = movable[int(i)].actor
        options = [
            VehicleMove(actor.track, (MOVE_M * along, MOVE_M * across), MOVE_RAD * turn)
            for along, across in ((1, 0), (-1, 0), (0, 1), (0, -1))
            for turn in (1, -1)
        ]
        for j in rng.permutation(len(options)):
            if is_free(plan, actor, options[int(j)]):
                return [options[int(j)]]
    return []


def is_free(plan: Plan, actor: Actor, move: VehicleMove) -> bool:
    """Whether a vehicle, moved so, meets no other and stands on nothing raised more than before."""
    edited = apply_edit(plan, move_to_edit(move)).actors
    place = next(a for a in edited if a.track == actor.track)
    old, new = (footprint(a.position_xz, a.yaw, a.size_lhw) for a in (actor, place))
    others = [footprint(a.position_xz, a.yaw, a.size_lhw) for a in edited if a.track != actor.track]
    if any(clearance(new, other) < 0.05 for other in others):
        return False
    return _raised(plan.setting.road, new) <= _raised(plan.setting.road, old)


def _raised(road: Road, corners: np.ndarray) -> int:
    """Number of corners (4, 2), (x, z) m, on raised ground next to the road."""
    x, z = corners.T
    s = z.copy()
    d = x.copy()
    for _ in range(3):
        d = (x - road.curvature * s * s / 2) / np.cos(road.curvature * s)
        s = z + d * np.sin(road.curvature * s)
    kerbs = [strip for strip in road.strips if strip.height_m > _RAISED_M]
    return sum(int(((d >= strip.d0) & (d <= strip.d1)).sum()) for strip in kerbs)


def disturb_labels(frame: SynthFrame, rng: np.random.Generator) -> Labels:
    """The frame's labels with their 3D boxes off by a little; one that would lie behind the camera stays."""
    labels, ground = frame.labels, frame.environment.ground.double()
    count = len(labels.kind)
    angle = torch.from_numpy(rng.uniform(0, 2 * math.pi, count))
    shift = SHIFT_M * torch.stack([torch.cos(angle), torch.zeros(count), torch.sin(angle)], dim=1)
    shift[:, 1] = -(shift[:, 0] * ground[0] + shift[:, 2] * ground[2]) / ground[1]
    turn = TURN_RAD * torch.from_numpy(rng.choice((-1.0, 1.0), count))
    stretch = 1 + STRETCH * torch.from_numpy(rng.choice((-1.0, 1.0), (count, 3)))
    off = replace(
        labels,
        translation=(labels.translation + shift).float(),
        yaw=(labels.yaw + turn).float(),
        size_lhw=(labels.size_lhw * stretch).float(),
    )
    boxes = project_boxes(off.size_lhw, off.yaw, off.translation, frame.camera.matrix)
    finite = torch.isfinite(boxes).all(dim=1)
    return replace(
        off,
        translation=torch.where(finite[:, None], off.translation, labels.translation),
        yaw=torch.where(finite, off.yaw, labels.yaw),
        size_lhw=torch.where(finite[:, None], off.size_lhw, labels.size_lhw),
    )


def synthetic_photograph(frame: SynthFrame, labels: Labels, masks: Tensor | None = None) -> Frame:
    """What de-rendering is given of a generated frame."""
    picture = torch.from_numpy(frame.image.transpose(2, 0, 1).astype(np.float32) / np.float32(255))
    return Frame("generated", picture, frame.camera, labels, masks)


def match_tracks(scene: SceneIR, frame: SynthFrame) -> list[int]:
    """The track of each object of a scene that was de-rendered from the frame."""
    labelled = [t.actor.track for t in frame.truths if t.labelled]
    return [labelled[int(scene.provenance[f"objects[{i}].label"])] for i in range(len(scene.objects))]


def track_coverage(frame: SynthFrame, track: int) -> NDArray[np.float32]:
    """How much (H, W) of each pixel truly shows a vehicle, in [0, 1]."""
    owner = next((t.index + 1 for t in frame.truths if t.actor.track == track), None)
    parts = blocks(frame.owner)
    if owner is None:
        return np.zeros(parts[0].shape, np.float32)
    return np.stack([part == owner for part in parts]).mean(axis=0, dtype=np.float32)


def judge(
    case: EditedStreet, scene: SceneIR, tracks: Sequence[int], labels: Labels | None = None, index: int = 0
) -> tuple[DerenderRow, list[SheetStrip]]:
    """Hold a scene against the truth. tracks: of its objects; labels: that it was made from, if any.

    -> errors (without time and memory), and strips for the sheets.
    """
    before, move = case.before, case.move
    compositor = Compositor(scene)
    identity_db, exact = _identity(compositor)
    ours = _picture(compositor.render(apply_move(case, scene, tracks)).image)
    region = changed_region(before, case.moved, [move.track])
    edited = _edited(ours, before.image, case.moved.image, region, _zones(case, region))
    gone = sorted({*tracks, *_removable(before)})
    empty = without(case, gone)
    cleared = _picture(scene.background)
    hole = changed_region(before, empty, gone)
    removed = _edited(cleared, before.image, empty.image, hole)
    shade, sun = compare_shadows(scene, before, empty, gone)
    truth = next(t for t in before.truths if t.actor.track == move.track)
    row = DerenderRow(
        index=index,
        weather=str(before.manifest["weather"]),
        road=str(before.manifest["road"]),
        objects=len(scene.objects),
        shapes=tuple(compare_silhouettes(case, compositor, tracks, labels)),
        moved=truth.actor.kind,
        shift_m=move.shift_m,
        turn_deg=round(math.degrees(move.turn), 1),
        never_seen=round(float(never_seen(case)[case.moved.instance == move.track + 1].mean()), 4),
        move=edited,
        remove=removed,
        identity_db=identity_db,
        exact=exact,
        derender_s=0.0,
        cpu_s=0.0,
        peak_mb=None,
        shadow_iou=round(shade, 4),
        sun_deg=round(sun, 2) if before.manifest["weather"] == "sun" else None,
    )
    caption = f"{truth.actor.kind} moved {move.shift_m[0]:+.1f} {move.shift_m[1]:+.1f} m, {row.turn_deg:+.0f} deg"
    strips = [
        SheetStrip(before.image, ours, case.moved.image, region, f"{index}, {caption}: {edited.psnr_db:.1f} dB"),
        SheetStrip(before.image, cleared, empty.image, hole, f"all removed: {removed.psnr_db:.1f} dB"),
    ]
    return row, strips


def compare_shadows(
    scene: SceneIR, before: SynthFrame, empty: SynthFrame, gone: Sequence[int]
) -> tuple[float, float]:
    """Errors of the vehicles' shadows: IoU of where they darken the ground outside the vehicles, with
    the truth; and degrees between the sun's azimuths. gone: tracks of the vehicles that `empty` lacks."""
    seen = np.zeros(before.image.shape[:2], bool)
    for track in gone:
        seen |= track_coverage(before, track) > 0
    surroundings = ~silhouette.grow_mask(seen, _GROW_PX)
    bright = [frame.image.max(axis=2).astype(np.float32) + 1 for frame in (before, empty)]
    true = (bright[0] < _SHADED * bright[1]) & surroundings
    factor = np.ones(seen.shape, np.float32)
    for source in scene.objects.source:
        if source.shadow is not None and source.shadow.values.numel():
            crop = source.shadow
            h, w = crop.values.shape[1:]
            factor[crop.y0 : crop.y0 + h, crop.x0 : crop.x0 + w] *= crop.values.amax(dim=0).numpy()
    ours = (factor < _SHADED) & surroundings
    either = np.count_nonzero(true | ours)
    suns = (scene.environment.sun, before.environment.sun)
    azimuths = [math.atan2(float(sun[2]), float(sun[0])) for sun in suns]
    apart = math.degrees(abs(math.remainder(azimuths[0] - azimuths[1], 2 * math.pi)))
    return np.count_nonzero(true & ours) / either if either else 1.0, apart


def apply_move(case: EditedStreet, scene: SceneIR, tracks: Sequence[int]) -> SceneIR:
    """The scene with its vehicle moved by the same vector and angle as the true one, and grown alike."""
    if case.move.track not in tracks:
        return scene
    i = list(tracks).index(case.move.track)
    old, new = (true_shape(frame, case.move.track) for frame in (case.before, case.moved))
    translation, yaw = scene.objects.translation.clone(), scene.objects.yaw.clone()
    translation[i] += torch.from_numpy(new.translation - old.translation).to(translation)
    yaw[i] += case.move.turn
    size_lhw = scene.objects.size_lhw.clone()
    size_lhw[i] *= 1 + case.move.size
    return scene.with_objects(translation=translation, yaw=yaw, size_lhw=size_lhw)


def _removable(frame: SynthFrame) -> list[int]:
    """Tracks of the vehicles that must be found, and of those that show too little: what the latter
    hide must not appear either."""
    vehicles = [t for t in frame.truths if t.actor.label in VEHICLE_CATEGORIES]
    return [t.actor.track for t in vehicles if eligible(t) or t.visible < _HARDLY_SEEN]


def without(case: EditedStreet, tracks: Sequence[int]) -> SynthFrame:
    """The generator's frame of the street without these vehicles."""
    edit = FrameEdit({track: ObjectEdit(remove=True) for track in tracks})
    frame = render_frame(apply_edit(case.plan, edit))
    assert frame is not None
    return frame


def true_shape(frame: SynthFrame, track: int) -> Truth:
    """The truth of a vehicle that the frame has."""
    return next(t for t in frame.truths if t.actor.track == track)


def changed_region(before: SynthFrame, after: SynthFrame, tracks: Sequence[int]) -> Mask:
    """Pixels (H, W) that an edit of these vehicles is about: where they are seen before or after, grown, and where
    the pictures differ."""
    seen = np.zeros(before.image.shape[:2], bool)
    for track in tracks:
        seen |= (track_coverage(before, track) > 0) | (track_coverage(after, track) > 0)
    apart = np.abs(before.image.astype(np.int16) - after.image).max(axis=2) > _CHANGED_LEVELS
    return silhouette.grow_mask(seen, _GROW_PX) | apart


def _zones(case: EditedStreet, region: Mask) -> dict[str, Mask]:
    """The parts of a move's region: each pixel lies in one."""
    new, old = (track_coverage(frame, case.move.track) >= 0.5 for frame in (case.moved, case.before))
    inside = silhouette.grow_mask(new, -_OUTLINE_PX)
    outline = silhouette.grow_mask(new, _OUTLINE_PX) & ~inside
    uncovered = silhouette.grow_mask(old, _GROW_PX) & ~outline & ~inside
    unseen = never_seen(case)
    masks = (inside & ~unseen, inside & unseen, outline, uncovered, ~(inside | outline | uncovered))
    return {name: mask & region for name, mask in zip(ZONES, masks, strict=True)}


def _edited(
    ours: Picture, photograph: Picture, truth: Picture, region: Mask, zones: dict[str, Mask] | None = None
) -> EditAccuracy:
    perception = _perception()
    square = ((ours.astype(np.float64) - truth) ** 2).sum(axis=2)
    total = max(float(square[region].sum()), 1.0)
    zones = {} if zones is None else {name: zone for name, zone in zones.items() if zone.any()}
    return EditAccuracy(
        psnr_db=round(psnr(ours, truth, region), 3),
        unchanged_db=round(psnr(photograph, truth, region), 3),
        perceptual=round(perception.distance(ours, truth, region), 4),
        unchanged_perceptual=round(perception.distance(photograph, truth, region), 4),
        pixels=int(np.count_nonzero(region)),
        zones={name: round(psnr(ours, truth, zone), 3) for name, zone in zones.items()},
        error={name: round(float(square[zone].sum()) / total, 4) for name, zone in zones.items()},
    )


def _picture(image: Tensor) -> Picture:
    """An image (3, H, W) in [0, 1] as it is written to a file."""
    return np.ascontiguousarray((image.detach().clamp(0, 1) * 255).round().byte().numpy().transpose(1, 2, 0))


def _identity(compositor: Compositor) -> tuple[float, bool]:
    """PSNR, dB, of the unperturbed render in the objects' boxes; whether it is exact beyond mattes, shadows and
    what stands in front."""
    scene = compositor.scene
    image = compositor.render(scene).image
    height, width = image.shape[1:]
    boxes, touched = np.zeros((height, width), bool), np.zeros((height, width), bool)
    for box, source in zip(scene.objects.box2d.tolist(), scene.objects.source, strict=True):
        x0, y0, x1, y1 = (max(round(v), 0) for v in box)
        boxes[y0 : y1 + 1, x0 : x1 + 1] = True
        reached = [(source.foreground, source.foreground.values[3] > 0)]
        if source.shadow is not None:
            reached.append((source.shadow, (source.shadow.values < 1).any(dim=0)))
        for crop, where in reached:
            h, w = where.shape
            touched[crop.y0 : crop.y0 + h, crop.x0 : crop.x0 + w] |= where.numpy()
    for crop in (occluder.foreground for occluder in scene.occluders):
        h, w = crop.values.shape[1:]
        touched[crop.y0 : crop.y0 + h, crop.x0 : crop.x0 + w] |= crop.values[3].numpy() > 0
    apart = (image - scene.photograph).double().numpy().transpose(1, 2, 0)
    mean = float(np.mean(apart[boxes] ** 2)) if boxes.any() else 0.0
    identity_db = EXACT_DB if mean == 0 else min(-10 * math.log10(mean), EXACT_DB)
    return round(identity_db, 3), bool((apart[~touched] == 0).all())


def compare_silhouettes(
    case: EditedStreet, compositor: Compositor, tracks: Sequence[int], labels: Labels | None
) -> Iterator[SilhouetteOverlap]:
    """Each eligible vehicle's silhouettes against the true ones."""
    frame, scene = case.before, compositor.scene
    meshes = _meshes_seen(compositor)
    drawn = compositor.render(scene).object_id.numpy()
    rows = [t.actor.track for t in frame.truths if t.labelled]
    for truth in filter(eligible, frame.truths):
        track = truth.actor.track
        seen = track_coverage(frame, track) >= 0.5
        whole = np.zeros_like(seen)
        h, w = truth.opacity.values.shape[1:]
        x0, y0 = truth.opacity.x0, truth.opacity.y0
        whole[y0 : y0 + h, x0 : x0 + w] = truth.opacity.values[0].numpy() >= 0.5
        hidden = whole & ~seen
        mesh = matte = 0.0
        place = yaw = stretch = None
        if track in tracks:
            i = list(tracks).index(track)
            place, yaw, stretch = _pose_errors(scene, i, truth)
            mesh = silhouette.mask_iou(meshes[i], seen, hidden)
            matte = silhouette.mask_iou(drawn == i + 1, seen)
        start = None
        if labels is not None:
            k = rows.index(track)
            kind = silhouette.rank_template_kinds(labels.kind[k], labels.size_lhw[k].tolist())[0]
            placed = silhouette.place_mesh(kind, labels.translation[k], labels.yaw[k], labels.size_lhw[k])
            start = round(
                silhouette.mask_iou(silhouette.render_silhouettes([placed], frame.camera)[0], seen, hidden), 4
            )
        yield SilhouetteOverlap(
            track=track,
            kind=truth.actor.kind,
            height_px=round(float(truth.box_xyxy[3] - truth.box_xyxy[1]), 1),
            visible=round(truth.visible, 3),
            template_iou=start,
            mesh_iou=round(mesh, 4),
            matte_iou=round(matte, 4),
            place_m=place,
            yaw_deg=yaw,
            stretch=stretch,
        )


def _pose_errors(scene: SceneIR, index: int, truth: Truth) -> tuple[float, float, float]:
    """Of an object: m on the ground, degrees, and relative size."""
    objects = scene.objects
    apart = objects.translation[index].double().numpy() - truth.translation
    turn = math.remainder(float(objects.yaw[index]) - truth.yaw, 2 * math.pi)
    ratio = objects.size_lhw[index].double().numpy() / np.array(truth.actor.size_lhw)
    return (
        round(float(np.hypot(apart[0], apart[2])), 4),
        round(abs(math.degrees(turn)), 3),
        round(float(np.abs(ratio - 1).max()), 4),
    )


def _meshes_seen(compositor: Compositor) -> list[Mask]:
    """For each object the pixels (H, W) that its mesh covers at least half, less those of nearer objects."""
    objects, camera = compositor.scene.objects, compositor.scene.camera
    found = [np.zeros((camera.height, camera.width), bool) for _ in range(len(objects))]
    if not found:
        return found
    drawn = compositor.find_visible(objects)
    rects = drawn.mesh.layout.rects.tolist()
    for mask, (span, size), (x0, y0, x1, y1) in zip(found, drawn.mesh.layout.spans(), rects, strict=True):
        mask[y0:y1, x0:x1] = (drawn.coverage[span] >= 0.5).reshape(size).numpy()
    nearer = np.zeros_like(found[0])
    for i in reversed(_far_to_near(compositor.scene)):
        found[i], nearer = found[i] & ~nearer, nearer | found[i]
    return found


def _far_to_near(scene: SceneIR) -> list[int]:
    objects = scene.objects
    centre = surfaces.camera_centre(scene.camera.matrix).to(objects.translation)
    return blend.paint_order(objects.size_lhw, objects.yaw, objects.translation, centre)


def never_seen(case: EditedStreet) -> Mask:
    """Pixels (H, W) of the moved vehicle with a surface not visible in the photograph: turned away, hidden or out of
    the image."""
    before, after = case.before, case.moved
    old, new = true_shape(before, case.move.track), true_shape(after, case.move.track)
    value = case.move.track + 1
    rows, columns = np.nonzero(after.instance == value)
    unseen = np.zeros(after.instance.shape, bool)
    matrix = before.camera.matrix.double().numpy()
    inverse, centre = np.linalg.inv(matrix[:, :3]), before.setting.view.centre
    ray = np.stack([columns, rows, np.ones_like(rows)], axis=1) @ inverse.T
    ray /= ray[:, 2:]
    point = centre + ray * after.depth_m[rows, columns, None]
    then, now = (yaw_matrix(torch.tensor(t.yaw, dtype=torch.float64)).numpy() for t in (old, new))
    place = (point - new.translation) @ now @ then.T + old.translation
    homogeneous = place @ matrix[:, :3].T + matrix[:, 3]
    z = place[:, 2] - centre[2]
    u, v = (np.rint(homogeneous[:, k] / homogeneous[:, 2]).astype(np.int64) for k in (0, 1))
    height, width = before.depth_m.shape
    visible = np.zeros(len(rows), bool)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            y, x = v + dy, u + dx
            inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
            y, x = y.clip(0, height - 1), x.clip(0, width - 1)
            near = np.abs(before.depth_m[y, x] - z) < _DEPTH_TOLERANCE_M
            visible |= inside & near & (before.instance[y, x] == value)
    unseen[rows, columns] = ~visible
    return unseen


def _ablations(
    case: EditedStreet, scene: SceneIR, tracks: list[int], frame: Frame, settings: DerenderSettings
) -> dict[str, dict[str, float]]:
    """Move and removal once more, each with a part of the answer given; nothing where a vehicle was not found."""
    before = case.before
    if not {t.actor.track for t in before.truths if eligible(t)} <= {*tracks}:
        return {}
    assert frame.labels is not None
    found: dict[str, dict[str, float]] = {}
    rows = [t for t in before.truths if t.labelled]
    masks = np.stack([track_coverage(before, t.actor.track) >= 0.5 for t in rows]).astype(np.float32)
    given = {
        "true labels": replace(frame, labels=before.labels),
        "true masks": replace(frame, masks=torch.from_numpy(masks)),
    }
    empty = without(case, tracks)
    for name, better in given.items():
        other = derender(better, settings)
        found[name] = _accuracy_columns(case, other, match_tracks(other, before), empty)
    perfect = perfect_scene(before, empty, tracks)
    parts: dict[str, tuple[str, ...]] = {
        "true pose": ("pose",),
        "true shape": ("shape",),
        "true geometry": ("pose", "shape"),
        "true mattes": ("mattes",),
        "true background": ("background",),
        "true background and mattes": ("background", "mattes"),
        "all true": ("pose", "shape", "mattes", "background"),
    }
    for name, true in parts.items():
        found[name] = _accuracy_columns(case, _mixed(scene, perfect, true), tracks, empty)
    return found


def perfect_scene(before: SynthFrame, empty: SynthFrame, tracks: Sequence[int]) -> SceneIR:
    """The generator's own scene of these vehicles, in this order. empty: the street without them."""
    frame = replace(
        before,
        truths=tuple(true_shape(before, track) for track in tracks),
        background=empty.image,
        background_depth_m=empty.depth_m,
        ground_material=empty.ground_material,
        environment=empty.environment,
    )
    return take_apart(frame, "perfect")


def _mixed(scene: SceneIR, perfect: SceneIR, true: Sequence[str]) -> SceneIR:
    """The scene with pose, shape (mesh, bending, size), mattes, or background and shadows those of another scene
    of the same vehicles."""
    pose, shape, mattes, background = (
        perfect if part in true else scene for part in ("pose", "shape", "mattes", "background")
    )
    placed = replace(
        scene,
        meshes=shape.meshes,
        objects=replace(shape.objects, translation=pose.objects.translation, yaw=pose.objects.yaw, source=()),
        environment=background.environment,
        background=background.background,
        depth=background.depth,
    )
    alphas = [replace(s.foreground, values=s.foreground.values[3:]) for s in mattes.objects.source]
    margins = [_reach_px(alpha, outline) for alpha, outline in zip(alphas, _outlines(placed), strict=True)]
    return solve_sources(placed, alphas, [s.shadow for s in background.objects.source], margins_px=margins)


def _outlines(scene: SceneIR) -> list[Mask]:
    o = scene.objects
    meshes = [scene.meshes[int(i)] for i in o.mesh_index]
    parts = zip(meshes, o.translation, o.yaw, o.size_lhw, o.ffd, strict=True)
    return silhouette.render_silhouettes([silhouette.Placement(*part) for part in parts], scene.camera)


def _reach_px(alpha: Crop, outline: Mask) -> float:
    """How far a matte's halo must reach beyond the outline, bounded as de-rendering bounds it."""
    settings = DerenderSettings()
    if not outline.any():
        return settings.min_reach_px
    beyond = cv2.distanceTransform((~outline).astype(np.uint8), cv2.DIST_L2, 5)
    h, w = alpha.values.shape[1:]
    far = beyond[alpha.y0 : alpha.y0 + h, alpha.x0 : alpha.x0 + w][alpha.values[0].numpy() > 0].max(initial=0)
    _, top, _, bottom = silhouette.mask_bounds(outline)
    most = max(settings.max_inflation * (bottom - top), settings.min_reach_px)
    return float(np.clip(far + 1.5, settings.min_reach_px, most))


def _accuracy_columns(
    case: EditedStreet, scene: SceneIR, tracks: Sequence[int], empty: SynthFrame
) -> dict[str, float]:
    compositor = Compositor(scene)
    shapes = list(compare_silhouettes(case, compositor, tracks, None))
    ours = _picture(compositor.render(apply_move(case, scene, tracks)).image)
    region = changed_region(case.before, case.moved, [case.move.track])
    hole = changed_region(case.before, empty, tracks)
    return {
        "move_db": round(psnr(ours, case.moved.image, region), 3),
        "remove_db": round(psnr(_picture(scene.background), empty.image, hole), 3),
        "mesh_iou": round(float(np.median([s.mesh_iou for s in shapes])), 4),
        "matte_iou": round(float(np.median([s.matte_iou for s in shapes])), 4),
    }


def summary(rows: Sequence[DerenderRow]) -> list[dict[str, Any]]:
    """A line a figure: median, tail (10th percentile, or 90th where less is better), count, goal where there is
    one."""
    shapes = [s for row in rows for s in row.shapes]
    lines = [
        _line("silhouette IoU, mesh", [s.mesh_iou for s in shapes], goal="median 0.95"),
        _line(
            "silhouette IoU, mesh, true template withheld",
            [s.mesh_iou for row in rows for s in row.withheld],
            goal="median 0.92",
        ),
        _line("silhouette IoU, matte", [s.matte_iou for s in shapes], goal="median 0.95"),
        _line("silhouette IoU, template at the label", [s.template_iou for s in shapes]),
        _line("place after the fit, error, m", [s.place_m for s in shapes], False),
        _line("yaw after the fit, error, degrees", [s.yaw_deg for s in shapes], False),
        _line("size after the fit, largest relative error", [s.stretch for s in shapes], False),
        _line("move, PSNR, dB", [r.move.psnr_db for r in rows], goal="median 28"),
        _line("move, unchanged, PSNR, dB", [r.move.unchanged_db for r in rows]),
        *(_line(f"move, {zone}, PSNR, dB", [r.move.zones.get(zone) for r in rows]) for zone in ZONES),
        *(_line(f"move, {zone}, share of error", [r.move.error.get(zone) for r in rows], False) for zone in ZONES),
        _line(f"move, {PERCEPTUAL}", [r.move.perceptual for r in rows], False),
        _line(f"move, unchanged, {PERCEPTUAL}", [r.move.unchanged_perceptual for r in rows], False),
        _line("move, never seen, share", [r.never_seen for r in rows], False),
        _line("remove, PSNR, dB", [r.remove.psnr_db for r in rows], goal="median 28"),
        _line("remove, unchanged, PSNR, dB", [r.remove.unchanged_db for r in rows]),
        _line(f"remove, {PERCEPTUAL}", [r.remove.perceptual for r in rows], False),
        _line("shadows, IoU", [r.shadow_iou for r in rows]),
        _line("sun's azimuth under a clear sky, error, degrees", [r.sun_deg for r in rows], False),
        _line("identity in boxes, PSNR, dB", [r.identity_db for r in rows], goal="each 45"),
        _line("identity exact elsewhere, share", [float(r.exact) for r in rows], goal="each 1"),
        _line("time, s", [r.derender_s for r in rows], False, goal="each 8"),
        _line("processor time, s", [r.cpu_s for r in rows], False),
        _line("peak memory, MB", [r.peak_mb for r in rows], False, goal="each 2000"),
    ]
    for name in ABLATIONS:
        given = [r.ablations[name] for r in rows if name in r.ablations]
        for key, what in (("move_db", "move, PSNR, dB"), ("remove_db", "remove, PSNR, dB")):
            lines.append(_line(f"{name}: {what}", [g[key] for g in given]))
    return [line for line in lines if line["count"]]


def _line(
    measure: str, values: Sequence[float | None], more_is_better: bool = True, goal: str | None = None
) -> dict[str, Any]:
    known = [v for v in values if v is not None]
    if not known:
        return {"measure": measure, "count": 0}
    median, low, high = np.percentile(known, (50, 10, 90)).tolist()
    worst = float(min(known) if more_is_better else max(known))
    return {
        "measure": measure,
        "median": round(median, 4),
        "tail": round(low if more_is_better else high, 4),
        "worst": round(worst, 4),
        "count": len(known),
        "goal": goal,
    }


def _copy_worst_sheets(rows: Sequence[DerenderRow], made: Path, destination: Path) -> None:
    """The worst sheets by the move's PSNR, and those next to its median."""
    order = sorted(rows, key=lambda row: row.move.psnr_db)
    worst = order[:_WORST]
    rest = order[_WORST:]
    middle = order[len(order) // 2].move.psnr_db if order else 0.0
    typical = sorted(rest, key=lambda row: abs(row.move.psnr_db - middle))[:_TYPICAL]
    for name, group in (("worst", worst), ("typical", typical)):
        for place, row in enumerate(group, start=1):
            data = files.read_bytes(made / f"{row.index}.png")
            files.write_bytes(destination / f"{name}-{place}-frame-{row.index}.png", data)


def _reset_peak() -> bool:
    """Forget the process's peak of resident memory so far; False where the system cannot.

    What earlier frames have left goes back first: cycles keep it, then glibc does, and it would count.
    """
    gc.collect()
    if sys.platform != "linux":
        return False
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return False
    return True


def _peak_mb() -> float | None:
    """Peak of this process's resident memory, MB."""
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    except OSError:
        return None
    line = next((line for line in status.splitlines() if line.startswith("VmHWM:")), None)
    return None if line is None else round(int(line.split()[1]) / _KB, 1)
