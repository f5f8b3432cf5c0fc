"""Anchor shapes for a data set, and how well they fit beside the published ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from detectors.anchors import fit_anchors, mean_best_iou
from detectors.squeezedet import ANCHOR_SIZES_WH
from drivesem.config.commands import Anchors
from drivesem.config.errors import UsageError
from drivesem.data.registry import Dataset, open_dataset
from scene_ir.errors import FormatError


def fitted_anchors(config: Anchors) -> dict[str, Any]:
    """Read the labels and fit: the JSON's form. Raises UsageError or SceneError for bad input."""
    dataset = open_dataset(config.dataset, Path(config.root))
    names = dataset.identifiers[: config.limit]
    sizes = _sizes(dataset, names, config)
    different = len(np.unique(sizes, axis=0))
    if config.count > different:
        raise UsageError("--count", f"at most {different}, the number of different sizes", config.count)
    found = fit_anchors(sizes, config.count, config.seed)
    return {
        "dataset": config.dataset,
        "frames": len(names),
        "boxes": len(sizes),
        "min_height": config.min_height,
        "anchors": [[round(w, 2), round(h, 2)] for w, h in found.sizes_wh],
        "mean_iou": round(found.mean_iou, 4),
        "published_anchors": [list(size) for size in ANCHOR_SIZES_WH],
        "published_mean_iou": round(mean_best_iou(sizes, np.array(ANCHOR_SIZES_WH)), 4),
    }


def _sizes(dataset: Dataset, names: tuple[str, ...], config: Anchors) -> np.ndarray:
    """(N, 2) width and height, px, of the labelled boxes that count, those to ignore left out."""
    wanted = None if config.classes is None else {name.strip() for name in config.classes.split(",")}
    sizes, kinds = [], set[str]()
    for name in names:
        labels = dataset.labels(name)
        if labels is None:
            raise FormatError(f"frame {name}", "labels", "none")
        kinds.update(labels.kind)
        corners = labels.boxes_xyxy.double().numpy()
        size = corners[:, 2:] - corners[:, :2]
        named = np.array([wanted is None or kind in wanted for kind in labels.kind], dtype=bool)
        sizes.append(size[named & (size[:, 0] > 0) & (size[:, 1] >= config.min_height)])
    if wanted is not None and not wanted <= kinds:
        raise UsageError("--classes", f"some of {', '.join(sorted(kinds))}", ", ".join(sorted(wanted - kinds)))
    joined = np.concatenate([np.zeros((0, 2)), *sizes])
    if not len(joined):
        raise UsageError("--root", f"boxes of at least {config.min_height:g} px", f"none in {len(names)} frames")
    return joined
