"""SqueezeDet (Wu et al., 2017, arXiv:1612.01051): SqueezeNet 1.1 layers, two more Fire modules, ConvDet.

Departures from the published code: anchor centres lie in the middle of their 16 px cell instead of being spread
over the image as (i + 1) * width / (cells + 1), so that images may have any size (at 1248x384 the two differ by
less than a cell); and the class term is the cross-entropy of the true class, as in the paper, whereas the code
adds that of not being any other class.
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
from detectors.base import AnchorPredictions, Candidates, Detector, DetectorStages
from detectors.types import CLASSES, Detections, Targets

ANCHOR_SIZES_WH = (
    *((36.0, 37.0), (366.0, 174.0), (115.0, 59.0)),
    *((162.0, 87.0), (38.0, 90.0), (258.0, 173.0)),
    *((224.0, 108.0), (78.0, 170.0), (72.0, 43.0)),
)
"""Anchor shapes in pixels: config/kitti_squeezeDet_config.py of the published code."""

BGR_MEAN = (103.939, 116.779, 123.68)
"""Subtracted from pixels in 0..255: ImageNet's mean, with which the backbone was trained."""

WEIGHT_BOX = 5.0
WEIGHT_CONFIDENCE_POSITIVE = 75.0
WEIGHT_CONFIDENCE_NEGATIVE = 100.0
WEIGHT_CLASS = 1.0
"""Weights of the loss terms (published code, LOSS_COEF_*)."""

TOP_DETECTIONS = 1024
NMS_IOU = 0.35
SCORE_MINIMUM = 0.005
"""Decoding (published code: TOP_N_DETECTION, NMS_THRESH, PROB_THRESH). The published code takes only the 64 best
boxes, which in full streets all belong to near cars, and suppresses from IoU 0.4 on; 0.35 was better on training
frames (Car AP50 0.982, at 0.4 0.974, at 0.3 0.976).
"""


@dataclass(frozen=True, slots=True)
class SqueezeDetLayout:
    """Layers up to ConvDet."""

    kernel: int
    """Size of conv1, stride 2."""
    channels: int
    """Output channels of conv1."""
    fires: dict[str, tuple[int, int]]
    """Channels of the squeeze and of each of the two expansions, by name."""
    pooled: tuple[str, str]
    """Fires followed by 3x3/2 max pooling, as is conv1."""


