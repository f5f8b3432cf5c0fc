"""Settings of a network trained elsewhere, from a YAML file: its input and the meaning of its outputs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

import torch
import torch.nn.functional as F
import yaml
from torch import Tensor

from detectors.base import DetectorError
from detectors.files import read_text

Resize = Literal["letterbox", "stretch"]
Channels = Literal["rgb", "bgr"]
Activation = Literal["none", "sigmoid", "softmax", "exp"]
BoxFormat = Literal["xyxy", "cxcywh", "xywh", "yxyx"]
Input = Literal["batch", "image", "list"]

MAX_SIDE = 8192
"""Largest side of a network's input, px: far above any real one, to bound memory."""
_MAX_CLASSES = 10_000
_MAX_YAML_BYTES = 1 << 18
NO_CLASS = ""
"""Name of a column of scores that is not a class: the background, or a number COCO never assigned."""

BACKGROUND_NAMES = ("N/A", "no-object", "__background__")
"""Names that lists of classes give to numbers that are not a class."""

COCO_NAMES = (
    "person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat", "traffic light",
    "fire hydrant", "stop sign", "parking meter", "bench", "bird", "cat", "dog", "horse", "sheep", "cow",
    "elephant", "bear", "zebra", "giraffe", "backpack", "umbrella", "handbag", "tie", "suitcase", "frisbee",
    "skis", "snowboard", "sports ball", "kite", "baseball bat", "baseball glove", "skateboard", "surfboard",
    "tennis racket", "bottle", "wine glass", "cup", "fork", "knife", "spoon", "bowl", "banana", "apple",
    "sandwich", "orange", "broccoli", "carrot", "hot dog", "pizza", "donut", "cake", "chair", "couch",
    "potted plant", "bed", "dining table", "toilet", "tv", "laptop", "mouse", "remote", "keyboard",
    "cell phone", "microwave", "oven", "toaster", "sink", "refrigerator", "book", "clock", "vase", "scissors",
    "teddy bear", "hair drier", "toothbrush",
)  # fmt: skip


def with_project_names(names: Iterable[str]) -> tuple[str, ...]:
    """COCO's class names with "car" as this project's "Car".

    The others keep their names: COCO divides trucks, buses and trains differently from KITTI's vans, trucks
    and trams, and its people may ride. Evaluation of cars skips them.
    """
    return tuple("Car" if name == "car" else name for name in names)


COCO_CLASSES = with_project_names(COCO_NAMES)
"""COCO's 80 classes."""
_UNASSIGNED = (0, 12, 26, 29, 30, 45, 66, 68, 69, 71, 83)
_names = iter(COCO_CLASSES)
COCO_CLASSES_91 = tuple(NO_CLASS if number in _UNASSIGNED else next(_names) for number in range(91))
"""By the numbers in COCO's files, which torchvision uses: 0 is the background, ten were never assigned."""
COCO_PEOPLE = tuple("Pedestrian" if name == "person" else name for name in COCO_CLASSES)
"""COCO's 80 classes with people as pedestrians; riders are among them."""
CLASS_LISTS: dict[str, tuple[str, ...]] = {
    "coco": COCO_CLASSES,
    "coco91": COCO_CLASSES_91,
    "coco-people": COCO_PEOPLE,
}
"""Lists that the setting `classes` may name."""


@dataclass(frozen=True, slots=True)
class NetworkSpec:
    """Pre- and postprocessing of a network. None leaves a setting to the output format or the file."""

    size: tuple[int, int] | None = None
    """Input (height, width), px; None uses the image's size, padded to a multiple of `multiple`."""
    multiple: int = 1
    """px."""
    resize: Resize = "letterbox"
    """letterbox preserves the aspect ratio and pads with `pad`; stretch does not."""
    centred: bool = True
    """Whether to pad on both sides, instead of right and below."""
    pad: float = 0.0
    """Grey level of the padding, in [0, 1]."""
    channels: Channels = "rgb"
    """Order of the channels."""
    scale: float = 1.0
    """Factor of pixels in [0, 1]."""
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Subtracted from the scaled pixels, in the network's channel order."""
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Divides the result, in the network's channel order."""
    input: Input = "batch"
    """The network's argument: a batch (1, 3, H, W), an image (3, H, W), or a list of one image."""
    format: str | None = None
    """Output format, a name in `detectors.adapters.formats.FORMATS`; None recognises it."""
    boxes: BoxFormat | None = None
    """The four numbers of a box."""
    normalised: bool = False
    """Whether boxes are shares of the input's size instead of px."""
    activation: Activation | None = None
    """Activation to apply to scores; exp for logarithms of probabilities."""
    classes: tuple[str, ...] | None = None
    """One name per column of scores; "" for none."""
    t_star: float | None = None
    """Score of best F1, in [0, 1]."""
    nms_iou: float | None = None
    """IoU of suppression, in [0, 1]."""
    least_score: float | None = None
    """Lowest decoded score, in [0, 1]."""


