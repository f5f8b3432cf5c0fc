"""The detector contract: images to raw predictions to detections and, with gradients, to a loss.

`detectors.check.check_detector` tests an implementation; docs/reference/detectors.md describes it with an example.
"""

from __future__ import annotations

import sys
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

from detectors.types import Detections, Targets

N = TypeVar("N", bound=nn.Module)
R = TypeVar("R")


class DetectorError(ValueError):
    """A detector that cannot be loaded: unknown name, missing file, or weights of another detector."""


def describe_error(error: Exception) -> str:
    """An error of user code with its location: `ValueError: why (mine.py:12, in forward)`.

    The location is the innermost frame outside installed libraries and this package.
    """
    if isinstance(error, SyntaxError) and error.filename:  # the file was never run
        return f"{type(error).__name__}: {error.msg} ({Path(error.filename).name}:{error.lineno})"
    frame = (user_code_frames(error) or traceback.extract_tb(error.__traceback__))[-1]
    message = " ".join(str(error).split())[:300]
    return f"{type(error).__name__}: {message} ({Path(frame.filename).name}:{frame.lineno}, in {frame.name})"


def user_code_frames(error: Exception) -> list[traceback.FrameSummary]:
    """Frames of an error's traceback outside installed libraries and this package."""
    frames = traceback.extract_tb(error.__traceback__)
    package = str(Path(__file__).parent)
    return [f for f in frames if "site-packages" not in f.filename and not f.filename.startswith(package)]


@runtime_checkable
class RawPredictions(Protocol):
    """The output of `Detector.forward` for a batch. Only these two methods are prescribed."""

    def __len__(self) -> int:
        """Number of images."""
        ...

    def select(self, index: int) -> RawPredictions:
        """The predictions of one image, as a batch of one."""
        ...


@runtime_checkable
class InjectablePredictions(Protocol):
    """Raw predictions into which a test can inject a prediction."""

    def inject(self, box_xyxy: Tensor, label: int) -> Any:
        """A copy with this box (4,) px as the only confident prediction in each image."""
        ...


@runtime_checkable
class SuppressiblePredictions(Protocol):
    """Raw predictions that support lowering the scores of one class, as planted faults do."""

    def suppress(self, label: int, by: Tensor) -> Any:
        """A copy with the class's logits lowered by `by` (B, A), one value per candidate."""
        ...


CERTAIN = 20.0
"""Logit of a certain prediction: its sigmoid differs from 1 by 2e-9."""


@dataclass(frozen=True, slots=True)
class AnchorPredictions:
    """Output of an anchor-based network before any selection; differentiable."""

    boxes_xyxy: Tensor
    """(B, A, 4) px of the input image, not clipped."""
    deltas: Tensor
    """(B, A, 4) raw outputs of the box head."""
    class_logits: Tensor
    """(B, A, C)."""
    confidence_logits: Tensor
    """(B, A)."""
    image_hw: tuple[int, int]
    """Size of the input image, px."""

    def __post_init__(self) -> None:
        b, a = self.confidence_logits.shape
        c = self.class_logits.shape[-1]
        for name, shape in {"boxes_xyxy": (b, a, 4), "deltas": (b, a, 4), "class_logits": (b, a, c)}.items():
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise ValueError(f"raw.{name}: expected shape {shape}, found {found}")

    def __len__(self) -> int:
        return int(self.confidence_logits.shape[0])

    def select(self, index: int) -> AnchorPredictions:
        """The predictions of one image, as a batch of one."""
        names = ("boxes_xyxy", "deltas", "class_logits", "confidence_logits")
        return replace(self, **{name: getattr(self, name)[index : index + 1] for name in names})

    def to_host(self) -> AnchorPredictions:
        """The predictions on the CPU, without gradients; from a GPU in one transfer."""
        if not self.boxes_xyxy.is_cuda:
            return self
        parts = (self.boxes_xyxy, self.deltas, self.class_logits, self.confidence_logits[..., None])
        moved = torch.cat([part.detach() for part in parts], -1).cpu()
        boxes_xyxy, deltas, classes, confidence = moved.split([part.shape[-1] for part in parts], -1)
        return AnchorPredictions(boxes_xyxy, deltas, classes, confidence[..., 0], self.image_hw)

    def inject(self, box_xyxy: Tensor, label: int) -> AnchorPredictions:
        """A copy with this box as the only confident prediction in each image, at the first anchor."""
        boxes, classes = self.boxes_xyxy.clone(), torch.full_like(self.class_logits, -CERTAIN)
        confidence = torch.full_like(self.confidence_logits, -CERTAIN)
        boxes[:, 0] = box_xyxy.to(boxes)
        classes[:, 0, label] = CERTAIN
        confidence[:, 0] = CERTAIN
        return replace(self, boxes_xyxy=boxes, class_logits=classes, confidence_logits=confidence)

    def suppress(self, label: int, by: Tensor) -> AnchorPredictions:
        """A copy with confidence logits lowered by `by` (B, A) where `label` is the likeliest class."""
        likeliest = self.class_logits.argmax(-1) == label
        return replace(self, confidence_logits=self.confidence_logits - torch.where(likeliest, by, 0.0))


