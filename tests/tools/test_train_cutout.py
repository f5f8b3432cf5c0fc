"""Training the network that cuts vehicles out, on a tiny set: what it learns from, and runs that are stopped."""

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


def test_streets_are_made_once(store: Any, tmp_path: Path) -> None:
    parts = train.make(tmp_path, "train", 5, 1, None)
    stamp = (parts[0] / "layers.bin").stat().st_mtime_ns
    assert train.make(tmp_path, "train", 5, 1, None) == parts
    assert (parts[0] / "layers.bin").stat().st_mtime_ns == stamp
