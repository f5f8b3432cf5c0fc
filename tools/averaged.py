"""Training of a small network: AdamW with clipped gradients, an average of the weights, and checkpoints from which
a run goes on to the same bytes.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from detectors.registry import read_weights, write_weights

CLIP = 5.0
"""Largest norm of a step's gradient."""


Network = TypeVar("Network", bound=nn.Module)


class AveragedSettings(Protocol):
    """What every run's settings, a dataclass, hold besides their own."""

    @property
    def weight_decay(self) -> float: ...

    @property
    def average(self) -> float: ...


class AveragedRun(Generic[Network]):
    """A network's weights, their average and the optimiser's state. step_number: steps done; seconds: of the
    processor, spent in `timed` blocks.
    """

    def __init__(self, network: Network, settings: AveragedSettings) -> None:
        """network: in training mode. settings: a dataclass; what a checkpoint must agree with."""
        self.settings, self.network = settings, network
        self.average = {k: v.detach().clone() for k, v in self._tensors().items()}
        self.optimiser = torch.optim.AdamW(network.parameters(), weight_decay=settings.weight_decay)
        self.seconds = 0.0
        self.step_number = 0

    def _tensors(self) -> dict[str, Tensor]:
        return {k: v for k, v in self.network.state_dict().items() if v.is_floating_point()}

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Count what is done inside as training."""
        start = time.process_time()
        yield
        self.seconds += time.process_time() - start

    def descend(self, loss: Tensor, rate: float) -> None:
        """One step of the optimiser against the loss (), and of the average. FloatingPointError where the gradient
        is not finite.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), CLIP)
        if not bool(torch.isfinite(norm)):
            raise FloatingPointError(
                f"step {self.step_number}: expected a finite gradient, found a norm of {float(norm)}"
            )
        self.optimiser.step()
        decay = min(self.settings.average, (1 + self.step_number) / (10 + self.step_number))
        for name, tensor in self._tensors().items():
            self.average[name].lerp_(tensor.detach(), 1 - decay)
        self.step_number += 1

    def averaged(self) -> Network:
        """A network with the averaged weights, rounded as they are shipped, frozen, in eval mode."""
        network = type(self.network)()
        network.load_state_dict({k: v.half().float() for k, v in self.average.items()}, strict=False)
        network.requires_grad_(False)
        return network.eval()

    def ship(self, path: Path, facts: dict[str, str]) -> None:
        """Write the averaged weights as float16, atomically. facts: the file's metadata."""
        write_weights(path, facts, {k: v.half().contiguous() for k, v in self.average.items()})

    def save(self, path: Path) -> None:
        """Write the checkpoint, atomically."""
        tensors = {f"weights.{k}": v.detach().contiguous() for k, v in self._tensors().items()}
        tensors |= {f"average.{k}": v.contiguous() for k, v in self.average.items()}
        for index, state in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{index}.{k}": v.contiguous() for k, v in state.items()}
        facts = {"step": str(self.step_number), "seconds": repr(self.seconds), "settings": self._fingerprint()}
        write_weights(path, facts, tensors)

    def load(self, path: Path) -> None:
        """Go on from a checkpoint. ValueError where it belongs to other settings."""
        facts, tensors = read_weights(path)
        if facts["settings"] != self._fingerprint():
            raise ValueError(f"{path}: expected settings {self._fingerprint()}, found {facts['settings']}")
        state: dict[int, dict[str, Tensor]] = {}
        weights: dict[str, Tensor] = {}
        for key, tensor in tensors.items():
            section, name = key.split(".", 1)
            if section == "weights":
                weights[name] = tensor
            elif section == "average":
                self.average[name].copy_(tensor)
            else:
                index, part = name.split(".", 1)
                state.setdefault(int(index), {})[part] = tensor
        self.network.load_state_dict(weights, strict=False)
        self.optimiser.load_state_dict(self.optimiser.state_dict() | {"state": state})
        self.step_number, self.seconds = int(facts["step"]), float(facts["seconds"])

    def _fingerprint(self) -> str:
        settings: Any = self.settings
        return json.dumps(asdict(settings), sort_keys=True)


def multiscale_error(apart: Tensor, gradient: float) -> Tensor:
    """Mean absolute value () of differences (N, C, h, w), and of their slopes at three scales with a weight."""
    loss = apart.abs().mean()
    for _ in range(3):
        slopes = apart.diff(dim=2).abs().mean() + apart.diff(dim=3).abs().mean()
        loss = loss + gradient * slopes
        apart = avg_pool2d(apart, 2)
    return loss
