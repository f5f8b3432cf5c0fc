"""Faults that are planted for a frame: clear of what is photographed, within reach, and as rare as was asked."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from detectors.planted import FEATURES, PlantedFault
from drivesem.bench.planted.plant import HITS, KINDS, FaultKind, plant
from drivesem.bench.planted.survey import FeaturesOf, Seen, Survey


def survey(seed: int = 0, cars: int = 3, sure: bool = True) -> Survey:
    """Cars that theta moves to either side of where they are: evenly in Halton's draws, farther in corners."""
    generator = torch.Generator().manual_seed(seed)
    shape = (len(FEATURES), cars)
    benign = 1 + torch.rand(shape, generator=generator)
    halton = benign + 0.3 * (2 * torch.rand(128, *shape, generator=generator) - 1)
    corners = benign + 0.45 * torch.where(torch.rand(48, *shape, generator=generator) < 0.5, -1.0, 1.0)
    judged, slack = torch.ones(cars, dtype=torch.bool), torch.full(shape, 0.02)
    seen = Seen(judged, judged & sure, torch.ones(shape), torch.zeros(shape), slack, slack)
    return Survey(FeaturesOf.__new__(FeaturesOf), seen, benign, halton, corners)


def test_the_yardstick_has_easy_and_rare_faults_of_every_feature() -> None:
    assert len(KINDS) == len(set(KINDS)) >= 12
    assert {name for kind in KINDS for name in kind.features} == set(FEATURES)
    for rarity in HITS:
        assert sum(kind.rarity == rarity for kind in KINDS) >= 6


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10_000), kind=st.sampled_from(KINDS))
def test_what_is_planted_keeps_its_promises(seed: int, kind: FaultKind) -> None:
    frame = survey(seed)
    made = plant(frame, kind, seed)
    if made is None:  # a single feature may have no rare part that theta reaches well
        assert (kind.rarity, len(kind.features)) == ("rare", 1)
        return
    assert made.fault.names == kind.features
    least, most = HITS[kind.rarity]
    assert least <= made.hit <= most
    assert made.hit == pytest.approx(frame.rarity(made.fault), abs=0.01)  # bands are float64, features float32
    rows = [FEATURES.index(name) for name in kind.features]
    clear = torch.zeros(frame.benign.shape[1], dtype=torch.bool)
    for row, band in zip(rows, made.fault.bands, strict=True):
        clear |= (frame.benign[row] < band.low - 0.02) | (frame.benign[row] > band.high + 0.02)
    assert clear.all()
    reached = torch.cat([frame.halton, frame.corners])[:, rows].transpose(0, 1)
    assert made.fault.contains(reached).any()


def test_equal_arguments_give_equal_faults() -> None:
    frame, kind = survey(), KINDS[0]
    assert plant(frame, kind, 3) == plant(frame, kind, 3)
    assert plant(frame, kind, 3) != plant(frame, kind, 4)
    assert PlantedFault.of(plant(frame, kind, 3).fault.text) == plant(frame, kind, 3).fault  # type: ignore[union-attr]


def test_nothing_is_planted_where_no_car_is_sure_or_can_be_moved() -> None:
    assert plant(survey(sure=False), KINDS[0], 0) is None
    still = survey()
    held = Survey(
        still.of, still.seen, still.benign, 0 * still.halton + still.benign, 0 * still.corners + still.benign
    )
    assert plant(held, KINDS[0], 0) is None


def test_a_rare_fault_lies_where_only_corners_lead() -> None:
    """One feature, evenly drawn: a rare band reaches beyond all draws, which end 0.3 from where the car is."""
    frame = survey(cars=1)
    made = plant(frame, FaultKind(("aspect",), "rare"), 0)
    assert made is not None
    (band,) = made.fault.bands
    aspect = float(frame.benign[FEATURES.index("aspect"), 0])
    assert max(abs(band.low - aspect), abs(band.high - aspect)) > 0.45
