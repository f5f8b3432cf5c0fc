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


ELEMENT_TYPES = {"float32": 1, "uint8": 2, "int32": 6, "int64": 7, "float16": 10, "bfloat16": 16}
"""ONNX's numbers of element types."""


def _value(name: str, shape: Sequence[int | str], element: str = "float32") -> bytes:
    """ValueInfoProto of a tensor."""
    sides = b"".join(_field(1, _field(1 if isinstance(side, int) else 2, side)) for side in shape)
    return _field(1, name) + _field(2, _field(1, _field(1, ELEMENT_TYPES[element]) + _field(2, sides)))


def _constant(name: str, array: np.ndarray) -> bytes:
    """NodeProto that gives an array."""
    element = _element_type(array)
    values = np.ascontiguousarray(array, np.float32 if element == "float32" else array.dtype)
    sides = b"".join(_field(1, side) for side in values.shape)
    tensor = sides + _field(2, ELEMENT_TYPES[element]) + _field(9, values.tobytes())
    return (
        _field(2, name) + _field(4, "Constant") + _field(5, _field(1, "value") + _field(5, tensor) + _field(20, 4))
    )


def _element_type(array: np.ndarray) -> str:
    """float32 for float64 too; numpy has no bfloat16: uint16 holds its bits."""
    name = {"float64": "float32", "uint16": "bfloat16"}.get(array.dtype.name, array.dtype.name)
    return name if name in ELEMENT_TYPES else "float32"


def constant_graph(
    input_shape: Sequence[int | str],
    outputs: Mapping[str, np.ndarray],
    facts: Mapping[str, str] | None = None,
    inputs: Mapping[str, str] | None = None,
    open_sides: bool = False,
) -> bytes:
    """A model (ModelProto) that takes an image and always gives the same outputs.

    Args:
        input_shape: Shape of the image.
        outputs: Arrays by name; those of uint16 are the bits of bfloat16.
        facts: Metadata.
        inputs: Element types by name: the image, then further inputs (1, 2). By default `image`, float32.
        open_sides: Whether the outputs' sides are declared by name only.
    """
    (image, element), *others = (inputs or {"image": "float32"}).items()
    graph = b"".join(_field(1, _constant(name, array)) for name, array in outputs.items())
    graph += _field(2, "test") + _field(11, _value(image, input_shape, element))
    graph += b"".join(_field(11, _value(name, (1, 2), kind)) for name, kind in others)
    for name, array in outputs.items():
        sides = [f"{name}{i}" for i in range(array.ndim)] if open_sides else array.shape
        graph += _field(12, _value(name, sides, _element_type(array)))
    metadata = b"".join(_field(14, _field(1, key) + _field(2, value)) for key, value in (facts or {}).items())
    return _field(1, 7) + _field(8, _field(2, 13)) + _field(7, graph) + metadata
