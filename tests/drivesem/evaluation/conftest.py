"""Random frames of objects and detections, and objects made from plain rows."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from drivesem.evaluation.instances import DetectionTable, GroundTruthTable, boxes_from_xyxy

KINDS = ("Car", "Van", "Pedestrian", "Person_sitting", "Cyclist", "Truck")


def truths_of(rows: Sequence[tuple], frames: int, kinds: Sequence[str] = KINDS) -> GroundTruthTable:
    """Rows of frame, kind ("DontCare" too), box xyxy, truncation, occlusion."""
    names = {**{kind: i for i, kind in enumerate(kinds)}, "DontCare": -1}
    boxes = np.array([row[2] for row in rows], float).reshape(-1, 4)
    return GroundTruthTable(
        frames=frames,
        frame=np.array([row[0] for row in rows], np.int64),
        label=np.array([names[row[1]] for row in rows], np.int64),
        boxes=boxes_from_xyxy(boxes),
        ignore=np.array([row[1] == "DontCare" for row in rows], np.bool_),
        truncation=np.array([row[3] if len(row) > 3 else 0.0 for row in rows], float),
        occlusion=np.array([row[4] if len(row) > 4 else 0 for row in rows], np.int64),
        distance_m=np.full(len(rows), np.nan),
        area=(boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]),
    )


def found_of(rows: Sequence[tuple], kinds: Sequence[str] = KINDS) -> DetectionTable:
    """Rows of frame, kind, box xyxy, score; sorted by frame here."""
    rows = sorted(rows, key=lambda row: row[0])
    return DetectionTable(
        frame=np.array([row[0] for row in rows], np.int64),
        label=np.array([kinds.index(row[1]) for row in rows], np.int64),
        boxes=boxes_from_xyxy(np.array([row[2] for row in rows], float).reshape(-1, 4)),
        score=np.array([row[3] for row in rows], float),
    )


def random_rows(seed: int, frames: int, crowded: bool) -> tuple[list[tuple], list[tuple]]:
    """Objects and detections of every kind. crowded: objects overlap one another, and scores tie."""
    draw = np.random.default_rng(seed)
    truth, found = [], []
    for frame in range(frames):
        extent = 180 if crowded else 900
        for _ in range(draw.integers(0, 9)):
            corner = draw.uniform(0, extent, 2)
            size = draw.uniform(18, 70, 2)
            box = np.round(np.concatenate([corner, corner + size]), 2)
            kind = draw.choice([*KINDS, "DontCare"], p=[0.45, 0.1, 0.15, 0.05, 0.1, 0.05, 0.1])
            truth.append((frame, str(kind), tuple(box), round(draw.uniform(0, 0.6), 2), int(draw.integers(0, 4))))
            for _ in range(draw.choice([0, 1, 2, 3], p=[0.2, 0.5, 0.2, 0.1])):
                moved = np.round(box + draw.normal(0, draw.choice([0.5, 3.0]), 4), 2)
                moved[2:] = np.maximum(moved[2:], moved[:2] + 1)
                name = str(kind) if kind != "DontCare" and draw.random() < 0.85 else str(draw.choice(KINDS))
                found.append((frame, name, tuple(moved), round(draw.uniform(0, 1), 1 if crowded else 4)))
        for _ in range(draw.integers(0, 4)):
            corner = draw.uniform(0, extent, 2)
            box = np.round(np.concatenate([corner, corner + draw.uniform(18, 70, 2)]), 2)
            found.append(
                (frame, str(draw.choice(KINDS)), tuple(box), round(draw.uniform(0, 1), 1 if crowded else 4))
            )
    return truth, found


@pytest.fixture
def make_truths() -> Callable[..., GroundTruthTable]:
    return truths_of


@pytest.fixture
def make_found() -> Callable[..., DetectionTable]:
    return found_of


@pytest.fixture
def draw_rows() -> Callable[..., tuple[list[tuple], list[tuple]]]:
    return random_rows
