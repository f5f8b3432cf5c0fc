"""Loads classifiers by name or file, to attack or to train, and saves them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from detectors.adapters import onnx
from detectors.adapters.spec import NetworkSpec, fit_images, load_settings, normalise_images
from detectors.base import DetectorError, prepare_for_inference
from detectors.files import read_state
from detectors.registry import SHIPPED as DETECTORS
from detectors.registry import half_precision_state, parse_class_names, write_weights
from detectors.squeezedet import SqueezeDet
from drivesem.classify.networks.architectures import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    PREFIXES,
    VGG16,
    Classifier,
    ImageClassifier,
    LibraryClassifier,
    PooledVGG16,
    ResNet50,
    SqueezeNet,
)
from scene_ir import files
from scene_ir.errors import FormatError, RangeError
from scene_ir.weights import load_weights, read_weights

ARCHITECTURES: dict[str, type[Classifier]] = {
    kind.architecture: kind for kind in (SqueezeNet, VGG16, PooledVGG16, ResNet50)
}
"""Networks by the name in weights files."""
SHIPPED = DETECTORS[SqueezeDet.name].parent / "squeezenet-objects.safetensors"
"""Weights of `squeezenet`, for the embedded objects."""
_NORMALISATION = "normalisation"
"""Key of mean and deviation in weights files."""
_TORCH_FILES = (".pth", ".pt", ".bin")


def open_network(name_or_path: str, classes: Sequence[str], device: str) -> ImageClassifier:
    """Load a network to attack.

    Args:
        name_or_path: As for `load_classifier`, or an ONNX file.
        classes: Names of the classes.
        device: torch device.

    Raises:
        FormatError: As `load_classifier`.
    """
    if Path(name_or_path).suffix == ".onnx":
        return OnnxClassifier(Path(name_or_path), classes)
    return load_classifier(name_or_path, classes, device)


def load_classifier(name_or_path: str, classes: Sequence[str], device: str = "cpu") -> Classifier:
    """Load a classifier, frozen and in eval mode.

    Args:
        name_or_path: `squeezenet`, the shipped one, or a file of `drivesem classify train`.
        classes: Names of the classes it must have.
        device: torch device.

    Raises:
        FormatError: A file that is missing, damaged, or for another network or other classes.
    """
    path = SHIPPED if name_or_path == SqueezeNet.architecture else Path(name_or_path)
    if path.suffix != ".safetensors":
        trained = "weights that drivesem classify train wrote (.safetensors)"
        expected = f"{SqueezeNet.architecture}, {trained}, or an ONNX file (.onnx)"
        found = name_or_path
        if found.startswith(PREFIXES):
            found += ", which has ImageNet's classes: train it on these (classify train --network)"
        raise FormatError("--network", expected, found)
    metadata, tensors = _read(path)
    network = _create_network(metadata.get("architecture"), parse_classes(path, metadata), f"{path}: architecture")
    if network.classes != tuple(classes):
        expected = f"one for the {len(classes)} classes {', '.join(classes)}"
        raise FormatError(str(path), expected, f"one for {', '.join(network.classes)}")
    load_weights(network, tensors, path)
    if _NORMALISATION in metadata:
        try:
            network.normalise_by(*json.loads(metadata[_NORMALISATION]))
        except (ValueError, TypeError, RuntimeError) as error:
            found = repr(metadata[_NORMALISATION])[:60]
            raise FormatError(f"{path}: {_NORMALISATION}", "mean and deviation of RGB", found) from error
    return prepare_for_inference(network, device)


def load_for_training(
    architecture: str,
    weights: str | None,
    classes: Sequence[str],
    generator: torch.Generator,
    random_weights: bool = False,
) -> Classifier:
    """Load a network to train, with a new last layer.

    Args:
        architecture: Key of `ARCHITECTURES`, `timm:NAME` or `torchvision:NAME`.
        weights: torchvision's file (.pth), or a safetensors file with the same names. By default `squeezenet` begins
            with the shipped convolutions, and a library's network with the library's weights.
        classes: Names of the classes.
        generator: Generator of the new layer.
        random_weights: Begin with random weights if there is no other default.

    Raises:
        FormatError: An unknown name, or a file for another network.
    """
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(generator.initial_seed())
        network = _create_network(architecture, classes, "--network", pretrained=weights is None)
    default = SHIPPED if isinstance(network, SqueezeNet) else None
    path = Path(weights) if weights is not None else default
    if path is None and isinstance(network, LibraryClassifier):
        network.replace_last_layer(classes, generator)
        return network
    if path is None and random_weights:
        return network
    if path is None:
        raise FormatError("--weights", f"a file with weights of {architecture}", "nothing")
    tensors = {network.local_name(key): tensor for key, tensor in _read_tensors(path).items()}
    network.replace_last_layer(classes, generator)
    state, head = network.state_dict(), network.head
    # The file's last layer is for other classes.
    body = {key: t for key, t in tensors.items() if key.rpartition(".")[0] not in (head, network.published_head)}
    load_weights(network, body | {f"{head}.{part}": state[f"{head}.{part}"] for part in ("weight", "bias")}, path)
    return network


def save_classifier(network: Classifier, path: Path, facts: Mapping[str, str]) -> None:
    """Write weights as float16, and batch statistics as float32.

    Args:
        network: The network.
        path: The file.
        facts: Further metadata.
    """
    tensors = {key: value for key, value in half_precision_state(network).items() if value.is_floating_point()}
    metadata = {"architecture": network.architecture, "classes": json.dumps(list(network.classes)), **facts}
    metadata[_NORMALISATION] = json.dumps([network.mean.flatten().tolist(), network.std.flatten().tolist()])
    write_weights(path, metadata, tensors)


def _read(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Read weights; the shipped file is checked against its model card first."""
    if path == SHIPPED:
        files.check_model_card(path, files.read_bytes(path))
    return read_weights(path)


