"""Run commands on hostile inputs: each must fail with one clear line, soon, and in little memory.

    python -m tools.hostile                        # all; --json: outcomes as JSON on standard output
    python -m tools.hostile --only signals         # cases with this in family or name
    python -m tools.hostile --only bomb --work DIR # DIR keeps inputs and outputs

A case passes with the expected exit code (2; 1 for `verify`; 130 and 143 if interrupted) and a last line on standard
error that begins with `drivesem: ` and names file or setting, field, expected and found value; `verify` names them
in its list of differences. A case fails with a traceback or warning, more than 5 s of processor time or 1 GB, a
file made by foreign code, or a process that lives 2 s after a signal. Exit code 1 if a case fails. Linux only.
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

from drivesem.reporting.tables import Console, progress_bar
from tools.hostile.cases import FAMILIES, cases
from tools.hostile.inputs import ValidInputs
from tools.hostile.trial import CaseResult, HostileCase, error_lines, judge, notes, run

_MAX_OUTPUT_LINES = 12
"""Lines of output shown of a failed case."""


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; exit code 1 if a case fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="part of a family or name")
    parser.add_argument("--json", action="store_true", help="print outcomes as JSON")
    parser.add_argument("--work", type=Path, help="folder to work in and keep; by default a temporary one")
    arguments = parser.parse_args(argv)
    chosen = [case for case in cases() if arguments.only in case.family or arguments.only in case.name]
    if not chosen:
        parser.error(f"--only: no case has {arguments.only!r} in its name")
    console = Console(stderr=arguments.json)
    with tempfile.TemporaryDirectory() as temporary:
        work = (arguments.work or Path(temporary)).resolve()
        work.mkdir(parents=True, exist_ok=True)
        ground = ValidInputs(work)
        outcomes: list[tuple[HostileCase, CaseResult, list[str]]] = []
        with progress_bar(Console(stderr=True), keep=False) as progress:
            task = progress.add_task("commands", total=len(chosen))
            for number, case in enumerate(chosen):
                done = run(case, work / f"case-{number:03d}", ground)
                outcomes.append((case, done, judge(case, done)))
                progress.advance(task)
    console.print(table(outcomes))
    for case, done, wrong in outcomes:
        if wrong:
            console.print(failure(case, done, wrong), soft_wrap=True, markup=False, highlight=False)
    count = sum(bool(wrong) for _, _, wrong in outcomes)
    console.print(f"{len(outcomes) - count} of {len(outcomes)} clean")
    if arguments.json:
        json.dump([row(case, done, wrong) for case, done, wrong in outcomes], sys.stdout, indent=1)
    return int(count > 0)


def table(outcomes: Sequence[tuple[HostileCase, CaseResult, list[str]]]) -> Table:
    """Counts by family, with the slowest and largest case among those with limits."""
    columns = ("family", "cases", "clean", "most s", "of", "most MB", "of ")
    summary = Table()
    for column in columns:
        summary.add_column(column, justify="left" if column in ("family", "of", "of ") else "right")
    for family in FAMILIES:
        ours = [one for one in outcomes if one[0].family == family]
        if not ours:
            continue
        limited = [one for one in ours if not one[0].unlimited]
        slowest = max(limited, key=lambda one: one[1].seconds, default=None)
        largest = max(limited, key=lambda one: one[1].mb, default=None)
        clean = sum(not wrong for _, _, wrong in ours)
        seconds = (f"{slowest[1].seconds:.1f}", slowest[0].name) if slowest else ("", "")
        memory = (f"{largest[1].mb:.0f}", largest[0].name) if largest else ("", "")
        summary.add_row(family, str(len(ours)), str(clean), *seconds, *memory)
    ended = [done.ended_s for case, done, _ in outcomes if case.signals is not None]
    if ended:
        summary.caption = f"after a signal, at most {max(ended):.1f} s until all processes were gone"
    return summary


def failure(case: HostileCase, done: CaseResult, wrong: Sequence[str]) -> str:
    """Describe a failed case.

    Args:
        case: The case.
        done: Its outcome.
        wrong: Its defects.
    """
    lines = [f"{case.family}: {case.name}", f"  $ {case.words}", *(f"  {line}" for line in wrong)]
    output = [line for line in (*done.out.splitlines()[-3:], *done.err.splitlines()) if line.strip()]
    return "\n".join([*lines, *(f"  | {line}" for line in output[-_MAX_OUTPUT_LINES:])])


def row(case: HostileCase, done: CaseResult, wrong: Sequence[str]) -> dict[str, Any]:
    """A case as JSON.

    Args:
        case: The case.
        done: Its outcome.
        wrong: Its defects.
    """
    facts = {key: value for key, value in asdict(done).items() if key not in ("out", "err")}
    names = {"name": case.name, "family": case.family, "command": case.words}
    return names | facts | {"errors": error_lines(done), "notes": notes(done), "wrong": list(wrong)}


if __name__ == "__main__":
    sys.exit(main())
