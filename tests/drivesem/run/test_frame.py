"""One frame: what is left of it in memory when it ends."""

from __future__ import annotations

import weakref

import pytest
import torch

from detectors.base import Detector
from detectors.incremental.reference import LIMIT_MB, Reference
from detectors.registry import load_detector
from drivesem.attack.methods.base import Attack
from drivesem.attack.methods.climb import Climb
from drivesem.attack.methods.sampling import Sampling
from drivesem.attack.space import Parameter
from drivesem.run.frame import FrameSettings, attack_scene
from drivesem.synth.demo import demo_scene
from scene_ir.render.prepare import RenderSettings


@pytest.mark.parametrize("method", [Climb(40), Sampling(4)])
def test_no_layers_are_kept_when_a_frame_ends(method: Attack, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[weakref.ref[Reference]] = []
    megabytes: list[float] = []
    of = Reference.of

    def noted(detector: Detector, image: torch.Tensor, limit_mb: float = LIMIT_MB) -> Reference | None:
        reference = of(detector, image, limit_mb)
        assert reference is not None
        made.append(weakref.ref(reference))
        megabytes.append(sum(r.bytes for one in made if (r := one()) is not None) / 1e6)
        return reference

    monkeypatch.setattr(Reference, "of", noted)
    settings = FrameSettings(
        method, (Parameter.TRANSLATE,), "moved", "objectness", RenderSettings(), seed=0, keep_mb=200
    )
    attacked = attack_scene("demo-000", demo_scene(0, 0), load_detector("squeezedet"), settings)
    assert made
    assert 0 < max(megabytes) <= 200
    assert [one() for one in made] == [None] * len(made)
    assert attacked.objective.kept_mb == 0
