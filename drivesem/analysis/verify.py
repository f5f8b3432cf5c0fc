"""Recomputes every frame of a run from its files and compares pictures, labels, success, grades, theta and totals."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from detectors.base import Predictor
from detectors.types import CLASSES, Detections, Targets
from drivesem.attacks.budgets import budget_for_coordinates, change_limits, parse_budget
from drivesem.attacks.feasibility_check import ChangeLimits, check_limits, check_scene
from drivesem.attacks.labels import Difficulty, Labeller, SceneLabels, to_kitti_labels
from drivesem.attacks.space import Budget, Parameter, ParameterSpace, Parametrisation
from drivesem.attacks.targets import EvaluatedClasses, TargetSelection, resolve_t_star
from drivesem.config.commands import VerifyConfig
from drivesem.config.errors import UsageError
from drivesem.data.kitti import read_labels
from drivesem.evaluation import failures
from drivesem.failures.certificate import CertificateRule, CompositorRenderer
from drivesem.failures.grades import Certificate, Grade
from drivesem.failures.grading import Grader
from drivesem.run.attack import build_grader, resolve_parameters, summarise_run
from drivesem.run.detection_cache import detect_objects, image_to_tensor
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.run.finished import (
    HASHED_FRAME_FIELDS,
    HASHED_RUN_FIELDS,
    MANIFEST,
    METRICS,
    AttackRun,
    hash_fields,
    hash_frame_files,
    hash_json,
    load_runs,
)
from drivesem.run.folder import CONFIG, FRAMES, load_run_detector, load_trusted_config, result_settings
from drivesem.run.frame import (
    EvaluatedScene,
    build_failure_records,
    build_grading_input,
    detection_records,
    psnr_in_boxes,
    target_records,
    targets_from_records,
)
from drivesem.run.labels import RESULT
from drivesem.run.records import from_json
from drivesem.run.results import BoxRecord, Failure, FrameResult, load_frame
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.io import load_scene, to_uint8
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import Labels, Render, SceneIR

WHOLE_RUN = "(run)"
"""Stands for the name of a frame in differences of the run as a whole."""
_NOT_COMPUTED = ("schema", "out", "seconds", "data", "frames_without_vehicles", "frames_failed")
"""Keys of metrics.json that do not follow from the frames. The last three are part of its hash."""
_ROUNDING = 1e-9


def run_verify(config: VerifyConfig) -> tuple[dict[str, Any], Path]:
    """Verify a run, and write the report. Returns its data and file. Raises UsageError or SceneError for bad
    input.
    """
    (run,) = load_runs([config.run or ""])
    make_verifier = partial(FrameVerifier, config, run)
    verifier = make_verifier()
    out = Path(config.out) if config.out else run.folder / "verify.json"
    if out.is_dir():
        raise UsageError("--out", "a file", f"the folder {out}")
    names = [frame.result.identifier for frame in run.frames][: config.limit]
    progress_settings = ProgressSettings("checking frames", keep=False)
    jobs = run_frame_jobs(names, verifier, make_verifier, config, progress_settings)
    checks = [jobs.results[name] for name in names if name in jobs.results]
    data = _to_json(run, checks, _check_totals(run, verifier), jobs.failed)
    files.write_json(out, data)
    return data, out


class FrameVerifier:
    """Verifies frames of a run; made once per process."""

    def __init__(self, config: VerifyConfig, run: AttackRun) -> None:
        attack = load_trusted_config(run.folder, config.trust)
        detector = load_run_detector(attack, config.device)
        self.run, self.attack = run, attack
        self.manifest = RunManifest.read(run.folder / MANIFEST)
        self.settings = RecordedSettings(
            detector=detector,
            device=config.device,
            backend=attack.backend,
            params=resolve_parameters(attack),
            budget=parse_budget(attack.budget),
            parametrisation=attack.parametrisation,
            aim=TargetSelection.from_options(attack.target_objects, attack.target_classes),
            t_star=resolve_t_star(detector, attack.t_star),
            hashes=self.manifest.frames,
            field_hashes=self.manifest.frame_fields,
            grader=build_grader(replace(attack, confirm=False), detector),
        )

    def __call__(self, name: str) -> FrameCheck:
        """Verify one frame."""
        return check_frame(name, self.run.folder / FRAMES / name, self.settings)


@dataclass(frozen=True, slots=True)
class RunManifest:
    """Settings and hashes in a run's manifest.json."""

    settings: Mapping[str, Any]
    """The run's settings."""
    metrics: str
    """Hash of metrics.json."""
    frames: Mapping[str, Mapping[str, str]]
    """Hashes by frame and file."""
    run_fields: Mapping[str, str]
    """Hashes of values in metrics.json."""
    frame_fields: Mapping[str, Mapping[str, str]]
    """Hashes of values in result.json, by frame."""

    @classmethod
    def read(cls, path: Path) -> RunManifest:
        """Read a manifest. Raises FormatError if it is damaged."""
        data = files.read_json(path)
        frames, settings = data.get("frames"), data.get("settings")
        if not isinstance(frames, dict) or not all(isinstance(part, dict) for part in frames.values()):
            raise FormatError(f"{path}: frames", "hashes by frame and file", "something else")
        if not isinstance(settings, dict):
            raise FormatError(f"{path}: settings", "settings by name", type(settings).__name__)
        fields = from_json(_ManifestFields, data.get("fields", {}), f"{path}: fields")
        return cls(settings, data.get("metrics"), frames, fields.run, fields.frames)


