"""The generator's labels of two pictures of one street: what counts, what is ignored, what is a region."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from detectors.types import CLASSES
from drivesem.failures.second_renderer.generator import label_before_and_after

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
    exact = label_before_and_after(before, after)
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
    exact = label_before_and_after(before, after)
    for targets in (exact.benign, exact.changed):
        assert targets.ignore.tolist() == [False] + [True] * (len(targets.ignore) - 1)
    regions = exact.changed.boxes_xyxy[1:, 0].unique().tolist()
    assert regions == [BOX[0] + step for step in (200, 400, 600)]
    # each for every class
    assert len(exact.changed.labels) == 1 + len(CLASSES) * 5