def _name_fires(*channels: tuple[int, int]) -> dict[str, tuple[int, int]]:
    """Channels by name, from fire2 on; each entry applies to two Fires."""
    return {f"fire{i}": channels[i // 2 - 1] for i in range(2, 2 * len(channels) + 2)}


_LAYOUT = SqueezeDetLayout(
    kernel=3,
    channels=64,
    fires=_name_fires((16, 64), (32, 128), (48, 192), (64, 256), (96, 384)),
    pooled=("fire3", "fire5"),
)
"""nets/squeezeDet.py of the published code."""

_LAYOUT_PLUS = SqueezeDetLayout(
    kernel=7,
    channels=96,
    fires=_name_fires((96, 64), (192, 128), (288, 192), (384, 256), (384, 256)),
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
    """Dropout with its own random generator, so that training resumes exactly; identity in eval mode."""

    def __init__(self, probability: float) -> None:
        super().__init__()
        self.probability = probability
        self.generator: torch.Generator | None = None

    def forward(self, x: Tensor) -> Tensor:
        if not self.training or self.probability == 0:
            return x
        # One byte per element, eight per draw: uniform floats would take a tenth of a training step.
        draws = torch.randint(-(2**63), 2**63 - 1, (-(-x.numel() // 8),), generator=self.generator)
        keep = draws.view(torch.uint8)[: x.numel()].view(x.shape) >= round(self.probability * 256)
        return x * keep.to(x) / (1 - self.probability)


@dataclass(frozen=True, slots=True)
class AnchorAssignment:
    """Which anchors predict which objects; no gradient. K objects of the batch that are not ignored."""

    image: Tensor
    """(K,) int64."""
    anchor: Tensor
    """(K,) int64."""
    confidence: Tensor
    """(K,) target confidence: IoU of predicted and true box."""
    deltas: Tensor
    """(K, 4) target offsets."""
    labels: Tensor
    """(K,) int64."""
    negative: Tensor
    """(B, A) bool: anchors that should predict nothing."""
    alarm: Tensor
    """(B, A) bool: negatives with a predicted box that matches no object (IoU below 0.5)."""
    found_by: Tensor
    """(K,) int64: the most confident anchor with a predicted box that matches the object."""
    found: Tensor
    """(K,) bool: whether there is one."""


class SqueezeDet(Detector):
    """SqueezeDet for images of any size: padded right and below to a multiple of 16 px, never resized.

    In eval mode with all weights frozen it runs as `detectors.frozen`.
    """

    name = "squeezedet"
    fresh_layers = ("convdet.", "fires.fire10.", "fires.fire11.")
    layout = _LAYOUT
    """Its layers."""

    def __init__(
        self,
        classes: tuple[str, ...] = CLASSES,
        t_star: float = 0.5,
        dropout: float = 0.5,
        anchors: Sequence[Sequence[float]] = ANCHOR_SIZES_WH,
    ) -> None:
        """Build the network without initialising it.

        Args:
            classes: Class names.
            t_star: Score of best F1, in [0, 1].
            dropout: Probability before ConvDet.
            anchors: Width and height of each anchor, px (see `detectors.anchors`).

        Raises:
            ValueError: The anchors are not such pairs.
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
        self._nets: dict[torch.dtype, tuple[object, frozen.FrozenSqueezeDet]] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Without the frozen layers, which are rebuilt: oneDNN's weights can neither be copied nor pickled."""
        return self.__dict__ | {"_nets": {}}

    @torch.no_grad()
    def initialise(self, generator: torch.Generator) -> None:
        """Draw all weights: He for the backbone, near zero for ConvDet (as published), low confidences."""
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                std = (2 / (module.weight[0].numel())) ** 0.5
                module.weight.normal_(0.0, 1e-3 if module is self.convdet else std, generator=generator)
                if module.bias is not None:
                    module.bias.zero_()
        count = len(self.anchors)
        first = count * len(self.classes)
        if self.convdet.bias is not None:
            self.convdet.bias[first : first + count] = -2.0  # sigmoid 0.12: most anchors have no object

    @torch.no_grad()
    def load_backbone(self, tensors: dict[str, Tensor]) -> None:
        """Load conv1 and fire2 to fire9 from SqueezeNet 1.1 (names as in `state_dict`); other layers stay.

        Raises:
            ValueError: A tensor is missing or has another shape.
        """
        for key, own in self.state_dict().items():
            if key.startswith(self.fresh_layers):
                continue
            if key not in tensors or tensors[key].shape != own.shape:
                found = tuple(tensors[key].shape) if key in tensors else "none"
                raise ValueError(f"backbone: {key}: expected shape {tuple(own.shape)}, found {found}")
            own.copy_(tensors[key])

    def forward(self, images: Tensor) -> AnchorPredictions:
        """images (B, 3, H, W), RGB in [0, 1]; A = K * ceil(H / 16) * ceil(W / 16) for K anchors."""
        if images.ndim != 4 or images.shape[1] != 3:
            raise ValueError(f"images: expected shape (B, 3, H, W), found {tuple(images.shape)}")
        height, width = int(images.shape[2]), int(images.shape[3])
        if self.is_frozen:
            coarse = torch.is_grad_enabled() and images.requires_grad
            return self._interpret(self._frozen_layers(coarse)(images), (height, width))
        mean = images.new_tensor(BGR_MEAN).view(1, 3, 1, 1)
        x = images.flip(1) * 255.0 - mean
        # To a multiple of 16, and for conv1 as TensorFlow's SAME: stride 2 needs an odd number of further rows,
        # the larger half of them below and to the right. Zero is the mean colour.
        padding = frozen.leading_padding(self.layout.kernel)
        x = F.pad(x, (padding, -width % grid.STRIDE + padding + 1, padding, -height % grid.STRIDE + padding + 1))
        x = x.contiguous(memory_format=torch.channels_last)
        return self._interpret(self.forward_after_conv1(self.conv1(x)), (height, width))

    @torch.no_grad()
    def forward_for_search(self, images: Tensor) -> AnchorPredictions:
        """As `Detector.forward_for_search`, in `gradient_precision`."""
        if not self.is_frozen:
            return self(images)
        return self._interpret(
            self._frozen_layers(coarse=True)(images), (int(images.shape[2]), int(images.shape[3]))
        )

    def forward_after_conv1(self, convolved: Tensor) -> Tensor:
        """ConvDet's output from conv1's."""
        x = F.relu(_pool(convolved), inplace=True)  # the same result as before pooling, on a quarter of the pixels
        for name, fire in self.fires.items():
            x = fire(x)
            if name in self.layout.pooled:
                x = _pool(x)
        return self.convdet(self.dropout(x))

    def stages(self, image_hw: tuple[int, int]) -> DetectorStages | None:
        """The layers for RGB pixels in [0, 1]; None with another precision for gradients."""
        if self.gradient_precision is not None:
            return None
        padding = frozen.leading_padding(self.layout.kernel)
        top, left = padding, padding
        bottom, right = (-side % grid.STRIDE + self.layout.kernel - 2 - padding for side in image_hw)
        blue, green, red = (level / 255 for level in BGR_MEAN)
        return DetectorStages(
            _RgbNetwork(self),
            (red, green, blue),
            (red, green, blue),
            (top, bottom, left, right),
            lambda outputs, hw: self._interpret(outputs[0], hw),
        )

    def _frozen_layers(self, coarse: bool) -> frozen.FrozenSqueezeDet:
        """The frozen layers, rebuilt after a change of weights. coarse: in the precision of gradients."""
        dtype = self.conv1.weight.dtype
        if coarse and self.gradient_precision is not None:
            dtype = self.gradient_precision
        state = [(p.data_ptr(), p._version, p.dtype, p.device) for p in self.parameters()]
        cached = self._nets.get(dtype)
        if cached is None or cached[0] != state:
            cached = self._nets[dtype] = (state, self._freeze(dtype))
        return cached[1]

    @torch.no_grad()
    def _freeze(self, dtype: torch.dtype) -> frozen.FrozenSqueezeDet:
        fires = [fire for fire in self.fires.values() if isinstance(fire, Fire)]
        following = [*(fire.squeeze for fire in fires[1:]), self.convdet]
        stages = [
            frozen.FrozenFire(
                expansions=(
                    frozen.freeze_convolution(fire.expand1x1, [fire.squeeze.out_channels], dtype),
                    frozen.freeze_convolution(fire.expand3x3, [fire.squeeze.out_channels], dtype),
                ),
                pools=name in self.layout.pooled,
                following=frozen.freeze_convolution(
                    after, [fire.expand1x1.out_channels, fire.expand3x3.out_channels], dtype
                ),
            )
            for name, fire, after in zip(self.fires, fires, following, strict=True)
        ]
        first = frozen.freeze_convolution(fires[0].squeeze, [self.conv1.out_channels], dtype)
        return frozen.FrozenSqueezeDet(
            frozen.freeze_first_layers(self.conv1, BGR_MEAN, first, dtype), tuple(stages), grid.STRIDE
        )

    def loss(self, raw: AnchorPredictions, targets: Sequence[Targets]) -> dict[str, Tensor]:
        """The terms of `loss_terms`, or those of `detectors.quality` if `trained_by` selects them. Targets are
        constants in the gradient, as in the published code.
        """
        assignment = self.assign(raw, targets)
        terms = self.loss_terms(raw, assignment)
        if self.trained_by == "quality":
            own = assignment.image, assignment.anchor
            learned = quality.quality_loss_terms(raw, targets, self.anchors, own, assignment.negative)
            terms |= learned | {"total": learned["confidence"] + learned["box"] + learned["class"]}
        return terms

    @torch.no_grad()
    def assign(self, raw: AnchorPredictions, targets: Sequence[Targets]) -> AnchorAssignment:
        """Assign each object the free anchor of highest IoU or, if none overlaps, the nearest free one.

        Raises:
            ValueError: Targets and images differ in number, or a label is not one of the classes.
        """
        if len(targets) != len(raw):
            raise ValueError(f"targets: expected {len(raw)}, one for each image, found {len(targets)}")
        height, width = raw.image_hw
        like = raw.deltas
        cells, cpu = grid.grid_size(raw.image_hw), torch.device("cpu")
        anchors_xyxy = grid.anchors_xyxy(self.anchors, *cells, like.dtype, like.device)
        anchors = [
            make(self.anchors, *cells, like.dtype, cpu) for make in (grid.anchors_cxcywh, grid.anchors_xyxy)
        ]
        negative = torch.ones(raw.confidence_logits.shape, dtype=torch.bool, device=like.device)
        matched = torch.zeros_like(negative)
        image, anchor, true_boxes, labels, matches = [], [], [], [], []
        for b, target in enumerate(targets):
            # On the CPU, where an attack's targets are: what follows from them alone does not wait for a GPU.
            ignore, target_xyxy = target.ignore.cpu(), target.boxes_xyxy.to(cpu, like.dtype)
            # Ignored regions are listed once per class.
            ignored_xyxy = torch.unique(target_xyxy[ignore], dim=0)
            objects_xyxy = target_xyxy[~ignore]
            anchor += grid.assign_anchors(objects_xyxy, *anchors)
            counts = [len(objects_xyxy), len(ignored_xyxy)]
            moved = torch.cat([objects_xyxy, ignored_xyxy]).to(like.device, non_blocking=True)
            objects_xyxy, ignored_xyxy = moved.split(counts)
            if len(ignored_xyxy):
                negative[b] = ~(
                    grid.covered_by_ignored(anchors_xyxy, ignored_xyxy)
                    | grid.covered_by_ignored(raw.boxes_xyxy[b], ignored_xyxy)
                )
            image += [b] * len(objects_xyxy)
            true_boxes.append(objects_xyxy)
            meets = boxes.iou_matrix(objects_xyxy, raw.boxes_xyxy[b]) >= grid.MEETING_IOU
            matched[b] = meets.any(0)
            matches.append(raw.confidence_logits[b].expand_as(meets).masked_fill(~meets, -torch.inf).max(1))
            labels += target.labels.cpu()[~ignore].tolist()
        if not all(0 <= label < len(self.classes) for label in labels):
            raise ValueError(f"targets.labels: expected 0..{len(self.classes) - 1}, found {labels}")
        indices = torch.tensor([image, anchor, labels], dtype=torch.int64).to(like.device, non_blocking=True)
        image, anchor, label = indices
        truth_xyxy = torch.cat(true_boxes)
        anchors_cxcywh = grid.anchors_cxcywh(self.anchors, *cells, like.dtype, like.device)
        negative[image, anchor] = False
        return AnchorAssignment(
            image=image,
            anchor=anchor,
            confidence=boxes.paired_iou(boxes.clip(raw.boxes_xyxy[image, anchor], height, width), truth_xyxy),
            deltas=grid.encode_boxes(truth_xyxy, anchors_cxcywh[anchor]),
            labels=label,
            negative=negative,
            alarm=negative & ~matched,
            found_by=torch.cat([m.indices for m in matches]),
            found=torch.cat([m.values for m in matches]) > -torch.inf,
        )

    def loss_terms(self, raw: AnchorPredictions, assignment: AnchorAssignment) -> dict[str, Tensor]:
        """The three terms over the batch with the published weights, their sum, and the term that attacks raise.

        Box and class are means over the batch's objects. Confidence is a mean over images of sums over anchors,
        weighted by 75 / objects of the batch for objects and by 100 / other anchors of an image elsewhere; so the
        larger the batch, the more false alarms weigh against misses.

        "objectness" is the confidence term for attacks: an object counts by the most confident anchor with a
        matching box, with target 1, and other matching anchors, which decoding suppresses, are not false alarms. A
        trained detector meets the published target, so that term starts at its minimum, and raising it makes an
        object more confident as readily as less.
        """
        image, anchor = assignment.image, assignment.anchor
        objects = max(len(image), 1)
        confidence = torch.sigmoid(raw.confidence_logits)
        confidence_error = (confidence[image, anchor] - assignment.confidence).square().sum() / objects
        found = torch.where(assignment.found, confidence[image, assignment.found_by], 0.0)
        miss_error = (1 - found).square().sum() / objects
        batch, anchors = confidence.shape
        silent = max(anchors - len(image), 1)
        active = torch.where(assignment.negative, confidence, 0.0).square()
        false, alarms = active.sum() / silent, torch.where(assignment.alarm, active, 0.0).sum() / silent
        box = (raw.deltas[image, anchor] - assignment.deltas).square().sum() / objects
        classes = F.cross_entropy(raw.class_logits[image, anchor], assignment.labels, reduction="sum") / objects
        terms = {
            "confidence": (WEIGHT_CONFIDENCE_POSITIVE * confidence_error + WEIGHT_CONFIDENCE_NEGATIVE * false)
            / batch,
            "box": WEIGHT_BOX * box,
            "class": WEIGHT_CLASS * classes,
        }
        return terms | {
            "total": terms["confidence"] + terms["box"] + terms["class"],
            "objectness": (WEIGHT_CONFIDENCE_POSITIVE * miss_error + WEIGHT_CONFIDENCE_NEGATIVE * alarms) / batch,
        }

    def candidates(self, raw: AnchorPredictions) -> Candidates:
        """Every anchor; score = confidence x class probability."""
        # Class dimension first: a softmax over a short last dimension takes ten times as long.
        logs = F.logsigmoid(raw.confidence_logits[0])[:, None] + F.log_softmax(raw.class_logits[0].T, 0).T
        return Candidates(raw.boxes_xyxy[0][:, None], logs)

    @torch.no_grad()
    def decode(self, raw: AnchorPredictions) -> list[Detections]:
        """Score = confidence x class probability; the 1024 best, NMS at IoU 0.35 per class, score >= 0.005."""
        found = []
        for b, confidence in enumerate(torch.sigmoid(raw.confidence_logits)):
            # A score never exceeds its confidence, and few anchors are confident.
            (likely,) = torch.nonzero(confidence >= SCORE_MINIMUM, as_tuple=True)
            probability, label = torch.softmax(raw.class_logits[b, likely], -1).max(-1)
            score = confidence[likely] * probability
            top = torch.sort(score, descending=True, stable=True).indices[:TOP_DETECTIONS]
            top = top[score[top] >= SCORE_MINIMUM]
            clipped = boxes.clip(raw.boxes_xyxy[b, likely[top]], *raw.image_hw)
            keep = boxes.nms(clipped, score[top], NMS_IOU, label[top])
            found.append(Detections(clipped[keep], label[top][keep], score[top][keep]))
        return found

    def _interpret(self, output: Tensor, image_hw: tuple[int, int]) -> AnchorPredictions:
        """Split ConvDet's channels (B, K * (C + 1 + 4), gh, gw) into class scores, confidences and deltas."""
        batch, _, rows, columns = output.shape
        count, classes = len(self.anchors), len(self.classes)
        cells = output.permute(0, 2, 3, 1)
        if cells.dtype in (torch.bfloat16, torch.float16):  # boxes need more than their 8 or 11 bits
            cells = cells.float()
        class_logits, confidence, deltas = cells.split((count * classes, count, count * 4), -1)
        anchors = grid.anchors_cxcywh(self.anchors, rows, columns, cells.dtype, cells.device)
        deltas = deltas.reshape(batch, -1, 4)
        centre = anchors[:, :2] + deltas[..., :2] * anchors[:, 2:]
        size = anchors[:, 2:] * grid.safe_exp(deltas[..., 2:])
        return AnchorPredictions(
            boxes_xyxy=torch.cat((centre - size / 2, centre + size / 2), -1),
            deltas=deltas,
            class_logits=class_logits.reshape(batch, -1, classes),
            confidence_logits=confidence.reshape(batch, -1),
            image_hw=image_hw,
        )


class _RgbNetwork(nn.Module):
    """The layers of a SqueezeDet for padded RGB in [0, 1] minus the mean."""

    def __init__(self, detector: SqueezeDet) -> None:
        super().__init__()
        self.detector = detector
        self.weight = detector.conv1.weight.detach().flip(1) * 255

    def forward(self, x: Tensor) -> Tensor:
        return self.detector.forward_after_conv1(F.conv2d(x, self.weight, self.detector.conv1.bias, 2))


class SqueezeDetPlus(SqueezeDet):
    """SqueezeDet+ of the same paper: a wider conv1 and wider squeezes, over three times the weights.

    conv1 is padded as in SqueezeDet; the published one omits the border.
    """

    name = "squeezedet-plus"
    fresh_layers = ("",)
    layout = _LAYOUT_PLUS


def _checked_sizes(anchors: Sequence[Sequence[float]]) -> grid.AnchorSizes:
    sizes = tuple(tuple(float(number) for number in size) for size in anchors)
    if not sizes or any(len(size) != 2 or not all(0 < number < math.inf for number in size) for size in sizes):
        raise ValueError(f"anchors: expected pairs of positive px, at least one, found {sizes}")
    return tuple((width, height) for width, height in sizes)


def _pool(x: Tensor) -> Tensor:
    # TensorFlow's SAME on an even size: the last window extends one pixel beyond the edge.
    return F.max_pool2d(x, 3, stride=2, ceil_mode=True)
