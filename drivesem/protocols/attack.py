"""An attack as MAITE's `Augmentation`: pictures in which a detector fails, with labels that moved with the vehicles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from detectors.adapters.maite import MaiteTarget, image_from_array
from detectors.registry import AnyDetector, load_predictor
from detectors.types import CLASSES
from drivesem.config.errors import UsageError
from drivesem.data.label_table import UNKNOWN_OCCLUSION
from drivesem.data.photographs import default_camera
from drivesem.protocols.dataset import IGNORED_BOXES, Metadata
from drivesem.protocols.metric import read_target
from drivesem.run.attack import NoVehicleError
from drivesem.run.counterexample import Counterexample, attack
from drivesem.scenes.scene import Frames, derender
from scene_ir.types import Frame, Labels

ATTACK = "attack"
"""Key of an attack's outcome in the metadata of an image."""
_SAME_PX = 0.5
"""Sides of a target and of the vehicle de-rendered from it differ by less."""


class MaiteAttack:
    """An attack that changes each image of a batch until a detector fails, by physical changes of its vehicles.

    Vehicles are de-rendered from the targets' boxes. Their boxes move with them; those that come to be hidden or too
    small move to `ignored_boxes` of the metadata. `attack` of the metadata has success, feasible, theta and failures.
    Images without a vehicle remain as they are.
    """

    def __init__(
        self,
        detector: AnyDetector,
        *,
        index2label: Mapping[int, str] | None = None,
        frames: Frames | None = None,
        focal: float | None = None,
        fit: bool = True,
        **options: Any,
    ) -> None:
        """Prepare an attack.

        Args:
            detector: As for `ds.attack`, or a MAITE model.
            index2label: Classes by the numbers of targets' labels; by default Car, Truck, Pedestrian and Cyclist. Other
                names of vehicles, such as "car" or "van", are understood.
            frames: Data set of the images, from which cameras and 3D labels are taken by the metadata's `id`.
            focal: Focal length of images without a frame, px; by default 0.58 of the longer side.
            fit: Fit vehicles to their outlines.
            options: Further options of `ds.attack`.

        Raises:
            DetectorError: The detector cannot be used.
        """
        self._detector = load_predictor(detector)
        self._names = dict(enumerate(CLASSES)) if index2label is None else dict(index2label)
        self._frames, self._focal, self._fit, self._options = frames, focal, fit, options
        self.metadata: Metadata = {"id": f"drivesem {options.get('method', 'attack')} on {self._detector.name}"}

    def __call__(
        self, batch: tuple[Sequence[Any], Sequence[Any], Sequence[Mapping[str, Any]]], /
    ) -> tuple[list[NDArray[Any]], list[MaiteTarget], list[Metadata]]:
        """Attack the images of a batch.

        Args:
            batch: Images (3, H, W) of whole numbers from 0 to 255 or of floats in [0, 1], their targets and metadata.

        Returns:
            The same for the changed images, of the same type.

        Raises:
            UsageError: A wrong option of `ds.attack`, a target without boxes, labels or scores, or metadata without id.
            DetectorError: An image has another shape or range.
        """
        changed = [self._attack_image(*datum) for datum in zip(*batch, strict=True)]
        return [c[0] for c in changed], [c[1] for c in changed], [c[2] for c in changed]

    def _attack_image(
        self, image: Any, target: Any, metadata: Mapping[str, Any]
    ) -> tuple[NDArray[Any], MaiteTarget, Metadata]:
        if not isinstance(metadata, Mapping) or "id" not in metadata:
            raise UsageError("metadata", "a mapping with an id", repr(metadata)[:80])
        boxes, labels, scores = read_target(target)
        before = MaiteTarget(boxes.numpy(), labels.numpy(), scores.numpy())
        frame = self._frame(str(metadata["id"]), image_from_array(image), before)
        try:
            found = attack(derender(frame, fit=self._fit), self._detector, **self._options)
        except NoVehicleError:
            return np.asarray(image), before, {**metadata, ATTACK: None}
        after, hidden = self._move_boxes(before, found)
        outcome = {
            "success": found.success,
            "feasible": found.feasible,
            "theta": found.theta,
            "failures": found.failure_rows(),
        }
        picture: NDArray[Any] = np.ascontiguousarray(found.picture.transpose(2, 0, 1))
        if np.issubdtype(np.asarray(image).dtype, np.floating):
            picture = (picture / 255).astype(np.asarray(image).dtype)
        return (
            picture,
            after,
            {**metadata, IGNORED_BOXES: [*metadata.get(IGNORED_BOXES, ()), *hidden], ATTACK: outcome},
        )

    def _frame(self, name: str, image: torch.Tensor, target: MaiteTarget) -> Frame:
        """The frame of the data set with this image, or one with the target's boxes as labels."""
        if self._frames is not None and name in self._frames.names:
            return replace(self._frames[name], photograph=image)
        count = len(target.labels)
        unknown = torch.full((count, 3), torch.nan)
        labels = Labels(
            kind=tuple(self._names.get(int(label), "background") for label in target.labels),
            boxes_xyxy=torch.from_numpy(target.boxes),
            truncation=unknown[:, 0],
            occlusion=torch.full((count,), UNKNOWN_OCCLUSION),
            translation=unknown,
            yaw=unknown[:, 0],
            size_lhw=unknown,
            ignore_xyxy=torch.zeros(0, 4),
        )
        height, width = image.shape[1:]
        return Frame(name, image, default_camera(height, width, self._focal), labels)

    def _move_boxes(self, target: MaiteTarget, found: Counterexample) -> tuple[MaiteTarget, list[list[float]]]:
        """The target after an attack, and the boxes of vehicles that came to be hidden or too small."""
        moved, paper = found.attacked.rendered.moved, found.attacked.objective.benign.paper
        number_by_name = {name: number for number, name in self._names.items()}
        boxes, labels, scores = target.boxes.copy(), target.labels, target.scores
        dropped, hidden = np.zeros(len(boxes), bool), []
        for i, box in enumerate(moved.boxes_xyxy.cpu().numpy()):
            present, ignored = bool(moved.in_view[i]), bool(moved.became_ignored[i] | moved.out_of_sight[i])
            start = paper.boxes_xyxy[i].cpu().numpy()
            rows = np.flatnonzero((np.abs(target.boxes - start) < _SAME_PX).all(1))
            boxes[rows] = box
            dropped[rows] |= ignored or not present
            if present and ignored and len(rows):
                hidden.append(box.tolist())
            name = CLASSES[int(moved.category[i])]
            if present and not bool(paper.in_view[i] | moved.ignore[i]) and name in number_by_name:  # it was added
                boxes = np.concatenate([boxes, box[None]])
                labels, scores = np.append(labels, number_by_name[name]), np.append(scores, np.float32(1))
                dropped = np.append(dropped, False)
        return MaiteTarget(boxes[~dropped], labels[~dropped], scores[~dropped]), hidden
