"""The bar that a terminal shows while a command works."""

from __future__ import annotations

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from drivesem.report.terminal import Console


def progress_bar(
    console: Console, *, stays: bool = True, elapsed: bool = True, remaining: bool = False, hidden: bool = False
) -> Progress:
    """A bar with a description and a count. stays: at the end too; elapsed, remaining: the times that it shows."""
    columns: list[ProgressColumn] = [
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
    ]
    columns += [TimeElapsedColumn()] if elapsed else []
    columns += [TimeRemainingColumn()] if remaining else []
    return Progress(*columns, console=console, transient=not stays, disable=hidden)


def training_bar(console: Console) -> Progress:
    """A bar of steps with the time that is left, on a terminal only."""
    return progress_bar(console, stays=False, elapsed=False, remaining=True, hidden=not console.is_terminal)
