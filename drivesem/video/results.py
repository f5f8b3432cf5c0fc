"""What an attack on a clip found, car by car, as plain dataclasses."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

FOUND, LOST, UNCOUNTED, ABSENT = "f", "l", "-", " "
"""A car in one frame: found; missed; too small, hidden or cut to be judged; not in it."""
State = Literal["before", "after", "control"]
STATES: tuple[State, ...] = ("before", "after", "control")
"""The clip as it was photographed, changed by the attack, and changed at random by as much."""


@dataclass(frozen=True, slots=True)
class MissedInterval:
    """How a car is missed in a clip. frames: in which it counts; lost: of these, missed; longest: frames of the
    longest unbroken stretch of misses; metres: by which the camera comes nearer while it counts; metres_lost:
    while it is missed.
    """

    frames: int
    lost: int
    longest: int
    metres: float
    metres_lost: float

    @classmethod
    def from_states(cls, states: str, distance_m: Sequence[float | None]) -> MissedInterval:
        """states: FOUND, LOST, UNCOUNTED or ABSENT a frame; distance_m: from the camera, None where absent."""
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
            metres=_metres(way for way, counts in zip(nearer, counted, strict=True) if counts),
            metres_lost=_metres(way for way, state in zip(nearer, states, strict=True) if state == LOST),
        )


def _metres(ways: Iterable[float]) -> float:
    return round(sum(ways, 0.0), 3)


@dataclass(frozen=True, slots=True)
class CarResult:
    """One car. track: its number in the data; frames: in which it counts, as changed; lost, longest, metres_lost:
    as of `Missed`, by STATES; metres: by which the camera comes nearer while it counts; graded: frames in which it
    is newly missed and was looked at in draws; certain: of these, missed for certain; states: by STATES, a letter
    a frame; distance_m: from the camera, a number a frame; path_m: how far it stands from its place, along its
    heading and across, a frame.
    """

    track: int
    kind: str
    frames: int
    lost_before: int
    lost_after: int
    lost_control: int
    longest_before: int
    longest_after: int
    longest_control: int
    metres: float
    metres_lost_before: float
    metres_lost_after: float
    metres_lost_control: float
    graded: int
    certain: int
    states: dict[str, str]
    distance_m: tuple[float | None, ...]
    path_m: tuple[tuple[float, float] | None, ...]

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
        """certain: one a frame that was graded."""
        missed = {state: MissedInterval.from_states(letters, distance_m) for state, letters in states.items()}
        figures = {
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
            **figures,
        )

    @property
    def new_misses(self) -> int:
        """Frames in which it is missed beyond those before."""
        return self.lost_after - self.lost_before


@dataclass(frozen=True, slots=True)
class DriveResult:
    """A whole clip. names: of its `frames`; feasible: frames in which the independent check finds nothing wrong;
    violations: what it finds, by frame; phantoms: by STATES, in all frames; queries: gradients, or clips judged by
    a search without; theta: coordinates that changed, in people's units; held_back: what was not feasible on the
    way; failed: why frames could not be used.
    """

    out: str
    clip: str
    detector: str
    t_star: float
    params: tuple[str, ...]
    method: str
    frames: int
    names: tuple[str, ...]
    cars: tuple[CarResult, ...]
    phantoms: dict[str, int]
    feasible: int
    violations: dict[str, tuple[str, ...]]
    held_back: tuple[str, ...]
    failed: dict[str, str]
    theta: dict[str, str]
    loss_trace: tuple[float, ...]
    queries: int
    passes: int
    seconds: float
