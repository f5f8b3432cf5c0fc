"""Loads and saves detectors as Darknet files: `NAME.cfg`, `NAME.weights`, and `NAME.names` with a class per line.

A `.weights` file has a header (major, minor and revision as int32; images seen in training as int64 from version
0.2 on, before that as int32), then all convolutions as little-endian float32: biases, then scales, means and
variances if normalised, then the kernel (out, in, height, width).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from detectors.adapters.spec import COCO_NAMES, with_project_names
from detectors.base import DetectorError
from detectors.files import check_file, read_file, read_text, write_atomically
from detectors.yolov3 import cfg
from detectors.yolov3.network import ConvolutionBlock, DarknetNetwork
from detectors.yolov3.yolov3 import YoloV3

_MAX_TEXT_BYTES = 1 << 20
"""Largest .cfg or .names file, bytes."""


def load(cfg_path: Path, weights_path: Path | None = None) -> YoloV3:
    """Load the network of a `.cfg` with its weights.

    Classes are those of the `.names` file of the same name or, if there are 80, COCO's; "car" becomes "Car".

    Args:
        cfg_path: The `.cfg`.
        weights_path: The `.weights`; by default of the same name.

    Raises:
        DetectorError: A file is missing, damaged, or does not fit the others.
    """
    description = cfg.parse(read_text(cfg_path, "a Darknet .cfg", _MAX_TEXT_BYTES), str(cfg_path))
    classes, path = _classes(cfg_path.with_suffix(".names"), description.classes), weights_path
    path = path or cfg_path.with_suffix(".weights")
    with torch.device("meta"):  # allocates nothing until the file is known to fill the tensors
        check_weights(YoloV3(classes, cfg=description).network, path)
    detector = YoloV3(classes, cfg=description)
    load_weights(detector.network, path)
    return detector


def save(detector: YoloV3, cfg_path: Path, seen: int = 0) -> None:
    """Write the three files that `load` reads.

    Args:
        detector: The detector.
        cfg_path: The `.cfg`; the others get the same name.
        seen: Images seen in training.
    """
    save_weights(detector.network, cfg_path.with_suffix(".weights"), seen)
    write_atomically(cfg_path.with_suffix(".names"), "".join(f"{name}\n" for name in detector.classes).encode())
    write_atomically(cfg_path, cfg.write(detector.cfg).encode())


def _classes(path: Path, count: int) -> tuple[str, ...]:
    if path.is_file():
        names = tuple(
            line.strip() for line in read_text(path, "class names", _MAX_TEXT_BYTES).splitlines() if line.strip()
        )
        if len(names) != count:
            raise DetectorError(f"{path}: expected {count} classes as in the .cfg, found {len(names)}")
    elif count == len(COCO_NAMES):
        names = COCO_NAMES
    else:
        raise DetectorError(f"{path}: expected the {count} classes of the .cfg, a line each, found no file")
    return with_project_names(names)


VERSION = (0, 2, 0)
"""Format version that is written."""
_VERSION_BYTES = 12
_MAX_WEIGHTS_BYTES = 1 << 30
"""Largest weights file; YOLOv3's has 248 MB."""


def check_weights(network: DarknetNetwork, path: Path) -> None:
    """Raise DetectorError if a file's size does not fit the network, which may be on the meta device."""
    check_file(path, "Darknet weights", _MAX_WEIGHTS_BYTES)
    expected, found = 4 * sum(tensor.numel() for tensor in _tensors(network)), path.stat().st_size
    if not _VERSION_BYTES + 4 <= found - expected <= _VERSION_BYTES + 8:
        numbers = (found - _VERSION_BYTES - 8) / 4
        raise DetectorError(f"{path}: expected {expected // 4:,} numbers after the header, found {numbers:,.10g}")


@torch.no_grad()
def load_weights(network: DarknetNetwork, path: Path) -> int:
    """Fill a network from a file; returns the number of images seen in training.

    Raises:
        DetectorError: The file is missing, or does not hold exactly the network's finite numbers.
    """
    content = read_file(path, "Darknet weights", _MAX_WEIGHTS_BYTES)
    if len(content) < _VERSION_BYTES:
        raise DetectorError(f"{path}: expected Darknet weights, found {len(content)} bytes")
    major, minor, _ = np.frombuffer(content, "<i4", 3)
    # Darknet's rule: int64 from version 0.2 on; versions beyond 1000 are byte-swapped files.
    has_int64 = int(major) * 10 + int(minor) >= 2 and major < 1000 and minor < 1000
    start = _VERSION_BYTES + (8 if has_int64 else 4)
    expected = sum(tensor.numel() for tensor in _tensors(network))
    found = max(len(content) - start, 0) / 4
    if found != expected:
        raise DetectorError(f"{path}: expected {expected:,} numbers after the header, found {found:,.10g}")
    numbers = torch.from_numpy(np.frombuffer(content, "<f4", expected, start).astype(np.float32))
    if not bool(torch.isfinite(numbers).all()):
        raise DetectorError(f"{path}: expected finite numbers, found NaN or infinity")
    position = 0
    for tensor in _tensors(network):
        tensor.copy_(numbers[position : position + tensor.numel()].view(tensor.shape))
        position += tensor.numel()
    return int(np.frombuffer(content, "<i8" if has_int64 else "<i4", 1, _VERSION_BYTES)[0])


def save_weights(network: DarknetNetwork, path: Path, seen: int = 0) -> None:
    """Write a file that Darknet reads, atomically.

    Args:
        network: The network.
        path: The file.
        seen: Images seen in training.
    """
    parts = [np.array(VERSION, "<i4").tobytes(), np.array([seen], "<i8").tobytes()]
    parts += [tensor.detach().cpu().contiguous().numpy().astype("<f4").tobytes() for tensor in _tensors(network)]
    write_atomically(path, b"".join(parts))


def _tensors(network: DarknetNetwork) -> list[Tensor]:
    """All tensors in the file's order."""
    return [tensor for block in network.blocks.values() for tensor in _block_tensors(block)]


def _block_tensors(block: ConvolutionBlock) -> list[Tensor]:
    norm = block.norm
    if norm is None:
        assert block.conv.bias is not None
        return [block.conv.bias, block.conv.weight]
    assert norm.running_mean is not None
    assert norm.running_var is not None
    return [norm.bias, norm.weight, norm.running_mean, norm.running_var, block.conv.weight]
