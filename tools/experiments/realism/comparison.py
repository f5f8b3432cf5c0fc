"""Photograph, re-render and counterexample of a run's frames beside one another, whole and around each vehicle."""

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
from tools.experiments.realism.closeness import Picture
from tools.experiments.realism.frechet import Floats, Gaussian, frechet
from tools.experiments.realism.measures import LEAST_PX, METRICS, PairDistance, SetFeatures, psnr_db

PAIRS = tuple(combinations(PICTURES, 2))
"""Photograph and re-render, photograph and counterexample, re-render and counterexample."""
REGIONS = ("frame", "boxes")
Window = tuple[slice, slice]
Box = tuple[float, float, float, float]
"""x0, y0, x1, y1 px."""
Measures = Mapping[str, PairDistance | SetFeatures]


@dataclass(frozen=True, slots=True)
class Part:
    """A whole frame, or the rectangle around one vehicle before and after, as far as it is there: one that left or
    parked is so in one picture only.

    index: of the vehicle, None for the frame; kind: its class; distances: by metric and pair, PSNR's as the mean
    squared error; features: by metric and picture (D,).
    """

    index: int | None
    kind: str
    distances: dict[str, dict[tuple[str, str], float]]
    features: dict[str, dict[str, Floats]]


@dataclass(frozen=True, slots=True)
class FrameParts:
    """parts: the whole frame first, then its vehicles."""

    identifier: str
    parts: tuple[Part, ...]

    def region(self, name: str) -> tuple[Part, ...]:
        """Of REGIONS."""
        return self.parts[:1] if name == "frame" else self.parts[1:]


@dataclass(frozen=True, slots=True)
class RealismRow:
    """One figure of a run. value: mean over frames (of vehicles: of each frame's mean), for PSNR that of the mean
    squared error, for a Fréchet distance that of all pictures; low, high: its interval, which a Fréchet distance
    does not have; median: over frames. None is an infinite PSNR, and what cannot be said. pictures: how many of
    each kind are compared.
    """

    region: str
    metric: str
    first: str
    second: str
    value: float | None
    low: float | None
    high: float | None
    median: float | None
    pictures: int


def area_of(box_xyxy: Box) -> float:
    """px²; 0 of what is not seen, as of a vehicle that left."""
    x0, y0, x1, y1 = box_xyxy
    return max(x1 - x0, 0) * max(y1 - y0, 0)


def rectangle_around(boxes_xyxy: Sequence[Box]) -> Box:
    """The rectangle around boxes; those without an area are nowhere. ValueError where none has one."""
    lefts, tops, rights, bottoms = zip(*(box for box in boxes_xyxy if area_of(box) > 0), strict=True)
    return min(lefts), min(tops), max(rights), max(bottoms)


def window(boxes_xyxy: Sequence[Box], height: int, width: int) -> Window:
    """Rows and columns of the rectangle around boxes, px, inside the picture, at least LEAST_PX a side.

    Raises ShapeError for a picture that is smaller, ValueError where no box has an area.
    """
    if min(height, width) < LEAST_PX:
        raise ShapeError("picture", f"at least {LEAST_PX} px a side", f"{width}x{height}")
    x0, y0, x1, y1 = rectangle_around(boxes_xyxy)
    return _span(y0, y1, height), _span(x0, x1, width)


