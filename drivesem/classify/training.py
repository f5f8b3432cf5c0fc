"""Training a classifier on pictures of objects: its last layer, as in the paper, or all of it."""

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
from drivesem.classify.networks.base import Classifier
from drivesem.classify.networks.loading import save_classifier, to_train
from drivesem.classify.objects.embedded import open_objects
from drivesem.classify.objects.types import SPLITS
from drivesem.classify.pictures import read_pictures, write_pictures
from drivesem.config.commands import ClassifyConfig
from drivesem.evaluation.resampling import wilson
from drivesem.report.terminal import Console, progress_bar, training_progress_bar
from drivesem.run.folder import PRESENTATION, claim_folder, resolve_output_folder
from scene_ir import files

PICTURES = "pictures"
"""Folder in --out where pictures are drawn, unless --data has them."""
RECORD = "training.json"
_FREE = tuple(name for name in PRESENTATION if name != "limit")
"""Settings that a run may be gone on with; --limit says what is learnt."""
_RATES = {"last": 3e-3, "all": 1e-4}
_EMBEDDED_AT_A_TIME = 4
"""More is no faster on a CPU, and VGG-16's maps are so large that the system clears them anew each time."""
_TINY = 1e-12

_Fitted = tuple[list[dict[str, float]], dict[str, float]]
"""What each epoch came to, and the accuracy by split."""


def train_run(config: ClassifyConfig) -> dict[str, Any]:
    """Train, and write the weights and how it went: the JSON's form. Raises UsageError or SceneError."""
    start = time.perf_counter()
    out = resolve_output_folder(config.out, Path("runs") / f"classifier-{config.network}-seed{config.seed}")
    classes = open_objects(config.objects).classes
    generator = torch.Generator().manual_seed(config.seed)
    torch.manual_seed(config.seed)  # dropout draws from torch's own
    anew = config.layers == "all"
    network = to_train(config.network, config.weights, classes, generator, anew).to(config.device)
    claim_folder(out, config, (f"{config.network}.safetensors", RECORD, PICTURES, CHECKPOINT), _FREE)
    folder = Path(config.data) if config.data else out / PICTURES
    failed = {} if config.data else write_pictures(config, folder)[1]
    splits = {name: read_pictures(folder, name, classes) for name in SPLITS}
    images = {name: shown for name, (shown, _) in splits.items()}
    labels = {name: told.to(config.device) for name, (_, told) in splits.items()}
    if config.layers == "last":
        network.eval()
        known = {name: embedded(network, images[name], config.device, f"looking at {name}") for name in SPLITS}
        curve, accuracy = fit_last(network, known, labels, config, generator)
    else:
        curve, accuracy = _fit_all(network, images, labels, config, generator, out / CHECKPOINT)
    path = out / f"{config.network}.safetensors"
    facts = {"accuracy": json.dumps(accuracy), "objects": config.objects or "embedded"}
    save_classifier(network, path, facts)
    counts = {name: len(told) for name, told in labels.items()}
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


def fit_last(
    network: Classifier,
    known: dict[str, Tensor],
    labels: dict[str, Tensor],
    config: ClassifyConfig,
    generator: torch.Generator,
    onward: bool = False,
) -> _Fitted:
    """Fit the last layer to features (N, K) and labels (N,) by split, of which `train` is learnt and `val`
    watched. onward: go on from what the layer is.
    """
    # Fitted to features of mean 0 and deviation 1, whatever the network, and then told in its own.
    deviation, mean = torch.std_mean(known["train"], dim=0)
    deviation = deviation + 1e-3 * deviation.mean() + _TINY
    known = {name: (features - mean) / deviation for name, features in known.items()}
    last = network.last
    if onward:
        with torch.no_grad():
            last.bias.add_(last.weight @ mean)
            last.weight.mul_(deviation)

    def batch(rows: Tensor, _: int) -> tuple[Tensor, Tensor]:
        return last(known["train"][rows]), labels["train"][rows]

    found = _fit(
        last, batch, lambda name, _: _accuracy(last(known[name]), labels[name]), labels, config, generator
    )
    with torch.no_grad():
        last.weight.div_(deviation)
        last.bias.sub_(last.weight @ mean)
    return found


