"""ONNX files as detectors without a gradient, run by ONNX Runtime.

The output format is recognised from the shapes (`detectors.adapters.formats`); the input follows from it, or from
a YAML file (`detectors.adapters.spec`).
"""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from detectors import boxes
from detectors.adapters.formats import Shape, make_decoder
from detectors.adapters.spec import (
    MAX_SIDE,
    ImagePlacement,
    NetworkSpec,
    fit_images,
    load_settings,
    normalise_images,
    with_project_names,
)
from detectors.base import DetectorError
from detectors.boxes import ioa_matrix, nms
from detectors.types import Detections

TILINGS = ("auto", "off")
LEAST_SCORE = 0.1
"""Lowest decoded score: many tiles would otherwise give thousands of boxes per image."""
_LOG_ERRORS = 3
"""ONNX Runtime's log level for errors only."""


@dataclass(frozen=True, slots=True)
class TileOutputs:
    """The network's outputs for one tile of one image."""

    tile: Tile
    """The tile."""
    outputs: tuple[np.ndarray, ...]
    """One array per output."""
    placement: ImagePlacement
    """Where the tile lies in the network's input."""


@dataclass(frozen=True, slots=True)
class OnnxPredictions:
    """The network's outputs for all tiles of B images."""

    images: tuple[tuple[TileOutputs, ...], ...]
    """The tiles of each image."""
    image_hw: tuple[int, int]
    """Size of the images, px."""


class OnnxPredictor:
    """A detector from an ONNX file: images (B, 3, H, W), RGB in [0, 1], any size."""

    def __init__(self, path: Path, tiling: str = "auto", spec: Path | None = None) -> None:
        """Load the graph, with as many threads as torch has now.

        Args:
            path: The ONNX file.
            tiling: "auto" detects in the whole image and in overlapping tiles (`detectors.adapters.onnx`), "off"
                only in the whole image.
            spec: YAML file of settings; by default FILE.yaml for FILE.onnx, if there is one.

        Raises:
            DetectorError: The file or ONNX Runtime is missing, or no format fits.
        """
        if tiling not in TILINGS:
            raise DetectorError(f"tiles: expected {' or '.join(TILINGS)}, found {tiling!r}")
        session = open_session(path)
        inputs = [(node.name, list(node.shape)) for node in session.get_inputs()]
        shapes: list[Shape] = [tuple(output.shape) for output in session.get_outputs()]
        names = _names(session.get_modelmeta().custom_metadata_map)
        settings = load_settings(path, spec)
        self.input_hw = _input_hw(path, inputs, settings.get("size"))
        self._decoder = make_decoder(shapes, self.input_hw, settings, names, str(path))
        flat_image = len(inputs[0][1]) == 3
        self._spec: NetworkSpec = replace(
            self._decoder.spec, size=self.input_hw, **({"input": "image"} if flat_image else {})
        )
        self.format = self._decoder.format
        self.name = path.stem
        self.classes = self._decoder.classes
        if self._spec.t_star is not None:
            self.t_star = self._spec.t_star
        self._nms_iou = NMS_IOU if self._spec.nms_iou is None else self._spec.nms_iou
        self._least_score = LEAST_SCORE if self._spec.least_score is None else self._spec.least_score
        self._tiling = tiling
        self._session = session
        self._input = inputs[0][0]

    def forward(self, images: Tensor) -> OnnxPredictions:
        """images (B, 3, H, W), RGB in [0, 1]; no gradient."""
        height, width = images.shape[2:]
        whole = [Tile(0, 0, width, height)]
        parts = make_tiles(height, width, self.input_hw) if self._tiling == "auto" else whole
        tiles = tuple(tuple(self._run_tile(image, tile) for tile in parts) for image in images.detach())
        return OnnxPredictions(tiles, (height, width))

    def decode(self, raw: OnnxPredictions) -> list[Detections]:
        """One Detections per image, best first, boxes inside the image."""
        return [self._merge(tiles, raw.image_hw) for tiles in raw.images]

    def _run_tile(self, image: Tensor, tile: Tile) -> TileOutputs:
        part = image[None, :, tile.y0 : tile.y1, tile.x0 : tile.x1].float().cpu()
        network_input, placement = fit_images(part, self._spec)
        network_input = normalise_images(network_input, self._spec)
        given = network_input if self._spec.input == "batch" else network_input[0]
        outputs = self._session.run(None, {self._input: given.contiguous().numpy()})
        return TileOutputs(tile, tuple(outputs), placement)

    def _merge(self, tiles: Sequence[TileOutputs], image_hw: tuple[int, int]) -> Detections:
        per_tile: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
        for tile_outputs in tiles:
            outputs = [torch.from_numpy(output) for output in tile_outputs.outputs]
            (edges,), (all_scores,) = self._decoder.decode(outputs, self.input_hw)
            cells, labels = (all_scores > self._least_score).nonzero(as_tuple=True)
            scores = all_scores[cells, labels]
            boxes_xyxy = _to_image(edges[cells], tile_outputs)
            # Boxes in the padding have no area left in the image.
            inside = boxes.area(boxes.clip(boxes_xyxy, *image_hw)) > 0
            boxes_xyxy, scores, labels = boxes_xyxy[inside], scores[inside], labels[inside]
            selected = boxes.nms(boxes_xyxy, scores, self._nms_iou, labels)
            boxes_xyxy = boxes_xyxy[selected]
            is_cut = is_cut_by_tile(boxes_xyxy, tile_outputs.tile, image_hw)
            per_tile.append((boxes_xyxy, scores[selected], labels[selected], is_cut))
        boxes_xyxy, scores, labels, is_cut = (torch.cat(parts) for parts in zip(*per_tile, strict=True))
        if len(tiles) > 1:
            selected = merge_tiles(boxes_xyxy, scores, labels, is_cut)
            boxes_xyxy, scores, labels = boxes_xyxy[selected], scores[selected], labels[selected]
        return Detections(boxes.clip(boxes_xyxy, *image_hw), labels, scores)


