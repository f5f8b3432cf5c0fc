"""A detector's precision and recall on a data set's photographs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.table import Table

from detectors.base import DetectorError, Predictor
from detectors.registry import load_predictor
from detectors.types import Detections
from drivesem.analysis.evaluate.files import MANY_FRAMES
from drivesem.attack.labels import Difficulty
from drivesem.attack.targets import HEADLINE, EvaluatedClasses, resolve_t_star
from drivesem.config.commands import EvalConfig
from drivesem.config.errors import UsageError
from drivesem.data.registry import Dataset, open_dataset
from drivesem.evaluation import coco
from drivesem.evaluation.instances import Floats
from drivesem.evaluation.matched_class import FrameMarks, MatchedClass
from drivesem.evaluation.resampling import DRAWS, Interval
from drivesem.report.drawing import (
    DETECTED_COLOUR,
    IGNORED_COLOUR,
    LOST_COLOUR,
    PHANTOM_COLOUR,
    TRUE_COLOUR,
    LabelLayout,
    TextLabel,
)
from drivesem.report.tables import format_count, format_percent
from drivesem.report.terminal import Console
from drivesem.run.detection_cache import detect_objects
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.training.frames import adapt_limits, evaluation_targets
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.io import to_uint8
from scene_ir.types import Labels


@dataclass(frozen=True, slots=True)
class DetectorMetrics:
    """What a detector sees of a data set. data: the JSON; intervals: of the headline's class."""

    data: dict[str, Any]
    per_class: Mapping[str, coco.ClassScores]
    intervals: Sequence[Interval]


def evaluate_detector(config: EvalConfig) -> DetectorMetrics:
    """Run the detector over the frames, count, and write what is asked for. UsageError or SceneError for bad
    input.
    """
    dataset = open_dataset(config.dataset, config.root or "")
    detector = _detector(config)
    names = dataset.identifiers[: config.limit]
    looker, build = _Looker(config, dataset, detector), partial(_Looker, config)
    looked = run_frame_jobs(names, looker, build, config, ProgressSettings("frames", keep=False))
    names = [name for name in names if name in looked.results]
    if not names:
        raise UsageError("--root", "frames that can be used", "none")
    found, labels = [looked.results[name][0] for name in names], [looked.results[name][1] for name in names]
    t_star = resolve_t_star(detector)
    judged = EvaluatedClasses.from_detector(detector).names
    limits = adapt_limits(Difficulty(config.min_height, config.max_occlusion, config.max_truncation), labels)
    targets = [evaluation_targets(one, limits, judged) for one in labels]
    scores = coco.evaluate(targets, found, judged, t_star, HEADLINE)
    outcome = MatchedClass.from_frames(targets, found, judged.index(HEADLINE))
    draws = config.bootstrap
    if draws is None:
        draws = 0 if len(names) > MANY_FRAMES else DRAWS
    spread = outcome.intervals(draws, config.seed) if draws else []
    data: dict[str, Any] = {
        "detector": config.detector,
        "dataset": config.dataset,
        "frames": len(names),
        "failed": dict(sorted(looked.failed.items())),
        "headline": HEADLINE,
        "t_star": t_star,
        "min_height": config.min_height,
        "max_occlusion": config.max_occlusion,
        "max_truncation": config.max_truncation,
        "tiles": config.tiles,
        **scores.to_json(),
        "bootstrap": draws,
        "intervals": [asdict(one) for one in spread],
    }
    if config.out is not None:
        _write(Path(config.out), data, names, found, judged)
        if config.pictures:
            _draw(config, dataset, names, outcome, t_star)
    return DetectorMetrics(data, scores.per_class, spread)


def _draw(
    config: EvalConfig, dataset: Dataset, names: Sequence[str], outcome: MatchedClass, t_star: float
) -> None:
    """The frames with most mistakes, worst first."""
    marks = [outcome.frame_marks(frame, t_star) for frame in range(len(names))]
    worst = sorted(range(len(names)), key=lambda i: (-marks[i].error_count, i))
    for rank, frame in enumerate(worst[: config.pictures], start=1):
        picture = draw_mistakes(to_uint8(dataset.frame(names[frame]).photograph), marks[frame])
        name = names[frame].replace("/", "_")
        files.write_png(Path(config.out or "") / "pictures" / f"{rank:03d}-{name}.png", picture)


