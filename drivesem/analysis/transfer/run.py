"""Tests counterexamples of runs on other detectors: a row per run and detector."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import torch

from detectors.base import DetectorError, Predictor
from detectors.registry import SHIPPED
from drivesem.analysis.transfer.matrix import SourceRun, TransferCounts, TransferTarget, compute_transfer_row
from drivesem.analysis.transfer.report import build_transfer_report
from drivesem.attack.targets import DEFAULT_T_STAR, HEADLINE, EvaluatedClasses, resolve_t_star
from drivesem.config.commands import TransferConfig
from drivesem.config.errors import UsageError
from drivesem.config.options import DetectionOptions
from drivesem.evaluation.resampling import DRAWS
from drivesem.report.tables import AnalysisReport
from drivesem.run.detection_cache import DetectionCache, DetectorSpec, cache_detections
from drivesem.run.finished import PICTURES, AttackRun, RunFrame, load_runs
from drivesem.run.folder import claim_folder

DETECTIONS = "detections"
"""Folder of cached detections."""
_WRITTEN = ("transfer.json", "transfer.md", "transfer.csv", "transfer.png", DETECTIONS)


@dataclass(frozen=True, slots=True)
class TargetDetector:
    """A detector that counterexamples are tested on."""

    name: str
    """Short name for people."""
    spec: DetectorSpec
    """How to load it, and where to cache its detections."""
    predictor: Predictor
    """The loaded detector."""
    t_star: float | None = None
    """Score from which detections count; by default the detector's own, or else that of the settings."""


def split_list(text: str) -> list[str]:
    """Split "a, b" at commas, without empty parts."""
    return [part.strip() for part in text.split(",") if part.strip()]


def parse_detector_names(text: str, setting: str = "--detectors") -> list[str]:
    """Parse detectors such as "a,b,darknet:c.cfg,c.weights": a part after KIND:FILE that is not a detector by itself
    belongs to it.

    Raises UsageError, naming the setting, for none or repeated detectors.
    """
    names: list[str] = []
    for part in split_list(text):
        is_detector = ":" in part or part in SHIPPED or part.endswith(".safetensors")
        if names and ":" in names[-1] and not is_detector:
            names[-1] += f",{part}"
        else:
            names.append(part)
    if not names:
        raise UsageError(setting, "detectors with commas", repr(text))
    for name in names:
        if names.count(name) > 1:
            raise UsageError(setting, "each detector once", name)
    return names


def shorten_detector_names(names: Sequence[str]) -> list[str]:
    """Shorten detectors to the names of their files, with as many folders as make them unique."""

    def keep_folders(name: str, folders: int) -> str:
        return re.sub(r"[^,:]+", lambda part: "/".join(part[0].split("/")[-folders - 1 :]), name)

    short = []
    for name in names:
        depths = range(name.count("/") + 1)
        unique = (d for d in depths if [keep_folders(n, d) for n in names].count(keep_folders(name, d)) == 1)
        short.append(keep_folders(name, next(unique, depths[-1])))
    return short


def load_target_detectors(
    specs: Sequence[str], config: DetectionOptions, out: Path, t_star: float | None = None
) -> list[TargetDetector]:
    """Load all detectors, before the first picture, so that a misspelt name shows at once.

    Args:
        specs: The detectors.
        config: Device and tiles.
        out: Output folder, with the cache DETECTIONS.
        t_star: Score from which the detections of all of them count.

    Raises:
        UsageError: One is not a detector.
    """
    targets = []
    for name, spec in zip(shorten_detector_names(specs), specs, strict=True):
        detector_spec = DetectorSpec(spec, config.device, config.tiles, out / DETECTIONS)
        try:
            predictor = detector_spec.load()
            EvaluatedClasses.from_detector(predictor)
        except DetectorError as error:
            raise UsageError.from_detector_error("--detectors", "detectors", error) from error
        targets.append(TargetDetector(name, detector_spec, predictor, t_star))
    return targets


def run_transfer(config: TransferConfig) -> AnalysisReport:
    """Test the pictures of runs on detectors, and write the report. Raises UsageError or SceneError."""
    runs = load_runs(split_list(config.run or ""), config.limit)
    specs = parse_detector_names(config.detectors or "")
    out = Path(config.out) if config.out else runs[0].folder / "transfer"
    detectors = load_target_detectors(specs, config, out)
    # detections are cached by content, so any setting may change
    claim_folder(out, config, _WRITTEN, presentation=[field.name for field in fields(config)])
    pairs, failed = evaluate_pairs(runs, detectors, config)
    draws = DRAWS if config.bootstrap is None else config.bootstrap
    rows = [compute_transfer_row(pair, draws, config.seed) for pair in pairs]
    data = {"rows": [r.to_json() for r in rows], "headline": HEADLINE, "bootstrap": draws, "frames_failed": failed}
    report = build_transfer_report(out, rows, draws, failed, data)
    report.write()
    return report


def evaluate_pairs(
    runs: Sequence[AttackRun], detectors: Sequence[TargetDetector], config: DetectionOptions
) -> tuple[list[TransferCounts], dict[str, str]]:
    """Evaluate each detector on each run.

    Args:
        runs: The runs.
        detectors: The detectors.
        config: Workers, t*, and whether to keep going.

    Returns:
        Counts per run and detector, and reasons by picture that could not be used.

    Raises:
        UsageError: No frame of a run can be used.
        SceneError: A picture is damaged, and `keep_going` is not set.
    """
    failed: dict[str, str] = {}
    pictures = [path for run in runs for frame in run.frames for path in frame.pictures.values()]
    for target in detectors:
        failed |= cache_detections(target.spec, target.predictor, pictures, config, target.name)
    pairs: list[TransferCounts] = []
    for run in runs:
        frames = [f for f in run.frames if not any(str(p) in failed for p in f.pictures.values())]
        if not frames:
            raise UsageError("--run", "a run with frames that can be read", run.folder)
        pairs += [_evaluate_pair(run, target, frames, config) for target in detectors]
    return pairs, failed


def _evaluate_pair(
    run: AttackRun, detector: TargetDetector, frames: Sequence[RunFrame], config: DetectionOptions
) -> TransferCounts:
    cache = DetectionCache(detector.spec, detector.predictor)
    default_t_star = DEFAULT_T_STAR if config.t_star is None else config.t_star
    t_star = resolve_t_star(detector.predictor, detector.t_star, default_t_star)
    classes = EvaluatedClasses.from_detector(detector.predictor).names
    target = TransferTarget(detector.name, detector.spec.detector, classes, t_star)
    detections = {name: [cache.load(frame.pictures[name]) for frame in frames] for name in PICTURES}
    source = SourceRun(run.name, run.detector, run.method, run.params)
    with torch.no_grad():
        return TransferCounts.from_detections(source, target, [frame.result for frame in frames], detections)
