"""The scene generator as a second renderer: find the plan of a frame, transfer the change to it, render, label."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from detectors.types import CLASSES, Targets
from drivesem.attacks.labels import Difficulty
from drivesem.config.edits import FrameEdit, ObjectEdit
from drivesem.config.errors import UsageError
from drivesem.failures.second_renderer.base import MANIFEST, SecondRender
from drivesem.synth.demo import demo_plan
from drivesem.synth.edits import apply_edit
from drivesem.synth.frames import (
    GENERATOR_VERSION,
    Plan,
    Street,
    SynthFrame,
    Truth,
    build_street,
    render_frame,
    table,
    yaw_in_camera,
)
from drivesem.synth.layout import Actor
from drivesem.synth.view import SUPERSAMPLING, View
from drivesem.synth.write import Order, list_jobs, plan_job
from scene_ir import ffd, files
from scene_ir.derender.derender import VEHICLE_CATEGORIES
from scene_ir.errors import FormatError
from scene_ir.types import LATTICE, TEXTURE_DIM, SceneIR

_GENERATED_RUN = "a run on generated frames: the embedded scenes, or drivesem synth --layout kitti"
_EXTERNAL_FILES = ("edits", "meshes", "assets")
"""Files that a manifest names but that are not part of the data set."""
_MAX_LEVELS_OFF = 1
"""Levels of 255 by which the same image may differ between CPU models."""


@dataclass(frozen=True, slots=True)
class PlanMatch:
    """The generator's plan of a frame, matched to the scene's N objects."""

    plan: Plan
    """Plan of the frame before the attack."""
    tracks: tuple[int | None, ...]
    """(N,) track of each object in the plan; None where it has no counterpart."""


class PlanSource(Protocol):
    """Plans by frame. Cheap to create, so every worker has its own."""

    def find_plan(self, identifier: str, scene: SceneIR) -> PlanMatch:
        """Find the plan of a run's frame and scene. Raises FormatError if it is unknown."""
        ...


class DemoPlans:
    """Plans of the embedded scenes, from the seed, street and attempt in their provenance."""

    def find_plan(self, identifier: str, scene: SceneIR) -> PlanMatch:
        """Find a plan; the scene's objects are its actors, in order."""
        try:
            origin = [int(scene.provenance[name]) for name in ("seed", "index", "attempt")]
        except (KeyError, ValueError) as error:
            raise FormatError(f"scene of {identifier}: provenance", "seed, index, attempt", error) from error
        plan = demo_plan(*origin)
        if plan is None:
            raise FormatError(f"scene of {identifier}: provenance", "an embedded scene's", origin)
        known = [actor.track for actor in plan.actors]
        return PlanMatch(plan, tuple(known[i] if i < len(known) else None for i in range(len(scene.objects))))


class FolderPlans:
    """Plans of a folder in KITTI's layout that `drivesem synth` wrote, from its manifest.

    Raises UsageError for a folder of photographs, FormatError for an incomplete manifest.
    """

    def __init__(self, root: Path) -> None:
        # Readers accept a data set's folder, or the split in it that holds the images.
        self._path = next((f / MANIFEST for f in (root, root.parent) if (f / MANIFEST).is_file()), root / MANIFEST)
        if not self._path.is_file():
            raise UsageError("--run", _GENERATED_RUN, f"one on {root}, which has no {MANIFEST}")
        manifest = files.read_json(self._path)
        if not isinstance(manifest, dict) or "generator" not in manifest:
            raise UsageError("--run", _GENERATED_RUN, f"one on {root} with another program's {MANIFEST}")
        if manifest["generator"] != GENERATOR_VERSION:
            version = f"version {GENERATOR_VERSION}, the only one that makes the same images"
            raise FormatError(f"{self._path}: generator", version, manifest["generator"])
        if manifest.get("layout") != "kitti":
            raise UsageError("--run", _GENERATED_RUN, f"layout {manifest.get('layout')}")
        for name in _EXTERNAL_FILES:
            if manifest.get(name) is not None:
                raise FormatError(
                    f"{self._path}: {name}", "none: the data set does not hold such files", manifest[name]
                )
        try:
            self._frames: list[dict[str, Any]] = list(manifest["frames"])
            self._jobs = list_jobs(_order(self._path.parent, manifest))
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(str(self._path), "a manifest as drivesem synth writes it", error) from error

    def find_plan(self, identifier: str, scene: SceneIR) -> PlanMatch:
        """Find a plan; the scene's objects are rows of the label file, in the manifest's order."""
        if not identifier.isdecimal() or int(identifier) >= len(self._frames):
            raise FormatError(f"{self._path}: frames", f"frame {identifier}", f"{len(self._frames)} others")
        number = int(identifier)
        try:
            labelled = [entry["track"] for entry in self._frames[number]["objects"] if entry["labelled"]]
        except (KeyError, TypeError) as error:
            raise FormatError(f"{self._path}: frame {number}", "objects with tracks", error) from error
        rows = [scene.provenance.get(f"objects[{i}].label", "") for i in range(len(scene.objects))]
        tracks = (labelled[int(r)] if r.isdecimal() and int(r) < len(labelled) else None for r in rows)
        plan = plan_job(self._jobs[number])
        known = {actor.track for actor in plan.actors}
        return PlanMatch(plan, tuple(track if track in known else None for track in tracks))


