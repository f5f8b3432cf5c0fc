"""Trains a classifier on pictures of objects: its last layer, as in the paper, or all layers."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detectors.base import DetectorError
from detectors.registry import read_weights, write_weights
from detectors.training import CHECKPOINT, PRECISIONS, optimiser_state, restore_optimiser, split_by_section
from drivesem.classify.networks.architectures import RENDERED_MEAN, RENDERED_STD, Classifier
from drivesem.classify.networks.loading import load_for_training, save_classifier
from drivesem.classify.objects.embedded import open_objects
from drivesem.classify.objects.types import SPLITS
from drivesem.classify.pictures import read_pictures, write_pictures
from drivesem.config.commands import ClassifyConfig
from drivesem.evaluation.resampling import wilson
from drivesem.reporting.tables import Console, progress_bar, training_progress_bar
from drivesem.run.folder import PRESENTATION, claim_folder, resolve_output_folder
from scene_ir import files
from scene_ir.errors import RangeError

PICTURES = "pictures"
"""Folder in --out for rendered pictures, without --data."""
RECORD = "training.json"
_FREE = tuple(name for name in PRESENTATION if name != "limit")
"""Settings that may differ when training is continued; --limit selects the training data."""
_MOMENTUM = 0.9
_RATES = {"last": 3e-3, "all": 1e-4}
_FEATURE_BATCH = 4
"""More is not faster on a CPU, where VGG-16's maps are so large that the system clears them each time."""
_TINY = 1e-12

_TrainingHistory = tuple[list[dict[str, float]], dict[str, float]]
"""Loss and accuracy of each epoch, and the final accuracy by split."""


def train_classifier(config: ClassifyConfig) -> dict[str, Any]:
    """Train, write weights and record, and return the record. Raises UsageError or SceneError."""
    start = time.perf_counter()
    out = resolve_output_folder(config.out, Path("runs") / f"classifier-{config.network}-seed{config.seed}")
    classes = open_objects(config.objects).classes
    generator = torch.Generator().manual_seed(config.seed)
    torch.manual_seed(config.seed)  # dropout draws from torch's own
    random_weights = config.layers == "all"
    network = load_for_training(config.network, config.weights, classes, generator, random_weights)
    if config.normalisation == "rendered":
        network.normalise_by(RENDERED_MEAN, RENDERED_STD)
    network = network.to(config.device)
    claim_folder(out, config, (f"{config.network}.safetensors", RECORD, PICTURES, CHECKPOINT), _FREE)
    folder = Path(config.data) if config.data else out / PICTURES
    failed = {} if config.data else write_pictures(config, folder)[1]
    splits = {name: read_pictures(folder, name, classes) for name in SPLITS}
    images = {name: pictures for name, (pictures, _) in splits.items()}
    labels = {name: truth.to(config.device) for name, (_, truth) in splits.items()}
    if config.layers == "last":
        network.eval()
        features = {
            name: compute_features(network, images[name], config.device, f"features of {name}") for name in SPLITS
        }
        curve, accuracy = train_last_layer(network, features, labels, config, generator)
    else:
        curve, accuracy = train_all_layers(network, images, labels, config, generator, out / CHECKPOINT)
    path = out / f"{config.network}.safetensors"
    facts = {"accuracy": json.dumps(accuracy), "objects": config.objects or "embedded"}
    save_classifier(network, path, facts)
    counts = {name: len(truth) for name, truth in labels.items()}
    data = {
        "out": str(out),
        "weights": str(path),
        "network": config.network,
        "layers": config.layers,
        "pictures": counts,
        "accuracy": accuracy,
        "intervals": {name: wilson(round(accuracy[name] * count), count) for name, count in counts.items()},
        "epochs": curve,
        "frames_failed": failed,
        "seconds": round(time.perf_counter() - start, 3),
    }
    files.write_json(out / RECORD, data)
    return data


