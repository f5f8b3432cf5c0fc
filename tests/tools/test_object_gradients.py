"""Whose doing it is that a gradient falls short: the network's, or the renderer's."""

import pytest
import torch

from tools.object_gradients import PictureScore, cosines

DIRECTIONS = torch.eye(2)
NOISE = torch.ones(3, 1, 1, dtype=torch.float64)


def smooth(theta):
    return torch.cat([theta, theta.sum(dim=0, keepdim=True)]).reshape(3, 1, 1)


def jumping(theta):
    """Its first number jumps at 0, which no gradient tells."""
    return smooth(theta) + torch.tensor([5e-3, 0, 0]).reshape(3, 1, 1) * (theta[0].detach() > 0)


def linear(picture):
    return (picture.reshape(-1) * torch.tensor([1.0, -2.0, 0.5])).sum()


def bent(picture):
    """Another slope from just behind the middle on."""
    return linear(picture) + 8 * (picture[0, 0, 0] - 1e-5).clamp_min(0)


@pytest.mark.parametrize(
    ("picture", "score", "network", "renderer"),
    [(smooth, linear, True, True), (smooth, bent, False, True), (jumping, linear, True, False)],
)
def test_what_falls_short_is_told_apart(picture, score, network, renderer):
    found = cosines(PictureScore(picture, score, NOISE), DIRECTIONS, 1e-3, 4)
    assert (float(found[4]) > 0.999) == network
    assert (float(found[5]) > 0.999) == renderer
    assert (float(found[2]) > 0.999) == (network and renderer)
