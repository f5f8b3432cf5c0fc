"""manifest.json: versions, settings and hashes of a run, which a second run reproduces to the byte."""

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
"""Keys of metrics.json and result.json that differ between two runs with the same settings: in no hash."""
HASHED_RUN_FIELDS = ("frames_without_vehicles", "frames_failed")
HASHED_FRAME_FIELDS = (
    *("loss_trace", "queries", "passes", "active_constraints", "violated_at_start", "became_ignored"),
    *("failures", "grade_notes", "checked_by", "change"),
)
"""What metrics.json and result.json hold that does not follow from other files, or not all of it. Each has a hash
of its own, so that what was changed has a name."""
_DIGITS = 16
"""Of such a hash, hexadecimal: the whole file's is beside it."""
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
    """The manifest of the run in `out`. names: of its frames; metrics: as metrics.json has them."""
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
    """SHA-256 of every file of a frame's folder, by its path in there; of result.json without its times. Raises
    FormatError for a file that cannot be read.
    """
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): _hash(path, folder) for path in paths}


def _hash(path: Path, folder: Path) -> str:
    return hash_json(files.read_json(path)) if path == folder / RESULT else files.sha256_digest(path)


def hash_fields(data: Mapping[str, Any], names: Sequence[str]) -> dict[str, str]:
    """The first digits of the SHA-256 of single values of a JSON object, null for those that it lacks."""
    return {name: _sha(data.get(name))[:_DIGITS] for name in names}


def hash_json(data: Any) -> str:
    """SHA-256 of a JSON object without OF_PLACE_AND_TIME. Raises FormatError where it is none."""
    if not isinstance(data, Mapping):
        raise FormatError("a run's figures", "an object", type(data).__name__)
    told = {key: value for key, value in data.items() if key not in VOLATILE_KEYS}
    return _sha(told)


def _sha(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