def open_session(path: Path) -> Any:
    """The graph of an ONNX file, ready to run with as many threads as torch has now.

    Raises:
        DetectorError: The file or ONNX Runtime is missing, or the file is damaged.
    """
    runtime = _runtime(path)
    if not path.is_file():
        raise DetectorError(f"{path}: expected an ONNX file, found none")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.inter_op_num_threads = 1
    options.log_severity_level = _LOG_ERRORS
    # Threads that spin while waiting take cores from torch.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        # A name that is not UTF-8 raises UnicodeDecodeError only when read.
        for node in (*session.get_inputs(), *session.get_outputs()):
            _ = node.name, node.shape
        _ = session.get_modelmeta().custom_metadata_map
        return session
    except Exception as error:  # ONNX Runtime's error classes differ between versions
        raise DetectorError(f"{path}: expected an ONNX graph, found {_first_line(error)}") from None


def _to_image(edges: Tensor, tiles: TileOutputs) -> Tensor:
    """Boxes (N, 4) of the network's input, as pixel edges, in px of the image, clipped to the tile."""
    origin = edges.new_tensor([tiles.tile.x0, tiles.tile.y0])
    end = edges.new_tensor([tiles.tile.x1, tiles.tile.y1])
    boxes_xyxy = tiles.placement.to_image(edges) + origin.repeat(2)
    # Pixel centres are integers: the first pixel's left edge is at -1/2.
    return torch.minimum(torch.maximum(boxes_xyxy, origin.repeat(2) - 0.5), end.repeat(2) - 0.5)


def _runtime(path: Path) -> ModuleType:
    try:
        import onnxruntime
    except ImportError:
        raise DetectorError(f"{path}: needs ONNX Runtime: pip install 'onnxruntime>=1.19'") from None
    return onnxruntime


def _input_hw(
    path: Path, inputs: Sequence[tuple[str, list[Any]]], size: tuple[int, int] | None
) -> tuple[int, int]:
    """Height and width of the graph's single image, px.

    Args:
        path: The ONNX file.
        inputs: Names and shapes.
        size: From a YAML file, for open sides.
    """
    shape = inputs[0][1] if len(inputs) == 1 else []
    output = len(shape) == 3 or (len(shape) == 4 and (shape[0] == 1 or not isinstance(shape[0], int)))
    if output and (shape[-3] == 3 or not isinstance(shape[-3], int)):
        fixed = tuple(side if isinstance(side, int) else None for side in shape[-2:])
        if not all(side is None or 1 <= side <= MAX_SIDE for side in fixed):
            raise DetectorError(f"{path}: expected an input of 1 to {MAX_SIDE} px a side, found {shape}")
        if size is not None and all(side in (None, given) for side, given in zip(fixed, size, strict=True)):
            return size
        if size is None and None not in fixed:
            return fixed[0] or 0, fixed[1] or 0
    found = ", ".join(f"{name} {shape}" for name, shape in inputs)
    expected = f"of {size[0]} x {size[1]}" if size else "of fixed size (or `size` in a YAML file)"
    raise DetectorError(f"{path}: expected one input (1, 3, height, width) {expected}, found {found}")


def _names(metadata: Mapping[str, str]) -> tuple[str, ...] | None:
    """Class names as Ultralytics' export writes them: "{0: 'person', 1: ...}"."""
    try:
        names = ast.literal_eval(metadata.get("names", ""))
        listed = [str(names[i]) for i in range(len(names))]
    except (ValueError, SyntaxError, TypeError, KeyError):
        return None
    return with_project_names(listed)


