"""Read the weights of this package's small networks from safetensors files, without the safetensors library.

Format: eight bytes with the header's length, a JSON header, raw little-endian numbers
(github.com/huggingface/safetensors, "Format").
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from scene_ir import files
from scene_ir.errors import FormatError

_Network = TypeVar("_Network", bound=nn.Module)
_DTYPES = {"F16": "<f2", "F32": "<f4"}
SHIPPED_WEIGHTS = Path(__file__).parent / "derender" / "weights"
_LENGTH_BYTES = 8
"""Size of the header's length."""


def read_weights(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Metadata and float32 tensors of a file of float16 or float32 tensors.

    Raises FormatError naming file and key; for the shipped weights also if they do not match their model card.
    """
    data = files.read_bytes(path)
    if path.parent == SHIPPED_WEIGHTS:
        files.check_model_card(path, data)
    length = int.from_bytes(data[:_LENGTH_BYTES], "little")
    if len(data) < _LENGTH_BYTES or len(data) - _LENGTH_BYTES < length:
        raise FormatError(str(path), "a safetensors file", f"{len(data)} bytes, cut short")
    try:
        text = data[_LENGTH_BYTES : _LENGTH_BYTES + length].decode()
    except UnicodeDecodeError as error:
        raise FormatError(f"{path}: header", "JSON", str(error)) from error
    header: Any = files.parse_json(text, f"{path}: header")
    if not isinstance(header, dict):
        raise FormatError(f"{path}: header", "an object", type(header).__name__)
    metadata = header.pop("__metadata__", {})
    if not isinstance(metadata, dict) or not all(isinstance(text, str) for text in metadata.values()):
        raise FormatError(f"{path}: __metadata__", "texts by name", repr(metadata)[:60])
    body = memoryview(data)[_LENGTH_BYTES + length :]
    return metadata, {name: _parse_tensor(f"{path}: {name}", entry, body) for name, entry in header.items()}


def _parse_tensor(where: str, entry: Any, body: memoryview) -> Tensor:
    try:
        dtype = np.dtype(_DTYPES[entry["dtype"]])
        start, end = entry["data_offsets"]
        values = np.frombuffer(body[start:end], dtype).reshape(entry["shape"])
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(where, f"{' or '.join(_DTYPES)} of its shape and offsets", repr(error)[:80]) from error
    if not np.isfinite(values).all():
        raise FormatError(where, "finite numbers", "NaN or infinity")
    return torch.from_numpy(values.astype(np.float32))


def load_weights(network: nn.Module, tensors: dict[str, Tensor], path: Path) -> None:
    """Load tensors into a network.

    Args:
        network: Changed in place.
        tensors: Floating tensors by name.
        path: The file that they come from, for messages.

    Raises:
        FormatError: The tensors are another network's.
    """
    expected = {k: v for k, v in network.state_dict().items() if v.is_floating_point()}
    for name in sorted(expected.keys() ^ tensors.keys()):
        found = "none" if name in expected else "a tensor"
        raise FormatError(f"{path}: {name}", "a tensor" if name in expected else "none", found)
    for name, tensor in tensors.items():
        if tensor.shape != expected[name].shape:
            raise FormatError(f"{path}: {name}", f"shape {tuple(expected[name].shape)}", tuple(tensor.shape))
    network.load_state_dict(tensors, strict=False)


def load_frozen(network: _Network, path: Path) -> _Network:
    """The network with a file's weights, in eval mode and without gradients. Raises FormatError."""
    load_weights(network, read_weights(path)[1], path)
    network.requires_grad_(False)
    return network.eval()
