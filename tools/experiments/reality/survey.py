"""The survey of certain failures on dry days, and of misses on real frames in bad weather and by night."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from drivesem.run.finished import RunFrame, load_run
from drivesem.run.frame import certain_losses
from scene_ir import files
from tools.bench.conditions import CONDITIONS, VEHICLES, ConditionFrame, ConditionSets
from tools.experiments.reality.observations import ADVERSE, REAL, TABLE, conditions_config, read_observations
from tools.experiments.reality.samples import ATTACKS, PARAMS
from tools.experiments.settings import RealityConfig
from tools.experiments.survey.page import (
    CHANGED,
    PHOTOGRAPH,
    Box,
    SurveyItem,
    SurveyPicture,
    crop_pictures,
    write_survey,
)
from tools.experiments.tables import RESULTS

_TRUTHS = {"car": "Car", "bus": "Truck", "truck": "Truck"}
"""The survey's answer for each class of the real frames."""
Question = tuple[str, str, str, int, str, Callable[[], SurveyPicture]]
"""Kind, run or condition, frame, number of the vehicle, its class, and what crops its pictures."""


def write_reality_survey(config: RealityConfig, out: Path) -> dict[str, int]:
    """Write the page with up to --items questions of each kind, drawn at random. Returns their numbers."""
    rng = np.random.default_rng(config.seed)
    chosen = [
        group[i]
        for group in (_certain_failures(out), _real_misses(config, out))
        for i in rng.permutation(len(group))[: config.items]
    ]
    questions = []
    for number in rng.permutation(len(chosen)).tolist():
        kind, source, frame, index, truth, crop = chosen[number]
        name = hashlib.sha256(f"{config.seed} {source} {frame} {index} {kind}".encode()).hexdigest()[:8]
        params = PARAMS if kind == CHANGED else ""
        questions.append((SurveyItem(name, kind, source, params, frame, index, truth), crop()))
    write_survey(out / "survey", questions, {"seed": config.seed})
    return {kind: sum(item.kind == kind for item, _ in questions) for kind in (CHANGED, PHOTOGRAPH)}


def _certain_failures(out: Path) -> list[Question]:
    """All vehicles that attacked detectors certainly lose."""
    found: list[Question] = []
    for folder in sorted((out / ATTACKS).iterdir()):
        for frame in load_run(folder).frames:
            for failure in certain_losses(frame.result):
                place = frame.result.identifier, failure.index or 0, failure.label
                found.append((CHANGED, folder.name, *place, partial(_crop_attacked, frame, failure.xyxy)))
    return found


def _real_misses(config: RealityConfig, out: Path) -> list[Question]:
    """Vehicles in real adverse frames that the first of --attacked misses."""
    detector = config.attacked.split(",")[0].strip()
    sets = ConditionSets(conditions_config(config, "B"))
    rows = read_observations(out / RESULTS / TABLE.format("B"))
    found: list[Question] = []
    for condition in CONDITIONS:
        if condition.name not in ADVERSE:
            continue
        frames = {frame.name: frame for frame in islice(sets.real(condition), config.real)}
        datasets = {name: dataset for dataset, name in sets.names(condition)}
        for one, _ in rows:
            if one.source != REAL or one.condition != condition.name or detector not in one.missed_by.split():
                continue
            labels = datasets[one.frame].labels(one.frame)
            kinds = [] if labels is None else [kind for kind in labels.kind if kind in VEHICLES]
            place = one.frame, one.number, _TRUTHS[kinds[one.number]]
            crop = partial(_crop_real, frames[one.frame], one.number)
            found.append((PHOTOGRAPH, condition.name, *place, crop))
    return found


def _crop_attacked(frame: RunFrame, box_xyxy: Box) -> SurveyPicture:
    before, after = (files.read_image(frame.pictures[name]) for name in ("benign", "attacked"))
    return crop_pictures(before, after, box_xyxy)


def _crop_real(frame: ConditionFrame, number: int) -> SurveyPicture:
    x0, y0, x1, y1 = frame.boxes_xyxy[number].tolist()
    return crop_pictures(None, frame.read(), (x0, y0, x1, y1))
