"""A user's segmentation network in an ONNX file, for `scene_ir.derender.segmentation`.

Requirements: one input (1, 3, H, W) float32, RGB in [0, 1], or (RGB - mean) / std where its metadata
has `mean` and `std` (three numbers each). H and W fixed, or free: then the photograph goes in at its own size,
rounded to multiples of 32. Its first output: logits or probabilities (1, C, h, w) of any size, or class numbers
(1, h, w). The classes' names are in its metadata, as `classes` or `names` (a JSON list, or an object by number);
without them they are Cityscapes' nineteen.
"""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scene_ir import files
from scene_ir.errors import FormatError

Array = NDArray[np.float32]

CITYSCAPES = (
    *("road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign", "vegetation"),
    *("terrain", "sky", "person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle"),
)
"""Evaluated classes of Cordts et al., CVPR 2016, in the order of their training ids."""
_MULTIPLE = 32
"""Free input sizes are rounded to multiples of this: networks halve them up to five times."""
_MAX_SIDE = 8192
"""Limit of a fixed input's sides, px, so that no file takes all memory."""
_SUM_ERROR = 0.01
"""Tolerance of the sum of probabilities; other outputs are logits."""


class OnnxSegmenter:
    """Maps a photograph (H, W, 3) RGB in [0, 1] to probabilities (C, h, w) and names of the classes.

    Raises FormatError naming the file for another network; see this module.
    """

    def __init__(self, path: Path) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            raise FormatError(str(path), "onnxruntime (pip install onnxruntime)", "none") from error
        self._path = str(path)
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4
        options.intra_op_num_threads = 1
        try:
            self._session: Any = onnxruntime.InferenceSession(
                files.read_bytes(path), options, providers=["CPUExecutionProvider"]
            )
            inputs = [(item.name, list(item.shape), item.type) for item in self._session.get_inputs()]
            metadata = dict(self._session.get_modelmeta().custom_metadata_map)
        except FormatError:
            raise
        except Exception as error:  # onnxruntime's errors have no narrower base class
            raise FormatError(self._path, "an ONNX network", _first_line(error)) from error
        shape = inputs[0][1] if inputs else []
        if len(inputs) != 1 or len(shape) != 4 or (isinstance(shape[1], int) and shape[1] != 3):
            found = ", ".join(f"{name} {sides}" for name, sides, _ in inputs)
            raise FormatError(f"{self._path}: inputs", "one of shape (1, 3, H, W)", found or "none")
        self._input, _, kind = inputs[0]
        if kind != "tensor(float)":
            raise FormatError(f"{self._path}: input {self._input}", "float32", kind)
        self._sides = tuple(side if isinstance(side, int) and side > 0 else None for side in shape[2:])
        if max((side for side in self._sides if side is not None), default=0) > _MAX_SIDE:
            raise FormatError(f"{self._path}: input {self._input}", f"at most {_MAX_SIDE} px a side", shape)
        self._mean, self._std = (self._parse_triple(metadata, *item) for item in (("mean", 0.0), ("std", 1.0)))
        if (self._std <= 0).any():
            raise FormatError(f"{self._path}: metadata std", "positive numbers", self._std.tolist())
        self.names = self._parse_names(metadata)

    def __call__(self, photograph: Array) -> tuple[Array, tuple[str, ...]]:
        """Return probabilities (C, h, w) of the classes, and their names."""
        height, width = (
            side or max(_MULTIPLE, round(own / _MULTIPLE) * _MULTIPLE)
            for side, own in zip(self._sides, photograph.shape[:2], strict=True)
        )
        image = cv2.resize(photograph, (width, height), interpolation=cv2.INTER_AREA)
        network_input = ((image - self._mean) / self._std).transpose(2, 0, 1)[None].astype(np.float32)
        try:
            output = np.asarray(self._session.run(None, {self._input: np.ascontiguousarray(network_input)})[0])
        except Exception as error:  # as above
            raise FormatError(
                self._path, f"a network that takes {network_input.shape}", _first_line(error)
            ) from error
        return self._to_probabilities(output), self.names

    def _to_probabilities(self, output: NDArray[Any]) -> Array:
        count = len(self.names)
        if output.ndim == 4 and output.shape[1] == 1:
            output = output[:, 0]
        if output.ndim == 3 and output.shape[0] == 1:
            numbers = np.rint(output[0]).astype(np.int64)
            return np.stack([numbers == i for i in range(count)]).astype(np.float32)
        if output.ndim != 4 or output.shape[:2] != (1, count):
            expected = f"(1, {count}, h, w) for {count} classes, or (1, h, w)"
            raise FormatError(f"{self._path}: output", expected, output.shape)
        values = output[0].astype(np.float32)
        if not np.isfinite(values).all():
            raise FormatError(f"{self._path}: output", "finite numbers", "NaN or infinity")
        if values.min() >= 0 and np.abs(values.sum(0) - 1).max() < _SUM_ERROR:
            return values
        exponentials = np.exp(values - values.max(0))
        return exponentials / exponentials.sum(0)

    def _parse_triple(self, metadata: dict[str, str], key: str, default: float) -> Array:
        if key not in metadata:
            return np.full(3, default, np.float32)
        try:
            values = np.array(ast.literal_eval(metadata[key]), np.float32)
        except (ValueError, SyntaxError, TypeError):
            values = np.zeros(0, np.float32)
        if values.shape != (3,) or not np.isfinite(values).all():
            raise FormatError(f"{self._path}: metadata {key}", "three numbers", metadata[key][:80])
        return values

    def _parse_names(self, metadata: dict[str, str]) -> tuple[str, ...]:
        key = next((k for k in ("classes", "names") if k in metadata), None)
        if key is None:
            return CITYSCAPES
        try:
            value = ast.literal_eval(metadata[key])
            if isinstance(value, dict):
                value = [value[k] for k in sorted(value, key=int)]
        except (ValueError, SyntaxError, TypeError):
            value = None
        if not isinstance(value, list) or not value or not all(isinstance(name, str) for name in value):
            raise FormatError(f"{self._path}: metadata {key}", "a list of names", metadata[key][:80])
        return tuple(value)


def _first_line(error: Exception) -> str:
    """Return the first line of another library's error, shortened."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:160]
