"""How far objects move away from their benign labels, and which counterexamples exist only because of that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from detectors import boxes
from detectors.types import CLASSES
from drivesem.attacks.targets import EvaluatedClasses
from drivesem.evaluation import failures
from drivesem.run.frame import detections_from_records, targets_from_records
from drivesem.run.results import FrameResult
from tools.experiments.detection.arms import ArmRun

OVERLAPS = (0.5, 0.7)
"""IoU from which a detection meets a label: COCO's AP50, and KITTI's for cars; the paper does not state its own."""
_QUANTILES = {"median": 0.5, "5 %": 0.05, "least": 0.0}


@dataclass(frozen=True, slots=True)
class LabelFailures:
    """Failures of one frame at one IoU, by either set of labels."""

    paper: bool
    """Whether the frame fails by the benign labels."""
    moved: bool
    """Whether it fails by the moved labels."""
    lost_paper: int
    """Objects lost by the benign labels."""
    lost_only_unmoved: int
    """Objects lost by the benign labels and not by the moved ones."""


@dataclass(frozen=True, slots=True)
class FrameLabels:
    """Both sets of labels of one frame."""

    iou: Mapping[int, float]
    """IoU of the benign and the moved label by object index, where neither is ignored."""
    failures: Mapping[float, LabelFailures]
    """Failures by each of OVERLAPS."""


@dataclass(frozen=True, slots=True)
class CounterexampleCounts:
    """Counterexamples of an arm at one IoU, by either set of labels."""

    paper: int
    """Frames that fail by the benign labels."""
    moved: int
    """Frames that fail by the moved labels."""
    only_unmoved: int
    """Frames that fail by the benign labels and not by the moved ones."""
    lost_paper: int
    """Objects lost by the benign labels."""
    lost_only_unmoved: int
    """Objects lost by the benign labels and not by the moved ones."""


@dataclass(frozen=True, slots=True)
class LabelComparison:
    """Both sets of labels of an arm."""

    name: str
    """Name of the arm."""
    frames: int
    """Number of frames."""
    objects: int
    """Objects that neither set ignores."""
    iou: dict[str, float | None]
    """Quantiles by name of the IoU of both labels of an object."""
    below: dict[float, float | None]
    """Share of objects with an IoU below each of OVERLAPS."""
    counts: dict[float, CounterexampleCounts]
    """Counterexamples by each of OVERLAPS."""

    def to_row(self) -> dict[str, Any]:
        """Numbers by name, for CSV and JSON."""
        row: dict[str, Any] = {"name": self.name, "frames": self.frames, "objects": self.objects}
        row |= {f"iou_{name.replace(' ', '').replace('%', '_percent')}": v for name, v in self.iou.items()}
        for overlap in OVERLAPS:
            at, counts = f"at_{overlap:g}", self.counts[overlap]
            row |= {
                f"below_{overlap:g}": self.below[overlap],
                f"counterexamples_paper_{at}": counts.paper,
                f"counterexamples_moved_{at}": counts.moved,
                f"only_unmoved_{at}": counts.only_unmoved,
                f"lost_paper_{at}": counts.lost_paper,
                f"lost_only_unmoved_{at}": counts.lost_only_unmoved,
            }
        return row


def compare_frame_labels(run: ArmRun) -> tuple[FrameLabels, ...]:
    """Compare both sets of labels in each frame of a run."""
    return tuple(
        FrameLabels(
            _label_overlaps(result),
            {iou: _count_failures(result, run.judged, run.summary.t_star, iou) for iou in OVERLAPS},
        )
        for result in run.results
    )


def compare_labels(name: str, frames: Sequence[FrameLabels]) -> LabelComparison:
    """Summarise the frames of the arm called `name`."""
    ious = np.array([iou for frame in frames for iou in frame.iou.values()])
    count = len(ious)
    return LabelComparison(
        name=name,
        frames=len(frames),
        objects=count,
        iou={name: float(np.quantile(ious, q)) if count else None for name, q in _QUANTILES.items()},
        below={overlap: float((ious < overlap).mean()) if count else None for overlap in OVERLAPS},
        counts={overlap: _sum_failures([frame.failures[overlap] for frame in frames]) for overlap in OVERLAPS},
    )


def _label_overlaps(result: FrameResult) -> dict[int, float]:
    moved = {box.index: box for box in result.targets_moved if box.index is not None and not box.ignore}
    pairs = {
        box.index: (box.xyxy, moved[box.index].xyxy)
        for box in result.targets_benign
        if box.index is not None and box.index in moved and not box.ignore
    }
    if not pairs:
        return {}
    before, after = (torch.tensor(side, dtype=torch.float64) for side in zip(*pairs.values(), strict=True))
    return dict(zip(pairs, boxes.iou_matrix(before, after).diagonal().tolist(), strict=True))


def _count_failures(result: FrameResult, judged: EvaluatedClasses, t_star: float, overlap: float) -> LabelFailures:
    benign = judged.map_targets(targets_from_records(result.targets_benign, CLASSES))
    moved = judged.map_targets(targets_from_records(result.targets_moved, CLASSES))
    before = detections_from_records(result.detections_rerendered, judged.names)
    after = detections_from_records(result.detections_attacked, judged.names)
    by_paper = failures.find_failures(benign, before, benign, after, t_star, overlap)
    by_moved = failures.find_failures(benign, before, moved, after, t_star, overlap)
    only_unmoved = len(set(by_paper.lost) - set(by_moved.lost))
    return LabelFailures(by_paper.success, by_moved.success, len(by_paper.lost), only_unmoved)


def _sum_failures(frames: Sequence[LabelFailures]) -> CounterexampleCounts:
    return CounterexampleCounts(
        paper=sum(one.paper for one in frames),
        moved=sum(one.moved for one in frames),
        only_unmoved=sum(one.paper and not one.moved for one in frames),
        lost_paper=sum(one.lost_paper for one in frames),
        lost_only_unmoved=sum(one.lost_only_unmoved for one in frames),
    )
