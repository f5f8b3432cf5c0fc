"""What is marked in a picture, beside a look at all frames; nobody looks where no picture is asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from detectors.types import Detections, Targets
from drivesem.cli import main
from drivesem.evaluation.coco import IOU_THRESHOLDS, CocoScores, evaluate
from drivesem.evaluation.matched_class import MatchedClass, ThresholdMatches
from drivesem.evaluation.matching import UNMATCHED
from drivesem.evaluation.resampling import WeightedAveragePrecision, WeightedRecall
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
    monkeypatch.setattr(MatchedClass, "frame_marks", lambda *words: evaluated.append(words[1]) or marks(*words))
    words = ["eval", "--detector", "squeezedet", "--dataset", "yolo", "--root", str(tmp_path), "--bootstrap", "0"]
    assert main([*words, "--workers", "1", "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out/metrics.json").is_file()
    assert not evaluated
    assert main([*words, "--workers", "1", "--out", str(tmp_path / "drawn"), "--pictures", "1"]) == 0
    assert evaluated == [0]


CLASSES = ("Car", "Truck", "Cyclist")


def random_frames(seed: int, frames: int) -> tuple[list[Targets], list[Detections]]:
    """Crowded: objects overlap one another, some are ignored, scores tie; in the first frame more than 100 are
    detected, and there is no cyclist.
    """
    draw = np.random.default_rng(seed)
    targets, found = [], []
    for frame in range(frames):
        count = int(draw.integers(0, 9))
        corners = draw.uniform(0, 150, (count, 2))
        boxes = np.concatenate([corners, corners + draw.uniform(18, 70, (count, 2))], 1)
        labels, ignore = draw.integers(0, 2, count), draw.random(count) < 0.2
        targets.append(Targets(torch.tensor(boxes).float(), torch.tensor(labels), torch.tensor(ignore)))
        times = 40 if frame == 0 else 3
        near = np.repeat(boxes, times, 0) + draw.normal(0, 4, (count * times, 4))
        scores = torch.tensor(draw.random(len(near)).round(1 if seed % 2 else 6)).float()
        owner = torch.tensor(np.where(draw.random(len(near)) < 0.9, np.repeat(labels, times), 1))
        found.append(Detections(torch.tensor(near).float(), owner, scores))
    return targets, found


@pytest.mark.parametrize("seed", range(8))
def test_metrics_equal_coco_to_the_last_bit(seed: int) -> None:
    targets, found = random_frames(seed, 6)
    expected = evaluate(targets, found, CLASSES, 0.4)
    own = {
        name: ThresholdMatches.from_frames(targets, found, label).scores(0.4) for label, name in enumerate(CLASSES)
    }
    assert own == expected.per_class
    assert own["Car"].objects > 3
    assert CocoScores.from_classes(own, "Car") == expected


@pytest.mark.parametrize("seed", range(8))
def test_unaffecting_detections_change_no_metric(seed: int) -> None:
    """To the last bit, at any weights of the frames."""
    matches = ThresholdMatches.from_frames(*random_frames(seed, 6), 0)
    stored = matches.affects_metrics()
    assert 0 < stored.sum() < len(stored)
    less = ThresholdMatches(matches.frame[stored], matches.score[stored], matches.marks[stored], matches.objects)
    assert less.affects_metrics().all()
    assert less.scores(0.4) == matches.scores(0.4)
    draws = np.random.default_rng(seed).multinomial(6, np.full(6, 1 / 6), 200).astype(np.float64)
    for place in range(len(IOU_THRESHOLDS)):
        one, other = less.class_matches(place), matches.class_matches(place)
        for figure in (WeightedRecall, lambda tally: WeightedAveragePrecision(tally, "coco")):
            assert [figure(one).value(w) for w in draws] == [figure(other).value(w) for w in draws]


def test_nothing_to_find_or_nothing_found() -> None:
    targets, found = random_frames(1, 4)
    empty = [Targets(t.boxes_xyxy[:0], t.labels[:0], t.ignore[:0]) for t in targets]
    none = [Detections(d.boxes_xyxy[:0], d.labels[:0], d.scores[:0]) for d in found]
    for case in ((targets, none), (empty, found)):
        assert not ThresholdMatches.from_frames(*case, 0).affects_metrics().any()
        assert ThresholdMatches.from_frames(*case, 0).scores(0.4) == evaluate(*case, CLASSES, 0.4).headline
