"""`drivesem classify explain`: how little of a change is enough, by the search that does so for detectors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import torch
from rich import box
from torch import Tensor

from drivesem.analysis.explain.minimal import MinimalChangeSearch, ThetaBlock, find_minimal_change
from drivesem.classify.finished import FailureWorker, ask_of_failures
from drivesem.classify.space import AXES, Moved, ObjectSpace
from drivesem.config.commands import ClassifyConfig
from drivesem.report.tables import AnalysisReport, ReportTable, format_count
from scene_ir import files
from scene_ir.errors import RangeError
from scene_ir.io import to_uint8

_POINTS = 16
"""Of the grid of scales, as for detectors."""
WORDS = ("picture", "called", "left out")
"""Columns of words; the others hold numbers."""
_LONGEST = 24
"""Letters of a name that stays on one line: all fits into 80 columns then. ShapeNet's hashes are longer."""
_NOTES = (
    "Enough: the share of the change, in steps of the attack, of the least that is still misclassified. Angles in "
    "rad, beyond the view; a dash where the angle is not needed. Vertex: the farthest goes so far, in object "
    "sizes. Left out: what went without a loss. What fails only between two of 16 shares is not seen.",
)


@dataclass(frozen=True, slots=True)
class LeastChange:
    """One failure. source: digest of the run's result. share: of the change's size that is enough; angles, found:
    rad by axis, of the least change and of the whole one; vertex, light: the largest of each in the least change;
    dropped: what was left out; predicted: the class that it is called then; sign_changes: how often failing
    begins or ends on the way to the whole change.
    """

    identifier: str
    source: str
    label: str
    predicted: str
    share: float
    angles: dict[str, float]
    found: dict[str, float]
    vertex: float
    light: float
    dropped: tuple[str, ...]
    sign_changes: int
    passes: int

    def sentence(self) -> str:
        """For people."""
        turns = [f"{name.partition('.')[2]} {value:+.3f} rad" for name, value in self.angles.items() if value]
        turns += [f"vertices by {self.vertex:.4f}"] if self.vertex else []
        turns += [f"light by {self.light:.2f}"] if self.light else []
        return f"{self.identifier} is called {self.predicted} with {', '.join(turns)}"

    def row(self) -> tuple[str, ...]:
        """A line of the table."""
        dropped = ", ".join(name.removeprefix("pose.") for name in self.dropped)
        told = [f"{self.angles[axis]:+.3f}" if self.angles.get(axis) else "-" for axis in AXES]
        return (
            *(self.identifier, self.predicted, f"{100 * self.share:.0f}", *told),
            *(f"{self.vertex:.4f}" if self.vertex else "-", dropped or "-"),
        )


class LeastWorker(FailureWorker[LeastChange]):
    """Takes the change of a failure back."""

    question, file, kind = "explain", "least.json", LeastChange

    def analyse(self, name: str, source: str, folder: Path) -> LeastChange:
        """See `FailureWorker`."""
        objective, theta = self.run.rebuilt(self.attacker, name)
        space, problem = objective.space, objective.problem()
        search = MinimalChangeSearch(
            project=lambda wanted: problem.project(wanted).theta,
            fails=lambda wanted: not objective.see(wanted).right,
            size=lambda wanted: float(problem.size(wanted)),
            points=_POINTS,
        )
        try:
            found = find_minimal_change(theta, blocks(space), search)
        except RangeError as error:  # judged otherwise on this machine
            raise RangeError(f"{name}: {error.field}", error.expected, error.actual) from error
        files.write_png(folder / "least.png", to_uint8(objective.picture(found.theta)))
        return LeastChange(
            identifier=name,
            source=source,
            label=self.run.frames[name].label,
            predicted=self.attacker.network.classes[objective.see(found.theta).predicted],
            share=round(search.size(found.theta) / search.size(theta), 6),
            angles=_angles(space, found.theta),
            found=_angles(space, theta),
            vertex=space.sizes(found.theta).get(Moved.VERTEX, 0.0),
            light=space.sizes(found.theta).get(Moved.LIGHTING, 0.0),
            dropped=found.dropped,
            sign_changes=found.sign_changes,
            passes=objective.passes,
        )


def blocks(space: ObjectSpace) -> list[ThetaBlock]:
    """What to try to leave out: each parameter, the vertices first, then each coordinate of pose and light."""
    parts = {str(parameter): where for parameter, where in space.blocks.items()}
    parts |= {space.name(i): slice(i, i + 1) for i in space.singles}
    place = torch.arange(space.dim)
    return [ThetaBlock(name, (place >= where.start) & (place < where.stop)) for name, where in parts.items()]


def _angles(space: ObjectSpace, theta: Tensor) -> dict[str, float]:
    pose = space.block(theta, Moved.POSE)
    return {} if pose is None else dict(zip(AXES, (round(a, 6) for a in pose.tolist()), strict=True))


def explain_run(config: ClassifyConfig) -> AnalysisReport:
    """Find the least change of a run's failures, or go on with it. Raises UsageError or SceneError."""
    asked = ask_of_failures(config, LeastWorker, "shortening changes")
    found = asked.answers
    middle = median(one.share for one in found) if found else math.nan
    rows = [asdict(one) | {"sentence": one.sentence()} for one in found]
    flat = [
        {"identifier": one.identifier, "label": one.label, "predicted": one.predicted, "share": one.share}
        | {axis: one.angles.get(axis) for axis in AXES}
        | {f"found_{axis}": one.found.get(axis) for axis in AXES}
        | {"vertex": one.vertex, "light": one.light, "sign_changes": one.sign_changes}
        for one in found
    ]
    answer = AnalysisReport(
        out=asked.out,
        name="explain",
        heading="How little is enough",
        data={**asked.facts, "share_median": round(middle, 4) if found else None, "least": rows},
        csv_tables={"explain": flat} if found else {},
        tables=[sheet_of(found, asked.run.config.network)],
        notes=(*_NOTES, f"In the median {100 * middle:.0f} % of the change are enough."),
        text_columns=WORDS,
        failed={f"picture {name}": reason for name, reason in asked.failed.items()},
    )
    answer.write()
    return answer


def sheet_of(found: Sequence[LeastChange], network: str) -> ReportTable:
    """The table of a network's failures."""
    columns = ("picture", "called", "enough\n%", "pitch\nrad", "yaw\nrad", "roll\nrad", "vertex", "left out")
    title = f"How little is enough: {format_count(len(found), 'failure')} of {network}"
    short = all(len(one.identifier) <= _LONGEST for one in found)
    unbroken = columns[0 if short else 1 : -1]
    looks = {"box": box.SIMPLE_HEAD, "padding": 0, "show_edge": False, "unbroken": unbroken}
    return ReportTable(title, columns, tuple(one.row() for one in found), looks)
