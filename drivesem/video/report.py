"""Results of a clip, object by object, and their report: a table, an HTML page with a slider, and a video."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

import cv2
import numpy as np
from markupsafe import Markup
from rich import box

from drivesem.data.classes import PEOPLE
from drivesem.reporting import web
from drivesem.reporting.tables import AnalysisReport, ReportTable, format_count
from drivesem.run.folder import FRAMES
from scene_ir import files
from scene_ir.errors import WriteError
from scene_ir.raster.launch import suppress_stderr

FOUND, LOST, UNCOUNTED, ABSENT = "f", "l", "-", " "
"""State of an object in one frame: detected; missed; too small, hidden or truncated to count; absent."""
State = Literal["before", "after", "control"]
STATES: tuple[State, ...] = ("before", "after", "control")
"""The original clip, the attacked one, and one with a random change of the same size."""


@dataclass(frozen=True, slots=True)
class MissedInterval:
    """How long an object is missed in a clip."""

    frames: int
    """Frames in which it counts."""
    lost: int
    """Of these, frames in which it is missed."""
    longest: int
    """Frames of the longest unbroken run of misses."""
    metres: float
    """Approach of the camera while it counts, m."""
    metres_lost: float
    """Approach of the camera while it is missed, m."""

    @classmethod
    def from_states(cls, states: str, distance_m: Sequence[float | None]) -> MissedInterval:
        """Measure from one state per frame, and the distances from the camera, None where absent."""
        nearer = [0.0]
        for before, now in pairwise(distance_m):
            nearer.append(0.0 if before is None or now is None else max(before - now, 0.0))
        counted = [state in (FOUND, LOST) for state in states]
        longest = run = 0
        for state in states:
            run = run + 1 if state == LOST else 0
            longest = max(longest, run)
        return cls(
            frames=sum(counted),
            lost=states.count(LOST),
            longest=longest,
            metres=_metres(distance for distance, counts in zip(nearer, counted, strict=True) if counts),
            metres_lost=_metres(distance for distance, state in zip(nearer, states, strict=True) if state == LOST),
        )


def _metres(distances: Iterable[float]) -> float:
    return round(sum(distances, 0.0), 3)


@dataclass(frozen=True, slots=True)
class TrackResult:
    """Result of one object; see `MissedInterval` for lost, longest and metres, and `STATES` for their suffixes."""

    track: int
    """Its number in the data."""
    kind: str
    """Its class."""
    frames: int
    """Frames of the attacked clip in which it counts."""
    lost_before: int
    """Missed frames of the original clip."""
    lost_after: int
    """Missed frames of the attacked clip."""
    lost_control: int
    """Missed frames with the random change."""
    longest_before: int
    """Longest run of misses in the original clip, frames."""
    longest_after: int
    """Longest run of misses in the attacked clip, frames."""
    longest_control: int
    """Longest run of misses with the random change, frames."""
    metres: float
    """Approach of the camera while the object counts, m."""
    metres_lost_before: float
    """Approach while it is missed in the original clip, m."""
    metres_lost_after: float
    """Approach while it is missed in the attacked clip, m."""
    metres_lost_control: float
    """Approach while it is missed with the random change, m."""
    graded: int
    """Graded frames with a new miss."""
    certain: int
    """Of these, frames in which the miss is certain."""
    states: dict[str, str]
    """One letter per frame, by `STATES`."""
    distance_m: tuple[float | None, ...]
    """Distance from the camera in each frame."""
    path_m: tuple[tuple[float, float] | None, ...]
    """Offset from its place along and across its heading in each frame."""

    @classmethod
    def from_states(
        cls,
        track: int,
        kind: str,
        states: dict[str, str],
        distance_m: tuple[float | None, ...],
        path_m: tuple[tuple[float, float] | None, ...],
        certain: Sequence[bool],
    ) -> TrackResult:
        """Measure an object.

        Args:
            track: Its number in the data.
            kind: Its class.
            states: One letter per frame, by `STATES`.
            distance_m: Distance from the camera in each frame.
            path_m: Offset along and across its heading in each frame.
            certain: Whether the miss is certain, for each graded frame.
        """
        missed = {state: MissedInterval.from_states(letters, distance_m) for state, letters in states.items()}
        metrics = {
            f"{name}_{state}": getattr(one, name)
            for state, one in missed.items()
            for name in ("lost", "longest", "metres_lost")
        }
        return cls(
            track=track,
            kind=kind,
            frames=missed["after"].frames,
            metres=missed["after"].metres,
            graded=len(certain),
            certain=sum(certain),
            states=states,
            distance_m=distance_m,
            path_m=path_m,
            **metrics,
        )

    @property
    def new_misses(self) -> int:
        """Increase of missed frames over the original clip."""
        return self.lost_after - self.lost_before


@dataclass(frozen=True, slots=True)
class DriveResult:
    """Result of an attack on a clip."""

    out: str
    """Folder of the result."""
    clip: str
    """Name of the clip."""
    detector: str
    """The detector."""
    t_star: float
    """Its score threshold."""
    params: tuple[str, ...]
    """Attacked parameters."""
    method: str
    """Search method."""
    frames: int
    """Number of frames."""
    names: tuple[str, ...]
    """Names of the frames."""
    tracks: tuple[TrackResult, ...]
    """Results by object, the most missed first."""
    phantoms: dict[str, int]
    """Phantoms in all frames, by `STATES`."""
    feasible: int
    """Frames in which the independent check finds no violation."""
    violations: dict[str, tuple[str, ...]]
    """Violations by frame."""
    held_back: tuple[str, ...]
    """Constraints that were active in the search."""
    failed: dict[str, str]
    """Why frames could not be used."""
    theta: dict[str, str]
    """Changed coordinates in physical units."""
    loss_trace: tuple[float, ...]
    """Loss of each step."""
    queries: int
    """Gradients, or evaluated clips of a gradient-free search."""
    passes: int
    """Detector passes; a gradient counts as 3."""
    seconds: float
    """Run time, s."""

    @property
    def noun(self) -> str:
        """What the objects are called: vehicles, unless people are among them."""
        return "object" if {one.kind for one in self.tracks} & {*PEOPLE} else "vehicle"


TEXT_COLUMNS = ("object",)
NOTES = (
    "lost: frames in which the detector misses the object, out of those in which it counts; before: in the original "
    "clip, after: with the change, random: with a random change of the same size.",
    "longest: longest unbroken run of missed frames after the change. unseen: metres by which the camera approaches "
    "the object while it is missed, out of the metres while it counts.",
    "certain: graded frames with a new miss in which the miss is certain (docs/guide/ideas.md).",
)
_TABLE_STYLE: dict[str, Any] = {
    "unbroken": (*TEXT_COLUMNS, "longest", "certain"),
    "box": box.SIMPLE_HEAD,
    "padding": 0,
    "show_edge": False,
}
"""Narrow enough for 80 columns."""


def build_report(result: DriveResult) -> AnalysisReport:
    """Build the report in the result's folder."""
    title = f"{result.detector} on {result.clip}: {' + '.join(result.params)}, {result.method}"
    rows = [format_track(one) for one in result.tracks]
    table = ReportTable(title, tuple(rows[0]), tuple(tuple(row.values()) for row in rows), _TABLE_STYLE)
    return AnalysisReport(
        out=Path(result.out),
        name="drive",
        heading=f"{format_count(result.frames, 'frame')} of {result.clip}",
        data=asdict(result),
        csv_tables={"drive": [track_metrics(one) for one in result.tracks]},
        tables=[table],
        notes=[*NOTES, format_summary(result), *list_classes(result), *list_infeasible(result)],
        text_columns=TEXT_COLUMNS,
        failed={f"frame {name}": reason for name, reason in result.failed.items()},
    )


