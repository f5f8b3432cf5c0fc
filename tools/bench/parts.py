"""CPU time of each part of de-rendering, with a fit and with --fast."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from statistics import mean, median
from typing import Any
from unittest.mock import patch

from drivesem.bench.session import Columns
from scene_ir.derender import alignment as stand
from scene_ir.derender import background_fill as behind
from scene_ir.derender import depth, shadow, silhouette
from scene_ir.derender import derender as taking
from scene_ir.derender import occluders as front
from scene_ir.derender import paint_mask as paint
from scene_ir.derender import segmentation as segment
from scene_ir.derender.derender import DerenderSettings, derender
from scene_ir.types import Frame
from tools.bench.label_free import load_frame_without_labels, names
from tools.bench.settings import BenchTool

TITLE = "Where the time of taking a photograph apart goes"
COLUMNS: Columns = {
    "part": ("part", "part"),
    "fit_s": ("with a fit, s a frame", "fit"), "fit_median": ("median", "median"),
    "fast_s": ("--fast, s a frame", "--fast"), "fast_median": ("median", "median"),
}  # fmt: skip
METHOD = (
    "Seconds of the processor, one thread, over all frames: the mean, and the median. Each frame is de-rendered "
    "with both settings in turn, after one that is not counted. A part's time is that of the functions that do it."
)
PARTS: dict[str, Sequence[tuple[Any, str]]] = {
    "template and heading": [(stand, "choose_pose")],
    "segmentation": [(taking._VehicleSegmenter, "first_mask"), (taking._VehicleSegmenter, "cut_out")],
    "fit": [(silhouette, "fit_silhouettes")],
    "occluders": [(front, "find_labelled_occluders"), (front, "compute_opacities")],
    "maps": [(segment, "segment_photograph")],
    "light and shadows": [(shadow, "estimate_ground_light"), (taking, "_find_shadows")],
    "fill behind": [(behind.BackgroundFill, "fill_hole")],
    "depth": [(depth, "estimate_depth")],
    "sources": [(taking, "solve_sources")],
    "paint": [(paint, "add_paint_regions")],
}
"""Functions by what they do; none of them calls another one."""
REST, WHOLE = "the rest", "all"


@dataclass(frozen=True, slots=True)
class DerenderedStreet:
    """Seconds of one frame by part, with a fit and with --fast."""

    fit: dict[str, float]
    fast: dict[str, float]


def measure(config: BenchTool) -> Iterator[DerenderedStreet]:
    """Frame by frame. Raises SceneError for one that cannot be used."""
    chosen = names(config)
    for place, name in enumerate((chosen[0], *chosen)):
        frame = load_frame_without_labels(config, name)
        taken = DerenderedStreet(spent(frame, DerenderSettings()), spent(frame, DerenderSettings.fast()))
        if place:  # the first time loads kernels and networks
            yield taken


def spent(frame: Frame, settings: DerenderSettings) -> dict[str, float]:
    """Seconds of the processor by part."""
    seconds = dict.fromkeys(PARTS, 0.0)
    with ExitStack() as watched:
        for part, functions in PARTS.items():
            for owner, name in functions:
                watched.enter_context(_timed(owner, name, part, seconds))
        start = time.process_time()
        derender(frame, settings)
        whole = time.process_time() - start
    return seconds | {REST: whole - sum(seconds.values()), WHOLE: whole}


@contextmanager
def _timed(owner: Any, name: str, part: str, seconds: dict[str, float]) -> Iterator[None]:
    """Adds what a function of a module or a class takes to its part."""
    function: Callable[..., Any] = getattr(owner, name)

    def timed(*words: Any, **named: Any) -> Any:
        start = time.process_time()
        try:
            return function(*words, **named)
        finally:
            seconds[part] += time.process_time() - start

    with patch.object(owner, name, timed):
        yield


def summary(rows: Sequence[DerenderedStreet]) -> list[dict[str, Any]]:
    """A row a part, and one for all."""
    found = []
    for part in (*PARTS, REST, WHOLE):
        fit, fast = ([getattr(row, way)[part] for row in rows] for way in ("fit", "fast"))
        metrics = {
            "fit_s": mean(fit),
            "fit_median": median(fit),
            "fast_s": mean(fast),
            "fast_median": median(fast),
        }
        found.append({"part": part} | {name: round(value, 3) for name, value in metrics.items()})
    return found
