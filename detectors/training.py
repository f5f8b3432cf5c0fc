"""Training of a detector on frames that come in as a sequence; resumable to the bit.

What step k sees depends on the seed and k alone, so a checkpoint holds weights, their running average and the
optimiser's state, and nothing about random generators.
"""

from __future__ import annotations

import csv
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from detectors.augment import AugmentSettings, view
from detectors.base import Detector
from detectors.registry import read_weights, write_weights
from detectors.squeezedet import SeededDropout
from detectors.types import Targets

CHECKPOINT = "checkpoint.safetensors"
LOG = "log.csv"
_COLUMNS: tuple[str, ...] = ("step", "seconds", "rate", "confidence", "box", "class", "total", "norm")

Sample = tuple[np.ndarray, Targets]
"""A frame (H, W, 3) uint8 RGB and what is in it."""

Evaluate = Callable[[Detector, int], None]
"""Called with the averaged detector (eval mode) and the number of steps done."""

Progress = Callable[[int, int, float], None]
"""Called after each step with the steps done, the steps in all, and the loss."""


@dataclass(frozen=True, slots=True)
class TrainingSettings:
    """How to train. Published: SGD 0.01, momentum 0.9, halved every 10k steps, decay 1e-4, clip 1, batch 20."""

    steps: int = 10000
    """Length of the cosine schedule."""
    minutes: float = 0.0
    """Where above 0, the schedule also ends after this wall-clock time (then a rerun is not equal to the bit)."""
    batch: int = 8
    optimiser: str = "adamw"
    """adamw or sgd (momentum 0.9)."""
    rate: float = 1e-3
    """Peak learning rate."""
    backbone_rate: float = 0.3
    """Rate of the layers that start from ImageNet weights, relative to the others'."""
    weight_decay: float = 1e-4
    warmup_steps: int = 200
    clip_norm: float = 50.0
    average_decay: float = 0.998
    """Decay a step of the exponential moving average of the weights."""
    bfloat16: bool = False
    """Autocast; twice as fast on CPUs with AVX512-BF16."""
    seed: int = 0
    checkpoint_every: int = 200
    evaluate_every: int = 0
    """Steps between calls of `evaluate`; 0 is at the end only."""
    augment: AugmentSettings = field(default_factory=AugmentSettings)

    def __post_init__(self) -> None:
        if self.optimiser not in ("adamw", "sgd"):
            raise ValueError(f"optimiser: expected adamw or sgd, found {self.optimiser!r}")
        for name in ("steps", "batch", "rate", "checkpoint_every"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name}: expected a number above 0, found {getattr(self, name)}")


def train(
    detector: Detector,
    dataset: Sequence[Sample],
    settings: TrainingSettings,
    folder: Path,
    evaluate: Evaluate | None = None,
    stop_after: int | None = None,
    progress: Progress | None = None,
) -> Detector:
    """Train in place, from the checkpoint in `folder` where there is one; the detector returned holds the averaged
    weights, in eval mode.

    `stop_after` leaves the schedule at that step, as a killed run does. Raises ValueError for an empty dataset and
    FloatingPointError (with the step) where the loss is no finite number.
    """
    if len(dataset) == 0:
        raise ValueError("dataset: expected at least one frame, found 0")
    folder.mkdir(parents=True, exist_ok=True)
    run = _Run(detector, settings)
    step = run.load(folder / CHECKPOINT) if (folder / CHECKPOINT).is_file() else 0
    started, before = time.monotonic(), run.seconds
    with _Log(folder / LOG, step) as log:
        while step < settings.steps and (stop_after is None or step < stop_after):
            run.seconds = before + time.monotonic() - started
            done = _done(step, run.seconds, settings)
            if done >= 1:
                break
            terms = run.step(step, dataset, schedule(done, step, settings))
            step += 1
            log.add(step, run.seconds, terms)
            if progress is not None:
                progress(step, settings.steps, terms["total"])
            if step % settings.checkpoint_every == 0:
                run.save(folder / CHECKPOINT, step)
                log.flush()
            if evaluate is not None and settings.evaluate_every and step % settings.evaluate_every == 0:
                with run.averaged() as averaged:
                    evaluate(averaged, step)
        if stop_after is None:
            run.save(folder / CHECKPOINT, step)
    run.use_average()
    if evaluate is not None and stop_after is None:
        evaluate(detector, step)
    return detector


