"""What an attack may want of a detector, told from the boxes and scores that it would decode.

Terms of a training loss ask for more than a failure: they go on rising on what is lost already, and hardly rise
where a score is near 1. These are distances from failure instead, in logits of the score, as the hinge of Carlini
and Wagner (2017) is: they rise evenly until something has failed for certain, and then no more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from detectors import boxes
from detectors.base import Candidates
from detectors.types import Detections, Targets
from drivesem.evaluation.failures import IOU

HIDE, PHANTOM, LOCALISATION, FAILURE = "hide", "phantom", "localisation", "failure"
GOALS = (HIDE, PHANTOM, LOCALISATION, FAILURE)
"""hide: objects are not found; phantom: something is found where nothing is; failure: both; localisation: what
finds an object does not lie on it."""
CERTAIN = 4.0
"""Logits beyond t* at which a failure is certain: a score of 0.02 less for one of 0.5."""
ALARMS = 8
"""Of what lies nowhere, as many of the best scores count: several, as suppression merges neighbours."""
_LARGEST_LOG = -1e-7
"""Of a score: its logit is 16 then."""


def goal(name: str, found: Candidates, targets: Targets, t_star: float, known: Sequence[int]) -> Tensor:
    """How near () the detector is to a failure, to be raised; differentiable to `found`.

    targets: labels index the columns of found.log_scores; ignored ones are no objects, and excuse what lies on
    them. t_star in (0, 1]: score from which a detection counts. known: columns of classes that are judged.
    KeyError for a name not in GOALS.
    """
    wanted = {HIDE: (_hidden,), PHANTOM: (_phantoms,), LOCALISATION: (_apart,), FAILURE: (_hidden, _phantoms)}[
        name
    ]
    parts = [part(found, targets, logit_of(t_star), known) for part in wanted]
    return torch.stack(parts).sum()


def logit_of(t_star: float) -> float:
    """The logit of a threshold in (0, 1], which is finite, as those of scores are."""
    below = min(t_star, math.exp(_LARGEST_LOG))
    return math.log(below) - math.log1p(-below)


def of_detections(found: Detections, classes: int) -> Candidates:
    """Detections as candidates: without a gradient, of detectors that have none."""
    scores = found.scores.new_zeros(len(found), classes)
    scores[torch.arange(len(found)), found.labels] = found.scores
    return Candidates(found.boxes_xyxy[:, None], scores.clamp_min(1e-12).log())


def _hidden(found: Candidates, targets: Targets, threshold: float, known: Sequence[int]) -> Tensor:
    """Sum over objects of how far the best score that meets one lies below t*; CERTAIN where none meets it."""
    total = _nothing(found)
    for label, objects in _objects(targets).items():
        placed = found.boxes_of(label)
        meets = boxes.iou_matrix(objects.to(placed), placed.detach()) >= IOU
        logit = logits_of(found.log_scores[:, label]).expand_as(meets).masked_fill(~meets, -math.inf)
        best = logit.amax(1) if logit.shape[1] else logit.new_full((len(objects),), -math.inf)
        total = total + (threshold - best).clamp_max(CERTAIN).sum()
    return total


def _phantoms(found: Candidates, targets: Targets, threshold: float, known: Sequence[int]) -> Tensor:
    """Mean over the ALARMS best scores, of what meets no object and lies on nothing ignored, of how far they lie
    above t*.
    """
    objects = _objects(targets)
    heard = []
    for label in known:
        placed = found.boxes_of(label).detach()
        silent = torch.ones(len(placed), dtype=torch.bool, device=placed.device)
        if label in objects:
            silent &= ~(boxes.iou_matrix(objects[label].to(placed), placed) >= IOU).any(0)
        regions = targets.boxes_xyxy[targets.ignore & (targets.labels == label)].to(placed)
        if len(regions):
            silent &= ~(boxes.ioa_matrix(placed, regions) >= IOU).any(1)
        silent &= boxes.area(placed) > 0
        heard.append(logits_of(found.log_scores[:, label][silent]))
    logit = torch.cat(heard) if heard else found.log_scores[:0, 0]
    if not len(logit):
        return _nothing(found) - CERTAIN
    best = logit.topk(min(ALARMS, len(logit))).values
    return (best - threshold).clamp(max=CERTAIN).mean()


def _apart(found: Candidates, targets: Targets, threshold: float, known: Sequence[int]) -> Tensor:
    """Sum over objects of 1 - IoU with the best scored box that meets it; 1 where none meets it."""
    total = _nothing(found)
    for label, objects in _objects(targets).items():
        placed = found.boxes_of(label)
        overlap = boxes.iou_matrix(objects.to(placed), placed)
        if not overlap.shape[1]:
            total = total + len(objects)
            continue
        score = found.log_scores[:, label].detach().expand_as(overlap).masked_fill(overlap < IOU, -math.inf)
        best = score.argmax(1, keepdim=True)
        met = (overlap.gather(1, best) >= IOU)[:, 0]
        total = total + torch.where(met, 1 - overlap.gather(1, best)[:, 0], 1.0).sum()
    return total


def _nothing(found: Candidates) -> Tensor:
    """0 (), with a gradient, which is 0 too: of a frame in which there is nothing to lose."""
    return found.log_scores[:0].sum()


def _objects(targets: Targets) -> dict[int, Tensor]:
    """Boxes (K, 4) px of the objects that count, by label."""
    kept = ~targets.ignore
    labels = targets.labels[kept]
    return {label: targets.boxes_xyxy[kept][labels == label] for label in sorted(set(labels.tolist()))}


def logits_of(log_score: Tensor) -> Tensor:
    """log(s / (1 - s)) of log(s), exact near s = 0 and s = 1."""
    held = log_score.clamp_max(_LARGEST_LOG)
    return held - torch.log(-torch.expm1(held))
