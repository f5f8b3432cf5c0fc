"""Detectors by name, asked about all pictures of runs: a row for each run and detector."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import torch

from detectors.base import DetectorError, Predictor
from detectors.registry import SHIPPED
from drivesem.analysis.transfer.matrix import PairCounts, ShownRun, Target, row_of
from drivesem.analysis.transfer.report import answer_of
from drivesem.attack.judging import DEFAULT_T_STAR, HEADLINE, JudgedClasses, t_star_of
from drivesem.config.blocks import Asking
from drivesem.config.commands import Transfer
from drivesem.config.errors import UsageError
from drivesem.evaluation.resampling import DRAWS
from drivesem.report.answer import Answer
from drivesem.run.finished import PICTURES, Frame, Run, load_runs
from drivesem.run.folder import claim
from drivesem.run.looking import Memory, Order, look

DETECTIONS = "detections"
"""Folder of what detectors found."""


@dataclass(frozen=True, slots=True)
class Asked:
    """A detector that is asked. name: for people; t_star: score from which its detections count, by default its
    own, or that of the settings where it has none.
    """

    name: str
    order: Order
    predictor: Predictor
    t_star: float | None = None


_WRITTEN = ("transfer.json", "transfer.md", "transfer.csv", "transfer.png", DETECTIONS)


def words(text: str) -> list[str]:
    """The parts of "a, b", without what is empty."""
    return [part.strip() for part in text.split(",") if part.strip()]


def detector_names(text: str, setting: str = "--detectors") -> list[str]:
    """The detectors of "a,b,darknet:c.cfg,c.weights". Behind KIND:FILE, a part without a colon that is no detector
    by itself goes with it.

    Raises UsageError, naming the setting, where none or one twice is named.
    """
    names: list[str] = []
    for part in words(text):
        alone = ":" in part or part in SHIPPED or part.endswith(".safetensors")
        if names and ":" in names[-1] and not alone:
            names[-1] += f",{part}"
        else:
            names.append(part)
    if not names:
        raise UsageError(setting, "detectors with commas", repr(text))
    for name in names:
        if names.count(name) > 1:
            raise UsageError(setting, "each detector once", name)
    return names


def short_names(names: Sequence[str]) -> list[str]:
    """Detectors without the folders of their files, but for as many as tell each from all others."""

    def end(name: str, folders: int) -> str:
        return re.sub(r"[^,:]+", lambda part: "/".join(part[0].split("/")[-folders - 1 :]), name)

    short = []
    for name in names:
        depths = range(name.count("/") + 1)
        alone = (d for d in depths if [end(other, d) for other in names].count(end(name, d)) == 1)
        short.append(end(name, next(alone, depths[-1])))
    return short


def detectors_of(specs: Sequence[str], config: Asking, out: Path, t_star: float | None = None) -> list[Asked]:
    """All of them loaded, before the first picture: a name that is misspelt shall not show after hours.

    out: in its folder DETECTIONS is remembered what they find; t_star: of all of them. Raises UsageError for what
    is no detector.
    """
    asked = []
    for name, spec in zip(short_names(specs), specs, strict=True):
        order = Order(spec, config.device, config.tiles, out / DETECTIONS)
        try:
            predictor = order.load()
            JudgedClasses.of(predictor)
        except DetectorError as error:
            raise UsageError.of("--detectors", "detectors", error) from error
        asked.append(Asked(name, order, predictor, t_star))
    return asked


def transfer_run(config: Transfer) -> Answer:
    """Show pictures of runs to detectors, and write what is said of them. Raises UsageError or SceneError."""
    runs = load_runs(words(config.run or ""), config.limit)
    specs = detector_names(config.detectors or "")
    out = Path(config.out) if config.out else runs[0].folder / "transfer"
    detectors = detectors_of(specs, config, out)
    # Detections are kept by content, so that no setting of an earlier call is in the way.
    claim(out, config, _WRITTEN, presentation=[field.name for field in fields(config)])
    pairs, failed = pairs_of(runs, detectors, config)
    draws = DRAWS if config.bootstrap is None else config.bootstrap
    rows = [row_of(pair, draws, config.seed) for pair in pairs]
    data = {"rows": [r.to_json() for r in rows], "headline": HEADLINE, "bootstrap": draws, "frames_failed": failed}
    answer = answer_of(out, rows, draws, failed, data)
    answer.write()
    return answer


def pairs_of(
    runs: Sequence[Run], detectors: Sequence[Asked], config: Asking
) -> tuple[list[PairCounts], dict[str, str]]:
    """Each run before each detector, and the pictures that could not be used, with reasons.

    Raises UsageError where no frame of a run is left, SceneError for a bad picture unless `keep_going`.
    """
    failed: dict[str, str] = {}
    pictures = [path for run in runs for frame in run.frames for path in frame.pictures.values()]
    for asked in detectors:
        failed |= look(asked.order, asked.predictor, pictures, config, asked.name)
    pairs: list[PairCounts] = []
    for run in runs:
        frames = [f for f in run.frames if not any(str(p) in failed for p in f.pictures.values())]
        if not frames:
            raise UsageError("--run", "a run with frames that can be read", run.folder)
        pairs += [_pair(run, asked, frames, config) for asked in detectors]
    return pairs, failed


def _pair(run: Run, asked: Asked, frames: Sequence[Frame], config: Asking) -> PairCounts:
    memory, predictor = Memory(asked.order, asked.predictor), asked.predictor
    otherwise = DEFAULT_T_STAR if config.t_star is None else config.t_star
    t_star = t_star_of(predictor, asked.t_star, otherwise)
    target = Target(asked.name, asked.order.detector, JudgedClasses.of(predictor).names, t_star)
    found = {name: [memory.recall(frame.pictures[name]) for frame in frames] for name in PICTURES}
    source = ShownRun(run.name, run.detector, run.method, run.params)
    with torch.no_grad():
        return PairCounts.of(source, target, [frame.result for frame in frames], found)
