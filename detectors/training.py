"""Training of a detector on frames that come in as a sequence; resumable to the bit.

What step k sees depends on the seed and k alone, so a checkpoint holds weights, their running average and the
optimiser's state, and nothing about random generators. For the same reason frames can be made ready ahead by
threads, and a batch can be shared by the processes of torch.distributed, where a launcher has set it up.
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

from detectors.augment import AugmentSettings, view
from detectors.base import Detector, DetectorError, RawPredictions
from detectors.memory import make_room
from detectors.registry import read_weights, write_weights
from detectors.squeezedet import SeededDropout
from detectors.types import Targets
from detectors.whole import write_whole

CHECKPOINT = "checkpoint.safetensors"
LOG = "log.csv"

PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
OPTIMISERS = ("adamw", "sgd")

NO_LOSS = "objectness"
"""The term that only attacks use: no column of the log."""

_FREE = ("minutes", "checkpoint_every", "evaluate_every")
"""Settings that a run may change on the way: a schedule by the clock may be stretched, the others change no
weight."""

Sample = tuple[np.ndarray, Targets]
"""A frame (H, W, 3) uint8 RGB and what is in it."""

Evaluate = Callable[[Detector, int], None]
"""Called with the averaged detector (eval mode) and the number of steps done."""

Progress = Callable[[int, int, Mapping[str, float]], None]
"""Called after each step with the steps done, the steps in all, and the row of the log."""


@runtime_checkable
class Drawn(Protocol):
    """A data set whose frames need not look the same each time."""

    def draw(self, index: int, step: int, generator: np.random.Generator) -> Sample:
        """What to show instead of frame `index` in step `step`; a function of these three alone."""
        ...


class Beside(Protocol):
    """A further term of the loss, on pictures of its own. name: of its column in the log."""

    name: str

    def images(self, step: int) -> Tensor:
        """What the detector is to see in a step for it: (K, 3, H, W) in [0, 1]; a function of the step alone."""
        ...

    def term(self, detector: Detector, raw: Any, step: int) -> Tensor:
        """The term (), weighted, of what the detector says of these images; differentiable."""
        ...


@dataclass(frozen=True, slots=True)
class TrainingSettings:
    """How to train; the published schedules are presets in configs/."""

    steps: int = 10000
    """Length of the schedule."""
    minutes: float = 0.0
    """Where above 0, the schedule also ends after this wall-clock time (then a rerun is not equal to the bit)."""
    batch: int = 8
    """Views a step, over all processes."""
    optimiser: str = "adamw"
    """adamw or sgd (with momentum)."""
    momentum: float = 0.9
    rate: float = 1e-3
    """Peak learning rate."""
    backbone_rate: float = 0.3
    """Rate of the layers that start from ImageNet weights, relative to the others'."""
    weight_decay: float = 1e-4
    warmup_steps: int = 200
    warmup_power: float = 1.0
    """The rate rises with this power of the steps done."""
    drops: tuple[int, ...] = ()
    """Steps at which the rate is multiplied by drop_factor; without any it falls in a half cosine."""
    drop_factor: float = 0.1
    clip_norm: float = 50.0
    average_decay: float = 0.998
    """Decay a step of the exponential moving average of the weights."""
    precision: str = "float32"
    """What the network computes in; its loss is always float32. bfloat16 is twice as fast on CPUs with
    AVX512-BF16."""
    seed: int = 0
    checkpoint_every: int = 200
    evaluate_every: int = 0
    """Steps between calls of `evaluate`; 0 is at the end only."""
    augment: AugmentSettings = field(default_factory=AugmentSettings)

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
    beside: Beside | None = None,
) -> Detector:
    """Train in place, from the checkpoint in `folder` where there is one; the detector returned holds the averaged
    weights, in eval mode.

    `stop_after` leaves the schedule at that step, as a killed run does. `loaders`: threads that make views ready
    ahead, each with one of torch's threads; without any, views are made between the steps. In a process group of
    torch.distributed each process computes its share of every batch, and the first one alone writes, evaluates and
    tells progress. `beside`: a term that each step adds to the loss.

    Raises ValueError for an empty dataset, or a batch that the processes cannot share evenly; DetectorError for a
    checkpoint of another detector or of other settings; FloatingPointError (with the step) where the loss is no
    finite number.
    """
    if len(dataset) == 0:
        raise ValueError("dataset: expected at least one frame, found 0")
    rank, ranks = _place()
    if settings.batch % ranks:
        raise ValueError(f"batch: expected a multiple of the {ranks} processes, found {settings.batch}")
    run = _Run(detector, settings, beside)
    step = run.load(folder / CHECKPOINT) if (folder / CHECKPOINT).is_file() else 0
    _wait_for_all()
    started, before = time.monotonic(), run.seconds
    slots = range(rank, settings.batch, ranks)
    with _Log(folder / LOG, step, rank == 0) as log, _Batches(dataset, settings, slots, loaders) as batches:
        while step < settings.steps and (stop_after is None or step < stop_after):
            run.seconds = before + time.monotonic() - started
            done = _done(step, run.seconds, settings)
            if done >= 1:
                break
            row = run.step(step, *batches.of(step), schedule(done, step, settings))
            step += 1
            log.add(step, run.seconds, row)
            if progress is not None and rank == 0:
                progress(step, settings.steps, row)
            # A run that is killed goes on from the checkpoint: what belongs to its step is written before it.
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


