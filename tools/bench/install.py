"""What drivesem costs before it finds anything: from a clone to the first report, megabytes, and each start."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from drivesem.bench.session import Columns
from drivesem.bench.timing import Spread
from drivesem.config.errors import UsageError
from tools.versions import ROOT, Run, StepResult, run_words

STEPS_TITLE, SIZES_TITLE, STARTS_TITLE = "From a clone to the first report", "What lies on the disk", "Starts"
STEPS: Columns = {"step": ("step", "step"), "seconds": ("s", "s"), "mb": ("MB on the disk", "MB")}
SIZES: Columns = {"package": ("package", "package"), "version": ("version", "version"), "mb": ("MB", "MB")}
STARTS: Columns = {
    "command": ("command", "command"), "repetitions": ("starts", "starts"), "first": ("first, s", "first"),
    "seconds": ("s", "s"), "iqr": ("IQR", "IQR"),
}  # fmt: skip
PATHS_TITLE = "From a clone to a report of your detector"
PATHS: Columns = {
    "detector": ("detector", "detector"), "lines": ("lines typed", "lines"), "install": ("install, s", "install"),
    "check": ("check, s", "check"), "attack": ("attack, s", "attack"), "minutes": ("minutes", "min"),
    "outcome": ("outcome", "outcome"),
}  # fmt: skip
PATHS_METHOD = (
    "For each detector of --detector, five lines are typed one after another into a fresh folder: git clone of this "
    "repository as committed; a virtual environment; pip install with the tested versions and the extra of the "
    "detector's kind; drivesem check; drivesem attack on two generated streets, which compiles the renderer's "
    "kernels first and writes the report. Seconds of the clock; install: the first three lines. pip's own settings "
    "and cache count. A line that fails ends the path, with its last message as the outcome."
)
EXTRAS = {
    "onnx": "onnx", "onnx-runtime": "onnx", "hf": "transformers", "ultralytics": "ultralytics",
    "torchvision": "torchvision",
}  # fmt: skip
"""Extras of drivesem that kinds of detectors need."""
METHOD = (
    "The README's words, typed one after another into a fresh folder: git clone of this repository as committed; "
    "a virtual environment; pip install with the tested versions, by pip's own settings and cache; the README's "
    "attack on ten generated streets, which compiles the renderer's kernels first. Seconds of the clock. MB are a "
    "million bytes of files. Packages: the largest of that environment by the files that each one lists, and "
    "drivesem by its wheel. Starts: commands in that environment, each a process of its own, from its start to "
    "its end; first: the first one, which may read files that the system has not cached; then the median and "
    "quartiles of the others. With --quick the environment is the one that measures."
)
ATTACK = ("attack", "--combo", "2")
ONE_FRAME = ("attack", "--limit", "1", "--steps", "1", "--nuisances", "off", "--no-confirm", "--workers", "1")
"""The least that attacks a frame."""
QUICK_STARTS, FULL_STARTS = 2, 7
_LARGEST = 8
_MB = 1e6
_SIZES = """
import json
from importlib.metadata import distributions
def size(one):
    paths = (one.locate_file(file) for file in one.files or ())
    return sum(path.stat().st_size for path in paths if path.is_file())
print(json.dumps([[one.name, one.version, size(one)] for one in distributions()]))
"""


@dataclass(frozen=True, slots=True)
class InstallStepRow:
    """A step."""

    step: str
    seconds: float
    mb: float
    """Of what it made."""


@dataclass(frozen=True, slots=True)
class SizeRow:
    """An installed package, or all others together."""

    package: str
    version: str
    mb: float


@dataclass(frozen=True, slots=True)
class StartRow:
    """A command that is started again and again."""

    command: str
    repetitions: int
    first: float
    """Seconds of the first time."""
    seconds: float
    """Of the others."""
    iqr: float
    """Of the others."""


@dataclass(frozen=True, slots=True)
class DetectorPathRow:
    """A new user's way to the report of one detector."""

    detector: str
    """As typed, without folders."""
    lines: int
    install: float
    """Seconds."""
    check: float
    """Seconds."""
    attack: float
    """Seconds; 0 if an earlier line failed."""
    minutes: float
    """Of all lines."""
    outcome: str
    """Report, or the message of the line that failed."""


Row = InstallStepRow | SizeRow | StartRow


def measure(quick: bool, run: Run = run_words) -> Iterator[Row]:
    """Rows of all three tables, as they are known. UsageError naming a step that fails."""
    starts = QUICK_STARTS if quick else FULL_STARTS
    with tempfile.TemporaryDirectory(prefix="drivesem-bench-") as made:
        work = Path(made)
        if quick:
            python, folder = sys.executable, ROOT
        else:
            python, folder = _own_python(work), work / "clone"
            yield from _steps(work, run)
        yield from _sizes(python, work, run)
        for words in _commands(python, work, attack=not quick):
            yield _start(words, starts, folder, run)


def _steps(work: Path, run: Run) -> Iterator[InstallStepRow]:
    """A clone, an environment, an installation, an attack, and their sum."""
    clone = work / "clone"
    words = [*_kernels(work), _own_python(work), "-m", "drivesem.cli", *ATTACK]
    attack = (f"drivesem {' '.join(ATTACK)}", words, clone, clone / "runs")
    rows: list[InstallStepRow] = []
    for name, words, folder, place in (*_installation(work), attack):
        before = _mb(place)
        taken, _ = _timed(words, folder, run)
        rows.append(InstallStepRow(name, round(taken, 1), round(_mb(place) - before, 1)))
        yield rows[-1]
    yield InstallStepRow(
        "in all", round(sum(row.seconds for row in rows), 1), round(sum(row.mb for row in rows), 1)
    )


