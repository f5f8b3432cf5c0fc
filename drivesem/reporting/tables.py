"""Results of an analysis as JSON, CSV, Markdown, a picture and tables; console output and progress bars."""

from __future__ import annotations

import csv
import io
import json
import os
import sys
import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import rich.console
from rich.cells import cell_len
from rich.measure import Measurement
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from scene_ir import files
from scene_ir.errors import make_printable

_UNLIMITED_WIDTH = 10_000
"""Characters; wide enough for any table."""


@dataclass(frozen=True, slots=True)
class ReportTable:
    """A table of text for people."""

    title: str
    """Heading."""
    columns: tuple[str, ...]
    """Names of the columns."""
    rows: tuple[tuple[str, ...], ...]
    """A cell per column."""
    rich_options: Mapping[str, Any] = field(default_factory=dict)
    """Keyword arguments of `fit_to_console` for this table."""

    def to_markdown(self, text_columns: Collection[str]) -> list[str]:
        """Return a heading and the table as lines. Columns are right-aligned unless they are text columns."""
        sides = ("---" if name in text_columns else "---:" for name in self.columns)
        lines = (self.columns, sides, *self.rows)
        cells = [[cell.replace("|", "\\|").replace("\n", ", ") for cell in line] for line in lines]
        return [f"## {self.title}", "", *(f"| {' | '.join(line)} |" for line in cells)]

    def to_rich(
        self,
        text_columns: Collection[str],
        unbroken: Collection[str] = (),
        widths: Sequence[int] | None = None,
        **rich_options: Any,
    ) -> Table:
        """Return the table for a terminal.

        Args:
            text_columns: Columns that are left-aligned.
            unbroken: Columns that are never wrapped.
            widths: Width of each column in characters; chosen by rich by default.
            rich_options: Further arguments of `rich.table.Table`.
        """
        table = Table(title=self.title, title_justify="left", **rich_options)
        for i, name in enumerate(self.columns):
            side, width = "left" if name in text_columns else "right", None if widths is None else widths[i]
            table.add_column(name, justify=side, no_wrap=name in unbroken, overflow="fold", width=width)
        for row in self.rows:
            table.add_row(*row)
        return table

    def fit_to_console(
        self, console: Console, text_columns: Collection[str], unbroken: Collection[str] = (), **rich_options: Any
    ) -> list[Table]:
        """Return tables that fit the width of a console without breaking words or numbers.

        This is `to_rich` if that fits, else the same with narrower columns, else several tables that all begin
        with the leading text columns.

        Args:
            console: Where the tables will be printed.
            text_columns: Columns that are left-aligned.
            unbroken: Columns that are never wrapped.
            rich_options: Further arguments of `rich.table.Table`.
        """

        def measure(table: Table) -> Measurement:
            return Measurement.get(console, console.options.update(width=_UNLIMITED_WIDTH), table)

        def fit_columns(indices: Sequence[int], title_suffix: str = "") -> Table | None:
            part = self._select_columns(indices, title_suffix)
            lows, highs = zip(
                *(part._column_widths(i, text_columns, unbroken) for i in range(len(indices))), strict=True
            )
            spare = console.width - measure(part.to_rich(text_columns, unbroken, lows, **rich_options)).maximum
            if spare < 0:
                return None
            wanted = max(sum(highs) - sum(lows), 1)
            widths = [a + min(b - a, spare * (b - a) // wanted) for a, b in zip(lows, highs, strict=True)]
            return part.to_rich(text_columns, unbroken, widths, **rich_options)

        whole = self.to_rich(text_columns, unbroken, **rich_options)
        if measure(whole).maximum <= console.width or not self.columns:
            return [whole]
        every_column = [*range(len(self.columns))]
        leading = next((i for i in every_column if self.columns[i] not in text_columns), len(every_column))
        parts = [every_column]
        if fit_columns(every_column) is None:
            parts = [[*range(leading)]]
            for i in every_column[leading:]:
                if len(parts[-1]) > leading and fit_columns([*parts[-1], i]) is None:
                    parts.append([*range(leading)])
                parts[-1].append(i)
        fitted = [fit_columns(part, ", further columns" if i else "") for i, part in enumerate(parts)]
        tables = [table for table in fitted if table is not None]
        return tables if len(tables) == len(parts) else [whole]

    def _column_widths(
        self, column: int, text_columns: Collection[str], unbroken: Collection[str]
    ) -> tuple[int, int]:
        """Return the least width of a column, and the width that wraps none of its lines, in characters. Numbers
        are never wrapped; their heading may be.
        """
        name, cells = self.columns[column], [row[column] for row in self.rows]
        longest_word, longest_line = _longest_line(name.split()), _longest_line(cells)
        if name in text_columns and name not in unbroken:
            least = max(longest_word, _longest_line(word for cell in cells for word in cell.split()), 1)
            return least, max(least, longest_line, _longest_line([name]))
        if name in unbroken:
            longest_word = _longest_line([name])
        return max(longest_word, longest_line, 1), max(longest_word, longest_line, 1)

    def _select_columns(self, indices: Sequence[int], title_suffix: str = "") -> ReportTable:
        return replace(
            self,
            title=self.title + title_suffix,
            columns=tuple(self.columns[i] for i in indices),
            rows=tuple(tuple(row[i] for i in indices) for row in self.rows),
        )


def _longest_line(texts: Iterable[str]) -> int:
    """Length of the longest line, characters."""
    return max((cell_len(line) for text in texts for line in text.splitlines()), default=0)


@dataclass(frozen=True, slots=True)
class AnalysisReport:
    """The result of one analysis, to be written to files and printed."""

    out: Path
    """Output folder."""
    name: str
    """Base name of the files, such as explain for explain.json."""
    heading: str
    """Title of the Markdown page."""
    data: Mapping[str, Any]
    """Contents of the JSON file, and what `--json` prints."""
    csv_tables: Mapping[str, Sequence[Mapping[str, Any]]]
    """CSV files by base name; a mapping per line."""
    tables: Sequence[ReportTable]
    """Tables of the Markdown page."""
    notes: Sequence[str]
    """Explanations below the tables."""
    text_columns: Collection[str] = ()
    """Columns that are left-aligned; by default the first of each table."""
    printed_tables: Sequence[ReportTable] | None = None
    """Tables on a terminal, if not `tables`."""
    printed_text_columns: Collection[str] = ()
    """Left-aligned columns on a terminal, if not `text_columns`."""
    intro: Sequence[str] = ()
    """Markdown lines below the title."""
    appendix: Sequence[str] = ()
    """Markdown lines at the end."""
    picture: Callable[[Path], object] | None = None
    """Draws the PNG file."""
    failed: Mapping[str, str] = field(default_factory=dict)
    """Reasons, by what was left out."""
    failure_text: str = "could not be used"
    """Verb phrase between a key of `failed` and its reason."""
    json_only: bool = False
    """Whether `--json` suppresses the tables."""

    def write(self) -> None:
        """Write all files into `out`."""
        files.write_json(self.out / f"{self.name}.json", self.data)
        for name, rows in self.csv_tables.items():
            files.write_text(self.out / f"{name}.csv", rows_to_csv(rows))
        files.write_text(self.out / f"{self.name}.md", self.to_markdown())
        if self.picture is not None:
            self.picture(self.out / f"{self.name}.png")

    def to_markdown(self) -> str:
        """Return the Markdown page."""
        lines = [f"# {self.heading}", "", *self.intro]
        lines += [f"![]({self.name}.png)", ""] if self.picture is not None else []
        for table in self.tables:
            lines += [*table.to_markdown(self.text_columns or table.columns[:1]), ""]
        return "\n".join([*lines, *(f"{note}\n" for note in self.notes), *self.appendix])

    def print(self, console: Console) -> None:
        """Print the tables and notes."""
        for table in self.tables if self.printed_tables is None else self.printed_tables:
            text_columns = self.printed_text_columns or self.text_columns or table.columns[:1]
            console.print(*table.fit_to_console(console, text_columns, **table.rich_options), sep="\n")
        for note in self.notes:
            console.print(note, soft_wrap=True)


def print_json(data: Mapping[str, Any]) -> None:
    """Print one line of JSON to standard output. Raises ValueError if a number is not finite."""
    sys.stdout.write(json.dumps(data, allow_nan=False) + "\n")


def rows_to_csv(rows: Sequence[Mapping[str, Any]], line_end: str = "\n") -> str:
    """Return rows as CSV, with a heading of all columns that any row has."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    return cells_to_csv(columns, ([row.get(name) for name in columns] for row in rows), line_end)


def cells_to_csv(columns: Sequence[str], rows: Iterable[Iterable[Any]], line_end: str = "\n") -> str:
    """Return CSV text.

    Args:
        columns: The heading.
        rows: Cells of each row.
        line_end: End of each line.
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator=line_end)
    writer.writerow(columns)
    writer.writerows(rows)
    return buffer.getvalue()


def format_count(number: int, noun: str, plural: str | None = None) -> str:
    """Format a number with its noun, such as 1 frame, 2 frames.

    Args:
        number: The number.
        noun: Singular of the noun.
        plural: Plural; the noun with an s by default.
    """
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def format_percent(value: float | None) -> str:
    """Format a fraction as a percentage with two decimals; "-" if it is undefined (None, or COCO's -1)."""
    return "-" if value is None or value < 0 else f"{100 * value:.2f}"


_MAX_CHARACTERS = 100_000
_LOG_WIDTH = 120
"""Characters per line of output that is not a terminal, unless COLUMNS is set."""
_LINE_SECONDS = 10.0
"""Time between two lines of `ProgressLines`."""


class Console(rich.console.Console):
    """A rich console for text from any file: brackets are not markup, and control characters are escaped."""

    def __init__(self, **rich_options: Any) -> None:
        super().__init__(markup=False, **rich_options)
        chosen = "width" in rich_options or "COLUMNS" in os.environ
        if not (chosen or self.is_terminal or self.is_jupyter):
            self.width = _LOG_WIDTH

    def render_str(self, text: str, **rich_options: Any) -> Text:
        """Render a string after escaping what would control the terminal."""
        return super().render_str(make_printable(text, _MAX_CHARACTERS), **rich_options)


def progress_bar(
    console: Console,
    *,
    keep: bool = True,
    show_elapsed: bool = True,
    show_remaining: bool = False,
    hidden: bool = False,
) -> Progress:
    """Return a progress bar with a description and a count, or plain lines (`ProgressLines`) without a terminal.

    Args:
        console: Where it is drawn.
        keep: Leave it on the screen at the end.
        show_elapsed: Show the time taken so far.
        show_remaining: Show an estimate of the time left.
        hidden: Draw nothing.
    """
    if not (hidden or console.is_terminal or console.is_jupyter):
        return ProgressLines(console, keep)
    columns: list[ProgressColumn] = [
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
    ]
    columns += [TimeElapsedColumn()] if show_elapsed else []
    columns += [TimeRemainingColumn()] if show_remaining else []
    return Progress(*columns, console=console, transient=not keep, disable=hidden)


def training_progress_bar(console: Console) -> Progress:
    """Return a bar of training steps with the time left."""
    return progress_bar(console, keep=False, show_elapsed=False, show_remaining=True)


class ProgressLines(Progress):
    """Progress for logs: a plain line for each running task every `_LINE_SECONDS`, with its count, pace and time left.

    Args:
        console: Where lines are printed.
        keep: Print a last line for each task at the end.
    """

    def __init__(self, console: Console, keep: bool = True) -> None:
        super().__init__(console=console, disable=True)
        self._keep = keep
        self._ended = threading.Event()
        self._first: dict[TaskID, float] = {}
        """Count at the start, by task; a resumed one has more than 0."""
        self._thread = threading.Thread(target=self._print_running, daemon=True)

    def add_task(self, *arguments: Any, **options: Any) -> TaskID:
        """Add a task, as `Progress.add_task`."""
        task = super().add_task(*arguments, **options)
        self._first[task] = self._tasks[task].completed
        return task

    def start(self) -> None:
        """Start printing."""
        self._thread.start()

    def stop(self) -> None:
        """End printing."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._keep:
            self._print_lines(self.tasks)

    def _print_running(self) -> None:
        while not self._ended.wait(_LINE_SECONDS):
            self._print_lines([task for task in self.tasks if not task.finished])

    def _print_lines(self, tasks: Iterable[Task]) -> None:
        for task in tasks:
            self.console.print(self._format_line(task), soft_wrap=True, highlight=False)

    def _format_line(self, task: Task) -> str:
        elapsed, done = task.elapsed or 0.0, task.completed - self._first[task.id]
        parts = [f"{task.completed:g}" if task.total is None else f"{task.completed:g} of {task.total:g}"]
        parts = parts if task.completed or task.total is not None else []
        parts.append(_format_duration(elapsed))
        if done and elapsed:
            pace = elapsed / done
            parts.append(f"{pace:.1f} s each" if pace >= 1 else f"{1 / pace:.1f} a second")
            parts += [f"{_format_duration(pace * task.remaining)} left"] if task.remaining else []
        return f"{task.description}: {', '.join(parts)}"


def _format_duration(seconds: float) -> str:
    """Format a duration as h:mm:ss."""
    return str(timedelta(seconds=round(seconds)))
