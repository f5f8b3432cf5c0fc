"""Who finds planted faults: failures that are certain, for each hundred passes of the detector."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np

from detectors.base import Detector, DetectorError, predict
from detectors.planted import Band, PlantedDetector, PlantedFault
from detectors.registry import load_detector
from drivesem.analysis.holes.rules import FeatureSamples
from drivesem.analysis.holes.run import draw_samples_around
from drivesem.attacks.budgets import parse_budget
from drivesem.attacks.objective import Objective
from drivesem.attacks.space import ParameterSpace, parse_params
from drivesem.config.commands import AttackConfig, HolesConfig
from drivesem.config.errors import UsageError
from drivesem.config.options import SceneOptions, shared_options
from drivesem.evaluation import failures
from drivesem.failures.grades import Grade
from drivesem.failures.neighbourhood import Neighbourhood
from drivesem.failures.nuisances import Nuisances
from drivesem.failures.rules import fit_rule, format_rule, overlap
from drivesem.run.attack import AttackWorker, build_grader
from drivesem.run.frame import AttackedScene
from drivesem.scenes.sources import NoVehicleError
from scene_ir import files
from scene_ir.render.compositor import Compositor
from tools.bench.planted.plant import KINDS, FaultKind, FaultPlacement, plant
from tools.bench.planted.survey import FrameSurvey
from tools.bench.settings import DetectorBenchConfig

METHODS = tuple(name for name in get_args(get_type_hints(AttackConfig)["method"]) if name != "placebo")
"""Attacks that can be judged: a placebo needs a run to be like."""
NO_FAULT = "none"
"""Kind and rarity of attempts on the unchanged detector, the control for rules."""
SURE = (Grade.CERTAIN, Grade.CONFIRMED, Grade.SHARED)
QUICK_KINDS = (KINDS[2], KINDS[-2])
"""One easy, one rare: those that could be planted wherever that was tried."""


@dataclass(frozen=True, slots=True)
class FaultSearch:
    """One method on one fault of one frame."""

    frame: str
    kind: str
    rarity: str
    fault: str
    hit: float
    """As of `FaultPlacement`."""
    sure: float
    """As of `FaultPlacement`."""
    method: str
    certain: int
    """Cars lost for certain."""
    found: int
    """Of these, those that the detector without the fault sees in the same picture."""
    inside: int
    """Of those, the ones inside of the fault's region."""
    passes: int
    """Of the detector."""
    seconds: float
    """Of the search and of certificates."""
    rule: str | None = None
    """Rule from samples around the first of those found (`naming`); None without --naming."""
    named: bool = False
    """Whether that is the fault, or a feature of it."""
    in_part: bool = False
    """Whether that is the fault, or a feature of it."""
    naming: int = 0
    """Passes that it took."""


@dataclass(frozen=True, slots=True)
class FrameSearches:
    """A frame."""

    frame: str
    attempts: tuple[FaultSearch, ...]
    """On all faults that could be planted."""
    unplanted: tuple[str, ...]
    """Kinds of the others."""

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def of_json(cls, data: Mapping[str, Any]) -> FrameSearches:
        return cls(data["frame"], tuple(FaultSearch(**row) for row in data["attempts"]), tuple(data["unplanted"]))


def chosen_methods(config: DetectorBenchConfig) -> tuple[str, ...]:
    """The methods that a command names. Raises UsageError for one that is not known."""
    return _names_among(METHODS, "--methods", config.methods)


def rule_methods(config: DetectorBenchConfig) -> tuple[str, ...]:
    """Methods with failures to explain by rules. Raises UsageError for another one."""
    return () if config.naming is None else _names_among(chosen_methods(config), "--naming", config.naming)


def _names_among(known: Sequence[str], setting: str, text: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))
    if not names or not set(names) <= set(known):
        raise UsageError(setting, f"names among {', '.join(known)}, with commas", repr(text))
    return names


def attack_settings(config: DetectorBenchConfig, method: str) -> AttackConfig:
    """The settings of a method; only the detector itself is used."""
    settings = AttackConfig(
        **shared_options(config, SceneOptions),
        method=method,  # pyright: ignore[reportArgumentType]
        params=config.params,
        budget=config.budget,
        passes=config.passes,
        detector=config.detector,
        device=config.device,
        confirm=False,
        second_detector="off",
        workers=1,
    )
    settings.check()
    return settings


