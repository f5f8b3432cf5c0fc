"""One frame of a run, computed again from its folder: pictures, detections, labels, success."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from detectors.base import Predictor
from detectors.types import CLASSES, Detections, Targets
from drivesem.analysis.verify.change import check_change, check_feasibility
from drivesem.analysis.verify.differences import CheckLog, Disagreement
from drivesem.attack.aims import Aim
from drivesem.attack.budgets import reach_of
from drivesem.attack.judging import JudgedClasses
from drivesem.attack.labels import Difficulty, Labeller, MovedLabels, to_kitti_labels
from drivesem.attack.space import Budget, Parameter, Parametrisation
from drivesem.data.kitti import read_labels
from drivesem.evaluation import failures
from drivesem.failures.certificate import Rule
from drivesem.failures.grades import Count, Grade
from drivesem.failures.grading import Grader
from drivesem.failures.second_renderer.compositor import CompositorDraw
from drivesem.run.frame import (
    RESULT,
    State,
    as_targets,
    case_of,
    detection_records,
    failure_records,
    psnr_in_boxes,
    target_records,
)
from drivesem.run.looking import as_picture, detections_in
from drivesem.run.manifest import OF_FRAME, field_hashes, frame_hashes
from drivesem.run.results import BoxRecord, Failure, FrameResult, load_frame
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.io import load_scene, to_uint8
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import Labels, Render, SceneIR

BENIGN, RERENDER, COUNTEREXAMPLE = "benign.png", "rerender.png", "counterexample.png"
LEVELS = 1
"""Levels of 255 by which the same picture may differ from one processor to another."""
BOX_PX, SCORE = 0.05, 1e-3
"""By how much a detection may differ: another number of threads adds up in another order."""
LABEL = 1e-3
"""Of numbers in label files, which have three decimals, and of recorded targets, in the label's units."""
IDENTITY_DB = 0.1
"""Of the PSNR of a re-render."""
_EXACT_DB = 120.0
"""A PSNR from which on, or without one, a re-render is the photograph."""
_NO_FILE = "no file"
DRAWS = 1
"""By how many draws a certificate may differ, whose scores lie that near to t*."""
_DETECTIONS = {
    BENIGN: "detections_benign",
    RERENDER: "detections_rerendered",
    COUNTEREXAMPLE: "detections_attacked",
}
"""The result's field of what was found in each picture."""
_LABEL_FIELDS = ("boxes_xyxy", "truncation", "occlusion", "translation", "size_lhw", "yaw")


@dataclass(frozen=True)
class Given:
    """What the run's settings say. hashes: of files in frames' folders, by frame and name, as the manifest has
    them; field_hashes: of values in their result.json; sealed: whether hashes are of all their files; t_star:
    score from which a detection counts; grader: of certificates alone.
    """

    detector: Predictor
    device: str
    backend: str
    params: tuple[Parameter, ...]
    budget: Budget
    parametrisation: Parametrisation
    aim: Aim
    t_star: float
    hashes: Mapping[str, Mapping[str, str]]
    field_hashes: Mapping[str, Mapping[str, str]]
    sealed: bool
    grader: Grader


@dataclass(frozen=True, slots=True)
class Level:
    """How far a picture is from the one on disk: the largest difference in levels of 255, and the share of pixels
    that differ at all.
    """

    largest: int
    share: float


@dataclass(frozen=True, slots=True)
class Checked:
    """One frame. compared: how often, by check; levels: of the three pictures, by file name."""

    identifier: str
    compared: dict[str, int]
    differences: tuple[Disagreement, ...]
    levels: dict[str, Level]


