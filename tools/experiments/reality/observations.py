"""Observes which vehicles detectors miss in real, drawn and placebo pictures of each condition."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from tools.bench.conditions import (
    CONDITIONS,
    DAY,
    UNDRAWN,
    ConditionFrame,
    ConditionSets,
    Picture,
    RecallDetector,
    ResultCache,
    detect_hits,
    encode_jpeg,
    load_detectors,
)
from tools.bench.picture_measures import LEAST_HEIGHT_PX, LINES, resize_to_lines
from tools.bench.settings import ConditionsConfig
from tools.experiments.reality.features import ObjectFeatures, find_hidden, measure_objects
from tools.experiments.settings import RealityConfig
from tools.experiments.tables import read_table, write_table

PREDICTED = ("dusk", "rain", "fog", "night")
"""Conditions whose loss of recall is predicted."""
ADVERSE = (*PREDICTED, "snow")
"""Conditions whose real frames test rules and retrained detectors."""
REAL, PLAIN, DRAWN, PLACEBO = "real", "undrawn", "drawn", "placebo"
"""Sources of pictures: photographs of the condition; sunny days as photographed, under drawn weather, and with a change
of brightness and contrast of the same size."""
_BISECTIONS, _LARGEST_LOG_CONTRAST = 24, 3.0


@dataclass(frozen=True, slots=True)
class ObservedObject:
    """One labelled vehicle in one picture."""

    half: str
    """Half of the real frames: A or B."""
    condition: str
    """Name of the condition."""
    source: str
    """REAL, PLAIN, DRAWN or PLACEBO."""
    frame: str
    """Name of the frame."""
    number: int
    """Number among the frame's vehicles."""
    hidden: bool
    """Whether it is cut by the border or covered by others."""
    missed_by: str
    """Names of the detectors that miss it, with spaces."""


Observation = tuple[ObservedObject, ObjectFeatures]
TABLE = "objects-{}.csv.gz"
"""File of the observations of a half."""


def conditions_config(config: RealityConfig, half: str) -> ConditionsConfig:
    """Settings of the frames of a half."""
    folder = (config.half_a if half == "A" else config.half_b) or str(Path(config.out or "") / f"half-{half}")
    return ConditionsConfig(
        root=config.root,
        fog_root=config.fog_root,
        out=folder,
        half=half,
        frames=config.drawn if half == "B" else config.days_a,
        real=max(config.real, config.real_days) if half == "B" else config.real_a,
        detectors=config.detectors,
    )


def observe_half(config: RealityConfig, half: str, path: Path) -> None:
    """Observe the frames of a half and write the table.

    Detections are stored in the half's folder, observations of each picture in --out.
    """
    settings = conditions_config(config, half)
    sets, detectors = ConditionSets(settings), load_detectors(settings.detectors)
    cache = ResultCache(Path(settings.out or "") / "detections")
    names = "+".join(sorted(one.name for one in detectors))
    rows: list[Observation] = []
    for source, frame in _frames(sets, half, config):
        folder = Path(config.out or "") / "observed" / names / source / frame.condition.replace(", ", "-")
        stored = folder / f"{frame.name}.csv"
        if not stored.is_file():
            seen = list(_observe(source, frame, half, detectors, cache))
            write_table(stored, (ObservedObject, ObjectFeatures), seen)
        rows += read_observations(stored)
    write_table(path, (ObservedObject, ObjectFeatures), rows)


def read_observations(path: Path) -> list[Observation]:
    """Read the table of a half. Raises FormatError for a damaged file."""
    return [(one, features) for one, features in read_table(path, (ObservedObject, ObjectFeatures))]


