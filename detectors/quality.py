"""A loss for training in which every anchor says how well its own box meets an object.

The published loss of SqueezeDet lets one anchor answer for an object, weighs it some thousand times what a silent
one weighs, and so makes loose boxes nearly as certain as tight ones: on few objects to learn from, precision stays
behind. Here confidence is the overlap of an anchor's box with its object, by the quality focal loss, and several
anchors learn the box of each object, by generalised IoU. Sources: Generalized Focal Loss, Li et al. 2020
(arXiv:2006.04388); adaptive choice of anchors, after Zhang et al. 2020 (arXiv:1912.02424); generalised IoU,
Rezatofighi et al. 2019 (arXiv:1902.09630).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from detectors import boxes, grid
from detectors.base import RawPredictions
from detectors.types import Targets

CANDIDATES = 9
"""Anchors, at most, whose boxes an object teaches: those that overlap it most (as many a level in ATSS)."""
NEAR_BEST = 0.6
"""Share of the best anchor's overlap from which an anchor is a candidate."""
FOCUS = 2.0
"""Power of the distance between wanted and given confidence that weighs an anchor (beta of the paper)."""
WEIGHT_CONFIDENCE = 2.0
WEIGHT_OVERLAP = 2.0
WEIGHT_OFFSETS = 1.0
WEIGHT_CLASS = 1.0
"""Weights of the terms: overlap and offsets make up the box term."""


@dataclass(frozen=True, slots=True)
class Answers:
    """Anchors that answer for an object, in one image; P of them. No gradient.

    anchor, object (P,) int64; candidate (P,) bool, whether the object teaches the anchor's box too; quality (P,),
    IoU of the anchor's box and the object; share (P,): 1 / how many anchors answer for the same object.
    """

    anchor: Tensor
    object: Tensor
    candidate: Tensor
    quality: Tensor
    share: Tensor


@torch.no_grad()
def answers(boxes_xyxy: Tensor, anchors_xyxy: Tensor, wanted_xyxy: Tensor, own: Tensor) -> Answers:
    """boxes_xyxy, anchors_xyxy (A, 4) px: what the anchors predict, and they themselves; wanted_xyxy (K, 4), the
    objects, K >= 1; own (K,) int64: an anchor of its own for each, that no overlap takes away.

    Candidates are an object's own anchor, and those of highest overlap; an anchor that is wanted twice goes to the
    object it overlaps more. Further anchors answer whose predicted boxes meet an object.
    """
    prior = boxes.iou_matrix(wanted_xyxy, anchors_xyxy)
    best = prior.topk(min(CANDIDATES, prior.shape[1]), dim=1)
    near = (best.values >= NEAR_BEST * best.values[:, :1]) & (best.values > 0)
    claim = torch.zeros_like(prior).scatter_(1, best.indices, torch.where(near, best.values, 0.0))
    claim[torch.arange(len(own), device=own.device), own] = 2.0  # above any overlap
    claimed, claimant = claim.max(0)
    predicted = boxes.iou_matrix(wanted_xyxy, boxes_xyxy)
    met, meeting = predicted.max(0)
    candidate = claimed > 0
    (anchor,) = torch.nonzero(candidate | (met >= grid.MEETING_IOU), as_tuple=True)
    chosen = torch.where(candidate[anchor], claimant[anchor], meeting[anchor])
    counts = torch.bincount(chosen, minlength=len(wanted_xyxy)).clamp_min(1)
    return Answers(
        anchor=anchor,
        object=chosen,
        candidate=candidate[anchor],
        quality=predicted[chosen, anchor],
        share=1 / counts[chosen].to(predicted.dtype),
    )


def terms(
    raw: RawPredictions,
    targets: Sequence[Targets],
    sizes: grid.Sizes,
    own: tuple[Tensor, Tensor],
    silent: Tensor,
) -> dict[str, Tensor]:
    """The weighted terms "confidence", "box" and "class" of a batch.

    own: image and anchor, both (objects of the batch,) int64, the anchor of its own of each object that is not
    ignored, in the targets' order; silent (B, A) bool: anchors that answer for nothing unless `answers` says so
    (no region covers them). Confidence: quality focal loss over all these, divided by how many answer. Box and
    class: a mean over objects, each with the mean of its anchors.
    """
    rows, columns = grid.cells(raw.image_hw)
    like = raw.deltas
    centred = grid.anchors(sizes, rows, columns, like.dtype, like.device)
    corners = grid.anchor_corners(sizes, rows, columns, like.dtype, like.device)
    logits = raw.confidence_logits
    wanted_confidence = torch.zeros_like(logits)
    counted = silent.clone()
    box, classes, objects, answering = logits.new_zeros(()), logits.new_zeros(()), 0, 0
    for b, target in enumerate(targets):
        kept = ~target.ignore.to(like.device)
        wanted_xyxy, labels = target.boxes_xyxy.to(like)[kept], target.labels.to(like.device)[kept]
        if not len(wanted_xyxy):
            continue
        found = answers(raw.boxes_xyxy[b].detach(), corners, wanted_xyxy, own[1][own[0] == b])
        objects += len(wanted_xyxy)
        answering += len(found.anchor)
        wanted_confidence[b, found.anchor] = found.quality
        counted[b, found.anchor] = True
        entropy = F.cross_entropy(raw.class_logits[b, found.anchor], labels[found.object], reduction="none")
        classes = classes + (entropy * found.share).sum()
        taught, truth = found.anchor[found.candidate], wanted_xyxy[found.object[found.candidate]]
        counts = torch.bincount(found.object[found.candidate], minlength=len(wanted_xyxy))
        share = 1 / counts[found.object[found.candidate]].to(like.dtype)
        aim = grid.offsets(truth, centred[taught])
        given = raw.deltas[b, taught]
        apart = 1 - boxes.paired_giou(grid.boxes_of(given), grid.boxes_of(aim))
        off = F.smooth_l1_loss(given, aim, reduction="none", beta=0.1).sum(1)
        box = box + ((WEIGHT_OVERLAP * apart + WEIGHT_OFFSETS * off) * share).sum()
    distance = (wanted_confidence - torch.sigmoid(logits)).abs()
    focal = distance**FOCUS * F.binary_cross_entropy_with_logits(logits, wanted_confidence, reduction="none")
    confidence = torch.where(counted, focal, 0.0).sum() / max(answering, 1)
    return {
        "confidence": WEIGHT_CONFIDENCE * confidence,
        "box": box / max(objects, 1),
        "class": WEIGHT_CLASS * classes / max(objects, 1),
    }
