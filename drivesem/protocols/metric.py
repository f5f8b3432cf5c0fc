"""COCO's metrics as MAITE's `Metric`: what `drivesem eval` computes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from detectors.types import CLASSES, Detections, Targets
from drivesem.attacks.targets import DEFAULT_T_STAR, HEADLINE
from drivesem.config.errors import UsageError
from drivesem.evaluation import coco
from drivesem.protocols.dataset import IGNORED_BOXES


class MaiteMetric:
    """COCO's average precision and recall, as of `drivesem eval`.

    Detections in `ignored_boxes` of the metadata, of `MaiteDataset` and `MaiteAttack`, do not count.
    """

    def __init__(
        self,
        index2label: Mapping[int, str] | None = None,
        *,
        t_star: float = DEFAULT_T_STAR,
        headline: str = HEADLINE,
    ) -> None:
        """Create an empty metric.

        Args:
            index2label: Classes by the numbers of labels and detections; by default Car, Truck, Pedestrian, Cyclist.
            t_star: Score from which a detection counts, for the recall.
            headline: Class of the first results.

        Raises:
            UsageError: The headline is none of the classes.
        """
        names = dict(enumerate(CLASSES)) if index2label is None else dict(index2label)
        if headline not in names.values():
            raise UsageError("headline", f"one of {', '.join(names.values())}", repr(headline))
        self._row_by_number = {number: row for row, number in enumerate(names)}
        self._names, self._t_star, self._headline = tuple(names.values()), t_star, headline
        self.metadata: dict[str, Any] = {"id": "drivesem COCO"}
        self.reset()

    def reset(self) -> None:
        """Forget all images."""
        self._targets: list[Targets] = []
        self._detections: list[Detections] = []

    def update(
        self,
        pred_batch: Sequence[Any],
        target_batch: Sequence[Any],
        metadata_batch: Sequence[Mapping[str, Any]],
        /,
    ) -> None:
        """Add images.

        Args:
            pred_batch: Detections, one MAITE target for each image.
            target_batch: Labels, one MAITE target for each image.
            metadata_batch: Metadata of each image.

        Raises:
            UsageError: A target lacks boxes, labels or scores, or has a label that is no class.
        """
        for found, labelled, metadata in zip(pred_batch, target_batch, metadata_batch, strict=True):
            boxes, labels, scores = read_target(found)
            order = scores.argsort(descending=True, stable=True)
            self._detections.append(Detections(boxes[order], self._rows(labels)[order], scores[order]))
            boxes, labels, _ = read_target(labelled)
            regions = torch.tensor(metadata.get(IGNORED_BOXES, ()), dtype=torch.float32).reshape(-1, 4)
            classes = len(self._names)
            self._targets.append(
                Targets(
                    torch.cat([boxes, regions.repeat_interleave(classes, 0)]),
                    torch.cat([self._rows(labels), torch.arange(classes).repeat(len(regions))]),
                    torch.arange(len(boxes) + classes * len(regions)) >= len(boxes),
                )
            )

    def compute(self) -> dict[str, Any]:
        """Metrics in [0, 1], or None without objects: `ap50`, `ap70`, `ap`, `recall`, `recall_at_t_star` and `objects`
        of the headline class, then `overall` and `per_class`.
        """
        return coco.evaluate(self._targets, self._detections, self._names, self._t_star, self._headline).to_json()

    def _rows(self, labels: torch.Tensor) -> torch.Tensor:
        """Rows (M,) of labels' classes."""
        unknown = set(labels.tolist()) - self._row_by_number.keys()
        if unknown:
            expected = f"labels among {', '.join(map(str, self._row_by_number))} (index2label)"
            raise UsageError("target.labels", expected, min(unknown))
        return torch.tensor([self._row_by_number[label] for label in labels.tolist()], dtype=torch.int64)


def read_target(target: Any) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Boxes (M, 4) px, labels (M,) and scores (M,) of a MAITE target.

    Raises:
        UsageError: One of these is missing or has another shape.
    """
    columns = [getattr(target, name, None) for name in ("boxes", "labels", "scores")]
    if any(values is None for values in columns):
        raise UsageError("target", "boxes, labels and scores", type(target).__name__)
    boxes, labels, scores = (torch.as_tensor(values).cpu() for values in columns)
    if scores.ndim == 2:
        scores = scores.max(1).values if len(scores) else scores.flatten()
    count = len(labels)
    if boxes.numel() != 4 * count or scores.shape != (count,):
        found = f"{tuple(boxes.shape)}, {tuple(labels.shape)} and {tuple(scores.shape)}"
        raise UsageError("target", "boxes (M, 4), labels (M,) and scores (M,)", found)
    return boxes.float().reshape(-1, 4), labels.long(), scores.float()
