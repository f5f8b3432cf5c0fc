"""Damaged files given to readers in a child process with limits on memory and time: what became of them."""

from __future__ import annotations

import json
import mmap
import os
import random
import resource
import select
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType, TracebackType
from typing import NoReturn

from tools.fuzz.formats import OWN_ERRORS, Format
from tools.fuzz.mutate import mutate

MEMORY_MB = 1024
"""By how much an input may make the process grow."""
SECONDS = 5.0
"""Of the processor, for an input."""
_STUCK_SECONDS = 120.0
"""Wall-clock seconds without output after which a child is ended."""
_STATE = struct.Struct("<5q2d")
"""Counters that the child shares: next input, tried, accepted, refused, wrong; most CPU seconds, most MB."""


@dataclass
class FuzzOutcome:
    """What became of a format's inputs."""

    name: str
    tried: int = 0
    accepted: int = 0
    refused: int = 0
    seconds: float = 0.0
    mb: float = 0.0
    wrong: dict[str, list[int]] = field(default_factory=dict)
    """A line for each kind of fault, and the inputs that showed it."""


class TooSlowError(BaseException):
    """The time of an input is up; no reader's own `except` may take it for the file's fault."""


class FuzzSubject:
    """A format's valid files, and their damaged likes one after the other."""

    def __init__(self, form: Format, folder: Path) -> None:
        self.form, self.root = form, folder / "given"
        form.make(self.root)
        chosen = {path for glob in form.files for path in self.root.glob(glob) if path.is_file()}
        self.valid = {path: path.read_bytes() for path in sorted(chosen)}
        self.others = folder

    @contextmanager
    def damaged(self, seed: int, number: int) -> Iterator[Path]:
        """The folder, with one or two of its files damaged, by seed and number alone; whole again afterwards."""
        rng = random.Random(f"{self.form.name} {seed} {number}")
        chosen = rng.sample(sorted(self.valid), k=min(rng.choice((1, 1, 1, 2)), len(self.valid)))
        for path in chosen:
            path.write_bytes(mutate(path.name, self.valid[path], rng))
        try:
            yield self.root
        finally:
            for path in chosen:
                path.write_bytes(self.valid[path])
            for path in self.others.iterdir():
                if path != self.root:
                    shutil.rmtree(path) if path.is_dir() else path.unlink()


def find_fault(form: Format, root: Path) -> tuple[str, bool]:
    """Read a folder: what is wrong with how its readers took it, "" for nothing; and whether they took it."""
    try:
        with _time_limit(), warnings.catch_warnings(action="error"):
            warnings.filterwarnings("ignore", category=DeprecationWarning)
            form.read(root)
    except TooSlowError:
        return f"more than {SECONDS:g} s {_place(sys.exc_info()[2])}", False
    except Exception as error:
        if type(error).__name__ not in OWN_ERRORS:
            return f"{type(error).__name__}: {_short(str(error))} {_place(error.__traceback__)}", False
        return "", False
    return "", True


def _short(message: str) -> str:
    """Of a message, so much that faults of one kind look alike."""
    return " ".join(message.split())[:60]


def _place(trace: TracebackType | None) -> str:
    """The innermost line of the project's."""
    frames = [
        f for f in traceback.extract_tb(trace) if "site-packages" not in f.filename and "<" not in f.filename
    ]  # pyright: ignore[reportArgumentType]
    home = str(Path(__file__).parents[2])
    own = [f for f in frames if f.filename.startswith(home) and "tools/fuzz" not in f.filename]
    return f"({Path(own[-1].filename).relative_to(home)}:{own[-1].lineno})" if own else "(nowhere)"


@contextmanager
def _time_limit() -> Iterator[None]:
    def late(number: int, frame: FrameType | None) -> NoReturn:
        raise TooSlowError

    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def fuzz(form: Format, seed: int, count: int, keep: Path | None = None, verbose: bool = False) -> FuzzOutcome:
    """Give `count` damaged inputs to a format's readers. keep: folder for inputs that showed a fault."""
    outcome = FuzzOutcome(form.name)
    start = 0
    while start < count:
        start = _in_child(form, seed, start, count, outcome, keep, verbose)
    return outcome