def _frames(sets: ConditionSets, half: str, config: RealityConfig) -> Iterator[tuple[str, ConditionFrame]]:
    """Sources and frames; drawn ones, and placebos of the first so many days, only of half B."""
    conditions = {condition.name: condition for condition in CONDITIONS}
    most = dict.fromkeys(ADVERSE, config.real if half == "B" else config.real_a) | {DAY: config.real_days}
    for name in (DAY, *ADVERSE):
        yield from ((REAL, frame) for frame in islice(sets.real(conditions[name]), most[name]))
    if half == "A":
        return
    plain = list(sets.drawn(UNDRAWN, {}))
    yield from ((PLAIN, frame) for frame in plain)
    drawn = {name: list(sets.drawn(name, conditions[name].settings(full=False) or {})) for name in PREDICTED}
    for i, photograph in enumerate(plain):
        for name in PREDICTED:
            frame = drawn[name][i]
            yield DRAWN, frame
            if i < config.placebos:
                yield PLACEBO, replace(frame, read=partial(_placebo, photograph, frame))


def _placebo(photograph: ConditionFrame, drawn: ConditionFrame) -> Picture:
    seed = hashlib.sha256(f"{drawn.condition}/{drawn.name}".encode()).digest()
    changed = change_as_much(photograph.read(), drawn.read(), np.random.default_rng(list(seed[:8])))
    stored = cv2.imdecode(np.frombuffer(encode_jpeg(changed), np.uint8), cv2.IMREAD_COLOR)
    assert stored is not None
    return np.ascontiguousarray(stored[..., ::-1]).astype(np.uint8)


def change_as_much(photograph: Picture, other: Picture, generator: np.random.Generator) -> Picture:
    """Change brightness and contrast of a photograph at random, by as much as another picture differs from it.

    The direction is drawn at random: from brighter or darker alone to more or less contrast alone. Its length is the
    one at which the mean absolute change of the pixels is that of the other picture, or the largest there is.

    Args:
        photograph: (H, W, 3).
        other: (H, W, 3), a changed version of it.
        generator: Source of random numbers.
    """
    pixels = photograph.astype(np.float32) / 255
    wanted = float(np.abs(other.astype(np.float32) / 255 - pixels).mean())
    angle = generator.uniform(0, 2 * np.pi)
    mean = float(pixels.mean())

    def change(length: float) -> np.ndarray:
        gain = np.exp(_LARGEST_LOG_CONTRAST * length * np.sin(angle))
        return np.clip((pixels - mean) * gain + mean + length * np.cos(angle), 0, 1)

    low, high = 0.0, 1.0
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if np.abs(change(middle) - pixels).mean() < wanted else (low, middle)
    return np.rint(255 * change(high)).astype(np.uint8)


def _observe(
    source: str, frame: ConditionFrame, half: str, detectors: Sequence[RecallDetector], cache: ResultCache
) -> Iterator[Observation]:
    """Observe the vehicles of a frame that are judged."""
    picture, boxes = frame.read(), frame.boxes_xyxy
    hits = {one.name: detect_hits(cache, one, picture, boxes) for one in detectors}
    scale = LINES / picture.shape[0]
    judged = np.flatnonzero(scale * boxes[:, 3] - scale * boxes[:, 1] >= LEAST_HEIGHT_PX)
    resized, judged_boxes = resize_to_lines(picture, boxes)
    hidden = find_hidden(scale * boxes, (resized.shape[0], resized.shape[1]))
    for number, features in zip(judged, measure_objects(resized, judged_boxes), strict=True):
        missed = " ".join(name for name, found in hits.items() if not found[number])
        yield (
            ObservedObject(half, frame.condition, source, frame.name, int(number), bool(hidden[number]), missed),
            features,
        )


def missed_flags(rows: Sequence[Observation], detector: str) -> np.ndarray:
    """Whether a detector misses each object (N,) bool."""
    return np.array([detector in one.missed_by.split() for one, _ in rows], bool)


def frame_numbers(rows: Sequence[Observation]) -> np.ndarray:
    """A number (N,) for the frame of each object, from 0."""
    numbers: Mapping[str, int] = {name: i for i, name in enumerate(dict.fromkeys(one.frame for one, _ in rows))}
    return np.array([numbers[one.frame] for one, _ in rows], np.int64)
