"""Tables for people, on a terminal and in Markdown."""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rich.table import Table


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

    def table(self, words: Collection[str], unbroken: Collection[str] = (), **looks: Any) -> Table:
        """The same for a terminal. unbroken: columns that are never wrapped; looks: of rich's Table."""
        table = Table(title=self.title, title_justify="left", **looks)
        for name in self.columns:
            side = "left" if name in words else "right"
            table.add_column(name, justify=side, no_wrap=name in unbroken, overflow="fold")
        for row in self.rows:
            table.add_row(*row)
        return table


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
