"""Success against queries, from where each frame was broken first."""

import numpy as np
import pytest

from tools.experiments.detection.success import against, curve_of, first_successes, most_queries


@pytest.fixture
def runs(frame, counted, arm):
    """One arm that breaks frames after 1, 3, 3 queries and one never; one that needs 8 in two of them."""
    quick = [(1, True), (3, True), (3, True), (10, False)]
    slow = [(8, True), (8, True), (64, False), (64, False)]
    made = {
        name: [frame(str(i), queries=q, success=won) for i, (q, won) in enumerate(pairs)]
        for name, pairs in (("quick", quick), ("slow", slow))
    }
    return (
        counted(arm("quick", early_stop=True), made["quick"]),
        counted(arm("slow", method="halton", queries=64, early_stop=True), made["slow"]),
    )


def test_the_curve_is_the_distribution_of_first_successes(runs) -> None:
    quick, slow = (curve_of(run, draws=40, seed=0) for run in runs)
    assert [one.value for one in quick.shares] == [0.25, 0.25] + [0.75] * 8
    assert [slow.at(q).value for q in (1, 7, 8, 64, 100)] == [0, 0, 0.5, 0.5, 0.5]
    assert quick.mean == pytest.approx(17 / 4)
    for curve in (quick, slow):
        shares = [one.value for one in curve.shares]
        assert shares == sorted(shares)
        assert all(one.low <= one.value <= one.high for one in curve.shares)
    assert quick.at(3).low < 0.75 < quick.at(3).high
    assert quick.to_json()[2] == {
        "name": "quick",
        "queries": 3,
        "share": 0.75,
        "low": quick.at(3).low,
        "high": quick.at(3).high,
    }


def test_queries_of_frames_that_were_never_broken_count_as_none(runs) -> None:
    assert first_successes(runs[0].frames).tolist() == [1, 3, 3, np.inf]


def test_one_arm_against_the_end_of_another(runs) -> None:
    one = against(*(runs[0], 2, runs[1]), draws=60, seed=0)
    assert (one.first, one.second, one.difference) == (0.5, 0.25, -0.25)
    assert one.low <= -0.25 <= one.high
    assert against(runs[0], 3, runs[1], 0, 0).difference == pytest.approx(0.25)


def test_how_many_queries_an_arm_may_take(frame, counted, arm) -> None:
    asked = {"si-fgsm": 7, "fgsm": 1, "halton": 32}
    for method, most in asked.items():
        queries = 32 if method == "halton" else None
        run = counted(arm(method, method=method, steps=7, queries=queries), [frame("0")])
        assert most_queries(run) == most