def lower_probability(probability: Tensor, by: Tensor) -> Tensor:
    """Probabilities (...) after lowering their logits by `by` (...); exact near 0 and 1."""
    return probability * torch.exp(-by) / (1 + probability * torch.expm1(-by))


@dataclass(frozen=True, slots=True)
class Candidates:
    """Scored boxes of one image before suppression; differentiable."""

    boxes_xyxy: Tensor
    """(A, K, 4) px, not clipped: K is 1, or C where each class has its own box."""
    log_scores: Tensor
    """(A, C) logarithms of the scores that `decode` gives, per class."""

    def __post_init__(self) -> None:
        a, c = self.log_scores.shape
        found = tuple(self.boxes_xyxy.shape)
        if found not in ((a, 1, 4), (a, c, 4)):
            raise ValueError(f"candidates: expected boxes of shape {(a, 1, 4)} or {(a, c, 4)}, found {found}")

    def boxes_for_class(self, label: int) -> Tensor:
        """Boxes (A, 4) px of one class."""
        return self.boxes_xyxy[:, label if self.boxes_xyxy.shape[1] > 1 else 0]


@dataclass(frozen=True, slots=True)
class DetectorStages:
    """A detector split into padding, network and decoding for one image size; used by `detectors.incremental`."""

    network: nn.Module
    """Maps a padded image (1, 3, H, W), RGB in [0, 1] minus `mean`, to one or several tensors; in eval mode and
    traceable by torch.fx."""
    mean: tuple[float, float, float]
    """RGB subtracted from the image."""
    fill: tuple[float, float, float]
    """RGB of the padding."""
    padding: tuple[int, int, int, int]
    """Rows above and below, columns left and right."""
    interpret: Callable[[Sequence[Tensor], tuple[int, int]], AnchorPredictions]
    """Maps the network's outputs and the image's (height, width) to the output of `Detector.forward`."""

    @property
    def image_origin(self) -> tuple[int, int]:
        """Row and column of the image's first pixel in the padded image."""
        return self.padding[0], self.padding[2]

    def pad_image(self, image: Tensor) -> Tensor:
        """The network's input for an image (1, 3, h, w)."""
        top, bottom, left, right = self.padding
        height, width = int(image.shape[2]), int(image.shape[3])
        mean, fill = (image.new_tensor(level).view(1, 3, 1, 1) for level in (self.mean, self.fill))
        padded = (fill - mean).repeat(1, 1, top + height + bottom, left + width + right)
        padded[:, :, top : top + height, left : left + width] = image - mean
        return padded.contiguous(memory_format=torch.channels_last)


@runtime_checkable
class Predictor(Protocol):
    """A detector without a gradient: `Detector` without loss and t*. `decode` takes the output of `forward`."""

    name: str
    """Shown in reports."""
    classes: tuple[str, ...]
    """Class names that labels index; with "Car" if the detector knows cars."""

    def forward(self, images: Tensor) -> Any:
        """images (B, 3, H, W), RGB in [0, 1], any size."""
        ...

    def decode(self, raw: Any) -> list[Detections]:
        """One Detections per image, best first, boxes inside the image; no gradient."""
        ...


def explain_missing_gradient(predictor: Predictor) -> str:
    """Why a detector that could have had a gradient has none, in brackets; empty if it could not."""
    reason = getattr(predictor, "gradient_obstacle", "")
    return f" ({reason})" if reason else ""


def detector_device(predictor: Predictor) -> torch.device:
    """The device of a detector's weights; the CPU if it has no visible weights."""
    tensors = chain(predictor.parameters(), predictor.buffers()) if isinstance(predictor, nn.Module) else ()
    first = next(iter(tensors), None)
    return torch.device("cpu") if first is None else first.device


def disable_tf32(device: str | torch.device) -> None:
    """Make a GPU convolve in float32: cuDNN defaults to TF32 with its 10-bit mantissa."""
    if torch.device(device).type == "cuda":
        torch.backends.cudnn.allow_tf32 = False


def prepare_for_inference(network: N, device: str | torch.device = "cpu") -> N:
    """The network on a device, frozen, in eval mode and channels-last."""
    disable_tf32(device)
    network.requires_grad_(False)
    return network.to(device=device, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]


@torch.no_grad()
def predict(predictor: Predictor, images: Tensor) -> list[Detections]:
    """One Detections per image (B, 3, H, W), RGB in [0, 1]; in halves when device memory runs out."""
    return run_in_halves(lambda part: predictor.decode(predictor.forward(part)), images, "images")


