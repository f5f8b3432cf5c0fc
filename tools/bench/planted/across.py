"""One fault per detector: bands for cars of all frames, searches in some of them, and rules from all frames.

A fault is drawn at random among those of its kind that hide few cars as photographed and some in Halton's draws.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from detectors.base import Detector, DetectorError
from detectors.planted import FEATURES, Band, PlantedDetector, PlantedFault
from detectors.registry import load_detector
from drivesem.analysis.holes.rules import FeatureSamples
from drivesem.attacks.budgets import parse_budget
from drivesem.attacks.methods.learned import Learn
from drivesem.attacks.objective import Objective
from drivesem.attacks.space import ParameterSpace, parse_params
from drivesem.config.errors import UsageError
from drivesem.config.options import SceneOptions, shared_options
from drivesem.run.attack import AttackWorker, build_grader
from drivesem.run.records import dump_record, load_record
from drivesem.run.search_memory import SearchMemory
from drivesem.scenes.sources import NoVehicleError, SceneSource
from scene_ir import files
from scene_ir.render.compositor import Compositor
from scene_ir.types import SceneIR
from tools.bench.planted.pool import CachingDetector, FramePool, hidden, sharpness
from tools.bench.planted.yardstick import (
    attack_settings,
    certain_losses,
    chosen_methods,
    detected_without_fault,
    sample_neighbourhood,
)
from tools.bench.settings import DetectorBenchConfig

KINDS = tuple(
    tuple(words.split("+"))
    for words in (
        *("height_px", "aspect", "across", "lightness", "contrast"),
        *("aspect+lightness", "height_px+contrast", "height_px+lightness", "across+lightness"),
        *("lightness+contrast", "across+contrast", "aspect+contrast"),
    )
)
"""What faults are about, one detector each."""
AS_PHOTOGRAPHED = 0.1
"""Share of cars found as photographed that a fault may hide there, at most."""
HITS = {"common": (0.02, 0.15), "rare": (0.003, 0.02)}
"""Share of cars in Halton's draws, of those that it does not hide as photographed, that a fault hides."""
CARS = {"common": 8, "rare": 3}
"""Of so many cars at least."""
FRAMES = {"common": 4, "rare": 3}
"""In so many frames at least."""
BY_ITSELF = 0.6
"""Share of cars in Halton's draws that lie in any one band, at most; the others of a pair halve what it holds."""
MIN_WIDTH = {"common": 0.0, "rare": 6.0}
"""Width of a band, at least, in standard deviations of what the detector sees of one car in draws of the camera. In a
narrower one no car is lost for certain; rare faults, which are planted for searches, would often be narrower."""
SAMPLES = 16
"""States around each failure, which are pooled."""
_TRIES = 4000
_DIGITS = 4
SCHEMA = 1


@dataclass(frozen=True, slots=True)
class SharedFault:
    """A fault of a detector."""

    fault: PlantedFault
    hit: float
    """Share of Halton's pictures in which it hides a car."""
    cars: float
    """Of cars in them."""
    still: float
    """Share of cars found as photographed that it hides there."""
    sharp: float
    """Of the cars in Halton's pictures that lie in its bands by their labels, the share that it hides. A
    detector's boxes are not the labels: in a band narrower than that difference few of them are lost."""


@dataclass(frozen=True, slots=True)
class NeighbourhoodSamples:
    """Samples around a failure of one object."""

    index: int
    around: FeatureSamples


@dataclass(frozen=True, slots=True)
class SharedFaultSearch:
    """A search in one frame."""

    frame: str
    fault: str
    """Its text, empty without one."""
    method: str
    certain: int
    """Cars lost for certain."""
    found: int
    """Of these, those that the detector without the fault sees in the same picture."""
    passes: int
    """Of the search."""
    neighbourhoods: tuple[NeighbourhoodSamples, ...]
    """Around each of the certain ones."""


@dataclass(frozen=True, slots=True)
class SharedFaultFrame:
    """What was found in one frame."""

    frame: str
    settings: str
    """See `SharedFaultBench`."""
    attempts: tuple[SharedFaultSearch, ...]


def plant_shared_fault(
    pools: Sequence[FramePool], names: Sequence[str], seed: int, nth: int = 0, rarity: str = "common"
) -> SharedFault | None:
    """The n-th fault of such features, as rare as `HITS` has it; None where none could be drawn. The same for equal
    arguments.
    """
    rows = [FEATURES.index(name) for name in names]
    values, still, cars, frames = _reached(pools, rows)
    if not len(values):
        return None
    narrowest = MIN_WIDTH[rarity] * _camera_noise(pools)[rows]
    rng = np.random.default_rng([seed, *"+".join(names).encode(), *([nth] if nth else [])])
    for _ in range(_TRIES):
        bands = np.array([_band(column, rng) for column in values.T])
        if (bands[:, 1] - bands[:, 0] < narrowest).any():
            continue
        each = (values >= bands[:, 0]) & (values <= bands[:, 1])
        inside = each.all(1)
        alone = each.mean(0)
        if alone.max() > BY_ITSELF or inside.mean() > (alone.min() if len(rows) == 1 else 0.7 * alone.min()):
            continue
        least, most = HITS[rarity]
        if not 0.5 * least <= inside.mean() <= 2 * most:
            continue
        if _inside(still, bands).mean() > 2 * AS_PHOTOGRAPHED or len(np.unique(cars[inside])) < CARS[rarity]:
            continue
        if len(np.unique(frames[inside])) < FRAMES[rarity]:
            continue
        fault = PlantedFault(tuple(Band(n, *b) for n, b in zip(names, bands.tolist(), strict=True)))
        planted = _measured(pools, fault, rarity)
        if planted is not None:
            return planted
    return None