def format_track(one: TrackResult) -> dict[str, str]:
    """Format an object's row of the table."""
    return {
        "object": f"{one.track} {one.kind}",
        "lost before": f"{one.lost_before}",
        "lost after": f"{one.lost_after}",
        "lost random": f"{one.lost_control}",
        "of": f"{one.frames}",
        "longest": f"{one.longest_after}",
        "unseen before": f"{one.metres_lost_before:.1f}",
        "unseen after": f"{one.metres_lost_after:.1f}",
        "unseen random": f"{one.metres_lost_control:.1f}",
        "of m": f"{one.metres:.1f}",
        "certain": f"{one.certain}/{one.graded}" if one.graded else "-",
    }


def format_summary(result: DriveResult) -> str:
    """Summarise the clip on one line."""
    phantoms, frames = format_count(result.phantoms["after"], "phantom"), format_count(result.frames, "frame")
    queries, passes = (
        format_count(result.queries, "query", "queries"),
        format_count(result.passes, "pass", "passes"),
    )
    return (
        f"{_format_misses(result.tracks, result.noun)}, {phantoms} ({result.phantoms['control']} random); "
        f"feasible in {result.feasible} of {frames}; {queries}, {passes}, {result.seconds:.0f} s"
    )


def list_classes(result: DriveResult) -> list[str]:
    """List the misses by class, where people and vehicles both count."""
    kinds = dict.fromkeys(one.kind for one in result.tracks if one.frames)
    if len({kind in PEOPLE for kind in kinds}) < 2:
        return []
    return [
        f"{kind}: {_format_misses([one for one in result.tracks if one.kind == kind], result.noun)}"
        for kind in kinds
    ]


def _format_misses(tracks: Sequence[TrackResult], noun: str) -> str:
    before, after, control = (
        sum(getattr(one, f"lost_{state}") for one in tracks) for state in ("before", "after", "control")
    )
    sightings = format_count(sum(one.frames for one in tracks), "sighting")
    counted = format_count(sum(one.frames > 0 for one in tracks), noun)
    return f"{after} of {sightings} of {counted} missed ({before} before, {control} by a random change)"


