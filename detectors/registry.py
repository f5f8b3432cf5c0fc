"""Loads detectors by name or weights file, ready to be attacked: frozen, in eval mode, channels-last."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from detectors import ensemble, planted
from detectors.base import (
    Detector,
    DetectorError,
    Predictor,
    disable_tf32,
    explain_missing_gradient,
    prepare_for_inference,
)
from detectors.files import read_file, read_text, write_atomically
from detectors.squeezedet import SqueezeDet, SqueezeDetPlus
from detectors.types import CLASSES
from detectors.yolov3 import cfg
from detectors.yolov3.yolov3 import YoloV3, YoloV3Slim, YoloV3Tiny

_ARCHITECTURES = (SqueezeDet, SqueezeDetPlus, YoloV3, YoloV3Tiny, YoloV3Slim)
ARCHITECTURES: dict[str, type[SqueezeDet] | type[YoloV3]] = {kind.name: kind for kind in _ARCHITECTURES}
"""Classes by architecture name, as in the metadata of weights files."""

SHIPPED = {
    name: Path(__file__).parent / "weights" / f"{name}.safetensors" for name in (SqueezeDet.name, YoloV3Slim.name)
}
"""Weights of the detectors that come with the package."""

ONNX = "onnx"
"""Kind of an ONNX graph, onnx:FILE: with a gradient if it can be converted."""
ONNX_RUNTIME = "onnx-runtime"
"""Kind of an ONNX graph without a gradient."""
HUGGING_FACE = "hf"
"""Kind of a model of transformers: hf:FOLDER or hf:NAME."""
MODULE = "module"
"""Kind of a class of the user: module:FILE.py:CLASS."""
MAITE = "maite"
"""Kind of a model by MAITE's protocol: maite:FILE.py:NAME."""
DARKNET = "darknet:"
"""Prefix of Darknet files: darknet:FILE.cfg,FILE.weights; the second may be omitted if it has the same name."""
KINDS = (ONNX, ONNX_RUNTIME, HUGGING_FACE, "torchvision", "ultralytics", "torchscript", "export", MODULE, MAITE)
"""Prefixes of detectors from elsewhere: KIND:WHAT[,MORE][,SPEC.yaml]."""
RUNS_CODE = ("ultralytics", "torchscript", "export", MODULE, MAITE)
"""Kinds that run code from their files when loaded."""
_SPEC_SUFFIXES = (".yaml", ".yml")
_MAX_CLASSES = 10_000
_MAX_ANCHORS = 1000
"""Anchors per cell: each is a candidate at every place of the image."""


AnyDetector: TypeAlias = "str | Path | Predictor | nn.Module | Callable[[Tensor], Any]"
"""A name or file, a detector, a torch module with known outputs, a MAITE model, or a function of images."""


def find_code_to_run(name_or_path: str | Path) -> str | None:
    """The module or file of code that loading this detector would run; None if there is only data."""
    name = str(name_or_path)
    if name.startswith(planted.PREFIX):
        return find_code_to_run(planted.parse_planted_name(name)[1])
    if name.startswith(ensemble.PREFIX):
        return next(filter(None, map(find_code_to_run, ensemble.parse_member_names(name))), None)
    kind, colon, rest = name.partition(":")
    return rest if colon and kind in RUNS_CODE else None


