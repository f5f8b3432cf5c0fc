"""The process whose memory `bench detector` tells: `python -m drivesem.bench.detector_probe ORDER FILE`.

It imports only what the detector needs.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from detectors.base import Detector
from detectors.registry import load_detector
from detectors.types import Targets
from drivesem.bench.probe import peak_kb, resident_kb

_STEPS = 6
"""The peak is reached in the first steps."""


@dataclass(frozen=True, slots=True)
class Order:
    """What to run. detector: name or file; height, width: of the image, px; threads: of torch."""

    detector: str
    height: int
    width: int
    threads: int


def both(detector: Detector, image: Tensor) -> Tensor:
    """Forward and backward: the gradient to images (1, 3, H, W) of the loss that attacks raise, for one object."""
    height, width = image.shape[2:]
    box = image.new_tensor([[width / 4, height / 3, width / 3, height / 2]])
    labels = torch.zeros(1, dtype=torch.int64, device=image.device)
    leaf = image.detach().requires_grad_(True)
    loss = detector.loss(detector(leaf), [Targets(box, labels, labels > 0)])["objectness"]
    return torch.autograd.grad(loss, leaf)[0]


def main(words: list[str]) -> None:
    """Run what the order says and leave peak and resident KB, the latter with the detector loaded, in the file."""
    from scene_ir.files import write_json

    order = Order(**json.loads(words[0]))
    torch.set_num_threads(order.threads)
    detector = load_detector(order.detector)
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(1, 3, order.height, order.width, generator=generator)
    image = image.contiguous(memory_format=torch.channels_last)
    loaded = resident_kb()
    for _ in range(_STEPS):
        both(detector, image)
    write_json(Path(words[1]), {"peak_kb": peak_kb(), "loaded_kb": loaded})


if __name__ == "__main__":
    main(sys.argv[1:])
