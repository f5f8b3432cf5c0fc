"""Evaluates a detector on a data set, and draws its mistakes."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.table import Table
from torch import Tensor

from detectors.base import DetectorError, Predictor
from detectors.check import survey_streets
from detectors.registry import load_predictor
from detectors.types import Detections
from drivesem.analysis.evaluate.conditions import (
    CONDITION_COLUMNS,
    measure_conditions,
    tabulate_conditions,
    write_conditions,
)
from drivesem.analysis.evaluate.files import MANY_FRAMES
from drivesem.attacks.labels import Difficulty
from drivesem.attacks.targets import HEADLINE, EvaluatedClasses, resolve_t_star
from drivesem.config.commands import EvalConfig
from drivesem.config.errors import UsageError
from drivesem.data.account import write_account_of
from drivesem.data.registry import Dataset
from drivesem.data.subsets import FrameFilter, open_selection
from drivesem.evaluation import coco
from drivesem.evaluation.conditions import ConditionRow, DetectedObjects
from drivesem.evaluation.instances import Floats
from drivesem.evaluation.matched_class import FrameMarks, MatchedClass
from drivesem.evaluation.resampling import DRAWS, Interval
from drivesem.reporting.drawing import (
    DETECTED_COLOUR,
    IGNORED_COLOUR,
    LOST_COLOUR,
    PHANTOM_COLOUR,
    TRUE_COLOUR,
    LabelLayout,
    TextLabel,
)
from drivesem.reporting.tables import Console, format_count, format_percent
from drivesem.run.detection_cache import detect_objects
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.training.frames import adapt_limits, evaluation_targets
from scene_ir import files
from scene_ir.errors import FormatError, SceneError
from scene_ir.io import to_uint8
from scene_ir.types import Labels


@dataclass(frozen=True, slots=True)
class DetectorMetrics:
    """Metrics of a detector on a data set."""

    data: dict[str, Any]
    """The JSON data."""
    per_class: Mapping[str, coco.ClassScores]
    """Scores by class."""
    intervals: Sequence[Interval]
    """Bootstrap intervals of the headline class."""
    conditions: Sequence[ConditionRow]
    """Recall of the headline class by condition, with `--by`."""


def evaluate_detector(config: EvalConfig) -> DetectorMetrics:
    """Evaluate a detector on a data set, and write the results. Raises UsageError or SceneError for bad input."""
    dataset = open_selection(config.dataset, config.root or "", FrameFilter.from_options(config))
    detector = _detector(config)
    account = write_account_of(dataset, config.keep_going)
    names = dataset.identifiers[: config.limit]
    _warn_if_blind(config, dataset, detector, names)
    frame_detector, make_detector = _FrameDetector(config, dataset, detector), partial(_FrameDetector, config)
    jobs = run_frame_jobs(names, frame_detector, make_detector, config, ProgressSettings("frames", keep=False))
    names = [name for name in names if name in jobs.results]
    if not names:
        raise UsageError("--root", "frames that can be used", "none")
    found, labels = [jobs.results[name][0] for name in names], [jobs.results[name][1] for name in names]
    t_star = resolve_t_star(detector)
    judged = EvaluatedClasses.from_detector(detector).names
    limits = adapt_limits(Difficulty(config.min_height, config.max_occlusion, config.max_truncation), labels)
    targets = [evaluation_targets(one, limits, judged) for one in labels]
    if not any(bool((~one.ignore).any()) for one in targets):
        expected = f"objects of {', '.join(judged)} that count (see --map, --min-height)"
        raise UsageError("--root", expected, f"none in {format_count(len(names), 'frame')}")
    scores = coco.evaluate(targets, found, judged, t_star, HEADLINE)
    outcome = MatchedClass.from_frames(targets, found, judged.index(HEADLINE))
    draws = config.bootstrap
    if draws is None:
        draws = 0 if len(names) > MANY_FRAMES else DRAWS
    spread = outcome.intervals(draws, config.seed) if draws else []
    conditions: list[ConditionRow] = []
    if config.by is not None:
        attributes = [dataset.attributes(name) for name in names]
        objects = DetectedObjects.from_matches(outcome.candidates, outcome.match, 0, t_star)
        conditions = measure_conditions(config, {HEADLINE: objects}, attributes, draws)
    data: dict[str, Any] = {
        "detector": config.detector,
        "dataset": config.dataset,
        "data": account,
        "frames": len(names),
        "failed": dict(sorted(jobs.failed.items())),
        "headline": HEADLINE,
        "t_star": t_star,
        "min_height": config.min_height,
        "max_occlusion": config.max_occlusion,
        "max_truncation": config.max_truncation,
        "tiles": config.tiles,
        **scores.to_json(),
        "bootstrap": draws,
        "intervals": [asdict(one) for one in spread],
        "conditions": [asdict(row) for row in conditions],
    }
    if config.out is not None:
        _write(Path(config.out), data, names, found, judged)
        write_conditions(Path(config.out), conditions)
        if config.pictures:
            _draw(config, dataset, names, outcome, t_star)
    return DetectorMetrics(data, scores.per_class, spread, conditions)


def _draw(
    config: EvalConfig, dataset: Dataset, names: Sequence[str], outcome: MatchedClass, t_star: float
) -> None:
    """Write pictures of the frames with most mistakes, worst first."""
    marks = [outcome.frame_marks(frame, t_star) for frame in range(len(names))]
    worst = sorted(range(len(names)), key=lambda i: (-marks[i].error_count, i))
    for rank, frame in enumerate(worst[: config.pictures], start=1):
        picture = draw_mistakes(to_uint8(dataset.frame(names[frame]).photograph), marks[frame])
        name = names[frame].replace("/", "_")
        files.write_png(Path(config.out or "") / "pictures" / f"{rank:03d}-{name}.png", picture)


def _warn_if_blind(config: EvalConfig, dataset: Dataset, detector: Predictor, names: Sequence[str]) -> None:
    """Print one line where the detector finds no car in the first frames that have some."""

    def photographs() -> Iterator[Tensor]:
        for name in names:
            try:
                frame = dataset.frame(name)
            except SceneError:  # its evaluation reports it
                continue
            if frame.labels is not None and HEADLINE in frame.labels.kind:
                yield frame.photograph.to(config.device)

    pictures = islice(photographs(), SURVEYED_FRAMES)
    survey, _ = survey_streets(detector, pictures, resolve_t_star(detector), until_found=True)
    if survey.pictures and survey.problem is not None:
        hint = f"drivesem check --detector {config.detector}"
        sys.stderr.write(f"--detector {config.detector}: {survey.problem} ({hint})\n")


def _detector(config: EvalConfig) -> Predictor:
    try:
        detector = load_predictor(config.detector or "", config.device, config.tiles)
        EvaluatedClasses.from_detector(detector)
    except DetectorError as error:
        raise UsageError.from_detector_error("--detector", "a detector", error) from error
    return detector


class _FrameDetector:
    """Detects objects in frames; made once per process."""

    def __init__(
        self, config: EvalConfig, dataset: Dataset | None = None, detector: Predictor | None = None
    ) -> None:
        choice = FrameFilter.from_options(config)
        self._dataset = dataset or open_selection(config.dataset, config.root or "", choice)
        self._detector = detector or _detector(config)
        self._device = config.device

    def __call__(self, name: str) -> tuple[Detections, Labels]:
        """Return the detections in a frame and its labels. Raises FormatError for a frame without labels."""
        frame = self._dataset.frame(name)
        if frame.labels is None:
            raise FormatError(f"frame {name}", "labels", "none")
        return detect_objects(self._detector, frame.photograph.to(self._device)), frame.labels


def _write(
    out: Path, data: Mapping[str, Any], names: Sequence[str], found: Sequence[Detections], judged: Sequence[str]
) -> None:
    """Write metrics.json, and the detections as KITTI results, which drivesem eval --pred reads."""
    from drivesem.data.kitti import write_labels

    files.write_json(out / "metrics.json", data)
    for name, one in zip(names, found, strict=True):
        # empty boxes match nothing, and inverted ones cannot be read
        is_valid = ((one.boxes_xyxy[:, 2:] - one.boxes_xyxy[:, :2]) >= 0.01).all(dim=1)
        n = int(is_valid.sum())
        unknown = torch.full((n, 3), torch.nan)
        labels = Labels(
            kind=tuple(judged[int(k)] for k in one.labels[is_valid]),
            boxes_xyxy=one.boxes_xyxy[is_valid],
            truncation=unknown[:, 0],
            occlusion=torch.full((n,), 3, dtype=torch.int64),
            translation=unknown,
            yaw=unknown[:, 0],
            size_lhw=unknown,
            ignore_xyxy=torch.zeros(0, 4),
        )
        path = out / "detections" / f"{name.replace('/', '_')}.txt"
        write_labels(path, labels, one.scores[is_valid])


def print_detector_metrics(metrics: DetectorMetrics, console: Console) -> None:
    """Print scores, intervals, and which objects were evaluated."""
    data = metrics.data
    for name, reason in data["failed"].items():
        console.print(f"frame {name} could not be used: {reason}", soft_wrap=True, markup=False)
    table = Table(title=f"{data['detector']} on {data['dataset']}, %", title_justify="left")
    table.add_column("class")
    for title in (*coco.SCORE_TITLES, "objects"):
        table.add_column(title, justify="right")
    for name, scores in metrics.per_class.items():
        table.add_row(name, *map(format_percent, scores.columns), str(scores.objects))
    console.print(table)
    if metrics.conditions:
        sheet = tabulate_conditions(metrics.conditions)
        console.print(*sheet.fit_to_console(console, CONDITION_COLUMNS, min_width=console.width), sep="\n")
    for one in metrics.intervals:
        if one.low is not None and one.high is not None:
            ends = f"{format_percent(one.low)} to {format_percent(one.high)}"
            bounds = f"{ends} in 95 % of {data['bootstrap']} bootstrap draws of frames"
            console.print(f"{HEADLINE} {one.name} {format_percent(one.value)}, {bounds}", soft_wrap=True)
    console.print(
        f"{format_count(data['frames'], 'frame')}; evaluated: at least {data['min_height']:g} px high, occlusion "
        f"at most {data['max_occlusion']}, truncation at most {data['max_truncation']:g}; t* {data['t_star']:.3f}",
        soft_wrap=True,
    )


SURVEYED_FRAMES = 8
"""Frames with cars of which one must have a car that the detector finds."""
_LEGEND = (
    ("hit", TRUE_COLOUR),
    ("missed", LOST_COLOUR),
    ("false alarm", PHANTOM_COLOUR),
    ("ignored", IGNORED_COLOUR),
)
_LEGEND_PX = 22


def draw_mistakes(image: NDArray[np.uint8], marks: FrameMarks) -> NDArray[np.uint8]:
    """Draw hits, misses and false alarms into an image (H, W, 3) uint8, above a legend."""
    canvas = np.concatenate([image, np.full((_LEGEND_PX, image.shape[1], 3), 250, np.uint8)])
    labels = LabelLayout(
        (image.shape[1], image.shape[0]), [*marks.missed.tolist(), *marks.false_positives.tolist()]
    )
    for box in marks.ignored:
        _rectangle(canvas, box, IGNORED_COLOUR, 1)
    for box in marks.hits:
        _rectangle(canvas, box, DETECTED_COLOUR, 1)
    for box in marks.matched:
        _rectangle(canvas, box, TRUE_COLOUR, 1)
    for box in marks.missed:
        _rectangle(canvas, box, LOST_COLOUR, 2)
    for box, score in zip(marks.false_positives, marks.false_positive_scores, strict=True):
        _rectangle(canvas, box, PHANTOM_COLOUR, 2)
        labels.add(box.tolist(), TextLabel(f"{score:.2f}", PHANTOM_COLOUR))
    labels.draw(canvas)
    x = 6
    for name, colour in (*_LEGEND, ("found at", DETECTED_COLOUR)):
        y = image.shape[0] + _LEGEND_PX // 2
        cv2.rectangle(canvas, (x, y - 5), (x + 10, y + 5), colour, -1)
        _text(canvas, name, (x + 15, y + 4), (30, 30, 30))
        x += 110
    return canvas


def _rectangle(canvas: NDArray[np.uint8], box: Floats, colour: tuple[int, int, int], thickness: int) -> None:
    x0, y0, x1, y1 = (round(float(v)) for v in box)
    cv2.rectangle(canvas, (x0, y0), (x1, y1), colour, thickness, cv2.LINE_AA)


def _text(canvas: NDArray[np.uint8], text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, colour, 1, cv2.LINE_AA)
