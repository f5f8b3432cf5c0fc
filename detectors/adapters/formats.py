"""What detectors' networks give: one description for each family, recognised by the shapes of its outputs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from detectors.adapters import nanodet
from detectors.adapters.spec import CLASS_LISTS, NO_CLASS, Layout, Spec, named
from detectors.base import DetectorError

Shape = tuple[int | str | None, ...]
"""Of an output; a name, or None, where a graph leaves a side open."""

_END_TO_END = (100, 300)
"""Boxes that networks with suppression inside give: torchvision's number, and Ultralytics'."""


@dataclass(frozen=True, slots=True)
class Format:
    """How one family of networks is fed and read.

    spec: what its networks usually want. recognises: whether outputs of these shapes, at this input size (height,
    width), are this family's. columns: of scores, from the shapes; None where they do not tell. read: outputs for
    B images, the input size, the spec -> boxes (B, A, 4) as `spec.boxes` has them, and scores (B, A, N).
    """

    name: str
    spec: Spec
    recognises: Callable[[Sequence[Shape], tuple[int, int]], bool]
    columns: Callable[[Sequence[Shape]], int | None]
    read: Callable[[Sequence[Tensor], tuple[int, int], Spec], tuple[Tensor, Tensor]]


@dataclass(frozen=True, slots=True)
class Reading:
    """A format with all settings made: reads the outputs of one network. spec.classes is never None."""

    format: Format
    spec: Spec

    @property
    def classes(self) -> tuple[str, ...]:
        """What labels are indices into."""
        return tuple(name for name in self.spec.classes or () if name != NO_CLASS)

    def read(self, outputs: Sequence[Tensor], input_hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Boxes (B, A, 4) px of the input, edges counted from its corner, and scores (B, A, C) in [0, 1]."""
        boxes, scores = self.format.read(outputs, input_hw, self.spec)
        boxes = _edges(boxes, self.spec.boxes or "xyxy")
        if self.spec.normalised:
            boxes = boxes * boxes.new_tensor([input_hw[1], input_hw[0]]).repeat(2)
        return boxes, named(scores, self.spec.classes or ())[0]


def reading(
    shapes: Sequence[Shape],
    input_hw: tuple[int, int],
    settings: Mapping[str, Any],
    names: tuple[str, ...] | None,
    where: str,
) -> Reading:
    """How outputs of these shapes are read. settings: of a Spec, they win; names: of classes, as a file has them.

    Raises DetectorError, beginning with `where`, for outputs of no known family, a format that does not fit, or
    classes whose number is not that of the scores.
    """
    wanted = settings.get("format")
    known = {form.name: form for form in FORMATS}
    found = ", ".join(str(list(shape)) for shape in shapes) or "none"
    if wanted is not None and wanted not in known:
        raise DetectorError(f"{where}: format: expected one of {', '.join(known)}, found {wanted!r}")
    fitting = [form for form in FORMATS if (wanted is None or form.name == wanted)]
    form = next((form for form in fitting if form.recognises(shapes, input_hw)), None)
    if form is None:
        raise DetectorError(
            f"{where}: expected the outputs of {' or '.join(form.name for form in fitting)}, found {found}"
        )
    spec = replace(form.spec, **settings)
    columns = form.columns(shapes)
    spec = replace(spec, classes=_classes(settings, names, form, columns, where))
    return Reading(form, spec)


def _classes(
    settings: Mapping[str, Any], names: tuple[str, ...] | None, form: Format, columns: int | None, where: str
) -> tuple[str, ...]:
    given: tuple[str, ...] | None = settings.get("classes") or names
    if given is None:
        usual = [form.spec.classes] if form.spec.classes else []
        given = next((n for n in (*usual, *CLASS_LISTS.values()) if columns is None or len(n) == columns), None)
    if given is None:
        raise DetectorError(f"{where}: classes: expected {columns} names in a YAML file, found none")
    if columns is not None and len(given) != columns:
        raise DetectorError(f"{where}: classes: expected {columns}, one a column of scores, found {len(given)}")
    return given


def flat(outputs: Any) -> list[Tensor]:
    """The tensors in whatever a network gives, in order; of a mapping with boxes, labels and scores, those."""
    if isinstance(outputs, Tensor):
        return [outputs]
    if isinstance(outputs, Mapping):
        keys = [key for key in ("boxes", "labels", "scores") if key in outputs]
        return [tensor for key in (keys or outputs) for tensor in flat(outputs[key])]
    if isinstance(outputs, Sequence) and not isinstance(outputs, str):
        return [tensor for output in outputs for tensor in flat(output)]
    return []


def activated(logits: Tensor, spec: Spec) -> Tensor:
    """Scores in [0, 1] of a network's (..., N)."""
    if spec.activation == "sigmoid":
        return logits.sigmoid()
    return logits.softmax(-1) if spec.activation == "softmax" else logits


