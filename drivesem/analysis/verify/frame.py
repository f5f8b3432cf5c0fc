"""Recomputes one frame of a run from its folder, and compares pictures, detections, labels, success and grades."""

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
from drivesem.analysis.verify.checks import CheckLog, Mismatch, check_change, check_feasibility
from drivesem.attack.budgets import change_limits
from drivesem.attack.labels import Difficulty, Labeller, SceneLabels, to_kitti_labels
from drivesem.attack.space import Budget, Parameter, Parametrisation
from drivesem.attack.targets import EvaluatedClasses, TargetSelection
from drivesem.data.kitti import read_labels
from drivesem.evaluation import failures
from drivesem.failures.certificate import CertificateRule, CompositorRenderer
from drivesem.failures.grades import Certificate, Grade
from drivesem.failures.grading import Grader
from drivesem.run.detection_cache import detect_objects, image_to_tensor
from drivesem.run.frame import (
    RESULT,
    EvaluatedScene,
    build_failure_records,
    build_grading_input,
    detection_records,
    psnr_in_boxes,
    target_records,
    targets_from_records,
)
from drivesem.run.manifest import HASHED_FRAME_FIELDS, hash_fields, hash_frame_files
from drivesem.run.results import BoxRecord, Failure, FrameResult, load_frame
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.io import load_scene, to_uint8
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import Labels, Render, SceneIR

BENIGN, RERENDER, COUNTEREXAMPLE = "benign.png", "rerender.png", "counterexample.png"
LEVELS = 1
"""Tolerance of pictures in levels of 255: results vary slightly between CPU models."""
BOX_PX, SCORE = 0.05, 1e-3
"""Tolerance of detections: the number of threads changes the order of sums."""
LABEL = 1e-3
"""Tolerance of label files, which have three decimals, and of recorded targets, in the label's units."""
IDENTITY_DB = 0.1
"""Tolerance of the PSNR of a re-render."""
_EXACT_DB = 120.0
"""A re-render with at least this PSNR, or none, is the photograph."""
_NO_FILE = "no file"
DRAWS = 1
"""Tolerance of a certificate in draws, as some scores lie close to t*."""
_DETECTIONS = {
    BENIGN: "detections_benign",
    RERENDER: "detections_rerendered",
    COUNTEREXAMPLE: "detections_attacked",
}
"""The result's field with the detections in each picture."""
_LABEL_FIELDS = ("boxes_xyxy", "truncation", "occlusion", "translation", "size_lhw", "yaw")


@dataclass(frozen=True)
class RecordedSettings:
    """The run's settings, detector and manifest."""

    detector: Predictor
    """The attacked detector."""
    device: str
    """Its device."""
    backend: str
    """Renderer backend."""
    params: tuple[Parameter, ...]
    """Attacked parameters."""
    budget: Budget
    """Limits of the change."""
    parametrisation: Parametrisation
    """Parametrisation of theta."""
    aim: TargetSelection
    """Attacked objects and classes."""
    t_star: float
    """Score from which detections count."""
    hashes: Mapping[str, Mapping[str, str]]
    """Hashes of files by frame and name."""
    field_hashes: Mapping[str, Mapping[str, str]]
    """Hashes of values in result.json by frame and name."""
    grader: Grader
    """Repeats certificates, without second opinions."""


@dataclass(frozen=True, slots=True)
class PixelDifference:
    """Difference between a re-rendered picture and the one on disk."""

    largest: int
    """Largest difference, levels of 255."""
    share: float
    """Share of pixels that differ."""


@dataclass(frozen=True, slots=True)
class FrameCheck:
    """Result of verifying one frame."""

    identifier: str
    """The frame."""
    compared: dict[str, int]
    """Number of comparisons by check."""
    differences: tuple[Mismatch, ...]
    """Values that differ."""
    levels: dict[str, PixelDifference]
    """Differences of the three pictures, by file name."""


