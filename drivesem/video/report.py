"""What is said of a clip: a table of its cars, and what its columns mean."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich import box

from drivesem.report.answer import Answer
from drivesem.report.tables import Sheet, number_of
from drivesem.video.results import CarResult, DriveResult

WORDS = ("car",)
NOTES = (
    "lost: frames in which the detector misses the car, of those in which it is judged; before: in the clip as it "
    "was, after: with the change, random: with a random change as large.",
    "longest: frames of the longest unbroken stretch of misses after it. unseen: metres by which the camera comes "
    "nearer to the car while it is missed, of the metres while it is judged.",
    "certain: of the frames in which it is newly missed and that were looked at again in draws, those in which "
    "it is missed for certain (docs/grades.md).",
)
_LOOKS: dict[str, Any] = {
    "unbroken": (*WORDS, "longest", "certain"),
    "box": box.SIMPLE_HEAD,
    "padding": 0,
    "show_edge": False,
}
"""Narrow enough for 80 columns."""


def answer_of(result: DriveResult) -> Answer:
    """The answer, in the result's folder."""
    title = f"{result.detector} on {result.clip}: {' + '.join(result.params)}, {result.method}"
    rows = [row_of(car) for car in result.cars]
    sheet = Sheet(title, tuple(rows[0]), tuple(tuple(row.values()) for row in rows), _LOOKS)
    return Answer(
        out=Path(result.out),
        name="drive",
        heading=f"{number_of(result.frames, 'frame')} of {result.clip}",
        data=asdict(result),
        tables={"drive": [figures(car) for car in result.cars]},
        sheets=[sheet],
        notes=[*NOTES, summary(result), *unfeasible(result)],
        words=WORDS,
        failed={f"frame {name}": reason for name, reason in result.failed.items()},
    )


def row_of(car: CarResult) -> dict[str, str]:
    """A car's line of the table."""
    return {
        "car": f"{car.track} {car.kind}",
        "lost before": f"{car.lost_before}",
        "lost after": f"{car.lost_after}",
        "lost random": f"{car.lost_control}",
        "of": f"{car.frames}",
        "longest": f"{car.longest_after}",
        "unseen before": f"{car.metres_lost_before:.1f}",
        "unseen after": f"{car.metres_lost_after:.1f}",
        "unseen random": f"{car.metres_lost_control:.1f}",
        "of m": f"{car.metres:.1f}",
        "certain": f"{car.certain}/{car.graded}" if car.graded else "-",
    }


def summary(result: DriveResult) -> str:
    """The clip in a line."""
    before, after, control = (
        sum(getattr(car, f"lost_{state}") for car in result.cars) for state in ("before", "after", "control")
    )
    sights = number_of(sum(car.frames for car in result.cars), "sight")
    phantoms, frames = number_of(result.phantoms["after"], "phantom"), number_of(result.frames, "frame")
    queries, passes = number_of(result.queries, "query", "queries"), number_of(result.passes, "pass", "passes")
    return (
        f"{after} of {sights} of {number_of(len(result.cars), 'car')} missed ({before} before, {control} by a "
        f"random change), {phantoms} ({result.phantoms['control']} random); "
        f"feasible in {result.feasible} of {frames}; {queries}, {passes}, {result.seconds:.0f} s"
    )


def unfeasible(result: DriveResult) -> list[str]:
    """Frames in which the change is not feasible."""
    return [f"not feasible in frame {name}: {'; '.join(lines)}" for name, lines in result.violations.items()]


def figures(car: CarResult) -> dict[str, Any]:
    """A car's numbers by name, without what there is of each frame."""
    return {name: value for name, value in asdict(car).items() if name not in ("states", "distance_m", "path_m")}