def run_in_halves(work: Callable[[Any], list[R]], items: Any, what: str) -> list[R]:
    """Process all items at once; when device memory runs out, each half on its own, recursively.

    Args:
        work: Maps items to one result each.
        items: A sequence or a tensor.
        what: Plural noun for the items, used in the line on standard error.

    Returns:
        One result per item.

    Raises:
        torch.OutOfMemoryError: A single item does not fit.
    """
    try:
        return work(items)
    except torch.OutOfMemoryError:
        if len(items) < 2:
            raise
    # After the except block: the error holds on to the tensors that filled the memory.
    half = -(-len(items) // 2)
    free_device_memory(f"{len(items)} {what} at once exceed the device's memory: trying {half}")
    return [*run_in_halves(work, items[:half], what), *run_in_halves(work, items[half:], what)]


def free_device_memory(line: str) -> None:
    """Empty the GPU's cache and write the reason to standard error."""
    if torch.cuda.is_available():
        torch.cuda.empty_cache()
    sys.stderr.write(f"drivesem: {line}\n")


class Detector(nn.Module, ABC):
    """A differentiable detector.

    It takes images as they are: normalisation, padding and resizing are part of `forward`, and boxes are px of the
    given image. Once all weights are frozen (`requires_grad_(False)`) it stays in eval mode, also after `train()`,
    so that neither dropout nor normalisation statistics change during an attack.
    """

    name: str
    """Shown in reports."""
    classes: tuple[str, ...]
    """Class names that labels index."""
    t_star: float
    """Score of best F1 on benign frames, in [0, 1]."""
    fresh_layers: tuple[str, ...] = ()
    """Name prefixes of the parameters that no pretrained backbone provides."""

    @property
    def is_frozen(self) -> bool:
        """Whether it is in eval mode with all weights frozen."""
        return not self.training and not any(parameter.requires_grad for parameter in self.parameters())

    @abstractmethod
    def forward(self, images: Tensor) -> Any:
        """Images (B, 3, H, W), RGB in [0, 1], any size, to `RawPredictions`; differentiable to the images."""

    @abstractmethod
    def loss(self, raw: Any, targets: Sequence[Targets]) -> dict[str, Tensor]:
        """Scalar loss terms by name, from the output of `forward` and one Targets per image.

        Two are required. "total" is the training loss, the sum of the detector's terms (SqueezeDet: "confidence",
        "box", "class"). "objectness" falls as confidences of objects approach 1 and all others approach 0; attacks
        raise it. Ignored targets count as neither.

        Raises:
            ValueError: Targets and images differ in number, or a label is not one of the classes.
        """

    @abstractmethod
    def decode(self, raw: Any) -> list[Detections]:
        """One Detections per image, best first, boxes inside the image; no gradient."""

    def candidates(self, raw: Any) -> Candidates:
        """The candidates of `decode` for a batch of one image; used by the attack objectives.

        Raises:
            DetectorError: The detector does not provide candidates.
        """
        raise DetectorError(f"detector {self.name}: expected one that provides its candidates")

    @torch.no_grad()
    def forward_for_search(self, images: Tensor) -> Any:
        """`forward` without a gradient, for proposals that are evaluated again; may use the lower precision."""
        return self(images)

    def stages(self, image_hw: tuple[int, int]) -> DetectorStages | None:
        """The detector's stages for images (height, width) with the present weights; None if it has none."""
        return None

    @contextmanager
    def freeze_choices(self, raw: Any) -> Iterator[None]:
        """Make `forward` repeat the choices made for `raw` that its gradient treats as constant.

        This makes finite differences comparable with the gradient. Most detectors make no such choices.
        """
        yield

    def train(self, mode: bool = True) -> Self:
        """Set training mode, unless all weights are frozen."""
        return super().train(mode and any(parameter.requires_grad for parameter in self.parameters()))

    def requires_grad_(self, requires_grad: bool = True) -> Self:
        """Set `requires_grad` of all weights; freezing also sets eval mode."""
        super().requires_grad_(requires_grad)
        return self if requires_grad else self.eval()


class DetectorWrapper(Detector):
    """A detector that delegates to `inner`; subclasses override `forward`."""

    def __init__(self, inner: Detector) -> None:
        super().__init__()
        self.inner = inner
        self.name, self.classes, self.t_star = inner.name, inner.classes, inner.t_star
        self.fresh_layers = tuple(f"inner.{prefix}" for prefix in inner.fresh_layers)

    def loss(self, raw: Any, targets: Sequence[Targets]) -> dict[str, Tensor]:
        """The inner detector's loss."""
        return self.inner.loss(raw, targets)

    def decode(self, raw: Any) -> list[Detections]:
        """The inner detector's detections."""
        return self.inner.decode(raw)

    def candidates(self, raw: Any) -> Candidates:
        """The inner detector's candidates."""
        return self.inner.candidates(raw)

    @contextmanager
    def freeze_choices(self, raw: Any) -> Iterator[None]:
        """The inner detector's `freeze_choices`."""
        with self.inner.freeze_choices(raw):
            yield
