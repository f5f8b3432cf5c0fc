"""How a network from elsewhere wants its images and what its numbers mean: a few settings, from a YAML file."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

import torch
import torch.nn.functional as F
import yaml
from torch import Tensor

from detectors.adapters import coco
from detectors.base import DetectorError
from detectors.reading import read_text

Resize = Literal["letterbox", "stretch"]
Channels = Literal["rgb", "bgr"]
Activation = Literal["none", "sigmoid", "softmax"]
Layout = Literal["xyxy", "cxcywh", "xywh", "yxyx"]
Input = Literal["batch", "image", "list"]

MOST_SIDE = 8192
"""px of a network's input: far above any, so that none takes all memory."""
_MOST_CLASSES = 10_000
_MOST_YAML = 1 << 18
"""Bytes of a YAML file: settings are short, and reading is slow."""
NO_CLASS = ""
"""Name of a column of scores that is no class: background, or a number that was never given."""

CLASS_LISTS: dict[str, tuple[str, ...]] = {"coco": coco.CLASSES, "coco91": coco.CLASSES_91}
"""What `classes` may name instead of listing."""


@dataclass(frozen=True, slots=True)
class Spec:
    """Before and after a network. What is None is left to the format, or to the file.

    size: (height, width) px that it takes; None: the image's own, padded to a multiple of `multiple`. resize:
    letterbox keeps the shape and fills up with `pad`, stretch does not; `centred`: filled up on both sides, else
    right and below. channels, scale, mean, std: pixels are ordered so, multiplied, less the mean, over the
    deviation (both in units of the scaled pixels, in the network's order). input: what is handed over: a batch
    (1, 3, H, W), an image (3, H, W), or a list of one image.

    format: of the outputs, a name of `detectors.adapters.formats.FORMATS`; None is recognised. boxes: what a box's
    four numbers are; normalised: shares of the input's size instead of px. activation: of scores. classes: one
    name a column of scores, "" where it is none. t_star, nms_iou, least_score: see `detectors.adapters.dense`.
    """

    size: tuple[int, int] | None = None
    multiple: int = 1
    resize: Resize = "letterbox"
    centred: bool = True
    pad: float = 0.0
    channels: Channels = "rgb"
    scale: float = 1.0
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    input: Input = "batch"
    format: str | None = None
    boxes: Layout | None = None
    normalised: bool = False
    activation: Activation | None = None
    classes: tuple[str, ...] | None = None
    t_star: float | None = None
    nms_iou: float | None = None
    least_score: float | None = None


@dataclass(frozen=True, slots=True)
class Fitted:
    """Where a picture lies in a network's input. scale_xy: px of the input a px of the picture, after its sides
    were rounded to whole px; offset_xy: px of the input left of it and above.
    """

    scale_xy: tuple[float, float]
    offset_xy: tuple[int, int]

    def back(self, edges_xyxy: Tensor) -> Tensor:
        """Boxes (..., 4) px of the input, counted from its corner, as px of the picture, whose first pixel's
        centre is at 0.
        """
        scale, offset = (edges_xyxy.new_tensor(pair).repeat(2) for pair in (self.scale_xy, self.offset_xy))
        return (edges_xyxy - offset) / scale - 0.5