def check_frame(identifier: str, folder: Path, given: Given) -> Checked:
    """Compare one frame's folder with itself: everything follows from `scene/` and the pictures, and must be what
    the other files say.

    No label file says that an object is ignored. Success is therefore judged twice: by boxes, classes and regions
    of `labels_moved.txt` and `labels_paper.txt` with the flags that result.json records, and by the targets that
    it records; the flags themselves are compared with those of the saved scene. Raises SceneError for files that
    are missing or damaged.
    """
    result = load_frame(folder / RESULT)
    perturbed = load_scene(folder / "scene")
    base, rest = perturbed.as_photographed(), perturbed.at_rest()
    log = CheckLog()
    known, found = given.hashes.get(identifier, {}), frame_hashes(folder)
    for name in sorted(known.keys() | found.keys()) if given.sealed else known:
        log.same("files", name, known.get(name, _NO_FILE), found.get(name, _NO_FILE))
    values = field_hashes(files.read_json(folder / RESULT), OF_FRAME)
    log.each("files", RESULT, given.field_hashes.get(identifier, {}), values)
    check_change(log, folder, result, rest, perturbed, given.params, given.budget, given.parametrisation)
    check_feasibility(log, result, rest, perturbed, reach_of(given.budget, given.parametrisation))
    size = (base.camera.height, base.camera.width)
    pictures = {name: files.read_image(folder / name, size) for name in _DETECTIONS}
    with torch.no_grad():
        difficulty = Difficulty(min_contrast=result.min_contrast)
        drawn = _render(log, pictures, _Scenes(base, perturbed), difficulty, given.backend)
        _identity(log, result, base, drawn.before)
        seen = {
            name: detections_in(given.detector, as_picture(image, given.device))
            for name, image in pictures.items()
        }
    names = JudgedClasses.of(given.detector).names
    for name, field in _DETECTIONS.items():
        _compare_boxes(log, "detections", field, getattr(result, field), detection_records(seen[name], names))
    _judge(log, folder, result, drawn.labels, _Scenes(base, perturbed), seen, given)
    if result.graded:
        _grades(log, result, drawn, _Scenes(base, perturbed), seen, given)
    return Checked(identifier, log.compared, tuple(log.differences), drawn.levels)


@dataclass(frozen=True, slots=True)
class _Scenes:
    """A scene before and after the change."""

    base: SceneIR
    perturbed: SceneIR


@dataclass(frozen=True, slots=True)
class _Drawn:
    """The scene before and after the change, rendered again. labels: by mode; levels: as of `Checked`."""

    renderer: CompositorDraw
    before: Render
    after: Render
    labels: dict[str, MovedLabels]
    levels: dict[str, Level]


def _render(
    log: CheckLog, pictures: Mapping[str, np.ndarray], scenes: _Scenes, difficulty: Difficulty, backend: str
) -> _Drawn:
    """The three pictures against the scene; labels of the scene by mode, and contrasts by the pictures."""
    compositor = Compositor(scenes.perturbed.at_rest(), RenderSettings(backend=backend))  # pyright: ignore[reportArgumentType]
    before, after = compositor.render(scenes.base), compositor.render(scenes.perturbed)
    drawn = {BENIGN: scenes.base.photograph, RERENDER: before.image, COUNTEREXAMPLE: after.image}
    levels: dict[str, Level] = {}
    for name, image in drawn.items():
        apart = np.abs(pictures[name].astype(np.int16) - to_uint8(image)).max(axis=2)
        levels[name] = Level(int(apart.max()), float((apart > 0).mean()))
        found = f"up to {levels[name].largest} levels off, in {100 * levels[name].share:.3g} % of the pixels"
        log.told("pictures", name, "the scene's", found, agrees=levels[name].largest <= LEVELS)
    shown = [
        replace(render, image=as_picture(pictures[name], "cpu"))
        for render, name in ((before, RERENDER), (after, COUNTEREXAMPLE))
    ]
    labeller = Labeller(scenes.base, shown[0], difficulty)
    labels = {"paper": labeller.paper(), "moved": labeller.moved(scenes.perturbed, shown[1])}
    return _Drawn(CompositorDraw(compositor, labeller), before, after, labels, levels)


def _identity(log: CheckLog, result: FrameResult, base: SceneIR, before: Render) -> None:
    """The PSNR of the re-render, in the boxes of the vehicles."""
    pair = [result.identity_psnr_db, psnr_in_boxes(base, before.image)]
    told, found = (_EXACT_DB if value is None else min(value, _EXACT_DB) for value in pair)
    log.told("pictures", "identity_psnr_db", *pair, agrees=abs(told - found) <= IDENTITY_DB)


