"""Trains a detector on a sequence of frames; resumable to the bit.

Each step's batch depends on the seed and the step alone, so a checkpoint holds weights, their running average and
the optimiser's state, but no state of random generators. For the same reason, threads may prepare batches ahead,
and the processes of torch.distributed may share a batch.
"""

from __future__ import annotations

import csv
import io
import json
import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor, distributed

from detectors.augment import AugmentSettings, augment
from detectors.base import Detector, DetectorError, free_device_memory
from detectors.files import write_atomically
from detectors.registry import read_weights, write_weights
from detectors.squeezedet import SeededDropout
from detectors.types import Targets

CHECKPOINT = "checkpoint.safetensors"
LOG = "log.csv"

PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
OPTIMISERS = ("adamw", "sgd")

ATTACK_TERM = "objectness"
"""The loss term that only attacks use: not logged."""

_CHANGEABLE = ("minutes", "checkpoint_every", "evaluate_every")
"""Settings that may change when a run resumes: they affect no weight, except that a schedule by time may be
extended.
"""

Sample = tuple[np.ndarray, Targets]
"""A frame (H, W, 3) uint8 RGB and its targets."""

Evaluate = Callable[[Detector, int], None]
"""Called with the averaged detector (eval mode) and the number of completed steps."""

Progress = Callable[[int, int, Mapping[str, float]], None]
"""Called after each step with the completed steps, the total, and the row of the log."""


@runtime_checkable
class AugmentedDataset(Protocol):
    """A data set that may return another version of a frame in each step."""

    def draw(self, index: int, step: int, generator: np.random.Generator) -> Sample:
        """The frame to train on instead of frame `index`; a function of the arguments alone.

        Args:
            index: Index of the frame.
            step: Number of the step.
            generator: Source of all random numbers.
        """
        ...


class AuxiliaryLoss(Protocol):
    """A further loss term, computed on images of its own."""

    name: str
    """Its column in the log."""

    def images(self, step: int) -> Tensor:
        """Images (K, 3, H, W) in [0, 1] for a step; a function of the step alone."""
        ...

    def term(self, detector: Detector, raw: Any, step: int) -> Tensor:
        """The weighted, differentiable term ().

        Args:
            detector: The detector in training.
            raw: Its predictions for `images(step)`.
            step: Number of the step.
        """
        ...


