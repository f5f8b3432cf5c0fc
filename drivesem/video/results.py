"""Results of an attack on a clip, car by car, as plain dataclasses."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

FOUND, LOST, UNCOUNTED, ABSENT = "f", "l", "-", " "
"""State of a car in one frame: detected; missed; too small, hidden or truncated to count; absent."""
State = Literal["before", "after", "control"]
STATES: tuple[State, ...] = ("before", "after", "control")
"""The original clip, the attacked one, and one with a random change of the same size."""


@dataclass(frozen=True, slots=True)
class MissedInterval:
    """How long a car is missed in a clip."""

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
class CarResult:
    """Result of one car; see `MissedInterval` for lost, longest and metres, and `STATES` for their suffixes."""

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
    """Approach of the camera while the car counts, m."""
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
    ) -> CarResult:
        """Measure a car.

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
    cars: tuple[CarResult, ...]
    """Results by car, the most missed first."""
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
