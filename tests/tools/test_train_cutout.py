"""Training the network that cuts vehicles out, on a tiny set: what it learns from, and runs that are stopped."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.tools.loading import tool

train = tool("train_cutout")
SETTINGS = train.CutoutSettings(cycles=((2, 3e-3), (1, 1e-3)), batch=2)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return train.CutoutStore(train.make(tmp_path_factory.mktemp("streets"), "train", 5, 2, None))


def test_shares_of_a_pixel_add_up_to_at_most_one(store: Any) -> None:
    for index in range(len(store)):
        layers = store.layers(index).astype(int)
        assert layers[..., 3:6].sum(-1).max() <= 255 + 2
        assert layers[..., 3].max() == 255
        hidden = (layers[..., 7] == 255) & (layers[..., 3] == 0)
        assert (layers[..., 4][hidden] == 255).all()


def test_without_disturbance_the_template_lies_on_the_vehicle(store: Any) -> None:
    scores = []
    for index in range(len(store)):
        if store.cases.visible[index] < 0.9:
            continue
        sample = train.make_sample(store, index, 0.0, None)
        assert sample is not None
        _, said = train.first_inputs([sample])
        cover, visible = said[0, 0].numpy() >= 0.5, sample.truth[..., 0] >= 128
        scores.append(np.count_nonzero(cover & visible) / np.count_nonzero(cover | visible))
    assert np.median(scores) > 0.8


def test_looks_keep_size_and_shares(store: Any) -> None:
    layers = store.layers(0)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        photograph, shares = train.vary_appearance(
            np.ascontiguousarray(layers[..., :3]), layers[..., 3:6].copy(), rng
        )
        assert photograph.shape == (*layers.shape[:2], 3)
        assert photograph.dtype == shares.dtype == np.uint8
        assert (shares.astype(int).sum(-1) <= 255 + 3).all()
        assert (shares[..., 0] <= layers[..., 3]).all()


def test_a_run_that_was_stopped_ends_at_the_same_weights(store: Any, tmp_path: Path) -> None:
    torch.set_num_threads(1)
    whole = train.CutoutRun(SETTINGS)
    for _ in range(SETTINGS.steps):
        terms = whole.step(store)
    assert np.isfinite(list(terms.values())).all()
    first = train.CutoutRun(SETTINGS)
    first.step(store)
    first.save(tmp_path / "c.safetensors")
    second = train.CutoutRun(SETTINGS)
    second.load(tmp_path / "c.safetensors")
    while second.step_number < SETTINGS.steps:
        second.step(store)
    for name, tensor in whole.average.items():
        assert torch.equal(tensor, second.average[name]), name


def test_a_checkpoint_of_other_settings_is_refused(tmp_path: Path) -> None:
    train.CutoutRun(SETTINGS).save(tmp_path / "c.safetensors")
    with pytest.raises(ValueError, match="expected settings"):
        train.CutoutRun(train.CutoutSettings(cycles=((4, 3e-3),), batch=2)).load(tmp_path / "c.safetensors")


def test_streets_are_made_once(store: Any, tmp_path: Path) -> None:
    parts = train.make(tmp_path, "train", 5, 1, None)
    stamp = (parts[0] / "layers.bin").stat().st_mtime_ns
    assert train.make(tmp_path, "train", 5, 1, None) == parts
    assert (parts[0] / "layers.bin").stat().st_mtime_ns == stamp


def test_each_cycle_begins_at_its_rate_and_ends_at_nothing() -> None:
    settings = train.CutoutSettings(cycles=((100, 3e-3), (60, 1e-3)))
    rates = [settings.rate(step) for step in range(160)]
    assert max(rates[50:100]) < 3e-3
    assert rates[99] < 1e-5
    assert rates[100] == 1e-3
    assert rates[159] < 1e-5
