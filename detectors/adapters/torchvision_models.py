"""torchvision's detection models (Faster R-CNN, RetinaNet, SSD, FCOS) with a gradient to the image.

Their `forward` ends in a selection without a gradient. Here the heads' outputs are taken for all anchors; for
Faster R-CNN those for the proposals, which are constant in the gradient.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detectors.adapters.dense import DenseDetector, DensePredictions
from detectors.adapters.spec import CLASS_LISTS, NO_CLASS, load_spec, with_project_names
from detectors.base import DetectorError
from detectors.files import read_state

BACKGROUND = 1
"""Score columns before the first class."""


class TorchvisionDetector(DenseDetector):
    """One of torchvision's models."""

    def __init__(self, name: str, model: nn.Module, names: Sequence[str]) -> None:
        """names: of all score columns, "" for none."""
        super().__init__(name, [n for n in names if n != NO_CLASS])
        self.model = model
        self._columns = [i for i, n in enumerate(names) if n != NO_CLASS]
        self._fixed_proposals: tuple[Tensor, ...] | None = None

    def predict(self, images: Tensor) -> DensePredictions:
        """Predictions after the model's own normalisation and resizing; boxes in px of the given images."""
        model: Any = self.model
        image_hw = int(images.shape[2]), int(images.shape[3])
        resized_images, _ = model.transform(list(images), None)
        features = model.backbone(resized_images.tensors)
        maps = [features] if isinstance(features, Tensor) else list(features.values())
        proposals_used: tuple[Tensor, ...] = ()
        if hasattr(model, "roi_heads"):
            boxes, probabilities, proposals_used = self._predict_proposals(model, resized_images, features)
        else:
            boxes, probabilities = self._predict_anchors(model, resized_images, maps)
        resized = resized_images.image_sizes[0]
        scale = boxes.new_tensor([image_hw[1] / resized[1], image_hw[0] / resized[0]]).repeat(2)
        columns = torch.tensor(self._columns, device=boxes.device)
        boxes = boxes[:, :, columns] if boxes.shape[2] > 1 else boxes
        # From edges measured from the corner to integer pixel centres.
        counts = tuple(len(proposals) for proposals in proposals_used) if proposals_used else None
        return DensePredictions(boxes * scale - 0.5, probabilities[..., columns], image_hw, proposals_used, counts)

    @contextmanager
    def freeze_choices(self, raw: DensePredictions) -> Iterator[None]:
        """Make Faster R-CNN use the proposals of `raw`."""
        self._fixed_proposals = raw.constants or None
        try:
            yield
        finally:
            self._fixed_proposals = None

    def _predict_anchors(self, model: Any, resized_images: Any, maps: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Boxes (B, A, 1, 4) px of the resized images and probabilities (B, A, N) of all anchors."""
        outputs = model.head(maps)
        anchors = model.anchor_generator(resized_images, maps)
        logits, offsets = outputs["cls_logits"], outputs["bbox_regression"]
        if "bbox_ctrness" in outputs:
            boxes = torch.stack([model.box_coder.decode(o, a) for o, a in zip(offsets, anchors, strict=True)])
            # The root of the product in logarithms: the slope of the root is infinite at 0.
            both = F.logsigmoid(logits) + F.logsigmoid(outputs["bbox_ctrness"])
            return boxes[:, :, None], (both / 2).exp()
        boxes = torch.stack([model.box_coder.decode_single(o, a) for o, a in zip(offsets, anchors, strict=True)])
        is_ssd = type(model).__name__ == "SSD"
        return boxes[:, :, None], logits.softmax(-1) if is_ssd else logits.sigmoid()

    def _predict_proposals(
        self, model: Any, resized_images: Any, features: Any
    ) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """Boxes (B, A, N, 4) px of the resized images, probabilities (B, A, N), and each image's proposals."""
        proposals = self._fixed_proposals
        if proposals is None:
            with torch.no_grad():
                proposals = tuple(model.rpn(resized_images, features)[0])
        heads = model.roi_heads
        pooled = heads.box_head(heads.box_roi_pool(features, list(proposals), resized_images.image_sizes))
        logits, offsets = heads.box_predictor(pooled)
        boxes = heads.box_coder.decode(offsets, list(proposals))
        counts = [len(p) for p in proposals]
        most = max(counts)
        # Padded with boxes of no size and no probability, so that images share one tensor.
        padded_boxes = torch.stack([F.pad(b, (0, 0, 0, 0, 0, most - len(b))) for b in boxes.split(counts)])
        padded = torch.stack([F.pad(p, (0, 0, 0, most - len(p))) for p in logits.softmax(-1).split(counts)])
        return padded_boxes, padded, proposals


def load_torchvision(name: str, weights: str = "default", spec: Path | None = None) -> TorchvisionDetector:
    """One of torchvision's detection models by its name there.

    Args:
        name: The model's name.
        weights: "default", torchvision's weights, downloaded if not in its cache; "none", random; or a file with a
            `state_dict`, read with `weights_only`.
        spec: YAML file with `classes` (and `t_star`, ...) of a model trained on others than COCO's, without
            background.

    Raises:
        DetectorError: A name, file or weights that do not fit, or torchvision is missing.
    """
    try:
        from torchvision.models import (  # pyright: ignore[reportMissingImports]
            detection,
            get_model,
            get_model_weights,
            list_models,
        )
    except ModuleNotFoundError:
        raise DetectorError(f"torchvision:{name}: needs torchvision: drivesem doctor has the command") from None
    except (ImportError, RuntimeError) as error:
        expected = f"a torchvision that fits torch {torch.__version__} (drivesem doctor has the command)"
        raise DetectorError(f"torchvision:{name}: expected {expected}, found {error}") from None
    known = [n for n in list_models(detection) if not n.startswith(("maskrcnn", "keypointrcnn"))]
    if name not in known:
        raise DetectorError(f"torchvision: expected one of {', '.join(known)}, found {name!r}")
    settings = {} if spec is None else load_spec(spec)
    names = (NO_CLASS, *settings["classes"]) if "classes" in settings else CLASS_LISTS["coco91"]
    if weights == "default" and "classes" in settings:
        raise DetectorError(f"torchvision:{name}: expected a weights file with other classes, found default")
    if weights == "default":
        try:
            model = get_model(name, weights="DEFAULT")
        except (OSError, RuntimeError) as error:
            raise DetectorError(f"torchvision:{name}: cannot load its weights: {error}") from None
        categories = get_model_weights(name)["DEFAULT"].meta["categories"]
        names = with_project_names(NO_CLASS if n in ("__background__", "N/A") else n for n in categories)
    else:
        model = get_model(name, weights=None, weights_backbone=None, num_classes=len(names))
    if weights not in ("default", "none"):
        _load_into(model, Path(weights))
    detector = TorchvisionDetector(name, model, names)
    for key in ("t_star", "nms_iou", "least_score"):
        if settings.get(key) is not None:
            setattr(detector, key, settings[key])
    return detector


def _load_into(model: nn.Module, path: Path) -> None:
    state = read_state(path, f"weights of {type(model).__name__}")
    try:
        model.load_state_dict(state)
    except (RuntimeError, TypeError, AttributeError, ValueError) as error:
        lines = itertools.islice((line.strip() for line in str(error).splitlines() if line.strip()), 2)
        raise DetectorError(
            f"{path}: expected weights of {type(model).__name__}, found {' '.join(lines)}"
        ) from None
