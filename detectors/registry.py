"""Detectors by name or weights file, ready to be attacked: frozen, in eval mode, channels-last."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn

from detectors import ensemble, planted
from detectors.adapters import choose
from detectors.base import Detector, DetectorError, Predictor, compute_exactly, ready
from detectors.reading import read_file, read_text
from detectors.squeezedet import SqueezeDet, SqueezeDetPlus
from detectors.types import CLASSES
from detectors.whole import write_whole
from detectors.yolov3 import cfg
from detectors.yolov3.yolov3 import YoloV3, YoloV3Slim, YoloV3Tiny

_KINDS = (SqueezeDet, SqueezeDetPlus, YoloV3, YoloV3Tiny, YoloV3Slim)
ARCHITECTURES: dict[str, type[SqueezeDet] | type[YoloV3]] = {kind.name: kind for kind in _KINDS}
"""Name of an architecture, as weights files carry it in their metadata, and its class."""

SHIPPED = {
    name: Path(__file__).parent / "weights" / f"{name}.safetensors" for name in (SqueezeDet.name, YoloV3Slim.name)
}
"""Detectors that come with the package."""


ONNX = "onnx:"
"""Before the path of an ONNX graph: onnx:FILE."""

DARKNET = "darknet:"
"""Before Darknet's files: darknet:FILE.cfg,FILE.weights, or the former alone where the latter has its name."""
_MOST_CLASSES = 10_000
_MOST_ANCHORS = 1000
"""Of a cell: each is a candidate at every place of the picture."""


def code_of(name_or_path: str | Path) -> str | None:
    """The module or file whose code loading a detector of that name would run; None where there is only data."""
    name = str(name_or_path)
    if name.startswith(planted.PREFIX):
        return code_of(planted.parts_of(name)[1])
    if name.startswith(ensemble.PREFIX):
        return next(filter(None, map(code_of, ensemble.names_of(name))), None)
    return name.partition(":")[2] if choose.kind_of(name) in choose.RUNS_CODE else None


def load_predictor(
    name_or_path: str | Path, device: str | torch.device = "cpu", tiling: str = "auto"
) -> Predictor:
    """A detector that is only asked what it finds: `onnx:FILE[,SPEC.yaml]`, or what `load_detector` takes.

    device: of the latter; graphs run on the CPU. tiling: of a graph, "auto" or "off" (see
    `detectors.adapters.onnx`). Raises DetectorError as `load_detector` does, and for a file that is no graph, a
    graph of no known kind, or where ONNX Runtime is missing.
    """
    if str(name_or_path).startswith(planted.PREFIX):
        fault, inner = planted.parts_of(str(name_or_path))
        return planted.with_fault(load_predictor(inner, device, tiling), fault)
    if str(name_or_path).startswith(ONNX):
        return choose.open_predictor(str(name_or_path), tiling)
    return load_detector(name_or_path, device)


def load_detector(
    name_or_path: str | Path,
    device: str | torch.device = "cpu",
    gradient_precision: torch.dtype | None = None,
) -> Detector:
    """The shipped detector of that name, or the one in a `.safetensors` file, or `darknet:FILE.cfg,FILE.weights`;
    frozen, eval mode, channels-last. Or one from elsewhere (see `detectors.adapters.choose`), always in float32;
    any of these with a fault that is known, `planted:FAULT@DETECTOR` (see `detectors.planted`); or several with
    the same classes as one, `ensemble:A+B` (see `detectors.ensemble`).

    gradient_precision: torch.bfloat16 or, on GPUs, torch.float16, for passes that a gradient follows; without it,
    all compute in float32. Detections and losses that are judged always do.

    Raises DetectorError for a name that is not known, a file that is missing or damaged, and weights that belong
    to another architecture; the message names the file, what was expected and what was found.
    """
    compute_exactly(device)
    if str(name_or_path).startswith(planted.PREFIX):
        fault, inner = planted.parts_of(str(name_or_path))
        return planted.PlantedDetector(load_detector(inner, device, gradient_precision), fault).requires_grad_(
            False
        )
    if str(name_or_path).startswith(ensemble.PREFIX):
        names = ensemble.names_of(str(name_or_path))
        members = [load_detector(name, device, gradient_precision) for name in names]
        return ensemble.Ensemble(members).requires_grad_(False)
    if choose.kind_of(str(name_or_path)) is not None:
        if gradient_precision is not None:
            raise DetectorError(f"{name_or_path}: expected float32 for its gradients, found {gradient_precision}")
        return choose.open_detector(str(name_or_path)).to(device)
    if str(name_or_path).startswith(DARKNET):
        from detectors.yolov3 import darknet

        files = [Path(part) for part in str(name_or_path).removeprefix(DARKNET).split(",", 1)]
        return _ready(darknet.load(*files), device, gradient_precision)
    path = SHIPPED.get(str(name_or_path), Path(name_or_path))
    if str(name_or_path) not in SHIPPED and path.suffix != ".safetensors":
        known = ", ".join(sorted(SHIPPED))
        kinds = ", ".join([DARKNET, *(f"{kind}:" for kind in choose.KINDS), ensemble.PREFIX])
        raise DetectorError(
            f"detector: expected {known}, a path.safetensors, or what begins with {kinds} or "
            f"{planted.PREFIX}, found {str(name_or_path)!r}"
        )
    if not path.is_file():
        raise DetectorError(f"{path}: expected a weights file, found none")
    if str(name_or_path) in SHIPPED:
        _check_card(path)
    metadata, tensors = read_weights(path)
    architecture = metadata.get("architecture", "squeezedet")
    if architecture not in ARCHITECTURES:
        known = ", ".join(sorted(ARCHITECTURES))
        raise DetectorError(f"{path}: expected architecture {known}, found {architecture!r}")
    try:
        settings: dict[str, Any] = {
            "classes": class_names(json.loads(metadata.get("classes", json.dumps(CLASSES)))),
            "t_star": float(metadata.get("t_star", "0.5")),
        }
        if not 0 < settings["t_star"] <= 1:
            raise ValueError(f"t_star: expected a score in (0, 1], found {metadata['t_star']}")
        if "anchors" in metadata:
            settings["anchors"] = json.loads(metadata["anchors"])
            if len(settings["anchors"]) > _MOST_ANCHORS:
                raise ValueError(f"anchors: expected at most {_MOST_ANCHORS}, found {len(settings['anchors'])}")
        if "cfg" in metadata:
            settings["cfg"] = cfg.parse(metadata["cfg"])
        with torch.device("meta"):  # without memory, until it is known that the file fills it
            _check_tensors(ARCHITECTURES[architecture](**settings), tensors, path)
        detector = ARCHITECTURES[architecture](**settings)
    except DetectorError:
        raise
    except (ValueError, TypeError, OverflowError, RecursionError, RuntimeError) as error:
        raise DetectorError(
            f"{path}: expected metadata classes (list), t_star (number) and anchors (pairs, px): {error}"
        ) from None
    detector.load_state_dict(tensors)
    return _ready(detector, device, gradient_precision)