def train_last_layer(
    network: Classifier,
    features: dict[str, Tensor],
    labels: dict[str, Tensor],
    config: ClassifyConfig,
    generator: torch.Generator,
    continued: bool = False,
) -> _TrainingHistory:
    """Train the last layer.

    Args:
        network: The network.
        features: Features (N, K) by split: trained on `train`, evaluated on the others.
        labels: Labels (N,) by split.
        config: Settings.
        generator: Generator of the order of samples.
        continued: Begin with the present weights.
    """
    # Train on normalised features, and convert the weights afterwards.
    deviation, mean = torch.std_mean(features["train"], dim=0)
    deviation = deviation + 1e-3 * deviation.mean() + _TINY
    features = {name: (values - mean) / deviation for name, values in features.items()}
    last = network.last
    if continued:
        with torch.no_grad():
            last.bias.add_(last.weight @ mean)
            last.weight.mul_(deviation)

    def batch(rows: Tensor, _: int) -> tuple[Tensor, Tensor]:
        return last(features["train"][rows]), labels["train"][rows]

    def evaluate(name: str, _: int) -> float:
        return _accuracy(last(features[name]), labels[name])

    history = _train(last, batch, evaluate, labels, config, generator)
    with torch.no_grad():
        last.weight.div_(deviation)
        last.bias.sub_(last.weight @ mean)
    return history


def train_all_layers(
    network: Classifier,
    images: dict[str, Tensor],
    labels: dict[str, Tensor],
    config: ClassifyConfig,
    generator: torch.Generator,
    checkpoint: Path,
) -> _TrainingHistory:
    """Train all layers on pictures, each mirrored with probability 1/2.

    Args:
        network: The network.
        images: Pictures (N, 3, H, W) uint8 by split: trained on `train`, evaluated on the others.
        labels: Labels (N,) by split.
        config: Settings.
        generator: Generator of the order of samples.
        checkpoint: File that is written after each epoch, and continued from.
    """
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    dtype = PRECISIONS[config.precision]

    def batch(rows: Tensor, epoch: int) -> tuple[Tensor, Tensor]:
        network.train()
        pictures = _to_float(images["train"][rows], config.device, epoch <= config.half)
        mirrored = torch.rand(len(rows), generator=generator) < 0.5
        pictures = torch.where(mirrored.to(pictures.device).view(-1, 1, 1, 1), pictures.flip(-1), pictures)
        with torch.autocast(config.device.partition(":")[0], dtype, enabled=dtype != torch.float32):
            scores = network(pictures.contiguous(memory_format=torch.channels_last))
        return scores.float(), labels["train"][rows]

    def evaluate(name: str, epoch: int) -> float:
        network.eval()
        half = epoch <= config.half
        features = compute_features(network, images[name], config.device, f"features of {name}", half)
        return _accuracy(network.last(features), labels[name])

    return _train(network, batch, evaluate, labels, config, generator, checkpoint)


@torch.no_grad()
def _accuracy(scores: Tensor, labels: Tensor) -> float:
    return round(float((scores.argmax(1) == labels).float().mean()), 4)


