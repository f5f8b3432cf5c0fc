"""What a command costs in this checkout and in another one, measured in turn.

    git worktree add --detach ../before 24a3e74
    python -m tools.compare_checkouts ../before -- attack --combo 2 --dataset kitti --root KITTI --limit 1 --out {out}

The words after -- are `drivesem`'s. {out} is a fresh folder each time; --keep DIR keeps the folders of the last
round as DIR/before and DIR/now. Seconds are the processor's, of all threads and processes that the command starts:
other work on the machine lengthens them by tenths, where it multiplies those of the clock. Each round runs both,
the order swapped every time.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from drivesem.config.errors import UsageError

ROOT = Path(__file__).resolve().parents[1]
OUT = "{out}"
_START = "import sys; from drivesem.cli import main; sys.exit(main())"
"""What the installed `drivesem` runs."""


@dataclass(frozen=True, slots=True)
class RunTime:
    """Seconds of one run: the processor's and the clock's."""

    processor: float
    clock: float


def run(checkout: Path, words: Sequence[str], out: Path) -> RunTime:
    """One run of a checkout's `drivesem`. UsageError with its last line where it ends with another code than 0 or
    1, a check that failed.
    """
    command_words = [word.replace(OUT, str(out)) for word in words]
    before, start = os.times(), time.perf_counter()
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    whole = [sys.executable, "-c", _START, *command_words]
    done = subprocess.run(whole, capture_output=True, text=True, check=False, env=environment, cwd=checkout)
    clock, after = time.perf_counter() - start, os.times()
    if done.returncode not in (0, 1):
        last = (done.stderr.strip().splitlines() or ["nothing"])[-1]
        raise UsageError(f"drivesem of {checkout}", "a command that works", last)
    processor = after.children_user + after.children_system - before.children_user - before.children_system
    return RunTime(processor, clock)


def compare(before: Path, words: Sequence[str], rounds: int, keep: Path | None) -> dict[str, list[RunTime]]:
    """`rounds` runs of each checkout, in turn."""
    checkouts = {"before": before.resolve(), "now": ROOT}
    spent: dict[str, list[RunTime]] = {name: [] for name in checkouts}
    for number in range(rounds):
        for name in sorted(checkouts, reverse=bool(number % 2)):
            with tempfile.TemporaryDirectory(prefix="drivesem-compare-") as folder:
                out = Path(folder) / "out"
                spent[name].append(run(checkouts[name], words, out))
                if keep is not None and number == rounds - 1 and out.exists():
                    shutil.copytree(out, keep / name, dirs_exist_ok=True)
    return spent


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point: prints both medians and their ratio. Exit code 2 for a command that does not work."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.compare_checkouts", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("before", type=Path, help="another checkout")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--keep", type=Path, help="folder for {out} of the last round")
    parser.add_argument("words", nargs="+", help="a command of drivesem, after --")
    known = parser.parse_args(argv)
    try:
        if not (known.before / "drivesem" / "cli.py").is_file():
            raise UsageError("before", "a checkout of drivesem", str(known.before))
        if known.rounds < 1:
            raise UsageError("--rounds", "at least 1", known.rounds)
        spent = compare(known.before, known.words, known.rounds, known.keep)
    except UsageError as error:
        sys.stderr.write(f"drivesem: {error}\n")
        return 2
    medians = {name: median(run.processor for run in runs) for name, runs in spent.items()}
    for name, runs in spent.items():
        each = ", ".join(f"{run.processor:.2f}" for run in runs)
        clock = median(run.clock for run in runs)
        print(f"{name:6} {medians[name]:8.2f} s of the processor ({each}), {clock:.1f} s of the clock")
    print(f"now / before: {medians['now'] / medians['before']:.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