def load_predictor(
    detector: AnyDetector,
    device: str | torch.device = "cpu",
    tiling: str = "auto",
    classes: Sequence[str] | None = None,
) -> Predictor:
    """Load a detector for prediction only, or make one of a Python object.

    Args:
        detector: `onnx-runtime:FILE[,SPEC.yaml]`, or anything that `load_detector` accepts; or an object: a detector,
            which is returned as it is; a torch module with outputs of a known format (docs/guide/detector.md); a
            MAITE model (`detectors.adapters.maite`); or a function from images (1, 3, H, W), RGB in [0, 1], to
            `boxes` (M, 4) px, `scores` (M,) and `labels` (M,) in a dict, as torchvision's detectors return them, or
            to `supervision.Detections`.
        device: Device of the weights; ONNX Runtime runs on the CPU. An object stays where it is.
        tiling: Of an ONNX graph, "auto" or "off" (see `detectors.adapters.onnx`).
        classes: Class names that the labels of a function index, or of a torch module without a `spec`.

    Raises:
        DetectorError: As `load_detector`; an ONNX graph of unknown format, or no ONNX Runtime; or an object that is
            no detector.
    """
    if not isinstance(detector, str | Path):
        if isinstance(detector, Predictor):
            return detector
        from detectors.adapters.network import adapt_object

        return adapt_object(detector, classes)
    name = str(detector)
    if name.startswith(planted.PREFIX):
        fault, inner = planted.parse_planted_name(name)
        return planted.plant_fault(load_predictor(inner, device, tiling), fault)
    kind, colon, rest = name.partition(":")
    return (
        _load_adapted(kind, rest, device, tiling) if colon and kind in KINDS else load_detector(detector, device)
    )


def load_detector(
    name_or_path: str | Path,
    device: str | torch.device = "cpu",
    gradient_precision: torch.dtype | None = None,
) -> Detector:
    """Load a differentiable detector, frozen, in eval mode and channels-last.

    Args:
        name_or_path: A shipped detector's name, a `.safetensors` file, `darknet:FILE.cfg,FILE.weights`, a detector
            from elsewhere (`KINDS`; always float32), `planted:FAULT@DETECTOR` (see `detectors.planted`), or
            `ensemble:A+B` (see `detectors.ensemble`).
        device: Device of the weights.
        gradient_precision: torch.bfloat16 or, on GPUs, torch.float16 for passes with a gradient; reported
            detections and losses are always float32.

    Raises:
        DetectorError: Unknown name, missing or damaged file, weights of another architecture, or no gradient.
    """
    disable_tf32(device)
    name = str(name_or_path)
    kind, colon, rest = name.partition(":")
    if name.startswith(planted.PREFIX):
        fault, inner = planted.parse_planted_name(name)
        detector = planted.PlantedDetector(load_detector(inner, device, gradient_precision), fault)
        return detector.requires_grad_(False)
    if name.startswith(ensemble.PREFIX):
        members = [load_detector(m, device, gradient_precision) for m in ensemble.parse_member_names(name)]
        return ensemble.Ensemble(members).requires_grad_(False)
    if colon and kind in KINDS:
        if gradient_precision is not None:
            raise DetectorError(f"{name}: expected float32 for its gradients, found {gradient_precision}")
        adapted = _load_adapted(kind, rest, device)
        if not isinstance(adapted, Detector):
            found = f"{name!r}, which has none{explain_missing_gradient(adapted)}"
            raise DetectorError(f"detector: expected one with gradients, found {found}")
        return adapted
    if name.startswith(DARKNET):
        from detectors.yolov3 import darknet

        pairs = (pair for pair in _split_at_commas(rest) if Path(pair[0]).is_file())
        files = next(pairs, rest.partition(",")[::2])
        network = darknet.load(*(Path(file) for file in files if file))
    elif name in SHIPPED:
        _check_card(SHIPPED[name])
        network = _load_weights_file(SHIPPED[name])
    elif Path(name_or_path).suffix == ".safetensors":
        network = _load_weights_file(Path(name_or_path))
    else:
        known = ", ".join(sorted(SHIPPED))
        prefixes = ", ".join([DARKNET, *(f"{kind}:" for kind in KINDS), ensemble.PREFIX])
        raise DetectorError(
            f"detector: expected {known}, a path.safetensors, or a name with prefix {prefixes} or "
            f"{planted.PREFIX}, found {name!r}"
        )
    network.gradient_precision = gradient_precision
    return prepare_for_inference(network, device)


