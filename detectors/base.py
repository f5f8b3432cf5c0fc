"""The contract of detectors: images to raw predictions, to detections; with gradients, also to a loss.

`detectors.check.check_detector` tests an implementation; docs/detectors.md says what it must do and shows one.
"""

from __future__ import annotations

import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Protocol, Self, TypeVar, runtime_checkable

import torch
from torch import Tensor, nn

from detectors.memory import in_halves
from detectors.types import Detections, Targets

N = TypeVar("N", bound=nn.Module)


class DetectorError(ValueError):
    """A detector that cannot be had: no such name or file, or weights that belong to another one."""


def raised(error: Exception) -> str:
    """What a user's code raised, and where: `ValueError: why (mine.py:12, in forward)`. The place is the innermost
    outside of installed libraries and of this package.
    """
    if isinstance(error, SyntaxError) and error.filename:  # no line of it was run
        return f"{type(error).__name__}: {error.msg} ({Path(error.filename).name}:{error.lineno})"
    place = (outside(error) or traceback.extract_tb(error.__traceback__))[-1]
    said = " ".join(str(error).split())[:300]
    return f"{type(error).__name__}: {said} ({Path(place.filename).name}:{place.lineno}, in {place.name})"


def outside(error: Exception) -> list[traceback.FrameSummary]:
    """The places that an error came through outside of installed libraries and of this package: a user's code."""
    frames = traceback.extract_tb(error.__traceback__)
    home = str(Path(__file__).parent)
    return [f for f in frames if "site-packages" not in f.filename and not f.filename.startswith(home)]


@runtime_checkable
class Raw(Protocol):
    """What any detector with gradients says about a batch of images: its own affair, but for these two."""

    def __len__(self) -> int:
        """Images of the batch."""
        ...

    def one(self, index: int) -> Raw:
        """What is said about one image of the batch, as a batch of one."""
        ...


@runtime_checkable
class Plantable(Protocol):
    """Raw predictions into which a test can put one of its own."""

    def planted(self, box_xyxy: Tensor, label: int) -> Any:
        """The same, but silent about all images except for one certain prediction in each: a box (4,) px."""
        ...


@runtime_checkable
class Lowerable(Protocol):
    """Raw predictions whose scores of one class can be lowered: what faults are planted into."""

    def lowered(self, label: int, by: Tensor) -> Any:
        """The same, scores of that class lowered by logits (B, A), row by row of the candidates."""
        ...


CERTAIN = 20.0
"""A logit that is as good as certain: its sigmoid differs from 1 by 2e-9."""


@dataclass(frozen=True, slots=True)
class RawPredictions:
    """What the network says about each of its A anchors, before any choice is made; differentiable.

    boxes_xyxy (B, A, 4) px of the input image, not clipped; deltas (B, A, 4), the box head's own numbers;
    class_logits (B, A, C); confidence_logits (B, A); image_hw, size of the input image in pixels.
    """

    boxes_xyxy: Tensor
    deltas: Tensor
    class_logits: Tensor
    confidence_logits: Tensor
    image_hw: tuple[int, int]

    def __post_init__(self) -> None:
        b, a = self.confidence_logits.shape
        c = self.class_logits.shape[-1]
        for name, shape in {"boxes_xyxy": (b, a, 4), "deltas": (b, a, 4), "class_logits": (b, a, c)}.items():
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise ValueError(f"raw.{name}: expected shape {shape}, found {found}")

    def __len__(self) -> int:
        return int(self.confidence_logits.shape[0])

    def one(self, index: int) -> RawPredictions:
        """What is said about one image of the batch, as a batch of one."""
        rows = slice(index, index + 1)
        return RawPredictions(
            self.boxes_xyxy[rows],
            self.deltas[rows],
            self.class_logits[rows],
            self.confidence_logits[rows],
            self.image_hw,
        )

    def planted(self, box_xyxy: Tensor, label: int) -> RawPredictions:
        """The same, but for a certain prediction by each image's first anchor, and silence of all others."""
        boxes, classes = self.boxes_xyxy.clone(), torch.full_like(self.class_logits, -CERTAIN)
        confidence = torch.full_like(self.confidence_logits, -CERTAIN)
        boxes[:, 0] = box_xyxy.to(boxes)
        classes[:, 0, label] = CERTAIN
        confidence[:, 0] = CERTAIN
        return replace(self, boxes_xyxy=boxes, class_logits=classes, confidence_logits=confidence)

    def lowered(self, label: int, by: Tensor) -> RawPredictions:
        """The same, but less confident where `label` is the likeliest class; see `Lowerable`."""
        likeliest = self.class_logits.argmax(-1) == label
        return replace(self, confidence_logits=self.confidence_logits - torch.where(likeliest, by, 0.0))


