"""Margins: how far an object is from being missed, and a place from having a phantom, in logits beyond t*.

A positive margin is right, a negative one a failure. A margin belongs to one image; its mean over nuisance samples
(`nuisances`) measures how certain a failure is. Differentiable.
"""

from __future__ import annotations

import torch
from torch import Tensor

from detectors import boxes
from detectors.base import Candidates
from drivesem.attacks.losses import log_score_logits, threshold_logit
from drivesem.failures.kinds import BACKGROUND_IOU, MATCH_IOU, SAME_PLACE_IOU

MIN_MARGIN = -8.0
"""Margin of an object that no candidate matches: that of a score of 0.0003 where t* is 0.5."""
LOGITS_PER_IOU = 40.0
"""Penalty in the soft margin, in logits per unit of IoU below `MATCH_IOU`; it shows which way a box must move."""

_SOFT_MAX_RANGE = 48.0
"""Candidates with less than exp(-48) of the largest weight in the soft maximum get no gradient. They would end in
subnormal numbers, which slow the detector's backward pass down threefold."""


def object_margins(
    candidates: Candidates,
    boxes_xyxy: Tensor,
    labels: Tensor,
    visible_xyxy: Tensor,
    t_star: float,
    sharpness: float | None = None,
) -> Tensor:
    """Compute each object's margin: the logit of the best candidate that would detect it, minus that of t*.

    Args:
        candidates: The detector's candidates before suppression.
        boxes_xyxy: (M, 4) px, labels' boxes.
        labels: (M,) int64, columns of `candidates.log_scores`.
        visible_xyxy: (M, 4) px, boxes of the visible parts.
        t_star: Score threshold.
        sharpness: 1 / logits of a soft maximum (log-sum-exp) over all candidates, where a low IoU lowers a
            candidate's logit; differentiable to scores and boxes. None takes the maximum over those that match
            the object, without a gradient to boxes.

    Returns:
        (M,) logits, at least `MIN_MARGIN`.
    """
    margins = []
    for label, box, visible in zip(labels.tolist(), boxes_xyxy, visible_xyxy, strict=True):
        candidate_boxes = candidates.boxes_for_class(label)
        ious = boxes.iou_matrix(torch.stack([box, visible]).to(candidate_boxes), candidate_boxes).amax(dim=0)
        logits = log_score_logits(candidates.log_scores[:, label])
        margins.append(_best_margin(logits, ious, MATCH_IOU, t_star, sharpness))
    return torch.stack(margins) if margins else candidates.log_scores[:0, 0]


def place_margins(
    candidates: Candidates, places_xyxy: Tensor, t_star: float, sharpness: float | None = None
) -> Tensor:
    """Compute the margin of places where nothing is: t*'s logit minus that of the best candidate of any class.

    Args:
        candidates: The detector's candidates before suppression.
        places_xyxy: (K, 4) px.
        t_star: Score threshold.
        sharpness: See `object_margins`.

    Returns:
        (K,) logits, at most -`MIN_MARGIN`.
    """
    logits = log_score_logits(candidates.log_scores.T.flatten())
    candidate_boxes = torch.cat(
        [candidates.boxes_for_class(label) for label in range(candidates.log_scores.shape[1])]
    )
    ious = boxes.iou_matrix(places_xyxy.to(candidate_boxes), candidate_boxes)
    margins = [-_best_margin(logits, row, SAME_PLACE_IOU, t_star, sharpness) for row in ious]
    return torch.stack(margins) if margins else candidates.log_scores[:0, 0]


def background_margin(
    candidates: Candidates, labelled_xyxy: Tensor, t_star: float, sharpness: float | None = None
) -> Tensor:
    """Compute the margin of the background: t*'s logit minus that of the best candidate that lies on nothing.

    Args:
        candidates: The detector's candidates before suppression.
        labelled_xyxy: (M, 4) px, all labelled objects and regions, ignored or not.
        t_star: Score threshold.
        sharpness: See `object_margins`.

    Returns:
        () logits, at most -`MIN_MARGIN`. What lies on nothing is defined by `kinds.match_detections`.
    """
    margins = []
    for label in range(candidates.log_scores.shape[1]):
        candidate_boxes = candidates.boxes_for_class(label)
        labelled = labelled_xyxy.to(candidate_boxes)
        touches = boxes.iou_matrix(candidate_boxes, labelled) >= BACKGROUND_IOU
        on_nothing = ~(touches | (boxes.ioa_matrix(candidate_boxes, labelled) >= MATCH_IOU)).any(dim=1)
        logits = log_score_logits(candidates.log_scores[:, label])
        margins.append(-_best_margin(logits, on_nothing.to(candidates.log_scores), 1.0, t_star, sharpness))
    return torch.stack(margins).amin()


def _best_margin(
    logits: Tensor, overlaps: Tensor, min_overlap: float, t_star: float, sharpness: float | None
) -> Tensor:
    """The largest logit () of candidates (A,) with enough overlap (A,), minus t*'s; at least `MIN_MARGIN`."""
    beyond = logits - threshold_logit(t_star)
    floor = beyond.new_tensor(MIN_MARGIN)
    if sharpness is None:
        return torch.cat([beyond[overlaps >= min_overlap], floor[None]]).amax()
    penalty = LOGITS_PER_IOU * (min_overlap - overlaps).clamp_min(0)
    scaled = sharpness * torch.cat([beyond - penalty, floor[None]])
    has_gradient = scaled.detach() >= scaled.detach().amax() - _SOFT_MAX_RANGE
    return torch.logsumexp(torch.where(has_gradient, scaled, scaled.detach()), dim=0) / sharpness