def schedule(done: float, step: int, settings: TrainingSettings) -> float:
    """Learning rate after the fraction `done` in [0, 1]: warm-up over steps, then drops or a half cosine to 1%."""
    warm = min((step + 1) / max(settings.warmup_steps, 1), 1.0) ** settings.warmup_power
    if settings.drops:
        return settings.rate * warm * settings.drop_factor ** sum(step >= drop for drop in settings.drops)
    return settings.rate * warm * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(done, 1.0))))


def batch_of(
    dataset: Sequence[Sample], step: int, settings: TrainingSettings, slots: Sequence[int] | None = None
) -> tuple[Tensor, list[Targets]]:
    """What step `step` sees: images (batch, 3, h, w) float32 in [0, 1], and targets; or those `slots` of it.

    Frames come epoch by epoch, each in an order of its own.
    """
    chosen = range(settings.batch) if slots is None else slots
    return _stacked([_sample(dataset, step, slot, settings) for slot in chosen])


def _sample(dataset: Sequence[Sample], step: int, slot: int, settings: TrainingSettings) -> tuple[Tensor, Targets]:
    epoch, place = divmod(step * settings.batch + slot, len(dataset))
    order = np.random.default_rng([settings.seed, 1, epoch]).permutation(len(dataset))
    index = int(order[place])
    if isinstance(dataset, Drawn):
        image, targets = dataset.draw(index, step, np.random.default_rng([settings.seed, 3, step, slot]))
    else:
        image, targets = dataset[index]
    return view(image, targets, settings.augment, np.random.default_rng([settings.seed, 2, step, slot]))


def _stacked(views: Sequence[tuple[Tensor, Targets]]) -> tuple[Tensor, list[Targets]]:
    return torch.stack([image for image, _ in views]), [targets for _, targets in views]


class _Batches:
    """Batches in the order of their steps; threads, where there are any, make the coming ones ready."""

    AHEAD = 2
    """Steps: one that is waited for, and one that the threads work on meanwhile."""

    def __init__(
        self, dataset: Sequence[Sample], settings: TrainingSettings, slots: Sequence[int], threads: int
    ) -> None:
        self._dataset, self._settings, self._slots = dataset, settings, slots
        self._pool: ThreadPoolExecutor | None = None
        if threads > 0:
            # a new thread would start with torch's default number, and sums depend on it
            self._pool = ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,))
        self._ready: deque[tuple[int, list[Future[tuple[Tensor, Targets]]]]] = deque()

    def __enter__(self) -> _Batches:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def of(self, step: int) -> tuple[Tensor, list[Targets]]:
        """This process's share of the batch of `step`; steps are asked for one after the other."""
        if self._pool is None:
            return batch_of(self._dataset, step, self._settings, self._slots)
        for coming in range(step + len(self._ready), min(step + self.AHEAD, self._settings.steps)):
            futures = [
                self._pool.submit(_sample, self._dataset, coming, slot, self._settings) for slot in self._slots
            ]
            self._ready.append((coming, futures))
        ready, futures = self._ready.popleft()
        assert ready == step
        return _stacked([future.result() for future in futures])