def _edges(boxes: Tensor, layout: Layout) -> Tensor:
    """Boxes (..., 4) as left, top, right, bottom."""
    first, second = boxes[..., :2], boxes[..., 2:]
    if layout == "cxcywh":
        return torch.cat((first - second / 2, first + second / 2), -1)
    if layout == "xywh":
        return torch.cat((first, first + second), -1)
    return torch.cat((first.flip(-1), second.flip(-1)), -1) if layout == "yxyx" else boxes


def _grid(shapes: Sequence[Shape]) -> tuple[int, int] | None:
    """Of a single output (B, m, n) its m and n, an open side as a very large one."""
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


def _read_end_to_end(outputs: Sequence[Tensor], _: tuple[int, int], spec: Spec) -> tuple[Tensor, Tensor]:
    """(B, K, 6): left, top, right, bottom, score, class."""
    output = outputs[0]
    return output[..., :4], _spread(output[..., 5], output[..., 4], spec)


def _read_yolov8(outputs: Sequence[Tensor], _: tuple[int, int], spec: Spec) -> tuple[Tensor, Tensor]:
    """(B, 4 + N, A)."""
    cells = outputs[0].transpose(1, 2)
    return cells[..., :4], activated(cells[..., 4:], spec)


def _read_yolov5(outputs: Sequence[Tensor], _: tuple[int, int], spec: Spec) -> tuple[Tensor, Tensor]:
    """(B, A, 5 + N): a class is as probable as it and an object are."""
    cells = outputs[0]
    thing = cells[..., 4:5]
    thing = thing if spec.activation in (None, "none") else thing.sigmoid()
    return cells[..., :4], thing * activated(cells[..., 5:], spec)


def _read_torchvision(outputs: Sequence[Tensor], _: tuple[int, int], spec: Spec) -> tuple[Tensor, Tensor]:
    """Boxes (K, 4), labels (K,) and scores (K,) of one image, with or without a side of 1 before; in any order."""
    deepest = max(output.ndim for output in outputs)
    boxes = next(output for output in outputs if output.ndim == deepest and output.shape[-1] == 4)
    others = [output for output in outputs if output is not boxes]
    # scores are no whole numbers; where labels come as floats too, they come first
    labels, scores = sorted(others, key=lambda output: output.is_floating_point())
    return boxes.reshape(1, -1, 4), _spread(labels.reshape(1, -1), scores.reshape(1, -1), spec)


def _read_ssd(outputs: Sequence[Tensor], _: tuple[int, int], spec: Spec) -> tuple[Tensor, Tensor]:
    """Boxes (B, A, 4) and scores (B, A, N), in any order; boxes first where both have four columns."""
    first, second = outputs
    boxes, scores = (first, second) if first.shape[-1] == 4 else (second, first)
    return boxes, activated(scores, spec)


def _spread(labels: Tensor, scores: Tensor, spec: Spec) -> Tensor:
    """Scores (B, K) of one class each as (B, K, N), all others at 0. Labels beyond the classes are nothing."""
    count = len(spec.classes or ())
    place = labels.long()
    there = (place >= 0) & (place < count)
    spread = scores.new_zeros((*scores.shape, count))
    return spread.scatter(-1, (place * there)[..., None], (scores * there)[..., None])


_ULTRALYTICS = Spec(pad=114 / 255, boxes="cxcywh")
"""The grey it fills up with; RGB in [0, 1]."""

FORMATS: tuple[Format, ...] = (
    Format(
        "nanodet",
        nanodet.SPEC,
        nanodet.recognises,
        lambda _: len(nanodet.SPEC.classes or ()),
        lambda outputs, input_hw, _: nanodet.read(outputs, input_hw),
    ),
    Format("end2end", replace(_ULTRALYTICS, boxes="xyxy"), _is_end_to_end, lambda _: None, _read_end_to_end),
    Format("yolov8", _ULTRALYTICS, _is_yolov8, lambda shapes: _less(shapes[0][1], 4), _read_yolov8),
    Format("yolov5", _ULTRALYTICS, _is_yolov5, lambda shapes: _less(shapes[0][2], 5), _read_yolov5),
    Format("torchvision", Spec(classes=CLASS_LISTS["coco91"]), _is_torchvision, lambda _: None, _read_torchvision),
    Format(
        "ssd",
        Spec(),
        _is_ssd,
        lambda shapes: _less(shapes[0][2] if shapes[1][2] == 4 and shapes[0][2] != 4 else shapes[1][2], 0),
        _read_ssd,
    ),
)
"""The families that are known; the first that recognises a network's outputs reads them."""


def _less(side: int | str | None, boxes: int) -> int | None:
    """Columns of scores in a side that holds other numbers too."""
    return side - boxes if isinstance(side, int) else None
