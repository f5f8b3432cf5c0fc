"""Detectors by name or weights file, ready to be attacked: frozen, in eval mode, channels-last."""

from __future__ import annotations

import json
import os
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from detectors.base import Detector, DetectorError, Predictor
from detectors.squeezedet import SqueezeDet
from detectors.types import CLASSES

ARCHITECTURES: dict[str, type[SqueezeDet]] = {"squeezedet": SqueezeDet}
"""Name of an architecture, as weights files carry it in their metadata, and its class."""

SHIPPED = {"squeezedet": Path(__file__).parent / "weights" / "squeezedet.safetensors"}
"""Detectors that come with the package."""


ONNX = "onnx:"
"""Before the path of an ONNX graph: onnx:FILE."""


def load_predictor(
    name_or_path: str | Path, device: str | torch.device = "cpu", tiling: str = "auto"
) -> Predictor:
    """A detector that is only asked what it finds: `onnx:FILE`, or what `load_detector` takes.

    device: of the latter; graphs run on the CPU. tiling: of a graph, "auto" or "off" (see
    `detectors.adapters.onnx`). Raises DetectorError as `load_detector` does, and for a file that is no graph, a
    graph of no known kind, or where ONNX Runtime is missing.
    """
    if not str(name_or_path).startswith(ONNX):
        return load_detector(name_or_path, device)
    from detectors.adapters.onnx import OnnxPredictor

    return OnnxPredictor(Path(str(name_or_path).removeprefix(ONNX)), tiling)


def load_detector(
    name_or_path: str | Path,
    device: str | torch.device = "cpu",
    gradient_precision: torch.dtype | None = None,
) -> Detector:
    """The shipped detector of that name, or the one in a `.safetensors` file; frozen, eval mode, channels-last.

    gradient_precision: torch.bfloat16 or, on GPUs, torch.float16, for passes that a gradient follows; without it,
    all compute in float32. Detections and losses that are judged always do.

    Raises DetectorError for a name that is not known, a file that is missing or damaged, and weights that belong
    to another architecture; the message names the file, what was expected and what was found.
    """
    if str(name_or_path).startswith(ONNX):
        raise DetectorError(f"detector: expected one with gradients, found {str(name_or_path)!r}, which has none")
    path = SHIPPED.get(str(name_or_path), Path(name_or_path))
    if str(name_or_path) not in SHIPPED and path.suffix != ".safetensors":
        known = ", ".join(sorted(SHIPPED))
        raise DetectorError(
            f"detector: expected one of {known} or a path.safetensors, found {str(name_or_path)!r}"
        )
    if not path.is_file():
        raise DetectorError(f"{path}: expected a weights file, found none")
    metadata, tensors = read_weights(path)
    architecture = metadata.get("architecture", "squeezedet")
    if architecture not in ARCHITECTURES:
        known = ", ".join(sorted(ARCHITECTURES))
        raise DetectorError(f"{path}: expected architecture {known}, found {architecture!r}")
    try:
        classes = tuple(json.loads(metadata.get("classes", json.dumps(CLASSES))))
        t_star = float(metadata.get("t_star", "0.5"))
    except (ValueError, TypeError) as error:
        raise DetectorError(f"{path}: expected metadata classes (list) and t_star (number): {error}") from None
    detector = ARCHITECTURES[architecture](classes=classes, t_star=t_star)
    _load_into(detector, tensors, path)
    detector.requires_grad_(False)
    detector.gradient_precision = gradient_precision
    return detector.to(device=device, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]


def save_detector(detector: Detector, path: Path, facts: dict[str, str] | None = None) -> None:
    """Write weights as float16 with name, classes, t_star and further facts as metadata; atomic."""
    metadata = {
        "architecture": detector.name,
        "classes": json.dumps(list(detector.classes)),
        "t_star": f"{detector.t_star:.6g}",
        **(facts or {}),
    }
    tensors = {k: v.detach().cpu().contiguous().to(torch.float16) for k, v in detector.state_dict().items()}
    write_weights(path, metadata, tensors)


def read_weights(path: Path) -> tuple[dict[str, str], dict[str, torch.Tensor]]:
    """Metadata and tensors of a safetensors file; DetectorError where it is none."""
    try:
        with safe_open(path, framework="pt") as file:
            return file.metadata() or {}, {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise DetectorError(f"{path}: expected a safetensors file, found {error}") from None


def write_weights(path: Path, metadata: dict[str, str], tensors: dict[str, torch.Tensor]) -> None:
    """Write a safetensors file, so that a reader sees the old or the new one, never a part. Makes the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".partial")
    temporary.write_bytes(save(tensors, metadata))
    os.replace(temporary, path)


def _load_into(detector: Detector, tensors: dict[str, torch.Tensor], path: Path) -> None:
    expected = detector.state_dict()
    missing, unexpected = sorted(expected.keys() - tensors.keys()), sorted(tensors.keys() - expected.keys())
    if missing or unexpected:
        raise DetectorError(
            f"{path}: expected the {len(expected)} tensors of {detector.name}, found "
            f"{len(missing)} missing{_first(missing)} and {len(unexpected)} unexpected{_first(unexpected)}"
        )
    for key, tensor in tensors.items():
        if tensor.shape != expected[key].shape:
            raise DetectorError(
                f"{path}: {key}: expected shape {tuple(expected[key].shape)} of {detector.name} with "
                f"{len(detector.classes)} classes, found {tuple(tensor.shape)}"
            )
        if not bool(torch.isfinite(tensor).all()):
            raise DetectorError(f"{path}: {key}: expected finite numbers, found NaN or infinity")
    detector.load_state_dict(tensors)


def _first(keys: list[str]) -> str:
    return f" ({keys[0]}{', ...' if len(keys) > 1 else ''})" if keys else ""