def _order(root: Path, manifest: Mapping[str, Any]) -> Order:
    variations = tuple(manifest["variations"])
    return Order(
        out=root,
        frames=len(manifest["frames"]) // len(variations),
        variations=variations,
        night=manifest.get("night", 0.0),
        varied_people=manifest.get("varied_people", False),
        **{
            key: manifest[key]
            for key in ("seed", "layout", "split", "sequence", "people", "cameras", "validation")
        },
    )


@dataclass(frozen=True, slots=True)
class TransferredEdit:
    """A scene's change as an edit of the generator's plan."""

    edit: FrameEdit
    """Edit by track."""
    missing: tuple[str, ...]
    """Changes without a counterpart in the plan; the edit leaves them out."""


def transfer_edit(still: SceneIR, changed: SceneIR, planned: PlanMatch) -> TransferredEdit:
    """Transfer the change between two states of a scene to the plan that the scene was rendered from.

    Moves transfer in metres along the camera's axes and turns as angles, so a vehicle with an inexact pose moves
    as its counterpart does. Lattice offsets are fractions of each vehicle's own unit box. Heights are ignored: the
    generator's vehicles stand on its ground.

    Args:
        still: State before the change.
        changed: State after it.
        planned: Plan of the scene.
    """
    before, after = still.objects, changed.objects
    actors = {actor.track: actor for actor in planned.plan.actors}
    view = planned.plan.setting.view
    edits: dict[int | str, ObjectEdit] = {}
    missing: list[str] = []
    for i, track in enumerate(planned.tracks):
        move = (after.translation[i] - before.translation[i]).detach().double()
        turn = float(after.yaw[i] - before.yaw[i])
        bend = (after.ffd[i] - before.ffd[i]).detach().double()
        grown = float((after.size_lhw[i] / before.size_lhw[i]).mean()) - 1
        paint = (after.texture_code[i] - before.texture_code[i]).detach()
        lamps = float(after.lamps[i] - before.lamps[i])
        if track is None:
            if turn or grown or lamps or bool(move.any()) or bool(bend.any()) or bool(paint.any()):
                missing.append(f"objects[{i}]: the generator's plan has no such vehicle")
            continue
        actor = actors[track]
        if math.cos(float(before.yaw[i]) - yaw_in_camera(actor, view)) < 0:
            bend = _turn_lattice_around(bend)
        edits[track] = ObjectEdit(
            translate_m=_along_and_across(move, actor, view),
            rotate=turn,
            color=tuple(paint[:TEXTURE_DIM].clamp(-1, 1).tolist()),
            mesh=tuple(ffd.to_symmetric(bend).tolist()) if bool(bend.any()) else (),
            size=grown,
            lamps=max(-1.0, min(lamps, 1.0)),
        )
    environment, then = changed.environment, still.environment
    if bool(environment.drops.any()):
        missing.append("drops: generated streets have no windscreen")
    edit = FrameEdit(
        objects=edits,
        weather=tuple((environment.weather - then.weather).detach().clamp(0, 1).tolist()),
        foliage=tuple((environment.foliage - then.foliage).detach().clamp(-1, 1).tolist()),
        sun=tuple((environment.light - then.light).detach().clamp(-1, 1).tolist()),
    )
    return TransferredEdit(edit, tuple(missing))


def _along_and_across(move: Tensor, actor: Actor, view: View) -> tuple[float, float]:
    """Resolve a move (3,) m in camera axes into metres along the actor's heading and to its left."""
    x, _, z = (view.rotation.T @ move.numpy()).tolist()
    cos, sin = math.cos(actor.yaw), math.sin(actor.yaw)
    return x * cos - z * sin, x * sin + z * cos


