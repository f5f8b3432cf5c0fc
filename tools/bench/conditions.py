"""Drawn weather against real frames in it: light, colour, sharpness, noise and lamps, a probe, and detectors' recalls.

Real frames of each condition come from BDD100K (weather and time of day) and DAWN (fog). Drawn frames are dry,
mostly sunny days of BDD100K under the weather of that name. Real frames are split by a hash of their names: constants
may be chosen on half A only, and half B is for reports.
"""

from __future__ import annotations

import hashlib
import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

import drivesem as ds
from detectors.base import DetectorError, Predictor, predict
from detectors.registry import SHIPPED, load_predictor
from detectors.types import Detections
from drivesem.attacks.budgets import PRESETS, STREET
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.space import Parameter, ParameterSpace
from drivesem.attacks.targets import resolve_t_star
from drivesem.bench.session import BenchTable, Columns
from drivesem.config.edits import WEATHER_CODES, WEATHER_PRESETS
from drivesem.config.errors import UsageError
from drivesem.data.registry import Dataset, open_dataset
from drivesem.evaluation.conditions import ConditionRow, DetectedObjects, recall_by_condition
from drivesem.reporting.drawing import write_picture
from drivesem.scenes.scene_cache import content_digest
from scene_ir import files
from scene_ir.errors import SceneError
from scene_ir.io import save_scene, to_tensor, to_uint8
from tools.bench import picture_measures
from tools.bench.picture_measures import LEAST_HEIGHT_PX, LINES, measure_picture, resize_to_lines
from tools.bench.settings import ConditionsConfig
from tools.bench.sights import assign
from tools.bench.two_samples import ProbeResult, compare_distributions, probe_sets
from tools.experiments.realism.perceptual import PerceptualDistance

Picture = NDArray[np.uint8]
Floats = NDArray[np.float64]
Arrays = dict[str, np.ndarray]

VEHICLES = ("car", "bus", "truck")
"""Classes of BDD100K, DAWN and COCO that are judged; a detector may call a vehicle any of its own vehicle classes."""
_DETECTOR_VEHICLES = (*VEHICLES, "van", "train")
DRY = ("clear", "partly_cloudy", "overcast", "undefined")
SUNNY = ("clear", "partly_cloudy")
DAY = "day, dry"
JOINT = "any feasible weather"
UNDRAWN = "as photographed"
_JPEG_QUALITY = 75
"""Of drawn pictures; finer than that of BDD100K's files, so that it hardly changes them (an undrawn day that is
compressed again stays as near to the real frames)."""
_SPLITS = 5
"""Random halves of the real frames that the probe compares, as a control."""
_SHEET_FRAMES, _SHEET_COLUMNS, _THUMBNAIL_WH = 24, 6, (480, 270)
_IOU = 0.5
_LEAST_FRAMES = 5
"""Real frames below which a condition is left out."""


@dataclass(frozen=True, slots=True)
class Condition:
    """A condition of real frames, and the weather that is drawn for it."""

    name: str
    """Name in tables."""
    times: tuple[str, ...]
    """BDD100K's times of day."""
    weathers: tuple[str, ...]
    """BDD100K's weather."""
    preset: str | None
    """Name of the drawn weather; None where nothing is drawn."""
    code: str
    """Its code, which is 1 with `--full`."""
    of_fog_frames: bool = False
    """Whether the frames of `--fog-root` belong here."""

    def settings(self, full: bool) -> Mapping[str, float] | None:
        """Codes of the drawn weather; None where there is no such weather."""
        if self.preset is None or (self.code if full else self.preset) not in (
            WEATHER_CODES if full else WEATHER_PRESETS
        ):
            return None
        return {self.code: 1.0} if full else WEATHER_PRESETS[self.preset]


