"""Damaged files of every format, given to the project's readers: does anything but one of its own errors come?

    python -m tools.fuzz --count 100000 --seed 1 --out fuzz        # inputs that show a fault go to fuzz/
    python -m tools.fuzz --formats "coco json,run" --count 2000
    python -m tools.fuzz --formats "coco json" --seed 1 --show 17  # one input again, with its whole traceback

Each input is a small valid folder of which a file or two are damaged, by format, seed and number alone. Readers
run in a child with limits: 5 s of the processor and 1 GB more memory than before. Faults are exceptions
other than the project's own errors, warnings, and a child that dies. Exit code 1 if there are any.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.table import Table

from scene_ir import files
from tools.fuzz.formats import FORMATS
from tools.fuzz.trial import FuzzOutcome, FuzzSubject, fuzz


def main(argv: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=2000, help="inputs of all formats together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--formats", default=",".join(FORMATS), help=f"of {', '.join(FORMATS)}")
    parser.add_argument("--out", type=Path, help="folder for inputs that showed a fault, and fuzz.json")
    parser.add_argument("--show", type=int, help="read this input of the format again, here, without limits")
    given = parser.parse_args(argv)
    forms = [FORMATS[name.strip()] for name in given.formats.split(",")]
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if given.show is not None:
        with (
            tempfile.TemporaryDirectory() as folder,
            FuzzSubject(forms[0], Path(folder)).damaged(given.seed, given.show) as root,
        ):
            forms[0].read(root)
        return 0
    every = sum(form.share for form in forms)
    counts = [math.ceil(given.count * form.share / every) for form in forms]
    outcomes = [
        fuzz(form, given.seed, count, given.out, verbose=True) for form, count in zip(forms, counts, strict=True)
    ]
    _print(outcomes, given.seed)
    if given.out is not None:
        files.write_json(
            given.out / "fuzz.json", {"seed": given.seed, "formats": [asdict(one) for one in outcomes]}
        )
    return int(any(one.wrong for one in outcomes))


def _print(outcomes: Sequence[FuzzOutcome], seed: int) -> None:
    table = Table(title=f"seed {seed}")
    for column in ("format", "inputs", "read", "refused", "wrong", "most s", "most MB"):
        table.add_column(column, justify="left" if column == "format" else "right")
    for one in outcomes:
        wrong = sum(map(len, one.wrong.values()))
        counts = (one.tried, one.accepted, one.refused, wrong)
        table.add_row(one.name, *(f"{n:,}" for n in counts), f"{one.seconds:.1f}", f"{one.mb:.0f}")
    Console().print(table)
    for one in outcomes:
        for fault, numbers in one.wrong.items():
            Console().print(
                f"{one.name}: {len(numbers)} x {fault}, first {numbers[0]}", soft_wrap=True, markup=False
            )


if __name__ == "__main__":
    sys.exit(main())
