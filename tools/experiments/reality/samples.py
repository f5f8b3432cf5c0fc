"""Attacks scenes of real dry days, and samples objects around certain failures and anywhere within the bounds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from drivesem.attacks.budgets import STREET
from drivesem.attacks.space import parse_params
from drivesem.config.commands import AttackConfig
from drivesem.config.options import SCENES
from drivesem.failures.neighbourhood import NEAR_REACH, ObjectSample, SceneSampler
from drivesem.run.attack import attack_dataset
from drivesem.run.finished import RebuiltFrame, load_run
from drivesem.run.folder import load_attack_config, load_run_detector
from scene_ir import files
from scene_ir.io import save_scene, to_uint8
from tools.bench.conditions import ConditionSets
from tools.experiments.reality.features import ObjectFeatures, measure_objects
from tools.experiments.reality.observations import conditions_config
from tools.experiments.settings import RealityConfig
from tools.experiments.tables import read_table, write_table

PARAMS = "weather,color,translate,rotate"
"""What attacks may change."""
_MOST_FAILURES = 3
"""Failures of a frame that are sampled."""
ATTACKS = "attacks"
"""Folder of the attacks' runs."""
TABLE = "samples.csv.gz"
"""File of the samples."""


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
    """Attack sunny days of half A and KITTI with each of --attacked, sample them, and write the table."""
    sets = ConditionSets(conditions_config(config, "A"))
    for name in sets.base()[: config.attack_frames]:
        if not (out / "scenes" / name).is_dir():
            with files.atomic_folder(out / "scenes" / name) as part:
                save_scene(sets.scene(name).ir, part)
    sources = {"bdd": (SCENES, str(out / "scenes"), config.attack_frames)}
    if config.kitti_root is not None:
        sources["kitti"] = ("kitti", config.kitti_root, config.kitti_frames)
    rows: list[RuleSample] = []
    for detector in config.attacked.split(","):
        spec, threshold = split_threshold(detector.strip())
        for source, (dataset, root, limit) in sources.items():
            folder = out / ATTACKS / f"{short_name(spec)}-{source}"
            attack = AttackConfig(
                detector=spec,
                t_star=threshold,
                dataset=dataset,
                root=root,
                limit=limit,
                params=PARAMS,
                budget=STREET,
                method="climb",
                passes=config.passes,
                confirm=False,
                workers=1,
                seed=config.seed,
                out=str(folder),
            )
            attack_dataset(attack)
            for frame in _sample_run(config, folder, short_name(spec), out / "sampled" / folder.name):
                rows += frame
    write_table(out / TABLE, (SampledObject, ObjectFeatures), rows)


def _sample_run(config: RealityConfig, folder: Path, name: str, out: Path) -> Iterator[list[RuleSample]]:
    """Sample the frames of a run; each frame's samples are stored."""
    attack = load_attack_config(folder)
    detector = load_run_detector(attack, "cpu")
    for frame in load_run(folder).frames:
        path = out / f"{frame.result.identifier}.csv.gz"
        if not path.is_file():
            rebuilt = RebuiltFrame.load(frame.folder, attack, parse_params(PARAMS), detector)
            rows = list(_sample_frame(config, rebuilt, name))
            write_table(path, (SampledObject, ObjectFeatures), rows)
        yield read_samples(path)


def _sample_frame(config: RealityConfig, frame: RebuiltFrame, detector: str) -> Iterator[RuleSample]:
    """Sample around certain failures of a frame, half of the states close to them, and all of its objects."""
    identifier = frame.result.identifier
    for failure, neighbourhood in islice(frame.neighbourhoods(str(config.seed)), _MOST_FAILURES):
        index = failure.index or 0
        for k in range(config.samples):
            sample = neighbourhood.sample(k, 1.0 if k % 2 else NEAR_REACH)
            if sample is not None:
                missed = neighbourhood.margin(sample) < 0
                yield SampledObject(detector, identifier, index, True, missed), _describe(sample, index)
    sampler = SceneSampler(frame.objective, frame.feasible, frame.nuisances, f"{identifier}:{config.seed}")
    for k in range(config.contrast):
        samples = sampler.sample(k)
        for index, margin in sampler.margins(samples).items():
            yield SampledObject(detector, identifier, index, False, margin < 0), _describe(samples[index], index)


def _describe(sample: ObjectSample, index: int) -> ObjectFeatures:
    boxes = sample.image.targets.boxes_xyxy[index : index + 1].double().cpu().numpy()
    return measure_objects(to_uint8(sample.image.image), np.asarray(boxes))[0]
