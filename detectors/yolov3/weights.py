"""Darknet's `.weights` files: a header, then the numbers of all convolutions as little-endian float32.

Header: major, minor and revision of the format as int32, then how many images training has seen: int64 from
version 0.2 on, int32 before. A convolution's numbers are its biases, then, where it is normalised, scales, means
and variances, then the kernel (out, in, height, width).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from detectors.base import DetectorError
from detectors.reading import check_file, read_file
from detectors.whole import write_whole
from detectors.yolov3.network import Block, Network

VERSION = (0, 2, 0)
_VERSION_BYTES = 12
_MOST_BYTES = 1 << 30
"""YOLOv3's have 248 MB."""


def check(network: Network, path: Path) -> None:
    """DetectorError for a file that has not as many bytes as the network takes, which may be without memory."""
    check_file(path, "Darknet weights", _MOST_BYTES)
    expected, found = 4 * sum(tensor.numel() for tensor in _tensors(network)), path.stat().st_size
    if not _VERSION_BYTES + 4 <= found - expected <= _VERSION_BYTES + 8:
        numbers = (found - _VERSION_BYTES - 8) / 4
        raise DetectorError(f"{path}: expected {expected // 4:,} numbers after the header, found {numbers:,.10g}")


@torch.no_grad()
def read(network: Network, path: Path) -> int:
    """Fill a network from a file; how many images it was trained on. DetectorError where the file is missing or
    has not as many numbers as the network takes.
    """
    content = read_file(path, "Darknet weights", _MOST_BYTES)
    if len(content) < _VERSION_BYTES:
        raise DetectorError(f"{path}: expected Darknet weights, found {len(content)} bytes")
    major, minor, _ = np.frombuffer(content, "<i4", 3)
    # Darknet's own rule: wide from 0.2 on, and versions beyond 1000 are files that were byte-swapped.
    wide = int(major) * 10 + int(minor) >= 2 and major < 1000 and minor < 1000
    start = _VERSION_BYTES + (8 if wide else 4)
    expected = sum(tensor.numel() for tensor in _tensors(network))
    found = max(len(content) - start, 0) / 4
    if found != expected:
        raise DetectorError(f"{path}: expected {expected:,} numbers after the header, found {found:,.10g}")
    numbers = torch.from_numpy(np.frombuffer(content, "<f4", expected, start).astype(np.float32))
    if not bool(torch.isfinite(numbers).all()):
        raise DetectorError(f"{path}: expected finite numbers, found NaN or infinity")
    at = 0
    for tensor in _tensors(network):
        tensor.copy_(numbers[at : at + tensor.numel()].view(tensor.shape))
        at += tensor.numel()
    return int(np.frombuffer(content, "<i8" if wide else "<i4", 1, _VERSION_BYTES)[0])


def write(network: Network, path: Path, seen: int = 0) -> None:
    """Write a file that Darknet reads; atomic. seen: images that the network was trained on."""
    parts = [np.array(VERSION, "<i4").tobytes(), np.array([seen], "<i8").tobytes()]
    parts += [tensor.detach().cpu().contiguous().numpy().astype("<f4").tobytes() for tensor in _tensors(network)]
    write_whole(path, b"".join(parts))


def _tensors(network: Network) -> list[Tensor]:
    """All tensors in the file's order."""
    return [tensor for block in network.blocks.values() for tensor in _of_block(block)]


def _of_block(block: Block) -> list[Tensor]:
    norm = block.norm
    if norm is None:
        assert block.conv.bias is not None
        return [block.conv.bias, block.conv.weight]
    assert norm.running_mean is not None
    assert norm.running_var is not None
    return [norm.bias, norm.weight, norm.running_mean, norm.running_var, block.conv.weight]