CONDITIONS = (
    Condition(DAY, ("daytime",), DRY, None, ""),
    Condition("dusk", ("dawn/dusk",), DRY, "twilight", "time"),
    Condition("rain", ("daytime",), ("rainy",), "rain", "rain"),
    Condition("fog", ("daytime",), ("foggy",), "fog", "fog", of_fog_frames=True),
    Condition("overcast", ("daytime",), ("overcast",), "overcast", "overcast"),
    Condition("night", ("night",), DRY, "night", "night"),
    Condition("snow", ("daytime",), ("snowy",), "snow", "snow"),
)
"""Conditions; one without a weather of that name has real figures only."""

JOINT_TITLE = "Feasible weather outside of what 99 % of real frames in bad weather and by night have"
JOINT_COLUMNS: Columns = {
    "measure": ("measure", "measure"), "real_frames": ("real frames", "real"), "low": ("from", "from"),
    "high": ("to", "to"), "drawn_frames": ("drawn frames", "drawn"), "outside": ("outside", "outside"),
}  # fmt: skip
JOINT_MEASURES = (
    "frame: brightness", "frame: contrast", "frame: saturation", "frame: air a*", "frame: air b*", "boxes: contrast",
    "boxes: saturation",
)  # fmt: skip
TITLE = "Drawn weather against real frames"
COLUMNS: Columns = {
    "condition": ("condition", "condition"), "measure": ("measure", "measure"),
    "real_frames": ("real frames", "real"), "real_low": ("first quartile", "q1"),
    "real_median": ("real median", "median"), "real_high": ("third quartile", "q3"),
    "drawn_frames": ("drawn frames", "drawn"), "drawn_median": ("drawn median", "median"),
    "inside": ("drawn median within real quartiles", "inside"), "distance": ("distance, real IQR", "distance"),
    "low": ("from", "from"), "high": ("to", "to"), "undrawn_median": ("undrawn median", "undrawn"),
    "undrawn_distance": ("distance undrawn", "undrawn d"),
}  # fmt: skip
PROBE_TITLE = "A probe that separates drawn from real frames"
PROBE_COLUMNS: Columns = {
    "condition": ("condition", "condition"), "pair": ("sets", "sets"), "first": ("frames", "frames"),
    "second": ("frames ", "frames "), "auc": ("AUC", "AUC"), "low": ("from", "from"), "high": ("to", "to"),
}  # fmt: skip
RECALL_TITLE = "Recall of vehicles at the box heights of dry days, %"
RECALL_COLUMNS: Columns = {
    "detector": ("detector", "detector"), "condition": ("condition", "condition"),
    "real_frames": ("real frames", "real"), "real_objects": ("vehicles", "vehicles"),
    "real": ("real recall", "recall"), "real_low": ("from", "from"), "real_high": ("to", "to"),
    "drawn_frames": ("drawn frames", "drawn"), "drawn_objects": ("vehicles ", "vehicles"),
    "drawn": ("drawn recall", "recall"), "drawn_low": ("from ", "from"), "drawn_high": ("to ", "to"),
    "difference": ("drawn less real", "difference"), "difference_low": ("from  ", "from"),
    "difference_high": ("to  ", "to"), "real_change": ("real, from dry days", "real change"),
    "drawn_change": ("drawn, from undrawn", "drawn change"), "same_sign": ("same sign", "same sign"),
}  # fmt: skip
METHOD = (
    "Pictures are resized to 720 lines; vehicles are cars, buses and trucks of at least 30 px. boxes: means over "
    "vehicles; ring: half a box around it, without vehicles; frame: the whole picture. Brightness and contrast: mean "
    "and standard deviation of luma; saturation: (max - min) / max; sharpness: steepest edges as a share of the "
    "region's range, per px; noise: Immerkaer's, levels of 255, lower quartile of blocks of 8 px, by luma (dark: under "
    "0.2, bright: from 0.6); air: CIELAB of the smoothest pixels above the horizon; glare: light around a lamp as a "
    "share of what is missing to white. Distance: Wasserstein, in interquartile ranges of the real frames; intervals: "
    "95 %, bootstrap over frames. Drawn: sunny days of BDD100K, de-rendered without 3D labels, under the weather's "
    f"preset (--full: its own code at 1), compressed as JPEG of quality {_JPEG_QUALITY}. Probe: logistic regression "
    "on means and deviations of SqueezeDet's conv1, fire3 and fire5, cross-validated by frame; real and real: the "
    "median of five random halves, for which cross-validation falls somewhat below 0.5. Recall: IoU 0.5, any "
    "vehicle class, at each detector's threshold, weighted to the box heights of dry days; difference: MOVER."
)


