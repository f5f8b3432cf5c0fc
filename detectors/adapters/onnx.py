"""ONNX files as detectors without a gradient, run by ONNX Runtime.

The graph runs once: what its outputs measure gives their format (`detectors.adapters.formats`). The input follows
from it, from what the graph declares, and from a YAML file (`detectors.adapters.spec`), which wins.
"""

from __future__ import annotations

import ast
import importlib
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from detectors import boxes
from detectors.adapters.formats import OutputDecoder, make_decoder, select_names
from detectors.adapters.spec import (
    MAX_SIDE,
    ImagePlacement,
    NetworkSpec,
    fit_images,
    load_settings,
    normalise_images,
    validate_settings,
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


GraphRunner = Callable[[Tensor, NetworkSpec], Sequence[Tensor]]
"""Maps an image (1, 3, h, w), RGB in [0, 1], of the graph's size, and the settings to the graph's outputs."""


@dataclass(frozen=True, slots=True)
class OnnxPredictions:
    """Boxes and scores of all tiles of B images."""

    tiles: tuple[Tile, ...]
    """The tiles of every image."""
    predictions: tuple[tuple[tuple[Tensor, Tensor], ...], ...]
    """For each image and tile, boxes (A, 4) px of the image and scores (A, C)."""
    image_hw: tuple[int, int]
    """Size of the images, px."""


class OnnxPredictor:
    """A detector from an ONNX file: images (B, 3, H, W), RGB in [0, 1], any size."""

    gradient_obstacle = ""
    """Why it has no gradient, if one was to be had."""

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
        graph = OnnxGraph(path, spec)
        self.graph = graph
        self.input_hw = graph.input_hw
        self.decoder = graph.decoder
        self._spec = graph.decoder.spec
        self.format = self.decoder.format
        self.name = path.stem
        self.classes = self.decoder.classes
        if self._spec.t_star is not None:
            self.t_star = self._spec.t_star
        self._nms_iou = NMS_IOU if self._spec.nms_iou is None else self._spec.nms_iou
        self._least_score = LEAST_SCORE if self._spec.least_score is None else self._spec.least_score
        self._tiling = tiling

    def forward(self, images: Tensor) -> OnnxPredictions:
        """images (B, 3, H, W), RGB in [0, 1]; no gradient."""
        height, width = int(images.shape[2]), int(images.shape[3])
        parts = self.tiles(height, width)
        images = images.detach().float().cpu()
        predictions = (tuple(self.predict_tile(image, tile, self.graph.run) for tile in parts) for image in images)
        return OnnxPredictions(parts, tuple(predictions), (height, width))

    def decode(self, raw: OnnxPredictions) -> list[Detections]:
        """One Detections per image, best first, boxes inside the image."""
        return [
            self.merge([(tile, *of_tile) for tile, of_tile in zip(raw.tiles, found, strict=True)], raw.image_hw)[0]
            for found in raw.predictions
        ]

    def tiles(self, height: int, width: int) -> tuple[Tile, ...]:
        """The tiles of an image of this size, px; the whole image comes first."""
        if self._tiling == "auto":
            return tuple(make_tiles(height, width, self.input_hw))
        return (Tile(0, 0, width, height),)

    def predict_tile(self, image: Tensor, tile: Tile, run: GraphRunner) -> tuple[Tensor, Tensor]:
        """Boxes (A, 4) px of the image, clipped to a tile, and scores (A, C); differentiable if `run` is.

        Args:
            image: (3, H, W), RGB in [0, 1].
            tile: A part of it.
            run: Runs the graph.
        """
        part = image[None, :, tile.y0 : tile.y1, tile.x0 : tile.x1]
        network_input, placement = fit_images(part, self._spec)
        (edges,), (scores,) = self.decoder.decode(run(network_input, self._spec), self.input_hw)
        return _to_image(edges, tile, placement), scores

    def merge(
        self, tiles: Sequence[tuple[Tile, Tensor, Tensor]], image_hw: tuple[int, int]
    ) -> tuple[Detections, Tensor]:
        """The detections of an image's tiles, and which of them a tile border cuts.

        Args:
            tiles: Each tile with its boxes (A, 4) px of the image and their scores (A, C).
            image_hw: Size of the image, px.

        Returns:
            Detections, best first, and (M,) bool.
        """
        per_tile: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
        for tile, edges, all_scores in tiles:
            cells, labels = (all_scores > self._least_score).nonzero(as_tuple=True)
            scores, boxes_xyxy = all_scores[cells, labels], edges[cells]
            # Boxes in the padding have no area left in the image.
            inside = boxes.area(boxes.clip(boxes_xyxy, *image_hw)) > 0
            boxes_xyxy, scores, labels = boxes_xyxy[inside], scores[inside], labels[inside]
            selected = boxes.nms(boxes_xyxy, scores, self._nms_iou, labels)
            boxes_xyxy = boxes_xyxy[selected]
            is_cut = is_cut_by_tile(boxes_xyxy, tile, image_hw)
            per_tile.append((boxes_xyxy, scores[selected], labels[selected], is_cut))
        boxes_xyxy, scores, labels, is_cut = (torch.cat(parts) for parts in zip(*per_tile, strict=True))
        if len(tiles) > 1:
            selected = merge_tiles(boxes_xyxy, scores, labels, is_cut)
            boxes_xyxy, scores, labels, is_cut = (x[selected] for x in (boxes_xyxy, scores, labels, is_cut))
        return Detections(boxes.clip(boxes_xyxy, *image_hw), labels, scores), is_cut


_SIDE_INPUTS: dict[str, Callable[[tuple[int, int]], list[float]]] = {
    "orig_target_sizes": lambda hw: [hw[1], hw[0]],
    "im_shape": lambda hw: [*hw],
    "scale_factor": lambda _: [1, 1],
}
"""Inputs of RT-DETR's and Paddle's graphs besides the image: numbers by the image's (height, width) in px. With these,
boxes are px of the image that the graph gets.
"""
_TYPES = {
    "tensor(float)": np.float32,
    "tensor(double)": np.float64,
    "tensor(float16)": np.float16,
    "tensor(uint8)": np.uint8,
    "tensor(int32)": np.int32,
    "tensor(int64)": np.int64,
}
_MAX_BATCH = 64
"""Largest fixed batch: copies of one image fill it."""
_BFLOAT16 = "tensor(bfloat16)"
_EIGHT_BIT: dict[str, Any] = {"scale": 255.0, "mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0)}
"""Settings of a graph that takes whole numbers: it normalises pixels by itself."""


class OnnxGraph:
    """An ONNX graph of one image, and how its outputs are decoded."""

    session: Any
    """ONNX Runtime's."""
    input_hw: tuple[int, int]
    """Size of the image that it takes, px."""
    decoder: OutputDecoder
    """Decodes its outputs; has the complete settings."""

    def __deepcopy__(self, _: Any) -> OnnxGraph:
        """Itself: it does not change, and a session cannot be copied."""
        return self

    def __init__(self, path: Path, spec: Path | None = None) -> None:
        """Load a graph and run it once.

        Args:
            path: The ONNX file.
            spec: YAML file of settings; by default FILE.yaml for FILE.onnx, if there is one.

        Raises:
            DetectorError: The file or ONNX Runtime is missing, the graph takes no image or cannot be run, or no format
                fits.
        """
        self.session = session = open_session(path)
        settings = load_settings(path, spec)
        facts: Mapping[str, str] = session.get_modelmeta().custom_metadata_map
        inputs = {node.name: node for node in session.get_inputs()}
        others = [name for name in inputs if name in _SIDE_INPUTS]
        images = {name: list(node.shape) for name, node in inputs.items() if name not in others}
        size = settings.get("size") or _exported_size(facts)
        self.input_hw, self._channels_last = _image_layout(path, images, size, "size" in settings)
        ((self._image, shape),) = images.items()
        self._is_batch = len(shape) == 4
        self._batch = shape[0] if self._is_batch and isinstance(shape[0], int) else 1
        self._type = _input_type(path, inputs[self._image])
        self._others = {
            name: np.asarray([_SIDE_INPUTS[name](self.input_hw)] * self._batch, _input_type(path, inputs[name]))
            for name in others
        }
        outputs = {node.name: node.type for node in session.get_outputs()}
        self._outputs = select_names(outputs)
        self._is_bfloat16 = any(outputs[name] == _BFLOAT16 for name in self._outputs)
        if not np.issubdtype(self._type, np.floating):
            settings = _EIGHT_BIT | settings
        self.decoder = self._measure(path, {**settings, "size": self.input_hw}, _names(facts), {*inputs, *outputs})

    def run(self, network_input: Tensor, spec: NetworkSpec) -> list[Tensor]:
        """The outputs for an image (1, 3, *input_hw), RGB in [0, 1], that fits the graph's size."""
        given = self._prepare(network_input, spec).numpy()
        feeds = {self._image: np.ascontiguousarray(given, self._type), **self._others}
        if self._is_bfloat16:  # numpy has no such type
            values = {name: _runtime().OrtValue.ortvalue_from_numpy(array) for name, array in feeds.items()}
            outputs = [torch.from_dlpack(v) for v in self.session.run_with_ort_values(self._outputs, values)]
        else:
            outputs = [torch.from_numpy(np.asarray(one)) for one in self.session.run(self._outputs, feeds)]
        return self._first_of_batch(outputs)

    def run_converted(self, network: Any, network_input: Tensor, spec: NetworkSpec) -> list[Tensor]:
        """`run` by the graph as a torch module of onnx2pytorch; differentiable. Whole numbers that the graph takes are
        rounded floats here, with the gradient of the unrounded ones.
        """
        given = self._prepare(network_input, spec)
        given = given.half() if self._type is np.float16 else given
        others = {name: torch.from_numpy(array).to(given.device) for name, array in self._others.items()}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the converter uses what torch deprecates
            outputs = network(**{self._image: given}, **others)
        named = dict(zip(network.output_names, [outputs] if isinstance(outputs, Tensor) else outputs, strict=True))
        return self._first_of_batch([named[name] for name in self._outputs])

    def _prepare(self, network_input: Tensor, spec: NetworkSpec) -> Tensor:
        """The graph's image; differentiable."""
        image = normalise_images(network_input, spec)
        if not np.issubdtype(self._type, np.floating):
            image = image + (image.round().clamp(0, 255) - image).detach()
        image = image.permute(0, 2, 3, 1) if self._channels_last else image
        return image.expand(self._batch, -1, -1, -1) if self._is_batch else image[0]

    def _first_of_batch(self, outputs: Sequence[Tensor]) -> list[Tensor]:
        """Outputs for the image; copies of it fill a batch of fixed size."""
        return [one[:1] if self._batch > 1 and one.shape[:1] == (self._batch,) else one for one in outputs]

    def _measure(
        self, path: Path, settings: dict[str, Any], names: tuple[str, ...] | None, node_names: set[str]
    ) -> OutputDecoder:
        """Run the graph on a grey image, and settle how its outputs are decoded."""
        grey = torch.full((1, 3, *self.input_hw), 0.5)
        try:
            outputs = self.run(grey, replace(NetworkSpec(), **settings))
        except DetectorError:
            raise
        except Exception as error:  # ONNX Runtime's error classes differ between versions
            expected = f"a graph that takes an image of {self.input_hw[0]} x {self.input_hw[1]} px"
            raise DetectorError(f"{path}: expected {expected}, found {_first_line(error)}") from None
        return make_decoder(outputs, self.input_hw, settings, names, str(path), node_names)


def open_session(path: Path) -> Any:
    """The graph of an ONNX file, ready to run with as many threads as torch has now.

    Raises:
        DetectorError: The file or ONNX Runtime is missing, or the file is damaged.
    """
    try:
        runtime = _runtime()
    except ImportError:
        raise DetectorError(f"{path}: needs ONNX Runtime: pip install 'onnxruntime>=1.19'") from None
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


def _to_image(edges: Tensor, tile: Tile, placement: ImagePlacement) -> Tensor:
    """Boxes (N, 4) of the network's input, as pixel edges, in px of the image, clipped to the tile."""
    origin = edges.new_tensor([tile.x0, tile.y0])
    end = edges.new_tensor([tile.x1, tile.y1])
    boxes_xyxy = placement.to_image(edges) + origin.repeat(2)
    # Pixel centres are integers: the first pixel's left edge is at -1/2.
    return torch.minimum(torch.maximum(boxes_xyxy, origin.repeat(2) - 0.5), end.repeat(2) - 0.5)


def _runtime() -> ModuleType:
    return importlib.import_module("onnxruntime")


def _input_type(path: Path, node: Any) -> type[np.generic]:
    """The type of numbers that an input takes."""
    if node.type not in _TYPES:
        raise DetectorError(f"{path}: input {node.name}: expected {', '.join(_TYPES)}, found {node.type}")
    return _TYPES[node.type]


def _image_layout(
    path: Path, images: Mapping[str, list[Any]], size: tuple[int, int] | None, required: bool
) -> tuple[tuple[int, int], bool]:
    """Height and width of the graph's image in px, and whether its channels come last.

    Args:
        path: The ONNX file.
        images: Shapes of the inputs by name, without `_SIDE_INPUTS`.
        size: From a YAML file or the graph's metadata, for open sides.
        required: Whether fixed sides must be this size.
    """
    shape = next(iter(images.values())) if len(images) == 1 else []
    sides = shape[-3:]
    batch = shape[0] if len(shape) == 4 and isinstance(shape[0], int) else 1
    has_channels = len(shape) in (3, 4) and (3 in (sides[0], sides[2]) or not isinstance(sides[0], int))
    if has_channels and 1 <= batch <= _MAX_BATCH:
        channels_last = sides[2] == 3 and sides[0] != 3
        fixed = [side if isinstance(side, int) else None for side in (sides[:2] if channels_last else sides[1:])]
        if not all(side is None or 1 <= side <= MAX_SIDE for side in fixed):
            raise DetectorError(f"{path}: expected an input of 1 to {MAX_SIDE} px a side, found {shape}")
        if size is not None and all(side in (None, given) for side, given in zip(fixed, size, strict=True)):
            return size, channels_last
        if None not in fixed and not required:
            return (fixed[0] or 0, fixed[1] or 0), channels_last
    found = ", ".join(f"{name} {shape}" for name, shape in images.items())
    expected = f"of {size[0]} x {size[1]}" if size else "of fixed size (or `size` in a YAML file)"
    raise DetectorError(f"{path}: expected one input (1, 3, height, width) {expected}, found {found}")


def _exported_size(facts: Mapping[str, str]) -> tuple[int, int] | None:
    """Height and width of the image, px, as Ultralytics' export writes them: "[640, 640]"."""
    try:
        return validate_settings({"size": ast.literal_eval(facts.get("imgsz", ""))}, "imgsz")["size"]
    except (DetectorError, ValueError, SyntaxError, TypeError):
        return None


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