def lowered_probability(probability: Tensor, by: Tensor) -> Tensor:
    """Probabilities (...) whose logits are lowered by so much (...); exact near 0 and 1."""
    return probability * torch.exp(-by) / (1 + probability * torch.expm1(-by))


@dataclass(frozen=True, slots=True)
class Candidates:
    """What a detector would choose from in one image, before suppression; differentiable.

    boxes_xyxy (A, K, 4) px, not clipped: K is 1, or C where each class has a box of its own; log_scores (A, C):
    logarithms of the scores that `decode` gives, class by class.
    """

    boxes_xyxy: Tensor
    log_scores: Tensor

    def __post_init__(self) -> None:
        a, c = self.log_scores.shape
        found = tuple(self.boxes_xyxy.shape)
        if found not in ((a, 1, 4), (a, c, 4)):
            raise ValueError(f"candidates: expected boxes of shape {(a, 1, 4)} or {(a, c, 4)}, found {found}")

    def boxes_of(self, label: int) -> Tensor:
        """Boxes (A, 4) px for one class."""
        return self.boxes_xyxy[:, label if self.boxes_xyxy.shape[1] > 1 else 0]


@dataclass(frozen=True, slots=True)
class Trunk:
    """A detector taken apart, for images of one size: what is around the image, the network, how its outputs are
    read. On it `detectors.incremental` builds.

    network: takes a padded image (1, 3, H, W), RGB in [0, 1] less `mean`, and gives one tensor or several; in eval
    mode, and torch.fx can trace it. fill: the padding's RGB; padding: its rows above and below, columns left and
    right; interpret: of the network's outputs and of the image's height and width what `Detector.forward` gives.
    """

    network: nn.Module
    mean: tuple[float, float, float]
    fill: tuple[float, float, float]
    padding: tuple[int, int, int, int]
    interpret: Callable[[Sequence[Tensor], tuple[int, int]], RawPredictions]

    @property
    def at(self) -> tuple[int, int]:
        """Row and column of the padded image at which the image begins."""
        return self.padding[0], self.padding[2]

    def padded(self, image: Tensor) -> Tensor:
        """What the network takes for an image (1, 3, h, w)."""
        top, bottom, left, right = self.padding
        height, width = int(image.shape[2]), int(image.shape[3])
        mean, around = (image.new_tensor(level).view(1, 3, 1, 1) for level in (self.mean, self.fill))
        whole = (around - mean).repeat(1, 1, top + height + bottom, left + width + right)
        whole[:, :, top : top + height, left : left + width] = image - mean
        return whole.contiguous(memory_format=torch.channels_last)


class Predictor(Protocol):
    """A detector that need have no gradient: what `Detector` is, less loss and t*; detectors of other projects.

    name; classes: labels are indices into it, "Car" among them where it knows cars. What `forward` gives is its
    own affair, `decode` takes it.
    """

    name: str
    classes: tuple[str, ...]

    def forward(self, images: Tensor) -> Any:
        """images (B, 3, H, W), RGB in [0, 1], any size."""
        ...

    def decode(self, raw: Any) -> list[Detections]:
        """One Detections for each image, best first, boxes inside the image; carries no gradient."""
        ...


