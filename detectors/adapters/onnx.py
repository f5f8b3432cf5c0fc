"""Detectors as ONNX files, run by ONNX Runtime: they predict, and have no gradient.

What the graph gives is recognised from its outputs' shapes (`detectors.adapters.formats`); what it takes follows,
or is said by a YAML file (`detectors.adapters.spec`).
"""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from detectors import boxes
from detectors.adapters import coco
from detectors.adapters.formats import Shape, reading
from detectors.adapters.spec import MOST_SIDE, Fitted, Spec, fit, prepare, settings_of
from detectors.adapters.tiles import NMS_IOU, Window, cut, merge, windows
from detectors.base import DetectorError
from detectors.types import Detections

TILINGS = ("auto", "off")
LEAST_SCORE = 0.1
"""What scores less is not decoded: of many windows there would be thousands of boxes a picture."""
_QUIET = 3
"""ONNX Runtime's level of messages from which on it speaks: errors."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What the graph gave for one window of one image. fitted: where the window's picture lies in the input."""

    window: Window
    outputs: tuple[np.ndarray, ...]
    fitted: Fitted


@dataclass(frozen=True, slots=True)
class OnnxPredictions:
    """What the graph gave for each window of each of B images, before any choice is made. image_hw: their size."""

    images: tuple[tuple[Seen, ...], ...]
    image_hw: tuple[int, int]


class OnnxPredictor:
    """A `detectors.base.Predictor` from an ONNX file: images (B, 3, H, W) RGB in [0, 1], any size.

    name: of the file. tiling: "auto" looks at the whole picture and at overlapping windows of it (see
    `detectors.adapters.tiles`), "off" at the whole picture only. spec: a YAML file of settings; by default the one
    beside the graph, FILE.yaml for FILE.onnx, where there is one. Threads are as many as torch has when made.
    Raises DetectorError where the file, ONNX Runtime, or a format that fits is missing.
    """

    def __init__(self, path: Path, tiling: str = "auto", spec: Path | None = None) -> None:
        if tiling not in TILINGS:
            raise DetectorError(f"tiles: expected {' or '.join(TILINGS)}, found {tiling!r}")
        session = session_of(path)
        inputs = [(told.name, list(told.shape)) for told in session.get_inputs()]
        shapes: list[Shape] = [tuple(output.shape) for output in session.get_outputs()]
        names = _names(session.get_modelmeta().custom_metadata_map)
        settings = settings_of(path, spec)
        self.input_hw = _input_hw(path, inputs, settings.get("size"))
        self._reading = reading(shapes, self.input_hw, settings, names, str(path))
        flat_image = len(inputs[0][1]) == 3
        self._spec: Spec = replace(
            self._reading.spec, size=self.input_hw, **({"input": "image"} if flat_image else {})
        )
        self.format = self._reading.format
        self.name = path.stem
        self.classes = self._reading.classes
        if self._spec.t_star is not None:
            self.t_star = self._spec.t_star
        self._nms_iou = NMS_IOU if self._spec.nms_iou is None else self._spec.nms_iou
        self._least_score = LEAST_SCORE if self._spec.least_score is None else self._spec.least_score
        self._tiling = tiling
        self._session = session
        self._input = inputs[0][0]

    def forward(self, images: Tensor) -> OnnxPredictions:
        """images (B, 3, H, W), RGB in [0, 1]; carries no gradient."""
        height, width = images.shape[2:]
        whole = [Window(0, 0, width, height)]
        parts = windows(height, width, self.input_hw) if self._tiling == "auto" else whole
        seen = tuple(tuple(self._look(image, window) for window in parts) for image in images.detach())
        return OnnxPredictions(seen, (height, width))

    def decode(self, raw: OnnxPredictions) -> list[Detections]:
        """One Detections for each image, best first, boxes inside the image."""
        return [self._merged(seen, raw.image_hw) for seen in raw.images]

    def _look(self, image: Tensor, window: Window) -> Seen:
        part = image[None, :, window.y0 : window.y1, window.x0 : window.x1].float().cpu()
        fed, fitted = fit(part, self._spec)
        fed = prepare(fed, self._spec)
        given = fed if self._spec.input == "batch" else fed[0]
        outputs = self._session.run(None, {self._input: given.contiguous().numpy()})
        return Seen(window, tuple(outputs), fitted)

    def _merged(self, seen: Sequence[Seen], image_hw: tuple[int, int]) -> Detections:
        found: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
        for one in seen:
            outputs = [torch.from_numpy(output) for output in one.outputs]
            (edges,), (all_scores,) = self._reading.read(outputs, self.input_hw)
            cells, labels = (all_scores > self._least_score).nonzero(as_tuple=True)
            scores = all_scores[cells, labels]
            placed = _placed(edges[cells], one)
            # What lies in the padding around the picture has no area left in it.
            there = boxes.area(boxes.clip(placed, *image_hw)) > 0
            placed, scores, labels = placed[there], scores[there], labels[there]
            kept = boxes.nms(placed, scores, self._nms_iou, labels)
            placed = placed[kept]
            found.append((placed, scores[kept], labels[kept], cut(placed, one.window, image_hw)))
        placed, scores, labels, is_cut = (torch.cat(parts) for parts in zip(*found, strict=True))
        if len(seen) > 1:
            kept = merge(placed, scores, labels, is_cut)
            placed, scores, labels = placed[kept], scores[kept], labels[kept]
        return Detections(boxes.clip(placed, *image_hw), labels, scores)