def schedule(done: float, step: int, settings: TrainingSettings) -> float:
    """Learning rate after the fraction `done` in [0, 1]: linear warm-up over steps, then a half cosine to 1%."""
    warm = min((step + 1) / max(settings.warmup_steps, 1), 1.0)
    return settings.rate * warm * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(done, 1.0))))


def batch_of(dataset: Sequence[Sample], step: int, settings: TrainingSettings) -> tuple[Tensor, list[Targets]]:
    """What step `step` sees: images (batch, 3, h, w) float32 in [0, 1], and targets.

    Frames come epoch by epoch, each in an order of its own.
    """
    views = []
    for slot in range(settings.batch):
        epoch, place = divmod(step * settings.batch + slot, len(dataset))
        order = np.random.default_rng([settings.seed, 1, epoch]).permutation(len(dataset))
        image, targets = dataset[int(order[place])]
        views.append(view(image, targets, settings.augment, np.random.default_rng([settings.seed, 2, step, slot])))
    return torch.stack([image for image, _ in views]), [targets for _, targets in views]


class _Run:
    """Weights, their average and the optimiser's state."""

    def __init__(self, detector: Detector, settings: TrainingSettings) -> None:
        self.detector, self.settings = detector.train(), settings
        self.seconds = 0.0
        self.generator = torch.Generator()
        for module in detector.modules():
            if isinstance(module, SeededDropout):
                module.generator = self.generator
        self.average = {name: p.detach().clone() for name, p in detector.named_parameters()}
        fresh, started = [], []
        for name, parameter in detector.named_parameters():
            (fresh if name.startswith(detector.fresh_layers) else started).append(parameter)
        groups: list[dict[str, Any]] = [
            {"params": fresh, "factor": 1.0},
            {"params": started, "factor": settings.backbone_rate},
        ]
        if settings.optimiser == "adamw":
            self.optimiser: torch.optim.Optimizer = torch.optim.AdamW(
                groups, lr=settings.rate, weight_decay=settings.weight_decay
            )
        else:
            self.optimiser = torch.optim.SGD(
                groups, lr=settings.rate, momentum=0.9, weight_decay=settings.weight_decay
            )

    def step(self, step: int, dataset: Sequence[Sample], rate: float) -> dict[str, float]:
        """One step of the optimiser; the loss terms, the norm of the gradient and the rate."""
        images, targets = batch_of(dataset, step, self.settings)
        self.generator.manual_seed(self.settings.seed * 1_000_003 + step)
        for group in self.optimiser.param_groups:
            group["lr"] = rate * group["factor"]
        with torch.autocast("cpu", torch.bfloat16, enabled=self.settings.bfloat16):
            raw = self.detector(images)
        terms = self.detector.loss(raw, targets)
        self.optimiser.zero_grad(set_to_none=True)
        terms["total"].backward()
        norm = torch.nn.utils.clip_grad_norm_(self.detector.parameters(), self.settings.clip_norm)
        values = {name: float(terms[name].detach()) for name in ("confidence", "box", "class", "total")}
        if not (math.isfinite(values["total"]) and bool(torch.isfinite(norm))):
            raise FloatingPointError(f"step {step}: expected a finite loss and gradient, found {values}, {norm}")
        self.optimiser.step()
        # The average of the first steps must not be the random start: its memory grows with the steps.
        decay = min(self.settings.average_decay, (1 + step) / (10 + step))
        with torch.no_grad():
            for name, parameter in self.detector.named_parameters():
                self.average[name].lerp_(parameter, 1 - decay)
        return values | {"norm": float(norm), "rate": rate}

    @contextmanager
    def averaged(self) -> Iterator[Detector]:
        """The detector with its averaged weights in eval mode; inside this block only."""
        current = {name: p.detach().clone() for name, p in self.detector.named_parameters()}
        self.use_average()
        try:
            yield self.detector
        finally:
            _copy_into(self.detector, current)
            self.detector.train()

    def use_average(self) -> None:
        _copy_into(self.detector, self.average)
        self.detector.eval()

    def save(self, path: Path, step: int) -> None:
        tensors = {f"weights.{n}": p.detach().contiguous() for n, p in self.detector.named_parameters()}
        tensors |= {f"average.{n}": p.contiguous() for n, p in self.average.items()}
        for index, state in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{index}.{key}": value.contiguous() for key, value in state.items()}
        facts = {"step": str(step), "seconds": repr(self.seconds), "settings": _fingerprint(self.settings)}
        write_weights(path, facts, tensors)

    def load(self, path: Path) -> int:
        """The step that a checkpoint was written after. ValueError where it belongs to other settings."""
        facts, tensors = read_weights(path)
        found, wanted = json.loads(facts.get("settings", "{}")), json.loads(_fingerprint(self.settings))
        # A schedule by the clock may be stretched on the way; all else must be as it was.
        differing = sorted(
            k for k in found.keys() | wanted.keys() if k != "minutes" and found.get(k) != wanted.get(k)
        )
        if differing:
            name = differing[0]
            raise ValueError(f"{path}: {name}: expected {wanted.get(name)} as set, found {found.get(name)}")
        sections: dict[str, dict[str, Tensor]] = {"weights": {}, "average": {}, "optimiser": {}}
        for key, tensor in tensors.items():
            section, name = key.split(".", 1)
            sections[section][name] = tensor
        _copy_into(self.detector, sections["weights"])
        # Copied, so that the averages keep the layout of the weights.
        for name, value in self.average.items():
            value.copy_(sections["average"][name])
        state: dict[int, dict[str, Tensor]] = {}
        for name, tensor in sections["optimiser"].items():
            index, key = name.split(".", 1)
            state.setdefault(int(index), {})[key] = tensor
        self.optimiser.load_state_dict(self.optimiser.state_dict() | {"state": state})
        self.seconds = float(facts["seconds"])
        return int(facts["step"])


