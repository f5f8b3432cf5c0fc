"""VGG-16's convolutions from elsewhere: torchvision's names, the same numbers from differently prepared pixels."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from drivesem.classify.networks.architectures import IMAGENET_MEAN, IMAGENET_STD, PooledVGG16
from tests.tools.loading import tool

vgg16 = tool("fetch_vgg16")
BGR_MEAN = (103.939, 116.779, 123.68)


def layers() -> list[tuple[np.ndarray, np.ndarray]]:
    rng, before, found = np.random.default_rng(0), 3, []
    for after in vgg16.SHAPES:
        found.append((rng.normal(0, 0.01, (3, 3, before, after)).astype(np.float32), np.zeros(after, np.float32)))
        before = after
    return found


def test_names_and_shapes_are_those_of_the_network() -> None:
    network, tensors = PooledVGG16(("a", "b")), vgg16.named(layers())
    own = {k: v.shape for k, v in network.state_dict().items() if k.startswith("features.")}
    assert {name: tensor.shape for name, tensor in tensors.items()} == own


def test_the_first_layer_sees_the_same_in_pixels_that_are_prepared_as_torchvision_does() -> None:
    given = layers()
    tensors = vgg16.named(given)
    images = torch.rand(1, 3, 9, 9, generator=torch.Generator().manual_seed(0))
    theirs = 255 * images.flip(1) - torch.tensor(BGR_MEAN).view(3, 1, 1)
    ours = (images - torch.tensor(IMAGENET_MEAN).view(3, 1, 1)) / torch.tensor(IMAGENET_STD).view(3, 1, 1)
    kernel = torch.from_numpy(given[0][0].transpose(3, 2, 0, 1).copy())
    torch.testing.assert_close(
        F.conv2d(ours, tensors["features.0.weight"], tensors["features.0.bias"]),
        F.conv2d(theirs, kernel),
        atol=1e-3,
        rtol=1e-3,
    )


def test_layers_in_their_order() -> None:
    names = ["block2/layers/conv2d", "block1/layers/conv2d_1", "block1/layers/conv2d_10", "block1/layers/conv2d"]
    assert sorted(names, key=vgg16.natural) == [names[3], names[1], names[2], names[0]]


def test_other_layers() -> None:
    with pytest.raises(ValueError, match="expected thirteen layers"):
        vgg16.named(layers()[1:])
