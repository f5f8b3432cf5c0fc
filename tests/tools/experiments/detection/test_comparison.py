"""Metrics of an arm: drops, by which labels, and beyond the controls."""

from dataclasses import replace

import pytest

from drivesem.config.commands import AttackConfig
from drivesem.evaluation.resampling import holm
from drivesem.run.run_report import PAPER_BENIGN
from tests.tools.experiments.detection.conftest import arm, arm_run, counted, frame
from tools.experiments.detection.arms import PLACEBO, RANDOM
from tools.experiments.detection.comparison import compare_arms
from tools.experiments.detection.counts import ArmCounts

FRAMES = 8
FAR = 40.0
"""px: the moved car's label meets the old one at an IoU of 1/9."""


@pytest.fixture
def runs():
    """An attack that makes the detector lose a car in half of the frames; a random control that moves the car in
    all of them and is followed; a placebo that does nothing.
    """
    names = [f"{i:03d}" for i in range(FRAMES)]
    lost = [frame(n, moved_by=5.0, found=i % 2 == 0, success=i % 2 == 1, yaw=0.2) for i, n in enumerate(names)]
    followed = [frame(n, moved_by=FAR) for n in names]
    nothing = [frame(n, yaw=0.1) for n in names]
    return [
        counted(arm("rotate", 0.982), lost),
        counted(arm("rotate random", control=(RANDOM, "rotate")), followed),
        counted(arm("rotate placebo", control=(PLACEBO, "rotate")), nothing),
    ]


def test_a_row_for_each_arm_that_is_no_control(runs) -> None:
    (row,) = compare_arms(runs, draws=50, seed=0)
    flat = row.to_row()
    assert (flat["name"], flat["reference"], flat["frames"], flat["objects"]) == ("rotate", 0.982, 8, 16)
    assert flat["reference_drop"] == pytest.approx(PAPER_BENIGN - 0.982)
    assert flat["benign_ap50"] == 1.0
    # 12 of 16 cars are found, nothing else: precision is 1 up to a recall of 0.75
    assert flat["moved_ap50"] == pytest.approx(76 / 101)
    assert flat["recall_moved"] == 0.75
    assert flat["drop_moved"] == pytest.approx(25 / 101)
    assert flat["drop_moved_low"] < flat["drop_moved"] < flat["drop_moved_high"]
    assert flat["successes_moved"] == 4
    # Wilson's interval of 4 of 8, by hand: 0.5 +- 1.96 sqrt(1/32 + 1.96^2 / 256) / (1 + 1.96^2 / 8)
    assert flat["broken_moved"] == 0.5
    assert (flat["broken_moved_low"], flat["broken_moved_high"]) == pytest.approx((0.2152, 0.7848), abs=1e-4)
    assert flat["queries"] == 80
    assert flat["feasible_fraction"] == 1.0


def test_metrics_are_those_of_pycocotools() -> None:
    """As the run itself tells them, of detections that are true at some overlaps and false at others."""
    run = arm_run(arm("a"), [frame(f"{i}", moved_by=4.0 * i, found=i != 3) for i in range(FRAMES)])
    (row,) = compare_arms([ArmCounts.from_run(run)], draws=0, seed=0)
    sides = {
        "benign": run.summary.benign,
        "paper": run.summary.attacked_paper,
        "moved": run.summary.attacked_moved,
    }
    for side, scores in sides.items():
        for key in ("ap50", "ap70", "ap", "recall"):
            expected = getattr(scores.headline, key)
            assert getattr(getattr(row, side), key) == pytest.approx(expected, abs=1e-12), (side, key)
    assert row.to_row()["objects"] == run.summary.benign.headline.objects


def test_drops_are_those_of_the_metrics(runs) -> None:
    (row,) = compare_arms(runs, draws=0, seed=0)
    flat = row.to_row()
    for mode in ("paper", "moved"):
        for key in ("ap50", "ap70", "ap", "recall"):
            drop = flat[f"drop_{mode}" if key == "ap50" else f"drop_{mode}_{key}"]
            after = flat[f"recall_{mode}"] if key == "recall" else flat[f"{mode}_{key}"]
            assert drop == pytest.approx(flat[f"benign_{key}"] - after, abs=1e-9)
    assert flat["drop_moved_low"] is None


def test_the_controls_stand_next_to(runs) -> None:
    (row,) = compare_arms(runs, draws=50, seed=0)
    flat = row.to_row()
    assert flat["placebo_drop_moved"] == 0
    assert flat["over_placebo_moved"] == pytest.approx(flat["drop_moved"])
    assert flat["over_placebo_moved_low"] <= flat["over_placebo_moved"] <= flat["over_placebo_moved_high"]
    # a car that moved and was found there is wrong by the labels that stay, and right by those that move
    assert flat["random_drop_moved"] == 0
    assert flat["random_drop_paper"] > 0.4
    assert flat["over_random_paper"] == pytest.approx(flat["random_paper_ap50"] - flat["paper_ap50"])
    assert flat["random_successes_moved"] == 0
    assert flat["placebo_size"] == pytest.approx(0.5)


def test_seeds_of_a_control_count_as_their_mean(runs) -> None:
    """Beside one that is followed in all frames, a second seed loses a car in all of them."""
    names = [f"{i:03d}" for i in range(FRAMES)]
    lost = counted(
        arm("rotate random 2", control=(RANDOM, "rotate"), seed=1),
        [frame(n, moved_by=5.0, found=False, success=True, yaw=0.1) for n in names],
    )
    (one,), (two,) = (compare_arms(these, draws=20, seed=0) for these in (runs, [*runs, lost]))
    alone, both = one.to_row(), two.to_row()
    # one of two cars: precision is 1 up to a recall of 0.5
    drop = 1 - 51 / 101
    assert both["random_drop_moved"] == pytest.approx(drop / 2)
    assert both["random_moved_ap50"] == pytest.approx(1 - drop / 2)
    assert both["over_random_moved"] == pytest.approx(alone["drop_moved"] - drop / 2)
    assert both["over_random_moved_low"] < both["over_random_moved"] < both["over_random_moved_high"]
    assert (both["random_successes_moved"], both["random_seeds"]) == (FRAMES / 2, 2)
    assert both["random_size"] == pytest.approx((0.5 + 0.5) / 2)


def test_the_effect_is_compared_with_the_control_with_as_many_chances(runs) -> None:
    """Random where the best is kept, the placebo where the last is; p is Holm's over the rows."""
    keeping_last = [
        replace(
            run,
            arm=replace(
                run.arm,
                name=f"last {run.arm.name}",
                control_of=run.arm.control_of and f"last {run.arm.control_of}",
            ),
        )
        for run in runs
    ]
    keeping_last[0] = replace(keeping_last[0], arm=replace(keeping_last[0].arm, config=AttackConfig(keep="last")))
    best, last = compare_arms([*runs, *keeping_last], draws=30, seed=0)
    assert (best.matching_control, last.matching_control) == (RANDOM, PLACEBO)
    ps = [best.effects[RANDOM]["moved"].p, last.effects[PLACEBO]["moved"].p]
    assert [best.p, last.p] == holm(ps)
    assert best.p >= ps[0]
    (alone,) = compare_arms(runs[:1], draws=20, seed=0)
    assert (alone.matching_control, alone.p, alone.to_row()["control"]) == (None, None, None)
