"""The largest changes of a study, before and after, to be looked at: is what counts as feasible also credible?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from drivesem.report.drawing import MARGIN_PX, PAPER, TEXT_PX, paste, write_picture, write_text
from drivesem.report.tables import format_count
from drivesem.run.folder import ARMS
from drivesem.run.results import FrameResult
from scene_ir import files
from tools.experiments.detection.counts import change_size
from tools.experiments.detection.running import ArmRun

MAX_CHANGES = 10
WIDTH_PX = 800
"""Of each of both pictures."""
_LINE_PX = TEXT_PX + 8


@dataclass(frozen=True, slots=True)
class LargeChange:
    """One frame of one arm. size: norm of theta, each coordinate in units of its bounds."""

    arm: str
    folder: Path
    result: FrameResult
    size: float


def find_largest_changes(runs: Sequence[ArmRun], out: Path) -> list[LargeChange]:
    """The SHOWN largest changes of arms that are no controls, the largest first; of one frame only one."""
    found: dict[str, LargeChange] = {}
    for run in runs:
        if run.arm.control is not None:
            continue
        for result in run.results:
            folder = out / ARMS / run.arm.folder / "frames" / result.identifier
            change = LargeChange(run.arm.name, folder, result, change_size(result))
            known = found.get(result.identifier)
            if change.size > 0 and (known is None or change.size > known.size):
                found[result.identifier] = change
    return sorted(found.values(), key=lambda c: (-c.size, c.result.identifier))[:MAX_CHANGES]


def write_largest_changes(path: Path, changes: Sequence[LargeChange]) -> None:
    """Photographs to the left, counterexamples to the right, a row for each change. None: no file."""
    rows = [_row(change) for change in changes]
    if not rows:
        return
    canvas = np.empty((sum(map(len, rows)) + (len(rows) + 1) * MARGIN_PX, rows[0].shape[1], 3), np.uint8)
    canvas[:] = PAPER
    y = MARGIN_PX
    for row in rows:
        paste(canvas, (0, y), row)
        y += len(row) + MARGIN_PX
    write_picture(path, canvas)


def _row(change: LargeChange) -> np.ndarray:
    pictures = [_shrunk(files.read_image(change.folder / name)) for name in ("benign.png", "counterexample.png")]
    high = max(map(len, pictures))
    row = np.empty((high + _LINE_PX, 2 * WIDTH_PX + 3 * MARGIN_PX, 3), np.uint8)
    row[:] = PAPER
    result = change.result
    lost = sum(failure.kind == "lost" for failure in result.failures)
    told = f"{lost} lost, {format_count(len(result.failures) - lost, 'phantom')}"
    write_text(row, (MARGIN_PX, 0), f"{result.identifier}, {change.arm}: size {change.size:.2f}, {told}")
    for column, picture in enumerate(pictures):
        paste(row, (MARGIN_PX + column * (WIDTH_PX + MARGIN_PX), _LINE_PX), picture)
    return row


def _shrunk(picture: np.ndarray) -> np.ndarray:
    height = round(WIDTH_PX * picture.shape[0] / picture.shape[1])
    return cv2.resize(picture, (WIDTH_PX, height), interpolation=cv2.INTER_AREA)