def check_frame(identifier: str, folder: Path, settings: RecordedSettings) -> FrameCheck:
    """Recompute a frame from `scene/` and the pictures, and compare with its other files.

    Label files lack the ignore flags of objects. So success is evaluated twice: by the boxes, classes and regions
    of `labels_moved.txt` and `labels_paper.txt` with the flags in result.json, and by the targets in result.json;
    the flags are compared with those of the saved scene.

    Args:
        identifier: The frame.
        folder: Its folder.
        settings: The run's settings, detector and manifest.

    Raises:
        SceneError: A file is missing or damaged.
    """
    result = load_frame(folder / RESULT)
    perturbed = load_scene(folder / "scene")
    base, rest = perturbed.as_photographed(), perturbed.unperturbed()
    log = CheckLog()
    expected, found = settings.hashes.get(identifier, {}), hash_frame_files(folder)
    for name in sorted(expected.keys() | found.keys()):
        log.compare("files", name, expected.get(name, _NO_FILE), found.get(name, _NO_FILE))
    values = hash_fields(files.read_json(folder / RESULT), HASHED_FRAME_FIELDS)
    log.compare_values("files", RESULT, settings.field_hashes.get(identifier, {}), values)
    check_change(log, folder, result, rest, perturbed, settings.params, settings.budget, settings.parametrisation)
    check_feasibility(log, result, rest, perturbed, change_limits(settings.budget, settings.parametrisation))
    size = (base.camera.height, base.camera.width)
    pictures = {name: files.read_image(folder / name, size) for name in _DETECTIONS}
    with torch.no_grad():
        difficulty = Difficulty(min_contrast=result.min_contrast)
        rerender = _rerender(log, pictures, _SceneChange(base, perturbed), difficulty, settings.backend)
        _check_identity(log, result, base, rerender.before)
        detections = {
            name: detect_objects(settings.detector, image_to_tensor(image, settings.device))
            for name, image in pictures.items()
        }
    names = EvaluatedClasses.from_detector(settings.detector).names
    for name, field in _DETECTIONS.items():
        _compare_boxes(
            log, "detections", field, getattr(result, field), detection_records(detections[name], names)
        )
    _check_success(log, folder, result, rerender.labels, _SceneChange(base, perturbed), detections, settings)
    if result.graded:
        _check_grades(log, result, rerender, _SceneChange(base, perturbed), detections, settings)
    return FrameCheck(identifier, log.compared, tuple(log.differences), rerender.levels)


@dataclass(frozen=True, slots=True)
class _SceneChange:
    """A scene before and after the change."""

    base: SceneIR
    """Before."""
    perturbed: SceneIR
    """After."""


@dataclass(frozen=True, slots=True)
class _Rerender:
    """The scene, rendered again before and after the change."""

    renderer: CompositorRenderer
    """The renderer."""
    before: Render
    """Before the change."""
    after: Render
    """After the change."""
    labels: dict[str, SceneLabels]
    """Labels after the change, by label mode."""
    levels: dict[str, PixelDifference]
    """Differences from the three pictures on disk, by file name."""


def _rerender(
    log: CheckLog, pictures: Mapping[str, np.ndarray], scenes: _SceneChange, difficulty: Difficulty, backend: str
) -> _Rerender:
    """Compare the three pictures with re-renders, and compute labels, with contrasts from the pictures."""
    compositor = Compositor(scenes.perturbed.unperturbed(), RenderSettings(backend=backend))  # pyright: ignore[reportArgumentType]
    before, after = compositor.render(scenes.base), compositor.render(scenes.perturbed)
    images = {BENIGN: scenes.base.photograph, RERENDER: before.image, COUNTEREXAMPLE: after.image}
    levels: dict[str, PixelDifference] = {}
    for name, image in images.items():
        difference = np.abs(pictures[name].astype(np.int16) - to_uint8(image)).max(axis=2)
        levels[name] = PixelDifference(int(difference.max()), float((difference > 0).mean()))
        found = f"up to {levels[name].largest} levels off, in {100 * levels[name].share:.3g} % of the pixels"
        log.record("pictures", name, "as the scene renders", found, agrees=levels[name].largest <= LEVELS)
    renders = [
        replace(render, image=image_to_tensor(pictures[name], "cpu"))
        for render, name in ((before, RERENDER), (after, COUNTEREXAMPLE))
    ]
    labeller = Labeller(scenes.base, renders[0], difficulty)
    labels = {"paper": labeller.paper(), "moved": labeller.moved(scenes.perturbed, renders[1])}
    return _Rerender(CompositorRenderer(compositor, labeller), before, after, labels, levels)


def _check_identity(log: CheckLog, result: FrameResult, base: SceneIR, before: Render) -> None:
    """Compare the PSNR of the re-render in the boxes of the vehicles."""
    pair = [result.identity_psnr_db, psnr_in_boxes(base, before.image)]
    expected, found = (_EXACT_DB if value is None else min(value, _EXACT_DB) for value in pair)
    log.record("pictures", "identity_psnr_db", *pair, agrees=abs(expected - found) <= IDENTITY_DB)