@dataclass(frozen=True, slots=True)
class TrainingSettings:
    """Training settings; the published schedules are presets in configs/."""

    steps: int = 10000
    """Length of the schedule."""
    minutes: float = 0.0
    """If above 0, the schedule also ends after this wall-clock time; such runs are not reproducible to the bit."""
    batch: int = 8
    """Windows per step, over all processes."""
    optimiser: str = "adamw"
    """adamw or sgd (with momentum)."""
    momentum: float = 0.9
    """Momentum of sgd."""
    rate: float = 1e-3
    """Peak learning rate."""
    backbone_rate: float = 0.3
    """Learning rate of pretrained layers, relative to the others'."""
    weight_decay: float = 1e-4
    """Weight decay."""
    warmup_steps: int = 200
    """Steps over which the learning rate rises."""
    warmup_power: float = 1.0
    """Exponent of that rise."""
    drops: tuple[int, ...] = ()
    """Steps at which the rate is multiplied by drop_factor; if empty, it falls as a half cosine."""
    drop_factor: float = 0.1
    """Factor of each drop."""
    clip_norm: float = 50.0
    """Largest norm of the gradient."""
    average_decay: float = 0.998
    """Decay per step of the exponential moving average of the weights."""
    precision: str = "float32"
    """Precision of the network; its loss is always float32. bfloat16 is twice as fast on CPUs with AVX512-BF16."""
    seed: int = 0
    """Seed of the whole run."""
    checkpoint_every: int = 200
    """Steps between checkpoints."""
    evaluate_every: int = 0
    """Steps between evaluations; 0 evaluates only at the end."""
    augment: AugmentSettings = field(default_factory=AugmentSettings)
    """Augmentation of the frames."""

    def __post_init__(self) -> None:
        if self.optimiser not in OPTIMISERS:
            raise ValueError(f"optimiser: expected {' or '.join(OPTIMISERS)}, found {self.optimiser!r}")
        if self.precision not in PRECISIONS:
            raise ValueError(f"precision: expected one of {', '.join(PRECISIONS)}, found {self.precision!r}")
        for name in ("steps", "batch", "rate", "checkpoint_every", "clip_norm"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a number above 0, found {getattr(self, name)}")


def train(
    detector: Detector,
    dataset: Sequence[Sample],
    settings: TrainingSettings,
    folder: Path,
    evaluate: Evaluate | None = None,
    stop_after: int | None = None,
    progress: Progress | None = None,
    loaders: int = 0,
    auxiliary_loss: AuxiliaryLoss | None = None,
) -> Detector:
    """Train a detector in place, resuming from the checkpoint in `folder` if there is one.

    In a process group of torch.distributed each process computes its share of every batch; only the first one
    writes, evaluates and reports progress.

    Args:
        detector: The detector to train.
        dataset: Frames with targets.
        settings: How to train.
        folder: Folder of the checkpoint and the log.
        evaluate: Evaluation callback.
        stop_after: Stop at this step without a final checkpoint, as a killed run would.
        progress: Progress callback.
        loaders: Threads that prepare batches ahead, each with one torch thread; 0 prepares them between steps.
        auxiliary_loss: Further loss term added in each step.

    Returns:
        The detector with averaged weights, in eval mode.

    Raises:
        ValueError: The dataset is empty, or the batch size is not a multiple of the number of processes.
        DetectorError: The checkpoint is of another detector or of other settings.
        FloatingPointError: The loss or gradient of a step is not finite.
    """
    if len(dataset) == 0:
        raise ValueError("dataset: expected at least one frame, found 0")
    rank, ranks = _rank_and_count()
    if settings.batch % ranks:
        raise ValueError(f"batch: expected a multiple of the {ranks} processes, found {settings.batch}")
    run = _Run(detector, settings, auxiliary_loss)
    step = run.load(folder / CHECKPOINT) if (folder / CHECKPOINT).is_file() else 0
    _wait_for_all()
    pretrained, before = time.monotonic(), run.seconds
    slots = range(rank, settings.batch, ranks)
    with _Log(folder / LOG, step, rank == 0) as log, _Batches(dataset, settings, slots, loaders) as batches:
        while step < settings.steps and (stop_after is None or step < stop_after):
            run.seconds = before + time.monotonic() - pretrained
            completed = _completed_fraction(step, run.seconds, settings)
            if completed >= 1:
                break
            row = run.step(step, *batches.get(step), learning_rate(completed, step, settings))
            step += 1
            log.add(step, run.seconds, row)
            if progress is not None and rank == 0:
                progress(step, settings.steps, row)
            # A killed run resumes from the checkpoint, so the log of its step is written first.
            if evaluate is not None and settings.evaluate_every and step % settings.evaluate_every == 0:
                log.write()
                if rank == 0:
                    with run.averaged() as averaged:
                        evaluate(averaged, step)
                _wait_for_all()
            if step % settings.checkpoint_every == 0 and rank == 0:
                log.write()
                run.save(folder / CHECKPOINT, step)
        if stop_after is None and rank == 0:
            log.write()
            run.save(folder / CHECKPOINT, step)
    run.use_average()
    if evaluate is not None and stop_after is None and rank == 0:
        evaluate(detector, step)
    _wait_for_all()
    return detector


def learning_rate(completed: float, step: int, settings: TrainingSettings) -> float:
    """Learning rate: warm-up over steps, then drops or a half cosine to 1 %.

    Args:
        done: Completed fraction of the schedule, in [0, 1].
        step: Number of the step.
        settings: The schedule.
    """
    warm = min((step + 1) / max(settings.warmup_steps, 1), 1.0) ** settings.warmup_power
    if settings.drops:
        return settings.rate * warm * settings.drop_factor ** sum(step >= drop for drop in settings.drops)
    return settings.rate * warm * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(completed, 1.0))))


def make_batch(
    dataset: Sequence[Sample], step: int, settings: TrainingSettings, slots: Sequence[int] | None = None
) -> tuple[Tensor, list[Targets]]:
    """The batch of one step. Each epoch visits all frames in an order of its own.

    Args:
        dataset: Frames with targets.
        step: Number of the step.
        settings: Seed, batch size and augmentation.
        slots: Positions in the batch; None for all.

    Returns:
        Images (B, 3, h, w) float32 in [0, 1] and their targets.
    """
    chosen = range(settings.batch) if slots is None else slots
    return _stack([_sample(dataset, step, slot, settings) for slot in chosen])