def _load_adapted(kind: str, rest: str, device: str | torch.device, tiling: str = "auto") -> Predictor:
    """A detector from elsewhere."""
    disable_tf32(device)
    arguments, spec = _split_arguments(kind, rest)
    if kind == ONNX:
        from detectors.adapters.onnx_gradient import load_onnx

        return load_onnx(Path(arguments[0]), tiling, spec, device)
    if kind == ONNX_RUNTIME:
        from detectors.adapters.onnx import OnnxPredictor

        return OnnxPredictor(Path(arguments[0]), tiling, spec)
    from detectors.adapters.network import load_maite_model, require_gradient

    if kind == MAITE:
        return load_maite_model(arguments[0], spec)
    return require_gradient(_load_network(kind, arguments, spec).requires_grad_(False).to(device))


def _load_network(kind: str, arguments: list[str], spec: Path | None) -> Detector:
    """A torch module from elsewhere, on the CPU."""
    if kind == HUGGING_FACE:
        from detectors.adapters.hugging_face import load_hugging_face

        return load_hugging_face(arguments[0], spec)
    if kind == "torchvision":
        from detectors.adapters.torchvision_models import load_torchvision

        return load_torchvision(*arguments, spec=spec)
    if kind == MODULE:
        from detectors.adapters.network import load_user_detector

        return load_user_detector(arguments[0], spec)
    from detectors.adapters import network

    loaders = {
        "ultralytics": network.load_ultralytics,
        "torchscript": network.load_torchscript,
        "export": network.load_exported,
    }
    return loaders[kind](Path(arguments[0]), spec)


def _split_arguments(kind: str, rest: str) -> tuple[list[str], Path | None]:
    """The comma-separated arguments after a prefix, and the YAML file if the last one is one."""
    name, comma, weights = rest.partition(",") if kind == "torchvision" else ("", "", rest)
    for path, more in _split_at_commas(weights):
        file, _, class_name = path.rpartition(":") if kind in (MODULE, MAITE) else (path, ":", "any")
        found = class_name.isidentifier() and file and Path(file).exists() and not file.endswith(_SPEC_SUFFIXES)
        if found and (not more or more.endswith(_SPEC_SUFFIXES)):
            return [name, path] if comma else [path], Path(more) if more else None
    words = [word.strip() for word in rest.split(",")]
    spec = Path(words.pop()) if len(words) > 1 and words[-1].endswith(_SPEC_SUFFIXES) else None
    most, expected = (2, "[,WEIGHTS]") if kind == "torchvision" else (1, "")
    if not 1 <= len(words) <= most or not all(words):
        raise DetectorError(f"detector: expected {kind}:WHAT{expected}[,SPEC.yaml], found {f'{kind}:{rest}'!r}")
    return words, spec


def _split_at_commas(text: str) -> Iterator[tuple[str, str]]:
    """The text whole, then divided at each comma, the last one first: a file's name may contain commas."""
    yield text, ""
    for place in reversed([i for i, letter in enumerate(text) if letter == ","]):
        yield text[:place], text[place + 1 :]


def _load_weights_file(path: Path) -> SqueezeDet | YoloV3:
    if not path.is_file():
        raise DetectorError(f"{path}: expected a weights file, found none")
    metadata, tensors = read_weights(path)
    architecture = metadata.get("architecture", "squeezedet")
    if architecture not in ARCHITECTURES:
        known = ", ".join(sorted(ARCHITECTURES))
        raise DetectorError(f"{path}: expected architecture {known}, found {architecture!r}")
    try:
        settings: dict[str, Any] = {
            "classes": parse_class_names(json.loads(metadata.get("classes", json.dumps(CLASSES)))),
            "t_star": float(metadata.get("t_star", "0.5")),
        }
        if not 0 < settings["t_star"] <= 1:
            raise ValueError(f"t_star: expected a score in (0, 1], found {metadata['t_star']}")
        if "anchors" in metadata:
            settings["anchors"] = json.loads(metadata["anchors"])
            if len(settings["anchors"]) > _MAX_ANCHORS:
                raise ValueError(f"anchors: expected at most {_MAX_ANCHORS}, found {len(settings['anchors'])}")
        if "cfg" in metadata:
            settings["cfg"] = cfg.parse(metadata["cfg"])
        with torch.device("meta"):  # allocates nothing until the file is known to fill the tensors
            _check_tensors(ARCHITECTURES[architecture](**settings), tensors, path)
        detector = ARCHITECTURES[architecture](**settings)
    except DetectorError:
        raise
    except (ValueError, TypeError, OverflowError, RecursionError, RuntimeError) as error:
        raise DetectorError(
            f"{path}: expected metadata classes (list), t_star (number) and anchors (pairs, px): {error}"
        ) from None
    detector.load_state_dict(tensors)
    return detector


