"""Caches a detector's detections in pictures on disk, by content of the picture and of the detector."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from detectors.base import Predictor, predict
from detectors.registry import load_predictor
from detectors.types import Detections
from drivesem.attacks.targets import EvaluatedClasses
from drivesem.config.options import WorkerOptions
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.run.frame import detection_records, detections_from_records
from drivesem.run.results import BoxRecord
from scene_ir import files
from scene_ir.errors import FormatError

_SCHEMA = 1
_FINGERPRINT = 16
"""Hexadecimal digits of a fingerprint, enough for unique folder names."""


@dataclass(frozen=True, slots=True)
class DetectorSpec:
    """How to load a detector, and where to cache its detections."""

    detector: str
    """Name or file."""
    device: str
    """Device."""
    tiles: str
    """Setting of tiled detection."""
    folder: Path
    """Folder of the cache."""

    def load(self) -> Predictor:
        """Load the detector. Raises DetectorError."""
        return load_predictor(self.detector, self.device, self.tiles)


def image_to_tensor(image: np.ndarray, device: str) -> Tensor:
    """Convert an image (H, W, 3) uint8 to (3, H, W) in [0, 1]."""
    return torch.from_numpy(image).permute(2, 0, 1).to(device) / 255


def detect_objects(predictor: Predictor, picture: Tensor) -> Detections:
    """Detect objects of the evaluated classes in a picture (3, H, W) in [0, 1]. Returns them on the CPU."""
    found = EvaluatedClasses.from_detector(predictor).map_detections(predict(predictor, picture[None])[0])
    return Detections(found.boxes_xyxy.cpu(), found.labels.cpu(), found.scores.cpu())


class DetectionCache:
    """Detections of one detector, a file per picture; equal pictures share one."""

    def __init__(self, spec: DetectorSpec, predictor: Predictor) -> None:
        self._folder = spec.folder / detector_fingerprint(spec, predictor)
        self._judged = EvaluatedClasses.from_detector(predictor)

    def contains(self, picture: Path) -> bool:
        """Whether the detections in a picture are cached."""
        return self.path_for(picture).is_file()

    def store(self, picture: Path, found: Detections) -> None:
        """Store detections, labelled by evaluated class."""
        records = [asdict(record) for record in detection_records(found, self._judged.names)]
        files.write_json(self.path_for(picture), {"schema": _SCHEMA, "detections": records})

    def load(self, picture: Path) -> Detections:
        """Load the detections in a picture. Raises FormatError if the file is damaged."""
        path = self.path_for(picture)
        data = files.read_json(path)
        try:
            records = tuple(BoxRecord(**record) for record in data["detections"])
            return detections_from_records(records, self._judged.names)
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(str(path), "detections as drivesem transfer writes them", error) from error

    def path_for(self, picture: Path) -> Path:
        """Return the file of a picture's detections, named after its bytes."""
        return self._folder / f"{files.sha256_digest(picture)}.json"


def detector_fingerprint(spec: DetectorSpec, predictor: Predictor) -> str:
    """Return a digest of all that affects detections: weights or files, classes, tiles, device and version."""
    known = hashlib.sha256()
    facts = [importlib.metadata.version("drivesem"), spec.detector, spec.tiles, spec.device, *predictor.classes]
    known.update(json.dumps(facts).encode())
    if isinstance(predictor, nn.Module):
        known.update(weights_digest(predictor).encode())
    # files in the name, such as an adapter's, and their settings files
    for part in re.split("[,:]", spec.detector):
        for path in (Path(part), Path(part).with_suffix(".yaml")) if part else ():
            if path.is_file():
                known.update(files.read_bytes(path))
    return known.hexdigest()[:_FINGERPRINT]


def weights_digest(module: nn.Module) -> str:
    """Return the SHA-256 of all tensors and their names."""
    known = hashlib.sha256()
    for name, tensor in module.state_dict().items():
        known.update(name.encode())
        known.update(tensor.detach().cpu().reshape(-1).view(torch.uint8).numpy().tobytes())
    return known.hexdigest()


def cache_detections(
    spec: DetectorSpec, predictor: Predictor, pictures: Sequence[Path], config: WorkerOptions, title: str
) -> dict[str, str]:
    """Cache the detections in all pictures; equal pictures are evaluated once.

    Args:
        spec: The detector and its cache.
        predictor: The loaded detector.
        pictures: The pictures.
        config: Number of workers, engine, and whether to keep going.
        title: Text of the progress bar.

    Returns:
        Reasons by picture that could not be used; without `keep_going`, the first error is raised.
    """
    cache = DetectionCache(spec, predictor)
    unknown = {cache.path_for(picture): picture for picture in reversed(pictures) if not cache.contains(picture)}
    todo = list(reversed(unknown.values()))
    work = partial(_detect_and_store, predictor=predictor, cache=cache, device=spec.device)
    return run_frame_jobs(
        todo, work, partial(_make_worker, spec), config, ProgressSettings(title, keep=False)
    ).failed


def _detect_and_store(picture: Path, predictor: Predictor, cache: DetectionCache, device: str) -> None:
    cache.store(picture, detect_objects(predictor, image_to_tensor(files.read_image(picture), device)))


def _make_worker(spec: DetectorSpec) -> Callable[[Path], None]:
    predictor = spec.load()
    return partial(
        _detect_and_store, predictor=predictor, cache=DetectionCache(spec, predictor), device=spec.device
    )
