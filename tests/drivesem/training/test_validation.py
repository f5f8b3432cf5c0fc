"""Figures and the score of best F1, by hand."""

import pytest
import torch

from detectors.types import CLASSES, Detections, Targets
from drivesem.training.validation import score_detections


def test_judge_by_hand() -> None:
    def found(boxes_xyxy: list[list[float]], scores: list[float]) -> Detections:
        return Detections(
            torch.tensor(boxes_xyxy), torch.zeros(len(scores), dtype=torch.int64), torch.tensor(scores)
        )

    car, far, region = [0.0, 0.0, 10.0, 10.0], [50.0, 0.0, 60.0, 10.0], [80.0, 0.0, 99.0, 20.0]
    wanted = Targets(torch.tensor([car, far, region]), torch.tensor([0, 0, 0]), torch.tensor([False, False, True]))
    # hit at 0.9; double at 0.8 is false; inside the ignored region at 0.7 counts nowhere; hit at 0.6
    detections = found([car, [0.0, 0.0, 10.0, 11.0], [82.0, 2.0, 90.0, 9.0], far], [0.9, 0.8, 0.7, 0.6])
    marks = score_detections([detections], [wanted], CLASSES)
    assert marks.scores.headline.objects == 2
    assert marks.scores.headline.recall == 1.0
    assert marks.scores.headline.ap50 == pytest.approx((51 * 1.0 + 50 * 2 / 3) / 101)
    assert marks.selection_score == pytest.approx(1.25 * (51 * 1.0 + 50 * 2 / 3) / 101)
    assert marks.f1 == pytest.approx(2 * 2 / (3 + 2))
    assert marks.t_star == pytest.approx(0.6)


def test_nothing_found_is_no_threshold() -> None:
    none = Detections(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), torch.zeros(0))
    wanted = Targets(torch.tensor([[0.0, 0.0, 10.0, 10.0]]), torch.tensor([0]), torch.tensor([False]))
    marks = score_detections([none], [wanted], CLASSES)
    assert (marks.f1, marks.t_star, marks.scores.headline.recall) == (0.0, 0.5, 0.0)
