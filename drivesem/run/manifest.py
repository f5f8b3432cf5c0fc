"""manifest.json: versions, settings and hashes of a run, which a second run reproduces to the byte."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from detectors.registry import ONNX
from drivesem.config.commands import Attack
from drivesem.run.folder import FRAMES, settings_of
from drivesem.run.frame import RESULT
from scene_ir import files
from scene_ir.errors import FormatError

OF_PLACE_AND_TIME = ("out", "seconds")
"""Keys of metrics.json and result.json that differ between two runs with the same settings: in no hash."""
OF_RUN = ("frames_without_vehicles", "frames_failed")
OF_FRAME = (
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


def manifest_of(config: Attack, out: Path, names: Sequence[str], metrics: Mapping[str, Any]) -> dict[str, Any]:
    """The manifest of the run in `out`. names: of its frames; metrics: as metrics.json has them."""
    packages = [*_PACKAGES]
    packages += ["cma"] if config.method == "cma-es" else []
    packages += ["onnxruntime"] if config.detector.startswith(ONNX) else []
    return {
        "versions": {package: importlib.metadata.version(package) for package in packages},
        "seed": config.seed,
        "settings": settings_of(config),
        "metrics": digest_of(metrics),
        "frames": {name: frame_hashes(out / FRAMES / name) for name in names},
        "fields": {
            "run": field_hashes(metrics, OF_RUN),
            "frames": {
                name: field_hashes(files.read_json(out / FRAMES / name / RESULT), OF_FRAME) for name in names
            },
        },
    }


def frame_hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a frame's folder, by its path in there; of result.json without its times. Raises
    FormatError for a file that cannot be read.
    """
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): _hash(path, folder) for path in paths}


def _hash(path: Path, folder: Path) -> str:
    return digest_of(files.read_json(path)) if path == folder / RESULT else files.digest(path)


def field_hashes(data: Mapping[str, Any], names: Sequence[str]) -> dict[str, str]:
    """The first digits of the SHA-256 of single values of a JSON object, null for those that it lacks."""
    return {name: _sha(data.get(name))[:_DIGITS] for name in names}


def digest_of(data: Any) -> str:
    """SHA-256 of a JSON object without OF_PLACE_AND_TIME. Raises FormatError where it is none."""
    if not isinstance(data, Mapping):
        raise FormatError("a run's figures", "an object", type(data).__name__)
    told = {key: value for key, value in data.items() if key not in OF_PLACE_AND_TIME}
    return _sha(told)


def _sha(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