def _train(
    module: nn.Module,
    batch: Callable[[Tensor, int], tuple[Tensor, Tensor]],
    evaluate: Callable[[str, int], float],
    labels: Mapping[str, Tensor],
    config: ClassifyConfig,
    generator: torch.Generator,
    checkpoint: Path | None = None,
) -> _TrainingHistory:
    """Train with Adam and a cosine schedule of the learning rate, or with SGD at one rate.

    Args:
        module: The trained layers.
        batch: Scores and labels of rows of `train` in an epoch, from 1.
        evaluate: Accuracy on a split after an epoch.
        labels: Labels by split.
        config: Settings.
        generator: Generator of the order of samples.
        checkpoint: File that is written after each epoch, and continued from.
    """
    count = len(labels["train"])
    rate, steps = config.rate or _RATES[config.layers], config.epochs * -(-count // config.batch)
    if config.optimiser == "sgd":
        optimiser: torch.optim.Optimizer = torch.optim.SGD(module.parameters(), lr=rate, momentum=_MOMENTUM)
        schedule: torch.optim.lr_scheduler.LRScheduler = torch.optim.lr_scheduler.ConstantLR(optimiser, 1.0)
    else:
        optimiser = torch.optim.Adam(module.parameters(), lr=rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    state = _ClassifierTrainingState(module, optimiser, schedule, generator)
    curve = state.load(checkpoint) if checkpoint is not None and checkpoint.is_file() else []
    with progress_bar(Console(stderr=True)) as progress:
        task = progress.add_task("training", total=steps, completed=steps * len(curve) // config.epochs)
        for epoch in range(len(curve) + 1, config.epochs + 1):
            total = 0.0
            for rows in torch.randperm(count, generator=generator).split(config.batch):
                scores, truth = batch(rows, epoch)
                loss = F.cross_entropy(scores, truth)
                if not bool(loss.isfinite()):
                    raise RangeError(
                        f"loss in epoch {epoch}", "a finite number; a lower --rate may help", float(loss.detach())
                    )
                optimiser.zero_grad(set_to_none=True)
                loss.backward()
                optimiser.step()
                schedule.step()
                total += float(loss.detach()) * len(rows)
                progress.advance(task)
            curve.append({"epoch": epoch, "loss": round(total / count, 5), "val": evaluate("val", epoch)})
            if checkpoint is not None:
                state.save(checkpoint, curve)
    return curve, {name: evaluate(name, config.epochs + 1) for name in labels}


@dataclass(frozen=True)
class _ClassifierTrainingState:
    """State of the training after an epoch."""

    module: nn.Module
    optimiser: torch.optim.Optimizer
    schedule: torch.optim.lr_scheduler.LRScheduler
    generator: torch.Generator

    def save(self, path: Path, curve: list[dict[str, float]]) -> None:
        """Write a checkpoint with the loss and accuracy of all epochs so far."""
        tensors = {f"weights.{name}": value.contiguous() for name, value in self.module.state_dict().items()}
        tensors |= {f"optimiser.{name}": value for name, value in optimiser_state(self.optimiser).items()}
        # Dropout uses torch's global generator, the order of pictures this one.
        tensors |= {"random.own": self.generator.get_state(), "random.torch": torch.get_rng_state()}
        rates = json.dumps(self.schedule.state_dict())
        write_weights(path, {"curve": json.dumps(curve), "schedule": rates}, tensors)

    def load(self, path: Path) -> list[dict[str, float]]:
        """Load a checkpoint and return the loss and accuracy of its epochs. Raises DetectorError if it is none."""
        facts, tensors = read_weights(path)
        try:
            parts = split_by_section(tensors, "weights", "optimiser", "random")
            self.module.load_state_dict(parts["weights"])
            restore_optimiser(self.optimiser, parts["optimiser"])
            self.schedule.load_state_dict(json.loads(facts["schedule"]))
            self.generator.set_state(parts["random"]["own"])
            torch.set_rng_state(parts["random"]["torch"])
            curve: list[dict[str, float]] = json.loads(facts["curve"])
            if not isinstance(curve, list):  # pyright: ignore[reportUnnecessaryIsInstance]
                raise TypeError(f"curve: {curve}")
            for group in self.optimiser.param_groups:
                group["lr"] = float(self.schedule.get_last_lr()[0])
        except (KeyError, TypeError, AttributeError, ValueError, RuntimeError) as error:
            raise DetectorError(f"{path}: expected a checkpoint of this network, found {error!r:.120}") from error
        return curve


@torch.no_grad()
def compute_features(network: Classifier, images: Tensor, device: str, title: str, half: bool = False) -> Tensor:
    """Compute the features of pictures.

    Args:
        network: The network.
        images: Pictures (N, 3, H, W) uint8.
        device: torch device.
        title: Title of the progress bar.
        half: Halve the pictures first.

    Returns:
        Features (N, K).
    """
    with training_progress_bar(Console(stderr=True)) as progress:
        parts = progress.track(images.split(_FEATURE_BATCH), description=title)
        return torch.cat([network.embed(_to_float(part, device, half)) for part in parts])


def _to_float(images: Tensor, device: str, half: bool) -> Tensor:
    """Convert pictures (N, 3, H, W) uint8 to [0, 1], optionally at half the size."""
    pictures = images.to(device).float() / 255
    return F.avg_pool2d(pictures, 2) if half else pictures
