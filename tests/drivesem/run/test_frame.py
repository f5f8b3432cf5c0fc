"""An attacked frame releases its cached layers."""

from __future__ import annotations

import weakref
from typing import Any

import pytest
import torch

from detectors.base import Detector
from detectors.incremental.reference import LIMIT_MB, ReferencePass
from detectors.registry import load_detector
from drivesem.config.commands import AttackConfig
from drivesem.run.attack import AttackWorker
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
