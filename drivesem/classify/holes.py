"""`drivesem classify holes`: the poses around each failure in which the object is misclassified.

Samples, rules and intervals are those of the failure regions of detectors. The features are the angles themselves,
so fresh samples are drawn inside a rule directly.
"""

from __future__ import annotations

import math
import zlib
from collections import Counter
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from drivesem.classify.analysis import FailureAnalyser, analyse_failures
from drivesem.classify.scenes import SEEN_PX, VIEWS
from drivesem.config.commands import ClassifyConfig
from drivesem.evaluation.resampling import wilson
from drivesem.failures.rules import Floats, Intervals, fit_rule, rates_differ
from drivesem.reporting.tables import AnalysisReport, ReportTable
from scene_ir.io import round_to_8bit

AXES: tuple[str, ...] = ("pitch", "yaw", "roll")
_NOTES = (
    "Where: pitch, yaw and roll of the object in degrees, including the view's own angles (top: pitch 20; left and "
    "right: yaw 29 and -29), with the shape and light of the failure. Misclassified: share of fresh samples "
    "inside the rule, each evaluated once, with nuisances, and Wilson's 95 % interval. Elsewhere: the same for "
    "samples outside of it, within --reach of the failure's pose.",
)


@dataclass(frozen=True, slots=True)
class PoseFailureRegion:
    """The poses around one failure in which the object is misclassified."""

    identifier: str
    """The picture."""
    source: str
    """Digest of its result in the run."""
    label: str
    """True class."""
    predicted: str
    """Class that is predicted most often in the region."""
    where: dict[str, tuple[float, float]]
    """Intervals by axis, degrees; empty if no angle separates failures."""
    fails: int
    """Failures among fresh samples inside."""
    count: int
    """Fresh samples inside."""
    fails_outside: int
    """Failures among samples outside."""
    count_outside: int
    """Samples outside."""
    fails_all: int
    """Failures in the whole neighbourhood."""
    count_all: int
    """Samples in the whole neighbourhood."""
    passes: int
    """Passes of the network."""

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the failure rate inside."""
        return wilson(self.fails, self.count)

    def sentence(self) -> str:
        """Describe the region."""
        intervals = [f"{axis} from {low:.0f} to {high:.0f} degrees" for axis, (low, high) in self.where.items()]
        low, high = self.interval
        rate = f"{100 * self.fails / self.count:.0f} % [{100 * low:.0f}, {100 * high:.0f}]"
        place = " and ".join(intervals) or "any angle near"
        error = f"The {self.label} of {self.identifier} is misclassified, mostly as {self.predicted}"
        if self.where and not rates_differ((self.fails, self.count), (self.fails_outside, self.count_outside)):
            low, high = wilson(self.fails_all, self.count_all)
            return f"{error}; no rule found: in {100 * low:.0f} to {100 * high:.0f} % of all poses near"
        return f"{error}, in {rate} of poses with {place}"

    def to_json(self) -> dict[str, Any]:
        """The region with its failure rate and description."""
        rate = {"probability": self.fails / self.count, "interval": list(self.interval)}
        return {**asdict(self), **rate, "sentence": self.sentence()}

    def to_table_row(self) -> tuple[str, ...]:
        """The row of the table."""
        outside = f"{100 * self.fails_outside / self.count_outside:.0f}" if self.count_outside else "-"
        return self.sentence(), outside, f"{100 * self.fails_all / self.count_all:.0f}"

    def to_csv_row(self) -> dict[str, Any]:
        """The row of the CSV file."""
        data = self.to_json()
        row = {key: data[key] for key in ("identifier", "label", "predicted", "probability", "fails", "count")}
        for axis in AXES:
            row[f"{axis}_low"], row[f"{axis}_high"] = self.where.get(axis, (None, None))
        return {**row, "fails_outside": self.fails_outside, "count_outside": self.count_outside}


class PoseRegionAnalyser(FailureAnalyser[PoseFailureRegion]):
    """Samples poses around a failure and fits a rule to those that fail."""

    command, file, kind = "holes", "hole.json", PoseFailureRegion

    def analyse(self, name: str, folder: Path) -> PoseFailureRegion:
        """See `FrameAnalyser.analyse`."""
        sampler, config = PoseSampler(self, name), self.config
        label, bounds = sampler.objective.scene.model.label, sampler.bounds(config.reach)
        poses = sampler.rng.uniform(bounds[:, 0], bounds[:, 1], (config.samples, 3))
        fails = sampler.classify_poses(poses) != label
        rule = fit_rule({axis: poses[:, i] for i, axis in enumerate(AXES)}, fails)
        for axis, interval in rule.intervals.items():
            bounds[AXES.index(axis)] = interval
        fresh = sampler.rng.uniform(bounds[:, 0], bounds[:, 1], (config.fresh, 3))
        predicted = sampler.classify_poses(fresh, config.samples)
        wrong = predicted[predicted != label].tolist()
        result, classes = self.run.results[name], self.attacker.network.classes
        return PoseFailureRegion(
            identifier=name,
            source=self.source_digest(name),
            label=result.label,
            predicted=classes[Counter(wrong).most_common(1)[0][0]] if wrong else result.attacked.predicted,
            where=_add_view_angles(rule.intervals, result.view),
            fails=len(wrong),
            count=len(predicted),
            fails_outside=rule.failures_outside,
            count_outside=rule.count_outside,
            fails_all=int(fails.sum()),
            count_all=len(fails),
            passes=sampler.objective.passes,
        )


class PoseSampler:
    """Renders the object of a failure in other poses, with nuisances."""

    def __init__(self, analyser: FailureAnalyser[Any], name: str) -> None:
        """
        Args:
            analyser: The analysis; its settings seed the samples.
            name: The failure.

        Raises:
            SceneError: An object that cannot be used.
        """
        seed = analyser.config.seed
        self.objective, theta = analyser.run.load_objective(analyser.attacker, name)
        self.rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
        """Generator of poses."""
        self._change = self.objective.space.change(theta)
        self._nuisances, self._stream = analyser.attacker.grader.nuisances, f"{analyser.command}:{name}:{seed}"

    def bounds(self, reach: float) -> Floats:
        """Lowest and highest angles (3, 2), degrees, within `reach` rad of the failure's pose."""
        angles = self._change.angles
        pose = np.zeros(3) if angles is None else np.degrees(angles.numpy().astype(float))
        return np.stack([pose - math.degrees(reach), pose + math.degrees(reach)], axis=1)

    @torch.no_grad()
    def render_sample(self, degrees: Floats, number: int) -> Tensor:
        """Render a pose (3,) with the nuisances of the sample of that number (3, H, W)."""
        change = replace(self._change, angles=torch.from_numpy(np.radians(degrees)).float())
        picture = round_to_8bit(self.objective.scene.render(change))
        return self._nuisances.sample_for_image(self._stream, number, (SEEN_PX, SEEN_PX)).degrade_image(picture)

    def classify_poses(self, degrees: Floats, first: int = 0) -> NDArray[np.int64]:
        """Predict the classes (N,) of poses (N, 3), with samples from number `first` on."""
        pictures = (self.render_sample(one, number) for number, one in enumerate(degrees, first))
        return np.array([self.objective.classify(picture).predicted for picture in pictures], np.int64)


def _add_view_angles(where: Intervals, view: str) -> dict[str, tuple[float, float]]:
    angles = dict(zip(AXES, (*np.degrees(VIEWS[view]).tolist(), 0.0), strict=True))
    return {
        axis: (round(low + angles[axis], 2), round(high + angles[axis], 2)) for axis, (low, high) in where.items()
    }


def find_pose_regions(config: ClassifyConfig) -> AnalysisReport:
    """Find the failure regions of a run by pose. Raises UsageError or SceneError."""
    analysis = analyse_failures(config, PoseRegionAnalyser, "sampling around failures")
    regions = sorted(analysis.results, key=lambda region: (-region.interval[0], region.identifier))
    title = f"Failure regions of {analysis.run.config.network}, by pose"
    rows = tuple(region.to_table_row() for region in regions)
    return analysis.write_report(
        "holes",
        "Failure regions by pose",
        {"holes": [region.to_json() for region in regions]},
        [region.to_csv_row() for region in regions],
        ReportTable(title, ("where", "elsewhere, %", "of all near, %"), rows),
        _NOTES,
    )