def _sample(dataset: Sequence[Sample], step: int, slot: int, settings: TrainingSettings) -> tuple[Tensor, Targets]:
    epoch, place = divmod(step * settings.batch + slot, len(dataset))
    order = np.random.default_rng([settings.seed, 1, epoch]).permutation(len(dataset))
    index = int(order[place])
    if isinstance(dataset, AugmentedDataset):
        image, targets = dataset.draw(index, step, np.random.default_rng([settings.seed, 3, step, slot]))
    else:
        image, targets = dataset[index]
    return augment(image, targets, settings.augment, np.random.default_rng([settings.seed, 2, step, slot]))


def _stack(windows: Sequence[tuple[Tensor, Targets]]) -> tuple[Tensor, list[Targets]]:
    return torch.stack([image for image, _ in windows]), [targets for _, targets in windows]


class _Batches:
    """Batches in the order of steps, prepared ahead by threads if there are any."""

    AHEAD = 2
    """Steps prepared: the next one, and one that threads work on meanwhile."""

    def __init__(
        self, dataset: Sequence[Sample], settings: TrainingSettings, slots: Sequence[int], threads: int
    ) -> None:
        self._dataset, self._settings, self._slots = dataset, settings, slots
        self._pool: ThreadPoolExecutor | None = None
        if threads > 0:
            # a new thread would start with torch's default thread count, which sums depend on
            self._pool = ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,))
        self._ready: deque[tuple[int, list[Future[tuple[Tensor, Targets]]]]] = deque()

    def __enter__(self) -> _Batches:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def get(self, step: int) -> tuple[Tensor, list[Targets]]:
        """This process's share of the batch of `step`; steps must be requested in order."""
        if self._pool is None:
            return make_batch(self._dataset, step, self._settings, self._slots)
        for coming in range(step + len(self._ready), min(step + self.AHEAD, self._settings.steps)):
            futures = [
                self._pool.submit(_sample, self._dataset, coming, slot, self._settings) for slot in self._slots
            ]
            self._ready.append((coming, futures))
        ready, futures = self._ready.popleft()
        assert ready == step
        return _stack([future.result() for future in futures])


