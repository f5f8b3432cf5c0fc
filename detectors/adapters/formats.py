"""Output formats of detection networks, recognised by the shapes of their outputs, and their decoding."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from detectors.adapters.spec import CLASS_LISTS, COCO_CLASSES, NO_CLASS, BoxFormat, NetworkSpec, select_classes
from detectors.base import DetectorError

Shape = tuple[int | str | None, ...]
"""Shape of an output; a name, or None, for a side that the graph leaves open."""

_END_TO_END = (100, 300)
"""Numbers of boxes from networks with built-in suppression: torchvision's and Ultralytics'."""


@dataclass(frozen=True, slots=True)
class OutputFormat:
    """Input and output conventions of one family of networks."""

    name: str
    """Its name in YAML files."""
    spec: NetworkSpec
    """The family's usual settings."""
    recognises: Callable[[Sequence[Shape], tuple[int, int]], bool]
    """Whether outputs of these shapes, for this input size (height, width), belong to the family."""
    columns: Callable[[Sequence[Shape]], int | None]
    """Number of score columns from the shapes; None if they do not determine it."""
    read: Callable[[Sequence[Tensor], tuple[int, int], NetworkSpec], tuple[Tensor, Tensor]]
    """Maps outputs for B images, the input size and the spec to boxes (B, A, 4), as in `spec.boxes`, and scores
    (B, A, N).
    """


