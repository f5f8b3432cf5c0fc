"""Failures in both pictures, by exact labels: what counts, what is ignored, what is the same failure."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from detectors.types import CLASSES, Detections
from drivesem.attack.judging import JudgedClasses
from drivesem.questions.confirm.judge import findings, stands
from drivesem.run.results import BoxRecord, Failure
from drivesem.truth.redraw.exact import exact_labels

T_STAR = 0.5
BOX = (100.0, 100.0, 160.0, 140.0)


def truth(track: int, box: tuple[float, ...] = BOX, kind: str = "Car", **changes: Any) -> Any:
    facts = {"labelled": True, "occlusion": 0, "truncation": 0.0} | changes
    actor = SimpleNamespace(track=track, label=kind)
    return SimpleNamespace(actor=actor, box_xyxy=np.array(box, float), **facts)


def frame(*truths: Any, ignore: tuple[tuple[float, ...], ...] = ()) -> Any:
    return SimpleNamespace(
        truths=truths, labels=SimpleNamespace(ignore_xyxy=torch.tensor(ignore, dtype=torch.float32).reshape(-1, 4))
    )


def beside(step: float) -> tuple[float, float, float, float]:
    x0, y0, x1, y1 = BOX
    return x0 + step, y0, x1 + step, y1


def detections(*boxes: tuple[float, ...], label: str = "Car", score: float = 0.9) -> Detections:
    count = len(boxes)
    return Detections(
        torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4),
        torch.full((count,), CLASSES.index(label)),
        torch.full((count,), score),
    )


def test_what_is_too_hard_before_or_after_is_ignored() -> None:
    before = frame(
        truth(0),
        truth(1, occlusion=2),
        truth(2),
        truth(3),
        truth(4),
        truth(5, labelled=False),
        truth(6, kind="Van"),
    )
    after = frame(
        truth(0, beside(9)), truth(1), truth(2, truncation=0.4), truth(4, labelled=False), truth(6, kind="Van")
    )
    exact = exact_labels(before, after)
    assert exact.tracks == (0, 1, 2, 3, 4, 6)
    assert exact.changed.ignore.tolist() == [False, True, True, True, True, False]
    assert exact.benign.boxes_xyxy[0].tolist() == list(BOX)
    assert exact.changed.boxes_xyxy[0].tolist() == list(beside(9))
    assert exact.changed.boxes_xyxy[3].tolist() == [0, 0, 0, 0]
    assert exact.changed.labels.tolist() == [CLASSES.index("Car")] * 6


def test_people_and_what_comes_into_view_are_regions_of_both() -> None:
    person = truth(7, beside(200), "Pedestrian")
    before = frame(truth(0), person, ignore=(beside(400),))
    after = frame(truth(0), person, truth(8, beside(600)), ignore=(beside(400),))
    exact = exact_labels(before, after)
    for targets in (exact.benign, exact.changed):
        assert targets.ignore.tolist() == [False] + [True] * (len(targets.ignore) - 1)
    regions = exact.changed.boxes_xyxy[1:, 0].unique().tolist()
    assert regions == [BOX[0] + step for step in (200, 400, 600)]
    # each for every class
    assert len(exact.changed.labels) == 1 + len(CLASSES) * 5


def found(failures: list[Failure], after: Detections, *moved: Any) -> Any:
    """Findings of two cars with tracks 4 and 9, both found before; `moved`: their truths after the change."""
    before = frame(truth(4), truth(9, beside(300)))
    exact = exact_labels(before, frame(*(moved or before.truths)))
    result = SimpleNamespace(failures=failures)
    seen = [detections(BOX, beside(300)), after]
    return findings(result, (9, 4, None), exact, seen, JudgedClasses(CLASSES, CLASSES), T_STAR)


def test_the_same_vehicle_is_lost_in_both() -> None:
    ours, theirs = found([Failure("lost", "Car", beside(300), index=0)], detections(BOX))
    assert [(f.kind, f.track, f.survives) for f in ours] == [("lost", 9, True)]
    assert [(f.kind, f.track, f.survives, f.xyxy) for f in theirs] == [("lost", 9, True, beside(300))]


def test_another_vehicle_is_another_failure() -> None:
    ours, theirs = found([Failure("lost", "Car", BOX, index=1)], detections(BOX))
    assert [(f.track, f.survives) for f in ours] == [(4, False)]
    assert [(f.track, f.survives) for f in theirs] == [(9, False)]


def test_without_a_counterpart_nothing_survives() -> None:
    ours, _ = found([Failure("lost", "Car", beside(300), index=2)], detections(BOX))
    assert [(f.track, f.survives) for f in ours] == [(None, False)]


def test_phantoms_of_a_class_and_place_are_the_same() -> None:
    phantoms = [
        Failure("phantom", "Car", beside(505), score=0.8),
        Failure("phantom", "Car", beside(700), score=0.8),
        Failure("phantom", "Truck", beside(500), score=0.8),
    ]
    ours, theirs = found(phantoms, detections(BOX, beside(300), beside(500)))
    assert [f.survives for f in ours] == [True, False, False]
    assert [(f.kind, f.label, f.survives) for f in theirs] == [("phantom", "Car", True)]


def test_found_where_it_went_is_no_failure() -> None:
    ours, theirs = found([], detections(BOX, beside(330)), truth(4), truth(9, beside(330)))
    assert ours == theirs == ()


def test_where_vehicles_stand() -> None:
    before = frame(truth(4), truth(9, beside(300)))
    after = frame(truth(4), truth(9, beside(312), occlusion=3))
    record = [
        BoxRecord(BOX, "Car", index=0),
        BoxRecord(beside(300), "Car", index=1),
        BoxRecord(BOX, "Car", index=2),
    ]
    moved = [BoxRecord(beside(20), "Car", index=0), BoxRecord(beside(312), "Car", index=1)]
    result: Any = SimpleNamespace(targets_benign=record, targets_moved=moved)
    one, two = stands(result, (4, 9, None), exact_labels(before, after), before, after)
    assert (one.index, one.track, one.judged, one.iou_benign, one.iou) == (0, 4, True, 1.0, 0.5)
    assert (two.index, two.track, two.judged, two.iou_benign, two.iou) == (1, 9, False, 1.0, 1.0)
