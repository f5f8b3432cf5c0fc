"""Tables for people, on a terminal and in Markdown."""

from __future__ import annotations

import csv
import io
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
        self,
        words: Collection[str],
        unbroken: Collection[str] = (),
        widths: Sequence[int] | None = None,
        **looks: Any,
    ) -> Table:
        """The same for a terminal. unbroken: columns that are never wrapped; widths: of the columns, characters,
        by default as rich finds; looks: of its Table.
        """
        table = Table(title=self.title, title_justify="left", **looks)
        for place, name in enumerate(self.columns):
            side, width = "left" if name in words else "right", None if widths is None else widths[place]
            table.add_column(name, justify=side, no_wrap=name in unbroken, overflow="fold", width=width)
        for row in self.rows:
            table.add_row(*row)
        return table

    def tables(
        self, console: Console, words: Collection[str], unbroken: Collection[str] = (), **looks: Any
    ) -> list[Table]:
        """`table`, or, where that does not fit the terminal, one in which no word and no number is broken; or,
        where there is no room for that, several of some columns each, all of which begin with the columns of words
        that this one begins with.
        """

        def size(table: Table) -> Measurement:
            return Measurement.get(console, console.options.update(width=_ROOMY), table)

        def laid(places: Sequence[int], more: str = "") -> Table | None:
            """Of some columns; None where there is no room."""
            part = self._of(places, more)
            least, most = zip(*(part._room(i, words, unbroken) for i in range(len(places))), strict=True)
            spare = console.width - size(part.table(words, unbroken, least, **looks)).maximum
            if spare < 0:
                return None
            wanted = max(sum(most) - sum(least), 1)
            widths = [a + min(b - a, spare * (b - a) // wanted) for a, b in zip(least, most, strict=True)]
            return part.table(words, unbroken, widths, **looks)

        whole = self.table(words, unbroken, **looks)
        if size(whole).maximum <= console.width or not self.columns:
            return [whole]
        everything = [*range(len(self.columns))]
        first = next((i for i in everything if self.columns[i] not in words), len(everything))
        parts = [everything]
        if laid(everything) is None:
            parts = [[*range(first)]]
            for place in everything[first:]:
                if len(parts[-1]) > first and laid([*parts[-1], place]) is None:
                    parts.append([*range(first)])
                parts[-1].append(place)
        found = [laid(part, ", further columns" if i else "") for i, part in enumerate(parts)]
        known = [table for table in found if table is not None]
        return known if len(known) == len(parts) else [whole]

    def _room(self, place: int, words: Collection[str], unbroken: Collection[str]) -> tuple[int, int]:
        """Characters that a column takes at least, and in which none of its lines is wrapped. Columns of numbers
        have them in one line, below a heading that may be wrapped.
        """
        name, cells = self.columns[place], [row[place] for row in self.rows]
        longest, lines = _longest(name.split()), _longest(cells)
        if name in words and name not in unbroken:
            least = max(longest, _longest(word for cell in cells for word in cell.split()), 1)
            return least, max(least, lines, _longest([name]))
        if name in unbroken:
            longest = _longest([name])
        return max(longest, lines, 1), max(longest, lines, 1)

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
    """Rows as CSV, with a heading of all columns that any of them has."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
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
