"""Frames on disk that training can begin with: one bright block each, a car."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from drivesem.data.kitti import KittiWriter
from scene_ir.types import Labels


def _labels(
    kind: tuple[str, ...], boxes_xyxy: list[list[float]], occlusion: list[int], truncation: list[float]
) -> Labels:
    n = len(kind)
    return Labels(
        kind=kind,
        boxes_xyxy=torch.tensor(boxes_xyxy, dtype=torch.float32).reshape(-1, 4),
        truncation=torch.tensor(truncation),
        occlusion=torch.tensor(occlusion, dtype=torch.int64),
        translation=torch.tensor([[0.0, 1.6, 20.0]]).repeat(n, 1),
        yaw=torch.zeros(n),
        size_lhw=torch.tensor([[4.0, 1.5, 1.7]]).repeat(n, 1),
        ignore_xyxy=torch.tensor([[0.0, 0.0, 9.0, 9.0]]),
    )


def _folder(root: Path, count: int, kind: str = "Car", seed: int = 0) -> Path:
    """A KITTI folder of `count` frames, 120x80 px."""
    writer = KittiWriter(root)
    projection = torch.tensor([[700.0, 0, 60, 0], [0, 700, 40, 0], [0, 0, 1, 0]])
    generator = np.random.default_rng(seed)
    for i in range(count):
        image = generator.integers(90, 130, (80, 120, 3), dtype=np.uint8)
        x, y = int(generator.integers(2, 70)), int(generator.integers(10, 40))
        image[y : y + 36, x : x + 40] = (250, 240, 30)
        rows = _labels((kind,), [[x, y, x + 39.0, y + 35.0]], [0], [0.0])
        writer.write_photograph(f"{i:06d}", image, rows, projection)
    return root


@pytest.fixture
def labels() -> Callable[..., Labels]:
    """Makes labels of kinds, boxes, occlusions and truncations, with one region to ignore."""
    return _labels


@pytest.fixture
def kitti_folder() -> Callable[..., Path]:
    """Makes a KITTI folder of a root and a number of frames."""
    return _folder