@dataclass(frozen=True, slots=True)
class ConditionFrame:
    """One frame of a condition."""

    condition: str
    """Name of the condition, or UNDRAWN."""
    drawn: bool
    """Whether it belongs to the drawn frames."""
    name: str
    """Identifier in its data set."""
    boxes_xyxy: Floats
    """Boxes (N, 4) px of all its vehicles."""
    read: Callable[[], Picture]
    """Reads or draws the picture (H, W, 3)."""


def half_of(name: str) -> str:
    """The half of a real frame, "A" or "B": by the parity of the first byte of its name's SHA-256 (without suffix)."""
    return "AB"[_digest(name)[0] % 2]


def _digest(name: str) -> bytes:
    return hashlib.sha256(Path(name).name.encode()).digest()


class ResultCache:
    """Results of pictures in a folder, by the digest of picture, settings and code."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get_or_make(self, inputs: object, make: Callable[[], Arrays]) -> Arrays:
        """Return the stored arrays of these inputs, or make and store them."""
        path = self._folder / f"{content_digest(inputs)[:24]}.npz"
        with suppress(SceneError):
            return files.read_npz(path)
        arrays = make()
        files.write_npz(path, arrays)
        return arrays


class ConditionSets:
    """Real and drawn frames of all conditions. Raises SceneError or UsageError for data that cannot be read."""

    def __init__(self, config: ConditionsConfig) -> None:
        self._config, self._out = config, Path(config.out or "")
        if config.redraw:
            shutil.rmtree(self._out / "drawn", ignore_errors=True)
        self._bdd = open_dataset(config.dataset, Path(config.root or ""))
        self._fog = None if config.fog_root is None else open_dataset("coco", Path(config.fog_root))
        self._attributes = {
            name: {key: value.replace(" ", "_") for key, value in self._bdd.attributes(name).items()}
            for name in self._bdd.identifiers
        }

    def real(self, condition: Condition) -> Iterator[ConditionFrame]:
        """Real frames of a condition in the chosen half, in the order of the hash."""
        for dataset, name in self.names(condition):
            yield _frame(condition.name, False, dataset, name)

    def names(self, condition: Condition) -> list[tuple[Dataset, str]]:
        """Data sets and names of these frames."""
        names = [(self._bdd, name) for name in self._of(condition.times, condition.weathers)]
        if condition.of_fog_frames and self._fog is not None:
            names += [(self._fog, name) for name in self._fog.identifiers if self._in_half(name)]
        return sorted(names, key=lambda pair: _digest(pair[1]))[: self._config.real]

    def drawn(self, condition: str, settings: Mapping[str, float]) -> Iterator[ConditionFrame]:
        """Sunny days with vehicles under codes of weather; without codes, as photographed."""
        text = ",".join(f"{code}={value:g}" for code, value in sorted(settings.items()))
        for name in self.base():
            frame = _frame(condition, True, self._bdd, name)
            if settings:
                read = partial(self._draw, name, dict(settings), self._out / "drawn" / text / f"{name}.jpg")
                frame = ConditionFrame(condition, True, name, frame.boxes_xyxy, read)
            yield frame

    def states(self) -> Iterator[ConditionFrame]:
        """The same days under random feasible states of all codes."""
        for name in self.base():
            boxes = _vehicle_boxes(self._bdd, name)
            for k in range(self._config.states):
                read = partial(self._draw_state, name, k, self._out / "drawn" / f"state-{k}" / f"{name}.jpg")
                yield ConditionFrame(JOINT, True, f"{name}-{k}", boxes, read)

    def _draw_state(self, name: str, k: int, path: Path) -> Picture:
        scene = self.scene(name)
        space = ParameterSpace(scene.ir, [Parameter.WEATHER], PRESETS[STREET])
        generator = np.random.default_rng([self._config.seed, k, *_digest(name)])
        # Ends of the codes' ranges are where attacks drive them.
        wanted = generator.choice([0.0, 1.0, generator.uniform()], size=space.dim)
        codes = FeasibleSet(space).project(torch.from_numpy(wanted).float()).theta.tolist()
        return self._draw(name, dict(zip(WEATHER_CODES, codes, strict=False)), path)

    def base(self) -> list[str]:
        """Frames that weather is drawn on: sunny days of the half with judged vehicles, in the order of the hash."""
        names = sorted(self._of(("daytime",), SUNNY), key=_digest)
        usable = (name for name in names if len(_judged_heights(_vehicle_boxes(self._bdd, name), LINES)))
        return [name for name, _ in zip(usable, range(self._config.frames), strict=False)]

    def _of(self, times: Sequence[str], weathers: Sequence[str]) -> list[str]:
        return [
            name
            for name, values in self._attributes.items()
            if values.get("timeofday") in times and values.get("weather") in weathers and self._in_half(name)
        ]

    def _in_half(self, name: str) -> bool:
        return self._config.half in ("all", half_of(name))

    def _draw(self, name: str, settings: dict[str, float], path: Path) -> Picture:
        if not path.is_file():
            files.write_bytes(path, encode_jpeg(self.scene(name).edit(weather=settings).render()))
        return files.read_image(path)

    def scene(self, name: str) -> ds.Scene:
        """The scene of a frame, de-rendered once into the folder `scenes` of --out."""
        folder = self._out / "scenes" / name
        with suppress(SceneError):
            return ds.load_scene(folder)
        scene = ds.derender(self._bdd.frame(name))
        with files.atomic_folder(folder) as part:
            save_scene(scene.ir, part)
        return scene


def encode_jpeg(picture: Picture) -> bytes:
    """A picture (H, W, 3) as the JPEG file in which drawn pictures are stored."""
    parameters = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    return cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), parameters)[1].tobytes()


def _frame(condition: str, drawn: bool, dataset: Dataset, name: str) -> ConditionFrame:
    return ConditionFrame(
        condition, drawn, name, _vehicle_boxes(dataset, name), partial(_photograph, dataset, name)
    )


def _photograph(dataset: Dataset, name: str) -> Picture:
    return to_uint8(dataset.frame(name).photograph)


def _vehicle_boxes(dataset: Dataset, name: str) -> Floats:
    labels = dataset.labels(name)
    if labels is None:
        return np.zeros((0, 4))
    chosen = [i for i, kind in enumerate(labels.kind) if kind in VEHICLES]
    return labels.boxes_xyxy[chosen].double().numpy()


def _judged_heights(boxes_xyxy: Floats, lines: int) -> Floats:
    """Heights, px at `LINES`, of the boxes in a picture of so many lines that are high enough."""
    height = (boxes_xyxy[:, 3] - boxes_xyxy[:, 1]) * LINES / lines
    return height[height >= LEAST_HEIGHT_PX]


def collect_frames(config: ConditionsConfig) -> tuple[list[ConditionFrame], list[str]]:
    """All frames that are measured, and a line for each condition of which something is missing.

    Raises UsageError where the half has no sunny day.
    """
    sets = ConditionSets(config)
    frames = list(sets.drawn(UNDRAWN, {}))
    if not frames:
        raise UsageError("--root", f"sunny days with vehicles in half {config.half}", "none")
    notes = []
    for condition in CONDITIONS:
        real = list(sets.real(condition))
        if len(real) < _LEAST_FRAMES:
            notes.append(f"{condition.name}: skipped, {len(real)} real frames")
            continue
        frames += real
        settings = condition.settings(config.full)
        if settings is not None:
            frames += sets.drawn(condition.name, settings)
        elif condition.preset is not None:
            notes.append(f"{condition.name}: not drawn, there is no weather {condition.preset!r}")
    return [*frames, *sets.states()], notes


@dataclass(frozen=True, slots=True)
class MeasuredFrame:
    """What is measured in one frame."""

    condition: str
    """Name of the condition, or UNDRAWN."""
    drawn: bool
    """Whether it is a drawn frame."""
    name: str
    """Identifier in its data set."""
    values: dict[str, float]
    """By measure; what cannot be measured is missing."""
    features: Floats
    """Features (D,) of the probe."""


def measure(config: ConditionsConfig, frames: Sequence[ConditionFrame]) -> Iterator[MeasuredFrame]:
    """Measure frames one by one; measures are stored in `--out`. Dry days are references of recalls only."""
    cache = ResultCache(Path(config.out or "") / "measured")
    code = files.sha256_digest(Path(picture_measures.__file__))
    network = PerceptualDistance()
    for frame in frames:
        picture = frame.read()

        def make(picture: Picture = picture, boxes: Floats = frame.boxes_xyxy) -> Arrays:
            values = {name: np.array(value) for name, value in measure_picture(picture, boxes).items()}
            return {**values, "features": pool_features(network, resize_to_lines(picture, boxes)[0])}

        arrays = cache.get_or_make((code, picture, frame.boxes_xyxy), make)
        features = arrays.pop("features").astype(np.float64)
        values = {name: float(value) for name, value in arrays.items()}
        yield MeasuredFrame(frame.condition, frame.drawn, frame.name, values, features)


@torch.no_grad()
def pool_features(network: PerceptualDistance, picture: Picture) -> NDArray[np.float32]:
    """Means and standard deviations (D,) over a picture of the channels of the frozen backbone's layers."""
    layers = network.features(picture)
    pooled = [part for layer in layers for part in (layer.mean(dim=(0, 2, 3)), layer.std(dim=(0, 2, 3)))]
    return torch.cat(pooled).numpy()


