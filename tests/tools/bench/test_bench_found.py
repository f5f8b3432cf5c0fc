"""Found again, or elsewhere: what bench found counts, with detectors that see what they are told."""

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from detectors.types import Detections
from drivesem.attacks.feasibility_check import check_places
from drivesem.attacks.labels import Labeller
from drivesem.evaluation.resampling import wilson
from scene_ir.errors import FormatError
from scene_ir.io import save_scene
from scene_ir.types import SceneIR
from tools.bench import found
from tools.bench.__main__ import main
from tools.bench.sights import SCORE, DetectorSight

CLASSES = ("person", "Car", "truck")
PERSON, CAR, TRUCK = range(3)
Rows = Sequence[tuple[Sequence[float], int, float]]
"""Boxes, labels, scores."""


def detections(rows: Rows) -> Detections:
    return Detections(
        torch.tensor([list(box) for box, _, _ in rows]).view(-1, 4),
        torch.tensor([label for _, label, _ in rows], dtype=torch.int64),
        torch.tensor([score for _, _, score in rows], dtype=torch.float32),
    )


class Told:
    """Answers in turn, whatever it is shown; keeps what it was shown."""

    name = "told"
    classes = CLASSES

    def __init__(self, answers: Sequence[Rows]) -> None:
        self.answers = list(answers)
        self.shown: list[Tensor] = []

    def forward(self, images: Tensor) -> Tensor:
        self.shown.append(images[0])
        return images

    def decode(self, raw: Tensor) -> list[Detections]:
        return [detections(self.answers.pop(0))]


def cars(boxes: Tensor, scores: Sequence[float]) -> Rows:
    return [(box, CAR, score) for box, score in zip(boxes.tolist(), scores, strict=True) if score > 0]


def moved_boxes(scene: SceneIR) -> tuple[dict[int, Tensor], Tensor, list[int]]:
    """Boxes (N, 4) with each car moved alone, then with all that fit; rows of those."""
    moves = found.CarMoves(scene, range(len(scene.objects)), np.random.default_rng(0))
    boxes = moves.together().boxes_xyxy
    return {row: move.boxes_xyxy for row, move in moves.alone.items()}, boxes, moves.in_crowd


def test_moves_are_free_and_all_their_size(street: Callable[..., SceneIR]) -> None:
    scene = street()
    moves = found.CarMoves(scene, range(4), np.random.default_rng(3))
    assert set(moves.alone) == {0, 1, 2, 3}
    for row, move in moves.alone.items():
        apart = (move.scene.objects.translation - scene.objects.translation).norm(dim=1)
        turned = move.scene.objects.yaw - scene.objects.yaw
        expected = torch.zeros(4)
        expected[row] = 1
        torch.testing.assert_close(apart, 0.5 * expected, atol=1e-5, rtol=0)
        torch.testing.assert_close(turned.abs(), np.pi / 18 * expected, atol=1e-5, rtol=0)
        assert check_places(scene, move.scene, range(4)) == []
        torch.testing.assert_close(move.boxes_xyxy, Labeller(scene).moved(move.scene).boxes_xyxy)


def test_what_is_counted(street: Callable[..., SceneIR]) -> None:
    scene = street(positions_xz=((-3.0, 9.0), (3.5, 12.0), (-1.5, 18.0), (1.8, 19.0)))
    boxes = scene.objects.box2d
    alone, crowd, together = moved_boxes(scene)
    assert set(together) == {0, 1, 2, 3}
    answers: list[Rows] = [
        cars(boxes, (0.9, 0.8, 0.7, 0.0)),  # the photograph: the last is not known
        [*cars(boxes, (0.0, 0.5, 0.2, 0.9)), (boxes[0].tolist(), TRUCK, 0.6)],  # emptied
        cars(crowd, (0.9, 0.9, 0.0, 0.9)),  # all moved: the third is lost
        cars(alone[0], (0.9, 0.9, 0.9, 0.9)),
        cars(alone[1], (0.9, SCORE - 0.01, 0.9, 0.9)),  # the second is lost
        cars(alone[2], (0.9, 0.9, 0.9, 0.9)),
        cars(alone[3], (0.9, 0.9, 0.9, 0.9)),
    ]
    told = Told(answers)
    rows = found.judge("street", scene, told, np.random.default_rng(0))
    assert told.answers == []
    assert torch.equal(told.shown[0], (scene.photograph * 255).round() / 255)
    assert [row.before.found for row in rows] == [True, True, True, False]
    assert [row.removed.found for row in rows] == [False, True, False, True]
    assert [row.removed_any.found for row in rows] == [True, True, False, True]
    assert [row.removed_faint.found for row in rows] == [False, True, True, True]
    assert [row.alone is not None and row.alone.found for row in rows] == [True, False, True, True]
    assert [row.together is not None and row.together.found for row in rows] == [True, True, False, True]
    assert [found.failures(row) for row in rows] == [[], ["removed", "alone"], ["together"], []]
    lines = {(line["which"], line["measure"]): line for line in found.summary(rows)}
    figures = {name: (line["found"], line["cars"]) for (which, name), line in lines.items() if which == "all"}
    assert figures == {
        "in the photograph": (3, 4),
        "removed, found again": (1, 3),
        "removed, IoU 0.3": (1, 3),
        "removed, as any vehicle": (2, 3),
        "removed, score 0.1": (2, 3),
        "removed, a new car in its place": (0, 3),
        "moved one at a time": (2, 3),
        "moved one at a time, as often": (3, 3),
        "moved all together": (2, 3),
        "moved all together, as often": (3, 3),
    }
    removed = lines["all", "removed, found again"]
    assert (removed["low"], removed["high"]) == tuple(round(v, 4) for v in wilson(1, 3))


