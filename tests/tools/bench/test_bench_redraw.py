"""The second renderer beside the photograph: what bench redraw counts, by a detector that sees what it is told."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from detectors.types import Detections
from drivesem.synth.demo import demo_scene
from scene_ir import files
from tools.bench import redraw
from tools.bench.__main__ import main

pytestmark = pytest.mark.usefixtures("screen")


class Twice:
    """Sees all cars in the first two pictures, and nothing in the others."""

    name = "twice"
    classes = ("Car",)

    def __init__(self, boxes: Tensor) -> None:
        self.boxes, self.looks = boxes, 0

    def forward(self, images: Tensor) -> Tensor:
        self.looks += 1
        return images

    def decode(self, raw: Tensor) -> list[Detections]:
        boxes = self.boxes if self.looks <= 2 else self.boxes[:0]
        return [Detections(boxes, torch.zeros(len(boxes), dtype=torch.int64), torch.full((len(boxes),), 0.9))]


def row(name: str, **changes: object) -> redraw.RedrawRow:
    facts = {"cars": 2, "apart": 3.0, "psnr_db": 30.0, "apart_outside": 0.5, "psnr_moved_db": 25.0}
    facts |= {"photograph": 2, "ours": 2, "second": 1, "moved": 1, "ours_moved": 1, "second_moved": 0}
    return redraw.RedrawRow(frame=name, **facts | {"made_s": 1.0, "picture_s": 0.25} | changes)


def test_counts_are_summed_and_the_rest_is_averaged() -> None:
    lines = redraw.summary([row("a"), row("b", apart=5.0, second=2), row("empty", apart=None, cars=0)])
    assert [line["frame"] for line in lines] == ["a", "b", "all"]
    total = lines[-1]
    assert (total["cars"], total["second"], total["apart"], total["picture_s"]) == (4, 3, 4.0, 0.25)
    assert redraw.summary([row("empty", apart=None)]) == []


@pytest.mark.slow
def test_a_scene_by_both_renderers(tmp_path: Path) -> None:
    scene = demo_scene(0, 0)
    found = redraw.judge("demo/0", scene, Twice(scene.objects.box2d), np.random.default_rng(0), tmp_path)
    assert found.cars >= 1
    assert (found.photograph, found.ours, found.second) == (found.cars, found.cars, 0)
    assert (found.ours_moved, found.second_moved) == (0, 0)
    assert found.apart is not None
    assert found.psnr_db is not None
    assert found.apart < 12
    assert found.psnr_db > 20
    assert found.apart_outside < 1.5
    sheet = files.read_image(tmp_path / "demo-0.png")
    assert sheet.shape[1] == round(2 * scene.camera.width * 0.75)


@pytest.mark.slow
def test_the_command_writes_its_figures(tmp_path: Path) -> None:
    words = ["redraw", "--limit", "1", "--workers", "1", "--out", str(tmp_path)]
    assert main(words) == 0
    data = json.loads((tmp_path / "redraw.json").read_text())
    assert data["frames"] == 1
    assert (tmp_path / "redraw").is_dir()
