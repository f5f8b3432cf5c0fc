"""SqueezeDet (Wu et al., 2017, arXiv:1612.01051): SqueezeNet 1.1 layers, two more Fire modules, ConvDet.

Departures from the published code. Anchor centres lie in the middle of their 16 px cell instead of being spread
over the image as (i + 1) * width / (cells + 1). So they do not depend on the size of the image, which may be any.
At 1248x384 the two differ by less than a cell. And the class term is the cross-entropy of the true class, as the
paper has it; the code adds that of not being any of the others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detectors import boxes, frozen, grid, quality
from detectors.base import Candidates, Detector, RawPredictions, Trunk
from detectors.types import CLASSES, Detections, Targets

ANCHOR_SIZES_WH = (
    (36.0, 37.0),
    (366.0, 174.0),
    (115.0, 59.0),
    (162.0, 87.0),
    (38.0, 90.0),
    (258.0, 173.0),
    (224.0, 108.0),
    (78.0, 170.0),
    (72.0, 43.0),
)
"""Anchor shapes in pixels: config/kitti_squeezeDet_config.py of the published code."""

BGR_MEAN = (103.939, 116.779, 123.68)
"""Subtracted from pixels in 0..255: the mean of ImageNet that the backbone's weights were trained with."""

WEIGHT_BOX = 5.0
WEIGHT_CONFIDENCE_POSITIVE = 75.0
WEIGHT_CONFIDENCE_NEGATIVE = 100.0
WEIGHT_CLASS = 1.0
"""Weights of the loss terms (published code, LOSS_COEF_*)."""

TOP_DETECTIONS = 1024
NMS_IOU = 0.35
SCORE_MINIMUM = 0.005
"""Decoding (published code: TOP_N_DETECTION, NMS_THRESH, PROB_THRESH). It takes the 64 best: in full streets these
are the many boxes of the near cars, and far ones are lost. And it suppresses from 0.4 on: on training frames 0.35
was better (Car AP50 0.982, at 0.4 0.974, at 0.3 0.976)."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Layers up to ConvDet. kernel, channels: of conv1, stride 2; fires: channels of squeeze and of each of the
    two expansions, by name; pooled: fires that a 3x3/2 max pooling follows, as it follows conv1.
    """

    kernel: int
    channels: int
    fires: dict[str, tuple[int, int]]
    pooled: tuple[str, str]


_LAYOUT = Layout(
    kernel=3,
    channels=64,
    fires={
        "fire2": (16, 64),
        "fire3": (16, 64),
        "fire4": (32, 128),
        "fire5": (32, 128),
        "fire6": (48, 192),
        "fire7": (48, 192),
        "fire8": (64, 256),
        "fire9": (64, 256),
        "fire10": (96, 384),
        "fire11": (96, 384),
    },
    pooled=("fire3", "fire5"),
)
"""nets/squeezeDet.py of the published code."""

_LAYOUT_PLUS = Layout(
    kernel=7,
    channels=96,
    fires={
        "fire2": (96, 64),
        "fire3": (96, 64),
        "fire4": (192, 128),
        "fire5": (192, 128),
        "fire6": (288, 192),
        "fire7": (288, 192),
        "fire8": (384, 256),
        "fire9": (384, 256),
        "fire10": (384, 256),
        "fire11": (384, 256),
    },
    pooled=("fire4", "fire8"),
)
"""nets/squeezeDetPlus.py of the published code."""


