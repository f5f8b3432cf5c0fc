"""Attacks scenes of real dry days, and samples objects around certain failures and anywhere within the bounds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from drivesem.attacks.budgets import PRESETS, STREET
from drivesem.attacks.objective import Objective
from drivesem.attacks.space import ParameterSpace, parse_params
from drivesem.config.commands import AttackConfig
from drivesem.config.options import SCENES
from drivesem.failures.neighbourhood import NEAR_REACH, ObjectSample, SceneSampler
from drivesem.failures.nuisances import Nuisances
from drivesem.run.attack import attack_dataset
from drivesem.run.finished import RebuiltFrame, RunFrame, load_run
from drivesem.run.folder import load_run_detector
from scene_ir import files
from scene_ir.io import save_scene, to_uint8
from scene_ir.render.compositor import Compositor
from scene_ir.types import SceneIR
from tools.bench.conditions import ConditionSets
from tools.experiments.reality.features import ObjectFeatures, measure_objects
from tools.experiments.reality.observations import conditions_config
from tools.experiments.settings import RealityConfig
from tools.experiments.tables import RESULTS, read_table, write_table

PARAMS = "weather,color,translate,rotate"
"""What attacks may change."""
_MOST_FAILURES = 3
"""Failures of a frame that are sampled."""
ATTACKS = "attacks"
"""Folder of the attacks' runs."""
TABLE = "samples-{}.csv.gz"
"""File of the samples of an attacked detector."""


@dataclass(frozen=True, slots=True)
class SampledObject:
    """One object in one rendered state."""

    detector: str
    """Name of the attacked detector."""
    frame: str
    """Name of the frame."""
    number: int
    """Number of the object in the scene."""
    failure: bool
    """Whether the state lies around a certain failure of the object; otherwise anywhere within the bounds."""
    missed: bool
    """Whether the detector misses it."""


RuleSample = tuple[SampledObject, ObjectFeatures]


def read_samples(path: Path) -> list[RuleSample]:
    """Read the samples. Raises FormatError for a damaged file."""
    return [(one, features) for one, features in read_table(path, (SampledObject, ObjectFeatures))]


def short_name(detector: str) -> str:
    """Name of a detector without folders and threshold, as `tools.bench conditions` has it."""
    return split_threshold(detector)[0].rpartition("/")[2]


def split_threshold(detector: str) -> tuple[str, float | None]:
    """Split NAME@SCORE; without @, the threshold is None."""
    name, at, score = detector.rpartition("@")
    return (name, float(score)) if at else (score, None)


def attack_days(config: RealityConfig, out: Path) -> None:
    """Attack sunny days of half A and KITTI with each of --attacked, sample objects, and write the tables."""
    sets = ConditionSets(conditions_config(config, "A"))
    days = sets.base()
    for name in days[: config.attack_frames]:
        if not (out / "scenes" / name).is_dir():
            with files.atomic_folder(out / "scenes" / name) as part:
                save_scene(sets.scene(name).ir, part)
    sources = {}
    if config.attack_frames:
        sources["bdd"] = (SCENES, str(out / "scenes"), config.attack_frames)
    if config.kitti_root is not None:
        sources["kitti"] = ("kitti", config.kitti_root, config.kitti_frames)
    for text in config.attacked.split(","):
        spec, threshold = split_threshold(text.strip())
        attack = AttackConfig(
            detector=spec,
            t_star=threshold,
            params=PARAMS,
            budget=STREET,
            method="climb",
            passes=config.passes,
            confirm=False,
            workers=1,
            seed=config.seed,
        )
        rows: list[RuleSample] = []
        sampler = _Sampler(config, attack, short_name(spec), out / "sampled" / short_name(spec))
        for source, (dataset, root, limit) in sources.items():
            folder = out / ATTACKS / f"{sampler.name}-{source}"
            attack_dataset(replace(attack, dataset=dataset, root=root, limit=limit, out=str(folder)))
            for frame in load_run(folder).frames:
                rows += sampler.around_failures(frame)
        for name in days:
            rows += sampler.anywhere(sets.scene(name).ir, name)
        write_table(out / RESULTS / TABLE.format(sampler.name), (SampledObject, ObjectFeatures), rows)


class _Sampler:
    """Samples objects for one detector; finished frames are stored."""

    def __init__(self, config: RealityConfig, attack: AttackConfig, name: str, out: Path) -> None:
        self.name = name
        self._config, self._attack, self._out = config, attack, out
        self._detector = load_run_detector(attack, "cpu")

    def around_failures(self, frame: RunFrame) -> list[RuleSample]:
        """Samples around certain failures of a frame, half of the states close to them."""

        def sample() -> Iterator[RuleSample]:
            identifier, seed = frame.result.identifier, str(self._config.seed)
            rebuilt = RebuiltFrame.load(frame.folder, self._attack, parse_params(PARAMS), self._detector)
            for failure, neighbourhood in islice(rebuilt.neighbourhoods(seed), _MOST_FAILURES):
                index = failure.index or 0
                for k in range(self._config.samples):
                    one = neighbourhood.sample(k, 1.0 if k % 2 else NEAR_REACH)
                    if one is not None:
                        missed = neighbourhood.margin(one) < 0
                        yield SampledObject(self.name, identifier, index, True, missed), _describe(one, index)

        return self._stored(f"{frame.result.identifier}-failures", sample)

    def anywhere(self, scene: SceneIR, name: str) -> list[RuleSample]:
        """Samples of all objects of a scene anywhere within the bounds, if they are detected in the photograph."""

        def sample() -> Iterator[RuleSample]:
            space = ParameterSpace(scene, parse_params(PARAMS), PRESETS[STREET])
            objective = Objective(Compositor(scene), space, self._detector, self._attack)
            nuisances = Nuisances.parse(self._attack.nuisances)
            sampler = SceneSampler(objective, objective.feasible_set(), nuisances, f"{name}:{self._config.seed}")
            for k in range(self._config.contrast):
                samples = sampler.sample(k)
                for index, margin in sampler.margins(samples).items():
                    described = _describe(samples[index], index)
                    yield SampledObject(self.name, name, index, False, margin < 0), described

        return self._stored(name, sample)

    def _stored(self, name: str, sample: Callable[[], Iterator[RuleSample]]) -> list[RuleSample]:
        path = self._out / f"{name}.csv.gz"
        if not path.is_file():
            write_table(path, (SampledObject, ObjectFeatures), sample())
        return read_samples(path)


def _describe(sample: ObjectSample, index: int) -> ObjectFeatures:
    boxes = sample.image.targets.boxes_xyxy[index : index + 1].double().cpu().numpy()
    return measure_objects(to_uint8(sample.image.image), np.asarray(boxes))[0]
