"""An attacked frame releases its cached layers; the rate of frames that sampled states."""

from __future__ import annotations

import weakref
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from detectors.base import Detector
from detectors.incremental.reference import LIMIT_MB, ReferencePass
from detectors.registry import load_detector
from drivesem.config.commands import AttackConfig
from drivesem.failures.feature_cells import CellVisit
from drivesem.run.attack import AttackWorker
from drivesem.run.frame import estimate_rate
from drivesem.synth.demo import demo_scene


@pytest.mark.parametrize("options", [{"method": "climb", "passes": 40}, {"method": "random", "queries": 4}])
def test_layers_are_released_after_a_frame(options: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[weakref.ref[ReferencePass]] = []
    megabytes: list[float] = []
    original_run = ReferencePass.run

    def noted(detector: Detector, image: torch.Tensor, limit_mb: float = LIMIT_MB) -> ReferencePass | None:
        reference = original_run(detector, image, limit_mb)
        assert reference is not None
        made.append(weakref.ref(reference))
        megabytes.append(sum(r.bytes for one in made if (r := one()) is not None) / 1e6)
        return reference

    monkeypatch.setattr(ReferencePass, "run", noted)
    config = AttackConfig(params="translate", grade=False, seed=0, keep_mb=200, **options)
    worker = AttackWorker.from_config(config, load_detector("squeezedet"))
    attacked = worker.attack_scene("demo-000", demo_scene(0, 0))
    assert made
    assert 0 < max(megabytes) <= 200
    assert [one() for one in made] == [None] * len(made)
    assert attacked.objective.reference_mb == 0


def sampled(found: tuple[int, ...], *visits: tuple[int, int, int], attacked: bool = True) -> Any:
    """A frame, and its visits as object, passes and misses; all in one cell."""
    return SimpleNamespace(
        attacked=attacked,
        found_before=found,
        visits=tuple(CellVisit(index, (0, 0, 0, 0), passes, misses) for index, passes, misses in visits),
    )


def test_a_rate_leaves_out_photographed_states_and_objects_missed_there() -> None:
    frames = [
        sampled((0, 2), (0, 9, 1), (1, 1, 1), (2, 4, 0), (2, 5, 3)),  # 8 states, and the photograph
        sampled((0,), (0, 9, 0)),
        sampled((0,), (0, 9, 8), attacked=False),
    ]
    rate = estimate_rate(frames)
    assert rate is not None
    assert (rate.failing, rate.draws, rate.frames) == (4, 24, 2)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"method": "random"}, True),
        ({"method": "halton", "queries": 4}, True),
        ({"method": "random", "early_stop": True}, False),
        ({"method": "random", "range": "steps"}, False),
        ({"method": "cma-es"}, False),
        ({}, False),
    ],
)
def test_only_states_that_no_score_influences_give_a_rate(settings: dict[str, Any], expected: bool) -> None:
    assert AttackConfig(**settings).samples_states is expected