def _in_child(
    form: Format, seed: int, start: int, count: int, outcome: FuzzOutcome, keep: Path | None, verbose: bool
) -> int:
    """Fork a child that goes on from `start`: where the next has to begin."""
    shared = mmap.mmap(-1, _STATE.size)
    shared[:] = _STATE.pack(start, 0, 0, 0, 0, 0.0, 0.0)
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(reading)
        code = 1
        try:
            _work(form, seed, range(start, count), shared, writing, keep)
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    os.close(writing)
    output, why = _watched(pid, reading, shared)
    state = _STATE.unpack(shared[:])
    outcome.tried += state[1]
    outcome.accepted += state[2]
    outcome.refused += state[3]
    outcome.seconds, outcome.mb = max(outcome.seconds, state[5]), max(outcome.mb, state[6])
    for line in output.splitlines():
        fault, number = json.loads(line)
        _add(outcome, fault, number, verbose)
    if not why:
        return count
    outcome.tried += 1
    _add(outcome, why, state[0], verbose)
    return state[0] + 1


def _add(outcome: FuzzOutcome, fault: str, number: int, verbose: bool) -> None:
    if verbose and fault not in outcome.wrong:
        print(f"{outcome.name}: {number}: {fault}", flush=True)
    outcome.wrong.setdefault(fault, []).append(number)


def _watched(pid: int, reading: int, shared: mmap.mmap) -> tuple[str, str]:
    """Output of a child, and why it ended early ("" if it did not)."""
    output, since, last, why = b"", time.monotonic(), -1, ""
    while True:
        ready, _, _ = select.select([reading], [], [], 1.0)
        if ready:
            part = os.read(reading, 1 << 16)
            if not part:
                break
            output += part
        (number,) = struct.unpack_from("<q", shared, 0)
        if number != last:
            last, since = number, time.monotonic()
        elif time.monotonic() - since > _STUCK_SECONDS:
            why = f"nothing for {_STUCK_SECONDS:g} s by the clock, or no answer to the end of its time"
            os.kill(pid, signal.SIGKILL)
            break
    os.close(reading)
    _, status = os.waitpid(pid, 0)
    code = os.waitstatus_to_exitcode(status)
    if not why and code != 0:
        why = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    return output.decode(), why


def _work(form: Format, seed: int, numbers: range, shared: mmap.mmap, writing: int, keep: Path | None) -> None:
    """The child process: reads inputs one after the other and reports each beforehand."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)  # C libraries write there
    tried = accepted = refused = wrong = 0
    most_seconds = most_mb = 0.0
    with tempfile.TemporaryDirectory(prefix="fuzz") as folder:
        subject = FuzzSubject(form, Path(folder))
        form.read(subject.root)  # what is loaded once counts for none
        limit = _data_bytes() + (MEMORY_MB << 20)
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
        for number in numbers:
            shared[:] = _STATE.pack(number, tried, accepted, refused, wrong, most_seconds, most_mb)
            with subject.damaged(seed, number) as root:
                before, start = _peak_mb(), time.process_time()
                fault, taken = find_fault(form, root)
                most_seconds = max(most_seconds, time.process_time() - start)
                most_mb = max(most_mb, _peak_mb() - before)
                if fault:
                    os.write(writing, json.dumps([fault, number]).encode() + b"\n")
                    if keep is not None:
                        shutil.copytree(
                            root, keep / f"{form.name.replace(' ', '-')}-{seed}-{number}", dirs_exist_ok=True
                        )
            tried, accepted, refused, wrong = (
                tried + 1,
                accepted + taken,
                refused + (not fault and not taken),
                wrong + bool(fault),
            )
        shared[:] = _STATE.pack(numbers.stop, tried, accepted, refused, wrong, most_seconds, most_mb)


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _data_bytes() -> int:
    """What Linux counts against RLIMIT_DATA."""
    status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    return int(status.partition("VmData:")[2].split()[0]) << 10