def measure_paths(detectors: Sequence[str], run: Run = run_words) -> Iterator[DetectorPathRow]:
    """A row for each detector, as they are known."""
    for detector in detectors:
        with tempfile.TemporaryDirectory(prefix="drivesem-bench-") as made:
            yield _detector_path(detector, Path(made), run)


def _detector_path(detector: str, work: Path, run: Run) -> DetectorPathRow:
    program = [*_kernels(work), _own_python(work), "-m", "drivesem.cli"]
    given, out = ["--detector", detector], work / "run"
    steps = [
        *(
            ("install", words, folder)
            for _, words, folder, _ in _installation(work, EXTRAS.get(detector.partition(":")[0]))
        ),
        ("check", [*program, "check", *given], Path.cwd()),
        ("attack", [*program, "attack", *given, "--limit", "2", "--out", str(out)], Path.cwd()),
    ]
    seconds, outcome = dict.fromkeys(("install", "check", "attack"), 0.0), "report"
    for part, words, folder in steps:
        start = time.perf_counter()
        failed = run(words, folder).failed
        seconds[part] += time.perf_counter() - start
        if failed or (part == "attack" and not (out / "report.html").is_file()):
            outcome = f"{part}: {failed or 'no report'}"
            break
    minutes = round(sum(seconds.values()) / 60, 1)
    rounded = {part: round(value, 1) for part, value in seconds.items()}
    kind, colon, rest = detector.partition(":")
    return DetectorPathRow(
        f"{kind}{colon}{Path(rest).name if colon else ''}", len(steps), **rounded, minutes=minutes, outcome=outcome
    )


def _installation(work: Path, extra: str | None = None) -> list[tuple[str, Sequence[str], Path, Path]]:
    """Name, words, folder and place of what is made: a clone, an environment, an installation."""
    clone, environment = work / "clone", work / "environment"
    target = f".[{extra}]" if extra else "."
    install = [_own_python(work), "-m", "pip", "install", "-q", "-c", "constraints.txt", "-e", target]
    return [
        ("git clone", ["git", "clone", "-q", str(ROOT), str(clone)], work, clone),
        ("python3 -m venv", [sys.executable, "-m", "venv", str(environment)], work, environment),
        (f"pip install -c constraints.txt -e {target}", install, clone, environment),
    ]


def _own_python(work: Path) -> str:
    return str(work / "environment" / "bin" / "python")


def _kernels(work: Path) -> list[str]:
    """Environment assignment before a command: its own cache of compiled kernels."""
    return ["env", f"WARP_CACHE_PATH={work / 'kernels'}"]


def _sizes(python: str, work: Path, run: Run) -> Iterator[SizeRow]:
    """drivesem's wheel, the largest packages, the others."""
    wheels = work / "wheels"
    _timed([python, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(wheels), str(ROOT)], work, run)
    _, output = _timed([python, "-c", _SIZES], work, run)
    found: list[tuple[str, str, int]] = [(name, version, size) for name, version, size in json.loads(output)]
    own = next((version for name, version, _ in found if name == "drivesem"), "")
    yield SizeRow("drivesem, its wheel", own, round(_mb(wheels), 1))
    ordered = sorted((one for one in found if one[0] != "drivesem"), key=lambda one: -one[2])
    for name, version, size in ordered[:_LARGEST]:
        yield SizeRow(name, version, round(size / _MB, 1))
    rest = ordered[_LARGEST:]
    yield SizeRow(f"{len(rest)} others", "", round(sum(size for *_, size in rest) / _MB, 1))


def _commands(python: str, work: Path, attack: bool) -> Iterator[tuple[str, Sequence[str]]]:
    """What is started: its name, its words."""
    program = [python, "-m", "drivesem.cli"]
    yield "python -c 'import drivesem'", [python, "-c", "import drivesem"]
    yield "drivesem --version", [*program, "--version"]
    yield "drivesem", program
    yield "drivesem attack --help", [*program, "attack", "--help"]
    if attack:
        words = [*_kernels(work), *program, *ONE_FRAME, "--no-resume", "--out", str(work / "again")]
        yield f"drivesem {' '.join(ONE_FRAME)}", words


def _start(command: tuple[str, Sequence[str]], repetitions: int, folder: Path, run: Run) -> StartRow:
    name, words = command
    first, *others = (_timed(words, folder, run)[0] for _ in range(repetitions))
    spread = Spread.from_values(others)
    return StartRow(name, repetitions, round(first, 2), round(spread.median, 2), round(spread.iqr, 2))


def _timed(words: Sequence[str], folder: Path, run: Run) -> tuple[float, str]:
    """Seconds, and standard output."""
    start = time.perf_counter()
    ended: StepResult = run(words, folder)
    if ended.failed:
        raise UsageError("bench install", "steps that work", f"{' '.join(words)[:200]}: {ended.failed}")
    return time.perf_counter() - start, ended.output


def _mb(path: Path) -> float:
    """MB of a folder's files; 0 where there is none."""
    return sum(one.lstat().st_size for one in path.rglob("*") if one.is_file() and not one.is_symlink()) / _MB
