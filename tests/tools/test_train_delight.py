"""Training of the network for the light of a closed sky: its examples, its truth, and how it is judged."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from scene_ir.derender.delight import DelightNet
from scene_ir.render.model import CLOSED_SKY_LOG
from tests.tools.loading import tool

training: Any = tool("train_delight")
SETTINGS = training.DelightSettings(steps=4, batch=2, frames=1)


@pytest.fixture(scope="module")
def pair() -> Any:
    return training.draw_pair(7, 0, "train")


@pytest.fixture(scope="module")
def store(pair: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "draw_pair", lambda seed, index, split: pair)
        return training.PairStore(tmp_path_factory.mktemp("delight"), 1, 7, "train")


def test_a_pair_differs_in_its_light_alone(pair: Any) -> None:
    sunny, clouded = pair
    assert np.array_equal(sunny.semantic, clouded.semantic)
    assert np.array_equal(sunny.depth_m, clouded.depth_m)
    assert np.abs(sunny.image.astype(int) - clouded.image).mean() > 5


def test_a_folder_of_another_stream_is_refused(store: Any, pair: Any, tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "draw_pair", lambda seed, index, split: pair)
        training.PairStore(tmp_path, 1, 7, "train")
    assert store.images.shape == (1, 2, *training.STORE_HW, 3)
    with pytest.raises(ValueError, match="expected frames of"):
        training.PairStore(tmp_path, 1, 8, "train")


def test_a_step_is_a_function_of_seed_and_number(store: Any) -> None:
    first, again, other = (training.build_batch(store, step, SETTINGS) for step in (3, 3, 4))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first[0], other[0])
    assert first[0].shape == first[1].shape
    assert all(m.shape == (2, 1, *first[0].shape[2:]) for m in first[2:])


def test_some_examples_are_under_clouds_already(store: Any) -> None:
    examples = [training.example(store, 0, np.random.default_rng(seed)) for seed in range(40)]
    ratio = [np.abs(e.clouded - e.image).mean() for e in examples]
    few = sum(r < 0.02 for r in ratio)  # noise differs
    assert 2 <= few <= 20


def test_the_truth_costs_least(store: Any) -> None:
    image, clouded, _, sky = training.build_batch(store, 0, SETTINGS)
    true = training.true_log_ratio(image, clouded)
    assert float(true.abs().max()) <= CLOSED_SKY_LOG + 1e-6
    assert float(training.compute_loss(true, true, sky, 0.5)) == 0
    assert float(training.compute_loss(true + 0.1, true, sky, 0.5)) > 0
    # the sky does not count
    assert float(training.compute_loss(true + 0.1, true, torch.ones_like(sky), 0.5)) == 0


def test_judged_against_the_street_under_clouds(pair: Any) -> None:
    network = DelightNet().eval()
    torch.nn.init.zeros_(network.out.weight)
    torch.nn.init.zeros_(network.out.bias)
    metrics = training.judge(network, [pair])
    assert set(metrics) == {"sun", "clouds"}
    before, after = metrics["sun"]
    assert before == pytest.approx(
        after, abs=0.2
    )  # a network without an opinion changes no pixel by more than a code
    assert metrics["clouds"][0] == 80  # the picture itself
    assert training.format_table(metrics).count("\n") == 1 + len(metrics)
