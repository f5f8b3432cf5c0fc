"""Where a detector's loss hangs on the picture: |d loss / d pixel|, over the picture it was taken at."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from drivesem.attack.objective import Objective, Rendered
from drivesem.report.drawing import INK, MARGIN_PX, PAPER, TEXT_PX, Label, Labels, pale, paste, write_text

Floats = NDArray[np.floating]
Picture = NDArray[np.uint8]

_BLUR_PX = 1.5
"""Standard deviation of the blur: neighbouring pixels' gradients alternate with a network's strides."""
_BRIGHTEST = 0.995
"""Share of the pixels that are not as bright as can be: a few take most of the gradient."""


def pixel_gradient(objective: Objective, rendered: Rendered) -> Floats:
    """|d loss / d pixel| (H, W), the norm over the colours, of a rendered picture as the detector sees it.

    Raises RangeError where the detector has no gradient.
    """
    image = rendered.render.image.detach().clone().requires_grad_(True)
    with torch.enable_grad():
        raw = objective.differentiable(image[None])
        loss = objective.loss_of(raw, rendered.scene, rendered.render)
    (gradient,) = torch.autograd.grad(loss, image)
    return gradient.norm(dim=0).cpu().numpy()


def shares(gradient: Floats, object_id: NDArray[np.int64], count: int) -> tuple[float, ...]:
    """Which part of a gradient (H, W) falls on each of `count` objects, and last on the background.

    object_id (H, W): 0 is background, i + 1 object i, as `Render` has it. All 0 where there is no gradient.
    """
    sums = np.bincount(object_id.ravel(), weights=gradient.ravel(), minlength=count + 1)
    total = float(sums.sum())
    return tuple(float(s) / total if total else 0.0 for s in (*sums[1:], sums[0]))


def overlay(image: Picture, gradient: Floats, brightest: float) -> Picture:
    """A gradient (H, W), blurred, as heat over the picture (H, W, 3) in pale grey. brightest: the scale's end."""
    level = np.clip(_blurred(gradient) / brightest, 0, 1) if brightest > 0 else np.zeros_like(gradient)
    heat = cv2.applyColorMap((255 * level).round().astype(np.uint8), cv2.COLORMAP_INFERNO)[..., ::-1]
    opacity = np.sqrt(level)[..., None]
    return (pale(image) * (1 - opacity) + heat * opacity).round().astype(np.uint8)


def numbers(size_wh: tuple[int, int], boxes_xyxy: Floats) -> Labels:
    """Each object's number, in brackets, in the middle of its box (N, 4) px of a picture, or near it."""
    labels = Labels(size_wh)
    for i, box in enumerate(boxes_xyxy.tolist()):
        labels.add(box, Label(f"[{i}]", INK, PAPER, TEXT_PX), within=True)
    return labels


def numbered(image: Picture, boxes_xyxy: Floats) -> Picture:
    """A picture (H, W, 3) with each object's number at its box (N, 4) px."""
    canvas = image.copy()
    numbers((image.shape[1], image.shape[0]), boxes_xyxy).draw(canvas)
    return canvas


def sheet(rows: Sequence[tuple[str, Picture, Floats, Floats]]) -> Picture:
    """Each named picture (H, W, 3), its objects numbered in their boxes (N, 4) px, beside its gradient (H, W), one
    below the other, on one scale of brightness.
    """
    blurred = np.concatenate([_blurred(gradient).ravel() for *_, gradient in rows])
    brightest = float(np.quantile(blurred, _BRIGHTEST))
    height, width = rows[0][1].shape[:2]
    step = height + TEXT_PX + 2 * MARGIN_PX
    canvas = np.full((len(rows) * step + MARGIN_PX, 2 * width + 3 * MARGIN_PX, 3), PAPER, np.uint8)
    for i, (name, image, boxes_xyxy, gradient) in enumerate(rows):
        y = i * step + MARGIN_PX
        write_text(canvas, (MARGIN_PX, y), name, INK)
        write_text(canvas, (2 * MARGIN_PX + width, y), f"{name}: |d loss / d pixel|", INK)
        y += TEXT_PX + MARGIN_PX // 2
        paste(canvas, (MARGIN_PX, y), numbered(image, boxes_xyxy))
        paste(canvas, (2 * MARGIN_PX + width, y), overlay(image, gradient, brightest))
    return canvas


def _blurred(gradient: Floats) -> Floats:
    return np.asarray(cv2.GaussianBlur(gradient, (0, 0), _BLUR_PX), dtype=gradient.dtype)
