"""What the page is made of, before it is HTML: runs with their figures, and curves. Nothing here reads a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from drivesem.run.report.grading import GradesAsked
from drivesem.run.results import FrameResult, RunSummary

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class PaperFigure:
    """The paper's mAP for the same parameters, fractions of 1: before the change and after it."""

    before: float
    after: float


@dataclass(frozen=True, slots=True)
class ShownRun:
    """One run of the page. name: unique among them; folder: holds `frames/<name>/`; frames: of all runs the same,
    in one order; summary: of these frames; method: the attack's name; command: what repeats the run; weathers: by
    frame, of data sets that say it; asked: how sure its failures had to be; paper: where the run keeps to the
    paper's protocol, and the paper has the same parameters.
    """

    name: str
    folder: Path
    summary: RunSummary
    frames: tuple[FrameResult, ...]
    method: str
    command: str
    weathers: tuple[str | None, ...]
    asked: GradesAsked
    paper: PaperFigure | None = None


@dataclass(frozen=True, slots=True)
class Line:
    """A curve. points: (x, y) by ascending x; mark: a point to be singled out; band: (x, low, high); steps: y
    stays until the next point.
    """

    name: str
    points: tuple[Point, ...]
    mark: Point | None = None
    band: tuple[tuple[float, float, float], ...] = ()
    steps: bool = False


@dataclass(frozen=True, slots=True)
class Chart:
    """Curves on one pair of axes, y from 0 to 100. doubling: x is on a scale on which each tick is twice the last;
    note: what the lines and marks mean.
    """

    title: str
    x_label: str
    y_label: str
    lines: Sequence[Line]
    note: str
    x_range: Point = (0.0, 100.0)
    doubling: bool = False


@dataclass(frozen=True, slots=True)
class Page:
    """A page. runs: at least one; charts: beside the figures; gallery: frames whose pictures are shown, worst
    first; left_out: frames that not every run has.
    """

    runs: Sequence[ShownRun]
    charts: Sequence[Chart]
    gallery: int
    left_out: int = 0
