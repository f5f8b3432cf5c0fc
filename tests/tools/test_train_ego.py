"""Training of the ego vehicle's network: what is drawn, and that a step is reproducible."""

from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from tests.tools.loading import tool

training: Any = tool("train_ego")
SETTINGS = training.EgoSettings(steps=4, batch=4, frames=2)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return training.SegmentStore(tmp_path_factory.mktemp("ego"), 2, 7, "train", training.street)


def drawn(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A grey ramp before and after drawing, and the coverage."""
    before = np.repeat(np.linspace(0.9, 0.3, 112, dtype=np.float32)[:, None, None], 224, 1).repeat(3, 2)
    after = before.copy()
    return before, after, training.draw_ego(after, np.random.default_rng(seed))


def test_only_the_covered_pixels_change() -> None:
    for seed in range(30):
        before, after, coverage = drawn(seed)
        assert coverage.shape == (112, 224)
        assert 0 <= coverage.min() <= coverage.max() <= 1
        # a gap or a lit edge may lie one pixel above the outline
        far = np.asarray(F.max_pool2d(torch.from_numpy(coverage)[None], 5, 1, 2)[0]) == 0
        assert np.array_equal(before[far], after[far])
        assert np.isfinite(after).all()


def test_shapes_differ_and_reach_the_border() -> None:
    shares, bottoms = [], 0
    for seed in range(60):
        coverage = drawn(seed)[2] > 0.5
        border = np.concatenate([coverage[0], coverage[-1], coverage[:, 0], coverage[:, -1]])
        assert border.any(), seed
        bottoms += bool(coverage[-1].mean() > 0.9)
        shares.append(coverage.mean())
    assert bottoms > 40
    assert np.percentile(shares, 10) < 0.08 < 0.15 < np.percentile(shares, 90) < 0.6


def test_a_step_is_a_function_of_seed_and_number(store: Any) -> None:
    first, again, other = (training.build_batch(store, step, SETTINGS) for step in (3, 3, 4))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first[0], other[0])
    images, shares = first
    assert images.shape == (4, 3, *training.INPUT_HW)
    assert shares.shape == (4, *training.INPUT_HW)
    assert 0 <= float(images.min()) <= float(images.max()) <= 1


def test_about_half_of_the_pictures_show_one(store: Any) -> None:
    settings = training.EgoSettings(batch=32)
    shown = (training.build_batch(store, 0, settings)[1].amax((1, 2)) > 0).float().mean()
    assert 0.25 < float(shown) < 0.75


def test_the_truth_costs_least(store: Any) -> None:
    shares = training.build_batch(store, 0, SETTINGS)[1]
    truth = torch.logit(F.avg_pool2d(shares[:, None], 2), 1e-3)
    assert training.compute_loss(truth, shares) < training.compute_loss(-truth, shares)
    assert training.compute_loss(truth, shares) < training.compute_loss(torch.zeros_like(truth), shares)


def test_training_lowers_the_loss_and_is_judged(store: Any) -> None:
    run = training.EgoRun(training.EgoSettings(steps=12, batch=4))
    losses = [run.step(store) for _ in range(12)]
    assert np.mean(losses[-4:]) < np.mean(losses[:4])
    metrics = training.judge(run.averaged(), store, 4)
    assert set(metrics) == {"iou", "median_iou", "missed", "false"}
    assert all(0 <= value <= 1 for value in metrics.values())