def _grades(
    log: CheckLog,
    result: FrameResult,
    drawn: _Drawn,
    scenes: _Scenes,
    seen: Mapping[str, Detections],
    given: Given,
) -> None:
    """Kinds and certificates of the recorded failures against draws that are taken again, and grades against what
    they rest on.
    """
    judged = JudgedClasses.of(given.detector)
    benign = State(scenes.base, drawn.before, drawn.labels["paper"], seen[RERENDER])
    now = State(scenes.perturbed, drawn.after, drawn.labels["moved"], seen[COUNTEREXAMPLE])
    case = case_of(result.identifier, drawn.renderer, judged, benign, now)
    moved = now.labels.targets
    found = failures.find(
        judged.targets(benign.labels.targets),
        benign.detections,
        judged.targets(moved),
        now.detections,
        given.t_star,
    )
    found = given.aim.failures(found, moved, now.detections, judged.names)
    again = failure_records(judged, moved, now.detections, found, given.grader.grade(case, found))
    if len(again) != len(result.failures):
        log.told("grades", "failures", len(result.failures), len(again), agrees=False)
        return
    for i, (recorded, failure) in enumerate(zip(result.failures, again, strict=True)):
        log.same("grades", f"failures[{i}].error", recorded.error, failure.error)
        log.same("grades", f"failures[{i}].index", recorded.index, failure.index)
        ours, theirs = _draws(recorded), _draws(failure)
        near = all(abs(a - b) <= DRAWS for a, b in zip(ours, theirs, strict=True))
        log.told("grades", f"failures[{i}].count", ours, theirs, agrees=near)
        log.same("grades", f"failures[{i}].grade", recorded.grade, str(_follows(recorded, given.grader.rule)))


def _draws(failure: Failure) -> tuple[int, int]:
    """Draws that count, before and after; of those that were not all taken as few as speak against it."""
    count = failure.count or Count()
    return count.before_draws - count.before, count.after_draws - count.after


def _follows(failure: Failure, rule: Rule) -> Grade:
    """The grade that the recorded draws give."""
    if failure.count is None or not rule.holds(failure.count):
        return Grade.THRESHOLD
    if failure.second is None or not failure.second.agrees:
        return Grade.CERTAIN
    return Grade.SHARED if failure.peer is not None and failure.peer.agrees else Grade.CONFIRMED


def _judge(
    log: CheckLog,
    folder: Path,
    result: FrameResult,
    labels: Mapping[str, MovedLabels],
    scenes: _Scenes,
    seen: Mapping[str, Detections],
    given: Given,
) -> None:
    """Labels against the scene, and success by them."""
    recorded = {"paper": result.targets_benign, "moved": result.targets_moved}
    count = len(scenes.base.objects)
    for mode, own in labels.items():
        _compare_targets(log, f"targets_{mode}", recorded[mode], target_records(own.targets, CLASSES, count))
    log.same(
        "labels",
        "became_ignored",
        list(result.became_ignored),
        labels["moved"].became_ignored.nonzero()[:, 0].tolist(),
    )
    judged = {mode: {"": as_targets(records, CLASSES)} for mode, records in recorded.items()}
    for mode, own in labels.items():
        name = f"labels_{mode}.txt"
        written = read_labels(folder / name)
        if _compare_labels(log, name, written, to_kitti_labels(own, scenes.base, scenes.perturbed)):
            judged[mode][f" by {name}"] = _targets_of(written, own, judged[mode][""].ignore)
    sizes = {len(targets) for kinds in judged.values() for targets in kinds.values()}
    if len(sizes) > 1:
        log.told("success", "targets", "as many of either label mode", sorted(sizes), agrees=False)
        return
    for mode, kinds in judged.items():
        for by, targets in kinds.items():
            _compare_success(log, result, mode, by, _failures(judged["paper"][""], targets, seen, given))


def _failures(
    benign: Targets, targets: Targets, seen: Mapping[str, Detections], given: Given
) -> tuple[tuple[int, ...], tuple[BoxRecord, ...]]:
    """Objects that are lost, and phantoms."""
    judged = JudgedClasses.of(given.detector)
    after = seen[COUNTEREXAMPLE]
    try:
        found = failures.find(judged.targets(benign), seen[RERENDER], judged.targets(targets), after, given.t_star)
    except ValueError as error:
        raise FormatError("targets_moved", "the objects of targets_benign", "others") from error
    found = given.aim.failures(found, targets, after, judged.names)
    records = detection_records(after, judged.names)
    return found.lost, tuple(records[i] for i in found.phantoms)


