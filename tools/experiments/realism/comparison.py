"""Distances between the photograph, re-render and counterexample of each frame, whole and around each vehicle."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from drivesem.evaluation.resampling import Interval, NamedMetric, bootstrap_intervals
from drivesem.run.finished import PICTURES, RunFrame
from drivesem.run.results import BoxRecord, FrameResult
from scene_ir import files
from scene_ir.errors import ShapeError
from tools.experiments.realism.metrics import (
    METRICS,
    MIN_SIDE_PX,
    Floats,
    Gaussian,
    PairDistance,
    SetFeatures,
    frechet_distance,
    psnr_db,
)
from tools.experiments.realism.perceptual import Picture

PAIRS = tuple(combinations(PICTURES, 2))
"""Photograph and re-render, photograph and counterexample, re-render and counterexample."""
REGIONS = ("frame", "boxes")
Window = tuple[slice, slice]
Box = tuple[float, float, float, float]
"""x0, y0, x1, y1 px."""
Measures = Mapping[str, PairDistance | SetFeatures]


@dataclass(frozen=True, slots=True)
class PictureRegion:
    """A whole frame, or the rectangle around one vehicle before and after (one that left or parked has one box)."""

    index: int | None
    """Index of the vehicle; None for the frame."""
    kind: str
    """Class of the vehicle."""
    distances: dict[str, dict[tuple[str, str], float]]
    """Distance by metric and pair; PSNR's as mean squared error."""
    features: dict[str, dict[str, Floats]]
    """Features (D,) by metric and picture."""


@dataclass(frozen=True, slots=True)
class FrameRegions:
    """The regions of a frame."""

    identifier: str
    """Name of the frame."""
    regions: tuple[PictureRegion, ...]
    """The whole frame, then its vehicles."""

    def select(self, name: str) -> tuple[PictureRegion, ...]:
        """The regions of one of REGIONS."""
        return self.regions[:1] if name == "frame" else self.regions[1:]


@dataclass(frozen=True, slots=True)
class RealismRow:
    """One metric of a run for one pair of pictures; None for an infinite PSNR or an unknown number."""

    region: str
    """One of REGIONS."""
    metric: str
    """Name of the metric."""
    first: str
    """First kind of picture."""
    second: str
    """Second kind of picture."""
    value: float | None
    """Mean over frames, of vehicles that of each frame's mean; PSNR of the mean squared error; Frechet distance of
    all pictures."""
    low: float | None
    """Lower end of the 95 % interval; a Frechet distance has none."""
    high: float | None
    """Upper end."""
    median: float | None
    """Median over frames."""
    pictures: int
    """Pictures of each kind."""


def box_area(box_xyxy: Box) -> float:
    """Area in px²; 0 if nothing is visible, as of a vehicle that left."""
    x0, y0, x1, y1 = box_xyxy
    return max(x1 - x0, 0) * max(y1 - y0, 0)


def enclosing_rectangle(boxes_xyxy: Sequence[Box]) -> Box:
    """The rectangle around boxes that have an area. Raises ValueError if none has one."""
    lefts, tops, rights, bottoms = zip(*(box for box in boxes_xyxy if box_area(box) > 0), strict=True)
    return min(lefts), min(tops), max(rights), max(bottoms)


def crop_window(boxes_xyxy: Sequence[Box], height: int, width: int) -> Window:
    """Rows and columns of the rectangle around boxes, inside the picture and at least MIN_SIDE_PX a side.

    Args:
        boxes_xyxy: Boxes, px.
        height: Height of the picture, px.
        width: Width of the picture, px.

    Raises:
        ShapeError: A smaller picture.
        ValueError: No box has an area.
    """
    if min(height, width) < MIN_SIDE_PX:
        raise ShapeError("picture", f"at least {MIN_SIDE_PX} px a side", f"{width}x{height}")
    x0, y0, x1, y1 = enclosing_rectangle(boxes_xyxy)
    return _span(y0, y1, height), _span(x0, x1, width)


