"""Random networks fit to be tested."""

from collections.abc import Callable

import pytest
import torch
from torch import nn


@pytest.fixture
def settle() -> Callable[[nn.Module, object], None]:
    """Gives a random network the statistics of what it is fed, and eval mode. With those that it is made with,
    activations fade from layer to layer until gradients are lost in rounding.
    """

    @torch.no_grad()
    def settle(network: nn.Module, fed: object) -> None:
        for norm in (m for m in network.modules() if isinstance(m, nn.BatchNorm2d)):
            norm.momentum = 1.0
            norm.training = True
        network(fed)
        network.eval()

    return settle