class _Run:
    """Weights and buffers, their average and the optimiser's state."""

    def __init__(self, detector: Detector, settings: TrainingSettings, beside: Beside | None = None) -> None:
        self.detector, self.settings, self.beside = detector.train(), settings, beside
        self.seconds = 0.0
        self.generator = torch.Generator()
        for module in detector.modules():
            if isinstance(module, SeededDropout):
                module.generator = self.generator
        self.device = next(detector.parameters()).device
        self.part = settings.batch  # views at once
        self.average = {name: value.detach().clone() for name, value in detector.state_dict().items()}
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
                groups, lr=settings.rate, momentum=settings.momentum, weight_decay=settings.weight_decay
            )
        # float16 loses small gradients: the loss is scaled up, and steps that overflow are left out
        self.scaler = torch.amp.GradScaler(self.device.type, enabled=settings.precision == "float16")
        self.forward: Callable[[Tensor], RawPredictions] = detector
        if _place()[1] > 1:
            self.forward = torch.nn.parallel.DistributedDataParallel(detector)

    def step(self, step: int, images: Tensor, targets: Sequence[Targets], rate: float) -> dict[str, float]:
        """One step of the optimiser; the rate, the loss terms and the norm of the gradient."""
        dtype = PRECISIONS[self.settings.precision]
        # other masks in each process, as in the parts of one batch
        self.generator.manual_seed(self.settings.seed * 1_000_003 + step + (_place()[0] << 40))
        for group in self.optimiser.param_groups:
            group["lr"] = rate * group["factor"]
        values = self._backward(images, targets, dtype)
        if self.beside is not None:
            values |= self._backward_beside(self.beside, step, values["total"], dtype)
        self.scaler.unscale_(self.optimiser)
        norm = torch.nn.utils.clip_grad_norm_(self.detector.parameters(), self.settings.clip_norm)
        overflown = self.scaler.is_enabled() and math.isfinite(values["total"])
        if not (math.isfinite(values["total"]) and (overflown or bool(torch.isfinite(norm)))):
            raise FloatingPointError(f"step {step}: expected a finite loss and gradient, found {values}, {norm}")
        self.scaler.step(self.optimiser)
        self.scaler.update()
        # The average of the first steps must not be the random start: its memory grows with the steps.
        decay = min(self.settings.average_decay, (1 + step) / (10 + step))
        with torch.no_grad():
            for name, value in self.detector.state_dict().items():
                if value.is_floating_point():
                    self.average[name].lerp_(value, 1 - decay)
                else:
                    self.average[name].copy_(value)
        return {"rate": rate, **values, "norm": float(norm)}

    def _backward(self, images: Tensor, targets: Sequence[Targets], dtype: torch.dtype) -> dict[str, float]:
        """Gradients of the mean loss of a batch, and the loss terms. Where the device's memory does not hold the
        whole batch, parts of it follow one another, as if so many processes shared it; then so in all later steps.
        """
        while True:
            try:
                return self._in_parts(images, targets, dtype)
            except torch.OutOfMemoryError:
                if self.part < 2 or _place()[1] > 1:
                    raise
            self.part = -(-min(self.part, len(images)) // 2)
            self.optimiser.zero_grad(set_to_none=True)
            make_room(
                f"a batch of {len(images)} does not fit into the device's memory: {self.part} at once from now on"
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
                if name != NO_LOSS:
                    values[name] = values.get(name, 0.0) + share * float(value.detach())
        return values

    def _backward_beside(self, beside: Beside, step: int, total: float, dtype: torch.dtype) -> dict[str, float]:
        """Add the gradients of the further term; it and the sum of all terms."""
        with torch.autocast(self.device.type, dtype, enabled=dtype != torch.float32):
            raw = self.forward(beside.images(step).to(self.device))
        term = beside.term(self.detector, raw, step)
        if term.requires_grad:  # else there is no object to compare
            self.scaler.scale(term).backward()
        return {beside.name: float(term.detach()), "total": total + float(term.detach())}

    @contextmanager
    def averaged(self) -> Iterator[Detector]:
        """The detector with its averaged weights in eval mode; inside this block only."""
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
        tensors |= {f"optimiser.{n}": v for n, v in state_of(self.optimiser).items()}
        facts = {
            "step": str(step),
            "seconds": repr(self.seconds),
            "settings": json.dumps(asdict(self.settings), sort_keys=True),
        }
        if self.scaler.is_enabled():
            facts["scaler"] = json.dumps(self.scaler.state_dict())
        write_weights(path, facts, tensors)

    def load(self, path: Path) -> int:
        """The step that a checkpoint was written after. DetectorError where it belongs to other settings."""
        facts, tensors = read_weights(path)
        found = _settings_of(facts)
        wanted = json.loads(json.dumps(asdict(self.settings)))
        differing = sorted(k for k in wanted if k not in _FREE and found.get(k) != wanted[k])
        if differing:
            name = differing[0]
            raise DetectorError(f"{path}: {name}: expected {wanted[name]} as set, found {found.get(name)}")
        sections = in_sections(tensors, "weights", "average", "optimiser")
        for section in ("weights", "average"):
            shapes = {name: value.shape for name, value in sections[section].items()}
            if shapes != {name: value.shape for name, value in self.average.items()}:
                raise DetectorError(f"{path}: expected the tensors of {self.detector.name}, found others")
        _copy_into(self.detector, sections["weights"])
        # Copied, so that the averages keep the layout of the weights.
        for name, value in self.average.items():
            value.copy_(sections["average"][name])
        restore(self.optimiser, sections["optimiser"])
        if self.scaler.is_enabled():
            self.scaler.load_state_dict(json.loads(facts["scaler"]))
        self.seconds = float(facts["seconds"])
        return int(facts["step"])


class _Log:
    """CSV of the run, a line a step; a run that goes on drops the lines after its checkpoint.

    Columns: step, seconds, rate, the detector's own loss terms, norm of the gradient. The file is whole at all
    times: a killed run must neither leave half a line, nor a checkpoint with steps that the log lacks.
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
        """All lines so far. DetectorError where they cannot be written."""
        if self._rows and self._writes:
            table = io.StringIO(newline="")
            writer = csv.DictWriter(table, list(self._rows[0]))
            writer.writeheader()
            writer.writerows(self._rows)
            write_whole(self._path, table.getvalue().encode())


def _place() -> tuple[int, int]:
    """Number of this process and how many there are."""
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1


def _wait_for_all() -> None:
    if _place()[1] > 1:
        distributed.barrier()


def _done(step: int, seconds: float, settings: TrainingSettings) -> float:
    if settings.minutes <= 0:
        return step / settings.steps
    shared = [seconds]
    if _place()[1] > 1:  # one clock, so that all have the same rate and stop at the same step
        distributed.broadcast_object_list(shared)
    return max(step / settings.steps, shared[0] / (60 * settings.minutes))


def _settings_of(facts: Mapping[str, str]) -> dict[str, Any]:
    """The settings that a checkpoint was made with; those that it does not know had their defaults."""
    found = json.loads(json.dumps(asdict(TrainingSettings()))) | json.loads(facts.get("settings", "{}"))
    if "bfloat16" in found:  # how checkpoints named it before there were other precisions
        found["precision"] = "bfloat16" if found["bfloat16"] else "float32"
    return found


def in_sections(tensors: Mapping[str, Tensor], *names: str) -> dict[str, dict[str, Tensor]]:
    """A checkpoint's tensors, "SECTION.NAME", by section. KeyError or ValueError where one is in none of these."""
    sections: dict[str, dict[str, Tensor]] = {name: {} for name in names}
    for key, tensor in tensors.items():
        section, name = key.split(".", 1)
        sections[section][name] = tensor
    return sections


def state_of(optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """What an optimiser keeps of each parameter, by "INDEX.NAME"."""
    state = optimiser.state_dict()["state"]
    return {f"{index}.{key}": value.contiguous() for index, kept in state.items() for key, value in kept.items()}


def restore(optimiser: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Give an optimiser of the same parameters what `state_of` told."""
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        index, key = name.split(".", 1)
        state.setdefault(int(index), {})[key] = tensor
    optimiser.load_state_dict(optimiser.state_dict() | {"state": state})


@torch.no_grad()
def _copy_into(detector: Detector, values: Mapping[str, Tensor]) -> None:
    for name, own in detector.state_dict().items():
        own.copy_(values[name])
