"""Inputs that were made to break a command, typed as a user types it: one clear line, soon, and in little memory?

    python -m tools.hostile                        # all; --json: what each did, on standard output
    python -m tools.hostile --only signals         # those whose family or name has this in it
    python -m tools.hostile --only bomb --work DIR # DIR keeps what each was given, and what it said

Right is the exit code (2; 1 of `verify`; 130 and 143 of what is interrupted) and one line on standard error that
begins with `drivesem: ` and says file or setting, field, what was expected and what was found; it is the last one.
Of `verify` it is a line of its differences, on standard output. The announcement of code that a setting names
begins alike, and is no error; bars of progress and notes begin otherwise. Wrong is any traceback or warning, more
than 5 s of the processor or 1 GB, a file that foreign code would make, and whatever lives on 2 s after a signal.
Exit code 1 where anything is wrong. Linux alone: processes are found in /proc.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.table import Table

from drivesem.report.progress import progress_bar
from drivesem.report.terminal import Console
from tools.hostile.cases import FAMILIES, cases
from tools.hostile.inputs import Ground
from tools.hostile.trial import Case, Done, judge, notes, run, told

_TOLD_LINES = 12
"""Of standard error, where something is wrong."""


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; exit code 1 where anything is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="part of a family or of a name")
    parser.add_argument("--json", action="store_true", help="what each did, as JSON on standard output")
    parser.add_argument("--work", type=Path, help="folder to work in, which stays; by default a temporary one")
    given = parser.parse_args(argv)
    chosen = [case for case in cases() if given.only in case.family or given.only in case.name]
    if not chosen:
        parser.error(f"--only: no case has {given.only!r} in its name")
    console = Console(stderr=given.json)
    with tempfile.TemporaryDirectory() as temporary:
        work = (given.work or Path(temporary)).resolve()
        work.mkdir(parents=True, exist_ok=True)
        ground = Ground(work)
        found: list[tuple[Case, Done, list[str]]] = []
        with progress_bar(Console(stderr=True), stays=False) as progress:
            task = progress.add_task("commands", total=len(chosen))
            for number, case in enumerate(chosen):
                done = run(case, work / f"case-{number:03d}", ground)
                found.append((case, done, judge(case, done)))
                progress.advance(task)
    console.print(table(found))
    for case, done, wrong in found:
        if wrong:
            console.print(failure(case, done, wrong), soft_wrap=True, markup=False, highlight=False)
    count = sum(bool(wrong) for _, _, wrong in found)
    console.print(f"{len(found) - count} of {len(found)} clean")
    if given.json:
        json.dump([row(case, done, wrong) for case, done, wrong in found], sys.stdout, indent=1)
    return int(count > 0)


def table(found: Sequence[tuple[Case, Done, list[str]]]) -> Table:
    """By families: how many, and the most that one took of those that are to refuse something."""
    columns = ("family", "cases", "clean", "most s", "of", "most MB", "of ")
    shown = Table()
    for column in columns:
        shown.add_column(column, justify="left" if column in ("family", "of", "of ") else "right")
    for family in FAMILIES:
        ours = [one for one in found if one[0].family == family]
        if not ours:
            continue
        limited = [one for one in ours if not one[0].unlimited]
        slowest = max(limited, key=lambda one: one[1].seconds, default=None)
        largest = max(limited, key=lambda one: one[1].mb, default=None)
        clean = sum(not wrong for _, _, wrong in ours)
        seconds = (f"{slowest[1].seconds:.1f}", slowest[0].name) if slowest else ("", "")
        memory = (f"{largest[1].mb:.0f}", largest[0].name) if largest else ("", "")
        shown.add_row(family, str(len(ours)), str(clean), *seconds, *memory)
    ended = [done.ended_s for case, done, _ in found if case.signals is not None]
    if ended:
        shown.caption = f"after a signal, at most {max(ended):.1f} s until all processes were gone"
    return shown


def failure(case: Case, done: Done, wrong: Sequence[str]) -> str:
    """What is wrong with one, in full."""
    lines = [f"{case.family}: {case.name}", f"  $ {case.words}", *(f"  {line}" for line in wrong)]
    said = [line for line in (*done.out.splitlines()[-3:], *done.err.splitlines()) if line.strip()]
    return "\n".join([*lines, *(f"  | {line}" for line in said[-_TOLD_LINES:])])


def row(case: Case, done: Done, wrong: Sequence[str]) -> dict[str, Any]:
    """One case, for JSON."""
    facts = {key: value for key, value in asdict(done).items() if key not in ("out", "err")}
    names = {"name": case.name, "family": case.family, "command": case.words}
    return names | facts | {"told": told(done), "notes": notes(done), "wrong": list(wrong)}


if __name__ == "__main__":
    sys.exit(main())
