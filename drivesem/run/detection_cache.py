"""What a detector finds in pictures on disk, remembered by content: of the picture, and of the detector."""

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
from drivesem.attack.targets import EvaluatedClasses
from drivesem.config.options import WorkerOptions
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.run.frame import detection_records, detections_from_records
from drivesem.run.results import BoxRecord
from scene_ir import files
from scene_ir.errors import FormatError

_SCHEMA = 1
_FINGERPRINT = 16
"""Hexadecimal digits of a fingerprint: enough for folder names that never meet."""


@dataclass(frozen=True, slots=True)
class DetectorSpec:
    """How to look: a detector by name or file, its device, tiles or not. folder: of what is remembered."""

    detector: str
    device: str
    tiles: str
    folder: Path

    def load(self) -> Predictor:
        """The detector. Raises DetectorError."""
        return load_predictor(self.detector, self.device, self.tiles)


def image_to_tensor(image: np.ndarray, device: str) -> Tensor:
    """An image (H, W, 3) uint8 as (3, H, W) in [0, 1]."""
    return torch.from_numpy(image).permute(2, 0, 1).to(device) / 255


def detect_objects(predictor: Predictor, picture: Tensor) -> Detections:
    """What is found in a picture (3, H, W) in [0, 1]: labels among the judged classes, on the CPU."""
    found = EvaluatedClasses.from_detector(predictor).map_detections(predict(predictor, picture[None])[0])
    return Detections(found.boxes_xyxy.cpu(), found.labels.cpu(), found.scores.cpu())


class DetectionCache:
    """One detector's detections, a file for each picture. Pictures with the same bytes share one."""

    def __init__(self, order: DetectorSpec, predictor: Predictor) -> None:
        self._folder = order.folder / detector_fingerprint(order, predictor)
        self._judged = EvaluatedClasses.from_detector(predictor)

    def contains(self, picture: Path) -> bool:
        """Whether a picture was looked at."""
        return self.path_for(picture).is_file()

    def store(self, picture: Path, found: Detections) -> None:
        """Remember detections whose labels are indices into the judged classes."""
        records = [asdict(record) for record in detection_records(found, self._judged.names)]
        files.write_json(self.path_for(picture), {"schema": _SCHEMA, "detections": records})

    def load(self, picture: Path) -> Detections:
        """What was found in a picture. Raises FormatError where the file is damaged."""
        path = self.path_for(picture)
        data = files.read_json(path)
        try:
            records = tuple(BoxRecord(**record) for record in data["detections"])
            return detections_from_records(records, self._judged.names)
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(str(path), "detections as drivesem transfer writes them", error) from error

    def path_for(self, picture: Path) -> Path:
        """The file of a picture's detections: that of its bytes."""
        return self._folder / f"{files.sha256_digest(picture)}.json"


def detector_fingerprint(order: DetectorSpec, predictor: Predictor) -> str:
    """Differs where anything may that decides what is found: weights or files, classes, tiles, device, version."""
    known = hashlib.sha256()
    facts = [importlib.metadata.version("drivesem"), order.detector, order.tiles, order.device, *predictor.classes]
    known.update(json.dumps(facts).encode())
    if isinstance(predictor, nn.Module):
        known.update(weights_digest(predictor).encode())
    # The files that a name speaks of, such as an adapter's, and the settings that may lie beside one.
    for part in re.split("[,:]", order.detector):
        for path in (Path(part), Path(part).with_suffix(".yaml")) if part else ():
            if path.is_file():
                known.update(files.read_bytes(path))
    return known.hexdigest()[:_FINGERPRINT]


def weights_digest(module: nn.Module) -> str:
    """Of all tensors and their names, hexadecimal."""
    known = hashlib.sha256()
    for name, tensor in module.state_dict().items():
        known.update(name.encode())
        known.update(tensor.detach().cpu().reshape(-1).view(torch.uint8).numpy().tobytes())
    return known.hexdigest()


def cache_detections(
    order: DetectorSpec, predictor: Predictor, pictures: Sequence[Path], config: WorkerOptions, title: str
) -> dict[str, str]:
    """Look at each picture that is not known yet. Returns which could not be used, and why, where the settings
    keep going; else the first ends it. Pictures with the same bytes are looked at once. title: of the bar.
    """
    memory = DetectionCache(order, predictor)
    unknown = {memory.path_for(picture): picture for picture in reversed(pictures) if not memory.contains(picture)}
    todo = list(reversed(unknown.values()))
    work = partial(_look, predictor=predictor, memory=memory, device=order.device)
    return run_frame_jobs(
        todo, work, partial(_in_process, order), config, ProgressSettings(title, keep=False)
    ).failed


def _look(picture: Path, predictor: Predictor, memory: DetectionCache, device: str) -> None:
    memory.store(picture, detect_objects(predictor, image_to_tensor(files.read_image(picture), device)))


def _in_process(order: DetectorSpec) -> Callable[[Path], None]:
    predictor = order.load()
    return partial(_look, predictor=predictor, memory=DetectionCache(order, predictor), device=order.device)