@dataclass(frozen=True)
class PlantedFaultBench:
    """What one process needs."""

    config: DetectorBenchConfig
    detector: Detector
    workers: Mapping[str, AttackWorker]
    """By method."""
    kinds: tuple[FaultKind, ...]
    named: tuple[str, ...]
    """Methods with failures to explain by rules."""
    folder: Path | None
    """Folder of what is done, by frame."""

    @classmethod
    def of(cls, config: DetectorBenchConfig) -> PlantedFaultBench:
        """Raises UsageError or SceneError for settings that cannot be."""
        methods = chosen_methods(config)
        parse_params(config.params)
        try:
            detector = load_detector(config.detector, config.device)
        except DetectorError as error:
            raise UsageError.from_detector_error("--detector", "a detector with gradients", error) from error
        first = AttackWorker.from_config(attack_settings(config, methods[0]), detector)
        workers = {method: first.with_config(attack_settings(config, method)) for method in methods}
        folder = None if config.out is None or config.out.endswith(".json") else Path(config.out) / "frames"
        return cls(config, detector, workers, QUICK_KINDS if config.quick else KINDS, rule_methods(config), folder)

    def judge(self, name: str) -> FrameSearches:
        """All methods on all faults of a frame; what another call has done with the same settings is read."""
        settings = {field.name: str(getattr(self.config, field.name)) for field in fields(SceneOptions)}
        keys = ("methods", "passes", "params", "budget", "detector", "quick", "faults", "naming")
        settings |= {key: getattr(self.config, key) for key in keys}
        settings.pop("limit")
        path = None if self.folder is None else self.folder / f"{name}.json"
        if path is not None and self.config.resume and path.is_file():
            known = files.read_json(path)
            if known["settings"] == settings:
                return FrameSearches.of_json(known["judged"])
        judged = self._judge(name)
        if path is not None:
            files.write_json(path, {"settings": settings, "judged": judged.to_json()})
        return judged

    def _judge(self, name: str) -> FrameSearches:
        scene = next(iter(self.workers.values())).source.scene(name)
        if not len(scene.objects):
            raise NoVehicleError(f"frame {name}", "a vehicle that can be de-rendered", "none")
        space = ParameterSpace(scene, parse_params(self.config.params), parse_budget(self.config.budget))
        objective = Objective(Compositor(scene), space, self.detector)
        survey = FrameSurvey.make(objective, objective.feasible_set(), name, self.config.seed)
        attempts: list[FaultSearch] = []
        unplanted: list[str] = []
        planted = 0
        for kind in self._kinds_of(name):
            if planted == self.config.faults:
                break
            planting = plant(survey, kind, self.config.seed)
            if planting is None:
                unplanted.append(kind.text)
                continue
            planted += 1
            detector = PlantedDetector(self.detector, planting.fault).requires_grad_(False)
            for method, worker in self.workers.items():
                grader = build_grader(worker.config, detector)
                attacked = replace(worker, detector=detector, grader=grader).attack_scene(name, scene)
                attempts.append(self._attempt(name, method, planting, survey, attacked))
        attempts += [
            self._control(name, method, self.workers[method].attack_scene(name, scene)) for method in self.named
        ]
        return FrameSearches(name, tuple(attempts), tuple(unplanted))

    def _kinds_of(self, name: str) -> list[FaultKind]:
        """All, or with --faults easy and rare ones in turn, in an order of the frame's own."""
        if self.config.faults is None:
            return list(self.kinds)
        rng = np.random.default_rng([self.config.seed, *name.encode()])
        order = [self.kinds[i] for i in rng.permutation(len(self.kinds))]
        easy, rare = ([kind for kind in order if kind.rarity == rarity] for rarity in ("easy", "rare"))
        pairs = zip_longest(*((easy, rare) if rng.random() < 0.5 else (rare, easy)))
        return [kind for pair in pairs for kind in pair if kind is not None]

    def _attempt(
        self, name: str, method: str, planting: FaultPlacement, survey: FrameSurvey, attacked: AttackedScene
    ) -> FaultSearch:
        certain = certain_losses(attacked)
        seen = detected_without_fault(self.detector, attacked) if certain else ()
        found = [index for index in certain if index in seen]
        inside = survey.inside(planting.fault, attacked.search.theta) if found else None
        attempt = FaultSearch(
            frame=name,
            kind=planting.kind.text,
            rarity=planting.kind.rarity,
            fault=planting.fault.text,
            hit=planting.hit,
            sure=planting.sure,
            method=method,
            certain=len(certain),
            found=len(found),
            inside=0 if inside is None else int(inside[found].sum()),
            passes=attacked.passes,
            seconds=round(attacked.seconds, 2),
        )
        if not found or method not in self.named:
            return attempt
        where, passes = fit_fault_rule(attacked, found[0], HolesConfig.samples, self.config.seed)
        whole, in_part = rule_names_fault(where, planting.fault, survey.bands_by_label(planting.fault))
        return replace(attempt, rule=format_rule(where), named=whole, in_part=in_part, naming=passes)

    def _control(self, name: str, method: str, attacked: AttackedScene) -> FaultSearch:
        """The same without a fault: what is named then is not planted."""
        certain = certain_losses(attacked)
        where, passes = (
            fit_fault_rule(attacked, certain[0], HolesConfig.samples, self.config.seed) if certain else (None, 0)
        )
        return FaultSearch(
            frame=name,
            kind=NO_FAULT,
            rarity=NO_FAULT,
            fault="",
            hit=0.0,
            sure=0.0,
            method=method,
            certain=len(certain),
            found=len(certain),
            inside=0,
            passes=attacked.passes,
            seconds=round(attacked.seconds, 2),
            rule=None if where is None else format_rule(where),
            naming=passes,
        )