def test_small_and_hidden_cars_are_beside(street: Callable[..., SceneIR]) -> None:
    scene = street()
    occlusion = torch.tensor([0, 2, 1, 0])
    scene = replace(scene, objects=replace(scene.objects, occlusion=occlusion))
    boxes = scene.objects.box2d.clone()
    boxes[3, 3] = boxes[3, 1] + 24
    scene = replace(scene, objects=replace(scene.objects, box2d=boxes))
    rows = found.judge("street", scene, Told([[]] * 7), np.random.default_rng(0))
    assert [row.judged for row in rows] == [True, False, True, False]
    assert [row.before for row in rows] == [DetectorSight()] * 4
    lines = [line for line in found.summary(rows) if line["measure"] == "in the photograph"]
    assert [(line["which"], line["cars"]) for line in lines] == [("judged", 2), ("all", 4)]


def test_a_detector_without_cars_is_refused(street: Callable[..., SceneIR]) -> None:
    told = Told([])
    told.classes = ("cat",)  # type: ignore[assignment]
    with pytest.raises(FormatError, match="expected one with class Car, found cat"):
        found.judge("street", street(), told, np.random.default_rng(0))


def test_the_command_reads_scenes_and_draws_failures(
    street: Callable[..., SceneIR],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    scene = street(positions_xz=((-2.5, 9.0), (2.5, 12.0)))
    for name in ("a", "b/c"):
        save_scene(scene, tmp_path / "scenes" / name)
    boxes = scene.objects.box2d
    # found in the photograph, found again after removal, lost wherever they are moved
    told = Told([cars(boxes, (0.9, 0.8)), cars(boxes, (0.6, 0.7)), [], [], []] * 2)
    monkeypatch.setattr(found, "load_predictor", lambda *_: told)
    out = tmp_path / "out"
    (out / "found").mkdir(parents=True)
    (out / "found" / "removed-09-old-1.png").write_bytes(b"of an earlier run")
    words = ["found", "--scenes", str(tmp_path / "scenes"), "--workers", "1", "--out", str(out)]
    assert main([*words, "--json"]) == 0
    captured = capsys.readouterr()
    result: dict[str, Any] = json.loads(captured.out)
    assert captured.out.count("\n") == 1
    assert (result["what"], result["frames"]) == ("found", 2)
    assert [(row["frame"], row["row"]) for row in result["rows"]] == [("a", 0), ("a", 1), ("b/c", 0), ("b/c", 1)]
    assert json.loads((out / "found.json").read_text()) == result
    assert "| removed, found again | 4 | 4 |" in (out / "found.md").read_text()
    names = sorted(path.name for path in (out / "found").iterdir())
    assert Counter(name.partition("-")[0] for name in names) == {"removed": 4, "alone": 4, "together": 4}
    # the surest first
    assert [name for name in names if name.startswith("removed")] == [
        *("removed-01-a-1.png", "removed-02-b_c-1.png", "removed-03-a-0.png", "removed-04-b_c-0.png"),
    ]


@pytest.mark.slow
def test_the_embedded_frames(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["found", "--limit", "1", "--workers", "1", "--json"]
    assert main(words) == 0
    result = json.loads(capsys.readouterr().out)
    lines = {(line["which"], line["measure"]): line for line in result["summary"]}
    assert lines["all", "in the photograph"]["found"] > 0
    assert lines["all", "removed, found again"]["found"] == 0
    assert result["command"] == "python -m tools.bench found --limit 1 --workers 1"
