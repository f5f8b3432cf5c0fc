"""Detections with what they are beside the labels: their figures are pycocotools', to the last bit."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from detectors.types import Detections, Targets
from drivesem.evaluation.coco import IOU_THRESHOLDS, CocoScores, evaluate
from drivesem.evaluation.matched_class import ThresholdMatches
from drivesem.evaluation.resampling import WeightedAveragePrecision, WeightedRecall

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
        whose = torch.tensor(np.where(draw.random(len(near)) < 0.9, np.repeat(labels, times), 1))
        found.append(Detections(torch.tensor(near).float(), whose, scores))
    return targets, found


@pytest.mark.parametrize("seed", range(8))
def test_figures_are_those_of_coco_to_the_last_bit(seed: int) -> None:
    targets, found = random_frames(seed, 6)
    expected = evaluate(targets, found, CLASSES, 0.4)
    own = {
        name: ThresholdMatches.from_frames(targets, found, label).scores(0.4) for label, name in enumerate(CLASSES)
    }
    assert own == expected.per_class
    assert own["Car"].objects > 3
    assert CocoScores.from_classes(own, "Car") == expected


@pytest.mark.parametrize("seed", range(8))
def test_what_has_no_say_changes_no_figure(seed: int) -> None:
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
