"""How good a detector is on held-out frames, and the score at which it is best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from detectors import boxes
from detectors.base import Predictor, predict
from detectors.types import Detections, Targets
from drivesem.evaluation.coco import Scores, evaluate
from drivesem.training.frames import FrameStore

EXCUSED = 0.5
"""Overlap with an ignored box, or share inside it, from which a detection counts nowhere."""
HIT_IOU = 0.5


@dataclass(frozen=True)
class Marks:
    """COCO's figures, and the best F1 over all classes with its score."""

    scores: Scores
    f1: float
    t_star: float

    @property
    def mark(self) -> float:
        """What weights are chosen by: the headline's AP50, and a quarter of the mean over classes."""
        return (self.scores.headline.ap50 or 0.0) + 0.25 * (self.scores.overall.ap50 or 0.0)

    def summary(self) -> str:
        """One line."""
        rows = [
            f"{name} AP50 {s.ap50:.4f} recall {s.recall:.4f} ({s.objects})"
            for name, s in self.scores.per_class.items()
            if s.objects
        ]
        return ", ".join(rows) + f", F1 {self.f1:.4f} at {self.t_star:.3f}"


def judge(
    found: Sequence[Detections], wanted: Sequence[Targets], classes: Sequence[str], headline: str = "Car"
) -> Marks:
    """Figures of detections in images, and the score at which F1 over all classes is best."""
    outcomes = [_outcomes(d, t, k) for d, t in zip(found, wanted, strict=True) for k in range(len(classes))]
    rows = np.concatenate(outcomes)
    rows = rows[np.argsort(-rows[:, 0], kind="stable")]
    hits = np.cumsum(rows[:, 1])
    f1 = 2 * hits / (np.arange(1, len(rows) + 1) + sum(int((~t.ignore).sum()) for t in wanted))
    best = int(np.argmax(f1)) if len(f1) else -1
    f1, t_star = (float(f1[best]), float(rows[best, 0])) if len(f1) else (0.0, 0.5)
    return Marks(evaluate(wanted, found, classes, t_star, headline), f1, t_star)


def _outcomes(found: Detections, wanted: Targets, label: int) -> np.ndarray:
    """(K, 2) score and hit of each detection of a class that counts."""
    mine = found.labels == label
    boxes_xyxy, scores = found.boxes_xyxy[mine], found.scores[mine]
    counted = (wanted.labels == label) & ~wanted.ignore
    overlap = boxes.iou_matrix(boxes_xyxy, wanted.boxes_xyxy[counted]).numpy()
    ignored = wanted.boxes_xyxy[wanted.ignore & (wanted.labels == label)]
    excused = (boxes.iou_matrix(boxes_xyxy, ignored) > EXCUSED) | (boxes.ioa_matrix(boxes_xyxy, ignored) > EXCUSED)
    excused = excused.any(1).numpy() if len(ignored) else np.zeros(len(scores), bool)
    free = np.ones(overlap.shape[1], bool)
    rows = []
    for i, score in enumerate(scores.tolist()):
        candidates = np.where(free, overlap[i], 0.0)
        if candidates.size and candidates.max() >= HIT_IOU:
            free[candidates.argmax()] = False
            rows.append((score, 1.0))
        elif not excused[i]:
            rows.append((score, 0.0))
    return np.array(rows, np.float64).reshape(-1, 2)


def detect(
    detector: Predictor, frames: FrameStore, indices: Sequence[int], device: str = "cpu"
) -> list[Detections]:
    """Detections in whole frames, on the CPU."""
    found = []
    for index in indices:
        image = torch.from_numpy(np.array(frames.image(index))).permute(2, 0, 1)[None].float() / 255
        for one in predict(detector, image.to(device)):
            found.append(Detections(one.boxes_xyxy.cpu(), one.labels.cpu(), one.scores.cpu()))
    return found
