"""A training loss in which each anchor predicts how well its own box fits an object.

SqueezeDet's published loss assigns one anchor to an object and weighs it a thousand times more than a silent one,
which makes loose boxes nearly as confident as tight ones; with few objects to learn from, precision suffers. Here
confidence is the IoU of an anchor's box with its object, by the quality focal loss, and several anchors learn each
object's box by generalised IoU. Sources: Generalized Focal Loss, Li et al. 2020 (arXiv:2006.04388); adaptive
anchor assignment, after Zhang et al. 2020 (arXiv:1912.02424); generalised IoU, Rezatofighi et al. 2019
(arXiv:1902.09630).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from detectors import boxes, grid
from detectors.base import AnchorPredictions
from detectors.types import Targets

CANDIDATES = 9
"""Maximum number of anchors that learn an object's box: those of highest IoU (as per level in ATSS)."""
NEAR_BEST = 0.6
"""Share of the best anchor's IoU from which an anchor is a candidate."""
FOCUS = 2.0
"""Exponent of the distance between target and predicted confidence (beta in the paper)."""
WEIGHT_CONFIDENCE = 2.0
WEIGHT_OVERLAP = 2.0
WEIGHT_OFFSETS = 1.0
WEIGHT_CLASS = 1.0
"""Weights of the terms; overlap and offsets form the box term."""


@dataclass(frozen=True, slots=True)
class ResponsibleAnchors:
    """The P anchors that predict an object in one image; no gradient."""

    anchor: Tensor
    """(P,) int64."""
    object: Tensor
    """(P,) int64."""
    candidate: Tensor
    """(P,) bool: whether the anchor also learns the object's box."""
    quality: Tensor
    """(P,) IoU of the anchor's predicted box with the object."""
    share: Tensor
    """(P,) 1 / number of anchors responsible for the same object."""


@torch.no_grad()
def choose_responsible_anchors(
    boxes_xyxy: Tensor, anchors_xyxy: Tensor, objects_xyxy: Tensor, assigned: Tensor
) -> ResponsibleAnchors:
    """Choose the anchors that predict each object.

    Candidates are each object's assigned anchor and those of highest IoU; a contested anchor goes to the object it
    overlaps more. All other anchors that predict a box on an object are responsible without learning the box.

    Args:
        boxes_xyxy: (A, 4) px, predicted boxes.
        anchors_xyxy: (A, 4) px.
        objects_xyxy: (K, 4) px, K >= 1.
        assigned: (K,) int64, a different anchor for each object, independent of overlaps.
    """
    prior = boxes.iou_matrix(objects_xyxy, anchors_xyxy)
    best = prior.topk(min(CANDIDATES, prior.shape[1]), dim=1)
    near_best = (best.values >= NEAR_BEST * best.values[:, :1]) & (best.values > 0)
    claims = torch.zeros_like(prior).scatter_(1, best.indices, torch.where(near_best, best.values, 0.0))
    claims[torch.arange(len(assigned), device=assigned.device), assigned] = 2.0  # above any overlap
    claimed, claimant = claims.max(0)
    predicted = boxes.iou_matrix(objects_xyxy, boxes_xyxy)
    best_iou, best_object = predicted.max(0)
    candidate = claimed > 0
    (anchor,) = torch.nonzero(candidate | (best_iou >= grid.MEETING_IOU), as_tuple=True)
    chosen = torch.where(candidate[anchor], claimant[anchor], best_object[anchor])
    counts = torch.bincount(chosen, minlength=len(objects_xyxy)).clamp_min(1)
    return ResponsibleAnchors(
        anchor=anchor,
        object=chosen,
        candidate=candidate[anchor],
        quality=predicted[chosen, anchor],
        share=1 / counts[chosen].to(predicted.dtype),
    )


def quality_loss_terms(
    raw: AnchorPredictions,
    targets: Sequence[Targets],
    sizes: grid.AnchorSizes,
    assigned: tuple[Tensor, Tensor],
    silent: Tensor,
) -> dict[str, Tensor]:
    """The weighted terms "confidence", "box" and "class" of a batch.

    Confidence is the quality focal loss over all counted anchors, divided by the number of responsible ones. Box
    and class are means over objects, each the mean over its anchors.

    Args:
        raw: Predictions of the batch.
        targets: One Targets per image.
        sizes: The detector's anchor sizes.
        assigned: Image and anchor, both (K,) int64, of each object that is not ignored, in the targets' order.
        silent: (B, A) bool: anchors that should predict nothing unless responsible (not in an ignored region).
    """
    rows, columns = grid.grid_size(raw.image_hw)
    like = raw.deltas
    centred = grid.anchors_cxcywh(sizes, rows, columns, like.dtype, like.device)
    corners = grid.anchors_xyxy(sizes, rows, columns, like.dtype, like.device)
    logits = raw.confidence_logits
    target_confidence = torch.zeros_like(logits)
    counted = silent.clone()
    box, classes, objects, responsible_count = logits.new_zeros(()), logits.new_zeros(()), 0, 0
    for b, target in enumerate(targets):
        is_object = ~target.ignore.to(like.device)
        objects_xyxy, labels = target.boxes_xyxy.to(like)[is_object], target.labels.to(like.device)[is_object]
        if not len(objects_xyxy):
            continue
        own_anchors = assigned[1][assigned[0] == b]
        responsible = choose_responsible_anchors(raw.boxes_xyxy[b].detach(), corners, objects_xyxy, own_anchors)
        anchor, matched = responsible.anchor, responsible.object
        objects += len(objects_xyxy)
        responsible_count += len(anchor)
        target_confidence[b, anchor] = responsible.quality
        counted[b, anchor] = True
        entropy = F.cross_entropy(raw.class_logits[b, anchor], labels[matched], reduction="none")
        classes = classes + (entropy * responsible.share).sum()
        anchor, matched = anchor[responsible.candidate], matched[responsible.candidate]
        share = 1 / torch.bincount(matched, minlength=len(objects_xyxy))[matched].to(like.dtype)
        target_deltas = grid.encode_boxes(objects_xyxy[matched], centred[anchor])
        deltas = raw.deltas[b, anchor]
        overlap = boxes.paired_giou(grid.decode_unit_boxes(deltas), grid.decode_unit_boxes(target_deltas))
        offset_loss = F.smooth_l1_loss(deltas, target_deltas, reduction="none", beta=0.1).sum(1)
        box = box + ((WEIGHT_OVERLAP * (1 - overlap) + WEIGHT_OFFSETS * offset_loss) * share).sum()
    distance = (target_confidence - torch.sigmoid(logits)).abs()
    focal = distance**FOCUS * F.binary_cross_entropy_with_logits(logits, target_confidence, reduction="none")
    confidence = torch.where(counted, focal, 0.0).sum() / max(responsible_count, 1)
    return {
        "confidence": WEIGHT_CONFIDENCE * confidence,
        "box": box / max(objects, 1),
        "class": WEIGHT_CLASS * classes / max(objects, 1),
    }