def measure_rows(rows: Sequence[MeasuredFrame], draws: int, seed: int) -> list[dict[str, Any]]:
    """A line for each measure of each condition: quartiles, distance and its interval, also of undrawn days."""
    table: list[dict[str, Any]] = []
    generator = np.random.default_rng([seed, 1])
    for name in _real_conditions(rows):
        real, drawn, undrawn = _sets(rows, name)
        for measure_name in sorted({key for row in real for key in row.values}):
            values, others, plain = (_values(part, measure_name) for part in (real, drawn, undrawn))
            if min(len(values), len(plain)) < _LEAST_FRAMES:
                continue
            control = compare_distributions(values, plain, 0 if len(others) else draws, generator)
            line: dict[str, Any] = {
                "condition": name,
                "measure": measure_name,
                "real_frames": len(values),
                **dict(zip(("real_low", "real_median", "real_high"), map(_round, control.real), strict=True)),
                "undrawn_median": _round(control.drawn[1]),
                "undrawn_distance": _round(control.distance),
            }
            if len(others) >= _LEAST_FRAMES:
                compared = compare_distributions(values, others, draws, generator)
                line |= {
                    "drawn_frames": len(others),
                    **dict(
                        zip(("drawn_low", "drawn_median", "drawn_high"), map(_round, compared.drawn), strict=True)
                    ),
                    "inside": "yes" if compared.inside else "no",
                    **{key: _round(getattr(compared, key)) for key in ("distance", "low", "high")},
                }
            table.append(line)
    return table


