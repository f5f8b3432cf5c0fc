"""A user's own segmentation network, an ONNX file, as `scene_ir.derender.segment` takes one.

What the file must be: one input (1, 3, H, W) float32, RGB in [0, 1], or (RGB - mean) / std where its metadata
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
"""Cordts et al., CVPR 2016: the classes that are judged, in the order of their training numbers."""
_MULTIPLE = 32
"""Sides that networks with a free input size can halve five times."""
_MOST_SIDE = 8192
"""px of a fixed input: far above any, so that none takes all memory."""
_SUM_ERROR = 0.01
"""Of probabilities; what misses 1 by more is logits."""


class OnnxSegmenter:
    """photograph (H, W, 3) RGB in [0, 1] -> shares (C, h, w) and names of the classes; see this module.

    Raises FormatError, one line naming the file, for what is no such network.
    """

    def __init__(self, path: Path) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            raise FormatError(str(path), "onnxruntime beside it (pip install onnxruntime)", "none") from error
        self._path = str(path)
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4
        options.intra_op_num_threads = 1
        try:
            self._session: Any = onnxruntime.InferenceSession(
                files.read_bytes(path), options, providers=["CPUExecutionProvider"]
            )
            inputs = [(one.name, list(one.shape), one.type) for one in self._session.get_inputs()]
            told = dict(self._session.get_modelmeta().custom_metadata_map)
        except FormatError:
            raise
        except Exception as error:  # onnxruntime's own classes derive from nothing narrower
            raise FormatError(self._path, "an ONNX network", _line(error)) from error
        shape = inputs[0][1] if inputs else []
        if len(inputs) != 1 or len(shape) != 4 or (isinstance(shape[1], int) and shape[1] != 3):
            found = ", ".join(f"{name} {sides}" for name, sides, _ in inputs)
            raise FormatError(f"{self._path}: inputs", "one of shape (1, 3, H, W)", found or "none")
        self._input, _, kind = inputs[0]
        if kind != "tensor(float)":
            raise FormatError(f"{self._path}: input {self._input}", "float32", kind)
        self._sides = tuple(side if isinstance(side, int) and side > 0 else None for side in shape[2:])
        if max((side for side in self._sides if side is not None), default=0) > _MOST_SIDE:
            raise FormatError(f"{self._path}: input {self._input}", f"at most {_MOST_SIDE} px a side", shape)
        self._mean, self._std = (self._three(told, key, usual) for key, usual in (("mean", 0.0), ("std", 1.0)))
        if (self._std <= 0).any():
            raise FormatError(f"{self._path}: metadata std", "positive numbers", self._std.tolist())
        self.names = self._names(told)

    def __call__(self, photograph: Array) -> tuple[Array, tuple[str, ...]]:
        """Shares (C, h, w) in [0, 1] of each class, and the classes' names."""
        height, width = (
            side or max(_MULTIPLE, round(own / _MULTIPLE) * _MULTIPLE)
            for side, own in zip(self._sides, photograph.shape[:2], strict=True)
        )
        image = cv2.resize(photograph, (width, height), interpolation=cv2.INTER_AREA)
        fed = ((image - self._mean) / self._std).transpose(2, 0, 1)[None].astype(np.float32)
        try:
            found = np.asarray(self._session.run(None, {self._input: np.ascontiguousarray(fed)})[0])
        except Exception as error:  # as above
            raise FormatError(self._path, f"a network that takes {fed.shape}", _line(error)) from error
        return self._shares(found), self.names

    def _shares(self, found: NDArray[Any]) -> Array:
        count = len(self.names)
        if found.ndim == 4 and found.shape[1] == 1:
            found = found[:, 0]
        if found.ndim == 3 and found.shape[0] == 1:
            numbers = np.rint(found[0]).astype(np.int64)
            return np.stack([numbers == i for i in range(count)]).astype(np.float32)
        if found.ndim != 4 or found.shape[:2] != (1, count):
            expected = f"(1, {count}, h, w) for {count} classes, or (1, h, w)"
            raise FormatError(f"{self._path}: output", expected, found.shape)
        values = found[0].astype(np.float32)
        if not np.isfinite(values).all():
            raise FormatError(f"{self._path}: output", "finite numbers", "NaN or infinity")
        if values.min() >= 0 and np.abs(values.sum(0) - 1).max() < _SUM_ERROR:
            return values
        grown = np.exp(values - values.max(0))
        return grown / grown.sum(0)

    def _three(self, told: dict[str, str], key: str, usual: float) -> Array:
        if key not in told:
            return np.full(3, usual, np.float32)
        try:
            values = np.array(ast.literal_eval(told[key]), np.float32)
        except (ValueError, SyntaxError, TypeError):
            values = np.zeros(0, np.float32)
        if values.shape != (3,) or not np.isfinite(values).all():
            raise FormatError(f"{self._path}: metadata {key}", "three numbers", told[key][:80])
        return values

    def _names(self, told: dict[str, str]) -> tuple[str, ...]:
        key = next((k for k in ("classes", "names") if k in told), None)
        if key is None:
            return CITYSCAPES
        try:
            value = ast.literal_eval(told[key])
            if isinstance(value, dict):
                value = [value[k] for k in sorted(value, key=int)]
        except (ValueError, SyntaxError, TypeError):
            value = None
        if not isinstance(value, list) or not value or not all(isinstance(name, str) for name in value):
            raise FormatError(f"{self._path}: metadata {key}", "a list of names", told[key][:80])
        return tuple(value)


def _line(error: Exception) -> str:
    """The first line of what another library says, not too long."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:160]
