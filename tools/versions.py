"""Does drivesem work with the oldest and the newest of what it says it works with?

    python -m tools.versions                                           # this Python, lowest and highest versions
    python -m tools.versions --python python3.11,python3.13 --tests    # also the quick tests
    python -m tools.versions --resolve                                 # only: do the versions go together?

For each Python and each of "lowest" (each dependency of pyproject.toml at its lower bound) and "highest" (whatever
pip finds), a wheel of the working tree is installed into a fresh virtual environment. From an empty folder it is
asked for `drivesem doctor`, and for an attack on one generated street. Exit code 1 where anything fails.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from scene_ir import files

ROOT = Path(__file__).resolve().parents[1]
ATTACK = "attack --limit 1 --steps 1 --combo 1 --nuisances off --workers 1 --out run"
SETS = ("lowest", "highest")
_MINUTES = 60
"""A step that takes longer is stopped."""
Run = Callable[[Sequence[str], Path], str]
"""Runs words in a folder; why they failed, in a line, or nothing."""


@dataclass(frozen=True)
class Outcome:
    """What came of one Python and one set of versions. failed: the step that failed, and why; empty where none."""

    python: str
    versions: str
    failed: str


def lowest(pyproject: Path) -> list[str]:
    """Each dependency at its lower bound, `name==version`. ValueError for one without."""
    wanted = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]["dependencies"]
    pins: list[str] = []
    for text in wanted:
        match = re.match(r"([A-Za-z0-9_.-]+)\s*>=\s*([0-9][0-9a-z.]*)", text)
        if match is None:
            raise ValueError(f"dependency {text!r}: expected a lower bound, name>=version")
        pins.append(f"{match[1]}=={match[2]}")
    return pins


def run_words(words: Sequence[str], folder: Path) -> str:
    """See `Run`."""
    own = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    try:
        ended = subprocess.run(words, cwd=folder, env=own, capture_output=True, text=True, timeout=60 * _MINUTES)
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    lines = [line for line in (ended.stderr or ended.stdout).splitlines() if line.strip()]
    return "" if ended.returncode == 0 else (lines[-1] if lines else f"exit code {ended.returncode}")


def tried(python: str, versions: str, wheel: str, work: Path, args: argparse.Namespace, run: Run) -> Outcome:
    """One Python and one set of versions. wheel: to install, or the tree."""
    environment, empty = work / "environment", work / "empty"
    empty.mkdir(parents=True)
    own = str(environment / "bin" / "python")
    install = [own, "-m", "pip", "install", "-q"]
    if versions == "lowest":
        files.write_text(work / "lowest.txt", "".join(f"{pin}\n" for pin in lowest(ROOT / "pyproject.toml")))
        install += ["-c", str(work / "lowest.txt")]
    install += ["--dry-run"] if args.resolve else []
    steps = {
        "venv": [python, "-m", "venv", str(environment)],
        "install": [*install, f"{wheel}[test]" if args.tests else wheel],
    }
    if not args.resolve:
        steps["doctor"] = [own, "-m", "drivesem.cli", "doctor"]
        steps["attack"] = [own, "-m", "drivesem.cli", *ATTACK.split()]
    if args.tests and not args.resolve:
        steps["tests"] = [own, "-m", "pytest", "-q", "-m", "quick", "-p", "no:cacheprovider", str(ROOT / "tests")]
    for name, words in steps.items():
        reason = run(words, ROOT if name == "tests" else empty)
        if reason:
            return Outcome(python, versions, f"{name}: {reason}")
    return Outcome(python, versions, "")


def main(argv: Sequence[str] | None = None, run: Run = run_words) -> int:
    """Entry point; exit code 0, or 1 where anything fails."""
    parser = argparse.ArgumentParser(prog="python -m tools.versions", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--python", default=sys.executable, help="interpreters, with commas")
    parser.add_argument("--versions", default=",".join(SETS), help="lowest, highest, or both with a comma")
    parser.add_argument("--tests", action="store_true", help="also run the quick tests of the tree")
    parser.add_argument("--resolve", action="store_true", help="only ask pip whether the versions go together")
    parser.add_argument("--out", help="JSON file for the outcomes")
    args = parser.parse_args(argv)
    if not set(args.versions.split(",")) <= set(SETS):
        parser.error(f"--versions: expected some of {', '.join(SETS)}, found {args.versions}")
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        reason = run([sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(work), str(ROOT)], work)
        if reason:
            sys.stderr.write(f"the wheel cannot be made: {reason}\n")
            return 1
        wheel = next((str(path) for path in work.glob("*.whl")), str(ROOT))
        for python in args.python.split(","):
            for versions in args.versions.split(","):
                place = work / f"{Path(python).name}-{versions}"
                outcome = tried(python, versions, wheel, place, args, run)
                outcomes.append(outcome)
                sys.stdout.write(f"{python}, {versions}: {outcome.failed or 'works'}\n")
    if args.out:
        files.write_json(Path(args.out), [asdict(outcome) for outcome in outcomes])
    return 1 if any(outcome.failed for outcome in outcomes) else 0


if __name__ == "__main__":
    sys.exit(main())