def session_of(path: Path) -> Any:
    """The graph of an ONNX file, ready to run, with as many threads as torch has now. Raises DetectorError where
    the file, or ONNX Runtime, is missing, or the file is damaged.
    """
    runtime = _runtime(path)
    if not path.is_file():
        raise DetectorError(f"{path}: expected an ONNX file, found none")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.inter_op_num_threads = 1
    options.log_severity_level = _QUIET
    # A thread that waits by spinning takes its core from torch's.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        # A name that is no text is told only where it is read, as UnicodeDecodeError.
        for told in (*session.get_inputs(), *session.get_outputs()):
            _ = told.name, told.shape
        _ = session.get_modelmeta().custom_metadata_map
        return session
    except Exception as error:  # ONNX Runtime's own classes differ from version to version
        raise DetectorError(f"{path}: expected an ONNX graph, found {_first_line(error)}") from None


def _placed(edges: Tensor, seen: Seen) -> Tensor:
    """Boxes (N, 4) of the network's input, edges of pixels, as boxes of the image, cut to the window."""
    origin = edges.new_tensor([seen.window.x0, seen.window.y0])
    end = edges.new_tensor([seen.window.x1, seen.window.y1])
    placed = seen.fitted.back(edges) + origin.repeat(2)
    # Pixel centres lie at integers: the first pixel's left edge is at -1/2.
    return torch.minimum(torch.maximum(placed, origin.repeat(2) - 0.5), end.repeat(2) - 0.5)


def _runtime(path: Path) -> ModuleType:
    try:
        import onnxruntime
    except ImportError:
        raise DetectorError(f"{path}: needs ONNX Runtime: pip install 'onnxruntime>=1.19'") from None
    return onnxruntime


def _input_hw(
    path: Path, inputs: Sequence[tuple[str, list[Any]]], size: tuple[int, int] | None
) -> tuple[int, int]:
    """Height and width px of the one image that a graph takes. inputs: names and shapes; size: a YAML file's, for
    sides left open.
    """
    shape = inputs[0][1] if len(inputs) == 1 else []
    one = len(shape) == 3 or (len(shape) == 4 and (shape[0] == 1 or not isinstance(shape[0], int)))
    if one and (shape[-3] == 3 or not isinstance(shape[-3], int)):
        fixed = tuple(side if isinstance(side, int) else None for side in shape[-2:])
        if not all(side is None or 1 <= side <= MOST_SIDE for side in fixed):
            raise DetectorError(f"{path}: expected an input of 1 to {MOST_SIDE} px a side, found {shape}")
        if size is not None and all(side in (None, given) for side, given in zip(fixed, size, strict=True)):
            return size
        if size is None and None not in fixed:
            return fixed[0] or 0, fixed[1] or 0
    found = ", ".join(f"{name} {shape}" for name, shape in inputs)
    expected = f"of {size[0]} x {size[1]}" if size else "of fixed size (or `size` in a YAML file)"
    raise DetectorError(f"{path}: expected one input (1, 3, height, width) {expected}, found {found}")


def _names(metadata: Mapping[str, str]) -> tuple[str, ...] | None:
    """Classes as Ultralytics' export writes them into a file: "{0: 'person', 1: ...}"."""
    try:
        names = ast.literal_eval(metadata.get("names", ""))
        listed = [str(names[i]) for i in range(len(names))]
    except (ValueError, SyntaxError, TypeError, KeyError):
        return None
    return coco.ours(listed)


def _first_line(error: Exception) -> str:
    return str(error).strip().split("\n")[0]