def fit(images: Tensor, spec: Spec) -> tuple[Tensor, Fitted]:
    """images (B, 3, H, W) RGB in [0, 1] as (B, 3, h, w), still RGB in [0, 1]; differentiable."""
    high, wide = images.shape[2:]
    size = high, wide
    filled = tuple(math.ceil(side / spec.multiple) * spec.multiple for side in size)
    if spec.size is not None:
        filled = size = spec.size
        if spec.resize == "letterbox":
            scale = min(filled[0] / high, filled[1] / wide)
            size = tuple(
                min(max(round(scale * side), 1), most) for side, most in zip((high, wide), filled, strict=True)
            )
    if size != (high, wide):
        images = F.interpolate(images, size, mode="bilinear", antialias=True, align_corners=False)
    below, right = filled[0] - size[0], filled[1] - size[1]
    left, top = (right // 2, below // 2) if spec.centred else (0, 0)
    if below or right:
        images = F.pad(images, (left, right - left, top, below - top), value=spec.pad)
    return images, Fitted((size[1] / wide, size[0] / high), (left, top))


def prepare(images: Tensor, spec: Spec) -> Tensor:
    """images (B, 3, h, w) RGB in [0, 1] of the network's size as the network takes them."""
    mean, std = (images.new_tensor(values).view(3, 1, 1) for values in (spec.mean, spec.std))
    return ((images if spec.channels == "rgb" else images.flip(1)) * spec.scale - mean) / std


def load_spec(path: Path) -> dict[str, Any]:
    """The settings of a YAML file, each checked; to be laid over a format's own. DetectorError names file, key."""
    loaded = _read_yaml(path)
    if not isinstance(loaded, dict):
        raise DetectorError(f"{path}: expected a mapping of settings, found {type(loaded).__name__}")
    return checked(loaded, str(path))


class _Loader(yaml.SafeLoader):
    """YAML without aliases, a few of which stand for gigabytes."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.MarkedYAMLError(problem="an alias", problem_mark=self.peek_event().start_mark)
        return super().compose_node(parent, index)


def _read_yaml(path: Path) -> Any:
    """The value in a YAML file. DetectorError where it is none, or has aliases."""
    text = read_text(path, "a YAML file", _MOST_YAML)
    try:
        return yaml.load(text, _Loader)  # a subclass of SafeLoader
    except (ValueError, TypeError, AttributeError, RecursionError, yaml.YAMLError) as error:
        raise DetectorError(f"{path}: expected a YAML file, found {' '.join(str(error).split())}") from None


def settings_of(path: Path, spec: Path | None) -> dict[str, Any]:
    """The settings of a YAML file: the one given, or else the one beside a network's file, where there is one."""
    if spec is not None:
        return load_spec(spec)
    beside = path.with_suffix(".yaml")
    return load_spec(beside) if beside.is_file() else {}


def checked(settings: Mapping[Any, Any], where: str) -> dict[str, Any]:
    """Settings of a Spec, in its types. DetectorError that begins with `where` and the key."""
    known = {field.name for field in fields(Spec)}
    found: dict[str, Any] = {}
    for key, value in settings.items():
        if key not in known:
            raise DetectorError(
                f"{where}: {key}: expected one of {', '.join(sorted(known))}, found an unknown key"
            )
        expected, read = _READERS[key]
        try:
            found[key] = read(value)
        except (TypeError, ValueError, KeyError, OverflowError):
            raise DetectorError(f"{where}: {key}: expected {expected}, found {value!r}") from None
    return found


def named(scores: Tensor, names: tuple[str, ...]) -> tuple[Tensor, tuple[str, ...]]:
    """Of scores (..., N) and N names, those that are classes: scores (..., C) and C names."""
    kept = [i for i, name in enumerate(names) if name != NO_CLASS]
    if len(kept) == len(names):
        return scores, names
    return scores[..., torch.tensor(kept, device=scores.device)], tuple(names[i] for i in kept)


def _one_of(kind: Any) -> tuple[str, Callable[[Any], Any]]:
    choices: tuple[str, ...] = get_args(kind)
    return " or ".join(choices), lambda value: {choice: choice for choice in choices}[value]


def _number(least: float, most: float) -> Callable[[Any], float]:
    def read(value: Any) -> float:
        number = float(value)
        if isinstance(value, bool | str) or not least <= number <= most:
            raise ValueError
        return number

    return read


def _whole(value: Any) -> int:
    if isinstance(value, bool) or int(value) != value or not 1 <= value <= MOST_SIDE:
        raise ValueError
    return int(value)


def _truth(value: Any) -> bool:
    if not isinstance(value, bool):
        raise TypeError
    return value


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
    if not real or len(set(real)) != len(real) or len(names) > _MOST_CLASSES:
        raise ValueError
    return names


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError
    return value


_READERS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "size": (f"a number of px up to {MOST_SIDE}, or [height, width]", _size),
    "multiple": (f"a whole number up to {MOST_SIDE}", _whole),
    "resize": _one_of(Resize),
    "centred": ("true or false", _truth),
    "pad": ("a number in [0, 1]", _number(0, 1)),
    "channels": _one_of(Channels),
    "scale": ("a positive number", _number(1e-6, 1e6)),
    "mean": ("a number, or three", _three),
    "std": ("a positive number, or three", _deviation),
    "input": _one_of(Input),
    "format": ("the name of a format", _text),
    "boxes": _one_of(Layout),
    "normalised": ("true or false", _truth),
    "activation": _one_of(Activation),
    "classes": (f"{', '.join(CLASS_LISTS)}, or a list of names, each once", _classes),
    "t_star": ("a number in [0, 1]", _number(0, 1)),
    "nms_iou": ("a number in [0, 1]", _number(0, 1)),
    "least_score": ("a number in [0, 1]", _number(0, 1)),
}
"""Of each setting: what is expected, and how it is read."""
