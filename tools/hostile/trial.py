"""A command typed in a process of its own, and what is wrong with how it took what it was given."""

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

from drivesem.report.tables import number_of
from tools.beside import ROOT
from tools.hostile.inputs import MARK, Ground
from tools.same import environment

SECONDS = 5.0
"""Of the processor, for a command that is to refuse something."""
MEMORY_MB = 1024
"""Resident, of the largest of its processes."""
END_SECONDS = 2.0
"""By the clock, from the last signal until the command and all that it started are gone."""
_STUCK_SECONDS = 120
"""By the clock, after which a command is killed."""
_LIMIT_SECONDS, _LIMIT_MB = 60, 8192
"""What the system lets a command have, so that one that fails leaves the machine alone: processor, memory."""
_OWN, _CODE = "drivesem: ", "runs the code in"
_TROUBLE = ("Traceback (most recent call last)", "Warning:", "leaked", "Exception ignored", "BrokenProcessPool")
"""What no command may say, whatever it is given."""
_PROGRESS = "━"

_LAUNCHER = """
import json, os, resource, signal, subprocess, sys
answer, seconds, megabytes, *words = sys.argv[1:]
signal.signal(signal.SIGINT, signal.SIG_DFL)  # what a shell starts in the background ignores it
def limit():
    for what, most in ((resource.RLIMIT_CPU, int(seconds)), (resource.RLIMIT_DATA, int(megabytes) << 20)):
        resource.setrlimit(what, (most, most))
child = subprocess.Popen(words, start_new_session=True, preexec_fn=limit, stdin=subprocess.DEVNULL)
with open(answer + ".pid", "w") as file:
    file.write(str(child.pid))
os.rename(answer + ".pid", answer + ".started")
_, status, used = os.wait4(child.pid, 0)
told = {"code": os.waitstatus_to_exitcode(status)}
told |= {"seconds": used.ru_utime + used.ru_stime, "mb": used.ru_maxrss / 1024}
with open(answer, "w") as file:
    json.dump(told, file)
"""
"""Starts a command and waits for it. A process between is needed: Linux counts the memory of whoever starts a
process as the new one's, and this one has torch in it."""


@dataclass(frozen=True, slots=True)
class Signals:
    """What is sent to a command while it works. ready: a file or folder that is there when counting begins, "" for
    at once; after: seconds from then until each; number: of the signal. To all processes of a terminal, as Ctrl-C
    is, where that is SIGINT; else to the command alone.
    """

    ready: str
    after: tuple[float, ...]
    number: signal.Signals = signal.SIGINT


@dataclass(frozen=True, slots=True)
class Case:
    """make: writes what the command is given into an empty folder, in which it is then typed; words: the command;
    code: the exit code that is right; says: what its one line must name; signals: what is sent to it. unlimited:
    it really works, so that it may take its time and its memory.
    """

    name: str
    family: str
    make: Callable[[Ground, Path], object]
    words: str
    says: tuple[str, ...] = ()
    code: int = 2
    signals: Signals | None = None
    unlimited: bool = False


@dataclass(frozen=True, slots=True)
class Done:
    """What a command did. seconds: of the processor, with all processes that it started and waited for; mb:
    resident memory of the largest of them; ended_s: from the last signal by the clock; mark: whether foreign code
    ran; left: processes that outlived it.
    """

    code: int | None
    out: str
    err: str
    seconds: float
    mb: float
    mark: bool = False
    ended_s: float = 0.0
    left: int = 0


def told(done: Done) -> list[str]:
    """The lines in which a command says what is wrong: those on standard error that begin with its name, but for
    the announcement of code that a setting names. Bars of progress and notes begin otherwise.
    """
    return [line for line in done.err.splitlines() if line.startswith(_OWN) and _CODE not in line]


def notes(done: Done) -> list[str]:
    """What else is on standard error, without bars of progress."""
    lines = (line.strip() for line in done.err.splitlines())
    return [line for line in lines if line and _PROGRESS not in line and not line.startswith(_OWN)]


def verdicts(done: Done) -> list[str]:
    """The lines in which `verify` tells of a difference."""
    return [line for line in done.out.splitlines() if ": expected " in line and ", found " in line]


def judge(case: Case, done: Done) -> list[str]:
    """What is wrong, a line each."""
    if done.code is None:
        return [f"no end after {_STUCK_SECONDS} s"]
    wrong = []
    if done.code != case.code:
        wrong.append(f"exit code {done.code}, not {case.code}")
    wrong += [f"says {text!r}" for text in _TROUBLE if text in done.out + done.err]
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
        wrong.append(f"{number_of(done.left, 'process', 'processes')} outlived it")
    return wrong


