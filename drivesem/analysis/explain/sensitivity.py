"""Computes and draws the sensitivity of a detector's loss to each pixel, |d loss / d pixel|."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from drivesem.attacks.objective import Objective, RenderEvaluation
from drivesem.reporting.drawing import (
    MARGIN_PX,
    PAPER_COLOUR,
    TEXT_COLOUR,
    TEXT_PX,
    LabelLayout,
    TextLabel,
    fade_to_grey,
    paste,
    write_text,
)

Floats = NDArray[np.floating]
Picture = NDArray[np.uint8]

_BLUR_PX = 1.5
"""Standard deviation of the blur, which hides how gradients alternate with a network's strides."""
_BRIGHTEST_QUANTILE = 0.995
"""Quantile of the gradient drawn at full brightness, as few pixels have most of it."""


def pixel_gradient(objective: Objective, rendered: RenderEvaluation) -> Floats:
    """Compute |d loss / d pixel| (H, W), the norm over colours, of a rendered picture.

    Raises RangeError if the detector has no gradient.
    """
    image = rendered.render.image.detach().clone().requires_grad_(True)
    with torch.enable_grad():
        raw = objective.differentiable(image[None])
        loss = objective.loss_from_predictions(raw, rendered.scene, rendered.render)
    (gradient,) = torch.autograd.grad(loss, image)
    return gradient.norm(dim=0).cpu().numpy()


def gradient_shares(gradient: Floats, object_id: NDArray[np.int64], count: int) -> tuple[float, ...]:
    """Compute the share of a gradient on each object, and on the background.

    Args:
        gradient: Gradient (H, W).
        object_id: Object of each pixel (H, W): 0 is background, i + 1 object i.
        count: Number of objects.

    Returns:
        Shares in [0, 1], the background last; all 0 if the gradient is 0.
    """
    sums = np.bincount(object_id.ravel(), weights=gradient.ravel(), minlength=count + 1)
    total = float(sums.sum())
    return tuple(float(s) / total if total else 0.0 for s in (*sums[1:], sums[0]))


def draw_heatmap(image: Picture, gradient: Floats, brightest: float) -> Picture:
    """Draw a blurred gradient over a pale picture.

    Args:
        image: Picture (H, W, 3).
        gradient: Gradient (H, W).
        brightest: Value at full brightness.
    """
    level = np.clip(_blur(gradient) / brightest, 0, 1) if brightest > 0 else np.zeros_like(gradient)
    heat = cv2.applyColorMap((255 * level).round().astype(np.uint8), cv2.COLORMAP_INFERNO)[..., ::-1]
    opacity = np.sqrt(level)[..., None]
    return (fade_to_grey(image) * (1 - opacity) + heat * opacity).round().astype(np.uint8)


def place_object_numbers(size_wh: tuple[int, int], boxes_xyxy: Floats) -> LabelLayout:
    """Place each object's number, in brackets, in the middle of its box (N, 4) xyxy px, or near it."""
    labels = LabelLayout(size_wh)
    for i, box in enumerate(boxes_xyxy.tolist()):
        labels.add(box, TextLabel(f"[{i}]", TEXT_COLOUR, PAPER_COLOUR, TEXT_PX), within=True)
    return labels


def draw_object_numbers(image: Picture, boxes_xyxy: Floats) -> Picture:
    """Draw each object's number at its box (N, 4) xyxy px into a picture (H, W, 3)."""
    canvas = image.copy()
    place_object_numbers((image.shape[1], image.shape[0]), boxes_xyxy).draw(canvas)
    return canvas


def draw_sensitivity_sheet(rows: Sequence[tuple[str, Picture, Floats, Floats]]) -> Picture:
    """Draw each picture, with numbered objects, next to its gradient, all on one scale.

    Args:
        rows: Name, picture (H, W, 3), boxes (N, 4) xyxy px, and gradient (H, W).
    """
    blurred = np.concatenate([_blur(gradient).ravel() for *_, gradient in rows])
    brightest = float(np.quantile(blurred, _BRIGHTEST_QUANTILE))
    height, width = rows[0][1].shape[:2]
    step = height + TEXT_PX + 2 * MARGIN_PX
    canvas = np.full((len(rows) * step + MARGIN_PX, 2 * width + 3 * MARGIN_PX, 3), PAPER_COLOUR, np.uint8)
    for i, (name, image, boxes_xyxy, gradient) in enumerate(rows):
        y = i * step + MARGIN_PX
        write_text(canvas, (MARGIN_PX, y), name, TEXT_COLOUR)
        write_text(canvas, (2 * MARGIN_PX + width, y), f"{name}: |d loss / d pixel|", TEXT_COLOUR)
        y += TEXT_PX + MARGIN_PX // 2
        paste(canvas, (MARGIN_PX, y), draw_object_numbers(image, boxes_xyxy))
        paste(canvas, (2 * MARGIN_PX + width, y), draw_heatmap(image, gradient, brightest))
    return canvas


def _blur(gradient: Floats) -> Floats:
    return np.asarray(cv2.GaussianBlur(gradient, (0, 0), _BLUR_PX), dtype=gradient.dtype)
