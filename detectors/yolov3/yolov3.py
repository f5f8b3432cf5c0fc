"""YOLOv3 (Redmon and Farhadi, 2018, arXiv:1804.02767) for images of any size.

Departures from the published code: images are padded right and below with its grey to a multiple of 32 px and
never resized; an object gets the next best anchor if the best one in its cell is taken; loss sums are divided by
the number of objects in the batch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from detectors import boxes
from detectors.base import AnchorPredictions, Candidates, Detector, DetectorStages
from detectors.grid import MEETING_IOU, covered_by_ignored
from detectors.types import CLASSES, Detections, Targets
from detectors.yolov3 import cfg as layouts
from detectors.yolov3.cfg import DarknetCfg
from detectors.yolov3.network import DarknetNetwork, FoldedNetwork

GREY = 0.5
"""Darknet's padding."""
MAX_LOG_SIZE = 6.0
"""Boxes are at most e^6 = 400 times their anchor: untrained ones cannot overflow."""
SCORE_MINIMUM = 0.005
NMS_IOU = 0.45
"""Decoding for evaluation (published code: `validate_detector`)."""
TOP_CANDIDATES = 200
"""Maximum number of scored boxes per image before suppression."""
MAX_CACHED_SIZES = 16
"""Image sizes with cached anchors."""
PRIOR = 0.01
"""Objectness before training: almost no anchor has an object."""
_HALF = (torch.bfloat16, torch.float16)


@dataclass(frozen=True, slots=True)
class AnchorPlacement:
    """Positions of an image's A anchors: by head in the file's order, cell row by row, and anchor."""

    cells_xy: Tensor
    """(A, 2) px, corner of the cell."""
    strides: Tensor
    """(A,) px."""
    anchors_wh: Tensor
    """(A, 2) px."""


@dataclass(frozen=True, slots=True)
class YoloAssignment:
    """Which anchors predict which objects, in K pairs, for the M objects that are not ignored; no gradient."""

    image: Tensor
    """(K,) int64."""
    anchor: Tensor
    """(K,) int64."""
    deltas: Tensor
    """(K, 4) targets of the box head: x and y in the cell, in (0, 1); logarithms of width and height in anchors.
    """
    scales: Tensor
    """(K,) 2 minus the object's share of the image."""
    labels: Tensor
    """(K,) int64."""
    negative: Tensor
    """(B, A) bool: anchors that should be silent."""
    found_image: Tensor
    """(M,) int64: image of each object."""
    found_by: Tensor
    """(M,) int64: the most confident anchor with a predicted box that matches the object."""
    found: Tensor
    """(M,) bool: whether there is one."""
    alarm: Tensor
    """(B, A) bool: negatives that match no object."""


