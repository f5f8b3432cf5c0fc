"""How far an object is from being lost, and a place from having a phantom: in logits beyond t*, differentiable.

A margin above 0 is right, below 0 a failure. It belongs to one picture; averaged over what a camera does between
two frames (`nuisances`) it says how sure a failure is.
"""

from __future__ import annotations

import torch
from torch import Tensor

from detectors import boxes
from detectors.base import Candidates
from drivesem.attack.goals import logit_of, logits_of
from drivesem.failures.kinds import MEETS, SAME_PLACE, TOUCHES

FLOOR = -8.0
"""Of an object that no candidate meets, as of a score of 0.0003 beside a t* of one half: nothing is farther off.
"""
PER_IOU = 40.0
"""Logits that an IoU short of `MEETS` costs a candidate in the soft margin: it tells which way a box must go."""

_HEARD = 48.0
"""A candidate whose weight in the soft maximum is below exp(-48) of the best one's has no gradient. Beside the
others it is nothing, and it would end in subnormal numbers, which slow a detector's way back threefold."""


def of_objects(
    candidates: Candidates,
    boxes_xyxy: Tensor,
    labels: Tensor,
    shown_xyxy: Tensor,
    t_star: float,
    sharpness: float | None = None,
) -> Tensor:
    """Margin of each target (M,): the logit of the best candidate that would count as its detection, less t*'s.

    boxes_xyxy: (M, 4) px; labels: (M,) int64, columns of candidates.log_scores; shown_xyxy: (M, 4) px, see
    `kinds.View`. sharpness: 1 / logits of a soft maximum over candidates (log-sum-exp), in which those that meet
    the object too little count less and less, so that it is differentiable to scores and boxes; None is the
    maximum itself, over those that meet it, and has no gradient to boxes.
    """
    margins = []
    for label, box, shown in zip(labels.tolist(), boxes_xyxy, shown_xyxy, strict=True):
        placed = candidates.boxes_of(label)
        pair = torch.stack([box, shown]).to(placed)
        overlap = boxes.iou_matrix(pair, placed).amax(dim=0)
        margins.append(_best(logits_of(candidates.log_scores[:, label]), overlap, MEETS, t_star, sharpness))
    return torch.stack(margins) if margins else candidates.log_scores[:0, 0]


def of_places(
    candidates: Candidates, places_xyxy: Tensor, t_star: float, sharpness: float | None = None
) -> Tensor:
    """Margin of each place (K,) at which nothing is: t*'s logit less that of the best candidate there, of any
    class.

    places_xyxy: (K, 4) px. sharpness: as of `of_objects`.
    """
    classes = range(candidates.log_scores.shape[1])
    logits = logits_of(candidates.log_scores.T.flatten())
    placed = torch.cat([candidates.boxes_of(label) for label in classes])
    overlaps = boxes.iou_matrix(places_xyxy.to(placed), placed)
    margins = [-_best(logits, overlap, SAME_PLACE, t_star, sharpness) for overlap in overlaps]
    return torch.stack(margins) if margins else candidates.log_scores[:0, 0]


def of_background(
    candidates: Candidates, labelled_xyxy: Tensor, t_star: float, sharpness: float | None = None
) -> Tensor:
    """Margin () of all that is no labelled thing: t*'s logit less that of the best candidate on nothing, of any
    class; at most -`FLOOR`. On nothing is what `kinds.judge` calls background.

    labelled_xyxy: (M, 4) px, of everything that has a label, ignored or not. sharpness: as of `of_objects`.
    """
    margins = []
    for label in range(candidates.log_scores.shape[1]):
        placed = candidates.boxes_of(label)
        labelled = labelled_xyxy.to(placed)
        touches = boxes.iou_matrix(placed, labelled) >= TOUCHES
        on_nothing = ~(touches | (boxes.ioa_matrix(placed, labelled) >= MEETS)).any(dim=1)
        overlap = on_nothing.to(candidates.log_scores)
        margins.append(-_best(logits_of(candidates.log_scores[:, label]), overlap, 1.0, t_star, sharpness))
    return torch.stack(margins).amin()


def _best(logits: Tensor, overlap: Tensor, least: float, t_star: float, sharpness: float | None) -> Tensor:
    """The best logit () among candidates (A,) whose overlap (A,) is enough, less t*'s; `FLOOR` at least."""
    beyond = logits - logit_of(t_star)
    floor = beyond.new_tensor(FLOOR)
    if sharpness is None:
        return torch.cat([beyond[overlap >= least], floor[None]]).amax()
    scaled = sharpness * torch.cat([beyond - PER_IOU * (least - overlap).clamp_min(0), floor[None]])
    heard = scaled.detach() >= scaled.detach().amax() - _HEARD
    return torch.logsumexp(torch.where(heard, scaled, scaled.detach()), dim=0) / sharpness
