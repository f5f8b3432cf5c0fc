"""Runs one hostile case in its own process, and lists what is wrong with the outcome."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from drivesem.reporting.tables import format_count
from tools.compare_checkouts import ROOT
from tools.hostile.inputs import MARK, ValidInputs
from tools.same import environment

SECONDS = 5.0
"""Processor time of a command that refuses its input, s."""
MEMORY_MB = 1024
"""Resident memory of its largest process, MB."""
END_SECONDS = 2.0
"""Wall-clock time from the last signal until all processes are gone, s."""
_STUCK_SECONDS = 120
"""Wall-clock time after which a command is killed, s."""
_LIMIT_SECONDS, _LIMIT_MB = 60, 8192
"""Hard limits that protect the machine: processor time, s; memory, MB."""
_PREFIXES = ("drivesem: ", "python -m tools.experiments: ")
_CODE_NOTICE = "runs the code in"
_TROUBLE = ("Traceback (most recent call last)", "Warning:", "leaked", "Exception ignored", "BrokenProcessPool")
"""Texts that no output may contain."""
_PROGRESS = "━"

_LAUNCHER = """
import json, os, resource, signal, subprocess, sys
result, seconds, megabytes, *words = sys.argv[1:]
signal.signal(signal.SIGINT, signal.SIG_DFL)  # background processes of a shell ignore it
def limit():
    for what, most in ((resource.RLIMIT_CPU, int(seconds)), (resource.RLIMIT_DATA, int(megabytes) << 20)):
        resource.setrlimit(what, (most, most))
child = subprocess.Popen(words, start_new_session=True, preexec_fn=limit, stdin=subprocess.DEVNULL)
with open(result + ".pid", "w") as file:
    file.write(str(child.pid))
os.rename(result + ".pid", result + ".started")
_, status, used = os.wait4(child.pid, 0)
facts = {"code": os.waitstatus_to_exitcode(status)}
facts |= {"seconds": used.ru_utime + used.ru_stime, "mb": used.ru_maxrss / 1024}
with open(result, "w") as file:
    json.dump(facts, file)
"""
"""Starts a command and waits for it. Linux counts the memory of the parent, here with torch loaded, as the child's,
so a small process stands between them."""


@dataclass(frozen=True, slots=True)
class Signals:
    """Signals sent to a running command: SIGINT to its process group, as Ctrl-C does; others to the command alone."""

    ready: str
    """Glob of a file or folder that starts the clock; empty for the start of the command."""
    after: tuple[float, ...]
    """Time of each signal on that clock, s."""
    number: signal.Signals = signal.SIGINT
    """The signal."""


@dataclass(frozen=True, slots=True)
class HostileCase:
    """A command with hostile input."""

    name: str
    """Unique name."""
    family: str
    """One of FAMILIES."""
    make: Callable[[ValidInputs, Path], object]
    """Writes the input into an empty folder."""
    words: str
    """Command line, run in that folder."""
    named: tuple[str, ...] = ()
    """Texts that the error line must contain."""
    code: int = 2
    """Expected exit code."""
    signals: Signals | None = None
    """Signals sent to it."""
    unlimited: bool = False
    """Whether it does real work, without limits of time and memory."""


@dataclass(frozen=True, slots=True)
class CaseResult:
    """Outcome of a case."""

    code: int | None
    """Exit code; None for a command that was killed."""
    out: str
    """Standard output."""
    err: str
    """Standard error."""
    seconds: float
    """Processor time, with finished child processes, s."""
    mb: float
    """Resident memory of the largest process, MB."""
    mark: bool = False
    """Whether foreign code ran."""
    ended_s: float = 0.0
    """Wall-clock time since the last signal, s."""
    left: int = 0
    """Processes that outlived the command."""


def error_lines(done: CaseResult) -> list[str]:
    """Lines of standard error that begin with the program's name, without notices about code that is run."""
    return [line for line in done.err.splitlines() if line.startswith(_PREFIXES) and _CODE_NOTICE not in line]


def notes(done: CaseResult) -> list[str]:
    """Other lines of standard error, without progress bars."""
    lines = (line.strip() for line in done.err.splitlines())
    return [line for line in lines if line and _PROGRESS not in line and not line.startswith(_PREFIXES)]


def difference_lines(done: CaseResult) -> list[str]:
    """Lines in which `verify` reports a difference."""
    return [line for line in done.out.splitlines() if ": expected " in line and ", found " in line]


def judge(case: HostileCase, done: CaseResult) -> list[str]:
    """One line for each defect."""
    if done.code is None:
        return [f"no end after {_STUCK_SECONDS} s"]
    wrong = []
    if done.code != case.code:
        wrong.append(f"exit code {done.code}, not {case.code}")
    wrong += [f"prints {text!r}" for text in _TROUBLE if text in done.out + done.err]
    wrong += _wrong_lines(case, done)
    if not case.unlimited and done.seconds > SECONDS:
        wrong.append(f"{done.seconds:.1f} s of the processor, more than {SECONDS:g}")
    if not case.unlimited and done.mb > MEMORY_MB:
        wrong.append(f"{done.mb:.0f} MB, more than {MEMORY_MB}")
    if done.mark:
        wrong.append("foreign code was run")
    if case.signals is not None and done.ended_s > END_SECONDS:
        wrong.append(f"ended {done.ended_s:.1f} s after the last signal, more than {END_SECONDS:g}")
    if done.left:
        wrong.append(f"{format_count(done.left, 'process', 'processes')} outlived it")
    return wrong


