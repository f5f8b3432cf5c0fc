"""Output formats of detection networks, recognised by what their outputs measure, and their decoding."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from detectors.adapters.spec import CLASS_LISTS, COCO_CLASSES, NO_CLASS, BoxFormat, NetworkSpec, select_classes
from detectors.base import DetectorError

Shape = tuple[int, ...]
"""Shape of an output."""

MAX_SELECTED = 1000
"""Most boxes of a network that selects them itself; one box a cell gives more."""
NAMED_OUTPUTS = (
    ("boxes", "labels", "scores"),
    ("detection_boxes", "detection_classes", "detection_scores"),
    ("det_boxes", "det_classes", "det_scores"),
    ("logits", "pred_boxes"),
)
"""Names of outputs that suffice where a network has all of a row; other outputs are left aside."""
_SHARES = (0.05, 2.0)
"""Range of the largest side of boxes that are shares of the input: some predictions extend beyond it."""
_INVERTED = 0.01
"""Share of boxes with right < left or bottom < top from which they are centre and size instead of corners."""
_FOLLOWS = 0.5
"""Correlation of centres with the places of their cells from which they are decoded."""
_RAW_SHARE = 0.25
"""Largest centre of undecoded cells, which count cells, as a share of the input's smaller side in px."""


@dataclass(frozen=True, slots=True)
class NetworkOutputs:
    """What a network gives for one image."""

    tensors: tuple[Tensor, ...]
    """Its outputs, without masks (`_leave_masks_aside`)."""
    input_hw: tuple[int, int]
    """Size of its input, px."""
    names: frozenset[str]
    """Names of the inputs and outputs of its graph, if it has names."""
    classes: tuple[str, ...] | None
    """Class names from the file or the settings, if any."""

    @property
    def class_counts(self) -> set[int]:
        """Numbers of classes that are likely: of the names, else of the known lists."""
        return {len(self.classes)} if self.classes else set(map(len, CLASS_LISTS.values()))

    def has_background(self, columns: int) -> bool:
        """Whether one of so many score columns is the background: the first or last has no name, or one more than
        the classes.
        """
        if columns in self.class_counts:
            return bool(self.classes) and NO_CLASS in (self.classes[0], self.classes[-1])
        return columns - 1 in self.class_counts

    @property
    def shapes(self) -> list[Shape]:
        """Shapes of the outputs."""
        return [tuple(tensor.shape) for tensor in self.tensors]


@dataclass(frozen=True, slots=True)
class OutputFormat:
    """Input and output conventions of one family of networks."""

    name: str
    """Its name in YAML files."""
    spec: NetworkSpec
    """The family's usual settings."""
    fits: Callable[[Sequence[Shape], tuple[int, int]], bool]
    """Whether outputs of these shapes, for this input size (height, width), can be read."""
    read: Callable[[Sequence[Tensor], tuple[int, int], NetworkSpec], tuple[Tensor, Tensor]]
    """Maps outputs for B images, the input size and the spec to boxes (B, A, 4), as in `spec.boxes`, and scores
    (B, A, N).
    """
    is_likely: Callable[[NetworkOutputs], bool] = lambda _: True
    """Whether outputs that fit are of this family, as far as their values and names show."""
    columns: Callable[[Sequence[Shape]], int | None] = lambda _: None
    """Number of score columns from the shapes; None if they do not determine it."""


