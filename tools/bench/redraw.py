"""The second renderer of photographs against the photograph and the compositor: pixels and detections.

Pyrender draws each scene as it was photographed, and once more with its cars moved. A picture in which a detector
that was trained elsewhere finds cars less often than in the photograph would confirm failures that are its own.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from detectors.base import Predictor
from detectors.registry import load_predictor
from drivesem.bench.session import Columns
from drivesem.failures.second_renderer.photograph import PhotographRenderer
from drivesem.reporting.drawing import PAPER_COLOUR, write_text
from drivesem.run.workers import run_jobs
from scene_ir import files
from scene_ir.render.compositor import Compositor
from scene_ir.types import Category, SceneIR
from tools.bench.found import LEAST_HEIGHT_PX, MOST_OCCLUSION, CarMoves, frame_names, open_scene_source
from tools.bench.settings import BenchTool
from tools.bench.sights import CarView, DetectorView

TITLE = "The second renderer of photographs"
COLUMNS: Columns = {
    "frame": ("frame", "frame"), "cars": ("cars", "cars"), "apart": ("apart on vehicles, levels", "apart"),
    "psnr_db": ("PSNR there, dB", "PSNR"), "apart_outside": ("apart outside them, levels", "outside"),
    "psnr_moved_db": ("moved, PSNR to ours, dB", "moved"), "photograph": ("found in the photograph", "photo"),
    "ours": ("in ours", "ours"), "second": ("in the second's", "second"), "moved": ("moved cars", "moved cars"),
    "ours_moved": ("found in ours", "ours"), "second_moved": ("in the second's ", "second"),
    "made_s": ("making it, s", "made, s"), "picture_s": ("a picture, s", "picture, s"),
}  # fmt: skip
METHOD = (
    "Cars (KITTI's Car and Van) that became objects, at least 25 px high, at most partly occluded by label. "
    "Apart: mean absolute difference, in levels of 255, of pyrender's unchanged picture from the photograph, over "
    "the pixels that are a vehicle's in ours (opacity of at least one half), and over all others; "
    "PSNR over the former. Moved: cars by 0.5 m along their headings and by 10 degrees, signs by seed, as bench "
    "found moves them; PSNR of pyrender's picture to ours over the pixels that are a vehicle's in ours. Found: a "
    "detection of class Car with a score above 0.3 and an IoU of at least 0.5 with the label, each for one car "
    "only. Seconds of CPU time: textures are baked once a scene; a picture is one state, drawn and labelled."
)


@dataclass(frozen=True, slots=True)
class RedrawRow:
    """One frame."""

    frame: str
    cars: int
    """Judged."""
    apart: float | None
    psnr_db: float | None
    apart_outside: float
    psnr_moved_db: float | None
    photograph: int
    """Of these found in the pictures without a change."""
    ours: int
    """Of these found in the pictures without a change."""
    second: int
    """Of these found in the pictures without a change."""
    moved: int
    """Cars that were moved, and how many of these are found; None where nothing could be compared."""
    ours_moved: int
    second_moved: int
    made_s: float
    picture_s: float


def measure(config: BenchTool, sheets: Path | None = None) -> Iterator[tuple[str, RedrawRow]]:
    """Frame by frame, in the order in which they are done. config: as of `found.measure`; sheets: a folder that
    gets a picture of each frame. Raises NoSecondRendererError where pyrender cannot draw.
    """
    judge = _RedrawJudge(config, sheets)
    names = frame_names(config)
    for name, outcome in run_jobs(judge.frame, partial(_in_process, config, sheets), names, config):
        yield name, outcome()


def _in_process(config: BenchTool, sheets: Path | None) -> Callable[[str], RedrawRow]:
    return _RedrawJudge(config, sheets).frame


class _RedrawJudge:
    """What one process needs: built once, used for many frames."""

    def __init__(self, config: BenchTool, sheets: Path | None) -> None:
        self._config, self._sheets = config, sheets
        self._source = open_scene_source(config)
        self._predictor = load_predictor(config.detector, config.device, config.tiles)

    def frame(self, name: str) -> RedrawRow:
        number = frame_names(self._config).index(name)
        rng = np.random.default_rng([self._config.seed, number])
        return judge(name, self._source.scene(name), self._predictor, rng, self._sheets)


@torch.no_grad()
def judge(
    name: str, scene: SceneIR, predictor: Predictor, rng: np.random.Generator, sheets: Path | None = None
) -> RedrawRow:
    """One scene by both renderers. rng: signs of the moves. sheets: a folder for the pictures side by side."""
    objects = scene.objects
    cars = (objects.category == int(Category.CAR)).nonzero()[:, 0].tolist()
    height = objects.box2d[:, 3] - objects.box2d[:, 1]
    judged = [i for i in cars if height[i] >= LEAST_HEIGHT_PX and objects.occlusion[i] <= MOST_OCCLUSION]
    start = time.process_time()
    second = PhotographRenderer(name, scene)
    made = time.process_time()
    drawn = second.render(scene)
    ended = time.process_time()
    compositor, eye = Compositor(scene), DetectorView(predictor)
    ours = compositor.render(scene)
    moves = CarMoves(scene, cars, rng)
    together = moves.together()
    ours_moved = compositor.render(together.scene)
    moved = second.render(together.scene)
    row_of_moved = [i for i in judged if i in moves.in_crowd]
    first = [eye.view_cars(image, objects.box2d) for image in (scene.photograph, ours.image, drawn.image)]
    then = [eye.view_cars(image, together.boxes_xyxy) for image in (ours_moved.image, moved.image)]
    if sheets is not None:
        pictures = [view.picture for view in (first[0], first[2], *then)]
        files.write_png(sheets / f"{name.replace('/', '-')}.png", _sheet(name, pictures))
    on = ours.object_id > 0
    return RedrawRow(
        frame=name,
        cars=len(judged),
        apart=_apart(drawn.image, scene.photograph, on),
        psnr_db=_psnr(drawn.image, scene.photograph, on),
        apart_outside=_apart(drawn.image, scene.photograph, ~on) or 0.0,
        psnr_moved_db=_psnr(moved.image, ours_moved.image, ours_moved.object_id > 0),
        photograph=_found(first[0], judged),
        ours=_found(first[1], judged),
        second=_found(first[2], judged),
        moved=len(row_of_moved),
        ours_moved=_found(then[0], row_of_moved),
        second_moved=_found(then[1], row_of_moved),
        made_s=round(made - start, 2),
        picture_s=round(ended - made, 2),
    )


def summary(rows: Sequence[RedrawRow]) -> list[dict[str, Any]]:
    """A line a frame with vehicles, and one of all: sums of cars, means of the rest."""
    redrawn = [row for row in rows if row.apart is not None]
    lines: list[dict[str, Any]] = [{key: getattr(row, key) for key in COLUMNS} for row in redrawn]
    if not redrawn:
        return lines
    total: dict[str, Any] = {"frame": "all"}
    for key in list(COLUMNS)[1:]:
        values = [value for row in redrawn if (value := getattr(row, key)) is not None]
        counts = all(isinstance(value, int) for value in values)
        total[key] = sum(values) if counts else round(sum(values) / len(values), 2) if values else None
    return [*lines, total]


def _found(view: CarView, rows: Sequence[int]) -> int:
    return sum(view.assigned[row].found for row in rows)


def _apart(one: Tensor, two: Tensor, where: Tensor) -> float | None:
    """Mean absolute difference of pictures (3, H, W) over pixels (H, W), in levels; None of none."""
    return round(255 * float((one - two).abs()[:, where].mean()), 2) if bool(where.any()) else None


def _psnr(one: Tensor, two: Tensor, where: Tensor) -> float | None:
    if not bool(where.any()):
        return None
    error = float((one - two).square()[:, where].mean())
    return round(-10 * math.log10(max(error, 1e-10)), 1)


def _sheet(name: str, pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Photograph and pyrender's picture above, both renderers' after the move below."""
    titles = (f"{name}, photograph", "pyrender, without a change", "ours, cars moved", "pyrender, cars moved")
    cells = []
    for title, picture in zip(titles, pictures, strict=True):
        cell = np.full((picture.shape[0] + 26, picture.shape[1], 3), PAPER_COLOUR, np.uint8)
        cell[26:] = picture
        write_text(cell, (4, 2), title)
        cells.append(cell)
    sheet = np.vstack([np.hstack(cells[:2]), np.hstack(cells[2:])])
    return cv2.resize(sheet, None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)
