"""Small ONNX files made by hand, as protocol buffers (onnx.proto), without the library of that name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np


def _number(value: int) -> bytes:
    found = bytearray()
    while value > 127:
        found.append(value & 127 | 128)
        value >>= 7
    return bytes([*found, value])


def _field(number: int, value: int | bytes | str) -> bytes:
    if isinstance(value, int):
        return _number(number << 3) + _number(value)
    data = value.encode() if isinstance(value, str) else value
    return _number(number << 3 | 2) + _number(len(data)) + data


def _value(name: str, shape: Sequence[int | str]) -> bytes:
    """ValueInfoProto of a float tensor."""
    sides = b"".join(_field(1, _field(1 if isinstance(side, int) else 2, side)) for side in shape)
    return _field(1, name) + _field(2, _field(1, _field(1, 1) + _field(2, sides)))


def _constant(name: str, array: np.ndarray) -> bytes:
    """NodeProto that gives an array."""
    values = np.ascontiguousarray(array, np.float32)
    tensor = b"".join(_field(1, side) for side in values.shape) + _field(2, 1) + _field(9, values.tobytes())
    return (
        _field(2, name) + _field(4, "Constant") + _field(5, _field(1, "value") + _field(5, tensor) + _field(20, 4))
    )


def constant_graph(
    input_shape: Sequence[int | str], outputs: Mapping[str, np.ndarray], facts: Mapping[str, str] | None = None
) -> bytes:
    """A model (ModelProto) that takes `image` and always gives the same outputs. facts: metadata."""
    graph = b"".join(_field(1, _constant(name, array)) for name, array in outputs.items())
    graph += _field(2, "test") + _field(11, _value("image", input_shape))
    graph += b"".join(_field(12, _value(name, array.shape)) for name, array in outputs.items())
    metadata = b"".join(_field(14, _field(1, key) + _field(2, value)) for key, value in (facts or {}).items())
    return _field(1, 7) + _field(8, _field(2, 13)) + _field(7, graph) + metadata
