"""Work shared by processes: results, errors, and what each process makes for itself."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import platform
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from drivesem.config.errors import UsageError
from drivesem.config.options import WorkerOptions
from drivesem.run.allocation import release_freed_memory
from drivesem.run.workers import run_jobs
from scene_ir.errors import FormatError, RangeError, SceneError, ShapeError


def square(job: int, offset: int = 0) -> tuple[int, int]:
    """A job's square and who found it. FormatError for 3."""
    if job == 3:
        raise FormatError("three", "another number", job)
    return job * job + offset, os.getpid()


def build(offset: int) -> Callable[[int], tuple[int, int]]:
    return partial(square, offset=offset)


def in_order(jobs: list[int], config: WorkerOptions) -> dict[int, tuple[int, int] | str]:
    found: dict[int, tuple[int, int] | str] = {}
    for job, outcome in run_jobs(square, partial(build, 100), jobs, config):
        try:
            found[job] = outcome()
        except SceneError as error:
            found[job] = str(error)
    return found


def test_one_process_does_it_here() -> None:
    found = in_order([1, 2, 3], WorkerOptions(workers=1))
    assert found == {1: (1, os.getpid()), 2: (4, os.getpid()), 3: "three: expected another number, found 3"}
    assert in_order([2], WorkerOptions(workers=4)) == {2: (4, os.getpid())}, "one job is not worth a process"
    assert in_order([], WorkerOptions(workers=4)) == {}


def test_processes_make_their_own_and_hand_errors_back() -> None:
    found = in_order([1, 2, 3, 4], WorkerOptions(workers=2))
    assert found[3] == "three: expected another number, found 3"
    for job in (1, 2, 4):
        value = found[job]
        assert isinstance(value, tuple)
        assert value[0] == job * job + 100
        assert value[1] != os.getpid()


def test_processes_begin_once_for_all_jobs() -> None:
    found = in_order([job for job in range(20) if job != 3], WorkerOptions(workers=2))
    processes = {value[1] for value in found.values() if isinstance(value, tuple)}
    assert len(processes) <= 2, "a start takes seconds; on a busy machine one is done before the other has begun"


_HELD: list[bytes] = []


def grow(job: int) -> int:
    """Keeps 400 MB, and takes so long that it is noticed. The process's number."""
    _HELD.append(bytes(bytearray(b"x") * 400_000_000))
    time.sleep(1.1)
    return os.getpid()


def growing() -> Callable[[int], int]:
    return grow


def test_a_process_that_grows_is_replaced_without_a_word(recwarn: pytest.WarningsRecorder) -> None:
    found = [outcome() for _, outcome in run_jobs(grow, growing, list(range(6)), WorkerOptions(workers=2))]
    assert len(found) == 6
    assert len(set(found)) > 2
    assert [str(one.message) for one in recwarn if "worker" in str(one.message)] == []


@pytest.mark.parametrize("kind", [ShapeError, RangeError, FormatError, UsageError])
def test_errors_survive_the_way_between_processes(kind: type[SceneError]) -> None:
    error = kind("file:3", "a number", [1, 2])
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind
    assert str(again) == str(error) == "file:3: expected a number, found [1, 2]"


@pytest.mark.parametrize("jobs", [[], [1], [1, 2]])
def test_threads_are_shared_among_processes_only_while_they_work(jobs: list[int]) -> None:
    before, shared = torch.get_num_threads(), max((os.cpu_count() or 1) // 2, 1)
    try:
        torch.set_num_threads(shared + 1)
        for _, outcome in run_jobs(square, partial(build, 0), jobs, WorkerOptions(workers=2)):
            outcome()
            assert torch.get_num_threads() == shared
        assert torch.get_num_threads() == shared + 1
    finally:
        torch.set_num_threads(before)


def test_no_more_threads_are_taken_than_torch_was_left() -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)  # as OMP_NUM_THREADS=1 has it
        for _ in run_jobs(square, partial(build, 0), [1, 2], WorkerOptions(workers=1)):
            assert torch.get_num_threads() == 1
    finally:
        torch.set_num_threads(before)


def stumble(job: int) -> int:
    return 12 // job


def stumbling() -> Callable[[int], int]:
    return stumble


@pytest.mark.parametrize("workers", [1, 2])
def test_a_defect_ends_the_work_unless_it_is_to_keep_going(workers: int) -> None:
    def found(*, keep_going: bool) -> dict[int, int | str]:
        results: dict[int, int | str] = {}
        config = WorkerOptions(workers=workers, keep_going=keep_going)
        for job, outcome in run_jobs(stumble, stumbling, [3, 0, 4], config):
            try:
                results[job] = outcome()
            except SceneError as error:
                results[job] = str(error)
        return results

    output = found(keep_going=True)
    assert (output[3], output[4]) == (4, 3)
    assert re.fullmatch(
        r"drivesem: expected no defect of its own, found ZeroDivisionError at test_workers.py:\d+: .*",
        str(output[0]),
    )
    with pytest.raises(ZeroDivisionError):
        found(keep_going=False)


@pytest.mark.parametrize("keep_going", [False, True])
def test_bad_settings_end_it_in_any_case(keep_going: bool) -> None:
    def refuse(job: int) -> int:
        raise UsageError("--detector", "another", job)

    ((_, outcome),) = run_jobs(refuse, stumbling, [1], WorkerOptions(workers=1, keep_going=keep_going))
    with pytest.raises(UsageError, match="--detector"):
        outcome()


def die(job: int, folder: str) -> int:
    """End the process at job 2 always, at job 4 once."""
    if job == 2 or (job == 4 and not Path(folder, "once").exists()):
        Path(folder, "once").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return job