def _span(low: float, high: float, length: int) -> slice:
    """The pixels from low to high, widened evenly and moved inside."""
    start, end = int(np.floor(np.clip(low, 0, length))), int(np.ceil(np.clip(high, 0, length)))
    size = max(end - start, LEAST_PX)
    start = min(max((start + end - size) // 2, 0), length - size)
    return slice(start, start + size)


def vehicles(result: FrameResult) -> list[tuple[BoxRecord, BoxRecord]]:
    """The scene's objects before and after, in order, without those seen in neither picture. The box of one that
    left or parked has no area in one of them.
    """
    after = {box.index: box for box in result.targets_moved if box.index is not None}
    pairs = [(box, after[box.index]) for box in result.targets_benign if box.index in after]
    return [(one, other) for one, other in pairs if area_of(one.xyxy) > 0 or area_of(other.xyxy) > 0]


def frame_parts(frame: RunFrame, measures: Measures) -> FrameParts:
    """Measure one frame. Raises FormatError for a bad picture, ShapeError where pictures differ in size."""
    pictures: dict[str, Picture] = {}
    for name, path in frame.pictures.items():
        image = files.read_image(path)
        # An equal picture stands for this one: what is done once need not be done again, and distances are 0.
        same = [p for p in pictures.values() if p.shape == image.shape and np.array_equal(p, image)]
        pictures[name] = same[0] if same else image
    height, width = next(iter(pictures.values())).shape[:2]
    if any(image.shape[:2] != (height, width) for image in pictures.values()):
        path = frame.pictures["attacked"].parent
        raise ShapeError(str(path), "pictures of one size", sorted({i.shape[:2] for i in pictures.values()}))
    places: list[tuple[int | None, str, Window]] = [(None, "", window([(0, 0, width, height)], height, width))]
    for before, after in vehicles(frame.result):
        places.append((before.index, before.label, window([before.xyxy, after.xyxy], height, width)))
    parts = tuple(_part(index, kind, where, pictures, measures) for index, kind, where in places)
    return FrameParts(frame.result.identifier, parts)


def _part(
    index: int | None, kind: str, where: Window, pictures: Mapping[str, Picture], measures: Measures
) -> Part:
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
            seen = {key: measure(view) for key, view in _each(views)}  # pyright: ignore[reportCallIssue]
            features[name] = {picture: seen[id(view)] for picture, view in views.items()}
    return Part(index, kind, distances, features)


def _each(views: Mapping[str, Picture]) -> Iterator[tuple[int, Picture]]:
    """Each picture once."""
    yield from {id(view): view for view in views.values()}.items()


@dataclass(frozen=True, slots=True)
class _Mean:
    """Of values (F,), a frame each."""

    values: Floats

    def value(self, weights: Floats | None) -> float | None:
        return float(np.average(self.values, weights=weights)) if len(self.values) else None


def rows(frames: Sequence[FrameParts], metrics: Sequence[str], draws: int, seed: int) -> list[RealismRow]:
    """Every figure of a run, with intervals by drawing frames."""
    found: list[RealismRow] = []
    for region in REGIONS:
        parts = [frame.region(region) for frame in frames]
        known = [p for p in parts if p]
        for metric in metrics:
            for pair in PAIRS:
                if METRICS[metric].pairwise:
                    found.append(_pair_row(known, region, metric, pair, (draws, seed)))
                else:
                    found.append(_set_row(known, region, metric, pair))
    return found


def _pair_row(
    parts: Sequence[Sequence[Part]], region: str, metric: str, pair: tuple[str, str], spread: tuple[int, int]
) -> RealismRow:
    values = np.array([np.mean([p.distances[metric][pair] for p in frame]) for frame in parts], np.float64)
    one = _interval(_Mean(values), len(values), spread)
    ends: list[float | None] = [one.value, one.low, one.high, float(np.median(values)) if len(values) else None]
    if METRICS[metric].squared:
        ends = [None if end is None else psnr_db(end) for end in ends]
        ends[1:3] = ends[2:0:-1]
    return RealismRow(region, metric, *pair, *ends, pictures=sum(map(len, parts)))


def _set_row(parts: Sequence[Sequence[Part]], region: str, metric: str, pair: tuple[str, str]) -> RealismRow:
    """Without an interval: draws with repetitions lie farther apart than the sets themselves."""
    everything = [part for frame in parts for part in frame]
    sides = [[part.features[metric][side] for part in everything] for side in pair]
    value = None
    if len(everything) > 1:
        equal = all(a is b for a, b in zip(*sides, strict=True))
        value = 0.0 if equal else frechet(*(Gaussian.of(np.stack(side)) for side in sides))
    return RealismRow(region, metric, *pair, value, None, None, None, pictures=len(everything))


def _interval(part: _Mean, frames: int, spread: tuple[int, int]) -> Interval:
    draws, seed = spread
    figure = NamedMetric("", (part,))  # pyright: ignore[reportArgumentType]
    (one,) = bootstrap_intervals([figure], frames, draws, np.random.default_rng(seed))
    return one
