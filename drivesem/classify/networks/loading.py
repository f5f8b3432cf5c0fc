"""Classifiers by name or file: ready to be attacked, or to be trained on."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from detectors.base import prepare_for_inference
from detectors.files import read_state
from detectors.registry import SHIPPED as DETECTORS
from detectors.registry import half_precision_state, parse_class_names, write_weights
from detectors.squeezedet import SqueezeDet
from drivesem.classify.networks.base import Classifier
from drivesem.classify.networks.libraries import PREFIXES, LibraryClassifier
from drivesem.classify.networks.published import VGG16, PooledVGG16, ResNet50, SqueezeNet
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.weights import load_weights, read_weights

ARCHITECTURES: dict[str, type[Classifier]] = {
    kind.architecture: kind for kind in (SqueezeNet, VGG16, PooledVGG16, ResNet50)
}
"""By the name that weights files carry."""
SHIPPED = DETECTORS[SqueezeDet.name].parent / "squeezenet-objects.safetensors"
"""`squeezenet`, for the embedded objects."""
_TORCH_FILES = (".pth", ".pt", ".bin")


def load_classifier(name_or_path: str, classes: Sequence[str], device: str = "cpu") -> Classifier:
    """The shipped classifier, `squeezenet`, or one that `drivesem classify train` wrote; frozen, in eval mode.

    Raises FormatError for a file that is none, is damaged, is another network's, or tells other classes apart.
    """
    path = SHIPPED if name_or_path == SqueezeNet.architecture else Path(name_or_path)
    if path.suffix != ".safetensors":
        trained = "weights that drivesem classify train wrote (.safetensors)"
        expected = f"{SqueezeNet.architecture}, {trained}, or an ONNX file (.onnx)"
        found = name_or_path
        if found.startswith(PREFIXES):
            found += ", which tells ImageNet's classes apart: train it on these (classify train --network)"
        raise FormatError("--network", expected, found)
    metadata, tensors = _read(path)
    network = _made(metadata.get("architecture"), classes_of(path, metadata), f"{path}: architecture")
    if network.classes != tuple(classes):
        expected = f"one for the {len(classes)} classes {', '.join(classes)}"
        raise FormatError(str(path), expected, f"one for {', '.join(network.classes)}")
    load_weights(network, tensors, path)
    return prepare_for_inference(network, device)


def to_train(
    architecture: str, weights: str | None, classes: Sequence[str], generator: torch.Generator, anew: bool = False
) -> Classifier:
    """A network with a new last layer for `classes`, and all else from a file: torchvision's (.pth), or a
    safetensors file by the same names. squeezenet needs none: it begins with the shipped one's convolutions. anew:
    others begin with random weights where no file is named.

    timm:NAME and torchvision:NAME have the library's own without a file. Raises FormatError naming file and tensor
    where the file is another network's, and for an unknown name.
    """
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(generator.initial_seed())
        network = _made(architecture, classes, "--network", pretrained=weights is None)
    usual = SHIPPED if isinstance(network, SqueezeNet) else None
    path = Path(weights) if weights is not None else usual
    if path is None and isinstance(network, LibraryClassifier):
        network.retarget(classes, generator)
        return network
    if path is None and anew:
        return network
    if path is None:
        raise FormatError("--weights", f"a file with weights of {architecture}", "nothing")
    tensors = {network.own_name(key): tensor for key, tensor in _tensors(path).items()}
    network.retarget(classes, generator)
    own, name = network.state_dict(), network.head
    # Of the file's own last layer, which tells other classes apart, nothing is used.
    replaced = (name, network.published_head)
    kept = {key: tensor for key, tensor in tensors.items() if key.rpartition(".")[0] not in replaced}
    load_weights(network, kept | {f"{name}.{part}": own[f"{name}.{part}"] for part in ("weight", "bias")}, path)
    return network


def save_classifier(network: Classifier, path: Path, facts: Mapping[str, str]) -> None:
    """Write weights as float16, what was counted in training as float32."""
    tensors = {key: value for key, value in half_precision_state(network).items() if value.is_floating_point()}
    metadata = {"architecture": network.architecture, "classes": json.dumps(list(network.classes)), **facts}
    write_weights(path, metadata, tensors)


def _read(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    """As `read_weights`; the shipped file is held against its model card first."""
    if path == SHIPPED:
        files.check_model_card(path, files.read_bytes(path))
    return read_weights(path)


def classes_of(path: Path, metadata: Mapping[str, str]) -> tuple[str, ...]:
    """The classes that a weights file is for. Raises FormatError."""
    try:
        return parse_class_names(json.loads(metadata.get("classes", "")))
    except ValueError as error:
        raise FormatError(f"{path}: classes", "a list of names", repr(metadata.get("classes"))[:60]) from error


def _made(architecture: str | None, classes: Sequence[str], where: str, *, pretrained: bool = False) -> Classifier:
    """The network of that name, with any weights, or with a library's own."""
    if architecture is not None and architecture.startswith(PREFIXES):
        return LibraryClassifier(architecture, classes, pretrained=pretrained)
    if architecture not in ARCHITECTURES:
        known = ", ".join([*ARCHITECTURES, *(f"{prefix}NAME" for prefix in PREFIXES)])
        raise FormatError(where, f"one of {known}", architecture)
    return ARCHITECTURES[architecture](classes)


def _tensors(path: Path) -> dict[str, Tensor]:
    """Floating tensors of a weights file. Raises FormatError, or DetectorError for what is none."""
    if path.suffix not in _TORCH_FILES:
        return _read(path)[1]
    loaded = read_state(path, "tensors by name, as torch.save writes them")
    if not isinstance(loaded, dict) or not all(isinstance(tensor, Tensor) for tensor in loaded.values()):
        raise FormatError(str(path), "tensors by name (a state_dict)", type(loaded).__name__)
    return {str(name): tensor for name, tensor in loaded.items() if tensor.is_floating_point()}