def list_infeasible(result: DriveResult) -> list[str]:
    """List the frames in which the change is not feasible."""
    return [f"infeasible in frame {name}: {'; '.join(lines)}" for name, lines in result.violations.items()]


def track_metrics(one: TrackResult) -> dict[str, Any]:
    """An object's numbers by name, without its data per frame."""
    return {name: value for name, value in asdict(one).items() if name not in ("states", "distance_m", "path_m")}


_CLASSES = {FOUND: "f", LOST: "l", UNCOUNTED: "u"}


def write_page(path: Path, result: DriveResult) -> None:
    """Write the page, which shows the images and the video in the same folder. Atomic."""
    pictures = [
        {"name": name} | {side: quote(f"{FRAMES}/{name}/{side}.jpg") for side in ("before", "after")}
        for name in result.names
    ]
    rows = [format_track(one) for one in result.tracks]
    text = web.render_page(
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
        notes=(*NOTES, format_summary(result), *list_classes(result), *list_infeasible(result)),
        result=result,
    )
    files.write_text(path, text)


def _runs(states: str) -> Iterator[tuple[int, int, str]]:
    """Yield runs of frames in one state: start, length and CSS class, without frames that lack the object."""
    start = 0
    for state, group in groupby(states):
        length = len(list(group))
        if state != ABSENT:
            yield start, length, _CLASSES[state]
        start += length


def _headline(result: DriveResult) -> str:
    worst = result.tracks[0]
    if worst.new_misses <= 0:
        return f"{result.detector} misses no {result.noun} of {result.clip} in more frames than before"
    return (
        f"{result.detector} misses {worst.kind.lower()} {worst.track} in {worst.lost_after} of "
        f"{format_count(worst.frames, 'frame')}, {worst.lost_before} before"
    )


def _lead(result: DriveResult) -> str:
    return (
        f"{' + '.join(result.params)} changed by {result.method}: one change for each of "
        f"{format_count(len(result.tracks), result.noun)} over {format_count(result.frames, 'frame')}, compared with a "
        "random change of the same size."
    )


def _tiles(result: DriveResult) -> list[dict[str, str]]:
    tracks = result.tracks
    lost, before, control, counted = (
        sum(getattr(one, name) for one in tracks)
        for name in ("lost_after", "lost_before", "lost_control", "frames")
    )
    unseen = max(tracks, key=lambda one: one.metres_lost_after)
    longest = max(tracks, key=lambda one: one.longest_after)
    graded, certain = sum(one.graded for one in tracks), sum(one.certain for one in tracks)
    return [
        {
            "title": f"missed {result.noun}s, over all frames",
            "figure": f"{before} → {lost}",
            "more": f"of {counted}; random change: {control}",
        },
        {
            "title": "longest time missed",
            "figure": f"{longest.longest_after / 10:.1f} s",
            "more": f"{longest.kind.lower()} {longest.track}; {longest.longest_before / 10:.1f} s before",
        },
        {
            "title": "longest approach while missed",
            "figure": f"{unseen.metres_lost_after:.1f} m",
            "more": f"{unseen.kind.lower()} {unseen.track}, of {unseen.metres:.1f} m; "
            f"{unseen.metres_lost_before:.1f} m before",
        },
        {
            "title": "certain new misses",
            "figure": f"{certain} of {graded}" if graded else "none",
            "more": "in graded frames",
        },
        {
            "title": "feasible",
            "figure": f"{result.feasible} of {result.frames}",
            "more": "frames, by the independent check",
        },
    ]


FRAMES_A_SECOND = 10
_GAP_PX = 4


def write_video(path: Path, folders: Sequence[Path]) -> None:
    """Write a WebM video (VP8) of frames, each a folder with before.jpg and after.jpg, one above the other. Atomic.

    Raises WriteError where OpenCV was built without VP8.
    """
    with tempfile.TemporaryDirectory() as folder:
        part = Path(folder) / path.name
        writer: cv2.VideoWriter | None = None
        for one in folders:
            picture = _above_each_other(one)
            writer = writer or _writer(part, (picture.shape[1], picture.shape[0]))
            if not writer.isOpened():
                raise WriteError(str(path), "this OpenCV cannot write VP8")
            writer.write(picture[..., ::-1])
        if writer is not None:
            writer.release()
            files.write_bytes(path, files.read_bytes(part))


def _above_each_other(folder: Path) -> np.ndarray:
    """Stack a frame before and after (h, w, 3); the codec needs even sides, so the last row and column repeat."""
    before, after = (files.read_image(folder / f"{name}.jpg") for name in ("before", "after"))
    picture = np.concatenate([before, np.zeros((_GAP_PX, *before.shape[1:]), np.uint8), after])
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _writer(path: Path, size_wh: tuple[int, int]) -> cv2.VideoWriter:
    with suppress_stderr():  # a harmless warning about the codec tag
        code = cv2.VideoWriter.fourcc(*"VP80")
        return cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, FRAMES_A_SECOND, size_wh)
