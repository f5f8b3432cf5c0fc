"""The twelve numbers on random and adversarial sets beside pycocotools itself, and this project's own matching."""

import contextlib
import io
from types import SimpleNamespace

import numpy as np
import pytest
import ultrafast_pycocotools
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from drivesem.evaluation.coco import IOU_THRESHOLDS, STATS, Engine, coco_stats, fastest_engine
from drivesem.evaluation.curves import average_precision
from drivesem.evaluation.instances import DetectionTable, GroundTruthTable, boxes_from_xywh
from drivesem.evaluation.matching import CandidatePairs, mean_of_known

ENGINES: list[Engine] = ["pycocotools", "ultrafast-pycocotools"]
CLASSES = 3
PYCOCOTOOLS = SimpleNamespace(COCO=COCO, COCOeval=COCOeval)


def _case(
    seed: int, frames: int = 6, objects: int = 8, spread: float = 120.0, ties: bool = False, crowd: float = 0.15
):
    draw = np.random.default_rng(seed)
    truth, found = [], []
    for frame in range(frames):
        for _ in range(draw.integers(0, objects + 1)):
            box = [*draw.uniform(0, spread, 2), *np.exp(draw.uniform(2, 5.2, 2))]
            label, is_crowd = int(draw.integers(0, CLASSES)), bool(draw.random() < crowd)
            truth.append((frame, label, box, is_crowd, float(box[2] * box[3] * draw.uniform(0.3, 1))))
            for _ in range(draw.integers(0, 4)):
                moved = np.array(box) * draw.normal(1, 0.08, 4)
                other = label if draw.random() < 0.9 else int(draw.integers(0, CLASSES))
                found.append((frame, other, moved.tolist(), round(draw.random(), 1 if ties else 6)))
        for _ in range(draw.integers(0, 4)):
            box = [*draw.uniform(0, spread, 2), *np.exp(draw.uniform(2, 5.2, 2))]
            found.append((frame, int(draw.integers(0, CLASSES)), box, round(draw.random(), 1 if ties else 6)))
    return truth, found, frames


def _arrays(truth, found, frames) -> tuple[GroundTruthTable, DetectionTable]:
    boxes = np.array([t[2] for t in truth], float).reshape(-1, 4)
    truths = GroundTruthTable(
        frames=frames,
        frame=np.array([t[0] for t in truth], np.int64),
        label=np.array([t[1] for t in truth], np.int64),
        boxes=boxes_from_xywh(boxes),
        ignore=np.array([t[3] for t in truth], np.bool_),
        truncation=np.full(len(truth), -1.0),
        occlusion=np.full(len(truth), -1, np.int64),
        distance_m=np.full(len(truth), np.nan),
        area=np.array([t[4] for t in truth], float),
    )
    return truths, DetectionTable(
        frame=np.array([d[0] for d in found], np.int64),
        label=np.array([d[1] for d in found], np.int64),
        boxes=boxes_from_xywh(np.array([d[2] for d in found], float).reshape(-1, 4)),
        score=np.array([d[3] for d in found], float),
    )


def _reference(truth, found, frames, first_id=1, tools=PYCOCOTOOLS) -> COCOeval:
    """pycocotools as its users call it, with ids of its own; or what takes its place."""
    with contextlib.redirect_stdout(io.StringIO()):
        sets = []
        for rows in (truth, found):
            coco = tools.COCO()
            coco.dataset = {
                "images": [{"id": 7 * i + 3} for i in range(frames)],
                "categories": [{"id": 10 * k + 1, "name": f"c{k}"} for k in range(CLASSES)],
                "annotations": [
                    {"id": i + (first_id if rows is truth else 1), "image_id": 7 * row[0] + 3,
                     "category_id": 10 * row[1] + 1, "bbox": list(row[2])}
                    | (
                        {"iscrowd": int(row[3]), "area": row[4]}
                        if rows is truth
                        else {"iscrowd": 0, "score": row[3], "area": row[2][2] * row[2][3]}
                    )
                    for i, row in enumerate(rows)
                ],
            }  # fmt: skip
            coco.createIndex()
            sets.append(coco)
        evaluator = tools.COCOeval(*sets, iouType="bbox")
        evaluator.evaluate()
        evaluator.accumulate()
        evaluator.summarize()
    return evaluator