def _check_grades(
    log: CheckLog,
    result: FrameResult,
    rerender: _Rerender,
    scenes: _SceneChange,
    detections: Mapping[str, Detections],
    settings: RecordedSettings,
) -> None:
    """Compare kinds and certificates of the failures with new draws, and grades with their evidence."""
    judged = EvaluatedClasses.from_detector(settings.detector)
    benign = EvaluatedScene(scenes.base, rerender.before, rerender.labels["paper"], detections[RERENDER])
    now = EvaluatedScene(scenes.perturbed, rerender.after, rerender.labels["moved"], detections[COUNTEREXAMPLE])
    case = build_grading_input(result.identifier, rerender.renderer, judged, benign, now)
    moved = now.labels.targets
    found = failures.find_failures(
        judged.map_targets(benign.labels.targets),
        benign.detections,
        judged.map_targets(moved),
        now.detections,
        settings.t_star,
    )
    found = settings.aim.failures(found, moved, now.detections, judged.names)
    again = build_failure_records(judged, moved, now.detections, found, settings.grader.grade(case, found))
    if len(again) != len(result.failures):
        log.record("grades", "failures", len(result.failures), len(again), agrees=False)
        return
    for i, (recorded, failure) in enumerate(zip(result.failures, again, strict=True)):
        log.compare("grades", f"failures[{i}].error", recorded.error, failure.error)
        log.compare("grades", f"failures[{i}].index", recorded.index, failure.index)
        expected, counted = _count_contrary_draws(recorded), _count_contrary_draws(failure)
        near = all(abs(a - b) <= DRAWS for a, b in zip(expected, counted, strict=True))
        log.record("grades", f"failures[{i}].count", expected, counted, agrees=near)
        log.compare(
            "grades",
            f"failures[{i}].grade",
            recorded.grade,
            str(_grade_from_evidence(recorded, settings.grader.rule)),
        )


def _count_contrary_draws(failure: Failure) -> tuple[int, int]:
    """Count the draws, before and after, that contradict the failure; sampling may have stopped early."""
    count = failure.count or Certificate()
    return count.before_draws - count.before, count.after_draws - count.after


def _grade_from_evidence(failure: Failure, rule: CertificateRule) -> Grade:
    """Return the grade that follows from the recorded draws and second opinions."""
    if failure.count is None or not rule.holds(failure.count):
        return Grade.THRESHOLD
    if failure.second is None or not failure.second.agrees:
        return Grade.CERTAIN
    return Grade.SHARED if failure.peer is not None and failure.peer.agrees else Grade.CONFIRMED


def _check_success(
    log: CheckLog,
    folder: Path,
    result: FrameResult,
    labels: Mapping[str, SceneLabels],
    scenes: _SceneChange,
    detections: Mapping[str, Detections],
    settings: RecordedSettings,
) -> None:
    """Compare labels with the scene, and success with labels and detections."""
    recorded = {"paper": result.targets_benign, "moved": result.targets_moved}
    count = len(scenes.base.objects)
    for mode, own in labels.items():
        _compare_targets(log, f"targets_{mode}", recorded[mode], target_records(own.targets, CLASSES, count))
    log.compare(
        "labels",
        "became_ignored",
        list(result.became_ignored),
        labels["moved"].became_ignored.nonzero()[:, 0].tolist(),
    )
    targets_by_mode = {mode: {"": targets_from_records(records, CLASSES)} for mode, records in recorded.items()}
    for mode, own in labels.items():
        name = f"labels_{mode}.txt"
        written = read_labels(folder / name)
        if _compare_labels(log, name, written, to_kitti_labels(own, scenes.base, scenes.perturbed)):
            ignore = targets_by_mode[mode][""].ignore
            targets_by_mode[mode][f" by {name}"] = _targets_from_labels(written, own, ignore)
    sizes = {len(targets) for by_source in targets_by_mode.values() for targets in by_source.values()}
    if len(sizes) > 1:
        log.record("success", "targets", "as many of either label mode", sorted(sizes), agrees=False)
        return
    for mode, by_source in targets_by_mode.items():
        for source, targets in by_source.items():
            found = _find_failures(targets_by_mode["paper"][""], targets, detections, settings)
            _compare_success(log, result, mode, source, found)


def _find_failures(
    benign: Targets, targets: Targets, detections: Mapping[str, Detections], settings: RecordedSettings
) -> tuple[tuple[int, ...], tuple[BoxRecord, ...]]:
    """Return lost objects and phantoms."""
    judged = EvaluatedClasses.from_detector(settings.detector)
    after = detections[COUNTEREXAMPLE]
    try:
        found = failures.find_failures(
            judged.map_targets(benign), detections[RERENDER], judged.map_targets(targets), after, settings.t_star
        )
    except ValueError as error:
        raise FormatError("targets_moved", "the objects of targets_benign", "others") from error
    found = settings.aim.failures(found, targets, after, judged.names)
    records = detection_records(after, judged.names)
    return found.lost, tuple(records[i] for i in found.phantoms)