def _turn_lattice_around(offsets: Tensor) -> Tensor:
    """Convert lattice offsets (64, 3) to those of a vehicle that faces the other way in the same place."""
    grid = offsets.reshape(*LATTICE, 3).flip(0, 2)
    return (grid * torch.tensor([-1.0, 1.0, -1.0]).to(grid)).reshape(-1, 3)


@dataclass(frozen=True, slots=True)
class GeneratorLabels:
    """The generator's labels before and after a change; row i of both is the same object."""

    benign: Targets
    """Labels before the change."""
    changed: Targets
    """Labels after it."""
    tracks: tuple[int, ...]
    """Tracks of the first rows; the others are regions in which no detection counts."""


def label_before_and_after(
    before: SynthFrame, after: SynthFrame, difficulty: Difficulty | None = None
) -> GeneratorLabels:
    """Label the vehicles that are labelled before a change in both frames, by the generator's geometry.

    Vehicles that are too hard before or after the change are ignored. So are regions: what the generator ignores
    in either frame, people, and vehicles that only the change brings into view.

    Args:
        before: Frame before the change.
        after: Frame after it.
        difficulty: Limits of what is evaluated; by default the usual ones.
    """
    difficulty = difficulty or Difficulty()
    first = {t.actor.track: t for t in before.truths if t.labelled and t.actor.label in VEHICLE_CATEGORIES}
    then = {t.actor.track: t for t in after.truths if t.actor.label in VEHICLE_CATEGORIES}
    regions = torch.cat(
        [
            *(_ignored_regions(frame) for frame in (before, after)),
            _boxes([t for track, t in then.items() if track not in first and t.labelled]),
        ]
    )
    ignore = [_too_hard(t, difficulty) or _too_hard(then.get(track), difficulty) for track, t in first.items()]
    count = len(CLASSES)
    labels = torch.cat(
        [
            torch.tensor([int(VEHICLE_CATEGORIES[t.actor.label]) for t in first.values()], dtype=torch.int64),
            torch.arange(count).repeat(len(regions)),
        ]
    )
    ignored = torch.tensor([*ignore, *[True] * (count * len(regions))], dtype=torch.bool)
    around = regions.repeat_interleave(count, dim=0)
    # A vehicle that left the image has no box, and is ignored.
    moved = [then[track].box_xyxy if track in then else np.zeros(4) for track in first]
    return GeneratorLabels(
        Targets(torch.cat([_boxes(list(first.values())), around]), labels, ignored),
        Targets(torch.cat([table(moved, 4), around]), labels, ignored),
        tuple(first),
    )


def _boxes(truths: Sequence[Truth]) -> Tensor:
    return table([t.box_xyxy for t in truths], 4)


def _ignored_regions(frame: SynthFrame) -> Tensor:
    people = [t for t in frame.truths if t.labelled and t.actor.label not in VEHICLE_CATEGORIES]
    return torch.cat([frame.labels.ignore_xyxy, _boxes(people)])


def _too_hard(truth: Truth | None, difficulty: Difficulty) -> bool:
    if truth is None or not truth.labelled:
        return True
    height = truth.box_xyxy[3] - truth.box_xyxy[1]
    return bool(
        height < difficulty.min_height_px
        or truth.occlusion > difficulty.max_occlusion
        or truth.truncation > difficulty.max_truncation
    )


@dataclass(frozen=True, slots=True)
class _RenderedEdit:
    """An edit of the plan and its image."""

    edit: FrameEdit
    frame: SynthFrame
    surround: Street  # all that stands in the street besides vehicles