def _detector(config: EvalConfig) -> Predictor:
    try:
        detector = load_predictor(config.detector or "", config.device, config.tiles)
        EvaluatedClasses.from_detector(detector)
    except DetectorError as error:
        raise UsageError.from_detector_error("--detector", "a detector", error) from error
    return detector


class _Looker:
    """What one process needs: built once, used for many frames."""

    def __init__(
        self, config: EvalConfig, dataset: Dataset | None = None, detector: Predictor | None = None
    ) -> None:
        self._dataset = dataset or open_dataset(config.dataset, config.root or "")
        self._detector = detector or _detector(config)
        self._device = config.device

    def __call__(self, name: str) -> tuple[Detections, Labels]:
        """What is found in a frame, and its labels. Raises FormatError for a frame without."""
        frame = self._dataset.frame(name)
        if frame.labels is None:
            raise FormatError(f"frame {name}", "labels", "none")
        return detect_objects(self._detector, frame.photograph.to(self._device)), frame.labels


def _write(
    out: Path, data: Mapping[str, Any], names: Sequence[str], found: Sequence[Detections], judged: Sequence[str]
) -> None:
    """metrics.json, and the detections as KITTI's results, which drivesem eval --pred reads."""
    from drivesem.data.kitti import write_labels

    files.write_json(out / "metrics.json", data)
    for name, one in zip(names, found, strict=True):
        # a box without an area meets nothing, and one that ends before it begins would not be read
        kept = ((one.boxes_xyxy[:, 2:] - one.boxes_xyxy[:, :2]) >= 0.01).all(dim=1)
        n = int(kept.sum())
        unknown = torch.full((n, 3), torch.nan)
        labels = Labels(
            kind=tuple(judged[int(k)] for k in one.labels[kept]),
            boxes_xyxy=one.boxes_xyxy[kept],
            truncation=unknown[:, 0],
            occlusion=torch.full((n,), 3, dtype=torch.int64),
            translation=unknown,
            yaw=unknown[:, 0],
            size_lhw=unknown,
            ignore_xyxy=torch.zeros(0, 4),
        )
        path = out / "detections" / f"{name.replace('/', '_')}.txt"
        write_labels(path, labels, one.scores[kept])


def print_detector_metrics(figures: DetectorMetrics, console: Console) -> None:
    """The table, the intervals, and who was judged."""
    data = figures.data
    for name, reason in data["failed"].items():
        console.print(f"frame {name} could not be used: {reason}", soft_wrap=True, markup=False)
    table = Table(title=f"{data['detector']} on {data['dataset']}, %", title_justify="left")
    table.add_column("class")
    for title in (*coco.SCORE_TITLES, "objects"):
        table.add_column(title, justify="right")
    for name, scores in figures.per_class.items():
        table.add_row(name, *map(format_percent, scores.columns), str(scores.objects))
    console.print(table)
    for one in figures.intervals:
        if one.low is not None and one.high is not None:
            bounds = f"{format_percent(one.low)} to {format_percent(one.high)} in 95 % of {data['bootstrap']} draws of frames"
            console.print(f"{HEADLINE} {one.name} {format_percent(one.value)}, {bounds}", soft_wrap=True)
    console.print(
        f"{format_count(data['frames'], 'frame')}; judged: at least {data['min_height']:g} px high, occlusion "
        f"at most {data['max_occlusion']}, truncation at most {data['max_truncation']:g}; t* {data['t_star']:.3f}",
        soft_wrap=True,
    )


_LEGEND = (
    ("hit", TRUE_COLOUR),
    ("missed", LOST_COLOUR),
    ("false alarm", PHANTOM_COLOUR),
    ("ignored", IGNORED_COLOUR),
)
_LEGEND_PX = 22


def draw_mistakes(image: NDArray[np.uint8], marks: FrameMarks) -> NDArray[np.uint8]:
    """The image (H, W, 3) uint8 RGB with its marks, and a line below that names their colours."""
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
