"""Training of a small network: AdamW with clipped gradients, an average of the weights, checkpoints from which a run
goes on to the same bytes, and the command line, the stored frames and the model card of those that see whole streets.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from detectors.registry import read_weights, write_weights
from drivesem.synth.frames import GENERATOR_VERSION
from scene_ir import files

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


def autocast() -> torch.autocast:
    """Passes in bfloat16 where the processor computes in it; elsewhere it is several times slower than float32."""
    return torch.autocast("cpu", torch.bfloat16, enabled=torch.cpu._is_avx512_bf16_supported())


@dataclass(frozen=True)
class StreetSettings:
    """What decides on the result of a run on whole streets."""

    steps: int = 2000
    """Steps of the optimiser."""
    batch: int = 8
    """Crops in a step."""
    frames: int = 360
    """Frames of the training set."""
    rate: float = 2e-3
    """Highest learning rate."""
    weight_decay: float = 0.02
    """AdamW's weight decay."""
    average: float = 0.995
    """Share of the averaged weights that a step keeps."""
    seed: int = 0
    """Seed of the weights, the crops and their order."""

    def frame_index(self, step: int, place: int, count: int) -> int:
        """Which of `count` pictures is at a place of a step's batch: each once in an epoch, in random order."""
        epoch, inside = divmod(step * self.batch + place, count)
        return int(np.random.default_rng([self.seed, 1_000_000 + epoch]).permutation(count)[inside])


Settings = TypeVar("Settings", bound=StreetSettings)


class StreetRun(AveragedRun[Network], ABC):
    """A network in training on whole streets."""

    settings: StreetSettings

    def __init__(self, network: Network, settings: StreetSettings) -> None:
        super().__init__(network, settings)
        self.network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    @abstractmethod
    def compute_loss(self, store: Any) -> Tensor:
        """The loss () of the next step."""

    def step(self, store: Any) -> float:
        """One step of the optimiser, the rate warmed up and falling as a cosine; the loss."""
        step, settings = self.step_number, self.settings
        with self.timed():
            loss = self.compute_loss(store)
            warm = min(1.0, (step + 1) / 50)
            self.descend(loss, settings.rate * warm * 0.5 * (1 + math.cos(math.pi * step / settings.steps)))
        return float(loss.detach())

    def train(self, store: Any, folder: Path, pause_after: int | None) -> bool:
        """Train from the checkpoint in `folder` on; return whether all steps are done. pause_after: steps of this
        call, None for all.
        """
        checkpoint, steps = folder / "checkpoint.safetensors", self.settings.steps
        print(f"{len(store)} pictures", flush=True)
        if checkpoint.is_file():
            self.load(checkpoint)
            print(f"going on from step {self.step_number}", flush=True)
        end = min(steps, self.step_number + (pause_after or steps))
        with (folder / "log.csv").open("a", newline="") as file:
            log = csv.writer(file)
            while self.step_number < end:
                loss = self.step(store)
                if self.step_number % 25 == 0:
                    log.writerow([self.step_number, f"{self.seconds:.1f}", f"{loss:.4f}"])
                    file.flush()
                if self.step_number % 100 == 0 or self.step_number == end:
                    self.save(checkpoint)
                    print(f"step {self.step_number}, {self.seconds:.0f} s: {loss:.3f}", flush=True)
        return self.step_number >= steps

    def write_results(self, arguments: argparse.Namespace, card: str, metrics: Any, **values: Any) -> None:
        """Write weights and model card. card: a template; values: those of its fields that only this network has."""
        settings = self.settings
        facts = {"steps": str(settings.steps), "seed": str(settings.seed), "metrics": json.dumps(metrics)}
        self.ship(arguments.out, facts)
        text = card.format(
            parameters=sum(p.numel() for p in self.network.parameters()),
            file=arguments.out.name,
            sha256=files.sha256_digest(arguments.out),
            frames=settings.frames,
            version=GENERATOR_VERSION,
            steps=settings.steps,
            batch=settings.batch,
            minutes=self.seconds / 60,
            seed=settings.seed,
            held_out=arguments.held_out,
            note=f"\n  {arguments.remark}" if arguments.remark else "",
            **values,
        )
        files.write_text(arguments.out.with_suffix(".md"), text)


def parse_options(
    about: str | None, run: Path, weights: Path, held_out: int, usual: type[Settings]
) -> tuple[argparse.Namespace, Settings]:
    """Read the command line and take one thread. about: what the tool does; run, weights, held_out, usual: defaults."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, default=run, help="frames, checkpoint, log")
    parser.add_argument("--out", type=Path, default=weights)
    parser.add_argument("--frames", type=int, default=usual.frames)
    parser.add_argument("--held-out", type=int, default=held_out, help="generated frames to judge by")
    parser.add_argument("--steps", type=int, default=usual.steps)
    parser.add_argument("--batch", type=int, default=usual.batch)
    parser.add_argument("--rate", type=float, default=usual.rate)
    parser.add_argument("--seed", type=int, default=usual.seed)
    parser.add_argument(
        "--pause-after", type=int, help="stop after so many steps of this call; call again to go on"
    )
    parser.add_argument("--remark", default="", help="a remark on this run for the model card")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    names = ("steps", "batch", "frames", "rate", "seed")
    return arguments, usual(**{name: getattr(arguments, name) for name in names})


def load_frames(
    folder: Path, frames: int, seed: int, split: str, make: Callable[[int], dict[str, np.ndarray]]
) -> list[dict[str, np.ndarray]]:
    """The first frames of a stream from their files, made as far as they are not there yet. make: a frame's arrays.

    Raises:
        ValueError: the folder has frames of another seed or split.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stamp, wanted = folder / "frames.json", {"seed": seed, "split": split}
    found = files.read_json(stamp) if stamp.is_file() else wanted | {"frames": 0}
    if {k: found[k] for k in wanted} != wanted:
        raise ValueError(f"{stamp}: expected frames of {wanted}, found {found}")
    for index in range(found["frames"], frames):
        files.write_npz(folder / f"{index:05d}.npz", make(index))
        files.write_json(stamp, wanted | {"frames": index + 1})
    return [files.read_npz(folder / f"{index:05d}.npz") for index in range(frames)]
