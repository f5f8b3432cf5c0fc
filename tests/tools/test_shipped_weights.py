"""The shipped detectors on pictures of the generator that they were trained with, from the held-out split."""

from pathlib import Path

import pytest
import torch

from detectors.boxes import iou_matrix
from detectors.registry import SHIPPED, load_detector
from detectors.types import CLASSES
from drivesem.synth.frames import generate_frame
from drivesem.training.frames import make_targets
from scene_ir import files
from tools.compare_checkouts import ROOT

SEED, INDEX = 2026, 13
"""A held-out street; no frame that the detectors were trained, chosen or judged on."""


@pytest.mark.parametrize("name", SHIPPED)
def test_near_cars_are_found(name: str) -> None:
    frame = generate_frame(SEED, INDEX, "heldout")
    targets = make_targets(frame.labels)
    objects = len(frame.labels.kind)  # regions to ignore stand behind them
    boxes_xyxy = targets.boxes_xyxy[:objects]
    near = (targets.labels[:objects] == CLASSES.index("Car")) & (boxes_xyxy[:, 3] - boxes_xyxy[:, 1] >= 40)
    near &= (frame.labels.occlusion == 0) & (frame.labels.truncation < 0.1)
    assert int(near.sum()) >= 1
    detector = load_detector(name)
    image = torch.from_numpy(frame.image).permute(2, 0, 1)[None].float() / 255
    found = detector.decode(detector(image))[0]
    sure = (found.scores >= detector.t_star) & (found.labels == CLASSES.index("Car"))
    overlap = iou_matrix(boxes_xyxy[near], found.boxes_xyxy[sure])
    assert float((overlap.max(1).values > 0.5).float().mean()) == 1.0


FILES = [path for part in ("detectors", "drivesem", "scene_ir") for path in (ROOT / part).rglob("*.safetensors")]


@pytest.mark.parametrize("path", sorted(FILES), ids=lambda path: path.stem)
def test_a_card_has_the_sha_of_every_file(path: Path) -> None:
    files.check_model_card(path, files.read_bytes(path))