class GeneratorRenderer:
    """The generator as a second renderer of one generated frame.

    Raises FormatError where the plan does not reproduce the photograph.
    """

    name = "generator"

    def __init__(self, identifier: str, scene: SceneIR, plans: PlanSource) -> None:
        """Find the plan and render it.

        Args:
            identifier: The frame's name.
            scene: Any state of its scene.
            plans: Source of its plan.
        """
        self._identifier = identifier
        self._still = scene.as_photographed()
        self._planned = plans.find_plan(identifier, scene)
        surround = build_street(self._planned.plan)
        frame = _render_plan(self._planned.plan, surround)
        _check_photograph(identifier, scene.photograph, frame.image)
        self._before = self._last = _RenderedEdit(self.transfer(self._still).edit, frame, surround)

    def unsupported_changes(self, changed: SceneIR) -> tuple[str, ...]:
        """List changes of vehicles without a counterpart in the plan."""
        return self.transfer(changed).missing

    def transfer(self, changed: SceneIR) -> TransferredEdit:
        """Transfer a state's change to the plan."""
        return transfer_edit(self._still, changed, self._planned)

    def render(self, changed: SceneIR) -> SecondRender:
        """Render a state of the scene; vehicles without a counterpart in the plan stay as photographed.

        Objects without a counterpart, or too hard in either image, are ignored. Regions are what the generator
        ignores in either image, and labelled vehicles that the scene does not have.
        """
        after, tracks = self.render_frame(changed), self._planned.tracks
        image = torch.from_numpy(after.image.transpose(2, 0, 1).astype(np.float32) / np.float32(255))
        labels = label_before_and_after(self._before.frame, after)
        return SecondRender(image, _scene_targets(labels, tracks, changed), _visible_boxes(after, tracks))

    def render_frame(self, changed: SceneIR) -> SynthFrame:
        """Render a state of the scene as the generator's frame, with its own labels of everything."""
        return self._render_edit(self.transfer(changed).edit)

    def _render_edit(self, edit: FrameEdit) -> SynthFrame:
        """Render an edit; the street around the vehicles is rebuilt only where its foliage changed."""
        for rendered in (self._before, self._last):
            if edit == rendered.edit:
                return rendered.frame
        plan = apply_edit(self._planned.plan, edit, f"frame {self._identifier}")
        surround = self._last.surround if edit.foliage == self._last.edit.foliage else build_street(plan)
        frame = _render_plan(plan, surround)
        self._last = _RenderedEdit(edit, frame, surround)
        return frame


def _render_plan(plan: Plan, surround: Street) -> SynthFrame:
    frame = render_frame(plan, surround=surround)
    assert frame is not None
    return frame


def _check_photograph(identifier: str, photograph: Tensor, image: np.ndarray) -> None:
    """Raise FormatError where the scene's photograph is not the generator's image."""
    expected = "the image that the generator renders"
    given = np.rint(photograph.cpu().numpy().transpose(1, 2, 0) * 255).astype(np.int16)
    if given.shape != image.shape:
        raise FormatError(f"photograph of {identifier}", expected, f"one of shape {given.shape}")
    apart = int(np.abs(given - image).max(initial=0))
    if apart > _MAX_LEVELS_OFF:
        raise FormatError(f"photograph of {identifier}", expected, f"one {apart} levels off")


def _scene_targets(exact: GeneratorLabels, tracks: tuple[int | None, ...], scene: SceneIR) -> Targets:
    """Labels of the changed image: one row per object of the scene, then each region once per class."""
    rows = {track: row for row, track in enumerate(exact.tracks)}
    own = [rows.get(track) if track is not None else None for track in tracks]
    boxes = scene.objects.box2d.new_zeros(len(tracks), 4, device="cpu", dtype=torch.float32)
    labels = scene.objects.category.cpu().clone()
    ignore = torch.ones(len(tracks), dtype=torch.bool)
    for i, row in enumerate(own):
        if row is not None:
            boxes[i], labels[i] = exact.changed.boxes_xyxy[row], exact.changed.labels[row]
            ignore[i] = exact.changed.ignore[row]
    unknown = [row for row in rows.values() if row not in own]
    unknown_boxes = exact.changed.boxes_xyxy[unknown].repeat_interleave(len(CLASSES), dim=0)
    kinds = torch.arange(len(CLASSES)).repeat(len(unknown))
    regions = slice(len(rows), None)
    return Targets(
        torch.cat([boxes, unknown_boxes, exact.changed.boxes_xyxy[regions]]),
        torch.cat([labels, kinds, exact.changed.labels[regions]]),
        torch.cat([ignore, torch.ones_like(kinds, dtype=torch.bool), exact.changed.ignore[regions]]),
    )


def _visible_boxes(frame: SynthFrame, tracks: tuple[int | None, ...]) -> Tensor:
    """(N, 4) px boxes of the visible part of each object, with pixels as in `synth.frames.measure`."""
    n, camera = SUPERSAMPLING, frame.camera
    limit = [camera.width - 1, camera.height - 1] * 2
    owners = {t.actor.track: t.index + 1 for t in frame.truths}
    boxes = []
    for track in tracks:
        seen = frame.owner == owners[track] if track in owners else np.zeros((1, 1), bool)
        rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        if len(rows):
            edges = np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]) / n - 0.5
            boxes.append(np.clip(edges, 0, limit))
        else:
            boxes.append(np.zeros(4))
    return table(boxes, 4)