def joint_rows(rows: Sequence[MeasuredFrame]) -> list[dict[str, Any]]:
    """A line for each measure: between which values 99 % of all real frames lie, and how many states lie outside."""
    lines = []
    states = [row for row in rows if row.condition == JOINT]
    for name in JOINT_MEASURES if states else ():
        real, drawn = _values([row for row in rows if not row.drawn], name), _values(states, name)
        low, high = np.quantile(real, [0.005, 0.995])
        outside = int(((drawn < low) | (drawn > high)).sum())
        lines.append(
            {
                "measure": name,
                "real_frames": len(real),
                "low": _round(float(low)),
                "high": _round(float(high)),
                "drawn_frames": len(drawn),
                "outside": outside,
            }
        )
    return lines


def probe_rows(rows: Sequence[MeasuredFrame], draws: int, seed: int) -> list[dict[str, Any]]:
    """AUCs of the probe by condition: drawn against real, undrawn against real, and real against real (the median of
    five random halves)."""
    table: list[dict[str, Any]] = []
    generator = np.random.default_rng([seed, 2])
    for name in _real_conditions(rows):
        real, drawn, undrawn = (np.array([row.features for row in part]) for part in _sets(rows, name))
        for pair, other in (("drawn and real", drawn), ("undrawn and real", undrawn)):
            result = probe_sets(real, other, draws, generator)
            if result is not None:
                table.append({"condition": name, "pair": pair, **_probe_fields(result)})
        halves = []
        for _ in range(_SPLITS):
            order = generator.permutation(len(real))
            halves.append(probe_sets(real[order[::2]], real[order[1::2]], draws, generator))
        results = [result for result in halves if result is not None]
        if results:
            median = sorted(results, key=lambda result: result.auc)[len(results) // 2]
            table.append({"condition": name, "pair": "real and real", **_probe_fields(median)})
    return table


def _probe_fields(result: ProbeResult) -> dict[str, Any]:
    ends = {key: _round(getattr(result, key)) for key in ("auc", "low", "high")}
    return {"first": result.frames[0], "second": result.frames[1], **ends}


def _real_conditions(rows: Sequence[MeasuredFrame]) -> list[str]:
    present = {row.condition for row in rows if not row.drawn}
    return [condition.name for condition in CONDITIONS if condition.name in present]


def _sets(rows: Sequence[MeasuredFrame], condition: str) -> tuple[list[MeasuredFrame], ...]:
    """Real frames of a condition, drawn ones, and undrawn days."""
    wanted = ((condition, False), (condition, True), (UNDRAWN, True))
    return tuple([row for row in rows if (row.condition, row.drawn) == key] for key in wanted)


def _values(rows: Sequence[MeasuredFrame], name: str) -> Floats:
    return np.array([row.values[name] for row in rows if name in row.values], np.float64)


def _round(value: float | None) -> float | None:
    return None if value is None else round(value, 4)


@dataclass(frozen=True, slots=True)
class RecallDetector:
    """A detector and its threshold."""

    name: str
    """Its name, without folders."""
    predictor: Predictor
    """The detector."""
    threshold: float
    """Lowest score of a detection."""
    digest: str
    """SHA-256 of its weights, if they are a file, and its tiling, if that is not the usual one."""


def load_detectors(names: str, tiles: str = "auto") -> list[RecallDetector]:
    """Load detectors of a list such as `squeezedet,onnx-runtime:FILE@0.35`; without @, at their t*.

    `tiles` is the `tiling` of `detectors.registry.load_predictor`.

    Raises UsageError for a detector that cannot be loaded or a threshold that is none.
    """
    loaded = []
    for text in names.split(","):
        name, at, score = text.strip().rpartition("@")
        name = name if at else score
        try:
            predictor = load_predictor(name, tiling=tiles)
        except DetectorError as error:
            raise UsageError.from_detector_error("--detectors", "detectors", error) from error
        threshold = resolve_t_star(predictor)
        if at:
            with suppress(ValueError):
                threshold = float(score)
            if not score.replace(".", "", 1).isdigit() or not 0 < threshold < 1:
                raise UsageError("--detectors", "NAME@SCORE with a score between 0 and 1", text.strip())
        weights = SHIPPED.get(name, Path(name.partition(":")[2] or name))
        digest = files.sha256_digest(weights) if weights.is_file() else ""
        digest += "" if tiles == "auto" else tiles
        loaded.append(RecallDetector(name.rpartition("/")[2], predictor, threshold, digest))
    return loaded


@dataclass(frozen=True, slots=True)
class DetectedFrame:
    """A detector's hits in one frame."""

    detector: str
    """Name of the detector."""
    condition: str
    """Name of the condition, or UNDRAWN."""
    drawn: bool
    """Whether it is a drawn frame."""
    heights: Floats
    """Heights (N,) of the judged boxes, px at 720 lines."""
    hits: NDArray[np.bool_]
    """Whether each (N,) is detected."""


def detect_frames(
    config: ConditionsConfig, detectors: Sequence[RecallDetector], frames: Sequence[ConditionFrame]
) -> Iterator[DetectedFrame]:
    """Detect vehicles frame by frame, detectors in turn; detections are stored in `--out`."""
    cache = ResultCache(Path(config.out or "") / "detections")
    for frame in frames:
        picture = frame.read()
        for detector in detectors:
            hits = detect_hits(cache, detector, picture, frame.boxes_xyxy)
            height = (frame.boxes_xyxy[:, 3] - frame.boxes_xyxy[:, 1]) * LINES / picture.shape[0]
            judged = height >= LEAST_HEIGHT_PX
            yield DetectedFrame(detector.name, frame.condition, frame.drawn, height[judged], hits[judged])


def detect_hits(
    cache: ResultCache, detector: RecallDetector, picture: Picture, boxes_xyxy: Floats
) -> NDArray[np.bool_]:
    """Whether each box (N, 4) of a vehicle is detected; a detection counts for one box."""

    @torch.no_grad()
    def make() -> Arrays:
        detections = predict(detector.predictor, to_tensor(picture)[None])[0]
        return {field.name: getattr(detections, field.name).numpy() for field in fields(detections)}

    found = cache.get_or_make((detector.name, detector.digest, picture), make)
    names = [detector.predictor.classes[int(label)].lower() for label in found["labels"]]
    is_vehicle = np.array([name in _DETECTOR_VEHICLES for name in names], bool)
    chosen = is_vehicle & (found["scores"] >= detector.threshold)
    detections = Detections(
        *(torch.from_numpy(found[name][chosen]) for name in ("boxes_xyxy", "labels", "scores"))
    )
    sights = assign(torch.from_numpy(boxes_xyxy).float(), detections)
    return np.array([sight.iou >= _IOU for sight in sights], bool)


def recall_rows(frames: Sequence[DetectedFrame], draws: int, seed: int) -> list[dict[str, Any]]:
    """A line for each condition of each detector: recalls at the box heights of real dry days, and differences."""
    table: list[dict[str, Any]] = []
    for detector in dict.fromkeys(frame.detector for frame in frames):
        recalls = _recalls([frame for frame in frames if frame.detector == detector], draws, seed)
        day, undrawn = recalls.get((DAY, False)), recalls.get((UNDRAWN, True))
        for name in [DAY, *(c.name for c in CONDITIONS if c.name != DAY)]:
            real, drawn = recalls.get((name, False)), undrawn if name == DAY else recalls.get((name, True))
            if real is None:
                continue
            line: dict[str, Any] = {"detector": detector, "condition": name, **_recall_fields("real", real)}
            real_change = None if name == DAY else _difference(real, day)
            if drawn is not None:
                line |= _recall_fields("drawn", drawn)
                line |= dict(
                    zip(
                        ("difference", "difference_low", "difference_high"),
                        subtract_recalls(drawn, real),
                        strict=True,
                    )
                )
            drawn_change = None if name == DAY else _difference(drawn, undrawn)
            line |= {"real_change": real_change, "drawn_change": drawn_change}
            if real_change is not None and drawn_change is not None:
                line["same_sign"] = "yes" if real_change * drawn_change > 0 else "no"
            table.append(line)
    return table


def _recalls(frames: Sequence[DetectedFrame], draws: int, seed: int) -> dict[tuple[str, bool], ConditionRow]:
    """Recalls of one detector by condition, and by whether frames are drawn."""
    keys = [(frame.condition, frame.drawn) for frame in frames]
    labels = {key: f"{key[0]}, {'drawn' if key[1] else 'real'}" for key in dict.fromkeys(keys)}
    groups = {label: np.array([i for i, own in enumerate(keys) if own == key]) for key, label in labels.items()}
    objects = DetectedObjects(
        np.repeat(np.arange(len(frames)), [len(frame.heights) for frame in frames]),
        np.concatenate([frame.heights for frame in frames]),
        np.concatenate([frame.hits for frame in frames]),
    )
    generator = np.random.default_rng([seed, 3])
    rows = recall_by_condition(objects, len(frames), groups, labels[DAY, False], draws, generator)
    by_label = {row.condition: row for row in rows}
    return {key: by_label[label] for key, label in labels.items()}


def _recall_fields(which: str, row: ConditionRow) -> dict[str, Any]:
    return {
        f"{which}_frames": row.frames,
        f"{which}_objects": row.objects,
        which: _percent(row.equal_recall),
        f"{which}_low": _percent(row.equal_low),
        f"{which}_high": _percent(row.equal_high),
    }


def _percent(value: float | None) -> float | None:
    return None if value is None else round(100 * value, 2)


def _difference(row: ConditionRow | None, reference: ConditionRow | None) -> float | None:
    if row is None or reference is None or row.equal_recall is None or reference.equal_recall is None:
        return None
    return round(100 * (row.equal_recall - reference.equal_recall), 2)


def subtract_recalls(first: ConditionRow, second: ConditionRow) -> tuple[float | None, float | None, float | None]:
    """Difference of two recalls of independent frames, first minus second, in percent, and its 95 % interval.

    The interval joins those of both (method of variance estimates recovery, Zou and Donner 2008).
    """
    difference = _difference(first, second)
    ends = first.equal_low, first.equal_high, second.equal_low, second.equal_high
    if difference is None or any(end is None for end in ends):
        return difference, None, None
    low, high, other_low, other_high = (100 * float(end or 0) for end in ends)
    one, other = 100 * float(first.equal_recall or 0), 100 * float(second.equal_recall or 0)
    below, above = math.hypot(one - low, other_high - other), math.hypot(high - one, other - other_low)
    return difference, round(difference - below, 2), round(difference + above, 2)


def write_sheets(frames: Sequence[ConditionFrame], out: Path) -> None:
    """Write up to 24 real and 24 drawn pictures of each condition as JPEG sheets."""
    for drawn in (False, True):
        for name in dict.fromkeys(frame.condition for frame in frames if frame.drawn == drawn):
            chosen = [frame for frame in frames if (frame.condition, frame.drawn) == (name, drawn)][:_SHEET_FRAMES]
            title = f"{name.replace(', ', '-').replace(' ', '-')}-{'drawn' if drawn else 'real'}.jpg"
            write_picture(out / "sheets" / title, picture_sheet([frame.read() for frame in chosen]))


def picture_sheet(pictures: Sequence[Picture]) -> Picture:
    """Pictures in rows of six, each cut to the shape of a thumbnail."""
    wide, high = _THUMBNAIL_WH
    rows = math.ceil(len(pictures) / _SHEET_COLUMNS)
    sheet = np.zeros((rows * high, _SHEET_COLUMNS * wide, 3), np.uint8)
    for i, picture in enumerate(pictures):
        top, left = (i // _SHEET_COLUMNS) * high, (i % _SHEET_COLUMNS) * wide
        scale = max(wide / picture.shape[1], high / picture.shape[0])
        size = (max(round(scale * picture.shape[1]), wide), max(round(scale * picture.shape[0]), high))
        small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        y, x = (size[1] - high) // 2, (size[0] - wide) // 2
        sheet[top : top + high, left : left + wide] = small[y : y + high, x : x + wide]
    return sheet


def tables(half: str, fields_: Mapping[str, Sequence[dict[str, Any]]]) -> list[BenchTable]:
    """The tables to print; their titles name the half that was measured."""
    of_half = "all real frames" if half == "all" else f"half {half}"
    parts = (
        ("rows", TITLE, COLUMNS),
        ("joint", JOINT_TITLE, JOINT_COLUMNS),
        ("probe", PROBE_TITLE, PROBE_COLUMNS),
        ("recall", RECALL_TITLE, RECALL_COLUMNS),
    )
    return [
        BenchTable(f"{title} ({of_half})", columns, fields_[key])
        for key, title, columns in parts
        if fields_.get(key)
    ]