@dataclass(frozen=True, slots=True)
class OutputDecoder:
    """Decodes the outputs of one network."""

    format: OutputFormat
    """Its output format."""
    spec: NetworkSpec
    """Complete settings: `classes` is not None."""
    alternatives: tuple[str, ...] = ()
    """Other formats that could read the outputs."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Class names that labels index."""
        return tuple(name for name in self.spec.classes or () if name != NO_CLASS)

    def describe(self) -> str:
        """How the outputs are read, and what else they could be."""
        spec = self.spec
        pixels = f"{spec.channels.upper()} in [0, {spec.scale:g}]" + (", normalised" if any(spec.mean) else "")
        other = f"{' or '.join(self.alternatives)} is possible too (`format` in a YAML file)"
        reading = f"read as {self.format.name}, input {pixels}, {spec.resize}"
        return f"{reading}; {other}" if self.alternatives else reading

    def decode(self, outputs: Sequence[Tensor], input_hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Boxes (B, A, 4) px of the input, edges measured from its corner, and scores (B, A, C) in [0, 1]."""
        boxes, scores = self.format.read(_leave_masks_aside(outputs), input_hw, self.spec)
        boxes = _edges(boxes, self.spec.boxes or "xyxy")
        if self.spec.normalised:
            boxes = boxes * boxes.new_tensor([input_hw[1], input_hw[0]]).repeat(2)
        return boxes, select_classes(scores, self.spec.classes or ())


def make_decoder(
    outputs: Sequence[Tensor],
    input_hw: tuple[int, int],
    settings: Mapping[str, Any],
    names: tuple[str, ...] | None,
    where: str,
    node_names: Collection[str] = (),
) -> OutputDecoder:
    """The decoder for a network, from its outputs for one image.

    Args:
        outputs: The outputs.
        input_hw: Input size, px.
        settings: Settings of a `NetworkSpec` that override the format's and what is measured.
        names: Class names from the network's file.
        where: Beginning of error messages.
        node_names: Names of the graph's inputs and outputs.

    Raises:
        DetectorError: Outputs of an unknown or another format, or a wrong number of class names.
    """
    format_name, names = settings.get("format"), settings.get("classes") or names
    measured = NetworkOutputs(tuple(_leave_masks_aside(outputs)), input_hw, frozenset(node_names), names)
    known = {f.name: f for f in FORMATS if format_name in (None, f.name)}
    if not known:
        expected = ", ".join(f.name for f in FORMATS)
        raise DetectorError(f"{where}: format: expected one of {expected}, found {format_name!r}")
    fitting = [f for f in FORMATS if f.fits(measured.shapes, input_hw)]
    # a format that the user names wins over what the values suggest
    likely = [f for f in fitting if f.name == format_name or (format_name is None and f.is_likely(measured))]
    if not likely:
        found = ", ".join(str(list(output.shape)) for output in outputs) or "none"
        raise DetectorError(f"{where}: expected the outputs of {' or '.join(known)}, found {found}")
    chosen = next((f for f in likely if _has_known_count(f, measured)), likely[0])
    facts = _measure(chosen, measured, settings)
    spec = replace(chosen.spec, **(facts | dict(settings)))
    columns = chosen.columns(measured.shapes)
    unnamed = (
        spec.activation in ("softmax", "exp") and columns is not None and columns not in measured.class_counts
    )
    needed = columns - 1 if unnamed and columns and measured.has_background(columns) else columns
    classes = names or _default_classes(chosen.spec.classes, needed)
    if classes is None:
        raise DetectorError(f"{where}: classes: expected {columns} names in a YAML file, found none")
    if needed is not None and len(classes) != needed:
        raise DetectorError(f"{where}: classes: expected {columns}, one a column of scores, found {len(classes)}")
    if needed != columns:
        classes = _add_background(classes, chosen, measured, spec)
    others = tuple(f.name for f in fitting if f is not chosen and _has_known_count(f, measured))
    return OutputDecoder(chosen, replace(spec, classes=classes), others)


def _default_classes(usual: tuple[str, ...] | None, columns: int | None) -> tuple[str, ...] | None:
    """The format's usual classes or a known list, with as many names as there are score columns."""
    lists = [usual] if usual else []
    return next((n for n in (*lists, *CLASS_LISTS.values()) if columns is None or len(n) == columns), None)


def _has_known_count(output_format: OutputFormat, outputs: NetworkOutputs) -> bool:
    """Whether there are as many score columns as likely classes, or one more for a background."""
    columns = output_format.columns(outputs.shapes)
    extra = output_format.name in _PAIRS
    return columns is None or columns in outputs.class_counts or (extra and columns - 1 in outputs.class_counts)


def _measure(output_format: OutputFormat, outputs: NetworkOutputs, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings that the outputs' values show: shares of the input, corners or centres, scores or logits."""
    if output_format.name == NANODET:
        return {}
    neutral = replace(output_format.spec, classes=settings.get("classes") or COCO_CLASSES, activation="none")
    boxes, scores = output_format.read(outputs.tensors, outputs.input_hw, neutral)
    found: dict[str, Any] = {"normalised": output_format.spec.normalised or _are_shares(boxes)}
    if output_format.name not in _PAIRS:
        return found
    activation = "sigmoid"
    if bool(((scores >= 0) & (scores <= 1)).all()):
        activation = "none"
    elif outputs.has_background(scores.shape[-1]):
        activation = "exp" if bool((scores <= 0).all()) else "softmax"
    usual = output_format.spec
    return found | {
        "boxes": usual.boxes or ("cxcywh" if _are_centred(boxes) else "xyxy"),
        "activation": usual.activation or activation,
    }


def _add_background(
    classes: tuple[str, ...], output_format: OutputFormat, outputs: NetworkOutputs, spec: NetworkSpec
) -> tuple[str, ...]:
    """The classes with a nameless column for the background: the first or the last, which has more probability."""
    _, scores = output_format.read(outputs.tensors, outputs.input_hw, replace(spec, classes=classes))
    means = scores.flatten(0, -2).mean(0)
    return (NO_CLASS, *classes) if bool(means[0] > means[-1]) else (*classes, NO_CLASS)


def _are_shares(boxes: Tensor) -> bool:
    """Whether boxes (..., 4) are shares of the input's size."""
    return bool(boxes.numel()) and _SHARES[0] < float(boxes.abs().max()) <= _SHARES[1]


def _are_centred(boxes: Tensor) -> bool:
    """Whether boxes (..., 4) are centres and sizes: as corners, some would be inverted."""
    return float((boxes[..., 2:] < boxes[..., :2]).any(-1).float().mean()) > _INVERTED


def _leave_masks_aside(outputs: Sequence[Tensor]) -> list[Tensor]:
    """Outputs in single precision at least, without planes (masks, heads of training) and, if a single output has
    columns of mask weights, without those.
    """
    halves = (torch.float16, torch.bfloat16)
    outputs = [output.float() if output.dtype in halves else output for output in outputs]
    planes, rest = [o for o in outputs if o.ndim > 3], [o for o in outputs if o.ndim <= 3]
    if len(planes) == 1 and planes[0].ndim == 4 and len(rest) == 1 and rest[0].ndim == 3:
        (output,), weights = rest, planes[0].shape[1]
        side = 1 if output.shape[1] < output.shape[2] else 2
        if output.shape[side] >= weights + SIDES:
            rest = [output.narrow(side, 0, output.shape[side] - weights)]
    return rest or outputs


def select_names(names: Collection[str]) -> tuple[str, ...]:
    """The names of a row of `NAMED_OUTPUTS` that a network has all of, else all names."""
    return next((row for row in NAMED_OUTPUTS if set(row) <= set(names)), tuple(names))


def flatten_outputs(outputs: Any) -> list[Tensor]:
    """The tensors in a network's output, in order; of a mapping those of `select_names`."""
    if isinstance(outputs, Tensor):
        return [outputs]
    if isinstance(outputs, Mapping):
        return [tensor for key in select_names(outputs) for tensor in flatten_outputs(outputs[key])]
    if isinstance(outputs, Sequence) and not isinstance(outputs, str):
        return [tensor for output in outputs for tensor in flatten_outputs(output)]
    return []


def activate(logits: Tensor, spec: NetworkSpec) -> Tensor:
    """Scores (..., N) in [0, 1] from a network's scores."""
    if spec.activation == "sigmoid":
        return logits.sigmoid()
    if spec.activation == "exp":
        return logits.exp()
    return logits.softmax(-1) if spec.activation == "softmax" else logits


def _edges(boxes: Tensor, layout: BoxFormat) -> Tensor:
    """Boxes (..., 4) as left, top, right, bottom."""
    first, second = boxes[..., :2], boxes[..., 2:]
    if layout == "cxcywh":
        return torch.cat((first - second / 2, first + second / 2), -1)
    if layout == "xywh":
        return torch.cat((first, first + second), -1)
    return torch.cat((first.flip(-1), second.flip(-1)), -1) if layout == "yxyx" else boxes


def _fits_grid(least: int, most: int | None = None) -> Callable[[Sequence[Shape], tuple[int, int]], bool]:
    """A single output (B, K, columns) with at least, and at most, so many columns."""
    return lambda shapes, _: (
        len(shapes) == 1 and len(shapes[0]) == 3 and least <= shapes[0][2] <= (most or shapes[0][2])
    )


def _fits_rows(columns: int) -> Callable[[Sequence[Shape], tuple[int, int]], bool]:
    """Rows (K, columns), and perhaps their number."""

    def fits(shapes: Sequence[Shape], _: tuple[int, int]) -> bool:
        numbers = [shape for shape in shapes[1:] if math.prod(shape) == 1]
        return len(shapes) == 1 + len(numbers) and len(shapes[0]) == 2 and shapes[0][1] == columns

    return fits


def _fits_yolov8(shapes: Sequence[Shape], _: tuple[int, int]) -> bool:
    return len(shapes) == 1 and len(shapes[0]) == 3 and min(shapes[0][1:]) > SIDES


def _fits_yolov5(shapes: Sequence[Shape], input_hw: tuple[int, int]) -> bool:
    return _fits_grid(6)(shapes, input_hw) and shapes[0][2] < shapes[0][1]


def _fits_yolox(shapes: Sequence[Shape], input_hw: tuple[int, int]) -> bool:
    return _fits_grid(6)(shapes, input_hw) and _yolox_strides(shapes[0][1], input_hw) is not None


def _fits_selected(shapes: Sequence[Shape], _: tuple[int, int]) -> bool:
    """Boxes (K, 4), labels (K,) and scores (K,), perhaps with a leading side of 1, and perhaps their number."""
    boxes = [shape for shape in shapes if shape[-1:] == (SIDES,) and len(shape) == max(map(len, shapes))]
    if len(shapes) not in (3, 4) or not boxes or len(boxes[0]) not in (2, 3):
        return False
    return sum(shape == boxes[0][:-1] for shape in shapes) in (2, 3)


def _fits_mmdet(shapes: Sequence[Shape], _: tuple[int, int]) -> bool:
    return len(shapes) == 2 and shapes[0][-1:] == (5,) and shapes[1] == shapes[0][:-1]


def _fits_pair(shapes: Sequence[Shape], _: tuple[int, int]) -> bool:
    """Boxes (B, A, 4) and scores (B, A, N), in any order."""
    same = len(shapes) == 2 and all(len(shape) == 3 for shape in shapes) and shapes[0][1] == shapes[1][1]
    return same and any(shape[2] == SIDES for shape in shapes)


def _fits_rtdetr(shapes: Sequence[Shape], input_hw: tuple[int, int]) -> bool:
    return _fits_pair(shapes, input_hw) or (_fits_grid(5)(shapes, input_hw) and shapes[0][1] <= MAX_SELECTED)


def _are_queries(outputs: NetworkOutputs) -> bool:
    """Whether a transformer's: few boxes, centres and sizes in shares of the input."""
    boxes = outputs.tensors[0] if len(outputs.tensors) == 1 else _split_pair(outputs.tensors)[0]
    few = boxes.shape[2] <= boxes.shape[1] <= MAX_SELECTED
    return few and _are_shares(boxes[..., :SIDES]) and _are_centred(boxes[..., :SIDES])


def _is_likely_detr(outputs: NetworkOutputs) -> bool:
    columns = _pair_columns(outputs.shapes)
    # sigmoid scores of COCO's numbers also have columns without a name
    sigmoid = columns == len(CLASS_LISTS["coco91"]) and outputs.classes in (None, CLASS_LISTS["coco91"])
    return outputs.has_background(columns) and not sigmoid and _are_queries(outputs)


def _is_likely_rfdetr(outputs: NetworkOutputs) -> bool:
    named = {"dets", "labels"} <= outputs.names or _pair_columns(outputs.shapes) == len(CLASS_LISTS["coco91"])
    return named and _are_queries(outputs)


def _is_likely_end_to_end(outputs: NetworkOutputs) -> bool:
    rows = outputs.tensors[0]
    labels = rows[..., 5]
    return rows.shape[1] <= MAX_SELECTED and bool((labels == labels.round()).all())


def _is_likely_yolov8(outputs: NetworkOutputs) -> bool:
    (shape,) = outputs.shapes
    return shape[1] < shape[2] or _yolov8_columns(outputs.shapes) in outputs.class_counts


def _is_likely_tfod(outputs: NetworkOutputs) -> bool:
    whole = any(not output.is_floating_point() for output in outputs.tensors)
    return not whole and any(name.startswith("detection_boxes") for name in outputs.names)


def _is_likely_tensorrt(outputs: NetworkOutputs) -> bool:
    return len(outputs.tensors) == 4 or any(name.startswith("num_det") for name in outputs.names)


def _yolox_strides(cells: int, input_hw: tuple[int, int]) -> tuple[int, ...] | None:
    """The strides that make so many cells; None if no usual ones do."""
    usual = ((8, 16, 32), (8, 16, 32, 64))
    return next((s for s in usual if cells == sum(math.prod(_grid_hw(input_hw, one)) for one in s)), None)


def _grid_hw(input_hw: tuple[int, int], stride: int) -> tuple[int, int]:
    """Rows and columns of cells."""
    return math.ceil(input_hw[0] / stride), math.ceil(input_hw[1] / stride)


def _cell_corners(input_hw: tuple[int, int], stride: int, like: Tensor) -> Tensor:
    """Column and row (cells, 2) of cells, row by row."""
    rows, columns = _grid_hw(input_hw, stride)
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    return torch.stack([x, y], dim=-1).view(-1, 2).to(like)


def _is_undecoded(cells: Tensor, input_hw: tuple[int, int]) -> bool:
    """Whether centres (B, A, 2+) count cells from their own: they are small, and do not follow the cells' places."""
    strides = _yolox_strides(cells.shape[1], input_hw) or ()
    places = torch.cat([(_cell_corners(input_hw, stride, cells) + 0.5) * stride for stride in strides])
    centres = cells[0, :, :2].detach()
    if float(centres.abs().max()) >= _RAW_SHARE * min(input_hw):
        return False
    correlations = [float(torch.corrcoef(torch.stack((places[:, i], centres[:, i])))[0, 1]) for i in (0, 1)]
    return max(correlations) < _FOLLOWS


def _yolov8_columns(shapes: Sequence[Shape]) -> int:
    return min(shapes[0][1:]) - SIDES


def _pair_columns(shapes: Sequence[Shape]) -> int:
    """Score columns; boxes come first if both outputs have four columns."""
    first, second = shapes[0][2], shapes[1][2]
    return second if first == SIDES else first


def _rtdetr_columns(shapes: Sequence[Shape]) -> int:
    return shapes[0][2] - SIDES if len(shapes) == 1 else _pair_columns(shapes)


def _read_end_to_end(outputs: Sequence[Tensor], _: tuple[int, int], spec: NetworkSpec) -> tuple[Tensor, Tensor]:
    """(B, K, 6): left, top, right, bottom, score, class."""
    output = outputs[0]
    return output[..., :4], _spread(output[..., 5], output[..., 4], spec)


def _read_yolov7(outputs: Sequence[Tensor], _: tuple[int, int], spec: NetworkSpec) -> tuple[Tensor, Tensor]:
    """(K, 7): image, left, top, right, bottom, class, score."""
    rows = outputs[0][None]
    return rows[..., 1:5], _spread(rows[..., 5], rows[..., 6], spec)


def _read_paddle(outputs: Sequence[Tensor], _: tuple[int, int], spec: NetworkSpec) -> tuple[Tensor, Tensor]:
    """(K, 6): class, score, left, top, right, bottom."""
    rows = outputs[0][None]
    return rows[..., 2:], _spread(rows[..., 0], rows[..., 1], spec)


def _read_mmdet(outputs: Sequence[Tensor], _: tuple[int, int], spec: NetworkSpec) -> tuple[Tensor, Tensor]:
    """(B, K, 5): left, top, right, bottom, score; (B, K): class."""
    rows, labels = outputs if outputs[0].ndim == 3 else [output[None] for output in outputs]
    return rows[..., :4], _spread(labels, rows[..., 4], spec)


def _read_yolov8(outputs: Sequence[Tensor], _: tuple[int, int], spec: NetworkSpec) -> tuple[Tensor, Tensor]:
    """(B, 4 + N, A), or transposed: A is the larger side."""
    cells = outputs[0]
    cells = cells.transpose(1, 2) if cells.shape[1] < cells.shape[2] else cells
    return cells[..., :4], activate(cells[..., 4:], spec)


def _read_yolov5(outputs: Sequence[Tensor], _: tuple[int, int], spec: NetworkSpec) -> tuple[Tensor, Tensor]:
    """(B, A, 5 + N): class scores are multiplied by objectness."""
    cells = outputs[0]
    objectness = cells[..., 4:5]
    objectness = objectness if spec.activation in (None, "none") else objectness.sigmoid()
    return cells[..., :4], objectness * activate(cells[..., 5:], spec)


def _read_yolox(outputs: Sequence[Tensor], input_hw: tuple[int, int], spec: NetworkSpec) -> tuple[Tensor, Tensor]:
    """(B, A, 5 + N) as YOLOv5's, or undecoded: centres count cells, sizes are logarithms of cells."""
    cells = outputs[0]
    boxes, scores = _read_yolov5(outputs, input_hw, spec)
    if not _is_undecoded(cells, input_hw):
        return boxes, scores
    strides = _yolox_strides(cells.shape[1], input_hw) or ()
    corners = torch.cat([_cell_corners(input_hw, stride, cells) for stride in strides])
    sides = torch.cat([cells.new_full((math.prod(_grid_hw(input_hw, s)), 1), s) for s in strides])
    return torch.cat(((boxes[..., :2] + corners) * sides, boxes[..., 2:].exp() * sides), -1), scores


def _read_rtdetr(outputs: Sequence[Tensor], input_hw: tuple[int, int], spec: NetworkSpec) -> tuple[Tensor, Tensor]:
    """Boxes and scores as a pair, or (B, K, 4 + N)."""
    if len(outputs) == 1:
        outputs = [outputs[0][..., :4], outputs[0][..., 4:]]
    return _read_pair(outputs, input_hw, spec)


def _read_selected(outputs: Sequence[Tensor], _: tuple[int, int], spec: NetworkSpec) -> tuple[Tensor, Tensor]:
    """Boxes (K, 4), labels (K,) and scores (K,) of one image, in any order, perhaps with a leading side of 1; their
    number, if given, is before the boxes or last.
    """
    deepest = max(output.ndim for output in outputs)
    boxes = next(output for output in outputs if output.ndim == deepest and output.shape[-1] == SIDES)
    others = [output for output in outputs if output is not boxes]
    if len(others) == 3:
        others = others[1:] if outputs[0] is not boxes else others[:2]
    # scores are floats; if labels are too, they come first
    labels, scores = sorted(others, key=lambda output: output.is_floating_point())
    return boxes.reshape(1, -1, 4), _spread(labels.reshape(1, -1), scores.reshape(1, -1), spec)


def _read_pair(outputs: Sequence[Tensor], _: tuple[int, int], spec: NetworkSpec) -> tuple[Tensor, Tensor]:
    """Boxes (B, A, 4) and scores (B, A, N), in any order."""
    boxes, scores = _split_pair(outputs)
    return boxes, activate(scores, spec)


def _split_pair(outputs: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Boxes and scores; boxes first if both have four columns."""
    first, second = outputs
    return (first, second) if first.shape[-1] == SIDES else (second, first)


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


def is_nanodet(shapes: Sequence[Shape], input_hw: tuple[int, int]) -> bool:
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
        logits = outputs[d].unflatten(2, (SIDES, BINS))
        bins = torch.arange(BINS, dtype=logits.dtype, device=logits.device)
        distance = (logits.softmax(dim=3) @ bins) * stride
        centre = (_cell_corners(input_hw, stride, bins) + 0.5) * stride
        boxes.append(torch.cat([centre - distance[..., :2], centre + distance[..., 2:]], dim=2))
        scores.append(outputs[s])
    return torch.cat(boxes, dim=1), torch.cat(scores, dim=1)


def _pairs(shapes: Sequence[Shape], input_hw: tuple[int, int]) -> list[tuple[int, int, int]]:
    """(index of scores, index of distances, stride) for each stride; ValueError if they do not match."""
    scores, distances = _cells(shapes, len(COCO_CLASSES)), _cells(shapes, SIDES * BINS)
    if not scores or scores.keys() != distances.keys() or 2 * len(scores) != len(shapes):
        raise ValueError(f"expected a pair of scores and distances a stride, found {list(shapes)}")
    found = []
    for cells, i in sorted(scores.items(), reverse=True):
        stride = round(math.sqrt(input_hw[0] * input_hw[1] / cells))
        if math.prod(_grid_hw(input_hw, stride)) != cells:
            raise ValueError(f"expected cells of one size over {input_hw}, found {cells}")
        found.append((i, distances[cells], stride))
    return found


def _cells(shapes: Sequence[Shape], columns: int) -> dict[int, int]:
    """Number of cells and index of each output (1, cells, columns)."""
    return {shape[1]: i for i, shape in enumerate(shapes) if len(shape) == 3 and shape[2] == columns}


NANODET = "nanodet"
_PAIRS = ("detr", "rfdetr", "rtdetr", "ssd")
"""Formats with boxes and scores apart; their conventions are measured."""
_GREY = 114 / 255
_ULTRALYTICS = NetworkSpec(pad=_GREY, boxes="cxcywh")
"""RGB in [0, 1], padded with its grey."""
_YOLOX = NetworkSpec(pad=_GREY, boxes="cxcywh", centred=False, channels="bgr", scale=255.0)
_IMAGENET = NetworkSpec(mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225))
_STRETCHED = NetworkSpec(resize="stretch")

FORMATS: tuple[OutputFormat, ...] = (
    OutputFormat(
        NANODET,
        NANODET_SPEC,
        is_nanodet,
        lambda outputs, input_hw, _: read_nanodet(outputs, input_hw),
        columns=lambda _: len(COCO_CLASSES),
    ),
    OutputFormat(
        "tfod",
        NetworkSpec(boxes="yxyx", normalised=True, resize="stretch", classes=CLASS_LISTS["coco91"]),
        _fits_selected,
        _read_selected,
        _is_likely_tfod,
    ),
    OutputFormat(
        "rtdetr-end2end",
        _STRETCHED,
        _fits_selected,
        _read_selected,
        lambda outputs: "orig_target_sizes" in outputs.names,
    ),
    OutputFormat(
        "tensorrt", replace(_ULTRALYTICS, boxes="xyxy"), _fits_selected, _read_selected, _is_likely_tensorrt
    ),
    OutputFormat("torchvision", NetworkSpec(classes=CLASS_LISTS["coco91"]), _fits_selected, _read_selected),
    OutputFormat("mmdet", NetworkSpec(), _fits_mmdet, _read_mmdet),
    OutputFormat("paddle", _STRETCHED, _fits_rows(6), _read_paddle),
    OutputFormat("yolov7", replace(_ULTRALYTICS, boxes="xyxy"), _fits_rows(7), _read_yolov7),
    OutputFormat(
        "end2end", replace(_ULTRALYTICS, boxes="xyxy"), _fits_grid(6, 6), _read_end_to_end, _is_likely_end_to_end
    ),
    OutputFormat(
        "detr",
        replace(_IMAGENET, boxes="cxcywh", normalised=True),
        _fits_pair,
        _read_pair,
        _is_likely_detr,
        _pair_columns,
    ),
    OutputFormat(
        "rfdetr",
        replace(_IMAGENET, boxes="cxcywh", normalised=True, resize="stretch", activation="sigmoid"),
        _fits_pair,
        _read_pair,
        _is_likely_rfdetr,
        _pair_columns,
    ),
    OutputFormat(
        "rtdetr",
        replace(_STRETCHED, boxes="cxcywh", normalised=True),
        _fits_rtdetr,
        _read_rtdetr,
        _are_queries,
        _rtdetr_columns,
    ),
    OutputFormat(
        "yolox",
        _YOLOX,
        _fits_yolox,
        _read_yolox,
        lambda outputs: _is_undecoded(outputs.tensors[0], outputs.input_hw),
        lambda shapes: shapes[0][2] - 5,
    ),
    OutputFormat("yolov8", _ULTRALYTICS, _fits_yolov8, _read_yolov8, _is_likely_yolov8, _yolov8_columns),
    OutputFormat("yolov5", _ULTRALYTICS, _fits_yolov5, _read_yolov5, columns=lambda shapes: shapes[0][2] - 5),
    OutputFormat("ssd", NetworkSpec(), _fits_pair, _read_pair, columns=_pair_columns),
)
"""Known formats; the first likely one with a known number of classes decodes a network's outputs."""