@dataclass(frozen=True, slots=True)
class OutputDecoder:
    """Decodes the outputs of one network."""

    format: OutputFormat
    """Its output format."""
    spec: NetworkSpec
    """Complete settings: `classes` is not None."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Class names that labels index."""
        return tuple(name for name in self.spec.classes or () if name != NO_CLASS)

    def decode(self, outputs: Sequence[Tensor], input_hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Boxes (B, A, 4) px of the input, edges measured from its corner, and scores (B, A, C) in [0, 1]."""
        boxes, scores = self.format.read(outputs, input_hw, self.spec)
        boxes = _edges(boxes, self.spec.boxes or "xyxy")
        if self.spec.normalised:
            boxes = boxes * boxes.new_tensor([input_hw[1], input_hw[0]]).repeat(2)
        return boxes, select_classes(scores, self.spec.classes or ())


def make_decoder(
    shapes: Sequence[Shape],
    input_hw: tuple[int, int],
    settings: Mapping[str, Any],
    names: tuple[str, ...] | None,
    where: str,
) -> OutputDecoder:
    """The decoder for outputs of these shapes.

    Args:
        shapes: Shapes of the outputs.
        input_hw: Input size, px.
        settings: Settings of a `NetworkSpec` that override the format's.
        names: Class names from the network's file.
        where: Beginning of error messages.

    Raises:
        DetectorError: Outputs of an unknown or another format, or a wrong number of class names.
    """
    format_name = settings.get("format")
    found = ", ".join(str(list(shape)) for shape in shapes) or "none"
    fitting = {f.name: f for f in FORMATS if format_name in (None, f.name)}
    if not fitting:
        known = ", ".join(f.name for f in FORMATS)
        raise DetectorError(f"{where}: format: expected one of {known}, found {format_name!r}")
    output_format = next((f for f in fitting.values() if f.recognises(shapes, input_hw)), None)
    if output_format is None:
        raise DetectorError(f"{where}: expected the outputs of {' or '.join(fitting)}, found {found}")
    columns = output_format.columns(shapes)
    classes = settings.get("classes") or names or _default_classes(output_format.spec.classes, columns)
    if classes is None:
        raise DetectorError(f"{where}: classes: expected {columns} names in a YAML file, found none")
    if columns is not None and len(classes) != columns:
        raise DetectorError(f"{where}: classes: expected {columns}, one a column of scores, found {len(classes)}")
    return OutputDecoder(output_format, replace(output_format.spec, **(dict(settings) | {"classes": classes})))


def _default_classes(usual: tuple[str, ...] | None, columns: int | None) -> tuple[str, ...] | None:
    """The format's usual classes or a known list, with as many names as there are score columns."""
    lists = [usual] if usual else []
    return next((n for n in (*lists, *CLASS_LISTS.values()) if columns is None or len(n) == columns), None)


def flatten_outputs(outputs: Any) -> list[Tensor]:
    """The tensors in a network's output, in order; of a mapping with boxes, labels and scores, only those."""
    if isinstance(outputs, Tensor):
        return [outputs]
    if isinstance(outputs, Mapping):
        keys = [key for key in ("boxes", "labels", "scores") if key in outputs]
        return [tensor for key in (keys or outputs) for tensor in flatten_outputs(outputs[key])]
    if isinstance(outputs, Sequence) and not isinstance(outputs, str):
        return [tensor for output in outputs for tensor in flatten_outputs(output)]
    return []


def activate(logits: Tensor, spec: NetworkSpec) -> Tensor:
    """Scores (..., N) in [0, 1] from a network's scores."""
    if spec.activation == "sigmoid":
        return logits.sigmoid()
    return logits.softmax(-1) if spec.activation == "softmax" else logits


def _edges(boxes: Tensor, layout: BoxFormat) -> Tensor:
    """Boxes (..., 4) as left, top, right, bottom."""
    first, second = boxes[..., :2], boxes[..., 2:]
    if layout == "cxcywh":
        return torch.cat((first - second / 2, first + second / 2), -1)
    if layout == "xywh":
        return torch.cat((first, first + second), -1)
    return torch.cat((first.flip(-1), second.flip(-1)), -1) if layout == "yxyx" else boxes


def _grid(shapes: Sequence[Shape]) -> tuple[int, int] | None:
    """m and n of a single output (B, m, n); open sides count as very large."""
    if len(shapes) != 1 or len(shapes[0]) != 3:
        return None
    m, n = (side if isinstance(side, int) else 1 << 30 for side in shapes[0][1:])
    return m, n


def _is_end_to_end(shapes: Sequence[Shape], _: tuple[int, int]) -> bool:
    grid = _grid(shapes)
    return grid is not None and grid[1] == 6 and grid[0] in _END_TO_END


def _is_yolov8(shapes: Sequence[Shape], _: tuple[int, int]) -> bool:
    grid = _grid(shapes)
    return grid is not None and 5 <= grid[0] < grid[1]


def _is_yolov5(shapes: Sequence[Shape], _: tuple[int, int]) -> bool:
    grid = _grid(shapes)
    return grid is not None and 6 <= grid[1] < grid[0]


def _is_torchvision(shapes: Sequence[Shape], _: tuple[int, int]) -> bool:
    if len(shapes) != 3:
        return False
    ranks = sorted(len(shape) for shape in shapes)
    return any(shape[-1:] == (4,) for shape in shapes) and ranks in ([1, 1, 2], [2, 2, 3])


def _is_ssd(shapes: Sequence[Shape], _: tuple[int, int]) -> bool:
    same = len(shapes) == 2 and all(len(shape) == 3 for shape in shapes) and shapes[0][1] == shapes[1][1]
    return same and any(shape[2] == 4 for shape in shapes)


def _read_end_to_end(outputs: Sequence[Tensor], _: tuple[int, int], spec: NetworkSpec) -> tuple[Tensor, Tensor]:
    """(B, K, 6): left, top, right, bottom, score, class."""
    output = outputs[0]
    return output[..., :4], _spread(output[..., 5], output[..., 4], spec)


def _read_yolov8(outputs: Sequence[Tensor], _: tuple[int, int], spec: NetworkSpec) -> tuple[Tensor, Tensor]:
    """(B, 4 + N, A)."""
    cells = outputs[0].transpose(1, 2)
    return cells[..., :4], activate(cells[..., 4:], spec)


def _read_yolov5(outputs: Sequence[Tensor], _: tuple[int, int], spec: NetworkSpec) -> tuple[Tensor, Tensor]:
    """(B, A, 5 + N): class scores are multiplied by objectness."""
    cells = outputs[0]
    objectness = cells[..., 4:5]
    objectness = objectness if spec.activation in (None, "none") else objectness.sigmoid()
    return cells[..., :4], objectness * activate(cells[..., 5:], spec)


def _read_torchvision(outputs: Sequence[Tensor], _: tuple[int, int], spec: NetworkSpec) -> tuple[Tensor, Tensor]:
    """Boxes (K, 4), labels (K,) and scores (K,) of one image, in any order, perhaps with a leading side of 1."""
    deepest = max(output.ndim for output in outputs)
    boxes = next(output for output in outputs if output.ndim == deepest and output.shape[-1] == 4)
    others = [output for output in outputs if output is not boxes]
    # scores are floats; if labels are too, they come first
    labels, scores = sorted(others, key=lambda output: output.is_floating_point())
    return boxes.reshape(1, -1, 4), _spread(labels.reshape(1, -1), scores.reshape(1, -1), spec)


def _read_ssd(outputs: Sequence[Tensor], _: tuple[int, int], spec: NetworkSpec) -> tuple[Tensor, Tensor]:
    """Boxes (B, A, 4) and scores (B, A, N), in any order; boxes first if both have four columns."""
    first, second = outputs
    boxes, scores = (first, second) if first.shape[-1] == 4 else (second, first)
    return boxes, activate(scores, spec)


def _spread(labels: Tensor, scores: Tensor, spec: NetworkSpec) -> Tensor:
    """Scores (B, K) of labels (B, K) as columns (B, K, N), 0 elsewhere. Labels beyond the classes are dropped."""
    count = len(spec.classes or ())
    place = labels.long()
    there = (place >= 0) & (place < count)
    spread = scores.new_zeros((*scores.shape, count))
    return spread.scatter(-1, (place * there)[..., None], (scores * there)[..., None])


NANODET_SPEC = NetworkSpec(
    channels="bgr",
    scale=255.0,
    mean=(103.53, 116.28, 123.675),
    std=(57.375, 57.12, 58.395),
    classes=COCO_CLASSES,
)
"""With ImageNet's mean and deviation of 8-bit values, as in NanoDet's configurations."""
BINS = 8
SIDES = 4


def is_nanodet(shapes: Sequence[tuple[int | str | None, ...]], input_hw: tuple[int, int]) -> bool:
    """Whether outputs of these shapes are NanoDet's: scores and distances for cells that fill the input."""
    try:
        return bool(_pairs(shapes, input_hw))
    except ValueError:
        return False


def read_nanodet(outputs: Sequence[Tensor], input_hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Boxes (B, A, 4) px of the input, measured from its corner, and scores (B, A, 80) in [0, 1] of all cells.

    NanoDet (https://github.com/RangiLyu/nanodet, before "Plus") has two outputs per stride: class scores (1, A,
    80) after the sigmoid, and distances (1, A, 32) from a cell's centre to the box's left, top, right and bottom,
    each the mean of a distribution over 0 to 7 strides, given as 8 logits (distribution focal loss, Li et al.
    2020).

    A cell's centre is at (column + 1/2) strides: on KITTI, boxes are then a pixel off the labels in the median.
    NanoDet-Plus has centres at whole strides and a fourth stride: it is another format.
    """
    boxes, scores = [], []
    for s, d, stride in _pairs([tuple(o.shape) for o in outputs], input_hw):
        rows, columns = (math.ceil(side / stride) for side in input_hw)
        logits = outputs[d].unflatten(2, (SIDES, BINS))
        bins = torch.arange(BINS, dtype=logits.dtype, device=logits.device)
        distance = (logits.softmax(dim=3) @ bins) * stride
        y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
        centre = (torch.stack([x, y], dim=-1).view(-1, 2).to(bins) + 0.5) * stride
        boxes.append(torch.cat([centre - distance[..., :2], centre + distance[..., 2:]], dim=2))
        scores.append(outputs[s])
    return torch.cat(boxes, dim=1), torch.cat(scores, dim=1)


def _pairs(
    shapes: Sequence[tuple[int | str | None, ...]], input_hw: tuple[int, int]
) -> list[tuple[int, int, int]]:
    """(index of scores, index of distances, stride) for each stride; ValueError if they do not match."""
    scores, distances = _cells(shapes, len(COCO_CLASSES)), _cells(shapes, SIDES * BINS)
    if not scores or scores.keys() != distances.keys() or 2 * len(scores) != len(shapes):
        raise ValueError(f"expected a pair of scores and distances a stride, found {list(shapes)}")
    found = []
    for cells, i in sorted(scores.items(), reverse=True):
        stride = round(math.sqrt(input_hw[0] * input_hw[1] / cells))
        if math.ceil(input_hw[0] / stride) * math.ceil(input_hw[1] / stride) != cells:
            raise ValueError(f"expected cells of one size over {input_hw}, found {cells}")
        found.append((i, distances[cells], stride))
    return found


def _cells(shapes: Sequence[tuple[int | str | None, ...]], columns: int) -> dict[int, int]:
    """Number of cells and index of each output (1, cells, columns)."""
    return {
        cells: i
        for i, shape in enumerate(shapes)
        if len(shape) == 3 and isinstance(cells := shape[1], int) and shape[2] == columns
    }


def _score_columns(side: int | str | None, boxes: int) -> int | None:
    """Score columns of a side that also holds other numbers."""
    return side - boxes if isinstance(side, int) else None


_ULTRALYTICS = NetworkSpec(pad=114 / 255, boxes="cxcywh")
"""RGB in [0, 1], padded with its grey."""

FORMATS: tuple[OutputFormat, ...] = (
    OutputFormat(
        "nanodet",
        NANODET_SPEC,
        is_nanodet,
        lambda _: len(NANODET_SPEC.classes or ()),
        lambda outputs, input_hw, _: read_nanodet(outputs, input_hw),
    ),
    OutputFormat("end2end", replace(_ULTRALYTICS, boxes="xyxy"), _is_end_to_end, lambda _: None, _read_end_to_end),
    OutputFormat("yolov8", _ULTRALYTICS, _is_yolov8, lambda shapes: _score_columns(shapes[0][1], 4), _read_yolov8),
    OutputFormat("yolov5", _ULTRALYTICS, _is_yolov5, lambda shapes: _score_columns(shapes[0][2], 5), _read_yolov5),
    OutputFormat(
        "torchvision",
        NetworkSpec(classes=CLASS_LISTS["coco91"]),
        _is_torchvision,
        lambda _: None,
        _read_torchvision,
    ),
    OutputFormat(
        "ssd",
        NetworkSpec(),
        _is_ssd,
        lambda shapes: _score_columns(
            shapes[0][2] if shapes[1][2] == 4 and shapes[0][2] != 4 else shapes[1][2], 0
        ),
        _read_ssd,
    ),
)
"""Known formats; the first that recognises a network's outputs decodes them."""