@dataclass(frozen=True, slots=True)
class ImagePlacement:
    """Where an image lies in a network's input."""

    scale_xy: tuple[float, float]
    """Input pixels per image pixel, after rounding the sides to whole pixels."""
    offset_xy: tuple[int, int]
    """Input pixels left of and above the image."""

    def to_image(self, edges_xyxy: Tensor) -> Tensor:
        """Boxes (..., 4) from px of the input, measured from its corner, to px of the image, with pixel centres at
        integers.
        """
        scale, offset = (edges_xyxy.new_tensor(pair).repeat(2) for pair in (self.scale_xy, self.offset_xy))
        return (edges_xyxy - offset) / scale - 0.5


def fit_images(images: Tensor, spec: NetworkSpec) -> tuple[Tensor, ImagePlacement]:
    """Resize and pad images (B, 3, H, W), RGB in [0, 1], to the network's size; differentiable."""
    height, width = images.shape[2:]
    size = height, width
    padded_size = tuple(math.ceil(side / spec.multiple) * spec.multiple for side in size)
    if spec.size is not None:
        padded_size = size = spec.size
        if spec.resize == "letterbox":
            scale = min(padded_size[0] / height, padded_size[1] / width)
            size = tuple(
                min(max(round(scale * side), 1), most)
                for side, most in zip((height, width), padded_size, strict=True)
            )
    if size != (height, width):
        images = F.interpolate(images, size, mode="bilinear", antialias=True, align_corners=False)
    below, right = padded_size[0] - size[0], padded_size[1] - size[1]
    left, top = (right // 2, below // 2) if spec.centred else (0, 0)
    if below or right:
        images = F.pad(images, (left, right - left, top, below - top), value=spec.pad)
    return images, ImagePlacement((size[1] / width, size[0] / height), (left, top))


def normalise_images(images: Tensor, spec: NetworkSpec) -> Tensor:
    """Images (B, 3, h, w), RGB in [0, 1], in the network's channel order and range."""
    mean, std = (images.new_tensor(values).view(3, 1, 1) for values in (spec.mean, spec.std))
    return ((images if spec.channels == "rgb" else images.flip(1)) * spec.scale - mean) / std


def load_spec(path: Path) -> dict[str, Any]:
    """The settings of a YAML file.

    Raises:
        DetectorError: The file cannot be read, or a setting is unknown or out of range.
    """
    text = read_text(path, "a YAML file", _MAX_YAML_BYTES)
    try:
        loaded = yaml.load(text, _Loader)  # a subclass of SafeLoader
    except (ValueError, TypeError, AttributeError, RecursionError, yaml.YAMLError) as error:
        raise DetectorError(f"{path}: expected a YAML file, found {' '.join(str(error).split())}") from None
    if not isinstance(loaded, dict):
        raise DetectorError(f"{path}: expected a mapping of settings, found {type(loaded).__name__}")
    return validate_settings(loaded, str(path))


class _Loader(yaml.SafeLoader):
    """YAML without aliases, a few of which can expand to gigabytes."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.MarkedYAMLError(problem="an alias", problem_mark=self.peek_event().start_mark)
        return super().compose_node(parent, index)


def load_settings(path: Path, spec: Path | None) -> dict[str, Any]:
    """The settings of the given YAML file or, by default, of the one next to a network's file, if there is one."""
    default = path.with_suffix(".yaml")
    return load_spec(spec or default) if spec is not None or default.is_file() else {}


def validate_settings(settings: Mapping[Any, Any], where: str) -> dict[str, Any]:
    """Settings of a `NetworkSpec`, converted to its types.

    Raises:
        DetectorError: A setting is unknown or out of range; the message begins with `where`.
    """
    known = {field.name for field in fields(NetworkSpec)}
    validated: dict[str, Any] = {}
    for key, value in settings.items():
        if key not in known:
            raise DetectorError(
                f"{where}: {key}: expected one of {', '.join(sorted(known))}, found an unknown key"
            )
        expected, read = _READERS[key]
        try:
            validated[key] = read(value)
        except (TypeError, ValueError, KeyError, OverflowError):
            raise DetectorError(f"{where}: {key}: expected {expected}, found {value!r}") from None
    return validated


def select_classes(scores: Tensor, names: tuple[str, ...]) -> Tensor:
    """The columns (..., C) of scores (..., N) that are classes."""
    columns = [i for i, name in enumerate(names) if name != NO_CLASS]
    return scores if len(columns) == len(names) else scores[..., torch.tensor(columns, device=scores.device)]


def _one_of(kind: Any) -> tuple[str, Callable[[Any], Any]]:
    choices: tuple[str, ...] = get_args(kind)
    return " or ".join(choices), lambda value: {choice: choice for choice in choices}[value]


def _of_type(kind: type) -> Callable[[Any], Any]:
    def read(value: Any) -> Any:
        if not isinstance(value, kind):
            raise TypeError
        return value

    return read


def _number(least: float, most: float) -> Callable[[Any], float]:
    def read(value: Any) -> float:
        number = float(value)
        if isinstance(value, bool | str) or not least <= number <= most:
            raise ValueError
        return number

    return read


def _whole(value: Any) -> int:
    if isinstance(value, bool) or int(value) != value or not 1 <= value <= MAX_SIDE:
        raise ValueError
    return int(value)


def _size(value: Any) -> tuple[int, int]:
    sides = [value, value] if isinstance(value, int) else list(value)
    if len(sides) != 2:
        raise ValueError
    return _whole(sides[0]), _whole(sides[1])


def _three(value: Any) -> tuple[float, ...]:
    read = _number(-1e6, 1e6)
    numbers = tuple(read(number) for number in ([value] * 3 if isinstance(value, int | float) else value))
    if len(numbers) != 3:
        raise ValueError
    return numbers


def _deviation(value: Any) -> tuple[float, ...]:
    numbers = _three(value)
    if min(numbers) <= 0:
        raise ValueError
    return numbers


def _classes(value: Any) -> tuple[str, ...]:
    if isinstance(value, str):
        return CLASS_LISTS[value]
    names = tuple(NO_CLASS if name in (None, "-") else str(name) for name in value)
    real = [name for name in names if name != NO_CLASS]
    if not real or len(set(real)) != len(real) or len(names) > _MAX_CLASSES:
        raise ValueError
    return names


_READERS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "size": (f"a number of px up to {MAX_SIDE}, or [height, width]", _size),
    "multiple": (f"a whole number up to {MAX_SIDE}", _whole),
    "resize": _one_of(Resize),
    "centred": ("true or false", _of_type(bool)),
    "pad": ("a number in [0, 1]", _number(0, 1)),
    "channels": _one_of(Channels),
    "scale": ("a positive number", _number(1e-6, 1e6)),
    "mean": ("a number, or three", _three),
    "std": ("a positive number, or three", _deviation),
    "input": _one_of(Input),
    "format": ("the name of a format", _of_type(str)),
    "boxes": _one_of(BoxFormat),
    "normalised": ("true or false", _of_type(bool)),
    "activation": _one_of(Activation),
    "classes": (f"{', '.join(CLASS_LISTS)}, or a list of names, each once", _classes),
    "t_star": ("a number in [0, 1]", _number(0, 1)),
    "nms_iou": ("a number in [0, 1]", _number(0, 1)),
    "least_score": ("a number in [0, 1]", _number(0, 1)),
}
"""What each setting should be, and how it is read."""
