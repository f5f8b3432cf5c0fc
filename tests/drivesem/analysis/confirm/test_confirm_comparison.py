"""Failures in both pictures, by each renderer's labels: what counts, what is ignored, what is the same failure."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from detectors.types import CLASSES, Detections, Targets
from drivesem.analysis.confirm import RetestedFailure, compare_objects, find_second_failures, pair_targets
from drivesem.attacks.targets import EvaluatedClasses
from drivesem.failures.grades import SecondOpinion
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


def found(after: Detections, *moved: tuple[float, ...]) -> Any:
    """Failures of two cars, both found before; `moved`: their boxes after the change."""
    before = drawn(BOX, shifted_box(300))
    rows = pair_targets(before, drawn(*moved) if moved else before, 2)
    seen = [detections(BOX, shifted_box(300)), after]
    return find_second_failures(rows, seen, EvaluatedClasses(CLASSES, CLASSES), T_STAR)


def test_a_lost_vehicle() -> None:
    (one,) = found(detections(BOX))
    assert (one.kind, one.index, one.xyxy) == ("lost", 1, shifted_box(300))


def test_what_is_ignored_is_not_lost() -> None:
    rows = pair_targets(drawn(BOX), drawn(NOTHING, ignored=(0,)), 1)
    seen = [detections(BOX), detections()]
    assert find_second_failures(rows, seen, EvaluatedClasses(CLASSES, CLASSES), T_STAR) == ()


def test_a_phantom() -> None:
    (one,) = found(detections(BOX, shifted_box(300), shifted_box(500)))
    assert (one.kind, one.label, one.index, one.score) == ("phantom", "Car", None, pytest.approx(0.9))


def test_found_where_it_went_is_no_failure() -> None:
    assert found(detections(BOX, shifted_box(330)), BOX, shifted_box(330)) == ()


def opinion(before: int, after: int) -> SecondOpinion:
    return SecondOpinion("generator", before, after, 4)


@pytest.mark.parametrize(
    ("seen", "survives"), [(opinion(3, 3), True), (opinion(4, 2), False), (opinion(2, 4), False), (None, False)]
)
def test_survival_is_the_rule_of_the_grade_confirmed(seen: SecondOpinion | None, survives: bool) -> None:
    one = RetestedFailure(Failure("lost", "Car", BOX, index=1, error="missed", grade="certain"), seen)
    assert one.survives is survives
    assert one.to_json("a")["survives"] is (None if seen is None else survives)
    assert seen is None or seen.agrees is survives


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
