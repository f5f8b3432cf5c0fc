"""Work shared by processes: results, errors, and what each process makes for itself."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from functools import partial

import pytest

from drivesem.config import Common, UsageError
from drivesem.pool import outcomes
from scene_ir.errors import FormatError, RangeError, SceneError, ShapeError


def square(job: int, offset: int = 0) -> tuple[int, int]:
    """A job's square and who found it. FormatError for 3."""
    if job == 3:
        raise FormatError("three", "another number", job)
    return job * job + offset, os.getpid()


def build(offset: int) -> Callable[[int], tuple[int, int]]:
    return partial(square, offset=offset)


def in_order(jobs: list[int], config: Common) -> dict[int, tuple[int, int] | str]:
    found: dict[int, tuple[int, int] | str] = {}
    for job, outcome in outcomes(square, partial(build, 100), jobs, config):
        try:
            found[job] = outcome()
        except SceneError as error:
            found[job] = str(error)
    return found


def test_one_process_does_it_here() -> None:
    found = in_order([1, 2, 3], Common(workers=1))
    assert found == {1: (1, os.getpid()), 2: (4, os.getpid()), 3: "three: expected another number, found 3"}
    assert in_order([2], Common(workers=4)) == {2: (4, os.getpid())}, "one job is not worth a process"
    assert in_order([], Common(workers=4)) == {}


def test_processes_make_their_own_and_hand_errors_back() -> None:
    found = in_order([1, 2, 3, 4], Common(workers=2))
    assert found[3] == "three: expected another number, found 3"
    for job in (1, 2, 4):
        value = found[job]
        assert isinstance(value, tuple)
        assert value[0] == job * job + 100
        assert value[1] != os.getpid()


@pytest.mark.parametrize("kind", [ShapeError, RangeError, FormatError, UsageError])
def test_errors_survive_the_way_between_processes(kind: type[SceneError]) -> None:
    error = kind("file:3", "a number", [1, 2])
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind
    assert str(again) == str(error) == "file:3: expected a number, found [1, 2]"