class _Log:
    """CSV of the run, a line a step; a run that goes on drops the lines after its checkpoint."""

    def __init__(self, path: Path, step: int) -> None:
        kept = []
        if step and path.is_file():
            with path.open(newline="") as file:
                kept = [row for row in csv.DictReader(file) if int(row["step"]) <= step]
        self._file = path.open("w", newline="")
        self._writer = csv.DictWriter(self._file, _COLUMNS)
        self._writer.writeheader()
        self._writer.writerows(kept)

    def __enter__(self) -> _Log:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def add(self, step: int, seconds: float, values: dict[str, float]) -> None:
        numbers = {name: f"{value:.6g}" for name, value in values.items()}
        self._writer.writerow({"step": step, "seconds": f"{seconds:.1f}", **numbers})

    def flush(self) -> None:
        self._file.flush()


def _done(step: int, seconds: float, settings: TrainingSettings) -> float:
    by_time = seconds / (60 * settings.minutes) if settings.minutes > 0 else 0.0
    return max(step / settings.steps, by_time)


def _fingerprint(settings: TrainingSettings) -> str:
    return json.dumps(asdict(settings), sort_keys=True)


@torch.no_grad()
def _copy_into(detector: Detector, values: dict[str, Tensor]) -> None:
    for name, parameter in detector.named_parameters():
        parameter.copy_(values[name])
