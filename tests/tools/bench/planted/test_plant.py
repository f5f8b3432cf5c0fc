"""Faults that are planted for a frame: clear of what is photographed, within reach, and as rare as was asked."""

from collections.abc import Iterator

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from detectors.planted import FEATURES, PlantedFault
from tools.bench.planted import plant as planting
from tools.bench.planted.plant import HITS, KINDS, FaultKind, plant
from tools.bench.planted.survey import FeatureObservation, FrameSurvey, ObservedFrame

SLACK = 0.02
"""How far features differ between draws of the camera."""


@pytest.fixture(autouse=True, scope="module")
def _few_trials() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planting, "_TRIALS", 1200)
        yield


def seen(values: torch.Tensor) -> FeatureObservation:
    """Each car by one prediction; values (F, N)."""
    count = values.shape[1]
    scores = torch.full((count,), 0.9)
    return FeatureObservation(
        values, torch.arange(count), scores, torch.eye(count, dtype=torch.bool), values - 0.1, 0.5
    )


def survey(seed: int = 0, cars: int = 3, sure: bool = True, reach: float = 0.3) -> FrameSurvey:
    """Cars that theta moves to either side of where they are: evenly in Halton's draws, farther in corners."""
    generator = torch.Generator().manual_seed(seed)
    shape = (len(FEATURES), cars)
    benign = 1 + torch.rand(shape, generator=generator)
    halton = benign + reach * (2 * torch.rand(128, *shape, generator=generator) - 1)
    corners = benign + 1.5 * reach * torch.where(torch.rand(48, *shape, generator=generator) < 0.5, -1.0, 1.0)
    looks = benign + SLACK * (2 * torch.rand(8, *shape, generator=generator) - 1)
    frame = ObservedFrame.__new__(ObservedFrame)
    frame.judged = torch.ones(cars, dtype=torch.bool)
    return FrameSurvey(
        frame=frame,
        camera_samples=tuple(map(seen, looks)),
        halton=tuple(map(seen, halton)),
        corners=tuple(map(seen, corners)),
        benign=benign,
        farthest=torch.full(shape, SLACK),
        mostly=torch.full(shape, SLACK),
        sure=frame.judged & sure,
        factor=torch.ones(shape),
        shift=torch.zeros(shape),
    )


def test_a_sighting_tells_what_a_fault_hides() -> None:
    """Two predictions of the first car, of which the fault hides one; the second car is not found at all."""
    values = torch.zeros(len(FEATURES), 2)
    values[FEATURES.index("aspect")] = torch.tensor([1.5, 3.0])
    meets = torch.tensor([[True, True], [False, False]])
    sighting = FeatureObservation(values, torch.tensor([0, 1]), torch.tensor([0.9, 0.8]), meets, values, 0.5)
    assert sighting.single.tolist() == [False, False]
    assert sighting.main[FEATURES.index("aspect"), 0] == 1.5
    assert sighting.main[:, 1].isnan().all()
    assert sighting.lost(PlantedFault.parse("aspect=1:2")).tolist() == [False, False]
    assert sighting.lost(PlantedFault.parse("aspect=1:4")).tolist() == [True, False]


def test_the_yardstick_has_easy_and_rare_faults_of_every_feature() -> None:
    assert len(KINDS) == len(set(KINDS)) >= 12
    assert {name for kind in KINDS for name in kind.features} == set(FEATURES)
    for rarity in HITS:
        assert sum(kind.rarity == rarity for kind in KINDS) >= 6


@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 10_000), kind=st.sampled_from(KINDS))
def test_what_is_planted_keeps_its_promises(seed: int, kind: FaultKind) -> None:
    frame = survey(seed)
    made = plant(frame, kind, seed)
    if made is None:  # what is rare may be out of the reach of so few trials
        assert kind.rarity == "rare"
        return
    assert made.fault.feature_names == kind.features
    least, most = HITS[kind.rarity]
    assert least <= made.hit <= most
    assert made.hit == frame.rarity(made.fault)
    assert not any(look.lost(made.fault).any() for look in frame.camera_samples)
    assert any(state.lost(made.fault).any() for state in (*frame.halton, *frame.corners))


def test_equal_arguments_give_equal_faults() -> None:
    frame, kind = survey(), KINDS[0]
    made = plant(frame, kind, 3)
    assert made is not None
    assert made == plant(frame, kind, 3)
    assert made != plant(frame, kind, 4)
    assert PlantedFault.parse(made.fault.text) == made.fault


def test_every_kind_can_be_planted() -> None:
    assert all(plant(survey(0), kind, 0) is not None for kind in KINDS)
