"""Console output and progress bars."""

from __future__ import annotations

from typing import Any

import rich.console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from scene_ir.errors import make_printable

_MAX_CHARACTERS = 100_000


class Console(rich.console.Console):
    """A rich console for text from any file: brackets are not markup, and control characters are escaped."""

    def __init__(self, **rich_options: Any) -> None:
        super().__init__(markup=False, **rich_options)

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
    """Return a progress bar with a description and a count.

    Args:
        console: Where it is drawn.
        keep: Leave it on the screen at the end.
        show_elapsed: Show the time taken so far.
        show_remaining: Show an estimate of the time left.
        hidden: Draw nothing.
    """
    columns: list[ProgressColumn] = [
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
    ]
    columns += [TimeElapsedColumn()] if show_elapsed else []
    columns += [TimeRemainingColumn()] if show_remaining else []
    return Progress(*columns, console=console, transient=not keep, disable=hidden)


def training_progress_bar(console: Console) -> Progress:
    """Return a bar of training steps with the time left; hidden if the console is not a terminal."""
    return progress_bar(
        console, keep=False, show_elapsed=False, show_remaining=True, hidden=not console.is_terminal
    )