class _Run:
    """Weights, their average and the optimiser's state."""

    def __init__(
        self, detector: Detector, settings: TrainingSettings, auxiliary_loss: AuxiliaryLoss | None = None
    ) -> None:
        self.detector, self.settings, self.auxiliary_loss = detector.train(), settings, auxiliary_loss
        self.seconds = 0.0
        self.generator = torch.Generator()
        for module in detector.modules():
            if isinstance(module, SeededDropout):
                module.generator = self.generator
        self.device = next(detector.parameters()).device
        self.part = settings.batch  # windows per forward pass
        self.average = {name: value.detach().clone() for name, value in detector.state_dict().items()}
        new_layers, pretrained = [], []
        for name, parameter in detector.named_parameters():
            (new_layers if name.startswith(detector.fresh_layers) else pretrained).append(parameter)
        groups: list[dict[str, Any]] = [
            {"params": new_layers, "factor": 1.0},
            {"params": pretrained, "factor": settings.backbone_rate},
        ]
        if settings.optimiser == "adamw":
            self.optimiser: torch.optim.Optimizer = torch.optim.AdamW(
                groups, lr=settings.rate, weight_decay=settings.weight_decay
            )
        else:
            self.optimiser = torch.optim.SGD(
                groups, lr=settings.rate, momentum=settings.momentum, weight_decay=settings.weight_decay
            )
        # float16 loses small gradients: the loss is scaled up, and steps that overflow are skipped
        self.scaler = torch.amp.GradScaler(self.device.type, enabled=settings.precision == "float16")
        self.forward: Callable[[Tensor], Any] = detector
        if _rank_and_count()[1] > 1:
            self.forward = torch.nn.parallel.DistributedDataParallel(detector)

    def step(self, step: int, images: Tensor, targets: Sequence[Targets], rate: float) -> dict[str, float]:
        """One optimiser step; returns the learning rate, loss terms and norm of the gradient."""
        dtype = PRECISIONS[self.settings.precision]
        # different dropout masks in each process
        self.generator.manual_seed(self.settings.seed * 1_000_003 + step + (_rank_and_count()[0] << 40))
        for group in self.optimiser.param_groups:
            group["lr"] = rate * group["factor"]
        values = self._backward(images, targets, dtype)
        if self.auxiliary_loss is not None:
            values |= self._backward_auxiliary(self.auxiliary_loss, step, values["total"], dtype)
        self.scaler.unscale_(self.optimiser)
        norm = torch.nn.utils.clip_grad_norm_(self.detector.parameters(), self.settings.clip_norm)
        overflown = self.scaler.is_enabled() and math.isfinite(values["total"])
        if not (math.isfinite(values["total"]) and (overflown or bool(torch.isfinite(norm)))):
            raise FloatingPointError(f"step {step}: expected a finite loss and gradient, found {values}, {norm}")
        self.scaler.step(self.optimiser)
        self.scaler.update()
        # The average's memory grows with the steps, so that the random start does not dominate it.
        decay = min(self.settings.average_decay, (1 + step) / (10 + step))
        with torch.no_grad():
            for name, value in self.detector.state_dict().items():
                if value.is_floating_point():
                    self.average[name].lerp_(value, 1 - decay)
                else:
                    self.average[name].copy_(value)
        return {"rate": rate, **values, "norm": float(norm)}

    def _backward(self, images: Tensor, targets: Sequence[Targets], dtype: torch.dtype) -> dict[str, float]:
        """Backpropagate the mean loss of a batch; returns the loss terms.

        When device memory runs out, the batch is split into parts, as if processes shared it; so are all later
        batches.
        """
        while True:
            try:
                return self._in_parts(images, targets, dtype)
            except torch.OutOfMemoryError:
                if self.part < 2 or _rank_and_count()[1] > 1:
                    raise
            self.part = -(-min(self.part, len(images)) // 2)
            self.optimiser.zero_grad(set_to_none=True)
            free_device_memory(
                f"a batch of {len(images)} exceeds the device's memory: {self.part} at once from now on"
            )

    def _in_parts(self, images: Tensor, targets: Sequence[Targets], dtype: torch.dtype) -> dict[str, float]:
        values: dict[str, float] = {}
        self.optimiser.zero_grad(set_to_none=True)
        for start in range(0, len(images), self.part):
            part = images[start : start + self.part]
            share = len(part) / len(images)
            with torch.autocast(self.device.type, dtype, enabled=dtype != torch.float32):
                raw = self.forward(part.to(self.device, non_blocking=True))
            terms = self.detector.loss(raw, targets[start : start + self.part])
            self.scaler.scale(terms["total"] * share).backward()
            for name, value in terms.items():
                if name != ATTACK_TERM:
                    values[name] = values.get(name, 0.0) + share * float(value.detach())
        return values

    def _backward_auxiliary(
        self, auxiliary_loss: AuxiliaryLoss, step: int, total: float, dtype: torch.dtype
    ) -> dict[str, float]:
        """Backpropagate the auxiliary term; returns it and the new total."""
        with torch.autocast(self.device.type, dtype, enabled=dtype != torch.float32):
            raw = self.forward(auxiliary_loss.images(step).to(self.device))
        term = auxiliary_loss.term(self.detector, raw, step)
        if term.requires_grad:  # otherwise there is no object to compare
            self.scaler.scale(term).backward()
        return {auxiliary_loss.name: float(term.detach()), "total": total + float(term.detach())}

    @contextmanager
    def averaged(self) -> Iterator[Detector]:
        """The detector with averaged weights in eval mode, within this context."""
        current = {name: value.detach().clone() for name, value in self.detector.state_dict().items()}
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
        tensors = {f"weights.{n}": v.detach().contiguous() for n, v in self.detector.state_dict().items()}
        tensors |= {f"average.{n}": v.contiguous() for n, v in self.average.items()}
        tensors |= {f"optimiser.{n}": v for n, v in optimiser_state(self.optimiser).items()}
        facts = {
            "step": str(step),
            "seconds": repr(self.seconds),
            "settings": json.dumps(asdict(self.settings), sort_keys=True),
        }
        if self.scaler.is_enabled():
            facts["scaler"] = json.dumps(self.scaler.state_dict())
        write_weights(path, facts, tensors)

    def load(self, path: Path) -> int:
        """Load a checkpoint; returns its step.

        Raises:
            DetectorError: It belongs to other settings or another detector.
        """
        facts, tensors = read_weights(path)
        found, wanted = json.loads(facts.get("settings", "{}")), json.loads(json.dumps(asdict(self.settings)))
        for name in sorted(wanted.keys() - set(_CHANGEABLE)):
            if found.get(name) != wanted[name]:
                raise DetectorError(f"{path}: {name}: expected {wanted[name]} as set, found {found.get(name)}")
        sections = split_by_section(tensors, "weights", "average", "optimiser")
        for section in ("weights", "average"):
            shapes = {name: value.shape for name, value in sections[section].items()}
            if shapes != {name: value.shape for name, value in self.average.items()}:
                raise DetectorError(f"{path}: expected the tensors of {self.detector.name}, found others")
        _copy_into(self.detector, sections["weights"])
        # Copied in place to preserve the memory layout of the weights.
        for name, value in self.average.items():
            value.copy_(sections["average"][name])
        restore_optimiser(self.optimiser, sections["optimiser"])
        if self.scaler.is_enabled():
            self.scaler.load_state_dict(json.loads(facts["scaler"]))
        self.seconds = float(facts["seconds"])
        return int(facts["step"])


class _Log:
    """CSV log with one row per step; a resumed run drops rows after its checkpoint.

    Columns: step, seconds, rate, the detector's loss terms, norm of the gradient. The file is always replaced as a
    whole: a killed run leaves neither half a row nor a checkpoint with steps missing from the log.
    """

    def __init__(self, path: Path, step: int, writes: bool) -> None:
        self._path, self._writes = path, writes
        self._rows: list[dict[str, str]] = []
        if step and path.is_file():
            with path.open(newline="") as file:
                self._rows = [row for row in csv.DictReader(file) if int(row["step"]) <= step]

    def __enter__(self) -> _Log:
        return self

    def __exit__(self, *_: object) -> None:
        self.write()

    def add(self, step: int, seconds: float, values: Mapping[str, float]) -> None:
        numbers = {name: f"{value:.6g}" for name, value in values.items()}
        self._rows.append({"step": str(step), "seconds": f"{seconds:.1f}", **numbers})

    def write(self) -> None:
        """Write all rows.

        Raises:
            DetectorError: The file cannot be written.
        """
        if self._rows and self._writes:
            table = io.StringIO(newline="")
            writer = csv.DictWriter(table, list(self._rows[0]))
            writer.writeheader()
            writer.writerows(self._rows)
            write_atomically(self._path, table.getvalue().encode())


def _rank_and_count() -> tuple[int, int]:
    """This process's rank and the number of processes."""
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1


def _wait_for_all() -> None:
    if _rank_and_count()[1] > 1:
        distributed.barrier()


def _completed_fraction(step: int, seconds: float, settings: TrainingSettings) -> float:
    if settings.minutes <= 0:
        return step / settings.steps
    shared = [seconds]
    if _rank_and_count()[1] > 1:  # one clock, so that all processes use the same rate and stop at the same step
        distributed.broadcast_object_list(shared)
    return max(step / settings.steps, shared[0] / (60 * settings.minutes))


def split_by_section(tensors: Mapping[str, Tensor], *names: str) -> dict[str, dict[str, Tensor]]:
    """A checkpoint's tensors, named "SECTION.NAME", by section.

    Raises:
        KeyError, ValueError: A tensor is in none of the sections.
    """
    sections: dict[str, dict[str, Tensor]] = {name: {} for name in names}
    for key, tensor in tensors.items():
        section, name = key.split(".", 1)
        sections[section][name] = tensor
    return sections


def optimiser_state(optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """An optimiser's state of each parameter, by "INDEX.NAME"."""
    state = optimiser.state_dict()["state"]
    return {
        f"{index}.{key}": value.contiguous() for index, values in state.items() for key, value in values.items()
    }


def restore_optimiser(optimiser: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Load the result of `optimiser_state` into an optimiser of the same parameters."""
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        index, key = name.split(".", 1)
        state.setdefault(int(index), {})[key] = tensor
    optimiser.load_state_dict(optimiser.state_dict() | {"state": state})


@torch.no_grad()
def _copy_into(detector: Detector, values: Mapping[str, Tensor]) -> None:
    for name, own in detector.state_dict().items():
        own.copy_(values[name])