class YoloV3(Detector):
    """The network of a `.cfg` with its loss and decoding.

    In eval mode with all weights frozen, normalisation is folded into the convolutions.
    """

    name = "yolov3"
    fresh_layers = ("network.",)
    layout: ClassVar[Callable[..., DarknetCfg]] = staticmethod(layouts.yolov3)
    """Builds the default network from the number of classes, and anchors."""

    def __init__(
        self,
        classes: tuple[str, ...] = CLASSES,
        t_star: float = 0.5,
        anchors: layouts.Anchors | None = None,
        cfg: DarknetCfg | None = None,
    ) -> None:
        """Build the network without initialising it.

        Args:
            classes: Class names.
            t_star: Score of best F1, in [0, 1].
            anchors: Width and height of each anchor, px; by default the layout's.
            cfg: The network; by default `layout`.

        Raises:
            ValueError: The number of classes or anchors does not fit the network.
        """
        super().__init__()
        if cfg is None:
            cfg = self.layout(len(classes)) if anchors is None else self.layout(len(classes), anchors)
        if len(classes) != cfg.classes:
            raise ValueError(f"classes: expected {cfg.classes} as in the cfg, found {len(classes)}")
        self.cfg = cfg
        self.classes = tuple(classes)
        self.t_star = t_star
        self.network = DarknetNetwork(cfg)
        self.gradient_precision: torch.dtype | None = None
        self._nets: dict[torch.dtype, tuple[object, FoldedNetwork]] = {}
        self._cached_places: dict[object, AnchorPlacement] = {}

    @property
    def anchors(self) -> layouts.Anchors:
        """Widths and heights of all heads' anchors, px."""
        return self.cfg.heads[0][1].anchors_wh

    @torch.no_grad()
    def initialise(self, generator: torch.Generator) -> None:
        """Draw all weights: He for the backbone, near zero for the heads, low objectness everywhere."""
        for block in self.network.blocks.values():
            std = (2 / block.conv.weight[0].numel()) ** 0.5
            block.conv.weight.normal_(0.0, 1e-2 if block.norm is None else std, generator=generator)
            if block.norm is not None:
                block.norm.reset_parameters()
        prior = -torch.log(torch.tensor(1 / PRIOR - 1))
        for i, head in self.cfg.heads:
            bias = self.network.blocks[i - 1].conv.bias
            if bias is not None:
                bias.zero_()
                bias.view(len(head.mask), -1)[:, 4] = prior

    def forward(self, images: Tensor) -> AnchorPredictions:
        """images (B, 3, H, W), RGB in [0, 1]; A: see `places`."""
        if images.ndim != 4 or images.shape[1] != 3:
            raise ValueError(f"images: expected shape (B, 3, H, W), found {tuple(images.shape)}")
        height, width = int(images.shape[2]), int(images.shape[3])
        stride = self.cfg.stride
        if not self.is_frozen:
            return self._interpret(self.network(_padded(images, stride)), (height, width))
        return self._forward_frozen(images, torch.is_grad_enabled() and images.requires_grad)

    @torch.no_grad()
    def forward_for_search(self, images: Tensor) -> AnchorPredictions:
        """As `Detector.forward_for_search`, in `gradient_precision`."""
        return self._forward_frozen(images, coarse=True) if self.is_frozen else self(images)

    def _forward_frozen(self, images: Tensor, coarse: bool) -> AnchorPredictions:
        """With folded convolutions. coarse: in the precision of gradients."""
        dtype = next(self.network.parameters()).dtype
        if coarse and self.gradient_precision is not None:
            dtype = self.gradient_precision
        gradient_scale = _GradientScale()
        x = images
        if dtype in _HALF:
            x = _ToHalf.apply(images, dtype, gradient_scale)  # pyright: ignore[reportAssignmentType]
        with torch.autocast(images.device.type, enabled=False):
            outputs = self._folded_network(dtype)(_padded(x, self.cfg.stride))
        return self._interpret(outputs, (int(images.shape[2]), int(images.shape[3])), gradient_scale)

    def stages(self, image_hw: tuple[int, int]) -> DetectorStages | None:
        """The whole network; None with another precision for gradients."""
        if self.gradient_precision is not None:
            return None
        bottom, right = (-side % self.cfg.stride for side in image_hw)
        return DetectorStages(
            self.network, (0.0, 0.0, 0.0), (GREY, GREY, GREY), (0, bottom, 0, right), self._interpret
        )

    def _folded_network(self, dtype: torch.dtype) -> FoldedNetwork:
        """The folded network, rebuilt after a change of weights."""
        tensors = [*self.network.parameters(), *self.network.buffers()]
        state = [(t.data_ptr(), t._version, t.dtype, t.device) for t in tensors]
        known = self._nets.get(dtype)
        if known is None or known[0] != state:
            known = self._nets[dtype] = (state, self.network.fold(dtype))
        return known[1]

    def places(self, image_hw: tuple[int, int], like: Tensor) -> AnchorPlacement:
        """An image's anchors, in the dtype and on the device of `like`."""
        key = (image_hw, like.dtype, like.device)
        if key not in self._cached_places:
            if len(self._cached_places) >= MAX_CACHED_SIZES:
                self._cached_places.clear()
            self._cached_places[key] = self._places(image_hw, like)
        return self._cached_places[key]

    def _places(self, image_hw: tuple[int, int], like: Tensor) -> AnchorPlacement:
        sides = [side + -side % self.cfg.stride for side in image_hw]
        cells, strides, anchors = [], [], []
        for i, head in self.cfg.heads:
            stride, count = self.cfg.strides[i], len(head.mask)
            y, x = (torch.arange(side // stride, dtype=like.dtype, device=like.device) * stride for side in sides)
            corners = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)
            shapes = like.new_tensor([head.anchors_wh[k] for k in head.mask])
            cells.append(corners.repeat_interleave(count, 0))
            anchors.append(shapes.repeat(len(corners), 1))
            strides.append(like.new_full((len(corners) * count,), stride))
        return AnchorPlacement(torch.cat(cells), torch.cat(strides), torch.cat(anchors))

    def _interpret(
        self, outputs: Sequence[Tensor], image_hw: tuple[int, int], gradient_scale: _GradientScale | None = None
    ) -> AnchorPredictions:
        """Decode the heads' channels, per anchor: x, y, width, height, objectness, classes."""
        numbers = 5 + len(self.classes)
        flat = [out.permute(0, 2, 3, 1).reshape(len(out), -1, numbers) for out in outputs]
        cells = torch.cat(flat, 1)
        if cells.dtype in _HALF:  # boxes need more than their 8 or 11 bits
            cells = cells.float() if gradient_scale is None else _FromHalf.apply(cells, gradient_scale)
        deltas, confidence, class_logits = cells.split((4, 1, len(self.classes)), -1)
        places = self.places(image_hw, cells)
        # A cell's edge lies half a pixel before its first pixel's centre, which is an integer.
        centre = places.cells_xy + torch.sigmoid(deltas[..., :2]) * places.strides[:, None] - 0.5
        half = places.anchors_wh * torch.exp(deltas[..., 2:].clamp_max(MAX_LOG_SIZE)) / 2
        return AnchorPredictions(
            boxes_xyxy=torch.cat((centre - half, centre + half), -1),
            deltas=deltas,
            class_logits=class_logits,
            confidence_logits=confidence[..., 0],
            image_hw=image_hw,
        )

    def loss(self, raw: AnchorPredictions, targets: Sequence[Targets]) -> dict[str, Tensor]:
        """The paper's loss; its targets (`assign`) are constant in the gradient, as in the published code."""
        return self.loss_terms(raw, self.assign(raw, targets))

    @torch.no_grad()
    def assign(self, raw: AnchorPredictions, targets: Sequence[Targets]) -> YoloAssignment:
        """Assign each object, in the cell of its centre, the anchor of all heads with the best shape, and those
        others with an IoU above their head's match_threshold.

        Raises:
            ValueError: Targets and images differ in number, or a label is not one of the classes.
        """
        if len(targets) != len(raw):
            raise ValueError(f"targets: expected {len(raw)}, one for each image, found {len(targets)}")
        like = raw.boxes_xyxy
        places = self.places(raw.image_hw, like)
        negative = torch.ones(raw.confidence_logits.shape, dtype=torch.bool, device=like.device)
        matches_any = ~negative
        image, anchor, truth, label, matches, found_image = [], [], [], [], [], []
        thresholds = _ignore_thresholds(self.cfg, raw.image_hw, like)
        for b, target in enumerate(targets):
            ignore = target.ignore.to(like.device)
            wanted = target.boxes_xyxy.to(like)[~ignore]
            labels = target.labels.to(like.device)[~ignore]
            # Ignored regions are listed once per class.
            regions = torch.unique(target.boxes_xyxy.to(like)[ignore], dim=0)
            overlap = boxes.iou_matrix(wanted, raw.boxes_xyxy[b])
            if len(wanted):
                negative[b] = overlap.max(0).values <= thresholds
                matches_any[b] = (overlap >= MEETING_IOU).any(0)
            if len(regions):
                negative[b] &= ~(
                    covered_by_ignored(_anchor_boxes(places), regions)
                    | covered_by_ignored(raw.boxes_xyxy[b], regions)
                )
            rows, columns = self._matches(wanted, raw.image_hw, places)
            image += [b] * len(rows)
            anchor += columns
            truth.append(wanted[rows])
            label.append(labels[rows])
            found_image += [b] * len(wanted)
            logits = raw.confidence_logits[b].expand_as(overlap)
            matches.append(logits.masked_fill(overlap < MEETING_IOU, -torch.inf).max(1))
        image = torch.tensor(image, dtype=torch.int64, device=like.device)
        anchor = torch.tensor(anchor, dtype=torch.int64, device=like.device)
        truth_xyxy, label = torch.cat(truth), torch.cat(label)
        if bool(((label < 0) | (label >= len(self.classes))).any()):
            raise ValueError(f"targets.labels: expected 0..{len(self.classes) - 1}, found {label.tolist()}")
        negative[image, anchor] = False
        centre, size = _centre_and_size(truth_xyxy)
        place = (centre - places.cells_xy[anchor]) / places.strides[anchor, None]
        share = size.prod(1) / (raw.image_hw[0] * raw.image_hw[1])
        return YoloAssignment(
            image=image,
            anchor=anchor,
            deltas=torch.cat((place.clamp(0, 1), torch.log(size / places.anchors_wh[anchor])), 1),
            scales=2 - share.clamp(0, 1),
            labels=label,
            negative=negative,
            found_image=torch.tensor(found_image, dtype=torch.int64, device=like.device),
            found_by=torch.cat([m.indices for m in matches]),
            found=torch.cat([m.values for m in matches]) > -torch.inf,
            alarm=negative & ~matches_any,
        )

    def _matches(
        self, objects_xyxy: Tensor, image_hw: tuple[int, int], places: AnchorPlacement
    ) -> tuple[list[int], list[int]]:
        """Rows of the objects (N, 4) and the anchor of each; an object's row occurs once per anchor."""
        shapes, offsets, strides, thresholds = [], [], [], []
        start = 0
        sides = [side + -side % self.cfg.stride for side in image_hw]
        for i, head in self.cfg.heads:
            stride, count = self.cfg.strides[i], len(head.mask)
            for k, index in enumerate(head.mask):
                shapes.append(head.anchors_wh[index])
                offsets.append((start + k, count, sides[1] // stride, sides[0] // stride))
                strides.append(stride)
                thresholds.append(head.match_threshold)
            start += count * (sides[0] // stride) * (sides[1] // stride)
        centre, size = _centre_and_size(objects_xyxy)
        overlaps = _shape_iou(size, objects_xyxy.new_tensor(shapes)).tolist()
        taken: set[int] = set()
        rows, columns = [], []
        further: list[tuple[int, int]] = []
        for row, ((x, y), fits) in enumerate(zip(centre.tolist(), overlaps, strict=True)):
            order = sorted(range(len(fits)), key=lambda k: -fits[k])
            at = []
            for k in order:
                first, count, wide, high = offsets[k]
                column = min(max(int(x // strides[k]), 0), wide - 1)
                line = min(max(int(y // strides[k]), 0), high - 1)
                at.append(first + count * (line * wide + column))
            best = next((k for k in range(len(at)) if at[k] not in taken), 0)
            taken.add(at[best])
            rows.append(row)
            columns.append(at[best])
            further += [(row, at[k]) for k in range(len(at)) if fits[order[k]] > thresholds[order[k]]]
        # Only when all objects have their best anchor do others get a further one.
        for row, index in further:
            if index not in taken:
                taken.add(index)
                rows.append(row)
                columns.append(index)
        return rows, columns

    def loss_terms(self, raw: AnchorPredictions, assignment: YoloAssignment) -> dict[str, Tensor]:
        """Sums over the batch, divided by its objects (1 where there is none); their sum, and what attacks raise.

        Box: binary cross entropy of x and y in their cell, minus its minimum, and half the squared error of the
        logarithms of width and height, both times `scales`; confidence: binary cross entropy of objectness over
        anchors that predict an object or must be silent; class: binary cross entropy per class. Their gradients are
        those of the published code, which uses squared errors of sigmoids and omits the sigmoid's slope.

        "objectness" is a squared error, so that no object dominates: 1 minus the confidence of the most
        confident matching anchor, and the confidences of anchors that match none.
        """
        image, anchor = assignment.image, assignment.anchor
        objects = max(len(assignment.found), 1)
        deltas, scales = raw.deltas[image, anchor], assignment.scales[:, None]
        wanted = assignment.deltas[:, :2]
        place = _cross_entropy(deltas[:, :2], wanted) - torch.special.entr(wanted) - torch.special.entr(1 - wanted)
        shape = (deltas[:, 2:] - assignment.deltas[:, 2:]).square() / 2
        logits = raw.confidence_logits
        missed = F.softplus(-logits[image, anchor]).sum()
        alarms = torch.where(assignment.negative, F.softplus(logits), 0.0).sum()
        class_logits = raw.class_logits[image, anchor]
        true = F.one_hot(assignment.labels, len(self.classes)).to(class_logits)
        terms = {
            "confidence": (missed + alarms) / objects,
            "box": ((place + shape) * scales).sum() / objects,
            "class": _cross_entropy(class_logits, true).sum() / objects,
        }
        confidence = torch.sigmoid(logits)
        found = torch.where(assignment.found, confidence[assignment.found_image, assignment.found_by], 0.0)
        unseen = (1 - found).square().sum()
        false = torch.where(assignment.alarm, confidence, 0.0).square().sum()
        return terms | {
            "total": terms["confidence"] + terms["box"] + terms["class"],
            "objectness": (unseen + false) / objects,
        }

    def candidates(self, raw: AnchorPredictions) -> Candidates:
        """Every anchor; score = objectness x class probability."""
        logs = F.logsigmoid(raw.confidence_logits[0])[:, None] + F.logsigmoid(raw.class_logits[0])
        return Candidates(raw.boxes_xyxy[0][:, None], logs)

    @torch.no_grad()
    def decode(self, raw: AnchorPredictions) -> list[Detections]:
        """Score = objectness x class probability, per class; NMS at IoU 0.45 per class, score >= 0.005."""
        found = []
        for b, confidence in enumerate(torch.sigmoid(raw.confidence_logits)):
            # A score never exceeds its confidence, and few anchors are confident.
            (likely,) = torch.nonzero(confidence >= SCORE_MINIMUM, as_tuple=True)
            scores = confidence[likely, None] * torch.sigmoid(raw.class_logits[b, likely])
            flat = scores.flatten()
            top = torch.sort(flat, descending=True, stable=True).indices[:TOP_CANDIDATES]
            top = top[flat[top] >= SCORE_MINIMUM]
            row, label = top // len(self.classes), top % len(self.classes)
            clipped = boxes.clip(raw.boxes_xyxy[b, likely[row]], *raw.image_hw)
            keep = boxes.nms(clipped, flat[top], NMS_IOU, label)
            found.append(Detections(clipped[keep], label[keep], flat[top][keep]))
        return found


class YoloV3Tiny(YoloV3):
    """The published small variant: poolings instead of residual blocks, two heads."""

    name = "yolov3-tiny"
    layout = staticmethod(layouts.yolov3_tiny)


class YoloV3Slim(YoloV3):
    """A narrow Darknet with three heads, for CPUs."""

    name = "yolov3-slim"
    layout = staticmethod(layouts.yolov3_slim)


class _GradientScale:
    """The factor of a gradient in half precision."""

    def __init__(self) -> None:
        self.factor: Tensor | None = None


class _ToHalf(torch.autograd.Function):
    """Convert images to half precision; backward, undo the factor of `_FromHalf`."""

    @staticmethod
    def forward(ctx: Any, images: Tensor, dtype: torch.dtype, gradient_scale: _GradientScale) -> Tensor:
        ctx.dtype, ctx.scaled = images.dtype, gradient_scale
        return images.to(dtype)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor, None, None]:
        return gradients[0].to(ctx.dtype) * ctx.scaled.factor, None, None


class _FromHalf(torch.autograd.Function):
    """Convert to float32; backward, scale the gradient relative to its maximum, because gradients of one
    confidence lie below float16's smallest number, 6e-8.
    """

    @staticmethod
    def forward(ctx: Any, cells: Tensor, gradient_scale: _GradientScale) -> Tensor:
        ctx.dtype, ctx.scaled = cells.dtype, gradient_scale
        return cells.float()

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor, None]:
        factor = gradients[0].abs().amax().clamp_min(torch.finfo(torch.float16).tiny)
        ctx.scaled.factor = factor
        return (gradients[0] / factor).to(ctx.dtype), None


def _padded(images: Tensor, stride: int) -> Tensor:
    height, width = images.shape[2:]
    x = F.pad(images, (0, -width % stride, 0, -height % stride), value=GREY)
    return x.contiguous(memory_format=torch.channels_last)


def _ignore_thresholds(cfg: DarknetCfg, image_hw: tuple[int, int], like: Tensor) -> Tensor:
    """(A,) IoU with an object beyond which an anchor need not be silent."""
    sides = [side + -side % cfg.stride for side in image_hw]
    parts = []
    for i, head in cfg.heads:
        cells = (sides[0] // cfg.strides[i]) * (sides[1] // cfg.strides[i])
        parts.append(like.new_full((cells * len(head.mask),), head.ignore_threshold))
    return torch.cat(parts)


def _anchor_boxes(places: AnchorPlacement) -> Tensor:
    """Anchors (A, 4) px around the middle of their cells."""
    centre = places.cells_xy + places.strides[:, None] / 2 - 0.5
    return torch.cat((centre - places.anchors_wh / 2, centre + places.anchors_wh / 2), -1)


def _centre_and_size(boxes_xyxy: Tensor) -> tuple[Tensor, Tensor]:
    """Centres (N, 2) px from the image's edge, half a pixel before the first pixel's centre; sizes (N, 2)."""
    top_left, bottom_right = boxes_xyxy[:, :2], boxes_xyxy[:, 2:]
    return (top_left + bottom_right) / 2 + 0.5, (bottom_right - top_left).clamp_min(1e-3)


def _shape_iou(first_wh: Tensor, second_wh: Tensor) -> Tensor:
    """IoU (N, M) of shapes (N, 2) and (M, 2) with one centre."""
    shared = torch.minimum(first_wh[:, None], second_wh[None]).prod(-1)
    return shared / (first_wh.prod(-1)[:, None] + second_wh.prod(-1)[None] - shared)


def _cross_entropy(logits: Tensor, wanted: Tensor) -> Tensor:
    return F.binary_cross_entropy_with_logits(logits, wanted, reduction="none")
