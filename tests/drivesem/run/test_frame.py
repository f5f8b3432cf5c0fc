"""An attacked frame releases its cached layers; the rate of frames that sampled states."""

from __future__ import annotations

import weakref
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from detectors.base import Detector
from detectors.incremental.reference import LIMIT_MB, ReferencePass
from detectors.registry import load_detector
from drivesem.attacks.methods.learned import Learn, MarginModel
from drivesem.config.commands import AttackConfig
from drivesem.evaluation.resampling import ClusteredShare
from drivesem.failures.feature_cells import CellVisit
from drivesem.run.attack import AttackWorker
from drivesem.run.frame import estimate_rate, write_frame
from drivesem.run.results import RunSummary
from drivesem.run.search_memory import MARGINS, read_margin_rows
from drivesem.scenes.sources import NoVehicleError
from drivesem.synth.demo import demo_scene
from scene_ir import files


@pytest.mark.parametrize("options", [{"method": "learn", "passes": 40}, {"method": "random", "queries": 4}])
def test_layers_are_released_after_a_frame(
    options: dict[str, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
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
    write_frame(attacked, tmp_path / "demo-000")
    learns = options["method"] == "learn"
    assert (tmp_path / "demo-000" / MARGINS).is_file() is learns
    if learns:
        assert len(read_margin_rows(tmp_path / "demo-000" / MARGINS)) > 20


def test_a_frame_is_searched_with_what_earlier_frames_of_its_run_know(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    models: list[MarginModel | None] = []

    def stop(worker: AttackWorker, identifier: str, scene: object) -> None:
        assert isinstance(worker.method, Learn)
        models.append(worker.method.model)
        raise NoVehicleError("frame", "a vehicle", "none")

    monkeypatch.setattr(AttackWorker, "attack_scene", stop)
    worker = AttackWorker.from_config(
        AttackConfig(params="translate", method="learn"), load_detector("squeezedet")
    )
    for number in range(5):
        assert not worker.attack_frame("demo-000", tmp_path)
        folder = tmp_path / "frames" / f"{number:03}"
        folder.mkdir(parents=True)
        files.write_npz(
            folder / MARGINS, {"rows": np.random.default_rng(number).random((60, 7)).astype(np.float32)}
        )
    assert [model is None for model in models] == [True, True, True, True, False]


def sampled(found: tuple[int, ...], *visits: tuple[int, int, int]) -> Any:
    """A frame, and its visits as object, random states and misses in them, with others; all in one cell."""
    counts = [CellVisit(index, (0, 0, 0, 0), n + 5, m + 4, random=n, random_misses=m) for index, n, m in visits]
    return SimpleNamespace(found_before=found, visits=tuple(counts))


def test_a_rate_leaves_out_searched_states_and_objects_missed_before() -> None:
    frames = [
        sampled((0, 2), (0, 8, 1), (1, 8, 8), (2, 4, 0), (2, 4, 3)),
        sampled((0,), (0, 8, 0)),
        sampled((0,), (0, 0, 0)),
    ]
    rate = estimate_rate(frames)
    assert rate is not None
    assert (rate.failing, rate.draws, rate.frames) == (4, 24, 2)


def test_a_rate_is_printed_without_exponents() -> None:
    summary: Any = SimpleNamespace(rate=ClusteredShare(10, 31, 2, 10 / 31, 2.4e-59, 1.0), noun="object")
    text = RunSummary.describe_rate(summary)
    assert text == "rate: 10 of 31 objects in random states of 2 frames missed (32.3 % [0, 100])"


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