def _wrong_lines(case: HostileCase, done: CaseResult) -> list[str]:
    lines = error_lines(done)
    if case.code == 1:
        wrong = [f"an error besides the differences: {line}" for line in lines]
        named = [line for line in difference_lines(done) if all(text in line for text in case.named)]
        return wrong if named else [*wrong, f"no difference names {' and '.join(case.named)}"]
    if case.code == 0:
        return [f"an error: {line}" for line in lines]
    if len(lines) != 1:
        return [f"{len(lines)} lines of error, not one"]
    (line,) = lines
    wrong = [f"the line does not name {text!r}" for text in case.named if text not in line]
    if case.code == 2 and not (": expected " in line and ", found " in line):
        wrong.append("the line does not state what was expected and found")
    if done.err.splitlines()[-1] != line:
        wrong.append("the line is not the last")
    return wrong


def process_words(case: HostileCase) -> list[str]:
    """Arguments of the process: `drivesem` and `tools` of this checkout, with this Python."""
    first, *rest = shlex.split(case.words)
    module = "drivesem.cli" if first == "drivesem" else first
    return [sys.executable, *(() if first == "python" else ("-m", module)), *rest]


def run(case: HostileCase, folder: Path, ground: ValidInputs) -> CaseResult:
    """Make the input of a case and run its command.

    Args:
        case: The case.
        folder: Folder for its input and output.
        ground: Valid data and runs to derive inputs from.
    """
    place, result = folder / "here", folder / "used.json"
    place.mkdir(parents=True)
    case.make(ground, place)
    limits = (str(_LIMIT_SECONDS * (10 if case.unlimited else 1)), str(_LIMIT_MB))
    words = [sys.executable, "-S", "-E", "-c", _LAUNCHER, str(result), *limits, *process_words(case)]
    with (folder / "out.txt").open("w") as out, (folder / "err.txt").open("w") as err:
        launcher = subprocess.Popen(words, cwd=place, env=_environment(folder), stdout=out, stderr=err)
        started = result.with_name(result.name + ".started")
        if not wait_until(started.exists):
            raise RuntimeError(f"{case.name}: the command did not start")
        session = int(started.read_text())
        used, sent, ended, left = {}, 0.0, 0.0, []
        try:
            sent = _send(case.signals, session, place) if case.signals is not None else 0.0
            launcher.wait(_STUCK_SECONDS)
            used = json.loads(result.read_text())
            # an interrupted command may take END_SECONDS; others have ended all their processes
            wait_until(
                lambda: not _members(session), max(sent + END_SECONDS - time.monotonic(), 0) if sent else 1.0
            )
        except subprocess.TimeoutExpired:
            pass
        finally:  # also if this process is interrupted
            ended, left = time.monotonic(), _members(session)
            for pid in left:
                _signal(os.kill, pid, signal.SIGKILL)
            launcher.wait()
    outputs = [(folder / name).read_text(errors="replace") for name in ("out.txt", "err.txt")]
    return CaseResult(
        code=used.get("code"),
        out=outputs[0],
        err=outputs[1],
        seconds=used.get("seconds", 0.0),
        mb=used.get("mb", 0.0),
        mark=any(place.rglob(MARK)),
        ended_s=ended - sent if sent else 0.0,
        left=len(left),
    )


def _environment(folder: Path) -> dict[str, str]:
    """Environment as for other tools, but with warnings, and wide enough for one line each."""
    settings = environment(folder) | {"PYTHONPATH": str(ROOT), "COLUMNS": "200"}
    settings.pop("PYTHONWARNINGS")
    return settings


def _send(signals: Signals, session: int, place: Path) -> float:
    """Wait until the command is ready, and send the signals. Returns the time of the last on the monotonic clock."""
    wait_until(
        lambda: not _members(session) or (not signals.ready or any(place.glob(signals.ready))), _STUCK_SECONDS
    )
    begin = time.monotonic()
    for seconds in signals.after:
        time.sleep(max(begin + seconds - time.monotonic(), 0))
        _signal(os.killpg if signals.number == signal.SIGINT else os.kill, session, signals.number)
    return time.monotonic()


def _signal(send: Callable[[int, int], None], target: int, number: int) -> None:
    try:
        send(target, number)
    except ProcessLookupError:  # it has ended
        return


def wait_until(condition: Callable[[], bool], seconds: float = 30.0) -> bool:
    """Wait until a condition holds, at most so many seconds. Returns whether it does."""
    until = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > until:
            return False
        time.sleep(0.02)
    return True


def _members(session: int) -> list[int]:
    """Running processes of a session: the command and its children (Linux)."""
    processes = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, session_id, *_ = path.read_text(errors="replace").rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(session_id) == session and state != "Z":
            processes.append(int(path.parent.name))
    return processes
