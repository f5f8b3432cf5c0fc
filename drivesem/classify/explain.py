"""`drivesem classify explain`: the smallest part of each change that is still misclassified."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import torch
from rich import box
from torch import Tensor

from drivesem.analysis.explain.attribution import MinimalChangeSearch, ThetaBlock, find_minimal_change
from drivesem.classify.analysis import FailureAnalyser, analyse_failures
from drivesem.classify.space import AXES, ClassifyParameter, ObjectSpace
from drivesem.config.commands import ClassifyConfig
from drivesem.reporting.tables import AnalysisReport, ReportTable, format_count
from scene_ir import files
from scene_ir.errors import RangeError
from scene_ir.io import to_uint8

_POINTS = 16
"""Points of the grid of scales, as for detectors."""
TEXT_COLUMNS = ("picture", "predicted", "left out")
"""Columns of text; the others hold numbers."""
_MAX_UNBROKEN = 24
"""Longest name that stays on one line, so that the table fits into 80 columns; ShapeNet's hashes are longer."""
_NOTES = (
    "Enough: size of the smallest misclassified part of the change, as a share of the whole in steps of the attack. "
    "Angles in rad, relative to the view; a dash marks an angle that is not needed. Vertex: largest distance of a "
    "vertex, in object sizes. Left out: parts that are not needed. Failures between two of 16 shares are missed.",
)


@dataclass(frozen=True, slots=True)
class MinimalObjectChange:
    """The smallest sufficient part of one change."""

    identifier: str
    """The picture."""
    source: str
    """Digest of its result in the run."""
    label: str
    """True class."""
    predicted: str
    """Class predicted for the smallest change."""
    share: float
    """Size of the smallest change relative to the whole, in [0, 1]."""
    angles: dict[str, float]
    """Angles of the smallest change by axis, rad."""
    found: dict[str, float]
    """Angles of the whole change by axis, rad."""
    vertex: float
    """Largest distance of a vertex in the smallest change, in object sizes."""
    light: float
    """Largest change of the light in the smallest change, as a fraction."""
    dropped: tuple[str, ...]
    """Parts that are not needed."""
    sign_changes: int
    """Changes between failing and not failing on the way to the whole change."""
    passes: int
    """Passes of the network."""

    def sentence(self) -> str:
        """Describe the smallest change."""
        changes = [f"{name.partition('.')[2]} {value:+.3f} rad" for name, value in self.angles.items() if value]
        changes += [f"vertices by {self.vertex:.4f}"] if self.vertex else []
        changes += [f"light by {self.light:.2f}"] if self.light else []
        return f"{self.identifier} is classified as {self.predicted} with {', '.join(changes)}"

    def to_table_row(self) -> tuple[str, ...]:
        """The row of the table."""
        dropped = ", ".join(name.removeprefix("pose.") for name in self.dropped)
        angles = [f"{self.angles[axis]:+.3f}" if self.angles.get(axis) else "-" for axis in AXES]
        return (
            *(self.identifier, self.predicted, f"{100 * self.share:.0f}", *angles),
            *(f"{self.vertex:.4f}" if self.vertex else "-", dropped or "-"),
        )

    def to_csv_row(self) -> dict[str, object]:
        """The row of the CSV file."""
        return {
            **{key: getattr(self, key) for key in ("identifier", "label", "predicted", "share")},
            **{axis: self.angles.get(axis) for axis in AXES},
            **{f"found_{axis}": self.found.get(axis) for axis in AXES},
            **{key: getattr(self, key) for key in ("vertex", "light", "sign_changes")},
        }


class MinimalObjectChangeAnalyser(FailureAnalyser[MinimalObjectChange]):
    """Finds the smallest sufficient part of each change."""

    command, file, kind = "explain", "least.json", MinimalObjectChange

    def analyse(self, name: str, folder: Path) -> MinimalObjectChange:
        """See `FrameAnalyser.analyse`."""
        objective, theta = self.run.load_objective(self.attacker, name)
        space, problem = objective.space, objective.problem()

        def fails(theta: Tensor) -> bool:
            return not objective.evaluate(theta).correct

        search = MinimalChangeSearch(
            project=lambda theta: problem.project(theta).theta,
            occurs=fails,
            fails=fails,
            size=lambda theta: float(problem.size(theta)),
            points=_POINTS,
        )
        try:
            minimal = find_minimal_change(theta, theta_blocks(space), search)
        except RangeError as error:  # this machine evaluates the picture differently
            raise RangeError(f"{name}: {error.field}", error.expected, error.actual) from error
        files.write_png(folder / "least.png", to_uint8(objective.render(minimal.theta)))
        largest = space.max_changes(minimal.theta)
        return MinimalObjectChange(
            identifier=name,
            source=self.source_digest(name),
            label=self.run.results[name].label,
            predicted=self.attacker.network.classes[objective.evaluate(minimal.theta).predicted],
            share=round(search.size(minimal.theta) / search.size(theta), 6),
            angles=_angles_by_axis(space, minimal.theta),
            found=_angles_by_axis(space, theta),
            vertex=largest.get(ClassifyParameter.VERTEX, 0.0),
            light=largest.get(ClassifyParameter.LIGHTING, 0.0),
            dropped=minimal.dropped,
            sign_changes=minimal.sign_changes,
            passes=objective.passes,
        )


def theta_blocks(space: ObjectSpace) -> list[ThetaBlock]:
    """Parts to leave out, in this order: parameters, vertices first; then coordinates of pose and light."""
    parts = {str(parameter): where for parameter, where in space.blocks.items()}
    parts |= {space.name(i): slice(i, i + 1) for i in space.scalar_coordinates}
    index = torch.arange(space.dim)
    return [ThetaBlock(name, (index >= where.start) & (index < where.stop)) for name, where in parts.items()]


def _angles_by_axis(space: ObjectSpace, theta: Tensor) -> dict[str, float]:
    angles = space.change(theta).angles
    return {} if angles is None else dict(zip(AXES, (round(a, 6) for a in angles.tolist()), strict=True))


def explain_failures(config: ClassifyConfig) -> AnalysisReport:
    """Find the smallest sufficient part of each change of a run. Raises UsageError or SceneError."""
    analysis = analyse_failures(config, MinimalObjectChangeAnalyser, "explaining failures")
    changes = analysis.results
    middle = median(one.share for one in changes) if changes else math.nan
    return analysis.write_report(
        "explain",
        "Smallest sufficient changes",
        {
            "share_median": round(middle, 4) if changes else None,
            "least": [asdict(one) | {"sentence": one.sentence()} for one in changes],
        },
        [one.to_csv_row() for one in changes],
        build_table(changes, analysis.run.config.network),
        (*_NOTES, f"In the median, {100 * middle:.0f} % of the change are enough."),
        TEXT_COLUMNS,
    )


def build_table(changes: Sequence[MinimalObjectChange], network: str) -> ReportTable:
    """Build the table of a network's failures."""
    columns = ("picture", "predicted", "enough\n%", "pitch\nrad", "yaw\nrad", "roll\nrad", "vertex", "left out")
    title = f"Smallest sufficient changes: {format_count(len(changes), 'failure')} of {network}"
    short = all(len(one.identifier) <= _MAX_UNBROKEN for one in changes)
    unbroken = columns[0 if short else 1 : -1]
    options = {"box": box.SIMPLE_HEAD, "padding": 0, "show_edge": False, "unbroken": unbroken}
    return ReportTable(title, columns, tuple(one.to_table_row() for one in changes), options)