def _span(low: float, high: float, length: int) -> slice:
    """Pixels from low to high, widened evenly and moved inside."""
    start, end = int(np.floor(np.clip(low, 0, length))), int(np.ceil(np.clip(high, 0, length)))
    size = max(end - start, MIN_SIDE_PX)
    start = min(max((start + end - size) // 2, 0), length - size)
    return slice(start, start + size)


def vehicle_boxes(result: FrameResult) -> list[tuple[BoxRecord, BoxRecord]]:
    """Boxes of the scene's objects before and after, in order, without objects that are visible in neither picture;
    the box of one that left or parked has no area in one of them.
    """
    after = {box.index: box for box in result.targets_moved if box.index is not None}
    pairs = [(box, after[box.index]) for box in result.targets_benign if box.index in after]
    return [(one, other) for one, other in pairs if box_area(one.xyxy) > 0 or box_area(other.xyxy) > 0]


def measure_frame(frame: RunFrame, measures: Measures) -> FrameRegions:
    """Measure one frame. Raises FormatError for a bad picture, ShapeError if sizes differ."""
    pictures: dict[str, Picture] = {}
    for name, path in frame.pictures.items():
        image = files.read_image(path)
        # equal pictures share one array: they are measured once, and their distance is 0
        same = [p for p in pictures.values() if p.shape == image.shape and np.array_equal(p, image)]
        pictures[name] = same[0] if same else image
    height, width = next(iter(pictures.values())).shape[:2]
    if any(image.shape[:2] != (height, width) for image in pictures.values()):
        path = frame.pictures["attacked"].parent
        raise ShapeError(str(path), "pictures of one size", sorted({i.shape[:2] for i in pictures.values()}))
    places: list[tuple[int | None, str, Window]] = [
        (None, "", crop_window([(0, 0, width, height)], height, width))
    ]
    for before, after in vehicle_boxes(frame.result):
        places.append((before.index, before.label, crop_window([before.xyxy, after.xyxy], height, width)))
    parts = tuple(_part(index, kind, where, pictures, measures) for index, kind, where in places)
    return FrameRegions(frame.result.identifier, parts)


def _part(
    index: int | None, kind: str, where: Window, pictures: Mapping[str, Picture], measures: Measures
) -> PictureRegion:
    cut = {id(image): np.ascontiguousarray(image[where]) for image in pictures.values()}
    views = {name: cut[id(image)] for name, image in pictures.items()}
    distances: dict[str, dict[tuple[str, str], float]] = {}
    features: dict[str, dict[str, Floats]] = {}
    for name, measure in measures.items():
        if METRICS[name].pairwise:
            known: dict[tuple[int, int], float] = {}
            distances[name] = {}
            for first, second in PAIRS:
                key = (id(views[first]), id(views[second]))
                if key not in known:
                    known[key] = float(measure(views[first], views[second]))  # pyright: ignore[reportCallIssue]
                distances[name][first, second] = known[key]
        else:
            seen = {key: measure(view) for key, view in _distinct(views)}  # pyright: ignore[reportCallIssue]
            features[name] = {picture: seen[id(view)] for picture, view in views.items()}
    return PictureRegion(index, kind, distances, features)


def _distinct(views: Mapping[str, Picture]) -> Iterator[tuple[int, Picture]]:
    """Each array once, by its id."""
    yield from {id(view): view for view in views.values()}.items()


@dataclass(frozen=True, slots=True)
class FrameMean:
    """Mean of values that can be reweighted by frame."""

    values: Floats
    """One value for each frame (F,)."""

    def value(self, weights: Floats | None) -> float | None:
        return float(np.average(self.values, weights=weights)) if len(self.values) else None


def realism_rows(
    frames: Sequence[FrameRegions], metrics: Sequence[str], draws: int, seed: int
) -> list[RealismRow]:
    """All metrics of a run.

    Args:
        frames: Regions of its frames.
        metrics: Names of the metrics.
        draws: Bootstrap draws of frames.
        seed: Seed of the draws.
    """
    found: list[RealismRow] = []
    for region in REGIONS:
        parts = [frame.select(region) for frame in frames]
        known = [p for p in parts if p]
        for metric in metrics:
            for pair in PAIRS:
                if METRICS[metric].pairwise:
                    found.append(_pair_row(known, region, metric, pair, (draws, seed)))
                else:
                    found.append(_set_row(known, region, metric, pair))
    return found


def _pair_row(
    parts: Sequence[Sequence[PictureRegion]],
    region: str,
    metric: str,
    pair: tuple[str, str],
    spread: tuple[int, int],
) -> RealismRow:
    values = np.array([np.mean([p.distances[metric][pair] for p in frame]) for frame in parts], np.float64)
    one = _interval(FrameMean(values), len(values), spread)
    ends: list[float | None] = [one.value, one.low, one.high, float(np.median(values)) if len(values) else None]
    if METRICS[metric].squared:
        ends = [None if end is None else psnr_db(end) for end in ends]
        ends[1:3] = ends[2:0:-1]
    return RealismRow(region, metric, *pair, *ends, pictures=sum(map(len, parts)))


def _set_row(
    parts: Sequence[Sequence[PictureRegion]], region: str, metric: str, pair: tuple[str, str]
) -> RealismRow:
    """No interval: draws with repetitions are farther apart than the sets themselves."""
    everything = [part for frame in parts for part in frame]
    sides = [[part.features[metric][side] for part in everything] for side in pair]
    value = None
    if len(everything) > 1:
        equal = all(a is b for a, b in zip(*sides, strict=True))
        value = 0.0 if equal else frechet_distance(*(Gaussian.from_features(np.stack(side)) for side in sides))
    return RealismRow(region, metric, *pair, value, None, None, None, pictures=len(everything))


def _interval(part: FrameMean, frames: int, spread: tuple[int, int]) -> Interval:
    draws, seed = spread
    mean = NamedMetric("", (part,))  # pyright: ignore[reportArgumentType]
    (one,) = bootstrap_intervals([mean], frames, draws, np.random.default_rng(seed))
    return one