@dataclass(frozen=True, slots=True)
class _ManifestFields:
    run: dict[str, str] = field(default_factory=dict)
    frames: dict[str, dict[str, str]] = field(default_factory=dict)


def _check_totals(run: AttackRun, verifier: FrameVerifier) -> CheckLog:
    """Compare config.yaml with the manifest, and metrics.json with the run's frames."""
    log, metrics, manifest = CheckLog(), files.read_json(run.folder / METRICS), verifier.manifest
    log.compare("files", METRICS, manifest.metrics, hash_json(metrics))
    log.compare_values("files", METRICS, manifest.run_fields, hash_fields(metrics, HASHED_RUN_FIELDS))
    settings, expected_settings = result_settings(verifier.attack), dict(manifest.settings)
    for name in sorted(settings.keys() | expected_settings.keys()):
        log.compare("settings", f"{CONFIG}: {name}", settings.get(name), expected_settings.get(name))
    results = [frame.result for frame in run.frames]
    params, detector = verifier.settings.params, verifier.settings.detector
    computed = summarise_run(verifier.attack, params, detector, results).to_json()
    for name in (*_NOT_COMPUTED, *({"map", "rate", "by_class"} - metrics.keys())):  # earlier versions lack them
        del computed[name]
    recorded = dict(_flatten("", metrics))
    for name, value in _flatten("", computed):
        expected = recorded.get(name)
        log.record("totals", f"{METRICS}: {name}", expected, value, agrees=_is_equal(expected, value))
    return log


