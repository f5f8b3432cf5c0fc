"""Checks that several tests of the renderer share."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor


@pytest.fixture
def check_code_gradient() -> Callable[[Callable[[Tensor], Tensor], Tensor], None]:
    """Compare the gradient of a random sum of `function(code)` with central differences; no component is 0."""

    def check(function: Callable[[Tensor], Tensor], code: Tensor) -> None:
        shape = function(code).shape
        weights = torch.randn(shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
        leaf = code.clone().requires_grad_()
        (analytic,) = torch.autograd.grad((function(leaf) * weights).sum(), leaf)
        with torch.no_grad():
            steps = torch.eye(len(code), dtype=torch.float64) * 1e-5
            ends = [[(function(code + s) * weights).sum() for s in (step, -step)] for step in steps]
        numeric = torch.tensor([float(high - low) / 2e-5 for high, low in ends], dtype=torch.float64)
        assert bool((analytic.abs() > 1e-3).all())
        torch.testing.assert_close(analytic, numeric, rtol=1e-4, atol=1e-6)

    return check
