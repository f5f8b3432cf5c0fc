"""An attacked frame releases its cached layers; the rate of frames that sampled states."""

from __future__ import annotations

import weakref
from dataclasses import replace
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
from drivesem.run.frame import estimate_photographed_rate, estimate_rate, write_frame
from drivesem.run.results import PhotographedRate, RunSummary
from drivesem.run.search_memory import MARGINS, Experience
from drivesem.scenes.sources import NoVehicleError
from drivesem.synth.demo import demo_scene


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
        assert len(Experience.read(tmp_path / "demo-000" / MARGINS).rows) > 20


def test_a_frame_is_searched_with_what_earlier_frames_of_its_run_know(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    models: list[MarginModel | None] = []

    def stop(worker: AttackWorker, identifier: str, scene: object) -> None:
        assert isinstance(worker.method, Learn)
        models.append(worker.method.knowledge.model if worker.method.knowledge else None)
        raise NoVehicleError("frame", "a vehicle", "none")

    monkeypatch.setattr(AttackWorker, "attack_scene", stop)
    worker = AttackWorker.from_config(
        AttackConfig(params="translate", method="learn"), load_detector("squeezedet")
    )
    for number in range(5):
        assert not worker.attack_frame("demo-000", tmp_path)
        folder = tmp_path / "frames" / f"{number:03}"
        folder.mkdir(parents=True)
        rows = np.random.default_rng(number).random((60, 7)).astype(np.float32)
        replace(Experience.empty(), rows=rows).write(folder / MARGINS)
    assert [model is None for model in models] == [True, True, True, True, False]


def test_frames_with_the_same_objects_draw_different_states() -> None:
    config = AttackConfig(params="translate", method="random", queries=2, grade=False)
    worker = AttackWorker.from_config(config, load_detector("squeezedet"))
    scene = demo_scene(0, 0)
    one, again, other = (worker.attack_scene(name, scene).search for name in ("a", "a", "b"))
    assert one.seed == again.seed != other.seed
    assert torch.equal(one.theta, again.theta)
    assert not torch.equal(one.theta, other.theta)


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
    share, weighted = ClusteredShare(10, 31, 2, 10 / 31, 2e-8, 1.0), PhotographedRate(0.125, 0.1, 0.2, 0.96)
    summary: Any = SimpleNamespace(rate=share, rate_as_photographed=None, noun="object")
    text = RunSummary.describe_rate(summary)
    assert text == "rate: 10 of 31 objects in random states of 2 frames missed (32.3 % [0, 100])"
    summary.rate_as_photographed = weighted
    assert RunSummary.describe_rate(summary) == (
        f"{text}; 12.5 % [10, 20] with size, contrast, place and light distributed as photographed "
        "(96 % of the objects are in cells that such states met)"
    )


def cells_of(*visits: tuple[int, int, int, bool], found: bool = True) -> Any:
    """A frame with one object, and its visits: height level, random states, misses in them, photographed there."""
    counts = [
        CellVisit(0, (level, 0, 0, 0), n + 5, m + 4, random=n, random_misses=m, photographed=there)
        for level, n, m, there in visits
    ]
    return SimpleNamespace(found_before=(0,) if found else (), visits=tuple(counts))


def test_a_rate_weighted_to_the_photographs_counts_cells_as_they_occur_there() -> None:
    frames = [
        cells_of((0, 12, 6, False), (1, 4, 0, True)),
        cells_of((0, 12, 6, True), (1, 4, 2, False)),
        cells_of((1, 8, 2, True)),
        cells_of((0, 16, 16, True), found=False),
        cells_of((2, 0, 0, True)),
    ]
    rate = estimate_photographed_rate(frames)
    assert rate is not None
    # A third of the covered objects are small as photographed, of which half is missed; 4 of 16 of the others are.
    assert rate.value == pytest.approx(0.5 / 3 + 0.25 * 2 / 3)
    assert rate.covered == 0.75
    assert rate.low < rate.value < rate.high
    assert estimate_photographed_rate([cells_of((0, 12, 6, False))] * 3) is None


def test_the_interval_of_a_weighted_rate_holds_it_in_as_many_runs_as_it_should() -> None:
    rng, held, truth = np.random.default_rng(0), 0, 0.2 * 0.3 + 0.8 * 0.1
    for _ in range(200):
        frames: list[Any] = []
        for _ in range(60):
            draws = rng.multinomial(32, [0.7, 0.3])  # random states are mostly in the cell that is rare on roads
            chances = rng.beta([1.2, 0.4], [2.8, 3.6])  # 0.3 and 0.1 in the mean
            misses, small = rng.binomial(draws, chances), rng.random() < 0.2
            rows = zip((0, 1), draws.tolist(), misses.tolist(), (small, not small), strict=True)
            frames.append(cells_of(*rows))
        rate = estimate_photographed_rate(frames)
        assert rate is not None
        held += rate.low <= truth <= rate.high
    assert 0.91 <= held / 200 <= 0.99


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
