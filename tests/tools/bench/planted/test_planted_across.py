"""Faults of a whole detector, and what pooled rules say of them, in a made-up world of cars."""

from dataclasses import replace

import numpy as np
import pytest

from detectors.planted import PlantedFault
from tools.bench.planted.across import (
    AS_PHOTOGRAPHED,
    CARS,
    FRAMES,
    HITS,
    KINDS,
    MIN_WIDTH,
    SharedFaultFrame,
    SharedFaultSearch,
    plant_shared_fault,
)
from tools.bench.planted.across_report import (
    ALL,
    FaultRuleRow,
    chance_rows,
    found_rows,
    rule_rows,
    summary_rows,
)
from tools.bench.planted.pool import CarObservation, FramePool

NAMES = ("height_px", "aspect", "across", "lightness", "contrast", "moved_m")
T_STAR = 0.5


def world(frames: int, states: int, seed: int = 0) -> list[FramePool]:
    """Cars that keep their height and place, more or less; paint changes much. Labels are what the detector sees,
    more or less. None is ever lost.
    """
    rng = np.random.default_rng(seed)
    pools = []
    for number in range(frames):
        cars = rng.uniform([25, 1.0, 0.1, 0.2, 0.1], [90, 2.8, 0.9, 0.6, 0.3], (5, 5))

        def seen(index: int, cars: np.ndarray = cars, free: bool = True) -> CarObservation:
            own = cars[index].copy()
            if free:
                own *= rng.uniform(0.9, 1.1, 5)
                own[3:] = rng.uniform([0.05, 0.05], [0.9, 0.4])
            told = own * rng.normal(1, 0.02, 5)
            moved = float(rng.random()) if free else 0.0
            return CarObservation(index, (*own.tolist(), moved), 2.0, ((0.9, *told.tolist()),))

        looks = tuple(tuple(seen(i, free=False) for i in range(5)) for _ in range(4))
        drawn = tuple(tuple(seen(i) for i in range(5)) for _ in range(states))
        pools.append(FramePool(f"{number:03d}", T_STAR, NAMES, looks, drawn))
    return pools


@pytest.fixture(scope="module")
def pools() -> list[FramePool]:
    return world(20, 12)


@pytest.mark.parametrize(
    ("kind", "rarity"), [(KINDS[0], "common"), (KINDS[3], "common"), (KINDS[8], "common"), (KINDS[8], "rare")]
)
def test_faults_hide_few_cars_as_photographed_and_some_others(
    pools: list[FramePool], kind: tuple[str, ...], rarity: str
) -> None:
    one = plant_shared_fault(pools, kind, 0, 0, rarity)
    assert one is not None
    assert one.fault.feature_names == kind
    assert one == plant_shared_fault(pools, kind, 0, 0, rarity)
    assert one != plant_shared_fault(pools, kind, 1, 0, rarity)
    assert one.still <= AS_PHOTOGRAPHED
    assert HITS[rarity][0] <= one.cars <= HITS[rarity][1]
    assert one.hit >= one.cars
    assert 0.4 < one.sharp < 1
    hidden = {
        (pool.frame, car.index)
        for pool in pools
        for state in pool.states
        for car in state
        if car.hidden(one.fault, T_STAR) and car.index not in pool.hidden_as_photographed(one.fault)
    }
    assert len(hidden) >= CARS[rarity]
    assert len({frame for frame, _ in hidden}) >= FRAMES[rarity]


def test_bands_of_rare_faults_are_wider_than_the_detector_s_noise(
    pools: list[FramePool], monkeypatch: pytest.MonkeyPatch
) -> None:
    heights = [
        [car.best_candidates[0][1] for sample in pool.camera_samples for car in sample if car.index == index]
        for pool in pools
        for index in range(5)
    ]
    noise = float(np.sqrt(np.var(heights, axis=1, ddof=1).mean()))

    def narrowest() -> float:
        planted = [plant_shared_fault(pools, ("height_px", "lightness"), seed, 0, "rare") for seed in range(12)]
        bands = [one.fault.bands[0] for one in planted if one is not None]
        assert bands
        return min(band.high - band.low for band in bands)

    wide = 1.5 * narrowest() / noise
    assert wide > MIN_WIDTH["rare"]
    monkeypatch.setitem(MIN_WIDTH, "rare", wide)
    assert narrowest() >= wide * noise


def test_halton_s_states_name_faults(pools: list[FramePool]) -> None:
    """At least two of three, the third in part: a rule may take a second feature along."""
    kinds = (KINDS[0], KINDS[3], KINDS[8])
    planted = [one for kind in kinds if (one := plant_shared_fault(pools, kind, 0)) is not None]
    rows = [row for row in rule_rows(planted, pools, [], ()) if row.by == ALL]
    *faults, none = rows
    assert sum(row.named for row in faults) >= 2
    for row, kind in zip(faults, kinds, strict=True):
        assert row.in_part
        assert all(name in row.rules[0] for name in kind)
        assert row.passes == 20 * 12
    assert (none.rules, none.named, none.failures) == ((), False, 0)


def test_chance_has_no_name(pools: list[FramePool]) -> None:
    rows = chance_rows(pools, 0, shams=6)
    assert [row["faults"] for row in rows] == [6, 6]
    assert sum(row["with_rule"] for row in rows) <= 1


def test_rows_are_summed_by_what_named_them() -> None:
    fault = PlantedFault.parse("height_px=30:40")
    one = FaultRuleRow(fault.text, "climb", 0.2, 0.1, 0.0, 0.5, 9, 4, 300, ("a", "b"), True, True, 1)
    blunt = replace(one, named=False, rules=(), further=0, passes=100, sharp=0.1)
    planted, sharp, none = summary_rows([one, blunt, replace(one, fault="", sharp=None, further=2)])
    assert (sharp["by"], sharp["faults"], sharp["named"]) == ("climb, sharp faults", 1, 1)
    assert (planted["faults"], planted["named"], planted["in_part"], planted["with_rule"]) == (2, 1, 2, 1)
    assert planted["low"] < 0.5 < planted["high"]
    assert (planted["further"], planted["passes"]) == (1, 200)
    assert (none["by"], none["named"], none["with_rule"], none["further"]) == ("climb, no fault", None, 1, 2)
    assert one.to_json()["rule"] == "a"


def search_of(fault: str, method: str, found: int) -> SharedFaultSearch:
    return SharedFaultSearch("", fault, method, found + 1, found, 50, ())


def test_cars_lost_by_faults_are_counted_by_method_with_paired_differences() -> None:
    frames = [
        SharedFaultFrame(
            str(number),
            "",
            tuple(
                search_of(fault, m, found) for fault in ("a", "b", "") for m, found in (("climb", 1), ("learn", 3))
            ),
        )
        for number in range(4)
    ]
    climb, learn = found_rows(frames, ("climb", "learn"), 0)
    assert (climb["found"], learn["found"], climb["certain"]) == (8, 24, 16)
    assert (climb["faults"], climb["faults_found"]) == (2, 2)
    assert (climb["per_1000"], learn["per_1000"]) == (20, 60)
    assert [learn[name] for name in ("difference", "difference_low", "difference_high")] == [40, 40, 40]