def _many_detections():
    truth, found, frames = _case(5, frames=2)
    draw = np.random.default_rng(0)
    for frame in range(2):
        for _ in range(150):
            box = [*draw.uniform(0, 120, 2), *draw.uniform(10, 60, 2)]
            found.append((frame, 1, box, round(draw.random(), 2)))
    return truth, sorted(found, key=lambda d: d[0]), frames


CASES = {
    **{f"random {seed}": _case(seed) for seed in range(8)},
    **{f"ties {seed}": _case(seed, ties=True, spread=40.0) for seed in range(8, 12)},
    "no ground truth": ([], _case(1)[1], 6),
    "no detections": (_case(1)[0], [], 6),
    "nothing": ([], [], 3),
    "only crowds": _case(2, crowd=1.0),
    "more than 100 detections": _many_detections(),
    "equal boxes": (
        [(0, 0, [10.0, 10.0, 50.0, 50.0], False, 2500.0)] * 3,
        [(0, 0, [10.0, 10.0, 50.0, 50.0], 0.5)] * 4,
        1,
    ),
    "IoU of exactly one half": (
        [(0, 0, [0.0, 0.0, 100.0, 100.0], False, 1e4), (0, 0, [300.0, 0.0, 100.0, 100.0], False, 1e4)],
        [(0, 0, [0.0, 0.0, 50.0, 100.0], 0.9), (0, 0, [300.0, 0.0, 75.0, 100.0], 0.8)],
        1,
    ),
    "a box without an area": (
        [(0, 0, [0.0, 0.0, 100.0, 100.0], False, 1e4)],
        [(0, 0, [5.0, 5.0, 0.0, 0.0], 0.9), (0, 0, [0.0, 0.0, 100.0, 100.0], 0.8)],
        1,
    ),
}


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", CASES)
def test_twelve_numbers(engine: Engine, name: str):
    expected = _reference(*CASES[name]).stats
    truths, found = _arrays(*CASES[name])
    numbers = coco_stats(truths, found, CLASSES, engine)
    assert len(numbers) == len(STATS) == 12
    assert numbers == expected.tolist()


@pytest.mark.parametrize("name", CASES)
def test_the_fast_engine_is_pycocotools_to_the_bit(name: str):
    """All that it counts, not only what is told of it."""
    slow, fast = _reference(*CASES[name]), _reference(*CASES[name], tools=ultrafast_pycocotools)
    assert slow.eval.keys() <= fast.eval.keys()
    for array in ("precision", "recall", "scores"):
        np.testing.assert_array_equal(fast.eval[array], slow.eval[array], strict=True)


def test_an_id_of_zero_is_no_match():
    """Only pycocotools itself counts so."""
    engine = fastest_engine(np.arange(3))
    assert (engine, fastest_engine(np.arange(1, 4))) == ("pycocotools", "ultrafast-pycocotools")
    truth, found, frames = CASES["a box without an area"]
    truths, detections = _arrays(truth, found, frames)
    expected = _reference(truth, found, frames, first_id=0).stats.tolist()
    ours = coco_stats(truths, detections, CLASSES, engine, np.arange(len(truth)))
    assert ours == pytest.approx(expected, abs=1e-9)
    assert expected != pytest.approx(_reference(truth, found, frames).stats.tolist(), abs=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_our_own_matching_gives_the_same_precision(name: str):
    evaluator = _reference(*CASES[name])
    truths, found = _arrays(*CASES[name])
    candidates = CandidatePairs.from_tables(truths, found, float(IOU_THRESHOLDS[0]))
    means = []
    for t, threshold in enumerate(IOU_THRESHOLDS.tolist()):
        match = candidates.match_coco(threshold)
        for k in range(CLASSES):
            tally = candidates.class_matches(match, k)
            expected = evaluator.eval["precision"][t, :, k, 0, 2]
            ours = average_precision(tally, "coco")
            means.append(ours)
            assert (ours is None) == (expected[0] == -1)
            assert ours is None or ours == pytest.approx(expected.mean(), abs=1e-12)
            recall = evaluator.eval["recall"][t, k, 0, 2]
            assert tally.recall() == (None if recall == -1 else pytest.approx(recall, abs=1e-12))
    whole = mean_of_known(means)
    assert (-1 if whole is None else whole) == pytest.approx(evaluator.stats[0], abs=1e-12)
