"""Tables for people, on a terminal and in Markdown."""

from __future__ import annotations

import csv
import io
import textwrap
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from rich.cells import cell_len
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

_ROOMY = 10_000
"""Characters in which any table has room."""


@dataclass(frozen=True, slots=True)
class Sheet:
    """One table: its title, its columns, and rows of text. looks: how a terminal shows it, as `table` takes it."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    looks: Mapping[str, Any] = field(default_factory=dict)

    def markdown(self, words: Collection[str]) -> list[str]:
        """Lines: a heading, and the table. words: columns of words; the others hold numbers."""
        sides = ("---" if name in words else "---:" for name in self.columns)
        lines = (self.columns, sides, *self.rows)
        cells = [[cell.replace("|", "\\|").replace("\n", ", ") for cell in line] for line in lines]
        return [f"## {self.title}", "", *(f"| {' | '.join(line)} |" for line in cells)]

    def table(
        self, words: Collection[str], unbroken: Collection[str] = (), least: bool = False, **looks: Any
    ) -> Table:
        """The same for a terminal: columns of words are wrapped, those of numbers are not. unbroken: further ones
        that are not; least: whether these keep their width where there is no room for it; looks: of rich's Table.
        """
        table = Table(title=self.title, title_justify="left", **looks)
        for place, name in enumerate(self.columns):
            wrapped = name in words and name not in unbroken
            # A heading takes lines that are no wider than what is below it, where its words allow.
            widest = max(_longest(row[place] for row in self.rows), _longest(name.split()), 1)
            heading = name if wrapped else textwrap.fill(name, widest, break_on_hyphens=False)
            kept = widest if least and not wrapped else None
            side = "left" if name in words else "right"
            table.add_column(heading, justify=side, no_wrap=not wrapped, overflow="fold", min_width=kept)
        for row in self.rows:
            table.add_row(*row)
        return table

    def tables(self, console: Console, words: Collection[str], **looks: Any) -> list[Table]:
        """`table`, or, where words and numbers would break for want of room, several of some columns each, all of
        which begin with the columns of words that this one begins with.
        """
        first = next((i for i, name in enumerate(self.columns) if name not in words), len(self.columns))
        whole, parts = [*range(len(self.columns))], [[*range(first)]]

        def fits(places: Sequence[int]) -> bool:
            table = self._of(places).table(words, least=True, **looks)
            roomy = console.options.update(width=_ROOMY)
            return Measurement.get(console, roomy, table).minimum <= console.width

        if not fits(whole):
            for place in whole[first:]:
                if len(parts[-1]) > first and not fits([*parts[-1], place]):
                    parts.append([*range(first)])
                parts[-1].append(place)
        if len(parts) == 1 or not all(map(fits, parts)):
            parts = [whole]
        found = (self._of(part, ", further columns" if i else "") for i, part in enumerate(parts))
        return [part.table(words, **looks) for part in found]

    def _of(self, places: Sequence[int], more: str = "") -> Sheet:
        columns = tuple(self.columns[i] for i in places)
        return replace(
            self,
            title=self.title + more,
            columns=columns,
            rows=tuple(tuple(row[i] for i in places) for row in self.rows),
        )


def _longest(texts: Iterable[str]) -> int:
    """Of lines, in characters."""
    return max((cell_len(line) for text in texts for line in text.splitlines()), default=0)


def csv_text(rows: Sequence[Mapping[str, Any]], line_end: str = "\n") -> str:
    """Rows of the same columns as CSV, with a heading."""
    columns = list(rows[0])
    return csv_table(columns, ([row.get(name) for name in columns] for row in rows), line_end)


def csv_table(columns: Sequence[str], rows: Iterable[Iterable[Any]], line_end: str = "\n") -> str:
    """Cells below a heading as CSV."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator=line_end)
    writer.writerow(columns)
    writer.writerows(rows)
    return buffer.getvalue()


def number_of(number: int, word: str, words: str | None = None) -> str:
    """How many there are of something: 1 frame, 2 frames. words: the plural, if it isn't the word with an s."""
    return f"{number} {word if number == 1 else words or word + 's'}"


def percent(value: float | None) -> str:
    """A fraction as a percentage; a dash where there is none (COCO's -1 too)."""
    return "-" if value is None or value < 0 else f"{100 * value:.2f}"