def _first_line(error: Exception) -> str:
    return str(error).strip().split("\n")[0]


OVERLAP = 0.3
"""Share of a tile's side that overlaps the next: smaller objects are complete in one of them."""
MAX_ENLARGEMENT = 1.0
"""Largest enlargement of a tile. At 1.34, NanoDet-m finds no more of the 41 cars in 14 KITTI frames (39), but 2.5
times as many false ones.
"""
BORDER = 0.02
"""Share of a tile's side: a box ending this near to a tile border inside the image counts as cut."""
NMS_IOU = 0.5
"""IoU of suppression: boxes of one car differ more between scales than within one (NanoDet's is 0.6)."""
INSIDE = 0.5
"""Share of a cut box inside a complete one of its class from which it counts as a part of it."""


@dataclass(frozen=True, slots=True)
class Tile:
    """A rectangle of an image."""

    x0: int
    """First column."""
    y0: int
    """First row."""
    x1: int
    """Last column + 1."""
    y1: int
    """Last row + 1."""


def make_tiles(height: int, width: int, input_hw: tuple[int, int]) -> list[Tile]:
    """Tiles of an image: the whole, then finer ones, row by row.

    The whole suffices if the image has the network's shape and is not much larger.

    Args:
        height: Of the image, px.
        width: Of the image, px.
        input_hw: Of the network, px.
    """
    tiles = [Tile(0, 0, width, height)]
    scale = min(input_hw[0] / height, input_hw[1] / width)
    while scale * 2 <= MAX_ENLARGEMENT:
        scale *= 2
        rows = _spans(height, min(math.ceil(input_hw[0] / scale), height))
        columns = _spans(width, min(math.ceil(input_hw[1] / scale), width))
        tiles += [Tile(x0, y0, x1, y1) for y0, y1 in rows for x0, x1 in columns]
    return tiles


def _spans(length: int, side: int) -> list[tuple[int, int]]:
    """Evenly spaced, overlapping spans of `side` px that cover `length` px."""
    if side >= length:
        return [(0, length)]
    count = 1 + math.ceil((length - side) / (side * (1 - OVERLAP)))
    starts = [round(i * (length - side) / (count - 1)) for i in range(count)]
    return [(start, start + side) for start in starts]


def is_cut_by_tile(boxes_xyxy: Tensor, tile: Tile, image_hw: tuple[int, int]) -> Tensor:
    """(N,) bool: whether boxes end at a tile border inside the image.

    Args:
        boxes_xyxy: (N, 4) px.
        window: The tile.
        image_hw: Size of the image, px.
    """
    height, width = image_hw
    near_x, near_y = BORDER * (tile.x1 - tile.x0), BORDER * (tile.y1 - tile.y0)
    left, top, right, bottom = boxes_xyxy.unbind(dim=1)
    tiles = torch.zeros_like(left, dtype=torch.bool)
    if tile.x0 > 0:
        tiles |= left < tile.x0 + near_x
    if tile.y0 > 0:
        tiles |= top < tile.y0 + near_y
    if tile.x1 < width:
        tiles |= right > tile.x1 - 1 - near_x
    if tile.y1 < height:
        tiles |= bottom > tile.y1 - 1 - near_y
    return tiles


def merge_tiles(boxes_xyxy: Tensor, scores: Tensor, labels: Tensor, is_cut: Tensor) -> Tensor:
    """Suppress the boxes of all tiles of an image.

    Complete boxes suppress each other per class as usual. A cut box is dropped, at any score, if more than half of
    its area lies in a complete one of its class; otherwise no tile contains the complete object, and it remains.

    Args:
        boxes_xyxy: (N, 4) px.
        scores: (N,).
        labels: (N,).
        is_cut: (N,) bool.

    Returns:
        Indices (K,) int64 of the remaining boxes, best first.
    """
    whole, parts = (~is_cut).nonzero()[:, 0], is_cut.nonzero()[:, 0]
    selected = whole[nms(boxes_xyxy[whole], scores[whole], NMS_IOU, labels[whole])]
    contained = ioa_matrix(boxes_xyxy[parts], boxes_xyxy[selected]) > INSIDE
    same_class = labels[parts][:, None] == labels[selected][None, :]
    parts = parts[~(contained & same_class).any(dim=1)]
    parts = parts[nms(boxes_xyxy[parts], scores[parts], NMS_IOU, labels[parts])]
    selected = torch.cat([selected, parts])
    return selected[torch.sort(scores[selected], descending=True, stable=True).indices]
