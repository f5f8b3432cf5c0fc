"""Reports which failures survive a second renderer: tables, Markdown, CSV, and a sheet of pictures per frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from detectors.types import CLASSES
from drivesem.analysis.confirm.comparison import ConfirmedFrame, RendererFailure
from drivesem.attack.targets import HEADLINE, EvaluatedClasses
from drivesem.evaluation import coco
from drivesem.evaluation.resampling import wilson
from drivesem.report.drawing import MARGIN_PX, PAPER_COLOUR, TEXT_PX, measure_text, paste, write_text
from drivesem.report.tables import AnalysisReport, ReportTable, format_count, format_percent
from drivesem.run.finished import RunFrame
from drivesem.run.frame import detections_from_records, targets_from_records
from drivesem.run.report.pictures import draw_overlay
from drivesem.run.results import BoxRecord, Failure, FrameResult
from scene_ir import files

SURVIVE, SAME, LOST, PHANTOMS, NEW = (
    "frames",
    "frames, same failure",
    "lost",
    "phantoms",
    "frames, second only",
)
"""Names of the survival rates: of frames that fail in the compositor's picture, those that fail in the second
renderer's, by any failure or by the same one; of lost vehicles and of phantoms, those that do; of frames that do
not fail in the compositor's picture, those that fail in the second renderer's."""

_OVERLAP = ("mean", "least", "boxes")
_MAX_ENLARGED = 3
"""Vehicles that are shown enlarged, lost ones first."""
_CONTEXT = 0.35
"""Context around an enlarged vehicle, as a share of the longer side of its box."""
_LINE_PX = TEXT_PX + 8


@dataclass(frozen=True, slots=True)
class SurvivalRate:
    """Share of failures that survive, with its 95 % Wilson interval."""

    name: str
    """What is counted: SURVIVE, SAME, LOST, PHANTOMS or NEW."""
    failures: int
    """Number of failures."""
    survive: int
    """Number of those that survive."""
    share: float | None
    """`survive` / `failures`; None without a failure."""
    low: float | None
    """Lower end of the interval."""
    high: float | None
    """Upper end."""

    @classmethod
    def from_outcomes(cls, name: str, outcomes: Sequence[bool]) -> SurvivalRate:
        """Count outcomes, one per failure: whether it survives."""
        count, hits = len(outcomes), sum(outcomes)
        low, high = wilson(hits, count) if count else (None, None)
        return cls(name, count, hits, hits / count if count else None, low, high)


@dataclass(frozen=True, slots=True)
class Confirmation:
    """Survival of a run's failures before a second renderer, over the frames that it can render completely."""

    frames: int
    """Number of these frames."""
    not_carried: dict[str, list[str]]
    """Parts of the change that the second renderer lacks, by frame that is left out."""
    shares: tuple[SurvivalRate, ...]
    """Survival rates."""
    scores: dict[str, coco.CocoScores]
    """Scores by picture, each by its own labels."""
    overlap: tuple[float, float, int] | None
    """Mean and least IoU of vehicles' boxes in both pictures, and their number; None without any."""

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object; rates are fractions."""
        return {
            "frames": self.frames,
            "not_carried": self.not_carried,
            "survive": self.shares[0].share,
            "rows": [
                {name: getattr(share, name) for name in ("name", "failures", "survive", "share", "low", "high")}
                for share in self.shares
            ],
            "scores": {name: scores.to_json() for name, scores in self.scores.items()},
            "box_iou": None if self.overlap is None else dict(zip(_OVERLAP, self.overlap, strict=True)),
        }


def summarise_confirmation(
    confirmed: Sequence[ConfirmedFrame], results: Sequence[FrameResult], classes: tuple[str, ...], t_star: float
) -> Confirmation:
    """Compute survival rates and scores.

    Args:
        confirmed: Re-rendered frames.
        results: The run's results of the same frames.
        classes: Evaluated classes.
        t_star: Score from which a detection counts.
    """
    pairs = [(one, result) for one, result in zip(confirmed, results, strict=True) if not one.not_carried]
    whole = [one for one, _ in pairs]
    failed = [one for one in whole if one.compositor]

    def outcomes(kind: str) -> list[bool]:
        return [f.survives for one in failed for f in one.compositor if f.kind == kind]

    shares = (
        SurvivalRate.from_outcomes(SURVIVE, [bool(one.second) for one in failed]),
        SurvivalRate.from_outcomes(SAME, [any(f.survives for f in one.compositor) for one in failed]),
        SurvivalRate.from_outcomes(LOST, outcomes("lost")),
        SurvivalRate.from_outcomes(PHANTOMS, outcomes("phantom")),
        SurvivalRate.from_outcomes(NEW, [bool(one.second) for one in whole if not one.compositor]),
    )
    ious = [s.iou for one in whole for s in one.objects if s.judged and s.iou is not None]
    return Confirmation(
        frames=len(whole),
        not_carried={one.identifier: list(one.not_carried) for one in confirmed if one.not_carried},
        shares=shares,
        scores=_compute_scores(pairs, classes, t_star),
        overlap=(sum(ious) / len(ious), min(ious), len(ious)) if ious else None,
    )


def _compute_scores(
    pairs: Sequence[tuple[ConfirmedFrame, FrameResult]], names: tuple[str, ...], t_star: float
) -> dict[str, coco.CocoScores]:
    columns = {
        "photograph": [(r.targets_benign, r.detections_benign) for _, r in pairs],
        "second renderer, unchanged": [(c.targets_benign, c.detections_benign) for c, _ in pairs],
        "compositor": [(r.targets_moved, r.detections_attacked) for _, r in pairs],
        "second renderer": [(c.targets_changed, c.detections_changed) for c, _ in pairs],
    }
    if not pairs:
        return {}
    judged = EvaluatedClasses(names, names)
    return {
        name: coco.evaluate(
            [judged.map_targets(targets_from_records(targets, CLASSES)) for targets, _ in column],
            [detections_from_records(detections, names) for _, detections in column],
            names,
            t_star,
            HEADLINE,
        )
        for name, column in columns.items()
    }


def build_confirm_tables(report: Confirmation) -> list[ReportTable]:
    """Build the tables of survival rates, and of precision and recall by picture."""
    shares = tuple(
        (
            s.name,
            str(s.failures),
            str(s.survive),
            format_percent(s.share),
            f"{format_percent(s.low)} to {format_percent(s.high)}",
        )
        for s in report.shares
    )
    scores = [(name, *map(format_percent, scores.headline.columns)) for name, scores in report.scores.items()]
    return [
        ReportTable("failures that survive, %", ("figure", "failures", "survive", "share", "95 %"), shares),
        ReportTable(f"{HEADLINE}, %", ("picture", *coco.SCORE_TITLES), tuple(scores)),
    ]


def build_confirm_notes(report: Confirmation) -> list[str]:
    """Explain the rates, and list what they leave out."""
    notes = [
        "Survive: the detector also fails in the second renderer's picture of the same change, by that picture's "
        "labels. Frames: by any failure, or by the same one; lost: the same vehicle; phantoms: one of the same "
        "class at an IoU of at least 0.5. Second only: of the frames that do not fail in the compositor's "
        "picture, those that fail in the second renderer's. Intervals: Wilson, 95 %.",
    ]
    if report.overlap is not None:
        mean, least, count = report.overlap
        notes.append(f"IoU of the boxes of {count} vehicles in both pictures: mean {mean:.3f}, least {least:.3f}.")
    notes += [f"Frame {name} is not counted: {'; '.join(why)}." for name, why in report.not_carried.items()]
    return notes


def build_confirm_report(
    out: Path,
    report: Confirmation,
    confirmed: Sequence[ConfirmedFrame],
    facts: Mapping[str, Any],
    failed: Mapping[str, str],
) -> AnalysisReport:
    """Build the report.

    Args:
        out: Output folder.
        report: Survival rates and scores.
        confirmed: Re-rendered frames.
        facts: First entries of the JSON.
        failed: Reasons by frame that could not be re-rendered.
    """
    return AnalysisReport(
        out=out,
        name="confirm",
        heading="The second renderer",
        data={**facts, **report.to_json(), "frames_failed": failed},
        csv_tables={"confirm": [_csv_row(frame) for frame in confirmed]},
        tables=build_confirm_tables(report),
        notes=build_confirm_notes(report),
        failed={f"frame {name}": reason for name, reason in failed.items()},
    )


def _csv_row(one: ConfirmedFrame) -> dict[str, Any]:
    row: dict[str, Any] = {
        "frame": one.identifier,
        "second": one.renderer,
        "fails_compositor": bool(one.compositor),
        "fails_second": bool(one.second),
        "survives": bool(one.compositor and one.second),
    }
    for kind, title in (("lost", "lost"), ("phantom", "phantoms")):
        ours = [f for f in one.compositor if f.kind == kind]
        row |= {
            f"{title}_compositor": len(ours),
            f"{title}_second": sum(f.kind == kind for f in one.second),
            f"{title}_both": sum(f.survives for f in ours),
        }
    ious = [s.iou for s in one.objects if s.judged and s.iou is not None]
    return row | {
        "vehicles": len(one.objects),
        "judged": len(ious),
        "box_iou": round(sum(ious) / len(ious), 4) if ious else None,
        "box_iou_least": round(min(ious), 4) if ious else None,
        "not_carried": "; ".join(one.not_carried),
    }


def draw_confirm_sheet(frame: RunFrame, confirmed: ConfirmedFrame, image: np.ndarray, t_star: float) -> np.ndarray:
    """Draw both renderers' pictures of a frame on one sheet, with failures enlarged.

    Args:
        frame: The run's frame.
        confirmed: Its failures before both renderers.
        image: The second renderer's picture of the change (H, W, 3) uint8.
        t_star: Score from which a detection counts.

    Returns:
        The sheet (h, w, 3) uint8.
    """
    composed = files.read_image(frame.pictures["attacked"])
    result = frame.result
    composed_overlay = _draw_failures(
        composed, result.targets_moved, result.detections_attacked, confirmed.compositor, t_star
    )
    second_overlay = _draw_failures(
        image, confirmed.targets_changed, confirmed.detections_changed, confirmed.second, t_star
    )
    titles = (
        f"{confirmed.identifier}, compositor: {_describe_failures(confirmed.compositor)}",
        f"{confirmed.identifier}, {confirmed.renderer}: {_describe_failures(confirmed.second)}",
    )
    names = ("compositor", confirmed.renderer)
    strip = _draw_enlarged(
        names, (composed, image), _choose_boxes(confirmed, result.targets_moved), composed.shape[1]
    )
    height, width = composed.shape[:2]
    canvas = np.empty(
        (2 * (height + _LINE_PX) + strip.shape[0] + 4 * MARGIN_PX, width + 2 * MARGIN_PX, 3), np.uint8
    )
    canvas[:] = PAPER_COLOUR
    y = MARGIN_PX
    for title, picture in zip(titles, (composed_overlay, second_overlay), strict=True):
        write_text(canvas, (MARGIN_PX, y), title)
        paste(canvas, (MARGIN_PX, y + _LINE_PX), picture)
        y += _LINE_PX + height + MARGIN_PX
    paste(canvas, (MARGIN_PX, y), strip)
    return canvas


def _draw_failures(
    image: np.ndarray,
    targets: Sequence[BoxRecord],
    detections: Sequence[BoxRecord],
    failures: Sequence[RendererFailure],
    t_star: float,
) -> np.ndarray:
    # ignored regions, which the targets hold once per class, are left out
    objects = tuple(t for t in targets if t.index is not None)
    failed = tuple(Failure(f.kind, f.label, f.xyxy, score=f.score) for f in failures)
    return draw_overlay(image, objects, tuple(detections), failed, t_star)


def _describe_failures(failures: Sequence[RendererFailure]) -> str:
    if not failures:
        return "no failure"
    lost = sum(f.kind == "lost" for f in failures)
    phantoms = format_count(len(failures) - lost, "phantom")
    return f"{lost} lost, {phantoms}; {sum(f.survives for f in failures)} in both pictures"


def _choose_boxes(confirmed: ConfirmedFrame, moved: Sequence[BoxRecord]) -> list[tuple[float, ...]]:
    """Choose the boxes to enlarge: failures, then the largest vehicles that count."""
    boxes: list[tuple[float, ...]] = [f.xyxy for f in (*confirmed.compositor, *confirmed.second)]
    cars = sorted((t for t in moved if t.index is not None and not t.ignore), key=lambda t: t.xyxy[1] - t.xyxy[3])
    for box in (t.xyxy for t in cars):
        if all(abs(box[0] - p[0]) + abs(box[1] - p[1]) > 8 for p in boxes):
            boxes.append(box)
    return boxes[:_MAX_ENLARGED]


def _draw_enlarged(
    names: tuple[str, str],
    pictures: tuple[np.ndarray, np.ndarray],
    boxes: Sequence[tuple[float, ...]],
    width: int,
) -> np.ndarray:
    """Draw pairs of enlarged crops side by side in `width` px, the compositor's on the left."""
    cell = (width - (2 * _MAX_ENLARGED - 1) * MARGIN_PX) // (2 * _MAX_ENLARGED)
    strip = np.empty((cell + _LINE_PX if boxes else 0, width, 3), np.uint8)
    strip[:] = PAPER_COLOUR
    for column, box in enumerate(boxes):
        for side, picture in enumerate(pictures):
            x = (2 * column + side) * (cell + MARGIN_PX)
            paste(
                strip,
                (x, _LINE_PX),
                cv2.resize(_crop_square(picture, box), (cell, cell), interpolation=cv2.INTER_CUBIC),
            )
            title = names[side]
            if measure_text(title, TEXT_PX)[0] <= cell:
                write_text(strip, (x, 0), title)
    return strip


def _crop_square(picture: np.ndarray, box: Sequence[float]) -> np.ndarray:
    """Crop a square around a box, shifted into the picture."""
    x0, y0, x1, y1 = box
    side = round(max(x1 - x0, y1 - y0, 16.0) * (1 + 2 * _CONTEXT))
    side = min(side, *picture.shape[:2])
    left = int(np.clip(round((x0 + x1 - side) / 2), 0, picture.shape[1] - side))
    top = int(np.clip(round((y0 + y1 - side) / 2), 0, picture.shape[0] - side))
    return picture[top : top + side, left : left + side]