def dying(folder: str) -> Callable[[int], int]:
    return partial(die, folder=folder)


def test_a_job_that_kills_its_process_is_retried_and_then_listed(tmp_path: Path) -> None:
    found: dict[int, int | str] = {}
    for job, outcome in run_jobs(die, partial(dying, str(tmp_path)), [1, 2, 3, 4, 5], WorkerOptions(workers=2)):
        try:
            found[job] = outcome()
        except SceneError as error:
            found[job] = str(error)
    assert {job: value for job, value in found.items() if job != 2} == {1: 1, 3: 3, 4: 4, 5: 5}
    assert "expected a process that lasts, found one that was ended twice" in str(found[2])


def linger(job: int, folder: str) -> None:
    """Say who works, and never end."""
    Path(folder, f"{job}-{os.getpid()}").touch()
    time.sleep(600)


def lingering(folder: str) -> Callable[[int], None]:
    return partial(linger, folder=folder)


_locks: list[Any] = []


def lock(job: int, folder: str) -> None:
    """Make a lock of processes, as progress bars of other packages do."""
    _locks.append(multiprocessing.RLock())


def locking(folder: str) -> Callable[[int], None]:
    return partial(lock, folder=folder)


# As in a terminal: what a shell starts in the background ignores Ctrl-C.
_STOPPED = """
import signal
from functools import partial

from drivesem.run.workers import run_jobs
from drivesem.config.options import WorkerOptions
from tests.drivesem.run.test_workers import {build}

signal.signal(signal.SIGINT, signal.default_int_handler)
list(run_jobs(None, partial({build}, {folder!r}), [1, 2], WorkerOptions(workers=2)))
"""


def wait_until(condition: Callable[[], bool], seconds: float) -> bool:
    from tools.hostile import trial  # slow, and workers import this module

    return trial.wait_until(condition, seconds)


def parent_of_workers(folder: Path, build: str = "lingering") -> subprocess.Popen[str]:
    """A script in a session of its own, whose two workers say in `folder` that they work."""
    (folder / "stopped.py").write_text(_STOPPED.format(folder=str(folder), build=build))
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    command = [sys.executable, str(folder / "stopped.py")]
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True)


def children(pid: int) -> list[int]:
    """Workers of a process that have been started, however far they are."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            parent = int(path.with_name("stat").read_text().rpartition(")")[2].split()[1])
            if parent == pid and b"popen_loky" in path.read_bytes():
                found.append(int(path.parent.name))
        except (FileNotFoundError, ProcessLookupError):
            continue
    return found


_NO_PROC = pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="needs Linux's /proc")


@_NO_PROC
@pytest.mark.parametrize("after_s", [0.0, pytest.param(0.2, marks=pytest.mark.slow)])
def test_workers_that_have_just_been_started_do_not_hear_ctrl_c(after_s: float, tmp_path: Path) -> None:
    with parent_of_workers(tmp_path) as parent:
        assert parent.stderr is not None
        assert wait_until(lambda: len(children(parent.pid)) > 0, 60)
        time.sleep(after_s)
        os.killpg(parent.pid, signal.SIGINT)
        output = parent.stderr.read()
    assert output.count("Traceback") == 1, output  # of the script itself, which catches nothing


@_NO_PROC
@pytest.mark.parametrize(
    "number",
    [
        signal.SIGKILL,
        *(pytest.param(number, marks=pytest.mark.slow) for number in (signal.SIGINT, signal.SIGTERM)),
    ],
)
def test_workers_of_a_process_that_is_stopped_end(number: signal.Signals, tmp_path: Path) -> None:
    """Soon, and without a word of their own; also where the script guards nothing by its name."""
    with parent_of_workers(tmp_path) as parent:
        assert parent.stderr is not None
        assert wait_until(lambda: len(list(tmp_path.glob("[12]-*"))) == 2, 60)
        workers = [int(path.name.partition("-")[2]) for path in tmp_path.glob("[12]-*")]
        start = time.monotonic()
        if number == signal.SIGINT:  # as a terminal sends it: to all of them
            os.killpg(parent.pid, number)
        else:
            parent.send_signal(number)
        parent.wait()
        assert wait_until(lambda: not any(_lives(pid) for pid in workers), 10)
        took, output = time.monotonic() - start, parent.stderr.read()
    assert took < 5
    assert output.count("Traceback") == (number == signal.SIGINT), "of the script itself, which catches nothing"


def test_workers_that_are_done_leave_no_semaphores(tmp_path: Path) -> None:
    with parent_of_workers(tmp_path, "locking") as parent:
        assert parent.stderr is not None
        assert parent.stderr.read() == ""
    assert parent.returncode == 0


def _lives(pid: int) -> bool:
    """Whether a process runs: one that ended and that nobody has asked for yet does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


_PINS: list[bytearray] = []


def resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def scatter(job: int) -> float:
    """Take 240 MB in small pieces, and let go of all but one in a hundred of them. How much was taken."""
    before = resident_mb()
    pieces = [bytearray(b"x" * 30_000) for _ in range(8_000)]
    _PINS.extend(pieces[::100])
    return resident_mb() - before


@_NO_PROC
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs glibc's malloc_trim")
def test_memory_that_is_free_goes_back_after_each_job() -> None:
    release_freed_memory()  # what tests before this one let go of would be taken again
    before = resident_mb()
    for _, outcome in run_jobs(scatter, stumbling, [1, 2, 3], WorkerOptions(workers=1)):
        assert outcome() > 150
        assert resident_mb() - before < 60
    _PINS.clear()
