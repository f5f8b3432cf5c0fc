"""Attack losses: how near a detector is to a failure, from the boxes and scores that it would decode.

The terms of a training loss go on rising for objects that are lost already, and hardly rise where a score is near
1. These losses are distances to a failure in logits of the score, as the hinge of Carlini and Wagner (2017): they
rise evenly until something fails clearly, and then no more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from detectors import boxes
from detectors.base import Candidates
from detectors.types import Detections, Targets
from drivesem.evaluation.failures import MATCH_IOU, match_detections

HIDE, PHANTOM, LOCALISATION, FAILURE = "hide", "phantom", "localisation", "failure"
GOALS = (HIDE, PHANTOM, LOCALISATION, FAILURE)
"""hide: objects are missed; phantom: detections on nothing; failure: both; localisation: the detection of an
object is off its place."""
MAX_MARGIN = 4.0
"""Logits beyond t* at which a loss stops rising: a score of 0.02 for a t* of 0.5."""
MAX_PHANTOMS = 8
"""Number of best-scored phantoms that count; several, as suppression merges neighbours."""
_MAX_LOG_SCORE = -1e-7
"""Largest log score; its logit is 16."""


def goal_loss(
    name: str, candidates: Candidates, targets: Targets, t_star: float, columns: Sequence[int]
) -> Tensor:
    """How near () the detector is to a failure; differentiable, to be raised.

    Args:
        name: one of GOALS.
        candidates: the detector's candidates.
        targets: labels index the columns of `candidates.log_scores`; ignored ones are no objects, and excuse
            detections on them.
        t_star: in (0, 1], score from which a detection counts.
        columns: columns of the evaluated classes.

    Raises:
        KeyError: an unknown name.
    """
    goals = {
        HIDE: (_hide_loss,),
        PHANTOM: (_phantom_loss,),
        LOCALISATION: (_localisation_loss,),
        FAILURE: (_hide_loss, _phantom_loss),
    }
    parts = [loss(candidates, targets, threshold_logit(t_star), columns) for loss in goals[name]]
    return torch.stack(parts).sum()


def threshold_logit(t_star: float) -> float:
    """The logit of a threshold in (0, 1]; finite, like those of scores."""
    below = min(t_star, math.exp(_MAX_LOG_SCORE))
    return math.log(below) - math.log1p(-below)


def candidates_from_detections(detections: Detections, classes: int) -> Candidates:
    """Detections as candidates, for detectors without a gradient."""
    scores = detections.scores.new_zeros(len(detections), classes)
    scores[torch.arange(len(detections)), detections.labels] = detections.scores
    return Candidates(detections.boxes_xyxy[:, None], scores.clamp_min(1e-12).log())


def _hide_loss(candidates: Candidates, targets: Targets, threshold: float, columns: Sequence[int]) -> Tensor:
    """Sum over objects of how far the best overlapping score lies below t*; MAX_MARGIN without one."""
    total = _zero_with_gradient(candidates)
    for label, objects in _boxes_by_label(targets).items():
        placed = candidates.boxes_for_class(label)
        meets = boxes.iou_matrix(objects.to(placed), placed.detach()) >= MATCH_IOU
        logit = log_score_logits(candidates.log_scores[:, label]).expand_as(meets).masked_fill(~meets, -math.inf)
        best = logit.amax(1) if logit.shape[1] else logit.new_full((len(objects),), -math.inf)
        total = total + (threshold - best).clamp_max(MAX_MARGIN).sum()
    return total


def _phantom_loss(candidates: Candidates, targets: Targets, threshold: float, columns: Sequence[int]) -> Tensor:
    """Mean over the MAX_PHANTOMS best scores on no object and no ignored region, of how far they lie above t*."""
    objects = _boxes_by_label(targets)
    phantom_logits = []
    for label in columns:
        placed = candidates.boxes_for_class(label).detach()
        free = torch.ones(len(placed), dtype=torch.bool, device=placed.device)
        if label in objects:
            free &= ~(boxes.iou_matrix(objects[label].to(placed), placed) >= MATCH_IOU).any(0)
        regions = targets.boxes_xyxy[targets.ignore & (targets.labels == label)].to(placed)
        if len(regions):
            free &= ~(boxes.ioa_matrix(placed, regions) >= MATCH_IOU).any(1)
        free &= boxes.area(placed) > 0
        phantom_logits.append(log_score_logits(candidates.log_scores[:, label][free]))
    logit = torch.cat(phantom_logits) if phantom_logits else candidates.log_scores[:0, 0]
    if not len(logit):
        return _zero_with_gradient(candidates) - MAX_MARGIN
    best = logit.topk(min(MAX_PHANTOMS, len(logit))).values
    return (best - threshold).clamp(max=MAX_MARGIN).mean()


def _localisation_loss(
    candidates: Candidates, targets: Targets, threshold: float, columns: Sequence[int]
) -> Tensor:
    """Sum over objects of 1 - IoU with the best-scored overlapping box; 1 without one."""
    total = _zero_with_gradient(candidates)
    for label, objects in _boxes_by_label(targets).items():
        placed = candidates.boxes_for_class(label)
        overlap = boxes.iou_matrix(objects.to(placed), placed)
        if not overlap.shape[1]:
            total = total + len(objects)
            continue
        score = (
            candidates.log_scores[:, label].detach().expand_as(overlap).masked_fill(overlap < MATCH_IOU, -math.inf)
        )
        best = score.argmax(1, keepdim=True)
        met = (overlap.gather(1, best) >= MATCH_IOU)[:, 0]
        total = total + torch.where(met, 1 - overlap.gather(1, best)[:, 0], 1.0).sum()
    return total


def _zero_with_gradient(candidates: Candidates) -> Tensor:
    """0 (), with a gradient of 0, for frames with nothing to lose."""
    return candidates.log_scores[:0].sum()


def _boxes_by_label(targets: Targets) -> dict[int, Tensor]:
    """Boxes (K, 4) px of the objects that count, by label."""
    counted = ~targets.ignore
    labels = targets.labels[counted]
    return {label: targets.boxes_xyxy[counted][labels == label] for label in sorted(set(labels.tolist()))}


def log_score_logits(log_score: Tensor) -> Tensor:
    """log(s / (1 - s)) from log(s), exact near s = 0 and s = 1."""
    log_score = log_score.clamp_max(_MAX_LOG_SCORE)
    return log_score - torch.log(-torch.expm1(log_score))


def detection_objectness(targets: Targets, detections: Detections) -> float:
    """The attack loss of detectors that have no loss of their own, from detections alone, without a gradient.

    Sum over objects of (1 - s)^2, where s is the best score of a detection of its class with an IoU of at least
    0.5, 0 without one; plus the sum of squared scores of false positives. Like the "objectness" of
    `detectors.base.Detector.loss` it rises as objects fade and as phantoms appear. Ignored targets are neither.
    """
    counted = ~targets.ignore
    overlap = boxes.iou_matrix(targets.boxes_xyxy[counted].to(detections.boxes_xyxy), detections.boxes_xyxy)
    matches = overlap >= MATCH_IOU
    matches &= targets.labels[counted].to(detections.labels)[:, None] == detections.labels[None]
    best = torch.zeros(len(matches), dtype=torch.float64)
    if len(detections):
        scores = detections.scores.double()
        best = torch.where(matches, scores, torch.zeros_like(scores)).amax(dim=1).cpu()
    false_positives = match_detections(targets, detections, threshold=0.0).false_positive
    return float((1 - best).square().sum() + detections.scores.cpu().double()[false_positives].square().sum())
