"""Training of the depth network: what it is shown, what it should say, and that a run can be gone on with."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from scene_ir.derender import depth
from scene_ir.derender.depth import DepthNet
from tests.tools.loading import tool

training: Any = tool("train_depth")
SETTINGS = training.DepthSettings(steps=4, batch=2, frames=2)


@pytest.fixture(scope="module")
def streets() -> list[Any]:
    return [training.street(7, index, "train") for index in (0, training.HIGHER_FROM)]


@pytest.fixture(scope="module")
def store(streets: list[Any], tmp_path_factory: pytest.TempPathFactory) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "street", lambda seed, index, split: streets[index])
        return training.DepthStore(tmp_path_factory.mktemp("depth"), 2, 7, "train")


def test_a_frame_is_kept_with_its_actors_and_without(store: Any, streets: list[Any], tmp_path: Path) -> None:
    assert len(store) == 4
    assert store.images.shape == (4, *training.STORE_HW, 3)
    assert (store.nearness[0::2] >= store.nearness[1::2] - 1e-3).mean() > 0.99
    assert (store.nearness[0] > store.nearness[1]).any()
    with pytest.raises(ValueError, match="expected frames of"):
        training.DepthStore(tmp_path_of(store, streets, tmp_path), 1, 8, "train")


def tmp_path_of(store: Any, streets: list[Any], folder: Path) -> Path:
    """A folder with the first frame of another stream."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "street", lambda seed, index, split: streets[index])
        training.DepthStore(folder, 1, 7, "train")
    return folder


def test_nothing_is_farther_than_the_ground(store: Any) -> None:
    for seed in range(6):
        part = training.example(store, seed % 4, np.random.default_rng(seed))
        assert part.image.shape == (*part.nearness.shape, 3)
        assert (part.nearness >= part.ground).all()
        assert (part.ground >= 0).all()
        # the ground begins at the horizon
        assert not (part.ground > 0.02)[part.elevation > 0.02].any()
        assert (part.ground > 0.02)[part.elevation < -0.06].all()


def test_a_step_is_a_function_of_seed_and_number(store: Any) -> None:
    first, again, other = (training.build_batch(store, step, SETTINGS) for step in (3, 3, 4))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first[0], other[0])
    assert first[0].shape[:2] == (2, 3)
    assert all(m.shape == (2, 1, *first[0].shape[2:]) for m in first[1:])


def test_the_truth_costs_least(store: Any) -> None:
    _, _, ground, near = training.build_batch(store, 0, SETTINGS)
    over = F.avg_pool2d(near, 2) - F.avg_pool2d(ground, 2)
    right = torch.log(torch.expm1(over.clamp(min=1e-6))) + 4.0
    assert torch.allclose(depth.nearness_excess(right), over, atol=1e-4)
    least = training.compute_loss(right, ground, near, 0.5)
    assert least < 1e-2
    assert least < training.compute_loss(right + 0.5, ground, near, 0.5)
    assert least < training.compute_loss(right.roll(5, 3), ground, near, 0.5)


def test_judged_beside_walls_by_rule(streets: list[Any]) -> None:
    network = DepthNet().eval()
    metrics = training.judge(network, streets[:1])
    assert set(metrics) == {"walls by rule", "network", "both"}
    assert all(error >= 0 and 0 <= near <= 1 for error, near in metrics.values())
    assert training.format_table(metrics).count("\n") == 1 + len(metrics)
