"""Training of a small network: the average, rounding, checkpoints, gradients that are not finite."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from detectors.registry import read_weights
from tests.tools.loading import tool

AveragedRun: Any = tool("averaged").AveragedRun


@dataclass(frozen=True)
class Settings:
    weight_decay: float = 0.0
    average: float = 0.5


class Line(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.slope = nn.Parameter(torch.tensor([1.0]))


def run_of(settings: Settings | None = None) -> Any:
    return AveragedRun(Line(), settings or Settings())


def test_the_average_starts_young_and_then_keeps_its_share() -> None:
    run = run_of()
    expected = 1.0
    for step in range(12):
        run.descend(run.network.slope.square().sum(), 0.1)
        share = min(0.5, (1 + step) / (10 + step))
        expected = share * expected + (1 - share) * run.network.slope.item()
        assert run.average["slope"].item() == pytest.approx(expected, abs=1e-6)
    assert run.step_number == 12
    assert run.averaged().slope.item() == run.average["slope"].half().item()


def test_a_run_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    whole, first, second = run_of(), run_of(), run_of()
    for _ in range(4):
        whole.descend(whole.network.slope.exp().sum(), 0.05)
    for _ in range(2):
        first.descend(first.network.slope.exp().sum(), 0.05)
    first.save(tmp_path / "c.safetensors")
    second.load(tmp_path / "c.safetensors")
    for _ in range(2):
        second.descend(second.network.slope.exp().sum(), 0.05)
    assert torch.equal(whole.network.slope, second.network.slope)
    assert torch.equal(whole.average["slope"], second.average["slope"])
    with pytest.raises(ValueError, match=r"expected settings .*0.9.*, found .*0.5"):
        run_of(replace(Settings(), average=0.9)).load(tmp_path / "c.safetensors")


def test_what_is_shipped_is_the_average(tmp_path: Path) -> None:
    run = run_of()
    run.descend(run.network.slope.sum(), 0.1)
    run.ship(tmp_path / "w.safetensors", {"name": "line"})
    facts, tensors = read_weights(tmp_path / "w.safetensors")
    assert facts == {"name": "line"}
    assert torch.equal(tensors["slope"], run.average["slope"].half())


def test_a_gradient_that_is_not_finite_is_an_error() -> None:
    run = run_of()
    with pytest.raises(FloatingPointError, match="step 0: expected a finite gradient"):
        run.descend((run.network.slope - 1).sqrt().sum(), 0.1)
