"""What labels that stay behind make of an attack: how far they are from where the cars are, and which
counterexamples are failures only because of that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from detectors import boxes
from detectors.types import CLASSES
from drivesem.attack.targets import JudgedClasses
from drivesem.evaluation import failures
from drivesem.run.frame import as_detections, as_targets
from drivesem.run.results import FrameResult
from tools.experiments.detection.running import ArmRun

OVERLAPS = (0.5, 0.7)
"""IoU from which a detection meets a label: the paper's measure is silent; COCO's AP50, and KITTI's for cars."""
_QUANTILES = {"median": 0.5, "5 %": 0.05, "least": 0.0}


@dataclass(frozen=True, slots=True)
class LabelFailures:
    """A frame at one IoU. paper, moved: whether it fails by either labels; lost_paper: objects that are lost by
    the paper's, lost_only_unmoved: and not by moved ones.
    """

    paper: bool
    moved: bool
    lost_paper: int
    lost_only_unmoved: int


@dataclass(frozen=True, slots=True)
class FrameLabels:
    """One frame. iou: of the benign and the moved label of each object that neither ignores, by its index;
    mistakes: by each of OVERLAPS.
    """

    iou: Mapping[int, float]
    failures: Mapping[float, LabelFailures]


@dataclass(frozen=True, slots=True)
class CounterexampleCounts:
    """Counterexamples at one IoU. paper, moved: frames that fail by either labels; only_unmoved: by paper's and
    not by moved ones; lost_paper, lost_only_unmoved: the same of lost objects.
    """

    paper: int
    moved: int
    only_unmoved: int
    lost_paper: int
    lost_only_unmoved: int


@dataclass(frozen=True, slots=True)
class LabelComparison:
    """One arm. iou: quantiles of the overlap of both labels, over objects that neither ignores; below: share of
    them that overlap less than each of OVERLAPS; counted: by IoU.
    """

    name: str
    frames: int
    objects: int
    iou: dict[str, float | None]
    below: dict[float, float | None]
    counts: dict[float, CounterexampleCounts]

    def to_row(self) -> dict[str, Any]:
        """Numbers by name."""
        found: dict[str, Any] = {"name": self.name, "frames": self.frames, "objects": self.objects}
        found |= {f"iou_{name.replace(' ', '').replace('%', '_percent')}": v for name, v in self.iou.items()}
        for overlap in OVERLAPS:
            at, one = f"at_{overlap:g}", self.counts[overlap]
            found |= {
                f"below_{overlap:g}": self.below[overlap],
                f"counterexamples_paper_{at}": one.paper,
                f"counterexamples_moved_{at}": one.moved,
                f"only_unmoved_{at}": one.only_unmoved,
                f"lost_paper_{at}": one.lost_paper,
                f"lost_only_unmoved_{at}": one.lost_only_unmoved,
            }
        return found


def compare_frame_labels(run: ArmRun) -> tuple[FrameLabels, ...]:
    """Of an arm's frames, in their order."""
    return tuple(
        FrameLabels(_overlaps(result), {o: _mistakes(result, run.judged, run.summary.t_star, o) for o in OVERLAPS})
        for result in run.results
    )


def compare_labels(name: str, frames: Sequence[FrameLabels]) -> LabelComparison:
    """Both label sets of the arm of that name, and what each makes of its counterexamples."""
    found = np.array([iou for frame in frames for iou in frame.iou.values()])
    count = len(found)
    return LabelComparison(
        name=name,
        frames=len(frames),
        objects=count,
        iou={name: float(np.quantile(found, q)) if count else None for name, q in _QUANTILES.items()},
        below={overlap: float((found < overlap).mean()) if count else None for overlap in OVERLAPS},
        counts={overlap: _counted([frame.failures[overlap] for frame in frames]) for overlap in OVERLAPS},
    )


def _overlaps(result: FrameResult) -> dict[int, float]:
    """IoU of each object's benign and moved label, by its index, where neither is ignored."""
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


def _mistakes(result: FrameResult, judged: JudgedClasses, t_star: float, overlap: float) -> LabelFailures:
    benign = judged.targets(as_targets(result.targets_benign, CLASSES))
    before = as_detections(result.detections_rerendered, judged.names)
    after = as_detections(result.detections_attacked, judged.names)
    by_paper = failures.find(benign, before, benign, after, t_star, overlap)
    targets = judged.targets(as_targets(result.targets_moved, CLASSES))
    by_moved = failures.find(benign, before, targets, after, t_star, overlap)
    only = len(set(by_paper.lost) - set(by_moved.lost))
    return LabelFailures(by_paper.success, by_moved.success, len(by_paper.lost), only)


def _counted(frames: Sequence[LabelFailures]) -> CounterexampleCounts:
    return CounterexampleCounts(
        paper=sum(one.paper for one in frames),
        moved=sum(one.moved for one in frames),
        only_unmoved=sum(one.paper and not one.moved for one in frames),
        lost_paper=sum(one.lost_paper for one in frames),
        lost_only_unmoved=sum(one.lost_only_unmoved for one in frames),
    )
