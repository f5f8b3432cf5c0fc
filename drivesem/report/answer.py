"""What a question says: one answer as JSON, CSV, Markdown, a picture, and tables on a terminal."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from drivesem.report.tables import Sheet, csv_text
from drivesem.report.terminal import Console
from scene_ir import files


@dataclass(frozen=True, slots=True)
class Answer:
    """One question's answer, in the folder `out`. name: of its files, such as explain.json.

    heading: of the Markdown page; data: the JSON; tables: CSVs by name, a mapping a line; sheets, words: the
    tables for people, and their columns of words (none: the first of each), which stand left; notes: below the
    tables. printed, printed_words: the same of a terminal, where it is shown others; lead, appendix: further
    Markdown lines, below the heading and at the end. picture: draws a PNG. failed: reasons by what could not be
    used, and `failure` the words between. only_json: with `--json` no tables.
    """

    out: Path
    name: str
    heading: str
    data: Mapping[str, Any]
    tables: Mapping[str, Sequence[Mapping[str, Any]]]
    sheets: Sequence[Sheet]
    notes: Sequence[str]
    words: Collection[str] = ()
    printed: Sequence[Sheet] | None = None
    printed_words: Collection[str] = ()
    lead: Sequence[str] = ()
    appendix: Sequence[str] = ()
    picture: Callable[[Path], object] | None = None
    failed: Mapping[str, str] = field(default_factory=dict)
    failure: str = "could not be used"
    only_json: bool = False

    def write(self) -> None:
        """All files."""
        files.write_json(self.out / f"{self.name}.json", self.data)
        for name, rows in self.tables.items():
            files.write_text(self.out / f"{name}.csv", csv_text(rows))
        files.write_text(self.out / f"{self.name}.md", self.markdown())
        if self.picture is not None:
            self.picture(self.out / f"{self.name}.png")

    def markdown(self) -> str:
        """The page."""
        lines = [f"# {self.heading}", "", *self.lead]
        lines += [f"![]({self.name}.png)", ""] if self.picture is not None else []
        for sheet in self.sheets:
            lines += [*sheet.markdown(self.words or sheet.columns[:1]), ""]
        return "\n".join([*lines, *(f"{note}\n" for note in self.notes), *self.appendix])

    def print(self, console: Console) -> None:
        """The tables, and what they mean."""
        for sheet in self.sheets if self.printed is None else self.printed:
            words = self.printed_words or self.words or sheet.columns[:1]
            console.print(*sheet.tables(console, words, **sheet.looks), sep="\n")
        for note in self.notes:
            console.print(note, soft_wrap=True)


def print_json(data: Mapping[str, Any]) -> None:
    """One line on standard output. ValueError where a number is not finite."""
    sys.stdout.write(json.dumps(data, allow_nan=False) + "\n")
