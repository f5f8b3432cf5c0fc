"""Contact sheet of a data set: images in a grid, with the boxes of their labels by use."""

from __future__ import annotations

import math

import cv2
import numpy as np

from drivesem.data.classes import CLASS_OF_TYPE, object_type
from drivesem.data.subsets import DatasetSelection
from drivesem.reporting.drawing import (
    IGNORED_COLOUR,
    LOST_COLOUR,
    MARGIN_PX,
    PAPER_COLOUR,
    TEXT_PX,
    TRUE_COLOUR,
    LabelLayout,
    TextLabel,
    paste,
    write_text,
)
from scene_ir.errors import FormatError
from scene_ir.io import to_uint8
from scene_ir.types import Frame

WIDTH_PX = 560
"""Width of an image on the sheet."""
_COLUMNS = 3
_MIN_LABELLED_PX = 14
"""Boxes of a lower height on the sheet have no name."""
_COLOURS = {"used": TRUE_COLOUR, "ignored": LOST_COLOUR, "background": IGNORED_COLOUR}


def draw_contact_sheet(dataset: DatasetSelection, count: int) -> np.ndarray:
    """Draw evenly spaced frames of a data set, three in a row, under a legend.

    Args:
        dataset: The frames.
        count: Number of frames.

    Returns:
        Picture (h, w, 3) uint8 RGB.
    """
    names = dataset.identifiers
    chosen = sorted({round(i) for i in np.linspace(0, len(names) - 1, min(count, len(names)))})
    panels = [_draw_panel(dataset, names[i]) for i in chosen]
    columns = min(_COLUMNS, len(panels))
    rows = [panels[i : i + columns] for i in range(0, len(panels), columns)]
    heights = [max(panel.shape[0] for panel in row) + MARGIN_PX for row in rows]
    top = TEXT_PX + 2 * MARGIN_PX
    size = (top + sum(heights), MARGIN_PX + columns * (WIDTH_PX + MARGIN_PX), 3)
    sheet = np.full(size, PAPER_COLOUR, np.uint8)
    x = MARGIN_PX
    for name, colour in _COLOURS.items():
        cv2.rectangle(sheet, (x, MARGIN_PX), (x + TEXT_PX, MARGIN_PX + TEXT_PX), colour, -1)
        write_text(sheet, (x + TEXT_PX + 6, MARGIN_PX - 1), name)
        x += 130
    for row, y in zip(rows, np.cumsum([top, *heights[:-1]]).tolist(), strict=True):
        for i, panel in enumerate(row):
            paste(sheet, (MARGIN_PX + i * (WIDTH_PX + MARGIN_PX), y), panel)
    return sheet


def _draw_panel(dataset: DatasetSelection, name: str) -> np.ndarray:
    """Draw a frame above its name and attributes; a frame that cannot be read is a blank panel with the reason."""
    try:
        frame = dataset.frame(name)
    except FormatError as error:
        panel = np.full((WIDTH_PX // 2, WIDTH_PX, 3), PAPER_COLOUR, np.uint8)
        write_text(panel, (4, WIDTH_PX // 4), f"{error}"[-80:], LOST_COLOUR, 11)
        return panel
    height, width = frame.photograph.shape[1:]
    scale = WIDTH_PX / width
    picture = cv2.resize(
        to_uint8(frame.photograph), (WIDTH_PX, math.ceil(height * scale)), interpolation=cv2.INTER_AREA
    )
    _draw_boxes(picture, frame, scale)
    panel = np.full((picture.shape[0] + TEXT_PX + 6, WIDTH_PX, 3), PAPER_COLOUR, np.uint8)
    paste(panel, (0, 0), picture)
    words = [name, *(f"{key} {value}" for key, value in frame.attributes.items())]
    write_text(panel, (0, picture.shape[0] + 2), ", ".join(words), size_px=TEXT_PX - 2)
    return panel


def _draw_boxes(picture: np.ndarray, frame: Frame, scale: float) -> None:
    labels = frame.labels
    if labels is None:
        return
    boxes = ((labels.boxes_xyxy + 0.5) * scale).tolist()
    layout = LabelLayout((picture.shape[1], picture.shape[0]), boxes)
    for kind, box in zip(labels.kind, boxes, strict=True):
        known = object_type(kind)
        colour = _COLOURS["background" if known is None else "used" if known in CLASS_OF_TYPE else "ignored"]
        x0, y0, x1, y1 = (round(value) for value in box)
        cv2.rectangle(picture, (x0, y0), (x1, y1), colour, 1, cv2.LINE_AA)
        if known is not None and y1 - y0 >= _MIN_LABELLED_PX:
            layout.add(box, TextLabel(kind, colour))
    for box in ((labels.ignore_xyxy + 0.5) * scale).tolist():
        x0, y0, x1, y1 = (round(value) for value in box)
        cv2.rectangle(picture, (x0, y0), (x1, y1), _COLOURS["ignored"], 1)
        cv2.line(picture, (x0, y0), (x1, y1), _COLOURS["ignored"], 1, cv2.LINE_AA)
    layout.draw(picture)