def parse_classes(path: Path, metadata: Mapping[str, str]) -> tuple[str, ...]:
    """Parse the classes in a file's metadata. Raises FormatError."""
    try:
        return parse_class_names(json.loads(metadata.get("classes", "")))
    except ValueError as error:
        raise FormatError(f"{path}: classes", "a list of names", repr(metadata.get("classes"))[:60]) from error


def _create_network(
    architecture: str | None, classes: Sequence[str], where: str, *, pretrained: bool = False
) -> Classifier:
    """Create a network by name; `where` names the setting in errors."""
    if architecture is not None and architecture.startswith(PREFIXES):
        return LibraryClassifier(architecture, classes, pretrained=pretrained)
    if architecture not in ARCHITECTURES:
        known = ", ".join([*ARCHITECTURES, *(f"{prefix}NAME" for prefix in PREFIXES)])
        raise FormatError(where, f"one of {known}", architecture)
    return ARCHITECTURES[architecture](classes)


def _read_tensors(path: Path) -> dict[str, Tensor]:
    """Read the floating tensors of a weights file. Raises FormatError, or DetectorError if it is none."""
    if path.suffix not in _TORCH_FILES:
        return _read(path)[1]
    loaded = read_state(path, "tensors by name, as torch.save writes them")
    if not isinstance(loaded, dict) or not all(isinstance(tensor, Tensor) for tensor in loaded.values()):
        raise FormatError(str(path), "tensors by name (a state_dict)", type(loaded).__name__)
    return {str(name): tensor for name, tensor in loaded.items() if tensor.is_floating_point()}


_SETTINGS = ("size", "resize", "channels", "scale", "mean", "std", "classes")
"""Settings of the YAML file that apply to classifiers."""


class OnnxClassifier:
    """`ImageClassifier` of an ONNX file with one output of logits (B, C).

    An optional YAML file of the same name sets another order of `classes`, or another preprocessing than ImageNet's
    normalisation.
    """

    differentiable = False

    def __init__(self, path: Path, classes: Sequence[str]) -> None:
        """Open a file for these classes. Raises FormatError if it is damaged, or is for other classes."""
        try:
            session = onnx.open_session(path)
            settings = load_settings(path, None)
        except DetectorError as error:
            field, _, rest = str(error).partition(": ")
            raise FormatError(field, "an ONNX classifier", rest) from error
        unknown = settings.keys() - set(_SETTINGS)
        if unknown:
            raise FormatError(
                str(path.with_suffix(".yaml")), f"settings among {', '.join(_SETTINGS)}", min(unknown)
            )
        shape = list(session.get_inputs()[0].shape)
        outputs = [list(output.shape) for output in session.get_outputs()]
        if len(session.get_inputs()) != 1 or len(shape) != 4 or shape[1] != 3:
            raise FormatError(f"{path}: input", "one batch of pictures (B, 3, H, W)", shape)
        if isinstance(shape[0], int) and shape[0] != 1:
            raise FormatError(f"{path}: input", "a batch of any size, or of one picture", shape)
        if len(outputs) != 1 or len(outputs[0]) != 2 or outputs[0][1] not in (len(classes), None):
            raise FormatError(f"{path}: output", f"one score for each of the {len(classes)} classes", outputs)
        order = tuple(settings.pop("classes", classes))
        if sorted(order) != sorted(classes):
            raise FormatError(f"{path}: classes", ", ".join(classes), ", ".join(order))
        sides = [side if isinstance(side, int) else None for side in shape[2:]]
        fixed = None if None in sides else tuple(sides)
        size = settings.get("size")
        if size is not None and not all(
            side in (None, setting) for side, setting in zip(sides, size, strict=True)
        ):
            raise FormatError(
                f"{path.with_suffix('.yaml')}: size", f"{shape[2]} x {shape[3]}, as the graph has", size
            )
        defaults: dict[str, Any] = {"resize": "stretch", "mean": IMAGENET_MEAN, "std": IMAGENET_STD, "size": fixed}
        self._spec = NetworkSpec(**(defaults | settings))
        self._session, self._input = session, session.get_inputs()[0].name
        self._order = [order.index(name) for name in classes]
        self.classes = tuple(classes)

    def __call__(self, images: Tensor) -> Tensor:
        """Compute scores before softmax (B, C) of pictures (B, 3, H, W), RGB in [0, 1], without gradient."""
        inputs = normalise_images(fit_images(images.detach().float().cpu(), self._spec)[0], self._spec)
        rows = [self._session.run(None, {self._input: one.numpy()})[0] for one in inputs.contiguous().split(1)]
        scores = torch.cat([torch.from_numpy(row) for row in rows])[:, self._order]
        if not bool(scores.isfinite().all()):
            raise RangeError("the network's scores", "finite numbers", "others")
        return scores.to(images.device)
