"""Detectors from elsewhere by the word before the colon: KIND:WHAT[,MORE][,SPEC.yaml]."""

from __future__ import annotations

from pathlib import Path

from detectors.base import Detector, DetectorError, Predictor

KINDS = ("onnx", "torchvision", "ultralytics", "torchscript", "export", "module")
"""Words before the colon."""
RUNS_CODE = ("ultralytics", "torchscript", "export", "module")
"""Kinds whose files hold code or pickles: loading one runs what is in it."""
WITHOUT_GRADIENT = ("onnx",)
SPEC_SUFFIXES = (".yaml", ".yml")


def kind_of(name: str) -> str | None:
    """The word before the colon, where it is one of `KINDS`."""
    kind, colon, _ = name.partition(":")
    return kind if colon and kind in KINDS else None


def open_predictor(name: str, tiling: str = "auto") -> Predictor:
    """The detector of a name with one of `KINDS`. tiling: of an ONNX graph. Raises DetectorError."""
    kind, _, rest = name.partition(":")
    if kind not in WITHOUT_GRADIENT:
        return open_detector(name)
    from detectors.adapters.onnx import OnnxPredictor

    (file,), spec = _parts(kind, rest, most=1)
    return OnnxPredictor(Path(file), tiling, spec)


def open_detector(name: str) -> Detector:
    """The detector with gradients of a name with one of `KINDS`: on the CPU, frozen.

    Raises DetectorError where it cannot be had, or has no gradient.
    """
    kind, _, rest = name.partition(":")
    if kind in WITHOUT_GRADIENT:
        raise DetectorError(f"detector: expected one with gradients, found {name!r}, which has none")
    words, spec = _parts(kind, rest, most=2 if kind == "torchvision" else 1)
    detector = _opened(kind, words, spec)
    return detector.requires_grad_(False)


def _opened(kind: str, words: list[str], spec: Path | None) -> Detector:
    if kind == "torchvision":
        from detectors.adapters import torchvision_models

        return torchvision_models.load(words[0], *words[1:], spec=spec)
    if kind == "ultralytics":
        from detectors.adapters import ultralytics_models

        return ultralytics_models.load(Path(words[0]), spec)
    if kind == "module":
        from detectors.adapters import module

        return module.load(words[0], spec)
    from detectors.adapters import network

    return (network.torchscript if kind == "torchscript" else network.exported)(Path(words[0]), spec)


def _parts(kind: str, rest: str, most: int) -> tuple[list[str], Path | None]:
    """What stands between the commas: one to `most` words, and a YAML file where the last word is one."""
    words = [word.strip() for word in rest.split(",")]
    spec = Path(words.pop()) if len(words) > 1 and words[-1].endswith(SPEC_SUFFIXES) else None
    if not 1 <= len(words) <= most or not all(words):
        more = "[,WEIGHTS]" if most > 1 else ""
        raise DetectorError(f"detector: expected {kind}:WHAT{more}[,SPEC.yaml], found {f'{kind}:{rest}'!r}")
    return words, spec
