"""Medians, and the sharing of seconds between rows."""

import time

import pytest

from drivesem.bench.timing import PairedTimer, Spread, TimeBudget, machine_facts, package_versions, repetitions


def test_median_and_quartiles() -> None:
    spread = Spread.from_values([5.0, 1.0, 2.0, 4.0, 3.0])
    assert (spread.median, spread.q1, spread.q3, spread.iqr) == (3.0, 2.0, 4.0, 2.0)


def test_one_value_has_no_spread() -> None:
    assert Spread.from_values([7.0]).iqr == 0


def test_what_one_row_saves_the_others_may_use() -> None:
    budget = TimeBudget(10.0, 4)
    assert budget.share() == pytest.approx(2.5, abs=0.1)
    assert budget.share() == pytest.approx(10 / 3, abs=0.1)
    assert budget.share(preparation=1.0) == pytest.approx(4.5, abs=0.1)
    assert TimeBudget(-1.0, 3).share() == 0


def test_a_call_that_waits_takes_no_time_of_the_processor() -> None:
    waited = PairedTimer().time_call(lambda: time.sleep(0.05))
    assert waited.ms >= 50
    assert waited.cpu_ms < 25
    worked = PairedTimer().time_call(lambda: sum(range(300_000)))
    assert worked.cpu_ms > 0.5


@pytest.mark.parametrize(("seconds", "count"), [(0.0, 3), (100.0, 7)])
def test_rounds_keep_to_fewest_and_most(seconds: float, count: int) -> None:
    assert list(repetitions(seconds, 3, 7)) == list(range(count))


def test_rounds_end_in_time() -> None:
    start = time.perf_counter()
    for _ in repetitions(0.05, 1, 10_000):
        time.sleep(0.01)
    assert time.perf_counter() - start < 0.5


def test_facts_of_machine_and_versions() -> None:
    facts = machine_facts()
    assert facts["cpu"]
    assert facts["cores"] >= 1
    assert facts["threads"] >= 1
    assert set(package_versions()) == {"python", "torch", "warp", "drivesem"}