def _reached(
    pools: Sequence[FramePool], rows: Sequence[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Features (K, F) of cars found in Halton's draws, and as photographed; of the former car and frame too."""
    drawn, still, cars, frames = [], [], [], []
    for number, pool in enumerate(pools):
        for state in pool.states:
            for car in state:
                if car.margin > 0 and car.best is not None:
                    drawn.append([car.best[row] for row in rows])
                    cars.append(1000 * number + car.index)
                    frames.append(number)
        still += [
            [car.best[row] for row in rows]
            for car in pool.camera_samples[0]
            if car.margin > 0 and car.best is not None
        ]
    return np.array(drawn), np.array(still).reshape(-1, len(rows)), np.array(cars), np.array(frames)


def _camera_noise(pools: Sequence[FramePool]) -> np.ndarray:
    """Standard deviations of FEATURES of one car in draws of the camera, in the mean of cars; 0 without cars."""
    by_car: dict[tuple[str, int], list[tuple[float, ...]]] = {}
    for pool in pools:
        for car in (car for sample in pool.camera_samples for car in sample):
            if car.margin > 0 and car.best is not None:
                by_car.setdefault((pool.frame, car.index), []).append(car.best)
    variances = [np.var(rows, axis=0, ddof=1) for rows in by_car.values() if len(rows) > 1]
    return np.sqrt(np.mean(variances, axis=0)) if variances else np.zeros(len(FEATURES))


def _band(values: np.ndarray, rng: np.random.Generator) -> list[float]:
    """Low and high between two quantiles of what is reached; half of the bands are open to one side."""
    low, high = np.sort(rng.random(2))
    side = rng.random()
    low, high = (0.0 if side < 0.25 else low), (1.0 if side > 0.75 else high)
    ends = np.quantile(values, [low, high])
    beyond = 0.05 * (ends[1] - ends[0])
    ends += [-beyond if low == 0 else 0.0, beyond if high == 1 else 0.0]
    return [float(f"{end:.{_DIGITS}g}") for end in ends]


def _inside(values: np.ndarray, bands: np.ndarray) -> np.ndarray:
    return np.all((values >= bands[:, 0]) & (values <= bands[:, 1]), axis=1)


def _measured(pools: Sequence[FramePool], fault: PlantedFault, rarity: str) -> SharedFault | None:
    """The fault and how often it hides what; None where that is too much or too little."""
    pictures = hit = count = lost = found = still = 0
    cars: set[tuple[str, int]] = set()
    for pool in pools:
        known, before = pool.found, pool.hidden_as_photographed(fault)
        found, still = found + len(known), still + len(known & before)
        own = [
            (number, car)
            for number, state in enumerate(pool.states)
            for car in state
            if car.margin > 0 and car.index not in before
        ]
        gone = hidden([car for _, car in own], fault, pool.t_star)
        lost_here = [place for place, one in zip(own, gone, strict=True) if one]
        cars |= {(pool.frame, car.index) for _, car in lost_here}
        pictures, hit = pictures + len(pool.states), hit + len({number for number, _ in lost_here})
        count, lost = count + len(own), lost + len(lost_here)
    least, most = HITS[rarity]
    if not found or not count or still > AS_PHOTOGRAPHED * found or not least <= lost / count <= most:
        return None
    if len(cars) < CARS[rarity] or len({frame for frame, _ in cars}) < FRAMES[rarity]:
        return None
    return SharedFault(fault, hit / pictures, lost / count, still / found, sharpness(pools, fault))


@dataclass(frozen=True)
class SharedFaultBench:
    """What one process needs."""

    config: DetectorBenchConfig
    detector: Detector
    workers: dict[str, AttackWorker]
    folder: Path | None
    """Folder of what is done."""
    faults: tuple[str, ...] = ()
    """In words."""
    memories: dict[str, SearchMemory] = field(default_factory=dict[str, SearchMemory])
    """By fault, what `learn` knows of earlier frames."""

    @classmethod
    def of(cls, config: DetectorBenchConfig, faults: tuple[str, ...] = ()) -> SharedFaultBench:
        """Raises UsageError or SceneError for settings that cannot be."""
        methods = chosen_methods(config)
        parse_params(config.params)
        parse_budget(config.budget)
        try:
            detector = load_detector(config.detector, config.device)
        except DetectorError as error:
            raise UsageError.from_detector_error("--detector", "a detector with gradients", error) from error
        first = AttackWorker.from_config(attack_settings(config, methods[0]), detector)
        workers = {method: first.with_config(attack_settings(config, method)) for method in methods}
        folder = None if config.out is None or config.out.endswith(".json") else Path(config.out)
        return cls(config, detector, workers, folder, faults)

    @property
    def states(self) -> int:
        """Of Halton's, a frame."""
        assert self.config.across is not None
        return self.config.across

    @property
    def source(self) -> SceneSource:
        """Of the frames."""
        return next(iter(self.workers.values())).source

    def pool(self, name: str) -> FramePool:
        """A frame's states; what another call has made with the same settings is read. Raises NoVehicleError."""
        settings = self._format_settings(("params", "budget", "detector", "across"))
        path = None if self.folder is None else self.folder / "pools" / name / "pool.json"
        if (
            path is not None
            and self.config.resume
            and path.is_file()
            and files.read_text(path.with_name("settings")) == settings
        ):
            return load_record(path, FramePool, SCHEMA)
        scene = self._scene(name)
        space = ParameterSpace(scene, parse_params(self.config.params), parse_budget(self.config.budget))
        objective = Objective(Compositor(scene), space, CachingDetector(self.detector))
        pool = FramePool.make(objective, name, self.config.seed, self.states)
        if path is not None:
            with files.atomic_folder(path.parent) as part:
                files.write_text(part / path.name, dump_record(pool, SCHEMA))
                files.write_text(part / "settings", settings)
        return pool

    def judge(self, numbered: tuple[int, str]) -> SharedFaultFrame:
        """Search a frame, by its number and name, for the faults assigned to it."""
        number, name = numbered
        chosen = self.turn(number)
        settings = self._format_settings(("params", "budget", "detector", "methods", "passes")) + repr(chosen)
        path = None if self.folder is None else self.folder / "frames" / f"{name}.json"
        if path is not None and self.config.resume and "learn" not in self.workers and path.is_file():
            known = load_record(path, SharedFaultFrame, SCHEMA)
            if known.settings == settings:
                return known
        scene, shared_detector = self._scene(name), CachingDetector(self.detector)
        attempts = tuple(
            self._attempt(name, scene, fault, method, shared_detector)
            for fault in chosen
            for method in self.workers
        )
        judged = SharedFaultFrame(name, settings, attempts)
        if path is not None:
            files.write_text(path, dump_record(judged, SCHEMA))
        return judged

    def turn(self, number: int) -> list[str]:
        """Faults that are searched for in the number-th frame, and "" for none: all, or `--faults` of them."""
        every = [*self.faults, ""]
        count = min(self.config.faults or len(every), len(every))
        return [every[(number * count + k) % len(every)] for k in range(count)]

    def _attempt(
        self, name: str, scene: SceneIR, fault: str, method: str, inner: CachingDetector
    ) -> SharedFaultSearch:
        worker, memory = self.workers[method], self.memories.setdefault(fault, SearchMemory())
        if isinstance(worker.method, Learn):
            worker = replace(worker, method=replace(worker.method, knowledge=memory.knowledge()))
        detector = PlantedDetector(inner, PlantedFault.parse(fault)).requires_grad_(False) if fault else inner
        attacked = replace(worker, detector=detector, grader=build_grader(worker.config, detector)).attack_scene(
            name, scene
        )
        if attacked.learns:
            memory.add(name, attacked.experience)
        certain = certain_losses(attacked)
        seen = detected_without_fault(self.detector, attacked) if certain else ()
        neighbourhoods = tuple(
            NeighbourhoodSamples(index, sample_neighbourhood(attacked, index, SAMPLES, self.config.seed))
            for index in certain
        )
        found = sum(index in seen for index in certain)
        return SharedFaultSearch(name, fault, method, len(certain), found, attacked.passes, neighbourhoods)

    def _scene(self, name: str) -> SceneIR:
        scene = self.source.scene(name)
        if not len(scene.objects):
            raise NoVehicleError(f"frame {name}", "a vehicle that can be de-rendered", "none")
        return scene

    def _format_settings(self, names: Sequence[str]) -> str:
        settings = shared_options(self.config, SceneOptions) | {name: getattr(self.config, name) for name in names}
        return repr(sorted((key, str(value)) for key, value in settings.items() if key != "limit"))


def build_pool_worker(config: DetectorBenchConfig) -> Callable[[str], FramePool]:
    """`Across.pool` of another process."""
    return SharedFaultBench.of(config).pool


def judge_of(
    config: DetectorBenchConfig, faults: tuple[str, ...]
) -> Callable[[tuple[int, str]], SharedFaultFrame]:
    """`Across.judge` of another process."""
    return SharedFaultBench.of(config, faults).judge