def _compare_success(
    log: CheckLog,
    result: FrameResult,
    mode: str,
    source: str,
    found: tuple[tuple[int, ...], tuple[BoxRecord, ...]],
) -> None:
    lost, phantoms = found
    expected = result.success_moved if mode == "moved" else result.success_paper
    log.compare("success", f"success_{mode}{source}", expected, bool(lost or phantoms))
    if mode == "moved":
        known = [f.index for f in result.failures if f.kind == "lost"]
        log.compare("success", f"lost{source}", [f"objects[{i}]" for i in known], [f"objects[{i}]" for i in lost])
        boxes = [BoxRecord(f.xyxy, f.label, f.score) for f in result.failures if f.kind == "phantom"]
        _compare_boxes(log, "success", f"phantoms{source}", boxes, phantoms)


def _compare_boxes(
    log: CheckLog, check: str, name: str, expected: Sequence[BoxRecord], found: Sequence[BoxRecord]
) -> None:
    """Compare detections within the tolerance, in any order."""
    unmatched = list(found)
    for record in expected:
        match = next((other for other in unmatched if _is_close(record, other)), None)
        if match is None:
            log.record(check, name, _describe_box(record), "no match", agrees=False)
        else:
            unmatched.remove(match)
            log.record(check, name, "", "", agrees=True)
    for record in unmatched:
        log.record(check, name, "no match", _describe_box(record), agrees=False)


def _is_close(one: BoxRecord, other: BoxRecord) -> bool:
    apart = max(abs(a - b) for a, b in zip(one.xyxy, other.xyxy, strict=True))
    return one.label == other.label and apart <= BOX_PX and abs((one.score or 0) - (other.score or 0)) <= SCORE


def _describe_box(record: BoxRecord) -> str:
    corners = " ".join(f"{value:.1f}" for value in record.xyxy)
    score = "" if record.score is None else f" {record.score:.3f}"
    return f"{record.label}{score} at {corners}"


def _compare_targets(log: CheckLog, name: str, expected: Sequence[BoxRecord], found: Sequence[BoxRecord]) -> None:
    """Compare recorded targets with those of the saved scene."""
    log.compare("labels", f"{name}, how many", len(expected), len(found))
    for i, (one, other) in enumerate(zip(expected, found, strict=False)):
        apart = max(abs(a - b) for a, b in zip(one.xyxy, other.xyxy, strict=True))
        same = (one.label, one.ignore, one.index) == (other.label, other.ignore, other.index)
        texts = [_describe_box(r) + (", ignored" if r.ignore else "") for r in (one, other)]
        log.record("labels", f"{name}[{i}]", *texts, agrees=same and apart <= LABEL)


def _compare_labels(log: CheckLog, name: str, written: Labels, own: Labels) -> bool:
    """Compare a label file with the saved scene. Returns whether both have the same objects and number of regions."""
    log.compare("labels", f"{name}: type", list(written.kind), list(own.kind))
    regions = len(written.ignore_xyxy), len(own.ignore_xyxy)
    log.compare("labels", f"{name}: DontCare", *regions)
    if written.kind != own.kind or regions[0] != regions[1]:
        return False
    for field in _LABEL_FIELDS:
        _compare_rows(log, f"{name}: objects[{{}}].{field}", getattr(written, field), getattr(own, field))
    _compare_rows(log, f"{name}: DontCare[{{}}]", written.ignore_xyxy, own.ignore_xyxy)
    return True


def _compare_rows(log: CheckLog, name: str, written: Tensor, own: Tensor) -> None:
    """Compare rows of numbers. name: a format string for the number of the row."""
    for i, (one, other) in enumerate(zip(written.tolist(), own.tolist(), strict=True)):
        pair = [side if isinstance(side, list) else [side] for side in (one, other)]
        differences = [a - b for a, b in zip(*pair, strict=True)]
        if name.endswith(".yaw"):
            differences = [math.remainder(difference, 2 * math.pi) for difference in differences]
        largest = max(map(abs, differences))
        texts = [" ".join(f"{value:.3f}" for value in side) for side in pair]
        log.record("labels", name.format(i), *texts, agrees=largest <= LABEL)


def _targets_from_labels(written: Labels, own: SceneLabels, ignore: Tensor) -> Targets:
    """Return the targets of a label file, with the recorded ignore flags (M,)."""
    boxes_xyxy = own.boxes_xyxy.clone()
    boxes_xyxy[own.in_view] = written.boxes_xyxy
    boxes = replace(own, boxes_xyxy=boxes_xyxy, regions_xyxy=written.ignore_xyxy).targets
    return Targets(boxes.boxes_xyxy, boxes.labels, ignore if len(ignore) == len(boxes) else boxes.ignore)