def _compare_success(
    log: CheckLog, result: FrameResult, mode: str, by: str, found: tuple[tuple[int, ...], tuple[BoxRecord, ...]]
) -> None:
    lost, phantoms = found
    expected = result.success_moved if mode == "moved" else result.success_paper
    log.same("success", f"success_{mode}{by}", expected, bool(lost or phantoms))
    if mode == "moved":
        known = [f.index for f in result.failures if f.kind == "lost"]
        log.same("success", f"lost{by}", [f"objects[{i}]" for i in known], [f"objects[{i}]" for i in lost])
        boxes = [BoxRecord(f.xyxy, f.label, f.score) for f in result.failures if f.kind == "phantom"]
        _compare_boxes(log, "success", f"phantoms{by}", boxes, phantoms)


def _compare_boxes(
    log: CheckLog, check: str, name: str, expected: Sequence[BoxRecord], found: Sequence[BoxRecord]
) -> None:
    """Detections, each with the first that is like it; order and what lies within the tolerance do not matter."""
    left = list(found)
    for record in expected:
        like = next((other for other in left if _alike(record, other)), None)
        if like is None:
            log.told(check, name, _said(record), "none like it", agrees=False)
        else:
            left.remove(like)
            log.told(check, name, "", "", agrees=True)
    for record in left:
        log.told(check, name, "none like it", _said(record), agrees=False)


def _alike(one: BoxRecord, other: BoxRecord) -> bool:
    apart = max(abs(a - b) for a, b in zip(one.xyxy, other.xyxy, strict=True))
    return one.label == other.label and apart <= BOX_PX and abs((one.score or 0) - (other.score or 0)) <= SCORE


def _said(record: BoxRecord) -> str:
    corners = " ".join(f"{value:.1f}" for value in record.xyxy)
    score = "" if record.score is None else f" {record.score:.3f}"
    return f"{record.label}{score} at {corners}"


def _compare_targets(log: CheckLog, name: str, expected: Sequence[BoxRecord], found: Sequence[BoxRecord]) -> None:
    """Recorded targets against those of the saved scene."""
    log.same("labels", f"{name}, how many", len(expected), len(found))
    for i, (one, other) in enumerate(zip(expected, found, strict=False)):
        apart = max(abs(a - b) for a, b in zip(one.xyxy, other.xyxy, strict=True))
        same = (one.label, one.ignore, one.index) == (other.label, other.ignore, other.index)
        told = [_said(r) + (", ignored" if r.ignore else "") for r in (one, other)]
        log.told("labels", f"{name}[{i}]", *told, agrees=same and apart <= LABEL)


def _compare_labels(log: CheckLog, name: str, written: Labels, own: Labels) -> bool:
    """A label file against the saved scene. Returns whether both have the same objects and as many regions."""
    log.same("labels", f"{name}: type", list(written.kind), list(own.kind))
    regions = len(written.ignore_xyxy), len(own.ignore_xyxy)
    log.same("labels", f"{name}: DontCare", *regions)
    if written.kind != own.kind or regions[0] != regions[1]:
        return False
    for field in _LABEL_FIELDS:
        _compare_rows(log, f"{name}: objects[{{}}].{field}", getattr(written, field), getattr(own, field))
    _compare_rows(log, f"{name}: DontCare[{{}}]", written.ignore_xyxy, own.ignore_xyxy)
    return True


def _compare_rows(log: CheckLog, name: str, written: Tensor, own: Tensor) -> None:
    """Rows of numbers; name: with a place for the row's."""
    for i, (one, other) in enumerate(zip(written.tolist(), own.tolist(), strict=True)):
        pair = [side if isinstance(side, list) else [side] for side in (one, other)]
        ways = [a - b for a, b in zip(*pair, strict=True)]
        if name.endswith(".yaw"):
            ways = [math.remainder(way, 2 * math.pi) for way in ways]
        apart = max(map(abs, ways))
        told = [" ".join(f"{value:.3f}" for value in side) for side in pair]
        log.told("labels", name.format(i), *told, agrees=apart <= LABEL)


def _targets_of(written: Labels, own: MovedLabels, ignore: Tensor) -> Targets:
    """What a label file holds as targets, with the recorded flags (M,) of what is ignored."""
    placed = own.boxes_xyxy.clone()
    placed[own.in_view] = written.boxes_xyxy
    boxes = replace(own, boxes_xyxy=placed, regions_xyxy=written.ignore_xyxy).targets
    return Targets(boxes.boxes_xyxy, boxes.labels, ignore if len(ignore) == len(boxes) else boxes.ignore)
