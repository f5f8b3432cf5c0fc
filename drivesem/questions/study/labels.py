"""What labels that stay behind make of an attack: how far they are from where the cars are, and which
counterexamples are failures only because of that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from detectors import boxes
from detectors.types import CLASSES
from drivesem.attack.judging import JudgedClasses
from drivesem.evaluation import failures
from drivesem.questions.study.running import ArmRun
from drivesem.run.frame import as_detections, as_targets
from drivesem.run.results import FrameResult

OVERLAPS = (0.5, 0.7)
"""IoU from which a detection meets a label: the paper's measure is silent; COCO's AP50, and KITTI's for cars."""
_QUANTILES = {"median": 0.5, "5 %": 0.05, "least": 0.0}


@dataclass(frozen=True, slots=True)
class Counted:
    """Counterexamples at one IoU. paper, moved: frames that fail by either labels; only_unmoved: by paper's and
    not by moved ones; lost_paper, lost_only_unmoved: the same of lost objects.
    """

    paper: int
    moved: int
    only_unmoved: int
    lost_paper: int
    lost_only_unmoved: int


@dataclass(frozen=True, slots=True)
class LabelSets:
    """One arm. iou: quantiles of the overlap of both labels, over objects that neither ignores; below: share of
    them that overlap less than each of OVERLAPS; counted: by IoU.
    """

    name: str
    frames: int
    objects: int
    iou: dict[str, float | None]
    below: dict[float, float | None]
    counted: dict[float, Counted]

    def flat(self) -> dict[str, Any]:
        """Numbers by name."""
        found: dict[str, Any] = {"name": self.name, "frames": self.frames, "objects": self.objects}
        found |= {f"iou_{name.replace(' ', '').replace('%', '_percent')}": v for name, v in self.iou.items()}
        for overlap in OVERLAPS:
            at, one = f"at_{overlap:g}", self.counted[overlap]
            found |= {
                f"below_{overlap:g}": self.below[overlap],
                f"counterexamples_paper_{at}": one.paper,
                f"counterexamples_moved_{at}": one.moved,
                f"only_unmoved_{at}": one.only_unmoved,
                f"lost_paper_{at}": one.lost_paper,
                f"lost_only_unmoved_{at}": one.lost_only_unmoved,
            }
        return found


def label_sets(run: ArmRun) -> LabelSets:
    """Both label sets of an arm's frames, and what each makes of its counterexamples."""
    found = _overlaps(run.results)
    count = len(found)
    return LabelSets(
        name=run.arm.name,
        frames=len(run.results),
        objects=count,
        iou={name: float(np.quantile(found, q)) if count else None for name, q in _QUANTILES.items()},
        below={overlap: float((found < overlap).mean()) if count else None for overlap in OVERLAPS},
        counted={o: _counted(run.results, run.judged, run.summary.t_star, o) for o in OVERLAPS},
    )


def _overlaps(results: Sequence[FrameResult]) -> np.ndarray:
    """IoU (N,) of each object's benign and moved label."""
    found: list[float] = []
    for result in results:
        moved = {box.index: box for box in result.targets_moved if box.index is not None and not box.ignore}
        pairs = [
            (box.xyxy, moved[box.index].xyxy)
            for box in result.targets_benign
            if box.index in moved and not box.ignore
        ]
        if pairs:
            before, after = (torch.tensor(side, dtype=torch.float64) for side in zip(*pairs, strict=True))
            found += boxes.iou_matrix(before, after).diagonal().tolist()
    return np.array(found)


def _counted(results: Sequence[FrameResult], judged: JudgedClasses, t_star: float, overlap: float) -> Counted:
    paper = moved = only = lost_paper = lost_only = 0
    for result in results:
        benign = judged.targets(as_targets(result.targets_benign, CLASSES))
        before = as_detections(result.detections_rerendered, judged.names)
        after = as_detections(result.detections_attacked, judged.names)
        by_paper = failures.find(benign, before, benign, after, t_star, overlap)
        targets = judged.targets(as_targets(result.targets_moved, CLASSES))
        by_moved = failures.find(benign, before, targets, after, t_star, overlap)
        paper += by_paper.success
        moved += by_moved.success
        only += by_paper.success and not by_moved.success
        lost_paper += len(by_paper.lost)
        lost_only += len(set(by_paper.lost) - set(by_moved.lost))
    return Counted(paper, moved, only, lost_paper, lost_only)
