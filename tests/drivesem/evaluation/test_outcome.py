"""What is marked in a picture, beside a look at all frames; nobody looks where no picture is asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from detectors.types import Detections, Targets
from drivesem.cli import main
from drivesem.evaluation.matched_class import MatchedClass
from drivesem.evaluation.matching import UNMATCHED
from scene_ir import files


def _random(draw: np.random.Generator) -> tuple[Targets, Detections]:
    """Objects in a row, and detections on and beside them."""
    objects, found = int(draw.integers(0, 5)), int(draw.integers(0, 7))
    places = torch.from_numpy(draw.permutation(8)[:objects] * 60.0).float()
    seen = torch.from_numpy(draw.permutation(8)[:found] * 60.0 + draw.uniform(0, 25, found)).float()
    boxes, others = (torch.stack([x, x * 0, x + 50, x * 0 + 50], dim=1) for x in (places, seen))
    labels = torch.zeros(objects, dtype=torch.int64)
    ignore = torch.from_numpy(draw.random(objects) < 0.3)
    scores = torch.from_numpy(draw.uniform(0, 1, found)).float()
    return Targets(boxes, labels, ignore), Detections(others, torch.zeros(found, dtype=torch.int64), scores)


@pytest.mark.parametrize("seed", range(4))
def test_marks_are_those_of_the_frame(seed: int) -> None:
    draw = np.random.default_rng(seed)
    targets, found = zip(*(_random(draw) for _ in range(12)), strict=True)
    outcome = MatchedClass.from_frames(targets, found, 0)
    truths, detections, match = outcome.candidates.ground_truth, outcome.candidates.detections, outcome.match
    for frame in range(12):
        mine = truths.frame == frame
        seen = (detections.frame == frame) & (detections.score >= 0.4)
        hit = np.isin(np.arange(len(truths)), match.ground_truth[seen])
        alarms = seen & (match.ground_truth == UNMATCHED) & ~match.excused
        marks = outcome.frame_marks(frame, 0.4)
        assert np.array_equal(marks.hits, detections.boxes[seen & (match.ground_truth != UNMATCHED), :4])
        assert np.array_equal(marks.matched, truths.boxes[mine & hit, :4])
        assert np.array_equal(marks.missed, truths.boxes[mine & ~hit & ~truths.ignore, :4])
        assert np.array_equal(marks.ignored, truths.boxes[mine & truths.ignore, :4])
        assert np.array_equal(marks.false_positives, detections.boxes[alarms, :4])
        assert np.array_equal(marks.false_positive_scores, detections.score[alarms])
        assert marks.error_count == len(marks.missed) + len(marks.false_positives)


def test_nothing_is_marked_without_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of tens of thousands of frames it takes a while."""
    files.write_png(tmp_path / "images/train/a.png", np.full((96, 128, 3), 120, np.uint8))
    files.write_text(tmp_path / "labels/train/a.txt", "0 0.5 0.5 0.4 0.4\n")
    files.write_text(tmp_path / "data.yaml", "train: images/train\nval: images/train\nnames: [Car]\n")
    evaluated: list[int] = []
    marks = MatchedClass.frame_marks
    monkeypatch.setattr(MatchedClass, "marks", lambda *words: evaluated.append(words[1]) or marks(*words))
    words = ["eval", "--detector", "squeezedet", "--dataset", "yolo", "--root", str(tmp_path), "--bootstrap", "0"]
    assert main([*words, "--workers", "1", "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out/metrics.json").is_file()
    assert not evaluated
    assert main([*words, "--workers", "1", "--out", str(tmp_path / "drawn"), "--pictures", "1"]) == 0
    assert evaluated == [0]