class Fire(nn.Module):
    """Squeeze by 1x1, expand by 1x1 and 3x3 side by side (SqueezeNet, arXiv:1602.07360)."""

    def __init__(self, channels: int, squeeze: int, expand: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(channels, squeeze, 1)
        self.expand1x1 = nn.Conv2d(squeeze, expand, 1)
        self.expand3x3 = nn.Conv2d(squeeze, expand, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        squeezed = F.relu(self.squeeze(x), inplace=True)
        return F.relu(torch.cat((self.expand1x1(squeezed), self.expand3x3(squeezed)), 1), inplace=True)


class SeededDropout(nn.Module):
    """Dropout that draws from a generator of its own, so that training resumes exactly; identity in eval mode."""

    def __init__(self, probability: float) -> None:
        super().__init__()
        self.probability = probability
        self.generator: torch.Generator | None = None

    def forward(self, x: Tensor) -> Tensor:
        if not self.training or self.probability == 0:
            return x
        # A byte an element, eight from one draw: uniform floats would take a tenth of a training step.
        draws = torch.randint(-(2**63), 2**63 - 1, (-(-x.numel() // 8),), generator=self.generator)
        keep = draws.view(torch.uint8)[: x.numel()].view(x.shape) >= round(self.probability * 256)
        return x * keep.to(x) / (1 - self.probability)


@dataclass(frozen=True, slots=True)
class Assignment:
    """Which anchors answer for which objects; holds no gradient. K objects of the batch that are not ignored.

    image, anchor (K,) int64; confidence (K,), the IoU of predicted and true box; deltas (K, 4); labels (K,) int64;
    negative (B, A) bool, the anchors that must stay silent; alarm (B, A) bool, those of them whose predicted boxes
    meet no object (IoU of at least 0.5). found_by (K,) int64: the most confident of the anchors whose predicted
    boxes meet the object; found (K,) bool: whether there is any.
    """

    image: Tensor
    anchor: Tensor
    confidence: Tensor
    deltas: Tensor
    labels: Tensor
    negative: Tensor
    alarm: Tensor
    found_by: Tensor
    found: Tensor


class SqueezeDet(Detector):
    """SqueezeDet for images of any size: padded right and below to a multiple of 16 px, never resized.

    In eval mode with all weights frozen it runs as `detectors.frozen` has it. gradient_precision: what passes
    compute in that a gradient to the images may follow, and `glance`; the others, which judge, always use the
    weights' own.
    trained_by: the loss, as published or `detectors.quality`'s; weights files do not carry it.
    """

    name = "squeezedet"
    fresh_layers = ("convdet.", "fires.fire10.", "fires.fire11.")
    layout = _LAYOUT

    def __init__(
        self,
        classes: tuple[str, ...] = CLASSES,
        t_star: float = 0.5,
        dropout: float = 0.5,
        anchors: Sequence[Sequence[float]] = ANCHOR_SIZES_WH,
    ) -> None:
        """anchors: width and height of each, px, as many as wanted (see `detectors.anchors`). Raises ValueError
        where they are no such pairs.
        """
        super().__init__()
        self.classes = tuple(classes)
        self.t_star = t_star
        self.anchors = _checked_sizes(anchors)
        self.conv1 = nn.Conv2d(3, self.layout.channels, self.layout.kernel, stride=2)
        inputs, fires = self.layout.channels, {}
        for name, (squeeze, expand) in self.layout.fires.items():
            fires[name] = Fire(inputs, squeeze, expand)
            inputs = 2 * expand
        self.fires = nn.ModuleDict(fires)
        self.dropout = SeededDropout(dropout)
        self.convdet = nn.Conv2d(inputs, len(self.anchors) * (len(self.classes) + 1 + 4), 3, padding=1)
        self.trained_by: Literal["published", "quality"] = "published"
        self.gradient_precision: torch.dtype | None = None
        self._nets: dict[torch.dtype, tuple[object, frozen.FrozenNet]] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Without the frozen layers, which are made anew: oneDNN's weights can neither be copied nor pickled."""
        return self.__dict__ | {"_nets": {}}

    @torch.no_grad()
    def initialise(self, generator: torch.Generator) -> None:
        """Draw all weights anew: He for the backbone, near zero for ConvDet (as published), anchors silent."""
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                std = (2 / (module.weight[0].numel())) ** 0.5
                module.weight.normal_(0.0, 1e-3 if module is self.convdet else std, generator=generator)
                if module.bias is not None:
                    module.bias.zero_()
        count = len(self.anchors)
        first = count * len(self.classes)
        if self.convdet.bias is not None:
            self.convdet.bias[first : first + count] = -2.0  # sigmoid 0.12: most anchors see no object

    @torch.no_grad()
    def load_backbone(self, tensors: dict[str, Tensor]) -> None:
        """Take conv1 and fire2 to fire9 from SqueezeNet 1.1 (names as in `state_dict`); other layers stay.

        Raises ValueError where one of these tensors is missing or of another shape.
        """
        for key, own in self.state_dict().items():
            if key.startswith(self.fresh_layers):
                continue
            if key not in tensors or tensors[key].shape != own.shape:
                found = tuple(tensors[key].shape) if key in tensors else "none"
                raise ValueError(f"backbone: {key}: expected shape {tuple(own.shape)}, found {found}")
            own.copy_(tensors[key])

    def forward(self, images: Tensor) -> RawPredictions:
        """images (B, 3, H, W), RGB in [0, 1]; A = K * ceil(H / 16) * ceil(W / 16) for K anchors, cells row by row,
        K each.
        """
        if images.ndim != 4 or images.shape[1] != 3:
            raise ValueError(f"images: expected shape (B, 3, H, W), found {tuple(images.shape)}")
        height, width = int(images.shape[2]), int(images.shape[3])
        if not self.training and not any(parameter.requires_grad for parameter in self.parameters()):
            coarse = torch.is_grad_enabled() and images.requires_grad
            return self._interpret(self._frozen(coarse)(images), (height, width))
        mean = images.new_tensor(BGR_MEAN).view(1, 3, 1, 1)
        x = images.flip(1) * 255.0 - mean
        # To a multiple of 16, and for conv1 as TensorFlow's SAME: stride 2 needs an odd number of rows more,
        # the larger half of them below and to the right. Zeros here are the mean colour.
        before = frozen.rows_before(self.layout.kernel)
        x = F.pad(x, (before, -width % grid.STRIDE + before + 1, before, -height % grid.STRIDE + before + 1))
        x = x.contiguous(memory_format=torch.channels_last)
        return self._interpret(self.after(self.conv1(x)), (height, width))

    @torch.no_grad()
    def glance(self, images: Tensor) -> RawPredictions:
        """See `Detector`."""
        if self.training or any(parameter.requires_grad for parameter in self.parameters()):
            return self(images)
        return self._interpret(self._frozen(coarse=True)(images), (int(images.shape[2]), int(images.shape[3])))

    def after(self, convolved: Tensor) -> Tensor:
        """ConvDet's output of what conv1 gives."""
        x = F.relu(_pool(convolved), inplace=True)  # the order does not matter, a quarter of the pixels does
        for name, fire in self.fires.items():
            x = fire(x)
            if name in self.layout.pooled:
                x = _pool(x)
        return self.convdet(self.dropout(x))

    def trunk(self, image_hw: tuple[int, int]) -> Trunk | None:
        """With the order and range of pixels in conv1's weights; None with another precision for gradients."""
        if self.gradient_precision is not None:
            return None
        before = frozen.rows_before(self.layout.kernel)
        top, left = before, before
        bottom, right = (-side % grid.STRIDE + self.layout.kernel - 2 - before for side in image_hw)
        blue, green, red = (level / 255 for level in BGR_MEAN)
        return Trunk(
            _OfPixels(self),
            (red, green, blue),
            (red, green, blue),
            (top, bottom, left, right),
            lambda outputs, hw: self._interpret(outputs[0], hw),
        )

    def _frozen(self, coarse: bool) -> frozen.FrozenNet:
        """The layers as attacks run them, made anew where the weights have changed since. coarse: in the precision
        of gradients.
        """
        dtype = self.conv1.weight.dtype
        if coarse and self.gradient_precision is not None:
            dtype = self.gradient_precision
        state = [(p.data_ptr(), p._version, p.dtype, p.device) for p in self.parameters()]
        known = self._nets.get(dtype)
        if known is None or known[0] != state:
            known = self._nets[dtype] = (state, self._freeze(dtype))
        return known[1]

    @torch.no_grad()
    def _freeze(self, dtype: torch.dtype) -> frozen.FrozenNet:
        fires = [fire for fire in self.fires.values() if isinstance(fire, Fire)]
        following = [*(fire.squeeze for fire in fires[1:]), self.convdet]
        stages = [
            frozen.Stage(
                expansions=(
                    frozen.convolution(fire.expand1x1, [fire.squeeze.out_channels], dtype),
                    frozen.convolution(fire.expand3x3, [fire.squeeze.out_channels], dtype),
                ),
                pools=name in self.layout.pooled,
                following=frozen.convolution(
                    after, [fire.expand1x1.out_channels, fire.expand3x3.out_channels], dtype
                ),
            )
            for name, fire, after in zip(self.fires, fires, following, strict=True)
        ]
        first = frozen.convolution(fires[0].squeeze, [self.conv1.out_channels], dtype)
        return frozen.FrozenNet(frozen.stem(self.conv1, BGR_MEAN, first, dtype), tuple(stages), grid.STRIDE)

    def loss(self, raw: RawPredictions, targets: Sequence[Targets]) -> dict[str, Tensor]:
        """The terms of `loss_terms`, or those of `detectors.quality` in their place where it trains. What they aim
        at is taken as constant, as in the published code.
        """
        assignment = self.assign(raw, targets)
        terms = self.loss_terms(raw, assignment)
        if self.trained_by == "quality":
            own = assignment.image, assignment.anchor
            learned = quality.terms(raw, targets, self.anchors, own, assignment.negative)
            terms |= learned | {"total": learned["confidence"] + learned["box"] + learned["class"]}
        return terms

    @torch.no_grad()
    def assign(self, raw: RawPredictions, targets: Sequence[Targets]) -> Assignment:
        """Give each object the anchor of highest IoU that is not taken yet; the nearest one where none overlaps.

        Raises ValueError where targets and images differ in number, or a label is no class of this detector.
        """
        if len(targets) != len(raw):
            raise ValueError(f"targets: expected {len(raw)}, one for each image, found {len(targets)}")
        height, width = raw.image_hw
        like = raw.deltas
        cells = grid.cells(raw.image_hw)
        anchors_cxcywh = grid.anchors(self.anchors, *cells, like.dtype, like.device)
        anchors_xyxy = grid.anchor_corners(self.anchors, *cells, like.dtype, like.device)
        negative = torch.ones(raw.confidence_logits.shape, dtype=torch.bool, device=like.device)
        met = torch.zeros_like(negative)
        image, anchor, true_boxes, labels, meeting = [], [], [], [], []
        for b, target in enumerate(targets):
            ignore = target.ignore.to(like.device)
            # Regions are named once for each class.
            ignored_xyxy = torch.unique(target.boxes_xyxy.to(like)[ignore], dim=0)
            wanted_xyxy = target.boxes_xyxy.to(like)[~ignore]
            if len(ignored_xyxy):
                negative[b] = ~(
                    grid.covered(anchors_xyxy, ignored_xyxy) | grid.covered(raw.boxes_xyxy[b], ignored_xyxy)
                )
            anchor += grid.distribute(wanted_xyxy, anchors_cxcywh, anchors_xyxy)
            image += [b] * len(wanted_xyxy)
            true_boxes.append(wanted_xyxy)
            meets = boxes.iou_matrix(wanted_xyxy, raw.boxes_xyxy[b]) >= grid.MEETING_IOU
            met[b] = meets.any(0)
            meeting.append(raw.confidence_logits[b].expand_as(meets).masked_fill(~meets, -torch.inf).max(1))
            labels.append(target.labels.to(like.device)[~ignore])
        image = torch.tensor(image, dtype=torch.int64, device=like.device)
        anchor = torch.tensor(anchor, dtype=torch.int64, device=like.device)
        truth_xyxy, label = torch.cat(true_boxes), torch.cat(labels)
        if bool(((label < 0) | (label >= len(self.classes))).any()):
            raise ValueError(f"targets.labels: expected 0..{len(self.classes) - 1}, found {label.tolist()}")
        negative[image, anchor] = False
        return Assignment(
            image=image,
            anchor=anchor,
            confidence=boxes.paired_iou(boxes.clip(raw.boxes_xyxy[image, anchor], height, width), truth_xyxy),
            deltas=grid.offsets(truth_xyxy, anchors_cxcywh[anchor]),
            labels=label,
            negative=negative,
            alarm=negative & ~met,
            found_by=torch.cat([m.indices for m in meeting]),
            found=torch.cat([m.values for m in meeting]) > -torch.inf,
        )

    def loss_terms(self, raw: RawPredictions, assignment: Assignment) -> dict[str, Tensor]:
        """The three terms over the whole batch, each weighted as published, their sum, and what attacks raise.

        Box and class: a mean over the batch's objects. Confidence: each image's sum over anchors, weighted by
        75 / objects of the batch where an object is and by 100 / the other anchors of one image elsewhere; then a
        mean over images. So false alarms weigh the more, against misses, the larger the batch.

        "objectness" is the confidence term as attacks want it: an object counts by the most confident of the
        anchors whose boxes meet it, and the target is 1; the others that meet it, which decoding drops, are no
        false alarms. A trained detector meets the published target, so that term starts at its minimum, and
        raising it makes an object more certain as readily as less.
        """
        image, anchor = assignment.image, assignment.anchor
        objects = max(len(image), 1)
        confidence = torch.sigmoid(raw.confidence_logits)
        missed = (confidence[image, anchor] - assignment.confidence).square().sum() / objects
        found = torch.where(assignment.found, confidence[image, assignment.found_by], 0.0)
        unseen = (1 - found).square().sum() / objects
        batch, anchors = confidence.shape
        silent = max(anchors - len(image), 1)
        active = torch.where(assignment.negative, confidence, 0.0).square()
        heard, alarms = active.sum() / silent, torch.where(assignment.alarm, active, 0.0).sum() / silent
        box = (raw.deltas[image, anchor] - assignment.deltas).square().sum() / objects
        classes = F.cross_entropy(raw.class_logits[image, anchor], assignment.labels, reduction="sum") / objects
        terms = {
            "confidence": (WEIGHT_CONFIDENCE_POSITIVE * missed + WEIGHT_CONFIDENCE_NEGATIVE * heard) / batch,
            "box": WEIGHT_BOX * box,
            "class": WEIGHT_CLASS * classes,
        }
        return terms | {
            "total": terms["confidence"] + terms["box"] + terms["class"],
            "objectness": (WEIGHT_CONFIDENCE_POSITIVE * unseen + WEIGHT_CONFIDENCE_NEGATIVE * alarms) / batch,
        }

    def candidates(self, raw: RawPredictions) -> Candidates:
        """Every anchor; score = confidence x class probability."""
        # Class by class: along so few numbers beside each other a softmax takes ten times as long.
        logs = F.logsigmoid(raw.confidence_logits[0])[:, None] + F.log_softmax(raw.class_logits[0].T, 0).T
        return Candidates(raw.boxes_xyxy[0][:, None], logs)

    @torch.no_grad()
    def decode(self, raw: RawPredictions) -> list[Detections]:
        """Score = confidence x class probability; the 1024 best, NMS at 0.35 in each class, score >= 0.005."""
        found = []
        for b, confidence in enumerate(torch.sigmoid(raw.confidence_logits)):
            # No score exceeds its confidence, and few of the anchors have any.
            (likely,) = torch.nonzero(confidence >= SCORE_MINIMUM, as_tuple=True)
            probability, label = torch.softmax(raw.class_logits[b, likely], -1).max(-1)
            score = confidence[likely] * probability
            top = torch.sort(score, descending=True, stable=True).indices[:TOP_DETECTIONS]
            top = top[score[top] >= SCORE_MINIMUM]
            clipped = boxes.clip(raw.boxes_xyxy[b, likely[top]], *raw.image_hw)
            keep = boxes.nms(clipped, score[top], NMS_IOU, label[top])
            found.append(Detections(clipped[keep], label[top][keep], score[top][keep]))
        return found

    def _interpret(self, output: Tensor, image_hw: tuple[int, int]) -> RawPredictions:
        """Split ConvDet's channels (B, K * (C + 1 + 4), gh, gw): class scores, confidences, deltas."""
        batch, _, rows, columns = output.shape
        count, classes = len(self.anchors), len(self.classes)
        cells = output.permute(0, 2, 3, 1)
        if cells.dtype in (torch.bfloat16, torch.float16):  # boxes need more than their 8 or 11 bits
            cells = cells.float()
        class_logits, confidence, deltas = cells.split((count * classes, count, count * 4), -1)
        anchors = grid.anchors(self.anchors, rows, columns, cells.dtype, cells.device)
        deltas = deltas.reshape(batch, -1, 4)
        centre = anchors[:, :2] + deltas[..., :2] * anchors[:, 2:]
        size = anchors[:, 2:] * grid.safe_exp(deltas[..., 2:])
        return RawPredictions(
            boxes_xyxy=torch.cat((centre - size / 2, centre + size / 2), -1),
            deltas=deltas,
            class_logits=class_logits.reshape(batch, -1, classes),
            confidence_logits=confidence.reshape(batch, -1),
            image_hw=image_hw,
        )


class _OfPixels(nn.Module):
    """The layers of a SqueezeDet, for padded RGB in [0, 1] less the mean."""

    def __init__(self, detector: SqueezeDet) -> None:
        super().__init__()
        self.detector = detector
        self.weight = detector.conv1.weight.detach().flip(1) * 255

    def forward(self, x: Tensor) -> Tensor:
        return self.detector.after(F.conv2d(x, self.weight, self.detector.conv1.bias, 2))


class SqueezeDetPlus(SqueezeDet):
    """SqueezeDet+ of the same paper: a wider stem and wider squeezes, over three times the weights. Its conv1 is
    padded as SqueezeDet's is, where the published one leaves the border out.
    """

    name = "squeezedet-plus"
    fresh_layers = ("",)
    layout = _LAYOUT_PLUS


def _checked_sizes(anchors: Sequence[Sequence[float]]) -> grid.Sizes:
    sizes = tuple(tuple(float(number) for number in size) for size in anchors)
    if not sizes or any(len(size) != 2 or not all(0 < number < math.inf for number in size) for size in sizes):
        raise ValueError(f"anchors: expected pairs of positive px, at least one, found {sizes}")
    return tuple((width, height) for width, height in sizes)


def _pool(x: Tensor) -> Tensor:
    # TensorFlow's SAME on an even size: the last window reaches one pixel beyond the edge.
    return F.max_pool2d(x, 3, stride=2, ceil_mode=True)