def device_of(predictor: Predictor) -> torch.device:
    """Where a detector's weights lie, and its images must; the processor, where it has none that are known."""
    known = chain(predictor.parameters(), predictor.buffers()) if isinstance(predictor, nn.Module) else ()
    first = next(iter(known), None)
    return torch.device("cpu") if first is None else first.device


def compute_exactly(device: str | torch.device) -> None:
    """Have a GPU convolve in float32; cuDNN's own choice is TF32, of ten bits."""
    if torch.device(device).type == "cuda":
        torch.backends.cudnn.allow_tf32 = False


def ready(network: N, device: str | torch.device = "cpu") -> N:
    """Frozen, in eval mode, channels-last."""
    compute_exactly(device)
    network.requires_grad_(False)
    return network.to(device=device, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]


@torch.no_grad()
def predict(predictor: Predictor, images: Tensor) -> list[Detections]:
    """What is found in images (B, 3, H, W), RGB in [0, 1]: one Detections for each. Images that are too many
    for the device's memory are looked at in halves.
    """
    return in_halves(lambda part: predictor.decode(predictor.forward(part)), images, "images")


class Detector(nn.Module, ABC):
    """A detector: `name`, `classes` (labels are indices into it), `t_star` (score of best F1 on benign frames).

    It takes images as they are: what normalises, pads or resizes them is part of `forward`, and boxes are px of
    the image that was given. With all weights frozen (`requires_grad_(False)`) it is in eval mode, and `train()`
    does not take it out: neither dropout nor the statistics of a normalisation change while it is attacked.
    """

    name: str
    classes: tuple[str, ...]
    t_star: float
    fresh_layers: tuple[str, ...] = ()
    """Beginnings of the names of those parameters that no pretrained backbone provides."""

    @abstractmethod
    def forward(self, images: Tensor) -> Any:
        """images (B, 3, H, W), RGB in [0, 1], any size, to what `Raw` is; differentiable to the images."""

    @abstractmethod
    def loss(self, raw: Any, targets: Sequence[Targets]) -> dict[str, Tensor]:
        """Scalars by name, of what `forward` gave and one Targets for each image. Two of them all detectors have:

        "total", what training lowers, the sum of the detector's own terms (SqueezeDet: "confidence", "box",
        "class"); and "objectness", which falls as the objects' confidences rise to 1 and those elsewhere fall to
        0: attacks raise it. Ignored targets are neither objects nor elsewhere.

        Raises ValueError where targets and images differ in number, or a label is no class of this detector.
        """

    @abstractmethod
    def decode(self, raw: Any) -> list[Detections]:
        """One Detections for each image, best first, boxes inside the image; carries no gradient."""

    def candidates(self, raw: Any) -> Candidates:
        """What `decode` chooses from, of a batch of one image, for the objectives of drivesem/attack/goals.py.

        Raises DetectorError where a detector does not tell.
        """
        raise DetectorError(f"detector {self.name}: expected one that tells its candidates")

    @torch.no_grad()
    def glance(self, images: Tensor) -> Any:
        """What `forward` gives, without a gradient, for searches, which judge nothing: in the precision of
        gradients, where that is another.
        """
        return self(images)

    def trunk(self, image_hw: tuple[int, int]) -> Trunk | None:
        """The detector taken apart for images (height, width), as its weights are; None where it cannot be."""
        return None

    @contextmanager
    def holding(self, raw: Any) -> Iterator[None]:
        """Inside, `forward` makes those choices that its gradient takes as constant as it made them for `raw`.
        So differences can be held against the gradient. Most detectors make none.
        """
        yield

    def train(self, mode: bool = True) -> Self:
        """Training mode, where there is something to train: with all weights frozen it stays in eval mode."""
        return super().train(mode and any(parameter.requires_grad for parameter in self.parameters()))

    def requires_grad_(self, requires_grad: bool = True) -> Self:
        """Of all weights. Without gradients there is nothing to train, and the detector goes into eval mode."""
        super().requires_grad_(requires_grad)
        return self if requires_grad else self.eval()
