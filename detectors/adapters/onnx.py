"""Detectors as ONNX files, run by ONNX Runtime: they predict, and have no gradient.

What the graph takes and gives is recognised from its outputs' shapes (`FORMATS`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from detectors import boxes
from detectors.adapters import nanodet
from detectors.adapters.formats import Format
from detectors.adapters.tiles import NMS_IOU, Window, cut, merge, windows
from detectors.base import DetectorError
from detectors.types import Detections

TILINGS = ("auto", "off")
LEAST_SCORE = 0.1
"""What scores less is not decoded: of many windows there would be thousands of boxes a picture."""
_QUIET = 3
"""ONNX Runtime's level of messages from which on it speaks: errors."""


FORMATS: tuple[Format, ...] = (nanodet.FORMAT,)
"""The families of graphs that are known; the first that recognises a graph's outputs reads them."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What the graph gave for one window of one image. scale: px of the network's input a px of the image;
    offset_xy: px of the input left of and above the window's picture in it."""

    window: Window
    outputs: tuple[np.ndarray, ...]
    scale: float
    offset_xy: tuple[int, int]


@dataclass(frozen=True, slots=True)
class OnnxPredictions:
    """What the graph gave for each window of each of B images, before any choice is made. image_hw: their size."""

    images: tuple[tuple[Seen, ...], ...]
    image_hw: tuple[int, int]


class OnnxPredictor:
    """A `detectors.base.Predictor` from an ONNX file: images (B, 3, H, W) RGB in [0, 1], any size.

    name: of the file. tiling: "auto" looks at the whole picture and at overlapping windows of it (see
    `detectors.adapters.tiles`), "off" at the whole picture only. Threads are as many as torch has when it is made.
    Raises DetectorError where the file, ONNX Runtime, or a format that fits is missing.
    """

    def __init__(self, path: Path, tiling: str = "auto") -> None:
        if tiling not in TILINGS:
            raise DetectorError(f"tiles: expected {' or '.join(TILINGS)}, found {tiling!r}")
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
        except Exception as error:  # ONNX Runtime's own classes differ from version to version
            raise DetectorError(f"{path}: expected an ONNX graph, found {_first_line(error)}") from None
        self.input_hw = _input_hw(path, session.get_inputs())
        self.format = _format(path, session.get_outputs(), self.input_hw)
        self.name = path.stem
        self.classes = self.format.classes
        self._tiling = tiling
        self._session = session
        self._input = session.get_inputs()[0].name

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
        high, wide = part.shape[2:]
        scale = min(self.input_hw[0] / high, self.input_hw[1] / wide)
        size = (min(round(scale * high), self.input_hw[0]), min(round(scale * wide), self.input_hw[1]))
        if size != (high, wide):
            part = F.interpolate(part, size, mode="bilinear", antialias=True, align_corners=False)
        left, top = (self.input_hw[1] - size[1]) // 2, (self.input_hw[0] - size[0]) // 2
        right, bottom = self.input_hw[1] - size[1] - left, self.input_hw[0] - size[0] - top
        fed = self.format.prepare(F.pad(part, (left, right, top, bottom)))
        outputs = self._session.run(None, {self._input: fed.contiguous().numpy()})
        return Seen(window, tuple(outputs), scale, (left, top))

    def _merged(self, seen: Sequence[Seen], image_hw: tuple[int, int]) -> Detections:
        found: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
        for one in seen:
            edges, all_scores = self.format.read(one.outputs, self.input_hw)
            cells, labels = (all_scores > LEAST_SCORE).nonzero(as_tuple=True)
            scores = all_scores[cells, labels]
            placed = _placed(edges[cells], one)
            kept = boxes.nms(placed, scores, NMS_IOU, labels)
            placed = placed[kept]
            found.append((placed, scores[kept], labels[kept], cut(placed, one.window, image_hw)))
        placed, scores, labels, is_cut = (torch.cat(parts) for parts in zip(*found, strict=True))
        kept = merge(placed, scores, labels, is_cut)
        return Detections(boxes.clip(placed[kept], *image_hw), labels[kept], scores[kept])


def _placed(edges: Tensor, seen: Seen) -> Tensor:
    """Boxes (N, 4) of the network's input, edges of pixels, as boxes of the image, cut to the window."""
    offset = edges.new_tensor(seen.offset_xy).repeat(2)
    window = edges.new_tensor([seen.window.x0, seen.window.y0, seen.window.x1, seen.window.y1])
    placed = (edges - offset) / seen.scale + window[:2].repeat(2)
    placed = torch.minimum(torch.maximum(placed, window[:2].repeat(2)), window[2:].repeat(2))
    # Pixel centres lie at integers: the first pixel's left edge is at -1/2.
    return placed - 0.5


def _runtime(path: Path) -> ModuleType:
    try:
        import onnxruntime
    except ImportError:
        raise DetectorError(f"{path}: needs ONNX Runtime: pip install 'onnxruntime>=1.19'") from None
    return onnxruntime


def _input_hw(path: Path, inputs: Sequence[Any]) -> tuple[int, int]:
    """Height and width px of the one image that a graph takes."""
    shape = list(inputs[0].shape) if len(inputs) == 1 else None
    if shape is None or len(shape) != 4 or shape[1] != 3 or not all(isinstance(side, int) for side in shape[2:]):
        found = ", ".join(f"{i.name} {i.shape}" for i in inputs)
        raise DetectorError(f"{path}: expected one input (1, 3, height, width) of fixed size, found {found}")
    return shape[2], shape[3]


def _format(path: Path, outputs: Sequence[Any], input_hw: tuple[int, int]) -> Format:
    """The family of graphs that gives such outputs."""
    shapes = [tuple(output.shape) for output in outputs]
    for form in FORMATS:
        if form.recognises(shapes, input_hw):
            return form
    found = ", ".join(f"{o.name} {o.shape}" for o in outputs)
    raise DetectorError(
        f"{path}: expected the outputs of {' or '.join(form.name for form in FORMATS)}, found {found}"
    )


def _first_line(error: Exception) -> str:
    return str(error).strip().split("\n")[0]