def _fit_all(
    network: Classifier,
    images: dict[str, Tensor],
    labels: dict[str, Tensor],
    config: ClassifyConfig,
    generator: torch.Generator,
    checkpoint: Path,
) -> _Fitted:
    """Fit all layers to pictures (N, 3, H, W) uint8, mirrored in half of all epochs, and labels (N,), by split."""
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    dtype = PRECISIONS[config.precision]

    def batch(rows: Tensor, epoch: int) -> tuple[Tensor, Tensor]:
        network.train()
        shown = _shown(images["train"][rows], config.device, epoch <= config.half)
        mirrored = torch.rand(len(rows), generator=generator) < 0.5
        shown = torch.where(mirrored.to(shown.device).view(-1, 1, 1, 1), shown.flip(-1), shown)
        with torch.autocast(config.device.partition(":")[0], dtype, enabled=dtype != torch.float32):
            scores = network(shown.contiguous(memory_format=torch.channels_last))
        return scores.float(), labels["train"][rows]

    def accuracy(name: str, epoch: int) -> float:
        network.eval()
        half = epoch <= config.half
        features = embedded(network, images[name], config.device, f"looking at {name}", half)
        return _accuracy(network.last(features), labels[name])

    return _fit(network, batch, accuracy, labels, config, generator, checkpoint)


@torch.no_grad()
def _accuracy(scores: Tensor, labels: Tensor) -> float:
    return round(float((scores.argmax(1) == labels).float().mean()), 4)


def _fit(
    module: nn.Module,
    batch: Callable[[Tensor, int], tuple[Tensor, Tensor]],
    accuracy: Callable[[str, int], float],
    labels: Mapping[str, Tensor],
    config: ClassifyConfig,
    generator: torch.Generator,
    checkpoint: Path | None = None,
) -> _Fitted:
    """Adam, with a rate that falls in a half cosine. batch: scores and labels of some of the pictures of `train`,
    in an epoch, of which the first is 1; accuracy: of a split, after an epoch; labels: by split; checkpoint:
    written after each epoch, and gone on from.
    """
    count = len(labels["train"])
    optimiser = torch.optim.Adam(module.parameters(), lr=config.rate or _RATES[config.layers])
    steps = config.epochs * -(-count // config.batch)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    state = _State(module, optimiser, schedule, generator)
    curve = state.load(checkpoint) if checkpoint is not None and checkpoint.is_file() else []
    with progress_bar(Console(stderr=True)) as progress:
        task = progress.add_task("training", total=steps, completed=steps * len(curve) // config.epochs)
        for epoch in range(len(curve) + 1, config.epochs + 1):
            total = 0.0
            for rows in torch.randperm(count, generator=generator).split(config.batch):
                scores, truth = batch(rows, epoch)
                loss = F.cross_entropy(scores, truth)
                optimiser.zero_grad(set_to_none=True)
                loss.backward()
                optimiser.step()
                schedule.step()
                total += float(loss.detach()) * len(rows)
                progress.advance(task)
            curve.append({"epoch": epoch, "loss": round(total / count, 5), "val": accuracy("val", epoch)})
            if checkpoint is not None:
                state.save(checkpoint, curve)
    return curve, {name: accuracy(name, config.epochs + 1) for name in labels}


@dataclass(frozen=True)
class _State:
    """All that the next epoch depends on."""

    module: nn.Module
    optimiser: torch.optim.Optimizer
    schedule: torch.optim.lr_scheduler.LRScheduler
    generator: torch.Generator

    def save(self, path: Path, curve: list[dict[str, float]]) -> None:
        """curve: what each epoch came to so far."""
        tensors = {f"weights.{name}": value.contiguous() for name, value in self.module.state_dict().items()}
        tensors |= {f"optimiser.{name}": value for name, value in optimiser_state(self.optimiser).items()}
        # Dropout draws from torch's own generator, the order of pictures from this one.
        tensors |= {"random.own": self.generator.get_state(), "random.torch": torch.get_rng_state()}
        rates = json.dumps(self.schedule.state_dict())
        write_weights(path, {"curve": json.dumps(curve), "schedule": rates}, tensors)

    def load(self, path: Path) -> list[dict[str, float]]:
        """What each epoch came to before the file was written. Raises DetectorError for what is no such file."""
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
def embedded(network: Classifier, images: Tensor, device: str, title: str, half: bool = False) -> Tensor:
    """Features (N, K) of pictures (N, 3, H, W) uint8, computed once. title: of the bar; half: shown at half their
    size.
    """
    with training_progress_bar(Console(stderr=True)) as progress:
        parts = progress.track(images.split(_EMBEDDED_AT_A_TIME), description=title)
        return torch.cat([network.embed(_shown(part, device, half)) for part in parts])


def _shown(images: Tensor, device: str, half: bool) -> Tensor:
    """Pictures (N, 3, H, W) uint8 as networks see them, or at half their size."""
    pictures = images.to(device).float() / 255
    return F.avg_pool2d(pictures, 2) if half else pictures