def _flatten(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the values of a nested object with their paths."""
    if isinstance(value, dict) and value:
        for key, part in value.items():
            yield from _flatten(f"{name}.{key}" if name else key, part)
    else:
        yield name, value


def _is_equal(expected: Any, value: Any) -> bool:
    """Compare exactly, but floats up to rounding."""
    numbers = isinstance(expected, int | float) and isinstance(value, float)
    return math.isclose(expected, value, rel_tol=_ROUNDING, abs_tol=_ROUNDING) if numbers else expected == value


def _to_json(
    run: AttackRun, checked: Sequence[FrameCheck], totals: CheckLog, failed: dict[str, str]
) -> dict[str, Any]:
    differences: list[tuple[str, Mismatch]] = [(c.identifier, d) for c in checked for d in c.differences]
    differences += [(WHOLE_RUN, d) for d in totals.differences]
    rows = []
    for check, holds in CHECKS.items():
        own = [name for name, d in differences if d.check == check]
        rows.append(
            {
                "name": check,
                "holds": holds,
                "compared": sum(c.compared.get(check, 0) for c in (*checked, totals)),
                "differing": len(own),
                "frames_differing": list(dict.fromkeys(own)),
            }
        )
    pictures = {name for c in checked for name in c.levels}
    return {
        "run": str(run.folder),
        "detector": run.detector,
        "params": run.params,
        "frames": len(checked),
        "frames_of_run": len(run.frames),
        "agree": not differences and not failed,
        "checks": rows,
        "rendered_again": {
            name: {
                "largest_level": max(c.levels[name].largest for c in checked),
                "largest_share": max(c.levels[name].share for c in checked),
            }
            for name in sorted(pictures)
        },
        "tolerances": {"levels": LEVELS, "box_px": BOX_PX, "score": SCORE, "label": LABEL, "draws": DRAWS},
        "differences": [{"frame": name, **asdict(d)} for name, d in differences],
        "frames_ungraded": sum(not frame.result.graded for frame in run.frames),
        "frames_failed": failed,
    }


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
FIDELITY = 0.02
"""Tolerance of the fidelity of a picture."""
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
    for name, recorded in _DETECTIONS.items():
        found_records = detection_records(detections[name], names)
        _compare_boxes(log, "detections", recorded, getattr(result, recorded), found_records)
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
        score, again_score = (1.0 if one.fidelity is None else one.fidelity.score for one in (recorded, failure))
        same = abs(score - again_score) <= FIDELITY
        log.record("grades", f"failures[{i}].fidelity", score, again_score, agrees=same)
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
    if failure.count is None or not rule.holds(failure.count) or not failure.is_trusted:
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
    for column in _LABEL_FIELDS:
        _compare_rows(log, f"{name}: objects[{{}}].{column}", getattr(written, column), getattr(own, column))
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


CHECKS: Mapping[str, str] = {
    "files": "all files of the frames, and metrics.json, have the hashes in manifest.json",
    "settings": "config.yaml has the settings in manifest.json",
    "pictures": "re-rendering the saved scene reproduces the three pictures",
    "detections": "the detector's detections in the three pictures are the recorded ones",
    "labels": "both label files and the recorded targets follow from the saved scene",
    "success": "lost objects, phantoms, and success in both label modes follow from labels and detections",
    "grades": "new draws reproduce each certificate; grades follow from their evidence",
    "feasibility": "the independent check agrees on the saved scene, and the change is within the budget",
    "theta": "theta.json, result.json and the saved scene hold the same change",
    "totals": "metrics.json follows from the frames and config.yaml",
}
"""Checks in the order of the report, and what holds if nothing differs."""


@dataclass(frozen=True, slots=True)
class Mismatch:
    """A difference between a run's result and its files."""

    check: str
    """Name of the check."""
    field: str
    """Such as `success_moved` or `objects[3].yaw`."""
    expected: str
    """Value in the run's result."""
    found: str
    """Value that follows from its files."""


@dataclass(slots=True)
class CheckLog:
    """Counts comparisons, and collects the differences."""

    compared: dict[str, int] = field(default_factory=dict)
    """Number of comparisons by check."""
    differences: list[Mismatch] = field(default_factory=list)
    """Values that differ."""

    def compare(self, check: str, name: str, expected: object, found: object) -> None:
        """Compare two values exactly.

        Args:
            check: Name of the check.
            name: Name of the value.
            expected: Value in the run's result.
            found: Value that follows from its files.
        """
        self.record(check, name, expected, found, agrees=expected == found)

    def compare_values(self, check: str, file: str, expected: Mapping[str, str], found: Mapping[str, str]) -> None:
        """Compare several values of a file exactly.

        Args:
            check: Name of the check.
            file: The file.
            expected: Values in the run's result, by name.
            found: Values that follow from its files.
        """
        for name, value in expected.items():
            self.compare(check, f"{file}: {name}", value, found.get(name))

    def record(self, check: str, name: str, expected: object, found: object, agrees: bool) -> None:
        """Record a comparison.

        Args:
            check: Name of the check.
            name: Name of the value.
            expected: Value in the run's result.
            found: Value that follows from its files.
            agrees: Whether they agree.
        """
        self.compared[check] = self.compared.get(check, 0) + 1
        if not agrees:
            self.differences.append(Mismatch(check, name, _format_value(expected), _format_value(found)))


def _format_value(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "; ".join(_format_value(part) for part in value) or "none"
    return str(value)


THETA = "theta.json"
BOUND = 1e-6
"""Tolerance of theta's bounds, in its units: above float32 rounding, below a sign step."""
SCENE = 1e-5
"""Tolerance between the scene that theta gives and the saved one (m, rad, unit boxes, codes)."""
_MOVED = ("translation", "yaw", "ffd", "size_lhw", "texture_code", "lamps")
_CODES = ("weather", "foliage", "light")


def check_change(
    log: CheckLog,
    folder: Path,
    result: FrameResult,
    base: SceneIR,
    perturbed: SceneIR,
    params: Sequence[Parameter],
    budget: Budget,
    parametrisation: Parametrisation,
) -> None:
    """Compare theta of result.json with theta.json, the run's bounds, and the saved scene.

    Args:
        log: Records the comparisons.
        folder: The frame's folder.
        result: The frame's result.
        base: The scene before the change.
        perturbed: The saved scene.
        params: The run's parameters.
        budget: The run's budget.
        parametrisation: The run's parametrisation.

    Raises:
        FormatError: theta.json is damaged.
    """
    written = files.read_json(folder / THETA)
    if not isinstance(written, dict):
        raise FormatError(str(folder / THETA), "coordinates by name", type(written).__name__)
    log.compare("theta", f"{THETA}, names", [c.name for c in result.theta], list(written))
    for c in result.theta:
        if c.name in written:
            expected = {"value": c.value, "unit": c.unit, "bounds": [c.lower, c.upper], "display": c.display}
            log.compare("theta", f"{THETA}: {c.name}", expected, written[c.name])
    recorded = budget_for_coordinates(budget, [c.name for c in result.theta])
    space = ParameterSpace(base, params, recorded, parametrisation=parametrisation)
    names = [space.name(i) for i in range(space.dim)]
    log.compare("theta", "coordinates", [c.name for c in result.theta], names)
    if len(result.theta) != space.dim:
        return
    for c, lower, upper in zip(result.theta, space.lower.tolist(), space.upper.tolist(), strict=True):
        bounds, own = f"[{c.lower:g}, {c.upper:g}]", f"[{lower:g}, {upper:g}]"
        same = abs(c.lower - lower) <= BOUND and abs(c.upper - upper) <= BOUND
        log.record("theta", f"{c.name}, bounds", bounds, own, agrees=same)
        log.record(
            "feasibility",
            f"{c.name}, budget",
            f"a value in {own}",
            c.value,
            agrees=lower - BOUND <= c.value <= upper + BOUND,
        )
    theta = torch.tensor([c.value for c in result.theta]).to(space.theta0)
    _compare_scenes(log, space.apply(base, theta), perturbed)


def _compare_scenes(log: CheckLog, expected: SceneIR, found: SceneIR) -> None:
    """Compare the scene that theta gives with the saved one."""
    for name in _MOVED:
        rows = zip(getattr(expected.objects, name), getattr(found.objects, name), strict=True)
        for i, (one, other) in enumerate(rows):
            _compare_tensors(log, f"scene: objects[{i}].{name}", one, other)
    for name in _CODES:
        one, other = (getattr(scene.environment, name) for scene in (expected, found))
        _compare_tensors(log, f"scene: {name}", one, other)


def _compare_tensors(log: CheckLog, name: str, expected: Tensor, found: Tensor) -> None:
    differences = (expected - found).abs().reshape(-1)
    worst = int(differences.argmax())
    pair = [f"{float(side.reshape(-1)[worst]):.6g}" for side in (expected, found)]
    log.record("theta", name, *pair, agrees=float(differences[worst]) <= SCENE)


def check_feasibility(
    log: CheckLog, result: FrameResult, base: SceneIR, perturbed: SceneIR, reach: ChangeLimits
) -> None:
    """Repeat the independent feasibility check, and check the saved poses against the run's budget.

    Args:
        log: Records the comparisons.
        result: The frame's result.
        base: The scene before the change.
        perturbed: The saved scene.
        reach: Limits of the change.
    """
    found = check_scene(base, perturbed, result.checked_by, result.joint_weather, reach)
    log.compare("feasibility", "violations", list(result.violations), found)
    log.compare("feasibility", "budget", [], check_limits(base, perturbed, reach))
