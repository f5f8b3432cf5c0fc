"""Failures in both pictures, by each renderer's labels: what counts, what is ignored, what is the same failure."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch

from detectors.types import CLASSES, Detections, Targets
from drivesem.analysis.confirm import compare_failures, compare_objects, pair_targets
from drivesem.attacks.targets import EvaluatedClasses
from drivesem.failures.second_renderer.base import SecondRender
from drivesem.run.results import BoxRecord, Failure

T_STAR = 0.5
BOX = (100.0, 100.0, 160.0, 140.0)
CAR = CLASSES.index("Car")
NOTHING = (0.0, 0.0, 0.0, 0.0)


def shifted_box(step: float) -> tuple[float, float, float, float]:
    x0, y0, x1, y1 = BOX
    return x0 + step, y0, x1 + step, y1


def drawn(
    *boxes: tuple[float, ...], ignored: tuple[int, ...] = (), region: tuple[float, ...] | None = None
) -> SecondRender:
    """A picture with cars in these boxes, and one region for cars."""
    count = len(boxes)
    rows = [*boxes, *([region] if region else [])]
    ignore = [i in ignored for i in range(count)] + [True] * (len(rows) - count)
    targets = Targets(
        torch.tensor(rows, dtype=torch.float32).reshape(-1, 4), torch.full((len(rows),), CAR), torch.tensor(ignore)
    )
    return SecondRender(torch.zeros(3, 4, 4), targets, torch.zeros(count, 4))


def detections(*boxes: tuple[float, ...]) -> Detections:
    count = len(boxes)
    return Detections(
        torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4),
        torch.full((count,), CAR),
        torch.full((count,), 0.9),
    )


def test_rows_are_objects_then_regions_of_both_pictures() -> None:
    before = drawn(BOX, shifted_box(300), shifted_box(500), ignored=(0,), region=shifted_box(700))
    after = drawn(BOX, shifted_box(310), shifted_box(500), ignored=(2,), region=shifted_box(800))
    rows = pair_targets(before, after, 3)
    for targets in (rows.benign, rows.changed):
        assert targets.ignore.tolist() == [True, False, True, True, True]
        assert targets.boxes_xyxy[3:].tolist() == [list(shifted_box(700)), list(shifted_box(800))]
    assert rows.benign.boxes_xyxy[1].tolist() == list(shifted_box(300))
    assert rows.changed.boxes_xyxy[1].tolist() == list(shifted_box(310))


def found(failures: list[Failure], after: Detections, *moved: tuple[float, ...]) -> Any:
    """Findings of two cars, both found before; `moved`: their boxes after the change."""
    before = drawn(BOX, shifted_box(300))
    rows = pair_targets(before, drawn(*moved) if moved else before, 2)
    result: Any = SimpleNamespace(failures=failures)
    seen = [detections(BOX, shifted_box(300)), after]
    return compare_failures(result, rows, seen, EvaluatedClasses(CLASSES, CLASSES), T_STAR)


def test_the_same_vehicle_is_lost_in_both() -> None:
    ours, theirs = found([Failure("lost", "Car", shifted_box(300), index=1)], detections(BOX))
    assert [(f.kind, f.index, f.survives) for f in ours] == [("lost", 1, True)]
    assert [(f.kind, f.index, f.survives, f.xyxy) for f in theirs] == [("lost", 1, True, shifted_box(300))]


def test_another_vehicle_is_another_failure() -> None:
    ours, theirs = found([Failure("lost", "Car", BOX, index=0)], detections(BOX))
    assert [(f.index, f.survives) for f in ours] == [(0, False)]
    assert [(f.index, f.survives) for f in theirs] == [(1, False)]


def test_what_is_ignored_is_not_lost() -> None:
    rows = pair_targets(drawn(BOX), drawn(NOTHING, ignored=(0,)), 1)
    result: Any = SimpleNamespace(failures=[Failure("lost", "Car", BOX, index=0)])
    seen = [detections(BOX), detections()]
    ours, theirs = compare_failures(result, rows, seen, EvaluatedClasses(CLASSES, CLASSES), T_STAR)
    assert [f.survives for f in ours] == [False]
    assert theirs == ()


def test_phantoms_of_a_class_and_place_are_the_same() -> None:
    phantoms = [
        Failure("phantom", "Car", shifted_box(505), score=0.8),
        Failure("phantom", "Car", shifted_box(700), score=0.8),
        Failure("phantom", "Truck", shifted_box(500), score=0.8),
    ]
    ours, theirs = found(phantoms, detections(BOX, shifted_box(300), shifted_box(500)))
    assert [f.survives for f in ours] == [True, False, False]
    assert [(f.kind, f.label, f.survives) for f in theirs] == [("phantom", "Car", True)]


def test_found_where_it_went_is_no_failure() -> None:
    ours, theirs = found([], detections(BOX, shifted_box(330)), BOX, shifted_box(330))
    assert ours == theirs == ()


def test_where_vehicles_stand() -> None:
    rows = pair_targets(
        drawn(BOX, shifted_box(300), BOX), drawn(BOX, shifted_box(312), NOTHING, ignored=(1, 2)), 3
    )
    record = [
        BoxRecord(BOX, "Car", index=0),
        BoxRecord(shifted_box(300), "Car", index=1),
        BoxRecord(BOX, "Car", index=2),
    ]
    moved = [BoxRecord(shifted_box(20), "Car", index=0), BoxRecord(shifted_box(312), "Car", index=1), record[2]]
    result: Any = SimpleNamespace(targets_benign=record, targets_moved=moved)
    one, two, three = compare_objects(result, rows, 3)
    assert (one.index, one.judged, one.iou_benign, one.iou) == (0, True, 1.0, 0.5)
    assert (two.index, two.judged, two.iou_benign, two.iou) == (1, False, 1.0, 1.0)
    assert (three.judged, three.iou) == (False, None)
