"""Builds manifest.json: versions, settings and hashes of a run, which an equal run reproduces to the byte."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from detectors.registry import ONNX
from drivesem.config.commands import AttackConfig
from drivesem.run.folder import FRAMES, result_settings
from drivesem.run.frame import RESULT
from scene_ir import files
from scene_ir.errors import FormatError

VOLATILE_KEYS = ("out", "seconds")
"""Keys of metrics.json and result.json that may differ between equal runs; not hashed."""
HASHED_RUN_FIELDS = ("frames_without_vehicles", "frames_failed")
HASHED_FRAME_FIELDS = (
    *("loss_trace", "queries", "passes", "active_constraints", "violated_at_start", "became_ignored"),
    *("failures", "grade_notes", "checked_by", "change"),
)
"""Values of metrics.json and result.json that do not follow from other files. Each has its own hash, so that a change
can be named."""
_DIGITS = 16
"""Hexadecimal digits of such a hash; the hash of the whole file is complete."""
_PACKAGES = (
    "drivesem",
    "torch",
    "kornia",
    "numpy",
    "scipy",
    "opencv-contrib-python-headless",
    "warp-lang",
    "pycocotools",
)


def build_manifest(
    config: AttackConfig, out: Path, names: Sequence[str], metrics: Mapping[str, Any]
) -> dict[str, Any]:
    """Build the manifest of a run.

    Args:
        config: The run's settings.
        out: Its folder.
        names: Its frames.
        metrics: Contents of metrics.json.
    """
    packages = [*_PACKAGES]
    packages += ["cma"] if config.method == "cma-es" else []
    packages += ["onnxruntime"] if config.detector.startswith(ONNX) else []
    return {
        "versions": {package: importlib.metadata.version(package) for package in packages},
        "seed": config.seed,
        "settings": result_settings(config),
        "metrics": hash_json(metrics),
        "frames": {name: hash_frame_files(out / FRAMES / name) for name in names},
        "fields": {
            "run": hash_fields(metrics, HASHED_RUN_FIELDS),
            "frames": {
                name: hash_fields(files.read_json(out / FRAMES / name / RESULT), HASHED_FRAME_FIELDS)
                for name in names
            },
        },
    }


def hash_frame_files(folder: Path) -> dict[str, str]:
    """Hash every file of a frame's folder with SHA-256, result.json without its times. Returns hashes by path.

    Raises FormatError for a file that cannot be read.
    """
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): _hash_file(path, folder) for path in paths}


def _hash_file(path: Path, folder: Path) -> str:
    return hash_json(files.read_json(path)) if path == folder / RESULT else files.sha256_digest(path)


def hash_fields(data: Mapping[str, Any], names: Sequence[str]) -> dict[str, str]:
    """Return the first digits of the SHA-256 of values of a JSON object; a missing value counts as null."""
    return {name: _sha256(data.get(name))[:_DIGITS] for name in names}


def hash_json(data: Any) -> str:
    """Return the SHA-256 of a JSON object without VOLATILE_KEYS. Raises FormatError if it is not an object."""
    if not isinstance(data, Mapping):
        raise FormatError("the metrics of a run", "an object", type(data).__name__)
    return _sha256({key: value for key, value in data.items() if key not in VOLATILE_KEYS})


def _sha256(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
