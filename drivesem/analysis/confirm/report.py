"""What survives the second renderer, for people and programs: tables, Markdown, CSV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from detectors.types import CLASSES
from drivesem.analysis.confirm.results import Confirmed
from drivesem.attack.judging import HEADLINE, JudgedClasses
from drivesem.evaluation import coco
from drivesem.evaluation.resampling import wilson
from drivesem.report.answer import Answer
from drivesem.report.tables import Sheet, percent
from drivesem.run.frame import as_detections, as_targets
from drivesem.run.results import FrameResult

SURVIVE, SAME, LOST, PHANTOMS, NEW = (
    "frames",
    "frames, same failure",
    "lost",
    "phantoms",
    "frames, second only",
)
"""Of the frames that fail in the compositor's picture: those that fail in the second renderer's, by any failure or
by one that both have. The same of lost vehicles and of phantoms, one by one. Of the frames that do not fail in the
compositor's: those that do in the second renderer's."""

_OVERLAP = ("mean", "least", "boxes")


@dataclass(frozen=True, slots=True)
class Share:
    """`survive` of `failures`, and Wilson's 95 % interval; None where there is no failure."""

    name: str
    failures: int
    survive: int
    share: float | None
    low: float | None
    high: float | None

    @classmethod
    def of(cls, name: str, outcomes: Sequence[bool]) -> Share:
        """Of outcomes, one a failure: whether it survives."""
        count, hits = len(outcomes), sum(outcomes)
        low, high = wilson(hits, count) if count else (None, None)
        return cls(name, count, hits, hits / count if count else None, low, high)


@dataclass(frozen=True, slots=True)
class Confirmation:
    """frames: those whose change was carried over whole, on which all figures rest; left: reasons by frame, of the
    others. scores: by picture, with the labels it is judged by. overlap: mean and least IoU of judged vehicles'
    boxes in both pictures, and how many; None where there is none.
    """

    frames: int
    left: dict[str, list[str]]
    shares: tuple[Share, ...]
    scores: dict[str, coco.Scores]
    overlap: tuple[float, float, int] | None

    def to_json(self) -> dict[str, Any]:
        """Numbers by name; fractions of 1."""
        return {
            "frames": self.frames,
            "not_carried": self.left,
            "survive": self.shares[0].share,
            "rows": [
                {name: getattr(share, name) for name in ("name", "failures", "survive", "share", "low", "high")}
                for share in self.shares
            ],
            "scores": {name: scores.to_json() for name, scores in self.scores.items()},
            "box_iou": None if self.overlap is None else dict(zip(_OVERLAP, self.overlap, strict=True)),
        }


def summarise(
    found: Sequence[Confirmed], results: Sequence[FrameResult], names: tuple[str, ...], t_star: float
) -> Confirmation:
    """The figures of confirmed frames. results: of the run, of the same frames; names: the judged classes."""
    pairs = [(one, result) for one, result in zip(found, results, strict=True) if not one.not_carried]
    whole = [one for one, _ in pairs]
    failed = [one for one in whole if one.compositor]

    def survival(kind: str) -> list[bool]:
        return [f.survives for one in failed for f in one.compositor if f.kind == kind]

    shares = (
        Share.of(SURVIVE, [bool(one.second) for one in failed]),
        Share.of(SAME, [any(f.survives for f in one.compositor) for one in failed]),
        Share.of(LOST, survival("lost")),
        Share.of(PHANTOMS, survival("phantom")),
        Share.of(NEW, [bool(one.second) for one in whole if not one.compositor]),
    )
    ious = [s.iou for one in whole for s in one.stands if s.judged and s.iou is not None]
    return Confirmation(
        frames=len(whole),
        left={one.identifier: list(one.not_carried) for one in found if one.not_carried},
        shares=shares,
        scores=_scores(pairs, names, t_star),
        overlap=(sum(ious) / len(ious), min(ious), len(ious)) if ious else None,
    )


def _scores(
    pairs: Sequence[tuple[Confirmed, FrameResult]], names: tuple[str, ...], t_star: float
) -> dict[str, coco.Scores]:
    columns = {
        "photograph": [(r.targets_benign, r.detections_benign) for _, r in pairs],
        "second renderer, unchanged": [(c.targets_benign, c.detections_benign) for c, _ in pairs],
        "compositor": [(r.targets_moved, r.detections_attacked) for _, r in pairs],
        "second renderer": [(c.targets_changed, c.detections_changed) for c, _ in pairs],
    }
    if not pairs:
        return {}
    judged = JudgedClasses(names, names)
    return {
        name: coco.evaluate(
            [judged.targets(as_targets(targets, CLASSES)) for targets, _ in column],
            [as_detections(detections, names) for _, detections in column],
            names,
            t_star,
            HEADLINE,
        )
        for name, column in columns.items()
    }


def sheets(report: Confirmation) -> list[Sheet]:
    """Two tables, %: what survives; precision and recall in either picture."""
    shares = tuple(
        (s.name, str(s.failures), str(s.survive), percent(s.share), f"{percent(s.low)} to {percent(s.high)}")
        for s in report.shares
    )
    figures = [(name, *map(percent, scores.headline.shown)) for name, scores in report.scores.items()]
    return [
        Sheet("failures that survive, %", ("figure", "failures", "survive", "share", "95 %"), shares),
        Sheet(f"{HEADLINE}, %", ("picture", *coco.SCORE_TITLES), tuple(figures)),
    ]


def notes(report: Confirmation) -> list[str]:
    """What the figures mean, and what they leave out."""
    told = [
        "Survive: the detector fails in the second renderer's picture of the same change too, by its own labels. "
        "Frames: by any failure, or by one that both have; lost: the same vehicle; phantoms: one of the class at "
        "an IoU of at least 0.5. Second only: of the frames that do not fail in the compositor's picture, those "
        "that do in the second renderer's. Intervals: Wilson.",
    ]
    if report.overlap is not None:
        mean, least, count = report.overlap
        told.append(
            f"Boxes of {count} judged vehicles in both pictures: IoU {mean:.3f} in the mean, {least:.3f} at least."
        )
    told += [f"Frame {name} is not counted: {'; '.join(why)}." for name, why in report.left.items()]
    return told


def answer_of(
    out: Path,
    report: Confirmation,
    confirmed: Sequence[Confirmed],
    facts: Mapping[str, Any],
    failed: Mapping[str, str],
) -> Answer:
    """confirm.json (with `facts` in front), confirm.md, and confirm.csv, a line a frame."""
    return Answer(
        out=out,
        name="confirm",
        heading="The second renderer",
        data={**facts, **report.to_json(), "frames_failed": failed},
        tables={"confirm": [_row(frame) for frame in confirmed]},
        sheets=sheets(report),
        notes=notes(report),
        failed={f"frame {name}": reason for name, reason in failed.items()},
    )


def _row(one: Confirmed) -> dict[str, Any]:
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
    ious = [s.iou for s in one.stands if s.judged and s.iou is not None]
    return row | {
        "vehicles": len(one.stands),
        "judged": len(ious),
        "box_iou": round(sum(ious) / len(ious), 4) if ious else None,
        "box_iou_least": round(min(ious), 4) if ious else None,
        "not_carried": "; ".join(one.not_carried),
    }
