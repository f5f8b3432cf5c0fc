"""The page of a clip: a slider over its frames, before and after, and strips of when each car is missed."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from urllib.parse import quote

from markupsafe import Markup

from drivesem.report import web
from drivesem.report.tables import number_of
from drivesem.run.folder import FRAMES
from drivesem.video.report import NOTES, row_of, summary, unfeasible
from drivesem.video.results import ABSENT, FOUND, LOST, UNCOUNTED, DriveResult
from scene_ir import files

_CLASSES = {FOUND: "f", LOST: "l", UNCOUNTED: "u"}


def write_page(path: Path, result: DriveResult) -> None:
    """Write the page, which shows the pictures and the video beside it. Atomic."""
    pictures = [
        {"name": name} | {side: quote(f"{FRAMES}/{name}/{side}.jpg") for side in ("before", "after")}
        for name in result.names
    ]
    rows = [row_of(car) for car in result.cars]
    text = web.render(
        "drivesem.video:page.html",
        "drivesem.video:page.js",
        runs=_runs,
        data=Markup(json.dumps(pictures).replace("<", "\\u003c")),
        title=f"{result.detector} on {result.clip}",
        headline=_headline(result),
        lead=_lead(result),
        tiles=_tiles(result),
        pictures=pictures,
        columns=list(rows[0]),
        rows=[list(row.values()) for row in rows],
        notes=(*NOTES, summary(result), *unfeasible(result)),
        result=result,
    )
    files.write_text(path, text)


def _runs(states: str) -> Iterator[tuple[int, int, str]]:
    """Stretches of frames of one kind: where each begins, how long it is, its class; none where the car is not."""
    start = 0
    for state, group in groupby(states):
        length = len(list(group))
        if state != ABSENT:
            yield start, length, _CLASSES[state]
        start += length


def _headline(result: DriveResult) -> str:
    worst = result.cars[0]
    if worst.newly <= 0:
        return f"{result.detector} misses no car of {result.clip} for longer than before"
    return (
        f"{result.detector} misses car {worst.track} in {worst.lost_after} of {number_of(worst.frames, 'frame')}, "
        f"{worst.lost_before} before"
    )


def _lead(result: DriveResult) -> str:
    return (
        f"{' + '.join(result.params)} changed by {result.method}: each of {number_of(len(result.cars), 'car')} "
        f"by the same over all of {number_of(result.frames, 'frame')}. Beside it, a random change as large."
    )


def _tiles(result: DriveResult) -> list[dict[str, str]]:
    cars = result.cars
    lost, before, control, counted = (
        sum(getattr(car, name) for car in cars) for name in ("lost_after", "lost_before", "lost_control", "frames")
    )
    unseen = max(cars, key=lambda car: car.metres_lost_after)
    longest = max(cars, key=lambda car: car.longest_after)
    graded, certain = sum(car.graded for car in cars), sum(car.certain for car in cars)
    return [
        {
            "title": "sights of cars that are missed",
            "figure": f"{before} → {lost}",
            "more": f"of {counted}; by a random change {control}",
        },
        {
            "title": "longest unbroken stretch",
            "figure": f"{longest.longest_after / 10:.1f} s",
            "more": f"car {longest.track}; {longest.longest_before / 10:.1f} s before",
        },
        {
            "title": "most metres of approach unseen",
            "figure": f"{unseen.metres_lost_after:.1f} m",
            "more": f"car {unseen.track}, of {unseen.metres:.1f} m; {unseen.metres_lost_before:.1f} m before",
        },
        {
            "title": "new misses that are certain",
            "figure": f"{certain} of {graded}" if graded else "none",
            "more": "in frames that were looked at again in draws",
        },
        {
            "title": "feasible",
            "figure": f"{result.feasible} of {result.frames}",
            "more": "frames, by the independent check",
        },
    ]
