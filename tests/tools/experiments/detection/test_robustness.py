"""How likely arms miss a car, from hand-made counts."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from drivesem.run.finished import load_runs
from drivesem.run.folder import load_attack_config
from tools.experiments.detection.robustness import (
    ANYWHERE,
    AROUND,
    CONTROLS,
    REDRAWN,
    FailureCounts,
    FrameStateCounts,
    StateEvaluator,
    compare_robustness,
    evaluate_states,
)
from tools.experiments.settings import StudyConfig

ARMS = [
    ("benign detector", "benign detector"),
    ("benign", "on benign"),
    ("random", "on random"),
    ("certain", "ours"),
]
DROPS = {"benign detector": [0.0], "benign": [0.001], "random": [0.0], "certain": [0.004]}
DRAWS, CARS = 200, 40


def frames(lost: dict[str, tuple[int, ...]], count: int = 12) -> list[FrameStateCounts]:
    """Frames of 40 cars in 10 pictures; each detector loses so many in a frame, one more in each second one."""
    columns = len(next(iter(lost.values())))
    return [
        FrameStateCounts(
            str(i),
            "",
            {
                kind: FailureCounts(CARS, tuple(n + (n > 0) * (i % 2) for n in own), 10, (1,) * columns)
                for kind, own in lost.items()
            },
            "",
        )
        for i in range(count)
    ]


def by_arm(lost: tuple[int, ...], arms=ARMS, drops=DROPS):
    return rows_by_arm(frames({ANYWHERE: lost}), arms, drops)


def rows_by_arm(seen: list[FrameStateCounts], arms=ARMS, drops=DROPS):
    return {row.arm: row for row in compare_robustness(seen, arms, drops, DRAWS, 0)}


def test_shares_are_of_cars_and_paired() -> None:
    rows = by_arm((20, 16, 16, 8))
    certain = rows["certain"]
    assert certain.failures[ANYWHERE].value == pytest.approx(8.5 / CARS)
    fewer = certain.fewer[ANYWHERE, "benign"]
    assert fewer.value == pytest.approx(1 - 8.5 / 16.5)
    # What both lose more in the same frames takes nothing from the difference: narrower than either by itself.
    assert fewer.low == pytest.approx(fewer.value, abs=0.02)
    assert certain.failures[REDRAWN].value is None
    assert certain.failures[AROUND].value is None
    assert certain.phantoms.value == pytest.approx(0.1)
    assert set(rows["random"].fewer) == {(kind, "benign") for kind in (ANYWHERE, REDRAWN, AROUND)}
    json.dumps([row.to_row() for row in rows.values()], allow_nan=False)


@pytest.mark.parametrize(
    ("lost", "drop", "short_of"),
    [
        ((20, 16, 16, 8), 0.004, ()),
        ((20, 16, 16, 12), 0.004, ("third",)),
        ((20, 16, 16, 8), 0.006, ("AP50",)),
        ((20, 16, 8, 8), 0.0, ("random",)),
        ((20, 16, 16, 16), 0.0, ("third", "benign", "random")),
    ],
    ids=["met", "too little", "too dear", "random does it too", "nothing"],
)
def test_what_the_goal_is_short_of(lost: tuple[int, ...], drop: float, short_of: tuple[str, ...]) -> None:
    rows = by_arm(lost, drops=DROPS | {"certain": [drop, drop]})
    assert rows["certain"].short_of == short_of
    assert rows["certain"].to_row()["goal"] is (not short_of)
    assert {rows[name].short_of for name in (*CONTROLS, "benign detector")} == {None}


@pytest.mark.parametrize(("phantoms", "short_of"), [(1, ()), (5, ("phantoms",))])
def test_failures_bought_with_phantoms_do_not_count(phantoms: int, short_of: tuple[str, ...]) -> None:
    seen = [
        replace(one, counts={ANYWHERE: replace(one.counts[ANYWHERE], phantoms=(1, i % 3, 1, phantoms))})
        for i, one in enumerate(frames({ANYWHERE: (20, 16, 16, 8)}))
    ]
    assert rows_by_arm(seen)["certain"].short_of == short_of


def test_seeds_count_together() -> None:
    arms = [*ARMS, ("certain", "ours, seed 1")]
    drops = DROPS | {"certain": [0.0, 0.008]}
    row = by_arm((20, 16, 16, 6, 10), arms, drops)["certain"]
    assert row.failures[ANYWHERE].value == pytest.approx(8.5 / CARS)
    assert row.ap50_drop == pytest.approx(0.004)
    assert row.title == "ours"


@pytest.mark.slow
def test_all_detectors_see_the_same_states(small_run: Path, tmp_path: Path) -> None:
    """The same detector twice loses the same cars; going on asks nothing again."""
    study, attack = StudyConfig(name="retrain", states=4, workers=1), load_attack_config(small_run)
    (run,) = load_runs([str(small_run)])
    requested = ["squeezedet", "squeezedet", "yolov3-slim"]
    (one,), failed = evaluate_states(run, attack, requested, study, tmp_path)
    assert not failed
    assert one.note == ""
    anywhere, redrawn = one.counts[ANYWHERE], one.counts[REDRAWN]
    assert (anywhere.pictures, redrawn.pictures, one.counts[AROUND].pictures) == (4, 1, 0)
    assert 0 < redrawn.cars < anywhere.cars
    assert anywhere.lost[0] == anywhere.lost[1] <= anywhere.cars
    assert redrawn.lost[0] == redrawn.lost[1]
    assert len(anywhere.lost) == len(anywhere.phantoms) == 3
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StateEvaluator, "analyse", None)
        assert evaluate_states(run, attack, requested, study, tmp_path)[0] == [one]
        with pytest.raises(TypeError):
            evaluate_states(run, attack, requested[:2], study, tmp_path)
