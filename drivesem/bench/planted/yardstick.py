"""Who finds planted faults: failures that are certain, for each hundred passes of the detector."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, get_args, get_type_hints

from detectors.base import Detector, DetectorError, predict
from detectors.planted import PlantedDetector
from detectors.registry import load_detector
from drivesem.attack.objective import Objective
from drivesem.attack.space import ParameterSpace, parse_params
from drivesem.bench.planted.plant import KINDS, FaultKind, Planting, plant
from drivesem.bench.planted.survey import FrameSurvey
from drivesem.evaluation import failures
from drivesem.run.attack import Worker, grader_of
from drivesem.run.frame import AttackedScene
from drivesem.scenes.sources import NoVehicleError
from drivesem.settings.blocks import Scenes, shared
from drivesem.settings.commands import Attack, Bench
from drivesem.settings.errors import UsageError
from drivesem.truth.grades import Grade
from scene_ir import files
from scene_ir.render.compositor import Compositor

METHODS = tuple(name for name in get_args(get_type_hints(Attack)["method"]) if name != "placebo")
"""Attacks that can be judged: a placebo needs a run to be like."""
SURE = (Grade.CERTAIN, Grade.CONFIRMED, Grade.SHARED)
QUICK_KINDS = (KINDS[2], KINDS[-2])
"""One easy, one rare: those that could be planted wherever that was tried."""


@dataclass(frozen=True, slots=True)
class Attempt:
    """One method on one fault of one frame. hit, sure: as of `Planting`. certain: cars lost for certain; found: of
    these, those that the detector without the fault sees in the same picture; inside: of those, the ones inside of
    the fault's region; passes: of the detector; seconds: of the search and of certificates.
    """

    frame: str
    kind: str
    rarity: str
    fault: str
    hit: float
    sure: float
    method: str
    certain: int
    found: int
    inside: int
    passes: int
    seconds: float


@dataclass(frozen=True, slots=True)
class JudgedFrame:
    """A frame. attempts: on all faults that could be planted; unplanted: kinds of the others."""

    frame: str
    attempts: tuple[Attempt, ...]
    unplanted: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def of_json(cls, data: Mapping[str, Any]) -> JudgedFrame:
        return cls(data["frame"], tuple(Attempt(**row) for row in data["attempts"]), tuple(data["unplanted"]))


def methods_of(config: Bench) -> tuple[str, ...]:
    """The methods that a command names. Raises UsageError for one that is not known."""
    names = tuple(dict.fromkeys(word.strip() for word in config.methods.split(",") if word.strip()))
    if not names or not set(names) <= set(METHODS):
        raise UsageError("--methods", f"names among {', '.join(METHODS)}, with commas", repr(config.methods))
    return names


def attack_settings(config: Bench, method: str) -> Attack:
    """The settings of a method: nobody is asked but the detector itself."""
    settings = Attack(
        **shared(config, Scenes),
        method=method,  # pyright: ignore[reportArgumentType]
        params=config.params,
        passes=config.passes,
        detector=config.detector,
        device=config.device,
        confirm=False,
        peer="off",
        workers=1,
    )
    settings.check()
    return settings


@dataclass(frozen=True)
class Yardstick:
    """What one process needs. workers: by method; kept: folder of what is done, by frame."""

    config: Bench
    detector: Detector
    workers: Mapping[str, Worker]
    kinds: tuple[FaultKind, ...]
    kept: Path | None

    @classmethod
    def of(cls, config: Bench) -> Yardstick:
        """Raises UsageError or SceneError for settings that cannot be."""
        methods = methods_of(config)
        parse_params(config.params)
        try:
            detector = load_detector(config.detector, config.device)
        except DetectorError as error:
            raise UsageError("--detector", "a detector with gradients", error) from error
        first = Worker.of(attack_settings(config, methods[0]), detector)
        workers = {method: first.beside(attack_settings(config, method)) for method in methods}
        kept = None if config.out is None or config.out.endswith(".json") else Path(config.out) / "frames"
        return cls(config, detector, workers, QUICK_KINDS if config.quick else KINDS, kept)

    def judge(self, name: str) -> JudgedFrame:
        """All methods on all faults of a frame; what another call has done with the same settings is read."""
        asked = {field.name: str(getattr(self.config, field.name)) for field in fields(Scenes)}
        asked |= {key: getattr(self.config, key) for key in ("methods", "passes", "params", "detector", "quick")}
        asked.pop("limit")
        path = None if self.kept is None else self.kept / f"{name}.json"
        if path is not None and self.config.resume and path.is_file():
            known = files.read_json(path)
            if known["asked"] == asked:
                return JudgedFrame.of_json(known["judged"])
        judged = self._judge(name)
        if path is not None:
            files.write_json(path, {"asked": asked, "judged": judged.to_json()})
        return judged

    def _judge(self, name: str) -> JudgedFrame:
        scene = next(iter(self.workers.values())).source.scene(name)
        if not len(scene.objects):
            raise NoVehicleError(f"frame {name}", "a vehicle that can be taken apart", "none")
        space = ParameterSpace(scene, parse_params(self.config.params))
        objective = Objective(Compositor(scene), space, self.detector)
        survey = FrameSurvey.make(objective, objective.feasible_set(), name, self.config.seed)
        attempts: list[Attempt] = []
        unplanted: list[str] = []
        for kind in self.kinds:
            planting = plant(survey, kind, self.config.seed)
            if planting is None:
                unplanted.append(kind.text)
                continue
            detector = PlantedDetector(self.detector, planting.fault).requires_grad_(False)
            for method, worker in self.workers.items():
                grader = grader_of(worker.config, detector)
                attacked = replace(worker, detector=detector, grader=grader).search(name, scene)
                attempts.append(self._attempt(name, method, planting, survey, attacked))
        return JudgedFrame(name, tuple(attempts), tuple(unplanted))

    def _attempt(
        self, name: str, method: str, planting: Planting, survey: FrameSurvey, attacked: AttackedScene
    ) -> Attempt:
        certain = [f.index for f in attacked.failures if f.index is not None and f.grade in SURE]
        seen = _seen_without(self.detector, attacked) if certain else ()
        found = [index for index in certain if index in seen]
        inside = survey.inside(planting.fault, attacked.search.theta) if found else None
        return Attempt(
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


def judge_of(config: Bench) -> Callable[[str], JudgedFrame]:
    """`Yardstick.judge` of another process."""
    return Yardstick.of(config).judge


def _seen_without(detector: Detector, attacked: AttackedScene) -> tuple[int, ...]:
    """Objects that a detector finds in an attacked scene's picture."""
    objective, rendered = attacked.objective, attacked.rendered
    detections = objective.judged.detections(predict(detector, rendered.render.image[None])[0])
    judgement = failures.judge(objective.judged.targets(rendered.moved.targets), detections, objective.t_star)
    return tuple(judgement.found.nonzero()[:, 0].tolist())