def _wrong_lines(case: Case, done: Done) -> list[str]:
    lines = told(done)
    if case.code == 1:
        wrong = [f"an error beside the differences: {line}" for line in lines]
        named = [line for line in verdicts(done) if all(text in line for text in case.says)]
        return wrong if named else [*wrong, f"no difference names {' and '.join(case.says)}"]
    if case.code == 0:
        return [f"an error: {line}" for line in lines]
    if len(lines) != 1:
        return [f"{len(lines)} lines of error, not one"]
    (line,) = lines
    wrong = [f"the line does not name {text!r}" for text in case.says if text not in line]
    if case.code == 2 and not (": expected " in line and ", found " in line):
        wrong.append("the line does not say what was expected, and what found")
    if done.err.splitlines()[-1] != line:
        wrong.append("the line is not the last")
    return wrong


def words_of(case: Case) -> list[str]:
    """The process that is started: `drivesem` is this checkout's, and `python` the one that runs this."""
    first, *rest = shlex.split(case.words)
    return [sys.executable, *(("-m", "drivesem.cli") if first == "drivesem" else ()), *rest]


def run(case: Case, folder: Path, ground: Ground) -> Done:
    """Make what the command is given in `folder`, and type it there."""
    place, answer = folder / "here", folder / "used.json"
    place.mkdir(parents=True)
    case.make(ground, place)
    limits = (str(_LIMIT_SECONDS * (10 if case.unlimited else 1)), str(_LIMIT_MB))
    words = [sys.executable, "-S", "-E", "-c", _LAUNCHER, str(answer), *limits, *words_of(case)]
    with (folder / "out.txt").open("w") as out, (folder / "err.txt").open("w") as err:
        launcher = subprocess.Popen(words, cwd=place, env=_environment(folder), stdout=out, stderr=err)
        started = answer.with_name(answer.name + ".started")
        if not soon(started.exists):
            raise RuntimeError(f"{case.name}: the command did not start")
        session = int(started.read_text())
        used, sent, ended, left = {}, 0.0, 0.0, []
        try:
            sent = _send(case.signals, session, place) if case.signals is not None else 0.0
            launcher.wait(_STUCK_SECONDS)
            used = json.loads(answer.read_text())
            # What was interrupted may take so long; what ended by itself has nothing to wait for.
            soon(lambda: not _members(session), max(sent + END_SECONDS - time.monotonic(), 0) if sent else 1.0)
        except subprocess.TimeoutExpired:
            pass
        finally:  # also where this one is interrupted
            ended, left = time.monotonic(), _members(session)
            for pid in left:
                _signal(os.kill, pid, signal.SIGKILL)
            launcher.wait()
    said = [(folder / name).read_text(errors="replace") for name in ("out.txt", "err.txt")]
    return Done(
        code=used.get("code"),
        out=said[0],
        err=said[1],
        seconds=used.get("seconds", 0.0),
        mb=used.get("mb", 0.0),
        mark=any(place.rglob(MARK)),
        ended_s=ended - sent if sent else 0.0,
        left=len(left),
    )


def _environment(folder: Path) -> dict[str, str]:
    """That of other tools, but for warnings, which a user would see, and width, so that a difference is a line."""
    settings = environment(folder) | {"PYTHONPATH": str(ROOT), "COLUMNS": "200"}
    settings.pop("PYTHONWARNINGS")
    return settings


def _send(signals: Signals, session: int, place: Path) -> float:
    """Wait until the command is as far as it is to be, and signal it. -> when the last was sent, by the clock."""
    soon(lambda: not _members(session) or (not signals.ready or any(place.glob(signals.ready))), _STUCK_SECONDS)
    begin = time.monotonic()
    for seconds in signals.after:
        time.sleep(max(begin + seconds - time.monotonic(), 0))
        _signal(os.killpg if signals.number == signal.SIGINT else os.kill, session, signals.number)
    return time.monotonic()


def _signal(send: Callable[[int, int], None], whom: int, number: int) -> None:
    try:
        send(whom, number)
    except ProcessLookupError:  # it has just ended
        return


def soon(what: Callable[[], bool], seconds: float = 30.0) -> bool:
    """Whether something holds within so many seconds; returns once it does."""
    until = time.monotonic() + seconds
    while not what():
        if time.monotonic() > until:
            return False
        time.sleep(0.02)
    return True


def _members(session: int) -> list[int]:
    """Processes of a session that run: the command, and what it started (Linux)."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, its_session, *_ = path.read_text(errors="replace").rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(its_session) == session and state != "Z":
            found.append(int(path.parent.name))
    return found
