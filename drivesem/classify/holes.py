"""`drivesem classify holes`: the poses in which an object is misclassified, around each failure of a run.

Samples, rules and intervals are those of detectors' holes; the features are the angles themselves, so that fresh
samples are drawn inside of a rule and not looked for.
"""

from __future__ import annotations

import math
import zlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from drivesem.classify.finished import FailureWorker, ask_of_failures
from drivesem.classify.scenes import SEEN_PX, VIEWS
from drivesem.config.commands import ClassifyConfig
from drivesem.evaluation.resampling import wilson
from drivesem.failures.rules import Floats, Intervals, fit_rule
from drivesem.report.tables import AnalysisReport, ReportTable
from scene_ir.io import round_to_8bit

AXES: tuple[str, ...] = ("pitch", "yaw", "roll")
_NOTES = (
    "Where: pitch, yaw and roll of the object in degrees, the view's own turn included (top: pitch 20; left and "
    "right: yaw 29 and -29), with shape and light as they were found. Misclassified: share of fresh samples "
    "inside of the rule, each seen once, with nuisances, and Wilson's 95 % interval. Elsewhere: the same of "
    "samples outside of it, within --reach of the pose that was found.",
)


@dataclass(frozen=True, slots=True)
class PoseHole:
    """Around one failure. source: digest of the run's result; predicted: what it is called most often there;
    where: intervals by axis, degrees, empty where no angle tells failures; fails, count: of fresh samples inside;
    fails_outside, count_outside: of samples outside of it; fails_all, count_all: of the whole neighbourhood.
    """

    identifier: str
    source: str
    label: str
    predicted: str
    where: dict[str, tuple[float, float]]
    fails: int
    count: int
    fails_outside: int
    count_outside: int
    fails_all: int
    count_all: int
    passes: int

    @property
    def interval(self) -> tuple[float, float]:
        """Of the probability inside."""
        return wilson(self.fails, self.count)

    def sentence(self) -> str:
        """For people."""
        ends = (f"{axis} from {low:.0f} to {high:.0f} degrees" for axis, (low, high) in self.where.items())
        low, high = self.interval
        share = f"{100 * self.fails / self.count:.0f} % [{100 * low:.0f}, {100 * high:.0f}]"
        place = " and ".join(ends) or "any angle near"
        called = f"misclassified, mostly as {self.predicted}"
        return f"The {self.label} of {self.identifier} is {called}, in {share} of poses with {place}"


class HoleWorker(FailureWorker[PoseHole]):
    """Turns an object around the pose in which it failed."""

    question, file, kind = "holes", "hole.json", PoseHole

    def analyse(self, name: str, source: str, folder: Path) -> PoseHole:
        """See `FailureWorker`."""
        poses, config = Poses(self, name), self.config
        label, bounds = poses.objective.scene.model.label, poses.bounds(config.reach)
        asked = poses.rng.uniform(bounds[:, 0], bounds[:, 1], (config.samples, 3))
        fails = poses.called(asked) != label
        rule = fit_rule({axis: asked[:, i] for i, axis in enumerate(AXES)}, fails)
        for axis, interval in rule.intervals.items():
            bounds[AXES.index(axis)] = interval
        inside = poses.called(poses.rng.uniform(bounds[:, 0], bounds[:, 1], (config.fresh, 3)), config.samples)
        wrong = inside[inside != label].tolist()
        frame, classes = self.run.frames[name], self.attacker.network.classes
        return PoseHole(
            identifier=name,
            source=source,
            label=frame.label,
            predicted=classes[Counter(wrong).most_common(1)[0][0]] if wrong else frame.attacked.predicted,
            where=_as_seen(rule.intervals, frame.view),
            fails=len(wrong),
            count=len(inside),
            fails_outside=rule.failures_outside,
            count_outside=rule.count_outside,
            fails_all=int(fails.sum()),
            count_all=len(fails),
            passes=poses.objective.passes,
        )


class Poses:
    """The object of a failure that a question is about, as it was found, in other poses. rng: of poses. Raises
    SceneError.
    """

    def __init__(self, worker: FailureWorker[Any], name: str) -> None:
        seed = worker.config.seed
        self.objective, theta = worker.run.rebuilt(worker.attacker, name)
        self.rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
        self._change = self.objective.space.change(theta)
        self._nuisances, self._stream = worker.attacker.grader.nuisances, f"{worker.question}:{name}:{seed}"

    def bounds(self, reach: float) -> Floats:
        """Lowest and highest angles (3, 2), degrees, within `reach` rad of the pose that was found."""
        angles = self._change.angles
        found = np.zeros(3) if angles is None else np.degrees(angles.numpy().astype(float))
        return np.stack([found - math.degrees(reach), found + math.degrees(reach)], axis=1)

    @torch.no_grad()
    def picture(self, degrees: Floats, number: int) -> Tensor:
        """The picture (3, H, W) in a pose (3,), in the draw of that number."""
        change = replace(self._change, angles=torch.from_numpy(np.radians(degrees)).float())
        picture = round_to_8bit(self.objective.scene.picture(change))
        draw = self._nuisances.sample_for_image(self._stream, number, (SEEN_PX, SEEN_PX))
        return draw.degrade_image(picture)

    def called(self, degrees: Floats, first: int = 0) -> NDArray[np.int64]:
        """The classes (N,) that poses (N, 3) are called, in draws from the first on."""
        pictures = (self.picture(one, number) for number, one in enumerate(degrees, first))
        return np.array([self.objective.look(picture).predicted for picture in pictures], np.int64)


def _as_seen(where: Intervals, view: str) -> dict[str, tuple[float, float]]:
    """A rule with the view's own turn in it."""
    turn = dict(zip(AXES, (*np.degrees(VIEWS[view]).tolist(), 0.0), strict=True))
    return {axis: (round(low + turn[axis], 2), round(high + turn[axis], 2)) for axis, (low, high) in where.items()}


def holes_run(config: ClassifyConfig) -> AnalysisReport:
    """Look around a run's failures, or go on with it. Raises UsageError or SceneError."""
    asked = ask_of_failures(config, HoleWorker, "looking around failures")
    ordered = sorted(asked.answers, key=lambda hole: (-hole.interval[0], hole.identifier))
    rows = [
        asdict(hole)
        | {"probability": hole.fails / hole.count, "interval": list(hole.interval), "sentence": hole.sentence()}
        for hole in ordered
    ]
    lines = tuple(
        (
            hole.sentence(),
            "-" if not hole.count_outside else f"{100 * hole.fails_outside / hole.count_outside:.0f}",
            f"{100 * hole.fails_all / hole.count_all:.0f}",
        )
        for hole in ordered
    )
    title = f"Holes of {asked.run.config.network}, by pose"
    answer = AnalysisReport(
        out=asked.out,
        name="holes",
        heading="Holes by pose",
        data={**asked.facts, "holes": rows},
        csv_tables={"holes": [_flat(row) for row in rows]} if rows else {},
        tables=[ReportTable(title, ("where", "elsewhere, %", "of all near, %"), lines)],
        notes=_NOTES,
        failed={f"picture {name}": reason for name, reason in asked.failed.items()},
    )
    answer.write()
    return answer


def _flat(row: Mapping[str, Any]) -> dict[str, Any]:
    told = {key: row[key] for key in ("identifier", "label", "predicted", "probability", "fails", "count")}
    for axis in AXES:
        told[f"{axis}_low"], told[f"{axis}_high"] = row["where"].get(axis, (None, None))
    return {**told, "fails_outside": row["fails_outside"], "count_outside": row["count_outside"]}