def save_detector(detector: Detector, path: Path, facts: dict[str, str] | None = None) -> None:
    """Write a weights file atomically: float16, with name, classes, t* and anchors as metadata.

    Args:
        detector: The detector.
        path: The `.safetensors` file.
        facts: Further metadata.
    """
    metadata = {
        "architecture": detector.name,
        "classes": json.dumps(list(detector.classes)),
        "t_star": f"{detector.t_star:.6g}",
        **({"anchors": json.dumps(detector.anchors)} if isinstance(detector, SqueezeDet) else {}),
        **({"cfg": cfg.write(detector.cfg)} if isinstance(detector, YoloV3) else {}),
        **(facts or {}),
    }
    write_weights(path, metadata, half_precision_state(detector))


def half_precision_state(network: nn.Module) -> dict[str, torch.Tensor]:
    """A network's state with its parameters as float16."""
    learned = {name for name, _ in network.named_parameters()}
    # Buffers, such as running statistics, may exceed float16's range.
    return {
        k: v.detach().cpu().contiguous().to(torch.float16 if k in learned else v.dtype)
        for k, v in network.state_dict().items()
    }


def read_weights(path: Path) -> tuple[dict[str, str], dict[str, torch.Tensor]]:
    """Metadata and tensors of a safetensors file.

    Raises:
        DetectorError: The file is not one.
    """
    try:
        with safe_open(path, framework="pt") as file:
            return file.metadata() or {}, {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise DetectorError(f"{path}: expected a safetensors file, found {error}") from None


def write_weights(path: Path, metadata: dict[str, str], tensors: dict[str, torch.Tensor]) -> None:
    """Write a safetensors file atomically. The same content gives the same bytes.

    Args:
        path: The file.
        metadata: Strings by name.
        tensors: Tensors by name.
    """
    write_atomically(path, _sort_metadata(save(tensors, metadata)))


def _sort_metadata(data: bytes) -> bytes:
    """A safetensors file with its metadata sorted by name: the library's order is random."""
    start = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:start])
    if "__metadata__" in header:
        header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)  # tensors begin at a multiple of 8
    return len(text).to_bytes(8, "little") + text + data[start:]


def _check_card(path: Path) -> None:
    """Raise DetectorError if shipped weights differ from those of their model card."""
    card = path.with_suffix(".md")
    stated = re.search(r"SHA-256: `([0-9a-f]{64})`", read_text(card, "a model card", 1 << 20))
    found = hashlib.sha256(read_file(path, "a weights file", 1 << 30)).hexdigest()
    if stated is None or stated[1] != found:
        expected = f"the SHA-256 of {card.name}, {stated[1] if stated else 'which the card lacks'}"
        raise DetectorError(f"{path}: expected {expected}, found {found}")


def parse_class_names(names: Any) -> tuple[str, ...]:
    """Class names from a file's metadata.

    Raises:
        ValueError: They are not 1 to 10,000 strings.
    """
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError("classes: expected a list of names, found something else")
    if not 1 <= len(names) <= _MAX_CLASSES:
        raise ValueError(f"classes: expected 1 to {_MAX_CLASSES}, found {len(names)}")
    return tuple(names)


def _check_tensors(detector: Detector, tensors: dict[str, torch.Tensor], path: Path) -> None:
    """Raise DetectorError if tensors do not fit a detector, which may be on the meta device."""
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
