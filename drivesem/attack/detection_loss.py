"""What attacks raise where a detector has no loss: from its detections alone, without a gradient."""

from __future__ import annotations

import torch

from detectors import boxes
from detectors.types import Detections, Targets
from drivesem.evaluation import failures


def objectness(targets: Targets, detections: Detections) -> float:
    """Sum over objects of (1 - s)^2, s the best score of a detection of its class that meets it (IoU of at least
    0.5), 0 without one; and the sum of squared scores of false alarms.

    In the spirit of the "objectness" of `detectors.base.Detector.loss`: it rises as objects fade and as what is no
    object appears. Ignored targets are neither objects nor false alarms.
    """
    wanted = ~targets.ignore
    overlap = boxes.iou_matrix(targets.boxes_xyxy[wanted].to(detections.boxes_xyxy), detections.boxes_xyxy)
    meets = overlap >= failures.IOU
    meets &= targets.labels[wanted].to(detections.labels)[:, None] == detections.labels[None]
    best = torch.zeros(len(meets), dtype=torch.float64)
    if len(detections):
        scores = detections.scores.double()
        best = torch.where(meets, scores, torch.zeros_like(scores)).amax(dim=1).cpu()
    alarms = failures.judge(targets, detections, threshold=0.0).false_positive
    return float((1 - best).square().sum() + detections.scores.cpu().double()[alarms].square().sum())