def _ready(
    detector: SqueezeDet | YoloV3, device: str | torch.device, gradient_precision: torch.dtype | None
) -> Detector:
    detector.gradient_precision = gradient_precision
    return ready(detector, device)


def save_detector(detector: Detector, path: Path, facts: dict[str, str] | None = None) -> None:
    """Write weights as float16 with name, classes, t_star, anchors and further facts as metadata; atomic."""
    metadata = {
        "architecture": detector.name,
        "classes": json.dumps(list(detector.classes)),
        "t_star": f"{detector.t_star:.6g}",
        **({"anchors": json.dumps(detector.anchors)} if isinstance(detector, SqueezeDet) else {}),
        **({"cfg": cfg.write(detector.cfg)} if isinstance(detector, YoloV3) else {}),
        **(facts or {}),
    }
    write_weights(path, metadata, halved(detector))


def halved(network: nn.Module) -> dict[str, torch.Tensor]:
    """A network's state, what was learned as float16."""
    learned = {name for name, _ in network.named_parameters()}
    # What was counted or measured in training need not lie in float16's range.
    return {
        k: v.detach().cpu().contiguous().to(torch.float16 if k in learned else v.dtype)
        for k, v in network.state_dict().items()
    }


def read_weights(path: Path) -> tuple[dict[str, str], dict[str, torch.Tensor]]:
    """Metadata and tensors of a safetensors file; DetectorError where it is none."""
    try:
        with safe_open(path, framework="pt") as file:
            return file.metadata() or {}, {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise DetectorError(f"{path}: expected a safetensors file, found {error}") from None


def write_weights(path: Path, metadata: dict[str, str], tensors: dict[str, torch.Tensor]) -> None:
    """Write a safetensors file, as `write_whole` does. The same content gives the same bytes."""
    write_whole(path, _in_order(save(tensors, metadata)))


def _in_order(data: bytes) -> bytes:
    """A safetensors file with its metadata sorted by name: the library writes them in an order of chance."""
    start = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:start])
    if "__metadata__" in header:
        header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)  # tensors begin at a multiple of 8
    return len(text).to_bytes(8, "little") + text + data[start:]


def _check_card(path: Path) -> None:
    """DetectorError for shipped weights that are not those of their model card."""
    card = path.with_suffix(".md")
    said = re.search(r"SHA-256: `([0-9a-f]{64})`", read_text(card, "a model card", 1 << 20))
    found = hashlib.sha256(read_file(path, "a weights file", 1 << 30)).hexdigest()
    if said is None or said[1] != found:
        expected = f"the SHA-256 of {card.name}, {said[1] if said else 'which names none'}"
        raise DetectorError(f"{path}: expected {expected}, found {found}")


def class_names(told: Any) -> tuple[str, ...]:
    """Classes of metadata. ValueError where they are none."""
    if not isinstance(told, list) or not all(isinstance(name, str) for name in told):
        raise ValueError("classes: expected a list of names, found something else")
    if not 1 <= len(told) <= _MOST_CLASSES:
        raise ValueError(f"classes: expected 1 to {_MOST_CLASSES}, found {len(told)}")
    return tuple(told)


def _check_tensors(detector: Detector, tensors: dict[str, torch.Tensor], path: Path) -> None:
    """DetectorError where tensors are not those of a detector, which may be without memory."""
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


def _first(keys: list[str]) -> str:
    return f" ({keys[0]}{', ...' if len(keys) > 1 else ''})" if keys else ""