def judge_of(config: DetectorBenchConfig) -> Callable[[str], FrameSearches]:
    """`Yardstick.judge` of another process."""
    return PlantedFaultBench.of(config).judge


def certain_losses(attacked: AttackedScene) -> list[int]:
    """Objects that are lost for certain."""
    return [f.index for f in attacked.failures if f.index is not None and f.grade in SURE]


def detected_without_fault(detector: Detector, attacked: AttackedScene) -> tuple[int, ...]:
    """Objects that a detector finds in an attacked scene's picture."""
    objective, rendered = attacked.objective, attacked.rendered
    detections = objective.classes.map_detections(predict(detector, rendered.render.image[None])[0])
    judgement = failures.match_detections(
        objective.classes.map_targets(rendered.moved.targets), detections, objective.t_star
    )
    return tuple(judgement.detected.nonzero()[:, 0].tolist())


ENOUGH = 0.5
"""Overlap of bands, their intersection by their hull, from which a band is the right one."""

Where = Mapping[str, tuple[float, float]]


def fit_fault_rule(attacked: AttackedScene, index: int, samples: int, seed: int) -> tuple[Where, int]:
    """A rule from so many samples around the failure of one object, and the passes that they took."""
    around = sample_neighbourhood(attacked, index, samples, seed)
    return fit_rule(around.columns(), around.failing).intervals if around.margins else {}, len(around.margins)


def sample_neighbourhood(attacked: AttackedScene, index: int, samples: int, seed: int) -> FeatureSamples:
    """So many samples around the failure of one object, half of them close to it. Each costs a pass."""
    objective, nuisances = attacked.objective, Nuisances()
    name = f"{attacked.identifier}:{index}:{seed}"
    near = Neighbourhood(objective, objective.feasible_set(), attacked.search.theta, index, nuisances, name)
    return draw_samples_around(near, samples)


def rule_names_fault(where: Where, fault: PlantedFault, bands: Sequence[Band]) -> tuple[bool, bool]:
    """Whether a rule names a fault: wholly, in part. bands: where it hides cars, by features of their labels;
    without any nothing is right.
    """
    true = {band.feature: (band.low, band.high) for band in bands}
    right = [name for name in where if name in true and overlap({name: where[name]}, {name: true[name]}) >= ENOUGH]
    return bool(right) and set(right) == set(where) == set(fault.feature_names), bool(right)
