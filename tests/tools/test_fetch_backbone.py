"""Reading the backbone: a pickle of arrays and nothing else, under the detector's names."""

import io
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from detectors.squeezedet import SqueezeDet
from tests.tools.loading import tool

backbone = tool("fetch_backbone")


def test_unpickler_admits_numpy_only() -> None:
    arrays = {"conv1": [np.zeros((3, 3, 3, 64), np.float32), np.zeros(64, np.float32)]}
    read = backbone.NumpyUnpickler(io.BytesIO(pickle.dumps(arrays))).load()
    assert np.array_equal(read["conv1"][0], arrays["conv1"][0])
    for evil in (print, Path("x"), np.load):
        with pytest.raises(pickle.UnpicklingError, match="is not admitted"):
            backbone.NumpyUnpickler(io.BytesIO(pickle.dumps(evil))).load()


def test_backbone_names_are_those_of_the_detector() -> None:
    detector = SqueezeDet()
    layers: dict[str, list[np.ndarray]] = {}
    for name, value in detector.state_dict().items():
        if not name.startswith(detector.fresh_layers):
            layer = (
                name.removeprefix("fires.").rsplit(".", 1)[0].replace(".squeeze", ".squeeze1x1").replace(".", "/")
            )
            array = value.numpy()
            layers.setdefault(layer, []).append(array.transpose(2, 3, 1, 0) if array.ndim == 4 else array)
    other = SqueezeDet()
    other.load_backbone(backbone.named(layers))
    for name, value in detector.state_dict().items():
        if not name.startswith(detector.fresh_layers):
            assert torch.equal(other.state_dict()[name], value), name
